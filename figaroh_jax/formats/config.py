"""The task file: every key of TASK.yaml with its type, its default and what may stand there.

`load_task` reads a file, follows `extends` and checks all of it; the first mistake becomes one `InputError` that names
file and key. The models can also be built in Python: `Preprocess(cutoff=15)`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, ValidationError, field_validator, model_validator

from ..errors import InputError, nearest
from .excite_keys import Excite, MotionBasis, MotionLimits, SizedEffect
from .fields import OF_A_FILE, Effect, Keys, Number, Positive, Switch, Vector, mistake
from .files import USD
from .recording_keys import Load, Measurement, Preprocess, RecordingEntry, Transmission, Units
from .taskfile import given_task, merge, read_task, where

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
    "checked_drive",
    "load_limits",
    "load_task",
    "robot_options",
]


class Robot(Keys):
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


class BaselineEffect(Keys):
    """An effect that is known to be there."""

    effect: Effect
    at: tuple[str, ...] = ()


class Baseline(Keys):
    """What is fitted beside the rigid body before anything is named, and what `identify` fits.

    At every joint `viscous` friction (N m s/rad), `coulomb` friction (N m), the inertia of the `rotor` (kg m2) and a
    torque `offset` (N m); `effects` names more, each with its place: `{"effect": "joint_spring", "at": ["elbow"]}`.

    >>> import figaroh_jax as fj
    >>> fj.Baseline(rotor=True, effects=[{"effect": "joint_spring", "at": ["elbow"]}]).effects[0].at
    ('elbow',)
    """

    viscous: Switch = True
    coulomb: Switch = True
    rotor: Switch = False
    offset: Switch = False
    effects: tuple[BaselineEffect, ...] = ()

    SWITCHES: ClassVar[dict[str, str]] = {
        "viscous": "viscous_friction",
        "coulomb": "coulomb_friction",
        "rotor": "rotor_inertia",
        "offset": "torque_offset",
    }

    def everywhere(self) -> list[str]:
        """Names of the effects that every joint has."""
        return [name for key, name in self.SWITCHES.items() if getattr(self, key)]


class JointDrive(Keys):
    """The drive of a joint that a URDF does not describe: torque = kp (u - q) - kd v, within the limit."""

    kind: Literal["position", "velocity", "torque"] = "position"
    kp: Positive | None = None  # N m/rad
    kd: Annotated[Number, Field(ge=0)] = 0.0  # N m s/rad
    force: Positive | None = None  # limit, N m

    @model_validator(mode="after")
    def _gains(self) -> JointDrive:
        if self.kind == "position" and self.kp is None:
            raise ValueError("kind position needs kp (N m/rad)")
        if self.kind == "velocity" and not self.kd > 0:
            raise ValueError("kind velocity needs kd (N m s/rad), the gain of its error: torque = kd (u - v)")
        idle = {"velocity": ("kp",), "torque": ("kp", "kd")}.get(self.kind, ())
        given = [key for key in idle if getattr(self, key)]
        if given:
            raise ValueError(f"kind {self.kind} has no {' and no '.join(given)}")
        return self


def checked_drive(drive: Any, place: str) -> dict[str, Any]:
    """A drive as a task file may state it."""
    if not isinstance(drive, Mapping):
        raise InputError(f"{place}: keys and values are expected, as in {{'kind': 'position', 'kp': 20.0, 'kd': 0.5}}")
    for key in drive:
        if key not in JointDrive.model_fields:
            raise InputError(f"{place}: unknown key '{key}'{nearest(str(key), JointDrive.model_fields)}")
    try:
        return JointDrive.model_validate(dict(drive)).model_dump()
    except ValidationError as error:
        first = error.errors()[0]
        at = "".join(f".{part}" for part in first["loc"])
        raise InputError(f"{place}{at}: {first['msg'].removeprefix('Value error, ')}") from None


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


class Rollouts(Keys):
    """How long a simulation runs before it is set on the measured state again."""

    window: Positive | Literal["auto", "whole"] = "auto"  # s


class Tolerance(Keys):
    """What is good enough: a misfit below it is `nothing`."""

    torque: Annotated[Number, Field(ge=0, lt=1)] = 0.01  # share of each joint's RMS torque
    offset: Annotated[Number, Field(ge=0)] = 0.001  # rad
    geometry: Annotated[Number, Field(ge=0)] = 0.0005  # m
    position: Annotated[Number, Field(ge=0)] = 0.001  # rad, of rollouts


class Diagnose(Keys):
    """What is looked for."""

    forbid: tuple[Effect, ...] = ()  # effects left out of the catalogue
    alpha: Annotated[Number, Field(gt=0, lt=1)] = 0.05
    tolerance: Tolerance = Tolerance()


class Bound(Keys):
    """What CAD says of a link, in its joint frame."""

    mass: tuple[Number, Number] | None = None  # kg, least and greatest
    com: tuple[Vector, Vector] | None = None  # m, corners of a box around the centre of mass


class Identify(Keys):
    """How `identify` fits."""

    fit: Literal["physical", "log_cholesky", "unconstrained"] = "physical"
    joints: tuple[str, ...] | None = None  # whose torque is fitted; None: all
    bounds: dict[str, Bound] = {}  # by link
    infeasible: Literal["refuse", "write"] = "refuse"  # whether `model/` is written with inconsistent links


class Task(Keys):
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


class Limits(Keys):
    """Bounds on the figures of a run, for `figaroh-jax verify`; what is not given is not asked for."""

    verdict: tuple[Literal["nothing", "named", "named+rest", "unknown"], ...] | None = None  # allowed
    holdout_relative: Positive | dict[str, Positive] | None = None  # at most, of all joints or by joint
    gain: Number | None = None  # share by which all causes together lower the held-out error, at least
    p_value: Annotated[Number, Field(ge=0, le=1)] | None = None  # at least
    forbidden_causes: tuple[Effect, ...] | None = None
    rank: Annotated[int, Field(ge=0)] | None = None  # at least
    condition: Positive | None = None  # at most
    relative_std: Positive | None = None  # of identified base parameters, at most
    consistent: Switch | None = None  # every link physically consistent
    position_mm: Positive | None = None  # validated, at most
    orientation_deg: Positive | None = None
    fk_parity: Positive | None = None  # m, at most
    unexplained: Positive | None = None  # calibrate: share of the measured points' spread, at most


def load_limits(path: str | Path) -> Limits:
    """Read a file of limits; raises `InputError` that names file and key of the first mistake."""
    chain = read_task(Path(path))
    try:
        return Limits.model_validate(merge(chain), context=OF_A_FILE)
    except ValidationError as error:
        place, text = mistake(error.errors(include_url=False))
        raise InputError(f"{where(chain, place)}: {text}") from None


def load_task(path: str | Path | Mapping[str, Any]) -> Task:
    """Read and check a task file, or its keys as a mapping, whose relative paths are those of the working directory.

    Raises `InputError` that names file and key of the first mistake.

    >>> import figaroh_jax as fj
    >>> fj.load_task(fj.DEMO.replace("robot.urdf", "task.yaml")).preprocess.cutoff
    15.0
    >>> run = {"file": "run.npz", "rate": 250, "position": "q", "torque": "tau"}
    >>> fj.load_task({"robot": {"model": fj.DEMO}, "data": [run]}).robot.trust
    0.1
    """
    if not isinstance(path, (str, Path, Mapping)):
        kind = type(path).__name__
        raise InputError(f"load_task takes the name of a task file or its keys as a dictionary, not {kind}")
    chain = given_task(path) if isinstance(path, Mapping) else read_task(Path(path))
    try:
        task = Task.model_validate(merge(chain), context=OF_A_FILE)
    except ValidationError as error:
        place, text = mistake(error.errors(include_url=False))
        raise InputError(f"{where(chain, place)}: {text}") from None
    task._file = chain[-1][0]
    return task


def robot_options(robot: Robot) -> dict[str, Any]:
    """Arguments of `read_robot` and `load_extended` beside the file; gravity None is an MJCF's or a stage's own."""
    own = robot.model.suffix.lower() in (".xml", *USD) and "gravity" not in robot.model_fields_set
    gravity = None if own else robot.gravity
    return {"joints": robot.joints, "posture": dict(robot.posture), "gravity": gravity, "root": robot.root}
