"""One cause after another: screening, comparison of the best on held-out folds, until none passes the gates."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect
from ..estimation.noise import Spectrum
from ..estimation.rows import Prior
from ..results import Name
from .comparison import Hypothesis, Verdicts, ground, judge, shares_of_wins, t_value
from .contenders import Contender, contend, for_refit, shortlist
from .design import kind
from .estimates import amplitude_places
from .flexible import friction_width
from .gates import ambiguous, exists, passes, physical_sign, rivals, simpler
from .problem import Problem
from .screening import DRAWS, Null, Screen, catalogue, family_p, screen
from .state import State, with_width
from .step import Step, stand, with_cause, with_causes
from .thresholds import CONFIDENT, GAIN, MOST_CAUSES, MUCH, SMALLEST, TRUSTED

__all__ = ["Found", "Search", "eliminate", "find_causes", "judged_without"]

NEAR, CLOSER = 4, 800  # times the level: p-values below which few draws cannot tell from it; draws that can
LATER = 150  # draws of the null once the first step has given the p-value that is reported


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

    @property
    def nuisance(self) -> bool:
        """Whether physics forbids its sign: it stands in the fit and is no cause."""
        return not physical_sign(self.effect)


class Search(NamedTuple):
    """How a search ended: the problem and the baseline as it sees them, its last step, the causes in order."""

    problem: Problem
    start: State
    step: Step
    found: list[Found]
    p_value: float  # of the whole catalogue before anything was found
    p_left: float  # of the same once the causes were in
    screened: Screen  # the first


def find_causes(
    problem: Problem,
    state: State,
    spectrum: Spectrum,
    whitening: Float[np.ndarray, "F nv"],
    forbid: Collection[str],
    alpha: float,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    generator: np.random.Generator | None = None,
) -> Search:
    """Accept the best cause until none passes the gates, or until noise explains what the catalogue still scores.

    A sensor that is late or that winds up rounds the reversals of dry friction, so that their width is fitted anew
    once such a cause is in: the old one would be made up for by a friction that is not there.
    """
    generator = generator or np.random.default_rng(0)
    step, found = stand(problem, state, whitening), []
    null = Null(problem, spectrum, whitening, generator)
    p_values, screens, screened, groups = [], [], None, None
    while len(found) < MOST_CAUSES:
        progress("screening the catalogue", len(found) / MOST_CAUSES)
        groups = catalogue(problem, step.state, step.rows, whitening, forbid, groups)
        screened = screen(step.rows, step.linear, groups, screened)
        p_values.append(_chance(step, screened, null, alpha, generator, not found))
        screens = screens or [screened]
        if p_values[-1] > alpha:
            break
        progress("comparing causes on held-out data", len(found) / MOST_CAUSES)
        contenders = _contenders(problem, step, screened, whitening)
        best = _best(problem, step, contenders, found)
        if best is None:
            break
        found.append(_found(step, contenders, best, screened, p_values[-1], generator))
        step = with_cause(problem, step, best.effect, whitening)
        if kind(best.effect) != "columns":
            problem = friction_width(problem, step.state, whitening)
            step, groups, screened = stand(problem, with_width(problem, step.state), whitening), None, None
    return Search(problem, with_width(problem, state), step, found, p_values[0], p_values[-1], screens[0])


def _chance(
    step: Step,
    screened: Screen,
    null: Null,
    alpha: float,
    generator: np.random.Generator,
    first: bool,
) -> float:
    """p-value of the whole catalogue, with more draws where few leave it open on which side of `alpha` it lies."""

    def drawn(draws: int) -> float:
        return family_p(step.rows, step.linear, screened, null, generator, draws)

    p = drawn(DRAWS if first else LATER)
    return drawn(CLOSER) if alpha < p < NEAR * alpha else p


def _contenders(
    problem: Problem, step: Step, screened: Screen, whitening: Float[np.ndarray, "F nv"]
) -> list[Contender]:
    """The shortlist with exact shapes, without what cannot exist, the best on held-out data first."""
    base = ground(step.rows, step.verdicts, step.state.prior, step.folded)
    ready = for_refit(problem, step, base, whitening)
    all_of_them = [contend(problem, step, whitening, base, ready, *entry) for entry in shortlist(step, screened)]
    return sorted((c for c in all_of_them if exists(problem, c.effect)), key=lambda c: c.verdicts.heldout)


def _best(problem: Problem, step: Step, contenders: list[Contender], before: list[Found]) -> Contender | None:
    """The cause that predicts best where it was not fitted, if it passes the gates; else nothing.

    Ten free parameters of a link make up for many a misfit: they are a cause only where the inertials are well known,
    and where they are not, what explains the same misfit less well is none either.
    """
    least = SMALLEST * (before[0].cost[0] - before[0].cost[1]) if before else 0.0
    passing = [c for c in contenders if passes(step, contenders, c) and step.verdicts.cost - c.verdicts.cost > least]
    while problem.trust > TRUSTED and passing and passing[0].name.effect == "link_inertia":
        passing = [c for c in passing[1:] if c not in rivals(step, passing, passing[0])]
    return next((c for c in passing if not simpler(step, passing, c)), None)


def _found(
    step: Step, contenders: list[Contender], best: Contender, screened: Screen, p: float, generator: np.random.Generator
) -> Found:
    """The accepted cause with its gain, and with what explains the same misfit as well or nearly so."""
    alike = rivals(step, contenders, best)
    drop = step.verdicts.cost - best.verdicts.cost
    wins = shares_of_wins(np.stack([c.verdicts.blocks for c in [best, *alike]]), generator)
    return Found(
        name=best.name,
        effect=best.effect,
        p_value=p,
        heldout=(step.verdicts.heldout, best.verdicts.heldout),
        cost=(step.verdicts.cost, best.verdicts.cost),
        t=t_value(step.verdicts.blocks, best.verdicts.blocks),
        confidence=float(wins[0]) * (1 - p),
        ambiguous=ambiguous(step, best, alike, screened),
        joints=best.joints,
        alike=tuple(c.name for c in alike if step.verdicts.cost - c.verdicts.cost > MUCH * drop),
    )


def eliminate(problem: Problem, start: State, found: list[Found], whitening: Float[np.ndarray, "F nv"]) -> list[Found]:
    """The causes without those that no longer predict anything once the others are in (earliest first)."""
    if len(found) < 2:
        return found
    full = with_causes(problem, start, [f.effect for f in found], whitening)
    for one in list(found[:-1]):
        without = judged_without(problem, start, full, found, one, whitening)
        worse, better = (v.own(full.rows, one.joints) for v in (without, full.verdicts))
        if 1 - better.sum() / worse.sum() < GAIN or t_value(worse, better) < CONFIDENT:
            found = [f for f in found if f is not one]
            full = with_causes(problem, start, [f.effect for f in found], whitening)
    return found


def judged_without(
    problem: Problem, start: State, full: Step, found: list[Found], one: Found, whitening: Float[np.ndarray, "F nv"]
) -> Verdicts:
    """What the data say of all causes but one."""
    if kind(one.effect) != "columns":
        others = [f.effect for f in found if f is not one]
        return with_causes(problem, start, others, whitening).verdicts
    place = amplitude_places(full.state, [f.effect for f in found], problem.model)[found.index(one)]
    X, prior = np.delete(full.rows.X, place, axis=2), full.state.prior
    fewer = Prior(np.delete(prior.mean, place), np.delete(prior.precision, place))
    return judge(full.rows, Hypothesis(X, fewer))
