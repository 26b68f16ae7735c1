"""The search for a motion: from several starts, within limits that are checked at 1 kHz."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from .clearance import Clearance
from .information import Learned
from .limits import ALLOWED, Limits, Torque, Use, checked
from .motions import Basis, Trajectory
from .sampling import CHUNK, Sampler
from .solvers import FEW_ROWS, NEAR, ROUGH, STEPS, GramObjective, Problem, polished, solve, within

__all__ = ["Stage", "best_motion", "random_motion"]

TIGHTENED, TIGHTENING = 3, 40  # times that a motion is designed again with a margin, in how many steps
TRIED_SHORTLY = 8  # random motions that a start improves a little, the best of them then as far as it goes
WAVE, OVER = 8, 4  # samples of a wave, rows of a column: enough to look for a motion, which all samples then improve
TRIED, ROOMY = 400, 3  # random postures in which a motion may begin; one of so many that are clear does
TRIED_WITHIN, EXCHANGED = 5, 45  # random motions that a start improves from within; trials of others of one joint
APART = 2, 4  # the same where distances count, which cost as much as ten times the rest
GENTLY = 20.0  # how strongly limits are felt before they are reached, at the beginning of such a trial
CHECKED = 8  # motions, the best first, until none promises more than one that is feasible at 1 kHz
ROUNDING = 1e-6  # of a limit
CLEAR_RATE = 40.0  # Hz at which a random motion touches nothing: what begins on the wrong side of a body stays there
SMALLER = (1.0, 0.8, 0.6, 0.45, 0.3, 0.2, 0.1, 0.05, 0.02)  # shares of a random motion that are tried for that
FAR, SHRUNK = 2.0, 12  # of a torque limit, where a random motion may begin; times that it is made smaller for it
STEP = 0.98  # by which a motion is made smaller until it meets its limits


@dataclass(frozen=True)
class Stage:
    """One motion of a design."""

    motion: Trajectory
    uses: tuple[Use, ...]  # of each limit at 1 kHz
    logdet: float  # of the information of this motion, all before it, and the prior
    starts: tuple[float, ...]  # objective that each start reached
    evaluations: int
    clearance: Clearance | None = None  # the limits' own, its capsules fitted to the shapes in this motion

    @property
    def met(self) -> bool:
        """Whether every limit is met at 1 kHz, within a thousandth."""
        return all(use.met for use in self.uses)


def _free_start(limits: Limits, nv: int, generator: np.random.Generator) -> Float[np.ndarray, " nv"]:
    """A random posture in the middle half of the range; where distances count, one of those that leave most room."""
    reach = np.where(np.isfinite(limits.reach), limits.reach, np.pi)
    clearance = limits.clearance
    if clearance is None or not _distances_count(limits):
        return limits.middle + 0.5 * reach * generator.uniform(-1, 1, nv)
    tried = limits.middle + 0.5 * reach * generator.uniform(-1, 1, (TRIED, nv))
    near = clearance.distances(tried)
    least = near.min(axis=1)
    clear = np.flatnonzero(least >= clearance.margin)
    if len(clear):
        roomy = clear[np.argsort(-least[clear])][: max(1, len(clear) // ROOMY)]
        return tried[generator.choice(roomy)]
    best = int(least.argmax())
    raise InputError(
        f"limits.clearance: none of {TRIED} postures keeps {clearance.margin:g} m; in the best of them"
        f" {clearance.name(int(near[best].argmin()))} are {near[best].min():.3f} m apart. Lower the margin, or give a"
        " start and narrower limits.position"
    )


def random_motion(problem: Problem, generator: np.random.Generator, amplitude: float = 0.9) -> Float[np.ndarray, " n"]:
    """Numbers of a random motion that keeps its limits of position, velocity and acceleration."""
    limits, nv = problem.limits, problem.nv
    start = problem.start
    if start is None:
        start = _free_start(limits, nv, generator) * problem.moved
    weights = generator.standard_normal((nv, problem.basis.size)) * problem.moved[:, None]
    motion = Trajectory(start, weights, problem.basis)
    x = problem.numbers(motion)
    still = problem.shares(problem.numbers(Trajectory(start, 0 * weights, problem.basis)))
    shares = problem.shares(x)
    scale = np.full(nv, np.inf)
    for kind, share in shares.items():
        moved = share - still[kind]
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(moved > 0, 1 - still[kind], 1 + still[kind]) / np.abs(moved)
        scale = np.minimum(scale, np.nanmin(np.where(np.abs(moved) > 0, room, np.inf), axis=0))
    scale = amplitude * np.where(np.isfinite(scale), scale, 1.0)
    if not _distances_count(limits):
        return _within_torque(problem, problem.numbers(Trajectory(start, weights * scale[:, None], problem.basis)))
    for smaller in SMALLER:
        motion = Trajectory(start, weights * (smaller * scale)[:, None], problem.basis)
        if _clear(problem, motion):
            break
    return problem.numbers(motion)


def _within_torque(problem: Problem, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The motion made smaller where it takes many times a torque limit, as of one who stands: no solver leads back."""
    for _ in range(SHRUNK if problem.torque else 0):
        worst = float(np.abs(problem.torque_shares(x)).max())
        if worst <= FAR:
            break
        motion = problem.trajectory(x)
        x = problem.numbers(replace(motion, weights=np.asarray(motion.weights) * max(0.5, FAR / worst)))
    return x


def _distances_count(limits: Limits) -> bool:
    return limits.clearance is not None and bool(limits.clearance.rows.names)


def best_motion(
    torque: Torque,
    learned: Learned,
    rows: tuple[Sampler, np.ndarray | None, tuple[float, ...]],
    ways: Sequence[Sequence[GramObjective]],
    basis: Basis,
    limits: Limits,
    start: np.ndarray | None,
    starts: int,
    rate: float,
    generator: np.random.Generator,
    progress: Callable[[float], None] = lambda share: None,
) -> Stage:
    """The best of several random motions after each was improved; feasible at 1 kHz where that is possible at all."""
    sampler, columns, shifts = rows
    columns = np.array(learned.independent) if columns is None else columns
    kept = (columns, basis, limits, start, rate)
    final = Problem(learned, sampler, ways[0][-1], *kept, shifts=shifts)
    simple, apart = final.linear_rows <= FEW_ROWS, _distances_count(limits)
    few = _few_samples(final) if simple or apart else None
    made = [[Problem(learned, sampler, one, *kept, shifts=shifts, samples=few) for one in way] for way in ways]
    found: list[tuple[float, np.ndarray]] = []
    for k in range(starts):

        def told(share: float, k: int = k) -> None:
            progress((k + share) / starts)

        search = _best_of_some if simple else _by_joints
        found.append(search(made[k % len(made)], final, generator, told))
    ends: list[tuple[bool, float, Trajectory, tuple[Use, ...], Limits]] = []
    for value, x in sorted(found, key=lambda one: one[0])[:CHECKED]:
        if ends and min(ends, key=lambda one: one[:2])[:2] <= (False, value):
            break  # no motion that is left promises more
        own = _fitted(final, final.trajectory(x))
        if simple and few is not None:
            x = solve(own, x)
        elif few is not None or own is not final:
            x = polished(own, x, {}, STEPS)
        motion, uses, kept_limits = _feasible(torque, own, x)
        met = all(use.met for use in uses)
        ends.append((not met, final.value(final.numbers(motion)), motion, uses, kept_limits))
        final.evaluations += own.evaluations if own is not final else 0
    _, _, motion, uses, kept_limits = min(ends, key=lambda one: one[:2])
    evaluations = sum(problem.evaluations for way in (*made, [final]) for problem in way)
    return Stage(motion, uses, np.nan, tuple(value for value, _ in found), evaluations, kept_limits.clearance)


def _best_of_some(
    problems: Sequence[Problem], final: Problem, generator: np.random.Generator, told: Callable[[float], None]
) -> tuple[float, np.ndarray]:
    """Of several random motions that are improved a little, the best one as far as it goes."""
    tried: list[tuple[float, np.ndarray]] = []
    for n in range(TRIED_SHORTLY):
        told(n / (2 * TRIED_SHORTLY))
        x = solve(problems[0], random_motion(final, generator), steps=ROUGH)
        tried.append((problems[0].value(x), x))
    _, x = min(tried, key=lambda one: one[0])
    for problem in problems:
        x = solve(problem, x)
    return problems[-1].value(x), x


def _by_joints(
    problems: Sequence[Problem], final: Problem, generator: np.random.Generator, told: Callable[[float], None]
) -> tuple[float, np.ndarray]:
    """A random motion as far as it goes, then again and again with another motion of one joint, while that is better.

    Thousands of rows make many optima; what is best for one joint among the others' motions is found joint by joint.
    """
    last, best, x = problems[-1], np.inf, np.zeros(0)
    tried, exchanged = APART if _distances_count(final.limits) else (TRIED_WITHIN, EXCHANGED)
    for n in range(tried):
        told(n / (tried + exchanged))
        other = random_motion(final, generator)
        for problem in problems:
            other = within(problem, other)
        if (value := last.value(other)) < best:
            best, x = value, other
    for n in range(exchanged):
        told((tried + n) / (tried + exchanged))
        other = _exchanged(final, x, int(generator.choice(np.flatnonzero(last.moved))), generator)
        if other is not None:
            other = within(last, other, GENTLY)
            if (value := last.value(other)) < best:
                best, x = value, other
    x = polished(last, x, {}, STEPS)
    return last.value(x), x


def _exchanged(
    problem: Problem, x: Float[np.ndarray, " n"], joint: int, generator: np.random.Generator
) -> Float[np.ndarray, " n"] | None:
    """The motion with a random one of one joint; None where it touches something."""
    own, other = problem.trajectory(x), problem.trajectory(random_motion(problem, generator))
    start, weights = np.array(own.start), np.array(own.weights)
    start[joint], weights[joint] = np.asarray(other.start)[joint], np.asarray(other.weights)[joint]
    motion = Trajectory(start, weights, own.basis)
    return problem.numbers(motion) if _clear(problem, motion) else None


def _clear(problem: Problem, motion: Trajectory) -> bool:
    """Whether nothing touches in a motion."""
    clearance = problem.limits.clearance
    if clearance is None or not _distances_count(problem.limits):
        return True
    return bool((clearance.distances(np.asarray(motion.states(CLEAR_RATE)[0])) > 0).all())


def _few_samples(problem: Problem) -> int | None:
    """Samples that show what a motion tells nearly as well as all do, whole chunks of them; None: all are needed."""
    every = problem.count
    few = CHUNK * int(np.ceil(WAVE * problem.basis.waves / CHUNK))
    enough = few * problem.nv >= OVER * len(problem.columns)
    return few if enough and few <= 0.7 * every else None


def _feasible(
    torque: Torque, problem: Problem, x: Float[np.ndarray, " n"]
) -> tuple[Trajectory, tuple[Use, ...], Limits]:
    """The motion of x, designed again with margins for what it exceeds at 1 kHz, at last made a little smaller."""
    margin: dict[str, float] = {}
    for _ in range(TIGHTENED):
        problem = _fitted(problem, problem.trajectory(x))
        uses = checked(torque, problem.learned.robot, problem.trajectory(x), problem.limits, meshes=False)
        over = {use.kind: _excess(use) for use in uses if use.share > 1.0}
        if max(over.values(), default=0.0) < ALLOWED:
            break
        margin = {kind: margin.get(kind, 0.0) + 1.2 * over.get(kind, 0.0) for kind in {*margin, *over}}
        x = polished(problem, x, margin, TIGHTENING)
    return _smaller(torque, problem, problem.trajectory(x))


def _fitted(problem: Problem, motion: Trajectory) -> Problem:
    """The problem with distances of capsules as near to those of the shapes as this motion allows."""
    limits = problem.limits
    if limits.clearance is None or not _distances_count(limits):
        return problem
    q = np.asarray(motion.states(CLEAR_RATE)[0])
    return replace(problem, limits=replace(limits, clearance=limits.clearance.fitted(q)), _near=None)


def _excess(use: Use) -> float:
    """What exceeds a limit, in the unit of the rows of the solver."""
    return (use.limit - use.value) / NEAR if use.kind == "clearance" else use.share - 1.0


def _smaller(torque: Torque, problem: Problem, motion: Trajectory) -> tuple[Trajectory, tuple[Use, ...], Limits]:
    """The motion shrunk towards its start until it meets its limits; as it was where standing still does not either."""
    robot, first = problem.learned.robot, None
    start = np.clip(motion.start, problem.limits.position[:, 0], problem.limits.position[:, 1])
    for _ in range(100):
        limits = _fitted(problem, motion).limits
        uses = checked(torque, robot, motion, limits, meshes=False)
        first = first or (motion, uses, limits)
        worst = max((use.share for use in uses), default=0.0)
        if worst <= 1.0 + ROUNDING and limits.clearance is not None:
            uses = checked(torque, robot, motion, limits)
            worst = max((use.share for use in uses if not use.met), default=0.0)
        if worst <= 1.0 + ROUNDING:
            return motion, uses, limits
        shrink = max(STEP, 1.0 / worst) if worst < 1.02 else STEP
        motion = Trajectory(start, np.asarray(motion.weights) * shrink, motion.basis)
    assert first is not None
    return first
