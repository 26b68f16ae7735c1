"""What a rollout can get wrong: every effect with the numbers of the loop that it frees and where its search starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from ..effects.base import Effect
from ..effects.catalogue import find
from ..rigid.model import Frame, Joint, RobotModel
from .loop import Joints, Loop
from .own import amplitudes, is_own, starts_of
from .parameters import Entry, Table

__all__ = ["BASELINE", "KINDS", "Candidate", "Catalogue", "Kind", "catalogue", "elastic_loop", "springs"]

_JOINT_ENTRIES = (
    "armature", "damping", "friction", "stribeck_force", "stribeck_speed", "load_ratio", "stiffness",
    "offset", "reading",
)  # fmt: skip
_DRIVE_ENTRIES = ("scale", "delay", "dead_band", "voltage", "force_limit")
BASELINE = {"rotor_inertia": "armature", "joint_damping": "damping", "friction_loss": "friction"}


class Kind(NamedTuple):
    """What sets an effect apart from others; the search asks this and never a name."""

    usual: bool = False  # every joint has it
    adds_to: str = ""  # the effect of which it is more: found beside it, not without it
    rival_of: str = ""  # the effect that it may stand for: asked where that is named, whatever else is left
    rival_start: float = 0.0  # its size where that is asked
    contains: tuple[str, ...] = ()  # what it can imitate exactly: the simpler one is preferred
    limit: bool = False  # it changes the model before that can be differentiated
    elastic: bool = False  # another structure: a spring between motor and link
    constant: bool = False  # it shows at a joint that stands: one such makes up for another there
    several: bool = False  # it shows at several joints
    signed: bool = True  # its size may be of either sign
    neutral: float = 0.0  # its size where it is none
    falls_off: int | None = (
        None  # number that is a speed: it shows nothing without a size, and no end beyond all motion
    )
    telling: int | None = None  # number that tells it from what it contains
    looks_like: str = ""  # what looks the same, in words
    experiment: str = "steps of {at} of two sizes, and slow sweeps"  # that tells it from others
    shapes: tuple[int, ...] = ()  # numbers of a user's effect that show nothing without a size: each start is asked

    def holds(self, other: str) -> bool:
        """Whether it can imitate another effect."""
        return other in self.contains


class Candidate(NamedTuple):
    """An effect at a place: the entries of the table that it frees, and values from which its fit starts."""

    effect: str
    at: tuple[str, ...]
    entries: tuple[int, ...]
    starts: tuple[tuple[float, ...], ...]  # of its entries; NaN: where the present model stands
    reported: tuple[str, ...]  # names of the entries in the answer

    @property
    def kind(self) -> Kind:
        """What sets its effect apart."""
        if self.effect in KINDS or self.effect in _PLAIN:
            return KINDS.get(self.effect, Kind())
        return _kind_of(find(self.effect))

    def own(self, known: Catalogue) -> bool:
        """Whether it is an effect of a user's, which machine code does not know."""
        return is_own(known.table[self.entries[0]].name) if self.entries[0] < len(known.table) else False


class Catalogue(NamedTuple):
    """Every number that may be freed, and the candidates."""

    table: Table
    candidates: tuple[Candidate, ...]

    def entry(self, name: str, place: int) -> int:
        """Where the number of a coordinate, drive or link stands in the table."""
        return next(k for k, e in enumerate(self.table) if e.name == name and place in e.at)


_KNOWN_MASS = "the same motion with {at} carrying a known mass"
KINDS = {
    **dict.fromkeys(BASELINE, Kind(usual=True, signed=False)),
    "joint_damping": Kind(usual=True, signed=False, looks_like="a wrong velocity gain of the drive looks the same"),
    "stribeck_friction": Kind(
        adds_to="friction_loss", falls_off=1, experiment="slow constant-velocity sweeps of {at} below 0.3 rad/s"
    ),
    "load_dependent_friction": Kind(
        rival_of="friction_loss", rival_start=0.2, experiment="the same motion of {at} with and without a known payload"
    ),
    "joint_spring": Kind(constant=True, contains=find("joint_spring").contains),
    "torque_offset": Kind(constant=True),
    "encoder_offset": Kind(constant=True),
    "actuator_gain": Kind(neutral=1.0, experiment=f"{_KNOWN_MASS}: else gains and inertias scale together"),
    "command_delay": Kind(
        looks_like="positions that are stamped late by as much look the same",
        experiment="steps of {at} small enough not to saturate its drive",
    ),
    "actuator_saturation": Kind(limit=True, signed=False),
    "voltage_saturation": Kind(limit=True, signed=False),
    "payload": Kind(several=True, experiment=f"{_KNOWN_MASS}, or without what is fixed to it"),
    "joint_elasticity": Kind(
        elastic=True,
        signed=False,
        experiment="a chirp of {at} above a third of its resonance, and an encoder on the link",
    ),
    "backlash": Kind(elastic=True, signed=False, contains=("joint_elasticity",), telling=2),
}
_PLAIN = ("dead_band",)  # of which nothing is to be said
_HERE = float("nan")


def _kind_of(effect: type[Effect]) -> Kind:
    """What a user's effect says of itself."""
    count = len(amplitudes(effect))
    plain = Kind(contains=effect.contains, signed=not effect.dissipative)
    told = effect.separated_by or plain.experiment
    return plain._replace(experiment=told, shapes=tuple(range(count, len(effect.parameters()))))


def catalogue(loop: Loop, forces: np.ndarray, *, gains_known: bool = True, forbid: Sequence[str] = ()) -> Catalogue:
    """The candidates of a loop; `forces` (nu,) are the largest that its drives gave in the recordings."""
    table, candidates = [], []
    robot = loop.robot
    names = robot.dof_names
    levers = np.asarray(loop.joints.friction)
    for j, name in enumerate(names):
        read = j in loop.measured
        table += [Entry(number, (j,)) for number in _JOINT_ENTRIES if read or number != "reading"]
        torque = _largest(loop, forces, j)
        own = _of_joint(j, max(float(levers[j]), 0.02 * torque), torque)
        candidates += [(*one, name) for one in own if read or one[0] != "encoder_offset"]
    for k in range(len(loop.drives.names)):
        table += [Entry(number, (k,)) for number in _DRIVE_ENTRIES]
        name = names[int(np.argmax(np.abs(np.asarray(loop.drives.transmission)[k])))]
        candidates += [(*one, name) for one in _of_drive(k, float(forces[k]), gains_known)]
    for i, joint in enumerate(robot.joints if loop.carried is None else ()):
        table.append(Entry("payload", (i,)))
        candidates.append(("payload", (("payload", i),), ((0.0,),), ("mass",), joint.link))
    known = {one[0] for one in candidates}
    for k, effect in enumerate(loop.effects):
        ordered = sorted(effect.parameters(), key=lambda name: name not in amplitudes(type(effect)))  # noqa: B023
        table += [Entry(f"{effect.name}.{name}", (k,)) for name in ordered]
        if effect.name not in known and effect.acts_on == "joint":
            own = tuple((f"{effect.name}.{name}", k) for name in ordered)
            candidates.append((effect.name, own, starts_of(type(effect)), tuple(ordered), names[effect.places[0]]))
    index = {(e.name, e.at[0]): k for k, e in enumerate(table)}
    built = [
        Candidate(effect, (name,), tuple(index[e] for e in entries), starts, reported)
        for effect, entries, starts, reported, name in candidates
        if effect not in forbid
    ]
    return Catalogue(tuple(table), tuple(built))


def _largest(loop: Loop, forces: np.ndarray, joint: int) -> float:
    way = np.abs(np.asarray(loop.drives.transmission))[:, joint]
    return float(max((way * forces).max(initial=0.0), 1e-6))


def _of_joint(j: int, friction: float, torque: float) -> list[tuple]:
    h = _HERE
    return [
        ("joint_damping", (("damping", j),), ((h,),), ("damping",)),
        ("friction_loss", (("friction", j),), ((h,), (friction,)), ("force",)),
        ("rotor_inertia", (("armature", j),), ((h,),), ("inertia",)),
        (
            "stribeck_friction",
            (("stribeck_force", j), ("stribeck_speed", j)),
            tuple((0.07 * friction, speed) for speed in (0.1, 0.25, 0.6)),
            ("force", "speed"),
        ),
        ("load_dependent_friction", (("load_ratio", j),), ((0.05,),), ("ratio",)),
        ("joint_spring", (("stiffness", j), ("offset", j)), ((0.002 * torque, 0.0),), ("stiffness", "offset")),
        ("torque_offset", (("offset", j),), ((0.0,),), ("offset",)),
        ("encoder_offset", (("reading", j),), ((0.0,),), ("offset",)),
    ]


def _of_drive(k: int, force: float, gains_known: bool) -> list[tuple]:
    limits = tuple((share * force,) for share in (0.9, 0.6, 0.3))
    gain = [] if gains_known else [("actuator_gain", (("scale", k),), ((_HERE,),), ("gain",))]
    return [
        *gain,
        ("command_delay", (("delay", k),), ((0.002,), (0.012,), (0.04,)), ("delay",)),
        ("actuator_saturation", (("force_limit", k),), limits, ("limit",)),
        ("voltage_saturation", (("voltage", k),), limits, ("limit",)),
        ("dead_band", (("dead_band", k),), ((0.002,), (0.02,)), ("band",)),
    ]


def springs(joint: str, first: int, forbid: Sequence[str] = ()) -> list[Candidate]:
    """A spring, and a spring with play, between motor and link of a joint; their numbers stand from `first` on."""
    reported = {"joint_elasticity": ("stiffness", "damping"), "backlash": ("stiffness", "damping", "width")}
    return [
        Candidate(effect, (joint,), tuple(range(first, first + len(names))), (), names)
        for effect, names in reported.items()
        if effect not in forbid
    ]


def elastic_loop(loop: Loop, coordinate: int, stiffness: float, damping: float, *, link_side: bool = False) -> Loop:
    """The loop with a spring between motor and link of one joint: the new last coordinate is the spring's twist.

    The motor carries the armature, the friction and the damping of the joint and turns first; its encoder is read,
    or the link's with `link_side`.
    """
    robot = loop.robot
    n, i = robot.nv, next(i for i, joint in enumerate(robot.joints) if joint.coordinate == coordinate)
    moved = np.asarray(loop.drives.transmission)
    drives = eqx.tree_at(
        lambda d: d.transmission, loop.drives, np.concatenate([moved, np.zeros((len(loop.drives.names), 1))], 1)
    )
    summed = tuple(
        n if link_side and k == coordinate else more for k, more in zip(loop.measured, loop.summed, strict=True)
    )
    return Loop(
        robot=_with_motor(robot, i),
        drives=drives,
        joints=_with_spring(loop.joints, stiffness, damping),
        start=np.append(np.asarray(loop.start), 0.0),
        dt=loop.dt,
        integrator=loop.integrator,
        law=loop.law,
        limited=loop.limited,
        measured=loop.measured,
        summed=summed,
        carried=loop.carried,
        effects=loop.effects,
    )


def _with_motor(robot: RobotModel, i: int) -> RobotModel:
    """The robot with joint `i` twice: a motor without a body, behind it the link on a spring (the last coordinate)."""
    mine = robot.joints[i]
    motor = Joint(mine.name, mine.kind, mine.parent, mine.coordinate, f"{mine.link}_motor")
    moved = [joint._replace(parent=joint.parent + 1) if joint.parent >= i else joint for joint in robot.joints]
    spring = Joint(f"{mine.name}_spring", mine.kind, i, robot.nv, mine.link)

    def inserted(values: Any, new: Any) -> np.ndarray:
        values = np.asarray(values)
        return np.concatenate([values[: i + 1], np.asarray(new)[None], values[i + 1 :]])

    ten = np.asarray(robot.inertia)
    return RobotModel(
        placement=inserted(robot.placement, np.eye(4)),
        axis=inserted(robot.axis, np.asarray(robot.axis)[i]),
        inertia=np.concatenate([ten[:i], _BODY[None], ten[i:]]),
        ratio=inserted(robot.ratio, 1.0),
        offset=inserted(robot.offset, 0.0),
        gravity=robot.gravity,
        frame_placement=robot.frame_placement,
        position_limit=np.concatenate([np.asarray(robot.position_limit), _FREE[None]]),
        velocity_limit=np.append(np.asarray(robot.velocity_limit), np.inf),
        effort_limit=np.append(np.asarray(robot.effort_limit), np.inf),
        joints=(*moved[:i], motor, spring, *moved[i + 1 :]),
        frames=tuple(Frame(f.name, f.parent + 1 if f.parent >= i else f.parent) for f in robot.frames),
        name=robot.name,
    )


def _with_spring(joints: Joints, stiffness: float, damping: float) -> Joints:
    """The terms of the joints with those of a spring behind them."""
    own = {}
    for name in joints.__dataclass_fields__:
        values = np.asarray(getattr(joints, name))
        fill = {"stribeck_speed": 0.1, "ripple_order": 1.0, "stiffness": stiffness, "damping": damping}.get(name, 0.0)
        last = values[-1:] if values.ndim > 1 or name.startswith("friction_") else np.array([fill])
        if name in ("limit", "torque_range"):
            last = _FREE[None]
        own[name] = np.concatenate([values, last])
    return type(joints)(**own)


_FREE = np.array([-np.inf, np.inf])
_BODY = np.zeros(10)  # the motor's own inertia is the joint's armature
