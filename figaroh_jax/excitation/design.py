"""Designs of motions: what is asked for, one motion after another, and what they tell."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import jax
import numpy as np
from jaxtyping import Array, Float

from ..effects.base import Effect
from ..effects.extended import ExtendedModel
from ..errors import InputError, check_count, check_kind, check_one_of, check_positive, check_real
from ..rigid.model import RobotModel
from .information import Learned, learn
from .limits import Limits, Torque, limits_of, unmeetable
from .motions import Basis, Trajectory
from .objectives import (
    condition_objective,
    information_objective,
    own_objective,
    prediction_objective,
    smooth_condition_objective,
)
from .sampling import Sampler
from .search import Stage, best_motion, random_motion
from .separation import Causes, Separated, causes, check_told, separated, separation_objective
from .solvers import GramObjective, Problem

__all__ = ["Cause", "Design", "excite"]

Objective = Literal["information", "prediction", "condition", "separate"]
Cause = tuple[str, Sequence[str], Mapping[str, float]]  # effect, place, sizes
Progress = Callable[[str, float], None]


@dataclass(frozen=True, repr=False)
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

    def __repr__(self) -> str:
        told = f"{self.learned.rank} base parameters, logdet {self.logdet:.4g}, condition {self.condition:.3g}"
        return f"Design: {len(self.stages)} motions, limits {'met' if self.met else 'NOT met'}; {told}"

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
    objective: Objective | GramObjective | Callable[[Array], Array] = "information",
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
    the relative sigma of a link that is a cause); or a function of the Gram matrix (n, n) of the weighted rows, that is
    made small: one of JAX that gives a number, or one that gives the number and its slope (`solvers.GramObjective`).
    `start` is the posture at the beginning (rad or m; None: chosen), `starts` how many random motions are improved,
    `rate` (Hz) the samples of a design, whose noise is independent. Raises `InputError` where no motion meets the
    limits, the start is outside of them, or `predict` is needed and empty.

    >>> import figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> limits = fj.limits_of(robot, acceleration=10.0)
    >>> found = fj.excite(robot, fj.spline(3, duration=2.0), limits, starts=1)
    >>> max(use.share for use in found.stages[0].uses) < 1 + 1e-9  # of the limits
    True
    >>> q, v, a = found.stages[0].motion.states(rate=1000.0)  # what the robot is to run
    """
    if not isinstance(basis, Basis):
        raise InputError(f"basis is of type {type(basis).__name__}; `fourier`, `spline` and `quintic` make one")
    named: Any = objective
    if isinstance(named, str):
        check_one_of("objective", named, get_args(Objective))
    check_count("starts", starts)
    check_count("trajectories", trajectories)
    check_count("seed", seed, 0)
    check_positive("trust", trust, "relative one sigma")
    asked = _asked(model, limits, learned, start)
    with jax.enable_x64(True):
        aim = _aim(asked, basis, objective, predict, separate, trust, rate)
        stages: list[Stage] = []
        before, seen = asked.learned, aim.nothing
        for k in range(trajectories):

            def told(share: float, k: int = k) -> None:
                at = "" if starts == 1 else f", start {min(int(share * starts), starts - 1) + 1} of {starts}"
                progress(f"trajectory {k + 1} of {trajectories}{at}", (k + share) / trajectories)

            own, generator = aim.objectives(np.asarray(before.prior), seen), np.random.default_rng([seed, k])
            kept = (basis, asked.limits, asked.start)
            stage = best_motion(asked.torque, before, aim.rows, own, *kept, starts, rate, generator, told)
            seen = seen if aim.given is None else seen + _shown(before, aim.given, stage.motion, asked.limits, rate)
            before = before.with_prior(gram_of(before, asked.sampler, stage.motion.states(rate)))
            stages.append(replace(stage, logdet=float(np.linalg.slogdet(np.asarray(before.prior))[1])))
        return _finished(asked, aim, rate, stages, np.asarray(before.prior), seen)


@dataclass(frozen=True)
class _Asked:
    """What a design is made for."""

    limits: Limits
    learned: Learned
    sampler: Sampler
    torque: Torque
    start: Float[np.ndarray, " nv"] | None


def _asked(
    model: RobotModel | ExtendedModel,
    limits: Limits | None,
    learned: Learned | None,
    start: Sequence[float] | np.ndarray | None,
) -> _Asked:
    """What is asked for, with its defaults; `InputError` where no motion can keep the limits."""
    check_kind("model", model, (RobotModel, ExtendedModel), "excite(model, basis)")
    robot = model.robot if isinstance(model, ExtendedModel) else model
    limits = limits_of(robot) if limits is None else limits
    check_kind("limits", limits, Limits, "`limits_of` makes them")
    learned = learn(model) if learned is None else learned
    check_kind("learned", learned, Learned, "`learn(model)` makes one")
    if start is not None:
        check_real("start", start)
    begin = None if start is None else _inside(robot, np.asarray(start, float), limits)
    limits = _without(limits, robot, learned.held, begin)
    sampler = Sampler(robot, learned.terms, np.asarray(learned.width))
    torque = torque_of(model, learned, sampler)
    if begin is not None:
        check_start(torque, robot, limits, begin)
    elif (problem := unmeetable(torque, robot, limits)) is not None:
        raise InputError(problem)
    return _Asked(limits, learned, sampler, torque, begin)


@dataclass(frozen=True)
class _Aim:
    """What a design makes large, and the rows that it takes."""

    objective: Objective | GramObjective | Callable[[Array], Array]
    wanted: np.ndarray | None  # mean Gram matrix of the motions that are to be predicted
    given: Causes | None  # that are to be told apart
    rows: tuple[Sampler, np.ndarray | None, tuple[float, ...]]  # sampler, its columns that count, late torques

    @property
    def nothing(self) -> np.ndarray:
        """Gram matrix of the causes before any motion."""
        return np.zeros((0 if self.given is None else len(self.given.columns) + len(self.given.shifts),) * 2)

    def objectives(self, prior: np.ndarray, seen: np.ndarray) -> tuple[tuple[GramObjective, ...], ...]:
        """Ways to a motion, which starts take in turn: objectives one after another, the last one counts."""
        return _objectives(self.objective, prior, self.wanted, self.given, seen)


def _aim(
    asked: _Asked,
    basis: Basis,
    objective: Objective | GramObjective | Callable[[Array], Array],
    predict: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    separate: Sequence[tuple[Cause, Cause]],
    trust: float,
    rate: float,
) -> _Aim:
    """The aim of a design; `InputError` where motions or causes are missing, or no motion tells them apart."""
    learned, sampler = asked.learned, asked.sampler
    wanted = _wanted(learned, sampler, predict) if objective == "prediction" else None
    if not separate:
        if objective == "separate":
            raise InputError("objective: separate needs pairs of causes (`separate`)")
        return _Aim(objective, wanted, None, (sampler, None, ()))
    usual = _typical(learned, sampler, basis, asked.limits, asked.start, rate)
    given = causes(learned, separate, np.stack(usual.states(rate)), trust)
    check_told(given, _shown(learned, given, usual, asked.limits, rate))
    apart = objective == "separate"
    return _Aim(
        objective, wanted, given, (given.sampler, given.columns, given.shifts) if apart else (sampler, None, ())
    )


def _finished(
    asked: _Asked, aim: _Aim, rate: float, stages: Sequence[Stage], information: np.ndarray, seen: np.ndarray
) -> Design:
    """The design of all its motions."""
    prior = np.asarray(asked.learned.prior)
    gram = information - prior
    size = np.sqrt(np.diag(gram))
    return Design(
        learned=asked.learned,
        limits=asked.limits,
        objective=aim.objective if isinstance(aim.objective, str) else "own",
        rate=rate,
        stages=tuple(stages),
        information=information,
        condition=_condition(gram),
        scaled_condition=_condition(gram / np.outer(size, size)) if (size > 0).all() else np.inf,
        separated=() if aim.given is None else separated(aim.given, seen, prior),
    )


def _condition(gram: Float[np.ndarray, "n n"]) -> float:
    """Condition number of rows with this Gram matrix."""
    return float(np.sqrt(np.linalg.cond(gram))) if gram.any() else np.inf


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
    objective: Objective | GramObjective | Callable[[Array], Array],
    prior: np.ndarray,
    wanted: np.ndarray | None,
    given: Causes | None,
    seen: np.ndarray | None,
) -> tuple[tuple[GramObjective, ...], ...]:
    """Ways to a motion, which starts take in turn: objectives one after another, the last is the one that counts."""
    if callable(objective):
        return ((own_objective(objective),),)
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
