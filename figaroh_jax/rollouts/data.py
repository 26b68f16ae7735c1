"""Recordings of command and position, cut into windows on the grid of the loop's steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import gammaincinv

from ..errors import InputError
from .loop import Loop
from .sensitivity import Windows
from .thresholds import AHEAD_LIKE, AHEAD_MORE, AHEAD_ROWS, AHEAD_SECONDS

__all__ = [
    "Run",
    "Stretch",
    "ahead_of_command",
    "as_recorded",
    "likeness",
    "noise_of",
    "regular",
    "told_by",
    "windows",
    "without_gaps",
]

_GAP, _GAPS = 3.0, 0.01  # periods from a row to the next, and share of rows, up to which gaps are filled in
_BEGINNING = 0.02  # share of rows within which a clock may have to settle
_LEAD = 0.2  # s of command kept before a window: no delay is longer
_KEPT = 0.97334  # variance of a normal variable that never leaves three sigma
_SMOOTH = 0.99  # level of the squares left by a cubic, up to which it follows the rows
_WHOLE_STEPS = 0.01  # steps by which every value of a counter may be off a whole number of them


class Run(NamedTuple):
    """One recording with a regular clock."""

    name: str
    time: np.ndarray  # (rows,) s
    command: np.ndarray  # (rows, nu)
    position: np.ndarray  # (rows, ny)
    velocity: np.ndarray | None
    holdout: bool = False
    trusted: np.ndarray | None = None  # (rows,) or (rows, ny), False: what counts for nothing
    carried: np.ndarray | None = None  # (rows, 4 + 3 links) of one joint alone: `alone.carried_by`
    stamps: np.ndarray | None = None  # s, of the recording itself where rows were filled in
    filled: np.ndarray | None = None  # (rows,) True: a row that was filled in


class Stretch(NamedTuple):
    """What one window covers."""

    run: int
    first: int
    rows: int


def regular(name: str, time: np.ndarray) -> float:
    """The period of a regular clock (s); raises `InputError` at the first stamp that jumps."""
    steps = np.diff(time)
    period = float(np.median(steps))
    wrong = np.flatnonzero(np.abs(steps - period) > 0.5 * period)
    if len(wrong):
        row = int(wrong[0]) + 1
        raise InputError(
            f"{name}: the time stamp jumps in row {row} (from 0): {steps[row - 1]:.6g} s after the row before, "
            f"where the period is {period:.6g} s; cut the recording there, a rollout needs a regular clock"
        )
    return float((time[-1] - time[0]) / (len(time) - 1))


def without_gaps(run: Run) -> tuple[Run, str]:
    """A recording of which a few rows are lost or late, with rows that count for nothing in the gaps, and what is said.

    The command holds through a gap, and the clock is that of the other rows: it is off by half a period at most for
    each. First rows whose stamps are closer together than those after them, as a logger empties a queue, are left out.
    What is neither that nor a few short gaps is left as it is, for `regular` to refuse.
    """
    run, begun = _settled(run)
    steps = np.diff(run.time)
    period = float(np.median(steps))
    late = np.abs(steps - period) > 0.5 * period
    if not late.any() or late.mean() > _GAPS or steps.max() > _GAP * period or steps.min() <= 0.5 * period:
        return run, begun
    period = float(steps[~late].mean())
    row = np.concatenate([[0], np.cumsum(np.round(steps / period).astype(int))])
    every = np.arange(row[-1] + 1)
    filled = ~np.isin(every, row)
    trusted = ~filled
    if run.trusted is not None:
        trusted[row] &= run.trusted
    new = run._replace(
        time=run.time[0] + period * every,
        command=run.command[np.searchsorted(row, every, side="right") - 1],
        position=_through(row, every, run.position),
        velocity=None if run.velocity is None else _through(row, every, run.velocity),
        trusted=trusted,
        stamps=run.time,
        filled=filled,
    )
    first, most = int(late.argmax()) + 1, 1e3 * (steps.max() - period)
    return new, (f"{begun}; " if begun else "") + (
        f"{run.name}: rows that come late: {late.sum()} of {len(run.time)}, the first row {first} (from 0), by at most"
        f" {most:.3g} ms; the command is taken to hold, and rows that count for nothing are filled in: {filled.sum()}"
    )


def _settled(run: Run) -> tuple[Run, str]:
    """The recording from the row on at which its clock has settled, and what is said of the rows before it."""
    steps = np.diff(run.time)
    early = np.flatnonzero(steps < 0.5 * np.median(steps)) + 1
    if not len(early) or early[-1] > _BEGINNING * len(run.time) or run.carried is not None:
        return run, ""
    first = int(early[-1])
    held = {key: None if (x := getattr(run, key)) is None else x[first:] for key in _BY_ROW}
    return run._replace(**held), (
        f"{run.name}: the stamps before row {first} (from 0) are closer together than the others: these rows are left"
        " out"
    )


_BY_ROW = ("time", "command", "position", "velocity", "trusted")


def _through(row: np.ndarray, every: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (rows, columns) with straight lines through what is filled in."""
    return np.stack([np.interp(every, row, one) for one in values.T], 1)


def as_recorded(run: Run, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The recording's own stamps, and what was simulated of it (rows, joints) at them."""
    return (run.time, values) if run.stamps is None or run.filled is None else (run.stamps, values[~run.filled])


def ahead_of_command(command: Float[np.ndarray, " rows"], position: Float[np.ndarray, " rows"], period: float) -> int:
    """Rows by which a position surely moves before the command that it follows, 0 where it does not.

    Told by the correlation of their steps at every shift: no drive knows its command beforehand.
    """
    from scipy.signal import correlate  # its distributions are slow to import

    steps, moves = np.diff(command), np.diff(position)
    most = min(round(AHEAD_SECONDS / period), len(steps) // 2)
    size = float(np.sqrt((steps @ steps) * (moves @ moves)))
    if size == 0 or most < AHEAD_ROWS:
        return 0
    like = correlate(moves, steps, method="fft")[len(steps) - 1 - most : len(steps) + most] / size
    ahead = most - int(like[:most].argmax())
    best, behind = like[:most].max(), like[most:].max()
    return ahead if ahead >= AHEAD_ROWS and best > AHEAD_LIKE and best > behind + AHEAD_MORE else 0


def likeness(
    command: Float[np.ndarray, " rows"], follower: Float[np.ndarray, " rows"], latest: float, period: float
) -> float:
    """The largest correlation with a command up to `latest` s before; 0 where one of both stands."""
    most = min(round(latest / period), len(command) // 2)
    pairs = ((command[: len(command) - k], follower[k:]) for k in range(0, most + 1, max(1, most // 25)))
    return max(float(np.corrcoef(u, q)[0, 1]) if np.ptp(u) and np.ptp(q) else 0.0 for u, q in pairs)


def noise_of(values: np.ndarray) -> np.ndarray:
    """Standard deviation of white noise on smooth records, by fourth differences; at least 0.3 of a counter's step.

    Differences beyond three sigma, as where a motion changes suddenly, are left out, twice.
    """
    fourth = np.abs(np.diff(values, 4, axis=0)) / np.sqrt(70.0)
    white = np.median(fourth, axis=0) / 0.67449
    for _ in range(2):
        inside = fourth <= 3 * np.maximum(white, 1e-300)
        kept = np.where(inside, fourth**2, 0.0).sum(0) / np.maximum(inside.sum(0), 1)
        white = np.where(kept > 0, np.sqrt(kept / _KEPT), white)
    return np.maximum(white, np.maximum(0.3 * _step(values), 1e-9))


def _step(values: np.ndarray) -> np.ndarray:
    """Least step of each column where it repeats values, or has whole steps alone (a counter's resolution), else 0."""
    found = np.zeros(values.shape[1])
    for k, column in enumerate(values.T):
        levels = np.unique(np.round(column, 9))
        if len(levels) < 2:
            continue
        least = np.min(np.diff(levels))
        whole = (levels - levels[0]) / least
        if len(levels) < 0.5 * len(column) or (least > 1e-7 and np.abs(whole - np.round(whole)).max() < _WHOLE_STEPS):
            found[k] = least
    return found


def told_by(values: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """How much of a reading each row tells: a counter that stands tells one, however often it is read.

    Rows one after the other with the same value share it; else each tells one.
    """
    found = np.ones(values.shape)
    for k, column in enumerate(values.T):
        first = np.flatnonzero(np.concatenate([[True], column[1:] != column[:-1]]))
        length = np.diff(np.append(first, len(column)))
        found[:, k] = 1 / np.repeat(length, length)
    return found


def windows(
    loop: Loop,
    runs: Sequence[Run],
    stretches: Sequence[Stretch],
    noise: Sequence[np.ndarray],
    block: float,
    *,
    smooth: bool = False,
    pole: Float[np.ndarray, " ny"] | None = None,
) -> Windows:
    """Windows of equal length in rows of one period; shorter ones are padded and count for nothing there.

    `noise` holds the standard deviations of positions, and of velocities where they count. `smooth` starts each from
    as many rows as a polynomial follows, for windows whose start is not fitted. `pole` is that of noise which is white
    noise behind a first-order low pass; `noise` is then what goes in.
    """
    period = regular(runs[0].name, runs[0].time)
    substeps = max(1, round(period / float(loop.dt)))
    rows_of_block = max(1, round(block / period))
    most = max(s.rows for s in stretches)
    rows = -(-most // rows_of_block) * rows_of_block
    lead = int(np.ceil(_LEAD / period))
    command, reading, weight, share, start, precision, carried = [], [], [], [], [], [], []
    for stretch in stretches:
        run = runs[stretch.run]
        at = np.clip(np.arange(stretch.first - lead, stretch.first + rows), 0, len(run.time) - 1)
        command.append(run.command[at])
        if run.carried is not None:
            carried.append(run.carried[at[lead:]])
        inside = np.arange(rows) < stretch.rows
        here = at[lead:]
        counted = inside if run.trusted is None else (inside & run.trusted[here].T).T
        parts = [run.position] + ([run.velocity] if len(noise) > 1 and run.velocity is not None else [])
        reading.append(np.concatenate([p[here] for p in parts], 1))
        share.append(np.concatenate([counted.reshape(rows, -1) * told_by(p)[here] for p in parts], 1))
        weight.append(np.concatenate([counted.reshape(rows, -1) / s for s in noise], 1))
        rows_of_state = _smooth_rows(run, stretch.first, noise[0]) if smooth else 5
        state, certainty = _state(loop, run, stretch.first, noise, period, rows_of_state)
        start.append(state)
        precision.append(certainty)
    return Windows(
        command=np.stack(command, -1),
        reading=np.stack(reading, -1),
        weight=np.stack(weight, -1),
        start=np.stack(start, -1),
        precision=np.stack(precision, -1),
        carried=np.stack(carried, -1) if carried else None,
        substeps=substeps,
        lead=lead,
        block=rows_of_block,
        pole=None if pole is None else np.repeat(np.asarray(pole, float)[:, None], len(stretches), 1),
        share=np.stack(share, -1),
    )


def _smooth_rows(run: Run, row: int, noise: Float[np.ndarray, " nv"]) -> int:
    """The most rows around one (5 to 129) that a cubic follows within the noise of every joint."""
    for rows in (129, 65, 33, 17, 9):
        first = min(max(row - rows // 2, 0), max(len(run.time) - rows, 0))
        near = run.position[first : first + rows]
        if len(near) < rows:
            continue
        t = np.linspace(-1, 1, rows)
        left = near - np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyfit(t, near, 3)).T
        if np.all((left**2).sum(0) <= 2 * gammaincinv((rows - 4) / 2, _SMOOTH) * np.maximum(noise, 1e-12) ** 2):
            return rows
    return 5


def _state(
    loop: Loop, run: Run, row: int, noise: Sequence[np.ndarray], period: float, rows: int = 5
) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity at a row by a polynomial through the rows around it, and how precise they are."""
    n = loop.robot.nv
    first = min(max(row - rows // 2, 0), max(len(run.time) - rows, 0))
    near = slice(first, first + rows)
    t = (np.arange(first, first + len(run.position[near])) - row) * period
    line = np.polyfit(t, run.position[near], min(2 if rows <= 5 else 3, len(t) - 1))
    q, v = line[-1], line[-2]
    q = np.where(np.ptp(run.position[near], axis=0) == 0, run.position[row], q)
    sigma = np.maximum(noise[0], 1e-9)
    state, certainty = np.zeros(2 * n), np.repeat([50.0, 2.0], n)  # a spring's twist is not read
    places = np.array(loop.measured)
    reading = np.asarray(loop.joints.reading, float)[places]
    state[places], certainty[places] = q - reading, 1 / np.maximum(5 * sigma, 0.05)
    state[n + places] = v
    certainty[n + places] = 1 / np.maximum(5 * sigma / period, 0.02)
    return state, certainty
