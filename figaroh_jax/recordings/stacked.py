"""Recordings on one clock, stacked and padded to one shape, and the one linear filter that every torque row passes.

Everything that is compared with the measured torque (the torque itself, each regressor column) goes through
`filter_rows`: the squared response of the row filter, a further response (whitening, delay, lag), the rows kept.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float, Inexact, Int, Shaped

from ..rigid.model import Leaf, RobotModel
from .dataset import carried_body
from .rowfilter import extension, fast_length, gain, on_host, reach
from .signals import Signals

__all__ = ["Records", "filter_rows", "filtered_rows", "open_rows", "stack"]

AT_ONCE = 100_000  # numbers of series that are filtered at once: their spectra stay in the processor's cache


class Records(eqx.Module):
    """`n` recordings of at most `N` samples at one period, and of at most `M` rows; short ones are padded."""

    time: Float[Leaf, "n N"]  # s
    position: Float[Leaf, "n N nq"]  # rad or m, low-passed
    velocity: Float[Leaf, "n N nv"]
    acceleration: Float[Leaf, "n N nv"]
    torque: Float[Leaf, "n N nv"]  # N m or N, as measured
    source: Int[Leaf, "n L"]  # sample that stands at each place of the extended record
    kept: Int[Leaf, "n M"]  # place of each row in the extended record
    weight: Float[Leaf, "n M nv"]  # what a row of the fit is multiplied by, at most 1; 0: not fitted
    judged: Float[Leaf, "n M nv"]  # 1: a row whose error counts in N m; 0: gated, gap, padding, holdout
    low_pass: Float[Leaf, " F"]  # response of the row filter
    omega: Float[Leaf, " F"]  # rad/s
    dt: Float[Leaf, ""] | float  # s, of the samples
    rate: Float[Leaf, ""] | float  # Hz, of the rows
    cutoff: Float[Leaf, ""] | float  # Hz
    carried: Float[Leaf, "n links 10"] | None = None  # known bodies on the links, at and in their joint frames

    @property
    def fitted(self) -> Float[np.ndarray, "n M nv"]:
        """1 for the rows of the fit, whatever their weight."""
        return (np.asarray(self.weight) > 0).astype(float)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Recordings, samples, rows, coordinates."""
        n, samples, nv = self.velocity.shape
        return n, samples, self.kept.shape[1], nv

    def flat(self, signal: Shaped[Leaf, "n N *rest"]) -> Shaped[Leaf, "nN *rest"]:
        """The samples of all recordings on one axis."""
        return signal.reshape(-1, *signal.shape[2:])

    def row_samples(self) -> Int[np.ndarray, "n M"]:
        """Sample of each row."""
        return np.take_along_axis(np.asarray(self.source), np.asarray(self.kept), axis=1)


def filter_rows(
    records: Records,
    torque: Float[np.ndarray, "*series n N"],
    response: Shaped[np.ndarray, "... F"] | None = None,
    fitted: bool = False,
) -> Float[np.ndarray, "*series n M"]:
    """Rows of torques or columns: low-passed without phase, times `response`, at the rows' samples.

    `response` (real or complex, over `records.omega`) may lack series, or hold one for all of an axis. On the host:
    the filter is linear, so that derivatives of a column pass it as columns do. `fitted`: rows of a recording of which
    none has a weight are zero.
    """
    series = torque.shape[:-2]
    factor = np.asarray(records.low_pass) if response is None else np.asarray(records.low_pass) * response
    count = int(np.prod(series))
    flat, out = torque.reshape(count, *torque.shape[-2:]), np.empty((count, *records.kept.shape))
    shared = factor.ndim == 1 or factor.size == factor.shape[-1]
    each = None if shared else np.broadcast_to(factor, (*series, factor.shape[-1])).reshape(count, factor.shape[-1])
    used = np.asarray(records.weight).any((1, 2)) if fitted else np.ones(len(records.kept), bool)
    out[:, ~used] = 0.0
    few = max(1, AT_ONCE // records.source.shape[1])
    parts = [slice(start, start + few) for start in range(0, count, few)]
    for k in np.flatnonzero(used):
        run = on_host(np.asarray(records.source[k]), np.asarray(records.kept[k]))
        for part in parts:
            out[part, k] = run(flat[part, k], factor.reshape(-1) if each is None else each[part])
    return out.reshape(*series, *records.kept.shape)


def open_rows(
    records: Records, torque: Float[np.ndarray, "nN nv"], response: Inexact[np.ndarray, " F"]
) -> Float[np.ndarray, "n M nv"]:
    """Rows of a torque at all samples, of all recordings and without a mask."""
    n, samples, _, nv = records.shape
    return np.moveaxis(filter_rows(records, torque.T.reshape(nv, n, samples), response), 0, 2)


def filtered_rows(
    records: Records, torque: Float[np.ndarray, "nN nv"], response: Inexact[np.ndarray, "F nv"]
) -> Float[np.ndarray, "nv T"]:
    """Rows of a torque at all samples through the row filter and `response`, masked."""
    n, samples, _, nv = records.shape
    rows = filter_rows(records, torque.T.reshape(nv, n, samples), response.T, fitted=True)
    return (rows * np.moveaxis(records.weight, 2, 0)).reshape(nv, -1)


def stack(signals: Sequence[Signals], model: RobotModel | None = None) -> Records:
    """The recordings as one; they must share period, row rate and cutoff (`signals.prepare_all` sees to that).

    With a `model`, the known loads stand in `carried`; `InputError` where one is fixed to what does not move.
    """
    first = signals[0]
    pad, samples = reach(first.dt, first.cutoff), max(s.time.size for s in signals)
    count = max(s.rows.kept for s in signals)
    length = fast_length(samples + 2 * pad)
    weight = _padded([s.rows.weight * (s.role == "fit") for s in signals], count, hold=False)
    return Records(
        time=_padded([s.time for s in signals], samples),
        position=_padded([s.position for s in signals], samples),
        velocity=_padded([s.velocity for s in signals], samples, hold=False),
        acceleration=_padded([s.acceleration for s in signals], samples, hold=False),
        torque=_padded([np.zeros_like(s.velocity) if s.torque is None else s.torque for s in signals], samples),
        source=np.stack([_extended(s, pad, length) for s in signals]),
        kept=_padded([s.rows.index + pad for s in signals], count),
        weight=weight,
        judged=weight,
        low_pass=gain(length, first.dt, first.cutoff),
        omega=2 * np.pi * np.fft.rfftfreq(length, first.dt),
        dt=first.dt,
        rate=1 / (first.dt * first.rows.step),
        cutoff=first.cutoff,
        carried=None if model is None else _carried(model, signals),
    )


def _carried(model: RobotModel, signals: Sequence[Signals]) -> Float[np.ndarray, "n links 10"] | None:
    """Ten parameters that known loads add to each link, recording by recording; None where nothing is carried."""
    if not any(one.load for one in signals):
        return None
    ten = np.zeros((len(signals), len(model.joints), 10))
    for one, own in zip(signals, ten, strict=True):
        if one.load:
            link, body = carried_body(model, one.load)
            own[link] = body
    return ten


def _extended(one: Signals, pad: int, length: int) -> Int[np.ndarray, " L"]:
    index = one.rows.index
    return extension(one.time.size, pad, length, int(index[0]), int(index[-1]), one.dt, one.cutoff)


def _padded(arrays: Sequence[Leaf], length: int, hold: bool = True) -> np.ndarray:
    """The arrays stacked; short ones hold their last value, or are zero from their end."""
    out = []
    for array in arrays:
        widths = [(0, length - len(array))] + [(0, 0)] * (array.ndim - 1)
        out.append(np.pad(array, widths, mode="edge") if hold else np.pad(array, widths))
    return np.stack(out)
