"""Exponential and logarithm of rotations and poses: group laws, SciPy's rotations and finite differences."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from figaroh_jax.rigid import lie

exp_so3, log_so3 = jax.jit(lie.exp_so3), jax.jit(lie.log_so3)
exp_se3, log_se3 = jax.jit(lie.exp_se3), jax.jit(lie.log_se3)
AXIS = np.array([0.6, -0.48, 0.64])
ANGLES = [0.0, 1e-12, 1e-6, 0.0099, 0.0101, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9]
unit = st.floats(-1.0, 1.0, allow_subnormal=False)
rotations = st.tuples(unit, unit, unit).map(lambda w: np.array(w) * np.pi / np.sqrt(3.0))
twists = st.tuples(rotations, st.tuples(unit, unit, unit)).map(lambda t: np.concatenate([t[1], t[0]]))


@settings(max_examples=60, deadline=None)
@given(rotations)
def test_exponential_is_scipys_rotation_and_logarithm_inverts_it(w: np.ndarray):
    R = np.asarray(exp_so3(jnp.asarray(w)))
    np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), rtol=0, atol=3e-15)
    np.testing.assert_allclose(log_so3(R), w, rtol=0, atol=1e-13)


@settings(max_examples=60, deadline=None)
@given(twists, twists)
def test_poses_form_a_group(a: np.ndarray, b: np.ndarray):
    A, B = exp_se3(a), exp_se3(b)
    np.testing.assert_allclose(log_se3(A), a, rtol=0, atol=1e-12)
    np.testing.assert_allclose(exp_se3(-a), np.linalg.inv(A), rtol=0, atol=1e-14)
    np.testing.assert_allclose(lie.inverse_pose(A @ B), lie.inverse_pose(B) @ lie.inverse_pose(A), rtol=0, atol=1e-14)
    np.testing.assert_allclose(exp_se3(log_se3(A @ B)), A @ B, rtol=0, atol=1e-12)
    np.testing.assert_allclose(exp_se3(0.3 * a) @ exp_se3(0.7 * a), A, rtol=0, atol=1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_logarithm_is_exact_from_zero_to_a_half_turn(angle: float):
    R = Rotation.from_rotvec(angle * AXIS).as_matrix()
    np.testing.assert_allclose(log_so3(R), angle * AXIS, rtol=0, atol=4e-15)


def test_logarithm_of_a_half_turn_about_each_axis_has_the_right_length():
    for axis in (*np.eye(3), AXIS):
        w = np.asarray(log_so3(2.0 * np.outer(axis, axis) - np.eye(3)))
        np.testing.assert_allclose(abs(w @ axis), np.pi, rtol=0, atol=1e-14)


def forth_and_back(d: jax.Array, at: jax.Array) -> jax.Array:  # differences stay on this side of the half turn
    return lie.log_se3(lie.exp_se3(at) @ lie.exp_se3(d))


def forth(d: jax.Array, at: jax.Array) -> jax.Array:
    return lie.exp_se3(at + d)


@pytest.mark.parametrize("function", [forth, forth_and_back])
def test_gradients_equal_finite_differences_at_zero_and_near_a_half_turn(function: Callable):
    at = jnp.stack([jnp.concatenate([jnp.array([0.3, -0.2, 0.5]), a * AXIS]) for a in ANGLES[:-2]])

    def both(x: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        zero = jnp.zeros(6)
        return jax.jacfwd(function)(zero, x), jax.jacrev(function)(zero, x), _differences(lambda d: function(d, x))

    forward, reverse, differences = jax.jit(jax.vmap(both))(at)
    scale = max(1.0, float(jnp.abs(forward).max()))
    np.testing.assert_allclose(forward, reverse, rtol=0, atol=1e-11 * scale)
    np.testing.assert_allclose(forward, differences, rtol=0, atol=2e-8 * scale)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.0101, 1.0, 3.1])
def test_left_jacobian_turns_rates_of_the_vector_into_angular_velocity(angle: float):
    w = jnp.asarray(angle * AXIS)
    turned = jax.jacfwd(lambda d: lie.log_so3(lie.exp_so3(w + d) @ lie.exp_so3(w).T))(jnp.zeros(3))
    np.testing.assert_allclose(lie.left_jacobian(w), turned, rtol=0, atol=1e-11)
    np.testing.assert_allclose(lie.left_jacobian(w) @ lie.left_jacobian_inverse(w), np.eye(3), rtol=0, atol=1e-12)


def _differences(function: Callable[[jax.Array], jax.Array], step: float = 1e-4) -> jax.Array:
    """Central differences at zero, extrapolated once (Richardson)."""

    def central(h: float) -> jax.Array:
        return jnp.moveaxis(jax.vmap(lambda e: (function(h * e) - function(-h * e)) / (2 * h))(jnp.eye(6)), 0, -1)

    return (4.0 * central(step / 2) - central(step)) / 3.0
