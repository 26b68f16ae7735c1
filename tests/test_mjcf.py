"""Reading MJCF: the tree, its dynamics and what acts at the joints, compared with MuJoCo C on the same file."""

from __future__ import annotations

from pathlib import Path

import mujoco
import mujoco_c
import numpy as np
import pinocchio as pin
import pytest
import robots
import tasks
import yaml

import figaroh_jax as fj
from figaroh_jax.effects.extended import extend, predict
from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.export import load_model, write_model
from figaroh_jax.formats.mjcf import compiled_robot, load_mjcf
from figaroh_jax.formats.robotfile import impossible_said, load_extended, load_robot, read_robot, stated_baseline
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.rigid.dynamics import inverse_dynamics, mass_matrix
from figaroh_jax.rigid.inertia import to_com
from figaroh_jax.rigid.kinematics import forward_kinematics
from figaroh_jax.rigid.model import RobotModel


def written(text: str, folder: Path) -> Path:
    path = folder / "robot.xml"
    path.write_text(text)
    return path


def stacked(model: RobotModel, samples: int) -> tuple[np.ndarray, ...]:
    return tuple(np.array(x) for x in zip(*mujoco_c.states(model, samples), strict=True))


def sliding(model: RobotModel, samples: int) -> tuple[np.ndarray, ...]:
    """States away from rest, where MuJoCo's dry friction is soft; neighbours turn against each other, as in a belt."""
    q, v, a = stacked(model, samples)
    return q, (0.5 + np.abs(v)) * (-1.0) ** np.arange(model.nv), a


@pytest.mark.parametrize("name", robots.MJCF)
def test_rigid_bodies_are_mujocos(name: str, tmp_path: Path) -> None:
    path = written(robots.MJCF[name], tmp_path)
    model = load_mjcf(path)
    theirs = mujoco_c.load(path, model, passive=False)
    q, v, a = stacked(model, 20)
    torques = [theirs.torque(*state) for state in zip(q, v, a, strict=True)]
    np.testing.assert_allclose(inverse_dynamics(model, q, v, a), torques, rtol=0, atol=1e-11)
    if name == "creature":
        masses = [theirs.mass_matrix(one) for one in q]
        np.testing.assert_allclose(mass_matrix(model, q), masses, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", robots.MJCF)
def test_bodies_and_sites_are_where_mujoco_has_them(name: str, tmp_path: Path) -> None:
    path = written(robots.MJCF[name], tmp_path)
    model = load_mjcf(path)
    theirs = mujoco_c.load(path, model, passive=False)
    q, v, a = stacked(model, 3)
    names = {frame.name for frame in model.frames}
    bodies, sites = ({getattr(theirs.mj, kind)(i).name for i in range(count)} - {""}
                     for kind, count in (("body", theirs.mj.nbody), ("site", theirs.mj.nsite)))  # fmt: skip
    assert bodies | sites <= names
    for one, tree in zip(q, np.asarray(forward_kinematics(model, q)), strict=True):
        theirs.set(one, v[0], a[0])
        mujoco.mj_forward(theirs.mj, theirs.data)
        for frame, placement in zip(model.frames, model.frame_placement, strict=True):
            if frame.name in bodies | sites:
                found = getattr(theirs.data, "body" if frame.name in bodies else "site")(frame.name)
                pose = (tree[frame.parent] if frame.parent >= 0 else np.eye(4)) @ placement
                np.testing.assert_allclose(pose[:3, 3], found.xpos, rtol=0, atol=1e-13, err_msg=frame.name)
                np.testing.assert_allclose(pose[:3, :3].ravel(), found.xmat, rtol=0, atol=1e-13, err_msg=frame.name)


@pytest.mark.parametrize("name", ["gripper", "creature"])
def test_what_acts_at_the_joints_is_mujocos(name: str, tmp_path: Path) -> None:
    path = written(robots.MJCF[name], tmp_path)
    extended, notes = load_extended(path)
    assert notes == ()
    theirs = mujoco_c.load(path, extended.robot, passive=True)
    q, v, a = sliding(extended.robot, 20)
    torques = np.array([theirs.torque(*state) for state in zip(q, v, a, strict=True)])
    if name == "gripper":
        torques[:, 2] += 1.5  # the actuator pushes by -0.5 times its gear of 3
    np.testing.assert_allclose(extended.inverse_dynamics(q, v, a), torques, rtol=0, atol=1e-9)


def test_a_body_with_several_joints_is_a_chain_with_massless_links(tmp_path: Path) -> None:
    model = load_mjcf(written(robots.CREATURE, tmp_path))
    assert [(j.name, j.kind, j.link) for j in model.joints[:5]] == [
        ("root_joint", "free", "torso"),
        ("hip_z", "revolute", "hip_z_link"),
        ("hip_x", "revolute", "hip_x_link"),
        ("thigh_joint", "prismatic", "thigh"),
        ("shank", "revolute", "shank"),
    ]
    assert not model.inertia[1:3].any() and model.inertia[3, 0] > 0
    assert (model.nq, model.nv) == (16, 14)
    np.testing.assert_allclose(model.position_limit[6], np.radians([-60, 60]))
    assert model.effort_limit[model.joint_index("wrist")] == 7


def test_a_joint_may_have_the_name_of_a_body(tmp_path: Path) -> None:
    """Of one that is fixed and not its own: MuJoCo keeps the names of joints and bodies apart."""
    mass = '<inertial pos=".1 0 0" mass="1" diaginertia=".1 .1 .1"/>'
    inner = f'<body name="inner" pos="0 .3 0"><joint name="outer" axis="0 1 0"/>{mass}</body>'
    text = f'<mujoco><worldbody><body name="outer" pos="0 0 1">{mass}{inner}</body></worldbody></mujoco>'
    path = written(text, tmp_path)
    model, theirs = load_mjcf(path), mujoco.MjModel.from_xml_path(str(path))
    assert model.joint_names == ("outer",)
    data = mujoco.MjData(theirs)
    data.qpos[:] = 0.4
    mujoco.mj_forward(theirs, data)
    for body in ("outer", "inner"):
        found = fj.frame_placement(model, np.array([0.4]), body)
        np.testing.assert_allclose(found[:3, 3], data.body(body).xpos, rtol=0, atol=1e-12)
    torque = inverse_dynamics(model, np.array([0.4]), np.zeros(1), np.zeros(1))
    np.testing.assert_allclose(torque, data.qfrc_bias, rtol=0, atol=1e-12)


def test_a_linear_coupling_is_a_mimic_joint_and_motors_bound_the_torque(tmp_path: Path) -> None:
    model = load_mjcf(written(robots.GRIPPER, tmp_path))
    assert model.joint_names == ("shoulder", "elbow", "left")
    assert model.joints[3].follows and model.joints[3].coordinate == 2
    np.testing.assert_allclose([model.ratio[3], model.offset[3]], [0.9, 0.02 + 0.005 - 0.9 * 0.01])
    np.testing.assert_allclose(model.effort_limit, [100.0, 160.0, np.inf])


def test_locked_joints_stand_where_the_file_has_them_or_the_posture_says(tmp_path: Path) -> None:
    path = written(robots.CREATURE, tmp_path)
    mj = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(mj)
    for posture in (
        {},
        {"hip_z": 0.3, "shoulder": [0.1, 0.2, 0.3, 0.9], "root_joint": [1.0, 2.0, 3.0, 0.0, 0.0, 0.6, 0.8]},
    ):
        data.qpos[:] = mj.qpos0
        for name, value in posture.items():
            at = mj.jnt_qposadr[0] if name == "root_joint" else mj.joint(name).qposadr[0]
            numbers = np.atleast_1d(np.asarray(value, float))
            numbers = numbers if len(numbers) == 1 else [*numbers[:-4], *np.roll(numbers[-4:], 1)]
            data.qpos[at : at + len(numbers)] = numbers
        mujoco.mj_kinematics(mj, data)
        model = load_mjcf(path, joints=["wrist"], posture=posture, root="fixed")
        assert model.joint_names == ("wrist",)
        frames = {frame.name: k for k, frame in enumerate(model.frames)}
        for name in ("imu", "strap"):
            pose = model.frame_placement[frames[name]]
            np.testing.assert_allclose(pose[:3, 3], data.site(name).xpos, rtol=0, atol=1e-13)
        np.testing.assert_allclose(model.frame_placement[frames["shank"]][:3, 3], data.body("shank").xpos, atol=1e-13)


def test_the_root_is_fixed_or_freed_as_asked(tmp_path: Path) -> None:
    walker = written(robots.quadruped(), tmp_path)
    fixed = load_mjcf(walker, root="fixed")
    assert fixed.nq == fixed.nv == 12
    for root in (None, "free_flyer"):
        assert load_mjcf(walker, root=root).joint_names[:2] == ("base", "abduct0")
        assert load_mjcf(walker, joints=["knee1", "swing1"], root=root).joint_names == ("base", "knee1", "swing1")
    locked = load_mjcf(walker, joints=["knee1"], posture={"base": [0.0] * 6 + [1.0]})
    assert locked.joint_names == load_mjcf(walker, joints=["knee1"], root="fixed").joint_names == ("knee1",)
    with pytest.raises(InputError, match="joint 'base' is free, but root is fixed"):
        load_mjcf(walker, joints=["base"], root="fixed")
    arm = written(robots.GRIPPER, tmp_path)
    freed = load_mjcf(arm, root="free_flyer")
    assert freed.joints[0][:5] == ("root_joint", "free", -1, 0, "table") and freed.nq == 10
    bare = robots.GRIPPER.replace('<body name="table" pos="0.5 0 0.7">', "<body name='table'><joint name='lift'/>")
    with pytest.raises(InputError, match="needs one body welded to the world to free; the world carries 'table'"):
        load_mjcf(written(bare, tmp_path), root="free_flyer")


def test_meshes_and_materials_are_never_looked_for_where_inertias_are_given(tmp_path: Path) -> None:
    assets = (
        '<asset><mesh name="m" file="no.stl"/><material name="k" texture="t"/>'
        '<texture name="t" type="2d" file="no.png"/></asset>'
    )
    looks = '<geom type="mesh" mesh="m" material="k"/><geom type="capsule" mesh="m"/>'
    text = robots.GRIPPER.replace("<worldbody>", assets + "<worldbody>" + looks)
    text = text.replace('<site name="tool"', looks + '<site name="tool"')
    plain = load_mjcf(written(robots.GRIPPER, tmp_path))
    np.testing.assert_array_equal(load_mjcf(written(text, tmp_path)).inertia, plain.inertia)
    heavy = text.replace('<inertial pos="0.02 0 0.15" mass="2" diaginertia="0.02 0.02 0.004"/>', "")
    with pytest.raises(InputError, match="MuJoCo does not compile it: .*no.stl"):
        load_mjcf(written(heavy, tmp_path))


EQUALITY = '<equality><joint joint1="right" joint2="left" polycoef="0.005 0.9 0 0 0"/></equality>'
FOLLOWS = '<joint joint1="{}" joint2="{}"/>'
REFUSED = {
    "loop": (
        '<connect name="pin" body1="left" body2="table" anchor="0 0 0"/>',
        "connect 'pin' between bodies 'left' and 'table' closes a kinematic loop",
    ),
    "weld": ('<weld body1="right" body2="upper"/>', "the weld 'number 0' between bodies 'right' and 'upper' closes"),
    "curve": ('<joint joint1="right" joint2="left" polycoef="0 1 2 0 0"/>', "'right' follows 'left' by a curve"),
    "twice": (FOLLOWS.format("right", "left") + FOLLOWS.format("right", "elbow"), "'right' is coupled by two"),
    "each other": (FOLLOWS.format("right", "left") + FOLLOWS.format("left", "right"), "mimics itself by way of"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_loops_and_curved_couplings_are_refused_by_name(name: str, tmp_path: Path) -> None:
    equality, message = REFUSED[name]
    path = written(robots.GRIPPER.replace(EQUALITY, f"<equality>{equality}</equality>"), tmp_path)
    with pytest.raises(InputError, match=message) as refusal:
        load_mjcf(path)
    assert str(path) in str(refusal.value)


def test_a_loop_of_locked_joints_or_one_that_is_not_active_does_not_matter(tmp_path: Path) -> None:
    loop = '<equality><weld body1="right" body2="fore"/></equality>'
    assert load_mjcf(written(robots.GRIPPER.replace(EQUALITY, loop), tmp_path), joints=["shoulder", "elbow"]).nv == 2
    loop = loop.replace("<weld", '<weld active="false"')
    assert load_mjcf(written(robots.GRIPPER.replace(EQUALITY, loop), tmp_path)).nv == 4


def test_a_joint_held_by_an_equality_does_not_move(tmp_path: Path) -> None:
    held = '<equality><joint joint1="right" polycoef="0.015 0 0 0 0"/></equality>'
    model = load_mjcf(written(robots.GRIPPER.replace(EQUALITY, held), tmp_path))
    assert model.joint_names == ("shoulder", "elbow", "left")
    frame = model.frames.index(next(f for f in model.frames if f.name == "right"))
    np.testing.assert_allclose(model.frame_placement[frame][:3, 3], [0, -0.03 - 0.015, 0.3], rtol=0, atol=1e-15)


IMPOSSIBLE = {  # what MuJoCo refuses: its own words, our note, the moments about the centre of mass
    "negative": ('diaginertia="-.1 .1 .2"', "A [+] B >= C", "negative principal moment, -0.1", [-0.1, 0.1, 0.2]),
    "nothing": ('diaginertia="0 0 0"', "larger than mjMINVAL", "", [0.0, 0.0, 0.0]),
    "sums": ('diaginertia=".1 .1 .5"', "A [+] B >= C", "moments 0.1, 0.1 and 0.5 kg m", [0.1, 0.1, 0.5]),
    "full": ('fullinertia=".1 .1 .2 .3 0 0"', "positive eigenvalues", "negative principal moment, -0.2 kg m", None),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_moments_that_mujoco_refuses_pass_for_postures_alone(name: str, tmp_path: Path) -> None:
    """Poses are MuJoCo's of the same file with moments that it takes; the link keeps the numbers of the file."""
    attribute, refused, told, moments = IMPOSSIBLE[name]
    about = np.diag(moments) if moments else np.array([[0.1, 0.3, 0], [0.3, 0.1, 0], [0, 0, 0.2]])
    text = (
        '<mujoco><worldbody><body name="a" pos="0 0 .2"><joint name="j" axis="0 0 1"/><inertial pos="0 0 0" mass="1"'
        ' diaginertia=".1 .1 .1"/><body name="b" pos=".3 0 0" euler="20 30 0"><joint name="k" axis="0 1 0"/><inertial'
        ' pos=".1 0 0" mass="2" {}/><site name="tip" pos=".1 .2 .3"/></body></body></worldbody></mujoco>'
    )
    (tmp_path / "sound.xml").write_text(text.format('diaginertia=".1 .1 .1"'))
    path = written(text.format(attribute), tmp_path)
    with pytest.raises(InputError, match=refused):
        load_mjcf(path)
    notes = impossible_said(path)  # none of zero moments, those of a point
    assert len(notes) == bool(told) and all(told in note and "robot.xml: link 'b': its" in note for note in notes)
    assert impossible_said(tmp_path / "sound.xml") == ()
    model = load_mjcf(path, kinematic=True)
    mass, com, got = to_com(np.asarray(model.inertia[1]))
    np.testing.assert_allclose([mass, *com], [2, 0.1, 0, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(got, about, rtol=0, atol=1e-12)
    mj = mujoco.MjModel.from_xml_path(str(tmp_path / "sound.xml"))
    data, q = mujoco.MjData(mj), np.array([0.4, -1.1])
    data.qpos[:] = q
    mujoco.mj_kinematics(mj, data)
    pose = fj.frame_placement(model, q, "tip")
    np.testing.assert_allclose(pose[:3, 3], data.site("tip").xpos, rtol=0, atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3].ravel(), data.site("tip").xmat, rtol=0, atol=1e-12)


def test_files_that_mujoco_does_not_take_are_refused(tmp_path: Path) -> None:
    for text, message in (
        (robots.GRIPPER.replace("axis=", "axes="), "MuJoCo does not compile it: .*axes"),
        (robots.GRIPPER.replace('joint="elbow"', 'joint="elbo"'), "MuJoCo does not compile it: .*elbo"),
        ("<robot/>", "the root element is <robot>; a <mujoco> is expected"),
        ("<mujoco/>", "no joint moves"),
        ("", "is empty"),
    ):
        with pytest.raises(InputError, match=message):
            load_mjcf(written(text, tmp_path))
    with pytest.raises(InputError, match="a robot model is a .urdf or an .xml"):
        read_robot(tmp_path / "robot.sdf")


UNSAID = {
    "spring of a ball": ('type="ball"', 'type="ball" stiffness="3"', "spring of joint 'shoulder'"),
    "armature of a free joint": ("<freejoint/>", '<joint type="free" armature="0.1"/>', "free joint 'root_joint'"),
    "fluid": ("<option ", '<option density="1.2" ', "forces of the fluid"),
    "curved spring": ('stiffness="40"', 'stiffness="40 5"', "square and cubic stiffness of joint 'thigh_joint'"),
    "range of a ball": ('type="ball"', 'type="ball" range="0 30" limited="true"', "range of joint 'shoulder'"),
    "gravcomp of the drives": ('name="wrist"', 'name="wrist" actuatorgravcomp="true"', "gravcomp: at wrist it is part"),
    "uneven gravcomp": ('name="pack"', 'name="pack" gravcomp="1"', "gravcomp of link 'torso'"),
}


@pytest.mark.parametrize("name", UNSAID)
def test_what_no_effect_stands_for_is_noted(name: str, tmp_path: Path) -> None:
    old, new, message = UNSAID[name]
    text = robots.CREATURE.replace(old, new, 1)
    if name == "gravcomp of the drives":
        text = text.replace('name="hand"', 'name="hand" gravcomp="1"')
    (note,) = load_extended(written(text, tmp_path)).notes
    assert note.startswith(message) or message in note


def test_tendons_of_one_joint_act_there_and_others_are_noted(tmp_path: Path) -> None:
    text = robots.GRIPPER.replace('coef="-2"', 'coef="0"')
    extended, notes = load_extended(written(text, tmp_path))
    at_shoulder = {e.name: e for e in extended.effects if tuple(e.at) == (0,) and e.acts_on == "joint"}
    assert notes == () and "coupled_transmission" not in {effect.name for effect in extended.effects}
    # of joint, actuator through its gear, tendon through its coefficient
    expected = {"inertia": 50**2 * 1e-4 + 4 * 0.03, "damping": 50**2 * 2e-4 + 4 * 0.6, "force": 0.4 + 2 * 0.2}
    found = {key: float(getattr(e, key)) for e in at_shoulder.values() for key in e.parameters()}
    assert found == pytest.approx(expected, rel=1e-12)
    uneven = robots.GRIPPER.replace('coef="-2"', 'coef="1"')
    (note,) = load_extended(written(uneven, tmp_path)).notes
    assert note.startswith("armature, damping, frictionloss of tendon 'belt'")
    (note,) = load_extended(written(robots.GRIPPER.replace("<fixed ", '<fixed stiffness="3" '), tmp_path)).notes
    assert note == "spring of tendon 'belt'"


@pytest.mark.parametrize("name", robots.MJCF)
def test_what_acts_at_the_joints_comes_back_from_the_written_mjcf_and_folder(name: str, tmp_path: Path) -> None:
    extended, _ = load_extended(written(robots.MJCF[name], tmp_path))
    write_model(extended, tmp_path / "model")
    again, notes = load_extended(tmp_path / "model" / "robot.xml")
    assert notes == ()
    for found in (again, load_model(tmp_path / "model")):
        assert found.robot.joints == extended.robot.joints
        for leaf in ("placement", "axis", "inertia", "ratio", "offset", "gravity"):
            pair = (np.asarray(getattr(model.robot, leaf)) for model in (found, extended))
            np.testing.assert_allclose(*pair, rtol=0, atol=1e-11, err_msg=leaf)
        for back, effect in zip(found.effects, extended.effects, strict=True):
            assert (back.name, *back.at) == (effect.name, *effect.at)
            values = [[float(getattr(e, key)) for key in effect.parameters()] for e in (back, effect)]
            np.testing.assert_allclose(*values, rtol=1e-12, atol=1e-15)


def test_simulation_and_sensors_refuse_joints_of_several_axes_by_name(tmp_path: Path) -> None:
    extended = extend(load_mjcf(written(robots.quadruped(), tmp_path)))
    q, v, a = stacked(extended.robot, 6)
    with pytest.raises(InputError, match="a simulation takes revolute and prismatic joints; joint 'base' of robot"):
        fj.simulate(extended, v, q[0], v[0], 0.01)
    with pytest.raises(InputError, match="a record of sensors takes .* joint 'base' of robot 'quadruped' is free"):
        predict(extended, np.arange(6) * 0.01, v, v, a, 0.01)


def test_what_differs_between_the_axes_of_a_joint_is_listed_and_not_written(tmp_path: Path) -> None:
    model = load_mjcf(written(robots.CREATURE, tmp_path))
    effects = [
        fj.place(fj.CATALOGUE["viscous_friction"], model, ["shoulder.wx"], damping=0.5),
        fj.place(fj.CATALOGUE["coulomb_friction"], model, ["root_joint.vz"], force=1.0),
        fj.place(fj.CATALOGUE["coupled_transmission"], model, ["shoulder.wx", "wrist"], friction=1.0),
        *(fj.place(fj.CATALOGUE["rotor_inertia"], model, [f"shoulder.w{k}"], inertia=0.1) for k in "xyz"),
    ]
    write_model(extend(model, *effects), tmp_path / "model")
    answer = yaml.safe_load((tmp_path / "model" / "effects.yaml").read_text())
    assert [effect["mjcf"] for effect in answer["effects"]] == [False, False, False, True, True, True]
    assert "damping of one axis of the spherical joint shoulder" in answer["effects"][0]["not in mjcf"]
    assert answer["effects"][1]["parameters"]["force"]["unit"] == "N"
    assert len(load_model(tmp_path / "model").effects) == 6


def test_urdf_dynamics_are_pinocchios(tmp_path: Path) -> None:
    more = robots.LIMIT + '<dynamics damping="{}" friction="{}"/>'
    follow = more.format(0.5, 0.2) + '<mimic joint="j0" multiplier="-1.5" offset="0.3"/>'
    joints = [
        robots.joint("j0", "base", "a", more=more.format(1.5, 0.7)),
        robots.joint("j1", "a", "b", "prismatic", more=more.format(0.4, 0)),
        robots.joint("j2", "b", "c", more=follow),
    ]
    text = robots.robot(*robots.LINKS[:4], *joints)
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    extended, notes = load_extended(path)
    q, v, a = robots.states(extended.robot, 5)
    theirs = pin.buildModelFromXML(text.replace('<mimic joint="j0" multiplier="-1.5" offset="0.3"/>', ""))
    share = np.array([[1, 0], [0, 1], [-1.5, 0]])
    torques = []
    for position, velocity, acceleration in zip(q @ share.T + [0, 0, 0.3], v @ share.T, a @ share.T, strict=True):
        rigid = pin.rnea(theirs, theirs.createData(), position, velocity, acceleration)
        torques.append(share.T @ (rigid + theirs.damping * velocity + theirs.friction * np.sign(velocity)))
    assert notes == ()
    np.testing.assert_allclose(extended.inverse_dynamics(q, v, a), torques, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", ["ur10e", "panda", "talos"])  # the others have inertias that MuJoCo refuses
def test_real_robots_are_the_same_where_mujoco_reads_the_urdf_itself(name: str, data_dir: Path) -> None:
    """MuJoCo's own reader of URDF makes the compiled model that is read here: nothing of ours is in between."""
    urdf = data_dir / robots.REAL[name]
    spec = mujoco.MjSpec.from_string(robots.without_looks(urdf.read_text()))
    spec.compiler.fusestatic = False
    theirs, ours = compiled_robot(name, spec.compile(), gravity=(0.0, 0.0, -9.81)), load_urdf(urdf)
    back = [ours.joint_names.index(joint) for joint in theirs.joint_names]
    assert len(back) == ours.nv and {f.name for f in theirs.frames} >= set(ours.link_names)
    q, v, a = robots.states(ours, 3)
    found = inverse_dynamics(theirs, q[:, back], v[:, back], a[:, back])
    np.testing.assert_allclose(found, np.asarray(inverse_dynamics(ours, q, v, a))[:, back], rtol=0, atol=1e-9)


def test_a_task_takes_an_mjcf_model(tmp_path: Path) -> None:
    tasks.write(tmp_path)
    written(robots.GRIPPER, tmp_path)
    for gravity, expected in ((None, (0, 0, -9.81)), ([0, 0, -1.62], (0, 0, -1.62))):
        keys = tasks.task()
        keys["robot"] = {"model": "robot.xml", "joints": ["elbow", "shoulder"]} | (
            {"gravity": gravity} if gravity else {}
        )
        model = load_robot(load_task(tasks.write(tmp_path, keys)))
        assert model.joint_names == ("elbow", "shoulder") and tuple(model.gravity) == expected


def test_what_a_model_file_says_of_the_joints_is_in_the_baseline_or_noted(tmp_path: Path) -> None:
    tasks.write(tmp_path)
    written(robots.GRIPPER, tmp_path)
    keys = tasks.task() | {"baseline": {"rotor": True}}
    keys["robot"] = {"model": "robot.xml", "joints": ["elbow", "shoulder"], "posture": {"left": 0.02}}
    known, notes = stated_baseline(load_task(tasks.write(tmp_path, keys)))
    assert notes == (
        "robot.xml: power_law_friction (elbow) of the file is not used: a baseline takes no such shape",
        "robot.xml: coupled_transmission (elbow, shoulder) of the file is not used: a baseline takes no such shape",
        "robot.xml: gravity_compensation (upper) of the file is part of the baseline: its size is fitted",
        "robot.xml: not read: gravcomp of link 'fore', whose welded bodies differ in it",
    )
    added = [(entry.effect, entry.at) for entry in known.effects]
    assert added == [("gravity_compensation", ("upper",))]
    switched = {}
    for baseline in ({}, {"rotor": False}):
        read, notes = stated_baseline(load_task(tasks.write(tmp_path, keys | {"baseline": baseline})))
        switched[len(baseline)] = [entry.at for entry in read.effects if entry.effect == "rotor_inertia"]
        assert any("rotor_inertia" in note and ("leaves it out" in note) == bool(baseline) for note in notes)
    assert switched[0] and not switched[1]
    task = load_task(tasks.write(tmp_path))
    assert stated_baseline(task) == (task.baseline, ())


@pytest.mark.slow
def test_the_demo_has_the_same_verdict_with_an_mjcf_model(tmp_path: Path) -> None:
    demo = Path(fj.__file__).parent / "demo"
    keys = yaml.safe_load((demo / "task.yaml").read_text())
    for entry in keys["data"]:
        entry["file"] = str(demo / entry["file"])
    urdf = demo / keys["robot"]["model"]
    write_model(extend(load_urdf(urdf)), tmp_path)
    answers = []
    for model in (urdf, tmp_path / "robot.xml"):
        keys["robot"]["model"] = str(model)
        (tmp_path / "task.yaml").write_text(yaml.safe_dump(keys))
        answers.append(fj.diagnose_task(load_task(tmp_path / "task.yaml")))
    first, second = answers
    assert first.verdict == second.verdict and [c.name for c in first.causes] == [c.name for c in second.causes]
    for ours, theirs in zip(first.causes, second.causes, strict=True):
        for name, estimate in ours.parameters.items():
            np.testing.assert_allclose(theirs.parameters[name].value, estimate.value, rtol=1e-6, atol=0)


def test_nothing_acts_at_the_joints_of_a_plain_robot(tmp_path: Path) -> None:
    extended, notes = load_extended(written(robots.quadruped().replace('armature="0.005"', ""), tmp_path), root="fixed")
    assert notes == () and {effect.name for effect in extended.effects} == {"viscous_friction", "coulomb_friction"}
    assert extend(extended.robot).effects == ()
