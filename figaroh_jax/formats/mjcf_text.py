"""Robots as MJCF text, MuJoCo's format, from a `RobotModel` and what acts at its joints.

A body stands where the frame of its link's name is, its joint anchored where the joint is. Frames are sites, motors one
actuator a joint whose control is the torque. A planar joint is two slides and a hinge; a free joint that does not
stand on the world is three slides and a ball. No meshes, no geoms, no contacts.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..rigid.inertia import to_com, transform
from ..rigid.model import RobotModel
from .assembly import translation
from .native import Drives, physical_inertia
from .xmlfile import as_text

__all__ = ["mjcf_text"]

_KIND = {"revolute": "hinge", "prismatic": "slide", "spherical": "ball", "free": "free"}
_FULL = ([0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2])  # MuJoCo's order of the six moments


def mjcf_text(robot: RobotModel, drives: Drives) -> tuple[str, tuple[str, ...]]:
    """MJCF of the robot with its drives, and warnings on what could not be written as it is."""
    root = ET.Element("mujoco", model=robot.name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    gravity = np.asarray(robot.gravity)
    ET.SubElement(root, "option", gravity=as_text(gravity), timestep="0.001", integrator="implicitfast")
    bodies = {-1: ET.SubElement(root, "worldbody")}
    anchor = {-1: np.zeros(3)} | {index: _anchor(robot, index) for index in range(len(robot.joints))}
    warnings = []
    for index, joint in enumerate(robot.joints):
        placement = translation(anchor[joint.parent]) @ np.asarray(robot.placement[index]) @ translation(-anchor[index])
        attributes = {"name": joint.link} | _pose(placement)
        if drives.gravcomp[index]:
            attributes["gravcomp"] = repr(float(drives.gravcomp[index]))
        bodies[index] = body = ET.SubElement(bodies[joint.parent], "body", attributes)
        inertia, warning = physical_inertia(np.asarray(robot.inertia[index]), "mjcf")
        if warning:
            warnings.append(f"robot.xml: link {joint.link} {warning}")
        ET.SubElement(body, "inertial", _inertial(transform(inertia, translation(anchor[index]))))
        for attributes in _joints(robot, index, drives):
            ET.SubElement(body, "joint", attributes | {"pos": as_text(anchor[index])})
    for frame, placement in zip(robot.frames, robot.frame_placement, strict=True):
        pose = _pose(translation(anchor[frame.parent]) @ np.asarray(placement))
        ET.SubElement(bodies[frame.parent], "site", {"name": frame.name} | pose)
    _tendons(root, robot, drives)
    warnings += _followers(root, robot)
    actuators = ET.SubElement(root, "actuator")
    for joint in robot.joints:
        if joint.kind in ("revolute", "prismatic") and not joint.follows:
            limit, bias = robot.effort_limit[joint.coordinate], drives.bias[joint.coordinate]
            ET.SubElement(actuators, "general", _motor(joint.name, float(limit), float(bias)))
        elif joint.kind not in ("revolute", "prismatic"):
            warnings.append(f"robot.xml: the {joint.kind} joint {joint.name} has no actuator")
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n", tuple(warnings)


def _pose(pose: ArrayLike) -> dict[str, str]:
    placement = np.asarray(pose)
    return {"pos": as_text(placement[:3, 3]), "quat": as_text(_quaternion(placement[:3, :3]))}


def _quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Unit quaternion w, x, y, z: the eigenvector of the largest eigenvalue (Bar-Itzhack 2000), accurate everywhere."""
    r = rotation
    w = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[0, 1:], matrix[1:, 0] = np.trace(r), w, w
    matrix[1:, 1:] = r + r.T - np.trace(r) * np.eye(3)
    q = np.linalg.eigh(matrix)[1][:, -1]
    return q if q[0] >= 0 else -q


def _anchor(robot: RobotModel, index: int) -> Float[np.ndarray, "3"]:
    """Where the joint is in its body: off the origin where the link's name is that of a frame shifted against it."""
    joint = robot.joints[index]
    for frame, placement in zip(robot.frames, robot.frame_placement, strict=True):
        if frame.name == joint.link and frame.parent == index and joint.kind != "free":
            pose = np.asarray(placement)
            return -pose[:3, 3] if np.array_equal(pose[:3, :3], np.eye(3)) else np.zeros(3)
    return np.zeros(3)


def _inertial(parameters: Float[np.ndarray, "10"]) -> dict[str, str]:
    mass, com, inertia = to_com(parameters)
    return {"mass": repr(float(mass)), "pos": as_text(com), "fullinertia": as_text(inertia[_FULL])}


def _joints(robot: RobotModel, index: int, drives: Drives) -> list[dict[str, str]]:
    """Attributes of the MuJoCo joints that stand for a tree joint."""
    joint, first = robot.joints[index], int(robot.dofs.first[index])
    if joint.kind == "planar":
        parts = [(f"{joint.name}_x", "prismatic", 0), (f"{joint.name}_y", "prismatic", 1), (joint.name, "revolute", 2)]
    elif joint.kind == "free" and not _is_root(robot, index):
        slides = [(f"{joint.name}_{axis}", "prismatic", k) for k, axis in enumerate("xyz")]
        parts = [*slides, (joint.name, "spherical", 3)]
    else:
        parts = [(joint.name, joint.kind, 0)]
    return [_joint(robot, index, (name, _KIND[kind]), first + dof, drives) for name, kind, dof in parts]


def _is_root(robot: RobotModel, index: int) -> bool:
    """Whether MuJoCo's free joint says the same, whose numbers are the pose in the world."""
    return robot.joints[index].parent < 0 and np.array_equal(np.asarray(robot.placement[index]), np.eye(4))


def _joint(robot: RobotModel, index: int, joint: tuple[str, str], dof: int, drives: Drives) -> dict[str, str]:
    name, kind = joint
    element = {"name": name, "type": kind}
    if kind in ("hinge", "slide"):
        element["axis"] = as_text(robot.axis[dof])
    if robot.joints[index].follows:
        return element  # its drive is that of the joint that it follows
    column = robot.dofs.column[dof]
    limit = np.asarray(robot.position_limit[column])
    if kind in ("hinge", "slide") and np.isfinite(limit).any() and limit[0] < limit[1]:
        element["range"] = as_text(np.clip(limit, -1e10, 1e10))
    for attribute in ("armature", "damping", "frictionloss", "stiffness", "springref"):
        if (value := getattr(drives, attribute)[column]) != 0:
            element[attribute] = repr(float(value))
    if drives.damping2[column] or drives.damping3[column]:  # MuJoCo's damping is of v, v |v| and v^3
        element["damping"] = as_text([drives.damping[column], drives.damping2[column], drives.damping3[column]])
    return element


def _motor(name: str, limit: float, bias: float) -> dict[str, str]:
    """A torque motor; a torque of the drive that does not reach the joint is taken off."""
    element = {"name": name, "joint": name, "gainprm": "1"}
    if 0 < limit < np.inf:
        element["ctrlrange"] = as_text(np.array([-limit, limit]))
    if bias != 0:
        element |= {"biastype": "affine", "biasprm": as_text(np.array([-bias, 0.0, 0.0]))}
    return element


def _tendons(root: ET.Element, robot: RobotModel, drives: Drives) -> None:
    if not drives.tendons:
        return
    group = ET.SubElement(root, "tendon")
    for tendon in drives.tendons:
        names = [robot.dof_names[place] for place in tendon.at]
        values = {k: repr(float(getattr(tendon, k))) for k in ("armature", "damping", "frictionloss")}
        fixed = ET.SubElement(group, "fixed", {"name": "-".join(names) + f"{tendon.sign:+.0f}"} | values)
        for name, factor in zip(names, (1.0, tendon.sign), strict=True):
            ET.SubElement(fixed, "joint", joint=name, coef=repr(factor))


def _followers(root: ET.Element, robot: RobotModel) -> list[str]:
    """Mimic joints: equality constraints, which MuJoCo keeps softly."""
    followers = [i for i, joint in enumerate(robot.joints) if joint.follows]
    if not followers:
        return []
    group = ET.SubElement(root, "equality")
    for index in followers:
        joint = robot.joints[index]
        polynomial = np.array([robot.offset[index], robot.ratio[index], 0, 0, 0], float)
        leader = robot.dof_names[joint.coordinate]
        ET.SubElement(group, "joint", joint1=joint.name, joint2=leader, polycoef=as_text(polynomial))
    names = ", ".join(robot.joints[index].name for index in followers)
    return [f"robot.xml: {names} follow other joints by equality constraints, which MuJoCo keeps softly"]
