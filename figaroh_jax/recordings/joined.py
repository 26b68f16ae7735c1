"""Columns that a table holds in pieces: a stamp in two halves, and joints whose names stand in a column of their own.

Each gets one name more, of a draft and of a task alike: `header.stamp.secs+nsecs` (s since the first second), and
`position.elbow` for that column of `position`, or that one of `position[0]`, `position[1]`, ..., beside which `name`
says elbow.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from .tables import Table

__all__ = ["in_halves", "joined"]

_COARSE = re.compile(r"(.*?)(sec|secs|seconds)", re.IGNORECASE)
_UNITS = {1e-9: ("nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds"), 1e-6: ("usec", "usecs", "microseconds")}
_FINE = {name: unit for unit, names in _UNITS.items() for name in names}
_NAME = re.compile(r"((?:.*[^A-Za-z])?)(?:joint_?)?names?[\[._]?(\d*)\]?", re.IGNORECASE)
_JOINT_ARRAY = re.compile(r"(position|velocity|velocitie|effort|torque|command|q|dq|qd|tau|pos|vel|eff|current)s?")
_NUMBERED = re.compile(r"([A-Za-z]+)[\[._]?(\d+)\]?")


def joined(table: Table) -> Table:
    """The table with the columns that it holds in pieces, and the pieces as `Table.pieces`."""
    added: dict[str, Callable[[], np.ndarray]] = {}
    pieces: set[str] = set()
    for coarse, fine, unit in _halves(table.names):
        added[f"{coarse}+{fine[_start(coarse) :]}"] = partial(_sum, table, coarse, fine, unit)
        pieces |= {coarse, fine}
    for name, read, of in _by_joint(table):
        added[name] = read
        pieces |= {*of}
    added = {name: read for name, read in added.items() if name not in table.names}
    if not added:
        return table
    names = (*table.names, *added)
    return table._replace(
        names=names, pieces=frozenset(pieces), read=lambda name: added[name]() if name in added else table.read(name)
    )


def in_halves(name: str) -> bool:
    """Whether a column is a stamp that was joined from two."""
    coarse, plus, fine = name.rpartition("+")
    return bool(plus) and _COARSE.fullmatch(coarse) is not None and fine.lower() in _FINE


def _start(coarse: str) -> int:
    found = _COARSE.fullmatch(coarse)
    assert found is not None
    return found.end(1)


def _halves(names: Sequence[str]) -> Iterator[tuple[str, str, float]]:
    """Seconds, the part of a second beside them, and its unit in s."""
    for coarse in names:
        found = _COARSE.fullmatch(coarse)
        before = "" if found is None else found[1]
        if found is not None and not before[-1:].isalpha():
            fine = [n for n in names if n.startswith(before) and n[len(before) :].lower() in _FINE]
            if len(fine) == 1:
                yield coarse, fine[0], _FINE[fine[0][len(before) :].lower()]


def _sum(table: Table, coarse: str, fine: str, unit: float) -> Float[np.ndarray, " samples"]:
    seconds, part = table.vector(coarse, "time"), table.vector(fine, "time")
    if len(seconds) != len(part):
        raise InputError(f"{table.file}: '{coarse}' has {len(seconds)} rows, '{fine}' {len(part)}")
    wrong = np.flatnonzero(~((part >= 0) & (part * unit < 1)))
    if len(wrong):
        raise InputError(
            f"{table.file}: '{fine}' is {part[wrong[0]]:.9g} in row {wrong[0]} (from 0), which is no part of a second"
        )
    return (seconds - seconds[:1]) + part * unit


def _by_joint(table: Table) -> Iterator[tuple[str, Callable[[], np.ndarray], tuple[str, ...]]]:
    """Each joint's column of each quantity beside a column of names: its name, its numbers, what it is made of."""
    befores = dict.fromkeys(found[1] for name in table.names if (found := _NAME.fullmatch(name)))
    for before in befores:
        names = _joint_names(table, before)
        if names is None:
            continue
        joints = dict.fromkeys(str(name) for name in names.ravel() if name)
        if any(((names == joint).sum(axis=1) > 1).any() for joint in joints):
            continue
        for quantity, of in _quantities(table, before, names):
            yield from ((f"{quantity}.{joint}", partial(_picked, table, of, names, joint), of) for joint in joints)


def _joint_names(table: Table, before: str) -> np.ndarray | None:
    """The names in the columns that begin so: a row for each sample, or one for all."""
    found = {name: match[2] for name in table.names if (match := _NAME.fullmatch(name)) and match[1] == before}
    numbered = sorted((name for name, number in found.items() if number), key=lambda name: int(found[name]))
    columns = [table.words(name) for name in numbered or found]
    words = [column for column in columns if column is not None]
    if len(words) != len(columns) or not words:
        return None
    if numbered:
        if any(column.ndim != 1 for column in words) or len({len(column) for column in words}) > 1:
            return None
        names = np.stack(words, axis=1)
    elif len(words) > 1:
        return None
    elif table.file.suffix.lower() == ".npz":
        names = np.atleast_2d(words[0])
    else:  # cells as ['shoulder', 'elbow']
        cells = {cell: [part.strip(" '\"") for part in cell.strip("[]() ").split(",")] for cell in {*words[0]}}
        if len({len(parts) for parts in cells.values()}) > 1:
            return None
        names = np.array([cells[cell] for cell in words[0]])
    if names.ndim != 2 or not names.size:
        return None
    return names[:1] if (names == names[:1]).all() else names


def _quantities(table: Table, before: str, names: np.ndarray) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Quantities of the joints beside their names: one array, or columns that are numbered as the names are."""
    numbered: dict[str, dict[int, str]] = {}
    wide = names.shape[1]
    for name in table.names:
        rest = name.removeprefix(before)
        if not name.startswith(before) or _NAME.fullmatch(name):
            continue
        found = _NUMBERED.fullmatch(rest)
        if found is not None and _JOINT_ARRAY.fullmatch(found[1].lower()):
            numbered.setdefault(found[1], {})[int(found[2])] = name
        elif _JOINT_ARRAY.fullmatch(rest.lower()) and table.words(name) is None:
            with suppress(InputError):  # what cannot be read is refused once it is asked for
                values = table.read(name)
                if values.ndim == 2 and values.shape[1] == wide and len(names) in (1, len(values)):
                    yield name, (name,)
    for quantity, columns in numbered.items():
        if sorted(columns) in ([*range(wide)], [*range(1, wide + 1)]):
            yield before + quantity, tuple(columns[k] for k in sorted(columns))


def _picked(table: Table, of: tuple[str, ...], names: np.ndarray, joint: str) -> Float[np.ndarray, " samples"]:
    """The joint's numbers, row by row where the order changes; NaN in rows that do not name it."""
    values = table.read(of[0]) if len(of) == 1 else None
    values = np.stack([table.vector(name, joint) for name in of], axis=1) if values is None else values
    own = np.broadcast_to(names == joint, values.shape)
    return np.where(own.any(axis=1), values[np.arange(len(values)), own.argmax(axis=1)], np.nan)
