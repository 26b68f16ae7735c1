"""What a fit found, the same for every job: the model, its numbers with their uncertainty, and why the solver ended."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..effects.extended import ExtendedModel
from ..errors import InputError
from ..results import Estimate
from .free import Free, Part

if TYPE_CHECKING:
    import optimistix

    from .data import Data

__all__ = ["HIDDEN", "Fit", "numbers"]

SHOWN = 24  # numbers that the text of a fit lists
HIDDEN = 1e-6  # share of a number in directions that nothing determines, above which it is not determined


class Fit(eqx.Module):
    """What a fit found; one of `fit` is a pytree, differentiable through the solution, and a batch under `jax.vmap`.

    `model` is the model with the fitted numbers in it, `parameters` each of them by name with value, sigma and unit;
    `values` (numbers,) are their changes from the model that was given, `covariance` (numbers, numbers) and
    `std` what the rows tell of them, `rank` how many directions data and prior determine. `cost` is half of the squares
    of all rows, `rows` the weighted residual. Covariance and `std` have no gradient (zero): where a deviation is to be
    made small, take `expected_std`, or invert J'J of the Jacobian of `residual`. `result` is
    `optimistix.RESULTS.successful` or why not, `reason` the same in words.
    """

    model: ExtendedModel  # with the numbers in it
    data: tuple[Data, ...]  # with the devices' frames put in
    values: Float[Array | np.ndarray, " numbers"]  # change of each number from the model that was given, SI units
    covariance: Float[Array | np.ndarray, "numbers numbers"]  # for rows of equal variance; without gradient
    hidden: Float[Array | np.ndarray, " numbers"]  # share of each number in directions that nothing determines
    cost: Float[Array | np.ndarray, ""] | float  # half of the squares of rows and prior
    rows: Float[Array | np.ndarray, " rows"]  # weighted residual of the data
    rank: Any  # directions that data and prior determine
    outcome: Any  # of optimistix; None of another solver
    stats: dict[str, Any]
    free: Free = eqx.field(static=True)
    failure: str = eqx.field(static=True, default="")  # why another solver did not end well

    def __repr__(self) -> str:
        robot, names, batch = self.model.robot.name, self.free.names, np.shape(self.values)[:-1]
        head = f"Fit of '{robot}': {len(names)} numbers"
        if batch or isinstance(self.values, Tracer):
            shown = [f"  {name}" for name in names[:SHOWN]]
            head += f", batch {batch}, see `values`, `std` and `model`" if batch else ", traced"
        else:
            rows = np.asarray(self.rows)
            head += f", rank {int(self.rank)}"
            head += f", RMS of {rows.size} rows {np.sqrt(np.mean(rows**2)):.4g}" if rows.size else ""
            head += f"; it did not end well: {self.reason}" if self.reason else ""
            shown = [f"  {name}: {value}" for name, value in islice(self.parameters.items(), SHOWN)]
        more = [f"  ... and {len(names) - SHOWN} more, see `parameters`"] if len(names) > SHOWN else []
        return "\n".join([head, *shown, *more])

    @property
    def result(self) -> optimistix.RESULTS:
        """`optimistix.RESULTS.successful`, or why not."""
        if self.outcome is not None:
            return self.outcome
        import optimistix  # slow to import

        return optimistix.RESULTS.nonlinear_divergence if self.failure else optimistix.RESULTS.successful

    @property
    def reason(self) -> str:
        """Why the solver did not end well, in words; empty where it did."""
        import optimistix

        if isinstance(self.values, Tracer) or np.ndim(self.values) != 1:
            raise InputError(
                "Fit.reason is of one fit: under jit, grad or vmap, and of a batch, take `result`, which has one each:"
                " `result == optimistix.RESULTS.successful`"
            )
        if self.failure or self.outcome is None:
            return self.failure
        return "" if self.outcome == optimistix.RESULTS.successful else optimistix.RESULTS[self.outcome]

    @property
    def std(self) -> Float[np.ndarray, " numbers"]:
        """One sigma of each number; inf where nothing determines it."""
        size = np.sqrt(np.maximum(np.diagonal(np.asarray(self.covariance), axis1=-2, axis2=-1), 0.0))
        return np.where(np.asarray(self.hidden) > HIDDEN, np.inf, size)

    @property
    def parameters(self) -> dict[str, Estimate]:
        """Each number by its name: value, one sigma, unit.

        Of effects, links and gravity the value is the fitted one; of joint offsets, geometry, frames and drives it is
        the change from what was given. Of one fit, outside of `jit` and `grad`: in there, and of a batch, `values`
        and `covariance` stand in the order of `free.names`.
        """
        if isinstance(self.values, Tracer) or np.ndim(self.values) != 1:
            raise InputError(
                "Fit.parameters are plain numbers of one fit: under jit, grad or vmap, and of a batch, take `values`,"
                " whose names are `free.names`"
            )
        values = self.free.held(self.model, np.asarray(self.values))
        each = zip(self.free.names, values, self.std, self.free.units, strict=True)
        return {name: Estimate(float(value), float(std), unit) for name, value, std, unit in each}


def numbers(kind: str, names: Sequence[str], units: Sequence[str], sizes: Sequence[float]) -> Free:
    """Numbers of an engine that has coordinates of its own: named, but not to be given to `fit`."""
    count = len(names)
    return Free((Part(kind, (), tuple(range(count)), (count,), tuple(names), tuple(units), tuple(sizes)),))
