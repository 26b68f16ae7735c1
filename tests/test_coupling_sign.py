"""The sign of a coupling is that of one rotor: SciPy's non-negative least squares, and mirrored parts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.optimize import nnls

from figaroh_jax.diagnosis import contenders
from figaroh_jax.diagnosis.comparison import Hypothesis, fold_sums, ground, judge
from figaroh_jax.estimation.joint_rows import JointRows
from figaroh_jax.estimation.rows import Prior, Rows

ROWS = 200


@pytest.mark.parametrize("seed", range(20))
def test_squares_explained_by_parts_of_zero_or_more_are_those_of_scipy(seed: int):
    rng = np.random.default_rng(seed)
    Z, y = rng.standard_normal((30, 3)) @ rng.standard_normal((3, 3)), rng.standard_normal(30)
    drop, parts = contenders._none_below_zero(Z.T @ Z, Z.T @ y)
    best, left = nnls(Z, y)
    assert drop == pytest.approx(y @ y - left**2, rel=1e-8, abs=1e-9)
    assert parts == tuple(np.flatnonzero(best > 1e-12))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_of_two_mirrored_signs_the_one_with_positive_parts_comes_first(sign: float):
    """Though the other fits better: most of what it gains is a friction below zero."""
    rng = np.random.default_rng(3)
    a, v, turns, across = rng.standard_normal((4, 2, ROWS))
    grid = [np.stack([s * a, s * v, x]) for s, x in ((1.0, turns), (-1.0, across))]
    own = grid[0 if sign > 0 else 1]
    noise = 0.1 * rng.standard_normal((2, ROWS))
    y = np.tensordot([0.5, 0.8, 0.3], own, 1) - 0.4 * grid[1 if sign > 0 else 0][2] + noise
    rows = _rows(y)
    X = JointRows.of(np.ones((2, ROWS, 1)))
    rows = rows._replace(X=X)
    prior = Prior(np.zeros(1), np.zeros(1))
    sums = fold_sums(rows, X)
    base = ground(judge(rows, Hypothesis(X, prior), sums), prior, sums)
    group: Any = SimpleNamespace(columns=SimpleNamespace(joints=(0, 1), Z=np.array(grid)))
    step: Any = SimpleNamespace(rows=rows)
    free = [contenders.judge_grown(rows, base, (0, 1), Z).cost for Z in grid]
    assert np.argmin(free) == (1 if sign > 0 else 0)
    for order in ([0, 1], [1, 0]):
        first = contenders._as_one_rotor(step, base, group, np.array(order))[0][0]
        assert first == (0 if sign > 0 else 1)


def _rows(y: np.ndarray) -> Rows:
    block = np.arange(ROWS) // 10
    empty = cast(Any, JointRows.of(np.zeros((2, ROWS, 0))))
    return Rows(**{name: empty for name in Rows._fields} | {"y": y, "fold": block % 5, "block": block})
