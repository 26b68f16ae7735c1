"""Robots from OpenUSD: what the converters write is the robot it was, and what is no tree is refused by name.

`tests/stages` are this suite's own robots through `urdf-usd-converter` and `mujoco-usd-converter`
(`python benchmarks/usd.py --write tests/stages`); the robots of the data folder go through `benchmarks/usd.py`.
"""

from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import robots

from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.robotfile import impossible_said, load_extended, load_robot, read_robot
from figaroh_jax.formats.usd import load_usd
from figaroh_jax.rigid import dynamics, kinematics
from figaroh_jax.rollouts.reading import load_loop

pytest.importorskip("pxr", reason="usd-core is not installed (the extra `usd`)")

STAGES = Path(__file__).with_name("stages")
TEXTS = {"tree": robots.TREE, "gripper": robots.GRIPPER, "creature": robots.CREATURE, "beast": robots.BEAST}
LEAVES = ("placement", "axis", "inertia", "ratio", "offset", "gravity")
# of `general`, whose planar joints and bodies without mass the converters do not write, tests are below


def original(name: str, folder: Path) -> Any:
    file = folder / f"{name}.{'xml' if TEXTS[name].startswith('<mujoco') else 'urdf'}"
    file.write_text(TEXTS[name])
    return file


@pytest.mark.parametrize("name", TEXTS)
def test_a_converted_robot_is_the_one_of_its_file(name: str, tmp_path: Path) -> None:
    """Mimic joints, joints with a reference, anchors off the bodies, several joints of a body, inertias from shapes."""
    first, second = read_robot(original(name, tmp_path)), load_usd(STAGES / f"{name}.usda")
    assert [(j.kind, j.parent, j.coordinate, j.follows) for j in second.joints] == [
        (j.kind, j.parent, j.coordinate, j.follows) for j in first.joints
    ]
    for leaf in LEAVES:
        got, want = (np.asarray(getattr(model, leaf)) for model in (second, first))
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-6, err_msg=leaf)
    if name != "tree":  # whose stage has limits that its text lacks
        for leaf in ("position_limit", "effort_limit"):
            np.testing.assert_allclose(getattr(second, leaf), getattr(first, leaf), rtol=1e-6, atol=1e-6)
    shared = {frame.name for frame in first.frames} & {frame.name for frame in second.frames}
    assert {"tree": {"e", "c", "weld"}, "gripper": {"tool"}, "creature": {"imu"}, "beast": {"tip", "fin"}}[
        name
    ] <= shared
    for frame in shared - {"world"}:
        a, b = (m.frame_placement[m.frame_index(frame)] for m in (first, second))
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-6, err_msg=frame)


def test_what_acts_at_the_joints_is_that_of_the_mjcf(tmp_path: Path) -> None:
    """Armature, damping (per degree in the stage), dry friction and springs; tendons and gravcomp are noted."""
    want, _ = load_extended(original("creature", tmp_path))
    got, notes = load_extended(STAGES / "creature.usda")
    assert [effect.name for effect in got.effects] == [effect.name for effect in want.effects]
    q = np.asarray(read_robot(STAGES / "creature.usda").nq * [0.3])
    q[3:7] = [0.0, 0.0, 0.6, 0.8]
    q[-5:-1] = [0.0, 0.6, 0.0, 0.8]
    v, a = np.random.default_rng(2).uniform(-1, 1, (2, 10, want.robot.nv))
    states = np.tile(q, (10, 1)), v, a
    off = np.asarray(got.inverse_dynamics(*states)) - np.asarray(want.inverse_dynamics(*states))
    np.testing.assert_allclose(off, 0.0, rtol=0, atol=3e-5)
    assert notes == ()
    _, notes = load_extended(STAGES / "gripper.usda")
    assert notes == ("tendon 'belt'", "gravcomp of the bodies upper, fore")


# A stage of two bodies, hand-written: centimetres, grams, y up.

BODY = """def Xform "{name}" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"{more}])
{{
    double3 xformOp:translate = {at}
    uniform token[] xformOpOrder = ["xformOp:translate"]
    float physics:mass = {mass}
    point3f physics:centerOfMass = {com}
    float3 physics:diagonalInertia = {moments}
    quatf physics:principalAxes = (0.70710678, 0, 0, 0.70710678)
}}
"""


def body(name: str, mass: float = 500.0, at: str = "(0, 0, 0)", com: str = "(0, 0, 0)", **more: str) -> str:
    return BODY.format(name=name, mass=mass, at=at, com=com, moments=more.get("moments", "(2000, 3000, 4000)"), more="")


def joint(name: str, kind: str, ends: tuple[str, str], inside: str = "", schemas: str = "") -> str:
    rels = "".join(f"    rel physics:body{k} = </robot/{e}>\n" for k, e in enumerate(ends) if e)
    head = f"(prepend apiSchemas = [{schemas}])" if schemas else ""
    return f'def Physics{kind}Joint "{name}" {head}\n{{\n{rels}{inside}\n}}\n'


def stage(folder: Path, *parts: str, head: str = "", scene: str = "") -> Path:
    text = "".join(parts).replace("\n", "\n    ")
    path = folder / "robot.usda"
    path.write_text(
        f'#usda 1.0\n(\n    defaultPrim = "robot"\n{head}\n)\ndef Xform "robot"\n{{\n    {text}\n}}\n{scene}'
    )
    return path


CENTIMETRES = 'upAxis = "Y"\nmetersPerUnit = 0.01\nkilogramsPerUnit = 0.001'
HELD = joint("hold", "Fixed", ("base", ""))
SWING = """    uniform token physics:axis = "Z"
    point3f physics:localPos0 = (10, 0, 0)
    point3f physics:localPos1 = (0, 20, 0)
    float physics:lowerLimit = -90
    float physics:upperLimit = 45
    float drive:angular:physics:stiffness = 3
    float drive:angular:physics:damping = 0.5
    float drive:angular:physics:maxForce = 70000
    float physxJoint:maxJointVelocity = 180"""
DRIVE = '"PhysicsDriveAPI:angular"'


def test_units_the_up_axis_and_the_way_of_a_joint(tmp_path: Path) -> None:
    """A pendulum of 0.5 kg in grams, centimetres and degrees: its law is in kilograms, metres and radians."""
    bob = body("bob", com="(0, -10, 0)")
    path = stage(
        tmp_path, body("base"), bob, joint("swing", "Revolute", ("base", "bob"), SWING, DRIVE), HELD, head=CENTIMETRES
    )
    model = load_usd(path)
    assert model.joint_names == ("swing",)
    np.testing.assert_allclose(model.gravity, [0, -9.81, 0])
    np.testing.assert_allclose(model.position_limit, [[-np.pi / 2, np.pi / 4]], rtol=1e-6)
    np.testing.assert_allclose(model.velocity_limit, [np.pi], rtol=1e-6)
    np.testing.assert_allclose(model.effort_limit, [70000e-7], rtol=1e-6)
    q, a = np.array([0.7]), np.array([1.3])
    about = 4000e-7 + 0.5 * 0.3**2  # the principal axes are turned about z; the anchor is 20 above, the mass 10 below
    want = about * a + 0.5 * 9.81 * 0.3 * np.sin(q)
    np.testing.assert_allclose(dynamics.inverse_dynamics(model, q, 0 * q, a), want, rtol=1e-6)
    turned = joint(
        "swing",
        "Revolute",
        ("bob", "base"),
        SWING.replace("Pos0", "Pos2").replace("Pos1", "Pos0").replace("Pos2", "Pos1"),
    )
    again = load_usd(stage(tmp_path, body("base"), bob, turned, HELD, head=CENTIMETRES))
    np.testing.assert_allclose(again.axis, [[0, 0, -1]])
    np.testing.assert_allclose(again.placement, model.placement, atol=1e-12)
    assert read_robot(path, root="free_flyer").nv == 7
    assert load_usd(stage(tmp_path, body("base"), bob, turned, head=CENTIMETRES)).joint_names == ("root_joint", "swing")


def test_drives_are_those_of_the_loop(tmp_path: Path) -> None:
    parts = body("base"), body("bob"), joint("swing", "Revolute", ("base", "bob"), SWING, DRIVE), HELD
    loop, _ = load_loop(stage(tmp_path, *parts, head=CENTIMETRES))
    degree = np.pi / 180
    np.testing.assert_allclose(loop.drives.gain[0, 0], 3e-7 / degree, rtol=1e-6)
    np.testing.assert_allclose(loop.drives.bias[0, 1:3], [-3e-7 / degree, -0.5e-7 / degree], rtol=1e-6)
    pushed = joint(
        "swing",
        "Revolute",
        ("base", "bob"),
        SWING + '\n uniform token drive:angular:physics:type = "acceleration"',
        DRIVE,
    )
    with pytest.raises(InputError, match="joint 'swing': its drive is of type acceleration"):
        load_loop(stage(tmp_path, *parts[:2], pushed, HELD))


def locked(*tokens: str) -> tuple[str, str]:
    lines = "".join(f"    float limit:{t}:physics:low = 1\n    float limit:{t}:physics:high = -1\n" for t in tokens)
    return lines, ", ".join(f'"PhysicsLimitAPI:{t}"' for t in tokens)


@pytest.mark.parametrize(
    ("tokens", "kind"),
    [
        (("transX", "transY", "transZ", "rotX", "rotZ"), "revolute"),
        (("transX", "transZ", "rotX", "rotY", "rotZ"), "prismatic"),
        (("transX", "transY", "transZ"), "spherical"),
        (("transZ", "rotX", "rotY"), "planar"),
        ((), "free"),
    ],
)
def test_a_generic_joint_is_what_its_limits_leave(tokens: tuple[str, ...], kind: str, tmp_path: Path) -> None:
    free = joint("loose", "", ("base", "bob"), *locked(*tokens))
    model = load_usd(stage(tmp_path, body("base"), body("bob"), free, HELD))
    assert [j.kind for j in model.joints] == [kind]
    if kind in ("revolute", "prismatic"):
        np.testing.assert_array_equal(model.axis, [[0, 1, 0]])


THREE = body("base"), body("a"), body("b")
AB = joint("ab", "Revolute", ("a", "b"))
BASE_A, BASE_B = joint("ja", "Revolute", ("base", "a")), joint("jb", "Revolute", ("base", "b"))
TIE = joint("tie", "Revolute", ("a", "b"), "    uniform bool physics:excludeFromArticulation = 1")
ROPE, APART = joint("rope", "Distance", ("a", "b")), joint("cb", "Prismatic", ("c", "b"))
ODD = joint("odd", "", ("base", "a"), *locked("transX", "rotX"))
LIMITS = joint("ja", "Prismatic", ("base", "a"), "    float physics:lowerLimit = 1\n    float physics:upperLimit = 0")


def test_a_negative_moment_passes_for_postures_alone(tmp_path: Path) -> None:
    """Torques had taken it in silence; poses are those of the stage with moments that a body can have."""
    hinge = joint("swing", "Revolute", ("base", "bob"), SWING)
    sound = load_usd(stage(tmp_path, body("base"), body("bob"), hinge, HELD, head=CENTIMETRES))
    wrong = body("bob", moments="(-2000, 3000, 4000)")
    path = stage(tmp_path, body("base"), wrong, hinge, HELD, head=CENTIMETRES)
    with pytest.raises(
        InputError, match="robot.usda: link 'bob': its inertia has a negative principal moment, -0.0002"
    ):
        load_usd(path)
    (note,) = impossible_said(path)
    assert note.startswith("robot.usda: link 'bob': its inertia has a negative")
    q = np.array([[0.7], [-0.4]])
    poses = [kinematics.forward_kinematics(model, q) for model in (sound, load_usd(path, kinematic=True))]
    np.testing.assert_allclose(poses[1], poses[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ((*THREE, HELD, BASE_A, BASE_B, AB), r"joint 'ab' closes a kinematic loop: the body '/robot/b'.*'jb'"),
        ((*THREE, HELD, BASE_A, TIE), r"joint /robot/tie closes a kinematic"),
        ((*THREE, HELD, BASE_A, joint("weld", "Fixed", ("a", ""))), r"joint 'weld' closes a kinematic loop"),
        ((*THREE, body("c"), BASE_A, APART), r"2 separate robots begin at the bodies '/robot/base', '/robot/b'"),
        ((*THREE, HELD, BASE_A, ROPE), r"joint /robot/rope: a PhysicsDistanceJoint does not hold"),
        ((*THREE[:2], HELD, ODD), r"/robot/odd: its limits leave transY"),
        ((*THREE[:2], HELD, joint("ja", "Revolute", ("base", "no"))), r"joint /robot/ja: body1, /robot/no, does not"),
        ((*THREE, HELD), r"no joint that moves"),
        (('def Xform "base" {}',), r"no prim is a rigid body"),
        ((*THREE[:2], HELD, LIMITS), r"joint 'ja': its lower limit 0.01 is above"),
        ((THREE[0], body("a", -1.0), HELD, BASE_A), r"body 'a': its mass is -1 kg"),
    ],
)
def test_what_is_no_tree_is_refused_by_name(parts: tuple[str, ...], told: str, tmp_path: Path) -> None:
    path = stage(tmp_path, *parts)
    with pytest.raises(InputError, match=told) as error:
        load_usd(path)
    assert str(error.value).startswith(f"{path}: ")


MESH = """def Xform "bob" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])
{
    def Mesh "shell" (prepend apiSchemas = ["PhysicsCollisionAPI"])
    {
    }
}
"""


def test_an_inertia_that_nobody_states_is_asked_for(tmp_path: Path) -> None:
    parts = body("base"), MESH, joint("swing", "Revolute", ("base", "bob")), HELD
    with pytest.raises(
        InputError, match="body 'bob' states no inertia, and that of its collider /robot/bob/shell, a Mesh"
    ):
        load_usd(stage(tmp_path, *parts))
    ball = MESH.replace("Mesh", "Sphere").replace("    {\n", "    {\n        double radius = 0.2\n")
    model = load_usd(stage(tmp_path, body("base"), ball, *parts[2:], head="metersPerUnit = 1"))
    mass = 1000 * 4 / 3 * np.pi * 0.2**3
    sphere = pin.Inertia.FromSphere(mass, 0.2).toDynamicParameters()
    np.testing.assert_allclose(model.inertia[0], sphere, rtol=1e-9, atol=1e-9)


def test_files_that_are_no_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = tmp_path / "robot.usda"
    wrong.write_text("a stage this is not")
    with pytest.raises(InputError, match="OpenUSD does not read it"):
        load_usd(wrong)
    with pytest.raises(InputError, match="did you mean 'robot.usda'"):
        load_usd(tmp_path / "robto.usda")
    kept = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name.partition(".")[0] == "pxr":
            raise ImportError(name)
        return kept(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"pip install 'figaroh-jax\[usd\]'"):
        load_usd(STAGES / "tree.usda")


def test_a_task_takes_a_stage(tmp_path: Path) -> None:
    """Gravity is the stage's own where the task gives none; columns are in the task's order."""
    task = tmp_path / "task.yaml"
    head = f"robot: {{model: {STAGES / 'tree.usda'}, joints: [knee, hip]}}\n"
    task.write_text(head + "data: [{file: run.npz, rate: 100, position: q, torque: tau}]\n")
    model = load_robot(load_task(task))
    assert model.joint_names == ("knee", "hip")
    np.testing.assert_allclose(model.gravity, [0, 0, -9.81], rtol=1e-6)
