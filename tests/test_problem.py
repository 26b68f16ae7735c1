"""The model of the data: priors, physical bodies, its torque against Pinocchio, and the width of dry friction."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import equinox as eqx
import numpy as np
import pinocchio as pin
import pytest
import reference
import robots
from synthetic import DT, made_signals, swing

from figaroh_jax.diagnosis.causes import possible
from figaroh_jax.diagnosis.comparison import Verdicts
from figaroh_jax.diagnosis.contenders import Contender
from figaroh_jax.diagnosis.design import units
from figaroh_jax.diagnosis.flexible import WIDTHS, friction_width
from figaroh_jax.diagnosis.floor import sober_spectrum
from figaroh_jax.diagnosis.gaining import foretells
from figaroh_jax.diagnosis.gates import ambiguous, exists, physical_sign, rivals
from figaroh_jax.diagnosis.holdout import fold_squares
from figaroh_jax.diagnosis.joint import polished
from figaroh_jax.diagnosis.layout import held_rows, layout
from figaroh_jax.diagnosis.naming import beyond_simpler, standings
from figaroh_jax.diagnosis.problem import Problem
from figaroh_jax.diagnosis.search import Found, Rival
from figaroh_jax.diagnosis.shifts import shifted, torque_change
from figaroh_jax.diagnosis.state import baseline, batched, extended_state, plain_rows, solved, whitened
from figaroh_jax.diagnosis.step import with_causes
from figaroh_jax.diagnosis.thresholds import MODULATION
from figaroh_jax.effects.base import Motion, place
from figaroh_jax.effects.catalogue import find
from figaroh_jax.errors import InputError
from figaroh_jax.estimation.joint_rows import JointRows
from figaroh_jax.estimation.priors import body_precision, physical_body, rigid_prior
from figaroh_jax.estimation.rows import fit
from figaroh_jax.formats.config import Load
from figaroh_jax.recordings.signals import Signals
from figaroh_jax.recordings.stacked import stack
from figaroh_jax.results import Name
from figaroh_jax.rigid.inertia import from_com, pseudo_inertia
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.simulators.native import NativeBackend

TRUST = 0.1


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    return robots.load(robots.ARM, tmp_path_factory.mktemp("arm"))


def problem_of(model: RobotModel, *signals: Signals) -> Problem:
    records = stack(signals, model)
    held = held_rows(signals, records)
    return Problem(NativeBackend(model), records, layout(signals, records), TRUST, np.zeros(model.nv), held)


def body(mass: float, com: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Ten parameters of a body with principal moments about its centre, turned by an arbitrary rotation."""
    turn = np.linalg.qr(np.random.default_rng(7).standard_normal((3, 3)))[0]
    return np.asarray(from_com(np.float64(mass), com, turn @ np.diag(moments) @ turn.T))


SOLID = body(1.3, np.array([0.05, -0.1, 0.2]), np.array([0.02, 0.03, 0.04]))


def information(seed: int) -> np.ndarray:
    """A metric of the ten parameters as data give it: some directions much better known than others."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.standard_normal((10, 10)))[0]
    return turn @ np.diag(10.0 ** rng.uniform(2, 5, 10)) @ turn.T


@pytest.mark.parametrize("seed", range(3))
def test_a_body_that_can_exist_is_left_as_it_is(seed: int) -> None:
    np.testing.assert_allclose(physical_body(SOLID, information(seed)), SOLID, rtol=0, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_a_body_that_cannot_exist_becomes_the_nearest_that_can(seed: int) -> None:
    rng, metric = np.random.default_rng(seed), information(seed)
    free = SOLID + rng.normal(size=10) * [0.2, *[0.1] * 3, *[0.1] * 6]
    free[4:] *= -1
    assert np.linalg.eigvalsh(np.asarray(pseudo_inertia(free)))[0] < -0.01
    found = physical_body(free, metric)
    assert found[0] > 0
    assert np.linalg.eigvalsh(np.asarray(pseudo_inertia(found)))[0] >= -1e-9
    # no body on the straight line to one that exists is nearer: the set is convex
    distance = (found - free) @ metric @ (found - free)
    towards = metric @ (found - free)
    for other in (SOLID, *(body(m, rng.normal(size=3) * 0.1, np.array([0.01, 0.02, 0.02])) for m in (0.2, 1.0, 3.0))):
        assert (other - found) @ towards >= -1e-3 * distance


def test_what_the_metric_does_not_see_leaves_the_mass_finite() -> None:
    """A moment and a negative inertia would be those of a mass without end, where nothing else is seen."""
    solid = np.append(SOLID[:4] + [0, 0.3, 0, 0], SOLID[4:])
    seen = np.zeros((10, 10))
    for k, size in ((1, 1e4), (6, 1e3)):  # the moment m c_x and one inertia, as at a joint that turns about one axis
        seen[k, k] = size
    free = np.where(np.diag(seen) > 0, solid, 0.0)
    found = physical_body(free, seen)
    assert 0 < found[0] < 1e4
    np.testing.assert_allclose(found[[1, 6]], free[[1, 6]], rtol=0, atol=1e-4)
    free[6] *= -1  # no body turns by less than none
    found = physical_body(free, seen)
    assert 0 < found[0] < 1e8 and np.isfinite(found).all()


@pytest.mark.parametrize("seed", range(40))
def test_parameters_far_from_any_body_end_at_one(seed: int) -> None:
    """Sizes without a scale in common, of which the metric sees some."""
    rng = np.random.default_rng(seed)
    free = rng.normal(size=10) * 10.0 ** rng.uniform(-4, 4, 10)
    seen = np.diag(10.0 ** rng.uniform(0, 7, 10) * rng.integers(0, 2, 10))
    found = physical_body(free, seen)
    values = np.linalg.eigvalsh(np.asarray(pseudo_inertia(found)))
    assert np.isfinite(found).all() and found[0] > 0 and values[0] > -1e-9 * values[-1]


def test_rigid_prior_is_trust_times_each_links_own_scale(tmp_path: Path) -> None:
    parts = [robots.link("base"), robots.link("a", 2.0, com="0.3 0 0.4", rpy="0 0 0"), '<link name="b"/>']
    joints = [robots.joint("turn", "base", "a"), robots.joint("slide", "a", "b", "prismatic")]
    light = robots.load(robots.robot(*parts, *joints), tmp_path)
    mean, precision = rigid_prior(light, TRUST)
    sigma = (1 / np.sqrt(precision) / TRUST).reshape(2, 10)
    turning = (0.04 + 0.06 + 0.03) / 3 + 0.3 * 2.0 * 0.5**2
    np.testing.assert_allclose(sigma[0], [2.0, 1.0, 1.0, 1.0, *[turning] * 6], rtol=0, atol=1e-9)
    np.testing.assert_allclose(mean.reshape(2, 10), light.inertia, rtol=0, atol=0)
    assert sigma[1, 0] == pytest.approx(2e-3, rel=0, abs=1e-12)  # massless: a thousandth of the heaviest


def test_a_fitted_body_is_believed_to_half_of_its_own_scale() -> None:
    ten = body(2.0, np.array([0.3, 0.0, 0.4]), np.array([0.02, 0.03, 0.04]))
    np.testing.assert_allclose(1 / np.sqrt(body_precision(ten)), [1, *[0.5] * 3, *[0.25] * 6], rtol=0, atol=1e-9)
    near = body(2.0, np.zeros(3), np.array([0.02, 0.03, 0.04]))  # no arm shorter than 5 cm
    np.testing.assert_allclose(1 / np.sqrt(body_precision(near)[1]), 0.05, rtol=0, atol=1e-9)


def rigid_torque(model: RobotModel, signals: Signals) -> np.ndarray:
    return np.asarray(reference.inverse_dynamics(model, signals.position, signals.velocity, signals.acceleration))


def test_torque_of_the_baseline_is_pinocchios_plus_the_friction(model: RobotModel) -> None:
    signals = made_signals(6.0)
    problem = problem_of(model, signals)
    state = baseline(problem, ["viscous_friction", "torque_offset"])
    state = solved(state, np.append(np.asarray(model.inertia).reshape(-1), [2.0, 0.5, -1.0, 3.0]))
    load = rigid_torque(model, signals)
    np.testing.assert_allclose(state.motion.load, load, rtol=0, atol=1e-10)
    expected = load + [2.0, 0.5] * signals.velocity + [-1.0, 3.0]
    np.testing.assert_allclose(state.motion.total, expected, rtol=0, atol=1e-10)


def test_rows_of_a_state_that_has_grown_are_those_computed_from_scratch(model: RobotModel) -> None:
    signals = made_signals(6.0, repeat="A"), made_signals(6.0, repeat="A")
    problem, fresh = problem_of(model, *signals), problem_of(model, *signals)
    weights = 1 / (1 + np.asarray(problem.records.omega)[:, None] * [0.01, 0.02])
    state = baseline(problem, ["viscous_friction"])
    for other in (0.5 * weights, weights):  # what is kept of them must not serve other weights
        whitened(problem, state, other)
    grown = extended_state(problem, state, find("joint_spring")(np.array([1])))
    short = whitened(problem, grown, weights)
    for one, other in zip(short, whitened(fresh, grown, weights), strict=True):
        a, b = (x.dense() if isinstance(x, JointRows) else x for x in (one, other))
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
    assert short.X.shape[2] == 20 + 2 + 2
    np.testing.assert_allclose(
        short.Xi.dense(), short.X.dense(), rtol=0, atol=1e-9
    )  # equal repeats are each other's instruments
    lighter = fresh.weighted(0.5 * np.asarray(fresh.records.weight))
    np.testing.assert_allclose(whitened(lighter, grown, weights).X.dense(), 0.5 * short.X.dense(), rtol=0, atol=1e-12)


def test_products_of_known_columns_are_those_of_the_rows_at_hand(model: RobotModel) -> None:
    """Whatever was made before: as many columns, more, other weights, other folds, another torque sensor."""
    problem = problem_of(model, made_signals(6.0), made_signals(5.0))
    begun, white = baseline(problem, ["viscous_friction"]), np.ones((len(problem.records.omega), model.nv))
    more = [
        extended_state(problem, begun, place(find(name), model, [model.joint_names[1]]))
        for name in ("joint_spring", "rotor_inertia")
    ]
    late = extended_state(problem, more[0], place(find("torque_delay"), model, delay=0.01))
    half = problem.weighted(np.asarray(problem.records.weight) * np.linspace(0.5, 1.0, model.nv))
    cases = [(problem, begun, white), *((problem, one, white) for one in more), (half, more[0], white)]
    cases += [(problem, late, white), (problem, more[1], 2 * white), (problem, more[0], white)]
    for here, state, response in cases:
        for fold in (here.layout.fold, here.layout.part):
            rows = whitened(here, state, response)._replace(fold=fold)
            tall = [np.concatenate(rows.X.dense()[:, fold == k]) for k in range(fold.max() + 1)]
            target = [np.concatenate(rows.y[:, fold == k]) for k in range(fold.max() + 1)]
            gram, moment, square = here.filtered.sums(rows)
            size = max(np.abs(x.T @ x).max() for x in tall)
            np.testing.assert_allclose(gram, [x.T @ x for x in tall], rtol=0, atol=1e-12 * size)
            expected = np.array([x.T @ y for x, y in zip(tall, target, strict=True)])
            np.testing.assert_allclose(moment, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
            np.testing.assert_allclose(square, [y @ y for y in target], rtol=1e-12)


def test_a_robot_near_its_nominal_values_is_fitted_without_rest(model: RobotModel) -> None:
    signals = made_signals(12.0)
    mean, precision = rigid_prior(model, 0.01)
    rng = np.random.default_rng(0)
    true = (mean + rng.standard_normal(20) / np.sqrt(precision)).reshape(2, 10)
    robot = dataclasses.replace(model, inertia=true)
    torque = rigid_torque(robot, signals) + [4.0, 1.0] * signals.velocity
    problem = problem_of(model, dataclasses.replace(signals, torque=torque))
    state = baseline(problem, ["viscous_friction"])
    sure = 1e4  # rows known to 1e-4 N m: the prior hardly pulls
    rows = whitened(problem, state, np.full((len(np.asarray(problem.records.omega)), 2), sure))
    linear = fit(rows, state.prior)
    assert np.abs(plain_rows(problem, state).y).max() > 10
    np.testing.assert_allclose(linear.residual / sure, 0.0, rtol=0, atol=1e-4)
    np.testing.assert_allclose(linear.theta[-2:], [4.0, 1.0], rtol=0, atol=1e-4)


@pytest.mark.parametrize("told", [False, True])
def test_a_sign_that_physics_forbids_gives_way_to_a_law_that_does_as_well(model: RobotModel, told: bool) -> None:
    """... and to no law that the data can tell from it, nor to one of another joint."""
    noise = np.random.default_rng(0).normal(size=(40, 50)) * 0.1
    speed = np.linspace(0.1, 1.0, 50)

    def said(change: np.ndarray, more: float = 0.0) -> Verdicts:
        error = noise + 0.3 * speed**0.4 - change + more * np.sign(noise)
        blocks, none = (error**2).sum(1), np.zeros(0)
        return Verdicts(float(blocks.sum()), none, none, blocks, none, error.reshape(1, -1), error.reshape(1, -1))

    def contender(name: str, change: np.ndarray, joint: str, more: float = 0.0, **values: float) -> Contender:
        return Contender(Name(name, (joint,)), place(find(name), model, (joint,), **values), said(change, more), (0,))

    law = 0.3 * speed**0.4
    wrong = contender("stribeck_friction", law, "turn", force=-0.1, speed=0.2)
    other = contender("power_law_friction", law, "slide", strength=0.3, exponent=0.4)
    right = contender("power_law_friction", law, "turn", more=0.1 * told, strength=0.3, exponent=0.4)
    step, screened = (cast(Any, x) for x in (SimpleNamespace(verdicts=said(0 * speed)), SimpleNamespace(groups=[])))
    open_to = ambiguous(step, wrong, rivals(step, [wrong, other, right], wrong), screened)
    instead = tuple(Rival(c.name, c.effect, c.joints) for c in (other, right) if c.name in open_to)
    found = cast(
        Any, Found(wrong.name, wrong.effect, 0.0, (1.0, 0.0), (1.0, 0.0), 9.0, 1.0, open_to, (0,), (), instead)
    )
    kept = possible([found], cast(Any, SimpleNamespace(causes=[wrong.effect])))
    assert kept[0].name == (wrong if told else right).name
    assert possible([found], cast(Any, SimpleNamespace(causes=[right.effect])))[0] is found


def test_an_effect_exists_within_its_bounds_only(model: RobotModel) -> None:
    signals = made_signals(4.0)
    problem = problem_of(model, dataclasses.replace(signals, torque=rigid_torque(model, signals)))

    def known(effect: str, *at: str, **values: float) -> bool:
        return exists(problem, place(find(effect), model, at, **values))

    assert known("torque_delay", delay=0.004)
    assert not known("torque_delay", delay=0.06) and not known("torque_delay", delay=-0.004)  # at its bound; acausal
    assert known("stribeck_friction", "turn", force=0.1, speed=0.1)
    # a wrong sign stays in a search, as a nuisance; it is never named
    assert not physical_sign(place(find("stribeck_friction"), model, ("turn",), force=-0.1, speed=0.1))
    assert physical_sign(place(find("stribeck_friction"), model, ("turn",), force=0.1, speed=0.1))
    assert not physical_sign(place(find("power_law_friction"), model, ("turn",), strength=-1.0, exponent=0.5))
    assert physical_sign(place(find("power_law_friction"), model, ("turn",), strength=1.0, exponent=0.5))
    assert physical_sign(place(find("power_law_friction"), model, ("turn",), strength=-1.0, exponent=1.5))
    assert not known("torque_offset", "turn", offset=1e3)  # more than the joint ever feels
    largest = np.abs(rigid_torque(model, signals)[:, model.joint_names.index("turn")]).max()
    assert known("friction_drift", "turn", force=0.9 * largest, time=3.0)  # it passes: no more on average


LOAD = Load(frame="tool", mass=1.7, com=(0.05, -0.1, 0.2))


@pytest.fixture(scope="module")
def carrying(tmp_path_factory: pytest.TempPathFactory) -> tuple[Problem, list[Any]]:
    """Two recordings of an arm with a tool frame, the second with a load there; Pinocchio's robot of each."""
    weld = robots.joint("weld", "b", "tool", "fixed", xyz="0.2 -0.1 0.3", rpy="0.5 1.0 -0.7")
    text = robots.ARM.replace("</robot>", f'<link name="tool"/>{weld}</robot>')
    model = robots.load(text, tmp_path_factory.mktemp("tool"))
    arms = [reference.build(model) for _ in range(2)]
    point = pin.Inertia(LOAD.mass, np.array(LOAD.com), np.zeros((3, 3)))
    frame = pin.SE3(pin.rpy.rpyToMatrix(0.5, 1.0, -0.7), np.array([0.2, -0.1, 0.3]))
    arms[1].appendBodyToJoint(2, point, frame)
    bare, loaded = made_signals(4.0), made_signals(4.0, begin=20.0)
    signals = [
        dataclasses.replace(one, torque=pinocchio_torque(arm, one.position, one.velocity, one.acceleration), load=load)
        for one, arm, load in zip((bare, loaded), arms, (None, LOAD), strict=True)
    ]
    return problem_of(model, *signals), arms


def pinocchio_torque(arm: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    data = arm.createData()
    return np.array([pin.rnea(arm, data, *x) for x in zip(q, v, a, strict=True)])


def torque_of_both(arms: list[Any], motion: Motion) -> np.ndarray:
    """Torque of the links of two recordings of one length, each with a robot of its own."""
    parts = [np.split(np.asarray(x), 2) for x in (motion.position, motion.velocity, motion.acceleration)]
    return np.concatenate([pinocchio_torque(arm, *(x[k] for x in parts)) for k, arm in enumerate(arms)])


def test_a_known_load_is_felt_in_its_own_recording_and_leaves_no_rest(carrying: tuple[Problem, list[Any]]) -> None:
    problem, arms = carrying
    state = baseline(problem, [])
    np.testing.assert_allclose(state.motion.load, torque_of_both(arms, problem.motion), rtol=0, atol=1e-10)
    np.testing.assert_allclose(problem.motion.load, state.motion.load, rtol=0, atol=1e-10)
    rows = plain_rows(problem, state)
    assert np.abs(rows.y - rows.X @ state.theta).max() < 1e-9 * np.abs(rows.y).max()


def test_a_known_load_moves_and_tilts_with_the_robot(carrying: tuple[Problem, list[Any]]) -> None:
    problem, arms = carrying
    motion, records = problem.motion, problem.records
    elastic = batched(place(find("joint_elasticity"), problem.model, ["turn"], compliance=2e-5))
    true = shifted(elastic, motion, records)
    moved = eqx.tree_at(
        lambda m: (m.position, m.velocity, m.acceleration),
        motion,
        (true.position[0], true.velocity[0], true.acceleration[0]),
    )
    load = torque_of_both(arms, moved)
    windup = np.split((motion.position - moved.position)[:, 0], 2)
    for found, one in zip(windup, np.split(2e-5 * load[:, 0], 2), strict=True):
        inner = slice(20, -20)  # the ends of a recording hold their neighbours' derivatives
        np.testing.assert_allclose(found[inner], one[inner], rtol=0, atol=1e-3 * np.abs(one).max())
    expected = load - torque_of_both(arms, motion)
    np.testing.assert_allclose(torque_change(elastic, motion, records)[0], expected, rtol=0, atol=1e-9)
    for arm in arms:
        arm.gravity.linear += np.array([1.0, 0.0, 0.0])
    tilted = torque_of_both(arms, motion) - motion.load
    tilt = batched(place(find("gravity_tilt"), problem.model))
    found = units({"gravity_tilt": tilt}, motion, records)["gravity_tilt"].torque[0, 0]
    np.testing.assert_allclose(found.T, tilted, rtol=0, atol=1e-9)


def test_a_load_on_what_does_not_move_is_refused(model: RobotModel) -> None:
    fixed = dataclasses.replace(made_signals(4.0), load=Load(frame="base", mass=1.0))
    with pytest.raises(InputError, match="load.frame 'base' does not move"):
        stack([fixed], model)


def averaged(law: Callable[[np.ndarray], np.ndarray], signals: Signals, joint: int) -> np.ndarray:
    """Mean of a law of the velocity over each sampling period, the velocity being straight within it."""
    inside = (np.arange(200) + 0.5) / 200 - 0.5
    v, a = signals.velocity[:, [joint]], signals.acceleration[:, [joint]]
    return law(v + a * DT * inside).mean(1)


@pytest.mark.parametrize("width", [0.0, 0.02, 0.08])
def test_the_width_of_simulated_friction_is_found_and_a_hard_sign_keeps_none(model: RobotModel, width: float) -> None:
    assert width in WIDTHS
    # slow: the sign's own width, |a| dt / 2, stays far below the friction's
    signals = made_signals(20.0, lambda time: 0.5 * swing(0.5 * time))
    hard = averaged(np.sign, signals, 0)
    smooth = averaged(lambda v: np.clip(v / width, -1, 1), signals, 1) if width else averaged(np.sign, signals, 1)
    sigma = 0.05
    noise = sigma * np.random.default_rng(1).standard_normal(signals.position.shape)
    torque = rigid_torque(model, signals) + np.stack([5.0 * hard, 8.0 * smooth], axis=1) + noise
    problem = problem_of(model, dataclasses.replace(signals, torque=torque))
    state = baseline(problem, ["viscous_friction", "coulomb_friction"])
    weights = np.full((len(np.asarray(problem.records.omega)), 2), 1 / sigma)
    found = friction_width(problem, state, weights)
    np.testing.assert_array_equal(found.width, [0.0, width])


def test_what_a_spring_adds_to_a_constant_is_how_its_torque_varies(model: RobotModel) -> None:
    torque = np.random.default_rng(3).normal(2.0, 5.0, (round(8.0 / DT), 2))
    problem = problem_of(model, made_signals(8.0, torque=torque))
    joint, stiffness, offset = 1, 0.4, 25.0
    spring = place(find("joint_spring"), model, [model.joint_names[joint]], stiffness=stiffness, offset=offset)
    state = extended_state(problem, baseline(problem, ["viscous_friction"], []), spring)
    at = [len(state.theta) - 2, len(state.theta) - 1]
    theta = np.append(np.zeros(len(state.theta) - 2), [stiffness, offset])
    state = dataclasses.replace(state, theta=theta)
    judged = np.asarray(problem.records.judged)[..., joint] > 0
    rows = np.take_along_axis(np.asarray(problem.records.position), problem.records.row_samples()[..., None], axis=1)
    varies = stiffness * rows[..., joint][judged].std()  # the filter passes the motion as it is
    size = np.sqrt((problem.torque[..., joint][judged] ** 2).mean())
    assert beyond_simpler(problem, state, spring, at) == pytest.approx(varies / size, rel=1e-3)
    assert beyond_simpler(problem, state, place(find("torque_offset"), model, [model.joint_names[joint]]), at[1:]) == 1


def test_fits_that_share_their_first_causes_are_those_made_alone(model: RobotModel) -> None:
    """`keep` spares what fits without one cause have in common, and changes none of them."""
    signals = made_signals(8.0), made_signals(6.0, begin=10.0)
    at = model.joint_names
    causes = [
        place(find("rotor_inertia"), model, at[:1], inertia=0.1),
        place(find("torque_delay"), model, [], delay=0.004),
        place(find("joint_elasticity"), model, at[1:2], compliance=1e-4),
        place(find("joint_spring"), model, at[:1], stiffness=2.0),
        place(find("joint_elasticity"), model, at[:1], compliance=2e-4),
    ]
    shared, alone = problem_of(model, *signals), problem_of(model, *signals)
    white = np.ones((len(shared.records.omega), model.nv))
    names = ["viscous_friction", "coulomb_friction"]
    first, second = baseline(shared, names), baseline(alone, names)
    with_causes(shared, first, causes, white, keep=True)
    assert shared.begun.get(first, white, *causes[:3]) is not None
    assert shared.begun.get(second, white, *causes[:3]) is None
    for one in [None, *causes]:
        few = [cause for cause in causes if cause is not one]
        found, expected = with_causes(shared, first, few, white), with_causes(alone, second, few, white)
        np.testing.assert_allclose(found.state.theta, expected.state.theta, rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.rows.X.dense(), expected.rows.X.dense(), rtol=0, atol=1e-12)
    shared.begun.clear()
    assert shared.begun.get(first, white, *causes[:3]) is None


def test_parts_left_out_of_several_recordings_are_predicted_by_their_own_coefficients(model: RobotModel) -> None:
    """Beside the regressor's rows times each fold's coefficients; a recording has rows of several folds, or of one."""
    problem = problem_of(model, made_signals(8.0), made_signals(5.0, begin=10.0), made_signals(3.0, begin=20.0))
    state = baseline(problem, ["viscous_friction"])
    rows, rng = plain_rows(problem, state), np.random.default_rng(11)
    n, _, count, nv = problem.records.shape
    fold = np.full((n, count), -1)
    fold[0] = np.arange(count) * 3 // count
    fold[1], fold[2, : count // 3] = 3, 1
    fold[2, count // 3 : count // 2] = 4
    folds = state.theta + rng.normal(size=(5, len(state.theta)))
    predicted, X = np.zeros((nv, n * count)), rows.X.dense()
    for row, own in enumerate(fold.reshape(-1)):
        if own >= 0:
            predicted[:, row] = X[:, row] @ folds[own]
    judged = np.moveaxis(np.asarray(problem.records.judged), 2, 0).reshape(nv, -1)
    expected = ((rows.y - predicted) ** 2 * judged).sum(1)
    found = fold_squares(problem, state, folds, fold.reshape(-1))
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_slow_noise_of_a_recording_kept_out_does_not_bear_out_what_was_fitted_to_another(model: RobotModel) -> None:
    """It does as often as the level of .01 says, though the drift is as slow as the recording; what is there does."""
    rng = np.random.default_rng(7)

    def drift(count: int) -> np.ndarray:
        """A part of a much longer drift, with a power of f^-2, of unit variance at both joints."""
        f = np.maximum(np.fft.rfftfreq(8 * count), 1 / count)[:, None]
        out = np.fft.irfft(np.fft.rfft(rng.standard_normal((8 * count, 2)), axis=0) / f, 8 * count, axis=0)[:count]
        return out / out.std(0)

    signals = made_signals(12.0), made_signals(8.0, begin=20.0, role="holdout")
    made = (dataclasses.replace(s, torque=drift(len(s.time))) for s in signals)
    problem = problem_of(model, *made)
    state, white = baseline(problem, ["viscous_friction"]), np.ones((len(problem.records.omega), model.nv))
    offset = place(find("torque_offset"), model, [model.joint_names[0]])
    bare, full = (with_causes(problem, state, causes, white) for causes in ([], [offset]))
    told, taken = (
        step.state.torque(step.state.theta).reshape(problem.records.torque.shape)[1, : len(signals[1].time)]
        for step in (bare, full)
    )
    taken = taken - told
    sober = sober_spectrum(problem, state)
    sure = {"alone": 0, "there": 0}
    for _ in range(60):
        for key, more in (("alone", 0.0), ("there", 4 * taken / np.abs(taken).max())):
            whole = np.array(problem.records.torque)
            whole[1, : len(told)] = told + drift(len(told)) + more
            records = eqx.tree_at(lambda r: r.torque, problem.records, whole)
            other = Problem(problem.backend, records, problem.layout, TRUST, problem.width, problem.held)
            sure[key] += foretells(other, bare, full, sober)
    assert sure["alone"] <= 3, sure
    assert sure["there"] > 50, sure


@pytest.mark.parametrize(("drifts", "varies"), [("the dry friction", False), ("the law", True)])
def test_an_amplitude_varies_where_what_a_law_adds_does_and_not_where_the_friction_beside_it_does(
    model: RobotModel, drifts: str, varies: bool
) -> None:
    """Most of |v|^.5 is dry and viscous friction: times the time, it took the drift of these for its own."""
    signals = made_signals(20.0)
    v, time = signals.velocity[:, 0], signals.time
    warm = 1 + 0.3 * (time / time[-1] - 0.5)
    law = 8.0 * np.abs(v) ** 0.5 * np.sign(v)
    torque = np.random.default_rng(3).normal(scale=0.05, size=signals.velocity.shape)
    torque[:, 0] += 2 * v + (law + 6.0 * warm * np.sign(v) if drifts == "the dry friction" else law * warm)
    torque += rigid_torque(model, signals)
    problem = problem_of(model, dataclasses.replace(signals, torque=torque))
    state, white = baseline(problem, ["viscous_friction", "coulomb_friction"]), np.ones((len(problem.records.omega), 2))
    power = place(find("power_law_friction"), model, model.joint_names[:1], strength=8.0, exponent=0.5)
    name = Name("power_law_friction", (model.joint_names[0],))
    found = [Found(name, power, 0.0, (1.0, 0.0), (1.0, 0.0), 9.0, 1.0, (), (0,))]
    (one,) = standings(problem, state, found, polished(problem, state, [power], white), white)
    assert (one.modulation > MODULATION) is varies, one
