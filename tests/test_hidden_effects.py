"""Effects hidden by simulators that share no code with the library are named, and clean recordings are left alone."""

from __future__ import annotations

import os
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from generators import CLOSED_LOOP_EFFECTS, Case, available, make_case, make_closed_loop_case, observable
from generators.scoring import Score, judge, named, table

from figaroh_jax.formats import config
from figaroh_jax.formats.robotfile import load_robot
from figaroh_jax.recordings.dataset import read_recordings
from figaroh_jax.results import Diagnosis
from figaroh_jax.simulators.native import as_backend

ROOT = Path(__file__).resolve().parents[1]
ROBOTS = ("tx40", "panda")
needs_robots = pytest.mark.skipif(
    not all(available(name) for name in ROBOTS),
    reason="the models of the robots are not on this machine (FIGAROH_JAX_DATA names their folder)",
)
HIDDEN = (*(name for name in CLOSED_LOOP_EFFECTS if name != "torque_gain"), "asymmetric_coulomb_friction")
LEFT_OUT = (
    "stribeck_friction",
    "coupled_transmission",
    "torque_ripple",
    "position_dependent_friction",
    "asymmetric_viscous_friction",
)
# what a case is made of beside its effect: (repeats, trajectories)
WITH_REPEATS, WITHOUT_REPEATS = (2, 3), (1, 6)
NOISES: tuple[dict[str, Any], ...] = (
    {"colour": "white"},
    {"colour": "ar20", "encoder_step": 1e-4},
    {"colour": "ar100"},
    {"colour": "ar20", "noise": 2.0},
    {"colour": "pink", "noise": 0.5},
)


def slow(*values: Any) -> Any:
    return pytest.param(*values, marks=pytest.mark.slow)


def slow_real(*values: Any) -> Any:
    """Of robots whose models need not be here."""
    return pytest.param(*values, marks=[pytest.mark.slow, needs_robots])


def diagnosis_of(case: Case, forbid: tuple[str, ...] = ()) -> Diagnosis:
    """The library's answer to the case as a user would ask it: files and a task."""
    from figaroh_jax.diagnosis.diagnosis import diagnose_task

    with tempfile.TemporaryDirectory() as folder:
        return diagnose_task(config.load_task(case.write(Path(folder), forbid)))


def hidden_effect(effect: str, robot: str, layout: tuple[int, int], seed: int, size: float = 0.05) -> Score:
    """Hide one effect and judge what is said about it."""
    repeats, trajectories = layout
    case = make_case([(effect, size)], robot=robot, repeats=repeats, trajectories=trajectories, seed=seed)
    truth = case.truth[0]
    label = f"{effect} ({', '.join(truth.at)}) on {robot}, {repeats} x {trajectories}, seed {seed}"
    return judge(label, case.truth, diagnosis_of(case))


def clean(robot: str, layout: tuple[int, int], seed: int) -> tuple[Score, float]:
    """Judge what is said about recordings in which nothing is hidden, and its p-value; the noise goes by the seed."""
    repeats, trajectories = layout
    noise = NOISES[seed % len(NOISES)]
    case = make_case([], robot=robot, repeats=repeats, trajectories=trajectories, seed=seed, **noise)
    answer = diagnosis_of(case)
    return judge(f"clean {robot}, {repeats} x {trajectories}, seed {seed}, {noise}", (), answer), answer.p_value


@pytest.mark.parametrize(
    "effect", ["stribeck_friction", slow("coupled_transmission"), slow("torque_ripple"), slow("joint_spring")]
)
def test_effects_in_an_arm_with_a_slide_are_named(effect: str):
    score = hidden_effect(effect, "small", WITH_REPEATS, seed=400)
    assert score.grade == "right" and not score.false, table([score])


@cache
def carrying() -> Case:
    return make_case([("payload", 0.05)], robot="small", repeats=2, trajectories=3, seed=412)


def test_a_payload_on_links_that_are_trusted_is_named_and_not_taken_in_by_them():
    score = judge("payload", carrying().truth, diagnosis_of(carrying()))
    assert score.grade == "right" and not score.false, table([score])


@needs_robots
def test_a_cause_at_one_joint_does_not_decide_whether_positions_are_slowed():
    """The motion of all joints is far below the cutoff, whether or not the largest reads its torque 5 % low."""
    from figaroh_jax.diagnosis import setting

    for seed in (7301, 7302):
        for effects in ([], [("torque_gain", 0.05, ("panda_joint2",))]):
            case = make_case(effects, robot="panda", repeats=1, trajectories=2, seed=seed, trusted=True)
            with tempfile.TemporaryDirectory() as folder, jax.enable_x64(True):
                task = config.load_task(case.write(Path(folder)))
                model = load_robot(task)
                given = read_recordings(task, model), task.preprocess, None, task.robot.trust
                assert setting.prepared_signals(as_backend(model), *given)[1], (seed, effects)


def test_trusted_links_that_are_not_as_believed_are_no_nothing():
    assert diagnosis_of(carrying(), ("payload", "link_inertia")).verdict == "unknown"


@cache
def score_of_hidden_effect(k: int) -> Score:
    """Robots and layouts take turns."""
    robot, layout = ROBOTS[k % 2], (WITH_REPEATS, WITHOUT_REPEATS)[(k // 2) % 2]
    return hidden_effect(HIDDEN[k], robot, layout, seed=100 + k)


@needs_robots
@pytest.mark.slow
def test_most_hidden_effects_are_named_at_their_place():
    scores = [score_of_hidden_effect(k) for k in range(len(HIDDEN))]
    right = sum(s.grade == "right" for s in scores)
    assert right >= 0.85 * len(scores), f"{right} of {len(scores)} right\n{table(scores)}"


@needs_robots
@pytest.mark.slow
@pytest.mark.parametrize("chosen", [range(1), range(len(HIDDEN))], ids=len)
def test_no_hidden_effect_gets_a_confident_wrong_name(chosen: range):
    scores = [score_of_hidden_effect(k) for k in chosen]
    assert sum(s.grade == "right" for s in scores) >= 0.8 * len(scores), table(scores)
    assert not any(s.grade == "wrong" for s in scores), table(scores)


@pytest.mark.parametrize(
    ("robot", "layout", "seed"),
    [("small", WITHOUT_REPEATS, 202), slow_real("tx40", WITH_REPEATS, 200), slow_real("panda", WITHOUT_REPEATS, 201)],
)
def test_nothing_is_named_in_clean_recordings(robot: str, layout: tuple[int, int], seed: int):
    score = clean(robot, layout, seed)[0]
    assert score.verdict == "nothing", table([score])


@pytest.mark.parametrize(
    ("effect", "robot"), [(LEFT_OUT[0], "small"), *(slow_real(effect, ROBOTS[0]) for effect in LEFT_OUT)]
)
def test_an_effect_left_out_of_the_catalogue_is_unknown(effect: str, robot: str):
    case = make_case([(effect, 0.08)], robot=robot, seed=300 + LEFT_OUT.index(effect))
    answer = diagnosis_of(case, forbid=(effect,))
    assert answer.verdict == "unknown", f"{case.truth[0]}: {answer.verdict} {named(answer)}"


@needs_robots
@pytest.mark.slow
def test_a_torque_gain_beyond_the_trust_in_the_inertials_is_named():
    case = make_case([("torque_gain", 0.2, ("panda_joint4",))], robot="panda", seed=500)  # trust 2 %
    score = judge("gain of 20 %", case.truth, diagnosis_of(case))
    assert score.grade == "right" and not score.false, table([score])


@pytest.mark.slow
@needs_robots
def test_a_torque_gain_within_the_trust_gets_no_other_name():
    """Links that are heavier by what they may be give much the same torque: `nothing` is right, and so is the gain."""
    case = make_case([("torque_gain", 0.05, ("panda_joint4",))], robot="panda", seed=500, trusted=False)  # trust 10 %
    score = judge("gain of 5 %", case.truth, diagnosis_of(case))
    assert score.grade in ("right", "nothing") and not score.false, table([score])


@pytest.mark.parametrize(
    ("robots", "layout"),
    [(("small",), WITH_REPEATS), slow_real(ROBOTS, WITH_REPEATS), slow_real(ROBOTS, WITHOUT_REPEATS)],
    ids=("small", "repeats", "no repeats"),
)
def test_a_case_drawn_at_run_time_gets_no_wrong_name(robots: tuple[str, ...], layout: tuple[int, int]):
    seed = int.from_bytes(os.urandom(4), "little")
    rng = np.random.default_rng(seed)
    effect, robot = rng.choice(HIDDEN), rng.choice(robots)
    score = hidden_effect(str(effect), str(robot), layout, seed)
    assert score.grade != "wrong", f"seed {seed} ({effect} on {robot}):\n{table([score])}"


@needs_robots
@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_of_several_effects_at_once_most_are_named_and_nothing_else(robot: str):
    """As in a real robot: four laws of its joints, drawn at run time, in one recording."""
    seed = int.from_bytes(os.urandom(4), "little")
    laws = [name for name in HIDDEN if name not in ("payload", "torque_delay", "power_law_friction")]
    chosen = np.random.default_rng(seed).choice(laws, 4, replace=False)
    case = make_case([(str(name), 0.08) for name in chosen], robot, *WITH_REPEATS, seed=seed)
    answer = diagnosis_of(case)
    causes = named(answer)
    told = f"seed {seed}: {chosen}\n{table([judge(robot, case.truth, answer)])}"
    assert all(members & set().union(*map(observable, case.truth)) for _, members in causes), told
    assert sum(any(members & observable(t) for _, members in causes) for t in case.truth) >= 2, told


@needs_robots
@pytest.mark.slow
def test_a_payload_among_other_effects_is_at_its_link():
    """Found first, where all others are still in what it is to explain, it fits the link before best."""
    hidden = {
        "asymmetric_coulomb_friction": 0.077,
        "payload": 0.143,
        "friction_drift": 0.104,
        "coupled_transmission": 0.023,
    }
    case = make_case(list(hidden.items()), "panda", *WITH_REPEATS, seed=71002)
    answer = diagnosis_of(case)
    payload = next(t for t in case.truth if t.effect == "payload")
    places = [members for name, members in named(answer) if name[0] in ("payload", "link_inertia")]
    assert len(places) == 1 and places[0] & observable(payload), table([judge("panda", case.truth, answer)])
    assert not judge("panda", case.truth, answer).false


@needs_robots
@pytest.mark.slow
def test_a_link_does_not_stand_in_for_what_has_no_name():
    """Links trusted to 2 %, several effects of which some stay unnamed: a link's ten numbers follow what they leave."""
    effects = [("stribeck_friction", 0.105, ("joint_2",)), ("joint_elasticity", 0.075, ("joint_2",)),
               ("payload", 0.024, ("link_5",)), ("coupled_transmission", 0.108, ("joint_3", "joint_4")),
               ("gravity_tilt", 0.056, ()), ("asymmetric_coulomb_friction", 0.072, ("joint_6",))]  # fmt: skip
    case = make_case(effects, "tx40", *WITH_REPEATS, seed=60000)
    score = judge("tx40", case.truth, diagnosis_of(case))
    assert not score.false and len(score.told) >= 3, table([score])


@needs_robots
@pytest.mark.slow
def test_a_body_that_more_than_a_few_causes_come_with_is_named_and_nothing_is_left():
    """The search without changes of links' inertia puts the body one link before its own, which leaves a rest."""
    hidden = {"torque_offset": 0.146, "payload": 0.118, "joint_spring": 0.038, "position_dependent_friction": 0.126}
    case = make_case(list(hidden.items()), "tx40", *WITH_REPEATS, seed=59012)
    answer = diagnosis_of(case)
    score = judge("tx40", case.truth, answer)
    assert answer.verdict == "named" and not score.false, table([score])
    assert {"payload", "link_inertia"} & {name for name, _ in score.told}, table([score])


def test_demo_files_are_small():
    assert sum(file.stat().st_size for file in (ROOT / "figaroh_jax" / "demo").iterdir()) <= 500_000


@cache
def clean_answers() -> tuple[tuple[Score, float], ...]:
    """Thirty recordings in which nothing is hidden, of every noise."""
    layouts = WITH_REPEATS, WITHOUT_REPEATS
    return tuple(clean(ROBOTS[k % 2], layouts[(k // 2) % 2], seed=1000 + k) for k in range(30))


@needs_robots
@pytest.mark.slow
def test_clean_recordings_of_every_noise_get_at_most_one_name():
    scores = [score for score, _ in clean_answers()]
    assert sum(bool(s.told) for s in scores) <= 1, table(scores)
    assert sum(s.verdict == "unknown" for s in scores) <= 3, table(scores)


@needs_robots
@pytest.mark.slow
def test_p_values_of_clean_recordings_are_uniform():
    p = np.array([value for _, value in clean_answers()])
    # 1.5 and 7.5 of 30 are expected
    assert (p < 0.05).sum() <= 5 and (p < 0.25).sum() <= 14, np.sort(p)


@pytest.mark.slow
def test_closed_loop_recordings_are_named_or_left_alone():
    effects = (None, "stribeck_friction", "torque_ripple", "joint_spring", "coupled_transmission")
    scores = []
    for seed, effect in enumerate(effects):
        case = make_closed_loop_case([effect] if effect else [], robot="small", trajectories=2, seed=seed)
        scores.append(judge(f"closed loop, {effect}", case.truth, diagnosis_of(case)))
    assert not any(s.grade == "wrong" for s in scores), table(scores)
    assert sum(s.grade == "right" for s in scores) >= 3, table(scores)
