"""What whitened rows say of candidate columns: fit with prior, scores, their null distributions, angles.

Rows are arranged `(joint, row)`, zero where a row is masked, so that an effect at one joint costs one joint's rows.
`X` are the columns of the current model, `Z` those of a candidate; `Xi`, `Zi` the same from the other repeat of the
excitation (instruments), whose encoder noise is independent of the residual's. Without repeats they are `X` and `Z`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

__all__ = ["Columns", "Linear", "Prior", "Rows", "Score", "fit", "score", "wilson_hilferty"]

CUT = 1e-7  # eigenvalues of the unit-diagonal variance below it: a direction that the baseline has absorbed


class Prior(NamedTuple):
    """Gaussian prior of the columns' coefficients, independent."""

    mean: Float[np.ndarray, " columns"]
    precision: Float[np.ndarray, " columns"]

    def extended(self, count: int) -> Prior:
        """With `count` more coefficients of which nothing is known."""
        return Prior(np.append(self.mean, np.zeros(count)), np.append(self.precision, np.full(count, 1e-8)))


class Rows(NamedTuple):
    """Whitened torque and regressor of the current model, with the layout of blocks and folds."""

    y: Float[np.ndarray, "nv T"]
    X: Float[np.ndarray, "nv T P"]
    Xi: Float[np.ndarray, "nv T P"]
    paired: Float[np.ndarray, "nv T"]  # 1 where a row has a partner to take instruments from
    partner: Int[np.ndarray, "partners T"]  # row of each other repeat, -1 where there is none
    block: Int[np.ndarray, " T"]  # of some seconds; -1 for padding
    fold: Int[np.ndarray, " T"]

    @property
    def count(self) -> int:
        """Number of rows with weight."""
        return int(np.count_nonzero(self.y))

    def instrument(self, Z: Float[np.ndarray, "*columns T"], joint: int) -> Float[np.ndarray, "*columns T"]:
        """Columns at the partners' rows (mean over the other repeats), zero where there is none."""
        return instruments(Z, self.partner, self.paired[joint])


class Linear(NamedTuple):
    """Instrumented fit with prior: coefficients, residual and what projects it out of a candidate."""

    theta: Float[np.ndarray, " P"]
    inverse: Float[np.ndarray, "P P"]  # of A = sym(Xi'X) + precision
    residual: Float[np.ndarray, "nv T"]
    moment: Float[np.ndarray, "P P"]  # Xi'Xi + precision
    pull: Float[np.ndarray, " P"]  # precision (theta - mean): what the prior rows hold against the data


class Columns(NamedTuple):
    """Columns of one effect at one place, for each point of its grid, at the joints that it touches."""

    joints: tuple[int, ...]
    Z: Float[np.ndarray, "grid k rows T"]


class Score(NamedTuple):
    """Score of a candidate at each grid point, and what its null distribution needs."""

    s: Float[np.ndarray, "grid k"]
    H: Float[np.ndarray, "grid P k"]
    root: Float[np.ndarray, "grid k k"]  # V^-1/2 on the kept directions, zero elsewhere
    rank: Int[np.ndarray, " grid"]
    Q: Float[np.ndarray, " grid"]
    z: Float[np.ndarray, " grid"]  # Q on one scale for all ranks (Wilson-Hilferty)


def instruments(
    Z: Float[np.ndarray, "*columns T"], partner: Int[np.ndarray, "partners T"], paired: Float[np.ndarray, " T"]
) -> Float[np.ndarray, "*columns T"]:
    """Mean of the columns over the partner rows, zero where there is none; without repeats the columns themselves."""
    if not len(partner):
        return Z
    have = partner >= 0
    total = sum(np.where(ok, Z[..., np.maximum(rows, 0)], 0.0) for rows, ok in zip(partner, have, strict=True))
    return total / np.maximum(have.sum(0), 1) * paired


def fit(rows: Rows, prior: Prior) -> Linear:
    """Coefficients th = A^-1 (Xi'y + L th0), A = sym(Xi'X) + L, and the residual y - X th."""
    X, Xi, y = (_tall(rows.X), _tall(rows.Xi), rows.y.reshape(-1))
    cross = Xi.T @ X
    A = (cross + cross.T) / 2 + np.diag(prior.precision)
    inverse = np.linalg.inv(_conditioned(A))
    y = y * rows.paired.reshape(-1)
    theta = inverse @ (Xi.T @ y + prior.precision * prior.mean)
    moment = Xi.T @ Xi + np.diag(prior.precision)
    residual = rows.y - rows.X @ theta
    return Linear(theta, inverse, residual, moment, prior.precision * (theta - prior.mean))


def score(rows: Rows, linear: Linear, columns: Columns) -> Score:
    """Score s = Zi'r of a candidate and Q = s'V^-1 s, V its variance with the current model projected out."""
    grid, k = columns.Z.shape[:2]
    s, XZ, XiZi, ZiZi = (0.0, 0.0, 0.0, 0.0)
    for place, joint in enumerate(columns.joints):
        Zi = rows.instrument(columns.Z[:, :, place], joint)
        flat = Zi.reshape(grid * k, -1)
        s = s + flat @ linear.residual[joint]
        XZ = XZ + flat @ rows.X[joint]
        XiZi = XiZi + flat @ rows.Xi[joint]
        ZiZi = ZiZi + Zi @ np.swapaxes(Zi, 1, 2)
    shaped = (grid, k, -1)
    XZ, XiZi = np.swapaxes(np.reshape(XZ, shaped), 1, 2), np.swapaxes(np.reshape(XiZi, shaped), 1, 2)
    H = linear.inverse @ XZ
    mixed = np.swapaxes(XiZi, 1, 2) @ H
    V = ZiZi - mixed - np.swapaxes(mixed, 1, 2) + np.swapaxes(H, 1, 2) @ linear.moment @ H
    s = np.reshape(s, (grid, k))
    root, rank = _whitener(V, ZiZi)
    Q = (np.squeeze(root @ s[..., None], -1) ** 2).sum(-1)
    return Score(s, H, root, rank, Q, wilson_hilferty(Q, rank))


def score_parts(
    rows: Rows, linear: Linear, columns: Columns, score: Score, other: Float[np.ndarray, "draws nv T"]
) -> Float[np.ndarray, "draws grid k"]:
    """The score that residual rows `other` would give: Zi'e - H'Xi'e."""
    grid, k = score.s.shape
    total = -np.einsum("dp,gpk->dgk", _scores_of_model(rows, other), score.H)
    for place, joint in enumerate(columns.joints):
        flat = rows.instrument(columns.Z[:, :, place], joint).reshape(grid * k, -1)
        total = total + (other[:, joint] @ flat.T).reshape(-1, grid, k)
    return total


def block_scores(rows: Rows, linear: Linear, columns: Columns, score: Score) -> Float[np.ndarray, "blocks grid k"]:
    """The score's share of each block, then of each prior row; they sum to the score."""
    grid, k = score.s.shape
    blocks = rows.block.max() + 1
    member = (rows.block == np.arange(blocks)[:, None]).astype(float)
    model = np.einsum("bt,jt,jtp->bp", member, linear.residual * rows.paired, rows.Xi, optimize=True)
    total = -np.einsum("bp,gpk->bgk", model, score.H)
    for place, joint in enumerate(columns.joints):
        flat = rows.instrument(columns.Z[:, :, place], joint).reshape(grid * k, -1)
        total = total + (member @ (flat * linear.residual[joint]).T).reshape(-1, grid, k)
    prior = linear.pull[:, None, None] * np.moveaxis(score.H, 0, 1)
    return np.concatenate([total, prior])


def absorbed(rows: Rows, linear: Linear, columns: Columns) -> Float[np.ndarray, "grid"]:
    """Share of the candidate's columns (by power) inside the span of the current model and its prior."""
    power, left = 0.0, 0.0
    ZX = sum(np.einsum("gkt,tp->gkp", columns.Z[:, :, i], rows.X[j]) for i, j in enumerate(columns.joints))
    power = (columns.Z**2).sum((1, 2, 3))
    inside = np.einsum("gkp,pq,gkq->g", ZX, linear.inverse, ZX)
    left = np.maximum(power - inside, 0)
    return 1 - left / np.maximum(power, 1e-300)


def wilson_hilferty(Q: Float[np.ndarray, " *n"], rank: Int[np.ndarray, " *n"]) -> Float[np.ndarray, " *n"]:
    """A chi-square of `rank` degrees on the scale of a standard normal."""
    k = np.maximum(rank, 1)
    spread = 2 / (9 * k)
    return np.where(rank > 0, ((Q / k) ** (1 / 3) - (1 - spread)) / np.sqrt(spread), -9.0)


def _tall(X: Float[np.ndarray, "nv T P"]) -> Float[np.ndarray, "nvT P"]:
    return X.reshape(-1, X.shape[-1])


def _scores_of_model(rows: Rows, other: Float[np.ndarray, "draws nv T"]) -> Float[np.ndarray, "draws P"]:
    return (other * rows.paired).reshape(len(other), -1) @ _tall(rows.Xi)


def _conditioned(A: Float[np.ndarray, "P P"]) -> Float[np.ndarray, "P P"]:
    """A with the rounding of columns that nothing excites lifted off zero."""
    return A + 1e-12 * np.diag(np.maximum(np.diag(A), 1e-12))


def _whitener(
    V: Float[np.ndarray, "grid k k"], raw: Float[np.ndarray, "grid k k"]
) -> tuple[Float[np.ndarray, "grid k k"], Int[np.ndarray, " grid"]]:
    scale = np.sqrt(np.maximum(np.diagonal(raw, axis1=1, axis2=2), 1e-300))
    unit = V / (scale[:, :, None] * scale[:, None, :])
    values, vectors = np.linalg.eigh((unit + np.swapaxes(unit, 1, 2)) / 2)
    keep = values > CUT
    inverse = np.where(keep, 1 / np.sqrt(np.where(keep, values, 1.0)), 0.0)
    return inverse[:, :, None] * np.swapaxes(vectors, 1, 2) / scale[:, None, :], keep.sum(1)
