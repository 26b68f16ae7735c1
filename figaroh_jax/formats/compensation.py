"""The effect of gravity that something else than the drives carries: MuJoCo's `gravcomp`, a balancer, buoyancy."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..effects.base import Effect, Motion, Native, Scalar, amplitude
from ..effects.catalogue import register
from ..rigid.dynamics import inverse_dynamics

__all__ = ["GravityCompensation"]


@register
class GravityCompensation(Effect):
    """A force at a link's centre of mass, against its weight; read from files, not searched by the diagnosis."""

    name, title, acts_on = "gravity_compensation", "gravity compensation", "link"
    equation = "-fraction tau_gravity of the link"
    separated_by = "postures of the joints below {at} with another load on it"
    searched = False
    fraction: Scalar = amplitude("")

    def torque(self, motion: Motion) -> Float[Array, "samples nv"]:
        """-fraction times the torque of the link's weight (samples, nv), N m or N: what the drives need not give."""
        model, still = motion.model, jnp.zeros_like(motion.velocity)
        own = jnp.zeros_like(jnp.asarray(model.inertia)).at[self.at[0]].set(jnp.asarray(model.inertia)[self.at[0]])
        alone = eqx.tree_at(lambda m: m.inertia, model, own)
        return -self.fraction * inverse_dynamics(alone, motion.position, still, still)

    def native(self) -> tuple[Native, ...]:
        """`gravcomp` of the body."""
        return (Native("body", "gravcomp", float(self.fraction)),)
