"""Read the shapes of scene files all at once, which takes a tenth of the time of one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pydantic import ValidatorFunctionWrapHandler, WrapValidator

from greenhouse_gym.crops.parts import STEM_KINDS, Stem, Tomato
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box, Capsule, Ellipsoid, Shape, Sphere, shapes_of, unchecked

Row = dict[str, Any]

_FIELDS: dict[type[Shape], tuple[str, ...]] = {
    Sphere: ("center", "radius"),
    Ellipsoid: ("center", "semi_axes", "rotation", "radius"),
    Capsule: ("start", "end", "radius"),
    Box: ("center", "half_extents", "rotation"),
}


def in_bulk(read: Callable[[Sequence[Row]], Sequence[Any]], limit: int) -> WrapValidator:
    """Return a validator that reads lists of objects at once, and one by one if that fails: this names the fault.

    Args:
        read: Reads them; a `KeyError`, `TypeError` or `ValueError` means that it fails.
        limit: Largest number of objects.
    """

    def validate(value: Any, one_by_one: ValidatorFunctionWrapHandler) -> Any:
        if isinstance(value, list) and len(value) <= limit and all(isinstance(row, dict) for row in value):
            try:
                return tuple(read(value))
            except (KeyError, TypeError, ValueError):
                pass
        return one_by_one(value)

    return WrapValidator(validate)


def read_tomatoes(rows: Sequence[Row]) -> list[Tomato]:
    """Read tomatoes."""
    shapes = _read(rows and [row["shape"] for row in rows], (Sphere, Ellipsoid))
    others = [(row["truss"], row.get("ripeness")) for row in rows]
    for row, (truss, ripeness) in zip(rows, others, strict=True):
        known = type(truss) is int and (ripeness is None or (type(ripeness) is float and 0 <= ripeness <= 1))
        if not known or not row.keys() <= {"shape", "truss", "ripeness"}:
            raise InvalidValueError(f"not a tomato: {row}")
    values = ((shape, *other) for shape, other in zip(shapes, others, strict=True))
    return unchecked(Tomato, ("shape", "truss", "ripeness"), values)


def read_stems(rows: Sequence[Row]) -> list[Stem]:
    """Read stems."""
    kinds = [row["kind"] for row in rows]
    if any(kind not in STEM_KINDS for kind in kinds):
        raise InvalidValueError(f"not all kinds of stems: {kinds}")
    capsules = _read([{key: row[key] for key in row if key != "kind"} for row in rows], (Capsule,))
    fields = _FIELDS[Capsule]
    values = ((*(vars(c)[field] for field in fields), kind) for c, kind in zip(capsules, kinds, strict=True))
    return unchecked(Stem, (*fields, "kind"), values)


def read_clutter(rows: Sequence[Row]) -> list[Shape]:
    """Read clutter."""
    return _read(rows, (Sphere, Capsule, Box))


def _read(rows: Sequence[Row], types: Sequence[type[Shape]]) -> list[Shape]:
    """Read shapes, each of the type among some that has its fields."""
    by_fields = {frozenset(_FIELDS[shape_type]): shape_type for shape_type in types}
    chosen: dict[type[Shape], list[int]] = {}
    for k, row in enumerate(rows):
        chosen.setdefault(by_fields[frozenset(row)], []).append(k)
    result: dict[int, Shape] = {}
    for shape_type, indices in chosen.items():
        columns = {field: [rows[k][field] for k in indices] for field in _FIELDS[shape_type]}
        result.update(zip(indices, shapes_of(shape_type, columns), strict=True))
    return [result[k] for k in range(len(rows))]
