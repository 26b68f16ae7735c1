r"""What a design makes as small as it can, as a function of the Gram matrix G of the weighted rows, and its gradient.

| objective | function | from |
|---|---|---|
| information | $-\log\det(G + M_0) / p$ (D-optimal) | prior $M_0$ |
| prediction | $\log \mathrm{tr}((G + M_0)^{-1} G_v)$ (V-optimal) | $G_v$: mean Gram matrix of the motions that matter |
| condition | logarithm of the condition number of G, smooth at first | nothing |
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..errors import InputError
from .programming import lapack
from .solvers import GramObjective

__all__ = [
    "condition_objective",
    "information_objective",
    "own_objective",
    "prediction_objective",
    "smooth_condition_objective",
]

_RIDGE = 1e-12  # of the mean diagonal: a motion that shows less has no finite information
SHARPNESS = 4.0  # of the soft extremes of the eigenvalues


def _inverse(G: Float[np.ndarray, "n n"]) -> tuple[np.ndarray, float]:
    """Inverse and log determinant, the columns scaled first."""
    size = np.sqrt(np.maximum(G.diagonal(), np.finfo(float).tiny))
    scaled = G / (size[:, None] * size)
    scaled.flat[:: len(G) + 1] += _RIDGE
    L, failed = lapack("potrf")(scaled, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the rows of a motion are not finite")
    half, _ = lapack("potri")(L, lower=1)  # its lower triangle
    inverse = np.tril(half) + np.tril(half, -1).T
    inverse /= size[:, None] * size
    return inverse, float(2 * np.log(L.diagonal() * size).sum())


def information_objective(prior: Float[np.ndarray, "n n"]) -> GramObjective:
    """Less the log determinant of the information, a parameter; in a design it is made small."""

    def objective(G: Float[np.ndarray, "n n"]) -> tuple[float, Float[np.ndarray, "n n"]]:
        inverse, logdet = _inverse(G + prior)
        return -logdet / len(G), -inverse / len(G)

    return objective


def prediction_objective(prior: Float[np.ndarray, "n n"], wanted: Float[np.ndarray, "n n"]) -> GramObjective:
    """Logarithm of the mean variance of the torque predicted on the motions of `wanted`."""

    def objective(G: Float[np.ndarray, "n n"]) -> tuple[float, Float[np.ndarray, "n n"]]:
        inverse, _ = _inverse(G + prior)
        spread = inverse @ wanted
        total = float(np.trace(spread))
        return float(np.log(total)), -(spread @ inverse) / total

    return objective


def condition_objective() -> GramObjective:
    """Logarithm of the condition number of the rows; it has kinks where eigenvalues meet."""

    def objective(G: Float[np.ndarray, "n n"]) -> tuple[float, Float[np.ndarray, "n n"]]:
        values, vectors = np.linalg.eigh(G)
        values = np.maximum(values, _RIDGE * values[-1])
        slope = (
            np.outer(vectors[:, -1], vectors[:, -1]) / values[-1] - np.outer(vectors[:, 0], vectors[:, 0]) / values[0]
        )
        return 0.5 * float(np.log(values[-1] / values[0])), 0.5 * slope

    return objective


def smooth_condition_objective(sharpness: float = SHARPNESS) -> GramObjective:
    """The same with soft extremes of the logarithms of the eigenvalues."""

    def objective(G: Float[np.ndarray, "n n"]) -> tuple[float, Float[np.ndarray, "n n"]]:
        values, vectors = np.linalg.eigh(G)
        values = np.maximum(values, _RIDGE * values[-1])
        logs = np.log(values)
        high, low = np.exp(sharpness * (logs - logs[-1])), np.exp(-sharpness * (logs - logs[0]))
        value = (np.log(high.sum()) + np.log(low.sum())) / sharpness + logs[-1] - logs[0]
        slope = (high / high.sum() - low / low.sum()) / values
        return 0.5 * float(value), 0.5 * (vectors * slope) @ vectors.T

    return objective


def own_objective(objective: Callable[..., Any]) -> GramObjective:
    """A user's objective with its slope, which is JAX's where the function gives none."""
    both = jax.jit(jax.value_and_grad(objective))

    def told(G: Float[np.ndarray, "n n"]) -> tuple[float, Float[np.ndarray, "n n"]]:
        given = objective(G)
        if isinstance(given, tuple):
            return given
        if np.shape(given) != ():
            raise InputError(f"objective gives an array of shape {np.shape(given)}; a number is expected")
        value, slope = both(jnp.asarray(G))
        return float(value), np.asarray(slope + slope.T) / 2

    return told
