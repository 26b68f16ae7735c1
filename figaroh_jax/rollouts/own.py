"""Effects that act in a loop by their own torque: a user's, which the loop has no numbers for.

An `Effect` with the form `torque` acts at every step: what does not depend on the direction of motion is a torque of
the beginning of the step (MuJoCo's `qfrc_applied`), half the jump between both directions is a level of dry friction
and holds the joint as every dry friction of the loop does. One with a `step` has a state, which is a state of the loop.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..effects.base import Effect, Motion, Place, fixed
from ..effects.catalogue import CATALOGUE, ROLLOUTS
from ..effects.registry import find
from ..effects.simulation import Reversal
from ..errors import InputError
from ..rigid.manifold import neutral
from ..rigid.model import RobotModel

__all__ = [
    "Acting",
    "acting",
    "after",
    "begun_memory",
    "bounds_of",
    "everywhere",
    "is_own",
    "left_out",
    "memories",
    "placed",
    "read_number",
    "registered",
    "silent",
    "starts_of",
    "unit_of",
    "with_numbers",
]

_MOST = 64  # starts of a search over the parameters that are not linear


class Acting(NamedTuple):
    """What effects do at instants: torque (nv, samples) as drives would have to add it, and level of dry friction."""

    torque: Array
    level: Array


def registered() -> dict[str, type[Effect]]:
    """Effects that a search of rollouts looks for by their torque at a joint, by name: users', as a rule."""
    own = {name: effect for name, effect in ROLLOUTS.items() if not effect.in_rollouts.numbers}
    return {name: e for name, e in own.items() if "torque" not in e.levels or CATALOGUE.get(name) is e}


def placed(robot: RobotModel, effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """The effects as a loop takes them; `InputError` where one is none that a step can simulate."""
    found = []
    for effect in map(fixed, effects):
        if not effect.has("torque") or not isinstance(effect.at, Place):
            raise InputError(f"a rollout has no form for '{effect.name}': it needs a `torque` at a known place")
        if what := _unknown_to_a_step(robot, effect):
            raise InputError(
                f"a rollout has no form for '{effect.name}': its torque follows the {what}, which a step does not know"
                " at its beginning"
            )
        found.append(_with(effect, {name: getattr(effect, name) for name in effect.parameters()}))
    return tuple(found)


def _unknown_to_a_step(robot: RobotModel, effect: Effect) -> str:
    """What its torque follows that a step does not know at its beginning: the acceleration, the time, or nothing."""
    return " and the ".join(what for what, moved in _follows(robot, effect).items() if moved)


def _follows(robot: RobotModel, effect: Effect) -> dict[str, bool]:
    """Whether its torque is computed from the acceleration, or from the time."""
    n, q = robot.nv, np.asarray(neutral(robot), float)

    def torque(acceleration: Array, time: Array) -> Array:
        given = _instant(robot, q[:, None], jnp.zeros((n, 1)), jnp.zeros((n, 1)), jnp.zeros((n, 1)))
        given = dataclasses.replace(given, acceleration=acceleration, time=time)
        one = _remembering(effect, jnp.zeros(1))
        return one.joint_torque(given.told(jnp.ones(()), jnp.ones(())))

    with jax.enable_x64(True):
        program = jax.make_jaxpr(torque)(np.zeros((1, n)), np.zeros(1)).jaxpr
    found = {}
    for name, variable in zip(("acceleration", "time"), program.invars, strict=True):
        moved = {variable}
        for equation in program.eqns:
            if any(not hasattr(x, "val") and x in moved for x in equation.invars):
                moved.update(equation.outvars)
        found[name] = any(not hasattr(x, "val") and x in moved for x in program.outvars)
    return found


def _with(effect: Effect, numbers: dict[str, Any]) -> Effect:
    own = {k: x if isinstance(x, jax.Array) else np.asarray(x, float) for k, x in numbers.items()}
    return dataclasses.replace(effect, **own)


def _remembering(effect: Effect, memory: Any) -> Effect:
    return dataclasses.replace(effect, memory=memory) if effect.has("step") else effect  # pyright: ignore


def _instant(robot: RobotModel, q: Any, v: Any, bias: Any, motor: Any) -> Reversal:
    """States (nq, samples) as a motion: `load` is gravity and velocity torques, `total` what the drives give."""
    zero = jnp.zeros(())
    return Reversal(
        robot, jnp.zeros(q.shape[1]), q.T, v.T, jnp.zeros_like(v.T), bias.T, motor.T, 0.0, jnp.zeros(v.shape[0]),
        zero, zero,
    )  # fmt: skip


def acting(
    effects: Sequence[Effect], robot: RobotModel, q: Array, v: Array, bias: Array, motor: Array, memory: Array
) -> Acting:
    """Of all effects together at states (nq, samples) and (nv, samples) with memories (effects with one, samples)."""
    motion, states = _instant(robot, q, v, bias, motor), iter(memory)
    now = [_remembering(e, next(states) if e.has("step") else None) for e in effects]

    def both(way: Array) -> Array:
        told: Motion = motion.told(way, way)
        return sum((e.joint_torque(told) for e in now), jnp.zeros_like(v.T))

    forth, back = jax.vmap(both)(jnp.array([1.0, -1.0]))
    return Acting((forth + back).T / 2, (forth - back).T / 2)


def memories(effects: Sequence[Effect]) -> int:
    """How many of the effects have a state."""
    return sum(effect.has("step") for effect in effects)


def begun_memory(effects: Sequence[Effect], v: Array) -> Array:
    """Their states where a simulation begins at velocities (nv, samples): (effects with one, samples)."""
    found = [jax.vmap(e.begin, 1)(v) for e in effects if e.has("step")]
    return jnp.stack(found) if found else jnp.zeros((0, v.shape[1]))


def after(effects: Sequence[Effect], memory: Array, v: Array, dt: Any) -> Array:
    """The states (effects with one, samples) after `dt` seconds at velocities (nv, samples)."""
    found, states = [], iter(memory)
    for effect in effects:
        if effect.has("step"):
            one = lambda z, v, e=effect: _remembering(e, z).step(v, dt).memory  # noqa: E731  # pyright: ignore
            found.append(jax.vmap(one, (0, 1))(next(states), v))
    return jnp.stack(found) if found else memory


# numbers of effects in a table: the name is "effect.parameter", the place stands for one of the loop's effects


def is_own(name: str) -> bool:
    """Whether a table's name is that of a number of an effect."""
    return "." in name


def _parameter(name: str) -> Any:
    effect, parameter = name.split(".")
    return (ROLLOUTS.get(effect) or find(effect)).parameters()[parameter]


def bounds_of(name: str) -> tuple[float, float]:
    """What the number can be."""
    one = _parameter(name)
    return one.lower, one.upper


def unit_of(name: str) -> str:
    """Its unit at a revolute joint."""
    return _parameter(name).unit


def read_number(effects: Sequence[Effect], name: str, xp: Any = np) -> Any:
    """The number of every effect of a loop, 0 at those of another name."""
    effect, parameter = name.split(".")
    return xp.stack([xp.asarray(getattr(e, parameter) if e.name == effect else 0.0) for e in effects])


def with_numbers(effects: Sequence[Effect], name: str, at: np.ndarray, new: Any) -> tuple[Effect, ...]:
    """The effects with new numbers of one name at some of their places."""
    own, parameter = list(effects), name.split(".")[1]
    for k, place in enumerate(at):
        own[place] = dataclasses.replace(own[place], **{parameter: new[k]})
    return tuple(own)


def silent(effects: Sequence[Effect], numbers: dict[tuple[str, int], float]) -> bool:
    """Whether no effect does anything, with `numbers` of (name, place) in place of its own."""
    for k, effect in enumerate(effects):
        names = effect.amplitudes()
        if not names or any(numbers.get((f"{effect.name}.{n}", k), float(getattr(effect, n))) for n in names):
            return False
    return True


def everywhere(robot: RobotModel, effects: Sequence[Effect], forbid: Sequence[str] = ()) -> tuple[Effect, ...]:
    """A loop's effects with every registered one at every joint, without a size where it does not act."""
    found = list(effects)
    there = {(e.name, *np.asarray(e.at).tolist()) for e in found}
    for name, effect in registered().items():
        new = [effect(Place((j,))) for j in range(robot.nv) if (name, j) not in there]
        if name in forbid or not new:
            continue
        if not _unknown_to_a_step(robot, new[0]):  # `left_out` tells it
            found += placed(robot, new)
    return tuple(found)


def left_out(robot: RobotModel, forbid: Sequence[str] = ()) -> tuple[str, ...]:
    """Of each registered effect that no search of rollouts can look for, why."""
    whats = {name: _unknown_to_a_step(robot, effect(Place((0,)))) for name, effect in registered().items()
             if name not in forbid}  # fmt: skip
    return tuple(
        f"'{name}' is registered, but not looked for in rollouts: its torque follows the {what}, which a step does not"
        " know at its beginning"
        for name, what in whats.items() if what
    )  # fmt: skip


def starts_of(effect: type[Effect]) -> tuple[tuple[float, ...], ...]:
    """Values from which a search over its parameters starts, amplitudes (0) first: points of the grids, thinned."""
    points = list(product(*(p.grid for p in effect.parameters().values() if not p.linear)))
    points = [points[k] for k in np.unique(np.linspace(0, len(points) - 1, min(len(points), _MOST)).astype(int))]
    return tuple((0.0,) * len(effect.amplitudes()) + one for one in points)
