"""Effects of a user's own in rollouts: simulated as MuJoCo C does it in a loop of Python, fitted, named, exported."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco as engine
import numpy as np
import pytest

import figaroh_jax as fj
from figaroh_jax.cli import main
from figaroh_jax.jobs.export import export_loop
from figaroh_jax.rollouts.data import Run, Stretch, windows
from figaroh_jax.rollouts.loop import Loop
from figaroh_jax.rollouts.own import everywhere, left_out
from figaroh_jax.rollouts.parameters import Entry
from figaroh_jax.rollouts.sensitivity import linear_sums, predicted

mujoco: Any = engine
ROOT = Path(__file__).resolve().parents[1]
SERVO = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body pos="0 0 1">
<joint name="lift" axis="0 1 0" damping="0.4" armature="0.05" frictionloss="0.15"/>
<inertial pos=".15 0 .02" mass="1" diaginertia=".01 .02 .02"/></body></worldbody>
<actuator><position name="lift" joint="lift" kp="60" kv="2"/></actuator></mujoco>"""
STRENGTH, NOTCH, GRIP, FORCE, DISTANCE = 1.5, 0.15, 0.1, 0.4, 0.05


class Notch(fj.JointEffect):
    """A ball that drops into a notch."""

    name, title, equation = "test_notch", "a notch", "strength x exp(-x^2 / 2), x = (q - place) / 0.1 rad"
    strength: float = fj.amplitude("N m")
    place: float = fj.shape("rad", (-0.6, -0.4, -0.2, 0.0, 0.2, 0.4, 0.6), (-1.0, 1.0))

    def torque(self, motion: fj.Motion) -> Any:
        x = (self.here(motion.position) - self.place) / 0.1
        return self.strength * x * jnp.exp(-(x**2) / 2)


class Grip(fj.JointEffect):
    """Dry friction that depends on the position."""

    name, title, equation, dissipative = "test_grip", "a grip", "s(v) force (1 + cos q)", True
    force: float = fj.amplitude("N m")

    def torque(self, motion: fj.Motion) -> Any:
        return self.force * self.here(motion.direction) * (1 + jnp.cos(self.here(motion.position)))


class Bristle(fj.JointEffect):
    """Friction with a state."""

    name, title, equation = "test_bristle", "a bristle", "force z, z' = v / distance (1 - z s(v))"
    force: float = fj.amplitude("N m")
    distance: float = fj.shape("rad", (0.02, 0.1), (0.001, 1.0))
    memory: Any = eqx.field(default=None, kw_only=True)

    def torque(self, motion: fj.Motion) -> Any:
        return self.force * self.memory * jnp.ones_like(self.here(motion.velocity))

    def step(self, velocity: Any, dt: Any) -> Bristle:
        end, stays = jnp.sign(velocity[self.at[0]]), jnp.exp(-jnp.abs(velocity[self.at[0]]) * dt / self.distance)
        return dataclasses.replace(self, memory=end + (self.memory - end) * stays)


def servo(folder: Path) -> Loop:
    """The servo with all three effects."""
    (folder / "servo.xml").write_text(SERVO)
    loop, _ = fj.load_loop(folder / "servo.xml")
    return loop.with_effects(
        fj.place(Notch, loop.robot, ["lift"], strength=STRENGTH, place=NOTCH),
        fj.place(Grip, loop.robot, ["lift"], force=GRIP),
        fj.place(Bristle, loop.robot, ["lift"], force=FORCE, distance=DISTANCE),
    )


def command(rows: int) -> np.ndarray:
    t = 0.002 * np.arange(rows)
    return (0.5 * np.sin(2 * t) + 0.3 * np.sin(5.3 * t + 1)) * np.clip(t / 0.2, 0, 1)


def simulated_by_mujoco(u: np.ndarray, grip: float = GRIP, force: float = FORCE) -> np.ndarray:
    """Positions in MuJoCo C, the effects applied before each step by code of its own."""
    model = mujoco.MjModel.from_xml_string(SERVO)
    data, q, z = mujoco.MjData(model), np.zeros(len(u)), 0.0
    for k, row in enumerate(u):
        q[k], data.ctrl[0] = data.qpos[0], row
        x = (q[k] - NOTCH) / 0.1
        data.qfrc_applied[0] = -STRENGTH * x * np.exp(-x * x / 2) - force * z
        model.dof_frictionloss[0] = 0.15 + grip * (1 + np.cos(q[k]))
        mujoco.mj_step(model, data)
        v = data.qvel[0]
        z = np.sign(v) + (z - np.sign(v)) * np.exp(-abs(v) * 0.002 / DISTANCE)
    return q


def recorded(folder: Path, q: np.ndarray, effect: str) -> Path:
    """A task with the servo's positions, noise added, and an effect in its baseline."""
    noise = 2e-4 * np.random.default_rng(3).standard_normal(len(q))
    np.savez(folder / "run.npz", t=0.002 * np.arange(len(q)), u=command(len(q)), q=q + noise)
    (folder / "task.yaml").write_text(
        f"robot: {{model: servo.xml}}\nbaseline: {{effects: [{effect}]}}\n"
        "data:\n  - {file: run.npz, time: t, command: u, position: q}\n"
    )
    return folder / "task.yaml"


def identified(folder: Path, q: np.ndarray, effect: str) -> dict[str, Any]:
    """The numbers that `identify` tells, by what they are."""
    task = recorded(folder, q, effect)
    assert main(["identify", str(task), "--out", str(folder / "out"), "--quiet"]) == 0
    result = json.loads((folder / "out" / "result.json").read_text())
    return {one["expression"]: one for one in result["base_parameters"]}


def test_effects_act_as_in_mujoco_c(tmp_path: Path):
    """A torque, a dry friction and a state, 1500 steps."""
    u = command(1500)
    mine = fj.rollout(servo(tmp_path), u[:, None], np.zeros(1)).position[:, 0]
    np.testing.assert_allclose(mine, simulated_by_mujoco(u), rtol=0, atol=1e-12)


def test_sums_by_numbers_of_effects_are_those_of_finite_differences(tmp_path: Path):
    """By linear and other numbers, of a friction and of a state, beside those of the joint and of the start."""
    loop, u = servo(tmp_path), command(500)
    names = ("test_notch.strength", "test_notch.place", "test_grip.force", "test_bristle.force",
             "test_bristle.distance", "friction", "armature")  # fmt: skip
    table = tuple(Entry(name, (k,)) for name, k in zip(names, (0, 0, 1, 2, 2, 0, 0), strict=True))
    theta, q = np.array([1.4, 0.16, 0.12, 0.5, 0.06, 0.14, 0.055]), simulated_by_mujoco(u)
    run = Run("run", 0.002 * np.arange(300), u[200:, None], q[200:, None], None)
    data = windows(loop, [run], [Stretch(0, 0, 300)], [np.array([1e-4])], 0.2)
    start = np.array([[q[200]], [0.6]])

    def squares(theta: np.ndarray, start: np.ndarray) -> float:
        with jax.enable_x64(True):
            read = np.asarray(predicted(loop, table, theta[None], data, start[None]))[0]
        return float((((data.reading - read) * data.weight) ** 2).sum())

    with jax.enable_x64(True):
        found = linear_sums(loop, table, theta[None], np.arange(7)[None], data, start[None])
    numeric = []
    for k in range(9):
        move = 1e-6 * np.eye(9)[k]
        ends = [squares(theta + s * move[:7], start + s * move[7:, None]) for s in (1, -1)]
        numeric.append((ends[0] - ends[1]) / 2e-6)
    np.testing.assert_allclose(-2 * np.asarray(found.gradient)[0].sum((0, 1)), numeric, rtol=1e-6, atol=0)


@pytest.fixture
def known() -> type[fj.Effect]:
    """The notch, registered for one test alone."""
    return fj.register(Notch)


def test_a_registered_effect_is_identified_and_exported(
    known: type[fj.Effect], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Its numbers by the command line; the files move MuJoCo as it moved, once its torque is said there too."""
    u = command(1000)
    q = simulated_by_mujoco(u, 0.0, 0.0)
    (tmp_path / "servo.xml").write_text(SERVO.replace('frictionloss="0.15"', 'frictionloss="0.3"'))
    told = identified(tmp_path, q, "{effect: test_notch, at: [lift]}")
    capsys.readouterr()
    for name, truth in (("strength", STRENGTH), ("place", NOTCH)):
        one = told[f"test_notch.{name} lift"]
        assert one["status"] == "identified" and one["unit"] == known.units()[name]
        assert abs(one["value"] - truth) < 3 * one["std"] < 0.1 * truth
    assert "test_notch" in (tmp_path / "out" / "model" / "effects.yaml").read_text()
    export_loop(tmp_path / "out" / "model", "mujoco", tmp_path / "files")
    assert "test_notch.strength" in export_loop(tmp_path / "out" / "model", "newton")
    spec = importlib.util.spec_from_file_location("callback", tmp_path / "files" / "callback.py")
    assert spec is not None and spec.loader is not None
    theirs = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(theirs)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "files" / "robot.xml"))
    with pytest.raises(ValueError, match="test_notch .* at lift is an effect that MuJoCo has no words for"):
        theirs.Rest(model, tmp_path / "files" / "loop.json")

    def torque(q: float, v: float, strength: float, place: float) -> float:
        return strength * (q - place) / 0.1 * np.exp(-(((q - place) / 0.1) ** 2) / 2)

    data, seen = mujoco.MjData(model), np.zeros(1000)
    rest = theirs.Rest(model, tmp_path / "files" / "loop.json", own={"test_notch": torque})
    for k, row in enumerate(u[:1000]):
        seen[k] = rest.reading(data)[0]
        rest.step(data, np.array([row]))
    assert np.sqrt(np.mean((seen - q[:1000]) ** 2)) < 2e-4


def test_effects_of_a_model_act_in_data_of_rollouts(tmp_path: Path):
    """`fit` frees the number of an own effect as it does those of the catalogue."""
    (tmp_path / "servo.xml").write_text(SERVO)
    loop, _ = fj.load_loop(tmp_path / "servo.xml")
    u = command(400)
    run = fj.recording(q=simulated_by_mujoco(u, 0.0, 0.0)[:, None], command=u[:, None], rate=500)
    data = fj.rollout_data(loop, run, noise=1e-4)
    model = fj.extend(data.model, fj.place(Notch, loop.robot, ["lift"], strength=1.0, place=0.12))
    found = fj.fit(model, data, {"effects": [Notch.name], "start": True}).parameters
    values = {name.split()[-1]: one.value for name, one in found.items() if Notch.name in name}
    assert values["strength"] == pytest.approx(STRENGTH, rel=1e-3) and values["place"] == pytest.approx(NOTCH, abs=1e-4)


class Twitch(fj.JointEffect):
    """A torque that follows the time."""

    name, title, equation = "test_twitch", "a twitch", "size sin t"
    size: float = fj.amplitude("N m")

    def torque(self, motion: fj.Motion) -> Any:
        return self.size * jnp.sin(motion.time)


def test_a_registered_effect_that_no_step_can_simulate_is_told(tmp_path: Path):
    """It stays out of the search, and the answer's notes say why."""
    (tmp_path / "servo.xml").write_text(SERVO)
    loop, _ = fj.load_loop(tmp_path / "servo.xml")
    fj.register(Twitch)
    assert not any(e.name == Twitch.name for e in everywhere(loop.robot, ()))
    (note,) = left_out(loop.robot)
    assert left_out(loop.robot, (Twitch.name,)) == ()
    assert note.startswith("'test_twitch' is registered, but not looked for in rollouts: its torque follows the time")


def test_what_a_step_does_not_know_is_refused(tmp_path: Path):
    (tmp_path / "servo.xml").write_text(SERVO)
    loop, _ = fj.load_loop(tmp_path / "servo.xml")
    for name, what in (("friction_drift", "time"), ("rotor_inertia", "acceleration")):
        with pytest.raises(fj.InputError, match=f"'{name}': its torque follows the {what}"):
            loop.with_effects(fj.place(fj.CATALOGUE[name], loop.robot, ["lift"]))


def test_what_a_rollout_has_no_number_for_is_refused_in_a_baseline(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "servo.xml").write_text(SERVO)
    q = simulated_by_mujoco(command(600), 0.0, 0.0)
    task = recorded(tmp_path, q, "{effect: joint_elasticity, at: [lift]}")
    assert main(["identify", str(task), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    assert "a rollout has no number for 'joint_elasticity' at 'lift'" in capsys.readouterr().err


@pytest.mark.slow
def test_a_baseline_names_what_a_rollout_can_fit(tmp_path: Path):
    """An effect of the catalogue acts by its torque where the loop has no number for it."""
    (tmp_path / "servo.xml").write_text(SERVO)
    q = simulated_by_mujoco(command(1500), 0.0, 0.0)
    told = identified(tmp_path, q, "{effect: asymmetric_coulomb_friction, at: [lift]}")
    assert "asymmetric_coulomb_friction.difference lift" in told


def test_a_base_that_is_not_level_is_identified(tmp_path: Path):
    """Gravity along x by the base that leans, of a servo in MuJoCo C."""
    (tmp_path / "servo.xml").write_text(SERVO)
    model = mujoco.MjModel.from_xml_string(SERVO)
    model.opt.gravity[:] = [0.6, 0.0, -np.sqrt(9.81**2 - 0.6**2)]
    data, u = mujoco.MjData(model), command(3000)
    q = np.zeros(len(u))
    for k, row in enumerate(u):
        q[k], data.ctrl[0] = data.qpos[0], row
        mujoco.mj_step(model, data)
    told = identified(tmp_path, q, "{effect: gravity_tilt}")
    x, y = told["gravity_x"], told["gravity_y"]
    assert x["status"] == "identified" and abs(x["value"] - 0.6) < 3 * x["std"] < 0.05 and x["unit"] == "m/s2"
    assert y["status"] == "unidentifiable"  # along the axis of the joint


@pytest.mark.slow
def test_the_example_names_its_effect():
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    example = ROOT / "examples" / "own_rollout_effect.py"
    run = subprocess.run(
        [sys.executable, str(example)], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    (line,) = run.stdout.splitlines()
    assert line.startswith("named: servo_detent (lift) {'strength': (1.50") and "'notch': (0.15" in line
