r"""Least squares of which rows and Jacobian are one program and the steps are SciPy's: little to compile.

A solver inside of a program puts the rows into it several times (to step, to end, for the covariance), and long rows,
as those of a simulation, then take a minute to compile. Here they are compiled once. SciPy's trust region reflective
method steps by the SVD of the Jacobian, on columns scaled to one length, so that nothing squares its condition number;
near the minimum whole steps of Gauss and Newton follow, which go on where a cost can no longer tell two points apart.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

__all__ = ["Ended", "descend"]

_TOLERANCE = 1e-10  # of the numbers in their sizes: a step below it is the last one
_COST = 1e-10  # of the squares: where SciPy's steps gain less, whole ones end the search; costs cannot tell its square
_LEFT = 1e-6  # of the squares: what linear rows promise to take off at a minimum
_RIDGE = 1e-7  # of the columns at the start: numbers that no row shows stay, and SciPy's whole steps are such
_SHOWN = 1e-10  # of the largest singular value: directions below it are shown by no row


class Ended(NamedTuple):
    """Where a search ended; neither `converged` nor `stuck`: its steps were used up."""

    at: Float[np.ndarray, " numbers"]
    rows: Float[np.ndarray, " rows"]
    jacobian: Float[np.ndarray, "rows numbers"]
    steps: int
    converged: bool = False
    stuck: bool = False


def descend(
    rows_at: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    precision: Float[np.ndarray, " numbers"],
    max_steps: int,
) -> Ended:
    r"""The least $\tfrac12 |r(y)|^2 + \tfrac12 \sum_k p_k y_k^2$ from y = 0; `rows_at` gives r and its Jacobian.

    `precision` is p, `max_steps` limits the steps tried. One to where the rows are not finite is no step; the search
    is `stuck` where they, or the Jacobian, are not finite at the start, and where only such steps would lead on.
    """
    root = np.sqrt(precision)
    held = np.flatnonzero(root)
    start = np.zeros(len(root))
    latest = (start, *rows_at(start))
    if not all(np.isfinite(x).all() for x in latest):
        return Ended(*latest, 0, stuck=True)

    def seen(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and Jacobian with those of the prior; NaN, to which SciPy does not step, where one is not finite."""
        nonlocal latest
        if not np.array_equal(y, latest[0]):
            latest = (y.copy(), *rows_at(y))
        _, rows, jacobian = latest
        rows = rows if np.isfinite(jacobian).all() else np.full_like(rows, np.nan)
        return np.concatenate([rows, (root * y)[held]]), np.concatenate([jacobian, np.diag(root)[held]])

    length = np.sqrt((seen(start)[1] ** 2).sum(0))
    ridge = _RIDGE * np.where(length > 0, length, length.max(initial=1.0))

    def bound(z: np.ndarray) -> np.ndarray:
        return np.concatenate([seen(z - 1.0)[0], ridge * (z - 1.0)])

    settings: Any = {"x_scale": "jac", "ftol": _COST, "xtol": _TOLERANCE, "gtol": None, "max_nfev": max_steps + 1}
    settings["jac"] = lambda z: np.concatenate([seen(z - 1.0)[1], np.diag(ridge)])
    found = least_squares(bound, start + 1.0, **settings)  # the first steps may be as long as the sizes, which are 1
    at, steps = found.x - 1.0, found.nfev - 1
    rows, jacobian = seen(at)
    step, promised = _whole_step(rows, jacobian)
    while steps < max_steps and found.status > 0 and _relative(step, at) > _TOLERANCE:
        more, slopes = seen(at + step)
        if not more @ more <= rows @ rows * (1 + _COST**2):
            break
        at, rows, jacobian, steps, before = at + step, more, slopes, steps + 1, step
        step, promised = _whole_step(rows, jacobian)
        if _relative(step, at) > 0.5 * _relative(before, at):
            break
    at_rest = promised <= _LEFT * (rows @ rows) or rows @ rows <= _TOLERANCE**2 * len(rows)
    ended, count = found.status > 0, len(latest[1])
    return Ended(at, rows[:count], jacobian[:count], steps, bool(ended and at_rest), bool(ended and not at_rest))


def _whole_step(
    rows: Float[np.ndarray, " rows"], jacobian: Float[np.ndarray, "rows numbers"]
) -> tuple[Float[np.ndarray, " numbers"], float]:
    """Gauss and Newton's step, none in directions that no row shows, and the squares that it promises to take off."""
    length = np.sqrt((jacobian**2).sum(0))
    scaled = jacobian / np.where(length > 0, length, 1.0)
    step = -np.linalg.lstsq(scaled, rows, rcond=_SHOWN)[0]
    return step / np.where(length > 0, length, 1.0), float(np.sum((scaled @ step) ** 2))


def _relative(step: Float[np.ndarray, " numbers"], at: Float[np.ndarray, " numbers"]) -> float:
    return float(np.max(np.abs(step) / (1.0 + np.abs(at)), initial=0.0))
