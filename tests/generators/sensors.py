"""What sensors add: torque noise of several colours, encoder noise and steps."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

RATE = 250.0  # Hz, of the recordings
COLOURS = ("white", "ar20", "ar100", "pink")


def torque_noise(samples: int, rms: np.ndarray, rng: np.random.Generator, colour: str, scale: float) -> np.ndarray:
    """Noise (samples, nv): 2 % of `rms` white, and 1 % coloured (`ar20`, `ar100`: AR(1) of 20, 100 ms; `pink`: 1/f)."""
    white = 0.02 * rng.standard_normal((samples, rms.size))
    if colour == "white":
        return scale * rms * white
    draw = rng.standard_normal((samples + 2000, rms.size))
    coloured = _pink(draw) if colour == "pink" else _autoregressive(draw, {"ar20": 0.02, "ar100": 0.1}[colour])
    return scale * rms * (white + 0.01 * coloured[2000:])


def encoder(position: np.ndarray, rng: np.random.Generator, scale: float, step: float) -> np.ndarray:
    """Position as an encoder reads it: white noise of 2e-5 rad, then steps of `step` (0: none)."""
    noisy = position + 2e-5 * scale * rng.standard_normal(position.shape)
    return np.round(noisy / step) * step if step > 0 else noisy


def _autoregressive(draw: np.ndarray, time: float) -> np.ndarray:
    """AR(1) of unit variance with the given correlation time, s."""
    phi = np.exp(-1 / (RATE * time))
    return np.asarray(lfilter([np.sqrt(1 - phi**2)], [1, -phi], draw, axis=0))


def _pink(draw: np.ndarray) -> np.ndarray:
    """Noise of power 1/f above .05 Hz, of unit variance."""
    f = np.fft.rfftfreq(len(draw), 1 / RATE)
    shaped = np.fft.irfft(np.fft.rfft(draw, axis=0) / np.sqrt(np.maximum(f, 0.05))[:, None], len(draw), axis=0)
    return shaped / shaped.std(0)
