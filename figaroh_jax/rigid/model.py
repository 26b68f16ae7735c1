"""The robot: an immutable pytree whose arrays are differentiable leaves and whose tree is static.

Conventions. Motions and wrenches are `[linear, angular]`. Tree joints are numbered depth first, so that the joints
moved by one joint are contiguous. A *coordinate* is a column of v, a and tau; a mimic joint shares the coordinate of
the joint it follows. Inertial parameters are Pinocchio's ten, `[m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz]`, at the
joint frame's origin, in the joint frame. Leaves are held in numpy float64 until a computation takes them, so a model
loaded without 64-bit JAX loses nothing.

Kinds of joints, with Pinocchio's conventions (the child is the joint frame, which moves with the link; the parent is
the joint frame at zero):

| kind | numbers in q | columns of v |
|---|---|---|
| revolute, prismatic | angle or way along the axis | its rate |
| spherical | quaternion x y z w, child in parent | angular velocity in child axes |
| planar | x, y in the plane, angle about the normal | (v_x, v_y) in child axes, rate of the angle |
| free | origin x y z in parent axes, quaternion x y z w | linear velocity of the origin, angular velocity: child axes |

a is the rate of the numbers v. The columns of q and of v stand in the same order of joints; nq differs from nv only
where there are quaternions. The axes of a joint (`axis`, one for each degree of freedom) are fixed in the child: the
unit vectors of spherical and free joints (linear first), for a planar joint two directions in the plane and the normal.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..errors import InputError, nearest

__all__ = ["DOF_NAMES", "NUMBERS", "Dofs", "Frame", "Joint", "Kind", "Leaf", "RobotModel", "dofs", "prismatic"]

# A leaf is NumPy's until a computation takes it, then JAX's; a type checker cannot know which of the two it meets.
if TYPE_CHECKING:
    Leaf = Any
else:
    Leaf = Array | np.ndarray

Kind = Literal["revolute", "prismatic", "spherical", "planar", "free"]

DOF_NAMES: dict[str, tuple[str, ...]] = {  # what the columns of v are called behind the joint's name
    "revolute": ("",),
    "prismatic": ("",),
    "spherical": (".wx", ".wy", ".wz"),
    "planar": (".vx", ".vy", ".wz"),
    "free": (".vx", ".vy", ".vz", ".wx", ".wy", ".wz"),
}
NUMBERS: dict[str, int] = {"revolute": 1, "prismatic": 1, "spherical": 4, "planar": 3, "free": 7}  # in q
_TURNING: dict[str, tuple[bool, ...]] = {
    "revolute": (True,),
    "prismatic": (False,),
    "spherical": (True, True, True),
    "planar": (False, False, True),
    "free": (False, False, False, True, True, True),
}


class Joint(NamedTuple):
    """A moving joint of the tree and the link that it carries; `parent` and `coordinate` are indices."""

    name: str
    kind: Kind
    parent: int  # index of the joint that carries this one, -1: the world
    coordinate: int  # first column of v that moves it
    link: str  # name of the moved link
    follows: bool = False  # mimic: the coordinate is named after another joint


class Frame(NamedTuple):
    """A frame fixed to the link of joint `parent` (-1: the world)."""

    name: str
    parent: int


class Dofs(NamedTuple):
    """The degrees of freedom of the tree joints, in tree order: which joint, which column of v, turning or sliding.

    A mimic joint has a degree of freedom of its own, whose column is its leader's. Read-only.
    """

    joint: np.ndarray  # (nd,) index of the tree joint
    column: np.ndarray  # (nd,) column of v
    turns: np.ndarray  # (nd,) whether it turns about its axis; otherwise it slides along it
    first: np.ndarray  # (nj,) first degree of freedom of each tree joint
    positions: tuple[slice, ...]  # columns of q of each tree joint


@lru_cache(maxsize=256)
def dofs(joints: tuple[Joint, ...]) -> Dofs:
    """Where the degrees of freedom of each joint stand in v, and its numbers in q."""
    counts = [len(DOF_NAMES[joint.kind]) for joint in joints]
    joint = np.repeat(np.arange(len(joints)), counts)
    first = np.cumsum([0, *counts])[:-1]
    start = np.array([j.coordinate for j in joints], int)
    column = start[joint] + np.arange(len(joint)) - first[joint]
    turns = np.array([turns for j in joints for turns in _TURNING[j.kind]], bool)
    independent = {j.coordinate: NUMBERS[j.kind] for j in joints if not j.follows}
    before = {c: sum(n for other, n in independent.items() if other < c) for c in independent}
    positions = tuple(slice(before[j.coordinate], before[j.coordinate] + NUMBERS[j.kind]) for j in joints)
    for array in (joint, column, turns, first):
        array.setflags(write=False)
    return Dofs(joint, column, turns, first, positions)


class RobotModel(eqx.Module):
    """Robot of `nj` tree joints with `nd` degrees of freedom, `nv` coordinates and `nf` frames (m, rad, kg).

    The position of a revolute or prismatic tree joint is `ratio * q[coordinate] + offset`; ratio is 1 and offset 0
    except for mimic joints. `nd` differs from `nv` only by the mimic joints. A robot that is not fixed to the world
    has a free joint, `root_joint`, in front.
    """

    placement: Float[Leaf, "nj 4 4"]  # pose of each joint in its parent's joint frame, at zero
    axis: Float[Leaf, "nd 3"]  # unit axis of each degree of freedom, in the joint frame
    inertia: Float[Leaf, "nj 10"]  # of the link that the joint moves, at and in the joint frame
    ratio: Float[Leaf, " nj"]
    offset: Float[Leaf, " nj"]
    gravity: Float[Leaf, "3"]  # m/s^2, in the world
    frame_placement: Float[Leaf, "nf 4 4"]  # pose of each frame in its parent's joint frame
    position_limit: Float[Leaf, "nv 2"]  # lower, upper; infinite where the model gives none, and for quaternions
    velocity_limit: Float[Leaf, " nv"]
    effort_limit: Float[Leaf, " nv"]
    joints: tuple[Joint, ...] = eqx.field(static=True)
    frames: tuple[Frame, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    __getattribute__ = object.__getattribute__  # methods as Python has them: equinox makes a module of each

    def __repr__(self) -> str:
        names = self.joint_names[:8] + ("...",) * (len(self.joint_names) > 8)
        batch = np.shape(self.gravity)[:-1]
        several = f"{batch} of " if batch else ""
        moving = f"{several}{len(self.joint_names)} joints ({', '.join(names)})"
        return f"RobotModel '{self.name}': {moving}, nq {self.nq}, nv {self.nv}, {len(self.frames)} frames"

    @property
    def nv(self) -> int:
        """Number of coordinates (columns of v, a, tau)."""
        return max((joint.coordinate + len(DOF_NAMES[joint.kind]) for joint in self.joints), default=0)

    @property
    def nq(self) -> int:
        """Numbers in q: `nv`, and one more for each quaternion."""
        return max((columns.stop for columns in self.dofs.positions), default=0)

    @property
    def nd(self) -> int:
        """Number of degrees of freedom of all tree joints, mimic joints included (rows of `axis`)."""
        return len(self.dofs.joint)

    @property
    def dofs(self) -> Dofs:
        """Where the degrees of freedom of the tree joints stand in v and q (static, cached)."""
        return dofs(self.joints)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the independent joints, in the order of their columns (mimic joints follow one of them)."""
        independent = (joint for joint in self.joints if not joint.follows)
        return tuple(joint.name for joint in sorted(independent, key=lambda joint: joint.coordinate))

    @property
    def dof_names(self) -> tuple[str, ...]:
        """Names of the coordinates (columns of v, a, tau): a joint's own, or `root_joint.vx` where it has several."""
        kinds = {joint.name: joint.kind for joint in self.joints}
        return tuple(name + part for name in self.joint_names for part in DOF_NAMES[kinds[name]])

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of the moved links, in tree order (ten regressor columns each)."""
        return tuple(joint.link for joint in self.joints)

    def joint_index(self, name: str) -> int:
        """Column of v of the joint or degree of freedom (`dof_names`) called `name`.

        Raises `InputError` with the nearest known name, and for a joint of several degrees of freedom.
        """
        several = [dof for dof in self.dof_names if dof.startswith(f"{name}.")] if name in self.joint_names else []
        if several and name not in self.dof_names:
            raise InputError(f"joint '{name}' of robot '{self.name}' has {len(several)} columns: {', '.join(several)}")
        return _index(name, self.dof_names, "joint", self.name)

    def tree_index(self, name: str) -> int:
        """Tree index of the joint called `name`, mimic joints among them; raises `InputError` with the nearest name."""
        return _index(name, tuple(joint.name for joint in self.joints), "joint", self.name)

    def link_index(self, name: str) -> int:
        """Tree index of the link called `name`; raises `InputError` with the nearest known name."""
        return _index(name, self.link_names, "link", self.name)

    def frame_index(self, name: str) -> int:
        """Index of the frame called `name`; raises `InputError` with the nearest known name."""
        return _index(name, tuple(frame.name for frame in self.frames), "frame", self.name)


def _index(name: str, names: tuple[str, ...], what: str, robot: str) -> int:
    if name not in names:
        raise InputError(f"robot '{robot}' has no {what} '{name}'{nearest(name, names)}")
    return names.index(name)


def prismatic(model: RobotModel) -> tuple[bool, ...]:
    """Whether each coordinate slides."""
    turns = dict(zip(model.dofs.column.tolist()[::-1], model.dofs.turns.tolist()[::-1], strict=True))
    return tuple(not turns[k] for k in range(model.nv))
