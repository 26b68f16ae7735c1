r"""Rotations and poses as groups: exponential, logarithm and their Jacobians, smooth at zero and up to a half turn.

A rotation vector `w` (rad) and a twist `[linear, angular]` (m, rad) are small motions; `exp_*` turns them into a matrix
and `log_*` back. All functions take one element: the caller maps them over samples. Formulas: Sola, Deray, Atchuthan
(2018), "A micro Lie theory for state estimation in robotics".
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

__all__ = [
    "exp_se3",
    "exp_so3",
    "inverse_pose",
    "left_jacobian",
    "left_jacobian_inverse",
    "log_se3",
    "log_so3",
    "pose",
    "skew",
]

_SMALL = 1e-4  # rad^2; below it the series is exact to rounding, and the quotients lose digits


def skew(w: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Matrix with `skew(w) @ u == cross(w, u)`."""
    zero = jnp.zeros_like(w[0])
    return jnp.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).reshape(3, 3)


def pose(rotation: Float[Array, "3 3"], translation: Float[Array, "3"]) -> Float[Array, "4 4"]:
    """Pose of a rotation and a translation (m)."""
    top = jnp.concatenate([rotation, translation[:, None]], axis=1)
    return jnp.concatenate([top, jnp.array([[0.0, 0.0, 0.0, 1.0]], top.dtype)])


def twist_pose(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """Pose E of a twist `[linear, angular]` (m, rad) as kinematic effects have it: translation, then rotation."""
    return pose(exp_so3(twist[3:]), twist[:3])


def inverse_pose(a_T_b: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """Pose the other way round."""
    back = a_T_b[:3, :3].T
    return pose(back, -back @ a_T_b[:3, 3])


def exp_so3(w: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rotation by |w| rad about w (Rodrigues)."""
    s, c, _ = _coefficients(w @ w)
    K = skew(w)
    return jnp.eye(3, dtype=w.dtype) + s * K + c * K @ K


@jax.custom_jvp
def log_so3(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Rotation vector (rad) of a rotation matrix, of the shorter way round; at a half turn either sign.

    By way of the unit quaternion, from the largest of its four entries: no quotient is ever small. The angle is
    2 atan2(|v|, w). Its derivative is that along rotations: `left_jacobian_inverse` times the angular velocity.
    """
    v, w = _quaternion(rotation)
    square = v @ v
    small = square < _SMALL
    norm = jnp.sqrt(jnp.where(small, 1.0, square))
    safe = jnp.where(small, w, 1.0)
    series = 2.0 / safe * (1.0 - square / (3.0 * safe**2) + square**2 / (5.0 * safe**4))
    return v * jnp.where(small, series, 2.0 * jnp.arctan2(norm, jnp.where(small, 1.0, w)) / norm)


@log_so3.defjvp
def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    w = log_so3(primals[0])
    spin = tangents[0] @ primals[0].T
    rate = 0.5 * jnp.stack([spin[2, 1] - spin[1, 2], spin[0, 2] - spin[2, 0], spin[1, 0] - spin[0, 1]])
    return w, left_jacobian_inverse(w) @ rate


def _quaternion(r: Float[Array, "3 3"]) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """Vector and scalar part (>= 0) of the unit quaternion: the row of 4 q q' with the largest diagonal entry."""
    x, y, z = r[0, 0], r[1, 1], r[2, 2]
    a, b, c = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    d, e, f = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    rows = jnp.stack([1 + x - y - z, d, e, a, d, 1 - x + y - z, f, b, e, f, 1 - x - y + z, c, a, b, c, 1 + x + y + z])
    rows = rows.reshape(4, 4)
    row = rows[jnp.argmax(jnp.diagonal(rows))]
    row = row / jnp.sqrt(row @ row) * jnp.where(row[3] < 0.0, -1.0, 1.0)
    return row[:3], row[3]


def left_jacobian(w: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """J with exp(w + d) = exp(J d) exp(w) to first order: turns a rate of `w` into an angular velocity."""
    _, b, c = _coefficients(w @ w)
    K = skew(w)
    return jnp.eye(3, dtype=w.dtype) + b * K + c * K @ K


def left_jacobian_inverse(w: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Inverse of `left_jacobian`: turns an angular velocity into the rate of the rotation vector."""
    square = w @ w
    small = square < _SMALL
    half = 0.5 * jnp.sqrt(jnp.where(small, 1.0, square))
    exact = (1.0 - half * jnp.cos(half) / jnp.sin(half)) / (4.0 * half**2)
    K = skew(w)
    d = jnp.where(small, 1.0 / 12.0 + square / 720.0 + square**2 / 30240.0, exact)
    return jnp.eye(3, dtype=w.dtype) - 0.5 * K + d * K @ K


def exp_se3(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """Pose after moving along the twist `[linear, angular]` (m, rad) for a unit of time."""
    linear, angular = twist[:3], twist[3:]
    return pose(exp_so3(angular), left_jacobian(angular) @ linear)


def log_se3(a_T_b: Float[Array, "4 4"]) -> Float[Array, "6"]:
    """Twist `[linear, angular]` (m, rad) whose exponential the pose is."""
    angular = log_so3(a_T_b[:3, :3])
    return jnp.concatenate([left_jacobian_inverse(angular) @ a_T_b[:3, 3], angular])


def _coefficients(square: Float[Array, ""]) -> tuple[Array, Array, Array]:
    """sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 of the squared angle, with a series near zero."""
    small = square < _SMALL
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    sine = jnp.sin(angle)
    a = jnp.where(small, 1.0 - square / 6.0 + square**2 / 120.0, sine / angle)
    b = jnp.where(small, 0.5 - square / 24.0 + square**2 / 720.0, 2.0 * jnp.sin(angle / 2.0) ** 2 / safe)
    c = jnp.where(small, 1.0 / 6.0 - square / 120.0 + square**2 / 5040.0, (angle - sine) / (safe * angle))
    return a, b, c
