"""A friction law of one's own: registered, fitted, diagnosed and exported, in 22 lines (from `@fj.register` on).

Friction that grows with the logarithm of the speed, as in greased bearings, is hidden at the shoulder of the demo's arm
in simulated recordings. Run `python examples/own_friction.py`; about a minute.
"""

import tempfile

import jax.numpy as jnp
import numpy as np

import figaroh_jax as fj


def recordings(robot: fj.RobotModel) -> list[fj.Recording]:
    """Two motions, each twice: viscous friction everywhere, and a law that the catalogue lacks."""
    rng, t, w = np.random.default_rng(1), np.arange(2500)[:, None] / 250.0, 0.2 * np.pi * np.arange(1, 6)[:, None, None]
    runs = []
    for label in "AB":
        s, c = rng.normal(size=(2, 5, 1, robot.nv)) / np.sqrt(np.arange(1, 6))[:, None, None]
        turns = (0.0, np.pi / 2, np.pi)
        parts = [(w**k * (s * np.sin(w * t + h) + c * np.cos(w * t + h))).sum(0) for k, h in enumerate(turns)]
        q, v, a = (part / np.abs(parts[0]).max(0) for part in parts)
        torque = np.asarray(fj.inverse_dynamics(robot, q, v, a)) + 1.0 * v
        torque[:, 1] += 0.6 * np.sign(v[:, 1]) * np.log1p(np.abs(v[:, 1]) / 0.03)
        for _ in range(2):
            tau = torque + 0.01 * np.sqrt(np.mean(torque**2, axis=0)) * rng.standard_normal(q.shape)
            runs.append(fj.recording(q=q, tau=tau, rate=250, model=robot, repeat=label))
    return runs


@fj.register
class Grease(fj.JointEffect):
    """Friction of a greased bearing."""

    name, title = "grease_friction", "friction of a greased bearing"
    equation = "force x sign(v) log(1 + |v| / speed)"
    dissipative = True  # a negative size would feed energy to the robot
    force: float = fj.amplitude("N m")
    speed: float = fj.shape("rad/s", (0.01, 0.02, 0.05, 0.1))

    def torque(self, motion: fj.Motion):
        v = self.here(motion.velocity)
        return self.force * self.here(motion.direction) * jnp.log1p(abs(v) / self.speed)


if __name__ == "__main__":
    robot, settings = fj.load_urdf(fj.DEMO), fj.Preprocess(cutoff=15, rate=50)
    runs = recordings(robot)
    friction = [fj.place(fj.CATALOGUE["viscous_friction"], robot, [name]) for name in robot.joint_names]
    model = fj.extend(robot, *friction, fj.place(Grease, robot, ["shoulder"], force=0.1, speed=0.05))
    found = fj.fit(model, fj.torque_data(robot, runs, settings), "effects")
    print("fit:", found.model.effects[-1])
    diagnosis = fj.diagnose(robot, runs, settings, fj.Baseline(coulomb=False))
    print(diagnosis.verdict, *(f"{cause.name} {cause.parameters}" for cause in diagnosis.causes))
    with tempfile.TemporaryDirectory() as folder:
        fj.write_model(diagnosis.model, folder)
        print("exported and read back:", [effect.name for effect in fj.load_model(folder).effects][-1])
