"""Postures for a calibration: the bound against brute force, the rows against differences of Pinocchio's poses."""

from __future__ import annotations

import itertools
import json
import re
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import reference
import robots

from figaroh_jax.cli import main
from figaroh_jax.effects.extended import extend
from figaroh_jax.errors import InputError
from figaroh_jax.excitation import postures
from figaroh_jax.excitation.clearance import Capsule, clearance_of
from figaroh_jax.excitation.postures import Instrument, View, excite_postures
from figaroh_jax.excitation.task import excite_task
from figaroh_jax.excitation.touch import Touch
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.export import model_files
from figaroh_jax.rigid.model import RobotModel

LIMIT = '<limit lower="-2" upper="2" velocity="3" effort="40"/>'
WRIST = robots.robot(
    *robots.LINKS[:4],
    robots.joint("turn", "base", "a", axis="0 0 1", more=LIMIT),
    robots.joint("bend", "a", "b", axis="0 1 0", more=LIMIT),
    robots.joint("roll", "b", "c", axis="1 0 0", more=LIMIT),
)
DEVICE = Instrument("pose", "base", "c")
LONG = robots.robot(
    *robots.LINKS,
    robots.link("e", 0.3),
    robots.joint("j0", "base", "a", axis="0 0 1", more=LIMIT),
    robots.joint("j1", "a", "b", axis="0 1 0", more=LIMIT),
    robots.joint("j2", "b", "c", axis="0 1 0", more=LIMIT),
    robots.joint("j3", "c", "d", axis="1 0 0", more=LIMIT),
    robots.joint("j4", "d", "e", axis="0 0 1", more=LIMIT),
)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    return robots.load(WRIST, tmp_path_factory.mktemp("arm"))


def test_no_choice_exceeds_the_bound_and_the_exchange_is_near_the_best_of_all_choices():
    generator = np.random.default_rng(0)
    for count, p in ((4, 5), (6, 8)):
        J = generator.normal(size=(11, 2, p)) * generator.uniform(0.2, 2.0, (11, 1, 1))
        every = [
            np.linalg.slogdet(np.einsum("crp,crq->pq", J[list(some)], J[list(some)]))[1]
            for some in itertools.combinations(range(11), count)
        ]
        chosen = postures.exchanged(J, postures.greedy(J, count))
        own = np.linalg.slogdet(np.einsum("crp,crq->pq", J[chosen], J[chosen]))[1]
        assert len(set(chosen.tolist())) == count
        assert own <= max(every) + 1e-9
        assert own >= max(every) - 0.02 * p  # nearly always the best itself
        for start in (None, chosen):
            bound = postures.certified_bound(J, count, start)
            assert max(every) - 1e-6 <= bound <= max(every) + 0.3 * p


def test_information_of_a_posture_is_that_of_differences_of_the_poses(arm: RobotModel):
    """The offset of a joint moves the tool as the joint does: Pinocchio's poses tell its column."""
    q = np.random.default_rng(1).uniform(-1.5, 1.5, (40, 3))
    calibrated = postures._Calibrated(arm, DEVICE, "joint_offset", q)
    rows = calibrated.rows(q)
    names = [calibrated.names[k].name for k in calibrated.kept]
    assert "joint_offset bend" in names
    h = 1e-6
    ends = [reference.forward_kinematics(arm, q + s * h * np.array([0.0, 1.0, 0.0]))[:, 2] for s in (-1, 1)]
    moved = (ends[1] - ends[0])[:, :3, 3] / (2 * h)
    turned = (ends[1] - ends[0])[:, :3, :3] @ ends[0][:, :3, :3].swapaxes(1, 2) / (2 * h)
    axis = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], 1)
    column = rows[:, :, names.index("joint_offset bend")] * np.repeat(postures.ACCURACY, 3)
    # the device's axes are turned against the base by a constant rotation: lengths and angles are the same
    np.testing.assert_allclose(np.linalg.norm(column[:, :3], axis=1), np.linalg.norm(moved, axis=1), rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(column[:, 3:], axis=1), np.linalg.norm(axis, axis=1), rtol=1e-5)


def test_designed_postures_stay_within_the_limits_and_tell_more_than_random_ones(arm: RobotModel):
    limits = np.array([[-1.0, 1.0], [-0.5, 1.2], [-2.0, 0.5]])
    found = excite_postures(arm, DEVICE, count=10, candidates=100, position_limit=limits)
    assert (found.position >= limits[:, 0]).all() and (found.position <= limits[:, 1]).all()
    assert found.random_logdet < found.chosen_logdet <= found.bound + 1e-9
    assert found.logdet >= found.chosen_logdet - 1e-9
    assert 0.95 < found.chosen_efficiency <= 1.0 + 1e-9
    # the device's frames turn about the middle of the candidates
    candidates = np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (100, 3))
    calibrated = postures._Calibrated(arm, DEVICE, "full", candidates)
    rows = calibrated.rows(found.position)
    flat = rows.reshape(-1, rows.shape[2])
    assert np.linalg.slogdet(flat.T @ flat)[1] == pytest.approx(found.logdet, rel=1e-9)
    np.testing.assert_allclose(found.std, np.sqrt(np.diag(np.linalg.inv(flat.T @ flat))), rtol=1e-6)


@pytest.mark.parametrize("mount", ["hand", "world"])
def test_designed_postures_are_seen_and_clear(arm: RobotModel, mount: Literal["hand", "world"]):
    """Angles and distances by Pinocchio's poses; spheres of the last link and the base stay apart."""
    place, axis = ((0.3, 0.6, 0.0), (0.0, 0.0, 1.0)) if mount == "hand" else ((1.5, 0.4, 0.7), (-1.0, 0.0, -0.2))
    view = View(place, axis, mount, cone=1.0, tilt=1.3, near=0.3, far=2.5)
    bodies = [Capsule("c", (0, 0, 0), (0, 0, 0.1), 0.05), Capsule("base", (0, 0, 0), (0, 0, 0.2), 0.1)]
    clearance = clearance_of(arm, margin=0.1, bodies=bodies, floor=-0.2)
    device = Instrument("pose", "base", "c", view=view)
    found = excite_postures(arm, device, count=10, candidates=100, clearance=clearance)
    assert found.logdet >= found.chosen_logdet - 1e-6
    pose = np.asarray(reference.forward_kinematics(arm, found.position))[:, 2]
    way = np.array(place) - pose[:, :3, 3]
    far = np.linalg.norm(way, axis=1)
    at_tool = np.arccos((way * pose[:, :3, 2]).sum(1) / far)
    at_place = np.arccos(-(way @ axis) / far / np.linalg.norm(axis))
    device_angle, target_angle = (at_tool, at_place) if mount == "hand" else (at_place, at_tool)
    assert (device_angle <= 1.0).all() and (target_angle <= 1.3).all()
    assert (far >= 0.3).all() and (far <= 2.5).all()
    ends = np.stack([pose[:, :3, 3], pose[:, :3, 3] + 0.1 * pose[:, :3, 2]], 1)
    assert (ends[..., 2] >= -0.2 + 0.05 + 0.1 - 1e-9).all()
    column = np.linspace(0, 0.2, 41)[:, None] * np.array([0, 0, 1.0])
    apart = np.linalg.norm(ends[:, :, None] - column, axis=3).min(axis=(1, 2)) - 0.15
    assert (apart >= 0.1 - 1e-6).all()
    with pytest.raises(InputError, match="0 of .* random postures are seen by the device and are clear"):
        excite_postures(arm, Instrument("pose", "base", "c", view=View((9.0, 9.0, 9.0), far=1.0)), count=10)


def test_the_order_of_postures_has_shorter_ways_than_the_one_given():
    q = np.random.default_rng(2).uniform(-2, 2, (20, 3))
    order = postures.in_order(q, np.ones(3))
    assert sorted(order.tolist()) == list(range(20))
    length = [np.abs(np.diff(x, axis=0)).max(axis=1).sum() for x in (q, q[order])]
    assert length[1] < 0.7 * length[0]


def test_the_command_writes_postures_with_their_share_of_the_bound(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "robot.urdf").write_text(WRIST)
    device = "measurement: {pose: pose, base_frame: base, tool_frame: c, unknown: [base_frame, tool_frame]}"
    block = f"{{kind: postures, postures: 10, candidates: 100, {device}}}"
    (tmp_path / "task.yaml").write_text(f"robot: {{model: robot.urdf}}\nexcite: {block}\n")
    assert main(["excite", str(tmp_path / "task.yaml"), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    assert "10 postures for" in capsys.readouterr().out
    answer = json.loads((tmp_path / "run" / "excitation.json").read_text())
    table = np.loadtxt(tmp_path / "run" / "postures.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table, answer["postures"], rtol=1e-7, atol=1e-8)
    assert answer["efficiency_of_random"] < answer["efficiency"]
    assert "certified" in (tmp_path / "run" / "report.html").read_text()


@pytest.mark.parametrize("form", ["urdf", "xml"])
def test_postures_are_chosen_for_a_robot_with_moments_that_no_body_can_have(tmp_path: Path, form: str):
    """The postures are those of the same robot with other moments; a motion, whose torques they make, is refused."""
    wrong, sound = tmp_path / f"wrong.{form}", tmp_path / f"sound.{form}"
    model = robots.load(WRIST, tmp_path)
    sound.write_text(WRIST if form == "urdf" else model_files(extend(model))["robot.xml"])
    where, numbers = ("link", "-9") if form == "urdf" else ("body", "-9 1 1 0 0 0")
    until = rf'(<{where} name="b".*?(ixx|fullinertia)=")[^"]*'
    wrong.write_text(re.sub(until, rf"\g<1>{numbers}", sound.read_text(), count=1, flags=re.DOTALL))
    limits = "limits: {clearance: 0.01}, floor: -5, bodies: [{link: c, at: [0, 0, 0], radius: 0.01}]"
    device = (
        f"{limits}, measurement: {{pose: pose, base_frame: base, tool_frame: c, unknown: [base_frame, tool_frame]}}"
    )
    found = []
    for file in (sound, wrong):
        block = f"{{kind: postures, postures: 10, candidates: 30, {device}}}"
        (tmp_path / "task.yaml").write_text(f"robot: {{model: {file.name}}}\nexcite: {block}\n")
        found.append(excite_task(load_task(tmp_path / "task.yaml")))
    np.testing.assert_allclose(found[1].position, found[0].position, rtol=0, atol=1e-12)
    (note,) = set(found[1].notes) - set(found[0].notes)
    assert note.startswith(f"wrong.{form}: link 'b': its inertia has a negative principal moment, -9")
    (tmp_path / "task.yaml").write_text(f"robot: {{model: {wrong.name}}}\nexcite: {{duration: 2}}\n")
    with pytest.raises(InputError, match="negative principal moment" if form == "urdf" else "does not compile it"):
        excite_task(load_task(tmp_path / "task.yaml"))


@pytest.mark.parametrize(
    ("block", "message"),
    [
        ("{kind: postures}", "excite.measurement is missing"),
        (
            "{kind: postures, measurement: {plane: n, tool_frame: c}}",
            "postures that touch a plane need its place and axis",
        ),
        ("{kind: postures, measurement: {pose: p, tool_frame: d}}", "has no frame 'd'"),
        ("{kind: postures, postures: 2, measurement: {pose: p, tool_frame: c}}", "2 postures cannot determine"),
        ("{kind: postures, measurement: {pose: p, base_frame: c, tool_frame: c}}", "no joint moves tool_frame"),
    ],
)
def test_what_cannot_be_chosen_is_one_message(tmp_path: Path, block: str, message: str):
    (tmp_path / "robot.urdf").write_text(WRIST)
    (tmp_path / "task.yaml").write_text(f"robot: {{model: robot.urdf}}\nexcite: {block}\n")
    with pytest.raises(InputError, match=message):
        excite_task(load_task(tmp_path / "task.yaml"))


@pytest.mark.parametrize("kind", [pytest.param("plane", marks=pytest.mark.slow), "socket"])
def test_designed_postures_touch_what_they_are_measured_with(tmp_path: Path, kind: Literal["plane", "socket"]):
    """Points by Pinocchio's poses; the information is that of differences of what a touch measures."""
    arm, point = robots.load(LONG, tmp_path), np.array([0.02, 0.0, 0.1])
    ends = reference.forward_kinematics(arm, np.array([[0.3, 0.4, 0.2, 0.1, 0], [-0.8, 0.9, -0.5, 0.3, 0]]))[:, 4]
    at = [tuple((end[:3, :3] @ point + end[:3, 3]).tolist()) for end in ends]
    places = [Touch(at[0], (0, 0, 1), 0.4), Touch(at[1], (0, -1, 0.2), 0.4)] if kind == "plane" else [*map(Touch, at)]
    device = Instrument(kind, "base", "e", ("tool_frame",), touched=tuple(places), point=tuple(point.tolist()))
    found = excite_postures(arm, device, count=12, candidates=100, level="joint_offset")
    assert found.logdet >= found.chosen_logdet - 1e-6 and found.random_logdet < found.chosen_logdet
    pose = np.asarray(reference.forward_kinematics(arm, found.position))[:, 4]
    at = pose[:, :3, :3] @ point + pose[:, :3, 3]
    low, high = np.array(arm.position_limit).T
    assert (found.position >= low - 1e-9).all() and (found.position <= high + 1e-9).all()
    away = at[:, None] - np.array([one.place for one in places])
    if kind == "plane":
        normal = np.array([np.array(one.axis) / np.linalg.norm(np.array(one.axis)) for one in places])
        off = np.abs((away * normal).sum(2))
        assert (np.linalg.norm(away, axis=2)[np.arange(12), off.argmin(1)] <= 0.4 + 1e-6).all()
    else:
        off = np.abs(away).max(2)
    assert (off.min(axis=1) < 1e-5).all()
    assert set(off.argmin(axis=1).tolist()) == {0, 1}


def test_postures_for_a_device_of_ones_own_are_those_of_its_function(arm: RobotModel):
    """A wire from an eyelet: its slope by a joint's offset is that of Pinocchio's distances."""
    import jax.numpy as jnp

    from figaroh_jax.recordings.devices import own_device

    eyelet = np.array([0.9, 0.4, 0.7])
    unknowns = {f"eyelet {axis}": (float(x), "m", 0.01) for axis, x in zip("xyz", eyelet, strict=True)}
    wire = own_device(lambda pose, at, length: jnp.linalg.norm(pose[:3, 3] - at)[None] - length, unknowns)

    def lengths(poses: np.ndarray) -> np.ndarray:
        return np.linalg.norm(poses[:, :3, 3] - eyelet, axis=1)

    device = Instrument("own", "base", "c", accuracy=(2e-4, 1e-3), device=wire, seen=lengths)
    found = excite_postures(arm, device, count=10, candidates=60, level="joint_offset")
    names = [one.name for one in found.parameters]
    assert found.random_logdet < found.chosen_logdet <= found.bound + 1e-9 and "eyelet x" in names

    def measured(q: np.ndarray) -> np.ndarray:
        return lengths(np.asarray(reference.forward_kinematics(arm, q))[:, 2])

    h, columns = 1e-6, []
    for name in names:
        if name.startswith("joint_offset"):
            step = h * np.eye(3)[["turn", "bend", "roll"].index(name.split()[1])]
            columns.append((measured(found.position + step) - measured(found.position - step)) / (2 * h))
        else:
            way = np.asarray(reference.forward_kinematics(arm, found.position))[:, 2, :3, 3] - eyelet
            columns.append(-(way / np.linalg.norm(way, axis=1, keepdims=True))[:, "xyz".index(name[-1])])
    J = np.stack(columns, 1) / 2e-4
    assert np.linalg.slogdet(J.T @ J)[1] == pytest.approx(found.logdet, abs=1e-3)
