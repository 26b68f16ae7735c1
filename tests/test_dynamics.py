"""Torques, masses and accelerations against Pinocchio, by its own reading of the URDF and by ours."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pinocchio as pin
import pytest
import reference
import robots

from figaroh_jax.compiled.batching import CPU_OPTIONS
from figaroh_jax.errors import InputError
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.rigid import dynamics, kinematics, regressor
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.rigid.scalar_programs import written


class Independent:
    """Pinocchio's own reading of the URDF, its joints matched by name, and continuous joints on the circle."""

    def __init__(self, path: Path, model: RobotModel) -> None:
        self.robot = pin.buildModelFromUrdf(str(path))
        self.data = self.robot.createData()
        tree = {joint.name: i for i, joint in enumerate(model.joints)}
        self.place = [tree[name] for name in list(self.robot.names)[1:]]
        self.offset = np.asarray(model.offset)[self.place]
        self.share = np.zeros((len(self.place), model.nv))
        for row, i in enumerate(self.place):
            self.share[row, model.joints[i].coordinate] = model.ratio[i]

    def configuration(self, q: np.ndarray) -> np.ndarray:
        entries = []
        for joint, x in zip(list(self.robot.joints)[1:], self.share @ q + self.offset, strict=True):
            entries += [np.cos(x), np.sin(x)] if joint.nq == 2 else [x]
        return np.array(entries)

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        tau = pin.rnea(self.robot, self.data, self.configuration(q), self.share @ v, self.share @ a)
        return self.share.T @ tau

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        upper = np.triu(pin.crba(self.robot, self.data, self.configuration(q)))
        return self.share.T @ (upper + np.triu(upper, 1).T) @ self.share


@pytest.mark.parametrize("name", robots.REAL)
def test_torques_and_masses_of_real_robots_equal_pinocchios_from_the_urdf_itself(name: str, data_dir: Path) -> None:
    path = data_dir / robots.REAL[name]
    model = load_urdf(path)
    peer = Independent(path, model)
    q, v, a = robots.states(model, 20)
    torques = [peer.inverse_dynamics(*x) for x in zip(q, v, a, strict=True)]
    np.testing.assert_allclose(dynamics.inverse_dynamics(model, q, v, a), torques, rtol=0, atol=1e-10)
    masses = [peer.mass_matrix(x) for x in q]
    np.testing.assert_allclose(dynamics.mass_matrix(model, q), masses, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", robots.INLINE)
def test_tiny_robots_equal_the_reference_backend(name: str, tmp_path: Path) -> None:
    model = robots.load(robots.INLINE[name], tmp_path, gravity=(1.0, -2.0, -9.0))
    q, v, a = robots.states(model, 6)
    for function, arguments in (
        ("inverse_dynamics", (q, v, a)),
        ("mass_matrix", (q,)),
        ("forward_dynamics", (q, v, a)),
    ):
        ours = getattr(dynamics, function)(model, *arguments)
        theirs = getattr(reference, function)(model, *arguments)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10, err_msg=function)


@pytest.mark.parametrize("name", ["ur10e", "talos"])
def test_forward_dynamics_equals_articulated_bodies(name: str, data_dir: Path) -> None:
    model = load_urdf(data_dir / robots.REAL[name])
    q, v, tau = robots.states(model, 5)
    theirs = reference.forward_dynamics(model, q, v, tau)
    scale = np.abs(theirs).max()
    np.testing.assert_allclose(dynamics.forward_dynamics(model, q, v, tau) / scale, theirs / scale, rtol=0, atol=1e-10)


def test_forward_dynamics_inverts_inverse_dynamics(tmp_path: Path) -> None:
    model = robots.load(robots.TREE, tmp_path)
    q, v, a = robots.states(model, 8)
    torque = dynamics.inverse_dynamics(model, q, v, a)
    np.testing.assert_allclose(dynamics.forward_dynamics(model, q, v, torque), a, rtol=0, atol=1e-10)


def test_power_of_the_torques_is_the_change_of_energy(tmp_path: Path) -> None:
    """d/dt (v' M v / 2 + U) = tau' v, where the potential's gradient is the torque at rest."""
    model = robots.load(robots.TREE, tmp_path)
    q, v, a = (x[0] for x in robots.states(model, 1))
    rest = dynamics.inverse_dynamics(model, q, 0 * v, 0 * v)

    def kinetic(t: float) -> float:
        rate = v + a * t
        return float(0.5 * rate @ dynamics.mass_matrix(model, q + v * t + a * t * t / 2) @ rate)

    h = 1e-5
    change = (kinetic(h) - kinetic(-h)) / (2 * h) + float(rest @ v)
    assert change == pytest.approx(float(dynamics.inverse_dynamics(model, q, v, a) @ v), rel=1e-7)


def test_one_sample_and_any_batch_are_the_same_function(tmp_path: Path) -> None:
    model = robots.load(robots.ARM, tmp_path)
    q, v, a = robots.states(model, 6)
    many = np.asarray(dynamics.inverse_dynamics(model, q, v, a))
    np.testing.assert_allclose(dynamics.inverse_dynamics(model, q[2], v[2], a[2]), many[2], rtol=0, atol=1e-13)
    folded = [x.reshape(3, 1, 2, -1) for x in (q, v, a)]
    np.testing.assert_allclose(np.ravel(dynamics.inverse_dynamics(model, *folded)), many.ravel(), rtol=0, atol=1e-13)


def test_answers_are_float64_whatever_the_global_setting(tmp_path: Path) -> None:
    model = robots.load(robots.TREE, tmp_path)
    q, v, a = robots.states(model, 3)
    expected = reference.inverse_dynamics(model, q, v, a)
    with jax.enable_x64(False):
        torque = dynamics.inverse_dynamics(model, q, v, a)
        acceleration = dynamics.forward_dynamics(model, q, v, torque)
    assert torque.dtype == acceleration.dtype == np.float64
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(acceleration, a, rtol=0, atol=1e-10)


def test_a_changed_mass_or_placement_does_not_compile_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model = robots.load(robots.ARM, tmp_path)
    x = robots.states(model, 4)
    dynamics.inverse_dynamics(model, *x)
    heavier = robots.load(robots.ARM.replace('mass value="2.0"', 'mass value="2.5"'), tmp_path)
    longer = robots.load(robots.ARM.replace("0.1 0.2 0.3", "0.1 0.2 0.4"), tmp_path)
    with jax.log_compiles(), caplog.at_level("WARNING"):
        torques = [np.asarray(dynamics.inverse_dynamics(m, *x)) for m in (model, heavier, longer)]
    assert not any("Finished XLA compilation" in record.getMessage() for record in caplog.records)
    assert not np.allclose(torques[0], torques[1]) and not np.allclose(torques[0], torques[2])


def test_wrong_shapes_are_refused_by_name(tmp_path: Path) -> None:
    """By the check that every public function makes first; with shape checks on, jaxtyping would refuse before it."""
    model = robots.load(robots.ARM, tmp_path)
    q, v, a = robots.states(model, 4)
    with pytest.raises(InputError, match=r"v has shape \(4, 1\); its last axis must hold the 2 joints turn, slide"):
        kinematics.check_shapes(model, q=q, v=v[:, :1], a=a)
    with pytest.raises(InputError, match=r"a has shape \(3, 2\), but q has \(4, 2\)"):
        kinematics.check_shapes(model, q=q, v=v, a=a[:3])


def test_constants_inside_somebodys_program_are_worked_out(tmp_path: Path):
    model = robots.load(robots.ARM, tmp_path)
    q = np.random.default_rng(0).normal(size=(3, model.nv))
    inside = jax.jit(
        lambda scale: (
            scale
            * (dynamics.inverse_dynamics(model, q, q, q) + regressor.joint_torque_regressor(model, q, q, q)[..., 0])
        )
    )
    expected = (
        np.asarray(dynamics.inverse_dynamics(model, q, q, q))
        + np.asarray(regressor.joint_torque_regressor(model, q, q, q))[..., 0]
    )
    np.testing.assert_allclose(inside(2.0), 2 * expected, rtol=0, atol=1e-12)


def test_torques_of_many_samples_equal_pinocchios(data_dir: Path) -> None:
    """Many samples go through a program that is written out for a short robot; a longer one keeps the plain one."""
    model = load_urdf(data_dir / robots.REAL["tx40"])
    assert written(load_urdf(data_dir / robots.REAL["talos"])) is None
    assert written(model) is not None or not CPU_OPTIONS
    model = dataclasses.replace(model, gravity=np.array([0.3, -0.2, -9.7]))
    heavier = dataclasses.replace(model, inertia=1.1 * np.asarray(model.inertia))
    q, v, a = robots.states(model, dynamics.MANY)
    for robot in (model, heavier):  # the second by the program of the first
        theirs = reference.inverse_dynamics(robot, q, v, a)
        np.testing.assert_allclose(dynamics.inverse_dynamics(robot, q, v, a), theirs, rtol=0, atol=1e-10)
