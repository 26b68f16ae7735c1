"""The current model against the recordings: its raw regressor, its prior, its noise, its whitened rows.

A `Problem` is the data, fixed for a diagnosis. A `State` is a model of it: baseline effects and the causes accepted so
far, with the regressor at every sample. `whitened` gives the rows in which everything is decided.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from .design import joint_columns, kind, shifted
from .dynamics import inverse_dynamics
from .effect import Effect, Motion
from .effects import Payload, find
from .evidence import Prior, Rows, instruments
from .inertia import from_pseudo_inertia, to_com
from .model import Leaf, RobotModel
from .records import Records, filter_rows
from .regressor import joint_torque_regressor

__all__ = ["Layout", "Problem", "State", "baseline", "extended_state", "plain_rows", "whitened"]

FRICTION_PRECISION = 1e-6
COLUMNS = 4  # filtered columns are padded to a multiple of it


class Layout(eqx.Module):
    """Which rows repeat, belong together or are left out together; T = recordings x rows."""

    partner: Int[np.ndarray, "partners T"]
    paired: Float[np.ndarray, "nv T"]
    block: Int[np.ndarray, " T"]
    fold: Int[np.ndarray, " T"]
    repeats: bool = eqx.field(static=True)


@dataclass(frozen=True)
class Problem:
    """Recordings and what is believed of the robot before; rows that are not fitted have no weight."""

    model: RobotModel
    records: Records
    layout: Layout
    trust: float
    width: Float[np.ndarray, " nv"]  # half width of the friction's reversal, rad/s or m/s
    held: Float[np.ndarray, "n M nv"]  # 1: a row of a holdout recording with torque

    @cached_property
    def torque(self) -> Float[np.ndarray, "n M nv"]:
        """Rows of the measured torque, not whitened, also those that are not fitted, N m or N."""
        return open_rows(self, self.records.flat(self.records.torque), jnp.ones(len(np.asarray(self.records.omega))))

    @cached_property
    def gain(self) -> Float[np.ndarray, " F"]:
        """Power gain of the row filter."""
        return np.asarray(self.records.low_pass) ** 2


@dataclass(frozen=True)
class State:
    """A model of the data: effects with columns in order, sensor effects, regressor at the samples, coefficients."""

    terms: tuple[Effect, ...]  # each with a leading axis of places
    sensors: tuple[Effect, ...]
    X: Float[np.ndarray, "nN nv P"]
    prior: Prior
    theta: Float[np.ndarray, " P"]
    motion: Motion  # as measured, with load and total torque of `theta`

    def response(self, omega: Float[Array | np.ndarray, " F"]) -> Complex[Array, " F"]:
        """Response of the torque sensor of all sensor effects together."""
        out = jnp.ones(omega.shape, dtype=complex)
        for effect in self.sensors:
            if kind(effect) == "response":
                out = out * effect.torque_response(jnp.asarray(omega))
        return out


def baseline(problem: Problem, names: Sequence[str], given: Sequence[Effect] = ()) -> State:
    """Rigid body with its prior and the named effects at every joint, then the `given` ones."""
    joints = np.arange(problem.model.nv)[:, None]
    terms = []
    for name in names:
        effect = find(name)
        terms.append(effect(joints, **{p: np.zeros(len(joints)) for p in effect.parameters()}))
    motion = measured_motion(problem.model, problem.records, problem.width)
    rigid, theta, precision = _rigid(problem, motion), *rigid_prior(problem.model, problem.trust)
    state = State((), (), rigid, Prior(theta, precision), theta, motion)
    for term in [*terms, *(batched(effect) for effect in given)]:
        state = with_term(problem, state, term)
    return state


def rigid_prior(model: RobotModel, trust: float) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Nominal inertial parameters and their precision: one sigma is `trust` times m, m L (three times), J (six times).

    L = max(0.05 m, |c|) and J = tr(I)/3 + 0.3 m L^2 give each link its own scale; a massless link gets that of one
    thousandth of the heaviest.
    """
    nominal = np.asarray(model.inertia)
    mass, com, inertia = (np.asarray(part) for part in to_com(nominal))
    floor = 1e-3 * max(float(mass.max(initial=0.0)), 1e-3)
    mass = np.maximum(mass, floor)
    length = np.maximum(0.05, np.linalg.norm(com, axis=1))
    turning = np.trace(inertia, axis1=1, axis2=2) / 3 + 0.3 * mass * length**2
    scale = np.column_stack([mass, *[mass * length] * 3, *[turning] * 6])
    return nominal.reshape(-1), 1 / (trust * scale.reshape(-1)) ** 2


def physical_body(free: Float[np.ndarray, "10"], information: Float[np.ndarray, "10 10"]) -> Float[np.ndarray, "10"]:
    """The ten parameters nearest to `free` (in the metric `information`) that a body of positive mass can have.

    The pseudo-inertia is L L' with L lower triangular (Wensing, Kim, Slotine 2018), L by Levenberg-Marquardt.
    """
    import optimistix  # slow to import

    values, vectors = np.linalg.eigh((information + information.T) / 2)
    root = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
    start = np.diag(np.sqrt(max(float(free[0]), 0.05) * np.array([0.002, 0.002, 0.002, 1.0])))[np.tril_indices(4)]
    solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-10)
    arguments = jnp.asarray(root), jnp.asarray(free)
    found = optimistix.least_squares(_misfit, solver, jnp.asarray(start), arguments, max_steps=200, throw=False)
    return np.asarray(_body(found.value))


def _body(lower: Float[Array, "10"]) -> Float[Array, "10"]:
    """Ten parameters of the pseudo-inertia L L'."""
    L = jnp.zeros((4, 4)).at[np.tril_indices(4)].set(lower)
    return jnp.asarray(from_pseudo_inertia(L @ L.T))


def _misfit(lower: Float[Array, "10"], arguments: tuple[Array, Array]) -> Float[Array, "10"]:
    root, free = arguments
    return root @ (_body(lower) - free)


def body_precision(ten: Float[np.ndarray, "10"]) -> Float[np.ndarray, "10"]:
    """Prior precision of a fitted body about itself: half of its own scale, no arm shorter than 5 cm."""
    mass, com, _ = (np.asarray(part) for part in to_com(ten))
    length = max(0.05, float(np.linalg.norm(com)))
    scale = float(mass) * np.array([1.0, *[length] * 3, *[length**2] * 6])
    return 1 / (0.5 * np.maximum(scale, 1e-6)) ** 2


def batched(effect: Effect) -> Effect:
    """The effect with a leading axis of one place."""
    return jax.tree.map(lambda x: np.asarray(x)[None], effect)


def with_term(problem: Problem, state: State, term: Effect) -> State:
    """The state with one more effect (leading axis of places) whose torque is linear in its amplitudes."""
    own = np.asarray(_term_columns(term, state.motion))
    count = own.shape[-1]
    mean, precision = np.zeros(count), np.full(count, FRICTION_PRECISION)
    if isinstance(term, Payload):
        mean = np.array([float(getattr(term, name)[0]) for name in term.parameters()])
        precision = body_precision(mean)
    prior = Prior(np.append(state.prior.mean, mean), np.append(state.prior.precision, precision))
    X = np.concatenate([state.X, own], axis=2)
    theta = np.append(state.theta, np.zeros(count))
    return replace(state, terms=(*state.terms, term), X=X, prior=prior, theta=theta)


def extended_state(problem: Problem, state: State, effect: Effect) -> State:
    """The state with one more cause of whatever kind."""
    if kind(effect) == "columns":
        return with_term(problem, state, batched(effect))
    grown = replace(state, sensors=(*state.sensors, effect))
    if kind(effect) == "response":
        return grown
    moved = _rigid(problem, link_motion(problem, grown))
    return replace(grown, X=np.concatenate([moved, state.X[:, :, moved.shape[2] :]], axis=2))


def link_motion(problem: Problem, state: State) -> Motion:
    """True motion of the links: as measured, less the errors of the position sensors."""
    motion = state.motion
    for effect in state.sensors:
        if kind(effect) == "position":
            motion = _shifted(effect, motion, problem.records)
    return motion


def solved(problem: Problem, state: State, theta: Float[np.ndarray, " P"]) -> State:
    """The state with coefficients `theta`, and with the load and the torque that follow from them."""
    links = 10 * len(problem.model.joints)
    load = state.X[:, :, :links] @ theta[:links]
    inertia = theta[:links].reshape(-1, 10)
    new = (load, state.X @ theta, inertia)
    motion = eqx.tree_at(lambda m: (m.load, m.total, m.model.inertia), state.motion, new)
    return replace(state, theta=theta, motion=motion)


def whitened(problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"], before: Rows | None = None) -> Rows:
    """Whitened rows of the measured torque and of the state's regressor, with their instruments.

    `before` are the rows of the state that this one extends by columns alone: only the new columns are filtered.
    """
    layout = problem.layout
    y = filtered_rows(problem, problem.records.flat(problem.records.torque), jnp.asarray(whitening))
    known = 0 if before is None else before.X.shape[2]
    response = jnp.asarray(whitening) * state.response(problem.records.omega)[:, None]
    X = _filtered_columns(problem, state.X[:, :, known:], response)
    Xi = X
    if layout.repeats:
        Xi = np.stack([instruments(x.T, layout.partner, p).T for x, p in zip(X, layout.paired, strict=True)])
    if before is not None:
        X, Xi = np.concatenate([before.X, X], axis=2), np.concatenate([before.Xi, Xi], axis=2)
    return Rows(y, np.ascontiguousarray(X), np.ascontiguousarray(Xi), *_row_layout(layout))


def _filtered_columns(
    problem: Problem, X: Float[np.ndarray, "nN nv k"], response: Complex[Array, "F nv"]
) -> Float[np.ndarray, "nv T k"]:
    """Masked rows of columns; their number is padded, so that few programs serve all models."""
    n, samples, _, nv = problem.records.shape
    count = X.shape[2]
    padded = np.pad(X, ((0, 0), (0, 0), (0, -count % COLUMNS))).reshape(n, samples, nv, -1)
    rows = np.asarray(_rows(problem.records, jnp.asarray(padded), response))[..., :count]
    rows = rows * np.asarray(problem.records.weight)[..., None]
    return np.moveaxis(rows.reshape(-1, nv, count), 0, 1)


def plain_rows(problem: Problem, state: State) -> Rows:
    """Rows as they are, N m or N."""
    return whitened(problem, state, np.ones((len(np.asarray(problem.records.omega)), problem.records.shape[3])))


def open_rows(
    problem: Problem, torque: Float[Leaf, "nN nv"], response: Complex[Array, " F"]
) -> Float[np.ndarray, "n M nv"]:
    """Rows of a torque at all samples, of all recordings and without a mask."""
    n, samples, _, nv = problem.records.shape
    factor = jnp.asarray(response)[:, None] + jnp.zeros((1, nv), complex)
    return np.asarray(_rows(problem.records, jnp.asarray(torque).reshape(n, samples, nv), factor))


def filtered_rows(
    problem: Problem, torque: Float[Leaf, "nN nv"], response: Complex[Array, "F nv"]
) -> Float[np.ndarray, "nv T"]:
    """Rows of a torque at all samples through the row filter and `response`, masked."""
    n, samples, _, nv = problem.records.shape
    columns = jnp.asarray(torque).reshape(n, samples, nv)
    rows = np.asarray(_rows(problem.records, columns, response)) * problem.records.weight
    return np.moveaxis(rows.reshape(-1, nv), 0, 1)


def _row_layout(layout: Layout) -> tuple[np.ndarray, ...]:
    return layout.paired, layout.partner, layout.block, layout.fold


@eqx.filter_jit
def measured_motion(model: RobotModel, records: Records, width: Float[Leaf, " nv"]) -> Motion:
    """All samples of all recordings as one motion, with the load of the nominal robot."""
    q, v, a = (records.flat(jnp.asarray(x)) for x in (records.position, records.velocity, records.acceleration))
    load = inverse_dynamics(model, q, v, a)
    return Motion(model, records.flat(jnp.asarray(records.time)), q, v, a, load, load, records.dt, width)


@eqx.filter_jit
def _rows(records: Records, columns: Array, response: Array) -> Array:
    return filter_rows(records, columns, jnp.broadcast_to(response, (records.omega.shape[0], records.shape[3])))


_shifted = eqx.filter_jit(shifted)


@eqx.filter_jit
def _term_columns(term: Effect, motion: Motion) -> Float[Array, "nN nv columns"]:
    columns = jax.vmap(lambda effect: joint_columns(effect, motion))(term)
    return jnp.moveaxis(columns, 0, 2).reshape(*columns.shape[1:3], -1)


def _rigid(problem: Problem, motion: Motion) -> Float[np.ndarray, "nN nv P"]:
    return np.asarray(joint_torque_regressor(problem.model, motion.position, motion.velocity, motion.acceleration))
