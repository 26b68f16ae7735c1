"""Recordings from arrays in memory, without files: of torques (`recording`) and of measured postures (`postures`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float

from ..errors import InputError, check_kind, check_names, check_one_of, check_positive, check_real, nearest
from ..rigid.model import RobotModel
from . import poses
from .dataset import Memory, Recording, check_order, unit_factors, unnamed
from .devices import Device

if TYPE_CHECKING:
    from ..formats.config import Load

__all__ = ["postures", "recording"]

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SLOWEST = 1.5  # s between samples
KINDS = ("pose", "position", "plane", "socket", "camera", "device")


def recording(
    *,
    q: Float[ArrayLike, "samples nq"],
    tau: Float[ArrayLike, "samples nv"] | None = None,
    time: Float[ArrayLike, " samples"] | None = None,
    rate: float | None = None,
    v: Float[ArrayLike, "samples nv"] | None = None,
    command: Float[ArrayLike, "samples nv"] | None = None,
    model: RobotModel | None = None,
    joints: Sequence[str] | None = None,
    units: Mapping[str, str] | None = None,
    load: Load | None = None,
    repeat: str | None = None,
    role: Literal["fit", "holdout"] = "fit",
    name: str = "recording",
) -> Recording:
    """A recording of motion and torque from arrays, as `diagnose`, `identify` and `residual` take it.

    `q` position (rad; m for sliding joints), `tau` torque of the drives on the joint side (N m; N), `time` (s) or
    `rate` (Hz), `command` commanded position. `units` may say `{"position": "deg" | "mm", "velocity": "deg/s",
    "time": "ms" | "us" | "ns"}`; with degrees or millimetres at a robot that slides somewhere, and where `q` holds
    quaternions, give its `model`. Columns stand in the model's order; `joints` names them. A measured velocity `v` is
    kept for rollouts; identification and diagnosis differentiate the position, because controllers filter their
    velocity with a delay that nobody states. `repeat`: recordings with one label repeat one excitation; `role`
    "holdout" is not fitted. Raises `InputError` that names array, row and column.

    >>> import numpy as np, figaroh_jax as fj
    >>> t = np.arange(500) / 250.0
    >>> q = np.sin(2 * np.pi * 0.5 * t)[:, None] * np.array([0.5, 0.4, 0.3, 0.2])
    >>> run = fj.recording(q=q, tau=np.cos(q), rate=250, repeat="A")
    >>> run.position.shape, run.role
    ((500, 4), 'fit')
    """
    source = Memory(name)
    _check_words(joints, units, ("position", "velocity", "time"), role, load)
    if model is not None:
        check_kind("model", model, RobotModel, "load_urdf reads one; an ExtendedModel holds one as `.robot`")
    names = tuple(joints or (model.dof_names if model is not None else ()))
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{source}: joints names '{twice}' twice; one name for each column of tau is expected")
    given = {"v": v, "tau": tau, "command": command}
    arrays = {"q": _matrix(q, "q", source)}
    arrays |= {key: _matrix(x, key, source) for key, x in given.items() if x is not None}
    samples = len(arrays["q"])
    wrong = next((key for key, x in arrays.items() if len(x) != samples), None)
    if wrong:
        raise InputError(f"{source}: {wrong} has {len(arrays[wrong])} samples, but q has {samples}")
    columns = next((arrays[key].shape[1] for key in ("tau", "v") if key in arrays), arrays["q"].shape[1])
    names = names or unnamed(columns)
    if joints and model is not None:
        check_order(source, names, model)
    _check_columns(arrays, names, model, source)
    known = dict(units or {})
    seconds = _unit(known.pop("time", "s"), SECONDS, "time", source)
    angle, speed = known.pop("position", "rad"), known.pop("velocity", None)
    stamps = _clock(time, rate, samples, source, seconds)
    _check_pace(stamps, source)
    return Recording(
        name=name,
        file=source,
        joints=names,
        time=stamps,
        position=arrays["q"] * _factors(angle, model, arrays["q"].shape[1], source),
        velocity=arrays["v"] * _factors(speed or angle, model, columns, source, "v") if "v" in arrays else None,
        torque=arrays.get("tau"),
        command=arrays["command"] * _factors(angle, model, columns, source, "v") if "command" in arrays else None,
        load=load,
        repeat=repeat,
        role=role,
    )


def postures(
    *,
    q: Float[ArrayLike, "postures nq"],
    tool_frame: str,
    base_frame: str,
    unknown: Sequence[Literal["base_frame", "tool_frame"]] = ("base_frame", "tool_frame"),
    mount: Literal["hand", "world"] = "hand",
    device: Device | None = None,
    measured: Any = None,
    distance: float | None = None,
    accuracy: tuple[float | None, float | None] = (None, None),
    time: Float[ArrayLike, " postures"] | None = None,
    units: Mapping[str, str] | None = None,
    load: Load | None = None,
    role: Literal["fit", "holdout"] = "fit",
    name: str = "postures",
    **kinds: Any,
) -> poses.PoseRecording:
    """Postures in the order in which they were measured, and what a device saw at each, from arrays.

    One of: `pose` (n, 4, 4) or (n, 7) as x y z qx qy qz qw; `position` (n, 3) or (n, markers, 3), m; `plane` or
    `socket` (n,) numbers of what the tool point touched (`distance` of two sockets, m); `camera` (n, 4, 4) board in
    camera, with `mount`; or `device` of your own (`own_device`) with what it `measured`. `base_frame` and
    `tool_frame` are frames of the model, `unknown` those to be estimated; `q` in rad or m, or `units`
    `{"position": "deg", "measurement": "mm"}`; `accuracy` one sigma, m and rad. NaN: not measured.

    >>> import numpy as np, figaroh_jax as fj
    >>> q, seen = np.zeros((10, 4)), np.zeros((10, 3))
    >>> fj.postures(q=q, position=seen, base_frame="base", tool_frame="hand").kind
    'position'
    """
    source = Memory(name)
    _check_words(unknown, units, ("position", "measurement"), role, load, "unknown")
    for key, frame in {"base_frame": base_frame, "tool_frame": tool_frame}.items():
        check_kind(key, frame, str, "the name of a frame of the model")
    for one in unknown:
        check_one_of("unknown", one, ("base_frame", "tool_frame"))
    check_one_of("mount", mount, ("hand", "world"))
    if device is not None:
        check_kind("device", device, Device, "`own_device` makes one of your function")
    if distance is not None:
        check_positive("distance", distance, "m")
    check_accuracy(accuracy)
    position = _matrix(q, "q", source)
    if not len(position):
        raise InputError(f"{source}: q holds no posture")
    known = dict(units or {})
    scale = _unit(known.pop("measurement", "m"), {"m": 1.0, "mm": 1e-3}, "measurement", source)
    position = position * _factors(known.pop("position", "rad"), None, position.shape[1], source)
    kind, values = _measurement(kinds, device, measured, len(position), mount, scale, source)
    touched = kind in ("plane", "socket")
    return poses.PoseRecording(
        name=name,
        file=source,
        time=np.arange(len(position)) * 1.0 if time is None else _clock(time, None, len(position), source, 1.0),
        position=position,
        kind=kind,
        values=values,
        base_frame=base_frame,
        tool_frame=tool_frame,
        unknown=tuple(u for u in dict.fromkeys(unknown) if not (touched and u == "base_frame")),
        accuracy=accuracy,
        distance=distance,
        load=load,
        role=role,
        device=device,
        carried="camera" in kinds and poses.carried("camera", mount),
    )


def _check_words(names: Any, units: Any, known: Sequence[str], role: Any, load: Any, called: str = "joints") -> None:
    """Raise `InputError` for what is no list of names, units that are not known, another role, or no load."""
    check_names(called, names)
    for one in names or ():
        check_kind(called, one, str, f"{called} is a list of names")
    if units is not None:
        check_kind("units", units, Mapping, '{"position": "deg"}, say')
        for key, unit in units.items():
            if key not in known:
                raise InputError(f"units has no '{key}'{nearest(str(key), known)}")
            check_kind(f"units['{key}']", unit, str, '"deg", say')
    check_one_of("role", role, ("fit", "holdout"))
    if load is not None:
        from ..formats.recording_keys import Load

        check_kind("load", load, Load, "fj.Load(frame='hand', mass=2.0), in kg")


def check_accuracy(accuracy: Any, name: str = "accuracy", *, may_lack: bool = True) -> None:
    """Refuse all but two sigmas above zero, in m and in rad; None is one that is not known (`may_lack`)."""
    if isinstance(accuracy, str) or not hasattr(accuracy, "__len__") or len(accuracy) != 2:
        told = "two are expected: one sigma in m and one in rad" + ", or None" * may_lack
        raise InputError(f"{name} is {accuracy!r:.100}; {told}")
    for sigma, unit in zip(accuracy, ("m", "rad"), strict=True):
        if sigma is not None or not may_lack:
            check_positive(name, sigma, unit)


class _Table(NamedTuple):
    """What the checks of a measurement ask of a file."""

    file: Memory


def _measurement(
    kinds: dict[str, Any], device: Any, measured: Any, count: int, mount: str, scale: float, source: Memory
) -> tuple[Any, np.ndarray]:
    """Kind and values as `PoseRecording` holds them."""
    given = {**kinds, **({} if device is None else {"device": measured})}
    unknown = next((key for key in given if key not in KINDS), None)
    if unknown or len(given) != 1:
        hint = f"unknown '{unknown}'{nearest(unknown, KINDS)}" if unknown else f"{len(given)} are given"
        raise InputError(f"{source}: exactly one of {', '.join(KINDS)} is needed: {hint}")
    (kind, values), table = next(iter(given.items())), _Table(source)
    values = np.zeros(0) if values is None else _numbers(values, kind, source)
    if not values.ndim or len(values) != count:
        size = f"{len(values)} rows" if values.ndim else "one number"
        raise InputError(f"{source}: {kind} has {size}, but q has {count}")
    if kind == "device":
        return "own", values
    if kind in ("plane", "socket"):
        return kind, poses.whole_numbers(values, table, kind)
    if kind == "position":
        return kind, poses.points(values, table, kind) * scale
    found = poses.poses(values, table, kind)
    found[:, :3, 3] *= scale
    return "pose", poses.seen_from_board(found, table, kind) if poses.carried(kind, mount) else found


def _matrix(x: ArrayLike, key: str, source: Memory) -> np.ndarray:
    array = _numbers(x, key, source)
    if array.ndim != 2:
        raise InputError(f"{source}: {key} has shape {array.shape}, expected (samples, joints)")
    wrong = np.argwhere(~np.isfinite(array))
    if len(wrong):
        row, column = wrong[0]
        raise InputError(
            f"{source}: {key} is {array[row, column]} in row {row}, column {column} (from 0); leave such rows out, with"
            " their time: gaps of it are seen"
        )
    return array


def _numbers(x: ArrayLike, key: str, source: Memory) -> np.ndarray:
    check_real(f"{source}: {key}", x)
    try:
        return np.array(x, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{source}: {key} is not an array of numbers: {error}") from None


def _check_columns(
    arrays: dict[str, np.ndarray], names: tuple[str, ...], model: RobotModel | None, source: Memory
) -> None:
    nq = model.nq if model is not None else len(names)
    expected = {"q": nq, "v": len(names), "tau": len(names), "command": nq if model is not None else len(names)}
    for key, x in arrays.items():
        if x.shape[1] != expected[key]:
            raise InputError(f"{source}: {key} has {x.shape[1]} columns, expected {expected[key]} ({', '.join(names)})")


def _unit(unit: str, known: Mapping[str, float], what: str, source: Memory) -> float:
    if unit not in known:
        raise InputError(f"{source}: units.{what} is '{unit}'; known: {', '.join(known)}")
    return known[unit]


def _factors(unit: str, model: RobotModel | None, columns: int, source: Memory, of: Literal["q", "v"] = "q") -> Any:
    _unit(unit.split("/")[0], {"rad": 1.0, "m": 1.0, "deg": np.pi / 180, "mm": 1e-3}, "position", source)
    if model is not None:
        return unit_factors(unit, False, model, of)
    return np.full(columns, {"deg": np.pi / 180, "mm": 1e-3}.get(unit.split("/")[0], 1.0))


def _check_pace(stamps: np.ndarray, source: Memory) -> None:
    """Refuse samples so far apart that they are no record of a motion; their unit is then another one."""
    step = float(np.median(np.diff(stamps)))
    if step > _SLOWEST:
        unit = next((unit for unit, factor in SECONDS.items() if step * factor <= 0.1), "ns")
        raise InputError(
            f"{source}: one sample every {step:.4g} s is too few for a motion; the stamps look like {unit}: add"
            f' units={{"time": "{unit}"}}'
        )


def _clock(time: Any, rate: float | None, samples: int, source: Memory, seconds: float) -> np.ndarray:
    if samples < 2:
        raise InputError(f"{source}: {samples} sample(s); a recording is a motion over time")
    if (time is None) == (rate is None):
        raise InputError(f"{source}: give time or rate, one of the two")
    if time is None:
        check_positive(f"{source}: rate", rate, "Hz")
        return np.arange(samples) / float(rate or 0)
    stamps = _numbers(time, "time", source) * seconds
    if stamps.shape != (samples,):
        raise InputError(f"{source}: time has shape {stamps.shape}, expected ({samples},)")
    wrong = np.flatnonzero(~np.isfinite(stamps[1:]) | ~(np.diff(stamps) > 0))
    if len(wrong):
        raise InputError(f"{source}: time does not increase in row {wrong[0] + 1} (from 0)")
    return stamps
