"""MuJoCo's model of a robot, and the translation of coordinates, for the backends that compute with MuJoCo.

A robot from an MJCF file keeps the model that MuJoCo compiles from that file; any other is built from the arrays of its
`RobotModel`, with every body at its joint. MuJoCo's coordinates differ from ours in four ways: quaternions are
w x y z; the linear velocity of a free joint and the velocity of a planar one (two slides and a hinge) are in the axes
of the parent; mimic joints have coordinates of their own; and its joints may stand in another order. So
`qpos = scale q[index] + shift`, `qvel = J(q) v`, `qacc = J(q) a + drift(q, v)` and our torques are `J' qfrc`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..rigid.inertia import from_com, to_com, transform
from ..rigid.model import RobotModel
from .files import model_format
from .mjcf import compile_mjcf, engine, joint_names

__all__ = [
    "Compiled",
    "Translation",
    "compiled",
    "drift",
    "frame_poses",
    "joint_poses",
    "link_inertias",
    "positions",
    "quaternion_matrix",
    "rates",
    "spatial_inertias",
]

_MJ_ORDER = [4, 6, 9, 5, 7, 8, 1, 2, 3, 0]  # of our ten in MuJoCo's spatial inertia: moments, first moments, mass


class _Turned(NamedTuple):
    """A joint whose first dofs are in the parent's axes in MuJoCo, in the child's in ours."""

    kind: str
    dof: int  # its first, MuJoCo's
    at: slice  # its numbers in q
    column: int  # its first of v


@dataclass(frozen=True, eq=False)
class Translation:
    """From the coordinates of a `RobotModel` to MuJoCo's; see the functions of this module."""

    index: Int[np.ndarray, " numbers"]
    scale: Float[np.ndarray, " numbers"]
    shift: Float[np.ndarray, " numbers"]
    share: Float[np.ndarray, "dofs nv"]  # J where no joint is turned
    turned: tuple[_Turned, ...]
    body: Int[np.ndarray, " nj"]  # MuJoCo's body of each link
    joint_in_body: Float[np.ndarray, "nj 3"]  # origin of each joint in its body; the axes are the body's
    reaches: Float[np.ndarray, "dofs nj"]  # 1 where MuJoCo's dof moves the link


class Compiled(NamedTuple):
    """MuJoCo's model of a robot."""

    model: Any  # mujoco.MjModel
    translation: Translation
    from_file: bool  # compiled from the user's MJCF, not built from arrays


def compiled(robot: RobotModel, source: Path | None = None) -> Compiled:
    """The model that MuJoCo compiles from an MJCF `source`, where its joints are the robot's, or one built from arrays.

    A body with several joints, or a joint that the robot does not have (locked, or held by an equality), has no link of
    its own in MuJoCo; such a robot is built from its arrays.
    """
    if source is not None and model_format(source) == "mjcf":
        model = compile_mjcf(source)
        same = sorted(joint_names(model)) == sorted(joint.name for joint in robot.joints)
        if same and (model.body_jntnum <= 1).all():
            return Compiled(model, _translation(robot, model, joint_names(model)), True)
    model, names = _build(robot)
    return Compiled(model, _translation(robot, model, names), False)


def positions(t: Translation, q: Float[Any, "*batch nq"]) -> Float[Any, "*batch numbers"]:
    """MuJoCo's qpos."""
    return q[..., t.index] * t.scale + t.shift


def rates(t: Translation, q: Float[Any, "*batch nq"]) -> Float[Any, "..."]:
    """The matrix J(q) with qvel = J v: `(dofs, nv)`, with the batch axes of q where it depends on q."""
    if not t.turned:
        return t.share
    xp, rows, done = q.__array_namespace__(), [], 0
    for joint in t.turned:
        turn = _rotation(joint, q)
        end = joint.dof + turn.shape[-1]
        rows += [t.share[done : joint.dof], turn @ t.share[joint.dof : end]]
        done = end
    shape = q.shape[:-1]
    rows = [xp.broadcast_to(xp.asarray(part), (*shape, *part.shape[-2:])) for part in [*rows, t.share[done:]]]
    return xp.concatenate(rows, axis=-2)


def drift(t: Translation, q: Float[Any, "*batch nq"], v: Float[Any, "*batch nv"]) -> Float[Any, "*batch dofs"]:
    """What qacc is where a is zero: the parent's axes see turning linear velocities change."""
    xp = q.__array_namespace__()
    parts, done = [], 0
    for joint in t.turned:
        turn, k = _rotation(joint, q), joint.column
        if joint.kind == "free":
            change = xp.linalg.cross(v[..., k + 3 : k + 6], v[..., k : k + 3])
        else:
            change = v[..., k + 2, None] * xp.stack([-v[..., k + 1], v[..., k]], axis=-1)
        own = (turn @ change[..., None])[..., 0]
        parts += [xp.zeros((*q.shape[:-1], joint.dof - done)), own]
        done = joint.dof + own.shape[-1]
    return xp.concatenate([*parts, xp.zeros((*q.shape[:-1], len(t.share) - done))], axis=-1)


def spatial_inertias(
    poses: Float[Any, "*batch nj 4 4"], about: Float[Any, "*batch nj 3"]
) -> Float[Any, "*batch nj 10 10"]:
    """MuJoCo's spatial inertia (`cinert`: about a point, in world axes) of each link for a unit of each of our ten.

    `poses` are `world_T_joint`, `about` the points. The last axis is MuJoCo's inertia, the one before our parameter.
    """
    xp = poses.__array_namespace__()
    rotation, way = poses[..., :3, :3], poses[..., :3, 3] - about
    bottom = xp.broadcast_to(xp.asarray([[0.0, 0.0, 0.0, 1.0]]), (*poses.shape[:-2], 1, 4))
    centred = xp.concatenate([xp.concatenate([rotation, way[..., None]], -1), bottom], -2)
    shape = (*centred.shape[:-2], 10)
    units = xp.broadcast_to(xp.asarray(np.eye(10)), (*shape, 10))
    return transform(units, xp.broadcast_to(centred[..., None, :, :], (*shape, 4, 4)))[..., _MJ_ORDER]


def joint_poses(
    t: Translation, rotation: Float[Any, "*batch nbody 3 3"], position: Float[Any, "*batch nbody 3"]
) -> Float[Any, "*batch nj 4 4"]:
    """Poses `world_T_joint` from those of MuJoCo's bodies."""
    xp = rotation.__array_namespace__()
    turned = rotation[..., t.body, :, :]
    origin = position[..., t.body, :] + (turned @ t.joint_in_body[..., None])[..., 0]
    bottom = xp.broadcast_to(xp.asarray([[0.0, 0.0, 0.0, 1.0]]), (*turned.shape[:-2], 1, 4))
    return xp.concatenate([xp.concatenate([turned, origin[..., None]], -1), bottom], -2)


def frame_poses(robot: RobotModel, joints: Float[Any, "*batch nj 4 4"]) -> Float[Any, "*batch frames 4 4"]:
    """Poses `world_T_frame` from those of the joints."""
    xp = joints.__array_namespace__()
    world = xp.broadcast_to(xp.asarray(np.eye(4)), (*joints.shape[:-3], 1, 4, 4))
    carrier = np.array([frame.parent for frame in robot.frames], int) + 1
    return xp.concatenate([world, joints], -3)[..., carrier, :, :] @ xp.asarray(robot.frame_placement)


def link_inertias(t: Translation, model: Any) -> Float[Any, "nj 10"]:
    """Our ten parameters of each link, welded bodies counted in, from an `MjModel` or an `mjx.Model`."""
    xp = model.body_mass.__array_namespace__()
    own = transform(
        from_com(model.body_mass, xp.zeros((model.nbody, 3)), model.body_inertia[:, :, None] * np.eye(3)),
        _pose(model.body_ipos, model.body_iquat),
    )
    local, shift = _pose(model.body_pos, model.body_quat), np.tile(np.eye(4), (len(t.body), 1, 1))
    shift[:, :3, 3] = -t.joint_in_body
    links = []
    for body, back in zip(t.body, shift, strict=True):
        poses = {int(body): xp.asarray(np.eye(4))}
        for b in range(int(body) + 1, model.nbody):
            if model.body_jntnum[b] == 0 and int(model.body_parentid[b]) in poses:
                poses[b] = poses[int(model.body_parentid[b])] @ local[b]
        links.append(sum(transform(own[b], back @ pose) for b, pose in poses.items()))
    return xp.stack(links)


def _pose(position: Float[Any, "n 3"], quaternion: Float[Any, "n 4"]) -> Float[Any, "n 4 4"]:
    xp = position.__array_namespace__()
    rotation = quaternion_matrix(
        quaternion[:, [1, 2, 3, 0]] / xp.linalg.vector_norm(quaternion, axis=-1, keepdims=True)
    )
    bottom = xp.broadcast_to(xp.asarray([[0.0, 0.0, 0.0, 1.0]]), (len(position), 1, 4))
    return xp.concatenate([xp.concatenate([rotation, position[..., None]], -1), bottom], -2)


def _rotation(joint: _Turned, q: Float[Any, "*batch nq"]) -> Float[Any, "*batch n n"]:
    xp = q.__array_namespace__()
    if joint.kind == "planar":
        angle = q[..., joint.at.stop - 1]
        c, s = xp.cos(angle), xp.sin(angle)
        return xp.stack([xp.stack([c, -s], -1), xp.stack([s, c], -1)], -2)
    return quaternion_matrix(q[..., joint.at.stop - 4 : joint.at.stop])


def quaternion_matrix(quaternion: Float[Any, "*batch 4"]) -> Float[Any, "*batch 3 3"]:
    """Rotation of a quaternion x y z w of length one."""
    xp = quaternion.__array_namespace__()
    x, y, z, w = (quaternion[..., k] for k in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, -1) for row in rows], -2)


def _build(robot: RobotModel) -> tuple[Any, list[str]]:
    """The model built from the arrays, and the names of our joints in the order of MuJoCo's."""
    mujoco = engine()
    spec = mujoco.MjSpec()
    spec.modelname, spec.compiler.degree = robot.name, False
    spec.option.gravity = np.asarray(robot.gravity, float)
    bodies = {-1: spec.worldbody}
    for i, joint in enumerate(robot.joints):
        pose = np.asarray(robot.placement[i], float)
        body = bodies[joint.parent].add_body(name=joint.link, pos=pose[:3, 3], quat=_quaternion(mujoco, pose[:3, :3]))
        # An inertia that MuJoCo takes, replaced in the compiled model by the true one, which it may refuse. Out of
        # centre and askew, because MuJoCo simplifies what it computes for a body that is neither.
        body.mass, body.inertia, body.explicitinertial = 1.0, [1.0, 1.1, 1.2], True
        body.ipos, body.iquat = [0.1, 0.2, 0.3], [0.9, 0.3, 0.2, 0.1]
        for name, kind, axis in _joints(mujoco, robot, i):
            body.add_joint(name=name, type=kind, axis=axis)
        bodies[i] = body
    model = spec.compile()
    for joint, parameters in zip(robot.joints, np.asarray(robot.inertia, float), strict=True):
        _set_inertia(mujoco, model, model.body(joint.link).id, parameters)
    model.body_subtreemass[:] = model.body_mass
    for body in range(model.nbody - 1, 0, -1):
        model.body_subtreemass[model.body_parentid[body]] += model.body_subtreemass[body]
    order = [model.jnt_bodyid[j] for j in range(model.njnt)]
    link = {model.body(joint.link).id: joint.name for joint in robot.joints}
    return model, [link[body] for body in dict.fromkeys(order)]


def _joints(mujoco: Any, robot: RobotModel, index: int) -> list[tuple[str, Any, np.ndarray]]:
    """Name, type and axis of MuJoCo's joints for one of ours."""
    joint, kinds = robot.joints[index], mujoco.mjtJoint
    axes = np.asarray(robot.axis, float)[robot.dofs.first[index] :]
    if joint.kind == "revolute":
        return [(joint.name, kinds.mjJNT_HINGE, axes[0])]
    if joint.kind == "prismatic":
        return [(joint.name, kinds.mjJNT_SLIDE, axes[0])]
    if joint.kind == "spherical":
        return [(joint.name, kinds.mjJNT_BALL, axes[0])]
    if joint.kind == "planar":
        slides = [(f"{joint.name}_{x}", kinds.mjJNT_SLIDE, axis) for x, axis in zip("xy", axes, strict=False)]
        return [*slides, (joint.name, kinds.mjJNT_HINGE, axes[2])]
    if joint.parent < 0 and np.array_equal(robot.placement[index], np.eye(4)):
        return [(joint.name, kinds.mjJNT_FREE, axes[0])]
    # MuJoCo has free joints of the world alone
    slides = [(f"{joint.name}_{x}", kinds.mjJNT_SLIDE, axis) for x, axis in zip("xyz", axes, strict=False)]
    return [*slides, (joint.name, kinds.mjJNT_BALL, axes[3])]


def _set_inertia(mujoco: Any, model: Any, body: int, parameters: Float[np.ndarray, "10"]) -> None:
    mass, com, about_com = to_com(parameters)
    moments, axes = np.linalg.eigh(about_com)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    model.body_mass[body], model.body_ipos[body], model.body_inertia[body] = mass, com, moments
    model.body_iquat[body] = _quaternion(mujoco, axes)


def _quaternion(mujoco: Any, rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    return quaternion


def _translation(robot: RobotModel, model: Any, names: list[str]) -> Translation:
    """`names`: our joint of each of MuJoCo's moving bodies, in MuJoCo's order."""
    tree = {joint.name: i for i, joint in enumerate(robot.joints)}
    index, scale, shift, turned = [], [], [], []
    share, body = np.zeros((model.nv, robot.nv)), np.zeros(len(tree), int)
    moving = list(dict.fromkeys(int(b) for b in model.jnt_bodyid))
    for b, name in zip(moving, names, strict=True):
        i = tree[name]
        joint, at, first = robot.joints[i], robot.dofs.positions[i], int(model.body_dofadr[b])
        numbers, ratio = np.arange(at.start, at.stop), float(robot.ratio[i])
        if joint.kind in ("spherical", "free"):
            numbers = np.concatenate([numbers[:-4], numbers[-1:], numbers[-4:-1]])  # w x y z
        if joint.kind in ("planar", "free"):
            turned.append(_Turned(joint.kind, first, at, joint.coordinate))
        body[i] = b
        width = int(model.body_dofnum[b])
        share[first : first + width, joint.coordinate : joint.coordinate + width] = ratio * np.eye(width)
        index += list(numbers)
        scale += [ratio] * len(numbers)
        shift += [float(robot.offset[i])] * len(numbers)
    joint_in_body = np.zeros((len(tree), 3))
    reaches = np.zeros((model.nv, len(tree)))
    for i, b in enumerate(body):
        joint_in_body[i] = model.jnt_pos[model.body_jntadr[b] + model.body_jntnum[b] - 1]
        while b > 0:
            reaches[model.body_dofadr[b] : model.body_dofadr[b] + model.body_dofnum[b], i] = 1.0
            b = model.body_parentid[b]
    return Translation(
        np.array(index), np.array(scale), np.array(shift), share, tuple(turned), body, joint_in_body, reaches
    )
