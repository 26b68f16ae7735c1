"""The check of recordings: wrong ones get the right advice, right ones pass, and what it computes is Pinocchio's."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import poses
import pytest
from generators import make_case
from spoiled import KINDS, Base, said

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.robotfile import load_robot
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.recordings.checks import check_recordings
from figaroh_jax.recordings.dataset import read_recordings
from figaroh_jax.recordings.likeness import Sampled, frame_poses, rigid_torque, stretch_of_time
from figaroh_jax.recordings.posture_checks import check_pose_recording

# its slide takes mm
NOT_HERE = {"mm on a revolute arm"}


def quaternions(T: np.ndarray) -> np.ndarray:
    """Matrices as x y z qx qy qz qw."""
    return np.hstack([T[:, :3, 3], [pin.Quaternion(R).coeffs() for R in T[:, :3, :3]]])


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Base:
    case = make_case(robot="small", repeats=1, trajectories=1, seed=4)
    urdf = tmp_path_factory.mktemp("robot") / "robot.urdf"
    urdf.write_text(case.urdf)
    run = case.recordings[0]
    arrays = {"t": run["time"], "q": run["position"], "tau": run["torque"]}
    entry = {"time": "t", "position": "q", "torque": "tau"}
    return Base("run", {"model": str(urdf), "joints": list(case.joints)}, arrays, entry, pair=(0, 1))


@pytest.mark.parametrize("kind", sorted(KINDS.keys() - NOT_HERE))
def test_wrong_recordings_get_the_right_advice(base: Base, kind: str, tmp_path: Path):
    spoil, advice = KINDS[kind]
    what, text = said(base, spoil, tmp_path)
    assert what != "silent" and re.search(advice, text), text
    assert "run.npz" in text


@pytest.mark.parametrize("seed", range(4))
def test_right_recordings_pass_in_silence(seed: int, tmp_path: Path):
    case = make_case(robot="small", repeats=1, trajectories=1, seed=seed)
    (tmp_path / "robot.urdf").write_text(case.urdf)
    run = case.recordings[0]
    arrays = {"t": run["time"], "q": run["position"], "tau": run["torque"]}
    robot: dict[str, Any] = {"model": str(tmp_path / "robot.urdf"), "joints": list(case.joints)}
    entry = {"time": "t", "position": "q", "torque": "tau"}
    assert said(Base("run", robot, arrays, entry), None, tmp_path) == ("silent", "")


def test_a_gap_that_the_stamps_tell_is_no_jump(base: Base, tmp_path: Path):
    q = np.asarray(base.arrays["q"])
    joint = int(np.argmax(np.ptp(q[:, :2], axis=0)))
    first, last = sorted((int(np.argmin(q[:, joint])), int(np.argmax(q[:, joint]))))
    assert abs(q[last, joint] - q[first, joint]) > 1.0 and last - first < 0.6 * len(q)
    arrays = {key: np.delete(value, slice(first + 1, last), axis=0) for key, value in base.arrays.items()}
    what, text = said(Base("run", base.robot, arrays, base.entry, pair=base.pair), None, tmp_path)
    assert "jumps" not in text, (what, text)


def test_an_absolute_value_is_refused_as_a_torque(tmp_path: Path):
    """The size of the torques of an arm of three joints; the same without the rows near zero may be gravity's."""
    case = make_case(robot="small", repeats=1, trajectories=1, seed=2)
    (tmp_path / "robot.urdf").write_text(case.urdf)
    run = case.recordings[0]
    entry = {"time": "t", "position": "q", "torque": "tau"}
    robot: dict[str, Any] = {"model": str(tmp_path / "robot.urdf"), "joints": list(case.joints)}
    for more, refused in ((0.0, True), (20.0, False)):
        arrays = {"t": run["time"], "q": run["position"], "tau": np.abs(run["torque"]) + more}
        what, text = said(Base("run", robot, arrays, entry), None, tmp_path)
        assert (what == "refused" and "never changes its sign" in text) == refused, text


def test_millimetres_on_an_arm_without_slides_are_refused(tmp_path: Path):
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(_URDF)
    t = np.arange(400) / 100
    arrays = {"t": t, "q": np.sin(t)[:, None], "tau": np.cos(3 * t)[:, None]}
    entry = {"time": "t", "position": "q", "torque": "tau", "units": {"position": "mm"}}
    what, text = said(Base("run", {"model": str(urdf)}, arrays, entry), None, tmp_path)
    assert what == "refused" and "every joint of the robot turns" in text


_URDF = """<robot name="arm"><link name="base"/><link name="rod"><inertial><origin xyz="0.3 0 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="50" velocity="5"/></joint></robot>"""


def test_stamps_in_nanoseconds_are_read_with_their_unit(base: Base, tmp_path: Path):
    arrays = dict(base.arrays) | {"t": np.round(1.7e18 + base.arrays["t"] * 1e9).astype(np.int64)}
    entry = {**base.entry, "units": {"time": "ns"}}
    assert said(Base("run", base.robot, arrays, entry), None, tmp_path) == ("silent", "")


def test_a_warning_is_logged_and_returned_and_names_all_its_files(base: Base, tmp_path: Path, caplog):
    spoil, _ = KINDS["sign of one torque"]
    arrays = {key: np.array(value) for key, value in base.arrays.items()}
    spoil(base, arrays, dict(base.entry))
    data = ""
    for name in ("one", "two"):
        np.savez(tmp_path / f"{name}.npz", **arrays)  # pyright: ignore[reportArgumentType]
        data += f"  - {{file: {name}.npz, time: t, position: q, torque: tau}}\n"
    (tmp_path / "task.yaml").write_text(f"robot: {{model: {base.robot['model']}}}\ndata:\n{data}")
    task = load_task(tmp_path / "task.yaml")
    model = load_robot(task)
    with caplog.at_level(logging.WARNING, "figaroh_jax"):
        warnings = check_recordings(task, model, read_recordings(task, model))
    assert len(warnings) == 1 and warnings[0].startswith("check: one.npz, two.npz: ")
    assert [record.getMessage() for record in caplog.records] == list(warnings)


def test_recordings_that_all_stand_still_are_refused_together(base: Base, tmp_path: Path):
    still = {"t": base.arrays["t"], "q": 0 * base.arrays["q"] + 0.1, "tau": base.arrays["tau"]}
    np.savez(tmp_path / "still.npz", **still)
    np.savez(tmp_path / "moves.npz", **base.arrays)  # pyright: ignore[reportArgumentType]
    entry = "{file: %s.npz, time: t, position: q, torque: tau}"
    head = f"robot: {{model: {base.robot['model']}}}\ndata:\n"
    for names, refused in ((("still",), True), (("still", "moves"), False)):
        (tmp_path / "task.yaml").write_text(head + "".join(f"  - {entry % name}\n" for name in names))
        task = load_task(tmp_path / "task.yaml")
        model = load_robot(task)
        recordings = read_recordings(task, model)
        if refused:
            with pytest.raises(InputError, match="no joint moves"):
                check_recordings(task, model, recordings)
        else:
            check_recordings(task, model, recordings)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_the_clock_is_told_from_the_torque(factor: float, base: Base):
    model = load_urdf(base.robot["model"])
    from figaroh_jax.recordings.likeness import sampled

    arrays = base.arrays
    read = sampled(factor * arrays["t"], arrays["q"], arrays["tau"])
    assert read is not None
    stretch, error = stretch_of_time(model, read)
    assert stretch == pytest.approx(factor, rel=0.15) and error < 0.15


def test_torque_and_frames_without_jax_are_those_of_pinocchio(base: Base):
    path = base.robot["model"]
    model, other = load_urdf(path), pin.buildModelFromUrdf(path)
    rng = np.random.default_rng(0)
    q, v, a = rng.normal(size=(3, 20, model.nv))
    data = other.createData()
    expected = np.array([pin.rnea(other, data, *row).copy() for row in zip(q, v, a, strict=True)])
    np.testing.assert_allclose(rigid_torque(model, Sampled(q, v, a, None, 1.0)), expected, rtol=0, atol=1e-11)
    turned, origin = frame_poses(model, q, "ram")
    for k, row in enumerate(q):
        pin.framesForwardKinematics(other, data, row)
        pose = data.oMf[other.getFrameId("ram")]
        np.testing.assert_allclose(origin[k], pose.translation, rtol=0, atol=1e-12)
        np.testing.assert_allclose(turned[k], pose.rotation, rtol=0, atol=1e-12)


@pytest.mark.parametrize("job", [fj.diagnose, fj.identify])
def test_recordings_from_arrays_are_checked_too(job: Any):
    robot = load_urdf(fj.DEMO)
    t = np.arange(600) / 100.0
    q = 0.7 * np.sin(2 * np.pi * 0.5 * t[:, None] + np.arange(4))
    torque = np.asarray(fj.inverse_dynamics(robot, q, np.gradient(q, t, axis=0), np.zeros_like(q)))
    degrees = fj.recording(q=np.rad2deg(q), tau=torque, time=t)
    with pytest.raises(InputError, match=r"looks like degrees|look like degrees|deg"):
        job(robot, [degrees])
    still = fj.recording(q=np.broadcast_to(q[:1], q.shape), tau=torque, time=t)
    with pytest.raises(InputError, match="no joint moves"):
        job(robot, [still])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (None, ""),
        (lambda T: quaternions(T)[:, [0, 1, 2, 6, 3, 4, 5]], "refused: .*they do as w x y z, or transposed"),
        (quaternions, ""),
        (lambda T: T.transpose(0, 2, 1), r"refused: .*the last row of the matrix is .*the matrices are transposed"),
        (np.linalg.inv, "warned: .*they would with every pose inverted"),
        (lambda T: T.transpose(1, 2, 0), r"refused: .*the postures stand on its last axis; its shape is \(4, 4, 40\)"),
        (lambda T: T.reshape(-1, 4), r"refused: .*160 rows.*its matrices are stacked below each other"),
        (lambda T: np.concatenate(T, 1), r"refused: .*4 rows.*the postures stand on its last axis"),
        (
            lambda T: np.concatenate([np.concatenate([T[:, :3, :3].swapaxes(1, 2), T[:, :3, 3:]], 2), T[:, 3:]], 1),
            "refused: .*they do as w x y z, or transposed",
        ),
    ],
)
def test_poses_in_another_convention_are_told(spoil: Any, words: str, tmp_path: Path):
    """The angle between two quaternions is the same in any order of their numbers: the axes of rotations tell."""
    rng = np.random.default_rng(12)
    (tmp_path / "robot.urdf").write_text(poses.urdf())
    q, real = poses.postures(rng, 40), poses.truth(rng)
    there = np.array([pose.homogeneous for pose in poses.tool_poses(tmp_path / "robot.urdf", q, real)])
    measurement = {"pose": "T", "base_frame": "base", "tool_frame": "tool0", "unknown": ["base_frame", "tool_frame"]}
    arrays = {"q": q, "T": there if spoil is None else spoil(there)}
    entry = {"position": "q", "measurement": measurement}
    robot = {"model": str(tmp_path / "robot.urdf"), "joints": list(poses.JOINTS)}
    what, text = said(Base("run", robot, arrays, entry), None, tmp_path)
    assert (what == "silent") if not words else re.search(words, f"{what}: {text}"), (what, text)


@pytest.mark.parametrize("form", ["xyzw", "wxyz"])
def test_quaternions_in_another_order_are_told_where_the_robot_turns_little(form: str, tmp_path: Path):
    """Postures of a camera before one target, 0.1 rad apart: the wrong order is off by less than a wrong robot may."""
    rng = np.random.default_rng(12)
    (tmp_path / "robot.urdf").write_text(poses.urdf())
    q = np.array([0.2, -0.5, 0.4, 0.3, 0.8, -0.3]) + rng.uniform(-0.06, 0.06, (40, 6))
    real = poses.truth(rng, offset=np.array([0.0, 0.002, -0.001, 0.002, 0.001, 0.0]))
    seen = quaternions(np.array([pose.homogeneous for pose in poses.tool_poses(tmp_path / "robot.urdf", q, real)]))
    seen = seen if form == "xyzw" else seen[:, [0, 1, 2, 6, 3, 4, 5]]
    recording = fj.postures(q=q, pose=seen, base_frame="base", tool_frame="tool0")
    found = check_pose_recording(recording, load_urdf(tmp_path / "robot.urdf"))
    assert [finding.wrong for finding in found] == ([] if form == "xyzw" else [True])
    assert form == "xyzw" or "or add `orientation: wxyz`" in found[0].text


@pytest.mark.parametrize("factor", [1 / 7, 1000.0])
def test_a_torque_in_another_unit_is_not_told_as_a_wrong_clock_too(base: Base, factor: float, tmp_path: Path):
    arrays = base.arrays | {"tau": np.asarray(base.arrays["tau"]) * factor}
    what, text = said(Base("run", base.robot, arrays, base.entry, pair=base.pair), None, tmp_path)
    assert "times what the model needs" in text and "clock" not in text, (what, text)


def test_several_things_that_cannot_be_right_stay_apart_on_one_line(base: Base, tmp_path: Path):
    still = {key: np.full_like(base.arrays[key], 0.3) for key in ("q", "tau")}
    what, text = said(Base("run", base.robot, base.arrays | still, base.entry, pair=base.pair), None, tmp_path)
    assert what == "refused" and "; run.npz: no joint moves" in " ".join(text.split())


def test_arrays_are_checked_as_files_are(base: Base):
    """Positions in degrees and of another number of joints, wherever arrays of a recording go in."""
    robot = load_urdf(Path(base.robot["model"]))
    t, q, tau = (np.asarray(base.arrays[key]) for key in ("t", "q", "tau"))
    turns = np.array([joint.kind == "revolute" for joint in robot.joints])
    degrees = fj.recording(q=np.where(turns, np.rad2deg(q), q), tau=tau, time=t)
    with pytest.raises(InputError, match="cannot be right: .* degrees"):
        fj.torque_data(robot, degrees)
    few = fj.recording(q=q[:, :2], tau=tau[:, :2], time=t)
    for takes in (
        fj.torque_data,
        lambda model, one: fj.identify(model, [one]),
        lambda model, one: fj.diagnose(model, [one]),
    ):
        with pytest.raises(InputError, match="q has 2 columns, but robot .* has 3 numbers of position"):
            takes(robot, few)


def test_postures_of_arrays_are_checked_as_files_are(tmp_path: Path):
    (tmp_path / "robot.urdf").write_text(poses.urdf())
    robot, rng = load_urdf(tmp_path / "robot.urdf"), np.random.default_rng(0)
    q = poses.postures(rng, 30)
    seen = np.asarray(fj.frame_placement(robot, q, "tool0"))[:, :3, 3]
    frames: dict[str, Any] = {"base_frame": "base", "tool_frame": "tool0"}
    degrees = fj.postures(q=np.rad2deg(q), position=seen, **frames)
    calibrated, diagnosed = (lambda model, one, job=job: job(model, [one]) for job in (fj.calibrate, fj.diagnose))
    for takes in (fj.pose_data, calibrated, diagnosed):
        with pytest.raises(InputError, match="cannot be right: .* degrees"):
            takes(robot, degrees)
    with pytest.raises(InputError, match="they look like mm"):
        fj.calibrate(robot, [fj.postures(q=q, position=1e3 * seen, **frames)])


def test_a_rate_that_contradicts_the_stamps_beside_it_is_told(base: Base, tmp_path: Path):
    """Twice the rate of the file's own clock, whose column the task does not name; a counter of samples is no clock."""
    t = np.asarray(base.arrays["t"])
    right = 1 / float(np.median(np.diff(t)))
    notes = {}
    for name, rate, stamps in (
        ("twice", 2 * right, t), ("right", right, 1e3 * t), ("counted", 2 * right, np.arange(len(t)))
    ):  # fmt: skip
        np.savez(tmp_path / f"{name}.npz", time=stamps, q=base.arrays["q"], tau=base.arrays["tau"])
        entry = {"file": f"{tmp_path}/{name}.npz", "rate": rate, "position": "q", "torque": "tau"}
        task = load_task({"robot": base.robot, "data": [entry]})
        (recording,) = read_recordings(task, load_robot(task))
        notes[name] = recording.notes
    assert notes["right"] == notes["counted"] == ()
    assert re.search(
        r"twice.npz: rate is .* Hz, but the column 'time' runs at .* should the task say time: time in",
        notes["twice"][0],
    )
