"""Pinocchio, the reference of the core's tests, by functions of a model and a state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from figaroh_jax_pinocchio import PinocchioBackend

from figaroh_jax.rigid.model import RobotModel

__all__ = ["build", "forward_dynamics", "forward_kinematics", "inverse_dynamics", "mass_matrix", "regressor"]


def build(model: RobotModel) -> Any:
    """The `pinocchio.Model`: joint i of the robot is its joint i + 1."""
    return PinocchioBackend.build(model).simulator


def forward_kinematics(model: RobotModel, q: Any) -> np.ndarray:
    """Poses of all tree joints (revolute and prismatic ones) in the world."""
    robot, q = build(model), np.asarray(q, float)
    data, columns = robot.createData(), [joint.coordinate for joint in model.joints]
    poses = []
    for position in q.reshape(-1, model.nq)[:, columns] * np.asarray(model.ratio) + np.asarray(model.offset):
        pin.forwardKinematics(robot, data, position)
        poses.append([pose.homogeneous for pose in list(data.oMi)[1:]])
    return np.array(poses).reshape(*q.shape[:-1], len(model.joints), 4, 4)


def inverse_dynamics(model: RobotModel, q: Any, v: Any, a: Any) -> np.ndarray:
    """Torques of the rigid body."""
    return np.asarray(PinocchioBackend.build(model).inverse_dynamics(q, v, a))


def forward_dynamics(model: RobotModel, q: Any, v: Any, tau: Any) -> np.ndarray:
    """Accelerations of the rigid body."""
    return np.asarray(PinocchioBackend.build(model).forward_dynamics(q, v, tau))


def mass_matrix(model: RobotModel, q: Any) -> np.ndarray:
    """Mass matrix of the rigid body."""
    return np.asarray(PinocchioBackend.build(model).mass_matrix(q))


def regressor(model: RobotModel, q: Any, v: Any, a: Any) -> np.ndarray:
    """Joint-torque regressor."""
    return np.asarray(PinocchioBackend.build(model).joint_torque_regressor(q, v, a))
