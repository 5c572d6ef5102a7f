"""Shapes in scene files: lists, read as arrays in a twentieth of the time of objects, or tables as compressed text.

Tables hold whole numbers: lengths in tenths of a millimetre, ripeness in thousandths, quaternions in 1e-5. Neighbors in
a table are neighbors in space, so each point is stored relative to the previous one. Of a unit quaternion the largest
entry follows from the three others, up to its sign and a rounding error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidatorFunctionWrapHandler, WrapValidator

from greenhouse_gym.common.array_files import compress, decompress
from greenhouse_gym.crops.parts import STEM_KINDS, Stem, Tomato
from greenhouse_gym.crops.shape_columns import ShapeColumns
from greenhouse_gym.crops.shape_tables import COLUMNS, MAX_ROWS, ShapeTables, as_tables
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

Integers = npt.NDArray[np.int64]

_UNITS = {"x": 1e-4, "a": 1e-4, "r": 1e-4, "t": 1.0, "i": 1e-3, "k": 1.0, "q": 1e-5}


def in_bulk(read: Callable[[Sequence[Row]], ShapeColumns], limit: int) -> WrapValidator:
    """Return a validator that reads lists of objects as columns, and one by one if that fails: this names the fault.

    Args:
        read: Reads them; a `KeyError`, `TypeError` or `ValueError` means that it fails.
        limit: Largest number of objects.
    """

    def validate(value: Any, one_by_one: ValidatorFunctionWrapHandler) -> Any:
        if isinstance(value, list) and len(value) <= limit and set(map(type, value)) <= {dict}:
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
    arrays, _ = _read(rows, (Capsule,), ("kind",))
    kinds = np.array([STEM_KINDS.index(row["kind"]) for row in rows], dtype=np.int8)
    return ShapeColumns.of()._replace(arrays=arrays, kinds=kinds)


def read_clutter(rows: Sequence[Row]) -> ShapeColumns:
    """Read clutter."""
    arrays, _ = _read(rows, (Sphere, Capsule, Box))
    return ShapeColumns.of()._replace(arrays=arrays, space=np.zeros(len(rows), dtype=np.bool_))


def _read(rows: Sequence[Row], types: Sequence[type[Shape]], others: Sequence[str] = ()) -> tuple[ShapeArrays, Array]:
    """Read shapes, each of the type among some that has its fields, and the radii (n,) of those that have one.

    Rows have some other fields as well.
    """
    by_fields = {frozenset((*_FIELDS[shape_type], *others)): shape_type for shape_type in types}
    orders = list(map(tuple, rows))
    types_of = {order: by_fields[frozenset(order)] for order in set(orders)}
    chosen: dict[type[Shape], list[int]] = {}
    for k, order in enumerate(orders):
        chosen.setdefault(types_of[order], []).append(k)
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


def pack(tomatoes: tuple[Tomato, ...], stems: tuple[Stem, ...], clutter: tuple[Shape, ...]) -> dict[str, Any]:
    """Return shapes as a JSON object: the number of rows of each table, and all tables as compressed text.

    Lengths are rounded to 0.1 mm, so unpacking and packing again gives the same text.
    """
    tables = as_tables(tomatoes, stems, clutter)
    columns = [
        _encode(_rounded(table, kinds), kinds).T.reshape(-1) for table, kinds in zip(tables, COLUMNS, strict=True)
    ]
    numbers = np.concatenate(columns)
    unsigned = ((numbers << 1) ^ (numbers >> 63)).astype("<u4")  # small numbers of either sign stay small
    planes = unsigned.view(np.uint8).reshape(-1, 4).T  # all lowest bytes first, which compresses better
    rows = {name: len(table) for name, table in zip(ShapeTables._fields, tables, strict=True)}
    return {"rows": rows, "xz": compress(planes.tobytes())}


def unpack(packed: Any) -> ShapeTables:
    """Return the shapes that `pack` stored, for `from_tables`.

    Raises:
        InvalidValueError: The object is damaged.
    """
    try:
        rows = [int(packed["rows"][name]) for name in ShapeTables._fields]
        text = packed["xz"]
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidValueError(f"packed shapes need rows and xz: {error}") from error
    if min(rows) < 0 or sum(rows) > MAX_ROWS:
        raise InvalidValueError(f"packed shapes: {rows} rows, from 0 up to {MAX_ROWS} in all expected")
    widths = [len(kinds) + ("q" in kinds) for kinds in COLUMNS]
    sizes = [count * width for count, width in zip(rows, widths, strict=True)]
    planes = np.frombuffer(decompress(text, 4 * sum(sizes)), dtype=np.uint8).reshape(4, -1)
    unsigned = np.ascontiguousarray(planes.T).reshape(-1).view("<u4").astype(np.int64)
    numbers = np.split((unsigned >> 1) ^ -(unsigned & 1), np.cumsum(sizes)[:-1])
    tables = [
        _decode(part.reshape(width, -1).T, kinds) * np.array([_UNITS[kind] for kind in kinds])
        for part, width, kinds in zip(numbers, widths, COLUMNS, strict=True)
    ]
    return ShapeTables(*tables)


def _rounded(table: Array, kinds: str) -> Integers:
    return np.rint(table / [_UNITS[kind] for kind in kinds]).astype(np.int64)


def _encode(table: Integers, kinds: str) -> Integers:
    """Return a table (n, columns) of whole numbers as smaller numbers, with one more column per quaternion."""
    points = kinds.count("x")
    ends = table[:, points - 3 : points]
    previous = np.vstack([np.zeros((1, 3), dtype=np.int64), ends[:-1]])[: len(table)]
    parts = [table[:, :3] - previous, ends - table[:, :3]][: points // 3]
    rest = table[:, points:]
    if "q" in kinds:
        quaternions = rest[:, -4:]
        largest = np.abs(quaternions).argmax(axis=1)
        left_out = np.arange(4) == largest[:, None]
        others, size = quaternions[~left_out].reshape(-1, 3), quaternions[left_out]
        error = np.abs(size) - _fourth_entry(others)
        rest = np.column_stack([rest[:, :-4], others, 2 * largest + (size < 0), error])
    return np.column_stack([*parts, rest])


def _decode(numbers: Integers, kinds: str) -> Integers:
    """Return the table of `_encode`.

    Raises:
        InvalidValueError: No table is encoded like this.
    """
    points = kinds.count("x")
    steps, lengths, rest = numbers[:, :3], numbers[:, 3:points], numbers[:, points:]
    ends = np.cumsum(steps + lengths if points > 3 else steps, axis=0)
    if "q" in kinds:
        others, code, error = rest[:, -5:-2], rest[:, -2], rest[:, -1]
        if ((code < 0) | (code > 7)).any():
            raise InvalidValueError("damaged data: a quaternion has four entries")
        left_out = np.arange(4) == (code // 2)[:, None]
        quaternions = np.empty(left_out.shape, dtype=np.int64)
        quaternions[~left_out] = others.reshape(-1)
        quaternions[left_out] = (_fourth_entry(others) + error) * np.where(code % 2, -1, 1)
        rest = np.column_stack([rest[:, :-5], quaternions])
    return np.column_stack([ends - lengths, ends, rest] if points > 3 else [ends, rest])


def _fourth_entry(others: Integers) -> Integers:
    """Return the size (n,) of the fourth entry of unit quaternions from the others (n, 3), alike on every processor."""
    square = _UNITS["q"] ** -2 - (others.astype(float) ** 2).sum(axis=1)
    return np.rint(np.sqrt(np.maximum(square, 0.0))).astype(np.int64)
