"""Analytic motion: Fourier series around a posture, as an excitation is, and the small errors of tracking it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

PERIOD = 10.0  # s
HARMONICS = 5
TRACKING = 3e-4  # rad or m, RMS of a repeat's error


@dataclass(frozen=True)
class Motion:
    """q(t) = centre + sum_k sine_k sin(w_k t) + cosine_k cos(w_k t), for all t."""

    centre: np.ndarray  # (nv,)
    omega: np.ndarray  # (terms,) rad/s
    sine: np.ndarray  # (terms, nv)
    cosine: np.ndarray

    def at(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity, acceleration at `time`, each (samples, nv)."""
        angle = np.outer(time, self.omega)
        sin, cos = np.sin(angle), np.cos(angle)
        q = self.centre + sin @ self.sine + cos @ self.cosine
        v = (cos * self.omega) @ self.sine - (sin * self.omega) @ self.cosine
        a = -(sin * self.omega**2) @ self.sine - (cos * self.omega**2) @ self.cosine
        return q, v, a


def excitation(
    model: pin.Model, rng: np.random.Generator, amplitude: float = 1.3, speed: float = 3.0, harmonics: int = HARMONICS
) -> Motion:
    """Random periodic motion inside the joint limits, at most `amplitude` (rad) and `speed` (rad/s) at every joint."""
    lower = np.maximum(model.lowerPositionLimit, -np.pi)
    upper = np.minimum(model.upperPositionLimit, np.pi)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    centre = middle + 0.1 * half * rng.uniform(-1, 1, model.nv)
    order = np.arange(1, harmonics + 1)
    weights = rng.standard_normal((2, harmonics, model.nv)) / np.sqrt(order)[None, :, None]
    motion = Motion(centre, 2 * np.pi * order / PERIOD, *weights)
    q, v, _ = motion.at(np.linspace(0, PERIOD, 1001))
    room = np.minimum(amplitude, 0.85 * half)
    scale = np.minimum(room / np.abs(q - centre).max(0), np.minimum(speed, model.velocityLimit) / np.abs(v).max(0))
    return replace(motion, sine=motion.sine * scale, cosine=motion.cosine * scale)


def tracked(motion: Motion, rng: np.random.Generator, error: float = TRACKING) -> Motion:
    """The motion as one run really follows it: a smooth error of RMS `error`, another one each time."""
    omega = 2 * np.pi * rng.uniform(0.2, 2.0, 6)
    wobble = error / np.sqrt(len(omega)) * rng.standard_normal((2, len(omega), motion.centre.size))
    return Motion(
        motion.centre,
        np.concatenate([motion.omega, omega]),
        np.concatenate([motion.sine, wobble[0]]),
        np.concatenate([motion.cosine, wobble[1]]),
    )
