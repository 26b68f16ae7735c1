"""Recordings that contradict their model never get a name; right ones keep theirs.

The recordings are those of `generators`, which shares no code with the library, drawn at run time and then misread as
users misread them: torque in another unit, gravity the wrong way round, a clock off by two.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from generators import Case, available, make_case
from test_plausibility import heavier

import figaroh_jax as fj
from figaroh_jax.diagnosis.believed import impossible_links
from figaroh_jax.diagnosis.diagnosis import diagnose_task
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.robotfile import load_robot
from figaroh_jax.recordings.checks import checked_recordings
from figaroh_jax.recordings.dataset import read_recordings
from figaroh_jax.reporting import wording
from figaroh_jax.reporting.answer import answer
from figaroh_jax.results import Diagnosis

sys.path.append(str(Path(__file__).resolve().parents[1]))

SEED = int.from_bytes(os.urandom(3), "little")  # told where a test fails
TWIN = 20  # one whose friction is named on both robots
NEEDS_PANDA = pytest.mark.skipif(not available("panda"), reason="FIGAROH_JAX_DATA has no Panda")
ROBOTS = ["small", pytest.param("panda", marks=NEEDS_PANDA)]
Arrays = dict[str, np.ndarray]
WRONG: dict[str, tuple[Callable[[Arrays], Arrays], list[float] | None, str]] = {
    "torque at a seventh": (lambda z: z | {"tau": z["tau"] / 7}, None, "torque"),
    "torque ten times": (lambda z: z | {"tau": z["tau"] * 10}, None, "torque is "),
    "gravity upwards": (lambda z: z, [0.0, 0.0, 9.81], "robot.gravity: [0, 0, -9.81]"),
    "gravity left out": (lambda z: z, [0.0, 0.0, 0.0], "robot.gravity: [0, 0, -9.81]"),
    "a clock at half its speed": (lambda z: z | {"t": z["t"] * 2}, None, "the clock looks wrong"),
}


@cache
def hidden(robot: str, seed: int = SEED) -> Case:
    """Friction that is named in the recordings as they are (`test_the_same_recordings_as_they_are_keep_their_name`)."""
    return make_case([("stribeck_friction", 0.15)], robot=robot, repeats=2, trajectories=2, seed=seed)


def written(case: Case, folder: Path, spoil: Callable[[Arrays], Arrays], gravity: list[float] | None = None) -> Path:
    path = case.write(folder)
    for file in folder.glob("*.npz"):
        np.savez(file, **spoil(dict(np.load(file))))  # pyright: ignore[reportArgumentType]
    if gravity is not None:
        task = json.loads(path.read_text())
        task["robot"]["gravity"] = gravity
        path.write_text(json.dumps(task))
    return path


def contradictions(path: Path) -> tuple[str, ...]:
    task = load_task(path)
    model = load_robot(task)
    return checked_recordings(task, model, read_recordings(task, model)).contradictions


def nothing_is_named(found: Diagnosis, words: str) -> None:
    assert found.verdict == "unknown" and found.causes == (), (SEED, found.verdict, found.causes)
    said = wording.sentence(found, "the arm")
    assert said.startswith("First settle what looks wrong") and words in said, said
    assert found.experiment is not None and "before what looks wrong is settled" in found.experiment.text
    told: Any = answer(found)
    assert any(words in note for note in told["notes"])
    assert all(near["why_not"] for near in told["rest"]["nearest"])


@pytest.mark.parametrize("wrong", WRONG)
def test_what_contradicts_the_model_is_told(wrong: str, tmp_path: Path):
    """Of any of the five what is to be settled; the next test asks what a diagnosis makes of it."""
    spoil, gravity, words = WRONG[wrong]
    told = contradictions(written(hidden("small"), tmp_path, spoil, gravity))
    assert any(words in text for text in told), (SEED, told)


@pytest.mark.parametrize(
    ("robot", "wrong"),
    [
        ("small", next(iter(WRONG))),
        *(pytest.param("small", wrong, marks=pytest.mark.slow) for wrong in [*WRONG][1:]),
        *(pytest.param("panda", wrong, marks=[NEEDS_PANDA, pytest.mark.slow]) for wrong in WRONG),  # a minute each
    ],
)
def test_a_recording_that_contradicts_its_model_gets_no_name(robot: str, wrong: str, tmp_path: Path):
    spoil, gravity, words = WRONG[wrong]
    seed = TWIN if robot == "small" else SEED  # the twin of a named one, and one that nobody has seen
    nothing_is_named(diagnose_task(load_task(written(hidden(robot, seed), tmp_path, spoil, gravity))), words)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_same_recordings_as_they_are_contradict_nothing(robot: str, tmp_path: Path):
    assert contradictions(written(hidden(robot), tmp_path, lambda z: z)) == (), SEED


@pytest.mark.parametrize("robot", ["small", pytest.param("panda", marks=[NEEDS_PANDA, pytest.mark.slow])])
def test_the_same_recordings_as_they_are_keep_their_name(robot: str, tmp_path: Path):
    case = hidden(robot, TWIN)
    found = diagnose_task(load_task(written(case, tmp_path / "twin", lambda z: z)))
    assert found.verdict in ("named", "named+rest") and found.rest.contradicts == (), found.verdict
    assert found.causes[0].name.at == case.truth[0].at, found.causes


@pytest.mark.parametrize("effect", ["torque_gain", "payload", "gravity_tilt", "external_wrench"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_hidden_effect_is_no_contradiction(robot: str, effect: str, tmp_path: Path):
    case = make_case([(effect, 0.1)], robot=robot, repeats=1, trajectories=2, seed=SEED)
    assert contradictions(written(case, tmp_path, lambda z: z)) == (), SEED


def test_recordings_as_arrays_are_judged_alike(tmp_path: Path):
    spoil, _, words = WRONG["torque at a seventh"]
    task = load_task(written(hidden("small"), tmp_path, spoil))
    robot = load_robot(task)
    found = fj.diagnose(robot, read_recordings(task, robot), task.preprocess, trust=task.robot.trust)
    assert isinstance(found, Diagnosis)
    nothing_is_named(found, words)


def test_one_recording_that_does_not_follow_the_model_is_no_contradiction_beside_others(tmp_path: Path):
    """Noise in place of a torque: in one of three recordings it is a warning, in two it contradicts the model."""
    case = make_case(robot="small", repeats=1, trajectories=3, seed=SEED)
    rng = np.random.default_rng(SEED)
    path = case.write(tmp_path)
    files = sorted(tmp_path.glob("*.npz"))
    for file, contradicts in zip(files, (False, True, True), strict=True):
        z = dict(np.load(file))
        z["tau"] = 5 * rng.standard_normal(z["tau"].shape)
        np.savez(file, **z)  # pyright: ignore[reportArgumentType]
        assert bool(contradictions(path)) == contradicts, SEED


def wild(z: Arrays, rows: int = 12) -> Arrays:
    """First rows that no robot made, as a log may have them before its stream has settled."""
    rng, tau = np.random.default_rng(SEED), z["tau"].copy()
    q = z["q"].copy()
    q[:rows] = rng.uniform(q.min(axis=0), q.max(axis=0), q[:rows].shape)
    tau[:rows] = rng.uniform(-30, 30, tau[:rows].shape) * np.abs(tau).max(axis=0)
    return z | {"q": q, "tau": tau}


@pytest.mark.parametrize("robot", ROBOTS)
def test_wild_samples_are_told_and_contradict_nothing(robot: str, tmp_path: Path):
    path = written(hidden(robot), tmp_path, wild)
    task = load_task(path)
    model = load_robot(task)
    found = checked_recordings(task, model, read_recordings(task, model))
    assert found.contradictions == (), SEED
    assert any("12 wild rows are left out" in text for text in found.warnings), SEED


def test_what_contradicts_the_model_is_found_beside_wild_samples(tmp_path: Path):
    spoil, _, words = WRONG["torque at a seventh"]
    assert any(words in text for text in contradictions(written(hidden("small"), tmp_path, lambda z: wild(spoil(z)))))


def test_the_wild_rows_of_a_real_log_contradict_nothing(data_dir: Path, tmp_path: Path):
    """A UR10e's log begins with eight of them: it read as if columns were swapped, and no recording had a name then."""
    from benchmarks import same_robot

    task = same_robot.ur10e()[0]
    log = data_dir / "ur10e_innopolis" / "id" / "19_09_27_11_32_02.npz"
    entry = {key: value for key, value in task["data"][0].items() if key != "role"}
    path = tmp_path / "task.json"
    path.write_text(json.dumps(task | {"data": [entry | {"file": str(log)}]}))
    task = load_task(path)
    model = load_robot(task)
    found = checked_recordings(task, model, read_recordings(task, model))
    assert found.contradictions == ()
    (told,) = [text for text in found.warnings if "wild" in text]
    assert "8 wild rows are left out" in told and "wrist_3_joint reads 2561 N m in row 3" in told


class _Problem:
    def __init__(self, model: Any, trust: float):
        from figaroh_jax.estimation.priors import rigid_prior

        self.model, self.trust, self.believed = model, trust, rigid_prior(model, trust)[1]


@pytest.mark.parametrize(
    ("factor", "std", "trust", "words"),
    [
        (-0.3, 0.1, 0.1, "which no body has"),
        (-0.3, 0.5, 0.1, ""),  # not surely below zero
        (7.0, 0.1, 0.1, "times as far from the model"),
        (7.0, 0.1, 1.0, ""),  # the model was not believed that far
        (2.0, 0.1, 0.1, ""),  # as UR10e's forearm
    ],
)
def test_links_that_cannot_be_are_told(factor: float, std: float, trust: float, words: str, tmp_path: Path):
    from tasks import URDF

    (tmp_path / "robot.urdf").write_text(URDF)
    robot = fj.load_urdf(tmp_path / "robot.urdf")
    theta = np.asarray(heavier(robot, 1, factor).inertia).ravel()
    told = impossible_links(_Problem(robot, trust), [], theta, std**2 * np.eye(len(theta)))  # type: ignore[arg-type]
    assert told == () if not words else len(told) == 1 and "fore" in told[0] and words in told[0], told
