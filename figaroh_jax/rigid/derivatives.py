"""How the torques of the rigid body depend on the state: gravity, Coriolis matrix, derivatives of inverse dynamics.

All of it is `inverse_dynamics` at chosen states or its exact derivative. Derivatives by the configuration are taken
along the steps of `manifold.integrate`, so every matrix has nv rows and columns, quaternions or not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..compiled.batching import sized_program
from ..compiled.precision import in_float64
from .dynamics import inverse_dynamics, mass_matrix
from .kinematics import states
from .manifold import bracket, integrate
from .model import RobotModel

__all__ = ["TorqueDerivatives", "coriolis_from_bias", "coriolis_matrix", "dynamics_derivatives", "gravity_vector"]


class TorqueDerivatives(NamedTuple):
    """Derivatives of the torques of `inverse_dynamics`: row = torque, column = what it is differentiated by."""

    q: Float[ArrayLike, "*batch nv nv"]  # along steps of the configuration
    v: Float[ArrayLike, "*batch nv nv"]
    a: Float[ArrayLike, "*batch nv nv"]  # the mass matrix


@in_float64
def gravity_vector(model: RobotModel, q: Float[ArrayLike, "*batch nq"]) -> Float[Array, "*batch nv"]:
    """Torques (N m, N) that hold the robot still at `q`, in float64."""
    (q,) = states(model, q=q)
    rest = jnp.zeros((*q.shape[:-1], model.nv))
    return inverse_dynamics(model, q, rest, rest)


@in_float64
def coriolis_matrix(
    model: RobotModel, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"]
) -> Float[Array, "*batch nv nv"]:
    r"""Coriolis matrix C with `C @ v` the torques of Coriolis and centrifugal forces, in float64.

    The one whose $\dot M = C + C^T$: with $b(v) = C(v) v$,
    $C = \tfrac12 \partial b / \partial v + \tfrac12 M [v, \cdot]$
    (the connection of the metric M that is free of torsion; Christoffel's symbols where each joint has one degree of
    freedom). The bracket is zero but for joints of several degrees of freedom.
    """
    return _coriolis_matrix(model, *states(model, q=q, v=v))


@sized_program
def _coriolis_matrix(model: RobotModel, q: Array, v: Array) -> Array:
    rest = jnp.zeros_like(v)
    half_slope = 0.5 * _columns(lambda x: inverse_dynamics(model, q, x, rest), v)
    return half_slope + 0.5 * mass_matrix(model, q) @ _brackets(model, v)


@in_float64
def coriolis_from_bias(
    model: RobotModel,
    bias: Callable[[Array], Array | np.ndarray],
    mass: Float[ArrayLike, "*batch nv nv"],
    v: Float[ArrayLike, "*batch nv"],
) -> Float[Array, "*batch nv nv"]:
    r"""Coriolis matrix from a simulator's bias torques and its mass matrix.

    `bias` gives the torques without acceleration, with or without gravity, of `(*batch, nv, nv)` velocities.

    The bias is quadratic in the velocities, so the difference of two of its values,
    $\tfrac14 (b(v + e_j) - b(v - e_j))$, is the j-th column without error of approximation.
    """
    v, mass = jnp.asarray(v, jnp.float64), jnp.asarray(mass, jnp.float64)
    around, steps = v[..., None, :], jnp.eye(model.nv)
    columns = jnp.swapaxes(0.25 * (bias(around + steps) - bias(around - steps)), -1, -2)
    return columns if _abelian(model) else columns + 0.5 * mass @ _brackets(model, v)


@in_float64
def dynamics_derivatives(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nq"],
    v: Float[ArrayLike, "*batch nv"],
    a: Float[ArrayLike, "*batch nv"],
) -> TorqueDerivatives:
    """Derivatives of the torques of `inverse_dynamics` by configuration, velocity and acceleration, in float64."""
    return _dynamics_derivatives(model, *states(model, q=q, v=v, a=a))


@sized_program
def _dynamics_derivatives(model: RobotModel, q: Array, v: Array, a: Array) -> TorqueDerivatives:
    along_q = _columns(lambda step: inverse_dynamics(model, integrate(model, q, step), v, a), jnp.zeros_like(v))
    along_v = _columns(lambda x: inverse_dynamics(model, q, x, a), v)
    return TorqueDerivatives(along_q, along_v, mass_matrix(model, q))


def _columns(function: Callable[[Array], Array], x: Array) -> Array:
    """Jacobian of each sample's answer by its own x: one forward derivative a column, all samples together."""
    steps = jnp.eye(x.shape[-1])
    columns = jax.vmap(lambda step: jax.jvp(function, (x,), (jnp.broadcast_to(step, x.shape),))[1])(steps)
    return jnp.moveaxis(columns, 0, -1)


def _abelian(model: RobotModel) -> bool:
    """Whether no joint has several degrees of freedom: all brackets are zero."""
    return all(joint.kind in ("revolute", "prismatic") for joint in model.joints)


@jax.jit
def _brackets(model: RobotModel, v: Array) -> Array:
    """Matrix of `w -> [v, w]`."""
    if _abelian(model):
        return jnp.zeros((*v.shape, v.shape[-1]))
    steps = jnp.eye(v.shape[-1])
    columns = jax.vmap(lambda step: bracket(model, v, jnp.broadcast_to(step, v.shape)))(steps)
    return jnp.moveaxis(columns, 0, -1)
