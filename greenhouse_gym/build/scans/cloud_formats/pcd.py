"""Points of PCD files: text, binary and compressed."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from itertools import dropwhile, islice
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.build.scans.cloud_formats.columns import Parts, every, named_parts, read_records, require_all
from greenhouse_gym.build.scans.cloud_formats.tables import as_declared, lines_of, numbers
from greenhouse_gym.errors import FileFormatError

_MAX_HEADER = 2**24  # bytes
_SIZES = {"I": (1, 2, 4, 8), "U": (1, 2, 4, 8), "F": (4, 8)}
_MAX_RATIO = 100  # of unpacked to packed bytes; LZF makes at most 264 bytes of 3


class _Field(NamedTuple):
    name: str
    dtype: np.dtype[Any]
    length: int

    @property
    def size(self) -> int:
        return self.dtype.itemsize * self.length


class _Header(NamedTuple):
    fields: list[_Field]
    points: int
    form: str


def read_pcd(path: Path) -> Parts:
    """Read the points.

    Raises:
        FileFormatError: The header is damaged, points are missing, or a number of a text file is missing or unreadable.
    """
    with path.open("rb") as file:
        header = _header(path, file)
        read = {"ascii": _text, "binary": _binary, "binary_compressed": _compressed}.get(header.form)
        if read is None:
            raise FileFormatError(path, f"its data are {header.form!r}; expected ascii, binary or binary_compressed")
        column = read(path, file, header)
    return named_parts(path, [field.name for field in header.fields], column, header.points)


def _header(path: Path, file: IO[bytes]) -> _Header:
    start = file.read(_MAX_HEADER)
    end = re.search(rb"(?:^|[\r\n])DATA[ \t]+\w+[ \t]*(?:\r\n|\n|\r)", start)
    if end is None:
        raise FileFormatError(path, "not a PCD file: expected a header that ends with DATA")
    file.seek(end.end())
    lines = [line.split() for line in start[: end.end()].decode("utf-8-sig", "replace").splitlines()]
    said = {line[0]: line[1:] for line in lines if line and not line[0].startswith("#")}
    names = said.get("FIELDS") or said.get("COLUMNS") or []
    counts = list(map(int, said.get("COUNT", ["1"] * len(names))))
    sizes, types = list(map(int, said.get("SIZE", []))), said.get("TYPE", [])
    if not len(names) == len(counts) == len(sizes) == len(types):
        raise FileFormatError(path, f"{len(names)} fields with {len(sizes)} sizes and {len(types)} types")
    fields = []
    for name, count, size, kind in zip(names, counts, sizes, types, strict=True):
        if size not in _SIZES.get(kind, ()) or count < 1:
            raise FileFormatError(path, f"field {name} has the type {kind!r}, size {size} and count {count}")
        fields.append(_Field(name, np.dtype(f"<{kind.lower()}{size}"), count))
    points = int(said["POINTS"][0]) if "POINTS" in said else int(said["WIDTH"][0]) * int(said["HEIGHT"][0])
    if points < 0:
        raise FileFormatError(path, f"states {points} points")
    return _Header(fields, points, said["DATA"][0])


def _text(path: Path, file: IO[bytes], header: _Header) -> Callable[[int], npt.NDArray[Any]]:
    step, fields, length = every(header.points), header.fields, file.tell()
    file.seek(0)
    first = 1 + len(re.findall(rb"\r\n|\r|\n", file.read(length)))

    def rows() -> Iterator[tuple[int, str]]:
        lines = dropwhile(lambda row: row[1].split()[0] != "DATA", lines_of(path))
        return islice(lines, 1, 1 + header.points, step)

    width = sum(field.length for field in fields)
    table = numbers(path, rows, width, first if step == 1 else None)[: header.points]
    require_all(path, len(table) * step, header.points)
    starts = np.cumsum([0, *(field.length for field in fields)])
    return lambda k: as_declared(path, fields[k].name, table[:, starts[k]], fields[k].dtype)


def _binary(path: Path, file: IO[bytes], header: _Header) -> Callable[[int], npt.NDArray[Any]]:
    layout = [(f"{k}", field.dtype, (field.length,)) for k, field in enumerate(header.fields)]
    records = read_records(path, file, np.dtype(layout), header.points)
    return lambda k: records[f"{k}"][:, 0]


def _compressed(path: Path, file: IO[bytes], header: _Header) -> Callable[[int], npt.NDArray[Any]]:
    """Return the columns of a file that holds all values of a field together, packed as one block."""
    packed, size = (int.from_bytes(file.read(4), "little") for _ in range(2))
    expected = header.points * sum(field.size for field in header.fields)
    content = file.read(packed)
    if len(content) < packed or size != expected or size > _MAX_RATIO * packed:
        raise FileFormatError(
            path,
            f"cut short or damaged: {len(content)} of {packed} bytes, for {size} unpacked ones; expected {expected}",
        )
    from greenhouse_gym.build.scans.cloud_formats.lzf_kernel import unpack

    data = np.empty(size, dtype=np.uint8)
    if (filled := unpack(np.frombuffer(content, dtype=np.uint8), data)) != size:
        end = "it cannot be unpacked" if filled < 0 else f"unpacked it has {filled} bytes"
        raise FileFormatError(path, f"damaged: {end}; expected {size}")
    starts = np.cumsum([0, *(field.size * header.points for field in header.fields)])

    def column(k: int) -> npt.NDArray[Any]:
        field = header.fields[k]
        values = np.frombuffer(data, field.dtype, field.length * header.points, int(starts[k]))
        return values.reshape(-1, field.length)[:: every(header.points), 0]

    return column
