"""From motion to rows: what a unit of every candidate adds, and exact predictions of what the sensors read.

Three kinds of effect act in three ways. `columns`: torque linear in its amplitudes is added or read; that of a position
sensor whose error is linear in them too, which is small, to first order. `position`: the true position is the measured
one less an error that is not linear in its parameter, so the rigid body moves otherwise. `response`: the torque sensor
filters the torque of the whole model, all columns alike.

JAX evaluates the equations, many effects in one program; samples, shifts and filters stay on the host in NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache, partial
from math import prod
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from ..compiled.batching import CPU_OPTIONS, DRAFT_OPTIONS
from ..compiled.executable_cache import Program
from ..effects.base import Effect, Motion, columns
from ..recordings.stacked import Records, filter_rows
from ..rigid.model import RobotModel
from .shifts import links_torque, shift_torques, torque_change

__all__ = [
    "BATCH",
    "Units",
    "as_kind",
    "batch_size",
    "candidates",
    "fitted_fields",
    "flattened",
    "kind",
    "local",
    "sensor_response",
    "shapes",
    "unit_rows",
    "units",
    "units_and_slopes",
    "with_shape",
]


SHORT = 4096  # samples up to which programs of the whole catalogue take longer to optimise than that spares
BATCH = 4  # effects with a shape in one program, and starts of a refit


class Units(NamedTuple):
    """Torque of a unit of each amplitude of several effects of one class, N m or N, at the joints that it touches.

    A sensor effect has one column, its torque divided by its parameter: exact at that parameter's value. That of a
    torque sensor comes out of the torque of the whole model by `response`.
    """

    torque: Float[np.ndarray, "effects k rows nN"]
    joints: Int[np.ndarray, "effects rows"]
    response: Complex[np.ndarray, "effects F"] | None = None

    def of(self, which: Bool[np.ndarray, " effects"]) -> Units:
        """Some of the effects."""
        if np.all(which):
            return self
        return Units(self.torque[which], self.joints[which], None if self.response is None else self.response[which])


def kind(effect: Effect | type[Effect]) -> Literal["columns", "position", "response"]:
    """How the effect acts on the rows."""
    return _kind(effect if isinstance(effect, type) else type(effect))


@lru_cache(maxsize=512)
def _kind(effect: type[Effect]) -> Literal["columns", "position", "response"]:
    if effect.has("position_error") and shapes(effect):
        return "position"
    return "response" if effect.has("torque_response") else "columns"


def shapes(effect: type[Effect]) -> list[str]:
    """Parameters that enter nonlinearly and may take any value between their bounds."""
    return [name for name, p in effect.parameters().items() if not p.linear and not p.choice]


def fitted_fields(effect: Effect) -> list[str]:
    """The effect's fields among the parameters of a fit, in order: amplitudes that have a column, then shapes."""
    return (effect.amplitudes() if kind(effect) == "columns" else []) + shapes(type(effect))


def batch_size(effect: Effect | type[Effect]) -> int:
    """Effects with a shape in one program: as many as a refit starts from."""
    return min(BATCH, prod(len(p.grid) for p in effect.parameters().values() if not p.linear))


def with_shape(effect: Effect, names: list[str], values: list) -> Effect:
    """The effect with the named parameters replaced."""
    other = object.__new__(type(effect))  # as `eqx.tree_at` makes it, which takes ten times as long
    for name, value in (vars(effect) | dict(zip(names, values, strict=True))).items():
        object.__setattr__(other, name, value)
    return other


def as_kind(effect: Effect, kind_of: type[Effect]) -> Effect:
    """The same numbers as an effect of another class with the same parameters."""
    other = object.__new__(kind_of)
    for name, value in vars(effect).items():
        object.__setattr__(other, name, value)
    return other


def flattened(batch: Effect) -> Effect:
    """The effects of a batch with leading axes (places, grid) on one axis."""
    return jax.tree.map(lambda x: np.reshape(x, (np.shape(x)[0] * np.shape(x)[1], *np.shape(x)[2:])), batch)


def units(batches: Mapping[str, Effect], motion: Motion, records: Records) -> dict[str, Units]:
    """What a unit of each amplitude adds, for batches (one leading axis) of effects of any kind."""
    plain = {name: batch for name, batch in batches.items() if _way(batch) == "torque"}
    program = _unit_torques if len(motion.time) > SHORT else _quick_unit_torques
    torques = program(plain, motion) if plain else {}
    responses = {name: batch for name, batch in batches.items() if kind(batch) == "response"}
    factors = sensor_response(responses, np.asarray(records.omega))
    everywhere, out = np.arange(np.shape(motion.velocity)[1]), {}
    for name, batch in batches.items():
        joints = np.asarray(batch.at) if local(batch) else np.tile(everywhere, (len(batch.at), 1))
        if _way(batch) == "shift":
            out[name] = Units(shift_torques(batch, motion, records), joints)
        elif name in torques:
            torque = np.asarray(torques[name])
            out[name] = Units(np.moveaxis(torque.reshape(*torque.shape[:3], -1), 2, 3), joints)
        elif name in factors:
            torque = np.broadcast_to(np.asarray(motion.total).T, (len(joints), 1, *np.shape(motion.total)[::-1]))
            out[name] = Units(torque, joints, (factors[name] - 1) / _size(batch)[:, None])
        elif _way(batch) == "position":
            # finds, near a resonance too (one step of Newton's method knows it); `shifted` with its turns decides
            torque = torque_change(batch, motion, records, turns=1) / _size(batch)[:, None, None]
            out[name] = Units(np.swapaxes(torque, 1, 2)[:, None], joints)
        else:
            out[name] = Units(_changed_torques(batch, motion, records), joints)
    return out


def unit_rows(given: Units, records: Records, whitening: Complex[np.ndarray, "F nv"]) -> Float[np.ndarray, "e k r n M"]:
    """Whitened rows of the units (effects, k, rows, n, M), with the weight of each joint's rows."""
    n, samples, _, _ = records.shape
    torque, of = given.torque.reshape(*given.torque.shape[:3], n, samples), given.joints[:, None]
    if given.response is None:
        rows = filter_rows(records, torque, whitening.T, fitted=True, of=of)
    else:
        rows = filter_rows(records, torque, whitening.T[of] * given.response[:, None, None], fitted=True)
    rows *= np.moveaxis(np.asarray(records.weight), 2, 0)[of]
    return rows


def units_and_slopes(
    effects: Effect, values: Float[np.ndarray, "effects p"], motion: Motion
) -> tuple[Float[np.ndarray, "effects k rows nN"], Float[np.ndarray, "effects p k rows nN"]]:
    """Unit torques of effects with the shapes `values`, and their derivatives in each shape."""
    torque, slope = _units_and_slopes(effects, values, motion)
    return _rows_first(np.asarray(torque)), _rows_first(np.moveaxis(np.asarray(slope), -1, 1))


def sensor_response(
    batches: Mapping[str, Effect], omega: Float[np.ndarray, " F"]
) -> dict[str, Complex[np.ndarray, "effects F"]]:
    """`torque_response` of batches of effects."""
    return {name: np.asarray(x) for name, x in _responses(dict(batches), omega).items()} if batches else {}


def candidates(effect: type[Effect], model: RobotModel, motion: Motion | None = None) -> Effect:
    """The effect at every place where it may act, on its grid: one object with leading axes (places, grid).

    With the recordings' `motion` the grid may follow it (`Effect.starts`), as long at every place.
    """
    places = _places(effect, model)
    places = places[[effect.may_act(model, int(at[0])) if len(at) else True for at in places]]
    own = {name: p.grid for name, p in effect.parameters().items() if not p.linear}
    grids = [own | (effect.starts(motion, int(at[0])) if motion is not None and len(at) else {}) for at in places]
    longest = {name: max((len(grid[name]) for grid in grids), default=1) for name in own}
    grids = [{n: np.resize(np.asarray(g), longest[n]) for n, g in grid.items()} for grid in grids]
    meshes = [[axis.reshape(-1) for axis in np.meshgrid(*grid.values(), indexing="ij")] for grid in grids]
    points = int(np.prod([*longest.values(), 1]))
    at = np.broadcast_to(places[:, None], (len(places), points, places.shape[1]))
    values = {name: np.zeros(at.shape[:2]) for name in effect.parameters()}
    for k, name in enumerate(own):
        values[name] = np.stack([mesh[k] for mesh in meshes]) if meshes else values[name]
    return effect(at, **values)


def _places(effect: type[Effect], model: RobotModel) -> np.ndarray:
    if effect.acts_on == "joint":
        return np.arange(model.nv)[:, None]
    if effect.acts_on == "link":
        return np.arange(len(model.joints))[:, None]
    if effect.acts_on == "robot":
        return np.zeros((1, 0), dtype=int)
    rank = {joint.coordinate: k for k, joint in enumerate(model.joints) if not joint.follows}
    neighbours = {  # in the order of the tree, whatever the columns'
        tuple(sorted((model.joints[joint.parent].coordinate, joint.coordinate), key=rank.__getitem__))
        for joint in model.joints
        if joint.parent >= 0 and model.joints[joint.parent].coordinate != joint.coordinate
    }
    return np.array(sorted(neighbours, key=sorted), dtype=int).reshape(-1, 2)


def local(effect: Effect) -> bool:
    """Whether its torque stands in the rows of its own joints alone."""
    return effect.acts_on in ("joint", "pair") and _way(effect) == "torque"


def _way(effect: Effect | type[Effect]) -> Literal["torque", "change", "shift", "position", "response"]:
    """Where the torque comes from: an equation of its own, or the rigid body with another model or motion."""
    return _way_of(effect if isinstance(effect, type) else type(effect))


@lru_cache(maxsize=512)
def _way_of(effect: type[Effect]) -> Literal["torque", "change", "shift", "position", "response"]:
    way = _kind(effect)
    if way != "columns":
        return way
    if effect.has("position_error"):
        return "shift"
    if effect.has("torque_error"):
        return "torque"
    return "change" if effect.has("change") and not effect.has("torque") else "torque"


def _size(effect: Effect) -> Float[np.ndarray, " effects"]:
    (name,) = effect.parameters()
    return np.asarray(getattr(effect, name))


def _changed_torques(batch: Effect, motion: Motion, records: Records) -> Float[np.ndarray, "effects k nv nN"]:
    """Torque of a unit of each amplitude of effects that change the robot, which it is linear in."""
    q, v, a = motion.position, motion.velocity, motion.acceleration
    before, robot = links_torque(motion.model, q, v, a, records), jax.tree.structure(motion.model)
    models = _changed(batch, motion.model)
    out = np.empty((len(batch.at), len(batch.amplitudes()), *before.shape[::-1]))
    for one, amplitude in np.ndindex(out.shape[:2]):
        changed = jax.tree.unflatten(robot, [np.asarray(x)[one, amplitude] for x in models])
        out[one, amplitude] = (links_torque(changed, q, v, a, records) - before).T
    return out


def _rows_first(torque: Float[np.ndarray, "*lead k nN rows"]) -> Float[np.ndarray, "*lead k rows nN"]:
    return np.moveaxis(torque, -1, -2)


def _all_unit_torques(batches: dict[str, Effect], motion: Motion) -> dict[str, Float[Array, "effects k nN *rows"]]:
    return {name: jax.vmap(lambda e: columns(e, motion))(batch) for name, batch in batches.items()}


_unit_torques, _quick_unit_torques = (Program(_all_unit_torques, options=o) for o in (CPU_OPTIONS, DRAFT_OPTIONS))


@partial(Program, options=CPU_OPTIONS)
def _units_and_slopes(
    effects: Effect, values: Array, motion: Motion
) -> tuple[Float[Array, "effects k nN rows"], Float[Array, "effects k nN rows p"]]:
    names = shapes(type(effects))

    def one(effect: Effect, x: Float[Array, " p"]) -> tuple[Array, Array]:
        def unit(x: Float[Array, " p"]) -> tuple[Array, Array]:
            torque = columns(with_shape(effect, names, list(x)), motion)
            torque = torque.reshape(*torque.shape[:2], -1)
            return torque, torque

        slope, torque = jax.jacfwd(unit, has_aux=True)(x)
        return torque, slope

    return jax.vmap(one)(effects, values)


@partial(Program, options=CPU_OPTIONS)
def _responses(batches: dict[str, Effect], omega: Array) -> dict[str, Complex[Array, "effects F"]]:
    return {name: jax.vmap(lambda e: e.torque_response(omega))(batch) for name, batch in batches.items()}


@partial(Program, options=CPU_OPTIONS)
def _changed(effects: Effect, model: RobotModel) -> list[Float[Array, "effects amplitudes *rest"]]:
    """Leaves of the robot with a unit of each amplitude of each effect."""
    names = effects.amplitudes()

    def change(effect: Effect, unit: Array) -> RobotModel:
        return with_shape(effect, names, list(unit)).change(model)

    return jax.tree.leaves(
        jax.vmap(jax.vmap(change, in_axes=(None, 0)), in_axes=(0, None))(effects, jnp.eye(len(names)))
    )
