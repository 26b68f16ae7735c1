"""The contract's functions for a simulator on the host that gives torques, a mass matrix, poses and Jacobians."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import Any, Self

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from ..errors import InputError
from ..formats.mujoco_model import frame_poses
from ..rigid.derivatives import coriolis_from_bias
from ..rigid.model import RobotModel
from .contract import Backend, Reference, as_reference, file_format, host_samples

__all__ = ["HostBackend"]


class HostBackend(Backend):
    """A backend of a robot and the file it was read from, whose underscored functions answer for samples of the host,
    q (samples, nq), v and a (samples, nv).
    """

    def __init__(self, robot: RobotModel, source: Path | None = None) -> None:
        self._robot, self._source = robot, source

    @classmethod
    def build(cls, robot: RobotModel, source: Path | None = None) -> Self:
        """The backend of a robot."""
        return cls(robot, source)

    @property
    def robot(self) -> RobotModel:
        """The robot."""
        return self._robot

    @property
    def model_format(self) -> str:
        """Format of the file that the robot was read from."""
        return file_format(self._source)

    @abstractmethod
    def _torques(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> Float[np.ndarray, "samples nv"]: ...

    @abstractmethod
    def _masses(self, q: np.ndarray) -> Float[np.ndarray, "samples nv nv"]: ...

    @abstractmethod
    def _joint_poses(self, q: np.ndarray) -> Float[np.ndarray, "samples nj 4 4"]:
        """Poses `world_T_joint`."""

    @abstractmethod
    def _point_jacobian(
        self,
        q: np.ndarray,
        joint: int,
        joints: Float[np.ndarray, "samples nj 4 4"],
        points: Float[np.ndarray, "samples 3"],
    ) -> Float[np.ndarray, "samples 6 nv"]:
        """Twist, in world axes, of the points of the link behind a joint of the tree; `joints` are the poses at q."""

    def frame_placements(self, q: Float[ArrayLike, "*batch nq"]) -> Float[np.ndarray, "*batch frames 4 4"]:
        """From the simulator's own poses of the links."""
        samples = host_samples(self, q=q)
        return samples.restore(frame_poses(self._robot, self._joint_poses(samples[0])))

    def frame_jacobian(
        self, q: Float[ArrayLike, "*batch nq"], frame: str, reference: Reference = "local_world_aligned"
    ) -> Float[np.ndarray, "*batch 6 nv"]:
        """The simulator's own Jacobian of the link, of the frame's origin or of the world's."""
        index, axes, samples = self.frame_id(frame), as_reference(reference), host_samples(self, q=q)
        q, parent = samples[0], self._robot.frames[index].parent
        if parent < 0:
            return samples.restore(np.zeros((len(q), 6, self.nv)))
        joints = self._joint_poses(q)
        pose = frame_poses(self._robot, joints)[:, index]
        points = np.zeros((len(q), 3)) if axes == "world" else pose[:, :3, 3]
        jacobian = self._point_jacobian(q, parent, joints, points)
        if axes == "local":
            back = np.swapaxes(pose[:, None, :3, :3], -1, -2)
            jacobian = (back @ jacobian.reshape(-1, 2, 3, self.nv)).reshape(jacobian.shape)
        return samples.restore(jacobian)

    def mass_matrix(self, q: Float[ArrayLike, "*batch nq"]) -> Float[np.ndarray, "*batch nv nv"]:
        """The simulator's own, see the class."""
        samples = host_samples(self, q=q)
        return samples.restore(self._masses(samples[0]))

    def coriolis_matrix(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"]
    ) -> Float[np.ndarray, "*batch nv nv"]:
        """From differences of the quadratic bias torques: without error of approximation, see `coriolis_from_bias`."""
        samples = host_samples(self, q=q, v=v)
        q, v = samples

        def bias(around: Any) -> np.ndarray:
            x = np.asarray(around).reshape(-1, self.nv)
            return self._torques(np.repeat(q, self.nv, 0), x, np.zeros_like(x)).reshape(around.shape)

        return samples.restore(np.asarray(coriolis_from_bias(self.robot, bias, self._masses(q), v)))

    def gravity_vector(self, q: Float[ArrayLike, "*batch nq"]) -> Float[np.ndarray, "*batch nv"]:
        """Torques at rest."""
        samples = host_samples(self, q=q)
        rest = np.zeros((len(samples[0]), self.nv))
        return samples.restore(self._torques(samples[0], rest, rest))

    def inverse_dynamics(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[np.ndarray, "*batch nv"]:
        """The simulator's own, see the class."""
        samples = host_samples(self, q=q, v=v, a=a)
        return samples.restore(self._torques(samples[0], samples[1], samples[2]))

    def forward_dynamics(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], tau: Float[ArrayLike, "*batch nv"]
    ) -> Float[np.ndarray, "*batch nv"]:
        """Solve with the mass matrix, in float64, for the torques less those without acceleration.

        Raises `InputError` where a joint moves no mass.
        """
        samples = host_samples(self, q=q, v=v, tau=tau)
        q, v, tau = samples
        bias = self._torques(q, v, np.zeros_like(v))
        try:
            return samples.restore(np.linalg.solve(self._masses(q), (tau - bias)[..., None])[..., 0])
        except np.linalg.LinAlgError:
            raise InputError(
                f"robot '{self.robot.name}': a joint moves no mass, so its torque does not determine its acceleration; "
                "give its link an inertia"
            ) from None
