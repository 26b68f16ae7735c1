"""What a robot carries for a part of a recording: it grips a body, and lets it go.

The torque of a small body, on a link that carries no other, is sought where a fit of the baseline leaves most of it. It
has a name where what slices of such a stretch tell of the body foretells the others, about as well as what each joint
may have changed by for itself, and takes far more than a body of negative mass does anywhere, which none is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from scipy.special import stdtr

from ..estimation.joint_rows import JointRows
from ..recordings.signals import Signals
from ..recordings.stacked import open_rows
from ..results import Cause, Diagnosis, Estimate, Gain, Name, Verdict
from ..rigid.model import RobotModel
from .constancy import fitted_recordings, shown_of_many
from .holdout import kept_out_error, predicted
from .layout import FOLDS, QUARTERS
from .problem import Problem
from .repeats import foretold_by_others
from .setting import weighed_by_residual
from .shifts import rigid_torque
from .state import State
from .step import Step

__all__ = ["LOAD", "Carried", "carried_in_part", "error_with", "torque_of", "with_loads", "without_loads"]

LOAD = "payload"
MOST_OF_ALL = 0.75  # of a recording: where a longer stretch is the best, all of it is unlike the others
CELLS = 40  # of a recording, at whose edges stretches begin and end
FINE = 33  # moments around an edge, up to those next to it, of which the best is taken
MOST = 24  # stretches
MOST_REFUSED = 3
FEWEST_BLOCKS = 4  # of a stretch: its slices foretell each other
RIDGE = 1e-4  # of a column's squares
REACH = 0.3  # m, deviation of the centre of mass from the origin of its link as it is believed before
LEAST_GAIN = 16.0  # squares that a body takes, those of the noise being 1
T = 2.0  # of what the other slices foretell, over the blocks of a stretch
FORETOLD = 0.5  # of the squares that are left in a stretch, at the joint where it is most
SECOND = 0.1  # of the squares foretold, at the joint where they are most but one: else that joint alone has changed
ALONE = 0.9  # of the squares that constants, friction and gains of the joints foretell, which are four numbers each
STILL = 0.3  # of the squares foretold, or beside the body these foretell so little
BESIDE = 5.0  # times what a body of negative mass takes anywhere
SETTLES = 0.2  # s beside either end: what is gripped weighs on the hand bit by bit
ROUNDS, STEPS, STEADY = 3, 30, 1e-9
REVERSAL = 0.05  # of a joint's RMS speed: half width in which friction turns


class Carried(NamedTuple):
    """A body that the robot carries in a stretch of a recording."""

    link: int
    recording: int
    rows: tuple[int, int]  # of the recording, from the first to that behind the last
    ends: tuple[bool, bool]  # whether it is gripped, and let go, in the course of the recording
    body: Float[np.ndarray, " 4"]  # mass, kg, and centre of mass in the link's joint frame, m
    deviation: Float[np.ndarray, " 4"]
    others: Float[np.ndarray, "slices 4"]  # the same as all but one slice of the stretch tell it
    slices: Int[np.ndarray, " rows"]  # of the stretch, -1 where none
    p_value: float  # of what the slices foretell

    def span(self, one: Signals) -> tuple[float, float]:
        """From when to when, s on the clock of the recording."""
        t, (a, b) = one.rows.row_times, self.rows
        begins = 0.5 * (t[a - 1] + t[a]) if self.ends[0] else one.time[0]
        return float(begins), float(0.5 * (t[b - 1] + t[b]) if self.ends[1] else one.time[-1])

    def torque(self, model: RobotModel, one: Signals, body: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "samples nv"]:
        """Torque of such a body, N m or N, zero outside the stretch."""
        begins, ends = self.span(one)
        there, inertia = (one.time >= begins) & (one.time <= ends), np.zeros((len(model.joints), 10))
        inertia[self.link] = _parameters(body)
        loaded = eqx.tree_at(lambda m: m.inertia, model, inertia)
        motion = (np.asarray(x)[there] for x in (one.position, one.velocity, one.acceleration))
        out = np.zeros(np.shape(one.velocity))
        out[there] = rigid_torque(loaded, *motion)
        return out


def carried_in_part(problem: Problem, start: State) -> tuple[Carried, ...]:
    """The bodies that the robot surely carries in a stretch of a recording, and not in all of it.

    The stretches are those of fitted recordings. A load that a recording has from its beginning to its end is none.
    """
    step, _ = weighed_by_residual(problem, start)
    rows, joints = _Rows.of(step), problem.model.joints
    links = [k for k in range(len(joints)) if not any(other.parent == k for other in joints)]
    spans = [(number, np.flatnonzero(used)) for number, used in fitted_recordings(problem, step.rows.block)]
    found: list[_Stretch] = []
    refused: list[_Stretch] = []
    while len(found) < MOST and len(refused) < MOST_REFUSED:
        bare, known = rows.without(found), [*found, *refused]
        each = [one for link in links for one in _stretches(bare, step.rows.block, spans, link, known)]
        best = max(each, key=lambda one: one.gain, default=None)
        if best is None or best.gain < LEAST_GAIN:
            break
        if _foretold(problem, step, bare, best) is None:
            refused.append(best)
            continue
        found.append(best)
        for _ in range(ROUNDS):
            found = [rows.without([*found[:k], *found[k + 1 :]]).fitted_anew(one) for k, one in enumerate(found)]
    while found:
        least = min(found, key=lambda one: one.gain)
        if least.gain > BESIDE * _of_none(rows.without(found), step.rows.block, spans, links):
            break
        found.remove(least)
    sure = [_told_of(problem, step, rows.without([x for x in found if x is not one]), one) for one in found]
    return tuple(sorted((one for one in sure if one is not None), key=lambda one: (one.recording, one.rows)))


class _Stretch(NamedTuple):
    """A stretch of rows, on the axis of all, and the body that takes most of what is left there."""

    link: int
    recording: int
    rows: tuple[int, int]
    ends: tuple[bool, bool]
    body: Float[np.ndarray, " 4"]
    gain: float  # squares

    @property
    def here(self) -> slice:
        return slice(*self.rows)


class _Rows(NamedTuple):
    """Rows of the baseline, weighed by what it leaves, what it leaves of them, and a root of its covariance."""

    X: JointRows
    root: Float[np.ndarray, "P P"]
    residual: Float[np.ndarray, "nv T"]

    @classmethod
    def of(cls, step: Step) -> _Rows:
        X, among = step.rows.X, step.rows.X.squares() + np.diag(step.state.prior.precision)
        values, vectors = np.linalg.eigh(np.linalg.inv(among + 1e-9 * np.diag(np.maximum(np.diag(among), 1e-9))))
        root, e = vectors * np.sqrt(np.maximum(values, 0.0)), step.linear.residual
        pull = X.pulled(e) - step.linear.pull  # repeats are instruments: theirs is not the least residual
        return cls(X, root, e - X @ (root @ (root.T @ pull)))

    def beside(self, torque: Float[np.ndarray, "nv T"]) -> Float[np.ndarray, "nv T"]:
        """What the baseline leaves of a torque."""
        return torque - self.X @ (self.root @ (self.root.T @ self.X.pulled(torque)))

    def without(self, found: Sequence[_Stretch]) -> _Rows:
        """The rows without what has been found, to which the baseline gives way."""
        if not found:
            return self
        torque = sum(self.torque(one, one.body) for one in found)
        return self._replace(residual=self.residual - self.beside(np.asarray(torque)))

    def torque(self, one: _Stretch, body: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "nv T"]:
        """Rows of the torque of a body in a stretch."""
        out, theta = np.zeros_like(self.residual), _parameters(body)
        for own, torque in zip(self.X.own, out, strict=True):
            at = slice(*np.searchsorted(own.place, (10 * one.link, 10 * one.link + 10)).tolist())
            torque[one.here] = own.columns[one.here, at] @ theta[own.place[at] - 10 * one.link]
        return out

    def sums(self, link: int, edges: Int[np.ndarray, " cells+1"]) -> _Sums:
        """Of the rows between edges, those in turn."""
        across, pull = np.zeros((len(edges) - 1, 10, self.X.width)), np.zeros((len(edges) - 1, 10))
        for own, e in zip(self.X.own, self.residual, strict=True):
            at = slice(*np.searchsorted(own.place, (10 * link, 10 * link + 10)).tolist())
            where = own.place[at] - 10 * link
            for k, (a, b) in enumerate(pairwise(edges) if len(where) else ()):
                columns = own.columns[a:b, at].T
                across[k][np.ix_(where, own.place)] += columns @ own.columns[a:b]
                pull[k, where] += columns @ e[a:b]
        return _Sums(across[:, :, 10 * link : 10 * link + 10], across @ self.root, pull)

    def fitted_anew(self, one: _Stretch) -> _Stretch:
        """A stretch with the body that takes most of what is left now."""
        body, gain = self.sums(one.link, np.array(one.rows)).fitted(one.body)
        return one._replace(body=body, gain=gain)


class _Sums(NamedTuple):
    """Products of a link's ten columns with each other, the baseline and the residual, by cells of rows."""

    squares: Float[np.ndarray, "cells 10 10"]
    turned: Float[np.ndarray, "cells 10 P"]  # with the baseline's columns, which its root makes independent
    pull: Float[np.ndarray, "cells 10"]

    def best(self, a: Int[np.ndarray, " pairs"], b: Int[np.ndarray, " pairs"], sign: int = 1) -> tuple[int, float]:
        """Of stretches from edge to edge, that in which a mass (of this sign) takes most, and how much; -1 for none.

        What the body's extent adds is left out.
        """
        if not len(a):
            return -1, 0.0
        ends = [np.concatenate([np.zeros_like(x[:1]), np.cumsum(x, axis=0)])[:, :4] for x in self]
        squares, turned, pull = (x[b] - x[a] for x in ends)
        A = squares[:, :, :4] - turned @ np.swapaxes(turned, 1, 2)
        theta = np.linalg.solve(A + _ridge(A), pull[..., None])[..., 0]
        gain = np.where(sign * theta[:, 0] > 0, (pull * theta).sum(1), 0.0)
        best = int(np.argmax(gain))
        return best, float(gain[best])

    def normal(self) -> tuple[Float[np.ndarray, "10 10"], Float[np.ndarray, " 10"]]:
        """Normal equations of the ten columns in all cells, beside the baseline."""
        turned = self.turned.sum(0)
        return self.squares.sum(0) - turned @ turned.T, self.pull.sum(0)

    def fitted(self, body: Float[np.ndarray, " 4"] | None = None) -> tuple[Float[np.ndarray, " 4"], float]:
        """The small body that takes most of the squares, and how much: damped Gauss-Newton steps."""
        A, c = self.normal()
        if body is None:
            few = np.linalg.solve(A[:4, :4] + _ridge(A[:4, :4]), c[:4])
            body = np.array([few[0], *np.clip(few[1:] / max(few[0], 1e-3), -1.0, 1.0)])
        now, damping = _cost(A, c, body), 1e-3
        for _ in range(STEPS):
            slopes = _slopes(body)
            H = slopes.T @ A @ slopes + _BELIEVED
            g = slopes.T @ (c - A @ _parameters(body)) - _BELIEVED @ body
            moved = body + np.linalg.solve(H + damping * np.diag(np.diag(H) + 1e-9), g)
            then = _cost(A, c, moved)
            if then < now:
                body, settled, now, damping = moved, now - then < STEADY * abs(now), then, damping / 10
                if settled:
                    break
            else:
                damping *= 10
                if damping > 1e6:
                    break
        theta = _parameters(body)
        return body, float(2 * c @ theta - theta @ A @ theta)


_BELIEVED = np.diag([1e-9, *[REACH**-2] * 3])  # precision of a body


def _cost(A: Float[np.ndarray, "10 10"], c: Float[np.ndarray, " 10"], body: Float[np.ndarray, " 4"]) -> float:
    theta = _parameters(body)
    return float(theta @ A @ theta - 2 * c @ theta + body @ _BELIEVED @ body)


def _ridge(A: Float[np.ndarray, "*stretches k k"]) -> Float[np.ndarray, "*stretches k k"]:
    size = np.maximum(np.diagonal(A, axis1=-2, axis2=-1), 0.0)
    return (RIDGE * size + 1e-9)[..., None] * np.eye(A.shape[-1])


def _parameters(body: Float[np.ndarray, " 4"]) -> Float[np.ndarray, " 10"]:
    """Ten inertial parameters of a body without extent: mass (kg) and centre of mass (m)."""
    mass, x, y, z = body
    return mass * np.array([1.0, x, y, z, y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y])


def _slopes(body: Float[np.ndarray, " 4"]) -> Float[np.ndarray, "10 4"]:
    """Their derivatives by mass and centre of mass."""
    mass, x, y, z = body
    out = np.zeros((10, 4))
    out[:, 0] = _parameters(np.array([1.0, x, y, z]))
    out[1:4, 1:] = mass * np.eye(3)
    out[4:, 1] = mass * np.array([0, -y, 2 * x, -z, 0, 2 * x])
    out[4:, 2] = mass * np.array([2 * y, -x, 0, 0, -z, 2 * y])
    out[4:, 3] = mass * np.array([2 * z, 0, 2 * z, -x, -y, 0])
    return out


def _stretches(
    rows: _Rows,
    block: Int[np.ndarray, " T"],
    spans: Sequence[tuple[int, Int[np.ndarray, " rows"]]],
    link: int,
    known: Sequence[_Stretch],
) -> Iterator[_Stretch]:
    """The stretch of each recording, beside those that are known, in which a body on the link takes most."""
    for number, own in spans:
        edges, count = _edges(block, own)
        if count <= FEWEST_BLOCKS:
            continue
        a, b = np.triu_indices(len(edges), -(-FEWEST_BLOCKS * (len(edges) - 1) // count))
        free = np.ones(len(a), bool)
        for one in known:
            if (one.recording, one.link) == (number, link):
                free &= (edges[a] >= one.rows[1]) | (edges[b] <= one.rows[0])
        a, b = a[free], b[free]
        best, most = rows.sums(link, edges).best(a, b)
        if not most > 0 or edges[b[best]] - edges[a[best]] > MOST_OF_ALL * (edges[-1] - edges[0]):
            continue
        ends = bool(a[best] > 0), bool(b[best] < len(edges) - 1)
        near = [_near(edges, k, inside) for k, inside in zip((a[best], b[best]), ends, strict=True)]
        fine = np.unique(np.concatenate(near))
        a, b = (x.ravel() for x in np.meshgrid(*(np.searchsorted(fine, x) for x in near), indexing="ij"))
        a, b = a[b > a], b[b > a]
        best, most = rows.sums(link, fine).best(a, b)
        if not most > 0:
            continue
        between = int(fine[a[best]]), int(fine[b[best]])
        body, gain = rows.sums(link, np.array(between)).fitted()
        if body[0] > 0:
            yield _Stretch(link, number, between, ends, body, gain)


def _edges(block: Int[np.ndarray, " T"], own: Int[np.ndarray, " rows"]) -> tuple[Int[np.ndarray, " cells+1"], int]:
    """First row of each cell of a recording, whole blocks, and behind them its end; the number of blocks."""
    firsts = own[np.flatnonzero(np.diff(block[own], prepend=-2))]
    return np.append(firsts[:: -(-len(firsts) // CELLS)], own[-1] + 1), len(firsts)


def _near(edges: Int[np.ndarray, " cells+1"], k: int, inside: bool) -> Int[np.ndarray, " fine"]:
    """Rows around an edge; that at an end of the recording stays."""
    if not inside:
        return edges[[k]]
    return np.unique(np.linspace(edges[k - 1] + 1, edges[k + 1] - 1, FINE).astype(int))


def _of_none(
    rows: _Rows,
    block: Int[np.ndarray, " T"],
    spans: Sequence[tuple[int, Int[np.ndarray, " rows"]]],
    links: Sequence[int],
) -> float:
    """The most that a body of negative mass takes in a stretch: none is one, but noise and laws may look like it."""
    most = 0.0
    for _, own in spans:
        edges, _ = _edges(block, own)
        a, b = np.triu_indices(len(edges), 1)
        most = max(most, *(rows.sums(link, edges).best(a, b, -1)[1] for link in links))
    return most


class _Foretold(NamedTuple):
    others: Float[np.ndarray, "slices 4"]
    slices: Int[np.ndarray, " rows"]
    p_value: float


def _foretold(problem: Problem, step: Step, rows: _Rows, one: _Stretch) -> _Foretold | None:
    """What slices of a stretch, its blocks in turn, tell of the others; None where that does not make it a body."""
    block = step.rows.block[one.here]
    numbers = np.unique(block[block >= 0])
    if len(numbers) < FEWEST_BLOCKS:
        return None
    slices = np.where(block >= 0, (block - numbers[0]) % FOLDS, -1)
    edges = one.rows[0] + np.append(np.flatnonzero(np.diff(slices, prepend=-2)), len(slices))
    sums, of = rows.sums(one.link, edges), slices[edges[:-1] - one.rows[0]]
    others, foretold = [], np.zeros((len(rows.residual), len(slices)))
    for number in range(slices.max() + 1):
        body, _ = _Sums(*(x[of != number] for x in sums)).fitted(one.body)
        own = slices == number
        foretold[:, own] = rows.beside(rows.torque(one, body))[:, one.here][:, own]
        others.append(body)
    there, e = step.rows.y[:, one.here] != 0, rows.residual[:, one.here]
    before, left = there * e**2, there * (e - foretold) ** 2
    share = 1 - left.sum(1) / np.maximum(before.sum(1), 1e-300)
    joints = np.stack([(before - left)[:, block == number].sum(1) for number in numbers])
    each = joints.sum(1)
    t, second = _sure(each), int(np.argsort(joints.sum(0))[-2]) if joints.shape[1] > 1 else -1
    if not (share.max() > FORETOLD and t > T and min(body[0] for body in others) > 0) or second < 0:
        return None
    if joints[:, second].sum() < SECOND * each.sum() or _sure(joints[:, second]) < T:
        return None  # a change of one joint is as good
    after = rows.residual.copy()
    after[:, one.here] -= foretold
    alone, still = (_by_themselves(problem, step, x, one) for x in (rows.residual, after))
    if each.sum() < ALONE * alone and still > STILL * each.sum():
        return None
    return _Foretold(np.stack(others), slices, float(stdtr(len(each) - 1, -t)))


def _sure(each: Float[np.ndarray, " blocks"]) -> float:
    """Mean over its standard deviation, as blocks scatter."""
    return float(each.mean() * np.sqrt(len(each)) / max(float(each.std(ddof=1)), 1e-300))


def _by_themselves(problem: Problem, step: Step, residual: Float[np.ndarray, "nv T"], one: _Stretch) -> float:
    """Squares that a constant, a friction and a gain of each joint foretell in a stretch, beyond those that they
    foretell elsewhere in the recording: what they take of any stretch is a rest that the robot has always."""
    n, samples, count, nv = problem.records.shape
    sample = (problem.records.row_samples() + samples * np.arange(n)[:, None]).reshape(-1)
    at, block, total = problem.records.spans[one.recording], step.rows.block, 0.0
    first, torque = at.slot * count + at.row, step.rows.X @ step.state.theta
    row = np.arange(first, first + at.rows)
    row = row[block[row] >= 0]
    inside = (row >= one.rows[0]) & (row < one.rows[1])
    for joint in range(nv):
        foretold = []
        for here in (row[inside], row[~inside]):
            here = here[step.rows.y[joint, here] != 0]
            e, given = residual[joint, here], (problem.motion.velocity[sample[here], joint], torque[joint, here])
            v, tau = (x / max(float(np.sqrt((x**2).sum() / max(len(x), 1))), 1e-300) for x in given)
            F = np.stack([np.ones(len(v)), v, np.tanh(v / REVERSAL), tau], axis=1)
            left = e - foretold_by_others(e, F, block[here] % FOLDS)
            foretold.append((float((e**2).sum() - (left**2).sum()), len(here)))
        (own, rows), (others, more) = foretold
        total += max(0.0, own - max(0.0, others) * rows / max(more, 1))
    return total


def _told_of(problem: Problem, step: Step, rows: _Rows, one: _Stretch) -> Carried | None:
    """A stretch as it is told, beside all others; None where it is no body beside them."""
    one = rows.fitted_anew(one)
    foretold = _foretold(problem, step, rows, one)
    if foretold is None or one.body[0] <= 0:
        return None
    (A, _), slopes = rows.sums(one.link, np.array(one.rows)).normal(), _slopes(one.body)
    inverse = np.linalg.inv(slopes.T @ A @ slopes + _BELIEVED)
    left = rows.without([one])
    firsts = np.flatnonzero(np.diff(step.rows.block[one.here], prepend=-2))
    scores = inverse @ slopes.T @ left.sums(one.link, one.rows[0] + np.append(firsts, len(foretold.slices))).pull.T
    level = max(1.0, float((left.residual[:, one.here] ** 2).mean()))
    parts = np.stack([own.sum(1) for own in np.array_split(scores, QUARTERS, axis=1)])  # noise may be as slow as they
    slow = (parts**2).sum(0) * QUARTERS / (QUARTERS - 1)
    variance = np.maximum(np.maximum((scores**2).sum(1), slow), level * np.diag(inverse))
    at = problem.records.spans[one.recording]
    first = at.slot * problem.records.shape[2] + at.row
    span = one.rows[0] - first, one.rows[1] - first
    return Carried(one.link, one.recording, span, one.ends, one.body, np.sqrt(variance), *foretold)


def without_loads(model: RobotModel, signals: Sequence[Signals], loads: Sequence[Carried]) -> list[Signals]:
    """The recordings, of the torques without what the robot carries in part; rows next to its ends have no weight."""
    out = list(signals)
    for load in loads:
        one = out[load.recording]
        times, margin = one.rows.row_times, SETTLES + 0.5 / one.cutoff
        near = [np.abs(times - t) < margin for t, inside in zip(load.span(one), load.ends, strict=True) if inside]
        weight = np.where(np.any(near, axis=0)[:, None], 0.0, one.rows.weight)
        torque: Any = np.asarray(one.torque) - load.torque(model, one, load.body)
        out[load.recording] = replace(one, torque=torque, rows=eqx.tree_at(lambda r: r.weight, one.rows, weight))
    return out


def torque_of(
    problem: Problem, signals: Sequence[Signals], load: Carried, body: Float[np.ndarray, " 4"]
) -> Float[np.ndarray, "n N nv"]:
    """Torque of a body in the stretch of a load, at all samples of all recordings, N m or N."""
    at, out = problem.records.spans[load.recording], np.zeros(problem.records.torque.shape)
    out[at.slot, at.sample : at.sample + at.samples] = load.torque(problem.model, signals[load.recording], body)
    return out


def error_with(problem: Problem, step: Step, signals: Sequence[Signals] = (), loads: Sequence[Carried] = ()) -> float:
    """Relative RMS error on data not fitted, of recordings `without_loads` where these are foretold by other slices.

    Where recordings are kept out, of which no load is known, it is that of the fitted ones.
    """
    records, kept = problem.records, np.asarray(problem.records.judged)
    fitted = problem.held.any()
    error = (problem.torque - predicted(problem, step.state)) * kept if fitted else kept_out_error(problem, step)
    for load in loads:
        whole, at = torque_of(problem, signals, load, load.body), records.spans[load.recording]
        rows = slice(at.row + load.rows[0], at.row + load.rows[1])
        for number, body in enumerate(load.others):
            lacks = records.flat(whole - torque_of(problem, signals, load, body))
            own = open_rows(records, lacks, np.ones(len(records.omega)))[at.slot, rows]
            error[at.slot, rows] += own * kept[at.slot, rows] * (load.slices == number)[:, None]
    return float(np.sqrt((error**2).sum() / max(((problem.torque * kept) ** 2).sum(), 1e-300)))


def with_loads(
    answer: Diagnosis, loads: Sequence[Carried], gains: dict[int, Gain], model: RobotModel, signals: Sequence[Signals]
) -> Diagnosis:
    """The answer to recordings `without_loads`, with the loads as causes, one of each link; `gains` are by link."""
    if answer.rest.contradicts:  # nothing is named before that is settled
        return replace(
            answer, notes=(*answer.notes, f"a part of the torque looks like a load: {_when(loads, signals)}")
        )
    causes, notes = list(answer.causes), list(answer.notes)
    for link, gain in gains.items():
        own = [load for load in loads if load.link == link]
        name, note = Name(LOAD, (model.link_names[link],)), _when(own, signals)
        same = next((k for k, cause in enumerate(causes) if cause.name == name), None)
        if same is not None:  # a load of all recordings, beside which these are more
            causes[same] = replace(causes[same], note=f"{causes[same].note}; more of it {note}".removeprefix("; "))
            notes.append(f"{LOAD} at {name.at[0]}: more of it {note}")
            continue
        best = min(own, key=lambda load: load.deviation[0] / load.body[0])
        units = ("kg", "m", "m", "m")
        each = zip(("mass", "com_x", "com_y", "com_z"), best.body, best.deviation, units, strict=True)
        numbers = {key: Estimate(float(value), float(std), unit) for key, value, std, unit in each}
        which = f"; the numbers are those of {signals[best.recording].name}" if len(own) > 1 else ""
        more = f"carried {note}{which}; the extended model is without it: cut the recordings there and state its `load`"
        notes.append(f"{LOAD} at {name.at[0]} is {more}")
        confidence = 1 - min(load.p_value for load in own)
        causes.append(Cause(name, numbers, confidence, gain, (), len(causes) + 1, more))
    verdict: Verdict = "named" if answer.verdict in ("nothing", "named") else "named+rest"
    causes.sort(key=lambda c: c.gain.after**2 - c.gain.before**2)
    p_value = min(answer.p_value, *(load.p_value for load in loads))
    return replace(answer, verdict=verdict, causes=tuple(causes), p_value=p_value, notes=tuple(notes))


def _when(loads: Sequence[Carried], signals: Sequence[Signals]) -> str:
    """When something is carried, in words; of many stretches, the lightest and the heaviest."""
    said = []
    for k in sorted(shown_of_many(np.array([load.body[0] for load in loads]))):
        load, one = loads[k], signals[loads[k].recording]
        begins, ends = load.span(one)
        when = f"from {begins:.2f} s to {ends:.2f} s"
        if not all(load.ends):
            when = f"from {begins:.2f} s on" if load.ends[0] else f"up to {ends:.2f} s"
        said.append(f"in {one.name} {when}, {load.body[0]:.3g} +- {1.96 * load.deviation[0]:.2g} kg")
    return "; ".join(said)
