"""Many robots of one structure, screened together for every single cause: which robot has what the others lack.

Each robot's base parameters are identified from its own recording; then each effect of the catalogue, at each place and
grid point, is set beside them, and how much of the robot's residual it takes is told. What all robots show alike (noise
that is not white, a law that the whole series has) is the population's; a robot is flagged by what it shows beside the
others. `diagnose` is for those that are flagged: it tells causes from each other on data held out, which this does not.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from functools import partial
from math import prod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compiled.batching import program
from ..effects.base import Effect, Motion, columns
from ..effects.catalogue import CATALOGUE
from ..errors import InputError, check_positive, nearest
from ..estimation.accelerators import BatchFit, conditioned_rows, coordinates, fit_states
from ..estimation.fleets import AT_ONCE, Fleet, check_fleet, fleet_of, own_arrays
from ..estimation.states import States
from ..results import Name
from ..rigid.dynamics import inverse_dynamics
from ..rigid.model import RobotModel
from .design import candidates, kind
from .screening import place_names

__all__ = ["CauseInFleet", "FleetScreen", "Flag", "screen_fleet"]

UNLIKE = 1e-6  # share of a candidate's columns that the fit must leave, for it to be something else than the baseline
SURELY = 5.0  # deviations beyond the other robots


class CauseInFleet(NamedTuple):
    """One effect at one place: in each robot how much it shows, and its parameters at the shape that fits all best."""

    name: Name
    score: Float[np.ndarray, " robots"]  # root of what it takes of the residual's squares, each 1 for white noise
    parameters: tuple[str, ...]
    values: Float[np.ndarray, "robots parameters"]  # in the units of `Effect.parameters`
    std: Float[np.ndarray, "robots parameters"]  # for white residuals
    shape: dict[str, float]

    @property
    def mean(self) -> Float[np.ndarray, " parameters"]:
        """Of the population."""
        return self.values.mean(axis=0)

    @property
    def spread(self) -> Float[np.ndarray, " parameters"]:
        """Of the robots, without what noise adds to it."""
        if len(self.values) < 2:
            return np.zeros(self.values.shape[1])
        return np.sqrt(np.maximum(self.values.var(axis=0, ddof=1) - (self.std**2).mean(axis=0), 0.0))

    def beyond(self) -> Float[np.ndarray, " robots"]:
        """Each robot's score beyond the median of all, in deviations: of the robots, and at least of white noise."""
        away = self.score - np.median(self.score)
        return away / max(1.0, np.median(np.abs(away)) / 0.6745)


class Flag(NamedTuple):
    """A robot that shows what the others do not, the cause that shows most, and how far beyond the others."""

    robot: int
    cause: Name
    beyond: float


class FleetScreen(NamedTuple):
    """What identification says of the fleet, and of every cause."""

    fleet: Fleet
    causes: tuple[CauseInFleet, ...]

    def unusual(self, sigmas: float = SURELY) -> Bool[np.ndarray, "robots causes"]:
        """Which robots show which cause so far beyond the others."""
        beyond = [cause.beyond() > sigmas for cause in self.causes]
        return np.stack(beyond, axis=1) if beyond else np.zeros((len(self.fleet.rms), 0), bool)

    def flagged(self, sigmas: float = SURELY) -> list[Flag]:
        """The robots that stand out, the furthest first, each with the cause that shows most in it: a first guess."""
        beyond = np.array([cause.beyond() for cause in self.causes]).reshape(len(self.causes), len(self.fleet.rms))
        found = [
            Flag(robot, self.causes[int(own.argmax())].name, float(own.max()))
            for robot, own in enumerate(beyond.T)
            if len(own) and own.max() > sigmas
        ]
        return sorted(found, key=lambda flag: -flag.beyond)

    def common(self, least: float = SURELY) -> list[CauseInFleet]:
        """Causes that most robots show, the surest first: what the model of the whole series lacks."""
        found = [cause for cause in self.causes if np.median(cause.score) > least]
        return sorted(found, key=lambda cause: -float(np.median(cause.score)))


def screen_fleet(
    robots: Sequence[RobotModel],
    terms: tuple[Effect, ...],
    q: Float[Any, "robots samples nq"],
    v: Float[Any, "robots samples nv"],
    a: Float[Any, "robots samples nv"],
    tau: Float[Any, "robots samples nv"],
    dt: float,
    effects: Collection[str] | None = None,
) -> FleetScreen:
    """Every single cause at every place in each robot, beside `identify_fleet` of the same arrays, robots side by side.

    Recordings are equally long, evenly sampled with the period `dt` (s). `effects` are names of the catalogue: where
    they are left out, all whose torque is linear in a parameter and that act on joints, on pairs or on the whole robot;
    what links carry stands in `FleetScreen.fleet`. An effect of a position sensor enters to first order, a delayed
    torque as its derivative. Raises `InputError` where robots, arrays or names do not fit.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot, t = fj.load_urdf(fj.DEMO), np.arange(400)[:, None] * 0.01
    >>> w = np.random.default_rng(0).uniform(1, 4, (3, 1, robot.nv))
    >>> q, v, a = np.sin(w * t), w * np.cos(w * t), -(w**2) * np.sin(w * t)
    >>> tau = np.stack([fj.inverse_dynamics(robot, *state) for state in zip(q, v, a)])
    >>> tau = tau + 0.01 * np.random.default_rng(1).normal(size=tau.shape)
    >>> tau[1, :, 0] += 0.5 * np.abs(v[1, :, 0])
    >>> found = fj.screen_fleet([robot] * 3, (), q, v, a, tau, 0.01, ["asymmetric_viscous_friction"])
    >>> [(flag.robot, str(flag.cause.effect)) for flag in found.flagged()]
    [(1, 'asymmetric_viscous_friction')]
    """
    check_fleet(robots, q, v, a, tau)
    check_positive("dt", dt, "s, the sampling period,")
    first, present = robots[0], {term.name for term in terms}
    unknown = [name for name in effects or () if name not in CATALOGUE]
    if unknown:
        raise InputError(f"no effect '{unknown[0]}' in the catalogue{nearest(unknown[0], CATALOGUE)}")
    wanted = [name for name in (CATALOGUE if effects is None else effects) if name not in present]
    batches = {name: candidates(CATALOGUE[name], first) for name in wanted if _can_be_screened(CATALOGUE[name])}
    batches = {name: batch for name, batch in batches.items() if len(batch.at)}
    rows = States(first, lambda: [], terms)
    into = coordinates(rows.structure, rows.structural).into
    numbers = first.nv * (2 * sum(into.shape) + 1) + max((_numbers(b, first.nv) for b in batches.values()), default=0)
    with jax.enable_x64(True):
        own = jax.tree.map(lambda *x: np.stack(x).astype(float), *[own_arrays(robot) for robot in robots])
        state = tuple(np.asarray(x, float) for x in (q, v, a, tau))
        at_once = max(1, min(len(robots), int(AT_ONCE / (8 * np.shape(q)[1] * numbers))))
        parts = [
            _of_some(first, terms, into, batches, jax.tree.map(lambda x, k=k: x[k], (own, state)), float(dt))
            for k in _in_turn(len(robots), at_once)
        ]
    fits, found = jax.tree.map(lambda *x: np.concatenate(x)[: len(robots)], *parts)
    return FleetScreen(fleet_of(rows.structural, fits), tuple(_causes(first, batches, found)))


def _in_turn(robots: int, at_once: int) -> list[Int[np.ndarray, " at_once"]]:
    """Robots that are taken together, so that one program serves all; the last part is filled up with its last one."""
    return [np.minimum(k + np.arange(at_once), robots - 1) for k in range(0, robots, at_once)]


def _of_some(
    first: RobotModel, terms: tuple[Effect, ...], into: np.ndarray, batches: dict[str, Effect], given: Any, dt: float
) -> tuple[BatchFit, dict[str, _Shown]]:
    """A program for the fits, then one for each effect: together they would take longer to compile than all do."""
    own, state = jax.device_put(given)
    fit, *beside = _fitted(first, terms, into, own, state)
    shown = {name: _shown_in(first, batch, own, state, dt, beside) for name, batch in batches.items()}
    fit, shown = jax.device_get((fit, shown))
    return BatchFit(*fit), {name: _Shown(*x) for name, x in shown.items()}


class _Shown(NamedTuple):
    """What the candidates of one effect take, and their parameters."""

    squares: Float[np.ndarray, "robots places grid"]
    values: Float[np.ndarray, "robots places grid k"]
    std: Float[np.ndarray, "robots places grid k"]


def _can_be_screened(effect: type[Effect]) -> bool:
    return effect.acts_on in ("joint", "pair", "robot") and (
        (bool(effect.amplitudes()) and not effect.inertial and kind(effect) == "columns") or effect.name == _DELAY
    )


_DELAY = "torque_delay"


def _numbers(batch: Effect, nv: int) -> int:
    """Numbers of a sample of all candidates of an effect."""
    rows = batch.at.shape[2] if _local(batch) else nv
    return prod(batch.at.shape[:2]) * rows * max(1, len(batch.amplitudes()))


def _local(batch: Effect) -> bool:
    return batch.acts_on in ("joint", "pair") and not batch.has("position_error")


def _fit_all(first: RobotModel, terms: tuple[Effect, ...], into: Array, own: Any, state: Any) -> tuple[Any, ...]:
    """The fits, and of each its weighted columns and what it leaves, the weights, the factor, and fitted torques."""

    def one(own: Any, state: tuple[Array, ...]) -> tuple[Any, ...]:
        model = eqx.tree_at(own_arrays, first, own)
        fit = fit_states(model, terms, into, *state)
        Z, y = conditioned_rows(model, terms, jnp.zeros(model.nv), into, *state)
        weight = 1.0 / jnp.maximum(fit.rms, 1e-300)
        Z, y = Z * weight[:, None, None], y * weight[:, None]
        factor = jnp.linalg.cholesky(jnp.einsum("jks,jls->kl", Z, Z))
        theta = jax.scipy.linalg.cho_solve((factor, True), jnp.einsum("jks,js->k", Z, y))
        fitted = jnp.einsum("jks,k->js", Z, theta)
        return tuple(fit), Z, y - fitted, weight, factor, (fitted / weight[:, None]).T

    return jax.vmap(one)(own, state)


def _show_all(first: RobotModel, batch: Effect, own: Any, state: Any, dt: Array, beside: Any) -> tuple[Array, ...]:
    """What the candidates of one effect take of each robot's residual."""

    def one(own: Any, state: tuple[Array, ...], beside: Any) -> tuple[Array, ...]:
        model, (Z, rest, weight, factor, total) = eqx.tree_at(own_arrays, first, own), beside
        q, v, a, _ = state
        load = inverse_dynamics(model, q, v, a)
        motion = Motion(model, jnp.arange(len(q)) * dt, q, v, a, load, total, dt, jnp.zeros(model.nv))
        return _shown(batch, Z, rest, weight, factor, motion)

    return jax.vmap(one)(own, state, beside)


_fitted, _shown_in = program(_fit_all, kept=True), program(_show_all, kept=True)


def _shown(
    batch: Effect, Z: Array, rest: Array, weight: Array, factor: Array, motion: Motion
) -> tuple[Array, Array, Array]:
    unit = jax.vmap(jax.vmap(partial(_unit, motion=motion)))(batch)  # (places, grid, k, samples, rows)
    at = batch.at[:, 0] if _local(batch) else np.tile(np.arange(len(weight)), (len(batch.at), 1))
    C = jnp.moveaxis(unit, -1, 3) * weight[at][:, None, None, :, None]
    across = jnp.einsum("pgkrs,prms->pgkm", C, Z[at])
    left = jax.scipy.linalg.solve_triangular(factor, across.reshape(-1, len(factor)).T, lower=True)
    left = left.T.reshape(across.shape)
    whole = jnp.einsum("pgkrs,pglrs->pgkl", C, C)
    S, pull = whole - jnp.einsum("pgkm,pglm->pgkl", left, left), jnp.einsum("pgkrs,prs->pgk", C, rest[at])
    size = jnp.sqrt(jnp.maximum(jnp.diagonal(whole, axis1=2, axis2=3), 1e-300))
    scaled = S / size[..., :, None] / size[..., None, :]
    values, vectors = jnp.linalg.eigh(scaled) if scaled.shape[-1] > 1 else (scaled[..., 0], jnp.ones_like(scaled))
    there = values > UNLIKE
    inverse = jnp.where(there, 1.0 / jnp.where(there, values, 1.0), 0.0)
    turned = jnp.einsum("pgkm,pgk->pgm", vectors, pull / size)
    std = jnp.sqrt(jnp.einsum("pgkm,pgm->pgk", vectors**2, inverse)) / size
    theta = jnp.einsum("pgkm,pgm->pgk", vectors, inverse * turned) / size
    return (inverse * turned**2).sum(-1), theta, std


def _unit(effect: Effect, motion: Motion) -> Float[Array, "k samples rows"]:
    """Torque of a unit of each amplitude in the rows of its own joints, or of all."""
    samples = len(motion.time)
    if effect.name == _DELAY:
        return -motion.rate(motion.total)[None]
    if not effect.has("position_error"):
        return columns(effect, motion).reshape(-1, samples, 1 if effect.acts_on == "joint" else _rows(effect, motion))
    names = effect.amplitudes()

    def shifted(amplitudes: Array) -> Array:
        error = eqx.tree_at(lambda e: [getattr(e, n) for n in names], effect, list(amplitudes)).position_error(motion)
        if error.ndim == 1:
            error = jnp.zeros_like(motion.velocity).at[:, effect.at[-1]].set(error)
        rate = motion.rate(error)
        moved = (-error, -rate, -motion.rate(rate))
        state = (motion.position, motion.velocity, motion.acceleration)
        return jax.jvp(partial(inverse_dynamics, motion.model), state, moved)[1]

    return jnp.stack([shifted(unit) for unit in jnp.eye(len(names))])


def _rows(effect: Effect, motion: Motion) -> int:
    return effect.at.shape[0] if effect.acts_on == "pair" else motion.velocity.shape[1]


def _causes(model: RobotModel, batches: dict[str, Effect], found: dict[str, _Shown]) -> Iterator[CauseInFleet]:
    for name, batch in batches.items():
        kind_of, shown = CATALOGUE[name], found[name]
        linear = tuple(kind_of.amplitudes() or kind_of.parameters())
        for place, at in enumerate(np.asarray(batch.at)[:, 0].tolist()):
            best = int(shown.squares[:, place].sum(0).argmax())
            shapes = [n for n in kind_of.parameters() if n not in linear]
            yield CauseInFleet(
                Name(name, place_names(model, batch, tuple(at))),
                np.sqrt(np.maximum(shown.squares[:, place].max(axis=1), 0.0)),
                linear,
                shown.values[:, place, best],
                shown.std[:, place, best],
                {n: float(np.asarray(getattr(batch, n))[place, best]) for n in shapes},
            )
