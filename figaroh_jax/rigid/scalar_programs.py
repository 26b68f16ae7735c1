"""The rigid body written out in scalars: torques, blocks of the regressor, mass matrix and accelerations of one sample.

Each function runs once, while a kernel is traced: it walks the tree in Python and leaves one multiplication or
addition behind for every product and sum that the robot's structure calls for. The tree is walked depth first and a
limb is finished before the next begins, so that few numbers are alive at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..compiled.batching import CPU_OPTIONS
from ..compiled.kernels import Number, Read
from .model import Joint, Leaf, RobotModel
from .scalars import (
    LOADED,
    NONE,
    PER_JOINT,
    PLACES,
    ZERO,
    Matrix,
    Motion,
    Pose,
    Robot,
    Vector,
    add,
    at_rest,
    constants,
    cross,
    dot,
    moved_by,
    pose_of,
    product,
    scaled,
    second_moments,
    spin_of,
    turned,
)

__all__ = [
    "Twist",
    "Written",
    "accelerations",
    "mass_entries",
    "regressor_blocks",
    "ten_columns",
    "torques",
    "written",
    "written_torques",
]

MOST_WRITTEN, _TURNED = 10, 3  # joints; numbers of a joint's rotation, on average, that may be other than 0, 1, -1


def _carried(robot: Robot, i: int, motion: Motion, spin: Matrix) -> tuple[Vector, Vector]:
    """Force on link i and torque about its origin."""
    m, h = robot.of_joint(i, "inertia")[0], tuple(robot.of_joint(i, "inertia")[1:4])
    xx, xy, yy, xz, yz, zz = robot.of_joint(i, "second")
    S = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    force = add(scaled(motion.ac, m), turned(spin, h))
    about = tuple(dot(spin[(k + 2) % 3], S[(k + 1) % 3]) - dot(spin[(k + 1) % 3], S[(k + 2) % 3]) for k in range(3))
    return force, add(cross(h, motion.ac), about)


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
        pose = pose_of(robot, i, q)
        motion = moved_by(robot, i, pose, above, spin, v, a)
        own = spin_of(motion)
        force, torque = _carried(robot, i, motion, own)
        for child in robot.children(i):
            if child in limbs:
                six = taken(child)
                there, about = tuple(six[:3]), tuple(six[3:])
            else:
                there, about = visit(child, motion, own)
            force, torque = add(force, there), add(torque, about)
        ratio = robot.of_joint(i, "ratio")[0]
        for k in robot.own(i):
            column = int(robot.dofs.column[k])
            along = dot(robot.of_dof(k, "axis"), torque if robot.dofs.turns[k] else force) * ratio
            total[column] = total[column] + along if column in total else along
            left[column] -= 1
            if not left[column]:
                put(column, total.pop(column))
        if robot.joints[i].parent < 0:
            return NONE, NONE
        up = pose.turn(force)
        return up, add(pose.turn(torque), cross(pose.origin, up))

    motion = at_rest(robot)
    spin = spin_of(motion)
    for i in robot.above(limb):
        motion = moved_by(robot, i, pose_of(robot, i, q), motion, spin, v, a)
        spin = spin_of(motion)
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
    of_joint = table[: len(model.joints) * PER_JOINT].reshape(-1, PER_JOINT)
    of_joint[:, PLACES["inertia"] : PLACES["ratio"]] = np.concatenate([inertia, second_moments(inertia)], 1)
    return Written(table, model.joints, codes)


_LAST: dict[tuple[Joint, ...], tuple[tuple[np.ndarray, ...], np.ndarray, bytes | None]] = {}  # of each structure


def _structure(model: RobotModel) -> tuple[Float[np.ndarray, " constants"], bytes | None]:
    """All numbers of a robot, and the codes of its program where it is to be written out."""
    table = constants(model, float, np)
    codes = np.where(np.isin(table, (-1.0, 0.0, 1.0)), table, LOADED).astype(np.int8)
    by_joint = codes[: len(model.joints) * PER_JOINT].reshape(-1, PER_JOINT)
    by_joint[:, PLACES["inertia"] : PLACES["ratio"]] = LOADED
    codes[-3:] = LOADED
    unlike = by_joint[:, : PLACES["origin"]] == LOADED
    return table, None if unlike.sum() > _TURNED * len(model.joints) else codes.tobytes()


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
    wanted: Sequence[Sequence[int]] | None = None,
) -> None:
    """`put(row, link, ten)` for every link (of `links`) and every degree of freedom, or coordinate, that moves it.

    Of each link's ten columns those that are `wanted`, where this is told. They are lin . F + ang . T
    with the force and the torque of a unit of each parameter: F = [ac, D, 0], T = [0, -[ac], L(al) + [w] L(w)].
    """
    own = set(range(len(robot.joints)) if links is None else links)
    needed = set(own)
    for i in sorted(own, reverse=True):
        while robot.joints[i].parent >= 0:
            i = robot.joints[i].parent
            needed.add(i)

    def visit(i: int, above: Motion, spin: Matrix, twists: list[Twist]) -> None:
        pose = pose_of(robot, i, q)
        motion = moved_by(robot, i, pose, above, spin, v, a)
        own_spin = spin_of(motion)
        here = _merged(robot, i, [_seen(pose, t) for t in twists], coordinates)
        if i in own:
            for twist in here:
                put(twist.row, i, ten_columns(twist, motion, own_spin, range(10) if wanted is None else wanted[i]))
        for child in robot.children(i):
            if child in needed:
                visit(child, motion, own_spin, here)

    still = at_rest(robot)
    for i in robot.children(-1):
        if i in needed:
            visit(i, still, spin_of(still), [])


def _seen(pose: Pose, twist: Twist) -> Twist:
    at = add(twist.linear, cross(twist.angular, pose.origin))
    return Twist(twist.row, pose.turn_back(at), pose.turn_back(twist.angular))


def _merged(robot: Robot, i: int, twists: list[Twist], coordinates: bool) -> list[Twist]:
    """Those of the links above and of joint i; of one coordinate they add up, each times its ratio."""
    ratio, here = robot.of_joint(i, "ratio")[0], list(twists)
    for k in robot.own(i):
        axis = robot.of_dof(k, "axis")
        if not coordinates:
            here.append(Twist(k, *((NONE, axis) if robot.dofs.turns[k] else (axis, NONE))))
            continue
        axis, row = scaled(axis, ratio), int(robot.dofs.column[k])
        new = Twist(row, *((NONE, axis) if robot.dofs.turns[k] else (axis, NONE)))
        same = [n for n, t in enumerate(here) if t.row == row]
        if same:
            old = here[same[0]]
            here[same[0]] = Twist(row, add(old.linear, new.linear), add(old.angular, new.angular))
        else:
            here.append(new)
    return here


def ten_columns(twist: Twist, motion: Motion, spin: Matrix, wanted: Sequence[int] = range(10)) -> list[Number]:
    """Those that are wanted of a link's ten columns in the row of a twist."""
    lin, ang, (w, al, ac) = twist.linear, twist.angular, motion
    g = cross(ang, w)

    def first(k: int) -> Number:
        return dot(tuple(row[k] for row in spin), lin) + cross(ac, ang)[k]

    def one(i: int, j: int) -> Number:
        straight = ang[i] * al[j] + g[i] * w[j]
        return straight if i == j else straight + ang[j] * al[i] + g[j] * w[i]

    columns = [lambda: dot(lin, ac), *(partial(first, k) for k in range(3)), *(partial(one, *ij) for ij in _ENTRIES)]
    return [columns[k]() for k in wanted]


_ENTRIES = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))  # of the inertia, in Pinocchio's order


Entries = dict[tuple[int, int], Number]  # of the mass matrix, by row and column


class Body(NamedTuple):
    """Of all that a joint carries, about its origin, in its axes: mass, first moments and moments of inertia."""

    m: Number
    h: Vector
    inertia: Matrix


def mass_entries(robot: Robot, q: Read, put: Callable[[Entries], None]) -> None:
    """Composite bodies (Featherstone 2008, section 6.2): `put` entries whose row is not above the column.

    Each degree of freedom's are put as soon as they are there, so that few are held at a time; those of joints that
    share a coordinate add up and are put last. Entries that are zero by structure are not put.
    """
    poses: dict[int, Pose] = {}
    total: dict[tuple[int, int], Number] = {}
    column, carried_by = robot.dofs.column, robot.joints
    alone = np.bincount(column)[column] == 1

    def enter(k: int, above: int, value: Number, ratio: Number, ready: Entries) -> None:
        place = (max(int(column[k]), int(column[above])), min(int(column[k]), int(column[above])))
        value = value * ratio
        if alone[k] and alone[above]:
            ready[place] = value
            return
        if column[k] == column[above] and k != above:
            value = value + value
        total[place] = total[place] + value if place in total else value

    def visit(i: int) -> Body:
        poses[i] = pose_of(robot, i, q)
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
            ready: Entries = {}
            axis = robot.of_dof(k, "axis")
            if robot.dofs.turns[k]:
                force, torque = cross(axis, body.h), turned(body.inertia, axis)
            else:
                force, torque = scaled(axis, body.m), cross(body.h, axis)
            for n in range(robot.own(i)[0], k + 1):
                moment = torque if robot.dofs.turns[n] else force
                enter(k, n, dot(robot.of_dof(n, "axis"), moment), ratio * ratio, ready)
            j = i
            while carried_by[j].parent >= 0:
                pose, j = poses[j], carried_by[j].parent
                force = pose.turn(force)
                torque = add(pose.turn(torque), cross(pose.origin, force))
                both = ratio * robot.of_joint(j, "ratio")[0]
                for n in robot.own(j):
                    moment = torque if robot.dofs.turns[n] else force
                    enter(k, n, dot(robot.of_dof(n, "axis"), moment), both, ready)
            if ready:
                put(ready)

    for i in robot.children(-1):
        visit(i)
    if total:
        put(total)


def accelerations(robot: Robot, q: Read, v: Read, tau: Read, put: Callable[[int, Number], None]) -> None:
    """`put` receives the acceleration of every coordinate: a = M^-1 (tau - bias), M = L'DL (Featherstone 2008, 8.5).

    From the last coordinate to the first that leaves the zeros of a tree where they are.
    """
    rest: dict[int, Number] = {}
    M: dict[tuple[int, int], Number] = {}
    torques(robot, q, v, lambda k: ZERO, lambda row, bias: rest.update({row: bias}))
    rest = {row: tau(row) - bias for row, bias in rest.items()}
    mass_entries(robot, q, M.update)
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
    rows = tuple(add(x, y) for x, y in zip(one.inertia, two.inertia, strict=True))
    return Body(one.m + two.m, add(one.h, two.h), rows)


def _shifted(body: Body, pose: Pose) -> Body:
    """Of the parent's origin and axes: R I R' + (2 h.p + m p.p) 1 - (h p' + p h') - m p p', h turned before."""
    R, p, m = pose.matrix(), pose.origin, body.m
    h, inertia = pose.turn(body.h), product(R, body.inertia)
    whole = add(scaled(p, m), h)
    away = dot(h, p) + dot(whole, p)

    def entry(i: int, j: int) -> Number:
        value = dot(inertia[i], R[j]) - (h[i] * p[j] + p[i] * whole[j])
        return value + away if i == j else value

    xx, xy, yy, xz, yz, zz = (entry(*ij) for ij in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)))
    return Body(m, whole, ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
