"""Recordings as users have them: written by the libraries that made them, read back as the same numbers."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from generators import make_case

from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.robotfile import load_robot
from figaroh_jax.recordings.dataset import Recording, read_recordings
from figaroh_jax.recordings.draft import draft_task
from figaroh_jax.recordings.draft_columns import Undecided
from figaroh_jax.recordings.progress import listener
from figaroh_jax.recordings.reading import read_table
from figaroh_jax.recordings.tables import Source


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[str, ...], dict[str, Any]]:
    case = make_case(robot="small", repeats=1, trajectories=1, seed=4)
    urdf = tmp_path_factory.mktemp("robot") / "robot.urdf"
    urdf.write_text(case.urdf)
    return urdf, case.joints, case.recordings[0]


def drafted(urdf: Path, file: Path, folder: Path, **known: Any) -> tuple[dict[str, Any], Recording]:
    """The first entry of a draft, and the recording that the draft reads."""
    task_file = folder / "task.yaml"
    task_file.write_text(draft_task(urdf, [file], **known).text)
    task = load_task(task_file)
    recording, *_ = read_recordings(task, load_robot(task))
    return task.data[0].model_dump(exclude_defaults=True), recording


def assert_read(recording: Recording, run: dict[str, Any], atol: float = 1e-9) -> None:
    assert recording.torque is not None
    np.testing.assert_allclose(recording.position, run["position"], rtol=0, atol=atol)
    np.testing.assert_allclose(recording.torque, run["torque"], rtol=0, atol=atol)
    np.testing.assert_allclose(np.diff(recording.time), np.diff(run["time"]), rtol=0, atol=2e-6)


# ROS


def bag(path: Path, joints: tuple[str, ...], run: dict[str, Any], plugin: str) -> Path:
    """A ROS 2 bag of joint states with joints in another order, a message sent twice, and a wrench."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    state, header = kinds["sensor_msgs/msg/JointState"], kinds["std_msgs/msg/Header"]
    stamp, wrench = kinds["builtin_interfaces/msg/Time"], kinds["geometry_msgs/msg/WrenchStamped"]
    vector, pure = kinds["geometry_msgs/msg/Vector3"], kinds["geometry_msgs/msg/Wrench"]
    order = np.arange(len(joints))[::-1]
    start = 1_700_000_000_000_000_000
    with Writer(path, version=9, storage_plugin=getattr(StoragePlugin, plugin)) as writer:
        states = writer.add_connection("/joint_states", state.__msgtype__, typestore=store)
        forces = writer.add_connection("/ft", wrench.__msgtype__, typestore=store)
        for k, t in enumerate(run["time"]):
            now = start + round(t * 1e9)
            head = header(stamp(now // 10**9, now % 10**9), "")
            message = state(
                head,
                [joints[j] for j in order],
                run["position"][k, order],
                np.zeros(len(joints)),
                run["torque"][k, order],
            )
            data = store.serialize_cdr(message, state.__msgtype__)
            for _ in range(2 if k == 3 else 1):
                writer.write(states, now + 1000, data)
            force = wrench(head, pure(vector(float(k), 0.0, 0.0), vector(0.0, 0.0, 1.0)))
            writer.write(forces, now + 1000, store.serialize_cdr(force, wrench.__msgtype__))
    return path


@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
def test_a_bag_of_ros_2_is_drafted_and_read(made, tmp_path: Path, plugin: str):
    urdf, joints, run = made
    folder = bag(tmp_path / "bag", joints, run, plugin)
    entry, recording = drafted(urdf, folder, tmp_path)
    assert entry["time"] == "stamp" and "topic" not in entry
    assert_read(recording, run)
    single = next(file for file in folder.iterdir() if file.suffix in (".mcap", ".db3"))
    assert_read(drafted(urdf, single, tmp_path)[1], run)
    table = read_table(folder, "data")
    np.testing.assert_array_equal(table.read("/ft:force.x"), np.arange(len(run["time"])))
    with pytest.raises(InputError, match="no topic '/joint_state'; did you mean '/joint_states'"):
        draft_task(urdf, [folder], topic="/joint_state")


def test_a_file_of_another_mcap_writer_is_read(made, tmp_path: Path):
    from mcap_ros2.writer import Writer

    urdf, joints, run = made
    text = (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
        "================================================================================\nMSG: std_msgs/Header\n"
        "builtin_interfaces/Time stamp\nstring frame_id\n"
        "================================================================================\n"
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    )
    with (tmp_path / "run.mcap").open("wb") as stream:
        writer = Writer(stream)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", text)
        for k, t in enumerate(run["time"]):
            now = 1_700_000_000_000_000_000 + round(t * 1e9)
            writer.write_message(
                topic="/arm/joint_states",
                schema=schema,
                message={
                    "header": {"stamp": {"sec": now // 10**9, "nanosec": now % 10**9}, "frame_id": ""},
                    "name": list(joints),
                    "position": run["position"][k].tolist(),
                    "velocity": [],
                    "effort": run["torque"][k].tolist(),
                },
                log_time=now,
                publish_time=now,
            )
        writer.finish()
    assert_read(drafted(urdf, tmp_path / "run.mcap", tmp_path)[1], run)


def test_a_bag_of_ros_1_with_controller_states_is_read(made, tmp_path: Path):
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    urdf, joints, run = made
    name = "control_msgs/msg/JointTrajectoryControllerState"
    text = "\n".join(
        [
            "std_msgs/Header header",
            "string[] joint_names",
            *(f"trajectory_msgs/JointTrajectoryPoint {part}" for part in ("desired", "actual", "error")),
        ]
    )
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(text, name))
    kinds = store.types
    header, stamp = kinds["std_msgs/msg/Header"], kinds["builtin_interfaces/msg/Time"]
    point, duration = kinds["trajectory_msgs/msg/JointTrajectoryPoint"], kinds["builtin_interfaces/msg/Duration"]
    none = np.zeros(0)
    with Writer(tmp_path / "run.bag") as writer:
        connection = writer.add_connection("/arm/state", name, typestore=store)
        for k, t in enumerate(run["time"]):
            now = 1_600_000_000_000_000_000 + round(t * 1e9)
            points = [
                point(run["position"][k] + off, none, none, effort, duration(0, 0))
                for off, effort in ((0.01, none), (0.0, run["torque"][k]), (0.01, none))
            ]
            message = kinds[name](header(k, stamp(now // 10**9, now % 10**9), ""), list(joints), *points)
            writer.write(connection, now, store.serialize_ros1(message, name))
    assert_read(drafted(urdf, tmp_path / "run.bag", tmp_path)[1], run)
    np.testing.assert_allclose(
        read_table(tmp_path / "run.bag", "data").read(f"command.{joints[0]}"), run["position"][:, 0] + 0.01, rtol=1e-12
    )


# LeRobot


def lerobot(folder: Path, joints: tuple[str, ...], run: dict[str, Any], version: str) -> Path:
    """Three episodes, a third of the recording each; version 2 keeps one file each, version 3 one file of all."""
    import pandas as pd

    names = {"motors": [f"{joint}.pos" for joint in joints]} if version == "v2.1" else [f"{j}.pos" for j in joints]
    features = {
        "observation.state": {"dtype": "float32", "shape": [len(joints)], "names": names},
        "observation.effort": {
            "dtype": "float32",
            "shape": [len(joints)],
            "names": [f"{joint}.effort" for joint in joints],
        },
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps({"codebase_version": version, "features": features}))
    frames = []
    for episode, rows in enumerate(np.array_split(np.arange(len(run["time"])), 3)):
        frames.append(
            pd.DataFrame(
                {
                    "observation.state": list(run["position"][rows]),
                    "observation.effort": list(run["torque"][rows]),
                    "timestamp": run["time"][rows] - run["time"][rows[0]],
                    "episode_index": episode,
                }
            )
        )
        if version == "v2.1":
            frames[-1].to_parquet(folder / "data" / "chunk-000" / f"episode_{episode:06d}.parquet")
    if version == "v3.0":
        pd.concat(frames).to_parquet(folder / "data" / "chunk-000" / "file-000.parquet")
    return folder


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_folder_of_lerobot_is_drafted_episode_by_episode(made, tmp_path: Path, version: str):
    urdf, joints, run = made
    folder = lerobot(tmp_path / "set", joints, run, version)
    text = draft_task(urdf, [folder]).text
    (tmp_path / "task.yaml").write_text(text)
    task = load_task(tmp_path / "task.yaml")
    assert [entry.episode for entry in task.data] == [0, 1, 2]
    recordings = read_recordings(task, load_robot(task))
    assert [recording.name for recording in recordings] == ["set_episode_0", "set_episode_1", "set_episode_2"]
    whole = np.concatenate([recording.position for recording in recordings])
    np.testing.assert_allclose(whole, run["position"], rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="3 episodes; `episode` must say which, 0 to 2"):
        read_table(folder, "data")


def test_degrees_and_per_cent_of_lerobot_look_alike_and_are_asked_for(made, tmp_path: Path):
    urdf, joints, run = made
    folder = lerobot(tmp_path / "set", joints, run | {"position": np.rad2deg(run["position"])}, "v3.0")
    with pytest.raises(Undecided, match="share of the range of motion"):
        draft_task(urdf, [folder])


# Logs of robots


def test_a_log_of_rtde_is_known_by_its_columns(made, tmp_path: Path):
    urdf, _, run = made
    constants = [11.0, 9.0, 8.0]
    head = ["timestamp", *(f"actual_q_{k}" for k in range(3)), *(f"actual_current_{k}" for k in range(3)), "speed"]
    rows = np.column_stack([run["time"] + 4e3, run["position"], run["torque"] / constants, np.ones(len(run["time"]))])
    np.savetxt(tmp_path / "robot_data.csv", rows, "%.15g", " ", header=" ".join(head), comments="")
    entry, recording = drafted(urdf, tmp_path / "robot_data.csv", tmp_path, constants=constants)
    assert entry["format"] == "rtde" and entry["units"]["torque"] == "A"
    assert_read(recording, run)
    text = (tmp_path / "task.yaml").read_text()
    (tmp_path / "task.yaml").write_text(text[: text.index("transmission")])
    with pytest.raises(InputError, match="transmission.torque must say what one ampere gives, as a list"):
        task = load_task(tmp_path / "task.yaml")
        read_recordings(task, load_robot(task))


@pytest.mark.parametrize("age", ["old", "new"])
def test_logs_of_libfranka_are_known_by_their_columns(made, tmp_path: Path, age: str):
    """Columns as `logToCSV` wrote them (commands under the names of states) and as it writes them today."""
    urdf, _, run = made
    time = np.round(run["time"] * 1e3).astype(int)
    state = {name: [f"{name}[{k}]" for k in range(3)] for name in ("q", "q_d", "dq", "tau_J")}
    zero = np.zeros_like(run["position"])
    values = [run["position"], run["position"], zero, run["torque"]]
    if age == "old":
        names = ["duration", "success rate", *sum(state.values(), []), "sent commands", *state["q_d"]]
    else:
        names = [
            "time",
            "success_rate",
            *(f"state.{n}" for n in sum(state.values(), [])),
            *(f"cmd.{n}" for n in state["q_d"]),
        ]
    lines = [", ".join(names) if age == "old" else ",".join(names)]
    for k in range(len(time)):
        cells = [str(time[k]), "1", *(repr(float(x)) for part in values for x in part[k])]
        cells += [""] * (age == "old") + [repr(float(x)) for x in run["position"][k]]
        lines.append(",".join(cells))
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    entry, recording = drafted(urdf, tmp_path / "log.csv", tmp_path)
    assert entry["format"] == "libfranka"
    assert_read(recording, run)


# Containers


def test_hdf5_and_new_files_of_matlab_are_read(made, tmp_path: Path):
    import h5py

    urdf, _, run = made
    with h5py.File(tmp_path / "run.h5", "w") as file:
        group = file.create_group("run")
        for name, key in (("time", "time"), ("q", "position"), ("tau", "torque")):
            group[name] = run[key]
    entry, recording = drafted(urdf, tmp_path / "run.h5", tmp_path)
    assert entry["position"] == "run/q"
    assert_read(recording, run)
    with h5py.File(tmp_path / "run.mat", "w", userblock_size=512) as file:
        for name, key in (("time", "time"), ("q", "position"), ("tau", "torque")):
            file[f"log/{name}"] = np.atleast_2d(run[key].T)
    head = b"MATLAB 7.3 MAT-file".ljust(124) + bytes([0, 2]) + b"IM"
    whole = (tmp_path / "run.mat").read_bytes()
    (tmp_path / "run.mat").write_bytes(head.ljust(512, b"\0") + whole[512:])
    assert_read(drafted(urdf, tmp_path / "run.mat", tmp_path)[1], run)


def test_fields_of_structs_of_matlab_are_read(made, tmp_path: Path):
    from scipy.io import savemat

    urdf, _, run = made
    log = {"t": run["time"], "q": run["position"], "tau": run["torque"], "note": "a text"}
    savemat(tmp_path / "run.mat", {"log": log})
    entry, recording = drafted(urdf, tmp_path / "run.mat", tmp_path)
    assert entry["position"] == "log.q"
    assert_read(recording, run)


def test_parquet_of_pandas_is_read(made, tmp_path: Path):
    import pandas as pd

    urdf, joints, run = made
    frame = pd.DataFrame({f"pos_{j}": run["position"][:, k] for k, j in enumerate(joints)})
    frame = frame.assign(**{f"effort_{j}": run["torque"][:, k] for k, j in enumerate(joints)})
    frame["stamp"] = pd.to_datetime("2024-05-01") + pd.to_timedelta(run["time"], unit="s")
    frame.to_parquet(tmp_path / "run.parquet")
    assert_read(drafted(urdf, tmp_path / "run.parquet", tmp_path)[1], run)


@pytest.mark.parametrize("form", ["parquet", "npz"])
def test_iso_times_as_words_are_a_clock_in_any_file(made, form: str, tmp_path: Path):
    urdf, joints, run = made
    stamps = np.datetime64("2024-05-01T10:00:00", "ns") + np.round(run["time"] * 1e9).astype("timedelta64[ns]")
    words = np.char.add(np.datetime_as_string(stamps, unit="us"), "Z")
    if form == "npz":
        np.savez(tmp_path / "words.npz", time=words, q=run["position"], tau=run["torque"])
        np.savez(tmp_path / "dates.npz", time=stamps, q=run["position"], tau=run["torque"])
    else:
        import pyarrow as pa
        from pyarrow import parquet

        columns = {
            f"{n}_{j}": run[kind][:, k]
            for n, kind in (("q", "position"), ("tau", "torque"))
            for k, j in enumerate(joints)
        }
        parquet.write_table(pa.table({"time": words.tolist(), **columns}), tmp_path / "words.parquet")
        parquet.write_table(pa.table({"time": ["2024-05-01", None, "x"]}), tmp_path / "odd.parquet")
        with pytest.raises(InputError, match="'time', row 2 .from 0.: 'x' is not a number"):
            read_table(tmp_path / "odd.parquet", "data").read("time")
    for file in sorted(tmp_path.glob("[wd]*")):
        assert_read(drafted(urdf, file, tmp_path)[1], run)


# JSON


@pytest.mark.parametrize("form", ["rows", "lines", "columns", "arrays"])
def test_json_of_pandas_and_of_scripts_is_read(made, form: str, tmp_path: Path):
    """Rows and columns as pandas writes them, and lists a sample in an object beside what is no recording."""
    import pandas as pd

    urdf, joints, run = made
    frame = pd.DataFrame({f"pos_{j}": run["position"][:, k] for k, j in enumerate(joints)})
    frame = frame.assign(**{f"effort_{j}": run["torque"][:, k] for k, j in enumerate(joints)}, stamp=run["time"])
    file = tmp_path / ("run.jsonl" if form == "lines" else "run.json")
    if form in ("rows", "lines"):
        frame.to_json(file, orient="records", lines=form == "lines", double_precision=15)
    elif form == "columns":
        file.write_text(json.dumps(frame.to_dict(orient="list")))
    else:
        log = {"t": run["time"].tolist(), "q": run["position"].tolist(), "tau": run["torque"].tolist()}
        file.write_text(json.dumps({"robot": "small", "rate": 250, "log": log}))
    entry, recording = drafted(urdf, file, tmp_path)
    assert (entry["position"] == "log.q") == (form == "arrays")
    assert_read(recording, run)


def test_runs_in_json_are_drafted_one_by_one_and_one_must_be_named(made, tmp_path: Path):
    """As scripts that move a servo write them: a list of runs of several lengths, a kind and targets in words."""
    urdf, joints, run = made
    half = len(run["time"]) // 2
    pieces = [slice(0, half), slice(half, half + 200), slice(half + 200, None)]
    keys = {"time": "t", "position": "q", "torque": "tau"}
    runs = [
        {"type": "step", "id": k, "targets": [], **{name: run[key][at].tolist() for key, name in keys.items()}}
        for k, at in enumerate(pieces)
    ]
    file, task = tmp_path / "runs.json", tmp_path / "task.yaml"
    file.write_text(json.dumps({"config": {"hz": 250}, "data": runs}))
    task.write_text(draft_task(urdf, [file], unit="rad").text)
    told = load_task(task)
    assert [one.episode for one in told.data] == [0, 1, 2]
    for one, at in zip(read_recordings(told, load_robot(told)), pieces, strict=True):
        np.testing.assert_allclose(one.position, run["position"][at], rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="holds 3 runs; `episode` must say which, 0 to 2"):
        read_table(file, "data")
    with pytest.raises(InputError, match="no run 3; `episode` is 0 to 2"):
        read_table(file, "data", Source(episode=3))


def test_rows_of_json_with_a_scanner_are_rows(tmp_path: Path):
    """Long lists beside a stamp that rises are readings of one sample; without `episode` they are no runs."""
    rows = [{"t": 0.01 * k, "q": [0.1 * k, 1.0], "imu": {"a": k}, "ranges": [k] * 360} for k in range(80)]
    (tmp_path / "run.json").write_text(json.dumps(rows))
    table = read_table(tmp_path / "run.json", "data")
    assert table.names == ("t", "q", "imu.a", "ranges")
    np.testing.assert_array_equal(table.read("q"), [row["q"] for row in rows])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"q": [1, 2', "line 1, column 12 is not JSON"),
        ('{"q": [1], "q": [2]}', "the key 'q' appears twice"),
        ('{"q": [[1, 2], [3]]}', "'q', row 1 .from 0.: a list of 1, but a list of 2 in row 0"),
        ('{"q": [1, null, 2]}', "'q', row 1 .from 0.: an empty cell is not a number"),
        ('[{"q": [1, 2]}, {"t": 1}, {"q": [1, 2]}]', "'q', row 1 .from 0.: no value stands there"),
        ('[{"t": 0}, {"q": [1, 2]}]', "'q', row 0 .from 0.: no value stands there"),
        ('{"q": [1, "two"]}', "'q', row 1 .from 0.: 'two' is not a number"),
        ('{"rate": 250}', "holds no lists of numbers"),
        ("[" * 100_000, "too deep"),
        ('{"q": [1' + "0" * 400 + "]}", "damaged or of another format"),
    ],
)
def test_what_is_wrong_in_json_is_said_with_its_place(tmp_path: Path, text: str, said: str):
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(InputError, match=said):
        read_table(tmp_path / "run.json", "data").read("q")


# Text


HEADS = {"two rows above": "# robot arm, cell 3\n# t0 = 4\n", "none above": ""}


@pytest.mark.parametrize("delimiter", [",", ";", "\t", " ", "|"])
@pytest.mark.parametrize("above", HEADS)
def test_tables_of_any_delimiter_with_lines_above_and_units_below_the_names(made, tmp_path, delimiter: str, above: str):
    urdf, joints, run = made
    names = ["t", *(f"q_{joint}" for joint in joints), *(f"tau_{joint}" for joint in joints)]
    units = ["[s]"] + ["[rad]"] * 3 + ["[Nm]"] * 3
    rows = np.column_stack([run["time"], run["position"], run["torque"]])
    text = HEADS[above] + delimiter.join(names) + "\n" + (delimiter.join(units) + "\n" if above else "")
    body = "\n".join(delimiter.join(map(repr, row)) for row in rows.tolist())
    (tmp_path / "run.csv").write_text(f"{text}{body}\n", encoding="utf-8-sig")
    assert_read(drafted(urdf, tmp_path / "run.csv", tmp_path)[1], run)


def test_decimal_commas_iso_times_empty_cells_and_words(tmp_path: Path):
    file = tmp_path / "run.csv"
    rows = [f"2024-05-01T10:00:00.{10 * k:03d}Z;{k},5;;ok" for k in range(50)]
    file.write_text("time;q1;gap;state\n" + "\n".join(rows) + "\n")
    table = read_table(file, "data")
    np.testing.assert_allclose(table.read("time"), 0.01 * np.arange(50), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(table.read("q1"), np.arange(50) + 0.5)
    assert np.isnan(table.read("gap")).all()
    with pytest.raises(InputError, match="'state', row 0 .from 0.: 'ok' is not a number"):
        table.read("state")


@pytest.mark.parametrize("clock", ["{:.3f}", "2024-05-01T10:00:00.{:.3f}Z"])
def test_rows_that_were_written_twice_are_read_once_beside_words_and_gaps(clock: str, tmp_path: Path):
    stamps = [clock.format(0.01 * k).replace(".0.", ".") for k in range(50)]
    rows = [f"{stamp},{0.1 * k},,RUN" for k, stamp in enumerate(stamps)]
    (tmp_path / "run.csv").write_text("\n".join(["time,q1,gap,state", *rows[:20], rows[19], *rows[20:], rows[-1]]))
    table = read_table(tmp_path / "run.csv", "data")
    np.testing.assert_allclose(table.read("time"), 0.01 * np.arange(50), rtol=0, atol=1e-9)
    np.testing.assert_allclose(table.read("q1"), 0.1 * np.arange(50), rtol=0, atol=1e-9)
    still = [f"{stamp},RUN" for stamp in ("1", "1", "1")]
    (tmp_path / "run.csv").write_text("\n".join(["q1,state", *still]))  # no clock says that they are the same row
    assert len(read_table(tmp_path / "run.csv", "data").read("q1")) == 3


@pytest.mark.parametrize("between", [";", "\t", "|", " ", ","])
def test_decimal_commas_between_any_delimiters(tmp_path: Path, between: str):
    file = tmp_path / "run.txt"
    numbers = np.arange(150).reshape(50, 3) / 8 - 2
    rows = [[f"{x:.4f}".replace(".", ",") for x in row] for row in numbers]
    rows = [[f'"{cell}"' for cell in row] if between == "," else row for row in rows]
    file.write_text("\n".join(between.join(row) for row in [["t", "q1", "q2"], *rows]) + "\n")
    table = read_table(file, "data")
    np.testing.assert_array_equal(np.stack([table.read(name) for name in ("t", "q1", "q2")], 1), numbers)


def test_a_delimiter_in_words_is_none(tmp_path: Path):
    (tmp_path / "run.csv").write_text("t,q1,state\n" + "".join(f"{k},{k}.5,on|off\n" for k in range(50)))
    np.testing.assert_array_equal(read_table(tmp_path / "run.csv", "data").read("q1"), np.arange(50) + 0.5)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t,q\n0,1\n1,2,3\n2,4\n", "row 1 .from 0. has 3 cells, its header 2"),
        ("t,q\n", "1 line"),
        ("a title\n0,1\n1,2\n", "a header line with one name for each column is expected"),
    ],
)
def test_what_is_no_table_is_said_with_its_row(tmp_path: Path, text: str, said: str):
    (tmp_path / "run.csv").write_text(text)
    with pytest.raises(InputError, match=said):
        read_table(tmp_path / "run.csv", "data")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-be"])
@pytest.mark.parametrize("packed", [False, True])
def test_text_of_spreadsheets_and_packed_text_is_read(made, encoding: str, packed: bool, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("figaroh_jax.recordings.textfiles._BLOCK", 1 << 12)
    urdf, joints, run = made
    names = ["t", *(f"q_{joint}" for joint in joints), *(f"tau_{joint}" for joint in joints)]
    rows = np.column_stack([run["time"], run["position"], run["torque"]]).tolist()
    text = "\r\n".join(["\t".join(names), *("\t".join(map(repr, row)) for row in rows)])
    content = ("\ufeff" * (encoding == "utf-16-be") + text).encode(encoding)
    file = tmp_path / ("run.csv.gz" if packed else "run.csv")
    file.write_bytes(gzip.compress(content) if packed else content)
    assert_read(drafted(urdf, file, tmp_path)[1], run)


def test_packed_text_that_is_damaged_or_too_long_is_told(tmp_path: Path, monkeypatch):
    file = tmp_path / "run.csv.gz"
    content = gzip.compress(b"t,q\n" + b"".join(b"%d,%d\n" % (k, k * k) for k in range(9000)))
    for damaged in (content[: len(content) // 2], b"t,q\n1,2\n"):
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=r"run\.csv\.gz"):
            read_table(file, "data")
    file.write_bytes(content)
    assert len(read_table(file, "data").read("q")) == 9000
    monkeypatch.setattr("figaroh_jax.recordings.textfiles.LARGEST", 1 << 16)
    with pytest.raises(InputError, match="of text, unpacked; split it"):
        read_table(file, "data")


def test_numbers_without_a_header_are_columns_by_number(tmp_path: Path):
    np.savetxt(tmp_path / "run.txt", np.arange(12.0).reshape(4, 3))
    table = read_table(tmp_path / "run.txt", "data")
    assert table.names == ("column_1", "column_2", "column_3")
    np.testing.assert_array_equal(table.read("column_2"), [1, 4, 7, 10])


@pytest.mark.parametrize("head", ["image,x,q1\n", "# image,x,q1\n"])
def test_an_example_row_in_the_comments_is_neither_names_nor_numbers(head: str, tmp_path: Path):
    rows = "".join(f"images/{k}.png,{k}.25,-{k}\n" for k in range(1, 9))
    (tmp_path / "run.csv").write_text(f"# one row an image\n# images/0.png,7.5,8.5\n{head}{rows}")
    table = read_table(tmp_path / "run.csv", "data")
    assert table.names == ("image", "x", "q1")
    np.testing.assert_array_equal(table.read("q1"), -np.arange(1.0, 9.0))


def test_long_files_are_read_in_blocks_and_tell_how_far(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("figaroh_jax.recordings.textfiles._BLOCK", 1000)
    rows = np.random.default_rng(1).normal(size=(500, 3))
    np.savetxt(tmp_path / "run.csv", rows, "%.17g", ",", header="a,b,c", comments="")
    shares: list[float] = []
    token = listener.set(lambda phase, share: shares.append(share))
    try:
        table = read_table(tmp_path / "run.csv", "data")
    finally:
        listener.reset(token)
    np.testing.assert_array_equal(np.column_stack([table.read(n) for n in "abc"]), rows)
    assert len(shares) > 20 and np.all(np.diff(shares) >= 0) and shares[-1] == 1.0


def test_a_format_whose_package_is_missing_names_the_extra(tmp_path: Path, monkeypatch):
    import sys

    (tmp_path / "run.h5").write_bytes(b"1")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(InputError, match=r"pip install 'figaroh-jax\[hdf5\]'"):
        read_table(tmp_path / "run.h5", "data")


@pytest.mark.parametrize("form", ["mcap", "db3", "h5", "json"])
def test_damaged_files_are_one_message(made, tmp_path: Path, form: str):
    """Bytes changed at random, and files cut off: an answer or an `InputError`, whatever the library raises."""
    import h5py

    _, joints, run = made
    short = {key: run[key][:60] for key in ("time", "position", "torque")}
    file = tmp_path / f"run.{form}"
    if form in ("mcap", "db3"):
        folder = bag(tmp_path / "bag", joints, short, "MCAP" if form == "mcap" else "SQLITE3")
        next(one for one in folder.iterdir() if one.suffix == file.suffix).rename(file)
    elif form == "json":
        file.write_text(json.dumps({key: value.tolist() for key, value in short.items()}))
    else:
        with h5py.File(file, "w") as opened:
            opened["q"] = short["position"]
    whole, rng = file.read_bytes(), np.random.default_rng(3)
    for k in range(25):
        damaged = bytearray(whole[: rng.integers(1, len(whole))] if k % 5 == 0 else whole)
        for at in rng.integers(0, len(damaged), 12):
            damaged[at] = rng.integers(0, 256)
        file.write_bytes(damaged)
        try:
            table = read_table(file, "data")
            for name in table.names:
                table.read(name)
        except InputError as error:
            assert file.name in str(error)


# Rollouts: a command and no torque


def test_a_command_without_torque_is_drafted_as_a_rollout(made, tmp_path: Path):
    urdf, joints, run = made
    np.savez(tmp_path / "run.npz", t=run["time"], q=run["position"], action=run["position"] + 0.01)
    with pytest.raises(Undecided, match="give the gains of the position servos by --kp"):
        draft_task(urdf, [tmp_path / "run.npz"])
    (tmp_path / "task.yaml").write_text(draft_task(urdf, [tmp_path / "run.npz"], gains=[9.0, 8.0, 7.0]).text)
    task = load_task(tmp_path / "task.yaml")
    assert task.data[0].command == "action" and task.actuator.drives[joints[1]].kp == 8.0
