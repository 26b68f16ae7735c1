r"""What gravity does to each joint in a posture: the torque about its axis and the moments across it."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..compiled.batching import traced
from ..rigid.chain import joint_axis
from ..rigid.kinematics import ancestors, forward_kinematics, poses_on_host
from ..rigid.model import RobotModel

__all__ = ["gravity_moments", "without_far_masses"]

_FAR = 10.0  # times the robot's reach: a centre of mass beyond it is a slip of the file


def without_far_masses(model: RobotModel) -> tuple[RobotModel, tuple[str, ...]]:
    """The model without the masses whose centres lie absurdly far out, and a note on each that was left out."""
    inertia = np.array(model.inertia)
    reach = max(float(np.linalg.norm(np.asarray(model.placement)[:, :3, 3], axis=1).sum()), 0.1)
    mass = inertia[:, 0]
    distance = np.linalg.norm(inertia[:, 1:4], axis=1) / np.where(mass > 0.0, mass, np.inf)
    notes = tuple(
        f"link {model.link_names[k]}: its centre of mass is {distance[k]:.3g} m from its joint, beyond"
        f" {_FAR:g} times the robot's reach; its weight is left out of the gravity load"
        for k in np.flatnonzero(distance > _FAR * reach)
    )
    inertia[distance > _FAR * reach] = 0.0
    return eqx.tree_at(lambda m: m.inertia, model, inertia), notes


def gravity_moments(
    model: RobotModel, q: Float[Any, "samples nv"]
) -> tuple[Float[Any, "samples nj"], Float[Any, "samples nj 3"]]:
    r"""Force or torque of gravity along each joint's motion (N or N m), and its moment in the joint frame (N m).

    $M_j = \sum_{i \text{ above } j} (c_i - o_j) \times m_i g$ over the links that joint j moves.
    """
    lib: Any = jnp if traced(model, q) else np
    poses: Any = poses_on_host(model, np.asarray(q, float)) if lib is np else forward_kinematics(model, q)
    R, o = poses[..., :3, :3], poses[..., :3, 3]
    inertia, gravity = lib.asarray(model.inertia), lib.asarray(model.gravity)
    mass, first = inertia[:, 0], inertia[:, 1:4]
    weighted = lib.einsum("nkij,kj->nki", R, first) + mass[:, None] * o  # m c in the world
    above = lib.asarray(ancestors(model.joints))
    force = lib.outer(above @ mass, gravity)
    about = lib.einsum("jk,nki->nji", above, weighted) - (above @ mass)[:, None] * o
    moment = lib.einsum("njik,nji->njk", R, lib.cross(about, gravity))
    axes = lib.stack([joint_axis(model, j) for j in range(len(model.joints))])
    along = lib.einsum("njik,ji->njk", R, force)
    revolute = np.array([joint.kind == "revolute" for joint in model.joints])
    return lib.einsum("njk,jk->nj", lib.where(revolute[:, None], moment, along), axes), moment
