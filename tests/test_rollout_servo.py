"""What a hobby servo's simulation gets wrong, whichever of its runs are fitted: the drive is at its limit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from figaroh_jax.results import Name
from figaroh_jax.rollouts.causes import Candidate
from figaroh_jax.rollouts.data import Run
from figaroh_jax.rollouts.found import Named
from figaroh_jax.rollouts.loop import Loop
from figaroh_jax.rollouts.parameters import put
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.search import leading, search
from figaroh_jax.rollouts.setting import setting
from figaroh_jax.rollouts.task import proxies, simulated

LEFT_OUT = ("payload", "encoder_offset", "torque_offset", "joint_elasticity", "backlash")  # alike beside free gains


@pytest.mark.slow
@pytest.mark.parametrize(("first", "every"), [(1, 4), (3, 4), (2, 5), (0, 3)])
def test_a_drive_at_its_limit_is_found_though_the_baseline_looks_soft_and_heavy(
    first: int, every: int, data_dir: Path
) -> None:
    """Free gains fit most of it with a sixth of the stiffness; nothing but limits and delays is named, and runs that
    were not fitted are predicted with half the error."""
    runs = []
    for k, one in enumerate(json.loads((data_dir / "servo_miuzei" / "dataset.json").read_text())["data"]):
        if one["type"] != "drop" and None not in one["actions"]:
            command = np.array(one["actions"], float).reshape(-1, 1)
            position = np.array(one["sensor_data"], float).reshape(len(command), -1)[:, :1]
            runs.append(Run(f"run {k}", np.arange(len(command)) / 50.0, command, position, None))
    drive = {"servo": {"kind": "position", "kp": 25.0, "kd": 5.0}}
    loop, _ = load_loop(data_dir / "servo_miuzei" / "servo_meshfree.xml", drive, law="hard", dt=0.005)
    here = setting(
        loop, runs[first::every], baseline=("rotor_inertia", "friction_loss"), gains_known=False, block=0.24,
        more=[("actuator_gain", "servo"), ("joint_damping", "servo")], forbid=LEFT_OUT,
    )  # fmt: skip
    found = search(here)
    told = [n.candidate.effect for n in found.named]
    assert told[0] in ("actuator_saturation", "voltage_saturation")
    assert set(told) <= {"actuator_saturation", "voltage_saturation", "command_delay"}
    unseen = [r for k, r in enumerate(runs) if k % every != first]

    def error(model: Loop) -> float:
        each = [np.mean((simulated(model, r) - r.position) ** 2) for r in unseen]
        return float(np.sqrt(np.mean(each)))

    begun = put(here.loop, here.known.table, found.first.theta)
    ended = put(found.structure.loop, found.structure.table, found.last.theta)
    assert error(ended) < 0.5 * error(begun)


def test_what_comes_near_are_fits_that_did_not_diverge():
    assert leading([float("nan"), 0.1, 0.3, float("-inf"), -0.2, 0.2]) == [2, 5, 1]


def test_a_proxy_is_told_with_what_does_as_well():
    """A load and a drive's gain look alike to the joint that carries the load."""
    load = Candidate("payload", ("arm",), (7,), ((0.1,),), ("mass",))
    assert proxies([Named(load, 5.0, 0.8, (Name("actuator_gain", ("servo",)),))]) == (
        "payload (arm) or actuator_gain (servo)"
    )
