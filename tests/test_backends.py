"""Backends: one contract, found by name, and every one gives Pinocchio's answers."""

from __future__ import annotations

import dataclasses
import os
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import Any

import figaroh_jax_mjx
import figaroh_jax_mujoco
import figaroh_jax_pinocchio
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import robots
import toy_backend
from hypothesis import given, settings, strategies as st

from figaroh_jax.compiled.batching import DRAFT_OPTIONS, program
from figaroh_jax.errors import InputError, NotSupported
from figaroh_jax.simulators import registry
from figaroh_jax.simulators.contract import FUNCTIONS, Backend
from figaroh_jax.simulators.native import NativeBackend

# One line a backend: the type checker compares the signatures with the contract.
native: type[Backend] = NativeBackend
mjx: type[Backend] = figaroh_jax_mjx.MjxBackend
mujoco_c: type[Backend] = figaroh_jax_mujoco.MujocoBackend
pinocchio: type[Backend] = figaroh_jax_pinocchio.PinocchioBackend
toy: type[Backend] = toy_backend.ToyBackend
CLASSES = {"native": native, "mjx": mjx, "mujoco": mujoco_c, "pinocchio": pinocchio}

TOLERANCE = {"native": 1e-10, "mujoco": 1e-9, "mjx": 1e-8}
SAMPLES = 100
SEED = int.from_bytes(os.urandom(2), "little")  # the states of a run; a failure shows it
ROBOTS = [*robots.INLINE, *robots.MIXED, *robots.REAL, "talos_free"]
LONG_CHAIN = "inverse_dynamics joint_torque_regressor mass_matrix frame_jacobian".split()
ARGUMENTS = {
    "mass_matrix": "q",
    "coriolis_matrix": "q v",
    "gravity_vector": "q",
    "inverse_dynamics": "q v a",
    "forward_dynamics": "q v tau",
    "frame_placements": "q",
    "frame_jacobian": "q",
    "joint_torque_regressor": "q v a",
    "dynamics_derivatives": "q v a",
    "integrate": "q v",
    "difference": "q q1",
}


@lru_cache
def source(robot: str) -> tuple[Path, Any]:
    """File of a robot and its root; skips where it is one of the recordings' and these are not here."""
    if robot in robots.INLINE or robot in robots.MIXED:
        return robots.write(robot), None
    folder = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    path = folder / robots.REAL[robot.removesuffix("_free")]
    if not path.is_file():
        pytest.skip(f"no {path} (FIGAROH_JAX_DATA names the folder)")
    return path, "free_flyer" if robot.endswith("_free") else None


@lru_cache
def made(name: str, robot: str) -> Backend:
    path, root = source(robot)
    return CLASSES[name].build(registry.read_robot(path, root=root), path)


@lru_cache
def states(robot: str) -> dict[str, np.ndarray]:
    reference, rng = made("pinocchio", robot), np.random.default_rng(SEED)
    q, q1 = (np.asarray(reference.random_configuration(rng, (2, SAMPLES // 2))) for _ in range(2))
    v, a = rng.uniform(-2.0, 2.0, (2, *q.shape[:-1], reference.nv))
    return {"q": q, "q1": q1, "v": v, "a": a, "tau": np.asarray(reference.inverse_dynamics(q, v, a))}


@lru_cache
def answer(name: str, robot: str, function: str) -> np.ndarray:
    arguments, backend = [states(robot)[word] for word in ARGUMENTS[function].split()], made(name, robot)
    if function == "frame_jacobian":
        frames = (backend.frame_names[-1], backend.joint_names[-1])
        axes = ("local", "world", "local_world_aligned")
        return np.stack([backend.frame_jacobian(*arguments, frame, a) for frame in frames for a in axes])  # pyright: ignore
    value = getattr(backend, function)(*arguments)
    return np.stack(value) if function == "dynamics_derivatives" else np.asarray(value)


def quick(name: str, robot: str, function: str) -> bool:
    """Whether a case belongs to the quick tests: every compiled program costs seconds, on each robot anew."""
    if name == "native":
        return robot in ("arm", "beast") or (robot == "tree" and function in LONG_CHAIN)
    if name == "mjx" and function != "dynamics_derivatives":
        return robot == "pendulum" or (robot == "beast" and function in LONG_CHAIN)
    return name == "mujoco"


def cases() -> list[Any]:
    """The table robot x function x backend; what a backend inherits from the contract is tested on one robot."""
    table = []
    for name in TOLERANCE:
        for robot in ROBOTS:
            for function in ARGUMENTS:
                inherited = name != "native" and getattr(CLASSES[name], function) is getattr(Backend, function)
                if function not in CLASSES[name].capabilities.functions or (inherited and robot != "beast"):
                    continue
                marks = [] if quick(name, robot, function) else [pytest.mark.slow]
                table.append(pytest.param(robot, function, name, marks=marks))
    return table


@pytest.mark.parametrize(("robot", "function", "name"), cases())
def test_every_backend_gives_pinocchios_answer(robot: str, function: str, name: str) -> None:
    state, message = states(robot), f"seed {SEED}"
    if function == "forward_dynamics" and not np.isfinite(answer("pinocchio", robot, function)).all():
        pytest.skip("a joint of this robot moves no mass")
    got = answer(name, robot, function)
    if function == "forward_dynamics":
        # as torques: an acceleration is only as exact as the mass matrix is well conditioned
        want, got = state["tau"], np.asarray(made("pinocchio", robot).inverse_dynamics(state["q"], state["v"], got))
    elif function == "integrate":  # a quaternion and its negative are one rotation
        got = np.asarray(made("native", robot).difference(answer("pinocchio", robot, function), got))
        want = np.zeros_like(got)
    else:
        want = answer("pinocchio", robot, function)
    np.testing.assert_allclose(got, want, rtol=0, atol=TOLERANCE[name], err_msg=message)


@pytest.mark.parametrize("name", [*TOLERANCE, "pinocchio"])
@pytest.mark.parametrize("robot", ["arm", "tree", "beast", "talos_free"])
def test_every_backend_tells_the_same_of_the_robot(robot: str, name: str) -> None:
    backend, model = made(name, robot), registry.read_robot(source(robot)[0], root=source(robot)[1])
    assert isinstance(backend, Backend)
    assert backend.name == name
    assert (backend.nq, backend.nv) == (model.nq, model.nv)
    assert backend.joint_names == model.joint_names
    assert backend.link_names == model.link_names
    assert backend.frame_id(backend.frame_names[-1]) == len(model.frames) - 1
    assert backend.model_format == ("mjcf" if robot == "beast" else "urdf")
    assert backend.simulator is not None
    np.testing.assert_allclose(backend.inertias, model.inertia, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(backend.position_limit, model.position_limit)
    q = np.asarray(backend.random_configuration(SEED, (50,)))
    limited = [
        i for i, joint in enumerate(model.joints) if joint.kind in ("revolute", "prismatic") and not joint.follows
    ]
    for i in limited:
        lower, upper = model.position_limit[model.joints[i].coordinate]
        column = q[:, model.dofs.positions[i]]
        assert (column >= lower).all() and (column <= upper).all()


@pytest.mark.parametrize("name", CLASSES)
def test_what_a_backend_lacks_it_says_with_those_that_have_it(name: str) -> None:
    backend = made(name, "arm")
    state = states("arm")
    for function in set(FUNCTIONS) - backend.capabilities.functions:
        with pytest.raises(NotSupported, match=f"'{name}' has no {function}; backends that do: native"):
            getattr(backend, function)(*(state[word] for word in ARGUMENTS[function].split()))


@pytest.mark.parametrize("name", ["mujoco", "pinocchio"])
def test_host_backends_refuse_to_be_traced(name: str) -> None:
    with pytest.raises(NotSupported, match="tracing by JAX.*native"):
        jax.jit(made(name, "arm").gravity_vector)(np.zeros(2))


@pytest.mark.parametrize("name", CLASSES)
def test_wrong_shapes_and_frames_are_refused(name: str) -> None:
    backend = made(name, "arm")
    with pytest.raises(InputError, match="q has shape"):
        backend.inverse_dynamics(*np.zeros((3, 3)))
    with pytest.raises(InputError, match="did you mean 'turn'"):
        backend.frame_jacobian(np.zeros(2), "tunr")
    if name != "native":  # whose annotations refuse it while the tests run
        with pytest.raises(InputError, match="reference is 'loca'"):
            backend.frame_jacobian(np.zeros(2), "turn", "loca")  # pyright: ignore[reportArgumentType]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), robot=st.sampled_from(["arm", "tree", "beast", "plane"]))
def test_power_of_the_torques_is_the_rate_of_the_energy(seed: int, robot: str) -> None:
    backend, rng, step = made("mujoco", robot), np.random.default_rng(seed), 1e-5
    q = np.asarray(backend.random_configuration(rng))
    v, a = rng.uniform(-1.0, 1.0, (2, backend.nv))

    def energy(time: float) -> float:
        at, rate = np.asarray(backend.integrate(q, v * time)), v + a * time
        poses = np.asarray(backend.frame_placements(at))
        links = [poses[backend.frame_id(joint.name)] for joint in backend.robot.joints]
        inertias, gravity = np.asarray(backend.inertias), np.append(np.asarray(backend.robot.gravity), 0.0)
        height = sum(gravity @ pose @ np.append(p[1:4], p[0]) for pose, p in zip(links, inertias, strict=True))
        return 0.5 * rate @ np.asarray(backend.mass_matrix(at)) @ rate - height

    # the path leaves q with velocity v and acceleration a up to second order: the velocity is kept in child axes
    rate = (energy(step) - energy(-step)) / (2 * step)
    power = np.asarray(backend.inverse_dynamics(q, v, a)) @ v
    np.testing.assert_allclose(power, rate, rtol=1e-6, atol=1e-5)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), robot=st.sampled_from(["arm", "tree", "beast", "plane"]))
def test_coriolis_matrix_and_its_transpose_are_the_rate_of_the_mass_matrix(seed: int, robot: str) -> None:
    backend, rng, step = made("mujoco", robot), np.random.default_rng(seed), 1e-5
    q = np.asarray(backend.random_configuration(rng))
    v = rng.uniform(-1.0, 1.0, backend.nv)
    ahead, behind = (np.asarray(backend.mass_matrix(backend.integrate(q, sign * step * v))) for sign in (1, -1))
    coriolis = np.asarray(backend.coriolis_matrix(q, v))
    np.testing.assert_allclose(coriolis + coriolis.T, (ahead - behind) / (2 * step), rtol=0, atol=1e-7)


def test_an_mjcf_keeps_what_is_not_rigid_in_the_simulator_alone() -> None:
    backend = made("mujoco", "beast")
    assert backend.simulator.joint("wrist").armature[0] == 0.2
    still = np.zeros(backend.nv)
    q = np.asarray(backend.random_configuration(0))
    column = backend.robot.joint_index("wrist")
    own = np.asarray(made("pinocchio", "beast").mass_matrix(q))[column, column]
    np.testing.assert_allclose(np.asarray(backend.mass_matrix(q))[column, column], own, rtol=0, atol=1e-12)
    np.testing.assert_allclose(backend.inverse_dynamics(q, still, still), backend.gravity_vector(q), rtol=0, atol=1e-12)


def test_mujocos_model_behind_the_backend_simulates_contact() -> None:
    model = made("mujoco", "beast").simulator
    data = mujoco.MjData(model)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert data.ncon > 0
    assert data.qpos[2] > 0.0  # it lies on the floor


def test_an_installed_backend_is_found_by_its_name() -> None:
    if "mujoco" not in registry.names():
        pytest.skip("figaroh-jax is not installed here, so no entry point names its backends")
    assert registry.backend_class("mujoco") is figaroh_jax_mujoco.MujocoBackend
    backend = registry.backend("mujoco", source("arm")[0], root="free_flyer")
    assert backend.nv == 8
    assert backend.joint_names[0] == "root_joint"


def test_an_unknown_backend_is_refused_with_those_installed_and_how_to_install_more() -> None:
    with pytest.raises(InputError, match="no backend 'bullet' is installed; installed: native.*pip install") as told:
        registry.backend("bullet", source("arm")[0])
    assert all(name in str(told.value) for name in registry.names())
    assert "'figaroh-jax[mujoco,mjx,pinocchio,newton,genesis]'" in str(told.value)


@pytest.mark.parametrize("name", CLASSES)
def test_a_robot_of_a_package_needs_no_meshes(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`package://` is found in the folders given; the mesh that the file names exists nowhere."""
    mesh = '<visual><geometry><mesh filename="package://my_arm/meshes/none.stl"/></geometry></visual></link>'
    package = tmp_path / "ros" / "my_arm"
    package.mkdir(parents=True)
    (package / "arm.urdf").write_text(robots.ARM.replace("</link>", mesh))
    monkeypatch.setattr(registry, "backend_class", CLASSES.__getitem__)
    backend = registry.backend(name, "package://my_arm/arm.urdf", packages=[tmp_path / "ros"])
    assert backend.joint_names == ("turn", "slide")
    np.testing.assert_allclose(backend.inertias, made("native", "arm").inertias, rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="my_arm"):
        registry.backend(name, "package://my_arm/arm.urdf", packages=[tmp_path])


def test_a_backend_needs_a_robot() -> None:
    with pytest.raises(InputError, match="for which robot"):
        registry.backend("native")
    with pytest.raises(InputError, match=r"\.urdf or an \.xml"):
        registry.backend("native", "robot.sdf")
    with pytest.raises(InputError, match="is fixed; load it with root='free_flyer'"):
        registry.backend("native", made("native", "arm").robot, root="free_flyer")


def test_a_backend_whose_library_is_missing_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = metadata.EntryPoint("bullet", "no_such_library:Backend", registry.GROUP)
    monkeypatch.setattr(metadata, "entry_points", lambda group: [entry])
    with pytest.raises(InputError, match=r"'bullet' needs the package 'no_such_library'.*pip install"):
        registry.backend("bullet", source("arm")[0])


class _Unreadable(NativeBackend):
    """Its simulator does not read the file."""

    @property
    def simulator(self) -> Any:
        raise InputError("this file is read by others alone")


def test_a_backend_is_one_where_its_simulator_cannot_be_had() -> None:
    """A property that raises is not asked for: Python 3.11 would evaluate it."""
    model = made("native", "pendulum").robot
    assert isinstance(_Unreadable(model), Backend)
    assert not isinstance(model, Backend)
    with pytest.raises(InputError):
        _ = _Unreadable(model).simulator


def test_a_third_party_adds_a_backend_by_an_entry_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = tmp_path / "toy_backend-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-backend\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\ntoy = toy_backend:ToyBackend\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert "toy" in registry.names()
    backend = registry.backend("toy", source("pendulum")[0])
    assert isinstance(backend, Backend)
    q, v, a = np.random.default_rng(SEED).uniform(-2, 2, (3, 5, 1))
    want = made("pinocchio", "pendulum").inverse_dynamics(q, v, a)
    np.testing.assert_allclose(backend.inverse_dynamics(q, v, a), want, rtol=0, atol=1e-12)
    with pytest.raises(NotSupported, match="'toy' has no joint_torque_regressor; backends that do: native"):
        backend.joint_torque_regressor(q, v, a)
    with pytest.raises(InputError, match="one revolute joint"):
        registry.backend("toy", source("arm")[0])


def test_mjx_maps_over_its_leaves() -> None:
    backend: Any = made("mjx", "pendulum")
    q, v, a = np.random.default_rng(SEED).uniform(-1.5, 1.5, (3, 1))
    with jax.enable_x64(True):
        masses = jnp.asarray(backend.simulator.body_mass) * jnp.array([[1.0], [2.0]])

        def torque(mass: Any) -> Any:
            changed = dataclasses.replace(backend, model=backend.simulator.replace(body_mass=mass))
            return changed.inverse_dynamics(q, v, a)

        got = np.asarray(program(jax.vmap(torque), DRAFT_OPTIONS)(masses))
    each = [float(np.asarray(torque(mass))[0]) for mass in np.asarray(masses)]
    np.testing.assert_allclose(got[:, 0], each, rtol=0, atol=1e-12)
