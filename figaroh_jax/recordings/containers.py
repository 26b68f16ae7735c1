"""Recordings in containers of arrays: NumPy, MATLAB, HDF5, Parquet and folders of LeRobot."""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError
from .tables import LARGEST, Source, Table, check_columns, numbers

__all__ = ["lerobot_episodes", "read_hdf5", "read_lerobot", "read_mat", "read_npz", "read_parquet"]

_MATLAB_NUMBERS = ("double", "single", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))


def read_npz(file: Path) -> Table:
    """Arrays as `numpy.savez` writes them."""
    if not zipfile.is_zipfile(file):
        raise InputError(f"{file} is not an .npz file (a zip of arrays, as numpy.savez writes it)")
    with zipfile.ZipFile(file) as archive:
        entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}

    def array(name: str) -> np.ndarray:
        try:
            with zipfile.ZipFile(file) as archive, archive.open(entries[name]) as stored:
                _check_size(np.lib.format.read_magic(stored), stored, file, name)
            with np.load(file, allow_pickle=False) as arrays:
                return np.asarray(arrays[name])
        except InputError:
            raise
        except Exception as error:  # numpy, zipfile and zlib each have their own ways to say "damaged"
            if "allow_pickle" in str(error) or "Object arrays" in str(error):
                raise InputError(f"{file}: array '{name}' holds Python objects, not numbers: it is refused") from error
            raise InputError(f"{file}: array '{name}' cannot be read: {error}") from error

    def words(name: str) -> np.ndarray | None:
        with suppress(InputError):  # an array that cannot be read is refused once its numbers are asked for
            values = array(name)
            return values.astype(str) if values.dtype.kind in "US" else None

    return Table(file, tuple(entries), lambda name: numbers(array(name), file, name), words)


def _check_size(version: tuple[int, int], stored: Any, file: Path, name: str) -> None:
    """Refuse an array by its header, before the memory for its numbers is asked for."""
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = header(stored)
    size = math.prod(shape) * max(8, dtype.itemsize)
    if size > LARGEST:
        raise InputError(
            f"{file}: array '{name}' of shape {shape} takes {size >> 20} MiB as float64; at most"
            f" {LARGEST >> 20} MiB are read"
        )


def read_mat(file: Path) -> Table:
    """MATLAB's files: arrays and the fields of structs (`log.q`); a row vector is a column. Version 7.3 is HDF5."""
    from scipy.io import loadmat, whosmat

    try:
        found = whosmat(file)
    except NotImplementedError:
        return read_hdf5(file, matlab=True)
    sizes = {name: math.prod(shape) * 8 for name, shape, kind in found if kind in _MATLAB_NUMBERS}
    fields = dict(_fields(file, [name for name, shape, kind in found if kind == "struct" and math.prod(shape) == 1]))

    def read(name: str) -> np.ndarray:
        if name in fields:
            return numbers(_column(fields[name]), file, name)
        if sizes[name] > LARGEST:
            raise InputError(f"{file}: array '{name}' of {sizes[name] / 2**30:.1f} GiB is too large")
        try:
            values = np.asarray(loadmat(file, variable_names=[name])[name])
        except Exception as error:  # scipy and zlib each have their own ways to say "damaged"
            raise InputError(f"{file}: array '{name}' cannot be read: {error}") from error
        return numbers(_column(values), file, name)

    return Table(file, (*sizes, *fields), read)


def _column(values: np.ndarray) -> np.ndarray:
    return values.ravel() if values.ndim == 2 and values.shape[0] == 1 else values


def _fields(file: Path, structs: Sequence[str]) -> Iterator[tuple[str, np.ndarray]]:
    """The numeric fields of structs, also of structs in them."""
    from scipy.io import loadmat

    if not structs:
        return
    loaded = loadmat(file, variable_names=[*structs])
    waiting = [(name, np.asarray(loaded[name])) for name in structs]
    while waiting:
        name, value = waiting.pop(0)
        if value.dtype.names and value.size == 1:
            waiting += [(f"{name}.{key}", np.asarray(value.reshape(-1)[0][key])) for key in value.dtype.names]
        elif value.dtype.kind in "fiu" and value.ndim <= 2:
            yield name, value


def read_hdf5(file: Path, *, matlab: bool = False) -> Table:
    """Datasets by their paths (`run/q`); a field of a compound one is `run/log.q`. MATLAB keeps columns as rows."""
    import h5py

    found: dict[str, tuple[str, str | None]] = {}
    sizes: dict[str, int] = {}

    def visit(path: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or path.startswith("#"):
            return
        for field in item.dtype.names or (None,):
            kind = item.dtype if field is None else item.dtype[field]
            if kind.base.kind in "fiu" and item.ndim + len(kind.shape) in (1, 2):
                name = path if field is None else f"{path}.{field}"
                name = name.replace("/", ".") if matlab else name
                found[name], sizes[name] = (path, field), math.prod((*item.shape, *kind.shape)) * 8

    with h5py.File(file, "r") as opened:
        opened.visititems(visit)
    check_columns(file, len(found))

    def read(name: str) -> np.ndarray:
        path, field = found[name]
        if sizes[name] > LARGEST:
            raise InputError(
                f"{file}: dataset '{name}' takes {sizes[name] >> 20} MiB; at most {LARGEST >> 20} are read"
            )
        with h5py.File(file, "r") as opened:
            dataset: Any = opened[path]
            values = np.asarray(dataset[()] if field is None else dataset[field])
        return numbers(_column(values.T) if matlab else values, file, name)

    return Table(file, tuple(found), read)


def read_parquet(file: Path) -> Table:
    """Columns of a Parquet file; a column of lists of one length is an array of that width."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(file) as opened:
            check_columns(file, opened.metadata.num_columns)
            size = 8 * opened.metadata.num_rows * opened.metadata.num_columns
            size = max(size, sum(opened.metadata.row_group(k).total_byte_size for k in range(opened.num_row_groups)))
            if size > LARGEST:
                raise InputError(f"{file}: its columns take {size >> 20} MiB; at most {LARGEST >> 20} MiB are read")
            table = opened.read()  # `parquet.read_table` would load pandas, where that is installed
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise InputError(f"{file} is not a Parquet file: {error}") from error
    return _arrow(file, table)


def _arrow(file: Path, table: Any) -> Table:
    names = tuple(table.column_names)
    check_columns(file, len(names))
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{file}: the column '{twice}' appears twice")

    def read(name: str) -> np.ndarray:
        column = table.column(name)
        try:
            kind = str(column.type)
            if "timestamp" in kind:
                return column.cast("int64").to_numpy() * _TICKS[kind.split("[")[1].split("]")[0].split(",")[0]]
            values = np.array(column.to_pylist()) if "list" in kind else column.to_numpy()
            return numbers(np.array(values), file, name)
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"{file}: the lists in column '{name}' differ in length") from error
        except Exception as error:  # kinds of columns that have no form in NumPy
            raise InputError(f"{file}: column '{name}' of type {column.type} cannot be read as numbers") from error

    return Table(file, names, read)


_TICKS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


# LeRobot


class _Episode(NamedTuple):
    """Where the rows of an episode stand."""

    number: int
    file: Path


def lerobot_episodes(folder: Path) -> tuple[int, ...]:
    """Numbers of the episodes of a LeRobot folder, as far as their files are there."""
    return tuple(episode.number for episode in _episodes(folder, _info(folder)))


def read_lerobot(folder: Path, source: Source) -> Table:
    """An episode of a LeRobot folder, version 2 or 3: its features, each also by the names that the folder gives them.

    `observation.state` of names `shoulder_pan.pos`, ... is an array, and `observation.state.shoulder_pan.pos` a column.
    """
    from pyarrow import parquet

    info = _info(folder)
    episodes = _episodes(folder, info)
    known = [episode.number for episode in episodes]
    if source.episode is None and len(known) > 1:
        raise InputError(f"{folder}: holds {len(known)} episodes; `episode` must say which, {_span(known)}")
    wanted = known[0] if source.episode is None else source.episode
    chosen = [episode for episode in episodes if episode.number == wanted]
    if not chosen:
        raise InputError(f"{folder}: has no episode {wanted}; there are {_span(known)}")
    with parquet.ParquetFile(chosen[0].file) as opened:
        table = opened.read()
    if "episode_index" in table.column_names:
        table = table.filter(table.column("episode_index").to_numpy() == wanted)
    whole = _arrow(folder, table)
    parts = {
        f"{feature}.{name}": (feature, k)
        for feature, about in info.get("features", {}).items()
        if feature in whole.names
        for k, name in enumerate(_names(about))
    }

    def read(name: str) -> np.ndarray:
        if name not in parts:
            return whole.read(name)
        feature, k = parts[name]
        values = whole.read(feature)
        if values.ndim != 2 or k >= values.shape[1]:
            raise InputError(f"{folder}: '{feature}' has shape {values.shape}, but meta/info.json names more columns")
        return values[:, k]

    return Table(folder, (*whole.names, *(name for name in parts if name not in whole.names)), read)


def _info(folder: Path) -> dict[str, Any]:
    path = folder / "meta" / "info.json"
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        version = str(info["codebase_version"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: does not describe a LeRobot folder ({error!r})") from None
    if not version.startswith(("v2", "v3")):
        raise InputError(f"{path}: codebase_version is {version}; v2.0, v2.1 and v3.0 are read")
    return info


def _names(about: Any) -> list[str]:
    """The names of a feature's numbers, a list or a list under one key ("motors")."""
    names = about.get("names") if isinstance(about, dict) else None
    if isinstance(names, dict):
        names = next(iter(names.values()), None)
    return [str(name) for name in names] if isinstance(names, list) and len(names) > 1 else []


def _episodes(folder: Path, info: dict[str, Any]) -> list[_Episode]:
    files = sorted((folder / "data").glob("*/*.parquet"))
    if not files:
        raise InputError(f"{folder}: data/ holds no .parquet file; download the folder's data as well as its meta/")
    if str(info["codebase_version"]).startswith("v2"):
        return sorted(_Episode(int(file.stem.rsplit("_", 1)[-1]), file) for file in files)
    from pyarrow import parquet

    found = []
    for file in files:
        with parquet.ParquetFile(file) as opened:
            column = opened.read(columns=["episode_index"]).column("episode_index").to_numpy()
        found += [_Episode(int(k), file) for k in np.unique(column)]
    return sorted(found)


def _span(known: Sequence[int]) -> str:
    return f"{known[0]} to {known[-1]}" if len(known) > 1 else str(known[0])
