"""Where a search for causes stands, and where it stands with one cause more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect
from ..estimation.rows import Linear, Rows, fit
from .comparison import FoldSums, Hypothesis, Verdicts, fold_sums, grown_sums, judge
from .design import kind
from .problem import Problem
from .state import State, extended_state, solved, whitened

__all__ = ["Step", "stand", "with_cause", "with_causes"]


@dataclass(frozen=True)
class Step:
    """Where a search stands: the state, its rows and fit."""

    state: State
    rows: Rows
    linear: Linear
    verdicts: Verdicts
    folded: FoldSums


def stand(problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"], before: Step | None = None) -> Step:
    """Rows, fit and held-out squares of a state; the state comes back with its coefficients.

    `before` is where the search stood when this state has grown out of it.
    """
    shared = before.rows if before is not None and len(before.state.sensors) == len(state.sensors) else None
    rows = whitened(problem, state, whitening, shared)
    folded = fold_sums(rows, rows.X) if before is None or shared is None else grown_sums(rows, before.folded, rows.X)
    linear = fit(rows, state.prior, folded.gram.sum(0))
    verdicts = judge(rows, Hypothesis(rows.X, state.prior), folded)
    return Step(solved(problem, state, verdicts.theta), rows, linear, verdicts, folded)


def with_cause(problem: Problem, step: Step, effect: Effect, whitening: Float[np.ndarray, "F nv"]) -> Step:
    """The search with one more cause; a shift of the position follows the load of the fit that it stands in."""
    grown = stand(problem, extended_state(problem, step.state, effect), whitening, step)
    if kind(effect) != "position":
        return grown
    base = solved(problem, step.state, grown.state.theta)
    return stand(problem, extended_state(problem, base, effect), whitening)


def with_causes(problem: Problem, start: State, causes: Sequence[Effect], whitening: Float[np.ndarray, "F nv"]) -> Step:
    """All causes in at once (sensor effects see the torque of the baseline and of the causes before them)."""
    state = start
    for effect in causes:
        if kind(effect) != "columns":
            state = stand(problem, state, whitening).state
        state = extended_state(problem, state, effect)
    return stand(problem, state, whitening)
