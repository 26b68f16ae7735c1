"""Fit a robot's dynamics to recordings: base parameters, consistent links, friction, and what can be trusted.

The recordings become one condensed regression (`regression`). Its rank is decided once; the base parameters' weighted
fit gives weights and covariance; the nominal inertials complete what no motion shows, believed as far as cross-
validation bears out; and the links are kept to what bodies can have.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..effects.base import Effect
from ..effects.friction import CoulombFriction
from ..effects.plausibility import implausible
from ..errors import (
    InputError,
    check_callable,
    check_each,
    check_kind,
    check_names,
    check_one_of,
    check_positive,
    check_switch,
    nearest,
)
from ..estimation.base_parameters import BaseParameters, base_parameters, essential
from ..estimation.columns import friction_terms, structural_columns
from ..estimation.conic import Body, NotConverged
from ..estimation.consistency import bodies, log_cholesky_fit, physical_fit, project
from ..estimation.intervals import coloured_covariance
from ..estimation.least_squares import Solution, WeightedByJoint, solve
from ..estimation.priors import rigid_prior
from ..estimation.regression import Condensed, Regression, condense
from ..formats.robotfile import load_robot, stated_baseline
from ..recordings.bandwidth import note_on
from ..recordings.checks import check_recordings
from ..recordings.dataset import Recording, named, read_recordings
from ..recordings.signals import Resampled, Signals, as_slow_as_torque, kept_out_in_vain, prepare_all
from ..rigid.model import DOF_NAMES, RobotModel, prismatic
from ..simulators.contract import Backend
from ..simulators.native import as_backend
from ..simulators.registry import backend as make_backend
from .judgement import (
    Judged,
    Solved,
    correlations,
    described_effects,
    described_links,
    dropped,
    posterior_covariance,
    predicted,
    prior_sigma,
    quality,
    solution_of,
)
from .result import Identification, Quality
from .reversal import widths_to_try, with_reversal_widths

if TYPE_CHECKING:
    from ..formats.config import Baseline, Preprocess, Task

__all__ = ["Fit", "identify", "identify_task"]

Fit = Literal["physical", "log_cholesky", "unconstrained"]
# A direction is loosened as far as the noise of the data moves it by no more than so many stated standard deviations.
# Of .5, 1, 2, 3 this one, chosen by the cross-validated error of the Panda and TIAGo; see `benchmarks/FINDINGS.md`.
MOVED = 2.0  # standard deviations that noise may move a loosened direction by
SHOWN = 0.01  # information of the data in a direction below which it stays as stated; 1 is the prior's own (a root)
TRUSTS = (1.0, 3.0, 10.0, 100.0)  # multiples of the stated trust that cross-validation chooses from
MOST_UNSEEN = 2.0  # relative sigma of a link beyond which nothing is let go that no torque shows
CLEARLY = 0.05  # of the squares left out: what letting go of all that no torque shows must gain
DRIVE_PRECISION = 1e-6  # of friction and rotors: as good as free
SHAKES = 0.5  # fall of the logarithm of the squares from which the first half octave is no motion but errors of sensors
DEAD = 0.5  # share of samples at one single value: such a torque is not measured


@dataclass(frozen=True)
class _Problem:
    """The condensed data and everything a fit of all columns needs."""

    data: Condensed
    base: BaseParameters
    weight: Float[np.ndarray, " nv"]
    mean: Float[np.ndarray, " columns"]
    precision: Float[np.ndarray, " columns"]  # at the stated trust
    inflation: float  # variance of the base parameters, over that of as many rows of white noise
    bounded: Float[np.ndarray, " columns"]  # least value of each column
    links: tuple[Body, ...]
    fit: Fit
    nominal: Float[np.ndarray, "links 10"]

    shown: Float[np.ndarray, "links10 shown"]  # directions, in prior standard deviations, that the torque shows
    told: Float[np.ndarray, " shown"]  # root of the information that the data have on each, the prior having one

    def loosened(self, slack: float) -> Float[np.ndarray, " shown"]:
        r"""Standard deviation of each shown direction, in stated ones, with the nominal believed `slack` times less.

        With the data's root information s and the deviation d an estimate is the share $k = d^2 s^2 / (1 + d^2 s^2)$ of
        what the data alone say, whose noise is $1 / s$: $k / s$ stays below `MOVED`.
        """
        room = np.maximum(1.0 - MOVED * self.told, 1e-12)
        return np.sqrt(np.clip(MOVED / (self.told * room), 1.0, slack**2))

    def root_at(self, slack: float, everywhere: bool = False) -> Float[np.ndarray, "columns columns"]:
        """R with R'R the precision of the prior, the nominal links believed up to `slack` times less (`loosened`).

        A direction that no torque shows stays as near to the nominal as was stated, however little that is believed
        elsewhere: nothing would hold it. `everywhere` lets it go too: a link that carries much more than it weighs is
        no body unless the moments that no torque shows grow with those that one does.
        """
        root, own = np.diag(np.sqrt(self.precision)), self.nominal.size
        if everywhere:
            root[:own, :own] /= slack
            return root
        tighter = self.shown * (1 - 1 / self.loosened(slack))
        root[:own, :own] -= (tighter @ self.shown.T) * np.sqrt(self.precision[:own])
        return root

    def spread_at(self, slack: float, everywhere: bool = False) -> Float[np.ndarray, "columns columns"]:
        """S with SS' the covariance of that prior: the inverse of `root_at`."""
        spread, own = np.diag(1 / np.sqrt(self.precision)), self.nominal.size
        if everywhere:
            spread[:own, :own] *= slack
            return spread
        wider = self.shown * (self.loosened(slack) - 1)
        spread[:own, :own] += (wider @ self.shown.T) / np.sqrt(self.precision[:own, None])
        return spread


def identify_task(
    task: Task, progress: Callable[[str, float], None] = lambda phase, share: None, backend: str = "native"
) -> Identification:
    """Identify what a task file of torques describes, by the named backend; see `tasks.identify_task`."""
    progress("reading", 0.0)
    model, (known, notes) = load_robot(task), stated_baseline(task)
    recordings = read_recordings(task, model, floating=True)
    notes = (*notes, *check_recordings(task, model, recordings))
    options = task.identify
    found = identify(
        make_backend(backend, model),
        recordings,
        task.preprocess,
        known,
        trust=task.robot.trust,
        fit=options.fit,
        joints=options.joints,
        bounds={name: bound.model_dump(exclude_none=True) for name, bound in options.bounds.items()},
        progress=progress,
        check=False,
    )
    return replace(found, notes=(*notes, *implausible(model, found.model, task.robot.trust), *found.notes))


def identify(
    model: RobotModel | Backend,
    recordings: Sequence[Recording],
    preprocess: Preprocess | None = None,
    known: Baseline | None = None,
    *,
    trust: float = 0.10,
    fit: Fit = "physical",
    joints: Sequence[str] | None = None,
    bounds: Mapping[str, Mapping[str, Any]] | None = None,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    check: bool = True,
) -> Identification:
    """Fit the dynamics of `model`, a robot or a backend of it, to recordings (joint side, SI units).

    `known` says which friction is fitted beside the links, `trust` how far the nominal inertials are believed (relative
    one sigma; less if cross-validation says so), `joints` whose torque is fitted (default: all that have one), `bounds`
    what CAD says of links: least and most mass, a box of the centre of mass (`consistency.bodies`). `fit` "physical"
    finds the best robot whose links are bodies, "log_cholesky" the same by Levenberg-Marquardt, "unconstrained" leaves
    the links free. `check` compares the recordings with the model first. Raises `InputError` where a recording cannot
    be right (units, order or sign of columns, clock, standstill), shows too little, or the fit asked for fails.

    >>> import figaroh_jax as fj
    >>> task = fj.load_task(fj.DEMO.replace("robot.urdf", "task.yaml"))
    >>> robot = fj.load_robot(task)
    >>> found = fj.identify(robot, fj.read_recordings(task, robot), fj.Preprocess(cutoff=15))
    >>> bool((found.fit.relative < found.nominal.relative + 1e-9).all())
    True
    """
    from ..formats.config import Baseline, Preprocess

    check_each("recordings", recordings, Recording, "`recording` makes one of arrays")
    check_each("preprocess", [preprocess or Preprocess()], Preprocess, "Preprocess(cutoff=15), in Hz, say")
    check_one_of("fit", fit, get_args(Fit))
    check_positive("trust", trust, "relative one sigma")
    check_switch("check", check)
    check_callable("progress", progress, "progress(phase, share)")
    if known is not None:
        check_kind("known", known, Baseline, "fj.Baseline(rotor=True), say")
    if bounds is not None:
        check_kind("bounds", bounds, Mapping, "{'forearm': {'mass': [1.0, 3.0]}}, in kg, say")
    if not len(recordings):
        raise InputError("recordings is empty: there is nothing to fit")
    backend = as_backend(model)
    model = backend.robot
    recordings = named(recordings, model)
    warned = check_recordings(None, model, recordings) if check else ()
    with jax.enable_x64(True):
        progress("preparing signals", 0.05)
        refused, left_out = _refused(model, recordings, joints)
        fitted = [one for one in recordings if one.role == "fit"]
        undriven = [name for name in model.dof_names if all(name in one.undriven for one in fitted)]
        terms = friction_terms(model, known or Baseline(), undriven)
        structure = structural_columns(model, terms)
        used = np.asarray(np.abs(structure).max(axis=0) > 0)
        progress("condensing the recordings", 0.15)
        read = _read(backend, recordings, preprocess or Preprocess(), terms, refused, used)
        structural = base_parameters(structure.reshape(-1, structure.shape[2]), read.regression.names)
        regression, data, base, start = _condensed(read, used)
        progress("covariance of coloured residuals", 0.5)
        covariance = coloured_covariance(regression, start.parameters, base.independent, start.weight)
        problem = _problem(regression, data, base, start, covariance, trust, fit, bounds)
        progress("fitting", 0.6)
        last = _best(problem, trust)
        progress("judging", 0.85)
        found = _judged(problem, regression, start.parameters, covariance, last, trust, structural.rank)
    notes = [*warned, *left_out, *found.notes, *dropped(regression.signals, model), *note_on(read.band)]
    notes += [*(note for one in regression.signals for note in one.notes), *kept_out_in_vain(regression.signals)]
    return replace(found, band=read.band, notes=tuple(notes))


_LOOSENED = (
    "the nominal links are believed within {:.0%} where the torque shows them, not {:.0%} as stated: that predicts data"
    " left out of the fit better; elsewhere as stated"
)
_LOOSENED_EVERYWHERE = (
    "the nominal links are believed within {:.0%}, not {:.0%} as stated: that predicts data left out of the fit clearly"
    " better; what no torque shows of them may be far off"
)


def _judged(
    problem: _Problem,
    regression: Regression,
    free: Float[np.ndarray, " columns"],
    covariance: Float[np.ndarray, "rank rank"],
    last: _Best,
    trust: float,
    structural_rank: int,
) -> Identification:
    """What a fit is worth; `free` are the parameters without prior and bounds."""
    model, data, base, theta = regression.model, problem.data, problem.base, last.fit.theta
    own = 10 * len(model.joints)
    posterior = posterior_covariance(base, covariance, problem.spread_at(last.slack, last.everywhere))
    judged = Judged(data, base, theta, posterior, covariance, prior_sigma(data, own, model, trust), problem.bounded)
    given = _given_links(problem)
    traces, holdout, outlying = predicted(regression, theta, given)
    loosened = _LOOSENED_EVERYWHERE if last.everywhere else _LOOSENED
    notes = [loosened.format(last.slack * trust, trust)] if last.slack > 1 else []
    notes += [f"{last.fit.failure}: do not trust these values"] if last.fit.failure else []
    notes += [_UNSOLVED.format(last.unsolved)] if last.unsolved else []
    rows = [np.asarray(t.after) - t.measured for t in traces if t.role == "fit" and t.measured is not None]
    weighted = np.concatenate([(row * np.sqrt(problem.weight)).reshape(-1) for row in rows])
    kept = essential(data.factor(problem.weight)[:, [*base.independent, -1]])
    sigma = np.where(_unseen(problem), np.inf, np.sqrt(np.maximum(np.diag(posterior), 0.0)))[own:]
    return Identification(
        solution=solution_of(regression, last.fit, posterior, base.rank, weighted),
        joints=model.dof_names,
        structural_rank=structural_rank,
        condition=base.condition,
        scaled_condition=base.scaled_condition,
        base=judged.base_parameters(),
        parameters=judged.parameters(),
        null_directions=base.null_directions,
        links=described_links(theta[:own].reshape(-1, 10), model.link_names),
        effects=described_effects(model, regression.terms, theta[own:], sigma),
        fit=quality(data, data.squares(theta)),
        unconstrained=quality(data, data.squares(free)),
        nominal=quality(data, data.squares(given)),
        validated=last.validated,
        holdout=holdout,
        trust=last.slack * trust,
        width=regression.width,
        method=problem.fit,
        essential=tuple(base.expressions[k] for k in kept),
        traces=traces,
        correlations=correlations(base, covariance),
        notes=(*notes, *outlying),
        prismatic=prismatic(model),
    )


class _Read(NamedTuple):
    """The recordings as they are prepared with one `band` of positions, condensed, and their first fit."""

    band: float | None  # as for `prepare_all`
    regression: Regression
    wide: Condensed  # with the columns of all reversal widths
    base: BaseParameters
    first: Solution

    @property
    def signals(self) -> Sequence[Signals]:
        return self.regression.signals

    @property
    def squares(self) -> Float[np.ndarray, " fitted"]:
        """Of the joints whose torque is fitted and not zero throughout; none is less than 1e-12 of their sum."""
        theta = np.zeros(len(self.wide.names))
        told = (self.wide.rows > 0) & (self.wide.squares(theta) > 0)
        theta[: len(self.first.parameters)] = self.first.parameters
        squares = self.wide.squares(theta)[told]
        return np.maximum(squares, max(1e-12 * squares.sum(), 1e-300))


def _read(
    backend: Backend,
    recordings: Sequence[Recording],
    preprocess: Preprocess,
    terms: tuple[Effect, ...],
    refused: frozenset[str],
    used: Bool[np.ndarray, "nv columns"],
) -> _Read:
    """The rows of the recordings.

    Positions keep all below the cutoff unless the torque says otherwise: a band guessed from the motion alone costs
    accuracy where friction makes the motion sharp.
    """
    resampled: Resampled = {}
    options: dict[str, Any] = {"model": backend.robot, "resampled": resampled}
    options["sticks"] = any(isinstance(term, CoulombFriction) for term in terms)

    def read(band: float | None) -> _Read:
        signals = prepare_all(tuple(recordings), preprocess, band=band, **options)
        regression = Regression(backend, terms, np.zeros(backend.robot.nv), signals, refused)
        wide = condense(regression, used, widths=widths_to_try(regression))
        data = wide.restricted(range(len(regression.names)))
        base = _base(data)
        return _Read(band, regression, wide, base, solve(data, WeightedByJoint(), kept=base.independent))

    whole = read(None)
    return as_slow_as_torque(whole, read, first=SHAKES) if backend.robot.nq == backend.robot.nv else whole


def _refused(
    model: RobotModel, recordings: Sequence[Recording], joints: Sequence[str] | None
) -> tuple[frozenset[str], list[str]]:
    """Joints whose torque is not fitted: not asked for, or standing at one value most of the time."""
    names = model.dof_names
    check_names("joints", joints)
    for name in joints or ():
        if name not in {*names, *model.joint_names}:
            raise InputError(f"identify.joints: no moving joint '{name}'{nearest(name, (*model.joint_names, *names))}")
    owner = {f"{joint.name}{part}": joint.name for joint in model.joints for part in DOF_NAMES[joint.kind]}
    asked = {name for name in names if joints is None or name in joints or owner[name] in joints}
    refused = set(names) - asked
    notes = [f"torque of {name} is not fitted: not among identify.joints" for name in names if name in refused]
    for j, name in enumerate(names):
        for one in recordings:
            # a root without any wrench on it is a measurement too: the robot flies
            if one.role != "fit" or one.torque is None or name in refused or name not in model.joint_names:
                continue
            if name in one.undriven:
                continue
            share = np.unique(one.torque[:, j], return_counts=True)[1].max() / len(one.torque)
            if share > DEAD:
                refused.add(name)
                notes.append(
                    f"torque of {name} is not fitted: it is constant in {share:.0%} of {one.file}"
                    " (dead zone, or not measured; where nothing drives the joint, say so by 0 in the place of its"
                    " column: `torque: [tau1, 0]`)"
                )
    if refused >= set(names):
        raise InputError(f"no joint has a torque that can be fitted: {'; '.join(notes)}")
    return frozenset(refused), notes


def _condensed(
    read: _Read, used: Bool[np.ndarray, "nv columns"]
) -> tuple[Regression, Condensed, BaseParameters, Solution]:
    """The regression with its reversal widths, condensed; its base parameters and their weighted fit."""
    _, regression, wide, base, first = read
    widened = with_reversal_widths(regression, wide, base.independent, first.weight)
    if (widened.width == regression.width).all():
        return regression, wide.restricted(range(len(regression.names))), base, first
    data = condense(widened, used)
    base = _base(data)
    return widened, data, base, solve(data, WeightedByJoint(), kept=base.independent)


def _base(data: Condensed) -> BaseParameters:
    factor = data.factor()
    base = base_parameters(factor[:, :-1], data.names)
    rows = int(data.rows.sum())
    if base.rank == 0:
        raise InputError("the recordings show no parameter at all: nothing moves, or every row was dropped")
    if rows < 2 * base.rank:
        raise InputError(
            f"{rows} rows of torque are left for {base.rank} base parameters; at least twice as many are needed:"
            " record for longer, or raise preprocess.cutoff"
        )
    return base


def _problem(
    regression: Regression,
    data: Condensed,
    base: BaseParameters,
    start: Solution,
    covariance: Float[np.ndarray, "rank rank"],
    trust: float,
    fit: Fit,
    bounds: Mapping[str, Mapping[str, Any]] | None,
) -> _Problem:
    model = regression.model
    mean, precision = rigid_prior(model, trust)
    drives = len(data.names) - len(mean)
    mean, precision = np.append(mean, np.zeros(drives)), np.append(precision, np.full(drives, DRIVE_PRECISION))
    A = data.factor(start.weight)[:, base.independent]
    # coloured rows tell less than their number says, so the prior weighs more against them
    inflation = float(np.trace(covariance @ (A.T @ A))) / base.rank
    lower = np.full(len(mean), -np.inf)
    lower[len(mean) - drives :] = _least(regression.terms)
    links = bodies(model, bounds)
    nominal = project(np.asarray(model.inertia, float), links)
    inflation = max(inflation, 1e-3)
    factor = data.factor(start.weight)[:, : nominal.size] / np.sqrt(inflation * precision[: nominal.size])
    size, direction = np.linalg.svd(factor, full_matrices=False)[1:]
    shown = size > SHOWN
    prior = (mean, precision, inflation, lower, links, fit, nominal)
    return _Problem(data, base, start.weight, *prior, direction[shown].T, size[shown])


def _least(terms: Sequence[Effect]) -> Float[np.ndarray, " drives"]:
    """Least physical value of each drive column: friction and rotor inertia take no energy out of nothing."""
    out: list[float] = []
    for term in terms:
        out += [term.parameters()[name].lower for name in term.amplitudes()] * len(term.at)
    return np.array(out)


def _fitted(problem: _Problem, folds: Sequence[int] | None, slack: float, everywhere: bool = False) -> Solved:
    """All columns fitted to the rows of `folds` (None: all), the nominal believed `slack` times less (`root_at`)."""
    root = np.sqrt(problem.inflation) * problem.root_at(slack, everywhere)
    rows = np.column_stack([root, root @ problem.mean])
    own = problem.data.factor(problem.weight, folds)
    factor = np.asarray(np.linalg.qr(np.concatenate([own, rows]), mode="r"))
    if problem.fit == "unconstrained":
        length = np.linalg.norm(factor[:, :-1], axis=0)
        return Solved(np.linalg.lstsq(factor[:, :-1] / length, factor[:, -1], rcond=None)[0] / length)
    if problem.fit == "log_cholesky":
        if any(b.box is not None or b.least_mass > 0 or np.isfinite(b.greatest_mass) for b in problem.links):
            raise InputError("identify.bounds: the fit 'log_cholesky' knows no bounds; use 'physical'")
        found = log_cholesky_fit(factor, problem.nominal)
        failure = "" if found.converged else f"log_cholesky has not converged in {found.steps} steps; try 'physical'"
        return Solved(found.parameters, failure, found.steps)
    try:
        theta = physical_fit(factor, problem.links, problem.bounded)
        return Solved(np.where(_unseen(problem), problem.mean, theta))
    except NotConverged as error:
        return Solved(problem.mean, str(error))


def _unseen(problem: _Problem) -> Bool[np.ndarray, " columns"]:
    """Friction and rotors in no row that is fitted: a solver of cones leaves them anywhere above their bound."""
    drives = np.arange(len(problem.mean)) >= problem.nominal.size
    return drives & ~problem.data.factor(problem.weight)[:, :-1].any(axis=0)


def _given_links(problem: _Problem) -> Float[np.ndarray, " columns"]:
    """The links as the robot's file has them, with the friction that fits best beside them."""
    own = problem.nominal.size
    factor = problem.data.factor(problem.weight)
    left = factor[:, -1] - factor[:, :own] @ problem.mean[:own]
    drives = np.linalg.lstsq(factor[:, own:-1], left, rcond=None)[0] if len(problem.mean) > own else np.zeros(0)
    return np.append(problem.mean[:own], drives)


_UNSOLVED = (
    "of the parts left out in turn {} could not be fitted, and the nominal robot stands in there: the cross-validated"
    " error is too large, and the trust in the nominal links may be chosen wrongly"
)


class _Best(NamedTuple):
    """The fit to all rows with the trust that predicts best, and its quality on blocks that were left out."""

    slack: float  # how much less than stated the nominal is believed
    everywhere: bool  # also where no torque shows it
    validated: Quality
    fit: Solved
    unsolved: int = 0  # parts left out whose fit gave up, the nominal links in its place


def _best(problem: _Problem, trust: float) -> _Best:
    """What cross-validation chooses; what no torque shows is let go only where that predicts clearly better, and never
    beyond `MOST_UNSEEN`: nothing but the nominal holds it."""
    tried = {slack: _left_out(problem, slack) for slack in TRUSTS}
    cost = {slack: float(squares @ problem.weight) for slack, (squares, _) in tried.items()}
    slack = TRUSTS[0]
    for other in TRUSTS[1:]:
        slack = other if cost[other] < cost[slack] * (1 - 1e-3) else slack
    (squares, unsolved), everywhere = tried[slack], False
    if slack > 1:
        for other in (x for x in TRUSTS[2:] if x * trust <= MOST_UNSEEN):
            free, gave_up = _left_out(problem, other, everywhere=True)
            if float(free @ problem.weight) > (1 - CLEARLY) * float(squares @ problem.weight):
                break
            slack, squares, everywhere, unsolved = other, free, True, gave_up
    fit = _fitted(problem, None, slack, everywhere)
    return _Best(slack, everywhere, quality(problem.data, squares), fit, unsolved)


def _left_out(problem: _Problem, slack: float, everywhere: bool = False) -> tuple[Float[np.ndarray, " nv"], int]:
    """Squares of each joint in blocks that were left out of the fit in turn, and in how many the fit gave up."""
    folds = [k for k in range(len(problem.data.factors)) if problem.data.count[k].any()]
    squares, unsolved = np.zeros(len(problem.weight)), 0
    for fold in folds:
        others = [k for k in folds if k != fold]
        solved = _fitted(problem, others, slack, everywhere) if others else Solved(problem.mean)
        unsolved += bool(solved.failure)
        squares += problem.data.squares(solved.theta, [fold])
    return squares, unsolved
