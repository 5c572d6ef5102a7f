"""Units of a LAS file by its records on the coordinate system: GeoTIFF keys or well-known text."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass

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
