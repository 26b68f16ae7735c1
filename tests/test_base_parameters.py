"""Base parameters: published ranks, laws of linear algebra, and a choice that nothing accidental can move."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from robots import REAL, TREE, joint, link, load, robot

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.estimation.base_parameters import BaseParameters, base_parameters
from figaroh_jax.estimation.columns import column_names, friction_terms, structural_columns
from figaroh_jax.formats.config import Baseline, BaselineEffect

DRIVES = Baseline(viscous=True, coulomb=True, rotor=True, offset=True)


def structural(model: fj.RobotModel, known: Baseline = DRIVES, **options) -> tuple[np.ndarray, BaseParameters]:
    """The columns at random states as one matrix, and their base parameters."""
    terms = friction_terms(model, known)
    X = structural_columns(model, terms, **options)
    return X, base_parameters(np.linalg.qr(X.reshape(-1, X.shape[2]))[1], column_names(model, terms))


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> tuple[np.ndarray, BaseParameters]:
    X, base = structural(load(TREE, tmp_path_factory.mktemp("tree")))
    return X.reshape(-1, X.shape[2]), base


@pytest.mark.parametrize(("name", "seen", "rank"), [("tx40", 73, 58), ("talos", 413, 328)])
def test_structural_rank_is_the_published_one(name: str, seen: int, rank: int, data_dir: Path):
    _, base = structural(fj.load_urdf(data_dir / REAL[name]))
    assert (len(base.names) - len(base.unseen), base.rank) == (seen, rank)


def test_coupling_of_the_tx40_adds_three_base_parameters(data_dir: Path):
    model = fj.load_urdf(data_dir / REAL["tx40"])
    coupling = BaselineEffect(effect="coupled_transmission", at=("joint_5", "joint_6"))
    _, base = structural(model, DRIVES.model_copy(update={"effects": (coupling,)}))
    assert base.rank == 61


def test_panda_with_two_free_fingers_has_the_published_rank(data_dir: Path, tmp_path: Path):
    text = (data_dir / REAL["panda"]).read_text()
    file = tmp_path / "panda.urdf"
    file.write_text("\n".join(line for line in text.splitlines() if "<mimic" not in line))
    model = fj.load_urdf(file)
    _, base = structural(model)
    assert (len(base.names), base.rank) == (126, 85)


DH = (  # of the UR10e: d and a in m, alpha (the maker's table)
    (0.1807, 0.0, np.pi / 2),
    (0.0, -0.6127, 0.0),
    (0.0, -0.57155, 0.0),
    (0.17415, 0.0, np.pi / 2),
    (0.11985, 0.0, -np.pi / 2),
    (0.11655, 0.0, 0.0),
)


def dh_arm(folder: Path) -> fj.RobotModel:
    """The arm from its table of Denavit and Hartenberg: every joint turns about the z of the frame before it."""
    parts = [link("l0")]
    before = (0.0, 0.0, 0.0)
    for k, row in enumerate(DH, 1):
        d, a, alpha = before
        parts += [link(f"l{k}"), joint(f"j{k}", f"l{k - 1}", f"l{k}", xyz=f"{a} 0 {d}", rpy=f"{alpha!r} 0 0")]
        before = row
    return load(robot(*parts), folder)


def test_arm_from_its_dh_table_has_the_published_ranks_and_lever_arms(tmp_path: Path):
    """Ranks and coefficients of the UR10 as published with figaroh's examples, those of frames beyond joint 6 apart."""
    model = dh_arm(tmp_path)
    counts = []
    for known in (Baseline(viscous=False, coulomb=False), DRIVES):
        _, base = structural(model, known)
        counts.append((len(base.names), len(base.names) - len(base.unseen), base.rank))
    assert counts == [(60, 49, 36), (84, 73, 58)]
    sizes = np.unique(np.abs(base.matrix[np.abs(base.matrix) > 1e-9]).round(6))
    for known in (0.6127, 0.57155, 0.11985, 0.17415, 0.375401, 0.326669, 0.014364):
        assert np.abs(sizes - known).min() < 1e-6
    row = next(k for k, text in enumerate(base.expressions) if text.startswith("mx2 "))
    masses = [base.matrix[row, base.names.index(f"m{k}")] for k in range(3, 7)]
    np.testing.assert_allclose(masses, -0.6127, rtol=0, atol=1e-12)  # kg m of each kilogram beyond the upper arm


def test_lever_arms_of_the_urdf_are_the_coefficients(data_dir: Path):
    model = fj.load_urdf(data_dir / REAL["ur10e"])
    _, base = structural(model, Baseline(viscous=False, coulomb=False))
    matrix, names = base.matrix, base.names
    for parent, arm in ((2, 0.613), (3, 0.571)):  # upper arm and forearm, m
        assert arm == pytest.approx(np.linalg.norm(model.placement[parent][:3, 3]), abs=0.2)
        row = [k for k, text in enumerate(base.expressions) if text.startswith(f"mz{parent} ")][0]
        heavier = [f"m{k}" for k in range(parent + 1, 7)]
        coefficients = [matrix[row, names.index(name)] for name in heavier]
        np.testing.assert_allclose(np.abs(coefficients), arm, rtol=0, atol=2e-3)


def test_torque_of_all_parameters_is_that_of_the_base_ones(tree: tuple[np.ndarray, BaseParameters]):
    X, base = tree
    theta = np.random.default_rng(1).normal(size=X.shape[1])
    np.testing.assert_allclose(X[:, base.independent] @ (base.matrix @ theta), X @ theta, rtol=0, atol=1e-10)


def test_null_directions_change_no_torque_and_no_base_parameter(tree: tuple[np.ndarray, BaseParameters]):
    X, base = tree
    scale = np.abs(X).max() * np.abs(base.null).max()
    np.testing.assert_allclose(X @ base.null / scale, 0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(base.matrix @ base.null, 0, rtol=0, atol=1e-12)
    assert base.null.shape[1] + base.rank == X.shape[1]


def test_base_parameters_come_back_from_the_full_ones_spread_from_them(tree: tuple[np.ndarray, BaseParameters]):
    _, base = tree
    phi = np.random.default_rng(2).normal(size=base.rank)
    np.testing.assert_allclose(base.matrix @ (base.spread @ phi), phi, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_choice_is_the_same_whatever_the_order_units_and_samples(tree: tuple[np.ndarray, BaseParameters], seed: int):
    X, base = tree
    generator = np.random.default_rng(seed)
    shuffled = generator.permutation(X.shape[1])
    units = 10.0 ** generator.uniform(-2, 2, X.shape[1])
    units[generator.integers(X.shape[1])] *= generator.choice([1e-6, 1e6])
    rows = generator.permutation(len(X))
    Y = (X * units)[rows][:, shuffled]
    names = [base.names[k] for k in shuffled]
    other = base_parameters(Y, names, order=np.argsort(shuffled).tolist())
    assert [names[k] for k in other.independent] == [base.names[k] for k in base.independent]
    assert [names[k] for k in other.dependent] == [base.names[k] for k in base.dependent]
    again = other.beta * units[base.independent][:, None] / units[base.dependent]
    np.testing.assert_allclose(again, base.beta, rtol=0, atol=1e-8)


def test_equal_columns_keep_the_first_bit_for_bit():
    column = np.random.default_rng(0).normal(size=20)
    base = base_parameters(np.column_stack([column, column, 2 * column]), ["a", "b", "c"])
    assert base.independent.tolist() == [0] and base.expressions == ("a + b + 2 c",)
    turned = base_parameters(np.column_stack([column, column, 2 * column]), ["a", "b", "c"], order=[1, 2, 0])
    assert turned.expressions == ("b + 2 c + a",)


def test_parameters_say_where_they_are_absorbed(tree: tuple[np.ndarray, BaseParameters]):
    _, base = tree
    for name in (base.names[k] for k in base.dependent):
        assert all(name in text for text in base.absorbed_in(name)) and base.absorbed_in(name)
    for name in (base.names[k] for k in base.unseen):
        assert base.absorbed_in(name) == ()
    with pytest.raises(InputError, match="no parameter 'mass'"):
        base.absorbed_in("mass")


def test_wrong_factors_are_refused():
    with pytest.raises(InputError, match="one column for each"):
        base_parameters(np.eye(3), ["a", "b"])
    with pytest.raises(InputError, match="not finite"):
        base_parameters(np.array([[1.0, np.nan]]), ["a", "b"])
    with pytest.raises(InputError, match="each of the 2 columns"):
        base_parameters(np.eye(2), ["a", "b"], order=[0, 0])


def test_golden_numbers_of_the_sample_manipulator():
    """States, low pass and torques of `pin.buildSampleModelManipulator()`; the library sees Pinocchio's regressor."""
    import pinocchio as pin
    from scipy import signal

    model = pin.buildSampleModelManipulator()
    rng = np.random.default_rng(0)
    f = rng.uniform(0.2, 0.8, (3, 6))
    A = rng.uniform(0.3, 1.0, (3, 6))
    t = np.arange(400)[:, None, None] / 100
    w = 2 * np.pi * f
    q, v, a = (A * np.sin(w * t)).sum(1), (A * w * np.cos(w * t)).sum(1), (-A * w**2 * np.sin(w * t)).sum(1)
    data = model.createData()
    tau = np.array([pin.rnea(model, data, *state) for state in zip(q, v, a, strict=True)])
    b, c = np.array(signal.butter(4, 10 / 50))
    q, v, a = (signal.filtfilt(b, c, x, axis=0, padtype="odd", padlen=12) for x in (q, v, a))
    W = np.concatenate([pin.computeJointTorqueRegressor(model, data, *s) for s in zip(q, v, a, strict=True)])
    base = base_parameters(np.linalg.qr(W)[1], [str(k) for k in range(60)])
    assert (60 - len(base.unseen), base.rank) == (51, 38)
    phi = np.linalg.lstsq(W[:, base.independent], tau.ravel(), rcond=None)[0]
    rmse = np.sqrt(np.mean((W[:, base.independent] @ phi - tau.ravel()) ** 2))
    assert rmse == pytest.approx(0.09574368495, rel=1e-9)
    assert base.condition == pytest.approx(235.860126, rel=1e-6)
    assert phi.sum() == pytest.approx(21.6607676, rel=1e-7)
    assert (phi**2).sum() == pytest.approx(60.2486797, rel=1e-7)
