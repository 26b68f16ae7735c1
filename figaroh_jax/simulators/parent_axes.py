"""Coordinates of simulators that keep the velocity of free, spherical and planar joints in the axes of the parent.

Newton and Genesis write q as this library does (tree order, quaternions apart), with a coordinate for each degree of
freedom of the tree, mimic joints included. Their velocities of joints with several degrees of freedom are in the axes
of the parent (Genesis: the angular ones in the body's), the linear one of a free joint that of the body's origin
(Genesis) or of its centre of mass (Newton). So `qd = J(q) v`,
`qdd = J(q) a + drift(q, v)`, and our torques are `J' f`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..formats.mujoco_model import quaternion_matrix
from ..rigid.inertia import from_com
from ..rigid.model import NUMBERS, RobotModel

__all__ = ["Rates", "numbers", "rates", "refuse_inner_free_joints", "unit_inertias", "unit_regressor"]


class Rates(NamedTuple):
    """From our velocities to the simulator's."""

    share: Float[np.ndarray, "n dofs nv"]  # J
    drift: Float[np.ndarray, "n dofs"]  # qdd where a is zero


def refuse_inner_free_joints(robot: RobotModel, backend: str) -> None:
    """Raise `InputError` for a free joint that another joint carries: the simulator has no such joint."""
    for joint in robot.joints:
        if joint.kind == "free" and joint.parent >= 0:
            carrier = robot.joints[joint.parent].name
            raise InputError(
                f"backend '{backend}' has free joints of the world alone; '{joint.name}' hangs on '{carrier}': "
                "choose native, mujoco or pinocchio"
            )


def numbers(robot: RobotModel, q: Float[np.ndarray, "n nq"]) -> list[Float[np.ndarray, "n k"]]:
    """The numbers of each tree joint in q: a mimic joint has its own."""
    parts = []
    for joint, at, ratio, offset in zip(robot.joints, robot.dofs.positions, robot.ratio, robot.offset, strict=True):
        own = q[:, at.start : at.start + NUMBERS[joint.kind]]
        parts.append(float(ratio) * own + float(offset) if joint.kind in ("revolute", "prismatic") else own)
    return parts


def rates(
    robot: RobotModel,
    q: Float[np.ndarray, "n nq"],
    v: Float[np.ndarray, "n nv"],
    centres: bool = False,
    own_turning: bool = False,
) -> Rates:
    """J and drift; with `centres` the linear velocity of a free joint is that of its link's centre of mass.

    `own_turning`: the angular velocity of free and spherical joints is in the axes of the body.
    """
    share = np.zeros((len(q), robot.nd, robot.nv))
    share[:, np.arange(robot.nd), robot.dofs.column] = np.asarray(robot.ratio)[robot.dofs.joint]
    drift = np.zeros((len(q), robot.nd))
    for i, joint in enumerate(robot.joints):
        first, at, column = int(robot.dofs.first[i]), robot.dofs.positions[i], joint.coordinate
        if joint.kind == "planar":
            c, s = np.cos(q[:, at.stop - 1]), np.sin(q[:, at.stop - 1])
            turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
            share[:, first : first + 2, column : column + 2] = turn
            x, y, w = v[:, column : column + 3].T
            drift[:, first : first + 2] = (turn @ np.stack([-w * y, w * x], -1)[..., None])[..., 0]
        turn = np.eye(3)
        if joint.kind in ("free", "spherical"):
            quaternion = q[:, at.stop - 4 : at.stop]
            turn = quaternion_matrix(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))
            width = 6 if joint.kind == "free" else 3
            angular = slice(first + width - 3, first + width), slice(column + width - 3, column + width)
            share[:, *angular] = np.eye(3) if own_turning else turn
        if joint.kind == "free":
            mass = float(robot.inertia[i][0])
            centre = np.asarray(robot.inertia[i][1:4], float) / mass if centres and mass else np.zeros(3)
            share[:, first : first + 3, column : column + 3] = turn
            share[:, first : first + 3, column + 3 : column + 6] = -turn @ _cross(centre)
            linear, spin = v[:, column : column + 3], v[:, column + 3 : column + 6]
            moved = np.cross(spin, linear + np.cross(spin, centre))
            drift[:, first : first + 3] = (turn @ moved[..., None])[..., 0]
    return Rates(share, drift)


def unit_inertias(links: int, only: tuple[int, int]) -> Float[np.ndarray, "links 10"]:
    """Inertias of a robot of one link with one of its ten parameters; for a first moment a point mass at one metre."""
    link, k = only
    parameters = np.zeros((links, 10))
    if 1 <= k <= 3:
        parameters[link] = from_com(1.0, np.eye(3)[k - 1], np.zeros((3, 3)))
    else:
        parameters[link, k] = 1.0
    return parameters


def unit_regressor(
    torques: Callable[[tuple[int, int]], Float[np.ndarray, "n nv"]], links: int
) -> Float[np.ndarray, "n nv columns"]:
    """The regressor by the torques of robots with the inertias of `unit_inertias`.

    Torques are linear in the ten parameters of a link, so ten runs a link give its columns. The column of a first
    moment is that of the point mass less its mass and its moments of inertia.
    """
    columns = np.stack([torques((link, k)) for link in range(links) for k in range(10)], axis=-1)
    columns = columns.reshape(*columns.shape[:-1], links, 10)
    xx, yy, zz = (columns[..., k] for k in (4, 6, 9))
    for k, others in enumerate((yy + zz, xx + zz, xx + yy)):
        columns[..., 1 + k] -= columns[..., 0] + others
    return columns.reshape(*columns.shape[:2], -1)


def _cross(x: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    return np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])
