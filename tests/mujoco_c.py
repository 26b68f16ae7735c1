"""MuJoCo C as a reference: an MJCF file at states and torques of our model of it.

The translation is written here a second time, on purpose: T maps our v to MuJoCo's qvel (joint by joint, by name), so
that torques go back by its transpose and accelerations by T a + dT/dt v.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from figaroh_jax.mjcf import joint_names
from figaroh_jax.model import RobotModel


class Reference(NamedTuple):
    """A compiled file and our model of it."""

    mj: Any
    data: Any
    model: RobotModel

    def set(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Give MuJoCo our state; returns T and dT/dt v."""
        self.data.qpos[:] = self.mj.qpos0
        T, rest = np.zeros((self.mj.nv, self.model.nv)), np.zeros(self.mj.nv)
        for i, joint in enumerate(self.model.joints):
            j = joint_names(self.mj).index(joint.name)
            numbers, at, dof = q[self.model.dofs.positions[i]], self.mj.jnt_qposadr[j], self.mj.jnt_dofadr[j]
            if joint.kind in ("revolute", "prismatic"):
                ratio = float(self.model.ratio[i])
                self.data.qpos[at] = ratio * numbers[0] + float(self.model.offset[i])
                T[dof, joint.coordinate] = ratio
                continue
            quaternion, count = np.roll(numbers[-4:], 1), len(numbers) - 1
            self.data.qpos[at : at + len(numbers)] = [*numbers[:-4], *quaternion]
            T[dof : dof + count, joint.coordinate : joint.coordinate + count] = np.eye(count)
            if joint.kind == "free":
                R = np.zeros(9)
                mujoco.mju_quat2Mat(R, quaternion)
                R, own = R.reshape(3, 3), v[joint.coordinate : joint.coordinate + 6]
                T[dof : dof + 3, joint.coordinate : joint.coordinate + 3] = R
                rest[dof : dof + 3] = R @ np.cross(own[3:], own[:3])
        self.data.qvel[:], self.data.qacc[:] = T @ v, T @ a + rest
        return T, rest

    def torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Torques of the drives (`mj_inverse`: the rigid body, armature and passive forces)."""
        T, _ = self.set(q, v, a)
        mujoco.mj_inverse(self.mj, self.data)
        return T.T @ self.data.qfrc_inverse

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        T, _ = self.set(q, np.zeros(self.model.nv), np.zeros(self.model.nv))
        mujoco.mj_forward(self.mj, self.data)
        columns = np.zeros_like(T)
        for column, unit in zip(columns.T, T.T, strict=True):
            answer = np.zeros(self.mj.nv)
            mujoco.mj_mulM(self.mj, self.data, answer, np.ascontiguousarray(unit))
            column[:] = answer
        return T.T @ columns


def load(path: Path, model: RobotModel, passive: bool) -> Reference:
    """The file without contacts, limits and couplings, and without what acts at the joints where that is not asked."""
    mj = mujoco.MjModel.from_xml_path(str(path))
    for flag in ("CONTACT", "LIMIT", "EQUALITY"):
        mj.opt.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}")
    if not passive:
        mj.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
        mj.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SPRING | mujoco.mjtDisableBit.mjDSBL_DAMPER
        mj.body_gravcomp[:] = 0
        mj.dof_armature[:] = 0
        mj.tendon_armature[:] = 0
        mj.actuator_armature[:] = 0
    return Reference(mj, mujoco.MjData(mj), model)


def states(model: RobotModel, samples: int, seed: int | None = None) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Random states, quaternions of length one."""
    rng = np.random.default_rng(seed)
    q, v, a = (rng.uniform(-2.0, 2.0, (samples, n)) for n in (model.nq, model.nv, model.nv))
    for joint, at in zip(model.joints, model.dofs.positions, strict=True):
        if joint.kind in ("spherical", "free"):
            turn = q[:, at.stop - 4 : at.stop]
            turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    return list(zip(q, v, a, strict=True))
