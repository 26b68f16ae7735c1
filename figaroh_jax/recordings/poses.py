"""Recordings of postures with a measurement at each: read, checked and brought to m, rad and one shape per kind.

| kind | `values` |
|---|---|
| `position` | points (postures, markers, 3) in the device's frame, m |
| `pose` | poses (postures, 4, 4) of the marker in the device's frame; a camera's board too, as the mount asks |
| `plane`, `socket` | number (postures,) of what the tool point touches |
| `own` | (postures, ...) whatever `device`, a measuring device of your own, takes; in Python alone |

A row, a marker or an orientation that was not measured is NaN (-1 for a number).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..rigid.chain import chain_between
from ..rigid.model import RobotModel
from . import dataset
from .devices import Device
from .reading import read_table
from .tables import Source, Table

if TYPE_CHECKING:
    from ..formats.config import Load, Measurement, RecordingEntry, Task

__all__ = ["PoseRecording", "points", "poses", "read_pose_recordings", "seen_from_board", "whole_numbers"]

_LOOSE = 1e-2  # how far a rotation or a quaternion may be off by rounding
_MOST_ANGLE = 6.5  # rad, of an orientation: a turn and a little


@dataclass(frozen=True, eq=False, repr=False)
class PoseRecording:
    """Postures in the order in which they were measured, and what the device saw at each."""

    name: str
    file: Path | dataset.Memory
    time: Float[np.ndarray, " samples"]  # s; counted where the file has no clock
    position: Float[np.ndarray, "samples nv"]  # rad or m
    kind: Literal["pose", "position", "plane", "socket", "own"]
    values: np.ndarray
    base_frame: str
    tool_frame: str
    unknown: tuple[str, ...] = ()
    accuracy: tuple[float | None, float | None] = (None, None)  # m, rad
    distance: float | None = None  # m, between two sockets
    load: Load | None = None
    role: Literal["fit", "holdout"] = "fit"
    notes: tuple[str, ...] = ()
    device: Device | None = None  # of kind "own"
    carried: bool = False  # poses of a camera that the robot carries: told by how it sees what stands in the origin
    apart: bool = False  # its unknown frames are its own, whichever device others have

    def __repr__(self) -> str:
        way = f"{self.kind} {np.shape(self.values)} from {self.base_frame} to {self.tool_frame}"
        unknown = f"; unknown: {', '.join(self.unknown)}" if self.unknown else ""
        return f"PoseRecording '{self.name}' ({self.role}): {len(self.position)} postures; {way}{unknown}"


def read_pose_recordings(task: Task, model: RobotModel) -> tuple[PoseRecording, ...]:
    """Read every recording of a task whose recordings hold a `measurement`, in the task's order.

    Raises `InputError` that names file, key, row or column: a recording without measurement, arrays of the wrong shape,
    numbers that are neither NaN nor finite, matrices that are no poses, frames that the model does not have.
    """
    drive = dataset.Drive(task, model)
    return tuple(_read(task, entry, f"data[{k}]", model, drive) for k, entry in enumerate(task.data))


def _read(task: Task, entry: RecordingEntry, key: str, model: RobotModel, drive: dataset.Drive) -> PoseRecording:
    if entry.measurement is None:
        raise InputError(
            f"{task.file}: {key} has no `measurement`: calibration needs what was measured at each posture"
        )
    table = read_table(entry.file, f"{key}.file", Source(entry.format, entry.topic, entry.episode))
    factors = dataset.unit_factors(entry.units.position, drive.position is not None, model)
    position = drive.joint_motion(dataset.joint_columns(table, entry.position, model, f"{key}.position") * factors)
    position = position + drive.offset
    measurement = entry.measurement
    base, tool, unknown, notes = _frames(task, measurement, f"{key}.measurement", model)
    scale = 1e-3 if entry.units.measurement == "mm" else 1.0
    kind, values = _values(table, entry, f"{key}.measurement", len(position), scale)
    accuracy = measurement.accuracy
    return PoseRecording(
        name=entry.name,
        file=entry.place,
        time=_time(table, entry, key, len(position)),
        position=position,
        kind=kind,
        values=values,
        base_frame=base,
        tool_frame=tool,
        unknown=unknown,
        accuracy=(accuracy.position, accuracy.orientation),
        distance=measurement.distance,
        load=entry.load,
        role=entry.role,
        notes=notes,
        carried=carried(measurement.kind, measurement.mount),
    )


def carried(kind: str, mount: str | None) -> bool:
    """Whether a measurement is that of a camera which the robot carries."""
    return kind == "camera" and mount == "hand"


def _frames(task: Task, measurement: Measurement, key: str, model: RobotModel):
    """Base frame, tool frame, what is unknown, and notes."""
    if measurement.tool_frame is None:
        raise InputError(f"{task.file}: {key}.tool_frame is missing: which frame of the model is measured?")
    base = measurement.base_frame or next((f.name for f in model.frames if f.parent < 0), model.frames[0].name)
    for name, frame in (("base_frame", base), ("tool_frame", measurement.tool_frame)):
        try:
            model.frame_index(frame)
        except InputError as error:
            raise InputError(f"{task.file}: {key}.{name}: {error}") from None
    try:
        chain_between(model, base, measurement.tool_frame)
    except InputError as error:
        raise InputError(f"{task.file}: {key}: {error}{_swapped(model, base, measurement.tool_frame)}") from None
    unknown, notes = tuple(dict.fromkeys(measurement.unknown)), ()
    if measurement.kind in ("plane", "socket") and "base_frame" in unknown:
        unknown = tuple(name for name in unknown if name != "base_frame")
        notes = (f"{key}: touching a {measurement.kind} at an unknown place shows no base frame; it is left as it is",)
    return base, measurement.tool_frame, unknown, notes


def _swapped(model: RobotModel, base: str, tool: str) -> str:
    """Whether the two frames would do the other way round, as a question."""
    try:
        chain_between(model, tool, base)
    except InputError:
        return ""
    return "; are the two swapped?"


def _time(table: Table, entry: RecordingEntry, key: str, samples: int) -> Float[np.ndarray, " samples"]:
    if entry.time is None:
        return np.arange(samples, dtype=float) / (entry.rate or 1.0)
    return dataset.read_time(table, entry, key, samples)


def _values(table: Table, entry: RecordingEntry, key: str, samples: int, scale: float):
    measurement = entry.measurement
    assert measurement is not None
    kind = measurement.kind
    source = getattr(measurement, kind)
    where = f"{key}.{kind}"
    if kind in ("plane", "socket"):
        return kind, _numbers(table, source, where, samples)
    values = _array(table, source, where)
    if len(values) != samples:
        wanted = "(postures, 3)" if kind == "position" else "(postures, 4, 4), (postures, 7) or (postures, 6)"
        shape, stacked = np.shape(values), kind != "position" and len(values) == 4 * samples
        why = ": its matrices are stacked below each other" if stacked else ""
        why = why or (": the postures stand on its last axis" if shape[-1] in (samples, 4 * samples) else "")
        raise InputError(
            f"{table.file}: {where} has {len(values)} rows, but position has {samples}{why}"
            + (f"; its shape is {shape}, expected is {wanted}" if why else "")
        )
    if kind == "position":
        return kind, points(values, table, where) * scale
    if measurement.orientation is not None or values.shape[1:] == (6,):
        degrees = entry.units.orientation == "deg"
        values = _with_quaternions(values, measurement.orientation, degrees, table, where)
    found = poses(values, table, where)
    found[:, :3, 3] *= scale
    return "pose", seen_from_board(found, table, where) if carried(kind, measurement.mount) else found


def seen_from_board(
    found: Float[np.ndarray, "postures 4 4"], table: Any, key: str
) -> Float[np.ndarray, "postures 4 4"]:
    """Poses of a camera seen from the board, which stands still; NaN where the board's orientation was not measured."""
    if np.isfinite(found[:, :3, 3]).all(axis=1).any() and not np.isfinite(found).all(axis=(1, 2)).any():
        raise InputError(
            f"{table.file}: {key}: no orientation of the board was measured, which a camera in the hand needs; for a"
            " point that it sees write a device of your own (examples/own_device.py)"
        )
    return np.linalg.inv(found)


def _array(table: Table, source: str | tuple[str, ...], key: str) -> np.ndarray:
    """An array, a list of columns or the columns that begin with a prefix, in their order in the file."""
    if isinstance(source, str) and source in table.names:
        return table.read(source)
    names = list(source) if not isinstance(source, str) else [n for n in table.names if n.startswith(source)]
    if not names:
        return table.vector(str(source), key)  # raises with the nearest name
    return np.stack([table.vector(name, key) for name in names], axis=1)


def points(values: np.ndarray, table: Any, key: str) -> np.ndarray:
    """Points (n, markers, 3), checked."""
    if values.ndim == 2 and values.shape[1] % 3 == 0 and values.shape[1]:
        values = values.reshape(len(values), -1, 3)
    if values.ndim != 3 or values.shape[2] != 3:
        raise InputError(
            f"{table.file}: {key} has shape {values.shape}, expected (postures, 3) or (postures, markers, 3)"
        )
    _whole_or_missing(values.reshape(len(values), -1, 3), table, key, "point")
    if not np.isfinite(values).all(axis=2).any(axis=0).all():
        marker = int(np.argmin(np.isfinite(values).all(axis=2).any(axis=0)))
        raise InputError(f"{table.file}: {key}: marker {marker} (from 0) was not measured in any posture")
    return values


def _with_quaternions(
    values: np.ndarray, orientation: str | None, degrees: bool, table: Table, key: str
) -> Float[np.ndarray, "postures 7"]:
    """Poses x y z qx qy qz qw of rows whose orientation is written in another way (`Measurement.orientation`)."""
    from scipy.spatial.transform import Rotation

    angles = orientation in ("rpy", "rotvec")
    if values.ndim != 2 or values.shape[1] not in (6, 7):
        raise InputError(f"{table.file}: {key} has shape {values.shape}; matrices need no `orientation`")
    if values.shape[1] == 6 and not angles:
        raise InputError(
            f"{table.file}: {key} has six numbers a posture: add `orientation: rpy` (roll, pitch and yaw about fixed x,"
            " y and z) or `orientation: rotvec` (axis times angle) to the measurement, and units: {orientation: deg}"
            " where they are degrees"
        )
    if values.shape[1] == 7 and angles:
        raise InputError(f"{table.file}: {key} has seven numbers a posture; `orientation: {orientation}` has six")
    if values.shape[1] == 7:
        return values[:, [0, 1, 2, 4, 5, 6, 3]] if orientation == "wxyz" else values
    _whole_or_missing(values[:, None, 3:], table, key, "orientation")
    seen = np.isfinite(values[:, 3:]).all(axis=1)
    turned = np.radians(values[seen, 3:]) if degrees else values[seen, 3:]
    if np.abs(turned).max(initial=0.0) > _MOST_ANGLE:
        raise InputError(
            f"{table.file}: {key} has angles up to {np.abs(values[seen, 3:]).max():.4g} rad: are they degrees? add"
            " units: {orientation: deg}"
        )
    found = np.full((len(values), 7), np.nan)
    found[:, :3] = values[:, :3]
    if len(turned):
        rotation = Rotation.from_euler("xyz", turned) if orientation == "rpy" else Rotation.from_rotvec(turned)
        found[seen, 3:] = rotation.as_quat()
    return found


def _whole_or_missing(values: np.ndarray, table: Any, key: str, what: str) -> None:
    """Refuse infinite numbers, and NaN in a part of a point or a rotation."""
    missing = np.isnan(values)
    wrong = np.isinf(values).any(axis=2) | (missing.any(axis=2) & ~missing.all(axis=2))
    if wrong.any():
        row, part = np.argwhere(wrong)[0]
        raise InputError(
            f"{table.file}: {key}, row {row} (from 0): {what} {part} is {values[row, part].tolist()};"
            f" a {what} that was not measured is NaN as a whole"
        )


def poses(values: np.ndarray, table: Any, key: str) -> np.ndarray:
    """Poses (n, 4, 4) of matrices or of x y z qx qy qz qw, checked."""
    from scipy.spatial.transform import Rotation

    if values.ndim == 2 and values.shape[1] == 16:
        values = values.reshape(-1, 4, 4)
    if values.ndim == 2 and values.shape[1] == 7:
        rotation, point = values[:, None, 3:], values[:, None, :3]
    elif values.shape[1:] == (4, 4):
        rotation, point = values[:, :3, :3].reshape(-1, 1, 9), values[:, None, :3, 3]
    else:
        raise InputError(
            f"{table.file}: {key} has shape {values.shape},"
            " expected (postures, 4, 4) or (postures, 7) as x y z qx qy qz qw"
        )
    _whole_or_missing(point, table, key, "position")
    _whole_or_missing(rotation, table, key, "orientation")
    found = np.full((len(values), 4, 4), np.nan)
    found[:, 3], found[:, :3, 3] = (0.0, 0.0, 0.0, 1.0), point[:, 0]
    seen = np.isfinite(rotation[:, 0]).all(axis=1)
    given = rotation[seen, 0]
    if given.shape[1] == 4:
        norms = np.linalg.norm(given, axis=1)
        if (norms < 1e-9).any():
            row = np.flatnonzero(seen)[np.argmax(norms < 1e-9)]
            raise InputError(f"{table.file}: {key}, row {row} (from 0): the quaternion is zero; NaN says not measured")
        off = np.abs(norms - 1.0)
        turned = Rotation.from_quat(given / norms[:, None] if len(given) else given)
        matrices = turned.as_matrix() if len(given) else np.zeros((0, 3, 3))
    else:
        given = given.reshape(-1, 3, 3)
        u, _, vt = np.linalg.svd(given)
        matrices = u @ vt
        off = np.maximum(np.abs(matrices - given).max(axis=(1, 2), initial=0.0), np.linalg.det(matrices) < 0.0)
    if np.any(off > _LOOSE):
        row = np.flatnonzero(seen)[np.argmax(off > _LOOSE)]
        what = "quaternion x y z w of length 1" if given.ndim == 2 else "rotation matrix"
        raise InputError(f"{table.file}: {key}, row {row} (from 0): the orientation is no {what}")
    if values.ndim == 3:
        _check_last_row(values, table, key)
    found[seen, :3, :3] = matrices
    return found


def _check_last_row(values: np.ndarray, table: Any, key: str) -> None:
    """`InputError` where a matrix does not end in 0 0 0 1."""
    last = values[:, 3]
    odd = np.isfinite(last).all(axis=1) & (np.abs(last - [0.0, 0.0, 0.0, 1.0]) > _LOOSE).any(axis=1)
    if odd.any():
        row = int(np.argmax(odd))
        column = np.abs(values[row, :, 3] - [0.0, 0.0, 0.0, 1.0]).max() < _LOOSE
        raise InputError(
            f"{table.file}: {key}, row {row} (from 0): the last row of the matrix is"
            f" [{', '.join(f'{x:.4g}' for x in last[row])}], expected [0, 0, 0, 1]"
            f"{': the matrices are transposed' if column else ''}"
        )


def _numbers(table: Table, source: str | tuple[str, ...] | None, key: str, samples: int) -> np.ndarray:
    if source is None:
        return np.zeros(samples, int)
    if not isinstance(source, str):
        if len(source) != 1:
            raise InputError(f"{table.file}: {key} names {len(source)} columns, expected one of numbers")
        source = source[0]
    values = table.vector(source, key)
    if len(values) != samples:
        raise InputError(f"{table.file}: {key} has {len(values)} rows, but position has {samples}")
    return whole_numbers(values, table, key)


def whole_numbers(values: np.ndarray, table: Any, key: str) -> np.ndarray:
    """Numbers of what was touched, -1 where nothing was; raises `InputError` where they are no whole numbers."""
    missing = np.isnan(values)
    wrong = ~missing & (np.isinf(values) | (np.where(missing, 0.0, values) % 1 != 0))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(f"{table.file}: {key}, row {row} (from 0): {values[row]} is not a whole number")
    return np.where(missing, -1, values).astype(int)
