"""Poses, frames and Jacobians against Pinocchio, laws of motion against finite differences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pinocchio as pin
import pytest
import reference
import robots

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.rigid import kinematics


@pytest.mark.parametrize("name", robots.REAL)
def test_every_frame_stands_and_moves_as_pinocchios_from_the_urdf_itself(name: str, data_dir: Path) -> None:
    path = data_dir / robots.REAL[name]
    model = load_urdf(path)
    robot = pin.buildModelFromUrdf(str(path))
    data = robot.createData()
    q = robots.states(model, 1)[0][0]
    tree = {joint.name: i for i, joint in enumerate(model.joints)}
    share, entries = np.zeros((robot.nv, model.nv)), []
    for row, (joint, word) in enumerate(zip(list(robot.joints)[1:], list(robot.names)[1:], strict=True)):
        coordinate = model.joints[tree[word]].coordinate
        share[row, coordinate] = 1.0
        entries += [np.cos(q[coordinate]), np.sin(q[coordinate])] if joint.nq == 2 else [q[coordinate]]
    pin.computeJointJacobians(robot, data, np.array(entries))
    pin.updateFramePlacements(robot, data)
    for frame in model.frames[:: max(1, len(model.frames) // 8)]:
        index = robot.getFrameId(frame.name)
        pose = kinematics.frame_placement(model, q, frame.name)
        np.testing.assert_allclose(pose, data.oMf[index].homogeneous, rtol=0, atol=1e-10, err_msg=frame.name)
        jacobian = pin.getFrameJacobian(robot, data, index, pin.LOCAL_WORLD_ALIGNED) @ share
        ours = kinematics.frame_jacobian(model, q, frame.name)
        np.testing.assert_allclose(ours, jacobian, rtol=0, atol=1e-10, err_msg=frame.name)


@pytest.mark.parametrize("name", robots.INLINE)
def test_joint_poses_of_tiny_robots_equal_the_reference_backend(name: str, tmp_path: Path) -> None:
    model = robots.load(robots.INLINE[name], tmp_path)
    q = robots.states(model, 6)[0].reshape(2, 3, -1)
    theirs = reference.forward_kinematics(model, q)
    np.testing.assert_allclose(kinematics.forward_kinematics(model, q), theirs, rtol=0, atol=1e-12)
    on_host = kinematics.poses_on_host(model, q.reshape(6, -1))
    np.testing.assert_allclose(on_host, np.reshape(theirs, on_host.shape), rtol=0, atol=1e-12)


def test_motion_is_the_time_derivative_of_the_poses(tmp_path: Path) -> None:
    model = robots.load(robots.TREE, tmp_path)
    q, v, a = (jnp.asarray(x.T) for x in robots.states(model, 3))
    state = eqx.filter_jit(kinematics.motion)(model, q, v, a)
    h, placed = 1e-4, eqx.filter_jit(kinematics.placements)
    poses = [placed(model, q + v * t + a * t * t / 2) for t in (-h, 0.0, h)]
    acceleration = np.array((poses[2] - 2 * poses[1] + poses[0])[:, :3] / h**2)
    acceleration[:, :, 3] -= np.asarray(model.gravity)[:, None]
    columns = np.moveaxis(np.roll(acceleration, 1, axis=2), 2, 1)  # origin first
    np.testing.assert_allclose(state.acceleration, columns, rtol=0, atol=2e-4 * np.abs(acceleration).max())
    spin = np.einsum("jabn,jcbn->jacn", (poses[2] - poses[0])[:, :3, :3] / (2 * h), poses[1][:, :3, :3])
    np.testing.assert_allclose(state.w, np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], 1), rtol=0, atol=1e-4)


def test_jacobian_is_the_derivative_of_the_pose_in_every_coordinate(tmp_path: Path) -> None:
    """Mimic and prismatic joints included; the frame lies behind a fixed joint."""
    model = robots.load(robots.TREE, tmp_path)
    q = robots.states(model, 1)[0][0]
    jacobian = np.asarray(kinematics.frame_jacobian(model, q, "d"))
    pose, h = np.asarray(kinematics.frame_placement(model, q, "d")), 1e-6
    for k in range(model.nv):
        step = h * np.eye(model.nv)[k]
        ahead, behind = (np.asarray(kinematics.frame_placement(model, q + s, "d")) for s in (step, -step))
        rate = (ahead - behind) / (2 * h)
        spin = rate[:3, :3] @ pose[:3, :3].T
        twist = np.array([*rate[:3, 3], spin[2, 1], spin[0, 2], spin[1, 0]])
        np.testing.assert_allclose(jacobian[:, k], twist, rtol=0, atol=1e-8)


def test_frames_of_the_world_stand_still(tmp_path: Path) -> None:
    model = robots.load(robots.TREE, tmp_path)
    q = robots.states(model, 2)[0]
    np.testing.assert_array_equal(kinematics.frame_placement(model, q, "base"), np.tile(np.eye(4), (2, 1, 1)))
    np.testing.assert_array_equal(kinematics.frame_jacobian(model, q, "base"), np.zeros((2, 6, model.nv)))


def test_an_unknown_frame_is_refused_with_the_nearest_name(tmp_path: Path) -> None:
    model = robots.load(robots.TREE, tmp_path)
    with pytest.raises(InputError, match="no frame 'fingr'; did you mean 'finger'"):
        kinematics.frame_placement(model, np.zeros(model.nv), "fingr")


def test_what_is_no_model_or_no_name_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # these tests alone check types
    model = robots.load(robots.TREE, tmp_path)
    q: Any = np.zeros(model.nv)
    wrong: Any
    for wrong, told in (
        ("r.urdf", "model is the text 'r.urdf'; a RobotModel is expected: load_urdf"),
        (fj.extend(model), "model is of type ExtendedModel.*give its `.robot`"),
        (q, "model is of type ndarray"),
    ):
        with pytest.raises(InputError, match=told):
            fj.inverse_dynamics(wrong, q, q, q)
        for function in (fj.frame_placement, fj.frame_jacobian):
            with pytest.raises(InputError, match=told):
                function(wrong, q, "finger")
    wrong = "finger"
    for function in (fj.frame_placement, fj.frame_jacobian):
        with pytest.raises(InputError, match=r"name is of type ndarray; .* expected: \(model, q, name\)"):
            function(model, wrong, q)
