"""Recordings have their columns in the order of the log, which need not be that of the tree: ROS sorts by name."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
import pytest
import robots
import yaml

import figaroh_jax as fj
from figaroh_jax.calibration.kinematic_diagnosis import diagnose_poses
from figaroh_jax.cli import main
from figaroh_jax.diagnosis.problem import Part
from figaroh_jax.effects.kinematic import CATALOGUE as POSES
from figaroh_jax.formats.urdf import load_urdf

DEMO = Path(fj.DEMO).parent

# the first branch is that of the last joint by name
BRANCHES = robots.robot(
    *robots.LINKS,
    robots.joint("shoulder", "base", "a", axis="0 1 0", more=robots.LIMIT),
    robots.joint("elbow", "a", "b", axis="1 0 1", more=robots.LIMIT),
    robots.joint("finger", "b", "c", "prismatic", "1 1 0", more=robots.LIMIT),
    robots.joint("head", "a", "d", "continuous", "0 1 0.5"),
)


@pytest.mark.parametrize("robot", ["branches", "talos"])
def test_columns_of_links_stand_at_the_joints_of_the_recording(
    robot: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """Beside Pinocchio's inverse dynamics, a random order of the joints."""
    file = tmp_path / "robot.urdf"
    if robot == "talos":
        file = request.getfixturevalue("data_dir") / robots.REAL["talos"]
    else:
        file.write_text(BRANCHES)
    their, rng = pin.buildModelFromUrdf(str(file)), np.random.default_rng()
    names = [str(n) for n in rng.permutation(list(their.names)[1:])]
    ours = load_urdf(file, joints=names)
    assert ours.dof_names == tuple(names)
    q, v, a = rng.normal(size=(3, 200, ours.nv))
    theirs = [their.joints[their.getJointId(name)] for name in names]
    at_q, at_v = np.zeros((200, their.nq)), np.zeros((2, 200, their.nv))
    for k, joint in enumerate(theirs):
        own = [np.cos(q[:, k]), np.sin(q[:, k])] if joint.nq == 2 else [q[:, k]]
        at_q[:, joint.idx_q : joint.idx_q + joint.nq] = np.stack(own, axis=1)
        at_v[:, :, joint.idx_v] = v[:, k], a[:, k]
    data = their.createData()
    torque = np.array([pin.rnea(their, data, *row) for row in zip(at_q, *at_v, strict=True)])
    expected = torque[:, [joint.idx_v for joint in theirs]]
    part, theta = Part.of_rigid(ours, [q, v, a]), np.asarray(ours.inertia).reshape(-1)
    size = np.abs(expected).max()
    np.testing.assert_allclose(part.torque(theta), expected, rtol=0, atol=1e-11 * size)  # by inverse dynamics
    np.testing.assert_allclose(part.torque(theta, slice(0, 200)), expected, rtol=0, atol=1e-11 * size)  # by columns
    dense = part.dense(range(len(theta))).transpose(2, 1, 0)
    np.testing.assert_allclose(dense @ theta, expected, rtol=0, atol=1e-11 * size)


@pytest.mark.parametrize(
    "order",
    [
        ["elbow", "shoulder", "waist", "wrist"],
        pytest.param(["wrist", "elbow", "shoulder", "waist"], marks=pytest.mark.slow),
    ],
)
def test_what_is_missing_does_not_depend_on_the_order_of_columns(order: list[str], tmp_path: Path) -> None:
    """The demo by the command line, its columns as they are (in the order of the tree), by name and from the end.

    Both causes are found, at their size.
    """
    task = yaml.safe_load((DEMO / "task.yaml").read_text())
    place = [task["robot"]["joints"].index(name) for name in order]
    task["robot"] |= {"model": fj.DEMO, "joints": order}
    for entry in task["data"]:
        with np.load(DEMO / entry["file"]) as file:
            np.savez(tmp_path / entry["file"], **{key: file[key][:, place] for key in ("q", "tau")})
    (tmp_path / "task.yaml").write_text(yaml.safe_dump(task))
    told = []
    for file in (DEMO / "task.yaml", tmp_path / "task.yaml"):
        assert main(["diagnose", str(file), "--out", str(tmp_path / str(len(told))), "--quiet"]) == 0
        told.append(json.loads((tmp_path / str(len(told)) / "answer.json").read_text()))
    as_it_is, turned = told
    hidden = yaml.safe_load((DEMO / "truth.yaml").read_text())["causes"]
    assert {(c["effect"], *sorted(c["at"])) for c in turned["causes"]} == {
        (c["effect"], *sorted(c["at"])) for c in hidden
    }
    assert turned["verdict"] == as_it_is["verdict"] == "named"
    found = {(c["effect"], *c["at"]): c["parameters"] for c in as_it_is["causes"]}
    assert set(found) == {(c["effect"], *c["at"]) for c in hidden}
    for cause in hidden:
        for name, value in cause["parameters"].items():
            assert abs(found[cause["effect"], *cause["at"]][name]["value"] - value) < 0.25 * abs(value), (name, found)
    for one, other in zip(as_it_is["causes"], turned["causes"], strict=True):
        assert (one["effect"], set(one["at"])) == (other["effect"], set(other["at"]))
        for key, value in one["parameters"].items():
            assert other["parameters"][key]["value"] == pytest.approx(value["value"], rel=1e-6, abs=0)
    assert turned["holdout"]["after"] == pytest.approx(as_it_is["holdout"]["after"], rel=1e-6, abs=0)
    names = {file: list(told[k]["holdout"]["joints"]) for k, file in enumerate(("tree", "turned"))}
    assert names["turned"] == order != names["tree"]
    for name in order:
        assert turned["holdout"]["joints"][name] == pytest.approx(as_it_is["holdout"]["joints"][name], rel=1e-6, abs=0)


ARM = [f"arm_left_{k}_joint" for k in range(1, 8)]
SEEN: dict[str, Any] = {"base_frame": "torso_2_link", "tool_frame": "gripper_left_base_link"}


def _arm(data_dir: Path, names: list[str], rng: np.random.Generator, postures: int) -> tuple[np.ndarray, Callable]:
    """Positions of TALOS's left arm, columns as `names`, and Pinocchio's pose of the tool where they stand so."""
    their = pin.buildModelFromUrdf(str(data_dir / robots.REAL["talos"]))
    state = their.createData()
    at = [their.joints[their.getJointId(name)] for name in names]
    low, high = (
        np.array([limit[j.idx_q] for j in at]) for limit in (their.lowerPositionLimit, their.upperPositionLimit)
    )
    frames = [their.getFrameId(SEEN[key]) for key in ("base_frame", "tool_frame")]

    def pose(position: np.ndarray) -> np.ndarray:
        q = pin.neutral(their)
        q[[j.idx_q for j in at]] = position
        pin.framesForwardKinematics(their, state, q)
        base, tool = (state.oMf[k].homogeneous for k in frames)
        return np.linalg.inv(base) @ tool

    return rng.uniform(low, high, (postures, len(names))), pose


@pytest.mark.slow
def test_effects_of_postures_act_at_the_joints_of_the_recording(data_dir: Path) -> None:
    """Where the tool stands while a sensor reads wrong, beside Pinocchio; a random order of the joints."""
    rng = np.random.default_rng()
    names = [str(n) for n in rng.permutation(ARM)]
    q, pose = _arm(data_dir, names, rng, 20)
    robot = fj.load_urdf(data_dir / robots.REAL["talos"], joints=names)
    gear, scaled, ahead, behind = (str(n) for n in rng.permutation(ARM)[:4])
    place = {name: names.index(name) for name in ARM}
    offset = {"sine": 0.03, "cosine": -0.02, "order": 3.0}
    effects = (
        fj.place(fj.CATALOGUE["encoder_scale"], robot, [scaled], scale=0.04),
        fj.place(POSES["gear_transmission_error"], robot, [gear], **offset),
        fj.place(POSES["joint_coupling"], robot, [ahead, behind], ratio=0.05),
        fj.place(POSES["settling"], robot, amount=0.1),
    )
    true, before = q.copy(), np.vstack([q[:1], q[:-1]])
    true[:, place[scaled]] -= 0.04 * q[:, place[scaled]]
    angle = 3.0 * q[:, place[gear]]
    true[:, place[gear]] -= 0.03 * np.sin(angle) - 0.02 * np.cos(angle)
    true[:, place[behind]] -= 0.05 * q[:, place[ahead]]
    true -= 0.1 * (q - before)
    run = fj.postures(q=q, pose=np.array([pose(x) for x in true]), unknown=(), **SEEN)
    rows = np.asarray(fj.pose_data(robot, run)[0].residual(fj.extend(robot, *effects)))
    np.testing.assert_allclose(rows, 0.0, rtol=0, atol=1e-12)


def test_a_bent_link_is_that_of_the_recording(tmp_path: Path) -> None:
    """An effect with a twist: the same poses whatever the order of the joints."""
    (tmp_path / "robot.urdf").write_text(BRANCHES)
    whole = fj.load_urdf(tmp_path / "robot.urdf")
    chain = list(whole.joint_names)
    q = np.random.default_rng().uniform(-1.0, 1.0, (10, len(chain)))
    run: dict[str, Any] = {"pose": np.asarray(fj.frame_placement(whole, q, "c")), "unknown": ()}
    run |= {"base_frame": "base", "tool_frame": "c"}
    told = []
    residual = eqx.filter_jit(lambda data, model: data.residual(model))  # as one program: it has 200 operations
    for names in (chain, chain[::-1]):
        robot = fj.load_urdf(tmp_path / "robot.urdf", joints=names)
        effect = fj.place(POSES["link_compliance"], robot, ["shoulder"], first=1e-3, second=-2e-3)
        seen = fj.postures(q=q[:, [chain.index(n) for n in names]], **run)
        told.append(np.asarray(residual(fj.pose_data(robot, seen)[0], fj.extend(robot, effect))))
    assert np.abs(told[0]).max() > 1e-3
    np.testing.assert_allclose(told[1], told[0], rtol=0, atol=1e-12)


def test_a_calibration_names_the_joint_of_the_recording(data_dir: Path, tmp_path: Path) -> None:
    """A gear error hidden at a joint by Pinocchio; columns in a random order."""
    rng = np.random.default_rng()
    names = [str(n) for n in rng.permutation(ARM)]
    while names in (ARM, ARM[::-1]):
        names = [str(n) for n in rng.permutation(ARM)]
    q, pose = _arm(data_dir, names, rng, 150)
    hidden = str(rng.choice(ARM[1:5]))
    true = q.copy()
    true[:, names.index(hidden)] += 4e-3 * np.sin(4.0 * q[:, names.index(hidden)])
    seen = np.array([pose(x) for x in true])
    seen[:, :3, 3] += 1e-4 * rng.normal(size=(len(q), 3))
    seen[:, :3, :3] = [R @ pin.exp3(2e-4 * rng.normal(size=3)) for R in seen[:, :3, :3]]
    np.savez(tmp_path / "poses.npz", q=q, m=seen)
    task = {
        "robot": {"model": str(data_dir / robots.REAL["talos"]), "joints": names},
        "data": [{"file": "poses.npz", "position": "q", "measurement": {"pose": "m", **SEEN, "unknown": []}}],
    }
    (tmp_path / "task.yaml").write_text(yaml.safe_dump(task))
    assert main(["calibrate", str(tmp_path / "task.yaml"), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    told = json.loads((tmp_path / "run" / "result.json").read_text())
    (cause,) = [c for c in told["causes"] if c["effect"] != "joint_offset"]
    assert (cause["effect"], cause["at"]) == ("gear_transmission_error", [hidden])
    assert cause["parameters"]["order"]["value"] == pytest.approx(4.0, rel=0, abs=0.1)
    assert np.hypot(*(cause["parameters"][k]["value"] for k in ("sine", "cosine"))) == pytest.approx(
        4e-3, rel=0.1, abs=0
    )


# a linkage that keeps the forearm's direction, as palletisers have it: the last joint of the first three follows
LINKAGE = robots.robot(
    *robots.LINKS,
    robots.joint("shoulder", "base", "a", axis="0 0 1", more=robots.LIMIT),
    robots.joint("lift", "a", "b", axis="0 1 0", more=robots.LIMIT),
    robots.joint("rod", "b", "c", axis="0 1 0", more=robots.LIMIT + '<mimic joint="lift" multiplier="-1"/>'),
    robots.joint("wrist", "c", "d", axis="1 1 0", more=robots.LIMIT),
)


def test_an_error_of_a_joint_that_others_follow_moves_them_too(tmp_path: Path) -> None:
    """A gear's error of the leader, columns from the last; Pinocchio takes the follower as a joint of its own."""
    (tmp_path / "robot.urdf").write_text(LINKAGE)
    their = pin.buildModelFromUrdf(str(tmp_path / "robot.urdf"))
    state, rng, names = their.createData(), np.random.default_rng(), ["wrist", "lift", "shoulder"]
    q = rng.uniform(-1.4, 1.4, (100, 3))
    true = dict(zip(names, q.T, strict=True))
    true["lift"] = true["lift"] + 8e-3 * np.sin(3.0 * true["lift"])
    seen = []
    for k in range(len(q)):
        position = np.zeros(their.nq)
        for name, value in (*((n, true[n][k]) for n in names), ("rod", -true["lift"][k])):
            position[their.joints[their.getJointId(name)].idx_q] = value
        pin.framesForwardKinematics(their, state, position)
        pose = state.oMf[their.getFrameId("d")]
        seen.append((pose * pin.SE3(pin.exp3(1e-4 * rng.normal(size=3)), 1e-4 * rng.normal(size=3))).homogeneous)
    robot = fj.load_urdf(tmp_path / "robot.urdf", joints=names)
    found = diagnose_poses(robot, [fj.postures(q=q, pose=np.array(seen), base_frame="base", tool_frame="d")])
    assert [(c.name.effect, c.name.at) for c in found.causes] == [("gear_transmission_error", ("lift",))]
    size = found.causes[0].parameters
    assert size["order"].value == pytest.approx(3.0, rel=0, abs=0.1)
    assert np.hypot(size["sine"].value, size["cosine"].value) == pytest.approx(8e-3, rel=0.05, abs=0)
    (effect,) = found.solution.model.effects
    assert effect.places.tolist() == [names.index("lift")]  # the exported model has it at the leader
