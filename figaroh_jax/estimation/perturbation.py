r"""A robot with small kinematic errors as a pytree: zeros are the nominal robot, `None` is not estimated (no leaf).

`forward_kinematics(apply(model, perturbation, q), q)` for one posture; map it over postures with `jax.vmap`, and
differentiate it by whatever leaf is there. The true joint position is the measured one plus what the fields say; the
twist of a placement acts before the joint moves.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..rigid import lie
from ..rigid.model import Leaf, RobotModel

__all__ = ["Perturbation", "apply"]


class Perturbation(eqx.Module):
    """Errors of a robot of `nj` joints of one axis each and `nf` frames."""

    offset: Float[Leaf, " nj"] | None = None  # rad or m
    placement: Float[Leaf, "nj 6"] | None = None  # twist [linear, angular] in the joint frame, m and rad
    axis: Float[Leaf, "nj 3"] | None = None  # rotation vector of the axis alone, rad
    frame: Float[Leaf, "nf 6"] | None = None  # twist of each frame on its link: tools, several markers
    base: Float[Leaf, "6"] | None = None  # twist of the whole robot at the world's origin
    scale: Float[Leaf, " nj"] | None = None  # of the encoder
    eccentricity: Float[Leaf, "nj 2"] | None = None  # rad: of sin q, cos q
    gear: Float[Leaf, "nj 2"] | None = None  # rad: of sin N q, cos N q
    order: Float[Leaf, " nj"] | None = None  # N, of the gear error
    compliance: Float[Leaf, " nj"] | None = None  # rad/(N m) or m/N, of the torque of gravity or a payload
    growth: Float[Leaf, " nj"] | None = None  # relative growth of the way from the parent's joint to this one


def apply(
    model: RobotModel,
    perturbation: Perturbation,
    q: Float[Array, " nv"],
    load: Float[Array, " nj"] | None = None,
) -> RobotModel:
    """The model in the posture `q` with its errors; `load` is the torque (N m or N) that pulls at each joint."""
    p, position = perturbation, q[jnp.array([joint.coordinate for joint in model.joints])]
    shift = jnp.zeros(len(model.joints))
    if p.offset is not None:
        shift += p.offset
    if p.scale is not None:
        shift += p.scale * position
    if p.eccentricity is not None:
        shift += p.eccentricity[:, 0] * jnp.sin(position) + p.eccentricity[:, 1] * jnp.cos(position)
    if p.gear is not None:
        turns = (jnp.ones_like(position) if p.order is None else p.order) * position
        shift += p.gear[:, 0] * jnp.sin(turns) + p.gear[:, 1] * jnp.cos(turns)
    if p.compliance is not None:
        shift += p.compliance * (jnp.zeros_like(position) if load is None else load)
    axis = jnp.asarray(model.axis)
    if p.axis is not None:
        axis = jax.vmap(lambda w, a: lie.exp_so3(w) @ a)(jnp.asarray(p.axis), axis)
    placement = jnp.asarray(model.placement)
    if p.growth is not None:
        placement = placement.at[:, :3, 3].multiply(1.0 + p.growth[:, None])
    if p.placement is not None:
        placement = placement @ jax.vmap(_moved)(jnp.asarray(p.placement))
    turns = jnp.array([joint.kind == "revolute" for joint in model.joints])[:, None]
    along = shift[:, None] * axis
    own = jnp.concatenate([jnp.where(turns, 0.0, along), jnp.where(turns, along, 0.0)], axis=1)
    placement = placement @ jax.vmap(_moved)(own)
    if p.base is not None:
        root = jnp.array([joint.parent < 0 for joint in model.joints])[:, None, None]
        placement = jnp.where(root, lie.exp_se3(jnp.asarray(p.base)) @ placement, placement)
    frames = jnp.asarray(model.frame_placement)
    if p.frame is not None:
        frames = frames @ jax.vmap(lie.exp_se3)(jnp.asarray(p.frame))
    return eqx.tree_at(lambda m: (m.placement, m.axis, m.frame_placement), model, (placement, axis, frames))


def _moved(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """E: the translation, then the rotation."""
    return lie.pose(lie.exp_so3(twist[3:]), twist[:3])
