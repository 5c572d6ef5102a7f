"""Find positions, colors and normals among the columns of a cloud, and convert colors of any type to fractions."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array

MAX_POINTS = 20_000_000
"""Maximum number of points that are used; of a larger file, every second, third, ... point is."""

_PIECE = 2**26  # bytes that are read at a time where points are left out

_POSITIONS = [
    {axis, f"{axis}coordinate", f"{axis}coord", f"points{k}", f"positions{k}"}
    | {prefix + axis for prefix in ("p", "pos", "position", "coord", "point", "vertex", "cartesian")}
    for k, axis in enumerate("xyz")
]
_NORMALS = [
    {f"{axis}normal", f"normal{k}", f"normals{k}"} | {prefix + axis for prefix in ("n", "norm", "normal", "normals")}
    for k, axis in enumerate("xyz")
]
_COLORS = [
    {name[0] + "f"}
    | {prefix + each for prefix in ("", "color", "colour", "diffuse", "vertex") for each in (name, name[0])}
    | {f"{prefix}{k}" for prefix in ("rgb", "rgba", "color", "colors", "colour")}
    for k, name in enumerate(("red", "green", "blue"))
]
POSITIONAL = (3, 6, 9)
"""Numbers of columns that need no names."""

_PACKED = ("rgb", "rgba")  # three channels in the bytes of one number
_WHITE = (255.0, 65535.0)  # of channels that are no fractions
_MAX_FRACTION = 1.05  # of channels that are fractions; rounding and interpolation may exceed 1
_UNIT = 0.02  # deviation from length 1 of normals that were rounded
_SHOWN, _WIDTH = 12, 40  # names of columns in a message, and their characters


@dataclass(frozen=True, eq=False)
class Parts:
    """Arrays of a point cloud.

    Attributes:
        points: (n, 3) positions of any numeric type.
        colors: (n, 3) colors of any numeric type, NaN where a point has none; or None.
        normals: (n, 3) of any length, or None.
        total: Number of points in the file; more than n if some were left out.
        notes: Sentences on what was left out.
        unit: Metres per unit if the file states it.
    """

    points: npt.NDArray[Any]
    colors: npt.NDArray[Any] | None = None
    normals: npt.NDArray[Any] | None = None
    total: int = 0
    notes: tuple[str, ...] = ()
    unit: float | None = None


def every(total: int) -> int:
    """Return k if every k-th of ``total`` points is used."""
    return total // (MAX_POINTS + 1) + 1


def require_all(path: Path, there: int, total: int) -> None:
    """Raise `FileFormatError` if fewer points are there than the file states."""
    if there < total:
        raise FileFormatError(path, f"cut short: at most {there} of {total} points are there")


def read_records(path: Path, file: IO[bytes], dtype: np.dtype[Any], total: int) -> npt.NDArray[Any]:
    """Return every k-th of the fixed-size records that follow in an open file.

    Raises:
        FileFormatError: The file ends before, or the records are empty.
    """
    if not dtype.itemsize:
        raise FileFormatError(path, "its points have no columns")
    there = (path.stat().st_size - file.tell()) // dtype.itemsize
    require_all(path, there, total)
    step, size = every(total), max(1, _PIECE // dtype.itemsize)
    if step == 1:
        return np.fromfile(file, dtype, total)
    starts = range(0, total, size)
    pieces = [np.fromfile(file, dtype, min(size, total - start))[-start % step :: step].copy() for start in starts]
    return np.concatenate(pieces)


def holds_positions(names: Iterable[str]) -> bool:
    """Return whether x, y and z are among the names of columns."""
    return len(_indices([_plain(name) for name in names], _POSITIONS)) == 3


def named_parts(path: Path, names: Sequence[str], column: Callable[[int], npt.NDArray[Any]], total: int) -> Parts:
    """Return the parts of a cloud by the names of its columns; common spellings are known.

    Args:
        path: The file, for messages.
        names: Names of the columns.
        column: Returns the values (n,) of the column with an index.
        total: Number of points in the file.

    Raises:
        FileFormatError: No columns are named x, y and z.
    """
    plain = [_plain(name) for name in names]
    indices = [_indices(plain, wanted) for wanted in (_POSITIONS, _COLORS, _NORMALS)]
    if len(indices[0]) < 3:
        raise FileFormatError(path, f"has the columns {_listed(names)}; expected x, y and z among them")
    packed = [plain.index(name) for name in _PACKED if name in plain and len(indices[1]) < 3][:1]
    found = [np.column_stack([column(k) for k in each]) if len(each) == 3 else None for each in indices]
    assert found[0] is not None
    colors = _unpacked(column(packed[0])) if packed else found[1]
    used = {k for each in indices if len(each) == 3 for k in each} | set(packed)
    unused = [name for k, name in enumerate(names) if k not in used and name != "_"]
    notes = (f"columns that were not used: {_listed(unused)}",) if unused else ()
    return Parts(found[0], colors, found[2], total, notes)


def positional_parts(path: Path, table: npt.NDArray[Any], total: int = 0) -> Parts:
    """Return the parts of a cloud whose columns have no names: x y z, and colors or normals or both.

    Args:
        path: The file, for messages.
        table: (..., 3), (..., 6) or (..., 9) numbers. Vectors of length 1 are normals.
        total: Number of points in the file.

    Raises:
        FileFormatError: The array has another shape.
    """
    if table.ndim < 2 or table.shape[-1] not in POSITIONAL:
        raise FileFormatError(
            path, f"an array of shape {table.shape}; expected 3, 6 or 9 columns: x y z, r g b, normal"
        )
    rows = table.reshape(-1, table.shape[-1])
    triples = [rows[:, k : k + 3] for k in range(3, rows.shape[1], 3)]
    if triples and _are_normals(triples[0]) and not (len(triples) == 2 and _are_normals(triples[1])):
        triples = [*triples[1:], triples[0]] if len(triples) == 2 else [None, triples[0]]  # type: ignore[list-item]
    colors, normals = (*triples, None, None)[:2]
    return Parts(rows[:, :3], colors, normals, total)


def fractions(path: Path, colors: npt.NDArray[Any]) -> Array:
    """Return colors of any type as fractions of white, NaN where a color is not finite.

    Args:
        path: The file, for messages.
        colors: (n, 3). White is 1 for fractions, else 255 or 65535: the smaller one that no value exceeds.

    Raises:
        FileFormatError: Values are below black or above white.
    """
    if colors.dtype == np.int8:  # a byte without its sign
        colors = colors.view(np.uint8)
    values = colors.astype(np.float64)
    values[~np.isfinite(values)] = np.nan
    low, high = np.nanmin(values, initial=0.0), np.nanmax(values, initial=0.0)
    are_fractions = colors.dtype.kind == "f" and high <= _MAX_FRACTION
    white = 1.0 if are_fractions else next((each for each in _WHITE if high <= each), np.nan)
    if not (low >= -(_MAX_FRACTION - 1) * white and high <= _MAX_FRACTION * white):
        raise FileFormatError(path, f"colors from {low:g} to {high:g}; expected 0 to 1, 255 or 65535")
    return np.clip(values / white, 0.0, 1.0)


def _plain(name: str) -> str:
    return re.sub(r"[\[(].*|[^a-z0-9]", "", name.lower())


def _listed(names: Sequence[str]) -> str:
    return ", ".join(name[:_WIDTH] for name in names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "") or "(none)"


def _indices(plain: Sequence[str], wanted: Iterable[set[str]]) -> list[int]:
    """Return the index of the first column with one of the names in each set, if there is one."""
    return [k for names in wanted for k in [k for k, name in enumerate(plain) if name in names][:1]]


def _unpacked(packed: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the channels (n, 3) of colors whose bytes are those of one number: blue first."""
    missing = np.zeros(len(packed), dtype=bool)
    if packed.dtype.itemsize == 4:
        bits = np.ascontiguousarray(packed).view(np.uint32)
    elif packed.dtype.kind in "iu":
        bits = packed.astype(np.uint32)
    else:  # text, of an integer or of a single-precision number
        missing = ~np.isfinite(packed)
        known = np.where(missing, 0.0, packed)
        whole = (known == np.floor(known)).all() and known.min(initial=0) >= 0 and known.max(initial=0) < 2**32
        bits = known.astype(np.uint32) if whole else known.astype(np.float32).view(np.uint32)
    channels = np.column_stack([(bits >> shift) & 255 for shift in (16, 8, 0)]).astype(np.uint8)
    return np.where(missing[:, None], np.nan, channels) if missing.any() else channels


def _are_normals(vectors: npt.NDArray[Any]) -> bool:
    """Return whether vectors (n, 3) have length 1 or 0 and are no pure colors."""
    if vectors.dtype.kind != "f":
        return False
    length = np.linalg.norm(vectors[:: len(vectors) // 10_000 + 1].astype(np.float64), axis=1)
    oblique = np.abs(vectors).max(axis=1, initial=0) < 1 - 1e-6
    unit = np.abs(length - 1) < _UNIT
    return bool((unit | (length == 0)).mean() > 0.99 and unit.any() and ((vectors < 0).any() or oblique.any()))
