"""Whether the masses and inertias of a robot's file are wrong, asked where a search ends beside a rest.

Ten numbers of a link make up for many a misfit, so they are asked last, link after link, and only those numbers that
the recordings tell to a share of the link's own size. A link is named where recordings left out are surely predicted
better, and where a body can have what was found: numbers that imitate another effect seldom are those of one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import numpy as np

from ..effects.catalogue import ROLLOUTS
from ..errors import InputError
from ..estimation.conic import NotConverged
from ..estimation.consistency import bodies, inconsistencies, physical_fit, project
from ..estimation.told import ABOUT_JOINT, beside, bodies_with, inertia_about_joint, sizes, told_numbers
from ..results import Name
from .arm import baseline_alone
from .causes import Candidate
from .fit import Fit, System, fit
from .found import TOO_LITTLE, Model, Named, Search
from .gates import rms_of, standing
from .loop import Loop, brought_back
from .parameters import TEN, Entry, put, values
from .screening import Standing, excess_of
from .sensitivity import Windows
from .setting import Setting, Structure, by_recording, excess, free_entries, thinned, whitened
from .sizes import told_errors
from .steady import most_unsteady
from .thresholds import (
    BODY,
    CLEAR_OF_NOTHING,
    GAIN,
    GAIN_BESIDE_REST,
    MOST_OF_A_REST,
    STEADY_OF_A_LINK,
    T_BESIDE_REST,
    T_WITHOUT_REST,
    t_of,
    t_of_recordings,
)

__all__ = [
    "EFFECT",
    "Link",
    "body_notes",
    "consistent",
    "fitted_links",
    "nearest_bodies",
    "searched_with_bodies",
    "told_alone",
    "with_bodies",
]

EFFECT = "link_inertia"
_LOOKS = 4  # at most, at which numbers are told
_COUPLED = "coupled_transmission"
_NO_OTHER = 1e-5  # of what a number does: what others cannot do as well, where it is one of them
_AS_GOOD = 1.001  # times the squares of a fit, up to which links that bodies can have leave as little
_NEARER = 4  # times at most that the nearest links are looked for where the last ones were
_EARLY = 0.25  # of a window's rows, that are fitted first
_TRIED = 3  # links that are fitted in a round
_MOST = 80  # iterations: links that are far off take many

Seek = Callable[..., Search]


def searched_with_bodies(
    seek: Seek,
    here: Setting,
    found: Search,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    *,
    forbid: Sequence[str] = (),
) -> Search:
    """What a search has found; where it leaves a rest, the search with the inertia of links fitted if that is better.

    `link_inertia` is named at every link that recordings left out bear out, before all other causes. So it is in place
    of a payload and more, where it leaves noise alone with fewer causes: a load is seldom at the link's centre of mass.
    """
    if (fewer := _in_place_of_a_load(seek, here, found, progress, forbid)) is not None:
        return fewer
    if not _is_asked(here, found, forbid):
        return found
    progress("asking whether links are as heavy as the file says", 0.9)
    before = found.setting or here
    plain = _rigid(here, found)
    sound = replace(before, loop=plain.structure.loop)
    whole = with_bodies(sound, range(len(sound.loop.robot.joints)))
    links, model, missed = _links(thinned(whole), plain)
    if not links:
        return replace(found, nearest=[*missed, *found.nearest])
    some = _freed(sound, whole, plain, links, model)
    other = seek(some, progress, forbid=forbid)
    if not np.isfinite(other.last.cost) or len(other.structure.table) != len(some.known.table):
        return found
    return _better(before.loop, whole, found, some, other, links)


def _in_place_of_a_load(
    seek: Seek, here: Setting, found: Search, progress: Callable[[str, float], None], forbid: Sequence[str]
) -> Search | None:
    """The search with links from the baseline on, where it has fewer causes than one with a payload, and no rest.

    Inertia that two joints share may be that of a link: where one link alone does as well, a coupling is told with it.
    """
    causes = found.named or found.proxy
    effects = {n.candidate.effect for n in causes}
    asked = ("payload" in effects and len(causes) > 1) or (found.verdict == "named" and _COUPLED in effects)
    if not (asked and _may_have_links(found, forbid) and found.origin is not None):
        return None
    sound = replace(found.setting or here, loop=found.origin.loop)
    whole, plain = with_bodies(sound, range(len(sound.loop.robot.joints))), _Rigid(found.origin, found.first)
    links, model, _ = _links(thinned(whole), plain)
    if not 0 < len(links) <= len(causes):
        return None
    some = _freed(sound, whole, plain, links, model)
    other = seek(some, progress, forbid=forbid)
    known = np.isfinite(other.last.cost) and len(other.structure.table) == len(some.known.table)
    if not known or other.verdict not in ("nothing", "named") or len(links) + len(other.named) > len(causes):
        return None
    new = _better((found.setting or here).loop, whole, found, some, other, links, fewer=True)
    if new is found or len(new.named) < len(causes):
        return new if new is not found else None
    told = tuple(Name(n.candidate.effect, n.candidate.at) for n in new.named if n.candidate.effect == EFFECT)
    both = [n._replace(alike=(*n.alike, *told)) if n.candidate.effect == _COUPLED else n for n in found.named]
    return replace(found, named=both) if found.verdict == "named" else None


def _may_have_links(found: Search, forbid: Sequence[str]) -> bool:
    """Whether links may be the reason for what a search has found."""
    loop = found.structure.loop
    plain = loop.carried is None and all(joint.kind in ("revolute", "prismatic") for joint in loop.robot.joints)
    return plain and bool(np.isfinite(found.last.cost)) and EFFECT not in forbid


def _is_asked(here: Setting, found: Search, forbid: Sequence[str]) -> bool:
    """Whether a rest is left in a robot whose links may be the reason."""
    return found.verdict in ("unknown", "named+rest") and _may_have_links(found, forbid)


class _Rigid(NamedTuple):
    """A model without a spring."""

    structure: Structure
    last: Fit


def _rigid(here: Setting, found: Search) -> _Rigid:
    """The model that a search has ended with, or its baseline where that has a spring: it may stand in for a link."""
    if len(found.structure.table) == len(here.known.table) or found.origin is None:
        return _Rigid(found.structure, found.last)
    return _Rigid(found.origin, found.first)


def with_bodies(here: Setting, links: Sequence[int]) -> Setting:
    """The setting with the ten numbers of links at the end of its table, but for those that are there already."""
    more = [Entry(name, (i,)) for i in links for name in TEN if not _entries(here, i)]
    return replace(here, known=here.known._replace(table=(*here.known.table, *more)))


class Link(NamedTuple):
    """A link, and the entries of the table that are those of its numbers that the recordings tell."""

    at: int
    entries: tuple[int, ...]
    promise: float  # squares that a linear step of these would take away


def _entries(here: Setting, link: int) -> list[int]:
    """Where the ten numbers of a link stand in the table."""
    return [k for k, e in enumerate(here.known.table) if e.name in TEN and e.at == (link,)]


class _Look:
    """One linearisation of a model by all numbers of all links, and which of these the recordings tell."""

    def __init__(self, here: Setting, now: Model, free: Sequence[int]):
        self.here, self.scale, self.level = here, sizes(here.loop.robot), _level(now)
        every = range(len(here.loop.robot.joints))
        self.places = [i for i in every if not set(_entries(here, i)) & set(free)]  # others are fitted already
        self.columns = free_entries(free, [k for i in self.places for k in _entries(here, i)])
        low, high = here.bounds.T
        self.bound = [k for k in free if not low[k] < now.fit.theta[k] < high[k]]
        self.others = [self.columns.index(k) for k in free if k not in self.bound]
        one = fit(*now.structure, now.fit.theta[None], [self.columns], now.fit.start[None], width=len(self.columns),
                  lanes=1, iterations=0)[0]  # fmt: skip
        self.finite = bool(np.isfinite(one.cost))
        if self.finite:
            self.matrix, self.right = System(one.sums, now.structure.data, one.start).reduced(1e-6)

    def told(self, links: Sequence[int]) -> list[Link]:
        """Of each link the numbers that are told to a share of its size, beside all else and the links before it.

        The noise is taken as large as all that is left. Masses come last: where a link turns about what moves, its mass
        is as good as a moment of what carries it. What is not told stays as the file has it.
        """
        if not self.finite:
            return [Link(i, (), 0.0) for i in links]
        entries = [_entries(self.here, i) for i in links]
        tens = [[self.columns.index(k) for k in ten] for ten in entries]
        found = told_numbers(self.matrix, self.right, tens, self.others, self.scale[list(links)], self.level)
        own = zip(links, entries, found, strict=True)
        return [Link(i, tuple(ten[k] for k in told), promise) for i, ten, (told, promise) in own]

    def spare(self, links: Sequence[Link]) -> set[int]:
        """Free numbers on their bounds whose part these links' numbers take: a rotor of none that turns with a link."""
        if not self.finite:
            return set()
        others = [*self.others, *(self.columns.index(k) for link in links for k in link.entries)]
        at = [(k, self.columns.index(k)) for k in self.bound]
        left = [(k, beside(self.matrix, self.right, [c], others)[0][0, 0] / self.matrix[c, c]) for k, c in at
                if self.matrix[c, c] > 0]  # fmt: skip
        return {k for k, share in left if share < _NO_OTHER}


def _links(here: Setting, found: _Rigid) -> tuple[list[Link], Standing, list[tuple[Name, float, str]]]:
    """The links whose inertia recordings left out bear out, the model with them, and else what came nearest.

    Links come in one after another while each takes much of what is left, those that the others can spare go again: no
    link by itself may predict better where several are wrong.
    """
    loop, table = found.structure.loop, here.known.table
    theta = np.concatenate([found.last.theta, np.zeros(len(table) - len(found.last.theta))])
    free = [int(k) for k in found.last.free if k >= 0]
    structure = Structure(loop, table, here.cut(loop))
    now = standing(here, structure, _fitted(here, structure, theta, free), free)
    steps = [(list[Link](), now.model)]
    while len(steps) <= len(loop.robot.joints) and (not steps[1:] or steps[-1][1].excess >= 1.0):
        best = _one_more(here, now, steps[-1][1], steps[-1][0])
        if best is None:
            break
        steps.append(best)
    missed: list[tuple[Name, float, str]] = []
    for links, model in reversed(steps[1:]):  # fewer where no bodies have what all of them would
        links, model = _told_further(here, now, model, links)
        new = _stands_as_bodies(here, now, model, links)
        gain, _, enough = (0.0, 0.0, False) if new is None else borne_out(here, now, new, MOST_OF_A_REST)
        if new is not None and enough:
            return *_needed(here, now, links, new), []
        if gain > GAIN_BESIDE_REST and not missed:
            alone = gain > MOST_OF_A_REST and by_recording(here)
            why = "not as good in all recordings" if alone else TOO_LITTLE
            missed = [(Name(EFFECT, (loop.robot.link_names[link.at],)), gain, why) for link in links]
    return [], now, missed


def _needed(here: Setting, now: Standing, links: list[Link], new: Standing) -> tuple[list[Link], Standing]:
    """The links without those that the others can spare, the least first."""
    free = now.model.free
    while len(links) > 1:
        fewer, gone = [[x for x in links if x is not link] for link in links], set(free) - set(new.model.free)
        models = [(one, _with(here, now, new.model, one, gone)) for one in fewer]
        least, other = min(models, key=lambda one: one[1].fit.cost)
        without = _stands_as_bodies(here, now, other, least)
        if without is None or borne_out(here, without, new)[2]:
            break
        links, new = least, without
    return links, new


def _one_more(here: Setting, now: Standing, model: Model, links: Sequence[Link]) -> tuple[list[Link], Model] | None:
    """The links with the one more that leaves the least, where it takes much of what is left or leaves noise alone."""
    look, taken = _Look(here, model, now.model.free), [link.at for link in links]
    sets = [look.told([*taken, i]) for i in look.places if i not in taken]
    sets = sorted([one for one in sets if one[-1].entries], key=lambda one: -one[-1].promise)[:_TRIED]
    ends = [(one, _with(here, now, model, one, look.spare(one))) for one in sets]
    best = min(ends, key=lambda one: one[1].fit.cost, default=None)
    if best is None or not np.isfinite(best[1].fit.cost):
        return None
    new = best[1]
    return best if new.excess < 1.0 or new.fit.squares < (1 - GAIN_BESIDE_REST) * model.fit.squares else None


def _told_further(here: Setting, now: Standing, model: Model, links: list[Link]) -> tuple[list[Link], Model]:
    """The links with all numbers that are told now: the less is left, the more is told."""
    for _ in range(_LOOKS):
        look = _Look(here, model, now.model.free)
        again = look.told([link.at for link in links])
        if {k for x in again for k in x.entries} <= {k for x in links for k in x.entries}:
            break
        new = _with(here, now, model, again, look.spare(again))
        if not new.fit.squares < model.fit.squares:
            break
        links, model = again, new
    return links, model


def _with(here: Setting, now: Standing, begin: Model, links: Sequence[Link], spare: Collection[int]) -> Model:
    """The model with the numbers of some links fitted, from where a fit has ended; numbers that are `spare` stay."""
    kept, theta = [k for k in now.model.free if k not in spare], begin.fit.theta.copy()
    free = free_entries(kept, [k for link in links for k in link.entries])
    away = [k for k, e in enumerate(here.known.table) if e.name in TEN and k not in free]
    theta[away] = 0.0
    new = _fitted(here, begin.structure, theta, free, begin.fit.start)
    excess = float(excess_of(here, begin.structure, new).max()) if np.isfinite(new.cost) else np.inf
    return Model(begin.structure, new, tuple(free), excess)


def _stands_as_bodies(here: Setting, now: Standing, model: Model, links: Sequence[Link]) -> Standing | None:
    """The model with links that bodies can have, and what it predicts of rows that it has not seen."""
    near = as_bodies(here, model, links, now.squares.sum())
    return None if near is None else standing(here, near.structure, near.fit, near.free)


def borne_out(
    here: Setting, now: Standing, new: Standing, least: float = GAIN_BESIDE_REST
) -> tuple[float, float, bool]:
    """Gain and t on rows that were not fitted, of all joints, and whether they are enough: `least` beside a rest."""
    before, after = now.held.sum(-1), new.held.sum(-1)
    gain = min(1 - after.sum() / max(before.sum(), 1e-300), 1 - new.squares.sum() / max(now.squares.sum(), 1e-300))
    rest, each = new.excess.max() >= 1.0, by_recording(here)
    runs = np.array([x.run for x in here.stretches])
    t = t_of_recordings(before, after, runs) if each and rest else t_of(before, after)
    if not rest:  # all that is seen is explained, be it in a few places only
        t = max(t, float(np.sqrt(max(before.sum() - after.sum(), 0.0))) / 2)
    enough = gain > least and t > T_BESIDE_REST and each if rest else gain > GAIN and t > T_WITHOUT_REST
    return float(gain), float(t), bool(enough)


def _fitted(
    here: Setting, structure: Structure, theta: np.ndarray, free: Sequence[int], start: np.ndarray | None = None
) -> Fit:
    """The fit from the states `start`; of a robot that no drive brings back also by the first rows of each window
    before all of them, and the better one: a link that is far off leads it far from what was measured."""

    def fitted(data: Windows, theta: np.ndarray, start: np.ndarray | None, most: int) -> Fit:
        return fit(*structure._replace(data=data), theta[None], [free], None if start is None else start[None],
                   width=max(here.width, len(free)), lanes=1, iterations=most)[0]  # fmt: skip

    plain = fitted(structure.data, theta, start, _MOST)
    if brought_back(structure.loop).all():
        return plain
    early = fitted(_early(structure.data), theta, None, _MOST // 2)
    if not np.isfinite(early.cost):
        return plain
    other = fitted(structure.data, early.theta, early.start, _MOST)
    return plain if plain.cost <= other.cost or not np.isfinite(other.cost) else other


def _early(data: Windows) -> Windows:
    """The windows with the first of their rows alone."""
    weight, share = np.array(data.weight), np.array(data.share)
    late = round(_EARLY * (weight > 0).any((1, 2)).sum())
    weight[late:], share[late:] = 0.0, 0.0
    return eqx.tree_at(lambda d: (d.weight, d.share), data, (weight, share))


def as_bodies(here: Setting, model: Model, links: Sequence[Link], gained_from: float) -> Model | None:
    """The model with links that bodies can have, or None where these predict clearly less than what was fitted."""
    near = nearest_bodies(here, model, links)
    least = model.fit.squares + BODY * (gained_from - model.fit.squares)
    return near if near is not None and near.fit.squares <= least else None


def nearest_bodies(here: Setting, model: Model, links: Sequence[Link]) -> Model | None:
    """The model with the nearest links that bodies can have, all else fitted again; None where none is found.

    Nearest by what the recordings tell. What they do not tell of a link is free to follow: a mass that stands as the
    file has it may be too small for an inertia that was found. Told numbers may hold what belongs to others that are
    told with them alone: where they leave more, the nearest in all ten is looked for as well, and the better one taken.
    """
    structure, last, loop = model.structure, model.fit, model.structure.loop
    if not np.isfinite(last.cost):
        return None
    names, ten = loop.robot.link_names, np.asarray(put(loop, structure.table, last.theta).robot.inertia)
    places = [link.at for link in links]
    if not inconsistencies(ten[places], [names[i] for i in places]):
        return model
    near = _nearest_in_told(here, model, links, ten)
    if near is not None and near.fit.squares < _AS_GOOD * last.squares:
        return near
    both = [x for x in (near, _nearest_in_all(here, model, links)) if x is not None]
    return min(both, key=lambda x: x.fit.squares, default=None)


def _nearest_in_all(here: Setting, model: Model, links: Sequence[Link]) -> Model | None:
    """The nearest links by all ten numbers of each, what is not told near the file's."""
    loop, table, _ = model.structure
    places, theta, start = [link.at for link in links], model.fit.theta.copy(), model.fit.start
    entries = [k for i in places for k in _entries(here, i)]
    others = [k for k in model.free if k not in entries]
    every = bodies(loop.robot)
    mine = [replace(every[i], columns=tuple(range(10 * k, 10 * k + 10))) for k, i in enumerate(places)]
    scale, filed = sizes(loop.robot)[places].ravel(), np.asarray(loop.robot.inertia)[places].ravel()
    columns, best = [*others, *entries], None
    for _ in range(_NEARER):
        one = fit(*model.structure, theta[None], [columns], start[None], width=len(columns), lanes=1, iterations=0)[0]
        if not np.isfinite(one.cost):
            break
        matrix, right = System(one.sums, model.structure.data, one.start).reduced(1e-6)
        own = list(range(len(others), len(columns)))
        information, score = beside(matrix, right, own, list(range(len(others))))
        values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
        seen = values > 1e-12 * values[-1]
        root = np.sqrt(values[seen])
        rows = np.concatenate([root[:, None] * vectors.T[seen], np.sqrt(_level(model)) * np.eye(len(scale))]) / scale
        away = np.concatenate([vectors.T[seen] @ (scale * score) / root, np.zeros(len(scale))])
        now = np.asarray(put(loop, table, theta).robot.inertia)[places].ravel()
        begun = np.concatenate([rows[: len(root)] @ now, rows[len(root) :] @ filed])
        try:
            ten = physical_fit(np.column_stack([rows, begun + away]), mine).ravel()
        except (InputError, NotConverged):
            break
        theta[entries] += ten - now
        one = _fitted(here, model.structure, theta, others, start)
        if best is not None and not one.squares < best.squares:
            break
        best, theta, start = one, one.theta.copy(), one.start
    if best is None:
        return None
    last = fit(*model.structure, best.theta[None], [model.free], best.start[None],
               width=max(here.width, len(model.free)), lanes=1, iterations=0)[0]  # fmt: skip
    return model._replace(fit=last) if np.isfinite(last.cost) else None


def _nearest_in_told(here: Setting, model: Model, links: Sequence[Link], ten: np.ndarray) -> Model | None:
    """The nearest links by the numbers that are told, all others free to follow."""
    structure, last, loop = model.structure, model.fit, model.structure.loop
    places = [link.at for link in links]
    columns, entries = [int(k) for k in last.free if k >= 0], [k for link in links for k in link.entries]
    own, others = ([columns.index(k) for k in ks] for ks in (entries, [k for k in columns if k not in entries]))
    information, _ = beside(*System(last.sums, structure.data, last.start).reduced(1e-6), own, others)
    at = [10 * places.index(structure.table[k].at[0]) + TEN.index(structure.table[k].name) for k in entries]
    away = _moved_to_bodies(loop, places, ten[places], at, information, _level(model))
    if away is None:
        return None
    theta = last.theta.copy()
    for i, more in zip(places, away, strict=True):
        theta[_entries(here, i)] += more
    one = _fitted(here, structure, theta, [k for k in model.free if k not in entries], last.start)
    again = fit(*structure, one.theta[None], [model.free], one.start[None], width=max(here.width, len(model.free)),
                lanes=1, iterations=0)[0]  # fmt: skip
    return model._replace(fit=again) if np.isfinite(again.cost) else None


def _moved_to_bodies(
    loop: Loop, places: Sequence[int], ten: np.ndarray, told: Sequence[int], information: np.ndarray, level: float
) -> np.ndarray | None:
    """What makes bodies of links (links, 10): the numbers that are `told` stay if they can, else move by least."""
    found = bodies_with(loop.robot, places, ten, told)
    if found is not None:
        return found - ten
    scale, every = sizes(loop.robot)[list(places)].ravel(), bodies(loop.robot)
    mine = [replace(every[i], columns=tuple(range(10 * k, 10 * k + 10))) for k, i in enumerate(places)]
    own = np.diag(np.sqrt(level) / scale)
    values, vectors = np.linalg.eigh(information)
    seen = np.zeros((len(told), len(own)))
    seen[:, list(told)] = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    own[list(told)] = 0.0
    try:
        return project(ten, mine, np.concatenate([own, seen])) - ten
    except NotConverged:
        return None


def _level(model: Model) -> float:
    """Squares of a row that counts, at least those of noise."""
    return max(model.fit.squares / max((np.asarray(model.structure.data.weight) > 0).sum(), 1), 1.0)


def _freed(sound: Setting, whole: Setting, found: _Rigid, links: Sequence[Link], now: Standing) -> Setting:
    """The setting whose file has the links that were found, and whose baseline fits their numbers further."""
    of = [k for k, e in enumerate(whole.known.table) if e.name in TEN]
    filed = put(sound.loop, tuple(whole.known.table[k] for k in of), now.model.fit.theta[of])
    loop = eqx.tree_at(lambda m: m.robot.inertia, sound.loop, np.asarray(filed.robot.inertia))
    entries, spare = [k for link in links for k in link.entries], set(found.last.free.tolist()) - set(now.model.free)
    kept = [k for k in sound.baseline if k not in spare]
    return replace(whole, loop=loop, baseline=(*kept, *entries), width=sound.width + len(entries))


def _better(
    filed: Loop, whole: Setting, found: Search, some: Setting, other: Search, links: Sequence[Link], fewer: bool = False
) -> Search:
    """The search with links of their own inertia where rows that were not fitted bear it out, else that before.

    `fewer`: where it leaves noise alone; it has fewer causes.
    """
    sound = other.setting or some
    if other.verdict == "unknown":
        baseline_alone(sound, other)
    free = tuple(int(k) for k in other.last.free if k >= 0)
    old = (found.origin, found.first) if fewer and found.origin is not None else (found.structure, found.last)
    last = as_bodies(sound, Model(other.structure, other.last, free, 0.0), links, old[1].squares)
    if last is None:
        return found
    other.last = last.fit
    part = thinned(sound)
    before, after = _stands(part, *old), _stands(part, other.structure, other.last)
    gain, t, enough = borne_out(part, before, after, MOST_OF_A_REST)
    if not enough or (fewer and after.excess.max() >= 1.0):
        return found
    left = excess(whitened(other.structure, other.last), np.asarray(other.structure.data.share))
    if after.excess.max() < 1.0 <= left:
        return found  # noise in the rows that are searched, and not in all
    structure, last = _as_filed(whole, some, other)
    numbers = {number: name for name, number in ROLLOUTS[EFFECT].in_rollouts.numbers}
    sizes, named = [rms_of(part, x.held) for x in (before, after)], list[Named]()
    for link in links:
        at = (whole.loop.robot.link_names[link.at],)
        reported = tuple(numbers[whole.known.table[k].name] for k in link.entries)
        one = Candidate(EFFECT, at, link.entries, (), reported)
        by, share = most_unsteady(sound, structure, last, one)
        if after.excess.max() >= 1.0 and share > STEADY_OF_A_LINK:
            why = f"its size differs by {by} ({share:.2g} of what it explains), as that of what stands in for another"
            return replace(found, doubtful=[*found.doubtful, (Name(EFFECT, at), gain, why)])
        if after.excess.max() >= 1.0 and not _has_a_number(structure, last, other.spread, link):
            why = "none of its numbers is surely there: together they may follow what else is missing"
            return replace(found, doubtful=[*found.doubtful, (Name(EFFECT, at), gain, why)])
        named.append(Named(one, t, gain, (), *sizes))
    label = ", ".join(str(Name(n.candidate.effect, n.candidate.at)) for n in named)
    first = found.first.theta
    return replace(
        other,
        verdict="named+rest" if after.excess.max() >= 1.0 else "named",
        named=[*named, *other.named],
        structure=structure,
        last=last,
        creeps=found.creeps,
        first=found.first._replace(theta=np.concatenate([first, np.zeros(len(structure.table) - len(first))])),
        origin=found.origin,
        p_value=found.p_value,
        table=[*found.table[:1], (label, other.table[0][1]), *other.table[1:]],
        held=[found.held[0], *other.held],
        setting=replace(sound, loop=filed),
    )


def _has_a_number(structure: Structure, last: Fit, spread: np.ndarray | None, link: Link) -> bool:
    """Whether one of the link's numbers alone is told from zero, by what is left and by how recordings differ."""
    errors = told_errors(structure, last, spread)
    at = [int(np.flatnonzero(last.free == entry)[0]) for entry in link.entries if entry in last.free]
    return bool((np.abs(last.theta[last.free[at]]) > CLEAR_OF_NOTHING * errors[at]).any())


def _stands(here: Setting, structure: Structure, last: Fit) -> Standing:
    """A fit on the rows of `here`, and what it predicts of those that it has not seen."""
    structure = structure._replace(data=here.cut(structure.loop))
    free = [int(k) for k in last.free if k >= 0]
    start = last.start if last.start.shape[1] == np.asarray(structure.data.start).shape[1] else None
    return standing(here, structure, _fitted(here, structure, last.theta, free, start), free)


def _as_filed(whole: Setting, some: Setting, other: Search) -> tuple[Structure, Fit]:
    """The model with the numbers of the links as what is added to the file's, not to what was found in between."""
    more = np.asarray(some.loop.robot.inertia) - np.asarray(whole.loop.robot.inertia)
    theta, table = other.last.theta.copy(), other.structure.table
    for k, entry in enumerate(table):
        if entry.name in TEN:
            theta[k] += more[entry.at[0], TEN.index(entry.name)]
    loop = eqx.tree_at(lambda m: m.robot.inertia, other.structure.loop, np.asarray(whole.loop.robot.inertia))
    return other.structure._replace(loop=loop), other.last._replace(theta=theta)


def body_notes(here: Setting, found: Search) -> dict[Name, str]:
    """By link that is named what its numbers look like, and what else of it was moved."""
    notes = dict[Name, str]()
    for one in [n.candidate for n in found.named if n.candidate.effect == EFFECT]:
        i = here.loop.robot.link_names.index(one.at[0])
        told = [_about_joint(here.loop, found, one, i)]
        if any(found.last.theta[k] for k in _entries(here, i) if k not in one.entries):
            told.append(
                "numbers that the recordings do not tell were moved as little as it takes for a body to have the rest"
            )
        text = "; ".join(x for x in told if x)
        if text:
            notes[Name(one.effect, one.at)] = text
    return notes


def _about_joint(loop: Loop, found: Search, one: Candidate, i: int) -> str:
    """What is said where the file seems to state a link's inertia about its joint; else nothing."""
    change, told = np.zeros(10), list[int]()
    for k in one.entries:
        told.append(TEN.index(found.structure.table[k].name))
        change[told[-1]] = found.last.theta[k]
    about = inertia_about_joint(np.asarray(loop.robot.inertia)[i], change, told)
    return ABOUT_JOINT if about else ""


def fitted_links(here: Setting) -> list[Link]:
    """The links that the baseline fits, with the numbers that it frees."""
    free = [k for k in here.baseline if here.known.table[k].name in TEN]
    places = sorted({here.known.table[k].at[0] for k in free})
    return [Link(i, tuple(k for k in free if here.known.table[k].at == (i,)), 0.0) for i in places]


def told_alone(here: Setting, first: Fit) -> tuple[Setting, Fit]:
    """The baseline's fit with those numbers of its links that the recordings tell; without links as it is."""
    links = [link.at for link in fitted_links(here)]
    if not links:
        return here, first
    structure = Structure(here.loop, here.known.table, here.data)
    bare = [k for k in here.baseline if here.known.table[k].name not in TEN]
    begun = _fitted(here, structure, values(*structure[:2]), bare, first.start)
    model, entries = Model(structure, begun, tuple(bare), 0.0), set[int]()
    for _ in range(_LOOKS):  # the less is left, the more is told
        if not np.isfinite(model.fit.cost):
            return here, first
        told = {k for link in _Look(here, model, bare).told(links) for k in link.entries}
        if told == entries:
            break
        entries, free, theta = told, free_entries(bare, sorted(told)), model.fit.theta.copy()
        theta[[k for i in links for k in _entries(here, i) if k not in told]] = 0.0
        model = Model(structure, _fitted(here, structure, theta, free, model.fit.start), tuple(free), 0.0)
    return replace(here, baseline=model.free), model.fit


def consistent(here: Setting, first: Fit) -> tuple[Fit, tuple[str, ...]]:
    """The baseline's fit with its links as bodies can have them, and what is said where the recordings would not."""
    links = fitted_links(here)
    structure = Structure(here.loop, here.known.table, here.data)
    near = nearest_bodies(here, Model(structure, first, here.baseline, 0.0), links) if links else None
    if near is None:
        return first, ()
    worse = (near.fit.squares - first.squares) / first.squares
    if worse < BODY:
        return near.fit, ()
    names = ", ".join(here.loop.robot.link_names[link.at] for link in links)
    return near.fit, (
        f"the recordings would have {names} with inertias that no body has; the nearest that one can have leave"
        f" {1 + worse:.3g} times the squares: something else is missing",
    )
