"""Recordings in JSON: rows, columns, or a list of runs, as a short script of an experiment writes them.

An object of lists holds columns (`{"t": [...], "q": [[...], ...]}`), a list of objects, and a file with one object a
line, holds rows. An object in an object is named with dots (`log.q`). A list of objects of long lists holds runs, of
which `episode` takes one.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from .tables import Source, Table, check_columns, is_time, numbers

__all__ = ["JSON", "json_episodes", "read_json"]

JSON = (".json", ".jsonl", ".ndjson")
LARGEST_JSON = 1 << 28  # bytes of a file: in memory its numbers take some ten times of that
_A_RUN = 50  # entries of a list from which on it holds samples rather than joints


def read_json(file: Path, source: Source) -> Table:
    """Numbers and lists of numbers by their keys; `InputError` where there are none, or several runs and none asked."""
    found = _loaded(file)
    runs = _runs(found, source.episode is not None)
    if runs is not None:
        path, known = runs
        if source.episode is None and len(known) > 1:
            raise InputError(f"{file}: holds {len(known)} runs; `episode` must say which, 0 to {len(known) - 1}")
        wanted = source.episode or 0
        if wanted >= len(known):
            raise InputError(f"{file}: there is no run {wanted}; `episode` is 0 to {len(known) - 1}")
        columns = dict(_columns(known[wanted], path))
    elif source.episode is not None:
        raise InputError(f"{file}: holds one run; `episode` is for a list of them, objects of long lists each")
    else:
        _parsed.cache_clear()
        columns = dict(_columns(found, ""))
    if not columns:
        raise InputError(
            f"{file}: holds no lists of numbers: a recording in JSON is an object of lists, or a list of objects, one"
            " for each sample"
        )
    check_columns(file, len(columns))

    def read(name: str) -> np.ndarray:
        lengths = [len(cell) if isinstance(cell, list) else -1 for cell in columns[name]]
        odd = next((k for k, length in enumerate(lengths) if length != lengths[0]), None)
        if odd is not None and None in columns[name]:
            row = columns[name].index(None)
            raise InputError(f"{file}: '{name}', row {row} (from 0): no value stands there; other rows have one")
        if odd is not None:
            raise InputError(
                f"{file}: '{name}', row {odd} (from 0): {_width(lengths[odd])}, but {_width(lengths[0])} in row 0"
            )
        return numbers(np.array(columns[name]), file, name)

    def words(name: str) -> np.ndarray | None:
        cells = columns.get(name, [])
        text = cells and all(isinstance(cell, str) for cell in cells) and not any(is_time(cell) for cell in {*cells})
        return np.array(cells) if text else None

    return Table(file, tuple(columns), read, words)


def json_episodes(file: Path) -> tuple[int, ...]:
    """Numbers of the runs of a file that holds a list of them; none of another."""
    runs = _runs(_loaded(file), False)
    return () if runs is None else tuple(range(len(runs[1])))


def _loaded(file: Path) -> Any:
    """What the file holds; of one object a line, their list."""
    told = file.stat()
    return _parsed(file, told.st_mtime_ns, told.st_size)


@lru_cache(maxsize=1)  # each run of a list is asked for by itself; what is no such list is not kept
def _parsed(file: Path, changed: int, size: int) -> Any:
    if size > LARGEST_JSON:
        raise InputError(
            f"{file}: {size >> 20} MiB of JSON; at most {LARGEST_JSON >> 20} MiB are read: write such recordings as"
            " .npz, or cut them"
        )
    try:
        text = file.read_text("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is not text in UTF-8 ({error.reason} at byte {error.start})") from None
    lines = text.splitlines() if file.suffix.lower() != ".json" else []
    if not lines:
        return _value(text, file, 1)
    return [_value(line, file, k) for k, line in enumerate(lines, 1) if line.strip()]


def _value(text: str, file: Path, first: int) -> Any:
    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        named = dict(pairs)
        if len(named) < len(pairs):
            keys = [key for key, _ in pairs]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise InputError(f"{file}: the key '{twice}' appears twice in one object")
        return named

    try:
        return json.loads(text, object_pairs_hook=once)
    except json.JSONDecodeError as error:
        line = first + error.lineno - 1
        raise InputError(f"{file}: line {line}, column {error.colno} is not JSON: {error.msg}") from None
    except RecursionError:
        raise InputError(f"{file}: its lists stand too deep in one another for a recording") from None


def _is_rows(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(isinstance(one, dict) for one in value)


def _runs(found: Any, asked: bool) -> tuple[str, list[dict[str, Any]]] | None:
    """The list of runs of a file and its path; None where it holds rows or columns.

    Objects of lists, some of them long, are runs, unless they are many and a number in them rises throughout: rows
    with a stamp may hold the readings of a scanner. Where a run is asked for they are runs.
    """
    lists = [("", found)] if _is_rows(found) else [(path, rows) for path, rows in _lists(found, "") if _is_rows(rows)]
    for path, rows in lists:
        flat = [dict(_flat(row, "")) for row in rows]
        longest = [max((len(x) for x in row.values() if isinstance(x, list)), default=0) for row in flat]
        if not min(longest) or max(longest) < _A_RUN:
            continue
        if asked or len(rows) < _A_RUN or not any(_rises([row.get(name) for row in flat]) for name in flat[0]):
            return path, rows
    return None


def _rises(cells: list[Any]) -> bool:
    told = all(isinstance(cell, (int, float)) for cell in cells)
    return told and all(later > sooner for sooner, later in pairwise(cells))


def _lists(value: Any, path: str) -> Iterator[tuple[str, list[Any]]]:
    """The lists in objects, by their paths."""
    if isinstance(value, list):
        yield path, value
    elif isinstance(value, dict):
        for key, one in value.items():
            yield from _lists(one, f"{path}.{key}" if path else str(key))


def _columns(value: Any, path: str) -> Iterator[tuple[str, list[Any]]]:
    """Named lists with a number, a text or a list of them for each sample."""
    for name, cells in _lists(value, path):
        if _is_rows(cells):
            yield from _of_rows(cells, name)
        elif cells:
            yield name or "column_1", cells


def _of_rows(rows: list[dict[str, Any]], path: str) -> Iterator[tuple[str, list[Any]]]:
    flat = [dict(_flat(row, path)) for row in rows]
    for name in dict.fromkeys(name for row in flat for name in row):
        yield name, [row.get(name) for row in flat]


def _flat(row: dict[str, Any], path: str) -> Iterable[tuple[str, Any]]:
    for key, one in row.items():
        name = f"{path}.{key}" if path else str(key)
        if isinstance(one, dict):
            yield from _flat(one, name)
        else:
            yield name, one


def _width(length: int) -> str:
    return "one number" if length < 0 else f"a list of {length}"
