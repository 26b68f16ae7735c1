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
from scipy.special import gammaincc, ndtri

from .causes import Candidate, springs
from .fit import Fit, System, fit, standard_errors
from .parameters import BOUNDS, UNITS, values
from .setting import Setting, Structure
from .thresholds import TOLD

__all__ = [
    "fitted_without",
    "is_excepted",
    "is_open",
    "least_sure",
    "possible",
    "simpler",
    "told_errors",
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
