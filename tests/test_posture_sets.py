"""Several kinematic errors at once, and recordings of an arm that was not the same in all: made by Pinocchio."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from generators import posture_sets
from test_kinematic_diagnosis import study

from figaroh_jax.calibration.changes import with_own_frames
from figaroh_jax.estimation.posegroups import shared
from figaroh_jax.recordings.poses import PoseRecording


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("sets")


def graded(folder: Path, case: Any, robot: str = "arm6") -> tuple[Any, Any]:
    """What became of everything that was hidden, and the answer."""
    bench = study()
    found = bench.diagnose(bench.arm(robot, folder), case)
    return bench.kinematic_sets.graded(case, found), found


def told(found: Any) -> list[str]:
    return [note for note in found.calibration.notes if "the recordings differ" in note]


def test_a_marker_that_was_moved_between_recordings_is_told_and_no_posture_is_an_outlier(folder: Path):
    """Drawn at run time; the last recording stood for a dozen outliers."""
    case = posture_sets.differ(study().arm("arm6", folder), "marker", 0, np.random.default_rng(), 30)
    _, found = graded(folder, case)
    assert (found.verdict, found.causes) == ("unknown", ()), found.causes
    place = f"in run{len(case.recordings) - 1} the device or its marker"
    assert any(place in note and "tool_frame" in note for note in told(found)), told(found)


def test_the_first_recording_gets_frames_of_its_own_as_any_other():
    """With 0 as the number of its group it was one with the others, whose frames are told by False."""
    q, poses = np.zeros((4, 2)), np.broadcast_to(np.eye(4), (4, 4, 4))
    device = ("pose", poses, "base", "tool", ("base",))
    made = [PoseRecording(f"run{k}", Path(f"run{k}.csv"), np.arange(4.0), q, *device) for k in range(3)]
    for k in range(3):
        assert sorted(map(sorted, shared(with_own_frames(made, k)))) == sorted([[k], [j for j in range(3) if j != k]])


def test_a_joint_that_lost_its_zero_between_recordings_is_named_with_both(folder: Path):
    case = posture_sets.differ(study().arm("arm6", folder), "joint_offset", 0, np.random.default_rng(3), 30)
    grade, found = graded(folder, case)
    assert (found.verdict, grade.marks, grade.false) == ("named+rest", ("named",), ()), found.causes
    last = f"change in run{len(case.recordings) - 1}"
    change, (truth,) = found.causes[0].parameters[last], case.truths
    assert abs(change.value - truth.values["change"]) < 4.0 * change.std < 1e-3
    (note,) = told(found)
    assert f"{truth.name[1][0]} has another zero in" in note


def test_recordings_of_a_robot_that_is_the_same_are_not_said_to_differ(folder: Path):
    case = posture_sets.differ(study().arm("arm6", folder), None, 0, np.random.default_rng(2), 30)
    _, found = graded(folder, case)
    assert (found.verdict, found.causes, told(found)) == ("nothing", (), [])


@pytest.mark.slow
def test_an_encoder_that_errs_in_one_recording_is_no_dozen_of_outliers(folder: Path):
    """What that recording alone has is said, and what all of them have keeps its name."""
    arm, rng = study().arm("arm6", folder), np.random.default_rng(11)
    for _ in range(3):
        grade, found = graded(folder, posture_sets.differ(arm, "encoder_eccentricity", 0, rng))
        assert found.verdict in ("unknown", "named+rest") and not grade.false and told(found), found.causes


@pytest.mark.slow
def test_two_effects_of_one_joint_are_not_taken_for_two_others(folder: Path):
    """A scale and a gear's error over a part of a turn: one by one they were an eccentricity and another gear's."""
    bench = study()
    for seed in (25, 64):  # of `hidden_kinematics.py --several 2 3`, the Panda
        rng = np.random.default_rng([seed, 733])
        robots = [bench.arm(name, folder) for name in ("arm6", "panda")]
        arm = robots[int(rng.integers(2))]
        grade, found = graded(folder, posture_sets.hide_several(arm, int(rng.choice((2, 3))), rng), "panda")
        assert "missed" not in grade.marks and not grade.false, found.causes


@pytest.mark.slow
def test_numbers_of_a_link_that_is_far_off_are_those_that_were_hidden(folder: Path):
    """15 tolerances: products of its rotation and shift with what offsets share are many deviations."""
    bench = study()
    arm, rng, sigmas = bench.arm("arm6", folder), np.random.default_rng(8), list[float]()
    for _ in range(4):
        q, built = posture_sets.postures._postures(arm, rng, 60), posture_sets._built(arm, rng, 0.6)
        name, values, error = posture_sets._one(arm, "link_geometry", 15.0, rng, q, built)
        seen = posture_sets._seen(posture_sets.postures._poses(arm, q, built, error), rng)
        run = posture_sets.Recording(np.arange(60.0), q, seen, False)
        case = posture_sets.Hidden((posture_sets.Truth(name, 15.0, values),), "", (run,))
        grade, _ = graded(folder, case)
        sigmas += [s for _, s in grade.sigmas]
    assert len(sigmas) > 5 and np.max(np.abs(sigmas)) < 4.0, sigmas
