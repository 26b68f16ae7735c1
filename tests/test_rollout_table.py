"""A table under an arm of six servos, made by MuJoCo C with a real contact: found where it is touched, never else."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import mujoco
import numpy as np
import pytest
from generators import servo_arm6

from figaroh_jax.rollouts.arm import search_arm
from figaroh_jax.rollouts.data import Run, Stretch
from figaroh_jax.rollouts.loop import Loop
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.setting import setting
from figaroh_jax.rollouts.table import on_table

END = "</body></body></body></body></body></body>"
TIP = '<geom type="sphere" size=".005" condim="1" pos="0.01 0 0.05" mass="0"/><site name="tip" pos="0.01 0 0.05"/>'
SMALL = {  # a desk arm: light links, servos whose friction is as large as their load
    "KP": (16.0, 12.0, 11.0, 12.0, 28.0, 30.0), "KV": (0.01,) * 6, "DAMPING": (1.3, 0.85, 0.76, 0.96, 1.9, 1.9),
    "FRICTION": (0.15, 0.4, 0.44, 0.14, 0.28, 0.2), "ARMATURE": (0.028,) * 6, "MASS": (0.1, 0.1, 0.1, 0.08, 0.09, 0.02),
    "LENGTH": (0.06, 0.12, 0.13, 0.06, 0.06, 0.05),
}  # fmt: skip


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Loop:
    """The loop of the arm, as the recordings' arm is."""
    for name, numbers in SMALL.items():
        monkeypatch.setattr(servo_arm6, name, numbers)
    (tmp_path / "arm.xml").write_text(text(None))
    return load_loop(tmp_path / "arm.xml")[0]


def text(height: float | None) -> str:
    made = servo_arm6.model_text().replace('<flag contact="disable"/>', "").replace(END, TIP + END)
    plane = "" if height is None else f'<geom type="plane" condim="1" size="3 3 .1" pos="0 0 {height}"/>'
    return made.replace("<worldbody>", f"<worldbody>{plane}")


def record(height: float | None, number: int) -> tuple[Run, np.ndarray]:
    """24 s of slow waves at 100 Hz, and at which rows the tip touches."""
    model = mujoco.MjModel.from_xml_string(text(height))
    data, rng = mujoco.MjData(model), np.random.default_rng([1, number])
    t = np.arange(round(24 / servo_arm6.DT))[:, None] * servo_arm6.DT
    wave = np.sin(2 * np.pi * rng.uniform(0.04, 0.08, 6) * t + rng.uniform(0, 6, 6))
    u = np.array([0, 1.2, 0.7, 0.4, 0, 0]) + np.array([0.4, 0.35, 0.3, 0.3, 0.3, 0.1]) * wave
    u = np.repeat(u[:: servo_arm6.EVERY], servo_arm6.EVERY, 0)
    q, touches = np.zeros_like(u), np.zeros(len(u), bool)
    data.qpos[:] = u[0]
    for k, one in enumerate(u):
        q[k], data.ctrl[:] = data.qpos, one
        mujoco.mj_step(model, data)
        touches[k] = data.ncon > 0
    q = q[:: servo_arm6.EVERY] + rng.normal(0, servo_arm6.NOISE, (len(u) // servo_arm6.EVERY, 6))
    return Run(f"run {number}", np.arange(len(q)) * 0.01, u[:: servo_arm6.EVERY], q, None), touches[:: servo_arm6.EVERY]


def test_a_table_is_told_with_time_height_and_force_where_the_arm_rests_on_it(small: Loop):
    """One recording touches a plane for 2.7 s with 2 N, one does not: times to half a second, height to 1 cm."""
    height = -0.1365
    recordings = [record(height, k) for k in (1, 2)]
    found = on_table(small, [run for run, _ in recordings])
    assert found is not None
    assert found.height == pytest.approx(height, abs=0.012)
    assert [x.run for x in found.stretches] == [1]
    for one in found.stretches:
        run, touches = recordings[one.run]
        times = run.time[touches]
        assert one.first == pytest.approx(times[0], abs=0.5)
        assert one.last == pytest.approx(times[-1], abs=0.5)
        assert 0.5 < one.force < 4
        assert {1, 2} <= set(one.joints) <= {1, 2, 3}


def test_no_table_where_there_is_none_however_wrong_the_model(small: Loop):
    """The same motions without a plane, with the right model, half and twice the friction, other masses and gains."""
    runs = [record(None, k)[0] for k in range(3)]
    changes = [
        lambda m: small,
        lambda m: eqx.tree_at(lambda x: x.joints.friction, m, 0.5 * np.asarray(m.joints.friction)),
        lambda m: eqx.tree_at(lambda x: x.joints.friction, m, 2.0 * np.asarray(m.joints.friction)),
        lambda m: eqx.tree_at(lambda x: x.robot.inertia, m, 1.5 * np.asarray(m.robot.inertia)),
        lambda m: eqx.tree_at(lambda x: x.robot.inertia, m, 0.5 * np.asarray(m.robot.inertia)),
        lambda m: eqx.tree_at(lambda x: x.drives.scale, m, 1.3 * np.asarray(m.drives.scale)),
    ]
    assert [on_table(change(small), runs) for change in changes] == [None] * len(changes)


@pytest.mark.slow
def test_a_recording_whose_only_fault_is_the_table_says_contact_and_nothing_else(small: Loop):
    """One recording, two seconds on a plane, friction in the model: no name, no second contact where none is."""
    run, touches = record(-0.1365, 0)
    times = run.time[touches]
    cut = [Stretch(0, first, 400) for first in range(0, len(run.time), 400)]
    loop = eqx.tree_at(lambda m: m.joints.friction, small, 1.2 * np.asarray(small.joints.friction))
    found = search_arm(setting(loop, [run], stretches=cut))
    assert (found.verdict, found.named, found.proxy) == ("nothing", [], [])
    (fault,) = found.faults
    assert fault.kind == "contact"
    assert fault.table == pytest.approx(-0.1365, abs=0.012)
    assert fault.first == pytest.approx(times[0], abs=0.5)
    assert fault.last == pytest.approx(times[-1], abs=0.5)
