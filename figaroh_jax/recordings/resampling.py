"""From one time base to another: uneven stamps to a grid, one rate to another, rows back to a recording's stamps.

Rates change through one band-limited interpolation (a sinc under a Kaiser window, 100 dB), symmetric in time and
therefore without phase. Signals are (samples, columns), times in seconds, rates in hertz.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

__all__ = [
    "Grid",
    "band_limited",
    "differentiate",
    "even_grid",
    "read_clock",
    "sampling_rate",
    "stencil",
    "to_recording_times",
    "unrounded",
]

EVEN = 0.02  # stamps within this share of a step of a straight line count as even
GAP_STEPS = 5
STAMP = 1e-7  # s: stamps are not told apart below it
FEW_STAMPS = 20  # from which rounding is told from chance
ON_LATTICE = 0.01  # of the lattice of stamps: where they stand on it
ROUNDED = 0.75  # of the lattice: how far from it the clock may be (half, and what the line's own fit is off)
SMOOTHER = 0.8  # times the mean square about cubics, on an even clock: its motion is the smoother one
_SAME = 9  # decimals, in samples: instants that lie so close between samples have one kernel
_AT_ONCE = 1 << 22  # weights of an interpolation that are held at once
STOP_BAND = 100.0  # dB
BETA = 0.1102 * (STOP_BAND - 8.7)  # Kaiser 1974
LENGTH = (STOP_BAND - 7.95) / (2.285 * 2 * np.pi)  # kernel length times transition width


class Grid(NamedTuple):
    """Columns on an even grid from `start`, with the gaps (begin, end) that the stamps left."""

    start: float
    rate: float
    columns: tuple[Float[np.ndarray, "samples _"], ...]
    gaps: tuple[tuple[float, float], ...]


def sampling_rate(time: Float[np.ndarray, " samples"]) -> float:
    """Rate in Hz: of the mean step where the stamps are even, else of the median step."""
    steps = np.diff(time)
    return float(1 / (steps.mean() if _is_even(time) else np.median(steps)))


def unrounded(time: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
    """Stamps (s) of an even clock whose logger has rounded them, as that clock had them; all others as they are.

    Whole milliseconds of 240 Hz are 4, 4, 4, 4, 4, 5, ...: taken at their word, they shake the position by its
    velocity times half a millisecond. They count as rounded where all stand on a lattice, off which one even clock lies
    nowhere by more than rounding. Samples may be missing.
    """
    steps = np.diff(time)
    if len(time) < FEW_STAMPS or _is_even(time) or not (steps > 0).all():
        return time
    lattice = float(steps.min())
    different = np.unique(np.round(steps / STAMP)) * STAMP
    if len(different) > 1:
        lattice = min(lattice, float(np.diff(different).min()))
    ticks = (time - time[0]) / lattice
    if np.abs(ticks - np.rint(ticks)).max() > ON_LATTICE:
        return time
    for step in (np.median(steps), steps.mean()):
        even, _ = _even_clock(time, float(step))
        if np.abs(time - even).max() < ROUNDED * lattice:
            return even
    return time


def _even_clock(time: Float[np.ndarray, " samples"], step: float) -> tuple[np.ndarray, np.ndarray]:
    """The even clock nearest to the stamps, and how many steps of it lie before each; samples may be missing."""
    count = np.append(0.0, np.cumsum(np.maximum(np.rint(np.diff(time) / step), 1)))
    period, start = np.polyfit(count, time, 1)
    return start + period * count, count


def read_clock(
    time: Float[np.ndarray, " samples"], position: Float[np.ndarray, "samples nq"]
) -> Float[np.ndarray, " samples"]:
    """When the samples were taken (s): the stamps, or the even clock behind stamps that are rounded or shake.

    A driver that reads its sensors evenly may stamp them when it gets round to it: such stamps shake the position by
    its velocity times their error. They count as shaken where none is half a period off one even clock, and the motion
    is smoother on that clock: its samples lie nearer to the cubic through the two before and the two after each.
    """
    time = unrounded(time)
    steps = np.diff(time)
    if len(time) < FEW_STAMPS or _is_even(time) or not (steps > 0).all():
        return time
    even, count = _even_clock(time, float(np.median(steps)))
    if np.abs(time - even).max() > 0.5 * (even[-1] - even[0]) / max(count[-1], 1.0):
        return time
    beside = np.flatnonzero(count[4:] - count[:-4] == 4)  # no sample lacks among five
    if len(beside) < FEW_STAMPS:
        return time
    stamped, steady = (_roughness(clock, position, beside) for clock in (time, even))
    moves = np.ptp(position, axis=0) > 0
    if not moves.any():
        return time
    least = np.finfo(float).tiny
    gained = np.log((steady[moves] + least) / (stamped[moves] + least)).mean()
    return even if gained < np.log(SMOOTHER) else time


def _roughness(
    time: Float[np.ndarray, " samples"], x: Float[np.ndarray, "samples cols"], first: Int[np.ndarray, " fives"]
) -> Float[np.ndarray, " cols"]:
    """Mean square of what the middle one of five samples is off the cubic through the other four."""
    at = time[first[:, None] + np.array([0, 1, 3, 4])] - time[first + 2][:, None]
    off = x[first + 2].copy()
    for one in range(4):
        others = [k for k in range(4) if k != one]
        weight = np.prod(-at[:, others] / (at[:, [one]] - at[:, others]), axis=1)
        off -= weight[:, None] * x[first + (0, 1, 3, 4)[one]]
    return (off**2).mean(axis=0)


def _is_even(time: Float[np.ndarray, " samples"]) -> bool:
    line = np.linspace(time[0], time[-1], len(time))
    return bool(np.abs(time - line).max() <= EVEN * (time[-1] - time[0]) / (len(time) - 1))


def even_grid(time: Float[np.ndarray, " samples"], smooth: Float[np.ndarray, "samples nv"], *rough) -> Grid:
    """Put columns on an even grid of the median step: `smooth` by cubic splines, each of `rough` linearly.

    Columns whose stamps are even already are passed on as they are.
    """
    rate = sampling_rate(time)
    if _is_even(time):
        return Grid(float(time[0]), rate, (smooth, *rough), ())
    from scipy.interpolate import CubicSpline

    steps = np.diff(time)
    grid = np.arange(time[0], time[-1] + 1e-9, 1 / rate)
    gaps = np.flatnonzero(steps > GAP_STEPS / rate)
    columns = [CubicSpline(time, smooth)(grid)]
    columns += [np.column_stack([np.interp(grid, time, column) for column in x.T]) for x in rough]
    return Grid(float(time[0]), rate, tuple(columns), tuple((float(time[k]), float(time[k + 1])) for k in gaps))


def band_limited(
    x: Float[np.ndarray, "samples cols"],
    at: Float[np.ndarray, " times"],
    *,
    start: float,
    rate: float,
    passed: float,
    stopped: float,
) -> Float[np.ndarray, "times cols"]:
    """Values at the times `at` of a signal sampled at `rate` from `start`, flat to `passed` Hz, nothing from `stopped`.

    Beyond its ends the signal is extended by point reflection. Signals of the same samples cost little more as columns
    of one than one of them: most of the time goes into the kernel.
    """
    length = LENGTH / (stopped - passed)
    half = min(int(np.ceil(length / 2 * rate)), len(x) - 1)
    extended = np.concatenate([2 * x[:1] - x[half:0:-1], x, 2 * x[-1:] - x[-2 : -half - 2 : -1]])
    where = (np.asarray(at) - start) * rate
    nearest = np.clip(np.rint(where).astype(int), 0, len(x) - 1)
    # what instants between samples have in common (few, where one rate divides another) is computed once
    between, which = np.unique(np.round(where - nearest, _SAME), return_inverse=True)
    taps = np.arange(-half, half + 1)
    out = np.empty((len(where), x.shape[1]))
    block = max(1, _AT_ONCE // len(taps))
    kernel = partial(_kernel, cutoff=(passed + stopped) / 2, length=length)
    known = kernel((taps - between[:, None]) / rate) if len(between) <= block else None
    for first in range(0, len(where), block):
        some = slice(first, first + block)
        weights = kernel((taps - between[which[some], None]) / rate) if known is None else known[which[some]]
        for j in range(x.shape[1]):
            out[some, j] = np.einsum("tk,tk->t", extended[nearest[some, None] + half + taps, j], weights)
    return out


def _kernel(lag: Float[np.ndarray, "times taps"], cutoff: float, length: float) -> Float[np.ndarray, "times taps"]:
    from scipy.special import i0

    window = i0(BETA * np.sqrt(np.clip(1 - (2 * lag / length) ** 2, 0, None))) * (np.abs(lag) <= length / 2)
    kernel = np.sinc(2 * cutoff * lag) * window
    return kernel / kernel.sum(axis=1, keepdims=True)


def to_recording_times(
    row_time: Float[np.ndarray, " rows"], values: Float[np.ndarray, "rows cols"], time: Float[np.ndarray, " samples"]
) -> Float[np.ndarray, "samples cols"]:
    """Values on evenly spaced rows brought to a recording's own stamps; the end values are held outside.

    Exact for content below 0.3 of the row rate, which is where the default preprocessing puts the cutoff.
    """
    rate = (len(row_time) - 1) / (row_time[-1] - row_time[0])
    at = np.clip(time, row_time[0], row_time[-1])
    start = float(row_time[0])
    return band_limited(values, at, start=start, rate=float(rate), passed=0.3 * rate, stopped=0.7 * rate)


def differentiate(x: Float[np.ndarray, "samples cols"], dt: float, order: int = 1) -> Float[np.ndarray, "samples cols"]:
    """First or second time derivative at the samples themselves, by five-point differences.

    Inside (8 (x[+1] - x[-1]) - (x[+2] - x[-2])) / (12 dt) and its second-order kin; the two samples at either end use
    the five outermost ones. Exact for polynomials up to degree four at every sample.
    """
    offsets = np.arange(5)
    result = np.empty_like(x)
    result[2:-2] = sum(c * x[k : len(x) - 4 + k] for k, c in enumerate(stencil(offsets - 2, order)))
    for row in (0, 1):
        result[row] = stencil(offsets - row, order) @ x[:5]
        result[-1 - row] = stencil(offsets - 4 + row, order) @ x[-5:]
    return result / dt**order


def stencil(offsets: np.ndarray, order: int) -> Float[np.ndarray, "5"]:
    """Weights on five samples that give the derivative of every polynomial up to degree four at offset zero."""
    powers = np.vander(offsets.astype(float), 5, increasing=True).T
    return np.linalg.solve(powers, np.eye(5)[order] * order)
