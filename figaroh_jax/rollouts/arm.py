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

from ..results import Name
from .alike import instead, names, rivals
from .causes import Candidate
from .faults import Fault, faults, without
from .fit import Fit, System, fit, refitted_without, spread_of_recordings
from .parameters import put, values
from .screening import LATE, ROUGH, Known, Standing, excess_of, joint_of, joint_of_entry, outputs, tried_now
from .search import Model, Named, Search, Tried, judged_by_colour, sized, t_of, t_of_places, t_of_recordings
from .sensitivity import predicted
from .setting import Setting, Structure, begins_of, begun, by_recording, evened, free_entries, level_of, thinned
from .thresholds import (
    CONFIDENT,
    COST_OF_A_MISSED,
    FITTED_FOR_HELD,
    GAIN,
    GAIN_BESIDE_REST,
    MOST_OF_IT,
    NEAR,
    NO_CHOICE,
    NO_WORSE,
    SLIGHT,
    SMALL,
    T_BESIDE_REST,
    T_WITHOUT_REST,
    UNTOLD,
    USUAL,
)

__all__ = ["search_arm"]

_AGAIN = 6  # iterations from the numbers of the model file
_TOP, _CHECKS = 3, 4  # candidates told as the nearest; those whose held-out squares are looked at in a round
_FIRST = 4  # iterations from each start of the baseline
_EVENED = 3  # fits of all that was recorded, each with weights by what the one before has left


def search_arm(
    here: Setting, progress: Callable[[str, float], None] = lambda phase, share: None, *, forbid: Sequence[str] = ()
) -> Search:
    """Causes of an arm whose drives act at one joint each and whose joints are all measured."""
    found = _searched(here, progress, forbid)
    return judged_by_colour(here, found, lambda again: _by_colour(again, found, forbid))


def _by_colour(here: Setting, white: Search, forbid: Sequence[str]) -> Search:
    """The search with coloured noise; where it ends in another valley, the first causes of the search before it."""
    new = _searched(here, lambda phase, share: None, forbid)
    if new.verdict in ("nothing", "named") or new.beside is not None or new.origin is None:
        return new
    begin = _standing(here, new.origin, new.first, here.baseline)
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
        now = _standing(here, structure, one, free)
        if not now.excess.max() < 1.0:
            continue
        found, now, slight = _still_needed(here, found, now, begin)
        found, now = _alike(here, found, now) if slight is None else (found, now)
        held = [_rms(here, begin.held), _rms(here, now.held)]
        label = ", ".join(str(Name(n.candidate.effect, n.candidate.at)) for n in found)
        steps = [("baseline", _level(here, new.first)), (label, _level(here, now.model.fit))]
        told = Search("nothing", found, now.model.structure, new.first, now.model.fit, new.p_value, [], [], steps, held,
                      [now.model.fit], new.origin, here)  # fmt: skip
        return _judged(here, told, now, slight)
    return new


def _searched(here: Setting, progress: Callable[[str, float], None], forbid: Sequence[str]) -> Search:
    progress("fitting the baseline", 0.05)
    whole, here = here, thinned(here)
    first, wrong = _begun(here), list[Fault]()
    if here.pole is None:  # a colour is told from sound rows
        whole, wrong = _sound(whole, first if whole is here else _started(whole, first))
    if wrong:
        here = thinned(whole)
        first = _begun(here)
    now = begin = _standing(here, Structure(here.loop, here.known.table, here.data), first, here.baseline)
    found: list[Named] = []
    held, steps, fits = [_rms(here, begin.held)], [("baseline", _level(here, first))], list[Fit]()
    nearest: list[tuple[Name, float, str]] = []
    known: Known = {}
    p_value = 1.0 if not np.isfinite(first.cost) else float(max(ndtr(-4 * begin.excess.max()), 1e-12))
    while np.isfinite(first.cost):
        number = len(steps)
        progress(f"searching for causes, round {number}", min(0.1 + 0.12 * number, 0.9))
        new, now, nearest = _round(here, now, found, forbid, nearest, known)
        found = [n for n in found if not any(_replaced(n, one) for one in new)] + new
        if not new:
            break
        steps.append(
            (", ".join(str(Name(n.candidate.effect, n.candidate.at)) for n in new), _level(here, now.model.fit))
        )
        held.append(_rms(here, now.held))
        fits.append(now.model.fit)
        if now.excess.max() < 1.0:
            break
    progress("judging", 0.9)
    found, now, slight = _still_needed(here, found, now, begin)
    found, now = _alike(here, found, now) if slight is None else (found, now)
    even = by_recording(whole) and bool(found) and now.excess.max() >= 1.0
    if whole is not here:
        progress("fitting all that was recorded", 0.95)
        begin, now, here = _on_all(whole, begin.model), _on_all(whole, now.model), whole
        first = begin.model.fit
        steps.append(("all that was recorded", _level(here, now.model.fit)))
    spread = None
    if even:
        now, spread = _alike_by_recording(here, now)
        steps.append(("recordings that are equally informative", _level(here, now.model.fit)))
    result = Search(
        "nothing", found, now.model.structure, first, now.model.fit, p_value, [], nearest, steps, held, fits,
        begin.model.structure, here, wrong, spread,
    )  # fmt: skip
    return _judged(here, result, now, slight)


def _started(here: Setting, first: Fit) -> Fit:
    """The states at the starts of all windows with numbers that were fitted to some."""
    structure = Structure(here.loop, here.known.table, here.data)
    return fit(*structure, first.theta[None], [[]], width=1, lanes=1, iterations=_FIRST, rough=ROUGH)[0]


def _on_all(here: Setting, model: Model) -> Standing:
    """A model of some windows fitted to all of them; what is held out was asked of the windows of the search."""
    structure = model.structure._replace(data=here.cut(model.structure.loop))
    new = _from(here, structure, model.fit, model.free) if np.isfinite(model.fit.cost) else model.fit
    return _standing(here, structure, new, model.free, held=False)


def _alike_by_recording(here: Setting, now: Standing) -> tuple[Standing, np.ndarray]:
    """The numbers where more than noise is left: each recording tells as much of a joint, not the fastest the most.

    With them how differently recordings tell each, (columns of the fit,).
    """
    structure, last, free, even = now.model.structure, now.model.fit, now.model.free, now.model.structure
    for _ in range(_EVENED):
        some = evened(here, structure, last)
        even = structure._replace(data=some.cut(structure.loop))
        last = _from(some, even, last, free)
    spread = spread_of_recordings(*even, last, here.folds)
    last = _from(here, structure, last, free, 0)
    beyond = excess_of(here, structure, last)
    model = Model(structure, last, free, float(beyond.max()))
    return Standing(model, outputs(here, last.sums.cost), now.held, beyond), spread


def _from(here: Setting, structure: Structure, last: Fit, free: Sequence[int], most: int = LATE) -> Fit:
    """The fit of these numbers from another of the same structure; the states at the starts too, where it had them."""
    start = last.start[None] if last.start.shape[1] == len(here.stretches) else None
    return fit(*structure, last.theta[None], [free], start, width=max(here.width, len(free)), lanes=1, iterations=most,
               rough=ROUGH)[0]  # fmt: skip


def _replaced(old: Named, new: Named | Tried) -> bool:
    """Whether a new cause contains one at the same place that is a structure of its own: a spring that has play."""
    kind = new.candidate.kind
    return kind.elastic and kind.holds(old.candidate.effect) and old.candidate.at == new.candidate.at


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
    if mixed.cost < usual.cost:
        return mixed
    return fit(*structure, best.theta[None], [here.baseline], best.start[None], width=here.width, lanes=1)[0]


def _judged(here: Setting, result: Search, now: Standing, slight: _Slight | None = None) -> Search:
    """`named` where every joint's rest is noise; `named+rest` where the names hold without each of three recordings.

    Also where a cause that is too slight to be told from the error of another's law explains the rest.
    """
    found = result.named
    if slight is not None:
        one, why = slight.cause.candidate, "too little beside what others explain: their laws may be off by as much"
        result.verdict, result.beside = "named+rest", slight.fit
        result.nearest = [(Name(one.effect, one.at), max(slight.cause.gain, 0.0), why)]
        return result
    if now.excess.max() < 1.0:
        result.verdict = "named" if found else "nothing"
    elif found and by_recording(here) and found[0].t > T_BESIDE_REST:
        result.verdict = "named+rest"
    else:
        result.verdict, result.proxy, result.named = "unknown", found, []
    return result


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


def _standing(here: Setting, structure: Structure, one: Fit, free: Sequence[int], *, held: bool = True) -> Standing:
    """A fit with what it leaves, on the rows it was fitted to and, where it is asked, without them (else the same)."""
    if not np.isfinite(one.cost):
        nothing = np.zeros((1, 1, 1))
        return Standing(Model(structure, one, tuple(free), np.inf), nothing, nothing, np.full(1, np.inf))
    beyond = excess_of(here, structure, one)
    model = Model(structure, one, tuple(free), float(beyond.max()))
    fitted = outputs(here, one.sums.cost)
    if not held:
        return Standing(model, fitted, fitted, beyond)
    without = refitted_without(*structure, [one], here.folds, lanes=1, outputs=True)[0]
    return Standing(model, fitted, outputs(here, without), beyond)


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
    ordered = {
        j: [one for one in _ordered(now, ones) if one.candidate not in known[j].refused and _worthy(here, now, one)]
        for j, ones in lists.items()
    }
    kept: list[Named] = []
    for _ in range(_CHECKS):
        firsts = sorted((ones[0] for ones in ordered.values() if ones), key=lambda one: -_gained(now, one))
        if not firsts:
            break
        chosen = [one for one in firsts if any(_replaced(n, one) for n in found)][:1] or firsts[:1]
        if chosen[0].candidate.kind.usual:  # what every joint has is found at all of them at once
            chosen = [one for one in firsts if one.candidate.kind.usual]
        new = _named(here, now, lists, chosen, found)
        if new is not None:
            kept, now = new
            break
        for one in chosen:
            known[joint_of(here, one.candidate)].refused.append(one.candidate)
        ordered = {j: [one for one in ones if all(one is not x for x in chosen)] for j, ones in ordered.items()}
    close = sorted(tried, key=lambda one: one.sse.sum())[:_TOP]
    total = float(now.squares.sum())
    if not kept:
        nearest = [
            (Name(one.candidate.effect, one.candidate.at), max(float((total - one.sse.sum()) / total), 0.0),
             "improves held-out data too little")
            for one in close
        ]  # fmt: skip
    return kept, now, nearest


def _gained(now: Standing, one: Tried) -> float:
    """Squares of the whole arm by which a fitted candidate is better."""
    return float(now.squares.sum() - one.sse.sum())


def _worthy(here: Setting, now: Standing, one: Tried) -> bool:
    """Whether a candidate takes so much of what it was fitted to that held-out rows can bear it out."""
    j = joint_of(here, one.candidate)
    mine = slice(None) if j < 0 else slice(j, j + 1)
    before, after = now.squares[..., mine].sum(-1), one.sse[..., mine].sum(-1)
    gain = 1 - after.sum() / max(before.sum(), 1e-300)
    if one.state.excess < 1.0:
        return bool(gain > GAIN)
    usual, rest = one.candidate.kind.usual, by_recording(here)
    needed = T_BESIDE_REST if rest and not (usual and gain > GAIN_BESIDE_REST) else CONFIDENT
    t = max(t_of(before, after), t_of_places(before, after) if one.candidate.kind.limit else 0.0)
    return bool(gain > (GAIN_BESIDE_REST if rest and not usual else GAIN) and t > FITTED_FOR_HELD * needed)


def _ordered(now: Standing, ones: Sequence[Tried]) -> list[Tried]:
    """Candidates of a joint in the order in which they may be named: what every joint has before what few have."""
    ranked = sorted(ones, key=lambda one: -_gained(now, one))
    first, best = ranked[0], _gained(now, ranked[0])
    if best <= 0:
        return []
    rest = first.state.excess >= 1.0
    usual = [x for x in ranked if rest and x.candidate.kind.usual and _gained(now, x) > USUAL * best]
    more = first.candidate.kind.adds_to
    usual += [x for x in ranked if rest and x.candidate.effect == more and all(x is not y for y in usual)]
    simple = [
        x for x in ranked
        if first.candidate.kind.holds(x.candidate.effect)
        and (t_of(x.sse.sum(-1), first.sse.sum(-1)) < UNTOLD or x.sse.sum() <= NO_WORSE * first.sse.sum())
    ]  # fmt: skip
    front = usual[:1] or simple[:1]
    return front + [x for x in ranked if all(x is not other for other in front)]


def _named(
    here: Setting, now: Standing, lists: dict[int, list[Tried]], chosen: Sequence[Tried], found: Sequence[Named]
) -> tuple[list[Named], Standing] | None:
    """The chosen causes that hold: all fitted together, those that held-out rows or the others do not need left out."""
    chosen = list(chosen)
    while chosen:
        new = _together(here, now, chosen)
        if not found or any(one.candidate.kind.elastic for one in chosen):
            new = _again(here, new, [n.candidate for n in found])
        with_all = _standing(here, new.structure, new.fit, new.free)
        checks = [_check(here, now, with_all, one) for one in chosen]
        keep = [one for one, (good, _, _) in zip(chosen, checks, strict=True) if good]
        if len(keep) < len(chosen):
            chosen = keep
            continue
        spare = _spare(here, with_all, chosen) if len(chosen) > 1 else None
        if spare is None:
            named = [_name(here, now, with_all, one, lists, check) for one, check in zip(chosen, checks, strict=True)]
            return sorted(named, key=lambda n: n.after**2 - n.before**2), with_all
        chosen = [one for one in chosen if one is not spare]
    return None


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


def _check(here: Setting, now: Standing, new: Standing, one: Tried) -> tuple[bool, float, float]:
    """Whether a cause holds on rows that were not fitted, with its gain there and its t."""
    j = joint_of(here, one.candidate)
    mine = slice(None) if j < 0 else slice(j, j + 1)
    before, after = now.held[..., mine].sum(-1), new.held[..., mine].sum(-1)
    gain = 1 - after.sum() / max(before.sum(), 1e-300)
    if by_recording(here):  # no more than on the data themselves: the rest is luck of a fit without a recording
        gain = min(gain, 1 - new.squares[..., mine].sum() / max(now.squares[..., mine].sum(), 1e-300))
    t, noise = t_of(before, after), float(new.excess[mine].max()) < 1.0
    if noise and float(now.excess[mine].max()) >= 1.0:  # all that is seen is explained, be it in a few places only
        t = max(t, float(np.sqrt(max(before.sum() - after.sum(), 0.0))) / 2)
    if gain > MOST_OF_IT or one.candidate.kind.limit:  # a limit is met in a few places
        t = max(t, t_of_places(before, after))
    rest = by_recording(here) and not noise
    if rest:  # blocks of a recording gain or lose together
        t = min(t, t_of_recordings(before, after, np.array([x.run for x in here.stretches])))
    usual = one.candidate.kind.usual
    sure = CONFIDENT if float(now.excess[mine].max()) >= 1.0 else T_WITHOUT_REST
    needed = T_BESIDE_REST if rest and not (usual and gain > GAIN_BESIDE_REST) else sure
    worth = GAIN_BESIDE_REST if rest and not usual else GAIN
    state = Model(new.model.structure, new.model.fit, new.model.free, 0.0)
    good = gain > worth and t > needed and sized(here, one._replace(state=state))
    return bool(good), float(gain), t


def _spare(here: Setting, new: Standing, chosen: Sequence[Tried], begin: Standing | None = None) -> Tried | None:
    """The cause, if any, that its joint does not need beside the others: the least one first.

    With the model at the `begin` also one that is worth next to nothing of what the others have explained there since:
    where their laws are off by as little, it makes up for that.
    """
    for one in sorted(chosen, key=lambda one: _gained(new, one), reverse=True):
        if one.candidate.kind.elastic:
            continue
        j, entries = joint_of(here, one.candidate), list(one.candidate.entries)
        mine = slice(None) if j < 0 else slice(j, j + 1)
        if _costs(here, new, entries) > COST_OF_A_MISSED * new.squares[..., mine].sum():
            continue
        other, _ = _without(here, new, entries)
        if not np.isfinite(other.cost):
            continue
        left = outputs(here, other.sums.cost)[..., mine]
        before, after = left.sum(-1), new.squares[..., mine].sum(-1)
        if before.sum() - after.sum() < SMALL * before.sum() or t_of(before, after) < CONFIDENT:
            return one
        if begin is not None and _is_slight(begin.squares[..., mine], left, new.squares[..., mine]):
            return one
    return None


def _is_slight(begin: np.ndarray, left: np.ndarray, after: np.ndarray) -> bool:
    """Whether a cause lowers what is `left` without it by too little beside what others explain, at each joint."""
    begin, left, after = (x.sum((0, 1)) for x in (begin, left, after))
    return bool((left - after < np.maximum(SLIGHT * (begin - left), SMALL * left)).all())


def _without(here: Setting, now: Standing, entries: Sequence[int]) -> tuple[Fit, list[int]]:
    """The fit without numbers, and what is free in it."""
    structure, last = now.model.structure, now.model.fit
    theta = last.theta.copy()
    theta[list(entries)] = values(structure.loop, structure.table)[list(entries)]
    free = [k for k in now.model.free if k not in entries or k in here.baseline]
    return fit(*structure, theta[None], [free], last.start[None], width=max(here.width, len(free)), lanes=1,
               iterations=LATE, rough=ROUGH)[0], free  # fmt: skip


class _Slight(NamedTuple):
    """A cause that explains what others leave, and may be no more than the error of their laws; the fit with it."""

    cause: Named
    fit: Fit


def _still_needed(
    here: Setting, found: list[Named], now: Standing, begin: Standing
) -> tuple[list[Named], Standing, _Slight | None]:
    """The causes without those that a later one made needless, where noise is all that is left.

    One without which more than noise is left, but too little to tell it from the error of another's law, is told apart.
    """
    while len(found) > 1 and now.excess.max() < 1.0:
        own = [Tried(n.candidate, now.model, now.squares) for n in found]
        spare = _spare(here, now, own, begin)
        if spare is None:
            break
        new = _standing(here, now.model.structure, *_without(here, now, spare.candidate.entries))
        rest = [n for n in found if n.candidate is not spare.candidate]
        if not new.excess.max() < 1.0:
            j = joint_of(here, spare.candidate)
            mine = slice(None) if j < 0 else slice(j, j + 1)
            if not _is_slight(begin.squares[..., mine], new.squares[..., mine], now.squares[..., mine]):
                break  # needed, be it in a few places only
            (gone,) = (n for n in found if n.candidate is spare.candidate)
            return rest, new, _Slight(gone, now.model.fit)
        found, now = rest, new
    return found, now, None


def _alike(here: Setting, found: list[Named], now: Standing) -> tuple[list[Named], Standing]:
    """The causes with all that would do as well in place of each; beside a rest, with what may stand for friction."""
    if not now.excess.max() < 1.0:
        more = rivals(here, now, found) if found else []
        return [n._replace(alike=tuple(dict.fromkeys([*n.alike, *m]))) for n, m in zip(found, more, strict=True)], now
    for k, one in enumerate(found):
        others = instead(here, now, one, found)
        if others and others[0].worse < -NO_CHOICE:  # the other is the likelier one
            best = others[0]
            now = _standing(here, now.model.structure, best.fit, best.free)
            found = [*found[:k], one._replace(candidate=best.candidate, alike=()), *found[k + 1 :]]
            others = instead(here, now, found[k], found)
        told = found[k].alike if found[k].candidate.kind.elastic else names(others)
        found = [*found[:k], found[k]._replace(alike=told), *found[k + 1 :]]
    return found, now


def _costs(here: Setting, new: Standing, entries: list[int]) -> float:
    """Squares by which the fit would be worse without numbers, to second order."""
    structure, last = new.model.structure, new.model.fit
    covariance = System(last.sums, structure.data, last.start).covariance(last.free < 0)
    at = [int(np.flatnonzero(last.free == k)[0]) for k in entries]
    stated, block = values(structure.loop, structure.table)[entries], covariance[np.ix_(at, at)]
    if not (np.isfinite(block).all() and np.isfinite(stated).all()):  # a limit at infinity: the fit tells
        return 0.0
    away = last.theta[entries] - stated
    return float(away @ np.linalg.pinv(block) @ away)


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
    most = _gained(now, one)
    alike = []
    for other in lists.get(j, []):
        contained = other.candidate.kind.holds(one.candidate.effect)
        comparable = other.state.excess < 1.0 or one.state.excess >= 1.0
        if other is one or contained or not comparable or most - _gained(now, other) > NEAR * most:
            continue
        if t_of(other.sse[..., mine].sum(-1), one.sse[..., mine].sum(-1)) < UNTOLD and sized(here, other):
            alike.append(Name(other.candidate.effect, other.candidate.at))
    before, after = (_rms(here, x, j) for x in (now.held, new.held))
    return Named(one.candidate, check[2], check[1], tuple(alike), before, after)


def _level(here: Setting, one: Fit) -> float:
    return level_of(one, np.asarray(here.data.weight))


def _rms(here: Setting, squares: np.ndarray, joint: int = -1) -> float:
    """Whitened squares (blocks, windows, joints) as an RMS over the rows of a joint, or of all: rad, or m."""
    mine = squares[..., slice(None) if joint < 0 else [joint]]
    count = (np.asarray(here.data.weight) > 0).sum() / here.loop.robot.nv * mine.shape[-1]
    return float(np.sqrt(max(mine.sum(), 0.0) / max(count, 1) * np.mean(here.spread**2)))
