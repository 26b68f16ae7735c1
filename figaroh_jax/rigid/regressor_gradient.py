r"""Gradient of any function of the regressor by the motion, written out: what a design of motions is made of.

A function of W has a cotangent C, and what is needed is the gradient of $h = \sum C \cdot W(q, v, a)$. Row j of C is a
set of inertial parameters of all links, so $h = \sum_j \tau_j(q, v, a; C_j)$. With the twist (s, u) of joint j, the
velocity (v, w) and the acceleration (b, e) of link l in the frame of l (b that of a point, less gravity), a link of
mass m, first moments h and inertia J adds
$$s \cdot (m b + e \times h + w \times (w \times h)) + u \cdot (h \times b + J e + w \times J w)$$
The derivatives by the motion of a link are summed over j first. Those by q follow in the world frame (twists $S$,
spatial velocities $V$ and accelerations $A$, links l moved by k, p the link that carries k):
$$\delta V_l = S_k, \; \delta A_l = S_k \times (V_l - 2 V_p) \; (\dot q_k); \quad \delta A_l = S_k \; (\ddot q_k)$$
A turn of joint k moves all behind it as one body, which changes no torque there; what is left is that the motion of p
and the twists of the joints before k stand still: the same with $-S_k \times V_p$ and the like. Reverse differentiation
by JAX gives the same numbers; its program takes five times as long to compile.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .kinematics import add_up, ancestors, axis_twists, gather, movers, pose_columns, take
from .model import RobotModel
from .regressor import pairs
from .spatial import cross, rotate, rotate_back

__all__ = ["pullback_rows"]

_MATRIX = np.array([[4, 5, 7], [5, 6, 8], [7, 8, 9]])  # of xx xy yy xz yz zz behind mass and first moments


class _Vector(NamedTuple):
    """Spatial vectors at the world's origin: of motion (velocity, rate of turn) or of force (force, torque)."""

    linear: Float[Array, "n 3 samples"]
    angular: Float[Array, "n 3 samples"]

    def plus(self, other: _Vector, factor: float = 1.0) -> _Vector:
        return _Vector(self.linear + factor * other.linear, self.angular + factor * other.angular)

    def times(self, x: Float[Array, "n 1 samples"]) -> _Vector:
        return _Vector(self.linear * x, self.angular * x)

    def of(self, index: np.ndarray) -> _Vector:
        return _Vector(take(self.linear, index), take(self.angular, index))

    def summed(self, which: np.ndarray) -> _Vector:
        return _Vector(add_up(which, self.linear), add_up(which, self.angular))

    def dot(self, other: _Vector) -> Float[Array, "n samples"]:
        return jnp.sum(self.linear * other.linear + self.angular * other.angular, axis=1)

    def turn(self, other: _Vector) -> _Vector:
        """Rate of a motion vector that this one carries along."""
        linear = cross(self.angular, other.linear) + cross(self.linear, other.angular)
        return _Vector(linear, cross(self.angular, other.angular))

    def turn_force(self, other: _Vector) -> _Vector:
        """Rate of a force vector that this one carries along."""
        torque = cross(self.angular, other.angular) + cross(self.linear, other.linear)
        return _Vector(cross(self.angular, other.linear), torque)


class _Links(NamedTuple):
    """Placement of links in the world, and their motion in their own frames."""

    origin: Float[Array, "n 3 samples"]
    turn: Float[Array, "n 3 3 samples"]  # rows: axes of the link
    v: Float[Array, "n 3 samples"]
    w: Float[Array, "n 3 samples"]
    b: Float[Array, "n 3 samples"]  # acceleration of a point at the origin, less gravity
    e: Float[Array, "n 3 samples"]

    def of(self, index: np.ndarray) -> _Links:
        return _Links(*(take(x, index) for x in self))

    def own(self, x: _Vector) -> tuple[Array, Array]:
        """A motion in the frame of each link: of its origin, and the turn."""
        return rotate(self.turn, x.linear + cross(x.angular, self.origin)), rotate(self.turn, x.angular)

    def world(self, force: Float[Array, "n 3 samples"], torque: Float[Array, "n 3 samples"]) -> _Vector:
        """A force at the origin of each link, in its frame, as the world has it."""
        force = rotate_back(self.turn, force)
        return _Vector(force, rotate_back(self.turn, torque) + cross(self.origin, force))


def _links(columns: Float[Array, "n 4 3 samples"], V: _Vector, A: _Vector) -> _Links:
    still = _Links(columns[:, 0], columns[:, 1:], *(4 * (columns[:, 0],)))
    (v, w), (b, e) = still.own(V), still.own(A)
    return still._replace(v=v, w=w, b=b + cross(w, v), e=e)


def _dot(x: Float[Array, "n 3 samples"], y: Float[Array, "n 3 samples"]) -> Float[Array, "n 1 samples"]:
    return jnp.sum(x * y, axis=1, keepdims=True)


def _wrenches(
    ten: Float[Array, "pairs 10 samples"], S: _Vector, links: _Links, at: np.ndarray
) -> tuple[_Vector, _Vector, _Vector]:
    """Derivatives by acceleration and velocity of each link, and the force of each pair (S, `at`), in the world."""
    pair = links.of(at)
    s, u = pair.own(S)
    m, h, J = ten[:, :1], ten[:, 1:4], ten[:, _MATRIX]
    Jw = rotate(J, pair.w)
    force = m * pair.b + cross(pair.e, h) + cross(pair.w, cross(pair.w, h))
    torque = cross(h, pair.b) + rotate(J, pair.e) + cross(pair.w, Jw)
    by_w = s * _dot(pair.w, h) + h * _dot(s, pair.w) - 2.0 * pair.w * _dot(s, h)
    by_w = by_w + cross(Jw, u) + rotate(J, cross(u, pair.w))
    which = (at == np.arange(len(links.v))[:, None]).astype(float)
    parts = m * s + cross(u, h), cross(h, s) + rotate(J, u), by_w
    by_b, by_e, by_w = (add_up(which, x) for x in parts)
    by_V = links.world(cross(by_b, links.w), by_w + cross(links.v, by_b))
    return links.world(by_b, by_e), by_V, pair.world(force, torque)


def pullback_rows(
    model: RobotModel,
    q: Float[Array, "nv samples"],
    v: Float[Array, "nv samples"],
    a: Float[Array, "nv samples"],
    cotangent: Float[Array, "nv columns samples"],
) -> Float[Array, "3 nv samples"]:
    """Gradient by q, v and a of the sum over C * W, sample by sample; the samples last, to be traced.

    `cotangent` is C, with the columns of `joint_torque_regressor`. For robots of revolute and prismatic joints (mimic
    joints too). Rates per unit of C: N m/rad, N m s/rad, N m s^2/rad and the like.
    """
    joint, column, above = model.dofs.joint, model.dofs.column, ancestors(model.joints)
    ratio = take(jnp.asarray(model.ratio, q.dtype), joint)[:, None, None]
    columns = pose_columns(model, q)
    S = _Vector(*axis_twists(model, columns))
    rate, push = (ratio * take(x, column)[:, None] for x in (v, a))
    moved = movers(model).T
    V = S.times(rate).summed(moved)
    own = S.times(push).plus(V.of(joint).turn(S.times(rate)))
    A = own.summed(moved)
    A = _Vector(A.linear - jnp.asarray(model.gravity, q.dtype)[:, None], A.angular)
    V_p, A_p = V.of(joint).plus(S.times(rate), -1.0), A.of(joint).plus(own, -1.0)

    j, link = pairs(model).T
    ten = (ratio[..., None] * take(cotangent, column).reshape(len(column), -1, 10, q.shape[-1]))[j, link]
    F, G, Z = _wrenches(ten, S.of(j), _links(columns, V, A), link)
    G, Z = G.plus(V.turn_force(F)), S.of(j).turn_force(Z)  # A of a link follows from its V

    behind = above[joint]  # (k, link): k moves the link
    before = above[joint[j]][:, joint].T  # (k, pair): joint j is k or before it
    F, G, Z = F.summed(behind), G.summed(behind), Z.summed(behind[:, link] * before)
    carried = V_p.turn_force(F)
    by_q = S.turn(V_p).dot(G.plus(carried, -1.0)) + S.turn(A_p).dot(F) + S.dot(Z)
    by_v = S.dot(G.plus(carried, -2.0))
    return jnp.stack([gather(model, x) for x in (-by_q, by_v, S.dot(F))])
