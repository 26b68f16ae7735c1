"""What a search of rollouts has found: the model that stands, candidates that were fitted beside it, and causes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..results import Name, Verdict
from .causes import Candidate
from .faults import Fault
from .fit import Fit
from .setting import Setting, Structure

__all__ = ["TOO_LITTLE", "Model", "Named", "Search", "Tried", "all_but"]

TOO_LITTLE = "improves held-out data too little"


class Model(NamedTuple):
    """The model that stands, and the causes in it."""

    structure: Structure
    fit: Fit
    free: tuple[int, ...]
    excess: float


class Tried(NamedTuple):
    """A candidate that was fitted."""

    candidate: Candidate
    state: Model
    sse: np.ndarray  # held out, by blocks and windows; of an arm those of its fit, by joints too
    alone: bool = True  # no other joint had a candidate in the same fit


class Named(NamedTuple):
    """A cause that was found."""

    candidate: Candidate
    t: float
    gain: float
    alike: tuple[Name, ...]
    before: float = float("nan")  # held-out RMS, rad or m
    after: float = float("nan")


def all_but(found: Sequence[Named], gone: Candidate) -> list[Named]:
    """The causes but one, and but those that have its numbers: joints of one kind of drive have one together."""
    return [n for n in found if (n.candidate.effect, n.candidate.entries) != (gone.effect, gone.entries)]


@dataclass
class Search:
    """What was found."""

    verdict: Verdict
    named: list[Named]
    structure: Structure
    first: Fit  # baseline
    last: Fit
    p_value: float
    proxy: list[Named] = field(default_factory=list)  # best, not named
    nearest: list[tuple[Name, float, str]] = field(default_factory=list)
    table: list[tuple[str, float]] = field(default_factory=list)  # chi2/N after each step
    held: list[float] = field(default_factory=list)  # held-out RMS of the baseline and after each cause, rad or m
    fits: list[Fit] = field(default_factory=list)  # after each cause
    origin: Structure | None = None  # of the baseline
    setting: Setting | None = None  # where rows were left out: without them
    faults: list[Fault] = field(default_factory=list)  # why they were
    spread: np.ndarray | None = None  # (columns of `last`,) by recordings: half of each 95 % interval over 1.96
    doubtful: list[tuple[Name, float, str]] = field(default_factory=list)  # of no sure size, left out, with their gain
    creeps: list[Named] = field(default_factory=list)  # friction that holds where the file's creeps
    beside: Fit | None = None  # where a cause that is too slight to be named is left out: with it noise alone is left
    odd: tuple[str, ...] = ()  # recordings kept out that no numbers explain beside those that were fitted
