"""What stays the same during a search for causes, what a fit leaves, and the baseline's fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ..effects.base import Effect, place
from ..effects.catalogue import CATALOGUE
from ..errors import InputError, nearest
from .causes import Candidate, Catalogue, catalogue, with_pairs
from .colour import colour_of, filtered
from .data import Run, Stretch, noise_of, regular, windows
from .fit import Fit, fit
from .loop import Loop
from .own import everywhere, placed
from .parameters import BOUNDS, Table, values
from .sensitivity import Windows, predicted
from .thresholds import HALF_A_STEP, POWER, SLOW, SLOW_ROWS, SURE_OF_NOISE, TO_TRY

__all__ = [
    "Setting",
    "Structure",
    "bare",
    "begins_of",
    "begun",
    "begun_by_parts",
    "by_readings",
    "by_recording",
    "coloured",
    "counted",
    "evened",
    "excess",
    "far_off",
    "free_entries",
    "in_parts",
    "largest_forces",
    "level_of",
    "residuals",
    "setting",
    "start_values",
    "thinned",
    "whitened",
]

_PAIR = 2  # starts of the baseline that are followed to the end
_ROUGH = 1e-3  # share of the squares that a step of such a start must promise
_ENOUGH = 6000  # rows of an arm's recordings that a search is made on; the more are asked at the end
_SHORTEST = 100  # rows of a window that is shortened for that
_EARLY = 4  # iterations of a race among all starts
_NOISE, _FAR_OFF = 1.3, 9.0  # times the noise's power: up to it noise is left; from it on short windows are tried too
_PART, _LEAST, _ENDS = 0.5, 20, 15  # s and least rows of such a window; iterations of their fit


@dataclass(frozen=True)
class Setting:
    """Everything that stays the same during a search."""

    loop: Loop
    runs: tuple[Run, ...]
    data: Windows
    noise: tuple[np.ndarray, ...]
    known: Catalogue
    baseline: tuple[int, ...]  # entries that every fit frees
    folds: np.ndarray  # (blocks, windows)
    lanes: int
    width: int
    stretches: tuple[Stretch, ...]
    block: float
    pole: np.ndarray | None = None  # of coloured noise, of which `noise` drives the low pass
    readings: bool = False  # whether rows weigh by what they tell of a reading: `by_readings`
    even: np.ndarray | None = None  # (runs, ny) by which rows weigh more or less than by their noise: `evened`

    @property
    def spread(self) -> np.ndarray:
        """Standard deviation of the noise of each position, rad or m."""
        own = self.noise[0]
        return own if self.pole is None else own / np.sqrt(1 - self.pole[: len(own)] ** 2)

    def cut(self, loop: Loop) -> Windows:
        """The recordings in windows, for a loop of these joints."""
        data = windows(loop, self.runs, self.stretches, self.noise, self.block, pole=self.pole)
        if self.readings:
            data = replace(data, weight=np.asarray(data.weight) * np.sqrt(data.share), weighed=True)
        if self.even is None:
            return data
        share = self.even[[one.run for one in self.stretches]].T
        return eqx.tree_at(lambda d: d.weight, data, np.asarray(data.weight) * share)

    def plain(self) -> Setting:
        """The same with every row weighed by its noise alone."""
        some = replace(self, even=None)
        return self if self.even is None else replace(some, data=some.cut(self.loop))

    @property
    def bounds(self) -> np.ndarray:
        """(entries, 2): what the numbers can be."""
        return np.array([BOUNDS[entry.name] for entry in self.known.table])


class Structure(NamedTuple):
    """The loop with the table of its numbers: plain, or with a spring in one joint."""

    loop: Loop
    table: Table
    data: Windows


def setting(
    loop: Loop,
    runs: Sequence[Run],
    *,
    baseline: Sequence[str] = ("rotor_inertia", "joint_damping", "friction_loss"),
    more: Sequence[tuple[str, ...]] = (),
    gains_known: bool = True,
    forbid: Sequence[str] = (),
    block: float = 0.3,
    stretches: Sequence[Stretch] = (),
    rates: bool = True,
) -> Setting:
    """Data, catalogue and baseline; `more` are (effect, place) that it has beside `baseline` at every joint."""
    loop = replace(with_pairs(loop), effects=everywhere(loop.robot, _with_wanted(loop, more), forbid))
    fitted = [r for r in runs if not r.holdout]
    noise = [np.sqrt(np.mean([noise_of(r.position) ** 2 for r in fitted], axis=0))]
    if rates and all(r.velocity is not None for r in fitted):
        noise.append(np.sqrt(np.mean([noise_of(r.velocity) ** 2 for r in fitted if r.velocity is not None], axis=0)))
    stretches = tuple(stretches) or tuple(Stretch(k, 0, len(r.time)) for k, r in enumerate(fitted))
    data = windows(loop, fitted, stretches, noise, block)
    forces = largest_forces(loop, fitted)
    links = loop.robot.link_names
    bodies = [links.index(one[1]) for one in more if one[0] == "link_inertia" and one[1:] and one[1] in links]
    known = catalogue(loop, forces, gains_known=gains_known, forbid=forbid, bodies=bodies)
    names = loop.robot.dof_names
    wanted = [(effect, name) for effect in baseline for name in names] + list(more)
    all_of = catalogue(loop, forces, gains_known=False, bodies=bodies).candidates
    told = {(c.effect, *c.at) for c in all_of}
    for effect, *at in more:
        if effect == "coupled_transmission":
            raise InputError(
                "baseline: effects: a rollout finds a 'coupled_transmission' by `diagnose`, with the sign of its second"
                " joint; it is not fitted before"
            )
        if (effect, *at) not in told:
            raise InputError(
                f"baseline: effects: a rollout has no number for '{effect}' at '{', '.join(at)}'"
                f"{nearest(effect, {one[0] for one in told})}; it has {', '.join(sorted({one[0] for one in told}))}"
            )
    free = [k for c in all_of if (c.effect, *c.at) in wanted for k in c.entries]
    keep = tuple(c for c in known.candidates if not set(c.entries) <= set(free))
    count = loop.robot.nv
    return Setting(
        loop, tuple(fitted), data, tuple(noise), Catalogue(known.table, keep), tuple(free),
        _folds(data, stretches), 8 if count == 1 else 1, len(free) + (5 if count == 1 else 8), stretches, block,
    )  # fmt: skip


def _with_wanted(loop: Loop, more: Sequence[tuple[str, ...]]) -> tuple[Effect, ...]:
    """The effects of a loop, and those of the baseline for which it has no number of its own but their torque."""
    own = {c.effect for c in catalogue(loop, np.ones(len(loop.drives.names)), gains_known=False).candidates}
    names = loop.robot.dof_names
    asked = [(one[0], one[1]) for one in more if len(one) == 2 and one[0] not in own and one[1] in names]
    new = [(CATALOGUE[effect], name) for effect, name in asked if effect in CATALOGUE]
    new = [
        place(effect, loop.robot, [name]) for effect, name in new if effect.acts_on == "joint" and effect.has("torque")
    ]
    there = {(e.name, *np.asarray(e.places).tolist()) for e in loop.effects}
    return (*loop.effects, *placed(loop.robot, [e for e in new if (e.name, *e.places.tolist()) not in there]))


def thinned(here: Setting) -> Setting:
    """Where there is more than a search needs, some windows of each recording, evenly spread; else the same.

    Where one window of each recording is still more, all are shortened alike.
    """
    total = sum(one.rows for one in here.stretches)
    if total <= _ENOUGH:
        return here
    kept = []
    for run in sorted({one.run for one in here.stretches}):
        mine = [one for one in here.stretches if one.run == run]
        many = int(np.ceil(len(mine) * _ENOUGH / total))
        kept += [mine[k] for k in np.unique(np.round((np.arange(many) + 0.5) * len(mine) / many - 0.5).astype(int))]
    share = min(_ENOUGH / sum(one.rows for one in kept), 1.0)
    kept = [one._replace(rows=max(int(one.rows * share), min(one.rows, _SHORTEST))) for one in kept]
    some = replace(here, stretches=tuple(kept))
    data = some.cut(here.loop)
    return replace(some, data=data, folds=_folds(data, kept))


def evened(here: Setting, structure: Structure, found: Fit) -> Setting:
    """The setting in which each recording tells as much of each joint, where a fit leaves more than noise of it.

    What a model lacks differs by recording and joint, as fast motions show more of it than slow ones: least squares
    weigh each by the variance of what is left there (A. C. Aitken, Proceedings of the Royal Society of Edinburgh 55,
    1935), all together as before.
    """
    plain = here.plain()
    data = structure._replace(data=plain.cut(structure.loop))
    left, told = residuals(data, found), np.asarray(data.data.weight) > 0
    run = np.array([one.run for one in here.stretches])
    size = np.ones((run.max() + 1, left.shape[1]))
    for k in np.unique(run):
        count = told[..., run == k].sum((0, 2))
        size[k] = np.sqrt((left[..., run == k] ** 2).sum((0, 2)) / np.maximum(count, 1))
    size = np.maximum(size, 1.0)
    mean = np.sqrt((left**2).sum() / max(told.sum(), 1))
    some = replace(plain, even=mean / size)
    return replace(some, data=some.cut(here.loop))


def _folds(data: Windows, stretches: Sequence[Stretch]) -> np.ndarray:
    """Recordings where there are three or more, else four quarters of the time."""
    blocks, count = data.reading.shape[0] // data.block, len(stretches)
    runs = [s.run for s in stretches]
    if len(set(runs)) >= 3:
        return np.broadcast_to(np.array(runs), (blocks, count)).copy()
    return np.broadcast_to((np.arange(blocks) * 4 // blocks)[:, None], (blocks, count)).copy()


def largest_forces(loop: Loop, runs: Sequence[Run]) -> np.ndarray:
    """The largest force of each drive, its law taken at what was recorded."""
    drives, found = loop.drives, np.zeros(len(loop.drives.names))
    for run in runs:
        position = np.zeros((len(run.time), loop.robot.nv))
        position[:, list(loop.measured)] = run.position
        length = position @ np.asarray(drives.transmission).T
        force = np.asarray(drives.bias)[:, 0] + np.asarray(drives.gain)[:, 0] * run.command
        force = np.abs(force + np.asarray(drives.bias)[:, 1] * length)
        found = np.maximum(found, np.quantile(force, 0.999, axis=0))
    return np.minimum(found, np.asarray(drives.force_range)[:, 1])


def residuals(structure: Structure, found: Fit) -> np.ndarray:
    """Residuals over their noise, (rows, ny, windows)."""
    with jax.enable_x64(True):
        read = predicted(structure.loop, structure.table, found.theta[None], structure.data, found.start[None])[0]
    return (np.asarray(structure.data.reading) - np.asarray(read)) * np.asarray(structure.data.weight)


def whitened(structure: Structure, found: Fit) -> np.ndarray:
    """What each row's residual tells beyond the row before it, (rows, ny, windows): white where it is noise.

    By what the row tells of a reading (`Windows.share`).
    """
    pole = None if structure.data.pole is None else np.asarray(structure.data.pole)
    left = residuals(structure, found)
    left = left if structure.data.weighed else left * np.sqrt(np.asarray(structure.data.share))
    return filtered(left, np.asarray(structure.data.weight) > 0, pole)


def coloured(here: Setting, structure: Structure, found: Fit) -> Setting | None:
    """The setting with the colour of what a fit leaves, or None where that is more than noise, or white."""
    if here.pole is not None:
        return None
    colour = colour_of(residuals(structure, found), np.asarray(structure.data.weight) > 0, TO_TRY)
    if colour is None or not colour.pole.any():
        return None
    levels = colour.level.reshape(len(here.noise), -1)
    noise = tuple(one * level for one, level in zip(here.noise, levels, strict=True))
    again = replace(here, noise=noise, pole=colour.pole)
    return replace(again, data=again.cut(here.loop))


def excess(error: np.ndarray, share: np.ndarray) -> float:
    """How many times what noise may reach the whitened residual is: its power, and that of its means over 25 rows.

    Rows in which a counter stands, which have one `share`, have one error: their mean is as large as each of them. No
    position is further from such a reading than half a step: what is, is none of its noise in any of the rows.
    """
    count = share.sum()
    power = ((error**2).sum() / count - 1) / np.sqrt(6 / count)
    rows = len(error) // SLOW_ROWS * SLOW_ROWS
    means = error[:rows].reshape(-1, SLOW_ROWS, *error.shape[1:]).sum(1) / np.sqrt(SLOW_ROWS)
    parts = share[:rows].reshape(-1, SLOW_ROWS, *error.shape[1:])
    full, most = (parts > 0).all(1), parts.max(1)
    standing = full & (most <= 1 / SLOW_ROWS)
    off = np.abs(means) / np.sqrt(SLOW_ROWS * np.where(standing, most, 1.0))  # of the noise, by which the mean is off
    means = np.hypot(means, np.where(standing, np.sqrt(SLOW_ROWS) * np.maximum(off - HALF_A_STEP, 0.0), 0.0))
    due = np.minimum(parts.sum(1)[full], 1.0)  # of a counter that stands for k rows: 25 / k, where k is more than 25
    slow = ((means[full] ** 2).sum() - due.sum()) / np.sqrt(4 * (due**2).sum()) if full.any() else 0.0
    return float(max(power / POWER, slow / SLOW))


def level_of(found: Fit, data: Windows) -> float:
    """Mean square of the misfit over the samples that count, in units of the noise's variance."""
    return found.squares / max(counted(data), 1)


def counted(data: Windows) -> float:
    """Samples that count, or readings where rows weigh by what they tell of one."""
    return float(np.asarray(data.share).sum() if data.weighed else (np.asarray(data.weight) > 0).sum())


def by_readings(here: Setting, last: Fit) -> Setting | None:
    """The setting in which a counter that stands tells one reading, where a fit leaves noise alone; else None.

    All rows of a stand have one error of reading. A model's own error, where that is more, each of them tells.
    """
    stands = (np.asarray(here.data.share) < (np.asarray(here.data.weight) > 0)).any()
    if here.readings or here.pole is not None or not stands or not level_of(last, here.data) < _NOISE:
        return None
    again = replace(here, readings=True)
    return replace(again, data=again.cut(here.loop))


def by_recording(here: Setting) -> bool:
    """Whether the folds are recordings, three or more."""
    return len(np.unique(here.folds)) == len({s.run for s in here.stretches}) >= 3


def begun(here: Setting) -> Fit:
    """The baseline's fit."""
    return begun_by_parts(here, _begun(here))


def _begun(here: Setting) -> Fit:
    begins: Any = begins_of(here, values(here.loop, here.known.table))
    structure = Structure(here.loop, here.known.table, here.data)
    sizes: Any = {"width": here.width, "lanes": here.lanes}
    if len(begins) == 1:
        return fit(*structure, begins, [here.baseline], **sizes)[0]
    early = fit(*structure, begins, [here.baseline] * len(begins), iterations=_EARLY, **sizes)
    order = sorted(early, key=lambda f: f.cost)[:_PAIR]
    states = np.stack([f.theta for f in order]), np.stack([f.start for f in order])
    fits = fit(*structure, states[0], [here.baseline] * len(order), states[1], rough=_ROUGH, **sizes)
    best = min(fits, key=lambda f: f.cost)
    return fit(*structure, best.theta[None], [here.baseline], best.start[None], **sizes)[0]


def begun_by_parts(here: Setting, found: Fit) -> Fit:
    """A baseline's fit; where it leaves much more than noise, the better one of it and of one begun by short windows.

    A long simulation that a drive's limit, or friction, holds up leads to numbers that no step leaves again; from the
    measured states at the starts of many short ones it does not. Not where it has several starts: real arms with free
    gains that a baseline explains better so were explained worse with all causes.
    """
    if not np.isfinite(found.cost) or not far_off(here, found) or len(begins_of(here, found.theta)) > 1:
        return found
    some = in_parts(here)
    if len(some.stretches) == len(here.stretches):
        return found
    sizes: Any = {"width": here.width, "lanes": here.lanes}
    short, filed = Structure(here.loop, here.known.table, some.data), np.asarray(values(here.loop, here.known.table))
    (early,) = fit(*short, filed[None], [here.baseline], iterations=_ENDS, rough=_ROUGH, **sizes)
    if not np.isfinite(early.cost):
        return found
    whole = Structure(here.loop, here.known.table, here.data)
    (again,) = fit(*whole, early.theta[None], [here.baseline], **sizes)
    return again if again.cost < found.cost else found


def bare(here: Setting, last: Fit) -> Fit | None:
    """The baseline's fit from where one with causes has ended, if that leaves hardly more: it had not ended before."""
    theta, own = np.asarray(values(here.loop, here.known.table)).copy(), list(here.baseline)
    theta[own] = last.theta[own]
    structure = Structure(here.loop, here.known.table, here.data)
    same = last.start.shape == np.shape(here.data.start)  # a spring has states of its own
    known = last.start[None] if same else None
    one = fit(*structure, theta[None], [here.baseline], known, width=here.width, lanes=1)[0]
    return one if np.isfinite(one.cost) and one.squares < last.squares + SURE_OF_NOISE else None


def in_parts(here: Setting) -> Setting:
    """The setting in short windows; the same where it is so already. Its folds are quarters of each recording."""
    rows = max(round(_PART / regular(here.runs[0].name, here.runs[0].time)), _LEAST)
    parts = [
        Stretch(one.run, first, min(rows, one.first + one.rows - first))
        for one in here.stretches
        for first in range(one.first, one.first + one.rows - _LEAST + 1, rows)
    ]
    some = replace(here, stretches=tuple(parts) if len(parts) > len(here.stretches) else here.stretches)
    data = some.cut(here.loop)
    blocks = data.reading.shape[0] // data.block
    quarter = np.array([4 * one.first // len(here.runs[one.run].time) for one in some.stretches])
    return replace(some, data=data, folds=np.broadcast_to(quarter, (blocks, len(quarter))).copy())


def far_off(here: Setting, found: Fit) -> bool:
    """Whether a fit leaves much more than noise."""
    return level_of(found, here.data) > _FAR_OFF


def begins_of(here: Setting, theta: np.ndarray) -> np.ndarray:
    """Where the baseline's fit starts: at the model; where the gains are free, also stiffer and heavier.

    A user's effect whose parameters are not all linear starts from each point of their grids.
    """
    known = catalogue(here.loop, np.ones(len(here.loop.drives.names))).candidates if here.loop.effects else ()
    own = {k: one for c in known for k, one in _grids(c).items() if k in here.baseline}
    if own:
        many = max(len(one) for one in own.values())
        begins = np.repeat(theta[None], many, 0)
        for k, one in own.items():
            begins[:, k] = np.resize(one, many)
        return begins
    gains = [k for k in here.baseline if here.known.table[k].name == "scale"]
    if not gains:
        return theta[None]
    rotors = [k for k in here.baseline if here.known.table[k].name == "armature"]
    begins = []
    for stiff, heavy in ((1.0, 1.0), (4.0, 1.0), (1.0, 8.0), (4.0, 8.0), (0.1, 1.0), (0.02, 1.0)):
        begins.append(theta.copy())
        begins[-1][gains] *= stiff
        begins[-1][rotors] = np.maximum(begins[-1][rotors], 1e-3) * heavy
    return np.array(begins)


def _grids(c: Candidate) -> dict[int, list[float]]:
    """The starting values of each number of a candidate that shows nothing without a size."""
    return {c.entries[i]: [start[i] for start in c.starts] for i in c.kind.shapes}


def free_entries(fitted: Sequence[int], extra: Sequence[int]) -> list[int]:
    """Entries of theta of both lists, each once, in the order in which they come first."""
    return list(dict.fromkeys([*fitted, *extra]))


def start_values(theta: np.ndarray, candidate: Candidate, values: Sequence[float]) -> np.ndarray:
    """Theta with a candidate's entries at the values that it starts from; where one is not a number it stays."""
    new = theta.copy()
    for entry, value in zip(candidate.entries, values, strict=True):
        if not np.isnan(value):
            new[entry] = value
    return new
