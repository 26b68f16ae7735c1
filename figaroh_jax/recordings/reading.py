"""Recording files: NumPy, text, JSON, MATLAB, HDF5, Parquet, ROS bags and LeRobot folders behind one function."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..formats.files import plain_file
from .bags import read_bag
from .containers import read_npz
from .joined import joined
from .jsonfiles import JSON, json_episodes, read_json
from .reader_process import episodes_apart, read_apart
from .tables import LARGEST, Source, Table
from .textfiles import read_text

__all__ = ["BAGS", "FORMATS", "TEXT", "episodes_of", "kind_of", "read_table"]

LARGEST_FILE = 2 << 30  # bytes
TEXT = (".csv", ".tsv", ".txt", ".log", ".dat")
_HDF5 = (".h5", ".hdf5", ".hdf")
_FOLDERS = ("rosbag2", "lerobot")
BAGS = (".bag", ".mcap", ".db3", "rosbag2")
FORMATS = (".npz", ".csv", ".parquet", ".mat", *TEXT[1:], *JSON, *_HDF5, *BAGS[:3])
_OWNERS = {"topic": "ROS bags and MCAP files", "episode": "LeRobot folders and lists of runs in JSON"}
_WHOLE = Source()


def read_table(file: Path, key: str, source: Source = _WHOLE) -> Table:
    """Open a recording; raises `InputError` that names the file, and the task's `key` that asks for it."""
    suffix = kind_of(file)
    if suffix not in _READERS:
        raise InputError(f"{file} ({key}): recordings are {', '.join(FORMATS)}, not '{file.suffix or file.name}'")
    if suffix not in _FOLDERS:
        plain_file(file, f"{file} ({key})", "a recording file", LARGEST if suffix in TEXT else LARGEST_FILE, FORMATS)
    for name, given, where in (("topic", source.topic, BAGS), ("episode", source.episode, ("lerobot", *JSON))):
        if given is not None and suffix not in where:
            raise InputError(f"{file} ({key}): `{name}` is of {_OWNERS[name]}, which this file is not")
    with _damage(file, key, suffix):
        table = _READERS[suffix](file, source)

    def read(name: str) -> np.ndarray:
        with _damage(file, key, suffix):
            return table.read(name)

    guarded = table._replace(read=read)
    return guarded if suffix in (*BAGS, "lerobot") or source.form is not None else joined(guarded)


def episodes_of(file: Path, key: str) -> tuple[int, ...]:
    """Numbers of the episodes of a LeRobot folder, as far as their files are there, and of a list of runs in JSON."""
    kind = kind_of(file)
    if kind in JSON:
        plain_file(file, f"{file} ({key})", "a recording file", LARGEST_FILE, FORMATS)
    with _damage(file, key, kind):
        return episodes_apart(file) if kind == "lerobot" else json_episodes(file) if kind in JSON else ()


@contextmanager
def _damage(file: Path, key: str, suffix: str) -> Iterator[None]:
    """What a library raises over a file that is damaged, or that it is missing for, as one message."""
    try:
        yield
    except InputError:
        raise
    except ModuleNotFoundError as error:
        package, extra = _EXTRAS[suffix]
        raise InputError(
            f"{file} ({key}): reading it needs the package {package}: pip install 'figaroh-jax[{extra}]' ({error})"
        ) from None
    except OSError as error:
        raise InputError(f"{file} ({key}) cannot be read: {error.strerror or error}") from error
    except Exception as error:  # zipfile, zlib, numpy, Arrow, ... each have their own ways to say "damaged"
        raise InputError(f"{file} ({key}) is damaged or of another format: {error}") from error


def kind_of(file: Path) -> str:
    """The suffix of a file, that of the text in a `.gz`; "rosbag2" or "lerobot" for a folder that is one."""
    if os.path.isfile(file / "metadata.yaml"):
        return "rosbag2"
    if os.path.isfile(file / "meta" / "info.json"):
        return "lerobot"
    inside = Path(file.stem).suffix.lower()
    return inside if file.suffix.lower() == ".gz" and inside in TEXT else file.suffix.lower()


_READERS: dict[str, Callable[[Path, Source], Table]] = {
    ".npz": lambda file, source: read_npz(file),
    ".mat": partial(read_apart, ".mat"),
    ".parquet": partial(read_apart, ".parquet"),
    "lerobot": partial(read_apart, "lerobot"),
    **dict.fromkeys(_HDF5, partial(read_apart, ".h5")),
    **dict.fromkeys(JSON, read_json),
    **dict.fromkeys(TEXT, lambda file, source: read_text(file, source.form)),
    **dict.fromkeys(BAGS, lambda file, source: read_bag(file, source.topic)),
}
_EXTRAS = {
    ".parquet": ("pyarrow", "parquet"),
    "lerobot": ("pyarrow", "parquet"),
    ".mat": ("h5py", "hdf5"),
    **dict.fromkeys(_HDF5, ("h5py", "hdf5")),
    **dict.fromkeys(BAGS, ("rosbags", "ros")),
}
