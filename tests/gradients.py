"""Gradient of one public function, plain `jax.grad` in this fresh interpreter, against differences of its values.

`python gradients.py MODE [NAME ...]`: with `x64` JAX's 64-bit mode is on, with `default` off. One line a function.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import figaroh_jax as fj
from figaroh_jax.rigid import derivatives, manifold

ROBOT = fj.load_urdf(fj.DEMO)
H = 1e-4  # step of differences of fourth order
N, LAST = ROBOT.nv, ROBOT.frames[-1].name
STATE = tuple(np.random.default_rng(0).uniform(-0.6, 0.6, (4, 3, N)))  # q, v, a, tau of three samples
TIME = np.arange(120)[:, None] / 60.0
WAVE = 0.5 * np.sin(TIME * np.array([3.0, 4.0, 5.0, 6.0]) + np.arange(4))
EXTENDED = fj.extend(ROBOT, fj.place(fj.CATALOGUE["viscous_friction"], ROBOT, ["elbow"], damping=1.5))


@lru_cache
def prepared() -> Any:
    """A recording as data, and the basis of what it tells; made before anything is traced."""
    data = fj.torque_data(ROBOT, fj.recording(q=WAVE, tau=np.cos(WAVE), rate=60))
    return data, fj.linear_basis(ROBOT, data)


@lru_cache
def learned() -> fj.Learned:
    """What a motion is to tell; made before anything is traced."""
    return fj.learn(ROBOT)


def _fitted(model: Any, x: jax.Array) -> Any:
    """Base parameters by what was measured."""
    data, basis = prepared()
    moved = eqx.tree_at(lambda d: d.torque, data, jnp.asarray(data.torque) + x[0, 0, 0])
    return fj.fit_linear(model, moved, basis).values


def _factor(model: Any, x: jax.Array) -> jax.Array:
    """R'R, which is the same for every choice of signs."""
    factor = fj.triangular_factor(model, *x, total=jnp.eye(10 * N + 1))
    return factor.T @ factor


def _residual(model: Any, x: jax.Array) -> jax.Array:
    return fj.residual(model, prepared()[0]) * x[0, 0, 0]


def _fit(model: Any, x: jax.Array) -> Any:
    """Two frictions fitted, differentiated through the solution."""
    data, _ = prepared()
    moved = eqx.tree_at(lambda d: d.torque, data, jnp.asarray(data.torque) * x[0, 0, 0])
    return fj.fit(model, moved, free="effects").values


# name: (function of a model and of the state, its model)
FUNCTIONS: dict[str, tuple[Callable[[Any, Any], Any], Any]] = {
    "inverse_dynamics": (lambda m, x: fj.inverse_dynamics(m, x[0], x[1], x[2]), ROBOT),
    "forward_dynamics": (lambda m, x: fj.forward_dynamics(m, x[0], x[1], x[3]), ROBOT),
    "mass_matrix": (lambda m, x: fj.mass_matrix(m, x[0]), ROBOT),
    "joint_torque_regressor": (lambda m, x: fj.joint_torque_regressor(m, x[0], x[1], x[2]), ROBOT),
    "packed_regressor": (lambda m, x: fj.packed_regressor(m, x[0], x[1], x[2]), ROBOT),
    "normal_matrix": (lambda m, x: fj.normal_matrix(m, *x), ROBOT),
    "triangular_factor": (_factor, ROBOT),
    "forward_kinematics": (lambda m, x: fj.forward_kinematics(m, x[0]), ROBOT),
    "frame_placement": (lambda m, x: fj.frame_placement(m, x[0], LAST), ROBOT),
    "frame_jacobian": (lambda m, x: fj.frame_jacobian(m, x[0], LAST), ROBOT),
    "predict": (
        lambda m, x: fj.predict(m, jnp.arange(6) / 50.0, *(jnp.tile(y, (2, 1)) for y in x[:3]), dt=0.02),
        EXTENDED,
    ),
    "simulate": (lambda m, x: fj.simulate(m, jnp.tile(x[3], (2, 1)), x[0][0], x[1][0], 0.002).position, EXTENDED),
    "residual": (_residual, EXTENDED),
    "fit_linear": (_fitted, ROBOT),
    "fit": (_fit, EXTENDED),
    "ExtendedModel.inverse_dynamics": (lambda m, x: m.inverse_dynamics(x[0], x[1], x[2]), EXTENDED),
    "ExtendedModel.forward_dynamics": (lambda m, x: m.forward_dynamics(x[0], x[1], x[3]), EXTENDED),
    "information": (lambda m, x: fj.information(m, (x[0], x[1], x[2]), learned()), ROBOT),
    "expected_std": (lambda m, x: fj.expected_std(learned(), (x[0], x[1], x[2])), ROBOT),
    "rigid.derivatives.gravity_vector": (lambda m, x: derivatives.gravity_vector(m, x[0]), ROBOT),
    "rigid.derivatives.coriolis_matrix": (lambda m, x: derivatives.coriolis_matrix(m, x[0], x[1]), ROBOT),
    "rigid.derivatives.dynamics_derivatives": (
        lambda m, x: derivatives.dynamics_derivatives(m, x[0], x[1], x[2]),
        ROBOT,
    ),
    "rigid.manifold.integrate": (lambda m, x: manifold.integrate(m, x[0], x[1]), ROBOT),
    "rigid.manifold.difference": (lambda m, x: manifold.difference(m, x[0], x[1]), ROBOT),
}
# what takes no arrays, reads or writes files, or decides: nothing to differentiate
OTHERS = frozenset(
    "Baseline BlockLevenbergMarquardt CATALOGUE Cause Device Diagnosis Effect ExtendedModel Fit Frame InputError Joint"
    " LinearFit Motion PoseData Preprocess Recording RobotModel TorqueData amplitude backend calibrate calibrate_task"
    " diagnose diagnose_task extend identify identify_task linear_basis linear_limits load_extended load_mjcf"
    " load_model load_robot load_task load_urdf load_usd own_device place pose_data postures read_recordings recording"
    " register shape torque_data write_model write_report"
    " Design Instrument Learned PostureDesign Trajectory excite excite_postures excite_task fourier learn limits_of"
    " quintic screen_fleet spline"
    " JointEffect Load PoseRecording RolloutData Selection load_loop read_loop rollout_data select write_loop".split()
) | {"rollout"}  # its gradients stand in test_rollouts and test_rollout_data


def _moved(tree: Any, way: Any, step: float) -> Any:
    return jax.tree.map(lambda x, d: x + step * d if d is not None else x, tree, way)


def _direction(tree: Any, rng: np.random.Generator) -> Any:
    """A random step of every floating array, none of what is not finite (limits)."""

    def one(x: Any) -> np.ndarray:
        x = np.asarray(x, float)
        there = np.where(np.isfinite(x), np.abs(x), 0.0)  # what is small moves little
        return np.where(np.isfinite(x), rng.standard_normal(x.shape), 0.0) * (there + 0.01 * there.max(initial=0.0))

    return jax.tree.map(one, tree)


def checked(name: str) -> tuple[float, float]:
    """Largest relative error of the slopes by model and by state along random steps."""
    function, model = FUNCTIONS[name]
    if name in ("residual", "fit", "fit_linear"):
        prepared()
    if name in ("information", "expected_std"):
        learned()
    rng = np.random.default_rng(1)
    state = jnp.asarray(np.stack(STATE))
    sizes = [rng.standard_normal(np.shape(x)) for x in jax.tree.leaves(jax.eval_shape(function, model, state))]

    def total(model: Any, state: Any) -> jax.Array:
        leaves = jax.tree.leaves(function(model, state))
        return sum((jnp.sum(x * w) for x, w in zip(leaves, sizes, strict=True)), jnp.zeros(()))

    slopes = jax.grad(total, argnums=(0, 1))(model, state)
    errors = []
    for k, tree in enumerate((model, np.stack(STATE))):
        way = _direction(tree, rng)
        told = sum(
            float(np.sum(np.asarray(g, float) * d))
            for g, d in zip(jax.tree.leaves(slopes[k]), jax.tree.leaves(way), strict=True)
        )
        with jax.enable_x64(True):
            h = H if name != "fit" else 100 * H  # which stops at a tolerance
            at = [np.stack(STATE), model]
            values = []
            for step in (h, -h, 2 * h, -2 * h):
                arguments = [model, jnp.asarray(at[0])]
                arguments[k] = _moved(tree, way, step)
                values.append(float(total(arguments[0], jnp.asarray(arguments[1]))))
        found = (8 * (values[0] - values[1]) - (values[2] - values[3])) / (12 * h)
        size = max(abs(found), 1e-3 * sum(float(np.abs(g).max(initial=0.0)) for g in jax.tree.leaves(slopes[k])), 1e-9)
        errors.append(abs(told - found) / size)
    return errors[0], errors[1]


def main() -> int:
    mode, *names = sys.argv[1:]
    jax.config.update("jax_enable_x64", mode == "x64")
    warnings.simplefilter("ignore")
    wrong = 0
    for name in names or FUNCTIONS:
        errors = checked(name)
        wrong += not max(errors) < (1e-5 if mode == "x64" and name != "fit" else 1e-3)
        print(f"{name}: {errors[0]:.1e} by model, {errors[1]:.1e} by state", flush=True)
    return wrong > 0


if __name__ == "__main__":
    sys.exit(main())
