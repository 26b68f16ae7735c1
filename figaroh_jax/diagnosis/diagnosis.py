"""Find what the simulation gets wrong, name it, put it in, measure the gain: the way of `diagnose` from end to end.

The noise comes from repeats or a rich model, never from the baseline's residual. The catalogue is screened with the
baseline projected out, the best are refitted exactly and compared on data they were not fitted to, one cause after
another, until nothing is gained. What is left decides between `named`, `named+rest`, `nothing` and `unknown`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..effects.base import Effect, place
from ..effects.catalogue import find
from ..effects.plausibility import implausible
from ..errors import InputError
from ..estimation.noise import Spectrum
from ..recordings.checks import check_recordings
from ..recordings.dataset import Recording, read_recordings
from ..recordings.signals import Signals, prepare_all
from ..recordings.stacked import stack
from ..results import Cause, Diagnosis, Gain, Verdict
from ..rigid.model import RobotModel, prismatic
from ..simulators.contract import Backend
from ..simulators.native import as_backend
from ..simulators.registry import backend as make_backend
from .estimates import Fitted, estimates, fitted_model
from .experiment import next_experiment
from .explain import explain
from .flexible import flexible_p, friction_width
from .floor import noise_floor, noise_rms
from .holdout import held_out, residual_rms, traces
from .joint import Joint, polished, sized
from .layout import describe_folds, held_rows, layout
from .problem import Problem
from .rest import excess, lines, rest_of, verdict, wrong_law
from .search import Found, Search, eliminate, find_causes
from .state import State, baseline
from .step import Step, stand

if TYPE_CHECKING:
    from ..formats.config import Baseline, Preprocess, Task

__all__ = ["diagnose", "diagnose_task"]

CERTAIN = 0.2  # of alpha: what a name needs, for p is not uniform under coloured noise


def diagnose_task(
    task: Task, progress: Callable[[str, float], None] = lambda phase, share: None, backend: str = "native"
) -> Diagnosis:
    """Diagnose what a task file describes, by the named backend; `InputError` before any work where it is wrong."""
    from ..formats.robotfile import load_robot, stated_baseline

    progress("reading", 0.0)
    model, (known, notes) = load_robot(task), stated_baseline(task)
    recordings = read_recordings(task, model)
    notes = (*notes, *check_recordings(task, model, recordings))
    options = {"trust": task.robot.trust, "forbid": task.diagnose.forbid, "alpha": task.diagnose.alpha}
    robot = make_backend(backend, model)
    found = diagnose(robot, recordings, task.preprocess, known, progress=progress, **options)
    return replace(found, notes=(*notes, *implausible(model, found.model, task.robot.trust), *found.notes))


def diagnose(
    model: RobotModel | Backend,
    recordings: Sequence[Recording],
    preprocess: Preprocess,
    known: Baseline | None = None,
    *,
    trust: float = 0.10,
    forbid: Sequence[str] = (),
    alpha: float = 0.05,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    seed: int = 0,
) -> Diagnosis:
    """What the robot's model gets wrong in the recordings (joint side, SI units), named where it can be.

    `model` is the robot, or a backend of it, which then computes its rigid body's torques and regressor. `trust` is how
    far the nominal inertials are believed (relative one-sigma), `known` what the baseline contains,
    `forbid` names effects left out of the catalogue, `alpha` is the level of the test for the whole catalogue.
    """
    with jax.enable_x64(True):
        progress("preparing signals", 0.03)
        signals = sorted(prepare_all(tuple(recordings), preprocess), key=lambda s: s.role == "holdout")
        here = _setting(as_backend(model), signals, known, trust, forbid, progress)
        generator = np.random.default_rng(seed)
        search = find_causes(*here, forbid, CERTAIN * alpha, progress, generator)
        here = here._replace(problem=search.problem, start=search.start)
        progress("fitting all causes together", 0.8)
        first = stand(here.problem, here.start, here.whitening)
        told = _judged(here, first, search, *_fitted_together(here, search.found, forbid), generator)
        progress("measuring the gain", 0.9)
        return _answer(here, signals, first, search, told)


class _Setting(NamedTuple):
    """What is known before any cause is looked for: data, baseline, noise and what makes it white."""

    problem: Problem
    start: State
    spectrum: Spectrum
    whitening: Float[np.ndarray, "F nv"]


class _Told(NamedTuple):
    """What the diagnosis stands by."""

    word: Verdict
    found: list[Found]
    joint: Joint  # all of them in one fit
    rest: str


def _setting(
    backend: Backend,
    signals: Sequence[Signals],
    known: Baseline | None,
    trust: float,
    forbid: Sequence[str],
    progress: Callable[[str, float], None],
) -> _Setting:
    """The recordings on one clock, the baseline, and the noise; holdout recordings stand behind the others."""
    model = backend.robot
    records = stack(signals, model)
    held = held_rows(signals, records)
    problem = Problem(backend, records, layout(signals, records), trust, np.zeros(model.nv), held)
    names, given = _baseline_effects(model, known)
    start = baseline(problem, names, given)
    progress("estimating the noise", 0.08)
    spectrum, whitening = noise_floor(problem, start, forbid)
    problem = friction_width(problem, start, whitening)
    return _Setting(problem, baseline(problem, names, given), spectrum, whitening)


def _fitted_together(here: _Setting, found: list[Found], forbid: Sequence[str]) -> tuple[list[Found], Joint]:
    """The causes that the others do not make needless and that surely have a size, all in one fit."""
    found = eliminate(here.problem, here.start, found, here.whitening)
    joint = polished(here.problem, here.start, [f.effect for f in found], here.whitening)
    kept = sized(found, joint, forbid)
    if len(kept) < len(found):
        joint = polished(here.problem, here.start, [f.effect for f in kept], here.whitening)
    return kept, joint


def _judged(
    here: _Setting, first: Step, search: Search, found: list[Found], joint: Joint, generator: np.random.Generator
) -> _Told:
    """The verdict by what is left; causes beside which too much is left are none."""
    problem, _, spectrum, whitening = here
    before, *_ = excess(problem, first.rows, first.linear.residual, spectrum, whitening)
    now = excess(problem, joint.step.rows, joint.step.linear.residual, spectrum, whitening)
    flexible = flexible_p(problem, joint.step.state, joint.step.rows, spectrum, whitening, generator)
    line = lines(problem, joint.step.linear.residual)
    rest = rest_of(now, max(before, 0.0), search.p_left, flexible, line, problem.model.joint_names)
    wrong = bool(found) and wrong_law(found[0].name.at, found[0].cost[0] - found[0].cost[1], flexible)
    word = verdict(bool(found), rest, max(before, 0.0), wrong)
    if word != "unknown" or not found:
        return _Told(word, found, joint, rest.text)
    proxy = ", ".join(str(f.name) for f in found)
    text = f"{rest.text}; closest effect, not named as a cause: {proxy}"
    return _Told(word, [], Joint(first, [], Fitted(np.zeros(0), np.zeros((0, 0)), ())), text)


def _answer(here: _Setting, signals: Sequence[Signals], first: Step, search: Search, told: _Told) -> Diagnosis:
    problem, model, last = here.problem, here.problem.model, told.joint.step
    gains = held_out(problem, here.start, told.joint.causes, here.whitening)
    noise = noise_rms(problem, here.spectrum)
    return Diagnosis(
        verdict=told.word,
        causes=_causes(told, gains, model),
        p_value=search.p_value,
        joints=model.joint_names,
        before=residual_rms(problem, first.state),
        after=residual_rms(problem, last.state),
        noise=noise,
        holdout=Gain(gains[0], gains[-1]),
        holdout_scheme=_scheme(signals),
        experiment=next_experiment(told.word, told.found, problem, here.start, told.joint.causes, here.whitening),
        candidates=explain(first.rows, first.linear, search.screened, noise),
        traces=traces(problem, signals, first.state, last.state, told.joint.causes, told.found),
        baseline=fitted_model(problem, first.state, []),
        model=fitted_model(problem, last.state, told.joint.causes),
        rest=told.rest,
        notes=_notes(signals, problem),
        prismatic=prismatic(model),
    )


def _causes(told: _Told, gains: Sequence[float], model: RobotModel) -> tuple[Cause, ...]:
    fitted = told.joint.fitted
    each = zip(told.found, told.joint.causes, fitted.places, pairwise(gains), strict=True)
    return tuple(
        Cause(one.name, estimates(effect, fitted, at, model), one.confidence, Gain(*gain), one.ambiguous)
        for one, effect, at, gain in each
    )


def _baseline_effects(model: RobotModel, known: Baseline | None) -> tuple[list[str], list[Effect]]:
    """Names of the effects that every joint has in the baseline, and the ones that stand at given joints."""
    if known is None:
        return ["viscous_friction", "coulomb_friction"], []
    switches = {
        "viscous_friction": known.viscous,
        "coulomb_friction": known.coulomb,
        "rotor_inertia": known.rotor,
        "torque_offset": known.offset,
    }
    given = []
    for entry in known.effects:
        effect = find(entry.effect)
        if not any(p.linear for p in effect.parameters().values()):
            raise InputError(f"baseline.effects: '{entry.effect}' cannot be fitted as part of the baseline")
        given.append(place(effect, model, entry.at))
    return [name for name, on in switches.items() if on], given


def _scheme(signals: Sequence[Signals]) -> str:
    if any(s.role == "holdout" and s.torque is not None for s in signals):
        return "recordings kept out of the fit"
    return describe_folds(signals)


def _notes(signals: Sequence[Signals], problem: Problem) -> tuple[str, ...]:
    notes = [note for s in signals for note in s.notes]
    if not problem.layout.repeats:
        notes.append("no recording repeats another: the noise is what a rich model leaves, less sure than repeats")
    return tuple(notes)
