"""Which rows belong to repeats of one another, which are judged together, which are left out together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from ..recordings.signals import Signals, align
from ..recordings.stacked import Records
from .problem import Layout

__all__ = ["FOLDS", "block_width", "describe_folds", "held_rows", "layout"]

BLOCK, SHORT_BLOCK, SHORT = 1.0, 0.3, 9.99  # s: of a block, of a block in recordings shorter than the third
FOLDS = 5  # where the excitations are few: blocks go to them in turn
QUARTERS = 4  # of an excitation, for folds of few
SLICED, QUARTERED = True, False
FEWEST_EXCITATIONS = 3  # from which each is left out as a whole


def layout(signals: Sequence[Signals], records: Records) -> Layout:
    """Partners of every row, blocks of about a second, folds of one excitation (or slices in turn where they are few).

    Holdout recordings stand behind the others and belong to no block and no fold.
    """
    n, _, count, _ = records.shape
    partner = _partners(signals, records)
    repeats = bool((partner >= 0).any())
    weight = records.fitted
    if repeats:
        target = np.maximum(partner, 0)
        flat = weight.reshape(n * count, -1)
        partner = np.where(flat[target].any(-1), partner, -1)
        paired = (flat[target] * (partner >= 0)[..., None]).max(0).T
    else:
        partner, paired = partner[:0], np.ones((weight.shape[2], n * count))
    fold, part = _folds(signals, records, SLICED), _folds(signals, records, QUARTERED)
    return Layout(partner, paired, _blocks(signals, records), fold, part, repeats, _changed(signals, records))


def held_rows(signals: Sequence[Signals], records: Records) -> Float[np.ndarray, "n M nv"]:
    """1 for the rows of recordings that are kept out of the fit and have torque."""
    held = np.zeros_like(np.asarray(records.weight))
    for one, at in zip(signals, records.spans, strict=True):
        if one.role == "holdout" and one.torque is not None:
            held[at.slot, at.row : at.row + at.rows] = one.rows.weight
    return held


def describe_folds(signals: Sequence[Signals]) -> str:
    """How the folds were made, in words."""
    labels = excitations([s for s in signals if s.role == "fit"])
    if max(labels) + 1 >= FEWEST_EXCITATIONS:
        return "each excitation left out in turn"
    return "each recording's quarters left out in turn"


def excitations(signals: Sequence[Signals]) -> list[int]:
    """Number of the excitation that each recording carries: repeats share one."""
    seen: dict[str, int] = {}
    return [seen.setdefault(s.repeat or f"\0{k}", len(seen)) for k, s in enumerate(signals)]


def _partners(signals: Sequence[Signals], records: Records) -> Int[np.ndarray, "partners T"]:
    """Row of every other repeat of the same excitation, -1 where it has none."""
    n, _, count, _ = records.shape
    labels = excitations([s for s in signals if s.role == "fit"])
    most = max(labels.count(label) for label in labels) - 1
    partner = np.full((max(most, 1), n * count), -1)
    first = [at.slot * count + at.row for at in records.spans]
    for one in range(len(labels)):
        own = np.arange(signals[one].rows.kept)
        others = [k for k in range(len(labels)) if k != one and labels[k] == labels[one]]
        for slot, other in enumerate(others):
            partner[slot, first[one] + own] = _same_rows(signals[one], signals[other], first[other])
    return partner


def _same_rows(one: Signals, other: Signals, first: int) -> Int[np.ndarray, " rows"]:
    """Row of another recording that moves alike, whose rows stand from `first` on, for each row of one; -1 without."""
    row = np.arange(one.rows.kept) + align(one, other)
    return np.where((row >= 0) & (row < other.rows.kept), first + row, -1)


def _changed(signals: Sequence[Signals], records: Records) -> Int[np.ndarray, " T"] | None:
    """Row of the recording that moves alike, but with another torque, -1 where there is none; None without any."""
    if not any(one.changed_since for one in signals):
        return None
    n, _, count, _ = records.shape
    out, first = np.full(n * count, -1), [at.slot * count + at.row for at in records.spans]
    numbers = {one.name: k for k, one in enumerate(signals)}
    for one, begin in zip(signals, first, strict=False):
        if one.changed_since:
            other = numbers[one.changed_since]
            out[begin : begin + one.rows.kept] = _same_rows(one, signals[other], first[other])
    return out


def _blocks(signals: Sequence[Signals], records: Records) -> Int[np.ndarray, " T"]:
    n, _, count, _ = records.shape
    block, start = np.full((n, count), -1), 0
    for one, at in zip((s for s in signals if s.role == "fit"), records.spans, strict=False):
        seconds = np.arange(at.rows) / float(records.rate)
        width = block_width(one)
        number = np.minimum(seconds / width, max(1, round(seconds[-1] / width)) - 1).astype(int)
        block[at.slot, at.row : at.row + at.rows] = start + number
        start += number[-1] + 1
    return block.reshape(-1)


def block_width(one: Signals) -> float:
    """Seconds of a block: a recording is to have many."""
    return BLOCK if one.time[-1] - one.time[0] > SHORT else SHORT_BLOCK


def _folds(signals: Sequence[Signals], records: Records, sliced: bool) -> Int[np.ndarray, " T"]:
    """One excitation each; where they are few, slices of a block's length in turn, or quarters that follow one another.

    A model that is fitted around a slice is asked to interpolate, one fitted beside a quarter to extrapolate: causes
    are told apart better by the first, what they gain is told more honestly by the second. Longer slices hold events
    whole (a joint that starts once): a cause that shows there most is then asked to predict them without them.
    """
    n, _, count, _ = records.shape
    fitted = [s for s in signals if s.role == "fit"]
    labels = excitations(fitted)
    enough = max(labels) + 1 >= FEWEST_EXCITATIONS
    fold, first = np.full((n, count), -1), {}
    for k, (one, at) in enumerate(zip(fitted, records.spans, strict=False)):
        late = align(fitted[first.setdefault(labels[k], k)], one) if one.repeat else 0
        row = np.maximum(np.arange(at.rows) - late, 0)  # repeats share their slices
        slices = row / float(records.rate) // block_width(one) % FOLDS
        quarter = labels[k] * QUARTERS + np.minimum(row * QUARTERS // max(one.rows.kept, 1), QUARTERS - 1)
        fold[at.slot, at.row : at.row + at.rows] = labels[k] if enough else slices if sliced else quarter
    used = np.unique(fold[fold >= 0])
    return np.where(fold < 0, -1, np.searchsorted(used, fold)).reshape(-1)
