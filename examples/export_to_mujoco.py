"""The extended robot in MuJoCo: written as MJCF, loaded there, stepped beside our own simulation."""

# mujoco's stubs lack what its C module holds
# pyright: reportAttributeAccessIssue=false

import tempfile
from pathlib import Path

import mujoco
import numpy as np

import figaroh_jax as fj

DT, STEPS = 1e-3, 500


def main() -> None:
    """Friction and a rotor put into the model, carried over, and both let go from the same posture."""
    robot = fj.load_urdf(fj.DEMO)
    effects = [fj.place(fj.CATALOGUE["viscous_friction"], robot, [name], damping=2.0) for name in robot.joint_names]
    effects.append(fj.place(fj.CATALOGUE["rotor_inertia"], robot, ["elbow"], inertia=0.05))
    model = fj.extend(robot, *effects)

    with tempfile.TemporaryDirectory() as folder:
        fj.write_model(model, folder)  # robot.urdf, robot.xml, effects.yaml
        theirs = mujoco.MjModel.from_xml_path(str(Path(folder) / "robot.xml"))
    theirs.opt.timestep, theirs.opt.integrator = DT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data = mujoco.MjData(theirs)
    start = np.array([0.2, 0.4, -0.3, 0.1])
    data.qpos[:] = start
    mujoco.mj_step(theirs, data, STEPS)

    ours = fj.simulate(model, np.zeros((STEPS, robot.nv)), start, np.zeros(robot.nv), DT)
    print("MuJoCo     ", np.round(data.qpos, 4))
    print("figaroh_jax", np.round(np.asarray(ours.position)[-1], 4))


if __name__ == "__main__":
    main()
