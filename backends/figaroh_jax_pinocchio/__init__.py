"""Pinocchio behind the signatures of figaroh_jax: the reference that the core is compared with.

The Pinocchio model is built from the arrays of a `RobotModel`, never from a file, so that a changed model is compared
too. Samples are computed one after another in float64; nothing here can be differentiated. Mimic joints are joints of
their own in Pinocchio: a matrix maps coordinates to joints.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
from jax.typing import ArrayLike
from jaxtyping import Float

from figaroh_jax.inertia import to_com
from figaroh_jax.kinematics import check_shapes
from figaroh_jax.model import RobotModel

__all__ = [
    "build",
    "forward_dynamics",
    "forward_kinematics",
    "inverse_dynamics",
    "joint_torque_regressor",
    "mass_matrix",
]


def build(model: RobotModel) -> Any:
    """The `pinocchio.Model` of the tree: joint i of the model is Pinocchio's joint i + 1."""
    result = pin.Model()
    result.name = model.name
    result.gravity.linear = np.asarray(model.gravity, float)
    for i, joint in enumerate(model.joints):
        kind = pin.JointModelRevoluteUnaligned if joint.kind == "revolute" else pin.JointModelPrismaticUnaligned
        placement = pin.SE3(np.asarray(model.placement[i], float))
        index = result.addJoint(joint.parent + 1, kind(np.asarray(model.axis[i], float)), placement, joint.name)
        mass, com, about_com = to_com(np.asarray(model.inertia[i], float))
        result.appendBodyToJoint(index, pin.Inertia(float(mass), com, about_com), pin.SE3.Identity())
    return result


def forward_kinematics(model: RobotModel, q: Float[ArrayLike, "*batch nv"]) -> Float[np.ndarray, "*batch nj 4 4"]:
    """Poses `world_T_joint` of all tree joints."""

    def one(robot: Any, data: Any, q: np.ndarray) -> np.ndarray:
        pin.forwardKinematics(robot, data, q)
        return np.array([pose.homogeneous for pose in list(data.oMi)[1:]])

    return _each(model, one, q=q)


def inverse_dynamics(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nv"],
    v: Float[ArrayLike, "*batch nv"],
    a: Float[ArrayLike, "*batch nv"],
) -> Float[np.ndarray, "*batch nv"]:
    """Torques that give the rigid body the accelerations `a`."""
    share = _share(model)
    return _each(model, lambda robot, data, *x: share.T @ pin.rnea(robot, data, *x), q=q, v=v, a=a)


def mass_matrix(model: RobotModel, q: Float[ArrayLike, "*batch nv"]) -> Float[np.ndarray, "*batch nv nv"]:
    """Mass matrix of the rigid body."""
    share = _share(model)
    return _each(model, lambda robot, data, q: share.T @ _crba(robot, data, q) @ share, q=q)


def forward_dynamics(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nv"],
    v: Float[ArrayLike, "*batch nv"],
    tau: Float[ArrayLike, "*batch nv"],
) -> Float[np.ndarray, "*batch nv"]:
    """Accelerations that the torques `tau` give the rigid body: articulated bodies, or a solve with mimic joints."""
    if len(model.joints) == model.nv:
        share = _share(model)
        return _each(model, lambda *x: share.T @ pin.aba(*x), q=q, v=v, tau=tau)
    bias = inverse_dynamics(model, q, v, np.zeros(np.shape(v)))
    return np.linalg.solve(mass_matrix(model, q), (np.asarray(tau) - bias)[..., None])[..., 0]


def joint_torque_regressor(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nv"],
    v: Float[ArrayLike, "*batch nv"],
    a: Float[ArrayLike, "*batch nv"],
) -> Float[np.ndarray, "*batch nv columns"]:
    """Matrix that the inertial parameters of all links, ten a link in tree order, map to the torques."""
    share = _share(model)

    def one(robot: Any, data: Any, *x: np.ndarray) -> np.ndarray:
        return share.T @ pin.computeJointTorqueRegressor(robot, data, *x)

    return _each(model, one, q=q, v=v, a=a)


def _crba(robot: Any, data: Any, q: np.ndarray) -> np.ndarray:
    upper = np.triu(pin.crba(robot, data, q))
    return upper + np.triu(upper, 1).T


def _share(model: RobotModel) -> Float[np.ndarray, "nj nv"]:
    """Rate of each joint for a unit rate of each coordinate."""
    share = np.zeros((len(model.joints), model.nv))
    share[np.arange(len(model.joints)), [joint.coordinate for joint in model.joints]] = np.asarray(model.ratio)
    return share


def _each(model: RobotModel, function: Callable[..., np.ndarray], **arrays: ArrayLike) -> np.ndarray:
    """`function(pinocchio model, data, q, ...)` of every sample, in Pinocchio's joints."""
    check_shapes(model, **arrays)
    robot, share = build(model), _share(model)
    data = robot.createData()
    first, *rates = (np.asarray(array, float) for array in arrays.values())
    batch = first.shape[:-1]
    columns = [first @ share.T + np.asarray(model.offset), *(rate @ share.T for rate in rates)]
    samples = zip(*(x.reshape(-1, len(share)) for x in columns), strict=True)
    answers = np.array([function(robot, data, *sample) for sample in samples])
    return answers.reshape(*batch, *answers.shape[1:])
