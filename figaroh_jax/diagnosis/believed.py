"""How far links may move whose inertials are well known: no further than the task believes them.

Enough data move the links wherever they fit best, whatever a prior says of them: a body that is fixed to a link then
shows nowhere but in links far from what is believed, and predicts no better than they do. Where the inertials are
trusted (`TRUSTED`), the squares of their deviations, each over its stated one sigma, stay within what chance makes of
links as they are believed. What lies beyond is left to bodies and links as causes, or to the rest: any other cause must
also predict better beside links that may move, for many follow them some of the way.
"""

from __future__ import annotations

import numpy as np

from ..estimation.rows import Prior
from .comparison import FoldSums, coefficients, told
from .problem import Problem
from .thresholds import BEYOND_TRUST

__all__ = ["believed", "let_go"]

TIGHTEST, HALVINGS = 1e8, 30  # times the stated precision; of its logarithm


def believed(problem: Problem, prior: Prior, sums: FoldSums) -> Prior:
    """The prior with the links' precision as stated, or just so much higher that they stay within what is believed."""
    if not problem.bounded:
        return prior
    from scipy.special import chdtri  # scipy is slow to import

    stated = problem.believed
    count = len(stated)

    def tighter(times: float) -> Prior:
        return Prior(prior.mean, np.append(times * stated, prior.precision[count:]))

    def squares(times: float) -> float:
        theta = coefficients(sums, tighter(times))[:count]
        return float(stated @ (theta - prior.mean[:count]) ** 2)

    most = chdtri(told(sums, tighter(1.0), count), BEYOND_TRUST)
    low, high = 1.0, TIGHTEST
    if squares(low) <= most:
        return tighter(low)
    for _ in range(HALVINGS):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if squares(middle) > most else (low, middle)
    return tighter(high)


def let_go(problem: Problem, prior: Prior) -> Prior | None:
    """The prior as stated where it holds links back that would have moved beyond what is believed; else None."""
    if not problem.bounded or prior.precision[0] <= problem.believed[0]:
        return None
    return prior._replace(precision=np.append(problem.believed, prior.precision[len(problem.believed) :]))
