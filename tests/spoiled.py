"""Recordings spoiled as users spoil them, and what has to be said of each.

A `Base` is a right recording with its robot; `KINDS` holds, for each way of being wrong, a function that spoils the
arrays and the keys of the entry, and the pattern that the message must match to be the right advice.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from figaroh_jax.errors import InputError


@dataclass(frozen=True)
class Base:
    """A right recording: arrays t, q, dq, tau (or points `p` at postures) and the keys of its task."""

    name: str
    robot: dict[str, Any]
    arrays: dict[str, np.ndarray]
    entry: dict[str, Any]
    beside: tuple[str, ...] = ()  # other recordings of the same task
    pair: tuple[int, int] = (1, 2)  # joints that carry something, neighbours
    heavy: int = 1

    @property
    def rate(self) -> float:
        return (len(self.arrays["t"]) - 1) / float(self.arrays["t"][-1] - self.arrays["t"][0])


Arrays = dict[str, np.ndarray]
Entry = dict[str, Any]
Spoil = Callable[[Base, Arrays, Entry], None]


def said(base: Base, spoil: Spoil | None, folder: Path) -> tuple[str, str]:
    """What the check says of a recording: "refused", "warned" or "silent", and its text."""
    from figaroh_jax.formats.config import load_task
    from figaroh_jax.formats.robotfile import load_robot
    from figaroh_jax.recordings.checks import check_recordings
    from figaroh_jax.recordings.dataset import read_recordings
    from figaroh_jax.recordings.poses import read_pose_recordings
    from figaroh_jax.recordings.posture_checks import check_pose_recordings

    arrays, entry = {k: np.array(v) for k, v in base.arrays.items()}, dict(base.entry)
    if spoil is not None:
        spoil(base, arrays, entry)
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{base.name}.npz"
    np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    task_file = folder / "task.yaml"
    data = [{"file": str(path), **entry} for path in (file, *base.beside)]
    task_file.write_text(json.dumps({"robot": base.robot, "data": data}))
    try:
        task = load_task(task_file)
        model = load_robot(task)
        if "measurement" in entry:
            warnings = check_pose_recordings(task, model, read_pose_recordings(task, model))
        else:
            warnings = check_recordings(task, model, read_recordings(task, model))
    except InputError as error:
        return "refused", str(error)
    return ("warned", "\n".join(warnings)) if warnings else ("silent", "")


def _with(key: str, change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    def spoil(base: Base, arrays: Arrays, entry: Entry) -> None:
        arrays[key] = change(arrays[key])

    return spoil


def _swapped(*keys: str) -> Spoil:
    def spoil(base: Base, arrays: Arrays, entry: Entry) -> None:
        order = list(range(arrays["q"].shape[1]))
        i, j = base.pair
        order[i], order[j] = j, i
        for key in keys:
            if key in arrays:
                arrays[key] = arrays[key][:, order]

    return spoil


def _clock(factor: float) -> Spoil:
    def spoil(base: Base, arrays: Arrays, entry: Entry) -> None:
        entry.pop("velocity", None)
        arrays["t"] = arrays["t"] * factor

    return spoil


def _stamps(factor: float) -> Spoil:
    def spoil(base: Base, arrays: Arrays, entry: Entry) -> None:
        stamps = (arrays["t"] - arrays["t"][0]) * factor
        arrays["t"] = np.round(stamps).astype(np.int64) if np.diff(stamps).min() >= 1 else stamps

    return spoil


def _joint(key: str, change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    def spoil(base: Base, arrays: Arrays, entry: Entry) -> None:
        entry.pop("velocity", None)
        arrays[key][:, base.heavy] = change(arrays[key][:, base.heavy])

    return spoil


def _row(key: str, value: float) -> Spoil:
    def spoil(base: Base, arrays: Arrays, entry: Entry) -> None:
        arrays[key][len(arrays[key]) // 2, base.heavy] = value

    return spoil


def _units(**units: str) -> Spoil:
    def spoil(base: Base, arrays: Arrays, entry: Entry) -> None:
        entry["units"] = units

    return spoil


def _held(times: int) -> Spoil:
    def spoil(base: Base, arrays: Arrays, entry: Entry) -> None:
        rows = np.arange(len(arrays["q"])) // times * times
        for key in ("q", "dq", "tau"):
            if key in arrays:
                arrays[key] = arrays[key][rows]

    return spoil


def _twice(base: Base, arrays: Arrays, entry: Entry) -> None:
    """Three rows are there twice, and no stamps say so."""
    n = len(arrays["q"])
    rows = np.sort(np.append(np.arange(n), [n // 4, n // 2, 3 * n // 4]))
    for key in ("q", "dq", "tau"):
        if key in arrays:
            arrays[key] = arrays[key][rows]
    entry["rate"] = float((n - 1) / np.ptp(arrays["t"]))
    del entry["time"]


def _coarse(base: Base, arrays: Arrays, entry: Entry) -> None:
    step = np.ptp(arrays["q"], axis=0).max() / 15
    arrays["q"] = np.round(arrays["q"] / step) * step
    entry.pop("velocity", None)


def _clipped(base: Base, arrays: Arrays, entry: Entry) -> None:
    column = arrays["tau"][:, base.heavy]
    arrays["tau"][:, base.heavy] = np.minimum(column, np.percentile(column, 85))


def _wrapped(base: Base, arrays: Arrays, entry: Entry) -> None:
    q = arrays["q"][:, base.heavy]
    entry.pop("velocity", None)
    middle = np.median(q)
    arrays["q"][:, base.heavy] = np.where(q > middle, q - 2 * np.pi, q)


def _still(base: Base, arrays: Arrays, entry: Entry) -> None:
    rng = np.random.default_rng(0)
    arrays["q"] = np.median(arrays["q"], axis=0) + 1e-5 * rng.normal(size=arrays["q"].shape)
    arrays["tau"] = np.median(arrays["tau"], axis=0) + 0.1 * rng.normal(size=arrays["tau"].shape)
    entry.pop("velocity", None)


def _degrees_with_velocity(base: Base, arrays: Arrays, entry: Entry) -> None:
    arrays["dq"] = np.rad2deg(_rates(arrays))
    entry["velocity"] = "dq"


def _rates(arrays: Arrays) -> np.ndarray:
    return arrays["dq"] if "dq" in arrays else np.gradient(arrays["q"], arrays["t"], axis=0)


def _negative_velocity(base: Base, arrays: Arrays, entry: Entry) -> None:
    arrays["dq"] = -_rates(arrays)
    entry["velocity"] = "dq"


def _half_rate_with_velocity(base: Base, arrays: Arrays, entry: Entry) -> None:
    arrays["dq"] = _rates(arrays)
    entry["velocity"] = "dq"
    entry.pop("time")
    entry["rate"] = base.rate / 2


def _lost(base: Base, arrays: Arrays, entry: Entry) -> None:
    rows = np.linspace(0.1, 0.9, 7) * len(arrays["q"])
    arrays["q"][rows.astype(int)] = 0.0
    arrays["tau"][rows.astype(int)] = 0.0


def _other_motion(base: Base, arrays: Arrays, entry: Entry) -> None:
    arrays["tau"] = np.roll(arrays["tau"][::-1], len(arrays["tau"]) // 3, axis=0)


def _without_gravity(base: Base, arrays: Arrays, entry: Entry) -> None:
    """Torque beside what the controller's gravity compensation gives: what such a controller logs as its output."""
    from figaroh_jax.formats.robotfile import read_robot
    from figaroh_jax.recordings.likeness import rigid_torque, sampled

    model = read_robot(base.robot["model"], base.robot.get("joints"))
    read = sampled(arrays["t"], arrays["q"], arrays["tau"])
    assert read is not None
    slow = read.scaled(time=1e6)
    rows = np.linspace(0, len(arrays["q"]) - 1, len(slow.position)).astype(int)
    gravity = rigid_torque(model, slow)
    for j in range(gravity.shape[1]):
        arrays["tau"][:, j] -= np.interp(np.arange(len(arrays["q"])), rows, gravity[:, j])


def _motor(base: Base, arrays: Arrays, entry: Entry) -> None:
    arrays["q"], arrays["tau"] = arrays["q"] * 101.0, arrays["tau"] / 101.0
    entry.pop("velocity", None)


def _nan(base: Base, arrays: Arrays, entry: Entry) -> None:
    arrays["q"][17, base.heavy] = np.nan


def _back(base: Base, arrays: Arrays, entry: Entry) -> None:
    arrays["t"][40] = arrays["t"][38]


_CLOCK = r"clock looks wrong|right rate|1?\.?\d* Hz instead of"
_DEG = r"\{position: deg"
KINDS: dict[str, tuple[Spoil, str]] = {
    "degrees read as rad": (_with("q", np.rad2deg), _DEG),
    "rad read as degrees": (_units(position="deg"), r"remove units|velocity.*degrees|in rad"),
    "mm on a revolute arm": (_units(position="mm"), r"every joint of the robot turns"),
    "torque columns swapped": (_swapped("tau"), r"torque columns are in a different order"),
    "position columns swapped": (_swapped("q"), r"position.*swapped|velocity of .* does not follow|limits"),
    "all columns of two joints swapped": (_swapped("q", "dq", "tau"), r"swapped|limits|order"),
    "sign of one torque": (_joint("tau", np.negative), r"torque of .* has the opposite sign"),
    "sign of all torques": (_with("tau", np.negative), r"every joint has the opposite sign"),
    "sign of one position": (_joint("q", np.negative), r"opposite sign|limits|sign or another order"),
    "half the rate": (_clock(2.0), _CLOCK),
    "twice the rate": (_clock(0.5), _CLOCK),
    "half the rate, velocity logged": (_half_rate_with_velocity, _CLOCK),
    "stamps in ms": (_stamps(1e3), r"\{time: ms\}"),
    "stamps in us": (_stamps(1e6), r"\{time: us\}"),
    "stamps in ns": (_stamps(1e9), r"\{time: ns\}"),
    "1e10 N m in one row": (_row("tau", 1e10), r"torque of \S+ reads 1e\+10 .* in row"),
    "1e10 N m everywhere": (_with("tau", lambda x: x * 1e10), r"times the model's effort limit"),
    "torque in mN m": (_with("tau", lambda x: x * 1e3), r"mN m"),
    "torque as a share of the rated one": (_with("tau", lambda x: x * 0.01), r"rated torque|constant"),
    "torque all zero": (_with("tau", np.zeros_like), r"torque is zero at every joint"),
    "torque of one joint constant": (_joint("tau", lambda x: np.full_like(x, 2.0)), r"never changes"),
    "torque of another motion": (_other_motion, r"does not follow|does not belong|opposite sign"),
    "torque without gravity": (_without_gravity, r"does not follow.*gravity|opposite sign"),
    "torque clipped": (_clipped, r"stays at .* limit"),
    "one spike of 1e3 rad": (_row("q", 1e3), r"jumps by .* in row"),
    "lost packets as zeros": (_lost, r"zero at every joint in row|jumps by .* in row"),
    "encoder wraps around": (_wrapped, r"unwrap|limits"),
    "three rows twice": (_twice, r"in row \d+ \(from 0\) and 2 more are those of the row before"),
    "every row four times": (_held(4), r"every row appears 4 times"),
    "coarse position": (_coarse, r"comes in steps"),
    "never moves": (_still, r"no joint moves"),
    "motor side": (_motor, r"motor side|transmission.position"),
    "velocity in degrees": (_degrees_with_velocity, r"deg/s"),
    "velocity negated": (_negative_velocity, r"velocity of .* opposite sign"),
    "NaN in a position": (_nan, r"nan in row 17"),
    "stamps go back": (_back, r"goes back|repeats"),
}


def _points_mm(base: Base, arrays: Arrays, entry: Entry) -> None:
    if arrays["p"].ndim == 3:
        arrays["p"][:, :3, 3] *= 1e3
    else:
        arrays["p"] = arrays["p"] * 1e3


def _same(base: Base, arrays: Arrays, entry: Entry) -> None:
    arrays["q"][:] = arrays["q"][0]


POSTURES: dict[str, tuple[Spoil, str]] = {
    "postures in degrees": (_with("q", np.rad2deg), _DEG),
    "measurement in mm": (_points_mm, r"measurement: mm"),
    "columns of postures swapped": (_swapped("q"), r"swapped|limits"),
    "sign of one posture column": (_joint("q", np.negative), r"opposite sign|limits"),
    "one posture again and again": (_same, r"every posture is the same"),
}
