"""Motions that tell two causes apart: the separation against plain least squares on Pinocchio's rows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import reference
import robots
from test_excitation import ARM, a_motion

from figaroh_jax.errors import InputError
from figaroh_jax.estimation.priors import rigid_prior
from figaroh_jax.excitation import information as info
from figaroh_jax.excitation.design import excite, gram_of
from figaroh_jax.excitation.limits import limits_of
from figaroh_jax.excitation.motions import fourier
from figaroh_jax.excitation.separation import LINK, LOOSE, causes, separated, separation_objective
from figaroh_jax.rigid.model import RobotModel

ROTOR = ("rotor_inertia", ("turn",), {"inertia": 0.3})
INERTIA = ("link_inertia", ("a",), {})
STRIBECK = ("stribeck_friction", ("bend",), {"force": 2.0, "speed": 0.1})
POWER = ("power_law_friction", ("bend",), {})


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    return robots.load(ARM, tmp_path_factory.mktemp("arm"))


def test_separation_is_what_least_squares_leaves_of_the_cause_and_its_gradient_that_of_finite_differences(
    arm: RobotModel,
):
    learned, motion = info.learn(arm), a_motion(arm)
    states = np.stack([np.asarray(x) for x in motion.states(20.0)])
    given = causes(learned, [(ROTOR, INERTIA)], states, 0.1)
    G = gram_of(learned, given.sampler, states, given.columns)
    forth, back = separated(given, G, np.asarray(learned.prior))
    q, v, a = states
    W = reference.regressor(arm, q, v, a)
    friction = np.zeros((len(q), 2, 4))
    for joint in range(2):
        friction[:, joint, joint] = v[:, joint]
        friction[:, joint, 2 + joint] = np.tanh(v[:, joint] / (info.SMOOTH + 1e-9))
    root = np.sqrt(np.asarray(learned.weight))[:, None]
    X = (np.concatenate([W, friction], axis=2) * root).reshape(2 * len(q), -1)[:, list(learned.independent)]
    link = (W[:, :, :10] * root).reshape(-1, 10)
    rotor = (np.stack([a[:, 0], 0 * a[:, 0]], 1) * root[:, 0]).reshape(-1, 1)
    prior = np.linalg.cholesky(learned.prior).T
    loose = np.sqrt(rigid_prior(arm, 0.1)[1][:10]) / LOOSE

    def left(z: np.ndarray, Z: np.ndarray, own: np.ndarray) -> float:
        A = np.block([[X, Z], [prior, np.zeros((len(prior), Z.shape[1]))], [np.zeros((len(own), X.shape[1])), own]])
        y = np.concatenate([z, np.zeros(len(prior) + len(own))])
        size = np.linalg.norm(A, axis=0)
        return float(np.linalg.norm(y - A @ (np.linalg.lstsq(A / size, y, rcond=None)[0] / size)))

    assert forth.sigmas == pytest.approx(left(0.3 * rotor[:, 0], link, np.diag(loose)), rel=1e-4)
    nominal = LINK * np.asarray(arm.inertia)[0]
    assert back.sigmas == pytest.approx(left(link @ nominal, rotor, np.zeros((0, 1))), rel=1e-4)
    assert forth.repeats == max(1, np.ceil((4 / forth.sigmas) ** 2))

    given = causes(learned, [(ROTOR, INERTIA), (STRIBECK, POWER)], states, 0.1)
    G = gram_of(learned, given.sampler, states, given.columns)
    objective = separation_objective(given, np.asarray(learned.prior))
    rows = np.random.default_rng(0).normal(size=(len(G), 3)) * np.sqrt(np.diag(G))[:, None] * 0.1
    change, h = rows @ rows.T, 1e-5
    slope = (objective(G + h * change)[0] - objective(G - h * change)[0]) / (2 * h)
    assert np.sum(objective(G)[1] * change) == pytest.approx(slope, rel=1e-4)


@pytest.mark.slow
def test_a_motion_designed_for_two_causes_tells_them_apart_better_than_one_that_tells_most_of_all(arm: RobotModel):
    basis, limits, learned = fourier(3, 0.5, 4.0), limits_of(arm, acceleration=8.0), info.learn(arm)
    pairs = [(ROTOR, INERTIA)]
    most = excite(arm, basis, limits, learned, separate=pairs, starts=1, start=[0.0, 0.0])
    told = excite(arm, basis, limits, learned, objective="separate", separate=pairs, starts=1, start=[0.0, 0.0])
    assert told.met and most.met
    worst = [min(one.sigmas for one in found.separated) for found in (most, told)]
    assert worst[1] > 1.05 * worst[0]


def test_effects_that_no_instant_shows_are_refused(arm: RobotModel):
    learned = info.learn(arm)
    states = np.stack([np.asarray(x) for x in a_motion(arm).states(20.0)])
    with pytest.raises(InputError, match="'rotor_inertia' has no parameter 'mass'"):
        causes(learned, [(("rotor_inertia", ("turn",), {"mass": 1.0}), INERTIA)], states)
    with pytest.raises(InputError, match="'torque_delay' has no torque of an instant"):
        causes(learned, [(("torque_delay", (), {}), INERTIA)], states)
    with pytest.raises(InputError, match="needs pairs of causes"):
        excite(arm, fourier(3, 0.5, 4.0), objective="separate")


@pytest.mark.slow
def test_a_task_asks_for_a_separation(tmp_path: Path):
    from figaroh_jax.excitation.task import excite_task
    from figaroh_jax.formats.config import load_task

    (tmp_path / "robot.urdf").write_text(ARM)
    pair = "[{effect: rotor_inertia, at: [turn], size: {inertia: 0.3}}, {effect: link_inertia, at: [a]}]"
    keys = f"{{duration: 2, basis: {{fourier: 2}}, starts: 1, objective: separate, separate: [{pair}]}}"
    (tmp_path / "task.yaml").write_text(f"robot: {{model: robot.urdf}}\nexcite: {keys}\n")
    found = excite_task(load_task(tmp_path / "task.yaml"))
    assert [one.truth for one in found.separated] == ["rotor_inertia at turn", "link_inertia at a"]
    assert found.separated[0].size == {"inertia": 0.3}
