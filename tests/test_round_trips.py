"""What is read and written again is, for Pinocchio and MuJoCo C, the robot of the original file."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import equinox as eqx
import mujoco_c
import numpy as np
import pinocchio as pin
import pytest
import robots
from hypothesis import given, settings, strategies as st

import figaroh_jax as fj
from figaroh_jax.effects.extended import extend
from figaroh_jax.formats.export import load_model, write_model
from figaroh_jax.formats.mjcf import load_mjcf
from figaroh_jax.formats.native import physical_inertia
from figaroh_jax.formats.robotfile import load_extended
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.rigid.model import RobotModel

KINDS = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "mimic")
SEEDS = st.integers(0, 2**32 - 1)


def words(*numbers: float) -> str:
    return " ".join(repr(float(x)) for x in numbers)


def random_urdf(rng: np.random.Generator, joints: int) -> str:
    """A URDF tree with joints of all kinds; Pinocchio's planes are normal to z."""
    parts, free = [robots.link("l0")], []
    for k in range(joints):
        kind = str(rng.choice(KINDS)) if k else "revolute"
        xyz, rpy = words(*rng.normal(size=3)), words(*rng.uniform(-3, 3, 3))
        axis = "0 0 1" if kind == "planar" else words(*rng.normal(size=3))
        more = robots.LIMIT
        if kind == "mimic":
            kind, leader = "revolute", rng.choice(free)
            more += f'<mimic joint="{leader}" multiplier="{rng.normal()}" offset="{rng.normal()}"/>'
        elif kind in ("revolute", "prismatic"):
            free.append(f"j{k}")
        parent = f"l{rng.integers(k + 1)}"
        parts += [
            robots.link(f"l{k + 1}", rng.uniform(0.3, 2), words(*rng.normal(0, 0.2, 3)), words(*rng.normal(size=3))),
            robots.joint(f"j{k}", parent, f"l{k + 1}", kind, axis, xyz, rpy, more),
        ]
    return robots.robot(*parts)


def random_mjcf(rng: np.random.Generator, bodies: int) -> str:
    """An MJCF tree: bodies with none to three joints off their origins, turned frames, reference positions."""
    children: dict[int, list[int]] = {k: [] for k in range(bodies + 1)}
    for k in range(1, bodies + 1):
        children[int(rng.integers(k)) if k > 1 else 0].append(k)

    def joint(name: str) -> str:
        kind, limits = rng.choice(["hinge", "slide"]), 'range="-2 2" armature="0.01"'
        return (
            f'<joint name="{name}" type="{kind}" axis="{words(*rng.normal(size=3))}" {limits} '
            f'pos="{words(*rng.normal(0, 0.2, 3))}" ref="{rng.normal()}"/>'
        )

    def body(k: int) -> str:
        free = k == 1 and rng.random() < 0.5
        joints = "<freejoint/>" if free else "".join(joint(f"j{k}{i}") for i in range(rng.integers(k == 1, 4)))
        inertial = (
            f'<inertial pos="{words(*rng.normal(0, 0.2, 3))}" quat="{words(*rng.normal(size=4))}" '
            f'mass="{rng.uniform(0.3, 2)}" diaginertia="{words(*rng.uniform(0.02, 0.03, 3))}"/>'
        )
        inner = "".join(body(child) for child in children[k])
        pose = f'pos="{words(*rng.normal(size=3))}" quat="{words(*rng.normal(size=4))}"'
        return f'<body name="b{k}" {pose}>{joints}{inertial}<site name="s{k}" {pose}/>{inner}</body>'

    world = "".join(body(k) for k in children[0])
    return f'<mujoco><compiler angle="radian"/><worldbody>{world}</worldbody></mujoco>'


def in_pinocchio(model: RobotModel, urdf: str, states: list[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
    """Torques of the URDF text by Pinocchio, damping and friction too, at states of our model and in its columns."""
    theirs = pin.buildModelFromXML(urdf)
    data, torques = theirs.createData(), []
    for q, v, a in states:
        position, share = pin.neutral(theirs), np.zeros((theirs.nv, model.nv))
        for i, joint in enumerate(model.joints):
            found: Any = theirs.joints[theirs.getJointId(joint.name)]
            numbers = q[model.dofs.positions[i]]
            if joint.kind in ("revolute", "prismatic"):
                numbers = float(model.ratio[i]) * numbers + float(model.offset[i])
            if len(numbers) < found.nq:  # an angle as cosine and sine
                numbers = np.concatenate([numbers[:-1], np.cos(numbers[-1:]), np.sin(numbers[-1:])])
            position[found.idx_q : found.idx_q + found.nq] = numbers
            columns = slice(joint.coordinate, joint.coordinate + found.nv)
            share[found.idx_v : found.idx_v + found.nv, columns] = np.eye(found.nv) * float(model.ratio[i])
        rate = share @ v
        passive = theirs.damping * rate + theirs.friction * np.sign(rate)
        torques.append(share.T @ (pin.rnea(theirs, data, position, rate, share @ a) + passive))
    return torques


def same_tree(found: RobotModel, wanted: RobotModel) -> None:
    assert found.joints == wanted.joints
    for leaf in ("placement", "axis", "ratio", "offset", "gravity", "inertia"):
        pair = (np.asarray(getattr(model, leaf)) for model in (found, wanted))
        np.testing.assert_allclose(*pair, rtol=0, atol=1e-10, err_msg=leaf)
    frames = {frame.name: (frame.parent, pose) for frame, pose in zip(found.frames, found.frame_placement, strict=True)}
    for frame, pose in zip(wanted.frames, wanted.frame_placement, strict=True):
        assert frames[frame.name][0] == frame.parent
        np.testing.assert_allclose(frames[frame.name][1], pose, rtol=0, atol=1e-10, err_msg=frame.name)


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.integers(1, 8))
def test_a_urdf_is_for_pinocchio_and_mujoco_what_it_was(seed: int, joints: int) -> None:
    text = random_urdf(np.random.default_rng(seed), joints)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "first.urdf").write_text(text)
        model = load_urdf(folder / "first.urdf")
        write_model(extend(model), folder / "model")
        same_tree(load_urdf(folder / "model" / "robot.urdf"), model)
        same_tree(load_model(folder / "model").robot, model)
        states = mujoco_c.states(model, 2, seed)
        wanted = in_pinocchio(model, text, states)
        written = (folder / "model" / "robot.urdf").read_text()
        np.testing.assert_allclose(in_pinocchio(model, written, states), wanted, rtol=1e-10, atol=1e-9)
        theirs = mujoco_c.load(folder / "model" / "robot.xml", model, passive=False)
        torques = [theirs.torque(*state) for state in states]
        np.testing.assert_allclose(torques, wanted, rtol=1e-10, atol=1e-9)
        if {joint.kind for joint in model.joints} <= {"revolute", "prismatic"}:
            same_tree(load_mjcf(folder / "model" / "robot.xml"), model)


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.integers(1, 6))
def test_an_mjcf_is_for_mujoco_and_pinocchio_what_it_was(seed: int, bodies: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "first.xml").write_text(random_mjcf(np.random.default_rng(seed), bodies))
        model = load_mjcf(folder / "first.xml")
        write_model(extend(model), folder / "model")
        same_tree(load_mjcf(folder / "model" / "robot.xml"), model)
        same_tree(load_model(folder / "model").robot, model)
        states = mujoco_c.states(model, 2, seed)
        theirs = mujoco_c.load(folder / "first.xml", model, passive=False)
        wanted = [theirs.torque(*state) for state in states]
        written = (folder / "model" / "robot.urdf").read_text()
        np.testing.assert_allclose(in_pinocchio(model, written, states), wanted, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("name", robots.REAL)
def test_real_robots_lose_nothing_from_urdf_to_mjcf_to_urdf(name: str, data_dir: Path, tmp_path: Path) -> None:
    """Random drives at every joint; MuJoCo C reads the file in the middle, Pinocchio the first and the last."""
    robot = load_urdf(data_dir / robots.REAL[name])
    inertia = [physical_inertia(np.asarray(ten), "mjcf")[0] for ten in robot.inertia]  # MuJoCo refuses some
    robot = eqx.tree_at(lambda m: m.inertia, robot, np.array(inertia))
    rng = np.random.default_rng()
    damping, force, rotor = rng.uniform(0.1, 1, (3, robot.nv))
    drives = [
        fj.place(fj.CATALOGUE[kind], robot, [joint], **{parameter: value})
        for kind, parameter, values in (
            ("viscous_friction", "damping", damping),
            ("coulomb_friction", "force", force),
            ("rotor_inertia", "inertia", rotor),
        )
        for joint, value in zip(robot.joint_names, values, strict=True)
    ]
    write_model(extend(robot), tmp_path / "rigid")
    write_model(extend(robot, *drives), tmp_path / "first")
    middle, notes = load_extended(tmp_path / "first" / "robot.xml", joints=robot.joint_names)
    write_model(middle, tmp_path / "second")
    states = [(q, np.sign(v) * (1 + abs(v)), a) for q, v, a in mujoco_c.states(robot, 5)]
    rigid = in_pinocchio(robot, (tmp_path / "rigid" / "robot.urdf").read_text(), states)
    wanted = [t + damping * v + force * np.sign(v) + rotor * a for t, (_, v, a) in zip(rigid, states, strict=True)]
    theirs = mujoco_c.load(tmp_path / "first" / "robot.xml", robot, passive=True)
    np.testing.assert_allclose([theirs.torque(*s) for s in states], wanted, rtol=1e-11, atol=1e-9)
    last = in_pinocchio(robot, (tmp_path / "second" / "robot.urdf").read_text(), states)
    last = [torque + rotor * a for torque, (_, _, a) in zip(last, states, strict=True)]  # which URDF has no element for
    np.testing.assert_allclose(last, wanted, rtol=1e-11, atol=1e-9)
    assert notes == () and [e.name for e in middle.effects if e.name == "rotor_inertia"] == ["rotor_inertia"] * robot.nv
