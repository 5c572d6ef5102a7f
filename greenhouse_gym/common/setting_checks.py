"""What numbers the settings of the sensing side may hold: one check for all of their dataclasses."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import fields
from math import isfinite
from numbers import Integral, Real
from typing import Any

from greenhouse_gym.errors import InvalidValueError


def check_numbers(settings: Any, positive: Collection[str] = (), shares: Collection[str] = ()) -> None:
    """Raise an error unless every number of a dataclass is one that makes sense.

    Fields are told apart by their annotations: a ``float`` is finite and at least 0, an ``int`` whole and at least 0, a
    ``bool`` true or false, a ``tuple[float, float]`` two such numbers that go up. Only what is annotated with
    ``| None`` may be None. Other fields are not looked at.

    Args:
        settings: The dataclass.
        positive: Fields that must not be 0.
        shares: Fields that must not be larger than 1.

    Raises:
        InvalidValueError: A value is something else; the message names the field.
    """
    for field in fields(settings):
        name, value = field.name, getattr(settings, field.name)
        kind, _, optional = str(field.type).partition(" | ")
        if value is None and optional == "None":
            continue
        expected = _expected(kind, name in positive, name in shares)
        if expected and not _fits(kind, value, name in positive, name in shares):
            raise InvalidValueError(f"{name} must be {expected}, got {value!r}")


def _expected(kind: str, positive: bool, share: bool) -> str:
    start, least = ("above 0", 1) if positive else ("from 0 on", 0)
    return {
        "float": f"a number {start.removesuffix(' on')} up to 1" if share else f"a number {start}",
        "int": f"a whole number from {least} on",
        "bool": "true or false",
        "tuple[float, float]": f"two numbers {start}, the smaller one first",
    }.get(kind, "")


def _fits(kind: str, value: Any, positive: bool, share: bool) -> bool:
    if kind == "bool":
        return isinstance(value, bool)
    if kind == "tuple[float, float]":
        pair = isinstance(value, tuple | list) and len(value) == 2 and all(map(_is_number, value))
        return pair and _fits("float", value[0], positive, share) and value[0] < value[1]
    if not _is_number(value) or (kind == "int" and not isinstance(value, Integral)):
        return False
    return (value > 0 or (value == 0 and not positive)) and not (share and value > 1)


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)
