"""Deviations of causes where the model is wrong: they count how far values move with the weights of the rows."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from figaroh_jax.diagnosis import joint as fits
from figaroh_jax.diagnosis.estimates import Fitted
from figaroh_jax.diagnosis.joint import AS_SURE, Joint, least_sure, with_misfit, with_parts, with_rest
from figaroh_jax.effects.base import Effect
from figaroh_jax.effects.catalogue import find
from figaroh_jax.estimation.joint_rows import JointRows
from figaroh_jax.estimation.rows import Prior, Rows

SHARE = 0.25  # correlation of the two values


def law() -> Effect:
    return find("power_law_friction")(np.array([0]), **{"strength": np.float64(1.0), "exponent": np.float64(2.0)})


def stood(value: list[float], deviation: list[float], at_shape: float = 1.0) -> Any:
    """A power law's strength and exponent, with its strength at the exponent that stands."""
    covariance = np.outer(deviation, deviation) * (np.eye(2) + SHARE * (1 - np.eye(2)))
    step = SimpleNamespace(state=SimpleNamespace(theta=np.array([at_shape])))
    return SimpleNamespace(step=step, causes=[law()], fitted=Fitted(np.array(value), covariance, ((0, 1),)))


def fitted_beside(monkeypatch: pytest.MonkeyPatch, *others: Any) -> Fitted:
    """The fit of values (1, 2) with deviations (.1, .2), beside others by other weights."""
    own, left = stood([1.0, 2.0], [0.1, 0.2]), list(others)
    monkeypatch.setattr(fits, "solved", lambda start, theta: start)
    monkeypatch.setattr(fits, "_together", lambda problem, base, causes, whitening: left.pop(0))
    problem: Any = SimpleNamespace(weighted=lambda weight: problem)
    start, nothing = cast(Any, SimpleNamespace(theta=np.zeros(2))), np.zeros(1)
    joint = Joint(own.step, own.causes, own.fitted)
    return with_misfit(problem, start, joint, [(nothing, nothing)] * len(others)).fitted


def widened(monkeypatch: pytest.MonkeyPatch, *others: Any) -> np.ndarray:
    """Covariance of that fit."""
    return fitted_beside(monkeypatch, *others).covariance


def test_a_value_that_moves_with_the_weights_is_as_unsure_as_it_moves(monkeypatch: pytest.MonkeyPatch):
    found = widened(monkeypatch, stood([1.3, 2.0], [0.1, 0.2]), stood([1.0, 2.0], [0.15, 0.2]))
    np.testing.assert_allclose(np.sqrt(np.diag(found)), [np.hypot(0.1, 0.3 / np.sqrt(2)), 0.2], rtol=1e-12)
    assert found[0, 1] == pytest.approx(SHARE * 0.1 * 0.2)  # the move is of the first value alone


def test_values_that_move_together_are_unsure_together(monkeypatch: pytest.MonkeyPatch):
    found = widened(monkeypatch, stood([1.5, 3.0], [0.1, 0.2]))
    np.testing.assert_allclose(found[0, 1], SHARE * 0.1 * 0.2 + 0.5 * 1.0, rtol=1e-12)


def test_a_fit_that_says_little_of_a_value_moves_its_deviation_little(monkeypatch: pytest.MonkeyPatch):
    found = widened(monkeypatch, stood([5.0, 2.0], [100.0, 0.2]))
    np.testing.assert_allclose(found[0, 0], 0.1**2 + (AS_SURE * 0.1 * 4.0 / 100.0) ** 2, rtol=1e-12)


def test_rows_that_say_nothing_of_a_value_leave_its_deviation(monkeypatch: pytest.MonkeyPatch):
    found = widened(monkeypatch, stood([np.nan, 2.0], [np.inf, 0.2]))
    np.testing.assert_allclose(np.sqrt(np.diag(found)), [0.1, 0.2], rtol=1e-12)


def test_an_amplitude_is_known_at_its_shape_as_far_as_it_moves_there(monkeypatch: pytest.MonkeyPatch):
    """Strength and exponent that trade with each other: at the exponent that is told the strength stays."""
    found = fitted_beside(monkeypatch, stood([3.0, 1.0], [0.1, 0.2], at_shape=1.05)).at_shapes
    assert found is not None
    given = 0.1**2 * (1 - SHARE**2)  # of two Gaussians of that correlation, one known
    np.testing.assert_allclose(found[0, 0], given + 0.05**2, rtol=1e-9)
    told = Fitted(np.array([1.0, 2.0]), np.diag([9.0, 9.0]), ((0, 1),), found)
    none: Any = None
    assert least_sure(Joint(none, [law()], told)) is None
    assert least_sure(Joint(none, [law()], Fitted(told.value, told.covariance, told.places))) == 0


def test_values_are_as_unsure_as_parts_of_the_data_disagree():
    """Against least squares without each part in turn (NumPy), with a residual that each part pulls another way."""
    rng = np.random.default_rng(5)
    X, truth, part = rng.normal(size=(2, 60, 3)), np.array([1.0, -2.0, 0.5]), np.repeat(np.arange(3), 20)
    pull = np.array([[0.4, -0.3, 0.0], [-0.5, 0.2, 0.0], [0.1, 0.1, 0.0]])
    y = X @ truth + np.einsum("jtp,tp->jt", X, pull[part]) + 0.01 * rng.normal(size=(2, 60))

    def solution(rows: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(X[:, rows].reshape(-1, 3), y[:, rows].reshape(-1), rcond=None)[0]

    each = np.stack([solution(part != k) for k in range(3)])
    jackknife = np.sqrt(2 / 3 * ((each - each.mean(0)) ** 2).sum(0))
    rows = Rows(y, JointRows.of(X), JointRows.of(X), np.zeros((0, 60), int), np.ones((2, 60)), part, part)
    theta = solution(part >= 0)
    state = SimpleNamespace(theta=theta, prior=Prior(np.zeros(3), np.full(3, 1e-9)))
    step: Any = SimpleNamespace(rows=rows, state=state)
    deviation = np.array([1e-3, 1e-3, 1.0])  # the last is wider already
    joint = Joint(step, [], Fitted(theta, np.diag(deviation**2), ()))
    problem: Any = SimpleNamespace(layout=SimpleNamespace(part=part))
    found = np.sqrt(np.diag(with_parts(problem, joint, np.ones((1, 2))).fitted.covariance))
    np.testing.assert_allclose(found[:2], jackknife[:2], rtol=1e-6)
    assert found[2] == deviation[2] > jackknife[2]


def test_a_value_that_one_part_alone_shows_is_as_sure_as_there():
    """Without that part nothing is known of it: the others' fit of it is no second opinion."""
    rng = np.random.default_rng(7)
    X, part = rng.normal(size=(1, 80, 2)), np.repeat(np.arange(4), 20)
    X[..., 1] *= part == 2
    y = X @ [1.0, 2.0] + 0.1 * rng.normal(size=(1, 80))
    theta = np.linalg.lstsq(X[0], y[0], rcond=None)[0]
    rows = Rows(y, JointRows.of(X), JointRows.of(X), np.zeros((0, 80), int), np.ones((1, 80)), part, part)
    state = SimpleNamespace(theta=theta, prior=Prior(np.zeros(2), np.full(2, 1e-9)))
    step: Any = SimpleNamespace(rows=rows, state=state)
    covariance = 0.01 * np.linalg.inv(X[0].T @ X[0])
    problem: Any = SimpleNamespace(layout=SimpleNamespace(part=part))
    told = with_parts(problem, Joint(step, [], Fitted(theta, covariance, ())), np.ones((1, 2))).fitted.covariance
    assert 1.0 <= told[1, 1] / covariance[1, 1] < 4.0


def test_values_are_as_unsure_as_what_is_left_at_their_joint(monkeypatch: pytest.MonkeyPatch):
    """A misfit of ten functions of equal size, of which one is the cause's: it moves by what one of them has."""
    rng = np.random.default_rng(8)
    functions, base = np.linalg.qr(rng.normal(size=(400, 11)))[0].T, rng.normal(size=(400, 1))
    X = np.stack([np.column_stack([base, functions[:1].T]), np.zeros((400, 2))])  # the second joint has none of it
    signs = rng.choice([-1.0, 1.0], 11)
    y = X[0] @ np.array([2.0, 5.0]) + 0.3 * signs @ functions
    theta, (squares,) = np.linalg.lstsq(X[0], y, rcond=None)[:2]
    step: Any = SimpleNamespace(
        rows=SimpleNamespace(X=JointRows.of(X)), state=SimpleNamespace(prior=Prior(np.zeros(2), np.full(2, 1e-9)))
    )
    monkeypatch.setattr(fits, "torque_slopes", lambda *args: [])
    none: Any = None
    joint = Joint(step, [none], Fitted(theta, np.diag([1e-8, 1e-8]), ((1,),)))
    told = with_rest(none, joint, np.ones((1, 2)), [(0,)], np.array([squares, 1e6])).fitted.covariance
    assert np.sqrt(told[1, 1]) == pytest.approx(abs(theta[1] - 5.0), rel=0.1)
    assert told[0, 0] == 1e-8  # no cause's


def test_a_value_that_no_row_shows_is_as_unsure_as_can_be():
    """... and no NaN: its scores are zero, which says nothing of how sure it is."""
    rows: Any = SimpleNamespace(size=100)
    covariance, inverse = np.array([[0.04, 0.0], [0.0, 0.0]]), np.diag([0.01, 1e24])
    found = fits._widened(covariance, inverse, rows, np.ones((1, 100)), 2)
    np.testing.assert_allclose(np.sqrt(np.diag(found)), [0.2, 1e12], rtol=0.02)
    assert np.isfinite(found).all() and found[0, 1] == 0
