"""The motion that tells most about a robot: by the library's design, and by any optimiser on `information`."""

import jax
import numpy as np
from scipy.optimize import minimize

import figaroh_jax as fj

jax.config.update("jax_enable_x64", True)
model = fj.load_urdf(fj.DEMO)
basis = fj.spline(4, duration=3.0)
learned = fj.learn(model, noise=0.02, trust=0.2)

# the library: limits of the model and a stated acceleration, met at 1 kHz
found = fj.excite(model, basis, fj.limits_of(model, acceleration=10.0), learned, starts=1)
used = max(use.share for use in found.stages[0].uses)
print(f"designed: log determinant {found.logdet:.1f}, largest use of a limit {used:.3f}")
q, v, a = found.stages[0].motion.states(rate=1000.0)  # what the robot is to run

# an optimiser of one's own: the objective is a pure function of the motion, here with a weak pull to small motions
start = fj.Trajectory(np.zeros(model.nv), 0.1 * np.ones((model.nv, basis.size)), basis)


def objective(weights):
    motion = fj.Trajectory(start.start, weights.reshape(model.nv, -1), basis)
    return 0.5 * (weights**2).sum() - fj.information(model, motion, learned, rate=10.0)


# compiled quickly rather than to run fast: it is called a few times
slope = jax.jit(jax.value_and_grad(objective), compiler_options={"xla_backend_optimization_level": 0})
own = minimize(lambda x: tuple(map(np.asarray, slope(x))), start.weights.ravel(), jac=True, options={"maxiter": 10})
print(f"own optimiser: {-objective(start.weights.ravel()):.1f} -> {-own.fun:.1f}")
