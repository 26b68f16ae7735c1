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

__all__ = ["FLAT", "Linear", "Posterior", "fit", "honest_covariance", "left_out", "posture_weights"]

FLAT = -1  # group of unknowns without a prior
_FREEDOM = 10.0  # of the Student t: fewer cost clean sets more than they gain on dirty ones
_PSEUDO = 2.0
_LEAST_NOISE = 1e-9  # m or rad: of rows without noise the rounding would make normal matrices singular
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
    spread: float  # variance of estimates from weighted rows over what `covariance` says, which counts weights as known


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
    postures = int(linear.posture.max()) + 1
    width = linear.tolerance.copy() if start is None else start.width.copy()
    noise = _first_noise(base, channel) if start is None else start.noise.copy()
    weight = np.ones(postures) if start is None else start.weight.copy()
    y, covariance, precision, spread = at, np.zeros((len(at),) * 2), np.zeros(len(at)), 1.0
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
            spread = _spread_of(r / noise[channel], weight, posture, float(leverage.sum()))
        now = np.concatenate([width, noise, weight])
        if np.max(np.abs(now - previous) / (np.abs(previous) + 1e-300)) < 1e-3:
            break
    return _filled(y, covariance, precision, free, noise, weight, width)._replace(spread=spread)


def honest_covariance(posterior: Posterior, prior: Int[Array, " unknowns"]) -> Float[Array, "unknowns unknowns"]:
    r"""Covariance of the estimates that counts in what was estimated with them: weights of postures, widths of priors.

    The information of the rows over `spread`, and priors of variance $\sigma_g^2\, \nu / (\nu - 2)$, that of a Student
    t with the $\nu = \gamma_g + 2$ numbers that the width of a group was taken from.
    """
    free = posterior.precision > 0.0
    inside = np.ix_(free, free)
    precision = posterior.precision[free]
    known = 1.0 - precision * np.diag(posterior.covariance)[free]
    wider = precision.copy()
    for group in np.unique(prior[free & (prior != FLAT)]):
        mine = prior[free] == group
        gamma = max(float(known[mine].sum()), 0.0)
        wider[mine] *= max(gamma / (gamma + _PSEUDO), 0.25)
    found = np.zeros_like(posterior.covariance)
    both = _inverse(posterior.covariance[inside])
    information = _without_negative(both - np.diag(precision), np.diag(both))  # where the rows tell nothing, rounding
    found[inside] = _inverse(information / posterior.spread + np.diag(wider))
    return found


def _without_negative(matrix: Array, diagonal: Array) -> Array:
    """The matrix without what is negative of it, in units of the roots of a `diagonal`."""
    root = np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(matrix / np.outer(root, root))
    return (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(root, root)


def _spread_of(whitened: Array, weight: Array, posture: Array, leverage: float) -> float:
    r"""$E[w^2 r^2] E[w] / E[d(w r)/dr]^2$, the sandwich over the inverse information (Huber 1967), rows of postures."""
    inside = posture >= 0
    w, square = weight[posture[inside]], whitened[inside] ** 2
    count = np.bincount(posture[inside])[posture[inside]]
    slope = np.mean(w - 2.0 * w**2 * square / (_FREEDOM + count))
    left = max(1.0 - leverage / len(whitened), 1e-3)
    return float(np.mean(w**2 * square) / left * np.mean(w) / slope**2)


def left_out(
    linear: Linear, posterior: Posterior, used: Bool[Array, " rows"]
) -> tuple[Float[Array, " rows"], Float[Array, " rows"]]:
    r"""Residual of all rows at the posterior, and what those `used` would be without their posture in the fit.

    To first order, widths and weights held: $e_i = (I - w_i H_i)^{-1} r_i$, $H_i = J_i \Sigma J_i'$ of whitened rows.
    """
    residual = linear.residual + linear.jacobian @ (posterior.unknowns - linear.at)
    predicted = residual.copy()
    rows = np.flatnonzero(used & (linear.posture >= 0))
    rows = rows[np.argsort(linear.posture[rows], kind="stable")]
    _, first, count = np.unique(linear.posture[rows], return_index=True, return_counts=True)
    for size in np.unique(count):
        some = rows[first[count == size][:, None] + np.arange(size)]  # postures, their rows
        noise = posterior.noise[linear.channel[some]]
        G = linear.jacobian[some] / noise[..., None]
        weight = posterior.weight[linear.posture[some[:, 0]]][:, None, None]
        left = np.eye(size) - weight * (G @ posterior.covariance) @ np.swapaxes(G, 1, 2)
        predicted[some] = noise * np.linalg.solve(left, (residual[some] / noise)[..., None])[..., 0]
    return residual, predicted


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
        + _LEAST_NOISE
    )


def _noise(r: Array, root: Array, leverage: Array, channel: Array, before: Array) -> Array:
    found = before.copy()
    for c in (0, 1):
        mine = channel == c
        if mine.any():
            left = max(mine.sum() - leverage[mine].sum(), 1.0)
            found[c] = np.sqrt(max(np.sum((root[mine] * r[mine]) ** 2) / left, _LEAST_NOISE**2))
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


def _filled(y, covariance, precision, free, noise, weight, width) -> Posterior:
    n, where = len(free), np.flatnonzero(free)
    unknowns, whole, priors = np.zeros(n), np.zeros((n, n)), np.zeros(n)
    unknowns[where], priors[where] = y, precision
    whole[np.ix_(where, where)] = covariance
    freedom = float(np.sum(1.0 - precision * np.diag(covariance)))
    return Posterior(unknowns, whole, priors, noise, weight, width, freedom, 1.0)
