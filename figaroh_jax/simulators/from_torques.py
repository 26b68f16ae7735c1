"""Dynamics of a simulator on the host that gives torques and a mass matrix: what the contract asks beside them."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from ..errors import InputError
from ..rigid.derivatives import coriolis_from_bias
from .contract import Backend, host_samples

__all__ = ["FromTorques"]


class FromTorques(Backend):
    """A backend whose `_torques(q, v, a)` and `_masses(q)` answer for samples of the host, (samples, nq or nv)."""

    @abstractmethod
    def _torques(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> Float[np.ndarray, "samples nv"]: ...

    @abstractmethod
    def _masses(self, q: np.ndarray) -> Float[np.ndarray, "samples nv nv"]: ...

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
