r"""Unknowns, prior widths and noise together, from the linearised problem: a maximum a posteriori fit.

Rows $r = r_0 + J (y - y_0)$; noise $s_c$ per channel, a prior $N(0, \sigma_g^2)$ on the unknowns of each group g, flat
where there is none. Widths and noise are chosen by marginal likelihood (MacKay 1992, fixed point), the widths with two
pseudo-counts at a stated tolerance: $\sigma_g^2 = (|y_g|^2 + 2 t_g^2) / (\gamma_g + 2)$, $\gamma_g = n_g -
\mathrm{tr}(\Lambda\Sigma)_g$, $s_c^2 = \mathrm{RSS}_c / (n_c - \gamma_c)$. With `robust`, postures are weighted by a
Student t of ten degrees of freedom.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

__all__ = ["FLAT", "Linear", "Posterior", "fit", "posture_weights"]

FLAT = -1  # group of unknowns without a prior
_FREEDOM = 10.0  # of the Student t: fewer cost clean sets more than they gain on dirty ones
_PSEUDO = 2.0
_ANCHOR = 1e-10  # precision of flat unknowns, so that one without any row stays where it is

Array = np.ndarray


class Linear(NamedTuple):
    """The linearised rows of a problem and what belongs together in it."""

    residual: Float[Array, " rows"]  # at `at`, m or rad
    jacobian: Float[Array, "rows unknowns"]
    at: Float[Array, " unknowns"]
    channel: Int[Array, " rows"]
    posture: Int[Array, " rows"]  # -1: a constraint
    prior: Int[Array, " unknowns"]  # group of each unknown's prior, or FLAT
    tolerance: Float[Array, " groups"]  # stated width of each group, in the unknowns' scale


class Posterior(NamedTuple):
    """What `fit` finds; arrays over the free unknowns carry zeros at the others."""

    unknowns: Float[Array, " unknowns"]
    covariance: Float[Array, "unknowns unknowns"]
    precision: Float[Array, " unknowns"]  # of the prior
    noise: Float[Array, " channels"]  # m, rad
    weight: Float[Array, " postures"]  # 1 unless robust
    width: Float[Array, " groups"]
    freedom: float  # unknowns that the data decide


def fit(
    linear: Linear,
    used: Bool[Array, " rows"],
    free: Bool[Array, " unknowns"],
    robust: bool = False,
    start: Posterior | None = None,
    iterations: int = 60,
) -> Posterior:
    """The posterior from the rows `used`, over the unknowns that are `free` (the others stay zero)."""
    rows = np.flatnonzero(used)
    J, channel, posture = linear.jacobian[rows][:, free], linear.channel[rows], linear.posture[rows]
    # from `at`, where the residual is small, no digits are lost; held unknowns go to zero
    base = linear.residual[rows] - linear.jacobian[rows][:, ~free] @ linear.at[~free]
    at, prior = linear.at[free], linear.prior[free]
    postures = linear.posture.max() + 1
    width = linear.tolerance.copy() if start is None else start.width.copy()
    noise = _first_noise(base, channel) if start is None else start.noise.copy()
    weight = np.ones(postures) if start is None else start.weight.copy()
    y, covariance, precision = at, np.zeros((len(at),) * 2), np.zeros(len(at))
    for _ in range(iterations):
        previous = np.concatenate([width, noise, weight])
        scaled = np.sqrt(_row_weights(weight, posture)) / noise[channel]
        G = J * scaled[:, None]
        precision = np.where(prior == FLAT, _ANCHOR, width[prior] ** -2.0)
        covariance = _inverse(G.T @ G + np.diag(precision))
        step = -covariance @ (G.T @ (base * scaled) + precision * at)
        y, r = at + step, base + J @ step
        leverage = ((G @ covariance) * G).sum(axis=1)
        noise = _noise(r, scaled * noise[channel], leverage, channel, noise)
        width = _widths(y, covariance, precision, prior, linear.tolerance)
        if robust:
            weight = posture_weights(r / noise[channel], posture, postures)
        now = np.concatenate([width, noise, weight])
        if np.max(np.abs(now - previous) / (np.abs(previous) + 1e-300)) < 1e-3:
            break
    return _spread(y, covariance, precision, free, noise, weight, width)


def posture_weights(
    whitened: Float[Array, " rows"], posture: Int[Array, " rows"], postures: int
) -> Float[Array, " postures"]:
    """Student-t weight of each posture from its whitened rows: (nu + m) / (nu + sum of squares), 1 on average."""
    inside = posture >= 0
    square = np.bincount(posture[inside], whitened[inside] ** 2, minlength=postures)
    count = np.bincount(posture[inside], minlength=postures)
    return (_FREEDOM + count) / (_FREEDOM + square)


def _row_weights(weight: Array, posture: Array) -> Array:
    return np.where(posture >= 0, weight[posture], 1.0)


def _first_noise(residual: Array, channel: Array) -> Array:
    return (
        np.array([np.sqrt(np.mean(residual[channel == c] ** 2)) if np.any(channel == c) else 1.0 for c in (0, 1)])
        + 1e-12
    )


def _noise(r: Array, root: Array, leverage: Array, channel: Array, before: Array) -> Array:
    found = before.copy()
    for c in (0, 1):
        mine = channel == c
        if mine.any():
            left = max(mine.sum() - leverage[mine].sum(), 1.0)
            found[c] = np.sqrt(max(np.sum((root[mine] * r[mine]) ** 2) / left, 1e-24))
    return found


def _widths(y: Array, covariance: Array, precision: Array, prior: Array, tolerance: Array) -> Array:
    width = tolerance.copy()
    for g in range(len(tolerance)):
        mine = prior == g
        if mine.any():
            gamma = mine.sum() - np.sum(precision[mine] * np.diag(covariance)[mine])
            width[g] = np.sqrt((np.sum(y[mine] ** 2) + _PSEUDO * tolerance[g] ** 2) / (max(gamma, 0.0) + _PSEUDO))
    return width


def _inverse(matrix: Array) -> Array:
    from scipy.linalg import cho_factor, cho_solve

    root = 1.0 / np.sqrt(np.diag(matrix))
    unit = matrix * np.outer(root, root)
    try:
        found = cho_solve(cho_factor(unit), np.eye(len(matrix)))
    except np.linalg.LinAlgError:  # without priors what the rows hardly tell apart drowns in rounding
        found = np.linalg.pinv(unit, rcond=1e-14, hermitian=True)
    return found * np.outer(root, root)


def _spread(y, covariance, precision, free, noise, weight, width) -> Posterior:
    n, where = len(free), np.flatnonzero(free)
    unknowns, whole, priors = np.zeros(n), np.zeros((n, n)), np.zeros(n)
    unknowns[where], priors[where] = y, precision
    whole[np.ix_(where, where)] = covariance
    freedom = float(np.sum(1.0 - precision * np.diag(covariance)))
    return Posterior(unknowns, whole, priors, noise, weight, width, freedom)
