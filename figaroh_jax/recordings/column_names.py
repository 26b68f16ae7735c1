"""What the names of columns say: the words that loggers use for quantities, and the joints of a robot."""

from __future__ import annotations

import re
from collections.abc import Sequence

__all__ = ["WORDS", "holds", "numbers_in", "one_set", "words_of"]

WORDS = {
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
    "torque": {"tau", "torque", "torques", "effort", "efforts", "eff", "trq", "moment", "moments", "force"},
    "position": {"q", "pos", "position", "positions", "angle", "angles", "theta", "state"},
}
_BESIDE = {"deg", "degree", "degrees", "rad", "mm", "m", "nm", "actual", "measured", "present"}.union(*WORDS.values())


def words_of(name: str) -> list[str]:
    """The words of a column's name in small letters: `jointPos_1 [deg]` holds joint, pos and deg."""
    return [word for word in re.split(r"[^a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()) if word]


def holds(column: str, joint: str, names: Sequence[str]) -> bool:
    """Whether a column's name holds a joint's, and no longer joint name that contains it.

    `shoulder_pan [deg]` holds `shoulder_pan_joint`: nothing but quantities and units stand beside it.
    """
    others = [name for name in names if name != joint]
    if _stands(joint, column):
        return not any(joint in name and name in column for name in others)
    short = _JOINT.sub("", joint)
    if len(short) < _SHORTEST or not _stands(short, column) or short.lower() in _BESIDE:
        return False
    if any(short in name and name in column for name in (_JOINT.sub("", other) for other in others)):
        return False
    beside = column.replace(short, " ", 1)
    return not set(words_of(beside)) - _BESIDE and not re.search(r"\d", beside)


def _stands(name: str, column: str) -> bool:
    return re.search(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", column) is not None


_JOINT = re.compile(r"^joint[_-]|[_-]joint$", re.IGNORECASE)
_SHORTEST = 3  # letters of a joint's name without `joint`: `joint_1` leaves no name


def one_set(columns: Sequence[str]) -> bool:
    """Whether names differ in one word alone, so that they are one quantity of several joints: `state.a`, `state.b`."""
    parts = [re.split(r"(?<=[._/ \[])|(?=[._/ \]])", name) for name in columns]
    head = next((k for k, words in enumerate(zip(*parts, strict=False)) if len(set(words)) > 1), 0)
    back = zip(*(reversed(words) for words in parts), strict=False)
    tail = next((k for k, words in enumerate(back) if len(set(words)) > 1), 0)
    return len(set(columns)) == len(columns) and head + tail > 0


def numbers_in(name: str) -> tuple[int, ...]:
    """The whole numbers of a name, for the order of `q_2` and `q_10`."""
    return tuple(int(digits) for digits in re.findall(r"\d+", name))
