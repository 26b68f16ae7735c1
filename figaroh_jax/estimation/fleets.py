"""Many robots of one structure, identified in one program: parameters of each, mean and spread, who stands out."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..effects.base import Effect
from ..errors import InputError
from ..rigid.model import RobotModel
from .accelerators import BatchFit, coordinates, fit_states
from .base_parameters import BaseParameters
from .states import States

__all__ = ["AT_ONCE", "Fleet", "check_fleet", "fleet_of", "identify_fleet", "own_arrays"]

AT_ONCE = 1.5e9  # bytes of the rows of the robots that are fitted at once


class Fleet(NamedTuple):
    """Base parameters of every robot, in the units of `names`, and what the population has in common."""

    names: tuple[str, ...]  # the base parameters' expressions at the first robot's lengths
    parameters: Float[np.ndarray, "robots kept"]
    std: Float[np.ndarray, "robots kept"]
    rms: Float[np.ndarray, "robots nv"]  # of each joint's residual, N m or N
    mean: Float[np.ndarray, " kept"]
    spread: Float[np.ndarray, " kept"]  # of the robots, without what noise adds to it

    def unusual(self, sigmas: float = 5.0) -> Bool[np.ndarray, "robots kept"]:
        """Which robots' parameters are so far from the median of all, in deviations of robots and noise together."""
        away = self.parameters - np.median(self.parameters, axis=0)
        beside = np.median(np.abs(away), axis=0) / 0.6745
        return np.abs(away) > sigmas * np.sqrt(beside**2 + self.std**2)


def identify_fleet(
    robots: Sequence[RobotModel],
    terms: tuple[Effect, ...],
    q: Float[Any, "robots samples nq"],
    v: Float[Any, "robots samples nv"],
    a: Float[Any, "robots samples nv"],
    tau: Float[Any, "robots samples nv"],
) -> Fleet:
    """Base parameters of each robot from its own recording, weighed by joint, on the default device.

    The robots have the same joints and may have lengths and masses of their own; `terms` are those of
    `columns.friction_terms`, recordings are equally long (rad, m, N m, N). One program for all, some robots at a time.
    Raises `InputError` where robots or arrays do not fit each other.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q, v, a = np.random.default_rng(0).normal(size=(3, 2, 300, robot.nv))
    >>> tau = np.stack([fj.inverse_dynamics(robot, *state) for state in zip(q, v, a)])
    >>> fj.fleets.identify_fleet([robot, robot], (), q, v, a, tau).parameters.shape
    (2, 22)
    """
    check_fleet(robots, q, v, a, tau)
    first = robots[0]
    rows = States(first, lambda: [], terms)
    into = coordinates(rows.structure, rows.structural).into
    bytes_each = 8 * np.shape(q)[1] * first.nv * (sum(into.shape) + 1)
    with jax.enable_x64(True):
        own = jax.tree.map(lambda *x: jnp.asarray(np.stack(x), float), *[own_arrays(robot) for robot in robots])
        at_once = max(1, int(AT_ONCE / bytes_each))
        state = tuple(jnp.asarray(x, float) for x in (q, v, a, tau))
        found: Any = jax.device_get(_program(at_once, first, terms, jnp.asarray(into), own, state))
    return fleet_of(rows.structural, found)


def check_fleet(robots: Sequence[RobotModel], q: Any, v: Any, a: Any, tau: Any) -> None:
    """Raise `InputError` where the robots have different joints or the arrays do not fit them.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot, x = fj.load_urdf(fj.DEMO), np.zeros((2, 100, 4))
    >>> fj.fleets.check_fleet([robot, robot], x, x, x, x)
    """
    if not robots:
        raise InputError("a fleet needs at least one robot")
    first = robots[0]
    for k, robot in enumerate(robots):
        if robot.joints != first.joints:
            raise InputError(f"robot {k} has other joints than robot 0; a fleet has one structure")
    shapes = {"q": (q, first.nq), "v": (v, first.nv), "a": (a, first.nv), "tau": (tau, first.nv)}
    for name, (x, width) in shapes.items():
        expected = (len(robots), np.shape(q)[1] if np.ndim(q) == 3 else "samples", width)
        if np.shape(x) != expected:
            raise InputError(f"{name} has shape {np.shape(x)}; expected {expected}: robots, samples, columns")


def fleet_of(base: BaseParameters, found: Any) -> Fleet:
    """What the fits (`BatchFit`) of all robots say; raises `InputError` where one is not finite."""
    kept = base.independent
    if not np.isfinite(found.parameters).all():
        wrong = int(np.flatnonzero(~np.isfinite(found.parameters).all(axis=1))[0])
        raise InputError(
            f"robot {wrong}: its parameters are not finite; its recording shows too little, or is not finite"
        )
    values, std = found.parameters[:, kept], found.std[:, kept]
    within = values.var(axis=0, ddof=1) - (std**2).mean(axis=0) if len(values) > 1 else np.zeros(len(kept))
    spread = np.sqrt(np.maximum(within, 0.0))
    return Fleet(tuple(base.expressions), values, std, found.rms, values.mean(axis=0), spread)


def own_arrays(robot: RobotModel) -> tuple[Any, ...]:
    """What may differ from robot to robot.

    >>> import figaroh_jax as fj
    >>> fj.fleets.own_arrays(fj.load_urdf(fj.DEMO))[2].shape  # inertial parameters
    (4, 10)
    """
    return robot.placement, robot.axis, robot.inertia, robot.ratio, robot.offset, robot.gravity


@partial(jax.jit, static_argnums=0)
def _program(at_once: int, first: RobotModel, terms: tuple[Effect, ...], into: Any, own: Any, state: Any) -> BatchFit:
    def one(given: Any) -> BatchFit:
        return fit_states(eqx.tree_at(own_arrays, first, given[0]), terms, into, *given[1])

    return jax.lax.map(one, (own, state), batch_size=at_once)
