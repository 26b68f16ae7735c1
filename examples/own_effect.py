"""An effect of your own in under 30 lines: register it, and `diagnose` finds it like one of the catalogue.

A spring-loaded ball drops into a notch as a joint passes it: a detent, which the catalogue does not have. Here one is
hidden at the elbow of the demo's arm, in simulated recordings with friction, wrong inertias and noise.
Run `python examples/own_effect.py`; it takes about a minute.
"""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import figaroh_jax as fj
from figaroh_jax.effects.base import Scalar
from figaroh_jax.effects.extended import predict


# the effect: its words, its parameters, its torque
@fj.register
class Detent(fj.Effect):
    """A ball that drops into a notch of the joint and has to be pushed out of it."""

    name, title, acts_on = "detent", "a detent", "joint"
    equation = "strength x exp(-x^2 / 2), x = (q - notch) / 0.1 rad"
    separated_by = "slow passes of {at} through the notch in both directions"
    strength: Scalar = fj.amplitude("N m")
    notch: Scalar = fj.shape("rad", tuple(np.arange(-2.0, 2.01, 0.1)))

    def torque(self, motion: fj.Motion) -> Float[Array, " samples"]:
        x = (self.here(motion.position) - self.notch) / 0.1
        return jnp.asarray(self.strength * x * jnp.exp(-(x**2) / 2))


HIDDEN = {"strength": 1.5, "notch": 0.37}
RATE, PERIOD = 250.0, 10.0  # Hz, s


def main() -> None:
    """Hide a detent at the elbow, diagnose, print what was found."""
    nominal = fj.load_urdf(Path(fj.__file__).parent / "demo" / "robot.urdf")
    rng = np.random.default_rng(1)
    truth = real_robot(nominal, rng)
    recordings = [record for label in "AB" for record in repeats(truth, label, rng)]
    diagnosis = fj.diagnose(nominal, recordings, fj.Preprocess(cutoff=15, rate=50))
    print(f"verdict: {diagnosis.verdict}")
    for cause in diagnosis.causes:
        values = ", ".join(f"{key} {e.value:.3f} +- {e.std:.3f} {e.unit}" for key, e in cause.parameters.items())
        print(f"{cause.name}: {values}; error {cause.gain.before:.3f} -> {cause.gain.after:.3f}")


def real_robot(nominal: fj.RobotModel, rng: np.random.Generator) -> fj.ExtendedModel:
    """The nominal robot with masses off by 3 %, with friction, and with the detent."""
    heavier = np.asarray(nominal.inertia) * (1 + 0.03 * rng.standard_normal((len(nominal.joints), 1)))
    robot = eqx.tree_at(lambda model: model.inertia, nominal, heavier)
    effects = [fj.place(fj.CATALOGUE["viscous_friction"], robot, [joint], damping=1.0) for joint in robot.joint_names]
    effects += [fj.place(fj.CATALOGUE["coulomb_friction"], robot, [joint], force=1.2) for joint in robot.joint_names]
    return fj.extend(robot, *effects, fj.place(Detent, robot, ["elbow"], **HIDDEN), width=0.01)


def repeats(truth: fj.ExtendedModel, label: str, rng: np.random.Generator) -> list[fj.Recording]:
    """Two recordings of one random periodic motion, with noise of the sensors."""
    robot, t = truth.robot, np.arange(int(RATE * PERIOD)) / RATE
    w = 2 * np.pi / PERIOD * np.arange(1, 6)[:, None, None]
    sine, cosine = rng.normal(size=(2, 5, 1, robot.nv)) / np.sqrt(np.arange(1, 6))[:, None, None]
    angle = w * t[:, None]
    scale = 1.0 / np.abs((sine * np.sin(angle) + cosine * np.cos(angle)).sum(0)).max(0)
    q = scale * (sine * np.sin(angle) + cosine * np.cos(angle)).sum(0)
    v = scale * (w * (sine * np.cos(angle) - cosine * np.sin(angle))).sum(0)
    a = -scale * (w**2 * (sine * np.sin(angle) + cosine * np.cos(angle))).sum(0)
    torque = np.asarray(predict(truth, t, q, v, a, 1 / RATE))
    noise = 0.02 * np.sqrt(np.mean(torque**2, axis=0))
    return [
        fj.Recording(
            name=f"{label}{k}",
            file=Path(f"{label}{k}.npz"),
            joints=robot.joint_names,
            time=t,
            position=q + 2e-5 * rng.standard_normal(q.shape),
            torque=torque + noise * rng.standard_normal(q.shape),
            repeat=label,
        )
        for k in (1, 2)
    ]


if __name__ == "__main__":
    main()
