"""What MuJoCo has no words for, said by the exported callback, against our own simulation of the same loop."""

import importlib.util
from pathlib import Path
from typing import Any

import equinox as eqx
import mujoco as engine
import numpy as np
import pytest
from test_rollouts import HAND, explicit

from figaroh_jax.formats.export import load_model, write_model
from figaroh_jax.jobs.export import export_loop
from figaroh_jax.rollouts.callback import Rest
from figaroh_jax.rollouts.causes import elastic_loop
from figaroh_jax.rollouts.loop import Loop
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.simulation import rollout
from figaroh_jax.rollouts.stored import add_loop, read_loop, write_loop
from figaroh_jax.rollouts.task import extended_of

mujoco: Any = engine
TWO = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast">
<flag contact="disable"/></option><worldbody><body pos="0 0 1"><joint name="j1" axis="0 1 0" damping="0.4"
armature="0.05" frictionloss="0.15"/><inertial pos=".15 0 .02" mass="1" diaginertia=".01 .02 .02"/>
<body pos="0.3 0 0"><joint name="j2" axis="0 1 0" damping="0.3" armature="0.04" frictionloss="0.1"/>
<inertial pos=".1 0 0" mass=".6" diaginertia=".004 .006 .006"/></body></body></worldbody>
<actuator><position name="a" joint="j1" kp="60" kv="2"/><position name="b" joint="j2" kp="40" kv="1"/></actuator>
</mujoco>"""
NUMBERS = {
    "friction": {"stribeck_force": [0.3, 0.0], "stribeck_speed": [0.2, 0.1], "load_ratio": [0.0, 0.15]},
    "torques": {"stiffness": [3.0, 2.0], "play": [0.05, 0.0], "offset": [0.1, -0.2], "reading": [0.02, -0.01]},
    "drives": {"dead_band": [0.01, 0.0], "voltage": [np.inf, 4.0], "delay": [0.0051, 0.008]},
}
NUMBERS["all"] = NUMBERS["friction"] | NUMBERS["torques"] | NUMBERS["drives"]


def changed(loop: Loop, numbers: dict[str, list[float]]) -> Loop:
    for name, value in numbers.items():
        part = "drives" if hasattr(loop.drives, name) else "joints"
        loop = eqx.tree_at(lambda m: getattr(getattr(m, part), name), loop, np.array(value))  # noqa: B023
    return loop


@pytest.mark.parametrize("which", NUMBERS)
def test_the_exported_callback_moves_mujoco_as_the_loop_moves(which: str, tmp_path: Path):
    """1000 steps with the files of `export --for mujoco --out`, read as a user reads them."""
    (tmp_path / "arm.xml").write_text(TWO)
    loop = changed(load_loop(tmp_path / "arm.xml")[0], NUMBERS[which])
    write_model(extended_of(loop), tmp_path / "model")
    add_loop(tmp_path / "model", loop)
    export_loop(tmp_path / "model", "mujoco", tmp_path / "out")
    spec = importlib.util.spec_from_file_location("callback", tmp_path / "out" / "callback.py")
    assert spec is not None and spec.loader is not None
    theirs = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(theirs)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "robot.xml"))
    data, rest = mujoco.MjData(model), theirs.Rest(model, tmp_path / "out" / "loop.json")
    t = 0.002 * np.arange(1000)[:, None]
    u, seen = 0.4 * np.sin(t * [4.0, 7.0] + [0.0, 1.0]) * np.clip(t / 0.2, 0, 1) + [0.2, -0.3], []
    for row in u:
        seen.append(rest.reading(data))
        rest.step(data, row)
    ours = rollout(loop, u, np.zeros(2)).reading
    assert np.ptp(seen, axis=0).min() > 0.1
    np.testing.assert_allclose(ours, seen, rtol=0, atol=1e-9)


FREE = "<joint name='base' type='free' armature='.2' damping='.1' frictionloss='.05'/>"


@pytest.mark.parametrize(("root", "integrator"), [("", "implicitfast"), (FREE, "explicit")])
def test_the_exported_files_start_and_move_as_the_original(root: str, integrator: str, tmp_path: Path):
    """Joints whose zero is not where they start, a ball and a free base: MuJoCo C with both files."""
    text = HAND.replace("{root}", root).replace("<body>", '<body pos="0 0 1">')
    text = explicit(text.replace("{integrator}", "Euler")) if integrator == "explicit" else text
    text = text.replace("{integrator}", integrator)
    (tmp_path / "arm.xml").write_text(text)
    loop, _ = load_loop(tmp_path / "arm.xml")
    write_model(extended_of(loop), tmp_path / "model")
    add_loop(tmp_path / "model", loop)
    for _ in range(2):  # the second time from what the first one wrote
        export_loop(tmp_path / "model", "mujoco", tmp_path / "out")
        (tmp_path / "model" / "robot.xml").write_text((tmp_path / "out" / "robot.xml").read_text())
    models = [mujoco.MjModel.from_xml_path(str(tmp_path / name)) for name in ("arm.xml", "out/robot.xml")]
    first, second = (mujoco.MjData(model) for model in models)
    rest = Rest(models[1], tmp_path / "out" / "loop.json")
    names = [models[0].joint(k).name for k in range(models[0].njnt)]
    assert sorted(names) == sorted(models[1].joint(k).name for k in range(models[1].njnt))
    for row in 0.8 * np.sin(0.004 * np.arange(200)[:, None] * [5.0, 9.0]):
        for name in names:
            np.testing.assert_allclose(second.joint(name).qpos, first.joint(name).qpos, rtol=0, atol=1e-8, err_msg=name)
        first.ctrl[:] = row
        mujoco.mj_step(models[0], first)
        rest.step(second, row)
    np.testing.assert_allclose(models[1].dof_invweight0.sum(), models[0].dof_invweight0.sum(), rtol=1e-9)
    assert abs(first.joint("finger").qpos[0] - 0.3) > 0.1


@pytest.mark.parametrize("play", [pytest.param(0.0, marks=pytest.mark.slow), 0.03])
def test_a_spring_between_motor_and_link_is_written_and_read_back(play: float, tmp_path: Path):
    """The written MJCF has motor and link, the URDF the rigid robot; what comes back moves as MuJoCo C moves that."""
    (tmp_path / "arm.xml").write_text(TWO)
    plain = load_loop(tmp_path / "arm.xml")[0]
    loop = elastic_loop(plain, 0, 90.0, 0.3)
    loop = eqx.tree_at(lambda m: m.joints.play, loop, np.array([0.0, 0.0, play]))
    write_loop(loop, tmp_path / "model")
    robot, back = load_model(tmp_path / "model").robot, read_loop(tmp_path / "model")
    assert (robot.joint_names, back.measured) == (("j1", "j2"), (0, 1))
    assert back.robot.dof_names == ("j1", "j2", "j1_spring")
    assert [one.link for one in robot.joints] == [one.link for one in plain.robot.joints]
    np.testing.assert_allclose(robot.inertia, plain.robot.inertia, rtol=0, atol=1e-15)
    np.testing.assert_allclose(robot.placement, plain.robot.placement, rtol=0, atol=1e-15)
    export_loop(tmp_path / "model", "mujoco", tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "robot.xml"))
    data, rest = mujoco.MjData(model), Rest(model, tmp_path / "out" / "loop.json")
    t = 0.002 * np.arange(800)[:, None]
    u, seen = 0.4 * np.sin(t * [4.0, 7.0] + [0.0, 1.0]) * np.clip(t / 0.2, 0, 1) + [0.2, -0.3], []
    for row in u:
        seen.append([data.joint(name).qpos[0] for name in back.robot.dof_names])
        rest.step(data, row)
    assert np.ptp(seen, axis=0).min() > 0.02
    np.testing.assert_allclose(rollout(back, u, np.zeros(3)).position, seen, rtol=0, atol=1e-9)


def test_torques_at_a_joint_of_several_axes_are_refused(tmp_path: Path):
    (tmp_path / "arm.xml").write_text(HAND.replace("{root}", "").replace("{integrator}", "implicitfast"))
    loop = changed(load_loop(tmp_path / "arm.xml")[0], {"offset": [0.0, 0.0, 0.0, 0.1, 0.0]})
    write_model(extended_of(loop), tmp_path / "model")
    add_loop(tmp_path / "model", loop)
    with pytest.raises(ValueError, match=r"tip\.wy: .* several axes"):
        Rest(mujoco.MjModel.from_xml_path(str(tmp_path / "model" / "robot.xml")), tmp_path / "model" / "loop.json")


def test_a_drive_with_a_state_is_refused(tmp_path: Path):
    (tmp_path / "arm.xml").write_text(TWO.replace('<position name="a"', '<position timeconst=".05" name="a"'))
    loop = changed(load_loop(tmp_path / "arm.xml")[0], {"dead_band": [0.01, 0.0]})
    write_model(extended_of(loop), tmp_path / "model")
    add_loop(tmp_path / "model", loop)
    export_loop(tmp_path / "model", "mujoco", tmp_path / "out")
    with pytest.raises(ValueError, match="drive a has a state"):
        Rest(mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "robot.xml")), tmp_path / "out" / "loop.json")
