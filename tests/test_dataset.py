"""Recordings: formats, columns, units and the way from the motor to the joint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv, parquet
from tasks import JOINTS, arrays, task, write

from figaroh_jax.formats.config import Preprocess, Task, load_task
from figaroh_jax.formats.robotfile import load_robot
from figaroh_jax.recordings.dataset import Recording, read_recordings
from figaroh_jax.recordings.signals import prepare


def recordings(folder: Path, *entries: dict, **keys) -> tuple[Recording, ...]:
    """Recordings of a task with these data entries, each with the usual names where it gives none."""
    full = [{"file": "run1.npz", "time": "t", "position": "q", "torque": "tau"} | entry for entry in entries]
    read = load_task(write(folder, {**task(), "data": full, **keys}))
    return read_recordings(read, load_robot(read))


def columns(prefixes: dict[str, str], names: tuple[str, ...]) -> pa.Table:
    """The usual arrays as a table whose columns are prefix + name."""
    data = arrays()
    table = {"t": data["t"]}
    for key, prefix in prefixes.items():
        table |= {prefix + name: data[key][:, k] for k, name in enumerate(names)}
    return pa.table(dict(reversed(table.items())))


def assert_close(actual: np.ndarray | None, expected: np.ndarray) -> None:
    assert actual is not None
    np.testing.assert_allclose(actual, expected, rtol=1e-13, atol=1e-12)


def assert_same(one: Recording, other: Recording) -> None:
    for key in ("time", "position", "velocity", "torque"):
        np.testing.assert_allclose(getattr(one, key), getattr(other, key), rtol=0, atol=1e-12)


def test_three_formats_give_the_same_recording(tmp_path):
    table = columns({"q": "q", "dq": "dq", "tau": "tau"}, ("1", "2", "3"))
    csv.write_csv(table, tmp_path / "run.csv")
    parquet.write_table(table, tmp_path / "run.parquet")
    read = recordings(tmp_path, *({"file": f, "velocity": "dq"} for f in ("run1.npz", "run.csv", "run.parquet")))
    assert [r.name for r in read] == ["run1", "run", "run"]
    assert read[0].joints == JOINTS
    np.testing.assert_array_equal(read[0].position, arrays()["q"])
    assert_same(read[0], read[1])
    assert_same(read[0], read[2])


@pytest.mark.parametrize(
    "names",
    [("_1", "_2", "_3"), ("0", "1", "2"), ("[0]", "[1]", "[2]"), ("8", "9", "10"), ("_shoulder", "_elbow", "_slide")],
)
def test_a_prefix_finds_its_columns_in_natural_order(tmp_path, names):
    parquet.write_table(columns({"q": "q", "tau": "tau"}, names), tmp_path / "run.parquet")
    one, other = recordings(tmp_path, {}, {"file": "run.parquet"})
    assert_same_motion(one, other)


def assert_same_motion(one: Recording, other: Recording) -> None:
    assert one.torque is not None and other.torque is not None
    np.testing.assert_array_equal(one.position, other.position)
    np.testing.assert_array_equal(one.torque, other.torque)


def test_a_list_of_columns_is_taken_in_its_order(tmp_path):
    csv.write_csv(columns({"q": "angle ", "tau": "tau"}, ("c", "a", "b")), tmp_path / "run.csv")
    names = {"position": ["angle c", "angle a", "angle b"], "torque": ["tauc", "taua", "taub"]}
    one, other = recordings(tmp_path, {}, {"file": "run.csv", **names})
    np.testing.assert_allclose(one.position, other.position, rtol=0, atol=1e-15)


def test_semicolons_a_byte_order_mark_and_spaces_in_a_csv_header_do_no_harm(tmp_path):
    data = arrays()
    lines = ["\ufefft; q1; q2; q3; tau1; tau2; tau3"]
    lines += [";".join(map(repr, map(float, row))) for row in np.column_stack([data["t"], data["q"], data["tau"]])]
    (tmp_path / "run.csv").write_text("\n".join(lines), encoding="utf-8")
    one, other = recordings(tmp_path, {}, {"file": "run.csv"})
    assert_same_motion(one, other)


def test_a_rate_stands_in_for_time(tmp_path):
    write(tmp_path)
    (read,) = recordings(tmp_path, {"time": None, "rate": 250})
    np.testing.assert_allclose(read.time, arrays()["t"], rtol=0, atol=1e-12)


def test_degrees_are_of_turning_joints_and_millimetres_of_sliding_ones(tmp_path):
    deg, mm = recordings(
        tmp_path,
        {"velocity": "dq", "command": "q", "units": {"position": "deg"}},
        {"velocity": "dq", "units": {"position": "mm", "velocity": "m/s"}},
    )
    data = arrays()
    turning = np.array([np.pi / 180, np.pi / 180, 1.0])
    assert_close(deg.position, data["q"] * turning)
    assert_close(deg.velocity, data["dq"] * turning)
    assert_close(deg.command, data["q"] * turning)
    assert_close(mm.position, data["q"] * [1, 1, 1e-3])
    assert_close(mm.velocity, data["dq"])


def test_roles_repeats_and_a_holdout_without_torque(tmp_path):
    fit, held = recordings(tmp_path, {"repeat": 1}, {"file": "run2.npz", "role": "holdout", "torque": None})
    assert (fit.role, fit.repeat) == ("fit", "1")
    assert (held.role, held.torque) == ("holdout", None)


def test_a_known_load_stays_with_its_recording_and_its_signals(tmp_path):
    loaded, bare = recordings(tmp_path, {"load": {"frame": "tool0", "mass": 2}}, {})
    assert loaded.load is not None and loaded.load.mass == 2 and bare.load is None
    assert prepare(loaded, Preprocess()).load == loaded.load


def test_velocity_passes_the_transmission_and_takes_no_offset(tmp_path):
    ratio = [[10.0, 0, 0], [2.0, 20.0, 0], [0, 0, -5.0]]
    (read,) = recordings(tmp_path, {"velocity": "dq"}, transmission={"position": ratio, "offset": [1.0, 2.0, 3.0]})
    data = arrays()
    assert read.velocity is not None
    assert_close(read.velocity @ np.array(ratio).T, data["dq"])
    assert_close((read.position - [1, 2, 3]) @ np.array(ratio).T, data["q"])


def test_amperes_become_newton_metres(tmp_path):
    gains = np.diag([10.0, 8.0, -3.0])
    (read,) = recordings(tmp_path, {"units": {"torque": "A"}}, transmission={"torque": gains.tolist()})
    assert_close(read.torque, arrays()["tau"] @ gains)


def tx40_task(folder: Path, data_dir: Path) -> Task:
    n = [32, 32, 45, -48, 45, 32]
    position, torque = np.diag(n).tolist(), np.diag(n).tolist()
    position[5][4] = torque[4][5] = 32
    keys = {
        "robot": {"model": str(data_dir / "staubli_tx40" / "tx40.urdf")},
        "data": [
            {
                "file": str(data_dir / "staubli_tx40" / "tx40.npz"),
                "rate": 5000,
                "position": "motor_position",
                "torque": "motor_current",
            }
        ],
        "transmission": {
            "position": position,
            "torque": torque,
            "offset": [0, -float(np.pi) / 2, float(np.pi) / 2, 0, 0, 0],
        },
    }
    return load_task(write(folder, keys))


def test_the_motors_of_the_tx40_become_joints_as_its_readme_says(tmp_path, data_dir):
    read = tx40_task(tmp_path, data_dir)
    (recording,) = read_recordings(read, load_robot(read))
    z = np.load(data_dir / "staubli_tx40" / "tx40.npz")
    n = np.array([32.0, 32, 45, -48, 45, 32])
    rq, rt = np.diag(n), np.diag(n)
    rq[5, 4] = rt[4, 5] = 32
    q = (np.linalg.inv(rq) @ z["motor_position"].T).T
    q[:, 1] -= np.pi / 2
    q[:, 2] += np.pi / 2
    assert_close(recording.position, q)
    assert_close(recording.torque, (rt @ z["motor_current"].T).T)
    assert recording.time[-1] == pytest.approx(44999 / 5000)
