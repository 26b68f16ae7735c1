"""Which columns of a recording hold what, of which joint, by their names: the first half of a draft.

Clocks, positions, torques, currents and commands are found by the words that loggers use, joints by the names of the
model. What names leave open is `Undecided`, with the option of the command that decides it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..rigid.model import RobotModel
from .column_names import WORDS, holds, numbers_in, one_set, words_of
from .dataset import Driven
from .joined import in_halves
from .reading import BAGS, episodes_of, kind_of, read_table
from .tables import Source, Table, leave_out, not_increasing

__all__ = [
    "Columns",
    "Commands",
    "Undecided",
    "column_kinds",
    "of_joints",
    "read_columns",
    "read_commands",
    "read_tables",
    "without_sign",
]

_FEW_STEPS, _ALIKE = 20, 0.9  # rows of a clock, and the share of its steps that are alike
_TIMES = ("t", "time", "timestamp", "timestamps", "stamp", "stamps", "sec", "seconds", "clock", "header.stamp")
_CLOCKS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SLOW, _FAST = 15.0, 14000.0  # Hz; their ratio is below a thousand, so that one unit of time alone fits
_HUGE = 1e12  # beyond it no column is a recording in any unit


class Undecided(InputError):
    """What the data cannot decide; `option` is the option of `new` by which a user does.

    The message says `what` is open, then the `advice` to use that option, which other commands do not have.
    """

    def __init__(self, option: str, what: str, advice: str = "") -> None:
        super().__init__(what + advice)
        self.option, self.what = option, what


class Columns(NamedTuple):
    """One recording: its columns by kind and what they hold, in the model's units."""

    file: Path
    entry: dict[str, Any]
    joints: tuple[str, ...]  # of the columns, in their order
    named: bool  # whether the columns' names hold the joints' names
    time: Float[np.ndarray, " samples"]
    position: Float[np.ndarray, "samples joints"]
    torque: Float[np.ndarray, "samples joints"] | None
    current: str  # unit of a torque that is none: "A", "mA", "%"; else empty
    command: Float[np.ndarray, "samples driven"] | None = None
    driven: tuple[Driven, ...] = ()  # of the columns of the command
    drives_named: bool = True  # whether the command's names hold those of joints or drives
    unsigned: str = ""  # a torque beside the command that is left out: an absolute value
    motor: bool = False  # whether the names say that positions are those of motors
    unused: tuple[str, ...] = ()  # columns that nothing was made of


def read_columns(
    tables: Iterable[tuple[Table, dict[str, Any]]],
    model: RobotModel,
    joints: Sequence[str] | None = None,
    rate: float | None = None,
    drives: Callable[[Sequence[str]], Sequence[Driven]] = lambda joints: (),
    passive: Sequence[str] = (),
) -> list[Columns]:
    """The columns of every recording, in the joints' order of the model; `draft_task` says what may be given.

    `tables` are those of `read_tables`, each let go before the next is read.
    """
    return [_read(table, model, joints, rate, entry, drives, passive) for table, entry in tables]


def read_tables(files: Sequence[Path], topic: str | None) -> Iterator[tuple[Table, dict[str, Any]]]:
    """Every recording with the keys of a task that say which it is; of a folder of episodes the first few."""
    for file in files:
        path = file.resolve()
        if episodes := episodes_of(file, "recording"):
            for episode in episodes[:_EPISODES]:
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
    table: Table,
    model: RobotModel,
    joints: Sequence[str] | None,
    rate: float | None,
    entry: dict[str, Any],
    drives: Callable[[Sequence[str]], Sequence[Driven]],
    passive: Sequence[str],
) -> Columns:
    form = entry.get("format")
    if form is None:
        _refuse_numbers_alone(table)
    clock = (_LOGGED[form]["time"] if form else _time(table)) if rate is None else None
    kinds = _logged(table, _LOGGED[form]) if form else column_kinds(table, clock)
    if "position" not in kinds:
        raise InputError(
            f"{table.file}: no column looks like a position (q, pos, position, angle...); its columns are"
            f" {', '.join(table.names[:12])}{'...' if len(table.names) > 12 else ''}; rename those of the position, or"
            " write a task whose `position` names them"
        )
    names, sources, named = of_joints(table, kinds["position"], model, joints, "position")
    position = _matrix(table, sources, names, "position")
    if form is None or sources != _LOGGED[form]["position"]:
        entry = entry | {"position": sources}
    torque, current, command, unsigned = None, "", None, ""
    driven, drives_named = (), True
    for kind in ("torque", "current", "velocity", "command"):
        if kind not in kinds or (kind in ("current", "command") and torque is not None):
            continue
        known = {one.joint: one for one in drives(names)} if kind == "command" else {}
        if kind == "command":
            own, source, by_name = _of_driven(table, kinds[kind], names, tuple(known.values()))
        else:
            few = kind != "velocity" and _count(table, kinds[kind]) < len(names)
            wanted = [name for name in names if not few or name not in passive]
            own, source, by_name = of_joints(table, kinds[kind], model, wanted, kind, names)
            if own != tuple(wanted):
                raise InputError(f"{table.file}: {kind} is of {', '.join(own)}, position of {', '.join(wanted)}")
        values = _matrix(table, source, own, kind)
        current = _unit_of_current(source) if kind == "current" else current
        if kind in ("torque", "current") and len(own) < len(names):
            values, source = _with_zeros(values, source, own, names)
        if len(values) != len(position):
            raise InputError(f"{table.file}: {kind} has {len(values)} samples, position {len(position)}")
        key = "torque" if kind == "current" else kind
        if key == "torque" and "command" in kinds and without_sign(values):
            unsigned = source if isinstance(source, str) else ", ".join(str(name) for name in source if name != 0)
            continue
        if form is None or source != _LOGGED[form].get(key):
            entry[key] = source
        if kind == "command":
            kept = [k for k, joint in enumerate(own) if not known or joint in known]
            command, driven = values[:, kept], tuple(known.get(own[k], Driven(own[k])) for k in kept)
            drives_named = by_name
        elif kind != "velocity":
            torque, named = values, named and by_name
    time, entry = _stamps(table, clock, rate, len(position), entry)
    if form is not None and rate is None:
        del entry["time"]
    motor = bool(_MOTORS & set(words_of(" ".join([sources] if isinstance(sources, str) else sources))))
    commands, used = (command, driven, drives_named), {clock, *(name for each in kinds.values() for name in each)}
    unused = tuple(name for name in table.names if name not in used)
    return Columns(table.file, entry, names, named, time, position, torque, current, *commands, unsigned, motor, unused)


_MOTORS = {"motor", "motors", "rotor", "rotors"}


def without_sign(*torques: Float[np.ndarray, "samples joints"]) -> bool:
    """Whether no column ever changes its sign, and there are several."""
    low, high = np.min([x.min(axis=0) for x in torques], axis=0), np.max([x.max(axis=0) for x in torques], axis=0)
    return len(low) > 1 and bool(((low >= 0) | (high <= 0)).all())


def _refuse_numbers_alone(table: Table) -> None:
    """A text table without a header: no name says what its columns are."""
    if all(re.fullmatch(r"column_\d+", name) for name in table.names):
        raise InputError(
            f"{table.file} has no header line, and `new` knows columns by their names: write one above its numbers"
            f" (time, q1, ..., tau1, ...), or a task, in which its columns are {table.names[0]} to {table.names[-1]}"
        )


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
    words = set(words_of(" ".join([source] if isinstance(source, str) else source)))
    return "%" if words & {"percent", "load"} else "mA" if "ma" in words else "A"


def _time(table: Table) -> str:
    names = [name for name in table.names if name not in table.pieces]
    found = [name for name in names if name.lower() in _TIMES] or [name for name in names if in_halves(name)]
    if not found and "received" in table.names:  # when a bag got a message that has no stamp of its own
        return "received"
    told = [n for n in names if set(words_of(n)) & {*_TIMES} and not set(words_of(n)) & {"des", "cmd"}]
    found = found or [n for n in told if not _falls(table, n)]
    if not found and len(rising := _rising(table)) == 1:
        return rising[0]
    if len(found) != 1:
        halves = [n for n in names if set(words_of(n)) & _HALVES]
        if halves and not found:
            raise Undecided(
                "rate",
                f"{table.file}: {', '.join(halves)} are parts of a time; write their sum into one column 'time', in s"
                " from the recording's beginning, or give --rate HZ",
            )
        what = f"several columns look like one: {', '.join(found)}" if found else "no column looks like one"
        raise Undecided(
            "rate", f"{table.file}: which column is the time? {what}; give --rate HZ, or rename it to 'time'"
        )
    return found[0]


_HALVES = {"secs", "nsec", "nsecs", "nanosec", "nanosecs", "usec", "usecs"}


def _falls(table: Table, name: str) -> bool:
    """Whether a column goes down too often for a clock, even one in which some rows are wrong: `m_t_3` is a torque."""
    try:
        steps = np.diff(np.asarray(table.read(name), float))
    except (InputError, TypeError, ValueError):
        return False
    return steps.ndim == 1 and bool(steps.size) and bool((steps < 0).mean() > 1 - _ALIKE)


def _rising(table: Table) -> list[str]:
    """Columns that run as a clock does, whatever they are called: up from row to row, mostly by the same step."""
    out = []
    for name in table.names:
        try:
            values = np.asarray(table.read(name), float)
        except (InputError, TypeError, ValueError):
            continue
        steps = np.diff(values) if values.ndim == 1 else np.zeros(0)
        if len(steps) < _FEW_STEPS or not (steps >= 0).all() or not (steps > 0).mean() > _ALIKE:
            continue
        step = float(np.median(steps))
        if np.mean(np.abs(steps - step) <= 0.5 * step) > _ALIKE:
            out.append(name)
    clocks = [name for name in out if not _counts(np.asarray(table.read(name), float))]
    return clocks if len(out) > 1 else out


def _counts(values: Float[np.ndarray, " samples"]) -> bool:
    """Whether a column is the running number of its row, as pandas writes it."""
    return bool(values[0] in (0, 1) and (np.diff(values) == 1).all())


def _stamps(
    table: Table, clock: str | None, rate: float | None, samples: int, entry: dict[str, Any]
) -> tuple[Float[np.ndarray, " samples"], dict[str, Any]]:
    """Time in s, and the entry with the key that says so."""
    if clock is None:
        assert rate is not None
        return np.arange(samples) / rate, entry | {"rate": rate}
    time = _increasing(table, clock, samples, "positions")
    step = float(np.median(np.diff(time)))
    unit = next((u for u, s in _CLOCKS.items() if _SLOW <= 1 / (step * s) <= _FAST), None)
    if unit is None:
        raise Undecided(
            "rate",
            f"{table.file}: '{clock}' steps by {step:.4g}, which is not a rate from {_SLOW:g} to {_FAST:g} Hz in s, ms,"
            " us or ns; give --rate HZ",
        )
    return (time - time[0]) * _CLOCKS[unit], entry | {"time": clock} | (
        {"units": {"time": unit}} if unit != "s" else {}
    )


def _increasing(table: Table, clock: str, samples: int, of: str) -> Float[np.ndarray, " samples"]:
    """The stamps as the file has them; `InputError` where they are not one to a row, each after the one before."""
    time = table.vector(clock, "time")
    if len(time) != samples:
        raise InputError(f"{table.file}: '{clock}' is not the {of}' clock: it has {len(time)} rows of {samples}")
    wrong = np.flatnonzero(~np.isfinite(time))
    if len(wrong):
        raise InputError(
            f"{table.file}: '{clock}' is {time[wrong[0]]} in row {wrong[0]} (from 0); {leave_out(len(wrong))}"
        )
    back = np.flatnonzero(~(np.diff(time) > 0))
    if len(back):
        row = int(back[0]) + 1
        raise InputError(
            f"{table.file}: '{clock}' is no clock of the {of}: in row {row} (from 0) it is {time[row]:.9g} after"
            f" {time[row - 1]:.9g}, and the stamps must increase; {not_increasing(time, row, '--rate')}"
        )
    return time


def column_kinds(table: Table, clock: str | None) -> dict[str, list[str]]:
    """Columns or arrays by what their names say that they hold."""
    found: dict[str, list[str]] = {}
    for name in table.names:
        words = set(_PRESENT.sub("", " ".join(words_of(name))).split())
        kind = next((k for k, known in WORDS.items() if known & words), None)
        kind = name.partition(".")[0] if name.partition(".")[0] in _OF_BAGS else kind
        told = name == clock or name in table.pieces or _has_parts(name, table.names)
        if not told and kind is not None and not _of_another_topic(name) and table.words(name) is None:
            found.setdefault("torque" if kind == "effort" else kind, []).append(name)
    positions = [name for name in found.get("position", ()) if set(words_of(name)) & WORDS["position"] - {"state"}]
    if positions and "position" in found:  # `state` is the mode of the controller there
        found["position"] = positions
    claimed = {name for names in found.values() for name in names} | {clock}
    plain = [n for n in table.names if n not in claimed and {"u", "ctrl"} & {*words_of(n)[:1], *words_of(n)[-1:]}]
    if "command" not in found and plain:
        found["command"] = [name for name in plain if not _has_parts(name, table.names)]
    return {kind: _plainest(names) for kind, names in found.items()}


_OTHERS = "|".join(sorted(WORDS["position"] | WORDS["velocity"] | WORDS["torque"]))
_PRESENT = re.compile(rf"\bcurrent (?=(?:{_OTHERS})\b)")  # `current_position` is where the joint is now, not a current
_OF_BAGS = ("position", "velocity", "effort", "command")


def _of_another_topic(name: str) -> bool:
    """A bag's `/topic:column`, not the `/topic/column` of a topic that was written as text."""
    return name.startswith("/") and ":" in name


def _has_parts(name: str, names: Sequence[str]) -> bool:
    """Whether the columns of an array are named one by one too."""
    return any(other.startswith(f"{name}.") for other in names)


def _plainest(names: list[str]) -> list[str]:
    """Of several sets of columns the plain one: `q`, not `q_filt`."""
    plain = [name for name in names if not _SHADES & set(words_of(name))]
    return plain or names


_SHADES = {"filt", "filtered", "raw", "smooth", "smoothed", "est", "estimated", "ext", "external", "residual"}


def _count(table: Table, columns: list[str]) -> int:
    """How many columns there are, those of an array counted."""
    shape = np.shape(table.read(columns[0])) if len(columns) == 1 else ()
    return shape[1] if len(shape) == 2 else len(columns)


def _with_zeros(
    values: Float[np.ndarray, "samples driven"], source: Any, own: Sequence[str], names: Sequence[str]
) -> tuple[Float[np.ndarray, "samples joints"], list[str | int]]:
    """Torques of the driven joints among those of all, and what the task says of them: 0 where nothing drives one."""
    listed = dict(zip(own, [source] if isinstance(source, str) else source, strict=True))
    whole = np.zeros((len(values), len(names)))
    whole[:, [names.index(joint) for joint in own]] = values
    return whole, [listed.get(joint, 0) for joint in names]


def of_joints(
    table: Table,
    columns: list[str],
    model: RobotModel,
    joints: Sequence[str] | None,
    kind: str,
    moving: Sequence[str] = (),
) -> tuple[tuple[str, ...], Any, bool]:
    """Joints of a kind's columns in the model's order, what the task says of them, and whether names decided it.

    `moving` are the joints whose positions have been read, where there are any: what `joints` holds is then not the
    user's word, but what is known from them.
    """
    wanted = list(joints or model.joint_names)
    by_name = {joint: c for joint in wanted for c in columns if holds(c, joint, model.joint_names)}
    if by_name and (joints is None or len(by_name) == len(wanted)):
        names = tuple(joint for joint in model.joint_names if joint in by_name)
        if len(names) < len(columns) and joints is None:
            rest = [c for c in columns if c not in by_name.values()]
            left = [joint for joint in model.joint_names if joint not in by_name]
            raise Undecided(
                "joints",
                f"{table.file}: {kind}: which joints are {', '.join(rest)}?",
                f" Name all joints by --joints, in the order of the columns {', '.join(columns)}; the model's others"
                f" are {', '.join(left) or 'none'}",
            )
        return names, [by_name[joint] for joint in names], True
    if len(columns) == 1 and table.read(columns[0]).ndim == 2:
        (rows, count), source = table.read(columns[0]).shape, columns[0]
        if rows == len(wanted) != count and count > rows:
            raise InputError(f"{table.file}: '{source}' has shape ({rows}, {count}): samples are rows; transpose it")
    else:
        numbered = sorted(columns, key=numbers_in)
        prefixes = {re.sub(r"\d+", "#", name) for name in columns}
        if joints is not None and len(columns) == len(wanted) and one_set(columns):
            _refuse_misplaced(table, columns, wanted, model)
            numbered = columns if len(prefixes) > 1 else numbered
        elif len(prefixes) > 1 and len(columns) > 1:
            raise InputError(
                f"{table.file}: several sets of columns look like {kind}: {', '.join(columns[:8])}; rename those that"
                f" are not meant (`new` goes by names), or write a task whose `{kind}` names the right ones"
            )
        count, source = len(columns), numbered
    if joints is None and count != len(model.joint_names):
        raise Undecided(
            "joints",
            f"{table.file}: {count} column{'s'[: count != 1]} of {kind}, but the robot has"
            f" {len(model.joint_names)} joints ({', '.join(model.joint_names)})",
            f"; name the joints of {', '.join(columns[:12])} by --joints, in this order, or give the columns of all"
            f" joints names such as {kind}_{model.joint_names[0]}",
        )
    if count != len(wanted) and moving and kind in ("torque", "current"):
        raise Undecided(
            "passive",
            f"{table.file}: {count} column{'s'[: count != 1]} of {kind} ({', '.join(columns[:8])}) for"
            f" {len(wanted)} joint{'s'[: len(wanted) != 1]} ({', '.join(wanted)})",
            "; name by --passive those that nothing drives, whose torque is zero, and give the columns of the others"
            f" the names of their joints, such as {kind}_{wanted[0]}",
        )
    if count != len(wanted):
        whose = "the positions are of" if moving else "--joints names"
        raise InputError(f"{table.file}: {count} column{'s'[: count != 1]} of {kind}, but {whose} {len(wanted)}")
    return tuple(wanted), source, False


def _of_driven(
    table: Table, columns: list[str], joints: Sequence[str], driven: Sequence[Driven]
) -> tuple[tuple[str, ...], Any, bool]:
    """Joints of a command's columns, what the task says of them, and whether names decided it.

    A column is of the joint whose name it holds, or of its drive's. Columns without such names are taken in the order
    of the joints: one for each, or for those alone that have a drive. Of a robot file without drives (`driven` is
    empty) the names say which joints have one, without names all.
    """
    wanted = [one.joint for one in driven] or list(joints)
    for called in ({joint: (joint,) for joint in joints}, {one.joint: one.drives for one in driven}):
        every = [name for names in called.values() for name in names]
        own = {joint: [c for c in columns if any(holds(c, n, every) for n in called[joint])] for joint in called}
        twice = next((own[joint] for joint in wanted if len(own.get(joint, ())) > 1), None)
        if twice:
            raise InputError(
                f"{table.file}: {' and '.join(twice)} look like commands of one joint, and a task has one command for"
                " each; rename those that are none, or write a task whose `command` names the right columns"
            )
        of = tuple(joint for joint in joints if own.get(joint) and joint in wanted)
        if of and (len(of) == len(wanted) or (not driven and len(of) == len(columns))):
            return of, [own[joint][0] for joint in of], True
    whole = len(columns) == 1 and table.read(columns[0]).ndim == 2
    alike = len({re.sub(r"\d+", "#", name) for name in columns}) == 1
    count = table.read(columns[0]).shape[1] if whole else len(columns)
    of = tuple(wanted if count == len(wanted) else joints)
    inside = sorted(columns, key=numbers_in) if alike else columns
    names = {joint: {joint}.union(*(one.drives for one in driven if one.joint == joint)) for joint in joints}
    every = [name for each in names.values() for name in each]
    held = [{joint for joint in joints if any(holds(c, name, every) for name in names[joint])} for c in inside]
    if count != len(of) or (not whole and any(own - {joint} for joint, own in zip(of, held, strict=True))):
        few = f", of which {', '.join(wanted)} ha{'s' if len(wanted) == 1 else 've'} a drive" if driven else ""
        raise InputError(
            f"{table.file}: {count} column{'s'[: count != 1]} of a command ({', '.join(columns[:12])}), but the robot"
            f" has {len(joints)} joint{'s'[: len(joints) != 1]} ({', '.join(joints)}){few}; give one column for each"
            f" joint with a drive, with that joint in its name, as cmd_{wanted[0]}"
        )
    if not whole and not alike and not one_set(columns):
        raise InputError(f"{table.file}: several sets of columns look like a command: {', '.join(columns[:8])}")
    return of, columns[0] if whole else inside, False


def _refuse_misplaced(table: Table, columns: Sequence[str], joints: Sequence[str], model: RobotModel) -> None:
    """Refuse an order of --joints that contradicts the columns that hold a joint's name."""
    for column, joint in zip(columns, joints, strict=True):
        own = next((name for name in model.joint_names if holds(column, name, model.joint_names)), joint)
        if own != joint:
            raise InputError(
                f"{table.file}: --joints names {joint} where the columns have '{column}'; their order is"
                f" {', '.join(columns)}"
            )


def _matrix(table: Table, source: Any, joints: Sequence[str], key: str) -> Float[np.ndarray, "samples joints"]:
    values = np.asarray(table.matrix(source, joints, key), float)
    wrong = np.argwhere(~(np.abs(values) < _HUGE))
    if len(wrong) and key != "velocity":  # which no draft uses
        row, column = wrong[0]
        raise InputError(
            f"{table.file}: {key} of {joints[column]} is {values[row, column]:.4g} in row {row} (from 0);"
            f" {leave_out(len(wrong))}"
        )
    return values


class Commands(NamedTuple):
    """A file of commands: one column for each drive, and where the joints were where it says so."""

    time: Float[np.ndarray, " samples"]  # s
    command: Float[np.ndarray, "samples drives"]
    columns: tuple[str, ...]  # of the command
    joints: tuple[str, ...] = ()  # of position and velocity
    position: Float[np.ndarray, "samples joints"] | None = None
    velocity: Float[np.ndarray, "samples joints"] | None = None


def read_commands(
    file: Path,
    drives: Sequence[str],
    of: Sequence[str],
    model: RobotModel,
    *,
    kinds: Sequence[str] = ("command",),
    columns: Sequence[str] = (),
    rate: float | None = None,
) -> Commands:
    """Time, commands and, where they are there, positions and velocities of a file, told by the names of its columns.

    A column is of the drive whose name it holds, or of the joint that the drive moves (`of`); columns without such
    names are taken in the drives' order. `kinds` are those that may be it, "command" or "torque", the first one
    first; a command that is called a position is no torque. `columns` states them (or the one array), in the
    drives' order where they have no names of drives or joints. A file with positions has a recording's clock, in s,
    ms, us or ns; time beside commands alone is in s; `rate` (Hz) is that of a file without a clock. Raises
    `InputError` with the columns of the file where they do not decide.
    """
    table = read_table(file, "recording")
    try:
        return _commands(table, drives, of, model, kinds, columns, rate)
    except Undecided as error:
        more = "" if error.option == "rate" else "; name each column after its joint, or leave the positions out"
        raise InputError(error.what + more) from None


def _commands(
    table: Table,
    drives: Sequence[str],
    of: Sequence[str],
    model: RobotModel,
    wanted: Sequence[str],
    stated: Sequence[str],
    rate: float | None,
) -> Commands:
    clock = _time(table) if rate is None else None
    kinds = column_kinds(table, clock)
    unknown = next((name for name in stated if name not in table.names), None)
    if unknown is not None:
        raise InputError(f"{table.file}: no column '{unknown}'; its columns are {', '.join(table.names[:12])}")
    found = [*stated] or _command_columns(table, kinds, clock, wanted, [*drives, *of])
    if not found:
        what = " or ".join({"torque": "torque (tau, effort)", "command": "command (cmd, u, target)"}[k] for k in wanted)
        raise InputError(
            f"{table.file}: no column looks like a {what}; its columns are {', '.join(table.names[:12])}; name one"
            f" column for each of {', '.join(drives)}, or state them by --columns"
        )
    command = _of_drives(table, found, drives, of, in_order=bool(stated))
    if "position" not in kinds:
        if clock is None:
            time, _ = _stamps(table, None, rate, len(command), {})
        else:
            time = _increasing(table, clock, len(command), "commands")
        return Commands(time, command, tuple(found))
    time, _ = _stamps(table, clock, rate, len(command), {})
    joints, source, _ = of_joints(table, kinds["position"], model, None, "position")
    states = {"position": _matrix(table, source, joints, "position")}
    if "velocity" in kinds:
        names, source, _ = of_joints(table, kinds["velocity"], model, list(joints), "velocity")
        if names == joints:
            states["velocity"] = _matrix(table, source, joints, "velocity")
    for kind, values in states.items():
        if len(values) != len(time):
            raise InputError(f"{table.file}: {kind} has {len(values)} rows, the command {len(time)}")
        wrong = np.argwhere(~np.isfinite(values))
        if len(wrong):
            row, column = wrong[0]
            raise InputError(f"{table.file}: {kind} of {joints[column]} is no number in row {row} (from 0)")
    return Commands(time, command, tuple(found), joints, **states)


def _command_columns(
    table: Table, kinds: dict[str, list[str]], clock: str | None, wanted: Sequence[str], names: Sequence[str]
) -> list[str]:
    """Columns that look like a command: by their words, as `u` or `ctrl`, or by the name of a drive or joint alone."""
    for kind in wanted:
        found = kinds.get(kind, [])
        if kind == "command" and "torque" in wanted:
            found = [name for name in found if not (WORDS["position"] | WORDS["velocity"]) & set(words_of(name))]
        if found:
            return found
    plain = [name for name in table.names if re.fullmatch(r"(u|ctrl)([._\[]*\d+\]?)?", name)]
    claimed = {name for each in kinds.values() for name in each} | {clock}
    return plain or [
        name for name in table.names if name not in claimed and any(holds(name, one, names) for one in names)
    ]


def _of_drives(
    table: Table, columns: Sequence[str], drives: Sequence[str], of: Sequence[str], *, in_order: bool
) -> Float[np.ndarray, "samples drives"]:
    """The commands in the drives' order, by the names of drives or joints, else as they stand or are numbered."""
    for names in (drives, of):
        by_name = {name: [c for c in columns if holds(c, name, names)] for name in names}
        twice = next((each for each in by_name.values() if len(each) > 1), None)
        if twice is not None and all(by_name.values()):
            raise InputError(
                f"{table.file}: {' and '.join(twice)} look like commands of one joint; state the columns by --columns"
            )
        if all(by_name.values()) and len(by_name) == len(drives):
            return _matrix(table, [each[0] for each in by_name.values()], drives, "command")
    whole = len(columns) == 1 and table.read(columns[0]).ndim == 2
    count = table.read(columns[0]).shape[1] if whole else len(columns)
    if count != len(drives):
        raise InputError(
            f"{table.file}: {count} columns of a command ({', '.join(columns[:12])}), but the model has {len(drives)}"
            f" drives: {', '.join(drives)}; name one column for each"
        )
    ordered = columns if in_order else sorted(columns, key=numbers_in)
    return _matrix(table, columns[0] if whole else list(ordered), drives, "command")
