"""Arrays as readers of point clouds deliver them, and records of fixed size from a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import FileFormatError

MAX_POINTS = 20_000_000
"""Maximum number of points that are used; of a larger file, every second, third, ... point is."""

_PIECE = 2**26  # bytes that are read at a time where points are left out


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
