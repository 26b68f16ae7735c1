"""Which causes predict data that was kept out: what does not lower its error is not named, however well it fits."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect
from ..results import Gain, Name
from .comparison import t_value
from .holdout import held_squares
from .joint import Joint, polished
from .problem import Problem
from .search import Found
from .state import State
from .thresholds import CONFIDENT

__all__ = ["Fall", "Gaining", "fall", "without_losses"]


class Gaining(NamedTuple):
    """Causes that all lower the error on the data held out, with that error."""

    named: list[Found]
    joint: Joint
    order: list[int]  # of the named, by what each gains as it comes in
    gains: list[Gain]  # of each, in that order
    holdout: Gain  # of all together
    worse: list[Name]  # those that did not


class Fall(NamedTuple):
    """What a cause does to the error on data kept out as it comes in."""

    own: float  # share of the squares of the joints where it acts that goes
    sure: float  # Student t of the blocks of these
    each: float  # sum over the joints of that share
    whole: float  # squares of all joints that go, N m or N, squared
    t: float  # Student t of the blocks of these

    def gains(self, strict: bool) -> bool:
        """Whether the cause predicts better where it acts, and the robot is not predicted worse for it.

        Beside a rest (`strict`) a fall may be chance and must be sure. There the squares of the robot are asked joint
        by joint: those in N m are the large joints', which any change of the fit moves by more than a small joint has.
        """
        if not strict:
            return self.own > 0 and self.whole > 0
        return self.own > 0 and self.sure > CONFIDENT and self.each > 0 and self.t > -CONFIDENT


def fall(before: Float[np.ndarray, "blocks nv"], after: Float[np.ndarray, "blocks nv"], joints: Sequence[int]) -> Fall:
    """What becomes of the squares of each block and joint for a cause that acts at the `joints`."""
    places, drop, had = list(joints), (before - after).sum(0), np.maximum(before.sum(0), 1e-300)
    return Fall(
        own=float(drop[places].sum() / had[places].sum()),
        sure=t_value(before[:, places].sum(1), after[:, places].sum(1)),
        each=float((drop / had).sum()),
        whole=float(drop.sum()),
        t=t_value(before.sum(1), after.sum(1)),
    )


def without_losses(
    problem: Problem,
    start: State,
    whitening: Float[np.ndarray, "F nv"],
    named: list[Found],
    joint: Joint,
    strict: bool,
) -> Gaining:
    """The causes without those that do not lower the error on the data held out, the worst first (`Fall`).

    Each is judged as it comes in, by what it gains alone, or else after all the others: some show only beside another.
    """
    worse: list[Name] = []
    later: list[Name] = []  # come in behind the others
    while True:
        order, squares, power = _by_gain(problem, start, whitening, joint.causes, [f.name in later for f in named])
        falls = [fall(a, b, named[k].joints) for k, (a, b) in zip(order, pairwise(squares), strict=True)]
        failing = [(one.sure, k) for k, one in zip(order, falls, strict=True) if not one.gains(strict)]
        if not failing:
            gains = [_told(a, b, power, named[k], problem) for k, (a, b) in zip(order, pairwise(squares), strict=True)]
            return Gaining(named, joint, order, gains, _relative(squares[0], squares[-1], power), worse)
        least = min(failing)[1]
        if named[least].name not in later and len(named) > 1:
            later.append(named[least].name)
            continue
        worse.append(named[least].name)
        named = [f for k, f in enumerate(named) if k != least]
        joint = polished(problem, start, [f.effect for f in named], whitening)


def _told(
    before: Float[np.ndarray, "blocks nv"],
    after: Float[np.ndarray, "blocks nv"],
    power: Float[np.ndarray, " nv"],
    one: Found,
    problem: Problem,
) -> Gain:
    """Error of the robot without and with a cause; where it gains less than chance moves that, of the joints where it
    acts."""
    if after.sum() < before.sum():
        return _relative(before, after, power)
    places = list(one.joints)
    names = ", ".join(problem.model.joint_names[k] for k in places)
    own = _relative(before[:, places], after[:, places], power[places])
    return Gain(own.before, own.after, f"relative RMS of {names}")


def _relative(before: np.ndarray, after: np.ndarray, power: np.ndarray) -> Gain:
    first, last = (float(np.sqrt(x.sum() / power.sum())) for x in (before, after))
    return Gain(first, last)


def _by_gain(
    problem: Problem,
    start: State,
    whitening: Float[np.ndarray, "F nv"],
    causes: Sequence[Effect],
    later: Sequence[bool],
) -> tuple[list[int], list[Float[np.ndarray, "blocks nv"]], Float[np.ndarray, " nv"]]:
    """The order of what each cause gains on held-out data as it comes in, those that come `later` behind the others.

    With the squares of the error in that order, and of the torque.
    """
    order = list(range(len(causes)))
    squares, power = held_squares(problem, start, list(causes), whitening)
    drops = [float((before - after).sum()) for before, after in pairwise(squares)]
    ranked = sorted(order, key=lambda k: (later[k], -drops[k]))
    if ranked != order:
        squares, power = held_squares(problem, start, [causes[k] for k in ranked], whitening)
    return ranked, squares, power
