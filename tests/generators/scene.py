"""One run of a robot with hidden effects, row by row at 1 kHz, before any sensor noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from . import robots
from .motion import Motion

STEP = 1e-3  # s
WARM_UP = 2.0  # s, before the recording: effects with a state forget how they began

Array = np.ndarray


@dataclass(frozen=True)
class Scene:
    """Samples of a run: time, motion at the motors, torque of the rigid bodies and of the drives."""

    robot: robots.Robot
    model: pin.Model  # as it really is
    time: Array  # (samples,) s
    q: Array  # (samples, nv)
    v: Array
    a: Array
    load: Array  # rigid bodies alone
    total: Array  # with viscous and Coulomb friction
    phase: float  # random number in [0, 1) of the recording, for what does not repeat

    def sign(self, joint: int) -> Array:
        """Direction of the joint's velocity, -1, 0 or 1."""
        return np.sign(self.v[:, joint])


@dataclass(frozen=True)
class Hidden:
    """An effect drawn at a place. Every form takes its `scale`, the one number that the size of the case sets."""

    effect: str
    at: tuple[str, ...]
    rows: tuple[int, ...]  # joints whose torque measures the size; empty: all that move
    parameters: Callable[[float], dict[str, float]]
    torque: Callable[[Scene, float], Array] | None = None  # (samples, nv) added at the joints
    change: Callable[[pin.Model, float], pin.Model] | None = None  # of the robot
    position: Callable[[Scene, float], Array] | None = None  # (samples, nv) added to the reading
    record: Callable[[Array, float], Array] | None = None  # of the torque reading
    warp: Callable[[Array, float], Array] | None = None  # of the time at which torque is read
    motor_side: bool = False  # the position error is a motion of the motor, which friction feels
    bounds: tuple[float, float] = (0.0, np.inf)  # of the scale, where the effect stays physical
    linear: bool = True  # torque in proportion to the scale
    scale: float = field(default=0.0)


def friction(robot: robots.Robot, v: Array) -> Array:
    """Viscous and Coulomb friction, which every case has."""
    return robot.viscous * v + robot.coulomb * np.sign(v)


def grid(duration: float) -> Array:
    """Times of a run at 1 kHz with its warm-up; two extra samples at the end for derivatives."""
    return np.arange(-WARM_UP, duration + 2 * STEP, STEP)


def derivative(x: Array) -> Array:
    """Time derivative of rows at 1 kHz, central differences of fourth order inside."""
    slope = np.gradient(x, STEP, axis=0)
    slope[2:-2] = (8 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) / (12 * STEP)
    return slope


def run(
    robot: robots.Robot, model: pin.Model, motion: Motion, time: Array, hidden: Sequence[Hidden] = (), phase: float = 0
) -> tuple[Array, Array]:
    """Position and torque that perfect sensors read at `time`, each (samples, nv)."""
    late = time
    for h in hidden:
        late = h.warp(late, h.scale) if h.warp else late
    reading, torque = _world(robot, model, motion, late, hidden, phase)
    if late is not time:
        moved = any(h.position for h in hidden)
        reading = _world(robot, model, motion, time, hidden, phase)[0] if moved else motion.at(time)[0]
    for h in hidden:
        torque = h.record(torque, h.scale) if h.record else torque
    return reading, torque


def _world(
    robot: robots.Robot, model: pin.Model, motion: Motion, time: Array, hidden: Sequence[Hidden], phase: float
) -> tuple[Array, Array]:
    for h in hidden:
        model = h.change(model, h.scale) if h.change else model
    q, v, a = motion.at(time)
    load = robots.torque(model, q, v, a)
    scene = Scene(robot, model, time, q, v, a, load, load, phase)
    windup = [h.position(scene, h.scale) for h in hidden if h.position and h.motor_side]
    if windup:
        motor = q + sum(windup)
        speed = derivative(motor)
        scene = replace(scene, q=motor, v=speed, a=derivative(speed))
    scene = replace(scene, total=load + friction(robot, scene.v))
    torque = scene.total + sum(h.torque(scene, h.scale) for h in hidden if h.torque)
    reading = scene.q + sum(h.position(scene, h.scale) for h in hidden if h.position and not h.motor_side)
    return reading, torque


def induced(robot: robots.Robot, model: pin.Model, motion: Motion, time: Array, h: Hidden) -> tuple[Array, Array]:
    """Torque that the effect brings about and torque without it, on the motion as the sensors read it."""
    reading, torque = run(robot, model, motion, time, (h,))
    if h.position:
        v = derivative(reading)
        a = derivative(v)
    else:
        reading, v, a = motion.at(time)
    without = robots.torque(model, reading, v, a) + friction(robot, v)
    keep = (time >= 0) & (time < time[-1] - 5 * STEP)
    return (torque - without)[keep], without[keep]


def relative_size(h: Hidden, pairs: Sequence[tuple[Array, Array]]) -> float:
    """RMS of the induced torque over the joint's RMS torque: the largest of `rows`, or root mean square over all."""
    extra = np.sqrt(np.mean([np.mean(e**2, 0) for e, _ in pairs], 0))
    ratio = extra / np.sqrt(np.mean([np.mean(w**2, 0) for _, w in pairs], 0))
    if h.rows:
        return float(ratio[list(h.rows)].max())
    moved = ratio[ratio > 1e-9 + 1e-4 * ratio.max()]
    return float(np.sqrt(np.mean(moved**2))) if moved.size else 0.0
