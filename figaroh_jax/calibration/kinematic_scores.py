r"""Score tests of blocks of columns against a fit with priors, with the maximum over all blocks inside the bootstrap.

The fit's rows, whitened, and the rows of its prior stand above each other: $e = (r, \Lambda^{1/2} y)$ is what it
leaves, M the projector off its columns, $\tilde Z = (Z, 0)$ a block. $Q = |B' e|^2$ with B an orthonormal basis of
$M \tilde Z$, over the mean square of the measured rows of e: links that are better than the prior's width say nothing
of the noise. Wilson and Hilferty's cube root puts blocks of different size on one scale.
Two nulls, the larger p counts: e is white, drawn again with its own level; and e of whole postures with their signs
flipped, which holds where the error of a posture moves all its rows together (play, a slack joint). The largest score
of all blocks is kept in each draw.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..estimation.marginal import FLAT, Linear, Posterior
from . import thresholds

__all__ = ["EXACT", "Scores", "Tested", "row_noise", "score_blocks", "score_jitter", "score_waves", "waves_shown"]

_CUT = 1e-16  # square of the share of a column that must be left beside the fit: more than rounding leaves
EXACT = 1e-8  # m or rad: what a simulation says without noise counts as no more exact, or rounding decides
_DRAWS = 400
_WAVE_DRAWS = 200

Array = np.ndarray


class Tested(NamedTuple):
    """A fit, beside which columns are scored."""

    linear: Linear
    noise: Float[Array, " rows"]  # one sigma, m or rad
    used: Bool[Array, " rows"]
    precision: Float[Array, " unknowns"]  # of the prior
    free: Bool[Array, " unknowns"]


class Scores(NamedTuple):
    """Scores of the blocks (-inf: nothing of it is left beside the fit) and the family-wise p-value of the largest."""

    q: Float[Array, " blocks"]
    z: Float[Array, " blocks"]
    size: Float[Array, " blocks"]  # columns that are left
    p_value: float
    level: float  # mean square of the whitened rows: 1 where the noise is right


def score_blocks(fit: Tested, blocks: Sequence[Float[Array, "rows _"]], seed: int = 0) -> Scores:
    """Scores of `blocks` beside the fit."""
    rows = np.flatnonzero(fit.used)
    e, basis, freedom = _left(fit, rows)
    bases = [_basis(_above(Z[rows] / fit.noise[rows, None], len(e)), basis) for Z in blocks]
    size = np.array([b.shape[1] for b in bases])
    whole = np.hstack(bases) if size.sum() else np.zeros((len(e), 0))
    level = float(_measured(e, len(rows)) / freedom)
    q = _sums((whole.T @ e)[None] ** 2, size)[0] / max(level, 1e-300)
    draws = np.random.default_rng(seed).normal(size=(_DRAWS, len(e)))
    z = _scale(q, size)
    top = z.max(initial=-np.inf)
    p_value = 0.0
    for null in (draws, _flipped(e, fit.linear.posture[rows], draws)):
        square = _measured(_off(null, basis, len(rows)), len(rows))
        scores = _sums((null @ whole) ** 2, size) / (square / freedom)[:, None]
        largest = _scale(scores, size).max(axis=1, initial=-np.inf)
        p_value = max(p_value, float((1 + np.sum(largest >= top)) / (_DRAWS + 1)))
    return Scores(q, z, size, p_value, level)


def row_noise(linear: Linear, posterior: Posterior) -> Float[Array, " rows"]:
    """One sigma of every row, m or rad, wider where its posture has less weight."""
    weight = np.where(linear.posture >= 0, posterior.weight[linear.posture], 1.0)
    return np.maximum(posterior.noise[linear.channel], EXACT) / np.sqrt(weight)


class Waves(NamedTuple):
    """Gear errors of one joint: how its motion moves the rows, and its waves in each posture."""

    blocks: Int[Array, " orders"]
    motion: Float[Array, " rows"]  # m or rad for 1 rad
    sine: Float[Array, "postures orders"]  # of the order times the joint's angle
    cosine: Float[Array, "postures orders"]

    def columns(self, posture: Int[Array, " rows"]) -> tuple[Float[Array, "rows orders"], Float[Array, "rows orders"]]:
        """Sines and cosines of all orders in the rows of the given postures."""
        return self.motion[:, None] * self.sine[posture], self.motion[:, None] * self.cosine[posture]


def score_waves(fit: Tested, waves: Iterable[Waves], seed: int = 0) -> float:
    r"""Family-wise p-value of the largest wave (sine and cosine of an order of a joint) beside the fit.

    A periodogram of what the fit leaves: with Q what a wave takes of the sum of squares S, white noise of f degrees of
    freedom exceeds it with probability $(1 - Q/S)^{f/2}$ in one wave, m times that in m of them; and postures with
    flipped signs are drawn as in `score_blocks`. The larger of both counts.
    """
    rows = np.flatnonzero(fit.used)
    e, basis, freedom = _left(fit, rows)
    draws = np.random.default_rng(seed).normal(size=(_WAVE_DRAWS, len(e)))
    null = _flipped(e, fit.linear.posture[rows], draws)
    total = _measured(_off(null, basis, len(rows)), len(rows))
    count, found, largest, scale = 0, 0.0, np.zeros(_WAVE_DRAWS), fit.noise[rows, None]
    for one in waves:
        sine, cosine = one.columns(fit.linear.posture)
        first, second = _orthonormal(sine[rows] / scale, cosine[rows] / scale, basis)
        count += len(one.blocks)
        found = max(found, float(_taken(e[None], first, second).max(initial=0.0)))
        largest = np.maximum(largest, _taken(null, first, second).max(axis=1, initial=0.0))
    if not count:
        return 1.0
    share = min(found / float(_measured(e, len(rows))), 1.0)
    white = min(1.0, count * (1.0 - share) ** (0.5 * (freedom - 2)))
    return max(white, float((1 + np.sum(largest / total >= share)) / (_WAVE_DRAWS + 1)))


def waves_shown(
    fit: Tested, waves: Iterable[Waves], beside: Float[Array, "rows _"], parts: Sequence[Bool[Array, " rows"]]
) -> list[int]:
    """The blocks of the largest wave of each joint beside the fit and the columns `beside`, where noise is unlikely.

    Each of the `parts` of the rows must have it as its largest wave too, to the resolution of its order: an order that
    is found with rows which are left out later would be judged by them.
    """
    waves = list(waves)
    whole = _spectra(fit, waves, beside)
    best, count = [int(np.argmax(share)) for share, _ in whole], sum(len(share) for share, _ in whole)
    shown = [
        k
        for k, (share, freedom) in enumerate(whole)
        if count * (1.0 - min(share[best[k]], 1.0)) ** (0.5 * (freedom - 2)) < thresholds.WAVE
    ]
    for rows in parts if shown else ():
        found = _spectra(fit._replace(used=rows), [waves[k] for k in shown], beside)
        shown = [k for k, (share, _) in zip(shown, found, strict=True) if abs(int(np.argmax(share)) - best[k]) <= 2]
    return [int(waves[k].blocks[best[k]]) for k in shown]


def _spectra(fit: Tested, waves: Sequence[Waves], beside: Array) -> list[tuple[Array, float]]:
    """What each order of each joint takes of the squares of the measured rows, as a share, and their freedom."""
    rows, posture, noise = np.flatnonzero(fit.used), fit.linear.posture, fit.noise
    e, basis, freedom = _left(fit, rows)
    if beside.shape[1]:
        more = _basis(_above(beside[rows] / noise[rows, None], len(e)), basis)
        e = e - more @ (more.T @ e)
        freedom -= float(np.sum(more[: len(rows)] ** 2))
    found, inside = [], rows[posture[rows] >= 0]
    left, member = e[: len(rows)][posture[rows] >= 0], posture[inside]
    for one in waves:
        motion = one.motion[inside] / noise[inside]
        pull, square = (np.bincount(member, x, minlength=len(one.sine)) for x in (motion * left, motion**2))
        taken = _by_posture(one.sine, one.cosine, pull, square)
        found.append((taken / _measured(e, len(rows)), freedom))
    return found


def _by_posture(sine: Array, cosine: Array, pull: Array, square: Array) -> Array:
    """What each order takes of the sum of squares, from the postures' own sums; waves are nearly off the fit."""
    s, c = pull @ sine, pull @ cosine
    ss, sc, cc = square @ sine**2, square @ (sine * cosine), square @ cosine**2
    determinant = ss * cc - sc**2
    solid = determinant > 1e-3 * ss * cc
    return np.where(solid, (cc * s**2 - 2 * sc * s * c + ss * c**2) / np.where(solid, determinant, 1.0), 0.0)


def _orthonormal(sine: Array, cosine: Array, basis: Array) -> tuple[Array, Array]:
    """Two orthonormal vectors for each order (rows and prior rows, orders), off the basis; zeros where none is left."""
    inside = basis[: len(sine)]

    def off(Z: Array) -> Array:
        whole = _above(Z, len(basis))
        return whole - basis @ (inside.T @ Z)

    def unit(Z: Array, before: Array) -> Array:
        length = np.linalg.norm(Z, axis=0)
        return np.where(length > 1e-3 * before, Z / np.where(length > 0.0, length, 1.0), 0.0)

    sizes = [np.linalg.norm(Z, axis=0) for Z in (sine, cosine)]
    first = unit(off(sine), sizes[0])
    second = off(cosine)
    return first, unit(second - first * np.sum(first * second, axis=0), sizes[1])


def _taken(e: Array, first: Array, second: Array) -> Array:
    """(draws, orders) what each pair of vectors takes of the squares of each draw."""
    return (e @ first) ** 2 + (e @ second) ** 2


def score_jitter(fit: Tested, ways: Float[Array, "rows joints"]) -> tuple[float, int]:
    r"""Family-wise p-value that no joint errs at random from posture to posture, and the joint that most looks so.

    With g the rows of one posture by a motion of the joint, `ways`, the statistic is $\sum (g' e)^2 / \sum g' g$ over
    the postures, the score of a variance component; the null draws e as `score_blocks` does.
    """
    rows = np.flatnonzero(fit.used)
    e, basis, freedom = _left(fit, rows)
    G = _above(ways[rows] / fit.noise[rows, None], len(e))
    posture = np.full(len(e), -1)
    posture[: len(rows)] = fit.linear.posture[rows]
    member = (posture[:, None] == np.unique(posture[posture >= 0])).astype(float)

    def statistic(left: Array) -> Array:
        """(draws, joints), in the mean square of each draw."""
        sums = np.stack([np.sum(((left * g) @ member) ** 2, axis=1) / max(g @ g, 1e-300) for g in G.T], axis=1)
        return sums / (_measured(left, len(rows)) / freedom)[:, None]

    draws = np.random.default_rng(0).normal(size=(_DRAWS, len(e)))
    null = statistic(draws - (draws @ basis) @ basis.T)
    middle, spread = null.mean(axis=0), null.std(axis=0) + 1e-300
    found = (statistic(e[None])[0] - middle) / spread
    largest = ((null - middle) / spread).max(axis=1)
    return float((1 + np.sum(largest >= found.max())) / (_DRAWS + 1)), int(np.argmax(found))


def _flipped(e: Array, posture: Array, draws: Array) -> Array:
    """(draws, rows) e with the signs of the `draws`, one for all rows of a posture; rows of the prior drawn anew.

    A single row of the prior can hold all the evidence of an offset, which no sign takes away.
    """
    sign = np.where(draws < 0.0, -1.0, 1.0)
    inside = np.flatnonzero(posture >= 0)
    _, first, member = np.unique(posture[inside], return_index=True, return_inverse=True)
    sign[:, inside] = sign[:, inside[first]][:, member]
    found = sign * e
    found[:, len(posture) :] = draws[:, len(posture) :]
    return found


def _left(fit: Tested, rows: Array) -> tuple[Array, Array, float]:
    """What the fit leaves of its rows and prior rows, whitened; an orthonormal basis of its columns; the measured rows'
    freedom."""
    linear, noise, _, precision, free = fit
    G = linear.jacobian[rows][:, free] / noise[rows, None]
    root = np.sqrt(np.where(linear.prior[free] == FLAT, 0.0, precision[free]))
    A = np.vstack([G, np.diag(root)])
    left = (linear.residual[rows] - linear.jacobian[rows][:, ~free] @ linear.at[~free]) / noise[rows]
    e = np.concatenate([left, root * linear.at[free]])
    basis, kept = np.linalg.qr(A)
    solid = np.abs(np.diag(kept)) > 1e-12 * np.abs(np.diag(kept)).max(initial=0.0)  # nothing is free: no column
    basis = basis[:, solid]
    return e - basis @ (basis.T @ e), basis, max(len(rows) - float(np.sum(basis[: len(rows)] ** 2)), 1.0)


def _off(draws: Array, basis: Array, measured: int) -> Array:
    """The measured rows of each draw off the fit's columns."""
    return draws[:, :measured] - (draws @ basis) @ basis[:measured].T


def _measured(e: Array, measured: int) -> Array:
    """Sum of squares of the measured rows, the first ones."""
    return np.sum(e[..., :measured] ** 2, axis=-1)


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
