r"""The motion that tells two causes apart, and by how many standard deviations.

With X the weighted rows of what is fitted anyway (prior $M_0$), $z$ the torque of the true cause and $Z_g$ the columns
of its rival at the point g of the rival's shapes, what no fit of the rival makes up for is
$$T_g = \min_{\theta, b} |z - X \theta - Z_g b|^2 + \theta' M_0 \theta = u' (G + M_0) u, \quad u = (-\theta, -b, 1)$$
in the Gram matrix G of all these columns, so its gradient by G is $u u'$. A design makes the smallest T of all pairs,
both ways, large; $t = \sqrt T$ is the separation in standard deviations, and n repeats give $\sqrt n \, t$.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect, place
from ..effects.catalogue import find
from ..errors import InputError
from ..estimation.priors import rigid_prior
from .information import Learned
from .sampling import Sampler
from .solvers import GramObjective

__all__ = ["ENOUGH", "Causes", "Pair", "Separated", "causes", "separated", "separation_objective"]

ENOUGH = 4.0  # standard deviations at which a name is sure
LOUD = 2.0  # times the noise: RMS torque of a cause whose size is not given
LINK = 0.2  # share by which a link's inertia is taken to be wrong
LOOSE = 5.0  # times the stated trust, of a link that is a cause itself
SHARPNESS = 8.0  # of the soft minimum over rivals
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
    repeats: int  # of the motion until the name is sure


@dataclass(frozen=True)
class _Case:
    """Columns of one fit of a rival to a true cause."""

    pair: int
    truth: np.ndarray  # columns of the true cause
    size: np.ndarray  # amplitudes
    rival: np.ndarray
    precision: np.ndarray  # prior of the rival's columns


@dataclass(frozen=True)
class Causes:
    """Columns of the causes behind those of what is learned, and which fits they take part in."""

    pairs: tuple[Pair, ...]
    sizes: tuple[dict[str, float], ...]
    columns: np.ndarray  # of the sampler: what is learned first
    learned: int
    cases: tuple[_Case, ...]
    sampler: Sampler
    prior: np.ndarray  # of what is learned


class _Cause:
    """One side of a pair: its columns at all points of its shape, and as the truth."""

    term: Effect | None = None

    def __init__(self, learned: Learned, effect: Effect, size: Mapping[str, float], first: int, trust: float) -> None:
        robot, kind = learned.robot, type(effect)
        self.linear = [name for name, p in kind.parameters().items() if p.linear]
        shapes = [name for name, p in kind.parameters().items() if not p.linear]
        if len(shapes) > 1:
            raise InputError(f"separate: '{effect.name}' has several shapes, which no design searches yet")
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
    kept = list(learned.independent)
    others: list[int] = []
    pairs, sizes, cases = [], [], []
    for both, names in zip(sides, titles, strict=True):
        for k in (0, 1):
            truth, rival = both[k], both[1 - k]
            size = _loud(truth, rows)
            told = truth.told | (dict(zip(truth.linear, size.tolist(), strict=True)) if truth.term is not None else {})
            pairs.append(Pair(names[k], names[1 - k]))
            sizes.append(told)
            for block in rival.blocks:
                cases.append(_Case(len(pairs) - 1, truth.truth, size, block, rival.precision))
                others += [*truth.truth.tolist(), *block.tolist()]
    columns = np.array([*kept, *dict.fromkeys(others)])
    behind = {int(column): k + len(kept) for k, column in enumerate(columns[len(kept) :])}
    local = tuple(
        _Case(
            c.pair,
            np.array([behind[int(x)] for x in c.truth]),
            c.size,
            np.array([behind[int(x)] for x in c.rival]),
            c.precision,
        )
        for c in cases
    )
    return Causes(tuple(pairs), tuple(sizes), columns, len(kept), local, sampler, np.asarray(learned.prior))


def _loud(cause: _Cause, rows: Float[np.ndarray, "nv columns samples"]) -> Float[np.ndarray, " amplitudes"]:
    """Sizes of the cause; those not given make a torque of twice the noise where it acts."""
    if np.isfinite(cause.size).all():
        return cause.size
    own = rows[:, cause.truth]
    rms = np.sqrt((own**2).mean(axis=2).max(axis=0))
    if not (rms > 0).all():
        raise InputError("separate: no motion shows a cause at its place: it has no torque there")
    return np.where(np.isfinite(cause.size), cause.size, LOUD / rms)


def _fits(
    G: Float[np.ndarray, "n n"], given: Causes, prior: Float[np.ndarray, "p p"]
) -> tuple[Float[np.ndarray, " cases"], Float[np.ndarray, "cases n"]]:
    """T of each case, and u with T = u' G u + theta' M0 theta."""
    p, T, U = given.learned, [], []
    for case in given.cases:
        z = np.zeros(len(G))
        z[case.truth] = case.size
        fitted = np.concatenate([np.arange(p), case.rival])
        M = G[np.ix_(fitted, fitted)].copy()
        M[:p, :p] += prior
        M[np.arange(p, len(fitted)), np.arange(p, len(fitted))] += case.precision
        scale = np.sqrt(np.maximum(np.diag(M), np.finfo(float).tiny))
        c = G[fitted] @ z
        fit = np.linalg.solve(M / np.outer(scale, scale) + _RIDGE * np.eye(len(M)), c / scale) / scale
        u = z.copy()
        u[fitted] -= fit
        T.append(max(float(z @ G @ z - c @ fit), np.finfo(float).tiny))
        U.append(u)
    return np.array(T), np.array(U)


def separation_objective(given: Causes, prior: Float[np.ndarray, "p p"]) -> GramObjective:
    """Less the logarithm of the smallest separation of all pairs, softly; in a design it is made small."""

    def objective(G: Float[np.ndarray, "n n"]) -> tuple[float, Float[np.ndarray, "n n"]]:
        T, U = _fits(G, given, prior)
        logs = -SHARPNESS * np.log(T)
        share = np.exp(logs - logs.max())
        value = (np.log(share.sum()) + logs.max()) / (2 * SHARPNESS)
        weight = -0.5 * share / share.sum() / T
        return float(value), (U.T * weight) @ U

    return objective


def separated(given: Causes, G: Float[np.ndarray, "n n"], prior: Float[np.ndarray, "p p"]) -> tuple[Separated, ...]:
    """How far the rows of a Gram matrix tell each pair apart, each way; the nearest shape of the rival counts."""
    T, _ = _fits(G, given, prior)
    pair_of = np.array([case.pair for case in given.cases])
    found = []
    for k, (pair, size) in enumerate(zip(given.pairs, given.sizes, strict=True)):
        sigmas = float(np.sqrt(T[pair_of == k].min()))
        found.append(Separated(pair.truth, pair.rival, size, sigmas, max(1, int(np.ceil((ENOUGH / sigmas) ** 2)))))
    return tuple(found)
