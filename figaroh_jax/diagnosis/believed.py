"""How far links may move whose inertials are well known: no further than the task believes them.

Enough data move the links wherever they fit best, whatever a prior says of them: a body that is fixed to a link then
shows nowhere but in links far from what is believed, and predicts no better than they do. Where the inertials are
trusted (`TRUSTED`), the squares of their deviations, each over its stated one sigma, stay within what chance makes of
links as they are believed. What lies beyond is left to bodies and links as causes, or to the rest: any other cause must
also predict better beside links that may move, for many follow them some of the way.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..effects.base import Effect
from ..estimation.rows import Prior
from .comparison import FoldSums, coefficients, told
from .problem import Problem
from .thresholds import BEYOND_ANY, BEYOND_TRUST, IMPOSSIBLE

__all__ = ["believed", "impossible_links", "let_go"]

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


def impossible_links(
    problem: Problem,
    causes: Sequence[Effect],
    theta: Float[np.ndarray, " P"],
    covariance: Float[np.ndarray, "parameters parameters"],
) -> tuple[str, ...]:
    """What cannot be of the links as fitted, in words: masses below zero, and links far beyond any stated trust.

    `theta` and its covariance begin with the links' ten parameters each. A payload heavier than the robot counts too.
    """
    nominal, one_sigma = np.asarray(problem.model.inertia, float), 1 / np.sqrt(problem.believed).reshape(-1, 10)
    count = nominal.size
    fitted = theta[:count].reshape(-1, 10)
    std = np.sqrt(np.maximum(np.diag(covariance)[:count], 0.0)).reshape(-1, 10)
    far = (np.abs(fitted - nominal) / one_sigma).max(axis=1)
    check = "check unit and sign of the torque, the clock and robot.gravity"
    out = []
    for name, mass, deviation, times in zip(problem.model.link_names, fitted[:, 0], std[:, 0], far, strict=True):
        if mass < -IMPOSSIBLE * deviation:
            out.append(
                f"the torque asks for a mass of {mass:.3g} +- {1.96 * deviation:.2g} kg of {name}, which no body has:"
                f" {check}"
            )
        elif times > BEYOND_ANY:
            out.append(
                f"the torque asks for a link {name} that is {times:.0f} times as far from the model as robot.trust"
                f" ({problem.trust:.0%}) lets expect: {check}, or say how far the model's inertials are to be trusted"
            )
    weight = float(nominal[:, 0].sum())
    for effect in causes:
        if effect.name == "payload" and float(getattr(effect, "mass", 0.0)) > weight:
            out.append(f"the torque asks for a payload that is heavier than the robot ({weight:.3g} kg): {check}")
    return tuple(out)
