"""The information of a motion is a pure function, which any optimiser takes: ten lines each for four of them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robots
from test_excitation import ARM

import figaroh_jax as fj
from figaroh_jax.excitation.motions import Trajectory, fourier
from figaroh_jax.rigid.model import RobotModel

pytestmark = pytest.mark.slow  # each compiles the gradient anew, a minute of processor
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


def test_optimistix(given):
    import optimistix as optx

    begin, less, before = given
    solver = optx.BFGS(rtol=1e-3, atol=1e-3)
    found = optx.minimise(lambda motion, _: less(motion), solver, begin, max_steps=30, throw=False).value
    assert float(less(found)) < before - 5


def test_optax(given):
    import optax

    begin, less, before = given
    solver, step = optax.adam(0.05), jax.jit(jax.value_and_grad(less))
    motion, state = begin, solver.init(begin)
    for _ in range(60):
        _, slope = step(motion)
        update, state = solver.update(slope, state)
        motion = optax.apply_updates(motion, update)
    assert float(less(motion)) < before - 5


def test_jaxopt(given):
    jaxopt = pytest.importorskip("jaxopt")

    begin, less, before = given
    found = jaxopt.LBFGS(less, maxiter=20).run(begin).params
    assert float(less(found)) < before - 5


def test_scipy(given):
    from jax.flatten_util import ravel_pytree
    from scipy.optimize import minimize

    begin, less, before = given
    x, motion_of = ravel_pytree(begin)
    both = jax.jit(jax.value_and_grad(lambda x: less(motion_of(x))))
    found = minimize(
        lambda x: [np.asarray(y, float) for y in both(x)], x, jac=True, method="L-BFGS-B", options={"maxiter": 20}
    )
    assert found.fun < before - 5
