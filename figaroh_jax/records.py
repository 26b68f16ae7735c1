"""Recordings on one clock, stacked and padded to one shape, and the one linear filter that every torque row passes.

Everything that is compared with the measured torque (the torque itself, each regressor column) goes through
`filter_rows`: the squared response of the row filter, a further response (whitening, delay, lag), the rows kept.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, Shaped

from .model import Leaf
from .signals import Signals

__all__ = ["Records", "filter_rows", "stack"]

REACH = 12.0  # impulse response of the row filter that is kept beyond each end, in 1/cutoff
END = 2.0  # part of a record at each end that is not used, in 1/cutoff


class Records(eqx.Module):
    """`n` recordings of at most `N` samples at one period, and of at most `M` rows; short ones are padded."""

    time: Float[Leaf, "n N"]  # s
    position: Float[Leaf, "n N nv"]  # rad or m, low-passed
    velocity: Float[Leaf, "n N nv"]
    acceleration: Float[Leaf, "n N nv"]
    torque: Float[Leaf, "n N nv"]  # N m or N, as measured
    source: Int[Leaf, "n L"]  # sample that stands at each place of the extended record
    kept: Int[Leaf, "n M"]  # place of each row in the extended record
    weight: Float[Leaf, "n M nv"]  # 1: a row of the fit; 0: gated, gap, padding, holdout
    low_pass: Float[Leaf, " F"]  # response of the row filter
    omega: Float[Leaf, " F"]  # rad/s
    dt: Float[Leaf, ""] | float  # s, of the samples
    rate: Float[Leaf, ""] | float  # Hz, of the rows
    cutoff: Float[Leaf, ""] | float  # Hz

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Recordings, samples, rows, coordinates."""
        n, samples, nv = self.position.shape
        return n, samples, self.kept.shape[1], nv

    def flat(self, signal: Shaped[Leaf, "n N *rest"]) -> Shaped[Leaf, "nN *rest"]:
        """The samples of all recordings on one axis."""
        return signal.reshape(-1, *signal.shape[2:])

    def row_samples(self) -> Int[np.ndarray, "n M"]:
        """Sample of each row."""
        return np.take_along_axis(np.asarray(self.source), np.asarray(self.kept), axis=1)


def filter_rows(
    records: Records,
    columns: Float[Array, "n N *rest"],
    response: Shaped[Array, "F *series"] | None = None,
) -> Float[Array, "n M *rest"]:
    """Rows of `columns`: low-passed without phase, times `response`, at the rows' samples.

    `response` (real or complex, over `records.omega`) has the trailing axes of `columns` or leads them.
    """
    n, _, *rest = columns.shape
    flat = columns.reshape(n, columns.shape[1], -1)

    extended = jax.vmap(lambda x, source: x[source])(flat, records.source)
    factor: Shaped[Array, " F k"] = jnp.asarray(records.low_pass)[:, None]
    if response is not None:
        series = response.reshape(*response.shape, *[1] * (1 + len(rest) - response.ndim))
        factor = factor * jnp.broadcast_to(series, (response.shape[0], *rest)).reshape(response.shape[0], -1)
    spectrum: Complex[Array, "n F k"] = jnp.fft.rfft(extended, axis=1) * factor
    filtered = jnp.fft.irfft(spectrum, records.source.shape[1], axis=1)
    rows = jnp.take_along_axis(filtered, records.kept[:, :, None], axis=1)
    return rows.reshape(n, -1, *rest)


def stack(signals: Sequence[Signals]) -> Records:
    """The recordings as one; they must share period, row rate and cutoff (`signals.prepare_all` sees to that)."""
    from scipy.fft import next_fast_len  # scipy is slow to import

    first = signals[0]
    reach = int(np.ceil(max(REACH / first.cutoff, 0.5) / first.dt))
    samples = max(s.time.size for s in signals)
    count = max(s.rows.kept for s in signals)
    length = int(next_fast_len(samples + 2 * reach, real=True))  # pyright: ignore
    extended = [_extension(s.time.size, reach, length, _inset(s)) for s in signals]
    omega = 2 * np.pi * np.fft.rfftfreq(length, first.dt)
    return Records(
        time=_padded([s.time for s in signals], samples),
        position=_padded([s.position for s in signals], samples),
        velocity=_padded([s.velocity for s in signals], samples, hold=False),
        acceleration=_padded([s.acceleration for s in signals], samples, hold=False),
        torque=_padded([np.zeros_like(s.position) if s.torque is None else s.torque for s in signals], samples),
        source=np.stack(extended),
        kept=_padded([s.rows.index + reach for s in signals], count),
        weight=_padded([s.rows.weight * (s.role == "fit") for s in signals], count, hold=False),
        low_pass=butterworth_power(omega, first.cutoff, first.dt),
        omega=omega,
        dt=first.dt,
        rate=1 / (first.dt * first.rows.step),
        cutoff=first.cutoff,
    )


def butterworth_power(omega: Float[np.ndarray, " F"], cutoff: float, dt: float) -> Float[np.ndarray, " F"]:
    """Squared magnitude of a digital Butterworth low pass of order 4: 1 / (1 + (tan(w dt/2) / tan(wc dt/2))^8)."""
    ratio = np.tan(np.minimum(omega * dt / 2, np.pi / 2 - 1e-9)) / np.tan(np.pi * cutoff * dt)
    return 1 / (1 + ratio**8)


def _extension(samples: int, reach: int, length: int, inset: int) -> Int[np.ndarray, " L"]:
    """Samples mirrored about those `inset` from both ends; what is left of `length` holds the outermost values.

    An odd reflection would add twice the noise of the sample that it turns about.
    """
    place = np.arange(length) - reach
    end = samples - 1
    first, last = inset, end - inset
    far = min(reach + inset, last - first)
    past = np.clip(place, first - far, last + far)
    past = np.where(place > end + (length - samples - reach) // 2 + reach // 2, first - far, past)
    return np.where(past < first, 2 * first - past, np.where(past > last, 2 * last - past, past))


def _inset(one: Signals) -> int:
    """Samples at each end that no row may see: derivatives of the low-passed position are wrong there.

    They repeat with the motion, and a whitening filter would carry them far into the record.
    """
    kept = one.rows.index
    return max(0, min(int(np.ceil(END / (one.cutoff * one.dt))), int(kept[0]), one.time.size - 1 - int(kept[-1])))


def _padded(arrays: Sequence[Leaf], length: int, hold: bool = True) -> np.ndarray:
    """The arrays stacked; short ones hold their last value, or are zero from their end."""
    out = []
    for array in arrays:
        widths = [(0, length - len(array))] + [(0, 0)] * (array.ndim - 1)
        out.append(np.pad(array, widths, mode="edge") if hold else np.pad(array, widths))
    return np.stack(out)
