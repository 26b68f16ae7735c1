"""The generators of test recordings are right themselves, and share no code with the library."""

from __future__ import annotations

import ast
import json
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from generators import (
    CLASSES,
    CLOSED_LOOP_EFFECTS,
    EFFECTS,
    Case,
    Truth,
    available,
    make_case,
    make_closed_loop_case,
    observable,
    robots,
    scene,
    servo_arm,
)
from generators.laws import FAMILIES
from generators.motion import TRACKING
from generators.scoring import judge, upper_bound
from scipy.signal import butter, filtfilt

PACKAGE = Path(__file__).parent / "generators"


@cache
def _clean(trusted: bool, **options: Any) -> Case:
    return make_case([], trusted=trusted, **options)


def _difference(effect: str, size: float = 0.05, **more: Any) -> tuple[Case, np.ndarray, Case]:
    """A case with the effect, what it adds to the torque of the first recording, and the same case without."""
    options: dict[str, Any] = {"robot": "small", "repeats": 1, "trajectories": 1, "noise": 0.0, "seed": 5} | more
    hidden, clean = make_case([(effect, size)], **options), _clean(hidden_is_trusted(effect), **options)
    return hidden, hidden.recordings[0]["torque"] - clean.recordings[0]["torque"], clean


def hidden_is_trusted(effect: str) -> bool:
    """Whether `make_case` takes well-known inertials for the effect."""
    return effect in {"payload", "link_inertia", "torque_gain"}


def _low_passed(x: np.ndarray, cutoff: float) -> np.ndarray:
    """Zero-phase low pass at `cutoff` Hz of a recording's signal."""
    numerator, denominator = butter(4, cutoff, fs=250)[:2]  # type: ignore[misc]
    return filtfilt(numerator, denominator, x, axis=0)


def _velocity(case: Case) -> np.ndarray:
    """Velocity of the first recording by central differences."""
    rec = case.recordings[0]
    return np.gradient(rec["position"], rec["time"], axis=0)


def test_the_generators_import_nothing_of_the_library():
    allowed = {"__future__", "collections", "dataclasses", "json", "os", "pathlib", "typing", "sys", "types"}
    allowed |= {"numpy", "scipy", "pinocchio", "mujoco"}
    demo = PACKAGE.parents[1] / "examples" / "make_demo.py"
    for file in (*PACKAGE.glob("*.py"), demo):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            assert {name.split(".")[0] for name in names} <= allowed, f"{file.name}: {names}"


def test_torque_of_a_clean_case_is_rigid_body_and_friction():
    case = make_case([], robot="small", repeats=1, trajectories=1, noise=0.0, seed=2)
    rec = case.recordings[0]
    robot = robots.load("small")
    true = robots.true_robot(robot.model, 0.05, np.random.default_rng(np.random.SeedSequence(2).spawn(4)[0]))
    data = true.createData()
    v = np.gradient(rec["position"], rec["time"], axis=0, edge_order=2)
    a = np.gradient(v, rec["time"], axis=0, edge_order=2)
    expected = np.array([pin.rnea(true, data, *row) for row in zip(rec["position"], v, a, strict=True)])
    expected += robot.viscous * v + robot.coulomb * np.sign(v)
    # differentiated positions and means over 4 ms are not exact, least so at reversals
    error = (rec["torque"] - expected)[5:-5]
    assert np.quantile(np.abs(error), 0.99) < 0.03


def test_true_inertials_are_bodies_and_differ_from_the_nominal_by_the_stated_error():
    robot, errors = robots.load("small"), []
    for seed in range(60):
        true = robots.true_robot(robot.model, 0.05, np.random.default_rng(seed))
        for joint in range(true.nv):
            assert np.linalg.eigvalsh(robots.pseudo_of_ten(robots.ten(true, joint))).min() > 0
            errors.append(robots.ten(true, joint)[0] / robots.ten(robot.model, joint)[0] - 1)
    assert 0.04 < np.std(errors) < 0.06


# no eccentricity of 5 % is physical on the small robot
@pytest.mark.parametrize("effect", [e for e in EFFECTS if e != "encoder_eccentricity"])
def test_induced_torque_has_the_size_asked_for(effect: str):
    # a bristle's share of the means over 4 ms needs the reversals of the whole motion
    hidden, added, clean = _difference(effect, duration=10.0 if effect == "presliding" else 5.0)
    assert hidden.induced[effect] == pytest.approx(0.05, rel=6e-3)
    if effect in ("joint_elasticity", "backlash") or effect.startswith(
        "encoder"
    ):  # shows in the position: the torque is that of the same link motion
        assert np.abs(hidden.recordings[0]["position"] - clean.recordings[0]["position"]).max() > 1e-5
        return
    torque = clean.recordings[0]["torque"]
    ratio = np.sqrt((added**2).mean(0) / (torque**2).mean(0))
    rows = [hidden.joints.index(j) for j in hidden.truth[0].at if j in hidden.joints]
    ratio = ratio[rows].max() if rows else np.sqrt((ratio[ratio > 1e-4 * ratio.max()] ** 2).mean())
    # means over 4 ms take a part of the short steps that a delay makes, and of a bristle's at each reversal
    loss = {"torque_delay": 0.15, "clock_error": 0.15, "presliding": 0.04}
    assert ratio == pytest.approx(0.05, rel=loss.get(effect, 0.02))


def test_friction_laws_are_those_of_the_contract():
    laws = {
        "stribeck_friction": lambda v, q, p: p["force"] * np.exp(-((v / p["speed"]) ** 2)) * np.sign(v),
        "power_law_friction": lambda v, q, p: p["strength"] * np.abs(v) ** p["exponent"] * np.sign(v),
        "asymmetric_viscous_friction": lambda v, q, p: p["difference"] * np.abs(v),
        "asymmetric_coulomb_friction": lambda v, q, p: p["difference"] * np.ones_like(v),
        "position_dependent_friction": lambda v, q, p: np.sign(v) * (p["cosine"] * np.cos(q) + p["sine"] * np.sin(q)),
        "torque_ripple": lambda v, q, p: p["sine"] * np.sin(p["order"] * q) + p["cosine"] * np.cos(p["order"] * q),
        "joint_spring": lambda v, q, p: p["stiffness"] * (q - p["rest"]),
        "torque_offset": lambda v, q, p: p["offset"] * np.ones_like(v),
    }
    for effect, law in laws.items():
        hidden, added, _ = _difference(effect)
        joint = hidden.joints.index(hidden.truth[0].at[0])
        q, v = hidden.recordings[0]["position"][:, joint], _velocity(hidden)[:, joint]
        away = np.abs(v) > 0.05  # not within the 4 ms of a reversal
        expected = law(v, q, hidden.truth[0].parameters)
        error = np.abs(added[:, joint] - expected)[away].max()
        assert error < 0.02 * np.abs(expected).max(), effect
        assert np.abs(np.delete(added, joint, axis=1)).max() == 0.0


def test_coupling_acts_on_both_joints_with_its_sign():
    hidden, added, _ = _difference("coupled_transmission")
    p, v = hidden.truth[0].parameters, _velocity(hidden)
    a = np.gradient(v, hidden.recordings[0]["time"], axis=0)
    dry = p["friction"] * np.sign(v[:, 0] + p["sign"] * v[:, 1])
    away = np.abs(v[:, 0] + p["sign"] * v[:, 1]) > 0.05
    for i, side in ((0, 1.0), (1, p["sign"])):
        expected = p["sign"] * (p["inertia"] * a[:, 1 - i] + p["damping"] * v[:, 1 - i]) + side * dry
        assert np.abs(added[:, i] - expected)[away][5:-5].max() < 2e-3
    assert np.all(added[:, 2] == 0)


@pytest.mark.slow
def test_delay_is_a_shift_in_time_and_lag_a_first_order_low_pass():
    for effect, key in (("torque_delay", "delay"), ("torque_lag", "time")):
        hidden, _, clean = _difference(effect)
        smooth = [_low_passed(c.recordings[0]["torque"], 8)[200:-200] for c in (hidden, clean)]
        slope = np.gradient(smooth[1], 0.004, axis=0)
        shift = -np.sum((smooth[0] - smooth[1]) * slope) / np.sum(slope**2)
        assert shift == pytest.approx(hidden.truth[0].parameters[key], rel=0.06)


def test_payload_and_tilt_change_the_torque_as_a_changed_robot_would():
    for effect in ("payload", "gravity_tilt"):
        hidden, added, clean = _difference(effect)
        p, rec = hidden.truth[0].parameters, clean.recordings[0]
        error = 0.01 if effect == "payload" else 0.05
        stream = np.random.default_rng(np.random.SeedSequence(5).spawn(4)[0])
        model = robots.true_robot(robots.load("small").model, error, stream)
        changed = model.copy()
        if effect == "payload":
            joint = robots.load("small").links.index(hidden.truth[0].at[0])
            body = pin.Inertia(p["mass"], np.array([p["com_x"], p["com_y"], p["com_z"]]), 1e-3 * p["mass"] * np.eye(3))
            changed.inertias[joint + 1] = model.inertias[joint + 1] + body
        else:
            changed.gravity.linear = np.array([9.81 * p["about_y"], -9.81 * p["about_x"], -9.81])
        at = [3, 700, 1500]
        q = rec["position"][at]
        still = np.zeros_like(q)
        statics = robots.torque(changed, q, still, still) - robots.torque(model, q, still, still)
        # gravity is most of it; the motion's share is small
        assert np.abs(added[at] - statics).max() < 0.35 * np.abs(statics).max()
        assert np.sign(added[at][np.abs(statics) > 0.3]).tolist() == np.sign(statics[np.abs(statics) > 0.3]).tolist()


def test_elastic_joint_reads_ahead_by_its_load():
    hidden, _, clean = _difference("joint_elasticity")
    joint = hidden.joints.index(hidden.truth[0].at[0])
    ahead = hidden.recordings[0]["position"] - clean.recordings[0]["position"]
    v = _velocity(clean)
    robot = robots.load("small")
    load = clean.recordings[0]["torque"] - scene.friction(robot, v)
    away = np.abs(v[:, joint]) > 0.05
    expected = hidden.truth[0].parameters["compliance"] * load[:, joint]
    assert np.abs(ahead[:, joint] - expected)[away].max() < 0.02 * np.abs(expected).max()


def test_repeats_follow_the_same_motion_up_to_a_smooth_tracking_error():
    case = make_case([], robot="small", repeats=2, trajectories=1, noise=0.0, seed=3)
    first, second = (rec["position"] for rec in case.recordings)
    rms = np.sqrt(np.mean((first - second) ** 2))
    assert 0.5 * TRACKING < rms < 3 * TRACKING


def test_noise_has_the_stated_level_and_positions_the_stated_steps():
    options = {"robot": "small", "repeats": 1, "trajectories": 2, "seed": 4}
    clean = make_case([], noise=0.0, **options).recordings
    rms = np.sqrt(np.mean(np.concatenate([rec["torque"] for rec in clean]) ** 2, 0))
    for colour, level in (("white", 0.02), ("ar20", np.hypot(0.02, 0.01)), ("pink", np.hypot(0.02, 0.01))):
        noisy = make_case([], noise=2.0, colour=colour, encoder_step=1e-4, **options).recordings
        noise = np.concatenate([n["torque"] - c["torque"] for n, c in zip(noisy, clean, strict=True)])
        assert np.std(noise / rms) == pytest.approx(2 * level, rel=0.15)
        steps = noisy[0]["position"] / 1e-4
        assert np.abs(steps - np.round(steps)).max() < 1e-6


def test_equal_seeds_give_equal_cases_and_unphysical_ones_are_refused():
    one, two = (make_case(["stribeck_friction"], robot="small", trajectories=1, seed=9, duration=3.0) for _ in range(2))
    assert one.truth == two.truth
    assert np.array_equal(one.recordings[1]["torque"], two.recordings[1]["torque"])
    with pytest.raises(ValueError, match="not physical"):
        make_case([("joint_elasticity", 30.0)], robot="small", trajectories=1, repeats=1, seed=1, duration=2.0)


def test_a_written_case_holds_a_task_and_all_recordings(tmp_path: Path):
    case = make_case(["payload"], robot="small", trajectories=2, holdout=True, seed=1)
    task = json.loads(case.write(tmp_path, forbid=["payload"]).read_text())
    assert task["robot"]["trust"] == 0.02 and task["diagnose"] == {"forbid": ["payload"]}
    assert [entry["role"] for entry in task["data"]] == ["fit"] * 4 + ["holdout"]
    for entry in task["data"]:
        with np.load(tmp_path / entry["file"]) as arrays:
            assert arrays["q"].shape == arrays["tau"].shape == (2500, 3) and arrays["t"].shape == (2500,)


def test_every_accepted_name_is_a_name_of_the_contract():
    assert set(EFFECTS) <= set(FAMILIES)
    truth = make_case(["torque_offset"], robot="small", trajectories=1, repeats=1, seed=1).truth[0]
    assert observable(truth) == {("torque_offset", truth.at), ("asymmetric_coulomb_friction", truth.at)}
    assert all(len(names) == 2 for names in CLASSES)


@pytest.mark.parametrize("robot", ["tx40", "panda", "ur10e"])
def test_real_robots_make_cases(robot: str):
    if not available(robot):
        pytest.skip("set FIGAROH_JAX_DATA to the folder of the real robots' files")
    case = make_case(["coupled_transmission"], robot=robot, trajectories=1, repeats=1, seed=1)
    assert case.recordings[0]["torque"].shape == (2500, len(case.joints))
    assert np.isfinite(case.recordings[0]["torque"]).all()


def _misfit(case: Case, trusted: bool) -> np.ndarray:
    """Torque of a closed-loop recording that the true rigid bodies and friction leave, over its RMS, below 15 Hz."""
    rec, made = case.recordings[0], robots.load(case.robot)
    stream = np.random.default_rng(np.random.SeedSequence(case.seed).spawn(4)[0])
    true = robots.true_robot(made.model, 0.01 if trusted else 0.05, stream)
    q = _low_passed(rec["position"], 15)
    v = np.gradient(q, 0.004, axis=0)
    a = np.gradient(v, 0.004, axis=0)
    sign = np.clip(np.gradient(rec["position"], 0.004, axis=0) / 0.005, -1, 1)
    model = robots.torque(true, q, v, a) + made.viscous * v + made.coulomb * sign
    rest, model = (_low_passed(x, 15)[100:-100] for x in (rec["torque"] - model, model))
    return np.sqrt((rest**2).mean(0) / (model**2).mean(0))


def test_closed_loop_without_effects_obeys_inverse_dynamics_with_friction():
    case = make_closed_loop_case([], robot="small", trajectories=1, repeats=1, noise=0.0, seed=4, duration=5.0)
    assert _misfit(case, trusted=False).max() < 0.01


@pytest.mark.parametrize(
    "effect",
    [
        "stribeck_friction",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("torque_ripple", "joint_spring", "torque_gain")),
    ],
)
def test_closed_loop_effect_has_its_size_at_its_joint_alone(effect: str):
    case = make_closed_loop_case([effect], robot="small", trajectories=1, repeats=1, noise=0.0, seed=4, duration=10.0)
    misfit, joint = _misfit(case, hidden_is_trusted(effect)), case.joints.index(case.truth[0].at[0])
    assert 0.035 < misfit[joint] < 0.07
    assert np.delete(misfit, joint).max() < 0.01


@pytest.mark.slow
def test_every_closed_loop_effect_changes_the_recording():
    options = {"robot": "small", "trajectories": 1, "repeats": 1, "noise": 0.0, "seed": 4, "duration": 0.5}
    clean = {trusted: make_closed_loop_case([], trusted=trusted, **options) for trusted in (False, True)}
    for effect in CLOSED_LOOP_EFFECTS:
        hidden = make_closed_loop_case([(effect, 0.02)], **options)
        beside = clean[hidden_is_trusted(effect)]
        change = np.abs(hidden.recordings[0]["torque"] - beside.recordings[0]["torque"]).max()
        assert change > 0.005 and np.isfinite(change), effect


def _answer(verdict: str, *causes: tuple[str, str, tuple[str, ...]]) -> SimpleNamespace:
    """An answer whose causes are (effect, joint, names of other effects there that cannot be told from it)."""

    def name(effect: str, joint: str) -> SimpleNamespace:
        return SimpleNamespace(effect=effect, at=(joint,))

    told = [SimpleNamespace(name=name(e, j), ambiguous_with=[name(o, j) for o in others]) for e, j, others in causes]
    return SimpleNamespace(verdict=verdict, causes=told)


@pytest.mark.parametrize(
    ("answer", "grade", "false"),
    [
        (_answer("named", ("torque_offset", "j1", ())), "right", 0),
        (_answer("named", ("asymmetric_coulomb_friction", "j1", ())), "right", 0),
        (_answer("named", ("joint_spring", "j1", ("torque_offset",))), "set", 0),
        (_answer("named", ("joint_spring", "j1", ())), "wrong", 1),
        (_answer("named", ("torque_offset", "j2", ())), "wrong", 1),
        (_answer("named+rest", ("torque_offset", "j1", ()), ("torque_gain", "j2", ())), "right", 1),
        (_answer("unknown", ("torque_gain", "j1", ())), "unknown", 0),
        (_answer("nothing"), "nothing", 0),
    ],
)
def test_answers_are_judged_by_name_place_and_set(answer: SimpleNamespace, grade: str, false: int):
    score = judge("case", [Truth("torque_offset", ("j1",), {})], answer)
    assert (score.grade, len(score.false)) == (grade, false)


def test_bound_of_no_failure_in_thirty_is_that_of_the_books():
    assert upper_bound(0, 30) == pytest.approx(1 - 0.05 ** (1 / 30), abs=1e-9)  # Clopper and Pearson 1934


def test_an_encoder_offset_of_one_joint_is_a_constant_torque_and_a_tilt():
    """Why `benchmarks/servo_cases.py --forbid` leaves out both: what the encoder reads is the same, in MuJoCo C."""
    offset, stiffness = 0.03, 60.0
    _, command = servo_arm.command()

    def read(start: float, reading: float, torque: float, tilt: float) -> np.ndarray:
        model = mujoco.MjModel.from_xml_string(servo_arm.model_text())
        data = mujoco.MjData(model)
        model.opt.gravity[:] = -9.81 * np.sin(tilt), 0.0, -9.81 * np.cos(tilt)
        data.qpos[0], data.qfrc_applied[0], told = start, torque, []
        for wanted in command[:2000]:
            told.append(data.qpos[0] + reading)
            data.ctrl[0] = wanted
            mujoco.mj_step(model, data)
        return np.array(told)

    truth = read(0.0, offset, 0.0, 0.0)
    np.testing.assert_allclose(read(offset, 0.0, stiffness * offset, offset), truth, rtol=0, atol=1e-12)
    assert np.abs(read(offset, 0.0, stiffness * offset, 0.0) - truth).max() > 1e-3  # the torque alone is another
