"""A friction that all joints of an arm share, too small at each of them to be told beside a rest, made by MuJoCo C."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from generators import servo_arm6

from figaroh_jax.rollouts.arm import search_arm
from figaroh_jax.rollouts.data import Run, Stretch
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.setting import setting

SPEED = 0.1  # rad/s


def record(number: int, more: float, differ: float) -> Run:
    """8 s of the arm, whose friction and damping differ by recording and whose friction at rest is larger."""
    rng = np.random.default_rng([1, number, 31])
    friction, damping = (
        np.array(x) * (1 + differ * rng.standard_normal(6)) for x in (servo_arm6.FRICTION, servo_arm6.DAMPING)
    )
    model = mujoco.MjModel.from_xml_string(servo_arm6.model_text())
    data, every = mujoco.MjData(model), servo_arm6.EVERY
    u = np.repeat(servo_arm6.command(1, number)[::every], every, 0)[:4000]
    q, data.qpos[:], model.dof_damping[:] = np.zeros_like(u), u[0], damping
    for k, one in enumerate(u):
        model.dof_frictionloss[:] = friction * (1 + more * np.exp(-((data.qvel / SPEED) ** 2)))
        q[k], data.ctrl[:] = data.qpos, one
        mujoco.mj_step(model, data)
    q = q[::every] + rng.normal(0, servo_arm6.NOISE, (len(u) // every, 6))
    return Run(f"run {number}", np.arange(len(q)) * servo_arm6.DT * every, u[::every], q, None)


def names_and_sizes(path: Path, more: float, differ: float) -> tuple[str, dict[tuple[str, str], np.ndarray]]:
    path.write_text(servo_arm6.model_text(1.2))
    runs = [record(number, more, differ) for number in range(6)]
    cut = [Stretch(k, first, 400) for k in range(6) for first in (0, 400)]
    found = search_arm(setting(load_loop(path)[0], runs, stretches=cut))
    told = found.named or found.proxy
    return found.verdict, {
        (n.candidate.effect, n.candidate.at[0]): found.last.theta[list(n.candidate.entries)] for n in told
    }


@pytest.mark.slow
def test_friction_that_falls_with_speed_at_all_joints_is_told_beside_a_rest(tmp_path: Path):
    """30 % more friction at rest where friction and damping differ by 5 % between six recordings."""
    verdict, found = names_and_sizes(tmp_path / "arm.xml", 0.3, 0.05)
    assert verdict == "named+rest"
    assert set(found) == {("stribeck_friction", name) for name in servo_arm6.NAMES}
    for (_, name), (force, speed) in found.items():
        truth = 0.3 * servo_arm6.FRICTION[servo_arm6.NAMES.index(name)]
        assert force == pytest.approx(truth, rel=0.25)
        assert speed == pytest.approx(SPEED, rel=0.15)


@pytest.mark.slow
def test_friction_that_differs_by_recording_has_no_name(tmp_path: Path):
    assert names_and_sizes(tmp_path / "arm.xml", 0.0, 0.1) == ("unknown", {})
