"""Pinocchio behind the contract of figaroh_jax: the reference that the other backends are compared with.

The Pinocchio model is built from the arrays of a `RobotModel`, never from a file, so that a changed model is compared
too. Samples are computed one after another in float64; nothing here can be differentiated. Two things are translated:
a planar joint has its plane in x and y and its angle as (cos, sin) in Pinocchio, and mimic joints are joints of their
own there, so a matrix maps velocities to joints.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pinocchio as pin
from jax.typing import ArrayLike
from jaxtyping import Float

from figaroh_jax.rigid.derivatives import TorqueDerivatives
from figaroh_jax.rigid.inertia import to_com, transform
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.simulators.contract import Backend, Capabilities, Reference, as_reference, file_format, host_samples

__all__ = ["PinocchioBackend"]

_REFERENCE = {
    "local": pin.ReferenceFrame.LOCAL,
    "world": pin.ReferenceFrame.WORLD,
    "local_world_aligned": pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
}


class PinocchioBackend(Backend):
    """A `pinocchio.Model` (`simulator`): joint i of the robot is Pinocchio's joint i + 1, frames keep their names."""

    name: ClassVar[str] = "pinocchio"
    capabilities: ClassVar[Capabilities] = Capabilities(batch="loop")

    def __init__(self, robot: RobotModel, model_format: str = "model") -> None:
        self._robot, self._format = robot, model_format
        self._turns = _turns(robot)
        self._model = _model(robot, self._turns)
        self._data = self._model.createData()
        self._frames = [self._model.getFrameId(_frame(frame.name)) for frame in robot.frames]
        self._share = _share(robot)

    @classmethod
    def build(cls, robot: RobotModel, source: Path | None = None) -> PinocchioBackend:
        """The backend of a robot, from its arrays."""
        return cls(robot, file_format(source))

    @property
    def robot(self) -> RobotModel:
        """The robot."""
        return self._robot

    @property
    def simulator(self) -> Any:
        """The `pinocchio.Model`."""
        return self._model

    @property
    def model_format(self) -> str:
        """Format of the file that the robot was read from."""
        return self._format

    @property
    def inertias(self) -> Float[np.ndarray, "links 10"]:
        """Inertial parameters of the links in Pinocchio's model."""
        inertias = np.array([inertia.toDynamicParameters() for inertia in list(self._model.inertias)[1:]])
        return transform(inertias, self._turns)

    def mass_matrix(self, q: Float[ArrayLike, "*batch nq"]) -> Float[np.ndarray, "*batch nv nv"]:
        """Composite bodies (`pinocchio.crba`)."""
        return self._reduced(lambda q: _symmetric(pin.crba(self._model, self._data, q)), q=q)

    def coriolis_matrix(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"]
    ) -> Float[np.ndarray, "*batch nv nv"]:
        """`pinocchio.computeCoriolisMatrix`."""
        return self._reduced(lambda *x: pin.computeCoriolisMatrix(self._model, self._data, *x), q=q, v=v)

    def gravity_vector(self, q: Float[ArrayLike, "*batch nq"]) -> Float[np.ndarray, "*batch nv"]:
        """`pinocchio.computeGeneralizedGravity`."""
        return self._torques(lambda q: pin.computeGeneralizedGravity(self._model, self._data, q), q=q)

    def inverse_dynamics(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[np.ndarray, "*batch nv"]:
        """`pinocchio.rnea`."""
        return self._torques(lambda *x: pin.rnea(self._model, self._data, *x), q=q, v=v, a=a)

    def forward_dynamics(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], tau: Float[ArrayLike, "*batch nv"]
    ) -> Float[np.ndarray, "*batch nv"]:
        """Articulated bodies (`pinocchio.aba`), or a solve with the mass matrix where there are mimic joints."""
        if len(self._share) == self.nv:
            return self._torques(lambda *x: pin.aba(self._model, self._data, *x), q=q, v=v, tau=tau)
        bias = self.inverse_dynamics(q, v, np.zeros(np.shape(v)))
        return np.linalg.solve(self.mass_matrix(q), (np.asarray(tau) - bias)[..., None])[..., 0]

    def frame_placements(self, q: Float[ArrayLike, "*batch nq"]) -> Float[np.ndarray, "*batch frames 4 4"]:
        """`pinocchio.framesForwardKinematics`."""

        def one(q: np.ndarray) -> np.ndarray:
            pin.framesForwardKinematics(self._model, self._data, q)
            return np.array([self._data.oMf[frame].homogeneous for frame in self._frames])

        return self._each(one, q=q)

    def frame_jacobian(
        self, q: Float[ArrayLike, "*batch nq"], frame: str, reference: Reference = "local_world_aligned"
    ) -> Float[np.ndarray, "*batch 6 nv"]:
        """`pinocchio.computeFrameJacobian`."""
        index, axes = self._frames[self.frame_id(frame)], _REFERENCE[as_reference(reference)]
        one = lambda q: pin.computeFrameJacobian(self._model, self._data, q, index, axes).reshape(6, -1)  # noqa: E731
        return self._each(one, q=q) @ self._share

    def joint_torque_regressor(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[np.ndarray, "*batch nv columns"]:
        """`pinocchio.computeJointTorqueRegressor`."""
        one = lambda *x: pin.computeJointTorqueRegressor(self._model, self._data, *x).reshape(len(self._share), -1)  # noqa: E731
        blocks = (self._share.T @ self._each(one, q=q, v=v, a=a)).reshape(*np.shape(q)[:-1], self.nv, -1, 1, 10)
        back = np.repeat(np.swapaxes(self._turns, 1, 2)[:, None], 10, axis=1)
        into = np.swapaxes(transform(np.tile(np.eye(10), (len(back), 1, 1)), back), 1, 2)
        return (blocks @ into).reshape(*np.shape(q)[:-1], self.nv, -1)

    def dynamics_derivatives(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> TorqueDerivatives:
        """`pinocchio.computeRNEADerivatives`."""

        def one(*x: np.ndarray) -> np.ndarray:
            by_q, by_v, by_a = pin.computeRNEADerivatives(self._model, self._data, *x)
            return np.array([by_q, by_v, _symmetric(by_a)])

        answers = self._reduced(one, q=q, v=v, a=a)
        return TorqueDerivatives(*(answers[..., k, :, :] for k in range(3)))

    def integrate(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"]
    ) -> Float[np.ndarray, "*batch nq"]:
        """`pinocchio.integrate`; this library's own where the two write q differently."""
        if self._model.nq != self.nq:
            return np.asarray(super().integrate(q, v))
        return self._each(lambda *x: pin.integrate(self._model, *x), q=q, v=v)

    def difference(
        self, q0: Float[ArrayLike, "*batch nq"], q1: Float[ArrayLike, "*batch nq"]
    ) -> Float[np.ndarray, "*batch nv"]:
        """`pinocchio.difference`; this library's own where the two write q differently."""
        if self._model.nq != self.nq:
            return np.asarray(super().difference(q0, q1))
        first, second = host_samples(self, q=q0), host_samples(self, q=q1)
        pairs = zip(first[0], second[0], strict=True)
        return first.restore(np.array([pin.difference(self._model, *pair) for pair in pairs]))

    def _torques(self, function: Callable[..., np.ndarray], **arrays: ArrayLike) -> np.ndarray:
        return self._each(function, **arrays) @ self._share

    def _reduced(self, function: Callable[..., np.ndarray], **arrays: ArrayLike) -> np.ndarray:
        return self._share.T @ self._each(function, **arrays) @ self._share

    def _each(self, function: Callable[..., np.ndarray], **arrays: ArrayLike) -> np.ndarray:
        """`function(q, ...)` of every sample, in Pinocchio's joints."""
        samples = host_samples(self, **arrays)
        columns = [_positions(self._robot, samples[0]), *(rate @ self._share.T for rate in samples[1:])]
        return samples.restore(np.array([function(*sample) for sample in zip(*columns, strict=True)]))


def _model(robot: RobotModel, turns: Float[np.ndarray, "nj 4 4"]) -> Any:
    result = pin.Model()
    result.name = robot.name
    result.gravity.linear = np.asarray(robot.gravity, float)
    back = np.concatenate([np.swapaxes(turns, 1, 2), np.eye(4)[None]])  # the last, -1: the world
    for i, joint in enumerate(robot.joints):
        placement = back[joint.parent] @ np.asarray(robot.placement[i], float) @ turns[i]
        index = result.addJoint(joint.parent + 1, _joint(robot, i), pin.SE3(placement), joint.name)
        mass, com, about_com = to_com(transform(np.asarray(robot.inertia[i], float), back[i]))
        result.appendBodyToJoint(index, pin.Inertia(float(mass), com, about_com), pin.SE3.Identity())
    for frame, placement in zip(robot.frames, np.asarray(robot.frame_placement, float), strict=True):
        pose = pin.SE3(back[frame.parent] @ placement)
        result.addFrame(pin.Frame(_frame(frame.name), frame.parent + 1, 0, pose, pin.FrameType.OP_FRAME), False)
    return result


def _frame(name: str) -> str:
    """Name of a frame in Pinocchio's model, where joints are frames too and names must differ."""
    return f"{name} (frame)"


def _joint(robot: RobotModel, index: int) -> Any:
    kind, axis = robot.joints[index].kind, np.asarray(robot.axis[robot.dofs.first[index]], float)
    if kind == "revolute":
        return pin.JointModelRevoluteUnaligned(axis)
    if kind == "prismatic":
        return pin.JointModelPrismaticUnaligned(axis)
    joints = {"spherical": pin.JointModelSpherical, "planar": pin.JointModelPlanar, "free": pin.JointModelFreeFlyer}
    return joints[kind]()


def _turns(robot: RobotModel) -> Float[np.ndarray, "nj 4 4"]:
    """Pose of Pinocchio's joint frame in ours: Pinocchio's planar joint moves in x and y, ours in any plane."""
    turns = np.tile(np.eye(4), (len(robot.joints), 1, 1))
    for i, joint in enumerate(robot.joints):
        if joint.kind == "planar":
            first = robot.dofs.first[i]
            turns[i, :3, :3] = np.asarray(robot.axis[first : first + 3], float).T
    return turns


def _positions(robot: RobotModel, q: Float[np.ndarray, "samples nq"]) -> Float[np.ndarray, "samples numbers"]:
    """Pinocchio's q: mimic joints have numbers of their own, planar joints the cosine and sine of their angle."""
    parts = []
    for joint, at, ratio, offset in zip(robot.joints, robot.dofs.positions, robot.ratio, robot.offset, strict=True):
        part = q[:, at]
        if joint.kind == "planar":
            part = np.concatenate([part[:, :2], np.cos(part[:, 2:]), np.sin(part[:, 2:])], 1)
        elif joint.kind in ("revolute", "prismatic"):
            part = float(ratio) * part + float(offset)
        parts.append(part)
    return np.concatenate(parts, 1)


def _symmetric(upper: np.ndarray) -> np.ndarray:
    upper = np.triu(upper)
    return upper + np.triu(upper, 1).T


def _share(robot: RobotModel) -> Float[np.ndarray, "nd nv"]:
    """Rate of each joint's degrees of freedom for a unit velocity of each coordinate."""
    share = np.zeros((robot.nd, robot.nv))
    share[np.arange(robot.nd), robot.dofs.column] = np.asarray(robot.ratio)[robot.dofs.joint]
    return share
