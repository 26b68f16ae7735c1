"""How much a recording is like its robot: the measured torque against what the nominal model needs for the motion.

Each joint's torque is regressed on the rigid body's (nominal inertials), viscous and Coulomb friction, the joint's own
acceleration (rotor) and a constant. The sign, the size and the partial correlation of the rigid body's share tell
whether columns, signs, units and clock can be right. Nothing here is an identification: a robot 30 % off still fits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..rigid.model import RobotModel
from .rowfilter import low_pass

__all__ = [
    "Likeness",
    "Sampled",
    "frame_poses",
    "likeness",
    "matrix_of_likeness",
    "rigid_torque",
    "sampled",
    "share_of_gravity",
    "stretch_of_time",
]

ROWS = 400  # evenly spread over the recording: more do not change a correlation
CUTOFF = 5.0  # Hz, the band in which gravity and inertia stand above noise
LINKS_OFF = 0.3  # of the inertial torque of a joint: what nominal links may be off
FEWEST_JOINTS = 1.5  # that must tell of the clock, each counted by its weight
STANDS = 0.02  # of a joint's top speed
ENOUGH_MOVING = 60  # rows in which a joint moves, of at most `ROWS`
FEWEST = 16  # samples that a filter and five columns need


@dataclass(frozen=True, eq=False)
class Sampled:
    """Rows of a recording, low-passed: position, its derivatives by time, and torque where there is one."""

    position: Float[np.ndarray, "rows nv"]
    velocity: Float[np.ndarray, "rows nv"]
    acceleration: Float[np.ndarray, "rows nv"]
    torque: Float[np.ndarray, "rows columns"] | None
    rate: float  # Hz of the recording

    def scaled(self, position: Float[np.ndarray, " nv"] | float = 1.0, time: float = 1.0) -> Sampled:
        """The same motion with positions `position` times as large and a clock that runs `time` times as long."""
        return replace(
            self,
            position=self.position * position,
            velocity=self.velocity * position / time,
            acceleration=self.acceleration * position / time**2,
            rate=self.rate / time,
        )

    def moved(self, offset: Float[np.ndarray, " nv"]) -> Sampled:
        """The same motion with other zeros of its joints."""
        return replace(self, position=self.position + offset)

    def thinned(self, rows: int) -> Sampled:
        """At most so many rows."""
        step = slice(None, None, max(1, -(-len(self.position) // rows)))
        motion = (self.position[step], self.velocity[step], self.acceleration[step])
        torque = None if self.torque is None else self.torque[step]
        return Sampled(*motion, torque, self.rate)

    def with_columns(self, order) -> Sampled:
        """The motion with its columns in another order."""
        order = list(order)
        motion = (self.position[:, order], self.velocity[:, order], self.acceleration[:, order])
        return replace(self, position=motion[0], velocity=motion[1], acceleration=motion[2])


class Likeness(NamedTuple):
    """One torque column against one joint of the model."""

    slope: float  # measured over nominal rigid-body torque
    error: float  # its standard error, for rows that depend on their neighbours
    correlation: float  # partial: friction, rotor and constant taken out of both
    expected: float  # RMS of the rigid body's torque, friction, rotor and constant taken out, N m


def sampled(
    time: Float[np.ndarray, " samples"],
    position: Float[np.ndarray, "samples nv"],
    torque: Float[np.ndarray, "samples columns"] | None = None,
) -> Sampled | None:
    """Rows of a recording on an even grid, low-passed without phase; None where it is too short."""
    if len(time) < FEWEST:
        return None
    rate = (len(time) - 1) / (time[-1] - time[0])
    grid = np.linspace(time[0], time[-1], len(time))

    def smooth(x: np.ndarray) -> np.ndarray:
        even = np.column_stack([np.interp(grid, time, column) for column in x.T])
        return low_pass(even, 1 / rate, min(CUTOFF, 0.1 * rate), order=2)

    q = smooth(position)
    v = np.gradient(q, 1 / rate, axis=0)
    a = np.gradient(v, 1 / rate, axis=0)
    edge = min(len(time) // 20, int(rate / CUTOFF) + 1)
    rows = np.unique(np.linspace(edge, len(time) - 1 - edge, min(ROWS, len(time) - 2 * edge)).astype(int))
    return Sampled(q[rows], v[rows], a[rows], None if torque is None else smooth(torque)[rows], rate)


def rigid_torque(model: RobotModel, motion: Sampled) -> Float[np.ndarray, "rows nv"]:
    """Torque of the nominal rigid body along the motion (N m, N): Newton-Euler in NumPy.

    A few hundred rows of one robot do not pay for a compiled program (`rigid.dynamics.inverse_dynamics`), and a check
    comes before any work. Joints are revolute or prismatic.
    """
    bodies = _bodies(model, motion.position, motion.velocity, motion.acceleration)
    wrenches = [_wrench(np.asarray(ten, float), body) for ten, body in zip(model.inertia, bodies[1:], strict=True)]
    out = np.zeros(motion.position.shape)
    for i in reversed(range(len(model.joints))):
        joint, body, (force, torque) = model.joints[i], bodies[i + 1], wrenches[i]
        along = torque if joint.kind == "revolute" else force
        out[:, joint.coordinate] += model.ratio[i] * np.einsum("ni,ni->n", body.axis, along)
        if joint.parent >= 0:
            up, arm = wrenches[joint.parent], body.origin - bodies[joint.parent + 1].origin
            wrenches[joint.parent] = up[0] + force, up[1] + torque + _cross(arm, force)
    return out


def frame_poses(
    model: RobotModel, position: Float[np.ndarray, "rows nv"], frame: str
) -> tuple[Float[np.ndarray, "rows 3 3"], Float[np.ndarray, "rows 3"]]:
    """Orientation and origin (m) of a frame in the world, of revolute and prismatic joints."""
    still = np.zeros_like(position)
    at = model.frame_index(frame)
    body, place = _bodies(model, position, still, still)[model.frames[at].parent + 1], model.frame_placement[at]
    place = np.asarray(place, float)
    return body.pose @ place[:3, :3], body.origin + body.pose @ place[:3, 3]


def _bodies(model: RobotModel, position: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> list[_Body]:
    """The world, then every link."""
    columns = [j.coordinate for j in model.joints]
    q, v, a = (x[:, columns] * np.asarray(model.ratio) for x in (position, velocity, acceleration))
    q = q + np.asarray(model.offset)
    zero = np.zeros((len(q), 3))
    lifted = np.tile(-np.asarray(model.gravity, float), (len(q), 1))
    bodies = [_Body(zero, zero, zero, lifted, np.tile(np.eye(3), (len(q), 1, 1)), zero)]
    for i, joint in enumerate(model.joints):
        bodies.append(_moved(model, i, bodies[joint.parent + 1], q[:, i], v[:, i], a[:, i]))
    return bodies


class _Body(NamedTuple):
    """A link in the world along the rows; `axis` is that of the joint that moves it."""

    origin: np.ndarray
    spin: np.ndarray
    turning: np.ndarray  # rate of the spin
    acceleration: np.ndarray  # of the origin, gravity taken off
    pose: np.ndarray
    axis: np.ndarray


def _cross(a: Float[np.ndarray, "rows 3"], b: Float[np.ndarray, "rows 3"]) -> Float[np.ndarray, "rows 3"]:
    """`np.cross`, which takes ten times as long for a few hundred rows."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def _turned(angle: Float[np.ndarray, " rows"], axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "rows 3 3"]:
    """Rotations by angles (rad) about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sine, cosine = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + sine * cross + (1 - cosine) * (cross @ cross)


def _moved(model: RobotModel, i: int, parent: _Body, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> _Body:
    at_zero, own = np.asarray(model.placement[i], float), np.asarray(model.axis[model.dofs.first[i]], float)
    pose = parent.pose @ at_zero[:3, :3]
    axis, arm = pose @ own, parent.pose @ at_zero[:3, 3]
    spin, turning, pushed = parent.spin, parent.turning, 0.0
    if model.joints[i].kind == "revolute":
        pose = pose @ _turned(q, own)
        spin = spin + axis * v[:, None]
        turning = turning + axis * a[:, None] + _cross(parent.spin, axis * v[:, None])
    else:
        arm = arm + axis * q[:, None]
        pushed = axis * a[:, None] + 2 * _cross(parent.spin, axis * v[:, None])
    swung = _cross(parent.turning, arm) + _cross(parent.spin, _cross(parent.spin, arm))
    return _Body(parent.origin + arm, spin, turning, parent.acceleration + swung + pushed, pose, axis)


def _wrench(ten: Float[np.ndarray, "10"], body: _Body) -> tuple[np.ndarray, np.ndarray]:
    """Force and torque about the link's origin, in the world, that move a link."""
    xx, xy, yy, xz, yz, zz = ten[4:]
    own = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    inertia, first = body.pose @ own @ body.pose.swapaxes(1, 2), body.pose @ ten[1:4]
    force = ten[0] * body.acceleration + _cross(body.turning, first)
    force = force + _cross(body.spin, _cross(body.spin, first))
    gyroscopic = _cross(body.spin, np.einsum("nij,nj->ni", inertia, body.spin))
    return force, _cross(first, body.acceleration) + np.einsum("nij,nj->ni", inertia, body.turning) + gyroscopic


def likeness(
    nominal: Float[np.ndarray, " rows"],
    torque: Float[np.ndarray, " rows"],
    velocity: Float[np.ndarray, " rows"],
    acceleration: Float[np.ndarray, " rows"],
) -> Likeness:
    """One measured torque against one nominal torque, beside the friction and the rotor of one joint.

    Rows at which the joint stands are left out where enough others are there: dry friction holds any torque then.
    """
    moves = np.abs(velocity) > STANDS * np.abs(velocity).max()
    if ENOUGH_MOVING <= moves.sum() < len(velocity):
        nominal, torque, velocity, acceleration = (x[moves] for x in (nominal, torque, velocity, acceleration))
    speed = np.sqrt(np.mean(velocity**2)) or 1.0
    others = np.column_stack([np.ones(len(torque)), velocity, np.tanh(velocity / (0.1 * speed)), acceleration])
    basis = _basis(others)
    x, y = (z - basis @ (basis.T @ z) for z in (nominal, torque))
    spread = np.std(torque)
    xx, yy, xy = x @ x, y @ y, x @ y
    expected = float(np.sqrt(xx / len(x)))
    if xx <= 1e-12 * max(nominal @ nominal, 1e-12) or yy <= 1e-18 * max(torque @ torque, 1e-300) or spread == 0:
        return Likeness(0.0, np.inf, 0.0, expected)
    slope, correlation = xy / xx, xy / np.sqrt(xx * yy)
    freedom = max(len(torque) / 10 - others.shape[1] - 1, 1.0)  # neighbours tell the same
    error = np.sqrt(max(yy - xy * slope, 0.0) / xx / freedom)
    return Likeness(float(slope), float(error), float(correlation), expected)


def _basis(columns: Float[np.ndarray, "rows k"]) -> Float[np.ndarray, "rows _"]:
    u, s, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
    return u[:, s > 1e-8]


def matrix_of_likeness(
    motion: Sampled, nominal: Float[np.ndarray, "rows nv"], torque: Float[np.ndarray, "rows columns"]
) -> list[list[Likeness]]:
    """Each torque column (second index) against each joint of the model (first index)."""
    return [
        [likeness(nominal[:, j], column, motion.velocity[:, j], motion.acceleration[:, j]) for column in torque.T]
        for j in range(nominal.shape[1])
    ]


def share_of_gravity(
    model: RobotModel, motion: Sampled
) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"], Float[np.ndarray, " nv"]]:
    """Gravity in each joint's measured torque over the model's, its standard error, and the RMS expected (N m)."""
    assert motion.torque is not None
    nominal, still = rigid_torque(model, motion), rigid_torque(model, motion.scaled(time=1e6))
    found = []
    for j in range(model.nv):
        others = [*_drive(motion, j), nominal[:, j] - still[:, j]]
        slope, error, _ = _last_slope(np.column_stack([*others, still[:, j]]), motion.torque[:, j])
        found.append((slope, error, np.std(still[:, j]) if np.isfinite(error) else 0.0))
    slope, error, expected = np.array(found).T
    return slope, np.where(np.isfinite(error), error, np.inf), expected


def stretch_of_time(model: RobotModel, motion: Sampled) -> tuple[float, float]:
    """By what the clock is too fast, and the standard error of its logarithm; infinite where the torque does not tell.

    Gravity needs no clock and the inertial torque goes with its square: its share of the measured torque, where the
    joint's own rotor is left aside, is one if the clock is right. Each joint counts by how well it is known and by how
    far its nominal links may be off; a single one tells nothing, and where they differ by more, all of it is less sure.
    """
    if motion.torque is None:
        return 1.0, np.inf
    nominal, still = rigid_torque(model, motion), rigid_torque(model, motion.scaled(time=1e6))
    found = []
    for j in range(model.nv):
        gravity, moving = still[:, j] - still[:, j].mean(), nominal[:, j] - still[:, j]
        others = _drive(motion, j)
        if np.std(gravity) > 0.05 * np.std(moving):
            others.append(gravity)
        slope, error, explained = _last_slope(np.column_stack([*others, moving]), motion.torque[:, j])
        if explained > 0.8 and 0 < error < np.inf:
            found.append((slope, error))
    if len(found) < 2:
        return 1.0, np.inf
    slope, error = np.array(found).T
    middle, weight = 0.0, 1 / error**2
    for _ in range(3):  # what the links are off grows with the share itself
        middle = float(weight @ slope / weight.sum())
        weight = 1 / (error**2 + (LINKS_OFF * middle) ** 2)
    if middle <= 0 or weight.sum() ** 2 < FEWEST_JOINTS * (weight @ weight):
        return 1.0, np.inf
    scatter = max(1.0, float(weight @ (slope - middle) ** 2) / (len(slope) - 1))
    return float(np.sqrt(middle)), float(np.sqrt(scatter / weight.sum()) / middle / 2)


def _drive(motion: Sampled, joint: int) -> list[Float[np.ndarray, " rows"]]:
    """Constant, viscous and Coulomb friction, and rotor of one joint."""
    v = motion.velocity[:, joint]
    speed = np.sqrt(np.mean(v**2)) or 1.0
    return [np.ones(len(v)), v, np.tanh(v / (0.1 * speed)), motion.acceleration[:, joint]]


def _last_slope(columns: Float[np.ndarray, "rows k"], torque: Float[np.ndarray, " rows"]) -> tuple[float, float, float]:
    """Coefficient of the last column, its standard error, and the share of the torque's variance that all explain."""
    basis = _basis(columns[:, :-1])
    x, y = (z - basis @ (basis.T @ z) for z in (columns[:, -1], torque))
    if x @ x <= 1e-9 * (columns[:, -1] @ columns[:, -1]) or np.std(torque) == 0:
        return 0.0, np.inf, 0.0
    slope = (x @ y) / (x @ x)
    rest = max(y @ y - slope * (x @ y), 0.0)
    error = np.sqrt(rest / (x @ x) / max(len(torque) / 10 - columns.shape[1], 1.0))
    return float(slope), float(error), float(1 - rest / len(torque) / np.var(torque))
