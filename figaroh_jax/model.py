"""The robot: an immutable pytree whose arrays are differentiable leaves and whose tree is static.

Conventions. Motions and wrenches are `[linear, angular]`. Tree joints are numbered depth first, so that the joints
moved by one joint are contiguous. A *coordinate* is an independent joint variable, in the column order of the
recordings; a mimic joint shares the coordinate of the joint it follows. Inertial parameters are Pinocchio's ten,
`[m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz]`, at the joint frame's origin, in the joint frame. Leaves are held in
numpy float64 until a computation takes them, so a model loaded without 64-bit JAX loses nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .errors import InputError, nearest

__all__ = ["Frame", "Joint", "Leaf", "RobotModel"]

# A leaf is NumPy's until a computation takes it, then JAX's; a type checker cannot know which of the two it meets.
if TYPE_CHECKING:
    Leaf = Any
else:
    Leaf = Array | np.ndarray


class Joint(NamedTuple):
    """A moving joint of the tree and the link that it carries."""

    name: str
    kind: Literal["revolute", "prismatic"]
    parent: int  # index of the joint that carries this one, -1: the world
    coordinate: int  # index of the coordinate that moves it
    link: str  # name of the moved link
    follows: bool = False  # mimic: the coordinate is named after another joint


class Frame(NamedTuple):
    """A frame fixed to the link of joint `parent` (-1: the world)."""

    name: str
    parent: int


class RobotModel(eqx.Module):
    """Robot with a fixed root: `nj` tree joints, `nv` coordinates, `nf` frames (metres, radians, kilograms).

    A tree joint's position is `ratio * q[coordinate] + offset`; ratio is 1 and offset 0 except for mimic joints.
    """

    placement: Float[Leaf, "nj 4 4"]  # pose of each joint in its parent's joint frame, at zero
    axis: Float[Leaf, "nj 3"]  # unit axis in the joint frame
    inertia: Float[Leaf, "nj 10"]  # of the link that the joint moves, at and in the joint frame
    ratio: Float[Leaf, " nj"]
    offset: Float[Leaf, " nj"]
    gravity: Float[Leaf, "3"]  # m/s^2, in the world
    frame_placement: Float[Leaf, "nf 4 4"]  # pose of each frame in its parent's joint frame
    position_limit: Float[Leaf, "nv 2"]  # lower, upper; infinite where the model gives none
    velocity_limit: Float[Leaf, " nv"]
    effort_limit: Float[Leaf, " nv"]
    joints: tuple[Joint, ...] = eqx.field(static=True)
    frames: tuple[Frame, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)

    @property
    def nv(self) -> int:
        """Number of coordinates (columns of q, v, a, tau)."""
        return 1 + max((joint.coordinate for joint in self.joints), default=-1)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the coordinates, in column order: the joint that drives each (mimic joints follow it)."""
        names = [""] * self.nv
        for joint in self.joints:
            if not joint.follows:
                names[joint.coordinate] = joint.name
        return tuple(names)

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of the moved links, in tree order (ten regressor columns each)."""
        return tuple(joint.link for joint in self.joints)

    def joint_index(self, name: str) -> int:
        """Column of the joint called `name`; raises `InputError` with the nearest known name."""
        return _index(name, self.joint_names, "joint", self.name)

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
