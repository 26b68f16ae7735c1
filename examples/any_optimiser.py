"""A motion designed by an optimiser of your choice: `information` is a pure function of the motion, a pytree.

Ten lines at most for optimistix, optax, jaxopt and SciPy (optax alone does not come with this library). Speeds are kept
near 2 rad/s by a penalty; `excite` keeps limits, and meets them at 1 kHz. Run `python examples/any_optimiser.py`; it
takes about half a minute, nearly all of it to compile the gradient.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import figaroh_jax as fj


def by_optimistix(less, begin):
    import optimistix as optx

    solver = optx.BFGS(rtol=1e-3, atol=1e-3)
    return optx.minimise(lambda motion, _: less(motion), solver, begin, max_steps=30, throw=False).value


def by_optax(less, begin):
    import optax

    solver, slope = optax.adam(0.05), jax.jit(jax.grad(less))
    motion, state = begin, solver.init(begin)
    for _ in range(60):
        step, state = solver.update(slope(motion), state)
        motion = optax.apply_updates(motion, step)
    return motion


def by_jaxopt(less, begin):
    import jaxopt

    return jaxopt.LBFGS(less, maxiter=20).run(begin).params


def by_scipy(less, begin):
    from scipy.optimize import minimize

    x, motion_of = ravel_pytree(begin)
    both = jax.jit(jax.value_and_grad(lambda x: less(motion_of(x))))
    found = minimize(lambda x: [np.asarray(y, float) for y in both(x)], x, jac=True, options={"maxiter": 20})
    return motion_of(found.x)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    robot, basis = fj.load_urdf(fj.DEMO), fj.fourier(2, 0.5, 2.0)
    learned, begin = fj.learn(robot), fj.Trajectory(jnp.zeros(4), 0.1 * jnp.ones((4, basis.size)), basis)

    def less(motion):  # what is to be small
        _, v, _ = motion.states(rate=10.0)
        return 10 * (jnp.maximum(jnp.abs(v) - 2.0, 0) ** 2).sum() - fj.information(robot, motion, learned, rate=10.0)

    found = by_scipy(less, begin)  # or any other of the four
    print(f"any optimiser: {float(less(begin)):.1f} -> {float(less(found)):.1f}")
