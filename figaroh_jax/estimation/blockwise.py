r"""Levenberg-Marquardt on normal equations that are added up block by block, with optimistix's interface.

Optimistix's own takes the QR factor of the whole Jacobian. This one asks `args.normal(y)` for $J'J$, $J'r$ and the
cost, which `fit` gives for postures in closed form, a block of them at a time: the Jacobian of all rows never exists.
Where `args` has no such method, they are made of the Jacobian of `fn`. See `posesolver` for the steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float

from .posesolver import NormalEquations, State, attempt, beginning, stuck

__all__ = ["BlockLevenbergMarquardt", "normal_of"]


class BlockLevenbergMarquardt(optimistix.AbstractLeastSquaresSolver):
    """Damped steps from normal equations; `y` is one vector. For `fit(solver=...)` and `optimistix.least_squares`.

    It stops where the next step is below 1e-9 of the (scaled) unknowns, or promises less than 1e-14 of the cost.

    >>> import jax.numpy as jnp, optimistix, figaroh_jax as fj
    >>> rows = lambda y, data: jnp.exp(y[0] * data[0]) + y[1] - data[1]
    >>> data = jnp.arange(5.0), jnp.exp(0.5 * jnp.arange(5.0)) + 2.0
    >>> found = optimistix.least_squares(rows, fj.BlockLevenbergMarquardt(), jnp.zeros(2), args=data)
    >>> [round(float(x), 6) for x in found.value]
    [0.5, 2.0]
    """

    rtol: float = 1e-9
    atol: float = 1e-9
    norm: Callable[..., Any] = optimistix.max_norm

    def init(self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any) -> State:
        """State at the start `y` (unknowns,); nothing has been evaluated yet."""
        del fn, args, options, f_struct, aux_struct, tags
        return beginning(y)

    def step(self, fn: Any, y: Any, args: Any, options: Any, state: State, tags: Any) -> tuple[Array, State, None]:
        """One damped step, from the data's own normal equations (`args.normal`) or those of a Jacobian of `fn`."""
        del y, options, tags
        normal = getattr(args, "normal", None) or (lambda at: normal_of(lambda x: fn(x, args)[0], at))
        state = attempt(normal, state)
        return state.at, state, None

    def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: State, tags: Any) -> Any:
        """Whether it has converged, and `nonlinear_divergence` where no damping lowers the cost any more."""
        del fn, y, args, options, tags
        failed = optimistix.RESULTS.nonlinear_divergence
        good = optimistix.RESULTS.successful
        return state.converged, optimistix.RESULTS.where(stuck(state) & ~state.converged, failed, good)

    def postprocess(
        self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: State, tags: Any, result: Any
    ) -> tuple[Array, None, dict[str, Any]]:
        """The solution, with its cost (half the sum of squares) and last damping as `stats`."""
        del fn, aux, args, options, tags, result
        return y, None, {"cost": state.normal.cost, "damping": state.damping}


def normal_of(rows: Callable[[Array], Any], at: Float[Array, " unknowns"]) -> NormalEquations:
    """Normal equations from the Jacobian of the rows, in forward mode."""

    def flat(y: Array) -> tuple[Array, Array]:
        value = jnp.concatenate([jnp.reshape(x, -1) for x in jax.tree.leaves(rows(y))])
        return value, value

    J, r = eqx.filter_jit(jax.jacfwd(flat, has_aux=True))(at)
    highest = jax.lax.Precision.HIGHEST
    return NormalEquations(jnp.matmul(J.T, J, precision=highest), J.T @ r, 0.5 * jnp.sum(r**2))
