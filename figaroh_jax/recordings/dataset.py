"""Recordings: measured motion and torque on the joint side, in SI units, with the columns in the model's order.

Motor-side recordings are converted with the task's matrices: motor position = position @ joint position,
joint torque = torque @ motor torque; the offset is added to the joint position afterwards.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..errors import InputError, check_kind, check_switch, nearest
from ..formats.assembly import ROOT_JOINT
from ..rigid.inertia import from_com, transform
from ..rigid.model import RobotModel
from .groupmotion import position_names
from .reading import read_table
from .tables import Source, Table, leave_out, not_increasing
from .wild import bridged, without_wild_rows

if TYPE_CHECKING:
    from ..formats.config import Load, RecordingEntry, Task

__all__ = [
    "Commanded",
    "Drive",
    "Driven",
    "Memory",
    "Recording",
    "carried_body",
    "carrying",
    "check_order",
    "joint_columns",
    "named",
    "read_recordings",
    "read_time",
    "unit_factors",
    "unnamed",
]


class Memory(NamedTuple):
    """Where a recording comes from that was never a file; messages name it so."""

    name: str

    def __str__(self) -> str:
        return f"recording '{self.name}'"


Commanded = Literal["position", "velocity", "torque"]


class Driven(NamedTuple):
    """A joint that drives act at, and what they are commanded."""

    joint: str
    command: Commanded = "position"
    drives: tuple[str, ...] = ()  # names
    gain: float | None = None  # of a command that is a torque: that of the joint (N m or N) per unit


@dataclass(frozen=True, eq=False, repr=False)
class Recording:
    """One recording on the joint side: rad and N m, or m and N for prismatic joints; see `figaroh_jax.recording`.

    `time` (samples,) in s, `position` (samples, nq), `torque` and `command` (samples, nv) or None; `role` "fit" or
    "holdout", `repeat` the label of its excitation.
    """

    name: str  # stem of the file
    file: Path | Memory
    joints: tuple[str, ...]  # names of the columns of torque
    time: Float[np.ndarray, " samples"]  # s, increasing
    position: Float[np.ndarray, "samples nq"]  # with quaternions x y z w where the robot has any
    velocity: Float[np.ndarray, "samples nv"] | None = None
    torque: Float[np.ndarray, "samples nv"] | None = None
    command: Float[np.ndarray, "samples nv"] | None = None  # commanded position; of rollouts what the drives take
    load: Load | None = None  # known payload carried
    repeat: str | None = None  # recordings with one label repeat one excitation
    role: Literal["fit", "holdout"] = "fit"
    notes: tuple[str, ...] = ()
    trusted: Bool[np.ndarray, "samples nv"] | None = None  # False: torque that counts for nothing (see `cleaning`)
    stamps: Float[np.ndarray, " all"] | None = None  # s, of all rows of the file, where some are left out or lack
    clock: Float[np.ndarray, " all"] | None = None  # s, when these rows were: the same but where rows lack
    wild: str = ""  # which rows no robot made, and what was done (see `wild`)
    undriven: tuple[str, ...] = ()  # joints that nothing drives: that their torque is zero is known

    def __repr__(self) -> str:
        held = {key: getattr(self, key) for key in ("position", "velocity", "torque", "command")}
        arrays = ", ".join(f"{key} {value.shape}" for key, value in held.items() if value is not None)
        span = f"{len(self.time)} samples in {float(np.ptp(self.time)) if len(self.time) else 0.0:.4g} s"
        return f"Recording '{self.name}' ({self.role}): {span}; {arrays}; joints {', '.join(self.joints)}"


def read_recordings(
    task: Task, model: RobotModel, *, floating: bool = False, rollouts: bool = False, driven: Sequence[Driven] = ()
) -> tuple[Recording, ...]:
    """Read every recording of a task of torque level, or of `rollouts` (a command in place of torque), in its order.

    With `floating` the root may be a free joint: the position then begins with its origin and quaternion (x y z, x
    y z w), the torque with the measured wrench on it, force and torque about its origin in its own axes. Where
    fewer joints are `driven` than move, commands may have a column for each of these alone; a commanded torque keeps
    its unit (N m or N), whatever that of the positions. Raises `InputError` that names the file, the key, the row or
    the joint: missing or damaged files and columns, NaN, wrong shapes, time that does not increase, names that the
    model does not know, a fit recording without torque.

    >>> import figaroh_jax as fj
    >>> task = fj.load_task(fj.DEMO.replace("robot.urdf", "task.yaml"))
    >>> runs = fj.read_recordings(task, fj.load_robot(task))
    >>> runs[0].name, runs[0].torque.shape[1]
    ('first_1', 4)
    """
    check_kind("model", model, RobotModel, "read_recordings(task, load_robot(task))")
    check_switch("floating", floating)
    check_switch("rollouts", rollouts)
    if not hasattr(task, "preprocess"):
        raise InputError(f"task is of type {type(task).__name__}; `load_task` reads one: read_recordings(task, model)")
    _check_names(task, model, floating, "commands" if rollouts else "joint torques")
    drive = Drive(task, model)
    every = (_read(entry, f"data[{k}]", model, drive, driven) for k, entry in enumerate(task.data))
    recordings = tuple(bridged(one, model) if rollouts else without_wild_rows(one, model) for one in every)
    if rollouts:
        lacking = next((r for r in recordings if r.command is None), None)
        if lacking is not None:
            raise InputError(f"{lacking.file}: a rollout needs `command`: the drives' setpoints at each sample")
        return recordings
    lacking = next((r for r in recordings if r.role == "fit" and r.torque is None), None)
    if lacking is not None:
        raise InputError(
            f"{lacking.file}: a fit recording needs `torque` (only `role: holdout` may lack it), or every recording"
            " a `command` instead"
        )
    return recordings


def _check_names(task: Task, model: RobotModel, floating: bool, what: str) -> None:
    for joint in model.joints:
        free = floating and joint.kind == "free" and joint.parent < 0
        if joint.kind not in ("revolute", "prismatic") and not free:
            key = f"robot.root is {task.robot.root}" if joint.name == ROOT_JOINT else f"joint '{joint.name}'"
            raise InputError(
                f"{task.file}: {key}: recordings of {what} hold one column a joint, and a {joint.kind} joint has"
                " several; use root: fixed where the base stands still, and name the revolute and prismatic joints"
                " under robot.joints"
            )
    known = {*model.joint_names, *model.link_names, *(frame.name for frame in model.frames)}
    if model.nq != model.nv and task.transmission is not None:
        raise InputError(f"{task.file}: transmission: recordings of a robot with a free root are on the joint side")
    for joint in task.preprocess.gate:
        if joint not in model.joint_names:
            hint = nearest(joint, model.joint_names)
            raise InputError(f"{task.file}: preprocess.gate: no moving joint '{joint}'{hint}")
    for k, effect in enumerate(task.baseline.effects):
        for name in effect.at:
            if name not in known:
                raise InputError(f"{task.file}: baseline.effects[{k}].at: robot has no '{name}'{nearest(name, known)}")
    for k, entry in enumerate(task.data):
        frames = [frame.name for frame in model.frames]
        if entry.load is not None and entry.load.frame not in {*frames, *model.link_names}:
            place = f"{task.file}: data[{k}].load.frame"
            raise InputError(f"{place}: robot has no frame '{entry.load.frame}'{nearest(entry.load.frame, frames)}")


def unnamed(count: int) -> tuple[str, ...]:
    """Names of the columns of arrays of which no joints are known."""
    return tuple(f"joint {k + 1}" for k in range(count))


def named(recordings: Sequence[Recording], model: RobotModel) -> tuple[Recording, ...]:
    """Recordings from arrays with the names of the robot's joints where their columns have none."""
    names = model.dof_names
    return tuple(replace(one, joints=names) if one.joints == unnamed(len(names)) else one for one in recordings)


def check_order(source: Memory | Path, names: Sequence[str], model: RobotModel, *, all_known: bool = True) -> None:
    """Refuse names of columns that are those of other joints of the robot; with `all_known` also those it has not."""
    known = model.dof_names
    for column, name in enumerate(names):
        if name in known and known[column : column + 1] != (name,):
            turned = ""
            if model.nq == model.nv and set(names) == set(known):
                turned = f"; of q and tau, [:, {[names.index(one) for one in known]}]"
            raise InputError(
                f"{source}: joints names column {column} (from 0) '{name}', which is column {known.index(name)} of"
                f" robot '{model.name}': bring the columns into its order, {', '.join(known)}{turned}"
            )
        if all_known and name not in known:
            raise InputError(f"{source}: joints: robot '{model.name}' has no joint '{name}'{nearest(name, known)}")


def carried_body(model: RobotModel, load: Load) -> tuple[int, Float[np.ndarray, "10"]]:
    """Link (index) that carries a known payload, and its ten parameters as a point mass in that joint's frame."""
    names = [frame.name for frame in model.frames]
    if load.frame in model.link_names:
        link, place_of = model.link_index(load.frame), np.eye(4)
    else:
        frame = model.frames[names.index(load.frame)]
        link, place_of = frame.parent, np.asarray(model.frame_placement[names.index(load.frame)])
    if link < 0:
        raise InputError(f"load.frame '{load.frame}' does not move: no torque shows what it carries")
    point = from_com(load.mass, np.asarray(load.com, float), np.zeros((3, 3)))
    return link, np.asarray(transform(point, place_of))


def carrying(model: RobotModel, load: Load | None) -> RobotModel:
    """The robot with a known payload at its link."""
    if load is None:
        return model
    link, ten = carried_body(model, load)
    inertia = np.array(model.inertia, float)
    inertia[link] += ten
    return eqx.tree_at(lambda m: m.inertia, model, inertia)


class Drive:
    """Motor side to joint side; the identity where the task gives no transmission."""

    def __init__(self, task: Task, model: RobotModel):
        def read(key: str, shape: tuple[int, ...]) -> np.ndarray | None:
            value = task.transmission and getattr(task.transmission, key)
            if value is None:
                return None
            found = np.asarray(value)
            if found.shape != shape:
                names = ", ".join(model.joint_names)
                place = f"{task.file}: transmission.{key}"
                raise InputError(f"{place} has shape {found.shape}, expected {shape} for the joints {names}")
            return found

        self.position = read("position", (model.nv, model.nv))
        self.torque = read("torque", (model.nv, model.nv))
        offset = read("offset", (model.nv,))
        self.offset = np.zeros(model.nq) if offset is None else offset

    def joint_motion(self, motor: Float[np.ndarray, "samples nv"]) -> Float[np.ndarray, "samples nv"]:
        """Position of the joints (rad or m) from that of the drives."""
        return motor if self.position is None else np.linalg.solve(self.position, motor.T).T

    def joint_torque(self, motor: Float[np.ndarray, "samples nv"]) -> Float[np.ndarray, "samples nv"]:
        """Torque of the joints (N m or N) from that of the drives."""
        return motor if self.torque is None else motor @ self.torque.T


def _read(entry: RecordingEntry, key: str, model: RobotModel, drive: Drive, driven: Sequence[Driven] = ()) -> Recording:
    table = read_table(entry.file, f"{key}.file", Source(entry.format, entry.topic, entry.episode))
    units = entry.units
    angle = unit_factors(units.position, drive.position is not None, model)
    position = _columns(table, entry.position, position_names(model), f"{key}.position") * angle
    time = read_time(table, entry, key, len(position))

    def optional(name: str, columns: Sequence[str]):
        source = getattr(entry, name)
        return None if source is None else _columns(table, source, columns, f"{key}.{name}", len(position))

    velocity = optional("velocity", model.dof_names)
    torque, undriven = _torque(table, entry, optional, model, key)
    command = _of_the_drives(table, entry.command, optional, position_names(model), [one.joint for one in driven])
    if torque is not None and units.torque in _NO_TORQUE and drive.torque is None:
        raise InputError(
            f"{entry.file}: {key}.units.torque is {units.torque}: transmission.torque must say what one"
            f" {_NO_TORQUE[units.torque]} gives, as a list of N m (or N) a unit in the order of the joints"
        )
    if torque is not None and units.torque == "mA":
        torque = torque * 1e-3
    rate = unit_factors(units.velocity or units.position, drive.position is not None, model, of="v")
    return Recording(
        name=entry.name,
        file=entry.place,
        joints=model.dof_names,
        time=time,
        position=drive.joint_motion(position) + drive.offset,
        velocity=None if velocity is None else drive.joint_motion(velocity * rate),
        torque=None if torque is None else drive.joint_torque(torque),
        command=None if command is None else _commanded(command, angle, rate, drive, model, driven),
        load=entry.load,
        repeat=entry.repeat,
        role=entry.role,
        notes=_clock_beside(table, entry, len(position)),
        undriven=undriven,
    )


def _torque(
    table: Table,
    entry: RecordingEntry,
    optional: Callable[[str, Sequence[str]], np.ndarray | None],
    model: RobotModel,
    key: str,
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Torque with a column for each joint, and the joints that nothing drives: those that have 0 for a column."""
    source, names = entry.torque, model.dof_names
    if source is None or isinstance(source, str) or 0 not in source:
        return optional("torque", names), ()
    if len(source) != len(names):
        raise InputError(
            f"{table.file}: {key}.torque lists {len(source)} columns, expected {len(names)}: for each of"
            f" {', '.join(names)} its column, or 0 where nothing drives it"
        )
    undriven = tuple(joint for joint, column in zip(names, source, strict=True) if column == 0)
    driven = [k for k, column in enumerate(source) if column != 0]
    found = _columns(table, [str(source[k]) for k in driven], [names[k] for k in driven], f"{key}.torque")
    whole = np.zeros((len(found), len(names)))
    whole[:, driven] = found
    return whole, undriven


def _commanded(
    command: np.ndarray,
    angle: np.ndarray,
    rate: np.ndarray,
    drive: Drive,
    model: RobotModel,
    driven: Sequence[Driven],
) -> np.ndarray:
    """Commands on the joint side: positions, and of drives that take another quantity velocities and torques."""
    found, kinds = drive.joint_motion(command * angle) + drive.offset, {one.joint: one.command for one in driven}
    for kind in set(kinds.values()) - {"position"}:
        other = drive.joint_torque(command) if kind == "torque" else drive.joint_motion(command * rate)
        found = np.where([kinds.get(name) == kind for name in model.dof_names], other, found)
    return found


def _of_the_drives(
    table: Table,
    source: str | Sequence[str] | None,
    optional: Callable[[str, Sequence[str]], np.ndarray | None],
    names: tuple[str, ...],
    driven: Sequence[str],
) -> np.ndarray | None:
    """Commands with a column for each joint; those that nothing drives may be left out, and are zero."""
    if source is None or not driven or len(driven) >= len(names):
        return optional("command", names)
    if isinstance(source, str) and source in table.names:
        values = table.read(source)
        wide = 1 if values.ndim < 2 else values.shape[1]
    else:
        wide = sum(name.startswith(source) for name in table.names) if isinstance(source, str) else len(source)
    if wide == len(driven):
        whole = np.zeros((len(found := np.asarray(optional("command", driven))), len(names)))
        whole[:, [names.index(name) for name in driven]] = found
        return whole
    try:
        return optional("command", names)
    except InputError as error:
        other = f"; or one column for each joint that is driven: {', '.join(driven)}" * (wide not in (0, len(names)))
        raise InputError(f"{error}{other}") from None


_NO_TORQUE = {"A": "ampere", "mA": "ampere", "%": "per cent"}


def unit_factors(
    unit: str, motor_side: bool, model: RobotModel, of: Literal["q", "v"] = "q"
) -> Float[np.ndarray, " columns"]:
    """What turns each column into rad or m: degrees are of turning joints, millimetres of sliding ones."""
    turns = np.ones(model.nv, dtype=bool)
    turns[model.dofs.column[::-1]] = model.dofs.turns[::-1] | motor_side
    factors = {"deg": (np.pi / 180, 1.0), "mm": (1.0, 1e-3)}
    turning, sliding = factors.get(unit.split("/")[0], (1.0, 1.0))
    rates = np.where(turns, turning, sliding)
    if of == "v" or model.nq == model.nv:
        return rates
    out = np.ones(model.nq)
    for joint, at in zip(model.joints, model.dofs.positions, strict=True):
        numbers = at.stop - at.start - (4 if joint.kind in ("spherical", "free") else 0)  # quaternions have no unit
        out[at.start : at.start + numbers] = rates[joint.coordinate : joint.coordinate + numbers]
    return out


def joint_columns(table: Table, source, model: RobotModel, key: str):
    """Columns of the joints in their order, finite; `InputError` names file, key and row."""
    return _columns(table, source, model.joint_names, key)


def _columns(table: Table, source, names: Sequence[str], key: str, samples: int | None = None):
    values = table.matrix(source, names, key)
    if samples is not None and len(values) != samples:
        raise InputError(f"{table.file}: {key} has {len(values)} samples, but position has {samples}")
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):
        row, column = wrong[0]
        name = source if isinstance(source, str) else source[column] if len(source) == len(names) else ", ".join(source)
        raise InputError(
            f"{table.file}: {key} ('{name}') is {values[row, column]} in row {row} (from 0), column {column},"
            f" joint {names[column]}; {leave_out(len(wrong))}"
        )
    return values


_CLOCKS = ("t", "time", "timestamp", "stamp")  # what a column of stamps is called
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_NEAR = 0.1  # of the rate: what the stamps may say otherwise


def _clock_beside(table: Table, entry: RecordingEntry, samples: int) -> tuple[str, ...]:
    """A warning where a task states a `rate` and the file holds stamps that say another one; sent to the log too."""
    name, stated = next((name for name in table.names if name.lower() in _CLOCKS), None), entry.rate
    if stated is None or name is None:
        return ()
    try:
        stamps = table.vector(name, name)
    except InputError:
        return ()
    steps = np.diff(stamps)
    if len(stamps) != samples or not (steps > 0).all() or np.median(steps) == 1.0:  # a counter of samples
        return ()
    rates = {unit: 1 / (float(np.median(steps)) * second) for unit, second in _SECONDS.items()}
    if any(abs(rate / stated - 1) < _NEAR for rate in rates.values()):
        return ()
    unit = min(rates, key=lambda unit: abs(np.log(rates[unit] / stated)))
    said = f"time: {name}" if unit == "s" else f"time: {name}, units: {{time: {unit}}}"
    other = f"the column '{name}' runs at {rates[unit]:.4g} Hz"
    text = f"check: {table.file.name}: rate is {stated:g} Hz, but {other}; should the task say {said} in its place?"
    logging.getLogger("figaroh_jax").warning(text)
    return (text,)


def read_time(table: Table, entry: RecordingEntry, key: str, samples: int) -> Float[np.ndarray, " samples"]:
    """Time in s, increasing; counted by the rate, or in steps of one, where the entry names no clock."""
    if samples < 2:
        raise InputError(f"{table.file}: {samples} sample{'s'[samples:]}; a recording is a motion over time")
    if entry.time is None:
        return np.arange(samples) / (entry.rate or 1.0)  # postures may have no clock: they are counted
    time = table.vector(entry.time, f"{key}.time")
    if len(time) != samples:
        raise InputError(f"{table.file}: {key}.time has {len(time)} samples, but position has {samples}")
    wrong = np.flatnonzero(~np.isfinite(time))
    if len(wrong):
        raise InputError(
            f"{table.file}: {key}.time ('{entry.time}') is {time[wrong[0]]} in row {wrong[0]} (from 0);"
            f" {leave_out(len(wrong))}"
        )
    back = np.flatnonzero(np.diff(time) <= 0)
    unit = entry.units.time
    if len(back):
        row = int(back[0]) + 1
        what = "repeats" if time[row] == time[row - 1] else "goes back"
        raise InputError(
            f"{table.file}: {key}.time {what} in row {row} (from 0): {time[row]:.9g} {unit} after"
            f" {time[row - 1]:.9g} {unit}; the stamps must increase;"
            f" {not_increasing(time, row, '`rate`')}"
        )
    return time * _SECONDS[unit]
