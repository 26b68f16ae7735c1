"""The loop of a robot file: an MJCF's own actuators and joints, or a URDF with the drives that a task states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from ..errors import InputError, check_one_of, check_positive, nearest
from ..formats.config import checked_drive
from ..formats.files import model_format
from ..formats.mjcf import actuator_of, compile_mjcf, compiled_robot, disabled, engine, joint_names
from ..formats.robotfile import read_robot, urdf_dynamics
from ..formats.usd import UsdJoint, usd_joints
from ..formats.xmlfile import find_in_packages
from ..recordings.dataset import Commanded, Driven
from ..rigid.manifold import neutral
from ..rigid.model import RobotModel
from .loop import Activation, Drives, Integrator, Joints, Loop, acts_across

__all__ = ["driven_joints", "joint_drives", "load_loop", "plain_joints"]

_INTEGRATORS: dict[int, Integrator] = {0: "euler", 1: "rk4", 3: "implicitfast"}
_SOLREF, _SOLIMP = (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0)  # MuJoCo's defaults


def load_loop(
    path: str | Path,
    drives: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    joints: Sequence[str] | None = None,
    posture: Mapping[str, float] | None = None,
    gravity: Sequence[float] | None = None,
    root: Any = None,
    dt: float | None = None,
    law: str | None = None,
    integrator: Integrator | None = None,
) -> tuple[Loop, tuple[str, ...]]:
    """The loop of a `.urdf`, `.xml` (MJCF) or `.usd` file, and what of the file it does not contain.

    An MJCF's joints, actuators, time step and integrator are taken as MuJoCo compiles them; `drives` replaces its
    actuators (of a stage: the drives of its joints), and states those of a URDF: `{joint: {kind: position, kp: 17.8,
    kd: 0.6, force: 3.35}}`. `law` is "soft" for an MJCF (its `frictionloss`) and "hard" otherwise, unless given.
    "euler" takes damping at the beginning of each step ("explicit") where the MJCF switches `eulerdamp` off. Raises
    `InputError` for actuators that this version does not simulate, with the actuator's name.

    >>> import figaroh_jax as fj
    >>> loop, notes = fj.load_loop(fj.DEMO, {"elbow": {"kind": "position", "kp": 20.0, "kd": 0.5}}, joints=["elbow"])
    >>> loop.drives.names
    ('elbow',)
    """
    if dt is not None:
        check_positive("dt", dt, "s")
    if law is not None:
        check_one_of("law", law, ("soft", "hard"))
    if integrator is not None:
        check_one_of("integrator", integrator, get_args(Integrator))
    form = model_format(path)
    if form != "mjcf":
        robot = read_robot(path, joints, posture, gravity, root)
        own, notes = (_usd_joints if form == "usd" else _urdf_joints)(robot, path), ()
        stated = _usd_drives(robot, path) if form == "usd" and not drives else drives or {}
        actuators, start = joint_drives(robot, stated, path), neutral(robot)
        default = (0.002, integrator or "implicitfast", "hard", bool(np.isfinite(own.limit).any()))
    else:
        file = find_in_packages(path, ())
        mj = compile_mjcf(file)
        robot = compiled_robot(str(file), mj, joints, posture, gravity, root)
        own, notes = _mjcf_joints(mj, robot)
        if drives:
            actuators = joint_drives(robot, drives, path)
        else:
            actuators, idle = _mjcf_drives(mj, robot, str(path))
            notes = (*notes, *(f"actuator '{name}', whose joint stands still" for name in idle))
        start, limited = _start(mj, robot), not disabled(mj, "LIMIT") and bool(np.isfinite(own.limit).any())
        default = (float(mj.opt.timestep), _integrator(mj, path, integrator), "soft", limited)
    step, scheme, friction, limited = default
    loop = Loop(
        robot=robot,
        drives=actuators,
        joints=own,
        start=start,
        dt=np.float64(dt or step),
        integrator=scheme,
        law=law or friction,  # pyright: ignore[reportArgumentType]
        limited=limited,
        measured=tuple(range(robot.nv)),
    )
    return loop, notes


def driven_joints(loop: Loop) -> tuple[Driven, ...]:
    """The joints that have drives, in the robot's order, and what is commanded there."""
    drives, found = loop.drives, list[Driven]()
    way, gain, bias = (np.asarray(x) for x in (drives.transmission, drives.gain, drives.bias))
    for k, joint in enumerate(loop.robot.dof_names):
        own = [d for d in range(len(way)) if np.abs(way[d]).argmax() == k]
        kinds: list[Commanded] = [_command_of(gain[d], bias[d], drives.activation[d]) for d in own]
        alone = len(own) == 1 and np.count_nonzero(way[own[0]]) == 1 and not bias[own[0]].any()
        if own:
            kind = min(kinds, key=("position", "velocity", "torque").index)
            names = tuple(drives.names[d] for d in own)
            found.append(Driven(joint, kind, names, float(way[own[0], k] * gain[own[0], 0]) if alone else None))
    return tuple(found)


def _command_of(gain: np.ndarray, bias: np.ndarray, activation: Activation) -> Commanded:
    if bias[1]:
        return "velocity" if activation == "integrator" else "position"
    return "velocity" if bias[2] and np.isclose(gain[0], -bias[2]) else "torque"


def plain_joints(robot: RobotModel) -> Joints:
    """Joints at which nothing acts."""
    zero = np.zeros(robot.nv)
    free = np.tile([-np.inf, np.inf], (robot.nv, 1))
    names = ("armature", "damping", "friction", "stribeck_force", "load_ratio", "stiffness", "rest", "play", "offset")
    names = (*names, "ripple_sine", "ripple_cosine", "limit_margin", "reading")
    (rate, share), ones = _friction_law(np.array(_SOLREF), np.array(_SOLIMP), 0.0), np.ones(robot.nv)
    return Joints(
        **{name: zero.copy() for name in names},
        stribeck_speed=0.1 * ones,
        ripple_order=ones,
        friction_rate=rate * ones,
        friction_share=share * ones,
        torque_range=free.copy(),
        limit=free,
        limit_solref=np.tile(_SOLREF, (robot.nv, 1)),
        limit_solimp=np.tile(_SOLIMP, (robot.nv, 1)),
    )


def _friction_law(solref: np.ndarray, solimp: np.ndarray, dt: float) -> tuple[float, float]:
    """b and (1 - d)/d of MuJoCo's dry friction: it stands at position 0, where the impedance is the least one."""
    lowest, highest = np.clip(solimp[:2], 1e-4, 0.9999)
    if lowest == highest or solimp[2] <= 1e-15:
        lowest = 0.5 * (lowest + highest)
    rate = 2 / (highest * max(solref[0], 2 * dt)) if solref[0] > 0 else -solref[1] / highest
    return rate, (1 - lowest) / lowest


def _urdf_joints(robot: RobotModel, path: str | Path) -> Joints:
    own = plain_joints(robot)
    for name, (damping, friction) in urdf_dynamics(find_in_packages(path, ())).items():
        for joint in robot.joints:
            if joint.name == name and not joint.follows and joint.kind in ("revolute", "prismatic"):
                own.damping[joint.coordinate], own.friction[joint.coordinate] = damping, friction
    return own


def _usd_joints(robot: RobotModel, path: str | Path) -> Joints:
    own = plain_joints(robot)
    for joint, acting in _driven(robot, path):
        k = joint.coordinate
        own.armature[k], own.damping[k], own.friction[k] = acting.armature, acting.damping, acting.friction
        own.stiffness[k], own.rest[k] = acting.stiffness, acting.rest
    return own


def _usd_drives(robot: RobotModel, path: str | Path) -> dict[str, dict[str, Any]]:
    return {joint.name: acting.drive for joint, acting in _driven(robot, path) if acting.drive is not None}


def _driven(robot: RobotModel, path: str | Path) -> list[tuple[Any, UsdJoint]]:
    """Independent joints of one axis with what a stage says acts there."""
    stated, _ = usd_joints(path)
    single = [joint for joint in robot.joints if not joint.follows and joint.kind in ("revolute", "prismatic")]
    return [(joint, stated[joint.name]) for joint in single if joint.name in stated]


def joint_drives(robot: RobotModel, drives: Mapping[str, Mapping[str, Any]], path: str | Path) -> Drives:
    """One drive for each named joint, in the robot's order; joints without one are passive."""
    for name in drives:
        if name not in robot.joint_names:
            raise InputError(
                f"{path}: actuator.{name}: robot has no moving joint '{name}'{nearest(name, robot.joint_names)}"
            )
    names = [name for name in robot.joint_names if name in drives]
    count = len(names)
    gain, bias, way = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, robot.nv))
    force = np.full(count, np.inf)
    for k, name in enumerate(names):
        drive = checked_drive(drives[name], f"{path}: actuator.{name}")
        kp, kd = float(drive.get("kp") or 0.0), float(drive.get("kd") or 0.0)
        kind = drive.get("kind", "position")
        gain[k, 0] = {"position": kp, "velocity": kd, "torque": 1.0}[kind]
        bias[k, 1], bias[k, 2] = (-kp if kind == "position" else 0.0), (-kd if kind != "torque" else 0.0)
        way[k, robot.joint_index(name)] = 1.0
        force[k] = drive.get("force") or np.inf
    return _drives(tuple(names), way, gain, bias, force_range=np.stack([-force, force], 1))


def _drives(
    names: tuple[str, ...],
    way: np.ndarray,
    gain: np.ndarray,
    bias: np.ndarray,
    *,
    force_range: np.ndarray,
    command_range: np.ndarray | None = None,
    time: np.ndarray | None = None,
    activation_range: np.ndarray | None = None,
    delay: np.ndarray | None = None,
    activation: tuple[Activation, ...] = (),
    early: tuple[bool, ...] = (),
    across: bool = False,
) -> Drives:
    free, zero = np.tile([-np.inf, np.inf], (len(names), 1)), np.zeros(len(names))
    return Drives(
        transmission=way,
        gain=gain,
        bias=bias,
        scale=np.ones(len(names)),
        command_range=free if command_range is None else command_range,
        force_range=force_range,
        voltage=np.full(len(names), np.inf),
        dead_band=zero,
        delay=zero.copy() if delay is None else delay,
        time_constant=np.ones(len(names)) if time is None else time,
        activation_range=free.copy() if activation_range is None else activation_range,
        names=names,
        activation=activation or tuple("none" for _ in names),
        early=early or (False,) * len(names),
        across=across,
    )


def _integrator(mj: Any, path: str | Path, wanted: Integrator | None) -> Integrator:
    kind = int(mj.opt.integrator)
    if kind not in _INTEGRATORS and wanted is None:
        raise InputError(f"{path}: option integrator is implicit; euler, implicitfast and RK4 are simulated")
    scheme = wanted or _INTEGRATORS.get(kind, "implicitfast")
    return "explicit" if scheme == "euler" and disabled(mj, "EULERDAMP") else scheme


def _start(mj: Any, robot: RobotModel) -> np.ndarray:
    start, names = neutral(robot), joint_names(mj)
    for joint, at in zip(robot.joints, robot.dofs.positions, strict=True):
        if joint.name in names and not joint.follows:
            j = names.index(joint.name)
            first = mj.jnt_qposadr[j]
            if joint.kind in ("revolute", "prismatic"):
                start[at] = mj.qpos0[first]
            elif joint.kind == "free":
                start[at] = np.concatenate([mj.qpos0[first : first + 3], np.roll(mj.qpos0[first + 3 : first + 7], -1)])
            elif joint.kind == "spherical":
                start[at] = np.roll(mj.qpos0[first : first + 4], -1)
    return start


def _mjcf_joints(mj: Any, robot: RobotModel) -> tuple[Joints, tuple[str, ...]]:
    own, names, notes = plain_joints(robot), joint_names(mj), list[str]()
    dt = float(mj.opt.timestep)
    for joint in robot.joints:
        j = names.index(joint.name) if joint.name in names else -1
        if j < 0 or joint.follows:
            if j >= 0:
                notes.append(f"what acts at joint '{joint.name}', and the softness by which it follows another one")
            continue
        first = int(mj.jnt_dofadr[j])
        for k in range(len(robot.dofs.column[robot.dofs.joint == robot.joints.index(joint)])):
            _mjcf_dof(mj, own, j, first + k, joint.coordinate + k, dt)
        if joint.kind in ("revolute", "prismatic"):
            _mjcf_joint(mj, own, j, joint.coordinate, notes, joint.name)
            continue
        if mj.jnt_stiffness[j] and not disabled(mj, "SPRING"):
            notes.append(f"the spring of joint '{joint.name}', which has several axes")
        if mj.jnt_limited[j] and not (disabled(mj, "LIMIT") or disabled(mj, "CONSTRAINT")):
            notes.append(f"the limit of joint '{joint.name}', which has several axes")
        if joint.kind == "free" and own.friction[joint.coordinate]:
            notes.append(f"that the dry friction of free joint '{joint.name}' acts along the world's axes, not its own")
    return own, (*notes, *_left_out(mj))


def _mjcf_dof(mj: Any, own: Joints, j: int, dof: int, k: int, dt: float) -> None:
    actuator = actuator_of(mj, j, "jnt")
    gear = 0.0 if actuator < 0 else float(mj.actuator_gear[actuator, 0]) ** 2
    own.armature[k] = mj.dof_armature[dof] + (gear * mj.actuator_armature[actuator] if gear else 0.0)
    if not disabled(mj, "DAMPER"):
        own.damping[k] = mj.dof_damping[dof] + (gear * mj.actuator_damping[actuator] if gear else 0.0)
    if not (disabled(mj, "FRICTIONLOSS") or disabled(mj, "CONSTRAINT")):
        own.friction[k] = mj.dof_frictionloss[dof]
    rate, share = _friction_law(mj.dof_solref[dof], mj.dof_solimp[dof], dt)
    own.friction_rate[k], own.friction_share[k] = rate, share


def _mjcf_joint(mj: Any, own: Joints, j: int, k: int, notes: list[str], name: str) -> None:
    if not disabled(mj, "SPRING"):
        own.stiffness[k], own.rest[k] = mj.jnt_stiffness[j], mj.qpos_spring[mj.jnt_qposadr[j]]
    if mj.jnt_stiffnesspoly[j].any() or mj.dof_dampingpoly[mj.jnt_dofadr[j]].any():
        notes.append(f"square and cubic stiffness and damping of joint '{name}'")
    if mj.jnt_actfrclimited[j]:
        own.torque_range[k] = mj.jnt_actfrcrange[j]
    if mj.jnt_limited[j] and not disabled(mj, "LIMIT") and not disabled(mj, "CONSTRAINT"):
        own.limit[k], own.limit_margin[k] = mj.jnt_range[j], mj.jnt_margin[j]
        own.limit_solref[k] = mj.jnt_solref[j]
        own.limit_solimp[k] = mj.jnt_solimp[j]
        own.limit_solimp[k, :2] = np.clip(own.limit_solimp[k, :2], 1e-4, 0.9999)


def _left_out(mj: Any) -> list[str]:
    notes = []
    scheme = _INTEGRATORS.get(int(mj.opt.integrator))
    if scheme == "rk4" and hasattr(mj, "actuator_delay") and mj.actuator_delay.any():
        notes.append("what a late command does between the stages of RK4")
    if disabled(mj, "REFSAFE") and _stiff(mj):
        notes.append("constraints stiffer than two time steps (option flag refsafe is disabled)")
    if mj.opt.density or mj.opt.viscosity:
        notes.append("forces of the fluid (option density, viscosity)")
    if mj.body_gravcomp.any():
        notes.append("gravcomp of bodies")
    if any(getattr(mj, f"tendon_{word}").any() for word in ("stiffness", "damping", "frictionloss", "armature")):
        notes.append("stiffness, damping, friction and armature of tendons")
    if (mj.tendon_limited.any() and not disabled(mj, "LIMIT")) or mj.tendon_actfrclimited.any():
        notes.append("limits of tendons")
    if not disabled(mj, "CONTACT") and (mj.geom_contype.any() or mj.geom_conaffinity.any()):
        notes.append("contacts of geoms")
    return notes


def _stiff(mj: Any) -> bool:
    """Whether dry friction or a limit is stiffer than MuJoCo takes it while `refsafe` is on."""
    softness = np.concatenate([mj.dof_solref[:, 0][mj.dof_frictionloss > 0], mj.jnt_solref[:, 0][mj.jnt_limited > 0]])
    return bool(((softness > 0) & (softness < 2 * mj.opt.timestep)).any())


def _mjcf_drives(mj: Any, robot: RobotModel, path: str) -> tuple[Drives, list[str]]:
    """The actuators that act at joints that move, and the names of those whose joints all stand still."""
    every = tuple(mj.actuator(a).name or f"actuator {a}" for a in range(mj.nu))
    if mj.nu and disabled(mj, "ACTUATION"):
        raise InputError(f"{path}: option flag actuation is disabled: no actuator acts; enable it")
    rows = [_transmission(mj, robot, a, path, every[a]) for a in range(mj.nu)]
    on = [a for a, row in enumerate(rows) if row is not None]
    way = np.array([row for row in rows if row is not None]).reshape(len(on), robot.nv)
    kinds: tuple[Activation, ...] = tuple(_activation(mj, a, path, every[a]) for a in on)
    gain, bias = mj.actuator_gainprm[:, :3].copy(), mj.actuator_biasprm[:, :3].copy()
    for a in on:
        _refuse_laws(mj, a, path, every[a])
        gain[a, 1:] *= int(mj.actuator_gaintype[a]) == int(engine().mjtGain.mjGAIN_AFFINE)
        bias[a] *= int(mj.actuator_biastype[a]) == int(engine().mjtBias.mjBIAS_AFFINE)
    limited = mj.actuator_ctrllimited & (not disabled(mj, "CLAMPCTRL"))
    drives = _drives(
        tuple(every[a] for a in on),
        way,
        gain[on],
        bias[on],
        force_range=_range(mj.actuator_forcelimited, mj.actuator_forcerange)[on],
        command_range=_range(limited, mj.actuator_ctrlrange)[on],
        time=mj.actuator_dynprm[on, 0].copy(),
        activation_range=_range(mj.actuator_actlimited, mj.actuator_actrange)[on],
        delay=_delays(mj, path, every)[on],
        activation=kinds,
        early=tuple(bool(mj.actuator_actearly[a]) for a in on),
        across=acts_across(robot, way),
    )
    return drives, [name for a, name in enumerate(every) if a not in on]


def _delays(mj: Any, path: str, names: Sequence[str]) -> np.ndarray:
    """Delay of each actuator as its command is late in whole steps, or in parts of one where it is interpolated."""
    if not hasattr(mj, "actuator_delay"):
        return np.zeros(mj.nu)
    found, dt = np.array(mj.actuator_delay, float), float(mj.opt.timestep)
    for a in np.flatnonzero(found > 0):
        kind = int(mj.actuator_history[a, 1])
        if kind > 1:
            raise InputError(f"{path}: actuator '{names[int(a)]}': interp is cubic; zoh and linear are simulated")
        found[a] = max(float(found[a]), dt)  # what is commanded in a step is not yet seen in it
        if kind == 0:  # the command of the last step that is not later
            found[a] = np.ceil(found[a] / dt - 1e-6) * dt
    return found


def _range(limited: np.ndarray, limits: np.ndarray) -> np.ndarray:
    return np.where(np.asarray(limited, bool)[:, None], limits, [-np.inf, np.inf])


def _activation(mj: Any, a: int, path: str, name: str) -> Activation:
    kinds = engine().mjtDyn
    known: dict[int, Activation] = {
        int(kinds.mjDYN_NONE): "none",
        int(kinds.mjDYN_INTEGRATOR): "integrator",
        int(kinds.mjDYN_FILTER): "filter",
        int(kinds.mjDYN_FILTEREXACT): "filterexact",
    }
    if int(mj.actuator_dyntype[a]) not in known:
        raise InputError(f"{path}: actuator '{name}': its dyntype is not simulated; known: {', '.join(known.values())}")
    return known[int(mj.actuator_dyntype[a])]


def _refuse_laws(mj: Any, a: int, path: str, name: str) -> None:
    mujoco = engine()
    gains = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
    biases = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
    if int(mj.actuator_gaintype[a]) not in gains or int(mj.actuator_biastype[a]) not in biases:
        raise InputError(f"{path}: actuator '{name}' has gains that are not affine (muscle, dcmotor or user's)")


def _transmission(mj: Any, robot: RobotModel, a: int, path: str, name: str) -> np.ndarray | None:
    """Row of the transmission of an actuator, gear included; None where none of its joints moves."""
    mujoco, row, names = engine(), np.zeros(robot.nv), joint_names(mj)
    kind, target, gear = int(mj.actuator_trntype[a]), int(mj.actuator_trnid[a, 0]), float(mj.actuator_gear[a, 0])
    places = {joint.name: joint for joint in robot.joints}
    if kind in (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
        parts = {names[target]: gear}
    elif kind == int(mujoco.mjtTrn.mjTRN_TENDON) and _fixed(mj, target):
        at = range(mj.tendon_adr[target], mj.tendon_adr[target] + mj.tendon_num[target])
        parts = {names[mj.wrap_objid[k]]: gear * float(mj.wrap_prm[k]) for k in at}
    else:
        raise InputError(f"{path}: actuator '{name}' acts on no joint and no fixed tendon; only these are simulated")
    for joint, share in parts.items():
        if joint in places and places[joint].kind in ("revolute", "prismatic"):
            tree = robot.joints.index(places[joint])
            row[places[joint].coordinate] += share * float(robot.ratio[tree])
        elif joint in places:
            raise InputError(f"{path}: actuator '{name}' drives joint '{joint}', which has several axes")
    return row if parts.keys() & places.keys() else None


def _fixed(mj: Any, tendon: int) -> bool:
    return int(mj.wrap_type[mj.tendon_adr[tendon]]) == int(engine().mjtWrap.mjWRAP_JOINT)
