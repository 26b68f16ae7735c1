"""This library's own dynamics behind the contract of backends."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import jax
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..errors import InputError
from ..rigid import derivatives, dynamics, kinematics, regressor
from ..rigid.derivatives import TorqueDerivatives
from ..rigid.model import RobotModel
from .contract import Backend, Capabilities, Reference, as_reference, file_format, tried

__all__ = ["NativeBackend", "as_backend"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NativeBackend(Backend):
    """A pytree around a `RobotModel`: every function can be differentiated by its leaves, mapped and compiled."""

    name: ClassVar[str] = "native"
    capabilities: ClassVar[Capabilities] = Capabilities(differentiable=True, batch="vectorised", gpu=True)

    model: RobotModel
    file_format: str = field(default="model", metadata={"static": True})

    @classmethod
    def build(cls, robot: RobotModel, source: Path | None = None) -> NativeBackend:
        """The backend of a robot; the arrays are those of `robot`, whatever file they came from."""
        return cls(robot, file_format(source))

    @property
    def robot(self) -> RobotModel:
        """The robot."""
        return self.model

    @property
    def model_format(self) -> str:
        """Format of the file that the robot was read from; `model` where there was none."""
        return self.file_format

    @property
    def simulator(self) -> RobotModel:
        """The `RobotModel` itself."""
        return self.model

    def mass_matrix(self, q: Float[ArrayLike, "*batch nq"]) -> Float[Array, "*batch nv nv"]:
        """See `dynamics.mass_matrix`."""
        return dynamics.mass_matrix(self.robot, q)

    def coriolis_matrix(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"]
    ) -> Float[Array, "*batch nv nv"]:
        """See `derivatives.coriolis_matrix`."""
        return derivatives.coriolis_matrix(self.robot, q, v)

    def gravity_vector(self, q: Float[ArrayLike, "*batch nq"]) -> Float[Array, "*batch nv"]:
        """See `derivatives.gravity_vector`."""
        return derivatives.gravity_vector(self.robot, q)

    def inverse_dynamics(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[Array, "*batch nv"]:
        """See `dynamics.inverse_dynamics`."""
        return dynamics.inverse_dynamics(self.robot, q, v, a)

    def forward_dynamics(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], tau: Float[ArrayLike, "*batch nv"]
    ) -> Float[Array, "*batch nv"]:
        """See `dynamics.forward_dynamics`."""
        return dynamics.forward_dynamics(self.robot, q, v, tau)

    def frame_placements(self, q: Float[ArrayLike, "*batch nq"]) -> Float[Array, "*batch frames 4 4"]:
        """See `kinematics.frame_placements`."""
        return kinematics.frame_placements(self.robot, q)

    def frame_jacobian(
        self, q: Float[ArrayLike, "*batch nq"], frame: str, reference: Reference = "local_world_aligned"
    ) -> Float[Array, "*batch 6 nv"]:
        """See `kinematics.frame_jacobian`."""
        return kinematics.frame_jacobian(self.robot, q, frame, as_reference(reference))

    def joint_torque_regressor(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[Array, "*batch nv columns"]:
        """See `regressor.joint_torque_regressor`."""
        return regressor.joint_torque_regressor(self.robot, q, v, a)

    def dynamics_derivatives(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> TorqueDerivatives:
        """See `derivatives.dynamics_derivatives`."""
        return derivatives.dynamics_derivatives(self.robot, q, v, a)


def as_backend(model: RobotModel | Backend) -> Backend:
    """The backend itself, or `native` for a plain robot."""
    if isinstance(model, RobotModel):
        return NativeBackend(model)
    if not (isinstance(getattr(model, "robot", None), RobotModel) and hasattr(model, "joint_torque_regressor")):
        told = f"the text '{model[:100]}'" if isinstance(model, str) else f"of type {type(model).__name__}"
        raise InputError(
            f"model is {told}; a RobotModel or a backend of one is expected: load_urdf reads one, an ExtendedModel"
            " holds one as `.robot`"
        )
    return tried(model)
