"""Models compared on rows that they were not fitted to: fold by fold, judged by blocks, resampled for confidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..estimation.joint_rows import JointRows
from ..estimation.rows import UNKNOWN, Prior, Rows

__all__ = [
    "FoldSums",
    "Ground",
    "Hypothesis",
    "Verdicts",
    "coefficients",
    "fewer_sums",
    "fold_sums",
    "ground",
    "grown_sums",
    "judge",
    "judge_grown",
    "last_coefficient",
    "left_out",
    "overlap",
    "prefix_sums",
    "shares_of_wins",
    "sums_of",
    "told",
    "t_needed",
    "t_value",
]


MOST = 10.0  # times the median size of the blocks' differences: what a gain counts for at the most
TINY = 1e-12  # of the diagonal: the rounding of columns that nothing excites


class Hypothesis(NamedTuple):
    """Regressor, prior and fixed torque (whitened rows) of one model of the data."""

    X: JointRows
    prior: Prior
    fixed: Float[np.ndarray, "nv T"] | float = 0.0


class Verdicts(NamedTuple):
    """What the data say of a hypothesis: penalised sum of squares of the whole fit, squares by held-out block."""

    cost: float
    theta: Float[np.ndarray, " P"]
    folds: Float[np.ndarray, "folds P"]  # coefficients without each fold
    blocks: Float[np.ndarray, " blocks"]  # sum of squares of each block, predicted without its fold
    without: Float[np.ndarray, " folds"]  # penalised sum of squares of the fit without each fold
    residual: Float[np.ndarray, "nv T"]  # of the whole fit
    error: Float[np.ndarray, "nv T"]  # of each fold, predicted without it

    def own(self, rows: Rows, joints: Sequence[int]) -> Float[np.ndarray, " blocks"]:
        """As `blocks`, of the rows of some joints."""
        return _block_squares(rows, self.error[list(joints)])

    @property
    def heldout(self) -> float:
        """Sum of squares over all blocks, each predicted without its fold."""
        return float(self.blocks.sum())


class Ground(NamedTuple):
    """A hypothesis that many others extend by a few columns: what they share with it."""

    verdicts: Verdicts
    inverse: Float[np.ndarray, "folds+1 P P"]  # of the normal matrix without each fold, then of all rows


class FoldSums(NamedTuple):
    """Normal equations of each fold."""

    gram: Float[np.ndarray, "folds P P"]
    moment: Float[np.ndarray, "folds P"]
    square: Float[np.ndarray, " folds"]


def fold_sums(rows: Rows, X: JointRows, y: Float[np.ndarray, "nv T"] | None = None) -> FoldSums:
    """X'X, X'y and y'y over each fold; `y` is the rows' own unless given."""
    y, stretches = rows.y if y is None else y, _stretches(rows)
    folds, P = rows.fold.max() + 1, X.width
    gram, moment, square = np.zeros((folds, P, P)), np.zeros((folds, P)), np.zeros(folds)
    for own, target in zip(X.own, y, strict=True):
        one = np.zeros((folds, len(own.place), len(own.place)))
        for fold, here in stretches:
            few = own.columns[here]
            one[fold] += few.T @ few
            moment[fold, own.place] += few.T @ target[here]
            square[fold] += target[here] @ target[here]
        gram[:, own.place[:, None], own.place] += one
    return FoldSums(gram, moment, square)


def _stretches(rows: Rows) -> list[tuple[int, slice]]:
    """The rows of each fold as stretches that follow one another, with its number; rows of no fold are in none."""
    firsts = np.append(0, np.flatnonzero(np.diff(rows.fold)) + 1)
    ends = np.append(firsts[1:], len(rows.fold))
    pairs = zip(firsts.tolist(), ends.tolist(), strict=True)
    return [(int(rows.fold[a]), slice(a, b)) for a, b in pairs if rows.fold[a] >= 0]


def _predicted(rows: Rows, X: JointRows, each: Float[np.ndarray, "folds+1 P"]) -> Float[np.ndarray, "nv T 2"]:
    """What the coefficients of `each` fold's fit make of its rows (nothing of those in no fold), and the last of all.

    All at once: the columns are read from memory once.
    """
    out, fold = np.zeros((*X.shape[:2], 2)), np.maximum(rows.fold, 0)[:, None]
    for told, own in zip(out, X.own, strict=True):
        every = own.columns @ each.T[own.place]
        told[:, 0] = np.take_along_axis(every, fold, axis=1)[:, 0]
        told[:, 1] = every[:, -1]
    out[:, rows.fold < 0, 0] = 0.0
    return out


def grown_sums(rows: Rows, known: FoldSums, more: JointRows) -> FoldSums:
    """The sums of the rows' first columns, which are `known`, with those of columns more."""
    (folds, P), k = known.moment.shape, more.width
    gram, moment = np.zeros((folds, P + k, P + k)), np.zeros((folds, P + k))
    gram[:, :P, :P], moment[:, :P] = known.gram, known.moment
    for own, its, target in zip(rows.X.first(P).own, more.own, rows.y, strict=True):
        if not len(its.place):  # columns of a cause at other joints
            continue
        place = its.place + P
        for fold, here in _stretches(rows):
            few = its.columns[here]
            gram[fold, own.place[:, None], place] += own.columns[here].T @ few
            gram[fold, place[:, None], place] += few.T @ few
            moment[fold, place] += few.T @ target[here]
    gram[:, P:, :P] = np.swapaxes(gram[:, :P, P:], 1, 2)
    return FoldSums(gram, moment, known.square)


def prefix_sums(rows: Rows, gram: Float[np.ndarray, "folds P P"]) -> FoldSums:
    """The sums of the first columns of some rows, their products being known."""
    return _moments(rows, rows.X.first(gram.shape[1]), gram, rows.y)


def _moments(rows: Rows, X: JointRows, gram: Float[np.ndarray, "folds P P"], y: Float[np.ndarray, "nv T"]) -> FoldSums:
    moment, square = np.zeros(gram.shape[:2]), np.zeros(len(gram))
    for own, target in zip(X.own, y, strict=True):
        for fold, here in _stretches(rows):
            moment[fold, own.place] += target[here] @ own.columns[here]
            square[fold] += target[here] @ target[here]
    return FoldSums(gram, moment, square)


def fewer_sums(known: FoldSums, without: Sequence[int]) -> FoldSums:
    """The sums of the columns that are left without some."""
    gram = np.delete(np.delete(known.gram, without, axis=1), without, axis=2)
    return FoldSums(gram, np.delete(known.moment, without, axis=1), known.square)


def sums_of(rows: Rows, known: FoldSums, y: Float[np.ndarray, "nv T"]) -> FoldSums:
    """The sums of the same columns with another torque `y`."""
    return _moments(rows, rows.X, known.gram, y)


def coefficients(sums: FoldSums, prior: Prior) -> Float[np.ndarray, " P"]:
    """The fit to all rows."""
    gram, moment, square = (part.sum(0) for part in sums)
    return _solve(gram, moment, square, prior)[0]


def left_out(sums: FoldSums, prior: Prior) -> Float[np.ndarray, "folds P"]:
    """The fits to all rows but those of each fold."""
    gram, moment, square = (part.sum(0) for part in sums)
    return np.array([_solve(gram - g, moment - m, square - s, prior)[0] for g, m, s in zip(*sums, strict=True)])


def last_coefficient(sums: FoldSums, prior: Prior) -> tuple[Float[np.ndarray, " P"], float]:
    """`coefficients`, and the variance of the last of them."""
    gram, moment, square = (part.sum(0) for part in sums)
    theta = _solve(gram, moment, square, prior)[0]
    unit = np.zeros(len(theta))
    unit[-1] = 1.0
    nothing = prior._replace(mean=np.zeros(len(theta)))
    return theta, max(float(_solve(gram, unit, 0.0, nothing)[0][-1]), 0.0)


def told(sums: FoldSums, prior: Prior, count: int) -> float:
    """How many of the first `count` coefficients the data tell, not the prior: trace of (G + L)^-1 G."""
    gram = sums.gram.sum(0)
    A = gram + np.diag(prior.precision)
    return float(np.trace(np.linalg.solve(A + TINY * np.diag(np.maximum(np.diag(A), TINY)), gram)[:count, :count]))


def judge(rows: Rows, hypothesis: Hypothesis, known: FoldSums | None = None, without: Sequence[int] = ()) -> Verdicts:
    """Fit to all rows and to all but each fold, and predict the fold that was left out.

    `known` are the sums of the hypothesis. The columns `without` are not fitted: their coefficients are zero.
    """
    X, y, prior = hypothesis.X, rows.y - hypothesis.fixed, hypothesis.prior
    sums, kept = known or fold_sums(rows, X, y), np.delete(np.arange(X.width), without)
    if len(without):
        sums, prior = fewer_sums(sums, without), Prior(prior.mean[kept], prior.precision[kept])
    G, b, yy = (part.sum(0) for part in sums)
    solved = [_solve(G - g, b - m, yy - s, prior) for g, m, s in zip(*sums, strict=True)]
    solved.append(_solve(G, b, yy, prior))
    each, costs = np.zeros((len(solved), X.width)), np.array([cost for _, cost in solved])
    each[:, kept] = [solution for solution, _ in solved]
    predicted = _predicted(rows, X, each)
    error, residual = y - predicted[..., 0], y - predicted[..., 1]
    squares = _block_squares(rows, error)
    return Verdicts(float(costs[-1]), each[-1], each[:-1], squares, costs[:-1], residual, error)


def ground(verdicts: Verdicts, prior: Prior, sums: FoldSums) -> Ground:
    """What judging hypotheses that extend one (its verdicts, prior and sums) needs once."""
    gram = sums.gram.sum(0) - np.concatenate([sums.gram, np.zeros_like(sums.gram[:1])])
    A = gram + np.diag(prior.precision)
    diagonal = np.maximum(np.diagonal(A, axis1=1, axis2=2), TINY)
    inverse = np.linalg.inv(A + TINY * diagonal[:, None] * np.eye(A.shape[1]))
    return Ground(verdicts, inverse)


def judge_grown(rows: Rows, base: Ground, joints: Sequence[int], more: Float[np.ndarray, "k rows T"]) -> Verdicts:
    """`judge` of the ground hypothesis with columns more, of which nothing is known, in the rows of some joints.

    By block elimination: with C = X'Z and S = Z'Z - C'A^-1 C the new coefficients are t = S^-1 (Z'y - C'theta), the
    others change by -A^-1 C t and the squares by -t'S t; all for the whole fit and for that without each fold.
    """
    was, k, (folds, P) = base.verdicts, len(more), base.verdicts.folds.shape
    crossed, gram, moment = np.zeros((folds, P, k)), np.zeros((folds, k, k)), np.zeros((folds, k))
    for fold, here in _stretches(rows):
        for one, joint in enumerate(joints):
            Z, own = more[:, one, here], rows.X.own[joint]
            crossed[fold, own.place] += own.columns[here].T @ Z.T
            gram[fold] += Z @ Z.T
            moment[fold] += Z @ rows.y[joint, here]
    shared, own, right = _without(crossed), _without(gram), _without(moment)[..., None]
    known = np.concatenate([was.folds, was.theta[None]])[..., None]
    across = np.matmul(base.inverse, shared)
    S = own - np.matmul(np.swapaxes(shared, 1, 2), across)
    diagonal = np.maximum(np.diagonal(own, axis1=1, axis2=2) + UNKNOWN, TINY)
    S = S + UNKNOWN * np.eye(k) + TINY * diagonal[:, None] * np.eye(k)
    left = right - np.matmul(np.swapaxes(shared, 1, 2), known)
    t = np.linalg.solve(S, left)
    drop = (left * t).sum((1, 2))
    change = -np.matmul(across, t)
    theta = np.concatenate([known + change, t], axis=1)[..., 0]
    predicted, own_joints = _predicted(rows, rows.X, change[..., 0]), list(joints)
    error, residual = was.error - predicted[..., 0], was.residual - predicted[..., 1]
    residual[own_joints] -= np.tensordot(t[folds, :, 0], more, 1)
    each = np.where(rows.fold >= 0, t[rows.fold, :, 0].T, 0.0)
    error[own_joints] -= np.einsum("kt,krt->rt", each, more)
    squares, costs = _block_squares(rows, error), was.without - drop[:folds]
    return Verdicts(was.cost - float(drop[folds]), theta[folds], theta[:folds], squares, costs, residual, error)


def _without(parts: Float[np.ndarray, "folds *rest"]) -> Float[np.ndarray, "folds+1 *rest"]:
    """Sums over all folds but each, then over all."""
    return np.concatenate([parts.sum(0) - parts, parts.sum(0)[None]])


def _block_squares(rows: Rows, error: Float[np.ndarray, "nv T"]) -> Float[np.ndarray, " blocks"]:
    used = rows.block >= 0
    return np.bincount(rows.block[used], (error**2).sum(0)[used])


def t_value(worse: Float[np.ndarray, " blocks"], better: Float[np.ndarray, " blocks"]) -> float:
    """Student t of the blocks' differences: how surely `better` predicts better.

    One block that gains far more than all others must not make what they all say less sure: it is the larger t of the
    differences and of those that count up to `MOST` times their median size.
    """
    gain = worse - better
    gains = np.stack([gain, np.minimum(gain, MOST * np.median(np.abs(gain)))])
    spread = gains.std(axis=1, ddof=1) / np.sqrt(len(gain))
    return float(np.max(np.where(spread > 0, gains.mean(1) / np.where(spread > 0, spread, 1.0), 0.0)))


def t_needed(blocks: int, t: float, tried: int = 1) -> float:
    """The Student t of so many blocks' differences that chance exceeds as often as it exceeds `t` of very many; the
    largest of as many as were `tried` no more often."""
    from scipy.special import ndtr, stdtrit  # scipy is slow to import

    return float(stdtrit(max(blocks - 1, 1), 1 - ndtr(-t) / tried))


def overlap(current: Verdicts, one: Verdicts, other: Verdicts) -> float:
    """Cosine between what two hypotheses change of the current residual: 1, the same misfit; 0, another one."""
    a, b = (current.residual - v.residual for v in (one, other))
    return float(np.vdot(a, b) / np.sqrt(np.vdot(a, a) * np.vdot(b, b) + 1e-300))


def shares_of_wins(
    costs: Float[np.ndarray, "hypotheses blocks"], generator: np.random.Generator, draws: int = 500
) -> Float[np.ndarray, " hypotheses"]:
    """Share of block resamples in which each hypothesis predicts best."""
    count = costs.shape[1]
    picks = generator.integers(0, count, (draws, count))
    winners = costs[:, picks].sum(2).argmin(0)
    return np.bincount(winners, minlength=len(costs)) / draws


def _solve(
    G: Float[np.ndarray, "P P"], b: Float[np.ndarray, " P"], yy: float, prior: Prior
) -> tuple[Float[np.ndarray, " P"], float]:
    A = G + np.diag(prior.precision)
    A = A + TINY * np.diag(np.maximum(np.diag(A), TINY))
    right = b + prior.precision * prior.mean
    theta = np.linalg.solve(A, right)
    return theta, float(yy + prior.precision @ prior.mean**2 - right @ theta)
