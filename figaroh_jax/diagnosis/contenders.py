"""The candidates that a screen points to, each with its exact shape and what the data say of the model with it in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import jax
import numpy as np
from jaxtyping import Float

from ..effects.base import Effect, exact
from ..estimation.joint_rows import JointRows
from ..estimation.priors import physical_body
from ..estimation.rows import UNKNOWN, Rows
from ..recordings.stacked import filtered_rows
from ..results import Name
from .believed import believed
from .comparison import Ground, Hypothesis, Verdicts, grown_sums, judge, judge_grown, last_coefficient, sums_of
from .design import BATCH, kind, shapes, unit_rows, units, with_shape
from .estimates import torque_slope
from .joint import POLISH, polished
from .problem import Problem
from .refit import Whitened, refit, refit_shift
from .screening import Group, Screen
from .shifts import torque_change
from .state import State, batched, extended_state, link_motion, solved
from .step import Step, stand
from .thresholds import BEST_OF_A_PLACE, GAIN, SHARE_OF_BEST, SHIFTS, SHORTLIST

__all__ = ["Contender", "acting", "contend", "for_refit", "next_shape", "shortlist"]

TURNS, RESPONSE_TURNS = 3, 6  # of Gauss-Newton on a shift of the position; on a response of the torque
EXPANSIONS, SMALL_MOVE = 8, 0.003  # of an effect about its size; a relative move of that after which it has settled
SMALL = 1e-5  # step of a derivative, relative
NEAR_ENOUGH = 0.1  # of its standard deviation: a step that moves the size by less is not taken


@dataclass(frozen=True)
class Contender:
    """A candidate with its exact shape, the model of the data with it in, and what the data say of that."""

    name: Name
    effect: Effect
    verdicts: Verdicts
    joints: tuple[int, ...]  # by whose rows it is judged
    free: Verdicts | None = None  # where links are held back (`believed`): the same beside links that are not


def shortlist(step: Step, found: Screen) -> list[tuple[Group, np.ndarray, float]]:
    """The best groups of the robot and of each place, each with its grid points by their scores, and the best score.

    One joint with a large misfit would fill a list of the best alone, and nothing else would be tried.
    """
    ranked = found.best(step.rows)
    shifts = [r for r in ranked if kind(found.groups[r[1]].effect) == "position"]
    everything, ranked = ranked, [r for r in ranked if r not in shifts[SHIFTS:]]
    chosen = [r for r in ranked[:SHORTLIST] if r[0] > SHARE_OF_BEST * ranked[0][0]] or ranked[:1]
    chosen += [r for r in _best_of_places(step, found, ranked) if r not in chosen]
    chosen += [r for r in _read_alike(found, everything, chosen) if r not in chosen]
    chosen += [r for r in _cut_off(step, found, ranked) if r not in chosen]
    simpler = {Name(n, found.groups[g].name.at) for _, g, _ in chosen for n in type(found.groups[g].effect).contains}
    chosen += [r for r in ranked if found.groups[r[1]].name in simpler and r not in chosen]
    return [(found.groups[g], np.argsort(-found.scores[g].Q), float(found.scores[g].Q[p])) for _, g, p in chosen]


def _read_alike(
    found: Screen, ranked: list[tuple[float, int, int]], chosen: list[tuple[float, int, int]]
) -> list[tuple[float, int, int]]:
    """All errors of a joint's position where one of them is among the chosen.

    To first order each is the joint's load, velocity and acceleration times some error, and the load itself is nearly
    a scale or an eccentricity: which of them it is, only their exact torques tell.
    """
    near = {found.groups[g].name.at for _, g, _ in chosen if type(found.groups[g].effect).has("position_error")}
    alike = [r for r in ranked if type(found.groups[r[1]].effect).has("position_error")]
    return [r for r in alike if found.groups[r[1]].name.at in near]


def _best_of_places(step: Step, found: Screen, ranked: list[tuple[float, int, int]]) -> list[tuple[float, int, int]]:
    """The best of each joint, pair, link and of the robot whose score could pass for a gain there."""
    squares, places = (step.verdicts.error**2).sum(1), {}
    for one in ranked:
        if _could_gain(squares, found, one):
            places.setdefault(found.groups[one[1]].name.at, []).append(one)
    best = (own[:BEST_OF_A_PLACE] for own in places.values())
    return [r for own in best for r in own if r[0] > SHARE_OF_BEST * own[0][0]]


def _cut_off(step: Step, found: Screen, ranked: list[tuple[float, int, int]]) -> list[tuple[float, int, int]]:
    """The limits of drives whose score could pass for a gain.

    Where a drive is often at its limit, the torque that it was to give is not known: that of a fit to what it gave
    passes the limit little, and the limit's score is small beside those of frictions that bend as the torque does.
    """
    squares = (step.verdicts.error**2).sum(1)
    limits = [r for r in ranked if found.groups[r[1]].effect.has("through")]
    return [r for r in limits if _could_gain(squares, found, r)]


def _could_gain(squares: Float[np.ndarray, " nv"], found: Screen, one: tuple[float, int, int]) -> bool:
    """Whether a candidate's score could pass for a gain at its joints; `squares` are those of each joint's errors."""
    rank, index, point = one
    group = found.groups[index]
    own = squares[list(acting(group.effect, len(squares), group.columns.joints))].sum()
    return rank > 0 and bool(found.scores[index].Q[point] > 0.5 * GAIN * own)


def acting(effect: Effect, nv: int, touched: Sequence[int]) -> tuple[int, ...]:
    """The joints by whose rows an effect is judged: those where it acts, or all that it touches."""
    if effect.acts_on in ("joint", "pair"):
        return tuple(int(k) for k in np.asarray(effect.at).reshape(-1, np.shape(effect.at)[-1])[0])
    return tuple(touched) if len(touched) else tuple(range(nv))


def contend(
    problem: Problem,
    step: Step,
    whitening: Float[np.ndarray, "F nv"],
    base: Ground,
    ready: Whitened,
    group: Group,
    order: np.ndarray,
    fitted: dict[Name, Effect],
) -> Contender:
    """The candidate with its exact shape, started from its best grid points; a position sensor from how it was last
    `fitted`, where it then is kept."""
    way = kind(group.effect)
    if way != "columns":
        near = _to_first_order(step, base, group, int(order[0]))
        if not worth_trying(step, near):
            return near
    if way == "response":
        first = jax.tree.map(lambda x: x[order[0]], group.effect)
        return _response_contender(problem, step, whitening, group, first)
    if way == "position":
        one = _position_contender(problem, step, base, ready, group, fitted.get(group.name))
        fitted[group.name] = one.effect
        return one
    if group.effect.has("through"):
        return _limit_contender(problem, step, whitening, group, order)
    if group.effect.about:
        return _expanded_contender(problem, step, base, ready, group)
    parts = None
    if group.effect.one_rotor:
        order, parts = _as_one_rotor(step, base, group, order)
    effect, Z = _exact_columns(problem, step, ready, group, order)
    free = None
    if effect.body:
        effect, verdicts = _body_verdicts(problem, step, base, effect, Z)
    else:
        names = effect.amplitudes()
        parts = range(len(names)) if parts is None else parts
        verdicts, free = _judged_beside(problem, step, base, group.columns.joints, Z[list(parts)])
        values = dict(zip(parts, verdicts.theta[-len(parts) :], strict=True)) if len(parts) else {}
        effect = with_shape(effect, names, [np.float64(values.get(k, 0.0)) for k in range(len(names))])
    free = None if effect.inertial else free
    return Contender(group.name, effect, verdicts, acting(effect, len(step.rows.y), group.columns.joints), free)


def next_shape(group: Group, best: Contender) -> np.ndarray:
    """The grid point that explains most of what the best one leaves, where that could pass for a gain; or none.

    A ripple so slow that the motion shows it no better than any smooth law may lie over one of many periods, which is
    another cause.
    """
    joints, grid = list(group.columns.joints), len(group.columns.Z)
    if grid < 2 or kind(group.effect) != "columns":
        return np.zeros(0, int)
    Z, rest = group.columns.Z.reshape(grid, -1, best.verdicts.residual[joints].size), best.verdicts.residual[joints]
    pull, inverse = Z @ rest.ravel(), np.linalg.pinv(Z @ np.swapaxes(Z, 1, 2), hermitian=True)
    explained = np.einsum("gk,gkl,gl->g", pull, inverse, pull)
    least = max(0.5 * GAIN * (rest**2).sum(), Z.shape[1] * np.log(rest.size) + 2 * np.log(grid))
    return np.argsort(-explained)[: int(explained.max() > least)]


def _to_first_order(step: Step, base: Ground, group: Group, point: int) -> Contender:
    """A sensor effect at a grid point, its columns taken as if their amplitude were free: better than it can be."""
    verdicts = judge_grown(step.rows, base, group.columns.joints, group.columns.Z[point])
    effect = jax.tree.map(lambda x: x[point], group.effect)
    return Contender(group.name, effect, verdicts, acting(effect, len(step.rows.y), group.columns.joints))


def worth_trying(step: Step, one: Contender) -> bool:
    """Whether a candidate gains, to first order, half of what a cause must: an exact fit of a sensor takes long."""
    before, after = (v.own(step.rows, one.joints).sum() for v in (step.verdicts, one.verdicts))
    return bool(1 - after / before > GAIN / 2)


def _exact_columns(
    problem: Problem, step: Step, ready: Whitened, group: Group, order: np.ndarray
) -> tuple[Effect, Float[np.ndarray, "k rows T"]]:
    """The effect with the shape that fits best, and its whitened columns."""
    if not shapes(type(group.effect)):
        return jax.tree.map(lambda x: x[order[0]], group.effect), group.columns.Z[order[0]]
    starts = np.resize(order, BATCH)
    effects = jax.tree.map(lambda x: x[starts], group.effect)
    effect, Z = refit(effects, step.state.motion, problem.records, ready, group.effect)
    return effect, Z.reshape(*Z.shape[:2], -1)


def _as_one_rotor(step: Step, base: Ground, group: Group, order: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
    """The grid points of a coupling, first that which explains most with no part below zero; and the parts it then has.

    One rotor that turns the sum of two joints, or their difference, has inertia, damping and friction of that sign.
    Inertia and damping of the two signs are mirror images, so that a free fit of the wrong one may be the better. And a
    part below zero follows some other misfit: with it the coupling would take the place of what explains that.
    """
    rows, joints, found = step.rows, list(group.columns.joints), []
    for point in order:
        Z = group.columns.Z[point]
        cross = rows.X.pulled_at(joints, Z).T
        G = np.tensordot(Z, Z, ((1, 2), (1, 2))) - cross.T @ base.inverse[-1] @ cross
        found.append(_none_below_zero(G, np.tensordot(Z, base.verdicts.residual[joints], 2)))
    best = np.argsort([-gain for gain, _ in found], kind="stable")
    return order[best], found[best[0]][1]


def _none_below_zero(G: Float[np.ndarray, "k k"], pull: Float[np.ndarray, " k"]) -> tuple[float, tuple[int, ...]]:
    """Squares that k columns explain with coefficients of zero or more (the least of x'Gx - 2 pull'x, negative), and
    the columns whose coefficients are not zero."""
    best = 0.0, ()
    for some in product((False, True), repeat=len(pull)):
        at = np.flatnonzero(some)
        own = np.linalg.lstsq(G[np.ix_(at, at)], pull[at], rcond=None)[0] if len(at) else np.zeros(0)
        if (own >= 0).all():
            best = max(best, (float(own @ pull[at]), tuple(int(k) for k in at)))
    return best


def _judged_beside(
    problem: Problem, step: Step, base: Ground, joints: Sequence[int], Z: Float[np.ndarray, "k rows T"]
) -> tuple[Verdicts, Verdicts | None]:
    """The current model with columns more; links that it holds back are held no more than with these, or not at all."""
    if step.loose is None:
        return judge_grown(step.rows, base, joints, Z), None
    more = JointRows.at(joints, Z, len(step.rows.y))
    X = step.rows.X.beside(more)
    sums, loose = grown_sums(step.rows, step.folded, more), step.loose.extended(len(Z))
    held, free = (judge(step.rows, Hypothesis(X, p), sums) for p in (believed(problem, loose, sums), loose))
    return held, free


def _body_verdicts(
    problem: Problem, step: Step, base: Ground, effect: Effect, Z: Float[np.ndarray, "10 nv T"]
) -> tuple[Effect, Verdicts]:
    """An effect that is a body, with the parameters of the nearest physically consistent body."""
    rows, full = step.rows, np.moveaxis(Z, 0, 2)
    free, _ = _judged_beside(problem, step, base, range(len(rows.y)), Z)
    body = physical_body(free.theta[-10:], _information(rows, base, full))
    fixed = full @ body
    sums = sums_of(rows, step.folded, rows.y - fixed)
    verdicts = judge(rows, Hypothesis(rows.X, believed(problem, step.state.prior, sums), fixed), sums)
    return with_shape(effect, list(effect.parameters()), list(body)), verdicts


def _information(rows: Rows, base: Ground, Z: Float[np.ndarray, "nv T k"]) -> Float[np.ndarray, "k k"]:
    """Z'Z with the current model projected out: the precision of the columns' coefficients."""
    tall, cross = Z.reshape(-1, Z.shape[2]), rows.X.pulled(np.moveaxis(Z, 2, 0)).T
    return tall.T @ tall - cross.T @ base.inverse[-1] @ cross


def for_refit(problem: Problem, step: Step, base: Ground, whitening: Float[np.ndarray, "F nv"]) -> Whitened:
    """What the refits of a step need."""
    n, _, count, nv = problem.records.shape
    residual = step.verdicts.residual.reshape(nv, n, count)
    response = whitening * step.state.response(problem.records.omega)[:, None]
    return Whitened(residual, step.rows.X, base.inverse[-1], response)


def _position_contender(
    problem: Problem,
    step: Step,
    base: Ground,
    ready: Whitened,
    group: Group,
    before: Effect | None,
) -> Contender:
    """A shift of the links' motion: Gauss-Newton on its size and all coefficients, from a search of its profile, or
    from how it stood `before`, beside fewer causes.

    The torque changes by what the links' true motion makes of the coefficients so far, which is exact; that a change
    of coefficients acts along the true motion too is of second order, and left to the step that takes the cause in.
    """
    rows, prior, state = step.rows, step.state.prior, step.state
    effect = before
    if effect is None:
        effect = refit_shift(group.effect, group.columns.Z[:, 0], state.motion, problem.records, ready)
    ((name, parameter),) = effect.parameters().items()
    change, slope = _shift(problem, state, effect, name, ready.whitening)
    for _ in range(TURNS):
        missing, cross = rows.y - change, rows.X.pulled(slope)
        theta = base.inverse[-1] @ (rows.X.pulled(missing) + prior.precision * prior.mean)
        taken = base.inverse[-1] @ cross
        own = float((slope**2).sum() - cross @ taken) + UNKNOWN
        move = float((slope * missing).sum() - cross @ theta) / own
        size = float(getattr(effect, name))
        value = float(np.clip(size + move, parameter.lower, parameter.upper))
        if abs(value - size) < NEAR_ENOUGH / np.sqrt(own):
            break
        effect = with_shape(effect, [name], [np.float64(value)])
        state = solved(step.state, theta - taken * move)
        change, slope = _shift(problem, state, effect, name, ready.whitening)
    sums, loose = sums_of(rows, step.folded, rows.y - change), step.loose
    free = None if loose is None else judge(rows, Hypothesis(rows.X, loose, change), sums)
    held = prior if loose is None else believed(problem, loose, sums)
    verdicts = judge(rows, Hypothesis(rows.X, held, change), sums)
    return Contender(group.name, effect, verdicts, acting(effect, len(rows.y), group.columns.joints), free)


def _limit_contender(
    problem: Problem, step: Step, whitening: Float[np.ndarray, "F nv"], group: Group, order: np.ndarray
) -> Contender:
    """A drive at its limit, all coefficients fitted with it: where it holds, the torque says nothing of them."""
    names, declared = group.effect.amplitudes(), group.effect.parameters()
    whole = [np.float64(1.0) for _ in names]
    effect = with_shape(jax.tree.map(lambda x: x[order[0]], group.effect), names, whole)
    joints = acting(effect, len(step.rows.y), group.columns.joints)
    for turns in (0, POLISH):
        here = polished(problem, step.state, [effect], whitening, turns)
        (effect,), free = here.causes, step.loose and here.step.free
        one = Contender(group.name, effect, here.step.verdicts, joints, free)
        inside = all(declared[n].lower < float(getattr(effect, n)) < declared[n].upper for n in names)
        if not (inside and worth_trying(step, one)):
            break
    return one


def _expanded_contender(problem: Problem, step: Step, base: Ground, ready: Whitened, group: Group) -> Contender:
    """An effect that is linear about its size alone: fitted about zero, then about what that gave, until it settles."""
    effect, Z = jax.tree.map(lambda x: x[0], group.effect), group.columns.Z[0]
    where, name = group.effect.about
    bounds = effect.parameters()[where]
    verdicts, free = _judged_beside(problem, step, base, group.columns.joints, Z)
    for _ in range(EXPANSIONS):
        last, size = float(getattr(effect, where)), np.clip(verdicts.theta[-1], bounds.lower, bounds.upper)
        if abs(size - last) < SMALL_MOVE * abs(size):
            break
        effect = exact(with_shape(effect, [name], [np.float64(size)]))
        motion = solved(step.state, verdicts.theta[:-1]).motion  # its torque without the effect
        fresh = units({group.name.effect: batched(effect)}, motion, problem.records)[group.name.effect]
        Z = unit_rows(fresh, problem.records, ready.whitening)[0].reshape(*Z.shape)
        verdicts, free = _judged_beside(problem, step, base, group.columns.joints, Z)
    effect = with_shape(effect, [name], [np.float64(verdicts.theta[-1])])
    return Contender(group.name, effect, verdicts, acting(effect, len(step.rows.y), group.columns.joints), free)


def _shift(
    problem: Problem, state: State, effect: Effect, name: str, response: np.ndarray
) -> tuple[Float[np.ndarray, "nv T"], Float[np.ndarray, "nv T"]]:
    """What a shift of the links' motion changes of the whitened torque, and the derivative of that in its size."""
    size = float(getattr(effect, name))
    h = SMALL * max(abs(size), SMALL)
    sides = jax.tree.map(lambda *x: np.stack(x), *(with_shape(effect, [name], [size + s]) for s in (0.0, h)))
    change, more = torque_change(sides, link_motion(problem, state), problem.records)
    rows = [filtered_rows(problem.records, x, response) for x in (change, (more - change) / h)]
    return rows[0], rows[1]


def _response_contender(
    problem: Problem, step: Step, whitening: Float[np.ndarray, "F nv"], group: Group, effect: Effect
) -> Contender:
    """Gauss-Newton on the one parameter of a torque sensor's response, all coefficients fitted anew each time."""
    ((name, parameter),) = effect.parameters().items()
    here = None
    for _ in range(RESPONSE_TURNS):
        here = stand(problem, extended_state(problem, step.state, effect), whitening)
        slope = torque_slope(problem, here.state, effect, name, whitening)
        sums = grown_sums(here.rows, here.folded, JointRows.of(slope[..., None]))
        theta, variance = last_coefficient(sums, here.state.prior.extended(1))
        size = float(getattr(effect, name))
        value = float(np.clip(size + theta[-1], parameter.lower, parameter.upper))
        if abs(value - size) < max(NEAR_ENOUGH * np.sqrt(variance), 1e-7):
            break
        effect, here = with_shape(effect, [name], [np.float64(value)]), None
    here = here or stand(problem, extended_state(problem, step.state, effect), whitening)
    free = None if step.loose is None else here.free
    return Contender(group.name, effect, here.verdicts, acting(effect, len(step.rows.y), group.columns.joints), free)
