"""What changes from recording to recording: a tool that only some carry, repeats that were made with another robot."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from generators import Case, available, make_case
from generators.inverse import shares_of
from generators.scoring import judge, table
from synthetic import DT, made_signals, swing
from test_layout import other

from figaroh_jax.diagnosis.diagnosis import diagnose_task
from figaroh_jax.diagnosis.repeats import changed_torques, checked_repeats, repeats_not_said
from figaroh_jax.formats import config
from figaroh_jax.formats.export import model_files
from figaroh_jax.recordings.signals import Signals
from figaroh_jax.results import Diagnosis, Name

SECONDS = 20.0
ONE_SIZE = "is told as one size for all recordings"


def white_noise(rng: np.random.Generator, size: float) -> np.ndarray:
    """Independent samples of each joint."""
    return rng.normal(0.0, size, (round(SECONDS / DT), 2))


def slow_noise(rng: np.random.Generator, size: float) -> np.ndarray:
    """A random walk, whose power lies where the motion is: of each joint, with a mean of zero."""
    walk = rng.standard_normal((round(SECONDS / DT), 2)).cumsum(axis=0)
    return size * (walk - walk.mean(axis=0)) / walk.std(axis=0)


def recorded(more: np.ndarray | float, noise: np.ndarray, name: str) -> Signals:
    """A swing whose torque is gravity's and what comes to it."""
    position = swing(np.arange(round(SECONDS / DT)) * DT)
    return made_signals(SECONDS, torque=10.0 * np.cos(position) + more + noise, name=name, repeat="A")


@pytest.mark.parametrize("kind", ["white", "slow"])
def test_noise_and_drifting_zeros_are_no_change_between_repeats(kind: str):
    rng = np.random.default_rng()
    for _ in range(10):
        noise = [
            rng.normal(0, 1.0, (round(SECONDS / DT), 2)) if kind == "white" else slow_noise(rng, 0.5) for _ in "12"
        ]
        assert not changed_torques(
            recorded(0.0, noise[0], "first"), recorded(np.array([3.0, -2.0]), noise[1], "second")
        )


@pytest.mark.parametrize("law", ["spring", "friction", "load"])
def test_a_torque_that_follows_the_motion_is_a_change_of_its_joint(law: str):
    rng, time = np.random.default_rng(), np.arange(round(SECONDS / DT)) * DT
    position = swing(time)[:, 1]
    velocity = np.gradient(position, DT)
    change = {"spring": position, "friction": np.sign(velocity), "load": 0.3 * 10.0 * np.cos(position)}[law]
    noise = [slow_noise(rng, 0.2) for _ in range(2)]
    more = np.stack([np.zeros_like(change), 2.0 * change], axis=1)
    first, second = recorded(0.0, noise[0], "first"), recorded(more, noise[1], "second")
    (joint,) = found = changed_torques(first, second)
    assert joint == 1
    assert found[1][1] == pytest.approx(np.std(2.0 * change), rel=0.25)
    told = checked_repeats([first, second], ["hip", "knee"])
    assert [one.repeat for one in told] == ["A", None] and told[1].changed_since == "first"
    assert "the torque of knee is another one" in told[1].notes[-1]
    assert not repeats_not_said(told)  # they are no repeats, whatever their motion


@pytest.mark.parametrize("by, told_apart", [(0.06, True), (2 * np.pi, False), (0.0005, False)])
def test_repeats_that_stand_aside_are_told(by: float, told_apart: bool):
    """An encoder that was zeroed anew between them; a turn more is the same posture."""
    first, second = (recorded(0.0, np.zeros((1, 2)), name) for name in ("first", "second"))
    second = replace(second, position=second.position + np.array([0.0, by]))
    one = checked_repeats([first, second], ["hip", "knee"])[1]
    assert (one.repeat is None) == told_apart and not one.changed_since
    assert ("reads knee +0.06 rad (or m) from there all along" in one.notes[-1]) == told_apart
    assert not repeats_not_said([first, one])


def test_recordings_of_other_motions_are_not_compared():
    first, second = recorded(0.0, np.zeros((1, 2)), "first"), made_signals(SECONDS, other, name="second", repeat="A")
    assert checked_repeats([first, second], ["hip", "knee"])[1].changed_since is None


def answer(case: Case, forbid: Sequence[str] = ()) -> Diagnosis:
    with tempfile.TemporaryDirectory() as folder:
        return diagnose_task(config.load_task(case.write(Path(folder), forbid=forbid)))


def shares_told(found: Diagnosis) -> dict[str, tuple[float, float]]:
    """By recording, of the one cause of which an answer says that recordings differ."""
    (note,) = [note for note in found.notes if ONE_SIZE in note]
    return {name: (float(s), float(d)) for s, d, name in re.findall(r"(-?[\d.]+) \+- ([\d.]+) in (\w+)", note)}


def test_the_share_that_each_recording_has_of_a_cause_is_told():
    """Stribeck friction that the robot lost before what was done was done again."""
    case = make_case([("stribeck_friction", 0.15)], robot="small", repeats=2, trajectories=3, seed=1, differs="repeat")
    found = answer(case)
    assert [(cause.name.effect, cause.name.at) for cause in found.causes] == [("stribeck_friction", case.truth[0].at)]
    assert found.verdict == "named+rest" and ONE_SIZE in found.rest.text
    told, true = shares_told(found), shares_of(case, "repeat", 3, 2)
    assert any(f"{ONE_SIZE}, but only some recordings have it" in note for note in found.notes)
    size = found.causes[0].parameters["force"].value / case.truth[0].parameters["force"]
    for one, share in zip(case.recordings, true, strict=True):
        of_size, half = told[one["name"]]
        assert abs(of_size * size - share) < 2 * half * size + 0.1, (one["name"], of_size * size, share)


@pytest.mark.slow
def test_recordings_that_have_a_cause_alike_are_not_told_to_differ():
    case = make_case([("stribeck_friction", 0.15)], robot="small", repeats=2, trajectories=3, seed=1)
    found = answer(case)
    assert found.verdict == "named" and not [note for note in found.notes if ONE_SIZE in note or "moves as" in note]


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_repeats_with_another_torque_are_no_noise(seed: int):
    """Taken as noise, a spring of 15 % of its joint's torque that comes with the second of each two read `nothing`."""
    case = make_case([("joint_spring", 0.15)], robot="small", repeats=2, trajectories=3, seed=seed, differs="repeat")
    found = answer(case)
    (at,) = case.truth[0].at
    assert found.verdict in ("unknown", "named+rest") and f"the torque of {at} is another one" in found.rest.text
    assert found.rest.relative[found.joints.index(at)] > 0.05


@pytest.mark.parametrize("seed", [1, pytest.param(4, marks=pytest.mark.slow), pytest.param(7, marks=pytest.mark.slow)])
def test_a_tool_in_half_of_the_recordings_is_not_nothing(seed: int):
    """Two of four recordings carry a body, and none repeats another: it passed for noise."""
    case = make_case([("payload", 0.15)], robot="small", repeats=1, trajectories=4, seed=seed, differs="part")
    assert shares_of(case, "part", 4, 1).sum() == 2
    found = answer(case)
    assert found.verdict == "unknown" and "was not the same in all" in found.rest.text, found.rest
    assert any(f"leaves in {one['name']} " in found.rest.text for one in case.recordings)


def constants_told(found: Diagnosis) -> dict[str, tuple[float, float]]:
    """By recording, of the one joint of which an answer says that they differ."""
    (note,) = [note for note in found.notes if "does not have one constant in all recordings" in note]
    number = r"([+-][\d.e-]+) \+- ([\d.e-]+) N(?: m)? in (\w+)"
    return {name: (float(value), float(half)) for value, half, name in re.findall(number, note)}


@pytest.mark.parametrize(
    "differs, repeats, trajectories",
    [("repeat", 2, 3), *(pytest.param(*one, marks=pytest.mark.slow) for one in (("part", 1, 4), ("size", 2, 3)))],
)
def test_a_torque_that_was_zeroed_anew_is_named_with_each_constant(differs: str, repeats: int, trajectories: int):
    """Drawn at run time. Between repeats it passed for noise (`nothing`), else it was `unknown`, or a false spring."""
    seed = int(np.random.default_rng().integers(1 << 30))
    asked = {"robot": "small", "repeats": repeats, "trajectories": trajectories, "seed": seed, "differs": differs}
    case = make_case([("torque_offset", 0.12)], **asked)
    found, truth = answer(case), case.truth[0]
    assert found.verdict == "named", (seed, found.rest)
    (cause,) = found.causes
    alike = {Name(effect, truth.at) for effect in ("torque_offset", "asymmetric_coulomb_friction")}
    assert {cause.name, *cause.ambiguous_with} == alike, seed  # of a joint that moves they are one torque
    each, told = truth.parameters["offset"] * shares_of(case, differs, trajectories, repeats), constants_told(found)
    values = np.array([told[one["name"]] for one in case.recordings])
    assert np.all(np.abs(values[:, 0] - (each - each.mean())) < 2 * values[:, 1] + 0.01 * np.ptp(each)), seed
    assert found.causes[0].parameters["spread"].value == pytest.approx(each.std(), rel=0.05)
    gain = found.causes[0].gain
    assert gain.after < gain.before < found.holdout.before and gain.after == pytest.approx(found.holdout.after)
    effects = yaml.safe_load(model_files(found.model, found.causes)["effects.yaml"])["effects"]
    (effect,) = [one for one in effects if one["effect"] == cause.name.effect]
    for name, number in effect["parameters"].items():
        assert number["value"] == pytest.approx(cause.parameters[name].value)
    forbidden = answer(case, forbid=[name.effect for name in alike]) if differs == "repeat" else None
    assert not forbidden or (forbidden.verdict == "unknown" and "does not have one constant" in forbidden.rest.text)


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["payload", "external_wrench", "gravity_tilt", "asymmetric_viscous_friction"])
def test_what_only_some_recordings_have_is_no_constant(effect: str):
    """A tool, a cable or friction makes another mean torque as well: with constants alone something is left."""
    seed = int(np.random.default_rng().integers(1 << 30))
    case = make_case([(effect, 0.15)], robot="small", repeats=1, trajectories=4, seed=seed, differs="part")
    assert "torque_offset" not in [c.name.effect for c in answer(case).causes], seed


@pytest.mark.slow
@pytest.mark.skipif(not available("panda"), reason="the Panda's model is not on this machine")
def test_a_body_of_which_recordings_have_more_or_less_may_be_at_the_next_link():
    """What one size for all leaves goes with the body: the link before took more of it, with confidence 1."""
    case = make_case([("payload", 0.1)], robot="panda", repeats=2, trajectories=3, seed=180530, differs="size")
    score = judge("payload", case.truth, answer(case))
    assert score.grade in ("right", "set") and not score.false, table([score])


@pytest.mark.slow
@pytest.mark.parametrize("differs", ["part", "size", "repeat"])
def test_what_changes_between_recordings_gets_no_wrong_name(differs: str):
    """Drawn at run time. The effect itself at its place is right, and so is `unknown`."""
    rng, told = np.random.default_rng(), []
    effects = (
        "payload",
        "stribeck_friction",
        "joint_spring",
        "load_dependent_friction",
        "rotor_inertia",
        "torque_gain",
    )
    for _ in range(6):
        seed, effect = int(rng.integers(1 << 30)), str(rng.choice(effects))
        case = make_case([(effect, 0.12)], robot="small", repeats=2, trajectories=3, seed=seed, differs=differs)
        told.append(judge(f"{effect} {case.truth[0].at} seed {seed}", case.truth, answer(case)))
    assert sum(bool(score.false) for score in told) <= 1, table(told)
