"""Text tables: any delimiter, header rows, units and comments above the numbers, decimal commas, ISO times.

The file is read in blocks of whole lines, so that only the numbers are ever held, and progress is told. A row that was
written twice, stamp and all, is read once.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple, cast

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from .progress import told
from .tables import LARGEST, LARGEST_HEAD, Table, check_columns, is_time, times

__all__ = ["LIBFRANKA", "read_text"]

LIBFRANKA = "libfranka"
_DELIMITERS = (",", ";", "\t", "|", None)  # None: white space
_BLOCK = 1 << 23  # bytes read at once
_LEAD = 60  # lines above the numbers, at most
_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d+,\d+([eE][+-]?\d+)?\s*")
_WITH_COMMA = re.compile(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?")
_NOT_NUMBERS = ("", "na", "n/a", "null", "none", "-")


class _Layout(NamedTuple):
    """How the lines of a file are read."""

    names: tuple[str, ...]
    delimiter: str | None  # None: white space
    skipped: int  # lines above the first row of numbers
    decimal: str  # "," or "."


def read_text(file: Path, form: str | None = None) -> Table:
    """A text table with named columns; a column that is not numbers is refused only where it is asked for.

    `form` is a format whose columns have names of their own ("libfranka"). A file without a header has the columns
    `column_1`, `column_2`, ... Raises `InputError` that names the line for a file that is no table.
    """
    layout = _layout(file)
    names = _libfranka(layout.names) if form == LIBFRANKA else layout.names
    check_columns(file, len(names))
    numbers, texts = _read(file, layout)

    def read(name: str) -> np.ndarray:
        if names.count(name) > 1:
            raise InputError(f"{file}: the column '{name}' appears twice")
        column = names.index(name)
        return numbers[:, column] if column not in texts else times(texts[column], file, name)

    def words(name: str) -> np.ndarray | None:
        cells = texts.get(names.index(name)) if names.count(name) == 1 else None
        if cells is None or np.isfinite(numbers[:, names.index(name)]).any():
            return None
        return None if any(_number(cell) is not None or is_time(cell) for cell in {*cells}) else np.array(cells)

    return Table(file, names, read, words)


def _layout(file: Path) -> _Layout:
    lines = _first_lines(file)
    delimiter = _delimiter(lines)
    rows = [_cells(line, delimiter) for line in lines]
    decimal = _decimal(rows)
    data = [_is_data(row, decimal) for row in rows]
    notes = [k for k, line in enumerate(lines) if data[k] and line.lstrip()[:1] in ("#", "%")]  # a row in a comment
    first = next((k for k, numbers in enumerate(data) if numbers and k not in notes), None)
    if first is None:
        if len(lines) < 2:
            raise InputError(f"{file} is not a table of numbers with a header line: it has {len(lines)} line(s)")
        first = 1  # names and rows of text: each column says what is wrong with it once it is asked for
    width = len(rows[first])
    heads = [k for k in range(first) if len(rows[k]) == width and lines[k].strip() and k not in notes]
    if not heads:
        if first:
            raise InputError(
                f"{file}: line {first + 1} has {width} cells, but no line above it has as many names; a header line"
                " with one name for each column is expected"
            )
        return _Layout(tuple(f"column_{k + 1}" for k in range(width)), delimiter, 0, decimal)
    names = tuple(name.strip().strip('"').strip() for name in rows[heads[0]])
    return _Layout((names[0].lstrip("#%").strip(), *names[1:]), delimiter, first, decimal)


class _Recoded:
    """UTF-16, as spreadsheets save it, as the bytes of UTF-8."""

    def __init__(self, stream: IO[bytes]) -> None:
        self.text = io.TextIOWrapper(stream, encoding="utf-16", newline="")

    def read(self, size: int) -> bytes:
        return self.text.read(size).encode()

    def readline(self, size: int = -1) -> bytes:
        return self.text.readline(size).encode()


@contextmanager
def _opened(file: Path) -> Iterator[tuple[IO[bytes] | _Recoded, IO[bytes]]]:
    """The text's bytes, unpacked and in UTF-8 where it was written in UTF-16, and those of the file."""
    with file.open("rb") as raw:
        packed = file.suffix.lower() == ".gz"
        stream: IO[bytes] = cast("IO[bytes]", gzip.GzipFile(fileobj=raw)) if packed else raw
        mark = stream.read(2)
        stream.seek(0)
        yield (_Recoded(stream) if mark in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else stream), raw


def _first_lines(file: Path) -> list[str]:
    with _opened(file) as (stream, _):
        head = stream.readline(LARGEST_HEAD)
        if len(head) == LARGEST_HEAD:
            raise InputError(
                f"{file}: its first line is longer than {LARGEST_HEAD >> 20} MiB; names of columns are expected"
            )
        lines = [head, *(stream.readline(LARGEST_HEAD) for _ in range(_LEAD))]
    try:
        return [line.decode("utf-8-sig").rstrip("\r\n") for line in lines if line]
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: its first lines are not UTF-8 text ({error}); save it as UTF-8") from None


def _cells(line: str, delimiter: str | None) -> list[str]:
    text = line.strip()
    if text[:1] in "#%" and text:
        text = text[1:].strip()
    if delimiter is None:
        return text.split()
    return next(csv.reader([text], delimiter=delimiter), []) if '"' in text else text.split(delimiter)


def _delimiter(lines: Sequence[str]) -> str | None:
    """What splits most lines into one number of cells, that of the last lines, and into most cells."""
    best, delimiter = (0, 1), ","
    tail = [line for line in lines if line.strip()][-20:]
    for one in _DELIMITERS:
        counts = [len(_cells(line, one)) for line in tail]
        same = sum(count == counts[-1] for count in counts) if counts else 0
        if counts and counts[-1] > 1 and same >= 0.5 * len(counts) and (same, counts[-1]) > best:
            best, delimiter = (same, counts[-1]), one
    if delimiter != ",":
        return delimiter
    for one in (";", "\t", "|") if tail else ():  # the commas may be those of the numbers
        cells, even = _cells(tail[-1], one), len({line.count(one) for line in tail}) == 1
        if even and len(cells) > 1 and any(map(_DECIMAL_COMMA.fullmatch, cells)):
            return one
    cells = tail[-1].split() if tail else []
    return None if len(cells) > 1 and all(map(_WITH_COMMA.fullmatch, cells)) else ","


def _decimal(rows: Sequence[Sequence[str]]) -> str:
    cells = [cell for row in rows[-20:] for cell in row]
    return "," if sum(_DECIMAL_COMMA.fullmatch(cell) is not None for cell in cells) > 0.2 * max(len(cells), 1) else "."


def _is_data(row: Sequence[str], decimal: str) -> bool:
    """Whether a line is a row of numbers: names and units may hold one or two, a row has them mostly."""
    filled = [cell for cell in row if cell.strip().lower() not in _NOT_NUMBERS]
    return len(filled) > 0 and sum(_number(cell, decimal) is not None for cell in filled) > 0.5 * len(filled)


def _number(cell: str, decimal: str = ".") -> float | None:
    try:
        return float(cell.replace(",", ".") if decimal == "," else cell)
    except ValueError:
        return None


def _blocks(file: Path, skipped: int) -> Iterator[tuple[str, float]]:
    """Whole lines of the file below the header, and the share of the file that is read."""
    size, left, read = max(file.stat().st_size, 1), b"", 0
    with _opened(file) as (stream, raw):
        for _ in range(skipped):
            stream.readline()
        while block := stream.read(_BLOCK):
            whole, mark, rest = (left + block).rpartition(b"\n")
            left = rest
            read += len(block)
            if read > LARGEST:
                raise InputError(f"{file}: more than {LARGEST >> 20} MiB of text, unpacked; split it")
            if mark:
                yield _decoded(file, whole), raw.tell() / size
    if left.strip():
        yield _decoded(file, left), 1.0


def _decoded(file: Path, block: bytes) -> str:
    try:
        return block.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: is not UTF-8 text ({error}); save it as UTF-8") from None


def _read(file: Path, layout: _Layout) -> tuple[Float[np.ndarray, "rows columns"], dict[int, list[str]]]:
    """The numbers of all columns, and the cells of those that hold text."""
    parts: list[np.ndarray] = []
    texts: dict[int, list[str]] = {}
    row = 0
    for block, share in _blocks(file, layout.skipped):
        numbers = _fast(block, layout) if not texts else None
        if numbers is None:
            numbers = _slowly(file, block, layout, texts, row)
        parts.append(numbers)
        row += len(numbers)
        if share < 1.0 or len(parts) > 1:
            told(f"reading {file.name}", share)
    if not row:
        raise InputError(f"{file} is not a table of numbers with a header line: there is no row below its header")
    return _without_repeats(np.concatenate(parts), texts)


def _without_repeats(
    numbers: Float[np.ndarray, "rows columns"], texts: dict[int, list[str]]
) -> tuple[Float[np.ndarray, "some columns"], dict[int, list[str]]]:
    """The rows without those that were written twice, where a column that else rises shows that they were."""
    words = {column: np.array(cells) for column, cells in texts.items()}
    same = (numbers[1:] == numbers[:-1]) | (np.isnan(numbers[1:]) & np.isnan(numbers[:-1]))
    again = np.append(False, same.all(axis=1))
    for cells in words.values():
        again[1:] &= cells[1:] == cells[:-1]
    kept = numbers[~again]
    if not again.any() or len(kept) < 2:
        return numbers, texts
    stamps = [cells[~again] for cells in words.values() if is_time(str(cells[0]))]
    if not (np.diff(kept, axis=0) > 0).all(axis=0).any() and not any((x[1:] > x[:-1]).all() for x in stamps):
        return numbers, texts
    return kept, {column: cells[~again].tolist() for column, cells in words.items()}


def _fast(block: str, layout: _Layout) -> np.ndarray | None:
    """Rows of a block whose every cell is a number; None where one is not."""
    if layout.delimiter == layout.decimal:  # commas of quoted numbers are not those between them
        return None
    text = block.replace(",", ".") if layout.decimal == "," else block
    try:
        found = np.loadtxt(io.StringIO(text), delimiter=layout.delimiter, ndmin=2, quotechar='"', comments=None)
    except ValueError:
        return None
    return found if found.shape[1:] == (len(layout.names),) and len(found) else None


def _slowly(file: Path, block: str, layout: _Layout, texts: dict[int, list[str]], before: int) -> np.ndarray:
    """Rows of a block cell by cell: empty ones are NaN, a column with a word is kept as text."""
    lines = [line for line in block.splitlines() if line.strip()]
    split = (
        [line.split() for line in lines]
        if layout.delimiter is None
        else [*csv.reader(lines, delimiter=layout.delimiter)]
    )
    width = len(layout.names)
    out = np.full((len(split), width), np.nan)
    for k, cells in enumerate(split):
        if len(cells) != width:
            if len(cells) == width + 1 and not cells[-1].strip():
                cells = cells[:-1]  # a delimiter at the end of the line
            else:
                raise InputError(
                    f"{file} is not a CSV table: row {before + k} (from 0) has {len(cells)} cells, its header {width}"
                )
        for column, cell in enumerate(cells):
            value = None if column in texts else _number(cell, layout.decimal)
            if value is not None:
                out[k, column] = value
            elif column in texts:
                texts[column].append(cell)
            elif cell.strip().lower() not in _NOT_NUMBERS:
                texts[column] = [""] * (before + k) + [cell]
    for cells in texts.values():
        cells += [""] * (before + len(split) - len(cells))
    return out


def _libfranka(names: Sequence[str]) -> tuple[str, ...]:
    """The columns of libfranka's logs, old and new, under one name each: `time` (ms), `q[0]`, ..., `cmd.tau_J_d[0]`."""
    found: list[str] = []
    for name in names:
        plain = {"duration": "time", "success rate": "success_rate"}.get(name, name.removeprefix("state."))
        found.append(f"cmd.{plain}" if "sent commands" in found or plain in found else plain)
    return tuple(found)
