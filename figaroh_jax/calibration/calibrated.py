"""What a calibration answers: plain immutable records, the same for the report, the terminal and `result.json`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..recordings.posture_checks import OFF
from ..results import Selection
from ..rigid.model import RobotModel

__all__ = [
    "Calibration",
    "Error",
    "Outlier",
    "Parameter",
    "Quality",
    "Shown",
    "SocketDistance",
    "quality_of",
]


@dataclass(frozen=True)
class Parameter:
    """An estimated number; `status` says whether the data give it, its prior does, or it moves with others."""

    name: str
    value: float
    std: float
    unit: str
    status: str  # "identified", "prior only" or "gauge"


@dataclass(frozen=True)
class Error:
    """RMS errors in `unit`: of the frames alone and of the calibrated robot, on fitted and on held-out postures."""

    unit: str
    before: float
    after: float
    validated_before: float
    validated_after: float


class Outlier(NamedTuple):
    """A posture that no model explains, and its error in sizes of the noise."""

    file: str
    row: int
    size: float


class SocketDistance(NamedTuple):
    """Distance of the two sockets of a recording, m: stated, and by its postures with the frames alone, calibrated."""

    recording: str
    role: str
    stated: float
    before: float
    after: float


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Selection):
    """The calibrated robot, what was estimated and how well it predicts; `solution.model` is that robot."""

    level: str
    twists: dict[str, Float[np.ndarray, "6"]]  # correction of each joint's placement, in the joint frame, m and rad
    frames: dict[str, Float[np.ndarray, "*shape"]]  # metrology: poses (4 4) or points, by name
    parameters: tuple[Parameter, ...]
    position: Error | None
    orientation: Error | None
    outliers: tuple[Outlier, ...]
    table: dict[str, tuple[float, float]]  # held-out RMS of each level and of the chosen one, m and rad
    classes: tuple[tuple[str, ...], ...]  # parameters that the data cannot tell apart
    rank: int
    condition: float
    noise: tuple[float, float]  # m, rad
    scheme: str  # how the validation was held out
    notes: tuple[str, ...]
    points: tuple[Shown, ...]
    distances: tuple[SocketDistance, ...] = ()
    correlations: tuple[tuple[str, str, float], ...] = ()  # of identified parameters, the strongest
    posture: dict[str, float] = field(default_factory=dict)  # of the joints that are locked, rad or m
    unexplained: float | None = None  # held-out error over the measured points' spread; None where no points are seen

    def _headline(self) -> str:
        errors = (one for one in (self.position, self.orientation) if one is not None)
        told = (f"{one.validated_before:.3g} -> {one.validated_after:.3g} {one.unit}" for one in errors)
        return f"{self.verdict}; level {self.level}, {len(self.parameters)} parameters; held out: {', '.join(told)}"

    @property
    def model(self) -> RobotModel:
        """The robot with corrected placements."""
        return self.solution.model.robot

    @property
    def contradicted(self) -> bool:
        """Whether it leaves more of the points' spread than any robot out of calibration: it is no calibration."""
        return self.unexplained is not None and self.unexplained > OFF

    @property
    def converged(self) -> bool:
        """Whether the solver ended where it should."""
        return not self.solution.failure

    @property
    def steps(self) -> int:
        """Of the solver."""
        return int(self.solution.stats["num_steps"])


@dataclass(frozen=True, eq=False)
class Shown:
    """One recording as the report draws it: the points and the errors of frames alone and of the calibrated robot."""

    name: str
    role: str
    at: Float[np.ndarray, "points 3"]  # m, in the device's or the base frame
    before: Float[np.ndarray, "points 3"]
    after: Float[np.ndarray, "points 3"]
    row: tuple[int, ...]


class Quality(NamedTuple):
    """Errors of one axis of a recording after the calibration, mm; R2 of its points; `before`: RMSE of the frames."""

    recording: str
    role: str
    axis: str
    before: float
    mean: float
    std: float
    rmse: float
    max: float
    r2: float


def quality_of(calibration: Calibration) -> list[Quality]:
    """A row for each recording of points and axis of its device, without the outlier postures."""
    rows, outliers = [], {(o.file.rpartition(".")[0] or o.file, o.row) for o in calibration.outliers}
    for shown in calibration.points:
        kept = np.array([(shown.name, row) not in outliers for row in shown.row])
        for k, axis in enumerate("xyz"):
            before, error = 1e3 * shown.before[kept, k], 1e3 * shown.after[kept, k]
            square, spread = np.mean(error**2), 1e3 * np.std(shown.at[kept, k])
            r2 = 1.0 - square / spread**2 if spread > 0.0 else np.nan
            sizes = np.sqrt(np.mean(before**2)), error.mean(), error.std(), np.sqrt(square), np.abs(error).max(), r2
            rows.append(Quality(shown.name, shown.role, axis, *(float(x) for x in sizes)))
    return rows
