r"""Maximising a function of a motion's rows within limits.

Few linear rows: sequential quadratic programming (SLSQP). Rows of torque and distance, or thousands of linear ones: the
motion is improved from within (`interior`), then with the rows alone that are near their limits (`programming`). Limits
are kept at the samples of the design, tightened by what the motion exceeds them between, and at last the motion is made
smaller until it meets them at 1 kHz.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from .information import Learned
from .interior import BEGUN, from_within
from .limits import KINDS, Limits
from .motions import Basis, Trajectory
from .programming import Rows, at_rest, descend, drawn_in
from .sampling import Sampler

__all__ = ["FEW_ROWS", "GramObjective", "Problem", "polished", "solve", "within"]

# f and its gradient by the (symmetric) Gram matrix of the weighted rows
GramObjective = Callable[[Float[np.ndarray, "n n"]], tuple[float, Float[np.ndarray, "n n"]]]

FEW_ROWS = 600  # linear rows that SLSQP takes
STEPS = 200  # of a descent
ROUGH = 12  # steps up to which a descent only shows whether a motion is worth more
ROOM = 0.1  # share of its way to rest from which a motion is improved from within
NEAR = 0.05  # m: a distance that misses its margin by this violates it as much as a whole limit


@dataclass
class _Seen:
    """What the gradient at a point takes from its value."""

    x: np.ndarray
    states: np.ndarray
    by_gram: np.ndarray
    rows: np.ndarray  # in memory that the next point takes


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
    _seen: _Seen | None = field(default=None, init=False)
    _near: tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]] | None = None  # at a point, and back

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
        # new memory at each point would cost as much as the numbers that go there; what nothing writes stays zero
        shape, counted = (self.sampler.columns, self.nv, self.matrix.shape[1]), len(self.columns) + len(self.shifts)
        self._rows, self._cotangent = np.zeros(shape), np.zeros(shape)
        self._own = np.zeros((counted + 1, len(self.measured), self.count))  # the last for torques, in a gradient

    @property
    def linear_rows(self) -> int:
        """Rows of position, velocity and acceleration, both signs."""
        finite = (np.isfinite(self.limits.of(kind)).sum() * len(functions) for kind, functions in self.rows)
        return 2 * int(sum(finite))

    def trajectory(self, x: Float[np.ndarray, " n"]) -> Trajectory:
        """The motion of the numbers x; joints that are held stand still, whatever rounding a solve has left them."""
        start, weights = self._split(x)
        return Trajectory(start, weights * self.moved[:, None], self.basis)

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
        flat = self.matrix.reshape(-1, self.basis.size)
        weights = (by_states.reshape(-1, self.nv).T @ flat).ravel()
        return weights if self.start is not None else np.concatenate([by_states[0].sum(0), weights])

    def gram(self, rows: Float[np.ndarray, "nv columns samples"]) -> tuple[np.ndarray, np.ndarray]:
        """Weighted rows (columns that count, then late torques; joints and samples), and their Gram matrix."""
        own, by_columns = self._own[:-1], rows.swapaxes(0, 1)
        if self._whole:
            np.take(by_columns, self.columns, axis=0, out=own, mode="clip")  # "raise" would copy
        else:
            own[: len(self.columns)] = by_columns[self.columns][:, self.measured, : self.count]
        if self.shifts:
            torque = np.asarray(self.learned.theta) @ rows[:, : len(self.learned.theta)]
            late = torque.reshape(self.nv, len(self.shifts), self.count).swapaxes(0, 1)
            own[len(self.columns) :] = late[:, self.measured]
        own *= self.root[:, None]
        flat = own.reshape(len(own), -1)
        return flat, flat @ flat.T

    @property
    def _whole(self) -> bool:
        """Whether all rows of the sampler count."""
        return len(self.measured) == self.nv and not self.shifts

    def value(self, x: Float[np.ndarray, " n"]) -> float:
        """The objective."""
        self.evaluations += 1
        states = self.states(x)
        self._seen = None
        rows = self.sampler.rows(states, self._rows)
        value, by_gram = self.objective(self.gram(rows)[1])
        self._seen = _Seen(x.copy(), states, by_gram, rows)
        return value

    def _at(self, x: np.ndarray) -> _Seen:
        """What was computed at a point; the one last seen is not computed again."""
        if self._seen is None or not np.array_equal(self._seen.x, x):
            self.value(x)
        assert self._seen is not None
        return self._seen

    def slope(
        self,
        x: Float[np.ndarray, " n"],
        by_torque: Float[np.ndarray, "samples nv"] | None = None,
        by_distance: Float[np.ndarray, "samples rows"] | None = None,
    ) -> Float[np.ndarray, " n"]:
        """Its gradient; that of a sum where a further part has slopes by `torque_shares` and `distances`."""
        seen = self._at(x)
        shares = None if by_torque is None else np.ascontiguousarray((by_torque / self.limits.torque).T)
        by_rows = self._by_whole_rows(seen, shares) if self._whole else self._by_rows(seen, shares)
        by_states = self.sampler.back(seen.states, by_rows.swapaxes(0, 1))
        if by_distance is not None:
            self.distances(x)
            assert self._near is not None
            by_states[0, : self.count] += self._near[2](by_distance / NEAR)
        return self.to_numbers(by_states)

    def _by_whole_rows(self, seen: _Seen, by_torque: np.ndarray | None) -> Float[np.ndarray, "columns nv samples"]:
        """Gradient by the sampler's rows, where all of them count: one product of what counts and of the torque."""
        own, theta = self._own, np.asarray(self.learned.theta)
        factor = np.zeros((len(self._cotangent), len(own)))
        factor[self.columns, :-1] = 2.0 * seen.by_gram
        own[-1] = 0.0 if by_torque is None else by_torque / self.root[:, None]
        factor[: len(theta), -1] = theta
        np.matmul(factor, own.reshape(len(own), -1), out=self._cotangent.reshape(len(factor), -1))
        self._cotangent *= self.root[:, None]
        return self._cotangent

    def _by_rows(self, seen: _Seen, by_torque: np.ndarray | None) -> Float[np.ndarray, "columns nv samples"]:
        """The same where some joints are not measured, or late torques are among what counts."""
        cotangent, theta = np.zeros(self._cotangent.shape), np.asarray(self.learned.theta)
        own = self._own[:-1].reshape(len(seen.by_gram), -1)
        by_own = ((2.0 * seen.by_gram) @ own).reshape(-1, len(self.measured), self.count) * self.root[:, None]
        by_rows = np.zeros((len(by_own), self.nv, self.count))
        by_rows[:, self.measured] = by_own
        cotangent[self.columns, :, : self.count] = by_rows[: len(self.columns)]
        if self.shifts:
            late = by_rows[len(self.columns) :].swapaxes(0, 1).reshape(self.nv, -1)
            cotangent[: len(theta)] += late * theta[:, None, None]
        if by_torque is not None:
            cotangent[: len(theta), :, : self.count] += np.multiply.outer(theta, by_torque)
        return cotangent

    def torque_shares(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, "samples nv"]:
        """Torques as shares of their limits."""
        theta = np.asarray(self.learned.theta)
        return (theta @ self._at(x).rows[:, : len(theta)]).T / self.limits.torque

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
        if self._near is None or not np.array_equal(self._near[0], x):
            near, back = clearance.with_gradient(self.states(x)[0, : self.count])
            self._near = x.copy(), (near - clearance.margin) / NEAR, back
        return self._near[1]

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


def solve(problem: Problem, x: Float[np.ndarray, " n"], steps: int = STEPS) -> Float[np.ndarray, " n"]:
    """The numbers of the best motion found from x in so many steps, within the limits at the samples of the design."""
    if problem.linear_rows <= FEW_ROWS:
        found = _sequential(problem, x, *problem.linear_matrix({}), steps)
        if Rows(problem, {}).of_curved(found).min(initial=0.0) >= 0.0:
            return found
    if steps > ROUGH:
        x = within(problem, x)
    return descend(problem, drawn_in(problem, x, {}), {}, steps)


def within(problem: Problem, x: Float[np.ndarray, " n"], begun: float = BEGUN) -> Float[np.ndarray, " n"]:
    """A better motion from x, first made a little smaller; of position, velocity and acceleration it leaves some.

    `begun`: how strongly limits are felt before they are reached, at first.
    """
    x = drawn_in(problem, x, {})
    return from_within(problem, x + ROOM * (at_rest(problem, x, ROOM) - x), begun)


def polished(
    problem: Problem, x: Float[np.ndarray, " n"], margin: dict[str, float], steps: int
) -> Float[np.ndarray, " n"]:
    """A better motion near x, after so many steps along the limits at the most.

    `margin`: of each kind of limit, a share of it that is kept beyond (of distances, in units of `NEAR`).
    """
    if problem.linear_rows <= FEW_ROWS:
        found = _sequential(problem, x, *problem.linear_matrix(margin), steps)
        if Rows(problem, margin).of_curved(found).min(initial=0.0) >= 0.0:
            return found
    return descend(problem, drawn_in(problem, x, margin), margin, steps)


def _sequential(problem: Problem, x: np.ndarray, A: np.ndarray, b: np.ndarray, steps: int) -> np.ndarray:
    from scipy.optimize import minimize  # slow to import

    rows = {"type": "ineq", "fun": lambda x: b - A @ x, "jac": lambda x: -A}
    options = {"maxiter": steps, "ftol": 1e-6}
    kept = [rows] if len(b) else []
    return minimize(problem.value, x, jac=problem.slope, method="SLSQP", constraints=kept, options=options).x
