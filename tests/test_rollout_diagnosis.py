"""Diagnosis and identification from command and position, on a servo arm made by MuJoCo C, through the command line."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import mujoco
import numpy as np
import pytest
from generators import servo_arm
from schema import matches

from figaroh_jax.cli import main
from figaroh_jax.errors import InputError
from figaroh_jax.rollouts.causes import elastic_loop
from figaroh_jax.rollouts.data import Run, Stretch, as_recorded, noise_of, regular, windows, without_gaps
from figaroh_jax.rollouts.export import described, for_simulator, with_drives
from figaroh_jax.rollouts.parameters import Entry, put
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.sensitivity import linear_sums, predicted
from figaroh_jax.rollouts.simulation import rollout

NOMINAL = servo_arm.model_text(0.08, 0.64, 0.48)  # 1.6 times too large


def task(folder: Path, case: str, more: str = "", role: str = "fit") -> Path:
    """A task file on one recording that is fitted and one, with other noise, that is not."""
    (folder / "arm.xml").write_text(NOMINAL)
    for name, seed in (("seen", 7), ("unseen", 8)):
        np.savez(folder / f"{name}.npz", **servo_arm.record(case, seed))  # pyright: ignore[reportArgumentType]
    columns = "time: t, command: u, position: q, velocity: dq"
    data = f"data:\n  - {{file: seen.npz, {columns}}}\n  - {{file: unseen.npz, {columns}, role: holdout}}\n"
    (folder / "task.yaml").write_text(f"robot: {{model: arm.xml}}\n{data}{more}")
    return folder / "task.yaml"


def short(seconds: float) -> tuple[Run, int]:
    record = servo_arm.record("none", 3)
    rows = round(seconds / servo_arm.DT)
    t, u, q, dq = (record[k][:rows] for k in ("t", "u", "q", "dq"))
    return Run("short", t, u, q, dq), rows


def test_sums_are_those_of_finite_differences(tmp_path: Path):
    """The gradient of the whitened squares by parameters, delay among them, and by the state at the start."""
    (tmp_path / "arm.xml").write_text(NOMINAL)
    loop, _ = load_loop(tmp_path / "arm.xml")
    run, _ = short(0.6)
    names = ("armature", "damping", "friction", "delay", "reading", "payload")
    table = tuple(Entry(name, (0,)) for name in names)
    data = windows(loop, [run], [Stretch(0, 0, 300)], [np.array([2e-4]), np.array([5e-3])], 0.2)
    theta = np.array([0.06, 0.5, 0.2, 0.0051, 0.01, 0.1])
    start = np.array([[0.03], [0.4]])

    def squares(theta: np.ndarray, start: np.ndarray) -> float:
        with jax.enable_x64(True):
            read = np.asarray(predicted(loop, table, theta[None], data, start[None]))[0]
        return float((((data.reading - read) * data.weight) ** 2).sum())

    with jax.enable_x64(True):
        found = linear_sums(loop, table, theta[None], np.arange(6)[None], data, start[None])
    exact = -2 * np.asarray(found.gradient)[0].sum((0, 1))
    numeric = []
    for k, step in enumerate([1e-6, 1e-5, 1e-5, 1e-7, 1e-6, 1e-6]):
        move = step * np.eye(6)[k]
        numeric.append((squares(theta + move, start) - squares(theta - move, start)) / (2 * step))
    for k in range(2):
        move = 1e-6 * np.eye(2)[k][:, None]
        numeric.append((squares(theta, start + move) - squares(theta, start - move)) / 2e-6)
    np.testing.assert_allclose(exact, numeric, rtol=1e-5, atol=0)
    assert np.asarray(found.cost).sum() == pytest.approx(squares(theta, start), rel=1e-10)


TWO = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body pos="0 0 1"><joint name="j1" axis="0 1 0" damping="0.4" armature="0.05" frictionloss="0.15"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="1"/>
<body pos="0.3 0 0"><joint name="j2" axis="0 1 0" damping="0.3" armature="0.04" frictionloss="0.1"/>
<geom type="capsule" fromto="0 0 0 0.25 0 0" size="0.02" mass="0.6"/></body></body></worldbody>
<actuator><position joint="j1" kp="60" kv="2"/><position joint="j2" kp="40" kv="1"/></actuator></mujoco>"""


@pytest.mark.parametrize("turned", [False, True])
def test_sums_of_two_joints_are_those_of_finite_differences(tmp_path: Path, turned: bool):
    """Numbers of joints, drives, sensors and of the rigid body itself, all free at once."""
    (tmp_path / "arm.xml").write_text(TWO)
    loop, _ = load_loop(tmp_path / "arm.xml")
    t = 0.002 * np.arange(300)
    u = 0.3 * np.sin(t[:, None] * [4.0, 7.0] + [0.0, 1.0])
    run = Run("two", t, u, 0.9 * u, np.gradient(0.9 * u, t, axis=0))
    data = windows(loop, [run], [Stretch(0, 0, 300)], [np.full(2, 2e-4), np.full(2, 5e-3)], 0.2)
    if turned:
        loop = replace(loop, robot=replace(loop.robot, gravity=np.array([-5.0, 7.0, 4.6])))
    at = {"armature": 0, "delay": 1, "friction": 0, "payload": 1, "mass_x": 0, "inertia_yy": 1}
    at |= {"gravity_x": 0, "gravity_y": 0}
    table = tuple(Entry(name, (place,)) for name, place in at.items())
    theta = np.array([0.06, 0.0051, 0.2, 0.1, 0.02, 0.004, 0.3, 2.0])
    length = [np.linalg.norm(x.robot.gravity) for x in (loop, put(loop, table, theta))]
    assert length[1] == pytest.approx(length[0], rel=1e-12)  # it is turned
    start = np.array([[0.03], [0.1], [0.4], [-0.2]])

    def squares(theta: np.ndarray) -> float:
        with jax.enable_x64(True):
            read = np.asarray(predicted(loop, table, theta[None], data, start[None]))[0]
        return float((((data.reading - read) * data.weight) ** 2).sum())

    with jax.enable_x64(True):
        found = linear_sums(loop, table, theta[None], np.arange(len(at))[None], data, start[None])
    assert np.asarray(found.cost).sum() == pytest.approx(squares(theta), rel=1e-10)
    exact = -2 * np.asarray(found.gradient)[0].sum((0, 1))[: len(at)]
    moves = 1e-6 * np.eye(len(at))
    numeric = [(squares(theta + move) - squares(theta - move)) / 2e-6 for move in moves]
    np.testing.assert_allclose(exact, numeric, rtol=1e-6, atol=0)


def test_a_joint_of_two_bodies_is_mujocos(tmp_path: Path):
    """The elastic structure built from the plain arm against MuJoCo's own two bodies."""
    (tmp_path / "arm.xml").write_text(servo_arm.model_text())
    loop = elastic_loop(load_loop(tmp_path / "arm.xml")[0], 0, 180.0, 0.1)
    loop = put(loop, (Entry("armature", (0,)),), np.array([0.0501]))  # the motor body's own inertia, in MuJoCo's model
    _, u = servo_arm.command()
    truth = servo_arm.record("joint_elasticity", 1)
    read = np.asarray(rollout(loop, u[:1500, None], np.zeros(2)).reading)
    assert np.sqrt(np.mean((read - truth["q"][:1500]) ** 2)) < 2.1e-4  # the noise is .2 mrad


def test_exported_drives_move_mujoco_as_the_loop_moves(tmp_path: Path):
    """Gains, force limit and delay in MuJoCo's own words; what Gazebo cannot say is listed with its size."""
    (tmp_path / "arm.xml").write_text(servo_arm.model_text())
    loop, _ = load_loop(tmp_path / "arm.xml")
    loop = eqx.tree_at(
        lambda m: (m.drives.delay, m.drives.force_range), loop, (np.array([8e-3]), np.array([[-9.0, 9.0]]))
    )
    (tmp_path / "out.xml").write_text(with_drives(tmp_path / "arm.xml", described(loop)))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out.xml"))
    data, truth, u = mujoco.MjData(model), [], servo_arm.command()[1][:1500]
    for value in u:
        truth.append(data.qpos.copy())
        data.ctrl[0] = value
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(rollout(loop, u[:, None], np.zeros(1)).position, truth, rtol=0, atol=1e-12)
    unsaid = {one["number"]: one["value"] for one in for_simulator(described(loop), "gazebo")["unsaid"]}
    assert unsaid == {"armature": 0.05, "delay": 8e-3}
    with pytest.raises(InputError, match="did you mean 'mujoco'"):
        for_simulator(described(loop), "mujco")


def test_noise_is_found_under_a_motion_and_a_jump_of_the_clock_is_told():
    run, _ = short(6.0)
    assert noise_of(run.position)[0] == pytest.approx(2e-4, rel=0.1)
    time = run.time.copy()
    time[70:] += 0.08
    with pytest.raises(InputError, match="jumps in row 70"):
        regular("run.npz", time)


def test_lost_and_late_rows_are_filled_in_and_count_for_nothing():
    """Row 50 of a clock of 10 ms is lost, and from row 120 on all come 6 ms late; a gap of 80 ms is not filled."""
    time = 0.01 * np.arange(400)
    time[120:] += 0.006
    kept = np.delete(np.arange(400), 50)
    wave = np.sin(time)[:, None]
    run = Run("run", time[kept], wave[kept], 2 * wave[kept], None)
    new, said = without_gaps(run)
    assert "late: 2 of 399, the first row 50 (from 0)" in said
    np.testing.assert_allclose(np.diff(new.time), 0.01, atol=1e-12, rtol=0)
    assert new.trusted is not None
    assert np.flatnonzero(~new.trusted).tolist() == [50, 120]
    np.testing.assert_array_equal(new.command[[50, 120]], wave[[49, 119]])
    np.testing.assert_allclose(new.position[50], wave[49] + wave[51], atol=1e-12, rtol=0)
    stamps, values = as_recorded(new, new.position)
    np.testing.assert_array_equal(stamps, run.time)
    np.testing.assert_array_equal(values, run.position)
    gone = run._replace(time=run.time + 0.08 * (np.arange(399) >= 200))
    assert without_gaps(gone) == (gone, "")
    assert without_gaps(run._replace(time=0.01 * np.arange(399)))[1] == ""
    queue = run._replace(time=0.01 * np.arange(399) + 0.008 * (np.arange(399) < 1) + 0.004 * (np.arange(399) < 2))
    begun, said = without_gaps(queue)  # the first stamps: 12, 14 and 20 ms
    assert "the stamps before row 1 (from 0) are closer together" in said
    np.testing.assert_array_equal(begun.time, queue.time[1:])
    np.testing.assert_array_equal(begun.position, queue.position[1:])
    assert regular("run", begun.time) == pytest.approx(0.01, rel=2e-3)


def test_a_recording_with_lost_rows_is_diagnosed_and_predicted_at_its_own_stamps(tmp_path: Path):
    path = task(tmp_path, "none")
    for file in tmp_path.glob("*.npz"):
        with np.load(file) as z:
            kept = np.delete(np.arange(len(z["t"])), [41, 300])
            arrays = {name: z[name][kept] for name in z.files}
        np.savez(file, **arrays)
    assert main(["diagnose", str(path), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    answer = json.loads((tmp_path / "run" / "answer.json").read_text())
    assert answer["verdict"] == "nothing"
    assert any("rows that come late: 2 of" in note and "the first row 41" in note for note in answer["notes"])
    with np.load(tmp_path / "run" / "predictions.npz") as told:
        for name in [x.removesuffix("_time") for x in told.files if x.endswith("_time")]:
            with np.load(tmp_path / f"{name}.npz") as z:
                np.testing.assert_array_equal(told[f"{name}_time"], z["t"])
                assert np.sqrt(np.mean((told[f"{name}_position"] - z["q"]) ** 2)) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("case", ["stribeck_friction", "none"])
def test_diagnose_names_what_is_hidden_and_nothing_else(tmp_path: Path, case: str):
    assert main(["diagnose", str(task(tmp_path, case)), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    answer = json.loads((tmp_path / "run" / "answer.json").read_text())
    matches("diagnose", answer)
    names = [cause["effect"] for cause in answer["causes"]]
    assert (answer["verdict"], names) == (("nothing", []) if case == "none" else ("named", [case]))
    made = np.load(tmp_path / "run" / "predictions.npz")
    error = made["unseen_position"] - np.load(tmp_path / "unseen.npz")["q"]
    assert np.sqrt(np.mean(error**2)) < 1.2 * 2e-4


@pytest.mark.slow
def test_identify_gives_the_joints_numbers_with_their_intervals(tmp_path: Path):
    assert main(["identify", str(task(tmp_path, "none")), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    matches("identify", result)
    for one in result["base_parameters"]:
        truth = {"armature joint": 0.05, "damping joint": 0.4, "friction joint": 0.3}[one["expression"]]
        assert one["status"] == "identified"
        assert abs(one["value"] - truth) < 4 * one["std"]


def test_identify_says_where_it_leaves_more_than_noise(tmp_path: Path):
    """A position that wanders by 20 mrad is no number of the fit, and its intervals do not count it."""
    record = servo_arm.record("none", 7)
    slow = record | {"q": record["q"] + 0.02 * np.sin(0.7 * record["t"]).reshape(record["q"].shape)}
    for name, one, said in (("clean", record, False), ("off", slow, True)):
        folder = tmp_path / name
        folder.mkdir()
        path = task(folder, "none")
        np.savez(folder / "seen.npz", **one)  # pyright: ignore[reportArgumentType]
        assert main(["identify", str(path), "--out", str(folder / "run"), "--quiet"]) == 0
        notes = json.loads((folder / "run" / "result.json").read_text())["notes"]
        assert any("times the encoder's noise at joint" in note for note in notes) == said, notes


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: r | {"u": r["u"] * 180 / np.pi}, "degrees or counts"),
        (lambda r: r | {"t": r["t"] + 0.1 * (np.arange(len(r["t"])) > 40)}, "jumps in row 41"),
    ],
)
def test_wrong_recordings_are_refused_with_row_and_joint(tmp_path: Path, change, words: str, capsys):
    path = task(tmp_path, "none")
    np.savez(tmp_path / "seen.npz", **change(servo_arm.record("none", 7)))
    assert main(["diagnose", str(path), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("command", ["diagnose", "identify"])
@pytest.mark.parametrize("gain", ["-30", "4e7"])
def test_gains_that_let_the_loop_diverge_are_told_with_row_and_joint(tmp_path: Path, capsys, command: str, gain: str):
    """A wrong sign, and a unit a million times too small."""
    path = task(tmp_path, "none")
    text = re.sub(r'kp="[^"]*"', f'kp="{gain}"', NOMINAL).replace("implicitfast", "Euler")
    (tmp_path / "arm.xml").write_text(text)
    assert main([command, str(path), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert re.search(r"diverges at joint joint, in row \d+ \(from 0, [0-9.]+ s\) of seen", said), said
    assert "kp" in said and len(said.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_a_urdf_needs_its_drives(tmp_path: Path, capsys):
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="base"/><link name="link"><inertial><mass value="1"/><origin xyz="0 0 -.3"/>'
        '<inertia ixx=".01" iyy=".01" izz=".001" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="joint" '
        'type="revolute"><parent link="base"/><child link="link"/><axis xyz="0 1 0"/>'
        '<limit lower="-3" upper="3" effort="9" velocity="9"/></joint></robot>'
    )
    path = task(tmp_path, "none")
    path.write_text(path.read_text().replace("arm.xml", "arm.urdf"))
    assert main(["diagnose", str(path), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    assert "state each joint's drive" in capsys.readouterr().err
    path.write_text(path.read_text() + "actuator: {joint: {kind: position}}\n")
    assert main(["diagnose", str(path), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    assert "kind position needs kp" in capsys.readouterr().err
