"""Newton and Genesis behind the contract: Pinocchio's answers within their precision, and what they refuse.

They are installed by few; the tests skip where they are not. Newton computes in float32: 2e-6 of the largest number of
an answer, of regressors and Coriolis matrices, which are differences, 1e-5. Genesis computes in float64: 1e-10.
"""

from __future__ import annotations

import importlib
from functools import lru_cache
from typing import Any

import figaroh_jax_pinocchio
import numpy as np
import pytest
import robots

from figaroh_jax.errors import InputError, NotSupported
from figaroh_jax.formats.robotfile import read_robot
from figaroh_jax.rigid.model import RobotModel

TOLERANCE = {"newton": 2e-6, "genesis": 1e-10}
DIFFERENCES = ("coriolis_matrix", "joint_torque_regressor")
FUNCTIONS = {
    "frame_placements": "q",
    "mass_matrix": "q",
    "gravity_vector": "q",
    "inverse_dynamics": "q v a",
    "forward_dynamics": "q v tau",
    "coriolis_matrix": "q v",
    "joint_torque_regressor": "q v a",
}
LIMIT = '<limit lower="-2" upper="2" velocity="3" effort="40"/>'
CART = robots.robot(
    *robots.LINKS[:3],
    robots.joint("glide", "base", "a", "planar", "1 2 -2"),
    robots.joint("turn", "a", "b", axis="0 1 -2", more=LIMIT),
)
NAMES = pytest.mark.parametrize("name", TOLERANCE)


@lru_cache
def loaded(robot: str) -> RobotModel:
    path = (
        robots.write(robot) if robot in (robots.INLINE | robots.MIXED) else robots.write("arm").with_name("cart.urdf")
    )
    if robot == "cart":
        path.write_text(CART)
    return read_robot(path)


@lru_cache
def made(name: str, robot: str) -> Any:
    if name == "pinocchio":
        return figaroh_jax_pinocchio.PinocchioBackend.build(loaded(robot))
    pytest.importorskip(name, reason=f"{name} is not installed (the extra `{name}`)")
    return getattr(importlib.import_module(f"figaroh_jax_{name}"), f"{name.capitalize()}Backend").build(loaded(robot))


@lru_cache
def states(robot: str) -> dict[str, np.ndarray]:
    reference, rng = made("pinocchio", robot), np.random.default_rng(5)
    q = np.asarray(reference.random_configuration(rng, (2, 25)))
    v, a = rng.uniform(-2.0, 2.0, (2, 2, 25, reference.nv))
    return {"q": q, "v": v, "a": a, "tau": np.asarray(reference.inverse_dynamics(q, v, a))}


def close(got: Any, want: Any, tolerance: float) -> None:
    want = np.asarray(want)
    np.testing.assert_allclose(got, want, rtol=0, atol=tolerance * np.abs(want).max())


@pytest.mark.parametrize("robot", ["arm", "tree", "beast", "cart"])
@NAMES
def test_the_answers_are_pinocchios(name: str, robot: str) -> None:
    """Mimic joints, a free base, a ball joint, a plane; 50 states."""
    backend, reference, state = made(name, robot), made("pinocchio", robot), states(robot)
    for function, words in FUNCTIONS.items():
        arguments = [state[word] for word in words.split()]
        got, want = getattr(backend, function)(*arguments), getattr(reference, function)(*arguments)
        if function == "forward_dynamics":  # an acceleration is only as exact as the mass matrix is well conditioned
            got, want = reference.inverse_dynamics(state["q"], state["v"], got), state["tau"]
        close(got, want, TOLERANCE[name] * (5 if function in DIFFERENCES else 1))
    if (name, robot) == ("genesis", "beast"):
        with pytest.raises(NotSupported, match=r"no frame_jacobian of spherical joints \('shoulder'\)"):
            backend.frame_jacobian(state["q"], "tip")
        return
    for frame in (backend.frame_names[-1], backend.joint_names[0]):
        for axes in ("local", "world", "local_world_aligned"):
            want = reference.frame_jacobian(state["q"], frame, axes)
            close(backend.frame_jacobian(state["q"], frame, axes), want, TOLERANCE[name])
    close(backend.inertias, loaded(robot).inertia, TOLERANCE[name])
    assert np.asarray(backend.mass_matrix(state["q"][0, :0])).shape == (0, backend.nv, backend.nv)


@NAMES
def test_a_regressor_leaves_the_inertias_as_they_were(name: str) -> None:
    backend, state = made(name, "arm"), states("arm")
    before = backend.inverse_dynamics(*(state[x] for x in "qva"))
    W = backend.joint_torque_regressor(*(state[x] for x in "qva"))
    np.testing.assert_array_equal(backend.inverse_dynamics(*(state[x] for x in "qva")), before)
    close(W @ np.ravel(loaded("arm").inertia), before, 5 * TOLERANCE[name])


@NAMES
def test_steps_follow_the_law_of_motion(name: str) -> None:
    """The change of velocity is the acceleration of forward dynamics, to the error of a step of first order."""
    backend, state, dt = made(name, "arm"), {k: x[0, :4] for k, x in states("arm").items()}, 1e-3
    q, v = backend.step(state["q"], state["v"], state["tau"], steps=2)
    np.testing.assert_allclose((v - state["v"]) / (2 * dt), state["a"], rtol=0, atol=0.2)
    np.testing.assert_allclose((q - state["q"]) / (2 * dt), state["v"], rtol=0, atol=0.02)


@NAMES
def test_what_they_lack_is_refused(name: str) -> None:
    backend = made(name, "arm")
    with pytest.raises(NotSupported, match=f"'{name}' has no dynamics_derivatives; backends that do: native"):
        backend.dynamics_derivatives(*(states("arm")[x] for x in "qva"))
    with pytest.raises(InputError, match="'fly' hangs on 'turn': choose native, mujoco or pinocchio"):
        made(name, "plane")
    assert backend.capabilities.precision == ("float32" if name == "newton" else "float64")
