"""Torques of the rigid body: inverse and forward dynamics and the mass matrix.

Every link's wrench is taken about the origin of the *world*, so that what a joint carries is the plain sum over the
links that it moves: one product with the tree's matrix of 0 and 1, without a second pass along the tree. Inside the
kernels the sample is the last axis; the public functions take any leading batch axes.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .inertia import pseudo_inertia
from .kinematics import Motion, add_up, ancestors, axis_twists, gather, in_samples, motion, placements, states
from .model import RobotModel
from .spatial import cross, matmul, rotate, rotate_back

__all__ = ["forward_dynamics", "inverse_dynamics", "joint_torques", "mass_matrix"]


def inverse_dynamics(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nv"],
    v: Float[ArrayLike, "*batch nv"],
    a: Float[ArrayLike, "*batch nv"],
) -> Float[Array, "*batch nv"]:
    r"""Torques (N m; N for a prismatic joint) that give the rigid body the accelerations `a`.

    Newton-Euler in the world frame: $\tau_j = (p_j \times s_j) \cdot f_j + s_j \cdot n_j$ with f and n the force and
    the torque about the world's origin of all links that joint j moves. q, v, a in rad, rad/s, rad/s^2 (m for prismatic
    joints); computed in float64. Torques of joints that share a coordinate add up, each times its ratio. Raises
    `InputError` where the shapes do not fit the model.
    """
    with jax.enable_x64(True):
        return _inverse_dynamics(model, *states(model, q=q, v=v, a=a))


@jax.jit
def _inverse_dynamics(model: RobotModel, q: Array, v: Array, a: Array) -> Array:
    return in_samples(lambda *x: joint_torques(model, *x), q, v, a)


def joint_torques(
    model: RobotModel, q: Float[Array, "nv samples"], v: Float[Array, "nv samples"], a: Float[Array, "nv samples"]
) -> Float[Array, "nv samples"]:
    """Kernel of `inverse_dynamics`: the samples on the last axis, the dtype that of `q`."""
    state = motion(model, q, v, a)
    force, torque = (add_up(ancestors(model.joints), x) for x in link_wrenches(model, state))
    linear, angular = axis_twists(model, state.R, state.p)
    return gather(model, jnp.sum(linear * force + angular * torque, axis=1))


def link_wrenches(model: RobotModel, state: Motion) -> tuple[Float[Array, "nj 3 n"], Float[Array, "nj 3 n"]]:
    r"""Force (N) and torque about the world's origin (N m) that move each link, in the world.

    In the joint frame, with $h$ the first moment and $I$ the inertia about its origin:
    $f = m c + \alpha \times h + w \times (w \times h), \quad n = h \times c + I\alpha + w \times I w$.
    """
    w, al, ac = (rotate_back(state.R, x) for x in (state.w, state.al, state.ac))
    parameters = jnp.asarray(model.inertia, w.dtype)[..., None]
    m, h = parameters[:, :1], parameters[:, 1:4]
    force = m * ac + cross(al, h) + cross(w, cross(w, h))
    torque = cross(h, ac) + _turn(parameters, al) + cross(w, _turn(parameters, w))
    force, torque = rotate(state.R, force), rotate(state.R, torque)
    return force, torque + cross(state.p, force)


def _turn(parameters: Float[Array, "nj 10 1"], u: Float[Array, "nj 3 samples"]) -> Float[Array, "nj 3 samples"]:
    xx, xy, yy, xz, yz, zz = (parameters[:, k] for k in range(4, 10))
    x, y, z = u[:, 0], u[:, 1], u[:, 2]
    return jnp.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z], axis=1)


def mass_matrix(model: RobotModel, q: Float[ArrayLike, "*batch nv"]) -> Float[Array, "*batch nv nv"]:
    r"""Mass matrix of the rigid body (kg m^2; kg m, kg for prismatic joints), symmetric, in float64.

    Composite bodies (Featherstone 2008, section 6.2): entry (j, k), j above k or k itself, is the rate of joint j in
    the momentum of all that joint k carries, for a unit rate of joint k. Raises `InputError` where the shape of `q`
    does not fit the model.
    """
    with jax.enable_x64(True):
        return _mass_matrix(model, *states(model, q=q))


@jax.jit
def _mass_matrix(model: RobotModel, q: Array) -> Array:
    return in_samples(lambda x: joint_masses(model, x), q)


def joint_masses(model: RobotModel, q: Float[Array, "nv samples"]) -> Float[Array, "nv nv samples"]:
    """Kernel of `mass_matrix`: the samples on the last axis, the dtype that of `q`."""
    poses, above = placements(model, q), ancestors(model.joints)
    moments = pseudo_inertia(jnp.asarray(model.inertia, q.dtype))[..., None]
    carried = add_up(above, matmul(matmul(poses, moments), jnp.swapaxes(poses, 1, 2)))
    linear, angular = axis_twists(model, poses[:, :3, :3], poses[:, :3, 3])
    second, h, m = carried[:, :3, :3], carried[:, :3, 3], carried[:, 3, 3, None]
    trace = second[:, 0, 0] + second[:, 1, 1] + second[:, 2, 2]
    force = m * linear + cross(angular, h)
    torque = cross(h, linear) + trace[:, None] * angular - rotate(second, angular)
    rows, columns = jnp.concatenate([linear, angular], 1), jnp.concatenate([force, torque], 1)
    upper = jnp.sum(rows[:, None] * columns[None], axis=2) * jnp.asarray(above, q.dtype)[..., None]
    diagonal = jnp.eye(len(above), dtype=q.dtype)[..., None]
    full = upper + jnp.swapaxes(upper * (1.0 - diagonal), 0, 1)
    return gather(model, jnp.swapaxes(gather(model, full), 0, 1))


def forward_dynamics(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nv"],
    v: Float[ArrayLike, "*batch nv"],
    tau: Float[ArrayLike, "*batch nv"],
) -> Float[Array, "*batch nv"]:
    """Accelerations (rad/s^2, m/s^2) that the torques `tau` (N m, N) give the rigid body; inverse of inverse_dynamics.

    Cholesky solve with the mass matrix, in float64. Where a joint moves no mass that matrix is singular and the answer
    is NaN or huge: give the link an inertia (or the joint a rotor). Raises `InputError` where the shapes do not fit.
    """
    with jax.enable_x64(True):
        return _forward_dynamics(model, *states(model, q=q, v=v, tau=tau))


@jax.jit
def _forward_dynamics(model: RobotModel, q: Array, v: Array, tau: Array) -> Array:
    bias = _inverse_dynamics(model, q, v, jnp.zeros_like(v))
    factor = jnp.linalg.cholesky(_mass_matrix(model, q))
    return jax.scipy.linalg.cho_solve((factor, True), (tau - bias)[..., None])[..., 0]
