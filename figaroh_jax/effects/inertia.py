"""Bodies: a link that is not as the model says, and a body that is fixed to one."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..rigid.model import RobotModel
from .base import Effect, Scalar, amplitude
from .loops import InRollouts
from .registry import register

__all__ = ["LinkEffect", "LinkInertia", "Payload"]


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
        """The robot with the ten parameters added to the link's, in the frame of its joint (kg, kg m, kg m2)."""
        return eqx.tree_at(lambda m: m.inertia, model, jnp.asarray(model.inertia).at[self.at[0]].add(self.ten()))


@register
class LinkInertia(LinkEffect):
    """A link whose inertia is not what the model says, further than it is trusted."""

    name, title = "link_inertia", "link inertia"
    contains = ("payload",)
    indistinguishable_from = ("payload",)
    needs_trust = 0.05  # ten free parameters of a link make up for many a misfit
    beside_rest = False  # for the same reason: wrong links were named where several other effects had no name
    equation = "W_k dpi_k, dpi_k free"
    separated_by = "the same motion with {at} disconnected or weighed"
    in_rollouts = InRollouts(
        (("mass", "mass"), ("mx", "mass_x"), ("my", "mass_y"), ("mz", "mass_z"),
         ("ixx", "inertia_xx"), ("ixy", "inertia_xy"), ("iyy", "inertia_yy"), ("ixz", "inertia_xz"),
         ("iyz", "inertia_yz"), ("izz", "inertia_zz")),
        lambda scale: ((0.0,) * 10,), "link", several=True, together=10, last=True,
        experiment="the same motion with {at} disconnected or weighed",
    )  # fmt: skip


@register
class Payload(LinkEffect):
    """A body fixed to a link: ten parameters that a physical body can have."""

    name, title = "payload", "payload"
    body = True
    equation = "W_k dpi_k, dpi_k a physical body: pseudo-inertia >= 0, mass > 0"
    separated_by = "the same motion with and without what is fixed to {at}"
    in_rollouts = InRollouts(
        (("mass", "payload"),), lambda scale: ((0.0,),), "link", several=True,
        experiment="the same motion with {at} carrying a known mass, or without what is fixed to it",
    )  # fmt: skip

    def physical(self) -> dict[str, Scalar]:
        """Mass (kg) and centre of mass in the frame of the link's joint (m); not finite for a mass of zero."""
        return {"mass": self.mass} | {f"com_{k}": getattr(self, f"m{k}") / self.mass for k in "xyz"}

    @classmethod
    def units(cls) -> dict[str, str]:
        """Those of `physical`: kg and m."""
        return {"mass": "kg"} | {f"com_{k}": "m" for k in "xyz"}
