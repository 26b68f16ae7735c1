"""What may stand in a field of a task file, and the keys of one place in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from ..errors import InputError, nearest
from .taskfile import check_effect

__all__ = [
    "OF_A_FILE",
    "Columns",
    "DrivenColumns",
    "Effect",
    "Keys",
    "Label",
    "Matrix",
    "MatrixOrDiagonal",
    "Number",
    "Positive",
    "Switch",
    "Vector",
    "mistake",
]


OF_A_FILE = {"of_a_file": True}  # context of keys read from a file: YAML takes 1e-4 for a text


def _number(value: Any, info: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("expected a number")
    if isinstance(value, str | bytes) and info.context is not OF_A_FILE:
        raise ValueError(f"expected a number, not the text {value!r:.100}")
    return value


def _switch(value: Any) -> Any:
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"expected true or false, not {value!r:.100}")
    return bool(value)


def _columns(value: Any) -> Any:
    names = value if isinstance(value, (list, tuple)) else [value]
    if not names or not all(isinstance(name, str) and name for name in names):
        raise ValueError("expected the name of an array, a prefix of column names or a list of columns")
    return value if isinstance(value, str) else tuple(value)


def _driven_columns(value: Any) -> Any:
    """Columns, with 0 in the place of a joint that nothing drives."""
    if isinstance(value, (list, tuple)):
        _columns([name for name in value if isinstance(name, bool) or name != 0])
        return value
    return _columns(value)


def _diagonal(value: Any) -> Any:
    plain = isinstance(value, (list, tuple)) and all(isinstance(x, (int, float)) for x in value) and len(value) > 0
    if not plain:
        return value
    return [[x if i == j else 0.0 for j in range(len(value))] for i, x in enumerate(value)]


def _effect(name: str) -> str:
    check_effect(name)
    return name


def _label(value: Any) -> Any:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


Number = Annotated[float, BeforeValidator(_number)]
Positive = Annotated[Number, Field(gt=0)]
Switch = Annotated[bool, BeforeValidator(_switch)]
Columns = Annotated[str | tuple[str, ...], BeforeValidator(_columns)]
DrivenColumns = Annotated[str | tuple[str | Literal[0], ...], BeforeValidator(_driven_columns)]
Effect = Annotated[str, BeforeValidator(lambda name: _effect(str(name)))]
Label = Annotated[str, BeforeValidator(_label)]
Vector = tuple[Number, Number, Number]
Matrix = list[list[Number]]
MatrixOrDiagonal = Annotated[Matrix, BeforeValidator(_diagonal)]  # a plain list is a diagonal


class _Called(type(BaseModel)):  # pyright: ignore[reportUntypedBaseClass, reportGeneralTypeIssues]
    """Wrong arguments of a call from Python are one `InputError`, as those of a file are."""

    if not TYPE_CHECKING:

        def __call__(cls, *args: Any, **keys: Any) -> Any:
            if args:
                named = ", ".join(f"{key}=..." for key in cls.model_fields)
                raise InputError(f"{cls.__name__} takes its arguments by name: {cls.__name__}({named})")
            try:
                return super().__call__(**keys)
            except ValidationError as error:
                raise InputError(f"{cls.__name__}: {mistake(error.errors(include_url=False))[1]}") from None


class Keys(BaseModel, metaclass=_Called):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, value: Any) -> Any:
        known = list(cls.model_fields)
        if isinstance(value, dict):
            for key in value:
                if key not in known:
                    raise ValueError(f"unknown key '{key}'{nearest(str(key), known)}")
        elif not isinstance(value, BaseModel):
            raise ValueError(f"expected keys and values: {', '.join(known)}")
        return value


_EXPECTED = {  # pydantic's kinds of mistakes, in fewer words
    "greater_than": "more than {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "less than {lt:g}",
    "literal_error": "{expected}",
    "too_long": "{max_length} values",
    "float_type": "a number",
    "float_parsing": "a number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "finite_number": "a finite number",
    "string_type": "text",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "keys and values",
    "path_type": "the name of a file",
}


def mistake(errors: Sequence[Any]) -> tuple[tuple[str | int, ...], str]:
    """Place and text of the first mistake; where a key takes one of several forms, of all of them together."""
    place = _keys(errors[0]["loc"])
    if len(place) == len(errors[0]["loc"]):
        return place, _message(place, errors[0], _expected(errors[0]))
    same = [error for error in errors if _keys(error["loc"])[: len(place)] == place]
    depth = max(len(_keys(error["loc"])) for error in same)
    near = [error for error in same if len(_keys(error["loc"])) == depth]  # of the form that was meant
    forms = list(dict.fromkeys(_expected(error) for error in near))
    text = " or ".join([", ".join(forms[:-1]), forms[-1]] if len(forms) > 1 else forms)
    place = _keys(near[0]["loc"])
    return place, _message(place, near[0], text)


def _keys(place: Sequence[str | int]) -> tuple[str | int, ...]:
    """Of a place, the keys of the task file, without the forms that pydantic tells apart."""
    return tuple(part for part in place if isinstance(part, int) or "[" not in part)


def _expected(error: Any) -> str:
    kind = error["type"]
    if kind == "value_error":
        return str(error["ctx"]["error"]).removeprefix("expected ")
    return _EXPECTED[kind].format(**error.get("ctx", {})) if kind in _EXPECTED else error["msg"]


def _message(place: Sequence[str | int], error: Any, expected: str) -> str:
    """One mistake in the words of the task file."""
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).lstrip(".")
    if error["type"] == "missing":
        return f"{key} is missing"
    if error["type"] == "value_error":
        return f"{key}: {error['ctx']['error']}" if key else str(error["ctx"]["error"])
    return f"{key} is {error['input']!r:.80}, expected {expected}"
