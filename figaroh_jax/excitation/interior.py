r"""A motion improved from within its limits, which it may use to the full only little by little.

$f(x) - \mu \sum \log r(x)$ is made small with r the room that every row leaves (a share of its limit), for smaller and
smaller $\mu$: a primal-dual interior point method (Nocedal and Wright 2006, chapter 19) whose motions keep position,
velocity and acceleration at every step. These rows are linear and each is of one joint alone, so their part of the
Hessian is a small block a joint; that of the rest is a formula of Broyden, Fletcher, Goldfarb and Shanno with Powell's
damping. Torques and distances may be exceeded on the way: below a small room their logarithm goes on as a parabola.

Where limits are felt late, what a motion tells decides its shape and not which limit it met first: from the same random
motions such descents end higher than those along the limits (`programming`), which then finish them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from .programming import FIRST, LONGEST, lapack, updated

if TYPE_CHECKING:
    from .solvers import Problem

__all__ = ["BEGUN", "from_within"]

BEGUN, LAST = 20.0, 3e-3  # mu of all rows of one limit of one joint together
FASTER = 0.2  # from one mu to the next
SOLVED, PATIENCE = 10.0, 40  # times mu that may be left of the conditions of an optimum, and steps for it
NEARLY = 0.99  # share of the room that a step may take
TIGHT = 0.05  # of a limit: room of a torque or distance below which its logarithm goes on as a parabola
ENOUGH, CUT, SHORTER = 1e-4, 12, 0.4
TRUSTED = 1e8  # times mu / room, up and down, that a multiplier may be


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

    def __post_init__(self) -> None:
        clearance = self.problem.limits.clearance
        self.apart = clearance is not None and bool(clearance.rows.names)
        self.seen: tuple[np.ndarray, tuple[np.ndarray | None, np.ndarray | None]] | None = None

    def value(self, x: Float[np.ndarray, " n"]) -> float:
        """Their sum."""
        total, *slopes = self._all(x)
        self.seen = x, (slopes[0], slopes[1])
        return total

    def slope(self, x: Float[np.ndarray, " n"], times: float) -> Float[np.ndarray, " n"]:
        """Gradient of the objective and so many times this sum."""
        if self.seen is None or self.seen[0] is not x:
            self.value(x)
        assert self.seen is not None
        scaled = (None if one is None else times * one for one in self.seen[1])
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

    def merit(self, mu: float) -> float:
        """The objective within its limits."""
        return self.value + mu * (self.curved - float(np.log(self.rooms).sum()))


def from_within(
    problem: Problem,
    x: Float[np.ndarray, " n"],
    begun: float = BEGUN,
) -> Float[np.ndarray, " n"]:
    """A better motion from x; x itself where it leaves no room to a position, velocity or acceleration.

    `begun`: how strongly limits are felt at first (mu, of all rows of one limit of a joint together).
    """
    linear, curved = _Linear(problem), _Curved(problem)
    if linear.rooms(x).min(initial=1.0) <= 0.0:
        return x
    mu, last = begun / problem.count, LAST / problem.count

    def at(x: np.ndarray, rooms: np.ndarray) -> _Point:
        return _Point(x, problem.value(x), curved.value(x), rooms)

    here = at(x, linear.rooms(x))
    slope, held = curved.slope(x, mu), mu / here.rooms
    H, fresh, waited = _plain(slope), True, 0
    while True:
        waited += 1
        left = np.abs(slope + linear.back(held[0] - held[1])).max()
        if max(left, np.abs(held * here.rooms - mu).max(initial=0.0)) < SOLVED * mu or waited > PATIENCE:
            if mu <= last:
                return here.x
            mu, waited = max(FASTER * mu, last), 0
            slope = curved.slope(here.x, mu)
        way = _step(linear, here, held, slope, H, mu)
        there = None if way is None else _along(linear, at, here, way, mu)
        if way is None or there is None:
            if mu <= last:
                return here.x
            mu, waited = max(FASTER * mu, last), 0
            slope = curved.slope(here.x, mu)
            H, fresh = _plain(slope), True
            continue
        slope_there = curved.slope(there.x, mu)
        H = updated(H, there.x - here.x, slope_there - slope, fresh)
        here, slope, fresh = there, slope_there, False
        held = np.clip(held + way.duals, mu / here.rooms / TRUSTED, TRUSTED * mu / here.rooms)


class _Way(NamedTuple):
    """A step, how fast the merit changes along it, how long it may be, and the change of the multipliers."""

    d: np.ndarray
    fall: float
    most: float
    duals: np.ndarray


def _plain(slope: np.ndarray) -> np.ndarray:
    return np.eye(len(slope)) * max(float(np.linalg.norm(slope)), 1e-12) / FIRST


def _step(linear: _Linear, here: _Point, held: np.ndarray, slope: np.ndarray, H: np.ndarray, mu: float) -> _Way | None:
    inside, stiff = mu / here.rooms, held / here.rooms
    r = slope + linear.back(inside[0] - inside[1])
    L, failed = lapack("potrf")(linear.stiffer(H, stiff.sum(axis=0)), lower=1)
    if failed:
        return None
    d = -lapack("potrs")(L, r, lower=1)[0]
    change = linear.changes(d)
    moved = np.stack([change, -change])  # of what is used
    duals = inside - held + stiff * moved
    most = min(1.0, NEARLY / max(float((moved / here.rooms).max(initial=0.0)), 1e-300))
    most = min(most, LONGEST / max(float(np.abs(d).max()), 1e-300))
    share = min(1.0, NEARLY / max(float((-duals / held).max(initial=0.0)), 1e-300))
    return _Way(d, float(r @ d), most, share * duals)


def _along(linear: _Linear, at, here: _Point, way: _Way, mu: float) -> _Point | None:
    before, share = here.merit(mu), way.most
    for _ in range(CUT):
        x = here.x + share * way.d
        there = at(x, linear.rooms(x))
        if there.merit(mu) <= before + ENOUGH * share * way.fall:
            return there
        share *= SHORTER
    return None
