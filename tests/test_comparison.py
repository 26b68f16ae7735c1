"""Held-out squares and their tests against a loop of refits, SciPy and vectors with known angles."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import ttest_1samp
from synthetic import made_rows

from figaroh_jax.diagnosis.comparison import (
    Hypothesis,
    coefficients,
    fewer_sums,
    fold_sums,
    ground,
    grown_sums,
    judge,
    judge_grown,
    overlap,
    shares_of_wins,
    sums_of,
    t_value,
)
from figaroh_jax.estimation.joint_rows import JointRows
from figaroh_jax.estimation.rows import Prior, Rows

NV, COUNT, WIDTH, BLOCKS, FOLDS = 2, 80, 3, 9, 4
PRIOR = Prior(np.array([0.3, -2.0, 0.0]), np.array([5.0, 0.2, 1e-3]))


@pytest.fixture
def rows() -> Rows:
    """Random rows; the last ones are padding, without block, fold or value."""
    rng = np.random.default_rng(0)
    y, X = rng.normal(size=(NV, COUNT)), rng.normal(size=(NV, COUNT, WIDTH))
    y[:, -5:], X[:, -5:] = 0.0, 0.0
    made = made_rows(y, X, blocks=BLOCKS, folds=FOLDS)
    made.block[-5:], made.fold[-5:] = -1, -1
    return made


def refit(rows: Rows, y: np.ndarray, prior: Prior, left_out: int) -> tuple[np.ndarray, float]:
    """Coefficients and penalised squares of the rows outside one fold, the prior being rows of the same stack."""
    X, use = rows.X.dense(), rows.fold != left_out
    root = np.sqrt(prior.precision)
    stacked = np.vstack([X[:, use].reshape(-1, X.shape[2]), np.diag(root)])
    right = np.append(y[:, use].reshape(-1), root * prior.mean)
    theta = np.linalg.lstsq(stacked, right, rcond=None)[0]
    return theta, float(((right - stacked @ theta) ** 2).sum())


@pytest.mark.parametrize("fixed", [False, True], ids=["columns", "fixed torque"])
def test_held_out_blocks_are_those_of_a_loop_of_refits(rows: Rows, fixed: bool) -> None:
    torque = np.random.default_rng(1).normal(size=rows.y.shape) * (rows.block >= 0) if fixed else 0.0
    verdicts = judge(rows, Hypothesis(rows.X, PRIOR, torque))
    y, X = rows.y - torque, rows.X.dense()
    blocks = np.zeros(BLOCKS)
    for fold in range(FOLDS):
        theta, cost = refit(rows, y, PRIOR, fold)
        np.testing.assert_allclose(verdicts.folds[fold], theta, rtol=0, atol=1e-9)
        np.testing.assert_allclose(verdicts.without[fold], cost, rtol=0, atol=1e-9)
        for row in np.flatnonzero(rows.fold == fold):
            blocks[rows.block[row]] += ((y[:, row] - X[:, row] @ theta) ** 2).sum()
    theta, cost = refit(rows, y, PRIOR, -2)
    np.testing.assert_allclose(verdicts.blocks, blocks, rtol=0, atol=1e-9)
    np.testing.assert_allclose(verdicts.heldout, blocks.sum(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(verdicts.theta, theta, rtol=0, atol=1e-9)
    np.testing.assert_allclose(verdicts.cost, cost, rtol=0, atol=1e-9)
    np.testing.assert_allclose(verdicts.residual, y - X @ theta, rtol=0, atol=1e-9)


def test_sums_grown_by_columns_are_the_sums_of_all_columns(rows: Rows) -> None:
    more = np.random.default_rng(2).normal(size=(NV, COUNT, 2)) * (rows.block >= 0)[:, None]
    both = JointRows.of(np.concatenate([rows.X.dense(), more], axis=2))
    grown, whole = grown_sums(rows, fold_sums(rows, rows.X), JointRows.of(more)), fold_sums(rows, both)
    for one, other in zip(grown, whole, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


def test_sums_of_fewer_columns_and_of_another_torque_are_those_computed_from_scratch(rows: Rows) -> None:
    torque, known = np.random.default_rng(4).normal(size=rows.y.shape), fold_sums(rows, rows.X)
    pairs = (
        (fewer_sums(known, [1]), fold_sums(rows, JointRows.of(rows.X.dense()[:, :, [0, 2]]))),
        (sums_of(rows, known, torque), fold_sums(rows, rows.X, torque)),
    )
    for short, whole in pairs:
        for one, other in zip(short, whole, strict=True):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)
    theta = coefficients(known, PRIOR)
    np.testing.assert_allclose(theta, refit(rows, rows.y, PRIOR, -2)[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("joints", [(1,), (0, 1)])
def test_a_hypothesis_grown_by_columns_is_judged_as_one_of_all_columns(rows: Rows, joints: tuple[int, ...]) -> None:
    more = np.random.default_rng(2).normal(size=(2, len(joints), COUNT)) * (rows.block >= 0)
    full = np.zeros((NV, COUNT, 2))
    full[list(joints)] = np.moveaxis(more, 0, 2)
    known = fold_sums(rows, rows.X)
    base = ground(judge(rows, Hypothesis(rows.X, PRIOR), known), PRIOR, known)
    whole = judge(rows, Hypothesis(JointRows.of(np.concatenate([rows.X.dense(), full], axis=2)), PRIOR.extended(2)))
    for one, other in zip(judge_grown(rows, base, joints, more), whole, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)


def test_sums_over_the_folds_are_the_normal_equations_of_all_rows(rows: Rows) -> None:
    sums, tall = fold_sums(rows, rows.X), rows.X.dense().reshape(-1, WIDTH)
    np.testing.assert_allclose(sums.gram.sum(0), tall.T @ tall, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sums.moment.sum(0), tall.T @ rows.y.reshape(-1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(sums.square.sum(), (rows.y**2).sum(), rtol=0, atol=1e-12)


def test_a_true_column_lowers_the_held_out_squares_and_a_random_one_raises_them_on_average() -> None:
    rng, changes = np.random.default_rng(3), []
    for _ in range(200):
        made = made_rows(rng.normal(size=(1, 60)), rng.normal(size=(1, 60, 2)), folds=4)
        true = made._replace(y=made.y + made.X.dense()[:, :, 1])
        costs = []
        for one in (made, true):
            with_it = judge(one, Hypothesis(one.X, Prior(np.zeros(2), np.zeros(2)))).heldout
            without = judge(one, Hypothesis(one.X.first(1), Prior(np.zeros(1), np.zeros(1)))).heldout
            costs.append(with_it - without)
        changes.append(costs)
    random, true = np.mean(changes, axis=0)
    assert true < -40 < 0 < random < 4


def test_t_value_is_that_of_the_paired_test() -> None:
    rng = np.random.default_rng(4)
    worse = rng.uniform(1.0, 2.0, 30)
    better = worse - rng.normal(0.1, 0.3, 30)
    expected = ttest_1samp(worse - better, 0.0).statistic  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_allclose(t_value(worse, better), expected, rtol=0, atol=1e-12)
    assert t_value(worse, worse) == 0.0


def test_a_block_that_gains_far_more_than_all_others_makes_none_of_them_less_sure() -> None:
    rng = np.random.default_rng(6)
    gain = rng.normal(0.5, 0.5, 36)
    sure = t_value(gain, np.zeros(36))
    gain[0] = 200.0
    assert t_value(gain, np.zeros(36)) > 0.5 * sure > 2.0
    alone = rng.normal(0.0, 0.5, 36)
    alone[0] = 200.0
    assert t_value(alone, np.zeros(36)) < 1.6  # one block that others do not bear out
    null = rng.laplace(size=(4000, 36)) ** 3  # symmetric, with tails that make some blocks far larger than the others
    exceeded = np.mean([t_value(one, np.zeros(36)) > 1.69 for one in null])  # 5 % of Student's t with 35 degrees
    assert exceeded < 0.06


def test_overlap_is_one_for_the_same_change_and_zero_for_another() -> None:
    rng = np.random.default_rng(5)
    X = np.linalg.qr(rng.normal(size=(COUNT, 2)))[0]
    made = made_rows((X @ [2.0, 3.0] + 0.1 * rng.normal(size=COUNT))[None], X[None])
    flat = Prior(np.zeros(1), np.zeros(1))
    current = judge(made, Hypothesis(JointRows.of(np.zeros((1, COUNT, 1))), flat))
    first, second = (judge(made, Hypothesis(JointRows.of(X[None, :, [k]]), flat)) for k in range(2))
    twice = judge(made, Hypothesis(JointRows.of(2 * X[None, :, [0]]), flat))
    between = judge(made, Hypothesis(JointRows.of((X @ [0.6, 0.8])[None, :, None]), flat))
    np.testing.assert_allclose(overlap(current, first, twice), 1.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(overlap(current, first, second), 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(overlap(current, first, between), 0.6, rtol=0, atol=1e-9)
    assert overlap(current, current, first) == 0.0


def test_wins_are_certain_for_a_hypothesis_better_in_every_block_and_even_for_mirror_images() -> None:
    rng = np.random.default_rng(6)
    cost = rng.uniform(1.0, 2.0, 40)
    np.testing.assert_array_equal(shares_of_wins(np.stack([cost, cost - 0.1, cost + 1]), rng), [0.0, 1.0, 0.0])
    swing = np.tile([1.0, -1.0], 20)
    shares = shares_of_wins(np.stack([cost + swing, cost - swing]), rng, draws=4000)
    np.testing.assert_allclose(shares.sum(), 1.0, rtol=0, atol=1e-12)
    # even resamples are ties (12 %), which go to the first
    np.testing.assert_allclose(shares, 0.5, rtol=0, atol=0.1)
