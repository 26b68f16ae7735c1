"""A recording as named columns.

Whatever file they came from, `Table.matrix` gives the (samples, width) array of a name, a list of columns or a prefix.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError, nearest

__all__ = ["Source", "Table", "check_columns", "is_time", "leave_out", "not_increasing", "numbers", "times"]

LARGEST = 1 << 29  # bytes of one array, or of all columns of a table, once the numbers are float64; of a CSV file
LARGEST_HEAD = 1 << 20  # bytes of a CSV file's first line
MOST_COLUMNS = 10_000


class Source(NamedTuple):
    """Which part of a file, or of a folder, is the recording."""

    form: str | None = None  # "rtde", "libfranka": text whose columns have names of their own
    topic: str | None = None  # of a bag
    episode: int | None = None  # of a LeRobot folder


_OTHERS_STAND = "; list the joints of the columns in robot.joints, and all others stand still"


class Table(NamedTuple):
    """Names in a recording file and a function that reads one of them."""

    file: Path
    names: tuple[str, ...]
    read: Callable[[str], np.ndarray]
    words: Callable[[str], np.ndarray | None] = lambda name: None  # the text of a column that holds no number
    pieces: frozenset[str] = frozenset()  # of columns that are there as a whole too (see `joined`)

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
            fewer = values.ndim == 2 and values.shape[1] < len(joints)
            raise InputError(
                f"{self.file}: {_text(source)} ({key}) has shape {values.shape}, {expected}{_OTHERS_STAND * fewer}"
            )
        return values

    def _columns(self, source: str | Sequence[str], joints: Sequence[str], key: str) -> list[str]:
        if not isinstance(source, str):
            return [self._known(name, key) for name in source]
        by_joint = [_first(self.names, (source + mark + joint for mark in ("", "_", ".", "/"))) for joint in joints]
        if all(by_joint):
            return [name for name in by_joint if name]
        numbered = re.compile(re.escape(source) + r"[_.\[ ]?(\d+)\]?")
        found = {name: int(match[1]) for name in self.names if (match := numbered.fullmatch(name))}
        twice = next((name for name in found if self.names.count(name) > 1), None)
        if twice is not None:
            raise InputError(f"{self.file}: the column '{twice}' appears twice")
        if not found:
            self._known(source, key)
        if len(found) != len(joints):
            raise InputError(
                f"{self.file}: prefix '{source}' ({key}) matches {len(found)} columns ({', '.join(found)}),"
                f" expected {len(joints)}, one for each of {', '.join(joints)}"
                f"{_OTHERS_STAND * (len(found) < len(joints))}"
            )
        return sorted(found, key=found.__getitem__)

    def _known(self, name: str, key: str) -> str:
        if name not in self.names:
            what = "array" if self.file.suffix.lower() in (".npz", ".mat") else "column"
            raise InputError(f"{self.file}: no {what} '{name}' ({key}){nearest(name, self.names)}")
        return name


def check_columns(file: Path, count: int) -> None:
    """`InputError` where a file has more columns than a recording can have."""
    if count > MOST_COLUMNS:
        raise InputError(f"{file}: {count} columns; a recording has at most {MOST_COLUMNS}")


def numbers(values: np.ndarray, file: Path, name: str) -> Float[np.ndarray, "..."]:
    """As float64, dates as s since the first, or an `InputError` that shows the first entry that is no number."""
    if values.dtype.kind in "fiu":
        with np.errstate(over="ignore", invalid="ignore"):
            return values.astype(np.float64)
    if values.dtype.kind == "c":
        raise InputError(f"{file}: '{name}' holds complex numbers; real ones are expected")
    if values.dtype.kind == "M" and values.size:
        since = (values - values.reshape(-1)[0]) / np.timedelta64(1, "ns")  # NaN where there is no date
        return since * 1e-9
    if values.dtype.kind in "UO" and values.ndim == 1 and values.size and is_time(values[0]):
        return times(["" if value is None else str(value) for value in values], file, name)
    if not values.size:
        raise InputError(f"{file}: '{name}' has shape {values.shape} and holds no number")
    for row, value in enumerate(values.reshape(len(values), -1)[:, 0] if values.ndim else [values]):
        try:
            float(value)
        except (TypeError, ValueError):
            shown = "an empty cell" if value is None else f"'{value}'"[:40]
            raise InputError(f"{file}: '{name}', row {row} (from 0): {shown} is not a number") from None
    raise InputError(f"{file}: '{name}' holds {values.dtype} values, expected numbers")


def leave_out(count: int) -> str:
    """What to do about values that are no numbers."""
    return (
        f"{count} such value{'s' if count > 1 else ''} in all; leave such rows out, stamps and all: gaps of the time"
        " are seen"
    )


def not_increasing(time: Float[np.ndarray, " samples"], row: int, option: str) -> str:
    """What to do about stamps that do not increase at `row`; `option` states a rate in their place."""
    steps = np.diff(time)
    if steps[row - 1] == 0 and (steps >= 0).all():
        count = int((steps == 0).sum())
        return (
            f"{count} row{'s have' if count > 1 else ' has'} the stamp of the row before: leave the row"
            f"{'s' * (count > 1)} out, stamps and all (gaps of the time are seen), or give {option} where the samples"
            " are even and their stamps alone are wrong"
        )
    return (
        "leave rows that were written again out, and cut the file where another recording begins"
        if steps[row - 1] < 0
        else "leave such rows out, stamps and all (gaps of the time are seen)"
    )


def times(cells: Sequence[str], file: Path, name: str) -> Float[np.ndarray, " rows"]:
    """Seconds since the first of ISO times; an `InputError` that shows the first cell that is neither."""
    try:
        stamps = [datetime.fromisoformat(_iso(cell)) for cell in cells]
        return np.array([(stamp - stamps[0]).total_seconds() for stamp in stamps])
    except (ValueError, TypeError):
        row = next((k for k, cell in enumerate(cells) if cell and not _is_number(cell) and not is_time(cell)), 0)
        shown = f"'{cells[row]}'"[:40] if cells[row] else "an empty cell"
        raise InputError(f"{file}: '{name}', row {row} (from 0): {shown} is not a number") from None


def is_time(cell: object) -> bool:
    """Whether a cell is an ISO time, and no number."""
    try:
        return isinstance(cell, str) and not _is_number(cell) and bool(datetime.fromisoformat(_iso(cell)))
    except ValueError:
        return False


def _iso(cell: str) -> str:
    return cell.strip().replace(" UTC", "+00:00")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _first(names: Sequence[str], wanted) -> str | None:
    return next((name for name in wanted if name in names), None)


def _text(source: str | Sequence[str]) -> str:
    return f"'{source}'" if isinstance(source, str) else f"[{', '.join(source)}]"
