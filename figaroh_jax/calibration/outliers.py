r"""Postures that no model explains: found one after the other by what the others predict for them.

The error of posture i is predicted by a robust fit without it, $e_i$ of `marginal.left_out`, whose covariance is
$(I - w_i H_i)^{-1}$. Its size is the root of the mean square of $e_i$ in that covariance, $\sqrt{r_i' e_i / n}$.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from ..estimation import marginal
from ..estimation.marginal import Linear, Posterior
from . import thresholds

__all__ = ["find_outliers"]


def find_outliers(
    linear: Linear, used: Bool[np.ndarray, " rows"], free: Bool[np.ndarray, " unknowns"]
) -> dict[int, float]:
    """Postures among the rows `used` that are outliers to a fit of the `free` unknowns, and the size of each."""
    found: dict[int, float] = {}
    postures = len(np.unique(linear.posture[used]))
    while len(found) < max(1, int(thresholds.OUTLIERS_AT_MOST * postures)):
        rows = used & ~np.isin(linear.posture, list(found))
        posterior = marginal.fit(linear, rows, free, robust=True)
        numbers, sizes, counts = _sizes(linear, posterior, rows)
        worst = int(np.argmax(sizes))
        if sizes[worst] < _limit(np.log(sizes), int(counts[worst])):
            break
        found[int(numbers[worst])] = float(sizes[worst])
    return found


def _limit(logarithms: np.ndarray, count: int) -> float:
    """Size from which a posture of `count` numbers is an outlier, by median and median deviation of all logarithms.

    That deviation is known from few postures: it is no less than that of normal noise, 1/sqrt(2 n) for n numbers.
    """
    if len(logarithms) < thresholds.ENOUGH:
        return thresholds.FAR
    middle = np.median(logarithms)
    spread = max(1.4826 * float(np.median(np.abs(logarithms - middle))), (2 * count) ** -0.5)
    return min(thresholds.FAR, float(np.exp(middle + thresholds.ALONE * spread)))


def _sizes(linear: Linear, posterior: Posterior, used: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Postures, the size of each one's error, and of how many numbers it is."""
    residual, predicted = marginal.left_out(linear, posterior, used)
    rows = np.flatnonzero(used & (linear.posture >= 0))
    postures, which = np.unique(linear.posture[rows], return_inverse=True)
    square = residual[rows] * predicted[rows] / posterior.noise[linear.channel[rows]] ** 2
    counts = np.bincount(which)
    return postures, np.sqrt(np.maximum(np.bincount(which, square) / counts, 1e-24)), counts
