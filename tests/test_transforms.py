"""Every function of the rigid body under grad, jvp, vmap and jit, with respect to every leaf of the model."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robots

from figaroh_jax.compiled.precision import Float32Boundary
from figaroh_jax.rigid import dynamics, kinematics
from figaroh_jax.rigid.model import RobotModel

LEAVES = ("placement", "axis", "inertia", "ratio", "offset", "gravity", "frame_placement")
FUNCTIONS: dict[str, Callable[..., jax.Array]] = {
    "inverse_dynamics": dynamics.inverse_dynamics,
    "forward_dynamics": dynamics.forward_dynamics,
    "mass_matrix": lambda model, q, v, a: dynamics.mass_matrix(model, q),
    "forward_kinematics": lambda model, q, v, a: kinematics.forward_kinematics(model, q),
    "frame_placement": lambda model, q, v, a: kinematics.frame_placement(model, q, "d"),
    "frame_jacobian": lambda model, q, v, a: kinematics.frame_jacobian(model, q, "d"),
}
READS = {  # leaves that a function's answer depends on
    "inverse_dynamics": LEAVES[:6],
    "forward_dynamics": LEAVES[:6],
    "mass_matrix": LEAVES[:5],
    "forward_kinematics": ("placement", "axis", "ratio", "offset"),
    "frame_placement": ("placement", "axis", "ratio", "offset", "frame_placement"),
    "frame_jacobian": ("placement", "axis", "ratio", "offset", "frame_placement"),
}


@pytest.fixture
def model(tmp_path: Path) -> RobotModel:
    return robots.load(robots.TREE, tmp_path)


def shifted(model: RobotModel, leaf: str, by: np.ndarray) -> RobotModel:
    return eqx.tree_at(lambda m: getattr(m, leaf), model, getattr(model, leaf) + by)


def state_of(model: RobotModel, still: bool) -> tuple[np.ndarray, ...]:
    return tuple(x[0] * (not still) for x in robots.states(model, 1))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_gradients_in_every_leaf_and_in_the_state_are_central_differences(name: str, model: RobotModel) -> None:
    """Reverse mode against differences, forward mode against reverse, in a random direction; moving and still."""
    rng = np.random.default_rng(3)
    weight = rng.normal(size=FUNCTIONS[name](model, *state_of(model, True)).shape)

    def value(robot: RobotModel, *state: np.ndarray) -> jax.Array:
        return jnp.sum(weight * FUNCTIONS[name](robot, *state))

    backward = jax.jit(jax.grad(value, argnums=(0, 1, 2, 3)))
    forward = jax.jit(lambda point, tangent: jax.jvp(value, point, tangent)[1])
    for still in (False, True):
        point = (model, *state_of(model, still))
        gradient = backward(*point)
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(gradient))
        for move in (*(moved_leaf(leaf) for leaf in READS[name]), *map(moved_state, (1, 2, 3))):
            tangent = eqx.tree_at(move, jax.tree.map(np.zeros_like, point), rng.normal(size=move(point).shape))
            ahead, behind = (value(*jax.tree.map(lambda x, t, h=h: x + h * t, point, tangent)) for h in (1e-6, -1e-6))
            slope, difference = float(np.sum(move(gradient) * move(tangent))), float(ahead - behind) / 2e-6
            scale = max(1.0, abs(difference))
            np.testing.assert_allclose(slope / scale, difference / scale, rtol=0, atol=1e-6)
            np.testing.assert_allclose(float(forward(point, tangent)) / scale, slope / scale, rtol=0, atol=1e-11)


def moved_leaf(leaf: str) -> Callable[[tuple], np.ndarray]:
    return lambda point: getattr(point[0], leaf)


def moved_state(k: int) -> Callable[[tuple], np.ndarray]:
    return lambda point: point[k]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_vmap_over_samples_is_the_batch_and_jit_changes_nothing(name: str, model: RobotModel) -> None:
    state = robots.states(model, 3)
    batch = FUNCTIONS[name](model, *state)
    mapped = jax.jit(jax.vmap(FUNCTIONS[name], in_axes=(None, 0, 0, 0)))(model, *state)
    np.testing.assert_allclose(mapped, batch, rtol=0, atol=1e-11 * np.abs(batch).max())


@pytest.mark.parametrize("leaf", LEAVES[:6])
def test_a_vmap_over_models_is_one_model_at_a_time(leaf: str, model: RobotModel) -> None:
    state = robots.states(model, 2)
    changes = 0.01 * np.random.default_rng(7).normal(size=(3, *getattr(model, leaf).shape))

    def torque(by: jax.Array) -> jax.Array:
        return dynamics.inverse_dynamics(shifted(model, leaf, by), *state)  # pyright: ignore[reportArgumentType]

    singly = np.stack([torque(jnp.asarray(by)) for by in changes])
    np.testing.assert_allclose(jax.vmap(torque)(jnp.asarray(changes)), singly, rtol=0, atol=1e-11)


def test_torque_is_linear_in_the_inertial_parameters(model: RobotModel) -> None:
    """Euler: the torque is its own Jacobian in the parameters times the parameters."""
    state = robots.states(model, 2)

    def torque(inertia: jax.Array) -> jax.Array:
        return dynamics.inverse_dynamics(dataclasses.replace(model, inertia=inertia), *state)

    jacobian = jax.jacfwd(torque)(jnp.asarray(model.inertia))
    np.testing.assert_allclose(
        np.tensordot(jacobian, model.inertia, 2), torque(jnp.asarray(model.inertia)), rtol=0, atol=1e-11
    )


def test_a_users_jit_without_64_bits_gives_float32_accuracy(model: RobotModel) -> None:
    state = robots.states(model, 2)
    exact = dynamics.inverse_dynamics(model, *state)
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("ignore", Float32Boundary)  # said once in a process: here, or by a test before
        rough = jax.jit(dynamics.inverse_dynamics)(model, *state)
    np.testing.assert_allclose(rough, exact, rtol=0, atol=1e-4 * np.abs(exact).max())
