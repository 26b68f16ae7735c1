"""What a joint at rest leaves is no error of the model where dry friction sticks, and one where a law is missing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import reference
import robots
from synthetic import made_signals, swing

import figaroh_jax as fj
from figaroh_jax.diagnosis.holdout import predicted
from figaroh_jax.diagnosis.layout import held_rows, layout
from figaroh_jax.diagnosis.problem import Problem
from figaroh_jax.diagnosis.rest import relative_rest
from figaroh_jax.diagnosis.standstill import beyond_sliding, only_sticks, resting, stands
from figaroh_jax.diagnosis.state import State, assembled, baseline, solved
from figaroh_jax.recordings.stacked import stack
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.simulators.native import NativeBackend

Law = Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]  # of velocity, top speeds and chance
SLIDING, NOISE, TOLERANCE = np.array([4.0, 4.0]), 1e-2, 0.01  # N m, N m, share of the torque


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    return robots.load(robots.ARM, tmp_path_factory.mktemp("arm"))


def stick(v: np.ndarray, top: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """At each rest a friction of its own between the limits, held until the joint moves on."""
    still = np.abs(v) < 0.05 * top
    begins = np.diff(still.astype(int), axis=0, prepend=0) > 0
    episode = np.cumsum(begins.astype(int), axis=0)
    level = rng.uniform(-1, 1, (episode.max() + 1, v.shape[1])) * SLIDING
    held = np.take_along_axis(level, episode, axis=0)
    return np.where(still, held - SLIDING * np.sign(v), 0.0)


def stribeck(v: np.ndarray, top: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return 0.6 * SLIDING * np.exp(-((v / (0.06 * top)) ** 2)) * np.sign(v)


def spring(v: np.ndarray, top: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A misfit that goes on while the joints move."""
    return 0.3 * SLIDING * np.sin(np.arange(len(v)) / 97.0)[:, None]


def halting(time: np.ndarray) -> np.ndarray:
    """Two joints whose velocity is the third power of a sine: at each reversal they stand still for a while."""
    phase = np.stack([1.3 * time, 1.9 * time + 0.8], axis=1)
    return np.array([0.9, 0.7]) * (np.cos(phase) ** 3 / 3 - np.cos(phase))


def recorded(
    model: RobotModel, more: Law, width: float = 0.0, motion: Callable[[np.ndarray], np.ndarray] = halting
) -> tuple[Problem, State]:
    """Torque of Pinocchio with sliding friction and something more, and the model without that; its friction reverses
    over twice the `width`, in top speeds."""
    plain = made_signals(30.0, motion)
    v, rng = plain.velocity, np.random.default_rng(5)
    rigid = reference.inverse_dynamics(model, plain.position, v, plain.acceleration)
    torque = rigid + SLIDING * np.sign(v) + more(v, np.abs(v).max(0), rng)
    signals = made_signals(30.0, motion, torque + NOISE * rng.standard_normal(torque.shape))
    records = stack([signals], model)
    turned = width * np.abs(v).max(0)
    problem = Problem(
        NativeBackend(model), records, layout([signals], records), 0.1, turned, held_rows([signals], records)
    )
    state = baseline(problem, ["coulomb_friction"])
    return problem, solved(state, np.append(state.theta[: -len(SLIDING)], SLIDING))


def pushed(v: np.ndarray, top: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """More at rest than dry friction can hold."""
    return np.where(np.abs(v) < 0.05 * top, 5 * SLIDING, 0.0)


@pytest.mark.parametrize(("more", "sticks"), [(stick, True), (pushed, False), (stribeck, False), (spring, False)])
def test_only_a_stick_is_no_error_of_the_model(model: RobotModel, more: Law, sticks: bool) -> None:
    problem, state = recorded(model, more)
    noise = np.full(2, NOISE)
    relative = relative_rest(problem, state, noise)
    assert relative.max() > TOLERANCE  # something is left, in all three
    assert only_sticks(problem, state, noise, relative, TOLERANCE) == sticks


def test_a_joint_that_passes_without_stopping_does_not_stick(model: RobotModel) -> None:
    """The same misfit around rest of joints that turn at once, of which nothing can hold one: a law is missing."""
    for motion, still in ((halting, True), (swing, False)):
        problem, state = recorded(model, stick, motion=motion)
        noise = np.full(2, NOISE)
        relative = relative_rest(problem, state, noise)
        assert relative.max() > TOLERANCE
        assert np.all(stands(problem) == still)
        assert only_sticks(problem, state, noise, relative, TOLERANCE) == still


def test_friction_up_to_its_limit_is_no_law_where_the_model_has_less(model: RobotModel) -> None:
    """What a joint that creeps holds goes with its velocity, and stays within what it takes to slide."""
    problem, state = recorded(model, lambda v, top, rng: 0.0 * v, width=0.06)
    noise, left = np.full(2, NOISE), problem.torque - predicted(problem, state)
    assert np.abs(left).max() > 0.2 * SLIDING.max()
    assert beyond_sliding(problem, state, left).max() < 0.01 * SLIDING.max()
    assert only_sticks(problem, state, noise, relative_rest(problem, state, noise), TOLERANCE)


def test_a_joint_that_never_slides_holds_nothing_for_sure(model: RobotModel) -> None:
    """Its friction turns over a width that no speed leaves: how much holds it at rest is not known, and no number."""
    problem, state = recorded(model, stick, width=50.0)
    left = problem.torque - predicted(problem, state)
    beyond = beyond_sliding(problem, state, left)
    assert np.isfinite(beyond).all()
    assert beyond.max() > 0.1 * SLIDING.max()


def test_what_is_tolerable_everywhere_is_no_stick(model: RobotModel) -> None:
    problem, state = recorded(model, lambda v, top, rng: 0.0 * v)
    assert not only_sticks(problem, state, np.full(2, NOISE), np.zeros(2), TOLERANCE)


def test_rows_at_rest_are_those_of_low_speed_and_their_neighbours(model: RobotModel) -> None:
    problem, _ = recorded(model, stick)
    still = resting(problem)[0]
    speed = np.abs(np.asarray(problem.records.velocity)[0, problem.records.row_samples()[0]])
    slow = speed < 0.08 * speed.max(0)
    assert still[slow].all()
    assert slow.mean() < still.mean() < 0.6


@pytest.mark.parametrize("first", [True, False])
def test_a_drive_at_its_limit_sees_the_torque_of_all_causes(model: RobotModel, first: bool) -> None:
    """Its torque is what is cut off of all the others', whichever of them a search has found first."""
    problem, state = recorded(model, lambda v, top, rng: np.zeros_like(v))
    motion, joint = problem.motion, 1
    at = [model.joint_names[joint]]
    rotor = fj.place(fj.CATALOGUE["rotor_inertia"], model, at, inertia=2.0)
    total = np.asarray(state.motion.total)[:, joint] + 2.0 * np.asarray(motion.acceleration)[:, joint]
    limit = 0.6 * np.abs(total).max()
    drive = fj.place(fj.CATALOGUE["torque_saturation"], model, at, share=1.0, limit=float(limit))
    causes = [drive, rotor] if first else [rotor, drive]
    found = assembled(problem, state, causes)
    assert [t.name for t in found.terms[-2:]] == [c.name for c in causes]
    cut = found.parts[-2 if first else -1].torque(np.ones(1))
    np.testing.assert_allclose(cut[:, joint], np.clip(total, -limit, limit) - total, rtol=0, atol=1e-9 * limit)
    np.testing.assert_allclose(found.theta[-2:], [1.0, 2.0] if first else [2.0, 1.0], rtol=0, atol=0)
