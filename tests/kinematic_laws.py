"""Kinematic effects hidden in postures: what each does to the joints, by its own equation, with Pinocchio's gravity."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import poses

Error = np.ndarray  # (postures, 6), rad: true position minus what the encoder says


def laws(path: Path, q: np.ndarray, joint: int) -> dict[str, tuple[tuple[str, ...], Error]]:
    """By effect: where it acts and a unit of it at the joint (or joints), for postures in the order measured."""
    robot = pin.buildModelFromUrdf(str(path))
    data = robot.createData()
    gravity = -np.array([pin.computeGeneralizedGravity(robot, data, x) for x in q])
    before = np.vstack([q[:1], q[:-1]])
    name, x = poses.JOINTS[joint], q[:, joint]
    column = np.eye(6)[joint]
    at = {
        "encoder_scale": x,
        "encoder_eccentricity": np.sin(x + 0.6),
        "gear_transmission_error": np.sin(5.0 * x + 0.4),
        "joint_compliance": gravity[:, joint],
        "reversal_hysteresis": np.sign(x - before[:, joint]),
        "backlash": np.sign(gravity[:, joint]),
    }
    found: dict[str, tuple[tuple[str, ...], Error]] = {
        effect: ((name,), unit[:, None] * column) for effect, unit in at.items()
    }
    found["settling"] = ((), before - q)
    found["joint_coupling"] = ((poses.JOINTS[joint - 1], name), q[:, joint - 1 : joint] * column)
    return found


def hide(
    path: Path, rng: np.random.Generator, real: poses.Truth, error: Callable[[np.ndarray], Error], count: int = 80
):
    """Postures and noisy points (0.05 mm) of a robot whose joints err."""
    q = poses.postures(rng, count)
    wrong = error(q)
    found = poses.tool_poses(path, q, real, lambda k: wrong[k])
    return q, poses.points(found, real, rng, noise=5e-5)


def scaled(unit: Error, size: float) -> Error:
    """The error with `size` (rad) as its RMS over postures, summed over the joints."""
    return unit * size / np.sqrt(np.mean(np.sum((unit - unit.mean(axis=0)) ** 2, axis=1)))
