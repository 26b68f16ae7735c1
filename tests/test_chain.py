"""Poses along a chain with twists on its joints, against Pinocchio and finite differences."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
import reference
import robots

from figaroh_jax.effects.kinematic import CATALOGUE, Postures, columns_of
from figaroh_jax.errors import InputError
from figaroh_jax.estimation.gravity import gravity_moments, without_far_masses
from figaroh_jax.rigid.chain import chain_between, chain_pose, joint_response
from figaroh_jax.rigid.kinematics import forward_kinematics
from figaroh_jax.rigid.lie import log_so3

pose_of = jax.jit(chain_pose)


def test_chain_with_twists_is_pinocchios_with_moved_placements(tmp_path: Path):
    rng = np.random.default_rng(1)
    model = robots.load(robots.ARM, tmp_path)
    chain = chain_between(model, "base", "b")
    twists, q = 0.1 * rng.normal(size=(2, 6)), rng.uniform(-2.0, 2.0, (5, 2))
    pose = pose_of(chain, q.T, np.repeat(twists[..., None], 5, axis=2))
    robot = reference.build(model)
    for joint, twist in enumerate(twists, 1):  # E = translation, then rotation, behind the placement
        robot.jointPlacements[joint] = robot.jointPlacements[joint] * pin.SE3(pin.exp3(twist[3:]), twist[:3])
    data = robot.createData()
    for k in range(5):
        pin.forwardKinematics(robot, data, q[k])
        np.testing.assert_allclose(pose.R[..., k], data.oMi[2].rotation, rtol=0, atol=1e-14)
        np.testing.assert_allclose(pose.p[..., k], data.oMi[2].translation, rtol=0, atol=1e-14)


def test_motion_of_the_tool_is_the_derivative_of_its_pose(tmp_path: Path):
    rng = np.random.default_rng(2)
    model = robots.load(robots.ARM, tmp_path)
    chain = chain_between(model, "base", "b")
    q, twists = rng.uniform(-2.0, 2.0, (2, 3)), 0.3 * rng.normal(size=(2, 6, 3))
    at, fields = np.array([0, 0, 1, 1]), rng.normal(size=(4, 6, 3))
    here = pose_of(chain, q, twists)
    response = joint_response(here, jnp.repeat(jnp.eye(6)[..., None], 3, axis=2))  # rows: the tool's motion itself
    motion = np.einsum("kris,kis->rks", response[at], fields)
    h = 1e-6
    for k in range(4):
        moved = [pose_of(chain, q, twists + sign * h * np.eye(2)[at[k]][:, None, None] * fields[k]) for sign in (1, -1)]
        linear = (moved[0].p - moved[1].p) / (2 * h)
        turn = jax.vmap(lambda a, b: log_so3(a @ b.T) / (2 * h), in_axes=-1, out_axes=-1)(moved[0].R, moved[1].R)
        np.testing.assert_allclose(motion[:3, k], linear, rtol=0, atol=1e-8)
        np.testing.assert_allclose(motion[3:, k], turn, rtol=0, atol=1e-8)


def test_a_chain_may_begin_on_a_moving_link(tmp_path: Path):
    model = robots.load(robots.TREE, tmp_path)
    chain = chain_between(model, "a", "d")
    q = np.random.default_rng(3).uniform(-1.0, 1.0, (4, model.nv))
    pose = pose_of(chain, q.T, np.zeros((len(chain.joints), 6, 4)))
    world = reference.forward_kinematics(model, q)
    a, d = (world[:, model.link_index(name)] for name in "ad")
    expected = np.linalg.inv(a) @ d
    np.testing.assert_allclose(np.moveaxis(np.asarray(pose.R), -1, 0), expected[:, :3, :3], rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.asarray(pose.p).T, expected[:, :3, 3], rtol=0, atol=1e-13)


def test_frames_that_no_joint_moves_against_each_other_are_refused(tmp_path: Path):
    model = robots.load(robots.TREE, tmp_path)
    with pytest.raises(InputError, match="no joint moves tool_frame 'c' against base_frame 'b'"):
        chain_between(model, "b", "c")
    with pytest.raises(InputError, match="does not carry tool_frame 'f'"):
        chain_between(model, "a", "f")


def test_gravity_torque_is_minus_what_pinocchio_holds_with(tmp_path: Path):
    model = robots.load(robots.ARM, tmp_path)
    q = np.random.default_rng(4).uniform(-2.0, 2.0, (6, 2))
    robot = reference.build(model)
    held = [pin.computeGeneralizedGravity(robot, robot.createData(), x) for x in q]
    np.testing.assert_allclose(gravity_moments(model, q)[0], -np.array(held), rtol=0, atol=1e-12)


def test_a_centre_of_mass_far_outside_the_robot_is_left_out_and_said(tmp_path: Path):
    far = robots.ARM.replace('xyz="-0.1 0.2 0"', 'xyz="500 0 0"')
    model, notes = without_far_masses(robots.load(far, tmp_path))
    assert len(notes) == 1 and "link b" in notes[0]
    np.testing.assert_array_equal(np.asarray(model.inertia)[1], 0.0)


def test_derivative_by_an_offset_is_the_column_of_the_calibration(tmp_path: Path):
    model = robots.load(robots.ARM, tmp_path)
    chain, q = chain_between(model, "base", "b"), np.random.default_rng(0).uniform(-1.0, 1.0, 2)
    none = np.zeros((1, 0))
    postures = Postures(q[None], q[None], none, none, none, np.zeros(1), 1.0)
    by_joint = jax.jit(jax.jacfwd(lambda q: forward_kinematics(model, q)[1, :3, 3]))(jnp.asarray(q))
    along = jax.jit(
        lambda t, d: jax.jvp(lambda t: chain_pose(chain, jnp.asarray(q[:, None]), t).p[:, 0], (t,), (d,))[1]
    )
    for joint in range(2):
        (column,) = columns_of(CATALOGUE["joint_offset"], model, (joint,))
        ((_, field),) = column.pieces
        step = jnp.zeros((2, 6, 1)).at[joint].set(field(postures))
        np.testing.assert_allclose(by_joint[:, joint], along(0 * step, step), rtol=0, atol=1e-13)
