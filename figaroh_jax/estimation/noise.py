"""The noise of the torque rows: its spectrum per joint, from something that is not the baseline's residual.

With repeats the noise is half the difference of two repeats; without, the residual of the richest model, corrected at
each frequency for what that model has fitted. A smooth log spectrum is fitted by a gamma GLM (Whittle likelihood) and
inverted into the whitening response that every row and every column then passes. Powers are per row: white noise of
variance s^2 has the spectrum s^2 at all frequencies.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped
from numpy.polynomial import Legendre

__all__ = [
    "PASSED",
    "Spectrum",
    "fit_spectrum",
    "leverage",
    "periodogram",
    "seen_through",
    "spectral_line",
    "white",
    "whitening",
]

FLOOR = 0.05  # of the median power between 1 Hz and the cutoff: bounds what whitening amplifies
PASSED = 0.1  # power gain of the row filter: where it passes less, what leaks from elsewhere is as large as the noise
LEVEL = 16  # independent bins whose mean is as certain as the median of 41 bins of a Hann periodogram
LOWEST = 0.3  # Hz: below, the spectrum follows a power of the frequency alone
SHIFT = 0.05  # Hz, added to the frequency of that power: noise levels off, and its power at 0 is finite
STEEPEST = 1.0  # power of 1/f to which noise is expected to rise below what a fit has seen
NEIGHBOURS = 1 + 2 * (4 / 9 + 1 / 36)  # bins of a Hann periodogram that tell as much as one: squared correlations
SMOOTHNESS = 10.0 ** np.arange(-3, 3.1)  # weights of the bending that are compared: rough to straight
ALIKE = 10.0 ** np.arange(-1, 4.1)  # the same of a joint's distance from the others: squared in log S, over its mean
_POLYNOMIALS = [Legendre.basis(k) for k in range(2, 6)]


class Spectrum(NamedTuple):
    """Power of the noise of each joint before the row filter: log S = basis(f) @ coefficients."""

    coefficients: Float[np.ndarray, "terms nv"]
    covariance: Float[np.ndarray, "nv terms terms"]
    nyquist: float  # Hz, of the rows
    lowest: float = 0.0  # Hz: below, the power that rows are weighted by is held constant
    known: float = 0.0  # Hz: the lowest frequency that the fit has seen

    def power(self, frequency: Float[np.ndarray, " freqs"]) -> Float[np.ndarray, "freqs nv"]:
        """Power at `frequency` (Hz), N^2 m^2 or N^2 a row; constant beyond what the rows resolve, at both ends."""
        return np.exp(_basis(np.clip(frequency, self.lowest, self.nyquist), self.nyquist) @ self.coefficients)

    def drawn(
        self, frequency: Float[np.ndarray, " freqs"], draws: int, generator: np.random.Generator
    ) -> Float[np.ndarray, "draws freqs nv"]:
        """Powers that the data leave possible: the coefficients drawn from their covariance, each joint for itself.

        Below `lowest` too, as far as it is known: there the noise may be larger, though rows are weighted as if it were
        not.
        """
        terms, count = self.coefficients.shape
        if not self.covariance.any():
            return np.broadcast_to(self.power(frequency), (draws, len(frequency), count))
        low = np.linalg.cholesky(self.covariance + 1e-12 * np.eye(terms))
        off = np.einsum("jab,djb->daj", low, generator.standard_normal((draws, count, terms)))
        basis = _basis(np.clip(frequency, self.known, self.nyquist), self.nyquist)
        return np.exp(basis @ (self.coefficients + off))

    def at_most(self, rms: Float[np.ndarray, " nv"], most: Float[np.ndarray, " nv"]) -> Spectrum:
        """The spectrum, which has `rms` in the rows of each joint, with no more than `most` in them."""
        lower = 2 * np.log(np.minimum(1.0, most / np.maximum(rms, 1e-300)))
        return self._replace(coefficients=self.coefficients + np.outer(np.arange(len(self.coefficients)) == 0, lower))

    def rise(self, frequency: Float[np.ndarray, " freqs"]) -> Float[np.ndarray, "freqs nv"]:
        """Power that noise is expected to have, over what `drawn` gives it; 1 but below `known`.

        There the fitted curve goes on, though no lower than at `known`, and no steeper than 1/f (`STEEPEST`): what is
        steeper may be a misfit, and the noise of a torque sensor does not fall towards 0.
        """
        below = np.minimum(frequency, self.known)
        curve = (_basis(below, self.nyquist) - _basis(np.array([self.known]), self.nyquist)) @ self.coefficients
        most = STEEPEST * np.log((self.known + SHIFT) / (below + SHIFT))
        return np.exp(np.clip(curve, 0.0, most[:, None]))


def periodogram(
    rows: Float[np.ndarray, "samples *series"], rate: float, level: bool = False
) -> tuple[Float[np.ndarray, " freqs"], Float[np.ndarray, "freqs *series"]]:
    """Frequencies (Hz) and Hann periodogram of a series, scaled so that white noise gives its variance.

    Without its mean and the frequency 0, or with both (`level`).
    """
    count = rows.shape[0]
    window = np.hanning(count + 2)[1:-1].reshape(-1, *[1] * (rows.ndim - 1))
    spectrum = np.fft.rfft((rows if level else rows - rows.mean(0)) * window, axis=0)
    power, first = np.abs(spectrum) ** 2 / (window**2).sum(), 0 if level else 1
    return np.fft.rfftfreq(count, 1 / rate)[first:], power[first:]


def seen_through(
    mask: Bool[np.ndarray, "samples nv"],
    rate: float,
    frequency: Float[np.ndarray, " freqs"],
    power: Float[np.ndarray, "freqs nv"],
) -> tuple[Float[np.ndarray, " own"], Float[np.ndarray, "own nv"]]:
    """Frequencies (Hz) and the mean of the Hann periodogram of noise of this power in the rows of the mask, the others
    zero.

    The Fourier transform of the noise's covariance times the autocorrelation of window and mask: the expected
    periodogram of the debiased Whittle likelihood (Sykulski et al., Biometrika 106, 2019). Rows that are left out carry
    power from where there is much to where the row filter lets little pass.
    """
    count = len(mask)
    window = np.hanning(count + 2)[1:-1, None]
    lags = np.fft.irfft(np.abs(np.fft.rfft(window * mask, 2 * count, axis=0)) ** 2, 2 * count, axis=0)
    fine = np.fft.rfftfreq(2 * count, 1 / rate)
    own = np.stack([np.interp(fine, frequency, column) for column in power.T], axis=1)
    covariance = np.fft.irfft(own, 2 * count, axis=0)
    seen = np.fft.rfft(lags * covariance, axis=0).real[::2] / (window**2).sum()
    return np.fft.rfftfreq(count, 1 / rate), np.maximum(seen, 0.0)


def fit_spectrum(
    frequency: Float[np.ndarray, " freqs"],
    power: Float[np.ndarray, "freqs nv"],
    gain: Float[np.ndarray, " freqs"],
    degrees: Float[np.ndarray, " freqs"],
    nyquist: float,
    lowest: float = 0.0,
) -> Spectrum:
    """Smooth spectrum of noise that has passed a filter of power gain `gain`.

    Gamma GLM with log link: log S = log gain + a0 + a1 log(f + .05 Hz) + Legendre polynomials 2 to 5 of log f above
    .3 Hz, less their value and slope there, by iteratively reweighted least squares. `degrees` counts the independent
    Hann periodograms averaged at each frequency. Below `lowest` the fit serves `drawn` alone.

    Short recordings have few bins at low frequency, which alone would draw a spectrum that the noise does not have. So
    the squared second derivative of the polynomials is penalised, and each joint's shape is expected to be that of the
    other joints; the weights of both are those of largest marginal likelihood (empirical Bayes, with Laplace's
    approximation), of the second joint by joint: noise that is not alike is not made so.
    """
    used = gain > PASSED
    basis, weight = _basis(frequency[used], nyquist), degrees[used] / NEIGHBOURS
    observed = np.maximum(power[used] / gain[used, None], 1e-300)
    nv, terms, known = observed.shape[1], basis.shape[1], float(frequency[used][0])
    bend = np.zeros((terms, terms))
    bend[2:, 2:] = _bending()
    free = np.diag([1e-9, 1e-2] + [0.0] * (terms - 2))
    relative = observed / np.average(observed, axis=0, weights=weight)
    others = relative if nv == 1 else (relative.sum(1, keepdims=True) - relative) / (nv - 1)
    each = [_penalised(basis, max(nv - 1, 1) * weight, others, free + w * bend) for w in SMOOTHNESS]
    smooth = int(np.argmax([likely.sum() for likely, *_ in each]))
    _, common, spread = each[smooth]
    if nv == 1:
        return Spectrum(common + np.log(observed / relative)[:1] * np.eye(terms)[:, :1], spread, nyquist, lowest, known)
    even = _basis(np.geomspace(LOWEST / 10, nyquist, 50), nyquist)
    even[:, 0] = 0.0
    apart = even.T @ even / len(even) + np.diag([1e-9] + [0.0] * (terms - 1))
    common[0] = 0.0
    priors = [a * apart + SMOOTHNESS[smooth] * bend for a in ALIKE]
    each = [_penalised(basis, weight, observed, prior, common) for prior in priors]
    best = np.argmax([likely for likely, *_ in each], axis=0)  # of each joint: one may be unlike all others
    coefficients = np.stack([each[k][1][:, joint] for joint, k in enumerate(best)], axis=1)
    own = np.stack([each[k][2][joint] for joint, k in enumerate(best)])
    drawn = own @ np.stack([priors[k] for k in best])  # how far each follows the others' shape
    drawn[:, :, 0] = 0.0
    covariance = own + drawn @ spread @ np.swapaxes(drawn, 1, 2)
    return Spectrum(coefficients, covariance, nyquist, lowest, known)


def _penalised(
    basis: Float[np.ndarray, "freqs terms"],
    weight: Float[np.ndarray, " freqs"],
    observed: Float[np.ndarray, "freqs nv"],
    prior: Float[np.ndarray, "terms terms"],
    mean: Float[np.ndarray, "terms nv"] | None = None,
) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, "terms nv"], Float[np.ndarray, "nv terms terms"]]:
    """Log marginal likelihood of a prior's precision at each joint, the coefficients and their covariance."""
    mean = np.zeros((basis.shape[1], observed.shape[1])) if mean is None else mean
    inverse = np.linalg.inv(basis.T @ (weight[:, None] * basis) + prior)
    coefficients = mean.copy()
    coefficients[0] += np.log(np.average(observed / np.exp(basis @ mean), axis=0, weights=weight))
    for _ in range(30):
        ratio = np.minimum(observed / np.exp(basis @ coefficients), 20.0)
        slope = basis.T @ (weight[:, None] * (ratio - 1)) - prior @ (coefficients - mean)
        coefficients = coefficients + inverse @ slope
    fitted, off = basis @ coefficients, coefficients - mean
    likely = -weight @ (fitted + observed / np.exp(fitted)) - (off * (prior @ off)).sum(0) / 2
    likely += (np.linalg.slogdet(prior)[1] + np.linalg.slogdet(inverse)[1]) / 2
    return likely, coefficients, np.broadcast_to(inverse, (observed.shape[1], *inverse.shape))


def white(
    variance: Float[np.ndarray, " nv"], nyquist: float, degrees: Float[np.ndarray, " nv"] | float = np.inf
) -> Spectrum:
    """The same power at all frequencies: a scale per joint and nothing else, known by so many `degrees`."""
    coefficients, covariance = np.zeros((6, len(variance))), np.zeros((len(variance), 6, 6))
    coefficients[0], covariance[:, 0, 0] = np.log(variance), 2 / np.asarray(degrees)
    return Spectrum(coefficients, covariance, nyquist)


def whitening(
    spectrum: Spectrum, frequency: Float[np.ndarray, " freqs"], gain: Float[np.ndarray, " freqs"], cutoff: float
) -> Float[np.ndarray, "freqs nv"]:
    """Zero-phase response that makes the filtered noise white: 1/sqrt(gain S + floor).

    The floor is 5 % of the median filtered power between 1 Hz and the cutoff, so that the band which the row filter
    has emptied is not blown up.
    """
    if not spectrum.coefficients[1:].any():  # white
        return np.broadcast_to(
            1 / np.sqrt(spectrum.power(frequency[:1])), (len(frequency), spectrum.coefficients.shape[1])
        )
    filtered = gain[:, None] * spectrum.power(frequency)
    band = (frequency >= min(1.0, cutoff / 4)) & (frequency <= 0.8 * cutoff)
    floor = FLOOR * np.median(filtered[band], axis=0)
    return 1 / np.sqrt(filtered + floor)


def leverage(basis: Float[np.ndarray, "samples columns"]) -> Float[np.ndarray, " freqs"]:
    """Share of white noise that a projection on orthonormal `basis` takes away at each frequency, from 0."""
    return (np.abs(np.fft.rfft(basis, axis=0)) ** 2).sum(-1) / basis.shape[0]


def spectral_line(
    residual: Float[np.ndarray, "recordings samples nv"], rate: float, cutoff: float
) -> tuple[float, float, int]:
    """p-value, frequency (Hz) and joint of the strongest line in time.

    Over a running median of 41 bins of what a smooth spectrum leaves: coloured noise is steep. A recording that is kept
    out of the fit, whose rows are zero, tells nothing; of recordings that differ in length or power as many count as
    the loudest goes into their sum: it alone makes the tail.
    """
    told = [rows for rows in residual if rows.any()]
    frequency = np.fft.rfftfreq(residual.shape[1], 1 / rate)[1:]
    used = (frequency > LOWEST) & (frequency < min(0.9 * cutoff, 0.6 * rate / 2))
    if used.sum() < 41 or not told:
        return 1.0, 0.0, 0
    frequency, power = frequency[used], np.mean([periodogram(rows, rate)[1] for rows in told], axis=0)[used]
    each = np.stack([(rows**2).sum(0) for rows in told])
    heard = each.sum(0) > 0  # by joint: one without rows has no line
    shape = float((each[:, heard].sum(0) / each[:, heard].max(0)).min())
    basis, log = _basis(frequency, rate / 2), np.log(np.maximum(power, 1e-300))
    power = np.exp(log - basis @ np.linalg.lstsq(basis, log, rcond=None)[0])  # a slope is no line
    padded = np.pad(power, ((20, 20), (0, 0)), mode="reflect")
    level = np.median(np.lib.stride_tricks.sliding_window_view(padded, 41, axis=0), axis=-1)
    ratio = np.where(heard, power / np.maximum(level, 1e-300), 0)
    row, joint = np.unravel_index(np.argmax(ratio), ratio.shape)
    from scipy.special import fdtrc, gammaincinv  # scipy is slow to import

    to_mean = gammaincinv(shape, 0.5) / shape  # median of a gamma variable over its mean
    # the level is itself uncertain, so the ratio has the tail of an F variable
    tail = fdtrc(2 * shape, 2 * shape * LEVEL, ratio[row, joint] * to_mean)
    return float(min(1.0, tail * used.sum() * power.shape[1])), float(frequency[row]), int(joint)


def _basis(frequency: Shaped[np.ndarray, " freqs"], nyquist: float) -> Float[np.ndarray, "freqs terms"]:
    x = 2 * np.log(np.maximum(frequency, LOWEST) / LOWEST) / np.log(nyquist / LOWEST) - 1
    x = np.clip(x, -1, 1)
    bent = [p(x) - p(-1) - p.deriv()(-1) * (x + 1) for p in _POLYNOMIALS]
    return np.column_stack([np.ones_like(x), np.log(frequency + SHIFT), *bent])


def _bending() -> Float[np.ndarray, "polynomials polynomials"]:
    """Integrals from -1 to 1 of the products of the polynomials' second derivatives."""
    whole = [[(p.deriv(2) * q.deriv(2)).integ() for q in _POLYNOMIALS] for p in _POLYNOMIALS]
    return np.array([[float(w(1) - w(-1)) for w in row] for row in whole])
