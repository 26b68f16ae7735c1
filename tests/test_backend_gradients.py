"""Gradients of the differentiable backends by the leaves of their models and by the state, against differences."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import equinox as eqx
import figaroh_jax_mjx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robots

from figaroh_jax.compiled.batching import DRAFT_OPTIONS, program
from figaroh_jax.formats.robotfile import read_robot
from figaroh_jax.simulators.contract import Backend
from figaroh_jax.simulators.native import NativeBackend

CASES = [
    pytest.param("native", "arm"),
    pytest.param("native", "beast"),
    pytest.param("mjx", "pendulum"),
    pytest.param("mjx", "arm", marks=pytest.mark.slow),
]
LEAVES = {
    "native": ("model.inertia", "model.placement", "model.gravity"),
    "mjx": ("model.body_mass", "model.body_ipos", "model.body_inertia", "model.body_pos", "model.opt.gravity"),
}
STEP = 1e-6


@lru_cache
def made(name: str, robot: str) -> Any:
    path = robots.write(robot)
    backend = {"native": NativeBackend, "mjx": figaroh_jax_mjx.MjxBackend}[name].build(read_robot(path), path)
    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, backend)


def leaf(tree: Any, path: str) -> Any:
    for word in path.split("."):
        tree = getattr(tree, word)
    return tree


def power_of(backend: Backend, state: tuple[Any, ...], weight: Any) -> Any:
    q, v, a, step = state
    return weight @ backend.inverse_dynamics(backend.integrate(q, step), v, a)


def slopes_of(backend: Backend, state: tuple[Any, ...], weight: Any) -> Any:
    return eqx.filter_grad(lambda both: power_of(both[0], both[1], weight))((backend, state))


power, slopes = program(power_of, DRAFT_OPTIONS), program(slopes_of, DRAFT_OPTIONS)


@pytest.mark.parametrize("at_zero", [False, True])
@pytest.mark.parametrize(("name", "robot"), CASES)
def test_gradients_are_central_differences(name: str, robot: str, at_zero: bool) -> None:
    backend, rng = made(name, robot), np.random.default_rng(5)
    q = np.asarray(backend.random_configuration(rng))
    scale = 0.0 if at_zero else 1.0
    v, a = scale * rng.uniform(-1, 1, (2, backend.nv))
    if at_zero:
        q = np.zeros(backend.nq)
        q[
            [
                at.stop - 1
                for j, at in zip(backend.robot.joints, backend.robot.dofs.positions, strict=True)
                if j.kind in ("free", "spherical")
            ]
        ] = 1.0
    state = tuple(jnp.asarray(x) for x in (q, v, a, np.zeros(backend.nv)))
    weight = jnp.asarray(rng.uniform(-1, 1, backend.nv))
    by_backend, by_state = slopes(backend, state, weight)
    for path in LEAVES[name]:
        value, got = np.asarray(leaf(backend, path)), np.asarray(leaf(by_backend, path))
        _compare(got, value, lambda x, path=path: power(_with(backend, path, x), state, weight), path)
    for k in (1, 2, 3):
        _compare(
            np.asarray(by_state[k]),
            np.asarray(state[k]),
            lambda x, k=k: power(backend, (*state[:k], x, *state[k + 1 :]), weight),
            ("q", "v", "a", "step of q")[k],
        )


def _with(backend: Any, path: str, value: Any) -> Any:
    return eqx.tree_at(lambda tree: leaf(tree, path), backend, value)


def _compare(got: np.ndarray, value: np.ndarray, function: Any, name: str) -> None:
    """At eight entries, or all where there are fewer."""
    entries = np.random.default_rng(1).permutation(value.size)[:8]
    for entry in entries:
        ends = []
        for sign in (1.0, -1.0):
            moved = value.copy().ravel()
            moved[entry] += sign * STEP
            ends.append(float(function(jnp.asarray(moved.reshape(value.shape)))))
        want = (ends[0] - ends[1]) / (2 * STEP)
        np.testing.assert_allclose(got.ravel()[entry], want, rtol=1e-6, atol=1e-6, err_msg=f"{name} {entry}")
