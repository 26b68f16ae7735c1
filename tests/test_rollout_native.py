"""Rollouts as machine code: against MuJoCo C, derivatives against differences, refusals of what it does not know."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from types import SimpleNamespace

import equinox as eqx
import jax
import numpy as np
import pytest
from generators import servo_arm6
from scipy.linalg import toeplitz
from test_rollouts import chain, explicit, mujoco_c, waves, written

from figaroh_jax.rollouts import sensitivity
from figaroh_jax.rollouts.alone import alone, carried_by
from figaroh_jax.rollouts.causes import elastic_loop
from figaroh_jax.rollouts.data import Run, Stretch, windows
from figaroh_jax.rollouts.loop import Loop
from figaroh_jax.rollouts.native import native
from figaroh_jax.rollouts.parameters import Entry, Table
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.sensitivity import Windows, linear_sums

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")

LIMITS = 'range="-.15 .2" limited="true" margin=".01"'
WEAK = 'actuatorfrcrange="-12 9"'  # N m of all drives of a joint together


@pytest.mark.parametrize(
    ("integrator", "more"),
    [
        pytest.param(one, more, marks=[pytest.mark.slow] * ((a - b) % 3 > 0))
        for a, one in enumerate(("implicitfast", "Euler", "explicit"))
        for b, more in enumerate(("", LIMITS, WEAK))
    ],
)
def test_seven_joints_with_friction_and_limits_are_mujocos(tmp_path: Path, integrator: str, more: str):
    text = chain(7, integrator, more) if integrator != "explicit" else explicit(chain(7, "Euler", more))
    path = written(tmp_path, text)
    loop, _ = load_loop(path)
    command = waves(2500, 0.002, 7, 0.5)
    truth, rates = mujoco_c(path, command)
    run = Run("run", 0.002 * np.arange(2500), command, truth, rates)
    data = windows(loop, [run], [Stretch(0, 0, 2500)], [np.ones(7), np.ones(7)], 1.0)
    read = native(loop, (), data).read(np.zeros(0), np.zeros((14, 1)))[:2500, :, 0]
    assert more != LIMITS or (truth < -0.15).any()
    np.testing.assert_allclose(read[:, :7], truth, rtol=0, atol=1e-9)
    np.testing.assert_allclose(read[:, 7:], rates, rtol=0, atol=1e-7)


def checked(loop: Loop, table: Table, theta: np.ndarray, data: Windows, start: np.ndarray, least: float = 1e-3) -> None:
    """Gradients of the whitened squares against central differences of the simulation's own.

    Coloured noise is whitened by the inverse of its covariance's triangular factor.
    """
    code, rows = native(loop, table, data), len(data.reading)
    whiten = (
        np.eye(rows)[None, None]
        if data.pole is None
        else np.array([[_whitener(p, rows) for p in x] for x in data.pole])
    )

    def squares(theta: np.ndarray, start: np.ndarray) -> np.ndarray:
        error = (data.reading - code.read(theta, start)) * data.weight
        every = whiten if len(whiten) > 1 else whiten[0, 0]
        return np.einsum("ywrs,syw->ryw" if every.ndim > 2 else "rs,syw->ryw", every, error)

    found = code.sums(theta, np.arange(len(table)), start)
    error = squares(theta, start)
    np.testing.assert_allclose(found.cost.sum(), (error**2).sum(), rtol=1e-12)
    slopes = []
    for k in range(len(table) + len(start)):
        move = 1e-6 * np.eye(len(table) + len(start))[k]
        sides = [squares(theta + s * move[: len(theta)], start + s * move[len(theta) :, None]) for s in (1, -1)]
        slopes.append((sides[1] - sides[0]) / 2e-6)
    rows = np.array([x.ravel() for x in slopes])
    scale = np.linalg.norm(rows, axis=1)
    names = [str(entry) for entry in table] + [f"state {k}" for k in range(len(start))]
    own = found.matrix.sum((0, 1))
    wrong = np.abs(own - rows @ rows.T) / np.maximum(np.outer(scale, scale), least)
    k = int(np.diag(wrong).argmax())
    assert wrong.max() < 2e-5, f"{names[k]}: {wrong[k, k]}"
    gradient, size = found.gradient.sum((0, 1)) / scale, float(np.linalg.norm(error))
    np.testing.assert_allclose(gradient, np.asarray(rows @ error.ravel()) / scale, rtol=0, atol=2e-5 * size)


def _whitener(pole: float, rows: int) -> np.ndarray:
    """Inverse of the triangular factor of the covariance of a first-order low pass of white noise of variance 1."""
    return np.linalg.inv(np.linalg.cholesky(toeplitz(pole ** np.arange(rows)) / (1 - pole**2)))


def arm(folder: Path) -> tuple[Loop, Run]:
    """Six servos with a laden, Stribeck and dry friction; the elbow meets a limit."""
    text = servo_arm6.model_text(1.6).replace('name="elbow"', 'name="elbow" range="-.1 .6" limited="true"', 1)
    loop, _ = load_loop(written(folder, text))
    loop = eqx.tree_at(
        lambda m: (m.joints.load_ratio, m.joints.stribeck_force), loop, (np.full(6, 0.05), np.full(6, 0.1))
    )
    r = servo_arm6.record([], 4, 0)
    return loop, Run("run", r["t"], r["u"], r["q"], None)


@pytest.mark.parametrize(
    ("law", "integrator"), [("soft", "implicitfast"), ("hard", "implicitfast"), ("soft", "explicit")]
)
def test_derivatives_of_an_arm_are_those_of_differences(tmp_path: Path, law: str, integrator: str):
    loop, run = arm(tmp_path)
    loop = dataclasses.replace(loop, law=law, integrator=integrator)
    data = windows(loop, [run], [Stretch(0, 100, 60)], [np.full(6, 2e-4)], 0.3)
    of_joints = (
        "armature",
        "damping",
        "friction",
        "load_ratio",
        "stribeck_force",
        "stribeck_speed",
        "stiffness",
        "offset",
    )
    of_links = ("payload", "mass_y", "inertia_xz")
    table = (
        *(Entry(name, (j,)) for name in (*of_joints, *of_links) for j in (1, 4)),
        *(Entry(name, (2,)) for name in ("scale", "delay", "kd")), Entry("gravity_x", (0,)), Entry("reading", (3,)),
        Entry("friction", (3, 5)),
    )  # fmt: skip
    own = [[0.05, 0.02], [0.5, 0.1], [0.3, 0.1], [0.06, 0.1], [0.1, 0.05], [0.3, 0.2], [0.4, 0.1], [0.1, -0.1]]
    theta = np.concatenate([*own, [0.1, 0.05], [0.01, 0.005], [1e-3, 5e-4], [1.1, 0.0043, 0.7, 0.2, 0.01, 0.05]])
    checked(loop, table, theta, data, np.asarray(data.start))


def test_derivatives_at_the_end_of_a_torque_range_are_those_of_differences(tmp_path: Path):
    loop, run = arm(tmp_path)
    loop = eqx.tree_at(lambda m: m.joints.torque_range, loop, np.tile([-2.0, 1.5], (6, 1)))
    data = windows(loop, [run], [Stretch(0, 100, 60)], [np.full(6, 2e-4)], 0.3)
    table = tuple(Entry(name, (k,)) for k in (1, 2) for name in ("kd", "scale", "friction"))
    checked(loop, table, np.array([0.7, 1.1, 0.3, 0.5, 0.9, 0.2]), data, np.asarray(data.start))


def test_derivatives_with_coloured_noise_are_those_of_differences(tmp_path: Path):
    loop, run = arm(tmp_path)
    pole = np.array([0.6, 0.0, 0.3, 0.9, 0.5, 0.1])
    data = windows(loop, [run], [Stretch(0, 120, 60), Stretch(0, 320, 60)], [np.full(6, 2e-4)], 0.3, pole=pole)
    table = (Entry("friction", (1,)), Entry("reading", (3,)), Entry("delay", (2,)))
    checked(loop, table, np.array([0.3, 0.01, 0.0043]), data, np.asarray(data.start))


@pytest.mark.parametrize("elastic", [pytest.param(False, marks=pytest.mark.slow), True])
def test_derivatives_of_a_carried_joint_are_those_of_differences(tmp_path: Path, elastic: bool):
    loop, run = arm(tmp_path)
    small, (mine,) = alone(loop, [run], carried_by(loop, [run]), 2)
    names = ("armature", "damping", "friction", "stribeck_force", "load_ratio", "scale", "delay", "dead_band")
    table = (*(Entry(name, (0,)) for name in names), *(Entry("payload", (k,)) for k in (2, 5)))
    theta = np.array([0.05, 0.5, 0.2, 0.1, 0.1, 1.1, 0.0043, 0.002, 0.1, 0.05])
    if elastic:
        small = elastic_loop(small, 0, 180.0, 0.1)
        table = (*table, *(Entry(name, (1,)) for name in ("stiffness", "damping", "play")))
        theta = np.append(theta, [150.0, 0.2, 0.004])
    data = windows(small, [mine], [Stretch(0, 100, 90)], [np.array([2e-4])], 0.3)
    checked(small, table, theta, data, np.asarray(data.start))


def test_what_the_code_does_not_know_is_left_to_the_plain_form(tmp_path: Path):
    loop, _ = load_loop(written(tmp_path, chain(1, "RK4")))
    run = Run("run", 0.002 * np.arange(30), np.zeros((30, 1)), np.zeros((30, 1)), None)
    data = windows(loop, [run], [Stretch(0, 0, 30)], [np.ones(1)], 0.02)
    assert not native(loop, (), data).usable
    assert native(dataclasses.replace(loop, integrator="euler"), (), data).usable


@pytest.mark.slow
@pytest.mark.parametrize("pole", [None, np.array([0.6])])
def test_the_plain_form_gives_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pole: np.ndarray | None):
    """Sums of a carried joint by JAX's program, which machines without a compiler run; some rows do not count."""
    loop, run = arm(tmp_path)
    small, (mine,) = alone(loop, [run], carried_by(loop, [run]), 2)
    table = tuple(Entry(name, (0,)) for name in ("armature", "friction", "load_ratio", "scale", "delay"))
    mine = mine._replace(trusted=(np.arange(len(mine.time)) < 115) | (np.arange(len(mine.time)) > 120))
    data = windows(small, [mine], [Stretch(0, 100, 60)], [np.array([2e-4])], 0.3, pole=pole)
    given = np.array([[0.05, 0.2, 0.1, 1.1, 0.0043]]), np.arange(5)[None], data, np.asarray(data.start)[None]
    own = linear_sums(small, table, *given)
    monkeypatch.setattr(sensitivity, "native", lambda *_: SimpleNamespace(usable=False))
    with jax.enable_x64(True):
        plain = linear_sums(small, table, *given)
    for one, other in zip(own, plain, strict=True):
        np.testing.assert_allclose(one, np.asarray(other), rtol=0, atol=1e-12 * np.abs(one).max())
