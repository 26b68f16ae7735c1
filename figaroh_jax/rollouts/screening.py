"""What could be missing in an arm: candidates ranked by one linear step each, the best of every joint fitted.

One linearisation of the arm ranks all that is linear; limits of drives and springs, which change the model before it
can be differentiated, are ranked on the windows where their joint is off the most. Candidates of different joints share
a fit, and a joint that is off by as much as when it was looked at last is not looked at again.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from .causes import Candidate, elastic_loop, elastic_table, springs
from .fit import Fit, fit
from .found import Model, Tried
from .loop import Loop
from .own import is_own
from .parameters import OF_DRIVES, OF_SEVERAL, values
from .search import scored, settled
from .sensitivity import Windows
from .setting import (  # fmt: skip
    Setting,
    Structure,
    by_recording,
    excess,
    free_entries,
    largest_forces,
    start_values,
    whitened,
)
from .thresholds import EXPLAINED, GAIN, HOPEFUL, MAY_WIN, RICHER, UNCHANGED, USUAL

__all__ = [
    "LATE",
    "ROUGH",
    "Known",
    "Standing",
    "excess_of",
    "joint_of",
    "joint_of_entry",
    "outputs",
    "sprung_now",
    "tried_now",
]

LATE, ROUGH = 30, 1e-4  # iterations; share of the squares that a step must promise
_EARLY = 3  # iterations of each candidate
_SPRUNG = 10  # of a spring by itself: far from its stiffness the first ones are refused
_MOST = 6  # causes of a joint
_TOP, _RACE = 3, 2  # candidates of a joint that are fitted, and that are fitted to the end
_PART = 3  # of the windows, one in so many shows whether a limit or a spring is worth a fit
_SHARES = (0.005, 0.05, 0.3)  # twists of a spring under the largest torque, rad or m
_PLAYS = (0.1, 0.4, 1.5)  # of a spring's twist under the largest torque
_LOWER = (0.45, 0.2)  # times a limit's starts: a stalled drive is asked for many times what it gives
_ABOVE = 1.3  # times where a limit's fit has ended: from there it is fitted once more


class Standing(NamedTuple):
    """The model that stands, its squares and those held out by outputs, and how far it is from noise by joint."""

    model: Model
    squares: np.ndarray  # (blocks, windows, joints)
    held: np.ndarray  # the same, of fits without some recordings or quarters
    excess: np.ndarray  # (joints,)


class _Seen(NamedTuple):
    """What was tried at a joint, when its squares were so large, and what held-out rows have refused since."""

    squares: float
    tried: list[Tried]
    refused: list[Candidate]


Known = dict[int, _Seen]


class _Ranked(NamedTuple):
    """A candidate with the decrease of the squares that one linear step promises."""

    promise: float
    structure: Structure
    candidate: Candidate
    theta: np.ndarray


def tried_now(
    here: Setting, now: Standing, named: Sequence[Candidate], forbid: Sequence[str], known: Known
) -> list[Tried]:
    """The candidates that one linear step promises most at each joint that is open, fitted.

    Where a joint is off by as much as when it was looked at last, what was found then stands.
    """
    model, n = now.model, here.loop.robot.nv
    rigid = model.structure.loop.robot.nv == n
    open_joints = [j for j in range(n) if now.excess[j] >= 1.0] or list(range(n))
    sizes = {-1: float(now.squares.sum())} | {j: float(now.squares[..., j].sum()) for j in range(n)}
    same = {j for j, one in known.items() if abs(one.squares - sizes[j]) < UNCHANGED * sizes[j]}
    stands = [_as_now(now, j, one) for j in sorted(same) if j < 0 or j in open_joints for one in known[j].tried]
    open_joints = [j for j in open_joints if j not in same]
    if not open_joints:
        return stands
    used = {(c.effect, c.at) for c in named}
    constant = {c.at for c in named if c.kind.constant}
    count = {at: sum(c.at == at for c in named) for at in {c.at for c in named}}
    left = [
        c for c in here.known.candidates
        if (c.effect, c.at) not in used and not set(c.entries) <= set(model.free)
        and not (c.kind.constant and c.at in constant) and count.get(c.at, 0) < _MOST
        and ((joint_of(here, c) < 0 and -1 not in same) or joint_of(here, c) in open_joints)
    ]  # fmt: skip
    own, cost = now.squares.sum((0, 1)), model.fit.cost
    bare = {j for j in open_joints if not any(joint_of(here, c) == j for c in named)}
    plain = [c for c in left if not c.kind.limit]
    best: dict[int, list[_Ranked]] = {}
    for k, (score, theta) in scored(here, model, plain).items():
        best.setdefault(joint_of(here, plain[k]), []).append(_Ranked(cost - score, model.structure, plain[k], theta))
    for j in open_joints:
        common = [one for one in best.get(j, []) if one.candidate.kind.usual and one.promise > USUAL * own[j]]
        if common and now.excess[j] >= 1.0:  # nothing that few joints have can come before it
            best[j] = [max(common, key=lambda one: one.promise)]
            continue
        best.setdefault(j, []).extend(
            _limits_and_springs(here, now, left, best.get(j, []), j, rigid, forbid, j in bare)
        )
    hopeful: dict[int, list[_Ranked]] = {}
    for j, ones in best.items():
        ranked = sorted(ones, key=lambda one: -one.promise)
        ranked = [one for k, one in enumerate(ranked) if all(one[2] is not other[2] for other in ranked[:k])]
        ranked = [one for one in ranked if not _no_more(one, ranked)]
        least = (HOPEFUL if by_recording(here) and now.excess.max() >= 1.0 else 0.0) * own[j]
        enough = [one for one in ranked if j < 0 or one.promise > least or one.candidate.kind.usual]
        usual = [one for one in enough if one.candidate.kind.usual][:1]  # may come before what promises more
        rest = [one for one in enough if all(one is not x for x in usual)]
        chosen = [*usual, *rest][: _TOP if j >= 0 else 1]
        if j < 0:  # a motor that turns with the sum of two joints, and one that turns with their difference
            chosen = [one for one in rest if one.candidate[:2] == chosen[0].candidate[:2]] if chosen else []
        hopeful[j] = chosen + [
            one for one in ranked if _asked_by(one.candidate, chosen) and all(one is not x for x in chosen)
        ]
    found = _fitted(here, now, hopeful, bare)
    for j in (-1, *open_joints) if -1 not in same else open_joints:
        known[j] = _Seen(sizes[j], [one for one in found if joint_of(here, one.candidate) == j], [])
    return stands + found


def _as_now(now: Standing, joint: int, one: Tried) -> Tried:
    """What was tried at a joint before, the other joints as they are now."""
    if joint < 0:
        return one._replace(alone=False)
    sse = now.squares.copy()
    sse[..., joint] = one.sse[..., joint]
    return one._replace(alone=False, sse=sse)


def _limits_and_springs(
    here: Setting, now: Standing, left: Sequence[Candidate], plain: Sequence[_Ranked], joint: int, rigid: bool,
    forbid: Sequence[str], bare: bool,
) -> list[_Ranked]:  # fmt: skip
    """What changes the model before it can be differentiated, ranked on the windows where the joint is off the most.

    `bare`: the joint has no cause yet, so that its baseline may stand for one of its drive.
    """
    (part, share, _), model = _part(now, joint), now.model
    mine = [c for c in left if joint_of(here, c) == joint]
    leader = max(plain, key=lambda one: one.promise, default=None)
    chosen = [c for c in mine if c.kind.limit or (leader is not None and c is leader.candidate)]
    if leader is not None and leader.candidate.kind.shapes:  # from the start that was the best one
        best = leader.candidate._replace(starts=(tuple(leader.theta[list(leader.candidate.entries)]),))
        chosen = [best if c is leader.candidate else c for c in chosen]
    scores = {chosen[k].effect: (part.fit.cost - x, theta) for k, (x, theta) in scored(here, part, chosen).items()}
    if bare and now.excess[joint] >= 1.0:
        for effect, (promise, theta) in _limits_as_filed(here, part, chosen, joint).items():
            if promise > scores.get(effect, (0.0, theta))[0]:
                scores[effect] = promise, theta
    if leader is not None and scores.get(leader.candidate.effect, (0.0, None))[0] > 0:
        share = leader.promise / scores[leader.candidate.effect][0]  # as much more as the same cause promises in all
    found = [
        _Ranked(scores[c.effect][0] * share, model.structure, c, scores[c.effect][1])
        for c in chosen if c.kind.limit and c.effect in scores
    ]  # fmt: skip
    most = max((one.promise for one in [*plain, *found]), default=0.0)
    much = now.excess.max() >= 1.0 and now.squares[..., joint].sum() - most > EXPLAINED * _rows(here, joint)
    if rigid and much:
        found += [one._replace(promise=one.promise * share) for one in _sprung(here, now, joint, forbid)]
    elif much:
        found += [one._replace(promise=one.promise * share) for one in _looser(here, now, joint, forbid)]
    return found


def _limits_as_filed(
    here: Setting, part: Model, chosen: Sequence[Candidate], joint: int
) -> dict[str, tuple[float, np.ndarray]]:
    """What limits of a joint's drive promise from the numbers of the model file, by effect, and from which numbers."""
    limits = [c._replace(starts=tuple((b * x,) for b in _LOWER for (x,) in c.starts)) for c in chosen if c.kind.limit]
    begin = {"theta": _as_filed(here, part.fit.theta, joint), "start": np.asarray(part.structure.data.start)}
    found = scored(here, part._replace(fit=part.fit._replace(**begin)), limits)
    return {limits[k].effect: (part.fit.cost - cost, theta) for k, (cost, theta) in found.items()}


def _as_filed(here: Setting, theta: np.ndarray, joint: int) -> np.ndarray:
    """The numbers of a model, what the baseline frees at a joint as in the model file.

    A baseline without a drive's limit holds up with friction what the drive lets fall.
    """
    mine, filed = [k for k in here.baseline if joint_of_entry(here, k) == joint], theta.copy()
    filed[mine] = values(here.loop, here.known.table)[mine]
    return filed


def _looser(here: Setting, now: Standing, joint: int, forbid: Sequence[str]) -> list[_Ranked]:
    """A spring that stands at a joint, with what contains it in its place: play as well."""
    model, first = now.model, len(here.known.table)
    wanted = [c for c in springs(here.loop.robot.dof_names[joint], first, forbid) if c.kind.telling is not None]
    wanted = [c for c in wanted if set(c.entries) - set(model.free) == {c.entries[c.kind.telling or 0]}]
    if not wanted or _sprung_joint(model.structure.loop) != joint:
        return []
    part, _, _ = _part(now, joint)
    (c,), found = wanted, []
    twist = _torque(here, joint) / max(float(model.fit.theta[first]), 1e-9)
    for share in _PLAYS:
        theta = model.fit.theta.copy()
        theta[c.entries[c.kind.telling or 0]] = share * twist
        score = settled(here, part.structure, theta, free_entries(model.free, c.entries), part.fit.start)
        found.append(_Ranked(part.fit.cost - score, model.structure, c, theta))
    return found


def _sprung_joint(loop: Loop) -> int:
    """The coordinate behind whose motor the last coordinate is the twist of a spring."""
    spring = next(joint for joint in loop.robot.joints if joint.coordinate == loop.robot.nv - 1)
    return loop.robot.joints[spring.parent].coordinate


def _part(now: Standing, joint: int) -> tuple[Model, float, np.ndarray]:
    """The model on the windows where a joint is off the most, how much more it is off in all, and which they are."""
    structure, one = now.model.structure, now.model.fit
    own = now.squares[..., joint].sum(0)
    which = np.sort(np.argsort(own)[::-1][: -(-len(own) // _PART)])
    data = _only(structure.data, which)
    start = one.start[:, which]
    prior = (start - data.start) * data.precision
    cost = float(one.sums.cost[:, which].sum() + (prior**2).sum())
    sums = type(one.sums)(*(np.asarray(x)[:, which] for x in one.sums))  # pyright: ignore[reportArgumentType]
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


def _asked_by(one: Candidate, others: Sequence[_Ranked]) -> bool:
    """Whether another is more of it, or may stand for it, as limits of a drive do: it has to be fitted too then."""
    kinds = [x.candidate.kind for x in others]
    return any(one.effect in (x.adds_to, x.rival_of) or (one.kind.limit and x.limit) for x in kinds)


def _no_more(one: _Ranked, ranked: Sequence[_Ranked]) -> bool:
    """Whether a candidate promises hardly more than one that it contains."""
    kind = one.candidate.kind
    return any(kind.holds(other.candidate.effect) and one.promise < RICHER * other.promise for other in ranked)


def _fitted(here: Setting, now: Standing, hopeful: dict[int, list[_Ranked]], bare: Collection[int]) -> list[Tried]:
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
        near = [x for x in ordered if before - x[0] > MAY_WIN * (before - ordered[0][0])]
        first = near[:_RACE]
        first += [x for x in ordered if all(x is not y for y in first) and x[0] < before
                  and _asked_by(x[1].candidate, [y[1] for y in near[:_RACE]])]  # fmt: skip
        leaders[j] = [(x[1], x[2]) for x in first]
    last = _all_in_lanes(here, now, leaders, LATE, now.model.fit.cost)
    found = []
    for one in _limits_anew(here, last, bare):
        c, beyond = one.ranked.candidate, excess_of(here, one.ranked.structure, one.fit)
        own = float(beyond.max() if one.joint < 0 else beyond[one.joint])
        state = Model(one.ranked.structure, one.fit, one.free, own)
        sse = outputs(here, one.fit.sums.cost)
        if not one.alone:
            mine, sse = sse[..., one.joint], now.squares.copy()
            sse[..., one.joint] = mine
        found.append(Tried(c, state, sse, one.alone))
    return found


def _limits_anew(here: Setting, fits: Sequence[_OneOf], bare: Collection[int]) -> list[_OneOf]:
    """The fits, those of a drive's limit that leave more than noise begun again; the better ends.

    A limit that a step has put too low lets the joint fall, and no step leads back: it is begun from above, and from
    where the best of the joint's limits has ended, the baseline as in the model file.
    """
    found, ends = list(fits), dict[int, float]()
    for again in range(2):
        for k, one in enumerate(found):
            if not (one.ranked.candidate.kind.limit and one.alone and one.joint in bare):
                continue
            (entry,) = one.ranked.candidate.entries
            begin = _ABOVE * float(one.fit.theta[entry]) if not again else ends[one.joint]
            if again and begin == float(one.fit.theta[entry]):
                continue  # it is the best one itself
            found[k] = _limit_from(here, one, begin)
        for one in sorted((x for x in found if x.ranked.candidate.kind.limit), key=lambda x: -x.fit.cost):
            ends[one.joint] = float(one.fit.theta[one.ranked.candidate.entries[0]])
    return found


def _limit_from(here: Setting, one: _OneOf, limit: float) -> _OneOf:
    """A fit of a drive's limit, or one begun at `limit` with the model file's baseline where that leaves less."""
    structure = one.ranked.structure
    if excess_of(here, structure, one.fit)[one.joint] < 1.0:
        return one
    theta = _as_filed(here, one.fit.theta, one.joint)
    theta[list(one.ranked.candidate.entries)] = limit
    other = fit(*structure, theta[None], [one.free], np.asarray(structure.data.start)[None],
                width=max(here.width, len(one.free)), lanes=1, iterations=LATE, rough=ROUGH / 10)[0]  # fmt: skip
    if not other.cost < one.fit.cost:
        return one
    return one._replace(fit=other, own=float(outputs(here, other.sums.cost)[..., one.joint].sum()))


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
    return [(one, x) for x in ([one.theta] if c.kind.elastic or not c.starts or c.kind.limit or c.kind.shapes else
                               [start_values(one.theta, c, start) for start in c.starts])]  # fmt: skip


def _all_in_lanes(
    here: Setting, now: Standing, lists: dict[int, list[tuple[_Ranked, np.ndarray]]], most: int, below: float
) -> list[_OneOf]:
    """Every candidate of the lists fitted, the first of each joint together, then the second ones, and so on.

    A spring changes the structure, a payload shows at several joints, a limit may hold up the steps of the others, and
    a joint that is off by more than all others together decides which steps are taken: these are fitted by themselves.
    """
    own = now.squares.sum((0, 1))
    large = [j for j in lists if j >= 0 and own[j] > 0.5 * own.sum()]
    apart = {j: [one for one in ones if j in large or _fitted_alone(one[0].candidate)] for j, ones in lists.items()}
    single = [(j, *one) for j, ones in apart.items() for one in ones]
    plain = {j: [x for x in ones if all(x is not y for y in apart[j])] for j, ones in lists.items() if j >= 0}
    lanes = [[(j, *ones[m]) for j, ones in plain.items() if m < len(ones)]
             for m in range(max((len(ones) for ones in plain.values()), default=0))]  # fmt: skip
    found, queue = [], [*lanes, *([one] for one in single)]
    while queue:
        lane = queue.pop(0)
        structure, theta, free = lane[0][1].structure, lane[0][2].copy(), list(now.model.free)
        for j, ranked, begin in lane:
            mine = list(ranked.candidate.entries)
            if len(lane) == 1:
                theta = begin.copy()
            own = [*mine, *(k for k in free if joint_of_entry(here, k) == j)]
            held = ranked.candidate.kind.falls_off if most == _EARLY else None  # a speed waits until its size is found
            theta[own], free = begin[own], free_entries(free, [k for i, k in enumerate(mine) if i != held])
        start = _start_of(now, structure)
        one = fit(*structure, theta[None], [free], start[None], width=max(here.width, len(free)), lanes=1,
                  iterations=most, rough=ROUGH / 10, below=below or np.inf)[0]  # fmt: skip
        if not np.isfinite(one.cost):  # one of them diverges: each by itself
            queue += [[x] for x in lane] if len(lane) > 1 else []
            continue
        squares = outputs(here, one.sums.cost)
        for j, ranked, _ in lane:
            own = float(squares[..., j].sum() if j >= 0 else squares.sum())
            found.append(_OneOf(j, own, ranked, one, tuple(free), len(lane) == 1))
    return found


def _fitted_alone(one: Candidate) -> bool:
    """Whether a candidate shares no fit with those of other joints."""
    return one.kind.elastic or one.kind.limit or one.kind.several


def _start_of(now: Standing, structure: Structure) -> np.ndarray:
    """The states at the windows' starts, in a structure that may have a spring more."""
    start, n = now.model.fit.start, now.model.structure.loop.robot.nv
    more = structure.loop.robot.nv - n
    zero = np.zeros((more, start.shape[1]))
    return np.concatenate([start[:n], zero, start[n:], zero]) if more else start


def _sprung(here: Setting, now: Standing, joint: int, forbid: Sequence[str]) -> list[_Ranked]:
    """A spring, and a spring with play, between motor and link of a joint."""
    wanted = springs(here.loop.robot.dof_names[joint], len(here.known.table), forbid)
    torque = _torque(here, joint)
    if not wanted or not np.isfinite(torque):
        return []
    loop = elastic_loop(here.loop, joint, 10.0 * torque, 0.01 * torque)
    table = elastic_table(here.loop, here.known.table, joint)
    structure = Structure(loop, table, here.cut(loop))
    part, _, which = _part(now, joint)
    small = structure._replace(data=_only(structure.data, which))
    start = _start_of(now, structure)[:, which]
    found = []
    for c in wanted:
        for share in _SHARES:
            play = 0.0 if c.kind.telling is None else 0.1 * share
            theta = np.concatenate([now.model.fit.theta, [torque / share, 0.002 * torque / share, play]])
            score = settled(here, small, theta, free_entries(now.model.free, c.entries), start)
            found.append(_Ranked(part.fit.cost - score, structure, c, theta))
    return found


def sprung_now(here: Setting, now: Standing, forbid: Sequence[str]) -> list[Tried]:
    """A spring at each joint of a rigid arm, with and without play: a few steps of each, those that may win to the end.

    A joint's own encoder does not judge it: a spring shows at the joints beside it too.
    """
    if now.model.structure.loop.robot.nv != here.loop.robot.nv:
        return []
    ranked = [max(_sprung(here, now, j, forbid), key=lambda one: one.promise, default=None)
              for j in range(here.loop.robot.nv)]  # fmt: skip
    early = [one for one in ranked if one is not None]
    early = [(one, _spring_fitted(here, now, one, one.theta, _start_of(now, one.structure), _SPRUNG)) for one in early]
    gains = [now.model.fit.cost - last.cost for _, last in early]
    least = max(MAY_WIN * max(gains, default=0.0), GAIN * now.model.fit.squares)
    found = []
    for (one, begun), gain in zip(early, gains, strict=True):
        if gain > least:
            found += _with_and_without_play(here, now, one, begun, forbid)
    return found


def _spring_fitted(
    here: Setting, now: Standing, one: _Ranked, theta: np.ndarray, start: np.ndarray, most: int
) -> Fit:  # fmt: skip
    free = free_entries(now.model.free, one.candidate.entries)
    return fit(*one.structure, theta[None], [free], start[None], width=max(here.width, len(free)), lanes=1,
               iterations=most)[0]  # fmt: skip


def _with_and_without_play(
    here: Setting, now: Standing, one: _Ranked, begun: Fit, forbid: Sequence[str]
) -> list[Tried]:
    """The spring of a joint fitted to the end, and what contains it or is contained in it from there."""
    last = _spring_fitted(here, now, one, begun.theta, begun.start, LATE)
    if not np.isfinite(last.cost):
        return []
    found = [_tried_spring(here, now, one, last)]
    first = len(here.known.table)
    for other in springs(one.candidate.at[0], first, forbid):
        if other.effect == one.candidate.effect:
            continue
        play = first + 2
        plays = [0.0]
        if other.kind.telling is not None:
            twist = float(_torque(here, joint_of(here, other)) / max(last.theta[first], 1e-9))
            plays = [share * twist for share in _PLAYS]
        fits = []
        for width in plays:
            theta = last.theta.copy()
            theta[play] = width
            fits.append(_spring_fitted(here, now, one._replace(candidate=other), theta, last.start, _EARLY))
        best = min(fits, key=lambda x: x.cost)
        best = _spring_fitted(here, now, one._replace(candidate=other), best.theta, best.start, LATE)
        if np.isfinite(best.cost):
            found.append(_tried_spring(here, now, one._replace(candidate=other), best))
    return found


def _tried_spring(here: Setting, now: Standing, one: _Ranked, last: Fit) -> Tried:
    free = tuple(free_entries(now.model.free, one.candidate.entries))
    state = Model(one.structure, last, free, float(excess_of(here, one.structure, last).max()))
    return Tried(one.candidate, state, outputs(here, last.sums.cost))


def _torque(here: Setting, joint: int) -> float:
    """The largest torque that the drives of a joint gave, N m or N."""
    way = np.abs(np.asarray(here.loop.drives.transmission))[:, joint]
    return float(max((way * largest_forces(here.loop, here.runs)).max(initial=0.0), 1e-6))


def outputs(here: Setting, squares: Any) -> np.ndarray:
    """Squares by outputs as squares by joints of the robot: rates go with their positions."""
    places, count = list(here.loop.measured), len(here.loop.measured)
    found = np.zeros((*squares.shape[:2], here.loop.robot.nv))
    for first in range(0, squares.shape[2], count):
        found[..., places] += squares[..., first : first + count]
    return found


def excess_of(here: Setting, structure: Structure, one: Fit) -> np.ndarray:
    """How far each joint's residual is above noise."""
    error, share = whitened(structure, one), np.asarray(structure.data.share)
    count, found = len(here.loop.measured), np.zeros(here.loop.robot.nv)
    for k, place in enumerate(here.loop.measured):
        mine = slice(k, None, count)
        found[place] = excess(error[:, mine], share[:, mine]) if share[:, mine].any() else 0.0
    return found


def joint_of(here: Setting, c: Candidate) -> int:
    """The joint whose encoder shows a cause; -1: those of several."""
    return -1 if c.kind.several else here.loop.robot.dof_names.index(c.at[0])


def joint_of_entry(here: Setting, entry: int) -> int:
    """The joint whose encoder shows a number of the table; -1: those of several."""
    one = here.known.table[entry] if entry < len(here.known.table) else None
    if one is None or len(one.at) != 1 or one.name in OF_SEVERAL:
        return -1
    (place,) = one.at
    if is_own(one.name):
        at = here.loop.effects[place].places
        return int(at[0]) if len(at) == 1 else -1
    if one.name in OF_DRIVES:
        return int(np.argmax(np.abs(np.asarray(here.loop.drives.transmission)[place])))
    return place
