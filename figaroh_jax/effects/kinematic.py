r"""The catalogue at kinematic level: every effect is a small twist on joints, as a function of the posture.

Each entry has its equation, its parameters with units, and where it may act. Notation: S the twist of a unit motion of
the joint, q its measured position, q' that of the posture before, tau_g and m_g the torque about the axis and the
moments across it that gravity puts on the joint (N m, positive where it pulls), t the time since the first posture.
The true position is the measured one plus the effect. A twist `[linear, angular]` (m, rad) is in the joint frame,
before the joint moves; a coefficient times its field is what the joint's twist gains.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError, nearest
from ..rigid.chain import joint_axis
from ..rigid.model import RobotModel, dofs

__all__ = ["CATALOGUE", "HISTORY", "Column", "KinematicEffect", "Postures", "columns_of", "find_kinematic"]

Array = np.ndarray
_ORDERS = tuple(np.arange(2.0, 12.5, 0.5))  # of gear errors, per turn of the joint


class Postures(NamedTuple):
    """Postures of one recording, in the order in which they were measured, and what gravity does in them."""

    q: Float[np.ndarray, "samples nv"]  # rad or m
    before: Float[np.ndarray, "samples nv"]  # the posture measured before; the first one's own
    torque: Float[np.ndarray, "samples nj"]  # gravity about each joint's axis, N m or N
    moment: Float[np.ndarray, "samples nj 3"]  # gravity's moment at each joint, in the joint frame, N m
    payload: Float[np.ndarray, "samples nj"]  # as torque, of the carried load alone
    time: Float[np.ndarray, " samples"]  # s
    duration: float  # s, of all recordings together


class Column(NamedTuple):
    """One linear parameter: where it acts and the twist of a unit of it, for postures at hand."""

    effect: str
    at: tuple[str, ...]
    parameter: str
    unit: str
    pieces: tuple[tuple[int, Callable[[Postures], Float[np.ndarray, "6 samples"]]], ...]  # tree joint, twist

    @property
    def label(self) -> str:
        """Name as it stands in result.json: "joint_offset joint_3", "link_geometry joint_3 y"."""
        alone = self.parameter in ("offset", "scale", "compliance", "amount", "growth", "width")
        return " ".join([self.effect, *self.at, *(() if alone else (self.parameter,))])


class KinematicEffect(NamedTuple):
    """An effect that can be named: `build` gives its columns at one place, for one value of its shape parameter."""

    name: str
    title: str
    equation: str
    acts_on: Literal["joint", "pair", "robot", "frame"]  # a frame: `at` is its joint and its own index
    build: Callable[[RobotModel, tuple[int, ...], float], Iterator[tuple[str, str, Sequence[tuple[int, Callable]]]]]
    shape: tuple[str, tuple[float, ...]] = ("", (0.0,))  # name and grid of the parameter that is not linear
    separated_by: str = ""


def _along(scalar: Callable[[Postures, int], Array]) -> Callable:
    """Effect along the joint's own motion: S times a scalar of the posture."""

    def field(model: RobotModel, joint: int) -> tuple[int, Callable[[Postures], Array]]:
        motion = axis_twist(model, joint)
        return joint, lambda postures: motion[:, None] * scalar(postures, joint)

    return field


def axis_twist(model: RobotModel, joint: int) -> Float[np.ndarray, "6"]:
    """Twist S of a unit motion of a joint, in its own frame."""
    twist = np.zeros(6)
    twist[3 * (model.joints[joint].kind == "revolute") :][:3] = joint_axis(model, joint)
    return twist


def across(model: RobotModel, joint: int) -> Float[np.ndarray, "2 3"]:
    """Two unit vectors across the joint's axis, the first one along a frame axis where it can be."""
    axis = joint_axis(model, joint)
    x = np.eye(3)[np.argmin(np.abs(axis))]
    x = x - (x @ axis) * axis
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x)])


def _position(model: RobotModel) -> Callable[[Postures, int], Array]:
    return lambda postures, j: postures.q[:, dofs(model.joints).positions[j].start]


def _move(model: RobotModel) -> Callable[[Postures, int], Array]:
    return lambda postures, j: (postures.before - postures.q)[:, dofs(model.joints).positions[j].start]


def _angle(model: RobotModel, j: int) -> str:
    return "rad" if model.joints[j].kind == "revolute" else "m"


def _torque(model: RobotModel, j: int) -> str:
    return "N m" if model.joints[j].kind == "revolute" else "N"


def _offset(model, at, _):
    (j,) = at
    yield "offset", _angle(model, j), [_along(lambda p, j: np.ones(len(p.q)))(model, j)]


def _geometry(model, at, _):
    (j,) = at
    revolute = model.joints[j].kind == "revolute"
    free = across(model, j)
    linear, angular = (np.eye(3), free) if revolute else (free, np.eye(3))
    for names, vectors, start, unit in (("xyz", linear, 0, "m"), ("xyz", angular, 3, "rad")):
        for name, vector in zip(_axis_names(vectors, names), vectors, strict=True):
            twist = np.zeros(6)
            twist[start : start + 3] = vector
            yield ("r" if start else "") + name, unit, [(j, lambda p, twist=twist: np.tile(twist[:, None], len(p.q)))]


def _axis_names(vectors: Array, names: str) -> list[str]:
    found = [names[int(np.argmax(np.abs(v)))] if np.abs(v).max() > 0.999 else "" for v in vectors]
    return [name or f"u{k + 1}" for k, name in enumerate(found)]


def _scale(model, at, _):
    (j,) = at
    yield "scale", "1", [_along(_position(model))(model, j)]


def _eccentricity(model, at, _):
    (j,) = at
    for name, wave in (("sine", np.sin), ("cosine", np.cos)):
        yield name, _angle(model, j), [_along(lambda p, j, wave=wave: wave(_position(model)(p, j)))(model, j)]


def _gear(model, at, order):
    (j,) = at
    for name, wave in (("sine", np.sin), ("cosine", np.cos)):
        yield name, _angle(model, j), [_along(lambda p, j, wave=wave: wave(order * _position(model)(p, j)))(model, j)]


def _compliance(model, at, _):
    (j,) = at
    yield "compliance", f"{_angle(model, j)}/({_torque(model, j)})", [_along(lambda p, j: p.torque[:, j])(model, j)]


def _bending(model, at, _):
    (j,) = at
    for name, vector in zip(("bending 1", "bending 2"), across(model, j), strict=True):
        twist = np.r_[np.zeros(3), vector]
        field = lambda p, twist=twist, vector=vector: twist[:, None] * (p.moment[:, j] @ vector)  # noqa: E731
        yield name, "rad/(N m)", [(j, field)]


def _thermal(model, at, share):
    (j,) = at
    way = np.asarray(model.placement[j])[:3, :3].T @ np.asarray(model.placement[j])[:3, 3]
    twist = np.r_[way, np.zeros(3)]
    yield "growth", "1", [(j, lambda p: twist[:, None] * -np.expm1(-p.time / (share * p.duration)))]


def _payload(model, at, _):
    (j,) = at
    yield "compliance", f"{_angle(model, j)}/({_torque(model, j)})", [_along(lambda p, j: p.payload[:, j])(model, j)]


def _base(model, at, _):
    j, frame = at
    placed = np.linalg.inv(model.frame_placement[frame]) @ model.placement[j]
    R, p = placed[:3, :3], placed[:3, 3]
    for name, unit, twist in _frame_twists():
        seen = np.r_[R.T @ (twist[:3] + np.cross(twist[3:], p)), R.T @ twist[3:]]
        yield name, unit, [(j, lambda postures, seen=seen: np.tile(seen[:, None], len(postures.q)))]


def _tool(model, at, _):
    j, frame = at
    last, axis = np.asarray(model.frame_placement[frame]), joint_axis(model, j)
    revolute = model.joints[j].kind == "revolute"

    def field(postures: Postures, twist: Array) -> Array:
        q = model.ratio[j] * _position(model)(postures, j) + model.offset[j]
        angular, linear, p = last[:3, :3] @ twist[3:], last[:3, :3] @ twist[:3], last[:3, 3]
        if not revolute:
            turned = np.tile(angular[:, None], len(q))
            return np.concatenate([linear[:, None] + np.cross(p + q[:, None] * axis, angular).T, turned])
        return np.concatenate([_turned(axis, q, linear + np.cross(p, angular)), _turned(axis, q, angular)])

    for name, unit, twist in _frame_twists():
        yield name, unit, [(j, lambda postures, twist=twist: field(postures, twist))]


def _frame_twists() -> Iterator[tuple[str, str, Array]]:
    for k, name in enumerate(("x", "y", "z", "rx", "ry", "rz")):
        yield name, "m" if k < 3 else "rad", np.eye(6)[k]


def _turned(axis: Array, q: Array, vector: Array) -> Float[np.ndarray, "3 samples"]:
    """The vector turned by q (rad) about a unit axis (Rodrigues)."""
    along, across = axis * (axis @ vector), np.cross(axis, vector)
    return along[:, None] + np.outer(vector - along, np.cos(q)) + np.outer(across, np.sin(q))


def _settling(model, at, _):
    joints = range(len(model.joints))
    yield "amount", "1", [_along(_move(model))(model, j) for j in joints]


def _hysteresis(model, at, _):
    (j,) = at
    yield "width", _angle(model, j), [_along(lambda p, j: -np.sign(_move(model)(p, j)))(model, j)]


def _backlash(model, at, _):
    (j,) = at
    yield "width", _angle(model, j), [_along(lambda p, j: np.sign(p.torque[:, j]))(model, j)]


def _coupling(model, at, _):
    i, j = at
    field = _along(lambda p, j: _position(model)(p, i))
    yield "ratio", "1", [field(model, j)]


CATALOGUE: dict[str, KinematicEffect] = {
    effect.name: effect
    for effect in (
        KinematicEffect("joint_offset", "zero offset of the encoder", "S c", "joint", _offset),
        KinematicEffect(
            "link_geometry", "geometry of the link", "three translations, two rotations", "joint", _geometry
        ),
        KinematicEffect(
            "encoder_scale",
            "scale of the encoder",
            "S s q",
            "joint",
            _scale,
            separated_by="postures over more than half a turn of {at}",
        ),
        KinematicEffect(
            "encoder_eccentricity",
            "eccentricity of the encoder",
            "S (a sin q + b cos q)",
            "joint",
            _eccentricity,
            separated_by="the same postures with two payloads, and a whole turn of {at}",
        ),
        KinematicEffect(
            "gear_transmission_error",
            "transmission error of the gear",
            "S (a sin N q + b cos N q)",
            "joint",
            _gear,
            shape=("order", _ORDERS),
            separated_by="a dense sweep of {at} alone",
        ),
        KinematicEffect(
            "joint_compliance",
            "compliance under gravity",
            "S c tau_g",
            "joint",
            _compliance,
            separated_by="the same postures with two payloads, on both sides of the vertical",
        ),
        KinematicEffect(
            "link_compliance",
            "bending of the link under gravity",
            "two rotations across the axis, each in proportion to its moment",
            "joint",
            _bending,
            separated_by="the same postures with two payloads, the link horizontal and vertical",
        ),
        KinematicEffect(
            "thermal_growth",
            "growth of the link with warmth",
            "length of the link times g (1 - exp(-t / T))",
            "joint",
            _thermal,
            shape=("share", (0.1, 0.3, 1.0, 10.0)),  # of the whole duration
            separated_by="one posture measured again and again while the robot warms up",
        ),
        KinematicEffect(
            "payload_deflection",
            "deflection under the payload",
            "S c tau_load",
            "joint",
            _payload,
            separated_by="the same postures with and without the payload",
        ),
        KinematicEffect(
            "settling",
            "reading before the motion had settled",
            "S a (q' - q) in all joints",
            "robot",
            _settling,
            separated_by="the same postures in another order, and with a longer wait",
        ),
        KinematicEffect(
            "reversal_hysteresis",
            "hysteresis of the direction of approach",
            "S w sign(q - q')",
            "joint",
            _hysteresis,
            separated_by="each posture approached with {at} from both sides",
        ),
        KinematicEffect(
            "backlash",
            "backlash",
            "S w sign(tau_g)",
            "joint",
            _backlash,
            separated_by="postures of {at} near the vertical, on both sides of it",
        ),
        KinematicEffect("joint_coupling", "coupling of two joints", "S_j k q_i", "pair", _coupling),
        KinematicEffect("base_frame", "place of the base, said to be known", "a fixed twist", "frame", _base),
        KinematicEffect("tool_frame", "place of the tool frame, said to be known", "a fixed twist", "frame", _tool),
    )
}


def _history(model, at, sign):
    for j in range(len(model.joints)):
        move = _move(model)
        law = (lambda p, j, move=move: np.sign(move(p, j))) if sign else move
        yield model.joints[j].name, "1", [_along(law)(model, j)]


# What depends on the posture before in any way, joint by joint: it competes, so that such an error gets no wrong name,
# but it is no name itself.
HISTORY = KinematicEffect(
    "history", "dependence on the posture before", "S_j h_j(q' - q)", "robot", _history, ("sign", (0.0, 1.0))
)


def find_kinematic(name: str) -> KinematicEffect:
    """The kinematic effect called `name`; raises `InputError` with the nearest known name."""
    if name not in CATALOGUE:
        raise InputError(f"no kinematic effect '{name}' in the catalogue{nearest(name, CATALOGUE)}")
    return CATALOGUE[name]


def columns_of(effect: KinematicEffect, model: RobotModel, at: Sequence[int], shape: float = 0.0) -> tuple[Column, ...]:
    """The effect's columns at the tree joints `at`."""
    names = tuple(model.joints[j].name for j in at) if effect.acts_on in ("joint", "pair") else ()
    return tuple(
        Column(effect.name, names, parameter, unit, tuple(pieces))
        for parameter, unit, pieces in effect.build(model, tuple(at), shape)
    )
