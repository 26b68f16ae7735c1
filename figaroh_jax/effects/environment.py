"""What acts on the robot from outside: the direction of gravity, a force at a link, a floor."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..rigid.kinematics import axis_twists, gather, movers, pose_columns, poses_on_host
from ..rigid.model import RobotModel
from .base import Effect, Motion, Scalar, amplitude, shape
from .loops import InRollouts
from .registry import register

__all__ = ["Contact", "ExternalWrench", "GravityTilt", "PointEffect", "level_axes"]

_LEANS = 0.05  # m/s2, from which a tilt is fitted: along a joint's axis it shows to second order alone, and not at zero


@register
class GravityTilt(Effect):
    """A base that is not level: gravity in the base frame has a horizontal part.

    For a base that is not upright (on a wall, under a ceiling) x and y are those of the base frame, turned by the
    smallest turn that takes its z axis up.
    """

    name, title, acts_on = "gravity_tilt", "base tilt", "robot"
    like_links = True
    equation = "tau(gravity + (x, y, 0)) - tau(gravity)"
    separated_by = "a full turn of the first joint with the arm stretched, or a level on the base"
    in_rollouts = InRollouts(
        (("x", "gravity_x"), ("y", "gravity_y")), lambda scale: ((_LEANS, _LEANS),), "robot", several=True, together=2,
    )  # fmt: skip
    x: Scalar = amplitude("m/s2")
    y: Scalar = amplitude("m/s2")

    def change(self, model: RobotModel) -> RobotModel:
        """The robot with x and y added to gravity in its base frame, m/s2."""
        tilted = model.gravity + level_axes(model.gravity) @ jnp.stack([jnp.asarray(self.x), jnp.asarray(self.y)])
        return eqx.tree_at(lambda m: m.gravity, model, tilted)

    def physical(self) -> dict[str, Scalar]:
        """The tilt itself: angles about those x and y axes, rad, for a base that leans by little (9.81 m/s2)."""
        return {"about_x": -self.y / 9.81, "about_y": self.x / 9.81}

    @classmethod
    def units(cls) -> dict[str, str]:
        """Those of `physical`: rad."""
        return {"about_x": "rad", "about_y": "rad"}


def level_axes(gravity: Float[ArrayLike, "3"]) -> Float[Array, "3 2"]:
    r"""The base's x and y axes after the smallest turn that takes its z axis up, in the base frame.

    With up u = -g / |g|: $e_i - u_i (e_z + u) / (1 + u_z)$ (Rodrigues' formula); where z points down, x and -y.
    """
    g = jnp.asarray(gravity)
    square = g @ g  # where there is none, z is up; and no gradient is NaN
    up = jnp.where(square > 0, -g / jnp.sqrt(jnp.where(square > 0, square, 1.0)), jnp.array([0.0, 0.0, 1.0], g.dtype))
    down = 1 + up[2] < 1e-6
    turned = jnp.eye(3, dtype=g.dtype)[:, :2] - jnp.outer(up.at[2].add(1.0), up[:2]) / jnp.where(down, 1.0, 1 + up[2])
    return jnp.where(down, jnp.array([[1.0, 0.0], [0.0, -1.0], [0.0, 0.0]], g.dtype), turned)


class PointEffect(Effect):
    """A force on a point of a link, fixed in the link's joint frame (m)."""

    acts_on = "link"
    reverses = False

    @classmethod
    def may_act(cls, model: RobotModel, place: int) -> bool:
        """At a link at the end of the tree: the index of its joint in `model.joints`."""
        return all(joint.parent != place for joint in model.joints)  # a link at the end of the tree

    def point(self, motion: Motion, offset: Array) -> tuple[Float[Array, "3 samples"], Float[Array, "nv 3 samples"]]:
        """The point `offset` of the link in the world, and the Jacobian of its position."""
        model, link = motion.model, self.at[0]
        poses = pose_columns(model, jnp.asarray(motion.position).T)
        own = poses[link]
        at = own[0] + jnp.tensordot(offset, own[1:], 1)
        linear = axis_twists(model, poses, at)[0] * jnp.asarray(movers(model))[:, link, None, None]
        return at, gather(model, linear)


@register
class ExternalWrench(PointEffect):
    """A constant force on the last link: a cable, a hose, somebody who pulls."""

    name, title = "external_wrench", "constant external force"
    like_links = True
    equation = "-J(q)' (force_x, force_y, force_z) at the point (x, y, z) of the link"
    separated_by = "the same motion with {at} free, or with the base turned"
    resembles = ("gravity_tilt", "payload")  # six numbers that follow any constant load of a few postures
    beside_rest = False  # for the same reason: a rest that goes with the posture looks like it
    force_x: Scalar = amplitude("N")
    force_y: Scalar = amplitude("N")
    force_z: Scalar = amplitude("N")
    x: Scalar = shape("m", (0.0,), (-0.6, 0.6))
    y: Scalar = shape("m", (0.0,), (-0.6, 0.6))
    z: Scalar = shape("m", (0.0,), (-0.6, 0.6))

    def torque(self, motion: Motion) -> Float[Array, "samples nv"]:
        """Drive torque (samples, nv) that balances the force: -J(q)' f, N m or N.

        The force (N) is constant in the world's axes; the point (m) is fixed in the frame of the link's joint.
        """
        force = jnp.stack([jnp.asarray(f) for f in (self.force_x, self.force_y, self.force_z)])
        jacobian = self.point(motion, jnp.stack([jnp.asarray(c) for c in (self.x, self.y, self.z)]))[1]
        return -jnp.einsum("jcs,c->sj", jacobian, force)


@register
class Contact(PointEffect):
    """A floor or a table that the last link presses on: a spring below a height, without friction."""

    name, title = "contact", "contact with a horizontal plane"
    equation = "-J_z(q)' stiffness max(0, height - z(q)) at the point (x, y, z) of the link"
    separated_by = "the same motion of {at} farther away from the plane"
    beside_rest = False  # any rest that is larger in one part of the space looks like a plane somewhere
    stiffness: Scalar = amplitude("N/m", lower=0.0)
    height: Scalar = shape("m", (0.0, 0.2, 0.5, 1.0), (-10.0, 10.0))
    x: Scalar = shape("m", (0.0,), (-0.6, 0.6))
    y: Scalar = shape("m", (0.0,), (-0.6, 0.6))
    z: Scalar = shape("m", (0.0,), (-0.6, 0.6))

    def torque(self, motion: Motion) -> Float[Array, "samples nv"]:
        """Drive torque (samples, nv) that balances the push of the plane: -J_z(q)' stiffness depth, N m or N.

        The depth of the point is measured from `height` (m, in the world) downwards; above it, it is zero.
        """
        at, jacobian = self.point(motion, jnp.stack([jnp.asarray(c) for c in (self.x, self.y, self.z)]))
        depth = jnp.maximum(self.height - at[2], 0.0)
        return -self.stiffness * (jacobian[:, 2] * depth).T

    @classmethod
    def starts(cls, motion: Motion, place: int) -> dict[str, tuple[float, ...]]:
        """Heights (m) at which the search begins: low quantiles of the height of the link's joint in the recordings."""
        some = np.asarray(motion.position)[:: max(1, len(motion.position) // 400)]
        height = poses_on_host(motion.model, some)[:, place, 2, 3]
        return {"height": tuple(np.unique(np.quantile(height, (0.05, 0.1, 0.2, 0.3, 0.45))).tolist())}
