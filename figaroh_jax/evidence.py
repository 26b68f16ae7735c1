"""What whitened rows say of candidate columns: fit with prior, scores, their null distributions, angles.

Rows are arranged `(joint, row)`, zero where a row is masked, so that an effect at one joint costs one joint's rows.
`X` are the columns of the current model, `Z` those of a candidate; `Xi`, `Zi` the same from the other repeat of the
excitation (instruments), whose encoder noise is independent of the residual's. Without repeats they are `X` and `Z`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

__all__ = ["Bank", "Columns", "Linear", "Prior", "Rows", "Score", "bank", "fit", "projection", "scores"]

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
    """Instruments of many candidates, joint by joint: one product serves all of them.

    Candidate i owns the columns `span[i]`, grid point by grid point; `joint[j]` are the columns that touch joint j.
    """

    span: list[tuple[int, int, int]]  # first column, grid points, columns a point
    joint: list[Int[np.ndarray, " columns"]]
    Zi: list[Float[np.ndarray, "columns T"]]

    @property
    def width(self) -> int:
        """Number of columns."""
        return max((first + grid * k for first, grid, k in self.span), default=0)

    def product(self, rows: list[Float[np.ndarray, "T m"]]) -> Float[np.ndarray, "columns m"]:
        """Every column times one matrix of rows a joint, summed over the joints."""
        out = np.zeros((self.width, rows[0].shape[1]))
        for columns, Zi, right in zip(self.joint, self.Zi, rows, strict=True):
            out[columns] += Zi @ right
        return out


class Score(NamedTuple):
    """Score of a candidate at each grid point, and what whitens it."""

    root: Float[np.ndarray, "grid k k"]  # V^-1/2 on the kept directions, zero elsewhere
    rank: Int[np.ndarray, " grid"]
    Q: Float[np.ndarray, " grid"]
    z: Float[np.ndarray, " grid"]  # Q on one scale for all ranks (Wilson-Hilferty)

    def largest(self, scores: Float[np.ndarray, "draws gridk"]) -> Float[np.ndarray, " draws"]:
        """Largest z over the grid that other scores of the same columns would have."""
        grid, k = self.root.shape[:2]
        white = np.matmul(scores.reshape(-1, grid, 1, k), np.swapaxes(self.root, 1, 2))[:, :, 0]
        return wilson_hilferty((white**2).sum(-1), np.broadcast_to(self.rank, white.shape[:2])).max(1)


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


def with_columns(rows: Rows, more: Float[np.ndarray, "nv T k"]) -> Rows:
    """Rows whose model has more columns, which are their own instruments."""
    return rows._replace(X=np.concatenate([rows.X, more], axis=2), Xi=np.concatenate([rows.Xi, more], axis=2))


def bank(rows: Rows, candidates: list[Columns]) -> Bank:
    """The candidates' instruments, arranged by joint."""
    span, first = [], 0
    touching: list[list[np.ndarray]] = [[] for _ in rows.y]
    stored: list[list[np.ndarray]] = [[] for _ in rows.y]
    for one in candidates:
        grid, k = one.Z.shape[:2]
        span.append((first, grid, k))
        for place, joint in enumerate(one.joints):
            stored[joint].append(rows.instrument(one.Z[:, :, place].reshape(grid * k, -1), joint))
            touching[joint].append(np.arange(first, first + grid * k))
        first += grid * k
    empty = np.zeros((0, rows.y.shape[1]))
    joint = [np.concatenate([*t, np.zeros(0, int)]) for t in touching]
    return Bank(span, joint, [np.concatenate([*z, empty]) for z in stored])


def projection(rows: Rows, linear: Linear, stock: Bank) -> Float[np.ndarray, "P columns"]:
    """H = A^-1 X'Zi: what the current model takes up of each candidate column."""
    return linear.inverse @ stock.product(list(rows.X)).T


def scores(rows: Rows, linear: Linear, stock: Bank, H: Float[np.ndarray, "P columns"]) -> list[Score]:
    """Score s = Zi'r of every candidate and Q = s'V^-1 s, V its variance with the current model projected out."""
    s = stock.product([r[:, None] for r in linear.residual])[:, 0]
    XiZi, moved = stock.product(list(rows.Xi)).T, linear.moment @ H
    raw = _own_products(stock)
    out = []
    for (first, grid, k), ZiZi in zip(stock.span, raw, strict=True):
        own = slice(first, first + grid * k)
        h, xz, mh = (np.moveaxis(m[:, own].reshape(-1, grid, k), 1, 0) for m in (H, XiZi, moved))
        mixed = np.matmul(np.swapaxes(xz, 1, 2), h)
        V = ZiZi - mixed - np.swapaxes(mixed, 1, 2) + np.matmul(np.swapaxes(h, 1, 2), mh)
        root, rank = _whitener(V, ZiZi)
        Q = (np.matmul(root, s[own].reshape(grid, k, 1)) ** 2).sum((1, 2))
        out.append(Score(root, rank, Q, wilson_hilferty(Q, rank)))
    return out


def other_scores(
    rows: Rows, stock: Bank, H: Float[np.ndarray, "P columns"], residual: Float[np.ndarray, "draws nv T"]
) -> Float[np.ndarray, "draws columns"]:
    """The scores that other residual rows would give: Zi'e - H'Xi'e."""
    draws = len(residual)
    model = (residual * rows.paired).reshape(draws, -1) @ _tall(rows.Xi)
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


def _own_products(stock: Bank) -> list[Float[np.ndarray, "grid k k"]]:
    """Zi'Zi of each candidate at each grid point."""
    out = [np.zeros((grid, k, k)) for _, grid, k in stock.span]
    starts = np.array([first for first, _, _ in stock.span])
    for columns, Zi in zip(stock.joint, stock.Zi, strict=True):
        place = 0
        while place < len(columns):
            which = int(np.searchsorted(starts, columns[place], side="right")) - 1
            _, grid, k = stock.span[which]
            own = Zi[place : place + grid * k].reshape(grid, k, -1)
            out[which] += np.matmul(own, np.swapaxes(own, 1, 2))
            place += grid * k
    return out


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
