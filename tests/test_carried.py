"""A body that the robot carries for a part of a recording: found, timed and weighed; a joint that changes is none."""

from __future__ import annotations

import re
import secrets
import tempfile
from pathlib import Path

import numpy as np
import pytest
from generators import robots
from generators.inverse import make_case

import figaroh_jax as fj
from benchmarks.conditions import graded, make
from figaroh_jax.diagnosis.carried import _parameters, _slopes

TOLD = re.compile(r"in (\d) from ([\d.]+) s to ([\d.]+) s, ([\d.]+) \+- ([\d.e-]+) kg")


def carried(seed: int, run: int, seconds: float) -> tuple[float, float, float]:
    """From when to when, s, and which mass, kg, as `conditions.py` draws it."""
    rng = np.random.default_rng((seed, 2, run))
    start = rng.uniform(0.1, 0.5)
    return start * seconds, (start + rng.uniform(0.2, 0.4)) * seconds, 0.7 * rng.uniform(0.4, 2)


@pytest.mark.parametrize("seed", [42005, pytest.param(42017, marks=pytest.mark.slow)])
def test_what_is_gripped_and_let_go_is_timed_and_weighed(seed: int):
    """MuJoCo C's torque of a body at the forearm's tip in the course of each recording; it was `unknown`."""
    with tempfile.TemporaryDirectory() as folder:
        told, _ = make(Path(folder), seed, "carried")
        found = fj.diagnose_task(fj.load_task(f"{folder}/task.yaml"))
    assert isinstance(found, fj.Diagnosis)
    (cause,) = found.causes
    assert (found.verdict, cause.name.effect, cause.name.at) == ("named", "payload", ("fore",))
    assert f"payload at fore is {cause.note}" in found.notes  # which answer.json has
    stretches = TOLD.findall(cause.note)
    assert len(stretches) == told.recordings
    for run, *numbers in stretches:
        begins, ends, mass, wide = map(float, numbers)
        truth = carried(seed, int(run), told.seconds)
        assert abs(begins - truth[0]) < 0.25 and abs(ends - truth[1]) < 0.25, (run, truth)
        assert abs(mass - truth[2]) < max(2 * wide, 0.02), (run, truth)
    com = [cause.parameters[f"com_{axis}"] for axis in "xz"]
    assert all(abs(one.value - true) < 3.5 * one.std for one, true in zip(com, (0.3, 0.05), strict=True))
    assert found.holdout.after < 0.2 * found.holdout.before
    assert (found.after < 0.5 * found.before).all()


@pytest.mark.parametrize("hidden", ["changed", pytest.param("clean", marks=pytest.mark.slow)])
def test_a_joint_that_changes_for_a_while_carries_nothing(hidden: str):
    """Another friction, gain or zero of one joint looks like a body on its axis."""
    seed = secrets.randbits(31)
    assert not [name for name in graded(seed, hidden)["names"] if name.startswith("payload")], seed


@pytest.mark.parametrize("seed", [42008, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (42011, 42021))])
def test_changes_that_looked_like_a_body_have_no_such_name(seed: int):
    """Before a second joint had to show it, each of these was a payload."""
    assert not [name for name in graded(seed, "changed")["names"] if name.startswith("payload")]


def test_the_parameters_of_a_body_without_extent_are_those_of_a_pseudo_inertia_of_rank_one():
    """m [c; 1] [c; 1]' is the pseudo-inertia of a point; moments as Pinocchio orders them."""
    rng = np.random.default_rng(0)
    body = np.array([rng.uniform(0.1, 2), *rng.normal(size=3)])
    mass, com = body[0], body[1:]
    moments = mass * (com @ com * np.eye(3) - np.outer(com, com))
    expected = [mass, *(mass * com), *(moments[i, k] for i, k in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)))]
    assert np.abs(_parameters(body) - expected).max() < 1e-12
    step = 1e-6
    for k in range(4):
        moved = step * np.eye(4)[k]
        difference = (_parameters(body + moved) - _parameters(body - moved)) / (2 * step)
        assert np.abs(_slopes(body)[:, k] - difference).max() < 1e-8


@pytest.mark.slow
@pytest.mark.skipif(not robots.available("tx40"), reason="FIGAROH_JAX_DATA has no staubli_tx40")
def test_a_load_of_all_recordings_is_not_carried_in_a_part_of_them():
    """The best stretch is all of a recording then; one bound to be shorter had said that the robot grips."""
    case = make_case([("payload", 0.05, ("link_6",))], repeats=2, trajectories=3, seed=secrets.randbits(31))
    with tempfile.TemporaryDirectory() as folder:
        found = fj.diagnose_task(fj.load_task(case.write(Path(folder))))
    assert isinstance(found, fj.Diagnosis)
    assert not [cause for cause in found.causes if "carried" in cause.note or "more of it" in cause.note], case


@pytest.mark.slow
def test_a_load_that_is_forbidden_is_not_named():
    with tempfile.TemporaryDirectory() as folder:
        make(Path(folder), 42005, "carried")
        task = Path(folder, "task.yaml")
        task.write_text(task.read_text() + "diagnose: {forbid: [payload]}\n")
        found = fj.diagnose_task(fj.load_task(task))
    assert isinstance(found, fj.Diagnosis)
    assert found.verdict == "unknown" and not found.causes
