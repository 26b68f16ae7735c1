r"""A motion improved from within its limits, which it may use to the full only little by little.

$f(x) - \mu \sum \log r(x)$ is made small with r the room that every row leaves (a share of its limit): a primal-dual
interior point method (Nocedal and Wright 2006, chapter 19) whose motions keep position, velocity and acceleration at
every step. These rows are linear and each is of one joint alone, so their part of the Hessian is a small block a joint;
that of the rest is a formula of Broyden, Fletcher, Goldfarb and Shanno of the last few steps alone. $\mu$ is chosen
anew at each step so that a linear model of the conditions of an optimum is met best after it (Nocedal, Waechter and
Waltz 2009), and rises as well as falls. Torques and distances may be exceeded on the way: below a small room their
logarithm goes on as a parabola; its weight only falls.

Where limits are felt late, what a motion tells decides its shape and not which limit it met first: from the same random
motions such descents end higher than those along the limits (`programming`), which then finish them. A Hessian of few
steps and a $\mu$ that goes up and down leave poor optima behind: with all steps and a $\mu$ that only falls twice the
evaluations ended lower.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from .programming import FIRST, LONGEST, lapack

if TYPE_CHECKING:
    from .solvers import Problem

__all__ = ["BEGUN", "from_within"]

BEGUN, LAST = 200.0, 3e-3  # of all rows of one limit of one joint: multipliers at first, multiplier times room at last
FIRST_WEIGHT, FASTER = 1.0, 0.2  # of the logarithms of all torques of one joint at first, and from one to the next
SOLVED, SOLVED_LAST, MOST = 10.0, 5e-3, 100  # times that weight, of the gradient: what may be left; steps
NEARLY = 0.99  # share of the room that a step may take
TIGHT = 0.05  # of a limit: room of a torque or distance below which its logarithm goes on as a parabola
ENOUGH, CUT, SHORTER = 1e-8, 12, 0.5
TRUSTED = 1e10  # times mu / room, up and down, that a multiplier may be
REMEMBERED = 6  # steps
VANISHED = 1e-2  # of what is left at last: mu follows multipliers and rooms no further down, where nothing converges
SHARPEST, CENTRED, TRIED, GOLDEN = (
    1e6,
    1e2,
    8,
    0.5 * (5**0.5 - 1),
)  # times the mean of multiplier and room that mu may be


class _Linear:
    """Positions, velocities and accelerations of the joints at the samples, as shares of their limits."""

    def __init__(self, problem: Problem) -> None:
        self.nv, self.free = problem.nv, problem.start is None
        functions, limits, offsets = [], [], []
        for kind, own in problem.rows:
            here = kind == "position"
            first = [np.full((len(own), 1), float(here))] if self.free else []
            functions.append(np.concatenate([*first, own], axis=1))
            limit = problem.limits.of(kind)
            limits.append(np.tile(limit, (len(own), 1)))
            given = np.zeros(self.nv) if self.free or problem.start is None else problem.start
            offsets.append(np.tile(given - problem.limits.middle if here else np.zeros(self.nv), (len(own), 1)))
        size = problem.basis.size + self.free
        self.functions = np.concatenate([np.zeros((0, size)), *functions])
        none = np.zeros((0, self.nv))
        self.limit, self.offset = np.concatenate([none, *limits]), np.concatenate([none, *offsets])
        each = np.arange(self.nv * problem.basis.size).reshape(self.nv, -1)
        self.index = np.concatenate([np.arange(self.nv)[:, None], self.nv + each], axis=1) if self.free else each

    def changes(self, d: Float[np.ndarray, " n"]) -> Float[np.ndarray, "rows nv"]:
        """By how much the shares change with the numbers of a motion."""
        return self.functions @ d[self.index].T / self.limit

    def rooms(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "2 rows nv"]:
        """What is left above and below."""
        share = self.changes(x) + self.offset / self.limit
        return np.stack([1.0 - share, 1.0 + share])

    def back(self, weight: Float[np.ndarray, "rows nv"]) -> Float[np.ndarray, " n"]:
        """Gradient of the shares, each times its weight."""
        out = np.zeros(self.index.size)
        out[self.index] = (weight / self.limit).T @ self.functions
        return out

    def stiffer(self, H: Float[np.ndarray, "n n"], weight: Float[np.ndarray, "rows nv"]) -> Float[np.ndarray, "n n"]:
        """H with the sum of the gradients' outer products, each times its weight."""
        out = H.copy()
        scaled = (weight / self.limit**2).T[:, :, None] * self.functions
        out[self.index[:, :, None], self.index[:, None, :]] += self.functions.T @ scaled
        return out


def _relaxed(room: np.ndarray) -> tuple[float, np.ndarray]:
    """Sum of -log room, which below a small room goes on as a parabola (Hauser and Saccon 2006), and its slopes."""
    tight = room < TIGHT
    inside = np.where(tight, TIGHT, room)
    below = (room - 2 * TIGHT) / TIGHT
    value = np.where(tight, 0.5 * (below**2 - 1) - np.log(TIGHT), -np.log(inside))
    return float(value.sum()), np.where(tight, below / TIGHT, -1.0 / inside)


@dataclass
class _Curved:
    """The relaxed logarithms of torques and distances."""

    problem: Problem
    weight: float = 0.0  # of their sum

    def __post_init__(self) -> None:
        clearance = self.problem.limits.clearance
        self.apart = clearance is not None and bool(clearance.rows.names)
        self.seen: tuple[np.ndarray, tuple[np.ndarray | None, np.ndarray | None]] | None = None

    def value(self, x: Float[np.ndarray, " n"]) -> float:
        """Their sum."""
        total, *slopes = self._all(x)
        self.seen = x, (slopes[0], slopes[1])
        return total

    def slope(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Gradient of the objective and the weighted sum."""
        if self.seen is None or self.seen[0] is not x:
            self.value(x)
        assert self.seen is not None
        scaled = (None if one is None else self.weight * one for one in self.seen[1])
        return self.problem.slope(x, *scaled)

    def _all(self, x: np.ndarray) -> tuple[float, np.ndarray | None, np.ndarray | None]:
        total, torque, distance = 0.0, None, None
        if self.problem.torque:
            share = self.problem.torque_shares(x)[: self.problem.count]
            (above, up), (under, down) = _relaxed(1.0 - share), _relaxed(1.0 + share)
            total, torque = above + under, down - up
        if self.apart:
            near, distance = _relaxed(self.problem.distances(x))
            total += near
        return total, torque, distance


class _Point(NamedTuple):
    """A motion, the objective with and the sum of the curved rows, and the rooms of the linear ones."""

    x: np.ndarray
    value: float
    curved: float
    rooms: np.ndarray

    def merit(self, mu: float, weight: float) -> float:
        """The objective within its limits."""
        return self.value + weight * self.curved - mu * float(np.log(self.rooms).sum())


def from_within(
    problem: Problem,
    x: Float[np.ndarray, " n"],
    begun: float = BEGUN,
) -> Float[np.ndarray, " n"]:
    """A better motion from x; x itself where it leaves no room to a position, velocity or acceleration.

    `begun`: how strongly limits are felt at first (multipliers of all rows of one limit of a joint together).
    """
    linear, curved = _Linear(problem), _Curved(problem)
    if linear.rooms(x).min(initial=1.0) <= 0.0:
        return x
    last = LAST / problem.count
    curved.weight = FIRST_WEIGHT / problem.count

    def at(x: np.ndarray) -> _Point:
        return _Point(x, problem.value(x), curved.value(x), linear.rooms(x))

    here = at(x)
    slope, held = curved.slope(x), np.full(here.rooms.shape, begun / problem.count)
    past, stopped = _Past(len(x), slope), False
    for _ in range(MOST):
        gap = float((held * here.rooms).mean()) if held.size else curved.weight
        left = slope + linear.back(held[0] - held[1])
        if gap <= curved.weight and (held.size or np.abs(left).max() < SOLVED * curved.weight):
            if curved.weight <= last and np.abs(left).max() < SOLVED_LAST:
                break
            curved.weight = max(FASTER * curved.weight, last)
            slope = curved.slope(here.x)
        way = _step(linear, here, held, slope, past.hessian(), max(gap, VANISHED * last))
        there = None if way is None else _along(at, here, way, curved.weight)
        if way is None or there is None:
            if stopped:
                break
            stopped = True
            past.forget(slope)
            continue
        slope_there = curved.slope(there.x)
        past.add(there.x - here.x, slope_there - slope)
        here, slope, stopped = there, slope_there, False
        held = np.clip(held + way.duals, way.mu / here.rooms / TRUSTED, TRUSTED * way.mu / here.rooms)
    return here.x


class _Past:
    """The Hessian that the last few steps tell of, in the compact form of Byrd, Nocedal and Schnabel (1994)."""

    def __init__(self, size: int, slope: np.ndarray) -> None:
        self.size = size
        self.forget(slope)

    def forget(self, slope: Float[np.ndarray, " n"]) -> None:
        """As at the beginning."""
        self.plain = max(float(np.linalg.norm(slope)), 1e-12) / FIRST
        self.steps: list[np.ndarray] = []
        self.changes: list[np.ndarray] = []
        self.left_out = 0

    def add(self, s: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> None:
        """A step that changed the gradient by y; left out where the function bends down along it."""
        if s @ y <= 1e-8 * np.linalg.norm(s) * np.linalg.norm(y):
            self.left_out += 1
            if self.left_out >= 2:  # what was seen before does not hold here
                self.steps, self.changes, self.left_out = [], [], 0
            return
        self.steps, self.changes = [*self.steps[1 - REMEMBERED :], s], [*self.changes[1 - REMEMBERED :], y]
        self.plain, self.left_out = float(s @ y) / float(s @ s), 0

    def hessian(self) -> Float[np.ndarray, "n n"]:
        """Positive."""
        H = self.plain * np.eye(self.size)
        if not self.steps:
            return H
        S, Y = np.array(self.steps).T, np.array(self.changes).T
        SY = S.T @ Y
        lower = np.tril(SY, -1)
        middle = np.block([[self.plain * S.T @ S, lower], [lower.T, -np.diag(SY.diagonal())]])
        both = np.concatenate([self.plain * S, Y], axis=1)
        return H - both @ np.linalg.solve(middle, both.T)


class _Way(NamedTuple):
    """A step, how fast the merit changes along it, how much of it is taken first, the multipliers' change, and mu."""

    d: np.ndarray
    fall: float
    most: float
    duals: np.ndarray
    mu: float


def _step(linear: _Linear, here: _Point, held: np.ndarray, slope: np.ndarray, H: np.ndarray, gap: float) -> _Way | None:
    """The step of the linearised conditions of an optimum; None where the Hessian has lost its sign to rounding.

    They are linear in mu, so the step is that of mu = 0 and so many times another.
    """
    inside, stiff = 1.0 / here.rooms, held / here.rooms
    L, failed = lapack("potrf")(linear.stiffer(H, stiff.sum(axis=0)), lower=1)
    if failed:
        return None
    centring = linear.back(inside[0] - inside[1])
    ways = -lapack("potrs")(L, np.stack([slope, centring], axis=1), lower=1)[0].T
    changes = [linear.changes(d) for d in ways]
    moved = [np.stack([change, -change]) for change in changes]  # of what is used
    duals = [stiff * moved[0] - held, stiff * moved[1] + inside]
    left = slope + linear.back(held[0] - held[1])
    mu, most, share = _best_mu(here.rooms, held, moved, duals, float(left @ left) / len(left), gap)
    d = ways[0] + mu * ways[1]
    most = min(most, LONGEST / max(float(np.abs(d).max()), 1e-300))
    return _Way(d, float((slope + mu * centring) @ d), most, share * (duals[0] + mu * duals[1]), mu)


def _best_mu(
    rooms: np.ndarray, held: np.ndarray, moved: list[np.ndarray], duals: list[np.ndarray], left: float, gap: float
) -> tuple[float, float, float]:
    """mu, and the shares of the step and of the multipliers' change that keep all of them positive.

    mu is a multiple of `gap`, the mean of multiplier times room; of those tried (golden section of its logarithm) the
    one after whose step the squares of what the conditions of an optimum leave are the smallest.
    """
    if not held.size:
        return gap, 1.0, 1.0
    used, lost = [x / rooms for x in moved], [-x / held for x in duals]

    def shares(mu: float) -> tuple[float, float]:
        one, two = (float((x[0] + mu * x[1]).max()) for x in (used, lost))
        return min(1.0, NEARLY / max(one, 1e-300)), min(1.0, NEARLY / max(two, 1e-300))

    def after(logarithm: float) -> float:
        mu = gap * float(np.exp(logarithm))
        one, two = shares(mu)
        products = (rooms - one * (moved[0] + mu * moved[1])) * (held + two * (duals[0] + mu * duals[1]))
        flat = products.ravel()
        return (1.0 - two) ** 2 * left + float(flat @ flat) / flat.size

    just = np.log(1.0 - 1e-3)
    low, high = (0.0, np.log(CENTRED)) if after(just) > after(0.0) else (np.log(1 / SHARPEST), just)
    a, b = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    at_a, at_b = after(a), after(b)
    for _ in range(TRIED):
        if at_a < at_b:
            high, b, at_b = b, a, at_a
            a = high - GOLDEN * (high - low)
            at_a = after(a)
        else:
            low, a, at_a = a, b, at_b
            b = low + GOLDEN * (high - low)
            at_b = after(b)
    mu = gap * float(np.exp(a if at_a < at_b else b))
    return mu, *shares(mu)


def _along(at: Callable[[np.ndarray], _Point], here: _Point, way: _Way, weight: float) -> _Point | None:
    before, share = here.merit(way.mu, weight), way.most
    for _ in range(CUT):
        there = at(here.x + share * way.d)
        inside = there.rooms.min(initial=1.0) > 0.0  # but for rounding, all steps are
        if inside and there.merit(way.mu, weight) <= before + ENOUGH * share * way.fall:
            return there
        share *= SHORTER
    return None
