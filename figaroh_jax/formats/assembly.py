"""From the links and joints of a file to a `RobotModel`: one tree, fixed and locked joints merged into their parents.

Readers of file formats describe links, joints and further frames in the order of the file (`LinkPart`, `JointPart`,
`FramePart`); `assemble` checks that they form one tree and builds the model. Frames: a link's frame is that of the
joint that carries it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError, check_kind, check_names, check_real, nearest
from ..rigid import inertia
from ..rigid.model import DOF_NAMES, NUMBERS, Frame, Joint, Kind, RobotModel

__all__ = [
    "LARGEST_NUMBER",
    "ROOT_JOINT",
    "FramePart",
    "JointPart",
    "LinkPart",
    "Posture",
    "Root",
    "Welded",
    "assemble",
    "displacement",
    "refuse_many",
    "translation",
    "welded_bodies",
]

Posture = Mapping[str, float | Sequence[float]]  # a number for a revolute or prismatic joint, its part of q for others
Root = Literal["fixed", "free_flyer"]

MOST_PARTS = 2000  # links or joints of a robot
_ROUNDED = 1e-6  # kg m^2; the inertias of small parts are often rounded to nonsense below this
LARGEST_NUMBER = 1e9  # m, kg, kg m^2, ...: beyond it no robot is described, and products overflow

ROOT_JOINT = "root_joint"  # the free joint between the world and the root link of a free flyer
_WORLD = ""  # the name of what carries it: no link of a file is called so, and no frame of the model


class LinkPart(NamedTuple):
    """A link of the file."""

    name: str
    inertia: Float[np.ndarray, "10"]  # at and in the link's frame
    wrong: str = ""  # what no body can have of its moments of inertia; empty: nothing


class JointPart(NamedTuple):
    """A joint of the file; the child link's frame is the joint's."""

    name: str
    kind: Kind | Literal["fixed"]
    parent: str  # name of the link that carries it
    child: str  # name of the link that it moves
    placement: Float[np.ndarray, "4 4"]  # in the parent link's frame, at zero
    axis: Float[np.ndarray, "3"]  # of any length above zero, in the joint frame; planar: the normal; else unused
    limit: tuple[float, float, float, float] = (-np.inf, np.inf, np.inf, np.inf)  # lower, upper, velocity, effort
    mimic: tuple[str, float, float] | None = None  # joint that it follows, ratio, offset
    neutral: tuple[float, ...] = ()  # its numbers in q where it is locked and the posture says nothing; empty: zero


class FramePart(NamedTuple):
    """A frame of the file beside those of links and joints, or in place of the one of its name."""

    name: str
    link: str  # name of the link that it is fixed to
    placement: Float[np.ndarray, "4 4"]  # in the link's frame


class Welded(NamedTuple):
    """A body that a file fixes to a moving link, with all that it carries."""

    name: str
    at: int  # index of the joint that moves it
    inertia: Float[np.ndarray, "10"]  # at and in that joint's frame


class _Drive(NamedTuple):
    """What moves a joint: `ratio * position of leader + offset`."""

    leader: str
    ratio: float
    offset: float


def assemble(
    source: str,
    name: str,
    parts: tuple[Sequence[LinkPart], Sequence[JointPart]],
    joints: Sequence[str] | None = None,
    posture: Posture | None = None,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    root: Root = "fixed",
    frames: Sequence[FramePart] = (),
    *,
    kinematic: bool = False,
) -> RobotModel:
    """Model of the robot `name` whose links and joints are `parts`.

    `joints` names the moving joints in column order; every other joint is locked at `posture` (rad or m, 0 where it
    says nothing; for a spherical, planar or free joint its numbers in q). Without `joints`, all joints move but those
    that `posture` names, in tree order. The root link is fixed to the world, or moves freely against it
    (`free_flyer`): then the free joint `root_joint` takes the first columns. Raises `InputError`, prefixed by
    `source`, for parts that are not one tree, for names that do not exist, and, unless the model is for postures alone
    (`kinematic`), for moments of inertia that no body can have.
    """
    try:
        for what, some in zip(("links", "joints"), parts, strict=True):
            refuse_many("", what, len(some))
        if not kinematic and (wrong := impossible_links(parts[0])):
            raise InputError(wrong[0])
        parts, joints = _rooted(root, parts, joints)
        base, children = _tree(*parts)
        drives = _drives(parts[1])
        locked = _locked(drives, [j.name for j in parts[1] if j.kind == "fixed"], joints, posture or {})
        build = _Build({link.name: link.inertia for link in parts[0]}, children, drives, locked)
        with np.errstate(over="ignore", invalid="ignore"):  # the model's numbers are checked when it is whole
            build.grow(base)
            build.mark(frames)
            return _sound(build.finish(name, joints, _gravity(gravity)))
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def impossible_links(links: Sequence[LinkPart]) -> tuple[str, ...]:
    """A line on each of the links whose moments of inertia no body can have."""
    return tuple(f"link '{link.name}': {link.wrong}" for link in links if link.wrong)


def wrong_moments(moments: Float[np.ndarray, "3 3"], *, sums: bool = False) -> str:
    """What no body can have of moments about its centre of mass (kg m^2); empty: nothing.

    `sums`: the largest principal moment above the two others together is wrong too, which few writers of URDF mind.
    """
    if not np.isfinite(moments).all():
        return ""  # `assemble` refuses it
    least, middle, most = np.linalg.eigvalsh(moments)
    little = _ROUNDED * max(1.0, most)
    if least < -little:
        return f"its inertia has a negative principal moment, {least:.3g} kg m^2"
    if sums and least + middle < most - little:
        return (
            f"its inertia has the principal moments {least:.3g}, {middle:.3g} and {most:.3g} kg m^2, the last more"
            " than the others together"
        )
    return ""


def welded_bodies(robot: RobotModel, parts: tuple[Sequence[LinkPart], Sequence[JointPart]]) -> tuple[Welded, ...]:
    """The bodies with a mass that the file of a robot fixes to a moving link, each with all that it carries there.

    `parts` are those that the robot is assembled from. A frame without a mass that carries a body is not told besides.
    """
    frames = zip(robot.frames, np.asarray(robot.frame_placement), strict=True)
    places = {frame.name: (frame.parent, pose) for frame, pose in frames}
    moved, carrier = {joint.link for joint in robot.joints}, {joint.child: joint.parent for joint in parts[1]}
    whole: dict[str, np.ndarray] = {}
    for link in parts[0]:
        at, pose = places.get(link.name, (-1, np.eye(4)))
        holder: str | None = link.name
        while at >= 0 and holder is not None and holder not in moved:
            own = inertia.transform(np.asarray(link.inertia), pose)
            whole[holder] = whole.get(holder, np.zeros(10)) + own
            holder = carrier.get(holder)
    inner = {carrier.get(name): ten for name, ten in whole.items() if ten[0] > 0}
    return tuple(
        Welded(name, places[name][0], ten)
        for name, ten in whole.items()
        if ten[0] > 0 and not (name in inner and np.allclose(ten, inner[name], rtol=0, atol=1e-12))
    )


def refuse_many(source: str, what: str, count: int) -> None:
    """Raise `InputError` for more links or joints than a robot has."""
    if count > MOST_PARTS:
        raise InputError(f"{source}{': ' * bool(source)}{count} {what}; a robot has at most {MOST_PARTS}")


def _sound(model: RobotModel) -> RobotModel:
    """The model itself, all of whose numbers are finite and of a size that products bear; else `InputError`."""
    joints, columns = [joint.name for joint in model.joints], list(model.dof_names)
    axes = [model.joints[index].name for index in model.dofs.joint]
    checked = (
        ("placement", "joint", joints, "the placement"),
        ("axis", "joint", axes, "the axis"),
        ("inertia", "link", list(model.link_names), "mass, centre of mass or inertia"),
        ("ratio", "joint", joints, "the ratio to the joint that it follows"),
        ("offset", "joint", joints, "the offset to the joint that it follows"),
        ("frame_placement", "frame", [frame.name for frame in model.frames], "the placement"),
    )
    for leaf, kind, names, what in checked:
        values = np.asarray(getattr(model, leaf)).reshape(len(names), -1)
        wrong = ~(np.abs(values) <= LARGEST_NUMBER)
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            raise InputError(
                f"{kind} '{names[row]}': {what} is {values[row, column]:.3g}, in the file or from its numbers together;"
                f" finite numbers of at most {LARGEST_NUMBER:g} are expected"
            )
    for leaf in ("position_limit", "velocity_limit", "effort_limit"):
        missing = np.isnan(np.asarray(getattr(model, leaf)).reshape(len(columns), -1)).any(axis=1)
        if missing.any():
            raise InputError(f"joint '{columns[int(np.argmax(missing))]}': its {leaf.replace('_', ' ')} is nan")
    return model


def _rooted(
    root: Root, parts: tuple[Sequence[LinkPart], Sequence[JointPart]], joints: Sequence[str] | None
) -> tuple[tuple[Sequence[LinkPart], Sequence[JointPart]], Sequence[str] | None]:
    """Parts and moving joints with the free joint of a free flyer."""
    if root == "fixed":
        return parts, joints
    if root != "free_flyer":
        raise InputError(f"root is '{root}'; known: fixed, free_flyer")
    base, _ = _tree(*parts)
    free = JointPart(ROOT_JOINT, "free", _WORLD, base, np.eye(4), np.zeros(3))
    world = LinkPart(_WORLD, np.zeros(10))
    order = None if joints is None else [ROOT_JOINT, *(joint for joint in joints if joint != ROOT_JOINT)]
    return ([world, *parts[0]], [free, *parts[1]]), order


def _gravity(gravity: Sequence[float]) -> Float[np.ndarray, "3"]:
    try:
        vector = np.asarray(gravity, float)
    except (TypeError, ValueError):
        vector = np.full(1, np.nan)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f"gravity is {gravity}; three finite numbers in m/s^2 are expected, such as (0, 0, -9.81)")
    return vector


def _tree(links: Sequence[LinkPart], joints: Sequence[JointPart]) -> tuple[str, dict[str, list[JointPart]]]:
    """Root link, and for each link the joints that it carries."""
    if not links:
        raise InputError("the robot has no link")
    _unique([link.name for link in links], "links")
    _unique([joint.name for joint in joints], "joints")
    children: dict[str, list[JointPart]] = {link.name: [] for link in links}
    carrier: dict[str, JointPart] = {}
    for joint in joints:
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in children:
                known = nearest(link, children)
                raise InputError(f"joint '{joint.name}': its {role} link '{link}' does not exist{known}")
        if joint.child in carrier:
            both = f"'{carrier[joint.child].name}' and '{joint.name}'"
            raise InputError(f"link '{joint.child}' is the child of two joints, {both}; loops are not supported")
        carrier[joint.child] = joint
        children[joint.parent].append(joint)
    roots = [link.name for link in links if link.name not in carrier]
    if len(roots) > 1:
        names = ", ".join(f"'{root}'" for root in roots)
        raise InputError(f"the links {names} have no parent joint; a robot has one root: join them by fixed joints")
    _refuse_cycle(carrier, links)
    return roots[0], children


def _unique(names: Sequence[str], what: str) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise InputError(f"two {what} are called '{name}'; names must differ")
        seen.add(name)


def _refuse_cycle(carrier: Mapping[str, JointPart], links: Sequence[LinkPart]) -> None:
    sound: set[str] = set()
    for link in links:
        path: list[str] = []
        at = link.name
        while at in carrier and at not in sound:
            if at in path:
                names = ", ".join(f"'{carrier[name].name}'" for name in path[path.index(at) :])
                raise InputError(f"the joints {names} form a cycle; a robot is a tree")
            path.append(at)
            at = carrier[at].parent
        sound.update(path)


def _drives(joints: Sequence[JointPart]) -> dict[str, _Drive]:
    """What moves each joint that is not fixed."""
    named = {joint.name: joint for joint in joints}
    found: dict[str, _Drive] = {}
    for joint in joints:
        if joint.kind != "fixed":
            found[joint.name] = _drive(joint, named, found)
    return found


def _drive(joint: JointPart, named: Mapping[str, JointPart], known: Mapping[str, _Drive]) -> _Drive:
    """Follow the mimic joints from `joint` to the independent one, or to one that is `known`."""
    at, ratio, offset, seen = joint, 1.0, 0.0, {joint.name: None}
    while at.mimic is not None:
        if at.name in known:
            leader, factor, shift = known[at.name]
            return _Drive(leader, ratio * factor, offset + ratio * shift)
        target, factor, shift = at.mimic
        if target not in named:
            raise InputError(f"joint '{at.name}' mimics '{target}', which does not exist{nearest(target, named)}")
        if target in seen:
            raise InputError(f"joint '{joint.name}' mimics itself by way of {' -> '.join([*seen, target])}")
        for joined in (at, named[target]):
            if joined.kind not in ("revolute", "prismatic"):
                raise InputError(f"joint '{at.name}' mimics '{target}', but '{joined.name}' is {joined.kind}")
        ratio, offset, at = ratio * factor, offset + ratio * shift, named[target]
        seen[target] = None
    return _Drive(at.name, ratio, offset)


def _locked(
    drives: Mapping[str, _Drive], fixed: Sequence[str], joints: Sequence[str] | None, posture: Posture
) -> dict[str, float | Sequence[float]]:
    """Position of every independent joint that does not move, where the posture gives one."""
    check_names("joints", joints)
    for name in joints or ():
        _independent(name, drives, fixed, "joints")
    _unique(list(joints or ()), "of the moving joints")
    check_kind("posture", posture, Mapping, "{'elbow': 0.5}, in rad or m")
    for name, value in posture.items():
        _independent(name, drives, fixed, "posture")
        check_real(f"posture: the position of joint '{name}'", value)
        if not np.isfinite(value).all():
            raise InputError(f"posture: joint '{name}' is at {value}; a finite position is expected")
        if joints is not None and name in joints:
            raise InputError(f"posture: joint '{name}' is one of the moving joints; only locked joints have a posture")
    leaders = [name for name, drive in drives.items() if drive.leader == name]
    moving = set(leaders) - set(posture) if joints is None else set(joints)
    return {name: posture.get(name, ()) for name in leaders if name not in moving}


def _independent(name: str, drives: Mapping[str, _Drive], fixed: Sequence[str], key: str) -> None:
    if name in fixed:
        raise InputError(f"{key}: joint '{name}' is fixed")
    if name not in drives:
        raise InputError(f"{key}: there is no joint '{name}'{nearest(name, drives)}")
    if drives[name].leader != name:
        raise InputError(f"{key}: joint '{name}' mimics '{drives[name].leader}'; name that joint instead")


class _Build:
    """The growing model: every list has one entry for a tree joint or a frame."""

    def __init__(
        self,
        inertias: dict[str, np.ndarray],
        children: dict[str, list[JointPart]],
        drives: dict[str, _Drive],
        locked: dict[str, float | Sequence[float]],
    ) -> None:
        self.inertias, self.children, self.drives, self.locked = inertias, children, drives, locked
        self.joints: list[JointPart] = []
        self.parents: list[int] = []
        self.placements: list[np.ndarray] = []
        self.carried: list[np.ndarray] = []
        self.frames: dict[str, tuple[int, np.ndarray]] = {}
        self.joint_frames: dict[str, tuple[int, np.ndarray]] = {}

    def grow(self, root: str) -> None:
        """Walk the tree depth first, in the order of the file."""
        stack: list[tuple[JointPart | None, str, int, np.ndarray]] = [(None, root, -1, np.eye(4))]
        while stack:
            joint, link, body, pose = stack.pop()
            if joint is not None:
                body, pose = self._attach(joint, body, pose)
            if body >= 0:
                self.carried[body] = self.carried[body] + inertia.transform(self.inertias[link], pose)
            self.frames[link] = (body, pose)
            stack += [(child, child.child, body, pose) for child in reversed(self.children[link])]

    def _attach(self, joint: JointPart, body: int, pose: np.ndarray) -> tuple[int, np.ndarray]:
        """Body and pose in it of the joint's child link."""
        pose = pose @ joint.placement
        drive = self.drives.get(joint.name)
        if drive is None or drive.leader in self.locked:
            if drive is not None:
                at = _numbers(joint, self.locked[drive.leader])
                pose = pose @ displacement(joint.kind, joint.axis, drive.ratio * at + drive.offset)
            self.joint_frames[joint.name] = (body, pose)
            return body, pose
        self.joints.append(joint)
        self.parents.append(body)
        self.placements.append(pose)
        self.carried.append(np.zeros(10))
        self.joint_frames[joint.name] = (len(self.joints) - 1, np.eye(4))
        return len(self.joints) - 1, np.eye(4)

    def mark(self, frames: Sequence[FramePart]) -> None:
        links = dict(self.frames)
        for name, link, placement in frames:
            body, pose = links[link]
            self.frames[name] = (body, pose @ placement)

    def finish(self, name: str, order: Sequence[str] | None, gravity: np.ndarray) -> RobotModel:
        drives = [self.drives[joint.name] for joint in self.joints]
        independent = [j.name for j, drive in zip(self.joints, drives, strict=True) if drive.leader == j.name]
        columns = list(order) if order is not None else independent
        if not columns:
            raise InputError("no joint moves; a robot needs one joint that is not fixed or locked")
        named = {joint.name: joint for joint in self.joints}
        widths = [len(DOF_NAMES[named[column].kind]) for column in columns]
        first = dict(zip(columns, np.cumsum([0, *widths]), strict=False))
        limit = np.repeat(np.array([named[column].limit for column in columns], float), widths, axis=0)
        frames = {name: place for name, place in (self.joint_frames | self.frames).items() if name != _WORLD}
        return RobotModel(
            placement=np.array(self.placements),
            axis=np.concatenate([_axes(joint) for joint in self.joints]),
            inertia=np.array(self.carried),
            ratio=np.array([drive.ratio for drive in drives]),
            offset=np.array([drive.offset for drive in drives]),
            gravity=gravity,
            frame_placement=np.array([pose for _, pose in frames.values()]),
            position_limit=limit[:, :2],
            velocity_limit=limit[:, 2],
            effort_limit=limit[:, 3],
            joints=tuple(
                Joint(j.name, j.kind, parent, int(first[drive.leader]), j.child, drive.leader != j.name)  # pyright: ignore[reportArgumentType] (none is fixed)
                for j, parent, drive in zip(self.joints, self.parents, drives, strict=True)
            ),
            frames=tuple(Frame(frame, parent) for frame, (parent, _) in frames.items()),
            name=name,
        )


def _axes(joint: JointPart) -> Float[np.ndarray, "dofs 3"]:
    """Unit axis of each degree of freedom, in the joint frame."""
    if joint.kind == "spherical":
        return np.eye(3)
    if joint.kind == "free":
        return np.concatenate([np.eye(3), np.eye(3)])
    axis = joint.axis / np.linalg.norm(joint.axis)
    return _plane(axis).T if joint.kind == "planar" else axis[None]


def _plane(normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation whose third column is the normal: the shortest from z, or from -z (half a turn about x before it)."""
    flip = np.diag([1.0, -1.0, -1.0]) if normal[2] < 0 else np.eye(3)
    x, y, z = flip @ normal
    turn = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    return flip @ (np.eye(3) + turn + turn @ turn / (1.0 + z))


def _numbers(joint: JointPart, given: float | Sequence[float]) -> Float[np.ndarray, " numbers"]:
    """The joint's part of q as the posture gives it; where it gives nothing (empty), the neutral one."""
    count = NUMBERS[joint.kind]
    numbers = np.atleast_1d(np.asarray(given, float))
    turned = joint.kind in ("spherical", "free")
    if not numbers.size and joint.neutral:
        return np.array(joint.neutral)
    if not numbers.size:
        return np.append(np.zeros(count - 1), 1.0 if turned else 0.0)
    if numbers.shape != (count,):
        raise InputError(f"posture: joint '{joint.name}' is {joint.kind}; {count} numbers are expected, not {given}")
    if turned and np.linalg.norm(numbers[-4:]) < 1e-9:
        raise InputError(f"posture: the quaternion of joint '{joint.name}' is zero; x y z w of length one is expected")
    return numbers


def translation(way: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Pose without a rotation."""
    pose = np.eye(4)
    pose[:3, 3] = way
    return pose


def displacement(kind: str, axis: Float[np.ndarray, "3"], position: Float[np.ndarray, " numbers"]) -> np.ndarray:
    """Pose of a joint that has moved to `position` (its part of q) in the pose that it had at zero."""
    pose = np.eye(4)
    if kind == "free":
        pose[:3, 3] = position[:3]
    if kind in ("free", "spherical"):
        pose[:3, :3] = _rotation(position[-4:-1], position[-1])
        return pose
    axis = axis / np.linalg.norm(axis)
    if kind == "prismatic":
        return translation(position[0] * axis)
    if kind == "planar":
        pose[:3, 3] = _plane(axis)[:, :2] @ position[:2]
    half = position[-1] / 2
    pose[:3, :3] = _rotation(np.sin(half) * axis, np.cos(half))
    return pose


def _rotation(vector: Float[np.ndarray, "3"], scalar: float) -> Float[np.ndarray, "3 3"]:
    """Rotation of the quaternion, of any length above zero."""
    x, y, z = vector
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + (2.0 * scalar * k + 2.0 * k @ k) / (vector @ vector + scalar**2)
