"""MuJoCo C as a reference: an MJCF file at states and torques of our model of it.

The translation is written here a second time, on purpose: T maps our v to MuJoCo's qvel (joint by joint, by name), so
that torques go back by its transpose and accelerations by T a + dT/dt v. What our writer makes of planar and free
joints (slides and a hinge or a ball) is known here by name.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from figaroh_jax.formats.mjcf import joint_names
from figaroh_jax.rigid.model import Joint, RobotModel

_WIDTH, _NUMBERS = (6, 3, 1, 1), (7, 4, 1, 1)  # of free, ball, slide, hinge


class Reference(NamedTuple):
    """A compiled file and our model of it."""

    mj: Any
    data: Any
    model: RobotModel

    def set(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Give MuJoCo our state; returns T."""
        self.data.qpos[:] = self.mj.qpos0
        T, rest, names = np.zeros((self.mj.nv, self.model.nv)), np.zeros(self.mj.nv), joint_names(self.mj)
        for i, joint in enumerate(self.model.joints):
            numbers, at = q[self.model.dofs.positions[i]], joint.coordinate
            parts = [names.index(name) for name in _parts(joint, names)]
            dofs = np.concatenate([self.mj.jnt_dofadr[j] + np.arange(_WIDTH[self.mj.jnt_type[j]]) for j in parts])
            T[dofs, at : at + len(dofs)] = np.eye(len(dofs))
            if joint.kind in ("revolute", "prismatic"):
                ratio = float(self.model.ratio[i])
                numbers, T[dofs[0], at] = ratio * numbers + float(self.model.offset[i]), ratio
            elif joint.kind in ("planar", "free"):
                R, w = _turn(joint.kind, numbers), v[at + 2 : at + 3] if joint.kind == "planar" else v[at + 3 : at + 6]
                n = len(R)
                T[dofs[:n], at : at + n] = R
                rest[dofs[:n]] = R @ (w[0] * np.array([-v[at + 1], v[at]]) if n == 2 else np.cross(w, v[at : at + 3]))
            if joint.kind in ("spherical", "free"):
                numbers = np.concatenate([numbers[:-4], np.roll(numbers[-4:], 1)])
            places = [self.mj.jnt_qposadr[j] + np.arange(_NUMBERS[self.mj.jnt_type[j]]) for j in parts]
            self.data.qpos[np.concatenate(places)] = numbers
        self.data.qvel[:], self.data.qacc[:] = T @ v, T @ a + rest
        return T

    def torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Torques of the drives (`mj_inverse`: the rigid body, armature and passive forces)."""
        T = self.set(q, v, a)
        mujoco.mj_inverse(self.mj, self.data)
        return T.T @ self.data.qfrc_inverse

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        T = self.set(q, np.zeros(self.model.nv), np.zeros(self.model.nv))
        mujoco.mj_forward(self.mj, self.data)
        columns = np.zeros_like(T)
        for column, unit in zip(columns.T, T.T, strict=True):
            answer = np.zeros(self.mj.nv)
            mujoco.mj_mulM(self.mj, self.data, answer, np.ascontiguousarray(unit))
            column[:] = answer
        return T.T @ columns


def _parts(joint: Joint, names: list[str]) -> list[str]:
    """MuJoCo's joints of one of ours: slides stand before a hinge or a ball where there is no joint of the kind."""
    slides = [f"{joint.name}_{axis}" for axis in "xyz"]
    return [name for name in slides if name in names and joint.kind in ("planar", "free")] + [joint.name]


def _turn(kind: str, numbers: np.ndarray) -> np.ndarray:
    """Rotation of the child in the parent: in the plane, or of the quaternion."""
    if kind == "planar":
        c, s = np.cos(numbers[2]), np.sin(numbers[2])
        return np.array([[c, -s], [s, c]])
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.roll(numbers[-4:], 1))
    return matrix.reshape(3, 3)


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
