"""An effect of the user's own: the example is short, and found by the diagnosis like one of the catalogue."""

from __future__ import annotations

import ast
import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robots

import figaroh_jax as fj
from figaroh_jax.effects.base import JointEffect, Scalar, amplitude
from figaroh_jax.effects.catalogue import register
from figaroh_jax.effects.kinematic import CATALOGUE, Postures, axis_twist, columns_of

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "own_effect.py"


def test_an_effect_of_ones_own_takes_30_lines_at_most():
    tree = ast.parse(EXAMPLE.read_text())
    (effect,) = (node for node in tree.body if isinstance(node, ast.ClassDef))
    assert effect.end_lineno is not None
    assert effect.end_lineno - effect.lineno + 1 + len(effect.decorator_list) <= 30


def test_the_effect_of_ones_own_is_found_and_nothing_else():
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    run = subprocess.run(
        [sys.executable, str(EXAMPLE)], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    verdict, *causes = run.stdout.splitlines()
    assert verdict == "verdict: named"
    assert len(causes) == 1
    words = causes[0].replace(",", "").split()
    assert words[:2] == ["detent", "(elbow):"]
    assert abs(float(words[words.index("strength") + 1]) - 1.5) < 0.03
    assert abs(float(words[words.index("notch") + 1]) - 0.37) < 0.005


def test_an_effect_of_ones_own_that_errs_in_position_is_one_of_postures(tmp_path: Path):
    class Wear(JointEffect):
        """A gear that has worn where it is used most."""

        name, title, equation = "wear", "wear of the gear", "q_measured = q + depth exp(-q^2)"
        depth: Scalar = amplitude("rad")

        def position_error(self, motion: Any) -> Any:
            return self.depth * np.exp(-(self.here(motion.angle) ** 2))

    model, q = robots.load(robots.ARM, tmp_path), np.random.default_rng(0).uniform(-1.0, 1.0, (5, 2))
    none = np.zeros((5, 2))
    postures = Postures(q, q, none, np.zeros((5, 2, 3)), none, np.arange(5.0), 4.0)
    register(Wear)
    (column,) = columns_of(CATALOGUE["wear"], model, (1,))
    ((joint, field),) = column.pieces
    assert (joint, column.parameter, column.unit) == (1, "depth", "m")  # the joint slides
    # the joint stands behind its reading by the error
    turn = axis_twist(model, 1)[:, None] * -np.exp(-(q[:, 1] ** 2))
    np.testing.assert_allclose(field(postures), turn, rtol=0, atol=1e-15)


class Net(fj.JointEffect):
    """Friction that a network learns: its activation is a function, which is no array."""

    name, title, equation = "net_friction", "a network", "net(v)"
    net: Any = None

    def torque(self, motion: fj.Motion) -> Any:
        return jax.vmap(self.net)(self.here(motion.velocity)[:, None])[:, 0]


def test_a_network_of_equinox_is_an_effect_and_learns_from_the_residual():
    robot, net = fj.load_urdf(fj.DEMO), eqx.nn.MLP(1, 1, 4, 1, activation=jnp.tanh, key=jax.random.key(0))
    model = fj.extend(robot, fj.place(Net, fj.extend(robot), "elbow", net=net))
    q = np.sin(np.arange(200)[:, None] / 25.0 + np.arange(4))
    data = fj.torque_data(robot, fj.recording(q=q, tau=0 * q, rate=100), fj.Preprocess(cutoff=10))

    def cost(net: Any) -> Any:
        return (fj.residual(eqx.tree_at(lambda m: m.effects[0].net, model, net), data) ** 2).mean()

    with jax.enable_x64(True):
        slope, h = eqx.filter_grad(cost)(net).layers[1].weight, 1e-4
        moved = [eqx.tree_at(lambda n: n.layers[1].weight, net, net.layers[1].weight + k * h) for k in (1, -1)]
        difference = (float(cost(moved[0])) - float(cost(moved[1]))) / (2 * h)
        assert float(slope.sum()) == pytest.approx(difference, rel=1e-5)
        added = model.inverse_dynamics(q, q, q) - fj.inverse_dynamics(robot, q, q, q)
        assert np.allclose(added[:, 2], jax.vmap(net)(jnp.asarray(q[:, 2:3]))[:, 0])


def test_what_place_takes_is_said():
    robot, effect = fj.load_urdf(fj.DEMO), fj.CATALOGUE["viscous_friction"]
    for wrong, message in (
        (lambda: fj.place(effect, ["elbow"]), "got list in place of the model"),
        (lambda: fj.place(effect, robot, 2), "takes names, got '2'; joints are waist, shoulder"),  # pyright: ignore
        (lambda: fj.place(Net, robot, "elbow", nets=1), "no parameter 'nets'; known: net"),
    ):
        with pytest.raises(fj.InputError, match=message):
            wrong()


class Bristle(fj.JointEffect):
    """Friction with a state, told by its `step` alone."""

    name, title, equation = "own_bristle", "a bristle", "force z, z' = v / distance (1 - z s(v))"
    force: float = fj.amplitude("N m")
    distance: float = fj.shape("rad", (0.02, 0.1), (0.001, 1.0))
    memory: Any = eqx.field(default=None, kw_only=True)

    def torque(self, motion: fj.Motion) -> Any:
        return self.force * self.memory

    def step(self, velocity: Any, dt: Any) -> Bristle:
        end, stays = jnp.sign(velocity[self.at[0]]), jnp.exp(-jnp.abs(velocity[self.at[0]]) * dt / self.distance)
        return dataclasses.replace(self, memory=end + (self.memory - end) * stays)

    def begin(self, velocity: Any) -> Any:
        return 0.0 * velocity[0]


def test_an_effect_with_a_state_follows_its_step_along_a_record():
    robot, t = fj.load_urdf(fj.DEMO), np.arange(300)[:, None] / 100.0
    q, v = 0.3 * np.sin(2 * t + np.arange(4)), 0.6 * np.cos(2 * t + np.arange(4))
    model = fj.extend(robot, fj.place(Bristle, robot, "elbow", force=2.0, distance=0.05))
    z, expected = 0.0, [0.0]
    for rate in v[1:, 2]:
        z = np.sign(rate) + (z - np.sign(rate)) * np.exp(-abs(rate) * 0.01 / 0.05)
        expected.append(2.0 * z)
    added = [np.asarray(fj.predict(one, t[:, 0], q, v, -4 * q, 0.01))[:, 2] for one in (model, robot)]
    assert np.allclose(added[0] - added[1], expected, atol=1e-12)


def test_a_state_that_would_stand_still_is_refused():
    class Frozen(Bristle):
        memory: Any = 0.0

    with pytest.raises(fj.InputError, match="has a `step`, so its state is a field `memory: Any"):
        fj.place(Frozen, fj.load_urdf(fj.DEMO), "elbow")
