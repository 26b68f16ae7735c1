"""An arm's loop replayed by other simulators from what the export says: their motion against our own.

    python benchmarks/replays.py write DIR                    # where figaroh_jax is installed
    python benchmarks/replays.py mujoco|newton|genesis DIR    # where that simulator is installed, NumPy alone beside it

The arm is that of `tests/generators/servo_arm6.py` with armature, damping and friction at each of six joints and
position drives; 4 s of commands, 2 ms, from rest. Every number is put where `figaroh-jax export --for NAME` says that
the simulator has it. It prints the RMS and the largest difference to our motion, mrad, and how far the arm moved.
"""

from __future__ import annotations

import argparse
import json
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np

STEPS = 2000


def write(folder: Path) -> None:
    """`arm.xml` (bodies alone), `full.xml` (as exported for MuJoCo), `NAME.json` for each simulator, `motion.npz`."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
    from generators import servo_arm6

    import figaroh_jax as fj
    from figaroh_jax.rollouts.export import SIMULATORS, described, for_simulator, with_drives

    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "arm.xml"
    file.write_text(servo_arm6.model_text())
    loop, _ = fj.load_loop(file)
    content = described(loop)
    (folder / "full.xml").write_text(with_drives(file, content))
    for name in SIMULATORS:
        told = for_simulator(content, name) | {"dt": content["dt"]}
        (folder / f"{name}.json").write_text(json.dumps(told, indent=1))
    command = servo_arm6.command(3, 0)[:STEPS]
    found = fj.rollout(loop, command, command[0])
    np.savez(folder / "motion.npz", command=command, position=np.asarray(found.reading), names=servo_arm6.NAMES)
    tree = ElementTree.parse(file)  # noqa: S314 (our own text)
    for actuator in tree.getroot().findall("actuator"):
        tree.getroot().remove(actuator)
    for joint in tree.getroot().iter("joint"):
        for word in ("armature", "damping", "frictionloss"):
            joint.attrib.pop(word, None)
    tree.write(file)


def numbers(folder: Path, name: str) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[str], float]:
    """The export's numbers by our name, joints in order; the command, our motion, the joints' names, the step."""
    told, made = json.loads((folder / f"{name}.json").read_text()), np.load(folder / "motion.npz")
    names = [str(x) for x in made["names"]]
    found: dict[str, np.ndarray] = {}
    for one in told["values"]:
        found.setdefault(one["number"], np.zeros(len(names)))[names.index(one["at"])] = one["value"]
    return found, made["command"], made["position"], names, told["dt"]


def mujoco(folder: Path) -> np.ndarray:
    import mujoco as engine

    _, command, _, names, _ = numbers(folder, "mujoco")
    api: Any = engine
    model = api.MjModel.from_xml_path(str(folder / "full.xml"))
    data, found = api.MjData(model), np.zeros_like(command)
    at = [model.joint(name).qposadr[0] for name in names]
    data.qpos[at] = command[0]
    for k, row in enumerate(command):
        found[k], data.ctrl[:] = data.qpos[at], row
        api.mj_step(model, data)
    return found


def newton(folder: Path) -> np.ndarray:
    import newton as engine  # pyright: ignore[reportMissingImports]

    api: Any = engine
    own, command, _, names, dt = numbers(folder, "newton")
    builder = api.ModelBuilder()
    api.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.add_mjcf(str(folder / "arm.xml"), enable_self_collisions=False)
    places = [next(k for k, label in enumerate(builder.joint_label) if label.split("/")[-1] == name) for name in names]
    dofs = [builder.joint_qd_start[k] for k in places]
    words = {
        "armature": builder.joint_armature, "friction": builder.joint_friction, "kp": builder.joint_target_ke,
        "kd": builder.joint_target_kd, "damping": builder.joint_damping,
    }  # fmt: skip
    for number, values in own.items():
        for dof, value in zip(dofs, values, strict=True):
            words[number][dof] = float(value)
    for dof in dofs:
        builder.joint_target_mode[dof] = int(api.JointTargetMode.POSITION_VELOCITY)
    model = builder.finalize(device="cpu")
    solver = api.solvers.SolverMuJoCo(model, use_mujoco_cpu=True, disable_contacts=True, integrator="implicitfast")
    states, control = [model.state(), model.state()], model.control()
    order = np.array(dofs)
    begin = np.zeros(model.joint_coord_count)
    begin[order] = command[0]
    states[0].joint_q.assign(begin.astype(np.float32))
    found, target = np.zeros_like(command), begin.astype(np.float32)
    for k, row in enumerate(command):
        found[k], target[order] = states[0].joint_q.numpy()[order], row
        control.joint_target_q.assign(target)
        solver.step(states[0], states[1], control, None, dt)
        states.reverse()
    return found


def genesis(folder: Path) -> np.ndarray:
    import genesis as engine  # pyright: ignore[reportMissingImports]

    api: Any = engine
    own, command, _, names, dt = numbers(folder, "genesis")
    api.init(backend=api.cpu, precision="64", logging_level="error")
    scene = api.Scene(
        show_viewer=False,
        sim_options=api.options.SimOptions(dt=dt),
        rigid_options=api.options.RigidOptions(integrator=api.integrator.implicitfast, enable_collision=False),
    )
    robot = scene.add_entity(api.morphs.MJCF(file=str(folder / "arm.xml")))
    scene.build()
    dofs = [robot.get_joint(name).dofs_idx_local[0] for name in names]
    calls = {
        "armature": robot.set_dofs_armature, "damping": robot.set_dofs_damping, "kp": robot.set_dofs_kp,
        "friction": robot.set_dofs_frictionloss, "kd": robot.set_dofs_kv, "stiffness": robot.set_dofs_stiffness,
    }  # fmt: skip
    for number, values in own.items():
        calls[number](values, dofs)
    robot.set_dofs_force_range(np.full(len(dofs), -1e6), np.full(len(dofs), 1e6), dofs)
    robot.set_dofs_position(command[0], dofs)
    found = np.zeros_like(command)
    for k, row in enumerate(command):
        found[k] = np.asarray(robot.get_dofs_position(dofs).cpu())
        robot.control_dofs_position(row, dofs)
        scene.step()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["write", "mujoco", "newton", "genesis"])
    parser.add_argument("folder", type=Path)
    args = parser.parse_args()
    if args.what == "write":
        return write(args.folder)
    found = {"mujoco": mujoco, "newton": newton, "genesis": genesis}[args.what](args.folder)
    _, _, ours, _, _ = numbers(args.folder, args.what)
    error = 1e3 * (found - ours)
    print(
        f"{args.what}: {np.sqrt(np.mean(error**2)):.3g} mrad RMS, {np.abs(error).max():.3g} at most;"
        f" by joint {np.sqrt(np.mean(error**2, axis=0)).round(5)}; moved {np.ptp(ours, axis=0).mean():.2f} rad"
    )


if __name__ == "__main__":
    main()
