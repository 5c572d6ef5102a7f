"""Bounds of numbers in settings, checked by pydantic for all settings of the sensing side."""

from __future__ import annotations

from collections.abc import Collection
from functools import cache
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from greenhouse_gym.errors import InvalidValueError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0)]
PositiveCount = Annotated[int, Field(gt=0)]


def check_numbers(settings: object, positive: Collection[str] = (), fractions: Collection[str] = ()) -> None:
    """Raise an error unless every field of a dataclass holds a value of its type, within its bounds.

    Bounds are annotated (``voxel: Positive``). A number without bounds must be finite and at least 0, and the two
    numbers of a ``tuple[float, float]`` must ascend.

    Args:
        settings: The dataclass.
        positive: Fields that must not be 0, where that is not annotated.
        fractions: Fields that must not exceed 1, where that is not annotated.

    Raises:
        InvalidValueError: A value is out of its bounds or of another type; the message names field, bounds and value.
    """
    kind: Any = type(settings)
    for name, adapter in _adapters(kind, frozenset(positive), frozenset(fractions)).items():
        value = getattr(settings, name)
        try:
            adapter.validate_python(value.item() if isinstance(value, np.generic) else value, strict=True)
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]["msg"].removeprefix("Value error, ")
            raise InvalidValueError(f"{name}: {problem}, got {value!r}") from error


@cache
def _adapters(kind: Any, positive: frozenset[str], fractions: frozenset[str]) -> dict[str, TypeAdapter[Any]]:
    """Return a validator for each field of a dataclass."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: TypeAdapter(_bounded(hint, name in positive, name in fractions)) for name, hint in hints.items()}


def _bounded(hint: Any, positive: bool, fraction: bool) -> Any:
    """Return a type with bounds on its plain numbers."""
    if hint is int:
        return PositiveCount if positive else Count
    if hint is float:
        lowest: dict[str, Any] = {"gt": 0} if positive else {"ge": 0}
        return Annotated[float, Field(**lowest, le=1 if fraction else None, allow_inf_nan=False)]
    if get_origin(hint) in (Union, UnionType):
        return Union[tuple(_bounded(each, positive, fraction) for each in get_args(hint))]  # noqa: UP007
    if hint == tuple[float, float]:
        number = _bounded(float, positive, fraction)
        return Annotated[tuple[number, number], AfterValidator(_ascending)]  # type: ignore[valid-type]
    return hint


def _ascending(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] >= ends[1]:
        raise ValueError("Input should be two ascending numbers")
    return ends
