"""The current model against the recordings: its raw regressor, its prior, its noise, its whitened rows.

A `Problem` is the data, fixed for a diagnosis. A `State` is a model of it: baseline effects and the causes accepted so
far, with the regressor at every sample. `whitened` gives the rows in which everything is decided.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Complex, Float, Int

from ..effect import Effect, Motion
from ..effects import CATALOGUE, LinkEffect, Payload, find
from ..inertia import to_com
from ..model import Leaf, RobotModel
from ..regressor import joint_torque_regressor
from .design import (
    Units,
    candidates,
    flattened,
    kind,
    rigid_torque,
    sensor_response,
    shapes,
    shifted,
    units,
    units_and_slopes,
)
from .evidence import Prior, Rows, instruments
from .records import Records, filter_rows

__all__ = ["Layout", "Problem", "State", "baseline", "extended_state", "plain_rows", "unit_torques", "whitened"]

FRICTION_PRECISION = 1e-6
BATCH = 4  # effects with a shape in one program


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
        return open_rows(self, self.records.flat(self.records.torque), np.ones(len(self.records.omega)))

    @cached_property
    def gain(self) -> Float[np.ndarray, " F"]:
        """Power gain of the row filter."""
        return np.asarray(self.records.low_pass) ** 2

    @cached_property
    def motion(self) -> Motion:
        """All samples of all recordings as measured, with the load of the nominal robot."""
        r = self.records
        q, v, a = (r.flat(x) for x in (r.position, r.velocity, r.acceleration))
        load = rigid_torque(self.model, q, v, a)
        return Motion(self.model, r.flat(r.time), q, v, a, load, load, r.dt, self.width)

    @cached_property
    def families(self) -> dict[str, dict[str, Effect]]:
        """Candidates of the whole catalogue (leading axes places, grid), by what their torque depends on.

        The equations of a family are one program: `fixed` by the measured motion alone, `shaped` (those that have a
        shape to search too), `following` the current model's torque, `sensor` through the rigid body or the filter.
        """
        out: dict[str, dict[str, Effect]] = {name: {} for name in ("fixed", "shaped", "following", "sensor", "link")}
        for name, effect in CATALOGUE.items():
            batch = candidates(effect, self.model)
            if batch.at.shape[0]:
                out[_family(effect)][name] = batch
        return out

    @cached_property
    def fixed(self) -> dict[str, Units]:
        """Unit torques of the effects that depend on the measured motion alone."""
        return self.family("fixed", self.motion)

    def family(self, name: str, motion: Motion) -> dict[str, Units]:
        """Unit torques of a family, on one axis of places and grid points."""
        return units({n: flattened(b) for n, b in self.families[name].items()}, motion, self.records)


@dataclass(frozen=True)
class State:
    """A model of the data: effects with columns in order, sensor effects, regressor at the samples, coefficients."""

    terms: tuple[Effect, ...]  # each with a leading axis of places
    sensors: tuple[Effect, ...]
    parts: tuple[Float[np.ndarray, "nN nv k"], ...]  # regressor: the rigid body's columns, then those of each term
    prior: Prior
    theta: Float[np.ndarray, " P"]
    measured: Motion  # as measured, with the nominal robot's load

    @cached_property
    def motion(self) -> Motion:
        """The motion as measured, with load, total torque and inertia of `theta`."""
        load, *others = self.shares(self.theta)
        new = (load, sum(others, load), self.theta[: self.rigid.shape[2]].reshape(-1, 10))
        return eqx.tree_at(lambda m: (m.load, m.total, m.model.inertia), self.measured, new)

    @property
    def rigid(self) -> Float[np.ndarray, "nN nv columns"]:
        """Regressor of the rigid body."""
        return self.parts[0]

    def columns(self, first: int = 0) -> Float[np.ndarray, "nN nv k"]:
        """Columns of the regressor from one on."""
        starts = np.cumsum([0, *(part.shape[2] for part in self.parts)])
        kept = [part[:, :, max(first - start, 0) :] for part, start in zip(self.parts, starts, strict=False)]
        return np.concatenate([part for part in kept if part.shape[2]] or [self.rigid[:, :, :0]], axis=2)

    def torque(self, theta: Float[np.ndarray, " P"]) -> Float[np.ndarray, "nN nv"]:
        """Torque at the samples with the coefficients `theta`, N m or N."""
        return sum(self.shares(theta), np.zeros(self.rigid.shape[:2]))

    def shares(self, theta: Float[np.ndarray, " P"]) -> Iterator[Float[np.ndarray, "nN nv"]]:
        """Torque of the rigid body, then of each term."""
        split = np.split(theta, np.cumsum([part.shape[2] for part in self.parts])[:-1])
        for part, own in zip(self.parts, split, strict=True):
            yield (part.reshape(-1, part.shape[2]) @ own).reshape(self.rigid.shape[:2])

    def response(self, omega: Float[Leaf, " F"]) -> Complex[np.ndarray, " F"] | Float[np.ndarray, " F"]:
        """Response of the torque sensor of all sensor effects together."""
        out = np.ones(np.shape(omega))
        for effect in self.sensors:
            if kind(effect) == "response":
                out = out * sensor_response({effect.name: batched(effect)}, np.asarray(omega))[effect.name][0]
        return out


def baseline(problem: Problem, names: Sequence[str], given: Sequence[Effect] = ()) -> State:
    """Rigid body with its prior and the named effects at every joint, then the `given` ones."""
    joints = np.arange(problem.model.nv)[:, None]
    terms = []
    for name in names:
        effect = find(name)
        terms.append(effect(joints, **{p: np.zeros(len(joints)) for p in effect.parameters()}))
    rigid, theta, precision = _rigid(problem, problem.motion), *rigid_prior(problem.model, problem.trust)
    state = State((), (), (rigid,), Prior(theta, precision), theta, problem.motion)
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
    from scipy.optimize import least_squares  # slow to import

    values, vectors = np.linalg.eigh((information + information.T) / 2)
    root = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
    lower = np.tril_indices(4)
    start = np.diag(np.sqrt(max(float(free[0]), 0.05) * np.array([0.002, 0.002, 0.002, 1.0])))[lower]
    basis = np.zeros((10, 4, 4))
    basis[(np.arange(10), *lower)] = 1.0

    def misfit(x: Float[np.ndarray, "10"]) -> Float[np.ndarray, "10"]:
        L = np.tensordot(x, basis, 1)
        return root @ (_ten(L @ L.T) - free)

    def slope(x: Float[np.ndarray, "10"]) -> Float[np.ndarray, "10 10"]:
        half = basis @ np.tensordot(x, basis, 1).T
        return root @ _ten(half + np.swapaxes(half, 1, 2)).T

    options = {"method": "lm", "ftol": 1e-10, "xtol": 1e-10}
    L = np.tensordot(least_squares(misfit, start, slope, **options).x, basis, 1)  # pyright: ignore[reportArgumentType]
    return _ten(L @ L.T)


def _ten(P: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 10"]:
    """Ten parameters of pseudo-inertias [[S, h], [h', m]]: the inertia is tr(S) 1 - S."""
    trace = np.trace(P[..., :3, :3], axis1=-2, axis2=-1)
    (xx, yy, zz), (xy, xz, yz) = ((P[..., i, i] for i in range(3)), (P[..., i, j] for i, j in ((0, 1), (0, 2), (1, 2))))
    h = (P[..., k, 3] for k in range(3))
    return np.stack([P[..., 3, 3], *h, trace - xx, -xy, trace - yy, -xz, -yz, trace - zz], axis=-1)


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
    own = _term_columns(problem, state, term)
    count = own.shape[-1]
    mean, precision = np.zeros(count), np.full(count, FRICTION_PRECISION)
    if isinstance(term, Payload):
        mean = np.array([float(getattr(term, name)[0]) for name in term.parameters()])
        precision = body_precision(mean)
    prior = Prior(np.append(state.prior.mean, mean), np.append(state.prior.precision, precision))
    theta = np.append(state.theta, np.zeros(count))
    return replace(state, terms=(*state.terms, term), parts=(*state.parts, own), prior=prior, theta=theta)


def extended_state(problem: Problem, state: State, effect: Effect) -> State:
    """The state with one more cause of whatever kind."""
    if kind(effect) == "columns":
        return with_term(problem, state, batched(effect))
    grown = replace(state, sensors=(*state.sensors, effect))
    if kind(effect) == "response":
        return grown
    moved = _rigid(problem, link_motion(problem, grown))
    return replace(grown, parts=(moved, *state.parts[1:]))


def link_motion(problem: Problem, state: State) -> Motion:
    """True motion of the links: as measured, less the errors of the position sensors."""
    motion = state.motion
    for effect in state.sensors:
        if kind(effect) == "position":
            moved = shifted(batched(effect), motion, problem.records)
            first = (moved.position[0], moved.velocity[0], moved.acceleration[0])
            motion = eqx.tree_at(lambda m: (m.position, m.velocity, m.acceleration), moved, first)
    return motion


def solved(problem: Problem, state: State, theta: Float[np.ndarray, " P"]) -> State:
    """The state with coefficients `theta`, from which its load and its torque follow."""
    return replace(state, theta=theta)


def unit_torques(problem: Problem, state: State, term: Effect) -> Units:
    """What a unit of each amplitude of a term (one leading axis) adds in the state, N m or N."""
    if isinstance(term, LinkEffect):
        links = np.asarray(term.at)[:, 0]
        torque = np.stack([state.rigid[:, :, 10 * k : 10 * k + 10].transpose(2, 1, 0) for k in links])
        return Units(torque, np.tile(np.arange(problem.model.nv), (len(links), 1)))
    family = _family(type(term))
    if family == "shaped":
        return _shaped_units(term, state.motion)
    if family in ("fixed", "following"):
        place = _places_in(problem.families[family].get(term.name), term)
        if place is not None:
            known = problem.fixed if family == "fixed" else problem.family(family, state.motion)
            return Units(known[term.name].torque[place], known[term.name].joints[place])
    return units({term.name: term}, state.motion, problem.records)[term.name]


def _family(effect: type[Effect]) -> str:
    if issubclass(effect, LinkEffect):
        return "link"
    if kind(effect) != "columns" or (effect.has("change") and not effect.has("torque")):
        return "sensor"
    if effect.follows_torque:
        return "following"
    return "shaped" if shapes(effect) else "fixed"


def _places_in(batch: Effect | None, term: Effect) -> Int[np.ndarray, " places"] | None:
    """Where the effects of a term stand among the candidates; nothing where one of them is no candidate."""
    if batch is None:
        return None
    flat, same = flattened(batch), []
    for at, *values in zip(np.asarray(term.at), *(np.asarray(getattr(term, n)) for n in _choices(term)), strict=True):
        alike = (np.asarray(flat.at) == at).all(1)
        for name, value in zip(_choices(term), values, strict=True):
            alike &= np.asarray(getattr(flat, name)) == value
        same.append(np.flatnonzero(alike))
    return np.array([place[0] for place in same]) if all(len(place) for place in same) else None


def _choices(effect: Effect) -> list[str]:
    return [name for name, p in effect.parameters().items() if not p.linear]


def _shaped_units(term: Effect, motion: Motion) -> Units:
    """By the program of the refits: filled up to its batch."""
    count, torques = len(term.at), []
    for start in range(0, count, BATCH):
        some = np.resize(np.arange(start, min(start + BATCH, count)), BATCH)
        part = jax.tree.map(lambda x, i=some: np.asarray(x)[i], term)
        values = np.stack([getattr(part, name) for name in shapes(type(term))], axis=1)
        torques.append(units_and_slopes(part, values, motion)[0])
    everywhere = np.tile(np.arange(np.shape(motion.velocity)[1]), (count, 1))
    joints = np.asarray(term.at) if term.acts_on in ("joint", "pair") else everywhere
    return Units(np.concatenate(torques)[:count], joints)


def _term_columns(problem: Problem, state: State, term: Effect) -> Float[np.ndarray, "nN nv columns"]:
    given = unit_torques(problem, state, term)
    columns = np.zeros((problem.model.nv, *given.torque.shape[:2], given.torque.shape[3]))
    for one, joints in enumerate(given.joints):
        np.add.at(columns[:, one], joints, np.swapaxes(given.torque[one], 0, 1))
    return np.ascontiguousarray(np.moveaxis(columns.reshape(problem.model.nv, -1, columns.shape[-1]), 2, 0))


def whitened(problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"], before: Rows | None = None) -> Rows:
    """Whitened rows of the measured torque and of the state's regressor, with their instruments.

    `before` are the rows of the state that this one extends by columns alone: only the new columns are filtered.
    """
    layout = problem.layout
    torque = problem.records.flat(problem.records.torque)
    y = filtered_rows(problem, torque, whitening) if before is None else before.y
    known = 0 if before is None else before.X.shape[2]
    response = whitening * state.response(problem.records.omega)[:, None]
    X = _filtered_columns(problem, state.columns(known), response)
    Xi = X
    if layout.repeats:
        Xi = np.stack([instruments(x.T, layout.partner, p).T for x, p in zip(X, layout.paired, strict=True)])
    if before is not None:
        X, Xi = np.concatenate([before.X, X], axis=2), np.concatenate([before.Xi, Xi], axis=2)
    return Rows(y, np.ascontiguousarray(X), np.ascontiguousarray(Xi), *_row_layout(layout))


def _filtered_columns(
    problem: Problem, X: Float[np.ndarray, "nN nv k"], response: Complex[np.ndarray, "F nv"]
) -> Float[np.ndarray, "nv T k"]:
    """Masked rows of columns, of which a tree leaves many zero."""
    n, samples, count, nv = problem.records.shape
    torque = np.ascontiguousarray(np.moveaxis(X, 0, 2)).reshape(-1, n, samples)
    joints = np.repeat(np.arange(nv), X.shape[2])
    used = torque.any(axis=(1, 2))
    rows = np.zeros((len(torque), n, count))
    rows[used] = filter_rows(problem.records, torque[used], response.T[joints[used]])
    rows = rows.reshape(nv, -1, n, count) * np.moveaxis(problem.records.weight, 2, 0)[:, None]
    return np.ascontiguousarray(np.swapaxes(rows.reshape(nv, -1, n * count), 1, 2))


def plain_rows(problem: Problem, state: State) -> Rows:
    """Rows as they are, N m or N."""
    return whitened(problem, state, np.ones((len(problem.records.omega), problem.records.shape[3])))


def open_rows(
    problem: Problem, torque: Float[np.ndarray, "nN nv"], response: Complex[np.ndarray, " F"]
) -> Float[np.ndarray, "n M nv"]:
    """Rows of a torque at all samples, of all recordings and without a mask."""
    n, samples, _, nv = problem.records.shape
    return np.moveaxis(filter_rows(problem.records, torque.T.reshape(nv, n, samples), response), 0, 2)


def filtered_rows(
    problem: Problem, torque: Float[np.ndarray, "nN nv"], response: Complex[np.ndarray, "F nv"]
) -> Float[np.ndarray, "nv T"]:
    """Rows of a torque at all samples through the row filter and `response`, masked."""
    n, samples, _, nv = problem.records.shape
    rows = filter_rows(problem.records, torque.T.reshape(nv, n, samples), response.T)
    return (rows * np.moveaxis(problem.records.weight, 2, 0)).reshape(nv, -1)


def _row_layout(layout: Layout) -> tuple[np.ndarray, ...]:
    return layout.paired, layout.partner, layout.block, layout.fold


def _rigid(problem: Problem, motion: Motion) -> Float[np.ndarray, "nN nv P"]:
    return np.asarray(joint_torque_regressor(problem.model, motion.position, motion.velocity, motion.acceleration))
