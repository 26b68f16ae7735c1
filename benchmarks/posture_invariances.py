"""Real robots' postures told in other ways, as logs and model files differ: the calibration is to be the same.

    python benchmarks/posture_invariances.py [--only talos irb120 ...] [--ways WORD ...] [--command diagnose] [--jobs N]

The pose sets of `calibration.py` by the command line: columns by name or from the last, recordings in another order,
mm, degrees, CSV, quaternions, single precision, the device elsewhere, the robot file with its parts in another order,
with other names of links, turned on its base together with gravity, each as far as it changes a set. Printed are level,
verdict, the error on held-out postures, how many of the causes are the same, and the largest difference of a number of
the robot, in its standard deviations.
"""

from __future__ import annotations

import argparse
import copy
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
from scipy.spatial.transform import Rotation

sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent)]
import calibration  # noqa: E402

from benchmarks import invariances  # noqa: E402

Arrays = list[dict[str, np.ndarray]]
Case = tuple[dict[str, Any], Arrays, str]  # task, arrays of its files, the robot's URDF
FILES = {
    "talos": "talos_contact/talos_full_v2.urdf",
    "tiago": "tiago_mocap/tiago_no_hand.urdf",
    "irb120": "irb120_wu2015/irb120.urdf",
    "panda_handeye": "panda_handeye_board/panda.urdf",
    "mukca": "mukca_panda/panda.urdf",
}
HEAD = "| way | level, verdict | held out, mm | causes | same | largest difference |\n" + "|---" * 6 + "|"
PLACE = np.eye(4)  # where the device is put instead
PLACE[:3, :3], PLACE[:3, 3] = Rotation.from_euler("xyz", [0.7, -1.2, 2.1]).as_matrix(), [1.3, -2.0, 0.4]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], metavar="WORD")
    parser.add_argument("--ways", nargs="+", default=[], metavar="WORD")
    parser.add_argument("--command", choices=["calibrate", "diagnose"], default="calibrate")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    ways = {name: way for name, way in WAYS.items() if not args.ways or any(word in name for word in args.ways)}
    for name in calibration.SETS:
        if args.only and not any(word in name for word in args.only):
            continue
        case = _case(name)
        made = {way: make(*copy.deepcopy(case)) for way, make in ways.items()}
        cases = {"as it is": case} | {way: own for way, own in made.items() if own is not None}
        with tempfile.TemporaryDirectory() as place, ThreadPoolExecutor(args.jobs) as pool:
            jobs = [pool.submit(_told, Path(place, str(k)), args.command, *c) for k, c in enumerate(cases.values())]
            told = [job.result() for job in jobs]
        print(f"\n{name}\n{HEAD}")
        for way, answer in zip(cases, told, strict=True):
            print(f"| {way} | {_line(told[0], answer)} |", flush=True)


def _case(name: str) -> Case:
    model, recordings = calibration.SETS[name]()
    data, arrays = [], []
    for k, one in enumerate(recordings):
        measurement: dict[str, Any] = {one.kind: "m", "base_frame": one.base_frame, "tool_frame": one.tool_frame}
        measurement |= {"unknown": list(one.unknown)} | ({"distance": one.distance} if one.distance else {})
        data.append({"file": f"run{k}.npz", "position": "q", "role": one.role, "measurement": measurement})
        arrays.append({"q": one.position, "m": one.values})
    task = {"robot": {"model": "robot.urdf", "joints": list(model.joint_names)}, "data": data}
    file = next(path for word, path in FILES.items() if name.startswith(word))
    return task, arrays, (calibration.DATA / file).read_text().lstrip()


def _told(folder: Path, command: str, task: dict[str, Any], arrays: Arrays, urdf: str) -> dict[str, Any] | str:
    folder.mkdir()
    (folder / "robot.urdf").write_text(urdf)
    for entry, own in zip(task["data"], arrays, strict=True):
        if entry["file"].endswith(".csv"):
            flat = {key: values.reshape(len(values), -1) for key, values in own.items()}
            names = [f"{key}_{k}" for key, values in flat.items() for k in range(values.shape[1])]
            table = np.hstack(list(flat.values()))
            np.savetxt(folder / entry["file"], table, delimiter=",", header=",".join(names), comments="", fmt="%.17g")
        else:
            np.savez(folder / entry["file"], allow_pickle=False, **own)
    (folder / "task.yaml").write_text(yaml.safe_dump(task, sort_keys=False))
    line = [sys.executable, "-m", "figaroh_jax", command, str(folder / "task.yaml"), "--out", str(folder / "run")]
    run = subprocess.run([*line, "--quiet"], capture_output=True, text=True, check=False)
    file = {"calibrate": "result.json", "diagnose": "answer.json"}[command]
    return run.stderr[-300:] if run.returncode else json.loads((folder / "run" / file).read_text())


def _line(first: Any, answer: Any) -> str:
    if isinstance(answer, str):
        return " ".join(answer.split())
    mine, its = ({(c["effect"], tuple(sorted(c["at"]))) for c in one["causes"]} for one in (first, answer))
    parameters = [{p["name"]: p for p in one.get("parameters", ())} for one in (first, answer)]
    moved = [
        abs(parameters[1][name]["value"] - own["value"]) / own["std"]
        for name, own in parameters[0].items()
        if name in parameters[1] and own["std"] and name.split()[0] not in ("base_frame", "tool_frame", "socket")
    ]
    error = answer.get("position") or {}
    held = " -> ".join(f"{error[key]:.5f}" for key in ("validated_before", "validated_after")) if error else ""
    size = f"{max(moved, default=0.0):.1g}"
    return " | ".join(
        [f"{answer.get('level', '')} {answer['verdict']}", held, str(len(its)), str(len(mine & its)), size]
    )


def _ordered(order: Callable[[list[str]], list[int]]) -> Callable[..., Case | None]:
    def way(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case | None:
        names = task["robot"]["joints"]
        place = order(names)
        task["robot"]["joints"] = [names[k] for k in place]
        turned = [own | {"q": own["q"][:, place]} for own in arrays]
        return None if place == list(range(len(names))) else (task, turned, urdf)

    return way


def _recordings(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case | None:
    return None if len(arrays) == 1 else (task | {"data": task["data"][::-1]}, arrays[::-1], urdf)


def _units(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case | None:
    """Degrees where every joint turns, and mm where lengths are measured."""
    slides = re.findall(r'<joint[^>]*name="([^"]*)"[^>]*type="prismatic"', urdf)
    units = {} if set(slides) & set(task["robot"]["joints"]) else {"position": "deg"}
    touched = "socket" in task["data"][0]["measurement"]
    units |= {} if touched else {"measurement": "mm"}
    told = []
    for own in arrays:
        seen = own["m"] if touched else 1e3 * own["m"]
        if seen.shape[-2:] == (4, 4):
            seen = own["m"].copy()
            seen[:, :3, 3] *= 1e3
        told.append({"q": np.degrees(own["q"]) if "position" in units else own["q"], "m": seen})
    return (task | {"data": [entry | {"units": units} for entry in task["data"]]}, told, urdf) if units else None


def _csv(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case:
    for entry in task["data"]:
        entry |= {"file": entry["file"].replace(".npz", ".csv"), "position": "q_"}
        kind = next(kind for kind in ("pose", "position", "socket") if kind in entry["measurement"])
        entry["measurement"][kind] = "m_0" if kind == "socket" else "m_"
    return task, arrays, urdf


def _quaternions(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case | None:
    if "pose" not in task["data"][0]["measurement"]:
        return None
    seen = [np.column_stack([o["m"][:, :3, 3], Rotation.from_matrix(o["m"][:, :3, :3]).as_quat()]) for o in arrays]
    return task, [own | {"m": m} for own, m in zip(arrays, seen, strict=True)], urdf


def _single(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case:
    return task, [{k: v.astype(np.float32) if v.dtype.kind == "f" else v for k, v in o.items()} for o in arrays], urdf


def _elsewhere(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case | None:
    if "base_frame" not in task["data"][0]["measurement"]["unknown"]:
        return None
    posed = "pose" in task["data"][0]["measurement"]
    moved = [PLACE @ own["m"] if posed else own["m"] @ PLACE[:3, :3].T + PLACE[:3, 3] for own in arrays]
    return task, [own | {"m": m} for own, m in zip(arrays, moved, strict=True)], urdf


def _renamed(task: dict[str, Any], arrays: Arrays, urdf: str) -> Case:
    names = [link.attrib["name"] for link in ElementTree.fromstring(urdf).iter("link")]  # noqa: S314  the set's own file
    new = {name: f"body {k:02d}" for k, name in enumerate(names)}
    for name, other in new.items():
        urdf = re.sub(rf'(<link[^>]*name=|link=)"{re.escape(name)}"', rf'\1"{other}"', urdf)
    for entry in task["data"]:
        for key in ("base_frame", "tool_frame"):
            entry["measurement"][key] = new.get(entry["measurement"][key], entry["measurement"][key])
    return task, arrays, urdf


WAYS: dict[str, Callable[..., Case | None]] = {
    "columns by name": _ordered(lambda names: sorted(range(len(names)), key=lambda k: names[k])),
    "columns from the last": _ordered(lambda names: list(range(len(names)))[::-1]),
    "recordings from the last": _recordings,
    "degrees and mm": _units,
    "CSV": _csv,
    "quaternions": _quaternions,
    "single precision": _single,
    "device elsewhere": _elsewhere,
    "robot file in another order": invariances.WAYS["robot file in another order"],
    "other names of links": _renamed,
    invariances.TURNED: invariances.WAYS[invariances.TURNED],
}


if __name__ == "__main__":
    main()
