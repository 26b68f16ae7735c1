"""Torques of the rigid body: inverse and forward dynamics and the mass matrix.

Every link's wrench is taken about the origin of the *world*, so that what a joint carries is the plain sum over the
links that it moves: one product with the tree's matrix of 0 and 1, without a second pass along the tree. Inside the
kernels the sample is the last axis; the public functions take any leading batch axes.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .kinematics import Motion, ancestors, gather, in_samples, motion, states, world_axes
from .model import RobotModel
from .spatial import cross, rotate, rotate_back

__all__ = ["inverse_dynamics", "joint_torques", "link_wrenches"]


def inverse_dynamics(
    model: RobotModel, q: Float[ArrayLike, "*batch nv"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
) -> Float[Array, "*batch nv"]:
    r"""Torques (N m; N for a prismatic joint) that give the rigid body the accelerations `a`.

    Newton-Euler in the world frame: $\tau_j = s_j \cdot (n_j - p_j \times f_j)$ with f and n the force and the torque
    about the world's origin of all links that joint j moves. q, v, a in rad, rad/s, rad/s^2 (m for prismatic joints);
    computed in float64. Torques of joints that share a coordinate add up, each times its ratio. Raises `InputError`
    where the shapes do not fit the model.
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
    force, torque = link_wrenches(model, state)
    above = jnp.asarray(ancestors(model.joints), q.dtype)
    carried, moment = (_sum_subtrees(above, x) for x in (force, torque))
    s = world_axes(model, state.R)
    turn = jnp.sum(s * (moment - cross(state.p, carried)), axis=1)
    slide = jnp.sum(s * carried, axis=1)
    revolute = np.array([joint.kind == "revolute" for joint in model.joints], bool)
    return gather(model, jnp.where(revolute[:, None], turn, slide))


def _sum_subtrees(above: Float[Array, "nj nj"], x: Float[Array, "nj k samples"]) -> Float[Array, "nj k samples"]:
    # highest precision: an accelerator's default would round the operands
    return jnp.tensordot(above, x, axes=1, precision=jax.lax.Precision.HIGHEST)


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
