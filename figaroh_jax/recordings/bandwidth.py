"""How fast a joint really moves, and its position smoothed no faster than that.

Above some frequency a recorded position holds nothing but the noise and the steps of its encoder, which two
derivatives make large. Left in the regressor, that noise stands in the residual and in every candidate's column at
once, and clean data look as if they had a cause (errors in variables). So the band of each joint is chosen where the
acceleration is in error least: by what the smoothing takes off the motion and by what it leaves of the noise.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

__all__ = ["motion_band", "smoothed"]

ORDER = 3  # of the differences that smoothing holds small: gain 1 / (1 + (f / band)^(2 ORDER))
STEPS = 2.0 ** (-np.arange(13) / 2)  # bands tried, as shares of the cutoff
WINDOW = 14.0  # Kaiser: what the motion leaks stays 100 dB below it
CHANCE = 12.0  # times its mean: power that noise reaches at one frequency in a hundred thousand
WORTH = 0.5  # share of the error in the acceleration at the cutoff below which a smaller band is taken
FEWEST = 200  # samples from which a spectrum tells motion and noise apart


def motion_band(position: Float[np.ndarray, " samples"], dt: float, cutoff: float) -> float:
    """Frequency (Hz, at most `cutoff`) up to which a position (rad or m, every `dt` s) holds more motion than noise.

    The noise is taken as white in the position, at its level between one and two and a half times the cutoff.
    """
    if len(position) < FEWEST:
        return cutoff
    frequency, power = _position_spectrum(position, dt)
    high = (frequency > cutoff) & (frequency < 2.5 * cutoff)
    if not high.any():
        return cutoff
    noise = float(power[high].mean())
    low = (frequency > 0) & (frequency < 2 * cutoff)
    weight, motion = frequency[low] ** 4, np.where(power[low] > CHANCE * noise, power[low] - noise, 0.0)
    gain = 1 / (1 + (frequency[low] / (cutoff * STEPS[:, None])) ** (2 * ORDER))
    error = ((1 - gain) ** 2 * motion + gain**2 * noise) @ weight
    best = int(np.argmin(error))
    return float(cutoff * STEPS[best]) if error[best] < WORTH * error[0] else cutoff


def smoothed(position: Float[np.ndarray, " samples"], dt: float, band: float) -> Float[np.ndarray, " samples"]:
    """The position nearest to the one given whose third differences are held small, with gain 1/2 at `band` (Hz).

    min |x - q|^2 + |D^3 x|^2 / (2 sin(pi band dt))^6 (Whittaker 1923): without phase, and free at both ends, where a
    filter would have to invent samples.
    """
    from scipy.linalg import solveh_banded  # scipy is slow to import

    count, strength = len(position), (2 * np.sin(np.pi * band * dt)) ** (-2 * ORDER)
    stencil = np.array([-1.0, 3.0, -3.0, 1.0])
    banded = np.zeros((ORDER + 1, count))
    for k in range(ORDER + 1):  # k-th lower diagonal of D'D
        for row in range(ORDER + 1 - k):
            banded[k, row : count - ORDER + row] += strength * stencil[row] * stencil[row + k]
    banded[0] += 1.0
    middle = position.mean()  # keeps the rounding of the solution that of the motion
    return middle + solveh_banded(banded, position - middle, lower=True)


def _position_spectrum(position: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies and power of the position, from its second differences (which leak less)."""
    second = np.diff(position, 2)
    window = np.kaiser(len(second), WINDOW)
    power = np.abs(np.fft.rfft((second - second.mean()) * window)) ** 2 / (window**2).sum()
    frequency = np.fft.rfftfreq(len(second), dt)
    power[1:] /= (2 * np.sin(np.pi * frequency[1:] * dt)) ** 4
    return frequency, power
