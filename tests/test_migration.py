"""Configurations of FIGAROH become tasks that run; none of their keys is passed over in silence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tasks

from figaroh_jax import cli
from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.robotfile import load_robot
from figaroh_jax.recordings.migration import KEYS, migrate
from figaroh_jax.recordings.poses import read_pose_recordings

FLAT = """
calibration:
  calib_level: full_params
  non_geom: false
  base_frame: universe
  tool_frame: hand
  markers:
    - {ref_joint: slide, measure: [True, True, True, False, False, False]}
  free_flyer: false
  base_pose: [0, 0, 0, 0, 0, 0]
  tip_pose: [0, 0, 0, 0, 0, 0]
  coeff_regularize: 0.01
  outlier_eps: 0.05
  data_file: points.csv
  sample_configs_file: none.yaml
  nb_sample: 20
identification:
  robot_params:
    - {q_lim_def: 1.57, fv: [1, 1, 1], fs: [1, 1, 1], Ia: [1, 1, 1], offset: [0, 0, 0], Iam6: 0, fvm6: 0, fsm6: 0,
       reduction_ratio: [32, 45, 10], ratio_essential: 30, dq_lim_def: [0.05, 0.06, 0.07], ddq_lim_def: 20,
       tau_lim_def: 4}
  trajectory_params:
    - {n_wps: 5, freq: 100, t_s: 2.0, soft_lim: 0.05, max_attempts: 100}
  problem_params:
    - {is_external_wrench: false, is_joint_torques: true, force_torque: None, external_wrench_offsets: false,
       has_friction: true, has_joint_offset: true, has_actuator_inertia: true, is_static_regressor: true,
       is_inertia_regressor: true, has_coupled_wrist: true, embedded_forces: false,
       active_joints: [shoulder, elbow, slide]}
  processing_params:
    - {cut_off_frequency_butterworth: 12.0, ts: 0.002}
  tls_params:
    - {mass_load: 0.0, which_body_loaded: 0, sync_joint_motion: false}
"""
UNIFIED = """
robot:
  name: arm
  properties:
    joints: {active_joints: [shoulder, elbow, slide]}
    mechanics: {reduction_ratios: [], friction_coefficients: {viscous: [], static: []}, actuator_inertias: []}
    coupling: {has_coupled_wrist: false}
tasks:
  identification:
    enabled: true
    problem: {use_joint_torques: true, wls: true, model_components: {friction: true, joint_offset: false}}
    signal_processing: {sampling_frequency: 500.0, cutoff_frequency: 15.0, filter_type: butterworth, filter_order: 4}
    colour: red
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    tasks.write(tmp_path, tasks.task())
    (tmp_path / "flat.yaml").write_text(FLAT)
    (tmp_path / "unified.yaml").write_text(UNIFIED)
    return tmp_path


def test_the_flat_layout_becomes_an_identification(folder: Path):
    found = migrate(folder / "flat.yaml", folder / "robot.urdf")
    (folder / "new.yaml").write_text(found.text.replace("RECORDING.csv", "run1.npz"))
    task = load_task(folder / "new.yaml")
    assert task.robot.joints == ("shoulder", "elbow", "slide")
    assert task.preprocess.cutoff == 12.0 and task.data[0].rate == 500.0
    assert task.preprocess.gate == {"shoulder": 0.05, "elbow": 0.06, "slide": 0.07}
    assert task.baseline.rotor and task.baseline.offset and task.baseline.effects[0].at == ("elbow", "slide")
    assert task.excite is not None and (task.excite.basis.quintic, task.excite.duration) == (5, 8.0)
    assert not [line for line in found.keys if "NOT TRANSLATED" in line]
    assert "transmission: {position: [32, 45, 10]" in found.text


def test_the_flat_layout_becomes_a_calibration_of_its_points(folder: Path):
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(20, 6))
    names = "x1,y1,z1,shoulder,elbow,slide"
    np.savetxt(folder / "points.csv", rows, delimiter=",", header=names, comments="")
    frame = load_robot(load_task(folder / "task.yaml")).frames[-1].name
    (folder / "flat.yaml").write_text(FLAT.replace("tool_frame: hand", f"tool_frame: {frame}"))
    (folder / "new.yaml").write_text(migrate(folder / "flat.yaml", folder / "robot.urdf", job="calibrate").text)
    task = load_task(folder / "new.yaml")
    (recording,) = read_pose_recordings(task, load_robot(task))
    np.testing.assert_array_equal(recording.position, rows[:, 3:])


def test_the_unified_layout_drafts_its_recordings_and_names_keys_that_it_does_not_know(folder: Path):
    found = migrate(folder / "unified.yaml", folder / "robot.urdf")
    assert [line for line in found.keys if "NOT TRANSLATED" in line] == [
        "tasks.identification.colour: NOT TRANSLATED: this key is not known"
    ]
    (folder / "new.yaml").write_text(found.text.replace("RECORDING.csv", "run1.npz"))
    task = load_task(folder / "new.yaml")
    assert task.preprocess.cutoff == 15.0 and task.data[0].rate == 500.0 and not task.baseline.offset


def test_what_keys_become_are_keys_of_a_task():
    """A name that begins with a dot is a key of the task file, as the reference has it."""
    from figaroh_jax.formats.reference import KEYS as REFERENCE

    named = {word.rstrip(":,;") for text in KEYS.values() for word in text.split() if word.startswith(".")}
    whole = {"baseline.effects", "excite.limits", "transmission", "data[].measurement"}
    assert {name[1:] for name in named} <= {*REFERENCE, *whole}


def test_the_command_writes_a_task_once(folder: Path, capsys: pytest.CaptureFixture[str]):
    command = ["migrate", str(folder / "flat.yaml"), str(folder / "robot.urdf"), "--out", str(folder / "out.yaml")]
    assert cli.main(command) == 0 and "calibration.nb_sample: nothing: all rows" in capsys.readouterr().out
    assert cli.main(command) == 2 and "exists already" in capsys.readouterr().err
    with pytest.raises(InputError, match="no configuration of FIGAROH"):
        migrate(folder / "task.yaml", folder / "robot.urdf")
