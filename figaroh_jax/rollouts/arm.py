"""The search for causes in an arm: each joint alone, payloads in all joints at once, then the whole arm simulated.

Every joint has its own search with the others moving as measured (`alone`). What acts at several joints at once is
sought over all of them: a payload is named before anything else where it explains more than any cause of one joint.
The verdict is that of the arm's simulation from the command alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from .alone import alone, carried_by
from .causes import Candidate, Catalogue, elastic_loop
from .data import windows
from .faults import Fault, faults, without
from .fit import Fit, System, fit, held_out
from .parameters import Entry, put, values
from .search import (
    Model,
    Named,
    Search,
    Setting,
    Structure,
    begun,
    excess,
    judged,
    level_of,
    residuals,
    search,
    t_of,
)  # fmt: skip
from .sensitivity import Sums, predicted

__all__ = ["arm_begun", "search_arm"]

_WEAK = 0.3  # share of the largest gain below which a joint is looked at again
_ROUNDS = 3  # times that a cause of several joints may be named and the joints searched again
_ROOM = 8  # numbers of causes beside the baseline, at one joint
_SHARED = 6  # steps of a payload's fit
_WHOLE = 5  # steps of the arm's own fit
_LEAST, _CERTAIN = 0.002, 2.5  # held-out gain and t of a cause in the arm's own simulation, below which it goes
_PLAIN = 0.2  # of the squares: a cause that explains so much stays without another fit
_SPREADS = "encoder_offset"  # of a joint: what the others carry is wrong by it, too


class _Joint(NamedTuple):
    """One joint of the arm: its own setting, and where its numbers stand in the arm's table."""

    setting: Setting
    entries: np.ndarray  # of the arm's table, by the joint's
    fit: Fit  # baseline


def search_arm(
    here: Setting, progress: Callable[[str, float], None] = lambda phase, share: None, *, forbid: Sequence[str] = ()
) -> Search:
    """Causes of an arm whose drives act at one joint each and whose joints are all measured."""
    joints = _begun(here, values(here.loop, here.known.table), progress, 0.1)
    first = _together(here, joints, [one.fit for one in joints])
    here, wrong = _sound(here, first)
    if wrong:
        joints = _begun(here, first.theta, progress, 0.15)
        first = _together(here, joints, [one.fit for one in joints])
    shared: list[Named] = []
    theta = values(here.loop, here.known.table)
    found: list[Search] = []
    for number in range(_ROUNDS + 1):
        found = _each(here, joints, [True] * len(joints), [], progress, forbid)
        best = _shared(here, joints, found, shared, theta) if number < _ROUNDS else None
        if best is None:
            break
        shared.append(best[0])
        theta = best[1]
        joints = _begun(here, theta, progress, 0.3, [e for one in shared for e in one.candidate.entries])
    joints, found = _rest_again(here, joints, found, theta, shared, progress, forbid)
    progress("simulating the arm", 0.85)
    result = _judged(here, joints, first, found, shared, theta)
    result.setting, result.faults = here, wrong
    return result


def _sound(here: Setting, first: Fit) -> tuple[Setting, list[Fault]]:
    """The setting without the rows that no loop explains, and what is wrong with these."""
    structure = Structure(here.loop, here.known.table, here.data)
    model = _simulated(here, structure, first.theta, first.start)
    if model is None:
        return here, []
    n, places = here.loop.robot.nv, np.array(here.loop.measured)
    loop = put(here.loop, here.known.table, first.theta)
    read = [x[:, :n][:, places] + np.asarray(loop.joints.reading)[places] for x in model]
    found = faults(loop, here.runs, read)
    if not found:
        return here, []
    runs = without(here.runs, found)
    data = windows(here.loop, runs, here.stretches, here.noise, here.block)
    return replace(here, runs=runs, data=data), found


def _begun(
    here: Setting, theta: np.ndarray, progress: Callable[[str, float], None], share: float, known: Sequence[int] = ()
) -> list[_Joint]:
    """The joints with their baselines fitted: among the measured others, then among the simulated ones corrected."""
    joints = _joints(here, theta, progress, share, known)
    new = theta
    for joint in joints:
        new = _with_own(new, joint, joint.fit.theta)
    structure = Structure(here.loop, here.known.table, here.data)
    model = _simulated(here, structure, new, np.concatenate(_halves([one.fit.start for one in joints])))
    return _joints(here, new, progress, share, known, model)


def _with_own(theta: np.ndarray, joint: _Joint, own: np.ndarray) -> np.ndarray:
    """The arm's numbers with a joint's own in them; payloads are the arm's."""
    new, mine = theta.copy(), [e.name != "payload" for e in joint.setting.known.table]
    new[joint.entries[mine]] = own[: len(mine)][mine]
    return new


def _halves(starts: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Positions of all joints, then their rates; of an elastic joint those of the motor."""
    return [x[[0]] for x in starts] + [x[[len(x) // 2]] for x in starts]


def _simulated(here: Setting, structure: Structure, theta: np.ndarray, start: np.ndarray) -> list[np.ndarray] | None:
    """Positions and rates of the joints at the rows of each recording, (rows, 2 nv), or None where they diverge."""
    data, n = structure.data, here.loop.robot.nv
    ny = len(here.loop.measured)
    wide = np.zeros((data.reading.shape[0], 2 * ny, data.reading.shape[2]))
    loop = eqx.tree_at(lambda m: m.joints.reading, structure.loop, np.zeros(structure.loop.robot.nv))
    table = tuple(e for e in structure.table if e.name != "reading")
    kept = np.array([e.name != "reading" for e in structure.table])
    with jax.enable_x64(True):
        both = eqx.tree_at(lambda d: (d.reading, d.weight), data, (wide, wide))
        read = np.asarray(predicted(loop, table, theta[None, kept], both, start[None]))[0]
    if not (np.abs(read) < 1e3).all():
        return None
    places = [*here.loop.measured, *(n + k for k in here.loop.measured)]
    found = []
    for k, run in enumerate(here.runs):
        model = np.zeros((len(run.time), 2 * n))
        for w, one in enumerate(here.stretches):
            if one.run == k:
                model[one.first : one.first + one.rows, places] = read[: one.rows, :, w]
                model[one.first + one.rows :, places] = read[one.rows - 1, :, w]  # rows that no window covers
        found.append(model)
    return found


def _each(
    here: Setting,
    joints: Sequence[_Joint],
    wanted: Sequence[bool],
    found: Sequence[Search],
    progress: Callable[[str, float], None],
    forbid: Sequence[str],
) -> list[Search]:
    """The search at each of the wanted joints; what was found at the others stays."""
    new = []
    for j, (one, again) in enumerate(zip(joints, wanted, strict=True)):
        if again:
            progress(f"looking for causes at joint {j + 1} of {len(joints)}", 0.2 + 0.5 * j / len(joints))
        new.append(search(one.setting, forbid=forbid, begin=one.fit) if again else found[j])
    return new


def _rest_again(
    here: Setting,
    joints: list[_Joint],
    found: list[Search],
    theta: np.ndarray,
    shared: Sequence[Named],
    progress: Callable[[str, float], None],
    forbid: Sequence[str],
) -> tuple[list[_Joint], list[Search]]:
    """What is left at the other joints once the causes of those that gain most are in the simulation of the arm."""
    gains = [sum(n.gain for n in (one.named or one.proxy)[:1]) * one.first.squares for one in found]
    weak = [0 < gain < _WEAK * max(gains) for gain in gains]
    if not any(weak):
        return joints, found
    kept = [[] if w else list(one.named or one.proxy) for w, one in zip(weak, found, strict=True)]
    plain = [_plain(one) if w else one for w, one in zip(weak, found, strict=True)]
    structure, last, _ = _assembled(here, joints, plain, kept, theta, [])
    model = _simulated(here, structure, last.theta, last.start)
    new = last.theta[: len(here.known.table)].copy()
    known = [e for one in shared for e in one.candidate.entries]
    again = _joints(here, new, progress, 0.7, known, model)
    mixed = [again[j] if weak[j] else joints[j] for j in range(len(joints))]
    return mixed, _each(here, mixed, weak, found, progress, forbid)


def _plain(one: Search) -> Search:
    """The search before its first cause."""
    return Search("nothing", [], one.origin or one.structure, one.first, one.first, 1.0)


def arm_begun(here: Setting) -> Fit:
    """The baseline's fit of an arm, joint by joint; its sums leave out what a joint does to the others."""
    joints = _begun(here, values(here.loop, here.known.table), lambda phase, share: None, 0.0)
    return _together(here, joints, [one.fit for one in joints])


def _joints(
    here: Setting,
    theta: np.ndarray,
    progress: Callable[[str, float], None],
    share: float,
    known: Sequence[int] = (),
    simulated: Sequence[np.ndarray] | None = None,
) -> list[_Joint]:
    """Each joint's own setting, at the arm's numbers `theta`, with the baseline fitted; entries `known` stay."""
    loop = put(here.loop, here.known.table, theta)
    loop = jax.tree.map(lambda x: np.asarray(x) if eqx.is_array_like(x) else x, loop)
    carried = carried_by(loop, here.runs, simulated)
    found = []
    for j in range(here.loop.robot.nv):
        progress(f"fitting joint {j + 1} of {here.loop.robot.nv}", share + 0.1 * j / here.loop.robot.nv)
        small, runs = alone(loop, here.runs, carried, j)
        drives = np.flatnonzero(np.asarray(loop.drives.transmission)[:, j])
        mine = [k for k, e in enumerate(here.known.table) if _of(e, j, drives)]
        place = {int(d): i for i, d in enumerate(drives)}
        table = tuple(Entry(e.name, _place(e, place)) for e in (here.known.table[k] for k in mine))
        at = {k: i for i, k in enumerate(mine)}
        own = tuple(
            c._replace(entries=tuple(at[e] for e in c.entries))
            for c in here.known.candidates
            if c.effect != "payload" and all(e in at for e in c.entries) and not set(c.entries) & set(known)
        )
        column = int(np.flatnonzero(np.array(here.loop.measured) == j)[0])
        noise = tuple(x[[column]] for x in here.noise)
        data = windows(small, runs, here.stretches, noise, here.block)
        free = tuple(at[k] for k in (*here.baseline, *known) if k in at and here.known.table[k].name != "payload")
        links = sum(e.name == "payload" for e in table)
        setting = Setting(
            small, runs, data, noise, Catalogue(table, own), free, here.folds, 8, len(free) + max(_ROOM, links),
            here.stretches, here.block,
        )  # fmt: skip
        found.append(_Joint(setting, np.array(mine), begun(setting)))
    return found


_OF_DRIVES = ("scale", "delay", "dead_band", "voltage", "force_limit", "kp", "kd", "time_constant")


def _of(entry: Entry, joint: int, drives: np.ndarray) -> bool:
    if entry.name == "payload":
        return True
    return all(k in drives for k in entry.at) if entry.name in _OF_DRIVES else entry.at == (joint,)


def _place(entry: Entry, drives: dict[int, int]) -> tuple[int, ...]:
    if entry.name == "payload":
        return entry.at
    return tuple(drives[k] for k in entry.at) if entry.name in _OF_DRIVES else (0,)


def _shared(
    here: Setting, joints: Sequence[_Joint], found: Sequence[Search], named: Sequence[Named], base: np.ndarray
) -> tuple[Named, np.ndarray] | None:
    """The cause of several joints that explains more than any cause of one, with the arm's numbers where it stands."""
    before = [held_out(one.fit, one.setting.data, here.folds) for one in joints]
    firsts = [(one.named or one.proxy)[:1] for one in found]
    gains = [float(b.sum() * f[0].gain) if f else 0.0 for b, f in zip(before, firsts, strict=True)]
    whole = float(sum(b.sum() for b in before))
    best: tuple[Named, np.ndarray] | None = None
    most = max(gains, default=0.0)
    links = [c for c in here.known.candidates if c.effect == "payload" and c not in [n.candidate for n in named]]
    rest = max(level_of(one.fit, np.asarray(one.setting.data.weight)) for one in joints)
    if links and rest > 1.05:
        candidate, thetas, fits = _payload(here, joints, links, base)
        after = [held_out(f, one.setting.data, here.folds) for f, one in zip(fits, joints, strict=True)]
        gain = sum(float((b - a).sum()) for b, a in zip(before, after, strict=True))
        t = t_of(np.concatenate([b.ravel() for b in before]), np.concatenate([a.ravel() for a in after]))
        if gain > most and t > 2.5 and gain > 0.004 * whole:
            rms = [_rms(here, np.concatenate([x.ravel() for x in part])) for part in (before, after)]
            return Named(candidate, t, gain / whole, (), *rms), thetas
    j = int(np.argmax(gains))
    if most > 0 and firsts[j] and firsts[j][0].candidate.effect == _SPREADS and len([g for g in gains if g > 0]) > 1:
        one, fitted = firsts[j][0], found[j].fits[0]
        theta = base
        for joint in joints:
            theta = _with_own(theta, joint, joint.fit.theta)
        theta = _with_own(theta, joints[j], fitted.theta)
        mine = one.candidate._replace(entries=tuple(int(joints[j].entries[e]) for e in one.candidate.entries))
        best = one._replace(candidate=mine), theta
    return best


def _rms(here: Setting, squares: np.ndarray) -> float:
    count = (np.asarray(here.data.weight) > 0).sum()
    return float(np.sqrt(max(squares.sum(), 0.0) / count * np.mean(here.noise[0] ** 2)))


def _payload(
    here: Setting, joints: Sequence[_Joint], links: Sequence[Candidate], base: np.ndarray
) -> tuple[Candidate, np.ndarray, list[Fit]]:
    """The link whose payload lowers the squares of all joints most, fitted with every joint's own numbers."""
    entries = [c.entries[0] for c in links]
    fits, systems = _payload_systems(here, joints, [one.fit for one in joints], entries)
    scores = [_shared_step(systems, k, 1e-6)[2] for k in range(len(links))]
    best = int(np.argmax(scores))
    fits, systems = _payload_systems(here, joints, fits, entries[best : best + 1])
    cost, damping = sum(f.cost for f in fits), 1e-4
    for _ in range(_SHARED):
        steps, mass, promised = _shared_step(systems, 0, damping)
        if promised < 0.05:
            break
        moved = [
            _moved(f, joint, step, mass, entries[best]) for f, joint, step in zip(fits, joints, steps, strict=True)
        ]
        new, other = _payload_systems(here, joints, moved, entries[best : best + 1])
        if sum(f.cost for f in new) < cost:
            fits, systems, cost, damping = new, other, sum(f.cost for f in new), damping / 5
        else:
            damping *= 10
    theta = base
    for joint, one in zip(joints, fits, strict=True):
        theta = _with_own(theta, joint, one.theta)
    theta[entries[best]] += fits[0].theta[int(np.flatnonzero(joints[0].entries == entries[best])[0])]
    return links[best], theta, [_without(f, joint, entries[best]) for f, joint in zip(fits, joints, strict=True)]


def _payload_systems(
    here: Setting, joints: Sequence[_Joint], fits: Sequence[Fit], entries: Sequence[int]
) -> tuple[list[Fit], list[tuple]]:
    """Each joint evaluated with its own numbers and the payloads free: normal equations without the states."""
    made, systems = [], []
    for joint, one in zip(joints, fits, strict=True):
        s = joint.setting
        local = [int(np.flatnonzero(joint.entries == e)[0]) for e in entries]
        free = [*s.baseline, *local]
        new = fit(s.loop, s.known.table, s.data, one.theta[None], [free], one.start[None],
                  width=s.width, lanes=s.lanes, iterations=0)[0]  # fmt: skip
        made.append(new)
        system = System(new.sums, s.data, new.start)
        systems.append((*system.reduced(1e-9), len(s.baseline), system))
    return made, systems


def _shared_step(systems: Sequence[tuple], which: int, damping: float) -> tuple[list[np.ndarray], float, float]:
    """Damped step of every joint's own numbers and of one payload for all, and the decrease that it promises."""
    own, right, curve, slope = [], [], 0.0, 0.0
    for matrix, vector, count, _ in systems:
        keep = [*range(count), count + which]
        m, v = matrix[np.ix_(keep, keep)], vector[keep]
        m = m + damping * np.diag(np.diag(m)) + 1e-12 * np.eye(len(m))
        inner = np.linalg.solve(m[:-1, :-1], np.column_stack([m[:-1, -1], v[:-1]])) if count else np.zeros((0, 2))
        own.append(inner)
        right.append((m, v))
        curve += m[-1, -1] - m[-1, :-1] @ inner[:, 0]
        slope += v[-1] - m[-1, :-1] @ inner[:, 1]
    mass = slope / max(curve, 1e-12)
    steps = [inner[:, 1] - inner[:, 0] * mass for inner in own]
    gain = slope * mass + sum(float(v[:-1] @ inner[:, 1]) for (_, v), inner in zip(right, own, strict=True))
    return steps, float(mass), float(gain)


def _moved(one: Fit, joint: _Joint, step: np.ndarray, mass: float, entry: int) -> Fit:
    theta = one.theta.copy()
    low, high = joint.setting.bounds.T
    free = list(joint.setting.baseline)
    theta[free] = np.clip(theta[free] + step, low[free], high[free])
    theta[int(np.flatnonzero(joint.entries == entry)[0])] += mass
    return one._replace(theta=theta)


def _without(one: Fit, joint: _Joint, entry: int) -> Fit:
    """The fit with that entry known."""
    local = int(np.flatnonzero(joint.entries == entry)[0])
    return one._replace(free=np.where(one.free == local, -1, one.free))


def _judged(
    here: Setting,
    joints: Sequence[_Joint],
    first: Fit,
    found: Sequence[Search],
    shared: list[Named],
    base: np.ndarray,
) -> Search:
    """All causes in the arm's own structure, the arm simulated, and what is left of it."""
    lists = [list(one.named or one.proxy) for one in found]
    payloads = [one.candidate.entries[0] for one in shared if one.candidate.effect == "payload"]
    structure, last, named = _needed(here, joints, found, lists, base, payloads)
    weight = np.asarray(here.data.weight)
    left = excess(residuals(structure, last), np.asarray(structure.data.weight))
    begin = Model(Structure(here.loop, here.known.table, here.data), first, here.baseline, 0.0)
    now = Model(structure, last, tuple(last.free), left)
    named = [*shared, *named]
    steps = [("baseline", level_of(first, weight)), ("all causes", level_of(last, weight))]
    nearest = [x for one in found for x in one.nearest]
    p = min([one.p_value for one in found] + ([1e-12] if shared else []))
    return judged(here, begin, now, named, p, steps, nearest)


def _needed(
    here: Setting,
    joints: Sequence[_Joint],
    found: Sequence[Search],
    lists: list[list[Named]],
    base: np.ndarray,
    payloads: Sequence[int],
) -> tuple[Structure, Fit, list[Named]]:
    """The arm's own fit with the causes that its simulation needs: a joint alone also shows what others' noise makes.

    The cause that explains least goes first; it stays where held-out squares of the arm are clearly fewer with it.
    """
    structure, last, named = _assembled(here, joints, found, lists, base, payloads)
    last, gone = _refitted(here, structure, last), set[tuple]()
    for one in reversed(named[1:] if len(named) > 1 and not payloads else list(named)):
        if one.candidate.elastic:
            j = here.loop.robot.dof_names.index(one.candidate.at[0])
            fewer = [[n for n in own if not n.candidate.elastic] if k == j else own for k, own in enumerate(lists)]
            rigid = [_rigid(joints[k], f) if k == j else f for k, f in enumerate(found)]
            other, without, names = _assembled(here, joints, rigid, fewer, base, payloads)
            for past in [n for n in names if (n.candidate.effect, n.candidate.at) in gone]:
                without = _fitted_without(here, other, without, past)
            without = _refitted(here, other, without)
            if not _worse(here, other, without, structure, last):
                structure, last, found, lists = other, without, rigid, fewer
                gone.add((one.candidate.effect, one.candidate.at))
                named = [n for n in names if (n.candidate.effect, n.candidate.at) not in gone]
            continue
        if _promised(structure, last, one) > _PLAIN * last.squares:
            continue
        without = _fitted_without(here, structure, last, one)
        if not _worse(here, structure, without, structure, last):
            last = without
            gone.add((one.candidate.effect, one.candidate.at))
            named = [n for n in named if (n.candidate.effect, n.candidate.at) not in gone]
    return structure, last, named


def _neutral(structure: Structure, one: Named) -> np.ndarray:
    """The numbers of a cause where it does nothing: those of the model as stated."""
    stated = values(structure.loop, structure.table)
    return stated[list(one.candidate.entries)]


def _promised(structure: Structure, last: Fit, one: Named) -> float:
    """Squares that come back without a cause, to second order, everything else following."""
    free, entries = last.free.tolist(), list(one.candidate.entries)
    if any(entry not in free for entry in entries):
        return 0.0
    matrix, _ = System(last.sums, structure.data, last.start).reduced(1e-9)
    mine = np.array([free.index(entry) for entry in entries])
    rest = np.array([k for k, entry in enumerate(free) if entry >= 0 and entry not in entries])
    step = last.theta[entries] - _neutral(structure, one)
    if not np.isfinite(step).all():  # a limit that is far away
        return 0.0
    inner = np.linalg.lstsq(matrix[np.ix_(rest, rest)], matrix[np.ix_(rest, mine)], rcond=1e-12)[0]
    return float(step @ (matrix[np.ix_(mine, mine)] - matrix[np.ix_(mine, rest)] @ inner) @ step)


def _fitted_without(here: Setting, structure: Structure, last: Fit, one: Named) -> Fit:
    theta, entries = last.theta.copy(), list(one.candidate.entries)
    theta[entries] = _neutral(structure, one)
    free = [k for k in last.free.tolist() if k >= 0 and (k not in entries or k in here.baseline)]
    return fit(
        *structure, theta[None], [free], last.start[None], width=max(here.width, len(free)), lanes=1, iterations=_WHOLE
    )[0]


def _worse(here: Setting, structure: Structure, without: Fit, full: Structure, last: Fit) -> bool:
    """Whether held-out squares of the arm are clearly more without a cause than with it."""
    if not np.isfinite(without.cost):
        return True
    before, after = held_out(without, structure.data, here.folds), held_out(last, full.data, here.folds)
    gain = (before.sum() - after.sum()) / before.sum()
    return bool(gain > _LEAST and t_of(before, after) > _CERTAIN)


def _rigid(joint: _Joint, one: Search) -> Search:
    """What was found at a joint, its spring left out."""
    known, n = len(joint.setting.known.table), joint.setting.loop.robot.nv
    keep = [n2 for n2 in (one.named or one.proxy) if not n2.candidate.elastic]
    s, last = joint.setting, one.last
    free = [int(k) for k in last.free if 0 <= k < known]
    start = last.start[[0, len(last.start) // 2]] if len(last.start) > 2 * n else last.start
    plain = Structure(s.loop, s.known.table, s.data)
    again = fit(
        *plain, last.theta[None, :known], [free], start[None],
        width=max(s.width, len(free)), lanes=s.lanes, iterations=_SHARED,
    )[0]  # fmt: skip
    return Search(one.verdict, keep, plain, one.first, again, one.p_value, [], one.nearest)


def _refitted(here: Setting, structure: Structure, last: Fit) -> Fit:
    """The arm's own fit of everything that is free, by its exact sensitivities, from where its joints' fits ended."""
    width = max(here.width, len(last.free))
    begin = fit(
        *structure, last.theta[None], [list(last.free)], last.start[None], width=width, lanes=1, iterations=_WHOLE
    )
    return begin[0] if np.isfinite(begin[0].cost) and begin[0].cost <= last.cost else last


def _assembled(
    here: Setting,
    joints: Sequence[_Joint],
    found: Sequence[Search],
    lists: Sequence[list[Named]],
    base: np.ndarray,
    payloads: Sequence[int],
) -> tuple[Structure, Fit, list[Named]]:
    """The arm with every joint's causes, and the payloads that were named, at the arm's numbers `base`."""
    loop, table, data = here.loop, here.known.table, here.data
    theta = base.copy()
    n, sprung = loop.robot.nv, [j for j, one in enumerate(found) if len(one.structure.table) > len(joints[j].entries)]
    for j in sprung:
        loop = elastic_loop(loop, j, *found[j].last.theta[len(joints[j].entries) :][:2])
        at = loop.robot.nv - 1
        table = (*table, *(Entry(name, (at,)) for name in ("stiffness", "damping", "play")))
        theta = np.concatenate([theta, found[j].last.theta[-3:]])
    if sprung:
        data = windows(loop, here.runs, here.stretches, here.noise, here.block)
    maps, named = [], []
    for j, one in enumerate(found):
        extra = len(here.known.table) + 3 * sprung.index(j) + np.arange(3) if j in sprung else np.zeros(0, int)
        maps.append(np.concatenate([joints[j].entries, extra]).astype(int))
        payload = [here.known.table[k].name == "payload" for k in joints[j].entries]
        own = np.append(~np.array(payload), np.ones(len(extra), bool))
        theta[maps[j][own]] = one.last.theta[own]
        for cause in lists[j]:
            entries = tuple(int(maps[j][e]) for e in cause.candidate.entries)
            own = cause.candidate._replace(entries=entries, at=(here.loop.robot.dof_names[j],))
            alike = tuple(a._replace(at=own.at) for a in cause.alike)
            named.append((cause._replace(candidate=own, alike=alike), j))
    named = [c for c, _ in _in_order(named, joints)]
    structure = Structure(loop, table, data)
    fits = [_with_payloads(one, joint, payloads) for one, joint in zip(found, joints, strict=True)]
    return structure, _assembled_fit(structure, fits, maps, theta, n), named


def _with_payloads(found: Search, joint: _Joint, payloads: Sequence[int]) -> Fit:
    """The joint's last fit, evaluated with the arm's payloads free as well."""
    if not payloads:
        return found.last
    last, s = found.last, joint.setting
    local = [int(np.flatnonzero(joint.entries == e)[0]) for e in payloads]
    free = [*last.free[last.free >= 0], *local]
    return fit(*found.structure, last.theta[None], [free], last.start[None],
               width=max(s.width, len(free)), lanes=s.lanes, iterations=0)[0]  # fmt: skip


def _in_order(named: list[tuple], joints: Sequence[_Joint]) -> list[tuple]:
    """The causes of all joints by what they explain, each joint's own order kept."""
    size = lambda one: one[0].before ** 2 - one[0].after ** 2  # noqa: E731
    queues = [[one for one in named if one[1] == j] for j in range(len(joints))]
    ordered = []
    while any(queues):
        best = max((q for q in queues if q), key=lambda q: size(q[0]))
        ordered.append(best.pop(0))
    return ordered


def _together(here: Setting, joints: Sequence[_Joint], fits: Sequence[Fit]) -> Fit:
    theta = values(here.loop, here.known.table)
    for joint, one in zip(joints, fits, strict=True):
        theta[joint.entries] = one.theta
    structure = Structure(here.loop, here.known.table, here.data)
    return _assembled_fit(structure, fits, [joint.entries for joint in joints], theta, here.loop.robot.nv)


def _assembled_fit(
    structure: Structure, fits: Sequence[Fit], maps: Sequence[np.ndarray], theta: np.ndarray, n: int
) -> Fit:
    """One fit of the arm: squares of its own simulation, each joint's sensitivities to its own numbers."""
    size = structure.loop.robot.nv
    frees = [one.free[one.free >= 0] for one in fits]
    free = np.array(list(dict.fromkeys(int(k) for j, f in enumerate(frees) for k in maps[j][f])), int)
    place = {int(k): i for i, k in enumerate(free)}
    blocks, count, m = *fits[0].sums.cost.shape[:2], len(free)
    states, start = 2 * size, np.zeros((2 * size, count))
    gradient = np.zeros((blocks, count, m + states))
    matrix = np.zeros((blocks, count, m + states, m + states))
    spring = n
    for j, (one, mine) in enumerate(zip(fits, frees, strict=True)):
        own = len(one.start) // 2
        places = [j] + ([spring] if own == 2 else [])
        spring += own == 2
        rows = [*places, *(size + p for p in places)]
        start[rows] = one.start
        used = np.concatenate([np.flatnonzero(one.free >= 0), len(one.free) + np.arange(2 * own)])
        columns = np.array([*(place[int(k)] for k in maps[j][mine]), *(m + r for r in rows)], int)
        gradient[..., columns] += one.sums.gradient[..., used]
        matrix[..., columns[:, None], columns[None]] += one.sums.matrix[..., used[:, None], used[None]]
    whole = Fit(theta, free, start, 0.0, Sums(np.zeros((blocks, count, 1)), gradient, matrix), True)  # pyright: ignore[reportArgumentType]
    error = residuals(structure, whole)
    cost = (error.reshape(blocks, -1, *error.shape[1:]) ** 2).sum(1).swapaxes(1, 2)
    return whole._replace(cost=float(cost.sum()), sums=Sums(cost, gradient, matrix))  # pyright: ignore[reportArgumentType]
