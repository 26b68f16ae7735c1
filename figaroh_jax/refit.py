"""Exact refit of what enters nonlinearly: the profile likelihood of an effect's shape, minimised by its gradient.

For a shape p the linear unknowns are solved for, so the profile is J(p) = -s'G^-1 s for columns Z(p), s = Z'r and
G = Z'Z - Z'X A^-1 X'Z; for a sensor effect, whose size is its parameter, J(p) = D'D - 2 D'r - D'X A^-1 X'D.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .design import effect_rows, kind
from .effect import Effect, Motion
from .records import Records

__all__ = ["Whitened", "bounded_minimum", "profile", "refit"]

STEPS = 25
RIDGE = 1e-9


class Whitened(eqx.Module):
    """Residual and regressor of the current model as whitened rows, `A^-1`, and the whitening response."""

    residual: Float[Array, "nv n M"]
    X: Float[Array, "nv n M P"]
    inverse: Float[Array, "P P"]
    whitening: Any  # (F, nv), complex where the torque sensor has a response


def bounded_minimum(
    function: Callable[[Float[Array, " p"]], Float[Array, ""]],
    start: Float[Array, " p"],
    lower: Float[Array, " p"],
    upper: Float[Array, " p"],
) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """Minimiser and minimum of a smooth function in a box; differentiable function, any transform around it.

    L-BFGS-B of jaxopt, which is no longer maintained: this is the only place that knows it.
    """
    from jaxopt import LBFGSB

    solver = LBFGSB(function, maxiter=STEPS, tol=1e-7, linesearch="backtracking", maxls=8, jit=True, unroll=False)
    found = solver.run(start, bounds=(lower, upper))
    return found.params, function(found.params)


def profile(effect: Effect, motion: Motion, records: Records, whitened: Whitened) -> Float[Array, ""]:
    """J(p) of the effect at its shape, the change of the penalised sum of squares that it brings."""
    Z = effect_rows(effect, motion, records, whitened.whitening)
    own = Z.shape[1] != whitened.residual.shape[0]
    residual = whitened.residual[effect.at] if own else whitened.residual
    X = whitened.X[effect.at] if own else whitened.X
    if kind(effect) != "columns":
        (name,) = effect.parameters()
        Z = Z * getattr(effect, name)
    k = Z.shape[0]
    flat = Z.reshape(k, -1)
    s = flat @ residual.reshape(-1)
    C = flat @ X.reshape(flat.shape[1], -1)
    G = flat @ flat.T - C @ whitened.inverse @ C.T
    if kind(effect) != "columns":
        return G[0, 0] - 2 * s[0]
    scale = jnp.sqrt(jnp.diagonal(flat @ flat.T) + 1e-300)
    unit = G / (scale[:, None] * scale[None, :]) + RIDGE * jnp.eye(k)
    return -(s / scale) @ jnp.linalg.solve(unit, s / scale)


@eqx.filter_jit
def _search(
    effects: Effect, box: Float[Array, "starts 2 p"], motion: Motion, records: Records, whitened: Whitened
) -> tuple[Float[Array, "starts p"], Float[Array, " starts"], Float[Array, "starts k rows n M"]]:
    names = shapes(type(effects))
    positive = jnp.array([effects.parameters()[name].lower > 0 for name in names])

    def one(effect: Effect, edges: Float[Array, "2 p"]) -> tuple[Array, Array, Array]:
        def to(x: Array) -> Array:
            return jnp.where(positive, jnp.log(jnp.where(positive, x, 1.0)), x)

        low, high = to(edges[0]), to(edges[1])

        def value(u: Float[Array, " p"]) -> Float[Array, ""]:
            x = low + u * (high - low)
            x = jnp.where(positive, jnp.exp(jnp.where(positive, x, 0.0)), x)
            return profile(with_shape(effect, names, list(x)), motion, records, whitened) / scale

        start = (to(jnp.stack([getattr(effect, name) for name in names])) - low) / (high - low)
        scale = jnp.abs(profile(effect, motion, records, whitened)) + 1e-9
        best, least = bounded_minimum(value, start, jnp.zeros_like(start), jnp.ones_like(start))
        x = low + best * (high - low)
        x = jnp.where(positive, jnp.exp(jnp.where(positive, x, 0.0)), x)
        Z = effect_rows(with_shape(effect, names, list(x)), motion, records, whitened.whitening)
        return x, least * scale, Z

    return jax.vmap(one)(effects, box)


def refit(
    effects: Effect, motion: Motion, records: Records, whitened: Whitened
) -> tuple[Effect, Float[np.ndarray, "k rows n M"]]:
    """Best shape over the starts (leading axis of `effects`), each between its neighbours on the grid; its columns."""
    names = shapes(type(effects))
    box = np.stack([_box(effects.parameters()[n], np.asarray(getattr(effects, n))) for n in names], axis=-1)
    found, least, Z = _search(effects, box, motion, records, whitened)
    best = int(np.argmin(np.where(np.isfinite(least), least, np.inf)))
    one = jax.tree.map(lambda x: np.asarray(x)[best], effects)
    return with_shape(one, names, list(np.asarray(found[best]))), np.asarray(Z[best])


def with_shape(effect: Effect, names: list[str], values: list[Any]) -> Effect:
    """The effect with the named parameters replaced."""
    return eqx.tree_at(lambda e: [getattr(e, name) for name in names], effect, values)


def shapes(effect: type[Effect]) -> list[str]:
    return [name for name, p in effect.parameters().items() if not p.linear and not p.choice]


def _box(parameter: Any, starts: Float[np.ndarray, " starts"]) -> Float[np.ndarray, "starts 2"]:
    """Neighbouring grid points of each start; the outermost reach to the parameter's bounds."""
    grid = np.array([parameter.lower, *sorted(parameter.grid), parameter.upper])
    place = np.array([np.argmin(np.abs(grid[1:-1] - x)) + 1 for x in starts])
    low, high = grid[place - 1], grid[place + 1]
    return np.stack([np.where(low == starts, parameter.lower, low), np.where(high == starts, parameter.upper, high)], 1)
