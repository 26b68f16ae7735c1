"""Friction by gradient descent: the residual is a function of JAX, so any optimiser takes it; here optax's Adam."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import figaroh_jax as fj

jax.config.update("jax_enable_x64", True)


def main() -> None:
    """Stribeck and viscous friction of one joint, all three numbers at once, nonlinear in the speed."""
    robot = fj.load_urdf(fj.DEMO)

    def friction(damping: float, force: float, speed: float) -> fj.ExtendedModel:
        viscous = fj.place(fj.CATALOGUE["viscous_friction"], robot, ["elbow"], damping=damping)
        stribeck = fj.place(fj.CATALOGUE["stribeck_friction"], robot, ["elbow"], force=force, speed=speed)
        return fj.extend(robot, viscous, stribeck)

    t = np.arange(2500)[:, None] / 250.0
    w = 2 * np.pi * np.array([0.3, 0.25, 0.35, 0.4])
    q, v, a = (0.5 * w**i * np.sin(w * t + i * np.pi / 2) for i in range(3))
    tau = np.asarray(friction(1.2, 0.8, 0.15).inverse_dynamics(q, v, a))
    data = fj.torque_data(robot, fj.recording(q=q, tau=tau, rate=250), fj.Preprocess(cutoff=20))

    def loss(effects: tuple[fj.Effect, ...], model: fj.ExtendedModel) -> jax.Array:
        return jnp.mean(fj.residual(eqx.tree_at(lambda m: m.effects, model, effects), data) ** 2)

    model = friction(0.5, 0.3, 0.3)
    effects, optimiser = jax.tree.map(jnp.asarray, model.effects), optax.adam(0.02)
    state = optimiser.init(effects)

    @jax.jit
    def step(effects, state):
        value, slope = jax.value_and_grad(loss)(effects, model)
        change, state = optimiser.update(slope, state)
        return optax.apply_updates(effects, change), state, value

    for k in range(300):
        effects, state, value = step(effects, state)
        if k % 100 == 0:
            print(f"step {k}: mean square {float(value):.2e}")
    viscous, stribeck = effects
    print(f"damping {viscous.damping:.3f}, force {stribeck.force:.3f}, speed {stribeck.speed:.3f}")


if __name__ == "__main__":
    main()
