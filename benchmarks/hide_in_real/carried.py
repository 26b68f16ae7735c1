"""A body that real robots carry for a part of a recording: its torque added to what was measured, Pinocchio's.

    python -m benchmarks.hide_in_real.carried --seeds 0 2                 # needs Pinocchio and $FIGAROH_JAX_DATA
    python -m benchmarks.hide_in_real.carried --robots tx40 panda --sizes 0.2 --forbid

In at least one recording that is fitted, from a tenth to a half of its time on, for a fifth to two fifths of it, the
last link has a body whose torque is a share (`--sizes`) of the RMS torque of the joint where it shows most. It weighs
on the robot bit by bit, in .15 s. A line a case: what is named beside the names of the untouched twin, and each stretch
as it was made and as it was told. `--forbid` takes `payload` out of the catalogue: then no name may be new.
"""

from __future__ import annotations

import argparse
import collections
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from .. import blackbox
from .generate import twin_of
from .motion import Scene, scene_of
from .recordings import SETS, RealSet

SETTLES = 0.15  # s
LIMIT = 1800  # s of one call
TOLD = re.compile(r"in (\S+) from ([\d.-]+) s to ([\d.-]+) s, ([\d.e-]+) \+- ([\d.e-]+) kg")
NEAR, SIZED = 0.5, 0.15  # s, and share of the mass: as it is told and as it was made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 1], metavar=("FIRST", "END"))
    parser.add_argument("--robots", nargs="+", choices=list(SETS), default=list(SETS))
    parser.add_argument("--sizes", nargs="+", type=float, default=[0.1, 0.2])
    parser.add_argument("--forbid", action="store_true", help="payload is left out of the catalogue")
    args = parser.parse_args()
    count = collections.Counter[str]()
    for robot in args.robots:
        real = SETS[robot]()
        scenes = [scene_of(real, recording) for recording in real.recordings]
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch)
            twin = twin_of(folder, real)
            before = _names(_diagnosed(folder, twin, args.forbid))
            print(f"{robot} untouched: {before}", flush=True)
            for seed in range(*args.seeds):
                for size in args.sizes:
                    added, stretches = _added(real, scenes, seed, size)
                    np.savez(folder / "added.npz", allow_pickle=False, **added)
                    found = _diagnosed(folder, twin | {"added": "added.npz"}, args.forbid)
                    mark, line = _graded(found, before, stretches)
                    count[f"{size:.0%}: {mark}"] += 1
                    print(f"{robot} {seed} {size:.0%}: {mark}; {line}", flush=True)
    print(*(f"{key} {number}" for key, number in sorted(count.items())), sep="\n")


def _added(real: RealSet, scenes: list[Scene], seed: int, size: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Torque in the file's own words, and by recording from when to when (s) which mass (kg) is carried."""
    rng = np.random.default_rng([seed, blackbox.digest(real.name, "carried")])
    fitted = [k for k, scene in enumerate(scenes) if scene.fitted]
    chosen = {int(rng.choice(fitted)), *(k for k in fitted if rng.random() < 0.5)}
    com = np.array([0.02, -0.01, 0.08]) + 0.03 * rng.uniform(-1, 1, 3)
    moments = 1e-4 * np.eye(3) + com @ com * np.eye(3) - np.outer(com, com)
    ten = np.array([1.0, *com, *(moments[i, k] for i, k in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)))])
    out, told = {}, {}
    for k in sorted(chosen):
        scene = scenes[k]
        times = scene.time[scene.kept]
        begins = times[0] + rng.uniform(0.1, 0.5) * (times[-1] - times[0])
        ends = begins + rng.uniform(0.2, 0.4) * (times[-1] - times[0])
        weighs = np.clip((scene.time - begins) / SETTLES, 0, 1) * np.clip((ends - scene.time) / SETTLES, 0, 1)
        unit = scene.of_body(len(real.joints) - 1, ten) * weighs[:, None]
        there = scene.kept & (weighs > 0)
        share = np.sqrt((unit[there] ** 2).mean(0)) / np.sqrt((scene.torque[scene.kept] ** 2).mean(0))
        mass = size / float(share.max())
        out[f"{real.recordings[k].name}/tau"] = real.stored(mass * unit)
        told[real.recordings[k].name] = (float(begins), float(ends), mass)
    return out, told


def _diagnosed(folder: Path, case: dict[str, Any], forbid: bool) -> dict[str, Any]:
    """The answer of the command line."""
    job = blackbox.Job(case["name"], ("payload",) if forbid else ())
    with tempfile.TemporaryDirectory() as out:
        said = blackbox.call_tool(folder, Path(out), case, job, blackbox.default_command(), LIMIT)
        answer = blackbox.read(Path(out) / job.folder)
    if answer is None:
        raise SystemExit(said)
    return answer


def _names(answer: dict[str, Any]) -> list[str]:
    return [_name(cause) for cause in answer["causes"]]


def _name(cause: dict[str, Any]) -> str:
    return f"{cause['effect']} ({', '.join(cause['at'])})"


def _graded(answer: dict[str, Any], before: list[str], stretches: dict[str, Any]) -> tuple[str, str]:
    """In a word, and in words."""
    new = [cause for cause in answer["causes"] if _name(cause) not in before]
    notes = [note for note in answer["notes"] if note.startswith("payload at") and "carried" in note]
    loads = [cause for cause in new if cause["effect"] == "payload" and notes]
    said = {name: tuple(map(float, numbers)) for name, *numbers in TOLD.findall(notes[0])} if loads else {}
    line = f"new {[_name(cause) for cause in new]}"
    line += f", gone {[name for name in before if name not in _names(answer)]}, {answer['verdict']}; "
    right = bool(said) and len(new) == len(loads) == 1
    for name, (begins, ends, mass) in stretches.items():
        line += f"{name} {begins:.2f} to {ends:.2f} s, {mass:.3g} kg: "
        if name not in said:
            line += "not told; "
            continue
        b, e, m, d = said[name]
        right &= abs(b - begins) < NEAR and abs(e - ends) < NEAR and abs(m - mass) < max(SIZED * mass, 1.5 * d)
        line += f"{b:.2f} to {e:.2f} s, {m:.3g} +- {d:.2g} kg; "
    right &= all(name in stretches for name in said)
    word = "right" if right else "wrong" if len(new) != len(loads) else "other numbers" if loads else "silent"
    return word, line


if __name__ == "__main__":
    main()
