r"""Maximising a function of a motion's rows within limits.

Few linear rows: sequential quadratic programming (SLSQP). Rows of torque, or thousands of linear ones: the augmented
Lagrangian $f + \sum \max(0, \lambda + \mu c)^2 / 2\mu$ (Nocedal and Wright 2006, section 17.4) by L-BFGS-B, which finds
the rows that matter, and then sequential quadratic programming with these alone, others joining as they are violated.
Objective and torques come from one pass over the rows. Limits are kept at the samples of the design, tightened by what
the motion exceeds them between, and at last the motion is made smaller until it meets them at 1 kHz.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .information import Learned
from .limits import KINDS, Limits
from .motions import Basis, Trajectory
from .sampling import Sampler

__all__ = ["FEW_ROWS", "GramObjective", "Problem", "solve"]

# f and its gradient by the (symmetric) Gram matrix of the weighted rows
GramObjective = Callable[[Float[np.ndarray, "n n"]], tuple[float, Float[np.ndarray, "n n"]]]

FEW_ROWS = 600  # linear rows that SLSQP takes
OUTER, INNER = 8, 40
AGAIN = 4  # outer steps from multipliers that are nearly right
PENALTY, GROWTH = 10.0, 3.0
NEAR = 0.05  # m: a distance that misses its margin by this violates it as much as a whole limit
CLOSE = 2e-3  # of a limit, at the samples of the design
ROUNDS, POLISHED = 8, 30  # times that rows join a sequential programme, and its steps
REACH = 1.5  # rad (or at 2 rad/s, 8 rad/s^2) that such a programme changes a number
ENDED = 1e-5  # of the objective, below which nothing more is gained
WITHIN = 0.15  # of a limit: rows nearer to it than this are in
MANY = 900  # rows that are too many for it


@dataclass
class _Seen:
    """What the gradient at a point takes from its value."""

    x: np.ndarray
    states: np.ndarray
    shape: tuple[int, ...]
    own: np.ndarray
    by_gram: np.ndarray
    rows: np.ndarray
    by_torque: np.ndarray | None = None
    by_position: np.ndarray | None = None  # of the distances
    slope: np.ndarray | float = 0.0


@dataclass
class Problem:
    """A function of the Gram matrix of a motion's rows, and the limits of the motion.

    The numbers of a motion are the start (where it is free) and the weights, joint by joint.
    """

    learned: Learned
    sampler: Sampler
    objective: GramObjective
    columns: np.ndarray  # columns of the sampler that the Gram matrix is of
    basis: Basis
    limits: Limits
    start: Float[np.ndarray, " nv"] | None  # None: free
    rate: float = 20.0  # Hz, of the rows
    shifts: tuple[float, ...] = ()  # s: torques of so long before are further columns
    samples: int | None = None  # at which these many are evaluated, each for several; None: at all
    evaluations: int = 0
    _seen: _Seen | None = None

    def __post_init__(self) -> None:
        every = self.basis.instants(self.rate)
        count = len(every) if self.samples is None else self.samples
        times = every if self.samples is None else (np.arange(count) + 0.5) / count * self.basis.duration
        self.count = count
        late = [np.maximum(times - shift, 0.0) for shift in self.shifts if shift > 0]
        self.matrix = self.basis.at(np.concatenate([times, *late]))
        self.nv = self.learned.robot.nv
        weight = np.asarray(self.learned.weight)
        self.measured = np.flatnonzero(weight > 0)  # coordinates whose rows count
        self.root = np.sqrt(weight[self.measured] * len(every) / count)
        self.moved = np.ones(self.nv)
        self.moved[list(self.learned.held)] = 0.0
        first, *others = self.basis.peaks(self.rate)
        peaks = (first if self.start is not None else np.append(0.0, first), *others)
        self.rows = [
            (kind, self.basis.at(times)[k])
            for k, (kind, times) in enumerate(zip(KINDS, peaks, strict=False))
            if np.isfinite(self.limits.of(kind)).any()
        ]
        self.torque = np.isfinite(self.limits.torque).any()

    def trajectory(self, x: Float[np.ndarray, " n"]) -> Trajectory:
        """The motion of the numbers x."""
        start, weights = self._split(x)
        return Trajectory(start, weights, self.basis)

    def numbers(self, motion: Trajectory) -> Float[np.ndarray, " n"]:
        """The numbers of a motion."""
        own = [] if self.start is not None else [np.asarray(motion.start)]
        return np.concatenate([*own, np.asarray(motion.weights).ravel()])

    def _split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        start = x[: self.nv] if self.start is None else self.start
        return start, x[len(x) - self.nv * self.basis.size :].reshape(self.nv, -1)

    def states(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "3 samples nv"]:
        """q, v, a at the samples of the design."""
        start, weights = self._split(x)
        out = self.matrix @ weights.T
        out[0] += start
        return out

    def to_numbers(self, by_states: Float[np.ndarray, "3 samples nv"]) -> Float[np.ndarray, " n"]:
        """Gradient by the numbers, of one by the states."""
        by_states = by_states * self.moved
        weights = np.einsum("ksb,ksj->jb", self.matrix, by_states).ravel()
        return weights if self.start is not None else np.concatenate([by_states[0].sum(0), weights])

    def gram(self, rows: Float[np.ndarray, "nv columns samples"]) -> tuple[np.ndarray, np.ndarray]:
        """Weighted rows (columns that count, then late torques; joints and samples), and their Gram matrix."""
        own = rows.swapaxes(0, 1)[self.columns][:, self.measured, : self.count]
        if self.shifts:
            torque = np.asarray(self.learned.theta) @ rows[:, : len(self.learned.theta)]
            late = torque.reshape(self.nv, len(self.shifts), self.count).swapaxes(0, 1)
            own = np.concatenate([own, late[:, self.measured]])
        flat = (own * self.root[:, None]).reshape(len(own), -1)
        return flat, flat @ flat.T

    def value(self, x: Float[np.ndarray, " n"]) -> float:
        """The objective."""
        return self.lagrangian(x, None)

    def slope(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Its gradient."""
        return self.gradient(x, None)

    def lagrangian(self, x: Float[np.ndarray, " n"], penalty: Penalty | None) -> float:
        """The objective with what the penalty makes of the limits."""
        self.evaluations += 1
        states = self.states(x)
        rows = self.sampler.rows(states)
        own, gram = self.gram(rows)
        value, by_gram = self.objective(gram)
        self._seen = _Seen(x.copy(), states, rows.shape, own, by_gram, rows)
        if penalty is not None:
            if self.limits.clearance is not None:
                distance, back = self.limits.clearance.with_gradient(states[0, : self.count])
                more, slope = penalty.one_sided("clearance", (self.limits.clearance.margin - distance) / NEAR)
                value += more
                self._seen.by_position = back(-slope / NEAR)
            if self.torque:
                torque = (np.asarray(self.learned.theta) @ rows[:, : len(self.learned.theta)]).T
                more, self._seen.by_torque = penalty.of("torque", torque / self.limits.torque)
                value += more
            more, self._seen.slope = self._linear(x, penalty)
            value += more
        return value

    def gradient(self, x: Float[np.ndarray, " n"], penalty: Penalty | None) -> Float[np.ndarray, " n"]:
        """Gradient of `lagrangian`; what was computed for its value at the same point is not computed again."""
        if self._seen is None or not np.array_equal(self._seen.x, x):
            self.lagrangian(x, penalty)
        seen = self._seen
        assert seen is not None
        nv, columns, samples = seen.shape
        cotangent, theta = np.zeros((columns, nv, samples)), np.asarray(self.learned.theta)
        by_own = ((2.0 * seen.by_gram) @ seen.own).reshape(-1, len(self.measured), self.count) * self.root[:, None]
        by_rows = np.zeros((len(by_own), nv, self.count))
        by_rows[:, self.measured] = by_own
        cotangent[self.columns, :, : self.count] = by_rows[: len(self.columns)]
        by_torque = np.zeros((nv, samples))
        if self.shifts:
            by_torque += by_rows[len(self.columns) :].swapaxes(0, 1).reshape(nv, samples)
        if seen.by_torque is not None:
            by_torque += (seen.by_torque / self.limits.torque).T
        if by_torque.any():
            cotangent[: len(theta)] += by_torque * theta[:, None, None]
        by_states = self.sampler.back(seen.states, cotangent.swapaxes(0, 1))
        if seen.by_position is not None:
            by_states[0, : self.count] += seen.by_position
        return self.to_numbers(by_states) + seen.slope

    def forget(self) -> None:
        """The multipliers have changed, and with them the value at every point."""
        self._seen = None

    def torque_shares(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "samples nv"]:
        """Torques as shares of their limits."""
        if self._seen is None or not np.array_equal(self._seen.x, x):
            self.lagrangian(x, None)
        assert self._seen is not None
        theta = np.asarray(self.learned.theta)
        return (theta @ self._seen.rows[:, : len(theta)]).T / self.limits.torque

    def torque_slopes(
        self, x: Float[np.ndarray, " n"], samples: np.ndarray, joints: np.ndarray
    ) -> Float[np.ndarray, "rows n"]:
        """Gradient of some of `torque_shares`."""
        states, theta = self.states(x), np.asarray(self.learned.theta)
        out = np.zeros((len(samples), len(x)))
        for j in np.unique(joints):
            cotangent = np.zeros((self.sampler.columns, self.nv, states.shape[1]))
            cotangent[: len(theta), j] = theta[:, None] / self.limits.torque[j]
            some = np.flatnonzero(joints == j)
            by = self.sampler.back(states, cotangent.swapaxes(0, 1))[:, samples[some]]
            out[some] = self._numbers_of_each(by, samples[some])
        return out

    def distances(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "samples rows"]:
        """What the distances leave of the margin, in units of `NEAR`."""
        clearance = self.limits.clearance
        if clearance is None or not clearance.rows.names:
            return np.zeros((self.count, 0))
        return (clearance.distances(self.states(x)[0, : self.count]) - clearance.margin) / NEAR

    def distance_slopes(
        self, x: Float[np.ndarray, " n"], samples: np.ndarray, pairs: np.ndarray
    ) -> Float[np.ndarray, "rows n"]:
        """Gradient of some of `distances`."""
        out = np.zeros((len(samples), len(x)))
        if not len(samples):
            return out
        clearance, states = self.limits.clearance, self.states(x)[0]
        assert clearance is not None
        near, back = clearance.with_gradient(states[samples])  # a posture for each row
        chosen = np.zeros_like(near)
        chosen[np.arange(len(samples)), pairs] = 1.0 / NEAR
        by = np.zeros((3, len(samples), self.nv))
        by[0] = back(chosen)
        return self._numbers_of_each(by, samples)

    def _numbers_of_each(self, by: Float[np.ndarray, "3 rows nv"], samples: np.ndarray) -> Float[np.ndarray, "rows n"]:
        """Gradients by the numbers of rows that each depend on one sample."""
        by = by * self.moved
        weights = np.einsum("krb,krj->rjb", self.matrix[:, samples], by).reshape(len(samples), -1)
        return weights if self.start is not None else np.concatenate([by[0], weights], axis=1)

    def shares(self, x: Float[np.ndarray, " n"]) -> dict[str, Float[np.ndarray, "rows nv"]]:
        """Position (from the middle), velocity and acceleration as shares of their limits."""
        start, weights = self._split(x)
        out = {}
        for kind, functions in self.rows:
            moved = functions @ weights.T
            out[kind] = (moved + (start - self.limits.middle if kind == "position" else 0.0)) / self.limits.of(kind)
        return out

    def _linear(self, x: np.ndarray, penalty: Penalty) -> tuple[float, np.ndarray]:
        shares, value = self.shares(x), 0.0
        by_start, by_weights = np.zeros(self.nv), np.zeros((self.nv, self.basis.size))
        for kind, functions in self.rows:
            more, slope = penalty.of(kind, shares[kind])
            value, slope = value + more, slope / self.limits.of(kind)
            by_weights += slope.T @ functions
            by_start += slope.sum(0) * (kind == "position")
        own = [] if self.start is not None else [by_start]
        return value, np.concatenate([*own, by_weights.ravel()])

    def linear_matrix(self, margin: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """A and b with A x <= b where position, velocity and acceleration keep their limits, less a margin."""
        free, size = (self.nv if self.start is None else 0), self.basis.size
        blocks, bounds = [], []
        for kind, functions in self.rows:
            limit = self.limits.of(kind)
            for j in np.flatnonzero(np.isfinite(limit)):
                block = np.zeros((len(functions), free + self.nv * size))
                block[:, free + j * size : free + (j + 1) * size] = functions / limit[j]
                offset = 0.0
                if kind == "position":
                    if free:
                        block[:, j] = 1.0 / limit[j]
                        offset = -self.limits.middle[j] / limit[j]
                    else:
                        assert self.start is not None
                        offset = (self.start[j] - self.limits.middle[j]) / limit[j]
                blocks += [block, -block]
                room = 1.0 - margin.get(kind, 0.0)
                bounds += [np.full(len(functions), room - offset), np.full(len(functions), room + offset)]
        size = free + self.nv * size
        return (np.concatenate(blocks), np.concatenate(bounds)) if blocks else (np.zeros((0, size)), np.zeros(0))


class Penalty:
    """Multipliers of all rows, both signs, and the margin that each kind keeps."""

    def __init__(self, margin: dict[str, float] | None = None) -> None:
        self.mu, self.margin, self.warm = PENALTY, margin or {}, False
        self.multipliers: dict[str, np.ndarray] = {}
        self.violation: dict[str, np.ndarray] = {}

    def one_sided(self, kind: str, excess: Float[np.ndarray, "rows k"]) -> tuple[float, Float[np.ndarray, "rows k"]]:
        """Value and gradient by what exceeds a bound."""
        beyond = excess + self.margin.get(kind, 0.0)
        self.violation[kind] = beyond
        lam = self._of(kind, beyond)
        push = np.maximum(0.0, lam + self.mu * beyond)
        return float(((push**2).sum() - (lam**2).sum()) / (2 * self.mu)), push

    def of(self, kind: str, share: Float[np.ndarray, "rows nv"]) -> tuple[float, Float[np.ndarray, "rows nv"]]:
        """Value and gradient by the shares."""
        both = np.stack([share, -share]) - (1.0 - self.margin.get(kind, 0.0))
        self.violation[kind] = both
        lam = self._of(kind, both)
        push = np.maximum(0.0, lam + self.mu * both)
        return float(((push**2).sum() - (lam**2).sum()) / (2 * self.mu)), push[0] - push[1]

    def _of(self, kind: str, like: np.ndarray) -> np.ndarray:
        """Multipliers of a kind; none yet where they were those of fewer samples."""
        if kind not in self.multipliers or self.multipliers[kind].shape != like.shape:
            self.multipliers[kind] = np.zeros_like(like)
        return self.multipliers[kind]

    def step(self) -> float:
        """Multipliers of the point last seen; the largest violation there."""
        for kind, violation in self.violation.items():
            self.multipliers[kind] = np.maximum(0.0, self.multipliers[kind] + self.mu * violation)
        return max((float(v.max()) for v in self.violation.values()), default=0.0)


def solve(
    problem: Problem,
    x: Float[np.ndarray, " n"],
    penalty: Penalty | None = None,
    *,
    iterations: int = 200,
    polish: bool = True,
) -> Float[np.ndarray, " n"]:
    """The numbers of the best motion found from x, within the limits at the samples of the design.

    `penalty` holds the margins to be kept; one that has served already (for fewer samples or smaller margins) is where
    the multipliers begin, and is changed. `polish`: not only near the best, which takes as long again.
    """
    penalty = Penalty() if penalty is None else penalty
    A, b = problem.linear_matrix(penalty.margin)
    if len(b) <= FEW_ROWS and not penalty.warm:
        found = _sequential(problem, x, A, b, iterations)
        if _meets_the_rest(problem, found, penalty.margin):
            return found
        x = found
    found = _augmented(problem, x, penalty)
    clearance = problem.limits.clearance  # its rows are dear, and gain little
    if not polish or (clearance is not None and clearance.rows.names):
        return found
    return _polished(problem, found, penalty, A, b)


def _polished(problem: Problem, x: np.ndarray, penalty: Penalty, A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A motion near its limits, improved with the rows that are near them; as it was where these do not settle."""
    from scipy.optimize import minimize  # slow to import

    rows, best, reach = _Near(problem, penalty.margin, A, b), x, REACH
    for _ in range(ROUNDS):
        if rows.joined(x) > MANY:
            return best
        kept = {"type": "ineq", "fun": rows.room, "jac": rows.slopes}
        options = {"maxiter": POLISHED, "ftol": 1e-6}
        box = np.stack([best - reach, best + reach], axis=1)  # rows that are not in know nothing of what lies beyond
        begin = np.clip(x, *box.T)
        tried = minimize(
            problem.value, begin, jac=problem.slope, method="SLSQP", bounds=box, constraints=[kept], options=options
        ).x
        worst, before = rows.worst(tried), problem.value(best)
        if not np.isfinite(worst) or worst > WITHIN:
            reach /= 3
        elif worst >= CLOSE:
            x = tried
        elif problem.value(tried) < before - ENDED or rows.worst(best) >= CLOSE:
            x = best = tried
        else:
            break
    return best


class _Near:
    """Rows that are near their limits, or have been: their room and its slopes."""

    def __init__(self, problem: Problem, margin: dict[str, float], A: np.ndarray, b: np.ndarray) -> None:
        self.problem, self.margin, self.A, self.b = problem, margin, A, b
        self.linear = np.zeros(len(b), bool)
        self.torque = np.zeros((problem.count, problem.nv), bool)
        self.distance = np.zeros(np.shape(problem.distances(np.zeros(A.shape[1]))), bool)

    def _rooms(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        torque = np.full(self.torque.shape, np.inf)
        if self.problem.torque:
            torque = 1.0 - self.margin.get("torque", 0.0) - np.abs(self.problem.torque_shares(x)[: len(torque)])
        distance = self.problem.distances(x) - self.margin.get("clearance", 0.0)
        return self.b - self.A @ x, torque, distance

    def joined(self, x: np.ndarray) -> int:
        """Take in what is near its limit at x; how many rows there are."""
        linear, torque, distance = self._rooms(x)
        self.linear |= linear < WITHIN
        self.torque |= torque < WITHIN
        self.distance |= distance < 2 * WITHIN
        return int(self.linear.sum() + self.torque.sum() + self.distance.sum())

    def worst(self, x: np.ndarray) -> float:
        """The largest violation of any row at x."""
        return max((-float(room.min()) for room in self._rooms(x) if room.size), default=0.0)

    def room(self, x: np.ndarray) -> np.ndarray:
        linear, torque, distance = self._rooms(x)
        return np.concatenate([linear[self.linear], torque[self.torque], distance[self.distance]])

    def slopes(self, x: np.ndarray) -> np.ndarray:
        parts = [-self.A[self.linear]]
        if self.torque.any():
            at = np.nonzero(self.torque)
            sign = np.sign(self.problem.torque_shares(x)[at])
            parts.append(-sign[:, None] * self.problem.torque_slopes(x, *at))
        parts.append(self.problem.distance_slopes(x, *np.nonzero(self.distance)))
        return np.concatenate(parts)


def _meets_the_rest(problem: Problem, x: np.ndarray, margin: dict[str, float]) -> bool:
    """Whether torques and distances keep their limits, which SLSQP was not told."""
    states, clearance = problem.states(x), problem.limits.clearance
    if clearance is not None and clearance.rows.names:
        if clearance.distances(states[0, : problem.count]).min() < clearance.margin + NEAR * margin.get(
            "clearance", 0.0
        ):
            return False
    if not problem.torque:
        return True
    torque = problem.sampler.torque(states, np.asarray(problem.learned.theta))
    return bool((np.abs(torque) / problem.limits.torque).max() <= 1.0 - margin.get("torque", 0.0))


def _sequential(problem: Problem, x: np.ndarray, A: np.ndarray, b: np.ndarray, iterations: int) -> np.ndarray:
    from scipy.optimize import minimize  # slow to import

    rows = {"type": "ineq", "fun": lambda x: b - A @ x, "jac": lambda x: -A}
    options = {"maxiter": iterations, "ftol": 1e-6}
    kept = [rows] if len(b) else []
    return minimize(problem.value, x, jac=problem.slope, method="SLSQP", constraints=kept, options=options).x


def _augmented(problem: Problem, x: np.ndarray, penalty: Penalty) -> np.ndarray:
    from scipy.optimize import minimize  # slow to import

    before, again, stuck = np.inf, penalty.warm, 0
    options = {"maxiter": INNER, "maxcor": 20}
    for outer in range(AGAIN if again else OUTER):
        problem.forget()
        x = minimize(problem.lagrangian, x, args=(penalty,), jac=problem.gradient, method="L-BFGS-B", options=options).x
        problem.lagrangian(x, penalty)  # the rows of the point itself
        worst = penalty.step()
        if worst < CLOSE and (again or outer >= 2):
            break
        stuck = stuck + 1 if worst > 0.9 * before else 0
        if stuck >= 2 and not again:  # between samples something is in the way: more of them show it
            penalty.multipliers.clear()
            penalty.mu = PENALTY * GROWTH
            break
        if worst > 0.5 * before:
            penalty.mu *= GROWTH
        before = worst
    penalty.warm = True
    return x
