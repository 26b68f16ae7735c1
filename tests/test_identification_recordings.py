"""Identification of real robots from their recordings, against what others have reached on them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import real_tasks

import figaroh_jax as fj
from figaroh_jax.identification.identification import identify_task
from figaroh_jax.identification.result import Identification, Quality


def pooled(quality: Quality) -> float:
    """RMSE over all joints, whose rows are equally many but for the gate."""
    return float(np.sqrt(np.mean(quality.rms**2)))


def physical(found: Identification) -> bool:
    return all(link.consistent for link in found.links)


@cache
def tx40(folder: Path, data: Path, gated: bool = True, backend: str = "native") -> Identification:
    return identify_task(fj.load_task(real_tasks.tx40_task(folder, data, gated=gated)), backend=backend)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tx40")


@pytest.mark.parametrize(("gated", "limit"), [(True, 1.25), (False, 1.6)])
def test_tx40_cross_validated_error_beats_figaroh(gated: bool, limit: float, data_dir: Path, folder: Path):
    """figaroh's pipeline, corrected: 1.256 to 1.301 N m with the gate, 2.08 without."""
    found = tx40(folder, data_dir, gated)
    assert (found.rank, found.structural_rank) == (61, 61)
    assert pooled(found.validated) <= limit
    assert physical(found) and pooled(found.fit) <= 1.01 * pooled(found.unconstrained)


@pytest.mark.slow
@pytest.mark.parametrize(
    "backend",
    ["mujoco", "pinocchio", "mjx"],
)
def test_every_backend_identifies_the_same_parameters(backend: str, data_dir: Path, folder: Path):
    want, got = tx40(folder, data_dir), tx40(folder, data_dir, backend=backend)
    assert [one.expression for one in got.base] == [one.expression for one in want.base]
    assert [one.status for one in got.base] == [one.status for one in want.base]
    got_base, want_base = ([(one.value, one.std) for one in found.base] for found in (got, want))
    np.testing.assert_allclose(got_base, want_base, rtol=1e-6, atol=1e-6)
    for one, same in zip(want.links, got.links, strict=True):  # to what the conic solver leaves of a link's size
        size = float(np.linalg.norm(one.parameters))
        np.testing.assert_allclose(same.parameters, one.parameters, rtol=0, atol=1e-6 * max(1.0, size))
    for one, same in zip(want.effects, got.effects, strict=True):
        left, right = ([(e.value, e.std) for e in effect.parameters.values()] for effect in (same, one))
        np.testing.assert_allclose(left, right, rtol=1e-6, atol=1e-6, err_msg=str(one.name))


@pytest.mark.slow
def test_tiago_arm_predicts_the_last_part_of_its_recording(data_dir: Path, tmp_path: Path):
    """figaroh: 1.028 N m (1.024 weighted)."""
    found = identify_task(fj.load_task(real_tasks.tiago_task(tmp_path, data_dir)))
    assert pooled(found.holdout["last.npz"]) <= 1.00
    # the free fit has a negative rotor, and the stated trust holds where no torque shows: without it 1.033
    assert physical(found) and pooled(found.fit) <= 1.05 * pooled(found.unconstrained)


@pytest.mark.slow
def test_panda_predicts_the_last_part_of_its_recording(data_dir: Path, tmp_path: Path):
    found = identify_task(fj.load_task(real_tasks.panda_task(tmp_path, data_dir)))
    reached = np.array([0.996, 0.999, 0.999, 0.999, 0.995, 0.999, 0.97])
    assert (np.round(found.holdout["last.npz"].r2, 3) >= reached).all()
    # the free fit has a negative moment about the last axis, and the stated trust holds where no torque shows: the
    # error held out is 4 % above that without trust, the fit's 11 % above the free one
    assert physical(found) and pooled(found.fit) <= 1.12 * pooled(found.unconstrained)


@pytest.mark.slow
def test_ur10e_predicts_other_runs(data_dir: Path, tmp_path: Path):
    found = identify_task(fj.load_task(real_tasks.ur10e_task(tmp_path, data_dir)))
    r2 = np.mean([quality.r2 for quality in found.holdout.values()], axis=0)
    reached = np.array([0.988, 0.996, 0.997, 0.981, 0.955, 0.976])
    assert (r2 >= reached - 1e-3).all()
    assert physical(found) and pooled(found.fit) <= 1.01 * pooled(found.unconstrained)
