"""Recording files as named columns: `.npz`, `.csv`, `.parquet` and `.mat` behind one look-up.

Whatever the format, `Table.matrix` gives the (samples, width) array of a name, of a list of columns or of a prefix.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError, nearest
from ..formats.files import plain_file

__all__ = ["Table", "read_table"]

FORMATS = (".npz", ".csv", ".parquet", ".mat")
LARGEST_FILE = 2 << 30  # bytes
LARGEST = 1 << 29  # bytes of one array, or of all columns of a table, once the numbers are float64; of a CSV file
LARGEST_HEAD = 1 << 20  # bytes of a CSV file's first line
MOST_COLUMNS = 10_000


class Table(NamedTuple):
    """Names in a recording file and a function that reads one of them."""

    file: Path
    names: tuple[str, ...]
    read: Callable[[str], np.ndarray]

    def vector(self, name: str, key: str) -> Float[np.ndarray, " samples"]:
        """The one-dimensional array or column called `name`; `key` is the task's key that asks for it."""
        values = self.read(self._known(name, key))
        if values.ndim == 2 and values.shape[1] == 1:
            values = values[:, 0]
        if values.ndim != 1:
            raise InputError(f"{self.file}: '{name}' ({key}) has shape {values.shape}, expected (samples,)")
        return values

    def matrix(self, source: str | Sequence[str], joints: Sequence[str], key: str) -> Float[np.ndarray, "samples nv"]:
        """One column per joint: an array of that shape, a list of columns, or a prefix of column names."""
        expected = f"expected (samples, {len(joints)}), one column for each of {', '.join(joints)}"
        if isinstance(source, str) and source in self.names:
            values = self.read(source)
            values = values[:, None] if values.ndim == 1 and len(joints) == 1 else values
        else:
            columns = self._columns(source, joints, key)
            parts = [self.vector(name, key) for name in columns]
            if len({len(part) for part in parts}) > 1:
                raise InputError(f"{self.file}: the columns of {key} differ in length: {[len(part) for part in parts]}")
            values = np.stack(parts, axis=1)
        if values.ndim != 2 or values.shape[1] != len(joints):
            raise InputError(f"{self.file}: {_text(source)} ({key}) has shape {values.shape}, {expected}")
        return values

    def _columns(self, source: str | Sequence[str], joints: Sequence[str], key: str) -> list[str]:
        if not isinstance(source, str):
            return [self._known(name, key) for name in source]
        by_joint = [_first(self.names, (source + mark + joint for mark in ("", "_", ".", "/"))) for joint in joints]
        if all(by_joint):
            return [name for name in by_joint if name]
        numbered = re.compile(re.escape(source) + r"[_.\[ ]?(\d+)\]?")
        found = {name: int(match[1]) for name in self.names if (match := numbered.fullmatch(name))}
        if not found:
            self._known(source, key)
        if len(found) != len(joints):
            raise InputError(
                f"{self.file}: prefix '{source}' ({key}) matches {len(found)} columns ({', '.join(found)}),"
                f" expected {len(joints)}, one for each of {', '.join(joints)}"
            )
        return sorted(found, key=found.__getitem__)

    def _known(self, name: str, key: str) -> str:
        if name not in self.names:
            what = "array" if self.file.suffix.lower() in (".npz", ".mat") else "column"
            raise InputError(f"{self.file}: no {what} '{name}' ({key}){nearest(name, self.names)}")
        return name


def read_table(file: Path, key: str) -> Table:
    """Open a recording; raises `InputError` that names the file, and the task's `key` that asks for it."""
    suffix = file.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"{file} ({key}): recordings are {', '.join(FORMATS)}, not '{file.suffix or file.name}'")
    plain_file(file, f"{file} ({key})", "a recording file", LARGEST if suffix == ".csv" else LARGEST_FILE, FORMATS)
    try:
        return {".npz": _npz, ".csv": _csv, ".parquet": _parquet, ".mat": _mat}[suffix](file)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{file} ({key}) cannot be read: {error.strerror or error}") from error
    except Exception as error:  # zipfile, zlib, numpy and Arrow each have their own ways to say "damaged"
        raise InputError(f"{file} ({key}) is damaged or of another format: {error}") from error


def _npz(file: Path) -> Table:
    if not zipfile.is_zipfile(file):
        raise InputError(f"{file} is not an .npz file (a zip of arrays, as numpy.savez writes it)")
    with zipfile.ZipFile(file) as archive:
        entries = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}

    def read(name: str) -> np.ndarray:
        try:
            with zipfile.ZipFile(file) as archive, archive.open(entries[name]) as stored:
                _check_size(np.lib.format.read_magic(stored), stored, file, name)
            with np.load(file, allow_pickle=False) as arrays:
                values = np.asarray(arrays[name])
        except InputError:
            raise
        except Exception as error:  # numpy, zipfile and zlib each have their own ways to say "damaged"
            if "allow_pickle" in str(error) or "Object arrays" in str(error):
                raise InputError(f"{file}: array '{name}' holds Python objects, not numbers: it is refused") from error
            raise InputError(f"{file}: array '{name}' cannot be read: {error}") from error
        return _numbers(values, file, name)

    return Table(file, tuple(entries), read)


def _mat(file: Path) -> Table:
    """MATLAB's files before version 7.3; a row vector is a column."""
    from scipy.io import loadmat, whosmat

    try:
        sizes = {name: math.prod(shape) * 8 for name, shape, kind in whosmat(file) if kind in _MATLAB_NUMBERS}
    except NotImplementedError:
        raise InputError(f"{file}: is of MATLAB's version 7.3; save it by save(..., '-v7')") from None

    def read(name: str) -> np.ndarray:
        if sizes[name] > LARGEST:
            raise InputError(f"{file}: array '{name}' of {sizes[name] / 2**30:.1f} GiB is too large")
        try:
            values = np.asarray(loadmat(file, variable_names=[name])[name])
        except Exception as error:  # scipy and zlib each have their own ways to say "damaged"
            raise InputError(f"{file}: array '{name}' cannot be read: {error}") from error
        return _numbers(values.ravel() if values.ndim == 2 and values.shape[0] == 1 else values, file, name)

    return Table(file, tuple(sizes), read)


_MATLAB_NUMBERS = ("double", "single", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))


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


def _csv(file: Path) -> Table:
    import pyarrow as pa
    from pyarrow import csv

    with file.open("rb") as stream:
        first = stream.readline(LARGEST_HEAD)
    if len(first) == LARGEST_HEAD:
        raise InputError(
            f"{file}: its first line is longer than {LARGEST_HEAD >> 20} MiB; names of columns are expected"
        )
    try:
        head = first.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: its first line is no text in UTF-8 ({error}); save it as UTF-8") from None
    delimiter = max(",;\t", key=head.count)
    try:
        table = csv.read_csv(file, parse_options=csv.ParseOptions(delimiter=delimiter))
    except pa.ArrowInvalid as error:
        raise InputError(f"{file} is not a CSV table with a header line: {error}") from error
    return _arrow(file, table.rename_columns([name.strip().lstrip("#").strip() for name in table.column_names]))


def _parquet(file: Path) -> Table:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        with parquet.ParquetFile(file) as opened:
            _check_columns(file, opened.metadata.num_columns)
            size = 8 * opened.metadata.num_rows * opened.metadata.num_columns
            size = max(size, sum(opened.metadata.row_group(k).total_byte_size for k in range(opened.num_row_groups)))
        if size > LARGEST:
            raise InputError(f"{file}: its columns take {size >> 20} MiB; at most {LARGEST >> 20} MiB are read")
        return _arrow(file, parquet.read_table(file))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise InputError(f"{file} is not a Parquet file: {error}") from error


def _arrow(file: Path, table) -> Table:
    names = tuple(table.column_names)
    _check_columns(file, len(names))
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise InputError(f"{file}: the column '{twice}' stands there twice")

    def read(name: str) -> np.ndarray:
        column = table.column(name)
        try:
            values = column.to_pylist() if "list" in str(column.type) else column.to_numpy()
            return _numbers(np.array(values), file, name)
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"{file}: the lists in column '{name}' differ in length") from error
        except Exception as error:  # kinds of columns that have no form in NumPy
            raise InputError(f"{file}: column '{name}' of type {column.type} cannot be read as numbers") from error

    return Table(file, names, read)


def _check_columns(file: Path, count: int) -> None:
    if count > MOST_COLUMNS:
        raise InputError(f"{file}: {count} columns; a recording has at most {MOST_COLUMNS}")


def _numbers(values: np.ndarray, file: Path, name: str) -> Float[np.ndarray, "..."]:
    """As float64, or an `InputError` that shows the first entry that is no number."""
    if values.dtype.kind in "fiu":
        with np.errstate(over="ignore", invalid="ignore"):
            return values.astype(np.float64)
    if values.dtype.kind == "c":
        raise InputError(f"{file}: '{name}' holds complex numbers; real ones are expected")
    if not values.size:
        raise InputError(f"{file}: '{name}' has shape {values.shape} and holds no number")
    for row, value in enumerate(values.reshape(len(values), -1)[:, 0] if values.ndim else [values]):
        try:
            float(value)
        except (TypeError, ValueError):
            shown = "an empty cell" if value is None else f"'{value}'"[:40]
            raise InputError(f"{file}: '{name}', row {row} (from 0): {shown} is not a number") from None
    raise InputError(f"{file}: '{name}' holds {values.dtype} values, expected numbers")


def _first(names: Sequence[str], wanted) -> str | None:
    return next((name for name in wanted if name in names), None)


def _text(source: str | Sequence[str]) -> str:
    return f"'{source}'" if isinstance(source, str) else f"[{', '.join(source)}]"
