"""Which causes a recording of commands and positions shows: greedy, exact fits, held-out gates, honest verdicts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr

from ..results import Name, Verdict
from .causes import Candidate, elastic_loop, elastic_table, springs
from .colour import colour_of
from .fit import Fit, System, fit, held_out, refitted_without, spread_of_recordings
from .found import TOO_LITTLE, Model, Named, Search, Tried
from .parameters import values
from .setting import (
    Setting,
    Structure,
    bare,
    begins_of,
    begun,
    by_readings,
    by_recording,
    coloured,
    counted,
    excess,
    far_off,
    free_entries,
    in_parts,
    largest_forces,
    level_of,
    residuals,
    start_values,
    whitened,
)
from .sizes import fitted_without, simpler, sized, why_not_sized
from .starting import suggested
from .steady import in_doubt
from .thresholds import (
    CONFIDENT,
    GAIN,
    GAIN_BESIDE_REST,
    NEAR,
    NO_CHOICE,
    NO_WORSE,
    SLIGHT,
    SURE_OF_NOISE,
    T_BESIDE_REST,
    T_WITHOUT_REST,
    UNTOLD,
    USUAL,
    t_of,
)

__all__ = [
    "in_short_windows",
    "judged_by_colour",
    "leading",
    "quiet",
    "scored",
    "search",
    "settled",
]

_SHORT = 6  # candidates that are fitted where a linear screening can order them
_CHECKED = 3  # candidates whose held-out squares are those of fits without some recordings
_ROOM = 120  # columns beside what is free that one linearisation takes: each is a fiftieth of the first
_LEAST_ROOM, _SUMS = 24, 2.5e7  # columns that it takes at least; numbers of its matrices by blocks of time
_OUT_OF_SIGHT = 4.0  # times the squares of a fit, beyond which those of rows left out are no linear step's
_SHORTER = 4  # of one joint of an arm
_MOST, _MOST_ONE = 6, 4  # causes, and where only a rest that is noise gives them a name
_EARLY, _LATE = 4, 30  # iterations of a race among all starts, and of its leaders


def judged_by_colour(here: Setting, found: Search, seek: Callable[[Setting], Search]) -> Search:
    """Where what is left may be coloured noise: the search once more with that noise, if then noise alone is left."""
    if found.verdict in ("nothing", "named") or not np.isfinite(found.last.cost):
        return found
    sound = found.setting or here
    again = coloured(sound, found.structure, found.last)
    if again is None:
        return found
    new = seek(again)
    levels = np.concatenate([one / white for one, white in zip(again.noise, sound.noise, strict=True)])
    counted = np.asarray(new.structure.data.weight) > 0
    left = residuals(new.structure, new.beside or new.last)
    if new.verdict not in ("nothing", "named") and new.beside is None:
        return found
    if colour_of(left * levels[:, None], counted) is None:
        begun = residuals(new.origin or new.structure, new.first)
        if new.verdict == "nothing" or (left**2).sum() > SLIGHT * (begun**2).sum():
            return found
        new.verdict = "named+rest"  # all that is left, noise too, may be the error of the law that was found
    new.setting, new.faults = again, found.faults
    if [n.candidate for n in new.named] == [n.candidate for n in found.named or found.proxy]:  # in plain squares
        old = found.named or found.proxy
        new.held = found.held
        new.named = [n._replace(before=o.before, after=o.after) for n, o in zip(new.named, old, strict=True)]
    return new


def search(
    here: Setting,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    *,
    forbid: Sequence[str] = (),
    begin: Fit | None = None,
) -> Search:
    """Baseline, then one cause after another while held-out data gain; what is left decides the verdict."""
    found = _by_parts(here, _searched(here, progress, forbid, begin), progress, forbid)
    if (again := by_readings(found.setting or here, found.last)) is not None:
        found = _searched(again, progress, forbid)
    return judged_by_colour(here, found, lambda again: _searched(again, lambda phase, share: None, forbid))


def _by_parts(here: Setting, found: Search, progress: Callable[[str, float], None], forbid: Sequence[str]) -> Search:
    """A search; where it has ended far from noise, one in short windows, if it leaves noise alone in whole ones too."""
    seen = in_short_windows(here, found, progress, lambda parts: _searched(parts, quiet, forbid), ("named",))
    if seen is None or excess(whitened(seen.structure, seen.last), np.asarray(seen.structure.data.share)) >= 1.0:
        return found
    short, structure, last = seen
    held = [found.held[0], _rms(here, held_out(last, here.folds))]
    named = [one._replace(before=held[0], after=held[1]) for one in short.named]
    label = ", ".join(str(Name(one.candidate.effect, one.candidate.at)) for one in named)
    levels = [found.table[0], (label, level_of(last, structure.data))]
    more = {"first": found.first, "last": last, "p_value": found.p_value, "origin": found.origin, "fits": [last]}
    return replace(short, structure=structure, named=named, table=levels, held=held, setting=None, **more)


class Seen(NamedTuple):
    """What a search in short windows has found, and the fit of it over whole ones."""

    short: Search
    structure: Structure
    last: Fit


def in_short_windows(
    here: Setting,
    found: Search,
    progress: Callable[[str, float], None],
    seek: Callable[[Setting], Search],
    verdicts: Sequence[Verdict],
) -> Seen | None:
    """What `seek` finds in short windows where a search has ended far from noise; none where it ends otherwise."""
    if found.verdict != "unknown" or not np.isfinite(found.last.cost) or not far_off(here, found.first):
        return None
    parts = in_parts(here)
    if len(parts.stretches) == len(here.stretches):
        return None
    progress("searching for causes in short windows", 0.9)
    short = seek(parts)
    if short.verdict not in verdicts:
        return None
    structure = short.structure._replace(data=here.cut(short.structure.loop))
    free = [int(k) for k in short.last.free if k >= 0]
    last = fit(*structure, short.last.theta[None], [free], width=max(here.width, len(free)), lanes=1)[0]
    return Seen(short, structure, last) if np.isfinite(last.cost) else None


def quiet(phase: str, share: float) -> None:
    """Progress of which nothing is told."""


def _searched(
    here: Setting, progress: Callable[[str, float], None], forbid: Sequence[str], begin: Fit | None = None
) -> Search:
    structure = Structure(here.loop, here.known.table, here.data)
    progress("fitting the baseline", 0.1)
    first = begun(here) if begin is None else begin
    share = np.asarray(here.data.share)
    now = Model(structure, first, here.baseline, excess(whitened(structure, first), share))
    stood, found, p_value, steps, nearest = [now], [], 1.0, [("baseline", level_of(first, here.data))], []
    most = _MOST if by_recording(here) else _MOST_ONE
    while len(found) < most:
        progress(f"searching for cause {len(found) + 1}", min(0.2 + 0.15 * len(found), 0.9))
        tried = _tried(here, now, [n.candidate for n in found], forbid)
        best, p = _best(here, now, tried, nearest)
        if best is not None and now.excess < 1.0 and now.structure.loop.robot.nv == here.loop.robot.nv == 1:
            best, p = _best(here, now, [*tried, *_elastic(here, now, forbid)], nearest)  # not looked for in noise
        p_value = p if not found else p_value
        if best is None:
            break
        found.append(best[0])
        now = best[1]
        stood.append(now)
        steps.append((str(Name(best[0].candidate.effect, best[0].candidate.at)), level_of(now.fit, here.data)))
        if now.excess < 1.0:
            break
    if found and now.excess < 1.0 and (alone := bare(here, now.fit)) is not None:
        first, found, p_value, steps = alone, [], 1.0, [("baseline", level_of(alone, here.data))]
        now = Model(structure, first, here.baseline, excess(whitened(structure, first), share))
        stood = [now]
    held = [_rms(here, held_out(first, here.folds)), *(n.after for n in found)]
    found, now, doubtful = _of_sure_size(here, now, found, forbid)
    for one, model in doubtful:
        stood.append(model)
        steps.append((f"without {one[0]}", level_of(model.fit, here.data)))
        held.append(_rms(here, _held_out(here, model, [])[1]))
    result = _judged(here, stood[0], now, found, p_value, steps, nearest)
    result.held, result.doubtful, result.spread = held, [one for one, _ in doubtful], _spread(here, now)
    result.fits, result.origin = [one.fit for one in stood[1:]], stood[0].structure
    return result


def _of_sure_size(
    here: Setting, now: Model, found: list[Named], forbid: Sequence[str]
) -> tuple[list[Named], Model, list[tuple[tuple[Name, float, str], Model]]]:
    """The causes that would be told without those whose told interval holds no effect, least sure first; and these."""
    doubtful = list[tuple[tuple[Name, float, str], Model]]()
    while _verdict(here, now.excess, found) in ("named", "named+rest"):
        spread = _spread(here, now)
        causes, rest = [n.candidate for n in found], now.excess >= 1.0
        doubt = in_doubt(causes, here, now.structure, now.fit, spread, rest=rest)
        if doubt is None:
            break
        gone, why = doubt
        (one,) = (n for n in found if n.candidate is gone)
        told = Name(gone.effect, gone.at), max(one.gain, 0.0), why
        less = simpler(here, now.structure, now.fit, now.free, gone, forbid)
        found, old = [n for n in found if n is not one], now.structure
        structure, last, free = fitted_without(here, old, now.fit, now.free, gone)
        now = Model(structure, last, free, excess(whitened(structure, last), np.asarray(structure.data.share)))
        if less is not None:
            best, _ = _best(here, now, [_tried_one(here, old, less[0], *less[1:])], [])
            found, now = (found, now) if best is None else ([*found, best[0]], best[1])
        doubtful.append((told, now))
    return found, now, doubtful


def _spread(here: Setting, now: Model) -> np.ndarray | None:
    """How differently recordings tell each number where more than noise is left, (columns of the fit,)."""
    if now.excess < 1.0 or not by_recording(here):
        return None
    return spread_of_recordings(now.structure.table, now.fit, here.folds)


def _tried(here: Setting, now: Model, named: Sequence[Candidate], forbid: Sequence[str]) -> list[Tried]:
    """Every candidate that may still come, fitted from the present optimum from each of its starts."""
    used = {(c.effect, c.at) for c in named}
    left = [c for c in here.known.candidates if (c.effect, c.at) not in used and not set(c.entries) <= set(now.free)]
    placed = {c.at for c in named if c.kind.constant}
    left = [c for c in left if not (c.kind.constant and c.at in placed)]
    left = [c for c in left if len(now.free) + len(c.entries) <= here.width]
    if here.loop.robot.nv > 1 or here.loop.carried is not None:
        left = _screened(here, now, left) if left else []
    best = _best_starts(here, now, left)
    thetas, free, owner = [], [], []
    anew, key = _anew(here, now), []
    for c in left:
        for begin, start in product([now.fit.theta, *(anew if c.kind.limit else ())], best.get(c.entries, c.starts)):
            thetas.append(start_values(begin, c, start))
            free.append(free_entries(now.free, c.entries))
            owner.append(c)
            key.append((c.effect, c.at, begin is now.fit.theta))
    ends: dict[tuple[int, ...], Tried] = {}
    for k, end in _raced(here, now, np.array(thetas), free, key):
        one = _tried_one(here, now.structure, owner[k], end, free[k])
        known = ends.get(one.candidate.entries)
        if known is None or one.state.fit.cost < known.state.fit.cost:
            ends[one.candidate.entries] = one
    found = list(ends.values())
    rigid = len(now.structure.table) == len(here.known.table)
    first = here.loop.carried is None or not named  # a spring competes with the first cause of a joint of an arm
    if here.loop.robot.nv == 1 and rigid and first and all(one.state.excess >= 1.0 for one in found):
        found += _elastic(here, now, forbid)
    return found


def _anew(here: Setting, now: Model) -> list[np.ndarray]:
    """Where the fit of a drive's limit starts beside the present optimum: at gains no lower than the model's.

    A drive at its limit looks soft and heavy. A baseline whose gains are free has settled there, and no step from it
    leads back.
    """
    model, found = values(here.loop, here.known.table), list[np.ndarray]()
    gains = [k for k in here.baseline if here.known.table[k].name == "scale"]
    if here.loop.robot.nv > 1 or not gains:
        return found
    for begin in begins_of(here, model):
        if (begin[gains] >= model[gains]).all():
            found.append(now.fit.theta.copy())
            found[-1][list(here.baseline)] = begin[list(here.baseline)]
    return found


def _best_starts(
    here: Setting, now: Model, left: Sequence[Candidate]
) -> dict[tuple[int, ...], list[tuple[float, ...]]]:
    """Of users' effects whose parameters are not all linear, the start from which a linear step promises most."""
    mine = [c for c in left if c.kind.shapes]
    found = scored(here, now, mine) if mine else {}
    return {mine[k].entries: [tuple(theta[list(mine[k].entries)])] for k, (_, theta) in found.items()}


def _raced(
    here: Setting, now: Model, thetas: np.ndarray, free: Sequence[Sequence[int]], owner: Sequence[tuple]
) -> list[tuple[int, Fit]]:
    """The fits that lead after a few steps, finished: one of each candidate, with its place among the starts."""
    if not len(thetas):
        return []
    start = np.repeat(now.fit.start[None], len(thetas), 0)
    lanes = here.lanes * 3 if here.lanes > 1 else 1
    early = fit(*now.structure, thetas, free, start, width=here.width, lanes=lanes, iterations=_EARLY)
    leads: dict[Any, int] = {}
    for k in np.argsort([f.cost for f in early]):
        leads.setdefault(owner[k], int(k))
    order = list(leads.values())[: max(here.lanes, _SHORT)]
    states = np.stack([early[k].theta for k in order]), np.stack([early[k].start for k in order])
    last = fit(
        *now.structure, states[0], [free[k] for k in order], states[1],
        width=here.width, lanes=here.lanes, iterations=_LATE,
    )  # fmt: skip
    return list(zip(order, last, strict=True))


def _tried_one(here: Setting, structure: Structure, c: Candidate, best: Fit, free: Sequence[int]) -> Tried:
    share = np.asarray(structure.data.share)
    state = Model(structure, best, tuple(free), excess(whitened(structure, best), share))
    return Tried(c, state, held_out(best, here.folds))


def _screened(here: Setting, now: Model, left: Sequence[Candidate]) -> list[Candidate]:
    """The candidates that one linear step from the present model promises most, several to one linearisation.

    A limit of a drive changes the model before it can be differentiated: each is linearised at one start of its own.
    """
    room = here.width - len(now.free)
    left = [c for c in left if len(c.entries) <= room]
    scores = scored(here, now, left)
    most = _SHORT if here.loop.carried is None else _SHORTER
    return [left[k] for k in sorted(scores, key=lambda k: scores[k][0])[:most]]


def scored(here: Setting, now: Model, left: Sequence[Candidate]) -> dict[int, tuple[float, np.ndarray]]:
    """The cost that one linear step of each candidate leaves, and from which numbers; those that diverge are left out.

    Several candidates share one linearisation; a limit of a drive changes the model before it can be differentiated:
    each is linearised at one start of its own. Users' effects stand by themselves, for no machine code knows them, and
    so does what is asked at several starts.
    """
    many = max(int(np.sqrt(_SUMS / now.fit.sums.cost[..., 0].size)) - len(now.free) - len(now.fit.start), _LEAST_ROOM)
    room = max(here.width - len(now.free), min(many, _ROOM))
    limits = [k for k, c in enumerate(left) if c.kind.limit]
    left = suggested(here, now.structure, now.fit, left)
    theirs = {c.effect: [k for k, x in enumerate(left) if x.effect == c.effect] for c in left if c.kind.shapes}
    theirs |= {c.effect: [k for k, x in enumerate(left) if x.effect == c.effect] for c in left if c.own(here.known)}
    nowhere = {k for k, c in enumerate(left) if c.kind.shapes and not c.starts}
    apart = {*limits, *(k for pack in theirs.values() for k in pack)}
    packs, filled = [], 0
    for k in [k for k in range(len(left)) if k not in apart]:
        if not packs or filled + len(left[k].entries) > room:
            packs.append([])
            filled = 0
        packs[-1].append(k)
        filled += len(left[k].entries)
    lanes = []
    for pack in packs:
        for variant in range(max([1, *(len(left[k].starts) for k in pack if left[k].kind.falls_off)])):
            theta = now.fit.theta.copy()
            for k in pack:
                if shape := left[k].kind.falls_off:
                    theta[left[k].entries[shape]] = left[k].starts[variant][shape]
            lanes.append((theta, pack))
    for one in theirs.values():  # every start of all that share a name, at all places at once
        pack = [k for k in one if k not in nowhere]
        for variant in range(max((len(left[k].starts) for k in pack), default=0)):
            theta = now.fit.theta.copy()
            for k in pack:
                theta[list(left[k].entries)] = left[k].starts[variant % len(left[k].starts)]
            lanes.append((theta, pack))
    for k in limits:
        lanes += [(start_values(now.fit.theta, left[k], start), [k]) for start in left[k].starts]
    return _scores(here, now, left, lanes) if lanes else {}


def _scores(
    here: Setting, now: Model, left: Sequence[Candidate], lanes: Sequence[tuple[np.ndarray, list[int]]]
) -> dict[int, tuple[float, np.ndarray]]:
    """Cost after a linear step of each candidate of each lane's pack beside what is free already."""
    columns = [free_entries(now.free, [entry for k in pack for entry in left[k].entries]) for _, pack in lanes]
    thetas, start = np.array([theta for theta, _ in lanes]), np.repeat(now.fit.start[None], len(lanes), 0)
    width = max(here.width, *(len(one) for one in columns))
    fits = fit(*now.structure, thetas, columns, start, width=width, lanes=here.lanes, iterations=0)
    scores: dict[int, tuple[float, np.ndarray]] = {}
    for one, (theta, pack) in zip(fits, lanes, strict=True):
        if not np.isfinite(one.cost):
            continue
        subsets = [np.flatnonzero(np.isin(one.free, [*now.free, *left[k].entries])) for k in pack]
        promised = System(one.sums, now.structure.data, one.start).promises(subsets)
        for k, promise in zip(pack, promised, strict=True):
            if k not in scores or one.cost - promise < scores[k][0]:
                scores[k] = one.cost - float(promise), theta
    return scores


def settled(here: Setting, structure: Structure, theta: np.ndarray, free: Sequence[int], start: np.ndarray) -> float:
    """The cost that one linear step of all that is free leaves; infinite where the loop diverges."""
    one = fit(*structure, theta[None], [free], start[None], width=max(here.width, len(free)), lanes=1, iterations=0)[0]
    if not np.isfinite(one.cost):
        return np.inf
    system = System(one.sums, structure.data, one.start)
    return one.cost - system.decrease(*system.solve(one.free < 0, 1e-6))


def _elastic(here: Setting, now: Model, forbid: Sequence[str]) -> list[Tried]:
    """A spring, and a spring with play, between motor and link."""
    wanted = springs(here.loop.robot.dof_names[0], len(here.known.table), forbid)
    if not wanted or len(now.free) + 3 > here.width:
        return []
    n = here.loop.robot.nv
    torque = float(largest_forces(here.loop, here.runs).max())
    loop = elastic_loop(here.loop, 0, 10.0 * torque, 0.01 * torque)
    table = elastic_table(here.loop, here.known.table, 0)
    structure = Structure(loop, table, here.cut(loop))
    base = np.concatenate([now.fit.theta, [0.0, 0.0, 0.0]])
    k = len(here.known.table)
    thetas, free, owner = [], [], []
    for one in wanted:
        for share in (0.005, 0.05, 0.3):
            stiffness = torque / share
            theta = base.copy()
            theta[k : k + 3] = stiffness, 0.002 * stiffness, 0.0 if one.kind.telling is None else 0.1 * share
            thetas.append(theta)
            free.append(free_entries(now.free, one.entries))
            owner.append(one)
    start = np.zeros((len(thetas), 2 * (n + 1), now.fit.start.shape[1]))
    start[:, :n], start[:, n + 1 : 2 * n + 1] = now.fit.start[:n], now.fit.start[n:]
    most = 40 if here.loop.carried is None else _LATE
    fits = fit(*structure, np.array(thetas), free, start, width=here.width, lanes=6, iterations=most)
    found = []
    for one in wanted:
        best = min((f for f, o in zip(fits, owner, strict=True) if o == one), key=lambda f: f.cost)
        found.append(_tried_one(here, structure, one, best, free_entries(now.free, one.entries)))
    return found


def _best(
    here: Setting, now: Model, tried: Sequence[Tried], nearest: list[tuple[Name, float, str]]
) -> tuple[tuple[Named, Model] | None, float]:
    """The cause to name next with the state it makes, and p of what is left before it being noise."""
    tried, before = _held_out(here, now, tried)
    gains = [(before.sum() - one.sse.sum()) / before.sum() for one in tried]
    if by_recording(here):  # no more than on the data themselves: the rest is luck of a fit without a recording
        gains = [min(g, 1 - one.state.fit.squares / now.fit.squares) for g, one in zip(gains, tried, strict=True)]
    ts = [t_of(before, one.sse) for one in tried]
    nearest.clear()
    if not tried:
        return None, 1.0
    p = float(max(ndtr(-4 * now.excess), 1e-12))
    sure = CONFIDENT if now.excess >= 1.0 else T_WITHOUT_REST
    beside = [by_recording(here) and one.state.excess >= 1.0 for one in tried]  # a rest: more is asked
    common = [t.candidate.kind.usual and g > GAIN_BESIDE_REST for t, g in zip(tried, gains, strict=True)]
    needs = [T_BESIDE_REST if rest and not usual else sure for rest, usual in zip(beside, common, strict=True)]
    worth = [GAIN_BESIDE_REST if r and not t.candidate.kind.usual else GAIN for r, t in zip(beside, tried, strict=True)]
    least = 0.0 if now.excess >= 1.0 else SURE_OF_NOISE
    enough = [
        g > w and t > n and now.fit.squares - one.state.fit.squares > least
        for g, w, t, n, one in zip(gains, worth, ts, needs, tried, strict=True)
    ]
    passing = [k for k in range(len(tried)) if enough[k] and sized(here, tried[k])]
    for k in leading(gains):
        why = TOO_LITTLE if not enough[k] else why_not_sized(here, tried[k]) or "no better than another"
        nearest.append((Name(tried[k].candidate.effect, tried[k].candidate.at), float(max(gains[k], 0.0)), why))
    if not passing:
        return None, p
    k = max(passing, key=lambda k: gains[k])
    if tried[k].state.excess >= 1.0:  # more is to come: what surely gains; what every joint has before what few have
        k = max(passing, key=lambda k: gains[k] * (1 - CONFIDENT / max(ts[k], CONFIDENT)))
        usual = [j for j in passing if tried[j].candidate.kind.usual and gains[j] > USUAL * gains[k]]
        first = tried[k].candidate
        usual += [j for j in passing if tried[j].candidate[:2] == (first.kind.adds_to, first.at)]
        k = max(usual, key=lambda j: gains[j], default=k)
    for simple in passing:  # what it contains is preferred unless clearly worse
        if tried[k].candidate.kind.holds(tried[simple].candidate.effect):
            if (
                t_of(tried[simple].sse, tried[k].sse) < UNTOLD
                or tried[simple].sse.sum() <= NO_WORSE * tried[k].sse.sum()
            ):
                k = simple
    k = _with_fewest_numbers(tried, passing, k)
    best = tried[k]
    alike = []
    for other in passing:
        contained = tried[other].candidate.kind.holds(best.candidate.effect)
        noise = tried[other].state.excess < 1.0 or best.state.excess >= 1.0
        near = tried[other].sse.sum() - best.sse.sum() < NEAR * (before.sum() - best.sse.sum())
        untold = t_of(tried[other].sse, best.sse) < UNTOLD or _no_choice(tried[other], best)
        if other != k and not contained and noise and near and untold:
            alike.append(Name(tried[other].candidate.effect, tried[other].candidate.at))
    named = Named(best.candidate, ts[k], float(gains[k]), tuple(alike), _rms(here, before), _rms(here, best.sse))
    return (named, best.state), p


def _no_choice(one: Tried, other: Tried) -> bool:
    """Whether two causes leave noise alone, and so little between them that neither is the likelier one."""
    noise = one.state.excess < 1.0 and other.state.excess < 1.0
    return noise and abs(one.state.fit.squares - other.state.fit.squares) < NO_CHOICE


def _with_fewest_numbers(tried: Sequence[Tried], passing: Sequence[int], k: int) -> int:
    """Of the causes that are as likely as the best one, that with fewer numbers: each more fits some of the noise."""
    count = [len(one.candidate.entries) for one in tried]
    fewer = [j for j in passing if count[j] < count[k] and _no_choice(tried[j], tried[k])]
    return min(fewer, key=lambda j: (count[j], tried[j].state.fit.squares), default=k)


def leading(gains: Sequence[float]) -> list[int]:
    """The three that gain most; a loop that diverges tells nothing."""
    return [int(k) for k in np.argsort(gains)[::-1] if np.isfinite(gains[k])][:3]


def _held_out(here: Setting, now: Model, tried: Sequence[Tried]) -> tuple[list[Tried], np.ndarray]:
    """The candidates that fit best, and the squares of the present model, held out by fits without some recordings."""
    tried = list(tried)
    if not by_recording(here) or here.loop.robot.nv > 1:
        before = _without_folds(here, now, held_out(now.fit, here.folds))
        for k in sorted(range(len(tried)), key=lambda k: tried[k].state.fit.cost)[:_CHECKED]:
            tried[k] = tried[k]._replace(sse=_without_folds(here, tried[k].state, tried[k].sse))
        return tried, before
    order = sorted(range(len(tried)), key=lambda k: tried[k].state.fit.cost)[:_CHECKED]
    same = [k for k in order if tried[k].state.structure is now.structure]
    fits = [now.fit, *(tried[k].state.fit for k in same)]
    before, *found = refitted_without(*now.structure, fits, here.folds, lanes=here.lanes)
    found = dict(zip(same, found, strict=True))
    for k in order:
        one = tried[k].state
        if k not in found:
            found[k] = refitted_without(*one.structure, [one.fit], here.folds, lanes=6)[0]
        tried[k] = tried[k]._replace(sse=found[k])
    return tried, before


def _without_folds(here: Setting, now: Model, held: np.ndarray) -> np.ndarray:
    """Held-out squares by one linear step, or by a few damped ones where that leads out of sight."""
    if not held.sum() > _OUT_OF_SIGHT * now.fit.squares or not np.isfinite(now.fit.cost):
        return held
    return refitted_without(*now.structure, [now.fit], here.folds, lanes=here.lanes)[0]


def _rms(here: Setting, squares: np.ndarray) -> float:
    """Whitened squares as an RMS of position: rad, or m."""
    return float(np.sqrt(max(squares.sum(), 0.0) / counted(here.data) * np.mean(here.spread**2)))


def _verdict(here: Setting, beyond: float, found: Sequence[Named]) -> Verdict:
    """`named` where the rest is noise; `named+rest` where the names hold without each of three recordings or more."""
    if beyond < 1.0:
        return "named" if found else "nothing"
    return "named+rest" if found and by_recording(here) and found[0].t > T_BESIDE_REST else "unknown"


def _judged(
    here: Setting, begin: Model, now: Model, found: list[Named], p_value: float, steps: list, nearest: list
) -> Search:
    """The answer; causes that have no name are the best proxy."""
    result = Search("nothing", found, now.structure, begin.fit, now.fit, p_value, [], list(nearest), steps)
    result.verdict = _verdict(here, now.excess, found)
    if result.verdict == "unknown":
        result.proxy, result.named = found, []
    return result
