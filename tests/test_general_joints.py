"""Robots with free, planar and spherical joints: the trees that come out, compared with Pinocchio's."""

from __future__ import annotations

from pathlib import Path

import mujoco_c
import numpy as np
import pinocchio as pin
import pytest
import robots

from figaroh_jax.effects.extended import extend
from figaroh_jax.errors import InputError
from figaroh_jax.formats.export import load_model, write_model
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.rigid.kinematics import frame_placements
from figaroh_jax.rigid.model import Joint, dofs


def test_columns_of_a_tree_with_joints_of_several_degrees_of_freedom(tmp_path: Path) -> None:
    model = robots.load(robots.GENERAL, tmp_path)
    assert (model.nq, model.nv, model.nd) == (13, 12, 12)
    assert [j.coordinate for j in model.joints] == [0, 1, 4, 5, 11]
    assert model.joint_names == ("lift", "cart", "elbow", "loose", "tail")
    assert model.dof_names[:5] == ("lift", "cart.vx", "cart.vy", "cart.wz", "elbow")
    assert [model.dofs.positions[k] for k in (1, 3, 4)] == [slice(1, 4), slice(5, 12), slice(12, 13)]
    assert model.joint_index("tail") == 11 and model.joint_index("cart.vy") == 2
    with pytest.raises(InputError, match="'cart' of robot 'tiny' has 3 columns: cart.vx, cart.vy, cart.wz"):
        model.joint_index("cart")
    np.testing.assert_array_equal(model.dofs.first, [0, 1, 4, 5, 11])
    np.testing.assert_array_equal(model.dofs.turns, [0, 0, 0, 1, 1, 0, 0, 0, 1, 1, 1, 1])
    assert model.axis.shape == (12, 3) and model.position_limit.shape == (12, 2)


def test_moving_joints_take_consecutive_columns_in_the_order_asked_for(tmp_path: Path) -> None:
    model = robots.load(robots.GENERAL, tmp_path, joints=["tail", "loose", "lift"], root="free_flyer")
    assert model.joint_names == ("root_joint", "tail", "loose", "lift")
    assert {j.name: j.coordinate for j in model.joints} == {"root_joint": 0, "lift": 13, "loose": 7, "tail": 6}
    assert dict(zip(("root_joint", "lift", "loose", "tail"), model.dofs.positions, strict=True)) == {
        "root_joint": slice(0, 7), "tail": slice(7, 8), "loose": slice(8, 15), "lift": slice(15, 16)
    }  # fmt: skip
    assert model.joints[0] == Joint("root_joint", "free", -1, 0, "base")
    assert "base" in model.link_names and "root_joint" in {frame.name for frame in model.frames}


def test_a_mimic_joint_has_a_degree_of_freedom_but_no_column_of_its_own() -> None:
    joints = (
        Joint("ball", "spherical", -1, 1, "a"),
        Joint("copy", "revolute", 0, 0, "b", True),
        Joint("lead", "revolute", 0, 0, "c"),
    )
    found = dofs(joints)
    np.testing.assert_array_equal(found.column, [1, 2, 3, 0, 0])
    np.testing.assert_array_equal(found.joint, [0, 0, 0, 1, 2])
    assert found.positions == (slice(1, 5), slice(0, 1), slice(0, 1))


@pytest.mark.parametrize("root", ["fixed", "free_flyer"])
def test_the_tree_is_pinocchios(root: str, tmp_path: Path) -> None:
    model = robots.load(robots.GENERAL, tmp_path, root=root)
    options = () if root == "fixed" else (pin.JointModelFreeFlyer(),)
    theirs = pin.buildModelFromXML(robots.GENERAL, *options)
    tree = {joint.name: i for i, joint in enumerate(model.joints)}
    # Pinocchio numbers siblings by name, and a plane's angle as cosine and sine
    assert set(list(theirs.names)[1:]) == set(tree) and theirs.nv == model.nv and theirs.nq == model.nq + 2
    for i in range(1, theirs.njoints):
        ours = tree[theirs.names[i]]
        parent = theirs.names[theirs.parents[i]] if theirs.parents[i] else None
        assert (model.joints[model.joints[ours].parent].name if model.joints[ours].parent >= 0 else None) == parent
        np.testing.assert_allclose(model.placement[ours], theirs.jointPlacements[i].homogeneous, rtol=0, atol=1e-14)
        np.testing.assert_allclose(model.inertia[ours], theirs.inertias[i].toDynamicParameters(), rtol=0, atol=1e-14)


def test_locked_at_a_posture_every_frame_is_where_pinocchio_puts_it(tmp_path: Path) -> None:
    theirs = pin.buildModelFromXML(robots.GENERAL)
    data, q = theirs.createData(), pin.randomConfiguration(theirs, -np.ones(theirs.nq), np.ones(theirs.nq))
    pin.framesForwardKinematics(theirs, data, q)
    posture = {}
    for i in range(1, theirs.njoints):
        joint = theirs.joints[i]
        numbers = q[joint.idx_q : joint.idx_q + joint.nq]
        if joint.shortname() in ("JointModelPlanar", "JointModelRUBY"):  # an angle as cosine and sine
            numbers = [*numbers[:-2], np.arctan2(numbers[-1], numbers[-2])]
        posture[theirs.names[i]] = list(numbers) if len(numbers) > 1 else float(numbers[0])
    moving = posture.pop("tail")  # one joint has to move; its frames are left out
    assert moving is not None
    model = robots.load(robots.GENERAL, tmp_path, joints=["tail"], posture=posture)
    for frame, placement in zip(model.frames, model.frame_placement, strict=True):
        if frame.parent < 0:
            pose = data.oMf[theirs.getFrameId(frame.name)].homogeneous
            np.testing.assert_allclose(placement, pose, rtol=0, atol=1e-13)


def test_the_plane_of_a_planar_joint_is_normal_to_its_axis(tmp_path: Path) -> None:
    rng = np.random.default_rng()
    for normal in np.array([[0, 0, 1], [0, 0, -1], *rng.normal(size=(5, 3))]):
        axis = " ".join(map(str, normal))
        text = robots.GENERAL.replace(
            robots.joint("cart", "a", "b", "planar", "0 0 1"), robots.joint("cart", "a", "b", "planar", axis)
        )
        frame = robots.load(text, tmp_path).axis[1:4]
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), rtol=0, atol=1e-14)
        np.testing.assert_allclose(np.linalg.det(frame), 1.0, rtol=0, atol=1e-14)
        np.testing.assert_allclose(frame[2], normal / np.linalg.norm(normal), rtol=0, atol=1e-15)


BAD = {
    "too few numbers": ({"posture": {"loose": [0.0, 1.0]}}, "'loose' is free; 7 numbers are expected"),
    "one number": ({"posture": {"cart": 0.5}}, "'cart' is planar; 3 numbers are expected"),
    "several numbers": ({"posture": {"lift": [0.5, 1.0]}}, "'lift' is prismatic; 1 numbers? (are|is) expected"),
    "no rotation": ({"posture": {"loose": [0.0] * 7}}, "quaternion of joint 'loose' is zero"),
    "NaN": ({"posture": {"cart": [0.0, np.nan, 0.0]}}, "'cart' is at .*nan"),
}


@pytest.mark.parametrize("name", BAD)
def test_wrong_postures_and_roots_are_refused(name: str, tmp_path: Path) -> None:
    options, message = BAD[name]
    with pytest.raises(InputError, match=message):
        robots.load(robots.GENERAL, tmp_path, **options)


def test_a_file_is_found_in_its_package(tmp_path: Path) -> None:
    folder = tmp_path / "tiny_description" / "urdf"
    folder.mkdir(parents=True)
    (folder / "tiny.urdf").write_text(robots.ARM)
    path = "package://tiny_description/urdf/tiny.urdf"
    for packages in ([tmp_path], [tmp_path / "none", tmp_path / "tiny_description"]):
        assert load_urdf(path, packages=packages).joint_names == ("turn", "slide")
    with pytest.raises(InputError, match="package 'tiny_description' is in none of the package folders .none was"):
        load_urdf(path)


def test_written_files_move_every_frame_as_the_model(tmp_path: Path) -> None:
    """Joints of all kinds through URDF, at random positions: the poses come from the kernels, not from the leaves."""
    for root in ("fixed", "free_flyer"):
        model = robots.load(robots.GENERAL, tmp_path, root=root)
        write_model(extend(model), tmp_path / root)
        found = load_model(tmp_path / root).robot
        q = mujoco_c.states(model, 3)
        poses = [np.asarray(frame_placements(m, np.array([state[0] for state in q]))) for m in (model, found)]
        places = [[frame.name for frame in m.frames] for m in (model, found)]
        order = [places[1].index(name) for name in places[0]]
        np.testing.assert_allclose(poses[1][:, order], poses[0], rtol=0, atol=1e-12)
