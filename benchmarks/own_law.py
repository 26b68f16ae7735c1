"""An own friction law as one writes it who read the docstrings alone: `main` is all of it, the recordings apart.

    python benchmarks/own_law.py                 # a minute; prints what the fit and the diagnosis find

The friction of a lip seal, force tanh(v / speed), is hidden at the elbow of the demo's arm: .7 N m, .3 rad/s.
"""

from __future__ import annotations

import tempfile

import jax.numpy as jnp
import numpy as np

import figaroh_jax as fj


def recordings(robot: fj.RobotModel) -> list[fj.Recording]:
    """Two motions, each twice, with viscous friction everywhere and noise of 1 %."""
    t, rng, runs = np.arange(2500)[:, None] / 250.0, np.random.default_rng(4), []
    for label in "AB":
        w, phase = 2 * np.pi * rng.uniform(0.15, 0.6, (3, 1, 4)), rng.uniform(0, 6, (3, 1, 4))
        q, v, a = ((0.35 * w**k * np.sin(w * t + phase + k * np.pi / 2)).sum(0) for k in range(3))
        tau = np.asarray(fj.inverse_dynamics(robot, q, v, a)) + 0.8 * v
        tau[:, 2] += 0.7 * np.tanh(v[:, 2] / 0.3)
        for _ in range(2):
            seen = tau + 0.01 * tau.std(0) * rng.standard_normal(q.shape)
            runs.append(fj.recording(q=q, tau=seen, rate=250, model=robot, repeat=label))
    return runs


def main(robot: fj.RobotModel, runs: list[fj.Recording], folder: str) -> None:
    """Registered, fitted, diagnosed, exported, read back."""

    @fj.register
    class Seal(fj.JointEffect):
        name, title, equation = "seal_friction", "friction of a lip seal", "force tanh(v / speed)"
        dissipative = True
        force: float = fj.amplitude("N m")
        speed: float = fj.shape("rad/s", (0.1, 0.3, 1.0))

        def torque(self, motion: fj.Motion):
            return self.force * jnp.tanh(self.here(motion.velocity) / self.speed)

    settings = fj.Preprocess(cutoff=15, rate=50)
    viscous = [fj.place(fj.CATALOGUE["viscous_friction"], robot, [name]) for name in robot.joint_names]
    model = fj.extend(robot, *viscous, fj.place(Seal, robot, ["elbow"], force=0.1, speed=0.2))
    found = fj.fit(model, fj.torque_data(robot, runs, settings), "friction")
    print({name: f"{one.value:.3f} +- {one.std:.3f}" for name, one in found.parameters.items() if "seal" in name})
    answer = fj.diagnose(robot, runs, settings, fj.Baseline(coulomb=False))
    print(answer.verdict, *(f"{one.name.effect} {one.name.at} {one.parameters}" for one in answer.causes))
    fj.write_model(answer.model, folder)
    print([effect.name for effect in fj.load_model(folder).effects])


if __name__ == "__main__":
    demo = fj.load_urdf(fj.DEMO)
    with tempfile.TemporaryDirectory() as out:
        main(demo, recordings(demo), out)
