"""Scalars of a rigid body for programs that hold one sample: numbers of a robot, vectors, poses, motions of links.

What is known before (zeros and ones of placements, axes and inertias) is left out of what they compute. Vectors are in
the axes of the link at hand, which spares turning its inertia; accelerations are the classical ones of the link's
origin, less gravity.
"""

from __future__ import annotations

from itertools import accumulate
from math import factorial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from ..compiled.kernels import Load, Number, Read
from .model import Joint, RobotModel, dofs

__all__ = [
    "LOADED",
    "NONE",
    "ONE",
    "ZERO",
    "PER_JOINT",
    "PER_DOF",
    "PLACES",
    "Matrix",
    "Vector",
    "Motion",
    "Pose",
    "Robot",
    "add",
    "at_rest",
    "codes_of_lengths",
    "constants",
    "cross",
    "dot",
    "known",
    "known_lengths",
    "moved_by",
    "nothing_known",
    "pose_of",
    "product",
    "scaled",
    "second_moments",
    "sine_cosine",
    "spin_of",
    "turned",
    "turned_back",
]

LOADED = 2  # code of a constant that is not known before; -1, 0 and 1 stand for themselves
_SIZES = {"rotation": 9, "origin": 3, "across": 9, "twice": 9, "inertia": 10, "second": 6, "ratio": 1, "offset": 1}
PER_JOINT = sum(_SIZES.values())
PLACES = dict(zip(_SIZES, accumulate(_SIZES.values(), initial=0), strict=False))
PER_DOF = {"axis": 3, "along": 3}


ZERO, ONE = Number(0.0), Number(1.0)
Vector = tuple[Number, ...]  # of three
Matrix = tuple[Vector, ...]  # its rows


def dot(u: Vector, v: Vector) -> Number:
    """u . v"""
    total = ZERO
    for x, y in zip(u, v, strict=True):
        total = total + x * y
    return total


def cross(u: Vector, v: Vector) -> Vector:
    """u x v"""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


def add(*vectors: Vector) -> Vector:
    """Sum of vectors."""
    first, *more = vectors
    for v in more:
        first = tuple(x + y for x, y in zip(first, v, strict=True))
    return first


def scaled(u: Vector, x: Number) -> Vector:
    """x u"""
    return tuple(y * x for y in u)


def turned(R: Matrix, u: Vector) -> Vector:
    """R u"""
    return tuple(dot(row, u) for row in R)


def turned_back(R: Matrix, u: Vector) -> Vector:
    """R' u"""
    return tuple(dot(tuple(row[k] for row in R), u) for k in range(3))


NONE: Vector = (ZERO, ZERO, ZERO)


def constants(model: RobotModel, dtype: Any = float, space: Any = jnp) -> Any:
    """What the programs take from a model, in one row: joint by joint, then dof by dof, then gravity."""
    placement, axis = space.asarray(model.placement, dtype), space.asarray(model.axis, dtype)
    rotation, joint = placement[:, :3, :3], model.dofs.joint
    hinge = model.dofs.first + np.array([_HINGE.get(one.kind, 0) for one in model.joints], int)
    across = space.cross(rotation, axis[hinge][:, None])
    inertia = space.asarray(model.inertia, dtype)
    second = second_moments(inertia)
    n, nd = len(model.joints), len(joint)
    columns = [rotation.reshape(n, 9), placement[:, :3, 3], across.reshape(n, 9)]
    columns += [space.cross(across, axis[hinge][:, None]).reshape(n, 9), inertia, second]
    columns += [space.asarray(x, dtype)[:, None] for x in (model.ratio, model.offset)]
    along = space.sum(rotation[joint] * axis[:, None], -1)
    by_dof = space.concatenate([axis, along], 1).reshape(6 * nd)
    gravity = space.asarray(model.gravity, dtype)
    return space.concatenate([space.concatenate(columns, 1).reshape(n * PER_JOINT), by_dof, gravity])


def second_moments(inertia: Any) -> Any:
    """Second moments of mass (joints, 6) of inertial parameters (joints, 10)."""
    half = 0.5 * (inertia[:, 4] + inertia[:, 6] + inertia[:, 9])
    return np.array([1, 0, 1, 0, 0, 1]) * half[:, None] - inertia[:, 4:]


_HINGE = {"planar": 2}  # the degree of freedom, counted in the joint, about which its angle turns


def known(model: RobotModel) -> bytes:
    """Which of the constants are 0, 1 or -1, for a model whose arrays are NumPy's; any other is loaded."""
    values = constants(model, float, np)
    codes = np.where(np.isin(values, (-1.0, 0.0, 1.0)), values, LOADED).astype(np.int8)
    return codes.tobytes()


def known_lengths(model: RobotModel, table: Float[np.ndarray, " constants"]) -> bytes:
    """As `known`, of the model's constants, but for what is fitted and tried: inertial parameters and gravity."""
    codes = codes_of_lengths(table, len(model.joints))
    codes[-3:] = LOADED
    return codes.tobytes()


def codes_of_lengths(table: Float[np.ndarray, " constants"], joints: int) -> np.ndarray:
    """What `known_lengths` keeps as bytes: -1, 0 or 1 for a constant of that value, else `LOADED`."""
    codes = np.where(np.isin(table, (-1.0, 0.0, 1.0)), table, LOADED).astype(np.int8)
    codes[: joints * PER_JOINT].reshape(-1, PER_JOINT)[:, PLACES["inertia"] : PLACES["ratio"]] = LOADED
    return codes


def nothing_known(joints: tuple[Joint, ...]) -> bytes:
    """In place of `known`, for a model whose arrays are being traced."""
    return np.full(len(joints) * PER_JOINT + 6 * len(dofs(joints).joint) + 3, LOADED, np.int8).tobytes()


class Robot:
    """A robot's structure and where its numbers come from: `load(k)` gives the k-th constant."""

    def __init__(self, joints: tuple[Joint, ...], codes: bytes, load: Load) -> None:
        self.joints, self.dofs, self.load = joints, dofs(joints), load
        self.codes = np.frombuffer(codes, np.int8)

    def _at(self, k: int) -> Number:
        code = self.codes[k]
        return Number(self.load(k)) if code == LOADED else Number(float(code))

    def of_joint(self, i: int, what: str) -> list[Number]:
        """Numbers of joint i by name."""
        first = i * PER_JOINT + PLACES[what]
        return [self._at(first + k) for k in range(_SIZES[what])]

    def of_dof(self, k: int, what: str) -> Vector:
        """Three numbers of the degree of freedom k by name."""
        first = len(self.joints) * PER_JOINT + 6 * k + 3 * list(PER_DOF).index(what)
        return self._at(first), self._at(first + 1), self._at(first + 2)

    def gravity(self) -> Vector:
        """Gravity in the world, m/s^2."""
        first = len(self.codes) - 3
        return self._at(first), self._at(first + 1), self._at(first + 2)

    def matrix(self, i: int, what: str) -> Matrix:
        """Nine numbers of joint i as rows."""
        x = self.of_joint(i, what)
        return tuple(x[:3]), tuple(x[3:6]), tuple(x[6:])

    def own(self, i: int) -> range:
        """Degrees of freedom of joint i."""
        first = int(self.dofs.first[i])
        return range(first, first + int((self.dofs.joint == i).sum()))

    def children(self, i: int) -> list[int]:
        """Joints that hang on joint i."""
        return [k for k, joint in enumerate(self.joints) if joint.parent == i]

    def above(self, i: int) -> list[int]:
        """Joints that move joint i's frame, from the world on."""
        out: list[int] = []
        while i >= 0 and self.joints[i].parent >= 0:
            i = self.joints[i].parent
            out.insert(0, i)
        return out


class Pose(NamedTuple):
    """Of a link in its parent: rotation (child to parent) = fixed . turn about axis `about` of the frame, and origin.

    Apart, the two cost less than their product where the fixed one is mostly zeros and ones, and leave two numbers to
    remember instead of nine.
    """

    fixed: Matrix
    origin: Vector
    about: int | None = None
    sine: Number = ZERO
    cosine: Number = ONE

    def turn(self, u: Vector) -> Vector:
        """From the link's axes to its parent's."""
        return turned(self.fixed, self._about(u, self.sine))

    def turn_back(self, u: Vector) -> Vector:
        """From the parent's axes to the link's."""
        return self._about(turned_back(self.fixed, u), -self.sine)

    def matrix(self) -> Matrix:
        """Rotation as one matrix."""
        return tuple(self._about(row, -self.sine) for row in self.fixed)

    def _about(self, u: Vector, sine: Number) -> Vector:
        if self.about is None:
            return u
        one, two = (self.about + 1) % 3, (self.about + 2) % 3
        new = list(u)
        new[one], new[two] = u[one] * self.cosine - u[two] * sine, u[one] * sine + u[two] * self.cosine
        return tuple(new)


def pose_of(robot: Robot, i: int, q: Read) -> Pose:
    """Pose of joint `i` in its parent joint's frame at the coordinates `q`, with what is simple about it kept apart."""
    joint, own, at = robot.joints[i], robot.own(i), robot.dofs.positions[i]
    ratio, offset = robot.of_joint(i, "ratio")[0], robot.of_joint(i, "offset")[0]
    rotation, origin = robot.matrix(i, "rotation"), tuple(robot.of_joint(i, "origin"))
    ways = {"prismatic": 1, "planar": 2, "free": 3}.get(joint.kind, 0)
    for k in range(ways):
        way = q(at.start + k) * ratio + offset
        origin = add(origin, scaled(robot.of_dof(own[k], "along"), way))
    if joint.kind in ("spherical", "free"):
        return Pose(product(rotation, _quaternion(*(q(k) for k in range(at.stop - 4, at.stop)))), origin)
    if joint.kind == "prismatic":
        return Pose(rotation, origin)
    sine, cosine = sine_cosine(q(at.stop - 1) * ratio + offset)
    axis = robot.of_dof(own[-1], "axis")
    plain = [k for k in range(3) if axis[k].known and abs(axis[k].x) == 1.0]
    if len(plain) == 1 and all(x.known for x in axis):
        pose = Pose(rotation, origin, plain[0], sine * axis[plain[0]], cosine)
        return pose if sum(x.known for row in rotation for x in row) >= _SPARSE else Pose(pose.matrix(), origin)
    return Pose(_rodrigues(robot, i, sine, cosine), origin)


_SPARSE = 5  # numbers of nine of a fixed rotation that are 0, 1 or -1, for it to stay apart


def _rodrigues(robot: Robot, i: int, sine: Number, cosine: Number) -> Matrix:
    """R0 (1 + sin [a] + (1 - cos) [a]^2) for any axis a."""
    parts, less = [robot.matrix(i, what) for what in ("rotation", "across", "twice")], ONE - cosine
    return tuple(
        tuple(r + x * sine + y * less for r, x, y in zip(*rows, strict=True)) for rows in zip(*parts, strict=True)
    )


def product(A: Matrix, B: Matrix) -> Matrix:
    """A B"""
    return tuple(tuple(dot(row, tuple(b[k] for b in B)) for k in range(3)) for row in A)


def _quaternion(x: Number, y: Number, z: Number, w: Number) -> Matrix:
    length = x * x + y * y + z * z + w * w
    s = Number(lax.div(lax.full_like(length.x, 2.0), length.x))
    return (
        (ONE - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)),
        (s * (x * y + z * w), ONE - s * (x * x + z * z), s * (y * z - x * w)),
        (s * (x * z - y * w), s * (y * z + x * w), ONE - s * (x * x + y * y)),
    )


# a quarter turn in parts of 30 bits, so that its product with a whole number below 2^22 is exact
_PARTS = (3.141592651605606 / 2, 1.9841871583270443e-09 / 2, 1.034036596358821e-18 / 2)
_SINE = [(-1) ** k / factorial(2 * k + 1) for k in range(7, 0, -1)]  # to r^15: 5e-17 at an eighth of a turn
_COSINE = [(-1) ** k / factorial(2 * k) for k in range(8, 0, -1)]  # to r^16: 2e-18


def sine_cosine(angle: Number) -> tuple[Number, Number]:
    """Sine and cosine (rad), to 2e-16 up to 1e5 rad in float64: of the rest behind quarter turns, by their series."""
    x = angle.x
    if x.dtype != jnp.float64:
        return Number(lax.sin(x)), Number(lax.cos(x))
    one = lambda value: lax.full_like(x, value)  # noqa: E731
    turns = lax.floor(x * one(2.0 / np.pi) + one(0.5))
    rest = ((x - turns * one(_PARTS[0])) - turns * one(_PARTS[1])) - turns * one(_PARTS[2])
    square = rest * rest
    sine, cosine = one(_SINE[0]), one(_COSINE[0])
    for term in _SINE[1:]:
        sine = sine * square + one(term)
    for term in _COSINE[1:]:
        cosine = cosine * square + one(term)
    sine, cosine = rest + rest * square * sine, one(1.0) + square * cosine
    bits = lax.convert_element_type(turns, jnp.int32)
    whole = lambda value: lax.full_like(bits, value)  # noqa: E731
    odd = (bits & whole(1)) != whole(0)
    first, second = lax.select(odd, cosine, sine), lax.select(odd, sine, cosine)
    down = (bits & whole(2)) != whole(0)
    away = ((bits + whole(1)) & whole(2)) != whole(0)
    return Number(lax.select(down, -first, first)), Number(lax.select(away, -second, second))


class Motion(NamedTuple):
    """Of a link, in its own axes: angular velocity and acceleration, acceleration of its origin less gravity."""

    w: Vector
    al: Vector
    ac: Vector


def spin_of(motion: Motion) -> Matrix:
    """D = [al] + [w][w]: what the acceleration of a point gains with its place in the link."""
    (x, y, z), (ax, ay, az) = motion.w, motion.al
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return (-(yy + zz), xy - az, xz + ay), (xy + az, -(xx + zz), yz - ax), (xz - ay, yz + ax, -(xx + yy))


def at_rest(robot: Robot) -> Motion:
    """Of the world."""
    return Motion(NONE, NONE, tuple(-x for x in robot.gravity()))


def moved_by(robot: Robot, i: int, pose: Pose, above: Motion, spin: Matrix, v: Read, a: Read) -> Motion:
    """Motion of link i from that of the link that carries it, whose D is `spin`."""
    ratio = robot.of_joint(i, "ratio")[0]
    w_before, al = pose.turn_back(above.w), pose.turn_back(above.al)
    ac = pose.turn_back(add(above.ac, turned(spin, pose.origin)))
    turning, turning_up, sliding = NONE, NONE, NONE
    for k in robot.own(i):
        axis, column = robot.of_dof(k, "axis"), int(robot.dofs.column[k])
        rate, push = v(column) * ratio, a(column) * ratio
        if robot.dofs.turns[k]:
            turning, turning_up = add(turning, scaled(axis, rate)), add(turning_up, scaled(axis, push))
        else:
            sliding, ac = add(sliding, scaled(axis, rate)), add(ac, scaled(axis, push))
    w = add(w_before, turning)
    al = add(al, turning_up, cross(w_before, turning))
    return Motion(w, al, add(ac, cross(add(w_before, w), sliding)))
