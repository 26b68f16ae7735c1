"""How an effect stands in a rollout: what a diagnosis from commands and positions asks it, and never its name.

A class says it as `in_rollouts`: the library's effects name the numbers of the loop that they change, one of yours acts
by its own `torque` and may say of itself what is different from the default.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

__all__ = ["HERE", "InRollouts", "Scale"]

HERE = float("nan")  # a search starts where the present model stands


class Scale(NamedTuple):
    """Sizes that a search starts from: the joint's dry friction and the largest torque of its drives, N m or N."""

    friction: float
    torque: float


class InRollouts(NamedTuple):
    """What sets an effect apart from others in a rollout."""

    numbers: tuple[tuple[str, str], ...] = ()  # as the answer calls them, and numbers of the loop; empty: its `torque`
    starts: Callable[[Scale], tuple[tuple[float, ...], ...]] = lambda scale: ()  # of the numbers, for each start
    place: Literal["joint", "drive", "link", "pair", "robot", "spring"] = "joint"
    called: str = ""  # its name in rollouts, where the contract has another one
    usual: bool = False  # every joint has it
    adds_to: str = ""  # the effect of which it is more: found beside it, not without it
    rival_of: str = ""  # the effect that it may stand for: asked where that is named, whatever else is left
    rival_start: float = 0.0  # its size where that is asked
    contains: tuple[str, ...] = ()  # what it can imitate exactly: the simpler one is preferred
    limit: bool = False  # it changes the model before that can be differentiated
    elastic: bool = False  # another structure: a spring between motor and link
    constant: bool = False  # it shows at a joint that stands: one such makes up for another there
    several: bool = False  # it shows at several joints
    signed: bool | None = None  # whether its size may be of either sign; none: what the class says
    together: int = 1  # first numbers that are its size together
    neutral: float = 0.0  # its size where it is none
    falls_off: int | None = None  # number that is a speed: nothing without a size, and no end beyond all motion
    telling: int | None = None  # number that tells it from what it contains
    looks_like: str = ""  # what looks the same, in words
    experiment: str = ""  # that tells it from others; none: `separated_by`
    shapes: tuple[int, ...] = ()  # numbers that show nothing without a size: each start is asked
    gains_free: bool = False  # looked for only where the gains of the drives are not known
    last: bool = False  # looked for only where all others leave a rest

    def holds(self, other: str) -> bool:
        """Whether it can imitate another effect."""
        return other in self.contains
