"""Motion of an extended model under commanded torques, with what its sensors would read.

Semi-implicit Euler, linearly implicit in the velocity (damping cannot blow up), and dry friction as a constraint: its
torque is the one that stops the joint, limited to the friction's level. A joint therefore sticks where friction can
hold it, and friction never gives energy to the robot.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from ..compiled.precision import in_float64
from ..errors import InputError, check_count, check_finite
from ..rigid.dynamics import inverse_dynamics
from ..rigid.kinematics import states
from ..rigid.model import RobotModel
from .base import Effect, Motion
from .extended import (
    ExtendedModel,
    changed_robot,
    check_period,
    extend,
    opened,
    read_position,
    read_torque,
    require_single_axes,
    with_torque,
)

__all__ = ["Command", "Reversal", "Simulation", "simulate"]

Command = Callable[[Float[Array, ""], Float[Array, " nv"], Float[Array, " nv"]], Float[Array, " nv"]]

_SWEEPS = 300  # Gauss-Seidel over the frictions; 5 to 30 are used, the last word has an exact solve
_REDUNDANT = 1e-10  # creep allowed to a friction, as a share of the velocity that it takes away


class Simulation(eqx.Module):
    """Record of a simulation: the truth, and what the sensors read of it."""

    time: Float[Array, " steps"]  # s
    position: Float[Array, "steps nv"]  # rad or m, at `time`
    velocity: Float[Array, "steps nv"]
    acceleration: Float[Array, "steps nv"]  # mean over the step that begins at `time`
    torque: Float[Array, "steps nv"]  # of the drives over that step, N m or N
    position_read: Float[Array, "steps nv"]  # with the errors of the position sensors
    torque_read: Float[Array, "steps nv"]  # with the response of the torque sensors


@in_float64
def simulate(
    extended: ExtendedModel | RobotModel,
    command: Float[ArrayLike, "steps nv"] | Command,
    position: Float[ArrayLike, " nv"],
    velocity: Float[ArrayLike, " nv"],
    dt: float,
    steps: int | None = None,
) -> Simulation:
    r"""Motion from `position` and `velocity` (rad or m, and per second) in steps of `dt` seconds.

    `command` holds the drives' torques (N m or N) of each step, or is a function of time, position and velocity that
    gives them; a function needs the number of `steps`. With h the torque of everything but dry friction,
    $h(q, v^+, (v^+ - v)/dt) + J' f = \tau$, $f_i = F_i \, \mathrm{clip}(J_i v^+ / w_i, -1, 1)$, $q^+ = q + dt\, v^+$,
    where the rows of J are the joints and the motors between joints, w is the width of their reversals (0: they stick)
    and the levels F hold the state at the step's beginning. Dry friction of an effect on the whole robot counts as
    friction of the joints. Differentiable with respect to model, command and start. Joints of several degrees of
    freedom are not simulated.

    >>> import numpy as np, figaroh_jax as fj
    >>> model = fj.extend(fj.load_urdf(fj.DEMO))
    >>> fj.simulate(model, np.zeros((20, 4)), np.zeros(4), np.zeros(4), 1e-3).position.shape
    (20, 4)
    """
    extended = extended if isinstance(extended, ExtendedModel) else extend(extended)
    require_single_axes(extended.robot, "a simulation")
    check_period(dt)
    q, v = states(extended.robot, position=position, velocity=velocity)
    if q.ndim != 1:
        raise InputError(f"position has shape {q.shape}; a simulation starts from one state, map it over several")
    check_finite("position", q)
    check_finite("velocity", v)
    if callable(command):
        if steps is None:
            raise InputError("a command that is a function needs the number of steps")
        check_count("steps", steps, 0)
        return _simulate(opened(extended), command, jnp.zeros((steps, q.size)), q, v, jnp.float64(dt))
    torque = states(extended.robot, command=command)[0]
    check_finite("command", torque)
    if steps is not None:
        check_count("steps", steps, 0)
    if torque.ndim != 2 or (steps is not None and torque.shape[0] < steps):
        raise InputError(f"command has shape {torque.shape}; one row of torques for each step is needed")
    return _simulate(opened(extended), None, torque[:steps], q, v, jnp.float64(dt))


@eqx.filter_jit
def _simulate(
    extended: ExtendedModel, command: Command | None, record: Array, q: Array, v: Array, dt: Array
) -> Simulation:
    time = dt * jnp.arange(record.shape[0])
    robot = changed_robot(extended)

    def advance(
        state: tuple[Array, Array, Array, list[Array]], step: tuple[Array, Array]
    ) -> tuple[tuple[Array, Array, Array, list[Array]], tuple[Array, ...]]:
        q, v, a, memory = state
        tau = step[1] if command is None else jnp.asarray(command(step[0], q, v), jnp.float64)
        for effect in extended.effects:
            tau = effect.delivered(tau)
        here = dataclasses.replace(extended, effects=_remembering(extended.effects, memory))
        after = _step(here, robot, step[0], q, v, a, tau, dt)
        memory: list[Any] = [getattr(e.step(after, dt), "memory") for e in here.effects if e.has("step")]  # noqa: B009
        a = (after - v) / dt
        return (q + dt * after, after, a, memory), (q, v, a, tau)

    start = (q, v, jnp.zeros_like(v), [e.begin(v) for e in extended.effects if e.has("step")])
    _, (qs, vs, accelerations, taus) = jax.lax.scan(advance, start, (time, record))
    load = jnp.zeros_like(qs) if not _reads(extended) else inverse_dynamics(robot, qs, vs, accelerations)
    motion = Motion(robot, time, qs, vs, accelerations, load, taus, dt, jnp.asarray(extended.width))
    seen = read_position(extended.effects, motion), read_torque(extended.effects, motion)
    return Simulation(time, qs, vs, accelerations, taus, *seen)


def _reads(extended: ExtendedModel) -> bool:
    return any(effect.has("position_error") or effect.has("torque_error") for effect in extended.effects)


def _remembering(effects: tuple[Effect, ...], memory: list[Array]) -> tuple[Effect, ...]:
    """The effects with the states of those that have one."""
    states = iter(memory)
    return tuple(dataclasses.replace(e, memory=next(states)) if e.has("step") else e for e in effects)  # pyright: ignore


def _step(
    extended: ExtendedModel,
    robot: RobotModel,
    time: Array,
    q: Array,
    v: Array,
    last: Array,
    tau: Array,
    dt: Array,
) -> Float[Array, " nv"]:
    """Velocity after one step; `last` is the acceleration of the step before: the frictions take their load from it."""

    def excess(a: Array) -> tuple[Array, tuple[Array, _Friction]]:
        # one evaluation of both instants compiles in half the time of two
        instants = [q, q], [v, v + dt * a], [last, a]
        motion = Reversal.at(extended, robot, time, *(jnp.stack(x) for x in instants))
        friction, smooth = _apart(extended, motion)
        torque = smooth[1] + friction.drive - tau
        return torque, (torque, friction)

    slope, (torque, friction) = jax.jacfwd(excess, has_aux=True)(jnp.zeros_like(v))
    answers = dt * jnp.linalg.solve(slope, jnp.concatenate([torque[:, None], friction.rows.T], axis=1))
    free, mobility = v - answers[:, 0], answers[:, 1:]
    if not extended.effects:
        return free
    f = _friction_force(friction, friction.rows @ free, friction.rows @ mobility)
    return free - mobility @ f


class Reversal(Motion):
    """One instant whose dry frictions are told their directions, so that they can be taken apart."""

    joint: Float[Array, ""]  # direction of the joints: 1, -1 or 0
    motor: Float[Array, ""]  # direction of the motors between joints

    @property
    def direction(self) -> Float[Array, "samples nv"]:
        """The direction of every joint that was told."""
        return self.joint * jnp.ones_like(self.velocity)

    def reversal(self, velocity: Array, acceleration: Array, width: Array) -> Array:
        """The direction of the motors that was told, whatever the velocity."""
        return self.motor * jnp.ones_like(velocity)

    @classmethod
    def at(cls, extended: ExtendedModel, robot: RobotModel, time: Array, q: Array, v: Array, a: Array) -> Reversal:
        """States (samples, nq) and (samples, nv) of a robot at `time` (s), with no direction told."""
        load, zero = inverse_dynamics(robot, q, v, a), jnp.zeros(())
        time = jnp.broadcast_to(time, q.shape[:1])
        return cls(robot, time, q, v, a, load, load, 0.0, jnp.asarray(extended.width), zero, zero)

    def told(self, joint: Float[Array, ""], motor: Float[Array, ""]) -> Reversal:
        """The same instant with these directions of joints and motors."""
        return dataclasses.replace(self, joint=joint, motor=motor)


class _Friction(NamedTuple):
    """Dry frictions at one instant; each row gives the velocity that its friction opposes."""

    rows: Float[Array, "frictions nv"]
    level: Float[Array, " frictions"]  # >= 0
    width: Float[Array, " frictions"]
    drive: Float[Array, " nv"]  # torque of frictions that push, i.e. whose level is negative


def _apart(extended: ExtendedModel, motion: Reversal) -> tuple[_Friction, Float[Array, "samples nv"]]:
    """Dry frictions at the first instant, and the torque of all the rest at every instant.

    A friction is half the jump of the torque from one direction to the other, the rest the mean of both.
    """
    ways, still = jnp.array([1.0, -1.0]), jnp.zeros(())
    told = jax.vmap(lambda way: with_torque(extended.effects, motion.told(way, still), motion.load).total)(ways)
    level, smooth = (told[0, 0] - told[1, 0]) / 2, (told[0] + told[1]) / 2
    width = motion.width
    drive = jnp.minimum(level, 0.0) * jnp.clip(motion.velocity[0] / (width + 1e-9), -1.0, 1.0)
    rows, levels, widths = [jnp.eye(level.size)], [jnp.maximum(level, 0.0)], [width]
    for effect in extended.effects:
        if effect.acts_on == "pair" and effect.has("torque"):
            forth, back = (effect.joint_torque(motion.told(still, way))[0] for way in ways)
            jump = (forth - back) / 2
            size = jnp.max(jnp.abs(jump))
            rows.append((jump / jnp.where(size > 0, size, 1.0))[None])
            levels.append(size[None])
            widths.append(width[effect.places].mean()[None])
    return _Friction(jnp.concatenate(rows), jnp.concatenate(levels), jnp.concatenate(widths), drive), smooth


def _friction_force(
    friction: _Friction, free: Float[Array, " frictions"], mobility: Float[Array, "frictions frictions"]
) -> Float[Array, " frictions"]:
    """Forces f with f = level clip(u / width, -1, 1) at the velocities u = free - mobility f.

    Which frictions slip is found by projected Gauss-Seidel; given that, one linear solve is exact and differentiable.
    """
    level = friction.level
    # velocity that a friction needs per unit of force; the last term lets a motor stick beside both of its joints
    soft = friction.width / jnp.where(level > 0, level, 1.0) + _REDUNDANT * jnp.diag(mobility)
    slips, way = jax.lax.stop_gradient(_slipping(*jax.lax.stop_gradient((level, soft, free, mobility))))
    equations = jnp.where(slips[:, None], jnp.eye(level.size), mobility + jnp.diag(soft))
    return jnp.linalg.solve(equations, jnp.where(slips, way * level, free))


def _slipping(level: Array, soft: Array, free: Array, mobility: Array) -> tuple[Bool[Array, " n"], Float[Array, " n"]]:
    own = jnp.diag(mobility) + soft
    own = jnp.where(own > 0, own, 1.0)

    def one(i: Array, f: Array) -> Array:
        rest = free[i] - mobility[i] @ f + jnp.diag(mobility)[i] * f[i]
        return f.at[i].set(jnp.clip(rest / own[i], -level[i], level[i]))

    def sweep(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        f, _, count = state
        new = jax.lax.fori_loop(0, level.size, one, f)
        return new, jnp.max(jnp.abs(new - f) * own), count + 1

    def unfinished(state: tuple[Array, Array, Array]) -> Array:
        return (state[1] > 1e-14 * (1 + jnp.max(jnp.abs(free)))) & (state[2] < _SWEEPS)

    f, _, _ = jax.lax.while_loop(unfinished, sweep, (jnp.zeros_like(free), jnp.asarray(jnp.inf), jnp.asarray(0)))
    return jnp.abs(f) >= level * (1 - 1e-12), jnp.sign(f)
