"""How large a cause is as it is told: no name stands beside an interval that says that the cause may be nothing.

Gates ask whether rows that were not fitted are predicted better. Where more than noise is left they may be, by a cause
that makes up for a little of what is missing; its size, told with what is left (chi2/N) or by how recordings differ,
is then as likely none. Two kinds are excepted, for an interval that holds zero says of them not that they may not be
there, but that the data do not tell how large they are: friction, damping and rotors, without which no joint is, and
limits of drives whose gains are fitted, for all torques are then known up to a factor, and none is an infinite limit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import gammaincc, gammainccinv, ndtr, ndtri

from .causes import Candidate, springs
from .fit import Fit, System, fit, standard_errors
from .found import Tried
from .parameters import BOUNDS, UNITS, values
from .setting import Setting, Structure
from .starting import shown
from .thresholds import CLEAR_OF_NOTHING, OF_ITS_SIZE, TOLD

__all__ = [
    "fitted_without",
    "is_excepted",
    "is_open",
    "least_sure",
    "possible",
    "simpler",
    "sized",
    "told_errors",
    "why_not_sized",
    "why_nothing",
]

_LATE = 30  # iterations


def told_errors(structure: Structure, last: Fit, spread: np.ndarray | None = None) -> np.ndarray:
    """One standard deviation of each free number as it is told, (columns,): by what is left; by `spread` if larger."""
    errors = standard_errors(last, structure.data, _level(structure, last))
    return errors if spread is None else np.fmax(errors, spread)


def possible(name: str) -> float:
    """The least that a number can be: 0 of what has no sign, else minus infinity."""
    return 0.0 if BOUNDS[name][0] >= 0 else -np.inf


def least_sure(
    causes: Sequence[Candidate], structure: Structure, last: Fit, spread: np.ndarray | None = None
) -> Candidate | None:
    """Of the causes that are not excepted the one whose told size is the least clear of none, unless all are clear."""
    errors = told_errors(structure, last, spread)
    asked = [c for c in causes if not is_excepted(c, structure, last)]
    clear = [_clear(c, structure, last, errors) for c in asked]
    return asked[int(np.argmin(clear))] if clear and min(clear) < TOLD else None


def is_excepted(c: Candidate, structure: Structure, last: Fit) -> bool:
    """Whether a cause is named although its interval may hold zero."""
    drive = structure.table[c.entries[0]].at
    fitted = any(structure.table[k].name == "scale" and structure.table[k].at == drive for k in last.free if k >= 0)
    return c.kind.usual or (c.kind.limit and fitted)


def is_open(c: Candidate, structure: Structure, last: Fit, spread: np.ndarray | None = None) -> bool:
    """Whether the interval of its size, as it is told, holds no effect."""
    return _clear(c, structure, last, told_errors(structure, last, spread)) < TOLD


def why_nothing(c: Candidate, structure: Structure, last: Fit, spread: np.ndarray | None = None) -> str:
    """Why a cause is not named although rows that were not fitted are predicted better with it, with its size."""
    errors, told = told_errors(structure, last, spread), []
    for entry in _size(c):
        column, name = int(np.flatnonzero(last.free == entry)[0]), structure.table[entry].name
        half = TOLD * errors[column]
        size = f"{last.theta[entry] - c.kind.neutral:.2g}"
        text = f"{size} +- {half:.2g} {UNITS[name]}" if np.isfinite(half) else f"{size} {UNITS[name]}, of any size"
        told.append(text.rstrip())
    return f"its size may be none: {', '.join(told)}"


def fitted_without(
    here: Setting, structure: Structure, last: Fit, free: Sequence[int], gone: Candidate, rough: float = 0.0
) -> tuple[Structure, Fit, tuple[int, ...]]:
    """All others fitted again without a cause, from where they are: a spring leaves the joint stiff."""
    theta, start = last.theta.copy(), last.start
    if gone.kind.elastic:
        n, more = here.loop.robot.nv, structure.loop.robot.nv - here.loop.robot.nv
        structure = Structure(here.loop, here.known.table, here.cut(here.loop))
        theta = theta[: len(structure.table)]
        start = np.concatenate([start[:n], start[n + more : 2 * n + more]])
        kept = [k for k in free if k < len(theta)]
    else:
        entries = list(gone.entries)
        theta[entries] = values(structure.loop, structure.table)[entries]
        kept = [k for k in free if k not in entries or k in here.baseline]
    new = fit(*structure, theta[None], [kept], start[None], width=max(here.width, len(kept)), lanes=1,
              iterations=_LATE, rough=rough)[0]  # fmt: skip
    return structure, new, tuple(kept)


def simpler(
    here: Setting, structure: Structure, last: Fit, free: Sequence[int], gone: Candidate, forbid: Sequence[str]
) -> tuple[Candidate, Fit, tuple[int, ...]] | None:
    """What a cause contains at its place, fitted instead of it: a spring without play, a torque without stiffness."""
    known = [c for c in here.known.candidates if c.at == gone.at]
    known += springs(gone.at[0], len(here.known.table), forbid) if gone.kind.elastic else []
    less = [c for c in known if gone.kind.holds(c.effect) and set(c.entries) < set(gone.entries)]
    if not less:
        return None
    c, theta = less[0], last.theta.copy()
    more = [k for k in gone.entries if k not in c.entries]
    theta[more] = 0.0 if gone.kind.elastic else values(structure.loop, structure.table)[more]
    kept = tuple(k for k in free if k not in more or k in here.baseline)
    new = fit(*structure, theta[None], [kept], last.start[None], width=max(here.width, len(kept)), lanes=1,
              iterations=_LATE)[0]  # fmt: skip
    return c, new, kept


def _level(structure: Structure, last: Fit) -> float:
    return max(1.0, last.squares / (np.asarray(structure.data.weight) > 0).sum())


def _size(c: Candidate) -> tuple[int, ...]:
    """The numbers that are its size: that which tells it from what it contains, else the first ones."""
    return c.entries[: c.kind.together] if c.kind.telling is None else (c.entries[c.kind.telling],)


def _clear(c: Candidate, structure: Structure, last: Fit, errors: np.ndarray) -> float:
    """Standard deviations, as they are told, by which a size is clear of none.

    A stiffness or a limit is none if it is infinite: its inverse has to first order as many.
    """
    at = np.array([int(np.flatnonzero(last.free == entry)[0]) for entry in _size(c) if entry in last.free])
    at = at[np.isfinite(errors[at]) & (errors[at] > 0)] if len(at) else at
    if not len(at):
        return 0.0
    size = last.theta[last.free[at]] - c.kind.neutral
    if len(at) == 1:
        return float(abs(size[0]) / errors[at[0]])
    own = System(last.sums, structure.data, last.start).covariance(last.free < 0)[np.ix_(at, at)]
    wide = errors[at] / np.sqrt(np.diag(own))
    wald = float(size @ np.linalg.pinv(own * np.outer(wide, wide), hermitian=True) @ size)
    return float(-ndtri(max(gammaincc(len(at) / 2, wald / 2), 1e-300) / 2))


def sized(here: Setting, one: Tried) -> bool:
    """Whether its first number is clear of no effect, and on no bound of the search."""
    return not why_not_sized(here, one)


def why_not_sized(here: Setting, one: Tried) -> str:
    """Why a candidate's numbers make no cause of it, or nothing."""
    found = one.state.fit
    column = int(np.flatnonzero(found.free == one.candidate.entries[0])[0])
    error = standard_errors(found, one.state.structure.data)[column]
    value = found.theta[one.candidate.entries[0]]
    kind = one.candidate.kind
    if kind.telling is not None:  # without it it is what it contains
        width = one.candidate.entries[kind.telling]
        spread = standard_errors(found, one.state.structure.data)[int(np.flatnonzero(found.free == width)[0])]
        if not found.theta[width] > CLEAR_OF_NOTHING * spread:
            return "it is no more than what it contains"
    bounds = here.bounds[list(one.candidate.entries)] if not kind.elastic else np.zeros((0, 2))
    if any(found.theta[e] >= high for e, (_, high) in zip(one.candidate.entries, bounds, strict=False)):
        return "a number of it ends at the bound of the search"
    if kind.falls_off is not None:  # beyond every speed it is plain friction
        speed = one.candidate.entries[kind.falls_off]
        if found.theta[speed] > max(_top_speed(here, j) for j in one.state.structure.table[speed].at):
            return "no motion is as fast as the speed that it tells"
    if not shown(here, one.candidate, found.theta):
        return "the motion covers too little of it: so short a piece could be any smooth torque"
    if not kind.signed:
        clear = np.isfinite(error) and error < OF_ITS_SIZE * abs(value) + 1e-12
    elif kind.together > 1:
        clear = _clear_together(one)
    else:
        clear = np.isfinite(error) and abs(value - kind.neutral) > CLEAR_OF_NOTHING * error
    return "" if clear else "its size may be nothing"


def _clear_together(one: Tried) -> bool:
    """Whether two numbers are a size together, such as sine and cosine: as sure as one number is to be."""
    found = one.state.fit
    entries = [k for k in one.candidate.entries[: one.candidate.kind.together] if k in found.free]
    at = [int(np.flatnonzero(found.free == k)[0]) for k in entries]
    covariance = System(found.sums, one.state.structure.data, found.start).covariance(found.free < 0)[np.ix_(at, at)]
    told = np.isfinite(np.diag(covariance))
    size = found.theta[entries][told]
    if not told.any():
        return False
    wald = float(size @ np.linalg.pinv(covariance[np.ix_(told, told)], hermitian=True) @ size)
    chance = 2 * ndtr(-CLEAR_OF_NOTHING)
    return wald > (CLEAR_OF_NOTHING**2 if told.sum() == 1 else 2 * gammainccinv(told.sum() / 2, chance))


def _top_speed(here: Setting, coordinate: int) -> float:
    """The fastest that a joint moved, over five rows (rad/s or m/s)."""
    column = here.loop.measured.index(coordinate)
    return max(
        float(
            np.abs(run.position[4:, column] - run.position[:-4, column]).max(initial=0.0) / (run.time[4] - run.time[0])
        )
        for run in here.runs
    )
