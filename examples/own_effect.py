"""An effect of your own: register it, and fit, diagnosis and export know it like one of the catalogue.

A spring-loaded ball drops into a notch as a joint passes it: a detent, which the catalogue does not have. Here one is
hidden at the elbow of the demo's arm, in simulated recordings. Run `python examples/own_effect.py`; about a minute.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import figaroh_jax as fj


# the effect: its words, its parameters, its torque
@fj.register
class Detent(fj.Effect):
    """A ball that drops into a notch of the joint and has to be pushed out of it."""

    name, title, acts_on = "detent", "a detent", "joint"
    equation = "strength x exp(-x^2 / 2), x = (q - notch) / 0.1 rad"
    separated_by = "slow passes of {at} through the notch in both directions"
    strength: float = fj.amplitude("N m")
    notch: float = fj.shape("rad", tuple(np.arange(-2.0, 2.01, 0.1)))

    def torque(self, motion: fj.Motion):
        x = (self.here(motion.position) - self.notch) / 0.1
        return self.strength * x * jnp.exp(-(x**2) / 2)


def recordings(robot: fj.RobotModel, rng: np.random.Generator) -> list[fj.Recording]:
    """Two motions, each recorded twice: friction, masses off by 3 %, the detent, noise."""
    heavier = np.asarray(robot.inertia) * (1 + 0.03 * rng.standard_normal((len(robot.joints), 1)))
    effects = [fj.place(fj.CATALOGUE["viscous_friction"], robot, [joint], damping=1.0) for joint in robot.joint_names]
    effects += [fj.place(fj.CATALOGUE["coulomb_friction"], robot, [joint], force=1.2) for joint in robot.joint_names]
    effects.append(fj.place(Detent, robot, ["elbow"], strength=1.5, notch=0.37))
    real = fj.extend(eqx.tree_at(lambda r: r.inertia, robot, heavier), *effects, width=0.01)
    t, w, runs = np.arange(2500) / 250.0, 0.2 * np.pi * np.arange(1, 6)[:, None, None], []
    for label in "AB":
        sine, cosine = rng.normal(size=(2, 5, 1, robot.nv)) / np.sqrt(np.arange(1, 6))[:, None, None]
        parts = [(w**k * (sine * np.sin(w * t[:, None] + h) + cosine * np.cos(w * t[:, None] + h))).sum(0)
                 for k, h in enumerate((0.0, np.pi / 2, np.pi))]  # fmt: skip
        q, v, a = (part / np.abs(parts[0]).max(0) for part in parts)
        torque = np.asarray(fj.predict(real, t, q, v, a, 1 / 250.0))
        noise = 0.02 * np.sqrt(np.mean(torque**2, axis=0))
        for _ in range(2):
            read, tau = (x + s * rng.standard_normal(q.shape) for x, s in ((q, 2e-5), (torque, noise)))
            runs.append(fj.recording(q=read, tau=tau, rate=250, model=robot, repeat=label))
    return runs


if __name__ == "__main__":
    nominal = fj.load_urdf(fj.DEMO)
    diagnosis = fj.diagnose(nominal, recordings(nominal, np.random.default_rng(1)), fj.Preprocess(cutoff=15, rate=50))
    print(f"verdict: {diagnosis.verdict}")
    for cause in diagnosis.causes:
        values = ", ".join(f"{key} {e.value:.3f} +- {e.std:.3f} {e.unit}" for key, e in cause.parameters.items())
        print(f"{cause.name}: {values}; error {cause.gain.before:.3f} -> {cause.gain.after:.3f}")
