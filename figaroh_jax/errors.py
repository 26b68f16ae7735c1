"""The errors that a user can cause; the command line turns them into one message and exit status 2."""

from __future__ import annotations

import difflib
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from typing import Any

_MOST_KNOWN, _MOST_LISTED, _LONGEST_WORD = 1000, 100, 100  # a file may hold ten thousand names of any length


class InputError(ValueError):
    """Wrong input: the message says what is wrong, in which file, key, row or joint, and what would be right."""


class NotSupported(InputError):
    """A backend was asked for what its library does not give; the message names those that do."""


def check_real(name: str, array: Any) -> None:
    """Raise `InputError` naming an array that holds anything but real numbers: complex ones, text, objects.

    Converted to float64, complex numbers would lose their imaginary part and text would be read as numbers.
    """
    dtype = getattr(array, "dtype", None)
    kind = "R" if getattr(dtype, "names", None) else getattr(dtype, "kind", None)
    if kind is None:
        import numpy as np

        try:
            kind = np.asarray(array).dtype.kind
        except Exception as error:
            if type(error).__module__.partition(".")[0] == "jax":
                return  # a list of what JAX traces: NumPy may not look into it, JAX checks it later
            if not isinstance(error, (TypeError, ValueError)):
                raise
            raise InputError(f"{name} is not an array of numbers: {str(error)[:200]}") from None  # rows of many lengths
    if kind not in "biufV":  # V: bfloat16 and the like
        held = {"c": "complex numbers", "U": "text", "S": "bytes", "O": "objects", "R": "records", "M": "dates"}.get(
            kind, f"data of kind '{kind}'"
        )
        raise InputError(f"{name} holds {held}; real numbers are expected")


@contextmanager
def as_written(what: object) -> Iterator[None]:
    """What breaks while a file of the library's own is used (changed or damaged since) becomes an `InputError`."""
    try:
        yield
    except InputError:
        raise
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        said = f"{type(error).__name__}: {str(error)[:200]}"
        raise InputError(f"{what}: is not what figaroh-jax writes; was it changed or damaged? ({said})") from error


def check_list(name: str, given: Any) -> None:
    """Refuse one thing where a list of such is expected."""
    if not isinstance(given, Iterable):
        raise InputError(f"{name} is one {type(given).__name__}; a list is expected, of one too: [{name[:-1]}]")


def check_each(name: str, given: Any, kind: type | tuple[type, ...], hint: str) -> None:
    """Refuse what is not a list of things of one kind; the message ends in how one is made."""
    check_list(name, given)
    for one in [given] if isinstance(given, str) else given:
        if not isinstance(one, kind):
            raise InputError(f"{name}: {_a(kind)} is expected, got a {type(one).__name__}: {hint}")


def check_kind(name: str, given: Any, kind: type | tuple[type, ...], hint: str) -> None:
    """Refuse what is of none of the kinds; the message ends in what would be right."""
    if not isinstance(given, kind):
        told = f"the text '{given[:100]}'" if isinstance(given, str) else f"of type {type(given).__name__}"
        raise InputError(f"{name} is {told}; {_a(kind)} is expected: {hint}")


def _a(kind: type | tuple[type, ...]) -> str:
    names = [one.__name__ for one in (kind if isinstance(kind, tuple) else (kind,))]
    return " or ".join(f"{'an' if name[0] in 'AEIOUaeiou' else 'a'} {name}" for name in names)


def check_callable(name: str, given: Any, hint: str) -> None:
    """Refuse what cannot be called; the message ends in what would be right."""
    if not callable(given):
        raise InputError(f"{name} is {given!r:.100}; a function is expected: {hint}")


def check_one_of(name: str, given: Any, known: Sequence[str]) -> None:
    """Refuse what is none of the known words."""
    if given not in known:
        near = nearest(given, known) if isinstance(given, str) else f"; known: {', '.join(known)}"
        raise InputError(f"{name} is {given!r:.100}{near}")


def check_path(name: str, given: Any) -> None:
    """Refuse what is no path: neither text nor what `os` takes as one."""
    if not isinstance(given, (str, os.PathLike)):
        kind = type(given).__name__
        raise InputError(f"{name} is {None if given is None else f'of type {kind}'}; the path of a file is expected")


def check_finite(name: str, array: Any, least: float = -math.inf) -> None:
    """Refuse all but real, finite numbers of `least` or more; what JAX traces passes."""
    check_real(name, array)
    import numpy as np

    try:
        values = np.asarray(array, float)
    except Exception as error:
        if type(error).__module__.partition(".")[0] != "jax":
            raise
        return
    wrong = ~(np.isfinite(values) & (values >= least))
    if wrong.any():
        bound = f" of {least:g} or more" * math.isfinite(least)
        told = "holds" if values.ndim else "is"
        raise InputError(f"{name} {told} {values[wrong].flat[0]:g}; finite numbers{bound} are expected")


def check_count(name: str, given: Any, least: int = 1) -> None:
    """Refuse all but one whole number of `least` or more."""
    if isinstance(given, bool) or not hasattr(given, "__index__") or given.__index__() < least:
        told = f"the text '{given[:100]}'" if isinstance(given, str) else f"{given!r:.100}"
        raise InputError(f"{name} is {told}; a whole number of {least} or more is expected")


def check_positive(name: str, given: Any, unit: str, below: float = math.inf) -> None:
    """Refuse all but one finite number above zero, and below another; what JAX traces passes."""
    if isinstance(given, bool | str | bytes) or getattr(given, "ndim", 0):
        wrong = True
    else:
        try:
            wrong = not 0 < float(given) < below
        except (TypeError, ValueError) as error:
            wrong = not (type(error).__module__.partition(".")[0] == "jax")
    if wrong:
        told = f"the text '{given[:100]}'" if isinstance(given, str) else f"{given!r:.100}"
        raise InputError(
            f"{name} is {told}; expected a number of {unit} above zero{f' and below {below:g}' * (below < math.inf)}"
        )


def check_switch(name: str, given: Any) -> None:
    """Refuse all but True and False; of a text such as "no" Python would make True."""
    import numpy as np

    if not isinstance(given, bool | np.bool_):
        told = f"the text '{given[:100]}'" if isinstance(given, str) else f"{given!r:.100}"
        raise InputError(f"{name} is {told}; True or False is expected")


def check_names(name: str, given: Any) -> None:
    """Refuse what is no list of names where one is expected; of one text the letters would be taken for names."""
    if not (given is None or isinstance(given, Iterable)):
        raise InputError(f"{name} is {given!r:.100}; a list of names is expected")
    if isinstance(given, str):
        raise InputError(f"{name} is the text '{given[:100]}'; a list is expected, of one name too: ['{given[:100]}']")


def nearest(name: str, known: Iterable[str]) -> str:
    """Text that names the known word nearest to `name`, or lists all of them: `"; did you mean 'joint_3'?"`."""
    words = [str(word) for word in islice(known, _MOST_KNOWN)]
    short = [word for word in words if len(word) <= _LONGEST_WORD]
    close = difflib.get_close_matches(str(name)[:_LONGEST_WORD], short, n=1, cutoff=0.5)
    if close:
        return f"; did you mean '{close[0]}'?"
    listed = ", ".join(word[:_LONGEST_WORD] for word in words[:_MOST_LISTED])
    return f"; known: {listed}{', ...' * (len(words) > _MOST_LISTED)}" if words else ""
