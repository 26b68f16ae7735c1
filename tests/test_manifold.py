"""The configuration manifold: laws of Lie groups, joint by joint, and their gradients."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robots
from hypothesis import given, settings, strategies as st

from figaroh_jax.errors import InputError
from figaroh_jax.formats.robotfile import read_robot
from figaroh_jax.rigid.manifold import difference, integrate, neutral, random_configuration
from figaroh_jax.rigid.model import RobotModel

MODELS = {name: read_robot(robots.write(name)) for name in ("tree", "plane", "beast")}
cases = given(
    name=st.sampled_from(sorted(MODELS)), seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-9, 1e-3, 1])
)
quick = settings(max_examples=40, deadline=None)


def _draw(name: str, seed: int, scale: float) -> tuple[RobotModel, np.ndarray, np.ndarray]:
    model, rng = MODELS[name], np.random.default_rng(seed)
    return model, random_configuration(model, rng, (3,)), scale * rng.uniform(-1.5, 1.5, (3, model.nv))


@quick
@cases
def test_difference_undoes_integrate(name: str, seed: int, scale: float) -> None:
    model, q, v = _draw(name, seed, scale)
    np.testing.assert_allclose(difference(model, q, integrate(model, q, v)), v, rtol=0, atol=1e-14 + 1e-12 * scale)


@quick
@cases
def test_integrate_undoes_difference(name: str, seed: int, scale: float) -> None:
    model, q, v = _draw(name, seed, scale)
    other = integrate(model, random_configuration(model, seed + 1, (3,)), v)
    reached = integrate(model, q, difference(model, q, other))
    np.testing.assert_allclose(difference(model, reached, other), 0.0, rtol=0, atol=1e-12)


@quick
@cases
def test_steps_along_one_velocity_add_up(name: str, seed: int, scale: float) -> None:
    model, q, v = _draw(name, seed, scale)
    halves = integrate(model, integrate(model, q, 0.3 * v), 0.7 * v)
    np.testing.assert_allclose(difference(model, halves, integrate(model, q, v)), 0.0, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", MODELS)
def test_no_step_leaves_the_configuration_and_the_way_to_itself_is_none(name: str) -> None:
    model = MODELS[name]
    q = random_configuration(model, 0, (5,))
    np.testing.assert_allclose(integrate(model, q, np.zeros((5, model.nv))), q, rtol=0, atol=1e-15)
    np.testing.assert_allclose(difference(model, q, q), 0.0, rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("scale", [0.0, 0.7])
def test_gradients_are_those_of_central_differences_at_zero_too(name: str, scale: float) -> None:
    model, rng, step = MODELS[name], np.random.default_rng(1), 1e-6
    q, v = random_configuration(model, rng), scale * rng.uniform(-1, 1, model.nv)
    slope = np.asarray(jax.jacfwd(lambda x: integrate(model, q, x))(jnp.asarray(v)))
    ends = [np.asarray(integrate(model, np.tile(q, (model.nv, 1)), v + s * np.eye(model.nv))) for s in (step, -step)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]).T / (2 * step), rtol=0, atol=1e-8)
    back = jax.jacrev(lambda x: difference(model, q, integrate(model, q, x)))(jnp.asarray(v))
    np.testing.assert_allclose(back, np.eye(model.nv), rtol=0, atol=1e-12)


def test_quaternions_are_drawn_evenly_and_of_length_one() -> None:
    model = MODELS["beast"]
    quaternions = random_configuration(model, 3, (4000,))[:, 3:7]
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=-1), 1.0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(quaternions.T @ quaternions / 4000, np.eye(4) / 4, rtol=0, atol=0.03)


def test_a_seed_a_generator_and_a_key_draw() -> None:
    model = MODELS["plane"]
    np.testing.assert_array_equal(random_configuration(model, 7), random_configuration(model, np.random.default_rng(7)))
    key = jax.random.key(7)
    np.testing.assert_array_equal(random_configuration(model, key), random_configuration(model, key))


def test_neutral_is_zeros_and_unit_quaternions() -> None:
    q = neutral(MODELS["beast"])
    np.testing.assert_array_equal(q[[6, 10]], 1.0)
    assert q.sum() == 2.0


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(InputError, match="v has shape"):
        integrate(MODELS["tree"], np.zeros(MODELS["tree"].nq), np.zeros(2))
