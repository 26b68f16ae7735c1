"""What the measurements can tell of each parameter: identified, or one of a class that moves together."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

__all__ = ["Gauge", "find_gauge"]

_RANK = 1e-5  # of a column, left over by those before it: 1 mm of it would move the tool by 10 nm
_SHARE = 1e-3  # of a dependent column, that a member of its class carries


class Gauge(NamedTuple):
    """Rank and condition of the identifiable columns, and the classes of those that the data cannot tell apart."""

    rank: int
    condition: float  # of the identifiable columns, each of length one
    classes: tuple[tuple[int, ...], ...]  # dependent column first, then those that can take its place
    dependent: frozenset[int]


def find_gauge(jacobian: Float[np.ndarray, "rows columns"], order: list[int]) -> Gauge:
    """Go through the columns in `order` and keep those that the kept ones before do not span (triangular factor)."""
    length = np.linalg.norm(jacobian, axis=0)
    unit = jacobian / np.where(length > 0.0, length, 1.0)
    basis = np.zeros((len(jacobian), 0))
    kept: list[int] = []
    dependent: list[int] = []
    for k in order:
        rest = unit[:, k] - basis @ (basis.T @ unit[:, k])
        rest -= basis @ (basis.T @ rest)  # twice is enough
        size = np.linalg.norm(rest)
        if length[k] > 0.0 and size > _RANK:
            basis = np.column_stack([basis, rest / size])
            kept.append(k)
        else:
            dependent.append(k)
    classes = []
    for k in dependent:
        weights = np.linalg.lstsq(unit[:, kept], unit[:, k], rcond=None)[0] if length[k] > 0.0 else np.zeros(len(kept))
        classes.append((k, *(kept[i] for i in np.flatnonzero(np.abs(weights) > _SHARE))))
    singular = np.linalg.svd(unit[:, kept], compute_uv=False)
    condition = float(singular[0] / singular[-1]) if len(singular) else 1.0
    return Gauge(len(kept), condition, tuple(classes), frozenset(dependent))
