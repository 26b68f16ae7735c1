"""Files whose readers are written in C or C++ are read in a process of their own.

A damaged Parquet, MATLAB or HDF5 file can end pyarrow, SciPy or h5py with a segmentation fault, or make them ask for
all memory. Here that ends one small process, bounded in time and memory, and becomes an `InputError`. One process
serves all files of a command; it imports neither JAX nor the robot's model. Requests and answers are a line of JSON
each on its pipes; behind an answer follow the numbers.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import importlib.util
import json
import math
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from ..errors import InputError
from . import containers
from .tables import Source, Table

__all__ = ["episodes_apart", "read_apart"]

SECONDS, SECONDS_PER_BYTE = 120.0, 2e-7  # of the clock: a busy machine and a slow disk are no damage
MEMORY = 8 << 30  # bytes of addresses: a file of 2 GiB, its columns and their numbers
_READERS = {
    ".parquet": lambda file, source: containers.read_parquet(file),
    ".mat": lambda file, source: containers.read_mat(file),
    ".h5": lambda file, source: containers.read_hdf5(file),
    "lerobot": containers.read_lerobot,
}
_NAMES = {".parquet": "Parquet", ".mat": "MATLAB's files", ".h5": "HDF5", "lerobot": "LeRobot's Parquet files"}
_PACKAGES = {".parquet": "pyarrow", "lerobot": "pyarrow", ".h5": "h5py"}


def read_apart(kind: str, file: Path, source: Source) -> Table:
    """A file of `kind` (".parquet", ".mat", ".h5", "lerobot") as a table whose columns another process reads."""
    package = _PACKAGES.get(kind)
    if package is not None and importlib.util.find_spec(package) is None:
        raise ModuleNotFoundError(f"No module named '{package}'")
    if not _has_interpreter():
        return _READERS[kind](file, source)
    asked = {"kind": kind, "file": str(file), "source": source._asdict()}
    names = _asked(asked | {"do": "open"}, kind, file)["names"]
    return Table(file, tuple(names), lambda name: _asked(asked | {"do": "read", "name": name}, kind, file)["values"])


def episodes_apart(folder: Path) -> tuple[int, ...]:
    """Numbers of the episodes of a LeRobot folder, as far as their files are there."""
    if not _has_interpreter():
        return containers.lerobot_episodes(folder)
    return tuple(_asked({"do": "episodes", "file": str(folder)}, "lerobot", folder)["episodes"])


def _has_interpreter() -> bool:
    """Inside another program (Blender, a simulator) `sys.executable` is that program, not Python."""
    return Path(sys.executable or "").stem.lower().startswith(("python", "pypy"))


# The side that asks


class _Reader:
    """A process that reads, and the pipes to it."""

    def __init__(self) -> None:
        path = [str(Path(__file__).resolve().parents[2]), *(entry for entry in sys.path if entry)]
        program = f"import sys; sys.path[:] = {path!r}; from {__name__} import _serve; _serve()"
        quiet = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "ARROW_IO")}
        self.owner, self.late = os.getpid(), False
        self.process = subprocess.Popen(  # noqa: S603
            [sys.executable, "-I", "-S", "-c", program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | quiet,
        )

    def ask(self, request: dict[str, Any], seconds: float) -> dict[str, Any] | None:
        """The answer; None where the process ended, or had to be ended, before it gave one."""
        assert self.process.stdin is not None and self.process.stdout is not None
        late = threading.Timer(seconds, self._stop)
        late.daemon = True
        late.start()
        try:
            self.process.stdin.write(json.dumps(request).encode() + b"\n")
            self.process.stdin.flush()
            answer = json.loads(self.process.stdout.readline() or "null")
            if answer is not None and "shape" in answer:
                answer["values"] = _numbers(self.process.stdout, tuple(answer["shape"]))
            return answer
        except (OSError, ValueError, EOFError):
            return None
        finally:
            late.cancel()

    def _stop(self) -> None:
        self.late = True
        self.process.kill()

    def end(self) -> str:
        """End the process and say how it ended: "SIGSEGV"."""
        for pipe in (self.process.stdin, self.process.stdout):
            with contextlib.suppress(OSError):  # the process may be gone
                if pipe is not None:
                    pipe.close()
        if self.owner != os.getpid():  # of the process that this one was forked from
            self.process.returncode = 0
            return ""
        try:
            status = self.process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = self.process.wait()
        if status >= 0:
            return f"status {status}"
        try:
            return signal.Signals(-status).name
        except ValueError:
            return f"signal {-status}"


def _numbers(pipe: Any, shape: tuple[int, ...]) -> np.ndarray:
    values = np.empty(math.prod(shape))
    waiting = values.view(np.uint8).data
    while len(waiting):
        count = pipe.readinto(waiting)
        if not count:
            raise EOFError
        waiting = waiting[count:]
    return values.reshape(shape)


_lock = threading.Lock()
_reader: _Reader | None = None


def _end() -> str:
    global _reader
    gone, _reader = _reader, None
    return gone.end() if gone is not None else ""


atexit.register(_end)


def _asked(request: dict[str, Any], kind: str, file: Path) -> dict[str, Any]:
    global _reader
    seconds = SECONDS + SECONDS_PER_BYTE * (file.stat().st_size if file.is_file() else 1 << 31)
    with _lock:
        if _reader is not None and _reader.owner != os.getpid():
            _end()  # a fork does not share its parent's pipes
        if _reader is None:
            _reader = _Reader()
        answer = _reader.ask(request | {"here": os.getcwd()}, seconds)
        if answer is None:
            late, how = _reader.late, _end()
            what = f"was not done after {seconds:.0f} s" if late else f"crashed ({how})"
            raise InputError(
                f"{file} is damaged: the reader of {_NAMES[kind]} {what}; write the file again, or its numbers as CSV"
                " or .npz"
            )
    if "error" in answer:
        _raise(answer)
    return answer


def _raise(answer: dict[str, Any]) -> NoReturn:
    kind, text = answer["error"], answer["text"]
    if kind == "system":
        raise OSError(answer["number"], text)
    raise {"input": InputError, "module": ModuleNotFoundError}.get(kind, RuntimeError)(text)


# The side that reads


def _serve() -> None:
    """Answer requests until there are no more; what libraries print goes nowhere."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    _bound_memory()
    sys.meta_path.insert(0, _WithoutPandas())  # pyright: ignore[reportArgumentType]
    opened: tuple[Any, Table] | None = None
    for line in sys.stdin.buffer:
        request = json.loads(line)
        values = None
        try:
            os.chdir(request["here"])  # the name of a file may be relative
            file, source = Path(request["file"]), Source(**request.get("source", {}))
            if request["do"] == "episodes":
                answer: dict[str, Any] = {"episodes": containers.lerobot_episodes(file)}
            else:
                key = (request["kind"], file, source)
                if request["do"] == "open" or opened is None or opened[0] != key:
                    opened = None  # its memory first
                    opened = key, _READERS[request["kind"]](file, source)
                answer = {"names": opened[1].names}
                if request["do"] == "read":
                    values = np.ascontiguousarray(opened[1].read(request["name"]), dtype=np.float64)
                    answer = {"shape": values.shape}
        except Exception as error:  # libraries each have their own ways to say "damaged"
            answer = _told(error)
        answers.write(json.dumps(answer).encode() + b"\n")
        if values is not None and "shape" in answer:
            answers.write(values.reshape(-1).view(np.uint8).data)
        answers.flush()


class _WithoutPandas:
    """pyarrow loads pandas where it is installed, half a second, and does without where it is not."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name == "pandas":
            raise ModuleNotFoundError("No module named 'pandas'", name=name)


def _told(error: Exception) -> dict[str, Any]:
    if isinstance(error, InputError):
        return {"error": "input", "text": str(error)}
    if isinstance(error, ModuleNotFoundError):
        return {"error": "module", "text": str(error)}
    if isinstance(error, OSError):
        return {"error": "system", "number": error.errno or errno.EIO, "text": error.strerror or str(error)[:1000]}
    return {"error": "other", "text": (str(error) or type(error).__name__)[:1000]}


def _bound_memory() -> None:
    try:
        import resource
    except ImportError:  # Windows
        return
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    limit = MEMORY if most == resource.RLIM_INFINITY else min(MEMORY, most)
    resource.setrlimit(resource.RLIMIT_AS, (limit, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
