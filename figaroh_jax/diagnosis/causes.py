"""The causes that the data show, all in one fit, and what they leave together: what a diagnosis judges."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..compiled.memory import give_back_holes
from ..effects.base import place
from ..effects.catalogue import CATALOGUE, find, related
from ..results import Name, Nearest
from .answer_fit import together
from .comparison import t_value
from .constancy import of_one_recording, still_changed
from .drives import rotors_for_bodies
from .estimates import amplitude_places, estimates
from .flexible import families, flexible_p
from .floor import foretold, noise_rms, short
from .gaining import beside_all, predicts_better
from .gates import physical_sign
from .holdout import kept_out_error
from .joint import Joint, polished, sized
from .judgement import Left, Searched
from .naming import LIKE_A_REST, beyond_simpler
from .rest import (
    beyond_noise,
    excess,
    follows_motion,
    lines,
    predictable,
    relative_rest,
    repeating,
    roughly_predictable,
    significance,
    wrong_law,
)
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
from .setting import Setting
from .standstill import left_moving, resting
from .step import stand, with_causes
from .thresholds import FEW_CAUSES, FOR_SURE, NO_REST, OF_REPEATED, REST_P, T_BETTER

__all__ = ["UNSURE", "possible", "searched_causes", "told_size"]

NEARLY = 1.1  # times the held-out squares of a search, up to which it is worth another one from other causes
UNSURE = "its size is not surely above zero"
_NEEDLESS = "beside the other causes it predicts nothing more of the held-out data: they explain the same misfit"


def searched_causes(
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
    asked = (forbid, tolerance, progress, generator)
    of_one = [n for n, e in CATALOGUE.items() if e.acts_on in ("joint", "pair") or e.inertial]
    like_a_rest = [name for name in of_one if not CATALOGUE[name].beside_rest]

    def first_of(found: list[Found]) -> int | None:
        return next((k for k, f in enumerate(found) if f.effect.name in like_a_rest), None)

    def too_many(found: list[Found]) -> bool:
        return len(found) > FOR_SURE * FEW_CAUSES and first_of(found) is not None

    search, first = find_causes(*here[:4], forbid, alpha, progress, generator, enough=too_many), None
    taken = first_of(search.found)
    if taken is None or not too_many(search.found):
        first = _ended(here, search, *asked)
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
    last = _ended(here, search, *asked)
    if first and (not last.all_told or t_value(last.search.blocks, first.search.blocks) > T_BETTER):
        return first
    gone = (*last.gone, *(Nearest(f.name, f.share, LIKE_A_REST) for f in left_out))
    return last._replace(gone=gone, fading=tuple(f.name for f in fading))


def _ended(
    before: Setting,
    search: Search,
    forbid: Sequence[str],
    tolerance: float,
    progress: Callable[[str, float], None],
    generator: np.random.Generator,
) -> Searched:
    """What a search has found, all in one fit, and what that leaves."""
    here = before._replace(problem=search.problem, start=search.start)
    progress("fitting all causes together", 0.8)
    found, joint, gone = _fitted_together(here, search.found, forbid, tolerance)
    found, joint = _told_apart(here, found, joint)
    give_back_holes()
    left = _left(here, search, found, joint, forbid, tolerance, generator)
    strict = left.rest.there or left.excess > NO_REST or len(found) > FEW_CAUSES
    if not strict and (kept := possible(found, joint)) != found:
        found, joint = kept, together(here, kept)
        left = _left(here, search, found, joint, forbid, tolerance, generator)
        strict = left.rest.there or left.excess > NO_REST
    if left.follows:
        noise = here.spectrum.at_most(noise_rms(here.problem, here.spectrum), left.follows.noise)
        here = here._replace(spectrum=noise)
    return Searched(before, here, search, found, joint, left, strict, gone)


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
            gone.append(Nearest(one.name, share, f"{UNSURE}: {told_size(joint, found.index(one), here)}"))
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


def possible(found: list[Found], joint: Joint) -> list[Found]:
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
        follows = follows_motion(problem, joint.step.state, tolerance, ~resting(problem))
        follows = follows or of_one_recording(problem, joint.step, tolerance)
        left = left._replace(text=follows.text if follows else left.text)
        there = bool((quiet & large).any() or rough.any() or follows)
    if changed := still_changed(problem, joint.step, tolerance):
        left, there, follows = left._replace(text=changed.text), True, changed
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


def told_size(joint: Joint, which: int, here: Setting) -> str:
    """A cause's parameters with their intervals, in words; an angle that may be any says nothing of a size."""
    each = estimates(joint.causes[which], joint.fitted, joint.fitted.places[which], here.problem.model)
    told = [(name, e.value, 1.96 * e.std, e.unit) for name, e in each.items()]
    sizes = [one for one in told if not (one[3] == "rad" and one[2] > 2 * np.pi)] or told
    return ", ".join(f"{name} {value:.3g} +- {half:.2g} {unit}".rstrip() for name, value, half, unit in sizes)
