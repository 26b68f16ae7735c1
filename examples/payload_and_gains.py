"""A payload that nobody weighed, drives whose gains nobody stated, and a fit that needs no acceleration."""

import equinox as eqx
import numpy as np

import figaroh_jax as fj

DAMPING = np.array([1.0, 1.5, 0.8, 0.3])  # N m s/rad
GAINS = np.array([13.6, -8.7, 10.5, 6.0])  # N m a unit of the reading


def run(
    robot: fj.RobotModel, seed: int, carried: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """States and torques of a motion, with ten more parameters on the hand where something is carried."""
    rng, t = np.random.default_rng(seed), np.arange(3000)[:, None] / 100.0
    w, phase = 2 * np.pi * rng.uniform(0.15, 0.9, (3, robot.nv)), rng.uniform(0, 6, (3, robot.nv))
    parts = [0.4 * w**i * np.sin(w * t[:, None] + phase + i * np.pi / 2) for i in range(3)]
    q, v, a = (part.sum(axis=1) for part in parts)
    inertia = np.array(robot.inertia)
    inertia[-1] += 0.0 if carried is None else carried
    tau = np.asarray(fj.inverse_dynamics(eqx.tree_at(lambda r: r.inertia, robot, inertia), q, v, a)) + DAMPING * v
    return q, v, a, tau + 0.02 * rng.normal(size=tau.shape)


def main() -> None:
    """Three questions on one arm."""
    robot = fj.load_urdf(fj.DEMO)
    friction = fj.columns.friction_terms(robot, fj.Baseline(coulomb=False))
    solve, weighted = fj.least_squares.solve, fj.least_squares.WeightedByJoint()
    mass, at = 1.7, np.array([0.02, -0.03, 0.05])
    about = mass * (at @ at * np.eye(3) - np.outer(at, at))
    ten = np.array([mass, *(mass * at), *about[np.triu_indices(3)][[0, 1, 3, 2, 4, 5]]])

    # an unknown payload: two recordings share the robot, the second one has ten parameters more
    plain = fj.states.States(robot, lambda: [run(robot, 1)], friction)
    loaded = fj.states.States(robot, lambda: [run(robot, 2, ten)], friction)
    hand = robot.link_names[-1]
    rows = fj.payloads.PayloadStates(plain, loaded, hand)
    found = solve(fj.regression.condense(rows, rows.used), weighted, kept=rows.structural.independent)
    print(f"payload {found.parameters[rows.names.index(f'm_{hand}')]:.3f} kg, put there {mass} kg")

    # unknown gains: what the known payload adds is the torque that no gain can change
    known = fj.Load(frame=hand, mass=mass, com=tuple(at))
    both_runs = (run(robot, 3), None), (run(robot, 4, ten), known)
    readings = [(q, v, a, tau / GAINS, load) for (q, v, a, tau), load in both_runs]
    base = plain.structural
    print("gains", np.round(fj.payloads.drive_gains(robot, friction, base, readings).gains, 2), "put there", GAINS)

    # momentum over windows of a tenth of a second: positions, velocities and torques alone
    q, v, _, tau = run(robot, 5)
    windows = fj.acceleration_free.WindowRows(robot, lambda: [(q, v, tau)], 0.01, "momentum", 10, friction)
    found = solve(fj.regression.condense(windows, windows.used), weighted, kept=base.independent)
    print("damping", np.round([found.parameters[windows.names.index(f"fv{k}")] for k in range(1, 5)], 2), "N m s/rad")


if __name__ == "__main__":
    main()
