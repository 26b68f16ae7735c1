"""Torques of the rigid body: inverse and forward dynamics and the mass matrix.

Every link's wrench is taken about the origin of the *world*, so that what a joint carries is the plain sum over the
links that it moves: one product with the tree's matrix of 0 and 1, without a second pass along the tree. Inside the
kernels the sample is the last axis; the public functions take any leading batch axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import prod

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..compiled.batching import on_host, over_samples, to_device, two_axes
from ..compiled.machine_code import machine_code, own_room
from ..compiled.precision import in_float64
from ..errors import InputError
from .inertia import pseudo_inertia
from .kinematics import Motion, add_up, ancestors, axis_twists, check_shapes, gather, motion, movers, pose_columns, take
from .model import RobotModel
from .scalar_forms import ACCELERATIONS, LIMB_TORQUES, MASSES, TORQUES, in_limbs, straight
from .scalar_programs import written, written_torques
from .spatial import cross, matmul, rotate

__all__ = [
    "forward_dynamics",
    "inverse_dynamics",
    "joint_accelerations",
    "joint_masses",
    "joint_torques",
    "mass_matrix",
    "refuse_singular",
    "torques_on_host",
]

MOST_JOINTS = 12  # of a robot whose mass matrix is factorised in registers
_HUGE = 1e12  # rad/s^2, m/s^2 and other numbers: beyond it a mass matrix is looked at
_NO_MASS = 1e-13  # of the largest number of a mass matrix
MANY = 512  # samples from which a program is worth its compilation that is written out for the robot at hand


@in_float64
def inverse_dynamics(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nq"],
    v: Float[ArrayLike, "*batch nv"],
    a: Float[ArrayLike, "*batch nv"],
) -> Float[Array, "*batch nv"]:
    r"""Torques (N m; N for a prismatic joint) that give the rigid body the accelerations `a`.

    Newton-Euler in the world frame: $\tau_k = l_k \cdot f + u_k \cdot n$ with $l_k$ and $u_k$ the twist of the degree
    of freedom, f and n the force and the torque about the world's origin of all links that it moves. q, v, a in rad,
    rad/s, rad/s^2 (m for sliding); computed in float64. Torques of joints that share a coordinate add up, each times
    its ratio. A free joint's six are the force and the torque about its origin, in its own axes. Raises `InputError`
    where the arrays do not fit the model.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a = np.zeros((3, 5, robot.nv))
    >>> fj.inverse_dynamics(robot, q, v, a).shape
    (5, 4)
    """
    check_shapes(model, q=q, v=v, a=a)
    if on_host(model, q, v, a) and prod(np.shape(q)[:-1]) >= MANY:
        rows = two_axes(q, v, a, host=True)
        if (code := machine_code(_TORQUES, model, *rows)) is not None:
            return to_device(code(own_room, *rows).reshape(*np.shape(q)[:-1], model.nv))
        if (robot := written(model)) is not None:
            return over_samples(written_torques, robot, q, v, a)
    return over_samples(joint_torques, model, q, v, a, straight=_TORQUES)


def torques_on_host(
    model: RobotModel,
    q: Float[np.ndarray, "*batch nq"],
    v: Float[np.ndarray, "*batch nv"],
    a: Float[np.ndarray, "*batch nv"],
) -> Float[np.ndarray, "*batch nv"]:
    """`inverse_dynamics` of arrays of the host, without the way through JAX where it can be."""
    if on_host(model) and prod(q.shape[:-1]) >= MANY:
        check_shapes(model, q=q, v=v, a=a)
        rows = two_axes(q, v, a, host=True)
        if (code := machine_code(_TORQUES, model, *rows)) is not None:
            return code(_heap_room, *rows).reshape(*q.shape[:-1], model.nv)
    return np.asarray(inverse_dynamics(model, q, v, a))


def _heap_room(shape: tuple[int, ...], fill: float | None) -> np.ndarray:
    """Memory that the process has already: answers of many sizes follow one another, and new pages cost as much."""
    return np.empty(shape) if fill is None else np.zeros(shape)


def joint_torques(
    model: RobotModel, q: Float[Array, "nq samples"], v: Float[Array, "nv samples"], a: Float[Array, "nv samples"]
) -> Float[Array, "nv samples"]:
    """Kernel of `inverse_dynamics`: the samples on the last axis, the dtype that of `q`."""
    state = motion(model, q, v, a)
    force, torque = (add_up(movers(model), x) for x in link_wrenches(model, state))
    return gather(model, jnp.sum(state.linear * force + state.angular * torque, axis=1))


def link_wrenches(model: RobotModel, state: Motion) -> tuple[Float[Array, "nj 3 n"], Float[Array, "nj 3 n"]]:
    r"""Force (N) and torque about the world's origin (N m) that move each link, in the world.

    With $t_a$ the columns of the link's pose, $g_a$ their accelerations and P the pseudo-inertia, in the same order:
    $f = y_p, \; n = \sum_a t_a \times y_a, \; y_a = \sum_b P_{ab} g_b$.
    """
    pushed = matmul(_pseudo_inertias(model, state.w.dtype), state.acceleration)
    return pushed[:, 0], jnp.sum(cross(state.columns, pushed), axis=1)


def _pseudo_inertias(model: RobotModel, dtype: jnp.dtype) -> Float[Array, "nj 4 4 1"]:
    return jnp.roll(pseudo_inertia(jnp.asarray(model.inertia, dtype)), 1, axis=(1, 2))[..., None]  # origin first


@in_float64
def mass_matrix(model: RobotModel, q: Float[ArrayLike, "*batch nq"]) -> Float[Array, "*batch nv nv"]:
    r"""Mass matrix of the rigid body (kg m^2; kg m, kg for prismatic joints), symmetric, in float64.

    Composite bodies (Featherstone 2008, section 6.2): entry (j, k), j above k or k itself, is the rate of joint j in
    the momentum of all that joint k carries, for a unit rate of joint k. Raises `InputError` where the shape of `q`
    does not fit the model.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> fj.mass_matrix(robot, np.zeros((5, robot.nv))).shape
    (5, 4, 4)
    """
    check_shapes(model, q=q)
    return over_samples(joint_masses, model, q, width=model.nv**2, straight=_MASSES)


def joint_masses(model: RobotModel, q: Float[Array, "nq samples"]) -> Float[Array, "nv nv samples"]:
    """Kernel of `mass_matrix`: the samples on the last axis, the dtype that of `q`."""
    columns, above = pose_columns(model, q), ancestors(model.joints)
    linear, angular = axis_twists(model, columns)
    pseudo, joint = _pseudo_inertias(model, q.dtype), model.dofs.joint
    weighted = matmul(pseudo, columns)
    second = add_up(above, matmul(jnp.swapaxes(columns, 1, 2), weighted))
    h, m = add_up(above, weighted[:, 0]), add_up(above, pseudo[:, 0, :1])
    second, h, m = (take(x, joint) for x in (second, h, m))
    trace = second[:, 0, 0] + second[:, 1, 1] + second[:, 2, 2]
    force = m * linear + cross(angular, h)
    torque = cross(h, linear) + trace[:, None] * angular - rotate(second, angular)
    rows, columns = jnp.concatenate([linear, angular], 1), jnp.concatenate([force, torque], 1)
    both = np.triu(above[np.ix_(joint, joint)])  # row above the column, or earlier in the same joint
    upper = jnp.sum(rows[:, None] * columns[None], axis=2) * jnp.asarray(both, q.dtype)[..., None]
    full = upper + jnp.swapaxes(upper * jnp.asarray(1.0 - np.eye(len(both)), q.dtype)[..., None], 0, 1)
    return gather(model, jnp.swapaxes(gather(model, full), 0, 1))


_LIMBS = straight(LIMB_TORQUES, joint_torques)
_TORQUES = straight(TORQUES, joint_torques, apart=lambda model: _LIMBS if in_limbs(model) else None)
_MASSES = straight(MASSES, joint_masses, lambda model: model.nv**2)


@in_float64
def forward_dynamics(
    model: RobotModel,
    q: Float[ArrayLike, "*batch nq"],
    v: Float[ArrayLike, "*batch nv"],
    tau: Float[ArrayLike, "*batch nv"],
) -> Float[Array, "*batch nv"]:
    """Accelerations (rad/s^2, m/s^2) that the torques `tau` (N m, N) give the rigid body; inverse of inverse_dynamics.

    Cholesky solve with the mass matrix, in float64. Where a joint moves no mass that matrix is singular: give the link
    an inertia (or the joint a rotor). Raises `InputError` there and where the shapes do not fit; under jit, grad and
    vmap, and on a GPU, nothing looks at the numbers, and the answer is NaN or huge.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a = 0.3 * np.ones((3, robot.nv))
    >>> tau = fj.inverse_dynamics(robot, q, v, a)
    >>> bool(np.allclose(fj.forward_dynamics(robot, q, v, tau), a))
    True
    """
    check_shapes(model, q=q, v=v, tau=tau)
    form = _ACCELERATIONS if len(model.joints) <= MOST_JOINTS else None
    answer = over_samples(joint_accelerations, model, q, v, tau, width=model.nv**2, straight=form)
    if on_host(model, q, v, tau):
        rows = np.reshape(q, (-1, model.nq))
        refuse_singular(answer, (q, v, tau), model.dof_names, lambda row: mass_matrix(model, rows[row]))
    return answer


def refuse_singular(
    answer: Float[ArrayLike, "*batch nv"],
    states: Sequence[Float[ArrayLike, "*batch _"]],
    names: Sequence[str],
    masses_at: Callable[[int], Float[ArrayLike, "nv nv"]],
) -> None:
    """Raise `InputError` where a mass matrix has given no accelerations; NaN or huge for NaN or huge numbers may pass.

    `states` are what the accelerations `answer` were asked of, `names` those of their columns, `masses_at` the matrix
    of a row.
    """
    if (np.abs(np.asarray(answer)) < _HUGE).all():
        return
    rows = (np.reshape(np.asarray(x), (-1, np.shape(x)[-1])) for x in (*states, answer))
    sane = [np.asarray((np.abs(x) < _HUGE).all(axis=1)) for x in rows]
    wrong = np.flatnonzero(np.all(sane[:-1], axis=0) & ~sane[-1])
    if not len(wrong) or not np.isfinite(masses := np.asarray(masses_at(int(wrong[0])))).all():
        return
    moved = np.diagonal(masses)
    still = [name for name, x in zip(names, moved, strict=True) if not x > _NO_MASS * moved.max()]
    if still or not np.linalg.cond(masses) < 1 / _NO_MASS:
        which = "some joints move one body alike"
        if still:
            which = f"joint{'s' * (len(still) > 1)} {', '.join(still)} move{'s' * (len(still) == 1)} no mass"
        row = f" in row {wrong[0]}" if len(sane[-1]) > 1 else ""
        raise InputError(
            f"the mass matrix is singular{row}: {which}; give the link an inertia (or the joint a rotor), or lock it"
        )


def joint_accelerations(
    model: RobotModel, q: Float[Array, "nq samples"], v: Float[Array, "nv samples"], tau: Float[Array, "nv samples"]
) -> Float[Array, "nv samples"]:
    """Kernel of `forward_dynamics`: the samples on the last axis, the dtype that of `q`."""
    bias = joint_torques(model, q, v, jnp.zeros_like(v))
    factor = jnp.linalg.cholesky(jnp.moveaxis(joint_masses(model, q), -1, 0))
    return jax.scipy.linalg.cho_solve((factor, True), (tau - bias).T[..., None])[..., 0].T


_ACCELERATIONS = straight(ACCELERATIONS, joint_accelerations, lambda model: model.nv**2)
