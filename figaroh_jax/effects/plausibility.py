"""Values of a result that no such robot has: masses far from what was trusted, drives beyond the model's own limits."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..rigid.model import RobotModel, prismatic
from .base import Effect
from .extended import ExtendedModel

__all__ = ["implausible"]

SIGMAS = 5.0  # of the stated trust
FACTOR = 1.5  # and at least this much more or less


def implausible(nominal: RobotModel, found: ExtendedModel, trust: float) -> tuple[str, ...]:
    """One note for each value of a result that should not be believed as it stands.

    A link's mass more than five times the stated `trust` (relative one sigma) from the nominal one and 1.5 times off; a
    friction, offset or spring torque above the joint's effort limit; a payload heavier than the robot.
    """
    notes = [*_masses(nominal, found.robot, trust)]
    for effect in found.effects:
        notes += _drive(nominal, effect)
    return tuple(f"implausible: {note}" for note in notes)


def _masses(nominal: RobotModel, robot: RobotModel, trust: float) -> Iterator[str]:
    if nominal.link_names != robot.link_names:
        return
    for name, before, after in zip(nominal.link_names, nominal.inertia[:, 0], robot.inertia[:, 0], strict=True):
        before, after = float(before), float(after)
        off = abs(after - before) > SIGMAS * trust * before
        if before > 0 and off and not before / FACTOR < after < FACTOR * before:
            yield (
                f"the mass of {name} is {after:.3g} kg, where {before:.3g} kg was trusted to {100 * trust:.0f} %"
                f" (robot.trust): {abs(after - before) / (trust * before):.0f} sigma off; check units and signs of the"
                " torque, and whether the motion excites this link"
            )


def _drive(model: RobotModel, effect: Effect) -> Iterator[str]:
    values, units = effect.physical(), effect.units()
    if effect.name == "payload" and float(values.get("mass", 0.0)) > float(np.sum(np.asarray(model.inertia)[:, 0])):
        yield f"payload of {float(values['mass']):.3g} kg: more than the whole robot"
    if effect.acts_on != "joint":
        return
    joint = int(np.ravel(effect.at[0])[0])
    effort, speed = (float(np.asarray(x)[joint]) for x in (model.effort_limit, model.velocity_limit))
    effort = effort if effort > 0 else np.inf
    unit = "N" if prismatic(model)[joint] else "N m"
    for name, value in values.items():
        torque = abs(float(np.ravel(value)[0]))
        said = f"{name} {torque:.3g} {unit} is above"
        if effect.name == "viscous_friction" and 0 < speed < np.inf:
            said = f"{name} {torque:.3g} gives {torque * speed:.3g} {unit} at the speed limit, above"
            torque *= speed
        elif units[name] not in ("N m", "N", "torque"):
            continue
        if torque > effort:
            yield f"{effect.name} at {model.dof_names[joint]}: {said} the model's effort limit of {effort:.3g}"
