"""Robots from URDF files, without any mesh.

Only what moves and weighs is read: links with their inertias, joints with placement, axis, limit and mimic.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ..errors import InputError, check_names, check_switch, nearest
from ..rigid import inertia
from ..rigid.model import Kind, RobotModel
from .assembly import JointPart, LinkPart, Posture, Root, assemble, refuse_many, wrong_moments
from .xmlfile import find_in_packages, read_xml

__all__ = ["load_urdf", "said_twice", "urdf_dynamics", "urdf_parts"]

_KINDS: dict[str, Kind | Literal["fixed"]] = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "fixed": "fixed",
    "floating": "free",
    "planar": "planar",
    "spherical": "spherical",  # not in the standard; MuJoCo's reader takes it too
}
_BOUNDED = ("revolute", "prismatic")
_UNREAD = {  # by the element that holds them
    ".": ("material", "transmission", "gazebo"),
    "link": ("visual", "collision"),
    "joint": ("dynamics", "calibration", "safety_controller"),
}
_XACRO = re.compile(r"\{[^}]*\bxacro/?\}")  # the namespace of what the program xacro replaces
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_ROWS = ("ixx ixy ixz", "ixy iyy iyz", "ixz iyz izz")
_NUMBERS = {  # element: attributes, how many numbers each holds, which must be there
    "origin": {"xyz": 3, "rpy": 3},
    "axis": {"xyz": 3},
    "mass": {"value": 1},
    "inertia": {name: 1 for name in _MOMENTS},
    "limit": {"lower": 1, "upper": 1, "velocity": 1, "effort": 1},
    "mimic": {"multiplier": 1, "offset": 1},
}
_REQUIRED = ("mass", "inertia")  # elements of which no attribute may be left out
_MAY_BE_INFINITE = ("limit",)
_ONCE = {"inertial": ("origin", "mass", "inertia")}  # a second one contradicts the first
_FIRST = {  # of these the first counts, as in urdfdom
    "link": ("inertial",),
    "joint": ("origin", "parent", "child", "axis", "limit", "mimic", "dynamics"),
}


def load_urdf(
    path: str | Path,
    joints: Sequence[str] | None = None,
    posture: Posture | None = None,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    root: Root = "fixed",
    packages: Sequence[str | Path] = (),
    *,
    kinematic: bool = False,
) -> RobotModel:
    """Model of the robot in a URDF file, its root link fixed to the world or free (`root="free_flyer"`).

    `joints` names the moving joints in the order of the columns of q; every other joint is locked at `posture` (rad,
    m; 0 where it says nothing) and merged into its parent, as fixed joints are. Without `joints`, all joints move in
    tree order but those that `posture` names. A free flyer's `root_joint` stands in front of them in either case.
    `gravity` in m/s^2 in the world, which is the root link's frame where that is fixed.

    A continuous joint is one plain angle; a `floating` joint is a free one; a `planar` joint moves in the plane normal
    to its axis; `spherical`, which is not in the standard, is read too; a mimic joint shares the coordinate of the
    joint it follows. Every link and every joint of the file is a frame of the model. Masses and inertias of links that
    do not move are left out: they do no work. Damping and friction of `<dynamics>` are not part of this model:
    `load_extended`. Meshes are never read; `packages` are the folders of packages by which a path such as
    `package://my_robot/robot.urdf` is found. `kinematic`: for postures alone, which ask for no moments of inertia:
    links whose moments no body can have pass as they are in the file.

    Raises `InputError` naming the file and the joint or link that is wrong.

    >>> import figaroh_jax as fj
    >>> fj.load_urdf(fj.DEMO).joint_names
    ('waist', 'shoulder', 'elbow', 'wrist')
    """
    check_names("joints", joints)
    check_switch("kinematic", kinematic)
    path = find_in_packages(path, packages)
    name, parts = urdf_parts(path)
    return assemble(str(path), name, parts, joints, posture, gravity, root, kinematic=kinematic)


def urdf_parts(path: str | Path) -> tuple[str, tuple[list[LinkPart], list[JointPart]]]:
    """Name of the robot in a URDF file, its links and its joints."""
    robot = _read(path)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # `assemble` checks what comes of it
            links = [_link(link) for link in robot.iterchildren("link")]
            joints = [_joint(joint) for joint in robot.iterchildren("joint")]
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return robot.get("name") or Path(path).stem, (links, joints)


def urdf_dynamics(path: str | Path) -> dict[str, tuple[float, float]]:
    """Damping (N m s/rad or N s/m) and dry friction (N m or N) of the joints that the file gives one."""
    found = {}
    for joint in read_xml(path, "robot").iterchildren("joint"):
        for element in joint.iterchildren("dynamics"):
            for attribute in ("damping", "friction"):
                _check_numbers(element, attribute, 1, f"{path}: joint '{joint.get('name')}'")
                if float(element.get(attribute, 0)) < 0:
                    raise InputError(
                        f"{path}: joint '{joint.get('name')}': its {attribute} is {element.get(attribute)}; "
                        "a negative one would drive the joint, zero or more is expected"
                    )
            found[joint.get("name")] = (float(element.get("damping", 0)), float(element.get("friction", 0)))
    return found


def said_twice(path: str | Path) -> tuple[str, ...]:
    """What the file says of a link or a joint more than once; the first counts, as for other readers of URDF."""
    parts = read_xml(path, "robot").iterchildren(*_FIRST)
    counts = ((part, tag, len(part.findall(tag))) for part in parts for tag in _FIRST[part.tag])
    return tuple(
        f"{'the second' if count == 2 else f'{count - 1} more'} <{tag}> of {part.tag} '{part.get('name')}' (line"
        f" {part.findall(tag)[1].sourceline}): the first counts"
        for part, tag, count in counts
        if count > 1
    )


def _read(path: str | Path) -> Any:
    """Root element of a file of which every name and number that is read has been checked."""
    root = read_xml(path, "robot")
    if (left := next((one for one in root.iter("*") if _XACRO.match(one.tag)), None)) is not None:
        raise InputError(
            f"{path}: line {left.sourceline} holds <xacro:{_XACRO.sub('', left.tag)}>: this is the source of a URDF;"
            f" write the URDF by `xacro {Path(path).name} > expanded.urdf`"
        )
    refuse_many(str(path), "links", sum(1 for _ in root.iterchildren("link")))
    for part in [part for holder, tags in _UNREAD.items() for tag in tags for part in root.findall(f"{holder}/{tag}")]:
        part.getparent().remove(part)
    try:
        for part in root.iterchildren("link", "joint"):
            _check_part(part)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return root


def _check_part(part: Any) -> None:
    name = part.get("name")
    if not name:
        raise InputError(f"a <{part.tag}> in line {part.sourceline} has no name")
    where = f"{part.tag} '{name}'"
    if part.tag == "joint":
        _check_joint(part, where)
    elif part.find("inertial") is not None:
        for child in _REQUIRED:
            if part.find(f"inertial/{child}") is None:
                raise InputError(f"{where}: its <inertial> has no <{child}>")
    for element in part.iter(*_ONCE):
        for tag in _ONCE[element.tag]:
            if len(element.findall(tag)) > 1:
                raise InputError(f"{where}: <{element.tag}> has {len(element.findall(tag))} <{tag}>; one is expected")
    for element in part.iter(*_NUMBERS):
        for attribute, count in _NUMBERS[element.tag].items():
            _check_numbers(element, attribute, count, where)


def _check_joint(part: Any, where: str) -> None:
    kind = part.get("type")
    if kind not in _KINDS:
        wrong = "has no type" if kind is None else f"unknown type '{kind}'"
        raise InputError(f"{where}: {wrong}{nearest(kind or '', _KINDS)}")
    for end in ("parent", "child"):
        element = part.find(end)
        if element is None or not element.get("link"):
            raise InputError(f'{where}: names no {end} link; <{end} link="..."/> is expected')
    mimic = part.find("mimic")
    if mimic is not None and not mimic.get("joint"):
        raise InputError(f"{where}: its <mimic> names no joint")


def _check_numbers(element: Any, attribute: str, count: int, where: str) -> None:
    text = element.get(attribute)
    place = f"{where}: {attribute} of <{element.tag}>"
    if text is None:
        if element.tag in _REQUIRED:
            raise InputError(f"{place} is missing")
        return
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count:
        raise InputError(f"{place} is '{text}'; {count} number{'s' * (count > 1)} expected")
    if not (np.isfinite(values).all() or element.tag in _MAY_BE_INFINITE and not np.isnan(values).any()):
        raise InputError(f"{place} is '{text}'; finite numbers are expected")


def _link(link: Any) -> LinkPart:
    name, inertial = str(link.get("name")), link.find("inertial")
    if inertial is None:
        return LinkPart(name, np.zeros(10))
    mass = float(inertial.find("mass").get("value"))
    if mass < 0.0:
        raise InputError(f"link '{name}': its mass is {mass:g} kg; it cannot be negative")
    moments = _moments(inertial)
    about_com = inertia.from_com(mass, np.zeros(3), moments)
    return LinkPart(name, inertia.transform(about_com, _origin(inertial)), wrong_moments(moments))


def _moments(inertial: Any) -> np.ndarray:
    """Inertia (3, 3) about the centre of mass, kg m^2."""
    moments = {key: float(value) for key, value in inertial.find("inertia").attrib.items() if key in _MOMENTS}
    return np.array([[moments[key] for key in row.split()] for row in _ROWS])


def _joint(joint: Any) -> JointPart:
    name, kind = str(joint.get("name")), _KINDS[joint.get("type")]
    axis = _vector(joint.find("axis"), "xyz", "1 0 0")
    if kind in ("revolute", "prismatic", "planar") and np.linalg.norm(axis) < 1e-9:
        raise InputError(f"joint '{name}': its axis is zero; a direction is expected")
    parent, child = (str(joint.find(end).get("link")) for end in ("parent", "child"))
    given = joint.find("mimic")
    mimic = None
    if given is not None:
        mimic = str(given.get("joint")), float(given.get("multiplier", 1.0)), float(given.get("offset", 0.0))
    return JointPart(name, kind, parent, child, _origin(joint), axis, _limit(joint), mimic)


def _vector(element: Any, attribute: str, default: str) -> Float[np.ndarray, "3"]:
    text = default if element is None else element.get(attribute, default)
    return np.array([float(word) for word in text.split()])


def _origin(part: Any) -> Float[np.ndarray, "4 4"]:
    """Placement by the `<origin>` of an element: R = Rz(yaw) Ry(pitch) Rx(roll), the identity where there is none."""
    origin = part.find("origin")
    (cr, cp, cy), (sr, sp, sy) = (f(_vector(origin, "rpy", "0 0 0")) for f in (np.cos, np.sin))
    placement = np.eye(4)
    placement[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    placement[:3, 3] = _vector(origin, "xyz", "0 0 0")
    return placement


def _limit(joint: Any) -> tuple[float, float, float, float]:
    """Lower, upper, velocity and effort limit; infinite where the file gives none."""
    given = joint.find("limit")
    attributes = {} if given is None else given.attrib
    lower, upper = float(attributes.get("lower", -np.inf)), float(attributes.get("upper", np.inf))
    if joint.get("type") not in _BOUNDED:
        lower, upper = -np.inf, np.inf
    if lower > upper:
        raise InputError(f"joint '{joint.get('name')}': its lower limit {lower:g} is above the upper one {upper:g}")
    return lower, upper, float(attributes.get("velocity", np.inf)), float(attributes.get("effort", np.inf))
