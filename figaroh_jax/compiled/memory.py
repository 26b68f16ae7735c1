"""Memory of large answers, used again once nobody holds the answer any more.

A page of new memory costs the system more than the numbers that go there: for the regressor of a robot of 32 joints
twice the time of computing it. So the memory of the last answers that were given up stays with the process, marked as
free (MADV_FREE): the system takes its pages away when it needs them, and they are zero then. Programs that leave zeros
where they write nothing get memory back that the same program wrote, whose zeros are where they were.
"""

from __future__ import annotations

import ctypes
import mmap
import weakref
from collections import deque
from math import prod
from typing import Any

import numpy as np
from jaxtyping import Float

__all__ = ["give_back_holes", "recycled"]

HOLES = 200_000_000  # bytes that the C library holds for nobody, from which on they are given back
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


class _Heap(ctypes.Structure):
    """What glibc tells of its memory (`mallinfo2`), bytes."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in ("arena", "_1", "_2", "_3", "mapped", "_4", "_5", "used", "free", "at_the_end")
    )


def give_back_holes() -> None:
    """Have the system take pages that the C library holds for nobody, where there are many: glibc alone.

    What large arrays leave is too small for the next ones, or elsewhere than they fit. It costs half a second for a
    gigabyte, so between phases alone.
    """
    try:
        library = ctypes.CDLL(None)
        tell, trim = library.mallinfo2, library.malloc_trim
    except (OSError, AttributeError):
        return
    tell.restype = _Heap
    if tell().free > HOLES:
        trim(0)
