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
from .model import Leaf
from .records import Records

__all__ = ["Whitened", "bounded_minimum", "profile", "refit"]

STEPS = 12
RIDGE = 1e-9


class Whitened(eqx.Module):
    """Residual and regressor of the current model as whitened rows, `A^-1`, and the whitening response."""

    residual: Float[Leaf, "nv n M"]
    X: Float[Leaf, "nv n M P"]
    inverse: Float[Leaf, "P P"]
    whitening: Any  # (F, nv), complex where the torque sensor has a response


def bounded_minimum(
    function: Callable[[Any], tuple[Any, Any]], start: Any, lower: Any, upper: Any, *, native: bool = False
) -> Any:
    """Minimiser in a box of a smooth function that answers its value and its gradient, by L-BFGS-B.

    The only place that knows the minimisers. SciPy's runs on the host around one compiled function. `native` takes
    jaxopt's, which works inside `jit` and `vmap` but compiles its own loop around every function (6 CPU s around a
    trivial one, 13 to 38 s around a refit), and is no longer maintained.
    """
    if native:
        from jaxopt import LBFGSB

        solver = LBFGSB(function, value_and_grad=True, maxiter=STEPS, tol=1e-6, implicit_diff=False)
        return solver.run(start, bounds=(lower, upper)).params
    from scipy.optimize import minimize  # slow to import

    options = {"maxiter": STEPS, "ftol": 1e-7, "gtol": 1e-6}
    return minimize(function, start, jac=True, bounds=list(zip(lower, upper, strict=True)), options=options).x


def profile(
    effect: Effect, motion: Motion, records: Records, whitened: Whitened
) -> tuple[Float[Array, ""], Float[Array, "k rows n M"]]:
    """J(p) of the effect at its shape, the change of the penalised sum of squares that it brings; its columns."""
    Z = effect_rows(effect, motion, records, whitened.whitening)
    own = Z.shape[1] != whitened.residual.shape[0]
    residual = whitened.residual[effect.at] if own else whitened.residual
    X = whitened.X[effect.at] if own else whitened.X
    k = Z.shape[0]
    flat = Z.reshape(k, -1)
    s = flat @ residual.reshape(-1)
    C = flat @ X.reshape(flat.shape[1], -1)
    G = flat @ flat.T - C @ whitened.inverse @ C.T
    if kind(effect) != "columns":
        (name,) = effect.parameters()
        size = getattr(effect, name)
        return size**2 * G[0, 0] - 2 * size * s[0], Z
    scale = jnp.sqrt(jnp.diagonal(flat @ flat.T) + 1e-300)
    unit = G / (scale[:, None] * scale[None, :]) + RIDGE * jnp.eye(k)
    return -(s / scale) @ jnp.linalg.solve(unit, s / scale), Z


@eqx.filter_jit
def _profiles(
    effects: Effect, values: Float[Leaf, "starts p"], motion: Motion, records: Records, whitened: Whitened
) -> tuple[Float[Array, " starts"], Float[Array, "starts p"], Float[Array, "starts k rows n M"]]:
    """Profile, gradient and columns of several starts, each its own effect with its own shape."""
    names = shapes(type(effects))

    def one(effect: Effect, x: Float[Array, " p"]) -> tuple[Array, tuple[Array, Array]]:
        value, Z = profile(with_shape(effect, names, list(x)), motion, records, whitened)
        return value, (value, Z)

    slope, (value, Z) = jax.vmap(jax.jacfwd(one, argnums=1, has_aux=True))(effects, values)
    return value, slope, Z


def refit(
    effects: Effect, motion: Motion, records: Records, whitened: Whitened
) -> tuple[Effect, Float[np.ndarray, "k rows n M"]]:
    """Best shape over the starts (leading axis of `effects`), each between its neighbours on the grid; its columns.

    All starts are one box problem: the sum of their profiles, whose gradient is that of each.
    """
    names = shapes(type(effects))
    start = np.stack([np.asarray(getattr(effects, name)) for name in names], axis=-1)
    wide = kind(effects) == "position"  # the profile of a shift has one valley, and the grid of its columns is alike
    box = np.stack([_box(effects.parameters()[n], x, wide) for n, x in zip(names, start.T, strict=True)], axis=-1)
    low, width = box[:, 0], box[:, 1] - box[:, 0]
    scale = 1.0

    def function(u: Float[np.ndarray, " startsp"]) -> tuple[float, Float[np.ndarray, " startsp"]]:
        value, slope, _ = _profiles(effects, low + u.reshape(low.shape) * width, motion, records, whitened)
        return float(value.sum()) / scale, np.asarray(slope * width).reshape(-1) / scale

    first = ((start - low) / width).reshape(-1)
    scale = abs(function(first)[0]) + 1e-9
    found = bounded_minimum(function, first, np.zeros_like(first), np.ones_like(first))
    values = low + found.reshape(low.shape) * width
    value, _, Z = _profiles(effects, values, motion, records, whitened)
    best = int(np.argmin(np.where(np.isfinite(value), value, np.inf)))
    one = jax.tree.map(lambda x: np.asarray(x)[best], effects)
    return with_shape(one, names, list(values[best])), np.asarray(Z[best])


def with_shape(effect: Effect, names: list[str], values: list[Any]) -> Effect:
    """The effect with the named parameters replaced."""
    return eqx.tree_at(lambda e: [getattr(e, name) for name in names], effect, values)


def shapes(effect: type[Effect]) -> list[str]:
    return [name for name, p in effect.parameters().items() if not p.linear and not p.choice]


def _box(parameter: Any, starts: Float[np.ndarray, " starts"], wide: bool) -> Float[np.ndarray, "starts 2"]:
    """Neighbouring grid points of each start; the outermost, or all if `wide`, reach to the parameter's bounds."""
    if wide:
        return np.tile([parameter.lower, parameter.upper], (len(starts), 1))
    grid = np.array([parameter.lower, *sorted(parameter.grid), parameter.upper])
    place = np.array([np.argmin(np.abs(grid[1:-1] - x)) + 1 for x in starts])
    low, high = grid[place - 1], grid[place + 1]
    if parameter.hole:
        low = np.where(starts >= parameter.hole[1], np.maximum(low, parameter.hole[1]), low)
        high = np.where(starts <= parameter.hole[0], np.minimum(high, parameter.hole[0]), high)
    return np.stack([low, high], axis=1)
