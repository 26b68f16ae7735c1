"""From a recording to even samples of position, velocity, acceleration and torque, and the filter of their rows.

Position and torque are brought to one *working rate*, some 12 to 16 times the cutoff, through one zero-phase
anti-aliasing kernel. Position is then low-passed and differentiated there. Torque stays as it is: `RowFilter` filters
it together with every regressor column after the column is formed, and keeps the rows at the output rate.

Velocity and acceleration always come from the position, so that the three belong to one motion. A logged velocity is
not used: controllers filter it with a delay that nobody states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, TypeVar, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..errors import InputError, nearest
from .bandwidth import Band, encoder_step, motion_band, smoothed
from .cleaning import near, without_untrusted
from .dataset import Recording
from .groupmotion import continued, group_rates, normalised
from .resampling import (
    Grid,
    band_limited,
    differentiate,
    even_grid,
    read_clock,
    sampling_rate,
    to_recording_times,
    unrounded,
)
from .rowfilter import RowFilter, fast_length, filter_rows, frequencies, low_pass, row_filter

if TYPE_CHECKING:
    from ..formats.config import Load, Preprocess
    from ..rigid.model import RobotModel

__all__ = [
    "Rates",
    "Read",
    "Resampled",
    "RowFilter",
    "Signals",
    "align",
    "apart",
    "as_slow_as_torque",
    "choose_rates",
    "common_rows",
    "filter_rows",
    "frequencies",
    "joint_by_joint",
    "kept_out_in_vain",
    "let_through",
    "moves_as",
    "prepare",
    "prepare_all",
    "stands_at_times",
    "to_recording_times",
]

DEFAULT_CUTOFF = 20.0  # Hz
WORKING = 13.2  # working rate over cutoff; the five-point differences are off by 0.2 % at the cutoff there
MOST_WORKING, LONG = 16.0, 40_000  # the same at the most, where all recordings together have more samples than these
ROWS = 3.3  # output rate over cutoff
MOST_NUMBERS = 1 << 25  # of one signal at the working rate: 256 MiB, hours of a robot
FEWEST_ROWS = 10
STALE = 0.1  # of the samples: more that repeat the one before are those of a robot that stands
MOST_STALE = 3  # of them in a row
STILL = 1e-12  # of rad or m: what a joint that stands still moves by rounding
CARRIES = 0.5  # periods of the cutoff to which the row filter carries what happens at a joint's rest
STANDS = 0.01  # of a joint's top speed
WORTH_TELLING = 0.05  # of a joint's rows at which it stands
MOSTLY_STANDS = 0.9  # of a joint's rows
HALF_OCTAVE = 2**-0.5
WORTH_A_STEP = 0.1  # fall of the squares that a model leaves of the torque (mean logarithm) for half an octave less
AT_COST = 1 / 3  # of that fall: what the squares of no joint may rise by
SAME_MOTION = 0.05  # of a joint's range (standard deviation): recordings that differ by more do not repeat each other
MOVES_MORE = 1.25  # times the acceleration that such a step takes of fitted recordings: more is motion, no error


@dataclass(frozen=True, eq=False)
class Signals:
    """A recording at the even working rate, joint side, SI units; `rows` makes the rows of a regression of it."""

    name: str
    file: str
    role: Literal["fit", "holdout"]
    repeat: str | None
    time: Float[np.ndarray, " samples"]  # s, on the recording's clock
    position: Float[np.ndarray, "samples nq"]  # low-passed
    velocity: Float[np.ndarray, "samples nv"]
    acceleration: Float[np.ndarray, "samples nv"]
    torque: Float[np.ndarray, "samples nv"] | None  # not low-passed: `rows` does it
    dt: float
    cutoff: float  # Hz
    bands: Float[np.ndarray, " nv"]  # Hz, up to which each position was let through, `cutoff` at most
    rows: RowFilter
    load: Load | None  # known payload carried
    notes: tuple[str, ...]
    stands: Bool[np.ndarray, "rows nv"] | None = None  # rows without weight because the joint stands; None: no row
    changed_since: str | None = None  # the recording that moves alike, but with another torque


# by recording and shift: rate and gaps of its even grid, then times and columns at the working rate
Resampled = dict[tuple[int, float], tuple[float, Any, Any, Any]]


class Rates(NamedTuple):
    """Rates that all recordings of a task share."""

    working: float  # Hz
    step: int  # working samples a row
    cutoff: float  # Hz

    @property
    def row(self) -> float:
        """Seconds from row to row."""
        return self.step / self.working


def prepare_all(
    recordings: Sequence[Recording],
    preprocess: Preprocess,
    *,
    band: Band = math.inf,
    model: RobotModel | None = None,
    resampled: Resampled | None = None,
    sticks: bool = True,
) -> tuple[Signals, ...]:
    """`prepare` every recording at the same rates, and repeats of one excitation on grids that meet.

    Row k of a repeat's first recording is then row k + `align(first, repeat)` of the repeat, to a fiftieth of a row.
    `band`, `model` and `resampled` as for `prepare`. Rows at which a joint stands have no weight, unless nothing
    `sticks` (a model without dry friction) or the `model` has quaternions, whose root no drive holds.
    """
    rates = choose_rates(recordings, preprocess)
    prepared: list[Signals] = []
    leaders: dict[str, Signals] = {}
    for recording in recordings:
        signals = prepare(recording, preprocess, rates, band=band, model=model, resampled=resampled)
        leader = leaders.setdefault(recording.repeat, signals) if recording.repeat else signals
        late = _late_rows(leader, signals) if leader is not signals else 0.0
        off = (late - round(late)) * rates.row
        if abs(off) >= rates.row / 50:
            more = {"band": band, "model": model, "resampled": resampled}
            signals = prepare(recording, preprocess, rates, shift=off, **more)
        prepared.append(signals)
    return without_standing(prepared) if sticks and (model is None or model.nq == model.nv) else tuple(prepared)


def without_standing(prepared: Sequence[Signals]) -> tuple[Signals, ...]:
    """The recordings without the rows of a joint that stands, and without those to which the filter carries them.

    A joint stands where its speed stays below a hundredth of its largest in all recordings for two periods of the
    cutoff. Dry friction holds it there with any torque up to its limit, and a brake with any at all: no law predicts
    the torque of its drive. A joint on its way through zero is not meant, nor one that hardly ever moves.
    """
    top = np.max([np.abs(one.velocity).max(axis=0) for one in prepared], axis=0)
    stands = [_standing(one, STANDS * top) for one in prepared]
    lost = sum(((one.rows.weight > 0) & out).sum(0) for one, out in zip(prepared, stands, strict=True))
    there = sum((one.rows.weight > 0).sum(0) for one in prepared)
    moves = lost <= MOSTLY_STANDS * there
    left_out = [out & moves & (one.rows.weight > 0) for one, out in zip(prepared, stands, strict=True)]
    return tuple(
        replace(one, stands=out, rows=eqx.tree_at(lambda r: r.weight, one.rows, np.where(out, 0.0, one.rows.weight)))
        for one, out in zip(prepared, left_out, strict=True)
    )


def stands_at_times(signals: Sequence[Signals], joints: Sequence[str]) -> tuple[str, ...]:
    """Which of the joints stand in how many of their rows, which are not judged, in words."""
    every = [one.stands for one in signals if one.stands is not None]
    share = np.concatenate(every).mean(axis=0) if every else np.zeros(len(joints))
    told = [f"{name} {100 * part:.0f} %" for name, part in zip(joints, share, strict=True) if part >= WORTH_TELLING]
    if not told:
        return ()
    return (
        "dry friction holds a joint that stands with any torque up to its limit: rows at rest are not judged, and left"
        f" out of the fit where they contradict the motion ({', '.join(told)})",
    )


def _standing(one: Signals, slow: Float[np.ndarray, " nv"]) -> Bool[np.ndarray, "rows nv"]:
    """Rows at which each joint stands, and as near to them as half a period of the cutoff."""
    reach, least = (max(1, round(periods / one.cutoff / one.dt)) for periods in (CARRIES, 2.0))
    out = np.zeros((len(one.velocity), len(slow)), bool)
    for joint, still in enumerate((np.abs(one.velocity) < slow).T):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            if end - begin >= least:
                out[max(0, begin - reach) : end + reach, joint] = True
    return out[np.asarray(one.rows.index)]


def prepare(
    recording: Recording,
    preprocess: Preprocess,
    rates: Rates | None = None,
    *,
    shift: float = 0.0,
    band: Band = math.inf,
    model: RobotModel | None = None,
    resampled: Resampled | None = None,
) -> Signals:
    """Even, low-passed, differentiated signals of one recording and the filter that makes its rows.

    `rates` are those of `choose_rates`, by default for this recording alone; `shift` (s, less than a row) moves the
    grid. A position is taken down to the band of its own motion where that is below the cutoff, else to `band` (Hz);
    None leaves all at the cutoff, a tuple says of each joint where. A `model` with quaternions in q takes the rates on
    its group (`groupmotion`).
    `resampled` holds what calls that differ in `band` alone have in common: an empty dictionary at first. Raises
    `InputError` where the window, the cutoff or the rate do not fit the recording, or it is too short.
    """
    rates, key = rates or choose_rates((recording,), preprocess), (id(recording), shift)
    recording, masked = without_untrusted(recording)
    time, position, torque = _window(recording, preprocess.window)
    grouped = model if model is not None and model.nq != model.nv else None
    if grouped is not None:
        position = continued(grouped, position, str(recording.file))
    _refuse_endless(recording, time, rates)
    known, raw = {} if resampled is None else resampled, position
    if key not in known:
        grid = even_grid(time, position, *([] if torque is None else [torque]))
        known[key] = grid.rate, grid.gaps, *_resample(grid, rates, shift)
    rate, gaps, at, columns = known[key]
    dt = 1 / rates.working
    seconds = time[-1] - time[0] + 1 / rate
    trim = 0.5 if seconds > 9.99 else 0.1
    nv = len(recording.joints)
    rows = row_filter(len(at), dt, rates.cutoff, step=rates.step, trim=trim, start=float(at[0]), nv=nv)
    if rows.kept < FEWEST_ROWS:
        raise InputError(
            f"{recording.file}: {seconds:.3g} s are too short: {rows.kept} row(s) at {1 / rates.row:.4g} Hz are left"
            f" after {trim} s are cut at both ends, at least {FEWEST_ROWS} are needed"
        )
    if grouped is None:
        bands = _bands(columns[0], dt, rates.cutoff, raw, rate, band)
        position = let_through(columns[0], dt, rates.cutoff, bands)
        moves = np.ptp(position, axis=0) > STILL * (1 + np.abs(position).max(axis=0))
        position[:, ~moves] = position[0, ~moves]  # dry friction would see the sign of rounding
        velocity, acceleration = (differentiate(position, dt, order=order) * moves for order in (1, 2))
    else:
        position, bands = normalised(grouped, low_pass(columns[0], dt, rates.cutoff)), np.full(nv, rates.cutoff)
        velocity, acceleration = group_rates(grouped, position, dt)
    weight = _weight(recording, preprocess, rows, velocity, gaps, rates.cutoff)
    weight *= ~near(rows.row_times, masked, 0.5 / rates.cutoff)
    return Signals(
        name=recording.name,
        file=str(recording.file),
        role=recording.role,
        repeat=recording.repeat,
        time=at,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        torque=None if torque is None else columns[1],
        dt=dt,
        cutoff=rates.cutoff,
        bands=bands,
        rows=eqx.tree_at(lambda r: r.weight, rows, weight),
        load=recording.load,
        notes=recording.notes + _clock_notes(recording) + _gap_notes(recording, gaps, rates.cutoff),
    )


@runtime_checkable
class Read(Protocol):
    """Recordings whose positions are taken down to some band, and what a model of the robot leaves of their torque."""

    @property
    def band(self) -> Band:
        """As for `prepare`."""
        ...

    @property
    def signals(self) -> Sequence[Signals]:
        """Of all recordings."""
        ...

    @property
    def squares(self) -> Float[np.ndarray, " fitted"]:
        """What the model leaves of the torque of each joint that is fitted, squared."""
        ...


R = TypeVar("R", bound=Read)


def as_slow_as_torque(best: R, read: Callable[[float], R], first: float = WORTH_A_STEP) -> R:
    """The recordings with positions in the smallest band (Hz) to which the torque follows them.

    `read` takes positions down to a band, those whose own shows no noise below the cutoff. They go down by half octaves
    for as long as each step lowers what the model leaves of the torque, at all joints: where motion is lost, or where
    friction sticks, some joints are predicted better and some worse. What a step takes of recordings kept out must be
    no more than of those that decide: they may move faster. `first` is what the first step must bring.
    """
    least = first
    while True:
        least_yet = best.band if isinstance(best.band, float) else math.inf
        slower = read(HALF_OCTAVE * min(least_yet, best.signals[0].cutoff))
        fall = np.log(best.squares / slower.squares)
        worth = np.mean(fall) >= least and min(fall) >= -AT_COST * np.mean(fall)  # not so where a square is no number
        if not worth or _takes_motion(best.signals, slower.signals):
            return best
        best, least = slower, WORTH_A_STEP


def joint_by_joint(best: R, own: R, read: Callable[[Band], R]) -> R:
    """The recordings with the position of each joint taken down by half octaves for as long as that alone helps.

    Only joints are asked that show noise below the cutoff, in the `own` bands of their motion, and no further down than
    these: a coarse encoder of one joint wants it, beside another whose motion is abrupt. A step helps as in
    `as_slow_as_torque`, by the sum over the joints: one joint's position has little part in the others' torque.
    """
    cutoff, bands = own.signals[0].cutoff, np.min([signals.bands for signals in own.signals], axis=0)
    limits: list[float | None] = [None] * len(bands)
    for joint in np.flatnonzero(bands < cutoff):
        while (lower := HALF_OCTAVE * (limits[joint] or cutoff)) > 0.99 * bands[joint]:
            slower = read((*limits[:joint], lower, *limits[joint + 1 :]))
            fall = np.log(best.squares / slower.squares)
            helps = fall.sum() >= WORTH_A_STEP and fall.min() >= -AT_COST * fall.sum()
            if not helps or _takes_motion(best.signals, slower.signals):
                break
            best, limits[joint] = slower, lower
    return best


def _takes_motion(before: Sequence[Signals], after: Sequence[Signals]) -> bool:
    """Whether a smaller band takes more of the accelerations of recordings kept out than of any that is fitted."""
    taken: dict[bool, list[np.ndarray]] = {True: [], False: []}
    for a, b in zip(before, after, strict=True):
        taken[a.role == "fit"].append(np.sqrt(np.mean((a.acceleration - b.acceleration) ** 2, axis=0)))
    held, fitted = (np.max(taken[own], axis=0, initial=0.0) for own in (False, True))
    return bool(np.any(held > MOVES_MORE * fitted))


def _refuse_endless(recording: Recording, time: Float[np.ndarray, " samples"], rates: Rates) -> None:
    """Raise `InputError` where the stamps span more than can be computed with: they are not in seconds, or one is off.

    A step between samples of 10 us to 1 s says in which unit they are.
    """
    seconds, step = float(time[-1] - time[0]), float(np.median(np.diff(time)))
    samples = seconds * max(rates.working, sampling_rate(time))
    if samples * len(recording.joints) <= MOST_NUMBERS:
        return
    units = [unit for unit, size in (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)) if 1e-5 <= step * size <= 1]
    advice = f"the stamps look like {units[0]}: add units: {{time: {units[0]}}}" if units else "is a stamp far off?"
    raise InputError(
        f"{recording.file}: its stamps span {seconds:.3g} s with {step:.3g} s between samples, which at"
        f" {rates.working:.4g} Hz would be {samples:.2g} samples of {len(recording.joints)} joints; {advice}"
    )


def _bands(
    position: Float[np.ndarray, "samples nv"],
    dt: float,
    cutoff: float,
    raw: Float[np.ndarray, "read nv"],
    rate: float,
    band: Band,
) -> Float[np.ndarray, " nv"]:
    """The band of each joint's motion, Hz, and `band` where it does not show below the `cutoff`; a tuple says them all.

    `raw` are the samples as they were read, at `rate` (Hz): they show the steps of the encoder.
    """
    if band is None:
        return np.full(position.shape[1], cutoff)
    if isinstance(band, tuple):
        return np.array([min(limit or cutoff, cutoff) for limit in band])
    steps = [encoder_step(column) for column in raw.T]
    own = np.array([motion_band(x, dt, cutoff, step, rate) for x, step in zip(position.T, steps, strict=True)])
    return np.where(own < cutoff, own, min(cutoff, band))


def let_through(
    position: Float[np.ndarray, "samples nv"], dt: float, cutoff: float, bands: Float[np.ndarray, " nv"]
) -> Float[np.ndarray, "samples nv"]:
    """The position of each joint without what lies above the cutoff, or above its band where that is below (Hz)."""
    out = low_pass(position, dt, cutoff)
    for joint in np.flatnonzero(bands < cutoff):
        out[:, joint] = smoothed(position[:, joint], dt, float(bands[joint]))
    return out


def choose_rates(recordings: Sequence[Recording], preprocess: Preprocess) -> Rates:
    """Working rate, output rate and cutoff for all recordings of a task; the slowest recording decides.

    Default cutoff 20 Hz, at most 0.2 of the recording's rate; default output rate about 3.3 times the cutoff. The
    working rate is a whole multiple of the output rate; it lies above the recording's own where that is below 12
    times the cutoff, because differences and friction signs need the finer samples, and is 13.2 times the cutoff for
    long data that it would else sample more than 16 times as fast.
    """
    raw, file = min(
        (sampling_rate(read_clock(recording.time, recording.position)), str(recording.file)) for recording in recordings
    )
    cutoff = preprocess.cutoff or min(DEFAULT_CUTOFF, 0.2 * raw)
    if cutoff >= raw / 2:
        raise InputError(
            f"{file}: preprocess.cutoff {cutoff:g} Hz is not below half of the recording's rate of {raw:.5g} Hz"
        )
    if preprocess.rate is not None:
        if preprocess.rate > raw * 1.001:
            raise InputError(f"{file}: preprocess.rate {preprocess.rate:g} Hz is above the recording's {raw:.5g} Hz")
        step = max(1, round(WORKING * cutoff / preprocess.rate))
        return Rates(step * preprocess.rate, step, cutoff)
    if raw < 12 * cutoff:
        return Rates(WORKING * cutoff, round(WORKING / ROWS), cutoff)
    working = raw / int(raw / (12 * cutoff))  # a whole divisor needs no interpolation between samples
    long = working * sum(recording.time[-1] - recording.time[0] for recording in recordings) > LONG
    if long and working > MOST_WORKING * cutoff:
        return Rates(WORKING * cutoff, round(WORKING / ROWS), cutoff)
    return Rates(working, max(1, round(working / (ROWS * cutoff))), cutoff)


def _window(recording: Recording, window: tuple[float, float] | None):
    """The part of a recording that is kept."""
    time = read_clock(recording.time, recording.position)
    position, torque = recording.position, recording.torque
    if torque is not None:
        new = _new_samples(position, torque)
        time, position, torque = time[new], position[new], torque[new]
    if window is None:
        return time, position, torque
    keep = (time >= window[0]) & (time <= window[1])
    if keep.sum() < 2:
        raise InputError(
            f"{recording.file}: preprocess.window [{window[0]:g}, {window[1]:g}] s keeps nothing of this recording,"
            f" which lasts from {time[0]:g} to {time[-1]:g} s"
        )
    return time[keep], position[keep], None if torque is None else torque[keep]


def _new_samples(
    position: Float[np.ndarray, "samples nq"], torque: Float[np.ndarray, "samples nv"]
) -> Bool[np.ndarray, " samples"] | slice:
    """The samples that are not, number by number, what stood there a sample before, where such ones are few.

    A logger that is faster than its robot, or has missed a message, writes the last one again under a new stamp: the
    position stands still for a sample and then leaps.
    """
    same = [(np.diff(x, axis=0) == 0).all(axis=1) for x in (position, torque)]
    again = np.append(False, same[0] & same[1])
    begin, end = (np.flatnonzero(np.diff(np.append(np.append(0, again), 0)) == step) for step in (1, -1))
    for first, after in zip(begin, end, strict=True):
        again[first:after] &= after - first <= MOST_STALE  # longer, it stands
    return ~again if 0 < again.mean() < STALE else slice(None)


def _resample(grid: Grid, rates: Rates, shift: float):
    """Times and columns at the working rate; columns whose rate is right already pass unchanged."""
    begin = shift if shift >= 0 else shift + rates.row
    count = int(((len(grid.columns[0]) - 1) / grid.rate - begin) * rates.working + 1e-6) + 1
    at = grid.start + begin + np.arange(max(count, 1)) / rates.working
    if shift == 0 and abs(grid.rate / rates.working - 1) < 1e-9:
        return at, grid.columns
    slower = min(grid.rate, rates.working)
    passed = min(3 * rates.cutoff, 0.4 * slower)
    edges = {"start": grid.start, "rate": grid.rate, "passed": passed, "stopped": slower - passed}
    widths = np.cumsum([x.shape[1] for x in grid.columns])[:-1]
    return at, tuple(np.split(band_limited(np.concatenate(grid.columns, axis=1), at, **edges), widths, axis=1))


def _weight(recording: Recording, preprocess: Preprocess, rows: RowFilter, velocity, gaps, cutoff: float):
    """0 for the rows near a gap that the filter cannot bridge, and below a joint's gate; else 1."""
    weight = np.ones((rows.kept, velocity.shape[1]))
    reach = 0.5 / cutoff
    for begin, end in _long(gaps, cutoff):
        weight[(rows.row_times > begin - reach) & (rows.row_times < end + reach)] = 0.0
    for joint, least in preprocess.gate.items():
        if joint not in recording.joints:
            hint = nearest(joint, recording.joints)
            raise InputError(f"{recording.file}: preprocess.gate: no moving joint '{joint}'{hint}")
        column = recording.joints.index(joint)
        weight[np.abs(velocity[rows.index, column]) < least, column] = 0.0
    return weight


def _long(gaps, cutoff: float) -> list[tuple[float, float]]:
    """Gaps that hide a quarter of the fastest period that passes."""
    return [(begin, end) for begin, end in gaps if end - begin > 0.25 / cutoff]


def _clock_notes(recording: Recording) -> tuple[str, ...]:
    clock, stamps = read_clock(recording.time, recording.position), unrounded(recording.time)
    off = float(np.std(clock - stamps))
    if off == 0:
        return ()
    return (
        f"{recording.name}: its time stamps shake by {1e3 * off:.2g} ms (RMS) about an even clock on which the motion"
        " is smoother: that clock is used",
    )


def _gap_notes(recording: Recording, gaps, cutoff: float) -> tuple[str, ...]:
    if not gaps:
        return ()
    begin, end = max(gaps, key=lambda gap: gap[1] - gap[0])
    left_out, one = len(_long(gaps, cutoff)), len(gaps) == 1
    said = f"rows near {left_out} of them are left out, the others are bridged"
    if left_out == 0:
        said = f"{'it is' if one else 'all are'} bridged"
    elif left_out == len(gaps):
        said = f"rows near {'it' if one else 'them'} are left out"
    return (
        f"{recording.name}: {len(gaps)} gap{'s' * (len(gaps) > 1)} in the time stamps, the longest {end - begin:.3g} s"
        f" at {begin:.4g} s; {said}",
    )


def align(first: Signals, second: Signals) -> int:
    """Rows by which `second` is late: row k of `first` repeats row k + shift of `second`.

    The shift has the smallest mean square difference of the low-passed positions where they then overlap (at least
    half of the shorter one); of equally good ones, as in a periodic motion, the smallest.
    """
    return round(_late_rows(first, second))


def common_rows(first: Signals, second: Signals) -> tuple[slice, slice]:
    """The rows of `first` and of `second` that belong together: `r1[a] - r2[b]` is the difference of two repeats."""
    shift = align(first, second)
    begin, end = max(0, -shift), min(first.rows.kept, second.rows.kept - shift)
    return slice(begin, end), slice(begin + shift, end + shift)


def apart(first: Signals, second: Signals) -> float:
    """Difference of two recordings' positions where they belong together, over the joint's range (both as standard
    deviations), at the joint where it is largest; infinite where no rows do."""
    own, other = common_rows(first, second)
    if own.stop <= own.start:
        return math.inf
    q, p = first.position[first.rows.index[own]], second.position[second.rows.index[other]]
    motion = q.std(axis=0)
    return float(((q - p).std(axis=0) / np.maximum(motion, 1e-3 * max(float(motion.max()), 1e-12))).max())


def moves_as(one: Signals, others: Iterable[Signals]) -> Signals | None:
    """The first of the others that moves as this recording does."""
    return next((other for other in others if apart(other, one) <= SAME_MOTION), None)


def kept_out_in_vain(signals: Sequence[Signals]) -> tuple[str, ...]:
    """Notes on recordings that are kept out of the fit, but move as a fitted one: they say nothing of other motions."""
    fitted = [one for one in signals if one.role == "fit"]
    judged = [one for one in signals if one.role == "holdout" and one.torque is not None]
    return tuple(
        f"{one.name} is kept out of the fit but moves as {like.name} does: its error shows how well the model repeats"
        " that motion, not how it predicts others"
        for one in judged
        if (like := moves_as(one, fitted)) is not None
    )


def _late_rows(first: Signals, second: Signals) -> float:
    """Rows by which `second` is late, between whole rows too."""
    if abs(first.dt / second.dt - 1) > 1e-3:
        raise InputError(f"{second.file}: {1 / second.dt:.5g} Hz, but its repeat {first.file} has {1 / first.dt:.5g}")
    late = second.time[0] - first.time[0] + _lag(first.position, second.position) * first.dt
    return (first.rows.row_times[0] + late - second.rows.row_times[0]) / (first.rows.step * first.dt)


def _lag(x: Float[np.ndarray, "n nv"], y: Float[np.ndarray, "m nv"]) -> float:
    """Samples l, between whole ones too, that make x[i] nearest to y[i + l] in the mean square over the overlap."""
    centre, scale = x.mean(axis=0), x.std(axis=0)
    scale = np.where(scale > 1e-6 * max(scale.max(), 1e-12), scale, np.inf)
    x, y = (x - centre) / scale, (y - centre) / scale
    lags = np.arange(1 - len(x), len(y))
    begin, end = np.maximum(0, -lags), np.minimum(len(x), len(y) - lags)
    size = fast_length(len(x) + len(y) - 1)
    product = np.fft.irfft(np.conj(np.fft.rfft(x, size, axis=0)) * np.fft.rfft(y, size, axis=0), size, axis=0)
    power_x, power_y = (np.concatenate([[0.0], np.cumsum((z**2).sum(axis=1))]) for z in (x, y))
    power = power_x[end] - power_x[begin] + power_y[end + lags] - power_y[begin + lags]
    distance = (power - 2 * product.sum(axis=1)[lags]) / (end - begin)
    distance[end - begin < min(len(x), len(y)) / 2] = np.inf
    good = np.flatnonzero(distance <= 1.05 * distance.min() + 1e-9)
    best = good[np.argmin(np.abs(lags[good]))]
    left, middle, right = distance[best - 1 : best + 2] if 0 < best < len(lags) - 1 else (np.inf,) * 3
    curvature = left - 2 * middle + right
    within = 0.5 * (left - right) / curvature if 0 < curvature < np.inf else 0.0
    return float(lags[best] + np.clip(within, -1.0, 1.0))  # the nearest to no lag need not be the smallest distance
