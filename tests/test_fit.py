"""One fit: hidden truths come back, solvers agree, derivatives are those of refits, failures are results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import figaroh_jax as fj
from figaroh_jax.estimation.free import chosen_of

T = np.arange(1500)[:, None] / 250.0
RATES = 2 * np.pi * np.array([0.5, 0.7, 0.9, 1.1])
Q, V, A = (0.6 * RATES**k * np.sin(RATES * T + np.arange(4) + k * np.pi / 2) for k in range(3))
OFFSET = np.array([0.0, 0.02, -0.03, 0.0])
JOINTS = {"joint_offset": ["shoulder", "elbow"]}


@pytest.fixture(scope="module")
def robot() -> fj.RobotModel:
    return fj.load_urdf(fj.DEMO)


def place(robot: fj.RobotModel, name: str, joint: str, **parameters: float) -> fj.Effect:
    return fj.place(fj.CATALOGUE[name], robot, [joint], **parameters)


@pytest.fixture(scope="module")
def tracked(robot: fj.RobotModel) -> tuple[fj.PoseData, ...]:
    """Points that a tracker saw, with noise, while two joints are zeroed wrongly."""
    rng = np.random.default_rng(0)
    q, hand = rng.uniform(-1.2, 1.2, (30, 4)), robot.link_names[-1]
    seen = np.array(fj.frame_placement(robot, q + OFFSET, hand)) @ np.array([0.02, 0.01, 0.05, 1.0])
    points = seen[:, :3] + 1e-5 * rng.normal(size=(30, 3)) + [0.4, -0.2, 0.1]
    return fj.pose_data(robot, fj.postures(q=q, position=points, base_frame="base", tool_frame=hand))


@pytest.fixture(scope="module")
def block(robot: fj.RobotModel, tracked: tuple[fj.PoseData, ...]) -> fj.Fit:
    """The offsets of two joints and the device's frames, by the solver that `fit` takes unless told otherwise."""
    return fj.fit(robot, tracked, {**JOINTS, "frames": True})


def test_both_solvers_find_hidden_offsets_and_agree(
    robot: fj.RobotModel, tracked: tuple[fj.PoseData, ...], block: fj.Fit
):
    free = {**JOINTS, "frames": True}
    own = fj.fit(robot, tracked, free, solver=optimistix.LevenbergMarquardt(rtol=1e-10, atol=1e-10))
    for found in (block, own):
        assert found.result == optimistix.RESULTS.successful
        for joint, truth in (("shoulder", 0.02), ("elbow", -0.03)):
            value, std, unit = found.parameters[f"joint_offset {joint}"]
            assert abs(value - truth) < 4 * std < 2e-4 and unit == "rad"
    np.testing.assert_allclose(own.cost, block.cost, rtol=1e-8, atol=0)
    np.testing.assert_allclose(own.values, block.values, rtol=0, atol=1e-8)
    np.testing.assert_allclose(own.std, block.std, rtol=1e-5, atol=0)
    # the fitted model and devices predict what the solver said
    np.testing.assert_allclose(fj.residual(own.model, own.data), own.rows, rtol=0, atol=1e-12)


def test_derivatives_of_a_fit_are_those_of_refits(robot: fj.RobotModel):
    model = fj.extend(robot, place(robot, "viscous_friction", "elbow"), place(robot, "coulomb_friction", "elbow"))
    torque = np.asarray(
        fj.extend(robot, place(robot, "viscous_friction", "elbow", damping=2.0)).inverse_dynamics(Q, V, A)
    )
    data = fj.torque_data(model, fj.recording(q=Q, tau=torque, rate=250), fj.Preprocess(cutoff=10, rate=20))

    @jax.jit
    def damping(scale: jax.Array) -> jax.Array:
        measured = eqx.tree_at(lambda d: d.torque, data, data.torque * scale)
        return fj.fit(model, measured, "friction").values[0]

    h = 1e-3
    np.testing.assert_allclose(damping(1.0), 2.0, rtol=0, atol=5e-2)
    slope, difference = jax.jit(jax.grad(damping))(1.0), (damping(1 + h) - damping(1 - h)) / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-6, atol=0)


def test_what_is_not_determined_has_no_size_and_a_failure_is_a_result(
    robot: fj.RobotModel, tracked: tuple[fj.PoseData, ...]
):
    last = robot.joint_names[-1]
    found = fj.fit(robot, tracked, {"joint_offset": [last, "elbow"], "frames": True})
    assert np.isinf(found.parameters[f"joint_offset {last}"].std) or int(found.rank) == len(found.values)
    stopped = fj.fit(robot, tracked, {**JOINTS, "frames": True}, max_steps=1)
    assert stopped.result == optimistix.RESULTS.nonlinear_max_steps_reached


def test_limits_hold_and_a_prior_pulls(robot: fj.RobotModel, tracked: tuple[fj.PoseData, ...], block: fj.Fit):
    free = {"joint_offset": ["shoulder", "elbow"], "frames": True}
    bounded = fj.fit(robot, tracked, free, bounds={"joint_offset elbow": (-0.02, 0.02)})
    assert bounded.parameters["joint_offset elbow"].value == pytest.approx(-0.02, abs=1e-9)
    assert bounded.result == optimistix.RESULTS.successful
    data = tuple(eqx.tree_at(lambda d: d.weight, one, one.weight / 1e-5) for one in tracked)
    pulled = fj.fit(robot, data, free, prior={"joint_offset": 1e-9})
    assert abs(pulled.parameters["joint_offset elbow"].value) < 1e-3 < abs(block.parameters["joint_offset elbow"].value)


@pytest.mark.parametrize(
    ("free", "message"),
    [
        ("joint_offsets", "'joint_offsets' — did you mean|nothing is called 'joint_offsets'"),
        ({"joint_offset": ["knee"]}, "none at"),
        ({"joint_offset": ["elbow", "wrst"]}, "joint_offset: none at 'wrst'; did you mean 'wrist'"),
        ({"joint_offset": False}, "joint_offset is False; True is expected, or its places"),
        ("friction", "the model and the data have none"),
        ({"friction": ["elbow"]}, "the model and the data have none; give the model some: extend"),
        ((), "nothing is named"),
    ],
)
def test_what_is_not_there_cannot_be_free(free, message: str, robot: fj.RobotModel, tracked: tuple[fj.PoseData, ...]):
    with pytest.raises(fj.InputError, match=message):
        fj.fit(robot, tracked, free)


def test_names_with_spaces_are_places_as_a_whole(tmp_path: Path):
    text = Path(fj.DEMO).read_text()
    for old, new in (("elbow", "axis 5"), ("wrist", "axis"), ("shoulder", "5")):
        text = text.replace(f'name="{old}"', f'name="{new}"')
    (tmp_path / "robot.urdf").write_text(text)
    robot = fj.load_urdf(tmp_path / "robot.urdf")
    model = fj.extend(robot, *(place(robot, "viscous_friction", name) for name in ("5", "axis", "axis 5")))
    for kind in ("joint_offset", "friction"):
        for name in ("5", "axis", "axis 5"):
            (found,) = chosen_of(model, (), {kind: name}).names
            assert found.split(maxsplit=1)[1].removesuffix(" damping") == name
        assert len(chosen_of(model, (), {kind: ["axis 5", "5"]}).names) == 2
    assert chosen_of(model, (), {"friction": "damping axis 5"}).names == ("viscous_friction axis 5 damping",)
    assert chosen_of(model, (), {"inertia": f"inertia {robot.link_names[0]} mx"}).names[0].endswith(" mx")


def test_everything_can_be_free_at_once(robot: fj.RobotModel, tracked: tuple[fj.PoseData, ...]):
    """The derivative of the rows by each number is that of the model that `free` makes of it."""
    from figaroh_jax.estimation.free import apply, chosen_of

    model = fj.extend(robot, place(robot, "stribeck_friction", "elbow", force=1.0, speed=0.2))
    kinds = ("inertia", "effects", "joint_offset", "link_geometry", "frames", "tool_frame", "base", "gravity")
    chosen = chosen_of(model, tracked, kinds)
    counts = {kind: sum(len(p.index) for p in chosen.parts if p.kind == kind) for kind in kinds}
    assert counts == {
        "inertia": 40,
        "effects": 0,
        "joint_offset": 4,
        "link_geometry": 24,
        "frames": 9,
        "tool_frame": 6 * len(robot.frames),
        "base": 6,
        "gravity": 3,
    }
    y = 0.01 * np.random.default_rng(1).normal(size=len(chosen.names))
    moved, devices = apply(chosen, model, tracked, jnp.asarray(y))
    at = {name: k for k, name in enumerate(chosen.names)}
    assert float(moved.effects[0].speed) == pytest.approx(0.2 + y[at["stribeck_friction elbow speed"]], abs=1e-15)
    assert float(moved.robot.inertia[2, 1]) == pytest.approx(
        float(robot.inertia[2, 1]) + y[at[f"inertia {robot.link_names[2]} mx"]], abs=1e-15
    )
    told = dict(zip(chosen.names, chosen.held(moved, y), strict=True))  # what `Fit.parameters` says
    assert told["stribeck_friction elbow force"] == float(moved.effects[0].force)
    assert told[f"inertia {robot.link_names[2]} mx"] == float(moved.robot.inertia[2, 1])
    assert (
        told["gravity z"] == float(moved.robot.gravity[2]) and told["joint_offset elbow"] == y[at["joint_offset elbow"]]
    )
    assert np.abs(fj.residual(moved, devices)).max() > 0


@pytest.fixture(scope="module")
def rubbing(robot: fj.RobotModel) -> fj.ExtendedModel:
    return fj.extend(robot, place(robot, "viscous_friction", "elbow"), place(robot, "coulomb_friction", "elbow"))


def moved_arm(rubbing: fj.ExtendedModel, more: float = 0.0, inertia: float = 1.0, noise: float = 0.0) -> fj.TorqueData:
    """A recording of an arm with 2 N m s/rad and 1 N m of friction at the elbow, or `more`."""
    robot = eqx.tree_at(lambda m: m.inertia, rubbing.robot, np.asarray(rubbing.robot.inertia) * inertia)
    friction = (
        place(robot, "viscous_friction", "elbow", damping=2 + more),
        place(robot, "coulomb_friction", "elbow", force=1 + more),
    )
    torque = np.array(fj.extend(robot, *friction).inverse_dynamics(Q, V, A))
    torque += noise * np.random.default_rng(0).normal(size=torque.shape)
    return fj.torque_data(rubbing, fj.recording(q=Q, tau=torque, rate=250), fj.Preprocess(cutoff=10, rate=20))


def test_one_fit_estimates_inertias_friction_placements_offsets_frames_and_gravity(
    robot: fj.RobotModel, tracked: tuple[fj.PoseData, ...], rubbing: fj.ExtendedModel
):
    """Torque and postures in one fit: what each shows alone comes back, what neither shows is its prior's."""
    torque = moved_arm(rubbing, inertia=1.02, noise=0.05)
    torque = eqx.tree_at(lambda d: d.weight, torque, torque.weight / 0.05)
    postures = tuple(eqx.tree_at(lambda d: d.weight, one, one.weight / 1e-5) for one in tracked)
    free = {"inertia": ["forearm", "hand"], "friction": True, "joint_offset": ["shoulder", "elbow"], "frames": True}
    free |= {"link_geometry": ["wrist"], "gravity": ["gravity z"]}
    prior = {"inertia": 0.1, "link_geometry": 1e-3, "gravity": 0.5}
    found = fj.fit(rubbing, [torque, *postures], free, prior=prior)
    assert found.result == optimistix.RESULTS.successful and int(found.rank) == len(found.values)
    truth = {"viscous_friction elbow damping": 2.0, "coulomb_friction elbow force": 1.0, "joint_offset shoulder": 0.02}
    for name, value in truth.items():
        assert abs(found.parameters[name].value - value) < 4 * found.parameters[name].std
    assert found.parameters["joint_offset shoulder"].std < 1e-3 and found.parameters["gravity z"].std < 0.5
    assert float(found.cost) < 0.6 * len(found.rows)  # half the squares of noise with one sigma


@pytest.mark.slow
def test_fits_of_many_runs_and_of_robots_of_one_structure_are_mapped(rubbing: fj.ExtendedModel):
    """One jitted call of `jax.vmap` gives what a loop gives."""
    runs = [moved_arm(rubbing, 0.1 * k) for k in range(3)]
    robots = [
        eqx.tree_at(lambda m: m.robot.inertia, rubbing, np.asarray(rubbing.robot.inertia) * (1 + 0.01 * k))
        for k in range(3)
    ]
    data, models = (jax.tree.map(lambda *x: jnp.stack(x), *many) for many in (runs, robots))

    def friction(model: fj.ExtendedModel, run: fj.TorqueData) -> jax.Array:
        return jnp.asarray(fj.fit(model, run, "friction").values)

    mapped = jax.jit(jax.vmap(friction, in_axes=(None, 0)))(rubbing, data)
    np.testing.assert_allclose(mapped, [[2 + 0.1 * k, 1 + 0.1 * k] for k in range(3)], rtol=0, atol=5e-2)
    both = jax.jit(jax.vmap(friction))(models, data)
    single = [friction(model, run) for model, run in zip(robots, runs, strict=True)]
    np.testing.assert_allclose(both, single, rtol=1e-8, atol=0)


def test_numbers_by_name_are_those_of_one_fit(rubbing: fj.ExtendedModel):
    """Under a transformation, and of a batch, one message says what to take instead."""
    runs = jax.tree.map(lambda *x: jnp.stack(x), *(moved_arm(rubbing, 0.1 * k) for k in range(2)))
    batch = jax.vmap(lambda run: fj.fit(rubbing, run, "friction"))(runs)
    with pytest.raises(fj.InputError, match="take `values`, whose names are `free.names`"):
        _ = batch.parameters
    with pytest.raises(fj.InputError, match="take `values`"):
        jax.jit(lambda run: fj.fit(rubbing, run, "friction").parameters)(moved_arm(rubbing, 0.1))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["torque", "postures"])
def test_plain_gradients_by_all_of_the_data_are_those_of_refits(
    kind: str, robot: fj.RobotModel, tracked: tuple[fj.PoseData, ...], rubbing: fj.ExtendedModel
):
    """No leaf is a whole number: `jax.grad` takes the data as they are."""
    run, (postures, *_) = moved_arm(rubbing), tracked

    def damping(data: fj.TorqueData) -> jax.Array:
        return jnp.asarray(fj.fit(rubbing, data, "friction").values)[0]

    def offset(data: fj.PoseData) -> jax.Array:
        return jnp.asarray(fj.fit(robot, data, {**JOINTS, "frames": True}).values)[0]

    of_kind: dict[str, tuple] = {
        "torque": (damping, run, lambda d: d.torque),
        "postures": (offset, postures, lambda d: d.position),
    }
    fitted, data, leaf = of_kind[kind]
    way = np.cos(np.arange(np.size(leaf(data)))).reshape(np.shape(leaf(data)))
    sides = [fitted(eqx.tree_at(leaf, data, np.asarray(leaf(data)) + s * 1e-4 * way)) for s in (1, -1)]
    slope = (np.asarray(leaf(jax.grad(fitted)(data))) * way).sum()
    np.testing.assert_allclose(slope, (sides[0] - sides[1]) / 2e-4, rtol=1e-5, atol=0)


def test_one_recording_where_a_list_is_expected_is_told(robot: fj.RobotModel):
    q = np.zeros((50, robot.nv))
    one: Any = fj.recording(q=q, tau=q, rate=100)
    for use in (fj.diagnose, fj.identify, fj.calibrate):
        with pytest.raises(fj.InputError, match=r"recordings is one Recording; a list is expected.*\[recording\]"):
            use(robot, one)
