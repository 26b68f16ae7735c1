"""A regression on states that are known already (position, velocity, acceleration, torque), streamed in chunks.

For simulated or prepared data, of any length: the source is read chunk by chunk, as often as a fit asks, and only one
chunk's columns exist at a time. `Regression` is for recordings, which have to be filtered first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..effects.base import Effect
from ..errors import InputError
from ..rigid.model import RobotModel
from .base_parameters import BaseParameters, base_parameters
from .columns import STATES, column_names, state_columns, structural_columns
from .regression import Piece

__all__ = ["OwnFrame", "States", "check_piece", "read_pieces"]


class OwnFrame(NamedTuple):
    """Of one joint's rows: columns that can differ from zero, and coordinates in which they are well conditioned.

    The rows of the `kept` ones, which are independent, are `kept @ into` there, and `z @ back` are those of all.
    """

    columns: Int[np.ndarray, " own"]
    kept: Int[np.ndarray, " rank"]
    into: Float[np.ndarray, "rank rank"]
    back: Float[np.ndarray, "rank own"]


CHUNK_BYTES = 8e6  # of a chunk's columns: they stay in the processor's cache
FEWEST = 256  # samples of a chunk, however wide


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

    @cached_property
    def structural(self) -> BaseParameters:
        """Base parameters that some motion could show."""
        rows = self.structure.reshape(-1, len(self.names))
        return base_parameters(np.linalg.qr(rows, mode="r") / np.sqrt(len(rows)), self.names)

    @cached_property
    def frames(self) -> tuple[OwnFrame, ...]:
        """Coordinates of each joint's rows, from random states, so many that the widest have twice their columns."""
        own = [np.flatnonzero(row) for row in self.used]
        factors, samples = [np.zeros((0, len(mine))) for mine in own], 0
        for seed in range(max(1, -(-2 * max(map(len, own)) // STATES))):
            X = structural_columns(self.model, self.terms, STATES, seed)
            both = [np.concatenate([R, X[:, j, mine]]) for j, (R, mine) in enumerate(zip(factors, own, strict=True))]
            factors, samples = [np.asarray(np.linalg.qr(rows, mode="r")) for rows in both], samples + len(X)
        return tuple(_frame(mine, R / np.sqrt(samples)) for mine, R in zip(own, factors, strict=True))

    def pieces(self, widths: Sequence[float] = (), fitted: bool = True) -> Iterator[Piece]:
        """Chunks of rows, all of one size but the last of each piece, which is filled up with rows of no weight."""
        del fitted
        chunk = max(FEWEST, int(CHUNK_BYTES / 8 / self.model.nv / max(len(self.names), 1)))
        width = jnp.broadcast_to(np.asarray(self.width, float), (self.model.nv,))
        count = 0
        for number, part in enumerate(self.source()):
            check_piece(self.model, part, number)
            for start in range(0, len(part[0]), chunk):
                block = [np.asarray(x[start : start + chunk], float) for x in part]
                n = len(block[0])
                filled = [np.concatenate([x, np.repeat(x[-1:], chunk - n, axis=0)]) if n < chunk else x for x in block]
                with jax.enable_x64(True):
                    X = state_columns(self.model, self.terms, width, tuple(widths), *filled[:3])
                weight = np.repeat(np.arange(chunk)[:, None] < n, self.model.nv, axis=1).astype(float)
                index = count + np.arange(chunk)
                yield Piece(X, filled[3], weight, index.astype(float), index // FEWEST % 5, 0)
                count += n


def _frame(own: Int[np.ndarray, " own"], factor: Float[np.ndarray, "k own"]) -> OwnFrame:
    base = base_parameters(factor, [str(k) for k in own])
    R = np.linalg.qr(factor[:, base.independent], mode="r")
    return OwnFrame(own, own[base.independent], np.linalg.inv(R), R @ base.matrix)


def read_pieces(files: Sequence[str | Path], samples: int = 20_000) -> Iterator[tuple[np.ndarray, ...]]:
    """Pieces of `samples` rows of the .npy files of q, v, a and tau, read one after another.

    Unlike arrays mapped by `numpy.load(mmap_mode="r")`, what was read does not stay in memory. Raises `InputError`
    where a file is no .npy file of numbers in rows, or has another number of rows than the first.

    >>> import tempfile, numpy as np, figaroh_jax as fj
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     files = [f"{folder}/{name}.npy" for name in ("q", "v", "a", "tau")]
    ...     for file in files:
    ...         np.save(file, np.zeros((50000, 4)))
    ...     [len(q) for q, v, a, tau in fj.states.read_pieces(files)]
    [20000, 20000, 10000]
    """
    arrays = [_mapped(Path(file)) for file in files]
    for file, array in zip(files, arrays, strict=True):
        if array.ndim != 2 or len(array) != len(arrays[0]):
            raise InputError(f"{file} has shape {array.shape}, expected {len(arrays[0])} rows as in {files[0]}")
    for start in range(0, len(arrays[0]), samples):
        yield tuple(_rows_of(array, start, samples) for array in arrays)


def _mapped(file: Path) -> np.memmap:
    try:
        array = np.load(file, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(f"{file} cannot be read as an .npy file: {error}") from error
    if not isinstance(array, np.memmap) or array.dtype.kind not in "fiu" or not array.flags.c_contiguous:
        raise InputError(f"{file}: expected an .npy file of numbers, rows first (C order)")
    return array


def _rows_of(array: np.memmap, start: int, samples: int) -> np.ndarray:
    count, width = min(samples, len(array) - start), array.shape[1]
    offset = array.offset + start * width * array.itemsize
    return np.fromfile(array.filename or "", array.dtype, count * width, offset=offset).reshape(count, width)


def check_piece(model: RobotModel, part: Sequence[Any], number: int, *, values: bool = True) -> None:
    """Refuse a piece of states with arrays of wrong shapes or, with `values`, a number that is not finite.

    >>> import numpy as np, figaroh_jax as fj
    >>> x = np.zeros((100, 4))
    >>> fj.states.check_piece(fj.load_urdf(fj.DEMO), (x, x, x, x), 0)
    """
    samples = len(part[0])
    shapes = [(samples, model.nq), *[(samples, model.nv)] * 3]
    for name, x, shape in zip(("q", "v", "a", "tau"), part, shapes, strict=True):
        if np.shape(x) != shape:
            raise InputError(f"piece {number} of the source: {name} has shape {np.shape(x)}, expected {shape}")
        wrong = ~np.isfinite(np.asarray(x)) if values else np.zeros(0, bool)
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            raise InputError(f"piece {number} of the source: {name} is not finite in row {row}, column {column}")
