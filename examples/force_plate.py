"""A robot bolted onto a force plate: six rows more a sample, and parameters that no joint's torque can show."""

import numpy as np

import figaroh_jax as fj

DAMPING = np.array([1.0, 1.5, 0.8, 0.3])  # N m s/rad
OFFSET = np.array([3.0, -2.0, 5.0, 0.1, -0.2, 0.3])  # of the plate's channels, N and N m


def main() -> None:
    """The joints alone, then the joints and the plate."""
    robot = fj.load_urdf(fj.DEMO)
    rng, t = np.random.default_rng(0), np.arange(3000)[:, None] / 100.0
    w, phase = 2 * np.pi * rng.uniform(0.15, 0.9, robot.nv), rng.uniform(0, 6, robot.nv)
    q, v, a = (0.6 * w**k * np.sin(w * t + phase + k * np.pi / 2) for k in range(3))
    tau = np.asarray(fj.inverse_dynamics(robot, q, v, a)) + DAMPING * v + 0.02 * rng.normal(size=q.shape)
    felt = np.asarray(fj.wrenches.wrench_regressor(robot, q, v, a, "base")) @ np.ravel(robot.inertia)
    wrench = felt + OFFSET + np.array([0.2] * 3 + [0.05] * 3) * rng.normal(size=felt.shape)

    friction = fj.columns.friction_terms(robot, fj.Baseline(coulomb=False))
    joints = fj.states.States(robot, lambda: [(q, v, a, tau)], friction)
    plate = fj.wrenches.SensorStates(robot, lambda: [(q, v, a, tau, wrench)], "base", friction)
    for name, rows in (("joints", joints), ("joints and plate", plate)):
        base = rows.structural
        data = fj.regression.condense(rows, rows.used)
        found = fj.least_squares.solve(data, fj.least_squares.WeightedByJoint(), kept=base.independent)
        print(f"{name}: {base.rank} base parameters; RMS error of each row", np.round(found.rms, 3))
    at = [rows.names.index(name) for name in ("Fx0", "Fy0", "Tz0")]
    print("offsets of the plate", np.round(found.parameters[at], 2), "put there", OFFSET[[0, 1, 5]])


if __name__ == "__main__":
    main()
