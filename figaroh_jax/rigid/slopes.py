"""Torques of a tree of turning and sliding joints with their derivatives by position and rate, in closed form.

Spatial vectors stand in the world's axes at the world's origin, angular part first; samples on the last axis.
S. Singh, R. P. Russell, P. M. Wensing, "Efficient analytical derivatives of rigid-body dynamics using spatial vector
algebra", IEEE RA-L 7 (2022). Only the poses go from link to link: what a link takes from those that carry it, or from
those that it carries, is one sum over a constant matrix.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
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


class _Inertia(NamedTuple):
    """Of every link, or of all that it carries, about the world's origin."""

    mass: Float[Array, "links"]
    first: Float[Array, "links 3 samples"]  # mass times place
    second: Float[Array, "links 3 3 samples"]

    def times(self, motion: Float[Array, "links 6 samples"]) -> Array:
        turn, move = motion[:, :3], motion[:, 3:]
        torque = jnp.sum(self.second * turn[:, None], 2) + cross(self.first, move)
        return jnp.concatenate([torque, self.mass[:, None, None] * move - cross(self.first, turn)], 1)

    def summed(self, which: np.ndarray) -> _Inertia:
        return _Inertia(*(jnp.tensordot(which, x, 1) for x in self))


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
    column = np.array([one.coordinate for one in robot.joints])
    below = _carriers(robot)  # (links, links): whether the second carries the first or is it
    above = below - np.eye(len(below))  # by a joint that is not its own
    turns, places = _poses(robot, q)
    S = _axes(robot, turns, places)
    own = _placed(robot, turns, places)
    pull = -jnp.asarray(robot.gravity)[:, None] * jnp.ones(q.shape[1])
    ground = jnp.concatenate([jnp.zeros_like(pull), pull])
    rates = S * v[column][:, None]
    V, V_up = jnp.tensordot(below, rates, 1), jnp.tensordot(above, rates, 1)
    T = _crossed(V_up, S)
    turning = T * v[column][:, None]
    A, A_up = ground + jnp.tensordot(below, turning, 1), ground + jnp.tensordot(above, turning, 1)
    P = own.times(V)
    carried, force = own.summed(below.T), jnp.tensordot(below.T, own.times(A) + _crossed_force(V, P), 1)
    B, momentum = jnp.tensordot(below.T, _bent(V, P, own), 1), jnp.tensordot(below.T, P[:, 3:], 1)
    U = _crossed(A_up, S) + _crossed(V_up, T)
    z, t = carried.times(S), 2 * cross(momentum, S[:, 3:]) + jnp.sum(B * S[:, :3, None], 1)

    def moved(x: Array) -> Array:
        return jnp.concatenate([jnp.sum(B * x[:, None, :3], 2), -2 * cross(momentum, x[:, :3])], 1)

    def matrix(lower: Array, upper: Array) -> Array:
        found = jnp.asarray(below)[..., None] * lower + jnp.asarray(above.T)[..., None] * upper
        return found[np.argsort(column)][:, np.argsort(column)]

    def rigid(one: Array) -> Array:
        """What accelerations of the joints add to the derivative by q."""
        speeding = S * one[column][:, None]
        F = jnp.tensordot(below.T, own.times(jnp.tensordot(below, speeding, 1)), 1)
        u = _crossed(jnp.tensordot(above, speeding, 1), S)
        return matrix(_dots(z, u), _dots(S, carried.times(u) + _crossed_force(S, F)))

    by_q = matrix(_dots(z, U) + _dots(t, T[:, :3]), _dots(S, carried.times(U) + _crossed_force(S, force) + moved(T)))
    by_v = matrix(2 * _dots(z, T) + _dots(t, S[:, :3]), _dots(S, 2 * carried.times(T) + moved(S)))
    mass = matrix(_dots(z, S), _dots(S, z))
    bias = jnp.sum(S * force, 1)[np.argsort(column)]
    torque = bias + jnp.sum(mass * a[:, None], 2)
    return Slopes(torque, by_q + jax.vmap(rigid)(a), by_v, mass)


def _carriers(robot: RobotModel) -> np.ndarray:
    found = np.eye(len(robot.joints))
    for i, one in enumerate(robot.joints):
        if one.parent >= 0:
            found[i] += found[one.parent]
    return found


def _poses(robot: RobotModel, q: Array) -> tuple[Array, Array]:
    """Rotations (links, 3, 3, samples) and origins (links, 3, samples) of all links."""
    placement, axes = jnp.asarray(robot.placement), jnp.asarray(robot.axis)
    start = jnp.broadcast_to(jnp.eye(3)[..., None], (3, 3, q.shape[1])), jnp.zeros((3, q.shape[1]))
    found: list[tuple[Array, Array]] = []
    for i, joint in enumerate(robot.joints):
        R, p = found[joint.parent] if joint.parent >= 0 else start
        p = p + jnp.sum(R * placement[i, :3, 3][:, None], 1)
        R, axis, x = _product(R, placement[i, :3, :3, None]), axes[i], q[joint.coordinate]
        if joint.kind == "prismatic":
            p = p + jnp.sum(R * axis[:, None], 1) * x
        else:
            skew = jnp.cross(jnp.eye(3), axis)
            R = _product(R, jnp.cos(x) * jnp.eye(3)[..., None] + jnp.sin(x) * skew[..., None]
                         + (1 - jnp.cos(x)) * jnp.outer(axis, axis)[..., None])  # fmt: skip
        found.append((R, p))
    return jnp.stack([R for R, _ in found]), jnp.stack([p for _, p in found])


def _axes(robot: RobotModel, turns: Array, places: Array) -> Array:
    slides = np.array([one.kind == "prismatic" for one in robot.joints])[:, None, None]
    e = jnp.sum(turns * jnp.asarray(robot.axis)[:, None, :, None], 2)
    return jnp.concatenate([jnp.where(slides, 0.0, e), jnp.where(slides, e, cross(places, e))], 1)


def _placed(robot: RobotModel, turns: Array, places: Array) -> _Inertia:
    """From the ten numbers of each link in its own axes at its own origin."""
    ten = jnp.asarray(robot.inertia)
    h = jnp.sum(turns * ten[:, None, 1:4, None], 2)
    own = ten[:, np.array([[4, 5, 7], [5, 6, 8], [7, 8, 9]])][..., None]
    J = _product(_product(turns, own), jnp.swapaxes(turns, 1, 2))
    m, p = ten[:, :1], places
    outer = p[:, :, None] * h[:, None] + h[:, :, None] * p[:, None] + m[..., None, None] * p[:, :, None] * p[:, None]
    size = 2 * jnp.sum(p * h, 1) + m * jnp.sum(p * p, 1)
    return _Inertia(ten[:, 0], h + m[..., None] * p, J - outer + size[:, None, None] * jnp.eye(3)[..., None])


def _bent(V: Array, P: Array, own: _Inertia) -> Array:
    """The upper left part of V x* I - I V x + (I V) x*, (links, 3, 3, samples)."""
    W, v, h = _skew(V[:, :3]), V[:, 3:], own.first
    outer = v[:, None] * h[:, :, None] + h[:, None] * v[:, :, None]
    size = 2 * jnp.sum(v * h, 1)[:, None, None] * jnp.eye(3)[..., None]
    return _product(W, own.second) - _product(own.second, W) - _skew(P[:, :3]) - outer + size


def _skew(x: Array) -> Array:
    """Matrices (links, 3, 3, samples) of x ×."""
    return jnp.swapaxes(cross(x[:, None], jnp.eye(3)[None, :, :, None]), 1, 2)


def _product(one: Array, two: Array) -> Array:
    return jnp.sum(one[..., :, :, None, :] * two[..., None, :, :, :], -3)


def _crossed(V: Array, S: Array) -> Array:
    """Motion x motion, (links, 6, samples)."""
    return jnp.concatenate([cross(V[:, :3], S[:, :3]), cross(V[:, :3], S[:, 3:]) + cross(V[:, 3:], S[:, :3])], 1)


def _crossed_force(V: Array, F: Array) -> Array:
    """Motion x force, (links, 6, samples)."""
    return jnp.concatenate([cross(V[:, :3], F[:, :3]) + cross(V[:, 3:], F[:, 3:]), cross(V[:, :3], F[:, 3:])], 1)


def _dots(one: Array, two: Array) -> Array:
    """(links, links, samples) of (links, k, samples)."""
    return jnp.sum(one[:, None] * two[None], 2)
