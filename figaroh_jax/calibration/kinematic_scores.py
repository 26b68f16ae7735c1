r"""Score tests of blocks of columns against a fit with priors, with the maximum over all blocks inside the bootstrap.

The fit's rows, whitened, and the rows of its prior stand above each other: $e = (r, \Lambda^{1/2} y)$ is what it
leaves, M the projector off its columns, $\tilde Z = (Z, 0)$ a block. $Q = |B' e|^2$ with B an orthonormal basis of
$M \tilde Z$, over the mean square of e; Wilson and Hilferty's cube root puts blocks of different size on one scale.
Under the null e is white: it is drawn again, with its own level, and the largest score of all blocks kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..estimation.marginal import FLAT, Linear

__all__ = ["Scores", "score_blocks", "score_jitter"]

_CUT = 1e-7  # of a column's length, that must be left beside the fit
_DRAWS = 400

Array = np.ndarray


class Scores(NamedTuple):
    """Scores of the blocks (-inf: nothing of it is left beside the fit) and the family-wise p-value of the largest."""

    q: Float[Array, " blocks"]
    z: Float[Array, " blocks"]
    size: Float[Array, " blocks"]  # columns that are left
    p_value: float
    level: float  # mean square of the whitened rows: 1 where the noise is right


def score_blocks(
    linear: Linear,
    noise: Float[Array, " rows"],
    used: Bool[Array, " rows"],
    precision: Float[Array, " unknowns"],
    blocks: Sequence[Float[Array, "rows _"]],
    free: Bool[Array, " unknowns"],
    seed: int = 0,
) -> Scores:
    """Scores of `blocks` beside the fit of the `free` unknowns with the given noise and prior precision."""
    rows = np.flatnonzero(used)
    e, basis, freedom = _left(linear, noise, rows, precision, free)
    bases = [_basis(_above(Z[rows] / noise[rows, None], len(e)), basis) for Z in blocks]
    size = np.array([b.shape[1] for b in bases])
    whole = np.hstack(bases) if size.sum() else np.zeros((len(e), 0))
    level = float(e @ e / freedom)
    q = _sums((whole.T @ e)[None] ** 2, size)[0] / max(level, 1e-300)
    draws = np.random.default_rng(seed).normal(size=(_DRAWS, len(e)))
    square = np.sum(draws**2, axis=1) - np.sum((draws @ basis) ** 2, axis=1)
    null = _sums((draws @ whole) ** 2, size) / (square / freedom)[:, None]
    z, largest = _scale(q, size), _scale(null, size).max(axis=1, initial=-np.inf)
    top = z.max(initial=-np.inf)
    return Scores(q, z, size, float((1 + np.sum(largest >= top)) / (_DRAWS + 1)), level)


def score_jitter(
    linear: Linear,
    noise: Float[Array, " rows"],
    used: Bool[Array, " rows"],
    precision: Float[Array, " unknowns"],
    ways: Float[Array, "rows joints"],
    free: Bool[Array, " unknowns"],
    seed: int = 0,
) -> tuple[float, int]:
    r"""Family-wise p-value that no joint errs at random from posture to posture, and the joint that most looks so.

    With g the rows of one posture by a motion of the joint, `ways`, the statistic is $\sum (g' e)^2 / \sum g' g$ over
    the postures, the score of a variance component; the null draws e as `score_blocks` does.
    """
    rows = np.flatnonzero(used)
    e, basis, freedom = _left(linear, noise, rows, precision, free)
    G = _above(ways[rows] / noise[rows, None], len(e))
    posture = np.full(len(e), -1)
    posture[: len(rows)] = linear.posture[rows]
    member = (posture[:, None] == np.unique(posture[posture >= 0])).astype(float)

    def statistic(left: Array) -> Array:
        """(draws, joints), in the mean square of each draw."""
        sums = np.stack([np.sum(((left * g) @ member) ** 2, axis=1) / max(g @ g, 1e-300) for g in G.T], axis=1)
        return sums / (np.sum(left**2, axis=1) / freedom)[:, None]

    draws = np.random.default_rng(seed).normal(size=(_DRAWS, len(e)))
    null = statistic(draws - (draws @ basis) @ basis.T)
    middle, spread = null.mean(axis=0), null.std(axis=0) + 1e-300
    found = (statistic(e[None])[0] - middle) / spread
    largest = ((null - middle) / spread).max(axis=1)
    return float((1 + np.sum(largest >= found.max())) / (_DRAWS + 1)), int(np.argmax(found))


def _left(linear: Linear, noise: Array, rows: Array, precision: Array, free: Array) -> tuple[Array, Array, int]:
    """What the fit leaves of its rows and prior rows, whitened; an orthonormal basis of its columns; its freedom."""
    G = linear.jacobian[rows][:, free] / noise[rows, None]
    root = np.sqrt(np.where(linear.prior[free] == FLAT, 0.0, precision[free]))
    A = np.vstack([G, np.diag(root)])
    left = (linear.residual[rows] - linear.jacobian[rows][:, ~free] @ linear.at[~free]) / noise[rows]
    e = np.concatenate([left, root * linear.at[free]])
    basis, kept = np.linalg.qr(A)
    solid = np.abs(np.diag(kept)) > 1e-12 * np.abs(np.diag(kept)).max()
    basis = basis[:, solid]
    return e - basis @ (basis.T @ e), basis, len(e) - basis.shape[1]


def _above(Z: Array, length: int) -> Array:
    """The columns with zeros in the prior rows below them."""
    return np.vstack([Z, np.zeros((length - len(Z), Z.shape[1]))])


def _basis(Z: Array, basis: Array) -> Array:
    """Orthonormal basis of what the columns add to `basis`."""
    length = np.linalg.norm(Z, axis=0)
    Z = Z[:, length > 0.0] / length[length > 0.0]
    Z = Z - basis @ (basis.T @ Z)
    Z = Z - basis @ (basis.T @ Z)
    u, s, _ = np.linalg.svd(Z, full_matrices=False)
    return u[:, s**2 > _CUT]


def _sums(squares: Array, size: Array) -> Array:
    ends = np.concatenate([[0], np.cumsum(size)])
    total = np.concatenate([np.zeros((len(squares), 1)), np.cumsum(squares, axis=1)], axis=1)
    return total[:, ends[1:]] - total[:, ends[:-1]]


def _scale(q: Array, size: Array) -> Array:
    k = np.maximum(size, 1)
    z = ((q / k) ** (1.0 / 3.0) - (1.0 - 2.0 / (9.0 * k))) / np.sqrt(2.0 / (9.0 * k))
    return np.where(size > 0, z, -np.inf)
