r"""The parameter of an effect that is not linear (a gear's order, a time), between the values of the catalogue's grid.

The profile: what the effect's columns at the shape s take from the sum of squares of the whitened rows, beside all that
is fitted. Its maximum gives s, its curvature the standard deviation, $\sigma^{-2} = -\tfrac12 d^2 / ds^2$.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool

from ..effects.kinematic import Postures, columns_of, shape_of
from ..estimation.marginal import FLAT, Linear, Posterior
from ..estimation.posegroups import Measured
from ..rigid.model import RobotModel
from .candidates import Block, moved_rows, moves, sizes_of, twist_rows

__all__ = ["refine"]

Array = np.ndarray


def refine(
    model: RobotModel,
    postures: Sequence[Postures],
    measured: Measured,
    fit: tuple[Linear, Posterior],
    rows: tuple[Bool[Array, " rows"], Bool[Array, " unknowns"]],
    blocks: Sequence[Block],
) -> list[Block]:
    """Each effect and place of `blocks` once, its shape at the maximum of the profile beside the others.

    `rows` are those used and the unknowns that are free in the `fit` without effects.
    """
    once = list({block.name: block for block in reversed(blocks)}.values())[::-1]
    by_twist = twist_rows(measured, fit[0].at)
    used, free = rows
    linear, posterior = fit
    weight = np.where(linear.posture >= 0, posterior.weight[linear.posture], 1.0)
    scale = (np.sqrt(weight) / posterior.noise[linear.channel])[used]
    root = np.sqrt(np.where(linear.prior[free] == FLAT, 0.0, posterior.precision[free]))
    e = np.concatenate([linear.residual[used] * scale, root * linear.at[free]])

    def tall(block: Block) -> Array:
        Z = moved_rows(measured, by_twist, [moves(column, postures) for column in block.columns])
        return np.vstack([Z[used] * scale[:, None] * block.sizes, np.zeros((len(root), Z.shape[1]))])

    fitted = np.vstack([linear.jacobian[used][:, free] * scale[:, None], np.diag(root)])
    for k, block in enumerate(once):
        if len(shape_of(block.effect)[1]) > 1:
            beside = np.hstack([fitted, *(tall(other) for j, other in enumerate(once) if j != k)])
            basis = np.linalg.svd(beside / np.linalg.norm(beside, axis=0).clip(1e-300), full_matrices=False)[0]
            once[k] = _sharpest(model, postures, block, lambda b, basis=basis: _taken(tall(b), basis, e))
    return once


def _taken(Z: Array, basis: Array, e: Array) -> float:
    """Sum of squares of e that Z explains beside the basis."""
    Z = Z - basis @ (basis.T @ Z)
    return float(np.sum((np.linalg.qr(Z)[0].T @ (e - basis @ (basis.T @ e))) ** 2))


def _sharpest(model: RobotModel, postures: Sequence[Postures], block: Block, taken) -> Block:
    from scipy.optimize import minimize_scalar

    grid = np.array(shape_of(block.effect)[1])
    place = int(np.argmin(np.abs(grid - block.shape)))
    low, high = grid[max(place - 1, 0)], grid[min(place + 1, len(grid) - 1)]
    if block.reach:
        low, high = block.shape - block.reach, block.shape + block.reach
    at = tuple(model.tree_index(name) for name in block.columns[0].at)

    def moved(shape: float) -> Block:
        columns = columns_of(block.effect, model, at, shape)
        return block._replace(columns=columns, sizes=tuple(sizes_of(columns, postures)), shape=shape)

    best: Any = minimize_scalar(
        lambda s: -taken(moved(s)), bounds=(float(low), float(high)), method="bounded", options={"xatol": 1e-3}
    )
    shape, step = float(best.x), 0.02 * float(high - low)
    bend = 2.0 * taken(moved(shape)) - taken(moved(shape - step)) - taken(moved(shape + step))
    return moved(shape)._replace(shape_std=float(step * np.sqrt(2.0 / bend)) if bend > 0.0 else float("inf"))
