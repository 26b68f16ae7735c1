"""Whether a cause has one size wherever its joint is, however fast it moves, and whenever.

A law that stands in for another explains much and predicts what was not fitted: a ripple for a notch, a spring for a
base that is not level, a constant torque for a dead band take 60 to 98 % of the squares at their joint, in every
recording. Its size is then not the same throughout: with sizes of its own in each fifth of the joint's positions,
speeds or of the time, or in each recording, it would explain much more. A cause that is there has one size, and what
else is missing hardly changes it, most where that differs between recordings. Friction, damping, rotors and what is
more of them every joint has, and real ones differ by place and day; a limit of a drive is told only where it is met.
Of these nothing is asked here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .causes import Candidate
from .fit import Fit
from .setting import Setting, Structure
from .sizes import least_sure, why_nothing
from .thresholds import STEADY

__all__ = ["Normal", "in_doubt", "most_unsteady"]

_PARTS = 5  # of the positions, speeds and the time
_SMALL = 1e-9  # of a column's squares, that keeps a direction without data from mattering


def in_doubt(
    causes: Sequence[Candidate],
    here: Setting,
    structure: Structure,
    last: Fit,
    spread: np.ndarray | None,
    *,
    rest: bool,
) -> tuple[Candidate, str] | None:
    """The cause that is least worth its name, and why: its told interval holds no effect, or its size differs."""
    gone = least_sure(causes, structure, last, spread)
    if gone is not None:
        return gone, why_nothing(gone, structure, last, spread)
    worst = _least_steady(here, structure, last, causes) if rest else None
    if worst is None:
        return None
    return worst.candidate, (
        f"its size differs by {worst.by} ({worst.share:.2g} of what it explains), as that of what stands in for another"
    )


class _Unsteady(NamedTuple):
    """A cause, by what its size differs, and what sizes of its own would explain over what the cause does."""

    candidate: Candidate
    by: str
    share: float
    least: float  # share from which it is in doubt


def _least_steady(here: Setting, structure: Structure, last: Fit, causes: Sequence[Candidate]) -> _Unsteady | None:
    """The cause whose size stays the same the least, unless all stay the same well enough."""
    asked = [c for c in causes if not (c.kind.usual or c.kind.limit or c.kind.adds_to)]
    told = [one for c in asked for one in _unsteadiness(here, structure, last, c)]
    worst = max(told, key=lambda one: one.share / one.least, default=None)
    return worst if worst is not None and worst.share > worst.least else None


def most_unsteady(here: Setting, structure: Structure, last: Fit, cause: Candidate) -> tuple[str, float]:
    """By what the size of a cause differs the most, and what sizes of its own would explain over what the cause does.

    Nothing where the fit has no size of it.
    """
    told = _unsteadiness(here, structure, last, cause)
    worst = max(told, key=lambda one: one.share, default=None)
    return ("", 0.0) if worst is None else (worst.by, worst.share)


def _unsteadiness(here: Setting, structure: Structure, last: Fit, c: Candidate) -> list[_Unsteady]:
    """How much the size of a cause differs, by each of what it may differ by; empty where the fit has no size of it."""
    size = [int(np.flatnonzero(last.free == k)[0]) for k in c.entries[: max(c.kind.together, 1)] if k in last.free]
    if not size:
        return []
    normal = Normal(structure, last, size)
    return [_Unsteady(c, by, normal.more(parts), least) for by, parts, least in _parts(here, structure, c)]


def _parts(here: Setting, structure: Structure, c: Candidate) -> list[tuple[str, np.ndarray, float]]:
    """Parts of the blocks, (blocks, windows): by position and speed of its joints, time, recording; and their share."""
    names, measured = here.loop.robot.dof_names, list(here.loop.measured)
    rows = structure.data.block
    reading = np.asarray(structure.data.reading)[:, : len(measured)]
    blocks = len(reading) // rows
    position = reading[: blocks * rows].reshape(blocks, rows, *reading.shape[1:])
    weight = np.asarray(structure.data.weight)[: blocks * rows].reshape(blocks, rows, -1, reading.shape[2])
    counted = np.asarray((weight > 0).any((1, 2)))  # windows that end before others are filled up
    joints = [names.index(at) for at in c.at if at in names]
    joints = [j for j in joints if j in measured] or measured
    found = list[tuple[str, np.ndarray, float]]()
    for j in joints:
        own = position[:, :, measured.index(j)]
        found.append((f"the position of {names[j]}", _fifths(own.mean(1), counted), STEADY[0]))
        found.append((f"the speed of {names[j]}", _fifths(np.abs(np.diff(own, axis=1)).mean(1), counted), STEADY[0]))
    count = reading.shape[2]
    time = np.arange(blocks) * _PARTS // blocks
    found.append(("time", np.broadcast_to(time[:, None], (blocks, count)), STEADY[1]))
    run = np.array([one.run for one in here.stretches])
    if len(np.unique(run)) > 1:
        found.append(("recording", np.broadcast_to(run, (blocks, count)), STEADY[1]))
    return found


def _fifths(values: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Which fifth of those that count each is in."""
    return np.searchsorted(np.quantile(values[counted], np.arange(1, _PARTS) / _PARTS), values)


class Normal:
    """Normal equations by blocks of a fit, of what is free beside the size of a cause and of the size (columns)."""

    def __init__(self, structure: Structure, last: Fit, size: Sequence[int]):
        count = len(last.free)
        others = [k for k in range(count) if last.free[k] >= 0 and k not in size]
        columns = [*others, *size, *range(count, last.sums.gradient.shape[-1])]
        self.n, self.p = len(others), len(size)
        self.matrix = np.asarray(last.sums.matrix)[..., columns, :][..., columns]
        self.gradient = np.asarray(last.sums.gradient)[..., columns]
        self.precision = np.asarray(structure.data.precision).T ** 2  # (windows, states)
        self.away = self.precision * (last.start - np.asarray(structure.data.start)).T
        self.size = last.theta[last.free[list(size)]]

    def more(self, parts: np.ndarray) -> float:
        """What a size of its own in each part would explain more, over what the size explains, to second order."""
        kinds, n, p = np.unique(parts), self.n, self.p
        m = n + p * len(kinds)
        states = self.matrix.shape[-1] - n - p
        windows = self.matrix.shape[1]
        whole, right = np.zeros((windows, m + states, m + states)), np.zeros((windows, m + states))
        for k, kind in enumerate(kinds):
            mine = (parts == kind)[..., None]
            at = np.r_[np.arange(n), n + k * p + np.arange(p), m + np.arange(states)]
            whole[np.ix_(range(windows), at, at)] += (self.matrix * mine[..., None]).sum(0)
            right[:, at] += (self.gradient * mine).sum(0)
        inner = whole[:, m:, m:] + np.einsum("wi,ij->wij", self.precision, np.eye(states))
        solved = np.linalg.solve(
            inner + _SMALL * np.einsum("wii,ij->wij", inner, np.eye(states)),
            np.concatenate([whole[:, m:, :m], (right[:, m:] - self.away)[..., None]], 2),
        )
        schur = (whole[:, :m, :m] - whole[:, :m, m:] @ solved[..., :-1]).sum(0)
        left = (right[:, :m] - np.einsum("wij,wj->wi", whole[:, :m, m:], solved[..., -1])).sum(0)
        tied = np.zeros((m, n + p))
        tied[:n, :n], tied[n:, n:] = np.eye(n), np.tile(np.eye(p), (len(kinds), 1))
        own, together = _decrease(schur, left), tied.T @ schur @ tied
        one = _decrease(together, tied.T @ left)
        spread = np.linalg.pinv(together, hermitian=True)[n:, n:]
        worth = float(self.size @ np.linalg.pinv(spread, hermitian=True) @ self.size)
        return (own - one) / worth if worth > 0 else np.inf


def _decrease(matrix: np.ndarray, right: np.ndarray) -> float:
    """The squares that the step of all columns promises to be gone."""
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    scaled = matrix / np.outer(size, size) + _SMALL * np.eye(len(size))
    return float(right / size @ np.linalg.lstsq(scaled, right / size, rcond=1e-10)[0])
