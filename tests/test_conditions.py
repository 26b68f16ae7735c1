"""Recordings as strangers make them (`benchmarks/conditions.py`, torques of MuJoCo C): each read something else before.

What was wrong stands beside each. What reads a motion (steps of an encoder, stamps without decimals, samples between
which dry friction turns) and slow noise in the band of a slow motion are no misfit of the model.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.conditions import Strange, draw, graded, motion, moved


@pytest.mark.parametrize(
    ("seed", "strange"),
    [
        (5021, False),  # a link's inertia: noise of 10 % in the band of a slow motion, 4096 counts
        (21003, False),  # a ripple: 4 s of slow noise
        (21057, False),  # unknown: friction turns between samples 20 ms apart
        (1007, True),  # unknown: 60 Hz with stamps in whole milliseconds
    ],
)
def test_a_right_model_is_told_so(seed: int, strange: bool) -> None:
    told = graded(seed, "clean", strange)
    assert (told["grade"], told["names"]) == ("nothing", []), told


def test_a_rotor_is_named_where_slow_noise_and_steps_are_asked_for() -> None:
    told = graded(6002, "rotor")
    assert (told["grade"], told["names"]) == ("named", ["rotor_inertia at elbow"]), told


@pytest.mark.parametrize("pause", [0.0, 0.25])
def test_the_motion_is_the_integral_of_its_velocity(pause: float) -> None:
    rng = np.random.default_rng(3)
    told = draw(rng)
    waves, t = motion(rng, told), np.arange(0, told.seconds, 1e-4)
    q, v, a = moved(t, waves, told, pause)
    inner = slice(5, -5)
    np.testing.assert_allclose(np.gradient(q, 1e-4, axis=0)[inner], v[inner], rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.gradient(v, 1e-4, axis=0)[inner], a[inner], rtol=0, atol=1e-2)
    assert Strange() == Strange(lost=0.0)
