"""Inertial parameters against Pinocchio's inertias and the laws of rigid bodies."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings, strategies as st

from figaroh_jax.rigid import inertia


def body(seed: int) -> tuple[pin.Inertia, np.ndarray]:
    """A random physical body, by Pinocchio, and its ten parameters."""
    pin.seed(seed)
    peer = pin.Inertia.Random()
    return peer, np.array(peer.toDynamicParameters())


seeds = st.integers(0, 2**31 - 1)


@settings(deadline=None, max_examples=50)
@given(seeds)
def test_parameters_from_the_centre_of_mass_are_pinocchios(seed: int) -> None:
    peer, parameters = body(seed)
    ours = inertia.from_com(peer.mass, np.array(peer.lever), np.array(peer.inertia))
    np.testing.assert_allclose(ours, parameters, rtol=0, atol=1e-13)
    mass, com, about_com = inertia.to_com(parameters)
    assert mass == pytest.approx(peer.mass, abs=1e-14)
    np.testing.assert_allclose(com, peer.lever, rtol=0, atol=1e-13)
    np.testing.assert_allclose(about_com, peer.inertia, rtol=0, atol=1e-12)


@settings(deadline=None, max_examples=50)
@given(seeds)
def test_a_body_in_another_frame_is_pinocchios(seed: int) -> None:
    peer, parameters = body(seed)
    placement = pin.SE3.Random()
    moved = inertia.transform(parameters, placement.homogeneous)
    np.testing.assert_allclose(moved, (placement * peer).toDynamicParameters(), rtol=0, atol=1e-12)


@settings(deadline=None, max_examples=50)
@given(seeds)
def test_the_pseudo_inertia_is_pinocchios_and_leads_back(seed: int) -> None:
    peer, parameters = body(seed)
    matrix = inertia.pseudo_inertia(parameters)
    np.testing.assert_allclose(matrix, peer.toPseudoInertia().toMatrix(), rtol=0, atol=1e-13)
    np.testing.assert_allclose(inertia.from_pseudo_inertia(matrix), parameters, rtol=0, atol=1e-13)


def test_point_masses_add_up_to_their_moments() -> None:
    rng = np.random.default_rng(0)
    points, masses = rng.normal(size=(5, 3)), rng.uniform(0.1, 1.0, 5)
    total = sum(inertia.from_com(m, p, np.zeros((3, 3))) for m, p in zip(masses, points, strict=True))
    homogeneous = np.c_[points, np.ones(5)]
    expected = np.einsum("k,ki,kj->ij", masses, homogeneous, homogeneous)
    np.testing.assert_allclose(inertia.pseudo_inertia(np.asarray(total)), expected, rtol=0, atol=1e-13)


def test_bodies_that_no_mass_distribution_has_are_told_from_those_that_one_has() -> None:
    ball = inertia.from_com(1.0, np.zeros(3), np.eye(3))
    plate = inertia.from_com(1.0, np.ones(3), np.diag([1.0, 2.0, 3.0]))  # flat: the limit of the triangle inequality
    needle = inertia.from_com(1.0, np.zeros(3), np.diag([1.0, 1.0, 2.1]))
    negative = -ball
    told = inertia.is_physical(np.stack([ball, plate, needle, negative, np.zeros(10)]))
    assert list(told) == [True, True, False, False, True]


def test_a_massless_link_has_its_centre_of_mass_at_the_origin() -> None:
    mass, com, about_com = inertia.to_com(np.zeros(10))
    assert mass == 0.0 and not com.any() and not about_com.any()


def test_jax_arrays_stay_jax_arrays_and_numpy_arrays_numpy() -> None:
    parameters = np.arange(1.0, 11.0)
    assert isinstance(inertia.transform(parameters, np.eye(4)), np.ndarray)
    assert isinstance(inertia.transform(jnp.asarray(parameters), jnp.eye(4)), jnp.ndarray)
