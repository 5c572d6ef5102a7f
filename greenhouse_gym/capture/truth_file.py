"""Ground truth of a simulated recording: one ``.npz`` file of shape tables without pickles."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from greenhouse_gym.common.array_files import read_arrays
from greenhouse_gym.common.files import parsing, read_bytes, write_atomically
from greenhouse_gym.crops.plant_row import PlantRow
from greenhouse_gym.crops.shape_tables import ShapeTables, as_tables, from_tables
from greenhouse_gym.crops.truth_shapes import truth_of
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array

TRUTH = "truth.npz"
MAX_BYTES = 50_000_000  # that such a file may unpack to; a row of 5 m takes about one million
_BEHIND = "behind_"


def save_truth(row: PlantRow, path: str | Path) -> Path:
    """Write the collision shapes of a row and of the one behind it."""
    truth = truth_of(row)
    arrays: dict[str, Array] = {"size": np.array([truth.length, float(truth.week)])}
    for prefix, part in (("", truth), (_BEHIND, truth.behind)):
        if part is not None:
            tables = as_tables(part.tomatoes, part.stems, part.clutter)
            arrays |= {prefix + name: table for name, table in zip(ShapeTables._fields, tables, strict=True)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return write_atomically(path, buffer.getvalue())


def load_truth(path: str | Path) -> PlantRow | None:
    """Read a row that `save_truth` wrote; None if the file does not exist.

    Raises:
        FileFormatError: The file is damaged.
    """
    if not Path(path).is_file():
        return None
    with parsing(path, "truth of a recording"):
        arrays = read_arrays(read_bytes(path, "truth"), MAX_BYTES)
        length, week = _floats(arrays["size"], 1)
        row = PlantRow(*_parts(arrays, ""), length=float(length), week=int(week))
        if _BEHIND + ShapeTables._fields[0] in arrays:
            row = replace(row, behind=PlantRow(*_parts(arrays, _BEHIND), length=row.length, week=row.week))
        if not (row.length > 0 and row.week >= 0):
            raise InvalidValueError(f"expected a positive length and a week from 0 up, got {row.length}, {row.week}")
    return row


def _parts(arrays: Mapping[str, Array], prefix: str) -> tuple[tuple, tuple, tuple]:  # type: ignore[type-arg]
    parts = from_tables(ShapeTables(*(_floats(arrays[prefix + name], 2) for name in ShapeTables._fields)))
    return parts.tomatoes, parts.stems, parts.clutter


def _floats(array: Array, dimensions: int) -> Array:
    if array.dtype != np.float64 or array.ndim != dimensions or not np.isfinite(array).all():
        raise InvalidValueError(f"expected finite float64 numbers, got {array.dtype} of shape {array.shape}")
    return array
