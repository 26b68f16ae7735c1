"""Friction: of the speed, of the load, of the position, of time, and of a bristle that bends before it slides.

q, v: position and velocity of the joint; s(v): the smooth sign of its velocity; tau_load: torque of the rigid body.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .base import JointEffect, Motion, Native, Scalar, amplitude, shape
from .loops import HERE, InRollouts
from .registry import register

__all__ = [
    "AsymmetricCoulombFriction",
    "AsymmetricViscousFriction",
    "Bristle",
    "CoulombFriction",
    "DirectionalLoadFriction",
    "FrictionDrift",
    "LoadDependentFriction",
    "LoadDependentStribeckFriction",
    "LuGreFriction",
    "PositionDependentFriction",
    "PowerLawFriction",
    "Presliding",
    "StribeckFriction",
    "ViscousFriction",
]


@register
class ViscousFriction(JointEffect):
    """Friction in proportion to the speed."""

    name, title = "viscous_friction", "viscous friction"
    dissipative = True
    reverses = False
    equation = "damping v"
    separated_by = "constant-speed sweeps of {at} at five or more speeds up to its maximum"
    in_rollouts = InRollouts(
        (("damping", "damping"),), lambda scale: ((HERE,),), called="joint_damping", usual=True, signed=False,
        looks_like="a wrong velocity gain of the drive looks the same",
    )  # fmt: skip
    damping: Scalar = amplitude("N m s/rad")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """damping v, N m or N, positive where the joint moves forwards."""
        return self.damping * self.here(motion.velocity)

    def native(self) -> tuple[Native, ...]:
        """`damping` of the joint, in MJCF and URDF."""
        return (Native("joint", "damping", float(self.damping)),)


@register
class CoulombFriction(JointEffect):
    """Dry friction: a constant level against the motion."""

    name, title = "coulomb_friction", "Coulomb friction"
    dissipative = True
    equation = "force s(v)"
    separated_by = "reversals of {at} at several accelerations"
    in_rollouts = InRollouts(
        (("force", "friction"),), lambda scale: ((HERE,), (scale.friction,)), called="friction_loss", usual=True,
        signed=False,
    )  # fmt: skip
    force: Scalar = amplitude("N m")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """force s(v), N m or N; s is the smooth sign of `Motion.direction`."""
        return self.force * self.here(motion.direction)

    def native(self) -> tuple[Native, ...]:
        """`frictionloss` of the joint in MJCF, `friction` in URDF."""
        return (Native("joint", "frictionloss", float(self.force)),)


@register
class AsymmetricCoulombFriction(JointEffect):
    """Dry friction of another level in each direction; the part that differs."""

    name, title = "asymmetric_coulomb_friction", "direction-dependent Coulomb friction"
    levels = ("torque", "pose")  # in rollouts it acts where a model has it, but is not looked for
    rubs = True
    indistinguishable_from = ("torque_offset",)
    equation = "difference |s(v)|"
    separated_by = "a dwell of {at} with the brake on, and motion in both directions"
    difference: Scalar = amplitude("N m")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """difference |s(v)|, N m or N: half the difference of the two levels, added in both directions."""
        return self.difference * jnp.abs(self.here(motion.direction))


@register
class AsymmetricViscousFriction(JointEffect):
    """Viscous friction of another slope in each direction; the part that differs."""

    name, title = "asymmetric_viscous_friction", "direction-dependent viscous friction"
    levels = ("torque", "pose")  # in rollouts it acts where a model has it, but is not looked for
    rubs = True
    reverses = False
    equation = "difference |v|"
    separated_by = "sweeps of {at} in both directions over its whole range of speed"
    difference: Scalar = amplitude("N m s/rad")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """difference |v|, N m or N: half the difference of the two slopes, added in both directions."""
        return self.difference * jnp.abs(self.here(motion.velocity))


@register
class StribeckFriction(JointEffect):
    """Friction that falls from its breakaway level as the speed rises (Armstrong-Helouvry 1991)."""

    name, title = "stribeck_friction", "Stribeck friction"
    dissipative = speed_law = True
    equation = "force exp(-(|v|/speed)^2) s(v)"
    separated_by = "slow constant-velocity sweeps of {at} at five or more speeds below 0.3 rad/s"
    in_rollouts = InRollouts(
        (("force", "stribeck_force"), ("speed", "stribeck_speed")),
        lambda scale: tuple((0.07 * scale.friction, speed) for speed in (0.1, 0.25, 0.6)),
        signed=True, adds_to="friction_loss", falls_off=1,
        experiment="slow constant-velocity sweeps of {at} below 0.3 rad/s",
    )  # fmt: skip
    force: Scalar = amplitude("N m")
    speed: Scalar = shape("rad/s", (0.03, 0.06, 0.1, 0.15, 0.25, 0.4), (0.012, 0.64))

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """force exp(-(v / speed)^2) s(v), N m or N: what breakaway adds to the Coulomb level."""
        weight = jnp.exp(-((self.here(motion.velocity) / self.speed) ** 2))
        return self.force * weight * self.here(motion.direction)


@register
class PowerLawFriction(JointEffect):
    """Friction that grows with a power of the speed (lubricant, temperature)."""

    name, title = "power_law_friction", "power-law friction"
    levels = ("torque", "pose")  # in rollouts it acts where a model has it, but is not looked for
    rubs = speed_law = bends = True
    equation = "strength |v|^exponent s(v)"
    separated_by = "constant-speed sweeps of {at} from 0.05 rad/s to its maximum speed"
    strength: Scalar = amplitude("N m (s/rad)^exponent")
    exponent: Scalar = shape("", (0.4, 0.6, 1.5, 2.0, 2.5, 3.0), (0.24, 4.0), hole=(0.85, 1.15))

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """strength |v|^exponent s(v), N m or N; |v| is kept above 1e-6 rad/s so that gradients at rest stay finite."""
        speed = jnp.sqrt(self.here(motion.velocity) ** 2 + 1e-12)
        return self.strength * speed**self.exponent * self.here(motion.direction)

    def possible(self) -> bool:
        """Friction that falls from rest is another law's: this one may only bend what viscous friction makes rise."""
        return float(self.strength) >= 0 or float(self.exponent) > 1

    def native(self) -> tuple[Native, ...]:
        """`damping2` or `damping3` of the joint where the exponent is 2 or 3; other exponents have no element."""
        attribute = {2.0: "damping2", 3.0: "damping3"}.get(float(self.exponent))
        return (Native("joint", attribute, float(self.strength)),) if attribute else ()


@register
class LoadDependentFriction(JointEffect):
    """Friction of the gears that grows with the torque they transmit."""

    name, title = "load_dependent_friction", "load-dependent friction"
    follows_torque = dissipative = True
    equation = "ratio |tau_load| s(v)"
    separated_by = "the same motion of {at} with and without a payload"
    in_rollouts = InRollouts(
        (("ratio", "load_ratio"),), lambda scale: ((0.05,),), signed=True, rival_of="friction_loss", rival_start=0.2,
        experiment="the same motion of {at} with and without a known payload",
    )  # fmt: skip
    ratio: Scalar = amplitude("")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """ratio |tau_load| s(v), N m or N; tau_load is the torque of the rigid body at this joint."""
        return self.ratio * jnp.abs(self.here(motion.load)) * self.here(motion.direction)


@register
class PositionDependentFriction(JointEffect):
    """Dry friction that changes over a turn (a bent shaft, a seal, a worn gear)."""

    name, title = "position_dependent_friction", "position-dependent friction"
    levels = ("torque", "pose")  # in rollouts it acts where a model has it, but is not looked for
    rubs = True
    waves = True
    equation = "s(v) (cosine cos q + sine sin q)"
    separated_by = "the same motion of {at} in other postures of the other joints"
    cosine: Scalar = amplitude("N m")
    sine: Scalar = amplitude("N m")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """s(v) (cosine cos q + sine sin q), N m or N; q in rad."""
        q = self.here(motion.angle)
        return self.here(motion.direction) * (self.cosine * jnp.cos(q) + self.sine * jnp.sin(q))


@register
class FrictionDrift(JointEffect):
    """Friction above its later level that falls off as the joint warms up."""

    name, title = "friction_drift", "friction that falls as the joint warms up"
    levels = ("torque", "pose")  # in rollouts it acts where a model has it, but is not looked for
    rubs = True
    beside_rest = False  # a rest that changes in the course of a recording looks like it
    fades = True
    equation = "(force s(v) + damping v) exp(-t/time)"
    separated_by = "the same motion of {at} at the start and again after the robot has warmed up"
    force: Scalar = amplitude("N m")
    damping: Scalar = amplitude("N m s/rad")
    time: Scalar = shape("s", (3.0, 8.0, 20.0, 60.0), (1.0, 600.0))

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """(force s(v) + damping v) exp(-t / time), N m or N; t counts from the beginning of the record, s."""
        level = self.force * self.here(motion.direction) + self.damping * self.here(motion.velocity)
        return level * jnp.exp(-motion.elapsed / self.time)


class Bristle(JointEffect):
    """Dry friction with a state: a bristle that bends before it slides, in units of its sliding deflection."""

    rubs = True
    vanishes = ("distance",)
    force: Scalar = amplitude("N m", lower=0.0)
    # teeth and bearings yield by a hundredth of a radian before they slide; a cable that is dragged along, by tenths
    distance: Scalar = shape("rad", (0.0003, 0.001, 0.003, 0.01, 0.03, 0.08), (2e-5, 0.1))
    memory: Any = eqx.field(default=None, kw_only=True)  # the state, where it is known (`step`)

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """force (z - s(v)), N m or N: the bristle's friction beyond the Coulomb friction that it comes with."""
        bent = self.along(motion) if self.memory is None else self.memory
        return self.force * (bent - self.here(motion.direction))

    def level(self, velocity: Float[Array, "*samples"]) -> Float[Array, "*samples"]:
        """Deflection at which the bristle slides at a speed."""
        return jnp.ones_like(velocity)

    def along(self, motion: Motion) -> Float[Array, " samples"]:
        """The state z along a record; sliding where the instants are none."""
        v = self.here(motion.velocity)
        end, stays = self._turn(v, motion.dt)
        stays = jnp.where(motion.begins, 0.0, stays)

        def follow(z: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            z = now[0] + (z - now[0]) * now[1]
            return z, z

        return jax.lax.scan(follow, jnp.zeros_like(end[0]), (end, stays), unroll=8)[1]

    def step(self, velocity: Float[Array, " nv"], dt: Float[Array, ""]) -> Bristle:
        """The bristle `dt` seconds later at the velocity (nv,), by the exact solution for its deflection z."""
        end, stays = self._turn(velocity[self.at[0]], dt)
        return dataclasses.replace(self, memory=end + (self.memory - end) * stays)

    def _turn(self, v: Float[Array, "*samples"], dt: Any) -> tuple[Array, Array]:
        """Where z goes, and the share of its way that is left after `dt` at a constant velocity: exact."""
        level = self.level(v)
        return jnp.sign(v) * level, jnp.exp(-jnp.abs(v) * dt / (self.distance * level))


@register
class Presliding(Bristle):
    """Dry friction that builds up over a small distance after each reversal (Dahl 1968, exponent 1)."""

    name, title = "presliding", "presliding friction"
    levels = ("torque", "pose")  # in rollouts it acts where a model has it, but is not looked for
    beside_rest = False  # most of any rest stands at reversals, where it acts
    equation = "force (z - s(v)), z' = v/distance (1 - z s(v))"
    separated_by = "reversals of {at} at several accelerations: presliding is late in position, a delay in time"

    def physical(self) -> dict[str, Scalar]:
        """Level (N m), distance of the build-up (rad) and their ratio, the stiffness at a reversal (N m/rad)."""
        force, distance = self.force, self.distance
        return {"force": force, "distance": distance, "stiffness": force / distance}

    @classmethod
    def units(cls) -> dict[str, str]:
        """Those of `physical`."""
        return {"force": "N m", "distance": "rad", "stiffness": "N m/rad"}


@register
class LuGreFriction(Bristle):
    """Dry friction of a bristle whose level falls with the speed (Canudas de Wit et al. 1995), without its damping."""

    name, title = "lugre_friction", "LuGre bristle friction"
    equation = "force (z - s(v)), z' = v/distance (1 - z s(v)/g), g = 1 + rise exp(-(v/speed)^2)"
    separated_by = "slow reversals of {at}, and constant speeds below 0.3 rad/s"
    searched = False  # presliding and Stribeck friction together, which a diagnosis finds one after the other
    rise: Scalar = shape("", (0.1, 0.5), (0.0, 3.0))
    speed: Scalar = shape("rad/s", (0.05, 0.2), (0.012, 0.64))

    def level(self, velocity: Float[Array, "*samples"]) -> Float[Array, "*samples"]:
        """g(v) = 1 + rise exp(-(v / speed)^2), in units of the level at high speed."""
        return 1 + self.rise * jnp.exp(-((velocity / self.speed) ** 2))


@register
class DirectionalLoadFriction(JointEffect):
    """Friction in proportion to the load, of another share where the drive lifts it and where it is driven by it."""

    name, title = "directional_load_friction", "load-dependent friction, driving and driven"
    follows_torque = dissipative = True
    contains = ("load_dependent_friction",)
    equation = "|tau_load| s(v) (driving where tau_load v > 0, driven elsewhere)"
    separated_by = "slow motion of {at} against and with gravity, with and without a payload"
    searched = False  # the second rung of a ladder whose first one is `load_dependent_friction`
    driving: Scalar = amplitude("")
    driven: Scalar = amplitude("")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """|tau_load| s(v) times `driving` where the drive lifts its load (tau_load v > 0), else `driven`, N m or N."""
        load, way = self.here(motion.load), self.here(motion.direction)
        lifts = (1 + jnp.sign(load) * way) / 2
        return jnp.abs(load) * way * (self.driving * lifts + self.driven * (1 - lifts))


@register
class LoadDependentStribeckFriction(JointEffect):
    """Friction in proportion to the load that falls as the speed rises."""

    name, title = "load_dependent_stribeck_friction", "load-dependent Stribeck friction"
    follows_torque = dissipative = True
    equation = "ratio |tau_load| exp(-(|v|/speed)^2) s(v)"
    separated_by = "slow sweeps of {at} below 0.3 rad/s with and without a payload"
    searched = False  # a rung of the same ladder
    ratio: Scalar = amplitude("")
    speed: Scalar = shape("rad/s", (0.03, 0.06, 0.1, 0.15, 0.25, 0.4), (0.012, 0.64))

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """ratio |tau_load| exp(-(v / speed)^2) s(v), N m or N."""
        weight = jnp.exp(-((self.here(motion.velocity) / self.speed) ** 2))
        return self.ratio * jnp.abs(self.here(motion.load)) * weight * self.here(motion.direction)
