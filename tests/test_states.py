"""States streamed through condensed factors: from memory or disk, the same numbers as the dense problem."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from robots import TREE, load, states

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.estimation import states as states_module
from figaroh_jax.estimation.base_parameters import base_parameters
from figaroh_jax.estimation.columns import friction_terms
from figaroh_jax.estimation.least_squares import solve
from figaroh_jax.estimation.regression import condense
from figaroh_jax.estimation.states import States
from figaroh_jax.formats.config import Baseline


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> fj.RobotModel:
    return load(TREE, tmp_path_factory.mktemp("tree"))


@pytest.fixture
def data(model: fj.RobotModel) -> np.ndarray:
    q, v, a = states(model, 700)
    noise = np.random.default_rng(1).normal(size=v.shape)
    return np.stack([q, v, a, np.asarray(fj.inverse_dynamics(model, q, v, a)) + 2 * v + np.sign(v) + noise])


def test_streamed_fit_from_disk_is_the_dense_one(
    model: fj.RobotModel, data: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    np.save(tmp_path / "states.npy", data)
    mapped = np.load(tmp_path / "states.npy", mmap_mode="r")
    terms = friction_terms(model, Baseline())
    monkeypatch.setattr(states_module, "CHUNK_BYTES", 1e6)
    rows = States(model, lambda: (mapped[:, k : k + 300] for k in range(0, 700, 300)), terms)
    condensed = condense(rows, rows.used)
    q, v, a, tau = data
    W = np.asarray(fj.joint_torque_regressor(model, q, v, a))
    eye = np.eye(model.nv)
    dense = np.concatenate([W, v[:, :, None] * eye, np.sign(v)[:, :, None] * eye], axis=2).reshape(len(tau.ravel()), -1)
    both = np.column_stack([dense, tau.ravel()])
    R = condensed.factor()
    np.testing.assert_allclose(R.T @ R, both.T @ both, rtol=0, atol=1e-11 * np.abs(both.T @ both).max())
    assert condensed.rows.tolist() == [700] * model.nv
    base = base_parameters(R[:, :-1], rows.names)
    assert base.rank == rows.structural.rank
    expected = np.linalg.lstsq(dense[:, base.independent], tau.ravel(), rcond=None)[0]
    found = solve(condensed, kept=base.independent).parameters[base.independent]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_wrong_pieces_are_named(model: fj.RobotModel, data: np.ndarray):
    q, v, a, tau = data
    with pytest.raises(InputError, match="piece 0 of the source: tau has shape"):
        list(States(model, lambda: [(q, v, a, tau[:, :2])]).pieces())
    spoilt = v.copy()
    spoilt[5, 1] = np.nan
    with pytest.raises(InputError, match="piece 1 of the source: v is not finite in row 5, column 1"):
        list(States(model, lambda: [(q, v, a, tau), (q, spoilt, a, tau)]).pieces())
