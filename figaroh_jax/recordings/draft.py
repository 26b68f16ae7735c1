"""A task file drafted from a robot and recordings as they are: what each column is, in which unit, of which joint.

Names decide first; limits, gravity and friction check what the names say, and decide what they leave open where they
can. What stays open is refused, what was assumed is said in the draft's comments.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError, nearest
from ..formats.config import RecordingEntry
from ..formats.robotfile import read_robot
from ..rigid.model import RobotModel, prismatic
from .checks import DEGREE, Finding, check_recording, position_findings
from .dataset import Recording
from .likeness import Sampled, likeness, rigid_torque, sampled
from .reading import BAGS, kind_of, lerobot_episodes, read_table
from .tables import Source, Table

__all__ = ["Draft", "Undecided", "draft_task"]

_WORDS = {
    "command": {
        "cmd",
        "command",
        "commanded",
        "des",
        "desired",
        "target",
        "ref",
        "reference",
        "setpoint",
        "goal",
        "action",
    },
    "velocity": {"dq", "qd", "vel", "velocity", "velocities", "speed", "qdot", "v"},
    "current": {"i", "current", "currents", "cur", "amp", "amps", "percent", "load"},
    "torque": {"tau", "torque", "torques", "effort", "efforts", "eff", "trq", "force", "j"},
    "position": {"q", "pos", "position", "positions", "angle", "angles", "theta", "state"},
}
_TIMES = ("t", "time", "timestamp", "timestamps", "stamp", "stamps", "sec", "seconds", "clock", "header.stamp")
_CLOCKS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SLOW, _FAST = 15.0, 14000.0  # Hz; their ratio is below a thousand, so that one unit of time alone fits
_HUGE = 1e12  # beyond it no column is a recording in any unit
CONFIRMED = 0.5  # of a torque's variance that its own joint explains, before it says anything of the order


class Undecided(InputError):
    """What the data cannot decide; `option` is the option of the command by which a user does."""

    def __init__(self, option: str, text: str) -> None:
        super().__init__(text)
        self.option = option


class Draft(NamedTuple):
    """The text of a task file, and what was assumed, one line each."""

    text: str
    assumed: tuple[str, ...]


class _Read(NamedTuple):
    """One recording: its columns by kind and what they hold, in the model's units."""

    file: Path
    entry: dict[str, Any]
    joints: tuple[str, ...]  # of the columns, in their order
    named: bool  # whether the columns' names hold the joints' names
    time: Float[np.ndarray, " samples"]
    position: Float[np.ndarray, "samples joints"]
    torque: Float[np.ndarray, "samples joints"] | None
    current: str  # unit of a torque that is none: "A", "mA", "%"; else empty
    command: Float[np.ndarray, "samples joints"] | None = None


def draft_task(
    model: Path,
    files: Sequence[Path],
    *,
    joints: Sequence[str] | None = None,
    rate: float | None = None,
    constants: Sequence[float] | None = None,
    unit: str | None = None,
    topic: str | None = None,
    gains: Sequence[float] | None = None,
) -> Draft:
    """A task for `diagnose` and `identify` on these recordings; `joints` names their columns, `rate` (Hz) their clock.

    `constants` are N m a unit of each torque column, `gains` the proportional gains of the position servos (N m/rad),
    both in the order of the joints; `unit` (rad, deg, m, mm) is that of the positions, `topic` that of bags.

    Raises `InputError` for what cannot be read, and `Undecided` for what the data do not decide.
    """
    whole = read_robot(model)
    for name in joints or ():
        if name not in whole.joint_names:
            raise InputError(f"--joints: robot '{whole.name}' has no joint '{name}'{nearest(name, whole.joint_names)}")
    reads = [_read(table, whole, joints, rate, entry) for table, entry in _tables(files, topic)]
    if len({read.joints for read in reads}) > 1:
        raise InputError("the recordings hold different joints; draft a task for each kind")
    robot = read_robot(model, reads[0].joints)
    assumed = [*dict.fromkeys(_clock_said(reads))]
    _doubt_percent(reads, unit)
    unit = unit or _unit_of_position(robot, reads)
    factor = np.where(np.array(prismatic(robot)), {"deg": 1.0, "mm": 1e-3}.get(unit, 1.0), _degrees(unit))
    reads = [
        read._replace(position=read.position * factor, command=None if read.command is None else read.command * factor)
        for read in reads
    ]
    if constants is not None and len(constants) != robot.nv:
        raise InputError(
            f"--constants: {len(constants)} numbers, expected one for each of {', '.join(robot.dof_names)}"
        )
    signs, said = _torques(robot, reads) if constants is None else ([*constants], ["torque constants as given"])
    drives, more = _drives(model, robot, reads, gains)
    said += more
    _refuse_what_is_wrong(robot, reads, signs)
    labels = _repeats(reads)
    assumed += [_unit_said(unit, robot), *said]
    return Draft(_text(model, robot, whole, reads, unit, signs, labels, assumed, drives), tuple(assumed))


def _degrees(unit: str) -> float:
    return DEGREE if unit == "deg" else 1.0


# Columns


def _tables(files: Sequence[Path], topic: str | None) -> Iterator[tuple[Table, dict[str, Any]]]:
    """Every recording with the keys of a task that say which it is; of a folder of episodes the first few."""
    for file in files:
        path = file.resolve()
        if kind_of(file) == "lerobot":
            for episode in lerobot_episodes(file, "recording")[:_EPISODES]:
                source = Source(episode=episode)
                yield read_table(file, "recording", source), {"file": str(path), "episode": episode}
            continue
        if kind_of(file) in BAGS:
            try:
                table = read_table(file, "recording", Source(topic=topic))
            except InputError as error:
                raise (Undecided("topic", str(error)) if "must name the one" in str(error) else error) from None
            yield table, {"file": str(path)} | ({} if topic is None else {"topic": topic})
            continue
        table = read_table(file, "recording")
        form = next((form for form, mark in _LOG_MARKS.items() if mark & set(table.names)), None)
        if form is not None:
            table = read_table(file, "recording", Source(form=form))
        yield table, {"file": str(path)} | ({} if form is None else {"format": form})


_EPISODES = 8
_LOG_MARKS = {"rtde": {"actual_q_0"}, "libfranka": {"tau_J[0]", "state.tau_J[0]"}}


def _read(
    table: Table, model: RobotModel, joints: Sequence[str] | None, rate: float | None, entry: dict[str, Any]
) -> _Read:
    form = entry.get("format")
    clock = (_LOGGED[form]["time"] if form else _time(table)) if rate is None else None
    kinds = _logged(table, _LOGGED[form]) if form else _kinds(table, clock)
    if "position" not in kinds:
        raise InputError(
            f"{table.file}: no column looks like a position (q, pos, position, angle...); its columns are"
            f" {', '.join(table.names[:12])}{'...' if len(table.names) > 12 else ''}"
        )
    names, sources, named = _of_joints(table, kinds["position"], model, joints, "position")
    position = _matrix(table, sources, names, "position")
    if form is None or sources != _LOGGED[form]["position"]:
        entry = entry | {"position": sources}
    torque, current, command = None, "", None
    for kind in ("torque", "current", "velocity", "command"):
        if kind not in kinds or (kind in ("current", "command") and torque is not None):
            continue
        own, source, by_name = _of_joints(table, kinds[kind], model, list(names), kind)
        if own != names:
            raise InputError(f"{table.file}: {kind} is of {', '.join(own)}, position of {', '.join(names)}")
        values = _matrix(table, source, names, kind)
        if len(values) != len(position):
            raise InputError(f"{table.file}: {kind} has {len(values)} samples, position {len(position)}")
        key = "torque" if kind == "current" else kind
        if form is None or source != _LOGGED[form].get(key):
            entry[key] = source
        if kind == "command":
            command = values
        elif kind != "velocity":
            torque, named = values, named and by_name
            current = _unit_of_current(source) if kind == "current" else ""
    time, entry = _stamps(table, clock, rate, len(position), entry)
    if form is not None and rate is None:
        del entry["time"]
    return _Read(table.file, entry, names, named, time, position, torque, current, command)


_LOGGED = {
    "rtde": {"time": "timestamp", "position": "actual_q", "current": "actual_current", "torque": "actual_current"},
    "libfranka": {"time": "time", "position": "q", "torque": "tau_J"},
}


def _logged(table: Table, known: dict[str, str]) -> dict[str, list[str]]:
    """The columns of a robot's own log, by the prefixes of its format."""
    wanted = {k: prefix for k, prefix in known.items() if k != "time" and not (k == "torque" and "current" in known)}
    pattern = {kind: re.compile(re.escape(prefix) + r"[_\[]\d+\]?") for kind, prefix in wanted.items()}
    found = {kind: [name for name in table.names if mark.fullmatch(name)] for kind, mark in pattern.items()}
    return {kind: names for kind, names in found.items() if names}


def _unit_of_current(source: Any) -> str:
    words = set(_words(" ".join([source] if isinstance(source, str) else source)))
    return "%" if words & {"percent", "load"} else "mA" if "ma" in words else "A"


def _words(name: str) -> list[str]:
    return [word for word in re.split(r"[^a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()) if word]


def _time(table: Table) -> str:
    found = [name for name in table.names if name.lower() in _TIMES]
    if not found and "received" in table.names:  # when a bag got a message that has no stamp of its own
        return "received"
    found = found or [n for n in table.names if set(_words(n)) & {*_TIMES} and not set(_words(n)) & {"des", "cmd"}]
    if len(found) != 1:
        what = f"several columns look like one: {', '.join(found)}" if found else "no column looks like one"
        raise Undecided(
            "rate", f"{table.file}: which column is the time? {what}; give --rate HZ, or rename it to 'time'"
        )
    return found[0]


def _stamps(
    table: Table, clock: str | None, rate: float | None, samples: int, entry: dict[str, Any]
) -> tuple[Float[np.ndarray, " samples"], dict[str, Any]]:
    """Time in s, and the entry with the key that says so."""
    if clock is None:
        assert rate is not None
        return np.arange(samples) / rate, entry | {"rate": rate}
    time = table.vector(clock, "time")
    if len(time) != samples or not (np.diff(time) > 0).all():
        raise InputError(f"{table.file}: '{clock}' is no clock of the positions: it does not increase, or is shorter")
    step = float(np.median(np.diff(time)))
    unit = next((u for u, s in _CLOCKS.items() if _SLOW <= 1 / (step * s) <= _FAST), None)
    if unit is None:
        raise Undecided(
            "rate",
            f"{table.file}: '{clock}' steps by {step:.4g}, which is no rate from {_SLOW:g} to {_FAST:g} Hz in s, ms, us"
            " or ns; give --rate HZ",
        )
    return (time - time[0]) * _CLOCKS[unit], entry | {"time": clock} | (
        {"units": {"time": unit}} if unit != "s" else {}
    )


def _kinds(table: Table, clock: str | None) -> dict[str, list[str]]:
    """Columns or arrays by what their names say that they hold."""
    found: dict[str, list[str]] = {}
    for name in table.names:
        words = _words(name)
        kind = next(
            (k for k, known in _WORDS.items() if known & set(words) and not (k == "torque" and words == ["j"])), None
        )
        kind = name.partition(".")[0] if name.partition(".")[0] in _OF_BAGS else kind
        if name != clock and kind is not None and not name.startswith("/") and not _has_parts(name, table.names):
            found.setdefault("torque" if kind == "effort" else kind, []).append(name)
    return {kind: _plainest(names) for kind, names in found.items()}


_OF_BAGS = ("position", "velocity", "effort", "command")


def _has_parts(name: str, names: Sequence[str]) -> bool:
    """Whether the columns of an array are named one by one too."""
    return any(other.startswith(f"{name}.") for other in names)


def _plainest(names: list[str]) -> list[str]:
    """Of several sets of columns the plain one: `q`, not `q_filt`."""
    plain = [name for name in names if not _SHADES & set(_words(name))]
    return plain or names


_SHADES = {"filt", "filtered", "raw", "smooth", "smoothed", "est", "estimated", "ext", "external", "residual"}


def _of_joints(
    table: Table, columns: list[str], model: RobotModel, joints: Sequence[str] | None, kind: str
) -> tuple[tuple[str, ...], Any, bool]:
    """Joints of a kind's columns in the model's order, what the task says of them, and whether names decided it."""
    wanted = list(joints or model.joint_names)
    by_name = {joint: c for joint in wanted for c in columns if _holds(c, joint, model.joint_names)}
    if by_name and (joints is None or len(by_name) == len(wanted)):
        names = tuple(joint for joint in model.joint_names if joint in by_name)
        if len(names) < len(columns) and joints is None:
            rest = [c for c in columns if c not in by_name.values()]
            text = f"{table.file}: {kind}: which joints are {', '.join(rest)}? Name all joints by --joints"
            raise Undecided("joints", text)
        return names, [by_name[joint] for joint in names], True
    if len(columns) == 1 and table.read(columns[0]).ndim == 2:
        count, source = table.read(columns[0]).shape[1], columns[0]
    else:
        numbered = sorted(columns, key=_number)
        prefixes = {re.sub(r"\d+", "#", name) for name in columns}
        if len(prefixes) > 1 and len(columns) > 1:
            raise InputError(f"{table.file}: several sets of columns look like {kind}: {', '.join(columns[:8])}")
        count, source = len(columns), numbered
    if joints is None and count != len(model.joint_names):
        raise Undecided(
            "joints",
            f"{table.file}: {count} columns of {kind}, but the robot has {len(model.joint_names)} joints"
            f" ({', '.join(model.joint_names)}); name theirs in the columns' order by --joints",
        )
    if count != len(wanted):
        raise InputError(f"{table.file}: {count} columns of {kind}, but --joints names {len(wanted)}")
    return tuple(wanted), source, False


def _holds(column: str, joint: str, names: Sequence[str]) -> bool:
    """Whether a column's name holds a joint's, and no longer joint name that contains it."""
    own = re.search(rf"(?<![A-Za-z0-9]){re.escape(joint)}(?![A-Za-z0-9])", column)
    longer = [n for n in names if n != joint and joint in n and n in column]
    return own is not None and not longer


def _number(name: str) -> tuple[int, ...]:
    return tuple(int(digits) for digits in re.findall(r"\d+", name))


def _matrix(table: Table, source: Any, joints: Sequence[str], key: str) -> Float[np.ndarray, "samples joints"]:
    values = np.asarray(table.matrix(source, joints, key), float)
    wrong = np.argwhere(~(np.abs(values) < _HUGE))
    if len(wrong) and key != "velocity":  # which no draft uses
        row, column = wrong[0]
        raise InputError(f"{table.file}: {key} of {joints[column]} is {values[row, column]:.4g} in row {row} (from 0)")
    return values


# What the values say


def _unit_of_position(robot: RobotModel, reads: Sequence[_Read]) -> str:
    """rad or deg (m or mm) that fits the model's limits and, where both do, the torque."""
    every = np.concatenate([read.position for read in reads])
    straight = np.array(prismatic(robot))
    wide = {"rad": every, "deg": every * np.where(straight, 1.0, DEGREE), "mm": every * np.where(straight, 1e-3, 1.0)}
    kinds = ["rad", *(["deg"] if not straight.all() else []), *(["mm"] if straight.all() else [])]
    fits = [u for u in kinds if not position_findings(wide[u], robot, "rad")]
    if len(fits) == 1:
        return fits[0]
    if not fits:
        text = "; ".join(finding.text for finding in position_findings(every, robot, "rad"))
        raise InputError(f"{reads[0].file}: in no unit do the positions fit the model: {text}")
    with_torque = [read for read in reads if read.torque is not None]
    misfit = {unit: float(np.mean([_unlike(robot, read, unit) for read in with_torque] or [0.0])) for unit in fits}
    best, other = sorted(fits, key=misfit.__getitem__)[:2]
    span = float(np.ptp(every, axis=0).max())
    if misfit[best] < 0.7 * misfit[other] or (best == "rad" and span < 2 * np.pi and misfit[best] <= misfit[other]):
        return best
    if span > 20:
        return "deg"
    raise Undecided(
        "unit",
        f"{reads[0].file}: positions span {span:.3g}: rad or degrees? Neither limits nor torque tell; give --unit",
    )


def _doubt_percent(reads: Sequence[_Read], unit: str | None) -> None:
    """LeRobot may keep positions as degrees or as a share of the range of motion, -100 to 100, which look alike."""
    for read in reads if unit is None else ():
        span = np.abs(read.position).max()
        if "episode" in read.entry and 7.0 < span <= 101.0:
            raise Undecided(
                "unit",
                f"{read.file}: positions reach {span:.3g}: LeRobot keeps degrees or, by default, a share of the range"
                " of motion (-100 to 100), which no file tells; give --unit deg where they are degrees",
            )


def _unlike(robot: RobotModel, read: _Read, unit: str) -> float:
    """Share of the heavy joints' torque that a reading does not explain."""
    straight = np.array(prismatic(robot))
    factor = np.where(straight, 1e-3 if unit == "mm" else 1.0, _degrees(unit))
    motion = sampled(read.time, read.position * factor, read.torque)
    if motion is None or motion.torque is None:
        return 1.0
    nominal = rigid_torque(robot, motion)
    like = [
        likeness(*each)
        for each in zip(nominal.T, motion.torque.T, motion.velocity.T, motion.acceleration.T, strict=True)
    ]
    size = np.array([one.expected for one in like])
    rest = np.array([1.0 - one.correlation**2 for one in like])
    return float(np.sum(size * rest) / max(np.sum(size), 1e-300))


class _Scale(NamedTuple):
    """Torque constant of a joint with its standard error, and what told its sign."""

    value: float
    error: float
    told: str  # "gravity", "friction" or nothing


def _torques(robot: RobotModel, reads: Sequence[_Read]) -> tuple[list[float] | None, list[str]]:
    """Factor from each torque column to N m (None: they are N m already), and what was assumed."""
    motions = [sampled(read.time, read.position, read.torque) for read in reads if read.torque is not None]
    motions = [motion for motion in motions if motion is not None]
    if not motions:
        known = all(read.command is not None for read in reads)
        said = "rollouts of the command" if known else "neither diagnose nor identify can use them without"
        return None, [f"the recordings hold no torque: {said}"]
    lowest = np.min([read.torque.min(axis=0) for read in reads if read.torque is not None], axis=0)
    highest = np.max([read.torque.max(axis=0) for read in reads if read.torque is not None], axis=0)
    if ((lowest >= 0) | (highest <= 0)).all() and robot.nv > 1:
        raise InputError(f"{reads[0].file}: no joint's torque changes its sign: an absolute value tells no direction")
    _order(robot, reads, motions)
    scales = [_scale(robot, motions, j) for j in range(robot.nv)]
    current = any(read.current for read in reads)
    odd = [s for s in scales if s.told == "gravity" and not 0.3 < abs(s.value) < 3.0]
    names = robot.dof_names
    if current or odd:
        open_joints = [
            n for n, s in zip(names, scales, strict=True) if s.told != "gravity" or s.error > 0.3 * abs(s.value)
        ]
        if open_joints:
            raise Undecided(
                "constants",
                f"{reads[0].file}: what holds the torque is no N m, and the motion does not tell the constants of"
                f" {', '.join(open_joints)}; those found: {_constants(names, scales)} N m a unit. Give all of them"
                " by --constants (data sheet: torque constant times gear ratio), N m a unit in the order of the joints",
            )
        said = [f"torque constants by the model's gravity, no surer than its masses: {_constants(names, scales)}"]
        return [s.value for s in scales], said
    turned = [n for n, s in zip(names, scales, strict=True) if s.value < 0 and s.told]
    unknown = [n for n, s in zip(names, scales, strict=True) if not s.told]
    said = []
    if turned:
        said.append(f"torque of {', '.join(turned)} has the opposite sign: turned by transmission.torque")
    if unknown:
        said.append(f"sign and order of the torque of {', '.join(unknown)} are taken as they are: nothing tells them")
    if not all(read.named for read in reads):
        told = [n for n, s in zip(names, scales, strict=True) if s.told]
        said.append(f"no column names a joint; gravity or friction bear the order out at {', '.join(told) or 'none'}")
    return ([-1.0 if n in turned else 1.0 for n in names] if turned else None), said


def _constants(names: Sequence[str], scales: Sequence[_Scale]) -> str:
    return ", ".join(
        f"{n} {s.value:.3g} ± {1.96 * s.error:.2g}" for n, s in zip(names, scales, strict=True) if s.told == "gravity"
    )


def _scale(robot: RobotModel, motions: Sequence[Sampled], joint: int) -> _Scale:
    """N m a unit of a column: by gravity and inertia of the model, else by friction, which must brake."""
    weights, values = [], []
    for motion in motions:
        assert motion.torque is not None
        nominal = rigid_torque(robot, motion)
        one = likeness(
            nominal[:, joint], motion.torque[:, joint], motion.velocity[:, joint], motion.acceleration[:, joint]
        )
        if abs(one.correlation) > 0.8 and one.expected > 0.02 * np.std(nominal) and one.error > 0:
            values.append(1 / one.slope)
            weights.append((one.slope / one.error) ** 2 / values[-1] ** 2)
    if values and (np.sign(values) == np.sign(values[0])).all():
        mean = float(np.average(values, weights=weights))
        return _Scale(mean, float(np.sqrt(1 / np.sum(weights)) + np.std(values) / np.sqrt(len(values))), "gravity")
    share = np.mean([_friction(motion, joint) for motion in motions])
    return _Scale(float(np.sign(share) or 1.0), np.inf, "friction" if abs(share) > 0.6 else "")


def _friction(motion: Sampled, joint: int) -> float:
    """Correlation of a torque with its joint's direction of motion."""
    assert motion.torque is not None
    x, v = motion.torque[:, joint], motion.velocity[:, joint]
    x, s = x - x.mean(), np.tanh(v / (0.1 * (np.sqrt(np.mean(v**2)) or 1.0)))
    s = s - s.mean()
    size = np.sqrt((x @ x) * (s @ s))
    return float(x @ s / size) if size > 0 else 0.0


def _order(robot: RobotModel, reads: Sequence[_Read], motions: Sequence[Sampled]) -> None:
    """Refuse torque columns that another joint's motion explains much better than their own."""
    from scipy.optimize import linear_sum_assignment

    shares = np.mean([_explained(robot, motion) for motion in motions], axis=0)
    _, order = linear_sum_assignment(-shares)
    names = robot.dof_names
    for cycle in _cycles(order.tolist()):
        own, best = shares[cycle, cycle], shares[cycle, order[cycle]]
        if (best > CONFIRMED).all() and np.sum(np.log((1.02 - own) / (1.02 - best))) > np.log(6.0):
            text = ", ".join(f"{names[j]} goes with the torque given for {names[order[j]]}" for j in cycle)
            raise InputError(f"{reads[0].file}: torque and position columns stand in different orders: {text}")


def _cycles(order: list[int]) -> Iterator[list[int]]:
    """The cycles of a permutation that move something."""
    left = {j for j, c in enumerate(order) if j != c}
    while left:
        cycle = [left.pop()]
        while order[cycle[-1]] in left:
            cycle.append(order[cycle[-1]])
            left.remove(cycle[-1])
        yield cycle


def _explained(robot: RobotModel, motion: Sampled) -> Float[np.ndarray, "nv nv"]:
    """Share of each torque column (second) that a joint's (first) nominal torque, friction and rotor explain."""
    assert motion.torque is not None
    nominal, out = rigid_torque(robot, motion), np.zeros((robot.nv, robot.nv))
    for j in range(robot.nv):
        v = motion.velocity[:, j]
        speed = np.sqrt(np.mean(v**2)) or 1.0
        columns = np.column_stack(
            [np.ones(len(v)), nominal[:, j], v, np.tanh(v / (0.1 * speed)), motion.acceleration[:, j]]
        )
        scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        rest = motion.torque - scaled @ np.linalg.lstsq(scaled, motion.torque, rcond=1e-8)[0]
        out[j] = 1 - rest.var(axis=0) / np.maximum(motion.torque.var(axis=0), 1e-300)
    return out


def _refuse_what_is_wrong(robot: RobotModel, reads: Sequence[_Read], signs: list[float] | None) -> None:
    """The check of recordings on the draft's own reading: a draft that it would warn of is not written."""
    factor = np.ones(robot.nv) if signs is None else np.array(signs)
    for read in reads:
        torque = None if read.torque is None else read.torque * factor
        recording = Recording(read.file.stem, read.file, robot.dof_names, read.time, read.position, torque=torque)
        entry = RecordingEntry(file=read.file, position="q", rate=1.0)
        grave = [f for f in check_recording(recording, robot, entry) if f.wrong or _decides(f)]
        if grave:
            raise InputError(f"{read.file}: {'; '.join(finding.text for finding in grave)}")


def _decides(finding: Finding) -> bool:
    """Whether a warning is about how the columns are read, not about the motion or its quality."""
    return any(
        word in finding.text for word in ("does not belong", "does not follow", "clock", "times what", "outside the")
    )


def _repeats(reads: Sequence[_Read]) -> list[str | None]:
    """One label for recordings whose positions are the same motion."""
    shapes = [_shape(read) for read in reads]
    labels: list[str | None] = [None] * len(reads)
    for i in range(len(reads)):
        for j in range(i):
            seconds = reads[i].time[-1] / max(reads[j].time[-1], 1e-9)
            if abs(seconds - 1) < 0.03 and np.corrcoef(shapes[i], shapes[j])[0, 1] > 0.995:
                labels[j] = labels[j] or chr(ord("A") + len({label for label in labels if label}))
                labels[i] = labels[j]
                break
    return labels


def _shape(read: _Read) -> Float[np.ndarray, " _"]:
    grid = np.linspace(0.0, read.time[-1], 200)
    x = np.column_stack([np.interp(grid, read.time, column) for column in read.position.T])
    return ((x - x.mean(axis=0)) / (x.std(axis=0).max() or 1.0)).ravel()


def _drives(
    model: Path, robot: RobotModel, reads: Sequence[_Read], gains: Sequence[float] | None
) -> tuple[dict[str, Any], list[str]]:
    """The `actuator` block of rollouts, which have a command in place of torque."""
    if any(read.torque is not None or read.command is None for read in reads):
        return {}, []
    for read in reads:
        assert read.command is not None
        for j, name in enumerate(robot.dof_names):
            if np.std(read.command[:, j]) > 1e-3 and np.corrcoef(read.command[:, j], read.position[:, j])[0, 1] < 0.5:
                raise InputError(
                    f"{read.file}: the position of {name} does not follow its command: order, sign or unit?"
                )
    if gains is not None:
        if len(gains) != robot.nv:
            raise InputError(f"--kp: {len(gains)} numbers, expected one for each of {', '.join(robot.dof_names)}")
        return {n: {"kind": "position", "kp": k} for n, k in zip(robot.dof_names, gains, strict=True)}, []
    if model.suffix.lower() == ".xml":
        return {}, ["the drives are the model's actuators"]
    raise Undecided(
        "kp",
        f"{model}: a command without torque is simulated with its drives, which a URDF does not describe: give the"
        f" gains of the position servos by --kp (N m/rad, in the order {', '.join(robot.dof_names)}), or an MJCF",
    )


# Words


def _clock_said(reads: Sequence[_Read]) -> Iterator[str]:
    for read in reads:
        rate = (len(read.time) - 1) / (read.time[-1] - read.time[0])
        unit = read.entry.get("units", {}).get("time", "s")
        yield f"{read.file.name}: {rate:.5g} Hz, stamps in {unit}, {read.time[-1]:.4g} s"


def _unit_said(unit: str, robot: RobotModel) -> str:
    text = {"rad": "rad (and m)", "deg": "degrees", "mm": "mm"}[unit]
    return f"positions are in {text}: that fits the limits of {robot.name} and its torque"


def _geared(robot: RobotModel, reads: Sequence[_Read], signs: list[float] | None) -> bool:
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


def _cutoff(reads: Sequence[_Read]) -> float:
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


def _text(
    model: Path,
    robot: RobotModel,
    whole: RobotModel,
    reads: Sequence[_Read],
    unit: str,
    signs: list[float] | None,
    labels: Sequence[str | None],
    assumed: Sequence[str],
    drives: dict[str, Any],
) -> str:
    from ..formats.export import dump_yaml

    robot_keys: dict[str, Any] = {"model": str(model.resolve())}
    if tuple(robot.joint_names) != tuple(whole.joint_names):
        robot_keys["joints"] = list(robot.joint_names)
    data = [_entry(read, unit, label, signs is not None) for read, label in zip(reads, labels, strict=True)]
    parts = ["# Drafted by `figaroh-jax new`. What was assumed:", *(f"#   {line}" for line in assumed)]
    order = "the columns' names" if all(read.named for read in reads) else "the order of the model's joints"
    parts += [f"#   columns belong to joints by {order}", ""]
    parts += [dump_yaml({"robot": robot_keys}), "# `role: holdout` keeps a recording out of the fit and predicts it."]
    parts += [dump_yaml({"data": data})]
    if signs is not None:
        parts += [
            "# From what the columns hold to N m at the joints.",
            dump_yaml({"transmission": {"torque": [float(x) for x in signs]}}),
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


def _entry(read: _Read, unit: str, label: str | None, converted: bool) -> dict[str, Any]:
    entry = {key: value for key, value in read.entry.items() if key != "units"}
    units = dict(read.entry.get("units", {}))
    if unit != "rad":
        units["position"] = unit
    if read.current and (converted or read.current != "A"):
        units["torque"] = read.current
    return entry | ({"units": units} if units else {}) | ({"repeat": label} if label else {}) | {"role": "fit"}
