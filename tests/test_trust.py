"""A prior that is believed less, but only in the directions that the torque shows."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from figaroh_jax.identification.identification import _Problem


@pytest.mark.parametrize("slack", [1.0, 3.0, 100.0])
def test_what_no_torque_shows_stays_as_near_to_the_nominal_as_was_stated(slack: float) -> None:
    rng = np.random.default_rng(3)
    shown = np.linalg.qr(rng.standard_normal((10, 4)))[0]
    told = np.array([50.0, 0.6, 0.3, 0.02])
    problem: Any = SimpleNamespace(precision=rng.uniform(1, 100, 12), nominal=np.zeros((1, 10)), shown=shown, told=told)
    loose = _Problem.loosened(problem, slack)
    problem.loosened = lambda slack: loose
    everywhere = [f(problem, slack, everywhere=True) for f in (_Problem.root_at, _Problem.spread_at)]
    np.testing.assert_allclose(everywhere[0] @ everywhere[1], np.eye(12), rtol=0, atol=1e-12)
    root, spread = _Problem.root_at(problem, slack), _Problem.spread_at(problem, slack)
    np.testing.assert_allclose(root @ spread, np.eye(12), rtol=0, atol=1e-12)
    covariance = spread @ spread.T
    scaled = covariance * np.sqrt(np.outer(problem.precision, problem.precision))
    hidden = np.linalg.svd(shown.T)[2][4:]
    np.testing.assert_allclose(np.diag(hidden @ scaled[:10, :10] @ hidden.T), 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.diag(shown.T @ scaled[:10, :10] @ shown), loose**2, rtol=1e-12, atol=0)
    assert (loose >= 1.0).all() and loose[0] == loose[1] == slack >= loose[2] and loose[3] <= slack
    # an estimate moves by no more than two stated deviations where the data differ by one of their own
    moved = (shown * told**2) @ np.linalg.solve(np.diag(told**2 + loose**-2.0), np.diag(1 / told))
    assert (np.linalg.norm(moved, axis=0) <= 2.0 * (1 + 1e-9) + (loose == 1.0)).all()
    np.testing.assert_allclose(scaled[10:, 10:], np.eye(2), rtol=0, atol=1e-12)
