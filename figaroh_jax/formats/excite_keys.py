"""Keys of a task file below `excite`: what is designed, within which limits, around what."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from .fields import Effect, Keys, Number, Positive, Vector
from .recording_keys import Measurement

__all__ = ["Body", "Excite", "MotionBasis", "MotionLimits", "Obstacle", "Sight", "SizedEffect", "Touched"]


class MotionBasis(Keys):
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


class MotionLimits(Keys):
    """What a designed motion may use: `model` is what the robot's file says, a number or a map by joint replaces it.

    `none` waives the limit of a model; an empty value, which may be a forgotten one, is refused.
    """

    position: Literal["model"] | Positive | dict[str, Positive | tuple[Number, Number]] = "model"  # rad or m
    velocity: Literal["model", "none"] | Positive | dict[str, Positive] = "model"
    acceleration: Positive | dict[str, Positive] | None = None  # rad/s^2 or m/s^2; None: no limit
    torque: Literal["model", "none"] | Positive | dict[str, Positive] = "model"  # N m or N
    clearance: Positive | None = None  # m, between bodies that no joint joins, the floor, boxes; None: not looked at


class Body(Keys):
    """A capsule or a sphere on a link, in the place of its collision shapes."""

    link: str  # or any frame of the model
    at: Vector = (0.0, 0.0, 0.0)  # m, in that frame: the middle of a sphere, one end of a capsule's axis
    to: Vector | None = None  # the other end
    radius: Positive  # m


class Obstacle(Keys):
    """A box that stands in the world."""

    name: str
    size: tuple[Positive, Positive, Positive]  # edges, m
    at: Vector  # its middle, m
    turn: Vector = (0.0, 0.0, 0.0)  # roll, pitch, yaw, rad


class Sight(Keys):
    """What the device of postures can see, in its base frame."""

    place: Vector  # m: of a fixed device, or of the board that a device in the hand looks at
    axis: Vector | None = None  # its line of sight, or the board's normal; None: any direction
    cone: Annotated[Positive, Field(le=3.15)] = 0.5  # rad, half angle of what the device sees
    tilt: Annotated[Positive, Field(le=3.15)] = 1.0  # rad, between the target's normal and the line of sight
    near: Positive = 0.1  # m
    far: Positive = 10.0


class Touched(Keys):
    """A plane or a socket that postures are to touch, in the device's base frame."""

    place: Vector  # m: the socket, or a point on the plane
    axis: Vector | None = None  # of a plane: its normal, towards the robot; of a socket: the way out of it
    radius: Positive = 0.3  # m around the place: how much of the plane is there
    tilt: Annotated[Positive, Field(le=3.15)] = 3.15  # rad, between the tool's z axis and the way in


class SizedEffect(Keys):
    """A cause that is to be told from another, and how large it is taken to be."""

    effect: Effect
    at: tuple[str, ...] = ()
    size: dict[str, Number] = {}  # its parameters; by default as large as twice the noise


class Excite(Keys):
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
