"""Recordings as a linear regression: rows of torque and columns of parameters, condensed to small triangular factors.

A piece of a recording becomes rows (filtered torque and regressor, `records.filter_rows`), the rows of each joint go
into that joint's triangular factor, one for each fold, and the rows are forgotten. Weights of joints, choices of folds,
rank, fits and their errors then need the factors alone. Long recordings are cut into pieces that overlap by the reach
of the filter, so memory does not grow with their length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..effects.base import Effect
from ..recordings.dataset import carried_body
from ..recordings.rowfilter import reach
from ..recordings.signals import Signals
from ..recordings.stacked import Records, filter_rows, stack
from ..rigid.model import RobotModel
from ..simulators.contract import Backend
from .columns import column_names, columns_of, motion_at

__all__ = [
    "Condensed",
    "Piece",
    "Regression",
    "Rows",
    "condense",
]

PIECE_BYTES = 96e6  # of the columns of one piece at the working rate
FOLDS = 5
BLOCK = 0.5  # s: rows of one block of time are left out together; longer where the cutoff is low
BLOCK_PERIODS = 4.0  # at least so many periods of the cutoff


class Piece(NamedTuple):
    """Rows of a stretch of one recording, in time order; `weight` 0: gated, beside a gap, or padding."""

    X: Float[np.ndarray, "rows nv columns"]
    y: Float[np.ndarray, "rows nv"]  # N m or N, low-passed
    weight: Float[np.ndarray, "rows nv"]
    time: Float[np.ndarray, " rows"]  # s
    fold: Int[np.ndarray, " rows"]
    recording: int  # place among the signals


@runtime_checkable
class Rows(Protocol):
    """Anything that gives rows piece by piece, as often as asked: a `Regression`, or data of one's own."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        ...

    def pieces(self, widths: Sequence[float] = (), fitted: bool = True) -> Iterator[Piece]:
        """Pieces in time order; see `Regression.pieces`."""
        ...


@dataclass(frozen=True)
class Condensed:
    """The whole regression: one triangular factor of `[X y]` for each fold and joint, over the joint's own columns."""

    names: tuple[str, ...]
    columns: tuple[Int[np.ndarray, " own"], ...]  # of each joint
    factors: tuple[tuple[Float[np.ndarray, "k k"], ...], ...]  # [fold][joint], the last column is y
    count: Float[np.ndarray, "folds nv"]  # rows
    torque: Float[np.ndarray, "folds nv"]  # sum of y over the rows

    @property
    def rows(self) -> Float[np.ndarray, " nv"]:
        """Rows of each joint."""
        return self.count.sum(axis=0)

    def factor(
        self, weight: Float[np.ndarray, " nv"] | None = None, folds: Sequence[int] | None = None
    ) -> Float[np.ndarray, "n n"]:
        """Triangular factor of `sqrt(weight) [X y]` of all joints, or of the rows in `folds`."""
        size, chosen = len(self.names) + 1, range(len(self.factors)) if folds is None else folds
        root = np.ones(len(self.columns)) if weight is None else np.sqrt(weight)
        total = [np.zeros((0, size))]
        for j, (own, w) in enumerate(zip(self.columns, root, strict=True)):
            whole = np.concatenate([np.zeros((0, len(own) + 1)), *(self.factors[fold][j] for fold in chosen)])
            if len(whole) > len(own) + 1:
                whole = np.asarray(np.linalg.qr(whole, mode="r"))
            total.append(np.zeros((len(whole), size)))
            total[-1][:, [*own, size - 1]] = w * whole
        R = np.asarray(np.linalg.qr(np.concatenate(total), mode="r"))
        return np.concatenate([R, np.zeros((size - len(R), size))])

    def squares(
        self, theta: Float[np.ndarray, " columns"], folds: Sequence[int] | None = None
    ) -> Float[np.ndarray, " nv"]:
        """Sum of the squared residuals of each joint for parameters `theta`, N^2 m^2 or N^2."""
        out = np.zeros(len(self.columns))
        for fold in range(len(self.factors)) if folds is None else folds:
            for j, (own, factor) in enumerate(zip(self.columns, self.factors[fold], strict=True)):
                out[j] += np.sum((factor @ np.append(theta[own], -1.0)) ** 2)
        return out

    def rms(self, theta: Float[np.ndarray, " columns"]) -> Float[np.ndarray, " nv"]:
        """RMS residual of each joint, N m or N; NaN for a joint without rows."""
        return np.sqrt(self.squares(theta) / np.where(self.rows > 0, self.rows, np.nan))

    def restricted(self, kept: Sequence[int]) -> Condensed:
        """The regression on the columns `kept` alone."""
        return self._restricted(kept, self.factors, self.count, self.torque)

    def merged(self, kept: Sequence[int]) -> Condensed:
        """The same without folds: one factor for each joint."""
        joined = (tuple(np.concatenate([fold[j] for fold in self.factors]) for j in range(len(self.columns))),)
        return self._restricted(kept, joined, self.count.sum(0, keepdims=True), self.torque.sum(0, keepdims=True))

    def _restricted(
        self, kept: Sequence[int], factors: tuple[tuple[np.ndarray, ...], ...], count: np.ndarray, torque: np.ndarray
    ) -> Condensed:
        place_of = {int(k): i for i, k in enumerate(kept)}
        inside = [[i for i, k in enumerate(own) if int(k) in place_of] for own in self.columns]
        columns = tuple(
            np.array([place_of[int(own[i])] for i in ins], int) for own, ins in zip(self.columns, inside, strict=True)
        )
        own = tuple(
            tuple(
                np.asarray(np.linalg.qr(R[:, [*ins, R.shape[1] - 1]], mode="r"))
                for R, ins in zip(fold, inside, strict=True)
            )
            for fold in factors
        )
        return Condensed(tuple(self.names[k] for k in kept), columns, own, count, torque)


@dataclass(frozen=True)
class Regression:
    """Recordings, the robot (its backend gives ten columns for each link) and the effects with columns beside these."""

    backend: Backend
    terms: tuple[Effect, ...]  # each with a leading axis of places
    width: Float[np.ndarray, " nv"]  # half width of a reversal of dry friction, rad/s or m/s
    signals: tuple[Signals, ...]
    refused: frozenset[str] = frozenset()  # joints whose torque is not trusted

    @property
    def model(self) -> RobotModel:
        """The robot."""
        return self.backend.robot

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return column_names(self.model, self.terms)

    def pieces(self, widths: Sequence[float] = (), fitted: bool = True) -> Iterator[Piece]:
        """Rows of the recordings, piece by piece, those of the fit alone if `fitted`; each pass forms them anew.

        `widths` adds a column for each (rad/s or m/s): the direction of the row's own joint with that half width.
        """
        parts = [(k, part) for k, one in enumerate(self.signals) for part in _segments(one, self._samples(one))]
        trusted = np.array([name not in self.refused for name in self.model.dof_names])
        with jax.enable_x64(True):
            records = stack([replace(part, role="fit") for _, part in parts])
            for place_of, (k, one) in enumerate(parts):
                if fitted and one.role != "fit":
                    continue
                single = _one(records, place_of)
                rows = _rows(self.backend, self.terms, self.width, single, tuple(widths))
                X, y = (np.asarray(x)[: one.rows.kept] for x in rows)
                weight = np.asarray(one.rows.weight) * (one.torque is not None) * trusted
                yield Piece(X, y - self._carried(one, X), weight, one.rows.row_times, _folds(one), k)

    def _carried(self, one: Signals, X: Float[np.ndarray, "rows nv columns"]) -> Float[np.ndarray, "rows nv"]:
        """Torque of the known payload, N m or N."""
        if one.load is None:
            return np.zeros(X.shape[:2])
        link, ten = carried_body(self.model, one.load)
        return X[:, :, 10 * link : 10 * link + 10] @ ten

    def _samples(self, one: Signals) -> int:
        """Working samples of a piece."""
        beside = reach(one.dt, one.cutoff)
        return max(int(PIECE_BYTES / 8 / self.model.nv / max(len(self.names), 1)), 8 * beside)


def condense(
    regression: Rows,
    used: Bool[np.ndarray, "nv columns"],
    weight: Callable[[Piece], Float[np.ndarray, "rows nv"]] = lambda piece: piece.weight,
    widths: Sequence[float] = (),
    folds: int = FOLDS,
) -> Condensed:
    """Triangular factors of all rows; `used` says which columns of a joint's rows can differ from zero.

    `weight` gives the weight of every row of a piece, an inverse variance; rows of weight zero are left out. With
    `widths` a joint has a column for each of them behind all others, joint by joint.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a = fj.columns.random_states(robot, 300)
    >>> states = fj.states.States(robot, lambda: [(q, v, a, np.asarray(fj.inverse_dynamics(robot, q, v, a)))], ())
    >>> data = fj.regression.condense(states, states.used)
    >>> data.rows.tolist()  # of each joint
    [300.0, 300.0, 300.0, 300.0]
    """
    columns, count_of = used.shape[1], len(widths)
    beside = [np.arange(columns + j * count_of, columns + (j + 1) * count_of) for j in range(len(used))]
    local = tuple(np.append(np.flatnonzero(row), np.arange(columns, columns + count_of)) for row in used)
    own = tuple(np.append(np.flatnonzero(row), extra) for row, extra in zip(used, beside, strict=True))
    factors = [[np.zeros((0, len(mine) + 1)) for mine in local] for _ in range(folds)]
    count, torque = np.zeros((2, folds, len(own)))
    for piece in regression.pieces(widths):
        weights = weight(piece)
        for fold in range(folds):
            for j, mine in enumerate(local):
                kept = (piece.fold == fold) & (weights[:, j] > 0)
                root = np.sqrt(weights[kept, j])[:, None]
                new = root * np.column_stack([piece.X[kept, j][:, mine], piece.y[kept, j]])
                factors[fold][j] = np.asarray(np.linalg.qr(np.concatenate([factors[fold][j], new]), mode="r"))
                count[fold, j] += kept.sum()
                torque[fold, j] += piece.y[kept, j].sum()
    names = [*regression.names, *(f"fc{j + 1}@{w:g}" for j in range(len(used)) for w in widths)]
    return Condensed(tuple(names), own, tuple(tuple(row) for row in factors), count, torque)


def _folds(one: Signals) -> Int[np.ndarray, " rows"]:
    """Fold of each row: blocks of time in turn."""
    block = max(BLOCK, BLOCK_PERIODS / one.cutoff)
    return np.floor(one.rows.row_times / block + 1e-9).astype(int) % FOLDS


def _segments(one: Signals, samples: int) -> list[Signals]:
    """A recording cut into equally long pieces that overlap by the reach of the row filter at both sides."""
    if one.time.size <= samples:
        return [one]
    beside = reach(one.dt, one.cutoff)
    index, out = one.rows.index, []
    inner = samples - 2 * beside
    for begin in range(int(index[0]), int(index[-1]) + 1, inner):
        mine = np.flatnonzero((index >= begin) & (index < begin + inner))
        if len(mine) == 0:
            continue
        first = min(max(begin - beside, 0), one.time.size - samples)
        out.append(_cut(one, slice(first, first + samples), mine))
    return out


def _cut(one: Signals, where: slice, rows: Int[np.ndarray, " mine"]) -> Signals:
    signals = {name: getattr(one, name)[where] for name in ("time", "position", "velocity", "acceleration")}
    kept = replace(
        one.rows,
        weight=np.asarray(one.rows.weight)[rows],
        start=np.asarray(one.time[where.start]),
        samples=where.stop - where.start,
        first=int(one.rows.index[rows[0]]) - where.start,
        kept=len(rows),
    )
    torque, stands = None if one.torque is None else one.torque[where], None if one.stands is None else one.stands[rows]
    return replace(one, torque=torque, stands=stands, rows=kept, **signals)


def _one(records: Records, k: int) -> Records:
    many = ["time", "position", "velocity", "acceleration", "torque", "source", "kept", "weight"]
    values = [np.asarray(getattr(records, name))[k : k + 1] for name in many]
    return eqx.tree_at(lambda r: [getattr(r, name) for name in many], records, values)


def _rows(
    backend: Backend,
    terms: tuple[Effect, ...],
    width: Float[np.ndarray, " nv"],
    records: Records,
    widths: tuple[float, ...],
) -> tuple[Float[np.ndarray, "rows nv columns"], Float[np.ndarray, "rows nv"]]:
    """Filtered columns and torque of one recording; columns that are zero throughout need no filter."""
    time, q, v, a = (
        records.flat(np.asarray(x)) for x in (records.time, records.position, records.velocity, records.acceleration)
    )
    motion = motion_at(backend.robot, time, q, v, a, records.dt, jnp.asarray(width))
    X = columns_of(backend, terms, motion, widths)
    seen = np.argwhere(X.any(axis=0))
    series = np.moveaxis(X[:, seen[:, 0], seen[:, 1]], 0, 1)[:, None]
    out = np.zeros((records.kept.shape[1], *X.shape[1:]))
    out[:, seen[:, 0], seen[:, 1]] = filter_rows(records, np.ascontiguousarray(series))[:, 0].T
    torque = np.moveaxis(np.asarray(records.torque), 2, 0)
    return out, filter_rows(records, np.ascontiguousarray(torque))[:, 0].T
