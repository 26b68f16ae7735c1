"""Torques as strangers record them: cases that MuJoCo C makes, through the command line, and what was mended for them.

The cases are drawn by `benchmarks/torque_conditions.py`; each was `unknown`, or had a wrong name, for a reason of its
own.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.torque_conditions import answered, drawn
from figaroh_jax import recording
from figaroh_jax.estimation.columns import joint_labels
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.mjcf import load_mjcf
from figaroh_jax.formats.recording_keys import Preprocess
from figaroh_jax.identification.identification import identify_task
from figaroh_jax.recordings.likeness import likeness
from figaroh_jax.recordings.resampling import read_clock
from figaroh_jax.recordings.signals import prepare_all


@pytest.mark.parametrize(
    ("seed", "mark"),
    [
        pytest.param(2, "nothing", id="two joints that move one after another, stamps that shake"),
        pytest.param(21, "nothing", id="joints that rest, one of them gated", marks=pytest.mark.slow),
        pytest.param(
            38,
            "nothing",
            id="a joint about the vertical that rests: its torque is all friction",
            marks=pytest.mark.slow,
        ),
        pytest.param(94, "nothing", id="moves with rests, without a filter", marks=pytest.mark.slow),
        pytest.param(104, "nothing", id="stamps that shake, a recording kept out", marks=pytest.mark.slow),
        pytest.param(
            73, "nothing", id="an offset of the baseline, and a difference that takes it off", marks=pytest.mark.slow
        ),
        pytest.param(70, "right", id="a coupling behind columns in another order", marks=pytest.mark.slow),
        pytest.param(33, "right", id="an offset of a joint that rests", marks=pytest.mark.slow),
    ],
)
def test_a_strangers_recording_gets_its_cause(seed: int, mark: str) -> None:
    case = drawn(np.random.default_rng([seed, 91]), Namespace(effects=[], most=5))
    assert case is not None
    marks, lines = answered(case, ["diagnose"])
    assert marks == [mark], (case.told, lines)


@pytest.mark.parametrize(
    ("seed", "effects", "mark"),
    [
        pytest.param(
            7073, [], "nothing", id="steps of an encoder that a gear's resonance filters out", marks=pytest.mark.slow
        ),
        pytest.param(
            31000,
            [],
            "nothing",
            id="a joint's position smoothed alone, for another's is abrupt",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            50, [], "unknown", id="the same of five joints beside an error of an encoder", marks=pytest.mark.slow
        ),
        pytest.param(9046, ["joint_elasticity"], "right", id="a gear that winds up"),
        pytest.param(9031, ["joint_elasticity"], "right", id="the same beside rests", marks=pytest.mark.slow),
    ],
)
def test_steps_of_an_encoder_are_no_elasticity(seed: int, effects: list[str], mark: str) -> None:
    case = drawn(np.random.default_rng([seed, 91]), Namespace(effects=effects, most=5))
    assert case is not None
    marks, lines = answered(case, ["diagnose"])
    assert marks == [mark], (case.told, lines)


@pytest.mark.slow
def test_no_robot_whose_joints_rest_gets_a_name() -> None:
    """Six drawn at run time that hide nothing: more than one named is no chance (one of a hundred is)."""
    seeds = np.random.default_rng().integers(10**6, 10**9, 6).tolist()
    named = []
    for seed in seeds:
        case = drawn(np.random.default_rng([seed, 91]), Namespace(effects=["nothing"], most=3))
        if case is not None and (mark := answered(case, ["diagnose"])[0][0]) not in ("nothing", "unknown"):
            named.append((seed, mark))
    assert len(named) <= 1, named


def motion(t: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(2.1 * t) + 0.3 * np.sin(5.3 * t + 1), 0.7 * np.cos(3.3 * t)], 1)


def test_stamps_that_shake_are_read_on_the_clock_behind_them() -> None:
    """A driver that samples evenly and stamps late by chance, with a sample lost: the clock comes back."""
    rng = np.random.default_rng(3)
    true = 12.5 + np.delete(np.arange(2000), 700) / 100.0
    position = motion(true) + 1e-5 * rng.standard_normal((1999, 2))
    shaken = true + rng.uniform(-1e-3, 1e-3, 1999)
    clock = read_clock(shaken, position)
    assert np.abs(clock - true).max() < 1e-4
    assert np.diff(clock)[699] == pytest.approx(0.02, rel=1e-3)  # where the sample lacks


def test_samples_that_were_taken_unevenly_keep_their_stamps() -> None:
    rng = np.random.default_rng(4)
    true = np.arange(2000) / 100.0 + rng.uniform(-1e-3, 1e-3, 2000)
    position = motion(true) + 1e-5 * rng.standard_normal((2000, 2))
    np.testing.assert_array_equal(read_clock(true, position), true)
    coarse = np.round(motion(true) / 0.05) * 0.05  # an encoder that tells nothing of either clock
    np.testing.assert_array_equal(read_clock(true, coarse), true)


def resting() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """20 s at 200 Hz of two joints, the first of which stands from 8 to 12 s; its friction then holds .8 N m."""
    t = np.arange(4000) / 200.0
    pace = np.clip(np.abs(t - 10) - 2, 0, 1)
    clock = np.cumsum(3 * pace**2 - 2 * pace**3) / 200.0
    q = np.stack([np.sin(2.3 * clock), 0.5 * np.sin(1.7 * t)], 1)
    v = np.gradient(q, 1 / 200, axis=0)
    tau = 2.0 * np.sin(q) + np.tanh(v / 1e-3) * [1.0, 0.2]
    tau[(t > 8) & (t < 12), 0] = 2.0 * np.sin(q[1800, 0]) - 0.8
    return t, q, tau


def test_rows_at_which_a_joint_stands_have_no_weight_and_those_of_a_reversal_have() -> None:
    t, q, tau = resting()
    (signals,) = prepare_all([recording(q=q, tau=tau, time=t)], Preprocess(cutoff=10, rate=50))
    rows, weight = signals.time[signals.rows.index], np.asarray(signals.rows.weight)
    inside, outside = (rows > 8.0) & (rows < 12.0), (rows < 7.0) | (rows > 13.0)
    assert signals.stands is not None
    assert signals.stands[inside, 0].all() and not weight[inside, 0].any()
    assert weight[outside].all() and weight[:, 1].all()  # the second joint only turns round
    (free,) = prepare_all([recording(q=q, tau=tau, time=t)], Preprocess(cutoff=10, rate=50), sticks=False)
    assert free.stands is None and np.asarray(free.rows.weight).all()  # a robot without dry friction
    still = np.where(np.arange(4000)[:, None] < 3900, q[:1], q)  # what hardly ever moves is not judged by its rests
    (signals,) = prepare_all([recording(q=still, tau=tau, time=t)], Preprocess(cutoff=10, rate=50))
    assert np.asarray(signals.rows.weight).all()


def test_a_torque_held_by_friction_is_no_reason_to_doubt_its_column() -> None:
    """A light joint that rests half the time: what friction holds is three times what its weight needs."""
    t, q, _ = resting()
    nominal = 0.5 * np.sin(q[:, 0]) + 0.3 * np.sin(2.7 * t)
    v, a = np.gradient(q[:, 0], 1 / 200), np.gradient(np.gradient(q[:, 0], 1 / 200), 1 / 200)
    rng = np.random.default_rng(0)
    held = 1.5 * np.repeat(rng.uniform(-1, 1, 20), 200)
    stands = np.abs(v) < 1e-3
    tau = nominal + np.where(stands, held, 0.3 * np.tanh(v / 1e-2)) + 0.01 * rng.standard_normal(len(t))
    found = likeness(nominal[::10], tau[::10], v[::10], a[::10])
    assert found.correlation > 0.98 and found.slope == pytest.approx(1.0, abs=0.05)


def test_identification_beside_rests_comes_to_the_friction_that_slides(tmp_path: Path) -> None:
    """MuJoCo C's friction of a made robot whose joints rest for more than half of the time: 10 %, by its own truth."""
    case = drawn(np.random.default_rng([21, 91]), Namespace(effects=[], most=5))
    assert case is not None
    answered(case, [], keep=tmp_path)
    found = identify_task(load_task(tmp_path / "task.yaml"))
    told = {e.name.at[0]: e.parameters["force"].value for e in found.effects if e.name.effect == "coulomb_friction"}
    for name, value in told.items():
        assert value == pytest.approx(case.numbers[f"friction {name}"], rel=0.1)


def test_a_joint_has_the_number_of_its_link_whatever_the_order_of_its_column(tmp_path: Path) -> None:
    """`fc1` was the friction of the first column beside `m1` of the first link: here those of two joints."""
    case = drawn(np.random.default_rng([8069, 91]), Namespace(effects=["nothing"], most=5))
    assert case is not None and case.task["robot"]["joints"] == ["j1", "j0"]
    assert case.numbers["fc1"] > 5 * case.numbers["fc2"] and case.numbers["fv1"] > 5 * case.numbers["fv2"]
    answered(case, [], keep=tmp_path)
    found = identify_task(load_task(tmp_path / "task.yaml"))
    told = {one.expression: one for one in found.base}
    for name in ("fc1", "fc2", "fv1", "fv2"):
        assert told[name].value == pytest.approx(case.numbers[name], abs=4 * told[name].std), name
        assert told[name].std < 0.05 * case.numbers[name]


def test_joints_of_several_coordinates_and_behind_a_free_root_are_numbered_by_links(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text(
        """<mujoco><worldbody><body name="root"><freejoint/><geom size=".1"/><body name="leg"><joint name="a"/>
        <geom size=".1"/><body name="ball"><joint type="ball" name="b"/><geom size=".1"/></body></body></body>
        </worldbody></mujoco>"""
    )
    assert joint_labels(load_mjcf(tmp_path / "robot.xml"))[6:] == ("2", "3.1", "3.2", "3.3")
