"""Columns of the regressor that follow from those of the link before, and need not be computed.

A mass that stands on the axis of a link's joint might as well be fixed to the link that carries it: for all motions the
columns are the same (Gautier and Khalil 1990). So for a joint that turns about axis k of its link, b and c the other
two, the columns of the mass, of the first moment along k, and of Ibb beside Icc follow from those of the carrying link;
for a joint that slides all six of the inertia, for a spherical one that of the mass. On a link that the world carries
they are zero, or Ibb is -Icc.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from .inertia import transform
from .model import Joint, RobotModel, dofs
from .scalars import LOADED, PER_JOINT, PLACES

__all__ = ["ALL", "Kept", "kept_columns", "orderly", "regrouping"]

ALL = tuple(range(10))
Kept = tuple[tuple[int, ...], ...]  # of each link, those of its ten columns that are computed
ORDERLY = 3  # numbers of a joint's rotation, on average, that may be other than 0, 1, -1
_INERTIA = {0: (6, 9), 1: (4, 9), 2: (4, 6)}  # Ibb and Icc beside axis k


@lru_cache(maxsize=64)
def kept_columns(joints: tuple[Joint, ...], codes: bytes) -> Kept:
    """Columns that are computed where so much is known of the robot (`scalars.known`): all, of an unknown axis."""
    return tuple(tuple(c for c in ALL if c not in _left_out(joints, codes, i)) for i in range(len(joints)))


def orderly(joints: tuple[Joint, ...], codes: bytes) -> bool:
    """Whether the fixed rotations are mostly zeros and ones, so that a program written out leaves much out."""
    by_joint = np.frombuffer(codes, np.int8)[: len(joints) * PER_JOINT].reshape(-1, PER_JOINT)
    unlike = (by_joint[:, PLACES["rotation"] : PLACES["origin"]] == LOADED).sum()
    return bool(unlike <= ORDERLY * len(joints))


def _axis(joints: tuple[Joint, ...], codes: bytes, i: int) -> int | None:
    """About which of its axes link i turns; None where it is another one, or not known before."""
    first = len(joints) * PER_JOINT + 6 * int(dofs(joints).first[i])
    axis = np.frombuffer(codes, np.int8)[first : first + 3]
    along = np.flatnonzero(axis)
    return int(along[0]) if len(along) == 1 and abs(axis[along[0]]) == 1 else None


def _left_out(joints: tuple[Joint, ...], codes: bytes, i: int) -> tuple[int, ...]:
    kind = joints[i].kind
    if kind == "prismatic":
        return ALL[4:]
    if kind == "spherical":
        return ALL[:1]
    axis = _axis(joints, codes, i)
    if kind != "revolute" or axis is None:
        return ()
    return 0, 1 + axis, _INERTIA[axis][0]


def regrouping(model: RobotModel, kept: Kept) -> Float[np.ndarray, "kept columns"]:
    """All columns of the regressor are those that are kept times this; of a model whose numbers are at hand."""
    return _regrouping(model.joints, np.asarray(model.placement, float).tobytes(), kept)


@lru_cache(maxsize=64)
def _regrouping(joints: tuple[Joint, ...], placement: bytes, kept: Kept) -> Float[np.ndarray, "kept columns"]:
    placements = np.frombuffer(placement).reshape(len(joints), 4, 4)
    ends = np.cumsum([0, *map(len, kept)])
    whole = np.zeros((ends[-1], 10 * len(kept)))
    for i, joint in enumerate(joints):
        own = 10 * i + np.arange(10)
        whole[ends[i] + np.arange(len(kept[i])), own[list(kept[i])]] = 1.0
        gone = sorted(set(ALL) - set(kept[i]))
        turning = [column - 1 for column in gone if 1 <= column <= 3]
        for column in gone:
            moved, beside = np.eye(10)[column], None
            if turning and column >= 4:  # what might as well be fixed to the carrying link is Ibb and Icc together
                beside = _INERTIA[turning[0]][1]
                moved = moved + np.eye(10)[beside]
            if joint.parent >= 0:
                above = transform(moved, placements[i])
                whole[:, own[column]] = whole[:, 10 * joint.parent + np.arange(10)] @ above
            if beside is not None:
                whole[:, own[column]] -= whole[:, own[beside]]
    return whole
