"""Designs of motions: from several starts, one motion after another, within limits that are checked at 1 kHz."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float

from ..effects.base import Effect
from ..effects.extended import ExtendedModel
from ..errors import InputError
from ..rigid.model import RobotModel
from .clearance import Clearance
from .information import Learned, learn
from .limits import ALLOWED, Limits, Torque, Use, checked, limits_of, unmeetable
from .motions import Basis, Trajectory
from .objectives import condition_objective, information_objective, prediction_objective, smooth_condition_objective
from .sampling import CHUNK, Sampler
from .separation import Causes, Separated, causes, check_told, separated, separation_objective
from .solvers import FEW_ROWS, NEAR, ROUGH, STEPS, GramObjective, Problem, polished, solve, within

__all__ = ["Cause", "Design", "Stage", "best_motion", "excite", "random_motion"]

TIGHTENED, TIGHTENING = 3, 40  # times that a motion is designed again with a margin, in how many steps
TRIED_SHORTLY = 8  # random motions that a start improves a little, the best of them then as far as it goes
WAVE, OVER = 8, 4  # samples of a wave, rows of a column: enough to look for a motion, which all samples then improve
TRIED, ROOMY = 400, 3  # random postures in which a motion may begin; one of so many that are clear does
TRIED_WITHIN = 5  # random motions that a start improves from within, the best of them then joint by joint
EXCHANGED = 15  # times that a start tries another motion of one joint, where thousands of rows make many optima
GENTLY = 1.0  # how strongly limits are felt before they are reached, at the beginning of such a trial
CHECKED = 8  # motions, the best first, until none promises more than one that is feasible at 1 kHz
ROUNDING = 1e-6  # of a limit
CLEAR_RATE = 40.0  # Hz at which a random motion touches nothing: what begins on the wrong side of a body stays there
SMALLER = (1.0, 0.8, 0.6, 0.45, 0.3, 0.2, 0.1, 0.05, 0.02)  # shares of a random motion that are tried for that
FAR, SHRUNK = 2.0, 12  # of a torque limit, where a random motion may begin; times that it is made smaller for it
STEP = 0.98  # by which a motion is made smaller until it meets its limits

Objective = Literal["information", "prediction", "condition", "separate"]
Cause = tuple[str, Sequence[str], Mapping[str, float]]  # effect, place, sizes
Progress = Callable[[str, float], None]


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


@dataclass(frozen=True)
class Design:
    """Motions designed one after another, and what they tell."""

    learned: Learned
    limits: Limits
    objective: str
    rate: float  # Hz at which the noise is independent
    stages: tuple[Stage, ...]
    information: Float[np.ndarray, "rank rank"]  # of all motions and the prior
    condition: float  # of the weighted rows of all motions
    scaled_condition: float  # the same with columns of length one
    separated: tuple[Separated, ...] = ()  # causes told apart by all motions together
    notes: tuple[str, ...] = ()

    @property
    def logdet(self) -> float:
        """Log determinant of the information of all motions and the prior."""
        return float(np.linalg.slogdet(self.information)[1])

    @property
    def std(self) -> Float[np.ndarray, " rank"]:
        """Standard deviation of each base parameter to be expected after the motions."""
        return np.sqrt(np.diag(np.linalg.inv(self.information)))

    @property
    def std_before(self) -> Float[np.ndarray, " rank"]:
        """The same before any motion; infinite where nothing is known."""
        prior = np.asarray(self.learned.prior)
        size = np.sqrt(np.diag(prior))
        if not (size > 0).all() or np.linalg.cond(prior / np.outer(size, size)) > 1e14:
            return np.full(len(prior), np.inf)
        return np.sqrt(np.diag(np.linalg.inv(prior / np.outer(size, size)))) / size

    @property
    def met(self) -> bool:
        """Whether every limit is met at 1 kHz by every motion."""
        return all(stage.met for stage in self.stages)


def excite(
    model: RobotModel | ExtendedModel,
    basis: Basis,
    limits: Limits | None = None,
    learned: Learned | None = None,
    *,
    objective: Objective | GramObjective = "information",
    predict: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]] = (),
    separate: Sequence[tuple[Cause, Cause]] = (),
    trust: float = 0.10,
    trajectories: int = 1,
    start: Sequence[float] | np.ndarray | None = None,
    starts: int = 4,
    rate: float = 20.0,
    seed: int = 0,
    progress: Progress = lambda phase, share: None,
) -> Design:
    """Motions of `basis` that tell most about what is to be learned, each given those before it.

    `limits` and `learned` None: as `limits_of` and `learn` have them of the model. `objective` "information" makes the
    log determinant large, "prediction" the error on the motions `predict` (arrays q, v, a) small, "condition" the
    condition number of the weighted rows, "separate" the pairs of causes `separate` easy to tell apart (`trust` is then
    the relative sigma of a link that is a cause); or a function of the Gram matrix (`solvers.GramObjective`).
    `start` is the posture at the beginning (rad or m; None: chosen), `starts` how many random motions are improved,
    `rate` (Hz) the samples of a design, whose noise is independent. Raises `InputError` where no motion meets the
    limits, the start is outside of them, or `predict` is needed and empty.

    >>> import figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> limits = fj.limits_of(robot, acceleration=10.0)
    >>> found = fj.excite(robot, fj.spline(3, duration=2.0), limits, starts=1)
    >>> max(use.share for use in found.stages[0].uses) <= 1.0  # of the limits
    True
    >>> q, v, a = found.stages[0].motion.states(rate=1000.0)  # what the robot is to run
    """
    robot = model.robot if isinstance(model, ExtendedModel) else model
    limits = limits_of(robot) if limits is None else limits
    learned = learn(model) if learned is None else learned
    begin = None if start is None else _inside(robot, np.asarray(start, float), limits)
    limits = _without(limits, robot, learned.held, begin)
    sampler = Sampler(robot, learned.terms, np.asarray(learned.width))
    torque = torque_of(model, learned, sampler)
    if begin is not None:
        check_start(torque, robot, limits, begin)
    problem = unmeetable(torque, robot, limits) if begin is None else None
    if problem is not None:
        raise InputError(problem)
    with jax.enable_x64(True):
        wanted = _wanted(learned, sampler, predict) if objective == "prediction" else None
        stages: list[Stage] = []
        before = learned
        given = None
        if separate:
            usual = _typical(learned, sampler, basis, limits, begin, rate)
            given = causes(learned, separate, np.stack(usual.states(rate)), trust)
            check_told(given, _shown(learned, given, usual, limits, rate))
        elif objective == "separate":
            raise InputError("objective: separate needs pairs of causes (`separate`)")
        seen = None if given is None else np.zeros((len(given.columns) + len(given.shifts),) * 2)
        for k in range(trajectories):
            own = _objectives(objective, np.asarray(before.prior), wanted, given, seen)
            generator = np.random.default_rng([seed, k])

            def told(share: float, k: int = k) -> None:
                progress(f"trajectory {k + 1} of {trajectories}", (k + share) / trajectories)

            rows = (sampler, None, ())
            if given is not None and objective == "separate":
                rows = (given.sampler, given.columns, given.shifts)
            stage = best_motion(torque, before, rows, own, basis, limits, begin, starts, rate, generator, told)
            if given is not None and seen is not None:
                seen = seen + _shown(before, given, stage.motion, limits, rate)
            before = before.with_prior(gram_of(before, sampler, stage.motion.states(rate)))
            stages.append(replace(stage, logdet=float(np.linalg.slogdet(np.asarray(before.prior))[1])))
        gram = np.asarray(before.prior) - np.asarray(learned.prior)
        size = np.sqrt(np.diag(gram))
        return Design(
            learned=learned,
            limits=limits,
            objective=objective if isinstance(objective, str) else "own",
            rate=rate,
            stages=tuple(stages),
            information=np.asarray(before.prior),
            condition=float(np.sqrt(np.linalg.cond(gram))),
            scaled_condition=float(np.sqrt(np.linalg.cond(gram / np.outer(size, size)))),
            separated=() if given is None or seen is None else separated(given, seen, np.asarray(learned.prior)),
        )


def gram_of(
    learned: Learned, sampler: Sampler, states: Any, columns: np.ndarray | None = None
) -> Float[np.ndarray, "n n"]:
    """Gram matrix of weighted rows: of the base parameters, their information; `columns` names others."""
    kept = np.array(learned.independent) if columns is None else columns
    rows = sampler.rows(np.stack([np.asarray(x) for x in states]))[:, kept]
    own = rows * np.sqrt(np.asarray(learned.weight))[:, None, None]
    flat = own.swapaxes(0, 1).reshape(own.shape[1], -1)
    return flat @ flat.T


def torque_of(model: RobotModel | ExtendedModel, learned: Learned, sampler: Sampler) -> Torque:
    """Torques of states: by the sampler's programs where they know all effects of the model, else by the model."""
    theta = np.asarray(learned.theta)
    if isinstance(model, ExtendedModel) and any(not _among(effect, learned.terms) for effect in model.effects):
        return lambda states: np.asarray(model.inverse_dynamics(*states))
    return lambda states: sampler.torque(states, theta)


def _among(effect: Effect, terms: Sequence[Effect]) -> bool:
    same = (at for term in terms if type(term) is type(effect) for at in np.asarray(term.at))
    return any(np.array_equal(np.asarray(effect.at), at) for at in same)


def _shown(learned: Learned, given: Causes, motion: Trajectory, limits: Limits, rate: float) -> np.ndarray:
    """Gram matrix of what is learned and of the causes in a motion."""

    def nothing(G: np.ndarray) -> tuple[float, np.ndarray]:
        return 0.0, G

    kept = (given.columns, motion.basis, limits, None, rate)
    problem = Problem(learned, given.sampler, nothing, *kept, shifts=given.shifts)
    return problem.gram(given.sampler.rows(problem.states(problem.numbers(motion))))[1]


def _typical(
    learned: Learned, sampler: Sampler, basis: Basis, limits: Limits, start: np.ndarray | None, rate: float
) -> Trajectory:
    """A random motion within the limits."""
    kept = np.array(learned.independent)
    objective = information_objective(np.asarray(learned.prior))
    problem = Problem(learned, sampler, objective, kept, basis, limits, start, rate)
    return problem.trajectory(random_motion(problem, np.random.default_rng(0)))


def _inside(robot: RobotModel, start: np.ndarray, limits: Limits) -> np.ndarray:
    if start.shape != (robot.nv,):
        raise InputError(f"start: {start.size} numbers for the {robot.nv} joints {', '.join(robot.dof_names)}")
    for name, x, (low, high) in zip(robot.dof_names, start, limits.position, strict=True):
        if not low <= x <= high:
            raise InputError(f"start: '{name}' at {x:g} is outside of its limits {low:g} to {high:g}")
    clearance = limits.clearance
    if clearance is not None and clearance.rows.names:
        near = clearance.distances(start[None])[0]
        row = int(near.argmin())
        if near[row] < clearance.margin:
            what = "overlap by" if near[row] < 0 else "are apart by only"
            raise InputError(
                f"start: {clearance.name(row)} {what} {abs(near[row]):.3f} m (by the capsules around their shapes);"
                f" limits.clearance is {clearance.margin:g} m: begin elsewhere"
            )
    return start


def check_start(torque: Torque, robot: RobotModel, limits: Limits, start: Float[np.ndarray, " nv"]) -> None:
    """`InputError` where the posture in which a motion begins takes more torque than there is, as of who falls over."""
    share = np.abs(torque(np.stack([start, 0 * start, 0 * start])[:, None]))[0] / limits.torque
    worst = int(share.argmax())
    if share[worst] > 1.0:
        raise InputError(
            f"start: holding still there takes {share[worst]:.2f} times the torque limit of '{robot.dof_names[worst]}'"
            f" ({limits.torque[worst]:g}), and a motion begins at rest: begin elsewhere (a person on a plate: where"
            " `people.balanced` says), or leave the start open"
        )


def _without(limits: Limits, robot: RobotModel, held: Sequence[int], start: Float[np.ndarray, " nv"] | None) -> Limits:
    """The limits, without those of motion of the joints that stand still: where the start is, or at zero."""
    if not held:
        return limits
    at, position = list(held), np.array(limits.position)
    for j in at if start is None else []:
        if not position[j, 0] <= 0 <= position[j, 1]:
            raise InputError(
                f"hold: '{robot.dof_names[j]}' cannot stand at zero, its range is {position[j, 0]:g} to"
                f" {position[j, 1]:g}; give a start"
            )
    position[at] = -np.inf, np.inf
    velocity, acceleration = np.array(limits.velocity), np.array(limits.acceleration)
    velocity[at] = acceleration[at] = np.inf
    return replace(limits, position=position, velocity=velocity, acceleration=acceleration)


def _wanted(
    learned: Learned, sampler: Sampler, predict: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> np.ndarray:
    """Mean Gram matrix of the motions that are to be predicted."""
    if not predict:
        raise InputError("objective: prediction needs the motions that matter (`predict`)")
    return np.sum([gram_of(learned, sampler, motion) / len(motion[0]) for motion in predict], axis=0) / len(predict)


def _objectives(
    objective: Objective | GramObjective,
    prior: np.ndarray,
    wanted: np.ndarray | None,
    given: Causes | None,
    seen: np.ndarray | None,
) -> tuple[tuple[GramObjective, ...], ...]:
    """Ways to a motion, which starts take in turn: objectives one after another, the last is the one that counts."""
    if callable(objective):
        return ((objective,),)
    if objective == "information":
        return ((information_objective(prior),),)
    if objective == "prediction":
        assert wanted is not None
        own = prediction_objective(prior, wanted)
        return ((information_objective(prior), own),)  # what tells nothing has no slope that leads anywhere
    if objective == "separate":
        assert given is not None and seen is not None
        apart = separation_objective(given, np.asarray(given.prior))

        def told(G: np.ndarray) -> tuple[float, np.ndarray]:
            return apart(G + seen)

        return (_leading(information_objective(np.asarray(given.prior)), given.learned), told), (told,)
    return ((smooth_condition_objective(), condition_objective()),)


def _leading(objective: GramObjective, size: int) -> GramObjective:
    """The objective of the first columns, those of what is learned, in a Gram matrix of more."""

    def own(G: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = objective(G[:size, :size])
        return value, np.pad(slope, (0, len(G) - size))

    return own


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
    few = _few_samples(final) if final.linear_rows <= FEW_ROWS else None
    made = [[Problem(learned, sampler, one, *kept, shifts=shifts, samples=few) for one in way] for way in ways]
    found: list[tuple[float, np.ndarray]] = []
    for k in range(starts):

        def told(share: float, k: int = k) -> None:
            progress((k + share) / starts)

        search = _best_of_some if final.linear_rows <= FEW_ROWS else _by_joints
        found.append(search(made[k % len(made)], final, generator, told))
    ends: list[tuple[bool, float, Trajectory, tuple[Use, ...], Limits]] = []
    for value, x in sorted(found, key=lambda one: one[0])[:CHECKED]:
        if ends and min(ends, key=lambda one: one[:2])[:2] <= (False, value):
            break  # no motion that is left promises more
        own = _fitted(final, final.trajectory(x))
        if few is not None:
            x = solve(own, x)
        elif own is not final:
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
    for n in range(TRIED_WITHIN):
        told(n / (TRIED_WITHIN + EXCHANGED))
        other = random_motion(final, generator)
        for problem in problems:
            other = within(problem, other)
        if (value := last.value(other)) < best:
            best, x = value, other
    for n in range(EXCHANGED):
        told((TRIED_WITHIN + n) / (TRIED_WITHIN + EXCHANGED))
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
    return replace(problem, limits=replace(limits, clearance=limits.clearance.fitted(q)))


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
