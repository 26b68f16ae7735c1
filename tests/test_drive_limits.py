"""A drive at its limit: what its torque says of the rest of the model, and limits that are found and sized."""

from __future__ import annotations

import secrets
import tempfile
from pathlib import Path

import numpy as np
import pytest
import robots
from generators import robots as real_robots
from generators.inverse import make_case
from synthetic import made_signals

import figaroh_jax as fj
from figaroh_jax.diagnosis.design import with_shape
from figaroh_jax.diagnosis.layout import held_rows, layout
from figaroh_jax.diagnosis.problem import Problem
from figaroh_jax.diagnosis.state import baseline, extended_state, solved, whitened
from figaroh_jax.effects.base import place
from figaroh_jax.effects.catalogue import find
from figaroh_jax.recordings.stacked import filtered_rows, stack
from figaroh_jax.simulators.native import NativeBackend

needs_robots = pytest.mark.skipif(not real_robots.available("tx40"), reason="FIGAROH_JAX_DATA has no staubli_tx40")


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_rows_at_a_limit_are_the_derivatives_of_what_the_drive_gives(tmp_path: Path, share: float):
    """Against differences of the clipped torque (NumPy): at its limit a drive says nothing of what it was to give."""
    model = robots.load(robots.ARM, tmp_path)
    signals = [made_signals(8.0)]
    records = stack(signals, model)
    held = held_rows(signals, records)
    problem = Problem(NativeBackend(model), records, layout(signals, records), 0.1, np.zeros(2), held)
    free = baseline(problem, ["viscous_friction", "coulomb_friction"])
    rng = np.random.default_rng(11)
    free = solved(free, free.prior.mean + 0.05 * rng.normal(size=len(free.prior.mean)))
    whitening = np.ones((len(records.omega), 1)) / np.array([0.2, 0.1])
    total = free.torque(free.theta)
    limit = float(np.median(np.abs(total[:, 0])))
    drive = place(find("torque_saturation"), model, ("turn",), share=share, limit=limit)
    cut = extended_state(problem, free, drive)
    theta = np.append(free.theta, share)

    def given(theta: np.ndarray) -> np.ndarray:
        wanted = free.torque(theta)
        wanted[:, 0] += share * (np.clip(wanted[:, 0], -limit, limit) - wanted[:, 0])
        return wanted

    rows, measured = whitened(problem, cut, whitening), whitened(problem, free, whitening).y
    np.testing.assert_allclose(cut.torque(theta), given(free.theta), rtol=0, atol=1e-12)
    left = measured - filtered_rows(records, given(free.theta), whitening)
    np.testing.assert_allclose(rows.y - rows.X @ theta, left, rtol=0, atol=1e-9)
    for _ in range(5):
        along = rng.normal(size=len(free.theta))
        ahead, behind = (given(free.theta + side * 1e-7 * along) for side in (1, -1))
        slope = filtered_rows(records, (ahead - behind) / 2e-7, whitening)
        np.testing.assert_allclose(rows.X.dense()[..., :-1] @ along, slope, rtol=0, atol=1e-5 * np.abs(slope).max())


@needs_robots
@pytest.mark.parametrize(
    "size, at, trajectories, seed",
    [
        (0.12, "joint_4", 2, secrets.randbits(31)),
        pytest.param(0.03, "joint_5", 4, secrets.randbits(31), marks=pytest.mark.slow),
        pytest.param(0.03, "joint_5", 4, 1456421666, marks=pytest.mark.slow),
    ],
    ids=["half of the time at its limit", "seldom at its limit", "at its limit where recordings end"],
)
def test_a_limit_is_found_and_sized(size: float, at: str, trajectories: int, seed: int):
    """Where a drive is often at its limit, Stribeck friction of a sign that cannot be had stood in its place; where
    few parts of the recordings reach it, its interval had no end. The ends of a recording have no rows: a limit that is
    reached there was below the tolerance."""
    hidden = make_case([("torque_saturation", size, (at,))], repeats=1, trajectories=trajectories, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        found = fj.diagnose_task(fj.load_task(hidden.write(Path(folder))))
    assert isinstance(found, fj.Diagnosis)
    assert [tuple(cause.name) for cause in found.causes] == [("torque_saturation", (at,))], seed
    told, truth = found.causes[0].parameters["limit"], hidden.truth[0].parameters["limit"]
    assert abs(told.value - truth) < 4.5 * told.std < 0.3 * truth, seed


def test_a_limit_that_the_torque_passes_is_none():
    model_torque = np.linspace(-10.0, 10.0, 2001)
    drive = with_shape(find("torque_saturation")(np.array([0])), ["share", "limit"], [np.float64(1.0), np.float64(8.0)])
    noisy = np.clip(model_torque, -8.0, 8.0) + 0.2 * np.random.default_rng(2).normal(size=len(model_torque))
    assert drive.allows(noisy) and not drive.allows(model_torque)
