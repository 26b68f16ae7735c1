"""`fj.select`: what a model lacks, by data with a residual and nothing else."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

import figaroh_jax as fj

RATES = np.array([3.0, 4.4, 5.6, 6.9])  # rad/s


def _measured(stiffness: float) -> tuple[fj.RobotModel, fj.TorqueData]:
    """A motion that dies away over 6 s, by Pinocchio, with a spring at the elbow and noise of .02 N m."""
    robot, model = fj.load_urdf(fj.DEMO), pin.buildModelFromUrdf(str(fj.DEMO))
    t = np.arange(1500)[:, None] / 250.0
    rate = RATES * 1j - 1.0
    swing = 0.6 * np.exp(rate * t + 1j * np.arange(4))
    q, v, a = swing.imag, (rate * swing).imag, (rate**2 * swing).imag
    data = model.createData()
    tau = np.array([pin.rnea(model, data, *rows) for rows in zip(q, v, a, strict=True)])
    tau[:, list(robot.joint_names).index("elbow")] += stiffness * q[:, list(robot.joint_names).index("elbow")]
    tau += 0.02 * np.random.default_rng(0).normal(size=q.shape)
    return robot, fj.torque_data(robot, fj.recording(q=q, tau=tau, rate=250), fj.Preprocess(cutoff=20))


@pytest.mark.parametrize("stiffness", [3.0, 0.0])
def test_a_spring_is_selected_though_most_of_its_torque_is_in_few_stretches(stiffness: float):
    """It takes 99.7 % of the squares, and p of the paired t was .034: `nothing` (the clean twin is, and stays so)."""
    robot, data = _measured(stiffness)
    springs = [fj.place(fj.CATALOGUE["joint_spring"], robot, [joint]) for joint in robot.joint_names]
    found = fj.select(robot, data, springs, most=1)
    if not stiffness:
        assert (found.verdict, found.causes) == ("nothing", ())
        return
    (cause,) = found.causes
    size = cause.parameters["stiffness"]
    assert (found.verdict, cause.name) == ("named", ("joint_spring", ("elbow",)))
    assert size.std is not None
    assert abs(size.value - stiffness) < 4 * size.std < 0.05
