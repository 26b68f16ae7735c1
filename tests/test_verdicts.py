"""Verdicts on single parameters, against the row space of Pinocchio's regressor on the same motion."""

from __future__ import annotations

from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import simulated_arm
from simulated_arm import Truth, recording

from figaroh_jax.estimation.priors import rigid_prior
from figaroh_jax.formats.config import Preprocess
from figaroh_jax.identification import identification
from figaroh_jax.recordings.dataset import Recording

identify = partial(identification.identify, check=False)  # of arms that no check would let pass

TRUST = 0.1
CASES = [moving for moving in product((True, False), repeat=3) if any(moving)]


def columns(truth: Truth, one: Recording) -> np.ndarray:
    """Rows of all parameters on the motion, in units of the torque's noise."""
    data = truth.model.createData()
    dt = 1 / simulated_arm.RATE
    v, a = np.gradient(one.position, dt, axis=0), np.gradient(np.gradient(one.position, dt, axis=0), dt, axis=0)
    rows = []
    for state in list(zip(one.position, v, a, strict=True))[5:-5:4]:
        rigid = pin.computeJointTorqueRegressor(truth.model, data, *state)
        drives = [np.diag(state[1]), np.diag(np.sign(state[1]))]
        rows.append(np.concatenate([rigid, *drives], axis=1) / simulated_arm.TORQUE_NOISE[:, None])
    return 2.0 * np.concatenate(rows)  # every fourth sample counts for four


def judged(truth: Truth, moving: tuple[bool, ...], seed: int) -> list[tuple[str, str, str]]:
    """Name, verdict expected and verdict given of every parameter that is clearly the one or the other."""
    one = recording(truth, 15.0, seed=seed, moving=moving)
    found = identify(truth.nominal, [one], Preprocess(cutoff=10), trust=TRUST)
    W = columns(truth, one)
    length = np.linalg.norm(W, axis=0)
    seen = length > 1e-9 * length.max()
    scaled = W / np.where(seen, length, 1.0) * seen
    values, V = np.linalg.svd(scaled, full_matrices=False)[1:]
    V = V[values > 1e-7 * values[0]]
    told = seen & ((V**2).sum(axis=0) > 1 - 1e-6)
    inverse = np.linalg.pinv(scaled, rcond=1e-7)
    std = np.linalg.norm(inverse, axis=1) / np.where(seen, length, 1.0)
    believed = 1 / np.sqrt(rigid_prior(truth.nominal, TRUST)[1])
    out = []
    for k, parameter in enumerate(found.parameters):
        inertial = k < len(believed)
        if not told[k]:
            expected = "prior only" if inertial else "not identifiable"
            contained = parameter.null_direction.replace("-", " ").split()
            assert parameter.name in contained or parameter.status == "identified"
        elif not inertial or std[k] < 0.3 * believed[k]:
            expected = "identified"
        elif std[k] > 3 * believed[k]:
            expected = "prior only"
        else:
            continue
        out.append((parameter.name, expected, parameter.status))
    return out


def right(cases: list[tuple[tuple[bool, ...], int]], folder: Path) -> float:
    verdicts = []
    for moving, seed in cases:
        truth = simulated_arm.arm(folder, seed=seed)
        verdicts += judged(truth, moving, seed)
    wrong = [v for v in verdicts if v[1] != v[2]]
    print(f"{len(cases)} cases, {len(verdicts)} verdicts, wrong {len(wrong)}: {wrong[:10]}")  # pytest -s
    assert {expected for _, expected, _ in verdicts} == {"identified", "prior only", "not identifiable"}
    return 1 - len(wrong) / len(verdicts)


def test_verdicts_are_those_of_the_row_space(tmp_path: Path):
    assert right([(moving, 100 + k) for k, moving in enumerate(CASES[:3])], tmp_path) >= 0.95


@pytest.mark.slow
def test_verdicts_are_right_in_fifty_cases(tmp_path: Path):
    assert right([(CASES[k % len(CASES)], k) for k in range(50)], tmp_path) >= 0.95
