"""Postures and what a device measures of a robot that differs from its URDF, made with Pinocchio alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

_LIMIT = '<limit lower="-3" upper="3" effort="100" velocity="3"/>'
_CHAIN = (  # name, xyz, rpy, axis, mass and centre of mass of the moved link
    ("j1", "0 0 0.3", "0 0 0", "0 0 1", 4.0, "0 0.02 0.1"),
    ("j2", "0.05 0 0.2", "-1.5708 0 0", "0 0 1", 5.0, "0.2 0 0.05"),
    ("j3", "0.4 0 0", "0 0 0", "0 0 1", 3.0, "0.1 0.03 0"),
    ("j4", "0.05 0.35 0", "-1.5708 0.2 0", "0 0 1", 1.5, "0 0 0.05"),
    ("j5", "0 0.02 0.1", "1.5708 0 0", "0 0 1", 1.0, "0 0.05 0"),
    ("j6", "0 -0.1 0.02", "1.5708 0 0.3", "0 0 1", 0.5, "0 0 0.06"),
)
JOINTS = tuple(part[0] for part in _CHAIN)


def urdf() -> str:
    """A six-joint arm with links that weigh, frames `base` and `tool0`."""
    text = '<robot name="arm6"><link name="base"/>'
    parent = "base"
    for name, xyz, rpy, axis, mass, com in _CHAIN:
        child = f"link_{name}"
        inertia = f'<inertia ixx="{0.02 * mass}" iyy="{0.02 * mass}" izz="{0.01 * mass}" ixy="0" ixz="0" iyz="0"/>'
        text += f'<link name="{child}"><inertial><origin xyz="{com}"/><mass value="{mass}"/>{inertia}</inertial></link>'
        text += f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        text += f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{_LIMIT}</joint>'
        parent = child
    text += f'<link name="tool0"/><joint name="flange" type="fixed"><parent link="{parent}"/><child link="tool0"/>'
    return text + '<origin xyz="0.02 0 0.08" rpy="0.1 0 0.2"/></joint></robot>'


class Truth(NamedTuple):
    """What the real robot and its device are."""

    offset: np.ndarray  # rad, added to what the encoders say
    twists: dict[str, np.ndarray]  # of the joints' placements, translation then rotation, m and rad
    base: pin.SE3  # of the robot in the device's frame
    markers: np.ndarray  # (markers, 3) in the tool frame, m
    compliance: np.ndarray  # rad/(N m)


def truth(rng: np.random.Generator, markers: int = 3, **changes: Any) -> Truth:
    """A robot as its URDF says, a device somewhere beside it; `changes` says what is different."""
    base = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
    spots = np.array([[0.05, 0.02, 0.1], [-0.06, 0.03, 0.08], [0.01, -0.07, 0.12]])[:markers]
    return Truth(np.zeros(6), {}, base, spots, np.zeros(6))._replace(**changes)


def postures(rng: np.random.Generator, count: int) -> np.ndarray:
    """Random postures over two thirds of the range."""
    return rng.uniform(-2.0, 2.0, (count, 6))


def tool_poses(
    path: Path, q: np.ndarray, real: Truth, error: Callable[[int], np.ndarray] | None = None
) -> list[pin.SE3]:
    """Poses of the tool frame in the device's frame for encoder positions q; `error(k)` is added to the joints."""
    robot = pin.buildModelFromUrdf(str(path))
    still = robot.copy()
    for name, twist in real.twists.items():
        joint = robot.getJointId(name)
        robot.jointPlacements[joint] = robot.jointPlacements[joint] * pin.SE3(pin.exp3(twist[3:]), twist[:3])
    data, tool = robot.createData(), robot.getFrameId("tool0")
    weight = still.createData()
    poses = []
    for k, x in enumerate(q):
        sag = -real.compliance * pin.computeGeneralizedGravity(still, weight, x)
        pin.framesForwardKinematics(robot, data, x + real.offset + sag + (0.0 if error is None else error(k)))
        poses.append(real.base * data.oMf[tool])
    return poses


def points(poses: list[pin.SE3], real: Truth, rng: np.random.Generator, noise: float = 1e-4) -> np.ndarray:
    """Markers (postures, markers, 3) in the device's frame, with white noise (m)."""
    exact = np.array([[pose.act(marker) for marker in real.markers] for pose in poses])
    return exact + noise * rng.normal(size=exact.shape)
