"""Read settings from TOML or JSON files and from single assignments; write them as commented TOML.

Settings are frozen dataclasses, possibly nested, whose numbers pydantic checks against bounds. Given values replace
the fields of default settings.
"""

from __future__ import annotations

import ast
import json
import re
import textwrap
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from inspect import cleandoc, getsource
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import AfterValidator, Field, TypeAdapter, ValidationError

from greenhouse_gym.common.files import first_fault, parsing, read_bytes
from greenhouse_gym.common.own_code import CLASS, described
from greenhouse_gym.errors import FileFormatError, GreenhouseError, InvalidValueError, UnknownNameError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0)]
PositiveCount = Annotated[int, Field(gt=0)]

Settings = TypeVar("Settings")
Tree = dict[str, Any]

_NOTHING = "null"
"""Spelling of None, for which TOML has no word."""


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


def resolve(defaults: Settings, file: str | Path | None = None, assignments: Sequence[str] = ()) -> Settings:
    """Return settings with some fields replaced.

    Args:
        defaults: A dataclass of settings.
        file: A JSON file, or a TOML file (suffix ``.toml``), with any of the fields; nested settings are tables.
        assignments: Texts such as ``shapes.voxel=0.004``, applied after the file.

    Raises:
        FileFormatError: The file cannot be read, is damaged, or does not fit the settings.
        UnknownNameError: An assignment names an unknown field; the message lists the choices.
        InvalidValueError: A value does not have the field's type, or a text is not an assignment.
    """
    if file is not None:
        content = _read(Path(file))
        try:
            defaults = replaced(defaults, content)
        except GreenhouseError as error:
            raise FileFormatError(file, str(error)) from error
    for text in assignments:
        defaults = replaced(defaults, assigned(text))
    return defaults


def as_toml(settings: object, comments: bool = False) -> str:
    """Return settings as TOML that `resolve` reads; with ``comments``, fields carry their documentation.

    Fields that are None are left out, or commented out where ``comments`` is set.
    """
    return "\n".join(_lines(settings, "", comments)).strip() + "\n"


def _read(path: Path) -> Tree:
    text = read_bytes(path, "settings")
    with parsing(path, "file of settings"):
        content = tomllib.loads(text.decode()) if path.suffix.lower() == ".toml" else json.loads(text)
        if not isinstance(content, dict):
            raise ValueError("expected fields with their values")
    return content


def assigned(text: str) -> Tree:
    """Return the tree of one assignment such as ``shapes.voxel=0.004``.

    Raises:
        InvalidValueError: The text is not an assignment.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise InvalidValueError(f"setting {text!r}: expected a field and its value, as shapes.voxel=0.004")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()  # a word without quotation marks
    for part in reversed(name.strip().split(".")):
        parsed = {part: parsed}
    return parsed


def replaced(settings: Settings, content: Tree) -> Settings:
    """Return settings in which the fields of a tree replace those of ``settings``.

    Args:
        settings: A dataclass of settings.
        content: Values by field name; those of nested settings are trees.

    Raises:
        UnknownNameError: A field does not exist; the message lists the choices.
        InvalidValueError: A value does not have the field's type.
    """
    merged = _merged(settings, content, "")
    try:
        return TypeAdapter(type(settings)).validate_python(merged)
    except ValidationError as error:
        raise InvalidValueError(f"setting {first_fault(error)}") from error


def _merged(settings: object, content: Mapping[str, Any], where: str) -> Tree:
    """Return the fields of a dataclass as a tree, overridden by those of ``content``."""
    names = [field.name for field in fields(settings)]  # type: ignore[arg-type]
    tree = {name: getattr(settings, name) for name in names}
    for name, value in content.items():
        if name not in names:
            raise UnknownNameError("setting", where + name, [where + known for known in names])
        inner = getattr(settings, name)
        if is_dataclass(inner) and isinstance(value, dict) and CLASS not in value:
            tree[name] = _merged(inner, value, f"{where}{name}.")
        elif isinstance(inner, Mapping) and isinstance(value, dict) and CLASS not in value:
            tree[name] = {**inner, **value}
        elif inner is None and isinstance(value, dict) and (kind := _inner_class(settings, name)) is not None:
            tree[name] = _merged(kind(), value, f"{where}{name}.")
        else:
            tree[name] = None if value == _NOTHING else value
    return tree


def _is_nested(settings: object, name: str) -> bool:
    """Return whether a field always holds settings, rather than any object."""
    return is_dataclass(get_type_hints(type(settings))[name]) or _inner_class(settings, name) is not None


def _inner_class(settings: object, name: str) -> Any:
    """Return the dataclass that an optional field may hold, or None."""
    hint = get_type_hints(type(settings))[name]
    return next((kind for kind in get_args(hint) if is_dataclass(kind)), None)


def _lines(settings: Any, where: str, comments: bool) -> list[str]:
    said = _comments(type(settings)) if comments else {}
    summary = cleandoc(type(settings).__doc__ or "").split("\n\n")[0] if comments else ""
    own = [f"# {line}" for line in textwrap.wrap(summary, 116)]
    inner: list[str] = []
    for field in fields(settings):
        value = getattr(settings, field.name)
        if value is None and _inner_class(settings, field.name) is not None and comments:
            value, said_of = _inner_class(settings, field.name)(), said.get(field.name, "")
            inner += ["", *([f"# {said_of}"] if said_of else []), *_table(value, where + field.name, comments)]
        elif is_dataclass(value) and _is_nested(settings, field.name):
            inner += ["", *_table(value, where + field.name, comments)]
        elif value is None and field.default not in (None, MISSING):
            own.append(f"{field.name} = {_value(_NOTHING)}")
        elif value is not None or comments:
            line = f"{field.name} = {_value(value)}" if value is not None else f"# {field.name} ="
            own.append(f"{line}  # {said[field.name]}" if said.get(field.name) else line)
    return own + inner


def _table(settings: Any, where: str, comments: bool) -> list[str]:
    return [f"[{where}]", *_lines(settings, f"{where}.", comments)]


def _value(value: Any) -> str:
    """Return a value as TOML; values without a JSON form, such as paths, become text."""
    value = described(value)
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{json.dumps(name)} = {_value(part)}' for name, part in value.items())} }}"
    return json.dumps(value, default=str)


def _comments(kind: type) -> dict[str, str]:
    """Return the documentation of each field: its trailing comment, or its entry in the class docstring."""
    source = textwrap.dedent(getsource(kind))
    said = {}
    for attribute in re.finditer(r"^ {8}(\w+): (.*(?:\n {12}\S.*)*)", source, re.M):
        said[attribute[1]] = " ".join(attribute[2].split())
    lines = source.splitlines()
    body = ast.parse(source).body[0]
    assert isinstance(body, ast.ClassDef)
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            _, mark, comment = lines[(node.end_lineno or 1) - 1][node.end_col_offset or 0 :].partition("# ")
            if mark:
                said[node.target.id] = comment.strip()
    return said
