"""Kinematic effects hidden in postures by Pinocchio: named and placed, or nothing, or unknown, never a wrong name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import kinematic_laws as hidden
import numpy as np
import poses
import pytest
import test_calibration as tasks

from figaroh_jax import cli
from figaroh_jax.calibration.kinematic_diagnosis import PoseDiagnosis, diagnose_poses
from figaroh_jax.calibration.poserecords import PoseRecording
from figaroh_jax.formats.urdf import load_urdf

EFFECTS = (
    "encoder_scale",
    "encoder_eccentricity",
    "gear_transmission_error",
    "joint_compliance",
    "reversal_hysteresis",
    "backlash",
    "settling",
    "joint_coupling",
)
BOTH = ("base_frame", "tool_frame")


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "robot.urdf"
    path.write_text(poses.urdf())
    return path


def diagnosed(
    urdf: Path, seed: int, effect: str | None, size: float, joint: int, forbid: tuple[str, ...] = ()
) -> tuple[tuple[str, ...], PoseDiagnosis]:
    """A robot built a little off, with an effect of `size` rad RMS; where it acts, and the answer."""
    rng = np.random.default_rng(seed)
    built = {name: np.concatenate([3e-4 * rng.normal(size=3), 5e-4 * rng.normal(size=3)]) for name in poses.JOINTS}
    real = poses.truth(rng, twists=built)
    at: tuple[str, ...] = ()

    def error(q: np.ndarray) -> np.ndarray:
        nonlocal at
        if effect is None:
            return np.zeros_like(q)
        at, unit = hidden.laws(urdf, q, joint)[effect]
        return hidden.scaled(unit, size)

    q, points = hidden.hide(urdf, rng, real, error)
    clock = np.arange(len(q), dtype=float)
    recording = PoseRecording("hidden", urdf, clock, q, "position", points, "base", "tool0", BOTH)
    return at, diagnose_poses(load_urdf(urdf), [recording], forbid)


def names(found: PoseDiagnosis) -> list[tuple[str, tuple[str, ...]]]:
    return [(cause.name.effect, cause.name.at) for cause in found.causes]


@pytest.mark.parametrize(
    ("effect", "size", "joint"), [("backlash", 1e-3, 1), ("settling", 3e-4, 1), ("encoder_eccentricity", 3e-4, 3)]
)
def test_a_hidden_effect_is_named_where_it_is_and_nothing_else(effect: str, size: float, joint: int, urdf: Path):
    at, found = diagnosed(urdf, 31, effect, size, joint)
    assert names(found) == [(effect, at)]
    assert found.verdict == "named" and found.p_value < 0.05


def test_settling_that_is_not_in_the_catalogue_is_not_called_an_encoder_scale(urdf: Path):
    _, found = diagnosed(urdf, 32, "settling", 6e-4, 1, forbid=("settling", "reversal_hysteresis"))
    assert (found.verdict, found.causes) == ("unknown", ())


def test_a_robot_built_within_its_tolerance_gets_nothing(urdf: Path):
    _, found = diagnosed(urdf, 33, None, 0.0, 0)
    assert (found.verdict, found.causes) == ("nothing", ())
    assert found.experiment is None


def test_offsets_are_named_by_the_command_with_the_answer_of_the_contract(urdf: Path, tmp_path: Path, capsys: Any):
    rng = np.random.default_rng(34)
    real = poses.truth(rng, offset=np.array([0.0, 0.0, 0.02, 0.0, -0.03, 0.0]))
    q = poses.postures(rng, 60)
    task = tasks.write(tmp_path, q, poses.points(poses.tool_poses(urdf, q, real), real, rng))
    out = tmp_path / "run"
    assert cli.main(["diagnose", str(task), "--out", str(out), "--quiet"]) == 0
    assert capsys.readouterr().out.startswith("named")
    answer = json.loads((out / "answer.json").read_text())
    assert {(c["effect"], *c["at"]) for c in answer["causes"]} == {("joint_offset", "j3"), ("joint_offset", "j5")}
    for cause, value in zip(answer["causes"], (-0.03, 0.02), strict=True):
        found = cause["parameters"]["offset"]
        assert abs(found["value"] - value) < 4.0 * found["std"] + 1e-4
    assert set(answer) == {"verdict", "causes", "p_value", "residual", "next_experiment"}
    assert (out / "model" / "robot.urdf").is_file() and (out / "report.html").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("size", [1.5e-4, 3e-4, 1e-3])
@pytest.mark.parametrize("effect", EFFECTS)
def test_every_effect_is_named_or_left_open_at_every_size(effect: str, size: float, urdf: Path):
    seed = 200 + EFFECTS.index(effect)
    at, found = diagnosed(urdf, seed, effect, size, 1 + seed % 3)
    wrong = [name for name in names(found) if name != (effect, at)]
    assert wrong == []
    assert size < 3e-4 or (effect, at) in names(found)


@pytest.mark.slow
def test_clean_robots_get_at_most_two_names_in_eighty(urdf: Path):
    answers = [diagnosed(urdf, 1000 + k, None, 0.0, 0)[1] for k in range(80)]
    assert sum(bool(found.causes) for found in answers) <= 2
    assert sum(found.p_value < 0.05 for found in answers) <= 0.07 * 80
