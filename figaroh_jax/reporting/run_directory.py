"""Run directories: written whole or not at all, and replaced only where all that they hold was written by a run.

A finished run holds a marker, `figaroh-jax-run.json`, with the size and the SHA-256 of every file that was written.
An existing directory is replaced only where its marker is intact and nothing in it was added or changed since; what a
user put there stops the run before any work. A new run is made in a hidden folder beside the directory and takes its
place in one step of the file system (`renameat2` with `RENAME_EXCHANGE`) where the system has it.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import json
import os
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

from ..errors import InputError

__all__ = ["MARKER", "add_to_run", "check_directory", "task_inputs", "whole_directory"]

MARKER = "figaroh-jax-run.json"
_WORK = ".figaroh-jax-"  # prefix of the hidden folder in which a run is made
_LARGEST_MARKER = 1 << 20  # bytes
_OLD_RUNS = ("answer.json", "result.json")  # what versions without a marker left
_REFERENCES = re.compile(rb"""\b(?:file|filename)\s*=\s*["']([^"'\0]{1,1000})["']""")  # of an XML file to others
_REASONS = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EROFS: "the file system is read-only",
    errno.ENAMETOOLONG: "the name is too long",
    errno.EACCES: "permission denied",
    errno.EPERM: "the operation is not permitted",
    errno.ENOENT: "a folder on the way vanished or does not exist",
    errno.ENOTDIR: "a part of the path is a file, no directory can stand below it",
    errno.ELOOP: "symbolic links on the way form a loop",
    errno.EIO: "the device reports an input/output error",
    errno.EXDEV: "the system cannot rename the directory (a part of a container's image?)",
    errno.EBUSY: "the system is using the directory (a mount point?)",
}


def check_directory(out: Path, inputs: Iterable[Path] = ()) -> None:
    """Raise `InputError` unless `out` can become a run directory, before any work is done.

    It must be absent, empty or an earlier run that holds exactly what was written; no symbolic link, no mount point,
    not the working directory or above it, and no part of it among `inputs` (files and folders that the job reads).
    """
    with _refusals(out):
        place = _place(out)
        _restore(place)
        problem = _occupied(place) or _holds(place, inputs) or _not_writable(place)
    if problem:
        raise InputError(f"--out {_shown(out)}: {problem}")


@contextmanager
def whole_directory(out: Path, inputs: Iterable[Path] = ()) -> Iterator[Path]:
    """A new directory that takes the place of `out`, and of an earlier run there, once the block has succeeded.

    Whatever is raised, in the block or by the file system, `out` stays as it was. Where something was put into `out`
    while the block ran, that is left alone, and the new run gets a free name beside it, which the `InputError` says.
    """
    check_directory(out, inputs)
    work = _Work(_place(out), out)
    try:
        with _refusals(out):
            yield work.begin()
            work.finish()
    finally:
        work.clean()


def add_to_run(folder: Path, name: str, text: str) -> None:
    """Write one more file of the library's into a finished run, and into its marker where that is intact."""
    with _refusals(folder):
        intact = _exists(folder / MARKER) and _altered(folder) is None
        (folder / name).write_text(text, encoding="utf-8")
        if intact:
            _seal(folder)


class _Work:
    """The hidden folder in which a run is made: `new`, which becomes the run directory, and perhaps the earlier run."""

    def __init__(self, place: Path, out: Path) -> None:
        self.place, self.out = place, out
        self.folder: Path | None = None
        self.parents: list[Path] = []  # made for this run
        self.own: int | None = None  # inode of the directory that is being made

    def begin(self) -> Path:
        """The empty directory to write into."""
        _make_parents(self.place.parent, self.parents)
        self.folder = Path(tempfile.mkdtemp(prefix=_WORK, dir=self.place.parent))
        new = self.folder / "new"
        new.mkdir()
        self.own = new.stat().st_ino
        return new

    def finish(self) -> None:
        """Put the new run in its place; the earlier one is then in `folder`, from where `clean` removes it."""
        assert self.folder is not None
        new, place = self.folder / "new", self.place
        _seal(new)
        problem = _occupied(place)
        if problem is None:
            try:
                problem = _put(new, place)
            except OSError as error:
                problem = _reason(error)
        self.parents.clear()
        if problem is not None:
            free = _free_name(place)
            new.rename(free)
            raise InputError(f"--out {_shown(self.out)}: {problem}. The finished run was kept: it is in {_shown(free)}")

    def clean(self) -> None:
        """Remove what is left: the half-written run, or of the earlier one exactly the files that were written."""
        with suppress(OSError):
            self._clean_work()
        for folder in reversed(self.parents):
            with suppress(OSError):
                folder.rmdir()

    def _clean_work(self) -> None:
        if self.folder is None:
            return
        earlier = self.folder / "earlier" / self.place.name
        if _exists(earlier) and not _exists(self.place):
            earlier.rename(self.place)  # where that fails, it stays where it is
        for folder in (self.folder / "new", earlier):
            if _exists(folder) and folder.stat().st_ino == self.own:
                shutil.rmtree(folder, ignore_errors=True)
            elif _exists(folder):
                _remove_run(folder, self.place)
        for folder in (earlier.parent, self.folder):
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def _refusals(out: Path) -> Iterator[None]:
    """What the file system refuses becomes one message about `out`."""
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"--out {_shown(out)}: {_reason(error)}; nothing there was changed") from error
    except ValueError as error:
        if "null byte" not in str(error) and "null character" not in str(error):
            raise
        raise InputError(f"--out {_shown(out)}: the name holds a null byte; name a directory") from None


def _reason(error: OSError) -> str:
    return f"cannot be written: {_REASONS.get(error.errno or 0) or error.strerror or error}"


def _shown(path: Path) -> str:
    """The path in at most 200 printable characters."""
    text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in str(path))
    return text if len(text) <= 200 else f"{text[:120]}...{text[-60:]}"


def _place(out: Path) -> Path:
    """Where `out` really is, its `..` and the links above it resolved; a link itself is refused."""
    if out.is_symlink():
        raise InputError(f"--out {_shown(out)}: is a symbolic link; name the directory itself")
    try:
        return out.resolve()
    except RuntimeError:  # Python before 3.13 says so of links that form a loop
        raise OSError(errno.ELOOP, "loop") from None


def _exists(path: Path) -> bool:
    return os.path.lexists(path)


def _occupied(place: Path) -> str | None:
    """Why nothing may be put in this place; None where it is free, empty or an earlier run as it was written."""
    if not _exists(place):
        return None
    if not place.is_dir():
        return "a file is there; name a directory"
    if os.path.ismount(place):
        return "is a mount point, which cannot be replaced; name a directory below it"
    names = sorted(os.listdir(place))
    if not names or MARKER in names:
        return (_altered(place) if names else None) or _stood_in(place)
    shown = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
    if any(name in names for name in _OLD_RUNS):
        return (
            f"holds {shown}, but no {MARKER}: it may be a run of an earlier version, which kept no list of what it"
            " wrote, or the files of somebody else; nothing is replaced there. Move it away or name another directory"
        )
    return f"holds other things than an earlier run ({shown}); name another directory"


def _stood_in(place: Path) -> str | None:
    try:
        here = Path.cwd()
    except FileNotFoundError:  # removed meanwhile
        return None
    inside = here.is_relative_to(place)
    return "is the working directory or above it; name a new directory, such as run1" if inside else None


def _altered(place: Path) -> str | None:
    """What in a run directory is not as the run wrote it."""
    written = _written(place)
    if written is None:
        return f"its {MARKER} is damaged, so nobody can tell what the run wrote; name another directory"
    folders = {str(parent) for name in written for parent in PurePosixPath(name).parents}
    for path in _below(place):
        name = path.relative_to(place).as_posix()
        info = path.lstat()
        if name == MARKER or stat.S_ISDIR(info.st_mode) and name in folders:
            continue
        if name not in written:
            return f"'{name}' was not written by the run that is there; move it away or name another directory"
        if not _unchanged(path, written[name]):
            return f"'{name}' was changed after the run wrote it; move it away or name another directory"
    return None


def _below(folder: Path) -> Iterator[Path]:
    """Everything in a folder, links not followed, a folder before what is in it."""
    for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
        yield Path(entry.path)
        if entry.is_dir(follow_symlinks=False):
            yield from _below(Path(entry.path))


def _written(place: Path) -> dict[str, Any] | None:
    """The files that the marker lists, by name; None where it is not one that a run wrote."""
    marker = place / MARKER
    if not stat.S_ISREG(marker.lstat().st_mode) or marker.stat().st_size > _LARGEST_MARKER:
        return None
    try:
        content = json.loads(marker.read_bytes())
        files = content["files"]
        own = content["format"] == 1 and content["sha256"] == _digest(_canonical(files))
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


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _unchanged(path: Path, entry: dict[str, Any]) -> bool:
    info = path.lstat()
    plain = stat.S_ISREG(info.st_mode) and info.st_size == entry["bytes"]
    return plain and _file_digest(path) == entry["sha256"]


def _seal(new: Path) -> None:
    """Write the marker of a finished run, and have everything on the disk before it takes its place."""
    files = {
        path.relative_to(new).as_posix(): {"bytes": path.stat().st_size, "sha256": _file_digest(path)}
        for path in _below(new)
        if not path.is_dir() and path != new / MARKER
    }
    content = {"format": 1, "what": "files of this run; a directory that holds others is never replaced"}
    content |= {"files": files, "sha256": _digest(_canonical(files))}
    (new / MARKER).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    for path in [*_below(new), new]:
        _synchronise(path)


def _synchronise(path: Path) -> None:
    if path.is_dir() and sys.platform == "win32":
        return  # folders cannot be opened there
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _put(new: Path, place: Path) -> str | None:
    """Move the new run to its place; the earlier one, if any, stays beside `new`. Says what got in the way."""
    if not _exists(place) or not os.listdir(place):
        try:
            new.rename(place)
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                return "something was put there while the run was being made"
            raise
    elif not _exchange(new, place):
        _exchange_by_renames(new, place)
    _synchronise(place.parent)
    return None


def _exchange(a: Path, b: Path) -> bool:
    """Exchange two directories in one step; False where the system cannot."""
    renameat2 = _renameat2()
    if renameat2 is None:
        return False
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    if renameat2(here, os.fsencode(a), here, os.fsencode(b), exchange) == 0:
        return True
    number = ctypes.get_errno()
    if number in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):  # an old kernel, a file system that cannot
        return False
    raise OSError(number, os.strerror(number), str(b))


def _renameat2() -> Any:
    if not sys.platform.startswith("linux"):
        return None
    try:
        function = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError):  # another libc
        return None
    function.argtypes = [ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint]
    return function


def _exchange_by_renames(new: Path, place: Path) -> None:
    """In two steps; whatever comes between them, the earlier run goes back (`_restore` does it after a kill)."""
    earlier = new.parent / "earlier" / place.name
    earlier.parent.mkdir()
    try:
        place.rename(earlier)
        new.rename(place)
    except BaseException:
        if _exists(earlier) and not _exists(place):
            earlier.rename(place)
        raise


def _restore(place: Path) -> None:
    """Bring back an earlier run that a killed process had moved away and not yet replaced."""
    if _exists(place) or not place.parent.is_dir():
        return
    for work in place.parent.iterdir():
        earlier = work / "earlier" / place.name
        if work.name.startswith(_WORK) and not work.is_symlink() and (earlier / MARKER).is_file():
            earlier.rename(place)
            return


def _remove_run(folder: Path, place: Path) -> None:
    """Remove an earlier run file by file, each only as it was written; what else turns up gets a name of its own."""
    with suppress(OSError):
        written = _written(folder) or {}
        for name, entry in written.items():
            path = folder / name
            if _exists(path) and _unchanged(path, entry):
                path.unlink()
        if written and {path.name for path in _below(folder) if not path.is_dir()} == {MARKER}:
            (folder / MARKER).unlink()
        for path in sorted(_below(folder), reverse=True):
            if path.is_dir() and not path.is_symlink():
                with suppress(OSError):
                    path.rmdir()
        if os.listdir(folder):
            folder.rename(_free_name(place))
        else:
            folder.rmdir()


def _free_name(place: Path) -> Path:
    number = 2
    while _exists(place.with_name(f"{place.name}-{number}")):
        number += 1
    return place.with_name(f"{place.name}-{number}")


def _make_parents(folder: Path, made: list[Path]) -> None:
    """Make the folder and those above it; each one made is put into `made`."""
    missing = []
    while not _exists(folder):
        missing.append(folder)
        folder = folder.parent
    for one in reversed(missing):
        one.mkdir(exist_ok=True)
        made.append(one)


def _not_writable(place: Path) -> str | None:
    """Why no directory can be made there, as far as that shows before it is tried."""
    existing = next(parent for parent in place.parents if _exists(parent))
    if not existing.is_dir():
        return f"{existing} is a file, no directory can stand below it"
    if not os.access(existing, os.W_OK | os.X_OK):
        return f"cannot be written: {existing} is not writable; name a directory elsewhere"
    return None


def _holds(place: Path, inputs: Iterable[Path]) -> str | None:
    """Which input of the job would be replaced with the directory."""
    if not _exists(place):
        return None
    for file in inputs:
        with suppress(OSError, RuntimeError, ValueError):
            if any(path.is_relative_to(place) for path in (file.resolve(), Path(os.path.abspath(file)))):
                return f"holds {_shown(file)}, which this command reads; name another directory"
    return None


def task_inputs(task_file: Path) -> list[Path]:
    """Every file that a task reads: the files that it extends, and whatever file one of their keys names.

    Files that the robot's model names (MJCF includes, meshes) are among them. A task that cannot be read has none.
    """
    from ..formats.taskfile import read_task

    found = [task_file]
    for file, keys in read_task(task_file):
        found.append(file)
        for text in _texts(keys):
            with suppress(OSError, ValueError):
                named = file.resolve().parent / text
                if named.is_file():
                    found += [named, *(_referred(named) if named.suffix.lower() in (".xml", ".urdf") else ())]
    return found


def _texts(keys: Any) -> Iterator[str]:
    if isinstance(keys, str):
        yield keys
    elif isinstance(keys, (dict, list)):
        for value in keys.values() if isinstance(keys, dict) else keys:
            yield from _texts(value)


def _referred(file: Path) -> Iterator[Path]:
    """Files that an XML file names, and those that they name in turn (MJCF includes), each once."""
    seen, waiting = {file}, [file]
    while waiting:
        current = waiting.pop()
        if not current.is_file() or current.suffix.lower() not in (".xml", ".urdf"):
            continue
        for match in _REFERENCES.finditer(current.read_bytes()):
            named = file.parent / os.fsdecode(match[1])
            if named not in seen and _exists(named):
                seen.add(named)
                waiting.append(named)
                yield named
