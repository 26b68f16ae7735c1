"""One cause after another: shortlist, exact refit, comparison on held-out folds, gates, ambiguity set."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float

from ..effect import Effect
from ..effects import Payload
from ..results import Name
from .comparison import (
    FoldSums,
    Ground,
    Hypothesis,
    Verdicts,
    fold_sums,
    ground,
    grown_sums,
    judge,
    judge_grown,
    overlap,
    shares_of_wins,
    t_value,
)
from .design import kind, shapes, with_shape
from .estimates import amplitude_places, torque_slope
from .evidence import Linear, Prior, Rows, fit
from .noise import Spectrum
from .problem import Problem, State, extended_state, physical_body, solved, whitened
from .refit import Whitened, refit, refit_shift
from .screening import DRAWS, Group, Screen, catalogue, family_p, screen

__all__ = ["Found", "Step", "find_causes", "stand"]

SHORTLIST, SHARE = 8, 0.35  # candidates compared exactly; share of the best rank that they need
SHIFTS = 2  # candidates of a position sensor tried at a step: each is a fit of its own
TURNS, RESPONSE_TURNS = 3, 6  # of Gauss-Newton on a shift of the position; on a response of the torque
STARTS = 4  # of a refit
GAIN, CONFIDENT, UNSURE = 0.004, 1.64, 1.7
SAME = 0.5  # overlap from which two causes explain the same misfit
MUCH = 0.5  # share of the best's drop from which another cause explains much of the same
CLEARLY = 3.0  # t from which data tell effects apart that are the same while the joint moves
EXACT = ({"torque_offset", "asymmetric_coulomb_friction"}, {"payload", "link_inertia"})
SMALLEST = 0.005  # share of the first cause's drop below which a later one may be what the first left over
TRUSTED = 0.05  # of the inertials, relative: up to it a link's own inertia may be the cause
MOST = 12
NEAR, CLOSER = 4, 800  # times the level: p-values below which few draws cannot tell from it; draws that can
LATER = 150  # draws of the null once the first step has given the p-value that is reported


@dataclass(frozen=True)
class Contender:
    """A candidate with its exact shape, the model of the data with it in, and what the data say of that."""

    name: Name
    effect: Effect
    verdicts: Verdicts


@dataclass(frozen=True)
class Found:
    """A cause that was accepted, and what could not be told from it."""

    name: Name
    effect: Effect
    p_value: float
    heldout: tuple[float, float]  # whitened squares before and after
    cost: tuple[float, float]
    t: float
    confidence: float
    ambiguous: tuple[Name, ...]
    alike: tuple[Name, ...] = ()  # what else explains much of the same misfit, though not as well


@dataclass(frozen=True)
class Step:
    """Where a search stands: the state, its rows and fit."""

    state: State
    rows: Rows
    linear: Linear
    verdicts: Verdicts
    folded: FoldSums


def stand(problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"], before: Step | None = None) -> Step:
    """Rows, fit and held-out squares of a state; the state comes back with its coefficients.

    `before` is where the search stood when this state has grown out of it.
    """
    shared = before.rows if before is not None and len(before.state.sensors) == len(state.sensors) else None
    rows = whitened(problem, state, whitening, shared)
    folded = fold_sums(rows, rows.X) if before is None or shared is None else grown_sums(rows, before.folded, rows.X)
    linear = fit(rows, state.prior, folded.gram.sum(0))
    verdicts = judge(rows, Hypothesis(rows.X, state.prior), folded)
    return Step(solved(problem, state, verdicts.theta), rows, linear, verdicts, folded)


def contend(
    problem: Problem,
    step: Step,
    whitening: Float[np.ndarray, "F nv"],
    base: Ground,
    ready: Whitened,
    group: Group,
    order: np.ndarray,
) -> Contender:
    """The candidate with its exact shape, started from its best grid points."""
    way = kind(group.effect)
    if way == "response":
        first = jax.tree.map(lambda x: x[order[0]], group.effect)
        return _sensor_contender(problem, step, whitening, group, first, RESPONSE_TURNS)
    if way == "position":
        return _position_contender(problem, step, whitening, ready, group)
    starts = np.resize(order, STARTS)
    if shapes(type(group.effect)):
        effects = jax.tree.map(lambda x: x[starts], group.effect)
        effect, Z = refit(effects, step.state.motion, problem.records, ready)
        Z = Z.reshape(*Z.shape[:2], -1)
    else:
        effect = jax.tree.map(lambda x: x[starts[0]], group.effect)
        Z = group.columns.Z[starts[0]]
    joints = list(group.columns.joints)
    if isinstance(effect, Payload):
        effect, verdicts = _body_verdicts(step, base, effect, Z)
    else:
        verdicts = judge_grown(step.rows, base, joints, Z)
        names = [n for n, p in effect.parameters().items() if p.linear]
        effect = with_shape(effect, names, list(verdicts.theta[-len(names) :]))
    return Contender(group.name, effect, verdicts)


def _body_verdicts(
    step: Step, base: Ground, effect: Payload, Z: Float[np.ndarray, "10 nv T"]
) -> tuple[Payload, Verdicts]:
    """A payload with the parameters of the nearest body that can exist."""
    rows, full = step.rows, np.moveaxis(Z, 0, 2)
    free = judge_grown(rows, base, range(len(rows.y)), Z)
    body = physical_body(free.theta[-10:], _information(rows, base, full))
    verdicts = judge(rows, Hypothesis(rows.X, step.state.prior, full @ body))
    return with_shape(effect, list(effect.parameters()), list(body)), verdicts


def _position_contender(
    problem: Problem, step: Step, whitening: Float[np.ndarray, "F nv"], ready: Whitened, group: Group
) -> Contender:
    """A shift of the links' motion: its size by the profile, then with the regressor and the load at the true motion.

    The load that the profile knows is that of a fit without the effect.
    """
    Z = group.columns.Z[:, 0]
    effect = refit_shift(group.effect, Z, step.state.motion, problem.records, ready)
    return _sensor_contender(problem, step, whitening, group, effect, TURNS)


def _information(rows: Rows, base: Ground, Z: Float[np.ndarray, "nv T k"]) -> Float[np.ndarray, "k k"]:
    """Z'Z with the current model projected out: the precision of the columns' coefficients."""
    tall, X = Z.reshape(-1, Z.shape[2]), rows.X.reshape(-1, rows.X.shape[2])
    cross = X.T @ tall
    return tall.T @ tall - cross.T @ base.inverse[-1] @ cross


def _for_refit(problem: Problem, step: Step, base: Ground, whitening: Float[np.ndarray, "F nv"]) -> Whitened:
    """What the refits of a step need."""
    n, _, count, nv = problem.records.shape
    residual = step.verdicts.residual.reshape(nv, n, count)
    response = whitening * step.state.response(problem.records.omega)[:, None]
    return Whitened(residual, step.rows.X.reshape(nv, n, count, -1), base.inverse[-1], response)


def _sensor_contender(
    problem: Problem, step: Step, whitening: Float[np.ndarray, "F nv"], group: Group, effect: Effect, turns: int
) -> Contender:
    """Gauss-Newton on the one parameter of a sensor effect, all coefficients fitted anew each time."""
    ((name, parameter),) = effect.parameters().items()
    base = step.state
    for _ in range(turns):
        here = stand(problem, extended_state(problem, base, effect), whitening)
        slope = torque_slope(problem, here.state, effect, name, whitening)
        X = np.concatenate([here.rows.X, slope[..., None]], axis=2)
        theta = judge(here.rows, Hypothesis(X, here.state.prior.extended(1))).theta
        value = float(np.clip(float(getattr(effect, name)) + theta[-1], parameter.lower, parameter.upper))
        done = abs(value - float(getattr(effect, name))) < 1e-7
        effect = with_shape(effect, [name], [np.float64(value)])
        if kind(effect) == "position":
            base = solved(problem, step.state, theta[:-1])
        elif done:
            break
    here = stand(problem, extended_state(problem, base, effect), whitening)
    return Contender(group.name, effect, here.verdicts)


def shortlist(step: Step, found: Screen) -> list[tuple[Group, np.ndarray]]:
    """The best groups, each with its grid points in the order of their scores."""
    ranked = found.best(step.rows)
    shifts = [r for r in ranked if kind(found.groups[r[1]].effect) == "position"]
    ranked = [r for r in ranked if r not in shifts[SHIFTS:]]
    chosen = [r for r in ranked[:SHORTLIST] if r[0] > SHARE * ranked[0][0]] or ranked[:1]
    simpler = {Name(n, found.groups[g].name.at) for _, g, _ in chosen for n in type(found.groups[g].effect).contains}
    chosen += [r for r in ranked if found.groups[r[1]].name in simpler and r not in chosen]
    return [(found.groups[g], np.argsort(-found.scores[g].Q)) for _, g, _ in chosen]


def find_causes(
    problem: Problem,
    state: State,
    spectrum: Spectrum,
    whitening: Float[np.ndarray, "F nv"],
    forbid: Collection[str],
    alpha: float,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    generator: np.random.Generator | None = None,
) -> tuple[Step, list[Found], tuple[float, float], Screen]:
    """Accept the best cause until none passes the gates.

    Answers the last step, the causes, the p-values of the whole catalogue at the first and the last step, and the
    first screen.
    """
    generator = generator or np.random.default_rng(0)
    step, found = stand(problem, state, whitening), []
    first_p, p, first_screen, screened, groups = 1.0, 1.0, None, None, None
    while len(found) < MOST:
        progress("screening the catalogue", len(found) / MOST)
        groups = catalogue(problem, step.state, step.rows, whitening, forbid, groups)
        screened = screen(step.rows, step.linear, groups, screened)
        draws = DRAWS if first_screen is None else LATER
        p = family_p(problem, step.rows, step.linear, screened, spectrum, whitening, generator, draws)
        if alpha < p < NEAR * alpha:
            p = family_p(problem, step.rows, step.linear, screened, spectrum, whitening, generator, CLOSER)
        if first_screen is None:
            first_p, first_screen = p, screened
        if p > alpha:
            break
        progress("comparing causes on held-out data", len(found) / MOST)
        accepted = _accept(problem, step, screened, whitening, p, generator, found)
        if accepted is None:
            break
        step = _with(problem, step, accepted.effect, whitening)
        groups, screened = (groups, screened) if kind(accepted.effect) == "columns" else (None, None)
        found.append(accepted)
    assert first_screen is not None  # the loop has run at least once
    return step, found, (first_p, p), first_screen


def _with(problem: Problem, step: Step, effect: Effect, whitening: Float[np.ndarray, "F nv"]) -> Step:
    """The search with one more cause; a shift of the position follows the load of the fit that it stands in."""
    grown = stand(problem, extended_state(problem, step.state, effect), whitening, step)
    if kind(effect) != "position":
        return grown
    base = solved(problem, step.state, grown.state.theta)
    return stand(problem, extended_state(problem, base, effect), whitening)


def eliminate(problem: Problem, start: State, found: list[Found], whitening: Float[np.ndarray, "F nv"]) -> list[Found]:
    """The causes without those that no longer predict anything once the others are in (earliest first)."""
    if len(found) < 2:
        return found
    full = _stand_with(problem, start, found, whitening)
    for one in list(found[:-1]):
        others = [f for f in found if f is not one]
        if kind(one.effect) == "columns":
            place = amplitude_places(full.state, [f.effect for f in found], problem.model)[found.index(one)]
            X, prior = np.delete(full.rows.X, place, axis=2), full.state.prior
            fewer = Prior(np.delete(prior.mean, place), np.delete(prior.precision, place))
            without = judge(full.rows, Hypothesis(X, fewer))
        else:
            without = _stand_with(problem, start, others, whitening).verdicts
        gain = 1 - full.verdicts.heldout / without.heldout
        if gain < GAIN or t_value(without.blocks, full.verdicts.blocks) < CONFIDENT:
            found, full = others, _stand_with(problem, start, others, whitening)
    return found


def _stand_with(problem: Problem, start: State, found: list[Found], whitening: Float[np.ndarray, "F nv"]) -> Step:
    """All causes in at once (sensor effects see the torque of the baseline and of the causes before them)."""
    state = start
    for one in found:
        if kind(one.effect) != "columns":
            state = stand(problem, state, whitening).state
        state = extended_state(problem, state, one.effect)
    return stand(problem, state, whitening)


def _accept(
    problem: Problem,
    step: Step,
    screened: Screen,
    whitening: Float[np.ndarray, "F nv"],
    p: float,
    generator: np.random.Generator,
    before: list[Found],
) -> Found | None:
    """The cause that predicts best where it was not fitted, if it passes the gates; else nothing.

    Ten free parameters of a link make up for many a misfit: they are a cause only where the inertials are well known,
    and where they are not, what explains the same misfit less well is none either.
    """
    base = ground(step.rows, step.verdicts, step.state.prior, step.folded)
    ready = _for_refit(problem, step, base, whitening)
    contenders = [contend(problem, step, whitening, base, ready, *entry) for entry in shortlist(step, screened)]
    contenders = [c for c in contenders if _exists(problem, c.effect)]
    contenders.sort(key=lambda c: c.verdicts.heldout)
    least = SMALLEST * (before[0].cost[0] - before[0].cost[1]) if before else 0.0
    passing = [c for c in contenders if _passes(step, contenders, c) and step.verdicts.cost - c.verdicts.cost > least]
    while problem.trust > TRUSTED and passing and passing[0].name.effect == "link_inertia":
        passing = [c for c in passing[1:] if c not in _rivals(step, passing, passing[0])]
    best = next((c for c in passing if not _simpler(step, passing, c)), None)
    if best is None:
        return None
    rivals = _rivals(step, contenders, best)
    drop = step.verdicts.cost - best.verdicts.cost
    wins = shares_of_wins(np.stack([c.verdicts.blocks for c in [best, *rivals]]), generator)
    return Found(
        best.name,
        best.effect,
        p,
        (step.verdicts.heldout, best.verdicts.heldout),
        (step.verdicts.cost, best.verdicts.cost),
        t_value(step.verdicts.blocks, best.verdicts.blocks),
        float(wins[0]) * (1 - p),
        _ambiguous(step, best, rivals, screened),
        tuple(c.name for c in rivals if step.verdicts.cost - c.verdicts.cost > MUCH * drop),
    )


def _exists(problem: Problem, effect: Effect) -> bool:
    """Whether such an effect can exist and be seen: amplitudes in bounds, forces no larger than the joint's torque."""
    position = np.asarray(problem.records.position)
    if not effect.shown_by(position.min((0, 1)), position.max((0, 1))):
        return False
    strongest = np.sqrt((problem.torque**2).mean((0, 1)))[np.asarray(effect.at)] if effect.acts_on == "joint" else None
    body = vars(effect)["mass"] if isinstance(effect, Payload) else 0.0
    if float(body) > float(np.asarray(problem.model.inertia)[:, 0].sum()):
        return False
    for name, parameter in effect.parameters().items():
        value = float(getattr(effect, name))
        if parameter.linear and value < parameter.lower:
            return False
        if (
            not (parameter.linear or parameter.choice)
            and not parameter.lower < value * 0.999 < value * 1.001 < parameter.upper
        ):
            return False
        if strongest is not None and parameter.linear and parameter.unit == "N m" and abs(value) > strongest[0]:
            return False
    return True


def _simpler(step: Step, contenders: list[Contender], one: Contender) -> bool:
    """Whether an effect that this one contains does as well."""
    inside = [c for c in contenders if c.name.effect in type(one.effect).contains and c.name.at == one.name.at]
    return any(_member(step, one, c) for c in inside)


def _rivals(step: Step, contenders: list[Contender], one: Contender) -> list[Contender]:
    """The others that explain the same misfit; a cause of another misfit is no alternative to this one."""
    others = [c for c in contenders if c is not one]
    return [c for c in others if overlap(step.verdicts, one.verdicts, c.verdicts) > SAME]


def _ambiguous(step: Step, best: Contender, rivals: list[Contender], screened: Screen) -> tuple[Name, ...]:
    """What cannot be told from the best: rivals that predict as well, and effects that are the same while moving."""
    names = [c.name for c in rivals if _member(step, best, c)]
    clearly_worse = {c.name for c in rivals if t_value(c.verdicts.blocks, best.verdicts.blocks) > CLEARLY}
    known = {group.name for group in screened.groups}
    for alike in EXACT:
        same = [Name(effect, best.name.at) for effect in sorted(alike - {best.name.effect})]
        if best.name.effect in alike:
            names += [n for n in same if n in known and n not in names and n not in clearly_worse]
    return tuple(names)


def _member(step: Step, best: Contender, other: Contender) -> bool:
    """Whether the data cannot tell the other from the best: held-out blocks and penalised squares alike."""
    drop = step.verdicts.cost - best.verdicts.cost
    close = other.verdicts.cost - best.verdicts.cost < max(0.1 * drop, 15)
    return close and t_value(other.verdicts.blocks, best.verdicts.blocks) < UNSURE


def _passes(step: Step, contenders: list[Contender], one: Contender) -> bool:
    gain = 1 - one.verdicts.heldout / step.verdicts.heldout
    surely = t_value(step.verdicts.blocks, one.verdicts.blocks) > CONFIDENT
    return gain > GAIN and surely and _recurs(step, contenders, one)


def _recurs(step: Step, contenders: list[Contender], one: Contender) -> bool:
    """Whether the cause is among the best three of its rivals in two thirds of the folds, ranked without the fold."""
    field = [one, *_rivals(step, contenders, one)]
    ranks = [
        sum(c.verdicts.without[fold] < one.verdicts.without[fold] for c in field)
        for fold in range(len(one.verdicts.without))
    ]
    return float(np.mean(np.array(ranks) < 3)) >= 2 / 3
