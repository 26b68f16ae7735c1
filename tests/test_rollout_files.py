"""Rollouts of files as strangers have them: a gripper left out, columns named after servos, numbers that differ."""

# ruff: noqa: E501 - the robot stands here as lines of XML
from __future__ import annotations

import csv
import datetime
import json
import re
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco as engine
import numpy as np
import pytest
from test_rollout_diagnosis import task

import figaroh_jax as fj
from figaroh_jax.cli import main
from figaroh_jax.errors import InputError
from figaroh_jax.formats.export import write_model
from figaroh_jax.jobs.export import export_loop
from figaroh_jax.results import Gain
from figaroh_jax.rollouts.alone import separable
from figaroh_jax.rollouts.data import Run, ahead_of_command
from figaroh_jax.rollouts.export import described, for_simulator
from figaroh_jax.rollouts.gates import rms_of
from figaroh_jax.rollouts.loop import Loop
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.simulation import rollout
from figaroh_jax.rollouts.stored import add_loop
from figaroh_jax.rollouts.task import _gain as gain_of, extended_of, read_rollouts

mujoco: Any = engine

ARM = """<mujoco model="lamp"><compiler angle="degree"/>
<option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option><worldbody>
<body pos="0 0 .1"><joint name="yaw" axis="0 0 1" range="-150 150" limited="true" armature=".03" damping=".6" frictionloss=".15"/>
  <inertial pos="0 .01 .02" mass=".25" diaginertia="3e-4 3e-4 2e-4"/>
  <body pos="0 0 .06"><joint name="lift" axis="0 1 0" range="-100 100" limited="true" armature=".03" damping=".6" frictionloss=".15"/>
    <inertial pos=".01 0 .12" mass=".5" diaginertia="2e-3 2e-3 2e-4"/>
    <body pos="0 .02 .24">{finger}<inertial pos="0 0 .02" mass=".02" diaginertia="1e-5 1e-5 1e-5"/></body>
  </body></body></worldbody>
<actuator>{first}<position joint="yaw" name="a" kp="25" kv="1"/><position joint="lift" name="b" gear="2" kp="12" kv="1"/>
</actuator></mujoco>"""
GRIPPING = ARM.format(
    finger='<joint name="left" type="slide" axis="0 1 0" range="0 .03" limited="true" damping="4"/>',
    first='<position joint="left" name="grip" kp="300" kv="20"/>',
)


def moved(text: str, rows: int, steps: int = 10) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, command of a row and position of a row, as MuJoCo C moves the arm, 50 Hz; the last actuators are driven."""
    model = mujoco.MjModel.from_xml_string(text)
    data, t = mujoco.MjData(model), np.arange(rows) * steps * 0.002
    u = np.column_stack([0.8 * np.sin(2.1 * t), 2 * (0.4 * np.sin(1.3 * t) + 0.1 * np.sin(5.1 * t))])
    if model.nu > 2:
        u = np.column_stack([0.015 + 0.01 * np.sin(t), u])
    q = []
    for row in u:
        q.append(data.qpos.copy())
        data.ctrl[:] = row
        mujoco.mj_step(model, data, steps)
    return t, u, np.array(q)


def write(path: Path, names: list[str], t: np.ndarray, u: np.ndarray, q: np.ndarray) -> None:
    """A CSV with ISO stamps and `action.NAME`, `observation.state.NAME` columns."""
    begin = datetime.datetime(2025, 3, 4, 10)
    with path.open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["timestamp", *(f"action.{n}" for n in names), *(f"observation.state.{n}" for n in names)])
        for when, *row in zip(t, *u.T, *q.T, strict=True):
            stamp = (begin + datetime.timedelta(seconds=float(when))).isoformat(timespec="milliseconds")
            out.writerow([stamp, *(f"{x:.6f}" for x in row)])


def test_the_actuator_of_a_joint_that_stands_still_is_no_drive(tmp_path: Path):
    """It is the first one of the file: the others keep their own commands, and the arm can be taken joint by joint."""
    (tmp_path / "arm.xml").write_text(GRIPPING)
    loop, notes = load_loop(tmp_path / "arm.xml", joints=["yaw", "lift"])
    assert loop.drives.names == ("a", "b") and separable(loop)
    assert "actuator 'grip', whose joint stands still" in notes
    _, u, q = moved(ARM.format(finger="", first=""), 100)
    read = rollout(loop, np.repeat(u, 10, axis=0), np.zeros(2)).position
    np.testing.assert_allclose(np.asarray(read)[::10], q, rtol=0, atol=1e-10)


def test_columns_named_otherwise_than_joints_are_drafted_by_their_order(tmp_path: Path, capsys):
    """`gripper` is no joint of the model: --joints decides, and an order that contradicts the names is refused."""
    (tmp_path / "arm.xml").write_text(GRIPPING)
    t, u, q = moved(GRIPPING, 300)
    order, degrees = [1, 2, 0], [180 / np.pi, 180 / np.pi, 1]
    write(tmp_path / "run.csv", ["yaw", "lift", "gripper"], t, u[:, order] * degrees, q[:, [0, 1, 2]] * degrees)
    new = ["new", str(tmp_path / "arm.xml"), str(tmp_path / "run.csv"), "--out", str(tmp_path / "task.yaml")]
    assert main(new) == 2
    said = capsys.readouterr().err
    assert "which joints are observation.state.gripper?" in said and "the model's others are left" in said
    assert main([*new, "--joints", "lift,yaw,left"]) == 2
    assert "names lift where the columns have 'observation.state.yaw'" in capsys.readouterr().err
    assert main([*new, "--joints", "yaw,lift,left"]) == 0
    text = (tmp_path / "task.yaml").read_text()
    assert "command: [action.yaw, action.lift, action.gripper]" in text and "position: deg" in text


@pytest.mark.slow
def test_numbers_of_the_file_that_the_fit_had_to_change_are_told(tmp_path: Path, capsys):
    """All three numbers of the file are 1.6 times too large: it does not agree as it is, and the headline says so."""
    assert main(["diagnose", str(task(tmp_path, "none")), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "agrees with the data once the" in said and "2 more numbers are fitted" in said
    (note,) = (n for n in json.loads((tmp_path / "run" / "answer.json").read_text())["notes"] if "in the file" in n)
    for told, true, stated in (("friction", 0.3, 0.48), ("damping", 0.4, 0.64), ("rotor inertia", 0.05, 0.08)):
        value = float(note.split(f"{told} of joint is ")[1].split()[0])
        assert abs(value - true) < 0.05 * true and f"({stated:.3g} in the file)" in note
    held = np.load(tmp_path / "unseen.npz")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    data, read = mujoco.MjData(model), []
    data.qpos[0] = held["q"][:5, 0].mean()
    for command in held["u"][:, 0]:
        read.append(data.qpos[0])
        data.ctrl[0] = command
        mujoco.mj_step(model, data)
    error = np.sqrt(np.mean((np.array(read) - held["q"][:, 0]) ** 2))
    told, unit = note.split("recordings kept out is ")[1].split()[:2]
    assert abs(float(told) * {"rad": 1.0, "mrad": 1e-3}[unit] - error) < 0.05 * error


DRIVES = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast">
<flag contact="disable"/></option><worldbody>
<body pos="0 0 1"><joint name="j1" axis="0 1 0" damping=".4" armature=".05" frictionloss=".3" solreffriction=".05 1"
 solimpfriction=".8 .9 .01 .5 2" range="-.5 .25" limited="true" solreflimit=".06 .7" solimplimit=".7 .9 .02 .4 3" margin=".01"/>
<inertial pos=".15 0 .02" mass="1" diaginertia=".01 .02 .02"/>
<body pos=".3 0 0"><joint name="j2" axis="0 1 0" damping=".3" armature=".04" actuatorfrcrange="-1.5 2.5" actuatorfrclimited="true"/>
<inertial pos=".1 0 0" mass=".6" diaginertia=".004 .006 .006"/>
<body pos=".2 0 0"><joint name="j3" axis="0 1 0" damping=".1" armature=".02" frictionloss=".05"/>
<inertial pos=".05 0 0" mass=".2" diaginertia=".001 .001 .001"/></body></body></body></worldbody>
<tendon><fixed name="both"><joint joint="j2" coef="1"/><joint joint="j3" coef="-.5"/></fixed></tendon>
<actuator>{}</actuator></mujoco>"""
POSITION = '<position name="a" joint="j1" gear="2" kp="20" kv=".6" {}/>'
OTHERS = {
    "ranges of one side": POSITION.format(
        'forcerange="-1 9" forcelimited="true" ctrlrange="-.2 .5" ctrllimited="true"'
    ),
    "late by a part of a step": POSITION.format('delay=".0031" nsample="6"'),
    "soon": POSITION.format('delay=".0041" nsample="6" interp="linear"'),
    "a damper and a motor": '<damper name="a" joint="j1" kv="2" ctrlrange="0 1"/><motor name="b" joint="j2" gear="3"/>',
    "a tendon": POSITION.format("") + '<position name="b" tendon="both" kp="9" kv=".4" gear="1.5"/>',
    "a filter": POSITION.format('timeconst=".05"')
    + '<general name="b" joint="j2" dyntype="filter" dynprm=".04" actrange="-.1 .3" actlimited="true" actearly="true"'
    ' biastype="affine" gainprm="12" biasprm=".2 -10 -.3"/>',
    "a velocity": POSITION.format("") + '<velocity name="b" joint="j3" kv=".3" gear="-2"/>',
}


@pytest.mark.parametrize("which", OTHERS)
def test_what_is_exported_moves_in_mujoco_as_the_users_own_file(which: str, tmp_path: Path):
    """Drives, limits and friction that are not the plain ones, through `loop.json` and `export`, 1000 steps."""
    source = DRIVES.format(OTHERS[which])
    (tmp_path / "arm.xml").write_text(source)
    loop, _ = load_loop(tmp_path / "arm.xml")
    write_model(extended_of(loop), tmp_path / "model")
    add_loop(tmp_path / "model", loop)
    export_loop(tmp_path / "model", "mujoco", tmp_path / "out")
    texts = [(tmp_path / "arm.xml"), (tmp_path / "out" / "robot.xml")]
    both, t = [], 0.002 * np.arange(1000)
    for file in texts:
        model = mujoco.MjModel.from_xml_path(str(file))
        data, q = mujoco.MjData(model), []
        assert [model.actuator(k).name for k in range(model.nu)] == list(loop.drives.names)
        for row in np.column_stack([0.4 * np.sin(4 * t) * np.exp(-0.3 * t), 0.6 * np.sin(7 * t + 1)])[:, : model.nu]:
            q.append(data.qpos.copy())
            data.ctrl[:] = row
            mujoco.mj_step(model, data)
        both.append(q)
    assert np.ptp(both[0], axis=0).min() > 0.05
    np.testing.assert_allclose(both[1], both[0], rtol=0, atol=1e-7)


def test_other_simulators_are_told_what_a_drive_does_at_its_joint():
    """By its torque: MuJoCo's actuator force at a state, against gains, target and limit of the joint as exported."""
    text = DRIVES.format(
        POSITION.format('forcerange="-5 5" forcelimited="true"')
        + '<velocity name="b" joint="j2" kv=".3" gear="-2"/><motor name="c" joint="j3" gear="3"/>'
    )
    model = mujoco.MjModel.from_xml_string(text)
    data, state, u = mujoco.MjData(model), np.array([[0.1, -0.2, 0.3], [0.5, 0.7, -0.4]]), [0.35, 0.2, -0.1]
    data.qpos[:], data.qvel[:], data.ctrl[:] = state[0], state[1], u
    mujoco.mj_forward(model, data)
    told = for_simulator(described(_loop(text)), "isaaclab")
    by = {(one["at"], one["number"]): one["value"] for one in told["values"]}
    servo = by["j1", "kp"] * (by["j1", "command"] * u[0] - state[0, 0]) - by["j1", "kd"] * state[1, 0]
    speed = by["j2", "kd"] * (by["j2", "command"] * u[1] - state[1, 1])
    np.testing.assert_allclose([servo, speed, by["j3", "command"] * u[2]], data.qfrc_actuator, rtol=1e-12)
    assert by["j1", "force"] == 10.0 and ("j2", "kp") not in by and ("j3", "kp") not in by
    several = for_simulator(described(_loop(DRIVES.format(OTHERS["a tendon"]))), "gazebo")
    unsaid = {(one["at"], one["number"]): one["value"] for one in several["unsaid"]}
    assert unsaid["b", "transmission j2"] == 1.5 and unsaid["b", "transmission j3"] == -0.75 and unsaid["b", "kp"] == 9
    sides = for_simulator(described(_loop(DRIVES.format(OTHERS["ranges of one side"]))), "genesis")["unsaid"]
    assert {one["number"] for one in sides} >= {"command_range low", "force_range low"}


def _loop(text: str) -> Loop:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "arm.xml").write_text(text)
        return load_loop(Path(folder) / "arm.xml")[0]


@pytest.mark.slow
def test_a_payload_that_rests_on_known_gains_says_so(tmp_path: Path):
    path = task(tmp_path, "payload", "robot: {model: arm.xml, trust: 0.02}\n")
    path.write_text("".join(path.read_text().splitlines(keepends=True)[1:]))
    assert main(["diagnose", str(path), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    answer = json.loads((tmp_path / "run" / "answer.json").read_text())
    assert [one["effect"] for one in answer["causes"]] == ["payload"]
    assert any("payload (link): the drives' gains are taken as right" in note for note in answer["notes"])


def test_identify_says_that_free_gains_are_not_fitted_unless_named(tmp_path: Path):
    path = task(tmp_path, "none", "actuator: {gains: free}\n")
    for file in tmp_path.glob("*.npz"):
        with np.load(file) as z:
            arrays = {name: z[name][: len(z[name]) // 3] for name in z.files}
        np.savez(file, **arrays)
    for more, said in (("", True), ("baseline: {effects: [{effect: actuator_gain, at: [joint]}]}\n", False)):
        (tmp_path / "two.yaml").write_text(path.read_text() + more)
        assert main(["identify", str(tmp_path / "two.yaml"), "--out", str(tmp_path / f"run{said}"), "--quiet"]) == 0
        result = json.loads((tmp_path / f"run{said}" / "result.json").read_text())
        assert any("`identify` fits those that the task names" in note for note in result["notes"]) == said
        fitted = any(one["expression"].startswith("scale") for one in result["base_parameters"])
        assert fitted != said


@pytest.mark.parametrize(
    ("drive", "words"),
    [
        ({"kind": "postion", "kp": 1.0}, "actuator.yaw.kind: Input should be 'position', 'velocity' or 'torque'"),
        ({"kp": "stiff"}, "actuator.yaw.kp: expected a number, not the text 'stiff'"),
        ({"kP": 3.0}, "unknown key 'kP'; did you mean 'kp'?"),
        ({"kind": "velocity", "kp": 3.0}, "kind velocity needs kd"),
        ({"kind": "torque", "kp": 3.0}, "kind torque has no kp"),
        (20.0, "keys and values are expected"),
    ],
)
def test_drives_that_say_nothing_are_refused_in_python_as_in_a_task(drive: Any, words: str, tmp_path: Path, capsys):
    """A motor with a gain was read as one without, in Python a velocity drive without its own as one that does nothing."""
    (tmp_path / "arm.xml").write_text(GRIPPING)
    with pytest.raises(InputError, match=re.escape(words)):
        load_loop(tmp_path / "arm.xml", {"yaw": drive})
    if "kind" not in words:
        return
    path = task(tmp_path, "none", f"actuator: {{joint: {json.dumps(drive)}}}\n")
    assert main(["identify", str(path), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    assert "actuator.joint" in capsys.readouterr().err


def test_files_of_the_other_format_and_a_run_for_its_model_are_told(tmp_path: Path):
    (tmp_path / "arm.xml").write_text(GRIPPING)
    with pytest.raises(InputError, match="it is an MJCF: load_mjcf reads it"):
        fj.load_urdf(tmp_path / "arm.xml")
    fj.write_model(fj.extend(fj.load_urdf(fj.DEMO)), tmp_path / "run" / "model")
    with pytest.raises(InputError, match=f"the model of this run is in {tmp_path / 'run' / 'model'}"):
        fj.load_model(tmp_path / "run")


SLIDER = """<mujoco model="lamp"><option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option>
<worldbody><body pos="0 0 .1"><joint name="yaw" axis="0 0 1" armature=".03" damping=".6" frictionloss=".15"/>
<inertial pos="0 .01 .02" mass=".25" diaginertia="3e-4 3e-4 2e-4"/><body pos="0 0 .06">
<joint name="left" type="slide" axis="0 1 0" damping="4" armature=".05" frictionloss=".5"/>
<inertial pos="0 0 .02" mass=".02" diaginertia="1e-5 1e-5 1e-5"/></body></body></worldbody>
<actuator><position joint="yaw" kp="25" kv="1"/><position joint="left" kp="300" kv="20"/></actuator></mujoco>"""


def test_a_joint_that_slides_has_its_own_units_in_file_and_page(tmp_path: Path):
    """A gripper beside a joint that turns: N s/m in its cell, not at the head of the column for all."""
    (tmp_path / "arm.xml").write_text(SLIDER)
    t, u, q = moved(SLIDER, 200)
    noise = np.random.default_rng(1).normal(0, 1, q.shape) * [3e-4, 3e-5]
    np.savez(tmp_path / "run.npz", t=t, u=u, q=q + noise)
    (tmp_path / "task.yaml").write_text(
        "robot: {model: arm.xml}\ndata: [{file: run.npz, time: t, command: u, position: q}]\n"
    )
    assert main(["identify", str(tmp_path / "task.yaml"), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    units = {one["expression"]: one["unit"] for one in result["base_parameters"]}
    assert (units["damping yaw"], units["damping left"]) == ("N m s/rad", "N s/m")
    assert (units["friction left"], units["armature left"]) == ("N", "kg")
    page = (tmp_path / "run" / "report.html").read_text()
    head = page[page.index("<thead>") : page.index("</thead>")]
    body = page[page.index("</thead>") : page.index("</table>")]
    assert "N s/m" not in head and "N m s/rad" not in head and body.count("N s/m") == 1 and body.count("N m s/rad") == 1


def stepped(rows: int = 400, steps: int = 10) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, command and position (rad, joint side) of the arm without its gripper on random steps, by MuJoCo C."""
    model = mujoco.MjModel.from_xml_string(ARM.format(finger="", first=""))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    u = np.repeat(rng.uniform(-0.4, 0.4, (rows // 20, 2)), 20, axis=0) * [1.0, 2.0]
    q = []
    for row in u:
        q.append(data.qpos.copy())
        data.ctrl[:] = row
        mujoco.mj_step(model, data, steps)
    return np.arange(rows) * steps * 0.002, u, np.array(q)


@pytest.mark.parametrize(
    ("spoil", "advice"),
    [
        (lambda u, q: (np.rad2deg(u), np.rad2deg(q)), "looks like degrees: add units: {position: deg}"),
        (lambda u, q: (q, u), "moves before its command at yaw, lift .*are `command` and `position` swapped"),
        (lambda u, q: (u, q + np.outer(np.arange(len(q)) > 200, [2 * np.pi, 0])), "yaw jumps by 2 pi in row 201"),
    ],
)
def test_a_rollout_in_another_unit_or_order_is_refused(spoil: Any, advice: str, tmp_path: Path, capsys):
    """Files that every simulation would fit wrongly in silence: exit status 2, one message, nothing written."""
    (tmp_path / "arm.xml").write_text(ARM.format(finger="", first=""))
    t, u, q = stepped()
    command, position = spoil(u, q)
    entry = "{file: run.npz, time: t, command: u, position: q}"
    (tmp_path / "task.yaml").write_text(f"robot: {{model: arm.xml}}\ndata:\n  - {entry}\n")
    np.savez(tmp_path / "run.npz", t=t, u=command, q=position)
    assert main(["identify", str(tmp_path / "task.yaml"), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "run.npz" in said and re.search(advice, said), said
    assert not (tmp_path / "run").exists()


def test_commands_in_the_order_of_the_actuators_are_refused(tmp_path: Path, capsys):
    """MuJoCo's `ctrl` as it is, of a hand whose first actuator is the last joint's: another joint's command each."""
    (tmp_path / "arm.xml").write_text(GRIPPING)
    t, u, q = moved(GRIPPING, 200)
    np.savez(tmp_path / "run.npz", t=t, u=u, q=q)
    entry = "{file: run.npz, time: t, command: u, position: q}"
    (tmp_path / "task.yaml").write_text(f"robot: {{model: arm.xml}}\ndata: [{entry}]\n")
    assert main(["identify", str(tmp_path / "task.yaml"), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "run.npz: the columns of `command` are read in the order of the joints (yaw, lift, left)" in said
    assert (
        "in the order of the model's actuators, which act at left, yaw, lift" in said
        and not (tmp_path / "run").exists()
    )


def test_torques_in_the_order_of_the_motors_are_refused(tmp_path: Path, capsys):
    """Motors that a controller outside drives, the elbow's first: a torque is told by the motion that it makes."""
    text = ARM.format(finger="", first="").split("<actuator>")[0]
    text += '<actuator><motor joint="lift" gear="-5"/><motor joint="yaw" gear="8"/></actuator></mujoco>'
    (tmp_path / "arm.xml").write_text(text)
    model = mujoco.MjModel.from_xml_string(text)
    data, t, u, q = mujoco.MjData(model), 0.01 * np.arange(250), [], []
    for now in t:
        q.append(data.qpos.copy())
        wanted = [0.8 * np.sin(3.1 * now), 0.6 * np.sin(2.3 * now) + 0.2 * np.sin(6.1 * now)]
        torque = 20 * (wanted - data.qpos) - 2 * data.qvel
        u.append([torque[1] / -5, torque[0] / 8])
        data.ctrl[:] = u[-1]
        mujoco.mj_step(model, data, 5)
    entry = "{file: run.npz, time: t, command: u, position: q}"
    (tmp_path / "task.yaml").write_text(f"robot: {{model: arm.xml}}\ndata: [{entry}]\n")
    for columns, status in (([0, 1], 2), ([1, 0], 0)):
        np.savez(tmp_path / "run.npz", t=t, u=np.array(u)[:, columns], q=np.array(q) + 1e-4 * np.cos(1e5 * t)[:, None])
        words = ["identify", str(tmp_path / "task.yaml"), "--out", str(tmp_path / f"run{status}"), "--quiet"]
        assert main(words) == status
    said = " ".join(capsys.readouterr().err.split())
    assert "read in the order of the joints (yaw, lift)" in said and "which act at lift, yaw" in said


POLE = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/><worldbody><body>
<joint name="cart" type="slide" axis="1 0 0" damping="2"/><inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/>
<body><joint name="pole" axis="0 1 0" damping=".02"/><inertial pos="0 0 -.2" mass=".3" diaginertia=".004 .004 .001"/>
</body></body></worldbody><actuator><position name="rail" joint="cart" kp="80" kv="4"/></actuator></mujoco>"""


def test_a_joint_without_a_drive_needs_no_command(tmp_path: Path, capsys):
    """A cart with a pole: one column, and the same numbers as with zeros for the pole; another count tells both."""
    (tmp_path / "cart.xml").write_text(POLE)
    model = mujoco.MjModel.from_xml_string(POLE.replace('damping=".02"', 'damping=".03"'))
    data, rng, q = mujoco.MjData(model), np.random.default_rng(4), []
    t = 0.01 * np.arange(500)
    u = 0.3 * np.sin(2 * np.pi * t[:, None] * [0.5, 0.9, 1.3]).sum(1, keepdims=True)
    for row in u:
        q.append(data.qpos.copy())
        data.ctrl[:] = row
        mujoco.mj_step(model, data, 5)
    read = np.array(q) + rng.normal(0, 2e-4, (500, 2))
    found = []
    for k, command in enumerate((u, np.hstack([u, 0 * u]))):
        np.savez(tmp_path / "run.npz", t=t, u=command, q=read)
        entry = "{file: run.npz, time: t, command: u, position: q}"
        (tmp_path / "task.yaml").write_text(f"robot: {{model: cart.xml}}\ndata: [{entry}]\n")
        assert main(["identify", str(tmp_path / "task.yaml"), "--out", str(tmp_path / f"run{k}"), "--quiet"]) == 0
        told = json.loads((tmp_path / f"run{k}" / "result.json").read_text())["base_parameters"]
        found.append({one["expression"]: one["value"] for one in told})
        (pole,) = (one for one in told if one["expression"] == "damping pole")
        assert abs(pole["value"] - 0.03) < 4 * pole["std"] < 4e-3
    assert found[0] == found[1]
    np.savez(tmp_path / "run.npz", t=t, u=np.hstack([u, u, u]), q=read)
    assert main(["identify", str(tmp_path / "task.yaml"), "--out", str(tmp_path / "no"), "--quiet"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "one column for each of cart, pole" in said and "or one column for each joint that is driven: cart" in said
    u[7] = np.nan  # what is wrong with the one column is said of it
    np.savez(tmp_path / "run.npz", t=t, u=u, q=read)
    assert main(["identify", str(tmp_path / "task.yaml"), "--out", str(tmp_path / "no"), "--quiet"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "row 7" in said and "shape" not in said and not (tmp_path / "no").exists()


def test_drives_of_one_joint_are_told_to_take_one_command(tmp_path: Path):
    more = '<velocity name="brake" joint="cart" kv="3"/></actuator>'
    (tmp_path / "cart.xml").write_text(POLE.replace("</actuator>", more))
    t = 0.01 * np.arange(100)
    np.savez(tmp_path / "run.npz", t=t, u=0.1 * np.sin(9 * t), q=np.stack([0.1 * np.sin(9 * t - 0.3), 0 * t], 1))
    entry = "{file: run.npz, time: t, command: u, position: q}"
    (tmp_path / "task.yaml").write_text(f"robot: {{model: cart.xml}}\ndata: [{entry}]\n")
    assert (
        "the drives rail and brake of cart take the same command"
        in read_rollouts(fj.load_task(tmp_path / "task.yaml"))[2]
    )


@pytest.mark.parametrize("late", [0, 3, 12])
def test_only_a_position_that_moves_first_is_ahead_of_its_command(late: int):
    """Of MuJoCo's motion, read `late` rows after it was made; a command that is logged one row late is none."""
    t, u, q = stepped()
    read, command = np.roll(q[:, 0], late), u[:, 0]
    assert ahead_of_command(command, read, t[1]) == 0
    assert ahead_of_command(np.roll(command, 1), q[:, 0], t[1]) == 0
    assert ahead_of_command(read, command, t[1]) > 0


def test_one_error_of_a_robot_counts_joints_of_one_kind(tmp_path: Path):
    """0.02 rad at two joints and 1 mm at the finger; what is named at the finger alone is judged there."""
    (tmp_path / "arm.xml").write_text(GRIPPING)
    loop, _ = load_loop(tmp_path / "arm.xml")
    names = loop.robot.dof_names
    errors = np.array([1e-3 if name == "left" else 0.02 for name in names])
    zero = np.zeros((50, 3))
    run = Run("run", np.arange(50) * 0.02, zero, zero, None, holdout=True)
    held = {"run": (zero + errors, zero + errors / 2)}

    def told(*at: str) -> Gain:
        named = [SimpleNamespace(candidate=SimpleNamespace(at=(name,))) for name in at]
        found: Any = SimpleNamespace(structure=SimpleNamespace(loop=loop), named=named)
        return gain_of(held, [run], found)

    assert told() == told("yaw") == told("yaw", "left")
    assert (told().before, told().after, told().unit) == (pytest.approx(0.02), pytest.approx(0.01), "rad")
    assert (told("left").before, told("left").after, told("left").unit) == (
        pytest.approx(1e-3),
        pytest.approx(5e-4),
        "m",
    )
    here: Any = SimpleNamespace(
        loop=loop, spread=errors, data=SimpleNamespace(weight=np.ones((1, 3, 50)), weighed=False)
    )
    squares = np.full((1, 1, 3), 50.0)  # whitened: each joint's error is its noise
    assert rms_of(here, squares) == pytest.approx(0.02)
    assert rms_of(here, squares, names.index("left")) == pytest.approx(1e-3)
