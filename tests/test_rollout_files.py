"""Rollouts of files as strangers have them: a gripper left out, columns named after servos, numbers that differ."""

# ruff: noqa: E501 - the robot stands here as lines of XML
from __future__ import annotations

import csv
import datetime
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_rollout_diagnosis import task

from figaroh_jax.cli import main
from figaroh_jax.rollouts.alone import separable
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.simulation import rollout

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
    error = 1e3 * np.sqrt(np.mean((np.array(read) - held["q"][:, 0]) ** 2))
    assert abs(float(note.split("recordings kept out is ")[1].split()[0]) - error) < 0.05 * error
