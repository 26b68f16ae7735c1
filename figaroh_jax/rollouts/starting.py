"""Where a search over numbers that are not linear starts: the points of an effect's grid that the data bear out.

A torque that the model lacks at a joint moves it as its servo lets it: nearly a mass on the drive's spring and damper.
What a unit of an effect would move, and what the present model leaves, are compared along the recordings; no rollout is
needed for it, and each point of a grid (the orders of a ripple, the places of a notch) costs a filter.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..effects.base import Effect, Motion, Place, changed
from ..effects.catalogue import ROLLOUTS, find
from ..rigid.kinematics import poses_on_host
from ..rigid.model import RobotModel
from .causes import Candidate
from .fit import Fit
from .loop import Loop
from .setting import Setting, Structure, residuals

__all__ = ["shown", "suggested"]

_FEW = 3  # starts of each candidate
_LOST = 1e12  # sigmas


def shown(here: Setting, c: Candidate, theta: np.ndarray) -> bool:
    """Whether the recorded motion can tell an effect with these numbers from a smooth torque (`Effect.shown_by`)."""
    if not c.kind.shapes or len(c.at) != 1 or c.at[0] not in here.loop.robot.dof_names:
        return True
    low, high = _range(here)
    effect = _effect(here.loop, c, [float(theta[k]) for k in c.entries])
    return effect.shown_by(low, high)


def suggested(here: Setting, structure: Structure, now: Fit, wanted: Sequence[Candidate]) -> list[Candidate]:
    """The candidates with the starts that explain most of what is left, `_FEW` of each; none that no motion shows."""
    many = [c for c in wanted if c.kind.shapes and len(c.starts) > _FEW and not _class_of(c).has("step")]
    if not many or here.loop.carried is not None:
        return list(wanted)
    left, weight = residuals(structure, now), np.asarray(structure.data.weight)
    if not (np.abs(left) < _LOST).all():  # the loop diverges
        return list(wanted)
    motion, servos = _motion(here, left[:, 0].shape), _servos(here.loop)
    low, high = _range(here)
    found = []
    for c in wanted:
        if c in many:
            j = here.loop.robot.dof_names.index(c.at[0])
            column = here.loop.measured.index(j)
            points = [x for x in c.starts if _effect(here.loop, c, x).shown_by(low, high)]
            if len(points) > _FEW:
                points = _best(here, servos[j], c, points, motion, left[:, column], weight[:, column])
            c = c._replace(starts=tuple(points))
        found.append(c)
    return found


def _range(here: Setting) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.zeros(here.loop.robot.nv), np.zeros(here.loop.robot.nv)
    at = list(here.loop.measured)
    low[at] = np.min([run.position.min(0) for run in here.runs], axis=0)
    high[at] = np.max([run.position.max(0) for run in here.runs], axis=0)
    return low, high


def _class_of(c: Candidate) -> type[Effect]:
    """The class of a candidate's effect."""
    return ROLLOUTS.get(c.effect) or find(c.effect)


def _effect(loop: Loop, c: Candidate, numbers: Sequence[float]) -> Effect:
    given = {name: np.float64(x) for name, x in zip(c.reported, numbers, strict=True)}
    return _class_of(c)(Place((loop.robot.dof_names.index(c.at[0]),)), **given)


def _best(
    here: Setting, servo: np.ndarray, c: Candidate, points: Sequence[tuple[float, ...]], motion: Motion,
    left: np.ndarray, weight: np.ndarray,
) -> list[tuple[float, ...]]:  # fmt: skip
    """Matching pursuit: the point that explains most of `left` (rows, windows), then that of what is left of it."""
    j = here.loop.robot.dof_names.index(c.at[0])
    q, v = motion.position[:, j], motion.velocity[:, j]
    torques = [np.ones_like(q), q, v, np.sign(v)]
    names = _class_of(c).amplitudes()
    for x in points:
        effect = _effect(here.loop, c, x)
        for name in names:
            numbers = {one: np.float64(one == name) for one in names}
            torques.append(np.asarray(changed(effect, **numbers).remembering(motion).torque(motion)).reshape(-1))
    columns = np.stack(torques, -1).reshape(*left.shape, -1)
    period = here.runs[0].time[1] - here.runs[0].time[0]
    moved = _moved(servo, columns, float(period)) * weight[..., None]
    moved = moved.reshape(-1, moved.shape[-1])
    if not moved.any(0).all():  # it follows what is not known here, as the load
        return list(points)
    base, rest = np.linalg.qr(moved[:, :4])[0], left.ravel()
    rest = rest - base @ (base.T @ rest)
    groups = [moved[:, 4 + k * len(names) : 4 + (k + 1) * len(names)] for k in range(len(points))]
    chosen: list[int] = []
    for _ in range(_FEW):
        groups = [x - base @ (base.T @ x) for x in groups]
        own = [np.linalg.qr(x)[0] for x in groups]
        gains = [-1.0 if k in chosen else float(((x.T @ rest) ** 2).sum()) for k, x in enumerate(own)]
        k = int(np.argmax(gains))
        chosen.append(k)
        base, rest = own[k], rest - own[k] @ (own[k].T @ rest)
    return [points[k] for k in chosen]


def _motion(here: Setting, shape: tuple[int, ...]) -> Motion:
    """Motion as it was measured, rows times windows of it, zero where a window is padded; its loads are not told."""
    q, v = (np.zeros((*shape, here.loop.robot.nv)) for _ in range(2))
    at = list(here.loop.measured)
    for w, one in enumerate(here.stretches):
        run = here.runs[one.run]
        mine = run.position[one.first : one.first + one.rows]
        q[: len(mine), w, at] = mine
        v[: len(mine), w, at] = np.gradient(mine, run.time[1] - run.time[0], axis=0) if len(mine) > 1 else 0.0
    n = here.loop.robot.nv
    q, v = q.reshape(-1, n), v.reshape(-1, n)
    zero = np.zeros_like(q)
    return Motion(here.loop.robot, np.zeros(len(q)), q, v, zero, zero, zero, 0.0, np.zeros(n))


def _servos(loop: Loop) -> np.ndarray:
    """Mass, damper and spring of each joint with its drive, (nv, 3): kg m2, N m s/rad, N m/rad."""
    masses = _masses(loop.robot, np.asarray(loop.start, float))
    way, bias = np.asarray(loop.drives.transmission), np.asarray(loop.drives.bias)
    joints = loop.joints
    spring = -(way**2 * (np.asarray(loop.drives.scale) * bias[:, 1])[:, None]).sum(0) + np.asarray(joints.stiffness)
    damper = -(way**2 * bias[:, 2][:, None]).sum(0) + np.asarray(joints.damping)
    rotors = masses + np.asarray(joints.armature)
    return np.stack([rotors, np.maximum(damper, 0.0), np.maximum(spring, 0.0)], 1)  # a loop that diverges tells nothing


def _masses(robot: RobotModel, q: np.ndarray) -> np.ndarray:
    """Inertia about each joint's axis of all that it carries, (nv,), at a configuration: kg m2 or kg."""
    poses, ten, found = poses_on_host(robot, q[None])[0], np.asarray(robot.inertia), np.zeros(robot.nv)
    for j, joint in enumerate(robot.joints):
        axis = poses[j, :3, :3] @ np.asarray(robot.axis)[j]
        for i in range(j, len(robot.joints)):
            up = i
            while up > j:
                up = robot.joints[up].parent
            if up != j:
                continue
            m, h, turn = ten[i, 0], ten[i, 1:4], poses[i, :3, :3]
            xx, xy, yy, xz, yz, zz = ten[i, 4:]
            own = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            a, d = turn.T @ axis, turn.T @ (poses[j, :3, 3] - poses[i, :3, 3])
            about = own + (m * (d @ d) - 2 * (h @ d)) * np.eye(3) - m * np.outer(d, d) + np.outer(h, d) + np.outer(d, h)
            found[joint.coordinate] += m if joint.kind == "prismatic" else a @ about @ a
    return found


def _moved(servo: np.ndarray, torque: np.ndarray, dt: float) -> np.ndarray:
    """How a servo moves under torques (rows, windows, columns) against it, rad or m: implicit Euler, at any period."""
    mass, damper, spring = servo
    x, rate, found = np.zeros(torque.shape[1:]), np.zeros(torque.shape[1:]), np.zeros_like(torque)
    for k in range(len(torque)):
        found[k] = x
        rate = (mass * rate - dt * (spring * x + torque[k])) / (mass + dt * damper + dt**2 * spring)
        x = x + dt * rate
    return found
