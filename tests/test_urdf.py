"""Reading URDF: the tree that comes out, locked and merged joints against Pinocchio, and files that are refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import reference
import robots
from robots import joint, link, robot

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.formats.robotfile import load_extended
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.rigid.kinematics import frame_placement


def test_joints_are_numbered_depth_first_in_the_order_of_the_file(tmp_path: Path) -> None:
    model = robots.load(robots.TREE, tmp_path)
    assert [j.name for j in model.joints] == ["hip", "copy", "finger", "knee", "toe"]
    assert [j.parent for j in model.joints] == [-1, 0, 1, 0, -1]
    assert [j.kind for j in model.joints] == ["revolute", "revolute", "prismatic", "revolute", "revolute"]
    assert model.link_names == ("a", "b", "d", "e", "f")
    assert model.joint_names == ("hip", "finger", "knee", "toe")


def test_every_link_and_every_joint_has_a_frame(tmp_path: Path) -> None:
    model = robots.load(robots.TREE, tmp_path)
    names = {"base", "a", "b", "c", "d", "e", "f", "hip", "copy", "weld", "finger", "knee", "toe"}
    assert {frame.name for frame in model.frames} == names
    pose = frame_placement(model, np.zeros(4), "weld")
    np.testing.assert_allclose(pose, frame_placement(model, np.zeros(4), "c"), rtol=0, atol=1e-15)


def test_leaves_are_float64_whatever_the_global_setting(tmp_path: Path) -> None:
    code = (
        "import sys, numpy as np, jax\nfrom figaroh_jax.formats.urdf import load_urdf\n"
        "model = load_urdf(sys.argv[1])\nassert not jax.config.jax_enable_x64\n"
        "assert all(x.dtype == np.float64 for x in jax.tree.leaves(model))\n"
        "assert model.inertia[0, 0] == 2.0 and model.placement[0, 0, 3] == 0.1"
    )
    path = tmp_path / "robot.urdf"
    path.write_text(robots.ARM)
    subprocess.run([sys.executable, "-c", code, str(path)], check=True, cwd=Path(__file__).parents[1])


@pytest.mark.parametrize("name", ["tiago", "talos"])
def test_locked_joints_are_merged_as_pinocchio_reduces_a_model(name: str, data_dir: Path) -> None:
    path = data_dir / robots.REAL[name]
    robot = pin.buildModelFromUrdf(str(path))
    full = load_urdf(path)
    bounded = {j for j, limit in zip(full.joint_names, full.position_limit, strict=True) if np.isfinite(limit).all()}
    kept = [j for j in full.joint_names if j in bounded][-7:-1]
    posture = {j: 0.3 + 0.1 * k for k, j in enumerate(sorted(bounded - set(kept))[:5])}
    start = pin.neutral(robot)
    for word, value in posture.items():
        start[robot.joints[robot.getJointId(word)].idx_q] = value
    locked = [robot.getJointId(word) for word in full.joint_names if word not in kept]
    reduced = pin.buildReducedModel(robot, locked, start)
    model = load_urdf(path, joints=kept[::-1], posture=posture)
    assert model.joint_names == tuple(kept[::-1])
    tree = {j.name: i for i, j in enumerate(model.joints)}
    for i in range(1, reduced.njoints):
        ours = model.inertia[tree[reduced.names[i]]]
        np.testing.assert_allclose(ours, reduced.inertias[i].toDynamicParameters(), rtol=0, atol=1e-12)
    q, v, a = robots.states(model, 1)
    order = [kept[::-1].index(word) for word in list(reduced.names)[1:]]
    torque = pin.rnea(reduced, reduced.createData(), *(x[0][order] for x in (q, v, a)))
    np.testing.assert_allclose(reference.inverse_dynamics(model, q, v, a)[0][order], torque, rtol=0, atol=1e-10)


def test_a_mimic_joint_follows_a_locked_joint(tmp_path: Path) -> None:
    model = robots.load(robots.TREE, tmp_path, joints=["hip"], posture={"knee": 0.4})
    free = robots.load(robots.TREE, tmp_path)
    for name in ("d", "e"):
        pose = frame_placement(free, np.array([0.7, 0.0, 0.4, 0.0]), name)
        np.testing.assert_allclose(frame_placement(model, np.array([0.7]), name), pose, rtol=0, atol=1e-14)


def test_posture_without_joints_locks_the_joints_that_it_names(tmp_path: Path) -> None:
    assert robots.load(robots.TREE, tmp_path, posture={"knee": 0.4}).joint_names == ("hip", "finger", "toe")


def test_a_chain_of_mimics_multiplies_out(tmp_path: Path) -> None:
    follow = [f'<mimic joint="j{k}" multiplier="2" offset="0.1"/>' for k in range(2)]
    joints = [joint("j0", "base", "a"), joint("j1", "a", "b", more=follow[0]), joint("j2", "b", "c", more=follow[1])]
    model = robots.load(robot(*robots.LINKS[:4], *joints), tmp_path)
    assert model.nv == 1
    np.testing.assert_allclose(model.ratio, [1.0, 2.0, 4.0], rtol=0, atol=0)
    np.testing.assert_allclose(model.offset, [0.0, 0.1, 0.3], rtol=0, atol=1e-15)


def test_limits_are_read_and_infinite_where_there_are_none(tmp_path: Path) -> None:
    limit = '<limit lower="-1" upper="2" velocity="3" effort="4"/>'
    joints = [
        joint("j0", "base", "a", more=limit),
        joint("j1", "a", "b", "continuous", more=limit),
        joint("j2", "b", "c"),
    ]
    model = robots.load(robot(*robots.LINKS[:4], *joints), tmp_path)
    np.testing.assert_array_equal(model.position_limit, [[-1, 2], [-np.inf, np.inf], [-np.inf, np.inf]])
    np.testing.assert_array_equal(model.velocity_limit, [3, 3, np.inf])
    np.testing.assert_array_equal(model.effort_limit, [4, 4, np.inf])


def test_what_a_joint_says_twice_counts_once_and_is_told(tmp_path: Path) -> None:
    """The first counts, as it does for Pinocchio (urdfdom); published files have such joints."""
    text = robot(*robots.LINKS[:2], joint("turn", "base", "a", "continuous", more='<origin xyz="9 9 9"/>'))
    model = robots.load(text, tmp_path)
    np.testing.assert_array_equal(model.placement[0, :3, 3], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(pin.buildModelFromXML(text).jointPlacements[1].translation, [0.1, 0.2, 0.3], rtol=0)
    (file,) = tmp_path.glob("*.urdf")
    assert load_extended(file).notes == ("the second <origin> of joint 'turn' (line 1): the first counts",)


def test_what_a_link_weighs_twice_counts_once_and_is_told(tmp_path: Path) -> None:
    """As for Pinocchio; the fingers of a published robot have two."""
    second = '<inertial><mass value="7"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    twice = robots.LINKS[1].replace("</inertial>", f"</inertial>{second}")
    text = robot(robots.LINKS[0], twice, joint("turn", "base", "a", "continuous"))
    model, theirs = robots.load(text, tmp_path), pin.buildModelFromXML(text)
    np.testing.assert_allclose(model.inertia[:, 0], [one.mass for one in theirs.inertias[1:]], rtol=1e-15)
    (file,) = tmp_path.glob("*.urdf")
    assert load_extended(file).notes == ("the second <inertial> of link 'a' (line 1): the first counts",)


@pytest.mark.parametrize("version", ["0.0", "1.1", "2.0"])
def test_a_version_of_a_file_in_the_declaration_does_not_matter(version: str, tmp_path: Path) -> None:
    """Files of a published quadruped have `<?xml version="0.0" ?>`, which readers of XML refuse and others do not."""
    assert robots.load(f'<?xml version="{version}" ?>\n{robots.ARM}', tmp_path).nv == 2


def test_meshes_are_never_looked_for(tmp_path: Path) -> None:
    mesh = '<visual><geometry><mesh filename="package://nowhere/a.dae"/></geometry></visual>'
    text = robots.ARM.replace('<link name="a">', f'<link name="a">{mesh}{mesh.replace("visual", "collision")}')
    assert robots.load(text, tmp_path).nv == 2


LINKS3 = robots.LINKS[:3]
TWO = [joint("j0", "base", "a"), joint("j1", "a", "b")]
FOLLOW = '<mimic joint="j{}"/>'
BAD = {
    "cycle": (robot(*LINKS3, joint("j0", "a", "b"), joint("j1", "b", "a")), "'j1', 'j0'|'j0', 'j1'.* form a cycle"),
    "all in a cycle": (robot(*LINKS3[1:], joint("j0", "a", "b"), joint("j1", "b", "a")), "form a cycle"),
    "two roots": (robot(*LINKS3, joint("j0", "base", "a")), "links 'base', 'b' have no parent joint"),
    "two parents": (robot(*LINKS3, *TWO, joint("j2", "base", "b")), "'b' is the child of two joints, 'j1' and 'j2'"),
    "no such parent": (robot(*LINKS3[:2], joint("j0", "bose", "a")), "'j0': its parent link 'bose' .* mean 'base'"),
    "no such child": (robot(*LINKS3[:2], joint("j0", "base", "z")), "'j0': its child link 'z' does not exist"),
    "no parent element": (robots.ARM.replace('<parent link="a"/>', ""), "'slide': names no parent link"),
    "negative mass": (robots.ARM.replace('mass value="2.0"', 'mass value="-2.0"'), "'a': its mass is -2 kg"),
    "negative moment": (robots.ARM.replace('iyy="0.06"', 'iyy="-0.06"'), "'a': its inertia has a negative"),
    "no mass": (robots.ARM.replace('<mass value="2.0"/>', ""), "'a': its <inertial> has no <mass>"),
    "no moment": (robots.ARM.replace('iyy="0.06"', ""), "'a': iyy of <inertia> is missing"),
    "zero axis": (robots.ARM.replace("0 3 4", "0 0 0"), "'slide': its axis is zero"),
    "two numbers": (robots.ARM.replace("0 3 4", "3 4"), "'slide': xyz of <axis> is '3 4'; 3 numbers expected"),
    "words": (robots.ARM.replace("0 3 4", "a b c"), "'slide': xyz of <axis> is 'a b c'"),
    "NaN": (robots.ARM.replace('mass value="2.0"', 'mass value="nan"'), "'a': value of <mass> is 'nan'"),
    "infinite": (robots.ARM.replace("0.1 0.2 0.3", "0.1 inf 0.3"), "'turn': xyz of <origin> is '0.1 inf 0.3'"),
    "two links of a name": (robot(*LINKS3, link("a"), *TWO), "two links are called 'a'"),
    "two joints of a name": (robot(*LINKS3, TWO[0], joint("j0", "a", "b")), "two joints are called 'j0'"),
    "no name": (robots.ARM.replace('name="slide"', ""), "a <joint> in line 1 has no name"),
    "no type": (robots.ARM.replace('type="prismatic"', ""), "'slide': has no type; known: revolute"),
    "mimic of a ball": (
        robot(*LINKS3, joint("j0", "base", "a", "floating"), joint("j1", "a", "b", more=FOLLOW.format(0))),
        "'j1' mimics 'j0', but 'j0' is free",
    ),
    "unknown type": (robots.ARM.replace("prismatic", "prismatc"), "'slide': unknown type 'prismatc'; did you mean 'pr"),
    "limits reversed": (
        robot(*LINKS3[:2], joint("j0", "base", "a", more='<limit lower="1" upper="-1"/>')),
        "'j0': its lower limit 1 is above",
    ),
    "mimic of nothing": (
        robot(*LINKS3, TWO[0], joint("j1", "a", "b", more=FOLLOW.format(9))),
        "'j1' mimics 'j9', which does not",
    ),
    "mimic of itself": (
        robot(*LINKS3, *(joint(f"j{k}", *"base a b".split()[k : k + 2], more=FOLLOW.format(1 - k)) for k in (0, 1))),
        "'j0' mimics itself by way of j0 -> j1 -> j0",
    ),
    "no joint moves": (robot(*LINKS3[:2], joint("j0", "base", "a", "fixed")), "no joint moves"),
    "no link": ("<robot name='r'/>", "the robot has no link"),
    "empty": ("  \n", "the file is empty"),
    "not XML": ("robot: {}", "not well-formed XML"),
    "unfinished": (robots.ARM[:200], "not well-formed XML"),
    "another root": ("<mujoco/>", "the root element is <mujoco>; a <robot> is expected"),
    "billion laughs": (
        '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>' + robots.ARM.replace("tiny", "&b;"),
        "declares a document type or an entity",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_malformed_file_is_refused_by_name(name: str, tmp_path: Path) -> None:
    text, message = BAD[name]
    with pytest.raises(InputError, match=message) as refusal:
        robots.load(text, tmp_path)
    assert str(refusal.value).startswith(str(tmp_path / "robot.urdf"))


OPTIONS = {
    "unknown joint": ({"joints": ["hip", "kne"]}, "joints: there is no joint 'kne'; did you mean 'knee'"),
    "joint twice": ({"joints": ["hip", "hip"]}, "two of the moving joints are called 'hip'"),
    "fixed joint": ({"joints": ["weld"]}, "joints: joint 'weld' is fixed"),
    "mimic joint": ({"joints": ["copy"]}, "joints: joint 'copy' mimics 'knee'; name that joint"),
    "text for joints": (
        {"joints": "knee"},
        r"joints is the text 'knee'; a list is expected, of one name too: \['knee'\]",
    ),
    "no joints": ({"joints": []}, "no joint moves"),
    "unknown posture": ({"posture": {"hop": 0.0}}, "posture: there is no joint 'hop'"),
    "posture of a moving joint": ({"joints": ["hip"], "posture": {"hip": 0.0}}, "'hip' is one of the moving joints"),
    "gravity of two numbers": ({"gravity": (0.0, -9.81)}, r"gravity is \(0.0, -9.81\); three finite numbers"),
    "gravity NaN": ({"gravity": (0.0, 0.0, float("nan"))}, "three finite numbers"),
    "posture NaN": ({"posture": {"hip": float("nan")}}, "posture: joint 'hip' is at nan"),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_wrong_joints_and_postures_are_refused_by_name(name: str, tmp_path: Path) -> None:
    options, message = OPTIONS[name]
    with pytest.raises(InputError, match=message):
        robots.load(robots.TREE, tmp_path, **options)


def test_one_joints_name_is_no_list_of_an_mjcf_either(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    file = tmp_path / "robot.xml"
    file.write_text(
        '<mujoco><worldbody><body><freejoint name="root"/><geom size=".1"/><body><joint name="j"/><geom size=".1"/>'
        "</body></body></worldbody></mujoco>"
    )
    for read in (fj.load_mjcf, fj.load_extended):
        with pytest.raises(InputError, match="joints is the text 'j'"):
            read(file, joints="j")


def test_files_that_are_no_text_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "binary.urdf").write_bytes(robots.ARM.encode("utf-16"))
    for name, message in (
        ("", "is a directory"),
        ("absent.urdf", "does not exist"),
        ("binary.urdf", "not a text file"),
    ):
        with pytest.raises(InputError, match=message):
            load_urdf(tmp_path / name)


def test_a_deep_chain_loads_without_recursion(tmp_path: Path) -> None:
    links = [link(f"l{k}") for k in range(1501)]
    joints = [joint(f"j{k}", f"l{k}", f"l{k + 1}", "revolute" if k == 0 else "fixed") for k in range(1500)]
    assert robots.load(robot(*links, *joints), tmp_path).nv == 1
