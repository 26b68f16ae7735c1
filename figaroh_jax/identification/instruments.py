"""Instrumental variables whose instruments come from the simulated trajectory.

Encoder noise enters the regressor, and in closed loop the torque as well: least squares is biased. The robot fitted so
far, simulated under the controller and references of the recording, moves without that noise; its regressor is the
instrument, and the fit and the simulation are repeated in turn (IDIM-IV; Janot, Vandanjon, Gautier, 2014).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..effects.extended import ExtendedModel, extend
from ..effects.simulation import simulate
from ..errors import InputError
from ..estimation.base_parameters import BaseParameters
from ..estimation.least_squares import InstrumentalVariables, Solution, WeightedByJoint, joint_weights, solve
from ..estimation.regression import condense
from ..estimation.states import States
from .judgement import fitted_effects

__all__ = ["simulated_instruments", "solve_by_simulation"]

Controller = Callable[[Any, Any, Any], Float[Array, " nv"]]
SETTLED = 1e-3  # relative change of the parameters at which the turns end


def simulated_instruments(
    rows: States,
    theta: Float[np.ndarray, " columns"],
    control: Controller,
    position: Float[np.ndarray, " nv"],
    velocity: Float[np.ndarray, " nv"],
    dt: float,
) -> States:
    """The states of `rows` as the robot with the parameters `theta` moves without noise.

    `control(time, q, v)` gives the torque (N m or N) of the recording's own controller and references, in JAX; the
    states of `rows` are one record at even steps of `dt` s that begins at `position` and `velocity`. Raises
    `InputError` where the simulated motion is not finite: the robot is none that can exist, or is not stabilised.
    An example: `examples/noisy_encoder.py`.
    """
    lengths = [len(part[0]) for part in rows.source()]
    found = simulate(_robot(rows, theta), control, position, velocity, dt, sum(lengths))
    motion = [np.asarray(x) for x in (found.position, found.velocity, found.acceleration, found.torque)]
    if not all(np.isfinite(x).all() for x in motion):
        raise InputError("the simulated trajectory of the instruments is not finite: the controller does not hold it")

    def source() -> Iterator[tuple[np.ndarray, ...]]:
        start = 0
        for length in lengths:
            yield tuple(x[start : start + length] for x in motion)
            start += length

    return replace(rows, source=source)


def solve_by_simulation(
    rows: States,
    base: BaseParameters,
    control: Controller,
    position: Float[np.ndarray, " nv"],
    velocity: Float[np.ndarray, " nv"],
    dt: float,
    turns: int = 10,
) -> Solution:
    """Base parameters by instrumental variables, the instruments simulated anew with each estimate.

    Starts from least squares weighted by joint; what no motion shows keeps the model's own values in the simulation.
    Arguments as `simulated_instruments`. `converged` tells whether the parameters settled within `turns`.
    An example: `examples/noisy_encoder.py`.
    """
    data = condense(rows, rows.used)
    found = solve(data, WeightedByJoint(), kept=base.independent)
    for turn in range(1, turns + 1):
        instruments = simulated_instruments(rows, _completed(rows, base, found), control, position, velocity, dt)
        weight = joint_weights(data, found.parameters)
        method = InstrumentalVariables(instruments)
        new = solve(data, method, kept=base.independent, weight=weight, regression=rows, used=rows.used)
        change = np.linalg.norm(new.parameters - found.parameters)
        found = replace(new, iterations=turn, converged=bool(change <= SETTLED * np.linalg.norm(new.parameters)))
        if found.converged:
            break
    return found


def _completed(rows: States, base: BaseParameters, found: Solution) -> Float[np.ndarray, " columns"]:
    """The model's own parameters, changed as little as the base parameters ask for."""
    own = np.zeros(len(base.names))
    ten = np.ravel(np.asarray(rows.model.inertia))
    own[: ten.size] = ten
    return own + base.spread @ (found.parameters[base.independent] - base.matrix @ own)


def _robot(rows: States, theta: Float[np.ndarray, " columns"]) -> ExtendedModel:
    links = 10 * len(rows.model.joints)
    robot = eqx.tree_at(lambda m: m.inertia, rows.model, theta[:links].reshape(-1, 10))
    width = np.broadcast_to(np.asarray(rows.width, float), (rows.model.nv,))
    return extend(robot, *fitted_effects(rows.terms, theta[links:]), width=width)
