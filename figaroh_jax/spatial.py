"""Products of vectors and matrices in space, the samples on the last axis.

A vector is `[..., 3, samples]` and a matrix `[..., 3, 3, samples]`. The products are sums of element products along the
samples, which XLA fuses on every device, where a batched 3x3 matrix product would be slow. A pose is a 4x4 matrix
`A_T_B` that maps points of frame B into frame A.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["cross", "matmul", "rotate", "rotate_back"]


def cross(u: Float[Array, "*a 3 n"], v: Float[Array, "*b 3 m"]) -> Float[Array, "..."]:
    """Cross product u x v with the samples last; leading axes and samples broadcast."""
    ux, uy, uz = u[..., 0, :], u[..., 1, :], u[..., 2, :]
    vx, vy, vz = v[..., 0, :], v[..., 1, :], v[..., 2, :]
    return jnp.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx], axis=-2)


def matmul(a: Float[Array, "*a i k n"], b: Float[Array, "*b k j m"]) -> Float[Array, "..."]:
    """Matrix product A B with the samples last."""
    first, *more = (a[..., :, k, None, :] * b[..., None, k, :, :] for k in range(a.shape[-2]))
    return sum(more, first)


def rotate(rotation: Float[Array, "*a i k n"], vector: Float[Array, "*b k m"]) -> Float[Array, "..."]:
    """Product of a matrix with a vector, R u, with the samples last."""
    first, *more = (rotation[..., :, k, :] * vector[..., None, k, :] for k in range(rotation.shape[-2]))
    return sum(more, first)


def rotate_back(rotation: Float[Array, "*a 3 3 n"], vector: Float[Array, "*b 3 m"]) -> Float[Array, "..."]:
    """Vector turned back, R' u, with the samples last."""
    return rotate(jnp.swapaxes(rotation, -3, -2), vector)
