"""Kinematic errors hidden in postures by Pinocchio, each by its own equation: what a tracker sees of three markers, or
of the tool's pose where a frame is said to be known.

`hide` builds the robot a little off everywhere (within the tolerance of a good one), adds one effect at one place and
gives the postures with noisy measurements. A size counts in sigmas: of the noise, as the RMS that the effect moves a
coordinate of a marker; of the tolerance, per coefficient, for what a fit estimates anyway (offsets, links, frames).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

NOISE, TURN = 5e-5, 1e-4  # m and rad, one sigma of the device
TOLERANCE = {"offset": 1e-3, "m": 5e-4, "rad": 1e-3}  # of a good robot: rad, m, rad
BUILT = 0.6  # of the tolerance, that the made robots are off
MARKERS = np.array([[0.05, 0.02, 0.1], [-0.06, 0.03, 0.08], [0.01, -0.07, 0.12]])
LOAD = (3.0, (0.02, 0.0, 0.08))  # kg and m in the tool frame
INTERVAL = 30.0  # s between postures
GEOMETRY = ("joint_offset", "link_geometry", "base_frame", "tool_frame")
EFFECTS = (
    *GEOMETRY,
    "encoder_scale",
    "encoder_eccentricity",
    "gear_transmission_error",
    "joint_compliance",
    "link_compliance",
    "outlier",
    "thermal_growth",
    "payload_deflection",
    "settling",
    "reversal_hysteresis",
    "backlash",
    "joint_coupling",
)
FOREIGN = ("random_play",)

Name = tuple[str, tuple[str, ...]]


class Arm(NamedTuple):
    """A robot file with the joints that move, and the frames between which is measured."""

    path: Path
    robot: pin.Model
    joints: tuple[str, ...]
    base: str
    tool: str


class Recording(NamedTuple):
    """Postures in the order measured, and what was seen: points (postures, 3, 3) or poses (postures, 4, 4)."""

    time: np.ndarray
    q: np.ndarray
    seen: np.ndarray
    loaded: bool


class Hidden(NamedTuple):
    """What a case hides, which names are right (more than one where none can tell them apart), and its recordings."""

    effect: str
    right: frozenset[Name]
    unknown: tuple[str, ...]
    recordings: tuple[Recording, ...]
    rows: tuple[int, ...] = ()  # of outliers
    order: float = 0.0  # of a gear error
    built: np.ndarray | None = None  # (joints, 6): how far each link is off, m and rad


class _Error(NamedTuple):
    """What one unit of an effect does at each posture: to joint positions, to placements before the joint moves."""

    shift: np.ndarray  # (postures, joints), rad or m
    twist: np.ndarray  # (postures, joints, 6)
    order: float = 0.0


def load_arm(path: Path, base: str, tool: str, joints: tuple[str, ...] = ()) -> Arm:
    """The robot with the joints that are not named locked at their neutral position; none named: all move."""
    whole = pin.buildModelFromUrdf(str(path))
    names = tuple(whole.names)[1:]
    locked = [whole.getJointId(name) for name in names if joints and name not in joints]
    robot = pin.buildReducedModel(whole, locked, pin.neutral(whole)) if locked else whole
    return Arm(path, robot, tuple(robot.names)[1:], base, tool)


def hide(
    arm: Arm,
    effect: str | None,
    size: float,
    rng: np.random.Generator,
    count: int = 80,
    orders: tuple[float, float] = (2.5, 11.0),
    off: float = BUILT,
) -> Hidden:
    """A case with `effect` of `size` sigmas at a place drawn at random; None hides nothing.

    `orders` is the range of a gear error's order; the links are `off` tolerances off everywhere.
    """
    n = len(arm.joints)
    loaded = np.arange(count) >= (count // 2 if effect == "payload_deflection" else count)
    q = _postures(arm, rng, count)
    built = np.concatenate(
        [TOLERANCE["m"] * rng.normal(size=(n, 3)), TOLERANCE["rad"] * rng.normal(size=(n, 3))], axis=1
    )
    built *= off
    device = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
    posed = effect in ("base_frame", "tool_frame")
    frames = {"base_frame": pin.SE3.Identity() if effect == "base_frame" else device, "tool_frame": pin.SE3.Identity()}
    if posed:
        frames[effect] = frames[effect] * _twist_pose(_drawn(rng, 6, size))
        if effect == "base_frame":
            frames["tool_frame"] = pin.SE3(pin.exp3(0.2 * rng.normal(size=3)), 0.1 * rng.normal(size=3))
    right, error = _placed(arm, effect, size, rng, q, loaded, orders)
    poses = [frames["base_frame"] * pose * frames["tool_frame"] for pose in _poses(arm, q, built, error)]
    seen = as_seen(poses, rng) if posed else _points(poses) + NOISE * rng.normal(size=(count, 3, 3))
    rows: tuple[int, ...] = ()
    if effect == "outlier":
        rows = tuple(sorted(int(k) for k in rng.choice(count, 2, replace=False)))
        for k in rows:
            way = rng.normal(size=3)
            seen[k] += size * NOISE * np.sqrt(3.0) * way / np.linalg.norm(way)
    time = INTERVAL * np.arange(count)
    parts = [loaded == value for value in (False, True) if np.any(loaded == value)]
    unknown = tuple(name for name in ("base_frame", "tool_frame") if name != effect)
    recordings = tuple(Recording(time[p], q[p], seen[p], bool(loaded[p][0])) for p in parts)
    return Hidden(effect or "nothing", right, unknown, recordings, rows, error.order, built)


class Perturbed(NamedTuple):
    """A robot that is off everywhere: its twists before each joint moves, its place, and what a tracker saw of it."""

    q: np.ndarray
    points: np.ndarray
    twists: np.ndarray  # (joints, 6)
    device: pin.SE3


def slack(arm: Arm, rng: np.random.Generator, count: int, width: float, held: int) -> Hidden:
    """A robot whose geometry is that of a good one, all its joints slack (rad): they lie where gravity and the last
    motion left them. The last `held` postures are a recording of their own."""
    n, q = len(arm.joints), _postures(arm, rng, count)
    built = np.concatenate(
        [TOLERANCE["m"] * rng.normal(size=(n, 3)), TOLERANCE["rad"] * rng.normal(size=(n, 3))], axis=1
    )
    torque, _ = _gravity(arm, q, np.zeros(count, bool))
    play = width / 2 * rng.uniform(0.2, 1.0, n)
    before = np.vstack([q[:1], q[:-1]])
    shift = play * (np.sign(torque + 0.3 * rng.normal(size=q.shape)) + np.sign(q - before))
    device = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
    poses = _poses(arm, q, BUILT * built, _Error(shift, np.zeros((count, n, 6))))
    seen = _points([device * pose for pose in poses]) + NOISE * rng.normal(size=(count, 3, 3))
    parts = (slice(0, count - held), slice(count - held, count))
    recordings = tuple(Recording(INTERVAL * np.arange(count)[p], q[p], seen[p], False) for p in parts)
    return Hidden("slack", frozenset(), ("base_frame", "tool_frame"), recordings)


def perturb(arm: Arm, rng: np.random.Generator, count: int = 60) -> Perturbed:
    """All links off by their tolerance, all joints by 5 mrad, in the mean square; read with noise of 0.1 mm."""
    n, q = len(arm.joints), _postures(arm, rng, count)
    twists = 1e-3 * rng.normal(size=(n, 6))
    for j in range(n):
        axis = _axis(arm, j)
        twists[j, 3:] += axis * (5e-3 * rng.normal() - axis @ twists[j, 3:])
    device = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
    poses = _poses(arm, q, twists, _Error(np.zeros_like(q), np.zeros((count, n, 6))))
    points = _points([device * pose for pose in poses])
    return Perturbed(q, points + 1e-4 * rng.normal(size=points.shape), twists, device)


def _postures(arm: Arm, rng: np.random.Generator, count: int) -> np.ndarray:
    """Random postures over two thirds of the range of each joint, within 2 rad of its middle."""
    low, high = arm.robot.lowerPositionLimit, arm.robot.upperPositionLimit
    half = np.minimum((high - low) / 3.0, 2.0)
    return (low + high) / 2.0 + half * rng.uniform(-1.0, 1.0, (count, len(low)))


def _drawn(rng: np.random.Generator, count: int, size: float) -> np.ndarray:
    """A twist or its last entries, each `size` tolerances in the mean square."""
    way = rng.normal(size=count)
    unit = np.array([TOLERANCE["m"]] * 3 + [TOLERANCE["rad"]] * 3)[:count]
    return size * unit * way * np.sqrt(count) / np.linalg.norm(way)


def _twist_pose(twist: np.ndarray) -> pin.SE3:
    return pin.SE3(pin.exp3(twist[3:]), twist[:3])


def _placed(
    arm: Arm,
    effect: str | None,
    size: float,
    rng: np.random.Generator,
    q: np.ndarray,
    loaded: np.ndarray,
    orders: tuple[float, float],
) -> tuple[frozenset[Name], _Error]:
    """The names that are right, and the error of all postures at its size."""
    n = len(arm.joints)
    none = _Error(np.zeros_like(q), np.zeros((len(q), n, 6)))
    if effect is None:
        return frozenset(), none
    if effect == "outlier":
        return frozenset({("outlier", ())}), none
    if effect in ("base_frame", "tool_frame"):
        # the pose of the base is the pose of the first joint: nothing tells them apart
        twins = (
            {("link_geometry", arm.joints[:1]), ("joint_offset", arm.joints[:1])} if effect == "base_frame" else set()
        )
        return frozenset({(effect, ()), *twins}), none
    if effect == "joint_offset":
        j = int(rng.integers(1, n - 1))
        none.shift[:, j] = size * TOLERANCE["offset"] * rng.choice([-1.0, 1.0])
        return frozenset({(effect, (arm.joints[j],))}), none
    if effect == "link_geometry":
        j = int(rng.integers(1, n))
        twist = _drawn(rng, 6, size)
        axis = _axis(arm, j)
        twist[3:] -= axis * (axis @ twist[3:])
        none.twist[:, j] = twist
        return frozenset({(effect, (arm.joints[j],))}), none
    at, unit = _law(arm, effect, rng, q, loaded, orders)
    sign = 1.0 if effect in ("backlash", "settling", "link_compliance", "joint_compliance") else rng.choice([-1.0, 1.0])
    small = 1e-4 / np.sqrt(np.mean(np.sum(unit.shift**2, axis=1) + np.sum(unit.twist**2, axis=(1, 2))))
    built = np.zeros((n, 6))
    still, moved = (_points(_poses(arm, q, built, e)) for e in (none, _scaled(unit, small)))
    factor = sign * size * NOISE * small / np.sqrt(np.mean((moved - still) ** 2))
    return frozenset({(effect, at)}), _scaled(unit, factor)


def _scaled(error: _Error, factor: float) -> _Error:
    return error._replace(shift=factor * error.shift, twist=factor * error.twist)


def _law(
    arm: Arm,
    effect: str,
    rng: np.random.Generator,
    q: np.ndarray,
    loaded: np.ndarray,
    orders: tuple[float, float],
) -> tuple[tuple[str, ...], _Error]:
    """Where the effect acts and one unit of it."""
    n = len(arm.joints)
    shift, twist = np.zeros_like(q), np.zeros((len(q), n, 6))
    before = np.vstack([q[:1], q[:-1]])
    torque, moment = _gravity(arm, q, loaded)
    if effect == "settling":
        return (), _Error(before - q, twist)
    heavy = [j for j in range(n) if np.std(torque[:, j]) > 0.3]
    places: dict[str, list[int]] = {
        "joint_compliance": heavy,
        "backlash": heavy,
        "payload_deflection": [j for j in heavy if loaded.any() and np.std(torque[loaded, j]) > 0.3],
        "link_compliance": [j for j in range(n) if np.std(moment[:, j]) > 0.3],
        "thermal_growth": [j for j in range(n) if np.linalg.norm(_way(arm, j)) > 0.05],
    }
    j = int(rng.choice(places.get(effect, list(range(n)))))
    x, at = q[:, j], (arm.joints[j],)
    if effect == "joint_coupling":
        i = int(rng.choice([k for k in (j - 1, j + 1) if 0 <= k < n]))
        shift[:, j] = q[:, i]
        return (arm.joints[i], arm.joints[j]), _Error(shift, twist)
    if effect == "link_compliance":
        axis = _axis(arm, j)
        across = moment[:, j] - np.outer(moment[:, j] @ axis, axis)
        twist[:, j, 3:] = across @ np.diag(rng.uniform(0.5, 1.5, 3))
        twist[:, j, 3:] -= np.outer(twist[:, j, 3:] @ axis, axis)
        return at, _Error(shift, twist)
    if effect == "thermal_growth":
        way = arm.robot.jointPlacements[j + 1].rotation.T @ _way(arm, j)
        warm = 1.0 - np.exp(-np.arange(len(q)) / (rng.uniform(0.15, 0.6) * len(q)))
        twist[:, j, :3] = np.outer(warm, way)
        return at, _Error(shift, twist)
    without, _ = _gravity(arm, q, np.zeros(len(q), bool))
    order = float(rng.uniform(*orders))
    shift[:, j] = {
        "encoder_scale": lambda: x,
        "encoder_eccentricity": lambda: np.sin(x + rng.uniform(-np.pi, np.pi)),
        "gear_transmission_error": lambda: np.sin(order * x + rng.uniform(-np.pi, np.pi)),
        "joint_compliance": lambda: torque[:, j],
        "payload_deflection": lambda: torque[:, j] - without[:, j],
        "reversal_hysteresis": lambda: np.sign(x - before[:, j]),
        "backlash": lambda: np.sign(torque[:, j]),
        "random_play": lambda: rng.uniform(-1.0, 1.0, len(q)),
    }[effect]()
    return at, _Error(shift, twist, order)


def _axis(arm: Arm, j: int) -> np.ndarray:
    """Axis of a revolute joint in its own frame."""
    data = arm.robot.createData()
    q = np.zeros(arm.robot.nq)
    pin.computeJointJacobians(arm.robot, data, q)
    return pin.getJointJacobian(arm.robot, data, j + 1, pin.LOCAL)[3:, j]


def _way(arm: Arm, j: int) -> np.ndarray:
    return arm.robot.jointPlacements[j + 1].translation


def _gravity(arm: Arm, q: np.ndarray, loaded: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Torque with which gravity pulls about each axis (postures, joints), and its moment in the joint frames, N m."""
    heavy = arm.robot.copy()
    tool = heavy.frames[heavy.getFrameId(arm.tool)]
    mass, com = LOAD
    extra = pin.Inertia(mass, tool.placement.act(np.array(com)), np.zeros((3, 3)))
    heavy.inertias[tool.parentJoint] += extra
    torque, moment = np.zeros_like(q), np.zeros((*q.shape, 3))
    for k, x in enumerate(q):
        robot = heavy if loaded[k] else arm.robot
        data = robot.createData()
        zero = np.zeros(robot.nv)
        torque[k] = -pin.rnea(robot, data, x, zero, zero)
        moment[k] = [-np.array(data.f[j + 1].angular) for j in range(q.shape[1])]
    return torque, moment


def _poses(arm: Arm, q: np.ndarray, built: np.ndarray, error: _Error) -> list[pin.SE3]:
    """Poses of the tool frame in the base frame."""
    robot = arm.robot.copy()
    nominal = [pin.SE3(placement) for placement in arm.robot.jointPlacements]
    base, tool, data = robot.getFrameId(arm.base), robot.getFrameId(arm.tool), robot.createData()
    found = []
    for k, x in enumerate(q):
        for j in range(len(built)):
            robot.jointPlacements[j + 1] = nominal[j + 1] * _twist_pose(built[j]) * _twist_pose(error.twist[k, j])
        pin.framesForwardKinematics(robot, data, x + error.shift[k])
        found.append(data.oMf[base].actInv(data.oMf[tool]))
    return found


def _points(poses: list[pin.SE3]) -> np.ndarray:
    return np.array([[pose.act(marker) for marker in MARKERS] for pose in poses])


def as_seen(poses: list[pin.SE3], rng: np.random.Generator) -> np.ndarray:
    """Poses (postures, 4, 4) with the noise of the device."""
    noisy = (p * pin.SE3(pin.exp3(TURN * rng.normal(size=3)), np.zeros(3)) for p in poses)
    found = np.array([pose.homogeneous for pose in noisy])
    found[:, :3, 3] += NOISE * rng.normal(size=(len(poses), 3))
    return found


def arguments(arm: Arm, recording: Recording, hidden: Any = None) -> dict[str, Any]:
    """Plain values of a recording, as a task or a test hands them over."""
    kind = "pose" if recording.seen.shape[1:] == (4, 4) else "position"
    load = {"frame": arm.tool, "mass": LOAD[0], "com": LOAD[1]} if recording.loaded else None
    return {"kind": kind, "values": recording.seen, "base_frame": arm.base, "tool_frame": arm.tool, "load": load}
