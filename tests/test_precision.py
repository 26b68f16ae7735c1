"""Public functions under JAX's default, 64-bit mode off: values, gradients and maps, in a fresh interpreter."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path

import gradients
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import figaroh_jax as fj
from figaroh_jax.compiled.precision import Float32Boundary, _say_once

DEMO = Path(fj.__file__).parent / "demo" / "robot.urdf"
ONE = """<robot name="one"><link name="base"/><link name="l"><inertial><origin xyz="0.1 0 0.2"/><mass value="2"/>
<inertia ixx="0.1" iyy="0.2" izz="0.15" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="{kind}"><parent link="base"/><child link="l"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


@pytest.fixture
def default_mode():
    """JAX as it comes: 64-bit mode off."""
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("ignore", Float32Boundary)
        yield


def test_readme_s_first_example_has_a_gradient_in_a_fresh_interpreter():
    text = f"""
import jax, numpy as np, figaroh_jax as fj
model = fj.load_urdf({str(DEMO)!r})
q = v = a = np.full(model.nv, 0.3)
slope = jax.grad(lambda m: fj.inverse_dynamics(m, q, v, a).sum())(model)
print(float(np.abs(slope.inertia).max()), slope.inertia.dtype)
"""
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("Float32Boundary: JAX's 64-bit mode is off") == 1
    assert done.stdout.endswith("float32\n")


@pytest.mark.parametrize("kind", ["continuous", pytest.param("prismatic", marks=pytest.mark.slow)])
def test_one_joint_has_gradients_by_everything(kind: str, tmp_path: Path, default_mode: None):
    file = tmp_path / "one.urdf"
    file.write_text(ONE.format(kind=kind))
    check(fj.load_urdf(file), np.array([0.3]), np.array([0.2]), np.array([0.4]))


@pytest.mark.slow
def test_a_free_joint_has_gradients_by_everything(tmp_path: Path, default_mode: None):
    file = tmp_path / "one.urdf"
    file.write_text(ONE.format(kind="continuous"))
    model = fj.load_urdf(file, root="free_flyer")
    q = np.array([0.1, 0.2, 0.3, 0.5, 0.5, -0.5, 0.5, 0.3])
    check(model, q, np.linspace(0.1, 0.7, 7), np.linspace(0.3, -0.3, 7))


def check(model: fj.RobotModel, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
    def power(model: fj.RobotModel, q: jax.Array) -> jax.Array:
        return jnp.sum(fj.inverse_dynamics(model, q, v, a) ** 2)

    by_both = jax.grad(power, argnums=(0, 1))
    mine = [by_both(model, q)]
    if len(q) > 1:
        mine.append(jax.jit(by_both)(model, q))
    with jax.enable_x64(True):
        exact = by_both(model, q)
    for found in mine:
        for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(exact), strict=True):
            assert x.dtype == jnp.float32
            size = float(np.abs(y).max(initial=1.0))
            np.testing.assert_allclose(x, y, rtol=0, atol=1e-5 * size)


@pytest.mark.slow
def test_every_transformation_agrees_with_float64(default_mode: None):
    model = fj.load_urdf(DEMO)
    q = np.array([[0.3, -0.2, 0.5, 0.1], [0.1, 0.4, -0.3, 0.2]])
    last = model.frames[-1].name
    functions = {
        "inverse_dynamics": lambda q: fj.inverse_dynamics(model, q, q, q),
        "mass_matrix": lambda q: fj.mass_matrix(model, q),
        "frame_placement": lambda q: fj.frame_placement(model, q, last),
    }

    def transformed(q: np.ndarray) -> list[jax.Array]:
        found = []
        for f in functions.values():
            found += [jax.vmap(jax.jacfwd(f))(q), jax.jit(jax.vmap(jax.jacrev(f)))(q)]
        return [*found, jax.jit(jax.hessian(lambda x: functions["inverse_dynamics"](x).sum()))(q[0])]

    mine = transformed(q)
    with jax.enable_x64(True):
        exact = transformed(q)
    for x, y in zip(mine, exact, strict=True):
        assert x.dtype == jnp.float32 and y.dtype == jnp.float64
        np.testing.assert_allclose(x, y, rtol=0, atol=2e-6 * max(1.0, float(np.abs(y).max())))


def test_the_boundary_is_said_once():
    model = fj.load_urdf(DEMO)
    _say_once.cache_clear()
    with jax.enable_x64(False), pytest.warns(Float32Boundary, match="jax_enable_x64"):
        jax.jit(lambda q: fj.inverse_dynamics(model, q, q, q))(np.ones(4))
    with jax.enable_x64(False):
        jax.jit(lambda q: fj.mass_matrix(model, q))(np.ones(4))


def test_plain_grad_takes_an_extended_model():
    robot = fj.load_urdf(DEMO)
    model = fj.extend(robot, fj.place(fj.CATALOGUE["viscous_friction"], robot, ["elbow"], damping=1.5))
    v = np.linspace(0.1, 0.4, 4)
    slope = jax.grad(lambda m: m.inverse_dynamics(v, v, v).sum())(model)
    np.testing.assert_allclose(slope.effects[0].damping, v[robot.joint_index("elbow")], rtol=0, atol=1e-14)
    assert all(jnp.issubdtype(x.dtype, jnp.inexact) for x in jax.tree.leaves(slope))


def test_every_public_function_has_a_gradient_that_is_checked_or_nothing_to_differentiate():
    named = {name for name in gradients.FUNCTIONS if "." not in name}
    assert named | gradients.OTHERS == set(fj.__all__) and not named & gradients.OTHERS


def _gradients(mode: str, *names: str) -> None:
    script = Path(__file__).with_name("gradients.py")
    done = subprocess.run([sys.executable, str(script), mode, *names], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["x64", "default"])
@pytest.mark.parametrize("name", [*gradients.FUNCTIONS])
def test_plain_grad_of_every_public_function_in_a_fresh_interpreter(mode: str, name: str):
    _gradients(mode, name)


@pytest.mark.slow
def test_plain_grad_of_the_mass_matrix_in_a_fresh_interpreter():
    _gradients("x64", "mass_matrix")
