"""Memory of large answers, used again once nobody holds the answer any more.

A page of new memory costs the system more than the numbers that go there: for the regressor of a robot of 32 joints
twice the time of computing it. So the memory of the last answers that were given up stays with the process, marked as
free (MADV_FREE): the system takes its pages away when it needs them, and they are zero then. Programs that leave zeros
where they write nothing get memory back that the same program wrote, whose zeros are where they were.
"""

from __future__ import annotations

import mmap
import weakref
from collections import deque
from math import prod
from typing import Any

import numpy as np
from jaxtyping import Float

__all__ = ["recycled"]

LEAST, MOST, LATEST = 1 << 20, 1 << 31, 2  # bytes of an answer; answers whose memory is kept
_FREE = getattr(mmap, "MADV_FREE", None)
_shelf: deque[tuple[tuple[Any, int], mmap.mmap]] = deque()


def recycled(owner: Any, shape: tuple[int, ...]) -> Float[np.ndarray, "..."] | None:
    """Memory for an answer of `owner`: zero, but where the owner has written before. None where it is not worth it.

    The arrays that the owner writes must be told from each other by their size.
    """
    size = 8 * prod(shape)
    if _FREE is None or not LEAST <= size <= MOST:
        return None
    key = (owner, size)
    block = _taken(key)
    if block is None:
        block = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        if hasattr(mmap, "MADV_HUGEPAGE"):
            _advise(block, mmap.MADV_HUGEPAGE)
    whole = np.frombuffer(block, float)  # all views of it hold this array, since what it holds itself is none
    weakref.finalize(whole, _given_back, key, block).atexit = False
    return whole.reshape(shape)


def _taken(key: tuple[Any, int]) -> mmap.mmap | None:
    """A block of this key; the others go back to the shelf. Another thread may take one in between."""
    for _ in range(len(_shelf)):
        try:
            found = _shelf.popleft()
        except IndexError:
            return None
        if found[0] == key:
            return found[1]
        _shelf.append(found)
    return None


def _given_back(key: tuple[Any, int], block: mmap.mmap) -> None:
    if _FREE is None or not _advise(block, _FREE):
        return
    _shelf.append((key, block))
    while len(_shelf) > LATEST:
        try:
            _shelf.popleft()
        except IndexError:
            return


def _advise(block: mmap.mmap, advice: int) -> bool:
    try:
        block.madvise(advice)
    except OSError:
        return False
    return True
