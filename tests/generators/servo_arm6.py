"""An arm of six servos in MuJoCo C with hidden effects of three sizes, sharing no code with the library.

2 ms, implicitfast, no contacts; position servos; dry friction, damping and armature at every joint. Read every 10 ms at
the instant at which the command is written, with noise: white (.2 mrad), coloured (the same power, a first-order low
pass of 20 ms), or the steps of an encoder of 4096 counts.
"""

# ruff: noqa: E501 - the robot stands here as lines of XML
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

EFFECTS = {  # three sizes each
    "stribeck_friction": (0.05, 0.12, 0.3),  # N m more at rest, per N m of 1
    "load_dependent_friction": (0.04, 0.1, 0.2),
    "joint_elasticity": (400.0, 150.0, 60.0),  # N m/rad
    "backlash": (0.004, 0.01, 0.025),  # rad
    "command_delay": (0.004, 0.008, 0.016),  # s
    "encoder_offset": (0.01, 0.025, 0.06),  # rad
    "payload": (0.03, 0.1, 0.3),  # kg at the last link
    "voltage_saturation": (0.8, 0.6, 0.4),  # share of the largest torque
    "dead_band": (0.003, 0.008, 0.02),  # rad
}
MORE = {  # effects of torque level that act on joints; three sizes each
    "torque_ripple": (0.05, 0.12, 0.3),  # N m, 13.7 times a turn and .9 rad late
    "gravity_tilt": (0.01, 0.03, 0.08),  # rad, about x; half of it about y
    "coupled_transmission": (0.3, 0.6, 1.0),  # of a joint's armature, damping and friction, by a tendon to the next one
    "link_inertia": (0.015, 0.03, 0.06),  # m by which the link's centre of mass lies further out
}
ORDER, PHASE = 13.7, 0.9
DETENT = (0.1, 0.25, 0.6)  # N m: no effect of the library's
DT, EVERY, SECONDS, NOISE = 0.002, 5, 12.0, 2e-4
KP, KV = (60.0, 60.0, 50.0, 20.0, 15.0, 8.0), (1.0, 1.0, 0.8, 0.3, 0.2, 0.1)
MASS, LENGTH = (1.0, 0.8, 0.6, 0.35, 0.25, 0.12), (0.06, 0.25, 0.22, 0.08, 0.08, 0.05)
AXIS = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1", "1 0 0")
ARMATURE, DAMPING, FRICTION = (
    (0.03, 0.03, 0.025, 0.01, 0.008, 0.004),
    (0.4, 0.4, 0.3, 0.1, 0.08, 0.04),
    (0.3, 0.3, 0.2, 0.08, 0.06, 0.03),
)
MIDDLE = (0.0, 0.9, 0.5, 0.3, 0.0, 0.0)  # rad, about which the joints are moved
NAMES = ("pan", "lift", "elbow", "flex", "roll", "jaw")


def model_text(
    scale: float = 1.0, payload: float = 0.0, spring: int = -1, tilt: float = 0.0,
    coupled: tuple[int, float] = (0, 0.0), holds: bool = False, moved: tuple[int, float] = (0, 0.0),
) -> str:  # fmt: skip
    """The arm as an MJCF file; `spring`: a hinge between motor and link of that joint; `holds`: its friction is stiff."""
    held = f' solreffriction="{2 * DT} 1" solimpfriction="0.9999 0.9999"' if holds else ""
    body, drives = "", ""
    for k, name in enumerate(NAMES):
        own = (f'<joint name="{name}" axis="{AXIS[k]}" armature="{scale * ARMATURE[k]:.6g}" damping="{scale * DAMPING[k]:.6g}" '
               f'frictionloss="{scale * FRICTION[k]:.6g}"{held}/>')  # fmt: skip
        mass = MASS[k] + (payload if k == 5 else 0.0)
        half = LENGTH[k] / 2
        size = MASS[k] * LENGTH[k] ** 2 / 12 + 1e-5
        link = f'<inertial pos="{0.01 + (moved[1] if k == moved[0] else 0.0):.6g} 0 {half:.4f}" mass="{mass:.6g}" diaginertia="{size:.6g} {size:.6g} {size / 3 + 1e-6:.6g}"/>'
        place = "0 0 0.05" if k == 0 else f"0 0 {LENGTH[k - 1]:.4f}"
        if k == spring:
            body += f'<body pos="{place}">{own}<inertial pos="0 0 0" mass="1e-4" diaginertia="1e-7 1e-7 1e-7"/><body><joint name="spring" axis="{AXIS[k]}"/>{link}'
        else:
            body += f'<body pos="{place}">{own}{link}'
        drives += f'<position name="{name}" joint="{name}" kp="{KP[k]}" kv="{KV[k]}"/>'
    ends = "</body>" * (6 + (spring >= 0))
    j, share = coupled
    tendon = "" if share == 0 else (f'<tendon><fixed armature="{share * ARMATURE[j]:.6g}" damping="{share * DAMPING[j]:.6g}" frictionloss="{share * FRICTION[j]:.6g}">'
        f'<joint joint="{NAMES[j]}" coef="1"/><joint joint="{NAMES[j + 1]}" coef="1"/></fixed></tendon>')  # fmt: skip
    x, y = np.sin(tilt / 2), -np.sin(tilt)
    pull = f"{9.81 * x:.9g} {9.81 * y:.9g} {-9.81 * np.sqrt(1 - x**2 - y**2):.9g}"
    return (f'<mujoco><compiler angle="radian"/><option timestep="{DT}" integrator="implicitfast" gravity="{pull}"><flag contact="disable"/></option>'
            f"<worldbody>{body}{ends}</worldbody>{tendon}<actuator>{drives}</actuator></mujoco>")  # fmt: skip


def command(seed: int, number: int) -> np.ndarray:
    """Commanded positions (steps, 6), rad: slow and fast waves, and steps; at rest at the beginning."""
    rng = np.random.default_rng([seed, number, 5])
    t = np.arange(round(SECONDS / DT))[:, None] * DT
    slow = 0.35 * np.sin(2 * np.pi * rng.uniform(0.1, 0.3, 6) * t + rng.uniform(0, 6, 6))
    fast = 0.12 * np.sin(2 * np.pi * (0.3 * t + 0.5 * rng.uniform(1.5, 3.0, 6) / SECONDS * t**2) + rng.uniform(0, 6, 6))
    steps = np.repeat(rng.uniform(-0.12, 0.12, (round(SECONDS / 0.5) + 1, 6)), round(0.5 / DT), 0)[: len(t)]
    return np.array(MIDDLE) + (slow + fast + steps) * np.clip(t / 1.0, 0, 1)


def record(
    hidden: Sequence[tuple[str, int, float]], seed: int, number: int, noise: str = "white", holds: bool = False
) -> dict[str, np.ndarray]:
    """`t`, `u`, `q` at 100 Hz of a recording; `hidden`: effect, joint, size."""
    import mujoco

    what = {name: (joint, size) for name, joint, size in hidden}
    sprung = next((what[k][0] for k in ("joint_elasticity", "backlash") if k in what), -1)
    text = model_text(
        payload=what.get("payload", (5, 0.0))[1], spring=sprung, tilt=what.get("gravity_tilt", (0, 0.0))[1],
        coupled=what.get("coupled_transmission", (0, 0.0)), holds=holds, moved=what.get("link_inertia", (0, 0.0)),
    )  # fmt: skip
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    dofs = [model.joint(name).dofadr[0] for name in NAMES]
    u = command(seed, number)
    driven = _late(u, what)
    data.qpos[dofs] = u[0]
    q = np.zeros_like(u)
    largest = np.array(KP) * 0.25
    for k in range(len(u)):
        now, rate = data.qpos[dofs].copy(), data.qvel[dofs].copy()
        q[k] = now
        error = driven[k] - now
        if "dead_band" in what:
            j, band = what["dead_band"]
            error[j] -= np.clip(error[j], -band, band)
        if "voltage_saturation" in what:
            j, share = what["voltage_saturation"]
            error[j] = np.clip(error[j], -share * largest[j] / KP[j], share * largest[j] / KP[j])
        data.ctrl[:] = now + error
        if "stribeck_friction" in what:
            j, more = what["stribeck_friction"]
            model.dof_frictionloss[dofs[j]] = FRICTION[j] * (1 + 4 * more * np.exp(-((rate[j] / 0.2) ** 2)))
        if "load_dependent_friction" in what:
            j, ratio = what["load_dependent_friction"]
            mujoco.mj_forward(model, data)
            load = abs(data.qfrc_actuator[dofs[j]] + data.qfrc_bias[dofs[j]])
            model.dof_frictionloss[dofs[j]] = 0.5 * FRICTION[j] + ratio * load
        if "detent" in what:  # a ball that drops into a notch .2 rad wide, in the middle of the joint's motion
            j, size = what["detent"]
            x = (now[j] - MIDDLE[j]) / 0.1
            data.qfrc_applied[dofs[j]] = -size * x * np.exp(-(x**2) / 2)
        if "torque_ripple" in what:
            j, size = what["torque_ripple"]
            data.qfrc_applied[dofs[j]] = -size * np.sin(ORDER * now[j] + PHASE)
        if sprung >= 0:
            at = model.joint("spring").dofadr[0]
            stiffness = what["joint_elasticity"][1] if "joint_elasticity" in what else 300.0
            width = what["backlash"][1] if "backlash" in what else 0.0
            twist = data.qpos[at]
            data.qfrc_applied[at] = (
                -stiffness * (twist - np.clip(twist, -width / 2, width / 2)) - 0.002 * stiffness * data.qvel[at]
            )
        mujoco.mj_step(model, data)
    assert np.isfinite(q).all() and np.abs(q).max() < 10, "the generator's own simulation is unstable"
    q = q[::EVERY] + _noise(noise, len(q[::EVERY]), np.random.default_rng([seed, number, 9]))
    if "encoder_offset" in what:
        q[:, what["encoder_offset"][0]] += what["encoder_offset"][1]
    if noise == "counts":
        q = np.round(q * 4096 / (2 * np.pi)) * 2 * np.pi / 4096
    return {"t": np.arange(len(q)) * DT * EVERY, "u": np.repeat(u[::EVERY], 1, 0), "q": q}


def _late(u: np.ndarray, what: dict[str, tuple[int, float]]) -> np.ndarray:
    """The command as the drives see it: held for a sample, late where a delay is hidden."""
    held = np.repeat(u[::EVERY], EVERY, 0)[: len(u)]
    if "command_delay" not in what:
        return held
    j, delay = what["command_delay"]
    rows = round(delay / DT)
    late = held.copy()
    late[:, j] = np.concatenate([np.full(rows, held[0, j]), held[: len(held) - rows, j]])
    return late


def _noise(kind: str, rows: int, rng: np.random.Generator) -> np.ndarray:
    white = rng.normal(0, NOISE, (rows, 6))
    if kind != "coloured":
        return white if kind == "white" else np.zeros((rows, 6))
    pole, found = np.exp(-EVERY * DT / 0.02), np.zeros((rows, 6))
    for k in range(1, rows):
        found[k] = pole * found[k - 1] + np.sqrt(1 - pole**2) * white[k]
    return found
