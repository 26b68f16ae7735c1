"""Robots as MJCF, MuJoCo's format: text from a `RobotModel`, and the model read back from such text.

Bodies stand where their joints are, so a joint is at its body's origin. Frames are sites, motors one actuator a joint
whose control is the torque. No meshes, no geoms, no contacts.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from .assembly import JointPart, LinkPart, assemble
from .errors import InputError
from .inertia import from_com, to_com
from .model import RobotModel
from .native import Drives, physical_inertia
from .xmlfile import read_xml

__all__ = ["mjcf_text", "read_mjcf"]

_KIND = {"revolute": "hinge", "prismatic": "slide"}
_BACK: dict[str, Literal["revolute", "prismatic"]] = {"hinge": "revolute", "slide": "prismatic"}
_FULL = ([0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2])  # MuJoCo's order of the six moments


def mjcf_text(robot: RobotModel, drives: Drives) -> tuple[str, tuple[str, ...]]:
    """MJCF of the robot with its drives, and warnings on what could not be written as it is."""
    root = ET.Element("mujoco", model=robot.name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    gravity = np.asarray(robot.gravity)
    ET.SubElement(root, "option", gravity=_text(gravity), timestep="0.001", integrator="implicitfast")
    bodies = {-1: ET.SubElement(root, "worldbody")}
    warnings = []
    for index, joint in enumerate(robot.joints):
        body = ET.SubElement(bodies[joint.parent], "body", {"name": joint.link} | _pose(robot.placement[index]))
        bodies[index] = body
        inertia, warning = physical_inertia(np.asarray(robot.inertia[index]), "mjcf")
        if warning:
            warnings.append(f"robot.xml: link {joint.link} {warning}")
        ET.SubElement(body, "inertial", _inertial(inertia))
        ET.SubElement(body, "joint", _joint(robot, index, drives))
    for frame, placement in zip(robot.frames, robot.frame_placement, strict=True):
        ET.SubElement(bodies[frame.parent], "site", {"name": frame.name} | _pose(placement))
    _tendons(root, robot, drives)
    warnings += _followers(root, robot)
    actuators = ET.SubElement(root, "actuator")
    efforts = np.asarray(robot.effort_limit)
    for name, limit, bias in zip(robot.joint_names, efforts, drives.bias, strict=True):
        ET.SubElement(actuators, "general", _motor(name, float(limit), float(bias)))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n", tuple(warnings)


def _text(numbers: ArrayLike) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(np.asarray(numbers)))


def _pose(pose: ArrayLike) -> dict[str, str]:
    placement = np.asarray(pose)
    return {"pos": _text(placement[:3, 3]), "quat": _text(_quaternion(placement[:3, :3]))}


def _quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Unit quaternion w, x, y, z: the eigenvector of the largest eigenvalue (Bar-Itzhack 2000), accurate everywhere."""
    r = rotation
    w = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[0, 1:], matrix[1:, 0] = np.trace(r), w, w
    matrix[1:, 1:] = r + r.T - np.trace(r) * np.eye(3)
    q = np.linalg.eigh(matrix)[1][:, -1]
    return q if q[0] >= 0 else -q


def _rotation(q: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    w, u = q[0] / np.linalg.norm(q), q[1:] / np.linalg.norm(q)
    cross = np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def _inertial(parameters: Float[np.ndarray, "10"]) -> dict[str, str]:
    mass, com, inertia = to_com(parameters)
    return {"mass": repr(float(mass)), "pos": _text(com), "fullinertia": _text(inertia[_FULL])}


def _joint(robot: RobotModel, index: int, drives: Drives) -> dict[str, str]:
    joint = robot.joints[index]
    element = {"name": joint.name, "type": _KIND[joint.kind], "axis": _text(robot.axis[index])}
    if joint.follows:
        return element  # its drive is that of the joint that it follows
    limit = np.asarray(robot.position_limit[joint.coordinate])
    if np.isfinite(limit).any() and limit[0] < limit[1]:
        element["range"] = _text(np.clip(limit, -1e10, 1e10))
    for attribute in ("armature", "damping", "frictionloss", "stiffness", "springref"):
        if (value := getattr(drives, attribute)[joint.coordinate]) != 0:
            element[attribute] = repr(float(value))
    return element


def _motor(name: str, limit: float, bias: float) -> dict[str, str]:
    """A torque motor; a torque of the drive that does not reach the joint is taken off."""
    element = {"name": name, "joint": name, "gainprm": "1"}
    if 0 < limit < np.inf:
        element["ctrlrange"] = _text(np.array([-limit, limit]))
    if bias != 0:
        element |= {"biastype": "affine", "biasprm": _text(np.array([-bias, 0.0, 0.0]))}
    return element


def _tendons(root: ET.Element, robot: RobotModel, drives: Drives) -> None:
    if not drives.tendons:
        return
    group = ET.SubElement(root, "tendon")
    for tendon in drives.tendons:
        names = [robot.joint_names[place] for place in tendon.at]
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
        leader = robot.joint_names[joint.coordinate]
        ET.SubElement(group, "joint", joint1=joint.name, joint2=leader, polycoef=_text(polynomial))
    names = ", ".join(robot.joints[index].name for index in followers)
    return [f"robot.xml: {names} follow other joints by equality constraints, which MuJoCo keeps softly"]


def read_mjcf(path: str | Path) -> RobotModel:
    """Model of a robot whose MJCF `mjcf_text` wrote (other MJCF uses elements that are not read here).

    Drives are left out: they are effects. Raises `InputError` for a file that is not such text.
    """
    root = read_xml(path, "mujoco")
    links, joints = [LinkPart("world", np.zeros(10))], []
    try:
        follow = {e.get("joint1"): e for e in root.iterfind("equality/joint")}
        gravity = _numbers(root.find("option"), "gravity")
        _read_body(root.find("worldbody"), "world", links, joints, follow)
    except (AttributeError, TypeError, ValueError, KeyError, IndexError):
        raise InputError(f"{path}: not MJCF as figaroh-jax writes it; other MJCF is not read yet") from None
    order = [name for e in root.iterfind("actuator/general") if (name := e.get("joint"))]
    return assemble(str(path), root.get("model"), (links, joints), order, None, gravity.tolist())


def _numbers(element: Any, attribute: str) -> Float[np.ndarray, " n"]:
    if element is None:
        raise KeyError(attribute)
    return np.array([float(word) for word in element.attrib[attribute].split()])


def _read_pose(element: Any) -> Float[np.ndarray, "4 4"]:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = _rotation(_numbers(element, "quat")), _numbers(element, "pos")
    return pose


def _read_body(body: Any, name: str, links: list[LinkPart], joints: list[JointPart], follow: dict[str, Any]) -> None:
    for child in body.iterfind("body"):
        link, joint = child.attrib["name"], child.find("joint")
        if joint is None:
            raise KeyError("joint")
        links.append(LinkPart(link, _read_inertial(child.find("inertial"))))
        joints.append(_read_joint(joint, name, child, follow.get(joint.get("name"))))
        _read_body(child, link, links, joints, follow)
    known = {link.name for link in links} | {joint.name for joint in joints}
    for site in body.iterfind("site"):
        frame = site.attrib["name"]
        if frame not in known:
            links.append(LinkPart(frame, np.zeros(10)))
            joints.append(JointPart(frame, "fixed", name, frame, _read_pose(site), np.zeros(3)))


def _read_joint(joint: Any, parent: str, body: Any, follow: Any) -> JointPart:
    lower, upper = _numbers(joint, "range") if "range" in joint.attrib else (-np.inf, np.inf)
    mimic = None
    if follow is not None:
        offset, ratio = _numbers(follow, "polycoef")[:2]
        mimic = (follow.attrib["joint2"], float(ratio), float(offset))
    limit = (float(lower), float(upper), np.inf, np.inf)
    name, link = joint.attrib["name"], body.attrib["name"]
    return JointPart(
        name, _BACK[joint.attrib["type"]], parent, link, _read_pose(body), _numbers(joint, "axis"), limit, mimic
    )


def _read_inertial(inertial: Any) -> Float[np.ndarray, "10"]:
    xx, yy, zz, xy, xz, yz = _numbers(inertial, "fullinertia")
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return from_com(np.float64(_numbers(inertial, "mass")[0]), _numbers(inertial, "pos"), inertia)
