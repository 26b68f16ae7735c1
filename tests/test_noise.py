"""Spectra, whitening, leverage and lines against simulated noise whose spectrum is known in closed form."""

from __future__ import annotations

import secrets
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.signal import lfilter

from figaroh_jax.diagnosis.screening import Null
from figaroh_jax.estimation import noise

RATE, COUNT, CUTOFF = 66.0, 2000, 20.0
POLES, DRIVEN, WHITE = (0.9, 0.6), (0.5, 2.0), (0.7, 1.0)  # of two joints: AR(1), its innovation, white noise
SERIES = 40


def simulated(rng: np.random.Generator) -> np.ndarray:
    """AR(1) plus white noise: (series, samples, joints)."""
    out = []
    for pole, driven, white in zip(POLES, DRIVEN, WHITE, strict=True):
        slow = np.asarray(lfilter([1.0], [1.0, -pole], driven * rng.standard_normal((SERIES, COUNT + 200))))
        out.append(slow[:, 200:] + white * rng.standard_normal((SERIES, COUNT)))
    return np.stack(out, axis=2)


def truth(frequency: np.ndarray) -> np.ndarray:
    turn = np.exp(-2j * np.pi * frequency[:, None] / RATE)
    return np.array(DRIVEN) ** 2 / abs(1 - np.array(POLES) * turn) ** 2 + np.array(WHITE) ** 2


def low_pass(frequency: np.ndarray) -> np.ndarray:
    return 1 / (1 + (frequency / CUTOFF) ** 8)


def filtered(series: np.ndarray, response: np.ndarray) -> np.ndarray:
    """Rows after a response over the frequencies of `rfft`, with one column a joint or one for all."""
    shaped = response.reshape(len(response), -1)
    return np.fft.irfft(np.fft.rfft(series, axis=1) * shaped, series.shape[1], axis=1)


def spectrum_of(series: np.ndarray, gain: np.ndarray) -> noise.Spectrum:
    powers = [noise.periodogram(one, RATE) for one in series]
    frequency, power = powers[0][0], np.mean([p for _, p in powers], axis=0)
    return noise.fit_spectrum(frequency, power, gain[1:], np.full(len(frequency), float(len(series))), RATE / 2)


def test_periodogram_of_white_noise_is_its_variance() -> None:
    rows = 3.0 * np.random.default_rng(0).standard_normal((4000, 50))
    frequency, power = noise.periodogram(rows, RATE)
    np.testing.assert_allclose(frequency[[0, -1]], [RATE / 4000, RATE / 2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(power.mean(), 9.0, rtol=0, atol=0.15)


def test_spectrum_of_coloured_noise_is_found_behind_the_row_filter() -> None:
    frequency = np.fft.rfftfreq(COUNT, 1 / RATE)
    response = low_pass(frequency)
    rows = filtered(simulated(np.random.default_rng(1)), response)
    found = spectrum_of(rows, response**2)
    band = np.linspace(0.7, CUTOFF, 200)
    np.testing.assert_allclose(found.power(band) / truth(band), 1.0, rtol=0, atol=0.08)
    # below, the form is a power of the frequency: too stiff for a spectrum that levels off
    slow = np.linspace(0.1, 0.7, 20)
    np.testing.assert_allclose(np.log(found.power(slow) / truth(slow)), 0.0, rtol=0, atol=np.log(1.8))


def test_rows_that_are_left_out_carry_power_into_the_band_that_the_row_filter_empties() -> None:
    rng, frequency = np.random.default_rng(), np.fft.rfftfreq(COUNT, 1 / RATE)
    gain = low_pass(frequency)[:, None] ** 2
    mask = np.ones((COUNT, 2), bool)
    for joint, share in enumerate((0.2, 0.3)):
        for at in rng.integers(0, COUNT - 8, int(share * COUNT / 8)):
            mask[at : at + 8, joint] = False
    powers = [filtered(simulated(rng), gain[:, 0] ** 0.5) * mask for _ in range(5)]
    drawn = np.mean([noise.periodogram(one, RATE, level=True)[1] for part in powers for one in part], axis=0)
    own, told = noise.seen_through(mask, RATE, frequency, gain * truth(frequency))
    np.testing.assert_allclose(own, frequency, rtol=0, atol=1e-9)
    parts = [np.array_split(power, 40) for power in (drawn, told)]
    ratio = [d.mean(0) / t.mean(0) for d, t in zip(*parts, strict=True)]
    np.testing.assert_allclose(ratio, 1.0, rtol=0, atol=0.12)  # 5 deviations of 200 series x 25 bins
    above = frequency > 1.5 * CUTOFF
    assert (told[above].mean(0) > 20 * (gain * truth(frequency))[above].mean(0)).all()


def test_whitened_noise_has_a_flat_spectrum_of_power_one_in_the_pass_band() -> None:
    frequency = np.fft.rfftfreq(COUNT, 1 / RATE)
    response, rng = low_pass(frequency), np.random.default_rng(2)
    spectrum = spectrum_of(filtered(simulated(rng), response), response**2)
    weights = noise.whitening(spectrum, frequency, response**2, CUTOFF)
    fresh = filtered(filtered(simulated(rng), response), weights)
    power = np.mean([noise.periodogram(one, RATE)[1] for one in fresh], axis=0)
    inner = (frequency[1:] > 0.7) & (frequency[1:] < 0.7 * CUTOFF)
    parts = np.stack([part.mean(0) for part in np.array_split(power[inner], 12)])
    # the floor takes up to 5 % of the median power
    np.testing.assert_allclose(parts, 1.0, rtol=0, atol=0.1)
    assert power[frequency[1:] > 1.4 * CUTOFF].max() < 1.0  # what the filter emptied is not blown up


def test_white_spectrum_is_only_a_scale() -> None:
    frequency = np.linspace(0.0, 33.0, 50)
    white = noise.white(np.array([4.0, 0.25]), 33.0)
    np.testing.assert_allclose(white.power(frequency), [[4.0, 0.25]] * 50, rtol=0, atol=1e-12)
    weights = noise.whitening(white, frequency, low_pass(frequency), CUTOFF)
    np.testing.assert_allclose(weights, [[0.5, 2.0]] * 50, rtol=0, atol=1e-12)


def test_redrawn_spectra_scatter_as_fits_to_new_data_do() -> None:
    frequency, rng = np.fft.rfftfreq(COUNT, 1 / RATE), np.random.default_rng(3)
    flat = np.ones(len(frequency))
    band = np.array([0.5, 2.0, 8.0, 20.0])
    fits = [spectrum_of(simulated(rng)[:4], flat) for _ in range(40)]
    scatter = np.std([np.log(one.power(band)) for one in fits], axis=0)
    drawn = np.log(fits[0].drawn(band, 400, rng)).std(axis=0)
    # a Hann window makes neighbouring bins follow one another: fits scatter by up to sqrt(2) more
    assert np.all((scatter / drawn > 0.7) & (scatter / drawn < 2.0)), scatter / drawn


def slow_spectrum(rng: np.random.Generator, truth: np.ndarray) -> noise.Spectrum:
    """From .2 Hz on, of four recordings of 10 s at 50 Hz; `truth` is their power at the frequencies of 80 s."""
    white = np.fft.rfft(rng.standard_normal((4, 4000, 3)), axis=1)
    rows = np.fft.irfft(white * np.sqrt(truth)[:, None], 4000, axis=1)[:, :500]
    powers = [noise.periodogram(one, 50.0, level=True) for one in rows]
    told = powers[0][0] >= 0.2
    power, flat = np.mean([p for _, p in powers], axis=0)[told], np.ones(told.sum())
    return noise.fit_spectrum(powers[0][0][told], power, flat, 4 * flat, 25.0, 0.2)


def test_below_what_a_fit_has_seen_noise_goes_on_as_it_is_above() -> None:
    rng, frequency, zero = np.random.default_rng(7), np.fft.rfftfreq(4000, 1 / 50.0), np.zeros(1)

    def found(truth: np.ndarray) -> list[noise.Spectrum]:
        return [slow_spectrum(rng, truth) for _ in range(20)]

    def expected(spectra: list[noise.Spectrum]) -> float:
        return float(np.exp(np.mean([np.log(s.power(zero) * s.rise(zero)) for s in spectra])))

    pink = 2.0 / np.maximum(frequency, 0.05)
    spectra = found(0.4 + pink)
    np.testing.assert_allclose(np.log(expected(spectra) / 40.4), 0.0, rtol=0, atol=np.log(1.5))
    held = np.exp(np.mean([np.log(s.power(zero)) for s in spectra]))
    assert held < 40.4 / 3  # what rows are weighted by: constant below .2 Hz
    np.testing.assert_allclose(expected(found(np.full(2001, 3.0))), 3.0, rtol=0, atol=0.3)
    for steep in found(pink**2):  # no more than 1/f: it may be a misfit
        np.testing.assert_allclose(steep.rise(np.array([0.0, 0.1, 0.2])), [[5.0] * 3, [5 / 3] * 3, [1.0] * 3])
    for falling in found(1e-3 + frequency**2):
        np.testing.assert_array_equal(falling.rise(frequency), np.ones((2001, 3)))


def test_candidates_are_scored_on_noise_that_goes_on_rising() -> None:
    frequency = np.fft.rfftfreq(4000, 1 / 50.0)
    spectrum = slow_spectrum(np.random.default_rng(8), 0.4 + 2.0 / np.maximum(frequency, 0.05))
    records = {"shape": (4, 500, 500, 3), "rate": 50.0, "omega": 2 * np.pi * frequency, "low_pass": np.ones(2001)}
    problem = cast(Any, SimpleNamespace(records=SimpleNamespace(**records, fitted=np.ones((4, 500, 3)))))
    null = Null(problem, spectrum, np.ones((2001, 3)), np.random.default_rng(9))
    rows = np.concatenate([null.rows(part) for part in range(8)]).reshape(-1, 3, 4, 500)
    told = (spectrum.power(np.zeros(1)) * spectrum.rise(np.zeros(1)))[0]
    means = 500 * (rows.mean(-1) ** 2).mean((0, 2))
    # each draw has a spectrum of its own, whose mean is larger than its median
    np.testing.assert_allclose(means / told, 1.2, rtol=0, atol=0.3)


def test_a_projection_takes_the_share_of_white_noise_that_leverage_says() -> None:
    rng, count, joints = np.random.default_rng(4), 60, 2
    time = np.arange(count)[:, None]
    slow = np.cos(np.pi * (time + 0.5) * np.arange(5) / count)  # low frequencies, at the first joint alone
    tall = np.zeros((count, joints, 8))
    tall[:, 0, :5], tall[:, :, 5:] = slow, rng.standard_normal((count, joints, 3))
    basis = np.linalg.qr(tall.reshape(-1, 8))[0]
    share = noise.leverage(basis.reshape(count, joints, 8))
    white = rng.standard_normal((20000, count * joints))
    left = (white - (white @ basis) @ basis.T).reshape(-1, count, joints)
    power = (abs(np.fft.rfft(left, axis=1)) ** 2).mean(0) / count
    np.testing.assert_allclose(power, 1 - share, rtol=0, atol=6 * np.sqrt(2 / 20000))
    assert share[0, 0] > 0.8 and share.max() <= 1 + 1e-9


def test_a_sine_in_noise_is_found_at_its_frequency_and_joint() -> None:
    rng, time = np.random.default_rng(5), np.arange(COUNT) / RATE
    residual = rng.standard_normal((3, COUNT, 2))
    residual[:, :, 1] += 0.4 * np.sin(2 * np.pi * 7.3 * time + rng.uniform(0, 6, (3, 1)))
    p, frequency, joint = noise.spectral_line(residual, RATE, CUTOFF)
    assert p < 1e-6 and joint == 1
    np.testing.assert_allclose(frequency, 7.3, rtol=0, atol=1.5 * RATE / COUNT)


def test_white_noise_rarely_shows_a_line() -> None:
    rng = np.random.default_rng(secrets.randbits(64))
    p = np.array([noise.spectral_line(rng.standard_normal((1, 1500, 6)), RATE, CUTOFF)[0] for _ in range(600)])
    # 0.6 and 0.06 are expected; the tail is right within a factor of two
    assert (p < 1e-3).sum() <= 8, np.sort(p)[:10]
    assert (p < 1e-4).sum() <= 4, np.sort(p)[:10]


@pytest.mark.parametrize("parts", [(1.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.2, 1.0)])
def test_recordings_left_out_of_the_fit_or_shorter_than_others_show_no_line(parts: tuple[float, ...]) -> None:
    """One recording and one that is kept out are not two: their mean scatters as one does."""
    rng, here = np.random.default_rng(secrets.randbits(64)), np.linspace(0, 1, 1500, endpoint=False)
    used = np.stack([here < part for part in parts])[:, :, None]
    p = np.array(
        [noise.spectral_line(rng.standard_normal((len(parts), 1500, 2)) * used, RATE, CUTOFF)[0] for _ in range(600)]
    )
    assert (p < 1e-2).sum() <= 16, np.sort(p)[:20]  # 6 are expected
    assert (p < 1e-3).sum() <= 8, np.sort(p)[:10]


def test_the_slope_of_coloured_noise_is_no_line() -> None:
    rng, rate = np.random.default_rng(secrets.randbits(64)), 50.0
    slow = [np.asarray(lfilter([1.0], [1.0, -0.95], rng.standard_normal((2, 600, 2)), axis=1)) for _ in range(600)]
    p = np.array([noise.spectral_line(rows[:, 200:], rate, 15.0)[0] for rows in slow])
    assert (p < 1e-2).sum() <= 16, np.sort(p)[:20]  # 6 are expected
    assert (p < 1e-3).sum() <= 8, np.sort(p)[:10]


def test_too_short_a_series_has_no_line() -> None:
    assert noise.spectral_line(np.ones((1, 60, 1)), RATE, CUTOFF) == (1.0, 0.0, 0)


def test_short_recordings_with_rows_left_out_show_white_noise_as_white() -> None:
    rng, count, joints, rate, cutoff = np.random.default_rng(8), 450, 6, 50.0, 15.0
    response = 1 / (1 + (np.fft.rfftfreq(count, 1 / rate) / cutoff) ** 8)
    frequency, low = np.fft.rfftfreq(count, 1 / rate), np.array([0.1, 0.25, 0.5, 1.0])
    off = []
    for _ in range(10):
        rows = filtered(rng.standard_normal((3, count, joints)), response) * (rng.random((3, count, joints)) > 0.03)
        power = np.mean([noise.periodogram(one, rate, level=True)[1] for one in rows], axis=0) / 0.97
        degrees = np.append(1.5, np.full(len(frequency) - 1, 3.0))
        found = noise.fit_spectrum(frequency, power, response**2, degrees, rate / 2, 0.22)
        off.append(np.log(found.power(low)))
    # a fit to each joint alone, and to what leaks beyond the cutoff, was off by a factor of seven
    assert np.abs(off).max() < np.log(2.5) and np.std(off) < 0.25, (np.abs(off).max(), np.std(off))
    assert abs(np.mean(off)) < 0.05, np.mean(off)


def test_joints_are_taken_as_alike_only_where_they_are() -> None:
    rng, count = np.random.default_rng(9), 1000
    slow = np.asarray(lfilter([1.0], [1.0, -0.9], rng.standard_normal((4, count + 200))))[:, 200:]
    rows = np.stack([slow, *rng.standard_normal((3, 4, count))], axis=2)
    powers = [noise.periodogram(one, RATE, level=True) for one in rows]
    frequency, power = powers[0][0], np.mean([p for _, p in powers], axis=0)
    found = noise.fit_spectrum(frequency, power, np.ones(len(frequency)), np.full(len(frequency), 4.0), RATE / 2, 0.2)
    band = np.array([0.5, 2.0, 8.0])
    driven = 1 / abs(1 - 0.9 * np.exp(-2j * np.pi * band / RATE)) ** 2
    np.testing.assert_allclose(np.log(found.power(band)[:, 0] / driven), 0.0, rtol=0, atol=0.5)
    np.testing.assert_allclose(np.log(found.power(band)[:, 1:]), 0.0, rtol=0, atol=0.4)
