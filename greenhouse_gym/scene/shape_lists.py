"""Read the shapes of scene files as arrays, which takes a twentieth of the time of one object after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from pydantic import ValidatorFunctionWrapHandler, WrapValidator

from greenhouse_gym.crops.parts import STEM_KINDS
from greenhouse_gym.crops.shape_columns import ShapeColumns
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, Box, Capsule, Ellipsoid, Shape, ShapeArrays, Sphere, checked_columns
from greenhouse_gym.geometry.shape_arrays import FIELDS, TYPES

Row = dict[str, Any]

_FIELDS: dict[type[Shape], tuple[str, ...]] = {
    Sphere: ("center", "radius"),
    Ellipsoid: ("center", "semi_axes", "rotation", "radius"),
    Capsule: ("start", "end", "radius"),
    Box: ("center", "half_extents", "rotation"),
}


def in_bulk(read: Callable[[Sequence[Row]], ShapeColumns], limit: int) -> WrapValidator:
    """Return a validator that reads lists of objects as columns, and one by one if that fails: this names the fault.

    Args:
        read: Reads them; a `KeyError`, `TypeError` or `ValueError` means that it fails.
        limit: Largest number of objects.
    """

    def validate(value: Any, one_by_one: ValidatorFunctionWrapHandler) -> Any:
        if isinstance(value, list) and len(value) <= limit and all(isinstance(row, dict) for row in value):
            try:
                return read(value)
            except (KeyError, TypeError, ValueError):
                pass
        return one_by_one(value)

    return WrapValidator(validate)


def read_tomatoes(rows: Sequence[Row]) -> ShapeColumns:
    """Read tomatoes."""
    arrays, radii = _read([row["shape"] for row in rows], (Sphere, Ellipsoid))
    for row in rows:
        ripeness = row.get("ripeness")
        known = type(row["truss"]) is int and (ripeness is None or (type(ripeness) is float and 0 <= ripeness <= 1))
        if not known or not row.keys() <= {"shape", "truss", "ripeness"}:
            raise InvalidValueError(f"not a tomato: {row}")
    return ShapeColumns.of()._replace(
        arrays=arrays,
        radii=radii,
        trusses=np.array([row["truss"] for row in rows], dtype=np.int64),
        ripeness=np.array([row.get("ripeness") for row in rows], dtype=np.float64),  # None becomes nan
    )


def read_stems(rows: Sequence[Row]) -> ShapeColumns:
    """Read stems."""
    arrays, _ = _read([{key: row[key] for key in row if key != "kind"} for row in rows], (Capsule,))
    kinds = np.array([STEM_KINDS.index(row["kind"]) for row in rows], dtype=np.int8)
    return ShapeColumns.of()._replace(arrays=arrays, kinds=kinds)


def read_clutter(rows: Sequence[Row]) -> ShapeColumns:
    """Read clutter."""
    arrays, _ = _read(rows, (Sphere, Capsule, Box))
    return ShapeColumns.of()._replace(arrays=arrays, space=np.zeros(len(rows), dtype=np.bool_))


def _read(rows: Sequence[Row], types: Sequence[type[Shape]]) -> tuple[ShapeArrays, Array]:
    """Read shapes, each of the type among some that has its fields, and the radii (n,) of those that have one."""
    by_fields = {frozenset(_FIELDS[shape_type]): shape_type for shape_type in types}
    chosen: dict[type[Shape], list[int]] = {}
    for k, row in enumerate(rows):
        chosen.setdefault(by_fields[frozenset(row)], []).append(k)
    arrays, radii = ShapeArrays.empty(len(rows)), np.zeros(len(rows))
    for shape_type, indices in chosen.items():
        columns = checked_columns(
            shape_type, {field: [rows[k][field] for k in indices] for field in _FIELDS[shape_type]}
        )
        kind = TYPES.index(shape_type)
        start, end, size = (columns[field] for field in FIELDS[kind])
        arrays.kinds[indices], arrays.starts[indices], arrays.ends[indices] = kind, start, end
        if size.ndim == 1:
            arrays.sizes[indices, 0] = size
        else:
            arrays.sizes[indices], arrays.rotations[indices] = size, columns["rotation"]
        radii[indices] = columns.get("radius", 0.0)
    return arrays, radii
