"""What a rollout can get wrong: every effect with the numbers of the loop that it frees and where its search starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from ..effects.base import Effect
from ..effects.catalogue import ROLLOUTS, find
from ..effects.loops import InRollouts, Scale
from ..rigid.model import Frame, Joint, RobotModel
from .loop import Joints, Loop, Pairs
from .own import is_own, starts_of
from .parameters import TEN, TILT, Entry, Table

__all__ = [
    "BASELINE",
    "Candidate",
    "Catalogue",
    "catalogue",
    "elastic_loop",
    "elastic_table",
    "kind_of",
    "springs",
    "with_pairs",
]

_JOINT_ENTRIES = (
    "armature", "damping", "friction", "stribeck_force", "stribeck_speed", "load_ratio", "stiffness",
    "offset", "ripple_sine", "ripple_cosine", "ripple_order", "reading",
)  # fmt: skip
_PAIR_ENTRIES = ("pair_inertia", "pair_damping", "pair_friction")
_DRIVE_ENTRIES = ("scale", "delay", "dead_band", "voltage", "force_limit")
_MOST_PAIRS = 64
BASELINE = ("rotor_inertia", "joint_damping", "friction_loss")


@lru_cache(maxsize=512)
def kind_of(effect: type[Effect]) -> InRollouts:
    """What an effect says of itself, the library's or a user's: `in_rollouts`, and what its class says otherwise."""
    own, parameters = effect.in_rollouts, effect.parameters()
    plain = own._replace(
        contains=tuple(dict.fromkeys((*effect.contains, *own.contains))),
        experiment=own.experiment or effect.separated_by or "steps of {at} of two sizes, and slow sweeps",
    )
    if own.numbers:
        return plain._replace(signed=own.signed is not False)
    count = len(effect.amplitudes())
    signed = not effect.dissipative if own.signed is None else own.signed
    together = count if signed else 1
    return plain._replace(signed=signed, together=together, shapes=tuple(range(count, len(parameters))))


class Candidate(NamedTuple):
    """An effect at a place: the entries of the table that it frees, and values from which its fit starts."""

    effect: str
    at: tuple[str, ...]
    entries: tuple[int, ...]
    starts: tuple[tuple[float, ...], ...]  # of its entries; NaN: where the present model stands
    reported: tuple[str, ...]  # names of the entries in the answer

    @property
    def kind(self) -> InRollouts:
        """What sets its effect apart."""
        return kind_of(ROLLOUTS.get(self.effect) or find(self.effect))

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


def catalogue(
    loop: Loop, forces: np.ndarray, *, gains_known: bool = True, forbid: Sequence[str] = (), bodies: Sequence[int] = ()
) -> Catalogue:
    """The candidates of a loop; `forces` (nu,) are the largest that its drives gave in the recordings.

    What is looked for last stands in it at the links `bodies` alone, whose ten numbers end the table.
    """
    robot, names = loop.robot, loop.robot.dof_names
    table, candidates = list[Entry](), list[_Wanted]()
    every = {called: kind_of(effect) for called, effect in ROLLOUTS.items() if called not in forbid}
    kinds = {called: kind for called, kind in every.items() if not kind.last}
    levers = np.asarray(loop.joints.friction)
    for j, name in enumerate(names):
        read = j in loop.measured
        table += [Entry(number, (j,)) for number in _JOINT_ENTRIES if read or number != "reading"]
        torque = _largest(loop, forces, j)
        scale = Scale(max(float(levers[j]), 0.02 * torque), torque)
        candidates += _wanted(kinds, "joint", (name,), j, scale, () if read else ("reading",))
    for k in range(len(loop.drives.names)):
        table += [Entry(number, (k,)) for number in _DRIVE_ENTRIES]
        name = names[int(np.argmax(np.abs(np.asarray(loop.drives.transmission)[k])))]
        own = {called: kind for called, kind in kinds.items() if not (kind.gains_free and gains_known)}
        candidates += _wanted(own, "drive", (name,), k, Scale(0.0, float(forces[k])))
    for i, joint in enumerate(robot.joints if loop.carried is None else ()):
        table.append(Entry("payload", (i,)))
        candidates += _wanted(kinds, "link", (joint.link,), i, Scale(0.0, 0.0))
    if _stands(loop):
        table += [Entry(name, (0,)) for name in TILT]
        candidates += _wanted(kinds, "robot", (), 0, Scale(0.0, 0.0))
    for k, (i, j, _) in enumerate(loop.pairs.at if loop.pairs is not None else ()):
        table += [Entry(number, (k,)) for number in _PAIR_ENTRIES]
        candidates += _wanted(kinds, "pair", (names[i], names[j]), k, Scale(0.0, 0.0))
    for k, effect in enumerate(loop.effects):
        ordered = sorted(effect.parameters(), key=lambda name: name not in effect.amplitudes())
        table += [Entry(f"{effect.name}.{name}", (k,)) for name in ordered]
        mine = kind_of(type(effect))
        if effect.acts_on == "joint" and effect.name not in forbid and not mine.numbers:
            own = tuple((f"{effect.name}.{name}", k) for name in ordered)
            candidates.append(
                _Wanted(effect.name, (names[effect.places[0]],), own, starts_of(type(effect)), tuple(ordered))
            )
    for i in bodies:
        table += [Entry(number, (i,)) for number in TEN]
        last = {called: kind for called, kind in every.items() if kind.last}
        candidates += _wanted(last, "link", (robot.joints[i].link,), i, Scale(0.0, 0.0))
    index = {(e.name, e.at[0]): k for k, e in enumerate(table)}
    built = [
        Candidate(one.effect, one.at, tuple(index[e] for e in one.entries), one.starts, one.reported)
        for one in candidates
    ]
    return Catalogue(tuple(table), tuple(built))


class _Wanted(NamedTuple):
    effect: str
    at: tuple[str, ...]
    entries: tuple[tuple[str, int], ...]
    starts: tuple[tuple[float, ...], ...]
    reported: tuple[str, ...]


def _wanted(
    kinds: dict[str, InRollouts], place: str, at: tuple[str, ...], k: int, scale: Scale, without: Sequence[str] = ()
) -> list[_Wanted]:
    """The effects that change numbers of one joint, drive, link or of the robot."""
    return [
        _Wanted(called, at, tuple((number, k) for _, number in kind.numbers), kind.starts(scale),
                tuple(name for name, _ in kind.numbers))
        for called, kind in kinds.items()
        if kind.place == place and kind.numbers and not any(number in without for _, number in kind.numbers)
    ]  # fmt: skip


def with_pairs(loop: Loop) -> Loop:
    """The loop with couplings of no size of every joint with the one before it: motors of their sum and difference."""
    joints = loop.robot.joints
    if (
        loop.pairs is not None
        or loop.carried is not None
        or any(j.kind not in ("revolute", "prismatic") for j in joints)
    ):
        return loop
    near = [(joints[j.parent], j) for j in joints if j.parent >= 0 and not j.follows]
    pairs = [(a.coordinate, b.coordinate) for a, b in near if a.kind == b.kind and not a.follows]
    at = tuple((*pair, sign) for pair in pairs for sign in (1, -1))
    if not 0 < len(at) <= _MOST_PAIRS:
        return loop
    zero = np.zeros(len(at))
    return replace(loop, pairs=Pairs(zero, zero, zero, at))


def _stands(loop: Loop) -> bool:
    """Whether the base stands still and gravity acts: then it may not be level."""
    still = all(joint.kind in ("revolute", "prismatic") for joint in loop.robot.joints)
    return still and loop.carried is None and bool(np.asarray(loop.robot.gravity).any())


def _largest(loop: Loop, forces: np.ndarray, joint: int) -> float:
    way = np.abs(np.asarray(loop.drives.transmission))[:, joint]
    return float(max((way * forces).max(initial=0.0), 1e-6))


def springs(joint: str, first: int, forbid: Sequence[str] = ()) -> list[Candidate]:
    """A spring, and a spring with play, between motor and link of a joint; their numbers stand from `first` on."""
    kinds = {called: kind_of(effect) for called, effect in ROLLOUTS.items() if called not in forbid}
    return [
        Candidate(called, (joint,), tuple(range(first, first + len(kind.numbers))), (),
                  tuple(name for name, _ in kind.numbers))
        for called, kind in kinds.items() if kind.place == "spring"
    ]  # fmt: skip


def elastic_loop(loop: Loop, coordinate: int, stiffness: float, damping: float) -> Loop:
    """The loop with a spring between motor and link of one joint: the new last coordinate is the spring's twist.

    The motor carries the armature, the friction and the damping of the joint and turns first; its encoder is read.
    """
    robot = loop.robot
    i = next(i for i, joint in enumerate(robot.joints) if joint.coordinate == coordinate)
    moved = np.asarray(loop.drives.transmission)
    drives = eqx.tree_at(
        lambda d: d.transmission, loop.drives, np.concatenate([moved, np.zeros((len(loop.drives.names), 1))], 1)
    )
    joints, start = _with_spring(loop.joints, stiffness, damping), np.append(np.asarray(loop.start), 0.0)
    return replace(loop, robot=with_motor(robot, i), drives=drives, joints=joints, start=start, linear=None)


def elastic_table(loop: Loop, table: Table, coordinate: int) -> Table:
    """The table in `elastic_loop` of a loop, and the three numbers of the spring: links behind the motor come later."""
    i = next(i for i, joint in enumerate(loop.robot.joints) if joint.coordinate == coordinate)
    of_links = ("payload", *TEN)
    moved = [
        entry._replace(at=tuple(k + (k >= i) for k in entry.at)) if entry.name in of_links else entry for entry in table
    ]
    return (*moved, *(Entry(name, (loop.robot.nv,)) for name in ("stiffness", "damping", "play")))


def rigid(loop: Loop) -> Loop:
    """The loop without the spring of `elastic_loop`: motor and link are one joint again."""
    robot, i = loop.robot, motor_of(loop.robot)
    if i is None:
        return loop
    first, spring = robot.joints[i : i + 2]
    after = [joint._replace(parent=joint.parent - (joint.parent > i)) for joint in robot.joints[i + 2 :]]
    left = {name: np.delete(np.asarray(getattr(robot, name)), i + 1, 0) for name in ("placement", "axis")}
    left |= {name: np.delete(np.asarray(getattr(robot, name)), i + 1) for name in ("ratio", "offset")}
    bare = RobotModel(
        **left,
        inertia=np.delete(np.asarray(robot.inertia), i, 0),
        gravity=robot.gravity,
        frame_placement=robot.frame_placement,
        position_limit=np.asarray(robot.position_limit)[:-1],
        velocity_limit=np.asarray(robot.velocity_limit)[:-1],
        effort_limit=np.asarray(robot.effort_limit)[:-1],
        joints=(*robot.joints[:i], first._replace(link=spring.link), *after),
        frames=tuple(Frame(f.name, f.parent - (f.parent > i)) for f in robot.frames),
        name=robot.name,
    )
    own = {name: np.asarray(getattr(loop.joints, name))[:-1] for name in loop.joints.__dataclass_fields__}
    drives = eqx.tree_at(lambda d: d.transmission, loop.drives, np.asarray(loop.drives.transmission)[:, :-1])
    return replace(loop, robot=bare, drives=drives, joints=type(loop.joints)(**own), start=np.asarray(loop.start)[:-1])


def motor_of(robot: RobotModel) -> int | None:
    """The joint of the motor that `elastic_loop` made, which has no body of its own, or None."""
    for i, (motor, link) in enumerate(pairwise(robot.joints)):
        pair = (f"{motor.name}_spring", i, robot.nv - 1, f"{link.link}_motor")
        if (link.name, link.parent, link.coordinate, motor.link) == pair and not np.asarray(robot.inertia[i]).any():
            return i
    return None


def with_motor(robot: RobotModel, i: int) -> RobotModel:
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
