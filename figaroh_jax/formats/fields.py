"""What may stand in a field of a task file, and the keys of one place in it."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from ..errors import nearest
from .taskfile import CONTRACT_EFFECTS

__all__ = ["Columns", "Effect", "Keys", "Label", "Matrix", "MatrixOrDiagonal", "Number", "Positive", "Vector"]


def _not_bool(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("expected a number")
    return value


def _columns(value: Any) -> Any:
    names = value if isinstance(value, (list, tuple)) else [value]
    if not names or not all(isinstance(name, str) and name for name in names):
        raise ValueError("expected the name of an array, a prefix of column names or a list of columns")
    return value if isinstance(value, str) else tuple(value)


def _diagonal(value: Any) -> Any:
    plain = isinstance(value, (list, tuple)) and all(isinstance(x, (int, float)) for x in value) and len(value) > 0
    if not plain:
        return value
    return [[x if i == j else 0.0 for j in range(len(value))] for i, x in enumerate(value)]


def _effect(name: str) -> str:
    from ..effects.catalogue import CATALOGUE

    known = list(dict.fromkeys([*CATALOGUE, *CONTRACT_EFFECTS]))
    if name not in known:
        raise ValueError(f"no effect '{name}'{nearest(name, known)}")
    return name


def _label(value: Any) -> Any:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


Number = Annotated[float, BeforeValidator(_not_bool)]
Positive = Annotated[Number, Field(gt=0)]
Columns = Annotated[str | tuple[str, ...], BeforeValidator(_columns)]
Effect = Annotated[str, BeforeValidator(lambda name: _effect(str(name)))]
Label = Annotated[str, BeforeValidator(_label)]
Vector = tuple[Number, Number, Number]
Matrix = list[list[Number]]
MatrixOrDiagonal = Annotated[Matrix, BeforeValidator(_diagonal)]  # a plain list is a diagonal


class Keys(BaseModel):
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
