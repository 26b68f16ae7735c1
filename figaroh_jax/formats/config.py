"""The task file: every key of TASK.yaml with its type, its default and what may stand there.

`load_task` reads a file, follows `extends` and checks all of it; the first mistake becomes one `InputError` that names
file and key. The models can also be built in Python: `Preprocess(cutoff=15)`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    field_validator,
    model_validator,
)

from ..errors import InputError, nearest
from .files import USD
from .taskfile import CONTRACT_EFFECTS, merge, read_task, where

if TYPE_CHECKING:
    pass

__all__ = [
    "Actuator",
    "Baseline",
    "BaselineEffect",
    "Bound",
    "Diagnose",
    "Excite",
    "Identify",
    "JointDrive",
    "Limits",
    "Load",
    "Measurement",
    "MotionBasis",
    "MotionLimits",
    "Preprocess",
    "RecordingEntry",
    "Robot",
    "Rollouts",
    "SizedEffect",
    "Task",
    "Transmission",
    "Units",
    "load_limits",
    "load_task",
    "robot_options",
]


def _not_bool(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("expected a number")
    return value


def _columns(value: Any) -> Any:
    names = value if isinstance(value, (list, tuple)) else [value]
    if not names or not all(isinstance(name, str) and name for name in names):
        raise ValueError("expected the name of an array, a prefix of column names or a list of columns")
    return value if isinstance(value, str) else tuple(value)


def _diagonal(value: Any) -> Any:
    plain = isinstance(value, (list, tuple)) and all(isinstance(x, (int, float)) for x in value) and len(value) > 0
    if not plain:
        return value
    return [[x if i == j else 0.0 for j in range(len(value))] for i, x in enumerate(value)]


def _effect(name: str) -> str:
    from ..effects.catalogue import CATALOGUE

    known = list(dict.fromkeys([*CATALOGUE, *CONTRACT_EFFECTS]))
    if name not in known:
        raise ValueError(f"no effect '{name}'{nearest(name, known)}")
    return name


def _label(value: Any) -> Any:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


Number = Annotated[float, BeforeValidator(_not_bool)]
Positive = Annotated[Number, Field(gt=0)]
Columns = Annotated[str | tuple[str, ...], BeforeValidator(_columns)]
Effect = Annotated[str, BeforeValidator(lambda name: _effect(str(name)))]
Label = Annotated[str, BeforeValidator(_label)]
Vector = tuple[Number, Number, Number]
Matrix = list[list[Number]]


class _Keys(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, value: Any) -> Any:
        known = list(cls.model_fields)
        if isinstance(value, dict):
            for key in value:
                if key not in known:
                    raise ValueError(f"unknown key '{key}'{nearest(str(key), known)}")
        elif not isinstance(value, BaseModel):
            raise ValueError(f"expected keys and values: {', '.join(known)}")
        return value


class Robot(_Keys):
    """Which model, which of its joints move, and how far its inertials are believed."""

    model: Path
    root: Literal["fixed", "free_flyer"] = "fixed"
    joints: tuple[str, ...] | None = None  # moving joints in column order; None: all of them
    posture: dict[str, Number | tuple[Number, ...]] = {}  # of the locked joints, rad or m; a list where q has several
    gravity: Vector = (0.0, 0.0, -9.81)  # m/s^2
    trust: Positive = 0.10  # relative one sigma of the nominal inertials

    @field_validator("joints")
    @classmethod
    def _once(cls, joints: tuple[str, ...] | None) -> tuple[str, ...] | None:
        for joint in joints or ():
            if joints is not None and joints.count(joint) > 1:
                raise ValueError(f"joint '{joint}' appears twice")
        if joints == ():
            raise ValueError("expected at least one joint")
        return joints


class Load(_Keys):
    """A known payload carried during a recording: `mass` in kg, `com` in m in the axes of the model's `frame`."""

    frame: str
    mass: Positive  # kg
    com: Vector = (0.0, 0.0, 0.0)  # m, in the frame


class Units(_Keys):
    """Units of the arrays where they are not s, rad, m and N m."""

    time: Literal["s", "ms", "us", "ns"] = "s"
    position: Literal["rad", "deg", "m", "mm"] = "rad"
    velocity: Literal["rad/s", "deg/s", "m/s", "mm/s"] | None = None  # None: as the position
    torque: Literal["N m", "Nm", "N", "A", "mA", "%"] = "N m"  # A, mA, %: transmission.torque is N m an A, N m a %
    measurement: Literal["m", "mm"] = "m"


class Accuracy(_Keys):
    """One sigma of the measuring device."""

    position: Positive | None = None  # m
    orientation: Positive | None = None  # rad


KINDS = ("pose", "position", "plane", "socket", "camera")


class Measurement(_Keys):
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


class RecordingEntry(_Keys):
    """One recording: a file and the names of its arrays or columns."""

    file: Path
    format: Literal["rtde", "libfranka"] | None = None  # a robot's own log: its columns are known by name
    topic: str | None = None  # of a ROS bag or an MCAP file; None: the one topic of joints
    episode: Annotated[int, Field(ge=0)] | None = None  # of a LeRobot folder
    position: Columns
    time: str | None = None  # s
    rate: Positive | None = None  # Hz
    velocity: Columns | None = None
    torque: Columns | None = None
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


class Transmission(_Keys):
    """Motor side to joint side: motor position = position @ joint position, joint torque = torque @ motor torque."""

    position: Annotated[Matrix, BeforeValidator(_diagonal)] | None = None  # a plain list is a diagonal
    torque: Annotated[Matrix, BeforeValidator(_diagonal)] | None = None
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


class Preprocess(_Keys):
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


class BaselineEffect(_Keys):
    """An effect that is known to be there."""

    effect: Effect
    at: tuple[str, ...] = ()


class Baseline(_Keys):
    """What is fitted beside the rigid body before anything is named, and what `identify` fits.

    At every joint `viscous` friction (N m s/rad), `coulomb` friction (N m), the inertia of the `rotor` (kg m2) and a
    torque `offset` (N m); `effects` names more, each with its place: `{"effect": "joint_spring", "at": ["elbow"]}`.

    >>> import figaroh_jax as fj
    >>> fj.Baseline(rotor=True, effects=[{"effect": "joint_spring", "at": ["elbow"]}]).effects[0].at
    ('elbow',)
    """

    viscous: bool = True
    coulomb: bool = True
    rotor: bool = False
    offset: bool = False
    effects: tuple[BaselineEffect, ...] = ()


class JointDrive(_Keys):
    """The drive of a joint that a URDF does not describe: torque = kp (u - q) - kd v, within the limit."""

    kind: Literal["position", "velocity", "torque"] = "position"
    kp: Positive | None = None  # N m/rad
    kd: Annotated[Number, Field(ge=0)] = 0.0  # N m s/rad
    force: Positive | None = None  # limit, N m

    @model_validator(mode="after")
    def _gains(self) -> JointDrive:
        if self.kind == "position" and self.kp is None:
            raise ValueError("kind position needs kp (N m/rad)")
        if self.kind == "velocity" and not self.kd:
            raise ValueError("kind velocity needs kd (N m s/rad)")
        return self


class Actuator(BaseModel):
    """Whether a rollout may trust the servo gains; every other key is a joint with its drive."""

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)
    # as pydantic documents it: the field says to type checkers that it is no argument
    __pydantic_extra__: dict[str, JointDrive] = Field(init=False)  # pyright: ignore[reportIncompatibleVariableOverride]

    gains: Literal["known", "free"] = "known"

    @model_validator(mode="before")
    @classmethod
    def _joints_have_drives(cls, value: Any) -> Any:
        for key, drive in value.items() if isinstance(value, dict) else ():
            if key != "gains" and not isinstance(drive, dict | JointDrive):
                hint = nearest(str(key), ["gains"])
                raise ValueError(f"unknown key '{key}'{hint}; other keys are joints: joint_1: {{kp: 20, kd: 1}}")
        return value

    @property
    def drives(self) -> dict[str, JointDrive]:
        """The stated drives by joint."""
        return dict(self.__pydantic_extra__ or {})


class Rollouts(_Keys):
    """How long a simulation runs before it is set on the measured state again."""

    window: Positive | Literal["auto", "whole"] = "auto"  # s


class Tolerance(_Keys):
    """What is good enough: a misfit below it is `nothing`."""

    torque: Annotated[Number, Field(ge=0, lt=1)] = 0.01  # share of each joint's RMS torque
    offset: Annotated[Number, Field(ge=0)] = 0.001  # rad
    geometry: Annotated[Number, Field(ge=0)] = 0.0005  # m
    position: Annotated[Number, Field(ge=0)] = 0.001  # rad, of rollouts


class Diagnose(_Keys):
    """What is looked for."""

    forbid: tuple[Effect, ...] = ()  # effects left out of the catalogue
    alpha: Annotated[Number, Field(gt=0, lt=1)] = 0.05
    tolerance: Tolerance = Tolerance()


class Bound(_Keys):
    """What CAD says of a link, in its joint frame."""

    mass: tuple[Number, Number] | None = None  # kg, least and greatest
    com: tuple[Vector, Vector] | None = None  # m, corners of a box around the centre of mass


class Identify(_Keys):
    """How `identify` fits."""

    fit: Literal["physical", "log_cholesky", "unconstrained"] = "physical"
    joints: tuple[str, ...] | None = None  # whose torque is fitted; None: all
    bounds: dict[str, Bound] = {}  # by link
    infeasible: Literal["refuse", "write"] = "refuse"  # whether `model/` is written with links that cannot exist


class MotionBasis(_Keys):
    """What designed motions are made of: exactly one of the three."""

    fourier: Annotated[int, Field(ge=2)] | None = None  # harmonics
    base: Positive | None = None  # Hz of the first harmonic; None: one period a motion
    spline: Annotated[int, Field(ge=2)] | None = None  # free control points
    quintic: Annotated[int, Field(ge=2)] | None = None  # waypoints, the start among them

    @model_validator(mode="after")
    def _one(self) -> MotionBasis:
        given = [name for name in ("fourier", "spline", "quintic") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"expected exactly one of fourier, spline, quintic; given: {', '.join(given) or 'none'}")
        if self.base is not None and self.fourier is None:
            raise ValueError("base is the first frequency of a Fourier series; it goes with fourier alone")
        return self


class MotionLimits(_Keys):
    """What a designed motion may use: `model` is what the robot's file says, a number or a map by joint replaces it."""

    position: Literal["model"] | Positive | dict[str, Positive | tuple[Number, Number]] = "model"  # rad or m
    velocity: Literal["model"] | Positive | dict[str, Positive] = "model"
    acceleration: Positive | dict[str, Positive] | None = None  # rad/s^2 or m/s^2; None: no limit
    torque: Literal["model"] | Positive | dict[str, Positive] = "model"  # N m or N
    clearance: Positive | None = None  # m, between bodies that no joint joins, the floor, boxes; None: not looked at


class Body(_Keys):
    """A capsule or a sphere on a link, in the place of its collision shapes."""

    link: str  # or any frame of the model
    at: Vector = (0.0, 0.0, 0.0)  # m, in that frame: the middle of a sphere, one end of a capsule's axis
    to: Vector | None = None  # the other end
    radius: Positive  # m


class Obstacle(_Keys):
    """A box that stands in the world."""

    name: str
    size: tuple[Positive, Positive, Positive]  # edges, m
    at: Vector  # its middle, m
    turn: Vector = (0.0, 0.0, 0.0)  # roll, pitch, yaw, rad


class Sight(_Keys):
    """What the device of postures can see, in its base frame."""

    place: Vector  # m: of a fixed device, or of the board that a device in the hand looks at
    axis: Vector | None = None  # its line of sight, or the board's normal; None: any direction
    cone: Annotated[Positive, Field(le=3.15)] = 0.5  # rad, half angle of what the device sees
    tilt: Annotated[Positive, Field(le=3.15)] = 1.0  # rad, between the target's normal and the line of sight
    near: Positive = 0.1  # m
    far: Positive = 10.0


class Touched(_Keys):
    """A plane or a socket that postures are to touch, in the device's base frame."""

    place: Vector  # m: the socket, or a point on the plane
    axis: Vector | None = None  # of a plane: its normal, towards the robot; of a socket: the way out of it
    radius: Positive = 0.3  # m around the place: how much of the plane is there
    tilt: Annotated[Positive, Field(le=3.15)] = 3.15  # rad, between the tool's z axis and the way in


class SizedEffect(_Keys):
    """A cause that is to be told from another, and how large it is taken to be."""

    effect: Effect
    at: tuple[str, ...] = ()
    size: dict[str, Number] = {}  # its parameters; by default as large as twice the noise


class Excite(_Keys):
    """What `excite` designs."""

    kind: Literal["trajectory", "postures"] = "trajectory"
    duration: Positive = 10.0  # s of each trajectory
    trajectories: Annotated[int, Field(ge=1, le=50)] = 1
    basis: MotionBasis = MotionBasis(fourier=5)
    limits: MotionLimits = MotionLimits()
    objective: Literal["information", "prediction", "condition", "separate"] = "information"
    predict: tuple[Path, ...] = ()  # motions that matter
    separate: tuple[tuple[SizedEffect, SizedEffect], ...] = ()
    noise: Positive | dict[str, Positive] | None = None  # share of the largest torque; None: of the recordings, or 0.01
    start: tuple[Number, ...] | None = None  # posture at the beginning, rad or m; None: chosen
    starts: Annotated[int, Field(ge=1, le=1000)] = 4  # random motions that are improved
    rate: Positive = 20.0  # Hz of a design's samples, whose noise is independent
    postures: Annotated[int, Field(ge=2, le=1000)] = 30
    candidates: Annotated[int, Field(ge=10, le=20_000)] = 500  # random postures to choose from
    measurement: Measurement | None = None  # of postures: the device; None: that of the recordings
    view: Sight | None = None  # of postures: what the device sees; None: everything
    touch: tuple[Touched, ...] = ()  # of postures measured with planes or sockets: where these are
    point: Vector = (0.0, 0.0, 0.0)  # m, in the tool frame: what touches them
    floor: Number | None = None  # its height in the world, m
    boxes: tuple[Obstacle, ...] = ()
    bodies: tuple[Body, ...] = ()  # for links without collision shapes, or in the place of theirs
    ignore: tuple[tuple[str, str], ...] = ()  # pairs of bodies whose distance is not looked at

    @model_validator(mode="after")
    def _complete(self) -> Excite:
        around = [name for name in ("floor", "boxes", "bodies", "ignore") if name in self.model_fields_set]
        if around and self.limits.clearance is None:
            raise ValueError(f"{around[0]}: distances are looked at where limits.clearance (m) says which to keep")
        if self.objective == "prediction" and not self.predict:
            raise ValueError("objective: prediction needs `predict`, the motions that matter")
        if self.objective == "separate" and not self.separate:
            raise ValueError("objective: separate needs `separate`, pairs of causes to be distinguished")
        return self


class Task(_Keys):
    """A whole task file."""

    robot: Robot
    data: tuple[RecordingEntry, ...] = ()  # needed by all but `excite`
    transmission: Transmission | None = None
    preprocess: Preprocess = Preprocess()
    baseline: Baseline = Baseline()
    actuator: Actuator = Actuator()
    rollout: Rollouts = Rollouts()
    diagnose: Diagnose = Diagnose()
    identify: Identify = Identify()
    excite: Excite | None = None
    _file: Path = PrivateAttr(default=Path("task"))

    @property
    def file(self) -> Path:
        """The file that the task was read from."""
        return self._file

    @property
    def of_postures(self) -> bool:
        """Whether recordings are postures, measured by a device."""
        return any(entry.measurement is not None for entry in self.data)

    @property
    def of_rollouts(self) -> bool:
        """Whether the recordings that are fitted hold a command and no torque."""
        fitted = [entry for entry in self.data if entry.role == "fit"]
        return all(e.command is not None and e.torque is None and e.measurement is None for e in fitted)

    @model_validator(mode="before")
    @classmethod
    def _data_or_excite(cls, value: Any) -> Any:
        if isinstance(value, dict) and "data" not in value and not value.get("excite"):
            raise ValueError("data is missing")
        return value

    @field_validator("data")
    @classmethod
    def _fit_and_holdout(cls, data: tuple[RecordingEntry, ...]) -> tuple[RecordingEntry, ...]:
        if not data:
            raise ValueError("expected at least one recording")
        if all(entry.role == "holdout" for entry in data):
            raise ValueError("no recording has role: fit")
        stems = [entry.name for entry in data if entry.role == "holdout"]
        for stem in stems:
            if stems.count(stem) > 1:
                raise ValueError(f"two holdout recordings are called '{stem}': their predictions would share one name")
        first: dict[str, int] = {}
        for k, entry in enumerate(data):
            place = first.setdefault(repr(entry), k)
            if place != k:
                raise ValueError(f"entries {place} and {k} (from 0) are the same recording, which would count twice")
        return data


class Limits(_Keys):
    """Bounds on the figures of a run, for `figaroh-jax verify`; what is not given is not asked for."""

    verdict: tuple[Literal["nothing", "named", "named+rest", "unknown"], ...] | None = None  # allowed
    holdout_relative: Positive | dict[str, Positive] | None = None  # at most, of all joints or by joint
    gain: Number | None = None  # share by which all causes together lower the held-out error, at least
    p_value: Annotated[Number, Field(ge=0, le=1)] | None = None  # at least
    forbidden_causes: tuple[Effect, ...] | None = None
    rank: Annotated[int, Field(ge=0)] | None = None  # at least
    condition: Positive | None = None  # at most
    relative_std: Positive | None = None  # of identified base parameters, at most
    consistent: bool | None = None  # every link physically consistent
    position_mm: Positive | None = None  # validated, at most
    orientation_deg: Positive | None = None
    fk_parity: Positive | None = None  # m, at most


def load_limits(path: str | Path) -> Limits:
    """Read a file of limits; raises `InputError` that names file and key of the first mistake."""
    chain = read_task(Path(path))
    try:
        return Limits.model_validate(merge(chain))
    except ValidationError as error:
        place, text = _mistake(error.errors(include_url=False))
        raise InputError(f"{where(chain, place)}: {text}") from None


def load_task(path: str | Path) -> Task:
    """Read and check a task file; raises `InputError` that names file and key of the first mistake.

    >>> import figaroh_jax as fj
    >>> fj.load_task(fj.DEMO.replace("robot.urdf", "task.yaml")).preprocess.cutoff
    15.0
    """
    chain = read_task(Path(path))
    try:
        task = Task.model_validate(merge(chain))
    except ValidationError as error:
        place, text = _mistake(error.errors(include_url=False))
        raise InputError(f"{where(chain, place)}: {text}") from None
    task._file = Path(path)
    return task


def robot_options(robot: Robot) -> dict[str, Any]:
    """Arguments of `read_robot` and `load_extended` beside the file; gravity None is an MJCF's or a stage's own."""
    own = robot.model.suffix.lower() in (".xml", *USD) and "gravity" not in robot.model_fields_set
    gravity = None if own else robot.gravity
    return {"joints": robot.joints, "posture": dict(robot.posture), "gravity": gravity, "root": robot.root}


_EXPECTED = {  # pydantic's kinds of mistakes, in fewer words
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "less than {lt:g}",
    "literal_error": "{expected}",
    "too_long": "{max_length} values",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "string_type": "text",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "keys and values",
    "path_type": "the name of a file",
}


def _mistake(errors: Sequence[Any]) -> tuple[tuple[str | int, ...], str]:
    """Place and text of the first mistake; where a key takes one of several forms, of all of them together."""
    place = _keys(errors[0]["loc"])
    if len(place) == len(errors[0]["loc"]):
        return place, _message(place, errors[0], _expected(errors[0]))
    same = [error for error in errors if _keys(error["loc"])[: len(place)] == place]
    depth = max(len(_keys(error["loc"])) for error in same)
    near = [error for error in same if len(_keys(error["loc"])) == depth]  # of the form that was meant
    forms = list(dict.fromkeys(_expected(error) for error in near))
    text = " or ".join([", ".join(forms[:-1]), forms[-1]] if len(forms) > 1 else forms)
    place = _keys(near[0]["loc"])
    return place, _message(place, near[0], text)


def _keys(place: Sequence[str | int]) -> tuple[str | int, ...]:
    """Of a place, the keys of the task file, without the forms that pydantic tells apart."""
    return tuple(part for part in place if isinstance(part, int) or "[" not in part)


def _expected(error: Any) -> str:
    kind = error["type"]
    if kind == "value_error":
        return str(error["ctx"]["error"]).removeprefix("expected ")
    return _EXPECTED[kind].format(**error.get("ctx", {})) if kind in _EXPECTED else error["msg"]


def _message(place: Sequence[str | int], error: Any, expected: str) -> str:
    """One mistake in the words of the task file."""
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).lstrip(".")
    if error["type"] == "missing":
        return f"{key} is missing"
    if error["type"] == "value_error":
        return f"{key}: {error['ctx']['error']}" if key else str(error["ctx"]["error"])
    return f"{key} is {error['input']!r:.80}, expected {expected}"
