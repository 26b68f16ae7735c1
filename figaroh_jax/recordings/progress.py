"""How far the reading of a file is, told to whoever listens; light, for a command starts with it."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar

__all__ = ["listener", "told"]

listener: ContextVar[Callable[[str, float], None]] = ContextVar("listener", default=lambda phase, share: None)


def told(phase: str, share: float) -> None:
    """Say to whoever listens (`listener`) that `share` of a file is read."""
    listener.get()(phase, share)
