"""Causes that the joints of an arm share: asked of all of them at once where none shows enough of it by itself.

Joints driven by one kind of servo have the same kinds of friction and rotor. Beside a rest that no model explains, a
cause at one joint must be large, for a smaller one may make up for what is missing. One that surely lowers what each of
three encoders or more shows need not be, where nearly all recordings that were not fitted bear all of them out; joints
that show less of it have it too then.

Each joint first has numbers of its own. Where these are not borne out, joints whose drives the file has alike have one
number together: a servo's own parts are the same wherever it stands, and one number is told by all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .causes import Candidate
from .fit import Fit, fit
from .found import Named, Tried
from .gates import rms_of, standing
from .loop import turns
from .parameters import of_one_number, values
from .screening import LATE, ROUGH, Standing, joint_of
from .setting import Setting, Structure, by_recording, free_entries, start_values
from .sizes import sized
from .thresholds import CONFIDENT, FEWEST_JOINTS, GAIN, HOPEFUL, T_BESIDE_REST, t_of_recordings

__all__ = ["as_one_number", "at_all_joints", "of_one_kind", "t_together"]

_PART = 1 / 3  # of what it adds to, from which its fit starts
_EARLY, _SOON = 4, 0.5  # steps from each start, and the share of what is to be gained that is seen by then


def at_all_joints(here: Setting, now: Standing, found: Sequence[Named]) -> tuple[list[Named], Standing]:
    """One cause of every joint that more than noise is left of, where all together bear it out; the model with it."""
    model = now.model
    if not by_recording(here) or model.structure.loop.robot.nv != here.loop.robot.nv:
        return [], now
    families = _families(here, now, found)
    for ones in families:
        named, new = _borne_out(here, now, ones)
        if named:
            return named, new
    for ones in (kind for family in families for kind in of_one_kind(here, family)):
        named, new = as_one_number(here, now, ones)
        if named:
            return named, new
    return [], now


def _families(here: Setting, now: Standing, found: Sequence[Named]) -> list[list[Candidate]]:
    """Candidates of one name, of what every joint has and of what is more of it, at the joints with a rest."""
    used = {(n.candidate.effect, n.candidate.at) for n in found}
    families: dict[str, list[Candidate]] = {}
    for c in here.known.candidates:
        open_still = (c.effect, c.at) not in used and not set(c.entries) <= set(now.model.free)
        less = _less(here, c)
        beside = c.kind.adds_to and (less is None or set(less.entries) <= set(now.model.free))
        shared = (c.kind.usual or beside) and not c.kind.several
        if shared and open_still and now.excess[joint_of(here, c)] >= 1.0:
            families.setdefault(c.effect, []).append(c)
    return [ones for ones in families.values() if len(ones) >= FEWEST_JOINTS]


def _less(here: Setting, c: Candidate) -> Candidate | None:
    """What a cause is more of, at its place, where the baseline does not have it: it is found beside that alone."""
    return next((x for x in here.known.candidates if (x.effect, x.at) == (c.kind.adds_to, c.at)), None)


def of_one_kind(here: Setting, ones: Sequence[Candidate]) -> list[list[Candidate]]:
    """Those of a family at joints that the file has alike: the same drive, which moves that joint alone, and the same
    numbers of it; joints that turn apart from those that slide, whose units are others."""
    drives, kinds = here.loop.drives, dict[tuple, list[Candidate]]()
    turning = turns(here.loop)
    gear = np.abs(np.asarray(drives.transmission))
    stated = values(here.loop, here.known.table)
    for c in ones:
        mine = np.flatnonzero(gear[:, joint_of(here, c)])
        if len(mine) != 1 or np.count_nonzero(gear[mine[0]]) != 1:
            continue
        own = (
            turning[joint_of(here, c)],
            gear[mine[0]].max(),
            *(np.asarray(x)[mine[0]] for x in (drives.gain, drives.bias, drives.force_range)),
        )
        told = np.concatenate([np.ravel(x) for x in (*own, stated[list(c.entries)])])
        kinds.setdefault(tuple(float(f"{x:.6g}") for x in told), []).append(c)
    return [alike for alike in kinds.values() if len(alike) >= FEWEST_JOINTS]


def _starts(here: Setting, now: Standing, ones: Sequence[Candidate]) -> list[np.ndarray]:
    """Where the fit of a family starts; what is more of another cause takes a third of it, and more rows tell both."""
    found = []
    for variant in range(max(len(c.starts) for c in ones)):
        theta = now.model.fit.theta.copy()
        for c in ones:
            theta = start_values(theta, c, c.starts[variant % len(c.starts)])
            if (less := _less(here, c)) is not None:
                theta[c.entries[0]] = _PART * theta[less.entries[0]]
                theta[less.entries[0]] *= 1 - _PART / 2
        found.append(theta)
    return found


def _best_early(
    here: Setting, now: Standing, structure: Structure, ones: Sequence[Candidate], starts: Sequence[np.ndarray]
) -> Fit | None:
    """The best of a family after a few steps from each start, where it may gain enough."""
    fits = [_fit(here, now, structure, ones, theta, now.model.fit.start, _EARLY)[0] for theta in starts]
    best = min(fits, key=lambda one: one.cost)
    own = now.squares[..., [joint_of(here, c) for c in ones]].sum()
    return best if now.model.fit.cost - best.cost > _SOON * HOPEFUL * own else None


def _fit(
    here: Setting,
    now: Standing,
    structure: Structure,
    ones: Sequence[Candidate],
    theta: np.ndarray,
    start: np.ndarray,
    most: int,
) -> tuple[Fit, list[int]]:
    free = free_entries(now.model.free, [k for c in ones for k in c.entries])
    return fit(*structure, theta[None], [free], start[None], width=max(here.width, len(free)), lanes=1,
               iterations=most, rough=ROUGH)[0], free  # fmt: skip


def _borne_out(here: Setting, now: Standing, ones: Sequence[Candidate]) -> tuple[list[Named], Standing]:
    """The members of a family that held-out recordings bear out, each with numbers of its own, and together."""
    structure = now.model.structure
    begin = _best_early(here, now, structure, ones, _starts(here, now, ones))
    for _ in range(2 if begin is not None else 0):
        assert begin is not None
        theta = begin.theta.copy()
        for k in [k for k in begin.free if k >= 0 and k not in now.model.free]:
            if all(k not in c.entries for c in ones):
                theta[k] = now.model.fit.theta[k]
        new, told = _judged(here, now, structure, ones, begin._replace(theta=theta))
        good = [c for c in ones if told[c].good]
        if len(good) == len(ones):
            return _together(here, now, new, told)
        if sum(told[c].t > CONFIDENT for c in good) < FEWEST_JOINTS:
            return [], now
        ones = good
    return [], now


def as_one_number(here: Setting, now: Standing, ones: Sequence[Candidate]) -> tuple[list[Named], Standing]:
    """The members of a family that held-out recordings bear out with one number together, the worst left out first."""
    ones = list(ones)
    while len(ones) >= FEWEST_JOINTS:
        table = of_one_number(now.model.structure.table, [c.entries for c in ones])
        structure, first = now.model.structure._replace(table=table), ones[0].entries
        starts = _starts(here, now, ones)
        for theta in starts:
            theta[list(first)] = np.mean([theta[list(c.entries)] for c in ones], axis=0)
        alike = [c._replace(entries=first) for c in ones]
        begin = _best_early(here, now, structure, alike, starts)
        if begin is None:
            return [], now
        new, told = _judged(here, now, structure, alike, begin)
        bad = [k for k, c in enumerate(alike) if not told[c].good]
        if not bad:
            return _together(here, now, new, told)
        del ones[min(bad, key=lambda k: told[alike[k]].gain)]
    return [], now


class _Told(NamedTuple):
    """What recordings that were not fitted say of one member of a family."""

    gain: float  # share of the squares of its joint, no more than on those that were fitted
    t: float
    good: bool


def _judged(
    here: Setting, now: Standing, structure: Structure, ones: Sequence[Candidate], begin: Fit
) -> tuple[Standing, dict[Candidate, _Told]]:
    """The model with a family, fitted to the end, and what it is worth at each joint."""
    new = standing(here, structure, *_fit(here, now, structure, ones, begin.theta, begin.start, LATE))
    runs, told = np.array([x.run for x in here.stretches]), dict[Candidate, _Told]()
    for c in ones:
        j = joint_of(here, c)
        gain = min(1 - x[..., j].sum() / max(y[..., j].sum(), 1e-300)
                   for x, y in ((new.held, now.held), (new.squares, now.squares)))  # fmt: skip
        t = t_of_recordings(now.held[..., j], new.held[..., j], runs)
        told[c] = _Told(gain, t, gain > GAIN and t > 0 and sized(here, Tried(c, new.model, new.squares)))
    return new, told


def _together(
    here: Setting, now: Standing, new: Standing, told: dict[Candidate, _Told]
) -> tuple[list[Named], Standing]:
    """The members of a family, where three or more are sure and all together are; the largest gain first."""
    runs, gains = np.array([x.run for x in here.stretches]), [one.gain for one in told.values()]
    if sum(one.t > CONFIDENT for one in told.values()) < FEWEST_JOINTS or np.mean(gains) < HOPEFUL:
        return [], now
    t = t_together(now.held, new.held, runs, [joint_of(here, c) for c in told])
    if t < T_BESIDE_REST:
        return [], now
    named = []
    for c, one in told.items():  # borne out by all of them: as sure as they are together
        before, after = (rms_of(here, x, joint_of(here, c)) for x in (now.held, new.held))
        named.append(Named(c, t, one.gain, (), before, after))
    return sorted(named, key=lambda n: n.after**2 - n.before**2), new


def t_together(worse: np.ndarray, better: np.ndarray, runs: np.ndarray, joints: Sequence[int]) -> float:
    """t over recordings of the mean logarithm of the joints' gains: each joint and recording counts alike."""
    logs = []
    for j in joints:
        sums = np.stack([np.bincount(runs, x[..., j].sum(0)) for x in (worse, better)])
        floor = 0.1 * sums[1].mean()
        logs.append(np.log((sums[0] + floor) / (sums[1] + floor)))
    mean = np.mean(logs, axis=0)[np.bincount(runs) > 0]
    return float(mean.mean() / (mean.std(ddof=1) / np.sqrt(len(mean)) + 1e-300)) if len(mean) > 2 else 0.0
