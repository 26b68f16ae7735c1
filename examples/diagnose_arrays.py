"""What does the simulation get wrong? From arrays in memory to a named cause, its size, and what it gains."""

import numpy as np

import figaroh_jax as fj


def recordings(robot: fj.RobotModel) -> list[fj.Recording]:
    """Two motions, each twice (from repeats comes the noise), of a robot with a spring that nobody modelled."""
    rng, t = np.random.default_rng(0), np.arange(2500)[:, None] / 250.0
    friction = [fj.place(fj.CATALOGUE["viscous_friction"], robot, [name], damping=1.0) for name in robot.joint_names]
    spring = fj.place(fj.CATALOGUE["joint_spring"], robot, ["shoulder"], stiffness=6.0)
    real, runs = fj.extend(robot, *friction, spring), []
    for label in "AB":
        w, phase = 2 * np.pi * rng.uniform(0.15, 0.7, (3, robot.nv)), rng.uniform(0, 6, (3, robot.nv))
        parts = [0.4 * w**i * np.sin(w * t[:, None] + phase + i * np.pi / 2) for i in range(3)]
        q, v, a = (part.sum(axis=1) for part in parts)
        torque = np.asarray(real.inverse_dynamics(q, v, a))
        noise = 0.01 * torque.std(axis=0)
        for k in (1, 2):
            tau = torque + noise * rng.normal(size=q.shape)
            runs.append(fj.recording(q=q, tau=tau, rate=250, model=robot, repeat=label, name=f"{label}{k}"))
    return runs


def main() -> None:
    """Diagnose, and use the extended model."""
    robot = fj.load_urdf(fj.DEMO)
    found = fj.diagnose(robot, recordings(robot), fj.Preprocess(cutoff=10, rate=40))
    print("verdict:", found.verdict)
    for cause in found.causes:
        sizes = {key: f"{e.value:.2f} +- {e.std:.2f} {e.unit}" for key, e in cause.parameters.items()}
        print(cause.name, sizes, f"error {cause.gain.before:.1%} -> {cause.gain.after:.1%}")
    print(np.round(found.model.inverse_dynamics(np.full(4, 0.5), np.zeros(4), np.zeros(4)), 2), "N m")


if __name__ == "__main__":
    main()
