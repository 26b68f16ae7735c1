"""How much of a hidden effect the data hold at all: its exact torque, projected on all that the baseline can take.

No code of the library and no answer of a tool goes in. Columns: ten parameters of each link (Pinocchio's, with the
prior about the nominal ones that the task states), viscous and Coulomb friction of each joint, along the motion. Rows
are Fourier coefficients of each recording up to the task's cutoff, each over the standard deviation that the sensors'
noise has there: that of the torque by its colour, that of the encoder through the robot's mean mass matrix. D is the
length of what is left, in these: the t-value that the effect's size has for one who knows all else of it. The misfit
is what is left in the joints' own unit, over their RMS torque: below the task's tolerance `nothing` is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
from generators import inverse, robots, scene, sensors
from generators.motion import Motion

Array = np.ndarray
RATE = sensors.RATE
SEEN = 5.0  # least D of an effect that the data hold; below it, no search among many could tell it from chance
TOLERANCE = 0.01  # of a joint's RMS torque: the tasks', which state none
WEAK = 1e-12  # precision of what nothing is known of
POSITION = 2e-5  # rad, the encoder's noise


class Seen(NamedTuple):
    """How much of an effect is out of reach of the baseline."""

    left: float  # share of its weighted power
    sigmas: float  # D: square root of what is left, in noise sigmas
    misfit: float  # RMS of what is left over that of the joint's torque, where it is largest


class Noise(NamedTuple):
    """What the sensors of a case add."""

    scale: float
    colour: str
    step: float  # rad, of the encoder


def seen(drawn: inverse.Drawn, repeats: int, noise: Noise, cutoff: float) -> Seen:
    """Of all hidden effects together."""
    robot, model, fit = drawn.robot, drawn.model, drawn.fit
    pairs: list[Array] = [sum(scene.induced(robot, model, m, drawn.time, h)[0] for h in drawn.hidden) for m in fit]  # type: ignore[misc]
    without = [scene.induced(robot, model, m, drawn.time, drawn.hidden[0])[1] for m in fit]
    rms = np.sqrt(np.mean(np.concatenate(without) ** 2, 0))
    deviation = _deviation(robot, fit, rms, noise, len(_thin(pairs[0])), cutoff)
    z = [_rows(_thin(added)[:, :, None], deviation)[:, 0] for added in pairs]
    X = [_rows(_columns(robot, motion, drawn.time), deviation) for motion in fit]
    take, square = (repeats * sum(x.T @ y for x, y in zip(a, z, strict=True)) for a in (X, z))
    gram = repeats * sum(x.T @ x for x in X) + np.diag(_precision(robot, 0.02 if drawn.trusted else 0.10))
    taken = np.linalg.solve(gram, take)
    left = max(float(square - take @ taken), 0.0)
    each = [(y - x @ taken).reshape(-1, len(rms)) for x, y in zip(X, z, strict=True)]
    back = np.concatenate([deviation, deviation[1:]])  # to N m: of the real, then of the imaginary parts
    power = np.mean([((one * back) ** 2 * np.where(np.arange(len(one)) > 0, 2, 1)[:, None]).sum(0) for one in each], 0)
    misfit = np.sqrt(power) / len(_thin(pairs[0])) / rms
    return Seen(left / float(square), float(np.sqrt(left)), float(misfit.max()))


def told(one: Seen) -> dict[str, Any]:
    """As it stands in `cases.json`."""
    shown = one.sigmas >= SEEN and one.misfit >= TOLERANCE
    return {"left": one.left, "sigmas": one.sigmas, "misfit": one.misfit, "visible": shown}


def _thin(x: Array) -> Array:
    """Means of four samples at 1 kHz, as the recordings have them."""
    rows = len(x) // inverse.AVERAGED
    return x[: rows * inverse.AVERAGED].reshape(rows, inverse.AVERAGED, *x.shape[1:]).mean(1)


def _columns(robot: robots.Robot, motion: Motion, time: Array) -> Array:
    """(samples, joints, parameters) of the nominal baseline: the regressor needs no parameters."""
    inside = time[(time >= 0) & (time < time[-1] - 5 * scene.STEP)]
    stamps = _thin(inside)
    q, v, a = motion.at(stamps)
    data, nv = robot.model.createData(), robot.model.nv
    links = np.stack([pin.computeJointTorqueRegressor(robot.model, data, *row).copy() for row in zip(q, v, a)])  # noqa: B905
    sign = _thin(np.sign(motion.at(inside)[1]))
    return np.concatenate([links, *(x[:, :, None] * np.eye(nv) for x in (v, sign))], 2)


def _rows(x: Array, deviation: Array) -> Array:
    """(samples, joints, k) as Fourier coefficients in the noise's deviations: (coefficients * joints, k)."""
    f = np.fft.rfft(x, axis=0)[: len(deviation)] / deviation[:, :, None]
    return np.concatenate([f.real, f.imag[1:]]).reshape(-1, x.shape[2])


def _deviation(
    robot: robots.Robot, fit: Sequence[Motion], rms: Array, noise: Noise, samples: int, cutoff: float
) -> Array:
    """(frequencies, joints) of the real and of the imaginary part of the noise's Fourier coefficients."""
    frequency = np.fft.rfftfreq(samples, 1 / RATE)
    density = 0.02**2 + 0.01**2 * _density(noise.colour, frequency, samples) if noise.colour != "white" else 0.02**2
    torque = (noise.scale * rms) ** 2 * np.broadcast_to(density, frequency.shape)[:, None]
    position = (POSITION * noise.scale) ** 2 + noise.step**2 / 12
    data = robot.model.createData()
    postures = np.concatenate([m.at(np.linspace(0, 10, 40))[0] for m in fit])
    mass = np.stack([np.triu(m) + np.triu(m, 1).T for m in (pin.crba(robot.model, data, q).copy() for q in postures)])
    felt = np.mean((mass**2).sum(2), 0)
    power = torque + position * (2 * np.pi * frequency[:, None]) ** 4 * felt
    half = np.where(frequency > 0, 0.5, 1.0)[:, None]
    return np.sqrt(samples * power * half)[frequency <= cutoff]


def _density(colour: str, frequency: Array, samples: int) -> Array:
    """Power of noise of unit variance at each frequency, over that of white noise."""
    if colour == "pink":
        every = np.abs(np.fft.fftfreq(samples, 1 / RATE))
        return 1 / np.maximum(frequency, 0.05) / np.mean(1 / np.maximum(every, 0.05))
    phi = np.exp(-1 / (RATE * {"ar20": 0.02, "ar100": 0.1}[colour]))
    return (1 - phi**2) / np.abs(1 - phi * np.exp(-2j * np.pi * frequency / RATE)) ** 2


def _precision(robot: robots.Robot, trust: float) -> Array:
    """Of each parameter: nominal links within `trust`; nothing is known of friction."""
    out = np.full(12 * robot.model.nv, WEAK)
    for j in range(robot.model.nv):
        body = robot.model.inertias[j + 1]
        mass, length = body.mass, max(0.05, float(np.linalg.norm(body.lever)))
        width = np.trace(body.inertia) / 3 + 0.3 * mass * length**2
        sigma = trust * np.array([mass, *[mass * length] * 3, *[width] * 6])
        out[10 * j : 10 * j + 10] = 1 / np.maximum(sigma, 1e-6) ** 2
    return out
