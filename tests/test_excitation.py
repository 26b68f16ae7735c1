"""Designed motions: bases, information, gradients, limits at 1 kHz; compared with Pinocchio and finite differences."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
import reference
import robots

from figaroh_jax.errors import InputError
from figaroh_jax.excitation import information as info
from figaroh_jax.excitation.design import excite
from figaroh_jax.excitation.interior import _Curved
from figaroh_jax.excitation.limits import limits_of
from figaroh_jax.excitation.motions import Basis, Trajectory, fourier, quintic, spline
from figaroh_jax.excitation.objectives import (
    condition_objective,
    information_objective,
    own_objective,
    prediction_objective,
    smooth_condition_objective,
)
from figaroh_jax.excitation.programming import Rows, drawn_in, quadratic_step
from figaroh_jax.excitation.sampling import Sampler
from figaroh_jax.excitation.search import random_motion
from figaroh_jax.excitation.solvers import Problem, solve, within
from figaroh_jax.formats.config import Baseline
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.rigid.regressor_gradient import pullback_rows

BASES = [fourier(3, 0.5, 4.0), spline(5, 4.0), quintic(4, 4.0)]
ARM = robots.robot(
    *robots.LINKS[:3],
    robots.joint("turn", "base", "a", axis="1 2 -1", more='<limit lower="-2" upper="2" velocity="2" effort="60"/>'),
    robots.joint("bend", "a", "b", axis="0 1 1", more='<limit lower="-1.5" upper="2" velocity="3" effort="20"/>'),
)
COUPLED = robots.robot(
    *robots.LINKS[:4],
    robots.joint("hip", "base", "a", axis="0 1 0"),
    robots.joint("finger", "a", "b", "prismatic", "1 1 0", more=robots.LIMIT),
    robots.joint("copy", "b", "c", axis="1 0 1", more='<mimic joint="hip" multiplier="-1.5" offset="0.3"/>'),
)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    return robots.load(ARM, tmp_path_factory.mktemp("arm"))


def a_motion(model: RobotModel, basis: Basis = BASES[0], seed: int = 0) -> Trajectory:
    generator = np.random.default_rng(seed)
    return Trajectory(0.3 * generator.normal(size=model.nv), generator.normal(size=(model.nv, basis.size)), basis)


@pytest.mark.parametrize("basis", BASES, ids=lambda basis: basis.kind)
def test_velocity_and_acceleration_are_the_derivatives_of_a_motion_that_begins_and_ends_at_rest(basis: Basis):
    time, h = np.linspace(0.1, 3.9, 57), 1e-5
    before, now, after = (basis.at(time + s * h) for s in (-1, 0, 1))
    np.testing.assert_allclose((after[:2] - before[:2]) / (2 * h), now[1:], rtol=0, atol=1e-5)
    ends = basis.at(np.array([0.0, basis.duration]))
    np.testing.assert_allclose(ends[0, 0], 0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ends[1:], 0, rtol=0, atol=1e-9)


def test_times_of_peaks_hold_the_largest_values_of_a_quintic():
    basis, weights = quintic(4, 4.0), np.random.default_rng(0).normal(size=3)
    dense = np.abs(basis.at(np.linspace(0, 4, 40001)) @ weights).max(axis=1)
    told = [np.abs(basis.at(times)[k] @ weights).max() for k, times in enumerate(basis.peaks(1.0))]
    np.testing.assert_allclose(told[1:], dense[1:], rtol=1e-6)
    assert told[0] == pytest.approx(dense[0], rel=1e-6) or dense[0] == 0


@pytest.mark.parametrize("text", [ARM, COUPLED], ids=["arm", "sliding and mimic joints"])
def test_gradient_by_the_regressor_is_that_of_pinocchios_regressor(text: str, tmp_path: Path):
    model, generator = robots.load(text, tmp_path), np.random.default_rng(1)
    state = generator.normal(size=(3, model.nv, 5))
    C = generator.normal(size=(model.nv, 10 * len(model.joints), 5))

    def total(x: np.ndarray) -> float:
        return float(np.einsum("sjk,jks->", reference.regressor(model, *x.swapaxes(1, 2)), C))

    with jax.enable_x64(True):
        slope, h = eqx.filter_jit(pullback_rows)(model, *(jax.numpy.asarray(x) for x in (*state, C))), 1e-6
    for at in [(0, 0, 1), (0, 1, 3), (1, 0, 2), (1, 1, 4), (2, 1, 0)]:
        step = np.zeros_like(state)
        step[at] = h
        assert slope[at] == pytest.approx((total(state + step) - total(state - step)) / (2 * h), rel=1e-6, abs=1e-6)


def friction_rows(v: np.ndarray) -> np.ndarray:
    """Viscous and Coulomb friction of the arm's two joints, (samples, 2, 4)."""
    return np.concatenate([np.eye(2) * v[:, None], np.eye(2) * np.tanh(v / (info.SMOOTH + 1e-9))[:, None]], axis=2)


def test_information_is_the_log_determinant_of_pinocchios_rows(arm: RobotModel):
    learned, motion = info.learn(arm, noise={"turn": 0.02, "bend": 0.01}), a_motion(arm)
    q, v, a = map(np.asarray, motion.states(20.0))
    rows = np.concatenate([reference.regressor(arm, q, v, a), friction_rows(v)], axis=2) / np.array([1.2, 0.2])[:, None]
    kept = rows.reshape(-1, rows.shape[2])[:, list(learned.independent)]
    assert np.linalg.matrix_rank(rows.reshape(-1, rows.shape[2])) == learned.rank
    expected = np.linalg.slogdet(kept.T @ kept + learned.prior)[1]
    assert float(info.information(arm, motion, learned)) == pytest.approx(expected, rel=1e-9)
    std = np.sqrt(np.diag(np.linalg.inv(kept.T @ kept + learned.prior)))
    np.testing.assert_allclose(info.expected_std(learned, motion), std, rtol=1e-6)


def test_prior_is_the_covariance_that_trust_gives_the_base_parameters(arm: RobotModel):
    learned = info.learn(arm, Baseline(viscous=False, coulomb=False), trust=0.2)
    generator = np.random.default_rng(0)
    q, v, a = generator.normal(size=(3, 40, 2))
    W = reference.regressor(arm, q, v, a).reshape(-1, 20)
    kept = W[:, list(learned.independent)]
    spread = np.linalg.lstsq(kept, W, rcond=None)[0]  # base parameters of all parameters
    from figaroh_jax.estimation.priors import rigid_prior

    covariance = (spread / rigid_prior(arm, 0.2)[1]) @ spread.T
    np.testing.assert_allclose(np.linalg.inv(learned.prior), covariance, rtol=1e-6, atol=1e-12)


def test_gradient_is_that_of_finite_differences_and_of_the_solvers_own_programs(arm: RobotModel):
    with jax.enable_x64(True):
        learned, motion = info.learn(arm), a_motion(arm)
        quick = {"xla_backend_optimization_level": 0}  # compiled in a third of the time
        slope = jax.jit(jax.grad(lambda m: info.information(arm, m, learned)), compiler_options=quick)(motion)
        generator, h = np.random.default_rng(2), 1e-6
        way = Trajectory(generator.normal(size=2), generator.normal(size=motion.weights.shape), motion.basis)
        ends = [
            float(info.information(arm, jax.tree.map(lambda x, d: x + s * h * d, motion, way), learned))  # noqa: B023
            for s in (-1, 1)
        ]
        along = sum(float(np.sum(x * d)) for x, d in zip(jax.tree.leaves(slope), jax.tree.leaves(way), strict=True))
        assert along == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-5)
        prior = np.asarray(learned.prior)
        sampler = Sampler(arm, learned.terms, np.asarray(learned.width))
        kept = np.array(learned.independent)
        objective = information_objective(prior)
        problem = Problem(learned, sampler, objective, kept, motion.basis, limits_of(arm), None)
        x = problem.numbers(motion)
        own = np.concatenate([np.asarray(y).ravel() for y in jax.tree.leaves(slope)])
        np.testing.assert_allclose(problem.slope(x), -own / learned.rank, rtol=1e-6, atol=1e-9)
        assert problem.value(x) == pytest.approx(-float(info.information(arm, motion, learned)) / learned.rank)
        rows, step = Rows(problem, {}), generator.normal(size=x.shape)
        room = rows.all(x)
        some = np.flatnonzero(np.isfinite(room))[:: max(1, len(room) // 200)]
        assert (some >= rows.curved).any() and (some < rows.curved).any()
        ends = [rows.all(x + s * h * step)[some] for s in (-1, 1)]
        np.testing.assert_allclose(-rows.slopes(x, some) @ step, (ends[1] - ends[0]) / (2 * h), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_a_quadratic_step_is_that_of_a_conic_solver(seed: int):
    """Rows side by side are nearly alike, as those of a motion's samples are; also from rows that held before."""
    import clarabel
    from scipy import sparse

    generator = np.random.default_rng(seed)
    n, m = 12, 60
    L = np.tril(generator.normal(size=(n, n))) + 3 * np.eye(n)
    slope, way = 5 * generator.normal(size=n), generator.normal(size=(m // 3, n))
    A = np.repeat(way, 3, axis=0) + 1e-4 * generator.normal(size=(m, n))
    room = np.repeat(generator.uniform(0, 0.5, m // 3), 3)
    found = quadratic_step(L, slope, A, room)
    assert found is not None
    d, held = found
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    cones = [clarabel.NonnegativeConeT(m)]
    P = sparse.csc_matrix(np.triu(L @ L.T))
    theirs = clarabel.DefaultSolver(P, slope, sparse.csc_matrix(A), room, cones, settings).solve()
    np.testing.assert_allclose(d, theirs.x, atol=1e-6, rtol=0)
    assert (A @ d <= room + 1e-9).all() and (held >= 0).all()
    np.testing.assert_allclose(L @ L.T @ d + slope + A.T @ held, 0, atol=1e-8)
    warm = quadratic_step(L, slope, A, room, np.append(np.flatnonzero(held), 5))
    assert warm is not None
    np.testing.assert_allclose(warm[0], d, atol=1e-8, rtol=0)
    assert quadratic_step(L, slope, np.stack([A[0], -A[0]]), np.array([-1.0, -1.0])) is None


def test_a_descent_within_torques_ends_where_slsqp_with_all_rows_does(arm: RobotModel):
    from scipy.optimize import minimize

    with jax.enable_x64(True):
        learned = info.learn(arm, Baseline(viscous=True, coulomb=False))
        basis, kept = spline(4, 2.0), np.array(learned.independent)
        limits = limits_of(arm, acceleration=9.0, torque={"turn": 9.0, "bend": 3.0})
        sampler = Sampler(arm, learned.terms, np.asarray(learned.width))
        problem = Problem(
            learned, sampler, information_objective(np.asarray(learned.prior)), kept, basis, limits, np.zeros(2)
        )
        rows = Rows(problem, {})
        x = random_motion(problem, np.random.default_rng(1))
        every = np.arange(rows.curved + rows.torques)
        found = solve(problem, x)
        assert rows.all(found).min() > -1e-4
        assert rows.of_curved(found).min() < 1e-3  # a torque is at its limit
        kept_rows = {"type": "ineq", "fun": rows.all, "jac": lambda x: -rows.slopes(x, every)}
        options = {"maxiter": 300, "ftol": 1e-10}
        theirs = minimize(
            problem.value, found, jac=problem.slope, method="SLSQP", constraints=[kept_rows], options=options
        ).x
        assert problem.value(found) < problem.value(theirs) + 1e-3


def test_a_motion_that_begins_at_the_edge_is_drawn_in_a_little_and_from_within_keeps_its_limits(arm: RobotModel):
    with jax.enable_x64(True):
        learned, basis = info.learn(arm), spline(5, 4.0)
        limits = limits_of(arm, acceleration=9.0, torque={"turn": 9.4, "bend": 2.7})
        sampler = Sampler(arm, learned.terms, np.asarray(learned.width))
        objective = information_objective(np.asarray(learned.prior))
        problem = Problem(learned, sampler, objective, np.array(learned.independent), basis, limits, None)
        away = -0.2 * np.random.default_rng(0).uniform(0.5, 1.0, (2, basis.size))  # from the edge, and back to it never
        x = problem.numbers(Trajectory(limits.position[:, 1], away, basis))
        margin = {"position": 2e-3}
        drawn = drawn_in(problem, x, margin)
        assert Rows(problem, margin).of_linear(drawn).min() > -1e-12
        assert (problem.trajectory(drawn).weights < 0.8 * away).all()  # it still moves
        found = within(problem, x)
        assert Rows(problem, {}).of_linear(found).min() > 0
        assert problem.value(found) < problem.value(x) - 0.1
        curved, step, h = _Curved(problem, 0.7), np.random.default_rng(1).normal(size=x.shape), 1e-6
        assert np.abs(problem.torque_shares(x)).max() > 1  # beyond its limit the logarithm goes on as a parabola
        ends = [problem.value(y) + 0.7 * curved.value(y) for y in (x - h * step, x + h * step)]
        assert curved.slope(x) @ step == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-5)


def test_gradients_by_the_gram_matrix_are_those_of_finite_differences():
    generator = np.random.default_rng(3)
    G, M, wanted, step = (x @ x.T for x in generator.normal(size=(4, 5, 9)))
    for objective in (
        information_objective(M),
        prediction_objective(M, wanted),
        condition_objective(),
        smooth_condition_objective(),
    ):
        h = 1e-6
        change = (objective(G + h * step)[0] - objective(G - h * step)[0]) / (2 * h)
        assert np.sum(objective(G)[1] * step) == pytest.approx(change, rel=1e-5)


def test_an_objective_of_jax_needs_no_slope():
    G, step = (x @ x.T for x in np.random.default_rng(3).normal(size=(2, 5, 9)))
    with jax.enable_x64(True):
        value, slope = own_objective(lambda G: -jax.numpy.linalg.slogdet(G)[1] / 5)(G)
    expected = information_objective(np.zeros((5, 5)))(G)
    assert value == pytest.approx(expected[0]) and np.allclose(slope, expected[1])
    assert own_objective(information_objective(step))(G)[0] == information_objective(step)(G)[0]
    with pytest.raises(InputError, match=r"objective gives an array of shape \(5, 5\)"):
        own_objective(lambda G: G)(G)


def test_a_designed_motion_tells_more_than_random_ones_and_meets_its_limits_by_pinocchio(arm: RobotModel):
    limits = limits_of(arm, acceleration={"turn": 6.0, "bend": 8.0}, torque={"turn": 45.0, "bend": 14.0})
    found = excite(arm, BASES[0], limits, trajectories=2, starts=1, start=[0.1, 0.2])
    learned = found.learned
    for stage in found.stages:
        assert stage.met
        np.testing.assert_allclose(stage.motion.start, [0.1, 0.2], rtol=0, atol=1e-12)
        q, v, a = (np.asarray(x) for x in stage.motion.states(1000.0))
        torque = reference.inverse_dynamics(arm, q, v, a)
        assert (q >= limits.position[:, 0] - 2e-3).all() and (q <= limits.position[:, 1] + 2e-3).all()
        for values, limit in ((v, limits.velocity), (a, limits.acceleration), (torque, limits.torque)):
            assert (np.abs(values) <= 1.001 * limit).all()
        used = {use.kind: use.share for use in stage.uses}
        assert used["torque"] == pytest.approx((np.abs(torque) / limits.torque).max(), rel=1e-6)
        assert max(used.values()) > 0.98  # something is used to the full
    assert found.stages[1].logdet > found.stages[0].logdet
    problem = Problem(
        learned,
        Sampler(arm, learned.terms, np.asarray(learned.width)),
        information_objective(np.asarray(learned.prior)),
        np.array(learned.independent),
        BASES[0],
        limits,
        np.array([0.1, 0.2]),
    )
    generator = np.random.default_rng(4)
    randoms = []
    for x in (random_motion(problem, generator, amplitude=0.7) for _ in range(40)):
        torque = reference.inverse_dynamics(arm, *problem.states(x))
        if (np.abs(torque) <= limits.torque).all():
            randoms.append(-learned.rank * problem.value(x))
    assert len(randoms) > 3
    assert found.stages[0].logdet > max(randoms) + 1.0
    assert (found.std < found.std_before).all()


def test_what_no_motion_meets_is_refused_with_the_joint_and_by_how_much(arm: RobotModel):
    with pytest.raises(InputError, match=r"limits.torque: holding still takes .* times the limit of '(turn|bend)'"):
        excite(arm, BASES[0], limits_of(arm, {"turn": (0.5, 1.0), "bend": (0.2, 0.5)}, torque=0.01))
    with pytest.raises(InputError, match="start: 'turn' at 3 is outside of its limits -2 to 2"):
        excite(arm, BASES[0], start=[3.0, 0.0])
    with pytest.raises(InputError, match="limits.velocity: 0 for 'bend'"):
        limits_of(arm, velocity={"bend": 0.0})
    with pytest.raises(InputError, match="limits.torque: no moving joint 'bent'; did you mean 'bend'"):
        limits_of(arm, torque={"bent": 1.0})
    with pytest.raises(InputError, match="a base of 0.5 Hz fits"):
        fourier(3, 0.45, 4.0)
    with pytest.raises(InputError, match="noise: bend missing"):
        info.learn(arm, noise={"turn": 0.1})
    with pytest.raises(InputError, match="needs the motions that matter"):
        excite(arm, BASES[0], objective="prediction")


@pytest.mark.slow
def test_an_identification_from_the_designed_motion_predicts_better_than_from_random_ones(arm: RobotModel):
    """Torques are Pinocchio's with friction and noise; the fit is plain least squares in NumPy."""
    found = excite(arm, BASES[0], limits_of(arm, acceleration=8.0), starts=2, start=[0.1, 0.2])
    learned = found.learned
    sigma, kept = 1 / np.sqrt(np.asarray(learned.weight)), np.array(learned.independent)
    sampler = Sampler(arm, learned.terms, np.asarray(learned.width))
    objective = information_objective(np.asarray(learned.prior))
    problem = Problem(learned, sampler, objective, kept, BASES[0], found.limits, np.array([0.1, 0.2]))
    generator = np.random.default_rng(5)
    randoms = [problem.states(random_motion(problem, generator)) for _ in range(9)]
    unseen, randoms = randoms[:4], randoms[4:]

    def rows(states: np.ndarray) -> np.ndarray:
        q, v, a = states
        return (
            np.concatenate([reference.regressor(arm, q, v, a), friction_rows(v)], axis=2)[:, :, kept] / sigma[:, None]
        )

    def torque(states: np.ndarray) -> np.ndarray:
        q, v, a = states
        return (reference.inverse_dynamics(arm, q, v, a) + 0.4 * v + 0.7 * np.tanh(v / info.SMOOTH)) / sigma

    tests = [(rows(motion), torque(motion)) for motion in unseen]

    def error(states: np.ndarray) -> float:
        A, truth, squares = rows(states).reshape(-1, len(kept)), torque(states), []
        for k in range(40):
            y = truth + np.random.default_rng([6, k]).standard_normal(truth.shape)
            fit = np.linalg.lstsq(A, y.ravel(), rcond=None)[0]
            squares += [((W @ fit - own) ** 2).mean() for W, own in tests]
        return float(np.sqrt(np.mean(squares)))

    designed = np.stack([np.asarray(x) for x in found.stages[0].motion.states(20.0)])
    assert error(designed) < 0.7 * np.median([error(motion) for motion in randoms])
