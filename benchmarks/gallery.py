"""The docs' gallery: public recordings of real robots through the command line, their reports as pictures and tables.

    python benchmarks/gallery.py --runs FOLDER                # runs what is not there yet, then writes docs/gallery.md
    python benchmarks/gallery.py --runs FOLDER --only tx40    # these alone are run

Recordings are read from `$FIGAROH_JAX_DATA`; none of them is copied into the docs, which hold figures and pictures of
results with their sources.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
DATA = Path(os.environ.get("FIGAROH_JAX_DATA", ROOT.parent / "shared" / "data"))
BOTH = ["base_frame", "tool_frame"]
TIAGO = ["torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8))]
TALOS = ["torso_1_joint", "torso_2_joint", *(f"arm_left_{k}_joint" for k in range(1, 8))]


class Robot(NamedTuple):
    """A public recording: its title, where it is from, what was measured, and the task that is run on it."""

    title: str
    source: str
    licence: str
    measured: str
    task: Callable[[Path], dict[str, Any]]
    remark: str = ""  # what is known of the robot beside the recording


def hidden(name: str) -> Callable[[Path], dict[str, Any]]:
    """The task that `hide_in_real` hides effects in, here as it is."""

    def write(folder: Path) -> dict[str, Any]:
        from benchmarks.hide_in_real.generate import twin_of
        from benchmarks.hide_in_real.recordings import SETS

        return twin_of(folder, SETS[name]())["task"] | {"robot": _robot(name, SETS[name]())}

    return write


def _robot(name: str, real: Any) -> dict[str, Any]:
    return real.task["robot"] | {"model": f"{name}/robot.urdf"}


def postures(folder: str, model: str, file: str, entry: dict[str, Any], joints: list[str] | None = None):
    def write(_: Path) -> dict[str, Any]:
        robot = {"model": str(DATA / folder / model)} | ({"joints": joints} if joints else {})
        return {"robot": robot, "data": [{"file": str(DATA / folder / file)} | entry]}

    return write


def measured(kind: str, values: Any, base: str, tool: str) -> dict[str, Any]:
    return {kind: values, "base_frame": base, "tool_frame": tool, "unknown": BOTH}


ROBOTS = {
    "tx40": Robot(
        "Stäubli TX40",
        "https://github.com/thanhndv212/figaroh-plus",
        "Apache-2.0",
        "motor angles and currents at 5 kHz, 9 s, one motion; nothing is held out but stretches of it",
        hidden("tx40"),
        "The gears couple joints 5 and 6, which the task says; the links' inertials of the file are hardly believed"
        " (`trust: 1.0`). The file holds no rotors, which published identifications of this recording have: that they"
        " are named is plausible. A power law stands for friction that grows less than in proportion to the speed;"
        " what law it is at low speed, 9 s do not tell.",
    ),
    "ur10e": Robot(
        "Universal Robots UR10e",
        "https://github.com/shamilmamedov/dynamic_calibration",
        "none stated: figures alone",
        "motor currents and positions at 100 Hz, two motions fitted, one held out; constants as published",
        hidden("ur10e"),
        "Rotors of the wrist are named after the large causes and gain little: they may stand for what the constants of"
        " the currents or the inertials of the URDF have wrong. The power law's numbers are hardly known: the data do"
        " not tell how much of it is viscous friction. Rest at standstill is friction that holds.",
    ),
    "panda": Robot(
        "Franka Emika Panda",
        "https://github.com/marcocognetti/FrankaEmikaPandaDynModel",
        "GPL-3.0",
        "torque sensors at the joints at 1 kHz; 15 s fitted, 6 s held out",
        hidden("panda"),
        "The simulation is within 1.2 % before anything is named, but not within the noise: what was found lowers the"
        " error of the last 6 s at all joints. None of it can be named: the amplitude of a spring at joint 6 varies"
        " with the motion, and a gain at joint 5 is not significant on held-out data.",
    ),
    "kuka": Robot(
        "KUKA LWR4+",
        "https://github.com/kjyv/FloBaRoID",
        "LGPL-3.0",
        "torque sensors at the joints at 200 Hz; one motion twice, another held out",
        hidden("kuka"),
        "What is named is position-dependent torque of unknown origin: it predicts the motion that was held out, but"
        " the names are not vouched for. Offsets of the torque sensors differ between the motions: that is the rest at"
        " joint 0.",
    ),
    "tiago": Robot(
        "PAL TIAGo, arm_1 to arm_4",
        "https://github.com/thanhndv212/figaroh-plus",
        "Apache-2.0",
        "motor currents at 100 Hz; the first 70 % fitted, the rest held out",
        hidden("tiago"),
        "The recording was made with a gripper that the URDF does not have: it is not named, for arm_4's"
        " own inertials are believed no better than that.",
    ),
    "dfki_simple_pendulum": Robot(
        "DFKI simple pendulum",
        "https://github.com/dfki-ric-underactuated-lab/torque_limited_simple_pendulum",
        "BSD-3-Clause",
        "one quasi-direct drive, torque from its current at 500 Hz; two motions fitted, one held out",
        hidden("dfki_simple_pendulum"),
        "The drive's friction is half of its torque and follows no law of the catalogue within the noise.",
    ),
    "dfki_double_pendulum": Robot(
        "DFKI double pendulum",
        "https://github.com/dfki-ric-underactuated-lab/double_pendulum",
        "BSD-3-Clause",
        "two quasi-direct drives, torque from their currents at 500 Hz; five motions fitted, one held out",
        hidden("dfki_double_pendulum"),
        "Torques are small against friction, and the drives ring at 4.8 Hz: no effect is named, and that is right as"
        " far as anybody knows.",
    ),
    "talos": Robot(
        "PAL TALOS, left arm",
        "https://github.com/thanhndv212/figaroh-plus",
        "Apache-2.0",
        "one point of the gripper by motion capture, 61 postures",
        postures(
            "talos_contact",
            "talos_full_v2.urdf",
            "talos_left_arm_02_10_contact.csv",
            {
                "position": TALOS,
                "measurement": measured("position", ["x1", "y1", "z1"], "base_link", "gripper_left_base_link"),
            },
            TALOS,
        ),
        "Offsets of the joints alone leave 1.6 mm held out; which part is geometry of links and which offsets, 61"
        " postures of one point do not tell apart, so the names at the shoulder are one reading of several.",
    ),
    "tiago_mocap": Robot(
        "PAL TIAGo, torso and arm",
        "https://github.com/thanhndv212/figaroh-plus",
        "Apache-2.0",
        "one marker on the hand by motion capture, 35 postures",
        postures(
            "tiago_mocap",
            "tiago_no_hand.urdf",
            "qualysis_base_hand_calibration.csv",
            {
                "position": TIAGO,
                "measurement": measured("position", ["x1", "y1", "z1"], "base_footprint", "arm_7_link"),
            },
            TIAGO,
        ),
        "Row 9 is a known bad measurement of this file. The rest is larger than the device's noise.",
    ),
    "irb120": Robot(
        "ABB IRB 120",
        "https://github.com/drliaowu/Minimal_Robot_Calibration_Using_Position",
        "none stated: figures alone",
        "three points of the tool by a measuring device, 36 postures",
        postures(
            "irb120_wu2015",
            "irb120.urdf",
            "irb120_wu.npz",
            {
                "position": "cali_q_deg",
                "units": {"position": "deg", "measurement": "mm"},
                "measurement": measured("position", "cali_xyz_mm", "base_link", "tool0"),
            },
        ),
        "The offsets agree with those of the published analysis: -0.0241, -0.0073, -0.0374, -0.0194 rad at joints 2"
        " to 5.",
    ),
}


def run(name: str, folder: Path) -> None:
    """Write the task of a robot and run the command on it."""
    place = folder / name
    place.mkdir(parents=True, exist_ok=True)
    (place / "task.yaml").write_text(yaml.safe_dump(ROBOTS[name].task(place), sort_keys=False))
    started = time.perf_counter()
    command = [sys.executable, "-m", "figaroh_jax", "diagnose", str(place / "task.yaml"), "--out", str(place / "run")]
    done = subprocess.run([*command, "--quiet"], capture_output=True, text=True)
    said = done.stdout if done.returncode == 0 else done.stderr
    print(f"{name}: status {done.returncode}, {time.perf_counter() - started:.0f} s\n{said[-1500:]}", flush=True)


def shown(name: str, folder: Path) -> str:
    """A robot's part of the page."""
    from figaroh_jax.reporting import wording

    robot, answer = ROBOTS[name], json.loads((folder / name / "run" / "answer.json").read_text())
    lines = [f"## {robot.title}", "", f"[Source]({robot.source}), licence {robot.licence}. Measured: {robot.measured}."]
    lines += [robot.remark] if robot.remark else []
    made = json.loads((folder / name / "run" / "provenance.json").read_text())
    lines += [f"Made on {made['time'][:10]}."]
    lines += ["", f"![The report of {robot.title}](images/gallery_{name}.png)", "", f"**{answer['verdict']}**"]
    lines += ["", "| cause | at | size ± 95 % | held-out error |", "|---|---|---|---|"] if answer["causes"] else []
    for cause in answer["causes"]:
        sizes = [f"{key.replace('_', ' ')} {_interval(p)}" for key, p in cause["parameters"].items() if _known(p)]
        if cause["effect"] == "outlier":
            sizes = [f"row {one['row']} (from 0)" for one in _result(folder / name / "run").get("outliers", [])]
        gain = cause["gain"]
        both = [gain[f"holdout_{key}"] for key in ("before", "after")]
        error = "–" if None in both else " → ".join(wording.error(value, gain["unit"]) for value in both)
        others = ", ".join(
            f"{wording.effect_title(o['effect'])} at {' + '.join(o['at'])}" for o in cause["ambiguous_with"]
        )
        title = wording.effect_title(cause["effect"]) + (f" (or {others})" if others else "")
        lines.append(
            f"| {title} | {' + '.join(cause['at']) or 'the robot'} | {'; '.join(sizes[:4]) or '–'} | {error} |"
        )
    of = "of the error of the frames alone" if _result(folder / name / "run") else "at the joints, of their torque"
    return "\n".join([*lines, "", *_left(answer, of), ""])


def _known(parameter: dict[str, Any]) -> bool:
    """Whether the interval of a size leaves zero out: single numbers of a geometry often are known together only."""
    return parameter["std"] is None or abs(parameter["value"]) > 1.96 * parameter["std"]


def _result(folder: Path) -> dict[str, Any]:
    path = folder / "result.json"
    return json.loads(path.read_text()) if path.is_file() else {}


def _interval(parameter: dict[str, Any]) -> str:
    from figaroh_jax.reporting import wording
    from figaroh_jax.results import Estimate

    std = np.inf if parameter["std"] is None else parameter["std"]
    return wording.interval(Estimate(parameter["value"], std, parameter["unit"]))


def _left(answer: dict[str, Any], of: str) -> list[str]:
    """What stays without a name, as the answer says it."""
    rest = answer.get("rest") or {}
    sizes = [f"{100 * x:.1f} %" for x in rest.get("relative", [])]
    lines = [f"Left {of}: {', '.join(sizes)}."] if sizes else []
    parts = sorted(rest.get("parts", []), key=lambda part: -part["share"])[:3]
    if parts:
        said = "; ".join(f"{part['kind']} at {', '.join(part['at'])} ({100 * part['share']:.0f} %)" for part in parts)
        lines.append(f"It varies with {said}.")
    return lines


def page(folder: Path, docs: Path, names: list[str]) -> None:
    import browser

    head, marker, _ = (docs / "gallery.md").read_text("utf-8").partition("<!-- runs -->")
    assert marker, "docs/gallery.md has lost its <!-- runs --> line"
    text = "\n".join(shown(name, folder) for name in names)
    (docs / "gallery.md").write_text(f"{head}{marker}\n\n{text}", encoding="utf-8")
    with tempfile.TemporaryDirectory() as profile, browser.page(Path(profile)) as tab:
        for name in names:
            tab.open((folder / name / "run" / "report.html").resolve(), 1000, 640, dark=False)
            time.sleep(1.0)
            tab.screenshot(docs / "images" / f"gallery_{name}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--runs", type=Path, required=True, help="folder of the runs; finished ones are kept")
    parser.add_argument("--only", nargs="+", choices=[*ROBOTS], default=[*ROBOTS])
    parser.add_argument("--docs", type=Path, default=ROOT / "docs")
    asked = parser.parse_args()
    for name in asked.only:
        if not (asked.runs / name / "run" / "answer.json").is_file():
            run(name, asked.runs)
    page(asked.runs, asked.docs, [n for n in ROBOTS if (asked.runs / n / "run" / "answer.json").is_file()])


if __name__ == "__main__":
    main()
