"""Find what the simulation gets wrong, name it, put it in, measure the gain: the way of `diagnose` from end to end.

The noise comes from repeats or a rich model, never from the baseline's residual. The catalogue is screened with the
baseline projected out, the best are refitted exactly and compared on data they were not fitted to, one cause after
another, until nothing is gained; anew where that shows a cause to have passed for noise. What is left decides between
`named`, `named+rest`, `nothing` and `unknown`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ..compiled.memory import give_back_holes
from ..effects.plausibility import implausible
from ..errors import check_count, check_finite
from ..formats.assembly import Welded
from ..formats.robotfile import load_robot, stated_baseline, welded_to
from ..recordings.bandwidth import note_on
from ..recordings.checks import checked_recordings, refuse_unmeasured
from ..recordings.dataset import Recording, read_recordings
from ..recordings.signals import Signals, kept_out_in_vain, stands_at_times
from ..results import Cause, Diagnosis, Experiment, Gain, Name, Nearest, Rest, Verdict
from ..rigid.model import RobotModel, prismatic
from ..simulators.contract import Backend
from ..simulators.native import as_backend
from ..simulators.registry import backend as make_backend
from .answer_fit import as_moves, as_predicts_best, as_weighed_in_motion, as_weighed_otherwise, together
from .believed import impossible_links
from .carried import LOAD, Carried, carried_in_part, error_with, torque_of, with_loads, without_loads
from .causes import UNSURE, searched_causes, told_size
from .constancy import follows_own_motion, of_one_recording, recordings_that_differ
from .estimates import estimates, fitted_model
from .experiment import next_experiment
from .explain import explain
from .floor import noise_rms, short, sober_spectrum, undecided
from .gaining import Gaining, without_losses
from .holdout import relative_error, residual_rms, traces
from .joint import Joint, least_sure, opened, with_rest, without_a_number
from .judgement import (
    KeptOut,
    Searched,
    as_slow_noise,
    doubted_rest,
    made_by_other_joints,
    reasons_against,
    standings_of,
    sticks_alone,
)
from .layout import describe_folds
from .links import as_gain, moved_links
from .naming import ONE_PART, lone_part, strong
from .problem import Problem
from .reading import Reader, only_read
from .repeats import repeats_not_said
from .rest import follows_motion, parts_of, relative_rest, roughly_predictable, tolerated, verdict
from .screening import OneMore, noise_squares
from .search import Found, Search, chance_beside
from .setting import Setting, begun_with, prepared_signals, setting_beside, setting_of
from .standstill import resting
from .state import State
from .step import Step, stand
from .thresholds import ALPHA_OF_A_NAME, AS_WELL, LINE_P, REST_P
from .zeros import EFFECT, Zeros, as_causes, gain_of, shifted, unexplained, zeros_that_differ

if TYPE_CHECKING:
    from ..formats.config import Baseline, Preprocess, Task

__all__ = ["diagnose", "diagnose_task"]


def diagnose_task(
    task: Task, progress: Callable[[str, float], None] = lambda phase, share: None, backend: str = "native"
) -> Diagnosis:
    """Diagnose what a task file describes, by the named backend; `InputError` before any work where it is wrong."""
    progress("reading", 0.0)
    model, (known, notes) = load_robot(task), stated_baseline(task)
    recordings = read_recordings(task, model)
    refuse_unmeasured(model, recordings)
    checked = checked_recordings(task, model, recordings)
    notes = (*notes, *checked.warnings)
    options: dict[str, Any] = {
        "contradictions": checked.contradictions,
        "trust": task.robot.trust,
        "forbid": task.diagnose.forbid,
        "alpha": task.diagnose.alpha,
        "welded": welded_to(model, task.robot.model, task.robot.root),
    }
    options["tolerance"] = task.diagnose.tolerance.torque
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
    tolerance: float = 0.01,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    seed: int = 0,
    contradictions: Sequence[str] = (),
    welded: Sequence[Welded] = (),
) -> Diagnosis:
    """What the robot's model gets wrong in the recordings (joint side, SI units), named where it can be.

    `model` is the robot, or a backend of it, which then computes its rigid body's torques and regressor. `trust` is how
    far the nominal inertials are believed (relative one-sigma), `known` what the baseline contains,
    `forbid` names effects left out of the catalogue, `alpha` is the level of the test for the whole catalogue, and
    `tolerance` is the share of each joint's RMS torque below which a misfit is good enough to be `nothing`.
    `contradictions` say, in words, what of the recordings contradicts the model (`checked_recordings`): with any, or
    where the links as fitted cannot be, nothing is named. `welded` are bodies that the model's file fixes to its links:
    whether one seems not to be there is told.
    """
    check_finite("tolerance", tolerance, 0.0)
    check_count("seed", seed, 0)
    with jax.enable_x64(True):
        progress("preparing signals", 0.03)
        backend = as_backend(model)
        refuse_unmeasured(backend.robot, recordings)
        signals, band, begun = prepared_signals(backend, recordings, preprocess, known, trust)
        ordered = sorted(recordings, key=lambda r: r.role == "holdout")

        def answered(here: Setting, reader: Reader, generator: np.random.Generator) -> tuple[_Answered, Setting | None]:
            """The answer, and the setting anew where a cause that was found has passed for noise."""
            give_back_holes()
            searched = searched_causes(here, forbid, ALPHA_OF_A_NAME * alpha, tolerance, progress, generator)
            give_back_holes()
            asks = bool(searched.found) and not contradictions  # where nothing may be named, once is enough
            again = setting_beside(searched.here, searched.joint, forbid) if asks else None
            asked = (searched, reader, forbid, tolerance, alpha, generator)
            judged = _judged(*asked, contradictions)
            if not contradictions and (cannot_be := _impossible(judged)):
                judged = _judged(*asked, cannot_be)
            progress("measuring the gain", 0.9)
            answer = _answer(searched.here, reader.signals, searched.search, judged, welded)
            return _Answered(answer, judged.here, judged.causes.joint.step), again

        def answer_to(signals: Sequence[Signals], begun: tuple[Problem, State]) -> _Answered:
            reader, generator = Reader(ordered, signals, preprocess, band), np.random.default_rng(seed)
            one, again = answered(setting_of(*begun, forbid, progress), reader, generator)
            if again:
                other, _ = answered(again, reader, generator)
                held = one.answer.holdout
                if other.answer.holdout.after <= min(AS_WELL * held.after, held.before):
                    return other
            return one

        def begun_anew(signals: Sequence[Signals]) -> tuple[Problem, State]:
            return begun_with(backend, signals, known, trust)

        loads = () if contradictions or LOAD in forbid else carried_in_part(*begun)
        if loads:
            signals = without_loads(backend.robot, signals, loads)
            begun = begun_anew(signals)
        zeros = () if contradictions else zeros_that_differ(*begun, tolerance)
        one = _beside_zeros(answer_to, begun_anew, signals, begun, zeros, forbid, tolerance)
        answer = _with_loads(one, loads, signals) if loads else one.answer
        cannot_be = [f"impossible: {text}" for text in answer.rest.contradicts if text not in contradictions]
        return replace(answer, band=band, notes=(*cannot_be, *answer.notes, *note_on(band)))


class _Answered(NamedTuple):
    """An answer, and the fit that it is of."""

    answer: Diagnosis
    here: Setting
    step: Step


def _beside_zeros(
    answer_to: Callable[[Sequence[Signals], tuple[Problem, State]], _Answered],
    begun_anew: Callable[[Sequence[Signals]], tuple[Problem, State]],
    signals: Sequence[Signals],
    begun: tuple[Problem, State],
    zeros: Sequence[Zeros],
    forbid: Sequence[str],
    tolerance: float,
) -> _Answered:
    """The answer to recordings with the `zeros` that some of them have for themselves, named where they may be."""
    names = [one.name for one in signals]
    if zeros and EFFECT not in forbid:
        moved = shifted(signals, zeros)
        one = answer_to(moved, begun_anew(moved))
        answer = _of_own_zeros(one, zeros, begun[0], names, forbid, tolerance)
        if answer is not None:
            return one._replace(answer=answer)
    one = answer_to(signals, begun)
    return one._replace(answer=unexplained(one.answer, zeros, one.here.problem.model.dof_names, names))


def _of_own_zeros(
    one: _Answered,
    zeros: Sequence[Zeros],
    measured: Problem,
    names: Sequence[str],
    forbid: Sequence[str],
    tolerance: float,
) -> Diagnosis | None:
    """The answer to recordings that were shifted, with the constants by which they were; None where these may be a part
    of a rest, or of a load or friction that only some recordings have. `measured` has the torques as they were."""
    answer, here, step = one
    problem, joints = here.problem, here.problem.model.dof_names
    if answer.rest.contradicts or not all(z.certain and not follows_own_motion(problem, step, z.joint) for z in zeros):
        return None
    if of_one_recording(problem, step, tolerance):
        return None
    problem = replace(problem, records=eqx.tree_at(lambda r: r.torque, problem.records, measured.records.torque))
    first = stand(problem, here.start, here.whitening)
    gains = [gain_of(here.problem, step, [z]) for z in zeros]
    answer = as_causes(answer, zeros, gains, joints, names, forbid)
    holdout = answer.holdout
    if not problem.held.any():  # of recordings kept out no constant is known
        after = gain_of(here.problem, step, zeros).after
        holdout = replace(holdout, before=relative_error(problem, first), after=after)
    return replace(answer, before=residual_rms(problem, first.state), holdout=holdout)


def _with_loads(one: _Answered, loads: Sequence[Carried], signals: Sequence[Signals]) -> Diagnosis:
    """The answer to recordings without what the robot carries in part, with that as causes."""
    answer, here, step = one
    problem, links = here.problem, dict.fromkeys(load.link for load in loads)

    def carrying(some: Sequence[Carried], state: State) -> tuple[Problem, Step]:
        torque = problem.records.torque + sum(torque_of(problem, signals, load, load.body) for load in some)
        seen = replace(problem, records=eqx.tree_at(lambda r: r.torque, problem.records, torque))
        return seen, stand(seen, state, here.whitening)

    gains = {}
    for link in links:
        own = [load for load in loads if load.link == link]
        gains[link] = Gain(error_with(*carrying(own, step.state)), error_with(problem, step, signals, own))
    answer = with_loads(answer, loads, gains, problem.model, signals)
    (seen, first), holdout = carrying(loads, here.start), answer.holdout
    if not problem.held.any():  # of recordings kept out no load is known
        holdout = replace(holdout, before=error_with(seen, first), after=error_with(problem, step, signals, loads))
    return replace(answer, before=residual_rms(seen, first.state), holdout=holdout)


class _Judged(NamedTuple):
    """What the diagnosis stands by."""

    word: Verdict
    causes: Gaining
    rest: Rest
    sticks: bool  # whether what is left is that of joints at rest
    here: Setting  # with the weights of the answer's fit
    more: str = ""  # data that would tell what is left from noise, in words, where these do not


def _judged(
    searched: Searched,
    reader: Reader,
    forbid: Sequence[str],
    tolerance: float,
    alpha: float,
    generator: np.random.Generator,
    contradictions: Sequence[str] = (),
) -> _Judged:
    """The verdict by what is left beside all causes; of these, the ones that stand beside it are named.

    What is not named is no part of the answer's model: the others are fitted anew without it. Where recordings and
    model contradict each other, or the links of the answer cannot be, that is `unknown`, whatever has been found: a
    cause stands for what is wrong with them as well as for itself.
    """
    before, here, _, found, _, left, *_ = searched
    each = standings_of(searched)
    kept_out = KeptOut(searched, {one.name: one.gain for one in each})
    doubted = doubted_rest(searched, forbid, generator)
    against = reasons_against(searched, each, kept_out, doubted, tolerance)
    against |= made_by_other_joints(searched, each, against)
    if contradictions:
        against = {name: why or "nothing is named before what looks wrong is settled" for name, why in against.items()}
    named = [f for f in found if not against[f.name]]
    if named and (chance := as_slow_noise(searched, named, forbid, generator)) is not None:
        against |= {f.name: f"noise as slow as the motion scores as much by chance (p = {chance:.2g})" for f in named}
        named = []
    settings = [here] if before.problem is here.problem else [here, before]
    asked_more = [one.name for one in each if one.whole or not one.beside_rest] if here.problem.held.any() else []
    must_keep = {name: kept_out.claims[name] for name in asked_more}
    here, gaining, by_speed, reasons = _answered(searched, settings, named, kept_out.borne_out, forbid, must_keep)
    named, joint, problem = gaining.named, gaining.joint, here.problem
    against |= reasons
    nearest = [Nearest(one.name, one.gain, against[one.name]) for one in each if against[one.name]]
    follows = None
    if found and not named and not left.rest.there:  # asked beside the causes it was not
        follows = follows_motion(problem, joint.step.state, tolerance, ~resting(problem))
    if follows:
        here = here._replace(spectrum=here.spectrum.at_most(noise_rms(problem, here.spectrum), follows.noise))
    relative = relative_rest(problem, joint.step.state, noise_rms(problem, here.spectrum))
    large = float(relative.max()) > tolerance
    shown = left.rest.there or bool(follows) or ((bool(nearest) or doubted) and large)
    if shown and not named and not left.rest.there and not follows and not doubted and short(problem, joint.step.state):
        sober = sober_spectrum(problem, joint.step.state, forbid)
        shown = chance_beside(problem, joint.step, sober, here.whitening, forbid, generator) < REST_P
    same = here.whitening is searched.here.whitening
    told = joint.step if same else stand(problem, joint.step.state, searched.here.whitening)
    stays = _Stays(True, False, False)
    if not contradictions:
        law = any(strong(one) and against[one.name] for one in each)  # it moves, whatever it is
        stays = _as_what(searched, here, gaining, by_speed, told, shown, law, reader, tolerance, generator)
    rest, sticks, read = stays
    text = follows.text if follows else left.rest.text
    text = (text or ("" if relative.any() else _LESS_THAN_NOISE)) if rest and shown else ""
    if rest and named:
        gaining = gaining._replace(joint=_beside_rest(here, named, joint))
    parts = parts_of(problem, told, searched.here.whitening, left.line, [s.name for s in reader.signals])
    quiet = not rest and not named and (large or searched.search.p_value < alpha)
    why = tolerated(float(relative.max()), tolerance, sticks, read) if quiet or read else ""
    unsure, more = "", _SETTLE_FIRST if contradictions else ""
    if quiet and not why:  # asked of the rows that the second opinions were asked of
        unsure, more = undecided(searched.here.problem, searched.joint.step.state)
    nearest += [one for one in searched.gone if one.name not in against]
    nearest.sort(key=lambda one: -one.share)
    told_rest = Rest(relative, parts, tuple(nearest), text, why, unsure, tuple(contradictions))
    return _Judged(verdict(bool(named), rest), gaining, told_rest, sticks, here, more)


class _Stays(NamedTuple):
    """As what it counts that the answer does not explain."""

    rest: bool  # as something that the catalogue does not name
    sticks: bool  # as dry friction of joints at rest
    read: bool  # as what sensors make of a model that is right


def _as_what(
    searched: Searched,
    here: Setting,
    gaining: Gaining,
    by_speed: Joint,
    told: Step,
    shown: bool,
    law: bool,
    reader: Reader,
    tolerance: float,
    generator: np.random.Generator,
) -> _Stays:
    """As what it counts that an answer leaves: `shown` or not, beside a `law` that moves and has no name or none.

    `told` is the answer in rows as white as those of the search, `by_speed` its causes with the weights of the search.
    """
    named, joint, problem = gaining.named, gaining.joint, here.problem
    noise = noise_rms(problem, here.spectrum)
    relative = relative_rest(problem, joint.step.state, noise)
    sticks = (shown or (float(relative.max()) > tolerance and not named)) and not law
    if sticks:
        sticks = sticks_alone(here, joint, tolerance) or sticks_alone(searched.here, by_speed, tolerance)
        sticks = sticks or (not named and sticks_alone(searched.here, as_moves(searched.here), tolerance))
    if sticks and not named:
        moving = ~np.any(resting(problem), axis=2)
        if roughly_predictable(problem, told, searched.here.whitening, tolerance, moving).any():
            return _Stays(True, False, False)  # what sticks, and something that moves and passed for noise
    if not shown or sticks:
        return _Stays(False, sticks, False)
    read = False
    if not named and searched.left.line[0] >= LINE_P:  # a line is none of what reading a motion leaves
        errors = reader.errors(problem, joint.step.state, generator)
        read = only_read(problem, joint.step.state, noise, relative, tolerance, errors, reader.rounding)
    return _Stays(not read, False, read)


def _impossible(judged: _Judged) -> tuple[str, ...]:
    """What cannot be of the links as the answer's fit has them, in words."""
    problem, joint = judged.here.problem, judged.causes.joint
    fitted = joint.fitted
    return impossible_links(problem, joint.causes, joint.step.state.theta, fitted.covariance)


def _answered(
    searched: Searched,
    settings: Sequence[Setting],
    named: list[Found],
    borne_out: Callable[[Name], bool],
    forbid: Sequence[str],
    claims: Mapping[Name, float],
) -> tuple[Setting, Gaining, Joint, dict[Name, str]]:
    """The causes that lower the error on data held out and whose size the answer's own intervals tell from zero.

    With the setting of the answer's fit, their fit with the weights that found them, and why the others went.
    """
    against: dict[Name, str] = {}
    known = searched.joint if [f.name for f in named] == [f.name for f in searched.found] else None
    here, joint, by_speed = as_predicts_best(settings, named, known)
    first = named
    while True:
        fit = (here.problem, here.start, here.whitening, named, joint)
        gaining = without_losses(*fit, searched.strict, borne_out, claims)
        against |= dict.fromkeys(gaining.worse, "the error on held-out data does not fall with it")
        if named and not gaining.named:  # the fit was chosen beside causes that have gone
            here, joint, _ = as_predicts_best(settings, [], None)
            gaining = without_losses(here.problem, here.start, here.whitening, [], joint, searched.strict)
        named = gaining.named
        if named:
            gaining = gaining._replace(joint=as_weighed_otherwise(here, searched.here.problem, gaining.joint))
        by_speed = by_speed if len(first) == len(named) else together(searched.here, named)
        first, moving = named, as_weighed_in_motion(searched.here, by_speed) if named else by_speed
        if (least := least_sure(moving)) is not None:
            why = f"{UNSURE}: {told_size(moving, least, here)}"
        elif not searched.strict and (least := least_sure(gaining.joint)) is not None:  # a rest widens what is told
            why = f"{UNSURE}: {told_size(gaining.joint, least, here)}"
        elif (least := without_a_number(gaining.joint)) is not None:
            why = "none of its ten numbers is surely there"
        elif searched.strict and (least := lone_part(gaining.joint)) is not None:
            why = ONE_PART
        elif (least := as_gain(here, gaining.joint)) is not None:
            why = "one gain of all torques, beside the links of the model file, explains as much"
        elif (least := _as_links(named, gaining.joint)) is not None:
            why = (
                "beside it the links would move further than believed, which no cause explains: it may be part of that"
            )
        else:
            return here, gaining._replace(named=opened(named, gaining.joint, forbid)), by_speed, against
        against[named[least].name] = why
        named = [f for f in named if f is not named[least]]
        joint = together(here, named)


def _as_links(named: Sequence[Found], joint: Joint) -> int | None:
    """The first of the causes that links other than believed may look like, where the fit would have links be so."""
    if joint.step.loose is None:
        return None
    return next((k for k, f in enumerate(named) if f.effect.like_links), None)


def _beside_rest(here: Setting, named: Sequence[Found], joint: Joint) -> Joint:
    """The answer's fit with what its intervals owe to a rest that stays."""
    squares = (joint.step.linear.residual**2).sum(1)
    left_over = squares - noise_squares(here.problem, here.spectrum, here.whitening)
    return with_rest(here.problem, joint, here.whitening, [f.joints for f in named], left_over)


def _answer(
    searched: Setting, signals: Sequence[Signals], search: Search, judged: _Judged, welded: Sequence[Welded]
) -> Diagnosis:
    here, seen = judged.here, stand(searched.problem, searched.start, searched.whitening)
    named, joint, order, gains, holdout, *_ = judged.causes
    problem, model, last = here.problem, here.problem.model, joint.step
    first = stand(problem, here.start, here.whitening)
    found = [named[k] for k in order]
    causes = [joint.causes[k] for k in order]
    noise = noise_rms(problem, here.spectrum)
    differ, elsewhere = recordings_that_differ(problem, joint, [str(f.name) for f in named], [s.name for s in signals])
    unlike = judged.word == "named" and bool(differ)  # one size for all leaves what others have more or less
    return Diagnosis(
        verdict="named+rest" if unlike else judged.word,
        causes=tuple(
            Cause(
                Name(*one.name),
                estimates(effect, joint.fitted, joint.fitted.places[k], model),
                one.confidence,
                gain,
                _set_of(one, elsewhere.get(k, ())),
                k + 1,
            )
            for k, one, effect, gain in zip(order, found, causes, gains, strict=True)
        ),
        p_value=search.p_value,
        joints=model.joint_names,
        before=residual_rms(problem, first.state),
        after=residual_rms(problem, last.state),
        noise=noise,
        holdout=holdout,
        holdout_scheme=_scheme(signals),
        experiment=Experiment(judged.more)
        if judged.more
        else next_experiment(judged.word, found, problem, here.start, causes, here.whitening),
        candidates=explain(seen.rows, seen.linear, search.shown, noise),
        traces=traces(problem, signals, first.state, last.state, joint.causes, named),
        baseline=fitted_model(problem, first.state, []),
        model=fitted_model(problem, last.state, joint.causes),
        rest=replace(
            judged.rest,
            nearest=tuple(map(_told, judged.rest.nearest)),
            text=differ[0] if unlike else judged.rest.text,
        ),
        links=moved_links(problem, first, last, here.whitening, welded),
        notes=(
            *_notes(signals, here, last),
            *differ,
            *([_LINKS_HELD] if judged.causes.links_held else []),
            *([_AT_REST] if judged.sticks else []),
        ),
        prismatic=prismatic(model),
    )


def _set_of(one: Found, more: Sequence[Name]) -> tuple[Name, ...]:
    """What cannot be told from a cause."""
    return tuple(dict.fromkeys(Name(*n) for n in (*one.ambiguous, *more) if tuple(n) != tuple(one.name)))


def _told(near: Nearest) -> Nearest:
    if not isinstance(near.name, OneMore):
        return near
    return replace(near, name=Name(*near.name), why_not=f"one more of it at that place: {near.why_not}")


_SETTLE_FIRST = "none before what looks wrong is settled: put it right in the task or the recording, and diagnose again"
_LESS_THAN_NOISE = "less is left than the noise is estimated to be, so part of that estimate is an error of the model"
_LINKS_HELD = (
    "the links of the extended model are held near those of the model without causes: free beside them, they would"
    " predict what was kept out worse by chance"
)
_AT_REST = (
    "at rest the torque differs from the model, as dry friction allows: there it can take any value up to its limit,"
    " which no law of velocity predicts; where the joints move, the residual is within the tolerance"
)


def _scheme(signals: Sequence[Signals]) -> str:
    if any(s.role == "holdout" and s.torque is not None for s in signals):
        return "recordings kept out of the fit"
    return describe_folds(signals)


def _notes(signals: Sequence[Signals], here: Setting, last: Step) -> tuple[str, ...]:
    notes = [*(note for s in signals for note in s.notes), *repeats_not_said(signals), *kept_out_in_vain(signals)]
    notes += stands_at_times(signals, here.problem.model.dof_names)
    if not here.problem.layout.repeats:
        notes.append(
            "no recording repeats another: the noise is estimated from the residual of a flexible model, which is less"
            " certain than from repeats"
        )
    if here.white:
        notes.append(
            "the model's error exceeds the noise: rows are weighted by each joint's residual, which predicts held-out"
            " data better than weights from the noise spectrum"
        )
    if last.loose is not None:
        notes.append(
            "the data would move the link inertials further than is likely with a robot.trust of"
            f" {here.problem.trust:.0%}, and no cause explains why: they are kept within it, and what that leaves"
            " counts as unexplained"
        )
    return tuple(notes)
