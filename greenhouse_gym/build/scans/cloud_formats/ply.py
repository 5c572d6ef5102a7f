"""Points of PLY files: text or binary of either byte order, with any elements before and after the points."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from itertools import dropwhile, islice
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.build.scans.cloud_formats.columns import Parts, every, named_parts, read_records, require_all
from greenhouse_gym.build.scans.cloud_formats.tables import as_declared, lines_of, numbers
from greenhouse_gym.errors import FileFormatError

_MAX_HEADER = 2**24  # bytes
_POINTS = ("vertex", "vertices", "point", "points")
_ORDERS = {b"binary_little_endian": "<", b"binary_big_endian": ">", b"ascii": ""}
_TYPES = {
    name: code
    for code, names in {"i1": "char int8", "u1": "uchar uint8", "i2": "short int16", "u2": "ushort uint16",
                        "i4": "int int32", "u4": "uint uint32", "f4": "float float32", "f8": "double float64"}.items()
    for name in names.split()
}  # fmt: skip

_LETTERS = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}  # of struct


class _Property(NamedTuple):
    name: str
    type: str
    count_type: str  # of a list, "" otherwise


class _Element(NamedTuple):
    name: str
    total: int
    properties: list[_Property]


def read_ply(path: Path) -> Parts:
    """Read the points.

    Raises:
        FileFormatError: The header is damaged, points are missing, or a number of a text file is missing or unreadable.
    """
    with path.open("rb") as file:
        order, elements = _header(path, file)
        index = next((i for i, element in enumerate(elements) if element.name in _POINTS), None)
        if index is None:
            raise FileFormatError(path, f"has the elements {', '.join(e.name for e in elements)}; expected vertex")
        points = elements[index]
        if not order:
            length = file.tell()
            file.seek(0)
            first = 1 + len(re.findall(rb"\r\n|\r|\n", file.read(length)))
            alone = sum(element.total for element in elements) == points.total
            return _from_text(
                path, sum(element.total for element in elements[:index]), points, first if alone else None
            )
        for element in elements[:index]:
            _skip(path, file, element, order)
        records = _records(path, file, points, order)
    names = records.dtype.names or ()
    return named_parts(path, names, lambda k: records[names[k]], points.total)


def _header(path: Path, file: IO[bytes]) -> tuple[str, list[_Element]]:
    """Return the byte order, "" for text, and the elements; leave the file at the first of them."""
    start = file.read(_MAX_HEADER)
    first = re.match(rb"(?:\xef\xbb\xbf)?ply[ \t]*(\r\n|\n|\r)", start)
    newline = first[1] if first else b"\n"
    end = re.search(newline + rb"end_header[ \t]*" + newline, start)
    if first is None or end is None:
        raise FileFormatError(path, "not a PLY file: expected a header from ply to end_header")
    file.seek(end.end())
    order, elements = None, list[_Element]()
    for line in start[first.end() : end.start()].split(newline):
        words = [word.decode("latin-1") for word in line.split()]
        match words:
            case ["format", form, _]:
                order = _ORDERS.get(form.encode())
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count_type, kind, name] if elements and {count_type, kind} <= _TYPES.keys():
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[count_type]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[kind], ""))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise FileFormatError(path, f"a line of its header cannot be read: {' '.join(words)[:80]!r}")
    if order is None:
        raise FileFormatError(path, f"states no format; known are {', '.join(key.decode() for key in _ORDERS)}")
    return order, elements


def _scalars(element: _Element) -> list[_Property]:
    """Return the properties before the first list, which have the same places in all records."""
    firsts = (i for i, each in enumerate(element.properties) if each.count_type)
    return element.properties[: next(firsts, None)]


def _dtype(properties: list[_Property], order: str) -> np.dtype[Any]:
    return np.dtype([(each.name, order + each.type) for each in properties])


def _from_text(path: Path, before: int, points: _Element, first: int | None) -> Parts:
    """Read the points after ``before`` lines of other elements; ``first`` is their first line if there are none."""
    scalars = _scalars(points)
    whole = len(scalars) == len(points.properties)

    def rows() -> Iterator[tuple[int, str]]:
        lines = dropwhile(lambda row: row[1].strip() != "end_header", lines_of(path))
        for number, line in islice(lines, 1 + before, 1 + before + points.total, every(points.total)):
            yield number, line if whole else " ".join(line.split()[: len(scalars)])

    fast = whole and every(points.total) == 1
    table = numbers(path, rows, len(scalars), first if fast else None)[: points.total]
    require_all(path, len(table) * every(points.total), points.total)
    names = [each.name for each in scalars]
    return named_parts(
        path, names, lambda k: as_declared(path, names[k], table[:, k], np.dtype(scalars[k].type)), points.total
    )


def _skip(path: Path, file: IO[bytes], element: _Element, order: str) -> None:
    if any(each.count_type for each in element.properties):
        start = file.tell()
        _, length = _read_rows(path, file.read(), element, order)
        file.seek(start + length)
        return
    end = file.tell() + element.total * _dtype(element.properties, order).itemsize
    if end > path.stat().st_size:
        raise FileFormatError(path, f"cut short among its {element.total} elements {element.name}")
    file.seek(end)


def _records(path: Path, file: IO[bytes], points: _Element, order: str) -> npt.NDArray[Any]:
    """Return every k-th point with its properties before the first list."""
    dtype = _dtype(_scalars(points), order)
    if len(_scalars(points)) == len(points.properties):
        return read_records(path, file, dtype, points.total)
    content = file.read()
    starts, _ = _read_rows(path, content, points, order)
    kept = np.array(starts[:: every(points.total)], dtype=np.int64)
    there = np.frombuffer(content, np.uint8)[kept[:, None] + np.arange(dtype.itemsize)]
    return there.view(dtype)[:, 0]


def _read_rows(path: Path, content: bytes, element: _Element, order: str) -> tuple[list[int], int]:
    """Return the first byte of each record of an element with lists, and the end of the last one."""
    steps: list[tuple[struct.Struct, int]] = []  # each ends with the length of a list, whose items have a size
    layout = ""
    for each in element.properties:
        if each.count_type:
            steps.append((struct.Struct(order + layout + _LETTERS[each.count_type]), np.dtype(each.type).itemsize))
            layout = ""
        else:
            layout += f"{np.dtype(each.type).itemsize}x"
    rest = struct.calcsize(order + layout)
    starts, at = [], 0
    try:
        for _ in range(element.total):
            starts.append(at)
            for fields, size in steps:
                length = int(fields.unpack_from(content, at)[0])
                if length < 0:
                    raise FileFormatError(
                        path, f"element {element.name} {len(starts) - 1} has a list of length {length}"
                    )
                at += fields.size + length * size
            at += rest
    except struct.error:
        at = len(content) + 1
    if at > len(content):
        raise FileFormatError(path, f"cut short: fewer than {element.total} elements {element.name} are there")
    return starts, at
