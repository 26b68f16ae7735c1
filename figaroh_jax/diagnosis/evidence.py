"""What whitened rows say of candidate columns: scores with the current model projected out, and their distributions.

`X` are the columns of the current model, `Z` those of a candidate; `Xi`, `Zi` their instruments (`rows`, `bank`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..estimation.rows import Linear, Rows, block_sums, model_sums
from .bank import Bank, Columns

__all__ = [
    "Score",
    "block_scores",
    "largest",
    "other_scores",
    "projection",
    "pulled",
    "scores",
    "wilson_hilferty",
]

_FEW = 4  # columns of a candidate at a point
CUT = 1e-7  # eigenvalues of the unit-diagonal variance below it: a direction that the baseline has absorbed
COLUMN_CUT = 1e-8  # of a candidate's longest column: below, a column is what rounding leaves of zero


class Score(NamedTuple):
    """Score of a candidate at each grid point, and what whitens it."""

    root: Float[np.ndarray, "grid k k"]  # V^-1/2 on the kept directions, zero elsewhere
    rank: Int[np.ndarray, " grid"]
    Q: Float[np.ndarray, " grid"]
    z: Float[np.ndarray, " grid"]  # Q on one scale for all ranks (Wilson-Hilferty)


def projection(linear: Linear, stock: Bank) -> Float[np.ndarray, "P columns"]:
    """H = A^-1 X'Zi: what the current model takes up of each candidate column."""
    return linear.inverse @ stock.ZX.T


def scores(linear: Linear, stock: Bank, H: Float[np.ndarray, "P columns"]) -> list[Score]:
    """Score s = Zi'r of every candidate and Q = s'V^-1 s, V its variance with the current model projected out."""
    s = stock.Zy - stock.ZX @ linear.theta
    moved, out = (linear.moment @ H).T, list[Score | None]([None] * len(stock.span))
    for members, columns in _by_width(stock.span):
        h, xz, mh = H.T[columns], stock.ZXi[columns], moved[columns]
        ZiZi = np.concatenate([stock.own[i] for i in members])
        mixed = np.matmul(xz, np.swapaxes(h, 1, 2))
        V = ZiZi - mixed - np.swapaxes(mixed, 1, 2) + np.matmul(h, np.swapaxes(mh, 1, 2))
        root, rank = _whitener(V, ZiZi)
        Q = (np.matmul(root, s[columns][..., None]) ** 2).sum((1, 2))
        z, ends = wilson_hilferty(Q, rank), np.cumsum([stock.span[i][1] for i in members])
        for i, end in zip(members, ends, strict=True):
            own = slice(end - stock.span[i][1], end)
            out[i] = Score(root[own], rank[own], Q[own], z[own])
    return [score for score in out if score is not None]


def largest(
    span: list[tuple[int, int, int]], found: list[Score], drawn: Float[np.ndarray, "draws columns"]
) -> Float[np.ndarray, " draws"]:
    """Largest z that other scores of the same columns would have, of the candidates that own the columns `span`."""
    highest, by_column = np.full(len(drawn), -np.inf), np.ascontiguousarray(drawn.T)
    for members, columns in _by_width(span):
        root = np.concatenate([found[i].root for i in members])
        rank = np.concatenate([found[i].rank for i in members])
        Q = _whitened_squares(by_column[columns.T], root)  # z grows with Q: the largest Q of a rank will do
        for one in np.unique(rank):
            highest = np.maximum(highest, wilson_hilferty(Q[rank == one].max(0), np.full(len(drawn), one)))
    return highest


def _whitened_squares(
    drawn: Float[np.ndarray, "k points draws"], root: Float[np.ndarray, "points k k"]
) -> Float[np.ndarray, "points draws"]:
    """Squares of root times each draw; few columns go term by term, which is faster than many small products."""
    if len(drawn) > _FEW:
        return (np.matmul(root, np.swapaxes(drawn, 0, 1)) ** 2).sum(1)
    factors = np.moveaxis(root, 0, 2)[..., None]  # in double: what nothing excites has huge ones
    squares = np.zeros((len(root), drawn.shape[2]))
    for row in factors:
        squares += sum(factor * part for factor, part in zip(row, drawn, strict=True)) ** 2
    return squares


def pulled(
    one: Columns, parts: list[Float[np.ndarray, "columns T"]], residual: Float[np.ndarray, "draws nv T"]
) -> Float[np.ndarray, "draws columns"]:
    """Zi'e of a candidate with the instruments `parts` (of its joints) for several residuals, in their precision."""
    pairs = zip(one.joints, parts, strict=True)
    return np.sum([residual[:, joint] @ own.astype(residual.dtype).T for joint, own in pairs], axis=0)


def other_scores(
    rows: Rows,
    H: Float[np.ndarray, "P columns"],
    residual: Float[np.ndarray, "draws nv T"],
    pulled: Float[np.ndarray, "draws columns"],
    prior: Float[np.ndarray, "draws P"],
) -> Float[np.ndarray, "draws columns"]:
    """The scores that other residual rows would give: Zi'e - H'(Xi'e - the prior's rows), in their precision."""
    kind = residual.dtype
    model = rows.Xi.pulled(residual * rows.paired.astype(kind))
    return pulled + ((prior - model) @ H).astype(kind)


def block_scores(
    rows: Rows, linear: Linear, stock: Bank, H: Float[np.ndarray, "P columns"]
) -> Float[np.ndarray, "blocks columns"]:
    """The scores' share of each block, then of each prior row; they sum to the scores."""
    model = model_sums(rows, rows.Xi, linear.residual * rows.paired)
    total = np.zeros((stock.width, rows.block.max() + 1))
    for joint, columns, Zi in stock.blocks:
        total[columns] += block_sums(rows, linear.residual[joint], Zi)
    total = total.T - model.T @ H
    return np.concatenate([total, linear.pull[:, None] * H])


def wilson_hilferty(Q: Float[np.ndarray, " *n"], rank: Int[np.ndarray, " *n"]) -> Float[np.ndarray, " *n"]:
    """A chi-square of `rank` degrees on the scale of a standard normal."""
    k = np.maximum(rank, 1)
    spread = 2 / (9 * k)
    return np.where(rank > 0, ((Q / k) ** (1 / 3) - (1 - spread)) / np.sqrt(spread), -9.0)


def _by_width(span: list[tuple[int, int, int]]) -> list[tuple[list[int], Int[np.ndarray, "points k"]]]:
    """Candidates of as many columns a point, and the columns of all their points."""
    out = []
    for k in sorted({width for _, _, width in span}):
        members = [i for i, (_, _, width) in enumerate(span) if width == k]
        columns = [np.arange(first, first + grid * k).reshape(grid, k) for first, grid, _ in (span[i] for i in members)]
        out.append((members, np.concatenate(columns)))
    return out


def _whitener(
    V: Float[np.ndarray, "grid k k"], raw: Float[np.ndarray, "grid k k"]
) -> tuple[Float[np.ndarray, "grid k k"], Int[np.ndarray, " grid"]]:
    scale = np.sqrt(np.maximum(np.diagonal(raw, axis1=1, axis2=2), 1e-300))
    seen = scale > COLUMN_CUT * scale.max(1, keepdims=True)
    unit = V * (seen[:, :, None] & seen[:, None, :]) / (scale[:, :, None] * scale[:, None, :])
    values, vectors = np.linalg.eigh((unit + np.swapaxes(unit, 1, 2)) / 2)
    keep = values > CUT
    inverse = np.where(keep, 1 / np.sqrt(np.where(keep, values, 1.0)), 0.0)
    return inverse[:, :, None] * np.swapaxes(vectors, 1, 2) / scale[:, None, :], keep.sum(1)
