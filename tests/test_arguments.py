"""Wrong arguments of public functions: the message names the argument and says what is expected."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jaxtyping
import numpy as np
import pytest

import figaroh_jax as fj
from figaroh_jax.errors import check_real
from figaroh_jax.reporting.motion_view import show_motion
from figaroh_jax.reporting.robot_view import show_diagnosis, show_run
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


def seen(**wrong: Any) -> Any:
    """Postures with wrong arguments."""
    return fj.postures(**({"q": Q, "position": Q[:, :3], "base_frame": "base", "tool_frame": "hand"} | wrong))


def device(**wrong: Any) -> Any:
    """A device for postures with wrong arguments."""
    return fj.Instrument("pose", "base", "hand", **wrong)


def turned(**more: Any) -> Any:
    """A recording whose columns are in another order than the robot's."""
    return fj.recording(q=Q, tau=Q, rate=100, joints=["elbow", "waist", "wrist", "shoulder"], **more)


SEEN = seen()
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
    "units": (
        lambda: fj.recording(q=Q, tau=Q, rate=100, units={"positon": "deg"}),
        "'positon'; did you mean 'position'",
    ),
    "unit": (
        lambda: ANY.recording(q=Q, tau=Q, rate=100, units="deg"),
        "units is the text 'deg'; a Mapping is expected",
    ),
    "role": (lambda: ANY.recording(q=Q, tau=Q, rate=100, role="test"), "role is 'test'; known: fit, holdout"),
    "load": (
        lambda: ANY.recording(q=Q, tau=Q, rate=100, load=2.0),
        r"load is of type float; a Load .* fj.Load\(frame=",
    ),
    "prior of no size": (
        lambda: fj.fit(MODEL, DATA, "inertia", prior={"inertia": 0.0}),
        "'inertia' is 0.0; .*above zero",
    ),
    "prior of nan": (
        lambda: fj.fit(MODEL, DATA, "inertia", prior={"inertia": np.nan}),
        "'inertia' is nan; .*above zero",
    ),
    "prior below zero": (lambda: fj.fit(MODEL, DATA, "inertia", prior={"inertia": -0.1}), "'inertia' is -0.1; .*zero"),
    "kind of a prior": (lambda: fj.fit(MODEL, DATA, "effects", prior={"x": 1.0}), "'x' is not free; free are effects"),
    "infinite noise": (lambda: fj.torque_data(ROBOT, RUN, noise=np.inf), "noise is inf; one sigma above zero"),
    "gate": (lambda: fj.torque_data(ROBOT, RUN, fj.Preprocess(gate={"elbo": 0.1})), "gate: no .*mean 'elbow'"),
    "milliseconds": (lambda: fj.recording(q=Q, tau=Q, time=4.0 * np.arange(300)), "stamps look like ms: add"),
    "dates": (lambda: ANY.recording(q=Q, tau=Q, time=TIME.astype("datetime64[s]")), "time holds dates; real"),
    "nan start": (lambda: fj.simulate(MODEL, Q, Q[0], np.full(4, np.nan), 0.01), "velocity holds nan; finite numbers"),
    "nan torque": (lambda: fj.simulate(MODEL, np.where(Q > 0.4, np.nan, Q), Q[0], Q[0], 0.01), "command holds nan; f"),
    "no posture": (lambda: seen(q=Q[:0], position=Q[:0, :3]), "recording 'postures': q holds no posture"),
    "no quaternion": (
        lambda: fj.postures(q=Q, pose=np.zeros((300, 7)), base_frame="base", tool_frame="hand"),
        "pose, row 0 .from 0.: the quaternion is zero",
    ),
    "baseline": (lambda: ANY.diagnose(ROBOT, [RUN], known="viscous"), "known is the text 'viscous'; a Baseline"),
    "baseline of a fit": (lambda: ANY.identify(ROBOT, [RUN], known=True), "known is of type bool; a Baseline"),
    "limits of links": (lambda: ANY.identify(ROBOT, [RUN], bounds="forearm"), "bounds is the text 'forearm'; a Map"),
    "progress": (lambda: ANY.diagnose(ROBOT, [RUN], progress=True), r"progress is True; a function .*\(phase, share\)"),
    "view of a design": (lambda: show_motion(ANY), "design is of type module; a Design"),
    "view of a diagnosis": (lambda: show_diagnosis(ANY), "diagnosis is of type module; a Diag"),
    "view of a run": (lambda: show_run("nowhere"), "nowhere: holds no run with a model"),
    "switch": (lambda: ANY.calibrate(ROBOT, [SEEN], priors="no"), "priors is the text 'no'; True or False is expected"),
    "check": (lambda: ANY.identify(ROBOT, [RUN], check="no"), "check is the text 'no'; True or False"),
    "kinematic": (lambda: ANY.load_urdf(fj.DEMO, kinematic=1), "kinematic is 1; True or False"),
    "polish": (lambda: ANY.excite_postures(ROBOT, device(), polish=None), "polish is None; True or False"),
    "choice": (lambda: ANY.shape("rad", (1.0,), choice="no"), "choice is the text 'no'; True or False"),
    "floating": (lambda: ANY.read_recordings(None, ROBOT, floating="no"), "floating is the text 'no'; True or False"),
    "switch of a baseline": (lambda: ANY.Baseline(coulomb="no"), "coulomb: expected true or false, not 'no'"),
    "text of an option": (lambda: ANY.Preprocess(cutoff="15"), "cutoff: expected a number, not the text '15'"),
    "texts of an option": (lambda: ANY.Preprocess(window=("0", 1)), r"window\[0\]: expected a number, not the text"),
    "packages": (lambda: fj.load_urdf(fj.DEMO, packages="src"), r"packages is the text 'src'; .*\['src'\]"),
    "option": (lambda: fj.diagnose(ROBOT, [RUN], tolerence=0.1), "diagnose has no argument 'tolerence'; .*'tolerance'"),
    "joint": (
        lambda: fj.recording(q=Q, tau=Q, rate=100, joints=["waist", "shoulder", "elbo", "wrist"], model=ROBOT),
        "'demo_arm' has no joint 'elbo'; did you mean 'elbow'",
    ),
    "joint twice": (lambda: fj.recording(q=Q, tau=Q, rate=100, joints=list("aabc")), "joints names 'a' twice"),
    "number of a joint": (
        lambda: ANY.recording(q=Q, tau=Q, rate=100, joints=[1, 2, 3, 4]),
        "joints is of type int; a str",
    ),
    "order": (lambda: fj.torque_data(ROBOT, turned()), r"'elbow', which is column 2 .* \[:, \[1, 3, 0, 2\]\]"),
    "order diagnosed": (lambda: fj.diagnose(ROBOT, [turned()]), "into its order, waist, shoulder, elbow, wrist"),
    "order of a model": (
        lambda: turned(model=ROBOT),
        "column 0 .from 0. 'elbow', which is column 2 of robot 'demo_arm'",
    ),
    "names": (lambda: fj.recording(q=Q, tau=Q, rate=100, joints="elbow"), "joints is the text 'elbow'; a list"),
    "extended": (lambda: ANY.recording(q=Q, tau=Q, rate=100, model=MODEL), "ExtendedModel; a RobotModel .* `.robot`"),
    "unknown frame": (lambda: seen(unknown="base_frame"), "unknown is the text 'base_frame'; a list is expected"),
    "base": (lambda: seen(base_frame=None), "base_frame is of type NoneType; a str is expected: the name of a frame"),
    "accuracy": (lambda: seen(accuracy=1e-3), "accuracy is 0.001; two are expected: one sigma in m and one in rad"),
    "mount": (lambda: seen(mount="tool"), "mount is 'tool'; known: hand, world"),
    "function": (lambda: seen(device=abs), "device is of type builtin_function_or_method; a Device .*`own_device`"),
    "task": (lambda: ANY.load_robot({"robot": 1}), "task is of type dict; a Task is expected: `load_task` reads one"),
    "posture": (lambda: ANY.load_urdf(fj.DEMO, posture=["elbow"]), "posture is of type list; a Mapping is expected"),
    "angle": (lambda: ANY.load_urdf(fj.DEMO, posture={"elbow": "1"}), "the position of joint 'elbow' holds text"),
    "folder": (lambda: ANY.load_model(ROBOT), "directory is of type RobotModel; the path of a file"),
    "write loop": (lambda: ANY.write_loop(ROBOT, "out"), r"RobotModel; a Loop is expected: `load_loop`"),
    "sigma": (
        lambda: fj.torque_data(ROBOT, RUN, noise=np.ones(3)),
        "one sigma above zero is expected .*for each joint",
    ),
    "pose data": (lambda: ANY.pose_data(ROBOT, [RUN]), "recordings: a PoseRecording is expected, got a Recording"),
    "no data": (lambda: ANY.residual(MODEL, "run.npz"), "data is str: expected recordings, postures or"),
    "free": (lambda: ANY.fit(MODEL, DATA, 3), "free is 3; one or several of inertia"),
    "candidates": (lambda: ANY.select(MODEL, DATA, None), "candidates is one NoneType; a list is expected"),
    "way to fit": (lambda: ANY.identify(ROBOT, [RUN], fit="phys"), "fit is 'phys'; did you mean 'physical'"),
    "nothing": (lambda: fj.identify(ROBOT, []), "recordings is empty"),
    "nothing to diagnose": (lambda: fj.diagnose(ROBOT, []), "recordings is empty"),
    "calibrated": (lambda: ANY.calibrate(MODEL, []), "ExtendedModel; a RobotModel .* holds one as `.robot`"),
    "diagnosed": (lambda: ANY.diagnose(MODEL, [RUN]), "ExtendedModel; a RobotModel or a backend of one is expected"),
    "forbid": (lambda: fj.diagnose(ROBOT, [RUN], forbid="backlash"), "forbid is the text 'backlash'; a list"),
    "known": (lambda: ANY.learn(ROBOT, "viscous"), "known is the text 'viscous'; a Baseline is expected"),
    "noise": (lambda: ANY.learn(ROBOT, noise="a"), "noise is the text 'a'; expected a number of relative one sigma"),
    "points": (lambda: ANY.spline("4", 3.0), "points is the text '4'; an int"),
    "duration": (lambda: fj.spline(4, 0.0), "duration is 0.0; expected a number of s above zero"),
    "limit": (lambda: ANY.limits_of(ROBOT, velocity=[1, 2]), r"limits.velocity is \[1, 2\]; a number for all joints"),
    "objective": (lambda: ANY.excite(ROBOT, fj.spline(4, 2.0), objective="dopt"), "objective is 'dopt'; .*condition"),
    "instrument": (lambda: ANY.excite_postures(ROBOT, "pose"), "instrument is the text 'pose'; an Instrument"),
    "no effect": (lambda: ANY.register(ROBOT), "a class of effects is expected"),
    "grid": (lambda: ANY.shape("rad", 3), "grid is 3; the values from which the search starts"),
    "text for a number": (
        lambda: fj.place(VISCOUS, ROBOT, "elbow", damping="1"),
        "damping is '1'; a number is expected",
    ),
    "width": (lambda: ANY.extend(ROBOT, width="1"), "width holds text; real numbers are expected"),
    "negative width": (lambda: fj.extend(ROBOT, width=-1.0), "width is -1; finite numbers of 0 or more"),
    "effect": (lambda: fj.calibrate(ROBOT, [SEEN], forbid=["joint_ofset"]), "forbid: no .*mean 'joint_offset'"),
    "effect of torques": (lambda: fj.diagnose(ROBOT, [RUN], forbid=["backlsh"]), "forbid: no .*mean 'backlash'"),
    "level of a test": (lambda: fj.diagnose(ROBOT, [RUN], alpha=2.0), "alpha is 2.0; .* above zero and below 1"),
    "trust": (lambda: fj.diagnose(ROBOT, [RUN], trust=-1.0), "trust is -1.0; .*one sigma above zero"),
    "trust of links": (lambda: ANY.identify(ROBOT, [RUN], trust="1"), "trust is the text '1'; .* above zero"),
    "trust of a design": (lambda: fj.excite(ROBOT, fj.spline(4, 2.0), trust=np.nan), "trust is nan; .* above zero"),
    "no motion": (
        lambda: fj.excite(ROBOT, fj.spline(4, 2.0), trajectories=0),
        "trajectories is 0; a whole number of 1",
    ),
    "tolerance": (lambda: fj.diagnose(ROBOT, [RUN], tolerance="0.1"), "tolerance holds text"),
    "count": (lambda: ANY.excite_postures(ROBOT, device(), count="9"), "count is the text '9'; a whole number of 1"),
    "level": (lambda: ANY.excite_postures(ROBOT, device(), level="ful"), "level is 'ful'; did you mean 'full'"),
    "positions": (
        lambda: fj.excite_postures(ROBOT, device(), position_limit=np.full((4, 2), np.nan)),
        "position_limit: 'waist' may move from nan to nan",
    ),
    "turned": (
        lambda: fj.excite_postures(ROBOT, device(), position_limit=np.tile([1.0, -1.0], (4, 1))),
        "'waist' may move from 1 to -1: the least comes first",
    ),
    "distances": (lambda: ANY.excite_postures(ROBOT, device(), clearance=0.1), "float; a Clearance is expected"),
    "one accuracy": (lambda: fj.excite_postures(ROBOT, device(accuracy=1e-3)), "accuracy is 0.001; two are expected"),
    "accuracy below zero": (
        lambda: fj.excite_postures(ROBOT, device(accuracy=(-1.0, 1.0))),
        "accuracy is -1.0; .* of m",
    ),
    "point": (lambda: fj.excite_postures(ROBOT, device(point="x")), "point holds text"),
    "view": (lambda: fj.excite_postures(ROBOT, device(view="x")), r"view is the text 'x'; a View is .*View\(place="),
    "steps of a fit": (lambda: fj.fit(MODEL, DATA, "effects", max_steps=-3), "max_steps is -3; a whole number of 1"),
    "nan limit": (
        lambda: fj.fit_linear(MODEL, DATA, BASIS, lower=np.full(23, np.nan)),
        "lower holds nan; .* inf where",
    ),
    "crossed": (lambda: ANY.fit_linear(MODEL, DATA, BASIS, lower=1.0, upper=0.0), "lower is above upper: 1 and 0"),
    "reversal": (lambda: fj.learn(ROBOT, width=-1.0), "width is -1; finite numbers of 0 or more"),
    "position limit": (lambda: ANY.limits_of(ROBOT, position="1"), "limits.position is the text '1'; a number, a map"),
    "limit of a joint": (lambda: ANY.limits_of(ROBOT, velocity={"elbow": "1"}), "limits.velocity: 'elbow' holds text"),
    "law": (lambda: fj.load_loop(fj.DEMO, law="sift"), "law is 'sift'; did you mean 'soft'"),
    "time step": (lambda: fj.load_loop(fj.DEMO, dt=-1.0), "dt is -1.0; .* s above zero"),
    "integrator": (lambda: ANY.load_loop(fj.DEMO, integrator="rk5"), "integrator is 'rk5'; did you mean 'rk4'"),
    "start of a device": (lambda: ANY.own_device(abs, {"x": ("0", "m", 1.0)}), "'x'.: its start holds text"),
    "size of a device": (
        lambda: ANY.own_device(abs, {"x": (0.0, "m", -1.0)}),
        "about how far off, is -1.0; .* of m above",
    ),
    "sigma of poses": (lambda: ANY.pose_data(ROBOT, SEEN, sigma=1e-3), "sigma is 0.001; two are expected"),
    "level of selection": (
        lambda: fj.select(MODEL, DATA, [MODEL.effects[0]], alpha=np.nan),
        "alpha is nan; .* below 1",
    ),
    "most": (lambda: fj.select(MODEL, DATA, [MODEL.effects[0]], most=-1), "most is -1; a whole number of 1 or more"),
    "nan in a grid": (lambda: fj.shape("rad", (np.nan, 1.0)), "grid holds nan"),
    "turned bounds": (lambda: fj.shape("rad", (1.0,), bounds=(2.0, 0.0)), r"bounds: \(2.0, 0.0\); least and greatest"),
    "text for a bound": (lambda: ANY.amplitude("N m", lower="a"), "lower and upper holds text"),
    "steps": (lambda: ANY.simulate(MODEL, Q, Q[0], Q[0], 0.01, steps=2.5), "steps is 2.5; a whole number of 0"),
    "report first": (lambda: ANY.write_report("x", "y", "z"), "diagnosis is the text 'x'; a Diagnosis is expected"),
    "loop": (lambda: ANY.rollout(ROBOT, Q, Q[0]), "loop is of type RobotModel; `load_loop`"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_argument_is_named(name: str, monkeypatch: pytest.MonkeyPatch):
    call, message = WRONG[name]
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # which users do not have in between
    with pytest.raises(fj.InputError, match=message):
        call()


def test_a_gate_names_the_robots_joint_where_columns_have_no_names():
    data: Any = fj.torque_data(ROBOT, RUN, fj.Preprocess(cutoff=10, gate={"elbow": 1e3}))
    assert (data.weight.sum(axis=(0, 1)) > 0).tolist() == [True, True, False, True]


def test_a_list_of_what_jax_traces_is_no_wrong_argument():
    """NumPy may not look into it."""
    assert jax.grad(lambda x: [check_real("q", [x, 0.0]), 2.0 * x][1])(1.0) == 2.0


def test_a_plain_robot_is_predicted_and_simulated():
    assert fj.predict(ROBOT, TIME, Q, Q, Q, 0.01).shape == (300, 4)
