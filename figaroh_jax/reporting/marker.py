"""The marker of a run directory: which files the run wrote, and whether they are still as it wrote them."""

from __future__ import annotations

import hashlib
import json
import os
import stat
import sys
from collections.abc import Collection, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

__all__ = [
    "LARGEST",
    "MARKER",
    "altered",
    "below",
    "digest",
    "marker_text",
    "seal",
    "synchronise",
    "unchanged",
    "written",
]

MARKER = "figaroh-jax-run.json"
LARGEST = 1 << 20  # bytes of it


def altered(place: Path, left: Collection[str]) -> str | None:
    """What in a run directory is not as the run wrote it; files called as in `left` do not count."""
    files = written(place)
    if files is None:
        return f"its {MARKER} is damaged, so it is unknown which files the run wrote; choose another directory"
    folders = {str(parent) for name in files for parent in PurePosixPath(name).parents}
    for path in below(place):
        name = path.relative_to(place).as_posix()
        info = path.lstat()
        if name in left and stat.S_ISREG(info.st_mode):
            continue
        if name == MARKER or stat.S_ISDIR(info.st_mode) and name in folders:
            continue
        if name not in files:
            return f"'{name}' was not written by the run that is there; move it away or name another directory"
        if not unchanged(path, files[name]):
            return f"'{name}' was changed after the run wrote it; move it away or name another directory"
    return None


def below(folder: Path) -> Iterator[Path]:
    """Everything in a folder, links not followed, a folder before what is in it."""
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
        yield Path(entry.path)
        if entry.is_dir(follow_symlinks=False):
            yield from below(Path(entry.path))


def written(place: Path) -> dict[str, Any] | None:
    """The files that the marker lists, by name; None where it is not one that a run wrote."""
    marker = place / MARKER
    if not stat.S_ISREG(marker.lstat().st_mode) or marker.stat().st_size > LARGEST:
        return None
    try:
        content = json.loads(marker.read_bytes())
        files = content["files"]
        own = content["format"] == 1 and content["sha256"] == digest(_canonical(files))
        good = all(
            isinstance(name, str)
            and not PurePosixPath(name).is_absolute()
            and ".." not in PurePosixPath(name).parts
            and set(entry) == {"bytes", "sha256"}
            for name, entry in files.items()
        )
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    return files if own and good else None


def _canonical(files: dict[str, Any]) -> bytes:
    return json.dumps(files, sort_keys=True).encode()


def digest(data: bytes) -> str:
    """SHA-256 in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def unchanged(path: Path, entry: dict[str, Any]) -> bool:
    """Whether a file is as its `entry` in the marker says."""
    info = path.lstat()
    plain = stat.S_ISREG(info.st_mode) and info.st_size == entry["bytes"]
    return plain and _file_digest(path) == entry["sha256"]


def seal(new: Path) -> None:
    """Write the marker of a finished run, and have everything on the disk before it takes its place."""
    files = {
        path.relative_to(new).as_posix(): {"bytes": path.stat().st_size, "sha256": _file_digest(path)}
        for path in below(new)
        if not path.is_dir() and path != new / MARKER
    }
    (new / MARKER).write_text(marker_text(files), encoding="utf-8")
    for path in [*below(new), new]:
        synchronise(path)


def marker_text(files: dict[str, Any]) -> str:
    """The marker's text for these files."""
    content = {"format": 1, "what": "files of this run; a directory that holds others is never replaced"}
    content |= {"files": files, "sha256": digest(_canonical(files))}
    return json.dumps(content, indent=1) + "\n"


def synchronise(path: Path) -> None:
    """Have a file or folder on the disk."""
    if path.is_dir() and sys.platform == "win32":
        return  # folders cannot be opened there
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
