"""Shapes in a scene file at a tenth of the size: tables of tenths of a millimetre, compressed."""

from __future__ import annotations

import base64
import binascii
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crop import Stem, Tomato
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Shape
from greenhouse_gym.packing import COLUMNS, MOST_SHAPES, ShapeParts, ShapeTables, as_tables, from_tables

_UNITS = {"x": 1e-4, "a": 1e-4, "r": 1e-4, "t": 1.0, "i": 1e-3, "k": 1.0, "q": 1e-5}


def pack(tomatoes: tuple[Tomato, ...], stems: tuple[Stem, ...], clutter: tuple[Shape, ...]) -> dict[str, Any]:
    """Shapes as a JSON object: the numbers of rows of each table, and the data.

    Lengths are rounded to 0.1 mm, so what was unpacked packs the same again.
    """
    tables = as_tables(tomatoes, stems, clutter)
    numbers = [
        np.rint(table / [_UNITS[column] for column in columns]).T.astype("<i4").reshape(-1)
        for table, columns in zip(tables, COLUMNS, strict=True)
    ]
    rows = {name: len(table) for name, table in zip(ShapeTables._fields, tables, strict=True)}
    return {"rows": rows, "data": compressed(by_byte(np.concatenate(numbers)))}


def unpack(packed: Any) -> ShapeParts:
    """The shapes of `pack`.

    Raises:
        InvalidValueError: The object is damaged.
    """
    try:
        rows = [int(packed["rows"][name]) for name in ShapeTables._fields]
        data = packed["data"]
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidValueError(f"packed shapes need rows and data: {error}") from error
    if min(rows) < 0 or sum(rows) > MOST_SHAPES:
        raise InvalidValueError(f"packed shapes: {rows} rows, from 0 up to {MOST_SHAPES} in all expected")
    sizes = [count * len(columns) for count, columns in zip(rows, COLUMNS, strict=True)]
    planes = np.frombuffer(decompressed(data, 4 * sum(sizes)), dtype=np.uint8).reshape(4, -1)
    numbers = np.split(np.ascontiguousarray(planes.T).view("<i4").reshape(-1), np.cumsum(sizes)[:-1])
    return from_tables(
        ShapeTables(
            *(
                part.reshape(len(columns), -1).T * [_UNITS[column] for column in columns]
                for part, columns in zip(numbers, COLUMNS, strict=True)
            )
        )
    )


def by_byte(numbers: npt.NDArray[np.int32]) -> bytes:
    """Little-endian integers (n,), all first bytes first, which compresses better."""
    return numbers.view(np.uint8).reshape(-1, 4).T.tobytes()


def compressed(data: bytes) -> str:
    """Bytes as text: zlib, then base64."""
    return base64.b64encode(zlib.compress(data, 9)).decode("ascii")


def decompressed(text: Any, size: int) -> bytes:
    """The bytes of `compressed`, no more than ``size`` of which are ever unpacked.

    Raises:
        InvalidValueError: The text is damaged, or holds another number of bytes.
    """
    try:
        unpacker = zlib.decompressobj()
        data = unpacker.decompress(base64.b64decode(text, validate=True), size + 1)
    except (binascii.Error, ValueError, TypeError, zlib.error) as error:
        raise InvalidValueError(f"damaged data: {error}") from error
    if len(data) != size or not unpacker.eof:
        raise InvalidValueError(f"damaged data: expected {size} bytes, got {len(data)} or an unfinished stream")
    return data
