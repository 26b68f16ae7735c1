"""Recordings have their columns in the order of the log, which need not be that of the tree: ROS sorts by name."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
import pytest
import robots
import yaml

import figaroh_jax as fj
from figaroh_jax.cli import main
from figaroh_jax.diagnosis.problem import Part
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


@pytest.mark.parametrize("order", [["elbow", "shoulder", "waist", "wrist"], ["wrist", "elbow", "shoulder", "waist"]])
def test_what_is_missing_does_not_depend_on_the_order_of_columns(order: list[str], tmp_path: Path) -> None:
    """The demo by the command line, its columns as they are (in the order of the tree), by name and from the end."""
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
    for one, other in zip(as_it_is["causes"], turned["causes"], strict=True):
        assert (one["effect"], set(one["at"])) == (other["effect"], set(other["at"]))
        for key, value in one["parameters"].items():
            assert other["parameters"][key]["value"] == pytest.approx(value["value"], rel=1e-6, abs=0)
    assert turned["holdout"]["after"] == pytest.approx(as_it_is["holdout"]["after"], rel=1e-6, abs=0)
    names = {file: list(told[k]["holdout"]["joints"]) for k, file in enumerate(("tree", "turned"))}
    assert names["turned"] == order != names["tree"]
    for name in order:
        assert turned["holdout"]["joints"][name] == pytest.approx(as_it_is["holdout"]["joints"][name], rel=1e-6, abs=0)
