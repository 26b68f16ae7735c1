"""Columns of the candidates, arranged joint by joint, so that one product serves all of them.

`Z` are the columns of a candidate, `Zi` their instruments (`rows`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..estimation.rows import Rows

__all__ = ["Bank", "Columns", "bank"]


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
