"""Profiles of shapes against finite differences, shapes recovered from noiseless rows, minimisers in a box."""

from __future__ import annotations

import itertools
from typing import Any

import jax
import numpy as np
import pytest
import reference
import robots
from synthetic import made_signals

from figaroh_jax.diagnosis.design import Units, candidates, flattened, shapes, unit_rows, units_and_slopes, with_shape
from figaroh_jax.diagnosis.refit import Whitened, box_minima, profile, refit, refit_shift, shift_profile
from figaroh_jax.diagnosis.shifts import shifted, torque_change
from figaroh_jax.effects.base import Effect, Motion
from figaroh_jax.effects.catalogue import find
from figaroh_jax.estimation.joint_rows import JointRows
from figaroh_jax.recordings.stacked import Records, stack
from figaroh_jax.rigid.dynamics import inverse_dynamics
from figaroh_jax.rigid.model import RobotModel

SECONDS = 8.0


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    return robots.load(robots.ARM, tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def records() -> Records:
    return stack([made_signals(SECONDS)])


@pytest.fixture(scope="module")
def motion(model: RobotModel, records: Records) -> Motion:
    q, v, a = (records.flat(x) for x in (records.position, records.velocity, records.acceleration))
    load = np.asarray(inverse_dynamics(model, q, v, a))
    total = load + 2.0 * v + 3.0 * np.tanh(v / 0.05)
    return Motion(model, records.flat(records.time), q, v, a, load, total, records.dt, np.zeros(2))


def whitened(records: Records, residual: np.ndarray | None = None) -> Whitened:
    """A random residual and a model of three random columns with a prior; rows as they are."""
    n, _, count, nv = records.shape
    rng = np.random.default_rng(0)
    X = rng.standard_normal((nv, n, count, 3))
    tall = X.reshape(-1, 3)
    inverse = np.linalg.inv(tall.T @ tall + np.diag([1.0, 10.0, 0.1]))
    residual = rng.standard_normal((nv, n, count)) if residual is None else residual
    return Whitened(
        residual, JointRows.of(X.reshape(nv, n * count, 3)), inverse, np.ones((len(np.asarray(records.omega)), nv))
    )


def at_joint(name: str, *, joint: float = 0, **shape: float) -> Effect:
    effect = find(name)
    where = np.array([int(joint)] if effect.acts_on == "joint" else [], dtype=np.int64)
    return effect(where, **{key: np.float64(value) for key, value in shape.items()})


def batch_of(effect: Effect, count: int) -> Any:
    return jax.tree.map(lambda x: np.stack([np.asarray(x)] * count), effect)


def columns_of(effect: Effect, motion: Motion, records: Records, rows: Whitened) -> tuple[np.ndarray, np.ndarray]:
    """Whitened columns of one effect with a shape, and their slopes."""
    batch, names = batch_of(effect, 1), shapes(type(effect))
    torque, slope = units_and_slopes(batch, np.stack([getattr(batch, n) for n in names], axis=1), motion)
    both = np.concatenate([torque[:, None], slope], axis=1)[0]
    parts = unit_rows(Units(both, np.repeat(batch.at, len(both), axis=0)), records, rows.whitening)
    return parts[0], parts[1:]


@pytest.mark.parametrize(
    ("name", "shape", "value"),
    [("stribeck_friction", "speed", 0.13), ("power_law_friction", "exponent", 1.7), ("torque_ripple", "order", 7.1)],
)
def test_gradient_of_the_profile_is_that_of_finite_differences(
    motion: Motion, records: Records, name: str, shape: str, value: float
) -> None:
    effect, rows = at_joint(name, **{shape: value}), whitened(records)

    def both(x: float) -> tuple[np.ndarray, np.ndarray]:
        return profile(*columns_of(with_shape(effect, [shape], [np.float64(x)]), motion, records, rows), [0], rows)

    (slope,) = both(value)[1]
    step = 2e-3 * value
    # five points: the error of the step is of fourth order, that of rounding 1e-12
    offsets, weights = np.array([-2.0, -1.0, 1.0, 2.0]), np.array([1.0, -8.0, 8.0, -1.0]) / 12
    values = [both(value + k * step)[0] for k in offsets]
    np.testing.assert_allclose(slope, weights @ values / step, rtol=0, atol=1e-6 * abs(slope))


def test_profile_is_the_change_of_the_penalised_squares(motion: Motion, records: Records) -> None:
    effect, rng = at_joint("torque_ripple", joint=1, order=6.0), np.random.default_rng(1)
    precision = np.array([1.0, 10.0, 0.1])
    rows = whitened(records)
    X, y = rows.X.dense().reshape(-1, 3), rng.standard_normal(np.asarray(rows.residual).size)
    root = np.diag(np.sqrt(precision))
    theta = np.linalg.lstsq(np.vstack([X, root]), np.append(y, np.zeros(3)), rcond=None)[0]
    residual = (y - X @ theta).reshape(np.asarray(rows.residual).shape)
    Z, slope = columns_of(effect, motion, records, rows)
    value, _ = profile(Z, slope, [1], rows._replace(residual=residual))
    full = np.zeros((2, 2, residual[0].size))
    full[:, 1] = Z.reshape(2, -1)
    stacked = np.hstack([np.vstack([X, root]), np.vstack([full.reshape(2, -1).T, np.zeros((3, 2))])])
    right = np.append(y, np.zeros(3))
    after = right - stacked @ np.linalg.lstsq(stacked, right, rcond=None)[0]
    before = right - np.vstack([X, root]) @ theta
    np.testing.assert_allclose(value, after @ after - before @ before, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "shape", "starts", "truth", "error"),
    [
        ("stribeck_friction", "speed", (0.06, 0.1, 0.15, 0.25), 0.122, 2e-3),
        ("torque_ripple", "order", (6.2, 7.0, 7.8, 8.6), 7.35, 2e-3),
    ],
)
def test_refit_finds_the_shape_that_made_noiseless_rows(
    motion: Motion, records: Records, name: str, shape: str, starts: tuple[float, ...], truth: float, error: float
) -> None:
    made = at_joint(name, **{shape: truth})
    rows = whitened(records)
    Z, _ = columns_of(made, motion, records, rows)
    amplitudes = np.array([3.0, -1.0])[: len(Z)]
    residual = np.zeros(rows.residual.shape)
    residual[0] = np.tensordot(amplitudes, Z[:, 0], 1)
    effects = with_shape(batch_of(at_joint(name), len(starts)), [shape], [np.array(starts)])
    found, columns = refit(effects, motion, records, less_the_model(rows, residual))
    np.testing.assert_allclose(getattr(found, shape), truth, rtol=0, atol=error)
    np.testing.assert_allclose(columns, Z, rtol=0, atol=0.02 * np.abs(Z).max())


def less_the_model(rows: Whitened, residual: np.ndarray) -> Whitened:
    """The rows with what the model leaves of a residual."""
    X = rows.X.dense().reshape(-1, rows.X.width)
    taken = X @ rows.inverse @ (X.T @ residual.reshape(-1))
    return rows._replace(residual=residual - taken.reshape(residual.shape))


@pytest.mark.parametrize(("truth", "error"), [(5e-5, 0.01), (3e-4, 0.01), (2.4e-3, 0.025), (4e-3, 0.05)])
def test_the_compliance_that_made_noiseless_rows_is_found(
    motion: Motion, records: Records, truth: float, error: float
) -> None:
    """Rows of the true motion, of which the search knows one step of Newton's method."""
    made, rows = at_joint("joint_elasticity", joint=1, compliance=truth), whitened(records)
    effects = flattened(batch_of(candidates(find("joint_elasticity"), motion.model), 1))
    effects = jax.tree.map(lambda x: x[1], effects)

    def changes(effects: Effect) -> np.ndarray:
        change = np.swapaxes(torque_change(effects, motion, records), 1, 2)[:, None]
        joints = np.tile([0, 1], (len(change), 1))
        return unit_rows(Units(change, joints), records, rows.whitening).reshape(len(change), 2, -1)

    residual = changes(batch_of(made, 1))[0].reshape(rows.residual.shape)
    rows = less_the_model(rows, residual)
    sizes = np.asarray(effects.compliance)  # pyright: ignore
    found = refit_shift(effects, changes(effects) / sizes[:, None, None], motion, records, rows)
    np.testing.assert_allclose(found.compliance, truth, rtol=error, atol=0)  # pyright: ignore
    tried = with_shape(batch_of(made, 3), ["compliance"], [truth * np.array([0.99, 1.0, 1.01])])
    low, best, high = shift_profile(changes(tried), rows)
    assert best < low and best < high


def test_the_true_motion_solves_the_equation_of_the_elastic_joint(motion: Motion, records: Records) -> None:
    compliance = 1e-3
    effect: Any = jax.tree.map(lambda x: np.asarray(x)[None], at_joint("joint_elasticity", compliance=compliance))
    inner = slice(200, -200)

    def missing(turns: int) -> float:
        true = shifted(effect, motion, records, turns)
        q, v, a = (np.asarray(x)[0] for x in (true.position, true.velocity, true.acceleration))
        load = reference.inverse_dynamics(motion.model, q, v, a)
        wound = np.asarray(motion.position) - q
        np.testing.assert_array_equal(wound[:, 1], 0.0)
        return float(np.std((wound[:, 0] - compliance * load[:, 0])[inner]) / np.std(wound[inner, 0]))

    left, first = missing(3), missing(0)
    assert left < 0.02 and left < 0.4 * first, (left, first)


def quadratic(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((3, 3))
    return root @ root.T + 0.5 * np.eye(3), 3 * rng.standard_normal(3)


def box_minimum(A: np.ndarray, b: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Minimiser of x'Ax/2 - b'x in the box: the best feasible one of all sets of active bounds."""
    best, lowest = lower, np.inf
    for state in itertools.product((-1, 0, 1), repeat=len(b)):
        side = np.array(state)
        x, free = np.where(side < 0, lower, upper), side == 0
        if free.any():
            x[free] = np.linalg.solve(A[np.ix_(free, free)], b[free] - A[np.ix_(free, ~free)] @ x[~free])
        value = x @ A @ x / 2 - b @ x
        if np.all((x >= lower - 1e-12) & (x <= upper + 1e-12)) and value < lowest:
            best, lowest = x, value
    return best


@pytest.mark.parametrize("seed", [0, 3])
def test_box_minima_follow_a_narrow_valley_to_its_end(seed: int) -> None:
    # a force at a point: its lever trades with its size along the valley, whose walls are the rows of a small joint
    turn, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    A, end = turn @ np.diag([1.0, 30.0, 1e3]) @ turn.T, np.array([0.52, 0.47, 0.61])

    def valley(x: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        off = x[0] - end
        return np.array([off @ A @ off / 2]), (A @ off)[None]

    found, _ = box_minima(valley, np.array([[0.5, 0.5, 0.2]]))
    np.testing.assert_allclose(found[0], end, rtol=0, atol=1e-3)


def test_box_minima_are_those_of_quadratics_in_the_box() -> None:
    made, asked = [quadratic(seed) for seed in range(6)], []

    def function(x: np.ndarray, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        asked.append(np.array(x))
        each = [(x[k] @ A @ x[k] / 2 - b @ x[k] - 1e3 * k, A @ x[k] - b) for k, (A, b) in enumerate(made) if k in some]
        return np.array([value for value, _ in each]), np.stack([slope for _, slope in each])

    for one, (A, b) in enumerate(made):  # one that stands above another by far is left where it is

        def alone(
            x: np.ndarray, some: np.ndarray, A: np.ndarray = A, b: np.ndarray = b
        ) -> tuple[np.ndarray, np.ndarray]:
            return np.array([x[0] @ A @ x[0] / 2 - b @ x[0]]), (A @ x[0] - b)[None]

        found, least = box_minima(alone, np.array([[0.1, 0.2, 0.3]]))
        expected = box_minimum(A, b, np.zeros(3), np.ones(3))
        np.testing.assert_allclose(found[0], expected, rtol=0, atol=2e-3)
        assert least[0] == pytest.approx(expected @ A @ expected / 2 - b @ expected, abs=1e-5), one
    found, least = box_minima(function, np.tile([0.1, 0.2, 0.3], (6, 1)))
    best = int(np.argmin(least))
    np.testing.assert_allclose(found[best], box_minimum(*made[best], np.zeros(3), np.ones(3)), rtol=0, atol=2e-3)
    assert all(np.all((x >= 0) & (x <= 1)) for x in asked)
