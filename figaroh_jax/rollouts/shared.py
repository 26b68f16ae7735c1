"""Causes that the joints of an arm share: asked of all of them at once where none shows enough of it by itself.

Joints driven by one kind of servo have the same kinds of friction and rotor. Beside a rest that no model explains, a
cause at one joint must be large, for a smaller one may make up for what is missing. One that surely lowers what each of
three encoders or more shows need not be, where nearly all recordings that were not fitted bear all of them out; joints
that show less of it have it too then.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .causes import Candidate
from .fit import Fit, fit
from .gates import rms_of, standing
from .screening import LATE, ROUGH, Standing, joint_of
from .search import Named, Tried, sized, t_of_recordings
from .setting import Setting, by_recording, free_entries, start_values
from .thresholds import CONFIDENT, FEWEST_JOINTS, GAIN, HOPEFUL, T_BESIDE_REST

__all__ = ["at_all_joints"]

_PART = 1 / 3  # of what it adds to, from which its fit starts
_EARLY, _SOON = 4, 0.5  # steps from each start, and the share of what is to be gained that is seen by then


def at_all_joints(here: Setting, now: Standing, found: Sequence[Named]) -> tuple[list[Named], Standing]:
    """One cause of every joint that more than noise is left of, where all together bear it out; the model with it."""
    model = now.model
    if not by_recording(here) or model.structure.loop.robot.nv != here.loop.robot.nv:
        return [], now
    for ones in _families(here, now, found):
        fits = [_early(here, now, ones, theta) for theta in _starts(here, now, ones)]
        best = min(fits, key=lambda one: one.cost)
        own = now.squares[..., [joint_of(here, c) for c in ones]].sum()
        if now.model.fit.cost - best.cost > _SOON * HOPEFUL * own:
            named, new = _borne_out(here, now, ones, best)
            if named:
                return named, new
    return [], now


def _families(here: Setting, now: Standing, found: Sequence[Named]) -> list[list[Candidate]]:
    """Candidates of one name, of what every joint has and of what is more of it, at the joints with a rest."""
    used = {(n.candidate.effect, n.candidate.at) for n in found}
    families: dict[str, list[Candidate]] = {}
    for c in here.known.candidates:
        open_still = (c.effect, c.at) not in used and not set(c.entries) <= set(now.model.free)
        shared = (c.kind.usual or c.kind.adds_to) and not c.kind.several
        if shared and open_still and now.excess[joint_of(here, c)] >= 1.0:
            families.setdefault(c.effect, []).append(c)
    return [ones for ones in families.values() if len(ones) >= FEWEST_JOINTS]


def _starts(here: Setting, now: Standing, ones: Sequence[Candidate]) -> list[np.ndarray]:
    """Where the fit of a family starts; what is more of another cause takes a third of it, and more rows tell both."""
    found = []
    for variant in range(max(len(c.starts) for c in ones)):
        theta = now.model.fit.theta.copy()
        for c in ones:
            theta = start_values(theta, c, c.starts[variant % len(c.starts)])
            less = next((x for x in here.known.candidates if (x.effect, x.at) == (c.kind.adds_to, c.at)), None)
            if less is not None:
                theta[c.entries[0]] = _PART * theta[less.entries[0]]
                theta[less.entries[0]] *= 1 - _PART / 2
        found.append(theta)
    return found


def _early(here: Setting, now: Standing, ones: Sequence[Candidate], theta: np.ndarray) -> Fit:
    """A few steps of a family from one start."""
    return _fit(here, now, ones, theta, now.model.fit.start, _EARLY)[0]


def _fit(
    here: Setting, now: Standing, ones: Sequence[Candidate], theta: np.ndarray, start: np.ndarray, most: int
) -> tuple[Fit, list[int]]:
    free = free_entries(now.model.free, [k for c in ones for k in c.entries])
    return fit(*now.model.structure, theta[None], [free], start[None], width=max(here.width, len(free)), lanes=1,
               iterations=most, rough=ROUGH)[0], free  # fmt: skip


def _borne_out(here: Setting, now: Standing, ones: Sequence[Candidate], begin: Fit) -> tuple[list[Named], Standing]:
    """The members of a family that held-out recordings bear out, each and together."""
    runs, before = np.array([x.run for x in here.stretches]), now.held
    for _ in range(2):
        theta = begin.theta.copy()
        for k in [k for k in begin.free if k >= 0 and k not in now.model.free]:
            if all(k not in c.entries for c in ones):
                theta[k] = now.model.fit.theta[k]
        one, free = _fit(here, now, ones, theta, begin.start, LATE)
        new = standing(here, now.model.structure, one, free)
        gains, ts = {}, {}
        for c in ones:
            j = joint_of(here, c)
            gains[c] = min(1 - x[..., j].sum() / max(y[..., j].sum(), 1e-300)
                           for x, y in ((new.held, before), (new.squares, now.squares)))  # fmt: skip
            ts[c] = t_of_recordings(before[..., j], new.held[..., j], runs)
        good = [c for c in ones if gains[c] > GAIN and ts[c] > 0 and sized(here, Tried(c, new.model, new.squares))]
        if sum(ts[c] > CONFIDENT for c in good) < FEWEST_JOINTS:
            return [], now
        if len(good) == len(ones):
            break
        ones = good
    else:
        return [], now
    together = _t_together(before, new.held, runs, [joint_of(here, c) for c in ones])
    if together < T_BESIDE_REST or np.mean(list(gains.values())) < HOPEFUL:
        return [], now
    rms = [[rms_of(here, x, joint_of(here, c)) for x in (before, new.held)] for c in ones]
    named = [Named(c, ts[c], gains[c], (), *x) for c, x in zip(ones, rms, strict=True)]
    return sorted(named, key=lambda n: n.after**2 - n.before**2), new


def _t_together(worse: np.ndarray, better: np.ndarray, runs: np.ndarray, joints: Sequence[int]) -> float:
    """t over recordings of the mean logarithm of the joints' gains: each joint and recording counts alike."""
    logs = []
    for j in joints:
        sums = np.stack([np.bincount(runs, x[..., j].sum(0)) for x in (worse, better)])
        floor = 0.1 * sums[1].mean()
        logs.append(np.log((sums[0] + floor) / (sums[1] + floor)))
    mean = np.mean(logs, axis=0)[np.bincount(runs) > 0]
    return float(mean.mean() / (mean.std(ddof=1) / np.sqrt(len(mean)) + 1e-300)) if len(mean) > 2 else 0.0
