"""The next experiment: what is predicted of it is what least squares find once it has been made."""

from __future__ import annotations

import numpy as np
import pytest
import robots
from synthetic import DT, made_signals

from figaroh_jax.diagnosis.experiment import SPEEDS, _everywhere, _predicted, _swept, next_experiment
from figaroh_jax.diagnosis.layout import held_rows, layout
from figaroh_jax.diagnosis.problem import Problem
from figaroh_jax.diagnosis.search import Found
from figaroh_jax.diagnosis.state import State, baseline, extended_state, solved, whitened
from figaroh_jax.effects.base import Effect, place
from figaroh_jax.effects.catalogue import find
from figaroh_jax.recordings.stacked import stack
from figaroh_jax.results import Name
from figaroh_jax.simulators.native import NativeBackend

NOISE = np.array([0.2, 0.1])  # N m, N
FRICTION, OTHER = Name("power_law_friction", ("turn",)), Name("asymmetric_viscous_friction", ("turn",))


@pytest.fixture(scope="module")
def setting(tmp_path_factory: pytest.TempPathFactory) -> tuple[Problem, State, np.ndarray]:
    model = robots.load(robots.ARM, tmp_path_factory.mktemp("arm"))
    signals = [made_signals(8.0), made_signals(8.0, begin=30.0)]
    records = stack(signals, model)
    held = held_rows(signals, records)
    problem = Problem(NativeBackend(model), records, layout(signals, records), 0.1, np.zeros(2), held)
    state = baseline(problem, ["viscous_friction", "coulomb_friction"])
    return problem, solved(state, state.prior.mean), np.ones((len(records.omega), 1)) / NOISE


def friction(problem: Problem) -> Effect:
    return place(find(FRICTION.effect), problem.model, FRICTION.at, strength=2.0, exponent=2.0)


def found(name: Name, effect: Effect, *ambiguous: Name) -> Found:
    return Found(name, effect, 0.001, (2.0, 1.0), (2.0, 1.0), 5.0, 0.9, ambiguous)


def test_what_the_recordings_tell_is_what_least_squares_leave(setting: tuple[Problem, State, np.ndarray]):
    problem, state, whitening = setting
    now, again, _ = _predicted(problem, state, friction(problem), [OTHER], whitening)
    rival = place(find(OTHER.effect), problem.model, OTHER.at)
    X = whitened(problem, extended_state(problem, state, rival), whitening).X.dense()
    truth = extended_state(problem, state, friction(problem))
    y = whitened(problem, truth, whitening).X.dense()[..., -1].reshape(-1) * 2.0
    sure = np.sqrt(np.append(state.prior.precision, 0.0))
    tall, right = np.concatenate([X.reshape(len(y), -1), np.diag(sure)]), np.append(y, np.zeros(len(sure)))
    left = right - tall @ np.linalg.lstsq(tall, right, rcond=None)[0]
    np.testing.assert_allclose(now, left @ left, rtol=1e-4, atol=0)
    assert now < again < 2 * now  # one of two recordings once more


def test_an_experiment_for_a_law_of_friction_moves_its_joint(setting: tuple[Problem, State, np.ndarray]):
    problem, state, whitening = setting
    effect, other = friction(problem), Name("stribeck_friction", ("turn",))
    told = next_experiment("named", [found(FRICTION, effect, other)], problem, state, [effect], whitening)
    assert told is not None and told.separates == (("power_law_friction", "stribeck_friction"),)
    assert "as informative as" in told.text and "more recordings of the current motion" in told.text
    assert "figaroh-jax excite --from RUN_DIR" in told.text


def test_what_no_motion_tells_apart_is_said_so(setting: tuple[Problem, State, np.ndarray]):
    problem, state, whitening = setting
    name, other = Name("torque_offset", ("turn",)), Name("asymmetric_coulomb_friction", ("turn",))
    offset = place(find(name.effect), problem.model, name.at, offset=0.5)
    told = next_experiment("named", [found(name, offset, other)], problem, state, [offset], whitening)
    assert told is not None and told.text.startswith("a dwell of turn with the brake on")
    assert "none of the motions" in told.text


def test_a_cause_alone_in_its_set_needs_no_experiment(setting: tuple[Problem, State, np.ndarray]):
    problem, state, whitening = setting
    effect = friction(problem)
    assert next_experiment("named", [found(FRICTION, effect)], problem, state, [effect], whitening) is None
    told = next_experiment("unknown", [], problem, state, [], whitening)
    assert told is not None and told.separates == ()


def test_sweeps_keep_their_speeds_and_the_recorded_range(setting: tuple[Problem, State, np.ndarray]):
    q = np.asarray(setting[0].records.position)[0]
    position, velocity, _ = _swept(q, [0], SPEEDS, DT)
    phase = np.arange(len(q)) * len(SPEEDS) // len(q)
    for k, speed in enumerate(SPEEDS):
        assert np.isclose(np.median(np.abs(velocity[phase == k, 0])), speed, rtol=0, atol=1e-9)
    assert (np.ptp(position, axis=0) <= np.ptp(q, axis=0) + 0.05).all() and not velocity[:, 1].any()
    rival = _everywhere(setting[0], Name("stribeck_friction", ("turn",)))
    assert len(rival.at) == 2 * len(find("stribeck_friction").parameters()["speed"].grid) - 1
