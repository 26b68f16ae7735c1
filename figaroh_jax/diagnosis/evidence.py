"""What whitened rows say of candidate columns: fit with prior, scores, their null distributions, angles.

Rows are arranged `(joint, row)`, zero where a row is masked, so that an effect at one joint costs one joint's rows.
`X` are the columns of the current model, `Z` those of a candidate; `Xi`, `Zi` the same from the other repeat of the
excitation (instruments), whose encoder noise is independent of the residual's. Without repeats they are `X` and `Z`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

__all__ = ["Bank", "Columns", "Linear", "Prior", "Rows", "Score", "bank", "fit", "largest", "projection", "scores"]

UNKNOWN = 1e-8  # precision of a coefficient of which nothing is known
CUT = 1e-7  # eigenvalues of the unit-diagonal variance below it: a direction that the baseline has absorbed


class Prior(NamedTuple):
    """Gaussian prior of the columns' coefficients, independent."""

    mean: Float[np.ndarray, " columns"]
    precision: Float[np.ndarray, " columns"]

    def extended(self, count: int) -> Prior:
        """With `count` more coefficients of which nothing is known."""
        return Prior(np.append(self.mean, np.zeros(count)), np.append(self.precision, np.full(count, UNKNOWN)))


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
    def size(self) -> int:
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


class Bank(NamedTuple):
    """Instruments of many candidates, joint by joint (one product serves all of them), and their products.

    Candidate i owns the columns `span[i]`, grid point by grid point; `joint[j]` are the columns that touch joint j.
    """

    candidates: list[Columns]
    span: list[tuple[int, int, int]]  # first column, grid points, columns a point
    parts: list[list[Float[np.ndarray, "columns T"]]]  # instruments of each candidate at each of its joints
    joint: list[Int[np.ndarray, " columns"]]
    Zi: list[Float[np.ndarray, "columns T"]]
    own: list[Float[np.ndarray, "grid k k"]]  # Zi'Zi of each candidate
    ZX: Float[np.ndarray, "columns P"]  # Zi'X
    ZXi: Float[np.ndarray, "columns P"]  # Zi'Xi

    @property
    def width(self) -> int:
        """Number of columns."""
        return max((first + grid * k for first, grid, k in self.span), default=0)

    def product(self, rows: list[Float[np.ndarray, "T m"]]) -> Float[np.ndarray, "columns m"]:
        """Every column times one matrix of rows a joint, summed over the joints."""
        return _product(self.width, self.joint, self.Zi, rows)

    def single(self) -> Bank:
        """With instruments in single precision, for products with rows in that precision."""
        return self._replace(Zi=[own.astype(np.float32) for own in self.Zi])


class Score(NamedTuple):
    """Score of a candidate at each grid point, and what whitens it."""

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


def fit(rows: Rows, prior: Prior, gram: Float[np.ndarray, "P P"] | None = None) -> Linear:
    """Coefficients th = A^-1 (Xi'y + L th0), A = sym(Xi'X) + L, and the residual y - X th.

    `gram` is X'X where that is known.
    """
    repeats = bool(len(rows.partner))
    Xi, y = _tall(rows.Xi), (rows.y * rows.paired).reshape(-1)
    cross = Xi.T @ _tall(rows.X) if repeats or gram is None else gram
    A = (cross + cross.T) / 2 + np.diag(prior.precision)
    inverse = np.linalg.inv(_conditioned(A))
    theta = inverse @ (Xi.T @ y + prior.precision * prior.mean)
    moment = (Xi.T @ Xi if repeats else cross) + np.diag(prior.precision)
    residual = rows.y - rows.X @ theta
    return Linear(theta, inverse, residual, moment, prior.precision * (theta - prior.mean))


def with_columns(rows: Rows, more: Float[np.ndarray, "nv T k"]) -> Rows:
    """Rows whose model has more columns, which are their own instruments."""
    return rows._replace(X=np.concatenate([rows.X, more], axis=2), Xi=np.concatenate([rows.Xi, more], axis=2))


def bank(rows: Rows, candidates: list[Columns], before: Bank | None = None) -> Bank:
    """The candidates' instruments, arranged by joint, and their products with each other and with the model.

    `before` is the bank of rows whose model these rows have only added columns to: of a candidate that was there, the
    same object, only the products with the new columns are computed.
    """
    old = {id(one): place for place, one in enumerate(before.candidates)} if before else {}
    place = [old.get(id(one), -1) for one in candidates]
    parts = [before.parts[i] if before and i >= 0 else _parts(rows, c) for i, c in zip(place, candidates, strict=True)]
    own = [
        before.own[i] if before and i >= 0 else _own_product(c, part)
        for i, c, part in zip(place, candidates, parts, strict=True)
    ]
    sizes = np.array([c.Z.shape[0] * c.Z.shape[1] for c in candidates], int)
    firsts = np.cumsum(sizes) - sizes
    span = [(int(first), *c.Z.shape[:2]) for first, c in zip(firsts, candidates, strict=True)]
    joint, Zi = _by_joint(rows, candidates, parts, firsts)
    kept = np.full(int(sizes.sum()), -1)  # column of `before`
    for i, first, size in zip(place, firsts, sizes, strict=True):
        if before and i >= 0:
            kept[first : first + size] = before.span[i][0] + np.arange(size)
    ZX = _grown_product(rows.X, joint, Zi, kept, before.ZX if before else None)
    ZXi = _grown_product(rows.Xi, joint, Zi, kept, before.ZXi if before else None) if len(rows.partner) else ZX
    return Bank(candidates, span, parts, joint, Zi, own, ZX, ZXi)


def _by_joint(
    rows: Rows, candidates: list[Columns], parts: list[list[np.ndarray]], firsts: Int[np.ndarray, " candidates"]
) -> tuple[list[Int[np.ndarray, " columns"]], list[Float[np.ndarray, "columns T"]]]:
    """Columns that touch each joint, and their instruments there."""
    stored: list[list[np.ndarray]] = [[np.zeros((0, rows.y.shape[1]))] for _ in rows.y]
    touching: list[list[np.ndarray]] = [[np.zeros(0, int)] for _ in rows.y]
    for one, part, first in zip(candidates, parts, firsts, strict=True):
        for joint, columns in zip(one.joints, part, strict=True):
            stored[joint].append(columns)
            touching[joint].append(np.arange(first, first + len(columns)))
    return [np.concatenate(t) for t in touching], [np.concatenate(z) for z in stored]


def _own_product(one: Columns, part: list[Float[np.ndarray, "columns T"]]) -> Float[np.ndarray, "grid k k"]:
    shaped = [x.reshape(*one.Z.shape[:2], -1) for x in part]
    return np.sum([np.matmul(x, np.swapaxes(x, 1, 2)) for x in shaped], axis=0)


def _parts(rows: Rows, one: Columns) -> list[Float[np.ndarray, "columns T"]]:
    count = one.Z.shape[0] * one.Z.shape[1]
    return [rows.instrument(one.Z[:, :, place].reshape(count, -1), joint) for place, joint in enumerate(one.joints)]


def _grown_product(
    X: Float[np.ndarray, "nv T P"],
    joint: list[Int[np.ndarray, " columns"]],
    Zi: list[Float[np.ndarray, "columns T"]],
    kept: Int[np.ndarray, " width"],
    known: Float[np.ndarray, "before P0"] | None,
) -> Float[np.ndarray, "width P"]:
    """Zi'X, of which the first columns are `known` where `kept` names a row of them."""
    if known is None:
        return _product(len(kept), joint, Zi, list(X))
    P, same = known.shape[1], kept >= 0
    out = np.zeros((len(kept), X.shape[2]))
    out[:, P:] = _product(len(kept), joint, Zi, [x[:, P:] for x in X])
    fresh = [~same[columns] for columns in joint]
    left = [columns[new] for columns, new in zip(joint, fresh, strict=True)]
    some = [z[new] for z, new in zip(Zi, fresh, strict=True)]
    out[:, :P] = _product(len(kept), left, some, [x[:, :P] for x in X])
    out[same, :P] = known[kept[same]]
    return out


def _product(
    width: int,
    joint: list[Int[np.ndarray, " columns"]],
    Zi: list[Float[np.ndarray, "columns T"]],
    rows: list[Float[np.ndarray, "T m"]],
) -> Float[np.ndarray, "columns m"]:
    out = np.zeros((width, rows[0].shape[1]))
    for columns, own, right in zip(joint, Zi, rows, strict=True):
        out[columns] += own @ right
    return out


def projection(linear: Linear, stock: Bank) -> Float[np.ndarray, "P columns"]:
    """H = A^-1 X'Zi: what the current model takes up of each candidate column."""
    return linear.inverse @ stock.ZX.T


def scores(linear: Linear, stock: Bank, H: Float[np.ndarray, "P columns"]) -> list[Score]:
    """Score s = Zi'r of every candidate and Q = s'V^-1 s, V its variance with the current model projected out."""
    s = stock.product([r[:, None] for r in linear.residual])[:, 0]
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


def largest(stock: Bank, found: list[Score], drawn: Float[np.ndarray, "draws columns"]) -> Float[np.ndarray, " draws"]:
    """Largest z of all candidates that other scores of the same columns would have."""
    highest = np.full(len(drawn), -np.inf)
    for members, columns in _by_width(stock.span):
        root = np.concatenate([found[i].root for i in members])
        rank = np.concatenate([found[i].rank for i in members])
        white = np.matmul(np.swapaxes(drawn[:, columns], 0, 1), np.swapaxes(root, 1, 2))
        Q = (white**2).sum(-1)  # (points, draws); z grows with Q, so that the largest Q of a rank will do
        for one in np.unique(rank):
            highest = np.maximum(highest, wilson_hilferty(Q[rank == one].max(0), np.full(len(drawn), one)))
    return highest


def _by_width(span: list[tuple[int, int, int]]) -> list[tuple[list[int], Int[np.ndarray, "points k"]]]:
    """Candidates of as many columns a point, and the columns of all their points."""
    out = []
    for k in sorted({width for _, _, width in span}):
        members = [i for i, (_, _, width) in enumerate(span) if width == k]
        columns = [np.arange(first, first + grid * k).reshape(grid, k) for first, grid, _ in (span[i] for i in members)]
        out.append((members, np.concatenate(columns)))
    return out


def other_scores(
    rows: Rows, stock: Bank, H: Float[np.ndarray, "P columns"], residual: Float[np.ndarray, "draws nv T"]
) -> Float[np.ndarray, "draws columns"]:
    """The scores that other residual rows would give: Zi'e - H'Xi'e, in the precision of the rows and the bank."""
    draws, kind = len(residual), residual.dtype
    model = (residual * rows.paired.astype(kind)).reshape(draws, -1) @ _tall(rows.Xi).astype(kind, copy=False)
    return stock.product(list(np.moveaxis(residual, 0, 2))).T - model @ H


def block_scores(
    rows: Rows, linear: Linear, stock: Bank, H: Float[np.ndarray, "P columns"]
) -> Float[np.ndarray, "blocks columns"]:
    """The scores' share of each block, then of each prior row; they sum to the scores."""
    member = (rows.block[:, None] == np.arange(rows.block.max() + 1)).astype(float)
    own = linear.residual * rows.paired
    model = sum(member.T @ (x * r[:, None]) for x, r in zip(rows.Xi, own, strict=True))
    total = stock.product([member * r[:, None] for r in linear.residual]).T - model @ H
    return np.concatenate([total, linear.pull[:, None] * H])


def absorbed(rows: Rows, linear: Linear, columns: Columns) -> Float[np.ndarray, "grid"]:
    """Share of the candidate's columns (by power) inside the span of the current model and its prior."""
    ZX = sum(columns.Z[:, :, i] @ rows.X[j] for i, j in enumerate(columns.joints))
    power = (columns.Z**2).sum((1, 2, 3))
    left = np.maximum(power - (ZX @ linear.inverse * ZX).sum((1, 2)), 0)
    return 1 - left / np.maximum(power, 1e-300)


def wilson_hilferty(Q: Float[np.ndarray, " *n"], rank: Int[np.ndarray, " *n"]) -> Float[np.ndarray, " *n"]:
    """A chi-square of `rank` degrees on the scale of a standard normal."""
    k = np.maximum(rank, 1)
    spread = 2 / (9 * k)
    return np.where(rank > 0, ((Q / k) ** (1 / 3) - (1 - spread)) / np.sqrt(spread), -9.0)


def _tall(X: Float[np.ndarray, "nv T P"]) -> Float[np.ndarray, "nvT P"]:
    return X.reshape(-1, X.shape[-1])


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
