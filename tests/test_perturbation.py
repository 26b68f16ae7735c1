"""The perturbed robot against Pinocchio, and its derivatives against the columns of the calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import reference
import robots

from figaroh_jax.effects.base import JointEffect, Scalar, amplitude
from figaroh_jax.effects.catalogue import register
from figaroh_jax.effects.kinematic import CATALOGUE, Postures, axis_twist, columns_of
from figaroh_jax.estimation.perturbation import Perturbation, apply
from figaroh_jax.rigid.chain import chain_between, chain_pose
from figaroh_jax.rigid.kinematics import forward_kinematics

rng = np.random.default_rng(0)


def test_zeros_are_the_nominal_robot_and_none_is_no_leaf(tmp_path: Path):
    model = robots.load(robots.ARM, tmp_path)
    nf = len(model.frames)
    zeros = Perturbation(offset=np.zeros(2), placement=np.zeros((2, 6)), base=np.zeros(6), frame=np.zeros((nf, 6)))
    assert len(jax.tree.leaves(zeros)) == 4
    same = eqx.filter_jit(apply)(model, zeros, jnp.zeros(2))
    np.testing.assert_allclose(same.placement, model.placement, rtol=0, atol=1e-15)
    np.testing.assert_allclose(same.frame_placement, model.frame_placement, rtol=0, atol=1e-15)


def test_each_posture_of_the_perturbed_robot_is_pinocchios(tmp_path: Path):
    model = robots.load(robots.ARM, tmp_path)
    error = Perturbation(
        offset=0.1 * rng.normal(size=2),
        placement=0.1 * rng.normal(size=(2, 6)),
        axis=0.1 * rng.normal(size=(2, 3)),
        scale=0.01 * rng.normal(size=2),
        eccentricity=0.01 * rng.normal(size=(2, 2)),
        gear=0.01 * rng.normal(size=(2, 2)),
        order=np.array([3.0, 5.0]),
        compliance=0.01 * rng.normal(size=2),
        growth=0.01 * rng.normal(size=2),
    )
    q, load = rng.uniform(-2.0, 2.0, (2, 4, 2))
    poses = jax.jit(jax.vmap(lambda x, f: forward_kinematics(apply(model, error, x, f), x)))(q, load)
    built = Perturbation(placement=error.placement, axis=error.axis, growth=error.growth)
    wrong = jax.tree.map(np.asarray, eqx.filter_jit(apply)(model, built, q[0]))
    for x, f, found in zip(q, load, poses, strict=True):
        shift = np.asarray(error.offset) + np.asarray(error.scale) * x + np.asarray(error.compliance) * f
        for part, order in ((error.eccentricity, np.ones(2)), (error.gear, np.asarray(error.order))):
            shift = shift + np.asarray(part)[:, 0] * np.sin(order * x) + np.asarray(part)[:, 1] * np.cos(order * x)
        expected = reference.forward_kinematics(wrong, x + shift)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


def test_an_effect_of_ones_own_that_errs_in_position_is_one_of_postures(tmp_path: Path):
    class Wear(JointEffect):
        """A gear that has worn where it is used most."""

        name, title, equation = "wear", "wear of the gear", "q_measured = q + depth exp(-q^2)"
        depth: Scalar = amplitude("rad")

        def position_error(self, motion: Any) -> Any:
            return self.depth * np.exp(-(self.here(motion.angle) ** 2))

    model, q = robots.load(robots.ARM, tmp_path), rng.uniform(-1.0, 1.0, (5, 2))
    none = np.zeros((5, 2))
    postures = Postures(q, q, none, np.zeros((5, 2, 3)), none, np.arange(5.0), 4.0)
    register(Wear)
    (column,) = columns_of(CATALOGUE["wear"], model, (1,))
    ((joint, field),) = column.pieces
    assert (joint, column.parameter, column.unit) == (1, "depth", "m")  # the joint slides
    # the joint stands behind its reading by the error
    turn = axis_twist(model, 1)[:, None] * -np.exp(-(q[:, 1] ** 2))
    np.testing.assert_allclose(field(postures), turn, rtol=0, atol=1e-15)


def test_derivative_by_an_offset_is_the_column_of_the_calibration(tmp_path: Path):
    model = robots.load(robots.ARM, tmp_path)
    chain, q = chain_between(model, "base", "b"), rng.uniform(-1.0, 1.0, 2)
    none = np.zeros((1, 0))
    postures = Postures(q[None], q[None], none, none, none, np.zeros(1), 1.0)
    for joint in range(2):
        (column,) = columns_of(CATALOGUE["joint_offset"], model, (joint,))
        ((_, field),) = column.pieces
        step = jnp.zeros((2, 6, 1)).at[joint].set(field(postures))
        along = jax.jit(
            lambda t, d: jax.jvp(lambda t: chain_pose(chain, jnp.asarray(q[:, None]), t).p[:, 0], (t,), (d,))[1]
        )
        by_chain = along(0 * step, step)

        def of_tool(c: jax.Array) -> jax.Array:
            return forward_kinematics(apply(model, Perturbation(offset=c), jnp.asarray(q)), q)[1, :3, 3]

        np.testing.assert_allclose(jax.jit(jax.jacfwd(of_tool))(jnp.zeros(2))[:, joint], by_chain, rtol=0, atol=1e-13)
