"""Physically consistent links: reasons, projections, and two fits that must meet."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from robots import REAL, TREE, load

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.estimation.conic import Body, Constraints, constrained
from figaroh_jax.estimation.consistency import bodies, inconsistencies, log_cholesky_fit, physical_fit, project
from figaroh_jax.estimation.priors import rigid_prior
from figaroh_jax.rigid.inertia import from_com, pseudo_inertia


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> fj.RobotModel:
    return load(TREE, tmp_path_factory.mktemp("tree"))


def problem(model: fj.RobotModel, seed: int, samples: int = 60, noise: float = 0.05) -> np.ndarray:
    """Triangular factor of noisy torques of a robot whose links differ from the model's, with a prior of 100 %."""
    generator = np.random.default_rng(seed)
    q, v, a = generator.uniform(-2, 2, (3, samples, model.nv))
    W = np.asarray(fj.joint_torque_regressor(model, q, v, a)).reshape(-1, 10 * len(model.joints))
    nominal = np.asarray(model.inertia).ravel()
    truth = project((nominal * (1 + 0.5 * generator.normal(size=nominal.shape))).reshape(-1, 10), bodies(model)).ravel()
    y = W @ truth
    y = y + noise * np.std(y) * generator.normal(size=y.shape)
    rows = np.column_stack([W, y]) / (noise * np.std(y))
    mean, precision = rigid_prior(model, 1.0)
    prior = np.column_stack([np.diag(np.sqrt(precision)), np.sqrt(precision) * mean])
    return np.linalg.qr(np.concatenate([rows, prior]))[1]


def cost(factor: np.ndarray, theta: np.ndarray) -> float:
    return 0.5 * float(np.sum((factor @ np.append(theta, -1.0)) ** 2))


def test_a_link_that_cannot_exist_is_named_with_its_reason():
    body = from_com(2.0, np.array([0.1, 0.0, 0.0]), np.diag([0.02, 0.03, 0.04]))
    light = body.copy()
    light[0] = -1.0
    thin = from_com(2.0, np.zeros(3), np.diag([0.01, 0.01, 0.05]))
    hollow = from_com(2.0, np.zeros(3), np.diag([-0.01, 0.02, 0.02]))
    found = inconsistencies(np.array([body, light, thin, hollow]), ["good", "light", "thin", "hollow"])
    assert [one.link for one in found] == ["light", "thin", "hollow"]
    assert "mass is -1 kg" in found[0].reason
    assert "exceeds the sum" in found[1].reason
    assert "negative" in found[2].reason
    for one, ten in zip(found, (light, thin, hollow), strict=True):
        assert one.eigenvalue == pytest.approx(np.linalg.eigvalsh(pseudo_inertia(ten))[0])


def test_projection_leaves_feasible_links_and_repairs_the_others(tree: fj.RobotModel):
    links = bodies(tree)
    wrong = np.array(tree.inertia)
    wrong[1] *= -1.0
    wrong[2, 4] += 1.0
    right = project(wrong, links)
    np.testing.assert_allclose(right[[0, 3]], wrong[[0, 3]], rtol=0, atol=1e-6)
    assert not inconsistencies(right, tree.link_names)
    assert np.linalg.eigvalsh(pseudo_inertia(right)).min() > 0


def test_projection_keeps_to_cad_bounds(tree: fj.RobotModel):
    name = tree.link_names[0]
    box = ((-0.01, -0.02, 0.0), (0.05, 0.02, 0.1))
    links = bodies(tree, {name: {"mass": (0.5, 0.9), "com": box}})
    ten = project(np.asarray(tree.inertia), links)[0]
    assert 0.5 - 1e-6 <= ten[0] <= 0.9 + 1e-6
    com = ten[1:4] / ten[0]
    assert (com >= np.array(box[0]) - 1e-5).all() and (com <= np.array(box[1]) + 1e-5).all()


@pytest.mark.parametrize("entry", [{"mass": (2.0, 1.0)}, {"com": ((1, 0, 0), (0, 0, 0))}, {"volume": (0, 1)}])
def test_bounds_that_make_no_sense_are_refused(tree: fj.RobotModel, entry: dict):
    with pytest.raises(InputError):
        bodies(tree, {tree.link_names[0]: entry})
    with pytest.raises(InputError, match="no link"):
        bodies(tree, {"nowhere": {}})


@pytest.mark.parametrize("seed", range(4))
def test_both_fits_reach_the_same_optimum(tree: fj.RobotModel, seed: int):
    factor = problem(tree, seed)
    convex = physical_fit(factor, bodies(tree))
    assert not inconsistencies(convex.reshape(-1, 10), tree.link_names)
    free = np.linalg.lstsq(factor[:, :-1], factor[:, -1], rcond=None)[0]
    assert cost(factor, free) <= cost(factor, convex) * (1 + 1e-9)
    found = log_cholesky_fit(factor, np.asarray(tree.inertia))
    assert found.converged
    assert found.cost == pytest.approx(cost(factor, found.parameters), rel=1e-6)
    assert found.cost <= cost(factor, convex) * (1 + 1e-3)
    assert not inconsistencies(found.parameters.reshape(-1, 10), tree.link_names)


def test_fit_finds_the_truth_where_there_is_no_noise(tree: fj.RobotModel):
    W = np.eye(50)
    truth = project(np.asarray(tree.inertia), bodies(tree)).ravel()  # the lightest link of the file cannot exist
    found = physical_fit(np.column_stack([W, W @ truth]), bodies(tree))
    np.testing.assert_allclose(found, truth, rtol=0, atol=1e-5)


def test_entropic_prior_pulls_to_the_nominal_robot(tree: fj.RobotModel):
    factor = problem(tree, 1)
    nominal = np.asarray(tree.inertia).ravel()
    far = [
        np.linalg.norm(log_cholesky_fit(factor, tree.inertia, prior="entropic", strength=s).parameters - nominal)
        for s in (0.0, 1e2, 1e7)
    ]
    assert far[0] > far[1] > far[2] and far[2] < 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tx40", "tiago", "talos"])
def test_log_cholesky_converges_from_perturbed_cad_values(name: str, data_dir: Path):
    """At least 98 of 100 starts, CAD values perturbed by 20 %, end within 0.1 % of the convex optimum's cost."""
    joints = {"talos": [f"arm_left_{k}_joint" for k in range(1, 8)], "tiago": None, "tx40": None}[name]
    model = fj.load_urdf(data_dir / REAL[name], joints=joints)
    factor = problem(model, 0, samples=300)
    best = cost(factor, physical_fit(factor, bodies(model)))
    generator, good = np.random.default_rng(1), 0
    nominal = np.asarray(model.inertia)
    for _ in range(100):
        start = project(nominal * (1 + 0.2 * generator.normal(size=nominal.shape)), bodies(model))
        good += log_cholesky_fit(factor, nominal, start.ravel()).cost <= best * (1 + 1e-3)
    assert good >= 98


def test_a_fit_whose_long_steps_lead_nowhere_is_found_with_shorter_ones():
    """The triangular factor of a SCARA's rows (torque made by MuJoCo C) with friction, rotors and the nominal links.

    The free solution satisfies all constraints, so it is the constrained one too.
    """
    kept = np.load(Path(__file__).with_name("stalled_fit.npz"))
    factor = np.zeros((53, 53))
    factor[np.triu_indices(53)] = kept["factor"]
    factor *= kept["length"]
    sizes = ((2.0, 0.1183), (1.5, 0.1693), (1.0, 0.1483), (0.5, 0.1304))  # kg, m
    links = [Body(f"l{k}", range(10 * k, 10 * k + 10), *size) for k, size in enumerate(sizes)]
    inertia = [(m, *[2 * m * a] * 3, *[2 * m * a**2] * 6) for m, a in sizes]
    scale = np.concatenate([*inertia, np.ones(12)])
    lower = np.concatenate([np.full(40, -np.inf), np.zeros(12)])
    found = constrained(factor, Constraints(bodies=links, lower=lower), scale)
    free = np.linalg.lstsq(factor[:, :-1], factor[:, -1], rcond=None)[0]
    left = [np.linalg.norm(factor @ np.append(x, -1.0)) for x in (found, free)]
    assert left[0] == pytest.approx(left[1], rel=1e-3) and found[40] == pytest.approx(20, rel=0.02)
