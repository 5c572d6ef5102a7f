"""Clouds as tables: text whose columns a header may name, and NumPy's files."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.build.scans.cloud_formats.columns import (
    POSITIONAL,
    Parts,
    every,
    holds_positions,
    named_parts,
    positional_parts,
    require_all,
)
from greenhouse_gym.common.array_files import read_array, read_arrays
from greenhouse_gym.common.files import MAX_BYTES, read_bytes, text_encoding
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array

Rows = Iterable[tuple[int, str]]
"""Lines with their numbers in the file."""

_MAX_LINE = 2**20  # characters
_MAX_HEADER = 1000  # lines
_COMMENT = ("#", "/", "%")
_MIN_ROW = 6  # characters of the shortest row: three digits, each with a separator
_SHOWN = 60  # characters of a line in a message
_DIGIT = re.compile(r"[-+]?\.?\d")  # at the start of a number
_NO_NUMBER = re.compile(r"[-+]?(nan(\(\w*\))?|1\.#(qnan|snan|ind|inf)0*)", re.IGNORECASE)
"""Other spellings of values that are not finite."""

_KIND = "cloud of points"
_NAMES = {
    "points": ("points", "positions", "xyz", "vertices"),
    "colors": ("colors", "color", "rgb"),
    "normals": ("normals", "normal"),
}


class _Layout(NamedTuple):
    """Layout of a text file: names of its columns or (), its separator, its first row and stated number of rows."""

    names: list[str]
    separator: str | None
    first: int
    stated: int
    width: int


def read_text(path: Path) -> Parts:
    """Read rows of x y z, optionally with colors and normals, or with the columns that a header names.

    Raises:
        FileFormatError: A row has a missing or unreadable number, or the columns cannot be distinguished.
    """
    layout = _layout(path)

    def rows(step: int = 1) -> Rows:
        lines = ((n, row) for n, row in lines_of(path) if n >= layout.first and not row.lstrip().startswith(_COMMENT))
        for number, line in islice(lines, None, None, step):
            text = line.partition(" #")[0]  # a comment; not that of 1.#QNAN
            yield number, text.replace(layout.separator, " ") if layout.separator else text

    total = sum(1 for _ in rows()) if every(path.stat().st_size // _MIN_ROW) > 1 else 0
    first = layout.first if every(total) == 1 else None
    table = numbers(path, lambda: rows(every(total)), layout.width, first, layout.separator)
    total = max(total, len(table))
    require_all(path, total, layout.stated)
    if layout.names:
        return named_parts(path, layout.names, lambda k: table[:, k], total)
    return positional_parts(path, table, total)


def lines_of(path: Path) -> Iterator[tuple[int, str]]:
    """Yield lines that are not empty, with their numbers.

    Raises:
        FileFormatError: A line is longer than a megabyte.
    """
    with path.open(encoding=text_encoding(path), errors="replace") as file:
        for number, line in enumerate(iter(lambda: file.readline(_MAX_LINE), ""), 1):
            if len(line) == _MAX_LINE:
                raise FileFormatError(path, f"line {number} is longer than {_MAX_LINE} characters")
            if not line.isspace():
                yield number, line


def numbers(
    path: Path, rows: Callable[[], Rows], width: int, first: int | None = None, separator: str | None = None
) -> Array:
    """Return rows of numbers as a table (n, width).

    Args:
        path: The file.
        rows: Returns the rows with white space between their numbers, once per call.
        width: Numbers in a row.
        first: Number of the first row's line if the rows are all further lines of the file; this is read faster.
        separator: Separator of the numbers in the file.

    Raises:
        FileFormatError: A row has another number of columns, or something that is no number.
    """
    try:
        if first is None:
            table = np.loadtxt((line for _, line in rows()), comments=None, ndmin=2)
        else:
            encoding = text_encoding(path)
            table = np.loadtxt(
                str(path), comments=None, delimiter=separator, skiprows=first - 1, ndmin=2, encoding=encoding
            )
    except ValueError:
        values = chain.from_iterable(_row(path, number, line, width) for number, line in rows())
        table = np.fromiter(values, np.float64).reshape(-1, width)
    if table.shape[1] != width and len(table):
        number, line = next(iter(rows()))
        _row(path, number, line, width)
    return table.reshape(-1, width)


def as_declared(path: Path, name: str, column: Array, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return a column (n,) of text as the integers it is declared to hold; others remain as they are.

    Raises:
        FileFormatError: A value is no such integer.
    """
    if dtype.kind == "f" or not np.isfinite(column).all():
        return column
    limits = np.iinfo(dtype)
    if ((column < limits.min) | (column > limits.max) | (column != np.floor(column))).any():
        raise FileFormatError(path, f"{name} from {column.min():g} to {column.max():g}; expected integers, {dtype}")
    return column.astype(dtype)


def _row(path: Path, number: int, line: str, width: int) -> list[float]:
    words = line.split()
    if len(words) != width:
        raise FileFormatError(path, f"line {number}: {len(words)} numbers, expected {width}: {line.strip()[:_SHOWN]!r}")
    values = [_number(word) for word in words]
    if None in values:
        word = words[values.index(None)]
        raise FileFormatError(path, f"line {number}: {word[:_SHOWN]!r} is no number (such as 0.25)")
    return values  # type: ignore[return-value]


def _number(word: str) -> float | None:
    if _NO_NUMBER.fullmatch(word):
        return np.nan
    try:
        return None if "_" in word else float(word)
    except ValueError:
        return None


def _layout(path: Path) -> _Layout:
    header: list[str] = []
    stated = 0
    for number, line in islice(lines_of(path), _MAX_HEADER):
        text = line.strip()
        separator = _separator(text)
        words = (text.replace(separator, " ") if separator else text).split()
        if text.startswith(_COMMENT) or not any(_DIGIT.match(word) or _number(word) is not None for word in words):
            header.append(text.lstrip("".join(_COMMENT)))
        elif not stated and len(words) == 1 and text.isdecimal() and len(text) < 12:
            stated = int(text)
        else:
            _row(path, number, " ".join(words), len(words))
            names, expected = _names(header, separator, len(words))
            if expected:
                raise FileFormatError(
                    path, f"line {number}: {len(words)} numbers, expected {expected}: {text[:_SHOWN]!r}"
                )
            return _Layout(names, separator, number, stated, len(words))
    raise FileFormatError(path, "holds no rows of numbers")


def _separator(row: str) -> str | None:
    """Return the separator of a row of numbers; None for white space.

    Commas inside of several words are decimal commas, which are no numbers here.
    """
    if ";" in row:
        return ";"
    words = row.split()
    return "," if "," in row and (len(words) == 1 or any("," in (word[0], word[-1]) for word in words)) else None


def _names(header: list[str], separator: str | None, width: int) -> tuple[list[str], str]:
    """Return the names of the columns by the last line of a header that names x, y and z, or an empty list.

    Also return the expected number of columns as words if ``width`` is not possible, else "".
    """
    for line in reversed(header):
        text = re.sub(r"[\[(][^\])]*[\])]", "", line)
        for names in (text.split(separator), re.split(r"[\s,;]+", text.strip())):
            if holds_positions(names) and len(names) == width:
                return [name.strip() for name in names], ""
        if holds_positions(names) and width > 3:
            return [], f"the {len(names)} that its header names"
    return [], "" if width in POSITIONAL else "3, 6 or 9, or a header that names the columns"


def read_npy(path: Path) -> Parts:
    """Read an array whose last axis holds x y z and optionally r g b and a normal, or whose fields have such names.

    Raises:
        FileFormatError: The array has another shape or type.
    """
    array = read_array(read_bytes(path, _KIND))
    if names := array.dtype.names:
        rows = array.reshape(-1)
        return named_parts(path, names, lambda k: rows[names[k]], len(rows))
    return positional_parts(path, array)


def read_npz(path: Path) -> Parts:
    """Read the arrays points, colors and normals, whose last axis has the length 3; colors may have an opacity, too.

    Raises:
        FileFormatError: There are no points.
    """
    arrays = read_arrays(read_bytes(path, _KIND), MAX_BYTES[_KIND])
    names = {name.lower(): name for name in arrays}
    points, colors, normals = (
        next((arrays[names[name]] for name in known if name in names), None) for known in _NAMES.values()
    )
    if points is None:
        raise FileFormatError(path, f"expected the arrays points, colors and normals; it has {', '.join(arrays)}")
    if colors is not None and colors.shape[-1:] == (4,):
        colors = colors[..., :3]
    rows = [each if each is None or each.ndim < 2 else each.reshape(-1, each.shape[-1]) for each in (colors, normals)]
    return Parts(points.reshape(-1, *points.shape[-1:]), colors=rows[0], normals=rows[1])
