"""Rigid motions in space: rotations, rigid transforms and the products of three-vectors.

Conventions. A pose is a 4x4 matrix `A_T_B` that maps points of frame B into frame A. Twists and wrenches are
`[linear, angular]`. Kernels hold samples on the *last* axis: a vector is `[..., 3, samples]` and a matrix
`[..., 3, 3, samples]`; their products are sums of element products, which every backend fuses, where a batched 3x3
matrix product would be slow.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = ["cross", "exp", "log", "matmul", "pose", "rotate", "rotate_back", "skew"]


def exp(twist: Float[Array, "*batch 6"]) -> Float[Array, "*batch 4 4"]:
    """Pose reached by following `twist` (linear m, angular rad, in the moving frame) for unit time."""
    return jaxlie.SE3.exp(jnp.asarray(twist)).as_matrix()


def log(transform: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch 6"]:
    """Twist (linear m, angular rad) whose `exp` is `transform`; rotations by pi have two answers, one is given."""
    return jaxlie.SE3.from_matrix(jnp.asarray(transform)).log()


def skew(vector: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3 3"]:
    """Matrix of the cross product: `skew(u) @ x == cross(u, x)`."""
    x, y, z = jnp.moveaxis(jnp.asarray(vector), -1, 0)
    o = jnp.zeros_like(x)
    rows = [jnp.stack(row, -1) for row in ((o, -z, y), (z, o, -x), (-y, x, o))]
    return jnp.stack(rows, -2)


def pose(rotation: Float[Array, "*batch 3 3"], position: Float[Array, "*batch 3"]) -> Float[Array, "*batch 4 4"]:
    """Pose with the given rotation and position (m)."""
    top = jnp.concatenate([rotation, position[..., None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0], top.dtype), (*top.shape[:-2], 1, 4))
    return jnp.concatenate([top, bottom], axis=-2)


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
