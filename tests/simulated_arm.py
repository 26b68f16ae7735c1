"""Recordings of an arm with known parameters, made by Pinocchio: the tests' truth shares no code with the library."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pinocchio as pin
import tasks
from scipy import signal

import figaroh_jax as fj
from figaroh_jax.recordings.dataset import Recording

RATE = 200.0  # Hz
VISCOUS, COULOMB = np.array([1.5, 0.8, 20.0]), np.array([2.0, 1.0, 5.0])
TORQUE_NOISE = np.array([0.3, 0.15, 0.5])


@dataclass(frozen=True)
class Truth:
    """The robot as its file says it, the robot as it is, and the parameters of the latter in the library's order."""

    file: Path
    nominal: fj.RobotModel
    model: Any
    theta: np.ndarray  # ten of each link, viscous and Coulomb friction of each joint


def arm(folder: Path, spread: float = 0.1, seed: int = 0, text: str = tasks.URDF) -> Truth:
    """Links heavier or lighter, longer or shorter than the file says, by `spread`; each of them a body."""
    file = folder / "robot.urdf"
    file.write_text(text)
    model = pin.buildModelFromXML(text)
    generator = np.random.default_rng(seed)
    for k in range(1, model.njoints):
        body = model.inertias[k]
        mass, lever = (float(body.mass * (1 + spread * generator.normal())), body.lever)
        turn = body.inertia * (1 + spread * generator.normal())
        model.inertias[k] = pin.Inertia(mass, lever + spread * 0.05 * generator.normal(size=3), turn)
    ten = np.concatenate([model.inertias[k].toDynamicParameters() for k in range(1, model.njoints)])
    nv = model.nv
    return Truth(file, fj.load_urdf(file), model, np.concatenate([ten, VISCOUS[:nv], COULOMB[:nv]]))


def recording(
    truth: Truth,
    seconds: float = 20.0,
    seed: int = 0,
    *,
    noise: Literal["white", "coloured", "none"] = "white",
    role: Literal["fit", "holdout"] = "fit",
    name: str = "run",
    payload: tuple[float, np.ndarray] | None = None,
    moving: tuple[bool, ...] = (True, True, True),
) -> Recording:
    """A rich motion of the `moving` joints; `coloured` noise has a correlation time of 0.1 s and the same deviation."""
    generator = np.random.default_rng(seed)
    t, nv = np.arange(int(seconds * RATE)) / RATE, truth.model.nv
    frequency = generator.uniform(0.1, 1.0, (5, nv))
    phase = generator.uniform(0, 2 * np.pi, (5, nv))
    amplitude = generator.uniform(0.1, 0.35, (5, nv)) * np.array([1, 1, 0.15])[:nv] * np.array(moving)[:nv]
    angle = 2 * np.pi * frequency * t[:, None, None] + phase
    w = 2 * np.pi * frequency
    q = (amplitude * np.sin(angle)).sum(1) + np.array([0.1, -0.2, 0.25])[:nv]
    v, a = (amplitude * w * np.cos(angle)).sum(1), -(amplitude * w**2 * np.sin(angle)).sum(1)
    model = truth.model
    if payload is not None:
        model = model.copy()
        mass, place = payload
        model.inertias[3] = model.inertias[3] + pin.Inertia(mass, place, np.zeros((3, 3)))
    data = model.createData()
    tau = np.array([pin.rnea(model, data, *s) for s in zip(q, v, a, strict=True)])
    tau += VISCOUS[:nv] * v + COULOMB[:nv] * np.sign(v) + _noise(noise, generator, tau.shape)
    joints = tuple(truth.nominal.joint_names)
    return Recording(name, Path(f"{name}.npz"), joints, t, q, None, tau, None, None, None, role)


def _noise(kind: str, generator: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    white = generator.normal(size=shape) * TORQUE_NOISE[: shape[1]]
    if kind == "none":
        return 0 * white
    if kind == "white":
        return white
    decay = np.exp(-1 / (0.1 * RATE))
    return np.asarray(signal.lfilter([np.sqrt(1 - decay**2)], [1.0, -decay], white, axis=0))
