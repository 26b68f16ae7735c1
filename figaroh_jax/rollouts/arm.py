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
from .fit import Fit, System, fit, refitted_without
from .parameters import Entry, put, values
from .search import (
    Model,
    Named,
    Search,
    Setting,
    Structure,
    Tried,
    begins_of,
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
from .sensitivity import Windows, predicted

__all__ = ["search_arm"]

_WORTH, _SURE, _UNSURE = 0.004, 1.64, 2.5  # held-out gain and t of a name, where more than noise is left and where not
_CLEAR, _MUCH = 3.0, 0.25  # t and gain of a name beside which more than noise stays, unless every joint has it
_ALIKE, _NEAR = 1.7, 0.1  # t and share of the gain within which two causes are alike
_USUAL = 0.5  # share of the best gain from which friction, damping and rotor come first while more is left
_TOP, _RACE = 3, 2  # candidates of a joint that are fitted, and that are fitted to the end
_EARLY, _AGAIN, _LATE = 3, 6, 30  # iterations
_ROUGH = 1e-4  # share of the squares that a step must promise
_PART = 3  # of the windows, one in so many shows whether a limit or a spring is worth a fit
_MOST, _CHECKS = 6, 4  # causes of a joint; candidates whose held-out squares are looked at in a round
_SURELY = 0.1  # share of the squares by which a cause that is surely missed would make them larger
_LEAST = 0.002  # held-out gain below which a cause found with others is not missed
_HOPE = 0.1  # share of a joint's squares that a cause must promise where it must take `_MUCH` in the end
_SAME = 0.02  # change of a joint's squares below which nothing new is looked for there
_WINS = 0.45  # share of the best gain after a few steps from which a candidate may still be named
_ALL = 1.1  # squares of a sample up to which nothing is left to explain by a spring
_SHARE_OF_T = 0.7  # of the t that a name needs on held-out rows, which it must have on those that were fitted
_MORE = 1.02  # of the promise of a simpler cause, which a richer one must exceed to be fitted
_FIRST = 4  # iterations from each start of the baseline
_OF_DRIVE = ("scale", "delay", "dead_band", "voltage", "force_limit")
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
    first = _begun(here)
    here, wrong = _sound(here, first)
    if wrong:
        first = _begun(here)
    now = begin = _standing(here, Structure(here.loop, here.known.table, here.data), first, here.baseline)
    found: list[Named] = []
    held, steps, fits = [_rms(here, begin.held)], [("baseline", _level(here, first))], list[Fit]()
    nearest: list[tuple[Name, float, str]] = []
    known: _Known = {}
    p_value = 1.0 if not np.isfinite(first.cost) else float(max(ndtr(-4 * begin.excess.max()), 1e-12))
    while np.isfinite(first.cost):
        number = len(steps)
        progress(f"looking for causes, round {number}", min(0.1 + 0.12 * number, 0.9))
        new, now, nearest = _round(here, now, found, forbid, nearest, known)
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


def _begun(here: Setting) -> Fit:
    """The baseline's fit: where it has several starts, each joint goes on from the one that its encoder likes best."""
    structure = Structure(here.loop, here.known.table, here.data)
    begins = begins_of(here, values(here.loop, here.known.table))
    if len(begins) == 1:
        return begun(here)
    early = [
        fit(*structure, x[None], [here.baseline], width=here.width, lanes=1, iterations=_FIRST, rough=_ROUGH)[0]
        for x in begins
    ]
    early = [one for one in early if np.isfinite(one.cost)]
    if not early:
        return begun(here)
    best = min(early, key=lambda one: one.cost)
    theta, start, n = best.theta.copy(), best.start.copy(), here.loop.robot.nv
    squares = [_outputs(here, one.sums.cost).sum((0, 1)) for one in early]
    for j in range(n):
        own = early[int(np.argmin([x[j] for x in squares]))]
        mine = [k for k in here.baseline if _joint_of(here, k) == j]
        theta[mine], start[[j, n + j]] = own.theta[mine], own.start[[j, n + j]]
    mixed, usual = (
        fit(*structure, x[None], [here.baseline], y[None], width=here.width, lanes=1, rough=_ROUGH, iterations=most)[0]
        for x, y, most in ((theta, start, _LATE), (best.theta, best.start, 0))
    )
    if mixed.cost < usual.cost:
        return mixed
    return fit(*structure, best.theta[None], [here.baseline], best.start[None], width=here.width, lanes=1)[0]


def _joint_of(here: Setting, entry: int) -> int:
    """The joint whose encoder shows a number of the table; -1: those of several."""
    one = here.known.table[entry] if entry < len(here.known.table) else None
    if one is None or len(one.at) > 1 or one.name == "payload":
        return -1
    if one.name in _OF_DRIVE:
        return int(np.argmax(np.abs(np.asarray(here.loop.drives.transmission)[one.at[0]])))
    return one.at[0]


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
    here: Setting, now: _Standing, found: Sequence[Named], forbid: Sequence[str], nearest: list, known: _Known
) -> tuple[list[Named], _Standing, list]:
    """Causes to name next, at most one of each joint, and the model with them."""
    tried = _tried(here, now, [n.candidate for n in found], forbid, known)
    lists: dict[int, list[Tried]] = {}
    for one in tried:
        lists.setdefault(_joint(here, one.candidate), []).append(one)
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
        chosen = firsts[:1]
        if chosen[0].candidate.effect in BASELINE:  # what every joint has is found at all of them at once
            chosen = [one for one in firsts if one.candidate.effect in BASELINE]
        new = _named(here, now, lists, chosen, found)
        if new is not None:
            kept, now = new
            break
        for one in chosen:
            known[_joint(here, one.candidate)].refused.append(one.candidate)
        ordered = {j: [one for one in ones if all(one is not x for x in chosen)] for j, ones in ordered.items()}
    close = sorted(tried, key=lambda one: one.sse.sum())[:_TOP]
    total = float(now.squares.sum())
    if not kept:
        nearest = [
            (Name(one.candidate.effect, one.candidate.at), max(float((total - one.sse.sum()) / total), 0.0),
             "gains too little on data that it was not fitted to")
            for one in close
        ]  # fmt: skip
    return kept, now, nearest


class _Seen(NamedTuple):
    """What was tried at a joint, when its squares were so large, and what held-out rows have refused since."""

    squares: float
    tried: list[Tried]
    refused: list[Candidate]


_Known = dict[int, _Seen]


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
    before, after = now.squares[..., mine].sum(-1), one.sse[..., mine].sum(-1)
    gain = 1 - after.sum() / max(before.sum(), 1e-300)
    if one.state.excess < 1.0:
        return bool(gain > _WORTH)
    usual, rest = one.candidate.effect in BASELINE, by_recording(here)
    needed = _CLEAR if rest and not (usual and gain > _MUCH) else _SURE
    return bool(gain > (_MUCH if rest and not usual else _WORTH) and t_of(before, after) > _SHARE_OF_T * needed)


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
    here: Setting, now: _Standing, lists: dict[int, list[Tried]], chosen: Sequence[Tried], found: Sequence[Named]
) -> tuple[list[Named], _Standing] | None:
    """The chosen causes that hold: all fitted together, those that held-out rows or the others do not need left out."""
    chosen = list(chosen)
    while chosen:
        new = _together(here, now, chosen)
        with_all = _standing(here, new.structure, new.fit, new.free)
        checks = [_check(here, now, with_all, one) for one in chosen]
        keep = [one for one, (good, _, _) in zip(chosen, checks, strict=True) if good]
        if len(keep) < len(chosen):
            chosen = keep
            continue
        spare = _spare(here, with_all, chosen) if len(chosen) > 1 else None
        if spare is None:
            better = new if found else _again(here, new)
            if better is not new:
                with_all = _standing(here, better.structure, better.fit, better.free)
                checks = [_check(here, now, with_all, one) for one in chosen]
            named = [_name(here, now, with_all, one, lists, check) for one, check in zip(chosen, checks, strict=True)]
            return sorted(named, key=lambda n: n.after**2 - n.before**2), with_all
        chosen = [one for one in chosen if one is not spare]
    return None


def _together(here: Setting, now: _Standing, chosen: Sequence[Tried]) -> Model:
    """All chosen causes in one fit, from where each ended by itself."""
    if len(chosen) == 1 and chosen[0].alone:
        return chosen[0].state
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
               iterations=_LATE, rough=_ROUGH)[0]  # fmt: skip
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
    for most, near in ((_AGAIN, 2.0), (_LATE, 1.0)):
        other = fit(*structure, theta[None], [new.free], start[None], width=max(here.width, len(new.free)), lanes=1,
                    iterations=most, rough=_ROUGH)[0]  # fmt: skip
        if not other.cost < near * last.cost:
            return new
        theta, start = other.theta, other.start
        own = list(new.free)
        if (np.abs(theta[own] - last.theta[own]) <= _NEAR * np.abs(last.theta[own])).all():  # the same valley
            return new
    return new._replace(fit=other) if other.cost < (1 - _ROUGH) * last.cost else new


def _of_joint(here: Setting, entry: int, c: Candidate) -> bool:
    """Whether a number belongs to the joint of a cause."""
    mine = {k for other in here.known.candidates if other.at == c.at for k in other.entries}
    name = here.known.table[entry] if entry < len(here.known.table) else None
    return entry in mine or (name is not None and entry in _numbers(here, c))


def _numbers(here: Setting, c: Candidate) -> set[int]:
    """Entries of the table at the joint of a cause."""
    j = _joint(here, c)
    return {k for k in range(len(here.known.table)) if j >= 0 and _joint_of(here, k) == j}


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
        if _costs(here, new, entries) > _SURELY * new.squares[..., j].sum():
            continue
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


def _costs(here: Setting, new: _Standing, entries: list[int]) -> float:
    """Squares by which the fit would be worse without numbers, to second order."""
    structure, last = new.model.structure, new.model.fit
    covariance = System(last.sums, structure.data, last.start).covariance(last.free < 0)
    at = [int(np.flatnonzero(last.free == k)[0]) for k in entries]
    away = (last.theta - values(structure.loop, structure.table))[entries]
    block = covariance[np.ix_(at, at)]
    return float(away @ np.linalg.pinv(block) @ away) if np.isfinite(block).all() and np.isfinite(away).all() else 0.0


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


def _tried(
    here: Setting, now: _Standing, named: Sequence[Candidate], forbid: Sequence[str], known: _Known
) -> list[Tried]:
    """The candidates that one linear step promises most at each joint that is open, fitted.

    Where a joint is off by as much as when it was looked at last, what was found then stands.
    """
    model, n = now.model, here.loop.robot.nv
    rigid = model.structure.loop.robot.nv == n
    open_joints = [j for j in range(n) if now.excess[j] >= 1.0] or list(range(n))
    sizes = {-1: float(now.squares.sum())} | {j: float(now.squares[..., j].sum()) for j in range(n)}
    same = {j for j, one in known.items() if abs(one.squares - sizes[j]) < _SAME * sizes[j]}
    stands = [one._replace(alone=False) for j in sorted(same) if j < 0 or j in open_joints for one in known[j].tried]
    open_joints = [j for j in open_joints if j not in same]
    if not open_joints:
        return stands
    used = {(c.effect, c.at) for c in named}
    still = {c.at for c in named if c.effect in _STILL}
    count = {at: sum(c.at == at for c in named) for at in {c.at for c in named}}
    left = [
        c for c in here.known.candidates
        if (c.effect, c.at) not in used and not set(c.entries) <= set(model.free)
        and not (c.effect in _STILL and c.at in still) and count.get(c.at, 0) < _MOST
        and ((_joint(here, c) < 0 and -1 not in same) or _joint(here, c) in open_joints)
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
        best.setdefault(j, []).extend(_limits_and_springs(here, now, left, best.get(j, []), j, rigid, forbid))
    hopeful: dict[int, list[_Ranked]] = {}
    for j, ones in best.items():
        ranked = sorted(ones, key=lambda one: -one.promise)
        ranked = [one for k, one in enumerate(ranked) if all(one[2] is not other[2] for other in ranked[:k])]
        ranked = [one for one in ranked if not _no_more(one, ranked)]
        least = (_HOPE if by_recording(here) and now.excess.max() >= 1.0 else 0.0) * own[j]
        enough = [one for one in ranked if j < 0 or one.promise > least or one.candidate.effect in BASELINE]
        usual = [one for one in enough if one.candidate.effect in BASELINE][:1]  # may come before what promises more
        rest = [one for one in enough if all(one is not x for x in usual)]
        hopeful[j] = [*usual, *rest][: _TOP if j >= 0 else 1]
    found = _fitted(here, now, hopeful)
    for j in (-1, *open_joints) if -1 not in same else open_joints:
        known[j] = _Seen(sizes[j], [one for one in found if _joint(here, one.candidate) == j], [])
    return stands + found


def _limits_and_springs(
    here: Setting, now: _Standing, left: Sequence[Candidate], plain: Sequence[_Ranked], joint: int, rigid: bool,
    forbid: Sequence[str],
) -> list[_Ranked]:  # fmt: skip
    """What changes the model before it can be differentiated, ranked on the windows where the joint is off the most."""
    (part, share, _), model = _part(now, joint), now.model
    mine = [c for c in left if _joint(here, c) == joint]
    leader = max(plain, key=lambda one: one.promise, default=None)
    chosen = [c for c in mine if c.effect in _LIMITS or (leader is not None and c is leader.candidate)]
    scores = {chosen[k].effect: (part.fit.cost - x, theta) for k, (x, theta) in scored(here, part, chosen).items()}
    if leader is not None and scores.get(leader.candidate.effect, (0.0, None))[0] > 0:
        share = leader.promise / scores[leader.candidate.effect][0]  # as much more as the same cause promises in all
    found = [
        _Ranked(scores[c.effect][0] * share, model.structure, c, scores[c.effect][1])
        for c in chosen if c.effect in _LIMITS and c.effect in scores
    ]  # fmt: skip
    most = max((one.promise for one in [*plain, *found]), default=0.0)
    if rigid and now.excess.max() >= 1.0 and now.squares[..., joint].sum() - most > _ALL * _rows(here, joint):
        found += [one._replace(promise=one.promise * share) for one in _sprung(here, now, joint, forbid)]
    return found


def _part(now: _Standing, joint: int) -> tuple[Model, float, np.ndarray]:
    """The model on the windows where a joint is off the most, how much more it is off in all, and which they are."""
    structure, one = now.model.structure, now.model.fit
    own = now.squares[..., joint].sum(0)
    which = np.sort(np.argsort(own)[::-1][: -(-len(own) // _PART)])
    data = _only(structure.data, which)
    start = one.start[:, which]
    prior = (start - data.start) * data.precision
    cost = float(one.sums.cost[:, which].sum() + (prior**2).sum())
    sums = type(one.sums)(*(np.asarray(x)[:, which] for x in one.sums))
    part = now.model._replace(
        structure=structure._replace(data=data), fit=one._replace(start=start, cost=cost, sums=sums)
    )
    return part, float(own.sum() / max(own[which].sum(), 1e-300)), which


def _only(data: Windows, which: np.ndarray) -> Windows:
    """Some of the windows."""
    return jax.tree.map(lambda x: np.asarray(x)[..., which], data)


def _rows(here: Setting, joint: int) -> int:
    """Samples of a joint that count."""
    column = here.loop.measured.index(joint)
    return int((np.asarray(here.data.weight)[:, column :: len(here.loop.measured)] > 0).sum())


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


def _fitted(here: Setting, now: _Standing, hopeful: dict[int, list[_Ranked]]) -> list[Tried]:
    """Candidates of all joints: a few steps of each, then those that may win to the end.

    One of each joint share a fit, for each joint's encoder judges its own: what another joint lacks hardly moves it.
    """
    early: dict[int, list[tuple[float, _Ranked, np.ndarray]]] = {}
    lists = {j: [one for each in ones for one in _from_starts(each)] for j, ones in hopeful.items()}
    for one in _all_in_lanes(here, now, lists, _EARLY, 0.0):
        early.setdefault(one.joint, []).append((one.own, one.ranked, one.fit.theta))
    leaders: dict[int, list[tuple[_Ranked, np.ndarray]]] = {}
    for j, ones in early.items():
        before = now.squares[..., j].sum() if j >= 0 else now.squares.sum()
        ordered = sorted(ones, key=lambda x: x[0])
        ordered = [x for k, x in enumerate(ordered) if all(x[1].candidate is not y[1].candidate for y in ordered[:k])]
        near = [x for x in ordered if before - x[0] > _WINS * (before - ordered[0][0])]
        leaders[j] = [(x[1], x[2]) for x in near[:_RACE]]
    found = []
    for one in _all_in_lanes(here, now, leaders, _LATE, now.model.fit.cost):
        c, beyond = one.ranked.candidate, _excess(here, one.ranked.structure, one.fit)
        own = float(beyond.max() if one.joint < 0 else beyond[one.joint])
        state = Model(one.ranked.structure, one.fit, one.free, own)
        sse = _outputs(here, one.fit.sums.cost)
        if not one.alone:
            mine, sse = sse[..., one.joint], now.squares.copy()
            sse[..., one.joint] = mine
        found.append(Tried(c, state, sse, one.alone))
    return found


class _OneOf(NamedTuple):
    """A candidate of a fit, with the squares of its own joint."""

    joint: int
    own: float
    ranked: _Ranked
    fit: Fit
    free: tuple[int, ...]
    alone: bool


def _from_starts(one: _Ranked) -> list[tuple[_Ranked, np.ndarray]]:
    """A candidate with the numbers from which its fit starts, once for each start."""
    c = one.candidate
    return [(one, x) for x in ([one.theta] if c.elastic or not c.starts or c.effect in _LIMITS else
                               [start_values(one.theta, c, start) for start in c.starts])]  # fmt: skip


def _all_in_lanes(
    here: Setting, now: _Standing, lists: dict[int, list[tuple[_Ranked, np.ndarray]]], most: int, below: float
) -> list[_OneOf]:
    """Every candidate of the lists fitted, the first of each joint together, then the second ones, and so on.

    A spring changes the structure, a payload shows at several joints, a limit may hold up the steps of the others:
    these are fitted by themselves.
    """
    lonely = lambda c: c.elastic or c.effect in _LIMITS or c.effect == "payload"  # noqa: E731
    single = [(j, *one) for j, ones in lists.items() for one in ones if lonely(one[0].candidate)]
    plain = {j: [one for one in ones if not lonely(one[0].candidate)] for j, ones in lists.items() if j >= 0}
    lanes = [[(j, *ones[m]) for j, ones in plain.items() if m < len(ones)]
             for m in range(max((len(ones) for ones in plain.values()), default=0))]  # fmt: skip
    found, queue = [], [*lanes, *([one] for one in single)]
    while queue:
        lane = queue.pop(0)
        structure, theta, free = lane[0][1].structure, lane[0][2].copy(), list(now.model.free)
        for j, ranked, begin in lane:
            mine = list(ranked.candidate.entries)
            own = [*mine, *(k for k in free if _joint_of(here, k) == j)] if len(lane) > 1 else list(range(len(begin)))
            theta, free = theta if len(lane) > 1 else begin.copy(), free_entries(free, mine)
            theta[own] = begin[own]
        start = _start_of(now, structure)
        one = fit(*structure, theta[None], [free], start[None], width=max(here.width, len(free)), lanes=1,
                  iterations=most, rough=_ROUGH / 10, below=below or np.inf)[0]  # fmt: skip
        if not np.isfinite(one.cost):  # one of them diverges: each by itself
            queue += [[x] for x in lane] if len(lane) > 1 else []
            continue
        squares = _outputs(here, one.sums.cost)
        for j, ranked, _ in lane:
            own = float(squares[..., j].sum() if j >= 0 else squares.sum())
            found.append(_OneOf(j, own, ranked, one, tuple(free), len(lane) == 1))
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
    part, _, which = _part(now, joint)
    small = structure._replace(data=_only(structure.data, which))
    start = _start_of(now, structure)[:, which]
    found = []
    for effect in wanted:
        entries, reported = (k, k + 1), ("stiffness", "damping")
        if effect == "backlash":
            entries, reported = (k, k + 1, k + 2), (*reported, "width")
        c = Candidate(effect, (name,), entries, (), reported, True)
        for share in _SHARES:
            play = 0.0 if effect == "joint_elasticity" else 0.1 * share
            theta = np.concatenate([now.model.fit.theta, [torque / share, 0.002 * torque / share, play]])
            score = settled(here, small, theta, free_entries(now.model.free, entries), start)
            found.append(_Ranked(part.fit.cost - score, structure, c, theta))
    return found
