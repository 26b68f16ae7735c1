"""Products with the samples last against NumPy's with the samples first."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from figaroh_jax.rigid import spatial

rng = np.random.default_rng(0)
A, B = rng.normal(size=(2, 7, 3, 3))
U, V = rng.normal(size=(2, 7, 3))


def last(x: np.ndarray) -> jax.Array:
    return jnp.asarray(np.moveaxis(x, 0, -1))


def test_products_equal_numpys_sample_by_sample() -> None:
    np.testing.assert_allclose(spatial.cross(last(U), last(V)), last(np.cross(U, V)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(spatial.matmul(last(A), last(B)), last(A @ B), rtol=0, atol=1e-14)
    forth = last(np.einsum("nij,nj->ni", A, U))
    np.testing.assert_allclose(spatial.rotate(last(A), last(U)), forth, rtol=0, atol=1e-14)
    back = last(np.einsum("nji,nj->ni", A, U))
    np.testing.assert_allclose(spatial.rotate_back(last(A), last(U)), back, rtol=0, atol=1e-14)


def test_leading_axes_and_single_samples_broadcast() -> None:
    constant = jnp.asarray(U[0][:, None])
    assert spatial.cross(constant, last(V)[None]).shape == (1, 3, 7)
    np.testing.assert_allclose(spatial.cross(constant, last(V)), last(np.cross(U[0], V)), rtol=0, atol=1e-15)
    product = spatial.matmul(last(A)[None, None], jnp.asarray(B[0][..., None]))
    np.testing.assert_allclose(product[0, 0], last(A @ B[0]), rtol=0, atol=1e-14)
