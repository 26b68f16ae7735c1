"""Motions that tell two causes apart: the separation against plain least squares on Pinocchio's rows."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import reference
import robots
from jaxtyping import Array, Float
from test_excitation import ARM, a_motion, friction_rows

from figaroh_jax.effects.base import JointEffect, Motion, Scalar, amplitude
from figaroh_jax.effects.catalogue import register
from figaroh_jax.errors import InputError
from figaroh_jax.estimation.priors import rigid_prior
from figaroh_jax.excitation import information as info
from figaroh_jax.excitation.design import excite, gram_of
from figaroh_jax.excitation.limits import limits_of
from figaroh_jax.excitation.motions import fourier
from figaroh_jax.excitation.separation import LINK, LOOSE, MOST, causes, separated, separation_objective
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
    root = np.sqrt(np.asarray(learned.weight))[:, None]
    X = (np.concatenate([W, friction_rows(v)], axis=2) * root).reshape(2 * len(q), -1)[:, list(learned.independent)]
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


def test_an_effect_of_ones_own_takes_part_and_its_repeats_are_those_of_rows_repeated(arm: RobotModel):
    """A magnet on 'bend' against its rotor; n repeats are the rows times the root of n, beside the same prior."""

    @register
    class Detent(JointEffect):
        """A magnet."""

        name, title, equation, separated_by = "detent", "detent", "strength sin(3 q)", "slow sweeps of {at}"
        strength: Scalar = amplitude("N m")

        def torque(self, motion: Motion) -> Float[Array, " samples"]:
            return self.strength * jnp.sin(3.0 * self.here(motion.position))

    learned = info.learn(arm, noise=0.02)
    states = np.stack([np.asarray(x) for x in a_motion(arm).states(20.0)])
    pair = (("detent", ("bend",), {"strength": 0.25}), ("rotor_inertia", ("bend",), {"inertia": 0.02}))
    given = causes(learned, [pair], states, 0.1)
    forth, back = separated(given, gram_of(learned, given.sampler, states, given.columns), learned.prior)
    q, v, a = states
    root = np.sqrt(np.asarray(learned.weight))[:, None]
    W = np.concatenate([reference.regressor(arm, q, v, a), friction_rows(v)], axis=2) * root
    X = W.reshape(2 * len(q), -1)[:, list(learned.independent)]
    prior = np.linalg.cholesky(learned.prior).T

    def left(z: np.ndarray, rival: np.ndarray, times: int) -> float:
        z, rival = ((np.stack([0 * x, x], 1) * root[:, 0]).reshape(-1) for x in (z, rival))
        A = np.sqrt(times) * np.column_stack([X, rival])
        A = np.concatenate([A, np.column_stack([prior, np.zeros(len(prior))])])
        y, size = np.concatenate([np.sqrt(times) * z, np.zeros(len(prior))]), np.linalg.norm(A, axis=0)
        return float(np.linalg.norm(y - A @ (np.linalg.lstsq(A / size, y, rcond=None)[0] / size)))

    magnet, rotor = 0.25 * np.sin(3 * q[:, 1]), 0.02 * a[:, 1]
    for told, z, rival in ((forth, magnet, rotor), (back, rotor, magnet)):
        assert told.sigmas == pytest.approx(left(z, rival, 1), rel=1e-4)
        if told.repeats is None:
            assert left(z, rival, MOST) < 4
        else:
            assert left(z, rival, told.repeats) >= 4 * (1 - 1e-4)
            assert told.repeats == 1 or left(z, rival, told.repeats - 1) < 4
    assert {type(told.repeats) for told in (forth, back)} == {int, type(None)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pair", "times"),
    [
        ((("torque_gain", ("bend",), {"gain": 0.05}), ("link_inertia", ("b",), {})), 2.0),
        ((("stribeck_friction", ("bend",), {"force": 0.3, "speed": 0.1}), POWER), 1.25),
    ],
    ids=["gain and link", "Stribeck and power law"],
)
def test_a_motion_designed_for_two_causes_tells_them_apart_better_than_one_that_tells_most_of_all(
    arm: RobotModel, pair: tuple, times: float
):
    basis, limits, learned = fourier(3, 0.5, 4.0), limits_of(arm, acceleration=8.0), info.learn(arm)
    most = excite(arm, basis, limits, learned, separate=[pair], starts=2, start=[0.0, 0.0])
    told = excite(arm, basis, limits, learned, objective="separate", separate=[pair], starts=2, start=[0.0, 0.0])
    assert told.met and most.met
    counted = 1 if pair[1][0] == "link_inertia" else 2  # how a link is wrong nobody knows beforehand
    worst = [min(one.sigmas for one in found.separated[:counted]) for found in (most, told)]
    assert worst[1] > times * worst[0]


def test_effects_that_no_instant_shows_are_refused(arm: RobotModel):
    learned = info.learn(arm)
    states = np.stack([np.asarray(x) for x in a_motion(arm).states(20.0)])
    with pytest.raises(InputError, match="'rotor_inertia' has no parameter 'mass'"):
        causes(learned, [(("rotor_inertia", ("turn",), {"mass": 1.0}), INERTIA)], states)
    with pytest.raises(InputError, match="'joint_elasticity' has no torque of an instant"):
        causes(learned, [(("joint_elasticity", ("turn",), {}), INERTIA)], states)
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


def test_delays_and_lags_are_torques_of_moments_before_and_tell_each_other(arm: RobotModel):
    """Against torques of a long motion that are delayed exactly, and low-passed by their Fourier series."""
    learned, motion = info.learn(arm), a_motion(arm)
    pair = (("torque_delay", (), {"delay": 0.01}), ("torque_lag", (), {"time": 0.012}))
    states = np.stack([np.asarray(x) for x in motion.states(20.0)])
    given = causes(learned, [pair], states)
    assert given.shifts[0] == 0.0 and len(given.cases) > 4
    first = len(given.columns)
    t = np.arange(800) / 200.0  # the motion is periodic: two periods of 2 s
    tau = reference.inverse_dynamics(arm, *(np.asarray(x) for x in motion.at(t)))[:400]
    omega = 2 * np.pi * np.fft.rfftfreq(400, 1 / 200)
    waves = np.fft.rfft(tau, axis=0)
    # the middle of the rivals of a delay is the lag as given, and the other way round
    delays, lags = given.cases[: len(given.cases) // 2], given.cases[len(given.cases) // 2 :]
    assert all(case.rival.shape[1] == 0 for case in given.cases)
    apart = delays[7].truth, lags[7].truth
    np.testing.assert_allclose(apart[0], -apart[1], rtol=0, atol=1e-12)
    both = np.exp(-0.01j * omega) - 1 / (1 + 0.012j * omega)
    for weights, response in ((apart[0], 1 + both), (apart[1], 1 - both)):
        exact = np.fft.irfft(waves * (response[:, None] - 1), 400, axis=0)
        late = [
            reference.inverse_dynamics(arm, *(np.asarray(x) for x in motion.at(np.mod(t[:400] - s, 2.0))))
            for s in given.shifts
        ]
        own = np.einsum("k,ksj->sj", weights[first:], late)
        assert np.abs(own - exact).max() < 0.05 * np.abs(exact).max()
    with pytest.raises(InputError, match="no motion distinguishes viscous_friction at turn from"):
        excite(
            arm,
            fourier(3, 0.5, 4.0),
            limits_of(arm),
            learned,
            separate=[(("viscous_friction", ("turn",), {}), ("rotor_inertia", ("turn",), {}))],
        )
