"""The search for causes in an arm: the whole arm simulated from its commands, each joint judged by its own encoder.

One linearisation of the arm ranks what every joint could lack; the best of each joint are fitted with everything else
free. Causes of several joints may be found in one round: each must lower what its own encoder shows in recordings or
quarters of the time that a fit has not seen, and must be missed where it alone is taken away again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.special import ndtr

from ..results import Name
from .causes import BASELINE, CONTAINS, Candidate, elastic_loop
from .data import windows
from .faults import Fault, faults, without
from .fit import Fit, fit, refitted_without
from .parameters import Entry, put, values
from .search import (
    Model,
    Named,
    Search,
    Setting,
    Structure,
    Tried,
    begun,
    by_recording,
    excess,
    free_entries,
    largest_forces,
    level_of,
    residuals,
    scored,
    settled,
    sized,
    start_values,
    t_of,
)  # fmt: skip
from .sensitivity import predicted

__all__ = ["search_arm"]

_WORTH, _SURE, _UNSURE = 0.004, 1.64, 2.5  # held-out gain and t of a name, where more than noise is left and where not
_CLEAR, _MUCH = 3.0, 0.25  # t and gain of a name beside which more than noise stays, unless every joint has it
_ALIKE, _NEAR = 1.7, 0.1  # t and share of the gain within which two causes are alike
_USUAL = 0.5  # share of the best gain from which friction, damping and rotor come first while more is left
_TOP, _RACE = 3, 2  # candidates of a joint that are fitted, and that are fitted to the end
_EARLY, _LATE = 3, 30  # iterations
_ROUGH = 1e-4  # share of the squares that a step must promise while candidates are ranked
_MOST, _CHECKS = 6, 4  # causes of a joint; candidates whose held-out squares are looked at in a round
_LEAST = 0.002  # held-out gain below which a cause found with others is not missed
_HOPE = 0.1  # share of a joint's squares that a cause must promise where it must take `_MUCH` in the end
_MORE = 1.02  # of the promise of a simpler cause, which a richer one must exceed to be fitted
_LIMITS = ("actuator_saturation", "voltage_saturation")
_STILL = ("encoder_offset", "torque_offset", "joint_spring")  # of one joint: each makes up for the others
_ELASTIC = ("joint_elasticity", "backlash")
_SHARES = (0.005, 0.05, 0.3)  # twists of a spring under the largest torque, rad or m


class _Standing(NamedTuple):
    """The model that stands, its squares and those held out by outputs, and how far it is from noise by joint."""

    model: Model
    squares: np.ndarray  # (blocks, windows, joints)
    held: np.ndarray  # the same, of fits without some recordings or quarters
    excess: np.ndarray  # (joints,)


def search_arm(
    here: Setting, progress: Callable[[str, float], None] = lambda phase, share: None, *, forbid: Sequence[str] = ()
) -> Search:
    """Causes of an arm whose drives act at one joint each and whose joints are all measured."""
    progress("fitting the baseline", 0.05)
    first = begun(here)
    here, wrong = _sound(here, first)
    if wrong:
        first = begun(here)
    now = begin = _standing(here, Structure(here.loop, here.known.table, here.data), first, here.baseline)
    found: list[Named] = []
    held, steps, fits = [_rms(here, begin.held)], [("baseline", _level(here, first))], list[Fit]()
    nearest: list[tuple[Name, float, str]] = []
    p_value = 1.0 if not np.isfinite(first.cost) else float(max(ndtr(-4 * begin.excess.max()), 1e-12))
    while np.isfinite(first.cost):
        number = len(steps)
        progress(f"looking for causes, round {number}", min(0.1 + 0.12 * number, 0.9))
        new, now, nearest = _round(here, now, found, forbid, nearest)
        found += new
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
    result = Search(
        "nothing", found, now.model.structure, first, now.model.fit, p_value, [], nearest, steps, held, fits,
        begin.model.structure, here, wrong,
    )  # fmt: skip
    return _judged(here, result, now)


def _judged(here: Setting, result: Search, now: _Standing) -> Search:
    """`named` where every joint's rest is noise; `named+rest` where the names hold without each of three recordings."""
    found = result.named
    if now.excess.max() < 1.0:
        result.verdict = "named" if found else "nothing"
    elif found and by_recording(here) and found[0].t > _CLEAR:
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
    return replace(here, runs=runs, data=windows(here.loop, runs, here.stretches, here.noise, here.block)), found


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


def _standing(here: Setting, structure: Structure, one: Fit, free: Sequence[int]) -> _Standing:
    """A fit with what it leaves, on the rows it was fitted to and without them."""
    if not np.isfinite(one.cost):
        nothing = np.zeros((1, 1, 1))
        return _Standing(Model(structure, one, tuple(free), np.inf), nothing, nothing, np.full(1, np.inf))
    beyond = _excess(here, structure, one)
    model = Model(structure, one, tuple(free), float(beyond.max()))
    held = refitted_without(*structure, [one], here.folds, lanes=1, outputs=True)[0]
    return _Standing(model, _outputs(here, one.sums.cost), _outputs(here, held), beyond)


def _outputs(here: Setting, squares: Any) -> np.ndarray:
    """Squares by outputs as squares by joints of the robot: rates go with their positions."""
    places, count = list(here.loop.measured), len(here.loop.measured)
    found = np.zeros((*squares.shape[:2], here.loop.robot.nv))
    for first in range(0, squares.shape[2], count):
        found[..., places] += squares[..., first : first + count]
    return found


def _excess(here: Setting, structure: Structure, one: Fit) -> np.ndarray:
    """How far each joint's residual is above noise."""
    error, weight = residuals(structure, one), np.asarray(structure.data.weight)
    count, found = len(here.loop.measured), np.zeros(here.loop.robot.nv)
    for k, place in enumerate(here.loop.measured):
        mine = slice(k, None, count)
        found[place] = excess(error[:, mine], weight[:, mine]) if (weight[:, mine] > 0).any() else 0.0
    return found


def _round(
    here: Setting, now: _Standing, found: Sequence[Named], forbid: Sequence[str], nearest: list
) -> tuple[list[Named], _Standing, list]:
    """Causes to name next, at most one of each joint, and the model with them."""
    tried = _tried(here, now, [n.candidate for n in found], forbid)
    lists: dict[int, list[Tried]] = {}
    for one in tried:
        lists.setdefault(_joint(here, one.candidate), []).append(one)
    if not lists:
        return [], now, nearest
    ordered = {j: [one for one in _ordered(now, ones) if _worthy(here, now, one)] for j, ones in lists.items()}
    kept: list[Named] = []
    for _ in range(_CHECKS):
        firsts = sorted((ones[0] for ones in ordered.values() if ones), key=lambda one: -_gained(now, one))
        if not firsts:
            break
        chosen = firsts[:1]
        if chosen[0].candidate.effect in BASELINE:  # what every joint has is found at all of them at once
            chosen = [one for one in firsts if one.candidate.effect in BASELINE]
        new = _named(here, now, lists, chosen)
        if new is not None:
            kept, now = new
            break
        ordered = {j: [one for one in ones if all(one is not x for x in chosen)] for j, ones in ordered.items()}
    close = sorted(tried, key=lambda one: one.state.fit.cost)[:_TOP]
    total = float(now.squares.sum())
    if not kept:
        nearest = [
            (Name(one.candidate.effect, one.candidate.at), max((total - one.state.fit.squares) / total, 0.0),
             "gains too little on data that it was not fitted to")
            for one in close
        ]  # fmt: skip
    return kept, now, nearest


def _joint(here: Setting, c: Candidate) -> int:
    """The joint whose encoder shows a cause; -1: those of several."""
    return -1 if c.effect == "payload" else here.loop.robot.dof_names.index(c.at[0])


def _gained(now: _Standing, one: Tried) -> float:
    """Squares of the whole arm by which a fitted candidate is better."""
    return float(now.squares.sum() - one.sse.sum())


def _worthy(here: Setting, now: _Standing, one: Tried) -> bool:
    """Whether a candidate takes so much of what it was fitted to that held-out rows can bear it out."""
    j = _joint(here, one.candidate)
    mine = slice(None) if j < 0 else slice(j, j + 1)
    gain = 1 - one.sse[..., mine].sum() / max(now.squares[..., mine].sum(), 1e-300)
    rest = by_recording(here) and one.state.excess >= 1.0
    return bool(gain > (_MUCH if rest and one.candidate.effect not in BASELINE else _WORTH))


def _ordered(now: _Standing, ones: Sequence[Tried]) -> list[Tried]:
    """Candidates of a joint in the order in which they may be named: what every joint has before what few have."""
    ranked = sorted(ones, key=lambda one: -_gained(now, one))
    first, best = ranked[0], _gained(now, ranked[0])
    if best <= 0:
        return []
    rest = first.state.excess >= 1.0
    usual = [x for x in ranked if rest and x.candidate.effect in BASELINE and _gained(now, x) > _USUAL * best]
    if first.candidate.effect == "stribeck_friction":  # more friction at rest: beside friction, not without it
        usual += [x for x in ranked if rest and x.candidate.effect == "friction_loss" and x not in usual]
    simple = [
        x for x in ranked
        if x.candidate.effect in CONTAINS.get(first.candidate.effect, ())
        and (t_of(x.sse.sum(-1), first.sse.sum(-1)) < _ALIKE or x.sse.sum() <= 1.002 * first.sse.sum())
    ]  # fmt: skip
    front = usual[:1] or simple[:1]
    return front + [x for x in ranked if all(x is not other for other in front)]


def _named(
    here: Setting, now: _Standing, lists: dict[int, list[Tried]], chosen: Sequence[Tried]
) -> tuple[list[Named], _Standing] | None:
    """The chosen causes that hold: all fitted together, those that held-out rows or the others do not need left out."""
    chosen = list(chosen)
    while chosen:
        new = chosen[0].state if len(chosen) == 1 else _together(here, now, chosen)
        new = _again(here, new)
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


def _together(here: Setting, now: _Standing, chosen: Sequence[Tried]) -> Model:
    """All chosen causes in one fit, from where each ended by itself."""
    elastic = next((one for one in chosen if one.candidate.elastic), None)
    structure, start = (now.model.structure, now.model.fit.start) if elastic is None else (
        elastic.state.structure, elastic.state.fit.start)  # fmt: skip
    theta = (now.model.fit if elastic is None else elastic.state.fit).theta.copy()
    free = list(now.model.free)
    for one in chosen:
        entries = list(one.candidate.entries)
        own = free_entries([k for k in now.model.free if _of_joint(here, k, one.candidate)], entries)
        theta[own] = one.state.fit.theta[own]
        free = free_entries(free, entries)
    last = fit(*structure, theta[None], [free], start[None], width=max(here.width, len(free)), lanes=1,
               iterations=_LATE)[0]  # fmt: skip
    return Model(structure, last, tuple(free), 0.0)


def _again(here: Setting, new: Model) -> Model:
    """The fit once more from the numbers of the model file, the causes where they are: the better of both.

    A baseline that was fitted without a cause may end in another valley than with it.
    """
    structure, last = new.structure, new.fit
    if not np.isfinite(last.cost) or _excess(here, structure, last).max() < 1.0:
        return new
    theta, stated = last.theta.copy(), values(structure.loop, structure.table)
    theta[list(here.baseline)] = stated[list(here.baseline)]
    start, n, more = np.array(last.start), here.loop.robot.nv, structure.loop.robot.nv - here.loop.robot.nv
    begin = np.asarray(here.data.start)
    start[:n], start[n + more : 2 * n + more] = begin[:n], begin[n:]
    other = fit(*structure, theta[None], [new.free], start[None], width=max(here.width, len(new.free)), lanes=1,
                iterations=_LATE)[0]  # fmt: skip
    return new._replace(fit=other) if other.cost < last.cost else new


def _of_joint(here: Setting, entry: int, c: Candidate) -> bool:
    """Whether a number belongs to the joint of a cause."""
    mine = {k for other in here.known.candidates if other.at == c.at for k in other.entries}
    name = here.known.table[entry] if entry < len(here.known.table) else None
    return entry in mine or (name is not None and entry in _numbers(here, c))


def _numbers(here: Setting, c: Candidate) -> set[int]:
    """Entries of the table at the joint of a cause."""
    j = here.loop.robot.dof_names.index(c.at[0]) if c.effect != "payload" else -1
    drives = np.flatnonzero(np.asarray(here.loop.drives.transmission)[:, j]) if j >= 0 else []
    of_drive = ("scale", "delay", "dead_band", "voltage", "force_limit")
    return {k for k, e in enumerate(here.known.table)
            if (e.at[0] in drives if e.name in of_drive else e.at == (j,) and e.name != "payload")}  # fmt: skip


def _check(here: Setting, now: _Standing, new: _Standing, one: Tried) -> tuple[bool, float, float]:
    """Whether a cause holds on rows that were not fitted, with its gain there and its t."""
    j = _joint(here, one.candidate)
    mine = slice(None) if j < 0 else slice(j, j + 1)
    before, after = now.held[..., mine].sum(-1), new.held[..., mine].sum(-1)
    gain = 1 - after.sum() / max(before.sum(), 1e-300)
    if by_recording(here):  # no more than on the data themselves: the rest is luck of a fit without a recording
        gain = min(gain, 1 - new.squares[..., mine].sum() / max(now.squares[..., mine].sum(), 1e-300))
    t, noise = t_of(before, after), float(new.excess[mine].max()) < 1.0
    if noise and float(now.excess[mine].max()) >= 1.0:  # all that is seen is explained, be it in a few places only
        t = max(t, float(np.sqrt(max(before.sum() - after.sum(), 0.0))) / 2)
    rest = by_recording(here) and not noise
    usual = one.candidate.effect in BASELINE
    sure = _SURE if float(now.excess[mine].max()) >= 1.0 else _UNSURE
    needed = _CLEAR if rest and not (usual and gain > _MUCH) else sure
    worth = _MUCH if rest and not usual else _WORTH
    state = Model(new.model.structure, new.model.fit, new.model.free, 0.0)
    good = gain > worth and t > needed and sized(here, one._replace(state=state))
    return bool(good), float(gain), t


def _spare(here: Setting, new: _Standing, chosen: Sequence[Tried]) -> Tried | None:
    """The cause, if any, that its joint does not need beside the others: the least one first."""
    structure, last = new.model.structure, new.model.fit
    for one in sorted(chosen, key=lambda one: _gained(new, one), reverse=True):
        if one.candidate.elastic:
            continue
        j, entries = _joint(here, one.candidate), list(one.candidate.entries)
        theta = last.theta.copy()
        theta[entries] = values(structure.loop, structure.table)[entries]
        free = [k for k in new.model.free if k not in entries or k in here.baseline]
        other = fit(*structure, theta[None], [free], last.start[None], width=max(here.width, len(free)), lanes=1,
                    iterations=_LATE, rough=_ROUGH)[0]  # fmt: skip
        if not np.isfinite(other.cost):
            continue
        before, after = _outputs(here, other.sums.cost)[..., j], new.squares[..., j]
        if (before.sum() - after.sum()) / before.sum() < _LEAST or t_of(before, after) < _SURE:
            return one
    return None


def _name(
    here: Setting,
    now: _Standing,
    new: _Standing,
    one: Tried,
    lists: dict[int, list[Tried]],
    check: tuple[bool, float, float],
) -> Named:
    """The name with its gain and with the causes that the rows tell no better."""
    j = _joint(here, one.candidate)
    mine = slice(None) if j < 0 else slice(j, j + 1)
    most = _gained(now, one)
    alike = []
    for other in lists.get(j, []):
        contained = other.candidate.effect in CONTAINS and one.candidate.effect in CONTAINS[other.candidate.effect]
        comparable = other.state.excess < 1.0 or one.state.excess >= 1.0
        if other is one or contained or not comparable or most - _gained(now, other) > _NEAR * most:
            continue
        if t_of(other.sse[..., mine].sum(-1), one.sse[..., mine].sum(-1)) < _ALIKE and sized(here, other):
            alike.append(Name(other.candidate.effect, other.candidate.at))
    before, after = (_rms(here, x[..., mine]) for x in (now.held, new.held))
    return Named(one.candidate, check[2], check[1], tuple(alike), before, after)


def _level(here: Setting, one: Fit) -> float:
    return level_of(one, np.asarray(here.data.weight))


def _rms(here: Setting, squares: np.ndarray) -> float:
    """Whitened squares by joints as an RMS over the rows of all of them: rad, or m."""
    count = (np.asarray(here.data.weight) > 0).sum() / here.loop.robot.nv * squares.shape[-1]
    return float(np.sqrt(max(squares.sum(), 0.0) / max(count, 1) * np.mean(here.noise[0] ** 2)))


def _tried(here: Setting, now: _Standing, named: Sequence[Candidate], forbid: Sequence[str]) -> list[Tried]:
    """The candidates that one linear step promises most at each joint that is open, fitted."""
    model, n = now.model, here.loop.robot.nv
    rigid = model.structure.loop.robot.nv == n
    open_joints = [j for j in range(n) if now.excess[j] >= 1.0] or list(range(n))
    used = {(c.effect, c.at) for c in named}
    still = {c.at for c in named if c.effect in _STILL}
    count = {at: sum(c.at == at for c in named) for at in {c.at for c in named}}
    left = [
        c for c in here.known.candidates
        if (c.effect, c.at) not in used and not set(c.entries) <= set(model.free)
        and not (c.effect in _STILL and c.at in still) and count.get(c.at, 0) < _MOST
        and (_joint(here, c) < 0 or _joint(here, c) in open_joints)
    ]  # fmt: skip
    own, cost = now.squares.sum((0, 1)), model.fit.cost
    plain = [c for c in left if c.effect not in _LIMITS]
    best: dict[int, list[_Ranked]] = {}
    for k, (score, theta) in scored(here, model, plain).items():
        best.setdefault(_joint(here, plain[k]), []).append(_Ranked(cost - score, model.structure, plain[k], theta))
    for j in open_joints:
        common = [one for one in best.get(j, []) if one.candidate.effect in BASELINE and one.promise > _USUAL * own[j]]
        if common and now.excess[j] >= 1.0:  # nothing that few joints have can come before it
            best[j] = [max(common, key=lambda one: one.promise)]
            continue
        limits = [c for c in left if c.effect in _LIMITS and _joint(here, c) == j]
        for k, (score, theta) in scored(here, model, limits).items():
            best.setdefault(j, []).append(_Ranked(cost - score, model.structure, limits[k], theta))
        if rigid and now.excess.max() >= 1.0:
            best.setdefault(j, []).extend(_sprung(here, now, j, forbid))
    tried = []
    for j, ones in best.items():
        ranked = sorted(ones, key=lambda one: -one.promise)
        ranked = [one for k, one in enumerate(ranked) if all(one[2] is not other[2] for other in ranked[:k])]
        ranked = [one for one in ranked if not _no_more(one, ranked)]
        least = (_HOPE if by_recording(here) and now.excess.max() >= 1.0 else 0.0) * own[j]
        hopeful = [one for one in ranked if j < 0 or one.promise > least or one.candidate.effect in BASELINE]
        tried += _fitted(here, now, hopeful[: _TOP if j >= 0 else 1])
    return tried


def _no_more(one: _Ranked, ranked: Sequence[_Ranked]) -> bool:
    """Whether a candidate promises hardly more than one that it contains."""
    simple = CONTAINS.get(one.candidate.effect, ())
    return any(other.candidate.effect in simple and one.promise < _MORE * other.promise for other in ranked)


class _Ranked(NamedTuple):
    """A candidate with the decrease of the squares that one linear step promises."""

    promise: float
    structure: Structure
    candidate: Candidate
    theta: np.ndarray


def _fitted(here: Setting, now: _Standing, ranked: Sequence[_Ranked]) -> list[Tried]:
    """Candidates of one joint: a few steps of each, then the leaders to the end."""
    early: list[tuple[Fit, Structure, Candidate, list[int]]] = []
    for _, structure, c, theta in ranked:
        starts = [theta] if c.elastic or not c.starts else [start_values(theta, c, x) for x in c.starts]
        start = _start_of(now, structure)
        free = free_entries(now.model.free, c.entries)
        fits = [
            fit(*structure, x[None], [free], start[None], width=max(here.width, len(free)), lanes=1, iterations=_EARLY,
                rough=_ROUGH)[0]
            for x in starts
        ]  # fmt: skip
        early.append((min(fits, key=lambda f: f.cost), structure, c, free))
    found = []
    for one, structure, c, free in sorted(early, key=lambda x: x[0].cost)[:_RACE]:
        if not np.isfinite(one.cost):
            continue
        last = fit(*structure, one.theta[None], [free], one.start[None], width=max(here.width, len(free)), lanes=1,
                   iterations=_LATE, rough=_ROUGH / 10)[0]  # fmt: skip
        beyond = _excess(here, structure, last)
        j = _joint(here, c)
        state = Model(structure, last, tuple(free), float(beyond.max() if j < 0 else beyond[j]))
        found.append(Tried(c, state, _outputs(here, last.sums.cost)))
    return found


def _start_of(now: _Standing, structure: Structure) -> np.ndarray:
    """The states at the windows' starts, in a structure that may have a spring more."""
    start, n = now.model.fit.start, now.model.structure.loop.robot.nv
    more = structure.loop.robot.nv - n
    zero = np.zeros((more, start.shape[1]))
    return np.concatenate([start[:n], zero, start[n:], zero]) if more else start


def _sprung(here: Setting, now: _Standing, joint: int, forbid: Sequence[str]) -> list[_Ranked]:
    """A spring, and a spring with play, between motor and link of a joint."""
    wanted = [name for name in _ELASTIC if name not in forbid]
    forces, name = largest_forces(here.loop, here.runs), here.loop.robot.dof_names[joint]
    way = np.abs(np.asarray(here.loop.drives.transmission))[:, joint]
    torque = float(max((way * forces).max(initial=0.0), 1e-6))
    if not wanted or not np.isfinite(torque):
        return []
    loop = elastic_loop(here.loop, joint, 10.0 * torque, 0.01 * torque)
    n, k = here.loop.robot.nv, len(here.known.table)
    table = (*here.known.table, *(Entry(x, (n,)) for x in ("stiffness", "damping", "play")))
    structure = Structure(loop, table, windows(loop, here.runs, here.stretches, here.noise, here.block))
    found = []
    for effect in wanted:
        entries, reported = (k, k + 1), ("stiffness", "damping")
        if effect == "backlash":
            entries, reported = (k, k + 1, k + 2), (*reported, "width")
        c = Candidate(effect, (name,), entries, (), reported, True)
        for share in _SHARES:
            play = 0.0 if effect == "joint_elasticity" else 0.1 * share
            theta = np.concatenate([now.model.fit.theta, [torque / share, 0.002 * torque / share, play]])
            score = settled(here, structure, theta, free_entries(now.model.free, entries), _start_of(now, structure))
            found.append(_Ranked(now.model.fit.cost - score, structure, c, theta))
    return found
