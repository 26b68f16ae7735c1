"""Identify a robot from arrays in memory: base parameters, physically consistent links, friction. No files."""

import numpy as np

import figaroh_jax as fj


def recordings(robot: fj.RobotModel) -> list[fj.Recording]:
    """Two motions of a robot with friction and a heavier forearm, with noise; yours come from your controller."""
    rng, t = np.random.default_rng(0), np.arange(2500)[:, None] / 250.0
    friction = [fj.place(fj.CATALOGUE["viscous_friction"], robot, [name], damping=1.5) for name in robot.joint_names]
    heavy = fj.place(fj.CATALOGUE["link_inertia"], robot, ["forearm"], mass=0.4, mz=0.05)
    real = fj.extend(robot, *friction, heavy)
    runs = []
    for k in range(2):
        w, phase = 2 * np.pi * rng.uniform(0.2, 0.8, robot.nv), rng.uniform(0, 6, robot.nv)
        q, v, a = (0.8 * w**i * np.sin(w * t + phase + i * np.pi / 2) for i in range(3))
        tau = np.asarray(real.inverse_dynamics(q, v, a)) + 0.05 * rng.normal(size=q.shape)
        runs.append(fj.recording(q=q, tau=tau, rate=250, model=robot, name=f"run {k}"))
    return runs


def main() -> None:
    """What the torques tell of the robot, and how well it then predicts them."""
    robot = fj.load_urdf(fj.DEMO)
    found = fj.identify(robot, recordings(robot), fj.Preprocess(cutoff=10))
    print(f"{found.rank} of {found.structural_rank} base parameters")
    for joint, before, after in zip(found.joints, found.nominal.relative, found.fit.relative, strict=True):
        print(f"{joint}: error {before:.1%} of its torque -> {after:.1%}")
    for effect in found.effects[: robot.nv]:
        print(effect.name, {key: f"{e.value:.3f} +- {e.std:.3f} {e.unit}" for key, e in effect.parameters.items()})


if __name__ == "__main__":
    main()
