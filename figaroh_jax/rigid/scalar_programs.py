"""The rigid body written out in scalars, for kernels that hold one sample of the states in registers.

Each function runs once, while a kernel is traced: it walks the tree in Python and leaves one multiplication or
addition behind for every product and sum that the robot's structure calls for. What is known before (zeros and ones of
placements, axes and inertias) is left out. Vectors are in the axes of the link at hand, which spares turning its
inertia; accelerations are the classical ones of the link's origin, less gravity. The tree is walked depth first and a
limb is finished before the next begins, so that few numbers are alive at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from itertools import accumulate
from math import factorial
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..compiled.batching import CPU_OPTIONS, in_one_program
from ..compiled.kernels import Load, Number, Program, Read, Straight, Write
from .kinematics import ancestors
from .model import Joint, Leaf, RobotModel, dofs

__all__ = [
    "ACCELERATIONS",
    "BLOCKS",
    "COLUMNS",
    "DENSE",
    "LIMB_TORQUES",
    "MASSES",
    "PACKED",
    "TORQUES",
    "Written",
    "in_limbs",
    "straight",
    "weighted_rows",
    "written",
    "written_torques",
]

LOADED = 2  # code of a constant that is not known before; -1, 0 and 1 stand for themselves
_SIZES = {"rotation": 9, "origin": 3, "across": 9, "twice": 9, "inertia": 10, "second": 6, "ratio": 1, "offset": 1}
_PER_JOINT = sum(_SIZES.values())
_PLACES = dict(zip(_SIZES, accumulate(_SIZES.values(), initial=0), strict=False))
_PER_DOF = {"axis": 3, "along": 3}
MOST_WRITTEN, _TURNED = 10, 3  # joints; numbers of a joint's rotation, on average, that may be other than 0, 1, -1


ZERO, ONE = Number(0.0), Number(1.0)
Vector = tuple[Number, ...]  # of three
Matrix = tuple[Vector, ...]  # its rows


def _dot(u: Vector, v: Vector) -> Number:
    total = ZERO
    for x, y in zip(u, v, strict=True):
        total = total + x * y
    return total


def _cross(u: Vector, v: Vector) -> Vector:
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


def _add(*vectors: Vector) -> Vector:
    first, *more = vectors
    for v in more:
        first = tuple(x + y for x, y in zip(first, v, strict=True))
    return first


def _scale(u: Vector, x: Number) -> Vector:
    return tuple(y * x for y in u)


def _turn(R: Matrix, u: Vector) -> Vector:
    return tuple(_dot(row, u) for row in R)


def _turn_back(R: Matrix, u: Vector) -> Vector:
    return tuple(_dot(tuple(row[k] for row in R), u) for k in range(3))


_NONE: Vector = (ZERO, ZERO, ZERO)


def constants(model: RobotModel, dtype: Any = float, space: Any = jnp) -> Any:
    """What the programs take from a model, in one row: joint by joint, then dof by dof, then gravity."""
    placement, axis = space.asarray(model.placement, dtype), space.asarray(model.axis, dtype)
    rotation, joint = placement[:, :3, :3], model.dofs.joint
    hinge = model.dofs.first + np.array([_HINGE.get(one.kind, 0) for one in model.joints], int)
    across = space.cross(rotation, axis[hinge][:, None])
    inertia = space.asarray(model.inertia, dtype)
    second = _second_moments(inertia)
    n, nd = len(model.joints), len(joint)
    columns = [rotation.reshape(n, 9), placement[:, :3, 3], across.reshape(n, 9)]
    columns += [space.cross(across, axis[hinge][:, None]).reshape(n, 9), inertia, second]
    columns += [space.asarray(x, dtype)[:, None] for x in (model.ratio, model.offset)]
    along = space.sum(rotation[joint] * axis[:, None], -1)
    by_dof = space.concatenate([axis, along], 1).reshape(6 * nd)
    gravity = space.asarray(model.gravity, dtype)
    return space.concatenate([space.concatenate(columns, 1).reshape(n * _PER_JOINT), by_dof, gravity])


def _second_moments(inertia: Any) -> Any:
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
    """As `known`, of the model's constants, but for inertial parameters: what a robot is taken to weigh is loaded."""
    return _codes_of_lengths(table, len(model.joints)).tobytes()


def _codes_of_lengths(table: Float[np.ndarray, " constants"], joints: int) -> np.ndarray:
    codes = np.where(np.isin(table, (-1.0, 0.0, 1.0)), table, LOADED).astype(np.int8)
    codes[: joints * _PER_JOINT].reshape(-1, _PER_JOINT)[:, _PLACES["inertia"] : _PLACES["ratio"]] = LOADED
    return codes


def nothing_known(joints: tuple[Joint, ...]) -> bytes:
    """In place of `known`, for a model whose arrays are being traced."""
    return np.full(len(joints) * _PER_JOINT + 6 * len(dofs(joints).joint) + 3, LOADED, np.int8).tobytes()


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
        first = i * _PER_JOINT + _PLACES[what]
        return [self._at(first + k) for k in range(_SIZES[what])]

    def of_dof(self, k: int, what: str) -> Vector:
        """Three numbers of the degree of freedom k by name."""
        first = len(self.joints) * _PER_JOINT + 6 * k + 3 * list(_PER_DOF).index(what)
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
        return _turn(self.fixed, self._about(u, self.sine))

    def turn_back(self, u: Vector) -> Vector:
        """From the parent's axes to the link's."""
        return self._about(_turn_back(self.fixed, u), -self.sine)

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


def _pose(robot: Robot, i: int, q: Read) -> Pose:
    joint, own, at = robot.joints[i], robot.own(i), robot.dofs.positions[i]
    ratio, offset = robot.of_joint(i, "ratio")[0], robot.of_joint(i, "offset")[0]
    rotation, origin = robot.matrix(i, "rotation"), tuple(robot.of_joint(i, "origin"))
    ways = {"prismatic": 1, "planar": 2, "free": 3}.get(joint.kind, 0)
    for k in range(ways):
        way = q(at.start + k) * ratio + offset
        origin = _add(origin, _scale(robot.of_dof(own[k], "along"), way))
    if joint.kind in ("spherical", "free"):
        return Pose(_product(rotation, _quaternion(*(q(k) for k in range(at.stop - 4, at.stop)))), origin)
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


def _product(A: Matrix, B: Matrix) -> Matrix:
    return tuple(tuple(_dot(row, tuple(b[k] for b in B)) for k in range(3)) for row in A)


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


def _spin(motion: Motion) -> Matrix:
    """D = [al] + [w][w]: what the acceleration of a point gains with its place in the link."""
    (x, y, z), (ax, ay, az) = motion.w, motion.al
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return (-(yy + zz), xy - az, xz + ay), (xy + az, -(xx + zz), yz - ax), (xz - ay, yz + ax, -(xx + yy))


def _rest(robot: Robot) -> Motion:
    """Of the world."""
    return Motion(_NONE, _NONE, tuple(-x for x in robot.gravity()))


def _moved(robot: Robot, i: int, pose: Pose, above: Motion, spin: Matrix, v: Read, a: Read) -> Motion:
    """Motion of link i from that of the link that carries it, whose D is `spin`."""
    ratio = robot.of_joint(i, "ratio")[0]
    w_before, al = pose.turn_back(above.w), pose.turn_back(above.al)
    ac = pose.turn_back(_add(above.ac, _turn(spin, pose.origin)))
    turning, turning_up, sliding = _NONE, _NONE, _NONE
    for k in robot.own(i):
        axis, column = robot.of_dof(k, "axis"), int(robot.dofs.column[k])
        rate, push = v(column) * ratio, a(column) * ratio
        if robot.dofs.turns[k]:
            turning, turning_up = _add(turning, _scale(axis, rate)), _add(turning_up, _scale(axis, push))
        else:
            sliding, ac = _add(sliding, _scale(axis, rate)), _add(ac, _scale(axis, push))
    w = _add(w_before, turning)
    al = _add(al, turning_up, _cross(w_before, turning))
    return Motion(w, al, _add(ac, _cross(_add(w_before, w), sliding)))


def _carried(robot: Robot, i: int, motion: Motion, spin: Matrix) -> tuple[Vector, Vector]:
    """Force on link i and torque about its origin."""
    m, h = robot.of_joint(i, "inertia")[0], tuple(robot.of_joint(i, "inertia")[1:4])
    xx, xy, yy, xz, yz, zz = robot.of_joint(i, "second")
    S = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    force = _add(_scale(motion.ac, m), _turn(spin, h))
    about = tuple(_dot(spin[(k + 2) % 3], S[(k + 1) % 3]) - _dot(spin[(k + 1) % 3], S[(k + 2) % 3]) for k in range(3))
    return force, _add(_cross(h, motion.ac), about)


def torques(
    robot: Robot,
    q: Read,
    v: Read,
    a: Read,
    put: Callable[[int, Number], None],
    limbs: Sequence[int] = (),
    limb: int = -1,
    hand: Callable[[list[Number]], None] = lambda six: None,
    taken: Callable[[int], list[Number]] = lambda child: [],
) -> None:
    """Newton and Euler's recursion (Luh, Walker and Paul, 1980): `put` receives the torque of every coordinate.

    Where `limbs` are told, by their first joints, only those of `limb` are put. Its motion comes from the world anew;
    `taken` gives the force and the torque of a limb that hangs on it, as that limb had them for `hand`: about the
    origin of the link that carries it, in its axes.
    """
    total: dict[int, Number] = {}
    left = np.bincount(robot.dofs.column)

    def visit(i: int, above: Motion, spin: Matrix) -> tuple[Vector, Vector]:
        pose = _pose(robot, i, q)
        motion = _moved(robot, i, pose, above, spin, v, a)
        own = _spin(motion)
        force, torque = _carried(robot, i, motion, own)
        for child in robot.children(i):
            if child in limbs:
                six = taken(child)
                there, about = tuple(six[:3]), tuple(six[3:])
            else:
                there, about = visit(child, motion, own)
            force, torque = _add(force, there), _add(torque, about)
        ratio = robot.of_joint(i, "ratio")[0]
        for k in robot.own(i):
            column = int(robot.dofs.column[k])
            along = _dot(robot.of_dof(k, "axis"), torque if robot.dofs.turns[k] else force) * ratio
            total[column] = total[column] + along if column in total else along
            left[column] -= 1
            if not left[column]:
                put(column, total.pop(column))
        if robot.joints[i].parent < 0:
            return _NONE, _NONE
        up = pose.turn(force)
        return up, _add(pose.turn(torque), _cross(pose.origin, up))

    motion = _rest(robot)
    spin = _spin(motion)
    for i in robot.above(limb):
        motion = _moved(robot, i, _pose(robot, i, q), motion, spin, v, a)
        spin = _spin(motion)
    for i in [limb] if limb >= 0 else robot.children(-1):
        up, about = visit(i, motion, spin)
        if limb >= 0 and robot.joints[i].parent >= 0:
            hand([*up, *about])


class Written(eqx.Module):
    """A robot whose program is written out in scalars: its numbers, and which of them the program knows before.

    Inertial parameters and gravity are never known, so that one program serves all that a robot is taken to weigh, and
    a tilted base.
    """

    table: Float[Leaf, " constants"]
    joints: tuple[Joint, ...] = eqx.field(static=True)
    codes: bytes = eqx.field(static=True)


def written(model: RobotModel) -> Written | None:
    """The robot for `written_torques` on a CPU; None where the program would take longer to compile than it spares.

    The compiler must put all of it into one loop over the samples, which it does with the options of JAX before 0.11;
    there a sample of six joints takes a ninth of the time of the plain kernel.
    """
    if not CPU_OPTIONS or len(model.joints) > MOST_WRITTEN:
        return None
    lengths = tuple(np.asarray(x) for x in (model.placement, model.axis, model.ratio, model.offset, model.gravity))
    last = _LAST.get(model.joints)
    if last is None or not all(x is y or np.array_equal(x, y) for x, y in zip(lengths, last[0], strict=True)):
        last = _LAST[model.joints] = (lengths, *_structure(model))
    _, table, codes = last
    if codes is None:
        return None
    table, inertia = table.copy(), np.asarray(model.inertia, float)
    of_joint = table[: len(model.joints) * _PER_JOINT].reshape(-1, _PER_JOINT)
    of_joint[:, _PLACES["inertia"] : _PLACES["ratio"]] = np.concatenate([inertia, _second_moments(inertia)], 1)
    return Written(table, model.joints, codes)


_LAST: dict[tuple[Joint, ...], tuple[tuple[np.ndarray, ...], np.ndarray, bytes | None]] = {}  # of each structure


def _structure(model: RobotModel) -> tuple[Float[np.ndarray, " constants"], bytes | None]:
    """All numbers of a robot, and the codes of its program where it is to be written out."""
    table = constants(model, float, np)
    codes = np.where(np.isin(table, (-1.0, 0.0, 1.0)), table, LOADED).astype(np.int8)
    by_joint = codes[: len(model.joints) * _PER_JOINT].reshape(-1, _PER_JOINT)
    by_joint[:, _PLACES["inertia"] : _PLACES["ratio"]] = LOADED
    codes[-3:] = LOADED
    turned = by_joint[:, : _PLACES["origin"]] == LOADED
    return table, None if turned.sum() > _TURNED * len(model.joints) else codes.tobytes()


def written_torques(
    robot: Written, q: Float[Array, "nq samples"], v: Float[Array, "nv samples"], a: Float[Array, "nv samples"]
) -> Float[Array, "nv samples"]:
    """Kernel of `inverse_dynamics` for a robot that is `written` out."""
    out: dict[int, Array] = {}
    whole = lambda x: jnp.broadcast_to(jnp.asarray(x, q.dtype), q.shape[1:])  # noqa: E731
    of_lanes = Robot(robot.joints, robot.codes, lambda k: whole(robot.table[k]))
    reads = [lambda k, x=x: Number(x[k]) for x in (q, v, a)]
    torques(of_lanes, reads[0], reads[1], reads[2], lambda column, number: out.update({column: whole(number.x)}))
    return jnp.stack([out[column] for column in sorted(out)])


class Twist(NamedTuple):
    """Velocity of a link for a unit rate of one that moves it, at its origin and in its axes."""

    row: int
    linear: Vector
    angular: Vector


def regressor_blocks(
    robot: Robot,
    q: Read,
    v: Read,
    a: Read,
    put: Callable[[int, int, list[Number]], None],
    links: Sequence[int] | None = None,
    coordinates: bool = False,
) -> None:
    """`put(row, link, ten)` for every link (of `links`) and every degree of freedom, or coordinate, that moves it.

    The ten columns of a link: lin . F + ang . T with the force and the torque of a unit of each parameter, where
    F = [ac, D, 0] and T = [0, -[ac], L(al) + [w] L(w)].
    """
    wanted = set(range(len(robot.joints)) if links is None else links)
    needed = set(wanted)
    for i in sorted(wanted, reverse=True):
        while robot.joints[i].parent >= 0:
            i = robot.joints[i].parent
            needed.add(i)

    def visit(i: int, above: Motion, spin: Matrix, twists: list[Twist]) -> None:
        pose = _pose(robot, i, q)
        motion = _moved(robot, i, pose, above, spin, v, a)
        own = _spin(motion)
        here = _merged(robot, i, [_seen(pose, t) for t in twists], coordinates)
        if i in wanted:
            for twist in here:
                put(twist.row, i, _columns(twist, motion, own))
        for child in robot.children(i):
            if child in needed:
                visit(child, motion, own, here)

    still = _rest(robot)
    for i in robot.children(-1):
        if i in needed:
            visit(i, still, _spin(still), [])


def _seen(pose: Pose, twist: Twist) -> Twist:
    at = _add(twist.linear, _cross(twist.angular, pose.origin))
    return Twist(twist.row, pose.turn_back(at), pose.turn_back(twist.angular))


def _merged(robot: Robot, i: int, twists: list[Twist], coordinates: bool) -> list[Twist]:
    """Those of the links above and of joint i; of one coordinate they add up, each times its ratio."""
    ratio, here = robot.of_joint(i, "ratio")[0], list(twists)
    for k in robot.own(i):
        axis = robot.of_dof(k, "axis")
        if not coordinates:
            here.append(Twist(k, *((_NONE, axis) if robot.dofs.turns[k] else (axis, _NONE))))
            continue
        axis, row = _scale(axis, ratio), int(robot.dofs.column[k])
        new = Twist(row, *((_NONE, axis) if robot.dofs.turns[k] else (axis, _NONE)))
        same = [n for n, t in enumerate(here) if t.row == row]
        if same:
            old = here[same[0]]
            here[same[0]] = Twist(row, _add(old.linear, new.linear), _add(old.angular, new.angular))
        else:
            here.append(new)
    return here


def _columns(twist: Twist, motion: Motion, spin: Matrix) -> list[Number]:
    lin, ang, (w, al, ac) = twist.linear, twist.angular, motion
    first = _add(_turn_back(spin, lin), _cross(ac, ang))
    g = _cross(ang, w)

    def one(i: int, j: int) -> Number:
        straight = ang[i] * al[j] + g[i] * w[j]
        return straight if i == j else straight + ang[j] * al[i] + g[j] * w[i]

    return [_dot(lin, ac), *first, one(0, 0), one(0, 1), one(1, 1), one(0, 2), one(1, 2), one(2, 2)]


class Body(NamedTuple):
    """Of all that a joint carries, about its origin, in its axes: mass, first moments and moments of inertia."""

    m: Number
    h: Vector
    inertia: Matrix


def mass_entries(robot: Robot, q: Read, put: Callable[[int, int, Number], None]) -> None:
    """Composite bodies (Featherstone 2008, section 6.2): `put(row, column, number)` for rows not above the column.

    Entries that are zero by structure are not put. Joints that share a coordinate add up when the last is there.
    """
    poses: dict[int, Pose] = {}
    total: dict[tuple[int, int], Number] = {}
    column, carried_by = robot.dofs.column, robot.joints

    def add(k: int, above: int, value: Number, ratio: Number) -> None:
        place = (max(int(column[k]), int(column[above])), min(int(column[k]), int(column[above])))
        value = value * ratio
        if column[k] == column[above] and k != above:
            value = value + value
        total[place] = total[place] + value if place in total else value

    def visit(i: int) -> Body:
        poses[i] = _pose(robot, i, q)
        xs = robot.of_joint(i, "inertia")
        xx, xy, yy, xz, yz, zz = xs[4:]
        body = Body(xs[0], tuple(xs[1:4]), ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
        for child in robot.children(i):
            body = _joined(body, _shifted(visit(child), poses[child]))
        project(i, body)
        return body

    def project(i: int, body: Body) -> None:
        ratio = robot.of_joint(i, "ratio")[0]
        for k in robot.own(i):
            axis = robot.of_dof(k, "axis")
            if robot.dofs.turns[k]:
                force, torque = _cross(axis, body.h), _turn(body.inertia, axis)
            else:
                force, torque = _scale(axis, body.m), _cross(body.h, axis)
            for n in range(robot.own(i)[0], k + 1):
                add(k, n, _dot(robot.of_dof(n, "axis"), torque if robot.dofs.turns[n] else force), ratio * ratio)
            j = i
            while carried_by[j].parent >= 0:
                pose, j = poses[j], carried_by[j].parent
                force = pose.turn(force)
                torque = _add(pose.turn(torque), _cross(pose.origin, force))
                both = ratio * robot.of_joint(j, "ratio")[0]
                for n in robot.own(j):
                    add(k, n, _dot(robot.of_dof(n, "axis"), torque if robot.dofs.turns[n] else force), both)

    for i in robot.children(-1):
        visit(i)
    for (row, col), value in total.items():
        put(row, col, value)


def accelerations(robot: Robot, q: Read, v: Read, tau: Read, put: Callable[[int, Number], None]) -> None:
    """`put` receives the acceleration of every coordinate: a = M^-1 (tau - bias), M = L'DL (Featherstone 2008, 8.5).

    From the last coordinate to the first that leaves the zeros of a tree where they are.
    """
    rest: dict[int, Number] = {}
    M: dict[tuple[int, int], Number] = {}
    torques(robot, q, v, lambda k: ZERO, lambda row, bias: rest.update({row: bias}))
    rest = {row: tau(row) - bias for row, bias in rest.items()}
    mass_entries(robot, q, lambda row, column, number: M.update({(row, column): number}))
    order = sorted(rest)
    above = {k: [i for i in order[:n] if (k, i) in M] for n, k in enumerate(order)}
    inverse: dict[int, Number] = {}
    for k in reversed(order):
        inverse[k] = _inverse(M[k, k])
        for i in reversed(above[k]):
            share = M[k, i] * inverse[k]
            for j in above[k]:
                if j <= i:
                    M[i, j] = M.get((i, j), ZERO) - share * M[k, j]
                    above[i] = sorted({*above[i], *([j] if j < i else [])})
            M[k, i] = share
            rest[i] = rest[i] - share * rest[k]
    for k in order:
        rest[k] = rest[k] * inverse[k]
        for i in above[k]:
            rest[k] = rest[k] - M[k, i] * rest[i]
        put(k, rest[k])


def _inverse(x: Number) -> Number:
    return Number(float("nan")) if x.known else Number(lax.div(lax.full_like(x.x, 1.0), x.x))


def _joined(one: Body, two: Body) -> Body:
    rows = tuple(_add(x, y) for x, y in zip(one.inertia, two.inertia, strict=True))
    return Body(one.m + two.m, _add(one.h, two.h), rows)


def _shifted(body: Body, pose: Pose) -> Body:
    """Of the parent's origin and axes: R I R' + (2 h.p + m p.p) 1 - (h p' + p h') - m p p', h turned before."""
    R, p, m = pose.matrix(), pose.origin, body.m
    h, turned = pose.turn(body.h), _product(R, body.inertia)
    whole = _add(_scale(p, m), h)
    away = _dot(h, p) + _dot(whole, p)

    def entry(i: int, j: int) -> Number:
        value = _dot(turned[i], R[j]) - (h[i] * p[j] + p[i] * whole[j])
        return value + away if i == j else value

    xx, xy, yy, xz, yz, zz = (entry(*ij) for ij in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)))
    return Body(m, whole, ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))


def columns(model: RobotModel) -> list[list[tuple[int, int]]]:
    """Columns of q, v and a (arrays 0, 1, 2) that belong to each joint, one after the other; none twice."""
    places, seen, out = model.dofs, set[tuple[int, int]](), []
    for i in range(len(model.joints)):
        moved = [int(k) for k in places.column[places.joint == i]]
        own = [(0, k) for k in range(places.positions[i].start, places.positions[i].stop)]
        own += [(array, k) for array in (1, 2) for k in moved]
        out.append([one for one in own if one not in seen])
        seen |= set(own)
    return [group for group in out if group]


def _torques(model: RobotModel, codes: bytes) -> list[Program]:
    def inverse_dynamics(load: Load, reads: list[Read], write: Write) -> None:
        q, v, a = reads[:3]
        torques(Robot(model.joints, codes, load), q, v, a, lambda row, number: write([((row,), number)]))

    return [inverse_dynamics]


LIMB = 10  # joints of which one kernel holds the torques: the numbers of more are not held by a lane's registers


@lru_cache(maxsize=64)
def _limbs(joints: tuple[Joint, ...]) -> tuple[int, ...]:
    """First joints of parts of the tree, so many joints at the most in each, those further out before others.

    None at all where the tree is one part, or where two parts share a coordinate.
    """
    size, cut = [1] * len(joints), list[int]()
    for i in reversed(range(len(joints))):
        hanging = sorted((k for k, joint in enumerate(joints) if joint.parent == i), key=lambda k: size[k])
        size[i] += sum(size[k] for k in hanging)
        while size[i] > LIMB and hanging:
            cut.append(hanging.pop())
            size[i] -= size[cut[-1]]
    cut += [i for i, joint in enumerate(joints) if joint.parent < 0]
    part = list[int]()
    for i, joint in enumerate(joints):
        part.append(i if i in cut else part[joint.parent])
    places = dofs(joints)
    shared = any(len({part[j] for j in places.joint[places.column == k]}) > 1 for k in set(places.column.tolist()))
    return () if len(cut) == 1 or shared or len(joints) <= LIMB else tuple(sorted(cut, reverse=True))


def _handed(model: RobotModel) -> dict[int, list[int]]:
    """Where the six numbers of each limb that hangs on another stand, behind the torques."""
    hanging = [i for i in _limbs(model.joints) if model.joints[i].parent >= 0]
    return {i: list(range(model.nv + 6 * n, model.nv + 6 * n + 6)) for n, i in enumerate(hanging)}


def _limb_torques(model: RobotModel, codes: bytes) -> list[Program]:
    limbs, handed = _limbs(model.joints), _handed(model)

    def of_limb(limb: int) -> Program:
        def inverse_dynamics(load: Load, reads: list[Any], write: Write) -> None:
            q, v, a, back = reads
            torques(
                Robot(model.joints, codes, load),
                *(q, v, a),
                put=lambda row, number: write([((row,), number)]),
                limbs=limbs,
                limb=limb,
                hand=lambda six: write([((k,), number) for k, number in zip(handed[limb], six, strict=True)]),
                taken=lambda child: back([(k,) for k in handed[child]]),
            )

        return inverse_dynamics

    return [of_limb(limb) for limb in limbs]


def _blocks(coordinates: bool, model: RobotModel, codes: bytes) -> list[Program]:
    """Of several kernels each holds the links of a piece of the tree, and goes to them from the world anew."""
    place = {tuple(block): k for k, block in enumerate(_rows(model, coordinates).tolist())}

    def of_links(links: list[int]) -> Program:
        def regressor(load: Load, reads: list[Read], write: Write) -> None:
            def put(row: int, link: int, ten: list[Number]) -> None:
                write([((place[row, link], k), number) for k, number in enumerate(ten)])

            q, v, a = reads[:3]
            regressor_blocks(Robot(model.joints, codes, load), q, v, a, put, links, coordinates)

        return regressor

    return [of_links(links) for links in _pieces(model)]


def _weighted_rows(side: int, model: RobotModel, codes: bytes) -> list[Program]:
    """Of each coordinate all of a normal matrix's columns: those of the links, then `side` given ones; weighed."""
    blocks = _rows(model, True)
    first = {int(row): int(np.flatnonzero(blocks[:, 0] == row)[0]) for row in blocks[:, 0]}
    place = {tuple(block): 10 * (k - first[block[0]]) for k, block in enumerate(blocks.tolist())}
    pieces = _pieces(model)

    def of_links(links: list[int]) -> Program:
        def weighted_rows(load: Load, reads: list[Read], write: Write) -> None:
            q, v, a, root, given = reads[:5]

            def put(row: int, link: int, ten: list[Number]) -> None:
                write([((row, place[row, link] + k), number * root(row)) for k, number in enumerate(ten)])

            if links is pieces[0]:
                for row, (count,) in enumerate(_row_lengths(side, model)):
                    own = range(row * side, (row + 1) * side)
                    write([((row, count - side + n), given(k) * root(row)) for n, k in enumerate(own)])
            regressor_blocks(Robot(model.joints, codes, load), q, v, a, put, links, True)

        return weighted_rows

    return [of_links(links) for links in pieces]


def _row_lengths(side: int, model: RobotModel) -> list[tuple[int]]:
    counts = np.bincount(_rows(model, True)[:, 0], minlength=model.nv)
    return [(10 * int(count) + side,) for count in counts]


def weighted_rows(side: int, plain: Callable[..., list[Array]]) -> Straight:
    """Rows (columns, samples) of each coordinate: of the links that it moves, then its `side` given ones.

    The arrays are q, v, a, the roots of the weights (samples, nv) and the given columns (samples, nv * side).
    """
    form = _Form(f"rows beside {side}", partial(_weighted_rows, side), partial(_row_lengths, side), last=True)

    def read(model: RobotModel) -> list[list[tuple[int, int]]]:
        given = ([(4, row * side + n) for n in range(side)] for row in range(model.nv))
        return [*columns(model), *([(3, row)] for row in range(model.nv)), *(one for one in given if one)]

    return straight(form, plain)._replace(plain=plain, columns=read)


def _pieces(model: RobotModel) -> list[list[int]]:
    """Links by depth first, cut where their blocks would be more than a kernel takes."""
    depth = ancestors(model.joints)[model.dofs.joint].sum(0)
    pieces, held = [[]], 0.0
    for link, blocks in enumerate(depth):
        if held and held + blocks > MOST:
            pieces, held = [*pieces, []], 0.0
        pieces[-1].append(link)
        held += blocks
    return pieces


MOST = 24  # blocks of the regressor, ten numbers each, that one kernel writes: more take long to compile


def _masses(model: RobotModel, codes: bytes) -> list[Program]:
    def mass_matrix(load: Load, reads: list[Read], write: Write) -> None:
        def put(row: int, column: int, number: Number) -> None:
            write([((min(row, column), max(row, column)), number)])

        mass_entries(Robot(model.joints, codes, load), reads[0], put)

    return [mass_matrix]


def _accelerations(model: RobotModel, codes: bytes) -> list[Program]:
    def forward_dynamics(load: Load, reads: list[Read], write: Write) -> None:
        q, v, tau = reads[:3]
        accelerations(Robot(model.joints, codes, load), q, v, tau, lambda row, number: write([((row,), number)]))

    return [forward_dynamics]


def _whole_masses(model: RobotModel, upper: Array) -> Array:
    """From the entries on and above the diagonal that are not zero for every posture."""
    place = np.arange(model.nv)
    upper = jnp.where((place[:, None] <= place)[..., None] & ~_empty(model.joints)[..., None], upper, 0.0)
    return upper + jnp.swapaxes(jnp.where((place[:, None] < place)[..., None], upper, 0.0), 0, 1)


@lru_cache(maxsize=64)
def _empty(joints: tuple[Joint, ...]) -> np.ndarray:
    """Entries of the mass matrix whose coordinates move no link in common: zero for every posture."""
    places = dofs(joints)
    moved = np.zeros((int(places.column.max(initial=-1)) + 1, len(joints)))
    np.add.at(moved, places.column, ancestors(joints)[places.joint])
    return moved @ moved.T == 0


def _rows(model: RobotModel, coordinates: bool) -> np.ndarray:
    """Degree of freedom, or coordinate, and link of the blocks of the regressor that can differ from zero, sorted."""
    return _sorted_rows(model.joints, coordinates)


@lru_cache(maxsize=64)
def _sorted_rows(joints: tuple[Joint, ...], coordinates: bool) -> np.ndarray:
    places = dofs(joints)
    row = places.column if coordinates else np.arange(len(places.column))
    dof, link = np.nonzero(ancestors(joints)[places.joint] > 0)
    return np.unique(np.stack([row[dof], link], 1), axis=0)


def _dense(model: RobotModel, blocks: Array) -> Array:
    rows = _rows(model, True)
    source = np.full((model.nv, len(model.joints)), len(rows))  # zeros, where no block is
    source[tuple(rows.T)] = np.arange(len(rows))
    filled = jnp.concatenate([blocks, jnp.zeros_like(blocks[:1])])
    return filled[source].reshape(model.nv, 10 * len(model.joints), -1)


class _Form(NamedTuple):
    """Of an answer: its programs, the shape of what they write, what is made of it, whether the samples stand last.

    Without `finish` the answer is what they write. `answer` and `places` are its shape and where in it a number goes.
    """

    name: str
    programs: Callable[[RobotModel, bytes], list[Program]]
    shape: Callable[[RobotModel], Any]
    finish: Callable[[RobotModel, Array], Array] | None = None
    last: bool = False
    answer: Callable[[RobotModel], tuple[int, ...]] | None = None
    places: Callable[[RobotModel, tuple[int, ...]], list[int]] | None = None


def _dense_places(model: RobotModel, place: tuple[int, ...]) -> list[int]:
    block, column = place
    row, link = _sorted_rows(model.joints, True)[block]
    return [10 * (row * len(model.joints) + link) + column]


def _column_places(model: RobotModel, place: tuple[int, ...]) -> list[int]:
    block, column = place
    row, link = _sorted_rows(model.joints, True)[block]
    return [int((10 * link + column) * model.nv + row)]


def _mass_places(model: RobotModel, place: tuple[int, ...]) -> list[int]:
    row, column = place
    return sorted({model.nv * row + column, model.nv * column + row})


_ANSWERS = {"rows": lambda model: (len(_rows(model, False)), 10), "blocks": lambda model: (len(_rows(model, True)), 10)}

ACCELERATIONS = _Form("accelerations", _accelerations, lambda model: (model.nv,))
TORQUES = _Form("torques", _torques, lambda model: (model.nv,))
LIMB_TORQUES = _Form(
    "torques of limbs",
    _limb_torques,
    lambda model: (model.nv + 6 * len(_handed(model)),),
    lambda model, whole: whole[: model.nv],
    answer=lambda model: (model.nv,),
)
PACKED = _Form("packed", partial(_blocks, False), _ANSWERS["rows"], last=True)
BLOCKS = _Form("blocks", partial(_blocks, True), _ANSWERS["blocks"], last=True)
DENSE = _Form(
    "dense",
    partial(_blocks, True),
    _ANSWERS["blocks"],
    _dense,
    answer=lambda model: (model.nv, 10 * len(model.joints)),
    places=_dense_places,
)
COLUMNS = _Form(
    "columns",
    partial(_blocks, True),
    _ANSWERS["blocks"],
    last=True,
    answer=lambda model: (10 * len(model.joints), model.nv),
    places=_column_places,
)
MASSES = _Form("masses", _masses, lambda model: (model.nv, model.nv), _whole_masses, places=_mass_places)


def _in_order(shape: Callable[[RobotModel], tuple[int, ...]], model: RobotModel, place: tuple[int, ...]) -> list[int]:
    return [int(np.ravel_multi_index(place, shape(model)))]


def straight(
    form: _Form,
    kernel: Callable[..., Any],
    width: Callable[[RobotModel], int] = lambda model: 1,
    apart: Callable[[RobotModel], Straight | None] = lambda model: None,
) -> Straight:
    """A form beside the plain kernel with the same answers; `width` as `over_samples` takes it, `apart` as Straight."""

    def plain(model: RobotModel, *arrays: Any) -> Any:
        arrays = tuple(jnp.asarray(x) for x in arrays)
        answer = in_one_program(kernel, width(model), model, *arrays).astype(arrays[0].dtype)
        return answer if form.last else jnp.moveaxis(answer, -1, 0)

    read = columns if form is not MASSES else lambda model: [[x for x in g if x[0] == 0] for g in columns(model)]
    return Straight(
        name=form.name,
        structure=lambda model: model.joints,
        plain=plain,
        constants=constants,
        known=known,
        known_lengths=known_lengths,
        nothing_known=lambda model: nothing_known(model.joints),
        programs=form.programs,
        shape=form.shape,
        columns=read,
        last=form.last,
        finish=form.finish,
        answer=form.answer or form.shape,
        places=form.places or partial(_in_order, form.shape),
        apart=apart,
    )


def in_limbs(model: RobotModel) -> bool:
    """Whether the tree is too large for one kernel, and falls into limbs."""
    return bool(_limbs(model.joints))
