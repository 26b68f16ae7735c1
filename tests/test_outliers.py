"""Which postures are outliers, against noise whose law is known."""

from __future__ import annotations

import numpy as np

from figaroh_jax.calibration.outliers import find_outliers
from figaroh_jax.estimation.marginal import FLAT, Linear

POSTURES, NUMBERS, UNKNOWNS = 80, 9, 6


def linear(rng: np.random.Generator, moved: float = 0.0) -> Linear:
    """Normal noise of one sigma in three markers a posture; the first posture is moved by so many in each number."""
    rows = POSTURES * NUMBERS
    posture = np.repeat(np.arange(POSTURES), NUMBERS)
    residual = rng.standard_normal(rows) + moved * (posture == 0) * rng.choice([-1.0, 1.0], rows)
    zeros = np.zeros(rows, int)
    groups = np.full(UNKNOWNS, FLAT)
    return Linear(
        residual, rng.standard_normal((rows, UNKNOWNS)), np.zeros(UNKNOWNS), zeros, posture, groups, np.ones(1)
    )


def outliers(made: Linear) -> dict[int, float]:
    return find_outliers(made, np.ones(len(made.residual), bool), np.ones(UNKNOWNS, bool))


def test_a_posture_of_twice_the_noise_is_none():
    """A spread of 80 postures that happens to be small must not make it an outlier."""
    assert not any(outliers(linear(np.random.default_rng(seed), 1.7)) for seed in range(200, 300))


def test_a_posture_moved_by_three_sigma_is_one():
    found = [outliers(linear(np.random.default_rng(seed), 3.2)) for seed in range(20)]
    assert sum(set(one) == {0} for one in found) >= 18
