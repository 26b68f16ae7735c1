"""The one linear zero-phase filter that torque and every regressor column pass through, in NumPy and in JAX.

It is an order-4 Butterworth low pass run forward and backward (gain 0.5 at the cutoff, no phase), applied as a
product in the frequency domain over a record extended at both ends. Its gain is the exact response of the
bilinear-transformed filter, so it equals `scipy.signal.sosfiltfilt` away from the ends.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float, Inexact, Int, Shaped

from ..compiled.batching import traced
from ..compiled.machine_code import library

__all__ = [
    "RowFilter",
    "extension",
    "fast_length",
    "filter_rows",
    "filtered",
    "frequencies",
    "gain",
    "in_machine_code",
    "low_pass",
    "on_host",
    "reach",
    "row_filter",
]

ORDER = 4
REACH = 12.0  # impulse response that is kept beyond each end, in 1/cutoff
LATEST = 0.5  # s: at least as much, so that a delay or lag of tens of milliseconds stays inside the extension as well
MOST_STRETCHES = 64  # of an index that is followed stretch by stretch
FROM = 16_384  # places of all extended records from which machine code is worth its compilation
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
    return on_host(np.asarray(source), np.asarray(place))(np.asarray(signal), np.asarray(response))


def on_host(
    source: Int[np.ndarray, " length"], place: Int[np.ndarray, " rows"]
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """`filtered` of a signal and a response in NumPy: what depends on the record alone is made once.

    Where only every second, fifth, ... number is asked for, the spectrum is folded before it is transformed back.
    """
    length = len(source)
    step = int(np.gcd.reduce(place - place[:1], initial=length))
    first = int(place[0]) % step if len(place) else 0
    extended, wanted, count = _taking(np.roll(source, -first)), _taking(place // step), length // step

    def run(signal: np.ndarray, response: np.ndarray) -> np.ndarray:
        spectrum = np.fft.rfft(extended(signal), axis=-1)
        shape = np.broadcast_shapes(spectrum.shape, response.shape)  # memory that is new takes longer than the product
        factor = np.asarray(response, complex)  # as it is, its numbers would be converted for each series
        spectrum = np.multiply(spectrum, factor, out=spectrum if shape == spectrum.shape else None)
        return wanted(np.fft.irfft(_folded(spectrum, step, count), count, axis=-1))

    return run


_SIZES = ("count", "step", "samples", "slots", "rows", "responses", "used")
_ARRAYS = ("radix", "order", "row", "frequency", "root", "turn", "response", "first", "series", "slot", "signal", "out")


class _Given(ctypes.Structure):
    _fields_ = [(name, ctypes.c_long) for name in _SIZES] + [(name, ctypes.c_void_p) for name in _ARRAYS]


@lru_cache(maxsize=1)
def _code() -> Any:
    """The compiled function of `rowfilter.c`, or None."""
    found = library((Path(__file__).parent / "rowfilter.c").read_text(), "-O3")
    if found is None:
        return None
    function = found["filtered"]
    function.restype, function.argtypes = ctypes.c_int, [ctypes.c_void_p]
    return function


def in_machine_code(
    source: Int[np.ndarray, "n L"], place: Int[np.ndarray, "n M"]
) -> Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray], None] | None:
    """`filtered` of many series by `rowfilter.c`: `run(signal, response, of, slots, out)`; None where it cannot be.

    `signal` (series, n, N) goes through `response[of[series]]` into `out` (series, n, M), of the records `slots` alone.
    """
    slots, length = source.shape
    step = int(np.gcd.reduce((place - place[:, :1]).reshape(-1), initial=length))
    count, first = length // step, place[:, :1] % step if place.size else np.zeros((slots, 1), int)
    radix = _radices(count)
    code = None if source.size < FROM or radix is None else _code()
    if code is None or radix is None:
        return None
    rolled = source[np.arange(slots)[:, None], (np.arange(length) + first) % length]
    turns = np.arange(step)[:, None] * np.arange(length) % length
    root = np.exp(-2j * np.pi * np.arange(length) / length)
    known = {
        "radix": np.array([*radix, 1]),
        "order": np.swapaxes(rolled.reshape(slots, count, step), 1, 2),
        "row": place // step,
        "frequency": _left_at(radix),
        "root": root,
        "turn": root[turns] / length,
    }
    known = {name: np.ascontiguousarray(x) for name, x in known.items()}
    sizes = {"count": count, "step": step, "slots": slots, "rows": place.shape[1]}

    def run(
        signal: Float[np.ndarray, "series n N"],
        response: Inexact[np.ndarray, "responses F"],
        of: Int[np.ndarray, " series"],
        used: Int[np.ndarray, " used"],
        out: Float[np.ndarray, "series n M"],
    ) -> None:
        given, series = _Given(), np.argsort(of, kind="stable")
        first = np.searchsorted(of[series], np.arange(len(response) + 1))
        own = {"signal": np.ascontiguousarray(signal, float), "response": np.ascontiguousarray(response, complex)}
        arrays = known | own | {"first": first, "series": series, "slot": used, "out": out}
        for name, x in arrays.items():
            setattr(given, name, x.ctypes.data)
        more = {"samples": signal.shape[2], "responses": len(response), "used": len(used)}
        for name, size in (sizes | more).items():
            setattr(given, name, size)
        if not code(ctypes.byref(given)):
            raise MemoryError(f"{length} places of a record")

    return run


def _radices(count: int) -> list[int] | None:
    """Factors of a transform, each from two to five; None where there are others."""
    out = []
    for factor in (4, 2, 3, 5):
        while count % factor == 0 and count > 1:
            count //= factor
            out.append(factor)
    return out if count == 1 else None


def _left_at(radix: list[int]) -> Int[np.ndarray, " count"]:
    """The frequency that a transform in place leaves at each place, its stages going apart."""
    out = np.zeros(1, int)
    for factor in reversed(radix):
        out = (np.arange(factor)[:, None] + factor * out).reshape(-1)
    return out


def _folded(spectrum: Complex[np.ndarray, "*series freqs"], step: int, count: int) -> Complex[np.ndarray, "*series _"]:
    """Spectrum of every `step`th number, `count` in all: the mean of what it cannot tell apart."""
    if step == 1:
        return spectrum
    kept = count // 2 + 1
    out, back = spectrum[..., :kept].copy(), spectrum[..., count - kept + 1 : count + 1].copy()
    for m in range(2, step // 2 + 1):
        back += spectrum[..., m * count - kept + 1 : m * count + 1]
    for m in range(1, (step + 1) // 2):
        out += spectrum[..., m * count : m * count + kept]
    out += np.conjugate(back, out=back)[..., ::-1]
    out *= 1 / step
    return out


def _taking(index: Int[np.ndarray, " places"]) -> Callable[[np.ndarray], np.ndarray]:
    """`np.take(..., index, axis=-1)` of an index that runs up, runs down or stays over a few long stretches."""
    stretches, at = [], 0
    change = np.append(np.diff(index), 2)
    turns = np.flatnonzero(np.diff(change)) + 1  # where another stretch begins, or one number stands between two
    while at < len(index) and len(stretches) < MOST_STRETCHES:
        step, first = int(change[at]), int(index[at])
        end = at + 1 if abs(step) > 1 else int(turns[np.searchsorted(turns, at, "right")]) + 1
        last = first + step * (end - at)
        here = slice(first, first + 1) if step == 0 or end == at + 1 else slice(first, None if last < 0 else last, step)
        stretches.append((slice(at, end), here))
        at = end
    if at < len(index):
        return lambda x: np.take(x, index, axis=-1)

    def taken(x: np.ndarray) -> np.ndarray:
        out = np.empty((*x.shape[:-1], len(index)), x.dtype)
        for to, here in stretches:
            out[..., to] = x[..., here]
        return out

    return taken


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
