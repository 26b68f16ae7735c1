"""Rollouts of an arm whose file says another gain than the robot's, and of one whose torque drifts, by MuJoCo C."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import figaroh_jax as fj
from figaroh_jax.reporting.rollout_report import show_rollouts
from figaroh_jax.rollouts.identification import identify_rollout_task

mujoco = pytest.importorskip("mujoco")

ARM = """<mujoco model="servo"><compiler angle="radian" autolimits="true"/>
<option timestep="0.002" integrator="implicitfast"/>
<default><joint damping="0.4" armature="0.02" frictionloss="0.05"/>
<position kp="20" kv="0.8" forcerange="-4 4"/></default>
<worldbody><body name="b1" pos="0 0 0.1">
<inertial pos="0 0 0.05" mass="0.8" diaginertia="0.002 0.002 0.001"/><joint name="pan" axis="0 0 1"/>
<body name="b2" pos="0 0 0.06"><inertial pos="0.1 0 0" mass="0.5" diaginertia="0.0004 0.002 0.002"/>
<joint name="lift" axis="0 1 0"/>
<body name="b3" pos="0.22 0 0"><inertial pos="0.08 0 0" mass="0.3" diaginertia="0.0002 0.0008 0.0008"/>
<joint name="elbow" axis="0 1 0"/></body></body></body></worldbody>
<actuator><position name="m_pan" joint="pan"/><position name="m_lift" joint="lift" kp="40" forcerange="-8 8"/>
<position name="m_elbow" joint="elbow"/></actuator></mujoco>"""


def recorded(
    folder: Path, seed: int, change: Callable[[Any], None] = lambda model: None, pushed: float = 0.0
) -> dict[str, Any]:
    """The task of three recordings of 10 s at 100 Hz; `pushed` N m/s at the lift grow with time."""
    (folder / "arm.xml").write_text(ARM)
    rng, entries = np.random.default_rng(seed), []
    for run in range(3):
        model = mujoco.MjModel.from_xml_string(ARM)
        change(model)
        data, t = mujoco.MjData(model), np.arange(1000) / 100
        waves = [(f, *rng.uniform([0.1, 0.0], [0.45, 6.0], (3, 2)).T) for f in (0.13, 0.31, 0.57, 0.9)]
        u = np.sum([size * np.sin(2 * np.pi * f * t[:, None] + phase) for f, size, phase in waves], axis=0)
        u = (u - [0.0, 0.3, 0.0]) * np.clip(t, 0, 1)[:, None]
        q = np.zeros_like(u)
        for k in range(len(t)):
            q[k], data.ctrl[:] = data.qpos, u[k]
            for _ in range(5):
                data.qfrc_applied[1] = pushed * data.time
                mujoco.mj_step(model, data)
        np.savez(folder / f"run{run}.npz", t=t, u=u, q=q + 2e-4 * rng.standard_normal(q.shape))
        entries.append({"file": f"run{run}.npz", "time": "t", "command": "u", "position": "q"})
    return {"robot": {"model": "arm.xml"}, "data": entries}


def answered(folder: Path, task: dict[str, Any]) -> fj.Diagnosis:
    (folder / "task.yaml").write_text(yaml.safe_dump(task))
    found = fj.diagnose_task(fj.load_task(folder / "task.yaml"))
    assert isinstance(found, fj.Diagnosis)
    return found


@pytest.mark.slow
def test_a_gain_that_is_off_is_no_load(tmp_path: Path) -> None:
    """The gain of the lift is less than the file's: a load at its link does as much there, and moves the pan."""
    seed = secrets.randbits(32)
    rng = np.random.default_rng(seed)
    gain = float(rng.uniform(29, 34))

    def softer(model: Any) -> None:
        model.actuator_gainprm[1, 0], model.actuator_biasprm[1, 1] = gain, -gain

    task = recorded(tmp_path, seed, softer)
    taken = answered(tmp_path, task)
    assert all(cause.name.effect not in ("payload", "link_inertia") for cause in taken.causes), seed
    assert taken.verdict == "unknown", seed
    assert any("actuator_gain (lift)" in near.why_not for near in taken.rest.nearest), seed
    told = answered(tmp_path, task | {"actuator": {"gains": "free"}})
    assert [(c.name.effect, c.name.at) for c in told.causes] == [("actuator_gain", ("lift",))], seed
    assert told.causes[0].parameters["gain"].value == pytest.approx(gain / 40 - 1, abs=0.01), seed


@pytest.mark.slow
def test_a_torque_that_grows_with_time_is_no_link(tmp_path: Path) -> None:
    """Ten numbers of a link follow a part of it together, and none of them is surely there."""
    seed = secrets.randbits(32)
    found = answered(tmp_path, recorded(tmp_path, seed, pushed=0.04))
    assert found.verdict == "unknown", (seed, found.causes)
    assert "time" in [part.kind for part in found.rest.parts if part.at == ("lift",)], seed


@pytest.mark.parametrize("share", [1.0, 0.8])
def test_numbers_beside_a_gain_that_is_off_are_not_told_without_a_word(
    share: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def softer(model: Any) -> None:
        model.actuator_gainprm[1, 0], model.actuator_biasprm[1, 1] = 40 * share, -40 * share

    task = recorded(tmp_path, secrets.randbits(32), softer)
    gain = {"effects": [{"effect": "actuator_gain", "at": ["lift"]}]}
    for baseline in ({}, {"baseline": gain}):
        (tmp_path / "task.yaml").write_text(yaml.safe_dump(task | {"actuator": {"gains": "known"}} | baseline))
        found = identify_rollout_task(fj.load_task(tmp_path / "task.yaml"))
        show_rollouts(found, "servo")
        said = " ".join(capsys.readouterr().out.split())
        assert ("or the gain of a drive is off" in said) == (share < 1 and not baseline)
        damping = {one["expression"]: one["value"] for one in found.result["base_parameters"]}["damping lift"]
        assert (abs(damping - 0.4) > 0.1) == (share < 1 and not baseline)
