"""A friction that all joints of an arm share, too small at each of them to be told beside a rest, made by MuJoCo C."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from generators import servo_arm6

from figaroh_jax.rollouts.arm import as_sure_together, search_arm
from figaroh_jax.rollouts.data import Run, Stretch
from figaroh_jax.rollouts.found import Named, all_but
from figaroh_jax.rollouts.gates import standing
from figaroh_jax.rollouts.parameters import of_one_number, put, values
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.setting import Setting, Structure, begun, setting
from figaroh_jax.rollouts.shared import as_one_number, of_one_kind
from figaroh_jax.rollouts.thresholds import T_BESIDE_REST

SPEED = 0.1  # rad/s


def record(number: int, more: float, differ: float, alike: float = 0.0) -> Run:
    """8 s of the arm, whose friction and damping differ by recording and whose friction at rest is larger: by a share
    of it, and by so many N m at every joint."""
    rng = np.random.default_rng([1, number, 31])
    friction, damping = (
        np.array(x) * (1 + differ * rng.standard_normal(6)) for x in (servo_arm6.FRICTION, servo_arm6.DAMPING)
    )
    model = mujoco.MjModel.from_xml_string(servo_arm6.model_text())
    data, every = mujoco.MjData(model), servo_arm6.EVERY
    u = np.repeat(servo_arm6.command(1, number)[::every], every, 0)[:4000]
    q, data.qpos[:], model.dof_damping[:] = np.zeros_like(u), u[0], damping
    for k, one in enumerate(u):
        model.dof_frictionloss[:] = friction + (more * friction + alike) * np.exp(-((data.qvel / SPEED) ** 2))
        q[k], data.ctrl[:] = data.qpos, one
        mujoco.mj_step(model, data)
    q = q[::every] + rng.normal(0, servo_arm6.NOISE, (len(u) // every, 6))
    return Run(f"run {number}", np.arange(len(q)) * servo_arm6.DT * every, u[::every], q, None)


def arm_of(path: Path, runs: list[Run]) -> Setting:
    path.write_text(servo_arm6.model_text(1.2))
    cut = [Stretch(k, first, 400) for k in range(len(runs)) for first in (0, 400)]
    return setting(load_loop(path)[0], runs, stretches=cut)


def names_and_sizes(path: Path, more: float, differ: float) -> tuple[str, dict[tuple[str, str], np.ndarray]]:
    found = search_arm(arm_of(path, [record(number, more, differ) for number in range(6)]))
    told = found.named or found.proxy
    return found.verdict, {
        (n.candidate.effect, n.candidate.at[0]): found.last.theta[list(n.candidate.entries)] for n in told
    }


@pytest.mark.slow
def test_friction_that_falls_with_speed_at_all_joints_is_told_beside_a_rest(tmp_path: Path):
    """30 % more friction at rest where friction and damping differ by 5 % between six recordings."""
    verdict, found = names_and_sizes(tmp_path / "arm.xml", 0.3, 0.05)
    assert verdict == "named+rest"
    assert set(found) == {("stribeck_friction", name) for name in servo_arm6.NAMES}
    for (_, name), (force, speed) in found.items():
        truth = 0.3 * servo_arm6.FRICTION[servo_arm6.NAMES.index(name)]
        assert force == pytest.approx(truth, rel=0.25)
        assert speed == pytest.approx(SPEED, rel=0.15)


@pytest.mark.slow
def test_friction_that_differs_by_recording_has_no_name(tmp_path: Path):
    assert names_and_sizes(tmp_path / "arm.xml", 0.0, 0.1) == ("unknown", {})


@pytest.mark.slow
def test_joints_of_one_kind_of_servo_have_one_number_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """.06 N m more at rest at every joint, whose friction and damping differ by 4 % between recordings."""
    monkeypatch.setattr(servo_arm6, "KP", (40.0,) * 6)
    monkeypatch.setattr(servo_arm6, "KV", (0.5,) * 6)
    here = arm_of(tmp_path / "arm.xml", [record(number, 0.0, 0.04, 0.06) for number in range(6)])
    now = standing(here, Structure(here.loop, here.known.table, here.data), begun(here), here.baseline)
    (ones,) = of_one_kind(here, [c for c in here.known.candidates if c.effect == "stribeck_friction"])
    assert [c.at for c in ones] == [(name,) for name in servo_arm6.NAMES]
    named, new = as_one_number(here, now, ones)
    assert {n.candidate.at[0] for n in named} >= {"flex", "roll", "jaw"}
    (t,) = {n.t for n in named}  # as sure as they are together
    assert t > T_BESIDE_REST
    (entries,) = {n.candidate.entries for n in named}
    force, speed = new.model.fit.theta[list(entries)]
    assert force == pytest.approx(0.06, rel=0.1)
    assert speed == pytest.approx(SPEED, rel=0.1)
    loop = put(new.model.structure.loop, new.model.structure.table, new.model.fit.theta)
    at = [servo_arm6.NAMES.index(n.candidate.at[0]) for n in named]
    np.testing.assert_array_equal(np.asarray(loop.joints.stribeck_force)[at], force)
    assert all_but(named, named[0].candidate) == []  # with one of them go all that have its numbers


def test_joints_of_other_drives_have_numbers_of_their_own(tmp_path: Path):
    """Pan and lift of the made arm have one kind of drive, which are too few to tell anything together."""
    here = arm_of(tmp_path / "arm.xml", [record(0, 0.0, 0.0)])
    ones = [c for c in here.known.candidates if c.effect == "stribeck_friction"]
    assert of_one_kind(here, ones) == []
    table = of_one_number(here.known.table, [c.entries for c in ones[:2]])
    theta = values(here.loop, table)
    assert np.isnan(theta[list(ones[1].entries)]).all()
    theta[list(ones[0].entries)] = 0.2, 0.3
    np.testing.assert_array_equal(
        np.asarray(put(here.loop, table, theta).joints.stribeck_force), [0.2, 0.2, 0, 0, 0, 0]
    )


def test_what_three_joints_show_in_one_round_is_as_sure_as_they_are_together(tmp_path: Path):
    """Each takes half of the squares of its joint, in all of four recordings; two joints are judged by themselves."""
    here = arm_of(tmp_path / "arm.xml", [record(number, 0.0, 0.0) for number in range(4)])
    ones = [c for c in here.known.candidates if c.effect == "stribeck_friction"]
    shape = (len(here.folds), len(here.stretches), 6)
    before = np.random.default_rng().uniform(0.9, 1.1, shape)
    now, new = (SimpleNamespace(held=x) for x in (before, 0.5 * before**2))
    named = [Named(c, 1.7, 0.5, ()) for c in ones]
    told = as_sure_together(here, now, new, named[:3])  # pyright: ignore[reportArgumentType]
    (t,) = {n.t for n in told}
    assert t > T_BESIDE_REST
    assert as_sure_together(here, now, new, named[:2]) == named[:2]  # pyright: ignore[reportArgumentType]
    other = next(c for c in here.known.candidates if c.effect == "load_dependent_friction")
    mixed = [*named[:3], Named(other, 1.7, 0.5, ())]
    assert as_sure_together(here, now, new, mixed) == mixed  # pyright: ignore[reportArgumentType]
