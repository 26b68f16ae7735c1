"""Recordings on one clock, stacked and padded to one shape, and the one linear filter that every torque row passes.

Everything that is compared with the measured torque (the torque itself, each regressor column) goes through
`filter_rows`: the squared response of the row filter, a further response (whitening, delay, lag), the rows kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Inexact, Int, Shaped

from ..rigid.model import Leaf, RobotModel
from .dataset import carried_body
from .rowfilter import Phases, extension, fast_length, gain, reach
from .signals import Signals

__all__ = ["Records", "filter_rows", "filtered_rows", "open_rows", "stack"]

FEW_SLOTS = 8  # more of them may be longer than the longest recording, where less is padded then
LONGER = (1.1, 1.15, 1.2, 1.3, 1.4, 1.5)  # times the longest recording
AT_ONCE = 200_000  # numbers of series that are filtered at once: with fewer calls cost more, more win nothing


class Span(NamedTuple):
    """Where a recording stands: its slot, and there its first sample and row, and how many there are."""

    slot: int
    sample: int
    samples: int
    row: int
    rows: int


class Records(eqx.Module):
    """`n` slots of at most `N` samples at one period, and of at most `M` rows; short ones are padded.

    A slot holds one recording, or several short ones behind each other (`stack`); `spans` says where each stands.
    """

    time: Float[Leaf, "n N"]  # s
    position: Float[Leaf, "n N nq"]  # rad or m, low-passed
    velocity: Float[Leaf, "n N nv"]
    acceleration: Float[Leaf, "n N nv"]
    torque: Float[Leaf, "n N nv"]  # N m or N, as measured
    source: Int[Leaf, "n L"]  # sample that stands at each place of the extended record
    kept: Int[Leaf, "n M"]  # place of each row in the extended record
    weight: Float[Leaf, "n M nv"]  # what a row of the fit is multiplied by, at most 1; 0: not fitted
    judged: Float[Leaf, "n M nv"]  # 1: a row whose error counts in N m; 0: gated, gap, padding, holdout
    standing: Float[Leaf, "n M nv"]  # 1: a row of a fit that is not judged because its joint stands
    low_pass: Float[Leaf, " F"]  # response of the row filter
    omega: Float[Leaf, " F"]  # rad/s
    dt: Float[Leaf, ""] | float  # s, of the samples
    rate: Float[Leaf, ""] | float  # Hz, of the rows
    cutoff: Float[Leaf, ""] | float  # Hz
    bands: Float[Leaf, "recordings nv"] | None = None  # Hz, up to which positions were let through where not the cutoff
    carried: Float[Leaf, "n links 10"] | None = None  # known bodies on the links, at and in their joint frames
    spans: tuple[Span, ...] = eqx.field(static=True, default=())  # of the recordings in their order

    __getattribute__ = object.__getattribute__  # methods as Python has them: equinox makes a module of each

    @property
    def joins(self) -> tuple[tuple[int, int], ...]:
        """Slot and sample of every recording that stands behind another one."""
        return tuple((s.slot, s.sample) for s in self.spans if s.sample)

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
    of: Int[np.ndarray, "..."] | None = None,
) -> Float[np.ndarray, "*series n M"]:
    """Rows of torques or columns: low-passed without phase, times `response`, at the rows' samples.

    `response` (real or complex, over `records.omega`) may lack series, or hold one for all of an axis; or it is a table
    (responses, F), and `of` says which of them each series has. On the host: the filter is linear, so that derivatives
    of a column pass it as columns do. `fitted`: rows of a recording of which none has a weight are zero.
    """
    series = torque.shape[:-2]
    factor = np.asarray(records.low_pass) if response is None else np.asarray(records.low_pass) * response
    count = int(np.prod(series))
    flat, out = torque.reshape(count, *torque.shape[-2:]), np.empty((count, *records.kept.shape))
    phases = _phases(records)
    of = np.arange(factor[..., 0].size).reshape(factor.shape[:-1]) if of is None else of
    needed, which = np.unique(np.broadcast_to(of, series), return_inverse=True)
    factors, which = phases.factors(factor.reshape(-1, factor.shape[-1])[needed])[:, None], which.reshape(count)
    fits = np.any(records.weight, axis=(1, 2)) if fitted else np.ones(len(records.kept), bool)
    used, out[:, ~fits] = np.flatnonzero(fits), 0.0
    few = max(1, AT_ONCE // max(1, len(used) * records.source.shape[1]))
    for part in (slice(start, start + few) for start in range(0, count, few)):
        spectra = phases.spectra(flat[part], used)
        spectra *= factors[which[part] if len(factors) > 1 else 0]
        out[part, used] = phases.rows(spectra, used)
    return out.reshape(*series, *records.kept.shape)


_PHASES: list[tuple[Any, Any, Phases]] = []  # of the last records


def _phases(records: Records) -> Phases:
    """What filters the recordings; it stays the same over a thousand calls."""
    source, kept = records.source, records.kept
    for known in _PHASES:
        if known[0] is source and known[1] is kept:
            return known[2]
    phases = Phases(np.asarray(source), np.asarray(kept), records.time.shape[1])
    _PHASES[:] = [(source, kept, phases), *_PHASES[:1]]
    return phases


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


def stack(signals: Sequence[Signals], model: RobotModel | None = None, joined: bool = False) -> Records:
    """The recordings as one; they must share period, row rate and cutoff (`signals.prepare_all` sees to that).

    With a `model`, the known loads stand in `carried`; `InputError` where one is fixed to what does not move. `joined`
    puts short recordings of one role behind each other where none carries a load: what is padded is computed too.
    """
    first = signals[0]
    pad, samples = reach(first.dt, first.cutoff), max(s.time.size for s in signals)
    carried = None if model is None else _carried(model, signals)
    slots = [[k] for k in range(len(signals))]
    if joined and carried is None:
        slots = _slots(signals, samples, _length(samples + 2 * pad, first.rows.step) - 2 * pad)
        longer = [_slots(signals, round(x * samples)) for x in LONGER] if len(slots) > FEW_SLOTS else []
        slots = min([slots, *longer], key=partial(_padded_size, signals))
    samples, count = (max(sum(sizes[k] for k in m) for m in slots) for sizes in _sizes(signals))
    length = _length(max(samples + 2 * pad, *(_with_ends(signals, m) for m in slots)), first.rows.step)
    spans, kept, source = [_NOWHERE] * len(signals), [], []
    for slot, members in enumerate(slots):
        sample = row = 0
        rows, index = [], []
        starts = [*_starts(signals, members, pad), length]
        for k, place, end in zip(members, starts, starts[1:], strict=False):
            one = signals[k]
            spans[k] = Span(slot, sample, one.time.size, row, one.rows.kept)
            index.append(_extended(one, pad, end - place) + sample)
            rows.append(one.rows.index + pad + place)
            sample, row = sample + one.time.size, row + one.rows.kept
        kept.append(np.concatenate(rows))
        source.append(np.concatenate(index))

    def behind(each: Sequence[Leaf]) -> list[np.ndarray]:
        return [np.concatenate([np.asarray(each[k]) for k in members]) for members in slots]

    weight = _padded(behind([s.rows.weight * (s.role == "fit") for s in signals]), count, hold=False)
    stands = [np.zeros(s.rows.weight.shape) if s.stands is None else s.stands * (s.role == "fit") for s in signals]
    torque = [np.zeros_like(s.velocity) if s.torque is None else s.torque for s in signals]
    return Records(
        time=_padded(behind([s.time for s in signals]), samples),
        position=_padded(behind([s.position for s in signals]), samples),
        velocity=_padded(behind([s.velocity for s in signals]), samples, hold=False),
        acceleration=_padded(behind([s.acceleration for s in signals]), samples, hold=False),
        torque=_padded(behind(torque), samples),
        source=np.stack(source),
        kept=_padded(kept, count),
        weight=weight,
        judged=weight,
        standing=_padded(behind(stands), count, hold=False),
        low_pass=gain(length, first.dt, first.cutoff),
        omega=2 * np.pi * np.fft.rfftfreq(length, first.dt),
        dt=first.dt,
        rate=1 / (first.dt * first.rows.step),
        cutoff=first.cutoff,
        bands=np.stack([s.bands for s in signals]),
        carried=carried,
        spans=tuple(spans),
    )


_NOWHERE = Span(0, 0, 0, 0, 0)


def _slots(signals: Sequence[Signals], samples: int, room: float = np.inf) -> list[list[int]]:
    """The recordings of each slot: long ones first, each into the first slot of its role that has room for it.

    A slot has `samples`, of which each further recording needs twice what the filter reaches more; `room` is what all
    have together. Slots stand in the order of their first recordings.
    """
    pad, step = reach(signals[0].dt, signals[0].cutoff), signals[0].rows.step
    slots: list[list[int]] = []
    for k in sorted(range(len(signals)), key=lambda k: -signals[k].time.size):
        for members in slots:
            taken = sum(signals[m].time.size for m in members) + signals[k].time.size
            alike = signals[members[0]].role == signals[k].role
            ends = (2 * pad + step - 1) * len(members)
            if alike and taken <= min(samples, room - ends) and _apart(signals, [*members, k]):
                members.append(k)
                break
        else:
            slots.append([k])
    return sorted(map(sorted, slots))


def _sizes(signals: Sequence[Signals]) -> tuple[list[int], list[int]]:
    """Samples and rows of each recording."""
    return [s.time.size for s in signals], [s.rows.kept for s in signals]


def _length(least: int, step: int) -> int:
    """A length that a real FFT is quick at, of which every `step`th number can be transformed back alone."""
    return step * fast_length(-(-least // step))


def _starts(signals: Sequence[Signals], members: Sequence[int], pad: int) -> list[int]:
    """Where the recordings of a slot begin in its extended record.

    Their rows stand a whole number of steps apart: then only these are transformed back (`rowfilter.Phases`).
    """
    first, starts = signals[members[0]].rows, [0]
    for before, k in pairwise(members):
        least = starts[-1] + signals[before].time.size + 2 * pad
        starts.append(least + (first.first - signals[k].rows.first - least) % first.step)
    return starts


def _with_ends(signals: Sequence[Signals], members: Sequence[int]) -> int:
    """Places of a slot: its recordings with what the filter reaches on both sides of each."""
    pad = reach(signals[0].dt, signals[0].cutoff)
    return _starts(signals, members, pad)[-1] + signals[members[-1]].time.size + 2 * pad


def _padded_size(signals: Sequence[Signals], slots: list[list[int]]) -> int:
    """Samples of all slots, and of what is transformed of them."""
    samples = max(sum(signals[k].time.size for k in members) for members in slots)
    longest = max(_with_ends(signals, members) for members in slots)
    return len(slots) * (samples + _length(longest, signals[0].rows.step))


def _apart(signals: Sequence[Signals], members: list[int]) -> bool:
    """Whether time jumps from each recording to the next: by that alone an effect knows where one begins."""
    ordered = [signals[k] for k in sorted(members)]
    return all(abs(b.time[0] - a.time[-1] - a.dt) > a.dt for a, b in pairwise(ordered))


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
