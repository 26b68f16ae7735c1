"""Where the joints and frames are and how they move.

The kernel is `motion`. Only rotations multiply along the tree: one `lax.scan` over its levels, all joints of a level
side by side and padded to the widest, so that compile time grows with neither joints nor samples. Everything else adds
up along the tree: one product with its matrix of 0 and 1. Inside the kernels the sample is the last axis; the public
functions take any leading batch axes and transpose once at the border. Frames: positions, velocities and accelerations
are those of the joint frame's origin, expressed in the world.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Shaped

from .errors import InputError
from .model import Joint, RobotModel
from .spatial import cross, matmul, rotate

__all__ = [
    "Motion",
    "add_up",
    "ancestors",
    "axis_twists",
    "check_shapes",
    "forward_kinematics",
    "frame_jacobian",
    "frame_placement",
    "gather",
    "in_samples",
    "motion",
    "placements",
    "revolute",
    "states",
    "world_axes",
]


_BLOCK = 32  # samples computed together on a CPU, so that what lies between stays in its cache
_BLOCK_ACCELERATOR = 65536


class Motion(NamedTuple):
    """Motion of every joint frame in the world, the samples on the last axis."""

    R: Float[Array, "nj 3 3 samples"]  # world_R_joint
    p: Float[Array, "nj 3 samples"]  # origin, m
    w: Float[Array, "nj 3 samples"]  # angular velocity, rad/s
    al: Float[Array, "nj 3 samples"]  # angular acceleration, rad/s^2
    ac: Float[Array, "nj 3 samples"]  # classical acceleration of the origin minus gravity, m/s^2


class _Levels(NamedTuple):
    """The tree by depth: `order[d, k]` is the k-th joint of depth d (padded by joint 0), `parent[d, k]` the place of
    its parent in level d - 1 (None: every joint hangs on its neighbour one level up, as in a chain), `place[i]` is
    where joint i stands in the flattened levels."""

    order: np.ndarray
    parent: np.ndarray | None
    place: np.ndarray


@lru_cache(maxsize=256)
def _levels(joints: tuple[Joint, ...]) -> _Levels:
    depth = np.zeros(len(joints), int)
    for i, joint in enumerate(joints):
        depth[i] = 0 if joint.parent < 0 else depth[joint.parent] + 1
    members = [np.flatnonzero(depth == d) for d in range(depth.max(initial=-1) + 1)]
    width = max((len(m) for m in members), default=0)
    order, parent = np.zeros((2, len(members), width), int)
    slot = np.zeros(len(joints), int)
    for d, level in enumerate(members):
        order[d, : len(level)] = level
        slot[level] = np.arange(len(level))
        parent[d, : len(level)] = [slot[joints[i].parent] if d else k for k, i in enumerate(level)]
    return _Levels(order, None if width == 1 else parent, depth * width + slot)


@lru_cache(maxsize=256)
def ancestors(joints: tuple[Joint, ...]) -> np.ndarray:
    """Matrix (nj, nj) of 0 and 1: entry (j, i) is 1 where joint j moves link i, that is, j is i or above it."""
    above = np.eye(len(joints))
    for i, joint in enumerate(joints):
        if joint.parent >= 0:
            above[:, i] += above[:, joint.parent]
    above.setflags(write=False)
    return above


def revolute(model: RobotModel) -> Bool[np.ndarray, " nj"]:
    """Which joints turn; the others slide."""
    _refuse_general(model)
    return model.dofs.turns


def _refuse_general(model: RobotModel) -> None:
    for joint in model.joints:
        if joint.kind not in ("revolute", "prismatic"):
            raise InputError(
                f"robot '{model.name}': joint '{joint.name}' is {joint.kind}; kinematics and dynamics take revolute "
                "and prismatic joints only so far: give the joint a posture, or the root as fixed"
            )


def _local(model: RobotModel, q: Float[Array, "nv samples"]) -> tuple[Array, Array]:
    """Rotation (nj 3 3 samples) and displacement (nj 3 samples) of each joint frame in its parent's (Rodrigues)."""
    dtype, turns = q.dtype, revolute(model)[:, None]
    placement, axis = jnp.asarray(model.placement, dtype), jnp.asarray(model.axis, dtype)[..., None]
    position = _to_joints(model, q) + jnp.asarray(model.offset, dtype)[:, None]
    angle = jnp.where(turns, position, 0.0)[:, None, None]
    r0, p0 = placement[:, :3, :3, None], placement[:, :3, 3, None]
    r0k = _times_skew(r0, axis)
    rotation = r0 + r0k * jnp.sin(angle) + _times_skew(r0k, axis) * (1.0 - jnp.cos(angle))
    if turns.all():
        return rotation, jnp.broadcast_to(p0, rotation[:, 0].shape)
    return rotation, p0 + rotate(r0, axis) * jnp.where(turns, 0.0, position)[:, None]


def _times_skew(matrix: Float[Array, "nj 3 3 1"], axis: Float[Array, "nj 3 1"]) -> Float[Array, "nj 3 3 1"]:
    """Product `matrix @ skew(axis)`: each row crossed with the axis."""
    return cross(matrix, axis[:, None])


def _coordinates(model: RobotModel) -> np.ndarray:
    return np.array([joint.coordinate for joint in model.joints], int)


def _to_joints(model: RobotModel, x: Float[Array, "nv samples"]) -> Float[Array, "nj samples"]:
    return jnp.asarray(model.ratio, x.dtype)[:, None] * x[_coordinates(model)]


def gather(model: RobotModel, x: Float[Array, "nj *rest"]) -> Float[Array, "nv *rest"]:
    """Sum of a joint quantity over the joints that share each coordinate, each times its ratio (mimic joints)."""
    coordinates = _coordinates(model)
    scaled = jnp.asarray(model.ratio, x.dtype).reshape(-1, *[1] * (x.ndim - 1)) * x
    if len(coordinates) == model.nv:
        return scaled[np.argsort(coordinates)]
    return add_up(np.arange(model.nv)[:, None] == coordinates, scaled)


def add_up(which: Shaped[np.ndarray, "k n"], x: Float[Array, "n *rest"]) -> Float[Array, "k *rest"]:
    """Sums of the entries of `x` that each row of the matrix of 0 and 1 picks."""
    # highest precision: an accelerator's default would round the operands
    return jnp.tensordot(jnp.asarray(which, x.dtype), x, axes=1, precision=jax.lax.Precision.HIGHEST)


def _tree(model: RobotModel, q: Float[Array, "nv samples"]) -> tuple[Array, Array]:
    """Rotation of each joint in the world and, in the world, the way from its parent's origin to its own."""
    rotation, shift = _local(model, q)
    levels = _levels(model.joints)
    parent = None if levels.parent is None else jnp.asarray(levels.parent)

    def level(R: Array, step: tuple[Array | None, Array]) -> tuple[Array, Array]:
        above = R if step[0] is None else R[step[0]]
        R = matmul(above, step[1])
        return R, R

    world = jnp.broadcast_to(jnp.eye(3, dtype=q.dtype)[..., None], (levels.order.shape[1], *rotation.shape[1:]))
    stacked = jax.lax.scan(level, world, (parent, rotation[levels.order]))[1]
    R = stacked.reshape(-1, *rotation.shape[1:])[levels.place]
    parents = np.array([joint.parent for joint in model.joints], int)
    return R, rotate(jnp.concatenate([world[:1], R])[parents + 1], shift)


def placements(model: RobotModel, q: Float[Array, "nv samples"]) -> Float[Array, "nj 4 4 samples"]:
    """Kernel of `forward_kinematics`: poses `world_T_joint`, the samples on the last axis, the dtype that of `q`."""
    R, d = _tree(model, q)
    p = add_up(ancestors(model.joints).T, d)
    bottom = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0], q.dtype)[:, None], (len(R), 1, 4, q.shape[-1]))
    return jnp.concatenate([jnp.concatenate([R, p[:, :, None]], axis=2), bottom], axis=1)


def motion(
    model: RobotModel, q: Float[Array, "nv samples"], v: Float[Array, "nv samples"], a: Float[Array, "nv samples"]
) -> Motion:
    r"""Motion of every joint frame in the world, for coordinates with the samples on the last axis.

    From parent to child, with s the joint's axis in the world, d the way from the parent's origin, r = 1 for a revolute
    and 0 for a prismatic joint (Featherstone 2008, chapter 5, in classical accelerations):
    $$w = w_p + r s \dot q, \quad \alpha = \alpha_p + r (s \ddot q + w_p \times s \dot q)$$
    $$c = c_p + \alpha_p \times d + w_p \times (w_p \times d) + (1 - r)(s \ddot q + 2 w_p \times s \dot q)$$
    starting from rest with c = -gravity. Units: rad or m, and their rates in seconds. The dtype is that of `q`.
    """
    R, d = _tree(model, q)
    above, s = ancestors(model.joints).T, world_axes(model, R)
    turns = jnp.asarray(revolute(model), q.dtype)[:, None, None]
    sv, sa = (s * _to_joints(model, x)[:, None] for x in (v, a))
    w, p = add_up(above, turns * sv), add_up(above, d)
    w_p = w - turns * sv
    coriolis = cross(w_p, sv)
    al_own = turns * (sa + coriolis)
    al = add_up(above, al_own)
    turning = cross(al - al_own, d) + cross(w_p, cross(w_p, d))
    ac = add_up(above, turning + (1.0 - turns) * (sa + 2.0 * coriolis))
    return Motion(R, p, w, al, ac - jnp.asarray(model.gravity, q.dtype)[:, None])


def world_axes(model: RobotModel, R: Float[Array, "nj 3 3 samples"]) -> Float[Array, "nj 3 samples"]:
    """Unit axis of every joint in the world, from the joints' rotations."""
    return rotate(R, jnp.asarray(model.axis, R.dtype)[..., None])


def states(model: RobotModel, **arrays: Float[ArrayLike, "..."]) -> list[Float[Array, "*batch nv"]]:
    """The named arrays (`q=`, `v=`, ...) in float64; to be called where 64-bit JAX is on. Raises as `check_shapes`."""
    check_shapes(model, **arrays)
    return [jnp.asarray(array, jnp.float64) for array in arrays.values()]


def check_shapes(model: RobotModel, **arrays: Float[ArrayLike, "..."]) -> None:
    """Raise `InputError` naming the array (`q=`, `v=`, ...) whose shape does not fit the model or the first array."""
    _refuse_general(model)
    first = next(iter(arrays))
    for name, array in arrays.items():
        shape, expected = np.shape(array), np.shape(arrays[first])
        if shape[-1:] != (model.nv,):
            joints = ", ".join(model.joint_names)
            raise InputError(f"{name} has shape {shape}; its last axis must hold the {model.nv} joints {joints}")
        if shape != expected:
            raise InputError(f"{name} has shape {shape}, but {first} has {expected}; give both alike")


def in_samples(kernel: Callable[..., Array], *arrays: Float[Array, "*batch nv"]) -> Float[Array, "..."]:
    """Apply a kernel that holds the samples on its last axis to arrays with any leading batch axes."""
    batch, flat = arrays[0].shape[:-1], [x.reshape(-1, x.shape[-1]) for x in arrays]
    samples, block = len(flat[0]), _BLOCK if jax.default_backend() == "cpu" else _BLOCK_ACCELERATOR

    def apply(rows: Sequence[Array]) -> Array:
        return jnp.moveaxis(kernel(*(x.T for x in rows)), -1, 0)

    if samples <= 2 * block:
        answer = apply(flat)
    else:
        blocks = -(-samples // block)
        padded = [jnp.pad(x, ((0, blocks * block - samples), (0, 0))).reshape(blocks, block, -1) for x in flat]
        answer = jax.lax.map(apply, padded)
        answer = answer.reshape(blocks * block, *answer.shape[2:])[:samples]
    return answer.reshape(*batch, *answer.shape[1:])


def forward_kinematics(model: RobotModel, q: Float[ArrayLike, "*batch nv"]) -> Float[Array, "*batch nj 4 4"]:
    """Poses `world_T_joint` of all tree joints (m; q in rad, m for a prismatic joint), in float64.

    Raises `InputError` where the shape of `q` does not fit the model.
    """
    with jax.enable_x64(True):
        return _forward_kinematics(model, *states(model, q=q))


@jax.jit
def _forward_kinematics(model: RobotModel, q: Array) -> Array:
    return in_samples(lambda x: placements(model, x), q)


def frame_placement(model: RobotModel, q: Float[ArrayLike, "*batch nv"], name: str) -> Float[Array, "*batch 4 4"]:
    """Pose `world_T_frame` of the frame called `name` (a link or a joint of the model), m and rad, in float64.

    Raises `InputError` where there is no such frame or the shape of `q` does not fit the model.
    """
    index = model.frame_index(name)
    with jax.enable_x64(True):
        return _frame_placement(model, *states(model, q=q), index, model.frames[index].parent)


@jax.jit
def _frame_placement(model: RobotModel, q: Array, index: Array, parent: Array) -> Array:
    return in_samples(lambda x: _frame_pose(placements(model, x), model, index, parent), q)


def _frame_pose(poses: Float[Array, "nj 4 4 samples"], model: RobotModel, index: Array, parent: Array) -> Array:
    """Pose (4 4 samples); a parent of -1, the world, stands before the joints."""
    world = jnp.broadcast_to(jnp.eye(4, dtype=poses.dtype)[..., None], (1, *poses.shape[1:]))
    carrier = jnp.concatenate([world, poses])[parent + 1]
    return matmul(carrier, jnp.asarray(model.frame_placement, poses.dtype)[index][..., None])


def frame_jacobian(model: RobotModel, q: Float[ArrayLike, "*batch nv"], name: str) -> Float[Array, "*batch 6 nv"]:
    """Jacobian of the frame called `name`: its velocity `[linear, angular]` at its origin, in world axes, for each v.

    Local-world-aligned in Pinocchio's words; m or 1 per rad or m, in float64. Raises `InputError` where there is no
    such frame or the shape of `q` does not fit the model.
    """
    index = model.frame_index(name)
    with jax.enable_x64(True):
        return _frame_jacobian(model, *states(model, q=q), index, model.frames[index].parent)


@jax.jit
def _frame_jacobian(model: RobotModel, q: Array, index: Array, parent: Array) -> Array:
    return in_samples(lambda x: _jacobian(model, x, index, parent), q)


def _jacobian(model: RobotModel, q: Float[Array, "nv samples"], index: Array, parent: Array) -> Array:
    poses = placements(model, q)
    origin = _frame_pose(poses, model, index, parent)[:3, 3]
    linear, angular = axis_twists(model, poses[:, :3, :3], poses[:, :3, 3] - origin)
    moved = jnp.asarray(np.pad(ancestors(model.joints), ((0, 0), (1, 0))), q.dtype)[:, parent + 1]
    columns = jnp.concatenate([linear, angular], axis=1) * moved[:, None, None]
    return jnp.moveaxis(gather(model, columns), 0, 1)


def axis_twists(
    model: RobotModel, R: Float[Array, "nj 3 3 samples"], p: Float[Array, "nj 3 samples"]
) -> tuple[Float[Array, "nj 3 samples"], Float[Array, "nj 3 samples"]]:
    """Linear and angular velocity that a unit rate of each joint gives the point from which `p` is measured."""
    s = world_axes(model, R)
    turns = revolute(model)[:, None, None]
    return jnp.where(turns, cross(p, s), s), jnp.where(turns, s, 0.0)
