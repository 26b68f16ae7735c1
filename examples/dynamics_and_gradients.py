"""Dynamics of a robot from its URDF, and derivatives by whatever the model holds."""

import jax
import numpy as np

import figaroh_jax as fj

jax.config.update("jax_enable_x64", True)  # gradients in float64


def main() -> None:
    """Torques, their inverse, and how the torque of one posture hangs on every mass of the robot."""
    robot = fj.load_urdf(fj.DEMO)  # a pytree: every array is a leaf
    q, v, a = (np.linspace(lo, 1.0, robot.nv) for lo in (0.1, 0.2, -0.5))

    tau = fj.inverse_dynamics(robot, q, v, a)  # N m
    assert np.allclose(fj.forward_dynamics(robot, q, v, tau), a)
    W = fj.joint_torque_regressor(robot, q, v, a)
    assert np.allclose(W @ robot.inertia.ravel(), tau)

    by_robot = jax.jacfwd(lambda model: fj.inverse_dynamics(model, q, v, a))(robot)
    print("torque", np.round(tau, 3), "N m")
    print("by the mass of each link\n", np.round(by_robot.inertia[:, :, 0], 3), "N m/kg")
    print("by gravity\n", np.round(by_robot.gravity, 3), "N m/(m/s2)")


if __name__ == "__main__":
    main()
