r"""Motions that are linear in their parameters: a constant matrix gives position, velocity and acceleration.

$(q, v, a)(t) = (q_0, 0, 0) + (\Phi, \dot\Phi, \ddot\Phi)(t) z_j$ for joint j. Every kind begins and ends at rest, and
$\Phi(0) = 0$, so that $q_0$ is the posture in which the motion begins. Limits of position, velocity and acceleration
are then linear in z. Each column is scaled so that a unit of it moves by a radian, at 2 rad/s, or at 8 rad/s^2,
whichever is reached first.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ..errors import InputError, check_kind, check_positive
from ..rigid.model import Leaf

__all__ = ["Basis", "Trajectory", "fourier", "quintic", "spline"]

_FAST = (1.0, 2.0, 8.0)  # rad, rad/s, rad/s^2 that a column may reach
_DENSE = 400  # instants at which the scale of a column is looked for
_DEGREE = 5  # of a spline


class Basis(NamedTuple):
    """What a joint may do: one of the kinds, how many functions it is made of, for how long (s)."""

    kind: Literal["fourier", "spline", "quintic"]
    number: int  # harmonics, free control points, waypoints with the first
    duration: float
    base: float = 0.0  # Hz, of a Fourier series

    @property
    def size(self) -> int:
        """Numbers of one joint beside the posture in which it begins."""
        return {"fourier": 2 * self.number - 2, "spline": self.number, "quintic": self.number - 1}[self.kind]

    @property
    def waves(self) -> float:
        """Waves of the fastest function in a motion."""
        return self.number * self.base * self.duration if self.kind == "fourier" else self.number / 2

    def at(self, time: Float[ArrayLike, " samples"]) -> Float[np.ndarray, "3 samples size"]:
        """Position, velocity and acceleration of each function at the times (s)."""
        functions, scale = _scaled(self)
        return functions(np.asarray(time, float)) * scale

    def instants(self, rate: float) -> Float[np.ndarray, " samples"]:
        """Times from the beginning to the end, `rate` (Hz) a second."""
        check_positive("rate", rate, "Hz")
        return np.arange(round(self.duration * rate) + 1) / rate

    def peaks(self, rate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times (s) at which position, velocity and acceleration can be largest.

        Exact for a quintic from rest to rest, whose extremes stand at fixed shares of each piece; else `rate` a second.
        """
        if self.kind != "quintic":
            times = self.instants(rate)[1:]
            return times, times, times
        pieces = self.number - 1
        shares = (1.0,), (0.5,), ((3 - 3**0.5) / 6, (3 + 3**0.5) / 6)
        times = (np.add.outer(np.arange(pieces), share).ravel() * self.duration / pieces for share in shares)
        position, velocity, acceleration = times
        return position, velocity, acceleration


def fourier(harmonics: int, base: float, duration: float) -> Basis:
    """Sums of sines and cosines of `base` (Hz) and its multiples, at rest at the beginning and the end (periodic).

    Raises `InputError` where the duration holds no whole number of periods, or there are fewer than two harmonics.

    >>> import figaroh_jax as fj
    >>> fj.fourier(5, base=0.1, duration=10.0).size  # numbers a joint
    8
    """
    check_kind("harmonics", harmonics, (int, np.integer), "how many functions a joint has")
    check_positive("base", base, "Hz")
    check_positive("duration", duration, "s")
    if harmonics < 2 or not base > 0:
        raise InputError(
            f"a Fourier basis of {harmonics} harmonics of {base:g} Hz: at least 2 of more than 0 Hz needed"
        )
    periods = duration * base
    if periods < 0.5 or abs(periods - round(periods)) > 1e-9:
        raise InputError(
            f"{duration:g} s are {periods:g} periods of {base:g} Hz: a motion ends at rest after a whole number of"
            f" them; a base of {max(1, round(periods)) / duration:g} Hz fits"
        )
    return Basis("fourier", harmonics, float(duration), float(base))


def spline(points: int, duration: float) -> Basis:
    """B-splines of degree 5, clamped at rest at both ends, with so many free control points; the last is the end.

    Raises `InputError` for fewer than two.

    >>> import figaroh_jax as fj
    >>> basis = fj.spline(4, duration=3.0)
    >>> basis.at([0.0, 3.0]).shape  # position, velocity and acceleration of four functions, at both ends
    (3, 2, 4)
    """
    check_kind("points", points, (int, np.integer), "how many functions a joint has")
    check_positive("duration", duration, "s")
    if points < 2:
        raise InputError(f"a spline with {points} free control points: at least 2 are needed")
    return Basis("spline", points, float(duration))


def quintic(waypoints: int, duration: float) -> Basis:
    """Quintic polynomials from rest to rest between waypoints, the first of which is the start; equal times between.

    Raises `InputError` for fewer than two.

    >>> import figaroh_jax as fj
    >>> fj.quintic(5, duration=8.0).size  # numbers a joint: the first waypoint is the start
    4
    """
    check_kind("waypoints", waypoints, (int, np.integer), "how many functions a joint has")
    check_positive("duration", duration, "s")
    if waypoints < 2:
        raise InputError(f"a quintic with {waypoints} waypoints: at least 2 are needed, the start among them")
    return Basis("quintic", waypoints, float(duration))


class Trajectory(eqx.Module):
    """A motion of all joints: a pytree whose two arrays are its parameters, to differentiate and to map over.

    >>> import numpy as np, figaroh_jax as fj
    >>> motion = fj.Trajectory(np.zeros(4), 0.2 * np.ones((4, 6)), fj.spline(6, duration=5.0))
    >>> q, v, a = motion.states(rate=100.0)
    >>> q.shape, float(abs(v[-1]).max())  # at rest at the end
    ((501, 4), 0.0)
    """

    start: Float[Leaf, "*batch nv"]  # posture at the beginning, rad or m
    weights: Float[Leaf, "*batch nv size"]  # of the basis' functions
    basis: Basis = eqx.field(static=True)

    @property
    def duration(self) -> float:
        """Length of the motion, s."""
        return self.basis.duration

    def states(
        self, rate: float = 20.0
    ) -> tuple[Float[Array, "*batch samples nv"], Float[Array, "*batch samples nv"], Float[Array, "*batch samples nv"]]:
        """Position, velocity and acceleration (rad or m, and their rates) from 0 to the duration, `rate` (Hz) a second.

        Linear in `start` and `weights`.
        """
        check_kind("basis", self.basis, Basis, "`fourier`, `spline` and `quintic` make one")
        return self.at(self.basis.instants(rate))

    def at(
        self, time: Float[ArrayLike, " samples"]
    ) -> tuple[Float[Array, "*batch samples nv"], Float[Array, "*batch samples nv"], Float[Array, "*batch samples nv"]]:
        """As `states`, at the given times (s)."""
        check_kind("basis", self.basis, Basis, "`fourier`, `spline` and `quintic` make one")
        matrix, joints = self.basis.at(np.asarray(time)), np.shape(self.start)[-1:]
        if np.shape(self.weights)[-2:] != (*joints, self.basis.size):
            raise InputError(
                f"weights have shape {np.shape(self.weights)}; {(*joints, self.basis.size)} is expected: a row for each"
                f" number of start {np.shape(self.start)}, a column for each of the basis' functions"
            )
        space = jnp if any(isinstance(x, jax.Array) for x in (self.start, self.weights)) else np
        q, v, a = (space.swapaxes(space.asarray(self.weights) @ phi.T, -1, -2) for phi in matrix)
        return q + space.asarray(self.start)[..., None, :], v, a


@lru_cache(maxsize=32)
def _scaled(basis: Basis):
    functions = {"fourier": _fourier, "spline": _spline, "quintic": _quintic}[basis.kind](basis)
    largest = np.abs(functions(np.linspace(0.0, basis.duration, _DENSE))).max(axis=1)
    return functions, 1.0 / (largest / np.array(_FAST)[:, None]).max(axis=0)


def _fourier(basis: Basis):
    omega = 2 * np.pi * basis.base * np.arange(1, basis.number + 1)

    def raw(time: np.ndarray) -> np.ndarray:
        s, c = np.sin(np.outer(time, omega)), np.cos(np.outer(time, omega))
        return np.stack(
            [np.hstack([s, c]), np.hstack([omega * c, -omega * s]), np.hstack([-(omega**2) * s, -(omega**2) * c])]
        )

    begin = raw(np.zeros(1))[:, 0]
    null = np.linalg.svd(begin[1:] / np.abs(begin[1:]).max(axis=1, keepdims=True))[2][2:].T  # at rest at the beginning

    def functions(time: np.ndarray) -> np.ndarray:
        out = raw(time) @ null
        out[0] -= begin[0] @ null
        return out

    return functions


def _spline(basis: Basis):
    from scipy.interpolate import BSpline  # slow to import

    controls = basis.number + 5  # three at the start, three at the end that are one
    inner = np.linspace(0.0, basis.duration, controls - _DEGREE + 1)
    knots = np.concatenate([np.zeros(_DEGREE), inner, np.full(_DEGREE, basis.duration)])
    coefficients = np.zeros((controls, basis.number))
    coefficients[np.arange(3, controls), np.minimum(np.arange(controls - 3), basis.number - 1)] = 1.0
    curves = [
        BSpline(knots, coefficients, _DEGREE).derivative(k) if k else BSpline(knots, coefficients, _DEGREE)
        for k in range(3)
    ]
    return lambda time: np.stack([curve(np.clip(time, 0.0, basis.duration)) for curve in curves])


def _quintic(basis: Basis):
    pieces = basis.number - 1
    length = basis.duration / pieces

    def functions(time: np.ndarray) -> np.ndarray:
        piece = np.clip((time / length).astype(int), 0, pieces - 1)
        u = np.clip(time / length - piece, 0.0, 1.0)
        step = np.stack(
            [
                u**3 * (10 - 15 * u + 6 * u**2),
                30 * u**2 * (1 - u) ** 2 / length,
                60 * u * (1 - u) * (1 - 2 * u) / length**2,
            ]
        )
        out = np.zeros((3, len(time), pieces))
        rows = np.arange(len(time))
        out[:, rows, piece] = step  # towards this piece's end
        behind = piece > 0
        out[:, rows[behind], piece[behind] - 1] = -step[:, behind]  # away from its beginning
        out[0, rows[behind], piece[behind] - 1] += 1.0
        return out

    return functions
