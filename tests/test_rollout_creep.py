"""Friction that holds a joint where MuJoCo's soft constraint creeps, made by MuJoCo C with a stiff one."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from schema import matches

from figaroh_jax.cli import main
from figaroh_jax.rollouts.causes import catalogue, elastic_loop
from figaroh_jax.rollouts.creep import creep_notes, creep_speed, searched_with_both, stiff
from figaroh_jax.rollouts.data import Run
from figaroh_jax.rollouts.export import described, for_simulator, with_drives
from figaroh_jax.rollouts.found import Named, Search
from figaroh_jax.rollouts.loop import STIFFEST
from figaroh_jax.rollouts.parameters import values
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.search import search
from figaroh_jax.rollouts.setting import Setting, Structure, setting
from figaroh_jax.rollouts.task import simulated

DT, EVERY, SECONDS = 0.002, 5, 7.5
NOISE = 2e-4  # rad


def servo(friction: float = 0.4, more: str = "", damping: float = 0.3) -> str:
    """A lever under gravity with a soft position drive, whose friction holds it off the command."""
    return f"""<mujoco><option timestep="{DT}" integrator="implicitfast"/><worldbody><body pos="0 0 1">
    <joint name="lift" axis="0 1 0" armature="0.03" damping="{damping}" frictionloss="{friction}" {more}/>
    <inertial pos="0.15 0 0" mass="0.4" diaginertia="0.001 0.001 0.001"/></body></worldbody>
    <actuator><position name="lift" joint="lift" kp="8" kv="0.2"/></actuator></mujoco>"""


STIFF = f'solreffriction="{2 * DT} 1" solimpfriction="{STIFFEST} {STIFFEST}"'


def recorded(text: str, number: int, detent: float = 0.0) -> Run:
    """Steps and holds; `detent` N m of a torque of the angle that is no effect of the library's."""
    model = mujoco.MjModel.from_xml_string(text)
    data, rng = mujoco.MjData(model), np.random.default_rng([7, number])
    held = rng.uniform(-0.7, 0.7, round(SECONDS / 1.5) + 1)
    time = np.arange(round(SECONDS / DT / EVERY)) * DT * EVERY
    wave = 0.3 * np.sin(2 * np.pi * time * rng.uniform(0.1, 0.4))
    u = np.repeat(held[(time / 1.5).astype(int)] + np.where(time < 3, 0.0, wave), EVERY)
    data.qpos[:], q = held[0], np.zeros(len(u))
    for k, one in enumerate(u):
        q[k], data.ctrl[:] = data.qpos[0], one
        data.qfrc_applied[:] = detent * np.sign(np.sin(60 * data.qpos))
        mujoco.mj_step(model, data)
    q = q[::EVERY] + rng.normal(0, NOISE, len(u) // EVERY)
    return Run(f"run {number}", np.arange(len(q)) * DT * EVERY, u[::EVERY, None], q[:, None], None)


def diagnosed(folder: Path, made: str, filed: str, detent: float = 0.0) -> tuple[Setting, Search]:
    (folder / "servo.xml").write_text(filed)
    here = setting(load_loop(folder / "servo.xml")[0], [recorded(made, k, detent) for k in range(3)])
    return here, searched_with_both(search, here)


def test_the_speed_of_creep_is_mujocos(tmp_path: Path) -> None:
    """A lever that friction holds against all that it can moves in MuJoCo C as fast as is said."""
    (tmp_path / "servo.xml").write_text(servo())
    loop, _ = load_loop(tmp_path / "servo.xml")
    model = mujoco.MjModel.from_xml_string(servo())
    model.opt.gravity[:], model.actuator_gainprm[:], model.actuator_biasprm[:], model.dof_damping[:] = 0, 0, 0, 0
    data = mujoco.MjData(model)
    data.qfrc_applied[:] = 0.4 * 0.999
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert data.qvel[0] == pytest.approx(0.999 * creep_speed(loop)[0], rel=1e-3)
    assert creep_speed(stiff(loop))[0] < 2e-3 * creep_speed(loop)[0]


@pytest.mark.slow
def test_friction_that_holds_is_named_where_the_files_creeps(tmp_path: Path) -> None:
    """Nothing else is missing: friction is named, nothing stays, its size is right, and MuJoCo C moves as told."""
    here, found = diagnosed(tmp_path, servo(more=STIFF), servo(friction=0.3, damping=0.2))
    assert found.verdict == "named"
    (named,) = found.named
    assert (named.candidate.effect, named.candidate.at) == ("friction_loss", ("lift",))
    (entry,) = named.candidate.entries
    assert found.last.theta[entry] == pytest.approx(0.4, rel=0.01)
    assert named.after < 0.5 * named.before
    (note,) = creep_notes(here, found).values()
    assert "mrad/s" in note
    assert "solimpfriction 0.9999" in note


def test_the_speed_is_told_where_a_joint_has_a_spring_too(tmp_path: Path) -> None:
    """The loop with a spring has one coordinate more than the robot of the file."""
    (tmp_path / "servo.xml").write_text(servo())
    here = setting(load_loop(tmp_path / "servo.xml")[0], [recorded(servo(), 0)])
    loop, table = elastic_loop(here.loop, 0, 100.0, 0.1), here.known.table
    theta, friction = values(here.loop, table), catalogue(here.loop, np.ones(1)).candidates
    (one,) = (Named(c, 4.0, 0.5, ()) for c in friction if c.effect == "friction_loss")
    found = SimpleNamespace(creeps=[one], structure=(stiff(loop), table, None), last=SimpleNamespace(theta=theta))
    found.structure = Structure(*found.structure)
    (note,) = creep_notes(here, found).values()  # pyright: ignore[reportArgumentType]
    assert f"{1e3 * creep_speed(here.loop)[0]:.2g} mrad/s" in note


def test_friction_that_creeps_as_the_files_is_nothing(tmp_path: Path) -> None:
    _, found = diagnosed(tmp_path, servo(), servo(friction=0.3, damping=0.2))
    assert (found.verdict, found.named, found.creeps) == ("nothing", [], [])


@pytest.mark.slow
@pytest.mark.parametrize("detent", [0.1, 0.3])
def test_what_is_not_in_the_catalogue_is_no_friction_that_holds(tmp_path: Path, detent: float) -> None:
    """A robot whose friction creeps as the file's, with a torque of its own beside it."""
    _, found = diagnosed(tmp_path, servo(), servo(friction=0.3, damping=0.2), detent)
    assert found.creeps == []


def test_the_exported_file_holds_in_mujoco(tmp_path: Path) -> None:
    """The stiff loop, and one whose friction is hard, as MJCF: MuJoCo C with its own options moves alike."""
    (tmp_path / "servo.xml").write_text(servo())
    run = recorded(servo(more=STIFF), 5)
    for law, bound in (("soft", 1e-9), ("hard", 1e-4)):
        loop = load_loop(tmp_path / "servo.xml", law=law)[0]
        loop = stiff(loop) if law == "soft" else loop
        text = with_drives(tmp_path / "servo.xml", described(loop))
        model = mujoco.MjModel.from_xml_string(text)
        assert model.opt.iterations >= 100
        assert model.opt.ls_iterations >= 50
        said = {
            (name, part): [one["value"] for one in told[part] if one["number"] == "friction_impedance"]
            for name in ("mujoco", "genesis", "gazebo")
            for told in [for_simulator(described(loop), name)]
            for part in ("values", "unsaid")
        }
        assert said.pop(("mujoco", "values")) == said.pop(("genesis", "unsaid")) == pytest.approx([STIFFEST])
        assert not any(said.values())  # Gazebo's friction is Coulomb's
        data, u = mujoco.MjData(model), np.repeat(run.command[:, 0], EVERY)
        data.qpos[:], q = run.position[0], np.zeros(len(u))
        ours = simulated(loop, run._replace(position=np.full_like(run.position, run.position[0])))
        for k, one in enumerate(u):
            q[k], data.ctrl[:] = data.qpos[0], one
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(q[::EVERY], ours[:, 0], atol=bound, rtol=0)


def test_the_command_line_names_it_and_identify_fits_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Three recordings that friction holds in, by both commands; one held out moves, in the other the joint stands."""
    (tmp_path / "servo.xml").write_text(servo(friction=0.3, damping=0.2))
    runs = [recorded(servo(more=STIFF), k) for k in range(4)]
    still = np.full_like(runs[0].position, 0.1)  # rad, at which the drive holds the weight with less than friction
    stands = runs[0]._replace(command=still + 0.15 * 0.4 * 9.81 * np.cos(0.1) / -8.0, position=still)
    for k, run in enumerate([*runs, stands]):
        np.savez(tmp_path / f"run{k}.npz", t=run.time, u=run.command, q=run.position)
    data = [{"file": f"run{k}.npz", "time": "t", "command": "u", "position": "q"} for k in range(5)]
    roles = [one | {"role": "fit" if k < 3 else "holdout"} for k, one in enumerate(data)]
    task = tmp_path / "task.yaml"
    task.write_text(json.dumps({"robot": {"model": "servo.xml"}, "data": roles}))

    assert main(["diagnose", str(task), "--out", str(tmp_path / "d"), "--quiet"]) == 0
    assert "The robot's friction holds joints" in " ".join(capsys.readouterr().out.split())
    answer = json.loads((tmp_path / "d" / "answer.json").read_text())
    assert answer["verdict"] == "named"
    (cause,) = answer["causes"]
    assert (cause["effect"], cause["at"]) == ("friction_loss", ["lift"])
    assert answer["p_value"] < 1e-3
    (note,) = (note for note in answer["notes"] if note.startswith("friction_loss (lift): it holds the joint"))
    assert "mrad/s" in note and "solimpfriction 0.9999" in note
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "d" / "model" / "robot.xml"))
    data_, u, q = mujoco.MjData(model), np.repeat(runs[3].command[:, 0], EVERY), np.zeros(len(runs[3].time) * EVERY)
    data_.qpos[:] = runs[3].command[0]
    for k, one in enumerate(u):
        q[k], data_.ctrl[:] = data_.qpos[0], one
        mujoco.mj_step(model, data_)
    assert np.sqrt(np.mean((q[::EVERY] - runs[3].position[:, 0]) ** 2)) < 2 * NOISE

    assert main(["identify", str(task), "--out", str(tmp_path / "i"), "--quiet"]) == 0
    result = json.loads((tmp_path / "i" / "result.json").read_text())
    matches("identify", result)
    told = {one["expression"]: one["value"] for one in result["base_parameters"]}
    assert told["friction lift"] == pytest.approx(0.4, rel=0.01)
    assert told["damping lift"] == pytest.approx(0.3, rel=0.02)
    assert any("friction holds where the soft friction of the file" in note for note in result["notes"])
    assert result["holdout"]["run4"]["relative"] == result["holdout"]["run4"]["r2"] == [None]
    assert result["holdout"]["run3"]["relative"][0] < 0.01
