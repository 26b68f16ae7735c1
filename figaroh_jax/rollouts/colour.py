"""The colour of an encoder's noise, told from what a model leaves: white noise behind a first-order low pass.

Noise is told from a misfit by its whole spectrum: up to the corner it is flat, beyond it falls, all in two numbers, and
its power is that of the record's own fourth differences. A misfit follows the motion: it stands above such a spectrum
where the motion is, or comes in bursts. The two numbers maximise Whittle's likelihood (P. Whittle, "Estimation and
information in stationary time series", Arkiv foer Matematik 2, 1953).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize_scalar
from scipy.special import chdtrc, ndtri

from .thresholds import BURST, BURST_ROWS, COLOUR, LEAST_OF_A_BAND, LOUDER, LOWEST_CORNER, SHORTEST

__all__ = ["Colour", "colour_of", "filtered"]

_BANDS = np.array([0.0, 0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.5])  # of the sampling rate
_MANY = 2001  # frequencies of an integral


class Colour(NamedTuple):
    """White noise behind a first-order low pass, x_k = pole x_{k-1} + a white number."""

    pole: Float[np.ndarray, " ny"]
    level: Float[np.ndarray, " ny"]  # standard deviation of the white number over that of `data.noise_of`


def colour_of(
    error: Float[np.ndarray, "rows ny windows"],
    counted: Bool[np.ndarray, "rows ny windows"],
    most: tuple[float, float] = (COLOUR, BURST),
) -> Colour | None:
    """The colour of residuals in units of `data.noise_of`, or None where one of them is no such noise.

    `most` are the sigmas by which octaves with levels of their own may be likelier, and power may come in bursts.
    """
    found = [_colour(list(_stretches(error[:, y], counted[:, y])), most) for y in range(error.shape[1])]
    if any(one is None for one in found):
        return None
    both = np.array([one for one in found if one is not None])
    return Colour(both[:, 0], both[:, 1])


def filtered(
    error: Float[np.ndarray, "rows ny windows"],
    counted: Bool[np.ndarray, "rows ny windows"],
    pole: Float[np.ndarray, "ny windows"] | None,
) -> Float[np.ndarray, "rows ny windows"]:
    """What each row tells beyond the row before it; where that does not count, the row alone."""
    if pole is None:
        return error
    past, had = np.zeros_like(error), np.zeros_like(counted)
    past[1:], had[1:] = error[:-1], counted[:-1]
    return np.where(had, error - pole * past, np.sqrt(1 - pole**2) * error) * counted


def _stretches(error: np.ndarray, counted: np.ndarray) -> Iterator[np.ndarray]:
    """Rows one after the other that all count."""
    for w in range(error.shape[1]):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], counted[:, w].astype(int), [0]])))
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            if last - first >= SHORTEST:
                yield error[first:last, w]


def _colour(stretches: list[np.ndarray], most: tuple[float, float]) -> tuple[float, float] | None:
    """The pole and the level of the noise of one encoder, or None where its residual is no such noise."""
    if not stretches:
        return None
    spectra = [_periodogram(x) for x in stretches]
    frequency, power = (np.concatenate([one[k] for one in spectra]) for k in (0, 1))

    def unlikely(pole: float) -> float:
        shape = _shape(frequency, pole)
        return float(np.log((power / shape).mean()) + np.log(shape).mean())

    pole = float(minimize_scalar(unlikely, bounds=(0.0, 1.0 - 1e-3), method="bounded").x)  # pyright: ignore[reportAttributeAccessIssue]
    level, rows = (power / _shape(frequency, pole)).mean(), sum(map(len, stretches))
    loud = level / _level(pole) ** 2
    corner = -np.log(max(pole, 1e-9)) / (2 * np.pi)
    if corner < LOWEST_CORNER or loud > 1 + LOUDER * np.sqrt(6 / rows):
        return None
    ratio = power / (level * _shape(frequency, pole))
    if _beyond_bands(frequency, ratio) > most[0] or _in_bursts(stretches, pole) > most[1]:
        return None
    return pole, float(np.sqrt(level))


def _periodogram(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    frequency = np.fft.rfftfreq(len(x))[1:]
    power = np.abs(np.fft.rfft(x)[1:]) ** 2 / len(x)
    inside = frequency < 0.5
    return frequency[inside], power[inside]


def _shape(frequency: np.ndarray, pole: float) -> np.ndarray:
    """Spectrum of the low pass of white noise of variance 1."""
    return 1 / np.abs(1 - pole * np.exp(-2j * np.pi * frequency)) ** 2


def _level(pole: float) -> float:
    """Standard deviation of the white number of which fourth differences make one."""
    frequency = np.linspace(0.0, 0.5, _MANY)
    fourth = np.abs(1 - np.exp(-2j * np.pi * frequency)) ** 8 / 70
    return float(1 / np.sqrt(np.mean(fourth * _shape(frequency, pole))))


def _beyond_bands(frequency: np.ndarray, ratio: np.ndarray) -> float:
    """Sigmas by which octaves with levels of their own are likelier than the low pass."""
    which = np.digitize(frequency, _BANDS) - 1
    count = np.bincount(which, minlength=len(_BANDS))
    mean = np.bincount(which, ratio, minlength=len(_BANDS)) / np.maximum(count, 1)
    kept = count >= LEAST_OF_A_BAND
    gained = 2 * float((count[kept] * (mean[kept] - 1 - np.log(mean[kept]))).sum())
    return -float(ndtri(max(chdtrc(max(kept.sum() - 2, 1), gained), 1e-300)))


def _in_bursts(stretches: list[np.ndarray], pole: float) -> float:
    """Sigmas by which the power of groups of rows varies more than that of noise that is always the same."""
    groups = []
    for x in stretches:
        white = x[1:] - pole * x[:-1]
        rows = len(white) // BURST_ROWS * BURST_ROWS
        groups.append((white[:rows].reshape(-1, BURST_ROWS) ** 2).sum(1))
    power = np.concatenate(groups)
    if len(power) < 2:
        return 0.0
    wide = power.var(ddof=1) / power.mean() ** 2 * BURST_ROWS / 2
    return float((wide - 1) / np.sqrt((2 + 12 / BURST_ROWS) / len(power)))
