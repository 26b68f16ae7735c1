"""From motion to rows: the regressor of the current model, the columns of every candidate, and exact predictions.

Three kinds of effect act in three ways. `columns`: torque linear in its amplitudes is added. `position`: the true
position is the measured one less the sensor's error, so the rigid body moves otherwise. `response`: the torque sensor
filters the torque of the whole model, all columns alike.
"""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from .dynamics import inverse_dynamics
from .effect import Effect, Motion, columns
from .model import RobotModel
from .records import Records, filter_rows

__all__ = ["candidates", "difference", "effect_rows", "joint_columns", "kind", "shifted", "torque_change"]


def kind(effect: Effect | type[Effect]) -> Literal["columns", "position", "response"]:
    """How the effect acts on the rows."""
    if effect.has("position_error"):
        return "position"
    return "response" if effect.has("torque_response") else "columns"


def difference(signal: Float[Array, "n N"], dt: Float[Array, ""] | float) -> Float[Array, "n N"]:
    """Derivative by five-point central differences; the two ends hold their neighbours' (rows there are trimmed)."""
    inner = (8 * (signal[:, 3:-1] - signal[:, 1:-3]) - (signal[:, 4:] - signal[:, :-4])) / (12 * dt)
    return jnp.pad(inner, ((0, 0), (2, 2)), mode="edge")


def shifted(effect: Effect, motion: Motion, records: Records) -> Motion:
    """The true motion of the links where `motion` is what the sensor of `effect` has read."""
    error = effect.position_error(motion).reshape(records.position.shape[:2])
    rate = difference(error, records.dt)
    change = [error, rate, difference(rate, records.dt)]
    joint = effect.at[0]
    q, v, a = (
        signal.at[:, joint].add(-delta.reshape(-1))
        for signal, delta in zip((motion.position, motion.velocity, motion.acceleration), change, strict=True)
    )
    return eqx.tree_at(lambda m: (m.position, m.velocity, m.acceleration), motion, (q, v, a))


def torque_change(effect: Effect, motion: Motion, records: Records) -> Float[Array, "nN nv"]:
    """Exact torque of a sensor effect: what the current model says with it less what it says without.

    A `position` effect moves the rigid body; a `response` is left to the row filter, which is exact in frequency.
    """
    true = shifted(effect, motion, records)
    moved = inverse_dynamics(motion.model, true.position, true.velocity, true.acceleration)
    return moved - inverse_dynamics(motion.model, motion.position, motion.velocity, motion.acceleration)


def effect_rows(
    effect: Effect, motion: Motion, records: Records, whitening: Float[Array, "F nv"]
) -> Float[Array, "amplitudes rows n M"]:
    """Whitened rows of a unit of each amplitude of `effect` at its joints (`rows`: its own, or all joints).

    Sensor effects have one column, their torque divided by the parameter: exact at that parameter's value.
    """
    torque, joints = raw_columns(effect, motion, records)
    flat = torque.reshape(-1, torque.shape[2])
    rows = placed_rows(flat, jnp.tile(joints, torque.shape[0]), records, response_of(effect, records, whitening))
    return rows.reshape(*torque.shape[:2], *rows.shape[1:])


def raw_columns(
    effect: Effect, motion: Motion, records: Records
) -> tuple[Float[Array, "amplitudes rows nN"], Int[Array, " rows"]]:
    """Torque of a unit of each amplitude at the samples, and the joints of its rows."""
    way, everywhere = kind(effect), jnp.arange(records.position.shape[2])
    if way == "response":
        return motion.total.T[None], everywhere
    if way == "position":
        return torque_change(effect, motion, records).T[None] / _size(effect), everywhere
    torque = columns(effect, motion)
    own = effect.acts_on in ("joint", "pair")
    torque = jnp.moveaxis(torque.reshape(*torque.shape[:2], -1), 1, 2)
    return torque, jnp.asarray(effect.at) if own else everywhere


def response_of(effect: Effect, records: Records, whitening: Float[Array, "F nv"]) -> Complex[Array, "F nv"]:
    """Response that the effect's columns pass: the whitening, and what a sensor effect makes of the torque."""
    if kind(effect) != "response":
        return whitening
    return whitening * ((effect.torque_response(records.omega) - 1) / _size(effect))[:, None]


def placed_rows(
    torque: Float[Array, "K nN"], joints: Int[Array, " K"], records: Records, response: Complex[Array, "F nv"]
) -> Float[Array, "K n M"]:
    """Rows of torques at one joint each, with that joint's response and weight."""
    n, samples, _, _ = records.shape
    signal = jnp.moveaxis(torque.reshape(-1, n, samples), 0, 2)
    rows = filter_rows(records, signal, jnp.take(response, joints, axis=1)) * jnp.take(records.weight, joints, axis=2)
    return jnp.moveaxis(rows, 2, 0)


def _size(effect: Effect) -> Float[Array, ""]:
    (name,) = effect.parameters()
    return getattr(effect, name)


def candidates(effect: type[Effect], model: RobotModel) -> Effect:
    """The effect at every place where it may act, on its grid: one object with leading axes (places, grid)."""
    places = _places(effect, model)
    shapes = {name: p for name, p in effect.parameters().items() if not p.linear}
    mesh = np.meshgrid(*[np.asarray(p.grid) for p in shapes.values()], indexing="ij")
    points = max(1, int(np.prod([len(p.grid) for p in shapes.values()])))
    at = np.broadcast_to(places[:, None], (len(places), points, places.shape[1]))
    values = {name: np.zeros(at.shape[:2]) for name in effect.parameters()}
    for name, grid in zip(shapes, mesh, strict=True):
        values[name] = np.broadcast_to(grid.reshape(1, -1), at.shape[:2])
    return effect(at, **values)


def _places(effect: type[Effect], model: RobotModel) -> np.ndarray:
    if effect.acts_on == "joint":
        return np.arange(model.nv)[:, None]
    if effect.acts_on == "link":
        return np.arange(len(model.joints))[:, None]
    if effect.acts_on == "robot":
        return np.zeros((1, 0), dtype=int)
    neighbours = {
        tuple(sorted((model.joints[joint.parent].coordinate, joint.coordinate)))
        for joint in model.joints
        if joint.parent >= 0 and model.joints[joint.parent].coordinate != joint.coordinate
    }
    return np.array(sorted(neighbours), dtype=int).reshape(-1, 2)


def joint_columns(effect: Effect, motion: Motion) -> Float[Array, "nN nv amplitudes"]:
    """`columns` of the effect in the rows of all joints."""
    torque = jnp.moveaxis(columns(effect, motion), 0, -1)
    if effect.acts_on in ("link", "robot"):
        return torque
    torque = torque.reshape(torque.shape[0], -1, torque.shape[-1])
    blank = jnp.zeros((*motion.position.shape, torque.shape[-1]))
    return blank.at[:, effect.at].add(torque)
