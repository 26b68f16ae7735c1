"""A model of the recordings: baseline effects and the causes accepted so far, with its regressor at every sample.

`whitened` gives the rows in which everything is decided.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Complex, Float, Int

from ..effects.base import Effect, Motion, changed, place
from ..effects.catalogue import find
from ..errors import InputError
from ..estimation.joint_rows import JointRows
from ..estimation.priors import body_precision, rigid_prior
from ..estimation.rows import Prior, Rows, instruments
from ..recordings.stacked import filtered_rows
from ..rigid.model import Leaf, RobotModel, dofs
from ..simulators.native import NativeBackend
from .design import Units, batch_size, flattened, kind, local, sensor_response, shapes, units, units_and_slopes
from .problem import Layout, Part, Problem, family_of
from .shifts import shifted

if TYPE_CHECKING:
    from ..formats.config import Baseline

__all__ = [
    "State",
    "assembled",
    "baseline",
    "batched",
    "extended_state",
    "link_motion",
    "on_motion",
    "plain_rows",
    "solved",
    "stated_effects",
    "unit_slopes",
    "unit_torques",
    "whitened",
    "with_size",
    "with_term",
]

FREE = 0.0, 1e3  # value and deviation before any data, N m: an amplitude is as good as free
FRICTION_PRECISION = FREE[1] ** -2  # 1/(N m)^2


class Cut(NamedTuple):
    """What drives at their limit make of the torque, to first order about the one that they were to give."""

    through: Float[np.ndarray, "nN nv"]  # of a change of that torque
    torque: Float[np.ndarray, "nN nv"]  # of that torque, what no change moves, N m or N


@dataclass(frozen=True)
class State:
    """A model of the data: effects with columns in order, sensor effects, regressor at the samples, coefficients."""

    terms: tuple[Effect, ...]  # each with a leading axis of places
    sensors: tuple[Effect, ...]
    parts: tuple[Part, ...]  # regressor: the rigid body's columns, then those of each term
    prior: Prior
    theta: Float[np.ndarray, " P"]
    measured: Motion  # as measured, with the nominal robot's load
    carried: Float[np.ndarray, "n links 10"] | None = None  # known bodies on the links of each recording
    cut: Cut | None = None

    @cached_property
    def motion(self) -> Motion:
        """The motion as measured, with load, total torque and inertia of `theta`."""
        load = self._load(self.theta)
        model = changed(self.measured.model, inertia=self.theta[: self.rigid.width].reshape(-1, 10))
        return changed(self.measured, load=load, total=self._total(load, self.theta), model=model)

    @property
    def rigid(self) -> Part:
        """Regressor of the rigid body."""
        return self.parts[0]

    @cached_property
    def known(self) -> Float[np.ndarray, "nN nv"]:
        """Torque that no coefficient moves, N m or N: of what recordings carry, and of drives at their limit."""
        return self._carried if self.cut is None else self.cut.through * self._carried + self.cut.torque

    @cached_property
    def _carried(self) -> Float[np.ndarray, "nN nv"]:
        """Torque of what each recording is known to carry, N m or N."""
        if self.carried is None:
            return np.zeros((self.rigid.samples, self.rigid.nv))
        count = self.rigid.samples // len(self.carried)
        each = [slice(k * count, (k + 1) * count) for k in range(len(self.carried))]
        torques = [self.rigid.torque(ten.reshape(-1), rows) for ten, rows in zip(self.carried, each, strict=True)]
        return np.concatenate(torques)

    def torque(self, theta: Float[np.ndarray, " P"], rows: slice = slice(None)) -> Float[np.ndarray, "rows nv"]:
        """Torque at some samples with the coefficients `theta`, N m or N."""
        return self._total(self._load(theta, rows), theta, rows)

    def _load(self, theta: Float[np.ndarray, " P"], rows: slice = slice(None)) -> Float[np.ndarray, "rows nv"]:
        """Torque of the rigid body with what it carries."""
        torque = self.rigid.torque(theta[: self.rigid.width], rows)
        return torque if self.carried is None else torque + self._carried[rows]

    def _total(
        self, load: Float[np.ndarray, "rows nv"], theta: Float[np.ndarray, " P"], rows: slice = slice(None)
    ) -> Float[np.ndarray, "rows nv"]:
        """The load with the torque of each term; what cuts it comes last."""
        terms = np.zeros(load.shape[::-1]).T  # a joint's samples follow one another
        cutting = []
        for term, part, own in zip(self.terms, self.parts[1:], self._of_terms(theta), strict=True):
            if self.cut is not None and term.has("through"):
                cutting.append((part, own))
            else:
                part.add(own, terms, rows)
        total = np.add(load, terms, order="C")
        if self.cut is not None:
            total = self.cut.through[rows] * total + self.cut.torque[rows]
        for part, own in cutting:
            part.add(own, total, rows)
        return total

    def _of_terms(self, theta: Float[np.ndarray, " P"]) -> list[Float[np.ndarray, " k"]]:
        """The coefficients of each term."""
        return np.split(theta, np.cumsum([part.width for part in self.parts])[:-1])[1:]

    def shares(self, theta: Float[np.ndarray, " P"]) -> Iterator[Float[np.ndarray, "nN nv"]]:
        """Torque of each term."""
        for part, own in zip(self.parts[1:], self._of_terms(theta), strict=True):
            yield part.torque(own)

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
    state = State((), (), (rigid,), Prior(theta, precision), theta, problem.motion, problem.records.carried)
    for term in [*terms, *(batched(effect) for effect in given)]:
        state = with_term(problem, state, term)
    return state


def batched(effect: Effect) -> Effect:
    """The effect with a leading axis of one place."""
    return jax.tree.map(lambda x: np.asarray(x)[None], effect)


def with_term(problem: Problem, state: State, term: Effect) -> State:
    """The state with one more effect (leading axis of places) whose torque is linear in its amplitudes."""
    own = _term_columns(problem, state, term)
    count = own.width
    known = [parameter.expected or FREE for parameter in term.parameters().values() if parameter.linear]
    mean, deviation = np.resize(known or FREE, (count, 2)).T
    precision = deviation**-2.0
    if term.body:
        mean = np.array([float(getattr(term, name)[0]) for name in term.parameters()])
        precision = body_precision(mean)
    prior = Prior(np.append(state.prior.mean, mean), np.append(state.prior.precision, precision))
    theta = np.append(state.theta, np.zeros(count))
    grown = replace(state, terms=(*state.terms, term), parts=(*state.parts, own), prior=prior, theta=theta)
    return replace(grown, cut=_cut_by(state, term))


def _cut_by(state: State, term: Effect) -> Cut | None:
    """What the drives of a state make of the torque once a term is in."""
    if not term.has("through"):
        return state.cut
    total = state.motion.total
    through, torque = (np.ones_like(total), np.zeros_like(total)) if state.cut is None else map(np.copy, state.cut)
    for k, joint in enumerate(np.asarray(term.at)[:, 0].tolist()):
        one = jax.tree.map(lambda x, k=k: np.asarray(x)[k], term)
        through[:, joint] = one.through(state.motion)
        torque[:, joint] = (1 - through[:, joint]) * total[:, joint]
    return Cut(through, torque)


def extended_state(problem: Problem, state: State, effect: Effect) -> State:
    """The state with one more cause of whatever kind."""
    if kind(effect) == "columns":
        return with_term(problem, state, batched(effect))
    grown = replace(state, sensors=(*state.sensors, effect))
    if kind(effect) == "response":
        return grown
    moved = _rigid(problem, link_motion(problem, grown))
    return replace(grown, parts=(moved, *state.parts[1:]))


def stated_effects(model: RobotModel, known: Baseline | None) -> tuple[list[str], list[Effect]]:
    """Names of the effects that every joint has in the baseline, and the ones that stand at given joints."""
    if known is None:
        return ["viscous_friction", "coulomb_friction"], []
    given = []
    for entry in known.effects:
        effect = find(entry.effect)
        if not effect.amplitudes():
            raise InputError(f"baseline.effects: '{entry.effect}' cannot be fitted as part of the baseline")
        given.append(place(effect, model, entry.at))
    return known.everywhere(), given


def assembled(
    problem: Problem,
    start: State,
    causes: Sequence[Effect],
    grow: Callable[[State, Sequence[Effect]], State] | None = None,
) -> State:
    """The state with all causes at their sizes, in their order; `grow` adds the last of the causes so far, if not
    `with_size`.

    A cause that follows all torque together is evaluated behind the others, whatever its place among them.
    """
    order = sorted(range(len(causes)), key=lambda k: type(causes[k]).follows_total)
    state, ordered = start, [causes[k] for k in order]
    for count, effect in enumerate(ordered, 1):
        state = grow(state, ordered[:count]) if grow else with_size(problem, state, effect)
    return _rearranged(state, [k for k in order if kind(causes[k]) == "columns"])


def with_size(problem: Problem, state: State, effect: Effect) -> State:
    """The state with one more cause at its size."""
    linear = effect.amplitudes() if kind(effect) == "columns" else []
    theta = np.append(state.theta, [float(getattr(effect, n)) for n in linear])
    return solved(extended_state(problem, state, effect), theta)


def _rearranged(state: State, order: list[int]) -> State:
    """The state with its last terms, which stand in `order`, sorted."""
    if order == sorted(order):
        return state
    first, sorting = len(state.terms) - len(order), np.argsort(order)
    places = np.split(np.arange(len(state.theta)), np.cumsum([part.width for part in state.parts])[:-1])
    moved = [*range(first), *(first + sorting)]
    at = np.concatenate([places[0], *(places[1 + k] for k in moved)])
    return replace(
        state,
        terms=tuple(state.terms[k] for k in moved),
        parts=(state.rigid, *(state.parts[1 + k] for k in moved)),
        prior=Prior(state.prior.mean[at], state.prior.precision[at]),
        theta=state.theta[at],
    )


def on_motion(problem: Problem, state: State) -> State:
    """The state, its coefficients as they are, along the motion of another problem."""
    rigid = _rigid(problem, problem.motion)
    first = State((), state.sensors, (rigid,), state.prior, state.theta[: rigid.width], problem.motion)
    here = replace(first, carried=problem.records.carried)
    if any(kind(effect) == "position" for effect in state.sensors):
        here = replace(here, parts=(_rigid(problem, link_motion(problem, here)),))
    for term in state.terms:
        own = _term_columns(problem, here, term)
        theta = state.theta[: len(here.theta) + own.width]
        cut = _cut_by(here, term)
        here = replace(here, terms=(*here.terms, term), parts=(*here.parts, own), theta=theta, cut=cut)
    return here


def with_width(problem: Problem, state: State) -> State:
    """The state in a problem whose friction reverses over another width: its columns are evaluated anew."""
    if state.measured is problem.motion:
        return state
    moved = replace(state, measured=problem.motion)
    pairs = list(zip(state.terms, state.parts[1:], strict=True))
    same = [term.follows_total or not term.reverses for term in state.terms]
    parts = [p if own else _term_columns(problem, moved, term) for (term, p), own in zip(pairs, same, strict=True)]
    moved = replace(moved, parts=(state.rigid, *parts))
    if not any(term.follows_total for term in state.terms):
        return moved
    others = [
        np.zeros(part.width) if t.follows_total else own
        for (t, part), own in zip(pairs, moved._of_terms(state.theta), strict=True)
    ]
    alone = replace(moved, theta=np.concatenate([state.theta[: state.rigid.width], *others]), cut=None)
    parts, cut = [], None
    for term, own in zip(state.terms, moved.parts[1:], strict=True):
        cut = _cut_by(replace(alone, cut=cut), term) if term.follows_total else cut
        parts.append(_term_columns(problem, alone, term) if term.follows_total else own)
    return replace(moved, parts=(state.rigid, *parts), cut=cut)


def link_motion(problem: Problem, state: State) -> Motion:
    """True motion of the links: as measured, less the errors of the position sensors."""
    motion = state.motion
    for effect in state.sensors:
        if kind(effect) == "position":
            moved = shifted(batched(effect), motion, problem.records)
            position, velocity, acceleration = moved.position[0], moved.velocity[0], moved.acceleration[0]
            motion = changed(moved, position=position, velocity=velocity, acceleration=acceleration)
    return motion


def solved(state: State, theta: Float[np.ndarray, " P"]) -> State:
    """The state with coefficients `theta`, from which its load and its torque follow."""
    return replace(state, theta=theta)


def unit_torques(problem: Problem, state: State, term: Effect) -> Units:
    """What a unit of each amplitude of a term (one leading axis) adds in the state, N m or N."""
    if term.inertial:
        links = np.asarray(term.at)[:, 0]
        torque = np.stack([state.rigid.dense(range(10 * k, 10 * k + 10)) for k in links])
        return Units(torque, np.tile(np.arange(problem.model.nv), (len(links), 1)))
    family = family_of(type(term))
    if family == "shaped":
        return _shaped_units(problem, term, state.measured)  # its torque does not follow the model's
    if family in ("fixed", "following"):
        place = _places_in(problem.families[family].get(term.name), term)
        if place is not None:
            fixed = family == "fixed"
            known = problem.fixed[term.name] if fixed else problem.following(term.name, state.motion)
            return Units(known.torque[place], known.joints[place])
    return units({term.name: term}, state.motion, problem.records)[term.name]


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


def _shaped_units(problem: Problem, term: Effect, motion: Motion) -> Units:
    """By the program of the refits, whose slopes a fit of all causes asks for next."""
    torque, slopes = shaped_units(term, motion)
    if len(torque) == 1:
        problem.kept((unit_slopes, *_identity(term)), motion, slopes[0].copy)
    everywhere = np.tile(np.arange(np.shape(motion.velocity)[1]), (len(torque), 1))
    return Units(torque, np.asarray(term.at) if local(term) else everywhere)


def shaped_units(
    term: Effect, motion: Motion
) -> tuple[Float[np.ndarray, "effects k rows nN"], Float[np.ndarray, "effects p k rows nN"]]:
    """`units_and_slopes` at the effects' own shapes, filled up to the batch of the refits."""
    count, found, size = len(term.at), [], batch_size(term)
    for start in range(0, count, size):
        some = np.resize(np.arange(start, min(start + size, count)), size)
        part = jax.tree.map(lambda x, i=some: np.asarray(x)[i], term)
        values = np.stack([getattr(part, name) for name in shapes(type(term))], axis=1)
        found.append(units_and_slopes(part, values, motion))
    torque, slope = (np.concatenate(x)[:count] for x in zip(*found, strict=True))
    return torque, slope


def unit_slopes(problem: Problem, state: State, effect: Effect, motion: Motion) -> Float[np.ndarray, "p k rows nN"]:
    """Derivatives of the unit torques of one effect in its shapes, `motion` being what it follows."""
    term = batched(effect)
    if effect.follows_torque:
        return shaped_units(term, motion)[1][0]
    return problem.kept(
        (unit_slopes, *_identity(term)), state.measured, lambda: shaped_units(term, motion)[1][0].copy()
    )


def _identity(term: Effect) -> tuple[Any, ...]:
    """What tells the columns of a term from those of others, the motion being the same."""
    return type(term), *((name, np.asarray(getattr(term, name)).tobytes()) for name in ("at", *_choices(term)))


def _term_columns(problem: Problem, state: State, term: Effect) -> Part:
    if family_of(type(term)) in ("fixed", "shaped"):
        return problem.kept(_identity(term), state.measured, lambda: _columns(problem, state, term))
    return _columns(problem, state, term)


def _columns(problem: Problem, state: State, term: Effect) -> Part:
    given = unit_torques(problem, state, term)
    places, count, rows, samples = given.torque.shape
    joint = np.broadcast_to(given.joints[:, None], (places, count, rows)).reshape(-1)
    column = np.repeat(np.arange(places * count), rows)
    shape = problem.model.nv, places * count
    return Part.of_series(given.torque.reshape(-1, samples), joint, column, shape)


def _rigid(problem: Problem, motion: Motion) -> Part:
    state = [np.asarray(x) for x in (motion.position, motion.velocity, motion.acceleration)]
    separate = len(dofs(problem.model.joints).column) == problem.model.nv  # no two joints share a coordinate
    if isinstance(problem.backend, NativeBackend) and separate:
        return Part.of_rigid(problem.model, state)
    return Part.of_samples(np.asarray(problem.backend.joint_torque_regressor(*state)))


def whitened(problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"]) -> Rows:
    """Whitened rows of the measured torque and of the state's regressor, with their instruments."""
    layout = problem.layout
    response = whitening * state.response(problem.records.omega)[:, None]
    y = _unexplained(problem, state, whitening, response)
    X = problem.filtered.rows(problem.records, state.parts, response)
    X = X if state.cut is None else _cut_rows(problem, state, X, response)
    Xi = X
    if layout.repeats:
        pairs = zip(X.own, layout.paired, strict=True)
        each = [(instruments(own.columns.T, layout.partner, p).T, own.place) for own, p in pairs]
        Xi = JointRows([(np.ascontiguousarray(columns), place) for columns, place in each], X.width)
    return Rows(y, X, Xi, *_row_layout(layout))


def _cut_rows(problem: Problem, state: State, X: JointRows, response: Complex[np.ndarray, "F nv"]) -> JointRows:
    """The rows with those of the joints whose drives are at their limit at times as these let them through."""
    assert state.cut is not None
    through = state.cut.through
    for joint in np.flatnonzero((through != 1).any(0)).tolist():
        factor = through[:, joint]
        whole = [False, *(term.has("through") for term in state.terms)]
        parts = [p.times(np.ones_like(factor) if w else factor, joint) for w, p in zip(whole, state.parts, strict=True)]
        X = X.replaced(joint, problem.filtered.rows(problem.records, parts, response))
    return X


def plain_rows(problem: Problem, state: State) -> Rows:
    """Rows as they are, N m or N."""
    return whitened(problem, state, np.ones((len(problem.records.omega), problem.records.shape[3])))


def _unexplained(
    problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"], response: Complex[np.ndarray, "F nv"]
) -> Float[np.ndarray, "nv T"]:
    """Rows of the measured torque, less what the sensors read of a known one."""
    rows = problem.filtered.rows(problem.records, [problem.read], whitening).dense()[..., 0]
    if state.carried is None and state.cut is None:
        return rows
    return rows - filtered_rows(problem.records, state.known, response)


def _row_layout(layout: Layout) -> tuple[np.ndarray, ...]:
    return layout.paired, layout.partner, layout.block, layout.fold
