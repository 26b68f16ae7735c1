"""The gain on data that was not used for the fit, and the recordings as the report shows them."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .effect import Effect
from .extended import ExtendedModel, predict
from .problem import Problem, State, extended_state, plain_rows
from .records import Records, filter_rows, stack
from .results import Trace
from .search import Found, stand
from .signals import Signals

__all__ = ["held_out", "traces"]


def held_out(
    problem: Problem,
    start: State,
    causes: list[Effect],
    whitening: Float[np.ndarray, "F nv"],
    signals: Sequence[Signals],
) -> list[float]:
    """Relative RMS error on data not fitted: of the baseline, then after each cause (filtered torque, all joints).

    sqrt(sum e^2 / sum tau^2) over the holdout recordings with torque; without any, over the folds, each predicted by
    a fit to the others.
    """
    kept = [s for s in signals if s.role == "holdout" and s.torque is not None]
    out, state = [], start
    for effect in [None, *causes]:
        state = state if effect is None else extended_state(problem, state, effect)
        step = stand(problem, state, whitening)
        state = step.state
        if kept:
            out.append(_recorded_error(fitted_so_far(problem, state, causes[: len(out)]), kept))
        else:
            out.append(_fold_error(problem, step.state, step.verdicts.folds))
    return out


def fitted_so_far(problem: Problem, state: State, causes: list[Effect]) -> ExtendedModel:
    """The extended model of a state."""
    from .estimates import fitted_model

    return fitted_model(problem, state, causes)


def traces(
    problem: Problem,
    signals: Sequence[Signals],
    before: ExtendedModel,
    after: ExtendedModel,
    causes: list[Effect],
    found: Sequence[Found],
) -> tuple[Trace, ...]:
    """Each recording's rows: measured torque, the model's before and after, the share of each cause."""
    out = []
    for one in signals:
        records = stack([one])
        rows = one.rows.index
        share = {}
        full = _predicted(after, one, records)
        for effect, cause in zip(causes, found, strict=True):
            others = tuple(e for e in after.effects if not _same(e, effect))
            without = ExtendedModel(after.robot, others, after.width)
            share[str(cause.name)] = full - _predicted(without, one, records)
        measured = None if one.torque is None else _filtered(records, one.torque)
        out.append(
            Trace(
                name=one.name,
                role=one.role,
                time=one.time[rows],
                position=one.position[rows],
                velocity=one.velocity[rows],
                measured=measured,
                before=_predicted(before, one, records),
                after=full,
                shares=share,
            )
        )
    return tuple(out)


def _same(one: Effect, other: Effect) -> bool:
    return type(one) is type(other) and np.array_equal(np.asarray(one.at), np.asarray(other.at))


def _predicted(model: ExtendedModel, one: Signals, records: Records) -> Float[np.ndarray, "M nv"]:
    return _filtered(records, np.asarray(predict(model, one.time, one.position, one.velocity, one.acceleration, one.dt)))


def _filtered(records: Records, torque: Float[np.ndarray, "N nv"]) -> Float[np.ndarray, "M nv"]:
    return np.asarray(filter_rows(records, jnp.asarray(torque)[None]))[0]


def _recorded_error(model: ExtendedModel, kept: Sequence[Signals]) -> float:
    errors, powers = 0.0, 0.0
    for one in kept:
        records = stack([one])
        weight = np.asarray(one.rows.weight)
        measured = _filtered(records, one.torque)
        errors += (((measured - _predicted(model, one, records)) * weight) ** 2).sum()
        powers += ((measured * weight) ** 2).sum()
    return float(np.sqrt(errors / powers))


def _fold_error(problem: Problem, state: State, folds: Float[np.ndarray, "folds P"]) -> float:
    rows = plain_rows(problem, state)
    theta = folds[np.maximum(rows.fold, 0)]
    residual = (rows.y - np.einsum("jtp,tp->jt", rows.X, theta, optimize=True)) * (rows.y != 0)
    return float(np.sqrt((residual**2).sum() / (rows.y**2).sum()))
