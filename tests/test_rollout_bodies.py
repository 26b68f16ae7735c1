"""Links that a robot's file has wrong, asked where a rest is left; robots made by MuJoCo C."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from generators import servo_arm6
from schema import matches

import figaroh_jax as fj
from figaroh_jax.cli import main
from figaroh_jax.estimation.consistency import inconsistencies
from figaroh_jax.rollouts.arm import search_arm
from figaroh_jax.rollouts.bodies import Link, body_notes, nearest_bodies, searched_with_bodies, with_bodies
from figaroh_jax.rollouts.causes import elastic_loop, elastic_table
from figaroh_jax.rollouts.data import Run, Stretch
from figaroh_jax.rollouts.fit import fit
from figaroh_jax.rollouts.found import Model, Search
from figaroh_jax.rollouts.loop import brought_back
from figaroh_jax.rollouts.parameters import Entry, put, values
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.setting import Setting, Structure, setting
from figaroh_jax.rollouts.task import simulated

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).parents[2] / "shared" / "data"))
DT, EVERY, SECONDS, NOISE = 0.001, 5, 6.0, 5e-4
MASS, COM, INERTIA = (0.5, 0.6), (0.2, 0.25), (0.004, 0.006)  # kg, m below the joint, kg m2 about the centre of mass


def pendulum(inertia=INERTIA, com=COM, friction: float = 0.05) -> str:
    """Two links in a plane that torques swing."""
    first, second = (
        f'<inertial pos="0 0 {-com[k]}" mass="{MASS[k]}" diaginertia="{inertia[k]} {inertia[k]} 0.002"/>'
        for k in (0, 1)
    )
    held = f'solreffriction="{2 * DT} 1" solimpfriction="0.9999 0.9999"'
    joint = f'axis="1 0 0" damping="0.01" frictionloss="{friction}" {held}'
    return f"""<mujoco><option timestep="{DT}" integrator="implicitfast"><flag contact="disable"/></option><worldbody>
    <body name="upper"><joint name="shoulder" {joint}/>{first}
    <body name="lower" pos="0 0 -0.3"><joint name="elbow" {joint}/>{second}</body></body></worldbody>
    <actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator></mujoco>"""


def swung(text: str, number: int, seed: int = 3, detent: float = 0.0) -> Run:
    """Torques of a few sines; `detent` N m of a torque of the angle that is no effect of the library's."""
    model, rng = mujoco.MjModel.from_xml_string(text), np.random.default_rng([seed, number])
    data, t = mujoco.MjData(model), np.arange(round(SECONDS / DT)) * DT
    size, rate, late = (rng.uniform(low, high, (3, 2)) for low, high in ((0.2, 0.7), (0.3, 1.6), (0, 6)))
    u = (size * np.array([1.0, 0.4]) * np.sin(2 * np.pi * rate * t[:, None, None] + late)).sum(1)
    u = np.repeat(u[::EVERY], EVERY, 0)
    q = np.zeros_like(u)
    for k, one in enumerate(u):
        q[k], data.ctrl[:] = data.qpos, one
        data.qfrc_applied[:] = detent * np.sign(np.sin(20 * data.qpos))
        mujoco.mj_step(model, data)
    q = q[::EVERY] + rng.normal(0, NOISE, (len(q) // EVERY, 2))
    return Run(f"run {number}", np.arange(len(q)) * DT * EVERY, u[::EVERY], q, None)


def diagnosed(folder: Path, runs: list[Run], filed: str) -> tuple[Setting, Search]:
    (folder / "robot.xml").write_text(filed)
    cut = [Stretch(k, first, 100) for k in range(len(runs)) for first in range(0, len(runs[0].time) - 99, 100)]
    here = setting(load_loop(folder / "robot.xml")[0], runs, stretches=cut)
    return here, searched_with_bodies(search_arm, here, search_arm(here))


def sizes(found: Search) -> dict[tuple[str, ...], dict[str, float]]:
    return {
        (n.candidate.effect, *n.candidate.at): dict(
            zip(n.candidate.reported, found.last.theta[list(n.candidate.entries)], strict=True)
        )
        for n in found.named
    }


def about_joint(k: int) -> float:
    """What moving a link's inertia from its centre of mass to its joint adds."""
    return MASS[k] * COM[k] ** 2


@pytest.mark.slow
def test_an_inertia_that_a_file_states_about_the_joint_is_found_and_told(tmp_path: Path):
    twice = tuple(INERTIA[k] + about_joint(k) for k in (0, 1))
    runs = [swung(pendulum(), k) for k in range(4)]
    here, found = diagnosed(tmp_path, runs, pendulum(twice))
    assert found.verdict == "named"
    told = sizes(found)
    assert set(told) == {("link_inertia", "upper"), ("link_inertia", "lower")}
    for k, link in enumerate(("upper", "lower")):
        np.testing.assert_allclose(told["link_inertia", link]["ixx"], -about_joint(k), atol=0.02 * about_joint(k))
    notes = body_notes(found.setting or here, found)
    assert len(notes) == 2
    assert all("about the joint" in text for text in notes.values())
    ten = np.asarray(put(found.structure.loop, found.structure.table, found.last.theta).robot.inertia)
    assert not inconsistencies(ten, ["upper", "lower"])
    (tmp_path / "right").mkdir()
    _, clean = diagnosed(tmp_path / "right", runs, pendulum())
    assert clean.verdict == "nothing"


@pytest.mark.slow
def test_a_link_that_is_drawn_is_found_and_a_detent_is_none(tmp_path: Path):
    """Of the upper link a payload and a rotor tell as much: it turns about nothing that moves."""
    rng = np.random.default_rng()
    seed, share = int(rng.integers(1 << 30)), float(rng.choice([0.7, 1.35]))
    told = f"seed {seed}, lower at {share:.3g} of its distance"
    _, found = diagnosed(
        tmp_path, [swung(pendulum(), k, seed) for k in range(4)], pendulum(com=(COM[0], share * COM[1]))
    )
    assert found.verdict == "named", told
    assert set(sizes(found)) == {("link_inertia", "lower")}, told
    size = sizes(found)["link_inertia", "lower"]["mz"]
    assert abs(size + MASS[1] * COM[1] * (1 - share)) < 0.05 * MASS[1] * COM[1], told
    (tmp_path / "detent").mkdir()
    _, other = diagnosed(tmp_path / "detent", [swung(pendulum(), k, seed, 0.15) for k in range(4)], pendulum())
    assert "link_inertia" not in {n.candidate.effect for n in other.named}, told


@pytest.mark.slow
def test_a_link_of_an_arm_whose_centre_of_mass_lies_elsewhere_is_told(tmp_path: Path):
    """By its name, its place and the moment that it has more (m times the shift), in a seed that is drawn."""
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text(1.6))
    seed, runs = int(np.random.default_rng().integers(1, 10**6)), []
    for number in range(4):
        r = servo_arm6.record([("link_inertia", 3, 0.03)], seed, number)
        runs.append(Run(f"run {number}", r["t"], r["u"], r["q"], None))
    cut = [Stretch(k, first, 600) for k in range(4) for first in (0, 600)]
    here = setting(load_loop(tmp_path / "arm.xml")[0], runs, stretches=cut)
    found = searched_with_bodies(search_arm, here, search_arm(here))
    link = here.loop.robot.joints[3].link
    assert (found.verdict, list(sizes(found))) == ("named", [("link_inertia", link)]), seed
    moment = 0.03 * servo_arm6.MASS[3]
    assert abs(sizes(found)["link_inertia", link]["mx"] - moment) < 0.02 * moment, seed


@pytest.mark.parametrize("joint", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_numbers_of_links_stay_with_them_beside_a_spring(tmp_path: Path, joint: int):
    """MuJoCo's arm with a hinge that is all but stiff is the arm without: so is ours, whatever its links carry."""
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text())
    loop, _ = load_loop(tmp_path / "arm.xml")
    table, sizes = (Entry("payload", (3,)), Entry("mass_x", (1,))), np.array([0.2, 0.05])
    u = servo_arm6.command(3, 0)[:600]
    rigid, bare = (np.asarray(fj.rollout(x, u, u[0]).reading) for x in (put(loop, table, sizes), loop))
    soft, more = elastic_loop(loop, joint, 3e4, 10.0), elastic_table(loop, table, joint)
    new = put(soft, more, np.append(sizes, [3e4, 10.0, 0.0]))
    read = np.asarray(fj.rollout(new, u, np.append(u[0], 0.0)).reading)[:, :6]
    assert np.abs(read - rigid).max() < 0.05 * np.abs(rigid - bare).max()


@pytest.mark.parametrize("told", [("mass_z", "inertia_xx"), ("mass", "mass_z", "inertia_xx")])
def test_a_link_that_no_body_can_have_becomes_one(tmp_path: Path, told: tuple[str, ...]):
    """What the recordings tell stays where a body can have it; where its mass is told as well, no body can."""
    (tmp_path / "robot.xml").write_text(pendulum())
    runs = [swung(pendulum(), k) for k in range(3)]
    here = with_bodies(setting(load_loop(tmp_path / "robot.xml")[0], runs), (0, 1))
    entries = [k for k, e in enumerate(here.known.table) if e.name in told and e.at == (1,)]
    inertia = next(k for k in entries if here.known.table[k].name == "inertia_xx")
    free = [*here.baseline, *entries]
    structure, theta = Structure(here.loop, here.known.table, here.data), values(here.loop, here.known.table)
    theta[inertia] = -0.008  # .0355 kg m2 about the joint, where a point mass has .0375
    one = fit(*structure, theta[None], [free], width=len(free), lanes=1, iterations=0)[0]
    links = ["upper", "lower"]
    assert inconsistencies(np.asarray(put(*structure[:2], theta).robot.inertia), links)
    near = nearest_bodies(here, Model(structure, one, tuple(free), 0.0), [Link(1, tuple(entries), 0.0)])
    assert near is not None
    assert not inconsistencies(np.asarray(put(*structure[:2], near.fit.theta).robot.inertia), links)
    assert (near.fit.theta[inertia] == theta[inertia]) == ("mass" not in told)


def test_identify_tells_the_links_that_a_task_names(tmp_path: Path):
    """The numbers cover the truth, and the links are those of bodies."""
    wrong = (INERTIA[0], INERTIA[1] + 0.02), (COM[0], 0.9 * COM[1])
    (tmp_path / "robot.xml").write_text(pendulum(*wrong))
    data = []
    for k in range(4):
        run = swung(pendulum(), k)
        np.savez(tmp_path / f"{k}.npz", t=run.time, u=run.command, q=run.position)
        role = "holdout" if k == 3 else "fit"
        data.append({"file": f"{k}.npz", "time": "t", "command": "u", "position": "q", "role": role})
    task = {
        "robot": {"model": "robot.xml"}, "data": data, "rollout": {"window": 0.5},
        "baseline": {"effects": [{"effect": "link_inertia", "at": ["lower"]}]},
    }  # fmt: skip
    (tmp_path / "task.yaml").write_text(json.dumps(task))
    assert main(["identify", str(tmp_path / "task.yaml"), "--out", str(tmp_path / "out"), "--quiet"]) == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    matches("identify", result)
    told = {p["expression"]: p for p in result["base_parameters"]}
    moment, inertia = MASS[1] * 0.1 * COM[1], INERTIA[1] - wrong[0][1] + MASS[1] * COM[1] ** 2 * (1 - 0.81)
    for name, truth in (("mz lower", -moment), ("ixx lower", inertia)):
        assert abs(told[name]["value"] - truth) < 4 * told[name]["std"] + 1e-5, name
    (link,) = result["links"]
    assert link["name"] == "lower"
    assert link["consistent"]
    np.testing.assert_allclose(result["fit"]["rms"], NOISE, atol=0.1 * NOISE)


def _told_of_the_double_pendulum(folder: Path, count: int, held: tuple[int, ...]) -> dict[str, Any]:
    """The answer by the first recordings, some of them `held` out."""
    own = DATA / "dfki_double_pendulum"
    data = [
        {"file": str(f), "time": "t", "command": "tau", "position": "q", "role": "holdout" if k in held else "fit"}
        for k, f in enumerate(sorted(own.glob("C1_*.npz"))[:count])
    ]
    task = {
        "robot": {"model": str(own / "double_pendulum_C1.urdf")}, "data": data, "rollout": {"window": 0.3},
        "actuator": {"Joint1": {"kind": "torque"}, "Joint2": {"kind": "torque"}},
    }  # fmt: skip
    (folder / "task.yaml").write_text(json.dumps(task))
    main(["diagnose", str(folder / "task.yaml"), "--out", str(folder / "out"), "--quiet"])
    return json.loads((folder / "out" / "answer.json").read_text())


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "dfki_double_pendulum").is_dir(), reason="FIGAROH_JAX_DATA is not there")
def test_the_real_double_pendulum_has_its_inertia_about_its_joints(tmp_path: Path):
    """The set's own identified parameters (I1, I2 about the joints) stand in its URDF as about the centres of mass."""
    answer = _told_of_the_double_pendulum(tmp_path, 6, held=(5,))
    assert answer["verdict"] == "named+rest"
    told = {tuple(c["at"]): c for c in answer["causes"] if c["effect"] == "link_inertia"}
    assert set(told) == {("Link1",), ("Link2",)}
    for link, extra in (("Link1", 0.52346 * 0.2**2), ("Link2", 0.62557 * 0.25569**2)):
        assert abs(told[link,]["parameters"]["ixx"]["value"] + extra) < 0.1 * extra
    assert sum("about the joint" in note for note in answer["notes"]) == 2
    assert answer["holdout"]["after"] < 0.5 * answer["holdout"]["before"]
    assert sum("judged in windows of 0.3 s" in note for note in answer["notes"]) == 1


@pytest.mark.skipif(not (DATA / "dfki_double_pendulum").is_dir(), reason="FIGAROH_JAX_DATA is not there")
@pytest.mark.parametrize(("count", "held"), [(4, (3,)), pytest.param(6, (2, 5), marks=pytest.mark.slow)])
def test_links_that_too_few_recordings_bear_out_are_what_came_nearest(
    tmp_path: Path, count: int, held: tuple[int, ...]
):
    answer = _told_of_the_double_pendulum(tmp_path, count, held)
    nearest = {tuple(one["at"]): one for one in answer["rest"]["nearest"] if one["effect"] == "link_inertia"}
    assert answer["verdict"] == "unknown" and set(nearest) == {("Link1",), ("Link2",)}
    assert {one["why_not"] for one in nearest.values()} == {"not as good in all recordings"}
    assert sum("judged in windows of 0.3 s" in note for note in answer["notes"]) == 1


def test_windows_of_a_robot_that_nothing_brings_back_begin_where_it_was_measured(tmp_path: Path):
    (tmp_path / "robot.xml").write_text(pendulum(friction=0.02))
    loop, run = load_loop(tmp_path / "robot.xml")[0], swung(pendulum(), 0)
    assert not brought_back(loop).any()
    whole, cut = simulated(loop, run), simulated(loop, run, 70)
    assert len(cut) == len(run.time)
    np.testing.assert_array_equal(cut[:70], whole[:70])
    moved = [np.sqrt(np.mean((x - run.position)[600:] ** 2)) for x in (cut, whole)]
    assert moved[0] < 0.2 * moved[1]
