"""`figaroh-jax new` on made recordings in other orders, signs, units and clocks, and on those of the public sets.

A draft is right where it reads back the positions (and torques) that were made; else it has to be refused, or its
comments have to say what nothing bears out. `python benchmarks/new.py` counts right, refused, said and wrong.
"""

from __future__ import annotations

import argparse
import collections
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))


FORMS = ("npz", "csv", "tsv", "mat", "h5", "parquet")


class Case(NamedTuple):
    """A recording that is known: of a made robot, or of a public set."""

    name: str
    model: Path
    joints: tuple[str, ...]
    straight: np.ndarray  # joints that slide
    arrays: dict[str, np.ndarray]  # t, q, tau


def made(count: int, folder: Path) -> Iterator[Case]:
    from generators import make_case

    for seed in range(count):
        robot = ("small", "tx40", "ur10e", "small")[seed % 4]
        case = make_case(robot=robot, repeats=1, trajectories=1, seed=seed)
        model = folder / f"robot_{seed}.urdf"
        model.write_text(case.urdf)
        run = case.recordings[0]
        arrays = {"t": run["time"], "q": run["position"], "tau": run["torque"]}
        yield Case(f"{seed} {robot}", model, case.joints, np.array([j == "slide" for j in case.joints]), arrays)


def real(each: int) -> Iterator[Case]:
    """Recordings of the public sets, at most `each` of a set."""
    import wrong_recordings

    import figaroh_jax as fj

    seen: collections.Counter[str] = collections.Counter()
    for base in wrong_recordings.real():
        kind = base.name.split("_")[0]
        seen[kind] += 1
        if "tau" not in base.arrays or seen[kind] > each:
            continue
        model = Path(base.robot["model"])
        joints = tuple(base.robot.get("joints") or fj.load_urdf(model).joint_names)
        yield Case(base.name, model, joints, np.zeros(len(joints), bool), base.arrays)


def spoiled(case: Case, rng: np.random.Generator) -> tuple[dict[str, np.ndarray], list[str] | None]:
    """A recording's columns under names, in an order, unit, sign and clock drawn at random, and what --joints says."""
    q, tau, joints = case.arrays["q"], case.arrays["tau"], case.joints
    shown = q if rng.random() < 0.5 else np.where(case.straight, q, np.rad2deg(q))
    sign = np.where(rng.random(len(joints)) < 0.2, -1.0, 1.0)
    factor = rng.choice([1.0, 1e3, 1e6, 1e9])
    time = case.arrays["t"] * factor + rng.choice([0.0, 1e3 * factor])
    if rng.random() < 0.5:  # named, in any order
        columns = {f"{joint}_pos": shown[:, j] for j, joint in enumerate(joints)}
        columns |= {f"{joint}_effort": (tau * sign)[:, j] for j, joint in enumerate(joints)}
        names = list(columns)
        rng.shuffle(names)
        return {"time": time, **{name: columns[name] for name in names}}, None
    order = np.arange(len(joints))
    if rng.random() < 0.5:
        rng.shuffle(order)
    return {"time": time, "q": shown[:, order], "tau": (tau * sign)[:, order]}, list(joints)


def written(columns: dict[str, np.ndarray], form: str, folder: Path) -> Path:
    """The columns in a file of a format."""
    file = folder / f"run.{form}"
    flat = {
        f"{n}{'_' + str(k) if x.ndim > 1 else ''}": c
        for n, x in columns.items()
        for k, c in enumerate(np.atleast_2d(x.T))
    }
    if form == "npz":
        np.savez(file, **columns)  # pyright: ignore[reportArgumentType]
    elif form in ("csv", "tsv"):
        mark = {"csv": ";", "tsv": "\t"}[form]
        np.savetxt(file, np.column_stack([*flat.values()]), "%.17g", mark, header=mark.join(flat), comments="# ")
    elif form == "mat":
        from scipy.io import savemat

        savemat(file, {"log": columns})
    elif form == "h5":
        import h5py

        with h5py.File(file, "w") as opened:
            for name, values in columns.items():
                opened[f"log/{name}"] = values
    else:
        import pandas as pd

        pd.DataFrame(flat).to_parquet(file)
    return file


def grade(task_text: str, assumed: tuple[str, ...], case: Case, folder: Path) -> str:
    from figaroh_jax.formats.config import load_task
    from figaroh_jax.formats.robotfile import load_robot
    from figaroh_jax.recordings.dataset import read_recordings

    (folder / "task.yaml").write_text(task_text)
    task = load_task(folder / "task.yaml")
    (recording,) = read_recordings(task, load_robot(task))
    assert recording.torque is not None
    order = [case.joints.index(name) for name in recording.joints]
    q, tau = case.arrays["q"][:, order], case.arrays["tau"][:, order]
    off = (np.abs(recording.position - q).max(axis=0) > 1e-6) | (np.abs(recording.torque - tau).max(axis=0) > 1e-6)
    if not off.any():
        return "right"
    unsure = " ".join(line for line in assumed if "nothing tells" in line or "bear the order out" in line)
    borne = unsure.split("bear the order out at")[-1].split(";")[0] if "bear the order out" in unsure else ""
    names = np.array(recording.joints)[off]
    said = all(name in unsure.split("no column")[0] or (borne and name not in borne) for name in names)
    return "said" if said else f"WRONG at {', '.join(names)}"


def main() -> None:
    from figaroh_jax.errors import InputError
    from figaroh_jax.recordings.draft import draft_task

    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--cases", type=int, default=40, help="made recordings")
    parser.add_argument("--each", type=int, default=3, help="recordings of each public set")
    asked = parser.parse_args()
    counts: collections.Counter[str] = collections.Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for k, case in enumerate([*made(asked.cases, folder), *real(asked.each)]):
            rng = np.random.default_rng(k)
            columns, joints = spoiled(case, rng)
            form = FORMS[k % len(FORMS)]
            file = written(columns, form, folder)
            try:
                draft = draft_task(case.model, [file], joints=joints if case.name[0].isalpha() else None)
                found = grade(draft.text, draft.assumed, case, folder)
            except InputError as error:
                found = f"refused: {str(error)[:160]}"
            counts[("real " if case.name[0].isalpha() else "made ") + found.split()[0].rstrip(":")] += 1
            print(f"{case.name} {form}: {found}", flush=True)
    print(dict(counts))


if __name__ == "__main__":
    main()
