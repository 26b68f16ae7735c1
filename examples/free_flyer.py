"""A robot that flies: identified from the wrench that carries it, measured by a sensor on a frame of its own."""

import numpy as np
from scipy.spatial.transform import Rotation

import figaroh_jax as fj

DAMPING = np.array([1.0, 1.5, 0.8, 0.3])  # N m s/rad


def motion(robot: fj.RobotModel, seed: int) -> tuple[np.ndarray, ...]:
    """Pose of the root with the joints, their rates in the root's axes, and the rates of those."""
    rng, t = np.random.default_rng(seed), np.arange(2500)[:, None] / 125.0
    n = 4 + len(DAMPING)  # x y z, an angle about a fixed axis, joints
    w, phase = 2 * np.pi * rng.uniform(0.15, 0.7, n), rng.uniform(0, 6, n)
    x, dx, ddx = (0.4 * w**k * np.sin(w * t + phase + k * np.pi / 2) for k in range(3))
    axis = np.array([1.0, 2.0, -1.0]) / np.sqrt(6.0)
    turn = Rotation.from_rotvec(x[:, 3:4] * axis)
    seen, faster = turn.inv().apply(dx[:, :3]), turn.inv().apply(ddx[:, :3])
    faster = faster - np.cross(dx[:, 3:4] * axis, seen)
    q = np.hstack([x[:, :3], turn.as_quat(), x[:, 4:]])
    return q, np.hstack([seen, dx[:, 3:4] * axis, dx[:, 4:]]), np.hstack([faster, ddx[:, 3:4] * axis, ddx[:, 4:]])


def main() -> None:
    """Torques of the motors and a wrench on the base are what moves it."""
    robot = fj.load_urdf(fj.DEMO, root="free_flyer")
    rng, runs = np.random.default_rng(0), []
    for seed in (1, 2):
        q, v, a = motion(robot, seed)
        force = np.asarray(fj.inverse_dynamics(robot, q, v, a))  # the root's wrench, then the joints' torques
        tau = force[:, 6:] + DAMPING * v[:, 6:] + 0.02 * rng.normal(size=(len(q), 4))  # of the motors
        wrench = force[:, :6] + 0.1 * rng.normal(size=(len(q), 6))  # on the frame "base", in its axes
        total = fj.wrenches.generalized_force(robot, q, {"base": wrench}) + np.pad(tau, ((0, 0), (6, 0)))
        runs.append(fj.recording(q=q, tau=total, rate=125, model=robot, name=f"flight {seed}"))
    found = fj.identify(robot, runs, fj.Preprocess(cutoff=10), fj.Baseline(coulomb=False))
    print(f"{found.rank} of {found.structural_rank} base parameters")
    for joint, error in zip(found.joints, found.fit.relative, strict=True):
        print(f"{joint}: {error:.2%} of its force or torque unexplained")
    for effect in found.effects:
        print(effect.name, f"{effect.parameters['damping'].value:.3f} N m s/rad")


if __name__ == "__main__":
    main()
