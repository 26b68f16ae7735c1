"""Calibration of robots whose truth Pinocchio made, and of real ones: what it predicts, names, refuses and writes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import poses
import pytest
import yaml
from schema import matches

import figaroh_jax as fj
from figaroh_jax import cli
from figaroh_jax.calibration.calibrated import Calibration
from figaroh_jax.calibration.calibration import calibrate_task
from figaroh_jax.calibration.kinematic_diagnosis import diagnose_poses
from figaroh_jax.effects.kinematic import CATALOGUE
from figaroh_jax.formats.config import load_task
from figaroh_jax.recordings.posture_checks import OFF, check_pose_recording
from figaroh_jax.reporting.calibration_files import write_calibration
from figaroh_jax.reporting.calibration_report import nominal_of
from figaroh_jax.reporting.picture import segments
from figaroh_jax.reporting.terminal import show_calibration
from figaroh_jax.reporting.verification import DEFAULT_LIMITS

OFFSET = np.array([0.01, -0.03, 0.05, 0.04, -0.06, 0.02])
BAD_ROW = 17


def write(folder: Path, q: np.ndarray, points: np.ndarray, **measurement: Any) -> Path:
    """A task of one recording of points."""
    (folder / "robot.urdf").write_text(poses.urdf())
    np.savez(folder / "postures.npz", q=q, points=points)
    known = {"position": "points", "base_frame": "base", "tool_frame": "tool0"}
    entry = {"file": "postures.npz", "position": "q", "measurement": known | {"unknown": ["base_frame", "tool_frame"]}}
    entry["measurement"] |= measurement
    task = folder / "task.yaml"
    task.write_text(yaml.safe_dump({"robot": {"model": "robot.urdf"}, "data": [entry]}))
    return task


def recorded(folder: Path, rng: np.random.Generator, real: poses.Truth, bad: int | None = None) -> Path:
    (folder / "robot.urdf").write_text(poses.urdf())
    q = poses.postures(rng, 40)
    points = poses.points(poses.tool_poses(folder / "robot.urdf", q, real), real, rng)
    if bad is not None:
        points[bad] += [0.0, 0.02, -0.01]
    return write(folder, q, points)


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, poses.Truth]:
    """A robot with wrong offsets and a soft second joint, one posture measured badly."""
    folder = tmp_path_factory.mktemp("wrong")
    rng = np.random.default_rng(11)
    twists = {"j3": np.array([5e-4, -3e-4, 2e-4, 1e-3, -8e-4, 0.0])}
    real = poses.truth(rng, offset=OFFSET, twists=twists, compliance=np.array([0.0, 2e-4, 0, 0, 0, 0]))
    return recorded(folder, rng, real, BAD_ROW), real


@pytest.fixture(scope="module")
def calibrated(wrong: tuple[Path, poses.Truth]) -> Calibration:
    return calibrate_task(load_task(wrong[0]))


def test_offsets_and_compliance_are_found_and_named(calibrated: Calibration):
    found = {p.name: p for p in calibrated.parameters}
    for joint in range(1, 5):
        p = found[f"joint_offset j{joint + 1}"]
        assert p.status == "identified"
        assert abs(p.value - OFFSET[joint]) < max(3.0 * p.std, 2e-4), p
    causes = {str(cause.name): cause for cause in calibrated.causes}
    assert calibrated.verdict == "named"
    assert {f"joint_offset (j{k})" for k in (2, 3, 4, 5)} <= set(causes)
    soft = causes["joint_compliance (j2)"].parameters["compliance"]
    assert abs(soft.value - 2e-4) < 4.0 * soft.std
    assert {cause.name.effect for cause in calibrated.causes} == {"outlier", "joint_offset", "joint_compliance"}


def test_a_joint_whose_name_has_spaces_is_one_joint(tmp_path: Path):
    rng = np.random.default_rng(3)
    task = recorded(tmp_path, rng, poses.truth(rng, offset=OFFSET))
    robot = tmp_path / "robot.urdf"
    robot.write_text(robot.read_text().replace('"j5"', '"wrist axis 5"'))
    offsets = [c.name.at for c in calibrate_task(load_task(task)).causes if c.name.effect == "joint_offset"]
    assert ("wrist axis 5",) in offsets


def test_a_calibration_is_a_view_of_its_fit(calibrated: Calibration):
    """Numbers, their sigmas and the rows of its data are those of the public residual of its model."""
    fit = calibrated.solution
    for one in calibrated.parameters:
        assert fit.parameters[one.name][:2] == pytest.approx((one.value, one.std), rel=1e-12, abs=1e-15)
    assert fit.model.robot is calibrated.model and not fit.reason
    assert [effect.name for effect in fit.model.effects] == ["joint_compliance"]
    stiff = fj.extend(fit.model.robot)
    theirs, ours, without = (np.sqrt(np.mean(np.asarray(x) ** 2)) for x in (fit.rows, *(fj.residual(m, fit.data) for m in (fit.model, stiff))))  # fmt: skip  # noqa: E501
    # the calibration takes gravity as the nominal robot has it, the residual as the corrected one does
    assert ours == pytest.approx(theirs, rel=0.3) and without > 3.0 * ours


def test_offsets_of_the_first_and_the_last_joint_are_a_gauge(calibrated: Calibration):
    status = {p.name: p.status for p in calibrated.parameters}
    assert status["joint_offset j1"] == status["joint_offset j6"] == "gauge"
    classes = {names[0]: names[1:] for names in calibrated.classes}
    assert any(name.startswith("base_frame") for name in classes["joint_offset j1"])
    assert any(name.startswith("tool_frame") for name in classes["joint_offset j6"])
    soft = sum(cause.name.effect == "joint_compliance" for cause in calibrated.causes)
    assert calibrated.rank == (4 * 6 + 6) + 3 + soft  # 4 n + 6 with a 6-D tool; three numbers more for three markers


def test_the_badly_measured_posture_is_named_and_left_out(calibrated: Calibration):
    assert [(o.file, o.row) for o in calibrated.outliers] == [("postures.npz", BAD_ROW)]


def test_calibrated_robot_predicts_postures_it_has_not_seen(calibrated: Calibration, wrong: tuple[Path, poses.Truth]):
    from figaroh_jax.estimation.gravity import gravity_moments
    from figaroh_jax.rigid.kinematics import frame_placement

    task, real = wrong
    q = poses.postures(np.random.default_rng(12), 50)
    truth = np.array([pose.act(real.markers[0]) for pose in poses.tool_poses(task.parent / "robot.urdf", q, real)])
    soft = next(p for p in calibrated.parameters if p.name == "joint_compliance j2").value
    sag = soft * np.asarray(gravity_moments(calibrated.model, q)[0])[:, 1]
    tool = np.asarray(frame_placement(calibrated.model, q + sag[:, None] * np.eye(6)[1], "tool0"))
    whole = calibrated.frames["base_frame"] @ tool
    predicted = whole[:, :3, :3] @ calibrated.frames["tool_frame"][0] + whole[:, :3, 3]
    error = np.sqrt(np.mean(np.sum((predicted - truth) ** 2, axis=1)))
    assert error < 1.5e-4  # the noise of one point is 1.7e-4
    assert calibrated.position is not None and calibrated.orientation is None
    assert calibrated.position.validated_after < 0.25 < 20.0 < calibrated.position.validated_before
    assert calibrated.converged


def test_the_terminal_says_the_level(calibrated: Calibration, capsys: Any):
    show_calibration(calibrated)
    assert "full geometry" in capsys.readouterr().out


def test_run_directory_holds_what_the_contract_asks(wrong: tuple[Path, poses.Truth], tmp_path: Path, capsys: Any):
    out = tmp_path / "run"
    assert cli.main(["calibrate", str(wrong[0]), "--out", str(out), "--quiet", "--json"]) == 0
    result = json.loads((out / "result.json").read_text())
    matches("calibrate", result)
    assert result.pop("fk_parity") < 1e-9  # of the written model, so in the file alone
    assert result == json.loads(capsys.readouterr().out)
    assert result["level"] == "full" and result["orientation"] is None and result["verdict"] == "named"
    assert result["outliers"] == [{"file": "postures.npz", "row": BAD_ROW}]
    assert set(result["position"]) == {"unit", "before", "after", "validated_before", "validated_after"}
    assert {"name", "value", "std", "unit", "status"} == set(result["parameters"][0])
    assert "plotly" in (out / "report.html").read_text().lower()
    robot = pin.buildModelFromUrdf(str(out / "model" / "robot.urdf"))
    placed = robot.jointPlacements[robot.getJointId("j3")]
    corrections = yaml.safe_load((out / "model" / "calibration.yaml").read_text())
    twist = np.array(corrections["placements"]["j3"])
    nominal = pin.buildModelFromUrdf(str(wrong[0].parent / "robot.urdf")).jointPlacements[3]
    np.testing.assert_allclose(placed, nominal * pin.SE3(pin.exp3(twist[3:]), twist[:3]), rtol=0, atol=1e-12)
    changes = yaml.safe_load((out / "model" / "master_calibration.yaml").read_text())
    changes = changes["robot_state_publisher"]["geometric_calibration"]
    for name, xyz, rpy, *_ in poses._CHAIN:  # added to the origins as they are written
        p, r = (
            np.array(text.split(), float) + [changes.get(f"{name}_{key}", 0.0) for key in keys]
            for text, keys in ((xyz, ("dx", "dy", "dz")), (rpy, ("droll", "dpitch", "dyaw")))
        )
        moved = robot.jointPlacements[robot.getJointId(name)]
        np.testing.assert_allclose(pin.SE3(pin.rpy.rpyToMatrix(*r), p), moved, rtol=0, atol=1e-12)
    assert {q["axis"] for q in result["quality"]} == {"x", "y", "z"}
    assert all(q["rmse"] < 0.2 < 1.0 < q["before"] and 0.999 < q["r2"] < 1.0 for q in result["quality"])
    assert all(abs(pair["value"]) <= 1.0 and pair["one"] != pair["other"] for pair in result["correlations"])


def test_the_level_that_is_asked_for_is_the_one_that_is_fitted(
    wrong: tuple[Path, poses.Truth], tmp_path: Path, capsys: Any
):
    task, out = str(wrong[0]), str(tmp_path / "run")
    assert cli.main(["calibrate", task, "--out", out, "--quiet", "--json", "--level", "joint_offset"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["level"] == "joint_offset"
    assert {p["name"].split()[0] for p in result["parameters"]} == {"joint_offset", "base_frame", "tool_frame"}
    assert cli.main(["calibrate", task, "--out", out, "--quiet", "--level", "offset"]) == 2
    assert "no level 'offset' of calibration; did you mean 'joint_offset'?" in capsys.readouterr().err


def test_the_nominal_robot_is_that_before_the_corrections(calibrated: Calibration, wrong: tuple[Path, poses.Truth]):
    robot = pin.buildModelFromUrdf(str(wrong[0].parent / "robot.urdf"))
    q, data = poses.postures(np.random.default_rng(3), 1)[0], robot.createData()
    pin.forwardKinematics(robot, data, q)
    tips = np.array([data.oMi[k].translation for k in range(1, 7)])
    np.testing.assert_allclose(segments(nominal_of(calibrated), q)[:, 1], tips, rtol=0, atol=1e-12)
    assert np.abs(segments(calibrated.model, q)[:, 1] - tips).max() > 1e-3


def test_a_robot_that_is_already_good_gets_nothing(tmp_path: Path):
    rng = np.random.default_rng(13)
    found = calibrate_task(load_task(recorded(tmp_path, rng, poses.truth(rng))))
    assert (found.level, found.verdict, found.causes, found.outliers) == ("frames", "nothing", (), ())
    assert found.position is not None
    assert found.position.validated_after == found.position.validated_before


def test_moments_that_no_body_can_have_are_told_and_kept(tmp_path: Path):
    """Postures ask for none: the model is as without them, its URDF keeps them, torques refuse the file."""
    rng = np.random.default_rng(3)
    task = recorded(tmp_path, rng, poses.truth(rng))
    sound = (tmp_path / "robot.urdf").read_text()
    (tmp_path / "robot.urdf").write_text(sound.replace('ixx="0.06"', 'ixx="-0.06"'))
    found = calibrate_task(load_task(task), level="frames")
    (note,) = (note for note in found.notes if "robot.urdf: link 'link_j3'" in note)
    assert "negative principal moment, -0.06 kg m^2" in note and "tasks of torques refuse the file" in note
    (tmp_path / "run").mkdir()
    write_calibration(found, tmp_path / "run", tmp_path / "robot.urdf")
    assert 'ixx="-0.06"' in (tmp_path / "run" / "model" / "robot.urdf").read_text()
    with pytest.raises(fj.InputError, match="'link_j3': its inertia has a negative principal moment"):
        fj.load_urdf(tmp_path / "robot.urdf")


def spoil(key: str, value: Any) -> Any:
    def change(keys: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        keys["data"][0]["measurement"][key] = value

    return change


def nan_in_a_point(keys: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    arrays["points"][4, 1, 2] = np.nan


def wrong_shape(keys: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    arrays["points"] = arrays["points"][..., :2]


def too_few(keys: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    arrays["points"], arrays["q"] = arrays["points"][:4], arrays["q"][:4]


def short(keys: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    arrays["points"] = arrays["points"][:-1]


def no_measurement(keys: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    del keys["data"][0]["measurement"]
    keys["data"][0]["rate"] = 1.0


def no_pose(keys: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    keys["data"][0]["measurement"] |= {"pose": "points"}
    del keys["data"][0]["measurement"]["position"]
    arrays["points"] = np.tile(2.0 * np.eye(4), (len(arrays["q"]), 1, 1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (spoil("tool_frame", "tool"), "data[0].measurement.tool_frame: robot 'arm6' has no frame 'tool'; did you mean"),
        (spoil("base_frame", "tool0"), "no joint moves tool_frame 'tool0' against base_frame 'tool0'"),
        (spoil("tool_frame", None), "data[0].measurement.tool_frame is missing"),
        (spoil("position", "spoints"), "no array 'spoints' (data[0].measurement.position); did you mean 'points'?"),
        (nan_in_a_point, "row 4 (from 0): point 1 is"),
        (wrong_shape, "expected (postures, 3) or (postures, markers, 3)"),
        (short, "has 39 rows, but position has 40"),
        (too_few, "4 measured postures give 36 numbers for 15 unknowns"),
        (no_measurement, "data[0] has no `measurement`"),
        (no_pose, "row 0 (from 0): the orientation is no rotation matrix"),
    ],
)
def test_wrong_measurements_are_refused_with_what_would_be_right(
    change: Any, message: str, tmp_path: Path, capsys: Any
):
    rng = np.random.default_rng(14)
    task = write(tmp_path, poses.postures(rng, 40), rng.normal(size=(40, 3, 3)))
    keys = yaml.safe_load(task.read_text())
    arrays = dict(np.load(tmp_path / "postures.npz"))
    change(keys, arrays)
    np.savez(tmp_path / "postures.npz", **arrays)  # pyright: ignore[reportArgumentType]
    task.write_text(yaml.safe_dump(keys))
    assert cli.main(["calibrate", str(task), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_no_error_is_said_to_fall_that_does_not(tmp_path: Path, capsys: Any):
    """Poses that are inverted follow no posture: no level predicts postures better."""
    rng = np.random.default_rng(5)
    q, real = poses.postures(rng, 40), poses.truth(rng, offset=np.array([0, 0.02, -0.03, 0, 0, 0]))
    (tmp_path / "robot.urdf").write_text(poses.urdf())
    there = np.array([pose.inverse().homogeneous for pose in poses.tool_poses(tmp_path / "robot.urdf", q, real)])
    np.savez(tmp_path / "run.npz", q=q, T=there)
    measurement = "{pose: T, base_frame: base, tool_frame: tool0, unknown: [base_frame, tool_frame]}"
    (tmp_path / "task.yaml").write_text(
        f"robot: {{model: robot.urdf}}\ndata: [{{file: run.npz, position: q, measurement: {measurement}}}]\n"
    )
    said = {}
    for level in ("joint_offset", "frames"):
        command = [
            "calibrate",
            str(tmp_path / "task.yaml"),
            "--level",
            level,
            "--out",
            str(tmp_path / level),
            "--quiet",
        ]
        assert cli.main(command) == 0
        said[level] = " ".join(capsys.readouterr().out.split())
        told = json.loads((tmp_path / level / "result.json").read_text())["position"]
        falls = told["validated_after"] < told["validated_before"]
        assert ("falls from" in said[level]) == (falls and level != "frames"), (said[level], told)


def test_a_level_whose_effects_go_again_gives_way_to_the_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Beside its effects it predicts better than the frames, by itself it does not, and no fold finds them again."""
    rng = np.random.default_rng(3)
    (tmp_path / "robot.urdf").write_text(poses.urdf())
    q, real = poses.postures(rng, 15), poses.truth(rng, offset=OFFSET, compliance=np.array([0.0, 2e-3, 0, 0, 0, 0]))
    points = poses.points(poses.tool_poses(tmp_path / "robot.urdf", q, real), real, rng)
    recording = fj.postures(q=q, position=points, base_frame="base", tool_frame="tool0")
    kept = ("joint_offset", "link_geometry", "joint_compliance")
    for name, answer in (("_better", lambda folds, one, others, other: one == "chosen"), ("_recurring", lambda *_: [])):
        monkeypatch.setattr(f"figaroh_jax.calibration.calibration.{name}", answer)
    forbid = [name for name in CATALOGUE if name not in kept]
    found = fj.calibrate(fj.load_urdf(tmp_path / "robot.urdf"), [recording], forbid=forbid)
    assert found.level == "frames" and found.position is not None
    assert found.position.validated_after == found.position.validated_before


def test_a_joint_that_is_counted_with_the_one_before_it_is_told_and_nothing_else_named(tmp_path: Path):
    """The forearm's angle against the upper arm's, as of a Fanuc: the check says what to write, and that is right."""
    rng = np.random.default_rng(6)
    (tmp_path / "robot.urdf").write_text(poses.urdf())
    q, real = poses.postures(rng, 25), poses.truth(rng)
    points = poses.points(poses.tool_poses(tmp_path / "robot.urdf", q, real), real, rng)
    rows = np.eye(6)
    rows[2, 1] = -1.0
    model = fj.load_urdf(tmp_path / "robot.urdf")
    seen = fj.postures(q=q @ rows.T, position=points, base_frame="base", tool_frame="tool0")
    (told,) = check_pose_recording(seen, model)
    assert "with j3 + j2 as the angle of j3" in told.text and "position is [0, -1, 1, 0, 0, 0]" in told.text
    found = diagnose_poses(model, [seen], forbid=[name for name in CATALOGUE if name != "joint_offset"])
    assert found.calibration.contradicted and (found.verdict, found.causes) == ("unknown", ())


def placed(folder: Path, unknown: list[str], base: pin.SE3, markers: int = 1) -> Path:
    """A task of postures of the robot as its URDF is, measured by a device at `base`, with `unknown` as stated."""
    rng = np.random.default_rng(3)
    real = poses.truth(rng, markers=markers)._replace(base=base)
    (folder / "robot.urdf").write_text(poses.urdf())
    q = poses.postures(rng, 40)
    points = poses.points(poses.tool_poses(folder / "robot.urdf", q, real), real, rng)
    return write(folder, q, points, unknown=unknown)


def test_a_device_that_stands_elsewhere_than_stated_is_told(tmp_path: Path, capsys):
    """0.8 m beside the base and taken as known: a warning with the key that is missing, and no calibration of it."""
    beside = pin.SE3(np.eye(3), np.array([0.8, 0.0, 0.1]))
    task = placed(tmp_path, ["tool_frame"], beside)
    assert cli.main(["calibrate", str(task), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    (note,) = (note for note in result["notes"] if "base_frame 'base' taken as exactly known" in note)
    assert "measurement.unknown: [base_frame, tool_frame]" in note
    doubtful = result["unexplained"] > 0.12
    for text in (capsys.readouterr().out, (tmp_path / "run" / "report.html").read_text()):
        assert ("Do not use this model" in " ".join(text.split())) == doubtful
    task = placed(tmp_path, ["base_frame", "tool_frame"], beside)
    assert cli.main(["calibrate", str(task), "--out", str(tmp_path / "right"), "--quiet"]) == 0
    assert json.loads((tmp_path / "right" / "result.json").read_text())["notes"] == []
    assert "Do not use" not in capsys.readouterr().out


def test_postures_that_belong_to_other_measurements_give_no_model_to_use(tmp_path: Path, capsys):
    """Rows in another order: terminal, report and result.json say how much of the points' spread is left."""
    task = placed(tmp_path, ["base_frame", "tool_frame"], pin.SE3.Identity())
    with np.load(tmp_path / "postures.npz") as file:
        q, points = file["q"], file["points"]
    np.savez(tmp_path / "postures.npz", q=q, points=points[np.random.default_rng(0).permutation(len(q))])
    assert cli.main(["calibrate", str(task), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    assert "Do not use this model" in " ".join(capsys.readouterr().out.split())
    assert "Do not use this model" in (tmp_path / "run" / "report.html").read_text()
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    spread = np.sqrt((np.std(points[:, 0], axis=0) ** 2).sum())
    with pytest.raises(fj.InputError, match=r"that of a calibration, .* robot\.urdf by load_urdf"):
        fj.load_model(tmp_path / "run" / "model")
    assert result["unexplained"] == pytest.approx(1e-3 * result["position"]["validated_after"] / spread, rel=1e-6)
    assert DEFAULT_LIMITS["unexplained"] == OFF
    assert cli.main(["verify", str(tmp_path / "run")]) == 1
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "unexplained" in line)
    assert line.startswith("fail")


def test_frames_that_are_swapped_are_one_message_before_any_work(wrong: tuple[Path, poses.Truth], tmp_path: Path):
    keys = yaml.safe_load(wrong[0].read_text())
    keys["data"][0]["measurement"] |= {"base_frame": "tool0", "tool_frame": "base"}
    keys["data"][0]["file"] = str(wrong[0].parent / "postures.npz")
    keys["robot"]["model"] = str(wrong[0].parent / "robot.urdf")
    (tmp_path / "task.yaml").write_text(yaml.safe_dump(keys))
    with pytest.raises(fj.InputError, match=r"task\.yaml: data\[0\]\.measurement: .*; are the two swapped\?"):
        calibrate_task(load_task(tmp_path / "task.yaml"))


@pytest.mark.parametrize(
    ("offset", "count", "said"),
    [
        ([0, 0.006, -0.009, 0.004, 0.012, 0], 8, "predicts surely better than .* which these postures are too few"),
        ([0, 0.002, -0.002, 0, 0, 0], 60, "no error of its kinematics that is surely beyond the tolerance .p = 0"),
        ([0, 0, 0, 0, 0, 0], 40, "no error of its kinematics beyond the tolerance. No correction .* predicts better"),
    ],
)
def test_what_is_not_sure_is_not_said_to_be_absent(tmp_path: Path, capsys: Any, offset: list, count: int, said: str):
    rng = np.random.default_rng(5)
    real = poses.truth(rng, markers=1, offset=np.array(offset))
    (tmp_path / "robot.urdf").write_text(poses.urdf())
    q = poses.postures(rng, count)
    points = poses.points(poses.tool_poses(tmp_path / "robot.urdf", q, real), real, rng, noise=3e-5)
    task = write(tmp_path, q, points[:, 0] if points.ndim == 3 else points)
    assert cli.main(["diagnose", str(task), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    assert re.search(said, " ".join(capsys.readouterr().out.split()))
