"""Torques of a tree of turning and sliding joints with their derivatives by position and rate, in closed form.

Spatial vectors stand in the world's axes at the world's origin, angular part first; samples on the last axis.
S. Singh, R. P. Russell, P. M. Wensing, "Efficient analytical derivatives of rigid-body dynamics using spatial vector
algebra", IEEE RA-L 7 (2022). A pass over the links and a few sums take the place of one derivative for each direction.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .model import RobotModel
from .spatial import cross

__all__ = ["Slopes", "slopes", "within_reach"]


class Slopes(NamedTuple):
    """Torques at each acceleration and their derivatives, row = torque; the mass matrix (no armature in any)."""

    torque: Float[Array, "accelerations nv samples"]
    by_q: Float[Array, "accelerations nv nv samples"]
    by_v: Float[Array, "nv nv samples"]  # at every acceleration the same
    mass: Float[Array, "nv nv samples"]


class _Link(NamedTuple):
    """A link and, once summed up, all that it carries; each (3, samples) or (3, 3, samples), spatial ones (6, ...)."""

    S: Array  # axis
    V: Array
    A: Array  # acceleration without those of the joints
    T: Array  # V of the parent x S
    F: Array
    P: Array  # momentum
    B: Array  # the upper left part of twice the slope of the momentum's torque
    inertia: tuple[Array, Array, Array]  # mass, its first moment, second moments


def within_reach(robot: RobotModel) -> bool:
    """Whether every joint turns about or slides along one axis, each with a coordinate of its own."""
    single = all(one.kind in ("revolute", "prismatic") and not one.follows for one in robot.joints)
    return single and len(robot.joints) == robot.nv == robot.nq


def slopes(
    robot: RobotModel,
    q: Float[Array, "nv samples"],
    v: Float[Array, "nv samples"],
    a: Float[Array, "accelerations nv samples"],
) -> Slopes:
    """Torques (N m, N) at the accelerations `a`, their derivatives by q and v, and the mass matrix."""
    joints, n = robot.joints, robot.nv
    links = _links(robot, q, v)
    carried = list(links)
    for i in reversed(range(n)):
        if (up := joints[i].parent) >= 0:
            one, own = carried[up], carried[i]
            inertia = tuple(x + y for x, y in zip(one.inertia, own.inertia, strict=True))
            carried[up] = one._replace(F=one.F + own.F, P=one.P + own.P, B=one.B + own.B, inertia=inertia)
    ground = _ground(robot, q)
    ups = [carried[j.parent] if j.parent >= 0 else None for j in joints]
    S, T = (jnp.stack([getattr(one, name) for one in carried]) for name in ("S", "T"))
    force, B = jnp.stack([one.F for one in carried]), jnp.stack([one.B for one in carried])
    momentum = jnp.stack([one.P[3:] for one in carried])  # linear
    rest = [ground if one is None else one.A for one in ups]
    before = [jnp.zeros_like(ground) if one is None else one.V for one in ups]
    U = jnp.stack([_crossed(x, one.S) + _crossed(w, one.T) for x, w, one in zip(rest, before, carried, strict=True)])
    z = jnp.stack([_times(one.inertia, one.S) for one in carried])
    turn = lambda x: jnp.sum(B * x[:, None, :3], 2)  # noqa: E731
    lever = lambda x: cross(momentum, x)  # noqa: E731
    bent = jnp.stack([_times(one.inertia, u) for one, u in zip(carried, U, strict=True)]) + _crossed_force(S, force)
    bent = bent + jnp.concatenate([turn(T), -2 * lever(T[:, :3])], 1)
    bent_v = 2 * jnp.stack([_times(one.inertia, one.T) for one in carried])
    bent_v = bent_v + jnp.concatenate([turn(S), -2 * lever(S[:, :3])], 1)
    t = 2 * lever(S[:, 3:]) + jnp.sum(B * S[:, :3, None], 1)
    below, above = _related(robot)
    by_q = _matrix(below, _dots(z, U) + _dots(t, T[:, :3]), above, _dots(S, bent))
    by_v = _matrix(below, 2 * _dots(z, T) + _dots(t, S[:, :3]), above, _dots(S, bent_v))
    moments = _dots(z, S)
    mass = _matrix(below, moments, above, jnp.swapaxes(moments, 0, 1))
    place = np.argsort([one.coordinate for one in joints])
    order = lambda x: x[place][:, place]  # noqa: E731
    by_q, by_v, mass = order(by_q), order(by_v), order(mass)
    bias = jnp.sum(S * force, 1)[place]
    found = [_rigid(robot, one, links, carried, S, z, below, above) for one in a]
    torques = jnp.stack([bias + jnp.sum(mass * one[None], 1) for one in a])
    return Slopes(torques, jnp.stack([by_q + order(x) for x in found]), by_v, mass)


def _rigid(
    robot: RobotModel, a: Array, links: list[_Link], carried: list[_Link], S: Array, z: Array, below: np.ndarray,
    above: np.ndarray,
) -> Array:  # fmt: skip
    """What accelerations of the joints add to the derivative by q, link by link."""
    joints, none = robot.joints, jnp.zeros_like(S[0])
    A: list[Array] = []
    for one, link in zip(joints, links, strict=True):
        A.append((A[one.parent] if one.parent >= 0 else none) + link.S * a[one.coordinate])
    F = [_times(link.inertia, x) for link, x in zip(links, A, strict=True)]
    for i in reversed(range(len(joints))):
        if (up := joints[i].parent) >= 0:
            F[up] = F[up] + F[i]
    U = [_crossed(A[one.parent], s) if one.parent >= 0 else none for one, s in zip(joints, S, strict=True)]
    bent = jnp.stack([_times(one.inertia, u) for one, u in zip(carried, U, strict=True)])
    return _matrix(below, _dots(z, jnp.stack(U)), above, _dots(S, bent + _crossed_force(S, jnp.stack(F))))


def _links(robot: RobotModel, q: Array, v: Array) -> list[_Link]:
    """Every link by itself."""
    found: list[_Link] = []
    poses: list[tuple[Array, Array]] = []
    samples, ground = q.shape[1], _ground(robot, q)
    placement, axis, ten = (jnp.asarray(x) for x in (robot.placement, robot.axis, robot.inertia))
    first = jnp.broadcast_to(jnp.eye(3)[..., None], (3, 3, samples)), jnp.zeros((3, samples))
    for i, joint in enumerate(robot.joints):
        up, c = joint.parent, joint.coordinate
        R0, p = poses[up] if up >= 0 else first
        V0, A0 = (found[up].V, found[up].A) if up >= 0 else (jnp.zeros_like(ground), ground)
        p = p + jnp.sum(R0 * placement[i, :3, 3][None, :, None], 1)
        R = _product(R0, placement[i, :3, :3, None])
        e = jnp.sum(R * axis[i][None, :, None], 1)
        if joint.kind == "prismatic":
            p = p + e * q[c]
            S = jnp.concatenate([jnp.zeros_like(e), e])
        else:
            R = _product(R, _turned(axis[i], q[c]))
            S = jnp.concatenate([e, cross(p, e)])
        poses.append((R, p))
        T = _crossed(V0, S)
        V, A = V0 + S * v[c], A0 + T * v[c]
        inertia = _placed(ten[i], R, p)
        P = _times(inertia, V)
        found.append(_Link(S, V, A, T, _times(inertia, A) + _crossed_force(V, P), P, _slope(V, P, inertia), inertia))
    return found


def _ground(robot: RobotModel, q: Array) -> Array:
    pull = -jnp.asarray(robot.gravity)[:, None] * jnp.ones(q.shape[1])
    return jnp.concatenate([jnp.zeros_like(pull), pull])


def _turned(axis: Array, angle: Array) -> Array:
    """Rotation about an axis, (3, 3, samples)."""
    x, y, z = axis
    skew = jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])[..., None]
    s, c = jnp.sin(angle), jnp.cos(angle)
    return c * jnp.eye(3)[..., None] + s * skew + (1 - c) * jnp.outer(axis, axis)[..., None]


def _placed(ten: Array, R: Array, p: Array) -> tuple[Array, Array, Array]:
    """Ten numbers of a link in its own axes at its own origin -> mass, moment and second moments at the world's."""
    m, h = ten[0], jnp.sum(R * ten[1:4][None, :, None], 1)
    xx, xy, yy, xz, yz, zz = ten[4:]
    J = jnp.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[..., None]
    J = _product(_product(R, J), jnp.swapaxes(R, 0, 1))
    outer = p[:, None] * h[None] + h[:, None] * p[None] + m * p[:, None] * p[None]
    size = 2 * jnp.sum(p * h, 0) + m * jnp.sum(p * p, 0)
    return m * jnp.ones(p.shape[1]), h + m * p, J - outer + size * jnp.eye(3)[..., None]


def _slope(V: Array, P: Array, inertia: tuple[Array, Array, Array]) -> Array:
    """The upper left part of V x* I - I V x + (I V) x*, twice."""
    (_, h, J), W, v = inertia, _skew(V[:3]), V[3:]
    outer = v[None] * h[:, None] + h[None] * v[:, None]
    twist = _product(W, J) - _product(J, W)
    return twist - _skew(P[:3]) - outer + 2 * jnp.sum(v * h, 0) * jnp.eye(3)[..., None]


def _skew(x: Array) -> Array:
    zero = jnp.zeros_like(x[0])
    return jnp.stack([jnp.stack([zero, -x[2], x[1]]), jnp.stack([x[2], zero, -x[0]]), jnp.stack([-x[1], x[0], zero])])


def _product(one: Array, two: Array) -> Array:
    return jnp.sum(one[:, :, None] * two[None], 1)


def _times(inertia: tuple[Array, Array, Array], V: Array) -> Array:
    m, h, J = inertia
    return jnp.concatenate([jnp.sum(J * V[None, :3], 1) + cross(h, V[3:]), m * V[3:] - cross(h, V[:3])])


def _crossed(V: Array, S: Array) -> Array:
    """Motion x motion, (6, samples)."""
    return jnp.concatenate([cross(V[:3], S[:3]), cross(V[:3], S[3:]) + cross(V[3:], S[:3])])


def _crossed_force(V: Array, F: Array) -> Array:
    """Motion x force, (..., 6, samples)."""
    turn, move, torque, force = V[..., :3, :], V[..., 3:, :], F[..., :3, :], F[..., 3:, :]
    return jnp.concatenate([cross(turn, torque) + cross(move, force), cross(turn, force)], -2)


def _dots(one: Array, two: Array) -> Array:
    """(links, links, samples) of (links, k, samples)."""
    return jnp.sum(one[:, None] * two[None], 2)


def _related(robot: RobotModel) -> tuple[np.ndarray, np.ndarray]:
    """(links, links): whether the second carries the first or is it; whether the first carries the second."""
    n = len(robot.joints)
    below = np.zeros((n, n), bool)
    for i in range(n):
        j = i
        while j >= 0:
            below[i, j] = True
            j = robot.joints[j].parent
    return below, below.T & ~np.eye(n, dtype=bool)


def _matrix(below: np.ndarray, lower: Array, above: np.ndarray, upper: Array) -> Array:
    return jnp.where(below[..., None], lower, jnp.where(above[..., None], upper, 0.0))
