"""Run directories: written whole or not at all, and replaced only where all that they hold was written by a run.

A finished run holds a marker, `figaroh-jax-run.json`, with the size and the SHA-256 of every file that was written.
An existing directory is replaced only where its marker is intact and nothing in it was added or changed since; what a
user put there stops the run before any work. A new run is made in a hidden folder beside the directory and takes its
place in one step of the file system (`renameat2` with `RENAME_EXCHANGE`) where the system has it. That folder holds a
file which its process keeps locked: what a killed process left is known by the open lock, and the next run removes it.
Single files (`write_file`) replace nothing but what the library wrote.
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

from ..errors import InputError
from .marker import LARGEST, MARKER, altered, below, digest, marker_text, seal, synchronise, unchanged, written

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

__all__ = ["MARKER", "add_to_run", "check_directory", "refusals", "task_inputs", "whole_directory", "write_file"]

_WORK = ".figaroh-jax-"  # prefix of the hidden folder in which a run is made
_OWNER = "owner.json"  # in it, locked by the process that makes the run
_ABANDONED = 60.0  # s, after which a hidden folder whose file says nothing belongs to nobody
_BEGINNING = 4096  # bytes of a file that are looked at
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
    with refusals(out):
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
        with refusals(out):
            yield work.begin()
            work.finish()
    finally:
        work.clean()


def add_to_run(folder: Path, name: str, text: str) -> None:
    """Write one more file of the library's into a finished run, and into the list of its marker.

    A file of that name which is not as a run wrote it is refused (`InputError`). Whatever comes between, the run is
    whole: the marker, which may list what is not there, is changed first.
    """
    data = text.encode("utf-8")
    with refusals(folder):
        files = written(folder) if _exists(folder / MARKER) else None
        path, known = folder / name, (files or {}).get(name)
        if _exists(path) and (known is None or not unchanged(path, known)):
            raise InputError(f"{_shown(path)}: is there and was not written by this run; move it away")
        if files is None:
            _whole_file(path, data, replace=False)
            return
        if _exists(path):
            path.unlink()
        files[name] = {"bytes": len(data), "sha256": digest(data)}
        _whole_file(folder / MARKER, marker_text(files).encode(), replace=True)
        _whole_file(path, data, replace=False)


def write_file(path: Path, text: str, option: str, own: str | None = None) -> None:
    """Write one file, whole or not at all. Raises `InputError` where another file is there or the system refuses.

    A file that is there is replaced where it says the same, or where its beginning holds `own`, a text that only the
    library writes.
    """
    data, shown = text.encode("utf-8"), f"{option} {_shown(path)}"
    try:
        if path.is_dir():
            raise InputError(f"{shown}: is a directory; name a file")
        place = path.resolve()
        there = _exists(place)
        if there and not place.is_file():  # /dev/stdout, a pipe: nothing is lost there
            place.write_bytes(data)
            return
        if there and place.stat().st_size == len(data) and place.read_bytes() == data:
            return
        if there and (own is None or own.encode() not in _beginning(place)):
            raise InputError(f"{shown}: is there and was not written by this command; name another file")
        _whole_file(place, data, replace=there)
    except FileExistsError:
        raise InputError(f"{shown}: was created by another program meanwhile; name another file") from None
    except (OSError, RuntimeError) as error:
        said = _reason(error) if isinstance(error, OSError) else "its links form a loop"
        raise InputError(f"{shown}: {said}") from error
    except ValueError as error:
        if isinstance(error, InputError) or "null" not in str(error):
            raise
        raise InputError(f"{shown}: the name holds a null byte; name a file") from None


def _beginning(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_BEGINNING)


def _whole_file(path: Path, data: bytes, *, replace: bool) -> None:
    """Put a file in its place in one step; without `replace` one that is there raises `FileExistsError`."""
    beside = path.with_name(_beside(path.name))
    if _exists(beside):  # of a process that was killed: nobody else uses such a name
        beside.unlink()
    try:
        with open(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if replace:
            os.replace(beside, path)
        elif not _linked(beside, path):
            if _exists(path):
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
            os.rename(beside, path)
    finally:
        with suppress(OSError):
            os.unlink(beside)


def _beside(name: str) -> str:
    """The name under which a file of this name is written first; short enough wherever the name itself is."""
    return f"{_WORK}{digest(os.fsencode(name))[:24]}"


def _linked(a: Path, b: Path) -> bool:
    """Give the file a second name that nothing has yet; False where the file system cannot."""
    try:
        os.link(a, b)
    except FileExistsError:
        raise
    except OSError:
        return False
    return True


class _Work:
    """The hidden folder in which a run is made: `new`, which becomes the run directory, and perhaps the earlier run."""

    def __init__(self, place: Path, out: Path) -> None:
        self.place, self.out = place, out
        self.folder: Path | None = None
        self.parents: list[Path] = []  # made for this run
        self.own: int | None = None  # inode of the directory that is being made
        self.lock: int | None = None

    def begin(self) -> Path:
        """The empty directory to write into."""
        _make_parents(self.place.parent, self.parents)
        _sweep(self.place.parent)
        self.folder = Path(tempfile.mkdtemp(prefix=_WORK, dir=self.place.parent))
        self.lock = _locked(self.folder / _OWNER, os.O_CREAT | os.O_EXCL)
        new = self.folder / "new"
        new.mkdir()
        self.own = new.stat().st_ino
        content = {"format": 1, "what": "a run is being made here", "place": self.place.name, "new": self.own}
        (self.folder / _OWNER).write_text(json.dumps(content), encoding="utf-8")
        return new

    def finish(self) -> None:
        """Put the new run in its place; the earlier one is then in `folder`, from where `clean` removes it."""
        assert self.folder is not None
        new, place = self.folder / "new", self.place
        seal(new)
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
        if fcntl is None:
            self._release()  # Windows removes no open file
        with suppress(OSError):
            self._clean_work()
        self._release()
        for folder in reversed(self.parents):
            with suppress(OSError):
                folder.rmdir()

    def _release(self) -> None:
        lock, self.lock = self.lock, None
        if lock is not None:
            with suppress(OSError):
                os.close(lock)

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
        with suppress(OSError):
            earlier.parent.rmdir()
        if set(os.listdir(self.folder)) <= {_OWNER}:
            (self.folder / _OWNER).unlink(missing_ok=True)
            self.folder.rmdir()


def _locked(owner: Path, flags: int = 0) -> int | None:
    """The file, open and locked until it is closed or its process ends; None where another process has it."""
    handle = os.open(owner, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | flags, 0o600)
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # somebody has it, or the file system has no locks
        if not flags:
            os.close(handle)
            return None
    return handle


def _sweep(parent: Path) -> None:
    """Remove the hidden folders that killed runs left here, as each of them would have done; others are left alone."""
    if fcntl is None:
        return
    for folder in parent.iterdir():
        if folder.name.startswith(_WORK) and stat.S_ISDIR(folder.lstat().st_mode):
            with suppress(OSError):
                _sweep_one(folder)


def _sweep_one(folder: Path) -> None:
    owner = folder / _OWNER
    silent = not _exists(owner) or not owner.lstat().st_size
    if silent and time.time() - folder.lstat().st_mtime < _ABANDONED:
        return  # another process may be about to write into it
    if not _exists(owner):
        folder.rmdir()  # where it is empty
        return
    lock = _locked(owner)
    if lock is None:
        return
    try:
        content = _content(owner) if not silent else {}
        name, own = content.get("place", folder.name), content.get("new")
        if isinstance(name, str) and PurePosixPath(name).name == name and name not in ("", ".."):
            left = _Work(folder.with_name(name), folder.with_name(name))
            left.folder, left.own = folder, own if isinstance(own, int) else None
            left.clean()
    finally:
        os.close(lock)


def _content(owner: Path) -> dict[str, Any]:
    try:
        content = json.loads(owner.read_bytes()[:LARGEST])
    except (ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) and content.get("format") == 1 else {}


@contextmanager
def refusals(out: Path) -> Iterator[None]:
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
        return (altered(place, _LEFT) if names else None) or _stood_in(place)
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
    synchronise(place.parent)
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
        files = written(folder) or {}
        for name in _LEFT if files else ():
            (folder / name).unlink(missing_ok=True)
        for name, entry in files.items():
            path = folder / name
            if _exists(path) and unchanged(path, entry):
                path.unlink()
        if files and {path.name for path in below(folder) if not path.is_dir()} == {MARKER}:
            (folder / MARKER).unlink()
        for path in sorted(below(folder), reverse=True):
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
                elif any((named / marker).is_file() for marker in _RECORDED):
                    found += [file for file in sorted(named.rglob("*")) if file.suffix in _READ and file.is_file()]
    return found


_RECORDED = ("metadata.yaml", "meta/info.json")  # by which a folder is a recording: a ROS 2 bag, LeRobot
_READ = (".yaml", ".json", ".jsonl", ".parquet", ".db3", ".mcap")


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


_LEFT = tuple(_beside(name) for name in (MARKER, "verification.json"))  # what a killed `add_to_run` may leave
