"""MuJoCo C behind the contract of figaroh_jax; regressors of large robots on threads, each with its own `MjData`.

Given an MJCF file, the functions compute with the model that MuJoCo compiles from it, given anything else with one
built from the robot's arrays (`figaroh_jax.formats.mujoco_model`, which also translates the coordinates). Only MuJoCo's
functions of rigid bodies are called (`mj_kinematics`, `mj_comPos`, `mj_comVel`, `mj_rne`, `mj_crb`), with armature
zero: contacts, constraints, damping, springs and actuators never enter. Nothing here can be differentiated, and MuJoCo
C has derivatives by finite differences alone, so `dynamics_derivatives` is not supported.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from figaroh_jax.formats.mujoco_model import (
    compiled,
    drift,
    joint_poses,
    link_inertias,
    positions,
    rates,
    spatial_inertias,
)
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.simulators.contract import Capabilities, host_samples
from figaroh_jax.simulators.host import HostBackend

__all__ = ["MujocoBackend"]

_CHUNK = 64  # samples of a task: what they need stays in the cache
# Each call of MuJoCo gives Python's lock away and takes it back. Threads pay where the calls are long: a regressor of
# TALOS (33 bodies) gains half, inverse dynamics of a 6-joint arm would take four times as long.
_MANY_BODIES = 16


class MujocoBackend(HostBackend):
    """A `mujoco.MjModel`: `simulator` is the user's own, with contacts and all, where an MJCF file was given.

    The model is compiled from the file where that is MJCF, else built from the robot's arrays. Mass matrix by `mj_crb`,
    torques by `mj_rne`, poses by `mj_kinematics`, Jacobians by `mj_jac`.
    """

    name: ClassVar[str] = "mujoco"
    capabilities: ClassVar[Capabilities] = Capabilities(
        batch="threads", contact=True, lacking=frozenset({"dynamics_derivatives"})
    )

    def __init__(self, robot: RobotModel, source: Path | None = None) -> None:
        super().__init__(robot, source)
        self._simulator, self._translation, _ = compiled(robot, source)
        self._rigid = copy.copy(self._simulator)
        self._rigid.dof_armature[:] = 0.0
        bodies = np.eye(self._rigid.nbody)
        for body in range(1, self._rigid.nbody):
            bodies[self._rigid.body_parentid[body], body] -= 1.0
        self._own_wrench = bodies[self._translation.body]  # what a body carries, less what its children carry

    @property
    def simulator(self) -> Any:
        """The `mujoco.MjModel`."""
        return self._simulator

    @property
    def inertias(self) -> Float[np.ndarray, "links 10"]:
        """Inertial parameters of the links in MuJoCo's model."""
        return link_inertias(self._translation, self._simulator)

    def joint_torque_regressor(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[np.ndarray, "*batch nv columns"]:
        """MuJoCo's inverse dynamics (`mj_rnePostConstraint`) with unit parameters in the place of the inertias.

        The wrench of a link is linear in its ten parameters, so ten runs a sample give every link's, exactly; the
        joints that carry the link take it up along their axes (`cdof`).
        """
        samples = host_samples(self, q=q, v=v, a=a)
        width = 10 * len(self._robot.joints)
        answer = np.empty((len(samples[0]), self.nv, width))

        def fill(data: Any, rows: slice) -> None:
            answer[rows] = self._regressor(data, *(x[rows] for x in samples))

        self._spread(fill, len(answer), heavy=self._rigid.nbody >= _MANY_BODIES)
        return samples.restore(answer)

    def _regressor(self, data: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        model, t = self._rigid, self._translation
        wrenches = np.empty((len(q), 10, model.nbody, 6))
        axes = np.empty((len(q), model.nv, 6))
        bodies = np.empty((len(q), model.nbody, 5, 3))
        for sample, _ in enumerate(self._states(data, q)):
            bodies[sample, :, :3] = data.xmat.reshape(-1, 3, 3)
            bodies[sample, :, 3], bodies[sample, :, 4] = data.xpos, data.subtree_com[model.body_rootid]
        poses = joint_poses(t, bodies[:, :, :3], bodies[:, :, 3])
        inertias = np.zeros((len(q), 10, model.nbody, 10))
        inertias[:, :, t.body] = np.swapaxes(spatial_inertias(poses, bodies[:, t.body, 4]), 1, 2)
        for sample, _ in enumerate(self._states(data, q, v, a)):
            axes[sample], own = data.cdof, data.cinert
            for k in range(10):
                own[:] = inertias[sample, k]
                mujoco.mj_rnePostConstraint(model, data)
                wrenches[sample, k] = data.cfrc_int
        own = self._own_wrench @ wrenches
        rows = np.einsum("ndc,nklc->ndlk", axes, own, optimize=True) * t.reaches[:, :, None]
        return np.swapaxes(rates(t, q), -1, -2) @ rows.reshape(len(q), model.nv, -1)

    def _torques(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        def one(data: Any, out: np.ndarray) -> None:
            mujoco.mj_rne(self._rigid, data, 1, out)

        forces = self._each(one, (self._rigid.nv,), q, v, a)
        return (forces[:, None] @ rates(self._translation, q))[:, 0]

    def _masses(self, q: np.ndarray) -> np.ndarray:
        def one(data: Any, out: np.ndarray) -> None:
            mujoco.mj_crb(self._rigid, data)
            _full_mass(self._rigid, data, out)

        share = rates(self._translation, q)
        return np.swapaxes(share, -1, -2) @ self._each(one, (self._rigid.nv, self._rigid.nv), q) @ share

    def _point_jacobian(self, q: np.ndarray, joint: int, joints: np.ndarray, points: np.ndarray) -> np.ndarray:
        body = int(self._translation.body[joint])

        def one(data: Any, out: np.ndarray, point: np.ndarray) -> None:
            mujoco.mj_jac(self._rigid, data, out[:3], out[3:], point, body)

        return self._each(one, (6, self._rigid.nv), q, more=(points,)) @ rates(self._translation, q)

    def _joint_poses(self, q: np.ndarray) -> np.ndarray:
        def one(data: Any, out: np.ndarray) -> None:
            out[:, :3], out[:, 3] = data.xmat.reshape(-1, 3, 3), data.xpos

        bodies = self._each(one, (self._rigid.nbody, 4, 3), q)
        return joint_poses(self._translation, bodies[:, :, :3], bodies[:, :, 3])

    def _each(
        self,
        function: Callable[..., None],
        shape: tuple[int, ...],
        *state: np.ndarray,
        more: tuple[np.ndarray, ...] = (),
    ) -> np.ndarray:
        """What `function(data, out, ...)` writes into `out`, of the given shape, for every sample."""
        answer = np.empty((len(state[0]), *shape))

        def fill(data: Any, rows: slice) -> None:
            states = self._states(data, *(x[rows] for x in state))
            for _, out, *others in zip(states, answer[rows], *(x[rows] for x in more), strict=True):
                function(data, out, *others)

        self._spread(fill, len(answer))
        return answer

    def _states(
        self, data: Any, q: np.ndarray, v: np.ndarray | None = None, a: np.ndarray | None = None
    ) -> Iterator[None]:
        """Bring `data` to one sample after another: kinematics, and velocities where they are given."""
        model, t = self._rigid, self._translation
        numbers, qpos, qvel, qacc = positions(t, q), data.qpos, data.qvel, data.qacc
        if v is None or a is None:
            for row in numbers:
                qpos[:] = row
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                yield
            return
        share = rates(t, q)
        velocities = (share @ v[..., None])[..., 0]
        accelerations = (share @ a[..., None])[..., 0] + drift(t, q, v)
        for row, velocity, acceleration in zip(numbers, velocities, accelerations, strict=True):
            qpos[:], qvel[:], qacc[:] = row, velocity, acceleration
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            yield

    def _spread(self, fill: Callable[[Any, slice], None], samples: int, heavy: bool = False) -> None:
        """`fill(data, rows)` for chunks of the samples, where these are heavy on as many threads as there are cores."""
        chunks = [slice(start, start + _CHUNK) for start in range(0, samples, _CHUNK)]
        if len(chunks) <= 2 or not heavy:
            data = mujoco.MjData(self._rigid)
            for rows in chunks:
                fill(data, rows)
            return
        workers = min(len(os.sched_getaffinity(0)), len(chunks))

        def work(first: int) -> None:
            data = mujoco.MjData(self._rigid)
            for rows in chunks[first::workers]:
                fill(data, rows)

        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(work, range(workers)))


def _full_mass(model: Any, data: Any, out: np.ndarray) -> None:
    if int(mujoco.__version__.split(".")[0]) < 4:
        mujoco.mj_fullM(model, out, data.qM)
    else:
        mujoco.mj_fullM(model, data, out)
