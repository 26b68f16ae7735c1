"""Ripple, a base that is not level and motors of two joints in rollouts: as MuJoCo C moves them, found, exported."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import mujoco as engine
import numpy as np
import pytest
from generators import servo_arm6

import figaroh_jax as fj
from figaroh_jax.formats.export import write_model
from figaroh_jax.rollouts import sensitivity
from figaroh_jax.rollouts.arm import search_arm
from figaroh_jax.rollouts.data import Run, Stretch, windows
from figaroh_jax.rollouts.fit import contradicted_errors, fit, standard_errors
from figaroh_jax.rollouts.loop import Pairs
from figaroh_jax.rollouts.native import native
from figaroh_jax.rollouts.parameters import Entry, put, values
from figaroh_jax.rollouts.search import search
from figaroh_jax.rollouts.sensitivity import linear_sums
from figaroh_jax.rollouts.setting import setting
from figaroh_jax.rollouts.stored import add_loop
from figaroh_jax.rollouts.task import extended_of

mujoco: Any = engine


def both(sign: int) -> Pairs:
    """The motor of the tendon."""
    return Pairs(np.array([0.012]), np.array([0.1]), np.array([0.15]), ((0, 1, sign),))


def moved(text: str, u: np.ndarray) -> np.ndarray:
    model = mujoco.MjModel.from_xml_string(text)
    data, q = mujoco.MjData(model), np.zeros_like(u)
    data.qpos[:] = u[0]
    for k, row in enumerate(u):
        q[k], data.ctrl[:] = data.qpos, row
        mujoco.mj_step(model, data)
    return q


PAIR = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body pos="0 0 1">
<joint name="one" axis="0 1 0" damping="{damping[0]}" armature="{armature[0]}" frictionloss="0.2"/>
<inertial pos=".02 0 .15" mass="1" diaginertia=".01 .01 .002"/><body pos="0 0 0.3">
<joint name="two" axis="0 1 0" damping="{damping[1]}" armature="{armature[1]}" frictionloss="0.1"/>
<inertial pos="0 .01 .1" mass=".6" diaginertia=".004 .004 .001"/></body></body></worldbody>{tendon}
<actuator><position joint="one" kp="50" kv="1.5"/><position joint="two" kp="30" kv="0.7"/></actuator></mujoco>"""
TENDON = """<tendon><fixed armature="0.012" damping="0.1" frictionloss="0.15"><joint joint="one" coef="1"/>
<joint joint="two" coef="{sign}"/></fixed></tendon>"""


@pytest.mark.parametrize("sign", [1, pytest.param(-1, marks=pytest.mark.slow)])
def test_a_motor_of_two_joints_moves_them_as_a_tendon_of_mujoco(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sign: int
):
    """Inertia, damping and dry friction, 800 steps by machine code and by JAX; derivatives by finite differences."""
    own = {"damping": (0.3, 0.2), "armature": (0.03, 0.02)}
    tendon = TENDON.format(sign=sign)
    whole = {name: [x + more for x in own[name]] for name, more in (("damping", 0.1), ("armature", 0.012))}
    (tmp_path / "arm.xml").write_text(PAIR.format(tendon="", **whole))
    loop, _ = fj.load_loop(tmp_path / "arm.xml")
    loop = dataclasses.replace(loop, pairs=both(sign))
    t = 0.002 * np.arange(800)[:, None]
    u = np.array([0.4, -0.3]) + 0.3 * np.sin(t * [5.0, 7.3] + [1.0, 2.0])
    q = moved(PAIR.format(tendon=tendon, **own), u)
    run = Run("run", t[:, 0], u, q, None)
    data = windows(loop, [run], [Stretch(0, 0, 800)], [np.full(2, 1e-4)], 0.2)
    names = ("pair_inertia", "pair_damping", "pair_friction", "armature", "payload")
    table = tuple(Entry(name, (0,)) for name in names)
    theta, start = values(loop, table), np.concatenate([u[0], [0.0, 0.0]])[:, None]
    code = native(loop, table, data)
    assert code.usable
    np.testing.assert_allclose(code.read(theta, start)[:, :, 0], q, rtol=0, atol=1e-12)
    theta, start = theta * [0.9, 1.1, 0.8, 1.1, 1.0] + [0, 0, 0, 0, 0.05], start + [[0.01], [-0.02], [0.7], [-0.5]]
    found = code.sums(theta, np.arange(5), start)

    def squares(k: int, size: float) -> float:
        left = data.reading - code.read(theta + size * np.eye(5)[k], start)
        return float(((left * data.weight) ** 2).sum())

    numeric = [(squares(k, 1e-6) - squares(k, -1e-6)) / 2e-6 for k in range(5)]
    np.testing.assert_allclose(-2 * found.gradient.sum((0, 1))[:5], numeric, rtol=1e-5)
    if sign > 0:
        return  # the programs of JAX take half a minute
    np.testing.assert_allclose(fj.rollout(loop, u, u[0]).position, q, rtol=0, atol=1e-12)
    monkeypatch.setattr(sensitivity, "native", lambda *_: SimpleNamespace(usable=False))
    with jax.enable_x64(True):
        plain = linear_sums(loop, table, theta[None], np.arange(5)[None], data, start[None])
    for one, other in zip(found, plain, strict=True):
        np.testing.assert_allclose(one, np.asarray(other)[0], rtol=1e-7, atol=1e-9 * np.abs(one).max())


def test_what_was_found_moves_mujoco_as_it_moves_us(tmp_path: Path):
    """A tendon and gravity in `robot.xml`, ripple by the callback."""
    (tmp_path / "arm.xml").write_text(PAIR.format(tendon="", damping=(0.4, 0.3), armature=(0.042, 0.032)))
    loop, _ = fj.load_loop(tmp_path / "arm.xml")
    loop = dataclasses.replace(loop, pairs=both(-1))
    table = tuple(Entry(name, (0,)) for name in ("ripple_sine", "ripple_cosine", "ripple_order", "gravity_x"))
    with jax.enable_x64(True):
        loop = put(loop, table, np.array([0.2, -0.1, 9.0, 0.7]))
    folder = tmp_path / "model"
    write_model(extended_of(loop), folder)
    add_loop(folder, loop)
    callback = Path(sensitivity.__file__).with_name("callback.py")
    spec = importlib.util.spec_from_file_location("callback", callback)
    assert spec is not None and spec.loader is not None
    theirs = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(theirs)
    model = mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
    t = 0.002 * np.arange(500)[:, None]
    u = np.array([0.4, -0.3]) + 0.3 * np.sin(t * [5.0, 7.3] + [1.0, 2.0])
    data, seen = mujoco.MjData(model), np.zeros_like(u)
    data.qpos[:] = u[0]
    rest = theirs.Rest(model, folder / "loop.json")
    for k, row in enumerate(u):
        seen[k] = rest.reading(data)
        rest.step(data, row)
    np.testing.assert_allclose(seen, fj.rollout(loop, u, u[0]).position, rtol=0, atol=1e-7)


def test_the_order_of_a_ripple_is_found(tmp_path: Path):
    """One servo in MuJoCo C, the grid's nearest point .3 away; with the ripple forbidden nothing else is named.

    Size, phase and noise are drawn at run time.
    """
    seed = int(np.random.default_rng().integers(1, 10**6))
    rng = np.random.default_rng(seed)
    size, phase = rng.uniform((0.13, 0.5), (0.2, 1.1))
    text = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body pos="0 0 1">
    <joint name="lift" axis="0 1 0" damping="0.4" armature="0.05" frictionloss="0.15"/>
    <inertial pos=".15 0 .02" mass="1" diaginertia=".01 .02 .02"/></body></worldbody>
    <actuator><position name="lift" joint="lift" kp="60" kv="2"/></actuator></mujoco>"""
    (tmp_path / "servo.xml").write_text(text)
    loop, _ = fj.load_loop(tmp_path / "servo.xml")
    model = mujoco.MjModel.from_xml_string(text)
    data, t = mujoco.MjData(model), 0.002 * np.arange(4000)
    u, q = 0.6 * np.sin(1.7 * t) + 0.25 * np.sin(4.1 * t + 1), np.zeros(4000)
    for k in range(4000):
        q[k], data.ctrl[0] = data.qpos[0], u[k]
        data.qfrc_applied[0] = -size * np.sin(13.7 * q[k] + phase)
        mujoco.mj_step(model, data)
    noisy = q + 2e-4 * rng.standard_normal(4000)
    runs = [Run("run", t, u[:, None], noisy[:, None], None)]
    here = setting(loop, runs)
    found = search(here)
    assert [n.candidate[:2] for n in found.named] == [("torque_ripple", ("lift",))], seed
    assert found.verdict == "named", seed
    errors = standard_errors(found.last, here.data)
    truth = {"sine": size * np.cos(phase), "cosine": size * np.sin(phase), "order": 13.7}
    for name, entry in zip(found.named[0].candidate.reported, found.named[0].candidate.entries, strict=True):
        error = errors[int(np.flatnonzero(found.last.free == entry)[0])]
        assert abs(found.last.theta[entry] - truth[name]) < 4 * error < 0.1 * abs(truth[name]), seed
    assert search(setting(loop, runs, forbid=("torque_ripple",)), forbid=("torque_ripple",)).verdict == "unknown", seed


@pytest.mark.parametrize("held", [1, 40])
def test_intervals_count_noise_that_stays_from_row_to_row(tmp_path: Path, held: int):
    """A servo in MuJoCo C read 24 times, with noise drawn anew in each row or held over 40, as by a coarse counter."""
    text = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body pos="0 0 1">
    <joint name="lift" axis="0 1 0" damping="0.4" armature="0.05" frictionloss="0.15"/>
    <inertial pos=".15 0 .02" mass="1" diaginertia=".01 .02 .02"/></body></worldbody>
    <actuator><position name="lift" joint="lift" kp="60" kv="2"/></actuator></mujoco>"""
    (tmp_path / "servo.xml").write_text(text)
    loop, _ = fj.load_loop(tmp_path / "servo.xml")
    model, rows, rng = mujoco.MjModel.from_xml_string(text), 6000, np.random.default_rng(7)
    data, t = mujoco.MjData(model), 0.002 * np.arange(rows)
    u, q = 0.6 * np.sin(1.7 * t) + 0.25 * np.sin(4.1 * t + 1), np.zeros(rows)
    for k in range(rows):
        q[k], data.ctrl[0] = data.qpos[0], u[k]
        mujoco.mj_step(model, data)
    table, truth, off = (Entry("damping", (0,)), Entry("friction", (0,))), np.array([0.4, 0.15]), []
    for _ in range(24):
        noisy = q + 3e-4 * np.repeat(rng.standard_normal(rows // held), held)
        run = Run("run", t, u[:, None], noisy[:, None], None)
        cut = windows(loop, [run], [Stretch(0, 0, rows)], [np.array([3e-4])], 0.3)
        (found,) = fit(loop, table, cut, truth[None], [[0, 1]], width=2, lanes=1)
        off.append([(found.theta - truth) / errors(found, cut) for errors in (standard_errors, contradicted_errors)])
    plain, told = np.sqrt(np.square(off).mean((0, 2)))
    assert 0.7 < told < 1.4
    assert told <= plain < 1.2 * told if held == 1 else plain > 3.0


@pytest.mark.slow
@pytest.mark.parametrize("effect", [name for name in servo_arm6.MORE if name != "link_inertia"])  # asked last
def test_it_is_found_in_an_arm_and_unknown_where_it_is_forbidden(tmp_path: Path, effect: str):
    """At its place, by its size, with nothing beside it; seeds that no rule was made on."""
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text(1.6))
    loop, _ = fj.load_loop(tmp_path / "arm.xml")
    recordings = [servo_arm6.record([(effect, 1, servo_arm6.MORE[effect][1])], 88, k) for k in range(2)]
    runs = [Run(f"run {k}", r["t"], r["u"], r["q"], None) for k, r in enumerate(recordings)]
    cut = [Stretch(k, f, 600) for k in range(2) for f in (0, 600)]
    here = setting(loop, runs, stretches=cut)
    found = search_arm(here)
    at = {"gravity_tilt": (), "coupled_transmission": ("lift", "elbow")}.get(effect, ("lift",))
    assert found.verdict == "named" and [n.candidate[:2] for n in found.named] == [(effect, at)]
    size = servo_arm6.MORE[effect][1]
    own = [servo_arm6.ARMATURE[1], servo_arm6.DAMPING[1], servo_arm6.FRICTION[1]]
    truth = {
        "torque_ripple": [size * np.cos(0.9), size * np.sin(0.9), 13.7],
        "gravity_tilt": [9.81 * np.sin(size / 2), -9.81 * np.sin(size)],
        "coupled_transmission": [size * x for x in own],
    }[effect]
    errors = standard_errors(found.last, here.data)
    for entry, value in zip(found.named[0].candidate.entries, truth, strict=True):
        error = errors[int(np.flatnonzero(found.last.free == entry)[0])]
        assert abs(found.last.theta[entry] - value) < 4 * error
    forbidden = search_arm(setting(loop, runs, stretches=cut, forbid=(effect,)), forbid=(effect,))
    assert forbidden.verdict == "unknown"
