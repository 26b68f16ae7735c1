"""Where the joints and frames are and how they move.

The kernel is `motion`: one `lax.scan` over the levels of the tree, all joints of a level side by side and padded to the
widest level, so that its compile time grows with neither the number of joints nor that of samples. Inside the kernels
the sample is the last axis; the public functions take any leading batch axes and transpose once at the border. Frames:
positions, velocities and accelerations are those of the joint frame's origin, expressed in the world.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .errors import InputError
from .model import Joint, RobotModel
from .spatial import cross, matmul, rotate

__all__ = [
    "Motion",
    "ancestors",
    "forward_kinematics",
    "gather",
    "in_samples",
    "motion",
    "states",
    "world_axes",
]


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


def _revolute(model: RobotModel) -> np.ndarray:
    return np.array([joint.kind == "revolute" for joint in model.joints], bool)


def _local(model: RobotModel, q: Float[Array, "nv samples"]) -> tuple[Array, Array]:
    """Rotation (nj 3 3 samples) and displacement (nj 3 samples) of each joint frame in its parent's (Rodrigues)."""
    dtype, revolute = q.dtype, _revolute(model)
    placement, axis = jnp.asarray(model.placement, dtype), jnp.asarray(model.axis, dtype)[..., None]
    angle = _to_joints(model, q, jnp.asarray(model.ratio, dtype)) + jnp.asarray(model.offset, dtype)[:, None]
    turn, slide = jnp.where(revolute[:, None], angle, 0.0), jnp.where(revolute[:, None], 0.0, angle)
    r0, p0 = placement[:, :3, :3, None], placement[:, :3, 3, None]
    r0k = jnp.stack([cross(axis, row) for row in jnp.moveaxis(-r0, 1, 0)], axis=1)
    r0kk = jnp.stack([cross(axis, row) for row in jnp.moveaxis(-r0k, 1, 0)], axis=1)
    sin, versine = jnp.sin(turn)[:, None, None], (1.0 - jnp.cos(turn))[:, None, None]
    rotation = r0 + r0k * sin + r0kk * versine
    if revolute.all():
        return rotation, jnp.broadcast_to(p0, rotation[:, 0].shape)
    return rotation, p0 + rotate(r0, axis) * slide[:, None]


def _coordinates(model: RobotModel) -> np.ndarray:
    return np.array([joint.coordinate for joint in model.joints], int)


def _to_joints(model: RobotModel, x: Float[Array, "nv samples"], ratio: Float[Array, " nj"]) -> Float[Array, "nj n"]:
    return ratio[:, None] * x[_coordinates(model)]


def gather(model: RobotModel, x: Float[Array, "nj *rest"]) -> Float[Array, "nv *rest"]:
    """Sum of a joint quantity over the joints that share each coordinate, each times its ratio (mimic joints)."""
    coordinates = _coordinates(model)
    share = jnp.asarray(np.arange(model.nv)[:, None] == coordinates, x.dtype) * jnp.asarray(model.ratio, x.dtype)
    if len(coordinates) == model.nv:
        place = np.argsort(coordinates)
        return (jnp.asarray(model.ratio, x.dtype).reshape(-1, *[1] * (x.ndim - 1)) * x)[place]
    return jnp.tensordot(share, x, axes=1, precision=jax.lax.Precision.HIGHEST)


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
    dtype = q.dtype
    levels, ratio = _levels(model.joints), jnp.asarray(model.ratio, dtype)
    rotation, shift = _local(model, q)
    revolute = jnp.asarray(_revolute(model), dtype)[:, None, None]
    axis = jnp.asarray(model.axis, dtype)
    rates = [_to_joints(model, x, ratio)[:, None] for x in (v, a)]
    steps = [x[levels.order] for x in (rotation, shift, axis[..., None], *rates, revolute)]
    parent = levels.parent
    if parent is not None:
        steps.append(jnp.asarray(parent))

    def level(state: Motion, step: list[Array]) -> tuple[Motion, Motion]:
        above = state if parent is None else Motion(*(x[step[6]] for x in state))
        below = _below(above, *step[:6])
        return below, below

    width, samples = levels.order.shape[1], q.shape[-1]
    zero = jnp.zeros((width, 3, samples), dtype)
    eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype)[..., None], (width, 3, 3, samples))
    world = Motion(eye, zero, zero, zero, zero - jnp.asarray(model.gravity, dtype)[:, None])
    stacked = jax.lax.scan(level, world, steps)[1]
    return Motion(*(x.reshape(-1, *x.shape[2:])[levels.place] for x in stacked))


def _below(above: Motion, rotation: Array, shift: Array, axis: Array, v: Array, a: Array, revolute: Array) -> Motion:
    R = matmul(above.R, rotation)
    s, d = rotate(R, axis), rotate(above.R, shift)
    sv, sa, coriolis = s * v, s * a, cross(above.w, s * v)
    return Motion(
        R=R,
        p=above.p + d,
        w=above.w + revolute * sv,
        al=above.al + revolute * (sa + coriolis),
        ac=above.ac + cross(above.al, d) + cross(above.w, cross(above.w, d)) + (1.0 - revolute) * (sa + 2.0 * coriolis),
    )


def world_axes(model: RobotModel, R: Float[Array, "nj 3 3 samples"]) -> Float[Array, "nj 3 samples"]:
    """Unit axis of every joint in the world, from the joints' rotations."""
    return rotate(R, jnp.asarray(model.axis, R.dtype)[..., None])


def states(model: RobotModel, **arrays: Float[ArrayLike, "*batch nv"]) -> list[Float[Array, "*batch nv"]]:
    """The named arrays (`q=`, `v=`, ...) in float64, once their shapes fit the model and each other.

    To be called where 64-bit JAX is on. Raises `InputError` naming the array whose shape is wrong.
    """
    shape = None
    for name, array in arrays.items():
        shape = shape or np.shape(array)
        if np.shape(array)[-1:] != (model.nv,):
            joints = ", ".join(model.joint_names)
            raise InputError(f"{name} has shape {np.shape(array)}; its last axis must hold the {model.nv} joints {joints}")
        if np.shape(array) != shape:
            raise InputError(f"{name} has shape {np.shape(array)}, but {next(iter(arrays))} has {shape}; give both alike")
    return [jnp.asarray(array, jnp.float64) for array in arrays.values()]


def in_samples(kernel: Callable[..., Array], *arrays: Float[Array, "*batch nv"]) -> Float[Array, "..."]:
    """Apply a kernel that holds the samples on its last axis to arrays with any leading batch axes."""
    batch = arrays[0].shape[:-1]
    answer = kernel(*(x.reshape(-1, x.shape[-1]).T for x in arrays))
    return jnp.moveaxis(answer, -1, 0).reshape(*batch, *answer.shape[:-1])


def forward_kinematics(model: RobotModel, q: Float[ArrayLike, "*batch nv"]) -> Float[Array, "*batch nj 4 4"]:
    """Poses `world_T_joint` of all tree joints (m; q in rad, m for a prismatic joint), in float64.

    Raises `InputError` where the shape of `q` does not fit the model.
    """
    with jax.enable_x64(True):
        return _forward_kinematics(model, *states(model, q=q))


@jax.jit
def _forward_kinematics(model: RobotModel, q: Array) -> Array:
    return in_samples(lambda x: _poses(model, x), q)


def _poses(model: RobotModel, q: Float[Array, "nv samples"]) -> Float[Array, "nj 4 4 samples"]:
    zero = jnp.zeros_like(q)
    state = motion(model, q, zero, zero)
    bottom = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0], q.dtype)[:, None], (len(model.joints), 1, 4, q.shape[-1]))
    return jnp.concatenate([jnp.concatenate([state.R, state.p[:, :, None]], axis=2), bottom], axis=1)
