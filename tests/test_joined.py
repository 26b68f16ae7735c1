"""Recordings of ROS without ROS: stamps in two halves, and joints named by columns of their own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from generators import make_case

from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.robotfile import load_robot
from figaroh_jax.recordings.dataset import Recording, read_recordings
from figaroh_jax.recordings.draft import draft_task
from figaroh_jax.recordings.draft_columns import Undecided
from figaroh_jax.recordings.reading import read_table

ORDER = [2, 0, 1]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, tuple[str, ...], dict[str, Any]]:
    case = make_case(robot="small", repeats=1, trajectories=1, seed=4)
    urdf = tmp_path_factory.mktemp("robot") / "robot.urdf"
    urdf.write_text(case.urdf)
    return urdf, case.joints, case.recordings[0]


def drafted(urdf: Path, file: Path) -> Recording:
    task_file = file.with_suffix(".yaml")
    task_file.write_text(draft_task(urdf, [file]).text, encoding="utf-8")
    task = load_task(task_file)
    (recording,) = read_recordings(task, load_robot(task))
    return recording


def agrees(recording: Recording, run: dict[str, Any]) -> None:
    np.testing.assert_allclose(recording.position, run["position"], rtol=0, atol=1e-9)
    assert recording.torque is not None
    np.testing.assert_allclose(recording.torque, run["torque"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.diff(recording.time), np.diff(run["time"]), rtol=0, atol=5e-7)


def halves(run: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    stamps = np.round(np.asarray(run["time"]) * 1e9).astype(np.int64) + 1_700_000_000_700_000_000
    return stamps // 10**9, stamps % 10**9


@pytest.mark.parametrize(("coarse", "fine"), [("secs", "nsecs"), ("js/header/stamp/sec", "js/header/stamp/nanosec")])
def test_seconds_and_their_part_are_one_clock(made, coarse: str, fine: str, tmp_path: Path):
    urdf, _, run = made
    seconds, part = halves(run)
    np.savez(tmp_path / "run.npz", **{coarse: seconds, fine: part, "q": run["position"], "tau": run["torque"]})
    agrees(drafted(urdf, tmp_path / "run.npz"), run)
    assert yaml.safe_load((tmp_path / "run.yaml").read_text())["data"][0]["time"] == f"{coarse}+{Path(fine).name}"


def test_halves_that_are_none_are_refused_with_their_row(made, tmp_path: Path):
    urdf, _, run = made
    seconds, part = halves(run)
    part[7] = 10**9
    np.savez(tmp_path / "run.npz", secs=seconds, nsecs=part, q=run["position"], tau=run["torque"])
    with pytest.raises(InputError, match=r"'nsecs' is 1e\+09 in row 7 \(from 0\), which is no part of a second"):
        draft_task(urdf, [tmp_path / "run.npz"])
    np.savez(tmp_path / "run.npz", nsecs=part, q=run["position"], tau=run["torque"])
    with pytest.raises(Undecided, match="nsecs are parts of a time"):
        draft_task(urdf, [tmp_path / "run.npz"])


@pytest.mark.parametrize("before", ["", "joint_states/"])
def test_names_beside_arrays_tell_the_order_of_the_joints(made, before: str, tmp_path: Path):
    urdf, joints, run = made
    arrays = {"name": np.array(joints)[ORDER], "position": run["position"][:, ORDER], "effort": run["torque"][:, ORDER]}
    np.savez(tmp_path / "run.npz", time=run["time"], **{before + name: values for name, values in arrays.items()})
    agrees(drafted(urdf, tmp_path / "run.npz"), run)


@pytest.mark.parametrize("form", ["{}[{}]", "{}_{}", "/arm/{}.{}", "field.{}{}"])
@pytest.mark.parametrize("changing", [False, True])
def test_names_in_columns_of_text_tell_the_order_of_the_joints(made, form: str, changing: bool, tmp_path: Path):
    """A flattened topic: of several publishers the order of the joints may change from row to row."""
    urdf, joints, run = made
    rows = np.tile(ORDER, (len(run["time"]), 1))
    rows[::3] = [0, 1, 2] if changing else ORDER
    parts = {"name": np.array(joints)[rows]}
    parts |= {
        "position": np.take_along_axis(run["position"], rows, 1),
        "effort": np.take_along_axis(run["torque"], rows, 1),
    }
    columns = {"Time": run["time"], "state": np.full(len(rows), "RUN")}
    columns |= {form.format(word, k): values[:, k] for word, values in parts.items() for k in range(3)}
    lines = [",".join(columns), *(",".join(map(str, row)) for row in zip(*columns.values(), strict=True))]
    (tmp_path / "run.csv").write_text("\n".join(lines))
    agrees(drafted(urdf, tmp_path / "run.csv"), run)


def test_names_in_one_cell_tell_the_order_of_numbered_columns(made, tmp_path: Path):
    urdf, joints, run = made
    shown = ";".join(["time", "name", *(f"{word}_{k}" for word in ("position", "effort") for k in range(3))])
    name = str([joints[k] for k in ORDER])
    values = np.column_stack([run["position"][:, ORDER], run["torque"][:, ORDER]])
    rows = [f"{t!r};{name};" + ";".join(map(str, row)) for t, row in zip(run["time"].tolist(), values, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join([shown, *rows]))
    agrees(drafted(urdf, tmp_path / "run.csv"), run)


def test_a_row_that_does_not_name_a_joint_has_no_number_of_it(tmp_path: Path):
    names = np.array([["a", "b"], ["b", "c"]])
    np.savez(tmp_path / "run.npz", name=names, position=np.array([[1.0, 2.0], [3.0, 4.0]]))
    table = read_table(tmp_path / "run.npz", "data")
    np.testing.assert_array_equal(table.read("position.a"), [1.0, np.nan])
    np.testing.assert_array_equal(table.read("position.b"), [2.0, 3.0])
    assert "position" in table.names


def test_the_state_of_a_controller_is_no_position(made, tmp_path: Path):
    """Its mode as a word or a number beside a running index, as pandas writes it."""
    urdf, joints, run = made
    count = np.arange(len(run["time"]))
    for clock, mode in (("t", np.full(len(count), "RUN")), ("Zeit", np.full(len(count), 3))):
        columns = {"": count, clock: run["time"], "state": mode}
        columns |= {f"q_{joint}": run["position"][:, j] for j, joint in enumerate(joints)}
        columns |= {f"tau_{joint}": run["torque"][:, j] for j, joint in enumerate(joints)}
        lines = [",".join(columns), *(",".join(map(str, row)) for row in zip(*columns.values(), strict=True))]
        (tmp_path / "run.csv").write_text("\n".join(lines))
        agrees(drafted(urdf, tmp_path / "run.csv"), run)


def test_a_topic_as_plotjuggler_writes_it_is_read(made, tmp_path: Path):
    urdf, joints, run = made
    columns = {"__time": run["time"] + 1.7e9}
    columns |= {f"/joint_states/{joint}/position": run["position"][:, j] for j, joint in enumerate(joints)}
    columns |= {f"/joint_states/{joint}/effort": run["torque"][:, j] for j, joint in enumerate(joints)}
    lines = [",".join(columns), *(",".join(map(repr, map(float, row))) for row in zip(*columns.values(), strict=True))]
    (tmp_path / "run.csv").write_text("\n".join(lines))
    agrees(drafted(urdf, tmp_path / "run.csv"), run)
