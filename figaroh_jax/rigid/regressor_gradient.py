r"""Gradient of any function of the regressor by the motion, written out: what a design of motions is made of.

A function of W has a cotangent C, and what is needed is the gradient of $h = \sum C \cdot W(q, v, a)$. Row j of C is a
set of inertial parameters of all links, so $h = \sum_j \tau_j(q, v, a; C_j)$, and the derivatives of Newton and Euler's
equations in the world frame follow in closed form (twists $S$, spatial velocities $V$ and accelerations $A$, links l
moved by k, p the link that carries k):
$$\delta V_l = S_k, \; \delta A_l = S_k \times (V_l - 2 V_p) \; (\dot q_k); \quad \delta A_l = S_k \; (\ddot q_k)$$
A turn of joint k moves all behind it as one body, which changes no torque there; what is left is that the motion of p
and the twists of the joints before k stand still: the same with $-S_k \times V_p$ and the like. Reverse differentiation
by JAX gives the same numbers; its program takes five times as long to compile.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiled.batching import program
from .kinematics import add_up, ancestors, axis_twists, gather, movers, pose_columns, take
from .model import RobotModel
from .regressor import pairs
from .spatial import cross, matmul, rotate

__all__ = ["pullback_rows", "regressor_pullback"]


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


class _Body(NamedTuple):
    """Mass, first moments and second moments in the world, of one set of parameters for each pair."""

    mass: Float[Array, "n 1 samples"]
    first: Float[Array, "n 3 samples"]
    second: Float[Array, "n 3 3 samples"]

    def momentum(self, x: _Vector) -> _Vector:
        trace = (self.second[:, 0, 0] + self.second[:, 1, 1] + self.second[:, 2, 2])[:, None]
        torque = cross(self.first, x.linear) + trace * x.angular - rotate(self.second, x.angular)
        return _Vector(self.mass * x.linear + cross(x.angular, self.first), torque)


def _body(ten: Float[Array, "n 10 samples"], columns: Float[Array, "n 4 3 samples"]) -> _Body:
    """Ten parameters in a joint frame, whose origin and axes are `columns`, as a body in the world."""
    m, x, y, z, xx, xy, yy, xz, yz, zz = (ten[:, k] for k in range(10))
    half = 0.5 * (xx + yy + zz)
    rows = [[m, x, y, z], [x, half - xx, -xy, -xz], [y, -xy, half - yy, -yz], [z, -xz, -yz, half - zz]]
    pseudo = jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)
    weighted = matmul(pseudo, columns)
    return _Body(m[:, None], weighted[:, 0], matmul(jnp.swapaxes(columns, 1, 2), weighted))


def pullback_rows(
    model: RobotModel,
    q: Float[Array, "nv samples"],
    v: Float[Array, "nv samples"],
    a: Float[Array, "nv samples"],
    cotangent: Float[Array, "nv columns samples"],
) -> Float[Array, "3 nv samples"]:
    """Kernel of `regressor_pullback`: the samples last, to be traced."""
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
    S_j, V_l, A_l, body = S.of(j), V.of(link), A.of(link), _body(ten, columns[link])
    F, momentum = body.momentum(S_j), body.momentum(V_l)
    G = body.momentum(S_j.turn(V_l)).plus(S_j.turn_force(momentum), -1.0).plus(V_l.turn_force(F))
    Z = S_j.turn_force(body.momentum(A_l).plus(V_l.turn_force(momentum)))

    behind = above[joint][:, link]  # (k, pair): k moves the link
    before = above[joint[j]][:, joint].T  # (k, pair): joint j is k or before it
    F, G, Z = F.summed(behind), G.summed(behind), Z.summed(behind * before)
    carried = V_p.turn_force(F)
    by_q = S.turn(V_p).dot(G.plus(carried, -1.0)) + S.turn(A_p).dot(F) + S.dot(Z)
    by_v = S.dot(G.plus(carried, -2.0))
    return jnp.stack([gather(model, x) for x in (-by_q, by_v, S.dot(F))])


_program = program(pullback_rows)


def regressor_pullback(
    model: RobotModel,
    q: Float[np.ndarray, "nv samples"],
    v: Float[np.ndarray, "nv samples"],
    a: Float[np.ndarray, "nv samples"],
    cotangent: Float[np.ndarray, "nv columns samples"],
) -> Float[np.ndarray, "3 nv samples"]:
    """Gradient by q, v and a of the sum over C * W, sample by sample; the samples last, in float64.

    `cotangent` is C, with the columns of `joint_torque_regressor`. For robots of revolute and prismatic joints (mimic
    joints too). Rates per unit of C: N m/rad, N m s/rad, N m s^2/rad and the like.
    """
    with jax.enable_x64(True):
        return np.asarray(_program(model, q, v, a, cotangent))
