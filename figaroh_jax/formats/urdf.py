"""Robots from URDF files, read by yourdfpy and without any mesh.

Only what moves and weighs is read: links with their inertias, joints with placement, axis, limit and mimic.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from ..errors import InputError, nearest
from ..rigid import inertia
from ..rigid.model import Kind, RobotModel
from .assembly import JointPart, LinkPart, Posture, Root, assemble, refuse_many
from .xmlfile import find_in_packages, read_xml

__all__ = ["load_urdf", "urdf_dynamics"]

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
_NUMBERS = {  # element: attributes, how many numbers each holds, which must be there
    "origin": {"xyz": 3, "rpy": 3},
    "axis": {"xyz": 3},
    "mass": {"value": 1},
    "inertia": {"ixx": 1, "ixy": 1, "ixz": 1, "iyy": 1, "iyz": 1, "izz": 1},
    "limit": {"lower": 1, "upper": 1, "velocity": 1, "effort": 1},
    "mimic": {"multiplier": 1, "offset": 1},
}
_REQUIRED = ("mass", "inertia")  # elements of which no attribute may be left out
_MAY_BE_INFINITE = ("limit",)
_ONCE = {"link": ("inertial",), "inertial": ("origin", "mass", "inertia")}  # a second one contradicts the first
_ROUNDED = 1e-6  # kg m^2; the inertias of small parts are often rounded to nonsense below this


def load_urdf(
    path: str | Path,
    joints: Sequence[str] | None = None,
    posture: Posture | None = None,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    root: Root = "fixed",
    packages: Sequence[str | Path] = (),
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
    `package://my_robot/robot.urdf` is found.

    Raises `InputError` naming the file and the joint or link that is wrong.

    >>> import figaroh_jax as fj
    >>> fj.load_urdf(fj.DEMO).joint_names
    ('waist', 'shoulder', 'elbow', 'wrist')
    """
    path = find_in_packages(path, packages)
    robot = _read(path)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # `assemble` checks what comes of it
            parts = [_link(link) for link in robot.links], [_joint(joint) for joint in robot.joints]
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return assemble(str(path), robot.name, parts, joints, posture, gravity, root)


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


def _read(path: str | Path) -> Any:
    """The robot as yourdfpy's dataclasses, from a file whose every number has been checked."""
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

    root = read_xml(path, "robot")
    refuse_many(str(path), "links", sum(1 for _ in root.iterchildren("link")))
    for part in [part for holder, tags in _UNREAD.items() for tag in tags for part in root.findall(f"{holder}/{tag}")]:
        part.getparent().remove(part)
    try:
        for part in root.iterchildren("link", "joint"):
            _check_part(part)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    root.set("name", root.get("name") or Path(path).stem)
    reader = _yourdfpy().URDF
    try:
        return reader.load(io.BytesIO(etree.tostring(root)), build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # parts that play no role here (materials, ...) may be anything
        raise InputError(f"{path}: cannot be read as URDF: {type(error).__name__}: {error}") from error


class _Later(ModuleType):
    """Stands for a package that is loaded when something of it is first used; until `ready`, its names are blanks."""

    ready = False

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(import_module(self.__name__), name) if self.ready else object


@lru_cache(maxsize=1)
def _yourdfpy() -> Any:
    """yourdfpy without trimesh, which with all that it loads takes ten times as long as the rest of reading a robot.

    The reader needs `trimesh.transformations` alone. While yourdfpy is imported, a stand-in takes the place of trimesh
    (where that is not loaded yet): submodules are found, its own names, which stand in annotations, are blanks. From
    then on the stand-in passes on to the real one, so that yourdfpy shows scenes as ever.
    """
    spec = find_spec("trimesh")
    if {"trimesh", "yourdfpy"} & set(sys.modules) or spec is None or spec.submodule_search_locations is None:
        return import_module("yourdfpy")
    later = _Later("trimesh")
    later.__path__ = list(spec.submodule_search_locations)
    sys.modules["trimesh"] = later
    try:
        return import_module("yourdfpy")
    finally:
        for name in [n for n in sys.modules if n.partition(".")[0] == "trimesh"]:
            del sys.modules[name]
        later.ready = True


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
    if link.inertial is None:
        return LinkPart(link.name, np.zeros(10))
    mass, about_com = link.inertial.mass, link.inertial.inertia
    if mass < 0.0:
        raise InputError(f"link '{link.name}': its mass is {mass:g} kg; it cannot be negative")
    moments = np.linalg.eigvalsh(about_com)
    if moments[0] < -_ROUNDED * max(1.0, moments[-1]):
        raise InputError(f"link '{link.name}': its inertia has a negative principal moment, {moments[0]:.3g} kg m^2")
    origin = np.eye(4) if link.inertial.origin is None else link.inertial.origin
    return LinkPart(link.name, inertia.transform(inertia.from_com(mass, np.zeros(3), about_com), origin))


def _joint(joint: Any) -> JointPart:
    kind = _KINDS[joint.type]
    if kind in ("revolute", "prismatic", "planar") and np.linalg.norm(joint.axis) < 1e-9:
        raise InputError(f"joint '{joint.name}': its axis is zero; a direction is expected")
    origin = np.eye(4) if joint.origin is None else joint.origin
    mimic = joint.mimic and (joint.mimic.joint, joint.mimic.multiplier, joint.mimic.offset)
    return JointPart(joint.name, kind, joint.parent, joint.child, origin, joint.axis, _limit(joint), mimic)


def _limit(joint: Any) -> tuple[float, float, float, float]:
    """Lower, upper, velocity and effort limit; infinite where the file gives none."""
    given = joint.limit
    lower, upper, velocity, effort = (
        bound if given is None or value is None else value
        for bound, value in (
            (-np.inf, given and given.lower),
            (np.inf, given and given.upper),
            (np.inf, given and given.velocity),
            (np.inf, given and given.effort),
        )
    )
    if joint.type not in _BOUNDED:
        lower, upper = -np.inf, np.inf
    if lower > upper:
        raise InputError(f"joint '{joint.name}': its lower limit {lower:g} is above the upper one {upper:g}")
    return lower, upper, velocity, effort
