"""Values and intervals of the accepted causes, all fitted together, and the models that carry them."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .design import kind, torque_change
from .effect import Effect, Motion, joint_unit
from .evidence import Rows
from .extended import ExtendedModel, extend
from .model import RobotModel
from .problem import Problem, State, filtered_rows
from .records import Records
from .refit import shapes, with_shape
from .results import Estimate

__all__ = ["Fitted", "estimates", "fitted_model", "joint_fit", "torque_slope", "with_amplitudes"]

KEPT = 1e-12


class Fitted(eqx.Module):
    """Parameters fitted together: coefficients of the state, then the shapes of its causes, and their covariance."""

    value: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    places: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # of each cause's fields among the parameters


def with_amplitudes(state: State, causes: list[Effect], model: RobotModel) -> list[Effect]:
    """The causes with the amplitudes that the state has found for them."""
    out = []
    for effect, place in zip(causes, amplitude_places(state, causes, model), strict=True):
        names = [name for name, p in effect.parameters().items() if p.linear]
        out.append(with_shape(effect, names, [state.theta[i] for i in place]) if names else effect)
    return out


def amplitude_places(state: State, causes: list[Effect], model: RobotModel) -> list[list[int]]:
    """Columns of each cause's amplitudes in the state; causes with columns are its last terms, in order."""
    counts = [sum(p.linear for p in e.parameters().values()) if kind(e) == "columns" else 0 for e in causes]
    first = state.X.shape[2] - sum(counts)
    starts = first + np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int) if counts else []
    return [list(range(s, s + c)) for s, c in zip(starts, counts, strict=True)]


def joint_fit(
    problem: Problem, state: State, rows: Rows, causes: list[Effect], whitening: Float[np.ndarray, "F nv"]
) -> Fitted:
    """Gauss-Newton step of all coefficients and shapes at once, and a covariance from the scores of the blocks.

    `A^-1 (sum_b g_b g_b' + L) A^-1` with g_b the score of a block and L the prior: right for coloured residuals too.
    """
    slopes, own = [], []
    for effect in with_amplitudes(state, causes, problem.model):
        names = shapes(type(effect))
        own.append(len(names))
        slopes += [torque_slope(problem, state, effect, name, whitening) for name in names]
    J = np.concatenate([rows.X, *[s[..., None] for s in slopes]], axis=2)
    precision = np.append(state.prior.precision, np.zeros(len(slopes)))
    tall = J.reshape(-1, J.shape[2])
    A = tall.T @ tall + np.diag(precision)
    A = A + KEPT * np.diag(np.maximum(np.diag(A), KEPT))
    residual = rows.y - rows.X @ state.theta
    pull = np.append(state.prior.precision * (state.prior.mean - state.theta), np.zeros(len(slopes)))
    inverse = np.linalg.inv(A)
    step = inverse @ (tall.T @ residual.reshape(-1) + pull)
    blocks = rows.block.max() + 1
    member = (rows.block[:, None] == np.arange(blocks)).astype(float)
    scores = np.sum([member.T @ (x * r[:, None]) for x, r in zip(J, residual, strict=True)], axis=0)
    covariance = inverse @ (scores.T @ scores * blocks / max(blocks - 1, 1) + np.diag(precision)) @ inverse
    values = [float(getattr(e, n)) for e in causes for n in shapes(type(e))]
    places, first = [], rows.X.shape[2]
    for amplitude, count in zip(amplitude_places(state, causes, problem.model), own, strict=True):
        places.append((*amplitude, *range(first, first + count)))
        first += count
    return Fitted(np.append(state.theta, values) + step, covariance, tuple(places))


def moved(effect: Effect, fitted: Fitted, place: tuple[int, ...]) -> Effect:
    """The cause with its shapes after the step, kept in their bounds."""
    names = shapes(type(effect))
    values = fitted.value[list(place[len(place) - len(names) :])] if names else []
    kept = []
    for name, value in zip(names, values, strict=True):
        parameter = effect.parameters()[name]
        inside = float(np.clip(value, parameter.lower, parameter.upper))
        if parameter.hole and parameter.hole[0] < inside < parameter.hole[1]:
            inside = float(getattr(effect, name))
        kept.append(np.float64(inside))
    return with_shape(effect, names, kept) if names else effect


def estimates(effect: Effect, fitted: Fitted, place: tuple[int, ...], model: RobotModel) -> dict[str, Estimate]:
    """What an engineer reads of the effect, with one sigma (first order in the fitted parameters)."""
    names = [n for n, p in effect.parameters().items() if p.linear and kind(effect) == "columns"]
    names += shapes(type(effect))
    found, slope = _physical(effect, names)
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
    values = jnp.asarray([float(getattr(effect, name)) for name in names])

    def physical(x: Float[Array, " k"]) -> dict[str, Float[Array, ""]]:
        return {k: jnp.asarray(v) for k, v in with_shape(effect, names, list(x)).physical().items()}

    slope = jax.jacfwd(physical)(values)
    return {k: float(v) for k, v in physical(values).items()}, {k: np.asarray(g) for k, g in slope.items()}


def prismatic(model: RobotModel) -> tuple[bool, ...]:
    """Whether each coordinate slides."""
    kinds = {joint.coordinate: joint.kind == "prismatic" for joint in reversed(model.joints)}
    return tuple(kinds[k] for k in range(model.nv))


def fitted_model(problem: Problem, state: State, causes: list[Effect]) -> ExtendedModel:
    """The robot with its fitted inertia, the friction of the baseline and the causes, as one extended model."""
    links = len(problem.model.joints)
    inertia = state.theta[: 10 * links].reshape(links, 10)
    robot = eqx.tree_at(lambda m: m.inertia, problem.model, inertia)
    effects, column = [], 10 * links
    known = {(type(e).name, tuple(np.asarray(e.at))) for e in causes}
    for term in state.terms:
        names = [name for name, p in term.parameters().items() if p.linear]
        for place in range(term.at.shape[0]):
            one = jax.tree.map(lambda x, k=place: np.asarray(x)[k], term)
            values = [np.float64(v) for v in state.theta[column : column + len(names)]]
            column += len(names)
            if (term.name, tuple(one.at)) not in known:
                effects.append(with_shape(one, names, values))
    return extend(robot, *effects, *with_amplitudes(state, causes, problem.model), width=problem.width)


def torque_slope(
    problem: Problem, state: State, effect: Effect, name: str, whitening: Float[np.ndarray, "F nv"]
) -> Float[np.ndarray, "nv T"]:
    """Derivative of the whitened torque in one shape of the effect, its amplitudes as they are."""
    omega = jnp.asarray(problem.records.omega)
    response = state.response(omega)[:, None] * jnp.asarray(whitening)
    if kind(effect) == "response":
        value, slope = jax.jvp(
            lambda p: with_shape(effect, [name], [p]).torque_response(omega),
            (jnp.asarray(getattr(effect, name)),),
            (jnp.ones(()),),
        )
        return filtered_rows(problem, state.motion.total, response * (slope / value)[:, None])
    torque = _torque_slope(effect, jnp.asarray(getattr(effect, name)), name, state.motion, problem.records)
    return filtered_rows(problem, torque, response)


@eqx.filter_jit
def _torque_slope(effect: Effect, value: Array, name: str, motion: Motion, records: Records) -> Float[Array, "nN nv"]:
    def torque(p: Float[Array, ""]) -> Float[Array, "nN nv"]:
        changed = with_shape(effect, [name], [p])
        if kind(effect) == "position":
            return torque_change(changed, motion, records)
        return changed.joint_torque(motion)

    return jax.jvp(torque, (value,), (jnp.ones(()),))[1]
