"""Whether a cause of an arm is worth its name: on rows that were not fitted, and beside all others that are named."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .fit import Fit, System, fit, refitted_without
from .found import Model, Named, Tried, all_but
from .loop import alike
from .parameters import values
from .screening import LATE, ROUGH, Standing, excess_of, joint_of, outputs
from .setting import Setting, Structure, by_recording, counted
from .sizes import sized
from .thresholds import (
    CONFIDENT,
    COST_OF_A_MISSED,
    FITTED_FOR_HELD,
    GAIN,
    GAIN_BESIDE_REST,
    MOST_OF_IT,
    NO_WORSE,
    SLIGHT,
    SMALL,
    SURE_OF_NOISE,
    T_BESIDE_REST,
    T_WITHOUT_REST,
    UNTOLD,
    USUAL,
    t_of,
    t_of_places,
    t_of_recordings,
)

__all__ = [
    "Slight",
    "checked",
    "gained",
    "needless",
    "in_order",
    "replaced",
    "rms_of",
    "standing",
    "still_needed",
    "worthy",
]


def standing(here: Setting, structure: Structure, one: Fit, free: Sequence[int], *, held: bool = True) -> Standing:
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


def gained(now: Standing, one: Tried) -> float:
    """Squares of the whole arm by which a fitted candidate is better."""
    return float(now.squares.sum() - one.sse.sum())


def replaced(old: Named, new: Named | Tried) -> bool:
    """Whether a new cause contains one at the same place that is a structure of its own: a spring that has play."""
    kind = new.candidate.kind
    return kind.elastic and kind.holds(old.candidate.effect) and old.candidate.at == new.candidate.at


def worthy(here: Setting, now: Standing, one: Tried) -> bool:
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


def in_order(now: Standing, ones: Sequence[Tried]) -> list[Tried]:
    """Candidates of a joint in the order in which they may be named: what every joint has before what few have."""
    ranked = sorted(ones, key=lambda one: -gained(now, one))
    first, best = ranked[0], gained(now, ranked[0])
    if best <= 0:
        return []
    rest = first.state.excess >= 1.0
    usual = [x for x in ranked if rest and x.candidate.kind.usual and gained(now, x) > USUAL * best]
    more = first.candidate.kind.adds_to
    usual += [x for x in ranked if rest and x.candidate.effect == more and all(x is not y for y in usual)]
    simple = [
        x for x in ranked
        if first.candidate.kind.holds(x.candidate.effect)
        and (t_of(x.sse.sum(-1), first.sse.sum(-1)) < UNTOLD or x.sse.sum() <= NO_WORSE * first.sse.sum())
    ]  # fmt: skip
    front = usual[:1] or simple[:1]
    return front + [x for x in ranked if all(x is not other for other in front)]


def checked(here: Setting, now: Standing, new: Standing, one: Tried) -> tuple[bool, float, float]:
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
    fitted = (now.squares - new.squares)[..., mine].sum()
    enough = float(now.excess[mine].max()) >= 1.0 or fitted > SURE_OF_NOISE
    good = gain > worth and t > needed and enough and sized(here, one._replace(state=state))
    return bool(good), float(gain), t


def needless(here: Setting, new: Standing, chosen: Sequence[Tried], begin: Standing | None = None) -> Tried | None:
    """The cause, if any, that its joint does not need beside the others: the least one first.

    With the model at the `begin` also one that is worth next to nothing of what the others have explained there since:
    where their laws are off by as little, it makes up for that.
    """
    for one in sorted(chosen, key=lambda one: gained(new, one), reverse=True):
        if one.candidate.kind.elastic:
            continue
        j, entries = joint_of(here, one.candidate), list(one.candidate.entries)
        mine = slice(None) if j < 0 else slice(j, j + 1)
        if _costs(new, entries) > COST_OF_A_MISSED * new.squares[..., mine].sum():
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


class Slight(NamedTuple):
    """A cause that explains what others leave, and may be no more than the error of their laws; the fit with it."""

    cause: Named
    fit: Fit


def still_needed(
    here: Setting, found: list[Named], now: Standing, begin: Standing
) -> tuple[list[Named], Standing, Slight | None]:
    """The causes without those that a later one made needless, where noise is all that is left.

    One without which more than noise is left, but too little to tell it from the error of another's law, is told apart.
    """
    while len(found) > 1 and now.excess.max() < 1.0:
        own = [Tried(n.candidate, now.model, now.squares) for n in found]
        spare = needless(here, now, own, begin)
        if spare is None:
            break
        new = standing(here, now.model.structure, *_without(here, now, spare.candidate.entries))
        rest = all_but(found, spare.candidate)
        if not new.excess.max() < 1.0:
            j = joint_of(here, spare.candidate)
            mine = slice(None) if j < 0 else slice(j, j + 1)
            if not _is_slight(begin.squares[..., mine], new.squares[..., mine], now.squares[..., mine]):
                break  # needed, be it in a few places only
            (gone,) = (n for n in found if n.candidate is spare.candidate)
            return rest, new, Slight(gone, now.model.fit)
        found, now = rest, new
    return found, now, None


def _costs(new: Standing, entries: list[int]) -> float:
    """Squares by which the fit would be worse without numbers, to second order."""
    structure, last = new.model.structure, new.model.fit
    covariance = System(last.sums, structure.data, last.start).covariance(last.free < 0)
    at = [int(np.flatnonzero(last.free == k)[0]) for k in entries]
    stated, block = values(structure.loop, structure.table)[entries], covariance[np.ix_(at, at)]
    if not (np.isfinite(block).all() and np.isfinite(stated).all()):  # a limit at infinity: the fit tells
        return 0.0
    away = last.theta[entries] - stated
    return float(away @ np.linalg.pinv(block) @ away)


def rms_of(here: Setting, squares: np.ndarray, joint: int = -1) -> float:
    """Whitened squares (blocks, windows, joints) as an RMS over the rows of a joint, or of all: rad, or m.

    Of a robot with joints of both kinds all are those that turn: no number holds rad and m.
    """
    each = np.maximum(squares.reshape(-1, squares.shape[-1]).sum(axis=0), 0.0) * here.spread**2
    mine = alike(here.loop) if joint < 0 else np.arange(len(each)) == joint
    count = counted(here.data) / here.loop.robot.nv * mine.sum()
    return float(np.sqrt(each[mine].sum() / max(count, 1)))
