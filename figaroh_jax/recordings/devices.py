r"""What a measuring device makes of the pose of the tool: residuals in m and rad, and the frames it leaves unknown.

A device is a small immutable object with one method, `residual(pose, unknown, datum)`, for one posture: `pose` is that
of the tool frame in the base frame, `unknown` the vector of what the device itself leaves open (its own place, the
place of its markers, of sockets, of planes), zero at the start, and `datum` what it measured. Derivatives are JAX's.
A device of your own is such a class, or a function given to `own_device`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..errors import InputError, check_each, check_finite, check_kind, check_positive
from ..rigid import lie
from ..rigid.model import Leaf

__all__ = [
    "ORIENTATION",
    "POSITION",
    "Device",
    "Distance",
    "Planes",
    "Points",
    "Poses",
    "Sockets",
    "own_device",
]

POSITION, ORIENTATION = 0, 1  # channels of a row: m or rad
_TWIST = ("x", "y", "z", "rx", "ry", "rz")
_FRAME_SCALE = (1e-2,) * 3 + (1e-2,) * 3  # m and rad: sizes at which the solver's steps are of order one


class Device(eqx.Module):
    """A measuring device; subclass it and write `residual`, and `unknowns` where it leaves something open."""

    def residual(self, pose: Float[Array, "4 4"], unknown: Float[Array, " k"], datum: Leaf) -> Float[Array, " rows"]:
        """Predicted minus measured, m or rad, for one posture."""
        raise NotImplementedError

    def unknowns(self) -> tuple[tuple[str, str, float], ...]:
        """Name, unit and typical size of every entry of `unknown`."""
        return ()

    def places(self, unknown: Float[Array, " k"]) -> dict[str, Float[Array, "*shape"]]:
        """Poses (4 4) and points (3) of the device's own frames for the report, by name."""
        return {}

    def channels(self) -> tuple[int, ...]:
        """Which of `residual`'s rows are positions (POSITION) and which angles (ORIENTATION)."""
        return (POSITION, POSITION, POSITION)

    def constraint(self, unknown: Float[Array, " k"]) -> Float[Array, " rows"]:
        """Rows in m that the unknowns alone must bring to zero, such as a known distance of two sockets."""
        return jnp.zeros(0)

    def moved(self, unknown: Float[Array, " k"]) -> Device:
        """The device with its unknowns put in: those of the new one are counted from there."""
        return _Moved(self, unknown)


class _Moved(Device):
    """A device with its unknowns put in."""

    device: Device
    by: Float[Leaf, " k"]

    def residual(self, pose: Array, unknown: Array, datum: Leaf) -> Float[Array, " rows"]:
        return self.device.residual(pose, self.by + unknown, datum)

    def unknowns(self) -> tuple[tuple[str, str, float], ...]:
        return self.device.unknowns()

    def places(self, unknown: Array) -> dict[str, Array]:
        return self.device.places(self.by + unknown)

    def channels(self) -> tuple[int, ...]:
        return self.device.channels()

    def constraint(self, unknown: Float[Array, " k"]) -> Float[Array, " rows"]:
        return self.device.constraint(self.by + unknown)


class Placed(Device):
    """A device that stands at an unknown or a known place and looks at a tool frame, perhaps unknown too.

    The unknown place is a twist about `centre`, the middle of what was measured: turning a far device about its own
    origin would move every point and stall the solver.
    """

    base: Float[Leaf, "4 4"]  # pose of the base frame in the device's frame, at the start
    centre: Float[Leaf, "3"]  # in the device's frame, m
    estimated: tuple[str, ...] = eqx.field(static=True)  # of "base_frame", "tool_frame"

    def device_T_base(self, unknown: Float[Array, " k"]) -> Float[Array, "4 4"]:
        """Pose of the base frame in the device's frame."""
        if "base_frame" not in self.estimated:
            return jnp.asarray(self.base)
        about = lie.pose(jnp.eye(3), jnp.asarray(self.centre))
        return about @ lie.exp_se3(unknown[:6]) @ lie.inverse_pose(about) @ self.base

    def _tool(self, unknown: Float[Array, " k"]) -> Float[Array, " tool"]:
        return unknown[6:] if "base_frame" in self.estimated else unknown

    def _base_unknowns(self) -> tuple[tuple[str, str, float], ...]:
        return _frame("base_frame") if "base_frame" in self.estimated else ()


class Points(Placed):
    """One or more points on the tool, measured in the device's frame: a tracker, motion capture, a touch probe."""

    markers: Float[Leaf, "markers 3"]  # in the tool frame, m, at the start

    def residual(self, pose: Array, unknown: Array, datum: Leaf) -> Float[Array, " rows"]:
        """Predicted minus measured points, m, marker by marker (3 markers,); `datum` is (markers, 3)."""
        device_T_tool = self.device_T_base(unknown) @ pose
        points = self.points(unknown) @ device_T_tool[:3, :3].T + device_T_tool[:3, 3]
        return (points - datum).reshape(-1)

    def places(self, unknown: Array) -> dict[str, Array]:
        """Pose of the base frame in the device's frame, and the markers in the tool frame (m)."""
        return {"base_frame": self.device_T_base(unknown), "tool_frame": self.points(unknown)}

    def points(self, unknown: Float[Array, " k"]) -> Float[Array, "markers 3"]:
        """The markers in the tool frame, m."""
        if "tool_frame" not in self.estimated:
            return jnp.asarray(self.markers)
        return self.markers + self._tool(unknown).reshape(-1, 3)

    def unknowns(self) -> tuple[tuple[str, str, float], ...]:
        """Twist of the base frame, then the coordinates of every marker, of what is estimated."""
        return self._base_unknowns() + (
            _points("tool_frame", len(self.markers)) if "tool_frame" in self.estimated else ()
        )

    def channels(self) -> tuple[int, ...]:
        """Positions alone."""
        return (POSITION,) * (3 * len(self.markers))


class Poses(Placed):
    """Position and orientation of the tool in the device's frame.

    The rows are the difference of the positions, on the device's axes or (`axes` "body") on the measured ones, and the
    logarithm of the rotation from the measured to the predicted orientation; with `axes` "twist", the logarithm of the
    whole motion from the one pose to the other. `axes` "sight" is for a camera that the robot carries, whose pose is
    told by what it sees: how far the device's origin, the board, stands elsewhere in the camera, to first order. There
    the errors of position and orientation are those of the camera; in the camera's own position they are mixed.
    """

    tool: Float[Leaf, "4 4"]  # pose of the marker in the tool frame, at the start
    axes: Literal["device", "body", "twist", "sight"] = eqx.field(static=True, default="device")

    def residual(self, pose: Array, unknown: Array, datum: Leaf) -> Float[Array, "6"]:
        """Predicted against measured pose (4, 4): three rows in m, three in rad; see the class for their axes."""
        predicted = self.device_T_base(unknown) @ pose @ self.tool_T_marker(unknown)
        if self.axes == "twist":
            return lie.log_se3(lie.inverse_pose(datum) @ predicted)
        turn = lie.log_so3(datum[:3, :3].T @ predicted[:3, :3])
        away = predicted[:3, 3] - datum[:3, 3]
        if self.axes != "device":
            away = datum[:3, :3].T @ away
        if self.axes == "sight":
            away = away + jnp.cross(turn, -datum[:3, :3].T @ datum[:3, 3])
        return jnp.concatenate([away, turn])

    def places(self, unknown: Array) -> dict[str, Array]:
        """Poses (4, 4): the base frame in the device's frame, the marker in the tool frame."""
        return {"base_frame": self.device_T_base(unknown), "tool_frame": self.tool_T_marker(unknown)}

    def tool_T_marker(self, unknown: Float[Array, " k"]) -> Float[Array, "4 4"]:
        """Pose of the marker in the tool frame."""
        return (
            self.tool @ lie.exp_se3(self._tool(unknown)) if "tool_frame" in self.estimated else jnp.asarray(self.tool)
        )

    def unknowns(self) -> tuple[tuple[str, str, float], ...]:
        """Twist of the base frame, then of the marker in the tool frame, of what is estimated."""
        return self._base_unknowns() + (_frame("tool_frame") if "tool_frame" in self.estimated else ())

    def channels(self) -> tuple[int, ...]:
        """Three positions, three angles."""
        return (POSITION,) * 3 + (ORIENTATION,) * 3


class _Touch(Device):
    """A point of the tool, perhaps unknown, that touches something fixed to the base."""

    point: Float[Leaf, "3"]  # in the tool frame, m, at the start
    estimated: tuple[str, ...] = eqx.field(static=True)

    def tool_point(self, unknown: Float[Array, " k"]) -> Float[Array, "3"]:
        """The point in the tool frame, m."""
        return self.point + unknown[:3] if "tool_frame" in self.estimated else jnp.asarray(self.point)

    def places(self, unknown: Array) -> dict[str, Array]:
        return {"tool_frame": self.tool_point(unknown)}

    def _fixed(self, unknown: Float[Array, " k"]) -> Float[Array, "things 3"]:
        return unknown[3 if "tool_frame" in self.estimated else 0 :].reshape(-1, 3)

    def _tool_unknowns(self) -> tuple[tuple[str, str, float], ...]:
        return _points("tool_frame", 1) if "tool_frame" in self.estimated else ()


class Sockets(_Touch):
    """The tool point sits in one of several sockets at unknown places; `datum` is the number of the socket."""

    sockets: Float[Leaf, "sockets 3"]  # in the base frame, m, at the start
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True, default=())  # sockets of known distance
    distance: Float[Leaf, " pairs"] = eqx.field(default_factory=lambda: np.zeros(0))  # m
    weight: Float[Leaf, " pairs"] = eqx.field(default_factory=lambda: np.zeros(0))  # root of the postures that carry it

    def centres(self, unknown: Float[Array, " k"]) -> Float[Array, "sockets 3"]:
        """The sockets in the base frame, m."""
        return self.sockets + self._fixed(unknown)

    def residual(self, pose: Array, unknown: Array, datum: Leaf) -> Float[Array, "3"]:
        """From the centre of the socket numbered `datum` to the tool point, in the base frame (3,), m."""
        return pose[:3, :3] @ self.tool_point(unknown) + pose[:3, 3] - self.centres(unknown)[datum]

    def constraint(self, unknown: Float[Array, " k"]) -> Float[Array, " pairs"]:
        """Distances of the `pairs` of sockets minus the known ones (pairs,), m, weighted as the postures are many."""
        place = self.centres(unknown)
        if not self.pairs:
            return jnp.zeros(0)
        a, b = np.array(self.pairs).T
        return self.weight * (jnp.linalg.norm(place[a] - place[b], axis=1) - self.distance)

    def unknowns(self) -> tuple[tuple[str, str, float], ...]:
        """The tool point, if it is estimated, then the centre of every socket."""
        return self._tool_unknowns() + _points("socket", len(self.sockets))


class Planes(_Touch):
    """The tool point touches one of several fixed, unknown planes; `datum` is the number of the plane.

    A plane is the axes at its start (the third one its normal), a point on it, and three unknowns: two tilts, a shift.
    """

    axes: Float[Leaf, "planes 3 3"]
    origin: Float[Leaf, "planes 3"]  # m

    def residual(self, pose: Array, unknown: Array, datum: Leaf) -> Float[Array, "1"]:
        """Height of the tool point over the plane numbered `datum` (1,), m."""
        tilt_x, tilt_y, shift = self._fixed(unknown)[datum]
        x, y, normal = self.axes[datum]
        tilted = normal + tilt_x * x + tilt_y * y
        point = pose[:3, :3] @ self.tool_point(unknown) + pose[:3, 3]
        return jnp.atleast_1d((tilted @ (point - self.origin[datum])) / jnp.linalg.norm(tilted) - shift)

    def channels(self) -> tuple[int, ...]:
        """One position."""
        return (POSITION,)

    def unknowns(self) -> tuple[tuple[str, str, float], ...]:
        """The tool point, if it is estimated, then two tilts (rad) and a shift (m) of every plane."""
        each = (("tilt x", "rad"), ("tilt y", "rad"), ("shift", "m"))
        planes = ((f"plane {k} {name}", unit, 1e-2) for k in range(len(self.axes)) for name, unit in each)
        return self._tool_unknowns() + tuple(planes)


class Distance(_Touch):
    """Only the distance from a fixed, unknown point is measured: a wire encoder, a ball bar; `datum` in m."""

    anchor: Float[Leaf, "3"]  # in the base frame, m, at the start

    def residual(self, pose: Array, unknown: Array, datum: Leaf) -> Float[Array, "1"]:
        """Predicted minus measured distance of the tool point from the anchor (1,), m."""
        point = pose[:3, :3] @ self.tool_point(unknown) + pose[:3, 3]
        return jnp.atleast_1d(jnp.linalg.norm(point - self.anchor - self._fixed(unknown)[0]) - datum)

    def channels(self) -> tuple[int, ...]:
        """One position."""
        return (POSITION,)

    def unknowns(self) -> tuple[tuple[str, str, float], ...]:
        """The tool point, if it is estimated, then the anchor in the base frame."""
        return self._tool_unknowns() + _points("anchor", 1)


class _Own(Device):
    """A device given as a function."""

    start: Float[Leaf, " k"]
    function: Callable[[Array, Array, Any], Array] = eqx.field(static=True)
    names: tuple[tuple[str, str, float], ...] = eqx.field(static=True)
    kinds: tuple[int, ...] = eqx.field(static=True)

    def residual(self, pose: Array, unknown: Array, datum: Leaf) -> Float[Array, " rows"]:
        return jnp.atleast_1d(self.function(pose, self.start + unknown, datum))

    def unknowns(self) -> tuple[tuple[str, str, float], ...]:
        return self.names

    def channels(self) -> tuple[int, ...]:
        return self.kinds


def own_device(
    residual: Callable[[Float[Array, "4 4"], Float[Array, " k"], Any], Float[Array, " rows"]],
    unknowns: Mapping[str, tuple[float, str, float]],
    channels: Sequence[int] = (POSITION,),
) -> Device:
    """A measuring device of your own from a function: the differentiable `residual(pose, unknown, datum)`.

    `pose` is that of the tool frame in the base frame, `datum` what was measured in the posture; given back is
    predicted minus measured, m (POSITION) or rad (ORIENTATION) as `channels` says row by row. `unknowns` names what
    the device leaves open, in the order in which the function takes it: its start, its unit, and about how far off
    that is.
    Hand it to `fj.postures(device=..., measured=...)`.

    >>> import jax.numpy as jnp, figaroh_jax as fj
    >>> wire = lambda pose, unknown, length: jnp.linalg.norm(pose[:3, 3] - unknown)[None] - length
    >>> device = fj.own_device(wire, {f"eyelet {axis}": (1.0, "m", 0.1) for axis in "xyz"})
    >>> [name for name, unit, size in device.unknowns()]
    ['eyelet x', 'eyelet y', 'eyelet z']
    """
    if not callable(residual):
        raise InputError(f"residual is of type {type(residual).__name__}; residual(pose, unknown, datum) is expected")
    check_kind("unknowns", unknowns, Mapping, "{'offset': (start, unit, about how far off)}")
    check_each("channels", channels, int, "one number for each row: POSITION or ORIENTATION")
    names, starts = [], []
    for name, given in unknowns.items():
        try:
            start, unit, size = given
            check_finite(f"unknowns['{name}']: its start", start)
            check_positive(f"unknowns['{name}'], about how far off,", size, str(unit))
            starts.append(float(start))
            names.append((str(name), str(unit), float(size)))
        except (TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"unknowns['{name}'] is {given!r:.100}; its start, its unit and about how far off that is are expected,"
                " (1.0, 'm', 0.1) say"
            ) from None
    return _Own(np.array(starts), residual, tuple(names), tuple(channels))


def _frame(name: str) -> tuple[tuple[str, str, float], ...]:
    return tuple((f"{name} {axis}", "m" if k < 3 else "rad", _FRAME_SCALE[k]) for k, axis in enumerate(_TWIST))


def _points(name: str, count: int) -> tuple[tuple[str, str, float], ...]:
    numbers: Sequence[str] = [f" {k + 1}" if count > 1 else "" for k in range(count)]
    return tuple((f"{name}{number} {axis}", "m", 1e-2) for number in numbers for axis in "xyz")
