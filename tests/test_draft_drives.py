"""`figaroh-jax new` for robots that are commanded: fewer drives than joints, motors, servos; recorded by MuJoCo C."""

# ruff: noqa: E501 - the robots stand here as lines of XML
from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco as engine
import numpy as np
import pytest
import yaml

import figaroh_jax as fj
from figaroh_jax.cli import main
from figaroh_jax.rollouts.task import read_rollouts

mujoco: Any = engine
HEAD = (
    '<mujoco model="{}"><option timestep=".002" integrator="implicitfast"><flag contact="disable"/></option><worldbody>'
)
CART = f"""{HEAD.format("cart")}<body><joint name="rail" type="slide" axis="1 0 0" damping=".5"/>
<geom type="box" size=".1 .05 .05" mass="1"/><body><joint name="pole" axis="0 1 0" damping=".01"/>
<geom type="capsule" fromto="0 0 0 0 0 -.6" size=".02" mass=".2"/></body></body></worldbody>
<actuator><motor name="belt" joint="rail"/></actuator></mujoco>"""
ARM = f"""{HEAD.format("arm")}<body><joint name="j1" axis="0 0 1" armature=".01" damping=".1"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1"/><body pos=".3 0 0"><joint name="j2" axis="0 1 0" armature=".01" damping=".1"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".8"/><body pos=".3 0 0"><joint name="j3" axis="0 1 0" damping=".01"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".3"/></body></body></body></worldbody>
<actuator><position name="lift" joint="j2" kp="40" kv="2"/><position name="turn" joint="j1" kp="40" kv="2"/></actuator></mujoco>"""
DOUBLE = f"""{HEAD.format("double")}<body><joint name="shoulder" axis="0 1 0" damping=".05"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".6"/><body pos="0 0 -.2"><joint name="elbow" axis="0 1 0" damping=".03"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5"/></body></body></worldbody>
<actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow" gear="2"/></actuator></mujoco>"""
T = 0.01 * np.arange(900)
COMMANDS = {
    CART: 4 * np.sin(3 * T[:, None]) + 3 * np.sin(5.3 * T[:, None] + 1),
    ARM: np.stack([0.4 * np.sin(3 * T) + 0.2 * np.sin(4.7 * T) - 0.3, 0.6 * np.sin(2 * T) + 0.2 * np.sin(5 * T)], 1),
    DOUBLE: np.stack([0.8 * np.sin(4 * T) + 0.4 * np.sin(7 * T), 0.15 * np.sin(5 * T + 1)], 1),
}


def recorded(xml: str, noise: float = 1e-4) -> tuple[np.ndarray, np.ndarray]:
    """Positions that MuJoCo C makes of this robot's commands, and those; the commands in the actuators' order."""
    model = mujoco.MjModel.from_xml_string(xml)
    data, q = mujoco.MjData(model), []
    key = next(one for one in COMMANDS if one.split("<")[1] == xml.split("<")[1])
    for row in COMMANDS[key]:
        q.append(data.qpos.copy())
        data.ctrl[:] = row
        mujoco.mj_step(model, data, 5)
    return np.array(q) + np.random.default_rng(0).normal(0, noise, np.shape(q)), COMMANDS[key]


def table(path: Path, **columns: np.ndarray) -> Path:
    np.savetxt(path, np.column_stack([*columns.values()]), "%.12g", ",", header=",".join(columns), comments="")
    return path


def drafted(folder: Path, xml: str, columns: dict[str, np.ndarray], *more: str) -> int:
    (folder / "robot.xml").write_text(xml)
    run = table(folder / "run.csv", time=T, **columns)
    return main(["new", str(folder / "robot.xml"), str(run), "--out", str(folder / "task.yaml"), *more])


def refused(capsys: pytest.CaptureFixture[str], folder: Path, xml: str, columns: dict[str, np.ndarray]) -> str:
    assert drafted(folder, xml, columns) == 2
    assert not (folder / "task.yaml").exists()
    return " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("xml", "changed", "names", "note"),
    [
        (CART, ('damping=".01"', 'damping=".03"'), ("q_rail", "q_pole", "command"), "damping of pole is 0.03"),
        (ARM, ('name="j2"', 'name="j2" frictionloss=".4"'), ("q1", "q2", "q3", "cmd_lift", "cmd_turn"), "friction of j2 is 0.4"),
        (DOUBLE, ('damping=".03"', 'damping=".03" frictionloss=".02"'), ("q1", "q2", "u1", "u2"), "friction of elbow is 0.02"),
    ],
    ids=["motor at a cart", "servos at two of three joints", "motors"],
)  # fmt: skip
def test_a_draft_of_a_commanded_robot_is_a_task_that_diagnose_runs(
    xml: str, changed: tuple[str, str], names: tuple[str, ...], note: str, tmp_path: Path
):
    """What the draft's diagnosis finds is what was changed in MuJoCo."""
    q, u = recorded(xml.replace(*changed))
    assert drafted(tmp_path, xml, dict(zip(names, np.hstack([q, u]).T, strict=True))) == 0
    assert main(["diagnose", str(tmp_path / "task.yaml"), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    answer = json.loads((tmp_path / "run" / "answer.json").read_text())
    assert answer["verdict"] == "nothing"
    assert note in " ".join(answer["refitted"] if "refitted" in answer else answer["notes"])


def test_torques_stay_torques_beside_positions_in_degrees(tmp_path: Path):
    q, u = recorded(DOUBLE)
    columns = {"q_shoulder": np.rad2deg(q[:, 0]), "q_elbow": np.rad2deg(q[:, 1]), "ctrl_elbow": u[:, 1], "ctrl_shoulder": u[:, 0]}  # fmt: skip
    assert drafted(tmp_path, DOUBLE, columns, "--unit", "deg") == 0
    _, (run,), _ = read_rollouts(fj.load_task(tmp_path / "task.yaml"))
    np.testing.assert_allclose(run.command, u, rtol=0, atol=1e-9)
    np.testing.assert_allclose(run.position, q, rtol=0, atol=1e-9)


def test_commanded_positions_and_velocities_have_the_unit_of_the_positions(tmp_path: Path):
    """A servo of position at j1, one of velocity at j2; zeros for the joint without a drive are no command."""
    xml = ARM.replace('<position name="lift" joint="j2" kp="40" kv="2"/>', '<velocity name="lift" joint="j2" kv="2"/>')
    q, u = recorded(xml)
    columns = {f"q{k + 1}": np.rad2deg(q[:, k]) for k in range(3)}
    columns |= {"cmd1": np.rad2deg(u[:, 1]), "cmd2": np.rad2deg(u[:, 0]), "cmd3": 0 * T}
    assert drafted(tmp_path, xml, columns, "--unit", "deg") == 0
    task = fj.load_task(tmp_path / "task.yaml")
    assert task.data[0].command == ("cmd1", "cmd2", "cmd3")
    _, (run,), _ = read_rollouts(task)
    np.testing.assert_allclose(run.command, u, rtol=0, atol=1e-9)


def test_commands_that_cannot_be_told_are_refused(tmp_path: Path, capsys):
    q, u = recorded(DOUBLE)
    both = {"q_shoulder": q[:, 0], "q_elbow": q[:, 1]}
    said = refused(capsys, tmp_path, DOUBLE, both | {"u_shoulder": u[:, 1], "u_elbow": u[:, 0]})
    assert "different orders: shoulder goes with the command given for elbow" in said
    said = refused(capsys, tmp_path, DOUBLE, both | {"voltage": u[:, 0]})
    assert "no column looks like a torque" in said and "cmd_shoulder" in said
    assert "2 joints (shoulder, elbow), of which" in refused(capsys, tmp_path, DOUBLE, both | {"cmd": u[:, 0]})
    q, u = recorded(ARM)
    three = {f"q{k + 1}": q[:, k] for k in range(3)}
    said = refused(capsys, tmp_path, ARM, three | {"cmd_j1": u[:, 0], "cmd_j2": u[:, 1]})
    assert "position of j1 does not follow its command" in said and "Its drive turn takes a position" in said
    said = refused(capsys, tmp_path, ARM, three | {"cmd1": u[:, 0], "cmd2": u[:, 1]})  # in the actuators' order
    assert "Name each column after its joint, as cmd_j1" in said
    said = refused(capsys, tmp_path, ARM, three | {"cmd_j1": u[:, 1], "cmd_j3": u[:, 0]})
    assert "of which j1, j2 have a drive" in said and "as cmd_j1" in said
    said = refused(capsys, tmp_path, ARM, three | {"cmd_j1": u[:, 1], "ref_j1": u[:, 1], "cmd_j2": u[:, 0]})
    assert "cmd_j1 and ref_j1 look like commands of one joint" in said


def test_a_urdf_has_drives_where_the_commands_names_say_so(tmp_path: Path, capsys):
    from test_draft import JOINT, LIMIT, LINK

    parts = [LINK.format(name, 1) for name in ("base", "a", "b", "c")]
    chain = (("j1", "base", "a"), ("j2", "a", "b"), ("j3", "b", "c"))
    parts += [JOINT.format(name, "revolute", above, below, "0 0 1", LIMIT) for name, above, below in chain]
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    q, u = recorded(ARM)
    columns = {f"q{k + 1}": q[:, k] for k in range(3)} | {"cmd_j2": u[:, 0], "cmd_j1": u[:, 1]}
    words = ["new", str(tmp_path / "arm.urdf"), str(table(tmp_path / "run.csv", time=T, **columns))]
    assert main([*words, "--kp", "40,40,40"]) == 2
    assert "expected one for each of j1, j2" in capsys.readouterr().err
    assert main([*words, "--kp", "40,30", "--out", str(tmp_path / "task.yaml")]) == 0
    assert yaml.safe_load((tmp_path / "task.yaml").read_text())["actuator"]["j2"] == {"kind": "position", "kp": 30.0}
    loop, (run,), _ = read_rollouts(fj.load_task(tmp_path / "task.yaml"))
    assert loop.drives.names == ("j1", "j2")
    np.testing.assert_allclose(run.command, u[:, ::-1], rtol=0, atol=1e-9)
