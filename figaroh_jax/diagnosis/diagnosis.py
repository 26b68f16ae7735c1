"""Find what the simulation gets wrong, name it, put it in, measure the gain: the way of `diagnose` from end to end.

The noise comes from repeats or a rich model, never from the baseline's residual. The catalogue is screened with the
baseline projected out, the best are refitted exactly and compared on data they were not fitted to, one cause after
another, until nothing is gained. What is left decides between `named`, `named+rest`, `nothing` and `unknown`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Float

from ..effect import Effect, place
from ..effects import find
from ..errors import InputError
from ..model import RobotModel
from ..recordings.dataset import Recording, read_recordings
from ..recordings.signals import Signals, prepare_all
from ..results import Cause, Diagnosis, Experiment, Gain, Name
from .estimates import Fitted, estimates, fitted_model, has_size, joint_fit, moved, prismatic, with_amplitudes
from .explain import explain
from .flexible import flexible_p, friction_width
from .floor import noise_floor
from .holdout import held_out, predicted, traces
from .layout import describe_folds, held_rows, layout
from .noise import Spectrum
from .problem import Problem, State, baseline, extended_state, solved
from .records import stack
from .rest import Rest, excess, lines, rest_of, verdict, wrong_law
from .search import Found, Step, eliminate, find_causes, stand

if TYPE_CHECKING:
    from ..formats.config import Baseline, Preprocess, Task

__all__ = ["diagnose", "diagnose_task"]

CERTAIN = 0.2  # of alpha: what a name needs, for p is not uniform under coloured noise
POLISH = 2
SPEED_LAWS = ("stribeck_friction", "power_law_friction")  # of dry friction over the speed


def diagnose_task(task: Task, progress: Callable[[str, float], None] = lambda phase, share: None) -> Diagnosis:
    """Diagnose what a task file describes; `InputError` before any work where it is wrong."""
    from ..formats.config import load_robot
    from ..formats.robotfile import robot_notes

    progress("reading", 0.0)
    model, notes = load_robot(task), robot_notes(task)
    recordings = read_recordings(task, model)
    options = {"trust": task.robot.trust, "forbid": task.diagnose.forbid, "alpha": task.diagnose.alpha}
    found = diagnose(model, recordings, task.preprocess, task.baseline, progress=progress, **options)
    return replace(found, notes=(*notes, *found.notes))


def diagnose(
    model: RobotModel,
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

    `trust` is how far the nominal inertials are believed (relative one-sigma), `known` what the baseline contains,
    `forbid` names effects left out of the catalogue, `alpha` is the level of the test for the whole catalogue.
    """
    with jax.enable_x64(True):
        progress("preparing signals", 0.03)
        signals = prepare_all(tuple(recordings), preprocess)
        return _diagnose(model, signals, known, trust, tuple(forbid), alpha, progress, np.random.default_rng(seed))


def _diagnose(
    model: RobotModel,
    signals: Sequence[Signals],
    known: Baseline | None,
    trust: float,
    forbid: tuple[str, ...],
    alpha: float,
    progress: Callable[[str, float], None],
    generator: np.random.Generator,
) -> Diagnosis:
    signals = sorted(signals, key=lambda s: s.role == "holdout")
    records = stack(signals)
    held = held_rows(signals, records)
    problem = Problem(model, records, layout(signals, records), trust, np.zeros(model.nv), held)
    names, given = _baseline_effects(model, known)
    start = baseline(problem, names, given)
    progress("estimating the noise", 0.08)
    spectrum, whitening = noise_floor(problem, start, forbid)
    problem = friction_width(problem, start, whitening)
    start = baseline(problem, names, given)
    step, found, (p, left), screened = find_causes(
        problem, start, spectrum, whitening, forbid, CERTAIN * alpha, progress, generator
    )
    found = eliminate(problem, start, found, whitening)
    progress("fitting all causes together", 0.8)
    first = stand(problem, start, whitening)
    last, causes, fitted = _polished(problem, start, [f.effect for f in found], whitening)
    sized = _sized(found, causes, fitted, forbid)
    if len(sized) < len(found):
        last, causes, fitted = _polished(problem, start, [f.effect for f in sized], whitening)
    found = sized
    rest, before, flexible = _what_is_left(problem, first, last, spectrum, whitening, generator, left)
    wrong = bool(found) and wrong_law(found[0].name.at, found[0].cost[0] - found[0].cost[1], flexible)
    word = verdict(bool(found), rest, before, wrong)
    if word == "unknown" and found:
        proxy = ", ".join(str(f.name) for f in found)
        rest = rest._replace(text=f"{rest.text}; best proxy, not a cause: {proxy}"[:160])
        found, causes, last = [], [], first
    progress("measuring the gain", 0.9)
    gains = held_out(problem, start, causes, whitening)
    extended = fitted_model(problem, last.state, causes)
    places = fitted.places if causes else ()
    noise = _noise_rms(problem, spectrum)
    return Diagnosis(
        verdict=word,
        causes=tuple(
            Cause(
                name=one.name,
                parameters=estimates(effect, fitted, at, model),
                confidence=one.confidence,
                gain=Gain(*pair),
                ambiguous_with=one.ambiguous,
            )
            for one, effect, at, pair in zip(found, causes, places, pairwise(gains), strict=True)
        ),
        p_value=p,
        joints=model.joint_names,
        before=_rms(problem, first.state),
        after=_rms(problem, last.state),
        noise=noise,
        holdout=Gain(gains[0], gains[-1]),
        holdout_scheme=_scheme(signals),
        experiment=_experiment(word, found, model),
        candidates=explain(first.rows, first.linear, screened, noise),
        traces=traces(problem, signals, first.state, last.state, causes, found),
        baseline=fitted_model(problem, first.state, []),
        model=extended,
        rest=rest.text,
        notes=_notes(signals, problem),
        prismatic=prismatic(model),
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


def _polished(
    problem: Problem, start: State, causes: list[Effect], whitening: Float[np.ndarray, "F nv"]
) -> tuple[Step, list[Effect], Fitted]:
    """All causes fitted together: a few Gauss-Newton steps over coefficients and shapes.

    Sensor effects follow the load and the torque, so each turn begins with what the last one made of the baseline.
    """
    step = None
    for turn in range(POLISH + 1):
        state = start if step is None else solved(problem, start, step.state.theta[: len(start.theta)])
        for effect in causes:
            state = solved(problem, extended_state(problem, state, effect), _grown(state, effect))
        step = stand(problem, state, whitening)
        causes = with_amplitudes(step.state, causes, problem.model)
        fitted = joint_fit(problem, step.state, step.rows, causes, whitening)
        if turn < POLISH:
            causes = [moved(e, fitted, at) for e, at in zip(causes, fitted.places, strict=True)]
    assert step is not None
    return step, causes, fitted  # pyright: ignore[reportPossiblyUnboundVariable]  # the loop runs at least once


def _sized(found: list[Found], causes: list[Effect], fitted: Fitted, forbid: Sequence[str]) -> list[Found]:
    """The causes whose size is surely not zero, and those whose law alone is open, with all that it may be.

    Where the amplitude's interval includes zero because any of several laws would do, the set says so; where nothing
    else explains the misfit, there is no cause to tell of.
    """
    out = []
    for one, effect, at in zip(found, causes, fitted.places, strict=True):
        if has_size(effect, fitted, at):
            out.append(one)
            continue
        laws = [n for n in SPEED_LAWS if one.name.effect in SPEED_LAWS and n not in (one.name.effect, *forbid)]
        more = dict.fromkeys([*one.ambiguous, *one.alike, *(Name(n, one.name.at) for n in laws)])
        if more and not type(effect).contains:
            out.append(replace(one, ambiguous=tuple(more)))
    return out


def _grown(state: State, effect: Effect) -> Float[np.ndarray, " P"]:
    from .design import kind

    if kind(effect) != "columns":
        return state.theta
    return np.append(state.theta, [float(getattr(effect, n)) for n, p in effect.parameters().items() if p.linear])


def _what_is_left(
    problem: Problem,
    first: Step,
    last: Step,
    spectrum: Spectrum,
    whitening: Float[np.ndarray, "F nv"],
    generator: np.random.Generator,
    left: float,
) -> tuple[Rest, float, tuple[float, Name, float]]:
    before = excess(problem, first.rows, first.linear.residual, spectrum, whitening)
    now = excess(problem, last.rows, last.linear.residual, spectrum, whitening)
    flexible = flexible_p(problem, last.state, last.rows, spectrum, whitening, generator)
    line = lines(problem, last.linear.residual)
    return (
        rest_of(now, max(before[0], 0.0), left, flexible, line, problem.model.joint_names),
        max(before[0], 0.0),
        flexible,
    )


def _rms(problem: Problem, state: State) -> Float[np.ndarray, " nv"]:
    weight = np.asarray(problem.records.weight)
    squares = ((problem.torque - predicted(problem, state)) ** 2 * weight).sum((0, 1))
    return np.sqrt(squares / np.maximum(weight.sum((0, 1)), 1))


def _noise_rms(problem: Problem, spectrum: Spectrum) -> Float[np.ndarray, " nv"]:
    frequency = np.linspace(0.05, float(problem.records.rate) / 2, 400)
    gain = np.interp(frequency, np.asarray(problem.records.omega) / (2 * np.pi), problem.gain)
    return np.sqrt((gain[:, None] * spectrum.power(frequency)).mean(0))


def _scheme(signals: Sequence[Signals]) -> str:
    if any(s.role == "holdout" and s.torque is not None for s in signals):
        return "recordings kept out of the fit"
    return describe_folds(signals)


def _experiment(word: str, found: list[Found], model: RobotModel) -> Experiment | None:
    unsure = [one for one in found if one.ambiguous]
    if unsure:
        one = unsure[0]
        pairs = tuple((one.name.effect, other.effect) for other in one.ambiguous)
        return Experiment(_text(one.name), pairs)
    if word == "unknown":
        return Experiment("the same motion repeated, then each joint alone at several constant speeds")
    return None


def _text(name: Name) -> str:
    where = " and ".join(name.at) or "the robot"
    return find(name.effect).separated_by.format(at=where)


def _notes(signals: Sequence[Signals], problem: Problem) -> tuple[str, ...]:
    notes = [note for s in signals for note in s.notes]
    if not problem.layout.repeats:
        notes.append("no recording repeats another: the noise is what a rich model leaves, less sure than repeats")
    return tuple(notes)
