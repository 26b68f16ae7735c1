"""One real robot's recordings told in other ways, as logs and model files differ: the answer is to be the same.

    python benchmarks/invariances.py [--only ur10e panda ...] [--ways WORD ...] [--jobs N]

Each set of `hide_in_real` is diagnosed by the command line as it is and in each way: columns by name (as ROS sorts
them), from the last to the first, recordings in another order, positions in degrees, stamps of the Unix epoch, single
precision, CSV, the robot file with its joints and links in another order, with other names of links, turned on its base
together with gravity, a joint's axis the other way round, the motor side of gears; a way that leaves a set as it is, or
that does not fit it, is left out. Printed are verdict, held-out error, and of the causes how many are the same and the
largest difference of a number, in its standard deviations.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.hide_in_real.generate import twin_of  # noqa: E402
from benchmarks.hide_in_real.recordings import SETS  # noqa: E402

Arrays = list[dict[str, np.ndarray]]
Case = tuple[dict[str, Any], Arrays, str]  # task, arrays of its files, the robot's URDF
HEAD = "| way | verdict | held out | causes | same | only here | lost | largest difference |\n" + "|---" * 8 + "|"
TURNED = "turned with gravity"
EPOCH = 1.7e9  # s
TURN = (0.5, -0.4, 1.1)  # rad, roll, pitch and yaw of the base


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(SETS), default=list(SETS))
    parser.add_argument("--ways", nargs="+", default=[], metavar="WORD")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    ways = {name: way for name, way in WAYS.items() if not args.ways or any(word in name for word in args.ways)}
    for name in args.only:
        with tempfile.TemporaryDirectory() as place:
            folder, case = Path(place), _case(name, Path(place))
            told_so = {way: make(*case) for way, make in ways.items()}
            cases = {"as it is": case} | {way: own for way, own in told_so.items() if own is not None}
            with ThreadPoolExecutor(args.jobs) as pool:
                jobs = [pool.submit(_told, folder / way.replace(" ", "_"), *own) for way, own in cases.items()]
                told = [job.result() for job in jobs]
        print(f"\n{name}\n{HEAD}")
        for way, answer in zip(cases, told, strict=True):
            print(f"| {way} | {_line(told[0], answer, way == TURNED)} |", flush=True)


def _case(name: str, folder: Path) -> Case:
    twin = twin_of(folder, SETS[name]())
    task = twin["task"]
    arrays = [dict(np.load(folder / entry["file"])) for entry in task["data"]]
    for entry in task["data"]:
        entry["file"] = Path(entry["file"]).name
    return task, arrays, (folder / twin["model"]).read_text()


def _told(folder: Path, task: dict[str, Any], arrays: Arrays, urdf: str) -> dict[str, Any] | str:
    folder.mkdir()
    (folder / "robot.urdf").write_text(urdf)
    task = task | {"robot": task["robot"] | {"model": "robot.urdf"}}
    for entry, own in zip(task["data"], arrays, strict=True):
        if str(entry["file"]).endswith(".csv"):
            columns = {k: v for key, values in own.items() for k, v in _columns(key, values)}
            table = np.column_stack(list(columns.values()))
            np.savetxt(folder / entry["file"], table, delimiter=",", header=",".join(columns), comments="", fmt="%.17g")
        else:
            np.savez(folder / entry["file"], allow_pickle=False, **own)
    (folder / "task.yaml").write_text(yaml.safe_dump(task, sort_keys=False))
    command = [sys.executable, "-m", "figaroh_jax", "diagnose", str(folder / "task.yaml"), "--out", str(folder / "run")]
    run = subprocess.run([*command, "--quiet"], capture_output=True, text=True, check=False)
    return run.stderr[-300:] if run.returncode else json.loads((folder / "run" / "answer.json").read_text())


def _columns(key: str, values: np.ndarray) -> list[tuple[str, np.ndarray]]:
    if values.ndim == 1:
        return [(key, values)]
    return [(f"{key}_{k}", column) for k, column in enumerate(values.T)]


def _line(first: Any, answer: Any, turned: bool) -> str:
    if isinstance(answer, str):
        return " ".join(answer.split())
    mine, its = ({(c["effect"], frozenset(c["at"])): c for c in one["causes"]} for one in (first, answer))
    moved = 0.0
    for cause in set(mine) & set(its):
        ours, theirs = mine[cause]["parameters"], its[cause]["parameters"]
        if turned and cause[0] == "gravity_tilt":  # its axes are the base's
            size = [np.hypot(*(told["value"] for told in one.values())) for one in (ours, theirs)]
            moved = max(moved, abs(size[1] - size[0]) / min(told["std"] for told in ours.values()))
            continue
        for key, told in ours.items():
            if told["std"]:
                moved = max(moved, abs(theirs[key]["value"] - told["value"]) / told["std"])
    words = [
        ", ".join(f"{e} {' '.join(sorted(at))}" for e, at in set(a) - set(b)) for a, b in ((its, mine), (mine, its))
    ]
    held = f"{answer['holdout']['before']:.5f} -> {answer['holdout']['after']:.5f}"
    return " | ".join([answer["verdict"], held, str(len(its)), str(len(set(mine) & set(its))), *words, f"{moved:.1g}"])


def _ordered(order: Callable[[list[str]], list[int]]) -> Callable[..., Case | None]:
    def way(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case | None:
        names = task["robot"]["joints"]
        place = order(names)
        if place == list(range(len(names))):
            return None
        task = task | {"robot": task["robot"] | {"joints": [names[k] for k in place]}}
        if "transmission" in task:
            turned = {k: np.array(v) for k, v in task["transmission"].items()}
            task["transmission"] = {
                k: (v[place] if v.ndim == 1 else v[np.ix_(place, place)]).tolist() for k, v in turned.items()
            }
        return task, [{k: v[:, place] if v.ndim == 2 else v for k, v in own.items()} for own in arrays], urdf

    return way


def _by_name(names: list[str]) -> list[int]:
    return sorted(range(len(names)), key=lambda k: names[k])


def _recordings(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case | None:
    return None if len(arrays) == 1 else (task | {"data": task["data"][::-1]}, arrays[::-1], urdf)


def _degrees(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case:
    entries = [entry | {"units": entry.get("units", {}) | {"position": "deg"}} for entry in task["data"]]
    return task | {"data": entries}, [own | {"q": np.degrees(own["q"])} for own in arrays], urdf


def _epoch(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case:
    entries, told = [], []
    for entry, own in zip(task["data"], arrays, strict=True):
        t = own["t"] if "t" in own else np.arange(len(own["q"])) / entry["rate"]
        told.append(own | {"t": t + EPOCH})
        entries.append({key: value for key, value in entry.items() if key != "rate"} | {"time": "t"})
    task = task | {"data": entries}
    if "window" in task["preprocess"]:  # it is by the stamps
        task["preprocess"] = task["preprocess"] | {"window": [edge + EPOCH for edge in task["preprocess"]["window"]]}
    return task, told, urdf


def _single(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case:
    return task, [{k: v if k == "t" else v.astype(np.float32) for k, v in own.items()} for own in arrays], urdf


def _csv(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case:
    entries = [entry | {"file": Path(entry["file"]).stem + ".csv"} for entry in task["data"]]
    for entry in entries:
        entry |= {key: f"{entry[key]}_" for key in ("position", "torque")}
    return task | {"data": entries}, arrays, urdf


def _shuffled(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case:
    root = ElementTree.fromstring(urdf)  # noqa: S314  the set\'s own file
    parts = [root[k] for k in np.random.default_rng(0).permutation(len(root))]
    root[:] = parts
    return task, arrays, ElementTree.tostring(root, encoding="unicode")


def _renamed(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case:
    root = ElementTree.fromstring(urdf)  # noqa: S314  the set's own file
    names = [link.attrib["name"] for link in root.iter("link")]
    for k, name in enumerate(names):
        urdf = re.sub(rf'(<link[^>]*name=|link=)"{re.escape(name)}"', rf'\1"body {k:02d}"', urdf)
    return task, arrays, urdf


def _turned(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case:
    root = ElementTree.fromstring(urdf)  # noqa: S314  the set\'s own file
    children = {child.attrib["link"] for child in root.iter("child")}
    base = next(link.attrib["name"] for link in root.iter("link") if link.attrib["name"] not in children)
    ElementTree.SubElement(root, "link", {"name": "floor"})
    joint = ElementTree.SubElement(root, "joint", {"name": "mount", "type": "fixed"})
    ElementTree.SubElement(joint, "parent", {"link": "floor"})
    ElementTree.SubElement(joint, "child", {"link": base})
    ElementTree.SubElement(joint, "origin", {"xyz": "1 2 3", "rpy": " ".join(map(str, TURN))})
    (cr, cp, cy), (sr, sp, sy) = np.cos(TURN), np.sin(TURN)
    turn = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )
    gravity = (turn @ np.array(task["robot"].get("gravity", [0.0, 0.0, -9.81]))).tolist()
    task = task | {"robot": task["robot"] | {"gravity": gravity}}
    return task, arrays, ElementTree.tostring(root, encoding="unicode")


def _flipped(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case | None:
    """The joint in the middle turns the other way round, in the robot file and in the recordings."""
    if "transmission" in task:
        return None
    names = task["robot"]["joints"]
    k, root = len(names) // 2, ElementTree.fromstring(urdf)  # noqa: S314  the set's own file
    joint = next(one for one in root.iter("joint") if one.get("name") == names[k])
    axis = joint.find("axis")
    if axis is None:
        axis = ElementTree.SubElement(joint, "axis", {"xyz": "1 0 0"})
    axis.set("xyz", " ".join(str(-float(x)) for x in axis.attrib["xyz"].split()))
    limit = joint.find("limit")
    if limit is not None and "lower" in limit.attrib:
        ends = [str(-float(limit.attrib[end])) for end in ("upper", "lower")]
        limit.attrib |= dict(zip(("lower", "upper"), ends, strict=True))
    sign = np.where(np.arange(len(names)) == k, -1.0, 1.0)
    turned = [{key: v * sign if v.ndim == 2 else v for key, v in own.items()} for own in arrays]
    return task, turned, ElementTree.tostring(root, encoding="unicode")


def _motor_side(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case | None:
    """Positions and torques before gears of 30 to 120, every second one turning the other way."""
    if "transmission" in task:
        return None
    names = task["robot"]["joints"]
    gear = np.linspace(30.0, 120.0, len(names)) * np.where(np.arange(len(names)) % 2, -1.0, 1.0)
    told = [{k: (v / gear if k == "tau" else v * gear) if v.ndim == 2 else v for k, v in one.items()} for one in arrays]
    both = dict.fromkeys(("position", "torque"), np.diag(gear).tolist())
    return task | {"transmission": both}, told, urdf


WAYS: dict[str, Callable[..., Case | None]] = {
    "columns by name": _ordered(_by_name),
    "columns from the last": _ordered(lambda names: list(range(len(names)))[::-1]),
    "recordings from the last": _recordings,
    "degrees": _degrees,
    "Unix epoch": _epoch,
    "single precision": _single,
    "CSV": _csv,
    "robot file in another order": _shuffled,
    "other names of links": _renamed,
    TURNED: _turned,
    "axis the other way round": _flipped,
    "motor side": _motor_side,
}


if __name__ == "__main__":
    main()
