"""Limits of a motion: what the model and the task give, as rows of an optimiser, and the check at 1 kHz.

A row is the share of its limit that a motion uses, less one: position from the middle of its range in half ranges,
velocity, acceleration and torque in their limits. Zero or less is allowed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from ..errors import InputError, nearest
from ..rigid.model import RobotModel
from .motions import Trajectory

__all__ = ["KINDS", "CHECK_RATE", "Limits", "Torque", "Use", "checked", "limits_of", "unmeetable"]

KINDS = ("position", "velocity", "acceleration", "torque")
CHECK_RATE = 1000.0  # Hz
ALLOWED = 1e-3  # of a limit: what may be exceeded at 1 kHz
_POSTURES = 512  # at which the torque of standing still is looked at

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

    @property
    def middle(self) -> Float[np.ndarray, " nv"]:
        """Of the range of positions; zero where there is none."""
        both = self.position.sum(axis=1) / 2
        return np.where(np.isfinite(both), both, 0.0)

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
    joint: str
    share: float  # 1: the limit
    time: float  # s
    value: float  # rad, rad/s, rad/s^2, N m (m, N)
    limit: float


def limits_of(
    robot: RobotModel,
    position: Given | Mapping[str, float | tuple[float, float]] = "model",
    velocity: Given = "model",
    acceleration: Given = None,
    torque: Given = "model",
    *,
    scale: float = 1.0,
) -> Limits:
    """Limits of the model or stated ones (a number, or a map by joint; None: none), all times `scale`.

    Raises `InputError` where a joint is not there, or a limit leaves no room.
    """
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
            raise InputError(f"limits.position: '{name}' may move from {low:g} to {high:g}: that leaves no room")
    middle, half = span.sum(axis=1, keepdims=True) / 2, np.diff(span) / 2
    with np.errstate(invalid="ignore"):
        scaled = np.where(np.isfinite(span), middle + np.array([-1.0, 1.0]) * half * scale, span)
    return Limits(scaled, *(given[kind] * scale for kind in KINDS[1:]))


def _by_joint(robot: RobotModel, kind: str, given: Any, own: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
    if given is None:
        return np.full(robot.nv, np.inf)
    if isinstance(given, str):
        return np.where(own > 0, own, np.inf) if kind != "acceleration" else own
    if not isinstance(given, Mapping):
        return np.full(robot.nv, float(given))
    out = np.array(own, float)
    for name, value in given.items():
        out[_dof(robot, kind, name)] = value
    return out


def _positions(robot: RobotModel, given: Any) -> Float[np.ndarray, "nv 2"]:
    own = np.array(robot.position_limit, float)
    if given is None:
        return np.tile([-np.inf, np.inf], (robot.nv, 1))
    if isinstance(given, Mapping):
        for name, value in given.items():
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
    held = np.abs(torque(np.stack([q, 0 * q, 0 * q]))) / limits.torque
    best = int(held.max(axis=1).argmin())
    worst = int(held[best].argmax())
    if held[best, worst] <= 1.0:
        return None
    return (
        f"limits.torque: holding still takes {held[best, worst]:.2f} times the limit of '{robot.dof_names[worst]}'"
        f" ({limits.torque[worst]:g}) in the easiest of {_POSTURES} postures; no motion meets it"
    )


def checked(torque: Torque, robot: RobotModel, motion: Trajectory, limits: Limits) -> tuple[Use, ...]:
    """The largest use of each limit at 1 kHz; `torque` gives that of states (3, samples, nv), N m or N."""
    time = motion.basis.instants(CHECK_RATE)
    q, v, a = (np.asarray(x) for x in motion.at(time))
    values = {"position": q - limits.middle, "velocity": v, "acceleration": a}
    if np.isfinite(limits.torque).any():
        values["torque"] = torque(np.stack([q, v, a]))
    uses = []
    for kind, moved in values.items():
        limit = limits.of(kind)
        if not np.isfinite(limit).any():
            continue
        share = np.abs(moved) / limit
        at, joint = (int(k) for k in np.unravel_index(int(np.argmax(share)), share.shape))
        real = (q if kind == "position" else moved)[at, joint]
        bound = limits.position[joint, int(moved[at, joint] > 0)] if kind == "position" else limit[joint]
        name = robot.dof_names[joint]
        uses.append(Use(kind, name, float(share[at, joint]), float(time[at]), float(real), float(bound)))
    return tuple(uses)
