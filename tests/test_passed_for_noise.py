"""A cause that no smooth function follows passes for noise until it is known; what is told then must not hold it."""

from __future__ import annotations

import re
import secrets
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from generators import robots
from generators.case import Case
from generators.inverse import draw_case, make_case, record_case

import figaroh_jax as fj
from benchmarks.conditions import graded
from benchmarks.hide_and_name.stiction import make_stiction_case

needs_robots = pytest.mark.skipif(not robots.available("tx40"), reason="FIGAROH_JAX_DATA has no staubli_tx40")


def diagnosed(case: Case, forbid: Sequence[str] = ()) -> fj.Diagnosis:
    with tempfile.TemporaryDirectory() as folder:
        found = fj.diagnose_task(fj.load_task(case.write(Path(folder), forbid)))
    assert isinstance(found, fj.Diagnosis)
    return found


def loud(case: Case) -> np.ndarray:
    """RMS torque of each joint (N m), which the noise of the made sensors goes with."""
    return np.sqrt(np.mean([(one["torque"] ** 2).mean(0) for one in case.recordings], axis=0))


@pytest.mark.slow
@needs_robots
@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(secrets.randbits(31), id="drawn"),
        pytest.param(1325230507, id="slow end of a motion"),
        pytest.param(539310508, id="creeps"),
    ],
)
def test_the_noise_beside_a_large_ripple_is_that_of_its_sensor(seed: int):
    """It had been told up to eight times too large, and the intervals with it; below 2.2 times it stays.

    Where a joint creeps at the end, a wide reversal of its friction had made up for a part of the ripple, and what that
    lacks had been Stribeck friction of 10 N m.
    """
    hidden = make_case([("torque_ripple", 0.8, ("joint_5",))], repeats=1, trajectories=2, seed=seed)
    without = make_case(repeats=1, trajectories=2, seed=seed)
    clean, found = diagnosed(without), diagnosed(hidden)
    (truth,) = hidden.truth
    assert [tuple(cause.name) for cause in found.causes] == [(truth.effect, truth.at)], seed
    assert (np.abs(np.log(found.noise / clean.noise * loud(without) / loud(hidden))) < np.log(2.4)).all(), seed
    told = found.causes[0].parameters
    for name, value in truth.parameters.items():
        assert abs(told[name].value - value) < 4.5 * told[name].std, (seed, name)


@pytest.mark.slow
@needs_robots
@pytest.mark.parametrize(
    "effect, at",
    [
        ("asymmetric_viscous_friction", ("joint_2",)),
        ("friction_drift", ("joint_6",)),
    ],
)
def test_what_the_catalogue_lacks_is_not_told_as_noise(effect: str, at: tuple[str, ...]):
    """27 s without repeats: six and four times the sensor's noise had been told there, and `nothing`."""
    seed = secrets.randbits(31)
    hidden, without = (make_case(effects, repeats=1, seed=seed) for effects in ([(effect, 0.15, at)], []))
    clean, found = diagnosed(without), diagnosed(hidden, [effect])
    assert found.verdict != "nothing", seed
    assert (np.abs(np.log(found.noise / clean.noise * loud(without) / loud(hidden))) < np.log(2.0)).all(), seed


@pytest.mark.slow
@needs_robots
@pytest.mark.parametrize(
    "effect, seed, scale, colour, step",
    [
        # nearly dependent columns of the rich model cancelled in the rows they were fitted to, and in no others
        pytest.param("clock_error", 3306761008, 2.0, "ar100", 1e-5, id="clock"),
        # a step beyond all torques leaves no slope to come back by; a power law of the speed was named
        pytest.param("torque_saturation", 1786552537, 0.5, "white", 1e-5, id="limit"),
    ],
)
def test_what_a_fit_had_lost_is_named_and_sized(effect: str, seed: int, scale: float, colour: str, step: float):
    hidden = make_case([(effect, 0.15)], "tx40", 1, 4, scale, seed, colour=colour, encoder_step=step)
    found, (truth,) = diagnosed(hidden), hidden.truth
    assert [tuple(cause.name) for cause in found.causes] == [(truth.effect, truth.at)]
    told = found.causes[0].parameters
    for name, value in truth.parameters.items():
        assert abs(told[name].value - value) < 4.5 * told[name].std, name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "seed", "scale", "colour"),
    [
        ("ur10e", 1654321527, 1.0, "white"),
        ("panda", 28229906, 2.0, "ar100"),
    ],
)
def test_a_gear_on_which_the_link_swings_in_the_band_of_its_motion_is_named(
    robot: str, seed: int, scale: float, colour: str
):
    """To first order its torque explains nothing; two gains were named for the UR10e's, the Panda's was unknown."""
    if not robots.available(robot):
        pytest.skip(f"FIGAROH_JAX_DATA has no {robot}")
    drawn = draw_case([("joint_elasticity", 0.15)], robot, 3, seed)
    case = record_case(drawn, 2, scale, colour=colour, encoder_step=1e-4)
    (cause,) = diagnosed(case).causes
    (truth,) = case.truth
    assert (cause.name.effect, cause.name.at) == (truth.effect, truth.at)
    size = cause.parameters["compliance"]
    assert abs(size.value - truth.parameters["compliance"]) < 3 * size.std


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["tx40", "panda"])
def test_a_torque_that_follows_other_joints_is_not_told_as_noise(robot: str):
    """36 s without repeats: a product of a position and a velocity of two other joints, which the catalogue lacks, was
    `nothing` in nine of nine cases of 5 and 15 %."""
    if not robots.available(robot):
        pytest.skip(f"FIGAROH_JAX_DATA has no {robot}")
    seed = secrets.randbits(31)
    hidden = make_case([("cross_joint_product", 0.1)], robot, 1, 4, 1.0, seed, colour="pink", encoder_step=1e-5)
    found, (truth,) = diagnosed(hidden), hidden.truth
    assert found.verdict == "unknown", seed
    names = found.joints
    j = names.index(truth.at[0])
    i, k = names[(j + 1) % len(names)], names[(j + 2) % len(names)]
    assert f"of what {names[j]} leaves goes with the position of {i} times the velocity of {k}" in found.rest.text, seed
    without = make_case([], robot, 1, 4, 1.0, seed, colour="pink", encoder_step=1e-5)
    noise = diagnosed(without).noise * loud(hidden) / loud(without)
    # it was told up to twenty times as large, and no rest at all
    assert abs(np.log(found.noise[j] / noise[j])) < np.log(2.4), (seed, found.noise[j], noise[j])
    assert int(np.argmax(found.rest.relative)) == j, seed


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["tx40", "panda"])
def test_a_spot_that_a_joint_feels_in_one_direction_has_no_name(robot: str):
    """One damaged tooth was `nothing`, within a noise that was told twice as large as all that is left."""
    if not robots.available(robot):
        pytest.skip(f"FIGAROH_JAX_DATA has no {robot}")
    seed = secrets.randbits(31)
    hidden = make_case([("sticky_tooth", 0.1)], robot, 1, 4, 1.0, seed, encoder_step=1e-5)
    found, (truth,) = diagnosed(hidden), hidden.truth
    assert found.verdict == "unknown", seed
    assert found.rest.relative.argmax() == found.joints.index(truth.at[0]), seed


@pytest.mark.slow
@pytest.mark.parametrize("seed", [40014, 40027, 40030, 40036])
def test_a_spot_of_a_gear_is_no_ripple_and_no_gain_of_the_joint_beside(seed: int):
    """Two ripples, one ripple, `nothing`, and a gain of the other joint were the answers."""
    answer = graded(seed, "tooth")
    assert answer["grade"] == "unknown", answer["names"]
    if seed == 40030:  # only that it has a place says that it is no noise; the spot lies at .712 rad
        goes = r".* of what elbow leaves goes with its position while it moves forwards, most at (.*) rad"
        told = re.fullmatch(goes, answer["text"])
        assert told and abs(float(told[1]) - 0.712) < 0.06, answer["text"]


@needs_robots
@pytest.mark.slow
def test_friction_that_a_law_turns_down_is_no_friction():
    """A drive at its limit, which the catalogue lacked, was a power law that lost a fifth of joint 6's friction again
    towards its top speed."""
    hidden = make_case([("torque_saturation", 0.15)], "tx40", 1, 4, 0.5, 2849299173, colour="white", encoder_step=1e-5)
    assert diagnosed(hidden, ["torque_saturation"]).verdict == "unknown"


@needs_robots
@pytest.mark.slow
def test_the_slowest_of_all_ripples_is_no_ripple():
    """A tilt left out had been a ripple of the base's joint, of the least order that is looked for (2.9 +- 1.4)."""
    case = make_stiction_case([("gravity_tilt", 0.1)], "tx40", 1, 4, 1113592688)
    found = diagnosed(case, ["gravity_tilt"])
    assert found.verdict == "unknown" and found.causes == ()
    assert "slower function" in {near.name.effect: near.why_not for near in found.rest.nearest}["torque_ripple"]


@needs_robots
@pytest.mark.slow
def test_presliding_is_not_what_samples_make_of_friction():
    """Its wide reversal was read as that of dry friction between two samples: `nothing`, at 11 % of the torque."""
    hidden = make_case([("presliding", 0.15)], "tx40", 1, 4, 0.5, 1232811719, colour="ar20", encoder_step=1e-4)
    assert diagnosed(hidden, ["presliding"]).verdict == "unknown"


@pytest.mark.slow
@needs_robots
@pytest.mark.parametrize(
    "size, seed",
    [
        pytest.param(0.2, secrets.randbits(31), id="drawn"),
        pytest.param(0.12, 71, id="half as large"),
        pytest.param(0.2, 1395646121, id="a rotor in its place"),
    ],
)
def test_a_ripple_beside_joints_that_stick_is_not_told_as_noise(size: float, seed: int):
    """In closed loop what sticks leaves the most; the ripple had been told as noise, and the rest as sticks alone."""
    case = make_stiction_case([("torque_ripple", size, ("joint_3",))], "tx40", repeats=1, trajectories=4, seed=seed)
    assert diagnosed(case, ["torque_ripple"]).verdict == "unknown", seed


@pytest.mark.slow
@needs_robots
@pytest.mark.parametrize("seed", [2977292912, 892567041])
def test_friction_that_slides_is_that_of_the_rows_that_move(seed: int):
    """Beside rows at rest it had been told 2 to 5 % too small, and what moves was no longer explained: `unknown`."""
    assert diagnosed(make_stiction_case([], "tx40", repeats=1, trajectories=4, seed=seed)).verdict == "nothing"


@pytest.mark.slow
@needs_robots
def test_a_link_of_which_no_number_is_known_is_no_cause():
    """A gain of joint 2 had been link 2, of which the mass was told as 0 +- 33 565 kg and none of the ten as surely
    there."""
    case = make_stiction_case([("torque_gain", 0.1)], "tx40", repeats=1, trajectories=4, seed=2223985989)
    assert "link_inertia" not in [cause.name.effect for cause in diagnosed(case).causes]


@pytest.mark.slow
@pytest.mark.skipif(not robots.available("ur10e"), reason="FIGAROH_JAX_DATA has no ur10e")
@pytest.mark.parametrize("seed", [3002095554, 1639379783])
def test_joints_that_break_loose_are_no_effect(seed: int):
    """The others' motion foretold a joint beside those that stick, in which nothing is missing: it had been `unknown`.

    A joint that breaks loose jerks its neighbours as no filtered acceleration shows.
    """
    assert diagnosed(make_stiction_case([], "ur10e", repeats=1, trajectories=4, seed=seed)).verdict == "nothing"


@pytest.mark.skipif(not robots.available("panda"), reason="FIGAROH_JAX_DATA has no panda")
@pytest.mark.slow
def test_a_payload_that_two_links_carry_alike_is_named():
    """Four candidates fitted alike, and each was fourth in too many folds: `unknown`, with .99 of the squares gone."""
    case = make_stiction_case([("payload", 0.1)], "panda", repeats=1, trajectories=4, seed=938974309)
    (payload,) = diagnosed(case).causes
    (truth,) = case.truth
    assert (truth.effect, truth.at) in [tuple(payload.name), *map(tuple, payload.ambiguous_with)]
    told = payload.parameters["mass"]
    assert abs(told.value - truth.parameters["mass"]) < 4.5 * told.std


@pytest.mark.slow
@needs_robots
def test_nothing_is_named_of_a_size_that_may_be_none_by_the_interval_beside_it():
    """Links and friction take a gain of 5 % but for .7 % of a joint: one of -1.6 +- 1.7 % stood at another joint."""
    case = record_case(draw_case([("torque_gain", 0.05)], "tx40", 3, 3880610113), 2, colour="ar100", encoder_step=1e-4)
    found = diagnosed(case)
    assert found.verdict == "nothing"
    assert not found.causes
