"""The written model: URDF against Pinocchio, MJCF against MuJoCo C, the folder read back against what was written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import mujoco
import numpy as np
import pinocchio as pin
import pytest
import robots
import yaml

import figaroh_jax as fj
from figaroh_jax.effects.base import Effect, Motion, amplitude, place
from figaroh_jax.effects.catalogue import CATALOGUE, find, register
from figaroh_jax.effects.extended import ExtendedModel, extend, predict
from figaroh_jax.effects.simulation import simulate
from figaroh_jax.errors import InputError
from figaroh_jax.formats.export import load_model, model_files, write_model
from figaroh_jax.formats.mjcf import load_mjcf
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.results import Cause, Estimate, Gain, Name
from figaroh_jax.rigid.inertia import is_physical
from figaroh_jax.rigid.kinematics import frame_placement
from figaroh_jax.rigid.model import RobotModel

LIMIT = '<limit lower="-1.5" upper="2.5" velocity="3" effort="40"/>'
# two branches, a prismatic joint, frames on the base and on moving links; `quarter` stands at the pole of rpy
BRANCHES = robots.robot(
    *robots.LINKS,
    robots.link("e", 0.3),
    '<link name="camera"/>',
    robots.joint("hip", "base", "a", axis="0 1 0", more=LIMIT),
    robots.joint("knee", "a", "b", axis="1 0 1", more=LIMIT),
    robots.joint("weld", "b", "c", "fixed"),
    robots.joint("finger", "c", "d", "prismatic", "1 1 0", more=LIMIT),
    robots.joint("quarter", "base", "e", axis="1 0 0", rpy="0.3 1.5707963267948966 -0.2", more=LIMIT),
    robots.joint("mount", "base", "camera", "fixed"),
)
DRIVES = [  # effects that MuJoCo has elements for
    ("rotor_inertia", ["hip"], {"inertia": 0.2}),
    ("rotor_inertia", ["knee"], {"inertia": 0.3}),
    ("viscous_friction", ["hip"], {"damping": 0.9}),
    ("viscous_friction", ["knee"], {"damping": 1.2}),
    ("viscous_friction", ["finger"], {"damping": 2.5}),
    ("joint_spring", ["knee"], {"stiffness": 7.0, "offset": -2.0}),
    ("joint_spring", ["knee"], {"stiffness": 3.0, "offset": 1.0}),
    ("torque_offset", ["quarter"], {"offset": 0.8}),
    ("coupled_transmission", ["hip", "knee"], {"inertia": 0.1, "damping": 0.6, "sign": -1.0}),
]
BODIES = [
    ("gravity_tilt", [], {"x": 0.4, "y": -0.3}),
    ("payload", ["d"], {"mass": 0.5, "mx": 0.02, "mz": 0.05, "ixx": 0.02, "iyy": 0.02, "izz": 0.01}),
    ("link_inertia", ["b"], {"mass": 0.1, "my": 0.01, "ixx": 0.003, "iyy": 0.002, "izz": 0.004}),
]
REST = [
    ("stribeck_friction", ["hip"], {"force": 1.2, "speed": 0.3}),
    ("torque_gain", ["finger"], {"gain": 0.07}),
    ("torque_delay", [], {"delay": 0.005}),
    ("joint_elasticity", ["knee"], {"compliance": 2e-4}),
]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    return robots.load(BRANCHES, tmp_path_factory.mktemp("branches"))


def put(model: RobotModel, *effects: tuple[str, list[str], dict[str, float]]) -> ExtendedModel:
    return extend(model, *(place(find(name), model, at, **values) for name, at, values in effects))


def content(folder: Path) -> dict:
    return yaml.safe_load((folder / "effects.yaml").read_text())


def assert_same_robot(found: RobotModel, wanted: RobotModel, atol: float = 1e-10) -> None:
    assert [j[:5] for j in found.joints] == [j[:5] for j in wanted.joints]
    for leaf in ("placement", "axis", "ratio", "offset", "gravity", "inertia"):
        np.testing.assert_allclose(getattr(found, leaf), getattr(wanted, leaf), rtol=0, atol=atol, err_msg=leaf)
    q = robots.states(wanted, 1)[0][0]
    for frame in wanted.frames:
        poses = (np.asarray(frame_placement(m, q, frame.name)) for m in (found, wanted))
        np.testing.assert_allclose(*poses, rtol=0, atol=atol, err_msg=frame.name)


def assert_reloads(model: RobotModel, folder: Path) -> None:
    write_model(extend(model), folder)
    found = load_urdf(folder / "robot.urdf", joints=model.joint_names)
    assert_same_robot(found, model)
    np.testing.assert_allclose(found.effort_limit, np.minimum(model.effort_limit, 1e9))
    in_mjcf = load_mjcf(folder / "robot.xml", joints=model.joint_names)
    physical = is_physical(np.asarray(model.inertia))[:, None]  # of the others mass and centre of mass are kept
    np.testing.assert_allclose(in_mjcf.inertia[:, :4], model.inertia[:, :4], rtol=0, atol=1e-10)
    inertia = np.where(physical, in_mjcf.inertia, model.inertia)
    assert_same_robot(eqx.tree_at(lambda m: m.inertia, in_mjcf, inertia), model)
    assert_same_robot(load_model(folder).robot, model)


@pytest.mark.parametrize("text", [BRANCHES, *robots.INLINE.values()], ids=["branches", *robots.INLINE])
def test_tiny_robots_reload_from_each_file(text: str, tmp_path: Path):
    assert_reloads(robots.load(text, tmp_path), tmp_path / "model")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name in ("panda", "talos", "tiago"))) for name in robots.REAL],
)
def test_real_robots_reload_from_each_file(name: str, data_dir: Path, tmp_path: Path):
    assert_reloads(load_urdf(data_dir / robots.REAL[name]), tmp_path)
    mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))


def test_pinocchio_reads_the_same_robot_from_the_urdf(model: RobotModel, tmp_path: Path):
    extended = put(model, *BODIES[1:])
    write_model(extended, tmp_path)
    robot = pin.buildModelFromUrdf(str(tmp_path / "robot.urdf"))
    data, names = robot.createData(), list(robot.names)[1:]
    order = [names.index(name) for name in model.joint_names]
    q, v, a = robots.states(model, 20)
    place_in_pin = np.argsort(order)
    torques = [pin.rnea(robot, data, *(x[place_in_pin] for x in state))[order] for state in zip(q, v, a, strict=True)]
    np.testing.assert_allclose(extended.inverse_dynamics(q, v, a), torques, rtol=0, atol=1e-9)
    for frame in model.frames:
        pin.framesForwardKinematics(robot, data, q[0][place_in_pin])
        pose = data.oMf[robot.getFrameId(frame.name)].homogeneous
        np.testing.assert_allclose(frame_placement(model, q[0], frame.name), pose, rtol=0, atol=1e-9)


def test_urdf_carries_damping_and_friction(model: RobotModel, tmp_path: Path):
    write_model(put(model, DRIVES[2], ("coulomb_friction", ["hip"], {"force": 1.5})), tmp_path)
    robot = pin.buildModelFromUrdf(str(tmp_path / "robot.urdf"))
    column = robot.joints[robot.getJointId("hip")].idx_v
    assert robot.damping[column] == 0.9
    assert robot.friction[column] == 1.5


def in_mujoco(
    extended: ExtendedModel, folder: Path, **options: int
) -> tuple[mujoco.MjModel, mujoco.MjData, np.ndarray]:
    write_model(extended, folder)
    simulator = mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
    for flag in (mujoco.mjtDisableBit.mjDSBL_LIMIT, mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL):
        simulator.opt.disableflags |= flag
    place = [simulator.joint(name).dofadr[0] for name in extended.robot.joint_names]
    return simulator, mujoco.MjData(simulator), np.array(place)


def accelerations(extended: ExtendedModel, folder: Path, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """What MuJoCo C makes of the drives' torques, given to the actuators."""
    simulator, data, place = in_mujoco(extended, folder)
    simulator.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    answers = []
    for position, velocity, torque in zip(q, v, tau, strict=True):
        data.qpos[place], data.qvel[place] = position, velocity
        for name, value in zip(extended.robot.joint_names, torque, strict=True):
            data.actuator(name).ctrl = value
        mujoco.mj_forward(simulator, data)
        answers.append(data.qacc[place].copy())
    return np.array(answers)


@pytest.mark.parametrize("effects", [*([e] for e in (*DRIVES, *BODIES)[1:8]), DRIVES, [*DRIVES, *BODIES]])
def test_mujoco_moves_as_the_extended_model(effects: list, model: RobotModel, tmp_path: Path):
    extended = put(model, *effects)
    assert all(effect["mjcf"] for effect in written(extended, tmp_path)["effects"])
    q, v, a = robots.states(model, 10)
    tau = np.asarray(extended.inverse_dynamics(q, v, a))
    np.testing.assert_allclose(accelerations(extended, tmp_path, q, v, tau), a, rtol=0, atol=1e-9)


def test_mujoco_inverse_dynamics_is_ours(model: RobotModel, tmp_path: Path):
    extended = put(model, *DRIVES[:7], *DRIVES[8:], *BODIES)
    simulator, data, place = in_mujoco(extended, tmp_path)
    q, v, a = robots.states(model, 10)
    for state, torque in zip(zip(q, v, a, strict=True), extended.inverse_dynamics(q, v, a), strict=True):
        data.qpos[place], data.qvel[place], data.qacc[place] = state
        mujoco.mj_inverse(simulator, data)
        np.testing.assert_allclose(data.qfrc_inverse[place], torque, rtol=0, atol=1e-9)


def test_mujoco_friction_of_a_sliding_joint_and_coupling_is_ours(model: RobotModel, tmp_path: Path):
    coupling = ("coupled_transmission", ["hip", "knee"], {"friction": 0.7, "sign": -1.0})
    extended = put(model, ("coulomb_friction", ["finger"], {"force": 1.5}), coupling)
    simulator, data, place = in_mujoco(extended, tmp_path)
    data.qvel[place] = [2.0, -1.0, -3.0, 0.5]
    mujoco.mj_forward(simulator, data)
    np.testing.assert_allclose(data.qfrc_constraint[place], [-0.7, 0.7, 1.5, 0.0], rtol=0, atol=1e-9)


def written(extended: ExtendedModel, folder: Path) -> dict:
    write_model(extended, folder)
    return content(folder)


def test_everything_reloads_to_the_same_torques(model: RobotModel, tmp_path: Path):
    extended = eqx.tree_at(lambda m: m.width, put(model, *DRIVES, *BODIES, *REST), np.array([0.0, 0.01, 0.02, 0.0]))
    write_model(extended, tmp_path)
    found = load_model(tmp_path)
    q, v, a = robots.states(model, 20)
    torques = (m.inverse_dynamics(q, v, a) for m in (found, extended))
    np.testing.assert_allclose(*torques, rtol=0, atol=1e-11)
    time = 0.01 * np.arange(20)
    np.testing.assert_allclose(*(predict(m, time, q, v, a, 0.01) for m in (found, extended)), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found.width, extended.width)
    np.testing.assert_array_equal(found.robot.position_limit, model.position_limit)
    assert model_files(found)["effects.yaml"] == model_files(extended)["effects.yaml"]


def test_every_effect_of_the_catalogue_is_written_and_comes_back(model: RobotModel, tmp_path: Path):
    at = {"joint": ["knee"], "pair": ["hip", "knee"], "link": ["d"], "robot": []}
    effects = [place(effect, model, at[effect.acts_on]) for effect in CATALOGUE.values()]
    effects = [eqx.tree_at(lambda e: getattr(e, list(e.parameters())[0]), e, np.float64(0.01)) for e in effects]
    answer = written(extend(model, *effects), tmp_path)
    assert [entry["effect"] for entry in answer["effects"]] == list(CATALOGUE)
    for effect, back in zip(effects, load_model(tmp_path).effects, strict=True):
        assert type(back) is type(effect)
        np.testing.assert_array_equal(back.at, effect.at)
        assert [float(getattr(back, key)) for key in effect.parameters()] == [
            float(getattr(effect, key)) for key in effect.parameters()
        ]


def test_what_a_file_lacks_is_listed(model: RobotModel, tmp_path: Path):
    answer = written(put(model, *DRIVES, *BODIES, *REST), tmp_path)
    lines = answer["warnings"]
    for entry in answer["effects"]:
        for form, file in (("urdf", "robot.urdf"), ("mjcf", "robot.xml")):
            name = str(Name(entry["effect"], tuple(entry["at"])))
            assert any(line.startswith(f"{file} lacks {name}:") for line in lines) != entry[form]
    carried = {entry["effect"] for entry in answer["effects"] if entry["urdf"]}
    assert carried == {"viscous_friction", "payload", "link_inertia"}
    assert {entry["effect"] for entry in answer["effects"] if not entry["mjcf"]} == {name for name, *_ in REST}


def test_a_coupling_without_rotors_to_take_it_from_is_not_forced_on_mujoco(model: RobotModel, tmp_path: Path):
    coupling = ("coupled_transmission", ["hip", "knee"], {"inertia": 0.1, "damping": 0.6, "friction": 1.0})
    answer = written(put(model, DRIVES[0], coupling), tmp_path)
    assert not answer["effects"][1]["mjcf"]
    assert "armature of knee would be -0.1, below zero" in answer["effects"][1]["not in mjcf"]
    simulator = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    assert simulator.ntendon == 0
    assert simulator.joint("hip").damping[0] == 0
    assert len(load_model(tmp_path).effects) == 2


@pytest.mark.parametrize("name", ["viscous_friction", "coulomb_friction", "rotor_inertia"])
def test_a_negative_friction_or_rotor_is_listed_and_not_written(name: str, model: RobotModel, tmp_path: Path):
    (parameter,) = find(name).parameters()
    answer = written(put(model, (name, ["hip"], {parameter: -0.2})), tmp_path)
    assert not answer["effects"][0]["mjcf"] and "below zero" in answer["effects"][0]["not in mjcf"]
    mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))


@pytest.mark.parametrize(
    ("ten", "remedy"),
    [
        ([1.0, 0, 0, 0, 0.01, 0, 0.01, 0, 0, 0.05], ["xml"]),  # breaks the triangle inequality: URDF does not mind
        ([1.0, 0.5, 0, 0, 0.01, 0, 0.01, 0, 0, 0.01], ["urdf", "xml"]),  # too far from the axis for its inertia
        ([-0.2, 0, 0, 0.01, 0.01, 0, 0.01, 0, 0, 0.01], ["urdf", "xml"]),  # a negative mass
        ([0.0, 0.1, 0, 0, 0.01, 0, 0.01, 0, 0, 0.01], ["urdf", "xml"]),  # a first moment without a mass
        ([0.0] * 10, ["xml"]),
    ],
)
def test_links_that_cannot_exist_are_mended_with_a_warning_and_come_back_as_fitted(
    ten: list[float], remedy: list[str], model: RobotModel, tmp_path: Path
):
    inertia = np.array(model.inertia)
    inertia[1] = ten
    fitted = eqx.tree_at(lambda m: m.inertia, model, inertia)
    warnings = written(extend(fitted), tmp_path)["warnings"]
    assert [line.split()[0] for line in warnings] == [f"robot.{file}:" for file in remedy]
    assert all("link b " in line for line in warnings)
    mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    pin.buildModelFromUrdf(str(tmp_path / "robot.urdf"))
    np.testing.assert_allclose(load_model(tmp_path).robot.inertia, inertia, rtol=0, atol=0)
    if "urdf" not in remedy:
        reloaded = load_urdf(tmp_path / "robot.urdf", joints=model.joint_names)
        np.testing.assert_allclose(reloaded.inertia, inertia, rtol=0, atol=1e-12)


def test_standard_deviations_come_from_the_causes(model: RobotModel, tmp_path: Path):
    estimate = {"force": Estimate(1.2, 0.1, "N m"), "speed": Estimate(0.3, 0.02, "rad/s")}
    cause = Cause(Name("stribeck_friction", ("hip",)), estimate, 0.9, Gain(0.2, 0.1))
    write_model(put(model, REST[0], DRIVES[4]), tmp_path, [cause])
    first, second = content(tmp_path)["effects"]
    assert first["parameters"]["force"] == {"value": 1.2, "std": 0.1, "unit": "N m"}
    assert second["parameters"]["damping"] == {"value": 2.5, "std": None, "unit": "N s/m"}


class Magnet(Effect):
    """A magnet that pulls towards zero."""

    name, title, equation, acts_on = "magnet", "a magnet", "pull sin q", "joint"
    pull: np.ndarray | float = amplitude("N m")

    def torque(self, motion: Motion):
        return self.pull * np.sin(1.0) * self.here(motion.position)


def test_an_effect_of_the_users_own_comes_back_once_registered(model: RobotModel, tmp_path: Path):
    write_model(extend(model, place(Magnet, model, ["hip"], pull=0.4)), tmp_path)
    with pytest.raises(InputError, match="no effect 'magnet' in the catalogue"):
        load_model(tmp_path)
    register(Magnet)
    assert load_model(tmp_path).effects[0].pull == 0.4  # pyright: ignore[reportAttributeAccessIssue]


def edited(change: Callable[[dict], object]) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        keys = content(folder)
        change(keys)
        (folder / "effects.yaml").write_text(yaml.safe_dump(keys))

    return edit


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "effects.yaml").unlink(), "effects.yaml does not exist"),
        (lambda folder: (folder / "robot.urdf").unlink(), "robot.urdf does not exist"),
        (edited(lambda keys: keys.pop("joints")), "the key 'joints' is missing"),
        (edited(lambda keys: keys["joints"][0].update(name="hop")), "no joint 'hop'; did you mean 'hip'"),
        (edited(lambda keys: keys["effects"][0].update(effect="viscous")), "did you mean 'viscous_friction'"),
        (edited(lambda keys: keys["effects"][0].update(at=["elbow"])), "no joint 'elbow'"),
        (edited(lambda keys: keys["effects"][0]["fields"].update(dumping=1)), "no parameter 'dumping'"),
        (edited(lambda keys: keys["effects"][0]["fields"].update(damping="much")), "not as figaroh-jax writes it"),
        (edited(lambda keys: keys["links"][0]["inertia"].pop()), r"shape \(9,\) where \(10,\) are expected"),
        (edited(lambda keys: keys.update(effects=3)), "not as figaroh-jax writes it"),
    ],
)
def test_a_damaged_folder_is_refused(damage: Callable, message: str, model: RobotModel, tmp_path: Path):
    write_model(put(model, DRIVES[2]), tmp_path)
    damage(tmp_path)
    with pytest.raises(InputError, match=message):
        load_model(tmp_path)


def test_a_folder_that_is_none_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="is not a folder"):
        load_model(tmp_path / "nothing")


def test_mujoco_and_our_simulation_stay_together(model: RobotModel, tmp_path: Path):
    """Both are first order in the step: half the step, half the distance after .3 s of falling and swinging."""
    extended = put(model, *DRIVES, *BODIES)
    simulator, data, place = in_mujoco(extended, tmp_path)
    start, torque = np.array([0.3, -0.4, 0.1, 0.5]), np.array([5.0, 2.0, -3.0, 1.0])

    def apart(dt: float) -> float:
        steps = round(0.3 / dt)
        simulator.opt.timestep = dt
        mujoco.mj_resetData(simulator, data)
        data.qpos[place] = start
        for name, value in zip(model.joint_names, torque, strict=True):
            data.actuator(name).ctrl = value
        for _ in range(steps):
            mujoco.mj_step(simulator, data)
        ours = simulate(extended, np.tile(torque, (1201, 1)), start, np.zeros(4), dt).position[steps]
        return float(np.abs(data.qpos[place] - ours).max())

    coarse, fine = apart(5e-4), apart(2.5e-4)
    assert fine < 2e-3
    assert coarse / fine == pytest.approx(2.0, rel=0.2)


def test_a_model_that_no_file_can_hold_and_a_place_that_is_none_are_told(model: RobotModel, tmp_path: Path):
    inertia = np.asarray(model.inertia).copy()
    inertia[1, 2] = np.nan
    wrong = eqx.tree_at(lambda m: m.inertia, model, inertia)
    with pytest.raises(InputError, match=rf"inertia of link '{model.link_names[1]}' holds nan"):
        fj.write_model(wrong, tmp_path / "model")
    assert not (tmp_path / "model").exists()
    (tmp_path / "note").write_text("mine")
    for where in ("note", "note/model"):
        with pytest.raises(InputError, match="cannot be written: .*; name another folder"):
            fj.write_model(model, tmp_path / where)
    assert (tmp_path / "note").read_text() == "mine"


def test_a_users_loop_is_not_replaced(tmp_path: Path):
    loop, _ = fj.load_loop(fj.DEMO, {"elbow": {"kind": "torque"}}, joints=["elbow"])
    (tmp_path / "loop.json").write_text('{"name": "mine"}')
    with pytest.raises(InputError, match=r"loop\.json is there and is none that write_loop wrote"):
        fj.write_loop(loop, tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["loop.json"]
    (tmp_path / "loop.json").unlink()
    fj.write_loop(loop, tmp_path)
    fj.write_loop(loop, tmp_path)  # its own
    fj.write_model(loop.robot, tmp_path)
    fj.write_loop(loop, tmp_path)
    assert fj.read_loop(tmp_path).robot.dof_names == ("elbow",)
    edited = (tmp_path / "loop.json").read_text().replace("{", "{ ", 1)
    (tmp_path / "loop.json").write_text(edited)
    with pytest.raises(InputError, match=r"loop\.json was changed after write_loop wrote it"):
        fj.write_loop(fj.load_loop(fj.DEMO, {"wrist": {"kind": "torque"}}, joints=["wrist"])[0], tmp_path)
    assert (tmp_path / "loop.json").read_text() == edited


def test_a_users_file_is_not_replaced(tmp_path: Path):
    model = load_urdf(fj.DEMO)
    own = tmp_path / "robot.urdf"
    own.write_text("mine")
    with pytest.raises(InputError, match=r"robot\.urdf is there and is none that write_model wrote"):
        write_model(model, tmp_path)
    assert own.read_text() == "mine" and list(tmp_path.iterdir()) == [own]
    write_model(model, tmp_path / "new")
    write_model(extend(model), tmp_path / "new")  # what it has written it may write anew
    for name in ("robot.urdf", "robot.xml", "effects.yaml"):
        folder = tmp_path / name.replace(".", "_")
        write_model(model, folder)
        before = (folder / name).read_text()
        edited = before.replace("demo_arm", "my_arm", 1)
        assert edited != before
        (folder / name).write_text(edited)
        with pytest.raises(InputError, match=rf"{name} was changed after write_model wrote it"):
            write_model(model, folder)
        assert (folder / name).read_text() == edited
        (folder / name).write_text(before + "# mine\n")  # behind all that was written
        with pytest.raises(InputError, match=rf"{name} was changed after write_model wrote it"):
            write_model(model, folder)
