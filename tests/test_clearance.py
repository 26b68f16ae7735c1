"""Distances of bodies: against coal on the same shapes, finite differences, and in a motion that keeps them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import robots

from figaroh_jax.cli import main
from figaroh_jax.errors import InputError
from figaroh_jax.excitation.certified import nearest_approaches
from figaroh_jax.excitation.clearance import Box, Capsule, clearance_of, enclosing_capsule, link_poses
from figaroh_jax.excitation.limits import checked, limits_of
from figaroh_jax.excitation.motions import Trajectory, fourier
from figaroh_jax.formats.collision import read_shapes
from figaroh_jax.rigid.kinematics import forward_kinematics
from figaroh_jax.rigid.model import RobotModel

LIMIT = '<limit lower="-2.5" upper="2.5" velocity="3" effort="60"/>'
ARM = robots.robot(
    *robots.LINKS[:4],
    robots.joint("turn", "base", "a", axis="0 0 1", more=LIMIT),
    robots.joint("bend", "a", "b", axis="0 1 0", more=LIMIT),
    robots.joint(
        "slide", "b", "c", "prismatic", "1 1 0", more='<limit lower="-.1" upper=".3" velocity="1" effort="90"/>'
    ),
)
BODIES = [
    Capsule("base", (0, 0, -0.1), (0, 0, 0.05), 0.06),
    Capsule("a", (0, 0, 0), (0.1, 0, 0.1), 0.05),
    Capsule("b", (0, 0, 0), (0.2, 0.1, 0), 0.04),
    Capsule("c", (0, 0, 0.1), (0.1, 0, 0.2), 0.03),
]
BOX = Box("table", (0.4, 0.5, 0.3), (0.6, 0.1, -0.3), (0.1, 0.2, 0.3))
SHAPES = """<collision><origin xyz=".02 0 .05" rpy=".3 0 .2"/><geometry>{}</geometry></collision></link>"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    return robots.load(ARM, tmp_path_factory.mktemp("arm"))


def postures(model: RobotModel, count: int = 40, seed: int = 0) -> np.ndarray:
    low, high = np.array(model.position_limit).T
    return np.random.default_rng(seed).uniform(low, high, (count, model.nv))


def test_poses_are_those_of_forward_kinematics_and_gradients_those_of_differences(arm: RobotModel):
    q = postures(arm)
    np.testing.assert_allclose(
        np.moveaxis(link_poses(arm, q), 3, 0), np.asarray(forward_kinematics(arm, q)), rtol=0, atol=1e-12
    )
    found = clearance_of(arm, margin=0.01, bodies=BODIES, floor=-1.5, boxes=[BOX])
    assert {found.name(k) for k in range(len(found.rows.names))} >= {"c - table", "b - floor", "c - a"}
    distance, back = found.with_gradient(q)
    weight, h = np.random.default_rng(1).normal(size=distance.shape), 1e-6
    weight[::3] = 0.0
    slope = back(weight)
    for k in range(arm.nv):
        step = h * np.eye(arm.nv)[k]
        change = (found.distances(q + step) - found.distances(q - step)) / (2 * h)
        np.testing.assert_allclose(slope[:, k], (weight * change).sum(1), rtol=0, atol=1e-5)


def test_distances_of_capsules_are_those_of_coal(arm: RobotModel):
    coal = pytest.importorskip("coal")
    found = clearance_of(arm, margin=0.01, bodies=BODIES, boxes=[BOX])
    q = postures(arm)
    own = found.distances(q)
    pairs = list(found.pairs)
    exact = found.exact_distances(q, pairs)
    assert exact is not None
    apart = exact > 0
    np.testing.assert_allclose(own[:, : len(pairs)][apart], exact[apart], rtol=0, atol=1e-6)
    assert apart.sum() > 20
    from figaroh_jax.formats.collision import rotation

    box, place = coal.Box(*BOX.size), coal.Transform3s(rotation(BOX.turn), np.array(BOX.at))
    poses, row = link_poses(arm, q), found.rows.names.index("c - table")
    (a, b), radius = (np.array(x) for x in BODIES[3][1:3]), BODIES[3].radius
    for s in range(len(q)):
        ends = [poses[2][:3, :3, s] @ x + poses[2][:3, 3, s] for x in (a, b)]
        z = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        x = np.cross(z, [0.3, 0.5, 0.8])
        x /= np.linalg.norm(x)
        at = coal.Transform3s(np.stack([x, np.cross(z, x), z], 1), (ends[0] + ends[1]) / 2)
        capsule = coal.Capsule(radius, float(np.linalg.norm(ends[1] - ends[0])))
        told = coal.distance(box, place, capsule, at, coal.DistanceRequest(), coal.DistanceResult())
        if told > 0:
            assert own[s, row] == pytest.approx(told, abs=1e-5)


def test_capsules_enclose_the_shapes_of_a_file_and_meshes_are_never_nearer(tmp_path: Path):
    pytest.importorskip("coal")
    trimesh = pytest.importorskip("trimesh")
    (tmp_path / "parts" / "meshes").mkdir(parents=True)
    generator = np.random.default_rng(3)
    mesh = trimesh.Trimesh(generator.normal(size=(40, 3)) * [0.03, 0.05, 0.12]).convex_hull
    mesh.export(tmp_path / "parts" / "meshes" / "b.stl")
    shapes = {
        "base": '<box size=".2 .1 .1"/>',
        "a": '<cylinder radius=".05" length=".2"/>',
        "b": '<mesh filename="package://parts/meshes/b.stl" scale="1 1 1.5"/>',
        "c": '<mesh filename="lost.stl"/>',
    }
    text = ARM
    for name, shape in shapes.items():
        i = text.index(f'<link name="{name}"')
        j = text.index("</link>", i)
        text = text[:j] + SHAPES.format(shape) + text[j + len("</link>") :]
    (tmp_path / "robot.urdf").write_text(text)
    model = robots.load(text, tmp_path)
    found, notes = read_shapes(tmp_path / "robot.urdf")
    assert [shape.kind for shape in found] == ["box", "cylinder", "mesh"]
    assert len(notes) == 1 and "link 'c': no file lost.stl" in notes[0]
    start, end, radius = enclosing_capsule(np.asarray(mesh.vertices))
    way = end - start
    t = np.clip((mesh.vertices - start) @ way / (way @ way), 0, 1)
    assert (np.linalg.norm(mesh.vertices - start - t[:, None] * way, axis=1) <= radius + 1e-9).all()
    assert np.pi * radius**2 * np.linalg.norm(way) + 4 / 3 * np.pi * radius**3 < 4 * mesh.bounding_box.volume
    clear = clearance_of(model, found, margin=0.005, bodies=[Capsule("c", (0, 0, 0), (0.1, 0, 0), 0.02)])
    q = postures(model, 60)
    exact = clear.exact_distances(q, clear.pairs)
    assert exact is not None and len(clear.pairs) >= 2
    rows, own = clear.rows, clear.distances(q)[:, : len(clear.rows.pair)] - clear.rows.slack
    for k in range(len(clear.pairs)):
        nearest = own[:, rows.pair == k].min(axis=1)
        assert (nearest <= np.maximum(exact[:, k], 0) + 1e-9).all()


def test_shapes_of_mjcf_are_its_colliding_geoms(tmp_path: Path):
    (tmp_path / "robot.xml").write_text(
        """<mujoco><worldbody><body name="one" pos="0 0 .1"><joint name="j" axis="0 1 0"/>
        <geom type="capsule" size=".05 .1" pos=".1 0 0" quat="1 1 0 0"/>
        <geom type="box" size=".1 .2 .3" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
    )
    (shape,), notes = read_shapes(tmp_path / "robot.xml")
    assert (shape.frame, shape.kind, shape.size, notes) == ("one", "capsule", (0.05, 0.1), ())
    np.testing.assert_allclose(shape.pose @ [0, 0, 0.1, 1], [0.1, -0.1, 0, 1], rtol=0, atol=1e-9)


def test_what_can_never_be_kept_is_refused_with_the_bodies_and_the_advice(arm: RobotModel):
    with pytest.raises(InputError, match="has no collision shapes that can be read; give `bodies`"):
        clearance_of(arm)
    with pytest.raises(InputError, match=r"c and a \(.* m\).*ignore: \[\[c, a\]\]"):
        clearance_of(arm, margin=0.9, bodies=BODIES[1:])
    assert not clearance_of(arm, margin=0.9, bodies=BODIES[1:], floor=-3.0, ignore=[("c", "a")]).pairs
    with pytest.raises(InputError, match=r"'a' is closer than 0.05 m to 'floor' in nearly every posture"):
        clearance_of(arm, margin=0.05, bodies=[*BODIES[1:], Capsule("a", (0.3, 0, 0), (0.3, 0, 0), 0.4)], floor=0.0)
    with pytest.raises(InputError, match="ignore: no body 'tabel' has a shape; did you mean 'table'"):
        clearance_of(arm, margin=0.01, bodies=BODIES, boxes=[BOX], ignore=[("c", "tabel")])
    with pytest.raises(InputError, match="bodies: the robot has no link or frame 'd'"):
        clearance_of(arm, bodies=[Capsule("d", (0, 0, 0), (0, 0, 0), 0.1)])


def test_the_largest_uses_are_those_of_every_sample_at_1_khz(arm: RobotModel):
    clearance = clearance_of(arm, margin=0.01, bodies=BODIES, floor=-1.5, boxes=[BOX])
    limits, basis = limits_of(arm, clearance=clearance), fourier(5, 0.5, 4.0)

    def torque(states: np.ndarray) -> np.ndarray:
        q, v, a = states
        return 20 * np.sin(3 * q) + 4 * a + 9 * np.tanh(v / 0.03)

    for seed in range(4):
        generator = np.random.default_rng(seed)
        motion = Trajectory(np.zeros(3), 0.4 * generator.normal(size=(3, basis.size)), basis)
        uses = {use.kind: use for use in checked(torque, arm, motion, limits)}
        q, v, a = (np.asarray(x) for x in motion.at(np.arange(4001) / 1000))
        share = np.abs(torque(np.stack([q, v, a]))) / limits.torque
        assert uses["torque"].share == pytest.approx(share.max(), rel=1e-9)
        assert uses["clearance"].value == pytest.approx(clearance.distances(q).min(), abs=1e-9)
        assert uses["velocity"].share == pytest.approx((np.abs(v) / limits.velocity).max(), rel=1e-9)


def test_a_designed_motion_keeps_its_distances_and_the_run_shows_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Two links that swing over a box; distances of the run against a dense search along both axes."""
    text = robots.robot(
        *robots.LINKS[:3],
        robots.joint("turn", "base", "a", axis="0 1 0", xyz="0 0 0", rpy="0 0 0", more=LIMIT),
        robots.joint("bend", "a", "b", axis="0 1 0", xyz=".3 0 0", rpy="0 0 0", more=LIMIT),
    )
    (tmp_path / "robot.urdf").write_text(text)
    keys = """
  basis: {fourier: 3}
  duration: 3
  starts: 1
  noise: 0.02
  start: [0.0, 0.0]
  limits: {acceleration: 9.0, clearance: 0.03, torque: 200.0}
  boxes:
  - {name: table, size: [0.5, 0.6, 0.2], at: [0.75, 0, -0.3]}
  - {name: shelf, size: [0.5, 0.6, 0.2], at: [0.75, 0, 0.3]}
  bodies: [{link: a, to: [0.3, 0, 0], radius: 0.03}, {link: b, to: [0.3, 0, 0], radius: 0.02}]
"""
    file = tmp_path / "task.yaml"
    file.write_text("robot: {model: robot.urdf}\nexcite:" + keys)
    assert main(["excite", str(file), "--out", str(tmp_path / "run"), "--json", "--quiet"]) == 0
    answer = json.loads(capsys.readouterr().out)
    (told,) = answer["trajectories"]
    use = next(one for one in told["use_at_1_kHz"] if one["limit"] == "clearance")
    assert use["joint"] in ("b - table", "b - shelf") and 0.03 * 0.999 <= use["value"] < 0.06
    model = robots.load(text, tmp_path)

    def nearest(run: str) -> float:
        with np.load(tmp_path / run / "trajectory_1.npz") as motion:
            poses = np.asarray(forward_kinematics(model, motion["q"][::5]))[:, 1]
        points = poses[:, None, :3, 0] * np.linspace(0, 0.3, 61)[:, None] + poses[:, None, :3, 3]
        out = np.abs(np.stack([points - [0.75, 0, z] for z in (-0.3, 0.3)])) - [0.25, 0.3, 0.1]
        return float(np.linalg.norm(np.maximum(out, 0), axis=-1).min()) - 0.02

    assert nearest("run") == pytest.approx(use["value"], abs=2e-3)
    free = keys[: keys.index("  boxes")].replace("clearance: 0.03, ", "")
    (tmp_path / "free.yaml").write_text("robot: {model: robot.urdf}\nexcite:" + free)
    assert main(["excite", str(tmp_path / "free.yaml"), "--out", str(tmp_path / "free"), "--json", "--quiet"]) == 0
    unkept = json.loads(capsys.readouterr().out)
    assert nearest("free") == pytest.approx(-0.02, abs=1e-9)  # right through the boxes: the distances hold the motion
    assert unkept["logdet"] > answer["logdet"] + 0.5  # what keeping clear costs
    assert min(told["clearance"]["distance"]) == pytest.approx(use["value"], abs=3e-3)
    page = (tmp_path / "run" / "report.html").read_text()
    assert "least distance between bodies" in page
    file.write_text(file.read_text().replace("start: [0.0, 0.0]", "start: [0.5, 0.0]"))
    assert main(["excite", str(file), "--out", str(tmp_path / "other"), "--quiet"]) == 2
    assert "start: b - table" in capsys.readouterr().err
    file.write_text("robot: {model: robot.urdf}\nexcite: {floor: 0.0}\n")
    assert main(["excite", str(file), "--out", str(tmp_path / "other"), "--quiet"]) == 2
    assert "floor: distances are looked at where limits.clearance" in capsys.readouterr().err


def test_the_view_draws_the_robot_and_the_capsules_that_were_kept_apart(arm: RobotModel):
    from figaroh_jax.reporting.motion_view import capsule_lines, skeleton

    q = postures(arm, 1)[0]
    poses = np.asarray(forward_kinematics(arm, q))
    lines = skeleton(arm, q)
    np.testing.assert_allclose(lines[:, 1], poses[:, :3, 3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(lines[1:, 0], poses[:-1, :3, 3], rtol=0, atol=1e-12)
    found = clearance_of(arm, margin=0.01, bodies=BODIES[3:], floor=-1.5)
    points = capsule_lines(found, q).reshape(-1, 3)
    start, end = (poses[2][:3, :3] @ x + poses[2][:3, 3] for x in np.array(BODIES[3][1:3]))
    t = np.clip((points - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    away = np.linalg.norm(points - start - t[:, None] * (end - start), axis=1)
    np.testing.assert_allclose(away, BODIES[3].radius, rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_a_distance_is_kept_between_samples_too_or_known_not_to_be(arm: RobotModel, seed: int):
    """A motion at 30 rad/s whose least distance no sample of 100 Hz shows; the truth by samples of 10 kHz."""
    basis, generator = fourier(5, 2.0, 0.5), np.random.default_rng(seed)
    motion = Trajectory(0.3 * generator.normal(size=3), 0.5 * generator.normal(size=(3, basis.size)), basis)
    every = clearance_of(arm, margin=0.01, bodies=BODIES, floor=-1.5, boxes=[BOX])
    fine, coarse = (every.capsule_distances(np.asarray(motion.states(rate)[0])) for rate in (10000.0, 100.0))
    names = [one.bodies for one in nearest_approaches(every, motion, 0.0)]
    least, shown = dict(zip(every.rows.names, fine.min(0), strict=True)), coarse.min(0)
    assert names == every.rows.names and (shown > fine.min(0) + 1e-6).any()
    for share, kept in ((1 - 1e-3, True), (1 + 1e-3, False)):
        for k, name in enumerate(names):
            if least[name] > 0.01:
                told = nearest_approaches(every, motion, share * least[name])[k]
                assert told.kept == kept, (name, told, least[name])
                assert told.distance >= least[name] - 1e-9
