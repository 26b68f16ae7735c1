"""A robot in MuJoCo C with friction, hidden effects and a tracking controller, written for closed-loop recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np
import pinocchio as pin

from . import robots

Array = np.ndarray
DT = 2e-4  # s, of the simulation
CONTROL = 5  # steps between two commands of the controller
BANDWIDTH = 150.0  # rad/s, of the controller
REVERSAL = 0.005  # rad/s, half width of the reversal of dry friction


@dataclass
class Physics:
    """What acts beside rigid bodies; torques are those the drive has to give (N m), by joint."""

    viscous: Array
    levels: list[Callable[[Array, Array, Array], Array]]  # (q, v, load) -> level of dry friction
    torques: list[Callable[[Array, Array], Array]] = field(default_factory=list)  # (q, v) -> torque
    needs_load: bool = False
    coupling: tuple[float, float] = (0.0, 0.0)  # viscous and dry friction of the coupled motor
    sign: float = 1.0


@dataclass(frozen=True)
class Structure:
    """What the compiled model holds: rotor inertia, a tendon over a pair, springs, tilt."""

    armature: Array
    pair: tuple[int, int, float, float] | None = None  # joints, sign, inertia
    springs: dict[int, tuple[float, float]] = field(default_factory=dict)  # joint: stiffness, rest


def mjcf(model: pin.Model, made: robots.Robot, structure: Structure) -> str:
    """MJCF of the Pinocchio model's chain: bodies, joints, armatures, springs and the tendon of a coupled pair."""
    data = model.createData()
    neutral = pin.neutral(model)
    text = {0: [""]}
    for j in range(1, model.njoints):
        axis = pin.computeJointJacobian(model, data, neutral, j)[:, j - 1]
        turning = not made.prismatic[j - 1]
        kind, direction = ("hinge", axis[3:]) if turning else ("slide", axis[:3])
        stiffness, rest = structure.springs.get(j - 1, (0.0, 0.0))
        joint = (
            f'<joint name="{model.names[j]}" type="{kind}" axis="{_text(direction)}" stiffness="{float(stiffness)!r}" '
        )
        joint += f'springref="{float(rest)!r}" armature="{float(structure.armature[j - 1])!r}"/>'
        text[j] = [_body(model, j) + joint + _inertial(model.inertias[j])]
    for j in range(model.njoints - 1, 0, -1):
        text[model.parents[j]].append("".join(text[j]) + "</body>")
    gravity = _text(model.gravity.linear)
    head = '<mujoco><compiler angle="radian" autolimits="false"/>'
    head += f'<option timestep="{DT}" integrator="implicitfast" gravity="{gravity}"/>'
    return head + f"<worldbody>{''.join(text[0])}</worldbody>{_tendon(model, structure)}</mujoco>"


def _text(vector: Array) -> str:
    return " ".join(repr(float(x)) for x in vector)


def _body(model: pin.Model, j: int) -> str:
    placement = model.jointPlacements[j]
    x, y, z, w = pin.Quaternion(placement.rotation).coeffs()
    return f'<body pos="{_text(placement.translation)}" quat="{_text(np.array([w, x, y, z]))}">'


def _inertial(inertia: pin.Inertia) -> str:
    # MuJoCo wants a body that can exist, which the nominal files' last links are not
    values, axes = np.linalg.eigh(inertia.inertia)
    values = np.maximum(values, 2e-4)
    values[:2] += max(0.0, values[2] - values[0] - values[1])
    i = axes @ np.diag(values) @ axes.T
    six = np.array([i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]])
    return f'<inertial pos="{_text(inertia.lever)}" mass="{float(inertia.mass)!r}" fullinertia="{_text(six)}"/>'


def _tendon(model: pin.Model, structure: Structure) -> str:
    if structure.pair is None:
        return ""
    i, j, sign, inertia = structure.pair
    first, second = (f'<joint joint="{model.names[k + 1]}" coef="{c}"/>' for k, c in ((i, 1.0), (j, sign)))
    return f'<tendon><fixed name="motor" armature="{float(inertia)!r}">{first}{second}</fixed></tendon>'


def inertia_along(model: pin.Model, armature: Array, positions: Array) -> Array:
    """Joint-space inertia with rotors (commands, nv, nv): what a computed-torque controller multiplies errors with."""
    data = model.createData()
    upper = np.array([np.triu(pin.crba(model, data, q)) for q in positions])
    return upper + np.triu(upper, 1).transpose(0, 2, 1) + np.diag(armature)


def track(
    model: mujoco.MjModel, physics: Physics, desired: tuple[Array, Array], forward: Array, inertia: Array
) -> tuple[Array, Array]:
    """Position and drive torque (steps, nv) of a run that follows `desired` (position, velocity), one row a command.

    Computed torque: errors in position and velocity are multiplied by `inertia` (commands, nv, nv).
    """
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = desired[0][0], desired[1][0]
    steps = CONTROL * len(forward)
    q_log, drive_log = np.empty((steps, model.nv)), np.empty((steps, model.nv))
    load, relative = np.zeros(model.nv), np.zeros(2)
    pair = model.tendon_num[0] if model.ntendon else 0
    wrap = [int(model.wrap_objid[k]) for k in range(pair)]
    drive = forward[0]
    for step in range(steps):
        q, v = data.qpos, data.qvel
        if step % CONTROL == 0:
            k = step // CONTROL
            error, slip = desired[0][k] - q, desired[1][k] - v
            drive = forward[k] + inertia[k] @ (BANDWIDTH**2 * error + 2 * BANDWIDTH * slip)
        q_log[step], drive_log[step] = q, drive
        level = sum(law(q, v, load) for law in physics.levels)
        # inside a reversal dry friction is a damper, which the integrator takes implicitly: no chatter
        inside = np.abs(v) < REVERSAL
        model.dof_damping[:] = physics.viscous + np.where(inside, level / REVERSAL, 0.0)
        data.qfrc_applied[:] = drive - np.where(inside, 0.0, level * np.sign(v)) - sum(f(q, v) for f in physics.torques)
        if pair:
            relative[:] = (1.0, physics.sign)
            speed = float(relative @ v[wrap])
            damping, dry = physics.coupling
            model.tendon_damping[:] = damping + (dry / REVERSAL if abs(speed) < REVERSAL else 0.0)
            data.qfrc_applied[wrap] -= relative * (dry * np.sign(speed) if abs(speed) >= REVERSAL else 0.0)
        mujoco.mj_step(model, data)
        if physics.needs_load:
            mujoco.mj_mulM(model, data, load, data.qacc)
            load += data.qfrc_bias
    return q_log, drive_log
