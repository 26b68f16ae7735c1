"""Which effects a model format carries by itself, and as what: the drives that URDF and MJCF can write.

URDF knows a joint's viscous and dry friction. MJCF also knows armature, springs, tendons between joints, constant
actuator bias and compensated gravity. Both carry what changes the robot; gravity is in MJCF alone. Neither takes a
negative armature, damping or dry friction, so an effect that would leave one is not carried. A joint of several
degrees of freedom has one value of each in a file, so its effects are carried where they are the same about all axes.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect, Native
from ..effects.extended import ExtendedModel
from ..rigid.inertia import from_com, from_pseudo_inertia, is_physical, pseudo_inertia, to_com
from ..rigid.model import DOF_NAMES, RobotModel

__all__ = ["Carried", "Drives", "Tendon", "carried", "changed_leaves", "drives", "physical_inertia", "place_names"]

Format = Literal["urdf", "mjcf"]

_JOINT = {
    "urdf": ("damping", "frictionloss"),
    "mjcf": ("armature", "damping", "damping2", "damping3", "frictionloss", "stiffness", "springref"),
}
_WHOLE: dict[str, dict[str, tuple[str, ...]]] = {  # what a joint of several degrees of freedom has one value of
    "urdf": {"free": ("damping", "frictionloss"), "planar": ("damping", "frictionloss")},
    "mjcf": {
        "spherical": ("armature", "damping", "damping2", "damping3", "frictionloss"),
        "free": ("damping",),
        "planar": ("damping",),
    },
}
_NOT_NEGATIVE = ("armature", "damping", "frictionloss", "stiffness")
_SENSORS = {"position_error": "position sensor", "torque_response": "torque sensor"}
_SMALLEST = 1e-12  # kg, kg m^2: least eigenvalue of a moving body's pseudo-inertia; MuJoCo refuses massless bodies


class Tendon(NamedTuple):
    """Fixed tendon over two joints, with coefficients 1 and `sign`."""

    at: tuple[int, int]
    sign: float
    armature: float
    damping: float
    frictionloss: float


class Drives(NamedTuple):
    """What a format writes at the joints, one value a coordinate."""

    armature: Float[np.ndarray, " nv"]
    damping: Float[np.ndarray, " nv"]
    damping2: Float[np.ndarray, " nv"]  # of v |v|
    damping3: Float[np.ndarray, " nv"]  # of v^3
    frictionloss: Float[np.ndarray, " nv"]
    stiffness: Float[np.ndarray, " nv"]
    springref: Float[np.ndarray, " nv"]  # rad or m
    gravcomp: Float[np.ndarray, " nj"]  # fraction of each link's weight that is compensated
    bias: Float[np.ndarray, " nv"]  # torque that the drive gives for nothing, N m or N
    tendons: tuple[Tendon, ...]


class Carried(NamedTuple):
    """Whether a format carries an effect, and why not."""

    yes: bool
    why: str = ""


def place_names(robot: RobotModel, effect: Effect) -> tuple[str, ...]:
    """Names of the joints or the link where the effect acts."""
    names = robot.link_names if effect.acts_on == "link" else robot.dof_names
    return tuple(names[int(index)] for index in np.ravel(np.asarray(effect.at)))


def changed_leaves(before: RobotModel, after: RobotModel) -> tuple[str, ...]:
    """Names of the robot's arrays that differ."""
    leaves = ("placement", "axis", "inertia", "ratio", "offset", "gravity", "frame_placement")
    pairs = ((np.asarray(getattr(model, leaf)) for model in (before, after)) for leaf in leaves)
    return tuple(leaf for leaf, (a, b) in zip(leaves, pairs, strict=True) if not np.array_equal(a, b))


def carried(extended: ExtendedModel, form: Format) -> tuple[Carried, ...]:
    """For each effect whether the format carries all of it."""
    robot, answers = extended.robot, []
    for effect in extended.effects:
        after = effect.change(robot)
        answers.append(_alone(effect, changed_leaves(robot, after), form))
        robot = after
    while (refused := _negative(extended, tuple(answers)) or _uneven(extended, tuple(answers), form)) is not None:
        index, why = refused
        answers[index] = Carried(False, why)
    return tuple(answers)


def _alone(effect: Effect, leaves: tuple[str, ...], form: Format) -> Carried:
    for sensor, where in _SENSORS.items():
        if effect.has(sensor):
            return Carried(False, f"no element for what the {where} reads")
    if form == "urdf" and "gravity" in leaves:
        return Carried(False, "URDF has no gravity")
    if not effect.has("torque"):
        return Carried(True)
    elements = _native(effect)
    if not elements:
        return Carried(False, "no native element")
    for element in elements:
        if not _known(element, form):
            return Carried(False, f"no element for the {element.attribute} of the {element.element}")
        if not np.isfinite(element.value):
            return Carried(False, f"{element.attribute} would be {element.value}")
    return Carried(True)


def _native(effect: Effect) -> tuple[Native, ...]:
    try:
        return effect.native() if effect.has("torque") else ()
    except ZeroDivisionError:  # a parameter that the format knows only as a ratio, e.g. the rest of a spring of zero
        return ()


def _known(element: Native, form: Format) -> bool:
    if element.element == "joint":
        return element.attribute in _JOINT[form]
    if form == "urdf":
        return False
    if element.element == "body":
        return element.attribute == "gravcomp"
    return element.attribute in ("armature", "damping", "frictionloss", "bias")


def drives(extended: ExtendedModel, answers: tuple[Carried, ...]) -> Drives:
    """The elements of all effects that are carried, summed at each joint."""
    sums = {name: np.zeros(extended.robot.nv) for name in (*_JOINT["mjcf"], "bias")}
    sums["gravcomp"] = np.zeros(len(extended.robot.joints))
    tendons = []
    for effect, answer in zip(extended.effects, answers, strict=True):
        if not answer.yes:
            continue
        at, elements = np.ravel(np.asarray(effect.at)).astype(int), _native(effect)
        of_joints = {e.attribute: e.value for e in elements if e.element != "tendon"}
        # the torques of springs add, not their rests
        if "springref" in of_joints:
            of_joints["springref"] *= of_joints.get("stiffness", 0.0)
        for attribute, value in of_joints.items():
            sums[attribute][at] += value
        tendon = {e.attribute: e for e in elements if e.element == "tendon"}
        if tendon:
            sign = next(iter(tendon.values())).sign
            values = [tendon[name].value if name in tendon else 0.0 for name in ("armature", "damping", "frictionloss")]
            tendons.append(Tendon((int(at[0]), int(at[1])), sign, *values))
    stiff = sums["stiffness"]
    sums["springref"] = np.divide(sums["springref"], stiff, out=np.zeros_like(stiff), where=stiff != 0)
    return Drives(**sums, tendons=tuple(tendons))


def _negative(extended: ExtendedModel, answers: tuple[Carried, ...]) -> tuple[int, str] | None:
    """An effect that leaves a negative value, with what it leaves; the largest offender where several do."""
    total = drives(extended, answers)
    for index, effect in enumerate(extended.effects):
        for element in _native(effect) if answers[index].yes else ():
            if element.element == "tendon" and element.value < 0:
                return index, f"{element.attribute} of the tendon would be {element.value:.4g}, below zero"
    for attribute in _NOT_NEGATIVE:
        sums = getattr(total, attribute)
        for joint in map(int, np.flatnonzero(sums < 0)):
            pairs = zip(extended.effects, answers, strict=True)
            parts = [_part(effect, attribute, joint) if answer.yes else 0.0 for effect, answer in pairs]
            name = extended.robot.dof_names[joint]
            return int(np.argmin(parts)), f"{attribute} of {name} would be {sums[joint]:.4g}, below zero"
    return None


def _uneven(extended: ExtendedModel, answers: tuple[Carried, ...], form: Format) -> tuple[int, str] | None:
    """An effect at a joint of several degrees of freedom that has no one value for all of them."""
    total, robot = drives(extended, answers), extended.robot
    for joint in robot.joints:
        columns = np.arange(joint.coordinate, joint.coordinate + len(DOF_NAMES[joint.kind]))
        for attribute in (*_JOINT["mjcf"], "bias") if len(columns) > 1 else ():
            values = getattr(total, attribute)[columns]
            if not values.any() or attribute in _WHOLE[form].get(joint.kind, ()) and np.ptp(values) == 0:
                continue
            for index, (effect, answer) in enumerate(zip(extended.effects, answers, strict=True)):
                if answer.yes and any(_part(effect, attribute, int(column)) for column in columns):
                    return index, f"no element for the {attribute} of one axis of the {joint.kind} joint {joint.name}"
        for index, (effect, answer) in enumerate(zip(extended.effects, answers, strict=True)):
            if answer.yes and len(columns) > 1 and effect.acts_on == "pair" and np.isin(effect.at, columns).any():
                return index, f"no tendon for an axis of the {joint.kind} joint {joint.name}"
    return None


def _part(effect: Effect, attribute: str, joint: int) -> float:
    if effect.acts_on not in ("joint", "pair") or joint not in np.ravel(np.asarray(effect.at)):
        return 0.0
    return float(
        sum(e.value for e in _native(effect) if e.element in ("joint", "actuator") and e.attribute == attribute)
    )


def physical_inertia(parameters: Float[np.ndarray, "10"], form: Format) -> tuple[Float[np.ndarray, "10"], str]:
    """The link's ten parameters as the format can hold them, and what had to be changed (empty: nothing).

    URDF takes any mass above zero with a non-negative inertia about the centre of mass; MuJoCo wants a body that can
    exist. Where it cannot, mass and centre of mass are kept and the second moments about it made positive definite.
    """
    parameters = np.asarray(parameters, float)
    massless = not parameters.any()
    mass, _, inertia = to_com(parameters)
    if form == "urdf" and (massless or (mass > 0 and np.linalg.eigvalsh(inertia)[0] >= 0)):
        return parameters, ""
    mended = _mended(parameters)
    if massless:
        return mended, f"has no mass; {_SMALLEST:g} kg is written"
    if form == "mjcf" and is_physical(parameters):
        return mended, ""
    return (
        mended,
        (
            "has an inertia that is not physically consistent; the nearest consistent one is written,"
            " and torques differ from the fit's"
        ),
    )


def _mended(parameters: Float[np.ndarray, "10"]) -> Float[np.ndarray, "10"]:
    mass, com, inertia = to_com(parameters)
    wanted = pseudo_inertia(parameters)
    nearest = _positive(wanted)
    if mass > 0:
        about_com = np.zeros((4, 4))
        about_com[:3, :3] = _positive(np.trace(inertia) / 2 * np.eye(3) - inertia)
        kept = from_pseudo_inertia(about_com) + from_com(mass, com, np.zeros((3, 3)))
        # a tiny mass can put its centre far away: then the nearest of all pseudo-inertias does less harm
        if np.linalg.norm(pseudo_inertia(kept) - wanted) <= 3 * np.linalg.norm(nearest - wanted):
            return kept
    return parameters if np.array_equal(nearest, wanted) else from_pseudo_inertia(nearest)


def _positive(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The nearest positive definite matrix, the matrix itself where it is one."""
    values, vectors = np.linalg.eigh(matrix)
    floor = max(_SMALLEST, 1e-12 * values[-1])
    return matrix if values[0] >= floor else vectors * np.maximum(values, floor) @ vectors.T
