"""Recordings as strangers make them (`benchmarks/conditions.py`, torques of MuJoCo C): each read something else before.

What was wrong stands beside each. What reads a motion (steps of an encoder, stamps without decimals, samples between
which dry friction turns) and slow noise in the band of a slow motion are no misfit of the model.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import figaroh_jax as fj
from benchmarks.conditions import Strange, draw, graded, make, motion, moved
from figaroh_jax.reporting.wording import sentence


@pytest.mark.parametrize(
    ("seed", "strange"),
    [
        pytest.param(
            5021, False, marks=pytest.mark.slow
        ),  # a link's inertia: noise of 10 % in the band of a slow motion, 4096 counts
        pytest.param(21003, False, marks=pytest.mark.slow),  # a ripple: 4 s of slow noise
        pytest.param(21057, False, marks=pytest.mark.slow),  # unknown: friction turns between samples 20 ms apart
        (1007, True),  # unknown: 60 Hz with stamps in whole milliseconds
        pytest.param(
            4128483, False, marks=pytest.mark.slow
        ),  # unknown: what slow noise carries through rows left out passed for noise at 10 to 20 Hz
        pytest.param(
            971270108, False, marks=pytest.mark.slow
        ),  # unknown: slow noise, most of whose power is a hundredth of the band
        pytest.param(
            4128371, False, marks=pytest.mark.slow
        ),  # unknown: two repeats of 4 s, whose common power was told twice
        pytest.param(
            4129578, True, marks=pytest.mark.slow
        ),  # unknown: repeats with a torque of ten bits, whose steps repeat
        pytest.param(971272111, True, marks=pytest.mark.slow),  # unknown: a known payload was taken for a wrong clock
    ],
)
def test_a_right_model_is_told_so(seed: int, strange: bool) -> None:
    told = graded(seed, "clean", strange)
    assert (told["grade"], told["names"]) == ("nothing", []), told


def test_a_rotor_is_named_where_slow_noise_and_steps_are_asked_for() -> None:
    told = graded(6002, "rotor")
    assert (told["grade"], told["names"]) == ("named", ["rotor_inertia at elbow"]), told


def test_what_repeats_at_one_joint_is_told_beside_the_noise_of_another() -> None:
    told = graded(971276306, "foreign")  # 1.7 % of the elbow's torque
    assert (told["grade"], int(np.argmax(told["relative"]))) == ("unknown", 1), told


def test_what_few_rows_cannot_tell_from_slow_noise_is_not_called_agreement(tmp_path: Path) -> None:
    """16 s with a torque of 15 % hidden at the elbow: no effect has it, and a rich model takes it for slow noise."""
    make(tmp_path, 9310010, "foreign")
    found = fj.diagnose_task(fj.load_task(str(tmp_path / "task.yaml")))
    assert isinstance(found, fj.Diagnosis)
    assert (found.verdict, int(np.argmax(found.rest.relative))) == ("nothing", 1)
    assert found.rest.relative[1] > 0.03 and "not enough to tell that from slow noise" in found.rest.undecided
    assert "of the torque of elbow is left" in sentence(found, "two") and "agrees" not in sentence(found, "two")
    assert found.experiment is not None and "s of such motion in all" in found.experiment.text


@pytest.mark.slow
def test_as_few_rows_of_a_right_model_agree_with_it(tmp_path: Path) -> None:
    make(tmp_path, 6633519, "clean")  # 8 s
    found = fj.diagnose_task(fj.load_task(str(tmp_path / "task.yaml")))
    assert isinstance(found, fj.Diagnosis)
    assert (found.verdict, found.rest.undecided, found.experiment) == ("nothing", "", None)
    assert "agrees with the data" in sentence(found, "two")


@pytest.mark.parametrize("pause", [0.0, 0.25])
def test_the_motion_is_the_integral_of_its_velocity(pause: float) -> None:
    rng = np.random.default_rng(3)
    told = draw(rng)
    waves, t = motion(rng, told), np.arange(0, told.seconds, 1e-4)
    q, v, a = moved(t, waves, told, pause)
    inner = slice(5, -5)
    np.testing.assert_allclose(np.gradient(q, 1e-4, axis=0)[inner], v[inner], rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.gradient(v, 1e-4, axis=0)[inner], a[inner], rtol=0, atol=1e-2)
    assert Strange() == Strange(lost=0.0)


@pytest.mark.slow
def test_a_ripple_that_the_catalogue_lacks_is_told_without_repeats(tmp_path: Path, data_dir: Path) -> None:
    """What 15 % of a joint's torque leaves of long data is not taken for slow noise (read `nothing` before)."""
    only = ["--seed", "247155", "--kinds", "inverse", "--clean", "0", "--only", "torque_ripple-0.15-tx40"]
    root = Path(__file__).resolve().parents[1]
    program = [sys.executable, "-m", "benchmarks.hide_and_name", "generate", "--cases", str(tmp_path), *only]
    subprocess.run(program, cwd=root, env=os.environ | {"PYTHONPATH": str(root)}, check=True, capture_output=True)
    (told,) = tmp_path.glob("inverse/*/case.json")
    case = json.loads(told.read_text())
    task = case["task"] | {"diagnose": {"forbid": case["forbid"]}}
    task["robot"]["model"] = str(tmp_path / case["model"])
    for recording in task["data"]:
        recording["file"] = str(tmp_path / recording["file"])
    (tmp_path / "task.yaml").write_text(json.dumps(task))
    found = fj.diagnose_task(fj.load_task(tmp_path / "task.yaml"))
    assert (found.verdict, found.causes) == ("unknown", ())
