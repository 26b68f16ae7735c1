"""What is said of causes by their size and by what they leave: amplitudes with zero in reach, laws that do not fit."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from figaroh_jax.diagnosis import rest as rests
from figaroh_jax.diagnosis.estimates import Fitted
from figaroh_jax.diagnosis.flexible import Smooth
from figaroh_jax.diagnosis.joint import Joint, has_size, least_sure
from figaroh_jax.diagnosis.naming import (
    Standing,
    _one_part,
    _spoils,
    _turns_against_itself,
    behind_joints,
    beside_rest,
    elsewhere_too,
    lone_part,
    of_its_own,
    reason_against,
    stands_alone,
    strong,
)
from figaroh_jax.diagnosis.rest import repeated_power, repeating, significance, tolerated, verdict, wrong_law
from figaroh_jax.effects.catalogue import find
from figaroh_jax.estimation.joint_rows import JointRows
from figaroh_jax.estimation.rows import Rows
from figaroh_jax.results import Name


def sized(name: str, deviation: list[float], **values: float) -> bool:
    effect = find(name)(np.array([0]), **{key: np.float64(value) for key, value in values.items()})
    count = len(deviation)
    return has_size(effect, Fitted(np.zeros(count), np.diag(deviation) ** 2, ()), tuple(range(count)))


@pytest.mark.parametrize(("joints", "repeats", "least"), [(1, 2, 0.03), (1, 3, 0.03), (3, 2, 0.01)])
def test_noise_of_repeats_has_power_in_common_as_often_as_its_p_value_says(
    joints: int, repeats: int, least: float
) -> None:
    """Noise of each recording its own: p is uniform, or less often small where several joints are asked as well as all
    together, whichever of the repeats a product is taken from."""
    rng, count, draws = np.random.default_rng(), 400, 600
    row, shape = np.arange(repeats * count), (joints, repeats * count)
    partner = np.stack([(row + k * count) % (repeats * count) for k in range(1, repeats)])
    blocks, none = row // 20, JointRows.of(np.zeros((*shape, 0)))
    rows = Rows(np.ones(shape), none, none, np.ones(shape), partner, blocks, blocks)
    p = [repeated_power(rows, rng.standard_normal(shape))[1] for _ in range(draws)]
    share, deviation = float(np.mean(np.array(p) < 0.05)), np.sqrt(0.05 * 0.95 / draws)
    assert least - 2 * deviation < share < 0.05 + 4 * deviation, share  # told twice it is .12
    common = 2.0 * rng.standard_normal(count)
    residual = rng.standard_normal(shape)
    residual[-1] += np.tile(common, repeats)
    power, p_common = repeated_power(rows, residual)
    assert p_common < 1e-3
    assert abs(power[-1] / (repeats * (common**2).sum()) - 1) < 0.5


@pytest.mark.parametrize(("force", "there"), [(0.5, False), (1.9, False), (2.0, True), (-2.0, True)])
def test_a_size_is_there_where_its_interval_excludes_zero(force: float, there: bool) -> None:
    assert sized("torque_offset", [1.0], offset=force) == there


def test_a_spring_without_stiffness_is_an_offset_and_no_spring() -> None:
    assert not sized("joint_spring", [1.0, 0.1], stiffness=0.5, offset=30.0)
    assert sized("joint_spring", [0.1, 10.0], stiffness=0.5, offset=3.0)


def test_two_amplitudes_are_judged_together() -> None:
    # chi-square of two: 5.99 at 95 %
    assert not sized("position_dependent_friction", [1.0, 1.0], cosine=1.7, sine=1.7)
    assert sized("position_dependent_friction", [1.0, 1.0], cosine=1.8, sine=1.8)


def test_friction_that_fades_more_slowly_than_it_is_seen_is_judged_at_its_time() -> None:
    """Over less than its time a larger and slower change is the same: .5 +- 1, +- .14 at that time."""
    values = {"force": np.float64(0.5), "damping": np.float64(0.0), "time": np.float64(15.0)}
    drift = find("friction_drift")(np.array([0]), **values)
    deviation, share = np.array([1.0, 0.2, 20.0]), np.eye(3)
    share[0, 2] = share[2, 0] = 0.99
    assert has_size(drift, Fitted(np.zeros(3), share * np.outer(deviation, deviation), ()), (0, 1, 2))
    share[0, 2] = share[2, 0] = 0.9  # .5 +- .44
    assert not has_size(drift, Fitted(np.zeros(3), share * np.outer(deviation, deviation), ()), (0, 1, 2))


def least_of(*causes: tuple[str, list[float], float, dict[str, float]]) -> int | None:
    """Which of some causes (name, deviations, correlation of the first two parameters, values) is least sure."""
    effects, blocks, places, first = [], [], [], 0
    for name, deviation, correlation, values in causes:
        effects.append(find(name)(np.array([0]), **{key: np.float64(value) for key, value in values.items()}))
        count = len(deviation)
        share = np.eye(count)
        if count > 1:
            share[0, 1] = share[1, 0] = correlation
        blocks.append(share * np.outer(deviation, deviation))
        places.append(tuple(range(first, first + count)))
        first += count
    covariance = np.zeros((first, first))
    for place, block in zip(places, blocks, strict=True):
        covariance[np.ix_(place, place)] = block
    none: Any = [None] * len(causes)
    return least_sure(Joint(none, effects, Fitted(np.zeros(first), covariance, tuple(places))))


def test_a_cause_whose_told_interval_holds_zero_is_the_first_to_go() -> None:
    ratio, gain, offset = (("load_dependent_friction", "ratio"), ("torque_gain", "gain"), ("torque_offset", "offset"))
    poor = (ratio[0], [0.0726], 0.0, {ratio[1]: 0.1211})
    poorer = (gain[0], [0.043], 0.0, {gain[1]: 0.0678})
    good = (offset[0], [1.0], 0.0, {offset[1]: 2.0})
    assert least_of(good) is None
    assert least_of(good, poor) == 1
    assert least_of(poorer, good, poor) == 0  # 1.58 deviations, 1.67
    assert least_of(("torque_delay", [0.002], 0.0, {"delay": 0.003})) == 0  # a size that is no amplitude
    assert least_of(("torque_delay", [0.001], 0.0, {"delay": 0.003})) is None


def test_a_law_of_the_speed_is_judged_at_its_shape() -> None:
    """Strength and exponent trade with each other: given the exponent, its deviation is a 25th."""
    law = {"strength": -4.0, "exponent": 1.15}
    assert least_of(("power_law_friction", [22.0, 0.68], 0.9992, law)) is None  # -4.0 +- .88 at that exponent
    assert least_of(("power_law_friction", [22.0, 0.68], 0.99, law)) == 0  # -4.0 +- 3.1


def test_friction_that_builds_up_over_a_distance_which_may_be_zero_goes() -> None:
    """Of a clean arm .59 +- .38 N m over .22 +- .34 mrad were named: plain friction, as far as anybody can tell."""
    law = {"force": 0.588, "distance": 0.219e-3}
    assert least_of(("presliding", [0.193, 0.175e-3], 0.0, law)) == 0
    assert least_of(("presliding", [0.193, 0.1e-3], 0.0, law)) is None
    assert least_of(("presliding", [0.35, 0.1e-3], 0.0, law)) == 0  # the force may be zero


def test_more_power_than_noise_can_have_is_a_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two joints of 400 independent rows: deviations of their power are sqrt(2 / 400) (chi-square)."""
    nothing, shape = cast(Any, None), (2, 400)

    def drawn(problem: Any, spectrum: Any, whitening: Any, draws: int, generator: np.random.Generator) -> np.ndarray:
        return generator.standard_normal((draws, *shape))

    monkeypatch.setattr(rests, "draw_noise", drawn)
    rng, left = np.random.default_rng(3), np.ones(shape)

    def against(share: float) -> tuple[np.ndarray, np.ndarray]:
        size = np.array([1.0, np.sqrt(1 + share * np.sqrt(2 / 400))])  # so many deviations at the second joint
        return rests.beyond_noise(nothing, left * size[:, None], nothing, nothing, rng)

    for share in (-2.0, 0.0, 2.0):
        beyond, quiet = against(share)
        assert not beyond.any() and not quiet.any()
    beyond, quiet = against(4.0)
    np.testing.assert_allclose(beyond, [0.0, 4 * np.sqrt(2 * 400)], rtol=0, atol=8)  # mean of 200 draws: +- 2
    assert not quiet.any()
    beyond, quiet = against(-4.5)  # noise never has so little: what was taken for noise is something else
    assert not beyond.any() and quiet.tolist() == [False, True]


def test_a_joint_without_rows_leaves_the_others_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draws in single precision of a joint that never moves: 0 / 0 made a rest of any power at every joint."""
    nothing, shape = cast(Any, None), (2, 400)

    def drawn(problem: Any, spectrum: Any, whitening: Any, draws: int, generator: np.random.Generator) -> np.ndarray:
        return generator.standard_normal((draws, *shape), np.float32)

    monkeypatch.setattr(rests, "draw_noise", drawn)
    moves = np.ones(shape, bool)
    moves[1] = False
    found = rests.beyond_noise(nothing, 1.01 * np.ones(shape), nothing, nothing, np.random.default_rng(3), moves)
    assert not np.any(found)


@pytest.mark.parametrize(
    ("misfit", "joints", "alone"),
    [
        ([0, 0, 1, 0, 0, 0], [2], True),
        ([0, 1, 1, 0, 0, 0], [2], True),  # one of five others
        ([1, 1, 1, 1, 0, 0], [2], False),  # most others have a misfit: this joint may have one too
        ([0, 1, 1, 0, 0, 0], [1, 2], True),
        ([0, 1, 1, 0, 0, 0], [0, 1, 2, 3, 4, 5], True),
        ([1, 1, 1, 0, 0, 0], [0, 1, 2, 3, 4, 5], False),
        ([1], [0], False),
    ],
)
def test_a_cause_stands_alone_where_others_have_no_misfit(misfit: list[int], joints: list[int], alone: bool) -> None:
    assert stands_alone(np.array(misfit, bool), joints) is alone


def test_what_stays_at_a_causes_joints_is_told_by_what_it_removes() -> None:
    assert of_its_own(np.array([0.0, 20.0, 30.0, 9.0]), [1, 2], 100.0) == pytest.approx(0.5)


def test_a_law_is_wrong_where_it_leaves_a_rest_at_its_own_place() -> None:
    rest = Smooth(0.001, Name("friction", ("elbow",)), 50.0, np.array([0.0, 50.0]))
    assert wrong_law(("elbow",), 1000.0, rest)
    assert wrong_law((), 1000.0, rest)  # the whole robot
    assert not wrong_law(("elbow",), 10_000.0, rest)  # a small share of what was removed
    assert not wrong_law(("wrist",), 1000.0, rest)
    assert not wrong_law(("elbow",), 1000.0, rest._replace(p=0.02))


def test_what_repeats_have_in_common_is_no_noise() -> None:
    """Two repeats of 4000 rows that share a wave; a third of the rows counts; the second joint has noise alone."""
    rng, n = np.random.default_rng(5), 4000
    wave = np.sin(np.arange(n) / 7.0)
    residual = rng.standard_normal((2, 2 * n))
    residual[0] += np.tile(wave, 2)
    partner = np.concatenate([np.arange(n) + n, np.arange(n)])[None]
    empty = JointRows.of(np.zeros((2, 0, 0)))
    rows = Rows(
        np.zeros((2, 0)), empty, empty, np.ones((2, 2 * n)), partner, np.zeros(2 * n, int), np.zeros(2 * n, int)
    )
    counted = np.tile(np.arange(2 * n) % 3 == 0, (2, 1))
    problem = cast(Any, SimpleNamespace(layout=SimpleNamespace(repeats=True)))
    shared, none = repeating(problem, rows, residual, counted)
    told = (np.tile(wave, 2)[counted[0]] ** 2).sum()
    assert shared == pytest.approx(told, rel=0.15)  # five deviations of the products' noise
    assert none < 0.15 * told
    problem.layout.repeats = False
    assert np.isinf(repeating(problem, rows, residual, counted)).all()


@pytest.mark.parametrize(
    ("rise", "moving", "share", "spoils"),
    [
        (0.0, 0.0, 1.0, False),
        (0.3, 0.3, 1.0, True),
        (-0.3, -0.3, 1.0, False),
        (0.3, 0.0, 1.0, False),  # at rest alone
        (0.3, 0.3, 0.01, False),  # of a joint whose rows weigh little beside what the cause removes
    ],
)
def test_a_law_of_the_whole_robot_that_predicts_one_joint_worse_is_none(
    rise: float, moving: float, share: float, spoils: bool
) -> None:
    """Three joints, 40 blocks: the first falls by a half, the last rises by a share of what it had."""
    rng = np.random.default_rng(11)
    before = rng.uniform(0.8, 1.2, (2, 3, 40)) * np.array([1.0, 1.0, share])[:, None]
    change = np.array([[[0.5], [1.0], [1.0 + rise]], [[0.5], [1.0], [1.0 + moving]]])
    after = before * (change + 0.1 * rng.standard_normal((2, 3, 40)))
    assert _spoils(before, after) == spoils


def test_verdicts_follow_causes_and_rest() -> None:
    assert verdict(False, False) == "nothing"
    assert verdict(False, True) == "unknown"
    assert verdict(True, False) == "named"
    assert verdict(True, True) == "named+rest"


RIGHT = Standing(
    Name("torque_ripple", ("elbow",)), whole=False, physical=True, gain=0.4, t=4.0, t_needed=2.4, share=0.1
)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({}, ""),
        ({"gain": 0.2}, "held-out error"),
        ({"t": 2.0}, "not significant"),
        ({"share": 0.015}, "needed"),
        ({"modulation": 0.2}, "varies"),
        ({"whole": True, "gain": 0.1, "modulation": 0.2}, ""),
        ({"whole": True, "gain": 0.05, "modulation": 0.2}, "borderline"),  # 1.67, 1.25 and 1.5 times what is needed
        ({"gain": 0.26, "t": 2.5, "modulation": 0.14}, "borderline"),  # each of them by little
        ({"gain": 0.26, "t": 2.5}, ""),  # but as steady as can be
        ({"gain": 0.34, "t": 3.8, "modulation": 0.11, "modulation_held_out": 0.1}, "borderline"),
        ({"gain": 0.34, "t": 3.8, "modulation": 0.11, "modulation_held_out": 0.0}, ""),  # half of that is chance
        ({"gain": 0.26, "t": 20.0, "modulation": 0.14}, ""),
        ({"whole": True, "gain": 0.05, "modulation": 0.4}, "varies"),
        ({"modulation_held_out": 0.25}, "varies"),
        ({"modulation_held_out": 0.12, "varies": True}, "varies"),  # less than .2, but surely
        ({"modulation_held_out": 0.12}, ""),
        ({"modulation_held_out": 0.08, "varies": True}, ""),
        ({"leaves": 0.06}, "another law acts there"),
        ({"leaves": 0.06, "alone": False}, ""),
        ({"modulation_held_out": 0.12, "varies": True, "alone": False}, ""),
        ({"modulation_held_out": 0.12, "varies": True, "alone": False, "whole": True}, "varies"),
        ({"share": 3.0, "cancels": True}, "cancels"),
        ({"physical": False}, "physically impossible"),
        ({"beside_rest": False}, "named only where nothing else"),
        ({"whole": True, "gain": 0.05}, ""),
        ({"whole": True, "gain": 0.05, "massless": True}, "mass is not surely"),
        ({"whole": True, "gain": 0.05, "beside_smooth": 0.0}, "smooth functions"),
        ({"whole": True, "contested": True}, "another law of the whole robot"),
        ({"one_part": True}, "no more than one"),
    ],
)
def test_beside_a_rest_a_cause_is_named_by_what_it_alone_explains(changes: dict[str, float], word: str) -> None:
    reason = reason_against(replace(RIGHT, **changes), True, 0.01)
    assert word in reason and bool(word) == bool(reason)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"gain": 0.1}, ""),
        ({"gain": 0.2, "t": 2.5, "modulation": 0.14}, ""),  # borderline
        ({"gain": 0.1, "t": 2.0}, "not significant"),
        ({"gain": 0.1, "physical": False}, "physically impossible"),
        ({"gain": 0.1, "modulation": 0.2}, "varies"),
        ({"gain": -0.1}, "does not improve"),
        ({"gain": 0.1, "share": 0.015}, "needed"),
    ],
)
def test_what_most_drives_have_need_not_take_much_at_one_more_joint(changes: dict[str, float], word: str) -> None:
    reason = reason_against(replace(RIGHT, **changes), True, 0.01, elsewhere=True)
    assert word in reason and bool(word) == bool(reason)


@pytest.mark.parametrize(
    ("kept_out", "changes", "word"),
    [
        (0.4, {}, ""),
        (0.2, {}, "held-out error"),
        (0.4, {"t": 2.1}, "held-out error"),  # Stribeck friction of a KUKA's first joint came and went
        (0.4, {"modulation": 0.19, "modulation_held_out": 0.13}, "held-out error"),
    ],
)
def test_what_recordings_kept_out_show_beyond_doubt_counts_as_the_gain(
    kept_out: float, changes: dict[str, float], word: str
) -> None:
    """Friction by load of a UR10e's shoulder takes .23 in slices of 12 recordings and .48 of six kept out."""
    own = replace(RIGHT, gain=0.22, **changes)
    reason = reason_against(own, True, 0.01, lambda name: True, kept_out=lambda name: kept_out)
    assert word in reason and bool(word) == bool(reason)


@pytest.mark.parametrize(
    ("effect", "named", "joints", "asked"),
    [
        ("rotor_inertia", 5, 6, True),
        ("rotor_inertia", 3, 6, True),
        ("rotor_inertia", 2, 4, False),  # of three other joints
        ("rotor_inertia", 3, 8, False),  # of seven
        ("joint_spring", 5, 6, False),  # no part of a drive
    ],
)
def test_a_part_of_every_drive_is_one_that_most_other_joints_have(
    effect: str, named: int, joints: int, asked: bool
) -> None:
    names = [Name(effect, (f"joint_{k}",)) for k in range(named + 1)]
    found = cast(Any, [SimpleNamespace(name=one, effect=find(effect)(np.array([k]))) for k, one in enumerate(names)])
    against = dict.fromkeys(names, "") | {names[-1]: "it removes 20 % of the held-out error where it acts"}
    assert (names[-1] in elsewhere_too(found, against, joints)) == asked
    against[names[0]] = "its fitted sign is physically impossible"  # one that is not named does not count
    assert (names[-1] in elsewhere_too(found, against, joints)) == (asked and named - 1 >= max(3, joints // 2))


@pytest.mark.parametrize(
    ("damping", "friction", "one"),
    [(1.1, -2.7, True), (1.1, 2.7, False), (-2.5, 1.0, True), (2.1, -2.7, False)],  # in standard deviations
)
def test_a_part_of_a_coupling_that_no_rotor_has_does_not_count(damping: float, friction: float, one: bool) -> None:
    """A coupling of -.20 N m of friction was told for a rotor of the TX40 that was left out of the catalogue."""
    values = {"inertia": 15.7, "damping": damping, "friction": friction, "sign": -1.0}
    effect = find("coupled_transmission")(np.array([1, 2]), **{k: np.float64(x) for k, x in values.items()})
    assert _one_part(effect, Fitted(np.zeros(3), np.eye(3), ()), (0, 1, 2)) == one


@pytest.mark.parametrize(
    ("inertia", "damping", "friction", "alone"),
    [
        (0.63, 0.08, -0.05, True),  # a rotor at the second joint
        (0.63, -0.7, -0.4, True),
        (0.63, 0.5, 0.0, False),  # likely damping
        (0.3, 0.1, 0.0, False),  # no part is surely there: what they do together may be
        (-0.7, 0.1, 0.2, False),
    ],
)
def test_a_coupling_is_none_by_its_inertia_alone(inertia: float, damping: float, friction: float, alone: bool) -> None:
    """Deviations are .25 each, of the answer's own intervals."""
    values = {"inertia": inertia, "damping": damping, "friction": friction, "sign": 1.0}
    effect = find("coupled_transmission")(np.array([1, 2]), **{k: np.float64(x) for k, x in values.items()})
    fitted = SimpleNamespace(covariance=0.0625 * np.eye(7))
    fitted.places = [(3, 4, 5)]
    joint = cast(Any, SimpleNamespace(causes=[effect], fitted=fitted))
    assert lone_part(joint) == (0 if alone else None)


@pytest.mark.parametrize(
    ("whole", "reason", "behind"),
    [
        ({}, "its sign", True),
        ({}, "", False),  # it has a name: what is left at the joint is another cause
        ({"gain": 0.2}, "its sign", False),
        ({"t": 2.0}, "its sign", False),
        ({"static": False}, "its sign", False),  # late torque is none of the posture
    ],
)
def test_a_spring_may_be_part_of_a_law_of_the_whole_robot_without_a_name(
    whole: dict[str, Any], reason: str, behind: bool
) -> None:
    spring = replace(RIGHT, name=Name("joint_spring", ("pan",)), static=True)
    tilt = replace(RIGHT, name=Name("gravity_tilt", ()), whole=True, static=True)
    each = [spring, RIGHT, replace(tilt, **whole)]
    told = behind_joints(each, {spring.name: "", RIGHT.name: "", tilt.name: reason})
    assert list(told) == ([spring.name] if behind else [])


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"t": 1.5}, True),
        ({"t": 1.5, "gain": 0.1}, False),
        ({"gain": 0.26, "t": 2.5, "modulation": 0.14, "modulation_held_out": 0.14}, True),
        ({"modulation": 0.18, "modulation_held_out": 0.18}, True),
        ({"modulation": 0.22, "modulation_held_out": 0.18}, False),
        ({"outdone": True}, False),
    ],
)
def test_recordings_kept_out_may_show_what_few_blocks_of_the_others_cannot(
    changes: dict[str, float], named: bool
) -> None:
    one = replace(RIGHT, **changes)
    assert reason_against(one, True, 0.01)
    assert bool(reason_against(one, True, 0.01, lambda name: True)) is not named


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"gain": 0.02, "t": 1.8}, ""),
        ({"gain": 0.0}, "does not improve"),
        ({"physical": False}, "physically"),
        ({"share": 0.005}, "tolerance"),
        ({"beside_rest": False}, ""),
        ({"modulation": 0.5}, ""),  # by chance, of a small cause
        ({"modulation_held_out": 0.3}, "varies"),
        ({"share": 2.0, "cancels": True}, ""),
        ({"outdone": True}, "predicts better, though it is none itself"),
        ({"whole": True, "spoils": True}, "predicts a joint worse"),
        ({"whole": True, "massless": True}, "mass is not surely"),
    ],
)
def test_without_a_rest_a_cause_need_only_be_there(changes: dict[str, float], word: str) -> None:
    reason = reason_against(replace(RIGHT, **changes), False, 0.01)
    assert word in reason and bool(word) == bool(reason)


def test_a_law_whose_own_joints_the_motion_still_predicts_is_another() -> None:
    """Four hundredths of what it removes, where three are the limit; not where other joints have misfits too."""
    followed = replace(RIGHT, followed=0.04)
    assert "another law acts there" in reason_against(followed, False, 0.01)
    assert reason_against(replace(followed, unmoved=False), False, 0.01) == ""
    assert reason_against(replace(RIGHT, followed=0.02), False, 0.01) == ""


def test_a_law_of_one_joint_is_none_beside_a_rest_where_one_of_all_joints_explains_as_much() -> None:
    shared = replace(RIGHT, everywhere=True)
    assert "whole robot" in reason_against(shared, True, 0.01)
    assert reason_against(shared, False, 0.01) == ""


def test_what_no_law_explains_is_no_law_that_has_lost_its_name() -> None:
    assert strong(RIGHT)
    weak = ({"gain": 0.2}, {"share": 0.01}, {"t": 2.0}, {"physical": False}, {"beside_rest": False}, {"whole": True})
    assert not any(strong(replace(RIGHT, **changes)) for changes in weak)


def test_friction_that_has_faded_in_recordings_kept_out_is_named_beside_a_rest() -> None:
    drift = replace(RIGHT, name=Name("friction_drift", ("joint_2",)), beside_rest=False)
    never = lambda name: False  # noqa: E731
    assert "named only where nothing else" in reason_against(drift, True, 0.01)
    assert not reason_against(drift, True, 0.01, never, [drift.name])
    assert reason_against(replace(drift, gain=0.1), True, 0.01, never, [drift.name])


def test_a_law_that_cannot_be_is_a_rest_at_its_joints() -> None:
    each = [replace(RIGHT, physical=False), RIGHT, RIGHT, replace(RIGHT, physical=False, whole=True)]
    joints = [(1,), (1, 2), (0,), (0, 1, 2)]
    assert beside_rest(each, joints, False) == [True, True, False, True]
    assert beside_rest(each[1:], joints[1:], False) == [False] * 3
    assert all(beside_rest(each, joints, True))


def test_what_is_left_at_its_joints_is_a_rest_where_it_is_more_than_the_cause() -> None:
    small = replace(RIGHT, share=0.012)
    left = np.array([0.002, 0.03, 0.011])
    assert beside_rest([small] * 3, [(0,), (1,), (2,)], False, left, 0.01) == [False, True, False]
    assert beside_rest([replace(small, share=0.1)], [(0, 1, 2)], False, left, 0.01) == [False]
    assert beside_rest([replace(small, share=0.001)], [(0,)], False, left, 0.01) == [False]  # below the tolerance


def test_a_law_like_a_rest_is_taken_on_less_where_it_leaves_nothing() -> None:
    contact = replace(RIGHT, t=1.8, gain=0.1, beside_rest=False)
    assert reason_against(contact, False, 0.01)
    assert not reason_against(replace(contact, complete=True), False, 0.01)
    assert reason_against(replace(contact, complete=True), True, 0.01)


def test_a_rest_without_repeats_counts_where_smooth_functions_predict_it() -> None:
    flexible, line = Smooth(0.001, Name("position", ("elbow",)), 50.0, np.array([0.0, 50.0])), (1.0, 0.0, 0)
    now, joints = (0.2, 1.0, np.array([0.1, 0.3])), ("shoulder", "elbow")

    def there(p_repeat: float = 1.0, predicted: bool = True, tolerable: bool = False) -> bool:
        return significance((now[0], p_repeat, now[2]), 1.0, 0.5, flexible, line, joints, predicted, tolerable).there

    assert there()
    assert not there(predicted=False)
    assert there(p_repeat=1e-4, predicted=False)  # power that repeats is no noise
    assert not there(p_repeat=1e-4, tolerable=True)


def test_what_is_more_than_noise_and_still_nothing_says_why() -> None:
    assert "at most 0.6 % of any joint's torque, within the tolerance of 1.0 %" in tolerated(0.006, 0.01, False)
    assert "at rest" in tolerated(0.1, 0.01, True)
    assert not tolerated(0.1, 0.01, False)  # a tenth of a torque is no small matter, however little is known of it


def test_a_coupling_turned_by_parts_of_opposite_signs_is_none() -> None:
    covariance = np.diag([0.1, 0.1, 0.1]) ** 2

    def against(inertia: float, damping: float, friction: float) -> bool:
        kind: Any = find("coupled_transmission")
        effect = kind(np.array([0, 1]), inertia=inertia, damping=damping, friction=friction)
        return _turns_against_itself(effect, Fitted(np.zeros(3), covariance, ((0, 1, 2),)), (0, 1, 2))

    assert not against(1.0, 1.0, 1.0)
    assert not against(1.0, 1.0, -0.25)  # may be zero
    assert against(1.0, 1.0, -0.35)
    assert against(-1.0, 1.0, 1.0)
