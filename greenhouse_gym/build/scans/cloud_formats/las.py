"""Points of LAS files, compressed (LAZ) or not, in versions 1.0 to 1.4."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.build.scans.cloud_formats.columns import Parts, every, read_records, require_all
from greenhouse_gym.build.scans.cloud_formats.native import native_output
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array

FOOT, SURVEY_FOOT = 0.3048, 1200 / 3937
"""Metres."""

_UNITS = {9001: ("metre", 1.0), 9002: ("foot", FOOT), 9003: ("US survey foot", SURVEY_FOOT), 9096: ("yard", 3 * FOOT),
          9036: ("kilometre", 1000.0), 1025: ("millimetre", 0.001), 1033: ("centimetre", 0.01)}  # fmt: skip
"""Names and metres of linear units by their numbers in the EPSG register."""

_KEYS, _DOUBLES, _TEXT = (("LASF_Projection", number) for number in (34735, 34736, 2112))
_MODEL, _SYSTEM, _HORIZONTAL, _SIZE, _VERTICAL = 1024, 3072, 3076, 3077, 4099  # keys of GeoTIFF
_GEOGRAPHIC, _OWN = 2, 32767  # values: longitude and latitude; a unit of the file's own
_UNIT = re.compile(r'\b(?:LENGTH)?UNIT\s*[\[(]\s*"([^"]*)"\s*,\s*([-+.\w]+)')
_INNER = re.compile(r"\b(?:GEOGCS|BASEGEO\w*|CONVERSION|DATUM|ENSEMBLE)\s*[\[(]")  # have units of their own
_VERTICAL_PART = re.compile(r"\bVERT(?:_CS|CRS|ICALCRS)\s*[\[(]")

_NOT_DEGREES = "the file states longitude and latitude, which its coordinates are not"

_LENGTHS = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)  # bytes of a point in the formats 0 to 10
_COLORS_AT = {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}  # byte of a point at which its colors start, by format
_COMPRESSED = 0xC0  # bits of the format
_MAX_RECORDS, _MAX_CONTENT = 10_000, 2**16  # records next to the points, and bytes of one that are read
_LASZIP = ("laszip encoded", 22204)
_DEGREES = 0.01  # extent of a row in degrees, at most
_TOO_SHORT = "not a LAS file, or cut short"


@dataclass(frozen=True)
class StatedUnits:
    """Units of the coordinates of a file.

    Attributes:
        metres: Metres per unit of x and y, or None.
        vertical: Units of x and y per unit of z.
        degrees: Whether x and y are said to be longitude and latitude.
        note: A sentence on them, or ""; with ``degrees`` it holds if the coordinates are something else.
    """

    metres: float | None = None
    vertical: float = 1.0
    degrees: bool = False
    note: str = ""


def stated_units(records: Mapping[tuple[str, int], bytes]) -> StatedUnits:
    """Return the units that records state, given their content by owner and number."""
    if records.get(_TEXT, b"").strip(b"\0 "):
        return _of_text(records[_TEXT].decode("utf-8", "replace"))
    return _of_keys(records[_KEYS], records.get(_DOUBLES, b"")) if _KEYS in records else StatedUnits()


def _of_keys(content: bytes, doubles: bytes) -> StatedUnits:
    rows = list(struct.iter_unpack("<4H", content[8 : len(content) // 8 * 8]))
    keys = {key: value for key, where, _, value in rows if where == 0}
    horizontal, vertical = (_UNITS.get(keys.get(key, 0)) for key in (_HORIZONTAL, _VERTICAL))
    if keys.get(_HORIZONTAL) == _OWN:
        at = next((8 * index for key, where, _, index in rows if key == _SIZE and where == _DOUBLES[1]), len(doubles))
        horizontal = ("a unit of its own", *struct.unpack_from("<d", doubles, at)) if at + 8 <= len(doubles) else None
    if keys.get(_MODEL) == _GEOGRAPHIC:
        return StatedUnits(degrees=True, note=_NOT_DEGREES)
    if horizontal is None and keys.get(_SYSTEM, _OWN) != _OWN:
        note = (
            f"the file states the coordinate system EPSG:{keys[_SYSTEM]}, whose unit is not looked up: give the units"
        )
        return StatedUnits(note=note)
    return _stated(horizontal, vertical)


def _of_text(text: str) -> StatedUnits:
    vertical_part = _VERTICAL_PART.search(text)
    end = vertical_part.start() if vertical_part else len(text)
    if not re.search(r"\bPROJ\w*\s*[\[(]", text[:end]) and re.search(r"\bGEO(?:GCS|GCRS|DCRS|GRAPHIC)", text[:end]):
        return StatedUnits(degrees=True, note=_NOT_DEGREES)
    return _stated(*(_first_unit(part) for part in (_outer(text[:end]), text[end:])))


def _outer(text: str) -> str:
    """Return well-known text without the parts that have units of their own."""
    while inner := _INNER.search(text):
        depth, end = 0, len(text)
        for each in re.finditer(r'"[^"]*"|[\[(]|[\])]', text[inner.start() :]):
            depth += {"[": 1, "(": 1, "]": -1, ")": -1}.get(each[0], 0)
            if depth == 0 and each[0] in "])":
                end = inner.start() + each.end()
                break
        text = text[: inner.start()] + text[end:]
    return text


def _first_unit(text: str) -> tuple[str, float] | None:
    found = _UNIT.search(text)
    try:
        return (found[1], float(found[2])) if found else None
    except ValueError:
        return None


def _stated(horizontal: tuple[str, float] | None, vertical: tuple[str, float] | None) -> StatedUnits:
    if horizontal is None or not 1e-6 < horizontal[1] < 1e6:
        return StatedUnits()
    note = f"units: the file states {horizontal[0]} ({horizontal[1]:.7g} m)"
    if vertical is None or not 1e-6 < vertical[1] < 1e6 or vertical[1] == horizontal[1]:
        return StatedUnits(horizontal[1], note=note)
    return StatedUnits(horizontal[1], vertical[1] / horizontal[1], note=f"{note}, and {vertical[0]} for heights")


@dataclass(frozen=True, eq=False)
class _Header:
    points_at: int
    dtype: np.dtype[Any]
    total: int
    scales: Array
    offsets: Array
    compressed: bool
    records: dict[tuple[str, int], tuple[int, int]]  # first byte and length, by owner and number


def read_las(path: Path) -> Parts:
    """Read points and colors, and the unit where the file states its coordinate system.

    Raises:
        FileFormatError: The header does not fit the file, points are missing, or the compressed ones are damaged.
        MissingDependencyError: The points are compressed and lazrs is not installed.
    """
    with path.open("rb") as file:
        header = _header(path, file)
        contents = {key: _bytes(file, start, min(size, _MAX_CONTENT)) for key, (start, size) in header.records.items()}
        file.seek(header.points_at)
        points = (
            _decompressed(path, header) if header.compressed else read_records(path, file, header.dtype, header.total)
        )
    positions = np.column_stack([points[axis] for axis in "xyz"]) * header.scales + header.offsets
    units = stated_units(contents)
    if units.degrees and len(positions) and np.ptp(positions[:, :2], axis=0).max() < _DEGREES:
        raise FileFormatError(path, "its coordinates are longitude and latitude; expected lengths")
    positions[:, 2] *= units.vertical
    colors = points["rgb"] if "rgb" in (header.dtype.names or ()) and points["rgb"].any() else None
    return Parts(positions, colors, None, header.total, (units.note,) if units.note else (), units.metres)


def _bytes(file: IO[bytes], start: int, size: int) -> bytes:
    file.seek(start)
    return file.read(size)


def _header(path: Path, file: IO[bytes]) -> _Header:
    start, size = file.read(375), path.stat().st_size
    if len(start) < 227 or start[:4] != b"LASF":
        raise FileFormatError(path, _TOO_SHORT)
    header_size, points_at, count, form, length, total = struct.unpack_from("<HIIBHI", start, 94)
    if not 227 <= header_size <= points_at <= size:
        raise FileFormatError(
            path, f"states {header_size} bytes of header and points from byte {points_at} on, of {size}"
        )
    spans = [*_record_spans(path, file, header_size, points_at, count, long=False)]
    if start[25] >= 4 and len(start) == 375:
        later, later_count, all_points = struct.unpack_from("<QIQ", start, 235)
        total = all_points or total
        spans += _record_spans(path, file, later, size, later_count, long=True) if later_count else []
    kind, compressed = form & ~_COMPRESSED, bool(form & _COMPRESSED)
    if kind >= len(_LENGTHS) or length < _LENGTHS[kind]:
        raise FileFormatError(path, f"points of format {kind} and {length} bytes; known are the formats 0 to 10")
    numbers = np.array(struct.unpack_from("<6d", start, 131))
    if not (np.isfinite(numbers).all() and numbers[:3].all()):
        raise FileFormatError(path, f"scales and offsets of its coordinates are {numbers.tolist()}")
    fields: list[tuple[str, Any, int]] = [("x", "<i4", 0), ("y", "<i4", 4), ("z", "<i4", 8)]
    fields += [("rgb", ("<u2", 3), _COLORS_AT[kind])] if kind in _COLORS_AT else []
    names, formats, offsets = map(list, zip(*fields, strict=True))
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": length})
    return _Header(points_at, dtype, total, numbers[:3], numbers[3:], compressed, dict(spans))


def _record_spans(
    path: Path, file: IO[bytes], start: int, end: int, count: int, long: bool
) -> Iterator[tuple[tuple[str, int], tuple[int, int]]]:
    """Yield owner and number, first byte and length of the records between two bytes of the file."""
    layout = struct.Struct("<2x16sHQ32x" if long else "<2x16sHH32x")
    if count > _MAX_RECORDS or start + count * layout.size > end:
        raise FileFormatError(path, f"states {count} records from byte {start} to {end}, which do not fit in there")
    for _ in range(count):
        head = _bytes(file, start, layout.size)
        if len(head) < layout.size:
            raise FileFormatError(path, _TOO_SHORT)
        owner, number, size = layout.unpack(head)
        start += layout.size
        yield (owner.rstrip(b"\0").decode("latin-1"), number), (start, size)
        start += size
        if start > end:
            raise FileFormatError(path, f"a record {number} of {size} bytes does not fit before byte {end}")


def _decompressed(path: Path, header: _Header) -> npt.NDArray[Any]:
    if _LASZIP not in header.records:
        raise FileFormatError(path, "compressed, without the record that says how")
    arguments = [header.points_at, *header.records[_LASZIP], header.dtype.itemsize, header.total, every(header.total)]
    with native_output(path, "write_laz", arguments, "lazrs") as file:
        points = np.fromfile(file, header.dtype)
    require_all(path, len(points) * every(header.total), header.total)
    return points
