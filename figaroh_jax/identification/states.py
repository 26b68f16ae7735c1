"""A regression on states that are known already (position, velocity, acceleration, torque), streamed in chunks.

For simulated or prepared data, of any length: the source is read chunk by chunk, as often as a fit asks, and only one
chunk's columns exist at a time. `Regression` is for recordings, which have to be filtered first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..effect import Effect
from ..errors import InputError
from ..model import RobotModel
from .base_parameters import BaseParameters, base_parameters
from .regression import Piece, column_names, state_columns, structural_columns

__all__ = ["States"]

CHUNK_BYTES = 48e6  # of a chunk's columns
FEWEST = 128  # samples of a chunk, however wide


@dataclass(frozen=True)
class States:
    """Rows for `regression.condense` from states.

    `source` gives, each time it is called, pieces (q, v, a, tau) with the samples first (rad, m, N m, N), of any
    lengths: arrays mapped from disk, files read one after another. `terms` are effects with a leading axis of places
    (`regression.friction_terms`), `width` the half width of dry friction's reversal (rad/s or m/s).
    """

    model: RobotModel
    source: Callable[[], Iterable[Sequence[Any]]]
    terms: tuple[Effect, ...] = ()
    width: float | Float[np.ndarray, " nv"] = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return column_names(self.model, self.terms)

    @cached_property
    def structure(self) -> Float[np.ndarray, "samples nv columns"]:
        """Columns at random states."""
        return structural_columns(self.model, self.terms)

    @property
    def used(self) -> Bool[np.ndarray, "nv columns"]:
        """Which columns of a joint's rows can differ from zero: what `condense` and `solve` ask for."""
        return np.asarray(np.abs(self.structure).max(axis=0) > 0)

    @property
    def structural(self) -> BaseParameters:
        """Base parameters that some motion could show."""
        return base_parameters(self.structure.reshape(-1, len(self.names)), self.names)

    def pieces(self, widths: Sequence[float] = (), fitted: bool = True) -> Iterator[Piece]:
        """Chunks of rows, all of one size but the last of each piece, which is filled up with rows of no weight."""
        del fitted
        chunk = max(FEWEST, int(CHUNK_BYTES / 8 / self.model.nv / max(len(self.names), 1)))
        width = jnp.broadcast_to(np.asarray(self.width, float), (self.model.nv,))
        count = 0
        for number, part in enumerate(self.source()):
            _check(self.model, part, number)
            for start in range(0, len(part[0]), chunk):
                block = [np.asarray(x[start : start + chunk], float) for x in part]
                n = len(block[0])
                filled = [np.concatenate([x, np.repeat(x[-1:], chunk - n, axis=0)]) if n < chunk else x for x in block]
                with jax.enable_x64(True):
                    X = np.asarray(state_columns(self.model, self.terms, width, tuple(widths), *filled[:3]))
                weight = np.repeat(np.arange(chunk)[:, None] < n, self.model.nv, axis=1).astype(float)
                index = count + np.arange(chunk)
                yield Piece(X, filled[3], weight, index.astype(float), index // FEWEST % 5, 0)
                count += n


def _check(model: RobotModel, part: Sequence[Any], number: int) -> None:
    samples = len(part[0])
    shapes = [(samples, model.nq), *[(samples, model.nv)] * 3]
    for name, x, shape in zip(("q", "v", "a", "tau"), part, shapes, strict=True):
        if np.shape(x) != shape:
            raise InputError(f"piece {number} of the source: {name} has shape {np.shape(x)}, expected {shape}")
        wrong = ~np.isfinite(np.asarray(x))
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            raise InputError(f"piece {number} of the source: {name} is not finite in row {row}, column {column}")
