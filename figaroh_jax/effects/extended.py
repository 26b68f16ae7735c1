"""The extended model: a robot with effects in it, and the torques and motions that it gives.

Effects act in the order of the tuple. First every `change` makes the robot what it really is; its rigid body torque is
the load. Then each torque form adds to the total that stands before it (so a `torque_gain` scales what was added
before). Position sensors read more than the truth by the sum of the `position_error` forms; torque sensors add the
`torque_error` forms and filter the total by the `torque_response` forms, in the order of the tuple. Sensors matter to
`predict` and to simulated readings alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..compiled.batching import on_host
from ..compiled.precision import in_float64
from ..errors import InputError, check_finite, check_real
from ..rigid.dynamics import inverse_dynamics, refuse_singular
from ..rigid.kinematics import states
from ..rigid.model import RobotModel
from .base import Effect, Motion, changed, exact, fixed, movable

__all__ = [
    "ExtendedModel",
    "changed_robot",
    "check_period",
    "extend",
    "opened",
    "predict",
    "read_position",
    "read_sensors",
    "read_torque",
    "require_single_axes",
    "with_torque",
]

_SHOWN = 12  # effects that a model's text lists
_NEWTON_STEPS = 12  # a load-dependent friction makes the torque piecewise affine in the acceleration: 2 or 3 are used


class ExtendedModel(eqx.Module):
    """A robot and the effects that act in it (`extend`); immutable, every array a differentiable leaf.

    `robot` is the rigid body, `effects` the tuple of effects at their places, `width` (nv,) the half width of a
    reversal within which dry friction is smooth, rad/s or m/s. `inverse_dynamics` and `forward_dynamics` have them all.
    """

    robot: RobotModel
    effects: tuple[Effect, ...]
    width: Float[Array | np.ndarray, " nv"]  # half width of a reversal of the joints' dry friction, rad/s or m/s

    def __repr__(self) -> str:
        shown = [f"  {one.name} {' '.join(_where(self.robot, one))}: {one}" for one in self.effects[:_SHOWN]]
        more = [f"  ... and {len(self.effects) - _SHOWN} more"] if len(self.effects) > _SHOWN else []
        return "\n".join([f"ExtendedModel of {self.robot}; {len(self.effects)} effects", *shown, *more])

    @in_float64
    def inverse_dynamics(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[Array, "*batch nv"]:
        """Torques of the drives (N m or N) that give the true motion q, v, a (rad or m, and their rates)."""
        return _inverse_dynamics(opened(self), *states(self.robot, q=q, v=v, a=a))

    @in_float64
    def forward_dynamics(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], tau: Float[ArrayLike, "*batch nv"]
    ) -> Float[Array, "*batch nv"]:
        """Accelerations (rad/s^2 or m/s^2) under the drives' torques `tau`: `inverse_dynamics` solved for `a`.

        Newton's method with the exact Jacobian; the derivatives are those of the solution (implicit function theorem).
        At v = 0 dry friction is taken as zero: a joint that sticks is the business of `simulate`. Raises `InputError`
        where neither link nor rotor gives a joint mass, but under jit, grad and vmap, where the answer is NaN or huge.
        """
        model, given = opened(self), states(self.robot, q=q, v=v, tau=tau)
        answer = _forward_dynamics(model, *given)
        if on_host(self, given):
            refuse_singular(answer, given, self.robot.dof_names, lambda row: _masses(model, given, row))
        return answer


def _masses(model: Any, given: Sequence[Any], row: int) -> Float[np.ndarray, "nv nv"]:
    """Mass matrix of robot and effects in one of the states (q, v, tau)."""
    q, v = (np.reshape(x, (-1, np.shape(x)[-1]))[row] for x in given[:2])
    ways: Any = np.concatenate([np.zeros((1, len(v))), np.eye(len(v))])
    still: Any = [np.tile(x, (len(ways), 1)) for x in (q, v)]
    torque = np.asarray(_inverse_dynamics(model, still[0], still[1], ways))
    return (torque[1:] - torque[0]).T


def _where(robot: RobotModel, effect: Effect) -> list[str]:
    """Names of the place, where it is one that is known."""
    names = robot.link_names if effect.acts_on == "link" else robot.dof_names
    return [] if isinstance(effect.at, Tracer) or np.ndim(effect.at) != 1 else [names[k] for k in np.asarray(effect.at)]


def extend(
    model: RobotModel | ExtendedModel, *effects: Effect, width: Float[Array | np.ndarray, " nv"] | float | None = None
) -> ExtendedModel:
    """The model with `effects` added behind those it has.

    `width` (rad/s or m/s, one for all joints or one each) is the half width of a reversal within which the joints' dry
    friction is smooth; None keeps the model's, 0 for a plain robot.

    >>> import figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> model = fj.extend(robot, fj.place(fj.CATALOGUE["viscous_friction"], robot, ["elbow"], damping=1.5))
    >>> model.effects[0].name
    'viscous_friction'
    """
    if not isinstance(model, (RobotModel, ExtendedModel)):
        raise InputError(
            f"model is of type {type(model).__name__}; a RobotModel or an ExtendedModel is expected, first"
        )
    for one in effects:
        if not isinstance(one, Effect):
            told = one.__name__ if isinstance(one, type) else type(one).__name__
            raise InputError(
                f"effects are those that `place` makes, one after the other: extend(model, *list); got {told}"
            )
    robot, present = (model.robot, model.effects) if isinstance(model, ExtendedModel) else (model, ())
    if width is None:
        width = model.width if isinstance(model, ExtendedModel) else 0.0
    check_finite("width", width, 0.0)
    if np.shape(width) not in ((), (robot.nv,)):
        raise InputError(f"width has shape {np.shape(width)}; robot '{robot.name}' needs one number or {robot.nv}")
    space: Any = jnp if isinstance(width, jax.Array) else np
    # a Python number would be a constant of the compiled programs, and each new value a new compilation
    effects = jax.tree.map(lambda x: np.float64(x) if isinstance(x, (int, float)) else x, effects)
    effects = tuple(fixed(effect) for effect in effects)
    return ExtendedModel(robot, (*present, *effects), space.broadcast_to(space.asarray(width), (robot.nv,)))


@in_float64
def predict(
    extended: ExtendedModel | RobotModel,
    time: Float[ArrayLike, " samples"],
    position: Float[ArrayLike, "samples nv"],
    velocity: Float[ArrayLike, "samples nv"],
    acceleration: Float[ArrayLike, "samples nv"],
    dt: float,
) -> Float[Array, "samples nv"]:
    """What the torque sensors would read (N m or N) while the position sensors read this motion.

    A uniform record of at least five samples, `dt` seconds apart. The rigid body moves as the links do, that is, as
    read less the sensors' errors (differentiated by five-point central differences; their load is that of the motion
    as read). Friction sits at the motor and follows the motion as read. Raises `InputError` for a robot with joints
    of several degrees of freedom: no one sensor reads their position.

    >>> import numpy as np, figaroh_jax as fj
    >>> model = fj.extend(fj.load_urdf(fj.DEMO))
    >>> t, still = np.arange(50) / 100.0, np.zeros((50, 4))
    >>> fj.predict(model, t, still, still, still, 0.01).shape
    (50, 4)
    """
    extended = extended if isinstance(extended, ExtendedModel) else extend(extended)
    require_single_axes(extended.robot, "a record of sensors")
    check_period(dt)
    check_real("time", time)
    motion = states(extended.robot, position=position, velocity=velocity, acceleration=acceleration)
    if motion[0].ndim != 2 or motion[0].shape[0] < 5:
        raise InputError(f"a record of 5 samples or more is needed, got the shape {motion[0].shape}")
    q, v, a = motion
    return read_sensors(extended, jnp.asarray(time, jnp.float64), q, v, a, jnp.float64(dt))


def check_period(dt: Any) -> None:
    """Raise `InputError` where a step or a period (s) is known and not above zero."""
    if isinstance(dt, str) or (not isinstance(dt, Tracer) and not float(dt) > 0):
        raise InputError(f"dt is {dt}; the time from one sample to the next is expected, above zero, in s")


def require_single_axes(robot: RobotModel, what: str) -> None:
    """Raise `InputError` where a joint has several degrees of freedom, which `what` does not take."""
    for joint in robot.joints:
        if joint.kind not in ("revolute", "prismatic"):
            given = f"joint '{joint.name}' of robot '{robot.name}' is {joint.kind}"
            raise InputError(f"{what} takes revolute and prismatic joints; {given}: lock it, or fix the root")


def read_sensors(extended: ExtendedModel, time: Array, q: Array, v: Array, a: Array, dt: Array) -> Array:
    """`predict` of float64 arrays, to be traced."""
    robot = changed_robot(extended)
    load = inverse_dynamics(robot, q, v, a)
    motion = Motion(robot, time, q, v, a, load, load, dt, jnp.asarray(extended.width))
    error = read_position(extended.effects, motion) - q
    if any(effect.has("position_error") for effect in extended.effects):
        rate = _difference(error, dt)
        load = inverse_dynamics(robot, q - error, v - rate, a - _difference(rate, dt))
    return read_torque(extended.effects, with_torque(extended.effects, motion, load))


@eqx.filter_jit
def _inverse_dynamics(extended: ExtendedModel, q: Array, v: Array, a: Array) -> Array:
    robot, shape = changed_robot(extended), v.shape
    q, v, a = (x.reshape(-1, x.shape[-1]) for x in (q, v, a))
    load = inverse_dynamics(robot, q, v, a)
    motion = Motion(robot, jnp.zeros(len(q)), q, v, a, load, load, 0.0, jnp.asarray(extended.width))
    return with_torque(extended.effects, motion, load).total.reshape(shape)


@eqx.filter_jit
def _forward_dynamics(extended: ExtendedModel, q: Array, v: Array, tau: Array) -> Array:
    flat = (x.reshape(-1, x.shape[-1]) for x in (q, v, tau))
    return jax.vmap(_solve_acceleration, (None, 0, 0, 0))(extended, *flat).reshape(v.shape)


def _solve_acceleration(extended: ExtendedModel, q: Array, v: Array, tau: Array) -> Array:
    def excess(a: Array) -> Array:
        return _inverse_dynamics(extended, q, v, a) - tau

    def solve_linear(linear: Callable[[Array], Array], right: Array) -> Array:
        return jnp.linalg.solve(jax.jacfwd(linear)(right), right)

    return jax.lax.custom_root(excess, jnp.zeros_like(v), _newton, solve_linear)


def _newton(excess: Callable[[Array], Array], start: Array) -> Array:
    def both(a: Array) -> tuple[Array, Array]:
        value = excess(a)
        return value, value

    def unfinished(state: tuple[Array, Array, Array]) -> Array:
        return (state[1] > 1e-13) & (state[2] < _NEWTON_STEPS)

    def improve(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        a, _, count = state
        slope, value = jax.jacfwd(both, has_aux=True)(a)
        step = jnp.linalg.solve(slope, value)
        return a - step, jnp.max(jnp.abs(step) / (1 + jnp.abs(a))), count + 1

    return jax.lax.while_loop(unfinished, improve, (start, jnp.asarray(jnp.inf), jnp.asarray(0)))[0]


def opened(extended: ExtendedModel) -> ExtendedModel:
    """The model with the places of its effects as arrays: one compiled program for all places."""
    return changed(extended, effects=tuple(movable(effect) for effect in extended.effects))


def changed_robot(extended: ExtendedModel) -> RobotModel:
    """The robot with every effect in it that changes its inertia, gravity or geometry."""
    robot = extended.robot
    for effect in extended.effects:
        robot = effect.change(robot)
    return robot


def with_torque(effects: tuple[Effect, ...], motion: Motion, load: Float[Array, "samples nv"]) -> Motion:
    """The motion under the given rigid body torque, and its total once every torque form has been added."""
    motion = dataclasses.replace(motion, load=load, total=load)
    for effect in effects:
        if effect.has("torque"):
            motion = dataclasses.replace(motion, total=motion.total + _joint_torque(movable(effect), motion))
    return motion


# compiled once for each kind of effect, whatever the joint: a model of other effects then needs no new compilation
@eqx.filter_jit
def _joint_torque(effect: Effect, motion: Motion) -> Float[Array, "samples nv"]:
    return effect.joint_torque(motion)


def read_position(effects: tuple[Effect, ...], motion: Motion) -> Float[Array, "samples nv"]:
    """What the position sensors read while the joints move as `motion` says, rad or m."""
    position = motion.position
    for effect in effects:
        if effect.has("position_error"):
            error = effect.position_error(motion)
            position = position + error if error.ndim == 2 else position.at[:, effect.at[-1]].add(error)
    return position


def read_torque(effects: tuple[Effect, ...], motion: Motion) -> Float[Array, "samples nv"]:
    """What the torque sensors make of a uniform record of the drives' torques, the `total` of `motion`; N m or N."""
    torque = motion.total
    for effect in effects:
        if effect.has("torque_error"):
            torque = torque + _joint_torque_error(exact(movable(effect)), dataclasses.replace(motion, total=torque))
        if effect.has("torque_response"):
            answer = _respond(movable(effect), torque, motion.dt)
            seen = effect.places if effect.acts_on in ("joint", "pair") else jnp.arange(torque.shape[1])
            torque = torque.at[:, seen].set(answer[:, seen])
    return torque


@eqx.filter_jit
def _joint_torque_error(effect: Effect, motion: Motion) -> Float[Array, "samples nv"]:
    return effect.in_joints(effect.torque_error(motion), motion)


@eqx.filter_jit
def _respond(effect: Effect, signal: Float[Array, "samples nv"], dt: Float[Array, ""] | float) -> Array:
    """Response to a record: exactly to the line between its ends, in the frequency domain to the rest.

    The rest vanishes at both ends, so its odd extension is periodic with a continuous slope: nothing rings.
    """
    samples = signal.shape[0]
    zero, one = jnp.zeros(1), jnp.ones(1)
    gain, slope = jax.jvp(lambda w: effect.torque_response(w) + 0j, (zero,), (one,))
    slide = (signal[-1] - signal[0]) / ((samples - 1) * dt)
    line = signal[0] + slide * (dt * jnp.arange(samples))[:, None]
    bend = signal - line
    periodic = jnp.concatenate([bend, -bend[-2:0:-1]])
    omega = 2 * jnp.pi * jnp.fft.rfftfreq(periodic.shape[0]) / dt
    response = effect.torque_response(omega)[:, None]
    answer = jnp.fft.irfft(response * jnp.fft.rfft(periodic, axis=0), n=periodic.shape[0], axis=0)[:samples]
    return answer + gain.real * line + slope.imag * slide


@jax.jit
def _difference(signal: Float[Array, "samples nv"], dt: Float[Array, ""]) -> Float[Array, "samples nv"]:
    """Five-point central derivative of a uniform record; the two samples at each end take their neighbour's."""
    inner = (8 * (signal[3:-1] - signal[1:-3]) - (signal[4:] - signal[:-4])) / (12 * dt)
    return jnp.pad(inner, ((2, 2), (0, 0)), mode="edge")
