"""Row clouds on disk: one ``.npz`` file without pickles, the report as JSON inside it."""

from __future__ import annotations

import io
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import TypeAdapter

from greenhouse_gym.common.array_files import read_arrays
from greenhouse_gym.common.files import MAX_BYTES, parsing, read_bytes, write_atomically
from greenhouse_gym.geometry import is_rotation
from greenhouse_gym.reconstruction.report import RowReport
from greenhouse_gym.reconstruction.row import RowCloud

_REPORT = TypeAdapter(RowReport)
_ARRAYS = ("points", "colors", "normals", "station", "registered", "world_from_station")


def report_as_json(report: RowReport) -> str:
    """A report as readable JSON."""
    return json.dumps(asdict(report), indent=1) + "\n"


def save_row(row: RowCloud, path: str | Path) -> Path:
    """Write a row cloud; points, colors and normals are stored as float32 (a tenth of a micrometre at arm's length)."""
    stored = {name: getattr(row, name) for name in _ARRAYS}
    for name in ("points", "colors", "normals"):
        stored[name] = stored[name].astype(np.float32)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, report=np.array(report_as_json(row.report)), **stored)
    return write_atomically(path, buffer.getvalue())


def load_row(path: str | Path) -> RowCloud:
    """Read a row cloud.

    Raises:
        FileFormatError: The file is missing, damaged, or lacks an array; or its arrays do not fit each other.
    """
    with parsing(path, "row cloud"):
        arrays = read_arrays(read_bytes(path, "row cloud"), MAX_BYTES["row cloud"])
        missing = [name for name in (*_ARRAYS, "report") if name not in arrays]
        if missing:
            raise ValueError(f"it lacks {', '.join(missing)}")
        report = _REPORT.validate_json(str(arrays["report"]))
        _check(arrays, report)
    for name in ("points", "colors", "normals"):
        arrays[name] = arrays[name].astype(np.float64)
    return RowCloud(**{name: arrays[name] for name in _ARRAYS}, report=report, sight=None)


def _check(arrays: dict[str, npt.NDArray[Any]], report: RowReport) -> None:
    """Raise `ValueError` for arrays that do not fit each other, the report or what a row is."""
    points, stations = len(arrays["points"]), len(arrays["registered"])
    expected = {
        "points": ("f", (points, 3)),
        "colors": ("f", (points, 3)),
        "normals": ("f", (points, 3)),
        "station": ("i", (points,)),
        "registered": ("b", (stations,)),
        "world_from_station": ("f", (stations, 4, 4)),
    }
    for name, (kind, shape) in expected.items():
        if arrays[name].dtype.kind != kind or arrays[name].shape != shape:
            got = f"{arrays[name].dtype} of shape {arrays[name].shape}"
            raise ValueError(f"{name} must have the shape {shape} and numbers of the kind {kind!r}, got {got}")
    poses = arrays["world_from_station"][arrays["registered"]]
    finite = {name: arrays[name] for name in ("points", "colors", "normals")} | {"poses of registered stations": poses}
    for name, values in finite.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{name} are not all finite numbers")
    if points and not 0 <= arrays["station"].min() <= arrays["station"].max() < stations:
        raise ValueError(f"points of stations that do not exist; there are {stations}")
    if not all(is_rotation(pose[:3, :3], tolerance=1e-4) and np.allclose(pose[3], [0, 0, 0, 1]) for pose in poses):
        raise ValueError("a registered station has no 4x4 pose")
    if len(report.stations) not in (0, stations):
        raise ValueError(f"its report tells of {len(report.stations)} stations, the arrays of {stations}")
