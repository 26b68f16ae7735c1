"""Models compared on rows that they were not fitted to: fold by fold, judged by blocks, resampled for confidence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .evidence import Prior, Rows

__all__ = [
    "FoldSums",
    "Hypothesis",
    "Verdicts",
    "fold_sums",
    "grown_sums",
    "judge",
    "overlap",
    "shares_of_wins",
    "t_value",
]


class Hypothesis(NamedTuple):
    """Regressor, prior and fixed torque (whitened rows) of one model of the data."""

    X: Float[np.ndarray, "nv T P"]
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

    @property
    def heldout(self) -> float:
        """Sum of squares over all blocks, each predicted without its fold."""
        return float(self.blocks.sum())


class FoldSums(NamedTuple):
    """Normal equations of each fold."""

    gram: Float[np.ndarray, "folds P P"]
    moment: Float[np.ndarray, "folds P"]
    square: Float[np.ndarray, " folds"]


def fold_sums(rows: Rows, X: Float[np.ndarray, "nv T P"], y: Float[np.ndarray, "nv T"] | None = None) -> FoldSums:
    """X'X, X'y and y'y over each fold; `y` is the rows' own unless given."""
    y = rows.y if y is None else y
    parts = []
    for fold in range(rows.fold.max() + 1):
        own = rows.fold == fold
        tall, target = X[:, own].reshape(-1, X.shape[-1]), y[:, own].reshape(-1)
        parts.append((tall.T @ tall, tall.T @ target, target @ target))
    return FoldSums(*(np.array(part) for part in zip(*parts, strict=True)))


def grown_sums(rows: Rows, known: FoldSums, X: Float[np.ndarray, "nv T P"]) -> FoldSums:
    """The sums of columns whose first ones are known."""
    P, folds = known.gram.shape[1], len(known.gram)
    gram, moment = np.zeros((folds, X.shape[2], X.shape[2])), np.zeros((folds, X.shape[2]))
    gram[:, :P, :P], moment[:, :P] = known.gram, known.moment
    for fold in range(folds):
        own = rows.fold == fold
        tall = X[:, own].reshape(-1, X.shape[2])
        cross = tall.T @ tall[:, P:]
        gram[fold, :, P:], gram[fold, P:, :P] = cross, cross[:P].T
        moment[fold, P:] = tall[:, P:].T @ rows.y[:, own].reshape(-1)
    return FoldSums(gram, moment, known.square)


def judge(rows: Rows, hypothesis: Hypothesis, known: FoldSums | None = None) -> Verdicts:
    """Fit to all rows and to all but each fold, and predict the fold that was left out."""
    X, y, prior = hypothesis.X, rows.y - hypothesis.fixed, hypothesis.prior
    sums = known or fold_sums(rows, X, y)
    G, b, yy = (part.sum(0) for part in sums)
    theta, cost = _solve(G, b, yy, prior)
    left = [_solve(G - g, b - m, yy - s, prior) for g, m, s in zip(*sums, strict=True)]
    each = np.stack([solution for solution, _ in left])
    residual = y.copy()
    for fold, solution in enumerate(each):
        own = rows.fold == fold
        residual[:, own] -= X[:, own] @ solution
    used = rows.block >= 0
    blocks = np.bincount(rows.block[used], (residual**2).sum(0)[used])
    return Verdicts(cost, theta, each, blocks, np.array([cost for _, cost in left]), y - X @ theta)


def t_value(worse: Float[np.ndarray, " blocks"], better: Float[np.ndarray, " blocks"]) -> float:
    """Student t of the blocks' differences: how surely `better` predicts better."""
    gain = worse - better
    spread = gain.std(ddof=1) / np.sqrt(len(gain))
    return float(gain.mean() / spread) if spread > 0 else 0.0


def overlap(current: Verdicts, one: Verdicts, other: Verdicts) -> float:
    """Cosine between what two hypotheses change of the current residual: 1, the same misfit; 0, another one."""
    a, b = (current.residual - v.residual for v in (one, other))
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum() + 1e-300))


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
    A = A + 1e-12 * np.diag(np.maximum(np.diag(A), 1e-12))
    right = b + prior.precision * prior.mean
    theta = np.linalg.solve(A, right)
    return theta, float(yy + prior.precision @ prior.mean**2 - right @ theta)
