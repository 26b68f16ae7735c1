"""The search for causes in an arm: the whole arm simulated from its commands, each joint judged by its own encoder.

One linearisation of the arm ranks what every joint could lack; the best of each joint are fitted with everything else
free. Causes of several joints may be found in one round: each must lower what its own encoder shows in recordings or
quarters of the time that a fit has not seen, and must be missed where it alone is taken away again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from scipy.special import ndtr

from ..results import Name, Verdict
from .alike import instead, names, rivals
from .causes import Candidate
from .faults import Fault, faults, without
from .fit import Fit, fit, spread_of_recordings
from .found import TOO_LITTLE, Model, Named, Search, Tried, all_but
from .gates import Slight, checked, gained, in_order, needless, replaced, rms_of, standing, still_needed, worthy
from .parameters import put, values
from .screening import LATE, ROUGH, Known, Standing, excess_of, joint_of, joint_of_entry, outputs, sprung_now, tried_now
from .search import in_short_windows, judged_by_colour, quiet
from .sensitivity import predicted
from .setting import (
    Setting,
    Structure,
    bare,
    begins_of,
    begun,
    by_readings,
    by_recording,
    evened,
    free_entries,
    level_of,
    thinned,
)
from .shared import at_all_joints, t_together
from .sizes import fitted_without, simpler, sized, why_not_sized
from .steady import in_doubt
from .table import on_table
from .thresholds import FEWEST_JOINTS, NEAR, NO_CHOICE, T_BESIDE_REST, UNTOLD, t_of

__all__ = ["alike_by_recording", "as_sure_together", "baseline_alone", "search_arm"]

_AGAIN = 6  # iterations from the numbers of the model file
_TOP, _CHECKS = 3, 4  # candidates told as the nearest; those whose held-out squares are looked at in a round
_FIRST = 4  # iterations from each start of the baseline
_EVENED = 3  # fits of all that was recorded, each with weights by what the one before has left


def search_arm(
    here: Setting, progress: Callable[[str, float], None] = lambda phase, share: None, *, forbid: Sequence[str] = ()
) -> Search:
    """Causes of an arm whose drives act at one joint each and whose joints are all measured."""
    found = _by_parts(here, _searched(here, progress, forbid), progress, forbid)
    if (again := by_readings(found.setting or here, found.last)) is not None:
        told = found.faults
        found = _searched(again, progress, forbid)
        found.faults = [*told, *found.faults]
    return judged_by_colour(here, found, lambda again: _by_colour(again, found, forbid))


def _by_parts(here: Setting, found: Search, progress: Callable[[str, float], None], forbid: Sequence[str]) -> Search:
    """A search; where it has ended far from noise, the causes of one in short windows, if noise alone is left by them.

    What a long simulation has lost sight of, as where a drive's limit lets a joint fall, shows no cause.
    """
    here, origin = found.setting or here, found.origin
    if origin is None:
        return found
    verdicts = ("nothing", "named")
    seen = in_short_windows(here, found, progress, lambda parts: _searched(parts, quiet, forbid), verdicts)
    if seen is None:
        return found
    free = [int(k) for k in seen.last.free if k >= 0]
    now = standing(here, seen.structure, seen.last, free)
    if not now.excess.max() < 1.0:
        return found
    begin = standing(here, origin, found.first, here.baseline)
    return _ended(here, found, seen.short.named, now, begin)


def _ended(here: Setting, search: Search, found: list[Named], now: Standing, begin: Standing) -> Search:
    """A search that ends with these causes, of which noise alone is left."""
    found, now, slight = still_needed(here, found, now, begin)
    found, now = _alike(here, found, now) if slight is None else (found, now)
    held = [rms_of(here, begin.held), rms_of(here, now.held)]
    label = ", ".join(str(Name(n.candidate.effect, n.candidate.at)) for n in found)
    steps = [("baseline", _level(here, search.first)), (label, _level(here, now.model.fit))]
    told = Search("nothing", found, now.model.structure, search.first, now.model.fit, search.p_value, [], [], steps,
                  held, [now.model.fit], search.origin, here, search.faults)  # fmt: skip
    return _judged(here, told, now, slight)


def _by_colour(here: Setting, white: Search, forbid: Sequence[str]) -> Search:
    """The search with coloured noise; where it ends in another valley, the first causes of the search before it."""
    new = _searched(here, lambda phase, share: None, forbid)
    if new.verdict in ("nothing", "named") or new.beside is not None or new.origin is None:
        return new
    begin = standing(here, new.origin, new.first, here.baseline)
    for last in white.fits:
        free = [int(k) for k in last.free if k >= 0]
        found = [n for n in white.named or white.proxy if set(n.candidate.entries) <= set(free)]
        if set(free) - set(here.baseline) - {k for n in found for k in n.candidate.entries}:
            continue
        plain = len(last.theta) == len(here.known.table)
        loop, table = (here.loop, here.known.table) if plain else white.structure[:2]
        structure = Structure(loop, table, here.cut(loop))
        one = fit(*structure, last.theta[None], [free], last.start[None], width=max(here.width, len(free)), lanes=1,
                  iterations=LATE)[0]  # fmt: skip
        now = standing(here, structure, one, free)
        if not now.excess.max() < 1.0:
            continue
        return _ended(here, new, found, now, begin)
    return new


class _Course(NamedTuple):
    """How a search went: chi2/N, held-out RMS (rad or m) and fit after each round; the baseline's come first."""

    steps: list[tuple[str, float]]
    held: list[float]
    fits: list[Fit]  # of the rounds alone


def _rounds(
    here: Setting, begin: Standing, forbid: Sequence[str], progress: Callable[[str, float], None]
) -> tuple[list[Named], Standing, list[tuple[Name, float, str]], _Course]:
    """Causes round after round until none comes in or noise alone is left: these, the model, and what came near."""
    found, now, known = list[Named](), begin, Known()
    nearest: list[tuple[Name, float, str]] = []
    steps, held, fits = course = _Course([("baseline", _level(here, begin.model.fit))], [rms_of(here, begin.held)], [])
    while np.isfinite(begin.model.fit.cost):
        number = len(steps)
        progress(f"searching for causes, round {number}", min(0.1 + 0.12 * number, 0.9))
        new, now, nearest = _round(here, now, found, forbid, nearest, known)
        if not new and now.excess.max() >= 1.0:
            new, now = at_all_joints(here, now, found)
        if not new:
            break
        found = [n for n in found if not any(replaced(n, one) for one in new)] + new
        steps.append(
            (", ".join(str(Name(n.candidate.effect, n.candidate.at)) for n in new), _level(here, now.model.fit))
        )
        held.append(rms_of(here, now.held))
        fits.append(now.model.fit)
        if now.excess.max() < 1.0:
            break
    return found, now, nearest, course


def _searched(
    here: Setting, progress: Callable[[str, float], None], forbid: Sequence[str], *, told: bool = False
) -> Search:
    """The search in rows that count; `told`: those in which the end rests on a table are left out already."""
    progress("fitting the baseline", 0.05)
    whole, here = here, thinned(here)
    first, wrong = _begun(here), list[Fault]()
    if here.pole is None:  # a colour is told from sound rows
        whole, wrong = _sound(whole, first if whole is here else _started(whole, first))
    if wrong:
        here = thinned(whole)
        first = _begun(here)
    begin = standing(here, Structure(here.loop, here.known.table, here.data), first, here.baseline)
    p_value = 1.0 if not np.isfinite(first.cost) else float(max(ndtr(-4 * begin.excess.max()), 1e-12))
    found, now, nearest, (steps, held, fits) = _rounds(here, begin, forbid, progress)
    if found and now.excess.max() < 1.0 and (alone := bare(here, now.model.fit)) is not None:
        first, found = alone, list[Named]()
        begin = now = standing(here, Structure(here.loop, here.known.table, here.data), first, here.baseline)
        p_value, (steps, held, fits) = 1.0, _Course([("baseline", _level(here, first))], [rms_of(here, now.held)], [])
    progress("judging", 0.9)
    found, now, slight = still_needed(here, found, now, begin)
    found, now = _alike(here, found, now) if slight is None else (found, now)
    even = by_recording(whole) and bool(found) and now.excess.max() >= 1.0
    rest = now.excess.max() >= 1.0 and not found and whole.pole is None
    look = not told and (even or (rest and _has_friction(now.model)))
    if look:  # beside a rest alone: noise leaves nothing to a table
        progress("looking for a table", 0.92)
    whole, resting = _off_the_table(whole, now.model) if look else (whole, [])
    wrong = [x for x in wrong if not any(_same_place(x, y) for y in resting)]
    if resting and not even:  # with these rows nothing was named: once more without
        again = _searched(whole, progress, forbid, told=True)
        new = [x for x in again.faults if not any(_same_place(x, y) for y in [*wrong, *resting])]
        again.faults, again.setting = [*wrong, *resting, *new], again.setting or whole
        return again
    if whole is not here:
        progress("fitting all that was recorded", 0.95)
        begin, now, here = _on_all(whole, begin.model), _on_all(whole, now.model), whole
        first = begin.model.fit
        steps.append(("all that was recorded", _level(here, now.model.fit)))
    spread = None
    if even:
        now, spread = alike_by_recording(here, now)
        steps.append(("recordings that are equally informative", _level(here, now.model.fit)))
    doubtful = list[tuple[Name, float, str]]()
    while slight is None and (less := _of_sure_size(here, now, found, spread, even, forbid)) is not None:
        gone, found, now, spread = less
        doubtful += gone
        steps.append((f"without {', '.join(str(one[0]) for one in gone)}", _level(here, now.model.fit)))
        held.append(rms_of(here, now.held))
    result = Search(
        "nothing", found, now.model.structure, first, now.model.fit, p_value, [], nearest, steps, held, fits,
        begin.model.structure, here, [*wrong, *resting], spread, doubtful,
    )  # fmt: skip
    return _judged(here, result, now, slight)


def _of_sure_size(
    here: Setting, now: Standing, found: list[Named], spread: np.ndarray | None, even: bool, forbid: Sequence[str]
) -> tuple[list[tuple[Name, float, str]], list[Named], Standing, np.ndarray | None] | None:
    """What is told of the least sure cause whose told interval holds no effect, and the model without it; else None.

    Beside a rest also of one whose size is not the same throughout. With it go those of other joints that have its
    numbers.
    """
    if (verdict := _verdict(here, now, found)) not in ("named", "named+rest"):
        return None
    doubt = in_doubt([n.candidate for n in found], here, *now.model[:2], spread, rest=verdict == "named+rest")
    if doubt is None:
        return None
    gone, why = doubt
    kept = all_but(found, gone)
    told = [(Name(n.candidate.effect, n.candidate.at), max(n.gain, 0.0), why) for n in found if n not in kept]
    return told, *_without(here, now, kept, gone, even, forbid)


def _without(
    here: Setting, now: Standing, found: list[Named], gone: Candidate, even: bool, forbid: Sequence[str]
) -> tuple[list[Named], Standing, np.ndarray | None]:
    """The model without a cause that may be nothing, or with what it contains where that holds on rows left out."""
    old = now.model
    structure, last, free = fitted_without(here, old.structure, old.fit, old.free, gone, ROUGH)
    less = simpler(here, old.structure, old.fit, old.free, gone, forbid)
    now = standing(here, structure, last, free)
    if less is not None:
        candidate, one, kept = less
        state = Model(old.structure, one, kept, 0.0)
        new = _named(here, now, {}, [Tried(candidate, state, outputs(here, one.sums.cost))], found)
        found, now = (found, now) if new is None else ([*found, *new[0]], new[1])
    if not even or now.excess.max() < 1.0:
        return found, now, None
    return found, *alike_by_recording(here, now)


def _started(here: Setting, first: Fit) -> Fit:
    """The states at the starts of all windows with numbers that were fitted to some."""
    structure = Structure(here.loop, here.known.table, here.data)
    return fit(*structure, first.theta[None], [[]], width=1, lanes=1, iterations=_FIRST, rough=ROUGH)[0]


def _on_all(here: Setting, model: Model) -> Standing:
    """A model of some windows fitted to all of them; what is held out was asked of the windows of the search."""
    structure = model.structure._replace(data=here.cut(model.structure.loop))
    new = _from(here, structure, model.fit, model.free) if np.isfinite(model.fit.cost) else model.fit
    return standing(here, structure, new, model.free, held=False)


def alike_by_recording(here: Setting, now: Standing) -> tuple[Standing, np.ndarray]:
    """The numbers where more than noise is left: each recording tells as much of a joint, not the fastest the most.

    With them how differently recordings, and quarters of each recording's time, tell each, (columns of the fit,): a
    friction that falls as all the recordings go on shows in the latter alone.
    """
    structure, last, free = now.model.structure, now.model.fit, now.model.free
    for _ in range(_EVENED):
        some = evened(here, structure, last)
        last = _from(some, structure._replace(data=some.cut(structure.loop)), last, free)
    spread = np.hypot(
        spread_of_recordings(structure.table, last, here.folds),
        spread_of_recordings(structure.table, last, _quarters(here, structure), alike=True),
    )
    last = _from(here, structure, last, free, 0)
    beyond = excess_of(here, structure, last)
    model = Model(structure, last, free, float(beyond.max()))
    return Standing(model, outputs(here, last.sums.cost), now.held, beyond), spread


def baseline_alone(here: Setting, found: Search) -> None:
    """The fit of the baseline is what stands where no cause has a name; each recording tells as much of it."""
    structure = Structure(here.loop, here.known.table, here.data)
    beyond = excess_of(here, structure, found.first)
    now = standing(here, structure, found.first, here.baseline, held=False)._replace(excess=beyond)
    if by_recording(here):
        now, found.spread = alike_by_recording(here, now)
    found.structure, found.last = structure, now.model.fit


def _quarters(here: Setting, structure: Structure) -> np.ndarray:
    """Which quarter of its recording each block and window is in, (blocks, windows)."""
    blocks = np.arange(structure.data.reading.shape[0] // structure.data.block)[:, None] * structure.data.block
    first = np.array([one.first for one in here.stretches])
    length = np.array([len(here.runs[one.run].time) for one in here.stretches])
    return np.clip((first + blocks) * 4 // length, 0, 3)


def _from(here: Setting, structure: Structure, last: Fit, free: Sequence[int], most: int = LATE) -> Fit:
    """The fit of these numbers from another of the same structure; the states at the starts too, where it had them."""
    start = last.start[None] if last.start.shape[1] == len(here.stretches) else None
    return fit(*structure, last.theta[None], [free], start, width=max(here.width, len(free)), lanes=1, iterations=most,
               rough=ROUGH)[0]  # fmt: skip


def _begun(here: Setting) -> Fit:
    """The baseline's fit: where it has several starts, each joint goes on from the one that its encoder likes best."""
    structure = Structure(here.loop, here.known.table, here.data)
    begins = begins_of(here, values(here.loop, here.known.table))
    if len(begins) == 1:
        return begun(here)
    early = [
        fit(*structure, x[None], [here.baseline], width=here.width, lanes=1, iterations=_FIRST, rough=ROUGH)[0]
        for x in begins
    ]
    early = [one for one in early if np.isfinite(one.cost)]
    if not early:
        return begun(here)
    best = min(early, key=lambda one: one.cost)
    theta, start, n = best.theta.copy(), best.start.copy(), here.loop.robot.nv
    squares = [outputs(here, one.sums.cost).sum((0, 1)) for one in early]
    for j in range(n):
        own = early[int(np.argmin([x[j] for x in squares]))]
        mine = [k for k in here.baseline if joint_of_entry(here, k) == j]
        theta[mine], start[[j, n + j]] = own.theta[mine], own.start[[j, n + j]]
    mixed, usual = (
        fit(*structure, x[None], [here.baseline], y[None], width=here.width, lanes=1, rough=ROUGH, iterations=most)[0]
        for x, y, most in ((theta, start, LATE), (best.theta, best.start, 0))
    )
    if not mixed.cost < usual.cost:
        mixed = fit(*structure, best.theta[None], [here.baseline], best.start[None], width=here.width, lanes=1)[0]
    return mixed


def _judged(here: Setting, result: Search, now: Standing, slight: Slight | None = None) -> Search:
    """`named` where every joint's rest is noise; `named+rest` where the names hold without each of three recordings.

    Also where a cause that is too slight to be told from the error of another's law explains the rest.
    """
    found = result.named
    if slight is not None:
        one, why = slight.cause.candidate, "too little beside what others explain: their laws may be off by as much"
        result.verdict, result.beside = "named+rest", slight.fit
        result.nearest = [(Name(one.effect, one.at), max(slight.cause.gain, 0.0), why)]
        return result
    result.verdict = _verdict(here, now, found)
    if result.verdict == "unknown":
        result.proxy, result.named = found, []
    return result


def _verdict(here: Setting, now: Standing, found: Sequence[Named]) -> Verdict:
    if now.excess.max() < 1.0:
        return "named" if found else "nothing"
    return "named+rest" if found and by_recording(here) and found[0].t > T_BESIDE_REST else "unknown"


def _sound(here: Setting, first: Fit) -> tuple[Setting, list[Fault]]:
    """The setting without the rows that no loop explains, and what is wrong with these."""
    read = _simulated(here, first)
    if read is None:
        return here, []
    found = faults(put(here.loop, here.known.table, first.theta), here.runs, read)
    if not found:
        return here, []
    runs = without(here.runs, found)
    here = replace(here, runs=runs)
    return replace(here, data=here.cut(here.loop)), found


def _off_the_table(here: Setting, model: Model) -> tuple[Setting, list[Fault]]:
    """The setting without the rows in which the arm's end rests on something, and where that is.

    It is told by a model with friction alone: without, all that friction holds looks as if something held it.
    """
    structure = model.structure
    table = on_table(put(structure.loop, structure.table, model.fit.theta), here.runs)
    if table is None:
        return here, []
    found = [
        Fault("contact", x.run, x.first, x.last, x.joints, x.force, table.height) for x in table.stretches
    ]  # fmt: skip
    here = replace(here, runs=without(here.runs, found))
    return replace(here, data=here.cut(here.loop)), found


def _has_friction(model: Model) -> bool:
    """Whether dry friction stands at every joint: all that it holds looks as if something held it, else."""
    joints = put(model.structure.loop, model.structure.table, model.fit.theta).joints
    return bool((np.asarray(joints.friction) > 0).all())


def _same_place(one: Fault, other: Fault) -> bool:
    """Whether both tell of the same rows that something holds the arm."""
    return one.kind == other.kind and one.run == other.run and one.first <= other.last and other.first <= one.last


def _simulated(here: Setting, first: Fit) -> list[np.ndarray] | None:
    """What the encoders of a baseline read, (rows, joints) of each recording, or None where it diverges."""
    with jax.enable_x64(True):
        read = np.asarray(predicted(here.loop, here.known.table, first.theta[None], here.data, first.start[None]))[0]
    if not (np.abs(read) < 1e3).all():
        return None
    found, ny = [], len(here.loop.measured)
    for k, run in enumerate(here.runs):
        model = np.zeros((len(run.time), ny))
        for w, one in enumerate(here.stretches):
            if one.run == k:
                model[one.first : one.first + one.rows] = read[: one.rows, :ny, w]
                model[one.first + one.rows :] = read[one.rows - 1, :ny, w]  # rows that no window covers
        found.append(model)
    return found


def _round(
    here: Setting, now: Standing, found: Sequence[Named], forbid: Sequence[str], nearest: list, known: Known
) -> tuple[list[Named], Standing, list]:
    """Causes to name next, at most one of each joint, and the model with them."""
    tried = tried_now(here, now, [n.candidate for n in found], forbid, known)
    lists: dict[int, list[Tried]] = {}
    for one in tried:
        lists.setdefault(joint_of(here, one.candidate), []).append(one)
    if not lists:
        return [], now, nearest
    springs = _springs_first(here, now, tried, found, forbid)
    for one in springs:  # a spring at one joint stands in for that of the next, whose own encoder hardly shows it
        if (j := joint_of(here, one.candidate)) in known:
            lists.setdefault(j, []).append(one)
    sprung = _spring_alone(here, now, tried, springs, found)
    if sprung is not None:
        return *sprung, nearest
    ordered = {
        j: [one for one in in_order(now, ones) if one.candidate not in known[j].refused and worthy(here, now, one)]
        for j, ones in lists.items()
    }
    kept: list[Named] = []
    for _ in range(_CHECKS):
        firsts = sorted((ones[0] for ones in ordered.values() if ones), key=lambda one: -gained(now, one))
        if not firsts:
            break
        chosen = [one for one in firsts if any(replaced(n, one) for n in found)][:1] or firsts[:1]
        if chosen[0].candidate.kind.usual:  # what every joint has is found at all of them at once
            chosen = [one for one in firsts if one.candidate.kind.usual]
        new = _named(here, now, lists, chosen, found)
        if new is not None:
            kept, now = _beside_springs(new, springs)
            break
        for one in chosen:
            known[joint_of(here, one.candidate)].refused.append(one.candidate)
        ordered = {j: [one for one in ones if all(one is not x for x in chosen)] for j, ones in ordered.items()}
    close = sorted(tried, key=lambda one: one.sse.sum())[:_TOP]
    total = float(now.squares.sum())
    if not kept:
        nearest = [
            (Name(one.candidate.effect, one.candidate.at), max(float((total - one.sse.sum()) / total), 0.0),
             (why_not_sized(here, one) if worthy(here, now, one) else "") or TOO_LITTLE)
            for one in close
        ]  # fmt: skip
    return kept, now, nearest


def _springs_first(
    here: Setting, now: Standing, tried: Sequence[Tried], found: Sequence[Named], forbid: Sequence[str]
) -> list[Tried]:
    """A spring at every joint before the first cause, unless something is missing that every joint has.

    A spring acts at the joints beside its own too, and one linear step tells little of it: ranked by that, a payload or
    a neighbour's spring comes first and stays.
    """
    if found or any(one.candidate.kind.usual for one in tried):
        return []
    return sprung_now(here, now, forbid)


def _spring_alone(
    here: Setting, now: Standing, tried: Sequence[Tried], springs: Sequence[Tried], found: Sequence[Named]
) -> tuple[list[Named], Standing] | None:
    """A spring, or play, with which noise alone is left, and which no other cause comes near."""
    clean = [one for one in springs if one.state.excess < 1.0]
    if not clean:
        return None
    best = in_order(now, clean)[:1]
    others = [one.state.fit.squares for one in tried if not one.candidate.kind.elastic]
    if not best or not best[0].state.fit.squares < min(others, default=np.inf) - NO_CHOICE:
        return None
    j = joint_of(here, best[0].candidate)
    return _named(here, now, {j: [one for one in clean if joint_of(here, one.candidate) == j]}, best, found)


def _beside_springs(new: tuple[list[Named], Standing], springs: Sequence[Tried]) -> tuple[list[Named], Standing]:
    """What is named with the springs that leave noise alone as well."""
    named, model = new
    if not model.excess.max() < 1.0:
        return new
    alike = [one.candidate for one in springs
             if one.state.excess < 1.0 and one.state.fit.squares < model.model.fit.squares + NO_CHOICE]  # fmt: skip
    told = tuple(Name(c.effect, c.at) for c in alike)
    return [n._replace(alike=tuple(dict.fromkeys([*n.alike, *told]))) for n in named], model


def _named(
    here: Setting, now: Standing, lists: dict[int, list[Tried]], chosen: Sequence[Tried], found: Sequence[Named]
) -> tuple[list[Named], Standing] | None:
    """The chosen causes that hold: all fitted together, those that held-out rows or the others do not need left out."""
    chosen = list(chosen)
    while chosen:
        new = _together(here, now, chosen)
        if not found or any(one.candidate.kind.elastic for one in chosen):
            new = _again(here, new, [n.candidate for n in found])
        if not np.isfinite(new.fit.cost):
            return None
        with_all = standing(here, new.structure, new.fit, new.free)
        checks = [checked(here, now, with_all, one) for one in chosen]
        keep = [one for one, (good, _, _) in zip(chosen, checks, strict=True) if good]
        if len(keep) < len(chosen):
            chosen = keep
            continue
        spare = needless(here, with_all, chosen) if len(chosen) > 1 else None
        if spare is None:
            named = [_name(here, now, with_all, one, lists, check) for one, check in zip(chosen, checks, strict=True)]
            named = as_sure_together(here, now, with_all, named)
            return sorted(named, key=lambda n: n.after**2 - n.before**2), with_all
        chosen = [one for one in chosen if one is not spare]
    return None


def as_sure_together(here: Setting, now: Standing, new: Standing, named: list[Named]) -> list[Named]:
    """What three joints or more turn out to have in one round is borne out by all of them."""
    alike = len({n.candidate.effect for n in named}) == 1 and len(named) >= FEWEST_JOINTS
    if not (alike and by_recording(here)):
        return named
    runs, joints = np.array([x.run for x in here.stretches]), [joint_of(here, n.candidate) for n in named]
    t = t_together(now.held, new.held, runs, joints)
    return [n._replace(t=max(n.t, t)) for n in named]


def _together(here: Setting, now: Standing, chosen: Sequence[Tried]) -> Model:
    """All chosen causes in one fit, from where each ended by itself."""
    lone = next((one for one in chosen if one.candidate.kind.elastic or (one.alone and len(chosen) == 1)), None)
    begin = now.model if lone is None else lone.state
    structure, start, theta = begin.structure, begin.fit.start, begin.fit.theta.copy()
    free = list(now.model.free)
    for one in chosen:
        entries = list(one.candidate.entries)
        own = free_entries([k for k in now.model.free if _of_joint(here, k, one.candidate)], entries)
        theta[own] = one.state.fit.theta[own]
        free = free_entries(free, entries)
    last = fit(*structure, theta[None], [free], start[None], width=max(here.width, len(free)), lanes=1,
               iterations=LATE, rough=ROUGH if by_recording(here) else 0.0)[0]  # fmt: skip
    return Model(structure, last, tuple(free), 0.0)


def _again(here: Setting, new: Model, before: Sequence[Candidate]) -> Model:
    """The fit once more from the numbers of the model file, the new causes where they are: the better of both.

    A baseline that was fitted without a cause may end in another valley than with it, and so may causes found before.
    """
    structure, last = new.structure, new.fit
    if not np.isfinite(last.cost) or excess_of(here, structure, last).max() < 1.0:
        return new
    theta, stated = last.theta.copy(), values(structure.loop, structure.table)
    old = [k for c in before if not c.kind.elastic for k in c.entries if np.isfinite(stated[k])]
    theta[[*here.baseline, *old]] = stated[[*here.baseline, *old]]
    start, n, more = np.array(last.start), here.loop.robot.nv, structure.loop.robot.nv - here.loop.robot.nv
    begin = np.asarray(here.data.start)
    start[:n], start[n + more : 2 * n + more] = begin[:n], begin[n:]
    for most, near in ((_AGAIN, 2.0), (LATE, 1.0)):
        other = fit(*structure, theta[None], [new.free], start[None], width=max(here.width, len(new.free)), lanes=1,
                    iterations=most, rough=ROUGH)[0]  # fmt: skip
        if not other.cost < near * last.cost:
            return new
        theta, start = other.theta, other.start
    return new._replace(fit=other) if other.cost < (1 - ROUGH) * last.cost else new


def _of_joint(here: Setting, entry: int, c: Candidate) -> bool:
    """Whether a number belongs to the joint of a cause."""
    mine = {k for other in here.known.candidates if other.at == c.at for k in other.entries}
    name = here.known.table[entry] if entry < len(here.known.table) else None
    return entry in mine or (name is not None and entry in _numbers(here, c))


def _numbers(here: Setting, c: Candidate) -> set[int]:
    """Entries of the table at the joint of a cause."""
    j = joint_of(here, c)
    return {k for k in range(len(here.known.table)) if j >= 0 and joint_of_entry(here, k) == j}


def _alike(here: Setting, found: list[Named], now: Standing) -> tuple[list[Named], Standing]:
    """The causes with all that would do as well in place of each; beside a rest, with what may stand for friction."""
    if not now.excess.max() < 1.0:
        more = rivals(here, now, found) if found else []
        return [n._replace(alike=tuple(dict.fromkeys([*n.alike, *m]))) for n, m in zip(found, more, strict=True)], now
    for k, one in enumerate(found):
        others = instead(here, now, one, found)
        if others and others[0].worse < -NO_CHOICE:  # the other is the likelier one
            best = others[0]
            now = standing(here, now.model.structure, best.fit, best.free)
            found = [*found[:k], one._replace(candidate=best.candidate, alike=()), *found[k + 1 :]]
            others = instead(here, now, found[k], found)
        told = found[k].alike if found[k].candidate.kind.elastic else names(others)
        found = [*found[:k], found[k]._replace(alike=told), *found[k + 1 :]]
    return found, now


def _name(
    here: Setting,
    now: Standing,
    new: Standing,
    one: Tried,
    lists: dict[int, list[Tried]],
    check: tuple[bool, float, float],
) -> Named:
    """The name with its gain and with the causes that the rows tell no better."""
    j = joint_of(here, one.candidate)
    mine = slice(None) if j < 0 else slice(j, j + 1)
    most = gained(now, one)
    alike = []
    for other in lists.get(j, []):
        contained = other.candidate.kind.holds(one.candidate.effect)
        comparable = other.state.excess < 1.0 or one.state.excess >= 1.0
        if (
            other.candidate[:2] == one.candidate[:2]
            or contained
            or not comparable
            or most - gained(now, other) > NEAR * most
        ):
            continue
        if t_of(other.sse[..., mine].sum(-1), one.sse[..., mine].sum(-1)) < UNTOLD and sized(here, other):
            alike.append(Name(other.candidate.effect, other.candidate.at))
    before, after = (rms_of(here, x, j) for x in (now.held, new.held))
    return Named(one.candidate, check[2], check[1], tuple(alike), before, after)


def _level(here: Setting, one: Fit) -> float:
    return level_of(one, here.data)
