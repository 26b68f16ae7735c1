"""Steps on the host: known minima, what no row shows, rows that are not finite, and the end of the steps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from figaroh_jax.estimation.hostfit import descend

T = np.linspace(0.0, 2.0, 40)
SEEN = 2.0 * np.exp(-0.7 * T) + 0.3 + 0.01 * np.random.default_rng(0).standard_normal(40)


def decay(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and Jacobian of a decay with three numbers, from 1, 0 and 0, and one that no row shows."""
    bend = np.exp(y[1] * T)
    columns = np.stack([bend, (1.0 + y[0]) * T * bend, np.ones_like(T), np.zeros_like(T)], 1)
    return ((1.0 + y[0]) * bend + y[2] - SEEN) / 0.01, columns / 0.01


@pytest.mark.parametrize("sigma", [np.inf, 0.05])
def test_it_ends_where_another_solver_does(sigma: float):
    root = np.array([1 / sigma, 1 / sigma, 1 / sigma, 0.0])
    found = descend(decay, root**2, 256)
    theirs = least_squares(
        lambda y: np.concatenate([decay(y)[0], root * y]),
        np.zeros(4),
        x_scale="jac",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-12,
    )
    assert found.converged and not found.stuck and found.steps < 30
    np.testing.assert_allclose(found.at, theirs.x, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.jacobian.T @ found.rows + root**2 * found.at, 0.0, rtol=0, atol=1e-5)
    assert found.at[3] == 0.0


def test_nearly_dependent_columns_and_rows_that_the_numbers_explain_wholly():
    rng = np.random.default_rng(1)
    matrix = rng.standard_normal((30, 4)) * [1.0, 1e-6, 1e3, 1.0]
    matrix[:, 3] = matrix[:, 0] + 1e-5 * matrix[:, 3]
    truth = np.array([1.0, -2.0, 0.5, 0.3])
    found = descend(lambda y: (matrix @ (y - truth), matrix), np.zeros(4), 256)
    assert found.converged
    np.testing.assert_allclose(found.at, truth, rtol=0, atol=1e-7)


def test_a_step_to_where_rows_are_not_finite_is_none():
    def rows(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.array([np.log(0.1 + y[0]), 0.0]), np.array([[1 / (0.1 + y[0])], [0.0]])

    found = descend(rows, np.zeros(1), 256)  # the first step from 0 is short, so begin far away too
    np.testing.assert_allclose(found.at, 0.9, rtol=0, atol=1e-9)
    far = descend(lambda y: rows(y + 9.0), np.zeros(1), 256)  # a whole step from there ends below zero
    assert found.converged and far.converged
    np.testing.assert_allclose(far.at, -8.1, rtol=0, atol=1e-9)
    assert descend(lambda y: rows(y - 1.0), np.zeros(1), 256).stuck


def test_steps_that_are_used_up_are_told():
    found = descend(decay, np.zeros(4), 1)
    assert not found.converged and not found.stuck and found.steps == 1
