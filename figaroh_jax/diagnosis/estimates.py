"""Values and intervals of the accepted causes, all fitted together, and the models that carry them."""

from __future__ import annotations

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from ..effects.base import Effect, Motion, joint_unit
from ..effects.catalogue import find
from ..effects.extended import ExtendedModel, extend
from ..recordings.stacked import filtered_rows
from ..results import Estimate
from ..rigid.model import RobotModel, prismatic
from .design import Units, as_kind, fitted_fields, kind, local, sensor_response, shapes, unit_rows, with_shape
from .problem import Problem
from .shifts import torque_change
from .state import State, unit_slopes

__all__ = ["Fitted", "estimates", "fitted_model", "torque_slope", "torque_slopes", "with_amplitudes"]

STEP = 1e-5  # of central differences, relative: error 1e-10 of a third derivative's size


class Fitted(eqx.Module):
    """Parameters fitted together: coefficients of the state, then the shapes of its causes, and their covariance."""

    value: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    places: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # of each cause's fields among the parameters
    at_shapes: Float[np.ndarray, "parameters parameters"] | None = None  # the covariance at each cause's shapes as told


def with_amplitudes(state: State, causes: list[Effect]) -> list[Effect]:
    """The causes with the amplitudes that the state has found for them."""
    out = []
    for effect, place in zip(causes, amplitude_places(state, causes), strict=True):
        names = effect.amplitudes()
        out.append(with_shape(effect, names, [state.theta[i] for i in place]) if names else effect)
    return out


def amplitude_places(state: State, causes: list[Effect]) -> list[list[int]]:
    """Columns of each cause's amplitudes in the state; causes with columns are its last terms, in order."""
    counts = [len(e.amplitudes()) if kind(e) == "columns" else 0 for e in causes]
    first = len(state.theta) - sum(counts)
    starts = first + np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int) if counts else []
    return [list(range(s, s + c)) for s, c in zip(starts, counts, strict=True)]


def estimates(effect: Effect, fitted: Fitted, place: tuple[int, ...], model: RobotModel) -> dict[str, Estimate]:
    """What an engineer reads of the effect, with one sigma (first order in the fitted parameters)."""
    found, slope = _physical(effect, fitted_fields(effect))
    covariance = fitted.covariance[np.ix_(place, place)]
    straight = effect.acts_on == "joint" and prismatic(model)[int(effect.at[0])]
    units = {**{n: p.unit for n, p in effect.parameters().items()}, **effect.units()}
    out = {}
    for name, value in found.items():
        g = slope[name]
        std = float(np.sqrt(max(g @ covariance @ g, 0.0)))
        out[name] = Estimate(float(value), std, joint_unit(units[name], straight))
    return out


def _physical(effect: Effect, names: list[str]) -> tuple[dict[str, float], dict[str, Float[np.ndarray, " k"]]]:
    """What is reported of the effect, and its derivatives in the fitted fields `names`."""
    if not effect.has("physical"):
        fields = list(effect.parameters())
        return {n: float(getattr(effect, n)) for n in fields}, {
            n: np.array([n == k for k in names], float) for n in fields
        }
    values = np.array([float(getattr(effect, name)) for name in names])

    def physical(x: Float[np.ndarray, " k"]) -> dict[str, float]:
        return {k: float(v) for k, v in with_shape(effect, names, list(x)).physical().items()}

    steps = np.diag(STEP * np.maximum(np.abs(values), STEP))
    sides = [(physical(values + step), physical(values - step)) for step in steps]
    found = physical(values)
    slope = {
        key: np.array([(high[key] - low[key]) / (2 * h) for (high, low), h in zip(sides, np.diag(steps), strict=True)])
        for key in found
    }
    return found, slope


def fitted_model(problem: Problem, state: State, causes: list[Effect]) -> ExtendedModel:
    """The robot with its fitted inertia, the friction of the baseline and the causes, as one extended model."""
    links = len(problem.model.joints)
    inertia = state.theta[: 10 * links].reshape(links, 10)
    robot = eqx.tree_at(lambda m: m.inertia, problem.model, inertia)
    effects, column = [], 10 * links
    known = {(type(e).name, tuple(np.asarray(e.at))) for e in causes}
    for term in state.terms:
        names = term.amplitudes()
        for place in range(term.at.shape[0]):
            one = jax.tree.map(lambda x, k=place: np.asarray(x)[k], term)
            values = [np.float64(v) for v in state.theta[column : column + len(names)]]
            column += len(names)
            if (term.name, tuple(one.at)) not in known:
                effects.append(with_shape(one, names, values))
    effects += with_amplitudes(state, causes)
    told = (as_kind(e, find(e.one_more_of)) if e.one_more_of else e for e in effects)
    return extend(robot, *told, width=problem.width)


def _without(state: State, effect: Effect) -> Motion:
    """The motion with the total torque that the effect follows: that of the model without it."""
    motion = state.motion
    if effect.follows_torque:
        own = [
            s
            for s, t in zip(state.shares(state.theta), state.terms, strict=True)
            if t.name == effect.name and np.array_equal(t.places.reshape(-1), effect.places.reshape(-1))
        ]
        motion = eqx.tree_at(lambda m: m.total, motion, motion.total - sum(own, np.zeros_like(motion.total)))
    return motion


def torque_slopes(
    problem: Problem, state: State, effect: Effect, whitening: Float[np.ndarray, "F nv"]
) -> list[Float[np.ndarray, "nv T"]]:
    """Derivatives of the whitened torque in the shapes of the effect, its amplitudes as they are."""
    names = shapes(type(effect))
    if not names or kind(effect) != "columns":
        return [torque_slope(problem, state, effect, name, whitening) for name in names]
    response = state.response(problem.records.omega)[:, None] * whitening
    amplitudes, out = [float(getattr(effect, n)) for n in effect.amplitudes()], []
    n, _, count, nv = problem.records.shape
    joints = np.asarray(effect.at) if local(effect) else np.arange(nv)
    for slope in unit_slopes(problem, state, effect, _without(state, effect)):
        own = Units(np.tensordot(amplitudes, slope, 1)[None, None], joints[None])
        rows = np.zeros((nv, n * count))
        rows[joints] = unit_rows(own, problem.records, response).reshape(len(joints), -1)
        out.append(rows)
    return out


def torque_slope(
    problem: Problem, state: State, effect: Effect, name: str, whitening: Float[np.ndarray, "F nv"]
) -> Float[np.ndarray, "nv T"]:
    """Derivative of the whitened torque in the one parameter of a sensor effect."""
    response, size = state.response(problem.records.omega)[:, None] * whitening, float(getattr(effect, name))
    h = STEP * max(abs(size), STEP)
    sides = jax.tree.map(lambda *x: np.stack(x), *(with_shape(effect, [name], [size + s * h]) for s in (1, -1)))
    if kind(effect) == "response":
        high, low = sensor_response({effect.name: sides}, problem.records.omega)[effect.name]
        relative = 2 * (high - low) / (high + low) / (2 * h)
        return filtered_rows(problem.records, state.motion.total, response * relative[:, None])
    high, low = torque_change(sides, state.motion, problem.records)
    return filtered_rows(problem.records, (high - low) / (2 * h), response)
