"""Products of vectors and matrices in space, rotations of angles and quaternions; the samples on the last axis.

A vector is `[..., 3, samples]` and a matrix `[..., 3, 3, samples]`. The products are sums of element products along the
samples, which XLA fuses on every device, where a batched 3x3 matrix product would be slow. A pose is a 4x4 matrix
`A_T_B` that maps points of frame B into frame A.
"""

from __future__ import annotations

from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

__all__ = ["cross", "matmul", "quaternion_rotation", "rotate", "rotate_back", "sine_cosine"]

# pi in parts of 30 bits, so that the product of the first two with a small whole number is exact
_PI = (3.141592651605606, 1.9841871583270443e-09, 1.034036596358821e-18)
_SINE = [(-1) ** k / factorial(2 * k + 1) for k in range(10, 0, -1)]  # r^21 ... r^3: 1e-18 at a quarter turn


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


@jax.custom_jvp
def sine_cosine(angle: Float[Array, "*a n"]) -> Float[Array, "*a 2 n"]:
    """Sine and cosine (rad), to 2e-16 up to 1e5 rad in float64.

    XLA's own go to the C library, one number at a time on a CPU; these are additions and products for all samples at
    once: the angle less the nearest odd or even multiple of a quarter turn, then the sine's series.
    """
    if angle.dtype != jnp.float64:
        return jnp.stack([jnp.sin(angle), jnp.cos(angle)], axis=-2)
    half = np.array([[0.0], [0.5]])  # the cosine is a sine a quarter turn on
    angle = angle[..., None, :]
    turns = jnp.round(angle * (1.0 / np.pi) - half)
    rest = ((angle - (turns + half) * _PI[0]) - (turns + half) * _PI[1]) - (turns + half) * _PI[2]
    square, series = rest * rest, _SINE[0]
    for term in _SINE[1:]:
        series = series * square + term
    odd = turns - 2.0 * jnp.floor(0.5 * turns)
    return (rest + rest * square * series) * (1.0 - 2.0 * odd) * (1.0 - 4.0 * half)


@sine_cosine.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    both = sine_cosine(*primals)
    turned = both[..., ::-1, :] * np.array([[1.0], [-1.0]], both.dtype)
    return both, turned * tangents[0][..., None, :]


def quaternion_rotation(quaternion: Float[Array, "*a 4 n"]) -> Float[Array, "*a 3 3 n"]:
    """Rotation matrix of a quaternion x, y, z, w of any length but zero."""
    x, y, z, w = (quaternion[..., k, :] for k in range(4))
    s = 2.0 / (x * x + y * y + z * z + w * w)
    rows = [
        [1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-2) for row in rows], axis=-3)
