"""Where the joints and frames are and how they move.

Inside the kernels the sample is the last axis and everything is expressed in the world: a pose is its four *columns*,
origin p and axes r_x, r_y, r_z; a joint's *twist* is the velocity `[linear, angular]` that a unit rate of it gives the
body point at the world's origin. Only poses multiply along the tree, one `lax.scan` over its levels, all joints of a
level side by side; twists and what follows from them add up along the tree, one product with its matrix of 0 and 1.
The public functions take any leading batch axes.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Shaped

from ..compiled.batching import over_samples, traced
from ..compiled.precision import in_float64
from ..errors import InputError, check_real
from .model import Joint, RobotModel, dofs
from .spatial import cross, matmul, quaternion_rotation, rotate_back, sine_cosine

__all__ = [
    "Motion",
    "add_up",
    "ancestors",
    "axis_twists",
    "check_shapes",
    "forward_kinematics",
    "frame_jacobian",
    "frame_placement",
    "frame_placements",
    "frame_pose",
    "gather",
    "motion",
    "movers",
    "placements",
    "pose_columns",
    "poses_on_host",
    "states",
    "take",
]

_UNROLLED = 8  # levels: a short chain compiles to straight code as fast as to a loop, and runs faster
_FEW = 1 << 17  # poses that NumPy makes on the host in less time than a program takes to compile
_ORIGIN = np.array([1.0, 0.0, 0.0, 0.0])[:, None, None]  # picks the origin among the columns of a pose


class Motion(NamedTuple):
    """Motion of every joint frame and its link, in the world, the samples on the last axis."""

    columns: Float[Array, "nj 4 3 samples"]  # origin p (m) and axes r_x, r_y, r_z
    linear: Float[Array, "nd 3 samples"]  # twists of the degrees of freedom: velocity at the world's origin, per rate
    angular: Float[Array, "nd 3 samples"]
    w: Float[Array, "nj 3 samples"]  # angular velocity of the link, rad/s
    al: Float[Array, "nj 3 samples"]  # its angular acceleration, rad/s^2
    acceleration: Float[Array, "nj 4 3 samples"]  # of p, minus gravity (m/s^2), and of the tips of r_x, r_y, r_z


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


def movers(model: RobotModel) -> Float[np.ndarray, "nd nj"]:
    """Matrix of 0 and 1: entry (k, i) is 1 where degree of freedom k moves link i."""
    return ancestors(model.joints)[model.dofs.joint]


def take(x: Float[Array, "n *rest"], index: Int[np.ndarray, " m"]) -> Float[Array, "m *rest"]:
    """The entries of `x` with the given indices, known when tracing: no copy where these are all, in order."""
    return x if np.array_equal(index, np.arange(len(x))) else x[index]


def add_up(which: Shaped[np.ndarray, "k n"], x: Float[Array, "n *rest"]) -> Float[Array, "k *rest"]:
    """Sums of the entries of `x` that each row of the matrix of 0 and 1 picks."""
    whole = which.shape[0] == which.shape[1] and bool(np.diagonal(which).all())
    # Each entry's own part apart: XLA then writes `x` to memory in its own shape, instead of computing it again,
    # number by number, in the flattened shape of the product's operand.
    others = which - np.eye(len(which)) if whole else which
    # highest precision: an accelerator's default would round the operands
    total = jnp.tensordot(jnp.asarray(others, x.dtype), x, axes=1, precision=jax.lax.Precision.HIGHEST)
    return total + x if whole else total


def gather(model: RobotModel, x: Float[Array, "nd *rest"]) -> Float[Array, "nv *rest"]:
    """Sum of a quantity over the degrees of freedom that share each coordinate, times their ratio (mimic joints)."""
    column = model.dofs.column
    scaled = _ratio(model, x.dtype).reshape(-1, *[1] * (x.ndim - 1)) * x
    if len(column) == model.nv:
        return take(scaled, np.argsort(column))
    return add_up(np.arange(model.nv)[:, None] == column, scaled)


def _ratio(model: RobotModel, dtype: jnp.dtype) -> Float[Array, " nd"]:
    return take(jnp.asarray(model.ratio, dtype), model.dofs.joint)


def _rates(model: RobotModel, x: Float[Array, "nv samples"]) -> Float[Array, "nd 1 samples"]:
    return (_ratio(model, x.dtype)[:, None] * take(x, model.dofs.column))[:, None]


class _Numbers(NamedTuple):
    """Which number of q turns each joint about which of its axes (-1: none), and which slides it along which: joint,
    degree of freedom, place among the joint's ways, column of q. A quaternion's four columns stand by themselves."""

    turn: np.ndarray  # (nj,) column of q
    hinge: np.ndarray  # (nj,) degree of freedom
    slides: np.ndarray  # (ways, 4)
    quaternions: np.ndarray  # (joints, 5): joint, columns of q


@lru_cache(maxsize=256)
def _numbers(joints: tuple[Joint, ...]) -> _Numbers:
    positions, first = dofs(joints).positions, dofs(joints).first
    turn, hinge = np.full(len(first), -1), np.array(first, int)
    slides, quaternions = [], []
    for i, (joint, at, dof) in enumerate(zip(joints, positions, first, strict=True)):
        if joint.kind in ("revolute", "planar"):
            turn[i], hinge[i] = at.stop - 1, dof + (2 if joint.kind == "planar" else 0)
        ways = {"prismatic": 1, "planar": 2, "free": 3}.get(joint.kind, 0)
        slides += [(i, dof + k, k, at.start + k) for k in range(ways)]
        if joint.kind in ("spherical", "free"):
            quaternions.append((i, *range(at.stop - 4, at.stop)))
    return _Numbers(turn, hinge, np.array(slides, int).reshape(-1, 4), np.array(quaternions, int).reshape(-1, 5))


def _local(model: RobotModel, q: Float[Array, "nq samples"]) -> Float[Array, "nj 4 3 samples"]:
    """Columns of each joint frame in its parent's: Rodrigues' formula as one product with sine and cosine."""
    numbers, dtype, joints = _numbers(model.joints), q.dtype, len(model.joints)
    placement, axis = jnp.asarray(model.placement, dtype), jnp.asarray(model.axis, dtype)
    ratio, offset = jnp.asarray(model.ratio, dtype)[:, None], jnp.asarray(model.offset, dtype)[:, None]
    turns = numbers.turn >= 0
    angle = ratio * take(q, numbers.turn) + offset
    known = sine_cosine(angle if turns.all() else jnp.where(turns[:, None], angle, 0.0))
    r0, a = placement[:, :3, :3], take(axis, numbers.hinge)[:, None]
    across = jnp.cross(r0, a)  # r0 [a]
    twice = jnp.cross(across, a)
    weights = jnp.pad(jnp.stack([across, -twice], -1), ((0, 0), (0, 0), (1, 0), (0, 0)))
    if len(numbers.slides):
        joint, dof, place, column = numbers.slides.T
        ways = jnp.zeros((joints, 1 + place.max(), q.shape[1]), dtype)
        ways = ways.at[joint, place].set(ratio[joint] * q[column] + offset[joint])
        along = jnp.zeros((joints, 3, 4, ways.shape[1]), dtype)
        along = along.at[joint, :, 0, place].set(jnp.sum(r0[joint] * axis[dof][:, None], -1))
        known, weights = jnp.concatenate([known, ways], 1), jnp.concatenate([weights, along], -1)
    weights = jnp.swapaxes(weights, 1, 2).reshape(joints, 12, -1)
    still = jnp.concatenate([placement[:, :3, 3:], r0 + twice], 2)
    product = jnp.einsum("jck,jks->jcs", weights, known, precision=jax.lax.Precision.HIGHEST)
    columns = product.reshape(joints, 4, 3, -1) + jnp.swapaxes(still, 1, 2)[..., None]
    return _turned_by_quaternions(numbers.quaternions, columns, q) if len(numbers.quaternions) else columns


def _turned_by_quaternions(which: np.ndarray, columns: Array, q: Array) -> Array:
    joint, rotation = which[:, 0], quaternion_rotation(q[which[:, 1:]])
    axes = columns[joint, 1:]
    turned = (
        sum(rotation[:, i, :, None] * axes[:, None, i] for i in range(1, 3)) + rotation[:, 0, :, None] * axes[:, :1]
    )
    return columns.at[joint, 1:].set(turned)


def pose_columns(model: RobotModel, q: Float[Array, "nq samples"]) -> Float[Array, "nj 4 3 samples"]:
    """Origin and axes of every joint frame in the world, the dtype that of `q`."""
    levels, own = _levels(model.joints), _local(model, q)
    parent = None if levels.parent is None else jnp.asarray(levels.parent[1:])

    def level(above: Array, step: tuple[Array | None, Array]) -> tuple[Array, Array]:
        above = above if step[0] is None else above[step[0]]
        x, y, z = (step[1][:, :, k, None] * above[:, None, k + 1] for k in range(3))
        here = x + y + z + jnp.asarray(_ORIGIN, q.dtype) * above[:, :1]
        return here, here

    own = own[:, None] if parent is None else own[levels.order]
    unroll = max(1, len(own) - 1) if len(own) <= _UNROLLED else 1
    below = jax.lax.scan(level, own[0], (parent, own[1:]), unroll=unroll)[1]
    stacked = jnp.concatenate([own[:1], below])
    return take(stacked.reshape(-1, *own.shape[2:]), levels.place)


def placements(model: RobotModel, q: Float[Array, "nq samples"]) -> Float[Array, "nj 4 4 samples"]:
    """Kernel of `forward_kinematics`: poses `world_T_joint`, the samples on the last axis, the dtype that of `q`."""
    columns = pose_columns(model, q)
    upper = jnp.swapaxes(jnp.concatenate([columns[:, 1:], columns[:, :1]], axis=1), 1, 2)
    bottom = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0], q.dtype)[:, None], (len(upper), 1, 4, q.shape[-1]))
    return jnp.concatenate([upper, bottom], axis=1)


def axis_twists(
    model: RobotModel, columns: Float[Array, "nj 4 3 samples"], point: Float[Array, "3 samples"] | None = None
) -> tuple[Float[Array, "nd 3 samples"], Float[Array, "nd 3 samples"]]:
    """Linear and angular velocity that a unit rate of each degree of freedom gives the body at a point of the world.

    The point is the world's origin where it is left out.
    """
    joint, turns = model.dofs.joint, model.dofs.turns[:, None, None]
    axis = jnp.asarray(model.axis, columns.dtype)[..., None]
    frames = take(columns, joint)
    s = axis[:, :1] * frames[:, 1] + axis[:, 1:2] * frames[:, 2] + axis[:, 2:] * frames[:, 3]
    arm = frames[:, 0] if point is None else frames[:, 0] - point
    if turns.all():
        return cross(arm, s), s
    return jnp.where(turns, cross(arm, s), s), jnp.where(turns, s, 0.0)


def motion(
    model: RobotModel, q: Float[Array, "nq samples"], v: Float[Array, "nv samples"], a: Float[Array, "nv samples"]
) -> Motion:
    r"""Motion of every joint frame in the world, for coordinates with the samples on the last axis.

    With $S_k$ the twists, sums over the degrees of freedom that move the link (Featherstone 2008, section 5.3):
    $$V = \sum S_k \dot q_k, \quad A = \sum S_k \ddot q_k + V_k \times S_k \dot q_k$$
    where $V_k$ belongs to the link that k carries. Then the accelerations of the frame's origin and of the tips of
    its axes, seen from its origin: $\alpha \times r + w \times (w \times r)$, and for the origin $A + w \times V$
    more, starting from rest with -gravity. Units: rad or m, and their rates in seconds. The dtype is that of `q`.
    """
    columns = pose_columns(model, q)
    linear, angular = axis_twists(model, columns)
    rate, push = _rates(model, v), _rates(model, a)
    linear_v, angular_v = linear * rate, angular * rate
    moved, carried = movers(model).T, model.dofs.joint
    v0, w = add_up(moved, linear_v), add_up(moved, angular_v)
    v0_k, w_k = take(v0, carried), take(w, carried)
    al = add_up(moved, angular * push + cross(w_k, angular_v))
    a0 = add_up(moved, linear * push + cross(w_k, linear_v) + cross(v0_k, angular_v))
    a0 = a0 + cross(w, v0) - jnp.asarray(model.gravity, q.dtype)[:, None]
    turning = cross(w[:, None], columns)
    acceleration = cross(al[:, None], columns) + cross(w[:, None], turning)
    return Motion(columns, linear, angular, w, al, acceleration + jnp.asarray(_ORIGIN, q.dtype) * a0[:, None])


def states(model: RobotModel, **arrays: Float[ArrayLike, "..."]) -> list[Float[Array, "*batch n"]]:
    """The named arrays (`q=`, `v=`, ...) in float64; to be called where 64-bit JAX is on. Raises as `check_shapes`."""
    check_shapes(model, **arrays)
    return [jnp.asarray(array, jnp.float64) for array in arrays.values()]


def check_shapes(model: RobotModel, **arrays: Float[ArrayLike, "..."]) -> None:
    """Raise `InputError` naming the array (`q=`, `v=`, ...) that is not real or does not fit the model or the first.

    The last axis of `q` holds the model's `nq` numbers, with unit quaternions; that of every other its `nv`. Raises
    too where the model is something else.
    """
    _check_model(model)
    first = next(iter(arrays))
    for name, array in arrays.items():
        check_real(name, array)
    for name, array in arrays.items():
        shape, expected = np.shape(array), np.shape(arrays[first])
        width = model.nq if name == "q" else model.nv
        if shape[-1:] != (width,):
            joints = ", ".join(model.joint_names)
            what = f"the {width} joints" if model.nq == len(model.joint_names) else f"{width} numbers, for the joints"
            raise InputError(f"{name} has shape {shape}; its last axis must hold {what} {joints}")
        if shape[:-1] != expected[:-1]:
            raise InputError(f"{name} has shape {shape}, but {first} has {expected}; give both alike")
    if model.nq > model.nv and "q" in arrays and not traced(arrays["q"]):
        _check_quaternions(model, np.asarray(arrays["q"]))


def _check_model(model: Any) -> None:
    if isinstance(model, RobotModel):
        joints = len(model.joints)
        for name, shape in (("inertia", (joints, 10)), ("gravity", (3,)), ("placement", (joints, 4, 4))):
            if np.shape(getattr(model, name)) != shape:
                raise InputError(
                    f"model.{name} has shape {np.shape(getattr(model, name))}; robot '{model.name}' needs {shape}: map"
                    " several robots by jax.vmap"
                )
        return
    if isinstance(getattr(model, "robot", None), RobotModel):
        own = f"the {type(model).__name__} holds one: give its `.robot`, or call what it can do itself"
    else:
        own = "load_urdf, load_mjcf or load_usd read one from a file"
    told = f"the text '{str(model)[:100]}'" if isinstance(model, str) else f"of type {type(model).__name__}"
    raise InputError(f"model is {told}; a RobotModel is expected: {own}")


def _frame_index(model: RobotModel, name: str) -> int:
    _check_model(model)
    if not isinstance(name, str):
        raise InputError(f"name is of type {type(name).__name__}; the name of a frame is expected: (model, q, name)")
    return model.frame_index(name)


def _check_quaternions(model: RobotModel, q: np.ndarray) -> None:
    for joint, at in zip(model.joints, model.dofs.positions, strict=True):
        if joint.kind in ("spherical", "free"):
            off = np.abs(np.linalg.norm(q[..., at.stop - 4 : at.stop], axis=-1) - 1.0)
            if not (off < 1e-3).all():
                length = np.ravel(1.0 + off)[np.argmax(np.ravel(~(off < 1e-3)))]
                raise InputError(
                    f"q, joint '{joint.name}': a quaternion (columns {at.stop - 4} to {at.stop - 1}, x y z w) is off"
                    f" unit length by {length - 1.0:.3g}; a unit quaternion is expected"
                )


@in_float64
def forward_kinematics(model: RobotModel, q: Float[ArrayLike, "*batch nq"]) -> Float[Array, "*batch nj 4 4"]:
    """Poses `world_T_joint` of all tree joints (m; q in rad, m for a prismatic joint), in float64.

    Raises `InputError` where `q` does not fit the model.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> fj.forward_kinematics(robot, np.zeros((5, robot.nv))).shape
    (5, 4, 4, 4)
    """
    check_shapes(model, q=q)
    return over_samples(placements, model, q)


def poses_on_host(model: RobotModel, q: Float[np.ndarray, "samples nq"]) -> Float[np.ndarray, "samples nj 4 4"]:
    """`forward_kinematics` of few arrays of the host in NumPy, where joints turn or slide about one axis.

    A program for them takes half a second to compile; where there are more than `_FEW` poses it is worth it.
    """
    numbers, parents = _numbers(model.joints), [joint.parent for joint in model.joints]
    kinds = {joint.kind for joint in model.joints}
    ordered = all(parent < k for k, parent in enumerate(parents))
    if kinds - {"revolute", "prismatic"} or not ordered or len(parents) * len(q) > _FEW:
        return np.asarray(forward_kinematics(model, q))
    check_shapes(model, q=q)
    sliding = {int(joint): int(column) for joint, _, _, column in numbers.slides}
    poses = np.empty((len(parents), len(q), 4, 4))
    for k, parent in enumerate(parents):
        axis, own = np.asarray(model.axis[numbers.hinge[k]], float), np.tile(np.eye(4), (len(q), 1, 1))
        column = sliding[k] if k in sliding else int(numbers.turn[k])
        value = float(model.ratio[k]) * q[:, column] + float(model.offset[k])
        if k in sliding:
            own[:, :3, 3] = value[:, None] * axis
        else:
            across = np.cross(np.eye(3), axis)
            turn = np.sin(value)[:, None, None] * across + (1 - np.cos(value))[:, None, None] * (across @ across)
            own[:, :3, :3] += turn
        here = np.asarray(model.placement[k], float) @ own
        poses[k] = here if parent < 0 else poses[parent] @ here
    return np.moveaxis(poses, 0, 1)


@in_float64
def frame_placement(model: RobotModel, q: Float[ArrayLike, "*batch nq"], name: str) -> Float[Array, "*batch 4 4"]:
    """Pose `world_T_frame` of the frame called `name` (a link or a joint of the model), m and rad, in float64.

    Raises `InputError` where there is no such frame or `q` does not fit the model.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> fj.frame_placement(robot, np.zeros(robot.nv), "hand").shape
    (4, 4)
    """
    index = _frame_index(model, name)
    check_shapes(model, q=q)
    return over_samples(_one_frame, (model, index, model.frames[index].parent), q)


@in_float64
def frame_placements(model: RobotModel, q: Float[ArrayLike, "*batch nq"]) -> Float[Array, "*batch nf 4 4"]:
    """Poses `world_T_frame` of all frames, in the order of `model.frames`; units and errors as `frame_placement`."""
    check_shapes(model, q=q)
    return over_samples(_all_frames, model, q)


def _one_frame(which: tuple[RobotModel, Any, Any], q: Array) -> Float[Array, "4 4 samples"]:
    return frame_pose(placements(which[0], q), *which)


def _all_frames(model: RobotModel, q: Array) -> Float[Array, "nf 4 4 samples"]:
    parents = np.array([frame.parent for frame in model.frames], int)
    return frame_pose(placements(model, q), model, slice(None), parents)


def frame_pose(poses: Float[Array, "nj 4 4 samples"], model: RobotModel, index: Any, parent: Any) -> Array:
    """Poses of frames; a parent of -1, the world, stands before the joints."""
    world = jnp.broadcast_to(jnp.eye(4, dtype=poses.dtype)[..., None], (1, *poses.shape[1:]))
    carrier = jnp.concatenate([world, poses])[parent + 1]
    return matmul(carrier, jnp.asarray(model.frame_placement, poses.dtype)[index][..., None])


@in_float64
def frame_jacobian(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nq"],
    name: str,
    reference: str = "local_world_aligned",
) -> Float[Array, "*batch 6 nv"]:
    """Jacobian of the frame called `name`: its velocity `[linear, angular]` for each v, in Pinocchio's references.

    `local_world_aligned`: of its origin, in world axes; `local`: of its origin, in its own axes; `world`: of the point
    of its body at the world's origin, in world axes. m or 1 per rad or m, in float64. Raises `InputError` where there
    is no such frame or reference or `q` does not fit the model.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> fj.frame_jacobian(robot, np.zeros(robot.nv), "hand", "local").shape
    (6, 4)
    """
    index = _frame_index(model, name)
    if reference not in _JACOBIANS:
        raise InputError(f"reference is '{reference}'; known: {', '.join(_JACOBIANS)}")
    check_shapes(model, q=q)
    return over_samples(_JACOBIANS[reference], (model, index, model.frames[index].parent), q)


def _aligned(which: tuple[RobotModel, Any, Any], q: Array) -> Float[Array, "6 nv samples"]:
    columns = pose_columns(which[0], q)
    pose = frame_pose(placements(which[0], q), *which)
    return _jacobian(which, *axis_twists(which[0], columns, pose[:3, 3]))


def _at_origin(which: tuple[RobotModel, Any, Any], q: Array) -> Float[Array, "6 nv samples"]:
    return _jacobian(which, *axis_twists(which[0], pose_columns(which[0], q)))


def _in_own_axes(which: tuple[RobotModel, Any, Any], q: Array) -> Float[Array, "6 nv samples"]:
    columns = pose_columns(which[0], q)
    pose = frame_pose(placements(which[0], q), *which)
    linear, angular = axis_twists(which[0], columns, pose[:3, 3])
    return _jacobian(which, rotate_back(pose[:3, :3], linear), rotate_back(pose[:3, :3], angular))


_JACOBIANS = {"local_world_aligned": _aligned, "local": _in_own_axes, "world": _at_origin}


def _jacobian(which: tuple[RobotModel, Any, Any], linear: Array, angular: Array) -> Array:
    """Twists of the degrees of freedom that move the frame, one column for each coordinate."""
    model, _, parent = which
    moved = jnp.asarray(np.pad(movers(model), ((0, 0), (1, 0))), linear.dtype)[:, parent + 1]
    columns = jnp.concatenate([linear, angular], axis=1) * moved[:, None, None]
    return jnp.moveaxis(gather(model, columns), 0, 1)
