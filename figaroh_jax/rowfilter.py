"""The one linear zero-phase filter that torque and every regressor column pass through, in NumPy and in JAX.

It is an order-4 Butterworth low pass run forward and backward (gain 0.5 at the cutoff, no phase), applied as a
product in the frequency domain over a record extended by point reflection at both ends. Its gain is the exact
response of the bilinear-transformed filter, so it equals `scipy.signal.sosfiltfilt` away from the ends.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

__all__ = ["RowFilter", "fast_length", "filter_rows", "frequencies", "low_pass", "row_filter"]

ORDER = 4


class RowFilter(eqx.Module):
    """Low pass, trimmed ends and decimation: `samples` at the working rate become `kept` rows at the output rate.

    Static sizes come from the record alone, so that records of one length share one compiled program.
    """

    gain: Float[Array | np.ndarray, " freqs"]  # response of the low pass at `frequencies(rows)`
    dt: Float[Array | np.ndarray, ""]  # s between samples
    start: Float[Array | np.ndarray, ""]  # s, time of sample 0
    weight: Float[Array | np.ndarray, "kept nv"]  # 0 where a gate or a gap drops the row of a joint, else 1
    samples: int = eqx.field(static=True)
    pad: int = eqx.field(static=True)  # samples of extension at either end
    length: int = eqx.field(static=True)  # of the transform
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
    pad = _pad(samples, dt, cutoff)
    length = fast_length(samples + 2 * pad)
    first = int(np.ceil(trim / dt - 1e-6))
    kept = max(0, -((2 * first - samples) // step))
    gain = _gain(length, dt, cutoff)
    return RowFilter(
        gain, np.asarray(dt), np.asarray(start), np.ones((kept, nv)), samples, pad, length, first, step, kept
    )


def filter_rows(
    rows: RowFilter, x: Float[Array | np.ndarray, "samples *cols"], response: Complex[Array, " freqs"] | None = None
) -> Float[Array, "kept *cols"]:
    """Rows of every column of `x` after the low pass, times an extra `response` where one is given.

    `response` is sampled at `frequencies(rows)`: exp(-i w d) delays by d, 1 / (1 + i w T) lags with time constant T,
    both exactly. Precision follows the caller's JAX setting: enable 64 bits around the whole computation.
    """
    record = jnp.moveaxis(jnp.asarray(x), 0, -1)
    spectrum = jnp.fft.rfft(_extend(record, rows.pad, jnp), n=rows.length)
    gain = rows.gain if response is None else rows.gain * response
    filtered = jnp.fft.irfft(spectrum * jnp.broadcast_to(gain, spectrum.shape), n=rows.length)
    begin = rows.pad + rows.first
    kept = filtered[..., begin : begin + rows.step * (rows.kept - 1) + 1 : rows.step]
    return jnp.moveaxis(kept, -1, 0)


def frequencies(rows: RowFilter) -> Float[Array, " freqs"]:
    """Angular frequencies (rad/s) at which a `response` of `filter_rows` is sampled."""
    return 2 * jnp.pi * jnp.arange(rows.length // 2 + 1) / (rows.length * jnp.asarray(rows.dt))


def low_pass(x: Float[np.ndarray, "samples cols"], dt: float, cutoff: float) -> Float[np.ndarray, "samples cols"]:
    """The same low pass on the host, at every sample: `x` every `dt` s, `cutoff` in Hz."""
    pad = _pad(len(x), dt, cutoff)
    length = fast_length(len(x) + 2 * pad)
    spectrum = np.fft.rfft(_extend(x.T, pad, np), n=length) * _gain(length, dt, cutoff)
    return np.fft.irfft(spectrum, n=length)[:, pad : pad + len(x)].T


def fast_length(least: int) -> int:
    """The smallest length from `least` that a real FFT is quick at."""
    from scipy.fft import next_fast_len  # scipy is slow to import

    return int(next_fast_len(least, real=True) or least)


def _pad(samples: int, dt: float, cutoff: float) -> int:
    # The slowest pole decays with 0.42 / cutoff: after 10 / cutoff the jump at the wrap has faded below 1e-10.
    # Half a second at least, so that a delay or lag of tens of milliseconds stays inside the extension as well.
    return min(samples - 1, int(np.ceil(max(10 / cutoff, 0.5) / dt)))


def _gain(length: int, dt: float, cutoff: float) -> Float[np.ndarray, " freqs"]:
    """|H|^2 of the digital Butterworth filter, 1 / (1 + (tan(w dt / 2) / tan(wc dt / 2))^(2 order))."""
    half = np.pi * np.arange(length // 2 + 1) / length
    return 1 / (1 + (np.tan(half) / np.tan(np.pi * cutoff * dt)) ** (2 * ORDER))


def _extend(x, pad: int, xp):
    """Point reflection of the last axis at both ends: keeps value and slope."""
    head = 2 * x[..., :1] - x[..., pad:0:-1]
    tail = 2 * x[..., -1:] - x[..., -2 : -pad - 2 : -1]
    return xp.concatenate([head, x, tail], axis=-1)
