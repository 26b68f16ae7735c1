"""Whether a name may stand beside its interval: recordings by MuJoCo C whose torque beyond the model's differs."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from generators import servo_arm
from scipy import stats

from figaroh_jax.reporting import wording
from figaroh_jax.results import BoundedEstimate, Estimate, Name
from figaroh_jax.rollouts.data import Run
from figaroh_jax.rollouts.found import Search
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.rest import nearest_of
from figaroh_jax.rollouts.search import search
from figaroh_jax.rollouts.setting import setting
from figaroh_jax.rollouts.sizes import is_open, least_sure

ROWS = 4000
OFFSET = Name("torque_offset", ("joint",))
DIFFER, ALIKE = (0.3, 0.25, -0.04, 0.17, 0.14, 0.0), (0.3, 0.25, 0.2, 0.35, 0.28, 0.22)  # N m


def record(number: int, torque: float, friction: float) -> Run:
    """8 s of the arm with a constant torque and a dry friction of its own."""
    model = mujoco.MjModel.from_xml_string(servo_arm.model_text(friction=friction))
    data = mujoco.MjData(model)
    t, u = (x[:ROWS] for x in servo_arm.command())
    q = np.zeros(ROWS)
    for k in range(ROWS):
        q[k], data.ctrl[0], data.qfrc_applied[0] = data.qpos[0], u[k], torque
        mujoco.mj_step(model, data)
    q += np.random.default_rng([number, 5]).normal(0, 2e-4, ROWS)
    return Run(f"run {number}", t, u[:, None], q[:, None], None)


def found(folder: Path, torques: tuple[float, ...], friction: float) -> Search:
    """The search for a constant torque and dry friction, which is another than the model's .3 N m."""
    (folder / "arm.xml").write_text(servo_arm.model_text())
    loop, _ = load_loop(folder / "arm.xml")
    runs = [record(k, one, friction) for k, one in enumerate(torques)]
    every = {c.effect for c in setting(loop, runs).known.candidates} | {"joint_elasticity", "backlash"}
    left_out = tuple(every - {"friction_loss", "torque_offset"})
    return search(setting(loop, runs, baseline=("joint_damping",), forbid=left_out), forbid=left_out)


def test_a_cause_whose_interval_holds_zero_is_told_beside_the_names_and_the_others_are_fitted_without_it(
    tmp_path: Path,
):
    """Most recordings are predicted better with a torque of .14 N m, whose mean may be none."""
    one = found(tmp_path, DIFFER, 0.8)
    assert one.verdict == "named+rest"
    assert [n.candidate.effect for n in one.named] == ["friction_loss"]
    near = nearest_of(one)[0]
    assert near.name == OFFSET
    size, half = map(float, re.findall(r"-?[0-9.]+", near.why_not)[:2])
    mean, spread = -np.mean(DIFFER), np.std(DIFFER, ddof=1) / np.sqrt(6)
    assert size == pytest.approx(mean, abs=0.01)
    assert half == pytest.approx(stats.t.ppf(0.975, 5) * spread, rel=0.1)
    offset = next(k for k, entry in enumerate(one.structure.table) if entry.name == "offset")
    assert offset not in one.last.free
    assert one.last.theta[offset] == 0.0
    assert one.table[-1][0] == f"without {OFFSET}"
    assert one.held[-1] == pytest.approx(one.held[1], rel=0.01)  # friction alone again


def test_a_size_that_recordings_tell_alike_keeps_its_name_and_friction_keeps_it_in_any_case(tmp_path: Path):
    one = found(tmp_path, ALIKE, 0.6)
    assert one.verdict == "named+rest"
    assert {n.candidate.effect for n in one.named} == {"torque_offset", "friction_loss"}
    causes, at = [n.candidate for n in one.named], (one.structure, one.last)
    assert least_sure(causes, *at, one.spread) is None
    open_sizes = np.full(len(one.last.free), 10.0)
    unsure = least_sure(causes, *at, open_sizes)
    assert unsure is not None
    assert unsure.effect == "torque_offset"
    assert all(is_open(c, *at, open_sizes) for c in causes)
    assert least_sure([c for c in causes if c is not unsure], *at, open_sizes) is None


def test_an_interval_is_cut_where_the_number_cannot_be():
    assert wording.interval(BoundedEstimate(0.424, 0.66, "N m", 0.0)) == "0.42 (0 to 1.7) N m"
    assert wording.interval(Estimate(0.424, 0.66, "N m")) == "0.4 ± 1.3 N m"
    assert wording.interval(BoundedEstimate(0.424, 0.1, "N m", 0.0)) == "0.42 ± 0.20 N m"
