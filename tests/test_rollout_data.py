"""Rollouts as data of the one residual and the one fit: against MuJoCo C, differences, and a hidden truth."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from generators import servo_arm6

import figaroh_jax as fj

RATE, STEPS, TRUTH = 100, 150, {"damping": 0.31, "armature": 0.012}
MJCF = """
<mujoco><option timestep="0.005" integrator="implicitfast"/>
  <worldbody><body name="arm"><joint name="j" axis="0 1 0" damping="{damping}" armature="{armature}"/>
    <inertial pos="0 0 -0.2" mass="0.8" diaginertia="0.01 0.01 0.002"/></body></worldbody>
  <actuator><position name="drive" joint="j" kp="6.0"/></actuator></mujoco>
"""


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> tuple[fj.ExtendedModel, fj.RolloutData]:
    """What MuJoCo C did with a truth, and a model that has half the damping and twice the rotor."""
    folder = tmp_path_factory.mktemp("rollout")
    theirs = mujoco.MjModel.from_xml_string(MJCF.format(**TRUTH))  # pyright: ignore[reportAttributeAccessIssue]
    state, seen = mujoco.MjData(theirs), np.zeros((STEPS, 1))  # pyright: ignore[reportAttributeAccessIssue]
    command = np.sign(np.sin(0.07 * np.arange(STEPS)))[:, None] * 0.6
    state.qpos[:] = 0.2
    for k in range(STEPS):
        seen[k], state.ctrl[:] = state.qpos, command[k]
        mujoco.mj_step(theirs, state, 2)  # pyright: ignore[reportAttributeAccessIssue]
    file = Path(folder) / "arm.xml"
    file.write_text(MJCF.format(damping=0.15, armature=0.024))
    loop, _ = fj.load_loop(file)
    noisy = seen + 1e-4 * np.random.default_rng(0).normal(size=seen.shape)
    data = fj.rollout_data(loop, fj.recording(q=noisy, command=command, rate=RATE), noise=1e-4)
    return data.model, data


def with_sizes(model: fj.ExtendedModel, damping: float, inertia: float) -> fj.ExtendedModel:
    where = lambda m: [next(e for e in m.effects if e.name == "viscous_friction").damping,  # noqa: E731
                       next(e for e in m.effects if e.name == "rotor_inertia").inertia]  # fmt: skip
    return eqx.tree_at(where, model, [jnp.asarray(damping), jnp.asarray(inertia)])


@pytest.mark.slow  # nearly a minute of compilation
def test_a_fit_finds_what_mujoco_hid_and_its_derivative_is_that_of_differences(case):
    model, data = case
    found = fj.fit(model, data, {"effects": ["damping", "inertia"], "start": True})
    assert not found.reason
    for name, truth in (("viscous_friction j damping", 0.31), ("rotor_inertia j inertia", 0.012)):
        assert abs(found.parameters[name].value - truth) < 4 * found.parameters[name].std < 0.01
    rows = np.asarray(found.rows)
    assert np.sqrt(np.mean(rows[:STEPS] ** 2)) == pytest.approx(1.0, abs=0.15)

    @jax.jit
    def both(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        cost = lambda y: (fj.residual(with_sizes(model, y[0], y[1]), data) ** 2).mean()  # noqa: E731
        h = jnp.array([1e-5, 1e-7])
        ends = [[cost(x + s * h * jnp.eye(2)[k]) for s in (1.0, -1.0)] for k in range(2)]
        return jax.grad(cost)(x), jnp.array([(a - b) / (2 * h[k]) for k, (a, b) in enumerate(ends)])

    with jax.enable_x64(True):
        slope, difference = both(jnp.array([0.2, 0.02]))
    np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=0)


def test_what_a_rollout_has_no_form_for_is_refused(case):
    model, data = case
    odd = fj.extend(model, fj.place(fj.CATALOGUE["friction_drift"], model.robot, ["j"]))
    with pytest.raises(fj.InputError, match="no form for 'friction_drift': its torque follows the time"):
        fj.residual(odd, data)
    with pytest.raises(fj.InputError, match="no number 'delays'; did you mean 'delay'"):
        fj.rollout_data(data.loop, [], drives=["delays"])


def test_one_joint_of_an_arm_is_fitted_by_itself_whatever_the_others_are(tmp_path: Path):
    """Rotors and frictions of the model are 1.6 times MuJoCo's; the lift's are found while the others stay wrong."""
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text(scale=1.6))
    loop, _ = fj.load_loop(tmp_path / "arm.xml")
    seen = servo_arm6.record([], 4, 0)
    run = fj.recording(time=seen["t"][:600], q=seen["q"][:600], command=seen["u"][:600])
    data = fj.rollout_data(loop, run, noise=servo_arm6.NOISE, joint="lift")
    assert data.model.robot.dof_names == ("lift",)
    found = fj.fit(data.model, data, ["effects", "start"]).parameters
    assert found["viscous_friction lift damping"].value == pytest.approx(servo_arm6.DAMPING[1], rel=0.03)
    assert found["coulomb_friction lift force"].value == pytest.approx(servo_arm6.FRICTION[1], rel=0.03)
    assert found["rotor_inertia lift inertia"].value == pytest.approx(servo_arm6.ARMATURE[1], rel=0.06)
    with pytest.raises(fj.InputError, match="did you mean 'lift'"):
        fj.rollout_data(loop, run, joint="lfit")


def test_a_recording_of_another_clock_unit_or_number_of_joints_is_told_what_fits(tmp_path: Path):
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text())
    loop, _ = fj.load_loop(tmp_path / "arm.xml")
    seen = servo_arm6.record([], 4, 0)
    t, q, u = seen["t"][:100], seen["q"][:100], seen["u"][:100]
    with pytest.raises(fj.InputError, match=r"dataclasses.replace\(loop, dt=") as told:
        fj.rollout_data(loop, fj.recording(time=1.003 * t, q=q, command=u))
    step = float(re.search(r"dt=([0-9.e-]+)", str(told.value)).group(1))  # pyright: ignore[reportOptionalMemberAccess]
    fj.rollout_data(replace(loop, dt=step), fj.recording(time=1.003 * t, q=q, command=u))
    with pytest.raises(fj.InputError, match="q has 2 columns"):
        fj.rollout_data(loop, fj.recording(time=t, q=q[:, :2], command=u[:, :2]))
    with pytest.raises(fj.InputError, match="cannot be right"):
        fj.rollout_data(loop, fj.recording(time=t, q=np.rad2deg(q) + 400, command=u))
