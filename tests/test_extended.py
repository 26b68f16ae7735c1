"""The extended model against Pinocchio, closed forms and the laws of energy: torques, sensors, motion that sticks."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import robots
from scipy import optimize, signal

from figaroh_jax.effects.base import place
from figaroh_jax.effects.catalogue import find
from figaroh_jax.effects.extended import ExtendedModel, extend, predict
from figaroh_jax.effects.simulation import Simulation, simulate
from figaroh_jax.errors import InputError
from figaroh_jax.rigid.model import RobotModel

CHAIN = robots.robot(
    *robots.LINKS[:4],
    robots.joint("turn", "base", "a", axis="0 1 0"),
    robots.joint("bend", "a", "b", axis="1 2 -1"),
    robots.joint("twist", "b", "c", axis="0 3 4"),
)
# a rod of 1 kg that turns about a level axis half a metre from its centre: inertia .3, gravity torque 4.905 sin q
PENDULUM = robots.robot(
    robots.link("base"),
    '<link name="rod"><inertial><mass value="1"/><origin xyz="0 0 -0.5"/>'
    '<inertia ixx="0.05" iyy="0.05" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>',
    robots.joint("hinge", "base", "rod", axis="0 1 0", xyz="0 0 0", rpy="0 0 0"),
)
INERTIA, GRAVITY = 0.3, 4.905
DT = 1e-3


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    return robots.load(CHAIN, tmp_path_factory.mktemp("chain"))


@pytest.fixture(scope="module")
def rod(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    return robots.load(PENDULUM, tmp_path_factory.mktemp("rod"))


def put(model: RobotModel | ExtendedModel, name: str, *at: str, **parameters: float) -> ExtendedModel:
    robot = model.robot if isinstance(model, ExtendedModel) else model
    return extend(model, place(find(name), robot, at, **parameters))


def furnished(chain: RobotModel) -> ExtendedModel:
    """One effect of each kind: the drive, the load, the robot itself, a pair, a gain of the total."""
    model = put(chain, "rotor_inertia", "turn", inertia=0.2)
    model = put(model, "viscous_friction", "bend", damping=0.7)
    model = put(model, "coulomb_friction", "turn", force=1.5)
    model = put(model, "load_dependent_friction", "bend", ratio=0.2)
    model = put(model, "coupled_transmission", "bend", "twist", inertia=0.01, damping=0.2, friction=0.4, sign=-1.0)
    model = put(model, "payload", "c", mass=0.5, mz=0.05, ixx=0.02, iyy=0.02, izz=0.01)
    model = put(model, "torque_gain", "twist", gain=0.1)
    return put(model, "torque_offset", "twist", offset=0.3)


def independent(chain: RobotModel, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Torque of `furnished` by Pinocchio and the equations written out; the gain scales what stands before it."""
    inertia = np.array(chain.inertia)
    inertia[2] += [0.5, 0, 0, 0.05, 0.02, 0, 0.02, 0, 0, 0.01]
    load = reference.inverse_dynamics(eqx.tree_at(lambda m: m.inertia, chain, inertia), q, v, a)
    tau = np.array(load)
    tau[:, 0] += 0.2 * a[:, 0] + 1.5 * np.sign(v[:, 0])
    tau[:, 1] += 0.7 * v[:, 1] + 0.2 * abs(load[:, 1]) * np.sign(v[:, 1])
    between = 0.4 * np.sign(v[:, 1] - v[:, 2])
    tau[:, 1] += -0.01 * a[:, 2] - 0.2 * v[:, 2] + between
    tau[:, 2] += -0.01 * a[:, 1] - 0.2 * v[:, 1] - between
    tau[:, 2] = 1.1 * tau[:, 2] + 0.3
    return tau


def test_inverse_dynamics_is_pinocchios_plus_the_equations(chain: RobotModel):
    q, v, a = robots.states(chain, 30)
    tau = furnished(chain).inverse_dynamics(q, v, a)
    np.testing.assert_allclose(tau, independent(chain, q, v, a), rtol=0, atol=1e-10)


def test_a_robot_without_effects_is_the_robot(chain: RobotModel):
    q, v, a = robots.states(chain, 10)
    tau = extend(chain).inverse_dynamics(q, v, a)
    np.testing.assert_allclose(tau, reference.inverse_dynamics(chain, q, v, a), rtol=0, atol=1e-10)


def test_forward_dynamics_inverts_inverse_dynamics(chain: RobotModel):
    model = furnished(chain)
    q, v, a = robots.states(chain, 30, seed=5)
    np.testing.assert_allclose(model.forward_dynamics(q, v, model.inverse_dynamics(q, v, a)), a, rtol=0, atol=1e-9)
    one = model.forward_dynamics(q[0], v[0], model.inverse_dynamics(q[0], v[0], a[0]))
    np.testing.assert_allclose(one, a[0], rtol=0, atol=1e-9)


def test_gradients_of_torque_and_acceleration_equal_finite_differences(rod: RobotModel):
    start = put(rod, "rotor_inertia", "hinge", inertia=0.2)
    start = put(start, "load_dependent_friction", "hinge", ratio=0.2)
    start = put(start, "torque_gain", "hinge", gain=0.1)
    start = put(start, "gravity_tilt", x=0.4)

    def where(model: ExtendedModel) -> list:
        e = model.effects
        return [e[0].inertia, e[1].ratio, e[2].gain, e[3].x]  # pyright: ignore[reportAttributeAccessIssue]

    @jax.jit
    def answers(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        def both(x: jax.Array) -> jax.Array:
            model, q, v, a = eqx.tree_at(where, start, list(x[:4])), x[4:5], x[5:6], x[6:]
            return jnp.concatenate([model.inverse_dynamics(q, v, a), model.forward_dynamics(q, v, 3 * a)])

        return both(x), jax.jacrev(both)(x)

    at = np.array([*(float(x) for x in where(start)), 0.8, 1.3, 2.1])
    jacobian = answers(at)[1]
    for k, step in enumerate(1e-6 * np.eye(len(at))):
        slope = (answers(at + step)[0] - answers(at - step)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, k], slope, rtol=1e-6, atol=1e-7)


def record(chain: RobotModel, dt: float = 0.002, samples: int = 1500) -> tuple[np.ndarray, ...]:
    """Smooth motion with its exact derivatives."""
    t = dt * np.arange(samples)[:, None]
    w, phase = np.array([1.1, 1.7, 2.3]), np.array([0.3, 1.0, 2.0])
    q = 0.8 * np.sin(w * t + phase)
    return t[:, 0], q, 0.8 * w * np.cos(w * t + phase), -(w**2) * q


def test_predicted_torque_without_sensor_effects_is_the_torque(chain: RobotModel):
    time, q, v, a = record(chain, samples=50)
    model = eqx.tree_at(lambda m: m.effects, furnished(chain), furnished(chain).effects[5:])
    torque = predict(model, time, q, v, a, 0.002)
    np.testing.assert_allclose(torque, model.inverse_dynamics(q, v, a), rtol=0, atol=1e-12)


def test_a_delay_by_whole_samples_shifts_the_torque(chain: RobotModel):
    time, q, v, a = record(chain)
    torque = np.asarray(extend(chain).inverse_dynamics(q, v, a))
    late = predict(put(chain, "torque_delay", delay=0.008), time, q, v, a, 0.002)
    np.testing.assert_allclose(late[4:], torque[:-4], rtol=0, atol=1e-9)


def test_a_lag_is_a_first_order_low_pass(chain: RobotModel):
    time, q, v, a = record(chain)
    torque = np.asarray(extend(chain).inverse_dynamics(q, v, a))
    seen = predict(put(chain, "torque_lag", time=0.01), time, q, v, a, 0.002)
    for joint in range(3):
        exact = signal.lsim(([1.0], [0.01, 1.0]), torque[:, joint], time, X0=[torque[0, joint] * 0.01])[1]
        np.testing.assert_allclose(seen[60:, joint], exact[60:], rtol=0, atol=2e-4)


def test_elasticity_explains_a_sensor_on_the_motor(chain: RobotModel):
    """The links move as recorded, the encoder on the motor reads more: predicted from its reading, the true torque."""
    time, q, v, a = record(chain)
    torque = np.asarray(reference.inverse_dynamics(chain, q, v, a))
    compliance, dt = 2e-3, 0.002
    read = np.array(q)
    read[:, 1] += compliance * torque[:, 1]
    rate = np.gradient(read, dt, axis=0, edge_order=2)
    twice = np.gradient(rate, dt, axis=0, edge_order=2)
    inner = slice(20, -20)
    rigid = predict(extend(chain), time, read, rate, twice, dt)[inner] - torque[inner]
    model = put(chain, "joint_elasticity", "bend", compliance=compliance)
    left = predict(model, time, read, rate, twice, dt)[inner] - torque[inner]
    # to second order in the compliance, since the load is that of the motion as read
    assert np.std(left) < 0.05 * np.std(rigid)


def coast(
    model: ExtendedModel, q: np.ndarray | jax.Array, v: np.ndarray, steps: int = 2000, dt: float = DT
) -> Simulation:
    return simulate(model, np.zeros((steps, model.robot.nv)), q, v, dt)


def test_energy_without_friction_is_kept_to_first_order_in_the_step(rod: RobotModel):
    def drift(dt: float) -> float:
        run = coast(extend(rod), np.array([1.0]), np.array([0.0]), 2000, dt)
        total = INERTIA * run.velocity[:, 0] ** 2 / 2 - GRAVITY * jnp.cos(run.position[:, 0])
        return float(jnp.max(jnp.abs(total - total[0])))

    coarse, fine = drift(2e-3), drift(1e-3)
    assert fine < 0.01 * GRAVITY
    assert coarse / fine == pytest.approx(2.0, rel=0.1)


def test_pendulum_follows_its_equation(rod: RobotModel):
    from scipy.integrate import solve_ivp

    run = coast(put(rod, "viscous_friction", "hinge", damping=0.1), np.array([1.0]), np.array([0.5]), 10_000, 1e-4)

    def motion(_: float, x: np.ndarray) -> list[float]:
        return [x[1], (-GRAVITY * np.sin(x[0]) - 0.1 * x[1]) / INERTIA]

    exact = solve_ivp(motion, (0, 1), [1.0, 0.5], t_eval=np.asarray(run.time), rtol=1e-10, atol=1e-10).y
    np.testing.assert_allclose(run.position[:, 0], exact[0], rtol=0, atol=5e-4)


def test_a_joint_sticks_where_friction_can_hold_it_and_slips_where_not(rod: RobotModel):
    model = put(rod, "coulomb_friction", "hinge", force=2.0)
    held = coast(model, np.array([0.4]), np.array([0.0]))  # gravity: 1.91 N m
    np.testing.assert_allclose(held.position, 0.4, rtol=0, atol=1e-9)
    falls = coast(model, np.array([0.43]), np.array([0.0]))  # 2.04 N m
    assert abs(falls.position[-1, 0] - 0.43) > 0.01


def test_friction_takes_the_energy_that_it_should_and_then_holds(rod: RobotModel):
    """Without gravity: the turn ends after J v^2 / 2F, at time J v / F, and nothing moves afterwards."""
    level = eqx.tree_at(lambda m: m.gravity, rod, np.zeros(3))
    run = coast(put(level, "coulomb_friction", "hinge", force=0.6), np.zeros(1), np.array([2.0]))
    travelled, ends = INERTIA * 2.0**2 / (2 * 0.6), INERTIA * 2.0 / 0.6
    np.testing.assert_allclose(run.position[-1], travelled, rtol=0, atol=2 * DT)
    moving = np.abs(run.velocity[:, 0]) > 1e-9
    assert run.time[np.flatnonzero(moving)[-1]] == pytest.approx(ends, abs=2 * DT)


def test_a_ramp_breaks_the_joint_away_at_the_level_of_friction(rod: RobotModel):
    level = eqx.tree_at(lambda m: m.gravity, rod, np.zeros(3))
    model = put(level, "coulomb_friction", "hinge", force=0.6)
    model = put(model, "asymmetric_coulomb_friction", "hinge", difference=0.2)
    model = put(model, "stribeck_friction", "hinge", force=0.5, speed=0.1)
    run = simulate(model, lambda t, q, v: jnp.array([1.0]) * t, np.zeros(1), np.zeros(1), DT, 2000)
    first = np.flatnonzero(np.abs(run.velocity[:, 0]) > 1e-7)[0]
    assert run.time[first] == pytest.approx(0.6 + 0.5 + 0.2, abs=3 * DT)


def test_a_motor_between_joints_holds_both(chain: RobotModel):
    """Dry friction of a coupling and of both of its joints: as redundant as can be, and all of them stick."""
    model = chain
    for joint in chain.joint_names:
        model = put(model, "coulomb_friction", joint, force=60.0)
    model = put(model, "coupled_transmission", "bend", "twist", inertia=0.01, damping=0.1, friction=5.0, sign=1.0)
    q = np.array([0.3, -0.2, 0.5])
    run = coast(model, q, np.zeros(3), 500)
    np.testing.assert_allclose(run.position, np.broadcast_to(q, (500, 3)), rtol=0, atol=1e-8)


def test_dry_friction_never_gives_energy(chain: RobotModel):
    level = eqx.tree_at(lambda m: m.gravity, chain, np.zeros(3))
    model = level
    for joint, force in zip(level.joint_names, (0.8, 0.3, 0.1), strict=True):
        model = put(model, "coulomb_friction", joint, force=force)
    model = put(model, "coupled_transmission", "bend", "twist", friction=0.2, sign=-1.0)
    run = coast(model, np.zeros(3), np.array([2.0, -3.0, 4.0]), 3000)
    masses = reference.mass_matrix(level, np.asarray(run.position))
    kinetic = np.einsum("ni,nij,nj->n", run.velocity, masses, run.velocity) / 2
    assert np.diff(kinetic).max() < 1e-6 * kinetic[0]
    assert np.abs(run.velocity[-1]).max() < 1e-8


def test_strong_damping_of_a_light_joint_does_not_blow_up(rod: RobotModel):
    run = coast(put(rod, "viscous_friction", "hinge", damping=1e4), np.array([1.0]), np.array([1.0]), 10_000)
    assert np.abs(run.velocity[2:]).max() < 0.01


def test_simulated_sensors_read_their_errors(chain: RobotModel):
    base = furnished(chain)
    model = put(put(base, "joint_elasticity", "bend", compliance=1e-3), "torque_delay", delay=5 * DT)
    q, v = np.array([0.5, -0.3, 0.2]), np.zeros(3)
    t = DT * np.arange(800)[:, None]
    command = 4.0 * np.sin(t * np.array([3.0, 5.0, 7.0])) * np.array([3.0, 1.0, 0.3])
    run, bare = (simulate(m, command, q, v, DT) for m in (model, base))
    np.testing.assert_allclose(run.position, bare.position, rtol=0, atol=1e-12)
    inertia = np.array(chain.inertia)
    inertia[2] += [0.5, 0, 0, 0.05, 0.02, 0, 0.02, 0, 0, 0.01]
    changed = eqx.tree_at(lambda m: m.inertia, chain, inertia)
    load = reference.inverse_dynamics(changed, *(np.asarray(x) for x in (run.position, run.velocity, run.acceleration)))
    np.testing.assert_allclose((run.position_read - run.position)[:, 1], 1e-3 * load[:, 1], rtol=0, atol=1e-10)
    np.testing.assert_allclose(run.torque_read[100:-100], command[95:-105], rtol=0, atol=1e-3)
    np.testing.assert_array_equal(run.torque, command)


def test_simulated_motion_satisfies_inverse_dynamics(chain: RobotModel):
    """A smooth motion of the full model: the torque that it needs is the torque that was commanded, to O(dt)."""
    model = furnished(chain)
    hold = np.tile([6.0, 3.0, 1.0], (800, 1))  # 60 of them are judged; of 800 there is a program

    def off(dt: float) -> float:
        run = simulate(model, hold, np.zeros(3), np.array([1.0, 0.6, -0.5]), dt)
        needed = model.inverse_dynamics(run.position[:60], run.velocity[:60], run.acceleration[:60])
        return float(jnp.abs(needed - run.torque[:60])[2:].max())

    coarse, fine = off(1e-3), off(2.5e-4)
    assert fine < 0.4 * coarse < 0.4


def test_gradient_of_a_simulation_equals_finite_differences(rod: RobotModel):
    start = put(put(rod, "viscous_friction", "hinge", damping=0.2), "coulomb_friction", "hinge", force=0.3)
    command = np.full((120, 1), 1.0)

    def end(values: list[np.ndarray]) -> jax.Array:
        model = eqx.tree_at(lambda m: [m.effects[0].damping, m.effects[1].force, m.robot.inertia], start, list(values))
        return simulate(model, command, np.zeros(1), np.array([1.0]), DT).position[-1, 0]

    at = [np.array(0.2), np.array(0.3), np.asarray(rod.inertia)]
    both = jax.jit(jax.value_and_grad(end))
    slopes = both(at)[1]
    step = 1e-5
    for k, shape in ((0, ()), (1, ()), (2, (0, 0)), (2, (0, 6))):
        low, high = ([np.array(x) for x in at] for _ in range(2))
        low[k][shape] -= step
        high[k][shape] += step
        difference = (both(high)[0] - both(low)[0]) / (2 * step)
        np.testing.assert_allclose(slopes[k][shape], difference, rtol=1e-6, atol=1e-9)


def test_simulations_map_over_starts(rod: RobotModel):
    model = put(rod, "coulomb_friction", "hinge", force=0.3)
    starts = np.array([[0.2], [0.9]])
    both = jax.vmap(lambda q: coast(model, q, np.zeros(1)).position)(jnp.asarray(starts))
    for run, start in zip(both, starts, strict=True):
        np.testing.assert_allclose(run, coast(model, start, np.zeros(1)).position, rtol=0, atol=1e-12)


def test_wrong_shapes_are_refused(chain: RobotModel):
    with pytest.raises(InputError, match="needs one number or 3"):
        extend(chain, width=np.zeros(2))
    with pytest.raises(InputError, match="5 samples or more"):
        predict(extend(chain), np.arange(3) * 0.1, np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), 0.1)
    with pytest.raises(InputError, match="number of steps"):
        simulate(extend(chain), lambda t, q, v: q, np.zeros(3), np.zeros(3), DT)
    with pytest.raises(InputError, match="last axis must hold the 3 joints"):
        simulate(extend(chain), np.zeros((5, 2)), np.zeros(2), np.zeros(2), DT)


def test_a_bristle_gives_way_until_it_holds(rod: RobotModel):
    """At rest a torque below the level bends the bristle by -distance log(1 - share): Dahl's curve, with gravity."""
    model = put(rod, "viscous_friction", "hinge", damping=12.0)
    model = put(model, "coulomb_friction", "hinge", force=2.0)
    model = put(model, "presliding", "hinge", force=2.0, distance=0.02)
    run = simulate(model, np.full((3000, 1), 1.2), np.zeros(1), np.zeros(1), DT)
    left = lambda q: GRAVITY * np.sin(q) + 2.0 * (1 - np.exp(-q / 0.02)) - 1.2  # noqa: E731
    held = cast(float, optimize.brentq(left, 0, 0.1))
    np.testing.assert_allclose(run.position[-1, 0], held, rtol=0, atol=2e-5)


def test_a_saturated_drive_gives_its_limit(rod: RobotModel):
    start, command = np.zeros(1), np.linspace(-4.0, 5.0, 2000)[:, None]
    run = simulate(put(rod, "torque_saturation", "hinge", share=1.0, limit=2.0), command, start, start, DT)
    bare = simulate(extend(rod), np.clip(command, -2.0, 2.0), start, start, DT)
    np.testing.assert_allclose(run.position, bare.position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.torque, np.clip(command, -2.0, 2.0), rtol=0, atol=1e-12)


def test_sensors_that_err_are_in_the_predicted_reading(rod: RobotModel):
    t, dt = np.arange(800) * 2e-3, 2e-3
    q, v, a = 0.8 * np.sin(3 * t), 2.4 * np.cos(3 * t), -7.2 * np.sin(3 * t)

    def reading(q: np.ndarray, a: np.ndarray) -> np.ndarray:
        return INERTIA * a + GRAVITY * np.sin(q)

    def predicted(name: str, **parameters: float) -> np.ndarray:
        model = put(rod, name, *(["hinge"] if find(name).acts_on == "joint" else []), **parameters)
        return np.asarray(predict(model, t, q[:, None], v[:, None], a[:, None], dt))[:, 0]

    inside = slice(10, -10)
    cases = {
        "encoder_offset": ({"offset": 0.05}, reading(q - 0.05, a)),
        "encoder_scale": ({"scale": 0.02}, reading(0.98 * q, 0.98 * a)),
        "torque_saturation": ({"share": 1.0, "limit": 1.5}, np.clip(reading(q, a), -1.5, 1.5)),
    }
    for name, (parameters, expected) in cases.items():
        np.testing.assert_allclose(predicted(name, **parameters)[inside], expected[inside], rtol=0, atol=1e-6)
    late = t * 1.02  # the torque is that of a time that runs ahead: in the end of one behind the record
    expected = reading(0.8 * np.sin(3 * late), -7.2 * np.sin(3 * late))
    np.testing.assert_allclose(predicted("clock_error", rate=0.02)[10:-30], expected[10:-30], rtol=0, atol=1e-5)


def test_double_precision_needs_no_setting_of_the_caller(chain: RobotModel, tmp_path: Path):
    q, v, a = robots.states(chain, 5)
    model = furnished(chain)
    with jax.enable_x64(False):
        tau = model.inverse_dynamics(q, v, a)
    assert tau.dtype == np.float64
    np.testing.assert_allclose(tau, independent(chain, q, v, a), rtol=0, atol=1e-10)
