"""Rows `(joint, row, column)` of a regressor, of each joint the columns that it has.

A link is in the torque of the joints that carry it, and a friction in that of its own joint: of a humanoid's rows six
sevenths are zero, of an arm's more than half. They are neither stored nor multiplied.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

__all__ = ["JointRows"]


class _Own(NamedTuple):
    """The columns of one joint, and their numbers among those of all joints, which increase."""

    columns: Float[np.ndarray, "T p"]
    place: Int[np.ndarray, " p"]

    def between(self, first: int, end: int) -> _Own:
        """The columns with these numbers, which then count from `first`."""
        some = slice(*np.searchsorted(self.place, (first, end)).tolist())
        return _Own(self.columns[:, some], self.place[some] - first)


class JointRows:
    """The columns of each joint, in rows that all joints have; `width` counts the columns of all.

    It is never changed: what is made of it shares its arrays.
    """

    def __init__(self, own: Sequence[tuple[Float[np.ndarray, "T p"], Int[np.ndarray, " p"]]], width: int) -> None:
        self.own, self.width = tuple(_Own(*one) for one in own), width

    @classmethod
    def of(cls, X: Float[np.ndarray, "nv T P"]) -> JointRows:
        """Those of dense rows."""
        used = [np.flatnonzero(columns.any(0)) for columns in X]
        return cls([(np.ascontiguousarray(x[:, at]), at) for x, at in zip(X, used, strict=True)], X.shape[2])

    @classmethod
    def at(cls, joints: Sequence[int], Z: Float[np.ndarray, "k rows T"], nv: int) -> JointRows:
        """Those of k columns that some joints have alone."""
        none, every = np.zeros((Z.shape[2], 0)), np.arange(len(Z))
        own = [(none, every[:0])] * nv
        for joint, columns in zip(joints, np.swapaxes(Z, 0, 1), strict=True):
            own[joint] = np.ascontiguousarray(columns.T), every
        return cls(own, len(Z))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Joints, rows, columns."""
        return len(self.own), len(self.own[0].columns), self.width

    @property
    def lengths(self) -> Float[np.ndarray, " P"]:
        """Sum of the squares of each column."""
        out = np.zeros(self.width)
        for own in self.own:
            out[own.place] += (own.columns**2).sum(0)
        return out

    def dense(self, first: int = 0, end: int | None = None) -> Float[np.ndarray, "nv T k"]:
        """Columns with their zeros, from the `first` to that before the `end`."""
        end = self.width if end is None else end
        out = np.zeros((*self.shape[:2], end - first))
        for rows, own in zip(out, self.own, strict=True):
            some = own.between(first, end)
            rows[:, some.place] = some.columns
        return out

    def first(self, count: int) -> JointRows:
        """The first columns."""
        return JointRows([own.between(0, count) for own in self.own], count)

    def after(self, count: int) -> JointRows:
        """The columns behind the first."""
        return JointRows([own.between(count, self.width) for own in self.own], self.width - count)

    def beside(self, *others: JointRows) -> JointRows:
        """These columns, and behind them those of others."""
        first = np.cumsum([0, self.width, *(one.width for one in others)])
        joined = []
        for each in zip(*(x.own for x in (self, *others)), strict=True):
            parts = [(own.columns, own.place + at) for own, at in zip(each, first, strict=False) if len(own.place)]
            if len(parts) < 2:
                joined.append(parts[0] if parts else each[0])
            else:
                joined.append((np.concatenate([x for x, _ in parts], axis=1), np.concatenate([at for _, at in parts])))
        return JointRows(joined, int(first[-1]))

    def replaced(self, joint: int, other: JointRows) -> JointRows:
        """With the rows of one joint those of others."""
        return JointRows([*self.own[:joint], other.own[joint], *self.own[joint + 1 :]], self.width)

    def tall(self, joints: Sequence[int]) -> _Own:
        """The rows of some joints below each other, in the columns that any of them has."""
        if len(joints) == 1:
            return self.own[joints[0]]
        place = np.unique(np.concatenate([self.own[joint].place for joint in joints]))
        count = self.shape[1]
        out = np.zeros((len(joints) * count, len(place)))
        for k, joint in enumerate(joints):
            own = self.own[joint]
            out[k * count : (k + 1) * count, np.searchsorted(place, own.place)] = own.columns
        return _Own(out, place)

    def __matmul__(self, theta: Float[np.ndarray, "P *k"]) -> Float[np.ndarray, "nv T *k"]:
        """X theta."""
        return np.stack([own.columns @ theta[own.place] for own in self.own])

    def pulled(self, residual: Float[np.ndarray, "*draws nv T"]) -> Float[np.ndarray, "*draws P"]:
        """X'r of the rows of all joints, in the precision of the residuals."""
        return self.pulled_at(range(len(self.own)), residual)

    def pulled_at(
        self, joints: Sequence[int], residual: Float[np.ndarray, "*draws rows T"]
    ) -> Float[np.ndarray, "*draws P"]:
        """X'r of the rows of some joints."""
        out = np.zeros((*residual.shape[:-2], self.width), residual.dtype)
        for k, joint in enumerate(joints):
            own = self.own[joint]
            out[..., own.place] += residual[..., k, :] @ own.columns.astype(residual.dtype, copy=False)
        return out

    def products(self, other: JointRows) -> Float[np.ndarray, "P k"]:
        """X'Z of the rows of all joints."""
        out = np.zeros((self.width, other.width))
        for own, its in zip(self.own, other.own, strict=True):
            out[np.ix_(own.place, its.place)] += own.columns.T @ its.columns
        return out

    def squares(self, weight: Float[np.ndarray, " nv"] | None = None) -> Float[np.ndarray, "P P"]:
        """X'X of the rows of all joints, each joint's times its weight."""
        out, weights = np.zeros((self.width, self.width)), np.ones(len(self.own)) if weight is None else weight
        for own, factor in zip(self.own, weights, strict=True):
            out[np.ix_(own.place, own.place)] += factor * (own.columns.T @ own.columns)
        return out
