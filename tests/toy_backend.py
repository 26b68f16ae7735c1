"""A backend as a third party would write it: a pendulum's textbook formula, for robots of one revolute joint."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from figaroh_jax.errors import InputError
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.simulators.contract import FUNCTIONS, Backend, Capabilities, host_samples

GIVEN = {"inverse_dynamics", "mass_matrix", "integrate", "difference", "random_configuration"}


class ToyBackend(Backend):
    name: ClassVar[str] = "toy"
    capabilities: ClassVar[Capabilities] = Capabilities(lacking=frozenset(FUNCTIONS) - GIVEN)

    def __init__(self, robot: RobotModel) -> None:
        if [joint.kind for joint in robot.joints] != ["revolute"]:
            raise InputError("backend 'toy' takes robots of one revolute joint")
        self._robot = robot

    @classmethod
    def build(cls, robot: RobotModel, source: Path | None = None) -> ToyBackend:
        return cls(robot)

    @property
    def robot(self) -> RobotModel:
        return self._robot

    @property
    def simulator(self) -> Any:
        return "a formula"

    @property
    def model_format(self) -> str:
        return "model"

    def mass_matrix(self, q: Any) -> np.ndarray:
        (positions,) = samples = host_samples(self, q=q)
        return samples.restore(np.full((len(positions), 1, 1), self._robot.inertia[0, 9]))

    def inverse_dynamics(self, q: Any, v: Any, a: Any) -> np.ndarray:
        """I a + m g l sin(q), for an axis z and gravity along x at zero and a centre of mass on x."""
        q, _, a = samples = host_samples(self, q=q, v=v, a=a)
        weight = self._robot.inertia[0, 1] * (self._robot.placement[0, :3, 0] @ self._robot.gravity)
        return samples.restore(self._robot.inertia[0, 9] * a + weight * np.sin(q))
