"""Fit of a loop's numbers to recordings: Levenberg-Marquardt on the exact sums, several lanes side by side.

The states at the windows' starts are unknowns too, with a prior at what was measured there. What a fit leaves is kept
by blocks of time, so that held-out errors follow without another fit: the normal matrix less a fold's share gives the
estimate without the fold.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from .loop import Loop
from .native import native
from .parameters import BOUNDS, Table, uncoupled
from .sensitivity import Sums, Windows, linear_sums

__all__ = [
    "Fit",
    "contradicted_errors",
    "fit",
    "held_out",
    "refitted_without",
    "spread_of_recordings",
    "standard_errors",
    "start_of",
]

_ITERATIONS = 40
_PAIR = 2
_FEW = 12  # windows up to which starts and numbers always move together
_MOSTLY = 0.5  # share of a step's gain from which the starts move alone, every other time
_COLUMNS = 16  # free numbers, a multiple of which a program differentiates
_GROUPS, _REFITS = 6, 10  # of recordings that are left out, steps of each fit without one
_SETTLED, _RESTING = 1e-5, 10.0  # predicted share of the squares at which a fit without some recordings ends
_OF_GAIN, _OF_REST = 0.02, 0.003  # shares of what a fit has gained and of what is left, where only its gain is asked
_LEAST_FREEDOM = 2.0  # of an interval told by recordings
_FEWEST_BLOCKS = 10  # of rows that tell how far they contradict each other
_CLOSE = 0.02  # predicted decrease of the sum of whitened squares at which a fit ends


class Fit(NamedTuple):
    """One lane's optimum."""

    theta: np.ndarray  # (entries,)
    free: np.ndarray  # (columns,) which entries were fitted, -1: none
    start: np.ndarray  # (2 nv, windows)
    cost: float  # sum of whitened squares, the prior of the starts included
    sums: Sums  # numpy, without the axis of lanes
    converged: bool

    @property
    def squares(self) -> float:
        """Sum of whitened squared residuals."""
        return float(self.sums.cost.sum())


def start_of(data: Windows, lanes: int = 1) -> np.ndarray:
    """The measured states at the windows' starts, for each lane."""
    return np.repeat(np.asarray(data.start)[None], lanes, 0)


def fit(
    loop: Loop,
    table: Table,
    data: Windows,
    theta: np.ndarray,
    free: Sequence[Sequence[int]],
    start: np.ndarray | None = None,
    *,
    width: int,
    lanes: int,
    iterations: int = _ITERATIONS,
    rough: float = 0.0,
    below: float = np.inf,
) -> list[Fit]:
    """Fit each row of `theta` in the entries `free` names for it, from there and from the states `start`.

    `width` pads the number of free entries and `lanes` the number of rows that one program takes, so that one
    compilation serves all fits. A fit ends where a step promises less than the share `rough` of the squares, or less
    than a fiftieth of what it has gained on the cost `below` and than three thousandths of what is left.
    """
    start = start_of(data, len(theta)) if start is None else start
    lots = range(0, len(theta), lanes)
    found = []
    for lot in lots:
        rows = slice(lot, lot + lanes)
        mine = _Lanes(loop, table, data, theta[rows], free[rows], start[rows], width, lanes)
        found += mine.run(iterations, rough, below)
    return found


class _Lanes:
    """Levenberg-Marquardt of a few lanes that share one compiled program."""

    def __init__(self, loop, table, data, theta, free, start, width, lanes, left=None):
        self.left = left or []  # (blocks, windows) of each lane, True: left out of its fit
        self.loop, self.table, self.data, self.lanes = loop, table, data, lanes
        self.theta, self.start = np.array(theta, float), np.array(start, float)
        self.free = np.full((len(theta), width), -1)
        for k, one in enumerate(free):
            self.free[k, : len(one)] = one
        self.bounds = np.array([BOUNDS[entry.name] for entry in table])
        self.inner = np.full((len(self.theta), self.start.shape[2]), 1e-8)  # damping of each window's start
        self.code = native(loop, table, data)
        self.rows = max(int((np.asarray(data.weight) > 0).sum()), 1)

    def sums(self, which: np.ndarray, theta: np.ndarray, start: np.ndarray) -> list[Sums]:
        if self.code.usable:
            plain = [self.code.knows_one(one, self.free[k]) for k, one in zip(which, theta, strict=True)]
            lanes = zip(which, theta, start, plain, strict=True)
            return [Sums(*self.code.sums(one, self.free[k], x)) if known else self.by_program(k, one, x)  # pyright: ignore[reportArgumentType]
                    for k, one, x, known in lanes]  # fmt: skip
        lanes = _PAIR if len(which) <= _PAIR < self.lanes else self.lanes  # few are left of many: a smaller program
        padded = np.resize(which, lanes)
        index = np.maximum(self.free[padded], 0)
        at = np.resize(np.arange(len(which)), lanes)
        with jax.enable_x64(True):
            loop = uncoupled(self.loop, self.table, theta, self.free[which])
            found = linear_sums(loop, self.table, theta[at], index, self.data, start[at])
            cost, gradient, matrix = (np.asarray(x) for x in found)
        return [Sums(cost[k], gradient[k], matrix[k]) for k in range(len(which))]

    def by_program(self, lane: Any, theta: np.ndarray, start: np.ndarray) -> Sums:
        """The sums of one lane in which effects act that machine code does not know; few sizes, each compiled once."""
        count, states = self.free.shape[1], len(start)
        wide = -(-count // _COLUMNS) * _COLUMNS
        index = np.zeros(wide, int)
        index[:count] = np.maximum(self.free[lane], 0)
        keep = np.r_[:count, wide : wide + states]
        with jax.enable_x64(True):
            loop = uncoupled(self.loop, self.table, theta, self.free[lane])
            found = linear_sums(loop, self.table, theta[None], index[None], self.data, start[None])
            cost, gradient, matrix = (np.asarray(x)[0] for x in found)
        return Sums(cost, gradient[..., keep], matrix[..., keep[:, None], keep])  # pyright: ignore[reportArgumentType]

    def several(self, now: list[Sums], steps: int) -> list[Sums]:
        """The sums of every lane after some damped steps of what it keeps; starts without their first rows stay."""
        count = len(self.theta)
        cost = np.array([self.cost(self.kept(now[k], k), self.start[k]) for k in range(count)])
        damping, active = np.full(count, 1e-3), np.arange(count)
        for _ in range(steps):
            made = {k: self.step(self.kept(now[k], k), k, damping[k]) for k in active}
            least = _SETTLED * cost * np.clip(cost / self.rows, 1.0, _RESTING)  # a large rest tells less of a number
            active = np.array([k for k in active if made[k].gain > least[k]], int)
            if not len(active):
                break
            starts = {k: np.where(self.left[k][0], self.start[k], made[k].start) for k in active}
            trial: list[Sums] = []
            for lot in range(0, len(active), self.lanes):
                which = active[lot : lot + self.lanes]
                trial += self.sums(
                    which, np.stack([made[k].theta for k in which]), np.stack([starts[k] for k in which])
                )
            for k, new in zip(active, trial, strict=True):
                after = self.cost(self.kept(new, k), starts[k])
                if after <= cost[k]:
                    self.theta[k], self.start[k], now[k], cost[k] = made[k].theta, starts[k], new, after
                    damping[k] /= 5
                else:
                    damping[k] *= 30
        return now

    def kept(self, sums: Sums, lane: Any) -> Sums:
        """Without what a lane leaves out."""
        keep = ~self.left[lane]
        return Sums(*(np.where(keep.reshape(keep.shape + (1,) * (x.ndim - 2)), x, 0.0) for x in sums))  # pyright: ignore[reportArgumentType]

    def cost(self, sums: Sums, start: np.ndarray) -> float:
        prior = (start - np.asarray(self.data.start)) * np.asarray(self.data.precision)
        total = float(sums.cost.sum() + (prior**2).sum())
        return total if np.isfinite(total) and np.isfinite(sums.matrix).all() else np.inf

    def run(self, iterations: int, rough: float, below: float = np.inf) -> list[Fit]:
        count = len(self.theta)
        everyone = np.arange(count)
        now = self.sums(everyone, self.theta, self.start)
        cost = [self.cost(s, x) for s, x in zip(now, self.start, strict=True)]
        damping, done = np.full(count, 1e-3), ~np.isfinite(cost)  # one that diverges has no derivative
        alone, worse = np.zeros(count, bool), np.zeros(count)
        below = below if np.isfinite(below) else 0.0
        for _ in range(iterations):
            active = everyone[~done]
            if not len(active):
                break
            steps = [self.step(now[k], k, damping[k]) for k in active]
            for k, step in zip(active, steps, strict=True):
                enough = min(_OF_GAIN * (below - cost[k]), _OF_REST * cost[k])
                least = max(_CLOSE * max(1.0, cost[k] / self.rows), rough * cost[k], enough)
                done[k] |= step.gain < least and (damping[k] <= 1.0 or (rough > 0 and worse[k] > 1))
            tried = [(k, step) for k, step in zip(active, steps, strict=True) if not done[k]]
            if not tried:
                continue
            for place, (k, step) in enumerate(tried):
                own = self.starts(now[k], k)
                many = self.start.shape[2] > _FEW
                alone[k] = many and own.gain > _MOSTLY * step.gain and (not alone[k] or (self.free[k] < 0).all())
                tried[place] = (k, own) if alone[k] else (k, step)
            which = np.array([k for k, _ in tried])
            trial = self.sums(which, np.stack([s.theta for _, s in tried]), np.stack([s.start for _, s in tried]))
            for (k, step), sums in zip(tried, trial, strict=True):
                if alone[k]:
                    before, now[k] = cost[k], self.better(now[k], sums, step.start, k)
                    cost[k] = self.cost(now[k], self.start[k])
                    done[k] = before - cost[k] < 1e-7 * before and self.inner[k].max() > 1e3
                    continue
                new = self.cost(sums, step.start)
                if new < cost[k]:
                    self.theta[k], self.start[k], now[k], damping[k] = step.theta, step.start, sums, damping[k] / 5
                    worse[k] = 0
                    done[k] = cost[k] - new < 1e-7 * cost[k]
                    cost[k] = new
                else:
                    if rough > 0 and self.start.shape[2] > _FEW:  # beside a rest a start may move far
                        self.held_back(now[k], sums, step.start, k)
                    damping[k], worse[k] = max(damping[k] * 6 * 2 ** worse[k], 1e-6), worse[k] + 1
                    done[k] = damping[k] > 1e8
        return [Fit(self.theta[k], self.free[k], self.start[k], cost[k], now[k], bool(done[k])) for k in everyone]

    def starts(self, sums: Sums, lane: int) -> _Step:
        """A step of the states at the starts alone, each window with a damping of its own."""
        system = System(sums, self.data, self.start[lane])
        size = self.inner[lane][:, None] * np.einsum("wii->wi", system.hss) + 1e-12
        change = np.linalg.solve(system.hss + size[:, None] * np.eye(size.shape[1]), system.gs[..., None])[..., 0]
        gain = system.decrease(np.zeros(system.m), change.T)
        return _Step(self.theta[lane], self.start[lane] + change.T, gain)

    def held_back(self, old: Sums, new: Sums, start: np.ndarray, lane: int) -> None:
        """The starts of the windows that a refused step made worse are damped more."""
        good = self.improved(old, new, start, lane)
        self.inner[lane] = np.where(good, self.inner[lane], np.clip(self.inner[lane] * 30, 1e-2, 1e8))

    def improved(self, old: Sums, new: Sums, start: np.ndarray, lane: int) -> np.ndarray:
        """Whether each window's cost is lower, (windows,)."""
        precise, truth = np.asarray(self.data.precision), np.asarray(self.data.start)
        costs = [
            sums.cost.sum((0, 2)) + ((x - truth) ** 2 * precise**2).sum(0)
            for sums, x in ((old, self.start[lane]), (new, start))
        ]
        return np.isfinite(new.matrix).all((0, 2, 3)) & (costs[1] < costs[0])

    def better(self, old: Sums, new: Sums, start: np.ndarray, lane: int) -> Sums:
        """The better sums of each window, whose start moves where they are the new ones."""
        good = self.improved(old, new, start, lane)
        self.start[lane] = np.where(good, start, self.start[lane])
        self.inner[lane] = np.where(good, self.inner[lane] / 5, np.clip(self.inner[lane] * 6, 1e-3, 1e8))
        wide = lambda x: good.reshape(1, -1, *(1,) * (x.ndim - 2))  # noqa: E731
        return Sums(*(np.where(wide(x), x, y) for x, y in zip(new, old, strict=True)))  # pyright: ignore[reportArgumentType]

    def step(self, sums: Sums, lane: Any, damping: Any) -> _Step:
        """The damped step within the bounds; entries that would leave them stay where they are."""
        system = System(sums, self.data, self.start[lane])
        free = self.free[lane]
        at, (low, high) = np.maximum(free, 0), self.bounds[np.maximum(free, 0)].T
        fixed = free < 0
        change, starts = system.solve(fixed, damping, self.inner[lane])
        for _ in range(2):
            wanted = self.theta[lane][at] + change
            out = ~fixed & (
                ((wanted < low) & (self.theta[lane][at] <= low)) | ((wanted > high) & (self.theta[lane][at] >= high))
            )
            if not out.any():
                break
            fixed = fixed | out
            change, starts = system.solve(fixed, damping, self.inner[lane])
        theta = self.theta[lane].copy()
        mine = free >= 0
        theta[at[mine]] = np.clip(theta[at[mine]] + change[mine], low[mine], high[mine])
        return _Step(theta, self.start[lane] + starts, system.decrease(change, starts))


class _Step(NamedTuple):
    theta: np.ndarray
    start: np.ndarray
    gain: float  # predicted decrease


class System:
    """Normal equations of the parameters and the windows' starts."""

    def __init__(self, sums: Sums, data: Windows, start: np.ndarray):
        gradient, matrix = sums.gradient.sum(0), sums.matrix.sum(0)
        states = start.shape[0]
        m = gradient.shape[1] - states
        precision = np.asarray(data.precision).T ** 2  # (windows, 2 nv)
        self.m = m
        self.hpp, self.gp = matrix[:, :m, :m].sum(0), gradient[:, :m].sum(0)
        self.hps = matrix[:, :m, m:]
        self.hss = matrix[:, m:, m:] + np.einsum("wi,ij->wij", precision, np.eye(states))
        self.gs = gradient[:, m:] - precision * (start - np.asarray(data.start)).T

    def solve(self, fixed: np.ndarray, damping: float, each: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Damped step of the parameters (those `fixed` stay) and of the windows' starts (states, windows).

        `each` (windows,) damps the starts of single windows more.
        """
        scale = np.einsum("wii->wi", self.hss)
        scale = scale * np.maximum(damping, np.broadcast_to(each, len(scale)))[:, None] + 1e-12
        hss = self.hss + scale[:, None] * np.eye(scale.shape[1])
        inner = np.linalg.solve(hss, np.concatenate([np.swapaxes(self.hps, 1, 2), self.gs[..., None]], 2))
        schur = self.hpp - np.einsum("wpi,wiq->pq", self.hps, inner[..., :-1])
        right = self.gp - np.einsum("wpi,wi->p", self.hps, inner[..., -1])
        diagonal = np.diag(self.hpp).copy()
        schur = schur + damping * np.diag(diagonal)
        keep = ~fixed & (diagonal > 0)
        change = np.zeros(self.m)
        if keep.any():
            size = np.sqrt(diagonal[keep])
            scaled = schur[np.ix_(keep, keep)] / np.outer(size, size) + 1e-13 * np.eye(keep.sum())
            change[keep] = np.linalg.lstsq(scaled, right[keep] / size, rcond=1e-12)[0] / size
        starts = inner[..., -1] - np.einsum("wip,p->wi", inner[..., :-1], change)
        return change, starts.T

    def promises(self, subsets: Sequence[np.ndarray]) -> np.ndarray:
        """`decrease` of the undamped step of the columns of each subset and of the windows' starts; others stay."""
        schur, right = self.reduced(1e-6)
        scale = 1e-6 * np.einsum("wii,ij->wij", self.hss, np.eye(self.hss.shape[1]))
        own = float((self.gs * np.linalg.solve(self.hss + scale, self.gs[..., None])[..., 0]).sum())
        found = np.full(len(subsets), own)
        for k, one in enumerate(subsets):
            keep = np.asarray(one)[np.diag(schur)[one] > 0]
            if len(keep):
                size = np.sqrt(np.diag(schur)[keep])
                scaled = schur[np.ix_(keep, keep)] / np.outer(size, size) + 1e-12 * np.eye(len(keep))
                found[k] += right[keep] / size @ np.linalg.lstsq(scaled, right[keep] / size, rcond=1e-12)[0]
        return found

    def reduced(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """Matrix and right side of the parameters, the windows' starts solved for."""
        hss = self.hss + damping * np.einsum("wii,ij->wij", self.hss, np.eye(self.hss.shape[1]))
        inner = np.linalg.solve(hss, np.concatenate([np.swapaxes(self.hps, 1, 2), self.gs[..., None]], 2))
        schur = self.hpp - np.einsum("wpi,wiq->pq", self.hps, inner[..., :-1])
        return schur, self.gp - np.einsum("wpi,wi->p", self.hps, inner[..., -1])

    def decrease(self, change: np.ndarray, starts: np.ndarray) -> float:
        """Of the sum of squares, as the quadratic model promises it for a step."""
        s = starts.T
        gain = 2 * (self.gp @ change + (self.gs * s).sum())
        spent = change @ self.hpp @ change + 2 * np.einsum("p,wpi,wi->", change, self.hps, s)
        return float(gain - spent - np.einsum("wi,wij,wj->", s, self.hss, s))

    def scores(self, sums: Sums) -> np.ndarray:
        """Gradient of the parameters of each block and window, (blocks, windows, parameters), starts solved for."""
        inner = self._by_starts()
        return sums.gradient[..., : self.m] - np.einsum("wip,bwi->bwp", inner, sums.gradient[..., self.m :])

    def _by_starts(self) -> np.ndarray:
        """How the best starts of the windows follow the parameters, (windows, states, parameters)."""
        size = 1e-12 * np.maximum(np.einsum("wii->w", self.hss), 1.0)
        least = size[:, None, None] * np.eye(self.hss.shape[1])
        return np.linalg.solve(self.hss + least, np.swapaxes(self.hps, 1, 2))

    def covariance(self, fixed: np.ndarray) -> np.ndarray:
        """Of the parameters, the starts being unknown; infinite variance where nothing tells one."""
        schur = self.hpp - np.einsum("wpi,wiq->pq", self.hps, self._by_starts())
        keep = ~fixed & (np.diag(schur) > 0)
        answer = np.diag(np.full(self.m, np.inf))
        answer[np.ix_(keep, keep)] = np.linalg.pinv(schur[np.ix_(keep, keep)], rcond=1e-14, hermitian=True)
        return answer


def standard_errors(found: Fit, data: Windows, level: float = 1.0) -> np.ndarray:
    """One standard deviation of each free entry, (columns,), the noise's variance times `level`."""
    with np.errstate(invalid="ignore"):
        spread = np.diag(System(found.sums, data, found.start).covariance(found.free < 0))
        return np.sqrt(np.maximum(spread, 0.0) * level)


def contradicted_errors(found: Fit, data: Windows, level: float = 1.0) -> np.ndarray:
    """`standard_errors`, or what blocks of rows contradict each other by where that is more, (columns,).

    An encoder's steps are no noise that each row draws anew. The scores of blocks, and of pairs of neighbours, stand
    for the noise's (K.-Y. Liang and S. Zeger, "Longitudinal data analysis using generalized linear models", Biometrika
    73, 1986), where there are enough of them.
    """
    errors, system = standard_errors(found, data, level), System(found.sums, data, found.start)
    told = np.flatnonzero(np.isfinite(errors) & (found.free >= 0))
    inner = system.covariance(found.free < 0)[np.ix_(told, told)]
    scores = system.scores(found.sums)[..., told]
    for many in (1, 2):
        each = np.add.reduceat(scores, np.arange(0, len(scores), many), axis=0).reshape(-1, len(told))
        count = int(each.any(axis=1).sum())
        if count >= max(_FEWEST_BLOCKS, 2 * len(told)):
            apart = np.square(each @ inner).sum(0) * count / (count - len(told))
            errors[told] = np.maximum(errors[told], np.sqrt(apart))
    return errors


def refitted_without(
    loop: Loop,
    table: Table,
    data: Windows,
    found: Sequence[Fit],
    folds: np.ndarray,
    *,
    lanes: int,
    outputs: bool = False,
) -> np.ndarray:
    """Squares of each block and window by fits of all others, (fits, blocks, windows): `held_out` to every order.

    With `outputs` a last axis tells the squares of each column that is read.

    Recordings that hold much of what tells a number leave a direction open that one linear step follows out of sight.
    A few damped steps do not. `folds` are recordings, left out in groups, six at the most.
    """
    left = _left_out(folds)
    many, width = len(left), max(len(one.free) for one in found)
    code = native(loop, table, data)
    if (
        code.usable
        and code.knows([one.theta for one in found], [one.free for one in found])
        and all((mine.all(0) == mine.any(0)).all() for mine in left)
    ):
        answers = np.stack(
            [_squares_without(loop, table, data, one, [np.any(mine, 0) for mine in left]) for one in found]
        )
        return answers if outputs else answers.sum(-1)
    theta, start = (np.repeat(np.stack([getattr(one, name) for one in found]), many, 0) for name in ("theta", "start"))
    free = [one.free for one in found for _ in left]
    fits = _Lanes(loop, table, data, theta, free, start, width, lanes, left * len(found))
    sums = fits.several([one.sums for one in found for _ in left], _REFITS)
    answers = np.zeros((len(found), *sums[0].cost.shape))
    for k, one in enumerate(sums):
        answers[k // many] = np.where(left[k % many][..., None], one.cost, answers[k // many])
    return answers if outputs else answers.sum(-1)


def _left_out(folds: np.ndarray) -> list[np.ndarray]:
    """Groups of folds, six at the most, each (blocks, windows)."""
    groups = np.searchsorted(np.unique(folds), folds) % _GROUPS
    return [groups == k for k in range(groups.max() + 1)]


def _squares_without(loop: Loop, table: Table, data: Windows, one: Fit, left: Sequence[np.ndarray]) -> np.ndarray:
    """Squares (blocks, windows, ny) of each group of windows by a fit of the others, which alone are simulated."""
    answer = np.zeros(one.sums.cost.shape)
    for out in left:
        some = [jax.tree.map(lambda x: np.asarray(x)[..., which], data) for which in (~out, out)]  # noqa: B023
        none = np.zeros((len(answer), int((~out).sum())), bool)
        begin = one.theta[None], [one.free], one.start[None][..., ~out]
        lane = _Lanes(loop, table, some[0], *begin, len(one.free), 1, [none])
        lane.several([Sums(*(x[:, ~out] for x in one.sums))], _REFITS)  # pyright: ignore[reportArgumentType]
        code = native(loop, table, some[1])
        answer[:, out] = code.sums(lane.theta[0], np.zeros(0, int), one.start[:, out]).cost
    return answer


def spread_of_recordings(table: Table, found: Fit, folds: np.ndarray, *, alike: bool = False) -> np.ndarray:
    """How differently recordings tell each free entry, (columns,): half of its 95 % interval over 1.96.

    Where more than noise is left, and in each recording in its own way, the noise tells no error. A Gauss-Newton step
    leads to the numbers without each recording (`folds` (blocks, windows) numbers them), whose spread tells it: a
    jackknife (J. W. Tukey, Annals of Mathematical Statistics 29, 1958) with Student's t. Its degrees of freedom follow
    from how much each recording tells of the number, unless all are to count `alike`. The starts of the windows stay,
    and so do numbers on their bounds.
    """
    from scipy.special import ndtri, stdtrit  # scipy is slow to import

    count, left = len(found.free), [folds == k for k in np.unique(folds)]
    low, high = np.array([BOUNDS[entry.name] for entry in table])[np.maximum(found.free, 0)].T
    value = found.theta[np.maximum(found.free, 0)]
    gradient, matrix = found.sums.gradient[..., :count], found.sums.matrix[..., :count, :count]
    keep = (found.free >= 0) & (value > low) & (value < high) & (np.diag(matrix.sum((0, 1))) > 0)
    away, told = np.zeros((len(left), count)), np.ones((len(left), count))
    whole = np.linalg.pinv(matrix.sum((0, 1))[np.ix_(keep, keep)], rcond=1e-12, hermitian=True)
    for k, out in enumerate(left):
        H, g = matrix[~out].sum(0)[np.ix_(keep, keep)], gradient[~out].sum(0)[keep]
        size = np.sqrt(np.maximum(np.diag(H), 1e-300))
        away[k, keep] = np.linalg.lstsq(H / np.outer(size, size), g / size, rcond=1e-12)[0] / size
        told[k, keep] = np.einsum("ij,jk,ik->i", whole, matrix[out].sum(0)[np.ix_(keep, keep)], whole)
    many = len(left)
    freedom = many - 1.0 if alike else _freedom(told)
    square = (many - 1) / many * ((away - away.mean(0)) ** 2).sum(0)
    return np.where(keep, np.sqrt(square) * stdtrit(freedom, 0.975) / ndtri(0.975), np.nan)


def _freedom(told: np.ndarray) -> np.ndarray:
    """Degrees of freedom of a jackknife, (columns,): fewer than its groups where few of them tell most of a number.

    `told` (groups, columns) is what each group tells of a number that is its own in each group: they are the weights of
    a mean. Its jackknife is a quadratic form, matched by mean and variance to a chi-squared (R. M. Bell and
    D. F. McCaffrey, Survey Methodology 28, 2002); two at the least, for a t of fewer has no variance. Given the weights
    that is on the safe side; but weights by what is left of each recording (`evened`) are drawn with the recordings.
    """
    many, count = told.shape
    found = np.ones(count)
    for k, own in enumerate(told.T):
        share = np.clip(own, 0.0, None)
        share = share / max(share.sum(), 1e-300)
        steps = (share / np.maximum(1 - share, 1e-6))[:, None] * (share - np.eye(many))
        steps = steps - steps.mean(0)
        form = steps.T @ steps
        found[k] = np.trace(form) ** 2 / max((form**2).sum(), 1e-300)
    return np.clip(found, min(_LEAST_FREEDOM, many - 1.0), many - 1.0)


def held_out(found: Fit, folds: np.ndarray) -> np.ndarray:
    """Squares of each block and window as predicted without the fold it is in, (blocks, windows).

    `folds` (blocks, windows) numbers them. The estimate without a fold is theta - (H - H_k)^-1 g_k; the residual is
    taken to first order there. The states at the starts stay, and so do entries at their bounds.
    """
    cost, count = found.sums.cost.sum(-1), len(found.free)
    gradient, matrix = found.sums.gradient[..., :count], found.sums.matrix[..., :count, :count]
    whole, answer = matrix.sum((0, 1)), np.zeros(folds.shape)
    keep = (found.free >= 0) & (np.diag(whole) > 0)
    for fold in np.unique(folds):
        mine = folds == fold
        left = (whole - matrix[mine].sum(0))[np.ix_(keep, keep)]
        size = np.sqrt(np.maximum(np.diag(left), 1e-300))
        change = np.zeros(count)
        right = -gradient[mine].sum(0)[keep] / size
        change[keep] = np.linalg.lstsq(left / np.outer(size, size), right, rcond=1e-12)[0] / size
        first, second = gradient @ change, np.einsum("p,bwpr,r->bw", change, matrix, change)
        answer = np.where(mine, cost - 2 * first + second, answer)
    return answer
