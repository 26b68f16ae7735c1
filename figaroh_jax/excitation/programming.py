r"""Sequential quadratic programming of a motion, with the rows that are near their limits.

Position, velocity and acceleration are linear in the numbers of a motion: a step within the rows that are near keeps
all of them, and where it meets another, that one joins and the step is found again. So every motion on the way keeps
these limits exactly, and thousands of rows cost what the hundred near ones do. Torques and distances are linearised;
what they exceed enters the merit $f + \nu \sum \max(0, c)$ (Nocedal and Wright 2006, chapter 18). The Hessian is that
of Broyden, Fletcher, Goldfarb and Shanno with Powell's damping; the quadratic programme is solved by the dual method
of Goldfarb and Idnani (1983), from the rows that held the last step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

if TYPE_CHECKING:
    from .solvers import Problem

__all__ = ["FIRST", "LONGEST", "Rows", "at_rest", "descend", "drawn_in", "lapack", "quadratic_step", "updated"]

BAND = 0.15  # of a limit: rows nearer to it than this are in
JOINING, JOINED = 5, 150  # times that rows join one step, and how many of them at once
FIRST = 0.5  # length of the first step, in numbers of a motion
LONGEST = 1.5  # rad (or at 2 rad/s, 8 rad/s^2) that a step changes a number
SHORTEST = 1e-9  # share of a step
ENOUGH = 1e-4  # share of the expected decrease that a step must bring
ENDED, IN_A_ROW = 1e-6, 3  # of the objective: what so many steps must gain
INWARDS = 0.05  # of a range: how far within it a motion that is drawn in may stand still
HELD = 1e-8  # a step's violation of rows that are in, which is rounding
CUT = 12  # times that a step is shortened
DEPENDENT = 1e-14  # square of what is left of a row of length one beside others, which is rounding
NEVER = 500  # exchanges of rows in one quadratic programme


@lru_cache
def lapack(name: str) -> Callable[..., Any]:
    """A routine of LAPACK, in double precision."""
    from scipy.linalg import get_lapack_funcs  # slow to import

    return get_lapack_funcs((name,), dtype=np.float64)[0]


class Rows:
    """Room that a motion leaves to every limit at the samples of the design, as shares; the linear rows first."""

    def __init__(self, problem: Problem, margin: dict[str, float]) -> None:
        self.problem, self.margin = problem, margin
        self.linear = [(functions, problem.limits.of(kind), kind) for kind, functions in problem.rows]
        self.counts = [2 * len(functions) * problem.nv for functions, _, _ in self.linear]
        self.curved = sum(self.counts)  # the first row that is not linear
        self.torques = problem.count * problem.nv if problem.torque else 0

    def of_linear(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " rows"]:
        """Room of position, velocity and acceleration."""
        shares, parts = self.problem.shares(x), [np.zeros(0)]
        for _, limit, kind in self.linear:
            room = np.where(np.isfinite(limit), 1.0 - self.margin.get(kind, 0.0), np.inf)
            parts.append(np.stack([room - shares[kind], room + shares[kind]]).ravel())
        return np.concatenate(parts)

    def of_curved(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " rows"]:
        """Room of torques and distances."""
        parts = []
        if self.torques:
            share = self.problem.torque_shares(x)[: self.problem.count]
            parts.append((1.0 - self.margin.get("torque", 0.0) - np.abs(share)).ravel())
        parts.append((self.problem.distances(x) - self.margin.get("clearance", 0.0)).ravel())
        return np.concatenate(parts)

    def all(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " rows"]:
        """Room of all rows."""
        return np.concatenate([self.of_linear(x), self.of_curved(x)])

    def slopes(self, x: Float[np.ndarray, " n"], index: Int[np.ndarray, " some"]) -> Float[np.ndarray, "some n"]:
        """How fast some rows lose their room."""
        out, first = np.zeros((len(index), len(x))), 0
        for (functions, limit, kind), count in zip(self.linear, self.counts, strict=True):
            here = np.flatnonzero((index >= first) & (index < first + count))
            if len(here):
                self._linear_slopes(out, here, index[here] - first, functions, limit, kind)
            first += count
        torques, distances = self._curved(index)
        if len(torques):
            at, joint = np.divmod(index[torques] - self.curved, self.problem.nv)
            sign = np.sign(self.problem.torque_shares(x)[at, joint])
            out[torques] = sign[:, None] * self.problem.torque_slopes(x, at, joint)
        if len(distances):
            pairs = self.problem.distances(x).shape[1]
            out[distances] = -self.problem.distance_slopes(
                x, *np.divmod(index[distances] - self.curved - self.torques, pairs)
            )
        return out

    def _curved(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        beyond = index - self.curved
        return np.flatnonzero((beyond >= 0) & (beyond < self.torques)), np.flatnonzero(beyond >= self.torques)

    def _linear_slopes(
        self, out: np.ndarray, here: np.ndarray, own: np.ndarray, functions: np.ndarray, limit: np.ndarray, kind: str
    ) -> None:
        nv, size = self.problem.nv, self.problem.basis.size
        free = nv if self.problem.start is None else 0
        side, at, joint = np.unravel_index(own, (2, len(functions), nv))
        sign = np.where(side == 0, 1.0, -1.0) / limit[joint]
        out[here[:, None], free + joint[:, None] * size + np.arange(size)] = sign[:, None] * functions[at]
        if free and kind == "position":
            out[here, joint] = sign


class _Step(NamedTuple):
    """A step, the rows it was held by, and how strongly."""

    d: np.ndarray
    rows: np.ndarray
    held: np.ndarray
    slopes: np.ndarray


class _Point(NamedTuple):
    """A motion, the objective and its gradient, and the room it leaves."""

    x: np.ndarray
    value: float
    slope: np.ndarray
    linear: np.ndarray
    curved: np.ndarray

    @property
    def over(self) -> float:
        """What torques and distances exceed, summed."""
        return float(-np.minimum(self.curved, 0.0).sum())


def descend(
    problem: Problem, x: Float[np.ndarray, " n"], margin: dict[str, float], steps: int
) -> Float[np.ndarray, " n"]:
    """A better motion, after so many steps at the most; x keeps position, velocity and acceleration."""
    rows, dear, fresh, small = Rows(problem, margin), 1.0, True, 0
    here = _at(problem, rows, x)
    H = np.eye(len(x)) * max(float(np.linalg.norm(here.slope)), 1e-12) / FIRST
    active = np.zeros(0, int)
    for _ in range(steps):
        step = _step(rows, here, H, active)
        if step is None:
            break
        active, curved = step.rows[step.held > 0], step.rows >= rows.curved
        dear = max(dear, 2.0 * float(step.held[curved].max(initial=0.0)))
        there = _shortened(problem, rows, here, step, dear)
        if there is None:
            break
        gained = here.value + dear * here.over - there.value - dear * there.over
        small = small + 1 if gained < ENDED * max(1.0, abs(here.value)) else 0
        if small >= IN_A_ROW:
            return there.x
        y = there.slope - here.slope
        bent = np.flatnonzero(curved & (step.held > 0))
        if len(bent):
            y = y + step.held[bent] @ (rows.slopes(there.x, step.rows[bent]) - step.slopes[bent])
        H = updated(H, there.x - here.x, y, fresh)
        here, fresh = there, False
    return here.x


def drawn_in(problem: Problem, x: Float[np.ndarray, " n"], margin: dict[str, float]) -> Float[np.ndarray, " n"]:
    """The motion made as much smaller as position, velocity and acceleration ask for."""
    rows = Rows(problem, margin)
    room = rows.of_linear(x)
    if room.min(initial=0.0) >= 0.0:
        return x
    rest = at_rest(problem, x, margin.get("position", 0.0) + INWARDS)  # at the edge itself nothing would be left of it
    with np.errstate(divide="ignore", invalid="ignore"):
        share = -room / (rows.of_linear(rest) - room)
    share = np.where(room < 0, share, 0.0).max()
    return x + min(max(float(share), 0.0), 1.0) * (rest - x)


def at_rest(problem: Problem, x: Float[np.ndarray, " n"], margin: float) -> Float[np.ndarray, " n"]:
    """Standing still where the motion begins, or so far within the positions as a margin asks for (a share)."""
    still = problem.trajectory(x)
    start = np.asarray(still.start)
    if problem.start is None:
        middle, reach = problem.limits.middle, (1.0 - margin) * problem.limits.reach
        start = np.clip(start, middle - reach, middle + reach)
    return problem.numbers(replace(still, start=start, weights=0.0 * np.asarray(still.weights)))


def _at(problem: Problem, rows: Rows, x: np.ndarray) -> _Point:
    value = problem.value(x)
    return _Point(x, value, problem.slope(x), rows.of_linear(x), rows.of_curved(x))


def updated(H: np.ndarray, s: np.ndarray, y: np.ndarray, fresh: bool) -> np.ndarray:
    """The Hessian after a step s that changed the gradient by y, still positive (Powell's damping)."""
    if fresh and s @ y > 0:
        H = np.eye(len(s)) * max(float(y @ y) / float(s @ y), 1e-8)
    Hs = H @ s
    sHs, sy = float(s @ Hs), float(s @ y)
    if sy < 0.2 * sHs:
        share = 0.8 * sHs / (sHs - sy)
        y = share * y + (1.0 - share) * Hs
        sy = float(s @ y)
    return H - np.outer(Hs, Hs) / sHs + np.outer(y, y) / sy


def _step(rows: Rows, here: _Point, H: np.ndarray, active: np.ndarray) -> _Step | None:
    """The step of the quadratic model within the rows that are near, others joining as it meets them."""
    room = np.concatenate([here.linear, here.curved])
    index = np.union1d(np.flatnonzero(room < BAND), active)
    L, failed = lapack("potrf")(H, lower=1, clean=1)
    if failed:
        return None
    step = None
    for _ in range(JOINING):
        A = rows.slopes(here.x, index)
        found = _within(L, here.slope, A, room[index], index >= rows.curved, np.searchsorted(index, active))
        if found is None:
            return None
        step = _Step(found[0], index, found[1], A)
        beyond = rows.of_linear(here.x + step.d)
        met = np.setdiff1d(np.flatnonzero(beyond < -HELD), index)
        if not len(met):
            break
        active = index[step.held > 0]
        index = np.union1d(index, met[np.argsort(beyond[met])[:JOINED]])
    return step


def _within(
    L: np.ndarray, slope: np.ndarray, A: np.ndarray, room: np.ndarray, curved: np.ndarray, warm: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """The step and its multipliers; curved rows that are violated are asked for less where all cannot be had."""
    for share in (1.0, 0.3, 0.0):
        left = np.where(curved, np.where(room < 0, share * room, room), np.maximum(room, 0.0))
        found = quadratic_step(L, slope, A, left, warm)
        if found is not None:
            return found
    return None


def _shortened(problem: Problem, rows: Rows, here: _Point, step: _Step, dear: float) -> _Point | None:
    """The point after as much of the step as the other linear rows allow and the merit is smaller for."""
    there = rows.of_linear(here.x + step.d)
    fall = np.subtract(here.linear, there, out=np.zeros_like(there), where=np.isfinite(there))  # others have no limit
    with np.errstate(divide="ignore", invalid="ignore"):
        most = np.where(fall > 1e-14, np.maximum(here.linear, 0.0) / fall, np.inf)
    kept = step.rows[step.rows < rows.curved]
    most[kept[fall[kept] <= np.maximum(here.linear[kept], 0.0) + HELD]] = np.inf
    share = min(1.0, float(most.min(initial=1.0)), LONGEST / max(float(np.abs(step.d).max()), 1e-12))
    wanted = float(here.slope @ step.d) - dear * here.over
    if wanted > -1e-9 or share < SHORTEST:
        return None
    before = here.value + dear * here.over
    for _ in range(CUT):
        x = here.x + share * step.d
        value, curved = problem.value(x), rows.of_curved(x)
        merit = value - dear * float(np.minimum(curved, 0.0).sum())
        if merit <= before + ENOUGH * share * wanted:
            return _Point(x, value, problem.slope(x), rows.of_linear(x), curved)
        bend = merit - before - share * wanted
        share = min(max(-wanted * share**2 / (2 * bend), 0.1 * share), 0.5 * share)
    return None


def quadratic_step(
    L: Float[np.ndarray, "n n"],
    slope: Float[np.ndarray, " n"],
    A: Float[np.ndarray, "rows n"],
    room: Float[np.ndarray, " rows"],
    warm: Int[np.ndarray, " some"] | None = None,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " rows"]] | None:
    """d that makes d' L L' d / 2 + slope' d smallest with A d <= room, and the rows' multipliers; None: there is none.

    `warm`: rows that are likely to hold.
    """
    own = lapack("trtrs")(L, slope, lower=1)[0]
    held = np.zeros(len(room))
    if not len(room):
        return lapack("trtrs")(L, -own, lower=1, trans=1)[0], held
    M = lapack("trtrs")(L, A.T, lower=1)[0]
    size = np.sqrt((M * M).sum(axis=0)) + 1e-300
    M /= size
    with np.errstate(over="ignore"):  # a row of zeros with room holds at any distance: inf
        far = room / size
    dual = _Dual(M, far + M.T @ own, max(1.0, float(np.abs(own).max())))
    dual.begin([] if warm is None else list(warm))
    if not dual.run():
        return None
    held[dual.rows] = dual.u / size[dual.rows]
    return lapack("trtrs")(L, dual.y - own, lower=1, trans=1)[0], held


class _Dual:
    """The shortest y with M' y <= h, by the dual method; `rows` hold it with multipliers `u`."""

    def __init__(self, M: np.ndarray, h: np.ndarray, scale: float) -> None:
        self.M, self.h, self.small = M, h, 1e-11 * scale
        self.rows: list[int] = []
        self.y, self.u = np.zeros(len(M)), np.zeros(0)

    def begin(self, rows: list[int]) -> None:
        """From the point that these rows hold, without those that do not hold it."""
        while rows:
            q, r = np.linalg.qr(self.M[:, rows])
            kept = np.abs(r.diagonal()) > 1e-8
            if len(kept) == len(rows) and kept.all():
                c = lapack("trtrs")(r, self.h[rows], trans=1)[0]
                u = lapack("trtrs")(r, -c)[0]
                if (u >= 0).all():
                    self.rows, self.y, self.u = rows, q @ c, u
                    return
                kept = u > 0
            rows = [row for row, keep in zip(rows, kept, strict=False) if keep]

    def run(self) -> bool:
        """Rows join, the most violated first, until none is; False where no point keeps all."""
        for _ in range(NEVER):
            missing = self.M.T @ self.y - self.h
            missing[self.rows] = -1.0
            row = int(missing.argmax())
            if missing[row] <= self.small:
                return True
            if not self._join(row, float(missing[row])):
                return False
        return False

    def _join(self, row: int, missing: float) -> bool:
        own, m = 0.0, self.M[:, row]
        while True:
            r, z = self._shares(m)
            zz = float(z @ z)
            full = missing / zz if zz > DEPENDENT else np.inf
            falls = r > 1e-13
            ends = np.where(falls, self.u / np.where(falls, r, 1.0), np.inf)
            first = int(ends.argmin()) if len(ends) else -1
            least = float(ends[first]) if len(ends) else np.inf
            t = min(full, least)
            if not np.isfinite(t):
                return False
            self.u, own = np.maximum(self.u - t * r, 0.0), own + t
            if np.isfinite(full):
                self.y, missing = self.y - t * z, missing - t * zz
            if full <= least:
                self.rows, self.u = [*self.rows, row], np.append(self.u, own)
                return True
            self.rows, self.u = [k for n, k in enumerate(self.rows) if n != first], np.delete(self.u, first)

    def _shares(self, m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """m in terms of the rows that hold, by least squares, and what is left of it; rows side by side are alike."""
        if not self.rows:
            return np.zeros(0), m
        q, r = np.linalg.qr(self.M[:, self.rows])
        along = q.T @ m
        z = m - q @ along
        return lapack("trtrs")(r, along)[0], z - q @ (q.T @ z)
