"""Shapes in a scene file at a tenth of the size: tables of tenths of a millimetre, compressed."""

from __future__ import annotations

import base64
import binascii
import lzma
import zlib
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.crops.shape_tables import COLUMNS, MOST_SHAPES, ShapeParts, ShapeTables, as_tables, from_tables
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Shape
from greenhouse_gym.scene.differences import QUATERNION_UNIT, Numbers, differences, restored, width

_UNITS = {"x": 1e-4, "a": 1e-4, "r": 1e-4, "t": 1.0, "i": 1e-3, "k": 1.0, "q": QUATERNION_UNIT}

_XZ: list[dict[str, int]] = [{"id": lzma.FILTER_LZMA2, "preset": 6, "dict_size": 2**20, "lc": 0, "pb": 0}]
"""Settings for numbers whose bytes tell nothing of those beside them; a small dictionary keeps reading cheap."""

_MOST_MEMORY = 2**24
"""Bytes that a file may claim for reading it."""


def pack(tomatoes: tuple[Tomato, ...], stems: tuple[Stem, ...], clutter: tuple[Shape, ...]) -> dict[str, Any]:
    """Shapes as a JSON object: the numbers of rows of each table, and the data.

    Lengths are rounded to 0.1 mm, so what was unpacked packs the same again.
    """
    tables = as_tables(tomatoes, stems, clutter)
    numbers = [
        differences(np.rint(table / [_UNITS[column] for column in columns]).astype(np.int64), columns)
        for table, columns in zip(tables, COLUMNS, strict=True)
    ]
    rows = {name: len(table) for name, table in zip(ShapeTables._fields, tables, strict=True)}
    planes = by_byte(_folded(np.concatenate([part.T.reshape(-1) for part in numbers])))
    data = lzma.compress(planes, format=lzma.FORMAT_XZ, check=lzma.CHECK_CRC32, filters=_XZ)
    return {"rows": rows, "xz": base64.b64encode(data).decode("ascii")}


def unpack(packed: Any) -> ShapeParts:
    """The shapes of `pack`, also of its first form, which had the numbers themselves, by zlib, as ``data``.

    Raises:
        InvalidValueError: The object is damaged.
    """
    try:
        rows = [int(packed["rows"][name]) for name in ShapeTables._fields]
        first_form = "xz" not in packed
        text = packed["data" if first_form else "xz"]
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidValueError(f"packed shapes need rows and xz: {error}") from error
    if min(rows) < 0 or sum(rows) > MOST_SHAPES:
        raise InvalidValueError(f"packed shapes: {rows} rows, from 0 up to {MOST_SHAPES} in all expected")
    widths = [len(columns) if first_form else width(columns) for columns in COLUMNS]
    sizes = [count * columns for count, columns in zip(rows, widths, strict=True)]
    data = decompressed(text, 4 * sum(sizes), zlib.decompressobj() if first_form else _unxz())
    words = np.ascontiguousarray(np.frombuffer(data, dtype=np.uint8).reshape(4, -1).T).reshape(-1)
    numbers = words.view("<i4").astype(np.int64) if first_form else _unfolded(words.view("<u4"))
    parts = [
        part.reshape(columns, -1).T
        for part, columns in zip(np.split(numbers, np.cumsum(sizes)[:-1]), widths, strict=True)
    ]
    if not first_form:
        parts = [restored(part, columns) for part, columns in zip(parts, COLUMNS, strict=True)]
    units = ([_UNITS[column] for column in columns] for columns in COLUMNS)
    return from_tables(ShapeTables(*(part * np.array(unit) for part, unit in zip(parts, units, strict=True))))


class Unpacker(Protocol):
    """What the standard library's modules of compression unpack by."""

    @property
    def eof(self) -> bool:
        """Whether the end was read."""

    def decompress(self, data: bytes, max_length: int, /) -> bytes:
        """No more than so many bytes."""


def by_byte(numbers: npt.NDArray[np.uint32]) -> bytes:
    """Little-endian integers (n,), all first bytes first, which compresses better."""
    return numbers.astype("<u4").view(np.uint8).reshape(-1, 4).T.tobytes()


def _unxz() -> lzma.LZMADecompressor:
    return lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=_MOST_MEMORY)


def _folded(numbers: Numbers) -> npt.NDArray[np.uint32]:
    """Integers (n,) as those from 0 on: small ones of either sign stay small."""
    return ((numbers << 1) ^ (numbers >> 63)).astype(np.uint32)


def _unfolded(numbers: npt.NDArray[np.uint32]) -> Numbers:
    """The integers (n,) of `_folded`."""
    wide = numbers.astype(np.int64)
    return (wide >> 1) ^ -(wide & 1)


def compressed(data: bytes) -> str:
    """Bytes as text: zlib, then base64."""
    return base64.b64encode(zlib.compress(data, 9)).decode("ascii")


def decompressed(text: Any, size: int, unpacker: Unpacker | None = None) -> bytes:
    """The bytes of `compressed`, or of what another unpacker reads; no more than ``size`` are ever unpacked.

    Raises:
        InvalidValueError: The text is damaged, or holds another number of bytes.
    """
    try:
        unpacker = unpacker or zlib.decompressobj()
        data = unpacker.decompress(base64.b64decode(text, validate=True), size + 1)
    except (binascii.Error, ValueError, TypeError, zlib.error, lzma.LZMAError, EOFError) as error:
        raise InvalidValueError(f"damaged data: {error}") from error
    if len(data) != size or not unpacker.eof:
        raise InvalidValueError(f"damaged data: expected {size} bytes, got {len(data)} or an unfinished stream")
    return data
