"""The information of a motion is a pure function, which any optimiser takes: ten lines each for four of them."""

from __future__ import annotations

import ast
import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
import robots
from test_excitation import ARM

import figaroh_jax as fj
from figaroh_jax.excitation.motions import Trajectory, fourier
from figaroh_jax.rigid.model import RobotModel

pytestmark = pytest.mark.slow  # each compiles the gradient anew, a minute of processor
EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "any_optimiser.py"
BASIS = fourier(2, 0.5, 2.0)


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory):
    model: RobotModel = robots.load(ARM, tmp_path_factory.mktemp("arm"))
    learned = fj.learn(model)
    with jax.enable_x64(True):
        begin = Trajectory(jnp.zeros(2), 0.1 * jnp.ones((2, BASIS.size)), BASIS)

        def less(motion: Trajectory) -> jax.Array:  # what is to be small: information, and speeds near 2 rad/s
            _, v, _ = motion.states(10.0)
            return -fj.information(model, motion, learned, 10.0) + 10 * jnp.sum(jnp.maximum(jnp.abs(v) - 2.0, 0) ** 2)

        yield begin, less, float(less(begin))


@pytest.mark.parametrize("name", ["optimistix", "optax", "jaxopt", "scipy"])
def test_ten_lines_of_the_example_find_a_better_motion(given, name: str):
    pytest.importorskip(name)
    begin, less, before = given
    own = runpy.run_path(str(EXAMPLE))[f"by_{name}"]
    assert float(less(own(less, begin))) < before - 5


def test_each_takes_ten_lines_at_most():
    functions = [one for one in ast.parse(EXAMPLE.read_text("utf-8")).body if isinstance(one, ast.FunctionDef)]
    assert len(functions) == 4 and all((one.end_lineno or 0) - one.lineno < 10 for one in functions)
