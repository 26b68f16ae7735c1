"""Momentum and energy forms, simulated instruments, payloads, drive gains: against Pinocchio and hidden truths."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np
import pytest
import reference
from robots import ARM, PENDULUM, load

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.estimation.columns import friction_terms
from figaroh_jax.estimation.least_squares import WeightedByJoint, solve
from figaroh_jax.estimation.regression import condense
from figaroh_jax.estimation.states import States
from figaroh_jax.formats.config import Baseline, Load
from figaroh_jax.identification.acceleration_free import WindowRows, energy_columns, momentum_columns
from figaroh_jax.identification.instruments import solve_by_simulation
from figaroh_jax.identification.payloads import PayloadStates, drive_gains

DRIVES = np.array([0.8, 0.5, 1.1, 0.7, 0.2, 0.3, 0.15, -0.4])  # viscous, Coulomb, rotor, offset of two joints


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[fj.RobotModel, Path]:
    folder = tmp_path_factory.mktemp("arm")
    return load(ARM, folder), folder / "robot.urdf"


def motion(seconds: float, dt: float, seed: int) -> tuple[np.ndarray, ...]:
    """Time, positions, velocities and accelerations of two joints, sums of sines."""
    random, t = np.random.default_rng(seed), np.arange(0, seconds, dt)
    w, phase = 2 * np.pi * random.uniform(0.1, 1.2, (4, 2)), random.uniform(0, 6.28, (4, 2))
    size = np.array([0.5, 0.15])
    x = t[:, None, None] * w + phase
    return t, (size * np.sin(x)).sum(1), (size * w * np.cos(x)).sum(1), (-size * w**2 * np.sin(x)).sum(1)


def drive_torque(v: np.ndarray, a: np.ndarray) -> np.ndarray:
    return DRIVES[:2] * v + DRIVES[2:4] * np.sign(v) + DRIVES[4:6] * a + DRIVES[6:]


def test_momentum_and_energy_are_pinocchios(arm: tuple[fj.RobotModel, Path]):
    pin = pytest.importorskip("pinocchio")
    model, _ = arm
    robot = reference.build(model)
    data = robot.createData()
    q, v = np.random.default_rng(None).uniform(-2, 2, (2, 20, 2))
    theta = np.ravel(np.asarray(model.inertia))
    P, H = (np.asarray(x) @ theta for x in momentum_columns(model, (), q, v))
    E, D = (np.asarray(x)[:, 0] @ theta for x in energy_columns(model, (), q, v))
    energy = []
    for k in range(20):
        M = pin.crba(robot, data, q[k])
        M = np.triu(M) + np.triu(M, 1).T
        np.testing.assert_allclose(P[k], M @ v[k], rtol=0, atol=1e-12)
        C = pin.computeCoriolisMatrix(robot, data, q[k], v[k])
        g = pin.computeGeneralizedGravity(robot, data, q[k])
        np.testing.assert_allclose(H[k], g - C.T @ v[k], rtol=0, atol=1e-11)
        energy.append(pin.computeKineticEnergy(robot, data, q[k], v[k]) + pin.computePotentialEnergy(robot, data, q[k]))
    np.testing.assert_allclose(np.diff(E), np.diff(energy), rtol=0, atol=1e-11)
    assert not D.any()


@pytest.mark.parametrize("form", ["momentum", pytest.param("energy", marks=pytest.mark.slow)])
def test_forms_without_acceleration_find_the_parameters_where_differences_spoil_the_torque_form(
    form: Literal["momentum", "energy"], arm: tuple[fj.RobotModel, Path]
):
    model, _ = arm
    terms, dt, random = friction_terms(model, Baseline(rotor=True, offset=True)), 2e-3, np.random.default_rng(3)
    _, q, v, a = motion(40.0, dt, 1)
    tau = np.asarray(fj.inverse_dynamics(model, q, v, a)) + drive_torque(v, a)
    truth = np.append(np.ravel(np.asarray(model.inertia)), DRIVES)
    noisy_q, noisy_v = q + 1e-4 * random.standard_normal(q.shape), v + 0.01 * random.standard_normal(v.shape)
    noisy = tau + 0.05 * random.standard_normal(tau.shape)
    torque = States(model, lambda: [(noisy_q, noisy_v, np.gradient(noisy_v, dt, axis=0), noisy)], terms)
    window = 20 if form == "momentum" else 10
    clean = WindowRows(model, lambda: [(q, v, tau)], dt, form, window, terms)
    rows = WindowRows(model, lambda: [(noisy_q, noisy_v, noisy)], dt, form, window, terms)
    base = torque.structural
    error = {}
    for name, one in {"torque": torque, "clean": clean, form: rows}.items():
        found = solve(condense(one, one.used), WeightedByJoint(), kept=base.independent)
        error[name] = base.matrix @ truth - found.parameters[base.independent]
    size = np.linalg.norm(base.matrix @ truth)
    assert np.linalg.norm(error["clean"]) < 0.01 * size  # the sign of a velocity jumps inside of a window
    assert np.linalg.norm(error[form]) < 0.35 * np.linalg.norm(error["torque"])
    assert np.linalg.norm(error[form]) < (0.06 if form == "momentum" else 0.12) * size


def test_odd_windows_and_short_records_are_refused(arm: tuple[fj.RobotModel, Path]):
    model, _ = arm
    with pytest.raises(InputError, match="window is 5, expected an even number"):
        WindowRows(model, list, 0.01, window=5)
    with pytest.raises(InputError, match="record 0 of the source: 8 samples are less than a window"):
        list(WindowRows(model, lambda: [(np.zeros((8, 2)),) * 3], 0.01).pieces())


KP, KD = 40.0, 6.0


def wanted(t, library):
    return 0.9 * library.sin(2.1 * t) + 0.5 * library.sin(5.3 * t + 1.0)


def swing(seconds: float, dt: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A pendulum under a servo that sees a noisy encoder: equations of one line, midpoint rule, no library."""
    J, weight, friction = 0.03 + 1.3 * 0.4**2, 1.3 * 0.4 * 9.81, 0.5
    random, q, v, seen = np.random.default_rng(seed), 0.0, 0.0, [0.0, 0.0]
    read, torque = [], []
    for k in range(int(seconds / dt)):
        seen = [q + 1e-3 * random.standard_normal(), seen[0]] if k else seen
        tau = KP * (wanted(k * dt, np) - seen[0]) - KD * v
        read.append(seen[0])
        torque.append(tau)
        middle = v + 0.5 * dt * (tau - weight * np.sin(q) - friction * v) / J
        v, q = v + dt * (tau - weight * np.sin(q + 0.5 * dt * v) - friction * middle) / J, q + dt * middle
    return np.array(read)[:, None], np.array(torque)[:, None]


def test_instruments_of_the_simulated_trajectory_remove_the_bias_of_encoder_noise(tmp_path: Path):
    model, dt, span = load(PENDULUM, tmp_path), 2e-3, 8
    q, tau = swing(30.0, dt, 4)
    k = np.arange(span, len(q) - span)
    v = (q[k + span] - q[k - span]) / (2 * span * dt)
    a = (q[k + span] - 2 * q[k] + q[k - span]) / (span * dt) ** 2
    terms = friction_terms(model, Baseline(coulomb=False))
    rows = States(model, lambda: [(q[k], v, a, tau[k])], terms)
    base = rows.structural
    names = [base.names[i] for i in base.independent]
    truth = dict(zip(names, base.matrix @ np.append(np.ravel(np.asarray(model.inertia)), 0.5), strict=True))
    inertia = next(name for name in names if name.startswith("I"))
    biased = solve(condense(rows, rows.used), kept=base.independent).parameters[base.names.index(inertia)]
    assert biased < 0.8 * truth[inertia]

    def control(time, position, velocity):
        return KP * (wanted(time + span * dt, jnp) - position) - KD * velocity

    found = solve_by_simulation(rows, base, control, q[span], v[0], dt)
    assert found.converged
    assert found.parameters[base.names.index(inertia)] == pytest.approx(truth[inertia], rel=0.03)
    assert found.parameters[base.names.index("fv1")] == pytest.approx(0.5, rel=0.05)


def test_an_unknown_payload_on_a_frame_is_found(arm: tuple[fj.RobotModel, Path]):
    model, _ = arm
    load, random = Load(frame="b", mass=1.7, com=(0.1, -0.2, 0.3)), np.random.default_rng(5)
    bare, loaded = (_states(model, 20.0, seed, given, random) for seed, given in ((1, None), (2, load)))
    terms = friction_terms(model, Baseline())
    rows = PayloadStates(States(model, lambda: [bare], terms), States(model, lambda: [loaded], terms), "b")
    base = rows.structural
    found = solve(condense(rows, rows.used), WeightedByJoint(), kept=base.independent)
    columns = dict(zip(base.expressions, found.parameters[base.independent], strict=True))
    assert columns["m_b"] == pytest.approx(1.7, abs=0.03)
    assert (found.rms < 0.055).all()


def _states(model: fj.RobotModel, seconds: float, seed: int, given: Load | None, random: np.random.Generator):
    """States and torques; the payload is a body that the model is given by hand."""
    import equinox as eqx

    _, q, v, a = motion(seconds, 0.01, seed)
    if given is not None:
        c, m = np.array(given.com), given.mass
        about = m * (c @ c * np.eye(3) - np.outer(c, c))
        ten = np.array([m, *(m * c), about[0, 0], about[0, 1], about[1, 1], about[0, 2], about[1, 2], about[2, 2]])
        model = eqx.tree_at(lambda x: x.inertia, model, np.asarray(model.inertia) + np.stack([0 * ten, ten]))
    tau = np.asarray(fj.inverse_dynamics(model, q, v, a)) + DRIVES[:2] * v + DRIVES[2:4] * np.sign(v)
    return q, v, a, tau + 0.05 * random.standard_normal(tau.shape)


def test_hidden_drive_gains_are_found_with_a_known_payload(arm: tuple[fj.RobotModel, Path]):
    model, _ = arm
    hidden, random = np.array([13.6, -8.7]), np.random.default_rng(6)
    given = Load(frame="b", mass=2.5, com=(0.1, -0.2, 0.3))
    terms = friction_terms(model, Baseline())
    base = States(model, list, terms).structural
    recordings = []
    for seed, carried in ((1, None), (2, given)):
        q, v, a, tau = _states(model, 40.0, seed, carried, random)
        recordings.append((q, v, a, tau / hidden, carried))
    found = drive_gains(model, terms, base, recordings)
    np.testing.assert_allclose(found.gains, hidden, rtol=0.01)
    truth = base.matrix @ np.concatenate([np.ravel(np.asarray(model.inertia)), DRIVES[:4]])
    error = found.parameters[base.independent] - truth
    assert np.linalg.norm(error) < 0.05 * np.linalg.norm(truth)
    with pytest.raises(InputError, match="no recording carries a known payload"):
        drive_gains(model, terms, base, recordings[:1])
