r"""From a base frame to a tool frame along one chain of joints, each with a small twist, and the exact Jacobian.

The chain is $F_b^{-1} \prod_j P_j E(\xi_j) \exp(S_j q_j)\, F_t$: P the placement of the joint in its parent, E a
translation followed by a rotation in the joint frame before the joint moves, F the two frames on their links. Every
kinematic error is such a twist, as a function of the posture (`effects.kinematic`). Samples stand on the last axis.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from ..errors import InputError
from . import lie
from .model import Leaf, RobotModel, dofs
from .spatial import cross, matmul, rotate, sine_cosine

__all__ = ["Chain", "ChainPose", "chain_between", "chain_pose", "joint_axis", "joint_response"]


class Chain(eqx.Module):
    """The joints between two frames, from base to tool (`n` of them), as arrays that a compiled program takes."""

    first: Float[Leaf, "4 4"]  # from the base frame to the frame of the link that carries it
    last: Float[Leaf, "4 4"]  # pose of the tool frame on its link
    placement: Float[Leaf, "n 4 4"]
    axis: Float[Leaf, "n 3"]
    turns: Float[Leaf, " n"]  # 1 for a revolute, 0 for a prismatic joint
    ratio: Float[Leaf, " n"]
    offset: Float[Leaf, " n"]
    column: Int[Leaf, " n"]  # of q
    joints: tuple[int, ...] = eqx.field(static=True)  # tree indices


class ChainPose(NamedTuple):
    """Pose of the tool in the base frame, and for each joint the axes and the point about which its twist acts."""

    R: Float[Array, "3 3 samples"]
    p: Float[Array, "3 samples"]
    before: Float[Array, "n 3 3 samples"]  # axes of the joint frame, in which the twist translates
    turned: Float[Array, "n 3 3 samples"]  # the same times the left Jacobian of the twist's rotation
    origin: Float[Array, "n 3 samples"]


def chain_between(model: RobotModel, base: str, tool: str) -> Chain:
    """The joints from the frame `base` to the frame `tool`; raises `InputError` where `base` is not below `tool`."""
    start, end = model.frame_index(base), model.frame_index(tool)
    stop, body = model.frames[start].parent, model.frames[end].parent
    path: list[int] = []
    while body not in (-1, stop):
        path.insert(0, body)
        body = model.joints[body].parent
    if body != stop:
        carrier = model.joints[stop].name
        raise InputError(f"base_frame '{base}' moves with joint '{carrier}', which does not carry tool_frame '{tool}'")
    if not path:
        raise InputError(f"no joint moves tool_frame '{tool}' against base_frame '{base}'")
    pick = np.array(path)
    return Chain(
        first=np.linalg.inv(model.frame_placement[start]),
        last=np.asarray(model.frame_placement[end]),
        placement=np.asarray(model.placement)[pick],
        axis=np.stack([joint_axis(model, j) for j in path]),
        turns=np.array([float(model.joints[j].kind == "revolute") for j in path]),
        ratio=np.asarray(model.ratio)[pick],
        offset=np.asarray(model.offset)[pick],
        column=np.array([dofs(model.joints).positions[j].start for j in path]),
        joints=tuple(path),
    )


def joint_axis(model: RobotModel, joint: int) -> Float[Any, "3"]:
    """Unit axis of a joint of one degree of freedom; raises `InputError` for the others."""
    kind = model.joints[joint].kind
    if kind not in ("revolute", "prismatic"):
        name = model.joints[joint].name
        raise InputError(f"joint '{name}' is {kind}; calibration takes revolute and prismatic joints")
    axis = model.axis[dofs(model.joints).first[joint]]
    return axis if isinstance(axis, Tracer) else np.asarray(axis)


def chain_pose(chain: Chain, q: Float[Array, "nq samples"], twists: Float[Array, "n 6 #samples"]) -> ChainPose:
    """Pose of the tool frame in the base frame (m), with the twist `[linear, angular]` of every joint (m, rad).

    Twists that no posture changes may come for one sample.
    """

    def step(carry: tuple[Array, Array], joint: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
        R, p = carry
        placement, moved, bend, along, across, twice, known = joint
        p = p + rotate(R, placement[:3, 3, None])
        before = matmul(R, placement[:3, :3, None])
        origin = p + rotate(before, moved[:, 3])
        turned = matmul(before, bend)
        sine, versine, slide = known
        turn = jnp.eye(3)[..., None] + sine * across[..., None] + versine * twice[..., None]
        R = matmul(before, moved[:, :3])
        return (matmul(R, turn), origin + rotate(R, slide * along[:, None])), (before, turned, origin)

    samples = q.shape[1]
    position = chain.ratio[:, None] * q[chain.column] + chain.offset[:, None]
    turns = jnp.asarray(chain.turns)[:, None] > 0.0
    both = sine_cosine(jnp.where(turns, position, 0.0))
    known = jnp.stack([both[:, 0], 1.0 - both[:, 1], jnp.where(turns, 0.0, position)], axis=1)
    first, end, axis = jnp.asarray(chain.first), jnp.asarray(chain.last), jnp.asarray(chain.axis)
    start = jnp.broadcast_to(first[:3, :3, None], (3, 3, samples)), jnp.broadcast_to(first[:3, 3:], (3, samples))
    across = jax.vmap(lie.skew)(axis)
    moved, bend = jax.vmap(last(_moved))(twists)
    joints = (jnp.asarray(chain.placement), moved, bend, axis, across, across @ across, known)
    (R, p), (before, turned, origin) = jax.lax.scan(step, start, joints)
    return ChainPose(matmul(R, end[:3, :3, None]), p + rotate(R, end[:3, 3, None]), before, turned, origin)


def _moved(twist: Float[Array, "6"]) -> tuple[Float[Array, "3 4"], Float[Array, "3 3"]]:
    """E, rotation and translation side by side, and the left Jacobian of its rotation."""
    rotation, bend = lie.exp_so3(twist[3:]), lie.left_jacobian(twist[3:])
    return jnp.concatenate([rotation, twist[:3, None]], axis=1), bend


def last(function):
    """Map a function of one element over the samples on the last axis."""
    return jax.vmap(function, in_axes=-1, out_axes=-1)


def joint_response(pose: ChainPose, by_motion: Float[Array, "rows 6 samples"]) -> Float[Array, "n rows 6 samples"]:
    r"""Derivatives of rows by the twist of every joint, from those by the tool's motion `[linear, angular]`.

    The motion is in base axes at the tool's origin: with L and W the two halves of a row,
    $$\delta r = L' R_P u_t + (W + (p - o) \times L)' R_P J_l(\xi_r) u_r$$
    """
    linear, angular = by_motion[:, :3], by_motion[:, 3:]
    arm = pose.p - pose.origin
    of_turn = matmul(angular + cross(arm[:, None], linear), pose.turned)
    return jnp.concatenate([matmul(linear, pose.before), of_turn], axis=2)
