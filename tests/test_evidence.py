"""Fit, scores and their null distributions against least squares on stacked rows, closed forms and simulated truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, kstest, norm
from synthetic import made_rows

from figaroh_jax.diagnosis import evidence
from figaroh_jax.diagnosis.bank import Columns, bank
from figaroh_jax.diagnosis.floor import kept_columns
from figaroh_jax.estimation.rows import Linear, Prior, Rows, fit, instruments

NV, COUNT, WIDTH = 2, 90, 4
PRIOR = Prior(np.array([0.5, -1.0, 0.0, 2.0]), np.array([3.0, 0.5, 40.0, 1e-3]))


def random_rows(seed: int = 0) -> Rows:
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(NV, COUNT, WIDTH)) * [1.0, 0.1, 5.0, 1.0]
    return made_rows(rng.normal(size=(NV, COUNT)), X)


def random_columns(k: int, joints: tuple[int, ...] = (0, 1), grid: int = 2, seed: int = 1) -> Columns:
    Z = np.random.default_rng(seed).normal(size=(grid, k, len(joints), COUNT))
    return Columns(joints, Z)


def least_squares(y: np.ndarray, X: np.ndarray, prior: Prior, Z: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Coefficients and penalised squares from rows of data and prior in one stack; `Z` (rows, k) has no prior."""
    tall = X.reshape(-1, X.shape[-1])
    root = np.sqrt(prior.precision)
    stacked = np.vstack([tall, np.diag(root)])
    if Z is not None:
        stacked = np.hstack([stacked, np.vstack([Z, np.zeros((len(root), Z.shape[1]))])])
    right = np.append(y.reshape(-1), root * prior.mean)
    theta = np.linalg.lstsq(stacked, right, rcond=None)[0]
    return theta, float(((right - stacked @ theta) ** 2).sum())


def spread(columns: Columns, point: int) -> np.ndarray:
    """Columns of one grid point as (rows of all joints, k)."""
    full = np.zeros((columns.Z.shape[1], NV, COUNT))
    full[:, list(columns.joints)] = columns.Z[point]
    return full.reshape(len(full), -1).T


def own_scores(rows: Rows, linear: Linear, columns: Columns) -> np.ndarray:
    """Z'r of each grid point, one after another."""
    points = [spread(columns, g).T @ linear.residual.reshape(-1) for g in range(len(columns.Z))]
    return np.concatenate(points)


def test_fit_is_the_least_squares_solution_with_the_prior_as_rows() -> None:
    rows = random_rows()
    linear = fit(rows, PRIOR)
    theta, _ = least_squares(rows.y, rows.X.dense(), PRIOR)
    np.testing.assert_allclose(linear.theta, theta, rtol=0, atol=1e-10)
    np.testing.assert_allclose(linear.residual, rows.y - rows.X.dense() @ theta, rtol=0, atol=1e-9)


def test_a_column_that_nothing_excites_keeps_its_prior_value() -> None:
    rows = random_rows()
    X = rows.X.dense()
    X[:, :, 2] = 0.0
    rows = made_rows(rows.y, X)
    prior = PRIOR._replace(mean=np.array([0.0, 0.0, 7.0, 0.0]))
    np.testing.assert_allclose(fit(rows, prior).theta[2], 7.0, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("k", "joints"), [(1, (0, 1)), (1, (1,)), (3, (0, 1)), (3, (0,))])
def test_score_is_the_drop_in_penalised_squares_when_the_columns_are_added(k: int, joints: tuple[int, ...]) -> None:
    rows, columns = random_rows(), random_columns(k, joints)
    linear, stock = fit(rows, PRIOR), bank(rows, [random_columns(2, (1,), seed=5), columns])
    found = evidence.scores(linear, stock, evidence.projection(linear, stock))[1]
    _, before = least_squares(rows.y, rows.X.dense(), PRIOR)
    drops = [before - least_squares(rows.y, rows.X.dense(), PRIOR, spread(columns, g))[1] for g in range(2)]
    np.testing.assert_allclose(found.Q, drops, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found.rank, k)


def test_a_candidate_inside_the_model_scores_nothing() -> None:
    rows, flat = random_rows(), Prior(np.zeros(WIDTH), np.zeros(WIDTH))
    inside = Columns((0, 1), (rows.X.dense() @ [1.0, 2.0, -1.0, 0.5])[None, None])
    linear, stock = fit(rows, flat), bank(rows, [inside])
    (found,) = evidence.scores(linear, stock, evidence.projection(linear, stock))
    assert found.rank[0] == 0


def test_columns_that_are_rounding_of_zero_count_as_no_direction() -> None:
    rows, columns = random_rows(), random_columns(2)
    rounding = 1e-14 * np.random.default_rng(7).normal(size=(2, 3, NV, COUNT))
    wider = Columns((0, 1), np.concatenate([columns.Z[:, :1], rounding, columns.Z[:, 1:]], axis=1))
    linear, stock = fit(rows, PRIOR), bank(rows, [wider])
    (found,) = evidence.scores(linear, stock, evidence.projection(linear, stock))
    _, before = least_squares(rows.y, rows.X.dense(), PRIOR)
    drops = [before - least_squares(rows.y, rows.X.dense(), PRIOR, spread(columns, g))[1] for g in range(2)]
    np.testing.assert_array_equal(found.rank, 2)
    np.testing.assert_allclose(found.Q, drops, rtol=0, atol=1e-9)


@pytest.mark.parametrize("k", [1, 3])
def test_score_is_chi_square_when_there_is_only_noise(k: int) -> None:
    rng, rows, columns = np.random.default_rng(3), random_rows(), random_columns(k, grid=1)
    prior = PRIOR._replace(precision=np.array([3.0, 0.5, 40.0, 1.0]))
    Q = []
    for _ in range(600):
        theta = prior.mean + rng.standard_normal(WIDTH) / np.sqrt(prior.precision)
        drawn = rows._replace(y=rows.X @ theta + rng.standard_normal(rows.y.shape))
        linear, stock = fit(drawn, prior), bank(drawn, [columns])
        Q.append(evidence.scores(linear, stock, evidence.projection(linear, stock))[0].Q[0])
    assert abs(np.mean(Q) - k) < 4 * np.sqrt(2 * k / len(Q))
    assert kstest(Q, chi2(k).cdf).pvalue > 1e-4  # pyright: ignore[reportAttributeAccessIssue]


def test_score_with_noisy_instruments_is_chi_square_when_there_is_only_noise() -> None:
    rng, count, flat, Q = np.random.default_rng(8), 400, Prior(np.zeros(2), np.zeros(2)), []
    truth = np.tile(rng.normal(size=(count // 2, 2)), (2, 1))
    alike = 0.9 * np.stack([truth[:, 0], truth[:, 1], truth[:, 0] - truth[:, 1]]) + 0.3 * rng.normal(size=(3, count))
    X = truth + 0.7 * rng.normal(size=truth.shape)
    candidate = Columns((0,), alike[None, :, None])
    for _ in range(600):
        rows = made_rows(rng.standard_normal((1, count)), X[None], repeats=True)
        linear, stock = fit(rows, flat), bank(rows, [candidate])
        Q.append(evidence.scores(linear, stock, evidence.projection(linear, stock))[0].Q[0])
    assert abs(np.mean(Q) - 3) < 4 * np.sqrt(2 * 3 / len(Q))


def noisy_repeats(rng: np.random.Generator, count: int = 20000) -> tuple[Rows, Columns]:
    """One column of size 1 that two repeats see each with its own noise, and a candidate that looks like it."""
    truth = np.tile(rng.normal(size=count // 2), 2)
    alike = 0.9 * truth + np.sqrt(1 - 0.9**2) * np.tile(rng.normal(size=count // 2), 2)
    seen = truth + 0.1 * rng.normal(size=count)
    y = truth + rng.normal(size=count)
    return made_rows(y[None], seen[None, :, None], repeats=True), Columns((0,), alike[None, None, None])


def plain(rows: Rows) -> Rows:
    return rows._replace(Xi=rows.X, partner=rows.partner[:0])


@pytest.mark.parametrize("feedback", [0.0, 0.8])
def test_instruments_from_a_repeat_remove_the_bias_of_noisy_columns(feedback: float) -> None:
    """Also where a controller answers the noise of the encoder, so that the torque holds a share of it."""
    rng, flat, count = np.random.default_rng(4), Prior(np.zeros(1), np.zeros(1)), 40000
    truth, own = np.tile(rng.normal(size=count // 2), 2), 0.5 * rng.normal(size=count)
    torque = 2.0 * truth + feedback * own + 0.1 * rng.normal(size=count)
    rows = made_rows(torque[None], (truth + own)[None, :, None], repeats=True)
    error = 6 * 1.25 / np.sqrt(count)
    biased = (2.0 + 0.25 * feedback) / 1.25  # truth has power 1, the noise 0.25
    np.testing.assert_allclose(fit(plain(rows), flat).theta, biased, rtol=0, atol=error)
    np.testing.assert_allclose(fit(rows, flat).theta, 2.0, rtol=0, atol=error)


def test_noisy_columns_raise_the_score_of_what_looks_alike_only_without_instruments() -> None:
    rng, flat = np.random.default_rng(5), Prior(np.zeros(1), np.zeros(1))
    Q: dict[str, list[float]] = {"plain": [], "instruments": []}
    for _ in range(80):
        rows, candidate = noisy_repeats(rng)
        for name, one in (("plain", plain(rows)), ("instruments", rows)):
            linear, stock = fit(one, flat), bank(one, [candidate])
            Q[name].append(evidence.scores(linear, stock, evidence.projection(linear, stock))[0].Q[0])
    # noise 0.01 of the power: the score of a column with cosine 0.9 grows by 20000 (0.9 0.01)^2 / (1 - 0.9^2)
    assert np.mean(Q["plain"]) == pytest.approx(1 + 20000 * 0.009**2 / 0.19, rel=0, abs=3.0)
    assert abs(np.mean(Q["instruments"]) - 1) < 4 * np.sqrt(2 / 80)


def test_instruments_are_the_mean_over_the_other_repeats_and_zero_without_one() -> None:
    Z = np.arange(12.0).reshape(2, 6)
    partner = np.array([[2, 3, 4, 5, 0, -1], [4, 5, 0, -1, 2, -1]])
    paired = np.array([1.0, 1, 1, 1, 0, 0])
    expected = np.stack([[(z[2] + z[4]) / 2, (z[3] + z[5]) / 2, (z[4] + z[0]) / 2, z[5], 0, 0] for z in Z])
    np.testing.assert_allclose(instruments(Z, partner, paired), expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("prior", [PRIOR, Prior(np.zeros(WIDTH), np.zeros(WIDTH))], ids=["prior", "flat"])
def test_block_scores_sum_to_the_score(prior: Prior) -> None:
    rows, columns = random_rows(), [random_columns(3), random_columns(1, (1,), seed=7)]
    linear, stock = fit(rows, prior), bank(rows, columns)
    parts = evidence.block_scores(rows, linear, stock, evidence.projection(linear, stock))
    expected = np.concatenate([own_scores(rows, linear, one) for one in columns])
    assert len(parts) == rows.block.max() + 1 + WIDTH
    np.testing.assert_allclose(parts.sum(0), expected, rtol=0, atol=1e-9)


def test_scores_of_the_residual_drawn_again_are_the_scores() -> None:
    rows, columns = random_rows(), random_columns(3)
    linear, stock = fit(rows, PRIOR), bank(rows, [columns])
    H = evidence.projection(linear, stock)
    drawn = np.stack([linear.residual, 0 * linear.residual])
    prior = np.stack([linear.pull, 0 * linear.pull])
    again = evidence.other_scores(rows, H, drawn, evidence.pulled(columns, stock.parts[0], drawn), prior)
    np.testing.assert_allclose(again[0], own_scores(rows, linear, columns), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(again[1], 0.0)
    found = evidence.scores(linear, stock, H)
    np.testing.assert_allclose(evidence.largest(stock.span, found, again)[0], found[0].z.max(), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("k", "error"), [(1, 0.2), (2, 0.12), (3, 0.09), (10, 0.04)])
def test_wilson_hilferty_gives_the_normal_quantile_of_a_chi_square(k: int, error: float) -> None:
    tail = np.array([0.3, 0.1, 0.01, 1e-3, 1e-4])
    z = evidence.wilson_hilferty(chi2.isf(tail, k), np.full(len(tail), k))
    np.testing.assert_allclose(z, norm.isf(tail), rtol=0, atol=error)


def test_masked_rows_do_not_count() -> None:
    rows = random_rows()
    rows.y[0, :10] = 0.0
    assert rows.size == NV * COUNT - 10


@pytest.mark.parametrize("repeats", [False, True])
def test_a_bank_beside_more_columns_is_the_bank_made_anew(repeats: bool) -> None:
    rng = np.random.default_rng(8)
    y, X = rng.normal(size=(NV, COUNT)), rng.normal(size=(NV, COUNT, WIDTH + 2))
    candidates = [random_columns(2, (1,), seed=5), random_columns(1, seed=6)]
    first, grown = (made_rows(y, x, repeats=repeats) for x in (X[..., :WIDTH], X))
    before, anew = bank(first, candidates), bank(grown, candidates)
    found = bank(grown, candidates, before)
    for ours, theirs in ((found.ZX, anew.ZX), (found.ZXi, anew.ZXi)):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)


def test_columns_that_the_model_has_already_do_not_come_in_again() -> None:
    rows, rng = random_rows(), np.random.default_rng(12)
    family = random_columns(3, grid=1, seed=13)
    again = rows.X.dense() @ [0.0, 1.0, 0.0, -2.0]  # what two columns of the model say, and rounding
    Z = np.concatenate([family.Z, (again + 1e-10 * rng.normal(size=again.shape))[None, None]], axis=1)
    own = Columns((0, 1), Z[:, rng.permutation(4)])
    weak = Prior(np.zeros(WIDTH), np.full(WIDTH, 1e-8))
    linear = fit(rows, weak)
    stock = bank(rows, [own])
    (score,) = evidence.scores(linear, stock, evidence.projection(linear, stock))
    kept = spread(own, 0) @ kept_columns(score.root[0])
    assert kept.shape[1] == 3
    X = rows.X.dense().reshape(-1, WIDTH)
    left = kept - X @ np.linalg.lstsq(X, kept, rcond=None)[0]
    np.testing.assert_allclose(left.T @ left, np.eye(3), rtol=0, atol=1e-6)
    span = np.linalg.qr(np.hstack([X, spread(family, 0)]))[0]
    np.testing.assert_allclose(span @ (span.T @ kept), kept, rtol=0, atol=1e-5)  # none is lost
