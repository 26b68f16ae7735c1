"""The reference of the task file: every key with its unit, an example and what happens without it.

The type, the allowed values and the default of a key are read from its definition (`config`); a test compares the two
lists, so that a key without a line here does not pass.
"""

from __future__ import annotations

import types
from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from . import config

__all__ = ["KEYS", "Key", "keys", "limits_keys", "markdown"]


class Key(NamedTuple):
    """A key of the task file, by its path."""

    path: str
    kind: str  # type or allowed values, in words
    default: str
    unit: str
    example: str
    without: str


# path: unit, example, what happens without it
KEYS: dict[str, tuple[str, str, str]] = {
    "robot.model": ("", "robot.urdf", "the task is refused; .urdf, .xml (MJCF) or .usd, no meshes are read"),
    "robot.root": ("", "free_flyer", "the root is fixed to the world"),
    "robot.joints": ("", "[shoulder, elbow]", "all joints move, in the order of the model's tree"),
    "robot.posture": ("rad, m", "{finger: 0.02}", "joints that do not move are locked at zero"),
    "robot.gravity": ("m/s²", "[0, 0, -9.81]", "gravity points down in the root's frame; an MJCF's own is taken"),
    "robot.trust": ("1, relative σ", "0.05", "nominal inertials are believed within 10 % (one standard deviation)"),
    "data[].file": ("", "run1.csv", "the entry is refused"),
    "data[].format": ("", "rtde", "columns are those that the entry names; with it those of the robot's log"),
    "data[].topic": ("", "/joint_states", "the one topic of joints in the bag; several are an error that lists them"),
    "data[].episode": (
        "",
        "3",
        "the only episode of a LeRobot folder, or run of a list of them in JSON; of several one must be named",
    ),
    "data[].position": ("rad, m", "[q1, q2]", "the entry is refused; an array, a list of columns or a prefix"),
    "data[].time": ("s", "t", "`rate` must say how often samples come; postures are counted"),
    "data[].rate": ("Hz", "500", "`time` must name the column of the stamps"),
    "data[].velocity": ("rad/s, m/s", "dq", "the velocity is the derivative of the filtered position"),
    "data[].torque": ("N m, N", "tau", "a holdout recording is predicted; a fit recording needs it, or a command"),
    "data[].command": ("rad, m; motors: N m, N", "u", "no rollouts: the recording is judged by its torque"),
    "data[].load.frame": ("", "tool0", "no payload is carried"),
    "data[].load.mass": ("kg", "2.0", "a load needs it"),
    "data[].load.com": ("m", "[0, 0, 0.05]", "the load is a point at the frame's origin"),
    "data[].repeat": ("", "A", "the noise is estimated from a rich model instead of from repeats"),
    "data[].role": ("", "holdout", "the recording is fitted"),
    "data[].units.time": ("", "ns", "stamps are seconds; ISO times are read as they are"),
    "data[].units.position": ("", "deg", "positions are rad, and m at prismatic joints"),
    "data[].units.velocity": ("", "deg/s", "as the position, per second"),
    "data[].units.torque": ("", "A", "torque is N m or N; for A, mA and % `transmission.torque` gives the constants"),
    "data[].units.measurement": ("", "mm", "points are in m"),
    "data[].units.orientation": ("", "deg", "angles of `orientation: rpy` and `rotvec` are in rad"),
    "data[].measurement.pose": ("m, 1", "pose", "another kind must be given; 4x4, x y z qx qy qz qw, `orientation`"),
    "data[].measurement.position": ("m", "[x, y, z]", "another kind must be given; points on the tool"),
    "data[].measurement.plane": ("", "plane", "another kind must be given; the tool point touches a plane"),
    "data[].measurement.socket": ("", "socket", "another kind must be given; the tool point sits in a socket"),
    "data[].measurement.camera": ("m, 1", "board", "another kind must be given; pose of a board in the camera"),
    "data[].measurement.base_frame": ("", "base_link", "the device's pose is relative to the root"),
    "data[].measurement.tool_frame": ("", "tool0", "the measurement is refused: which frame is measured?"),
    "data[].measurement.unknown": ("", "[base_frame, tool_frame]", "both transforms are taken as identity"),
    "data[].measurement.accuracy.position": ("m, one σ", "1.0e-4", "the noise is estimated from the residuals"),
    "data[].measurement.accuracy.orientation": ("rad, one σ", "1.0e-3", "the noise is estimated from the residuals"),
    "data[].measurement.distance": ("m", "0.05", "the distance of two sockets is not used"),
    "data[].measurement.mount": ("", "hand", "a camera needs it: in the hand or in the world"),
    "data[].measurement.orientation": (
        "",
        "rpy",
        "orientations are quaternions x y z w; rpy: roll pitch yaw about fixed x, y, z; rotvec: axis times angle",
    ),
    "transmission.position": ("1", "[100, 100]", "positions are on the joint side"),
    "transmission.torque": ("1, N m/A, N m/%", "[11.2, 9.8]", "torque is on the joint side and in N m"),
    "transmission.offset": ("rad, m", "[0.0, -1.5708]", "the zeros of the encoders are those of the model"),
    "preprocess.window": ("s", "[0.5, 12.0]", "the whole recording is kept"),
    "preprocess.cutoff": ("Hz", "15", "chosen from the bandwidth of the motion"),
    "preprocess.rate": ("Hz", "100", "chosen from the cutoff"),
    "preprocess.gate": ("rad/s, m/s", "{elbow: 0.05}", "no sample is dropped for its speed"),
    "baseline.viscous": ("", "false", "viscous friction of every joint is fitted"),
    "baseline.coulomb": ("", "false", "Coulomb friction of every joint is fitted"),
    "baseline.rotor": ("", "true", "rotor inertia is not part of the baseline: it can be named"),
    "baseline.offset": ("", "true", "torque offsets are not part of the baseline: they can be named"),
    "baseline.effects[].effect": ("", "coupled_transmission", "nothing else is known of the robot"),
    "baseline.effects[].at": ("", "[joint_5, joint_6]", "the effect acts on the whole robot"),
    "actuator.gains": ("", "free", "the gains of the drives are taken as right"),
    "actuator.<joint>.kind": ("", "velocity", "the drive is a position servo"),
    "actuator.<joint>.kp": ("N m/rad", "17.8", "a position servo of a URDF needs it"),
    "actuator.<joint>.kd": ("N m s/rad", "0.6", "the drive has no damping of its own"),
    "actuator.<joint>.force": ("N m", "3.35", "the drive has no limit"),
    "rollout.window": ("s", "0.5", "chosen so that errors stay readable; `whole`: never reset to the measured state"),
    "diagnose.forbid": ("", "[torque_delay]", "every effect of the catalogue is looked for"),
    "diagnose.alpha": ("1", "0.01", "a name may be wrong by chance once in twenty families of tests"),
    "diagnose.tolerance.torque": ("1, of the RMS", "0.02", "a misfit below 1 % of a joint's torque is `nothing`"),
    "diagnose.tolerance.offset": ("rad", "0.002", "offsets below 1 mrad are `nothing`"),
    "diagnose.tolerance.geometry": ("m", "0.001", "errors of geometry below 0.5 mm are `nothing`"),
    "diagnose.tolerance.position": ("rad", "0.002", "stated: rollouts that stay within it are `nothing`"),
    "identify.fit": ("", "unconstrained", "links are physically consistent, by a conic solver"),
    "identify.joints": ("", "[elbow]", "the torque of every joint is fitted that moves"),
    "identify.bounds.<link>.mass": ("kg", "[1.0, 3.0]", "the mass is bounded by consistency alone"),
    "identify.bounds.<link>.com": ("m", "[[-0.1, -0.1, 0], [0.1, 0.1, 0.4]]", "no box around the centre of mass"),
    "identify.infeasible": ("", "write", "`model/` is not written if a link is not physically consistent"),
    "excite.kind": ("", "postures", "trajectories are designed"),
    "excite.duration": ("s", "20", "each trajectory takes 10 s"),
    "excite.trajectories": ("", "3", "one trajectory"),
    "excite.basis.fourier": ("harmonics", "5", "five harmonics, unless another basis is given"),
    "excite.basis.base": ("Hz", "0.1", "one period a motion"),
    "excite.basis.spline": ("points", "9", "no spline"),
    "excite.basis.quintic": ("waypoints", "5", "no waypoints"),
    "excite.limits.position": ("rad, m", "{elbow: [-1, 1]}", "the model's limits hold"),
    "excite.limits.velocity": ("rad/s, m/s", "1.5", "the model's limits hold; `none`: no limit of the velocity"),
    "excite.limits.acceleration": ("rad/s², m/s²", "8.0", "the acceleration has no limit of its own"),
    "excite.limits.torque": ("N m, N", "{elbow: 20}", "the model's limits hold; `none`: no limit of the torque"),
    "excite.limits.clearance": ("m", "0.02", "distances between bodies are not looked at"),
    "excite.objective": ("", "condition", "the determinant of the information is maximised"),
    "excite.predict": ("", "[motion.npz]", "`objective: prediction` needs it: the motions that matter"),
    "excite.separate": ("", "[[{effect: rotor_inertia, at: [j3]}, ...]]", "`objective: separate` needs it"),
    "excite.noise": ("1, of the torque", "0.02", "that of the recordings, or 1 % of the largest torque"),
    "excite.start": ("rad, m", "[0, 0.5]", "the posture at the beginning is chosen"),
    "excite.starts": ("", "10", "four random motions are improved and the best is kept"),
    "excite.rate": ("Hz", "50", "a design counts 20 independent samples a second"),
    "excite.postures": ("", "60", "30 postures are chosen"),
    "excite.candidates": ("", "2000", "from 500 random ones"),
    "excite.floor": ("m", "0.0", "no floor is kept clear of; its height in the world"),
    "excite.boxes[].name": ("", "table", "no box is kept clear of; a box needs a name"),
    "excite.boxes[].size": ("m", "[1.0, 0.6, 0.1]", "a box needs the lengths of its edges"),
    "excite.boxes[].at": ("m", "[0.5, 0, 0.4]", "a box needs its middle"),
    "excite.boxes[].turn": ("rad", "[0, 0, 0.3]", "the box is not turned; roll, pitch, yaw"),
    "excite.bodies[].link": ("", "forearm", "links have the collision shapes of their file"),
    "excite.bodies[].at": ("m", "[0, 0, 0.1]", "the capsule begins at the frame's origin"),
    "excite.bodies[].to": ("m", "[0, 0, 0.3]", "the body is a sphere"),
    "excite.bodies[].radius": ("m", "0.06", "a body needs it"),
    "excite.view.place": ("m", "[1.5, 0, 1.0]", "what the device of postures can see is not looked at"),
    "excite.view.axis": ("", "[-1, 0, 0]", "a fixed device sees in any direction"),
    "excite.view.cone": ("rad", "0.4", "the device sees within 0.5 rad of its axis"),
    "excite.view.tilt": ("rad", "0.8", "the target may be turned away by 1 rad"),
    "excite.view.near": ("m", "0.3", "from a distance of 0.1 m"),
    "excite.view.far": ("m", "3.0", "to a distance of 10 m"),
    "excite.touch[].place": (
        "m",
        "[0.5, 0, 0.1]",
        "no plane or socket is touched; the socket, or a point on the plane",
    ),
    "excite.touch[].axis": ("", "[0, 0, 1]", "a socket is open to every side; a plane needs its normal"),
    "excite.touch[].radius": ("m", "0.2", "a plane is there within 0.3 m of its place"),
    "excite.touch[].tilt": ("rad", "0.8", "the tool may come from any side"),
    "excite.point": ("m", "[0, 0, 0.1]", "the origin of the tool frame touches planes and sockets"),
    "excite.ignore": ("", "[[hand, forearm]]", "every pair of bodies that no joint joins keeps clear"),
    "excite.measurement": ("", "{position: p, tool_frame: tool0}", "the device of the recordings"),
}
LIMITS: dict[str, tuple[str, str, str]] = {
    "verdict": ("", "[nothing, named]", "any verdict passes"),
    "holdout_relative": ("1", "0.05", "the held-out error is not judged; a number or a map by joint"),
    "gain": ("1", "0.1", "the joint gain of all causes is not judged"),
    "p_value": ("1", "0.01", "the p value is not judged"),
    "forbidden_causes": ("", "[torque_delay]", "any cause passes"),
    "rank": ("", "40", "the number of excited base parameters is not judged"),
    "condition": ("1", "200", "the condition number is not judged"),
    "relative_std": ("1", "0.1", "the largest relative σ of an identified base parameter is not judged"),
    "consistent": ("", "true", "links that are not physically consistent pass"),
    "position_mm": ("mm", "0.5", "the validated error of position is not judged"),
    "orientation_deg": ("deg", "0.1", "the validated error of orientation is not judged"),
    "fk_parity": ("m", "1.0e-9", "the exported model is not compared with the calibrated one"),
    "unexplained": ("1", "0.12", "the share of the measured points' spread that the calibration leaves is not judged"),
}
_OPEN = {"actuator": ("<joint>", config.JointDrive), "identify.bounds": ("<link>", config.Bound)}
_WHOLE = ("excite.measurement", "excite.separate")  # whose own keys stand elsewhere


def keys() -> tuple[Key, ...]:
    """Every key of the task file; raises `KeyError` for one of which `KEYS` says nothing."""
    return tuple(Key(path, kind, default, *KEYS[path]) for path, kind, default in _of(config.Task, ""))


def limits_keys() -> tuple[Key, ...]:
    """Every key of LIMITS.yaml."""
    return tuple(Key(path, kind, default, *LIMITS[path]) for path, kind, default in _of(config.Limits, ""))


def _of(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, str, str]]:
    for name, field in model.model_fields.items():
        path = f"{prefix}{name}"
        inner, listed = _model(field.annotation)
        whole = inner is None or path in _WHOLE or (path in _OPEN and inner is _OPEN[path][1])
        if inner is not None and not whole:
            yield from _of(inner, f"{path}{'[]' if listed else ''}.")
        elif path not in _OPEN:
            yield path, _kind(field.annotation), _default(field)
        if path in _OPEN:
            yield from _of(_OPEN[path][1], f"{path}.{_OPEN[path][0]}.")


def _model(annotation: Any) -> tuple[type[BaseModel] | None, bool]:
    """The model that a field holds, and whether it holds a list of them."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, False
    listed = get_origin(annotation) is tuple
    found = [(inner, listed or more) for one in get_args(annotation) for inner, more in [_model(one)] if inner]
    return found[0] if found else (None, False)


_PLAIN = {str: "text", float: "number", int: "whole number", bool: "true or false", type(None): ""}


def _kind(annotation: Any) -> str:
    """The type in words."""
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _kind(args[0])
    if origin is Literal:
        return ", ".join(map(str, args))
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(filter(None, map(_kind, args))))
    if origin in (tuple, list):
        return f"list of {_kind(args[0])}"
    if origin is dict:
        return f"map of {_kind(args[1])}"
    return _PLAIN.get(annotation, "name of a file" if getattr(annotation, "__name__", "") == "Path" else "keys")


def _default(field: Any) -> str:
    value = field.default
    if value is PydanticUndefined:
        return "needed"
    if value is None or value == () or value == {}:
        return "–"
    if isinstance(value, bool):
        return str(value).lower()
    return "keys" if isinstance(value, BaseModel) else str(value)


_HEAD = "| key | what | unit | default | example | without it |\n|---|---|---|---|---|---|\n"


def markdown() -> str:
    """The page of the reference."""
    parts = ["# The task file\n\nEvery key, generated from the code. *Needed*: there is no default.\n"]
    block = ""
    for key in (*keys(),):
        first = key.path.split(".")[0].removesuffix("[]")
        if first != block:
            block = first
            parts.append(f"\n## `{block}`\n\n{_HEAD}")
        parts.append(_row(key))
    parts.append("\n## LIMITS.yaml\n\nFor `figaroh-jax verify`; a figure that a run did not measure is `skipped`.\n")
    parts.append(f"\n{_HEAD}")
    return "".join([*parts, *map(_row, limits_keys())])


def _row(key: Key) -> str:
    cells = (f"`{key.path}`", key.kind, key.unit, key.default, f"`{key.example}`", key.without)
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |\n"
