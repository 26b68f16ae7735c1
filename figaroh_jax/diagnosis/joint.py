"""All causes fitted together: coefficients and shapes at once, and which of them surely have a size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect, exact
from ..effects.catalogue import CATALOGUE, find
from ..estimation.joint_rows import JointRows
from ..estimation.rows import Rows, block_sums, model_sums
from ..results import Name
from .comparison import fold_sums
from .design import fitted_fields, kind, shapes, with_shape
from .estimates import Fitted, amplitude_places, torque_slopes, with_amplitudes
from .problem import Problem, family_of
from .state import State, assembled, solved
from .step import Step, stand, with_causes
from .thresholds import NUMBER, SIZE_REGION

if TYPE_CHECKING:
    from .search import Found

__all__ = [
    "Joint",
    "has_size",
    "joint_fit",
    "least_sure",
    "moved",
    "opened",
    "polished",
    "sized",
    "with_misfit",
    "with_parts",
    "with_rest",
    "without_a_number",
]

KEPT = 1e-12  # of the diagonal: a ridge for numbers that no row shows
PIECES = 10.0  # functions of a joint's motion that what is left at it goes into
AS_SURE = 2.0  # times the deviation of a fit up to which another one counts in full
LATE = 4  # turns: most fits have settled by then
BACK = 0.5  # of its last move: what a shape goes back by where steps overshoot
WORSE = 1.0  # squares by which the last turn may cost more than the best one
POLISH, SETTLED = 10, 0.03  # turns at the most; a turn that moves nothing by more of its standard deviation is the last


class Joint(NamedTuple):
    """All causes in one fit: where it stands, the causes with their amplitudes, values with covariance."""

    step: Step
    causes: list[Effect]
    fitted: Fitted


def polished(
    problem: Problem, start: State, causes: list[Effect], whitening: Float[np.ndarray, "F nv"], turns: int = POLISH
) -> Joint:
    """All causes fitted together: Gauss-Newton steps over coefficients and shapes until they settle.

    Sensor effects follow the load and the torque, so each turn begins with what the last one made of the baseline.
    A shape that late turns send back as far as it came would go on so for ever: it moves half of the way from then on.
    A limit that a step has moved beyond all torques is nowhere and has no slope to come back by: where the last turn
    costs more than an earlier one, that one is the fit.
    """
    joint = least = _first(problem, start, causes, whitening)
    share, before = np.ones_like(joint.fitted.value), np.zeros_like(joint.fitted.value)
    for turn in range(0 if all(map(_settled, causes)) else turns):
        move = _move(joint)
        if turn >= LATE:
            share = np.where(move * before < -BACK * before**2, share / 2, share)
        goal = replace(joint.fitted, value=joint.fitted.value - (1 - share) * move)
        causes = [moved(e, goal, at) for e, at in zip(joint.causes, goal.places, strict=True)]
        base = solved(start, joint.step.state.theta[: len(start.theta)])
        before, last, joint = move, joint.fitted, _together(problem, base, causes, whitening)
        least = joint if joint.step.verdicts.cost < least.step.verdicts.cost else least
        if np.all(np.abs(joint.fitted.value - last.value) <= SETTLED * np.sqrt(np.diag(joint.fitted.covariance))):
            break
    return least if least.step.verdicts.cost < joint.step.verdicts.cost - WORSE else joint


def _first(problem: Problem, start: State, causes: list[Effect], whitening: Float[np.ndarray, "F nv"]) -> Joint:
    """All causes in one fit from the sizes that they have, or that all the others have without those that clip torque.

    A drive at its limit clips the torque of all others. Where these are other ones than it was found beside, that may
    be far beyond it anywhere: the rows that are left say little of them, and no turn leads back.
    """
    joint = _together(problem, start, causes, whitening)
    free = [e for e in causes if not e.has("through")]
    if len(free) == len(causes):
        return joint
    step = with_causes(problem, start, free, whitening)
    sized, base = iter(with_amplitudes(step.state, free)), solved(start, step.state.theta[: len(start.theta)])
    anew = [e if e.has("through") else exact(next(sized)) for e in causes]
    other = _together(problem, base, anew, whitening)
    return other if other.step.verdicts.cost < joint.step.verdicts.cost else joint


def with_misfit(
    problem: Problem,
    start: State,
    joint: Joint,
    weights: Sequence[tuple[Float[np.ndarray, "n M nv"], Float[np.ndarray, "F nv"]]],
) -> Joint:
    """The fit with deviations that also say how far its values move where rows weigh otherwise.

    A model that leaves noise alone gets the same values from all weights, but for the noise (Hausman's test of a model
    asks for that). What it leaves beyond pulls them by what the rows weigh, the same way in every block, so that no
    scatter of blocks shows it: which weights are right nobody knows, so the mean square of the moves is added to the
    variance. A fit whose own deviation is more than `AS_SURE` times as large says less of that, and counts less.
    `weights` are those of the rows, with a whitening. Amplitudes at the shapes that are told move by less: beside
    them shapes are not asked for.
    """
    fitted, theta = joint.fitted, joint.step.state.theta
    moves, shaped = np.zeros_like(fitted.covariance), _at_shapes(joint.causes, fitted)
    amplitudes = np.zeros_like(shaped)
    for weight, whitening in weights:
        other = problem.weighted(weight)
        base = solved(start, theta[: len(start.theta)])
        one = _together(other, base, joint.causes, whitening)
        moves += _moves(fitted.covariance, one.fitted.covariance, one.fitted.value - fitted.value)
        alone = np.append(one.step.state.theta - theta, np.zeros(len(fitted.value) - len(theta)))
        amplitudes += _moves(shaped, _at_shapes(joint.causes, one.fitted), alone)
    count = max(len(weights), 1)
    return joint._replace(
        fitted=replace(fitted, covariance=fitted.covariance + moves / count, at_shapes=shaped + amplitudes / count)
    )


def _moves(
    own: Float[np.ndarray, "P P"], other: Float[np.ndarray, "P P"], move: Float[np.ndarray, " P"]
) -> Float[np.ndarray, "P P"]:
    """Squares of what another fit moves, as far as it is as sure."""
    move = np.sqrt(_as_sure(own, other)) * move
    move = np.where(np.isfinite(move), move, 0.0)  # a fit without rows of a joint says nothing of it
    return np.outer(move, move)


def _as_sure(own: Float[np.ndarray, "P P"], other: Float[np.ndarray, "P P"]) -> Float[np.ndarray, " P"]:
    """How far the values of another fit count, 1 up to `AS_SURE` times the deviation. Both are covariances."""
    return np.clip(AS_SURE**2 * np.diag(own) / np.maximum(np.diag(other), 1e-300), 0.0, 1.0)


def _at_shapes(causes: Sequence[Effect], fitted: Fitted) -> Float[np.ndarray, "P P"]:
    """Covariance of the parameters, those of each cause's amplitudes at its shapes as fitted."""
    out = fitted.covariance.copy()
    for effect, place in zip(causes, fitted.places, strict=True):
        known = list(place[len(place) - len(shapes(type(effect))) :])
        own = list(place[: len(place) - len(known)])
        if known and own and np.isfinite(fitted.covariance[np.ix_(place, place)]).all():  # else no row says anything
            out[np.ix_(own, own)] = _given(fitted.covariance, own, known)
    return out


def _given(covariance: Float[np.ndarray, "P P"], at: Sequence[int], known: Sequence[int]) -> Float[np.ndarray, "k k"]:
    """Covariance of some parameters where others are known."""
    across = covariance[np.ix_(at, known)]
    within = np.linalg.pinv(covariance[np.ix_(known, known)], hermitian=True)
    return covariance[np.ix_(at, at)] - across @ within @ across.T


def with_parts(problem: Problem, joint: Joint, whitening: Float[np.ndarray, "F nv"]) -> Joint:
    """The fit with no deviation below what its values scatter by as each part of the data is left out (jackknife).

    Parts are excitations, or quarters of recordings: what a model leaves goes on for longer than a block of the scores,
    and pulls the values another way in each of them. To first order, with v_k the values without part k of K:
    variance = (K - 1) / K sum_k (v_k - their mean)^2. Without the one part that shows a value (a limit that a single
    excitation reaches) the others say nothing of it: such a v_k counts as far as it is as sure.
    """
    step, fitted, state = joint.step, joint.fitted, joint.step.state
    rows = step.rows._replace(fold=problem.layout.part)
    slopes = [slope for e in joint.causes for slope in torque_slopes(problem, state, e, whitening)]
    J = _with_slopes(rows, slopes)
    shape = [float(getattr(e, n)) for e in joint.causes for n in shapes(type(e))]
    sums = fold_sums(rows, J, rows.y - rows.X @ state.theta - J @ (fitted.value - np.append(state.theta, shape)))
    count = len(sums.gram)
    if count < 2:
        return joint
    A = sums.gram.sum(0) + np.diag(np.append(state.prior.precision, np.zeros(len(slopes))))
    inverse = [_inverse(A - own) for own in sums.gram]
    share = np.array([_as_sure(_inverse(A), other) for other in inverse])
    moves = np.sqrt(share) * (np.stack(inverse) @ sums.moment[..., None])[..., 0]
    variance = (count - 1) / count * ((moves - moves.mean(0)) ** 2).sum(0)
    return joint._replace(fitted=_wider(fitted, variance / np.maximum(np.diag(fitted.covariance), 1e-300)))


def with_rest(
    problem: Problem,
    joint: Joint,
    whitening: Float[np.ndarray, "F nv"],
    places: Sequence[Sequence[int]],
    rest: Float[np.ndarray, " nv"],
) -> Joint:
    """The fit with what its intervals owe to a rest that no cause explains.

    What is wrong at a joint beside a cause looks in part like that cause, the same in every part of the data. How much
    cannot be seen, but what is left there can: smooth misfits of a joint go into some `PIECES` functions of its motion,
    and the law of the cause is one function more, which has taken as many squares as any of them. `rest` are the
    squares of each joint's rows beyond those of noise, `places` the joints where each cause acts.
    """
    step, fitted = joint.step, joint.fitted
    slopes = [slope for e in joint.causes for slope in torque_slopes(problem, step.state, e, whitening)]
    J = _with_slopes(step.rows, slopes)
    inverse = _inverse(J.squares() + np.diag(np.append(step.state.prior.precision, np.zeros(len(slopes)))))
    covariance = fitted.covariance.copy()
    for place, joints in zip(fitted.places, places, strict=True):
        at = np.ix_(place, place)
        covariance[at] += max(float(rest[list(joints)].mean()), 0.0) / PIECES * inverse[at]
    return joint._replace(fitted=replace(fitted, covariance=covariance))


def _with_slopes(rows: Rows, slopes: Sequence[Float[np.ndarray, "nv T"]]) -> JointRows:
    """The columns of the model, and those of the shapes of its causes."""
    return rows.X.beside(JointRows.of(np.stack(slopes, axis=-1))) if slopes else rows.X


def _wider(fitted: Fitted, times: Float[np.ndarray, " parameters"]) -> Fitted:
    """The values with variances so many times as large, but no smaller ones."""
    wider = np.sqrt(np.maximum(times, 1.0))
    return replace(fitted, covariance=fitted.covariance * np.outer(wider, wider))


def _move(joint: Joint) -> Float[np.ndarray, " parameters"]:
    """How far the fit would move each shape; zero for the coefficients, which have moved."""
    move = np.zeros_like(joint.fitted.value)
    for effect, place in zip(joint.causes, joint.fitted.places, strict=True):
        names = shapes(type(effect))
        at = list(place[len(place) - len(names) :])
        move[at] = joint.fitted.value[at] - [float(getattr(effect, name)) for name in names]
    return move


def _settled(effect: Effect) -> bool:
    """Whether one turn is all: the columns are those of the measured motion, whatever is found of the others."""
    return effect.inertial or family_of(type(effect)) == "fixed"


def _together(problem: Problem, base: State, causes: list[Effect], whitening: Float[np.ndarray, "F nv"]) -> Joint:
    step = stand(problem, assembled(problem, base, causes), whitening)
    causes = with_amplitudes(step.state, causes)
    return Joint(step, causes, joint_fit(problem, step, causes, whitening))


def joint_fit(problem: Problem, step: Step, causes: list[Effect], whitening: Float[np.ndarray, "F nv"]) -> Fitted:
    """Gauss-Newton step of all coefficients and shapes at once, and a covariance from the scores of the blocks."""
    state, rows = step.state, step.rows
    causes = with_amplitudes(state, causes)
    each = [slope for e in causes for slope in torque_slopes(problem, state, e, whitening)]
    slopes = np.stack(each) if each else np.zeros((0, *rows.y.shape))
    precision = np.append(state.prior.precision, np.zeros(len(slopes)))
    flat, cross = slopes.reshape(len(slopes), rows.y.size), rows.X.pulled(slopes)
    A = np.block([[step.folded.gram.sum(0), cross.T], [cross, flat @ flat.T]]) + np.diag(precision)
    inverse = _inverse(A)
    residual = rows.y - rows.X @ state.theta
    pull = np.append(state.prior.precision * (state.prior.mean - state.theta), np.zeros(len(slopes)))
    move = inverse @ (np.append(rows.X.pulled(residual), flat @ residual.reshape(-1)) + pull)
    values = [float(getattr(e, n)) for e in causes for n in shapes(type(e))]
    covariance = inverse @ (_scatter(rows, slopes, residual) + np.diag(precision)) @ inverse
    covariance = _widened(covariance, inverse, rows, residual, len(A))
    return Fitted(np.append(state.theta, values) + move, covariance, _places(state, causes))


def _inverse(A: Float[np.ndarray, "P P"]) -> Float[np.ndarray, "P P"]:
    return np.linalg.inv(A + KEPT * np.diag(np.maximum(np.diag(A), KEPT)))


def _widened(
    covariance: Float[np.ndarray, "P P"],
    inverse: Float[np.ndarray, "P P"],
    rows: Rows,
    residual: Float[np.ndarray, "nv T"],
    count: int,
) -> Float[np.ndarray, "P P"]:
    """The covariance with no standard deviation below that of independent rows of the residual's size.

    Scores of a few blocks, from a residual that the fit has made smaller, may miss by chance what they scatter by.
    """
    level = max(1.0, float((residual**2).sum()) / max(rows.size - count, rows.size / 2))
    least = np.sqrt(level * np.maximum(np.diag(inverse), 0.0))
    own = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    shown = own > KEPT * least  # of the others no row says anything
    wider = np.where(shown, np.maximum(least / np.where(shown, own, 1.0), 1.0), 0.0)
    return covariance * np.outer(wider, wider) + np.diag(np.where(shown, 0.0, least**2))


def _scatter(
    rows: Rows, slopes: Float[np.ndarray, "shapes nv T"], residual: Float[np.ndarray, "nv T"]
) -> Float[np.ndarray, "P P"]:
    """sum_b g_b g_b' of the blocks' scores g_b = J_b' r_b: right for coloured residuals too. J are X and the slopes."""
    blocks, touched = rows.block.max() + 1, np.flatnonzero(slopes.any((0, 2)))
    others = np.zeros((len(slopes), blocks))
    for joint in touched:
        others += block_sums(rows, residual[joint], slopes[:, joint])
    scores = np.concatenate([model_sums(rows, rows.X, residual), others])
    return scores @ scores.T * blocks / max(blocks - 1, 1)


def _places(state: State, causes: list[Effect]) -> tuple[tuple[int, ...], ...]:
    """Where each cause's amplitudes and shapes stand among the parameters."""
    places, first = [], len(state.theta)
    for effect, amplitude in zip(causes, amplitude_places(state, causes), strict=True):
        count = len(shapes(type(effect)))
        places.append((*amplitude, *range(first, first + count)))
        first += count
    return tuple(places)


def moved(effect: Effect, fitted: Fitted, place: tuple[int, ...]) -> Effect:
    """The cause with its shapes after the step, kept in their bounds, and linear about its new size (`exact`)."""
    effect = exact(effect)
    names = shapes(type(effect))
    values = fitted.value[list(place[len(place) - len(names) :])] if names else []
    kept = []
    for name, value in zip(names, values, strict=True):
        parameter = effect.parameters()[name]
        inside = float(np.clip(value, parameter.lower, parameter.upper))
        if parameter.hole and parameter.hole[0] < inside < parameter.hole[1]:
            inside = float(getattr(effect, name))
        kept.append(np.float64(inside))
    return with_shape(effect, names, kept) if names else effect


def sized(found: list[Found], joint: Joint, forbid: Sequence[str]) -> list[Found]:
    """The causes whose size is surely not zero, and those whose law alone is open, with all that it may be.

    Where the amplitude's interval includes zero because any of several laws would do, the set says so; where nothing
    else explains the misfit, there is no cause to tell of.
    """
    out = []
    for one, effect, at in zip(found, joint.causes, joint.fitted.places, strict=True):
        if has_size(effect, joint.fitted, at):
            out.append(one)
        elif (more := _open(one, effect, forbid)) and not type(effect).contains:
            out.append(replace(one, ambiguous=more))
    return out


def opened(found: list[Found], joint: Joint, forbid: Sequence[str]) -> list[Found]:
    """The causes, each whose size this fit leaves open with all that it may be.

    The fit that predicts best weighs rows otherwise than the one that found the causes.
    """
    each = zip(found, joint.causes, joint.fitted.places, strict=True)
    return [
        one if has_size(effect, joint.fitted, at) else replace(one, ambiguous=_open(one, effect, forbid))
        for one, effect, at in each
    ]


def _open(one: Found, effect: Effect, forbid: Sequence[str]) -> tuple[Name, ...]:
    """What a cause without a sure size may be: what was told apart poorly, or any law of the speed for such a law."""
    laws = [n for n, e in CATALOGUE.items() if effect.speed_law and e.speed_law and n not in (effect.name, *forbid)]
    return tuple(dict.fromkeys([*one.ambiguous, *one.alike, *(Name(n, one.name.at) for n in laws)]))


def has_size(effect: Effect, fitted: Fitted, place: tuple[int, ...]) -> bool:
    """Whether the effect's size is surely not zero: its amplitudes' 95 % region excludes it.

    Amplitudes that a simpler effect has too do not count: a spring without stiffness is an offset. Of friction that
    fades they are judged at its time: where that is longer than the recordings, a larger and slower change is the same.
    """
    own = _amplitudes(effect)
    given = _shape_places(effect, place) if effect.fades else ()
    return not own or kind(effect) != "columns" or _beyond_zero(effect, fitted, place, own, given) > 1


def least_sure(joint: Joint) -> int | None:
    """Which of the causes is least surely there by the intervals that are told, of those that are not; else None.

    Of a law of the speed whose shape is open the amplitude is judged at that shape: the same friction comes of many
    pairs of strength and exponent, none of them surely, and of no strength at none. So it is with friction that fades.
    Friction that builds up over a distance which may be zero may be plain friction.
    """
    shares = []
    for effect, place in zip(joint.causes, joint.fitted.places, strict=True):
        own = _amplitudes(effect) if kind(effect) == "columns" else list(range(len(place)))
        given = _shape_places(effect, place) if effect.speed_law or effect.fades else ()
        there = [(own, given)] if own else []
        there += [([fitted_fields(effect).index(name)], ()) for name in effect.vanishes]
        shares.append(min((_beyond_zero(effect, joint.fitted, place, *which) for which in there), default=np.inf))
    least = int(np.argmin(shares)) if shares else 0
    return least if shares and shares[least] <= 1 else None


def without_a_number(joint: Joint) -> int | None:
    """The first of the causes that is a body's, or a link's, of which none of the ten numbers is told from zero.

    Together they may surely move what the link's torque depends on; but nobody could put in any of them, and a gain of
    its joint follows as much.
    """
    for k, (effect, place) in enumerate(zip(joint.causes, joint.fitted.places, strict=True)):
        if effect.inertial:
            value = np.array([float(getattr(effect, name)) for name in fitted_fields(effect)])
            variance = np.diag(joint.fitted.covariance)[list(place)]
            if np.all(value**2 < NUMBER**2 * variance):
                return k
    return None


def _amplitudes(effect: Effect) -> list[int]:
    """Which of an effect's amplitudes no simpler effect has; of one that is known before any data, its shapes."""
    simpler = {name for inside in type(effect).contains for name in find(inside).parameters()}
    own, known = effect.amplitudes(), effect.parameters()
    if any(known[name].expected is not None for name in own):
        return list(range(len(own), len(own) + len(shapes(type(effect)))))
    return [k for k, name in enumerate(own) if name not in simpler]


def _shape_places(effect: Effect, place: tuple[int, ...]) -> Sequence[int]:
    """Which of an effect's parameters are its shape."""
    return range(len(place) - len(shapes(type(effect))), len(place))


def _beyond_zero(
    effect: Effect, fitted: Fitted, place: tuple[int, ...], own: Sequence[int], given: Sequence[int] = ()
) -> float:
    """How far some of an effect's parameters are from zero, where those `given` are as fitted: 1 on the border of their
    95 % region."""
    from scipy.special import chdtri  # scipy is slow to import

    names = fitted_fields(effect)
    at, known = np.array(place)[list(own)], np.array(place)[list(given)].astype(int)
    value = np.array([float(getattr(effect, names[k])) for k in own])
    covariance = fitted.covariance[np.ix_(at, at)]
    if len(known):
        shaped = fitted.at_shapes
        covariance = _given(fitted.covariance, list(at), list(known)) if shaped is None else shaped[np.ix_(at, at)]
    size = value @ np.linalg.pinv(covariance, hermitian=True) @ value
    return float(size / chdtri(len(own), 1 - SIZE_REGION))
