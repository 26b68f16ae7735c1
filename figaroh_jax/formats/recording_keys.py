"""Keys of a task file that say what recordings hold and how they are prepared: `data`, `transmission`, `preprocess`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from .fields import Columns, DrivenColumns, Keys, Label, Matrix, MatrixOrDiagonal, Number, Positive, Vector

__all__ = ["Accuracy", "Load", "Measurement", "Preprocess", "RecordingEntry", "Transmission", "Units"]


class Load(Keys):
    """A known payload carried during a recording: `mass` in kg, `com` in m in the axes of the model's `frame`."""

    frame: str
    mass: Positive  # kg
    com: Vector = (0.0, 0.0, 0.0)  # m, in the frame


class Units(Keys):
    """Units of the arrays where they are not s, rad, m and N m."""

    time: Literal["s", "ms", "us", "ns"] = "s"
    position: Literal["rad", "deg", "m", "mm"] = "rad"
    velocity: Literal["rad/s", "deg/s", "m/s", "mm/s"] | None = None  # None: as the position
    torque: Literal["N m", "Nm", "N", "A", "mA", "%"] = "N m"  # A, mA, %: transmission.torque is N m an A, N m a %
    measurement: Literal["m", "mm"] = "m"
    orientation: Literal["rad", "deg"] = "rad"  # of rpy and rotvec


class Accuracy(Keys):
    """One sigma of the measuring device."""

    position: Positive | None = None  # m
    orientation: Positive | None = None  # rad


KINDS = ("pose", "position", "plane", "socket", "camera")


class Measurement(Keys):
    """What was measured at each posture: exactly one of the kinds pose, position, plane, socket, camera."""

    pose: Columns | None = None
    position: Columns | None = None
    plane: Columns | None = None
    socket: Columns | None = None
    camera: Columns | None = None
    base_frame: str | None = None
    tool_frame: str | None = None
    unknown: tuple[Literal["base_frame", "tool_frame"], ...] = ()
    accuracy: Accuracy = Accuracy()
    distance: Positive | None = None  # m between two sockets
    mount: Literal["hand", "world"] | None = None  # of the camera
    orientation: Literal["xyzw", "wxyz", "rpy", "rotvec"] | None = None  # of a pose that is no matrix; None: xyzw

    @property
    def kind(self) -> str:
        """The kind that was given."""
        return next(kind for kind in KINDS if kind in self.model_fields_set)

    @model_validator(mode="after")
    def _one_kind(self) -> Measurement:
        kinds = [kind for kind in KINDS if kind in self.model_fields_set]
        if len(kinds) != 1:
            raise ValueError(f"expected exactly one of {', '.join(KINDS)}; given: {', '.join(kinds) or 'none'}")
        if self.plane is None and getattr(self, kinds[0]) is None and kinds != ["plane"]:
            raise ValueError(f"{kinds[0]} must name an array")
        if (self.distance is not None) and kinds != ["socket"]:
            raise ValueError("distance belongs to the kind socket")
        if (self.mount is not None) != (kinds == ["camera"]):
            raise ValueError("the kind camera, and only it, needs mount: hand or world")
        if self.orientation is not None and kinds not in (["pose"], ["camera"]):
            raise ValueError("orientation belongs to the kinds pose and camera")
        return self


_LOGS: dict[str, dict[str, Any]] = {  # what the columns of a robot's own log are
    "rtde": {
        "time": "timestamp",
        "position": "actual_q",
        "torque": "actual_current",
        "units": {"torque": "A"},
    },
    "libfranka": {"time": "time", "position": "q", "torque": "tau_J", "units": {"time": "ms"}},
}


class RecordingEntry(Keys):
    """One recording: a file and the names of its arrays or columns."""

    file: Path
    format: Literal["rtde", "libfranka"] | None = None  # a robot's own log: its columns are known by name
    topic: str | None = None  # of a ROS bag or an MCAP file; None: the one topic of joints
    episode: Annotated[int, Field(ge=0)] | None = None  # of a LeRobot folder, or of a list of runs in JSON
    position: Columns
    time: str | None = None  # s
    rate: Positive | None = None  # Hz
    velocity: Columns | None = None
    torque: DrivenColumns | None = None  # 0 in a list: nothing drives that joint
    command: Columns | None = None
    load: Load | None = None
    repeat: Label | None = None
    role: Literal["fit", "holdout"] = "fit"
    units: Units = Units()
    measurement: Measurement | None = None

    @model_validator(mode="before")
    @classmethod
    def _columns_of_logs(cls, value: Any) -> Any:
        known = _LOGS.get(str(value.get("format"))) if isinstance(value, dict) else None
        if known is None:
            return value
        own = {key: name for key, name in known.items() if key != "time" or "rate" not in value}
        if "torque" in value and isinstance(own.get("units"), dict):
            own["units"] = {key: unit for key, unit in own["units"].items() if key != "torque"}
        units = value.get("units", {})
        return own | value | ({"units": own["units"] | units} if isinstance(units, dict) else {})

    @property
    def place(self) -> Path:
        """The file, or the episode in it, by which messages name the recording."""
        return self.file if self.episode is None else self.file / f"episode_{self.episode}"

    @property
    def name(self) -> str:
        """By which predictions name the recording."""
        return self.file.stem if self.episode is None else f"{self.file.name}_episode_{self.episode}"

    @model_validator(mode="after")
    def _one_clock(self) -> RecordingEntry:
        if self.time is not None and self.rate is not None:
            raise ValueError("both time and rate are given, expected one of them")
        if self.time is None and self.rate is None and self.measurement is None:
            raise ValueError("neither time (name of the time column) nor rate (Hz) is given")
        return self


class Transmission(Keys):
    """Motor side to joint side: motor position = position @ joint position, joint torque = torque @ motor torque."""

    position: MatrixOrDiagonal | None = None
    torque: MatrixOrDiagonal | None = None
    offset: tuple[Number, ...] | None = None  # rad or m, added to the joint position

    @field_validator("position", "torque")
    @classmethod
    def _invertible(cls, rows: Matrix | None) -> Matrix | None:
        if rows is None:
            return None
        if not rows or any(len(row) != len(rows) for row in rows):
            raise ValueError(f"expected a square matrix, rows have lengths {[len(row) for row in rows]}")
        singular = np.linalg.svd(np.asarray(rows), compute_uv=False)
        if singular[-1] <= 1e-12 * singular[0]:
            raise ValueError("the matrix is singular: some joint motion moves no motor")
        return rows


class Preprocess(Keys):
    """What happens to every recording before anything is fitted; what is not given is chosen from the recordings.

    `window` (begin, end) in s is the part that is kept; `cutoff` in Hz that of one zero-phase low pass for position,
    torque and every column of the regressor; `rate` in Hz that of the rows after it; `gate` drops the rows of a joint
    that moves more slowly, `{"elbow": 0.05}` in rad/s (m/s).

    >>> import figaroh_jax as fj
    >>> fj.Preprocess(cutoff=15, rate=50).cutoff
    15.0
    """

    window: tuple[Number, Number] | None = None  # s, kept
    cutoff: Positive | None = None  # Hz
    rate: Positive | None = None  # Hz of the rows
    gate: dict[str, Annotated[Number, Field(ge=0)]] = {}  # rad/s: slower samples of the joint are dropped

    @field_validator("window")
    @classmethod
    def _ordered(cls, window: tuple[float, float] | None) -> tuple[float, float] | None:
        if window is not None and not window[0] < window[1]:
            raise ValueError(f"[{window[0]:g}, {window[1]:g}] ends before it begins")
        return window
