r"""Postures in which the tool touches something fixed: planes and sockets (ball joints), as `calibrate` measures them.

A posture is brought onto a plane ($n \cdot (x - o) = 0$) or into a socket ($x = o$) by Newton's steps of least length,
$q \leftarrow q - J^+ c$; a slope along which postures are moved keeps the part that leaves c as it is, $(1 - J^+ J) g$.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

__all__ = ["Touch", "Touching"]

_STEP = 1e-6  # rad or m, of differences
_STEPS = 12  # of Newton
_FARTHEST = 0.5  # rad or m that a step moves a joint
_TOUCHES = 1e-7  # m


@dataclass(frozen=True)
class Touch:
    """A plane (`axis` is its normal) or a socket that the tool point touches, in the base frame, m and rad."""

    place: tuple[float, float, float]  # the socket, or a point on the plane
    axis: tuple[float, float, float] | None = None  # normal, towards the robot; a socket needs none
    radius: float = 0.3  # m around the place, of a plane that is touched
    tilt: float = np.pi  # rad, largest angle between the tool's z axis and the way into the plane or socket


class Touching:
    """Which postures touch which of several planes or sockets.

    `tool` gives poses of the tool frame in the base frame at joint positions; `point` is the tool point in it, m.
    """

    def __init__(
        self,
        tool: Callable[[Float[np.ndarray, "n nv"]], Float[np.ndarray, "n 4 4"]],
        point: Sequence[float],
        touched: Sequence[Touch],
        plane: bool,
    ) -> None:
        self.tool, self.point, self.touched, self.plane = tool, np.append(point, 1.0), tuple(touched), plane
        self.place = np.array([one.place for one in touched], float)
        axes = np.array([one.axis or (0.0, 0.0, 1.0) for one in touched], float)
        self.axis = axes / np.linalg.norm(axes, axis=1, keepdims=True)

    def missing(self, q: Float[np.ndarray, "n nv"], which: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n k"]:
        """What is between the tool point and the plane or socket that is to be touched, m."""
        away = (self.tool(q) @ self.point)[:, :3] - self.place[which]
        return (away * self.axis[which]).sum(axis=1, keepdims=True) if self.plane else away

    def which(self, q: Float[np.ndarray, "n nv"]) -> Int[np.ndarray, " n"]:
        """The one that each posture touches, or is nearest to."""
        every = [np.full(len(q), k) for k in range(len(self.place))]
        away = np.stack([np.linalg.norm(self.missing(q, k), axis=1) for k in every], axis=1)
        return away.argmin(axis=1)

    def slopes(self, q: Float[np.ndarray, "n nv"], which: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n k nv"]:
        """Derivatives of `missing` by the joint positions."""
        n, nv = q.shape
        around = (q[None] + np.concatenate([np.zeros((1, nv)), _STEP * np.eye(nv)])[:, None]).reshape(-1, nv)
        c = self.missing(around, np.tile(which, nv + 1)).reshape(nv + 1, n, -1)
        return np.moveaxis((c[1:] - c[:1]) / _STEP, 0, 2)

    def onto(self, q: Float[np.ndarray, "n nv"], which: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n nv"]:
        """The postures moved until they touch; some may not get there."""
        for _ in range(_STEPS):
            c = self.missing(q, which)
            if (np.abs(c) < _TOUCHES).all():
                break
            step = np.einsum("nvk,nk->nv", np.linalg.pinv(self.slopes(q, which), rcond=1e-4), c)
            longest = np.abs(step).max(axis=1, keepdims=True)
            q = q - step * np.minimum(1.0, _FARTHEST / np.maximum(longest, 1e-12))
        return q

    def along(
        self, q: Float[np.ndarray, "n nv"], which: Int[np.ndarray, " n"], slope: Float[np.ndarray, "n nv"]
    ) -> Float[np.ndarray, "n nv"]:
        """The part of a slope that goes on touching."""
        J = self.slopes(q, which)
        return slope - np.einsum("nvk,nkw,nw->nv", np.linalg.pinv(J, rcond=1e-4), J, slope)

    def room(self, q: Float[np.ndarray, "n nv"]) -> Float[np.ndarray, "n 3"]:
        """Below zero where a posture does not touch, is beside the plane (m) or too oblique (cosine)."""
        which, tool = self.which(q), self.tool(q)
        away = (tool @ self.point)[:, :3] - self.place[which]
        radius, tilt = (np.array([getattr(one, name) for one in self.touched])[which] for name in ("radius", "tilt"))
        missed = np.abs(self.missing(q, which)).max(axis=1)
        into = -(tool[:, :3, 2] * self.axis[which]).sum(axis=1)
        beside = radius - np.linalg.norm(away, axis=1) if self.plane else np.ones(len(q))
        return np.stack([10 * _TOUCHES - missed, beside, into - np.cos(tilt)], axis=1)
