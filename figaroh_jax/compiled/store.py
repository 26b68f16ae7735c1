"""A folder of files of which only those are read that this user's own processes wrote, as they wrote them.

What a compiler keeps on disk is code: whoever can plant a file there runs what he likes. Every entry therefore begins
with an HMAC-SHA256 of its name and content under a key that stands elsewhere, readable by the user alone; the folder
belongs to the user, is no link, and nobody else may look into it. All of it is checked at every read. Whatever is not
so (planted, damaged, a link, a pipe, a folder of somebody else, a full disk) reads as absent and is never an error.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import stat
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

__all__ = ["Store", "cache_home"]

_KEY_BYTES = 32
_TAG_BYTES = 32
_LARGEST = 1 << 28  # bytes of an entry
_OPEN = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)


class Store:
    """Entries by name in one folder, which is made when something is first put into it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, name: str) -> bytes | None:
        """The entry as it was put; None where there is none that this user's processes wrote."""
        with suppress(OSError, ValueError):
            key = _key()
            if key is None or not _private(self.folder):
                return None
            data = _read(self.folder / name)
            if data is not None and hmac.compare_digest(data[:_TAG_BYTES], _tag(key, name, data[_TAG_BYTES:])):
                return data[_TAG_BYTES:]
        return None

    def put(self, name: str, data: bytes) -> None:
        """Keep the entry, in place of what has its name; where that cannot be, nothing happens."""
        beside = self.folder / f"{name}.{secrets.token_hex(8)}"
        with suppress(OSError, ValueError):
            key = _key()
            if key is None or not _made_private(self.folder):
                return
            try:
                _write(beside, _tag(key, name, data) + data)
                beside.replace(self.folder / name)
            except BaseException:
                beside.unlink(missing_ok=True)
                raise


def cache_home() -> Path | None:
    """The user's folder for what can be made again (`XDG_CACHE_HOME`, else `~/.cache`); None for one without a home."""
    told = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if told.is_absolute():
        return told / "figaroh_jax"
    try:
        return Path("~/.cache").expanduser() / "figaroh_jax"
    except RuntimeError:
        return None


def _key() -> bytes | None:
    """The user's own key, made when it is first needed; None where it cannot be kept."""
    home = cache_home()
    return None if home is None else _key_in(home)


@lru_cache(maxsize=4)
def _key_in(home: Path) -> bytes | None:
    file = home / "key"
    with suppress(OSError):
        if not _made_private(home):
            return None
        for _ in range(2):
            found = _read(file, private=True)
            if found is not None and len(found) == _KEY_BYTES:
                return found
            if os.path.lexists(file):  # cut short, or others could read it: what it signed is made anew
                file.unlink()
            beside = home / f"key.{secrets.token_hex(8)}"
            _write(beside, secrets.token_bytes(_KEY_BYTES))
            with suppress(FileExistsError):  # another process was first: its key is the one
                os.link(beside, file)
            beside.unlink()
        return _read(file, private=True)
    return None


def _tag(key: bytes, name: str, data: bytes) -> bytes:
    signed = hmac.new(key, name.encode() + b"\0", hashlib.sha256)
    signed.update(data)
    return signed.digest()


def _own(info: os.stat_result) -> bool:
    return not hasattr(os, "geteuid") or info.st_uid == os.geteuid()


def _private(folder: Path) -> bool:
    info = folder.lstat()
    return stat.S_ISDIR(info.st_mode) and _own(info) and (os.name == "nt" or not info.st_mode & 0o077)


def _made_private(folder: Path) -> bool:
    """Whether the folder is there for this user alone; one of the user's own that others may look into is closed."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    info = folder.lstat()
    if stat.S_ISDIR(info.st_mode) and _own(info) and info.st_mode & 0o077:
        folder.chmod(0o700)
    return _private(folder)


def _read(path: Path, private: bool = False) -> bytes | None:
    """Content of a plain file of the user's, else None; links are not followed, and nobody waits for a pipe."""
    try:
        handle = os.open(path, _OPEN)
    except OSError:
        return None
    with open(handle, "rb") as file:
        info = os.fstat(file.fileno())
        readable = private and os.name != "nt" and info.st_mode & 0o077
        if not stat.S_ISREG(info.st_mode) or not _own(info) or readable or info.st_size > _LARGEST:
            return None
        return file.read(_LARGEST)


def _write(path: Path, data: bytes) -> None:
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(data)
