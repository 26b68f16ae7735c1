"""A robot from a file of any format: its rigid bodies, or those with all that the file says of the joints besides.

What URDF and MJCF say beyond rigid bodies becomes effects: armature, damping, dry friction, springs, coupled drives,
compensated gravity, constant forces of the actuators. Their controllers are no part of a robot: the torque of a drive
is what the actuator gives. What no effect stands for is noted, one line each, never dropped in silence.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..effects.base import Effect, place
from ..effects.catalogue import find
from ..effects.extended import ExtendedModel, extend
from ..errors import InputError, check_kind
from ..rigid.model import RobotModel
from .assembly import LARGEST_NUMBER, JointPart, LinkPart, Posture, Root, Welded, impossible_links, welded_bodies
from .compensation import GravityCompensation
from .files import model_format
from .mjcf import (
    actuator_of,
    body_name,
    compile_mjcf,
    compiled_robot,
    disabled,
    engine,
    joint_names,
    load_mjcf,
    mjcf_parts,
)
from .native import place_names
from .urdf import load_urdf, said_twice, urdf_dynamics, urdf_parts
from .usd import load_usd, usd_joints, usd_parts
from .xmlfile import find_in_packages

if TYPE_CHECKING:
    from .config import Baseline, Task

__all__ = ["Loaded", "impossible_said", "load_extended", "load_robot", "read_robot", "stated_baseline", "welded_to"]


class Loaded(NamedTuple):
    """An extended model from a file, and what the file says that it does not hold."""

    model: ExtendedModel
    notes: tuple[str, ...]


def read_robot(
    path: str | Path,
    joints: Sequence[str] | None = None,
    posture: Posture | None = None,
    gravity: Sequence[float] | None = None,
    root: Root | None = None,
    packages: Sequence[str | Path] = (),
    *,
    kinematic: bool = False,
) -> RobotModel:
    """Rigid bodies of the robot in a `.urdf`, `.xml` (MJCF) or `.usd` file: `load_urdf`, `load_mjcf`, `load_usd`.

    `gravity` and `root` None: as the file has them, which for URDF is (0, 0, -9.81) and a fixed root. `kinematic` as
    in `load_urdf`. Raises `InputError` for other files, and as those do.
    """
    form = model_format(path)
    if form == "urdf":
        down = (0.0, 0.0, -9.81) if gravity is None else gravity
        return load_urdf(path, joints, posture, down, root or "fixed", packages, kinematic=kinematic)
    load = load_usd if form == "usd" else load_mjcf
    return load(path, joints, posture, gravity, root, packages, kinematic=kinematic)


def load_extended(
    path: str | Path,
    joints: Sequence[str] | None = None,
    posture: Posture | None = None,
    gravity: Sequence[float] | None = None,
    root: Root | None = None,
    packages: Sequence[str | Path] = (),
) -> Loaded:
    """The robot of a file with the effects that stand for its joints' armature, damping, friction, springs and so on.

    Arguments as in `read_robot`. Effects of mimic joints act at the joint that they follow; those of locked joints do
    no work. `inverse_dynamics` of the model is MuJoCo's `mj_inverse` of the same file, and Pinocchio's `rnea` with the
    URDF's damping and friction.

    >>> import figaroh_jax as fj
    >>> model, notes = fj.load_extended(fj.DEMO)
    >>> model.robot.nv
    4
    """
    form = model_format(path)
    if form == "usd":
        robot = read_robot(path, joints, posture, gravity, root, packages)
        found = _Joints(robot)
        acting, notes = usd_joints(path, packages)
        for name, own in acting.items():
            if width := found.width(name):
                for dof in range(width):
                    found.add(name, dof, rotor=own.armature, damping=(own.damping,), friction=own.friction)
                if own.stiffness and width == 1:
                    found.add(name, spring=(own.stiffness, own.rest))
        return Loaded(extend(robot, *found.effects()), notes)
    if form == "urdf":
        robot = read_robot(path, joints, posture, gravity, root, packages)
        found = _Joints(robot)
        file = find_in_packages(path, packages)
        for name, (damping, friction) in urdf_dynamics(file).items():
            for dof in range(found.width(name)):
                found.add(name, dof, damping=(damping,), friction=friction)
        return Loaded(extend(robot, *found.effects()), said_twice(file))
    file = find_in_packages(path, packages)
    mj = compile_mjcf(file)
    robot = compiled_robot(str(file), mj, joints, posture, gravity, root)
    found = _Joints(robot)
    with np.errstate(all="ignore"):  # `effects` checks what comes of it
        notes = [*_joints(mj, found), *_tendons(mj, found), *_biases(mj, found), *_others(mj, robot)]
    compensated, more = _compensation(mj, robot)
    try:
        return Loaded(extend(robot, *found.effects(), *compensated), (*notes, *more))
    except InputError as error:
        raise InputError(f"{file}: {error}") from None


def load_robot(task: Task, *, kinematic: bool = False) -> RobotModel:
    """The robot of a task, joints locked and ordered as it says; gravity is an MJCF's own where the task gives none.

    `kinematic`: for postures alone, as in `load_urdf`; `impossible_said` tells what was wrong then.

    >>> import figaroh_jax as fj
    >>> fj.load_robot(fj.load_task(fj.DEMO.replace("robot.urdf", "task.yaml"))).nv
    4
    """
    if isinstance(task, str | Path):
        raise InputError(
            f"load_robot takes a task, as load_task reads it, and '{task}' is a path: load_urdf, load_mjcf or load_usd"
            " reads the file of a robot"
        )
    from .config import Task, robot_options

    check_kind("task", task, Task, "`load_task` reads one")
    try:
        model_format(task.robot.model)
    except InputError as error:
        raise InputError(f"{task.file}: robot.model {error}") from None
    return read_robot(task.robot.model, **robot_options(task.robot), kinematic=kinematic)


def impossible_said(path: str | Path, packages: Sequence[str | Path] = ()) -> tuple[str, ...]:
    """A note on each link whose moments of inertia no body can have, in a file that is read for postures alone.

    Postures ask for none: the weight of a link, which bends compliant joints, takes mass and centre of mass alone.
    """
    urdf = model_format(path) == "urdf"
    return tuple(
        f"{Path(path).name}: {line}, which no body can have; postures do not depend on it (a link's weight takes mass"
        f" and centre of mass alone). A calibration's {'robot.urdf keeps it, its ' * urdf}robot.xml has the nearest"
        " that a body can have; tasks of torques refuse the file"
        for line in impossible_links(_parts(find_in_packages(path, packages))[0])
    )


def welded_to(robot: RobotModel, path: str | Path, root: Root | None = None) -> tuple[Welded, ...]:
    """What the file of a robot fixes to its moving links: hands, cameras, covers. Arguments as in `read_robot`."""
    return welded_bodies(robot, _parts(find_in_packages(path, ()), root))


def _parts(file: Path, root: Root | None = None) -> tuple[Sequence[LinkPart], Sequence[JointPart]]:
    """Links and joints that the file of a robot names."""
    form = model_format(file)
    if form == "urdf":
        return urdf_parts(file)[1]
    return usd_parts(file, root) if form == "usd" else mjcf_parts(compile_mjcf(file, kinematic=True), root)[:2]


def stated_baseline(task: Task) -> tuple[Baseline, tuple[str, ...]]:
    """The task's baseline with what its model file says of the joints, and a note on each effect of the file.

    A simulation of the file has its armature, springs and couplings, so none of them is missing; their sizes are fitted
    with the rest of the baseline. What the task switches off itself, and what has a shape or a sign that a baseline
    cannot be told, is left out.
    """
    from .config import BaselineEffect, robot_options

    known, file = task.baseline, task.robot.model
    fitted = {*known.everywhere(), *(entry.effect for entry in known.effects)}
    refused = {name for key, name in known.SWITCHES.items() if key in known.model_fields_set} - fitted
    extended, notes = load_extended(file, **robot_options(task.robot))
    added: dict[tuple[str, tuple[str, ...]], BaselineEffect] = {}
    places: dict[tuple[str, bool], list[str]] = {}
    for effect in extended.effects:
        if effect.name not in fitted:
            at = place_names(extended.robot, effect)
            linear = effect.name not in refused and _fits_linearly(effect)
            places.setdefault((effect.name, linear), []).extend(at)
            if linear:
                added[effect.name, at] = BaselineEffect.model_construct(effect=effect.name, at=at)
    lines = [
        f"{name} ({', '.join(dict.fromkeys(at))}) of the file "
        + ("is part of the baseline: its size is fitted" if linear else f"is not used: {_why(name, refused)}")
        for (name, linear), at in places.items()
    ]
    whole = known.model_copy(update={"effects": (*known.effects, *added.values())})
    return whole, tuple(f"{file.name}: {line}" for line in (*lines, *(f"not read: {note}" for note in notes)))


def _why(name: str, refused: set[str]) -> str:
    return "the task's baseline leaves it out" if name in refused else "a baseline takes no such shape"


def _fits_linearly(effect: Effect) -> bool:
    """Whether a baseline can fit it: all is linear but for a choice that stands at its default."""
    return all(
        p.linear or (p.choice and float(getattr(effect, name)) == p.grid[0]) for name, p in effect.parameters().items()
    )


class _Joints:
    """What acts at each coordinate, summed over the tree joints that share it."""

    def __init__(self, robot: RobotModel) -> None:
        self.robot, self.names = robot, [joint.name for joint in robot.joints]
        self.sums = {name: np.zeros(robot.nv) for name in ("rotor", "friction", "stiffness", "offset", "bias")}
        self.damping, self.couplings = np.zeros((robot.nv, 3)), list[Effect]()

    def width(self, name: str) -> int:
        """Degrees of freedom of a tree joint; 0 for one that does not move."""
        return int((self.robot.dofs.joint == self.names.index(name)).sum()) if name in self.names else 0

    def column(self, name: str, dof: int = 0) -> tuple[int, float, float]:
        """Coordinate of a degree of freedom of a tree joint, its ratio and offset."""
        i = self.names.index(name)
        return self.robot.joints[i].coordinate + dof, float(self.robot.ratio[i]), float(self.robot.offset[i])

    def add(
        self,
        name: str,
        dof: int = 0,
        *,
        rotor: float = 0.0,
        damping: Sequence[float] | np.ndarray = (),
        friction: float = 0.0,
        spring: tuple[float, float] = (0.0, 0.0),
        bias: float = 0.0,
    ) -> None:
        """Add what acts at a tree joint: damping of v, v|v| and v^3, a spring's stiffness and rest, ..."""
        k, r, offset = self.column(name, dof)
        powers = abs(r) ** np.arange(2, 2 + len(damping))
        self.damping[k, : len(damping)] += powers * np.asarray(damping)
        stiffness, rest = spring
        given = (r**2 * rotor, abs(r) * friction, r**2 * stiffness, r * stiffness * (offset - rest), r * bias)
        for total, value in zip(self.sums.values(), given, strict=True):
            total[k] += value

    def _check(self) -> None:
        """Raise `InputError` for what no joint has: numbers that are not finite or huge, and drives that push."""
        names = self.robot.dof_names
        values = {"armature": self.sums["rotor"], "damping": self.damping, "frictionloss": self.sums["friction"]}
        values |= {"stiffness": self.sums["stiffness"], "spring's rest": self.sums["offset"]}
        for what, some in (values | {"constant force": self.sums["bias"]}).items():
            some = some.reshape(len(names), -1)
            wrong = ~(np.abs(some) <= LARGEST_NUMBER)
            if what in ("armature", "frictionloss"):
                wrong |= some < 0
            elif what == "damping":
                wrong[:, 0] |= some[:, 0] < 0
            if wrong.any():
                row, column = np.argwhere(wrong)[0]
                raise InputError(
                    f"joint '{names[row]}': {what} is {some[row, column]:g}; a finite number"
                    f"{' of zero or more' * bool(some[row, column] < 0)} up to {LARGEST_NUMBER:g} is expected"
                )

    def effects(self) -> list[Effect]:
        """One effect for each kind and coordinate that anything acts at."""
        found, s = [], self.sums
        self._check()
        for k, name in enumerate(self.robot.dof_names):
            linear, square, cube = self.damping[k]
            wanted = [
                ("rotor_inertia", {"inertia": s["rotor"][k]}),
                ("viscous_friction", {"damping": linear}),
                ("power_law_friction", {"strength": square, "exponent": 2.0}),
                ("power_law_friction", {"strength": cube, "exponent": 3.0}),
                ("coulomb_friction", {"force": s["friction"][k]}),
                ("joint_spring", {"stiffness": s["stiffness"][k], "offset": s["offset"][k]}),
                ("torque_offset", {"offset": s["bias"][k]}),
            ]
            for effect, values in wanted:
                if next(iter(values.values())):
                    found.append(place(find(effect), self.robot, [name], **values))
        return found + self.couplings


def _joints(mj: Any, found: _Joints) -> list[str]:
    """Armature, damping, dry friction and springs at the joints; what has no effect is returned."""
    notes = []
    for j, name in enumerate(joint_names(mj)):
        width, first = found.width(name), mj.jnt_dofadr[j]
        if not width:
            continue
        rotor, damping = _driven(mj, j, "jnt")
        free, several = width == 6, width > 1
        for dof in range(width):
            d = first + dof
            own = np.array([mj.dof_damping[d], *mj.dof_dampingpoly[d]]) + damping
            own = np.zeros(3) if disabled(mj, "DAMPER") else own
            armature, friction = mj.dof_armature[d] + rotor, mj.dof_frictionloss[d]
            friction = 0.0 if disabled(mj, "FRICTIONLOSS") or disabled(mj, "CONSTRAINT") else friction
            if free and dof < 3 and (armature or friction or own[1:].any()):
                notes.append(f"armature, frictionloss and nonlinear damping along the axes of free joint '{name}'")
                armature, friction, own[1:] = 0.0, 0.0, 0.0
            found.add(name, dof, rotor=armature, damping=own, friction=friction)
        spring = 0.0 if disabled(mj, "SPRING") else mj.jnt_stiffness[j]
        if spring and several:
            notes.append(f"spring of joint '{name}', which turns about more than one axis")
        elif spring:
            found.add(name, spring=(spring, mj.qpos_spring[mj.jnt_qposadr[j]]))
        if mj.jnt_stiffnesspoly[j].any():
            notes.append(f"square and cubic stiffness of joint '{name}'")
        if getattr(mj, "jnt_springyield", np.zeros(mj.njnt))[j]:
            notes.append(f"plastic spring (springyield) of joint '{name}'")
        if several and mj.jnt_limited[j]:
            notes.append(f"range of joint '{name}', which has no position limit of one axis")
    return list(dict.fromkeys(notes))


def _driven(mj: Any, index: int, kind: str) -> tuple[float, np.ndarray]:
    """Armature and damping that an actuator adds at its joint or tendon, through the square of its gear."""
    actuator = actuator_of(mj, index, kind)
    if actuator < 0:
        return 0.0, np.zeros(3)
    gear = mj.actuator_gear[actuator, 0] ** 2
    damping = np.array([mj.actuator_damping[actuator], *mj.actuator_dampingpoly[actuator]])
    return float(gear * mj.actuator_armature[actuator]), gear * damping


def _tendons(mj: Any, found: _Joints) -> list[str]:
    """Fixed tendons over one joint act there, over two alike as their coupled transmission; others are returned."""
    mujoco = engine()
    notes, names = [], joint_names(mj)
    for t in range(mj.ntendon):
        name, at = mj.tendon(t).name or f"number {t}", slice(mj.tendon_adr[t], mj.tendon_adr[t] + mj.tendon_num[t])
        rotor, damping = _driven(mj, t, "tendon")
        rotor, friction = float(rotor + mj.tendon_armature[t]), float(mj.tendon_frictionloss[t])
        damping = damping + np.array([mj.tendon_damping[t], *mj.tendon_dampingpoly[t]])
        if mj.tendon_stiffness[t] or mj.tendon_stiffnesspoly[t].any():
            notes.append(f"spring of tendon '{name}'")
        if mj.tendon_limited[t]:
            notes.append(f"range of tendon '{name}'")
        if not (rotor or friction or damping.any()):
            continue
        coefficients: dict[int, float] = {}
        for joint, coefficient in zip(mj.wrap_objid[at], mj.wrap_prm[at], strict=True):
            if found.width(names[joint]) == 1:
                column, ratio, _ = found.column(names[joint])
                coefficients[column] = coefficients.get(column, 0.0) + coefficient * ratio
        pair = sorted(k for k, coefficient in coefficients.items() if coefficient)
        weights = np.array([coefficients[k] for k in pair])
        straight = all(kind == mujoco.mjtWrap.mjWRAP_JOINT for kind in mj.wrap_type[at])
        alike = len(pair) < 2 or len(pair) == 2 and np.isclose(*np.abs(weights), rtol=1e-12, atol=0)
        if straight and alike and not damping[1:].any():
            _couple(found, pair, weights, (rotor, float(damping[0]), friction))
        else:
            notes.append(
                f"armature, damping, frictionloss of tendon '{name}': not of one or two joints with one weight"
            )
    return notes


def _couple(found: _Joints, pair: list[int], weights: np.ndarray, values: tuple[float, float, float]) -> None:
    """A drive on the weighted sum of one or two joints: rotor, damping and friction, diagonal and shared parts."""
    rotor, damping, friction = values
    for column, weight in zip(pair, weights, strict=True):
        found.sums["rotor"][column] += weight**2 * rotor
        found.damping[column, 0] += weight**2 * damping
        if len(pair) == 1:
            found.sums["friction"][column] += abs(weight) * friction
    if len(pair) == 2:
        names, square = [found.robot.dof_names[k] for k in pair], weights[0] ** 2
        shared = {"inertia": square * rotor, "damping": square * damping, "friction": abs(weights[0]) * friction}
        sign = float(np.sign(weights[0] * weights[1]))
        found.couplings.append(place(find("coupled_transmission"), found.robot, names, sign=sign, **shared))


def _biases(mj: Any, found: _Joints) -> list[str]:
    """Constant force of a motor: what its drive has to give in its place."""
    mujoco = engine()
    names = joint_names(mj)
    for a in range(mj.nu):
        affine = mj.actuator_biastype[a] == mujoco.mjtBias.mjBIAS_AFFINE and not mj.actuator_biasprm[a, 1:3].any()
        at_joint = mj.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT
        if affine and at_joint and found.width(names[mj.actuator_trnid[a, 0]]) == 1:
            force = mj.actuator_biasprm[a, 0] * mj.actuator_gear[a, 0]
            found.add(names[mj.actuator_trnid[a, 0]], bias=-float(force))
    return []


def _compensation(mj: Any, robot: RobotModel) -> tuple[list[Effect], list[str]]:
    """`gravcomp` of the bodies of each link, where they have one of it."""
    if not mj.body_gravcomp.any():
        return [], []
    through_drives = [name for name, flag in zip(joint_names(mj), mj.jnt_actgravcomp, strict=True) if flag]
    if through_drives:
        return [], [f"gravcomp: at {', '.join(through_drives)} it is part of what the drives give (actuatorgravcomp)"]
    carrier = {frame.name: frame.parent for frame in robot.frames}
    found, notes = [], []
    for index, link in enumerate(robot.link_names):
        bodies = [b for b in range(1, mj.nbody) if mj.body_mass[b] and carrier[body_name(mj, b)] == index]
        fractions = {float(mj.body_gravcomp[b]) for b in bodies}
        if len(fractions) > 1:
            notes.append(f"gravcomp of link '{link}', whose welded bodies differ in it")
        elif any(fractions):
            found.append(place(GravityCompensation, robot, [link], fraction=fractions.pop()))
    return found, notes


def _others(mj: Any, robot: RobotModel) -> list[str]:
    notes = []
    if mj.opt.density or mj.opt.viscosity:
        notes.append("forces of the fluid (option density, viscosity)")
    moving = {frame.name for frame in robot.frames if frame.parent >= 0}
    plugins = [body_name(mj, b) for b in range(mj.nbody) if mj.body_plugin[b] >= 0 and body_name(mj, b) in moving]
    return notes + [f"plugin of body '{name}'" for name in plugins]
