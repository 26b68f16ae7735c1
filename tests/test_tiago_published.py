"""TIAGo's torso and arm by a recipe that others have run: the errors of its fits, reproduced with our columns.

The recipe is the test's: medians and a low pass on positions, torque as recorded, decimation by ten.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

import figaroh_jax as fj
from figaroh_jax.estimation.base_parameters import base_parameters
from figaroh_jax.estimation.columns import friction_terms, state_columns
from figaroh_jax.estimation.consistency import bodies, inconsistencies, physical_fit
from figaroh_jax.formats.config import Baseline

GAIN = np.array([1.0, 13.6, 13.6, -8.7, -8.7, -20.5968, -20.5968, -20.5968])
JOINTS = ["torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8))]


class Rows(NamedTuple):
    """Columns and torque of the joints whose rows are fitted, the samples first."""

    X: np.ndarray
    tau: np.ndarray

    def rmse(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        each = np.sqrt(np.mean((self.tau - self.X @ theta) ** 2, axis=0))
        return float(np.sqrt(np.mean(each**2))), each


def rows(data_dir: Path, joints: slice, *, logged: bool) -> tuple[fj.RobotModel, Rows]:
    with np.load(data_dir / "tiago_dynamic" / "tiago_dynamic.npz") as file:
        t, q, dq, effort = (file[key][921:6791] for key in ("t", "q", "dq", "effort"))
    b, a = np.array(signal.butter(4, 2 / 50))

    def smooth(x: np.ndarray) -> np.ndarray:
        medians = np.stack([signal.medfilt(column, 5) for column in x.T], axis=1)
        return signal.filtfilt(b, a, medians, axis=0, padtype="odd", padlen=12)

    q = smooth(q)
    v = smooth(dq) if logged else np.gradient(q, t, axis=0)
    acceleration = np.gradient(v, t, axis=0)
    model = fj.load_urdf(data_dir / "tiago_dynamic" / "tiago_no_hand.urdf", joints=JOINTS)
    known = Baseline(viscous=True, coulomb=True, rotor=True, offset=True)
    with jax.enable_x64(True):
        X = state_columns(model, friction_terms(model, known), jnp.zeros(model.nv), (), q, v, acceleration)
    X, tau = np.asarray(X)[:, joints], (effort * GAIN)[:, joints]
    return model, Rows(*(signal.decimate(x, 10, axis=0, zero_phase=True) for x in (X, tau)))


def fitted(found: Rows) -> tuple[int, float, np.ndarray]:
    """Rank and ordinary least squares of the base parameters."""
    columns = found.X.shape[2]
    X = found.X.reshape(-1, columns)
    base = base_parameters(np.asarray(np.linalg.qr(X, mode="r")), [str(k) for k in range(columns)])
    theta = np.zeros(columns)
    theta[base.independent] = np.linalg.lstsq(X[:, base.independent], found.tau.ravel(), rcond=None)[0]
    return base.rank, *found.rmse(theta)


@pytest.mark.parametrize(
    ("joints", "logged", "rank", "total", "each"),
    [
        (slice(0, 8), True, 73, 0.7331, [0.275, 1.032, 1.383, 0.858, 0.659, 0.188, 0.175, 0.094]),
        (slice(0, 8), False, 73, 0.6430, [0.249, 1.020, 1.125, 0.731, 0.592, 0.157, 0.166, 0.060]),
        (slice(1, 5), False, 57, 0.8843, [1.020, 1.105, 0.724, 0.587]),
    ],
)
def test_errors_of_the_fits_are_the_published_ones(
    joints: slice, logged: bool, rank: int, total: float, each: list[float], data_dir: Path
):
    _, found = rows(data_dir, joints, logged=logged)
    seen, rmse, single = fitted(found)
    assert len(found.tau) == 587
    assert rmse == pytest.approx(total, abs=2e-4)
    np.testing.assert_allclose(single, each, rtol=0, atol=1e-3)
    assert seen == rank


def test_direct_fit_with_links_that_exist_is_as_good_as_published(data_dir: Path):
    """0.9020 N m by a semidefinite program of others on the same rows."""
    model, found = rows(data_dir, slice(1, 5), logged=False)
    X = found.X.reshape(-1, found.X.shape[2])
    R = np.asarray(np.linalg.qr(np.column_stack([X, found.tau.ravel()]), mode="r"))
    theta = physical_fit(np.concatenate([R, 1e-5 * np.eye(*R.shape)]), bodies(model))
    assert not inconsistencies(theta[: 10 * len(model.joints)].reshape(-1, 10), model.link_names)
    assert found.rmse(theta)[0] <= 0.9020 + 2e-4
