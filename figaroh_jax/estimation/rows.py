"""Whitened rows of the torque and of the current model's regressor, and the fit to them.

Rows are arranged `(joint, row)`, zero where a row is masked, so that an effect at one joint costs one joint's rows.
`X` are the columns of the current model, `Xi` the same from the other repeat of the excitation (instruments), whose
encoder noise is independent of the residual's. Without repeats they are `X`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .joint_rows import JointRows

__all__ = ["Linear", "Prior", "Rows", "block_sums", "fit", "instruments", "model_sums"]

FEW = 50  # columns of which sums over blocks are quicker than a product for each block
UNKNOWN = 1e-8  # precision of a coefficient of which nothing is known


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
    X: JointRows
    Xi: JointRows
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


def fit(rows: Rows, prior: Prior, gram: Float[np.ndarray, "P P"] | None = None) -> Linear:
    """Coefficients th = A^-1 (Xi'y + L th0), A = sym(Xi'X) + L, and the residual y - X th.

    `gram` is X'X where that is known.
    """
    repeats = bool(len(rows.partner))
    cross = rows.Xi.products(rows.X) if repeats or gram is None else gram
    A = (cross + cross.T) / 2 + np.diag(prior.precision)
    inverse = np.linalg.inv(_conditioned(A))
    theta = inverse @ (rows.Xi.pulled(rows.y * rows.paired) + prior.precision * prior.mean)
    moment = (rows.Xi.squares() if repeats else cross) + np.diag(prior.precision)
    residual = rows.y - rows.X @ theta
    return Linear(theta, inverse, residual, moment, prior.precision * (theta - prior.mean))


def instruments(
    Z: Float[np.ndarray, "*columns T"], partner: Int[np.ndarray, "partners T"], paired: Float[np.ndarray, " T"]
) -> Float[np.ndarray, "*columns T"]:
    """Mean of the columns over the partner rows, zero where there is none; without repeats the columns themselves."""
    if not len(partner):
        return Z
    have = partner >= 0
    total = sum(np.where(ok, Z[..., np.maximum(rows, 0)], 0.0) for rows, ok in zip(partner, have, strict=True))
    return total / np.maximum(have.sum(0), 1) * paired


def block_sums(
    rows: Rows, weight: Float[np.ndarray, " T"], columns: Float[np.ndarray, "columns T"]
) -> Float[np.ndarray, "columns blocks"]:
    """Sums over the rows of each block of a weight times each column.

    The rows of a block follow one another: a product with each stretch of them is a few hundredths of the work of one
    with all rows and zeros. Few columns are multiplied, then summed as they lie.
    """
    firsts = np.append(0, np.flatnonzero(np.diff(rows.block)) + 1)
    numbers, out = rows.block[firsts], np.zeros((len(columns), rows.block.max() + 1))
    if len(columns) < FEW:
        sums, used = np.add.reduceat(columns * weight, firsts, axis=1), numbers >= 0
        np.add.at(out.T, numbers[used], sums.T[used])
        return out
    for first, end, number in zip(firsts, [*firsts[1:], len(rows.block)], numbers, strict=True):
        if number >= 0:
            out[:, number] += columns[:, first:end] @ weight[first:end]
    return out


def model_sums(rows: Rows, X: JointRows, residual: Float[np.ndarray, "nv T"]) -> Float[np.ndarray, "P blocks"]:
    """`block_sums` of the residual and each column of the model, over the joints."""
    out = np.zeros((X.width, rows.block.max() + 1))
    for own, weight in zip(X.own, residual, strict=True):
        out[own.place] += block_sums(rows, weight, own.columns.T)
    return out


def _conditioned(A: Float[np.ndarray, "P P"]) -> Float[np.ndarray, "P P"]:
    """A with the rounding of columns that nothing excites lifted off zero."""
    return A + 1e-12 * np.diag(np.maximum(np.diag(A), 1e-12))
