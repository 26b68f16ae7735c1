"""The one linear zero-phase filter that torque and every regressor column pass through, in NumPy and in JAX.

It is an order-4 Butterworth low pass run forward and backward (gain 0.5 at the cutoff, no phase), applied as a
product in the frequency domain over a record extended at both ends. Its gain is the exact response of the
bilinear-transformed filter, so it equals `scipy.signal.sosfiltfilt` away from the ends.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float, Inexact, Int, Shaped

from ..compiled.batching import traced

__all__ = [
    "Phases",
    "RowFilter",
    "extension",
    "fast_length",
    "filter_rows",
    "filtered",
    "frequencies",
    "gain",
    "low_pass",
    "reach",
    "row_filter",
]

ORDER = 4
REACH = 12.0  # impulse response that is kept beyond each end, in 1/cutoff
LATEST = 0.5  # s: at least as much, so that a delay or lag of tens of milliseconds stays inside the extension as well
END = 2.0  # part of a record at each end that is not used, in 1/cutoff


class RowFilter(eqx.Module):
    """Low pass, trimmed ends and decimation: `samples` at the working rate become `kept` rows at the output rate.

    Static sizes come from the record alone, so that records of one length share one compiled program.
    """

    gain: Float[Array | np.ndarray, " freqs"]  # response of the low pass at `frequencies(rows)`
    source: Int[Array | np.ndarray, " length"]  # sample that stands at each place of the extended record
    dt: Float[Array | np.ndarray, ""]  # s between samples
    start: Float[Array | np.ndarray, ""]  # s, time of sample 0
    weight: Float[Array | np.ndarray, "kept nv"]  # 0 where a gate or a gap drops the row of a joint, else 1
    samples: int = eqx.field(static=True)
    pad: int = eqx.field(static=True)  # samples of extension at either end
    first: int = eqx.field(static=True)  # sample of row 0
    step: int = eqx.field(static=True)  # samples from row to row
    kept: int = eqx.field(static=True)  # number of rows

    @property
    def index(self) -> Int[np.ndarray, " kept"]:
        """Sample of each kept row: `signals.position[rows.index]` is the position at the rows."""
        return self.first + self.step * np.arange(self.kept)

    @property
    def row_times(self) -> Float[np.ndarray, " kept"]:
        """Time of each kept row on the recording's clock, s."""
        return float(self.start) + float(self.dt) * self.index


def row_filter(samples: int, dt: float, cutoff: float, *, step: int, trim: float, start: float, nv: int) -> RowFilter:
    """Filter for a record of `samples` every `dt` s from time `start`; rows of weight 1.

    `cutoff` in Hz; `trim` s are cut at both ends; one sample of every `step` is kept.
    """
    pad = reach(dt, cutoff)
    length = fast_length(samples + 2 * pad)
    first = int(np.ceil(trim / dt - 1e-6))
    kept = max(0, -((2 * first - samples) // step))
    source = extension(samples, pad, length, first, first + step * (kept - 1), dt, cutoff)
    weight = np.ones((kept, nv))
    return RowFilter(
        gain(length, dt, cutoff), source, np.asarray(dt), np.asarray(start), weight, samples, pad, first, step, kept
    )


def filter_rows(
    rows: RowFilter, x: Float[Array | np.ndarray, "samples *cols"], response: Complex[ArrayLike, " freqs"] | None = None
) -> Float[Array | np.ndarray, "kept *cols"]:
    """Rows of every column of `x` after the low pass, times an extra `response` where one is given.

    `response` is sampled at `frequencies(rows)`: exp(-i w d) delays by d, 1 / (1 + i w T) lags with time constant T,
    both exactly. On the host in NumPy; in JAX under a transformation (jit, vmap, grad).
    """
    library: Any = jnp if traced(rows, x, response) else np
    factor = rows.gain if response is None else rows.gain * library.asarray(response)
    kept = filtered(library.moveaxis(library.asarray(x), 0, -1), rows.source, rows.pad + rows.index, factor)
    return library.moveaxis(kept, -1, 0)


def filtered(
    signal: Float[Array | np.ndarray, "*series samples"],
    source: Int[Array | np.ndarray, " length"],
    place: Int[Array | np.ndarray, " rows"],
    response: Shaped[Array | np.ndarray, "*responses freqs"],
) -> Float[Array | np.ndarray, "*series rows"]:
    """What stands at the places of the extended record after the `response` (which leads or equals the series)."""
    if traced(signal, source, response):
        spectrum = jnp.fft.rfft(signal[..., source], axis=-1) * response
        return jnp.fft.irfft(spectrum, source.shape[-1], axis=-1)[..., place]
    phases, one = Phases(np.asarray(source)[None], np.asarray(place)[None], signal.shape[-1]), np.zeros(1, int)
    spectra = phases.spectra(np.asarray(signal)[..., None, :], one)
    return phases.rows(spectra * phases.factors(np.asarray(response))[..., None, :, :], one)[..., 0, :]


class Phases:
    """`filtered` in NumPy, of many series of `n` records of `samples` whose rows stand a whole number of steps apart.

    A record goes apart into its `step` phases (places 0, step, ...; 1, 1 + step, ...), each transformed by itself: what
    the filter makes of every `step`th number has the sum of the phases' spectra as its own, each times that of the
    impulse response from its phase to the rows. These transforms stay in the nearest cache (four of 1296 numbers take
    15 us, one of 5184 takes 23), and only the numbers wanted are transformed back.
    """

    def __init__(self, source: Int[np.ndarray, "n L"], place: Int[np.ndarray, "n M"], samples: int) -> None:
        slots, length = source.shape
        self.step = int(np.gcd.reduce((place - place[:, :1]).reshape(-1), initial=length))
        self.count, self._length = length // self.step, length
        first = place[:, :1] % self.step if place.size else np.zeros((slots, 1), int)
        begun = (
            np.take_along_axis(source, (np.arange(length) + first) % length, 1) + samples * np.arange(slots)[:, None]
        )
        self._order = np.swapaxes(begun.reshape(slots, self.count, self.step), 1, 2).reshape(slots, length)
        self._rows = place // self.step
        self._turn = (self.step * np.arange(self.count) - np.arange(self.step)[:, None]) % length
        self._last: tuple[np.ndarray, np.ndarray] | None = None  # responses and their factors

    def factors(self, response: Inexact[np.ndarray, "*responses F"]) -> Complex[np.ndarray, "*responses step K"]:
        """Spectra of the impulse response, phase by phase; most responses are those of the call before."""
        if self._last is None or not np.array_equal(self._last[0], response):
            impulse = np.fft.irfft(response, self._length)
            self._last = response.copy(), np.fft.rfft(np.take(impulse, self._turn, axis=-1))
        return self._last[1]

    def spectra(
        self, signal: Float[np.ndarray, "*series n N"], used: Int[np.ndarray, " used"]
    ) -> Complex[np.ndarray, "*series used step K"]:
        """Spectra of the phases of the records `used`."""
        series = signal.shape[:-2]
        extended = np.take(signal.reshape(*series, -1), self._order[used].reshape(-1), axis=-1)
        return np.fft.rfft(extended.reshape(*series, len(used), self.step, self.count))

    def rows(
        self, spectra: Complex[np.ndarray, "*series used step K"], used: Int[np.ndarray, " used"]
    ) -> Float[np.ndarray, "*series used M"]:
        """Rows of the records `used`, whose phases' spectra have been multiplied by the `factors`."""
        wanted = np.fft.irfft(spectra.sum(axis=-2), self.count)
        place = (self._rows[used] + self.count * np.arange(len(used))[:, None]).reshape(-1)
        rows = np.take(wanted.reshape(*wanted.shape[:-2], -1), place, axis=-1)
        return rows.reshape(*wanted.shape[:-1], self._rows.shape[1])


def frequencies(rows: RowFilter) -> Float[np.ndarray, " freqs"]:
    """Angular frequencies (rad/s) at which a `response` of `filter_rows` is sampled."""
    length = rows.source.shape[0]
    return 2 * np.pi * np.arange(length // 2 + 1) / (length * np.asarray(rows.dt))


def low_pass(
    x: Float[np.ndarray, "samples cols"], dt: float, cutoff: float, order: int = ORDER
) -> Float[np.ndarray, "samples cols"]:
    """The same low pass on the host, at every sample: `x` every `dt` s, `cutoff` in Hz."""
    pad = min(len(x) - 1, reach(dt, cutoff))
    length = fast_length(len(x) + 2 * pad)
    head, tail = 2 * x[:1] - x[pad:0:-1], 2 * x[-1:] - x[-2 : -pad - 2 : -1]  # reflected in the end: value and slope
    spectrum = np.fft.rfft(np.concatenate([head, x, tail]).T, n=length) * gain(length, dt, cutoff, order)
    return np.fft.irfft(spectrum, n=length)[:, pad : pad + len(x)].T


@lru_cache(maxsize=256)
def fast_length(least: int) -> int:
    """The smallest length from `least` that a real FFT is quick at: a product of twos, threes and fives."""
    odd = (3**i * 5**k for i in range(20) for k in range(14))
    return min(n << max(-(-least // n) - 1, 0).bit_length() for n in odd)


def reach(dt: float, cutoff: float) -> int:
    """Samples that are put before and behind a record: the jump at the wrap has faded below 1e-10 there."""
    return int(np.ceil(max(REACH / cutoff, LATEST) / dt))


def gain(length: int, dt: float, cutoff: float, order: int = ORDER) -> Float[np.ndarray, " freqs"]:
    """|H|^2 of the digital Butterworth filter, 1 / (1 + (tan(w dt / 2) / tan(wc dt / 2))^(2 order))."""
    half = np.minimum(np.pi * np.arange(length // 2 + 1) / length, np.pi / 2 - 1e-9)
    return 1 / (1 + (np.tan(half) / np.tan(np.pi * cutoff * dt)) ** (2 * order))


def extension(
    samples: int, pad: int, length: int, first: int, last: int, dt: float, cutoff: float
) -> Int[np.ndarray, " length"]:
    """Sample at each place of a record that is extended by `pad` at both ends, for rows from sample `first` to `last`.

    The record is mirrored about samples a little inside of its ends: derivatives of the low-passed position are wrong
    at the ends, they would repeat with the motion, and a whitening filter would carry them far into the record. (An
    odd reflection would add twice the noise of the sample that it turns about.) What is left of `length` holds the
    outermost values.
    """
    inset = max(0, min(int(np.ceil(END / (cutoff * dt))), first, samples - 1 - last))
    place = np.arange(length) - pad
    begin, end = inset, samples - 1 - inset
    far = min(pad + inset, end - begin)
    past = np.clip(place, begin - far, end + far)
    past = np.where(place > samples - 1 + (length - samples - pad) // 2 + pad // 2, begin - far, past)
    return np.where(past < begin, 2 * begin - past, np.where(past > end, 2 * end - past, past))
