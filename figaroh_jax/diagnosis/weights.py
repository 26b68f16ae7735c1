"""How much the rows of each joint count by its speed: dry friction at and around rest is what no law of speed predicts.

During a stick the friction takes any value up to its limit, and the sign of a filtered, noisy velocity is wrong around
a reversal. Rows at a reversal are left out. The others are weighted by what a rich model of the joint leaves at their
speed, against what it leaves where the joint is fast.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..estimation.rows import Rows
from ..recordings.stacked import Records, filter_rows
from .flexible import smooth_functions
from .holdout import fold_error, weighted_rms
from .problem import Problem
from .state import State, plain_rows, whitened
from .step import stand
from .thresholds import (
    FAST,
    LEAST_FACTOR,
    LOW_SPEEDS,
    REVERSAL,
    REVERSALS_AT_MOST,
    ROWS_OF_A_BIN,
    SPEED_EDGES,
    WHITE_GAIN,
)

__all__ = [
    "relative_speed",
    "speed_factors",
    "weighted_by_speed",
    "white_where_better",
    "without_held",
    "without_reversals",
]

HELD = 2.0  # times what a rich model leaves in motion: what it leaves at rest is dry friction
RIDGE = 1e-6  # of the mean diagonal of a joint's normal equations


def without_reversals(records: Records) -> Records:
    """The recordings without the rows of a joint within a quarter period of the cutoff around its reversals."""
    reach = round(REVERSAL / float(records.cutoff) / float(records.dt))
    near = np.stack([_near_reversal(v, k, reach) for v, k in zip(records.velocity, records.row_samples(), strict=True)])
    near &= np.asarray(records.weight) > 0
    often = near.sum((0, 1)) > REVERSALS_AT_MOST * records.fitted.sum((0, 1))
    return eqx.tree_at(lambda r: r.weight, records, np.where(near & ~often, 0.0, records.weight))


def _near_reversal(velocity: Float[np.ndarray, "N nv"], rows: np.ndarray, reach: int) -> Bool[np.ndarray, "M nv"]:
    turns = np.cumsum(np.vstack([np.zeros((1, velocity.shape[1])), velocity[:-1] * velocity[1:] < 0]), axis=0)
    last = len(velocity) - 1
    return turns[np.minimum(rows + reach, last)] > turns[np.maximum(rows - reach, 0)]


def weighted_by_speed(problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"]) -> Problem:
    """The problem with each row of the fit multiplied by 1/sqrt(factor) of its joint's speed."""
    speed = relative_speed(problem)
    factors = speed_factors(problem, state, whitening)
    if (factors == 1).all():
        return problem
    centres = np.array(SPEED_EDGES[:-1]) + np.diff(SPEED_EDGES) / 2
    each = [np.interp(s, centres, np.log(f)) for s, f in zip(np.moveaxis(speed, 2, 0), factors, strict=True)]
    return problem.weighted(problem.records.fitted * np.exp(-np.stack(each, axis=2) / 2))


def speed_factors(problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"]) -> Float[np.ndarray, "nv bins"]:
    """Mean square of what a rich model leaves in each bin of |v| / max |v|, over that of the fast rows; never rising.

    The model is the baseline with smooth functions of the joint's position, speed and load, and of its friction over
    position and speed, low speeds apart: what a law of the velocity could predict there is no scatter. It serves the
    weights alone. Bins of few rows are drawn towards 1.
    """
    rows = whitened(problem, state, whitening)
    weight, speed = (
        np.moveaxis(x, 2, 0).reshape(len(rows.y), -1) for x in (problem.records.weight, relative_speed(problem))
    )
    functions, out = smooth_functions(state.motion), []
    for joint in range(len(rows.y)):
        own = np.concatenate([functions[joint], _friction_of_low_speed(problem, state, joint)])
        smooth = _whitened_rows(problem, state, own, whitening, joint)
        residual = _left(rows, state, joint, smooth) / np.maximum(weight[joint], 1e-12)
        used = weight[joint] > 0
        out.append(_bin_factors(residual[used], speed[joint][used]))
    return np.array(out)


def without_held(problem: Problem, state: State) -> Problem:
    """The problem without the rows at which a joint stands, where its motion says clearly that they are no model's.

    Dry friction holds a joint with any torque up to its limit. What a rich model that is fitted to the joint's motion
    leaves of the rows at rest says how much of that there is: where its squares are several times those that it leaves
    in motion, row by row and in all, they tell nothing of the robot, and a cause that explains them stands for
    friction. Where they are not, the rows are weighted by their speed as others are.
    """
    records = problem.records
    standing = np.asarray(records.standing) * records.fitted
    if not standing.any():
        return problem
    rows, functions = plain_rows(problem, state), smooth_functions(state.motion)
    ones, weight = np.ones((len(records.omega), len(rows.y))), np.asarray(records.weight).copy()
    for joint in range(len(rows.y)):
        still = standing[..., joint].reshape(-1) > 0
        moves = (np.asarray(records.judged)[..., joint] * records.fitted[..., joint]).reshape(-1) > 0
        if not still.any() or moves.sum() < ROWS_OF_A_BIN:
            continue
        smooth = _whitened_rows(problem, state, functions[joint], ones, joint)
        left = _left(rows, state, joint, smooth, moves)
        at_rest, moving = left[still] ** 2, left[moves] ** 2
        if at_rest.mean() > HELD**2 * moving.mean() and at_rest.sum() > HELD**2 * moving.sum():
            weight[..., joint] *= 1 - standing[..., joint]
    return problem.weighted(weight)


def _friction_of_low_speed(problem: Problem, state: State, joint: int) -> Float[np.ndarray, "k nN"]:
    """Friction that falls, or rises, within some share of the joint's top speed: a law of the velocity, no scatter."""
    fitted = np.asarray(problem.records.fitted)[..., joint] > 0
    speed = np.abs(np.asarray(problem.records.velocity)[..., joint])
    top = float(np.take_along_axis(speed, problem.records.row_samples(), axis=1)[fitted].max(initial=1e-12))
    v, s = np.asarray(state.motion.velocity)[:, joint], np.asarray(state.motion.direction)[:, joint]
    return np.stack([s * np.exp(-((v / (width * top)) ** 2)) for width in LOW_SPEEDS])


def white_where_better(
    problem: Problem, state: State, coloured: Float[np.ndarray, "F nv"]
) -> tuple[Float[np.ndarray, "F nv"], bool]:
    """What the rows pass: the `coloured` whitening, or each joint's residual RMS alone where that predicts better.

    The spectrum of the noise says whether there is a rest. Where the model errs by more than the noise, weights by the
    noise alone follow what the model does worst; judged by the error in N m on the folds. The RMS is that of rows as
    they are weighted: slow ones, which count less, must not make their joint's fast ones count less too.
    """
    step = stand(problem, state, coloured)
    error, residual = (
        fold_error(problem, step.state, step.verdicts.folds, problem.layout.fold),
        weighted_rms(problem, step.state),
    )
    white = np.broadcast_to(1 / np.maximum(residual, 1e-12 * residual.max()), coloured.shape)
    other = stand(problem, state, white)
    if fold_error(problem, other.state, other.verdicts.folds, problem.layout.fold) > (1 - WHITE_GAIN) * error:
        return coloured, False
    residual = weighted_rms(problem, other.state)
    return np.broadcast_to(1 / np.maximum(residual, 1e-12 * residual.max()), coloured.shape), True


def relative_speed(problem: Problem) -> Float[np.ndarray, "n M nv"]:
    """Speed of every joint at the rows of every recording, as a share of its largest in the rows that are fitted."""
    records = problem.records
    speed = np.take_along_axis(np.abs(np.asarray(records.velocity)), records.row_samples()[..., None], axis=1)
    return speed / np.maximum((speed * records.fitted).max((0, 1)), 1e-12)


def _whitened_rows(
    problem: Problem, state: State, columns: Float[np.ndarray, "k nN"], whitening: np.ndarray, joint: int
) -> Float[np.ndarray, "T k"]:
    records = problem.records
    n, samples, _, _ = records.shape
    response = (whitening[:, joint] * state.response(records.omega))[None]
    rows = filter_rows(records, columns.reshape(-1, n, samples), response, fitted=True)
    return (rows * np.asarray(records.weight)[:, :, joint]).reshape(len(columns), -1).T


def _left(
    rows: Rows,
    state: State,
    joint: int,
    smooth: Float[np.ndarray, "T k"],
    used: Bool[np.ndarray, " T"] | None = None,
) -> Float[np.ndarray, " T"]:
    """Residual of one joint's rows, the baseline's coefficients free for it alone (within their prior) and fitted to
    the rows `used`, by default all."""
    own = rows.X.own[joint]
    X = np.concatenate([own.columns, smooth], axis=1)
    precision = np.append(state.prior.precision[own.place], np.zeros(smooth.shape[1]))
    mean = np.append(state.prior.mean[own.place], np.zeros(smooth.shape[1]))
    asked = slice(None) if used is None else used
    A = X[asked].T @ X[asked]
    A += np.diag(precision + RIDGE * np.diag(A) + 1e-12)
    return rows.y[joint] - X @ np.linalg.solve(A, X[asked].T @ rows.y[joint][asked] + precision * mean)


def _bin_factors(residual: Float[np.ndarray, " rows"], speed: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " bins"]:
    bins = np.digitize(speed, SPEED_EDGES[1:-1])
    fast = speed >= FAST
    if fast.sum() < ROWS_OF_A_BIN:
        return np.ones(len(SPEED_EDGES) - 1)
    level = max(float((residual[fast] ** 2).mean()), 1e-300)
    counts = np.bincount(bins, minlength=len(SPEED_EDGES) - 1).astype(float)
    squares = np.bincount(bins, residual**2, minlength=len(counts))
    factor = (squares / level + ROWS_OF_A_BIN) / (counts + ROWS_OF_A_BIN)
    factor = _never_rising(factor, counts + 1e-9)
    factor = np.where(np.array(SPEED_EDGES[:-1]) >= FAST, 1.0, factor)
    return np.where(factor < LEAST_FACTOR, 1.0, factor)


def _never_rising(values: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The nearest sequence that never rises (pool adjacent violators)."""
    pools: list[list[float]] = []  # mean, weight, length
    for value, weight in zip(values, weights, strict=True):
        pools.append([float(value), float(weight), 1])
        while len(pools) > 1 and pools[-1][0] > pools[-2][0]:
            (b, wb, nb), (a, wa, na) = pools.pop(), pools.pop()
            pools.append([(a * wa + b * wb) / (wa + wb), wa + wb, na + nb])
    return np.concatenate([np.full(int(length), mean) for mean, _, length in pools])
