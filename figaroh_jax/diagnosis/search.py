"""One cause after another: screening, comparison of the best on held-out folds, until none passes the gates."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..compiled.memory import give_back_holes
from ..effects.base import Effect, exact, place
from ..estimation.noise import Spectrum
from ..estimation.rows import Prior
from ..results import Name
from .believed import believed
from .comparison import Hypothesis, Verdicts, fewer_sums, ground, judge, overlap, shares_of_wins, t_value
from .contenders import Contender, acting, contend, for_refit, next_shape, shortlist
from .design import kind
from .estimates import amplitude_places, with_amplitudes
from .evidence import block_scores
from .flexible import friction_width
from .gates import ambiguous, apart, exists, gains, holds, member, passes, physical_sign, rivals, simpler
from .joint import polished
from .problem import Problem
from .screening import DRAWS, Group, Null, Screen, Shown, catalogue, exact_columns, family_p, place_p, screen
from .state import State, batched, solved, with_width
from .step import Step, stand, with_cause, with_causes
from .thresholds import (
    GAIN,
    MOST_CAUSES,
    MOST_OF_A_GAIN,
    OUTDONE,
    OVERLAP_ELSEWHERE,
    SHARE_AGAIN,
    SHARE_ALIKE,
    SMALLEST,
    T_BETTER,
)

__all__ = [
    "Begun",
    "Found",
    "Rival",
    "Search",
    "at_their_links",
    "chance_beside",
    "eliminate",
    "find_causes",
    "judged_without",
    "stood_without",
    "taken_beside",
]

NEAR, CLOSER = 4, 800  # times the level: p-values below which few draws cannot tell from it; draws that can
BROKEN = 0.02  # of a cause's drop of the squares: where it keeps less of it than the rest, its shape is fitted on
UNSETTLED = 1.02  # times the squares at the end of a search, beyond which its causes, all put in at once, are fitted on
LATER = 150  # draws of the null once the first step has given the p-value that is reported


class Rival(NamedTuple):
    """What cannot be told from a cause, as it would be put in its place."""

    name: Name
    effect: Effect
    joints: tuple[int, ...]


@dataclass(frozen=True)
class Found:
    """A cause that was accepted, and what could not be told from it."""

    name: Name
    effect: Effect
    p_value: float
    heldout: tuple[float, float]  # whitened squares before and after
    cost: tuple[float, float]  # penalised squares before and after
    t: float
    confidence: float
    ambiguous: tuple[Name, ...]
    joints: tuple[int, ...] = ()  # by whose rows it is judged
    alike: tuple[Name, ...] = ()  # what else explains much of the same misfit, though not as well
    instead: tuple[Rival, ...] = ()  # of the `ambiguous` those that were fitted in its place
    outdone: tuple[Rival, ...] = ()  # what could be named in its place and predicts better in nearly all draws
    share: float = 0.0  # of the held-out squares of its joints, as it came in

    def as_another(self, other: Rival, alike: Iterable[Name]) -> Found:
        """The same cause by another's name, effect and joints; `alike` is what then cannot be told from it."""
        known = tuple(name for name in alike if name != other.name)
        own = {"name": other.name, "effect": other.effect, "joints": other.joints}
        return replace(self, **own, ambiguous=known, outdone=())


class Search(NamedTuple):
    """How a search ended: the problem and the baseline as it sees them, the causes in order."""

    problem: Problem
    start: State  # with the coefficients that it has beside all causes
    found: list[Found]
    p_value: float  # of the whole catalogue before anything was found
    p_left: float  # of the same once the causes were in
    shown: list[Shown]  # candidates, as the first screen saw them
    blocks: Float[np.ndarray, " blocks"]  # held-out whitened squares with the causes in


class Begun(NamedTuple):
    """What a search takes over from one of other effects: the first causes of it, and what it began with."""

    found: list[Found]
    p_value: float
    shown: list[Shown]


def find_causes(
    problem: Problem,
    state: State,
    spectrum: Spectrum,
    whitening: Float[np.ndarray, "F nv"],
    forbid: Collection[str],
    alpha: float,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    generator: np.random.Generator | None = None,
    after: Begun | None = None,
    enough: Callable[[list[Found]], bool] = lambda found: False,
) -> Search:
    """Accept the best cause until none passes the gates, or until noise explains what the catalogue still scores.

    `after` is what it takes over from another one. It ends once there are `enough`.

    A sensor that is late or that winds up rounds the reversals of dry friction, so that their width is fitted anew
    once such a cause is in: the old one would be made up for by a friction that is not there. What follows all torque
    finds another one once it is in (`_refreshed`).
    """
    generator = generator or np.random.default_rng(0)
    if after is None:
        step, found, p_values, shown = stand(problem, state, whitening), [], [], []
    else:
        step = with_causes(problem, state, [f.effect for f in after.found], whitening)
        found, p_values, shown = list(after.found), [after.p_value], after.shown
    null = Null(problem, spectrum, whitening, generator)
    screened, groups, turned = None, None, ()
    failed: dict[Name, float] = {}  # share of its joints' squares that a candidate scored when it last failed
    fitted: dict[Name, Effect] = {}  # position sensors as they were last fitted exactly
    while len(found) < MOST_CAUSES and not (found and enough(found)):
        progress("screening the catalogue", 0.1 + 0.7 * len(found) / MOST_CAUSES)
        groups, turned = catalogue(problem, step.state, step.rows, whitening, forbid, groups, turned), ()
        screened = screen(step.rows, step.linear, groups, screened)
        p_values.append(_chance(step, screened, null, alpha, generator, not found))
        shown = shown or screened.shown()
        if p_values[-1] > alpha:
            break
        progress("comparing causes on held-out data", 0.1 + 0.7 * len(found) / MOST_CAUSES)
        contenders = _contenders(problem, step, screened, whitening, failed, fitted)
        contenders = [c for c in contenders if not _told_already(c, found)]
        chosen = _chosen(problem, step, contenders, found, alpha / len(groups))
        if not chosen:
            break
        chosen = chosen[: MOST_CAUSES - len(found)]
        found += [_found(problem, step, contenders, best, screened, p_values[-1], generator) for best in chosen]
        effects = [best.effect for best in chosen]
        ways = {"late" if effect.about else kind(effect) for effect in effects}
        promised = (1 - BROKEN) * chosen[0].verdicts.cost + BROKEN * step.verdicts.cost
        promised = promised if len(chosen) == 1 else np.inf
        del contenders, chosen  # what they leave of every row is large
        for effect in effects:
            step = with_cause(problem, step, effect, whitening)
        if ways != {"columns"}:
            give_back_holes()
            known, problem, screened = problem, friction_width(problem, step.state, whitening), None
            groups, turned = (
                None if "response" in ways else groups,
                np.flatnonzero(problem.width != known.width).tolist(),
            )
            step = step if problem is known else stand(problem, with_width(problem, step.state), whitening)
        if any(type(f.effect).follows_total for f in found):
            screened = None
            found, step = _refreshed(problem, state, step, found, whitening, promised)
    begun = solved(with_width(problem, state), step.state.theta[: len(state.theta)])
    return Search(problem, begun, found, p_values[0], p_values[-1], shown, step.verdicts.blocks)


def chance_beside(
    problem: Problem,
    step: Step,
    spectrum: Spectrum,
    whitening: Float[np.ndarray, "F nv"],
    forbid: Collection[str],
    generator: np.random.Generator,
) -> float:
    """p-value of the whole catalogue beside the causes of a step."""
    screened = screen(step.rows, step.linear, catalogue(problem, step.state, step.rows, whitening, forbid))
    null = Null(problem, spectrum, whitening, generator)
    return family_p(step.rows, step.linear, screened, null, generator, LATER)


def _refreshed(
    problem: Problem,
    start: State,
    step: Step,
    found: list[Found],
    whitening: Float[np.ndarray, "F nv"],
    promised: float,
) -> tuple[list[Found], Step]:
    """The causes, and the step with what follows all torque together evaluated at that of all causes so far.

    Where its penalised squares are then more than the last cause `promised` (a limit is in and finds clipped torque),
    all shapes are fitted on.
    """
    begun = solved(with_width(problem, start), step.state.theta[: len(start.theta)])
    causes = [exact(one) for one in with_amplitudes(step.state, [f.effect for f in found])]
    found = [replace(f, effect=e) for f, e in zip(found, causes, strict=True)]
    step = with_causes(problem, begun, causes, whitening)
    if step.verdicts.cost <= promised:
        return found, step
    base = solved(begun, step.state.theta[: len(start.theta)])
    joint = polished(problem, base, [f.effect for f in found], whitening)
    return [replace(f, effect=e) for f, e in zip(found, joint.causes, strict=True)], joint.step


def _chance(
    step: Step,
    screened: Screen,
    null: Null,
    alpha: float,
    generator: np.random.Generator,
    first: bool,
) -> float:
    """p-value of the whole catalogue, with more draws where few leave it open on which side of `alpha` it lies.

    Once causes are in, each place is asked for itself too: what one joint leaves must not hide another's.
    """

    if not screened.scores:
        return 1.0
    parts = block_scores(step.rows, step.linear, screened.stock, screened.H)

    def drawn(draws: int) -> float:
        return family_p(step.rows, step.linear, screened, null, generator, draws, parts)

    p = drawn(DRAWS if first else LATER)
    if alpha < p < NEAR * alpha:
        p = drawn(CLOSER)
    return p if first or p <= alpha else min(p, place_p(screened, parts, generator))


def _contenders(
    problem: Problem,
    step: Step,
    screened: Screen,
    whitening: Float[np.ndarray, "F nv"],
    failed: dict[Name, float],
    fitted: dict[Name, Effect],
) -> list[Contender]:
    """The shortlist with exact shapes, without what cannot exist, the best on held-out data first.

    A candidate that has failed is tried again where it scores more of what its joints leave than it did then.
    """
    base = ground(step.verdicts, step.state.prior, step.folded)
    ready, squares, out = for_refit(problem, step, base, whitening), (step.verdicts.error**2).sum(1), []
    for group, order, score in shortlist(step, screened):
        share = score / squares[list(acting(group.effect, len(squares), group.columns.joints))].sum()
        if share <= SHARE_AGAIN * failed.get(group.name, 0.0):
            continue
        one = contend(problem, step, whitening, base, ready, group, order, fitted)
        if not exists(problem, one.effect) and len(order := next_shape(group, one)):
            one = contend(problem, step, whitening, base, ready, group, order, fitted)
        if exists(problem, one.effect) and apart(problem, step.state, one.effect):
            out.append(one)
        else:
            fitted.pop(group.name, None)
            failed[group.name] = share
        if not gains(step, one):
            failed[group.name] = share
    return sorted(out, key=lambda c: c.verdicts.heldout)


def _told_already(one: Contender, found: list[Found]) -> bool:
    """Whether a cause is one found before, at another place from which the data could not tell it.

    Beside that one it would take what little they differ by, and in the end its place.
    """
    return any(one.name in f.ambiguous and one.name.effect == f.name.effect for f in found)


def _chosen(
    problem: Problem, step: Step, contenders: list[Contender], before: list[Found], chance: float
) -> list[Contender]:
    """The best cause, and the best of other joints that explain another misfit.

    The p-value of the step is that of the first. Each of the others must lower the squares by more than a candidate
    does by `chance`, or it waits for a step of its own.
    """
    first = _best(problem, step, contenders, before)
    if first is None:
        return []
    chosen = [first]
    while first.effect.acts_on in ("joint", "pair") and kind(first.effect) == "columns":
        free = [c for c in contenders if all(_apart(step, c, one) for one in chosen) and _shows(step, c, chance)]
        other = _best(problem, step, free, before)
        if other is None:
            break
        chosen.append(other)
    return chosen


def _shows(step: Step, one: Contender, chance: float) -> bool:
    """Whether it lowers the squares by more than so many numbers do of noise with that chance."""
    from scipy.special import chdtri  # scipy is slow to import

    return step.verdicts.cost - one.verdicts.cost > chdtri(len(one.effect.parameters()), chance)


def _apart(step: Step, one: Contender, other: Contender) -> bool:
    """Whether a cause acts at other joints than another one and changes another part of the residual."""
    local = one.effect.acts_on in ("joint", "pair") and kind(one.effect) == "columns"
    elsewhere = local and not set(one.joints) & set(other.joints)
    return elsewhere and abs(overlap(step.verdicts, one.verdicts, other.verdicts)) < OVERLAP_ELSEWHERE


def _best(problem: Problem, step: Step, contenders: list[Contender], before: list[Found]) -> Contender | None:
    """The cause that predicts best where it was not fitted, if it passes the gates; else nothing.

    Some effects make up for many a misfit where the inertials are not well known (`Effect.needs_trust`): there they are
    no cause, and what explains the same misfit less well is none either.
    """
    least = SMALLEST * (before[0].cost[0] - before[0].cost[1]) if before else 0.0
    passing = [c for c in contenders if passes(step, contenders, c) and step.verdicts.cost - c.verdicts.cost > least]
    while passing and problem.trust > passing[0].effect.needs_trust:
        passing = [c for c in passing[1:] if c not in rivals(step, passing, passing[0])]
    for one in passing:
        instead = simpler(step, passing, one)
        if not instead:
            return one
        if type(one.effect).resembles:
            return instead[0]
    return None


def _found(
    problem: Problem,
    step: Step,
    contenders: list[Contender],
    best: Contender,
    screened: Screen,
    p: float,
    generator: np.random.Generator,
) -> Found:
    """The accepted cause with its gain, and with what explains the same misfit as well or nearly so."""
    alike = rivals(step, contenders, best)
    drop = step.verdicts.cost - best.verdicts.cost
    open_to = ambiguous(step, best, alike, screened)
    wins = shares_of_wins(np.stack([c.verdicts.blocks for c in [best, *alike]]), generator)
    # what holds this one, and need not: where it wins, this one has won
    outer = np.array([holds(c, best) or _takes_most(step, best, c) for c in alike], bool)
    own = float(wins[0] + wins[1:][outer].sum())
    # where the links are not well known, those that they can stand for are no names
    apart = np.array([problem.trust <= c.effect.needs_trust and physical_sign(c.effect) for c in alike], bool)
    better = [c for c, win, a, o in zip(alike, wins[1:], apart, outer, strict=True) if a and not o and win > 0]
    outdone = own < OUTDONE * (own + wins[1:][apart & ~outer].sum())
    before, after = (v.own(step.rows, best.joints) for v in (step.verdicts, best.verdicts))
    return Found(
        name=best.name,
        effect=best.effect,
        p_value=p,
        heldout=(step.verdicts.heldout, best.verdicts.heldout),
        cost=(step.verdicts.cost, best.verdicts.cost),
        t=t_value(step.verdicts.blocks, best.verdicts.blocks),
        confidence=own * (1 - p),
        ambiguous=open_to,
        joints=best.joints,
        alike=tuple(c.name for c in alike if step.verdicts.cost - c.verdicts.cost > SHARE_ALIKE * drop),
        instead=tuple(Rival(c.name, c.effect, c.joints) for c in alike if c.name in open_to),
        outdone=tuple(Rival(c.name, c.effect, c.joints) for c in better) if outdone else (),
        share=1 - float(after.sum() / before.sum()),
    )


def _takes_most(step: Step, best: Contender, rival: Contender) -> bool:
    """Whether a joint's cause gains most of what a body in its place does.

    A link's ten numbers hold the inertia of a rotor at its joint, and follow what else goes with the link's motion:
    what it predicts better by these is another misfit.
    """
    gain, most = (step.verdicts.heldout - c.verdicts.heldout for c in (best, rival))
    return best.effect.acts_on == "joint" and rival.effect.body and gain > MOST_OF_A_GAIN * most


def eliminate(
    problem: Problem, start: State, found: list[Found], whitening: Float[np.ndarray, "F nv"]
) -> tuple[list[Found], list[tuple[Found, float]]]:
    """The causes without those that no longer predict anything once the others are in, the least of them first; and
    those, each with the share of its joints' held-out squares that it took beside the others.

    One that came in last may make an earlier one needless and be the lesser of the two: which of them goes must not
    hang on their order.
    """
    gone: list[tuple[Found, float]] = []
    if len(found) < 2:
        return found, gone
    full = _all_in(problem, start, found, whitening)
    asked = list(found)
    while len(found) > 1:
        taken = [taken_beside(problem, start, full, found, one, whitening) for one in asked]
        needs = [min(share / GAIN, t / T_BETTER) for share, t in taken]
        needless = sorted((need, k) for k, need in enumerate(needs) if need < 1)
        if not needless:
            break
        gone.append((asked[needless[0][1]], taken[needless[0][1]][0]))
        asked = [asked[k] for _, k in needless]
        found, asked = [f for f in found if f is not asked[0]], asked[1:]
        del full  # its rows and columns are large
        full = _all_in(problem, start, found, whitening)
    problem.begun.clear()  # and so are theirs
    del full
    give_back_holes()
    return found, gone


def at_their_links(
    problem: Problem, start: State, found: list[Found], whitening: Float[np.ndarray, "F nv"]
) -> list[Found]:
    """The causes, each change of a link's inertia at the next link where it fits and predicts better; and with the next
    link among what cannot be told from it where that does as well.

    One that came in before others was judged beside all that they explain, which may hide at which of two links it is.
    """
    for one in [f for f in found if f.effect.inertial]:
        step = stood_without(problem, start, found, one, whitening)
        here, *others = _at_links(problem, step, one, whitening)
        free = [c for c in others if c.name not in [f.name for f in found] and exists(problem, c.effect)]
        better = [
            c for c in free if c.verdicts.cost < here.verdicts.cost and c.verdicts.heldout < here.verdicts.heldout
        ]
        best = min(better, key=lambda c: c.verdicts.heldout, default=here)
        alike = [c for c in (here, *free) if c is not best and member(step, best, c)]
        if best is not here:
            same = [Name(name.effect, best.name.at) for name in one.ambiguous if name.at == one.name.at]
            told = one.as_another(Rival(best.name, best.effect, best.joints), [*(c.name for c in alike), *same])
        else:
            new = [c for c in alike if c.name not in one.ambiguous]
            instead = (*one.instead, *(Rival(c.name, c.effect, c.joints) for c in new))
            told = replace(one, ambiguous=(*one.ambiguous, *(c.name for c in new)), instead=instead)
        found = [told if f is one else f for f in found]
    return found


def _at_links(problem: Problem, step: Step, one: Found, whitening: Float[np.ndarray, "F nv"]) -> list[Contender]:
    """A change of a link's inertia at its link, and at those that a joint connects to it."""
    joints, own = problem.model.joints, int(np.ravel(one.effect.at)[0])
    base = ground(step.verdicts, step.state.prior, step.folded)
    ready, out = for_refit(problem, step, base, whitening), []
    for link in [own, *(k for k, joint in enumerate(joints) if k == joints[own].parent or joint.parent == own)]:
        name = Name(one.name.effect, (problem.model.link_names[link],))
        effect = place(type(one.effect), problem.model, name.at)
        group = Group(name, batched(effect), exact_columns(problem, step.state, step.rows, whitening, effect))
        out.append(contend(problem, step, whitening, base, ready, group, np.zeros(1, int), {}))
    return out


def _all_in(problem: Problem, start: State, found: list[Found], whitening: Float[np.ndarray, "F nv"]) -> Step:
    """All causes at once, as the search left them.

    Drives at their limit clip the torque of all other causes, and find other rows to clip each time that is evaluated:
    where one step leads away from where the search ended, they are fitted on from there.
    """
    full = with_causes(problem, start, [f.effect for f in found], whitening, keep=True)
    if full.state.cut is None or full.verdicts.cost <= UNSETTLED * found[-1].cost[1]:
        return full
    settled = polished(problem, start, [f.effect for f in found], whitening).step
    return settled if settled.verdicts.cost < full.verdicts.cost else full


def taken_beside(
    problem: Problem, start: State, full: Step, found: list[Found], one: Found, whitening: Float[np.ndarray, "F nv"]
) -> tuple[float, float]:
    """Share of the held-out squares of its joints that a cause takes beside all others, and the t of that."""
    without = judged_without(problem, start, full, found, one, whitening)
    worse, better = (v.own(full.rows, one.joints) for v in (without, full.verdicts))
    return 1 - float(better.sum() / worse.sum()), t_value(worse, better)


def judged_without(
    problem: Problem, start: State, full: Step, found: list[Found], one: Found, whitening: Float[np.ndarray, "F nv"]
) -> Verdicts:
    """What the data say of all causes but one."""
    if kind(one.effect) != "columns" or one.effect.has("through"):
        about = start, whitening, *(f.effect for f in found if f is not one)
        known = problem.judged.get(*about)
        return known or problem.judged.put(stood_without(problem, start, found, one, whitening).verdicts, *about)
    place = amplitude_places(full.state, [f.effect for f in found])[found.index(one)]
    prior, kept = full.state.prior, np.delete(np.arange(len(full.state.theta)), place)
    fewer = believed(problem, Prior(prior.mean[kept], prior.precision[kept]), fewer_sums(full.folded, place))
    precision = prior.precision.copy()
    precision[kept] = fewer.precision
    return judge(full.rows, Hypothesis(full.rows.X, Prior(prior.mean, precision)), full.folded, place)


def stood_without(
    problem: Problem, start: State, found: list[Found], one: Found, whitening: Float[np.ndarray, "F nv"]
) -> Step:
    """All causes but one, each as the search found it."""
    return with_causes(problem, start, [f.effect for f in found if f is not one], whitening)
