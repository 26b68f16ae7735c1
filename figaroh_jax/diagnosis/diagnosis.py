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

import jax
import numpy as np

from ..compiled.memory import give_back_holes
from ..effects.base import place
from ..effects.catalogue import CATALOGUE, find, related
from ..effects.plausibility import implausible
from ..errors import check_count, check_finite
from ..formats.assembly import Welded
from ..formats.robotfile import load_robot, stated_baseline, welded_to
from ..recordings.bandwidth import note_on
from ..recordings.checks import checked_recordings, refuse_unmeasured
from ..recordings.dataset import Recording, read_recordings
from ..recordings.signals import Signals, kept_out_in_vain, stands_at_times
from ..results import Cause, Diagnosis, Experiment, Name, Nearest, Rest, Verdict
from ..rigid.model import RobotModel, prismatic
from ..simulators.contract import Backend
from ..simulators.native import as_backend
from ..simulators.registry import backend as make_backend
from .answer_fit import as_moves, as_predicts_best, as_weighed_in_motion, as_weighed_otherwise, together
from .believed import impossible_links
from .comparison import t_value
from .drives import rotors_for_bodies
from .estimates import amplitude_places, estimates, fitted_model
from .experiment import next_experiment
from .explain import explain
from .flexible import families, flexible_p
from .floor import foretold, noise_rms, short, sober_spectrum, undecided
from .gaining import Gaining, beside_all, predicts_better, without_losses
from .gates import physical_sign
from .holdout import kept_out_error, residual_rms, traces
from .joint import Joint, least_sure, opened, polished, sized, with_rest, without_a_number
from .judgement import KeptOut, Left, Searched, as_slow_noise, doubted_rest, reasons_against, standings_of, sticks_alone
from .layout import describe_folds, repeats_not_said
from .links import as_gain, moved_links
from .naming import LIKE_A_REST, ONE_PART, beyond_simpler, lone_part, strong
from .reading import Reader, only_read
from .rest import (
    beyond_noise,
    excess,
    follows_others,
    lines,
    parts_of,
    predictable,
    relative_rest,
    repeating,
    roughly_predictable,
    significance,
    tolerated,
    verdict,
    wrong_law,
)
from .screening import OneMore, noise_squares
from .search import (
    Begun,
    Found,
    Rival,
    Search,
    at_their_links,
    chance_beside,
    eliminate,
    find_causes,
    judged_without,
    taken_beside,
)
from .setting import Setting, prepared_signals, setting_beside, setting_of
from .standstill import left_moving, resting
from .step import Step, stand, with_causes
from .thresholds import ALPHA_OF_A_NAME, AS_WELL, FEW_CAUSES, FOR_SURE, LINE_P, NO_REST, OF_REPEATED, REST_P, T_BETTER

if TYPE_CHECKING:
    from ..formats.config import Baseline, Preprocess, Task

__all__ = ["diagnose", "diagnose_task"]

NEARLY = 1.1  # times the held-out squares of a search, up to which it is worth another one from other causes


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
        here = setting_of(*begun, forbid, progress)
        ordered = sorted(recordings, key=lambda r: r.role == "holdout")
        reader, generator = Reader(ordered, signals, preprocess, band), np.random.default_rng(seed)

        def answered(here: Setting) -> tuple[Diagnosis, Setting | None]:
            """The answer, and the setting anew where a cause that was found has passed for noise."""
            give_back_holes()
            searched = _searched(here, forbid, ALPHA_OF_A_NAME * alpha, tolerance, progress, generator)
            give_back_holes()
            asks = bool(searched.found) and not contradictions  # where nothing may be named, once is enough
            again = setting_beside(searched.here, searched.joint, forbid) if asks else None
            asked = (searched, reader, forbid, tolerance, alpha, generator)
            judged = _judged(*asked, contradictions)
            if not contradictions and (cannot_be := _impossible(judged)):
                judged = _judged(*asked, cannot_be)
            progress("measuring the gain", 0.9)
            return _answer(searched.here, signals, searched.search, judged, welded), again

        answer, again = answered(here)
        if again:
            other, _ = answered(again)
            if other.holdout.after <= min(AS_WELL * answer.holdout.after, answer.holdout.before):
                answer = other
        cannot_be = [f"impossible: {text}" for text in answer.rest.contradicts if text not in contradictions]
        return replace(answer, band=band, notes=(*cannot_be, *answer.notes, *note_on(band)))


class _Judged(NamedTuple):
    """What the diagnosis stands by."""

    word: Verdict
    causes: Gaining
    rest: Rest
    sticks: bool  # whether what is left is that of joints at rest
    here: Setting  # with the weights of the answer's fit
    more: str = ""  # data that would tell what is left from noise, in words, where these do not


def _searched(
    here: Setting,
    forbid: Sequence[str],
    alpha: float,
    tolerance: float,
    progress: Callable[[str, float], None],
    generator: np.random.Generator,
) -> Searched:
    """The causes that the data show; where a rest stays, without the laws of a joint or link that any rest looks like.

    Beside a rest those (`Effect.beside_rest`) are not named, and take the place of causes that could be: the search is
    taken up again from where the first of them came in; or from all the others that were found, where that surely
    predicts better. Such an effect of the whole robot stays: what it stands for would go into several others, each of
    which would look sure. One that fades stays where recordings kept out, in which it is no longer there, surely show
    it: what any rest looks like would be there again. Where many causes are found, that is known before they are in one
    fit. Many that leave nothing are the answer where the others alone leave a rest, or surely predict worse.
    """

    def ended(before: Setting, search: Search) -> Searched:
        here = before._replace(problem=search.problem, start=search.start)
        progress("fitting all causes together", 0.8)
        found, joint, gone = _fitted_together(here, search.found, forbid, tolerance)
        found, joint = _told_apart(here, found, joint)
        give_back_holes()
        left = _left(here, search, found, joint, forbid, tolerance, generator)
        strict = left.rest.there or left.excess > NO_REST or len(found) > FEW_CAUSES
        if not strict and (kept := _possible(found, joint)) != found:
            found, joint = kept, together(here, kept)
            left = _left(here, search, found, joint, forbid, tolerance, generator)
            strict = left.rest.there or left.excess > NO_REST
        if left.follows:
            noise = here.spectrum.at_most(noise_rms(here.problem, here.spectrum), left.follows.noise)
            here = here._replace(spectrum=noise)
        return Searched(before, here, search, found, joint, left, strict, gone)

    of_one = [n for n, e in CATALOGUE.items() if e.acts_on in ("joint", "pair") or e.inertial]
    like_a_rest = [name for name in of_one if not CATALOGUE[name].beside_rest]

    def first_of(found: list[Found]) -> int | None:
        return next((k for k, f in enumerate(found) if f.effect.name in like_a_rest), None)

    def too_many(found: list[Found]) -> bool:
        return len(found) > FOR_SURE * FEW_CAUSES and first_of(found) is not None

    search, first = find_causes(*here[:4], forbid, alpha, progress, generator, enough=too_many), None
    taken = first_of(search.found)
    if taken is None or not too_many(search.found):
        first = ended(here, search)
        if taken is None or not first.strict:
            return first
        if not first.all_told:
            first = None  # its rows and columns are large
    kept = search.found[:taken]
    fading = [f for f in search.found[taken:] if f.effect.fades and _borne_out(here, kept, f)]
    left_out = [f for f in search.found[taken:] if f.effect.name in like_a_rest and f not in fading]
    others = [f for f in search.found if f not in left_out]
    p_value, shown = search.p_value, search.shown
    del search

    def anew(begun: list[Found]) -> Search:
        give_back_holes()
        return find_causes(*here[:4], [*forbid, *like_a_rest], alpha, progress, generator, Begun(begun, p_value, shown))

    search = anew(kept + fading)
    if len(others) > len(kept + fading) and _comes_near(here, others, search):
        other = anew(others)
        search = other if t_value(search.blocks, other.blocks) > T_BETTER else search
        del other
    give_back_holes()
    last = ended(here, search)
    if first and (not last.all_told or t_value(last.search.blocks, first.search.blocks) > T_BETTER):
        return first
    gone = (*last.gone, *(Nearest(f.name, f.share, LIKE_A_REST) for f in left_out))
    return last._replace(gone=gone, fading=tuple(f.name for f in fading))


def _comes_near(here: Setting, found: list[Found], search: Search) -> bool:
    """Whether some causes alone nearly predict what is left out as well as those that a search has ended with."""
    problem, start, _, whitening = here[:4]
    step = with_causes(problem, start, [f.effect for f in found], whitening)
    return step.verdicts.heldout < NEARLY * float(search.blocks.sum())


def _borne_out(here: Setting, before: list[Found], one: Found) -> bool:
    """Whether recordings kept out surely show a cause beside those that were found before it."""
    problem, start, whitening, found = here.problem, here.start, here.whitening, [*before, one]
    if not problem.held.any():
        return False
    step = polished(problem, start, [f.effect for f in found], whitening).step
    without = judged_without(problem, start, step, found, one, whitening)
    worse, better = (v.own(step.rows, one.joints).sum() for v in (without, step.verdicts))
    return beside_all(problem, start, whitening, found, step, one).surely(1 - float(better / max(worse, 1e-300)))


def _fitted_together(
    here: Setting, found: list[Found], forbid: Sequence[str], tolerance: float
) -> tuple[list[Found], Joint, tuple[Nearest, ...]]:
    """The causes that the others do not make needless and that surely have a size, all in one fit; and the others."""
    problem, start, whitening = here.problem, here.start, here.whitening
    found, bodies = rotors_for_bodies(problem, start, found, whitening, forbid)
    found, needless = eliminate(problem, start, found, whitening)
    found = at_their_links(problem, start, found, whitening)
    gone = [*bodies, *(Nearest(one.name, share, _NEEDLESS) for one, share in needless)]
    joint = together(here, found)
    kept = _simple(here, found, joint, forbid, tolerance)
    if kept != found:
        joint = together(here, kept)
    found, kept = kept, sized(kept, joint, forbid)
    if len(kept) < len(found):
        for one in (f for f in found if f.name not in [k.name for k in kept]):
            share, _ = taken_beside(problem, start, joint.step, found, one, whitening)
            gone.append(Nearest(one.name, share, f"{_UNSURE}: {_told_size(joint, found.index(one), here)}"))
        joint = together(here, kept)
    return kept, joint, tuple(gone)


def _told_apart(here: Setting, found: list[Found], joint: Joint) -> tuple[list[Found], Joint]:
    """The causes, each as that of those which slices cannot tell from it that recordings kept out surely prefer.

    They are asked at the joints where both act: elsewhere only one of them says anything.
    """
    problem, start, whitening = here.problem, here.start, here.whitening
    for k, one in enumerate(found if problem.held.any() else ()):
        for other in one.instead:
            known = problem.trust <= other.effect.needs_trust  # else it is no cause
            if not (known and physical_sign(other.effect)) or other.name in [f.name for f in found]:
                continue
            both = sorted({*one.joints} & {*other.joints})
            fits = ([x if at == k else e for at, e in enumerate(joint.causes)] for x in (joint.causes[k], other.effect))
            # both in one step from the same start, which leaves all that they share alike
            own, instead = (kept_out_error(problem, with_causes(problem, start, one, whitening)) for one in fits)
            if predicts_better(problem, own, instead, both):
                new = one.as_another(other, (one.name, *one.ambiguous))
                found = [new if f is found[k] else f for f in found]
                joint = polished(problem, start, [f.effect for f in found], whitening)
    return found, joint


def _possible(found: list[Found], joint: Joint) -> list[Found]:
    """The causes, each whose sign physics forbids as the best at its place that does as well, where there is one.

    Beside a rest it stays: it takes what another law would be named for.
    """
    out = []
    for one, effect in zip(found, joint.causes, strict=True):
        there = [o for o in one.instead if o.name.at == one.name.at and physical_sign(o.effect)]
        if there and not physical_sign(effect):
            one = one.as_another(there[0], one.ambiguous)
        out.append(one)
    return out


def _simple(here: Setting, found: list[Found], joint: Joint, forbid: Sequence[str], tolerance: float) -> list[Found]:
    """The causes, each as the simpler effect that it contains where it adds to that no more than is tolerable."""
    problem, state, out = here.problem, joint.step.state, []
    for one, effect, at in zip(found, joint.causes, amplitude_places(state, joint.causes), strict=True):
        inside = next((n for n in type(effect).contains if n not in forbid), None)
        if inside and beyond_simpler(problem, state, effect, at) < tolerance:
            where = one.name.at
            alike = [Name(n, where) for n in related(inside, "indistinguishable_from") if n not in forbid]
            simpler = Rival(Name(inside, where), place(find(inside), problem.model, where), one.joints)
            one = one.as_another(simpler, alike)
        out.append(one)
    return out


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
    relative = relative_rest(problem, joint.step.state, noise_rms(problem, here.spectrum))
    large = float(relative.max()) > tolerance
    shown = left.rest.there or ((bool(nearest) or doubted) and large)
    if shown and not named and not left.rest.there and not doubted and short(problem, joint.step.state):
        sober = sober_spectrum(problem, joint.step.state, forbid)
        shown = chance_beside(problem, joint.step, sober, here.whitening, forbid, generator) < REST_P
    same = here.whitening is searched.here.whitening
    told = joint.step if same else stand(problem, joint.step.state, searched.here.whitening)
    stays = _Stays(True, False, False)
    if not contradictions:
        law = any(strong(one) and against[one.name] for one in each)  # it moves, whatever it is
        stays = _as_what(searched, here, gaining, by_speed, told, shown, law, reader, tolerance, generator)
    rest, sticks, read = stays
    text = (left.rest.text or ("" if relative.any() else _LESS_THAN_NOISE)) if rest and shown else ""
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
            why = f"{_UNSURE}: {_told_size(moving, least, here)}"
        elif not searched.strict and (least := least_sure(gaining.joint)) is not None:  # a rest widens what is told
            why = f"{_UNSURE}: {_told_size(gaining.joint, least, here)}"
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


def _told_size(joint: Joint, which: int, here: Setting) -> str:
    """A cause's parameters with their intervals, in words; an angle that may be any says nothing of a size."""
    each = estimates(joint.causes[which], joint.fitted, joint.fitted.places[which], here.problem.model)
    told = [(name, e.value, 1.96 * e.std, e.unit) for name, e in each.items()]
    sizes = [one for one in told if not (one[3] == "rad" and one[2] > 2 * np.pi)] or told
    return ", ".join(f"{name} {value:.3g} +- {half:.2g} {unit}".rstrip() for name, value, half, unit in sizes)


def _left(
    here: Setting,
    search: Search,
    found: list[Found],
    joint: Joint,
    forbid: Sequence[str],
    tolerance: float,
    generator: np.random.Generator,
) -> Left:
    """What all causes together leave."""
    problem, start, spectrum, whitening, _ = here
    first = stand(problem, start, whitening)
    before, *_ = excess(problem, first.rows, first.linear.residual, spectrum, whitening)
    now = excess(problem, joint.step.rows, joint.step.linear.residual, spectrum, whitening)
    smooth = families(problem, joint.step.state, whitening)
    flexible = flexible_p(problem, joint.step, smooth, spectrum, whitening, generator)
    line = lines(problem, joint.step.linear.residual)
    noise = noise_rms(problem, spectrum)
    size = float(relative_rest(problem, joint.step.state, noise).max())
    predicted = predictable(joint.step, smooth)
    del smooth  # their rows are large
    p_left = search.p_left
    if len(found) < len(search.found):  # it was asked beside causes that have gone
        p_left = chance_beside(problem, joint.step, spectrum, whitening, forbid, generator)
    joints, tolerable = problem.model.joint_names, size <= tolerance
    left = significance(now, max(before, 0.0), p_left, flexible, line, joints, predicted, tolerable)
    wrong = bool(found) and wrong_law(found[0].name.at, found[0].cost[0] - found[0].cost[1], flexible)
    loud, quiet = beyond_noise(problem, joint.step.linear.residual, spectrum, whitening, generator)
    there, rows, linear, follows = left.there, joint.step.rows, joint.step.linear, None
    if not there and not tolerable and (wrong or loud.any()):
        # of few rows a rich model's residual is less than the noise, and what repeats do not repeat is no misfit
        again = loud <= OF_REPEATED * repeating(problem, rows, linear.residual, np.ones(linear.residual.shape, bool))
        there = not short(problem, joint.step.state) and bool(wrong or (again & (loud > 0)).any())
        there = there or bool((foretold(problem, joint.step.state, forbid) & (wrong | (loud > 0))).any())
    if quiet.any() and not there and not found:  # rows of little weight have less than noise
        full = np.moveaxis(problem.records.weight >= problem.records.fitted, 2, 0).reshape(rows.y.shape)
        quiet = beyond_noise(problem, linear.residual, spectrum, whitening, generator, full, (rows, linear))[1]
    if not problem.layout.repeats and not found and not there:  # nor is it known how much of what is left is noise
        large = relative_rest(problem, joint.step.state, 0 * noise) > tolerance
        rough = roughly_predictable(problem, joint.step, whitening, tolerance)
        follows = follows_others(problem, joint.step.state, tolerance)
        left = left._replace(text=follows.text if follows else left.text)
        there = bool((quiet & large).any() or rough.any() or follows)
    moves = np.moveaxis(~resting(problem), 2, 0).reshape(joint.step.rows.y.shape)
    beyond, alone = (
        beyond_noise(problem, step.linear.residual, spectrum, whitening, generator, moves)[0]
        for step in (joint.step, first)
    )
    # what a wrong law leaves shows in all rows too, and is there again in a repeat: what noisy positions make is not
    beyond = np.minimum(beyond, loud)
    beyond = np.minimum(beyond, repeating(problem, rows, linear.residual, moves))
    misfit = (alone > 0) | (relative_rest(problem, first.state, noise) > tolerance)
    followed = flexible.each * (predicted and flexible.p < REST_P)
    moved = (alone > 0) | (left_moving(problem, first.state, noise) > tolerance)
    return Left(
        left._replace(there=there), p_left, now[0], line, flexible.each, beyond, misfit, followed, moved, follows
    )


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
    return Diagnosis(
        verdict=judged.word,
        causes=tuple(
            Cause(
                Name(*one.name),
                estimates(effect, joint.fitted, joint.fitted.places[k], model),
                one.confidence,
                gain,
                tuple(dict.fromkeys(Name(*n) for n in one.ambiguous if tuple(n) != tuple(one.name))),
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
        rest=replace(judged.rest, nearest=tuple(map(_told, judged.rest.nearest))),
        links=moved_links(problem, first, last, here.whitening, welded),
        notes=(
            *_notes(signals, here, last),
            *([_LINKS_HELD] if judged.causes.links_held else []),
            *([_AT_REST] if judged.sticks else []),
        ),
        prismatic=prismatic(model),
    )


def _told(near: Nearest) -> Nearest:
    if not isinstance(near.name, OneMore):
        return near
    return replace(near, name=Name(*near.name), why_not=f"one more of it at that place: {near.why_not}")


_NEEDLESS = "beside the other causes it predicts nothing more of the held-out data: they explain the same misfit"
_UNSURE = "its size is not surely above zero"
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
