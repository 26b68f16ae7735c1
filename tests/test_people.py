"""A person's sizes by markers and segments by force plates, against Pinocchio and a table's own numbers.

`benchmarks/people.py` judges whole people, with skin that slides, on motion that was not fitted.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import pinocchio as pin
import pytest
import robots

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.estimation import markers
from figaroh_jax.identification import people
from figaroh_jax.rigid.inertia import to_com
from figaroh_jax.rigid.kinematics import forward_kinematics

PLACES = ([0.05, 0.0, 0.02], [0.0, 0.06, 0.1], [-0.04, -0.03, 0.05], [0.02, 0.05, -0.06])
STICK = robots.robot(  # two legs' worth of a person: names of segments, a massless axis between
    robots.link("pelvis", 9.0, com="0 0.05 0"),
    robots.link("thigh", 7.0, com="0 -0.18 0.01"),
    robots.link("shank", 3.0, com="0.01 -0.2 0"),
    robots.link("foot", 1.0, com="0.06 -0.03 0"),
    robots.joint("hip", "pelvis", "thigh", axis="0 0 1", xyz="0.02 -0.08 0.09", rpy="0 0 0", more=robots.LIMIT),
    robots.joint("knee", "thigh", "shank", axis="0 1 1", xyz="0 -0.42 0", rpy="0 0 0", more=robots.LIMIT),
    robots.joint("ankle", "shank", "foot", axis="1 0 1", xyz="0 -0.4 0", rpy="0 0 0", more=robots.LIMIT),
)


def stick(folder: Path) -> fj.RobotModel:
    return robots.load(STICK, folder, root="free_flyer")


def motion(robot: fj.RobotModel, samples: int, rate: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Time and positions: sums of slow sines, of the root too."""
    rng, t = np.random.default_rng(seed), np.arange(samples) / rate
    wave: np.ndarray = sum(  # pyright: ignore[reportAssignmentType]
        np.sin(2 * np.pi * np.outer(t, rng.uniform(0.2, 0.8, robot.nv)) + rng.uniform(0, 6, robot.nv)) for _ in "ab"
    )
    q = np.zeros((samples, robot.nq))
    q[:, :3] = [0.3, 0.1, 1.0] + 0.05 * wave[:, :3]
    q[:, 3:7] = [pin.Quaternion(pin.exp3(0.2 * w)).coeffs() for w in wave[:, 3:6]]
    q[:, 7:] = 0.4 * wave[:, 6:]
    return t, q


def seen_by_markers(robot: fj.RobotModel, truth: np.ndarray) -> tuple[dict, dict, np.ndarray]:
    """Places of markers on the robot, where they are seen on one with segments of other sizes, to 1 mm; positions."""
    rng = np.random.default_rng(1)
    _, segment = markers.segments_of(robot)
    _, q = motion(robot, 24, 4.0)
    grown = markers.scaled(robot, segment, truth)
    poses = np.asarray(forward_kinematics(eqx.tree_at(lambda m: m.placement, robot, np.asarray(grown.placement)), q))
    own, seen = {}, {}
    for i, link in enumerate(robot.link_names):
        for k, place in enumerate(PLACES):
            at = np.array(place) + ([0.0, -0.3, 0.0] if k > 1 else 0.0)
            own[f"{link}{k}"] = link, at
            there = np.einsum("tij,j->ti", poses[:, i, :3, :3], truth[i] * at) + poses[:, i, :3, 3]
            seen[f"{link}{k}"] = there + 1e-3 * rng.normal(size=there.shape)
    seen["foot0"][3] = np.nan
    return own, seen, q


SIZES = np.array([1.1, 0.9, 1.15, 0.95])


def test_sizes_and_positions_are_those_that_the_markers_were_made_with(tmp_path: Path) -> None:
    """Noise of 1 mm."""
    robot = stick(tmp_path)
    own, seen, q = seen_by_markers(robot, SIZES)
    assert markers.segments_of(robot)[0] == ("pelvis", "thigh", "shank", "foot")
    data = markers.marker_data(robot, own, seen, sigma=1e-3)
    found = markers.segment_sizes(robot, data, misplaced=1e-4)
    assert (np.abs(found.scale - SIZES) < 4 * found.std + 2e-3).all()
    np.testing.assert_allclose(found.data.start[:, 7:], q[:, 7:], rtol=0, atol=0.03)
    assert 0.5e-3 < found.rms < 1.5e-3
    with pytest.raises(InputError, match="marker 'a': robot 'tiny' has no link 'thihg'; did you mean 'thigh'"):
        markers.marker_data(robot, {"a": ("thihg", [0, 0, 0])}, {"a": np.zeros((3, 3))})


def test_the_tables_numbers_are_those_of_the_links(tmp_path: Path) -> None:
    """De Leva 1996: a man's thigh has 14.16 % of the mass, its centre at 40.95 %, radii 32.9, 32.9 and 14.9 %."""
    robot = stick(tmp_path)
    person = people.anthropometric(robot, 80.0, "male", np.array([1.0, 1.2, 1.0, 1.0]))
    mass, com, about = (np.asarray(x) for x in to_com(np.asarray(person.inertia)))
    thigh, length = person.link_index("thigh"), 1.2 * 0.42
    np.testing.assert_allclose(mass[thigh], 2 * 0.1416 * 80)  # the model has one leg: it carries both
    np.testing.assert_allclose(com[thigh], [0, -0.4095 * length, 0], atol=1e-12)
    radii = np.sqrt(np.diag(about[thigh]) / mass[thigh]) / length
    np.testing.assert_allclose(radii, [0.329, 0.149, 0.329], atol=1e-9)
    np.testing.assert_allclose(person.placement[person.link_index("shank"), :3, 3], [0, -length, 0])
    shank = people._TABLE["shank"]  # from the knee's to the ankle's joint centre, not to the malleolus
    assert (shank["male"].centre, shank["female"].centre) == (0.4395, 0.4352)
    for sex in ("female", "male"):  # head, trunk and two of everything else are the whole body
        shares = {kind: row[sex].mass for kind, row in people._TABLE.items()}
        assert abs(2 * sum(shares.values()) - shares["head"] - shares["trunk"] - 1) < 2e-4
    odd = robots.load(STICK.replace("thigh", "widget"), tmp_path, root="free_flyer")
    with pytest.raises(InputError, match="link 'widget' is not a segment of the table"):
        people.anthropometric(odd, 80.0)


def trial(robot: fj.RobotModel, truth: pin.Model, seed: int, load: pin.Inertia | None = None) -> people.Capture:
    """A capture of Pinocchio's root wrench with noise, through a plate that stands askew."""
    rng, (t, q) = np.random.default_rng(seed), motion(robot, 800, 100.0, seed)
    model = truth.copy()
    if load is not None:
        model.inertias[model.getJointId("knee")] += load
    data, plate = model.createData(), pin.SE3(pin.exp3(np.array([0.3, 0, 0.5])), np.array([0.2, -0.1, 0.05]))
    steps = [pin.difference(model, a, b) * 100 for a, b in zip(q[:-1], q[1:], strict=True)]
    v = np.gradient(np.cumsum([np.zeros(model.nv), *steps], axis=0) / 100, 0.01, axis=0, edge_order=2)
    a = np.gradient(v, 0.01, axis=0, edge_order=2)
    wrench = []
    for row in zip(q, v, a, strict=True):
        root = pin.Force(pin.rnea(model, data, *row)[:6])
        pin.forwardKinematics(model, data, row[0])
        wrench.append((plate.inverse() * data.oMi[1]).act(root).vector)
    noise = rng.normal(0, [1.0] * 3 + [0.3] * 3, (len(t), 6))
    return people.capture(robot, t, q, [(plate.homogeneous, np.array(wrench) + noise)], cutoff=5.0, name=str(seed))


def test_segments_are_found_by_the_roots_wrench_alone(tmp_path: Path) -> None:
    robot, rng = stick(tmp_path), np.random.default_rng(3)
    truth = pin.buildModelFromUrdf(str(tmp_path / "robot.urdf"), pin.JointModelFreeFlyer())
    for j in range(1, truth.njoints):
        own = truth.inertias[j]
        factor = 1 + rng.choice([-1, 1]) * rng.uniform(0.1, 0.25)
        lever = own.lever * (1 + 0.1 * rng.normal(size=3))
        truth.inertias[j] = pin.Inertia(own.mass * factor, lever, own.inertia * factor * 1.1)
    fitted, unseen = [trial(robot, truth, k) for k in range(2)], trial(robot, truth, 9)
    found = people.identify_segments(fitted, robot)
    total = sum(i.mass for i in truth.inertias)
    assert abs(found.mass()[0] - total) < 0.01 * total
    gone = people.predicted(found.model, unseen) - unseen.wrench
    before = people.predicted(robot, unseen) - unseen.wrench
    assert np.sqrt((gone[:, :3] ** 2).sum(1).mean()) < 0.02 * 9.81 * total
    assert (gone.std(0) < 0.5 * before.std(0)).all()
    q = unseen.position[100]
    centre, std = found.centre(q)
    np.testing.assert_allclose(centre, pin.centerOfMass(truth, truth.createData(), q), atol=3e-3)
    assert (std < 5e-3).all()
    true = np.array([truth.inertias[j].toDynamicParameters() for j in range(1, truth.njoints)])
    off = np.abs(found.parameters - true) / found.std
    assert (off < 1.96).mean() > 0.9
    assert np.linalg.eigvalsh(to_com(found.parameters)[2]).min() > 0
    assert {word for row in found.status for word in row} == {"identified", "prior only"}
    carried = people.name_payload(
        [trial(robot, truth, 11, pin.Inertia(3.0, np.array([0.05, -0.3, 0.1]), 0.003 * np.eye(3)))], found
    )
    assert carried.link == "shank"
    assert abs(carried.mass - 3.0) < min(0.45, 3 * carried.std)


def plate_wrench(path: str, robot: fj.RobotModel, q0: np.ndarray, x: np.ndarray, link: str) -> np.ndarray:
    """Pinocchio's wrench on the free person whose `link` stands still at the place of q0, there, in the world's axes.

    x: positions, velocities and accelerations of the other joints.
    """
    model = pin.buildModelFromUrdf(path, pin.JointModelFreeFlyer())
    data, frame = model.createData(), model.getFrameId(link)
    own = [model.joints[model.getJointId(j.name)] for j in robot.joints[1:]]
    columns = [j.coordinate - 6 for j in robot.joints[1:]]
    q, v, a = q0.copy(), np.zeros(model.nv), np.zeros(model.nv)
    for joint, k in zip(own, columns, strict=True):
        q[joint.idx_q], v[joint.idx_v], a[joint.idx_v] = x[:, k]
    pin.framesForwardKinematics(model, data, q0)
    stands = data.oMf[frame].copy()
    pin.framesForwardKinematics(model, data, q)
    root = stands * data.oMf[frame].inverse() * data.oMi[1]
    q[:7] = pin.SE3ToXYZQUAT(root)
    J = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL)
    v[:6] = -np.linalg.solve(J[:, :6], J[:, 6:] @ v[6:])
    pin.forwardKinematics(model, data, q, v, 0 * v)
    pin.updateFramePlacements(model, data)
    drift = pin.getFrameAcceleration(model, data, frame).vector
    a[:6] = -np.linalg.solve(J[:, :6], J[:, 6:] @ a[6:] + drift)
    force = pin.Force(pin.rnea(model, data, q, v, a)[:6])
    plate = pin.SE3(np.eye(3), stands.translation)
    return (plate.inverse() * root).act(force).vector


def upright(robot: fj.RobotModel) -> np.ndarray:
    q = np.zeros(robot.nq)
    q[:7] = [0.1, 0.2, 0.9, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    return q


def test_a_person_on_a_plate_moves_as_one_whose_foot_stands_still(tmp_path: Path) -> None:
    robot, rng = stick(tmp_path), np.random.default_rng(4)
    path, q0 = str(tmp_path / "robot.urdf"), upright(stick(tmp_path))
    for link in ("foot", "thigh"):  # the end of the tree, and a link on the way
        person = people.standing(robot, link, q0)
        assert person.dof_names == (*people.PLATE, "hip", "knee", "ankle")
        x = rng.normal(size=(3, 3))
        own = np.asarray(fj.inverse_dynamics(person, *np.concatenate([np.zeros((3, 6)), x], axis=1)))
        np.testing.assert_allclose(own[:6], plate_wrench(path, robot, q0, x, link), rtol=0, atol=1e-9)
        placed = np.asarray(forward_kinematics(person, np.zeros(9)))[5, :3, 3]
        np.testing.assert_allclose(placed, np.asarray(person.placement)[0, :3, 3], rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="root='free_flyer'"):
        people.standing(robots.load(STICK, tmp_path), "foot", np.zeros(3))
    with pytest.raises(InputError, match=r"\(10,\) finite numbers"):
        people.standing(robot, "foot", np.zeros(9))


def on_one_foot(robot: fj.RobotModel) -> tuple[fj.RobotModel, fj.Learned, Any, Any]:
    """A person on a plate, what a recording there would tell, limits and a basis of the motion."""
    person = people.standing(robot, "foot", upright(robot), support=(0.12, 0.1))
    sigma = dict.fromkeys(people.PLATE, 2.0)
    learned = fj.learn(person, fj.Baseline(viscous=False, coulomb=False), measured=sigma, hold=people.PLATE)
    return person, learned, fj.limits_of(person, velocity=2.0, acceleration=6.0), fj.fourier(2, 0.25, 4.0)


@pytest.mark.slow
def test_a_motion_on_a_plate_keeps_limits_and_balance_and_tells_more(tmp_path: Path) -> None:
    robot = stick(tmp_path)
    person, learned, limits, basis = on_one_foot(robot)
    start = people.balanced(person, np.repeat([0.0, 0.3], [6, 3]))
    assert not start[:6].any()
    still = plate_wrench(
        str(tmp_path / "robot.urdf"), robot, upright(robot), np.stack([start[6:], *np.zeros((2, 3))]), "foot"
    )
    np.testing.assert_allclose(still[3:5] / (9.81 * 20.0), 0.0, rtol=0, atol=5e-3)
    found = fj.excite(person, basis, limits, learned, start=start, starts=1, rate=10.0)
    assert found.met
    motion = found.stages[0].motion
    assert not np.asarray(motion.weights)[:6].any()
    q, v, a = (np.asarray(x) for x in motion.states(20.0))
    wrench = np.array([
        plate_wrench(str(tmp_path / "robot.urdf"), robot, upright(robot), np.stack(x)[:, 6:], "foot")
        for x in zip(q, v, a, strict=True)
    ])  # fmt: skip
    weight = 9.81 * 20.0
    assert (np.abs(wrench[:, 3:5]) < weight * np.array([0.1, 0.12]) * 1.001).all()
    assert (found.std < 0.5 * found.std_before).mean() > 0.4


def test_what_cannot_stand_on_a_plate_is_refused(tmp_path: Path) -> None:
    robot = stick(tmp_path)
    person, learned, limits, basis = on_one_foot(robot)
    with pytest.raises(InputError, match=r"start: holding still there takes .* 'plate_T[xy]' .*`people.balanced` says"):
        fj.excite(person, basis, limits, learned, start=np.repeat([0.0, 1.2], [6, 3]))
    with pytest.raises(InputError, match=r"balanced: near has shape \(3,\)"):
        people.balanced(person, np.zeros(3))
    with pytest.raises(InputError, match="balanced: hold: no moving joint 'kneee'; did you mean 'knee'"):
        people.balanced(person, hold=["kneee"])
    with pytest.raises(InputError, match="mm off in the best posture within the limits"):
        people.balanced(person, np.repeat([0.0, 1.2], [6, 3]), hold=["hip", "knee"])
    with pytest.raises(InputError, match="does not stand on a plate"):
        people.balanced(robot)
    with pytest.raises(InputError, match="measured: no moving joint 'plate_fx'"):
        fj.learn(person, measured={"plate_fx": 1.0})


def test_wrong_captures_are_refused(tmp_path: Path) -> None:
    robot = stick(tmp_path)
    t, q = motion(robot, 100, 100.0)
    plate = np.eye(4), np.zeros((100, 6))
    with pytest.raises(InputError, match="no force plate"):
        people.capture(robot, t, q, [])
    with pytest.raises(InputError, match=r"finite wrench \(100, 6\)"):
        people.capture(robot, t, q, [(np.eye(4), np.full((100, 6), np.nan))])
    with pytest.raises(InputError, match="evenly spaced"):
        people.capture(robot, t**2, q, [plate])
    with pytest.raises(InputError, match="cutoff 90 Hz"):
        people.capture(robot, t, q, [plate], cutoff=90)
    with pytest.raises(InputError, match="free_flyer"):
        people.capture(robots.load(STICK, tmp_path), t, q[:, 7:], [plate])


@pytest.mark.slow
def test_the_fit_of_the_librarys_own_solver_finds_the_same_sizes(tmp_path: Path) -> None:
    robot = stick(tmp_path)
    own, seen, _ = seen_by_markers(robot, SIZES)
    data = markers.marker_data(robot, own, seen, sigma=1e-3)
    found = markers.segment_sizes(robot, data, misplaced=1e-4)
    start = eqx.tree_at(lambda d: d.start, data, found.data.start)
    fitted = fj.fit(robot, start, "segments", prior={"segments": 0.15})
    np.testing.assert_allclose(fitted.data[0].scale, found.scale, rtol=0, atol=4e-3)


@pytest.mark.slow
def test_a_simulated_person_from_end_to_end() -> None:
    """Markers, skin, two plates: within the goals but for what `benchmarks/people.py` tells of many people."""
    import sys

    root = Path(__file__).resolve().parents[1]
    data = Path(os.environ.get("FIGAROH_JAX_DATA", root.parent / "shared" / "data"))
    if not (data / "human_model").is_dir():
        pytest.skip(f"no human_model below {data}")
    sys.path.insert(0, str(root / "benchmarks"))
    import people as benchmark

    line = benchmark.study(np.random.default_rng(0), 20.0, 3)
    assert line["mass"] < 1.5
    assert line["size"] < 3.0
    assert line["force"][0] < line["force"][2]
    assert line["moment"][0] < 5.0 < line["moment"][1]
    assert 0.85 < line["covered"]


@pytest.mark.slow
def test_a_whole_person_moves_on_one_foot_within_the_limits_of_39_joints() -> None:
    """Limits and the centre of pressure by Pinocchio, at 100 Hz of the whole motion."""
    root = Path(__file__).resolve().parents[1]
    urdf = Path(os.environ.get("FIGAROH_JAX_DATA", root.parent / "shared" / "data")) / "human_model" / "human.urdf"
    if not urdf.is_file():
        pytest.skip(f"no {urdf}")
    robot = fj.load_urdf(urdf, root="free_flyer")
    support = np.array([0.1, 0.05])
    person = people.standing(robot, "left_foot", upright(robot), support=(0.1, 0.05))
    sigma = dict.fromkeys(people.PLATE, 2.0)
    learned = fj.learn(person, fj.Baseline(viscous=False, coulomb=False), measured=sigma, hold=people.PLATE, trust=0.25)
    limits = fj.limits_of(person, velocity=3.0, acceleration=10.0, scale=0.95)
    start = people.balanced(person)
    found = fj.excite(person, fj.fourier(2, 0.25, 4.0), limits, learned, start=start, starts=1)
    assert found.met and person.nv == 45
    assert (found.std < 0.5 * found.std_before).sum() > 20
    x = np.stack([np.asarray(y) for y in found.stages[0].motion.states(100.0)], axis=1)
    low, high = np.asarray(person.position_limit)[6:].T
    assert (x[:, 0, 6:] >= low).all() and (x[:, 0, 6:] <= high).all()
    assert (np.abs(x[:, 1]) <= 3.0).all() and (np.abs(x[:, 2]) <= 10.0).all()
    wrench = np.array([plate_wrench(str(urdf), robot, upright(robot), one[:, 6:], "left_foot") for one in x])
    mass = float(np.asarray(robot.inertia)[:, 0].sum())
    assert (np.abs(wrench[:, [4, 3]]) <= 9.81 * mass * support).all()
    assert (np.abs(wrench[:, [4, 3]] / wrench[:, 2:3]) < 1.5 * support).all()  # of the force of the moment
    assert (wrench[:, 2] > 0).all()  # the foot stays on the plate
