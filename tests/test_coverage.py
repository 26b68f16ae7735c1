"""Intervals cover: the truth lies within 95 % intervals of the base parameters in 95 % of the cases."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import simulated_arm
import tasks
from robots import joint, link, robot
from simulated_arm import recording

from figaroh_jax.estimation.base_parameters import base_parameters
from figaroh_jax.estimation.columns import column_names, friction_terms, structural_columns
from figaroh_jax.formats.config import Baseline, Preprocess
from figaroh_jax.identification import identification

identify = partial(identification.identify, check=False)  # of arms that no check would let pass

LIMIT = '<limit lower="-3" upper="3" effort="100" velocity="5"/>'
JOINTS = joint("j1", "base", "a", axis="0 1 0", more=LIMIT), joint("j2", "a", "b", more=LIMIT)
SHORT = robot(link("base"), link("a", 2.0), link("b", 1.5), *JOINTS)
ROBOTS = {"bench": tasks.URDF, "short": SHORT}


def scores(text: str, noise: Literal["white", "coloured"], runs: int, folder: Path) -> np.ndarray:
    """Errors of all base parameters in standard deviations; each run has a truth, a motion and noise of its own."""
    out = []
    for seed in range(runs):
        truth = simulated_arm.arm(folder, seed=seed, text=text)
        model = truth.nominal
        found = identify(model, [recording(truth, 15.0, seed=seed, noise=noise)], Preprocess(cutoff=10))
        terms = friction_terms(model, Baseline())
        X = structural_columns(model, terms)
        matrix = base_parameters(X.reshape(-1, X.shape[2]), column_names(model, terms)).matrix
        assert len(matrix) == found.rank
        value, std = (np.array([getattr(one, key) for one in found.base]) for key in ("value", "std"))
        out.append((value - matrix @ truth.theta) / std)
    return np.array(out)


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["white", "coloured"])
def test_intervals_cover_in_a_few_runs(noise: Literal["white", "coloured"], tmp_path: Path):
    covered = np.mean(np.abs(scores(SHORT, noise, 12, tmp_path)) < 1.96)
    assert 0.87 <= covered <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["white", "coloured"])
@pytest.mark.parametrize("name", ROBOTS)
def test_intervals_cover_in_two_hundred_runs(name: str, noise: Literal["white", "coloured"], tmp_path: Path):
    each = np.mean(np.abs(scores(ROBOTS[name], noise, 200, tmp_path)) < 1.96, axis=0)
    covered = each.mean()
    print(f"{name}, {noise}: {covered:.3f}, single parameters {each.min():.3f} to {each.max():.3f}")  # pytest -s
    assert 0.92 <= covered <= 0.98
