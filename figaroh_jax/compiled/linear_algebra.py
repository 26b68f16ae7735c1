"""Small dense systems that are safe in batches on every device."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["symmetric_solve"]


def symmetric_solve(matrix: Float[Array, "n n"], right: Float[Array, "n k"]) -> Float[Array, "n k"]:
    """Solution of a positive definite system by its Cholesky factor; differentiable, and mapped by `jax.vmap`.

    On a CPU a batch is solved one system after another: LAPACK's batched kernels in jaxlib wait for threads of the pool
    that runs them, and two of them at once on a machine of two cores wait for each other without end.
    """

    def solve(_: object, b: Array) -> Array:
        return jax.lax.platform_dependent(matrix, b, cpu=_one_by_one, default=_solved)

    multiply = lambda x: jnp.matmul(matrix, x, precision=jax.lax.Precision.HIGHEST)  # noqa: E731
    return jax.lax.custom_linear_solve(multiply, right, solve, symmetric=True)


def _solved(matrix: Array, right: Array) -> Array:
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), right)


_one_by_one = jax.custom_batching.sequential_vmap(_solved)
