"""Kernels of robots with free, planar and spherical joints, against Pinocchio's own model of the same random tree."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
import robots

from figaroh_jax.errors import InputError
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.rigid import dynamics, kinematics
from figaroh_jax.rigid.model import Frame, Joint, RobotModel
from figaroh_jax.rigid.normal_equations import normal_matrix, triangular_factor
from figaroh_jax.rigid.regressor import joint_torque_regressor, packed_regressor, pairs

REFERENCES = {"local": pin.LOCAL, "world": pin.WORLD, "local_world_aligned": pin.LOCAL_WORLD_ALIGNED}
KINDS: dict[str, Callable[[np.ndarray], Any]] = {
    "revolute": lambda axis: pin.JointModelRevoluteUnaligned(*axis),
    "prismatic": lambda axis: pin.JointModelPrismaticUnaligned(*axis),
    "spherical": lambda axis: pin.JointModelSpherical(),
    "planar": lambda axis: pin.JointModelPlanar(),
    "free": lambda axis: pin.JointModelFreeFlyer(),
}
UNIT = {"spherical": np.eye(3), "planar": np.eye(3), "free": np.concatenate([np.eye(3), np.eye(3)])}


class Twin(NamedTuple):
    """The same robot for us and for Pinocchio, whose planar joints have the cosine and the sine of their angle in q."""

    model: RobotModel
    robot: Any
    data: Any

    def theirs(self, q: np.ndarray) -> np.ndarray:
        parts = []
        for joint, at in zip(self.model.joints, self.model.dofs.positions, strict=True):
            planar = joint.kind == "planar"
            parts.append(np.array([*q[at][:2], np.cos(q[at][2]), np.sin(q[at][2])]) if planar else q[at])
        return np.concatenate(parts)


def random_tree(seed: int, kinds: tuple[str, ...]) -> Twin:
    """A tree whose i-th joint, of the given kind, hangs on the one before it, on one above that, or on the world."""
    rng, robot = np.random.default_rng(seed), pin.Model()
    robot.gravity.linear = rng.normal(size=3)
    joints, frames, axes = [], [], []
    for i, kind in enumerate(kinds):
        parent, axis = i - 1, rng.normal(size=3)
        for _ in range(rng.integers(3)):  # Pinocchio wants its joints numbered depth first
            parent = joints[parent].parent if parent >= 0 else -1
        axis /= np.linalg.norm(axis)
        robot.addJoint(parent + 1, KINDS[kind](axis), pin.SE3.Random(), f"j{i}")
        robot.appendBodyToJoint(i + 1, pin.Inertia.Random(), pin.SE3.Identity())
        frame = pin.Frame(f"f{i}", i + 1, 0, pin.SE3.Random(), pin.FrameType.OP_FRAME)
        robot.addFrame(frame)
        frames.append(frame)
        joints.append(Joint(f"j{i}", kind, parent, robot.joints[i + 1].idx_v, f"l{i}"))  # pyright: ignore[reportArgumentType]
        axes.append(UNIT.get(kind, axis[None]))
    nv = robot.nv
    model = RobotModel(
        placement=np.array([x.homogeneous for x in list(robot.jointPlacements)[1:]]),
        axis=np.concatenate(axes),
        inertia=np.array([x.toDynamicParameters() for x in list(robot.inertias)[1:]]),
        ratio=np.ones(len(kinds)),
        offset=np.zeros(len(kinds)),
        gravity=np.array(robot.gravity.linear),
        frame_placement=np.array([frame.placement.homogeneous for frame in frames]),
        position_limit=np.zeros((nv, 2)),
        velocity_limit=np.zeros(nv),
        effort_limit=np.zeros(nv),
        joints=tuple(joints),
        frames=tuple(Frame(f"f{i}", i) for i in range(len(kinds))),
        name="random",
    )
    return Twin(model, robot, robot.createData())


def states(model: RobotModel, samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random states with unit quaternions."""
    rng = np.random.default_rng(seed)
    q, (v, a) = rng.normal(size=(samples, model.nq)), rng.normal(size=(2, samples, model.nv))
    for joint, at in zip(model.joints, model.dofs.positions, strict=True):
        if joint.kind in ("spherical", "free"):
            q[:, at.stop - 4 : at.stop] /= np.linalg.norm(q[:, at.stop - 4 : at.stop], axis=1, keepdims=True)
    return q, v, a


TREES = {
    "humanoid": (1, ("free", "revolute", "revolute", "spherical", "prismatic", "revolute", "spherical")),
    "one of each": (2, ("planar", "spherical", "free", "revolute", "prismatic")),
    "drawn": (
        int(np.random.default_rng().integers(1 << 30)),
        tuple(np.random.default_rng().permutation(list(KINDS)).tolist()),  # one of each
    ),
}


@pytest.fixture(params=[*(pytest.param(name, marks=pytest.mark.slow) for name in ("humanoid", "one of each")), "drawn"])
def twin(request: pytest.FixtureRequest) -> Twin:
    return random_tree(*TREES[request.param])


def close(ours: Any, theirs: Any, what: object = "") -> None:
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * max(1.0, np.abs(theirs).max()), err_msg=str(what))


def agrees(model: RobotModel, robot: Any, data: Any, theirs: Callable[[np.ndarray], np.ndarray], samples: int) -> None:
    """Poses, torques, masses, accelerations and regressor at random states are Pinocchio's."""
    q, v, a = states(model, samples)
    poses, M = kinematics.forward_kinematics(model, q), dynamics.mass_matrix(model, q)
    tau, W = dynamics.inverse_dynamics(model, q, v, a), joint_torque_regressor(model, q, v, a)
    back = dynamics.forward_dynamics(model, q, v, tau)
    names = list(robot.names)[1:]
    order = [names.index(joint.name) for joint in model.joints]
    column = np.concatenate([robot.joints[k + 1].idx_v + np.arange(robot.joints[k + 1].nv) for k in order])
    for k in range(samples):
        x, rates = theirs(q[k]), np.zeros((2, robot.nv))
        rates[:, column] = v[k], a[k]
        pin.forwardKinematics(robot, data, x)
        torque = pin.rnea(robot, data, x, *rates)[column]
        close(tau[k], torque, model.joints)
        close(poses[k], [data.oMi[i + 1].homogeneous for i in order], model.joints)
        crba = pin.crba(robot, data, x)
        crba = np.triu(crba) + np.triu(crba, 1).T
        close(M[k], crba[np.ix_(column, column)], model.joints)
        rows = pin.computeJointTorqueRegressor(robot, data, x, *rates)[column]
        close(W[k], rows.reshape(len(column), -1, 10)[:, order].reshape(len(column), -1), model.joints)
    np.testing.assert_allclose(back, a, rtol=0, atol=1e-9)


def test_kernels_of_random_trees_are_pinocchios(twin: Twin) -> None:
    agrees(twin.model, twin.robot, twin.data, twin.theirs, 5)


def test_frames_and_their_jacobians_are_pinocchios_in_every_reference() -> None:
    twin = random_tree(*TREES["humanoid"])
    q = states(twin.model, 2)[0]
    poses = kinematics.frame_placements(twin.model, q)
    for name in (f"f{k}" for k in range(0, len(twin.model.joints), 2)):
        index = twin.robot.getFrameId(name)
        jacobians = {r: kinematics.frame_jacobian(twin.model, q, name, r) for r in REFERENCES}
        for k in range(2):
            pin.computeJointJacobians(twin.robot, twin.data, twin.theirs(q[k]))
            pin.updateFramePlacements(twin.robot, twin.data)
            close(poses[k, twin.model.frame_index(name)], twin.data.oMf[index].homogeneous)
            for reference, theirs in REFERENCES.items():
                close(jacobians[reference][k], pin.getFrameJacobian(twin.robot, twin.data, index, theirs), reference)
    with pytest.raises(InputError, match="reference is 'body'; known: local_world_aligned, local, world"):
        kinematics.frame_jacobian(twin.model, q, "f0", "body")


@pytest.mark.slow
def test_talos_with_a_free_root_is_pinocchios(data_dir: Path) -> None:
    """The first six rows of the regressor are the wrench at the base, in its own axes."""
    path = data_dir / robots.REAL["talos"]
    model = load_urdf(path, root="free_flyer")
    robot = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
    names = {joint.name: at for joint, at in zip(model.joints, model.dofs.positions, strict=True)}

    def theirs(q: np.ndarray) -> np.ndarray:
        parts = []
        for joint, name in zip(list(robot.joints)[1:], list(robot.names)[1:], strict=True):
            x = q[names["root_joint" if name == "root_joint" else name]]
            parts.append(np.array([np.cos(x[0]), np.sin(x[0])]) if joint.nq == 2 and joint.nv == 1 else x)
        return np.concatenate(parts)

    agrees(model, robot, robot.createData(), theirs, 3)


def test_packed_and_condensed_regressors_are_the_dense_one() -> None:
    model = random_tree(*TREES["humanoid"]).model
    q, v, a = states(model, 30)
    W, tau = np.asarray(joint_torque_regressor(model, q, v, a)), np.random.default_rng(0).normal(size=v.shape)
    dense = np.moveaxis(W, 0, -1).reshape(model.nv, len(model.joints), 10, -1)
    row, link = pairs(model).T
    close(packed_regressor(model, q, v, a), dense[model.dofs.column[row], link])
    both = np.concatenate([W, tau[..., None]], axis=2).reshape(30 * model.nv, -1)
    G, b, square = normal_matrix(model, q, v, a, tau)
    close(np.block([[np.asarray(G), np.asarray(b)[:, None]], [np.asarray(b), np.asarray(square)]]), both.T @ both)
    R = np.asarray(triangular_factor(model, q, v, a, tau))
    close(R.T @ R, both.T @ both)


def test_gradients_by_quaternions_velocities_and_axes_are_central_differences() -> None:
    twin = random_tree(4, ("free", "spherical", "revolute", "planar"))
    point = {**dict(zip("qva", states(twin.model, 2), strict=True)), "axis": np.asarray(twin.model.axis)}
    weight = np.random.default_rng(1).normal(size=(2, twin.model.nv))

    @jax.jit
    def value(point: dict[str, jax.Array]) -> jax.Array:
        robot = eqx.tree_at(lambda m: m.axis, twin.model, point["axis"])
        return jnp.sum(weight * dynamics.inverse_dynamics(robot, *(point[k] for k in "qva")))

    gradient = jax.jit(jax.grad(value))(point)
    for name, x in point.items():
        step = np.random.default_rng(2).normal(size=x.shape)
        ahead, behind = (value(point | {name: x + h * step}) for h in (1e-6, -1e-6))
        difference = float(ahead - behind) / 2e-6
        np.testing.assert_allclose(np.sum(gradient[name] * step), difference, rtol=1e-6, atol=0, err_msg=name)


def test_a_quaternion_of_another_length_is_refused() -> None:
    twin = random_tree(5, ("revolute", "free"))
    q, v, a = states(twin.model, 3)
    q[1, 4:] *= 1.5
    with pytest.raises(InputError, match="'j1': a quaternion .columns 4 to 7, x y z w. is off unit length by 0.5"):
        dynamics.inverse_dynamics(twin.model, q, v, a)
