"""Products with rows `(joint, row, column)` that leave out the columns which a joint has not.

A link is in the torque of the joints that carry it, and a friction in that of its own joint: of a humanoid's rows six
sevenths are zero, of an arm's more than half. Which columns a joint has is looked up once for each array of rows; these
are not written to afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from weakref import ref

import numpy as np
from jaxtyping import Bool, Float, Int

__all__ = ["dense", "know_spans", "places", "products", "pulled", "spans", "squares", "times"]

GAP = 8  # columns of zeros between others that are multiplied with them

Spans = tuple[tuple[slice, ...], ...]

_KNOWN: dict[int, tuple[ref[np.ndarray], Spans]] = {}  # by the address of the rows, while they live


def spans(X: Float[np.ndarray, "nv T P"]) -> Spans:
    """The columns that each joint has, as ranges; outside them its rows are zero."""
    known = _KNOWN.get(id(X))
    if known is not None and known[0]() is X:
        return known[1]
    return know_spans(X, [columns.any(0) for columns in X])


def know_spans(X: Float[np.ndarray, "nv T P"], used: Sequence[Bool[np.ndarray, " P"]]) -> Spans:
    """Keep for `spans` which columns of each joint may be other than zero."""
    key, found = id(X), tuple(_ranges(np.flatnonzero(own)) for own in used)
    _KNOWN[key] = ref(X, lambda _: _KNOWN.pop(key, None) and None), found
    return found


def _ranges(used: Int[np.ndarray, " used"]) -> tuple[slice, ...]:
    if not len(used):
        return ()
    ends = [0, *(np.flatnonzero(np.diff(used) > GAP) + 1).tolist(), len(used)]
    return tuple(slice(int(used[a]), int(used[b - 1]) + 1) for a, b in pairwise(ends))


def dense(columns: Float[np.ndarray, "T P"], own: tuple[slice, ...]) -> Float[np.ndarray, "T p"]:
    """The columns of one joint side by side, without the zeros between its ranges `own`."""
    if len(own) == 1:
        return columns[:, own[0]]
    return np.concatenate([columns[:, one] for one in own] or [columns[:, :0]], axis=1)


def times(X: Float[np.ndarray, "nv T P"], theta: Float[np.ndarray, "P *k"]) -> Float[np.ndarray, "nv T *k"]:
    """X theta, joint by joint."""
    out = np.zeros((*X.shape[:2], *theta.shape[1:]))
    for joint, own in enumerate(spans(X)):
        for one in own:
            out[joint] += X[joint, :, one] @ theta[one]
    return out


def pulled(X: Float[np.ndarray, "nv T P"], residual: Float[np.ndarray, "*draws nv T"]) -> Float[np.ndarray, "*draws P"]:
    """X'r of the rows of all joints, in the precision of the residuals."""
    out = np.zeros((*residual.shape[:-2], X.shape[2]), residual.dtype)
    for joint, own in enumerate(spans(X)):
        for one in own:
            out[..., one] += residual[..., joint, :] @ X[joint, :, one].astype(residual.dtype, copy=False)
    return out


def squares(X: Float[np.ndarray, "nv T P"], weight: Float[np.ndarray, " nv"] | None = None) -> Float[np.ndarray, "P P"]:
    """X'X of the rows of all joints, each joint's times its weight."""
    return products(X, X, weight)


def products(
    X: Float[np.ndarray, "nv T P"], Z: Float[np.ndarray, "nv T k"], weight: Float[np.ndarray, " nv"] | None = None
) -> Float[np.ndarray, "P k"]:
    """X'Z of the rows of all joints, each joint's times its weight."""
    out = np.zeros((X.shape[2], Z.shape[2]))
    for joint, (own, its) in enumerate(zip(spans(X), spans(Z), strict=True)):
        if not (own and its):
            continue
        left = dense(X[joint], own)
        one = left.T @ (left if Z is X else dense(Z[joint], its))
        out[np.ix_(places(own), places(its))] += one if weight is None else weight[joint] * one
    return out


def places(own: tuple[slice, ...]) -> Int[np.ndarray, " p"]:
    """The columns in ranges, one by one."""
    return np.concatenate([np.arange(one.start, one.stop) for one in own] or [np.zeros(0, int)])
