"""The effects of rollouts in words: what each is, what hides it, how to excite it, in which simulators it can be said.

The search itself is `rollouts.causes`; a test compares the names.
"""

from __future__ import annotations

import inspect
from typing import NamedTuple

from ..effects.catalogue import ROLLOUTS

__all__ = ["NOT_LOOKED_FOR", "ROLLOUT_EFFECTS", "RolloutEffect"]


class RolloutEffect(NamedTuple):
    """How the documentation and the pages speak of an effect that a command and a position show."""

    title: str
    meaning: str
    equation: str
    acts_on: str
    parameters: dict[str, str]  # unit of each
    number: str  # of the loop, for a picture of what it does: a name of `rollouts.parameters`
    size: float
    hidden_by: str
    excite: str
    said_by: str  # in the files of simulators


def _said(name: str, number: str, size: float, hidden_by: str, excite: str, said_by: str) -> RolloutEffect:
    """An effect whose class says what it is."""
    effect = ROLLOUTS[name]
    meaning = inspect.cleandoc(effect.__doc__ or "").split("\n\n")[0].replace("\n", " ")
    units = effect.units()
    return RolloutEffect(
        effect.title, meaning, effect.equation, effect.acts_on, units, number, size, hidden_by, excite, said_by
    )  # fmt: skip


_NONE = "no simulator's file: `model/loop.json` holds it, and `figaroh-jax simulate` moves it"
_HELD = "no simulator's file: `model/loop.json` holds it, and `fj.rollout` moves such a loop made in Python"

ROLLOUT_EFFECTS = {
    "joint_damping": RolloutEffect(
        "joint damping", "A torque against the velocity, in proportion to it.", "-damping v", "joint",
        {"damping": "N m s/rad"}, "damping", 0.6,
        "the drive's own velocity gain kd, which does the same: `actuator: {gains: known}` says that kd is right",
        "sweeps of {at} at several constant speeds", "MuJoCo (damping), URDF (damping)",
    ),
    "friction_loss": RolloutEffect(
        "dry friction", "A torque against the motion that does not depend on the speed, and holds the joint at rest.",
        "-force sign(v)", "joint", {"force": "N m"}, "friction", 0.8,
        "a dead band of the drive at slow motion", "slow reversals of {at}, and rest at several loads",
        "MuJoCo (frictionloss), URDF (friction)",
    ),
    "rotor_inertia": RolloutEffect(
        "rotor inertia", "The drive's own inertia, seen through its gear.", "-inertia a", "joint",
        {"inertia": "kg m2"}, "armature", 0.08, "the inertia of the links beyond the joint",
        "fast steps of {at} in several postures of the joints beyond it", "MuJoCo (armature)",
    ),
    "stribeck_friction": RolloutEffect(
        "Stribeck friction", "Dry friction that is larger near standstill.",
        "-force exp(-(v/speed)^2) sign(v)", "joint",
        {"force": "N m", "speed": "rad/s"}, "stribeck_force", 0.8, "dry friction, where the joint is never slow",
        "slow constant-velocity sweeps of {at} below 0.3 rad/s", _NONE,
    ),
    "load_dependent_friction": RolloutEffect(
        "load-dependent friction", "Dry friction in proportion to the torque that the gear carries.",
        "-ratio |tau_gear| sign(v)", "joint", {"ratio": "1"}, "load_ratio", 0.25,
        "dry friction, where the load of the joint is always the same",
        "the same motion of {at} with and without a known payload", _NONE,
    ),
    "joint_spring": RolloutEffect(
        "joint spring", "A torque towards a rest position: a cable, a hose, a balancer.",
        "-stiffness (q - rest)", "joint", {"stiffness": "N m/rad", "rest": "rad"}, "stiffness", 3.0,
        "gravity, where the joint moves a little only",
        "{at} over its whole range, with the base turned if that can be",
        "MuJoCo (stiffness, springref)",
    ),
    "torque_offset": RolloutEffect(
        "constant torque", "A constant torque: a preload, or an offset of the drive.", "-offset", "joint",
        {"offset": "N m"}, "offset", 1.0, "an encoder's offset at a position servo",
        "{at} at several gains of its drive",
        "MuJoCo (a drive's constant bias)",
    ),
    "torque_ripple": _said(
        "torque_ripple", "", 0.0, "motion that covers less than one and a half periods of it",
        "sweeps of {at} over its whole range at two constant speeds", _NONE,
    ),
    "coupled_transmission": _said(
        "coupled_transmission", "", 0.0, "motion in which one of the two joints stands still",
        "{at} alone, together and against each other", "MuJoCo (a fixed tendon's armature, damping, frictionloss)",
    ),
    "gravity_tilt": _said(
        "gravity_tilt", "", 0.0, "encoder offsets, where few joints carry a load",
        "a full turn of the first joint with the arm stretched, or a level on the base", "MuJoCo (option gravity)",
    ),
    "encoder_offset": RolloutEffect(
        "encoder offset", "The encoder reads the position plus a constant.",
        "q_measured = q + offset", "joint",
        {"offset": "rad"}, "reading", 0.05, "a constant torque at a position servo",
        "a reference mark of {at}, or gravity in several postures", _NONE,
    ),
    "actuator_gain": _said(
        "actuator_gain", "scale", 0.6, "all masses and frictions at once: gains and inertias scale together",
        "the same motion with {at} carrying a known mass", "MuJoCo (gainprm, biasprm)",
    ),
    "command_delay": _said(
        "command_delay", "delay", 0.04, "positions that are stamped early",
        "steps of {at} that are small enough not to saturate its drive", _NONE,
    ),
    "actuator_saturation": _said(
        "actuator_saturation", "force_limit", 5.0, "gentle motion, which never asks for as much",
        "steps of {at} of two sizes", "MuJoCo (forcerange), URDF (effort)",
    ),
    "voltage_saturation": _said(
        "voltage_saturation", "voltage", 5.0, "gentle motion, and a limit of the torque where the joint is slow",
        "large steps of {at} in both directions", _NONE,
    ),
    "dead_band": _said(
        "dead_band", "dead_band", 0.05, "dry friction", "slow ramps of {at} of a few times the band", _NONE
    ),
    "payload": RolloutEffect(
        "payload", "A body that the robot carries and the model lacks, or the other way round.",
        "a point mass at the link's centre of mass", "link", {"mass": "kg"}, "payload", 1.0,
        "the gain of the drive: with `gains: free` the two are reported as a pair",
        "the same motion with and without what is fixed to {at}", "MuJoCo, URDF and every simulator: it is an inertia",
    ),
    "link_inertia": RolloutEffect(
        "link inertia", "A link whose mass, centre of mass or inertia is not what the file says; asked after all else.",
        "those of the link's ten numbers that the recordings tell, as a body can have them", "link",
        {"mass": "kg", "mx, my, mz": "kg m", "ixx, ixy, iyy, ixz, iyz, izz": "kg m2"}, "", 0.0,
        "payloads and rotors, where the link turns about nothing that moves", "the same motion with {at} weighed",
        "MuJoCo, URDF and every simulator",
    ),
    "joint_elasticity": RolloutEffect(
        "joint elasticity", "A spring between motor and link; the encoder reads the motor.",
        "tau_link = stiffness (q_motor - q_link)", "joint", {"stiffness": "N m/rad", "damping": "N m s/rad"}, "", 0.0,
        "motion that is slow against the resonance", "a chirp of {at} above a third of its resonance",
        "MuJoCo (a second joint with stiffness and damping)",
    ),
    "backlash": RolloutEffect(
        "backlash", "Play of the gear: the link turns freely within a width.",
        "no torque while |q_motor - q_link| < width/2", "joint",
        {"stiffness": "N m/rad", "damping": "N m s/rad", "width": "rad"}, "", 0.0,
        "elasticity, and dry friction", "slow reversals of the load of {at}", _HELD,
    ),
    "contact_stiffness": RolloutEffect(
        "contact stiffness", "How hard the ground is.", "force = stiffness depth", "pair of bodies",
        {"stiffness": "N/m"}, "", 0.0, "everything but a recording with contacts",
        "landings of two heights", "MuJoCo (solref)",
    ),
    "contact_friction": RolloutEffect(
        "contact friction", "How slippery the ground is.", "|force along| <= friction force across",
        "pair of bodies", {"friction": "1"}, "", 0.0, "everything but a recording with contacts",
        "pushes beyond sliding", "MuJoCo (friction)",
    ),
}  # fmt: skip

NOT_LOOKED_FOR = ("contact_stiffness", "contact_friction")  # names that a task may say; no diagnosis looks for them yet
