"""Columns of the candidates, arranged joint by joint, so that one product serves all of them.

`Z` are the columns of a candidate, `Zi` their instruments (`rows`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..estimation.joint_rows import JointRows
from ..estimation.rows import Rows

__all__ = ["Bank", "Columns", "bank"]

MANY, PIECE = 8, 512  # columns of a product that is made of all candidates of a joint at once; rows to a piece of it
FEW = 8_000_000  # numbers of all columns that are put side by side joint by joint: one product is quicker than many


class Columns(NamedTuple):
    """Columns of one effect at one place, for each point of its grid, at the joints that it touches."""

    joints: tuple[int, ...]
    Z: Float[np.ndarray, "grid k rows T"]


class Block(NamedTuple):
    """Columns at one joint, of all candidates that touch it, or of one where they are large."""

    joint: int
    columns: Int[np.ndarray, " columns"]
    Zi: Float[np.ndarray, "columns T"]


class Bank(NamedTuple):
    """Instruments of many candidates, joint by joint (one product serves all of them), and their products.

    Candidate i owns the columns `span[i]`, grid point by grid point.
    """

    candidates: list[Columns]
    span: list[tuple[int, int, int]]  # first column, grid points, columns a point
    parts: list[list[Float[np.ndarray, "columns T"]]]  # instruments of each candidate at each of its joints
    blocks: list[Block]
    own: list[Float[np.ndarray, "grid k k"]]  # Zi'Zi of each candidate
    ZX: Float[np.ndarray, "columns P"]  # Zi'X
    ZXi: Float[np.ndarray, "columns P"]  # Zi'Xi
    Zy: Float[np.ndarray, " columns"]  # Zi'y

    @property
    def width(self) -> int:
        """Number of columns."""
        return max((first + grid * k for first, grid, k in self.span), default=0)

    def product(self, rows: JointRows) -> Float[np.ndarray, "columns m"]:
        """Every column times the rows of its joints, summed over them."""
        return _product(self.width, self.blocks, rows)


def bank(rows: Rows, candidates: list[Columns], before: Bank | None = None) -> Bank:
    """The candidates' instruments, arranged by joint, and their products with each other and with the model.

    `before` is the bank of rows whose model these rows have only added columns to: of a candidate that was there, the
    same object, only the products with the new columns are computed.
    """
    if before and len(before.candidates) == len(candidates):
        if all(old is new for old, new in zip(before.candidates, candidates, strict=True)):
            return _beside_more(rows, before)
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
    blocks = _blocks(candidates, parts, firsts)
    kept = np.full(int(sizes.sum()), -1)  # column of `before`
    for i, first, size in zip(place, firsts, sizes, strict=True):
        if before and i >= 0:
            kept[first : first + size] = before.span[i][0] + np.arange(size)
    ZX = _grown_product(rows.X, blocks, kept, before.ZX if before else None)
    ZXi = _grown_product(rows.Xi, blocks, kept, before.ZXi if before else None) if len(rows.partner) else ZX
    Zy = _grown_product(JointRows.of(rows.y[..., None]), blocks, kept, before.Zy[:, None] if before else None)[:, 0]
    return Bank(candidates, span, parts, blocks, own, ZX, ZXi, Zy)


def _beside_more(rows: Rows, before: Bank) -> Bank:
    """The same bank beside a model with more columns."""
    ZX = np.concatenate([before.ZX, before.product(rows.X.after(before.ZX.shape[1]))], axis=1)
    if not len(rows.partner):
        return before._replace(ZX=ZX, ZXi=ZX)
    more = before.product(rows.Xi.after(before.ZXi.shape[1]))
    return before._replace(ZX=ZX, ZXi=np.concatenate([before.ZXi, more], axis=1))


def _blocks(
    candidates: list[Columns], parts: list[list[np.ndarray]], firsts: Int[np.ndarray, " candidates"]
) -> list[Block]:
    """The instruments at each joint, with the columns that they are of."""
    out = [
        Block(joint, np.arange(first, first + len(columns)), columns)
        for one, part, first in zip(candidates, parts, firsts, strict=True)
        for joint, columns in zip(one.joints, part, strict=True)
    ]
    if sum(block.Zi.size for block in out) > FEW:
        return out
    joints = sorted({block.joint for block in out})
    beside = [[block for block in out if block.joint == joint] for joint in joints]
    return [
        Block(joint, np.concatenate([x.columns for x in own]), np.concatenate([x.Zi for x in own]))
        for joint, own in zip(joints, beside, strict=True)
    ]


def _own_product(one: Columns, part: list[Float[np.ndarray, "columns T"]]) -> Float[np.ndarray, "grid k k"]:
    shaped = [x.reshape(*one.Z.shape[:2], -1) for x in part]
    return np.sum([np.matmul(x, np.swapaxes(x, 1, 2)) for x in shaped], axis=0)


def _parts(rows: Rows, one: Columns) -> list[Float[np.ndarray, "columns T"]]:
    count = one.Z.shape[0] * one.Z.shape[1]
    return [rows.instrument(one.Z[:, :, place].reshape(count, -1), joint) for place, joint in enumerate(one.joints)]


def _grown_product(
    X: JointRows,
    blocks: list[Block],
    kept: Int[np.ndarray, " width"],
    known: Float[np.ndarray, "before P0"] | None,
) -> Float[np.ndarray, "width P"]:
    """Zi'X, of which the first columns are `known` where `kept` names a row of them."""
    if known is None:
        return _product(len(kept), blocks, X)
    P, same = known.shape[1], kept >= 0
    out = np.zeros((len(kept), X.width))
    out[:, P:] = _product(len(kept), blocks, X.after(P))
    out[:, :P] = _product(len(kept), [_fresh(block, ~same[block.columns]) for block in blocks], X.first(P))
    out[same, :P] = known[kept[same]]
    return out


def _fresh(block: Block, new: Bool[np.ndarray, " columns"]) -> Block:
    return block if new.all() else Block(block.joint, block.columns[new], block.Zi[new])


def _product(width: int, blocks: list[Block], rows: JointRows) -> Float[np.ndarray, "columns m"]:
    out = np.zeros((width, rows.width))
    for joint in sorted({block.joint for block in blocks}):
        beside = [block for block in blocks if block.joint == joint and len(block.columns)]
        own = rows.own[joint]
        if not len(own.place):  # columns of a cause at other joints
            continue
        if len(beside) < 2 or len(own.place) < MANY:
            for block in beside:
                out[np.ix_(block.columns, own.place)] += block.Zi @ own.columns
            continue
        columns = np.concatenate([block.columns for block in beside])
        out[np.ix_(columns, own.place)] += _product_in_pieces([block.Zi for block in beside], own.columns)
    return out


def _product_in_pieces(
    parts: list[Float[np.ndarray, "columns T"]], rows: Float[np.ndarray, "T m"]
) -> Float[np.ndarray, "width m"]:
    """The parts below each other times the rows: a few rows of all at a time, which stay in the cache."""
    ends = np.cumsum([len(part) for part in parts])
    total, piece = np.zeros((ends[-1], rows.shape[1])), np.empty((ends[-1], PIECE))
    for start in range(0, len(rows), PIECE):
        few = rows[start : start + PIECE]
        for part, end in zip(parts, ends, strict=True):
            piece[end - len(part) : end, : len(few)] = part[:, start : start + len(few)]
        total += piece[:, : len(few)] @ few
    return total
