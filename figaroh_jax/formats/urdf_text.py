"""Robots as URDF text: moving joints and links, frames as massless links, friction of the joints where URDF has it."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ..rigid.inertia import to_com
from ..rigid.model import Frame, RobotModel
from .native import Drives, physical_inertia
from .xmlfile import as_text

__all__ = ["roll_pitch_yaw", "urdf_text"]

_NO_LIMIT = 1e9  # rad, m, N m, ...: URDF readers in C++ refuse "inf"
_MOMENTS = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


def urdf_text(robot: RobotModel, drives: Drives) -> tuple[str, tuple[str, ...]]:
    """URDF of the robot with its drives, and warnings on what could not be written as it is.

    Links without a joint of their own and the joints that fix them come back from the model's frames: of the frames at
    one pose, the first half are joints and the second half links, as the reader puts them.
    """
    root = ET.Element("robot", name=robot.name)
    fixed, warnings = _fixed_links(robot)
    base = fixed.pop(0)[1]
    ET.SubElement(root, "link", name=base)
    links = {-1: base}
    for index, joint in enumerate(robot.joints):
        inertia, warning = physical_inertia(np.asarray(robot.inertia[index]), "urdf")
        if warning:
            warnings.append(f"robot.urdf: link {joint.link} {warning}")
        _link(root, joint.link, inertia)
        _moving(root, robot, index, links[joint.parent], drives)
        if joint.kind == "spherical":
            warnings.append(f"robot.urdf: joint {joint.name} is 'spherical', which MuJoCo reads but URDF does not have")
        links[index] = joint.link
    for name, link, parent, placement in fixed:
        ET.SubElement(root, "link", name=link)
        _joint(root, name, "fixed", (links[parent], link), placement)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n", tuple(warnings)


def _fixed_links(robot: RobotModel) -> tuple[list[tuple[str, str, int, Float[np.ndarray, "4 4"]]], list[str]]:
    """Joint, link, parent and pose of everything that does not move by itself, the base link first; and warnings."""
    moving = {name: i for i, joint in enumerate(robot.joints) for name in (joint.name, joint.link)}
    poses = [np.asarray(placement) for placement in robot.frame_placement]
    groups: list[tuple[int, np.ndarray, list[str]]] = [(-1, np.eye(4), [])]
    warnings = []
    for frame, pose in zip(robot.frames, poses, strict=True):
        name = frame.name
        if moving.get(name) == frame.parent and np.array_equal(pose, np.eye(4)):
            continue
        if name in moving:  # a body whose joint is not at its origin: a link of URDF is where its joint is
            name = _unused(f"{name}_origin", robot.frames)
            warnings.append(f"robot.urdf: frame {frame.name} is called {name}: the link of that name is at its joint")
        group = next((g for g in groups if g[0] == frame.parent and np.array_equal(g[1], pose)), None)
        if group is None:
            groups.append(group := (frame.parent, pose, []))
        group[2].append(name)
    names = groups[0][2]
    root = names.pop(len(names) // 2) if names else _unused("base", robot.frames)
    fixed = [("", root, -1, np.eye(4))]
    for parent, pose, names in groups:
        half = len(names) // 2
        joints = names[:half] + [_unused(f"{name}_fixed", robot.frames) for name in names[2 * half :]]
        fixed += [(joint, link, parent, pose) for joint, link in zip(joints, names[half:], strict=True)]
    return fixed, warnings


def _unused(name: str, frames: tuple[Frame, ...]) -> str:
    taken = {frame.name for frame in frames}
    while name in taken:
        name += "_"
    return name


def _link(root: ET.Element, name: str, parameters: Float[np.ndarray, "10"]) -> None:
    link = ET.SubElement(root, "link", name=name)
    if not parameters.any():
        return
    mass, com, inertia = to_com(parameters)
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=as_text(com), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=repr(float(mass)))
    ET.SubElement(inertial, "inertia", {name: repr(float(inertia[place])) for name, place in _MOMENTS.items()})


def _moving(root: ET.Element, robot: RobotModel, index: int, parent: str, drives: Drives) -> None:
    joint = robot.joints[index]
    limit = np.asarray(robot.position_limit[joint.coordinate])
    several = joint.kind not in ("revolute", "prismatic")
    unbounded = several or joint.kind == "revolute" and not np.isfinite(limit).any()
    kind = {"free": "floating", "revolute": "continuous" if unbounded else "revolute"}.get(joint.kind, joint.kind)
    element = _joint(root, joint.name, kind, (parent, joint.link), np.asarray(robot.placement[index]))
    first = robot.dofs.first[index]
    if not several or joint.kind == "planar":
        ET.SubElement(element, "axis", xyz=as_text(robot.axis[first + 2 if several else first]))
    bounds = {} if unbounded else {"lower": _bound(limit[0]), "upper": _bound(limit[1])}
    velocity, effort = robot.velocity_limit[joint.coordinate], robot.effort_limit[joint.coordinate]
    ET.SubElement(element, "limit", bounds | {"velocity": _bound(velocity), "effort": _bound(effort)})
    leader = robot.dof_names[joint.coordinate]
    if joint.follows:
        ratio, offset = repr(float(robot.ratio[index])), repr(float(robot.offset[index]))
        ET.SubElement(element, "mimic", joint=leader, multiplier=ratio, offset=offset)
        return
    damping, friction = drives.damping[joint.coordinate], drives.frictionloss[joint.coordinate]
    if damping or friction:
        ET.SubElement(element, "dynamics", damping=repr(float(damping)), friction=repr(float(friction)))


def _joint(
    root: ET.Element, name: str, kind: str, ends: tuple[str, str], placement: Float[np.ndarray, "4 4"]
) -> ET.Element:
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "origin", xyz=as_text(placement[:3, 3]), rpy=as_text(roll_pitch_yaw(placement[:3, :3])))
    ET.SubElement(joint, "parent", link=ends[0])
    ET.SubElement(joint, "child", link=ends[1])
    return joint


def roll_pitch_yaw(r: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Angles with R = Rz(yaw) Ry(pitch) Rx(roll); exact through the pole, where the yaw is taken as it comes.

    The roll is read off after the yaw has been turned back, so that near the pole their errors cancel.
    """
    yaw = np.arctan2(r[1, 0], r[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-r[2, 0], c * r[0, 0] + s * r[1, 0])
    roll = np.arctan2(s * r[0, 2] - c * r[1, 2], c * r[1, 1] - s * r[0, 1])
    return np.array([roll, pitch, yaw])


def _bound(value: ArrayLike) -> str:
    return repr(float(np.clip(np.asarray(value), -_NO_LIMIT, _NO_LIMIT)))
