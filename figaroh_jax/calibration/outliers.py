r"""Postures that no model explains: found one after the other by what the others predict for them.

The error of posture i is predicted by a robust fit without it, $e_i$ of `marginal.left_out`, whose covariance is
$(I - w_i H_i)^{-1}$. Its size is the root of the mean square of $e_i$ in that covariance, $\sqrt{r_i' e_i / n}$.
Postures may also err together in all their rows: a joint that plays, or the device (`playing_joints`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from ..estimation import marginal
from ..estimation.marginal import Linear, Posterior
from . import thresholds

__all__ = ["find_outliers", "playing_joints", "still_outliers", "variance_along"]

Array = np.ndarray
_STEPS = np.concatenate([[0.0], 10.0 ** np.arange(-1.5, 2.51, 0.25)])  # standard deviations that are tried


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


def still_outliers(
    linear: Linear,
    posterior: Posterior,
    used: Bool[Array, " rows"],
    way: Float[Array, " rows"],
    suspects: Sequence[int],
) -> list[int]:
    """Those of the postures `suspects`, left out of the fit, that a joint which varies along `way` does not explain.

    The variance of the joint is that over the postures `used`; all sizes are taken again with it in the covariance.
    """
    whitened = way / posterior.noise[linear.channel]
    residual = (linear.residual + linear.jacobian @ (posterior.unknowns - linear.at)) / posterior.noise[linear.channel]
    variance = variance_along(linear, posterior, used, way)
    sizes, counts = {}, {}
    for k in (*np.unique(linear.posture[used & (linear.posture >= 0)]).tolist(), *suspects):
        rows = np.flatnonzero(linear.posture == k)
        rows = rows[used[rows]] if k not in suspects else rows[linear.residual[rows] != 0.0]  # 0: not measured
        G = linear.jacobian[rows] / posterior.noise[linear.channel[rows], None]
        spread = G @ posterior.covariance @ G.T
        g, e = whitened[rows], residual[rows]
        own = np.eye(len(rows))
        if k not in suspects:  # its own rows took part in the fit
            w = posterior.weight[k]
            own, spread = np.linalg.inv(own - w * spread), np.zeros_like(spread)
            e = own @ e
        sizes[k] = np.sqrt(e @ np.linalg.solve(own + spread + variance * np.outer(g, g), e) / len(rows))
        counts[k] = len(rows)
    others = np.log([max(size, 1e-12) for k, size in sizes.items() if k not in suspects])
    return [k for k in suspects if sizes[k] >= _limit(others, counts[k])]


def variance_along(
    linear: Linear, posterior: Posterior, used: Bool[Array, " rows"], way: Float[Array, " rows"]
) -> float:
    """Variance over the postures `used` of a motion along `way`, in the square of its unit."""
    noise = posterior.noise[linear.channel]
    inside = np.flatnonzero(used & (linear.posture >= 0))
    residual = (linear.residual + linear.jacobian @ (posterior.unknowns - linear.at))[inside] / noise[inside]
    postures, shown = linear.posture[inside], way[inside] / noise[inside]
    square, along = np.bincount(postures, shown**2), np.bincount(postures, shown * residual)
    return max(float(np.sum(along**2 - square) / max(np.sum(square**2), 1e-300)), 0.0)


def playing_joints(
    linear: Linear,
    noise: Float[Array, " rows"],
    used: Bool[Array, " rows"],
    ways: Float[Array, "rows joints"],
    device: Float[Array, "rows six"],
) -> list[int]:
    """The joints one of which varies from posture to posture beside a device that errs; none where it need not.

    Likelihood of normal errors with three components: all rows, the measured body's place and its rotation (as the
    columns `device` of the pose of its base move it; none: no such component), and one joint. A joint must be told from
    none, and those are given that are not told from the best.
    """
    rows = np.flatnonzero(used & (linear.posture >= 0))
    e = linear.residual[rows] / noise[rows]
    _, member = np.unique(linear.posture[rows], return_inverse=True)
    parts = [np.flatnonzero(member == k) for k in range(member.max() + 1)]
    turned = np.zeros((len(rows), 0))
    if device.shape[1] == 6:
        D = device[rows] / noise[rows, None]
        turned = D.copy()
        for part in parts:  # a rotation about the middle of what is measured
            turned[part, 3:] -= D[part, :3] @ np.linalg.lstsq(D[part, :3], D[part, 3:], rcond=None)[0]
    groups = np.array([0, 0, 0, 1, 1, 1, 2])[7 - turned.shape[1] - 1 :]
    found = []
    for way in (np.zeros(len(linear.residual)), *ways.T):
        U = np.column_stack([turned, way[rows] / noise[rows]])
        size = np.array([np.sqrt(np.mean(U[:, groups == g] ** 2)) for g in groups])
        U = U / np.where(size > 0.0, size, 1.0)
        A, b = np.array([U[p].T @ U[p] for p in parts]), np.array([U[p].T @ e[p] for p in parts])
        found.append(_likelihood(A, b, float(e @ e), len(e), groups))
    best = max(found[1:])
    if best - found[0] < thresholds.TOLD:
        return []
    return [k for k, value in enumerate(found[1:]) if best - value < thresholds.TOLD]


def _likelihood(A: Array, b: Array, square: float, count: int, groups: Array) -> float:
    """Largest log likelihood over the deviations of the components and of all rows; A, b: inner products by posture."""
    deviation = np.zeros(3)

    def value() -> float:
        s = deviation[groups]
        M = np.eye(len(s)) + s[:, None] * A * s
        sb = b * s
        fit = square - float(np.sum(sb * np.linalg.solve(M, sb[..., None])[..., 0]))
        return -0.5 * (count * np.log(max(fit, 1e-300) / count) + float(np.linalg.slogdet(M)[1].sum()))

    best = value()
    for _ in range(5):
        before = best
        for g in np.unique(groups):
            tried = []
            for step in _STEPS:
                deviation[g] = step
                tried.append(value())
            deviation[g], best = _STEPS[int(np.argmax(tried))], max(tried)
        if best - before < 1e-3:
            break
    return best
