"""Which other cause would do as well in place of one that was found, where noise is all that is left.

A search fits most candidates a few steps, so that two which move a joint alike may seem far apart: an offset of an
encoder and a constant torque at a joint that gravity does not load. Here every candidate of a joint is asked, by one
linearisation, whether the cause would still be needed beside it; those beside which it is not are fitted in its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..results import Name
from .causes import Candidate
from .fit import Fit, System, fit
from .found import Named
from .parameters import values
from .screening import LATE, ROUGH, Standing, excess_of, joint_of, outputs
from .setting import Setting, free_entries, start_values
from .thresholds import NO_CHOICE, STILL_NEEDED, UNTOLD, t_of

__all__ = ["Instead", "instead", "names", "rivals"]


class Instead(NamedTuple):
    """A cause fitted in the place of another."""

    candidate: Candidate
    fit: Fit
    free: tuple[int, ...]
    worse: float  # squares of whitened rows by which it is worse


def instead(here: Setting, now: Standing, named: Named, found: Sequence[Named]) -> list[Instead]:
    """Causes at the same joint, or of several, that leave noise alone in place of a named one, the best first.

    In place of one of several joints also those of any joint.
    """
    tried = [*_beside(here, now, named, found), *_told(here, now, named)]
    good = sorted((x for x in tried if x.worse < NO_CHOICE), key=lambda x: x.worse)
    return [x for x in good if not any(x.candidate.kind.holds(other.candidate.effect) for other in good)]


def _told(here: Setting, now: Standing, named: Named) -> list[Instead]:
    """What was told to be alike while more was left, fitted from each of its starts: limits of drives among them."""
    structure, last, mine = now.model.structure, now.model.fit, named.candidate
    stated = values(structure.loop, structure.table)
    if mine.kind.elastic:
        return []
    found = []
    for c in here.known.candidates:
        if Name(c.effect, c.at) not in named.alike or set(c.entries) & set(now.model.free) - set(mine.entries):
            continue
        without = last.theta.copy()
        without[list(mine.entries)] = stated[list(mine.entries)]
        free = [k for k in now.model.free if k not in mine.entries or k in here.baseline]
        free = free_entries(free, c.entries)
        fits = [
            fit(*structure, start_values(without, c, start)[None], [free], last.start[None],
                width=max(here.width, len(free)), lanes=1, iterations=LATE)[0]
            for start in c.starts
        ]  # fmt: skip
        new = min(fits, key=lambda one: one.cost)
        if np.isfinite(new.cost) and excess_of(here, structure, new).max() < 1.0:
            found.append(Instead(c, new, tuple(free), new.squares - last.squares))
    return found


def _beside(here: Setting, now: Standing, named: Named, found: Sequence[Named]) -> list[Instead]:
    """Those beside which it is not needed, to first order, fitted in its place."""
    structure, last = now.model.structure, now.model.fit
    mine = named.candidate
    stated = values(structure.loop, structure.table)
    if mine.kind.elastic or not np.isfinite(stated[list(mine.entries)]).all():
        return []
    j, others = joint_of(here, mine), {(n.candidate.effect, n.candidate.at) for n in found}
    left = [
        c for c in here.known.candidates
        if (j < 0 or joint_of(here, c) in (j, -1)) and (c.effect, c.at) not in others
        and not c.kind.limit and not set(c.entries) & set(now.model.free) and not c.kind.holds(mine.effect)
    ]  # fmt: skip
    if not left:
        return []
    begun = last.theta.copy()
    for c in left:
        if c.kind.falls_off is not None:
            begun[c.entries[c.kind.falls_off]] = c.starts[len(c.starts) // 2][c.kind.falls_off]
    columns = free_entries(now.model.free, [entry for c in left for entry in c.entries])
    one = fit(*structure, begun[None], [columns], last.start[None], width=len(columns), lanes=1, iterations=0)[0]
    if not np.isfinite(one.cost):
        return []
    matrix, _ = System(one.sums, structure.data, one.start).reduced(1e-6)
    place = {int(entry): k for k, entry in enumerate(one.free)}
    answers = []
    for c in left:
        begin = _begin(matrix, place, now.model.free, mine, c, begun, stated)
        if begin is None:
            continue
        free = [k for k in free_entries(now.model.free, c.entries) if k not in mine.entries or k in here.baseline]
        new = fit(*structure, begin[None], [free], last.start[None], width=max(here.width, len(free)), lanes=1,
                  iterations=LATE)[0]  # fmt: skip
        if np.isfinite(new.cost) and excess_of(here, structure, new).max() < 1.0:
            answers.append(Instead(c, new, tuple(free), new.squares - last.squares))
    return answers


def _begin(
    matrix: np.ndarray, place: dict[int, int], free: Sequence[int], mine: Candidate, c: Candidate, theta: np.ndarray,
    stated: np.ndarray,
) -> np.ndarray | None:  # fmt: skip
    """Numbers with the cause taken away and the other in its place, to first order; None where both are needed."""
    own = [place[k] for k in mine.entries]
    rest = [place[k] for k in free_entries(free, c.entries) if k not in mine.entries]
    rest = [k for k in rest if matrix[k, k] > 0]
    if not all(place[k] in rest for k in c.entries):
        return None
    away = theta[list(mine.entries)] - stated[list(mine.entries)]
    size = np.sqrt(np.diag(matrix)[rest])
    inner = matrix[np.ix_(rest, rest)] / np.outer(size, size)
    beside = np.linalg.lstsq(inner, matrix[np.ix_(rest, own)] / size[:, None], rcond=1e-10)[0]
    left = matrix[np.ix_(own, own)] - (matrix[np.ix_(rest, own)] / size[:, None]).T @ beside
    if away @ left @ away > STILL_NEEDED:
        return None
    begin, entries = theta.copy(), {k: entry for entry, k in place.items()}
    begin[list(mine.entries)] = stated[list(mine.entries)]
    for k, change in zip(rest, (beside @ away) / size, strict=True):
        begin[entries[k]] += change
    return begin


def rivals(here: Setting, now: Standing, found: Sequence[Named]) -> list[tuple[Name, ...]]:
    """Of each named cause the effects that may stand for it (`Kind.rival_of`) and tell the rows no worse.

    Those of all joints are fitted at once, each in the place of its cause; each joint is judged by its own encoder.
    """
    structure, last = now.model.structure, now.model.fit
    stated, theta, free = values(structure.loop, structure.table), last.theta.copy(), list(now.model.free)
    pairs: dict[int, Candidate] = {}
    for k, one in enumerate(found):
        mine = one.candidate
        same = [c for c in here.known.candidates if c.at == mine.at and c.kind.rival_of == mine.effect]
        same = [c for c in same if not set(c.entries) & set(now.model.free)]
        if mine.kind.usual and same:
            pairs[k] = same[0]
            theta[list(mine.entries)] = stated[list(mine.entries)]
            theta[list(same[0].entries)] = same[0].kind.rival_start
            free = [x for x in free_entries(free, same[0].entries) if x not in mine.entries]
    if not pairs:
        return [() for _ in found]
    new = fit(*structure, theta[None], [free], last.start[None], width=max(here.width, len(free)), lanes=1,
              iterations=LATE, rough=ROUGH)[0]  # fmt: skip
    if not np.isfinite(new.cost):
        return [() for _ in found]
    other, told = outputs(here, new.sums.cost), []
    for k, one in enumerate(found):
        j = joint_of(here, one.candidate)
        good = k in pairs and t_of(other[..., j], now.squares[..., j]) < UNTOLD
        told.append((Name(pairs[k].effect, pairs[k].at),) if good else ())
    return told


def names(alternatives: Sequence[Instead]) -> tuple[Name, ...]:
    """As the answer tells them."""
    return tuple(dict.fromkeys(Name(x.candidate.effect, x.candidate.at) for x in alternatives))
