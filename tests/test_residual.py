"""Data in memory and the public residual: against the engine's own rows, and under every transformation."""

from __future__ import annotations

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import figaroh_jax as fj
from figaroh_jax.compiled.precision import Float32Boundary
from figaroh_jax.estimation.data import PLACES
from figaroh_jax.recordings.devices import Planes, Sockets

T = np.arange(500)[:, None] / 250.0
MOTION = 0.6 * np.sin(2 * np.pi * np.array([0.5, 0.7, 0.9, 1.1]) * T + np.arange(4))


@pytest.fixture(scope="module")
def robot() -> fj.RobotModel:
    return fj.load_urdf(fj.DEMO)


def run(**more) -> fj.Recording:
    return fj.recording(q=MOTION, tau=np.cos(MOTION), rate=250, **more)


def test_arrays_in_memory_are_checked_and_converted(robot: fj.RobotModel):
    found = fj.recording(q=np.degrees(MOTION), tau=MOTION, time=T[:, 0] * 1e9, units={"position": "deg", "time": "ns"})
    np.testing.assert_allclose(found.position, MOTION, rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.time, T[:, 0], rtol=0, atol=1e-14)
    assert found.joints == ("joint 1", "joint 2", "joint 3", "joint 4")
    assert fj.recording(q=MOTION, rate=1, model=robot).joints == robot.joint_names
    broken = MOTION.copy()
    broken[3, 1] = np.nan
    wrong = [
        ({"q": broken, "rate": 1}, "q is nan in row 3, column 1"),
        ({"q": MOTION}, "time or rate"),
        ({"q": MOTION, "tau": MOTION[:-1], "rate": 1}, "tau has 499 samples"),
        ({"q": MOTION, "tau": MOTION[:, :3], "rate": 1}, "q has 4 columns, expected 3"),
        ({"q": MOTION, "time": -T[:, 0]}, "does not increase in row 1"),
        ({"q": MOTION, "rate": 1, "units": {"position": "turns"}}, "'turns'; known: rad"),
        ({"q": MOTION, "rate": 1, "units": {"positions": "deg"}}, "no 'positions'"),
    ]
    for arguments, message in wrong:
        with pytest.raises(fj.InputError, match=message):
            fj.recording(**arguments)


def test_residual_is_the_low_passed_torque_of_the_model_less_the_measured(robot: fj.RobotModel):
    friction = fj.place(fj.CATALOGUE["viscous_friction"], robot, ["elbow"], damping=1.5)
    model = fj.extend(robot, friction)
    data = fj.torque_data(model, run(), fj.Preprocess(cutoff=10), noise=np.array([1.0, 2.0, 3.0, 4.0]))
    rows = np.asarray(fj.residual(model, data)).reshape(-1, 4)
    torque = np.asarray(model.inverse_dynamics(data.position[0], data.velocity[0], data.acceleration[0]))
    assert data.source is not None and data.kept is not None
    inside = np.asarray(data.source[0], int)[np.asarray(data.kept[0], int)]
    # a smooth motion far below the cutoff passes the filter as it is
    expected = (torque[inside] - np.cos(data.position[0])[inside]) / np.array([1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(rows[4:-4], expected[4:-4], rtol=0, atol=2e-3 * np.abs(expected).max())


def test_residual_of_torques_differentiates_by_every_array_of_the_model(robot: fj.RobotModel):
    model = fj.extend(robot, fj.place(fj.CATALOGUE["stribeck_friction"], robot, ["elbow"], force=1.0, speed=0.2))
    data = fj.torque_data(model, run())

    def cost(model: fj.ExtendedModel) -> jax.Array:
        return jnp.mean(fj.residual(model, data) ** 2)

    slope = jax.jit(jax.grad(cost))(model)
    value = jax.jit(cost)
    rng = np.random.default_rng(0)
    for where in (
        lambda m: m.robot.inertia,
        lambda m: m.robot.placement,
        lambda m: m.robot.gravity,
        lambda m: m.effects[0].force,
        lambda m: m.effects[0].speed,
    ):
        at = np.asarray(where(model), float)
        way, h = rng.normal(size=at.shape), 1e-5
        ahead, behind = (value(eqx.tree_at(where, model, at + s * h * way)) for s in (1, -1))
        np.testing.assert_allclose(np.sum(where(slope) * way), (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-7)


def devices(robot: fj.RobotModel) -> dict[str, fj.PoseData]:
    rng = np.random.default_rng(1)
    q = rng.uniform(-1, 1, (12, 4))
    frames = {"q": q, "base_frame": "base", "tool_frame": robot.link_names[-1]}
    poses = np.asarray(fj.frame_placement(robot, q, robot.link_names[-1]))
    number = np.arange(12) % 2
    own = fj.own_device(lambda pose, u, d: pose[:3, 3] @ pose[:3, 3] - u - d, {"zero": (0.1, "m", 0.1)}, (0,))
    recordings = {
        "pose": fj.postures(pose=poses, **frames),
        "position": fj.postures(position=poses[:, :3, 3], **frames),
        "plane": fj.postures(plane=number, **frames, unknown=["tool_frame"]),
        "socket": fj.postures(socket=number, distance=0.05, **frames, unknown=["tool_frame"]),
        "camera": fj.postures(camera=np.linalg.inv(poses), **frames),
        "device": fj.postures(device=own, measured=poses[:, 0, 3], **frames),
    }
    return {kind: fj.pose_data(robot, one)[0] for kind, one in recordings.items()}


COUNTS = {"pose": 12 * 6, "position": 12 * 3, "plane": 12, "socket": 12 * 3 + 1, "camera": 12 * 6, "device": 12}


@pytest.mark.parametrize(
    "kinds", [("position", "socket", "device"), pytest.param(tuple(COUNTS), marks=pytest.mark.slow)], ids=len
)
def test_every_device_has_a_residual_that_differentiates(robot: fj.RobotModel, kinds: tuple[str, ...]):
    """Half of the devices, and all of them together; `test_posefit.py` has the derivatives of each."""
    every = devices(robot)
    assert isinstance(every["plane"].device, Planes) and isinstance(every["socket"].device, Sockets)
    data = tuple(every[kind] for kind in kinds)
    model = fj.extend(robot)
    rows = fj.residual(model, data)
    ends = np.cumsum([COUNTS[kind] for kind in kinds])
    assert len(rows) == ends[-1]
    for kind, part in zip(kinds, np.split(np.asarray(rows), ends[:-1]), strict=True):
        if kind in ("pose", "position"):  # frames in closed form are exact
            np.testing.assert_allclose(part, 0.0, rtol=0, atol=1e-9)

    def moved(placement: jax.Array) -> jax.Array:
        return fj.residual(eqx.tree_at(lambda m: m.robot.placement, model, placement), data)

    at, h = np.asarray(robot.placement), 1e-6
    way = np.random.default_rng(2).normal(size=at.shape) * (np.arange(4)[:, None] < 3)

    @jax.jit
    def thrice(x: jax.Array) -> tuple[jax.Array, ...]:
        forward = jax.jvp(moved, (x,), (way,))[1]
        return forward, (moved(x + h * way) - moved(x - h * way)) / (2 * h), jax.vjp(moved, x)[1](rows)[0]

    forward, difference, back = thrice(at)
    np.testing.assert_allclose(forward, difference, rtol=0, atol=2e-7 * np.abs(difference).max())
    np.testing.assert_allclose(np.sum(back * way), rows @ forward, rtol=1e-9, atol=1e-12)


def test_what_was_not_measured_weighs_nothing_and_a_map_over_robots_gives_each_its_rows(robot: fj.RobotModel):
    q = np.random.default_rng(3).uniform(-1, 1, (10, 4))
    seen = np.array(fj.frame_placement(robot, q, robot.link_names[-1]))[:, :3, 3]
    seen[4] = np.nan
    one = fj.postures(q=q, position=seen, base_frame="base", tool_frame=robot.link_names[-1], accuracy=(1e-3, None))
    (data,) = fj.pose_data(robot, one)
    longer = jax.tree.map(lambda x: np.stack([x, x]), robot)
    placement = np.array(longer.placement)
    placement[1, 1, 2, 3] += 0.001
    rows = jax.vmap(lambda r: fj.residual(r, data))(eqx.tree_at(lambda m: m.placement, longer, placement))
    assert rows.shape == (2, 30)
    np.testing.assert_array_equal(rows[:, 12:15], 0.0)
    assert np.abs(rows[0]).max() < 1e-6 < np.abs(rows[1]).max()


def test_links_that_bend_or_grow_move_the_residual_of_postures(tmp_path):
    """A pitching arm whose mass lies beside it: its weight rolls the link; the second joint moves out with warmth."""
    unit = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    inertial = f'<inertial><mass value="2"/><origin xyz="0 0.5 0"/>{unit}</inertial>'
    text = (
        f'<robot name="arm"><link name="base"/><link name="a">{inertial}</link><link name="b"/><link name="tip"/>'
        '<joint name="pitch" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>'
        '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        '<joint name="yaw" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.5 0 0"/>'
        '<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        '<joint name="end" type="fixed"><parent link="b"/><child link="tip"/><origin xyz="0.3 0.4 0"/></joint></robot>'
    )
    (tmp_path / "arm.urdf").write_text(text)
    robot = fj.load_urdf(tmp_path / "arm.urdf")
    seen = fj.postures(
        q=np.zeros((3, 2)),
        position=np.zeros((3, 3)),
        time=np.arange(3.0),
        base_frame="base",
        tool_frame="tip",
        unknown=(),
    )
    (data,) = fj.pose_data(robot, seen)
    soft = fj.place(fj.effects.kinematic.LinkCompliance, robot, ["pitch"], first=1e-3)
    warm = fj.place(fj.effects.kinematic.ThermalGrowth, robot, ["yaw"], growth=2e-3, share=0.3)
    roll = -9.81 * 1e-3  # the weight's moment about x, 2 kg at 0.5 m
    bent = np.tile([0.8, 0.4 * np.cos(roll), 0.4 * np.sin(roll)], (3, 1))
    grown = np.outer(-np.expm1(-np.arange(3.0) / 0.6), [2e-3 * 0.5, 0.0, 0.0])
    found = np.asarray(fj.residual(fj.extend(robot, soft, warm), data)).reshape(3, 3)
    np.testing.assert_allclose(found, bent + grown, rtol=0, atol=1e-9)

    by = jax.jacfwd(lambda model: fj.residual(model, data))(fj.extend(robot, soft, warm))
    np.testing.assert_allclose(by.effects[0].first.reshape(3, 3)[:, 2], -9.81 * 0.4 * np.cos(roll), rtol=1e-9)
    np.testing.assert_allclose(by.effects[1].growth.reshape(3, 3), grown / 2e-3, rtol=0, atol=1e-9)


@pytest.mark.parametrize("wide", [True, False])
def test_an_effect_takes_a_number_that_is_traced(robot: fj.RobotModel, wide: bool):
    """A user maps and differentiates by a parameter where the effect is placed, with JAX's 64-bit mode on and off."""
    t = np.arange(400)[:, None] / 250.0
    q = 0.5 * np.sin(t * np.array([3.0, 4.4, 5.6, 6.9]))
    data = fj.torque_data(robot, fj.recording(q=q, tau=np.cos(q), rate=250), fj.Preprocess(cutoff=20))

    def cost(damping):
        friction = fj.place(fj.CATALOGUE["viscous_friction"], robot, ["elbow"], damping=damping)
        return (fj.residual(fj.extend(robot, friction), data) ** 2).mean()

    sizes = np.array([0.0, 0.5, 1.0], np.float32)
    with jax.enable_x64(wide), warnings.catch_warnings():
        warnings.simplefilter("ignore", Float32Boundary)
        many = np.asarray(jax.vmap(cost)(sizes))
        slope = float(jax.grad(cost)(0.5))
    single = [float(cost(float(size))) for size in sizes]
    np.testing.assert_allclose(many, single, rtol=1e-12 if wide else 1e-6, atol=0)
    assert slope == pytest.approx(single[2] - single[0], rel=1e-5)  # of a parabola


def test_a_recording_whose_samples_single_precision_cannot_count_is_refused(
    robot: fj.RobotModel, monkeypatch: pytest.MonkeyPatch
):
    """The places of rows are floats: above 2^24 two of them would be one without x64."""
    first, last = (float(np.float32(PLACES + k)) for k in (-1, 1))
    assert first == PLACES - 1 and last != PLACES + 1
    monkeypatch.setattr("figaroh_jax.estimation.data.PLACES", 400)
    with pytest.raises(fj.InputError, match="more than 400 cannot be counted .* split it into shorter"):
        fj.torque_data(robot, run())
