"""Simulation of the loop from a command: `rollout`, differentiable in the loop, the command and the start."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..compiled.batching import filtered_program, traced
from ..compiled.precision import in_float64
from ..errors import InputError, check_real
from ..rigid.kinematics import check_shapes
from . import own
from .loop import Loop, State, advance, integrated, mobility, observe

__all__ = ["Rollout", "delayed", "rollout"]


class Rollout(eqx.Module):
    """Motion of a loop: the state at each of the `time`s, before the step that begins there."""

    time: Float[Array, " steps"]  # s
    position: Float[Array, "steps nq"]  # rad or m
    velocity: Float[Array, "steps nv"]
    reading: Float[Array, "steps measured"]  # of the encoders


def rollout(
    loop: Loop,
    command: Float[ArrayLike, "steps nu"],
    position: Float[ArrayLike, " nq"],
    velocity: Float[ArrayLike, " nv"] | None = None,
) -> Rollout:
    """Motion of the loop from a start (rad or m, and per second), one row of `command` for each step of `loop.dt`.

    Row k holds over the step from k dt to (k + 1) dt, k >= 0; drives with a delay see it later, by the mean over the
    step of what was held `delay` before. Position, velocity and reading k are those at k dt, before that step. Forward
    and reverse mode work: `jax.grad` of a loss over the readings, `jax.jvp`, `jax.vmap`. Raises `InputError` where the
    shapes do not fit and, outside of `jit`, where the motion diverges, with the joint and the step, or a number that it
    depends on is not finite.

    >>> import numpy as np, figaroh_jax as fj
    >>> loop, _ = fj.load_loop(fj.DEMO, {"elbow": {"kind": "position", "kp": 20.0, "kd": 0.5}}, joints=["elbow"])
    >>> fj.rollout(loop, np.zeros((20, 1)), np.zeros(1)).reading.shape
    (20, 1)
    """
    if not isinstance(loop, Loop):
        raise InputError(
            f"loop is of type {type(loop).__name__}; `load_loop` makes one of a robot's file and its drives"
        )
    check_real("command", command)
    u = _array(command)
    if u.ndim != 2 or u.shape[1] != len(loop.drives.names):
        names = ", ".join(loop.drives.names)
        raise InputError(f"command has shape {u.shape}; one row for each step, one column for each of: {names}")
    velocity = np.zeros(loop.robot.nv) if velocity is None else velocity
    check_shapes(loop.robot, q=position, v=velocity)
    q, v = _array(position), _array(velocity)
    found = in_float64(_rollout)(loop, u, q, v)
    if not traced(found.reading):
        _refuse_divergence(loop, found, command=u, position=q, velocity=v)
    return found


def _array(x: Any) -> Any:
    """What JAX traces as it is, all else in float64."""
    return jnp.asarray(x) if traced(x) else np.asarray(x, float)


def _refuse_divergence(loop: Loop, found: Rollout, **given: Any) -> None:
    wrong = np.argwhere(~(np.abs(np.asarray(found.velocity)) < 1e6))
    if len(wrong):
        for name, array in given.items():
            for at in np.argwhere(~np.isfinite(np.asarray(array)))[:1]:
                row, places = f"row {at[0]}, " * (len(at) > 1), loop.robot.dof_names
                if name == "command":
                    places = loop.drives.names
                where = places[at[-1]] if len(places) == array.shape[-1] else f"number {at[-1]}"
                raise InputError(f"{name}, {row}{where}: {np.asarray(array)[tuple(at)]}; finite numbers are expected")
        row, column = wrong[0]
        raise InputError(
            f"the simulation diverges at joint {loop.robot.dof_names[column]}, {row * float(loop.dt):.4g} s"
            f" (step {row}): check the gains against the inertia and the time step"
        )


@filtered_program
def _rollout(loop: Loop, u: Array, q: Array, v: Array) -> Rollout:
    weight = mobility(loop)
    seen = delayed(u[..., None], jnp.asarray(loop.drives.delay), loop.dt)

    def one(carry: tuple[State, Array], control: Array) -> tuple[tuple[State, Array], State]:
        state, warm = carry
        step = jax.lax.stop_gradient(advance(loop, state, control, weight, warm)[1])
        return (integrated(loop, state, control, weight, step), step.a), state

    active = jnp.concatenate([jnp.zeros((u.shape[1], 1)), own.begun_memory(loop.effects, v[:, None])])
    start = State(q[:, None], v[:, None], active)
    _, states = jax.lax.scan(one, (start, jnp.zeros_like(v)[:, None]), seen)
    time = loop.dt * jnp.arange(len(u))
    reading = jax.vmap(lambda q, v, act: observe(loop, State(q, v, act)))(*states)
    return Rollout(time, states.q[..., 0], states.v[..., 0], reading[..., 0])


def delayed(command: Array, delay: Array, dt: Any) -> Array:
    """What a drive sees `delay` (nu,) seconds late, (steps, nu, samples): the mean over each step of the held command.

    That mean is the linear interpolation between two rows, so it has the right derivative by the delay. Before the
    first row its value holds.
    """
    late = jnp.maximum(delay, 0.0) / dt
    whole = jnp.floor(late)
    part = (late - whole)[None, :, None]
    row = jnp.arange(len(command))[:, None] - whole.astype(int)[None]
    now, before = (jnp.take_along_axis(command, jnp.clip(row - k, 0, None)[..., None], axis=0) for k in (0, 1))
    return (1 - part) * now + part * before
