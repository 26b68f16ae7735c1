"""Recordings of ROS: bags of ROS 1 and ROS 2 and MCAP files, a topic as a table.

Columns of a topic of joints are `stamp`, `received` (s since its first message) and `position.<joint>`,
`velocity.<joint>`, `effort.<joint>`, `command.<joint>`; of a wrench `force.x` to `torque.z`; of tf
`<child>.x` to `<child>.qw`. A column of another topic is `/topic:column`, interpolated at the stamps of the first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..errors import InputError, nearest
from .progress import told
from .tables import Table

__all__ = ["read_bag"]

_Row = tuple[tuple[str, ...], list[float]]  # names of a message's columns and their numbers
_JOINTS = ("JointState", "JointTrajectoryControllerState", "DynamicJointState")


def read_bag(path: Path, topic: str | None = None) -> Table:
    """One topic of a bag as a table; without `topic`, the one topic of joints that there is."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    def opened() -> Any:
        return AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))

    with opened() as reader:
        kinds = {c.topic: c.msgtype.rsplit("/", 1)[-1] for c in reader.connections}
    known = {name: kind for name, kind in kinds.items() if kind in _MESSAGES}
    chosen = _topic(path, topic, known, kinds)
    tables: dict[str, dict[str, np.ndarray]] = {}

    def load(name: str) -> dict[str, np.ndarray]:
        if name not in tables:
            with opened() as reader:
                tables[name] = _columns(path, name, known[name], reader)
        return tables[name]

    def read(name: str) -> np.ndarray:
        if not name.startswith("/"):
            return load(chosen)[name]
        other, _, column = name.rpartition(":")
        return _interpolated(path, load(chosen), load(other), other, column)

    others = tuple(f"{name}:{c}" for name in known if name != chosen for c in load(name) if c not in _CLOCKS)
    return Table(path, (*load(chosen), *others), read)


_CLOCKS = ("stamp", "received")


def _topic(path: Path, topic: str | None, known: dict[str, str], kinds: dict[str, str]) -> str:
    if topic is not None:
        if topic not in kinds:
            raise InputError(f"{path}: no topic '{topic}'{nearest(topic, kinds)}")
        if topic not in known:
            raise InputError(f"{path}: topic '{topic}' holds {kinds[topic]}; read are {', '.join(_MESSAGES)}")
        return topic
    joints = [name for name, kind in known.items() if kind in _JOINTS]
    if len(joints) != 1:
        found = ", ".join(f"{name} ({kind})" for name, kind in kinds.items()) or "none"
        why = "several topics hold joints" if joints else "no topic holds joint states"
        raise InputError(f"{path}: {why}; `topic` must name the one that is meant. Topics: {found}")
    return joints[0]


def _columns(path: Path, topic: str, kind: str, reader: Any) -> dict[str, np.ndarray]:
    """Every message of a topic, the columns of those with most joints; messages sent twice count once."""
    connections = [c for c in reader.connections if c.topic == topic]
    total = sum(c.msgcount for c in connections) or 1
    rows: dict[tuple[str, ...], list[tuple[int, int, list[float]]]] = {}
    for count, (connection, received, raw) in enumerate(reader.messages(connections)):
        message = reader.deserialize(raw, connection.msgtype)
        for stamp, (names, values) in _MESSAGES[kind](message):
            rows.setdefault(names, []).append((stamp, received, values))
        if count and count % 2000 == 0:
            told(f"reading {path.name} {topic}", count / total)
    rows = {names: found for names, found in rows.items() if names}
    if not rows:
        raise InputError(f"{path}: topic '{topic}' holds no message with numbers")
    if kind == "TFMessage":
        return _all_frames(rows)
    names = max(rows, key=lambda names: (len(names), len(rows[names])))
    return _once(names, rows[names])


def _once(names: tuple[str, ...], found: list[tuple[int, int, list[float]]]) -> dict[str, np.ndarray]:
    kept = [
        row
        for k, row in enumerate(found)
        if k == 0 or row[0] == 0 or (row[0], row[2]) != (found[k - 1][0], found[k - 1][2])
    ]
    stamps = np.array([[row[0], row[1]] for row in kept], dtype=np.int64)
    clocks = {name: (column - column[0]) * 1e-9 for name, column in zip(_CLOCKS, stamps.T, strict=True)}
    if not stamps[:, 0].any():
        del clocks["stamp"]
    values = np.array([row[2] for row in kept], dtype=np.float64)
    return clocks | dict(zip(names, values.T, strict=True))


def _all_frames(rows: dict[tuple[str, ...], list[tuple[int, int, list[float]]]]) -> dict[str, np.ndarray]:
    """Frames of tf at the stamps of the one that is sent most often."""
    tables = sorted((_once(names, found) for names, found in rows.items()), key=lambda t: -len(t["received"]))
    first = tables[0]
    clock = "stamp" if all("stamp" in table for table in tables) else "received"
    for table in tables[1:]:
        for name, column in table.items():
            if name not in _CLOCKS:
                first[name] = np.interp(first[clock], table[clock], column)
    return first


def _interpolated(
    path: Path, own: dict[str, np.ndarray], other: dict[str, np.ndarray], topic: str, column: str
) -> Float[np.ndarray, " samples"]:
    """A column of another topic at the times at which this topic's messages were received."""
    if column not in other:
        raise InputError(f"{path}: topic '{topic}' has no column '{column}'{nearest(column, other)}")
    return np.interp(own["received"], other["received"], other[column])


# Messages: (stamp in ns, (names of the columns, their numbers)) of each


def _stamp(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _by_joint(joints: Any, **arrays: Any) -> _Row:
    names, values = [], []
    for kind, array in arrays.items():
        if array is not None and len(array) == len(joints):
            names += [f"{kind}.{joint}" for joint in joints]
            values += [float(x) for x in array]
    return tuple(names), values


def _joint_state(message: Any) -> Iterator[tuple[int, _Row]]:
    yield (
        _stamp(message),
        _by_joint(message.name, position=message.position, velocity=message.velocity, effort=message.effort),
    )


def _controller_state(message: Any) -> Iterator[tuple[int, _Row]]:
    """`actual` and `desired` (before Humble), `feedback` and `reference` (since)."""
    measured = getattr(message, "feedback", None) or message.actual
    wanted = getattr(message, "reference", None) or message.desired
    arrays = {"position": measured.positions, "velocity": measured.velocities, "effort": measured.effort}
    yield _stamp(message), _by_joint(message.joint_names, **arrays, command=wanted.positions)


def _dynamic_joint_state(message: Any) -> Iterator[tuple[int, _Row]]:
    names, values = [], []
    for joint, state in zip(message.joint_names, message.interface_values, strict=True):
        for kind, value in zip(state.interface_names, state.values, strict=True):
            names.append(f"{kind}.{joint}")
            values.append(float(value))
    yield _stamp(message), (tuple(names), values)


def _wrench(message: Any) -> Iterator[tuple[int, _Row]]:
    wrench, names = getattr(message, "wrench", message), ("force", "torque")
    values = [float(getattr(getattr(wrench, name), axis)) for name in names for axis in "xyz"]
    stamp = _stamp(message) if hasattr(message, "header") else 0
    yield stamp, (tuple(f"{name}.{axis}" for name in names for axis in "xyz"), values)


def _frames(message: Any) -> Iterator[tuple[int, _Row]]:
    for one in message.transforms:
        place, turn = one.transform.translation, one.transform.rotation
        names = tuple(f"{one.child_frame_id}.{axis}" for axis in ("x", "y", "z", "qx", "qy", "qz", "qw"))
        yield _stamp(one), (names, [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w])


_MESSAGES: dict[str, Callable[[Any], Iterator[tuple[int, _Row]]]] = {
    "JointState": _joint_state,
    "JointTrajectoryControllerState": _controller_state,
    "DynamicJointState": _dynamic_joint_state,
    "WrenchStamped": _wrench,
    "Wrench": _wrench,
    "TFMessage": _frames,
}
