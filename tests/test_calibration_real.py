"""Real robots, calibrated with everything chosen inside the folds: errors on postures left out, and what is named."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

import figaroh_jax as fj
from figaroh_jax.calibration.calibrated import Calibration
from figaroh_jax.calibration.calibration import Run, calibrate
from figaroh_jax.calibration.kinematic_diagnosis import diagnose_poses

DISTANCES = {"mukca panda_2_clean": 0.19, "mukca panda_3": 0.04, "mukca panda_4_clean": 0.04}  # mm, not fitted
ROOT = Path(__file__).resolve().parents[1]


def bench(data_dir: Path) -> Any:
    """The benchmark, which reads the sets."""
    spec = importlib.util.spec_from_file_location("bench_calibration", ROOT / "benchmarks" / "calibration.py")
    assert spec is not None and spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.DATA = data_dir
    return module


def calibrated(name: str, data_dir: Path, **options: Any) -> Calibration:
    sets = bench(data_dir)
    model, recordings = sets.SETS[name]()
    points = [replace(r, values=sets.points_of(r.values)) if r.kind == "position" else r for r in recordings]
    return calibrate(model, points, **options)


def names(found: Calibration) -> set[tuple[str, ...]]:
    return {(cause.name.effect, *cause.name.at) for cause in found.causes}


def test_irb120_predicts_a_quarter_of_a_millimetre_and_its_third_joint_gives_way(data_dir: Path):
    found = calibrated("irb120_wu2015", data_dir)
    assert found.position is not None
    assert abs(found.position.validated_before - 5.952) < 1e-3  # frames alone, an external fact
    assert found.position.validated_after <= 0.221  # .2245 where folds take gear errors of a high order by chance
    assert ("joint_compliance", "joint_3") in names(found)
    assert {("joint_offset", f"joint_{k}") for k in (2, 3, 4, 5)} <= names(found)
    assert any("500 m" in note for note in found.notes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "frames", "limit"),
    [
        ("talos_contact", 5.423, 0.70),
        ("tiago_mocap, 34", 4.670, 3.6),
        ("tiago_mocap, all 35", 4.670, 3.6),
        ("tiago_mocap, three markers", 4.874, 3.8),
        ("panda_handeye_board", 4.793, 1.55),
        ("mukca panda_2_clean", 9.109, 0.32),
        ("mukca panda_3", 2.985, 0.21),
        ("mukca panda_4_clean", 4.190, 0.25),
    ],
)
def test_real_sets_predict_at_least_as_well_as_stated(name: str, frames: float, limit: float, data_dir: Path):
    found = calibrated(name, data_dir)
    assert found.position is not None
    assert abs(found.position.validated_before - frames) < 2e-3
    assert found.position.validated_after <= limit
    assert [o.row for o in found.outliers] == ([9] if name.endswith("35") else [])
    if name in DISTANCES:
        held = [abs(d.after - d.stated) for d in found.distances if d.role == "holdout"]
        assert 1e3 * sum(held) / len(held) <= DISTANCES[name]
    if name == "talos_contact":
        assert abs(found.position.before - 5.159) < 1e-3  # an external fact
        assert "joint_compliance" in {effect for effect, *_ in names(found)}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "talos_contact",
        "tiago_mocap, 34",
        "tiago_mocap, all 35",
        "tiago_mocap, three markers",
        "irb120_wu2015",
        "panda_handeye_board",
        *DISTANCES,
        "mukca panda_1",
    ],
)
def test_what_is_named_predicts_held_out_postures_better_than_the_frames_alone(name: str, data_dir: Path):
    sets = bench(data_dir)
    model, recordings = sets.SETS[name]()
    points = [replace(r, values=sets.points_of(r.values)) if r.kind == "position" else r for r in recordings]
    found = diagnose_poses(model, points)
    position = found.calibration.position
    assert position is not None
    if any(cause.name.effect != "outlier" for cause in found.causes):
        assert position.validated_after < position.validated_before
    for cause in found.causes:
        assert cause.name.effect == "outlier" or cause.gain.after < cause.gain.before, cause


@pytest.mark.slow
def test_one_tool_position_is_said_to_be_too_few(data_dir: Path):
    assert any("one position" in note for note in calibrated("mukca panda_1", data_dir).notes)


def figures(found: Calibration) -> tuple[float, ...]:
    assert found.position is not None
    position = found.position
    return position.before, position.after, position.validated_before, position.validated_after


def test_tiago_s_fourteen_offsets_and_full_geometry_fit_as_published(data_dir: Path):
    """Frames 4.087 mm, 14 parameters 3.539; five-fold 4.670 and 4.294, full without priors 4.791 (a study in numpy)."""
    offsets = calibrated("tiago_mocap, 34", data_dir, level="joint_offset", priors=False)
    assert (offsets.rank, len(offsets.parameters)) == (14, 14)
    assert figures(offsets) == pytest.approx((4.087, 3.539, 4.670, 4.294), rel=0, abs=1e-3)
    full = calibrated("tiago_mocap, 34", data_dir, level="full", priors=False)
    assert figures(full)[2:] == pytest.approx((4.670, 4.791), rel=0, abs=1e-3)
    assert any("no better than the frames alone" in note for note in full.notes)


@pytest.mark.slow
def test_talos_with_sixteen_and_thirty_nine_parameters_fits_as_published(data_dir: Path):
    offsets = calibrated("talos_contact", data_dir, level="joint_offset", priors=False)
    assert offsets.rank == 16
    assert figures(offsets) == pytest.approx((5.159, 1.430, 5.423, 1.580), rel=0, abs=1e-3)
    full = calibrated("talos_contact", data_dir, level="full", priors=False)
    assert full.rank == 39 and full.converged
    assert figures(full)[1] == pytest.approx(0.509, rel=0.01)


def test_known_distances_are_fitted_though_the_last_recording_is_held_out(data_dir: Path):
    model, recordings = bench(data_dir).SETS["mukca panda_4_clean"]()
    assert recordings[-1].role == "holdout"
    measured = Run(model, recordings, (), lambda phase, share: None).measured
    assert (measured.posture == -1).sum() == 2  # one of each tool position that is fitted
    assert measured.fitted[measured.posture == -1].all()


def test_a_posture_that_a_diagnosis_leaves_out_is_told_where_it_has_no_name(data_dir: Path, tmp_path: Path):
    """Posture 9 of TIAGo is 60 mm off (README of the set); beside a joint that seems to play it is not named."""
    joints = ["torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8))]
    points = [f"{axis}{marker}" for marker in range(1, 5) for axis in "xyz"]  # as the file has them, one twice
    frames = {"base_frame": "base_link", "tool_frame": "arm_7_link", "unknown": ["base_frame", "tool_frame"]}
    folder = data_dir / "tiago_mocap"
    entry = {"file": str(folder / "qualysis_base_hand_calibration.csv"), "position": joints}
    robot = {"model": str(folder / "tiago_no_hand.urdf"), "joints": joints}
    task = {"robot": robot, "data": [entry | {"measurement": {"position": points, **frames}}]}
    (tmp_path / "task.yaml").write_text(yaml.safe_dump(task))
    found = fj.diagnose_task(fj.load_task(tmp_path / "task.yaml"))
    named = any(cause.name.effect == "outlier" for cause in found.causes)
    assert named or any("row 9 of" in note and "left out" in note for note in found.calibration.notes)
