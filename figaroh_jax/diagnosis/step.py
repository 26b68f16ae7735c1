"""Where a search for causes stands, and where it stands with one cause more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect
from ..estimation.rows import Linear, Prior, Rows, fit
from .believed import believed, let_go
from .comparison import FoldSums, Hypothesis, Verdicts, coefficients, grown_sums, judge
from .design import kind
from .problem import Problem
from .state import State, assembled, extended_state, solved, whitened, with_size

__all__ = ["Step", "stand", "with_cause", "with_causes"]


@dataclass(frozen=True)
class Step:
    """Where a search stands: the state, its rows and the normal equations of their folds."""

    state: State
    rows: Rows
    folded: FoldSums
    loose: Prior | None = None  # as stated, where the state's prior holds links back (`believed`)

    @cached_property
    def linear(self) -> Linear:
        """The instrumented fit."""
        return fit(self.rows, self.state.prior, self.folded.gram.sum(0))

    @cached_property
    def verdicts(self) -> Verdicts:
        """What the data say of the state, on rows that it was not fitted to."""
        return judge(self.rows, Hypothesis(self.rows.X, self.state.prior), self.folded)

    @cached_property
    def free(self) -> Verdicts:
        """The same with links that no trust holds back."""
        if self.loose is None:
            return self.verdicts
        return judge(self.rows, Hypothesis(self.rows.X, self.loose), self.folded)


def stand(problem: Problem, state: State, whitening: Float[np.ndarray, "F nv"], before: Step | None = None) -> Step:
    """Rows and fit of a state, which comes back with its coefficients.

    `before` is where the search stood when this state has grown out of it.
    """
    rows = whitened(problem, state, whitening)
    same = before is not None and len(before.state.sensors) == len(state.sensors) and before.state.cut is state.cut
    if before is not None and same:
        folded = grown_sums(rows, before.folded, rows.X.after(before.folded.moment.shape[1]))
    else:
        folded = problem.filtered.sums(rows)
    state = replace(state, prior=believed(problem, state.prior, folded))
    solution = solved(state, coefficients(folded, state.prior))
    return Step(solution, rows, folded, let_go(problem, state.prior))


def with_cause(problem: Problem, step: Step, effect: Effect, whitening: Float[np.ndarray, "F nv"]) -> Step:
    """The search with one more cause; a shift of the position follows the load of the fit that it stands in."""
    grown = stand(problem, extended_state(problem, step.state, effect), whitening, step)
    if kind(effect) != "position":
        return grown
    base = solved(step.state, grown.state.theta)
    del grown  # its rows and columns are large
    return stand(problem, extended_state(problem, base, effect), whitening)


def with_causes(
    problem: Problem, start: State, causes: Sequence[Effect], whitening: Float[np.ndarray, "F nv"], keep: bool = False
) -> Step:
    """All causes in at once, each at its size where it comes in.

    What follows the torque (a late sensor, friction by load) sees that of the coefficients of `start` and of the causes
    before it; what follows all torque together (a drive at its limit), that of all causes. `keep`: other fits will have
    the same first causes, up to some sensor.
    """

    def grow(state: State, first: Sequence[Effect]) -> State:
        if kind(first[-1]) == "columns":
            return with_size(problem, state, first[-1])
        known = problem.begun.get(start, whitening, *first)
        if known is None:
            known = with_size(problem, stand(problem, state, whitening).state, first[-1])
            if keep:
                problem.begun.put(known, start, whitening, *first)
        return known

    return stand(problem, assembled(problem, start, causes, grow), whitening)
