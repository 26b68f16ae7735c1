"""Many identifications in one call: jax.vmap over bootstrap resamples, over recordings, over robots."""

import jax
import numpy as np

import figaroh_jax as fj

jax.config.update("jax_enable_x64", True)


def main() -> None:
    """Friction and base parameters of three recordings at once, and 200 resamples of the first."""
    robot = fj.load_urdf(fj.DEMO)
    friction = [(n, j, p) for j in robot.joint_names for n, p in SIZES.items()]
    real = fj.extend(robot, *(fj.place(fj.CATALOGUE[name], robot, [joint], **size) for name, joint, size in friction))
    rng, t = np.random.default_rng(0), np.arange(2500)[:, None] / 250.0
    runs = []
    for _ in range(3):
        w, phase = 2 * np.pi * rng.uniform(0.2, 0.8, robot.nv), rng.uniform(0, 6, robot.nv)
        q, v, a = (0.8 * w**i * np.sin(w * t + phase + i * np.pi / 2) for i in range(3))
        tau = np.asarray(real.inverse_dynamics(q, v, a)) + 0.2 * rng.normal(size=q.shape)
        runs.append(fj.torque_data(real, fj.recording(q=q, tau=tau, rate=250), fj.Preprocess(cutoff=10)))

    basis = fj.linear_basis(real, runs[0])  # which parameters: once, for all of about this motion
    lower, upper = fj.linear_limits(real, basis)
    together = jax.tree.map(lambda *x: np.stack(x), *runs)
    each = jax.jit(jax.vmap(lambda data: fj.fit_linear(real, data, basis, lower=lower, upper=upper)))(together)
    k = basis.names.index("fv2")
    print(f"viscous friction of joint 2 in three recordings: {np.round(each.values[:, k], 3)} N m s/rad")

    blocks = -(-runs[0].torque.shape[1] // runs[0].together)
    counts = rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=200).astype(float)
    many = jax.jit(jax.vmap(lambda c: fj.fit_linear(real, runs[0], basis, counts=c)))(counts)
    print(f"200 resamples: {many.values[:, k].mean():.3f} +- {many.values[:, k].std():.3f}")
    print(f"white sigma of one fit: {each.std[0, k]:.3f}")


SIZES = {"viscous_friction": {"damping": 1.5}, "coulomb_friction": {"force": 1.0}}

if __name__ == "__main__":
    main()
