"""What a contender must pass to be a cause, and what else the data leave possible in its place."""

from __future__ import annotations

import numpy as np

from ..effects.base import Effect, Parameter
from ..effects.catalogue import related
from ..results import Name
from .comparison import overlap, t_value
from .contenders import Contender
from .problem import Problem
from .screening import Screen
from .step import Step

__all__ = ["CONFIDENT", "GAIN", "ambiguous", "exists", "passes", "rivals", "simpler"]

GAIN, CONFIDENT, UNSURE = 0.004, 1.64, 1.7
SAME = 0.5  # overlap from which two causes explain the same misfit
CLEARLY = 3.0  # t from which data tell effects apart that are the same while the joint moves


def exists(problem: Problem, effect: Effect) -> bool:
    """Whether such an effect can exist and be seen: amplitudes in bounds, forces no larger than the joint's torque."""
    position = np.asarray(problem.records.position)
    if not effect.shown_by(position.min((0, 1)), position.max((0, 1))):
        return False
    values = {name: float(getattr(effect, name)) for name in effect.parameters()}
    if effect.body and values["mass"] > float(np.asarray(problem.model.inertia)[:, 0].sum()):
        return False
    if not all(_within(effect.parameters()[name], value) for name, value in values.items()):
        return False
    forces = [abs(values[n]) for n, p in effect.parameters().items() if p.linear and p.unit == "N m"]
    if effect.acts_on != "joint" or not forces:
        return True
    return max(forces) <= np.sqrt((problem.torque[..., int(effect.at[0])] ** 2).mean())


def _within(parameter: Parameter, value: float) -> bool:
    """Whether a parameter lies in its bounds; one that enters nonlinearly must not lean against them."""
    if parameter.linear:
        return parameter.lower <= value <= parameter.upper
    margin = 1e-3 * abs(value)
    return parameter.choice or parameter.lower + margin < value < parameter.upper - margin


def passes(step: Step, contenders: list[Contender], one: Contender) -> bool:
    """Whether the cause predicts what it was not fitted to: by enough, surely, and in most of the folds."""
    gain = 1 - one.verdicts.heldout / step.verdicts.heldout
    surely = t_value(step.verdicts.blocks, one.verdicts.blocks) > CONFIDENT
    return gain > GAIN and surely and _recurs(step, contenders, one)


def _recurs(step: Step, contenders: list[Contender], one: Contender) -> bool:
    """Whether the cause is among the best three of its rivals in two thirds of the folds, ranked without the fold."""
    field = np.stack([c.verdicts.without for c in rivals(step, contenders, one)] or [one.verdicts.without])
    ranks = (field < one.verdicts.without).sum(0)
    return float(np.mean(ranks < 3)) >= 2 / 3


def simpler(step: Step, contenders: list[Contender], one: Contender) -> bool:
    """Whether an effect that this one contains does as well."""
    inside = [c for c in contenders if c.name.effect in type(one.effect).contains and c.name.at == one.name.at]
    return any(_member(step, one, c) for c in inside)


def rivals(step: Step, contenders: list[Contender], one: Contender) -> list[Contender]:
    """The others that explain the same misfit; a cause of another misfit is no alternative to this one."""
    others = [c for c in contenders if c is not one]
    return [c for c in others if overlap(step.verdicts, one.verdicts, c.verdicts) > SAME]


def _member(step: Step, best: Contender, other: Contender) -> bool:
    """Whether the data cannot tell the other from the best: held-out blocks and penalised squares alike."""
    drop = step.verdicts.cost - best.verdicts.cost
    close = other.verdicts.cost - best.verdicts.cost < max(0.1 * drop, 15)
    return close and t_value(other.verdicts.blocks, best.verdicts.blocks) < UNSURE


def ambiguous(step: Step, best: Contender, rivals: list[Contender], screened: Screen) -> tuple[Name, ...]:
    """What cannot be told from the best: rivals that predict as well, and effects that are the same while moving."""
    names = [c.name for c in rivals if _member(step, best, c)]
    clearly_worse = {c.name for c in rivals if t_value(c.verdicts.blocks, best.verdicts.blocks) > CLEARLY}
    known = {group.name for group in screened.groups}
    same = [Name(effect, best.name.at) for effect in related(best.name.effect, "indistinguishable_from")]
    return (*names, *(n for n in same if n in known and n not in names and n not in clearly_worse))
