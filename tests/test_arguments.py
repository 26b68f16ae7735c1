"""Wrong arguments of public functions: the message names the argument and says what is expected."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jaxtyping
import numpy as np
import pytest

import figaroh_jax as fj
from figaroh_jax.rigid.dynamics import refuse_singular

ROBOT = fj.load_urdf(fj.DEMO)
Q = 0.5 * np.sin(np.arange(300)[:, None] / 30.0 + np.arange(4))
RUN = fj.recording(q=Q, tau=Q, rate=100)
VISCOUS: Any = fj.CATALOGUE["viscous_friction"]
MODEL = fj.extend(ROBOT, fj.place(VISCOUS, ROBOT, ["elbow"]))
DATA: Any = fj.torque_data(ROBOT, RUN, fj.Preprocess(cutoff=10))
FEW: Any = eqx.tree_at(lambda d: d.position, DATA, np.asarray(DATA.position)[:, :-5])
LEARNED = fj.learn(ROBOT)
TIME = np.arange(300) / 100.0
BASIS = fj.linear_basis(MODEL, DATA)
ONES = np.ones((2, 2))
LIGHT = eqx.tree_at(lambda r: r.inertia, ROBOT, np.asarray(ROBOT.inertia) * np.array([1.0, 1.0, 1.0, 0.0])[:, None])


def robot_with(name: str, value: Any) -> Any:
    """The robot with another array."""
    return eqx.tree_at(lambda r: getattr(r, name), ROBOT, value)


ANY: Any = fj
WRONG: dict[str, tuple[Callable[[], Any], str]] = {
    "gravity": (lambda: fj.inverse_dynamics(robot_with("gravity", np.zeros(2)), Q, Q, Q), r"model.gravity .*\(2,\)"),
    "batch": (lambda: fj.mass_matrix(robot_with("inertia", np.zeros((3, 4, 10))), Q), "model.inertia .* jax.vmap"),
    "class": (lambda: fj.extend(ROBOT, VISCOUS), "`place` makes.*ViscousFriction"),
    "list": (lambda: ANY.extend(ROBOT, list(MODEL.effects)), r"extend\(model, \*list\); got list"),
    "path": (lambda: ANY.extend(fj.DEMO), "model is of type str"),
    "swapped": (lambda: ANY.residual(DATA, MODEL), "model is of type TorqueData"),
    "swapped fit": (lambda: ANY.fit(DATA, MODEL, "effects"), "model is of type TorqueData"),
    "array": (lambda: ANY.torque_data(ROBOT, Q), "recordings: a Recording is expected, got a ndarray"),
    "cutoff": (lambda: ANY.torque_data(ROBOT, RUN, 15), r"Preprocess\(cutoff=15\)"),
    "identify": (lambda: ANY.identify(ROBOT, Q), "a Recording is expected, got a ndarray"),
    "diagnose": (lambda: ANY.diagnose(ROBOT, Q), "a Recording or a PoseRecording is expected, got a ndarray"),
    "calibrate": (lambda: ANY.calibrate(ROBOT, [RUN]), "a PoseRecording is expected, got a Recording"),
    "prior": (lambda: ANY.fit(MODEL, DATA, "effects", prior=0.1), "prior is 0.1; a mapping"),
    "bounds": (lambda: ANY.fit(MODEL, DATA, "effects", bounds={"viscous_friction": 1}), "a pair is expected"),
    "solver": (lambda: fj.fit(MODEL, DATA, "effects", solver="LM"), "solver is 'LM'; one of optimistix"),
    "other motion": (lambda: fj.residual(MODEL, FEW), r"data.position has shape .* but data.time \(1, "),
    "dt": (lambda: fj.predict(MODEL, TIME, Q, Q, Q, 0.0), "dt is 0.0; .*above zero, in s"),
    "step": (lambda: fj.simulate(MODEL, Q, Q[0], Q[0], -0.01), "dt is -0.01"),
    "basis": (lambda: ANY.excite(ROBOT, "fourier"), "basis is of type str; `fourier`, `spline`"),
    "weights": (lambda: fj.Trajectory(Q[0], np.ones((3, 3)), fj.spline(4, 2.0)).states(), r"\(4, 4\) is expected"),
    "motion": (lambda: ANY.information(ROBOT, Q, LEARNED), "three arrays"),
    "limits": (
        lambda: fj.fit_linear(MODEL, DATA, BASIS, lower=np.zeros(3)),
        r"lower has shape \(3,\); one number .* 23",
    ),
    "text for limits": (lambda: ANY.fit_linear(MODEL, DATA, BASIS, upper="1"), "upper holds text"),
    "basis and data": (lambda: ANY.fit_linear(MODEL, BASIS, DATA), "data is of type Basis; a TorqueData is expected"),
    "rate": (lambda: ANY.recording(q=Q, tau=Q, rate="100"), "rate is the text '100'; expected a number of Hz above"),
    "no file": (lambda: ANY.load_urdf(None), "path is None; the path of a file is expected"),
    "folder first": (
        lambda: ANY.write_model("out", MODEL),
        r"model is the text 'out'; an ExtendedModel or a RobotModel",
    ),
    "learned first": (lambda: ANY.information(LEARNED, (Q, Q, Q), ROBOT), r"Learned; .*information\(model, motion, l"),
    "device": (lambda: ANY.own_device(abs, {"x": 1.0}), r"unknowns\['x'\] is 1.0; its start, its unit and about how"),
    "unknown key": (lambda: ANY.Preprocess(cutof=3), "Preprocess: unknown key 'cutof'; did you mean 'cutoff'"),
    "wrong value": (lambda: fj.Preprocess(cutoff=-1), "Preprocess: cutoff is -1, expected more than 0"),
    "by position": (lambda: ANY.Preprocess(15), r"takes its arguments by name: Preprocess\(window=..., cutoff="),
    "no mass": (lambda: fj.forward_dynamics(LIGHT, Q[0], Q[0], Q[0]), "singular: joint wrist moves no mass; give the"),
    "no accelerations": (
        lambda: refuse_singular(np.array([[0.0, 0.0], [np.nan, 1.0]]), [np.ones((2, 2))], ("a", "b"), lambda row: ONES),
        "singular in row 1: some joints move one body alike",
    ),
    "loop": (lambda: ANY.rollout(ROBOT, Q, Q[0]), "loop is of type RobotModel; `load_loop`"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_argument_is_named(name: str, monkeypatch: pytest.MonkeyPatch):
    call, message = WRONG[name]
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # which users do not have in between
    with pytest.raises(fj.InputError, match=message):
        call()


def test_a_plain_robot_is_predicted_and_simulated():
    assert fj.predict(ROBOT, TIME, Q, Q, Q, 0.01).shape == (300, 4)
