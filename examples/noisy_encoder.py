"""An encoder that is noise where it is differentiated twice: least squares is biased, two other forms are not."""

from typing import Any

import jax.numpy as jnp
import numpy as np

import figaroh_jax as fj

DT, SPAN = 2e-3, 8  # s; samples over which positions are differentiated
STIFF, SOFT = 60.0, 8.0  # gains of the servo
DAMPING = 1.5  # N m s/rad


def wanted(time: Any) -> Any:
    """The reference of the one joint that moves, rad."""
    return 0.5 * jnp.sin(2.1 * time + jnp.zeros(1)) + 0.2 * jnp.sin(4.8 * time + 1.0)


def control(time: Any, q: Any, v: Any) -> Any:
    """The servo of the recording, which the simulated instruments run under as well; it begins SPAN samples late."""
    return STIFF * (wanted(time + SPAN * DT) - q) - SOFT * v


def main() -> None:
    """Three fits of one recording."""
    robot = fj.load_urdf(fj.DEMO, joints=["shoulder"])
    friction = fj.place(fj.CATALOGUE["viscous_friction"], robot, ["shoulder"], damping=DAMPING)
    run = fj.simulate(fj.extend(robot, friction), control, np.zeros(1), np.zeros(1), DT, 6000)
    read = np.asarray(run.position) + 5e-4 * np.random.default_rng(0).normal(size=run.position.shape)
    k = np.arange(SPAN, len(read) - SPAN)
    v = (read[k + SPAN] - read[k - SPAN]) / (2 * SPAN * DT)
    a = (read[k + SPAN] - 2 * read[k] + read[k - SPAN]) / (SPAN * DT) ** 2
    q, tau = read[k], np.asarray(run.torque)[k]

    terms = fj.columns.friction_terms(robot, fj.Baseline(coulomb=False))
    rows = fj.states.States(robot, lambda: [(q, v, a, tau)], terms)
    base = rows.structural
    truth = base.matrix @ np.append(np.ravel(robot.inertia), DAMPING)
    solve, condense, weighted = fj.least_squares.solve, fj.regression.condense, fj.least_squares.WeightedByJoint()
    first, speed = np.asarray(run.position)[SPAN], np.asarray(run.velocity)[SPAN]
    windows = fj.acceleration_free.WindowRows(robot, lambda: [(q, v, tau)], DT, "energy", 20, terms)
    found = {
        "least squares": solve(condense(rows, rows.used), weighted, kept=base.independent),
        "simulated instruments": fj.instruments.solve_by_simulation(rows, base, control, first, speed, DT),
        "energy over windows": solve(condense(windows, windows.used), weighted, kept=base.independent),
    }
    for name, one in found.items():
        error = np.linalg.norm(one.parameters[base.independent] - truth) / np.linalg.norm(truth)
        print(f"{name}: base parameters {error:.1%} from the truth")


if __name__ == "__main__":
    main()
