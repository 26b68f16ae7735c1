"""What a diagnosis answers: plain immutable records, the same for the report, the terminal and `answer.json`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .recordings.bandwidth import Band

__all__ = [
    "BoundedEstimate",
    "Candidate",
    "Cause",
    "Diagnosis",
    "Estimate",
    "Experiment",
    "Gain",
    "Links",
    "MovedLink",
    "Name",
    "Nearest",
    "Part",
    "Rest",
    "Selection",
    "Trace",
    "Verdict",
    "finite",
]

Verdict = Literal["nothing", "named", "named+rest", "unknown"]


class Name(NamedTuple):
    """An effect at a place: `at` holds joint, link or frame names in model order, empty for the whole robot."""

    effect: str
    at: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.effect} ({', '.join(self.at)})" if self.at else self.effect


class Estimate(NamedTuple):
    """Value and one standard deviation (inf: not determined), in `unit`."""

    value: float
    std: float
    unit: str

    def __str__(self) -> str:
        return f"{self.value:.6g} {self.unit}".rstrip() + f" (σ {self.std:.2g})"


class BoundedEstimate(Estimate):
    """An estimate of what cannot be below `least`: its interval is told as cut there."""

    least: float = float("-inf")

    def __new__(cls, value: float, std: float, unit: str, least: float = float("-inf")) -> BoundedEstimate:
        one = super().__new__(cls, value, std, unit)
        one.least = least
        return one


@dataclass(frozen=True)
class Gain:
    """Error on data not used for the fit, before and after the cause was put in."""

    before: float
    after: float
    unit: str = "relative RMS"

    def __str__(self) -> str:
        return f"error {self.before:.3g} -> {self.after:.3g} ({self.unit})"


@dataclass(frozen=True)
class Cause:
    """A named cause, how large it is, what it gains and what cannot be told from it.

    `name` has the `effect` and where it is, `at`; `parameters` are estimates by name with `value`, `std` and `unit`;
    `gain` the error on held-out data `before` and `after`; `confidence` the share of resamples in which it wins.
    """

    name: Name
    parameters: dict[str, Estimate]
    confidence: float
    gain: Gain
    ambiguous_with: tuple[Name, ...] = ()
    found: int = 0  # place in the order of discovery, from 1
    note: str = ""  # e.g. what MJCF and URDF cannot express

    def __str__(self) -> str:
        sizes = ", ".join(f"{key} {value}" for key, value in self.parameters.items())
        rivals = f"; not told from {', '.join(map(str, self.ambiguous_with))}" if self.ambiguous_with else ""
        return f"{self.name}: {sizes}; {self.gain}{rivals}"


@dataclass(frozen=True)
class Nearest:
    """A cause that was found and is not named: the share of its joints' held-out error that it takes, and why not."""

    name: Name
    share: float
    why_not: str


Dependence = Literal["standstill", "position", "velocity", "load", "time", "frequency", "recording"]


@dataclass(frozen=True)
class Part:
    """What a share of the power beyond the noise goes with, at a joint."""

    kind: Dependence
    at: tuple[str, ...]
    share: float
    band: tuple[float, float] | None = None  # Hz, of a frequency
    file: str | None = None  # of a recording


@dataclass(frozen=True)
class Rest:
    """What no cause explains: how large, what it goes with on held-out data, which causes came near."""

    relative: Float[np.ndarray, " nv"]  # RMS beyond the noise over the RMS torque of each joint
    parts: tuple[Part, ...] = ()
    nearest: tuple[Nearest, ...] = ()
    text: str = ""  # where it is more than noise, in words; empty where it is not
    tolerated: str = ""  # why what is surely more than noise does not count, in words
    undecided: str = ""  # why more than is tolerable can be told neither from noise nor from an error, in words
    contradicts: tuple[str, ...] = ()  # what of recordings, or of links as fitted, cannot be: nothing is named then


@dataclass(frozen=True)
class MovedLink:
    """A link whose mass or inertia is another than the model file has, or a rotor that looks like one."""

    name: Name  # link_inertia or rotor_inertia
    share: float  # of what fitting all links gains: taken by this one and those before it
    numbers: dict[str, Estimate]  # what is to be added to the file's, of those that data tell: kg, kg m, kg m2
    instead: tuple[Name, ...] = ()  # what gains as much in its place
    note: str = ""  # what the numbers look like


@dataclass(frozen=True)
class Links:
    """How much of the simulation's error the links of the model file are, which the baseline fits before all causes."""

    filed: Float[np.ndarray, " nv"]  # RMS residual of each joint with them, friction being fitted, N m or N
    gain: Gain  # error on data not fitted, with the links of the file and with fitted ones
    far: float  # how far they move, RMS of what the data tell, in stated one sigmas
    trust: float  # the stated relative one sigma
    moved: tuple[MovedLink, ...] = ()


@dataclass(frozen=True)
class Candidate:
    """What the data can say of one effect at one place, before any verdict."""

    name: Name
    identifiable: float  # share of the effect outside the span of the baseline, 0..1
    detectable: float  # smallest RMS torque (N m or N) that this data would show (D = 4); inf: never
    nearest: Name | None  # the effect with the smallest angle to this one
    angle: float  # that angle, degrees
    score: float  # Wilson-Hilferty z of the first screening


@dataclass(frozen=True)
class Experiment:
    """The motion that would separate causes which this data cannot tell apart."""

    text: str
    separates: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Trace:
    """One recording as the report shows it: measured torque and the model's, before and after (N m or N)."""

    name: str
    role: Literal["fit", "holdout"]
    time: Float[np.ndarray, " samples"]
    position: Float[np.ndarray, "samples nv"]
    velocity: Float[np.ndarray, "samples nv"]
    measured: Float[np.ndarray, "samples nv"] | None  # None: a holdout recording without torque
    before: Float[np.ndarray, "samples nv"]
    after: Float[np.ndarray, "samples nv"]
    shares: dict[str, Float[np.ndarray, "samples nv"]] = field(default_factory=dict)  # torque of each cause
    counted: Bool[np.ndarray, "samples nv"] | None = None  # False: near a gap, below a gate, at rest; None: all


@dataclass(frozen=True, kw_only=True, repr=False)
class Selection:
    """What a search among effects decides, the same for every job; reports and JSON files are views of it."""

    verdict: Verdict
    causes: tuple[Cause, ...]  # diagnoses of torque: by their gain
    solution: Any = None  # estimation.solution.Fit of the model with the causes in it, where the job has one

    def __repr__(self) -> str:
        return "\n".join([f"{type(self).__name__}: {self._headline()}", *(f"  {cause}" for cause in self.causes)])

    def _headline(self) -> str:
        return self.verdict


@dataclass(frozen=True, repr=False)
class Diagnosis(Selection):
    """Verdict, causes by their gain, and everything the report needs to show why."""

    p_value: float
    joints: tuple[str, ...]
    before: Float[np.ndarray, " nv"]  # RMS residual of the baseline per joint, N m or N
    after: Float[np.ndarray, " nv"]  # RMS residual of the extended model
    noise: Float[np.ndarray, " nv"]  # RMS of the noise
    holdout: Gain  # whole error on data not fitted, before and after all causes
    holdout_scheme: str  # how that data was held out, in words
    experiment: Experiment | None
    candidates: tuple[Candidate, ...]
    traces: tuple[Trace, ...]
    baseline: Any  # extended.ExtendedModel: rigid body with friction, as fitted before anything was named
    model: Any  # extended.ExtendedModel with the causes put in
    rest: Rest = field(default_factory=lambda: Rest(np.zeros(0)))
    notes: tuple[str, ...] = ()  # what was dropped or assumed while reading the data
    prismatic: tuple[bool, ...] = ()  # per joint; empty: every joint is revolute
    band: Band = None  # Hz, that positions were taken down to (`prepare`): predictions want the same
    of_positions: bool = False  # a rollout: residuals and traces are positions, not torques
    remark: str = ""  # a sentence that the headline says besides what is missing
    links: Links | None = None  # of the file, where the torque moves them further than they are believed
    refitted: tuple[str, ...] = ()  # numbers of the model file that the baseline's fit surely moved, in words

    def _headline(self) -> str:
        return f"{self.verdict}; held out: {self.holdout}"

    @property
    def torque_units(self) -> tuple[str, ...]:
        """Unit of what is compared at each joint: "N m", or "N" at a prismatic one; "rad" and "m" for rollouts."""
        if self.of_positions:
            return tuple("m" if straight else "rad" for straight in self.prismatic or (False,) * len(self.joints))
        return tuple("N" if straight else "N m" for straight in self.prismatic or (False,) * len(self.joints))


def finite(value: Any) -> float | None:
    """A number as JSON takes it: a plain one, None where it is infinite or none."""
    plain = float(value)
    return plain if math.isfinite(plain) else None
