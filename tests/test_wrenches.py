"""Free flyers, force plates and wrist sensors against MuJoCo C and Pinocchio."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.estimation.columns import friction_terms, random_states
from figaroh_jax.estimation.least_squares import WeightedByJoint, solve
from figaroh_jax.estimation.regression import condense
from figaroh_jax.estimation.states import States
from figaroh_jax.formats.config import Baseline, load_task
from figaroh_jax.identification.result import Identification
from figaroh_jax.identification.wrenches import SensorStates, generalized_force, wrench_regressor
from figaroh_jax.jobs.predictions import predictions
from figaroh_jax.recordings.groupmotion import group_rates

# a trunk that flies, an arm of two joints on it; {k} scales what the model is told of the masses
FLYER = """<mujoco model="flyer"><compiler angle="radian"/><option timestep="1e-3" integrator="Euler"/><worldbody>
<body name="trunk" pos="0 0 0.6"><freejoint name="root"/>
  <inertial pos="0.02 -0.01 0.03" mass="{m[0]}" fullinertia="{i[0]} {i[1]} {i[2]} 0.002 -0.001 0.003"/>
  <site name="mount" pos="-0.1 0.02 -0.05" quat="0.9 0.1 0.3 -0.2"/>
  <body name="upper" pos="0.2 0 0.1"><joint name="shoulder" axis="0 1 0"/>
    <inertial pos="0.03 0.01 0.15" mass="{m[1]}" fullinertia="{i[3]} {i[4]} {i[5]} 0.001 0.0005 -0.001"/>
    <body name="hand" pos="0 0.02 0.35"><joint name="elbow" axis="1 0 0"/>
      <inertial pos="0.02 -0.01 0.1" mass="{m[2]}" fullinertia="{i[6]} {i[7]} {i[8]} 0.0002 -0.0001 0.0003"/>
      <site name="palm" pos="0.01 0 0.22" quat="0.8 -0.3 0.4 0.1"/>
    </body></body></body></worldbody></mujoco>"""
MASS = np.array([6.0, 1.8, 0.9])
INERTIA = np.array([0.06, 0.09, 0.08, 0.025, 0.022, 0.008, 0.006, 0.007, 0.003])
VISCOUS, COULOMB = np.array([0.9, 0.5]), np.array([1.2, 0.4])
SIGMA = {"q": 5e-6, "tau": 0.03, "wrench": 0.15}


def flyer(folder: Path, scale: float = 1.0) -> Path:
    path = folder / f"flyer{scale:g}.xml"
    noise = np.random.default_rng(7).uniform(-1, 1, 12) * (scale - 1)
    m, i = MASS * (1 + noise[:3]), INERTIA * (1 + noise[:3].repeat(3))
    path.write_text(FLYER.format(m=m, i=i))
    return path


class Flight(NamedTuple):
    time: np.ndarray
    q: np.ndarray  # x y z, quaternion x y z w, joints
    tau: np.ndarray  # motors
    wrenches: dict[str, np.ndarray]  # measured, on frames in their axes


def fly(path: Path, seconds: float, seed: int) -> Flight:
    """Velocity Verlet with MuJoCo's forces: forces, positions and velocities of one step belong together.

    A wrench at the mount carries and turns the trunk, another pulls at the palm; motors move the arm against friction
    that is computed here.
    """
    mj = mujoco.MjModel.from_xml_path(str(path))
    data, random = mujoco.MjData(mj), np.random.default_rng(seed)
    frequency, phase = random.uniform(0.15, 0.9, (14, 3)), random.uniform(0, 6.28, (14, 3))
    mount, palm = (mj.site(name).id for name in ("mount", "palm"))
    rows = []
    for _ in range(int(seconds / mj.opt.timestep)):
        wave = np.sin(2 * np.pi * frequency * data.time + phase).sum(axis=1)
        half = data.qvel.copy()
        data.qvel[:] += 0.5 * mj.opt.timestep * data.qacc
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_comPos(mj, data)
        R = data.xmat[1].reshape(3, 3)
        target = np.array([0, 0, 0.6]) + 0.1 * wave[:3]
        turn = np.zeros(3)
        mujoco.mju_quat2Vel(turn, data.qpos[3:7], 1.0)
        force = 900 * (target - data.qpos[:3]) - 90 * data.qvel[:3] + [0, 0, 9.81 * MASS.sum()]
        torque = R @ (30 * (0.2 * wave[3:6] - turn) - 3 * data.qvel[3:6])
        pull, twist = 5 * wave[8:11], 0.8 * wave[11:14]
        motor = np.array([60, 25]) * (0.5 * wave[6:8] - data.qpos[7:]) - np.array([5, 2]) * data.qvel[6:]
        friction = VISCOUS * data.qvel[6:] + COULOMB * np.sign(data.qvel[6:])
        data.qfrc_applied[:] = 0
        data.qfrc_applied[6:] = motor - friction
        for site, f, t in ((mount, force, torque), (palm, pull, twist)):
            mujoco.mj_applyFT(mj, data, f, t, data.site_xpos[site], mj.site_bodyid[site], data.qfrc_applied)
        mujoco.mj_forward(mj, data)
        pairs = {
            "mount": (mount, force, torque),
            "palm": (palm, pull, twist),
        }
        turned = {
            name: np.concatenate([data.site_xmat[s].reshape(3, 3).T @ x for x in (f, t)])
            for name, (s, f, t) in pairs.items()
        }
        q = np.concatenate([data.qpos[:3], np.roll(data.qpos[3:7], -1), data.qpos[7:]])
        rows.append((data.time, q, motor, turned))
        data.qvel[:] = half
        mujoco.mj_Euler(mj, data)
    time, q, tau = (np.array([row[k] for row in rows]) for k in range(3))
    q = q + SIGMA["q"] * random.standard_normal(q.shape)
    tau = tau + SIGMA["tau"] * random.standard_normal(tau.shape)
    measured = {name: np.array([row[3][name] for row in rows]) for name in ("mount", "palm")}
    measured = {
        name: w + SIGMA["wrench"] * random.standard_normal(w.shape) * [1, 1, 1, 0.1, 0.1, 0.1]
        for name, w in measured.items()
    }
    return Flight(time, q, tau, measured)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("flyer")


@pytest.fixture(scope="module")
def task(folder: Path) -> Path:
    """A task on disk: positions with the root's pose, torques with what the wrenches do at the coordinates."""
    truth, nominal = flyer(folder), flyer(folder, 1.25)
    model = fj.load_mjcf(nominal)
    for name, seed in {"fit": 1, "held": 2}.items():
        one = fly(truth, 14.0 if name == "fit" else 5.0, seed)
        tau = np.concatenate([np.zeros((len(one.tau), 6)), one.tau], axis=1)
        np.savez(folder / f"{name}.npz", t=one.time, q=one.q, tau=tau + generalized_force(model, one.q, one.wrenches))
    text = f"""robot: {{model: {nominal.name}, root: free_flyer}}
data:
  - {{file: fit.npz, time: t, position: q, torque: tau}}
  - {{file: held.npz, time: t, position: q, torque: tau, role: holdout}}
preprocess: {{cutoff: 20}}
"""
    (folder / "flyer.yaml").write_text(text)
    return folder / "flyer.yaml"


@pytest.fixture(scope="module")
def found(task: Path) -> Identification:
    identified = fj.identify_task(load_task(task))
    assert isinstance(identified, Identification)
    return identified


def truth_of(folder: Path) -> dict[str, float]:
    """The parameters by name, from MuJoCo's own compiled numbers."""
    mj = mujoco.MjModel.from_xml_path(str(flyer(folder)))
    out = {}
    for k in range(3):
        m, c, R = mj.body_mass[k + 1], mj.body_ipos[k + 1], np.zeros(9)
        mujoco.mju_quat2Mat(R, mj.body_iquat[k + 1])
        E = R.reshape(3, 3) @ np.diag(mj.body_inertia[k + 1]) @ R.reshape(3, 3).T + m * (
            c @ c * np.eye(3) - np.outer(c, c)
        )
        out |= {f"m{k + 1}": m, f"mx{k + 1}": m * c[0], f"my{k + 1}": m * c[1], f"mz{k + 1}": m * c[2]}
        out |= {f"I{'xyz'[i]}{'xyz'[j]}{k + 1}": E[i, j] for i in range(3) for j in range(i, 3)}
    for k in range(2):
        out |= {f"fv{k + 2}": VISCOUS[k], f"fc{k + 2}": COULOMB[k]}  # the legs are the second and third link
    return out


def test_a_free_flyer_with_measured_wrenches_is_identified_within_its_intervals(found: Identification, folder: Path):
    truth = truth_of(folder)
    assert found.rank == found.structural_rank
    assert found.joints[:6] == tuple(f"root.{axis}" for axis in ("vx", "vy", "vz", "wx", "wy", "wz"))
    scores = []
    for one in found.base:
        terms = re.findall(r"([+-]?) ?(\d[\d.e+-]*)? ?([A-Za-z]+\d+)", one.expression)
        value = sum((-1.0 if s == "-" else 1.0) * float(f or 1) * truth[name] for s, f, name in terms)
        scores.append((one.value - value) / one.std)
    scores = np.array(scores)
    assert np.mean(np.abs(scores) < 1.96) > 0.85, scores
    assert np.abs(scores).max() < 4.5, scores
    mass = next(p for p in found.parameters if p.name == "m1")
    assert mass.status == "prior only"  # the trunk's mass alone stands in the sum of all masses
    assert sum(one.status == "identified" for one in found.base) > 0.9 * found.rank


def test_the_held_out_flight_is_predicted_to_its_noise(found: Identification):
    held = found.holdout["held.npz"]
    assert (held.relative < 0.02).all(), held.relative
    assert (np.asarray(found.nominal.rms) > 2 * np.asarray(found.fit.rms)).all()
    assert all(link.consistent for link in found.links)


def test_predictions_of_the_held_out_flight_hold_the_wrench_on_the_root_too(found: Identification, task: Path):
    time, torque = predictions(load_task(task), found.model, identified=True)["held"]
    with np.load(task.parent / "held.npz") as held:
        inside = slice(1000, -1000)
        error = torque[inside] - held["tau"][inside]
        assert (time == held["t"]).all()
        assert (error.std(axis=0) < 0.1 * held["tau"][inside].std(axis=0)).all()


def test_friction_stands_in_the_rows_of_the_joints_alone(found: Identification):
    at = [name for effect in found.effects for name in effect.name.at]
    assert sorted(set(at)) == ["elbow", "shoulder"]


def test_a_floating_base_with_friction_is_rnea_plus_friction(folder: Path):
    model = fj.load_mjcf(flyer(folder))
    terms = friction_terms(model, Baseline(rotor=True, offset=True))
    q, v, a = random_states(model, 50, 3)
    tau = np.array(fj.inverse_dynamics(model, q, v, a))
    drives = np.array([0.9, 0.5, 1.2, 0.4, 0.03, 0.02, 0.1, -0.2])
    extra = [
        (drives[k] * v[:, 6:].T[k] + drives[2 + k] * np.sign(v[:, 6 + k]) + drives[4 + k] * a[:, 6 + k] + drives[6 + k])
        for k in range(2)
    ]
    tau[:, 6:] += np.stack(extra, axis=1)
    piece = next(States(model, lambda: [(q, v, a, tau)], terms).pieces())
    theta = np.append(np.ravel(model.inertia), drives)
    np.testing.assert_allclose(piece.X[:50] @ theta, tau, rtol=0, atol=1e-12 * np.abs(tau).max())


def test_rates_on_the_group_are_exact_for_a_screw_and_fourth_order_for_a_flight(folder: Path):
    pin = pytest.importorskip("pinocchio")
    model = fj.load_mjcf(flyer(folder))
    robot = pin.buildModelFromMJCF(str(flyer(folder)))
    twist, spin = np.array([0.3, -0.2, 0.4, 1.1, -0.7, 0.9, 0.5, -0.3]), np.array([0.0] * 8)
    dt, t = 0.01, np.arange(40) * 0.01
    start = pin.neutral(robot)
    screw = np.array([pin.integrate(robot, start, twist * s + spin * s * s) for s in t])
    v, a = group_rates(model, screw, dt)
    np.testing.assert_allclose(v, np.tile(twist, (40, 1)), rtol=0, atol=1e-11)
    np.testing.assert_allclose(a, 0, atol=1e-8)

    def path(s: float) -> tuple[np.ndarray, np.ndarray]:
        """A turn by two angles; angular velocity in the axes of the body by the rule of the product."""
        x, y = 0.8 * np.sin(2 * s), 0.6 * np.cos(3 * s)
        dx, dy = 1.6 * np.cos(2 * s), -1.8 * np.sin(3 * s)
        R = pin.utils.rotate("x", x) @ pin.utils.rotate("y", y)
        w = pin.utils.rotate("y", y).T @ [dx, 0, 0] + [0, dy, 0]
        q = np.concatenate([[np.sin(s), np.cos(s), s * s], pin.Quaternion(R).coeffs(), [0.0, 0.0]])
        return q, np.concatenate([R.T @ [np.cos(s), -np.sin(s), 2 * s], w, [0.0, 0.0]])

    h = 1e-6
    q, v = (np.array([path(s)[k] for s in t]) for k in range(2))
    a = np.array([(path(s + h)[1] - path(s - h)[1]) / (2 * h) for s in t])
    gv, ga = group_rates(model, q, dt)
    np.testing.assert_allclose(gv[2:-2], v[2:-2], rtol=0, atol=1e-5)
    np.testing.assert_allclose(ga[2:-2], a[2:-2], rtol=0, atol=1e-4)


# the sensors of MuJoCo's own: a plate under the first body and a wrist before the tool
SENSED = """<mujoco model="sensed"><compiler angle="radian"/><worldbody>
<body name="slab" pos="0.1 0.2 0.3" quat="0.9 0.2 0 0.1">
<inertial pos="0 0 0" mass="1e-9" diaginertia="1e-12 1e-12 1e-12"/>
<site name="plate" pos="0.03 -0.02 0" quat="0.7 0.1 0.5 0.2"/>
<body name="a" pos="0 0 0.1"><joint name="j1" axis="0 0 1"/>
 <inertial pos="0.02 0.03 0.1" mass="3" fullinertia="0.03 0.04 0.02 0.001 0.002 -0.003"/>
 <body name="b" pos="0.1 0 0.3" quat="0.8 0.4 0 0.3"><joint name="j2" axis="0 1 0"/>
  <inertial pos="0.1 0.01 0" mass="2" fullinertia="0.01 0.03 0.03 0.001 0 0.002"/>
  {welded}
 </body></body></body></worldbody>
<sensor><force site="plate"/><torque site="plate"/>{more}</sensor></mujoco>"""
TOOL = """<body name="tool" pos="0.25 0.02 0.01" quat="0.6 0.3 -0.5 0.4"><site name="wrist"/>
 <inertial pos="0.03 -0.02 0.06" mass="0.8" fullinertia="0.004 0.005 0.003 0.0002 0.0001 -0.0003"/></body>"""
BARE = '<site name="wrist" pos="0.25 0.02 0.01" quat="0.6 0.3 -0.5 0.4"/>'


@pytest.fixture(scope="module")
def sensed(folder: Path) -> tuple[fj.RobotModel, list[np.ndarray]]:
    """The robot without its tool, and (q, v, a, tau, plate, wrist) of MuJoCo with it."""
    path = folder / "sensed.xml"
    path.write_text(SENSED.format(welded=TOOL, more='<force site="wrist"/><torque site="wrist"/>'))
    mj = mujoco.MjModel.from_xml_path(str(path))
    data, random = mujoco.MjData(mj), np.random.default_rng(None)
    q, v, a = random.uniform(-2, 2, (3, 300, 2))
    out = []
    for k in range(300):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(mj, data)
        out.append(np.concatenate([data.qfrc_inverse, data.sensordata]))
    path.write_text(SENSED.format(welded=BARE, more=""))
    return fj.load_mjcf(path), [q, v, a, *np.split(np.array(out), [2, 8], axis=1)]


def test_wrench_rows_of_a_plate_are_mujocos(sensed: tuple[fj.RobotModel, list[np.ndarray]]):
    """Our robot has no tool: what MuJoCo's wrist feels is added."""
    model, (q, v, a, tau, plate, wrist) = sensed
    links = np.ravel(np.asarray(model.inertia))
    bare = np.asarray(wrench_regressor(model, q, v, a, "plate")) @ links
    tool = _in_axes_of_plate(model, q, wrist)
    np.testing.assert_allclose(bare + tool, plate, rtol=0, atol=1e-6 * np.abs(plate).max())


def _in_axes_of_plate(model: fj.RobotModel, q: np.ndarray, wrist: np.ndarray) -> np.ndarray:
    """The wrist's wrench about the plate's frame, by poses."""
    at, to = (np.asarray(fj.frame_placement(model, q, name)) for name in ("wrist", "plate"))
    f, n = (np.einsum("sij,sj->si", at[:, :3, :3], x) for x in (wrist[:, :3], wrist[:, 3:]))
    n = n + np.cross(at[:, :3, 3] - to[:, :3, 3], f)
    return np.concatenate([np.einsum("sji,sj->si", to[:, :3, :3], x) for x in (f, n)], axis=1)


@pytest.mark.parametrize("frame", ["plate", "wrist"])
def test_a_sensor_beside_the_joints_identifies_more_and_the_tool(
    frame: str, sensed: tuple[fj.RobotModel, list[np.ndarray]]
):
    model, (q, v, a, tau, plate, wrist) = sensed
    random, offset = np.random.default_rng(5), np.array([3.0, -1.0, 2.0, 0.1, 0.2, -0.3])
    drives = np.array([0.4, 0.3, 0.7, 0.5])
    measured = (plate if frame == "plate" else wrist) + offset + 1e-3 * random.standard_normal(plate.shape)
    torque = tau + drives[:2] * v + drives[2:] * np.sign(v) + 1e-3 * random.standard_normal(tau.shape)
    rows = SensorStates(model, lambda: [(q, v, a, torque, measured)], frame, friction_terms(model, Baseline()))
    base = rows.structural
    assert base.rank > States(model, list, rows.terms).structural.rank
    found = solve(condense(rows, rows.used), WeightedByJoint(), kept=base.independent)
    assert (found.rms < 1.2e-3).all()
    links = np.ravel(np.asarray(model.inertia)).copy()
    names = list(rows.names)
    tool = np.array([0.8, 0.024, -0.016, 0.048])
    if frame == "plate":
        return
    for name, value in zip(("m", "mx", "my", "mz"), tool, strict=True):
        k = base.names.index(f"{name}_wrist")
        value_found = base.matrix[list(base.independent).index(k)] @ found.parameters if k in base.independent else None
        assert value_found == pytest.approx(value, abs=2e-3)
    for k, value in zip([names.index(n) for n in ("fv1", "fv2", "fc1", "fc2")], drives, strict=True):
        assert found.parameters[k] == pytest.approx(value, abs=2e-3)
    assert links.size == 20


def test_wrong_wrenches_and_quaternions_are_named(task: Path, tmp_path: Path):
    model = fj.load_mjcf(task.parent / "flyer1.xml")
    with pytest.raises(InputError, match="wrench on 'palm' has shape"):
        generalized_force(model, np.zeros((5, 9)) + np.eye(9)[6], {"palm": np.zeros((5, 3))})
    with pytest.raises(InputError, match="has no frame 'plam'; did you mean 'palm'"):
        generalized_force(model, np.zeros((5, 9)) + np.eye(9)[6], {"plam": np.zeros((5, 6))})
    given = dict(np.load(task.parent / "fit.npz"))
    given["q"][20, 3:7] *= 0.5
    np.savez(tmp_path / "fit.npz", **given)
    (tmp_path / "t.yaml").write_text(f"extends: {task}\ndata: [{{file: fit.npz, time: t, position: q, torque: tau}}]")
    with pytest.raises(InputError, match="quaternion of 'root' .* has length 0.5 in row 20"):
        fj.identify_task(load_task(tmp_path / "t.yaml"))
