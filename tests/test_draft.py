"""`figaroh-jax new`: a draft reads the recording as it was made, or refuses; nothing wrong in silence."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from generators import make_case

import figaroh_jax as fj
from figaroh_jax import cli
from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.robotfile import load_robot
from figaroh_jax.recordings.checks import check_recordings
from figaroh_jax.recordings.dataset import read_recordings
from figaroh_jax.recordings.draft import draft_task
from figaroh_jax.recordings.draft_columns import Undecided
from figaroh_jax.recordings.poses import read_pose_recordings


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[str, ...], list[dict[str, Any]]]:
    case = make_case(robot="small", repeats=2, trajectories=2, seed=4)
    urdf = tmp_path_factory.mktemp("robot") / "robot.urdf"
    urdf.write_text(case.urdf)
    return urdf, case.joints, list(case.recordings)


def table(path: Path, columns: dict[str, np.ndarray]) -> Path:
    np.savetxt(path, np.column_stack(list(columns.values())), "%.12g", ",", header=",".join(columns), comments="")
    return path


def read_back(draft: str, folder: Path):
    file = folder / "task.yaml"
    file.write_text(draft)
    task = load_task(file)
    model = load_robot(task)
    return task, model, read_recordings(task, model)


def test_columns_named_in_any_order_unit_and_clock_are_read_right(made, tmp_path: Path):
    urdf, joints, (run, *_) = made
    rng = np.random.default_rng(3)
    columns = {f"{joint}/position": run["position"][:, j] for j, joint in enumerate(joints)}
    columns |= {f"effort.{joint}": run["torque"][:, j] for j, joint in enumerate(joints)}
    names = list(columns)
    rng.shuffle(names)
    shuffled = {"stamp": np.round(run["time"] * 1e9) + 5e12, **{name: columns[name] for name in names}}
    draft = draft_task(urdf, [table(tmp_path / "run.csv", shuffled)])
    task, model, (recording,) = read_back(draft.text, tmp_path)
    assert task.data[0].units.time == "ns"
    np.testing.assert_allclose(recording.position, run["position"], rtol=0, atol=1e-9)
    assert recording.torque is not None
    np.testing.assert_allclose(recording.torque, run["torque"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.diff(recording.time), np.diff(run["time"]), rtol=0, atol=1e-6)


def test_degrees_and_a_turned_sign_are_found(made, tmp_path: Path):
    urdf, joints, (run, *_) = made
    turning = np.array([True, True, False])
    sign = np.array([1.0, -1.0, 1.0])
    arrays = {"t": run["time"], "q": np.where(turning, np.rad2deg(run["position"]), run["position"])}
    np.savez(tmp_path / "run.npz", **arrays, tau=run["torque"] * sign)
    draft = draft_task(urdf, [tmp_path / "run.npz"])
    _, _, (recording,) = read_back(draft.text, tmp_path)
    np.testing.assert_allclose(recording.position, run["position"], rtol=0, atol=1e-9)
    assert recording.torque is not None
    np.testing.assert_allclose(recording.torque, run["torque"], rtol=0, atol=1e-9)
    assert any("opposite sign" in line for line in draft.assumed)


def test_rad_that_lie_outside_a_limit_are_no_degrees(made, tmp_path: Path):
    """Degrees fit every limit where the motion in rad nearly does; a zero offset (or a swap) is what is wrong."""
    urdf, joints, (run, *_) = made
    limit = np.asarray(fj.load_urdf(urdf).position_limit)[0]
    q = run["position"].copy()
    q[:, 0] += limit[1] + 0.3 * np.ptp(limit) - q[:, 0].max()
    np.savez(tmp_path / "run.npz", t=run["time"], q=q, tau=run["torque"])
    with pytest.raises(Undecided, match=f"rad or degrees. In rad, position of {joints[0]} lies outside") as told:
        draft_task(urdf, [tmp_path / "run.npz"])
    assert told.value.option == "unit"
    np.savez(tmp_path / "run.npz", t=run["time"], q=np.rad2deg(q) * [1, 1, np.deg2rad(1)], tau=run["torque"])
    with pytest.raises(InputError, match="in no unit do the positions fit"):
        draft_task(urdf, [tmp_path / "run.npz"])


def test_repeats_share_a_label(made, tmp_path: Path):
    urdf, _, runs = made
    files = []
    for run in runs:
        files.append(tmp_path / f"{run['name']}.npz")
        np.savez(files[-1], t=run["time"], q=run["position"], tau=run["torque"])
    draft = draft_task(urdf, files)
    labels = [entry.get("repeat") for entry in yaml.safe_load(draft.text)["data"]]
    assert labels[0] == labels[1] != labels[2] == labels[3]
    for pair in (files[:2], files[2:4]):
        assert any(f"{pair[0]} and {pair[1]} repeat one motion" in line for line in draft.assumed)


def test_swapped_columns_without_names_are_refused(made, tmp_path: Path):
    urdf, _, (run, *_) = made
    np.savez(tmp_path / "run.npz", t=run["time"], q=run["position"], tau=run["torque"][:, [1, 0, 2]])
    with pytest.raises(InputError, match="order"):
        draft_task(urdf, [tmp_path / "run.npz"])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"q": None}, "no column looks like a position"),
        ({"t": None}, "which column is the time"),
        ({"q": np.ones((2500, 2))}, "2 columns of position, but the robot has 3 joints"),
    ],
)
def test_what_cannot_be_decided_is_refused(made, change: dict[str, Any], said: str, tmp_path: Path):
    urdf, _, (run, *_) = made
    arrays = {"t": run["time"], "q": run["position"], "tau": run["torque"]} | change
    np.savez(tmp_path / "run.npz", **{key: value for key, value in arrays.items() if value is not None})
    with pytest.raises(InputError, match=said):
        draft_task(urdf, [tmp_path / "run.npz"])


def test_the_command_writes_a_draft_and_replaces_nothing(made, tmp_path: Path, capsys):
    urdf, _, (run, *_) = made
    np.savez(tmp_path / "run.npz", t=run["time"], q=run["position"], tau=run["torque"])
    out = tmp_path / "task.yaml"
    command = ["new", str(urdf), str(tmp_path / "run.npz"), "--out", str(out)]
    assert cli.main(command) == 0
    assert "assumed:" in capsys.readouterr().out
    load_task(out)
    assert cli.main(command) == 2
    assert "exists already" in capsys.readouterr().err


def test_a_draft_says_that_constant_torques_and_gains_are_no_finding(made, tmp_path: Path):
    """A baseline with an offset takes it in without a word, and `gains: known` a gain that is off."""
    urdf, _, (run, *_) = made
    np.savez(tmp_path / "run.npz", t=run["time"], q=run["position"], tau=run["torque"], cmd=run["position"])
    draft = draft_task(urdf, [tmp_path / "run.npz"])
    assert yaml.safe_load(draft.text)["baseline"]["offset"] is True
    said = next(line for line in draft.assumed if "constant torque" in line)
    assert "`offset: false`" in said and said in draft.text
    np.savez(tmp_path / "run.npz", t=run["time"], q=run["position"], cmd=run["position"])
    draft = draft_task(urdf, [tmp_path / "run.npz"], gains=[9.0, 8.0, 7.0])
    assert any("actuator.gains: known" in line for line in draft.assumed)
    assert not any("constant torque" in line for line in draft.assumed)


def test_a_draft_names_files_of_its_folder_from_there_and_letters_as_they_are(made, tmp_path: Path, capsys):
    """The folder can move, and a name in any script can be read."""
    urdf, _, (run, *_) = made
    home, away = tmp_path / "messung", tmp_path / "anderswo"
    (home / "daten").mkdir(parents=True)
    (home / "robot é.urdf").write_text(urdf.read_text())
    for file in (home / "daten" / "schulter λ.npz", away.with_suffix(".npz")):
        np.savez(file, t=run["time"], q=run["position"], tau=run["torque"])
    files = [home / "robot é.urdf", home / "daten" / "schulter λ.npz", away.with_suffix(".npz")]
    assert cli.main(["new", *map(str, files), "--out", str(home / "task.yaml")]) == 0
    text = (home / "task.yaml").read_text(encoding="utf-8")
    keys = yaml.safe_load(text)
    assert keys["robot"]["model"] == "robot é.urdf" in text and "daten/schulter λ.npz" in text
    assert [entry["file"] for entry in keys["data"]] == ["daten/schulter λ.npz", str(away.with_suffix(".npz"))]
    home.rename(away)
    task = load_task(away / "task.yaml")
    assert len(read_recordings(task, load_robot(task))) == 2
    capsys.readouterr()
    assert cli.main(["new", *map(str, (urdf, files[-1]))]) == 0  # printed, it may be put anywhere
    assert yaml.safe_load(capsys.readouterr().out)["robot"]["model"] == str(urdf)


def test_a_plain_list_of_constants_is_a_diagonal(made, tmp_path: Path):
    urdf, _, (run, *_) = made
    np.savez(tmp_path / "run.npz", t=run["time"], q=run["position"], current=run["torque"] / [2.0, 4.0, 5.0])
    draft = draft_task(urdf, [tmp_path / "run.npz"], constants=[2.0, 4.0, 5.0])
    task, _, (recording,) = read_back(draft.text, tmp_path)
    assert "torque: [2.0, 4.0, 5.0]" in draft.text and task.data[0].units.torque == "A"
    assert recording.torque is not None
    np.testing.assert_allclose(recording.torque, run["torque"], rtol=0, atol=1e-9)


def test_a_recording_of_matlab_is_read_like_any_other(made, tmp_path: Path):
    from scipy.io import savemat

    urdf, _, (run, *_) = made
    arrays = {"t": run["time"][None], "q": run["position"], "tau": run["torque"], "note": "a text"}
    savemat(tmp_path / "run.mat", arrays)
    _, _, (recording,) = read_back(draft_task(urdf, [tmp_path / "run.mat"]).text, tmp_path)
    np.testing.assert_allclose(recording.position, run["position"], rtol=0, atol=1e-12)
    (tmp_path / "bad.mat").write_bytes((tmp_path / "run.mat").read_bytes()[:3000])
    with pytest.raises(InputError, match="bad.mat"):
        draft_task(urdf, [tmp_path / "bad.mat"])


def test_positions_of_motors_ask_for_gears(made, tmp_path: Path):
    urdf, _, (run, *_) = made
    gears = np.array([50.0, -80.0, 200.0])
    np.savez(tmp_path / "run.npz", t=run["time"], motor_position=run["position"] * gears, tau=run["torque"])
    with pytest.raises(Undecided, match="named after motors: give --gears"):
        draft_task(urdf, [tmp_path / "run.npz"])
    draft = draft_task(urdf, [tmp_path / "run.npz"], gears=[*gears])
    _, _, (recording,) = read_back(draft.text, tmp_path)
    np.testing.assert_allclose(recording.position, run["position"], rtol=0, atol=1e-12)
    assert any("coupled" in line for line in draft.assumed)


def test_a_torque_that_the_model_does_not_bear_out_is_taken_where_the_user_says_so(made, tmp_path: Path):
    """A real drive's friction may hide gravity: refused, until signs and constants are stated."""
    urdf, _, (run, *_) = made
    noise = np.random.default_rng(1).normal(size=run["torque"].shape)
    np.savez(tmp_path / "run.npz", t=run["time"], q=run["position"], tau=noise)
    with pytest.raises(Undecided, match="does not follow what the model needs") as caught:
        draft_task(urdf, [tmp_path / "run.npz"])
    assert caught.value.option == "constants"
    draft = draft_task(urdf, [tmp_path / "run.npz"], constants=[1.0, 1.0, 1.0])
    assert any("nothing confirms them" in line for line in draft.assumed)
    assert read_back(draft.text, tmp_path)[2][0].torque is not None


def test_a_torque_without_sign_is_left_out_beside_a_command(made, tmp_path: Path):
    urdf, _, (run, *_) = made
    arrays = {"t": run["time"], "q": run["position"], "command": run["position"]}
    np.savez(tmp_path / "run.npz", **arrays, torque_abs=np.abs(run["torque"]))
    draft = draft_task(urdf, [tmp_path / "run.npz"], gains=[9.0, 8.0, 7.0])
    assert yaml.safe_load(draft.text)["data"][0].keys() >= {"command"} and "torque_abs:" not in draft.text
    assert any("torque_abs never changes its sign" in line for line in draft.assumed)


def test_measured_postures_are_told_what_to_write(made, tmp_path: Path):
    urdf, joints, (run, *_) = made
    points = np.random.default_rng(0).normal(size=(30, 3))
    columns = {f"{axis}1": points[:, k] for k, axis in enumerate("xyz")}
    columns |= {joint: run["position"][:30, j] for j, joint in enumerate(joints)}
    with pytest.raises(InputError, match="a task for `calibrate`") as caught:
        draft_task(urdf, [table(tmp_path / "postures.csv", columns)])
    shown = " ".join(str(caught.value).split()).partition("The task is ")[2].partition(" where MODEL")[0]  # as shown
    shown = shown.replace("MODEL", str(urdf)).replace("BASE", "base").replace("TOOL", "tool0")
    (tmp_path / "task.yaml").write_text(shown)
    assert load_task(tmp_path / "task.yaml").data[0].measurement is not None
    assert load_task(tmp_path / "task.yaml").robot.joints is None


def test_the_task_of_postures_lists_the_joints_that_the_file_holds(made, tmp_path: Path):
    """Else the columns are fewer than the robot's joints, and the task is refused."""
    urdf, joints, (run, *_) = made
    columns = {f"{axis}1": run["torque"][:30, k] for k, axis in enumerate("xyz")}
    columns |= {joint: run["position"][:30, j] for j, joint in enumerate(joints[:2])}
    with pytest.raises(InputError, match="a task for `calibrate`") as caught:
        draft_task(urdf, [table(tmp_path / "postures.csv", columns)])
    assert f"robot: {{model: MODEL, joints: [{joints[0]}, {joints[1]}]}}" in str(caught.value)


def test_the_task_of_postures_reads_units_in_the_names_of_columns(made, tmp_path: Path):
    """Columns as `A1 [deg]`, one for each joint, and `X [mm]`: the task that the message shows is one that is read."""
    urdf, joints, (run, *_) = made
    columns = {f"A{j + 1} [deg]": np.rad2deg(run["position"][:30, j]) for j in range(3)}
    columns |= {f"{axis} [mm]": np.linspace(0, 1, 30) for axis in "XYZ"}
    with pytest.raises(InputError, match="look like measured poses or points") as told:
        draft_task(urdf, [table(tmp_path / "postures.csv", columns)])
    task = yaml.safe_load(str(told.value).split("The task is\n")[1].split("\nwhere")[0])
    (entry,) = task["data"]
    assert entry["position"] == ["A1 [deg]", "A2 [deg]", "A3 [deg]"]
    assert entry["units"] == {"position": "deg", "measurement": "mm"}
    assert entry["measurement"]["position"] == ["X [mm]", "Y [mm]", "Z [mm]"]


def test_the_task_of_poses_with_quaternions_names_every_column(made, tmp_path: Path):
    """Joints `q1` to `q3` beside a quaternion `qx` to `qw`: what the message shows is read as it stands."""
    urdf, joints, (run, *_) = made
    pose = np.random.default_rng(0).normal(size=(30, 7))
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    columns = {f"q{j + 1}": run["position"][:30, j] for j in range(len(joints))}
    columns |= {name: pose[:, k] for k, name in enumerate(("x", "y", "z", "qx", "qy", "qz", "qw"))}
    with pytest.raises(InputError, match="a task for `calibrate`") as caught:
        draft_task(urdf, [table(tmp_path / "poses.csv", columns)])
    shown = " ".join(str(caught.value).split()).partition("The task is ")[2].partition(" where MODEL")[0]
    shown = shown.replace("MODEL", str(urdf)).replace("BASE", joints[0]).replace("TOOL", joints[-1])
    (tmp_path / "task.yaml").write_text(shown)
    task = load_task(tmp_path / "task.yaml")
    (recording,) = read_pose_recordings(task, load_robot(task))
    assert recording.kind == "pose"
    np.testing.assert_allclose(recording.position, run["position"][:30], rtol=0, atol=1e-9)
    np.testing.assert_allclose(recording.values[:, :3, 3], pose[:, :3], rtol=0, atol=1e-9)


@pytest.mark.parametrize("numbered", [True, False])
def test_the_task_of_poses_with_angles_names_every_column_and_unit(numbered: bool, made, tmp_path: Path):
    """A table of a robot's display: mm and degrees in the names, joints by number or by name, a column of words."""
    from scipy.spatial.transform import Rotation

    urdf, joints, (run, *_) = made
    point, turned = np.random.default_rng(0).normal(size=(2, 30, 3))
    columns: dict[str, Any] = {"image": [f"images/{k}.png" for k in range(30)]}
    columns |= {f"{axis}_mm": 1e3 * point[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"r{axis}_deg": np.rad2deg(turned[:, k]) for k, axis in enumerate("xyz")}
    slides = [joint.kind == "prismatic" for joint in fj.load_urdf(urdf).joints]
    degrees = np.where(slides, run["position"][:30], np.rad2deg(run["position"][:30]))
    columns |= {f"A{j + 1}_deg" if numbered else f"{joint}_deg": degrees[:, j] for j, joint in enumerate(joints)}
    rows = [",".join(columns), *(",".join(map(str, row)) for row in zip(*columns.values(), strict=True))]
    (tmp_path / "poses.csv").write_text("\n".join(rows))
    with pytest.raises(InputError, match="a task for `calibrate`") as caught:
        draft_task(urdf, [tmp_path / "poses.csv"])
    shown = " ".join(str(caught.value).split()).partition("The task is ")[2].partition(" where MODEL")[0]
    shown = shown.replace("MODEL", str(urdf)).replace("BASE", joints[0]).replace("TOOL", joints[-1])
    (tmp_path / "task.yaml").write_text(shown)
    task = load_task(tmp_path / "task.yaml")
    (recording,) = read_pose_recordings(task, load_robot(task))
    np.testing.assert_allclose(recording.position, run["position"][:30], rtol=0, atol=1e-9)
    np.testing.assert_allclose(recording.values[:, :3, 3], point, rtol=0, atol=1e-9)
    expected = Rotation.from_euler("xyz", turned).as_matrix()
    np.testing.assert_allclose(recording.values[:, :3, :3], expected, rtol=0, atol=1e-9)


def test_numbers_without_a_header_are_told_to_have_none(made, tmp_path: Path):
    urdf, _, (run, *_) = made
    np.savetxt(tmp_path / "run.txt", np.column_stack([run["time"], run["position"]]))
    with pytest.raises(InputError, match="run.txt has no header line.* its columns are column_1 to column_4"):
        draft_task(urdf, [tmp_path / "run.txt"])


def test_columns_whose_names_tell_too_little_are_shown(made, tmp_path: Path):
    urdf, joints, (run, *_) = made
    columns = {f"q_{joint}": run["position"][:, j] for j, joint in enumerate(joints)}
    columns |= {f"m_t_{joint}": run["torque"][:, j] for j, joint in enumerate(joints)}  # no clock: it goes up and down
    with pytest.raises(Undecided, match="which column is the time"):
        draft_task(urdf, [table(tmp_path / "run.csv", columns)])
    with pytest.raises(InputError, match=f"nothing was made: m_t_{joints[0]}, "):
        draft_task(urdf, [table(tmp_path / "run.csv", columns)], rate=250.0)


def test_fewer_columns_than_joints_are_told_how_to_name_theirs(made, tmp_path: Path):
    urdf, _, (run, *_) = made
    np.savez(tmp_path / "run.npz", t=run["time"], q=run["position"][:, :2], tau=run["torque"][:, :2])
    (tmp_path / "task.yaml").write_text(
        f"robot: {{model: {urdf}}}\ndata: [{{file: run.npz, time: t, position: q, torque: tau}}]"
    )
    task = load_task(tmp_path / "task.yaml")
    with pytest.raises(InputError, match="list the joints of the columns in robot.joints"):
        read_recordings(task, load_robot(task))


def test_a_clock_of_another_name_and_rows_that_were_written_twice(made, tmp_path: Path):
    urdf, joints, (run, *_) = made
    columns = {"Zeit [ms]": np.round(1e3 * run["time"])}
    columns |= {f"angle {joint} [rad]": run["position"][:, j] for j, joint in enumerate(joints)}
    columns |= {f"Moment {joint} [Nm]": run["torque"][:, j] for j, joint in enumerate(joints)}
    twice = {name: np.repeat(values, 1 + (np.arange(len(values)) % 300 == 7)) for name, values in columns.items()}
    draft = draft_task(urdf, [table(tmp_path / "run.csv", twice)])
    task, _, (recording,) = read_back(draft.text, tmp_path)
    assert (task.data[0].time, task.data[0].units.time) == ("Zeit [ms]", "ms")
    np.testing.assert_allclose(recording.position, run["position"], rtol=0, atol=1e-9)


def test_a_clock_that_stops_is_told_by_its_row(made, tmp_path: Path):
    urdf, _, (run, *_) = made
    time = np.array(run["time"])
    time[40] = time[39]
    np.savez(tmp_path / "run.npz", t=time, q=run["position"], tau=run["torque"])
    with pytest.raises(InputError, match=r"'t' is no clock of the positions: in row 40 \(from 0\).*leave the row out"):
        draft_task(urdf, [tmp_path / "run.npz"])
    time[40:] -= 0.5
    np.savez(tmp_path / "run.npz", t=time, q=run["position"], tau=run["torque"])
    with pytest.raises(InputError, match="cut the file where another recording begins"):
        draft_task(urdf, [tmp_path / "run.npz"])


@pytest.mark.parametrize(
    ("name", "said"), [("t", "'t' is nan"), ("q", "position of turn is nan"), ("tau", "torque of")]
)
def test_numbers_that_are_none_are_told_what_to_do(made, name: str, said: str, tmp_path: Path):
    urdf, _, (run, *_) = made
    arrays = {"t": np.array(run["time"]), "q": run["position"].copy(), "tau": run["torque"].copy()}
    arrays[name][7:9] = np.nan
    np.savez(tmp_path / "run.npz", **arrays)
    with pytest.raises(InputError, match=rf"{said}.*in row 7 \(from 0\).*leave such rows out, stamps and all"):
        draft_task(urdf, [tmp_path / "run.npz"])


def test_columns_numbered_by_joints_called_j_are_read(made, tmp_path: Path):
    """`j1_pos` holds a position though many logs write torque as J; `current_position` holds no current."""
    urdf, joints, (run, *_) = made
    renamed = tmp_path / "renamed.urdf"
    text = urdf.read_text()
    for j, joint in enumerate(joints):
        text = text.replace(f'"{joint}"', f'"j{j + 1}"')
    renamed.write_text(text)
    for word in ("pos", "current_position"):
        columns = {"time": run["time"]} | {f"j{j + 1}_{word}": run["position"][:, j] for j in range(3)}
        columns |= {f"j{j + 1}_torque": run["torque"][:, j] for j in range(3)}
        _, _, (recording,) = read_back(draft_task(renamed, [table(tmp_path / f"{word}.csv", columns)]).text, tmp_path)
        np.testing.assert_allclose(recording.position, run["position"], rtol=0, atol=1e-9)
        assert recording.torque is not None
        np.testing.assert_allclose(recording.torque, run["torque"], rtol=0, atol=1e-9)


def test_a_turned_position_is_not_taken_for_a_turned_torque(made, tmp_path: Path):
    urdf, _, (run, *_) = made
    np.savez(tmp_path / "run.npz", t=run["time"], q=run["position"] * [1.0, -1.0, 1.0], tau=run["torque"])
    with pytest.raises(Undecided, match=r"position of \w+ seems to have the opposite sign.*--gears 1,-1,1") as caught:
        draft_task(urdf, [tmp_path / "run.npz"])
    assert caught.value.option == "gears"
    draft = draft_task(urdf, [tmp_path / "run.npz"], gears=[1.0, -1.0, 1.0])
    _, _, (recording,) = read_back(draft.text, tmp_path)
    np.testing.assert_allclose(recording.position, run["position"], rtol=0, atol=1e-12)


def test_a_draft_says_which_joints_it_locks_and_what_told_the_order(made, tmp_path: Path):
    urdf, joints, (run, *_) = made
    np.savez(tmp_path / "run.npz", t=run["time"], q=run["position"][:, :2], tau=run["torque"][:, :2])
    draft = draft_task(urdf, [tmp_path / "run.npz"], joints=joints[:2], unit="rad", constants=[1.0, 1.0])
    assert any(f"no column holds {joints[2]}: locked" in line for line in draft.assumed)
    assert "by the order of --joints" in draft.text
    assert any(line.endswith("as stated") for line in draft.assumed)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"constants": [1.0, float("nan"), 1.0]}, "--constants: expected finite numbers other than zero"),
        ({"constants": [1.0, 0.0, 1.0]}, "--constants: expected finite numbers other than zero"),
        ({"gears": [1.0, float("inf"), 1.0]}, "--gears: expected finite numbers other than zero"),
        ({"joints": (0, 0, 1)}, "is named twice"),
    ],
)
def test_options_that_cannot_be_meant_are_refused_by_their_name(made, options: dict[str, Any], said: str, tmp_path):
    urdf, joints, (run, *_) = made
    np.savez(tmp_path / "run.npz", t=run["time"], q=run["position"], tau=run["torque"])
    if "joints" in options:
        options = {"joints": [joints[j] for j in options["joints"]]}
    with pytest.raises(InputError, match=said):
        draft_task(urdf, [tmp_path / "run.npz"], **options)


def test_units_that_no_joint_has_are_refused_and_m_is_the_unit_of_sliding_joints(tmp_path: Path):
    link = '<link name="{0}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    link += "</inertial></link>"
    joint = (
        '<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/><axis xyz="0 0 1"/>'
        '<limit lower="-9" upper="9" velocity="9" effort="99"/></joint>'
    )
    t = np.arange(2000) / 200
    q = 0.3 * np.sin(np.outer(t, [2.0]))
    tau = -0.3 * 4.0 * np.sin(np.outer(t, [2.0])) + 9.81
    np.savez(tmp_path / "run.npz", t=t, q=q, tau=tau)
    for kind, right, wrong in (("prismatic", "m", "deg"), ("revolute", "rad", "mm")):
        urdf = tmp_path / f"{kind}.urdf"
        parts = [link.format("base"), link.format("tip"), joint.format("j", kind, "base", "tip")]
        urdf.write_text(f'<robot name="r">{"".join(parts)}</robot>')
        with pytest.raises(InputError, match=f"--unit {wrong}: every joint of 'r'"):
            draft_task(urdf, [tmp_path / "run.npz"], unit=wrong)
        draft = draft_task(urdf, [tmp_path / "run.npz"], unit=right, constants=[1.0])
        assert f"positions are in {right}: as stated" in draft.assumed
        np.testing.assert_allclose(read_back(draft.text, tmp_path)[2][0].position, q, rtol=0, atol=1e-12)


def test_recordings_that_are_too_short_or_transposed_are_told_so(made, tmp_path: Path):
    urdf, _, (run, *_) = made
    np.savez(tmp_path / "short.npz", t=run["time"][:5], q=run["position"][:5], tau=run["torque"][:5])
    with pytest.raises(InputError, match="5 samples are too few"):
        draft_task(urdf, [tmp_path / "short.npz"])
    np.savez(tmp_path / "turned.npz", t=run["time"], q=run["position"].T, tau=run["torque"].T)
    with pytest.raises(InputError, match="samples are rows; transpose it"):
        draft_task(urdf, [tmp_path / "turned.npz"])


def test_stated_constants_are_taken_where_the_model_contradicts_them(made, tmp_path: Path):
    """The words of the documentation; a zero that the log does not share makes right ones look wrong (the TX40)."""
    urdf, _, (run, *_) = made
    np.savez(tmp_path / "run.npz", t=run["time"], q=run["position"], tau=run["torque"])
    draft = draft_task(urdf, [tmp_path / "run.npz"], constants=[-1.0, -1.0, -1.0])
    (line,) = [line for line in draft.assumed if "does not match the motion as read" in line]
    assert "nothing confirms them" in line
    assert yaml.safe_load(draft.text)["transmission"]["torque"] == [-1.0, -1.0, -1.0]


LINK = (
    '<link name="{}"><inertial><origin xyz="0.1 0 0"/><mass value="{}"/>'
    '<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><axis xyz="{}"/>{}</joint>'
LIMIT = '<limit lower="-3" upper="3" velocity="4" effort="99"/>'


def test_a_wheel_may_turn_for_ever(tmp_path: Path):
    """Twenty-five turns of a joint without limits are no degrees, though degrees would fit; nor are they refused."""
    parts = [LINK.format("base", 5), LINK.format("wheel", 2), LINK.format("arm", 3)]
    parts += [JOINT.format("w", "continuous", "base", "wheel", "0 0 1", "")]
    parts += [JOINT.format("a", "revolute", "base", "arm", "0 1 0", LIMIT)]
    urdf = tmp_path / "cart.urdf"
    urdf.write_text(f'<robot name="cart">{"".join(parts)}</robot>')
    t = np.arange(4000) / 200
    q = np.column_stack([8 * t, 0.7 + 1.5 * np.sin(2 * t) + 0.5 * np.cos(3 * t)])
    v, a = np.gradient(q, t, axis=0), np.gradient(np.gradient(q, t, axis=0), t, axis=0)
    tau = np.asarray(fj.inverse_dynamics(fj.load_urdf(urdf), q, v, a)) + 0.3 * np.sign(v)
    np.savez(tmp_path / "run.npz", t=t, q=q, tau=tau)
    draft = draft_task(urdf, [tmp_path / "run.npz"])
    task, model, (recording,) = read_back(draft.text, tmp_path)
    np.testing.assert_allclose(recording.position, q, rtol=0, atol=1e-12)
    assert not [text for text in check_recordings(task, model, [recording]) if "position" in text]
    np.savez(tmp_path / "run.npz", t=t, q=np.rad2deg(q), tau=tau)
    assert "position: deg" in draft_task(urdf, [tmp_path / "run.npz"]).text


@pytest.mark.parametrize("kind", ["planar", "floating"])
def test_joints_of_several_degrees_of_freedom_are_refused_by_name(kind: str, tmp_path: Path):
    parts = [LINK.format("base", 5), LINK.format("arm", 3), JOINT.format("a", kind, "base", "arm", "0 1 0", LIMIT)]
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(f'<robot name="r">{"".join(parts)}</robot>')
    t = np.arange(400) / 200
    np.savez(tmp_path / "run.npz", t=t, q=np.sin(t)[:, None], tau=np.cos(t)[:, None])
    with pytest.raises(InputError, match="joint a of several degrees of freedom"):
        draft_task(urdf, [tmp_path / "run.npz"])


def test_interactive_asks_until_the_answer_can_be_meant(made, tmp_path: Path, monkeypatch, capsys):
    """What the recording cannot decide is asked for; a slip is asked again and costs no answer before it."""
    urdf, _, (run, *_) = made
    noise = np.random.default_rng(1).normal(size=run["torque"].shape)
    np.savez(tmp_path / "run.npz", q=run["position"], tau=noise)
    command = ["new", str(urdf), str(tmp_path / "run.npz"), "--interactive"]
    monkeypatch.setattr("sys.stdin", io.StringIO("fast\n250\n1;1;1\n1,1,1\n"))
    assert cli.main(command) == 0
    told = capsys.readouterr()
    assert yaml.safe_load(told.out)["data"][0]["rate"] == 250.0
    assert "--rate fast: expected" in told.err and "--constants 1;1;1: expected" in told.err
    monkeypatch.setattr("sys.stdin", io.StringIO("250\n"))
    assert cli.main(command) == 2  # no answer gives up
