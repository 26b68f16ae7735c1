"""The words of a draft: what it assumed, and the text of the task file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..rigid.model import RobotModel, prismatic
from .draft_columns import Columns
from .likeness import rigid_torque, sampled

__all__ = ["baseline_said", "clock_said", "locked_said", "place_said", "task_text", "unit_said"]


def clock_said(reads: Sequence[Columns]) -> Iterator[str]:
    """The rate, the stamps' unit and the length of each recording."""
    for read in reads:
        rate = (len(read.time) - 1) / (read.time[-1] - read.time[0])
        unit = read.entry.get("units", {}).get("time", "s")
        yield f"{read.file.name}: {rate:.5g} Hz, stamps in {unit}, {read.time[-1]:.4g} s"


def locked_said(robot: RobotModel, whole: RobotModel) -> list[str]:
    """The joints that no column holds, and where the task has them stand."""
    names = [name for name in whole.joint_names if name not in robot.joint_names]
    said = "no column holds {}: locked at the neutral position; robot.posture names another one"
    return [said.format(", ".join(names))] if names else []


def unit_said(unit: str, robot: RobotModel, reads: Sequence[Columns], stated: bool) -> str:
    """The unit of the positions, and by what it is known."""
    straight = prismatic(robot)
    plain = "m" if all(straight) else "rad and m" if any(straight) else "rad"
    text = {"rad": plain, "deg": "degrees", "mm": "mm"}[unit]
    torque = " and its torque" if any(read.torque is not None for read in reads) else ""
    return f"positions are in {text}: {'as stated' if stated else f'that fits the limits of {robot.name}{torque}'}"


def baseline_said(reads: Sequence[Columns]) -> str:
    """What the task takes as given that a user may want to have named."""
    if all(read.torque is None for read in reads):
        return (
            "the gains of the drives are taken as known (actuator.gains: known); `free` has `diagnose` look for gains"
            " that are off"
        )
    return (
        "friction and a constant torque of each joint are fitted first (baseline), for sensors of torque seldom read"
        " zero: an offset is no cause then; `offset: false` has `diagnose` name it"
    )


def _geared(robot: RobotModel, reads: Sequence[Columns], signs: list[float] | None) -> bool:
    """Whether the torque shows rotors: inertia at a joint's own acceleration that the links do not have."""
    found = 0
    for read in (read for read in reads if read.torque is not None):
        motion = sampled(read.time, read.position, None if read.torque is None else read.torque * (signs or 1.0))
        if motion is None or motion.torque is None:
            continue
        nominal = rigid_torque(robot, motion)
        for j in range(robot.nv):
            v, a = motion.velocity[:, j], motion.acceleration[:, j]
            rest = motion.torque[:, j] - nominal[:, j]
            columns = np.column_stack([np.ones(len(v)), v, np.tanh(v / (0.1 * (np.sqrt(np.mean(v**2)) or 1.0))), a])
            size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
            rotor = (np.linalg.lstsq(columns / size, rest, rcond=1e-8)[0] / size)[3]
            found += rotor * np.std(a) > 0.1 * np.std(motion.torque[:, j])
    return bool(found > 0)


def _cutoff(reads: Sequence[Columns]) -> float:
    """Highest frequency at which the position's steps make less than a tenth of the acceleration (Hz)."""
    best = 20.0
    for read in reads:
        rate = (len(read.time) - 1) / read.time[-1]
        motion = sampled(read.time, read.position)
        best = min(best, 0.2 * rate)
        for j in range(read.position.shape[1]) if motion is not None else ():
            step = np.diff(np.unique(read.position[:, j]))
            size = float(np.sqrt(np.mean(motion.acceleration[:, j] ** 2))) if motion is not None else 0.0
            if len(step) and size > 0 and np.ptp(read.position[:, j]) > 0.05:
                noise = float(np.median(step)) / np.sqrt(12) * np.sqrt(2 / rate / 5) * (2 * np.pi) ** 2  # at 1 Hz
                best = min(best, max((0.1 * size / noise) ** 0.4, 2.0))
    return float(f"{best:.2g}")


def task_text(
    model: Path,
    robot: RobotModel,
    whole: RobotModel,
    reads: Sequence[Columns],
    unit: str,
    signs: list[float] | None,
    labels: Sequence[str | None],
    assumed: Sequence[str],
    drives: dict[str, Any],
    gears: Sequence[float] | None = None,
    listed: bool = False,
    folder: Path | None = None,
) -> str:
    """The task, whose paths are relative where a file lies in the `folder` of the task or below it."""
    from ..formats.export import dump_yaml

    robot_keys: dict[str, Any] = {"model": place_said(model, folder)}
    if tuple(robot.joint_names) != tuple(whole.joint_names):
        robot_keys["joints"] = list(robot.joint_names)
    data = [_entry(read, unit, label, signs is not None, folder) for read, label in zip(reads, labels, strict=True)]
    parts = ["# Drafted by `figaroh-jax new`. What was assumed:", *(f"#   {line}" for line in assumed)]
    unnamed = "the order of --joints" if listed else "the order of the model's joints"
    order = "the columns' names" if all(read.named for read in reads) else unnamed
    parts += [f"#   columns belong to joints by {order}", ""]
    parts += [dump_yaml({"robot": robot_keys}), "# `role: holdout` keeps a recording out of the fit and predicts it."]
    parts += [dump_yaml({"data": data})]
    given = {"position": gears, "torque": signs}
    sides = {key: [float(x) for x in values] for key, values in given.items() if values is not None}
    if sides:
        parts += [
            "# From what the columns hold to the joints: rad (m) and N m (N).",
            dump_yaml({"transmission": sides}),
        ]
    if drives:
        parts += ["# The loop that turns the command into torque: N m/rad.", dump_yaml({"actuator": drives})]
    if all(read.torque is None for read in reads):
        return "\n".join(part.rstrip("\n") for part in parts) + "\n"
    rotor = _geared(robot, reads, signs)
    parts += [
        "# The position's steps and rate allow this low pass (Hz).",
        dump_yaml({"preprocess": {"cutoff": _cutoff(reads)}}),
    ]
    parts += [
        "# `rotor: true` where the torque is that of geared motors; false where it is sensed behind the gears.",
        dump_yaml({"baseline": {"viscous": True, "coulomb": True, "rotor": rotor, "offset": True}}),
    ]
    return "\n".join(part.rstrip("\n") for part in parts) + "\n"


def place_said(file: Path, folder: Path | None) -> str:
    """A file as the task names it: from the task's folder where it lies in it, so that both can move; else in full."""
    whole = file.resolve()
    inside = folder is not None and whole.is_relative_to(folder.resolve())
    return whole.relative_to(folder.resolve()).as_posix() if folder is not None and inside else str(whole)


def _entry(read: Columns, unit: str, label: str | None, converted: bool, folder: Path | None) -> dict[str, Any]:
    entry = {key: value for key, value in read.entry.items() if key != "units"}
    entry["file"] = place_said(Path(entry["file"]), folder)
    units = dict(read.entry.get("units", {}))
    if unit != "rad":
        units["position"] = unit
    if read.current and (converted or read.current != "A"):
        units["torque"] = read.current
    return entry | ({"units": units} if units else {}) | ({"repeat": label} if label else {}) | {"role": "fit"}
