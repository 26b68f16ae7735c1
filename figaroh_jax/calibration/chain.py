r"""From a base frame to a tool frame along one chain of joints, each with a small twist, and the exact Jacobian.

The chain is $F_b^{-1} \prod_j P_j E(\xi_j) \exp(S_j q_j)\, F_t$: P the placement of the joint in its parent, E a
translation followed by a rotation in the joint frame before the joint moves, F the two frames on their links. Every
kinematic error is such a twist, as a function of the posture (`kinematic_effects`). Samples stand on the last axis.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .. import lie
from ..errors import InputError
from ..model import Leaf, RobotModel, dofs
from ..spatial import cross, matmul, rotate

__all__ = ["Chain", "ChainPose", "chain_between", "chain_pose", "chain_twists", "column_motion", "joint_axis"]


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


def joint_axis(model: RobotModel, joint: int) -> Float[np.ndarray, "3"]:
    """Unit axis of a joint of one degree of freedom; raises `InputError` for the others."""
    kind = model.joints[joint].kind
    if kind not in ("revolute", "prismatic"):
        name = model.joints[joint].name
        raise InputError(f"joint '{name}' is {kind}; calibration takes revolute and prismatic joints")
    return np.asarray(model.axis)[dofs(model.joints).first[joint]]


def chain_pose(chain: Chain, q: Float[Array, "nq samples"], twists: Float[Array, "n 6 samples"]) -> ChainPose:
    """Pose of the tool frame in the base frame (m), with the twist `[linear, angular]` of every joint (m, rad)."""

    def step(carry: tuple[Array, Array], joint: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
        R, p = carry
        placement, axis, turns, position, twist = joint
        p = p + rotate(R, placement[:3, 3, None])
        before = matmul(R, placement[:3, :3, None])
        origin = p + rotate(before, twist[:3])
        turned = matmul(before, last(lie.left_jacobian)(twist[3:]))
        R = matmul(before, last(lie.exp_so3)(twist[3:]))
        slide = jnp.where(turns > 0.0, 0.0, position) * axis[:, None]
        turn = last(lie.exp_so3)(jnp.where(turns > 0.0, position, 0.0) * axis[:, None])
        return (matmul(R, turn), origin + rotate(R, slide)), (before, turned, origin)

    samples = q.shape[1]
    position = chain.ratio[:, None] * q[chain.column] + chain.offset[:, None]
    first, end = jnp.asarray(chain.first), jnp.asarray(chain.last)
    start = jnp.broadcast_to(first[:3, :3, None], (3, 3, samples)), jnp.broadcast_to(first[:3, 3:], (3, samples))
    joints = (jnp.asarray(chain.placement), jnp.asarray(chain.axis), jnp.asarray(chain.turns), position, twists)
    (R, p), (before, turned, origin) = jax.lax.scan(step, start, joints)
    return ChainPose(matmul(R, end[:3, :3, None]), p + rotate(R, end[:3, 3, None]), before, turned, origin)


def last(function):
    """Map a function of one element over the samples on the last axis."""
    return jax.vmap(function, in_axes=-1, out_axes=-1)


def chain_twists(
    coefficients: Float[Array, " columns"],
    column: Int[Array, " pieces"],
    at: Int[Array, " pieces"],
    fields: Float[Array, "pieces 6 samples"],
    n: int,
) -> Float[Array, "n 6 samples"]:
    """Twist of each of the `n` joints: every piece acts at one of them, times the coefficient of its column."""
    scaled = coefficients[column][:, None, None] * fields
    return jnp.zeros((n, *fields.shape[1:]), fields.dtype).at[at].add(scaled)


def column_motion(
    pose: ChainPose, at: Int[Array, " pieces"], fields: Float[Array, "pieces 6 samples"]
) -> Float[Array, "6 pieces samples"]:
    r"""Motion of the tool, `[linear, angular]` in base axes at its origin, for a unit of each piece's coefficient.

    $$\delta p = R_P u_t + (R_P J_l(\xi_r) u_r) \times (p - o), \quad \delta\omega = R_P J_l(\xi_r) u_r$$
    """
    angular = rotate(pose.turned[at], fields[:, 3:])
    linear = rotate(pose.before[at], fields[:, :3]) + cross(angular, pose.p - pose.origin[at])
    return jnp.moveaxis(jnp.concatenate([linear, angular], axis=1), 0, 1)
