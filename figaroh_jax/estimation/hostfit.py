r"""Levenberg-Marquardt of which rows and Jacobian are one program and the steps are NumPy's: little to compile.

A solver inside of a program puts the rows into it several times (to step, to end, for the covariance), and long rows,
as those of a simulation, then take a minute to compile. Here they are compiled once. Damping follows Nielsen (1999), on
columns of one length (Marquardt 1963); each step comes from the QR factor of the Jacobian, so that nothing squares its
condition number.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

__all__ = ["Ended", "descend"]

_TOLERANCE = 1e-10  # of the numbers in their sizes, and of the cost: a step below it in both is the last one
_ROUNDING = 1e-13  # of the cost: which of two points is better, costs cannot tell below it
_DAMPING, _LEAST, _MOST = 1e-3, 1e-14, 1e12  # at the start and its limits, of columns of one length


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

    `precision` is p, `max_steps` limits the steps tried. One to where the rows are not finite is no step, and the
    search is `stuck` at once where they are not at the start.
    """
    root = np.sqrt(precision)
    at = np.zeros(len(root))
    ended = Ended(at, *rows_at(at), 0)
    cost = _cost(ended, root)
    if not (np.isfinite(cost) and np.isfinite(ended.jacobian).all()):
        return ended._replace(stuck=True)
    factor, right, scale = _triangle(ended, root)
    damping, growth, last = _DAMPING, 2.0, np.inf
    for tried in range(1, max_steps + 1):
        step = scale * _damped(factor, right, damping)
        promised = 0.5 * float(right @ right - np.sum((factor @ (step / scale) + right) ** 2))
        blind = promised <= _ROUNDING * cost
        trial = Ended(ended.at + step, *rows_at(ended.at + step), tried)
        gained = cost - _cost(trial, root)
        if not (gained >= (-10 * _ROUNDING * cost if blind else 0.0) and np.isfinite(trial.jacobian).all()):
            damping, growth, ended = damping * growth, 2.0 * growth, ended._replace(steps=tried)
            if damping > _MOST:
                return ended._replace(converged=blind, stuck=not blind)
            continue
        ended, cost = trial, cost - gained
        length = float(np.max(np.abs(step) / (1.0 + np.abs(ended.at)), initial=0.0))
        if length < _TOLERANCE and abs(gained) < _TOLERANCE * (1.0 + cost) or blind and length > 0.5 * last:
            return ended._replace(converged=True)
        last = length if blind else np.inf
        shrink = 0.1 if blind else max(0.1, 1.0 - (2.0 * gained / promised - 1.0) ** 3)
        damping, growth = max(damping * shrink, _LEAST), 2.0
        factor, right, scale = _triangle(ended, root)
    return ended


def _cost(one: Ended, root: Float[np.ndarray, " numbers"]) -> float:
    return 0.5 * float(one.rows @ one.rows + np.sum((root * one.at) ** 2))


def _triangle(
    one: Ended, root: Float[np.ndarray, " numbers"]
) -> tuple[Float[np.ndarray, "some numbers"], Float[np.ndarray, " some"], Float[np.ndarray, " numbers"]]:
    """R and Q'r of rows and prior with columns of one length, and what a step in these is of the numbers."""
    whole = np.concatenate([one.jacobian, np.diag(root)])
    length = np.sqrt((whole**2).sum(0))
    scale = 1.0 / np.where(length > 0, length, 1.0)
    right = np.concatenate([one.rows, root * one.at])
    triangle = np.asarray(np.linalg.qr(np.column_stack([whole * scale, right]), mode="r"))
    return triangle[:, :-1], triangle[:, -1], scale


def _damped(
    factor: Float[np.ndarray, "some numbers"], right: Float[np.ndarray, " some"], damping: float
) -> Float[np.ndarray, " numbers"]:
    count = factor.shape[1]
    whole = np.concatenate([factor, np.sqrt(damping) * np.eye(count)])
    Q, R = np.linalg.qr(whole)
    return -np.linalg.solve(R, Q[: len(right)].T @ right)
