"""What `diagnose` says of a real robot from recordings that have nothing in common: the same causes of the same size?

    python benchmarks/same_robot.py [--only ur10e ...] [--jobs 2] [--out RESULTS.json]

What a real robot has that its model file lacks nobody knows; but it is there in all of its recordings. Each set is cut
into groups of recordings, or a long one into parts, and each group is diagnosed by the command line as if there were no
other. One row a cause: its first number, value +- half of the 95 % interval, by each group that names it. Two sizes
agree where they differ by no more than the intervals of both say (root of the sum of squares).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.hide_in_real.recordings import DATA, SETS, UR_GAIN

Task = dict[str, Any]
UR10E = (  # the last of each is kept out
    ("20_02_10_30sec_12harm", "20_02_12_40sec_12harm", "20_02_10_20sec_7harm"),  # those of `hide_in_real`
    ("20_02_12_50sec_12harm", "20_02_06_20sec_10harm", "20_02_05_20sec_8harm"),
    ("20_02_19_14harm50sec", "20_02_06_20sec_5harm", "20_02_05_20sec_12harm"),
    ("20_02_19_15harm50sec", "20_01_31_unload", "19_12_23_free"),
)
UR10E_2019 = ("19_10_01_13_51_41", "19_10_01_14_04_13", "19_10_01_14_04_41", "19_09_27_11_28_22", "19_09_27_15_11_06")
PENDULUM = (
    ("143339", "143524", "143601", "143704", "154220", "154548"),  # those of `hide_in_real`
    ("143747", "143906", "144003", "144115"),
)


def ur10e(groups: Sequence[Sequence[str]] = UR10E) -> list[Task]:
    """Four groups of three recordings, two fitted."""
    joints = [f"{n}_joint" for n in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")]
    folder = DATA / "ur10e_innopolis"
    entry = {"time": "t", "position": "q", "torque": "i", "units": {"torque": "A"}}
    task = {
        "robot": {"model": str(folder / "ur10e.urdf"), "joints": joints},
        "preprocess": {"cutoff": 5},
        "baseline": {"offset": True},
        "transmission": {"torque": np.diag(UR_GAIN).tolist()},
    }
    return [task | {"data": _data(folder / "id", runs, entry)} for runs in groups]


def ur10e_2019() -> list[Task]:
    """Five short recordings of the same robot that no rule was set on."""
    return ur10e([UR10E_2019])


def tx40() -> list[Task]:
    """The first and the second half of the one recording."""
    real = SETS["tx40"]()
    low, high = real.window
    middle = (low + high) / 2
    return [
        real.task | {"preprocess": real.task["preprocess"] | {"window": list(part)}}
        for part in ((low, middle), (middle, high))
    ]


def tiago() -> list[Task]:
    """The parts that `hide_in_real` fits and keeps out, each by itself."""
    return [dict(SETS["tiago"]().task), dict(SETS["tiago"]().task)]


def dfki_double_pendulum() -> list[Task]:
    """Two groups of runs; the last of each is kept out."""
    folder = DATA / "dfki_double_pendulum"
    entry = {"time": "t", "position": "q", "torque": "tau"}
    task = {
        "robot": {"model": str(folder / "double_pendulum_C1.urdf"), "joints": ["Joint1", "Joint2"]},
        "preprocess": {"cutoff": 15},
        "baseline": {"offset": True},
    }
    return [task | {"data": _data(folder, [f"C1_20230629-{k}" for k in runs], entry)} for runs in PENDULUM]


ROBOTS = {
    "ur10e": ur10e,
    "ur10e_2019": ur10e_2019,
    "tx40": tx40,
    "tiago": tiago,
    "dfki_double_pendulum": dfki_double_pendulum,
}


def _data(folder: Path, runs: Sequence[str], entry: Task) -> list[Task]:
    roles = [*["fit"] * (len(runs) - 1), "holdout"]
    return [{"file": str(folder / f"{run}.npz"), "role": role} | entry for run, role in zip(runs, roles, strict=True)]


def _written(name: str, group: int, task: Task, folder: Path) -> Path:
    """The task as a file; of sets that `hide_in_real` makes, with its model and recordings."""
    folder.mkdir(parents=True)
    if "data" not in task:
        real = SETS[name]()
        (folder / "robot.urdf").write_text(real.urdf)
        parts = real.recordings if len(real.recordings) == 1 else [real.recordings[group]]
        for part in parts:
            np.savez(folder / f"{part.name}.npz", allow_pickle=False, **part.arrays)
        data = [{"file": f"{part.name}.npz"} | part.entry | {"role": "fit"} for part in parts]
        task = task | {"robot": task["robot"] | {"model": "robot.urdf"}, "data": data}
    (folder / "task.json").write_text(json.dumps(task))
    return folder / "task.json"


def answered(name: str, group: int, task: Task, scratch: Path) -> dict[str, Any]:
    """`answer.json` of one group."""
    file = _written(name, group, task, scratch / f"{name}_{group}")
    out = file.parent / "run"
    words = [sys.executable, "-m", "figaroh_jax", "diagnose", str(file), "--out", str(out), "--quiet"]
    run = subprocess.run(words, capture_output=True, text=True, check=False)
    if not (out / "answer.json").exists():
        raise SystemExit(f"{name} {group}: {run.stderr[-500:]}")
    return json.loads((out / "answer.json").read_text())


def table(name: str, answers: list[dict[str, Any]]) -> list[str]:
    """The causes of all groups with their sizes, and how many of these agree."""
    rows: dict[str, dict[int, tuple[float, float, str]]] = {}
    for k, answer in enumerate(answers):
        for cause in answer["causes"]:
            at = ", ".join(cause["at"])
            number, first = next(iter(cause["parameters"].items()))
            one = first["value"], 1.96 * first["std"], f"{number}, {first['unit']}" if first["unit"] else number
            rows.setdefault(f"{cause['effect']} ({at})", {})[k] = one
    held = [answer["holdout"] for answer in answers]
    errors = ", ".join(f"{h['before']:.4f} -> {h['after']:.4f}" for h in held)
    lines = [f"## {name}: {', '.join(a['verdict'] for a in answers)}; error held out {errors}", ""]
    lines += [
        f"| cause | number |{''.join(f' {k + 1} |' for k in range(len(answers)))}",
        "|---" * (len(answers) + 2) + "|",
    ]
    pairs = same = 0
    for cause, sizes in sorted(rows.items(), key=lambda row: (-len(row[1]), row[0])):
        told = [f"{sizes[k][0]:.3g} +- {sizes[k][1]:.2g}" if k in sizes else "" for k in range(len(answers))]
        lines.append(f"| {cause} | {next(iter(sizes.values()))[2]} | {' | '.join(told)} |")
        for (a, da, _), (b, db, _) in combinations(sizes.values(), 2):
            pairs, same = pairs + 1, same + (abs(a - b) <= np.hypot(da, db))
    common = sum(len(sizes) == len(answers) for sizes in rows.values())
    several = sum(len(sizes) > 1 for sizes in rows.values())
    lines += [
        "",
        f"{len(rows)} causes, {common} by every group, {several} by several; sizes agree in {same} of {pairs} pairs",
    ]
    return lines


def main() -> None:
    """Diagnose each group in a process of its own and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="JSON file of all answers")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(args.jobs) as pool:
        work = {
            name: [pool.submit(answered, name, k, task, Path(scratch)) for k, task in enumerate(ROBOTS[name]())]
            for name in args.only
        }
        told = {name: [one.result() for one in ones] for name, ones in work.items()}
    for name, answers in told.items():
        print(*table(name, answers), "", sep="\n", flush=True)
    if args.out:
        args.out.write_text(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
