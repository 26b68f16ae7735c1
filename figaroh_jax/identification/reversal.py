"""How sharply dry friction turns round: the half width of each joint's reversal, chosen from a grid.

A gear's friction does not jump. All widths stand in one condensed regression as columns, so a choice costs no pass over
the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from ..estimation.columns import joint_labels
from ..estimation.regression import Condensed, Regression

__all__ = ["WIDTHS", "widths_to_try", "with_reversal_widths"]

WIDTHS = (0.0025, 0.005, 0.01, 0.02, 0.04, 0.08, 0.16)  # rad/s or m/s; zero is the column that is there anyway
GAIN = 10.0  # by which the weighted squares must fall: a smooth reversal has to earn its place


def widths_to_try(regression: Regression) -> tuple[float, ...]:
    """Half widths of which `with_reversal_widths` wants columns beside the regression's own; none without Coulomb."""
    return WIDTHS if any(name.startswith("fc") for name in regression.names) else ()


def with_reversal_widths(
    regression: Regression,
    wide: Condensed,
    kept: Sequence[int] | Int[np.ndarray, " kept"],
    weight: Float[np.ndarray, " nv"],
) -> Regression:
    """The regression with the half width that fits best at each joint that has Coulomb friction.

    `wide` is the regression condensed with the columns of `widths_to_try`; `kept` are the base columns, `weight` the
    joints' inverse variances.
    """
    names = regression.names
    coulomb = [names.index(f"fc{k}") if f"fc{k}" in names else None for k in joint_labels(regression.model)]
    if not any(column in kept for column in coulomb if column is not None):
        return regression
    factor = wide.factor(weight)
    chosen, width = list(kept), np.array(regression.width, float)
    for j, column in enumerate(coulomb):
        if column not in chosen:
            continue
        tried = [column, *(len(names) + j * len(WIDTHS) + k for k in range(len(WIDTHS)))]
        place = chosen.index(column)
        costs = [_cost(factor, [*chosen[:place], other, *chosen[place + 1 :]]) for other in tried]
        best = int(np.argmin(np.array(costs) - GAIN * (np.arange(len(tried)) == 0)))
        chosen[place] = tried[best]
        width[j] = 0.0 if best == 0 else WIDTHS[best - 1]
    return replace(regression, width=width)


def _cost(factor: Float[np.ndarray, "n k"], columns: Sequence[int]) -> float:
    """Squares that the columns leave."""
    return float(np.asarray(np.linalg.qr(factor[:, [*columns, -1]], mode="r"))[-1, -1] ** 2)
