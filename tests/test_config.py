"""The task file: what is read, inherited and refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from tasks import task, write

from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import Preprocess, Task, load_task
from figaroh_jax.formats.robotfile import load_robot
from figaroh_jax.recordings.dataset import read_recordings
from figaroh_jax.reporting.run_directory import task_inputs

CONTRACT = """
robot:
  model: robot.urdf
  root: fixed
  joints: [j1, j2]
  posture: {finger_joint1: 0.0}
  gravity: [0.0, 0.0, -9.81]
  trust: 0.10
data:
  - file: run1.npz
    time: t
    position: q
    velocity: dq
    torque: tau
    command: u
    load: {frame: tool0, mass: 2.0, com: [0, 0, 0.05]}
    repeat: A
    role: fit
    units: {position: deg, measurement: mm}
transmission:
  position: [[32, 0], [0, 32]]
  torque: [[32, 0], [0, 32]]
  offset: [0.0, -1.5708]
preprocess:
  window: [0.05, 7.66]
  cutoff: 20
  rate: 100
  gate: {joint_1: 0.05}
baseline:
  {viscous: true, coulomb: true, rotor: false, offset: false,
   effects: [{effect: coupled_transmission, at: [joint_5, joint_6]}]}
actuator: {gains: known}
diagnose:
  forbid: []
  alpha: 0.05
"""

POSTURES = """
robot: {model: robot.urdf}
data:
  - file: postures.npz
    position: q
    role: fit
    measurement:
      position: point
      base_frame: base_link
      tool_frame: tool0
      unknown: [base_frame, tool_frame]
      accuracy: {position: 1e-4, orientation: 1.0e-3}
"""


def read(folder: Path, text: str) -> Task:
    file = folder / "task.yaml"
    file.write_text(text)
    return load_task(file)


def test_the_contracts_task_is_read_whole(tmp_path):
    read_task = read(tmp_path, CONTRACT)
    assert read_task.robot.model == tmp_path / "robot.urdf"
    assert read_task.data[0].file == tmp_path / "run1.npz"
    assert read_task.data[0].load is not None and read_task.data[0].load.com == (0, 0, 0.05)
    assert read_task.preprocess.window == (0.05, 7.66) and read_task.preprocess.gate == {"joint_1": 0.05}
    assert read_task.baseline.effects[0].at == ("joint_5", "joint_6")
    assert read_task.transmission is not None and read_task.transmission.offset == (0, -1.5708)
    assert read_task.file == tmp_path / "task.yaml"


def test_what_is_left_out_has_the_contracts_defaults(tmp_path):
    read_task = load_task(write(tmp_path))
    assert read_task.robot.trust == 0.10 and read_task.robot.gravity == (0, 0, -9.81)
    assert read_task.baseline.viscous and read_task.baseline.coulomb
    assert not (read_task.baseline.rotor or read_task.baseline.offset or read_task.baseline.effects)
    assert read_task.diagnose.alpha == 0.05 and read_task.diagnose.forbid == ()
    assert read_task.actuator.gains == "known" and read_task.transmission is None


def test_a_task_of_postures_needs_no_time(tmp_path):
    measurement = read(tmp_path, POSTURES).data[0].measurement
    assert measurement is not None and measurement.kind == "position"
    assert measurement.accuracy.position == 1e-4 and measurement.unknown == ("base_frame", "tool_frame")


def test_a_plane_needs_no_array(tmp_path):
    measurement = read(tmp_path, POSTURES.replace("position: point", "plane:")).data[0].measurement
    assert measurement is not None and measurement.kind == "plane" and measurement.plane is None


def test_extends_inherits_key_by_key_and_later_values_win(tmp_path):
    (tmp_path / "robots").mkdir()
    base = {**task(), "preprocess": {"cutoff": 15, "rate": 60}}
    (tmp_path / "robots" / "base.yaml").write_text(yaml.safe_dump(base))
    inherited = read(tmp_path, "extends: robots/base.yaml\npreprocess: {cutoff: 10}\nrobot: {trust: 0.5}\n")
    assert inherited.preprocess == Preprocess(cutoff=10, rate=60)
    assert inherited.robot.trust == 0.5


def test_each_files_paths_stand_against_its_own_folder(tmp_path):
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "base.yaml").write_text(yaml.safe_dump(task()))
    data = "data: [{file: run3.npz, time: t, position: q, torque: tau}]"
    inherited = read(tmp_path, f"extends: robots/base.yaml\n{data}\n")
    assert inherited.robot.model == tmp_path / "robots" / "robot.urdf"
    assert [entry.file for entry in inherited.data] == [tmp_path / "run3.npz"]


def test_a_mistake_is_said_of_the_file_in_which_it_stands(tmp_path):
    (tmp_path / "base.yaml").write_text(yaml.safe_dump({**task(), "preprocess": {"cutoff": -1}}))
    with pytest.raises(InputError, match="base.yaml: preprocess.cutoff"):
        read(tmp_path, "extends: base.yaml\n")
    with pytest.raises(InputError, match="task.yaml: preprocess.rate"):
        read(tmp_path, "extends: base.yaml\npreprocess: {cutoff: 1, rate: 0}\n")


def test_tasks_cannot_be_changed(tmp_path):
    with pytest.raises(ValueError, match="frozen"):
        load_task(write(tmp_path)).preprocess.cutoff = 3.0  # pyright: ignore


def test_the_robot_of_a_task_has_its_joints_in_their_order(tmp_path):
    keys = task()
    keys["robot"] |= {"joints": ["elbow", "shoulder"], "posture": {"slide": 0.1}, "gravity": [0, 0, -1.62]}
    model = load_robot(load_task(write(tmp_path, keys)))
    assert model.joint_names == ("elbow", "shoulder")
    assert tuple(model.gravity) == (0, 0, -1.62)


def test_the_path_of_a_robot_is_no_task(tmp_path):
    write(tmp_path, task())
    with pytest.raises(InputError, match="load_robot takes a task.*robot.urdf' is a path: load_urdf"):
        load_robot(tmp_path / "robot.urdf")  # pyright: ignore[reportArgumentType]


def test_a_free_root_is_loaded_but_refused_where_recordings_hold_joint_torques(tmp_path):
    keys = task()
    keys["robot"]["root"] = "free_flyer"
    read_task = load_task(write(tmp_path, keys))
    model = load_robot(read_task)
    assert model.joint_names == ("root_joint", "shoulder", "elbow", "slide") and (model.nq, model.nv) == (10, 9)
    with pytest.raises(InputError, match="robot.root is free_flyer: recordings of joint torques hold one column"):
        read_recordings(read_task, model)


def test_keys_are_a_task_as_a_file_of_them_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Paths are those of the working directory; the keys stay as they are; a mistake is named as in a file."""
    file = write(tmp_path)
    monkeypatch.chdir(tmp_path)
    keys = task()
    assert load_task(keys).model_dump() == load_task(file).model_dump()
    assert keys == task()
    keys["robot"]["model"] = Path("robot.urdf")
    assert load_task(keys).robot.model == tmp_path / "robot.urdf"
    (tmp_path / "base.yaml").write_text("preprocess: {cutoff: 7}")
    assert (
        load_task({**{k: v for k, v in task().items() if k != "preprocess"}, "extends": "base.yaml"}).preprocess.cutoff
        == 7
    )
    with pytest.raises(InputError, match="task: unknown key 'robott'; did you mean 'robot'"):
        load_task({"robott": {}, "data": task()["data"]})


def test_motions_to_predict_stand_beside_their_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """`excite.predict` resolves against the file that says it, from wherever it is read; it is an input of the run."""
    keys = {"robot": {"model": "robot.urdf"}, "excite": {"objective": "prediction", "predict": ["motion.npz"]}}
    file = write(tmp_path, keys)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    excite = load_task(file).excite
    assert excite is not None and excite.predict == (tmp_path / "motion.npz",)
    (tmp_path / "motion.npz").write_bytes(b"any")
    assert tmp_path / "motion.npz" in task_inputs(file)
