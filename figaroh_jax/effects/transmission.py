"""Gears and motors: rotors, couplings, ripple, springs, elasticity and play.

q, v, a: position, velocity and acceleration of the joint; s(v): the smooth sign of its velocity; tau_load: torque of
the rigid body.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..rigid.model import Leaf
from .base import Effect, JointEffect, Motion, Native, Scalar, amplitude, shape
from .loops import HERE, InRollouts
from .registry import register

__all__ = [
    "Backlash",
    "CoupledTransmission",
    "JointElasticity",
    "JointSpring",
    "RotorInertia",
    "TorqueRipple",
]


_ORDERS = tuple(3.0 + 0.8 * k for k in range(30))  # 1/rad
_CROSSING = 0.01  # s that the motor takes to cross the play of its gear


@register
class RotorInertia(JointEffect):
    """Inertia of the motor and gears, seen through the gear ratio (armature)."""

    name, title = "rotor_inertia", "rotor inertia"
    in_every_drive = like_links = True
    reverses = False
    equation = "inertia a"
    separated_by = "fast motion of {at} in several postures of the joints beyond it"
    in_rollouts = InRollouts((("inertia", "armature"),), lambda scale: ((HERE,),), usual=True, signed=False)
    inertia: Scalar = amplitude("kg m2", lower=0.0)

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """inertia a, N m or N; the inertia is seen at the joint: the rotor's own times the square of the gear ratio."""
        return self.inertia * self.here(motion.acceleration)

    def native(self) -> tuple[Native, ...]:
        """`armature` of the joint."""
        return (Native("joint", "armature", float(self.inertia)),)


@register
class CoupledTransmission(Effect):
    """A motor that turns the sum or the difference of two joints: its rotor and its friction act on both."""

    name, title, acts_on = "coupled_transmission", "transmission coupling", "pair"
    equation = "row i: inertia a_j + damping v_j + friction s(v_i + sign v_j); row j: i and j swapped, friction by sign"
    separated_by = "{at} alone, together and against each other"
    in_rollouts = InRollouts(
        (("inertia", "pair_inertia"), ("damping", "pair_damping"), ("friction", "pair_friction")),
        lambda scale: ((0.0, 0.0, 0.0),), "pair", several=True, together=3,
    )  # fmt: skip
    one_rotor = ("inertia", "damping", "friction")
    inertia: Scalar = amplitude("kg m2")
    damping: Scalar = amplitude("N m s/rad")
    friction: Scalar = amplitude("N m")
    sign: Scalar = shape("", (1.0, -1.0), choice=True)

    def torque(self, motion: Motion) -> Float[Array, "samples 2"]:
        """Torque (samples, 2) at both joints, N m.

        The rotor turns with v_i + sign v_j. Its inertia and damping against a joint's own motion count as that
        joint's own; here is what they do at the other joint, and all of the rotor's dry friction.
        """
        v, a = (jnp.take(x, self.places, axis=1, mode="clip") for x in (motion.velocity, motion.acceleration))
        relative = jnp.stack([jnp.ones(()), jnp.asarray(self.sign)])  # of the motor to each joint
        reversal = motion.reversal(v @ relative, a @ relative, jnp.take(motion.width, self.places, mode="clip").mean())
        linear = self.sign * (self.inertia * a[:, ::-1] + self.damping * v[:, ::-1])
        return linear + self.friction * reversal[:, None] * relative

    def native(self) -> tuple[Native, ...]:
        """A tendon over both joints; what it would add to each joint's own motion is taken off there."""
        sign = float(self.sign)
        inertia, damping, friction = float(self.inertia), float(self.damping), float(self.friction)
        return (
            Native("tendon", "armature", inertia, sign),
            Native("tendon", "damping", damping, sign),
            Native("tendon", "frictionloss", friction, sign),
            Native("joint", "armature", -inertia),
            Native("joint", "damping", -damping),
        )


@register
class TorqueRipple(JointEffect):
    """Torque that repeats with the position: cogging, teeth, bearings."""

    name, title = "torque_ripple", "torque ripple"
    reverses = False
    waves = True
    equation = "sine sin(order q) + cosine cos(order q)"
    separated_by = "sweeps of {at} at two constant speeds: the order stays, the frequency moves"
    in_rollouts = InRollouts(
        (("sine", "ripple_sine"), ("cosine", "ripple_cosine"), ("order", "ripple_order")),
        lambda scale: tuple((0.0, 0.0, order) for order in _ORDERS), together=2, shapes=(2,),
    )  # fmt: skip
    sine: Scalar = amplitude("N m")
    cosine: Scalar = amplitude("N m")
    order: Scalar = shape("1/rad", _ORDERS, (2.9, 26.6))

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """sine sin(order q) + cosine cos(order q), N m or N."""
        angle = self.order * self.here(motion.angle)
        return self.sine * jnp.sin(angle) + self.cosine * jnp.cos(angle)

    def shown_by(self, low: Float[np.ndarray, " nv"], high: Float[np.ndarray, " nv"]) -> bool:
        """Whether the motion covers one and a half periods: less could be any smooth function of the position.

        So could one whose order is the lowest of all: a slower one would do better.
        """
        covered = float(self.order) * (high - low)[int(self.at[0])] > 3 * np.pi
        return bool(covered and float(self.order) > type(self).parameters()["order"].lower)


@register
class SecondRipple(TorqueRipple):
    """One more wave at a joint that ripples: another stage of its gear, or twice a turn beside once a turn.

    Told as a `TorqueRipple` of that joint, as the first one is.
    """

    name, title = "second_ripple", "second torque ripple"
    one_more_of = "torque_ripple"
    searched = False  # nor is it anything by itself
    levels = ("torque",)

    def apart_from(self, other: Effect, low: Float[np.ndarray, " nv"], high: Float[np.ndarray, " nv"]) -> bool:
        """Whether the motion covers half a beat of the two: waves of closer orders are one that grows or fades."""
        order = other.order if isinstance(other, TorqueRipple) else 0.0
        return bool(abs(float(self.order) - float(order)) * (high - low)[int(self.at[0])] > np.pi)


@register
class JointSpring(JointEffect):
    """A spring across the joint: a balancer, a cable, a hose."""

    name, title = "joint_spring", "joint spring"
    like_links = True
    contains = ("torque_offset",)
    of_position = True
    reverses = False
    equation = "stiffness (q - rest)"
    separated_by = "motion of {at} over a larger range, or with the base turned"
    in_rollouts = InRollouts(
        (("stiffness", "stiffness"), ("offset", "offset")), lambda scale: ((0.002 * scale.torque, 0.0),), constant=True,
        signed=True,
    )  # fmt: skip
    stiffness: Scalar = amplitude("N m/rad", lower=0.0)
    offset: Scalar = amplitude("N m")  # -stiffness rest: linear, where the rest position is not

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """stiffness q + offset, N m or N."""
        return self.stiffness * self.here(motion.angle) + self.offset

    def physical(self) -> dict[str, Scalar]:
        """Stiffness (N m/rad) and the rest position (rad), which is not finite for a stiffness of zero."""
        return {"stiffness": self.stiffness, "rest": -self.offset / self.stiffness}

    @classmethod
    def units(cls) -> dict[str, str]:
        """Those of `physical`."""
        return {"stiffness": "N m/rad", "rest": "rad"}

    def native(self) -> tuple[Native, ...]:
        """`stiffness` and `springref` of the joint."""
        rest = -float(self.offset) / float(self.stiffness)
        return (Native("joint", "stiffness", float(self.stiffness)), Native("joint", "springref", rest))


@register
class JointElasticity(JointEffect):
    """A gear that winds up under load: the sensor on the motor reads more than the link has turned."""

    name, title, winds_up = "joint_elasticity", "joint elasticity", True
    equation = "q_measured = q + compliance tau_load"
    separated_by = "a chirp of {at} above a third of its resonance, or a sensor on the link side"
    in_rollouts = InRollouts(
        (("stiffness", "stiffness"), ("damping", "damping")), place="spring", elastic=True, signed=False,
        experiment="a chirp of {at} above a third of its resonance, and an encoder on the link",
    )  # fmt: skip
    compliance: Scalar = shape("rad/(N m)", (2e-5, 1e-4, 4e-4, 1.5e-3, 5e-3), (1e-7, 1e-2))

    def position_error(self, motion: Motion) -> Float[Leaf, "samples *joints"]:
        """compliance times the torque of the rigid body at the joint, rad: motor side minus link side."""
        return self.compliance * self.here(motion.load)


@register
class Backlash(JointEffect):
    """Play in the gear: the motor stands ahead of the link by half of it, on the side to which it pushes."""

    name, title, abrupt = "backlash", "backlash", True
    correction = 2.0  # a calibration reports half of the play
    equation = "q_measured = q + width/2 sign(tau_load)"
    separated_by = "slow reversals of the load of {at}, with a second encoder on the link"
    separated_by_postures = "postures of {at} near the vertical, on both sides of it"
    in_rollouts = InRollouts(
        (("stiffness", "stiffness"), ("damping", "damping"), ("width", "play")), place="spring", elastic=True,
        signed=True, contains=("joint_elasticity",), telling=2,
        experiment="steps of {at} of two sizes, and slow sweeps",
    )  # fmt: skip
    width: Scalar = amplitude("rad", lower=0.0, upper=0.05)

    def position_error(self, motion: Motion) -> Float[Leaf, "samples *joints"]:
        """Half of the play on the side of the load, rad; a change of side lasts as long as the motor needs."""
        load = self.here(motion.load)
        space = np if isinstance(load, np.ndarray) else jnp
        if isinstance(motion.dt, float) and motion.dt == 0.0:  # instants that are no record: the play has been crossed
            return self.width / 2 * space.sign(load)
        ramp = abs(motion.rate(load)) * space.maximum(motion.dt, _CROSSING) / 2
        return self.width / 2 * (load / (ramp + 1e-12)).clip(-1.0, 1.0)
