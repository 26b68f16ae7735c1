"""What a check of recordings looks at, what it finds, and the words for it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ..rigid.model import RobotModel, prismatic
from .dataset import Recording
from .likeness import Sampled

if TYPE_CHECKING:
    from ..formats.config import RecordingEntry

__all__ = ["LIKE", "SOFT", "UNLIKE", "Finding", "Look", "and_more", "effort_unit", "named", "unit_of"]

LIKE = 0.8  # partial correlation of a torque, or a velocity, that belongs to its joint
UNLIKE = 0.4
SOFT = 3.0  # times a limit, or what the model needs: worth a word


class Finding(NamedTuple):
    """Something about a recording; `wrong` is refused, else it is a warning.

    A `grave` one contradicts the robot's model, so that no fit of this recording says what the model lacks. Where a
    torque merely does not follow the model, one recording says little of it: the joints of which that is so are
    `unlike`, and most recordings must say it of one of them.
    """

    wrong: bool
    text: str
    grave: bool = False
    unlike: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Look:
    """What the checks look at; those of positions alone need no recording."""

    position: Float[np.ndarray, "samples nv"]
    joints: tuple[str, ...]
    model: RobotModel
    unit: str = "rad"  # that the task says of the position
    series: Recording | None = None
    entry: RecordingEntry | None = None
    motion: Sampled | None = None
    time: Float[np.ndarray, " samples"] | None = None  # s; None: the positions have no order in time

    @property
    def recording(self) -> Recording:
        """The recording that is looked at, once it has been read."""
        assert self.series is not None
        return self.series

    def row(self, row: int | np.integer) -> int:
        """The row of the file that is a row here: some may have been left out."""
        clock = None if self.series is None else self.series.clock
        return int(row) if clock is None else int(np.searchsorted(clock, self.recording.time[row]))

    @cached_property
    def span(self) -> Float[np.ndarray, " nv"]:
        """Range of each joint without its outermost per cent."""
        low, high = np.percentile(self.position, [1, 99], axis=0)
        return high - low


def named(look: Look, which: np.ndarray) -> str:
    """The joints of a mask by name."""
    names = [name for name, at in zip(look.joints, which, strict=True) if at]
    return "every joint" if len(names) == len(look.joints) > 1 else ", ".join(names)


def unit_of(look: Look, joint: int) -> str:
    """Unit of a joint's position."""
    return "m" if prismatic(look.model)[joint] else "rad"


def effort_unit(look: Look, joint: int) -> str:
    """Unit of a joint's torque."""
    return "N" if prismatic(look.model)[joint] else "N m"


def and_more(rows: np.ndarray) -> str:
    """How many rows there are beside the one that is named."""
    return f" and {len(rows) - 1} more" if len(rows) > 1 else ""
