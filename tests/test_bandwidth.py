"""The band of a motion against motions whose noise is known, and the smoother against its gain in closed form."""

from __future__ import annotations

import secrets

import numpy as np
import pytest

from figaroh_jax.recordings.bandwidth import encoder_step, motion_band, smoothed
from figaroh_jax.recordings.resampling import differentiate

DT, CUTOFF, SECONDS = 1 / 200, 15.0, 10.0
TIME = np.arange(0, SECONDS, DT)
INNER = slice(100, -100)  # what is left of a recording when its ends are cut
NOISE = 2e-5


def swung(fastest: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A motion of harmonics up to `fastest` Hz, and its acceleration."""
    rng = np.random.default_rng(seed)
    omega = 2 * np.pi * np.linspace(0.1, fastest, 6)
    amplitude, phase = 0.4 / np.arange(1, 7), rng.uniform(0, 6, 6)
    waves = amplitude * np.sin(np.outer(TIME, omega) + phase)
    return waves.sum(1), -(waves * omega**2).sum(1)


def acceleration(position: np.ndarray) -> np.ndarray:
    return differentiate(position[:, None], DT, order=2)[:, 0]


@pytest.mark.parametrize("step", [0.0, 1e-4])
def test_a_slow_motion_is_smoothed_and_its_acceleration_is_much_better_known(step: float) -> None:
    seed = secrets.randbits(32)
    position, true = swung(0.6, seed)
    read = position + NOISE * np.random.default_rng(seed + 1).standard_normal(len(TIME))
    read = np.round(read / step) * step if step else read
    band = motion_band(read, DT, CUTOFF)
    assert 1.0 < band < CUTOFF / 2, seed
    at_cutoff, at_band = (acceleration(smoothed(read, DT, b)) - true for b in (CUTOFF, band))
    assert np.std(at_band[INNER]) < 0.1 * np.std(at_cutoff[INNER]), seed


def test_a_cutoff_far_above_the_motion_of_a_coarse_encoder_is_not_where_it_is_smoothed() -> None:
    """4096 counts read at 1 kHz, a cutoff of 250 Hz: what is left of the steps read as a lag of the torque."""
    seed, dt = secrets.randbits(32), 1e-3
    rng, time = np.random.default_rng(seed), np.arange(0, 4, 1e-3)
    wave = 2 * np.pi * rng.uniform(0.3, 1.1, 5)
    angle = wave * time[:, None] + rng.uniform(0, 6, 5)
    read = np.round(np.sin(angle).sum(1) * 4096 / (2 * np.pi)) * (2 * np.pi) / 4096
    band = motion_band(read, dt, 250.0)
    assert band < 15.0, seed
    off = differentiate(smoothed(read, dt, band)[:, None], dt, order=2)[:, 0] + (wave**2 * np.sin(angle)).sum(1)
    assert np.std(off[500:-500]) < 0.1, seed  # rad/s^2 of some 40; 2 at 31 Hz, an eighth of the cutoff


@pytest.mark.parametrize(("rate", "counts"), [(100.0, 2**18), (200.0, 2**14), (500.0, 2**14)])
def test_a_start_from_rest_is_not_lost_in_the_noise_of_all_the_rest(rate: float, counts: int) -> None:
    """Waves that begin within a second: a corner of the acceleration, of which the spectrum of 15 s shows nothing."""
    seed = secrets.randbits(32)
    rng, time, times = np.random.default_rng(seed), np.arange(0, 15, 1 / rate), []
    grow, step, cutoff = np.clip(time, 0, 1), 2 * np.pi / counts, min(20.0, 0.2 * rate)
    begun = 10 * grow**3 - 15 * grow**4 + 6 * grow**5
    slope = 30 * grow**2 - 60 * grow**3 + 30 * grow**4
    bend = 60 * grow - 180 * grow**2 + 120 * grow**3
    for _ in range(15):
        wave, size = 2 * np.pi * rng.uniform(0.06, 0.9, 3), np.array([0.6, 0.3, 0.12])
        angle = wave * time[:, None] + rng.uniform(0, 6, 3)
        s, c = np.sin(angle), np.cos(angle)
        true = bend * (s @ size) + 2 * slope * (c @ (size * wave)) - begun * (s @ (size * wave**2))
        read, off = np.round(begun * (s @ size) / step) * step, []
        for band in [motion_band(read, 1 / rate, cutoff, step, rate), *(cutoff * 2.0 ** (-np.arange(13) / 2))]:
            found = np.gradient(np.gradient(smoothed(read, 1 / rate, band), 1 / rate), 1 / rate)
            off.append(np.std((found - true)[3:-3]))
        times.append(off[0] / min(off))
    assert np.median(times) < 2.6, (seed, times)  # not reached where the spectrum of the whole alone is asked


def test_a_motion_that_is_faster_than_the_noise_keeps_its_cutoff() -> None:
    seed = secrets.randbits(32)
    position, _ = swung(14.0, seed)
    assert motion_band(position + NOISE * np.random.default_rng(seed).standard_normal(len(TIME)), DT, CUTOFF) == CUTOFF
    assert motion_band(position, DT, CUTOFF) == CUTOFF


def test_a_short_record_keeps_its_cutoff() -> None:
    assert motion_band(np.random.default_rng(0).standard_normal(150), DT, CUTOFF) == CUTOFF


@pytest.mark.parametrize("frequency", [0.5, 3.0, 6.0])
def test_smoothing_has_the_gain_of_its_penalty_and_no_phase(frequency: float) -> None:
    band, wave = 4.0, np.sin(2 * np.pi * frequency * TIME + 0.7)
    sine = np.sin(np.pi * frequency * DT) / np.sin(np.pi * band * DT)
    np.testing.assert_allclose(smoothed(wave, DT, band)[300:-300], wave[300:-300] / (1 + sine**6), rtol=0, atol=2e-3)


def test_smoothing_leaves_a_parabola_alone_up_to_its_ends() -> None:
    parabola = 0.3 + 0.2 * TIME - 0.05 * TIME**2
    np.testing.assert_allclose(smoothed(parabola, DT, 3.0), parabola, rtol=0, atol=1e-7)


@pytest.mark.parametrize("rate", [250.0, 1000.0])
def test_the_steps_of_a_slow_joint_are_not_taken_for_motion(rate: float) -> None:
    """Near its turns a joint makes a slow, loud sawtooth of its encoder's steps, whose lines stand above the rest."""
    seed, time = secrets.randbits(32), np.arange(0, 8, 1 / rate)
    rng, off = np.random.default_rng(seed), []
    for _ in range(8):
        wave = rng.uniform(0.5, 2.0, 6)
        angle, speed = wave * time[:, None] + rng.uniform(0, 6, 6), rng.uniform(0.05, 0.3, 6)
        step = 2 * np.pi / 4096
        read = np.round((speed / wave * np.sin(angle)).sum(1) / step) * step
        assert abs(encoder_step(read) / step - 1) < 1e-6 or encoder_step(read) == 0, seed
        band = motion_band(read, 1 / rate, 0.25 * rate, encoder_step(read), rate)
        known = differentiate(smoothed(read, 1 / rate, band)[:, None], 1 / rate, order=2)[:, 0]
        off.append(np.std((known + (speed * wave * np.sin(angle)).sum(1))[int(rate) : -int(rate)]))
    assert max(off) < 0.3, (seed, off)  # rad/s^2; 10 to 300 at the cutoff


def test_a_step_is_read_from_the_values_that_occur() -> None:
    slow = np.sin(np.arange(0, 4, 1e-3))
    assert encoder_step(np.round(slow / 0.01) * 0.01) == pytest.approx(0.01)
    assert encoder_step(np.round(np.round(slow / 0.0015339) * 0.0015339, 4)) == pytest.approx(0.0015, abs=1e-4)
    assert encoder_step(slow) == 0.0 == encoder_step(np.zeros(100))
