"""Linear fits in batches: against NumPy's least squares, SciPy's bounded ones, and the engine's on the TX40."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from scipy.optimize import lsq_linear

import figaroh_jax as fj

T = np.arange(2000)[:, None] / 250.0
RATES = 2 * np.pi * np.array([0.5, 0.7, 0.9, 1.1])
Q, V, A = (0.6 * RATES**k * np.sin(RATES * T + np.arange(4) + k * np.pi / 2) for k in range(3))


@pytest.fixture(scope="module")
def case() -> tuple[fj.ExtendedModel, fj.TorqueData, Any]:
    """An arm with friction at every joint, one of them pushing, noise of another size at each joint."""
    robot = fj.load_urdf(fj.DEMO)
    damping = dict(zip(robot.joint_names, (1.0, 2.0, -0.5, 0.3), strict=True))
    effects = [fj.place(fj.CATALOGUE["viscous_friction"], robot, [j], damping=d) for j, d in damping.items()]
    model = fj.extend(robot, *effects)
    noise = np.random.default_rng(0).normal(size=Q.shape) * [0.1, 0.2, 0.3, 0.05]
    tau = np.asarray(model.inverse_dynamics(Q, V, A)) + noise
    data = fj.torque_data(model, fj.recording(q=Q, tau=tau, rate=250), fj.Preprocess(cutoff=10, rate=30))
    return model, data, fj.linear_basis(model, data)


def rows(model: fj.ExtendedModel, data: fj.TorqueData, basis: Any) -> tuple[np.ndarray, np.ndarray]:
    """Columns of the kept parameters (rows nv rank) and torque, by the derivative of the public residual."""
    from figaroh_jax.estimation.free import apply, chosen_of

    free = chosen_of(model, (data,), ("inertia", "effects"))
    at = lambda y: fj.residual(apply(free, model, (data,), y)[0], data)  # noqa: E731
    X = np.asarray(jax.jit(jax.jacfwd(at))(jnp.zeros(len(free.names))))
    return X[:, list(basis.kept)].reshape(-1, 4, len(basis.kept)), np.asarray(data.torque).reshape(-1, 4)


def test_fit_counts_and_limits_agree_with_numpy_and_scipy(case):
    model, data, basis = case
    X, y = rows(model, data, basis)
    lower, upper = fj.linear_limits(model, basis)
    blocks = -(-len(y) // data.together)
    counts = np.random.default_rng(1).multinomial(blocks, np.full(blocks, 1 / blocks)).astype(float)
    counts = np.stack([np.ones(blocks), counts])
    many = jax.jit(jax.vmap(lambda c: fj.fit_linear(model, data, basis, counts=c)))(counts)
    bounded = jax.jit(lambda: fj.fit_linear(model, data, basis, lower=lower, upper=upper))()
    for k, count in enumerate(counts):
        root = np.sqrt(np.repeat(count, data.together)[: len(y)])[:, None]
        scale = root / np.asarray(many.rms[k])
        found = np.linalg.lstsq((X * scale[..., None]).reshape(-1, X.shape[2]), (y * scale).reshape(-1), rcond=None)[0]
        size = np.abs(found).max()
        np.testing.assert_allclose(many.values[k], found, rtol=0, atol=1e-7 * size)
        left = np.sqrt(np.sum((root * (y - X @ found)) ** 2, axis=0) / np.sum(root**2))
        np.testing.assert_allclose(many.rms[k], left, rtol=1e-6, atol=0)
    scale = np.ones((len(y), 1)) / np.asarray(bounded.rms)
    A, b = (X * scale[..., None]).reshape(-1, X.shape[2]), (y * scale).reshape(-1)
    length = np.linalg.norm(A, axis=0)
    theirs = lsq_linear(A / length, b, (lower * length, upper), method="bvls", tol=1e-14).x / length
    assert bool(bounded.converged) and [basis.names[k] for k in np.flatnonzero(bounded.active)] == ["fv3"]
    assert float(bounded.values[basis.names.index("fv3")]) == 0.0
    np.testing.assert_allclose(bounded.values, theirs, rtol=0, atol=1e-6 * np.abs(theirs).max())


def test_robots_of_one_structure_are_one_batch(case):
    model, data, basis = case
    both = jax.tree.map(lambda x: np.stack([x, x]), data)
    torque = np.array(both.torque)
    torque[1] *= 2.0
    import equinox as eqx

    doubled = eqx.tree_at(lambda d: d.torque, both, torque)
    found = jax.jit(jax.vmap(lambda d: fj.fit_linear(model, d, basis)))(doubled)
    size = np.abs(np.asarray(found.values[0])).max()
    np.testing.assert_allclose(found.values[1], 2.0 * found.values[0], rtol=0, atol=1e-8 * size)


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch, data_dir: Path) -> Any:
    """The benchmark, which builds the real sets."""
    folder = Path(__file__).resolve().parents[1] / "benchmarks"
    monkeypatch.syspath_prepend(str(folder))
    for name in ("fit", "calibration"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    import calibration
    import fit

    calibration.DATA = data_dir
    return fit


@pytest.mark.slow
def test_the_tx40_s_parameters_are_the_same_by_every_fit(bench: Any, data_dir: Path, tmp_path: Path):
    model, _, basis, linear, engine, own = bench.tx40(data_dir, tmp_path)
    mine = np.asarray(linear.values)
    size = np.abs(mine).max()
    np.testing.assert_allclose(engine.parameters[list(basis.kept)], mine, rtol=0, atol=1e-6 * size)
    start = np.concatenate([np.asarray(model.robot.inertia).reshape(-1), np.zeros(len(own.values))])
    whole = start[: len(own.values)] + np.asarray(own.values)
    np.testing.assert_allclose(basis.matrix @ whole, mine, rtol=0, atol=1e-6 * size)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "level", "rank", "error"),
    [("talos", "offsets", 16, 1.430), ("talos", "full", 39, 0.509), ("tiago", "offsets", 14, 3.539)],
)
def test_optimistix_calibrates_real_robots_as_published(bench: Any, name: str, level: str, rank: int, error: float):
    model, data = bench.sets()[name]
    free = bench.OFFSETS if level == "offsets" else bench.FULL
    found = {key: fj.fit(model, data, free, solver=solver, max_steps=3000) for key, solver in bench.SOLVERS.items()}
    for one in found.values():
        assert one.result == optimistix.RESULTS.successful and int(one.rank) == rank
        assert bench.millimetres(one) == pytest.approx(error, abs=1e-3)
    both = [float(one.cost) for one in found.values()]
    assert both[0] == pytest.approx(both[1], rel=1e-8)


@pytest.mark.slow
def test_gradients_by_the_data_of_a_real_robot_are_those_of_refits(bench: Any, data_dir: Path, tmp_path: Path):
    """Friction of the TX40's twelve terms: derivatives of a fit by torques, weights and positions as they were read."""
    import bootstrap

    model, data = bootstrap.problem(tmp_path)

    def damping(data: fj.TorqueData) -> jax.Array:
        return jnp.asarray(fj.fit(model, data, "friction").values)[0]

    slopes = jax.grad(damping)(data)
    assert all(np.isfinite(np.asarray(one)).all() for one in jax.tree.leaves(slopes))
    for leaf in (lambda d: d.torque, lambda d: d.weight, lambda d: d.position):
        value = np.asarray(leaf(data))
        way = np.cos(0.01 * np.arange(value.size)).reshape(value.shape) * (value != 0)
        h = 1e-4 * np.abs(value).max()
        ahead, behind = (damping(eqx.tree_at(leaf, data, value + s * h * way)) for s in (1, -1))
        np.testing.assert_allclose(
            (np.asarray(leaf(slopes)) * way).sum(), (ahead - behind) / (2 * h), rtol=1e-3, atol=0
        )
