"""`figaroh-jax new` of measured postures: what Pinocchio's robot measured is read as it was, or refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml
from scipy.spatial.transform import Rotation

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.robotfile import load_robot
from figaroh_jax.recordings.column_names import holds
from figaroh_jax.recordings.draft import draft_task
from figaroh_jax.recordings.poses import PoseRecording, read_pose_recordings

ARM = ("a1", "a2", "a3", "a4", "a5", "a6")


def _urdf() -> str:
    """Six joints with bends between them, and a gripper of two fingers, the second of which mimics the first."""
    axes = ["0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0"]
    offsets = ["0 0 0.3", "0.05 0 0.1", "0 0.02 0.4", "0.15 0 0.05", "0.2 0 0", "0.1 0 0.02"]
    links = "".join(f'<link name="l{k}"/>' for k in range(7)) + '<link name="f1"/><link name="f2"/>'
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/><origin xyz="{at}"/>'
        f'<axis xyz="{axis}"/><limit lower="-2.9" upper="2.9" effort="9" velocity="2"/></joint>'
        for k, (name, axis, at) in enumerate(zip(ARM, axes, offsets, strict=True))
    )
    fingers = "".join(
        f'<joint name="g{k}" type="prismatic"><parent link="l6"/><child link="f{k}"/><axis xyz="0 1 0"/>'
        f'<limit lower="0" upper="0.04" effort="9" velocity="1"/>{follows}</joint>'
        for k, follows in ((1, ""), (2, '<mimic joint="g1"/>'))
    )
    return f'<robot name="arm">{links}{joints}{fingers}</robot>'


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, np.ndarray, np.ndarray]:
    """URDF, postures (30, 6) rad, poses of the marker in the device's frame and three points on the tool (m)."""
    urdf = tmp_path_factory.mktemp("arm") / "arm.urdf"
    urdf.write_text(_urdf())
    model = pin.buildModelFromUrdf(str(urdf))
    rng, data = np.random.default_rng(7), model.createData()
    q = rng.uniform(-1.5, 1.5, (30, 6))
    device, marker = (pin.SE3.Random() for _ in range(2))
    marker.translation *= 0.1
    frame, poses = model.getFrameId("l6"), []
    for row in q:
        pin.framesForwardKinematics(model, data, np.concatenate([row, np.zeros(model.nq - 6)]))
        poses.append((device * data.oMf[frame] * marker).homogeneous)
    poses = np.array(poses)
    poses[:, :3, 3] += rng.normal(0, 2e-4, (30, 3))
    corners = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.02], [0.0, 0.08, 0.0]])
    return urdf, q, poses, np.einsum("nij,kj->nki", poses[:, :3, :3], corners) + poses[:, None, :3, 3]


def _table(path: Path, columns: dict[str, np.ndarray]) -> Path:
    np.savetxt(path, np.column_stack([*columns.values()]), "%.12g", ";", header=";".join(columns), comments="")
    return path


def _read(urdf: Path, files: list[Path], folder: Path, **known: Any) -> tuple[PoseRecording, ...]:
    (folder / "task.yaml").write_text(draft_task(urdf, files, **known).text)
    task = load_task(folder / "task.yaml")
    return read_pose_recordings(task, load_robot(task))


Make = Callable[[np.ndarray, np.ndarray], dict[str, np.ndarray]]


def _named(names: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[:, k] for k, name in enumerate(names.split())}


POSES: dict[str, Make] = {
    "matrices": lambda q, T: {"q": q, "T_world_marker": T},
    "degrees and mm": lambda q, T: {"q": np.rad2deg(q), "pose": np.concatenate([1e3 * T[:, :3, 3], _turn(T)], axis=1)},
    "w first": lambda q, T: {"q": q, "pose": np.concatenate([T[:, :3, 3], _turn(T)[:, [3, 0, 1, 2]]], axis=1)},
    "rotation vectors": lambda q, T: {
        "q": q,
        "tcp_pose": np.concatenate([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_rotvec()], axis=1),
    },
}


def _turn(T: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(T[:, :3, :3]).as_quat()


@pytest.mark.parametrize("way", POSES)
def test_poses_in_arrays_are_read_as_they_were_measured(measured, tmp_path: Path, way: str):
    """Six columns of a robot of seven joints belong to its arm."""
    urdf, q, poses, _ = measured
    np.savez(tmp_path / "run.npz", **POSES[way](q, poses))  # pyright: ignore[reportArgumentType]
    (one,) = _read(urdf, [tmp_path / "run.npz"], tmp_path)
    assert (one.kind, one.tool_frame, one.unknown) == ("pose", "l6", ("base_frame", "tool_frame"))
    np.testing.assert_allclose(one.position, q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(one.values, poses, rtol=0, atol=1e-9)


@pytest.mark.parametrize("names", ["W P R", "C B A", "roll pitch yaw"])
def test_angles_in_columns_are_read_in_degrees_by_the_makers_letters(measured, tmp_path: Path, names: str):
    """Fanuc's W P R and KUKA's A B C, in any order of the columns."""
    urdf, q, poses, _ = measured
    angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("xyz", degrees=True)
    columns = _named("X Y Z", 1e3 * poses[:, :3, 3]) | _named(names, angles)
    columns |= {f"{joint} [deg]": np.rad2deg(q[:, k]) for k, joint in enumerate(ARM)}
    shuffled = [*columns]
    np.random.default_rng(1).shuffle(shuffled)
    (one,) = _read(urdf, [_table(tmp_path / "run.csv", {name: columns[name] for name in shuffled})], tmp_path)
    assert one.kind == "pose"
    np.testing.assert_allclose(one.position, q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(one.values, poses, rtol=0, atol=1e-6)


def test_columns_name_joints_without_the_word_joint(measured, tmp_path: Path):
    """`shoulder_pan [deg]` is of `shoulder_pan_joint`, in any order; a column that two joints may have is none's."""
    urdf, q, _, points = measured
    names = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    text = urdf.read_text()
    for old, new in zip(ARM, names, strict=True):
        text = text.replace(f'"{old}"', f'"{new}_joint"')
    robot = tmp_path / "named.urdf"
    robot.write_text(text)
    columns = {f"{names[k]} [deg]": np.rad2deg(q[:, k]) for k in (3, 0, 5, 1, 4, 2)}
    columns |= {f"{axis} [mm]": 1e3 * points[:, 0, k] for k, axis in enumerate("XYZ")}
    (found,) = _read(robot, [_table(tmp_path / "run.csv", columns)], tmp_path)
    np.testing.assert_allclose(found.position, q, rtol=0, atol=1e-9)
    assert not holds("elbow [deg]", "elbow_joint", ("elbow_joint", "joint_elbow"))
    assert not holds("wrist_x", "wrist_joint", ("wrist_joint",))  # of a point


def test_a_board_seen_by_a_camera_in_the_hand_is_told_from_a_measured_pose(measured, tmp_path: Path):
    """The inverse poses agree with the robot only where the board stands still."""
    urdf, q, poses, _ = measured
    np.savez(tmp_path / "run.npz", q=q, T_cam_board=np.linalg.inv(poses))
    (one,) = _read(urdf, [tmp_path / "run.npz"], tmp_path)
    assert one.carried
    np.testing.assert_allclose(one.values, poses, rtol=0, atol=1e-9)


def test_points_belong_to_the_body_that_moves_as_they_do(measured, tmp_path: Path):
    """Two markers in mm, axis by axis in the file, on the fifth link: the sixth joint turns without them."""
    urdf, q, _, _ = measured
    model = pin.buildModelFromUrdf(str(urdf))
    data, corners, points = model.createData(), np.array([[0.1, 0.05, 0.0], [0.0, -0.1, 0.03]]), []
    for row in q:
        pin.framesForwardKinematics(model, data, np.concatenate([row, np.zeros(model.nq - 6)]))
        points.append([data.oMf[model.getFrameId("l5")].act(corner) + [0.5, -1.0, 0.2] for corner in corners])
    points = np.array(points)
    columns = {f"m{k}_{axis}": 1e3 * points[:, k, j] for j, axis in enumerate("xyz") for k in range(2)}
    columns |= {joint: q[:, k] for k, joint in enumerate(ARM)}
    (one,) = _read(urdf, [_table(tmp_path / "run.csv", columns)], tmp_path)
    assert (one.kind, one.tool_frame) == ("position", "l5")
    np.testing.assert_allclose(one.values, points, rtol=0, atol=1e-9)


def test_what_the_controller_computed_is_not_taken_for_the_measurement(measured, tmp_path: Path):
    urdf, q, poses, _ = measured
    model = pin.buildModelFromUrdf(str(urdf))
    data, own = model.createData(), []
    for row in q:
        pin.framesForwardKinematics(model, data, np.concatenate([row, np.zeros(model.nq - 6)]))
        own.append(data.oMf[model.getFrameId("l6")].homogeneous)
    np.savez(tmp_path / "run.npz", q=q, T_base_flange=np.array(own), T_world_marker=poses)
    (one,) = _read(urdf, [tmp_path / "run.npz"], tmp_path)
    np.testing.assert_allclose(one.values, poses, rtol=0, atol=1e-9)


def test_a_second_measurement_and_what_was_not_seen_are_told(measured, tmp_path: Path):
    """A worse device beside, a marker that hides in some postures, and a row in which nothing was seen."""
    urdf, q, poses, points = measured
    hidden = points.copy()
    hidden[::7, 1], hidden[4] = np.nan, np.nan
    camera = poses[:, :3, 3] + np.random.default_rng(2).normal(0, 3e-3, (30, 3))
    np.savez(tmp_path / "run.npz", q=q, markers=hidden, camera_xyz=camera)
    draft = draft_task(urdf, [tmp_path / "run.npz"])
    assert "camera_xyz agrees with the robot less well than markers, and is not used" in draft.text
    (one,) = _read(urdf, [tmp_path / "run.npz"], tmp_path)
    np.testing.assert_allclose(one.values, hidden, rtol=0, atol=1e-12)


def test_moments_that_no_body_can_have_are_told(measured, tmp_path: Path):
    urdf, q, poses, _ = measured
    moments = '<inertia ixx="-0.1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    body = f'<link name="l3"><inertial><mass value="1"/>{moments}</inertial></link>'
    (tmp_path / "arm.urdf").write_text(urdf.read_text().replace('<link name="l3"/>', body))
    np.savez(tmp_path / "run.npz", q=q, pose=poses)
    (said,) = (line for line in draft_task(tmp_path / "arm.urdf", [tmp_path / "run.npz"]).assumed if "'l3'" in line)
    assert said.startswith("arm.urdf: link 'l3': its inertia has a negative principal moment, -0.1 kg m^2")
    np.savez(tmp_path / "run.npz", q=np.tile(q, (9, 1)), tau=np.tile(q, (9, 1)))
    with pytest.raises(InputError, match="'l3': its inertia has a negative"):
        draft_task(tmp_path / "arm.urdf", [tmp_path / "run.npz"], joints=ARM, rate=100.0)


def test_sets_of_one_file_are_recordings_and_those_that_test_are_held_out(measured, tmp_path: Path):
    """A test set of the same device is held out; one of another device cannot be predicted, and is fitted."""
    urdf, q, _, points = measured
    sets = {"cali_q": q[:20], "cali_xyz": points[:20], "test_q": q[20:], "test_xyz": points[20:]}
    np.savez(tmp_path / "run.npz", **sets)  # pyright: ignore[reportArgumentType]
    assert [one.role for one in _read(urdf, [tmp_path / "run.npz"], tmp_path)] == ["fit", "holdout"]
    np.savez(tmp_path / "run.npz", **sets | {"test_xyz": points[20:, 0]})  # pyright: ignore[reportArgumentType]
    assert [one.role for one in _read(urdf, [tmp_path / "run.npz"], tmp_path)] == ["fit", "fit"]


def test_joints_in_another_order_agree_with_the_robot_in_no_meaning(measured, tmp_path: Path):
    urdf, q, poses, _ = measured
    turned = [3, 0, 1, 2, 5, 4]
    np.savez(tmp_path / "run.npz", q=q[:, turned], pose=poses)
    with pytest.raises(InputError, match="--joints names the joints of the columns"):
        draft_task(urdf, [tmp_path / "run.npz"])
    (one,) = _read(urdf, [tmp_path / "run.npz"], tmp_path, joints=[ARM[k] for k in turned])
    np.testing.assert_allclose(one.position[:, [turned.index(k) for k in range(6)]], q, rtol=0, atol=1e-12)


def test_a_held_out_recording_of_a_device_that_no_other_shows_is_refused(measured, tmp_path: Path):
    """Nothing tells where its device stands (it ended in an internal error)."""
    urdf, q, _, points = measured
    np.savez(tmp_path / "fit.npz", q=q, p=points)
    np.savez(tmp_path / "test.npz", q=q, p=points[:, 0])
    frames = {"position": "p", "base_frame": "l0", "tool_frame": "l6", "unknown": ["base_frame", "tool_frame"]}
    data = [{"file": f"{name}.npz", "position": "q", "role": role, "measurement": frames} for name, role in ROLES]
    robot = {"model": str(urdf), "joints": [*ARM]}
    (tmp_path / "task.yaml").write_text(yaml.safe_dump({"robot": robot, "data": data}))
    with pytest.raises(InputError, match="nothing with role: fit is measured by the same device"):
        fj.calibrate_task(load_task(tmp_path / "task.yaml"))


ROLES = (("fit", "fit"), ("test", "holdout"))


@pytest.mark.parametrize(
    ("robot", "file", "joints", "source", "units"),
    [
        ("tiago_mocap/tiago_no_hand.urdf", "qualysis_base_hand_calibration.csv", 8, "x1", ("rad", "m")),
        ("irb120_wu2015/irb120.urdf", "irb120_wu.npz", 6, "cali_xyz_mm", ("deg", "mm")),
        ("panda_handeye_board/panda.urdf", "panda_handeye.npz", 7, "T_board_cam", ("rad", "m")),
        ("talos_contact/talos_full_v2.urdf", "talos_left_arm_02_10_contact.csv", 9, "x1", ("rad", "m")),
    ],
)
def test_real_postures_are_drafted_from_their_files_alone(
    data_dir: Path, robot: str, file: str, joints: int, source: str, units: tuple[str, str]
):
    """Markers of three robots and a board that a Panda's camera saw, beside the pose that its controller computed."""
    urdf = data_dir / robot
    task = yaml.safe_load(draft_task(urdf, [urdf.parent / file]).text)
    first = task["data"][0]
    (seen,) = (first["measurement"][kind] for kind in ("pose", "position") if kind in first["measurement"])
    assert (seen if isinstance(seen, str) else seen[0]) == source
    assert (first.get("units", {}).get("position", "rad"), first.get("units", {}).get("measurement", "m")) == units
    assert load_robot(load_task(task)).nv == joints
