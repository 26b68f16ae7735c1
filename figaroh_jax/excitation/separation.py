r"""The motion that tells two causes apart, and by how many standard deviations.

With X the weighted rows of what is fitted anyway (prior $M_0$), $z$ the torque of the true cause and $Z_g$ the columns
of its rival at the point g of the rival's shapes, what no fit of the rival makes up for is
$$T_g = \min_{\theta, b} |z - X \theta - Z_g b|^2 + \theta' M_0 \theta = u' (G + M_0) u, \quad u = (-\theta, -b, 1)$$
in the Gram matrix G of all these columns, so its gradient by G is $u u'$. A design makes the smallest T of all pairs,
both ways (but for a link as the true cause, of which only a guess could be told), large;
$t = \sqrt T$ is the separation in standard deviations. Of n repeats it is that of n G: $\sqrt n \, t$ where the rows
decide, and bounded where it is the prior that keeps the fit from following.

A cause that changes the torque in time (a delay, a lag: a response $H(\omega)$) is written as torques of some moments
before, $\sum_k w_k \tau(t - s_k) \approx H \tau$, by least squares of $\sum w_k e^{-i \omega s_k} - H(\omega)$ over
the frequencies of motions; the columns are then $\tau(t - s_k)$, of the model as it stands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..effects.base import Effect, place
from ..effects.catalogue import find
from ..errors import InputError
from ..estimation.priors import rigid_prior
from .information import Learned
from .sampling import Sampler
from .solvers import GramObjective

__all__ = ["ENOUGH", "Causes", "Pair", "Separated", "causes", "check_told", "separated", "separation_objective"]

ENOUGH = 4.0  # standard deviations at which a name is sure
MOST = 50  # repeats that are thought of
LOUD = 2.0  # times the noise: RMS torque of a cause whose size is not given
LINK = 0.2  # share by which a link's inertia is taken to be wrong
LOOSE = 5.0  # times the stated trust, of a link that is a cause itself
SHARPNESS = 8.0  # of the soft minimum over rivals
SHIFTS = (0.0, 0.012, 0.025, 0.04, 0.06)  # s before, whose torques delays and lags are made of
FASTEST = 8.0  # Hz up to which they are
AROUND = 3.0  # times a delay or lag, up and down, that its rival may have
NOTHING = 1e-6  # share of the squares of a cause's torque
_RIDGE = 1e-10


@dataclass(frozen=True)
class Pair:
    """A true cause and its rival, by name."""

    truth: str
    rival: str


@dataclass(frozen=True)
class Separated:
    """How far a motion tells a cause from its rival."""

    truth: str
    rival: str
    size: dict[str, float]  # of the true cause, in its own units
    sigmas: float  # of one run
    repeats: int | None  # of the motion until the name is sure; None: no number of them does it


@dataclass(frozen=True)
class _Case:
    """Combinations of the columns in one fit of a rival to a true cause."""

    pair: int
    truth: np.ndarray  # (n,) torque of the true cause, less that of a rival that has no amplitude
    rival: np.ndarray  # (n, k) columns of the rival
    precision: np.ndarray  # (k,) prior of the rival
    counts: bool = True  # in a design; how a link is wrong, and by how much, nobody knows beforehand


@dataclass(frozen=True)
class Causes:
    """Columns of the causes behind those of what is learned, and which fits they take part in."""

    pairs: tuple[Pair, ...]
    sizes: tuple[dict[str, float], ...]
    columns: np.ndarray  # of the sampler: what is learned first
    shifts: tuple[float, ...]  # s: torques of so long before follow as further columns
    learned: int
    cases: tuple[_Case, ...]
    sampler: Sampler
    prior: np.ndarray  # of what is learned


class _Cause:
    """One side of a pair: its columns at all points of its shape, and as the truth."""

    term: Effect | None = None

    def __init__(self, learned: Learned, effect: Effect, size: Mapping[str, float], first: int, trust: float) -> None:
        robot, kind = learned.robot, type(effect)
        self.linear = kind.amplitudes()
        shapes = [name for name, p in kind.parameters().items() if not p.linear]
        if len(shapes) > 1:
            raise InputError(f"separate: '{effect.name}' has several shapes, which no design searches yet")
        self.response, self.inertial = effect.has("torque_response"), kind.inertial
        if self.response and shapes and not self.linear:
            points = np.array(kind.parameters()[shapes[0]].grid, float)
            true = float(size.get(shapes[0], points[len(points) // 2]))
            some = true * np.geomspace(1 / AROUND, AROUND, 15)  # what a rival may be: it has no amplitude of its own
            self.weights = np.stack([_weights(effect, shapes[0], x) for x in (*some, true)])
            self.blocks, self.truth, self.size = [np.zeros(0, int)] * len(some), np.zeros(0, int), np.zeros(0)
            self.precision, self.told = np.zeros(0), {shapes[0]: true}
            return
        if not self.linear or not (effect.has("torque") or effect.has("torque_error") or effect.has("change")):
            raise InputError(f"separate: '{effect.name}' has no torque of an instant in which a size is linear")
        self.precision = np.zeros(len(self.linear))
        if kind.inertial:
            link = int(np.asarray(effect.at)[0])
            self.grid, self.blocks = 1, [np.arange(10 * link, 10 * link + 10)]
            own = np.asarray(robot.inertia)[link]
            self.truth, self.size = self.blocks[0], LINK * own
            self.precision = rigid_prior(robot, trust)[1][self.blocks[0]] / LOOSE**2
            self.told = {"share of the nominal inertia": LINK}
            return
        values: np.ndarray = np.zeros(1)
        if shapes:
            grid = np.sort(np.array(kind.parameters()[shapes[0]].grid, float))
            true = float(size.get(shapes[0], grid[len(grid) // 2]))
            values = np.append(grid, true)
        self.grid = len(values) - bool(shapes)
        many = {name: np.zeros(len(values)) for name in self.linear} | {name: values for name in shapes}
        at = np.tile(np.asarray(effect.at), (len(values), 1))
        self.term = kind(at, **many)
        width = len(self.linear)
        every = [np.arange(first + k * width, first + (k + 1) * width) for k in range(len(values))]
        self.blocks, self.truth = every[: self.grid], every[-1]
        self.size = np.array([size.get(name, np.nan) for name in self.linear])
        self.told = {name: float(values[-1]) for name in shapes}

    def combined(self, columns: np.ndarray, late: int, point: int, size: np.ndarray | None) -> np.ndarray:
        """Combinations (n, k) of the sampler's columns and so many late torques; of a given size one alone."""
        out = np.zeros((len(columns) + late, 1 if self.response else len(self.truth)))
        if self.response:
            out[len(columns) :, 0] = self.weights[point]
            return out
        block = self.truth if point < 0 else self.blocks[point]
        out[[int(np.flatnonzero(columns == c)[0]) for c in block], np.arange(len(block))] = 1.0
        return out if size is None else (out @ size)[:, None]

    @property
    def width(self) -> int:
        return 0 if self.term is None else len(np.asarray(self.term.at)) * len(self.linear)


def causes(
    learned: Learned,
    pairs: Sequence[tuple[tuple[str, Sequence[str], Mapping[str, float]], ...]],
    states: Float[np.ndarray, "3 samples nv"],
    trust: float = 0.10,
) -> Causes:
    """Columns and fits of pairs of causes, each a name, a place and sizes (its parameters, in their units).

    A size that is not given is that of a torque of twice the noise, RMS over `states`. Raises `InputError` for effects
    that are not there, and those without a torque of an instant.
    """
    robot = learned.robot
    first = len(learned.names)
    sides: list[tuple[_Cause, _Cause]] = []
    titles, terms = [], list(learned.terms)
    for pair in pairs:
        both = []
        for name, at, size in pair:
            effect = place(find(name), robot, at)
            unknown = set(size) - set(effect.parameters())
            if unknown:
                raise InputError(f"separate: '{name}' has no parameter '{sorted(unknown)[0]}'")
            cause = _Cause(learned, effect, size, first, trust)
            if cause.term is not None:
                terms.append(cause.term)
            first += cause.width
            both.append(cause)
        sides.append((both[0], both[1]))
        titles.append(tuple(f"{name} at {', '.join(at) or 'the robot'}" for name, at, _ in pair))
    sampler = Sampler(robot, terms, np.asarray(learned.width))
    rows = sampler.rows(states) * np.sqrt(np.asarray(learned.weight))[:, None, None]
    return _arranged(learned, sides, titles, sampler, rows)


def _arranged(
    learned: Learned,
    sides: list[tuple[_Cause, _Cause]],
    titles: list[tuple[str, ...]],
    sampler: Sampler,
    rows: np.ndarray,
) -> Causes:
    every = [int(c) for both in sides for side in both for block in (side.truth, *side.blocks) for c in block]
    columns = np.array([*learned.independent, *dict.fromkeys(c for c in every if c not in learned.independent)])
    shifts = SHIFTS if any(side.response for both in sides for side in both) else ()
    pairs, sizes, cases = [], [], []
    for both, names in zip(sides, titles, strict=True):
        for k in (0, 1):
            truth, rival = both[k], both[1 - k]
            size = _loud(truth, names[k], rows)
            told = truth.told | (dict(zip(truth.linear, size.tolist(), strict=True)) if truth.term is not None else {})
            pairs.append(Pair(names[k], names[1 - k]))
            sizes.append(told)
            z = truth.combined(columns, len(shifts), -1, size)[:, 0]
            for point in range(len(rival.blocks)):
                R, left = rival.combined(columns, len(shifts), point, None), z
                if rival.response:
                    R, left = R[:, :0], z - R[:, 0]
                counts = not truth.inertial or rival.inertial
                cases.append(_Case(len(pairs) - 1, left, R, rival.precision, counts))
    first = len(learned.independent)
    return Causes(tuple(pairs), tuple(sizes), columns, shifts, first, tuple(cases), sampler, np.asarray(learned.prior))


def _weights(effect: Effect, name: str, value: float) -> Float[np.ndarray, " shifts"]:
    """Of the torques of the moments before, what a response adds to the torque."""
    omega = 2 * np.pi * np.linspace(0.0, FASTEST, 60)
    changed = type(effect)(effect.at, **{name: value})
    wanted = np.asarray(changed.torque_response(jnp.asarray(omega)), complex) - 1.0
    turned = np.outer(omega, SHIFTS)
    tall = np.concatenate([np.cos(turned), -np.sin(turned)])
    return np.linalg.lstsq(tall, np.concatenate([np.real(wanted), np.imag(wanted)]), rcond=None)[0]


def _loud(cause: _Cause, name: str, rows: Float[np.ndarray, "nv columns samples"]) -> Float[np.ndarray, " amplitudes"]:
    """Sizes of the cause; those not given make a torque of twice the noise where it acts."""
    own = rows[:, cause.truth]
    rms = np.sqrt((own**2).mean(axis=2).max(axis=0))
    if len(rms) and not (rms > 0).any():
        raise InputError(f"separate: no motion shows {name}: it makes no torque within these limits")
    if np.isfinite(cause.size).all():
        return cause.size
    if not (rms > 0).all():
        raise InputError(f"separate: no motion shows all parameters of {name}: give their sizes")
    return np.where(np.isfinite(cause.size), cause.size, LOUD / rms)


def _fits(
    G: Float[np.ndarray, "n n"], given: Causes, prior: Float[np.ndarray, "p p"]
) -> tuple[Float[np.ndarray, " cases"], Float[np.ndarray, "cases n"]]:
    """T of each case, and u with T = u' G u + theta' M0 theta."""
    p, T, U = given.learned, [], []
    for case in given.cases:
        z, R = case.truth, case.rival
        GR, Gz = G @ R, G @ z
        M = np.block([[G[:p, :p] + prior, GR[:p]], [GR[:p].T, R.T @ GR + np.diag(case.precision)]])
        scale = np.sqrt(np.maximum(np.diag(M), np.finfo(float).tiny))
        c = np.concatenate([Gz[:p], R.T @ Gz])
        fit = np.linalg.solve(M / np.outer(scale, scale) + _RIDGE * np.eye(len(M)), c / scale) / scale
        u = z - R @ fit[p:]
        u[:p] -= fit[:p]
        T.append(max(float(z @ Gz - c @ fit), np.finfo(float).tiny))
        U.append(u)
    return np.array(T), np.array(U)


def check_told(given: Causes, G: Float[np.ndarray, "n n"]) -> None:
    """Refuse causes that what is fitted anyway, or the rival, makes up for in whatever motion (G: of a usual one)."""
    T, _ = _fits(G, given, given.prior)
    for case, t in zip(given.cases, T, strict=True):
        if t < NOTHING * float(case.truth @ G @ case.truth):
            pair = given.pairs[case.pair]
            raise InputError(
                f"separate: no motion distinguishes {pair.truth} from {pair.rival}: what is fitted anyway (`baseline`)"
                " and the rival make the same torques; leave one of them out of the baseline, or another pair"
            )


def separation_objective(given: Causes, prior: Float[np.ndarray, "p p"]) -> GramObjective:
    """Less the logarithm of the smallest separation of all pairs, softly; in a design it is made small."""

    wanted = replace(given, cases=tuple(case for case in given.cases if case.counts))

    def objective(G: Float[np.ndarray, "n n"]) -> tuple[float, Float[np.ndarray, "n n"]]:
        T, U = _fits(G, wanted, prior)
        logs = -SHARPNESS * np.log(T)
        share = np.exp(logs - logs.max())
        value = (np.log(share.sum()) + logs.max()) / (2 * SHARPNESS)
        weight = -0.5 * share / share.sum() / T
        return float(value), (U.T * weight) @ U

    return objective


def separated(given: Causes, G: Float[np.ndarray, "n n"], prior: Float[np.ndarray, "p p"]) -> tuple[Separated, ...]:
    """How far the rows of a Gram matrix tell each pair apart, each way; the nearest shape of the rival counts."""
    pair_of = np.array([case.pair for case in given.cases])

    def least(times: int) -> Float[np.ndarray, " pairs"]:
        T = _fits(times * G, given, prior)[0]
        return np.sqrt([T[pair_of == k].min() for k in range(len(given.pairs))])

    found = []
    for k, (pair, size) in enumerate(zip(given.pairs, given.sizes, strict=True)):
        sigmas = float(least(1)[k])
        enough = None
        if least(MOST)[k] >= ENOUGH:  # rows that only add up would take the first number of these
            first = max(1, min(MOST, int(np.ceil((ENOUGH / sigmas) ** 2))))
            enough = next(n for n in range(first, MOST + 1) if least(n)[k] >= ENOUGH)
        found.append(Separated(pair.truth, pair.rival, size, sigmas, enough))
    return tuple(found)
