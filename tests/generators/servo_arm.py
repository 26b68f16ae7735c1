"""A servo arm of one joint in MuJoCo C with one hidden effect: the seven cases, sharing no code with the library.

Link of 1 kg, its centre of mass 0.3 m below a horizontal axis; armature .05, damping .4, frictionloss .3; position
servo 60 (u - q) - 1 q'; 2 ms, implicitfast, no contacts, at rest hanging. What is read is the state at the instant at
which the command is written; white noise of .2 mrad and 5 mrad/s.
"""

# ruff: noqa: E501 - the robot stands here as lines of XML
from __future__ import annotations

import numpy as np

CASES = (
    "none",
    "stribeck_friction",
    "load_dependent_friction",
    "joint_elasticity",
    "command_delay",
    "encoder_offset",
    "payload",
)
DT, SECONDS = 0.002, 12.0
_OPTION = (
    '<compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option>'
)
_LINK = '<inertial pos="0 0 -.3" mass="{mass}" diaginertia=".01 .01 .001"/>'
_JOINT = '<joint name="joint" axis="0 1 0" armature="{a}" damping="{d}" frictionloss="{f}"/>'
_SERVO = '<actuator><position name="servo" joint="joint" kp="60" kv="1"/></actuator>'


def model_text(armature: float = 0.05, damping: float = 0.4, friction: float = 0.3, mass: float = 1.0) -> str:
    """The arm as an MJCF file."""
    joint = _JOINT.format(a=armature, d=damping, f=friction)
    return f"<mujoco>{_OPTION}<worldbody><body name='link'>{joint}{_LINK.format(mass=mass)}</body></worldbody>{_SERVO}</mujoco>"


def _elastic_text() -> str:
    joint = _JOINT.format(a=0.05, d=0.4, f=0.3)
    motor = '<inertial pos="0 0 0" mass=".05" diaginertia="1e-4 1e-4 1e-4"/>'
    link = f'<body name="link"><joint name="spring" axis="0 1 0" stiffness="180" damping=".1"/>{_LINK.format(mass=1.0)}</body>'
    return f"<mujoco>{_OPTION}<worldbody><body>{joint}{motor}{link}</body></worldbody>{_SERVO}</mujoco>"


def command() -> tuple[np.ndarray, np.ndarray]:
    """Time (s) and commanded position (rad): a chirp to 4 Hz, at half its size after 60 %, beside a slow wave."""
    t = np.arange(round(SECONDS / DT)) * DT
    weight = np.where(t < 0.6 * SECONDS, 1.0, 0.5)
    chirp = 0.6 * np.sin(2 * np.pi * (0.2 * t + 0.5 * (4 - 0.2) / SECONDS * t**2)) * weight
    return t, chirp + 0.4 * np.sin(2 * np.pi * 0.3 * t)


def record(case: str, seed: int) -> dict[str, np.ndarray]:
    """`t`, `u`, `q`, `dq` of a case, with the noise of the seed."""
    import mujoco

    text = _elastic_text() if case == "joint_elasticity" else model_text(mass=1.3 if case == "payload" else 1.0)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    t, u = command()
    driven = np.concatenate([np.full(4, u[0]), u[:-4]]) if case == "command_delay" else u
    q, dq = np.zeros(len(t)), np.zeros(len(t))
    for k in range(len(t)):
        q[k], dq[k] = data.qpos[0], data.qvel[0]
        data.ctrl[0] = driven[k]
        if case == "stribeck_friction":
            model.dof_frictionloss[0] = 0.3 + 0.5 * np.exp(-((data.qvel[0] / 0.25) ** 2))
        if case == "load_dependent_friction":
            mujoco.mj_forward(model, data)
            model.dof_frictionloss[0] = 0.15 + 0.25 * abs(data.qfrc_actuator[0] + data.qfrc_bias[0])
        mujoco.mj_step(model, data)
    rng = np.random.default_rng([seed, CASES.index(case)])
    offset = 0.03 if case == "encoder_offset" else 0.0
    return {
        "t": t,
        "u": u[:, None],
        "q": (q + offset + rng.normal(0, 2e-4, len(t)))[:, None],
        "dq": (dq + rng.normal(0, 5e-3, len(t)))[:, None],
    }
