"""Every method against an independent solution of the same dense problem."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import pytest
from scipy import optimize

from figaroh_jax.errors import InputError
from figaroh_jax.estimation.conic import Constraints
from figaroh_jax.estimation.least_squares import (
    Constrained,
    ElasticNet,
    InstrumentalVariables,
    OrdinaryLeastSquares,
    Prior,
    Ridge,
    Robust,
    TotalLeastSquares,
    WeightedByJoint,
    solve,
    with_prior,
)
from figaroh_jax.estimation.regression import Condensed, Piece, condense

NV, K, ROWS = 2, 5, 400
SIGMA = np.array([0.1, 1.0])  # of each joint's noise


class Made(NamedTuple):
    """Rows in place of recordings: `condense` needs no more than names and pieces."""

    X: np.ndarray
    y: np.ndarray
    truth: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        return tuple("abcde")

    def pieces(self, widths: Sequence[float] = (), fitted: bool = True):
        for rows in np.array_split(np.arange(len(self.X)), 3):
            ones = np.ones((len(rows), NV))
            yield Piece(self.X[rows], self.y[rows], ones, rows * 0.01, rows % 5, 0)

    def condensed(self) -> Condensed:
        return condense(self, USED)

    def dense(self, weight: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        root = np.sqrt(np.ones(NV) if weight is None else weight)
        return (self.X * root[:, None]).reshape(-1, K), (self.y * root).ravel()


USED = np.array([[True] * K, [False] + [True] * (K - 1)])


@pytest.fixture(params=range(2))
def made(request: pytest.FixtureRequest) -> Made:
    generator = np.random.default_rng(request.param)
    X = generator.normal(size=(ROWS, NV, K)) * USED * 10.0 ** generator.uniform(-1, 1, K)
    truth = generator.normal(size=K)
    return Made(X, X @ truth + SIGMA * generator.normal(size=(ROWS, NV)), truth)


def test_factors_hold_the_dense_problem(made: Made):
    data = made.condensed()
    X, y = made.dense()
    both = np.column_stack([X, y])
    np.testing.assert_allclose(data.factor().T @ data.factor(), both.T @ both, rtol=1e-12, atol=1e-9)
    theta = made.truth + 1
    np.testing.assert_allclose(data.squares(theta), ((made.y - made.X @ theta) ** 2).sum(0), rtol=1e-12)
    np.testing.assert_allclose(data.torque.sum(0), made.y.sum(0), rtol=0, atol=1e-9)
    part = data.restricted([1, 3]).factor()
    assert np.allclose(part.T @ part, both[:, [1, 3, 5]].T @ both[:, [1, 3, 5]], rtol=1e-12, atol=1e-9)


def test_ordinary_is_numpys(made: Made):
    X, y = made.dense()
    expected = np.linalg.lstsq(X, y, rcond=None)[0]
    np.testing.assert_allclose(solve(made.condensed()).parameters, expected, rtol=1e-10)
    some = solve(made.condensed(), OrdinaryLeastSquares(), kept=[0, 2])
    np.testing.assert_allclose(some.parameters[[0, 2]], np.linalg.lstsq(X[:, [0, 2]], y, rcond=None)[0], rtol=1e-10)
    assert some.parameters[[1, 3, 4]].tolist() == [0, 0, 0]


def test_weighting_by_joint_finds_the_noise_and_is_nearer_to_the_truth(made: Made):
    found = solve(made.condensed(), WeightedByJoint())
    assert found.converged
    np.testing.assert_allclose(1 / np.sqrt(found.weight), SIGMA, rtol=0.15)
    X, y = made.dense(found.weight)
    np.testing.assert_allclose(found.parameters, np.linalg.lstsq(X, y, rcond=None)[0], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(found.rms, SIGMA, rtol=0.15)


def test_a_joint_without_torque_does_not_draw_its_parameters_to_zero(made: Made):
    X = made.X.copy()
    X[:, 1] -= np.outer(X[:, 1] @ made.truth, made.truth * USED[1]) / (made.truth**2 @ USED[1])
    X[:, 1] += 0.01 * np.random.default_rng(7).normal(size=(ROWS, K)) * np.abs(X[:, 1]).std(axis=0) * USED[1]
    found = solve(Made(X, made.y * [1, 0], made.truth).condensed(), WeightedByJoint())
    assert found.weight[1] == found.weight[0]  # by what it leaves it would weigh without end
    np.testing.assert_allclose(found.parameters, made.truth, atol=0.1 * np.abs(made.truth).max())


def test_ridge_and_prior_are_the_normal_equations(made: Made):
    X, y = made.dense()
    length = np.linalg.norm(X, axis=0)
    ridge = np.linalg.solve(X.T @ X + 0.3 * np.diag(length**2), X.T @ y)
    np.testing.assert_allclose(solve(made.condensed(), Ridge(0.3)).parameters, ridge, rtol=1e-9)
    mean, precision = np.arange(5.0), np.array([0.0, 1.0, 10.0, 100.0, 1e4])
    prior = np.linalg.solve(X.T @ X + np.diag(precision), X.T @ y + precision * mean)
    np.testing.assert_allclose(solve(made.condensed(), Prior(mean, precision)).parameters, prior, rtol=1e-9)


@pytest.mark.parametrize("lasso", [1.0, 0.5])
def test_elastic_net_is_scikit_learns_on_all_rows(made: Made, lasso: float):
    from sklearn.linear_model import ElasticNet as Descent

    X, y = made.dense()
    length = np.linalg.norm(X, axis=0)
    most = np.abs((X / length).T @ y).max() / len(y) / lasso
    options = {"l1_ratio": lasso, "fit_intercept": False, "max_iter": 100_000, "tol": 1e-10}
    tall = Descent(alpha=0.2 * most, **options).fit(X / length, y)
    found = solve(made.condensed(), ElasticNet(0.2, lasso)).parameters
    np.testing.assert_allclose(found, tall.coef_ / length, rtol=0, atol=2e-3)
    assert not solve(made.condensed(), ElasticNet(1.0001, lasso)).parameters.any()


@pytest.mark.parametrize("loss", ["huber", "student"])
def test_robust_ignores_outliers_that_move_least_squares(made: Made, loss: Literal["huber", "student"]):
    y = made.y.copy()
    y[::20] += 30.0
    spoilt = made._replace(y=y)
    plain = solve(spoilt.condensed()).parameters
    found = solve(spoilt.condensed(), Robust(loss), regression=spoilt, used=USED)
    assert found.converged
    assert np.linalg.norm(found.parameters - made.truth) < 0.3 * np.linalg.norm(plain - made.truth)


def test_bounds_are_those_of_scipy(made: Made):
    X, y = made.dense()
    lower, upper = made.truth - [0.5, -0.2, 0.5, 0.5, 0.5], made.truth + [0.5, 0.5, -0.1, np.inf, 0.5]
    expected = optimize.lsq_linear(X, y, (lower, upper), tol=1e-14).x
    found = solve(made.condensed(), Constrained(Constraints(lower=lower, upper=upper))).parameters
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


def test_equalities_solve_the_kkt_system_and_inequalities_hold(made: Made):
    X, y = made.dense()
    A, b = np.array([[1.0, 1, 0, 0, 0], [0, 0, 1, -1, 0]]), np.array([0.3, -0.2])
    system = np.block([[X.T @ X, A.T], [A, np.zeros((2, 2))]])
    expected = np.linalg.solve(system, np.concatenate([X.T @ y, b]))[:5]
    found = solve(made.condensed(), Constrained(Constraints(equal=(A, b)))).parameters
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)
    tight = solve(made.condensed(), Constrained(Constraints(at_most=(A, A @ made.truth - 0.1)))).parameters
    np.testing.assert_allclose(A @ tight, A @ made.truth - 0.1, rtol=0, atol=1e-5)


def test_constraints_that_contradict_are_refused(made: Made):
    wrong = Constraints(lower=np.full(5, 1.0), upper=np.full(5, 0.0))
    with pytest.raises(InputError, match="no parameters satisfy"):
        solve(made.condensed(), Constrained(wrong))


def test_total_least_squares_is_the_smallest_singular_vector(made: Made):
    X, y = made.dense()
    direction = np.linalg.svd(np.column_stack([X, y]) / [1, 1, 1, 1, 1, 2.0])[2][-1] / [1, 1, 1, 1, 1, 2.0]
    found = solve(made.condensed(), TotalLeastSquares(np.array([1, 1, 1, 1, 1, 2.0])))
    np.testing.assert_allclose(found.parameters, -direction[:5] / direction[5], rtol=1e-8)


def test_total_least_squares_with_exact_columns_is_least_squares(made: Made):
    found = solve(made.condensed(), TotalLeastSquares(np.array([0, 0, 0, 0, 0, 1.0])))
    np.testing.assert_allclose(found.parameters, solve(made.condensed()).parameters, rtol=1e-9)


def test_instruments_remove_the_bias_of_noisy_columns(made: Made):
    generator = np.random.default_rng(5)
    noisy = made._replace(X=made.X + 0.5 * made.X.std(axis=0) * generator.normal(size=made.X.shape))
    biased = solve(noisy.condensed()).parameters
    method = InstrumentalVariables(made)  # the columns without noise
    found = solve(noisy.condensed(), method, regression=noisy, used=USED).parameters
    assert np.linalg.norm(found - made.truth) < 0.7 * np.linalg.norm(biased - made.truth)


def test_methods_that_need_rows_say_so(made: Made):
    with pytest.raises(InputError, match="Robust looks at single rows"):
        solve(made.condensed(), Robust())


def test_a_prior_is_rows_of_its_own(made: Made):
    factor = with_prior(made.condensed().factor(), np.ones(5), np.full(5, 4.0))
    X, y = made.dense()
    tall = np.concatenate([np.column_stack([X, y]), 2.0 * np.column_stack([np.eye(5), np.ones(5)])])
    np.testing.assert_allclose(factor.T @ factor, tall.T @ tall, rtol=1e-12, atol=1e-9)
