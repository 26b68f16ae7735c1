"""The catalogue: the torque of every effect against its equation in NumPy and Pinocchio, and the forms of an effect."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import robots
from scipy.spatial.transform import Rotation

import figaroh_jax as fj
from figaroh_jax.effects.base import Effect, Motion, amplitude, columns, joint_unit, place, shape, smooth_sign
from figaroh_jax.effects.catalogue import CATALOGUE, find, register, related
from figaroh_jax.effects.environment import level_axes
from figaroh_jax.errors import InputError
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.rigid.model import RobotModel

# three joints, the last one prismatic
CHAIN = robots.robot(
    *robots.LINKS[:4],
    robots.joint("turn", "base", "a", axis="0 1 0"),
    robots.joint("bend", "a", "b", axis="1 2 -1"),
    robots.joint("slide", "b", "c", "prismatic", "0 3 4"),
)
WIDTH = np.array([0.0, 0.02, 0.01])
DT = 0.004
PARAMETERS = {  # of each effect, none of them a default
    "viscous_friction": {"damping": 2.0},
    "coulomb_friction": {"force": 3.0},
    "rotor_inertia": {"inertia": 0.4},
    "torque_offset": {"offset": -1.5},
    "coupled_transmission": {"inertia": 0.02, "damping": 0.6, "friction": 1.9, "sign": -1.0},
    "asymmetric_coulomb_friction": {"difference": 0.8},
    "asymmetric_viscous_friction": {"difference": 0.7},
    "stribeck_friction": {"force": 1.2, "speed": 0.3},
    "power_law_friction": {"strength": 0.9, "exponent": 1.7},
    "load_dependent_friction": {"ratio": 0.2},
    "position_dependent_friction": {"cosine": 0.5, "sine": -0.4},
    "torque_ripple": {"sine": 0.3, "cosine": 0.2, "order": 7.3},
    "joint_spring": {"stiffness": 4.0, "offset": 1.1},
    "gravity_tilt": {"x": 0.3, "y": -0.2},
    "link_inertia": {"mass": 0.2, "mx": 0.01, "my": -0.02, "mz": 0.03, "ixx": 0.004, "ixy": 1e-3, "iyy": 0.005}
    | {"ixz": -1e-3, "iyz": 2e-3, "izz": 0.006},
    "payload": {"mass": 0.3, "mx": 0.02, "my": 0.01, "mz": 0.06, "ixx": 0.02, "iyy": 0.02, "izz": 0.01},
    "torque_gain": {"gain": 0.07},
    "torque_delay": {"delay": 0.005},
    "torque_lag": {"time": 0.008},
    "joint_elasticity": {"compliance": 2e-4},
    "friction_drift": {"force": 1.1, "damping": 0.4, "time": 3.0},
    "presliding": {"force": 2.0, "distance": 0.02},
    "torque_saturation": {"share": 1.0, "limit": 1.7},
    "contact": {"stiffness": 300.0, "height": 0.4, "x": 0.1, "y": -0.2, "z": 0.3},
    "external_wrench": {"force_x": 7.0, "force_y": -5.0, "force_z": 4.0, "x": 0.1, "y": -0.2, "z": 0.3},
    "clock_error": {"rate": 2e-3},
    "encoder_offset": {"offset": 0.03},
    "encoder_scale": {"scale": -0.01},
    "encoder_eccentricity": {"sine": 0.004, "cosine": -0.003},
    "backlash": {"width": 2e-3},
}
AT = {"joint": ["bend"], "pair": ["turn", "bend"], "link": ["b"], "robot": []}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    return robots.load(CHAIN, tmp_path_factory.mktemp("chain"))


def moving(model: RobotModel, samples: int = 60) -> Motion:
    """Random states around rest, some of them inside the reversal of the friction."""
    rng = np.random.default_rng(3)
    q, v, a = rng.normal(size=(3, samples, model.nv))
    v[::5] *= 0.01
    load = np.asarray(reference.inverse_dynamics(model, q, v, a))
    total = load + rng.normal(size=load.shape)
    time, width = jnp.arange(samples) * DT, jnp.asarray(WIDTH)
    q, v, a, load, total = (jnp.asarray(x) for x in (q, v, a, load, total))
    return Motion(model, time, q, v, a, load, total, DT, width)


def made(name: str, model: RobotModel, **other: float) -> Effect:
    effect = find(name)
    return place(effect, model, AT[effect.acts_on], **(PARAMETERS[name] | other))


def sign(v: np.ndarray, a: np.ndarray, width: float = 0.02) -> np.ndarray:
    """The sign averaged over one sample, a straight line from -1 to 1 through the reversal."""
    return np.clip(v / (np.maximum(abs(a) * DT / 2, width) + 1e-9), -1, 1)


def rigid_change(motion: Motion, inertia: np.ndarray | float = 0.0, gravity: np.ndarray | float = 0.0) -> np.ndarray:
    """Pinocchio's torque with other link parameters or gravity, less that of the model."""
    model = motion.model
    new = np.asarray(model.inertia) + inertia, np.asarray(model.gravity) + gravity
    changed = eqx.tree_at(lambda m: (m.inertia, m.gravity), model, new)
    state = [np.asarray(x) for x in (motion.position, motion.velocity, motion.acceleration)]
    return reference.inverse_dynamics(changed, *state) - reference.inverse_dynamics(model, *state)


def added(effect: Effect, motion: Motion) -> jax.Array:
    """Torque that the effect adds to the drives', or to their reading."""
    return effect.torque_error(motion) if effect.has("torque_error") else effect.torque(motion)


def bristle(v: np.ndarray, distance: float) -> np.ndarray:
    """z' = (v / distance)(1 - z s(v)), each sample's velocity held over it, sliding at the first; by steps of Euler."""
    z, out, parts = np.sign(v[0]), [], 4000
    for k, speed in enumerate(v):
        for _ in range(parts if k else 0):
            z += DT / parts * speed / distance * (1 - z * np.sign(speed))
        out.append(z)
    return np.array(out)


def pressed(motion: Motion, p: dict[str, float], force: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """-J'f of a force at a point of link `b`, the Jacobian by differences of Pinocchio's poses."""
    offset, q = np.array([p["x"], p["y"], p["z"], 1.0]), np.asarray(motion.position)

    def point(q: np.ndarray) -> np.ndarray:
        return (reference.forward_kinematics(motion.model, q)[:, 1] @ offset)[:, :3]

    steps = 1e-6 * np.eye(3)
    jacobian = np.stack([(point(q + step) - point(q - step)) / 2e-6 for step in steps], axis=1)
    return -np.einsum("sjc,sc->sj", jacobian, force(point(q)))


def expected(name: str, motion: Motion, p: dict[str, float]) -> np.ndarray:
    """Added torque by the equations of the design, section 2.1, at joint `bend` (pair: `turn`, `bend`; link: `b`)."""
    qs, vs, accelerations, load, total = (
        np.asarray(x) for x in (motion.position, motion.velocity, motion.acceleration, motion.load, motion.total)
    )
    q, v, a = qs[:, 1], vs[:, 1], accelerations[:, 1]
    s = sign(v, a)
    if name == "coupled_transmission":
        u, ua = vs[:, 0] - vs[:, 1], accelerations[:, 0] - accelerations[:, 1]
        between = p["friction"] * sign(u, ua, 0.01)
        first = -p["inertia"] * a - p["damping"] * v + between
        second = -p["inertia"] * accelerations[:, 0] - p["damping"] * vs[:, 0] - between
        return np.stack([first, second], axis=1)
    if name in ("link_inertia", "payload"):
        order = ("mass", "mx", "my", "mz", "ixx", "ixy", "iyy", "ixz", "iyz", "izz")
        inertia = np.zeros((3, 10))
        inertia[1] = [p.get(key, 0.0) for key in order]
        return rigid_change(motion, inertia=inertia)
    if name == "external_wrench":
        constant = np.array([p["force_x"], p["force_y"], p["force_z"]])
        return pressed(motion, p, lambda at: np.tile(constant, (len(at), 1)))
    if name == "contact":
        up = np.array([0.0, 0.0, p["stiffness"]])
        return pressed(motion, p, lambda at: np.maximum(p["height"] - at[:, 2:], 0) * up)
    if name == "clock_error":
        rate = np.zeros_like(total)
        rate[2:-2] = (8 * (total[3:-1] - total[1:-3]) - (total[4:] - total[:-4])) / (12 * DT)
        return p["rate"] * np.arange(len(total))[:, None] * DT * rate
    if name == "gravity_tilt":
        return rigid_change(motion, gravity=np.array([p["x"], p["y"], 0.0]))
    equations: dict[str, Callable[[], np.ndarray]] = {
        "viscous_friction": lambda: p["damping"] * v,
        "coulomb_friction": lambda: p["force"] * s,
        "rotor_inertia": lambda: p["inertia"] * a,
        "torque_offset": lambda: np.full(len(v), p["offset"]),
        "asymmetric_coulomb_friction": lambda: p["difference"] * abs(s),
        "asymmetric_viscous_friction": lambda: p["difference"] * abs(v),
        "stribeck_friction": lambda: p["force"] * np.exp(-((abs(v) / p["speed"]) ** 2)) * s,
        "power_law_friction": lambda: p["strength"] * abs(v) ** p["exponent"] * s,
        "load_dependent_friction": lambda: p["ratio"] * abs(load[:, 1]) * s,
        "position_dependent_friction": lambda: s * (p["cosine"] * np.cos(q) + p["sine"] * np.sin(q)),
        "torque_ripple": lambda: p["sine"] * np.sin(p["order"] * q) + p["cosine"] * np.cos(p["order"] * q),
        "joint_spring": lambda: p["stiffness"] * (q + p["offset"] / p["stiffness"]),
        "torque_gain": lambda: p["gain"] * total[:, 1],
        "friction_drift": lambda: (p["force"] * s + p["damping"] * v) * np.exp(-np.arange(len(v)) * DT / p["time"]),
        "presliding": lambda: p["force"] * (bristle(v, p["distance"]) - s),
        "torque_saturation": lambda: np.clip(total[:, 1], -p["limit"], p["limit"]) - total[:, 1],
    }
    return equations[name]()


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (0.3, -0.7, -0.5), None])
def test_a_base_tilts_about_two_axes_across_gravity_wherever_it_is_mounted(up: tuple[float, ...] | None) -> None:
    """Upright, hanging, on a wall and at any angle: the smallest turn (SciPy) takes z up and x, y across."""
    way = np.random.default_rng().normal(size=3) if up is None else np.array(up)
    way /= np.linalg.norm(way)
    axis, angle = np.cross([0.0, 0.0, 1.0], way), np.arccos(way[2])
    if np.linalg.norm(axis) < 1e-12:  # all turns by pi are as small: about x
        axis = np.array([1.0, 0.0, 0.0])
    turn = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix()
    np.testing.assert_allclose(level_axes(-9.81 * way), turn[:, :2], rtol=0, atol=1e-12)
    # how x and y turn has no limit towards straight down: the nearer, the more of the rounding of `way` shows
    rounding = 1e-5 + 1e-6 / (1.0 + way[2] if way[2] > -1.0 else 1.0)
    np.testing.assert_allclose(level_axes((-9.81 * way).astype(np.float32)), turn[:, :2], rtol=0, atol=rounding)
    model = eqx.tree_at(lambda m: m.gravity, load_urdf(fj.DEMO), jnp.asarray(-9.81 * way))
    told = find("gravity_tilt")(np.zeros(0, int), **{"x": 0.05, "y": -0.03})
    tilted = np.asarray(told.change(model).gravity)
    angles = told.physical()
    lean = Rotation.from_rotvec(turn[:, 0] * angles["about_x"] + turn[:, 1] * angles["about_y"]).as_matrix()
    np.testing.assert_allclose(tilted, lean.T @ np.asarray(model.gravity), rtol=0, atol=2e-4)  # second order


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0, 0.0, -9.81)])
def test_axes_of_a_tilt_have_gradients_without_gravity_and_under_a_ceiling(gravity: tuple[float, ...]) -> None:
    slopes = [jax.jit(way(level_axes))(jnp.asarray(gravity)) for way in (jax.jacfwd, jax.jacrev)]
    assert all(bool(jnp.isfinite(slope).all()) for slope in slopes)
    np.testing.assert_allclose(level_axes(np.zeros(3)), np.eye(3)[:, :2], rtol=0, atol=0)


TORQUES = [n for n, e in CATALOGUE.items() if e.has("torque") or e.has("change") or e.has("torque_error")]
READ = [name for name in TORQUES if CATALOGUE[name].has("torque_error")]
SENSORS = [name for name in PARAMETERS if name not in TORQUES]


def test_every_effect_of_the_catalogue_is_tested_here():
    assert set(PARAMETERS) == set(CATALOGUE)
    assert len(CATALOGUE) >= 16


@pytest.mark.parametrize("name", TORQUES)
def test_torque_equals_the_equation(name: str, model: RobotModel):
    motion, effect = moving(model), made(name, model)
    # |v| is rounded off below 1e-6 in the power law, so that its slope stays finite at rest
    tolerance = {"power_law_friction": 1e-9, "presliding": 1e-3, "contact": 1e-6, "external_wrench": 1e-7}.get(
        name, 1e-12
    )
    torque = expected(name, motion, PARAMETERS[name])
    np.testing.assert_allclose(added(effect, motion), torque, rtol=0, atol=tolerance)
    if name in READ:
        np.testing.assert_array_equal(effect.joint_torque(motion), 0.0)
        return
    joints = np.zeros((60, 3))
    columns = {"joint": [1], "pair": [0, 1]}.get(effect.acts_on, [0, 1, 2])
    joints[:, columns] = torque.reshape(60, -1)
    np.testing.assert_allclose(effect.joint_torque(motion), joints, rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", TORQUES)
def test_columns_are_the_torque_of_a_unit_of_each_amplitude(name: str, model: RobotModel):
    motion, effect = moving(model), made(name, model)
    linear = effect.amplitudes()
    found = columns(effect, motion)
    assert found.shape[0] == len(linear)
    for key, column in zip(linear, found, strict=True):
        alone = dict.fromkeys(linear, 0.0) | {key: 1.0}
        np.testing.assert_allclose(column, added(made(name, model, **alone), motion), rtol=0, atol=1e-9)
    amplitudes = np.array([PARAMETERS[name].get(key, 0.0) for key in linear])
    np.testing.assert_allclose(np.tensordot(amplitudes, found, 1), added(effect, motion), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", [name for name, effect in CATALOGUE.items() if not effect.reverses])
def test_what_reverses_with_no_friction_has_the_same_torque_over_any_width(name: str, model: RobotModel):
    motion, effect = moving(model), made(name, model)
    wider = eqx.tree_at(lambda m: m.width, motion, motion.width + 0.3)
    np.testing.assert_array_equal(added(effect, motion), added(effect, wider))


@pytest.mark.parametrize("name", TORQUES)
def test_gradient_equals_finite_differences_in_every_parameter(name: str, model: RobotModel):
    motion, effect = moving(model), made(name, model)
    continuous = [key for key, parameter in effect.parameters().items() if not parameter.choice]
    weight = jnp.cos(jnp.arange(added(effect, motion).size) + 0.5)

    def work(values: jax.Array) -> jax.Array:
        changed = eqx.tree_at(lambda e: [getattr(e, key) for key in continuous], effect, list(values))
        return weight @ added(changed, motion).ravel()

    work = jax.jit(work)
    at = np.array([float(getattr(effect, key)) for key in continuous])
    step = 1e-5
    slopes = [float(work(at + step * e) - work(at - step * e)) / (2 * step) for e in np.eye(len(at))]
    np.testing.assert_allclose(jax.jit(jax.grad(work))(at), slopes, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", [name for name in TORQUES if CATALOGUE[name].acts_on in ("joint", "link")])
def test_places_and_parameters_map_in_one_call(name: str, model: RobotModel):
    motion, effect = moving(model), made(name, model)
    many = eqx.tree_at(lambda e: e.at, effect, np.arange(3)[:, None])
    axes = eqx.tree_at(lambda e: e.at, jax.tree.map(lambda _: None, effect), 0, is_leaf=lambda x: x is None)
    torques = jax.vmap(lambda e: e.joint_torque(motion), in_axes=(axes,))(many)
    for joint in range(3):
        one = eqx.tree_at(lambda e: e.at, effect, np.array([joint]))
        np.testing.assert_allclose(torques[joint], one.joint_torque(motion), rtol=0, atol=1e-12)


def test_gradients_stay_finite_at_rest(model: RobotModel):
    motion = moving(model)
    still = eqx.tree_at(lambda m: (m.velocity, m.acceleration), motion, (jnp.zeros((60, 3)), jnp.zeros((60, 3))))
    effects = {name: made(name, model) for name in TORQUES}
    slopes = jax.jit(jax.grad(lambda all_: sum(added(e, still).sum() for e in all_.values()), allow_int=True))(effects)
    for name, effect in effects.items():
        values = [float(getattr(slopes[name], key)) for key in effect.parameters()]
        assert np.isfinite(values).all(), name


def test_elasticity_winds_up_with_the_load(model: RobotModel):
    motion = moving(model)
    error = made("joint_elasticity", model).position_error(motion)
    np.testing.assert_allclose(error, 2e-4 * np.asarray(motion.load)[:, 1], rtol=0, atol=1e-15)


def test_encoders_and_play_read_their_errors(model: RobotModel):
    motion = moving(model)
    q, load = np.asarray(motion.position)[:, 1], np.asarray(motion.load)[:, 1]
    errors = {
        "encoder_offset": np.full(60, 0.03),
        "encoder_scale": -0.01 * q,
        "encoder_eccentricity": 0.004 * np.sin(q) - 0.003 * np.cos(q),
    }
    for name, error in errors.items():
        np.testing.assert_allclose(made(name, model).position_error(motion), error, rtol=0, atol=1e-15)
    side = np.asarray(made("backlash", model).position_error(motion)) / 1e-3
    rate = np.zeros(60)
    rate[2:-2] = (8 * (load[3:-1] - load[1:-3]) - (load[4:] - load[:-4])) / (12 * DT)
    crossed = abs(load) > abs(rate) * 0.005  # on one side of the play for the whole 10 ms that it takes to cross it
    np.testing.assert_allclose(side[crossed], np.sign(load)[crossed], rtol=0, atol=1e-9)
    assert np.all(abs(side) <= 1) and 5 < crossed.sum() < 60


def test_states_and_clocks_begin_anew_with_each_recording(model: RobotModel):
    """Two recordings one after another in a record give what each of them gives alone."""
    motion, half = moving(model), slice(0, 30)
    twice = eqx.tree_at(lambda m: m.time, motion, jnp.tile(motion.time[half], 2))
    alone = [
        jax.tree.map(lambda x, i=i: x[i] if np.ndim(x) and len(x) == 60 else x, motion) for i in (half, slice(30, 60))
    ]
    alone = [eqx.tree_at(lambda m: m.time, one, motion.time[half]) for one in alone]
    for name in ("presliding", "clock_error", "friction_drift"):
        effect, torque = made(name, model), eqx.filter_jit(added)
        parts = [torque(effect, one) for one in alone]
        np.testing.assert_allclose(torque(effect, twice), jnp.concatenate(parts), rtol=0, atol=1e-12)


def test_a_bristle_takes_the_steps_of_a_simulation_as_it_follows_a_record(model: RobotModel):
    effect = made("presliding", model)
    motion = moving(model)
    z = np.asarray(effect.torque(motion)) / 2.0 + np.asarray(motion.direction)[:, 1]
    here = eqx.tree_at(lambda e: e.memory, effect, jnp.asarray(z[0]), is_leaf=lambda x: x is None)
    for k in range(1, 20):
        here = here.step(motion.velocity[k], DT)
        np.testing.assert_allclose(here.memory, z[k], rtol=0, atol=1e-12)


def test_what_the_ladder_of_load_friction_adds(model: RobotModel):
    motion = moving(model)
    v, a, load = (np.asarray(x)[:, 1] for x in (motion.velocity, motion.acceleration, motion.load))
    s = sign(v, a)
    both = place(find("directional_load_friction"), model, ["bend"], driving=0.2, driven=0.2)
    np.testing.assert_allclose(both.torque(motion), 0.2 * abs(load) * s, rtol=0, atol=1e-12)
    one = place(find("directional_load_friction"), model, ["bend"], driving=0.2, driven=0.05)
    clear = abs(s) == 1
    share = np.where(load * v > 0, 0.2, 0.05)
    np.testing.assert_allclose(
        np.asarray(one.torque(motion))[clear], (share * abs(load) * s)[clear], rtol=0, atol=1e-12
    )
    slow = place(find("load_dependent_stribeck_friction"), model, ["bend"], ratio=0.3, speed=0.2)
    np.testing.assert_allclose(slow.torque(motion), 0.3 * abs(load) * np.exp(-((v / 0.2) ** 2)) * s, rtol=0, atol=1e-12)
    lugre = place(find("lugre_friction"), model, ["bend"], force=2.0, distance=1e-5, rise=0.5, speed=0.2)
    sliding = abs(v) > 0.1  # a bristle of no length slides at once: Stribeck's curve
    level = 2.0 * (1 + 0.5 * np.exp(-((v / 0.2) ** 2))) * np.sign(v) - 2.0 * s
    np.testing.assert_allclose(np.asarray(lugre.torque(motion))[sliding][1:], level[sliding][1:], rtol=0, atol=1e-6)


def test_delay_and_lag_respond_as_their_transfer_functions(model: RobotModel):
    omega = np.linspace(0.0, 300.0, 40)
    delay = made("torque_delay", model).torque_response(jnp.asarray(omega))
    np.testing.assert_allclose(abs(delay), 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.unwrap(np.angle(delay)), -0.005 * omega, rtol=0, atol=1e-12)
    lag = made("torque_lag", model).torque_response(jnp.asarray(omega))
    np.testing.assert_allclose(abs(lag), 1 / np.hypot(1, 0.008 * omega), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.angle(lag), -np.arctan(0.008 * omega), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", SENSORS)
def test_sensor_effects_add_no_torque(name: str, model: RobotModel):
    assert not made(name, model).has("torque")
    np.testing.assert_array_equal(made(name, model).joint_torque(moving(model)), 0.0)


def test_sign_is_the_mean_of_the_sign_over_one_sample():
    """A joint that reverses at constant acceleration: the mean over the sample from -dt/2 to dt/2."""
    v, a = 0.003, 4.0
    inside = v + a * np.linspace(-DT / 2, DT / 2, 200_001)
    np.testing.assert_allclose(
        smooth_sign(jnp.array([v]), jnp.array([a]), DT)[0], np.sign(inside).mean(), rtol=0, atol=1e-5
    )


def test_the_sign_of_smooth_friction_has_the_wider_of_its_two_ramps():
    v = jnp.array([0.004, 0.004])
    np.testing.assert_allclose(smooth_sign(v, jnp.array([0.1, 4.0]), DT, 0.02)[0], 0.2, rtol=0, atol=1e-6)
    wide = 4.0 * 0.02 / 2
    np.testing.assert_allclose(smooth_sign(v, jnp.array([0.1, 4.0]), 0.02, 0.01)[1], 0.004 / wide, rtol=0, atol=1e-6)


def test_a_ripple_is_shown_by_a_motion_over_more_than_a_turn_of_it(model: RobotModel):
    ripple = made("torque_ripple", model)
    low, high = np.full(model.nv, -0.5), np.full(model.nv, 0.5)
    assert not ripple.shown_by(low, high * 2 * np.pi / float(ripple.order))
    assert ripple.shown_by(low * 2 * np.pi * 4 / float(ripple.order), high * 2 * np.pi * 4 / float(ripple.order))
    slowest = eqx.tree_at(lambda e: e.order, ripple, type(ripple).parameters()["order"].lower)
    assert not slowest.shown_by(10 * low, 10 * high)  # over four turns of it: a slower one would do better


@pytest.mark.parametrize("name", PARAMETERS)
def test_every_effect_says_what_it_is(name: str, model: RobotModel):
    effect = made(name, model)
    assert effect.title and effect.equation
    assert set(effect.units()) == set(effect.physical())
    for parameter in effect.parameters().values():
        assert parameter.linear or (parameter.grid and parameter.lower <= min(parameter.grid) <= parameter.upper)


def test_units_follow_the_kind_of_the_joint():
    assert joint_unit("N m s/rad", prismatic=False) == "N m s/rad"
    assert joint_unit("N m s/rad", prismatic=True) == "N s/m"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: find("stribek_friction"), "did you mean 'stribeck_friction'"),
        (lambda m: place(find("viscous_friction"), m, ["bent"]), "did you mean 'bend'"),
        (lambda m: place(find("coupled_transmission"), m, ["turn"]), "takes 2 names"),
        (lambda m: place(find("viscous_friction"), m, ["turn"], damp=1.0), "has no parameter 'damp'"),
        (lambda m: made("torque_delay", m).position_error(moving(m)), "no form at the position sensor"),
    ],
)
def test_wrong_names_are_refused_with_the_nearest(call: Callable, message: str, model: RobotModel):
    with pytest.raises((InputError, NotImplementedError), match=message):
        call(model)


def test_a_registered_effect_is_found_and_a_taken_name_refused(model: RobotModel):
    class Magnet(Effect):
        """A magnet that pulls towards a position."""

        name, title, equation, acts_on = "magnet", "a magnet", "pull sin(q - home)", "joint"
        pull: jax.Array | np.ndarray | float = amplitude("N m")
        home: jax.Array | np.ndarray | float = shape("rad", (0.0, 1.0, 2.0))

        def torque(self, motion: Motion) -> jax.Array:
            return jnp.asarray(self.pull * jnp.sin(self.here(motion.position) - self.home))

    register(Magnet)
    magnet = place(find("magnet"), model, ["turn"], pull=2.0, home=0.5)
    motion = moving(model)
    torque = 2.0 * np.sin(np.asarray(motion.position)[:, 0] - 0.5)
    np.testing.assert_allclose(magnet.torque(motion), torque, rtol=0, atol=1e-14)

    class Other(Magnet):
        name = "magnet"

    with pytest.raises(InputError, match="registered already"):
        register(Other)


def test_relations_hold_both_ways_whichever_class_states_them():
    assert related("torque_lag", "excludes") == ("torque_delay",)  # stated by the delay
    assert related("torque_delay", "excludes") == ("torque_lag",)
    assert related("torque_offset", "indistinguishable_from") == ("asymmetric_coulomb_friction",)
    assert related("payload", "indistinguishable_from") == ("link_inertia",)
    assert related("torque_ripple", "excludes") == ()
    for effect in CATALOGUE.values():
        for relation in ("contains", "resembles", "indistinguishable_from", "excludes"):
            assert all(find(name) for name in getattr(effect, relation))


def test_an_effect_of_ones_own_states_its_relations_and_its_sign():
    class Seal(Effect):
        """Dry friction of a seal that wears in."""

        name, title, equation, acts_on = "seal", "a seal", "force s(v) exp(-|v|)", "joint"
        dissipative = speed_law = True
        excludes = ("stribeck_friction",)
        indistinguishable_from = ("power_law_friction", "of another package")
        force: jax.Array | np.ndarray | float = amplitude("N m")

    assert related("stribeck_friction", "excludes") == ()
    register(Seal)
    assert related("stribeck_friction", "excludes") == ("seal",)
    assert related("seal", "indistinguishable_from") == ("power_law_friction",)
    assert Seal.parameters()["force"].lower == 0.0


@pytest.mark.parametrize(
    "name", ["viscous_friction", "coulomb_friction", "stribeck_friction", "load_dependent_friction"]
)
def test_what_physics_forbids_lies_outside_the_bounds(name: str):
    assert all(p.lower == 0.0 for p in find(name).parameters().values() if p.linear)
    bounds = {"torque_delay": "delay", "torque_lag": "time", "joint_elasticity": "compliance"}
    assert all(find(effect).parameters()[p].lower >= 0.0 for effect, p in bounds.items())
    assert find("rotor_inertia").parameters()["inertia"].lower == 0.0
    assert find("joint_spring").parameters()["stiffness"].lower == 0.0


def test_a_recorded_robot_takes_effects_at_its_names(data_dir: Path):
    tx40 = load_urdf(data_dir / robots.REAL["tx40"])
    pair = place(find("coupled_transmission"), tx40, ["joint_5", "joint_6"], friction=1.0)
    np.testing.assert_array_equal(pair.at, [4, 5])


def test_a_law_of_ones_own_says_which_one_contains_it():
    outer = fj.CATALOGUE["power_law_friction"]
    before = outer.contains
    try:

        @fj.register
        class Churning(fj.JointEffect):
            name, title, equation = "oil_churning", "losses of churned oil", "drag v |v|"
            contained_in = ("power_law_friction",)
            drag: float = fj.amplitude("N m s2/rad2")

        assert fj.register(Churning) is Churning  # once more adds nothing
        assert outer.contains == (*before, "oil_churning")
    finally:
        outer.contains = before
        fj.CATALOGUE.pop("oil_churning", None)


def test_a_name_that_the_catalogue_lacks_is_a_key_error_with_the_nearest():
    with pytest.raises(InputError, match="^no effect 'stribek' in the catalogue; did you mean 'stribeck_friction'"):
        CATALOGUE["stribek"]
    with pytest.raises(KeyError):
        CATALOGUE["stribek"]
    assert "stribek" not in CATALOGUE and CATALOGUE.get("stribek") is None
