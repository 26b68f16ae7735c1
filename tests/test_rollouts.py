"""The loop of command, drives and joints: against MuJoCo C, and its derivatives against finite differences."""

# ruff: noqa: E501 - robots stand here as lines of XML
from __future__ import annotations

import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.simulation import delayed, rollout

OPTION = (
    '<compiler angle="radian"/><option timestep="{dt}" integrator="{integrator}"><flag contact="disable"/></option>'
)


def chain(joints: int, integrator: str, more: str = "") -> str:
    """An arm of alternating axes with friction, armature and damping at every joint and a position servo each."""
    rng = np.random.default_rng(3)
    bodies, drives = "", ""
    for k in range(joints):
        size = 3.0 / (1 + k)
        axis, com = ("0 0 1", "0 1 0", "1 0 0")[k % 3], " ".join(f"{x:.4f}" for x in rng.uniform(-0.1, 0.1, 3))
        diagonal = f"{0.02 * size:.5f} {0.025 * size:.5f} {0.015 * size:.5f}"
        bodies += (
            f'<body name="l{k}" pos="0 {0.02 * (k % 2):.3f} 0.2"><joint name="j{k}" axis="{axis}" {more}'
            f' armature="{0.1 / (1 + k):.4f}" damping="{0.5 / (1 + k):.4f}" frictionloss="{1.0 / (1 + k):.4f}"/>'
            f'<inertial pos="{com}" mass="{size:.4f}" diaginertia="{diagonal}"/>'
        )
        drives += f'<position name="u{k}" joint="j{k}" kp="{400 / (1 + k):.2f}" kv="{20 / (1 + k):.2f}"/>'
    body = bodies + "</body>" * joints
    return f"<mujoco>{OPTION.format(dt=0.002, integrator=integrator)}<worldbody>{body}</worldbody><actuator>{drives}</actuator></mujoco>"


CART = f"""<mujoco>{OPTION.format(dt=0.002, integrator="{integrator}")}<worldbody><body>
<joint name="slide" type="slide" axis="1 0 0" range="-.4 .3" limited="true" damping=".3" frictionloss=".6"/>
<inertial pos="0 0 0" mass="2" diaginertia=".1 .1 .1"/>
<body><joint name="pole" axis="0 1 0" damping=".02" stiffness=".4" springref=".2" range="-2 2" limited="true" margin=".02"
 solreflimit="-3000 -40"/><inertial pos="0 0 .4" mass=".5" diaginertia=".02 .02 .001"/></body></body></worldbody>
<tendon><fixed name="both"><joint joint="slide" coef="1"/><joint joint="pole" coef="-.3"/></fixed></tendon>
<actuator><motor name="push" joint="slide" gear="12" ctrlrange="-2 2" ctrllimited="true"/>
<general name="lagged" tendon="both" dyntype="filter" dynprm=".05" gainprm="2" biastype="affine" biasprm=".1 -1 -.2" forcerange="-1 1" forcelimited="true"/>
<damper name="brake" joint="pole" kv=".3" ctrlrange="0 1"/><intvelocity name="turn" joint="pole" kp="3" actrange="-1 1"/>
<general name="exact" joint="pole" dyntype="filterexact" dynprm=".03" gainprm=".2" actearly="true"/></actuator></mujoco>"""

LEG = """<body name="{s}thigh" pos="0 {y} -.05"><joint name="{s}hip_x" axis="1 0 0" range="-.4 .4"/><joint name="{s}hip_z" axis="0 0 1" range="-1 .6"/>
<joint name="{s}hip_y" axis="0 1 0" range="-1.9 .35" stiffness="8"/><inertial pos="0 .005 -.17" mass="4" diaginertia=".05 .05 .008"/>
<body name="{s}shin" pos="0 .01 -.34"><joint name="{s}knee" axis="0 -1 0" range="-2.8 -.03"/><inertial pos="0 0 -.15" mass="2.5" diaginertia=".03 .03 .003"/>
<body name="{s}foot" pos="0 0 -.39"><joint name="{s}ankle_y" axis="0 1 0" range="-.9 .9" stiffness="4"/><joint name="{s}ankle_x" axis="1 0 .5" range="-.9 .9"/>
<inertial pos=".05 0 -.03" mass="1" diaginertia=".003 .005 .005"/></body></body></body>"""
LEGS = (
    '<mujoco><compiler angle="radian" autolimits="true"/><option timestep="0.003" integrator="{integrator}" gravity="0 0 -9.81">'
    '<flag contact="disable"/></option><default><joint damping=".5" armature=".02" frictionloss=".2" limited="true"/>'
    '<motor ctrlrange="-1 1" ctrllimited="true"/></default><worldbody><body name="pelvis" pos="0 0 1">{root}'
    '<inertial pos="0 0 .1" mass="12" diaginertia=".12 .1 .09"/>' + LEG.format(s="r_", y="-.1") + LEG.format(s="l_", y=".1") + "</body></worldbody><actuator>"
    + "".join(f'<motor joint="{s}{j}" gear="{g}"/>' for s in ("r_", "l_") for j, g in (("hip_x", 40), ("hip_y", 80), ("knee", 60), ("ankle_y", 15)))
    + "</actuator></mujoco>"
)  # fmt: skip


def mujoco_c(path: Path, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """qpos before each step of MuJoCo C, its constraints solved to the end (its own tolerance is 1e-8)."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.tolerance, model.opt.iterations = 0.0, 200
    data, found, rates = mujoco.MjData(model), [], []
    for u in command:
        found.append(data.qpos.copy())
        rates.append(data.qvel.copy())
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
    return np.array(found), np.array(rates)


def waves(steps: int, dt: float, count: int, size: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    t = dt * np.arange(steps)[:, None, None]
    return size * np.sin(2 * np.pi * rng.uniform(0.2, 3.0, (3, count)) * t + rng.uniform(0, 6, (3, count))).sum(1) / 2


def written(folder: Path, text: str) -> Path:
    path = folder / "robot.xml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "integrator", [pytest.param(name, marks=pytest.mark.slow) for name in ("implicitfast", "Euler")]
)
def test_seven_joints_with_friction_are_mujocos(tmp_path: Path, integrator: str):
    path = written(tmp_path, chain(7, integrator))
    loop, notes = load_loop(path)
    command = waves(2500, 0.002, 7, 0.5)
    np.testing.assert_allclose(
        rollout(loop, command, np.zeros(7)).position, mujoco_c(path, command)[0], rtol=0, atol=1e-9
    )
    assert notes == ()


@pytest.mark.parametrize(
    "integrator",
    ["implicitfast", pytest.param("Euler", marks=pytest.mark.slow), pytest.param("RK4", marks=pytest.mark.slow)],
)
def test_cart_with_every_kind_of_actuator_is_mujocos(tmp_path: Path, integrator: str):
    path = written(tmp_path, CART.replace("{integrator}", integrator))
    loop, _ = load_loop(path)
    command = (
        np.abs(waves(500, 0.002, 5, 4.0, seed=1))
        * np.array([1, 1, 0.2, 1, 1])
        * np.sign(np.sin(np.arange(500) / 40))[:, None]
    )
    command[:, 2] = np.abs(command[:, 2])
    truth, _ = mujoco_c(path, command)
    assert truth[:, 0].max() > 0.3  # the limit was met
    np.testing.assert_allclose(rollout(loop, command, np.zeros(2)).position, truth, rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("root", ["", "<freejoint/>"])
def test_legs_with_limits_are_mujocos(tmp_path: Path, root: str):
    path = written(tmp_path, LEGS.replace("{root}", root).replace("{integrator}", "implicitfast"))
    loop, _ = load_loop(path)
    command = waves(500, 0.003, 8, 0.4, seed=2)
    truth, _ = mujoco_c(path, command)
    found = np.asarray(rollout(loop, command, loop.start).position)
    if root:
        found = np.concatenate([found[:, :3], found[:, 6:7], found[:, 3:6], found[:, 7:]], 1)
    assert (truth[:, -9:] < -0.9).any()  # an ankle or a knee at its limit
    np.testing.assert_allclose(found, truth, rtol=0, atol=1e-6)


HAND = """<mujoco><compiler angle="radian"/><option timestep="0.004" integrator="{integrator}"><flag contact="disable"/></option>
<worldbody><body>{root}<inertial pos="0 .02 0" mass="1" diaginertia=".01 .02 .02"/>
<body pos="0 .1 .1"><joint name="thumb" axis="0 1 .3" damping=".1" armature=".01" actuatorfrcrange="-.5 .4"/>
<inertial pos=".1 0 0" mass=".4" diaginertia=".004 .006 .006"/></body>
<body pos="0 -.1 .1"><joint name="finger" axis="0 1 0" ref=".3" damping=".1" armature=".02" frictionloss=".05"/>
<inertial pos=".1 0 0" mass=".5" diaginertia=".004 .006 .006"/><body pos=".2 0 0"><joint name="tip" type="ball" damping=".05" armature=".005"/>
<inertial pos=".05 .03 .02" mass=".2" diaginertia=".002 .003 .003"/></body></body></body></worldbody>
<tendon><fixed name="grip"><joint joint="thumb" coef="1"/><joint joint="finger" coef="-.7"/></fixed></tendon><actuator>
<position name="close" tendon="grip" kp="9" kv=".9"/><position name="thumb" joint="thumb" kp="30" kv="1.5"/></actuator></mujoco>"""
FREE = '<joint type="free" armature=".2" damping=".1"/>'


@pytest.mark.parametrize(
    "root, integrator",
    [
        ("", "implicitfast"),
        pytest.param(FREE, "RK4", marks=pytest.mark.slow),
        pytest.param("", "RK4", marks=pytest.mark.slow),
        pytest.param(FREE, "implicitfast", marks=pytest.mark.slow),
    ],
)
def test_a_hand_is_mujocos(tmp_path: Path, root: str, integrator: str):
    """A drive of fingers on two branches, one at the end of its torque range, beside a ball and a free base."""
    path = written(tmp_path, HAND.replace("{root}", root).replace("{integrator}", integrator))
    loop, notes = load_loop(path)
    command = waves(150, 0.004, 2, 1.5, seed=5)
    truth, _ = mujoco_c(path, command)
    found = np.asarray(rollout(loop, command, loop.start).position)
    if root:
        found = np.concatenate([found[:, :3], found[:, 6:7], found[:, 3:6], found[:, 7:]], 1)
    found = np.concatenate([found[:, :-4], found[:, -1:], found[:, -4:-1]], 1)  # the tip's w, x, y, z
    assert notes == () and loop.drives.across and np.ptp(truth[:, -6:-4], axis=0).min() > 0.1
    assert np.ptp(truth[:, -3:], axis=0).min() > 1e-3
    np.testing.assert_allclose(found, truth, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("was", "now", "told"),
    [
        ('<fixed name="grip">', '<fixed name="grip" armature=".1">', "armature of tendons"),
        ('<fixed name="grip">', '<fixed name="grip" range="-1 1">', "limits of tendons"),
        ('type="ball"', 'type="ball" stiffness="2"', "the spring of joint 'tip'"),
        ('type="ball"', 'type="ball" range="0 1"', "the limit of joint 'tip'"),
        ("<body>", '<body><joint type="free" frictionloss=".1"/>', "along the world's axes"),
        ('kp="9"', 'kp="9" delay=".01" nsample="4"', "between the stages of RK4"),
        ('contact="disable"', 'contact="disable" refsafe="disable"', "refsafe"),
    ],
)
def test_what_a_file_has_beside_the_loop_is_told(tmp_path: Path, was: str, now: str, told: str):
    text = (
        HAND.replace("{root}", "")
        .replace("{integrator}", "RK4")
        .replace("frictionloss", 'solreffriction=".003 1" frictionloss')
    )
    _, notes = load_loop(written(tmp_path, text.replace(was, now)))
    assert len(notes) == 1 and told in notes[0]


def explicit(text: str) -> str:
    """The file with Euler's damping at the beginning of each step."""
    return text.replace('contact="disable"', 'contact="disable" eulerdamp="disable"')


def test_a_chain_with_explicit_damping_is_mujocos(tmp_path: Path):
    """Files of MuJoCo Playground have it so; implicit, or as the task asks for, the chain moves otherwise."""
    path = written(tmp_path, explicit(chain(2, "Euler")))
    loop, notes = load_loop(path)
    command = waves(300, 0.002, 2, 0.5)
    truth = mujoco_c(path, command)[0]
    np.testing.assert_allclose(rollout(loop, command, np.zeros(2)).position, truth, rtol=0, atol=1e-12)
    assert notes == () and load_loop(path, integrator="euler")[0].integrator == "explicit"
    other = mujoco_c(written(tmp_path, chain(2, "Euler")), command)[0]
    assert np.abs(other - truth).max() > 1e-5


def test_actuators_that_are_off_are_refused(tmp_path: Path):
    text = HAND.replace("{root}", "").replace("{integrator}", "Euler")
    with pytest.raises(InputError, match="actuation is disabled"):
        load_loop(written(tmp_path, text.replace('contact="disable"', 'contact="disable" actuation="disable"')))


def test_a_hard_friction_holds_the_joint_and_never_pulls(tmp_path: Path):
    path = written(tmp_path, chain(1, "implicitfast").replace('frictionloss="1.0000"', 'frictionloss="3"'))
    loop, _ = load_loop(path, law="hard")
    still = np.asarray(rollout(loop, np.full((400, 1), 3e-3), np.zeros(1)).position)  # 1.2 N m of 3
    np.testing.assert_allclose(still, 0.0, rtol=0, atol=1e-9)
    moved = np.asarray(rollout(loop, np.full((3000, 1), 3e-2), np.zeros(1)).position)
    assert 0.02 < moved[-1, 0] < 0.03  # it stops short of the command, where the servo's pull is the friction's
    assert np.diff(moved[:, 0]).min() >= 0.0


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences(tmp_path: Path):
    """Smooth stretch of motion: no constraint changes its state within the step of the differences."""
    path = written(tmp_path, chain(3, "implicitfast"))
    loop, _ = load_loop(path)
    command = waves(150, 0.002, 3, 0.5, seed=4) + 0.3

    def loss(values: jax.Array) -> jax.Array:
        changed = eqx.tree_at(
            lambda m: (m.joints.friction, m.joints.damping, m.joints.armature, m.drives.scale, m.robot.inertia, m.drives.delay),
            loop,
            (values[0:3], values[3:6], values[6:9], values[9:12], jnp.asarray(loop.robot.inertia).at[2, 0].add(values[12]), jnp.repeat(values[13], 3)),
        )  # fmt: skip
        return (rollout(changed, command, np.zeros(3)).reading ** 2).sum()

    with jax.enable_x64(True):
        at = jnp.asarray(
            np.concatenate([loop.joints.friction, loop.joints.damping, loop.joints.armature, [1, 1, 1, 0.1, 0.0033]])
        )
        value = jax.jit(loss)
        exact = np.asarray(jax.grad(loss)(at))
        step = 1e-6 * np.maximum(np.abs(at), 0.1)
        step[-1] = 1e-7
        eye = np.eye(len(at))
        numeric = [
            (float(value(at + h * e)) - float(value(at - h * e))) / (2 * h) for h, e in zip(step, eye, strict=True)
        ]
    np.testing.assert_allclose(exact, numeric, rtol=1e-6, atol=1e-7 * np.abs(numeric).max())


def test_gradients_with_the_64_bit_mode_off_are_those_of_finite_differences():
    """JAX's default: float32 goes in and comes out, float64 between."""
    drives = {name: {"kind": "position", "kp": 60.0, "kd": 4.0} for name in ("shoulder", "elbow")}
    loop, _ = load_loop(fj.DEMO, drives, joints=["shoulder", "elbow"], dt=0.01)
    u, start = 0.3 * np.sin(0.2 * np.arange(20)[:, None] + np.arange(2)), np.array([0.1, 0.2])
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        slope = np.asarray(jax.grad(lambda u: rollout(loop, u, start).reading.sum())(jnp.asarray(u)))
    assert slope.dtype == np.float32
    for row, column in ((0, 0), (5, 1), (12, 0)):
        step = np.zeros_like(u)
        step[row, column] = 1e-5
        ends = [np.asarray(rollout(loop, u + k * step, start).reading).sum() for k in (1, -1)]
        assert slope[row, column] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4)


def test_a_delay_is_the_mean_of_the_held_command():
    command = np.array([0.0, 1.0, 3.0, 3.0, -1.0])[:, None, None]
    for late, expected in ((0.0, command[:, 0, 0]), (0.2, [0, 0, 1, 3, 3]), (0.05, [0, 0.75, 2.5, 3, 0])):
        with jax.enable_x64(True):
            found = delayed(jnp.asarray(command), jnp.asarray([late]), 0.2)[:, 0, 0]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_a_command_of_another_shape_and_a_loop_that_diverges_are_told(tmp_path: Path):
    path = written(tmp_path, chain(1, "Euler").replace('kv="20.00"', 'kv="900"'))
    loop, _ = load_loop(path)
    with pytest.raises(InputError, match="one column for each of: u0"):
        rollout(loop, np.zeros((5, 2)), np.zeros(1))
    with pytest.raises(InputError, match="diverges at joint j0"):
        rollout(loop, np.ones((2000, 1)), np.zeros(1))


def test_a_number_that_is_not_finite_is_no_gain_that_diverges(tmp_path: Path):
    loop, _ = load_loop(written(tmp_path, chain(2, "Euler")))
    command = np.zeros((20, 2))
    command[3, 1] = np.nan
    with pytest.raises(InputError, match="command, row 3, u1: nan; finite numbers are expected"):
        rollout(loop, command, np.zeros(2))
    with pytest.raises(InputError, match="position, j1: inf; finite"):
        rollout(loop, np.zeros((20, 2)), np.array([0.0, np.inf]))
    with pytest.raises(InputError, match="velocity, j0: nan; finite"):
        rollout(loop, np.zeros((20, 2)), np.zeros(2), np.array([np.nan, 0.0]))


def test_friction_that_follows_the_load_holds_a_weight_within_its_law(tmp_path: Path):
    """Load w, drive m, friction up to r |m + w| (m against w): it holds for (1 - r) / (1 + r) < m / w < its inverse."""
    inertial = '<inertial pos="0.3 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
    text = (
        f'<mujoco>{OPTION.format(dt=0.002, integrator="Euler")}<worldbody><body><joint name="j" axis="0 -1 0"/>{inertial}'
        '</body></worldbody><actuator><motor name="u" joint="j"/></actuator></mujoco>'
    )
    loop, _ = load_loop(written(tmp_path, text), law="hard")
    loop = eqx.tree_at(lambda m: m.joints.load_ratio, loop, np.array([0.2]))
    weight = 0.3 * 9.81
    for share, holds in ((0.68, True), (0.65, False), (1.0, True), (1.48, True), (1.52, False)):
        moved = np.abs(np.asarray(rollout(loop, np.full((200, 1), share * weight), np.zeros(1)).reading)).max()
        assert (moved < 1e-6) == holds, (share, moved)
        assert holds or moved > 1e-2
