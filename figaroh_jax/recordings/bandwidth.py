"""How fast a joint really moves, and its position smoothed no faster than that.

Above some frequency a recorded position holds nothing but the noise and the steps of its encoder, which two
derivatives make large. Left in the regressor, that noise stands in the residual and in every candidate's column at
once, and clean data look as if they had a cause (errors in variables). So the band of each joint is chosen where the
acceleration is in error least: by what the smoothing takes off the motion and by what it leaves of the noise.

Errors that are no white noise (a sensor that shakes, stamps that jitter) look like motion. The torque tells them apart:
what moves the model's torque above some frequency and not the measured one is none (`signals.as_slow_as_torque`).
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

__all__ = ["Band", "encoder_step", "motion_band", "note_on", "smoothed"]

# Hz, that positions are taken down to where they show no band of their own below the cutoff; None: all are left at the
# cutoff; a tuple: where each joint's are taken down to, or None
Band = float | None | tuple[float | None, ...]

ORDER = 3  # of the differences that smoothing holds small: gain 1 / (1 + (f / band)^(2 ORDER))
STEPS = 2.0 ** (-np.arange(13) / 2)  # bands tried, as shares of the cutoff
WINDOW = 14.0  # Kaiser: what the motion leaks stays 100 dB below it
CHANCE = 12.0  # times its mean: power that noise reaches at one frequency in a hundred thousand
WORTH = 0.5  # share of the error in the acceleration at the cutoff below which a smaller band is taken
FEWEST = 200  # samples from which a spectrum tells motion and noise apart
FELT = 0.1  # of the noise's power: steps of less are lost in it
FEW_VALUES = 20  # of a position: fewer are steps
LINE = 3  # bins to either side to which the window spreads a line
AT_ONCE = 64  # stretches, for the memory that they take
TOLD = 0.05  # of the power, that smoothing must take off for what it takes to be told
READINGS = 4  # of a motion by an encoder, each with its steps at another place
STRETCH = 1.0  # s in which a motion that is short may show, and no less than 20 periods of the cutoff


def note_on(band: Band) -> tuple[str, ...]:
    """What is told of positions that `signals.as_slow_as_torque` has taken down."""
    if not isinstance(band, float) or math.isinf(band):
        return ()
    return (
        f"positions are smoothed to {band:.3g} Hz: faster motion in them changes the model's torque, but the measured"
        " torque does not follow it, so it is taken for an error of the position sensors",
    )


def motion_band(
    position: Float[np.ndarray, " samples"],
    dt: float,
    cutoff: float,
    step: float = 0.0,
    rate: float | None = None,
) -> float:
    """Frequency (Hz, at most `cutoff`) up to which a position (rad or m, every `dt` s) holds more motion than noise.

    The noise is taken as white in the position, at its level between one and two and a half times the cutoff, but
    nowhere as less than what the `step` of an encoder makes of such a motion (`_stepping`). Motion is asked of the
    recording as a whole and of short stretches of it: a start from rest, or a corner of the acceleration, is lost in
    the noise of all the rest. `rate` (Hz) is that of the recording, where it is not 1/dt: above 0.4 of it the samples
    hold nothing.
    """
    if len(position) < FEWEST:
        return cutoff
    frequency, power = _position_spectrum(position, dt)
    top = 2.5 * cutoff if rate is None else min(2.5 * cutoff, max(0.4 * rate, 1.1 * cutoff))
    high = (frequency > cutoff) & (frequency < top)
    if not high.any():
        return cutoff
    low = (frequency > 0) & (frequency < 2 * cutoff)
    noise = np.full(int(low.sum()), float(power[high].mean()))
    steps = None
    if step**2 / 12 > FELT * noise[0] * (rate or 1 / dt) * dt:
        steps = _stepping(position, dt, cutoff, step, rate or 1 / dt, frequency, power)
        noise = np.maximum(noise, _line_by_line(steps, 1 / (rate or 1 / dt), dt, frequency)[low])
    weight, motion = frequency[low] ** 4, np.where(power[low] > CHANCE * noise, power[low] - noise, 0.0)
    gain = 1 / (1 + (frequency[low] / (cutoff * STEPS[:, None])) ** (2 * ORDER))
    error = ((1 - gain) ** 2 * motion + gain**2 * noise) @ weight
    best = int(np.argmin(error))
    if error[best] >= WORTH * error[0]:
        return cutoff
    left = position - smoothed(position, dt, cutoff * STEPS[best])
    short = _in_stretches(left, dt, cutoff, (1 - gain[best]) ** 2, frequency[low], noise, steps, rate or 1 / dt)
    error = ((1 - gain) ** 2 * np.maximum(motion, short) + gain**2 * noise) @ weight
    return float(cutoff * STEPS[max(int(np.argmin(error)), 1)])


def encoder_step(position: Float[np.ndarray, " samples"]) -> float:
    """Step of the encoder that a position was read from (its unit); zero where the samples do not show one.

    The small distances between neighbours among the values that occur, where nearly all are whole multiples of them.
    """
    gaps = np.diff(np.unique(position))
    if len(gaps) < FEW_VALUES:
        return float(gaps.min()) if len(gaps) else 0.0
    step = float(np.median(gaps[gaps <= 1.5 * np.quantile(gaps, 0.1)]))
    off = np.abs(gaps / step - np.rint(gaps / step))
    return step if np.mean(off < 0.1) > 0.9 else 0.0


def _stepping(
    position: np.ndarray, dt: float, cutoff: float, step: float, rate: float, frequency: np.ndarray, power: np.ndarray
) -> Float[np.ndarray, "readings read"]:
    """Errors that an encoder's `step` makes of the position's own motion, read at `rate` (Hz).

    Slow motion makes a sawtooth of |v| / step Hz, whose lines stand far below the encoder's Nyquist frequency and far
    above its mean error. So the motion, smoothed until no more than twice the variance of the steps (step^2 / 12) is
    taken off, is read once more, at several places of its steps.
    """
    above = 2 * np.cumsum(power[::-1])[::-1] / len(position)
    first = int(np.argmax(above <= 2 * step**2 / 12))
    smooth = smoothed(position, dt, min(max(frequency[first], cutoff * STEPS[-1]), cutoff))
    time = np.arange(len(smooth)) * dt
    read = np.interp(np.arange(0, time[-1], 1 / rate), time, smooth)
    offset = np.arange(READINGS)[:, None] / READINGS
    return step * (np.round(read / step + offset) - offset) - read


def _line_by_line(
    error: Float[np.ndarray, "readings *stretches read"], every: float, dt: float, frequency: np.ndarray
) -> Float[np.ndarray, "*stretches freqs"]:
    """Power of readings' errors (samples `every` s), at frequencies of a position's spectrum (samples `dt` s apart).

    It is averaged over the readings and over a fifth of the frequency, and is nowhere less than that of a line close
    by.
    """
    window = np.kaiser(error.shape[-1], WINDOW)
    each = np.abs(np.fft.rfft((error - error.mean(-1, keepdims=True)) * window)) ** 2
    each = each.mean(0) / (window**2).sum() * (every / dt)
    place = frequency * error.shape[-1] * every
    low = np.minimum(place.astype(int), each.shape[-1] - 2)
    seen = each[..., low] + (place - low) * (each[..., low + 1] - each[..., low])
    seen = np.where(place <= each.shape[-1] - 1, seen, 0.0)
    whole, place = np.cumsum(seen, axis=-1), np.arange(seen.shape[-1])
    whole = np.concatenate([np.zeros_like(whole[..., :1]), whole], axis=-1)
    reach = np.maximum(place // 10, LINE)
    begin, end = np.maximum(place - reach, 0), np.minimum(place + reach + 1, len(place))
    padded = np.pad(seen, [(0, 0)] * (seen.ndim - 1) + [(LINE, LINE)])
    line = np.lib.stride_tricks.sliding_window_view(padded, 2 * LINE + 1, axis=-1).max(-1)
    return np.maximum((whole[..., end] - whole[..., begin]) / (end - begin), line)


def _in_stretches(
    left: np.ndarray,
    dt: float,
    cutoff: float,
    taken: np.ndarray,
    frequency: np.ndarray,
    noise: np.ndarray,
    steps: np.ndarray | None,
    rate: float,
) -> Float[np.ndarray, " freqs"]:
    """Power of the motion that shows in what smoothing has `left` of a position, in stretches of `STRETCH`, each begun
    a quarter further on: more than the `noise`, of both of which smoothing leaves the share that it has `taken` off.

    Slow motion is gone from it, which would spread to all frequencies of a stretch. `steps` are errors of readings at
    `rate` (Hz), of which each stretch has its own.
    """
    second, samples = np.diff(left, 2), round(max(STRETCH, 20.0 / cutoff) / dt)
    if len(second) <= samples:
        return np.zeros_like(noise)
    begins = np.append(np.arange(0, len(second) - samples, max(samples // 4, 1)), len(second) - samples)
    window, own = np.kaiser(samples, WINDOW), np.fft.rfftfreq(samples, dt)
    share = np.append(np.inf, (2 * np.sin(np.pi * own[1:] * dt)) ** 4) * (window**2).sum()
    white, above = np.interp(own, frequency, noise), np.zeros_like(own)
    part = np.interp(own, frequency, taken)
    parts = np.lib.stride_tricks.sliding_window_view(second, samples)
    for some in np.array_split(begins, math.ceil(len(begins) / AT_ONCE)):
        power, usual = np.abs(np.fft.rfft(parts[some] * window)) ** 2 / share, white
        if steps is not None:
            read = round(samples * dt * rate)
            at = np.minimum(np.round(some * dt * rate).astype(int), steps.shape[1] - read)
            local = np.lib.stride_tricks.sliding_window_view(steps, read, axis=1)[:, at]
            usual = np.maximum(white, _line_by_line(local, 1 / rate, dt, own))
        above += np.where(power > CHANCE * part * usual, power - part * usual, 0.0).sum(0) / len(begins)
    return np.interp(frequency, own, np.where(part > TOLD, above / np.maximum(part, TOLD), 0.0))


def smoothed(position: Float[np.ndarray, " samples"], dt: float, band: float) -> Float[np.ndarray, " samples"]:
    """The position nearest to the one given whose third differences are held small, with gain 1/2 at `band` (Hz).

    min |x - q|^2 + |D^3 x|^2 / (2 sin(pi band dt))^6 (Whittaker 1923): without phase, and free at both ends, where a
    filter would have to invent samples.
    """
    from scipy.linalg import solveh_banded  # scipy is slow to import

    count, strength = len(position), (2 * np.sin(np.pi * band * dt)) ** (-2 * ORDER)
    stencil = np.array([-1.0, 3.0, -3.0, 1.0])
    banded = np.zeros((ORDER + 1, count))
    for k in range(ORDER + 1):  # k-th lower diagonal of D'D
        for row in range(ORDER + 1 - k):
            banded[k, row : count - ORDER + row] += strength * stencil[row] * stencil[row + k]
    banded[0] += 1.0
    middle = position.mean()  # keeps the rounding of the solution that of the motion
    return middle + solveh_banded(banded, position - middle, lower=True)


def _position_spectrum(position: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies and power of the position, from its second differences (which leak less)."""
    second = np.diff(position, 2)
    window = np.kaiser(len(second), WINDOW)
    power = np.abs(np.fft.rfft((second - second.mean()) * window)) ** 2 / (window**2).sum()
    frequency = np.fft.rfftfreq(len(second), dt)
    power[1:] /= (2 * np.sin(np.pi * frequency[1:] * dt)) ** 4
    return frequency, power
