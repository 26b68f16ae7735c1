"""What a contender must pass to be a cause, and what else the data leave possible in its place."""

from __future__ import annotations

import jax
import numpy as np

from ..effects.base import Effect, Parameter
from ..effects.catalogue import find, related
from ..results import Name
from .comparison import Verdicts, overlap, t_value
from .contenders import Contender
from .problem import Problem
from .screening import Screen
from .state import State
from .step import Step
from .thresholds import GAIN, OVERLAP_SAME, SIZE_REGION, T_ALIKE, T_APART, T_BETTER

__all__ = ["ambiguous", "apart", "exists", "gains", "holds", "member", "passes", "physical_sign", "rivals", "simpler"]


def exists(problem: Problem, effect: Effect) -> bool:
    """Whether the data can show such an effect: shapes inside their bounds, forces no larger than any of the joint.

    A wrong sign (`physical_sign`) does not count here: such an effect is no cause, but it may stand in the fit.
    """
    if not effect.shown_by(*problem.reached):
        return False
    if effect.acts_on == "joint":
        joint = int(effect.at[0])
        if not effect.allows(problem.torque[..., joint][np.asarray(problem.records.judged)[..., joint] > 0]):
            return False
    values = {name: float(getattr(effect, name)) for name in effect.parameters()}
    if effect.body and values["mass"] > float(np.asarray(problem.model.inertia)[:, 0].sum()):
        return False
    if not all(_within(effect.parameters()[name], value) for name, value in values.items()):
        return False
    # an offset beside a stiffness is where the spring would rest: the two together are the torque
    shared = {name for inside in type(effect).contains for name in find(inside).parameters()}
    own = {n: p for n, p in effect.parameters().items() if p.linear and n not in shared}
    forces = [abs(values[n]) for n, p in own.items() if p.unit == "N m"]
    if effect.acts_on != "joint" or not forces:
        return True
    # one that passes, or that only slow motion shows, may be larger than the joint's torque on average
    return max(forces) <= np.abs(problem.torque[..., int(effect.at[0])]).max()


def apart(problem: Problem, state: State, effect: Effect) -> bool:
    """Whether one more effect of a place differs enough from the one that is there; whatever is none of that does."""
    first, at = type(effect).one_more_of, np.asarray(effect.at)
    there = [
        jax.tree.map(lambda x, k=k: np.asarray(x)[k], term)
        for term in state.terms
        if first and term.name == first
        for k in np.flatnonzero((np.asarray(term.at) == at).all(1))
    ]
    return all(effect.apart_from(other, *problem.reached) for other in there)


def physical_sign(effect: Effect) -> bool:
    """Whether no parameter has a sign that physics forbids: a rotor of negative inertia, a torque before its time."""
    own = all(float(getattr(effect, name)) >= p.lower for name, p in effect.parameters().items())
    return own and effect.possible()


def _within(parameter: Parameter, value: float) -> bool:
    """Whether a parameter lies in its bounds, whatever its sign; one that enters nonlinearly not against them."""
    if parameter.linear:
        # zero is a bound of the sign, any other one of the size
        return (parameter.lower == 0 or parameter.lower <= value) and value <= parameter.upper
    margin = 1e-3 * abs(value)
    return parameter.choice or parameter.lower + margin < value < parameter.upper - margin


def gains(step: Step, one: Contender) -> bool:
    """Whether the cause predicts what it was not fitted to, at its joints and on the whole: by enough, and surely.

    Where links are held back (`believed`), what is no body must also do so beside links that are not.
    """
    pairs = [(step.verdicts, one.verdicts)] + ([] if one.free is None else [(step.free, one.free)])
    return all(_predicts_better(step, one.joints, before, after) for before, after in pairs)


def _predicts_better(step: Step, joints: tuple[int, ...], before: Verdicts, after: Verdicts) -> bool:
    worse, better = (v.own(step.rows, joints) for v in (before, after))
    gain, surely = 1 - better.sum() / worse.sum(), t_value(worse, better) > T_BETTER
    return bool(gain > GAIN and surely and after.heldout < before.heldout)


def passes(step: Step, contenders: list[Contender], one: Contender) -> bool:
    """Whether the cause predicts what it was not fitted to, and in most of the folds."""
    return gains(step, one) and _recurs(step, contenders, one)


def _recurs(step: Step, contenders: list[Contender], one: Contender) -> bool:
    """Whether the cause is among the best three of its rivals in two thirds of the folds, ranked without the fold.

    A law that holds it at the same place is no rival: where that is better, so may this one be.
    """
    others = [c for c in rivals(step, contenders, one) if not holds(c, one)]
    field = np.stack([c.verdicts.without for c in others] or [one.verdicts.without])
    ranks = (field < one.verdicts.without).sum(0)
    return float(np.mean(ranks < 3)) >= 2 / 3


def simpler(step: Step, contenders: list[Contender], one: Contender) -> list[Contender]:
    """The simpler effects that this one can imitate and that do as well, the best first."""
    kind = type(one.effect)
    inside = [c for c in contenders if c.name.effect in kind.contains and c.name.at == one.name.at]
    like = [c for c in rivals(step, contenders, one) if c.name.effect in kind.resembles and physical_sign(c.effect)]
    return [c for c in (*inside, *like) if member(step, one, c)]


def holds(law: Contender, one: Contender) -> bool:
    """Whether a law holds another one at the same place."""
    return one.name.effect in type(law.effect).contains and law.name.at == one.name.at


def rivals(step: Step, contenders: list[Contender], one: Contender) -> list[Contender]:
    """The others that explain the same misfit; a cause of another misfit is no alternative to this one."""
    others = [c for c in contenders if c is not one]
    return [c for c in others if overlap(step.verdicts, one.verdicts, c.verdicts) > OVERLAP_SAME]


def member(step: Step, best: Contender, other: Contender) -> bool:
    """Whether the data cannot tell the other from the best: held-out blocks and penalised squares alike.

    Of two that resemble each other, one has more numbers to follow a misfit with: squares alone do not tell them apart.
    Where the other has no more numbers and fits all rows as well as the one that predicts better, the two measures
    disagree, which data that tell them apart do not leave. A law inside the other (a spring of no stiffness is an
    offset) is enough where the other's further numbers explain no more than noise.
    """
    worse = t_value(other.verdicts.blocks, best.verdicts.blocks)
    if holds(best, other) and not _needed(best, other):
        return worse < T_APART
    no_more = len(other.effect.parameters()) <= len(best.effect.parameters())
    if no_more and other.verdicts.cost <= best.verdicts.cost:
        return worse < T_APART
    if other.name.effect in type(best.effect).resembles or best.name.effect in type(other.effect).resembles:
        return worse < T_APART
    drop = step.verdicts.cost - best.verdicts.cost
    close = other.verdicts.cost - best.verdicts.cost < max(0.1 * drop, 15)
    return close and worse < T_ALIKE


def _needed(best: Contender, inside: Contender) -> bool:
    """Whether the numbers that a law has beyond one inside it lower the squares by more than noise would."""
    from scipy.special import chdtri  # scipy is slow to import

    more = len(best.effect.parameters()) - len(inside.effect.parameters())
    return more < 1 or inside.verdicts.cost - best.verdicts.cost > chdtri(more, 1 - SIZE_REGION)


def ambiguous(step: Step, best: Contender, rivals: list[Contender], screened: Screen) -> tuple[Name, ...]:
    """What cannot be told from the best: rivals that predict as well, and effects that are the same while moving."""
    names = [c.name for c in rivals if member(step, best, c)]
    clearly_worse = {c.name for c in rivals if t_value(c.verdicts.blocks, best.verdicts.blocks) > T_APART}
    known = {group.name for group in screened.groups}
    same = [Name(effect, best.name.at) for effect in related(best.name.effect, "indistinguishable_from")]
    return (*names, *(n for n in same if n in known and n not in names and n not in clearly_worse))
