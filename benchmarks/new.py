"""`figaroh-jax new` on made recordings in other orders, signs, units and clocks, and on those of the public sets.

A draft is right where it reads back the positions (and torques) that were made; else it has to be refused, or its
comments have to say what nothing bears out. `python benchmarks/new.py` counts right, refused, said and wrong.
"""

from __future__ import annotations

import argparse
import collections
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))


def spoiled(case: Any, rng: np.random.Generator) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """A recording's columns under names, in an order, unit, sign and clock drawn at random; and what they hold."""
    run, joints = case.recordings[0], case.joints
    q, tau = run["position"], run["torque"]
    straight = np.array([joint == "slide" for joint in joints])
    shown = q if rng.random() < 0.5 else np.where(straight, q, np.rad2deg(q))
    sign = np.where(rng.random(len(joints)) < 0.2, -1.0, 1.0)
    factor = rng.choice([1.0, 1e3, 1e6, 1e9])
    time = run["time"] * factor + rng.choice([0.0, 1e3 * factor])
    if rng.random() < 0.5:  # named, in any order
        columns = {f"{joint}_pos": shown[:, j] for j, joint in enumerate(joints)}
        columns |= {f"{joint}_effort": (tau * sign)[:, j] for j, joint in enumerate(joints)}
        names = list(columns)
        rng.shuffle(names)
        return {"time": time, **{name: columns[name] for name in names}}, q, tau
    order = np.arange(len(joints))
    if rng.random() < 0.5:
        rng.shuffle(order)
    return {"time": time, "q": shown[:, order], "tau": (tau * sign)[:, order]}, q, tau


def grade(task_text: str, assumed: tuple[str, ...], q: np.ndarray, tau: np.ndarray, folder: Path) -> str:
    from figaroh_jax.formats.config import load_task
    from figaroh_jax.formats.robotfile import load_robot
    from figaroh_jax.recordings.dataset import read_recordings

    (folder / "task.yaml").write_text(task_text)
    task = load_task(folder / "task.yaml")
    (recording,) = read_recordings(task, load_robot(task))
    assert recording.torque is not None
    off = (np.abs(recording.position - q).max(axis=0) > 1e-6) | (np.abs(recording.torque - tau).max(axis=0) > 1e-6)
    if not off.any():
        return "right"
    unsure = " ".join(line for line in assumed if "nothing tells" in line or "bear the order out" in line)
    borne = unsure.split("bear the order out at")[-1].split(";")[0] if "bear the order out" in unsure else ""
    names = np.array(recording.joints)[off]
    said = all(name in unsure.split("no column")[0] or (borne and name not in borne) for name in names)
    return "said" if said else f"WRONG at {', '.join(names)}"


def main() -> None:
    from generators import make_case

    from figaroh_jax.errors import InputError
    from figaroh_jax.recordings.draft import draft_task

    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--cases", type=int, default=40)
    counts: collections.Counter[str] = collections.Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for seed in range(parser.parse_args().cases):
            robot = ("small", "tx40", "ur10e", "small")[seed % 4]
            case = make_case(robot=robot, repeats=1, trajectories=1, seed=seed)
            (folder / "robot.urdf").write_text(case.urdf)
            columns, q, tau = spoiled(case, np.random.default_rng(seed))
            np.savez(folder / "run.npz", **columns)  # pyright: ignore[reportArgumentType]
            try:
                draft = draft_task(folder / "robot.urdf", [folder / "run.npz"])
                found = grade(draft.text, draft.assumed, q, tau, folder)
            except InputError as error:
                found = "refused"
                print(f"{seed} {robot}: refused: {str(error)[:200]}", flush=True)
            counts[found.split()[0]] += 1
            if found not in ("refused", "right"):
                print(f"{seed} {robot}: {found}", flush=True)
    print(dict(counts))


if __name__ == "__main__":
    main()
