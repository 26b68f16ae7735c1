"""The catalogue: every effect that can be named, with its equation, parameters, units and where it acts.

Notation of the equations: q, v, a position, velocity and acceleration of the joint, s(v) the smooth sign of its
velocity, tau_load the torque of the rigid body, tau_hat the torque of the whole model. `register` adds one of yours.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..errors import InputError, nearest
from ..rigid.model import RobotModel
from .base import Effect, Motion, Native, Scalar, amplitude, shape

__all__ = ["CATALOGUE", "find", "register", "related"]

CATALOGUE: dict[str, type[Effect]] = {}
_OTHERS: dict[str, type[Effect]] = {}  # known by name, but nothing that a diagnosis looks for


def register(effect: type[Effect]) -> type[Effect]:
    """Add an effect class to the catalogue under its `name` (usable as a decorator); returns it."""
    if (CATALOGUE | _OTHERS).get(effect.name, effect).__qualname__ != effect.__qualname__:
        raise InputError(f"an effect called '{effect.name}' is registered already")
    (CATALOGUE if effect.searched else _OTHERS)[effect.name] = effect
    return effect


def find(name: str) -> type[Effect]:
    """The effect called `name`; raises `InputError` with the nearest known name."""
    known = CATALOGUE | _OTHERS
    if name not in known:
        raise InputError(f"no effect '{name}' in the catalogue{nearest(name, known)}")
    return known[name]


def related(name: str, relation: str) -> tuple[str, ...]:
    """Effects that stand in a `relation` to one: `indistinguishable_from` or `excludes`, whichever of them states it.

    A tuple of names, sorted, without the name itself; names that are not registered are left out.
    """
    known = CATALOGUE | _OTHERS
    own = getattr(known[name], relation) if name in known else ()
    back = (other for other, effect in known.items() if name in getattr(effect, relation))
    return tuple(sorted({*own, *back} & set(known) - {name}))


class JointEffect(Effect):
    """An effect at one joint."""

    acts_on = "joint"


@register
class ViscousFriction(JointEffect):
    """Friction in proportion to the speed."""

    name, title = "viscous_friction", "viscous friction"
    dissipative = True
    equation = "damping v"
    separated_by = "constant-speed sweeps of {at} at five or more speeds up to its maximum"
    damping: Scalar = amplitude("N m s/rad")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        return self.damping * self.here(motion.velocity)

    def native(self) -> tuple[Native, ...]:
        return (Native("joint", "damping", float(self.damping)),)


@register
class CoulombFriction(JointEffect):
    """Dry friction: a constant level against the motion."""

    name, title = "coulomb_friction", "Coulomb friction"
    dissipative = True
    equation = "force s(v)"
    separated_by = "reversals of {at} at several accelerations"
    force: Scalar = amplitude("N m")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        return self.force * self.here(motion.direction)

    def native(self) -> tuple[Native, ...]:
        return (Native("joint", "frictionloss", float(self.force)),)


@register
class RotorInertia(JointEffect):
    """Inertia of the motor and gears, seen through the gear ratio (armature)."""

    name, title = "rotor_inertia", "rotor inertia"
    equation = "inertia a"
    separated_by = "fast motion of {at} in several postures of the joints beyond it"
    inertia: Scalar = amplitude("kg m2", lower=0.0)

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        return self.inertia * self.here(motion.acceleration)

    def native(self) -> tuple[Native, ...]:
        return (Native("joint", "armature", float(self.inertia)),)


@register
class TorqueOffset(JointEffect):
    """Constant torque: an offset of the sensor, the drive or a preload."""

    name, title = "torque_offset", "torque offset"
    equation = "offset"
    separated_by = "a dwell of {at} with the brake on or the motor unloaded"
    offset: Scalar = amplitude("N m")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        return self.offset * jnp.ones_like(motion.time)

    def native(self) -> tuple[Native, ...]:
        return (Native("actuator", "bias", float(self.offset)),)


@register
class CoupledTransmission(Effect):
    """A motor that turns the sum or the difference of two joints: its rotor and its friction act on both."""

    name, title, acts_on = "coupled_transmission", "coupling of the transmission", "pair"
    equation = "row i: inertia a_j + damping v_j + friction s(v_i + sign v_j); row j: i and j swapped, friction by sign"
    separated_by = "{at} alone, together and against each other"
    inertia: Scalar = amplitude("kg m2")
    damping: Scalar = amplitude("N m s/rad")
    friction: Scalar = amplitude("N m")
    sign: Scalar = shape("", (1.0, -1.0), choice=True)

    def torque(self, motion: Motion) -> Float[Array, "samples 2"]:
        v, a = (jnp.take(x, self.at, axis=1, mode="clip") for x in (motion.velocity, motion.acceleration))
        relative = jnp.stack([jnp.ones(()), jnp.asarray(self.sign)])  # of the motor to each joint
        reversal = motion.reversal(v @ relative, a @ relative, jnp.take(motion.width, self.at, mode="clip").mean())
        linear = self.sign * (self.inertia * a[:, ::-1] + self.damping * v[:, ::-1])
        return linear + self.friction * reversal[:, None] * relative

    def native(self) -> tuple[Native, ...]:
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
class AsymmetricCoulombFriction(JointEffect):
    """Dry friction of another level in each direction; the part that differs."""

    name, title = "asymmetric_coulomb_friction", "Coulomb friction that differs by direction"
    indistinguishable_from = ("torque_offset",)
    equation = "difference |s(v)|"
    separated_by = "a dwell of {at} with the brake on, beside motion in both directions"
    difference: Scalar = amplitude("N m")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        return self.difference * jnp.abs(self.here(motion.direction))


@register
class AsymmetricViscousFriction(JointEffect):
    """Viscous friction of another slope in each direction; the part that differs."""

    name, title = "asymmetric_viscous_friction", "viscous friction that differs by direction"
    equation = "difference |v|"
    separated_by = "sweeps of {at} in both directions over its whole range of speed"
    difference: Scalar = amplitude("N m s/rad")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        return self.difference * jnp.abs(self.here(motion.velocity))


@register
class StribeckFriction(JointEffect):
    """Friction that falls from its breakaway level as the speed rises (Armstrong-Helouvry 1991)."""

    name, title = "stribeck_friction", "Stribeck friction"
    dissipative = speed_law = True
    equation = "force exp(-(|v|/speed)^2) s(v)"
    separated_by = "slow constant-velocity sweeps of {at} at five or more speeds below 0.3 rad/s"
    force: Scalar = amplitude("N m")
    speed: Scalar = shape("rad/s", (0.03, 0.06, 0.1, 0.15, 0.25, 0.4), (0.012, 0.64))

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        weight = jnp.exp(-((self.here(motion.velocity) / self.speed) ** 2))
        return self.force * weight * self.here(motion.direction)


@register
class PowerLawFriction(JointEffect):
    """Friction that grows with a power of the speed (lubricant, temperature)."""

    name, title = "power_law_friction", "friction with a power of the speed"
    speed_law = True
    equation = "strength |v|^exponent s(v)"
    separated_by = "constant-speed sweeps of {at} from 0.05 rad/s to its maximum speed"
    strength: Scalar = amplitude("N m (s/rad)^exponent")
    exponent: Scalar = shape("", (0.4, 0.6, 1.5, 2.0, 2.5, 3.0), (0.24, 4.0), hole=(0.85, 1.15))

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        speed = jnp.sqrt(self.here(motion.velocity) ** 2 + 1e-12)
        return self.strength * speed**self.exponent * self.here(motion.direction)

    def native(self) -> tuple[Native, ...]:
        attribute = {2.0: "damping2", 3.0: "damping3"}.get(float(self.exponent))
        return (Native("joint", attribute, float(self.strength)),) if attribute else ()


@register
class LoadDependentFriction(JointEffect):
    """Friction of the gears that grows with the torque they transmit."""

    name, title = "load_dependent_friction", "friction that grows with the load"
    follows_torque = dissipative = True
    equation = "ratio |tau_load| s(v)"
    separated_by = "the same motion of {at} with and without a payload"
    ratio: Scalar = amplitude("")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        return self.ratio * jnp.abs(self.here(motion.load)) * self.here(motion.direction)


@register
class PositionDependentFriction(JointEffect):
    """Dry friction that changes over a turn (a bent shaft, a seal, a worn gear)."""

    name, title = "position_dependent_friction", "friction that changes with the position"
    equation = "s(v) (cosine cos q + sine sin q)"
    separated_by = "the same motion of {at} in other postures of the other joints"
    cosine: Scalar = amplitude("N m")
    sine: Scalar = amplitude("N m")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        q = self.here(motion.angle)
        return self.here(motion.direction) * (self.cosine * jnp.cos(q) + self.sine * jnp.sin(q))


@register
class TorqueRipple(JointEffect):
    """Torque that repeats with the position: cogging, teeth, bearings."""

    name, title = "torque_ripple", "torque ripple"
    equation = "sine sin(order q) + cosine cos(order q)"
    separated_by = "sweeps of {at} at two constant speeds: the order stays, the frequency moves"
    sine: Scalar = amplitude("N m")
    cosine: Scalar = amplitude("N m")
    order: Scalar = shape("1/rad", tuple(3.0 + 0.8 * k for k in range(30)), (2.9, 26.6))

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        angle = self.order * self.here(motion.angle)
        return self.sine * jnp.sin(angle) + self.cosine * jnp.cos(angle)

    def shown_by(self, low: Float[np.ndarray, " nv"], high: Float[np.ndarray, " nv"]) -> bool:
        # one and a half periods: what has not come back is any smooth function of the position
        return bool(float(self.order) * (high - low)[int(self.at[0])] > 3 * np.pi)


@register
class JointSpring(JointEffect):
    """A spring across the joint: a balancer, a cable, a hose."""

    name, title = "joint_spring", "spring at the joint"
    contains = ("torque_offset",)
    equation = "stiffness (q - rest)"
    separated_by = "motion of {at} over a larger range, or with the base turned"
    stiffness: Scalar = amplitude("N m/rad", lower=0.0)
    offset: Scalar = amplitude("N m")  # -stiffness rest: linear, where the rest position is not

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        return self.stiffness * self.here(motion.angle) + self.offset

    def physical(self) -> dict[str, Scalar]:
        return {"stiffness": self.stiffness, "rest": -self.offset / self.stiffness}

    @classmethod
    def units(cls) -> dict[str, str]:
        return {"stiffness": "N m/rad", "rest": "rad"}

    def native(self) -> tuple[Native, ...]:
        rest = -float(self.offset) / float(self.stiffness)
        return (Native("joint", "stiffness", float(self.stiffness)), Native("joint", "springref", rest))


@register
class GravityTilt(Effect):
    """A base that is not level: gravity in the base frame has a horizontal part."""

    name, title, acts_on = "gravity_tilt", "tilt of the base", "robot"
    equation = "tau(gravity + (x, y, 0)) - tau(gravity)"
    separated_by = "a full turn of the first joint with the arm stretched, or a level on the base"
    x: Scalar = amplitude("m/s2")
    y: Scalar = amplitude("m/s2")

    def change(self, model: RobotModel) -> RobotModel:
        tilted = model.gravity + jnp.stack([jnp.asarray(self.x), jnp.asarray(self.y), jnp.zeros(())])
        return eqx.tree_at(lambda m: m.gravity, model, tilted)

    def physical(self) -> dict[str, Scalar]:
        return {"about_x": -self.y / 9.81, "about_y": self.x / 9.81}

    @classmethod
    def units(cls) -> dict[str, str]:
        return {"about_x": "rad", "about_y": "rad"}


class LinkEffect(Effect):
    """A change of the ten inertial parameters of one link, at and in its joint frame."""

    acts_on = "link"
    inertial = True
    mass: Scalar = amplitude("kg")
    mx: Scalar = amplitude("kg m")
    my: Scalar = amplitude("kg m")
    mz: Scalar = amplitude("kg m")
    ixx: Scalar = amplitude("kg m2")
    ixy: Scalar = amplitude("kg m2")
    iyy: Scalar = amplitude("kg m2")
    ixz: Scalar = amplitude("kg m2")
    iyz: Scalar = amplitude("kg m2")
    izz: Scalar = amplitude("kg m2")

    def ten(self) -> Float[Array, "10"]:
        """The change in Pinocchio's order."""
        return jnp.stack([jnp.asarray(getattr(self, name)) for name in self.parameters()])

    def change(self, model: RobotModel) -> RobotModel:
        return eqx.tree_at(lambda m: m.inertia, model, jnp.asarray(model.inertia).at[self.at[0]].add(self.ten()))


@register
class LinkInertia(LinkEffect):
    """A link whose inertia is not what the model says, further than it is trusted."""

    name, title = "link_inertia", "inertia of a link"
    contains = ("payload",)
    indistinguishable_from = ("payload",)
    needs_trust = 0.05  # ten free parameters of a link make up for many a misfit
    equation = "W_k dpi_k, dpi_k free"
    separated_by = "the same motion with {at} disconnected or weighed"


@register
class Payload(LinkEffect):
    """A body fixed to a link: ten parameters that a physical body can have."""

    name, title = "payload", "a payload"
    body = True
    equation = "W_k dpi_k, dpi_k a physical body: pseudo-inertia >= 0, mass > 0"
    separated_by = "the same motion with and without what is fixed to {at}"

    def physical(self) -> dict[str, Scalar]:
        return {"mass": self.mass} | {f"com_{k}": getattr(self, f"m{k}") / self.mass for k in "xyz"}

    @classmethod
    def units(cls) -> dict[str, str]:
        return {"mass": "kg"} | {f"com_{k}": "m" for k in "xyz"}


@register
class TorqueGain(JointEffect):
    """A wrong torque constant or gear ratio: the reading is off by a factor."""

    name, title = "torque_gain", "wrong torque gain"
    follows_torque = True
    equation = "gain tau_hat"
    separated_by = "the same motion of {at} with and without a payload of known mass"
    gain: Scalar = amplitude("")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        return self.gain * self.here(motion.total)


@register
class TorqueDelay(Effect):
    """Torque that is stamped late against the position."""

    name, title, acts_on = "torque_delay", "delay of the torque", "robot"
    follows_torque = True
    excludes = ("torque_lag",)
    equation = "tau_hat(t - delay) - tau_hat(t)"
    separated_by = "faster motion: a lag weakens high frequencies, a delay does not"
    delay: Scalar = shape("s", (0.001, 0.003, 0.006, 0.012, 0.025), (0.0, 0.06))

    def torque_response(self, omega: Float[Array, " freqs"]) -> Complex[Array, " freqs"]:
        return jnp.exp(-1j * omega * self.delay)


@register
class TorqueLag(Effect):
    """Torque seen through a first-order low pass."""

    name, title, acts_on = "torque_lag", "lag of the torque", "robot"
    follows_torque = True
    equation = "(1/(1 + time p) - 1) tau_hat"
    separated_by = "faster motion: a lag weakens high frequencies, a delay does not"
    time: Scalar = shape("s", (0.001, 0.003, 0.006, 0.012, 0.025), (0.0002, 0.06))

    def torque_response(self, omega: Float[Array, " freqs"]) -> Complex[Array, " freqs"]:
        return 1 / (1 + 1j * omega * self.time)


@register
class JointElasticity(JointEffect):
    """A gear that winds up under load: the sensor on the motor reads more than the link has turned."""

    name, title = "joint_elasticity", "elasticity of the joint"
    equation = "q_measured = q + compliance tau_load"
    separated_by = "a chirp of {at} above a third of its resonance, or a sensor on the link side"
    compliance: Scalar = shape("rad/(N m)", (2e-5, 1e-4, 4e-4, 1.5e-3, 5e-3), (1e-7, 1e-2))

    def position_error(self, motion: Motion) -> Float[Array, " samples"]:
        return self.compliance * self.here(motion.load)
