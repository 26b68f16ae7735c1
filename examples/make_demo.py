"""Make the recordings of `figaroh-jax demo`: a four-joint arm in MuJoCo C under a tracking controller.

Nothing of the library is used, so that the demo is a fair question. The nominal URDF is a few per cent wrong, as every
model is, and two causes are hidden: Stribeck friction at the shoulder, and a transmission shared by elbow and wrist.
Run `python examples/make_demo.py` to write the same files again (`figaroh_jax/demo`), the truth in `truth.yaml`.
"""

# pyright: reportAttributeAccessIssue=false
from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

import mujoco
import numpy as np

FOLDER = Path(__file__).resolve().parents[1] / "figaroh_jax" / "demo"
SEED = 20240
DT = 1e-4  # s, of the simulation
CONTROL = 4  # steps between two commands
AVERAGED = 40  # steps in one sample of the recording: 250 Hz
PERIOD, WARM_UP = 10.0, 2.0  # s
REVERSAL = 0.005  # rad/s, half width of a reversal of dry friction

JOINTS = ("waist", "shoulder", "elbow", "wrist")
LINKS = ("turret", "upper_arm", "forearm", "hand")
# placement of the joint in its parent (m), axis, mass (kg), centre of mass (m), principal inertia (kg m2)
NOMINAL = (
    ((0, 0, 0.12), (0, 0, 1), 3.0, (0.0, 0.01, 0.06), (0.012, 0.014, 0.010)),
    ((0.03, 0, 0.10), (0, 1, 0), 2.2, (0.14, 0.0, 0.02), (0.003, 0.020, 0.021)),
    ((0.30, 0, 0), (0, 1, 0), 1.4, (0.10, 0.005, 0.0), (0.002, 0.008, 0.008)),
    ((0.22, 0, 0), (0, 1, 0), 0.7, (0.06, 0.0, 0.01), (0.001, 0.0016, 0.0014)),
)
CENTRE = np.array([0.0, -0.7, 1.1, 0.3])  # rad, of the motion
VISCOUS = np.array([1.2, 1.5, 0.9, 0.5])  # N m s/rad
COULOMB = np.array([1.4, 1.8, 1.1, 0.6])  # N m
ROTOR = np.array([0.020, 0.025, 0.012, 0.006])  # kg m2, which a URDF cannot hold; the task fits it
STRIBECK = {"force": 1.6, "speed": 0.13}  # at the shoulder
COUPLING = {"inertia": 0.004, "damping": 0.10, "friction": 0.25, "sign": 1.0}  # of elbow and wrist


def main(folder: Path) -> None:
    """Write robot, task, recordings and truth into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(SEED)
    model = mujoco.MjModel.from_xml_string(mjcf(rng))
    motions = [excitation(rng) for _ in range(3)]
    runs = {"first_1": 0, "first_2": 0, "second_1": 1, "second_2": 1, "unseen": 2}
    clean = {name: simulate(model, *motions[k], rng) for name, k in runs.items()}
    rms = np.sqrt(np.mean([np.mean(torque**2, 0) for _, torque in clean.values()], 0))
    for name, (position, torque) in clean.items():
        noise = 0.02 * rng.standard_normal(torque.shape) + 0.01 * coloured(torque.shape, rng)
        reading = np.round((position + 2e-5 * rng.standard_normal(position.shape)) / 2e-5) * 2e-5
        # a sensor of 1 mN m steps: the files stay small
        drive = np.round((torque + rms * noise) / 1e-3) * 1e-3
        np.savez_compressed(folder / f"{name}.npz", q=reading.astype(np.float32), tau=drive.astype(np.float32))
    (folder / "robot.urdf").write_text(urdf())
    (folder / "task.yaml").write_text(task(runs))
    (folder / "truth.yaml").write_text(TRUTH)


def mjcf(rng: np.random.Generator) -> str:
    """The real arm: inertials off the nominal ones, rotors, and the tendon that couples elbow and wrist."""
    text, close = "", ""
    for name, rotor, (place, axis, mass, com, inertia) in zip(JOINTS, ROTOR, NOMINAL, strict=True):
        mass *= 1 + 0.04 * rng.standard_normal()
        com = np.array(com) + 0.04 * np.linalg.norm(com) * rng.standard_normal(3)
        inertia = np.array(inertia) * (1 + 0.04 * rng.standard_normal())
        text += f'<body pos="{words(place)}"><joint name="{name}" axis="{words(axis)}" armature="{rotor}"/>'
        text += f'<inertial pos="{words(com)}" mass="{mass!r}" diaginertia="{words(inertia)}"/>'
        close += "</body>"
    pair = "".join(f'<joint joint="{JOINTS[k]}" coef="{c}"/>' for k, c in ((2, 1.0), (3, COUPLING["sign"])))
    tendon = f'<tendon><fixed armature="{COUPLING["inertia"]}">{pair}</fixed></tendon>'
    option = f'<option timestep="{DT}" integrator="implicitfast"/>'
    return f"<mujoco>{option}<worldbody>{text}{close}</worldbody>{tendon}</mujoco>"


def excitation(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Sine and cosine coefficients (rad) of five harmonics of .1 Hz, at most 1 rad from the centre and 2.5 rad/s."""
    order = np.arange(1, 6)[:, None]
    coefficients = rng.standard_normal((2, 5, 4)) / np.sqrt(order)
    q, v, _ = motion(coefficients[0], coefficients[1], np.linspace(0, PERIOD, 1001))
    scale = np.minimum(1.0 / np.abs(q - CENTRE).max(0), 2.5 / np.abs(v).max(0))
    return coefficients[0] * scale, coefficients[1] * scale


def motion(sine: np.ndarray, cosine: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and acceleration of the excitation at `time`."""
    w = 2 * np.pi / PERIOD * np.arange(1, len(sine) + 1)
    sin, cos = np.sin(np.outer(time, w)), np.cos(np.outer(time, w))
    velocity = (cos * w) @ sine - (sin * w) @ cosine
    return CENTRE + sin @ sine + cos @ cosine, velocity, -(sin * w**2) @ sine - (cos * w**2) @ cosine


def simulate(
    model: mujoco.MjModel, sine: np.ndarray, cosine: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Position and torque of the drives at 250 Hz, each the mean over 4 ms."""
    data = mujoco.MjData(model)
    time = np.arange(-WARM_UP, PERIOD, DT * CONTROL)
    q, v, a = motion(sine, cosine, time)
    wobble = 3e-4 * np.sin(2 * np.pi * rng.uniform(0.3, 1.5, 4) * time[:, None] + rng.uniform(0, 6, 4))
    forward = feed_forward(q, v, a)
    inertia = np.array([0.25, 0.30, 0.08, 0.015]) + ROTOR
    stiffness, damping = inertia * 200.0**2, inertia * 400.0
    data.qpos[:], data.qvel[:] = q[0], v[0]
    drive = forward[0]
    position, torque = np.empty((2, len(time) * CONTROL, 4))
    for step in range(len(position)):
        k, late = divmod(step, CONTROL)
        if late == 0:
            drive = forward[k] + stiffness * (q[k] + wobble[k] - data.qpos) + damping * (v[k] - data.qvel)
        before = data.qpos.copy()
        friction(model, data, drive)
        mujoco.mj_step(model, data)
        position[step], torque[step] = (before + data.qpos) / 2, drive
    kept = slice(round(WARM_UP / DT), None)
    return tuple(x[kept].reshape(-1, AVERAGED, 4).mean(1) for x in (position, torque))  # type: ignore[return-value]


def feed_forward(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """What the controller believes: torque of the nominal arm without its rotors, with plain friction."""
    nominal = mujoco.MjModel.from_xml_string(urdf())
    data = mujoco.MjData(nominal)
    out = np.empty_like(q)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(nominal, data)
        out[k] = data.qfrc_inverse
    return out + VISCOUS * v + COULOMB * np.clip(v / 0.01, -1, 1)


def friction(model: mujoco.MjModel, data: mujoco.MjData, drive: np.ndarray) -> None:
    """Set the forces of one step: the drive, dry friction with the hidden parts; viscous friction as damping.

    Inside a reversal dry friction is a damper that the integrator takes implicitly, so that nothing chatters.
    """
    v = data.qvel
    level = COULOMB.copy()
    level[1] += STRIBECK["force"] * np.exp(-((v[1] / STRIBECK["speed"]) ** 2))
    inside = np.abs(v) < REVERSAL
    model.dof_damping[:] = VISCOUS + np.where(inside, level / REVERSAL, 0.0)
    data.qfrc_applied[:] = drive - np.where(inside, 0.0, level * np.sign(v))
    speed = v[2] + COUPLING["sign"] * v[3]
    inside = abs(speed) < REVERSAL
    model.tendon_damping[:] = COUPLING["damping"] + (COUPLING["friction"] / REVERSAL if inside else 0.0)
    shared = 0.0 if inside else COUPLING["friction"] * np.sign(speed)
    data.qfrc_applied[2:] -= shared * np.array([1.0, COUPLING["sign"]])


def coloured(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Noise of unit variance whose correlation falls to 1/e in 20 ms."""
    keep = np.exp(-4.0 / 20.0)
    out = rng.standard_normal(shape)
    for k in range(1, len(out)):
        out[k] = keep * out[k - 1] + np.sqrt(1 - keep**2) * out[k]
    return out


def urdf() -> str:
    """The nominal arm, which everyone believes in."""
    text, parent = '<?xml version="1.0"?>\n<robot name="demo_arm">\n  <link name="base"/>\n', "base"
    for joint, link, (place, axis, mass, com, (xx, yy, zz)) in zip(JOINTS, LINKS, NOMINAL, strict=True):
        text += f'  <joint name="{joint}" type="revolute">\n    <parent link="{parent}"/><child link="{link}"/>\n'
        text += f'    <origin xyz="{words(place)}"/><axis xyz="{words(axis)}"/>\n'
        text += '    <limit lower="-3.0" upper="3.0" velocity="4.0" effort="60.0"/>\n  </joint>\n'
        text += f'  <link name="{link}">\n    <inertial>\n      <origin xyz="{words(com)}"/><mass value="{mass}"/>\n'
        text += f'      <inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/>\n'
        text += "    </inertial>\n  </link>\n"
        parent = link
    return text + "</robot>\n"


def task(runs: dict[str, int]) -> str:
    """The task file: recordings at 250 Hz, repeats by label, the last one held out."""
    text = f"robot:\n  model: robot.urdf\n  joints: [{', '.join(JOINTS)}]\n  trust: 0.10\ndata:\n"
    for name in runs:
        more = "role: holdout" if name == "unseen" else f"repeat: {name.split('_')[0]}"
        text += f"  - {{file: {name}.npz, rate: 250, position: q, torque: tau, {more}}}\n"
    return text + "preprocess: {cutoff: 15, rate: 50}\nbaseline: {viscous: true, coulomb: true, rotor: true}\n"


def words(numbers: Iterable[float]) -> str:
    """Numbers as XML wants them."""
    return " ".join(repr(float(x)) for x in numbers)


TRUTH = f"""\
# What make_demo.py hid; the library does not read this file.
causes:
  - effect: stribeck_friction
    at: [shoulder]
    parameters: {{force: {STRIBECK["force"]}, speed: {STRIBECK["speed"]}}}
  - effect: coupled_transmission
    at: [elbow, wrist]
    parameters: {{inertia: {COUPLING["inertia"]}, damping: {COUPLING["damping"]}, friction: {COUPLING["friction"]}, \
sign: {COUPLING["sign"]}}}
"""

if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
