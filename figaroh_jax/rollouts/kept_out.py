"""Whether recordings that were kept out are of the same robot: one set of numbers leaves noise alone in all of them.

Noise alone may be left of the recordings that are fitted while those kept out show a tool that these did not carry,
another zero, warm joints or a drained battery. What is predicted of them is then off, but so it is, by less, where the
fitted recordings hardly show a number of the model. Therefore all that is free is fitted to all recordings together:
what no such numbers explain differs from recording to recording.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np

from ..results import Name
from .data import Run, Stretch, noise_of, told_by
from .fit import Fit, fit
from .found import Search
from .loop import Loop
from .parameters import put
from .screening import LATE, ROUGH, excess_of
from .setting import Setting, Structure, by_readings, excess, residuals

__all__ = ["largest_of", "odd_note", "odd_recordings", "with_kept_out"]

_FIRST = 4  # iterations of the states at the starts of the windows


def odd_recordings(
    here: Setting, found: Search, kept_out: Sequence[Run], simulated: Callable[[Loop, Run], np.ndarray]
) -> Search:
    """A search that left noise alone, as a rest where recordings that were kept out show more with any numbers.

    A cause stays named that lowers the error of each of them; another one is not the same in all recordings.
    `simulated` gives what the encoders of a loop read, (rows, joints): where noise alone is between that and the
    recordings, nothing is fitted.
    """
    if found.verdict not in ("nothing", "named") or not kept_out or not np.isfinite(found.last.cost):
        return found
    loop = put(found.structure.loop, found.structure.table, found.last.theta)
    if here.pole is None and all(_is_noise(here, run, simulated(loop, run)) for run in kept_out):
        return found
    every = with_kept_out(by_readings(here, found.last) or here, kept_out)
    structure = found.structure._replace(data=every.cut(found.structure.loop))
    free = [int(k) for k in found.last.free if k >= 0]
    started = _fitted(every, structure, found.last, [], _FIRST)
    if excess_of(every, structure, started).max() < 1.0:
        return found
    if excess_of(every, structure, _fitted(every, structure, started, free, LATE)).max() < 1.0:
        return found
    odd = [k for k in range(len(here.runs), len(every.runs)) if _is_odd(every, structure, started, k)]
    odd = odd or [*range(len(here.runs), len(every.runs))]
    found.odd = tuple(every.runs[k].name for k in odd)
    if not found.named:
        found.verdict = "unknown"
        return found
    plain = Structure(here.loop, here.known.table, every.data)
    before = _squares(every, plain, _fitted(every, plain, found.first, [], _FIRST))
    after = _squares(every, structure, started)
    names = every.loop.robot.dof_names
    for n in found.named:
        mine = [j for j, k in enumerate(here.loop.measured) if names[k] in n.candidate.at] or [*range(before.shape[1])]
        worse = [every.runs[k].name for k in odd if after[k, mine].sum() >= before[k, mine].sum()]
        if worse:
            why = f"it does not predict {', '.join(worse)} better, so that it is not the same in all recordings"
            found.doubtful = [(Name(n.candidate.effect, n.candidate.at), max(n.gain, 0.0), why), *found.doubtful]
    found.verdict = "named+rest"
    if found.doubtful:
        found.verdict, found.proxy, found.named = "unknown", found.named, []
    return found


def odd_note(found: Search) -> tuple[str, ...]:
    """What recordings that were kept out say against the model, and what to do."""
    if not found.odd:
        return ()
    names = ", ".join(found.odd)
    return (
        f"the model that leaves noise alone of the other recordings does not explain {names}, kept out, whatever its"
        " numbers are: something is not the same in all recordings, such as a load, a zero, a gain, the base's level,"
        f" warm joints or a battery. Without `role: holdout` a cause is looked for in {names} too",
    )


def largest_of(left: np.ndarray, found: Search, runs: Sequence[Run], held: dict[str, np.ndarray]) -> np.ndarray:
    """The RMS left at each joint, or that of odd recordings that were kept out, as they are predicted, if larger."""
    odd = [run for run in runs if run.name in found.odd]
    return np.max([left, *(np.sqrt(((run.position - held[run.name]) ** 2).mean(0)) for run in odd)], axis=0)


def _is_noise(here: Setting, run: Run, read: np.ndarray) -> bool:
    """Whether noise alone is between a recording and what is predicted of it, joint by joint."""
    level, share = np.maximum(noise_of(run.position), here.spread), told_by(run.position)
    error = (run.position - read) / level * np.sqrt(share)
    return all(excess(error[:, [k], None], share[:, [k], None]) < 1.0 for k in range(error.shape[1]))


def with_kept_out(here: Setting, kept_out: Sequence[Run]) -> Setting:
    """The setting with recordings that were kept out, in windows as long; positions alone, each with its own noise."""
    count, rows = len(here.loop.measured), max(one.rows for one in here.stretches)
    stretches, even = list(here.stretches), np.ones((len(here.runs) + len(kept_out), count))
    for k, run in enumerate(kept_out, len(here.runs)):
        total = len(run.time)
        stretches += [
            Stretch(k, first, min(rows, total - first)) for first in range(0, max(total - rows // 5, 1), rows)
        ]
        even[k] = here.spread / np.maximum(noise_of(run.position), here.spread)
    runs = (*here.runs, *(run._replace(holdout=False) for run in kept_out))
    pole = None if here.pole is None else here.pole[:count]
    every = replace(here, runs=runs, stretches=tuple(stretches), noise=here.noise[:1], pole=pole, even=even)
    return replace(every, data=every.cut(here.loop))


def _fitted(every: Setting, structure: Structure, begin: Fit, free: Sequence[int], most: int) -> Fit:
    """The states at the starts of all windows, and what is free."""
    start = np.array(structure.data.start)
    if begin.start.shape[1] <= start.shape[1]:
        start[:, : begin.start.shape[1]] = begin.start
    width = max(every.width, len(free))
    theta = begin.theta[None]
    return fit(*structure, theta, [free], start[None], width=width, lanes=1, iterations=most, rough=ROUGH)[0]


def _squares(every: Setting, structure: Structure, one: Fit) -> np.ndarray:
    """Squares of the residuals over their noise, of each recording and joint."""
    left, runs = (residuals(structure, one) ** 2).sum(0), np.array([x.run for x in every.stretches])
    return np.stack([left[:, runs == k].sum(1) for k in range(runs.max() + 1)])


def _is_odd(every: Setting, structure: Structure, one: Fit, run: int) -> bool:
    """Whether the model of the fitted recordings leaves more than noise of a recording."""
    mine = [k for k, x in enumerate(every.stretches) if x.run == run]
    data = structure.data
    some = eqx.tree_at(lambda d: d.weight, data, _only(np.asarray(data.weight), mine))
    some = eqx.tree_at(lambda d: d.share, some, _only(np.asarray(data.share), mine))
    return bool(excess_of(every, structure._replace(data=some), one).max() >= 1.0)


def _only(values: np.ndarray, windows: Sequence[int]) -> np.ndarray:
    """Zeros in all other windows."""
    kept = np.zeros_like(values)
    kept[..., list(windows)] = values[..., list(windows)]
    return kept
