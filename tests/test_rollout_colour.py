"""The colour of an encoder's noise, told from what a model leaves, and what is no such noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from generators import servo_arm6
from scipy.signal import lfilter

from figaroh_jax.rollouts.arm import search_arm
from figaroh_jax.rollouts.colour import colour_of, filtered
from figaroh_jax.rollouts.data import Run, Stretch, noise_of
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.setting import setting

ROWS, WINDOWS = 600, 4


def low_passed(pole: float, seed: int, level: float = 1.0) -> np.ndarray:
    """(rows, 1, windows) of white noise of that standard deviation behind a low pass that has settled."""
    white = np.random.default_rng(seed).normal(0, level, (ROWS + 200, 1, WINDOWS))
    return np.asarray(lfilter([1.0], [1.0, -pole], white, axis=0))[200:]


def in_its_unit(error: np.ndarray) -> np.ndarray:
    return error / np.sqrt(np.mean([noise_of(error[..., w]) ** 2 for w in range(WINDOWS)]))


@pytest.mark.parametrize("pole", [0.0, 0.3, 0.6, 0.8])
def test_the_pole_and_the_level_of_a_low_pass_are_found(pole: float):
    for seed in range(5):
        error = low_passed(pole, seed, 3.0)
        unit = float((error / in_its_unit(error)).mean())
        found = colour_of(error / unit, np.ones(error.shape, bool))
        assert found is not None
        assert abs(found.pole[0] - pole) < 4 * np.sqrt((1 - pole**2) / (ROWS * WINDOWS)) + 1e-3
        assert found.level[0] * unit == pytest.approx(3.0, rel=0.1)
        white = filtered(error, np.ones(error.shape, bool), np.full((1, WINDOWS), found.pole[0]))[1:]
        assert abs((white[1:] * white[:-1]).mean() / white.var()) < 4 / np.sqrt(white.size)


def misfits() -> dict[str, np.ndarray]:
    t = np.arange(ROWS)[:, None, None]
    slow = np.sin(2 * np.pi * t / 90 + np.arange(WINDOWS))
    turning = np.exp(-(((t + 20 * np.arange(WINDOWS)) % 75) / 12.0))  # after each change of direction
    return {
        "follows a motion": low_passed(0.0, 1) + slow,
        "follows a motion beside coloured noise": low_passed(0.6, 1) + 2 * slow,
        "comes after changes of direction": low_passed(0.0, 2) + 2 * turning,
        "comes in bursts": low_passed(0.5, 3) * np.where(t // 100 % 3 == 0, 3.0, 1.0),
        "wanders": low_passed(0.97, 4),
        "has a line": low_passed(0.3, 5) + np.sin(2 * np.pi * t / 7.3),
    }


@pytest.mark.parametrize("name", misfits())
def test_what_follows_the_motion_is_no_noise(name: str):
    assert colour_of(in_its_unit(misfits()[name]), np.ones((ROWS, 1, WINDOWS), bool)) is None


def test_rows_that_do_not_count_are_left_out():
    error, counted = low_passed(0.6, 7), np.ones((ROWS, 1, WINDOWS), bool)
    unit = float((error / in_its_unit(error)).mean())
    counted[200:260] = False
    error[200:260] = 1e3
    found = colour_of(error / unit, counted)
    assert found is not None and found.pole[0] == pytest.approx(0.6, abs=0.07)
    white = filtered(error, counted, np.full((1, WINDOWS), 0.6))
    assert np.abs(white).max() < 6 and not white[200:260].any()
    np.testing.assert_allclose(white[260], 0.8 * error[260])


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [[], [("command_delay", 2, 0.008)]])
def test_an_arm_with_coloured_noise_is_judged_by_it(tmp_path: Path, hidden: list):
    """Noise of MuJoCo's arm behind a low pass of 20 ms: `nothing` and the cause; `unknown` where that is forbidden."""
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text(1.6))
    loop, _ = load_loop(tmp_path / "arm.xml")
    recorded = [servo_arm6.record(hidden, 11, k, "coloured") for k in range(2)]
    runs = [Run(f"run {k}", r["t"], r["u"], r["q"], None) for k, r in enumerate(recorded)]
    cut = [Stretch(k, f, 600) for k in range(2) for f in (0, 600)]
    found = search_arm(setting(loop, runs, stretches=cut))
    assert found.verdict == ("named" if hidden else "nothing")
    assert [n.candidate[:2] for n in found.named] == [(e, (servo_arm6.NAMES[j],)) for e, j, _ in hidden]
    assert found.setting is not None and found.setting.pole is not None
    np.testing.assert_allclose(found.setting.pole, np.exp(-0.5), atol=0.07)
    np.testing.assert_allclose(found.setting.spread, servo_arm6.NOISE, rtol=0.15)
    if hidden:
        left_out = (hidden[0][0],)
        assert search_arm(setting(loop, runs, stretches=cut, forbid=left_out), forbid=left_out).verdict == "unknown"
