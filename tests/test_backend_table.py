"""The table of backends in README.md: each cell is what `capabilities` says, and what the backend does when called."""

from __future__ import annotations

import importlib
from functools import lru_cache
from pathlib import Path
from typing import Any

import figaroh_jax_mjx
import figaroh_jax_mujoco
import figaroh_jax_pinocchio
import jax
import numpy as np
import pinocchio as pin
import pytest
import robots

from figaroh_jax.errors import NotSupported
from figaroh_jax.formats.robotfile import read_robot
from figaroh_jax.rigid import regressor
from figaroh_jax.simulators.contract import Backend
from figaroh_jax.simulators.native import NativeBackend

README = Path(__file__).resolve().parents[1] / "README.md"


class _Classes(dict[str, type[Backend]]):
    """By name; what few have installed is imported where it is asked for, and a test that needs it skips without it."""

    def __missing__(self, name: str) -> type[Backend]:
        pytest.importorskip({"newton": "newton", "genesis": "genesis"}[name], reason=f"{name} is not installed")
        return getattr(importlib.import_module(f"figaroh_jax_{name}"), f"{name.capitalize()}Backend")


CLASSES = _Classes(
    native=NativeBackend,
    mjx=figaroh_jax_mjx.MjxBackend,
    mujoco=figaroh_jax_mujoco.MujocoBackend,
    pinocchio=figaroh_jax_pinocchio.PinocchioBackend,
)
NAMES = pytest.mark.parametrize("name", [*CLASSES, "newton", "genesis"])


@lru_cache
def table() -> dict[str, dict[str, str]]:
    lines = README.read_text(encoding="utf-8").splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("| backend |"))
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[start:]]
    rows = rows[: next(k for k, row in enumerate(rows) if len(row) < 2)]
    return {row[0].strip("`"): dict(zip(rows[0], row, strict=True)) for row in rows[2:]}


@lru_cache
def made(name: str, robot: str = "pendulum") -> Any:
    path = robots.write(robot)
    return CLASSES[name].build(read_robot(path), path)


def figaroh_jax_of(name: str) -> Any:
    return importlib.import_module(f"figaroh_jax_{name}")


def state(name: str, samples: int = 3) -> np.ndarray:
    return np.random.default_rng(1).uniform(-1, 1, (3, samples, made(name).nv))


def said(name: str, column: str) -> bool:
    return not table()[name][column].startswith("no")


def test_every_backend_has_a_row() -> None:
    assert table().keys() == {*CLASSES, "newton", "genesis"}


@NAMES
def test_formats(name: str) -> None:
    told = {word.strip().lower() for word in table()[name]["formats"].split(",")}
    assert told == set(CLASSES[name].capabilities.formats) - {"model"}
    assert (made(name).model_format, made(name, "beast").model_format) == ("urdf", "mjcf")


@NAMES
def test_differentiable(name: str) -> None:
    assert said(name, "differentiable") == CLASSES[name].capabilities.differentiable

    def power(q: Any) -> Any:
        return made(name).inverse_dynamics(q, np.ones(1), np.ones(1)).sum()

    if said(name, "differentiable"):
        assert jax.eval_shape(jax.grad(power), np.ones(1)).shape == (1,)
    else:
        with pytest.raises(NotSupported, match="tracing by JAX"):
            jax.grad(power)(np.ones(1))


@NAMES
def test_gpu(name: str) -> None:
    """What has the word `yes` is lowered for an accelerator here; that it computes there is the benchmark's."""
    assert said(name, "GPU") == CLASSES[name].capabilities.gpu
    traced = jax.jit(made(name).inverse_dynamics)
    if name == "newton":  # Warp compiles for the devices that it finds
        assert said(name, "GPU")
        assert made(name).simulator.device is not None
    elif said(name, "GPU"):
        assert "func" in traced.trace(*state(name)).lower(lowering_platforms=("cuda",)).as_text()
    else:
        with pytest.raises(NotSupported):
            traced.trace(*state(name))


@NAMES
def test_batch(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert table()[name]["batch"] == CLASSES[name].capabilities.batch
    backend, calls = made(name), []
    if name == "pinocchio":
        rnea = pin.rnea
        monkeypatch.setattr(pin, "rnea", lambda *x: calls.append(1) or rnea(*x))
        backend.inverse_dynamics(*state(name))
        assert len(calls) == 3
    elif name == "mujoco":
        pool = figaroh_jax_mujoco.ThreadPoolExecutor
        monkeypatch.setattr(figaroh_jax_mujoco, "_MANY_BODIES", 0)
        monkeypatch.setattr(figaroh_jax_mujoco, "ThreadPoolExecutor", lambda *x: calls.append(1) or pool(*x))
        q, v, a = state(name, 300)
        many = backend.joint_torque_regressor(q, v, a)
        np.testing.assert_array_equal(many[:3], backend.joint_torque_regressor(q[:3], v[:3], a[:3]))
        assert calls
    elif name in ("newton", "genesis"):  # one evaluation for all samples
        place = getattr(figaroh_jax_of(name), "_Worlds" if name == "newton" else "GenesisBackend")
        step = "place" if name == "newton" else "_place"
        kept = getattr(place, step)
        monkeypatch.setattr(place, step, lambda *x: calls.append(1) or kept(*x))
        backend.inverse_dynamics(*state(name, 20))
        assert len(calls) == 1
    else:
        shape = jax.eval_shape(jax.vmap(backend.inverse_dynamics), *state(name)).shape
        assert shape == jax.eval_shape(backend.inverse_dynamics, *state(name)).shape == (3, 1)


@NAMES
def test_contact(name: str) -> None:
    assert said(name, "contact") == CLASSES[name].capabilities.contact
    simulator = made(name, "beast").simulator
    shapes = {"newton": lambda: simulator.shape_count, "genesis": lambda: simulator.sim.rigid_solver.n_geoms}
    assert (shapes.get(name, lambda: getattr(simulator, "ngeom", 0))() > 0) == said(name, "contact")


@NAMES
def test_regressor(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each its own: neither Pinocchio's nor ours is called by another."""
    assert said(name, "regressor") == ("joint_torque_regressor" in CLASSES[name].capabilities.functions)

    def refuse(*_: Any) -> Any:
        raise AssertionError("another library's regressor")

    if name != "pinocchio":
        monkeypatch.setattr(pin, "computeJointTorqueRegressor", refuse)
    if name != "native":
        monkeypatch.setattr(regressor, "joint_torque_regressor", refuse)
    backend = made(name)
    W = np.asarray(backend.joint_torque_regressor(*state(name)))
    want = np.asarray(made("pinocchio").inverse_dynamics(*state(name)))
    single = CLASSES[name].capabilities.precision == "float32"
    np.testing.assert_allclose(W @ np.ravel(backend.inertias), want, rtol=0, atol=1e-4 if single else 1e-9)


@NAMES
def test_derivatives(name: str) -> None:
    assert said(name, "derivatives") == ("dynamics_derivatives" in CLASSES[name].capabilities.functions)
    derivatives = made(name).dynamics_derivatives
    if not said(name, "derivatives"):
        with pytest.raises(NotSupported, match="backends that do: native"):
            derivatives(*state(name))
    elif said(name, "differentiable"):  # the numbers are compared in test_backends.py
        assert jax.eval_shape(derivatives, *state(name)).q.shape == (3, 1, 1)
    else:
        assert derivatives(*state(name)).q.shape == (3, 1, 1)
