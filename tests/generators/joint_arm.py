"""An arm of two joints in MuJoCo C that three instruments see: torque sensors, a tracker, encoders behind servos.

The robot differs from its file in what all three share: how the joints are zeroed, the length of the upper arm, a load
at the forearm, friction. It shares no code with the library.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np

ARM = """<mujoco><compiler angle="radian"/><option timestep="0.005" integrator="implicitfast"/><worldbody>
<body name="upper" pos="0 0 0.5" euler="0 {shoulder} 0">
  <joint name="shoulder" axis="0 1 0" damping="{d1}" frictionloss="{f1}" armature="0.03"/>
  <inertial pos="0.15 0 0.01" mass="1.5" diaginertia="0.004 0.012 0.012"/>
  <body name="fore" pos="{length} 0 0" euler="0 {elbow} 0">
    <joint name="elbow" axis="0 1 0" damping="{d2}" frictionloss="{f2}" armature="0.01"/>
    <inertial pos="{x} 0 {z}" mass="{mass}" diaginertia="0.002 {turning} 0.006"/>
    <body name="tip" pos="0.25 0 0"/>
  </body>
</body></worldbody><actuator>
<position name="shoulder" joint="shoulder" kp="80" kv="4"/><position name="elbow" joint="elbow" kp="40" kv="2"/>
</actuator></mujoco>"""
NOMINAL = {"shoulder": 0.0, "elbow": 0.0, "d1": 0.5, "f1": 0.3, "d2": 0.2, "f2": 0.1, "length": 0.3,
           "mass": 0.8, "x": 0.12, "z": 0.0, "turning": 0.006}  # fmt: skip
TRUE = {"shoulder": 0.02, "elbow": -0.03, "d1": 0.8, "f1": 0.6, "d2": 0.35, "f2": 0.25, "length": 0.304,
        "mass": 1.0, "x": 0.14, "z": 0.01, "turning": 0.008}  # fmt: skip
TORQUE_NOISE, TRACKER_NOISE, ENCODER_NOISE = 0.05, 2e-4, 2e-4  # N m; m; rad


class Seen(NamedTuple):
    """What the instruments saw of the true arm: positions (rad) with torques (N m), points (m), commands (rad)."""

    moved: np.ndarray  # at 250 Hz
    torque: np.ndarray
    held: np.ndarray
    point: np.ndarray  # of the tip, in the world
    command: np.ndarray  # at 100 Hz
    followed: np.ndarray


def engine(**numbers: float) -> Any:
    return mujoco.MjModel.from_xml_string(ARM.format(**numbers))  # pyright: ignore[reportAttributeAccessIssue]


def truth() -> dict[str, float]:
    """Hidden numbers by the library's names for them; moments about the elbow's axis."""
    mass, x, z = (TRUE[key] for key in ("mass", "x", "z"))
    return {
        "inertia fore mx": mass * x,
        "inertia fore mz": mass * z,
        "inertia fore Iyy": TRUE["turning"] + mass * (x * x + z * z),
        "viscous_friction shoulder damping": TRUE["d1"],
        "viscous_friction elbow damping": TRUE["d2"],
        "coulomb_friction shoulder force": TRUE["f1"],
        "coulomb_friction elbow force": TRUE["f2"],
        "joint_offset shoulder": TRUE["shoulder"],
        "joint_offset elbow": TRUE["elbow"],
        "link_geometry elbow x": TRUE["length"] - NOMINAL["length"],
    }


def record(seed: int) -> Seen:
    """8 s of a motion, 30 postures, 2 s behind the servos."""
    rng = np.random.default_rng(seed)
    moved, torque = _torques(rng)
    held, point = _postures(rng)
    command, followed = _servos(rng)
    return Seen(moved, torque, held, point, command, followed)


def _torques(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Inverse dynamics in MuJoCo C without friction, friction written out here."""
    model = engine(**TRUE | dict.fromkeys(("d1", "d2", "f1", "f2"), 0.0))
    state, t = mujoco.MjData(model), np.arange(2000)[:, None] / 250  # pyright: ignore[reportAttributeAccessIssue]
    rate, phase = 2 * np.pi * np.array([[0.37, 0.53], [0.71, 0.93]]), rng.uniform(0, 6, (2, 2))
    q, v, a = (
        np.sum([0.4 * w**k * np.sin(w * t + p + k * np.pi / 2) for w, p in zip(rate, phase, strict=True)], axis=0)
        for k in range(3)
    )
    torque = np.zeros_like(q)
    for k in range(len(t)):
        state.qpos[:], state.qvel[:], state.qacc[:] = q[k], v[k], a[k]
        mujoco.mj_inverse(model, state)  # pyright: ignore[reportAttributeAccessIssue]
        torque[k] = state.qfrc_inverse
    torque += [TRUE["d1"], TRUE["d2"]] * v + [TRUE["f1"], TRUE["f2"]] * np.sign(v)
    return q, torque + TORQUE_NOISE * rng.standard_normal(q.shape)


def _postures(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    model = engine(**TRUE)
    state = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
    q, point = rng.uniform(-1.2, 1.2, (30, 2)), np.zeros((30, 3))
    for k in range(len(q)):
        state.qpos[:] = q[k]
        mujoco.mj_kinematics(model, state)  # pyright: ignore[reportAttributeAccessIssue]
        point[k] = state.body("tip").xpos
    return q, point + TRACKER_NOISE * rng.standard_normal(point.shape)


def _servos(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    model = engine(**TRUE)
    state, t = mujoco.MjData(model), 0.01 * np.arange(200)[:, None]  # pyright: ignore[reportAttributeAccessIssue]
    u = 0.5 * np.sin(np.array([3.0, 5.0]) * t) + 0.3 * np.sign(np.sin(np.array([4.0, 2.6]) * t + 0.3))
    q = np.zeros_like(u)
    for k in range(len(u)):
        q[k], state.ctrl[:] = state.qpos, u[k]
        mujoco.mj_step(model, state, 2)  # pyright: ignore[reportAttributeAccessIssue]
    return u, q + ENCODER_NOISE * rng.standard_normal(q.shape)
