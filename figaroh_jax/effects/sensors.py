"""Sensors: what encoders and torque sensors read beside the truth, and clocks that disagree.

q: position of the joint; tau_hat: torque of the whole model; p: d/dt.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..rigid.model import Leaf
from .base import Effect, JointEffect, Motion, Native, Scalar, amplitude, shape
from .loops import InRollouts
from .registry import register

__all__ = [
    "ClockError",
    "EncoderEccentricity",
    "EncoderOffset",
    "EncoderScale",
    "TorqueDelay",
    "TorqueGain",
    "TorqueLag",
    "TorqueOffset",
    "TorqueSaturation",
]

NEAR = 1e-3  # samples between two times that count as one
OVERSHOOT, PASSED = 0.1, 0.01  # of a limit, by which noise may pass it; share of the rows beyond that


@register
class TorqueOffset(JointEffect):
    """Constant torque: an offset of the sensor, the drive or a preload."""

    name, title = "torque_offset", "torque offset"
    of_position = True
    reverses = False
    equation = "offset"
    separated_by = "a dwell of {at} with the brake on or the motor unloaded"
    in_rollouts = InRollouts((("offset", "offset"),), lambda scale: ((0.0,),), constant=True)
    offset: Scalar = amplitude("N m")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """The offset at every sample, N m or N."""
        return self.offset * jnp.ones_like(motion.time)

    def native(self) -> tuple[Native, ...]:
        """`bias` of the joint's actuator."""
        return (Native("actuator", "bias", float(self.offset)),)


@register
class TorqueGain(JointEffect):
    """A wrong torque constant or gear ratio: the reading is off by a factor."""

    name, title = "torque_gain", "torque gain error"
    like_links = True
    levels = ("torque", "pose")  # in rollouts it acts where a model has it, but is not looked for
    follows_torque = follows_total = True
    equation = "gain tau_hat"
    separated_by = "the same motion of {at} with and without a payload of known mass"
    gain: Scalar = amplitude("")

    def torque(self, motion: Motion) -> Float[Array, " samples"]:
        """gain times the torque of the whole model, N m or N: what the sensor reads too much."""
        return self.gain * self.here(motion.total)


@register
class TorqueDelay(Effect):
    """Torque that is stamped late against the position."""

    name, title, acts_on = "torque_delay", "torque delay", "robot"
    follows_torque = True
    excludes = ("torque_lag",)
    equation = "tau_hat(t - delay) - tau_hat(t)"
    separated_by = "faster motion: a lag weakens high frequencies, a delay does not"
    delay: Scalar = shape("s", (0.001, 0.003, 0.006, 0.012, 0.025), (0.0, 0.06))

    def torque_response(self, omega: Float[Array, " freqs"]) -> Complex[Array, " freqs"]:
        """exp(-i omega delay): the torque sensor reads what was true `delay` seconds before."""
        return jnp.exp(-1j * omega * self.delay)


@register
class TorqueLag(Effect):
    """Torque seen through a first-order low pass."""

    name, title, acts_on = "torque_lag", "torque lag", "robot"
    follows_torque = True
    equation = "(1/(1 + time p) - 1) tau_hat"
    separated_by = "faster motion: a lag weakens high frequencies, a delay does not"
    time: Scalar = shape("s", (0.001, 0.003, 0.006, 0.012, 0.025), (0.0002, 0.06))

    def torque_response(self, omega: Float[Array, " freqs"]) -> Complex[Array, " freqs"]:
        """1 / (1 + i omega time): a low pass of first order."""
        return 1 / (1 + 1j * omega * self.time)


@register
class TorqueSaturation(JointEffect):
    """A drive or a sensor that gives no more than its limit."""

    name, title = "torque_saturation", "torque saturation"
    follows_torque = follows_total = True
    equation = "clip(tau_hat, -limit, limit) - tau_hat"
    separated_by = "motion of {at} at two larger accelerations: the largest torque stays"
    share: Scalar = amplitude("", lower=0.5, upper=2.0, expected=(1.0, 0.02))  # of what is cut: none passes a limit
    limit: Scalar = shape("N m", (1.0, 3.0, 10.0, 30.0, 100.0, 300.0), (0.0, 1e5))

    def torque_error(self, motion: Motion) -> Float[Array, " samples"]:
        """share (clip(tau, -limit, limit) - tau), N m or N, of the torque of the whole model."""
        total = self.here(motion.total)
        return self.share * (jnp.clip(total, -self.limit, self.limit) - total)

    def delivered(self, torque: Float[Array, " nv"]) -> Float[Array, " nv"]:
        """The torques (nv,) with this joint's cut at its limit, N m or N."""
        own = torque[self.at[0]]
        return torque.at[self.at[0]].add(self.share * (jnp.clip(own, -self.limit, self.limit) - own))

    def through(self, motion: Motion) -> Float[Leaf, " samples"]:
        """1 below the limit, 1 - share beyond it: there the torque says nothing of what the drive was to give."""
        return np.where(np.abs(np.asarray(self.here(motion.total))) > self.limit, 1 - self.share, 1.0)

    def allows(self, torque: Float[np.ndarray, " rows"]) -> bool:
        """No more than `PASSED` of the torques are beyond the limit by more than `OVERSHOOT` of it, as noise may be."""
        beyond = np.count_nonzero(np.abs(torque) > (1 + OVERSHOOT) * self.limit)
        return bool(beyond <= PASSED * np.size(torque))

    def physical(self) -> dict[str, Scalar]:
        """The limit alone: the share is 1 where a drive is saturated."""
        return {"limit": self.limit}

    @classmethod
    def units(cls) -> dict[str, str]:
        """N m; N of a prismatic joint."""
        return {"limit": "N m"}

    @classmethod
    def starts(cls, motion: Motion, place: int) -> dict[str, tuple[float, ...]]:
        """The limit at which the search begins, N m or N: what most of the largest torques measured are near to.

        The middle of the shortest stretch that holds a quarter of those that may be at a limit (a mode: Robertson and
        Cryer, 1974).
        """
        size = np.sort(np.abs(np.asarray(motion.total)[:, place]))
        size = size[np.searchsorted(size, np.quantile(size, 1 - PASSED) / (1 + OVERSHOOT)) :]
        count = len(size) // 4
        first = int(np.argmin(size[count:] - size[: len(size) - count]))
        return {"limit": (float(size[first : first + count + 1].mean()),)}


@register
class ClockError(Effect):
    """A clock of the torque that runs faster or slower than that of the position."""

    name, title, acts_on = "clock_error", "drift between the clocks of position and torque", "robot"
    follows_torque = follows_total = True
    beside_rest = False  # whatever is late in one part of a recording and not in another looks like it
    about = ("expansion", "rate")
    equation = "tau_hat(t + rate t) - tau_hat(t)"
    separated_by = "a longer recording: the lag at its end against the lag at its start"
    rate: Scalar = amplitude("s/s", lower=-0.02, upper=0.02)
    expansion: Scalar = shape("s/s", (0.0,), (-0.02, 0.02), choice=True)

    def torque_error(self, motion: Motion) -> Float[Array, "samples nv"]:
        """tau(t + rate t) - tau(t) (samples, nv), N m or N: a lag that grows with the time t since the record began.

        Linear in the rate, and exact where the expansion is the rate: the mean of d(tau)/dt from t to t + expansion t,
        times rate t. Steps of dry friction are read at their place, which no derivative at a few points would do.
        """
        total, elapsed, dt = jnp.asarray(motion.total), motion.elapsed, jnp.asarray(motion.dt)
        ahead = self.expansion * elapsed
        apart = jnp.abs(ahead) > NEAR * dt
        secant = (motion.later(total, ahead) - total) / jnp.where(apart, ahead, 1.0)[:, None]
        return (self.rate * elapsed)[:, None] * jnp.where(apart[:, None], secant, motion.rate(motion.total))

    def physical(self) -> dict[str, Scalar]:
        """The rate alone: the expansion is the same number."""
        return {"rate": self.rate}

    @classmethod
    def units(cls) -> dict[str, str]:
        """That of `physical`."""
        return {"rate": "s/s"}


@register
class EncoderOffset(JointEffect):
    """A zero of the encoder that is not the model's."""

    name, title = "encoder_offset", "encoder zero offset"
    like_links = True
    levels = ("torque", "rollout")  # to a calibration it is a `joint_offset`
    in_rollouts = InRollouts((("offset", "reading"),), lambda scale: ((0.0,),), constant=True)
    equation = "q_measured = q + offset"
    separated_by = "kinematic calibration, or a reference mark of {at}: torque hardly distinguishes it from inertia"
    offset: Scalar = amplitude("rad", lower=-0.2, upper=0.2)

    def position_error(self, motion: Motion) -> Float[Leaf, "samples *joints"]:
        """The offset at every sample, rad or m."""
        return self.offset + 0.0 * motion.time


@register
class EncoderScale(JointEffect):
    """An encoder that counts too much or too little a turn, or a gear ratio that is not the model's."""

    name, title = "encoder_scale", "encoder scale error"
    like_links = True
    correction = -1.0
    equation = "q_measured = q + scale q"
    separated_by = "motion of {at} over more than half a turn, or kinematic calibration"
    separated_by_postures = "postures over more than half a turn of {at}"
    scale: Scalar = amplitude("", lower=-0.2, upper=0.2)

    def position_error(self, motion: Motion) -> Float[Leaf, "samples *joints"]:
        """scale q, rad or m."""
        return self.scale * self.here(motion.angle)


@register
class EncoderEccentricity(JointEffect):
    """An encoder's disc that is not centred: an error that comes back with every turn."""

    name, title = "encoder_eccentricity", "encoder eccentricity"
    correction = -1.0
    equation = "q_measured = q + sine sin q + cosine cos q"
    separated_by = "a whole turn of {at}, or kinematic calibration with two payloads"
    separated_by_postures = "the same postures with two payloads, and a whole turn of {at}"
    sine: Scalar = amplitude("rad", lower=-0.05, upper=0.05)
    cosine: Scalar = amplitude("rad", lower=-0.05, upper=0.05)

    def position_error(self, motion: Motion) -> Float[Leaf, "samples *joints"]:
        """sine sin q + cosine cos q, rad."""
        q = self.here(motion.angle)
        space = np if isinstance(q, np.ndarray) else jnp
        return self.sine * space.sin(q) + self.cosine * space.cos(q)
