"""The gain on data that was not used for the fit, and the recordings as the report shows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect
from ..recordings.signals import Signals
from ..recordings.stacked import open_rows
from ..results import Trace
from .design import kind, sensor_response
from .estimates import amplitude_places
from .problem import Problem
from .search import Found
from .shifts import torque_change
from .state import State, batched, extended_state
from .step import stand

__all__ = ["fold_error", "held_out", "predicted", "residual_rms", "traces"]


def held_out(problem: Problem, start: State, causes: list[Effect], whitening: Float[np.ndarray, "F nv"]) -> list[float]:
    """Relative RMS error on data not fitted: of the baseline, then after each cause (filtered torque, all joints).

    sqrt(sum e^2 / sum tau^2) over the holdout recordings with torque; without any, over the folds, each predicted by
    a fit to the others.
    """
    out, step = [], None
    for effect in [None, *causes]:
        grown = start if step is None or effect is None else extended_state(problem, step.state, effect)
        step = stand(problem, grown, whitening, step)
        state = step.state
        if problem.held.any():
            error = (problem.torque - predicted(problem, state)) * problem.held
            out.append(float(np.sqrt((error**2).sum() / ((problem.torque * problem.held) ** 2).sum())))
        else:
            out.append(fold_error(problem, state, step.verdicts.folds))
    return out


def predicted(problem: Problem, state: State) -> Float[np.ndarray, "n M nv"]:
    """Rows of the torque that the state predicts, as the sensors read it, in all recordings (N m or N)."""
    return open_rows(problem.records, state.torque(state.theta), state.response(problem.records.omega))


def residual_rms(problem: Problem, state: State) -> Float[np.ndarray, " nv"]:
    """RMS of what the state leaves of the fitted rows of each joint, N m or N."""
    weight = np.asarray(problem.records.judged)
    squares = ((problem.torque - predicted(problem, state)) ** 2 * weight).sum((0, 1))
    return np.sqrt(squares / np.maximum(weight.sum((0, 1)), 1))


def traces(
    problem: Problem,
    signals: Sequence[Signals],
    first: State,
    last: State,
    causes: list[Effect],
    found: Sequence[Found],
) -> tuple[Trace, ...]:
    """Each recording's rows: measured torque, the model's before and after, the share of each cause."""
    before, after = predicted(problem, first), predicted(problem, last)
    places = amplitude_places(last, causes, problem.model)
    shares = [_share(problem, last, e, at) for e, at in zip(causes, places, strict=True)]
    out = []
    for k, one in enumerate(signals):
        rows, count = one.rows.index, one.rows.kept
        out.append(
            Trace(
                name=one.name,
                role=one.role,
                time=one.time[rows],
                position=one.position[rows],
                velocity=one.velocity[rows],
                measured=None if one.torque is None else problem.torque[k, :count],
                before=before[k, :count],
                after=after[k, :count],
                shares={str(f.name): share[k, :count] for f, share in zip(found, shares, strict=True)},
            )
        )
    return tuple(out)


def _share(problem: Problem, state: State, effect: Effect, place: list[int]) -> Float[np.ndarray, "n M nv"]:
    """Rows of the torque that one cause brings about, the others being as they are."""
    response = state.response(problem.records.omega)
    if kind(effect) == "response":
        own = sensor_response({effect.name: batched(effect)}, problem.records.omega)[effect.name][0]
        return open_rows(problem.records, state.motion.total, response * (1 - 1 / own))
    if kind(effect) == "position":
        return open_rows(problem.records, torque_change(batched(effect), state.motion, problem.records)[0], response)
    own = np.isin(np.arange(len(state.theta)), place)
    return open_rows(problem.records, state.torque(np.where(own, state.theta, 0.0)) - state.known, response)


def fold_error(problem: Problem, state: State, folds: Float[np.ndarray, "folds P"]) -> float:
    """Relative RMS error (N m over N m, all joints) of each fold, predicted with the coefficients without it."""
    weight = np.asarray(problem.records.judged)
    response, fold = state.response(problem.records.omega), problem.layout.fold.reshape(weight.shape[:2])
    error = problem.torque * weight
    power = (error**2).sum()
    for k, theta in enumerate(folds):
        error = error - open_rows(problem.records, state.torque(theta), response) * weight * (fold == k)[..., None]
    return float(np.sqrt((error**2).sum() / power))
