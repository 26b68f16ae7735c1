"""Effects of drives, which a command and a position show and a torque that was measured does not.

u: command, q: position; kp, kd: gains of the drive; tau: its torque.
"""

from __future__ import annotations

from .base import JointEffect, Scalar, amplitude, shape
from .loops import HERE, InRollouts
from .registry import register

__all__ = ["ActuatorGain", "ActuatorSaturation", "CommandDelay", "DeadBand", "VoltageSaturation"]


class DriveEffect(JointEffect):
    """What a drive makes of its command."""

    levels = ("rollout",)


@register
class ActuatorGain(DriveEffect):
    """The drive gives more or less torque than its gains say; considered only with `gains: free`."""

    name, title = "actuator_gain", "drive gain"
    equation = "(1 + gain) kp (u - q) - kd v"
    gain: Scalar = amplitude("1")
    in_rollouts = InRollouts(
        (("gain", "scale"),), lambda scale: ((HERE,),), "drive", neutral=1.0, gains_free=True,
        experiment="the same motion of {at} carrying a known mass: else gains and inertias scale together",
    )  # fmt: skip


@register
class CommandDelay(DriveEffect):
    """The drive sees the command late."""

    name, title = "command_delay", "command delay"
    equation = "u(t - delay)"
    delay: Scalar = shape("s", (0.002, 0.012, 0.04), (0.0, 0.15))
    in_rollouts = InRollouts(
        (("delay", "delay"),), lambda scale: ((0.002,), (0.012,), (0.04,)), "drive",
        looks_like="positions that are stamped late by as much look the same",
        experiment="steps of {at} small enough not to saturate its drive",
    )  # fmt: skip


_LIMITS = (0.9, 0.6, 0.3)  # of the largest torque: a limit shows nothing above it


@register
class ActuatorSaturation(DriveEffect):
    """The drive's torque is limited."""

    name, title = "actuator_saturation", "torque limit"
    equation = "clip(tau, -limit, limit)"
    separated_by = "steps of {at} of two sizes, and slow sweeps"
    limit: Scalar = amplitude("N m", lower=0.0)
    in_rollouts = InRollouts(
        (("limit", "force_limit"),), lambda scale: tuple((share * scale.torque,) for share in _LIMITS), "drive",
        limit=True, signed=False,
    )  # fmt: skip


@register
class VoltageSaturation(DriveEffect):
    """The torque is limited before the motor's back-EMF is taken off, so that fast motion gets less."""

    name, title = "voltage_saturation", "voltage limit"
    equation = "clip(kp (u - q), -limit, limit) - kd v"
    separated_by = "steps of {at} of two sizes, and slow sweeps"
    limit: Scalar = amplitude("N m", lower=0.0)
    in_rollouts = InRollouts(
        (("limit", "voltage"),), lambda scale: tuple((share * scale.torque,) for share in _LIMITS), "drive",
        limit=True, signed=False,
    )  # fmt: skip


@register
class DeadBand(DriveEffect):
    """The drive ignores errors within a band, and subtracts the band from larger ones."""

    name, title = "dead_band", "drive dead band"
    equation = "kp (e - clip(e, -band, band)), e = u - q"
    separated_by = "slow ramps of {at} of a few times the band"
    band: Scalar = shape("rad", (0.002, 0.02), (0.0, 0.5))
    in_rollouts = InRollouts((("band", "dead_band"),), lambda scale: ((0.002,), (0.02,)), "drive")
