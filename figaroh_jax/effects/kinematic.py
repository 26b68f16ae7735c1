r"""Effects as postures see them: errors of the joints' positions, and twists of links and frames.

An effect with a `position_error` is one of postures as it stands, whether it is here or in another file of the
catalogue or a user's own; a few have a form of their own as a `twist`. `columns_of` makes small twists of both.
Notation: S the twist of a unit motion of the joint, q its measured position, q' that of the posture before, tau_g and
m_g the torque about the axis and the moments across it that gravity puts on the joint (N m, positive where it pulls),
t the time since the first posture. An effect's sign is that of all effects: what the sensor reads minus the truth. A
calibration reports corrections, what has to be added to the reading, where `Effect.correction` is -1: in the equations
here the true position is the measured one plus the effect. A twist `[linear, angular]` (m, rad) is in the joint frame,
before the joint moves; a coefficient times its field is what the joint's twist gains.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..rigid.chain import joint_axis
from ..rigid.model import Leaf, RobotModel, dofs
from . import catalogue as catalogue  # its effects with an error of the position are effects of postures too
from .base import Effect, JointEffect, Motion, Scalar, amplitude, joint_unit, shape
from .registry import POSES as CATALOGUE, register

__all__ = [
    "CATALOGUE",
    "HISTORY",
    "Column",
    "PostureMotion",
    "Postures",
    "across",
    "axis_twist",
    "columns_of",
    "moving_with",
    "shape_of",
    "twists_of",
]

Array = np.ndarray
_MOVED = 0.01  # rad or m: where no joint moves more, the posture is the one before
_ORDERS = tuple(np.arange(2.0, 12.5, 0.5))  # of gear errors, per turn of the joint


@dataclass(frozen=True, eq=False)
class Postures:
    """Postures of one recording, in the order in which they were measured, and what gravity does in them."""

    q: Float[Leaf, "samples nv"]  # rad or m
    before: Float[Leaf, "samples nv"]  # the posture measured before; the first one's own
    torque: Float[Leaf, "samples nj"]  # gravity about each joint's axis, N m or N
    moment: Float[Leaf, "samples nj 3"]  # gravity's moment at each joint, in the joint frame, N m
    payload: Float[Leaf, "samples nj"]  # as torque, of the carried load alone
    time: Float[Leaf, " samples"]  # s
    duration: float  # s, of all recordings together
    _motions: dict[tuple[int, int], PostureMotion] = field(default_factory=dict, init=False, repr=False)

    def motion(self, model: RobotModel, joint: int) -> PostureMotion:
        """The postures as an effect at a tree joint sees them, made once: a joint that follows another has a load of
        its own."""
        key = id(model), joint if model.joints[joint].follows else -1
        if key not in self._motions:
            self._motions[key] = PostureMotion.of(model, self, joint)
        return self._motions[key]


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


def axis_twist(model: RobotModel, joint: int) -> Float[np.ndarray, "6"]:
    """Twist S of a unit motion of a joint, in its own frame."""
    twist = np.zeros(6)
    twist[3 * (model.joints[joint].kind == "revolute") :][:3] = joint_axis(model, joint)
    return twist


def across(model: RobotModel, joint: int) -> Float[Any, "2 3"]:
    """Two unit vectors across the joint's axis, the first one along a frame axis where it can be."""
    axis = joint_axis(model, joint)
    lib = _library(axis)
    x = lib.eye(3)[lib.argmin(lib.abs(axis))]
    x = x - (x @ axis) * axis
    x = x / lib.linalg.norm(x)
    return lib.stack([x, lib.cross(axis, x)])


def _position(model: RobotModel) -> Callable[[Postures, int], Array]:
    return lambda postures, j: postures.q[:, dofs(model.joints).positions[j].start]


def _move(model: RobotModel) -> Callable[[Postures, int], Array]:
    return lambda postures, j: (postures.before - postures.q)[:, dofs(model.joints).positions[j].start]


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


def _bending(model, at, _):
    (j,) = at
    for name, vector in zip(("bending 1", "bending 2"), across(model, j), strict=True):
        twist = _library(vector).concatenate([np.zeros(3), vector])
        field = lambda p, twist=twist, vector=vector: twist[:, None] * (p.moment[:, j] @ vector)  # noqa: E731
        yield name, "rad/(N m)", [(j, field)]


def _thermal(model, at, share):
    (j,) = at
    lib, placement = _library(model.placement), model.placement[j]
    twist = lib.concatenate([placement[:3, :3].T @ placement[:3, 3], np.zeros(3)])

    def field(p: Postures) -> Any:
        warm = -p.time / (share * p.duration)
        return twist[:, None] * -_library(warm).expm1(warm)

    yield "growth", "1", [(j, field)]


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


def _history(model, at, sign):
    for j in range(len(model.joints)):
        move = _move(model)
        law = (lambda p, j, move=move: _side(move(p, j), p.before - p.q)) if sign else move
        motion = axis_twist(model, j)
        yield model.joints[j].name, "1", [(j, lambda p, j=j, law=law, motion=motion: motion[:, None] * law(p, j))]


def _side(way: Any, whole: Any) -> Any:
    """Sign of a motion; none where the `whole` posture is one again.

    Of repeats it would be that of what was measured: where a tool that is brought to touch again errs, its joints go
    along.
    """
    lib = _library(whole)
    return lib.where(abs(whole).max(axis=1) > _MOVED, lib.sign(way), 0.0)


def _library(array: Any) -> Any:
    """NumPy on the host, where it costs no program, and JAX under its transformations."""
    return jnp if isinstance(array, jax.Array) else np


class PostureMotion(Motion):
    """Postures as the effects see a motion: at rest, each with the one before."""

    before: Float[Leaf, "samples nq"]
    payload: Float[Leaf, "samples nv"]  # what the carried load adds to `load`, N m or N

    @classmethod
    def of(cls, model: RobotModel, postures: Postures, joint: int) -> PostureMotion:
        """The postures of a recording; the drives hold against gravity. In the column of the tree joint at hand stands
        its own load, in each other one that of its independent joint."""
        own = _tree_joints(model) | {model.joints[joint].coordinate: joint}
        load, payload = np.zeros((2, len(postures.q), model.nv))
        for by_column, by_joint in ((load, postures.torque), (payload, postures.payload)):
            if by_joint.shape[1]:  # else none is known
                by_column[:, list(own)] = -by_joint[:, list(own.values())]
        rest, width = np.zeros_like(load), np.zeros(model.nv)
        time = postures.time if len(postures.time) == len(postures.q) else np.zeros(len(postures.q))
        return cls(model, time, postures.q, rest, rest, load, load, 0.0, width, postures.before, payload)

    @property
    def way(self) -> Float[Leaf, "samples nv"]:
        """Motion of each coordinate from the posture before, rad or m."""
        return self.by_coordinate(self.position - self.before)


@register
class JointOffset(JointEffect):
    """A zero of the encoder that is not the model's, as a calibration names it."""

    name, title, equation = "joint_offset", "encoder zero offset", "S c"
    levels, correction = ("pose",), -1.0
    offset: Scalar = amplitude("rad")

    def position_error(self, motion: Any) -> Float[Leaf, " samples"]:
        """The offset at every posture, rad: reading minus truth."""
        return self.offset * np.ones(len(motion.time))


@register
class LinkGeometry(JointEffect):
    """A link whose joint stands elsewhere than the model says."""

    name, title, equation = "link_geometry", "link geometry error", "three translations, two rotations"
    levels = ("pose",)
    twist = staticmethod(_geometry)


@register
class GearTransmissionError(JointEffect):
    """An error that comes back several times in a turn: teeth, the wave of a harmonic drive."""

    name, title = "gear_transmission_error", "gear transmission error"
    equation = "S (a sin N q + b cos N q)"
    levels, correction = ("pose",), -1.0
    separated_by = "a dense sweep of {at} alone"
    sine: Scalar = amplitude("rad")
    cosine: Scalar = amplitude("rad")
    order: Scalar = shape("", _ORDERS)

    def position_error(self, motion: Any) -> Float[Leaf, " samples"]:
        """sine sin(N q) + cosine cos(N q), rad: reading minus truth."""
        angle = self.order * self.here(motion.angle)
        return self.sine * _library(angle).sin(angle) + self.cosine * _library(angle).cos(angle)


@register
class JointCompliance(JointEffect):
    """A joint that gives way under gravity, in proportion to its torque."""

    name, title, equation = "joint_compliance", "joint compliance under gravity", "S c tau_g"
    levels = ("pose",)
    separated_by = "the same postures with two payloads, on both sides of the vertical"
    compliance: Scalar = amplitude("rad/(N m)")

    def position_error(self, motion: Any) -> Float[Leaf, " samples"]:
        """compliance times the torque of gravity at the joint (N m), rad: reading minus truth."""
        return self.compliance * self.here(motion.load)


@register
class LinkCompliance(JointEffect):
    """A link that bends under gravity."""

    name, title = "link_compliance", "link bending under gravity"
    equation = "two rotations across the axis, each in proportion to its moment"
    levels = ("pose",)
    separated_by = "the same postures with two payloads, the link horizontal and vertical"
    first: Scalar = amplitude("rad/(N m)")  # about the two directions of `across`
    second: Scalar = amplitude("rad/(N m)")
    twist = staticmethod(_bending)


@register
class ThermalGrowth(JointEffect):
    """A link that grows as the robot warms up."""

    name, title = "thermal_growth", "thermal growth of the link"
    equation = "length of the link times g (1 - exp(-t / T))"
    levels = ("pose",)
    separated_by = "one posture measured again and again while the robot warms up"
    growth: Scalar = amplitude("")
    share: Scalar = shape("", (0.1, 0.3, 1.0, 10.0))  # of the whole duration
    twist = staticmethod(_thermal)


@register
class PayloadDeflection(JointEffect):
    """A joint that gives way under a load that is carried."""

    name, title, equation = "payload_deflection", "deflection under the payload", "S c tau_load"
    levels = ("pose",)
    separated_by = "the same postures with and without the payload"
    compliance: Scalar = amplitude("rad/(N m)")

    def position_error(self, motion: Any) -> Float[Leaf, " samples"]:
        """compliance times the torque of the load that is carried (N m), rad: reading minus truth."""
        return self.compliance * self.here(motion.payload)


@register
class Settling(Effect):
    """Joints read before they have come to rest."""

    name, title, acts_on = "settling", "reading before the motion had settled", "robot"
    equation = "S a (q' - q) in all joints"
    levels = ("pose",)
    separated_by = "the same postures in another order, and with a longer wait"
    amount: Scalar = amplitude("")

    def position_error(self, motion: Any) -> Float[Leaf, "samples nv"]:
        """A share of the way from the posture before, in all joints (samples, joints), rad: reading minus truth."""
        return self.amount * motion.way


@register
class ReversalHysteresis(JointEffect):
    """A joint that stops elsewhere when it comes from the other side."""

    name, title = "reversal_hysteresis", "hysteresis of the direction of approach"
    equation = "S w sign(q - q')"
    levels = ("pose",)
    separated_by = "each posture approached with {at} from both sides"
    width: Scalar = amplitude("rad")

    def position_error(self, motion: Any) -> Float[Leaf, " samples"]:
        """-width times the side from which the joint came, rad: reading minus truth; zero where it did not move."""
        return -self.width * _side(self.here(motion.way), motion.way)


@register
class JointCoupling(Effect):
    """A joint that follows another one in part."""

    name, title, acts_on = "joint_coupling", "joint coupling", "pair"
    equation = "S_j k q_i"
    levels, correction = ("pose",), -1.0
    ratio: Scalar = amplitude("")

    def position_error(self, motion: Any) -> Float[Leaf, " samples"]:
        """ratio times the angle of the first joint of the pair, read at the second, rad."""
        return self.ratio * self.here(motion.angle)


@register
class BaseFrame(Effect):
    """A base frame that is said to be known and stands elsewhere."""

    name, title, acts_on = "base_frame", "base frame other than stated", "frame"
    equation = "a fixed twist"
    levels = ("pose",)
    twist = staticmethod(_base)


@register
class ToolFrame(Effect):
    """A tool frame that is said to be known and stands elsewhere."""

    name, title, acts_on = "tool_frame", "tool frame other than stated", "frame"
    equation = "a fixed twist"
    levels = ("pose",)
    twist = staticmethod(_tool)


class _History(Effect):
    """What depends on the posture before in any way, joint by joint.

    It competes, so that such an error gets no wrong name, but it is no name itself.
    """

    name, title, acts_on = "history", "dependence on the previous posture", "robot"
    equation = "S_j h_j(q' - q)"
    sign: Scalar = shape("", (0.0, 1.0))
    twist = staticmethod(_history)


HISTORY = _History

# the order of a search; effects of a user's own follow
for _name in (
    *("joint_offset", "link_geometry", "encoder_scale", "encoder_eccentricity", "gear_transmission_error"),
    *("joint_compliance", "link_compliance", "thermal_growth", "payload_deflection", "settling"),
    *("reversal_hysteresis", "backlash", "joint_coupling", "base_frame", "tool_frame"),
):
    CATALOGUE[_name] = CATALOGUE.pop(_name)


def shape_of(effect: type[Effect]) -> tuple[str, tuple[float, ...]]:
    """Name and grid of the effect's parameter that is not linear; no name and one point where it has none."""
    return next(((n, p.grid) for n, p in effect.parameters().items() if not p.linear), ("", (0.0,)))


def columns_of(effect: type[Effect], model: RobotModel, at: Sequence[int], shape: float = 0.0) -> tuple[Column, ...]:
    """The effect's columns at the tree joints `at`, one for each linear parameter as a calibration reports it."""
    names = tuple(model.joints[j].name for j in at) if effect.acts_on in ("joint", "pair") else ()
    parts = effect.twist(model, tuple(at), shape) if effect.has("twist") else _shifts(effect, model, tuple(at), shape)
    return tuple(Column(effect.name, names, parameter, unit, tuple(pieces)) for parameter, unit, pieces in parts)


def twists_of(effects: Sequence[Effect], model: RobotModel, postures: Postures) -> Float[Any, "nj 6 samples"]:
    """What the twist of each joint's frame gains by effects with such a form and a size, in the postures; traceable.

    Each of an effect's linear parameters is the coefficient of one of its columns, in the order of both.
    """
    total = jnp.zeros((len(model.joints), 6, len(postures.q)))
    for effect in effects:
        sizes = [getattr(effect, name) for name in effect.amplitudes()]
        if sizes and effect.has("twist"):
            curved = getattr(effect, shape_of(type(effect))[0], 0.0)
            columns = effect.twist(model, tuple(_tree_joints(model)[int(k)] for k in effect.at), curved)
            for size, (_, _, pieces) in zip(sizes, columns, strict=True):
                for joint, field in pieces:
                    total = total.at[joint].add(size * field(postures))
    return total


def moving_with(model: RobotModel, joint: int) -> list[tuple[int, float]]:
    """The tree joint and those that follow it, each with how far it moves for 1 rad or m of the joint."""
    if model.joints[joint].follows:
        return [(joint, 1.0)]
    column = model.joints[joint].coordinate
    followers = [k for k, other in enumerate(model.joints) if other.follows and other.coordinate == column]
    return [(joint, 1.0), *((k, float(model.ratio[k])) for k in followers)]


def _tree_joints(model: RobotModel) -> dict[int, int]:
    """Tree joint of each coordinate, by its first column of v."""
    return {joint.coordinate: k for k, joint in enumerate(model.joints) if not joint.follows}


def _shifts(
    effect: type[Effect], model: RobotModel, at: tuple[int, ...], shape: float
) -> Iterator[tuple[str, str, Sequence[tuple[int, Callable]]]]:
    """Twists along the joints' own motions: what a reading with the effect has to be moved by to be true."""
    joints = moving_with(model, at[-1]) if at else [(j, float(model.ratio[j])) for j in range(len(model.joints))]
    joints = joints[:1] if effect is JointOffset else joints  # of geometry: each joint has one
    columns = tuple(model.joints[j].coordinate for j in at)  # of v, as every effect has its place
    unit_shape = {shape_of(effect)[0]: shape} if shape_of(effect)[0] else {}
    for name, parameter in effect.parameters().items():
        if parameter.linear:
            one = partial(_sized, effect, columns, **{name: effect.correction}, **unit_shape)
            unit = joint_unit(parameter.unit or "1", bool(at) and model.joints[at[-1]].kind != "revolute")
            yield name, unit, [(j, _shift(model, j, factor, at[-1] if at else j, one)) for j, factor in joints]


@cache
def _still(effect: type[Effect], at: tuple[int, ...]) -> Effect:
    """The effect at a place, without a size."""
    return effect(np.array(at, int))


def _sized(effect: type[Effect], at: tuple[int, ...], **values: float) -> Effect:
    """The effect with sizes; without what equinox checks of every new module, for a search makes thousands."""
    one = object.__new__(effect)
    vars(one).update(vars(_still(effect, at)), **values)
    return one


def _shift(
    model: RobotModel, joint: int, factor: float, own: int, one: Callable[[], Effect]
) -> Callable[[Postures], Float[np.ndarray, "6 samples"]]:
    """The field of an effect that is made when it is asked for: of many candidates few ever are.

    The `joint` moves by a `factor` of the error at the joint `own`.
    """
    motion = factor * axis_twist(model, joint)

    def field(postures: Postures) -> Float[np.ndarray, "6 samples"]:
        made = one()
        seen = postures.motion(model, own)
        error = np.asarray(type(made).position_error(made, seen))  # a bound method is a module too
        return -motion[:, None] * (error if error.ndim == 1 else error[:, model.joints[joint].coordinate])

    return field
