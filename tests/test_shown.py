"""What a public object prints in an interpreter: a few lines that say what it is, also of a batch and while tracing."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from test_rollout_own import Bristle

import figaroh_jax as fj
from figaroh_jax.estimation.free import Free, Part
from figaroh_jax.results import Diagnosis, Estimate, Gain, Name

ROBOT = fj.load_urdf(fj.DEMO)
MODEL = fj.extend(ROBOT, fj.place(fj.CATALOGUE["viscous_friction"], ROBOT, ["elbow"], damping=1.5))
DRIVES = {name: {"kind": "position", "kp": 60.0, "kd": 4.0} for name in ROBOT.joint_names}
FREE = Free((Part("effect", (0, "damping"), (0,), (1,), ("viscous_friction elbow damping",), ("N m s/rad",), (1.0,)),))


def fitted(values: Any = (0.0,)) -> fj.Fit:
    """A fit of one number."""
    values = np.asarray(values)
    covariance = np.full((*np.shape(values), 1), 1e-4)
    rows = np.full((*np.shape(values)[:-1], 9), 0.5)
    return fj.Fit(MODEL, (), values, covariance, np.zeros(np.shape(values)), 1.0, rows, 1, None, {}, FREE)


def test_a_model_says_its_joints_and_effects():
    assert repr(ROBOT) == "RobotModel 'demo_arm': 4 joints (waist, shoulder, elbow, wrist), nq 4, nv 4, 9 frames"
    assert "viscous_friction elbow: ViscousFriction(at=(2,), damping=1.5)" in repr(MODEL)
    assert "(7,) of 4 joints" in repr(jax.tree.map(lambda x: np.stack([x] * 7), ROBOT))
    loop, _ = fj.load_loop(fj.DEMO, DRIVES)
    assert "drives: waist, shoulder, elbow, wrist; steps of 0.002 s" in repr(loop)
    seen: list[str] = []
    jax.eval_shape(lambda *trees: seen.extend(map(repr, trees)), MODEL, loop)  # they hold nothing but tracers here
    assert "ViscousFriction(at=(2,), damping=f" in seen[0] and "demo_arm" in seen[1]


def test_an_effect_shows_its_numbers_and_the_shapes_of_all_else():
    assert repr(fj.place(Bristle, ROBOT, ["elbow"], force=2.0)) == "Bristle(at=(2,), force=2, distance=0.02)"
    many = eqx.tree_at(lambda e: e.damping, fj.CATALOGUE["viscous_friction"](np.arange(4)[:, None]), np.ones(4))
    assert len(repr(many)) < 100 and "[4]" in repr(many)


def test_a_fit_says_its_numbers_with_sigma_and_unit():
    assert "viscous_friction elbow damping: 1.5 N m s/rad (σ 0.01)" in repr(fitted())
    assert "RMS of 9 rows 0.5" in repr(fitted()) and len(repr(fitted()).splitlines()) == 2
    batch = fitted(np.zeros((5, 1)))
    assert "batch (5,)" in repr(batch)
    with pytest.raises(fj.InputError, match="take `result`"):
        _ = batch.reason
    seen: list[str] = []
    jax.eval_shape(lambda found: seen.append(repr(found)), fitted())
    assert "traced" in seen[0]


def test_answers_are_a_headline_and_a_line_for_each_cause():
    gain, some = Gain(0.1, 0.02), np.ones(4)
    cause = fj.Cause(Name("torque_gain", ("elbow",)), {"gain": Estimate(0.1, 0.01, "1")}, 0.9, gain)
    lines = [
        "Diagnosis: named; held out: error 0.1 -> 0.02 (relative RMS)",
        "  torque_gain (elbow): gain 0.1 1 (σ 0.01); error 0.1 -> 0.02 (relative RMS)",
    ]
    found = Diagnosis(
        verdict="named", causes=(cause,), p_value=0.0, joints=ROBOT.joint_names, before=some, after=some, noise=some,
        holdout=gain, holdout_scheme="", experiment=None, candidates=(), traces=(), baseline=MODEL, model=MODEL,
    )  # fmt: skip
    assert repr(found).splitlines() == lines
    assert repr(fj.Selection(verdict="nothing", causes=())) == "Selection: nothing"


def test_recordings_and_data_say_how_much_they_hold():
    q = np.sin(np.arange(400)[:, None] / 60.0 + np.arange(4))
    run = fj.recording(q=q, tau=q, rate=100, model=ROBOT, name="run")
    assert repr(run).startswith("Recording 'run' (fit): 400 samples in 3.99 s; position (400, 4), torque (400, 4)")
    seen = fj.postures(q=q[:20], position=np.zeros((20, 3)), base_frame="base", tool_frame="hand", name="tracker")
    assert repr(seen).startswith("PoseRecording 'tracker' (fit): 20 postures; position (20, 1, 3) from base to hand")
    assert repr(fj.learn(ROBOT)).startswith("Learned: 30 base parameters of 'demo_arm': Izz1, ")
    assert "viscous_friction" in repr(fj.CATALOGUE) and "<class" not in repr(fj.CATALOGUE)
