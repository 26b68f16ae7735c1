"""Models compared on rows that they were not fitted to: fold by fold, judged by blocks, resampled for confidence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .evidence import Prior, Rows

__all__ = ["Hypothesis", "Verdicts", "judge", "overlap", "shares_of_wins", "t_value"]


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


def judge(rows: Rows, hypothesis: Hypothesis) -> Verdicts:
    """Fit to all rows and to all but each fold, and predict the fold that was left out."""
    X, y = hypothesis.X, rows.y - hypothesis.fixed
    prior, folds = hypothesis.prior, rows.fold.max() + 1
    grams, moments, squares = [], [], []
    for fold in range(folds):
        own = rows.fold == fold
        tall, target = X[:, own].reshape(-1, X.shape[-1]), y[:, own].reshape(-1)
        grams.append(tall.T @ tall)
        moments.append(tall.T @ target)
        squares.append(target @ target)
    G, b, yy = np.sum(grams, axis=0), np.sum(moments, axis=0), float(np.sum(squares))
    theta, cost = _solve(G, b, yy, prior)
    left = [_solve(G - g, b - m, yy - s, prior) for g, m, s in zip(grams, moments, squares, strict=True)]
    each = np.stack([solution for solution, _ in left])
    residual = y - np.einsum("jtp,tp->jt", X, each[np.maximum(rows.fold, 0)], optimize=True)
    member = rows.block == np.arange(rows.block.max() + 1)[:, None]
    blocks = member.astype(float) @ (residual**2).sum(0)
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
