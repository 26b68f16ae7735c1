"""Opening a file that a user names: what is no plain, readable file of a bearable size is one message."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from ..errors import InputError, check_path, nearest

__all__ = ["USD", "model_format", "plain_file", "read_file"]

USD = (".usd", ".usda", ".usdc", ".usdz")


def model_format(path: str | Path) -> str:
    """Format of a robot's file by its name, `urdf`, `mjcf` or `usd`; `InputError` for other names."""
    check_path("path", path)
    suffix = Path(path).suffix.lower()
    known = {".urdf": "urdf", ".xml": "mjcf", ".mjcf": "mjcf"} | dict.fromkeys(USD, "usd")
    if suffix not in known:
        text = "a robot model is a .urdf or an .xml (MJCF) file, or USD (.usd, .usda, .usdc, .usdz)"
        near = "" if Path(path).exists() else nearest(Path(path).name, _beside(Path(path), tuple(known)))
        raise InputError(f"{path} does not exist{near}; {text}" if near else f"{path}: {text}")
    return known[suffix]


def plain_file(path: Path, name: str, what: str, largest: int, suffixes: tuple[str, ...] = ()) -> int:
    """Size in bytes of a plain file that can be read and is not empty; `InputError` for anything else.

    `name` stands in the message and `what` says what is expected ("a recording file"); a pipe or a device, from which
    reading may never end, is refused. For a missing file, the nearest name with one of `suffixes` beside it is named.
    """
    try:
        info = os.stat(path)
    except FileNotFoundError:
        raise InputError(f"{name} does not exist{nearest(path.name, _beside(path, suffixes))}") from None
    except ValueError:
        raise InputError(f"{name}: a null byte in the name; {what} is expected") from None
    except OSError as error:
        raise InputError(f"{name} cannot be read: {error.strerror or error}") from None
    if stat.S_ISDIR(info.st_mode):
        raise InputError(f"{name} is a directory, expected {what}")
    if not stat.S_ISREG(info.st_mode):
        raise InputError(f"{name} is a pipe, a socket or a device, expected {what}")
    if info.st_size == 0:
        raise InputError(f"{name} is empty; expected {what}")
    if info.st_size > largest:
        raise InputError(f"{name} has {info.st_size} bytes; {what} has at most {largest}")
    return info.st_size


def read_file(path: Path, name: str, what: str, largest: int, suffixes: tuple[str, ...] = ()) -> bytes:
    """Content of a file that `plain_file` accepts."""
    plain_file(path, name, what, largest, suffixes)
    try:
        with path.open("rb") as file:
            return file.read(largest)
    except OSError as error:
        raise InputError(f"{name} cannot be read: {error.strerror or error}") from None


def _beside(path: Path, suffixes: tuple[str, ...]) -> list[str]:
    try:
        return sorted(name for name in os.listdir(path.parent) if Path(name).suffix.lower() in suffixes)[:1000]
    except OSError:
        return []
