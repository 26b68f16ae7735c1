"""Limits of a motion: what the model and the task give, as rows of an optimiser, and the check at 1 kHz.

A row is the share of its limit that a motion uses, less one: position from the middle of its range in half ranges,
velocity, acceleration and torque in their limits, of distances what is missing of the margin. Zero or less is allowed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ..errors import InputError, check_kind, check_positive, check_real, nearest
from ..rigid.model import RobotModel
from .certified import nearest_approaches
from .clearance import Clearance
from .motions import Trajectory

__all__ = [
    "ALLOWED",
    "CHECK_RATE",
    "KINDS",
    "Limits",
    "Torque",
    "Use",
    "checked",
    "limits_of",
    "open_limits",
    "unmeetable",
]

KINDS = ("position", "velocity", "acceleration", "torque")
CHECK_RATE = 1000.0  # Hz
ALLOWED = 1e-3  # of a limit: what may be exceeded at 1 kHz
_TURNS = 10 * 2 * np.pi  # rad: a range beyond ten turns is more likely one of degrees
_SKIPPED = 10  # samples of 1 kHz, between two that are always looked at
_POSTURES, _FIRST = 512, 64  # at which the torque of standing still is looked at, and how many of them first
_NEAR, _AROUND, _NEARER = 4, 32, 24  # of these the easiest, postures around each, and how often these come nearer

# torques (samples, nv) of states (3, samples, nv)
Torque = Callable[[Float[np.ndarray, "3 samples nv"]], Float[np.ndarray, "samples nv"]]
Given = Literal["model"] | float | Mapping[str, float] | None


@dataclass(frozen=True)
class Limits:
    """Largest values of each joint, infinite where there is no limit."""

    position: Float[np.ndarray, "nv 2"]  # rad or m
    velocity: Float[np.ndarray, " nv"]
    acceleration: Float[np.ndarray, " nv"]
    torque: Float[np.ndarray, " nv"]  # N m or N
    clearance: Clearance | None = None  # distances between bodies

    @property
    def middle(self) -> Float[np.ndarray, " nv"]:
        """Of the range of positions; zero where there is none."""
        low, high = self.position.T
        bounded = np.isfinite(low) & np.isfinite(high)
        return (np.where(bounded, low, 0.0) + np.where(bounded, high, 0.0)) / 2

    @property
    def reach(self) -> Float[np.ndarray, " nv"]:
        """Half of the range of positions; infinite where there is none."""
        half = (self.position[:, 1] - self.position[:, 0]) / 2
        return np.where(np.isfinite(half), half, np.inf)

    def of(self, kind: str) -> Float[np.ndarray, " nv"]:
        """Largest value of a kind; of positions, of the distance from the middle."""
        return self.reach if kind == "position" else getattr(self, kind)


@dataclass(frozen=True)
class Use:
    """The largest share of a limit that a motion uses, and where."""

    kind: str
    joint: str  # of distances: the two bodies
    share: float  # 1: the limit; of distances the margin by the distance, and more where it is less than the margin
    time: float  # s
    value: float  # rad, rad/s, rad/s^2, N m (m, N)
    limit: float

    @property
    def met(self) -> bool:
        """Whether the limit is met within a thousandth."""
        return self.share <= 1.0 + ALLOWED


def limits_of(
    robot: RobotModel,
    position: Given | Mapping[str, float | tuple[float, float]] = "model",
    velocity: Given = "model",
    acceleration: Given = None,
    torque: Given = "model",
    *,
    clearance: Clearance | None = None,
    scale: float = 1.0,
) -> Limits:
    """Limits of the model or stated ones (a number, or a map by joint; None: none), all times `scale`.

    `clearance`: distances between bodies, as `clearance_of` has them.

    Raises `InputError` where a joint is not there, or a limit leaves no room.

    >>> import figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> limits = fj.limits_of(robot, velocity={"elbow": 1.0}, acceleration=10.0, scale=0.9)
    >>> float(limits.velocity[robot.joint_names.index("elbow")])
    0.9
    """
    check_kind("robot", robot, RobotModel, "load_urdf reads one; an ExtendedModel holds one as `.robot`")
    check_positive("scale", scale, "times the limits")
    if clearance is not None:
        check_kind("clearance", clearance, Clearance, "`clearance_of` makes one")
    given = {
        "velocity": _by_joint(robot, "velocity", velocity, np.asarray(robot.velocity_limit, float)),
        "acceleration": _by_joint(robot, "acceleration", acceleration, np.full(robot.nv, np.inf)),
        "torque": _by_joint(robot, "torque", torque, np.asarray(robot.effort_limit, float)),
    }
    for kind, values in given.items():
        for name, value in zip(robot.dof_names, values, strict=True):
            if not value > 0:
                raise InputError(f"limits.{kind}: {value:g} for '{name}' allows no motion; more than 0 is expected")
    span = _positions(robot, position)
    for name, (low, high) in zip(robot.dof_names, span, strict=True):
        if not low < high:
            raise InputError(
                f"limits.position: '{name}' may move from {low:g} to {high:g}: that leaves no room"
                f"; state it, as in limits: {{position: {{{name}: [-1, 1]}}}}"
            )
    with np.errstate(invalid="ignore"):
        middle, half = span.sum(axis=1, keepdims=True) / 2, np.diff(span) / 2
        scaled = np.where(np.isfinite(span), middle + np.array([-1.0, 1.0]) * half * scale, span)
    return Limits(scaled, **{kind: given[kind] * scale for kind in KINDS[1:]}, clearance=clearance)


def open_limits(robot: RobotModel, limits: Limits, given: Mapping[str, Given]) -> tuple[str, ...]:
    """What is to be said of limits that nobody gives, where the task does not waive them, and of odd ones.

    `given` holds what the task states of position, velocity and torque.
    """
    said, turns = [], robot.dofs.turns[np.argsort(robot.dofs.column)]
    for kind in ("position", "velocity", "torque"):
        if given.get(kind) is None:
            continue
        names = [name for name, x in zip(robot.dof_names, limits.of(kind), strict=True) if not np.isfinite(x)]
        if names:
            said.append(
                f"nothing limits the {kind} of {', '.join(names)} (the model says 0 or nothing): the motion may ask"
                f" for more than the robot can do; state limits.{kind}"
            )
    for name, turning, (low, high) in zip(robot.dof_names, turns, limits.position, strict=True):
        if turning and _TURNS < high - low < np.inf:
            said.append(f"'{name}' may move from {low:g} to {high:g} rad: are its limits in degrees?")
    return tuple(said)


def _by_joint(robot: RobotModel, kind: str, given: Any, own: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
    if given is None:
        return np.full(robot.nv, np.inf)
    if isinstance(given, str) and given != "model":
        raise InputError(
            f"limits.{kind} is the text '{given[:100]}'; a number, a map by joint, None or 'model' is expected"
        )
    if isinstance(given, str):
        return np.where(own > 0, own, np.inf) if kind != "acceleration" else own
    if not isinstance(given, Mapping):
        if np.ndim(given):
            raise InputError(f"limits.{kind} is {given!r:.100}; a number for all joints is expected, or a map by joint")
        return np.full(robot.nv, float(given))
    out = np.where(own > 0, own, np.inf)  # as `model` has the joints that the map leaves out
    for name, value in given.items():
        check_real(f"limits.{kind}: '{name}'", value)
        out[_dof(robot, kind, name)] = value
    return out


def _positions(robot: RobotModel, given: Any) -> Float[np.ndarray, "nv 2"]:
    own = np.array(robot.position_limit, float)
    if given is None:
        return np.tile([-np.inf, np.inf], (robot.nv, 1))
    if isinstance(given, str) and given != "model":
        raise InputError(
            f"limits.position is the text '{given[:100]}'; a number, a map by joint, None or 'model' is expected"
        )
    if isinstance(given, Mapping):
        for name, value in given.items():
            check_real(f"limits.position: '{name}'", value)
            pair = (-value, value) if np.ndim(value) == 0 else tuple(value)
            own[_dof(robot, "position", name)] = pair
        return own
    return own if isinstance(given, str) else np.tile([-float(given), float(given)], (robot.nv, 1))


def _dof(robot: RobotModel, kind: str, name: str) -> int:
    if name not in robot.dof_names:
        raise InputError(f"limits.{kind}: no moving joint '{name}'{nearest(name, robot.dof_names)}")
    return robot.dof_names.index(name)


def unmeetable(torque: Torque, robot: RobotModel, limits: Limits, seed: int = 0) -> str | None:
    """Why no motion meets the limits, where the torque of standing still says so: which joint, by how much."""
    if not np.isfinite(limits.torque).any():
        return None
    generator = np.random.default_rng(seed)
    low, high = (np.where(np.isfinite(x), x, end) for x, end in zip(limits.position.T, (-np.pi, np.pi), strict=True))
    q = generator.uniform(low, high, (_POSTURES, robot.nv))
    for some in (q[:_FIRST], q):
        held = _held_still(torque, limits, some)
        if held.max(axis=1).min() <= 1.0:
            return None
    best, shares = _easiest(torque, limits, q, held, (low, high), generator)
    if shares.max() <= 1.0:
        return None
    worst = int(shares.argmax())
    at = ", ".join(f"{x:.3g}" for x in best)
    return (
        f"limits.torque: holding still takes {shares[worst]:.2f} times the limit of '{robot.dof_names[worst]}'"
        f" ({limits.torque[worst]:g}) in the easiest posture that was found ({at}); no motion meets it"
    )


def _held_still(torque: Torque, limits: Limits, q: Float[np.ndarray, "samples nv"]) -> Float[np.ndarray, "samples nv"]:
    return np.abs(torque(np.stack([q, 0 * q, 0 * q]))) / limits.torque


def _easiest(
    torque: Torque,
    limits: Limits,
    q: Float[np.ndarray, "samples nv"],
    held: Float[np.ndarray, "samples nv"],
    ends: tuple[np.ndarray, np.ndarray],
    generator: np.random.Generator,
) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"]]:
    """The posture that is easiest to hold of all near the easiest of some, nearer and nearer; and the shares there."""
    first = held.max(axis=1).argsort()[:_NEAR]
    q, held = q[first], held[first]
    for reach in np.geomspace(0.5, 1e-3, _NEARER):
        others = np.repeat(q, _AROUND, axis=0)
        others = np.clip(others + reach * generator.standard_normal(others.shape), *ends)
        every = np.concatenate([q, others]), np.concatenate([held, _held_still(torque, limits, others)])
        best = every[1].max(axis=1).argsort()[:_NEAR]
        q, held = every[0][best], every[1][best]
        if held[0].max() <= 1.0:
            break
    return q[0], held[0]


def checked(
    torque: Torque, robot: RobotModel, motion: Trajectory, limits: Limits, *, meshes: bool = True
) -> tuple[Use, ...]:
    """The largest use of each limit at 1 kHz; `torque` gives that of states (3, samples, nv), N m or N.

    Torques and distances are looked at 100 times a second, and at 1 kHz wherever what lies between two of these
    instants could be larger than the largest of them. `meshes`: distances by the shapes of the bodies where their
    capsules are too near, and between samples too (`certified`).
    """
    time = motion.basis.instants(CHECK_RATE)
    states = np.stack([np.asarray(x) for x in motion.at(time)])
    uses = []
    for kind, moved in zip(KINDS, (states[0] - limits.middle, states[1], states[2]), strict=False):
        if np.isfinite(limits.of(kind)).any():
            shares, at = np.abs(moved) / limits.of(kind), np.arange(len(time))
            uses.append(_largest(kind, robot, limits, shares, time[at], states[0] if kind == "position" else moved))
    if np.isfinite(limits.torque).any():
        tau, at = _looked(lambda k: torque(states[:, k]), lambda x: np.abs(x) / limits.torque, len(time))
        uses.append(_largest("torque", robot, limits, np.abs(tau) / limits.torque, time[at], tau))
    if limits.clearance is not None:
        uses += _distances(limits.clearance, motion, states[0], time, meshes)
    return tuple(uses)


def _largest(
    kind: str, robot: RobotModel, limits: Limits, share: np.ndarray, time: np.ndarray, values: np.ndarray
) -> Use:
    at, joint = (int(k) for k in np.unravel_index(int(np.argmax(share)), share.shape))
    real = float(values[at, joint])
    middle = float(limits.middle[joint])
    bound = limits.position[joint, int(real > middle)] if kind == "position" else limits.of(kind)[joint]
    return Use(kind, robot.dof_names[joint], float(share[at, joint]), float(time[at]), real, float(bound))


def _looked(
    values: Callable[[np.ndarray], np.ndarray], size: Callable[[np.ndarray], np.ndarray], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Values at every tenth sample, and at those between where the size could exceed the largest; and the samples."""
    coarse = np.unique(np.append(np.arange(0, count, _SKIPPED), count - 1))
    first = values(coarse)
    shares = size(first)
    change = np.abs(np.diff(shares, axis=0))
    around = np.maximum(np.maximum(change, np.roll(change, 1, 0)), np.roll(change, -1, 0))
    could = np.maximum(shares[:-1], shares[1:]) + around >= shares.max() - 1e-12
    between = [np.arange(coarse[k] + 1, coarse[k + 1]) for k in np.flatnonzero(could.any(axis=1))]
    fine = np.concatenate([np.zeros(0, int), *between])
    if not len(fine):
        return first, coarse
    return np.concatenate([first, values(fine)]), np.concatenate([coarse, fine])


def _distances(clearance: Clearance, motion: Trajectory, q: np.ndarray, time: np.ndarray, shapes: bool) -> list[Use]:
    """The nearest two bodies at 1 kHz, by their capsules; with their shapes, at every instant between too."""
    margin, rows, uses = clearance.margin, clearance.rows, []
    told = nearest_approaches(clearance, motion, (1.0 - ALLOWED) * margin) if shapes else []
    exact = {row for one in told if one.exact for row in np.flatnonzero(rows.pair == one.row).tolist()}
    own = np.array([row for row in range(len(rows.names)) if row not in exact], int)
    if len(own):
        distances = clearance.capsule_distances if shapes else clearance.distances
        near, at = _looked(lambda k: distances(q[k])[:, own], lambda d: -d, len(time))
        s, row = (int(k) for k in np.unravel_index(int(np.argmin(near)), near.shape))
        uses.append(_nearness(clearance.name(own[row]), float(near[s, row]), float(time[at[s]]), margin))
    for one in told:
        if one.exact or not one.kept:
            name = f"{one.bodies} (meshes)" if one.exact else one.bodies
            distance = one.distance if one.kept else min(one.distance, (1.0 - 2 * ALLOWED) * margin)
            uses.append(_nearness(name, distance, one.time, margin))
    return uses


def _nearness(bodies: str, distance: float, time: float, margin: float) -> Use:
    """How much of a margin two bodies use: the margin by their distance, with the same slope below the margin."""
    share = margin / distance if distance >= margin else 2.0 - distance / margin
    return Use("clearance", bodies, share, time, distance, margin)
