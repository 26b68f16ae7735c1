"""Torques, postures and a rollout in one fit: it finds what is hidden in an arm of MuJoCo C."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import optimistix
import pytest
from generators import joint_arm

import figaroh_jax as fj


@pytest.mark.slow
def test_one_fit_of_three_kinds_of_data_finds_the_hidden_arm(tmp_path: Path):
    (tmp_path / "arm.xml").write_text(joint_arm.ARM.format(**joint_arm.NOMINAL))
    seen = joint_arm.record(seed=101)
    loop, _ = fj.load_loop(tmp_path / "arm.xml")
    run = fj.recording(q=seen.followed, command=seen.command, rate=100)
    rollout = fj.rollout_data(loop, run, noise=joint_arm.ENCODER_NOISE)
    model = rollout.model

    run = fj.recording(q=seen.moved, tau=seen.torque, rate=250)
    low_passed = joint_arm.TORQUE_NOISE * np.sqrt(2 * 10 / 250)  # 10 of 125 Hz of white noise pass
    torque = fj.torque_data(model, run, fj.Preprocess(cutoff=10, rate=20), noise=low_passed)
    points = fj.postures(q=seen.held, position=seen.point, base_frame="world", tool_frame="tip", unknown=[])
    (postures,) = fj.pose_data(model, points, sigma=(joint_arm.TRACKER_NOISE, 1.0))

    free = {"inertia": ["fore"], "friction": True, "joint_offset": True, "link_geometry": ["elbow x"], "start": True}
    found = fj.fit(model, [torque, postures, rollout], free, prior={"inertia": 0.5})
    assert found.result == optimistix.RESULTS.successful and int(found.rank) == len(found.values)
    assert 0.9 < np.sqrt(np.mean(np.asarray(found.rows) ** 2)) < 1.2  # the noise of each kind, nothing more
    pulls = []
    for name, truth in joint_arm.truth().items():
        value, std, _ = found.parameters[name]
        nominal = value - found.values[found.free.names.index(name)]
        assert abs(value - truth) < 4 * std < 0.2 * abs(truth - nominal)  # hidden, and far more than its interval
        pulls.append((value - truth) / std)
    assert np.sqrt(np.mean(np.square(pulls))) < 1.5
    # the same arm explains each kind of data, whatever the others weigh
    for data in found.data:
        assert np.sqrt(np.mean(np.asarray(fj.residual(found.model, data)) ** 2)) < 1.5
