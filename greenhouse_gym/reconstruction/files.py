"""Row clouds on disk: one ``.npz`` file without pickles, the report as JSON inside it."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from dataclasses import asdict
from pathlib import Path

import numpy as np

from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.paths import write_atomically
from greenhouse_gym.reconstruction.calibration import CalibrationReport
from greenhouse_gym.reconstruction.report import RowReport, station_report
from greenhouse_gym.reconstruction.row import RowCloud

_DAMAGED = (KeyError, TypeError, ValueError, EOFError, AttributeError, RuntimeError, zipfile.BadZipFile, zlib.error)
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
        FileFormatError: The file is missing, damaged, or lacks an array.
    """
    try:
        with Path(path).open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = {name: file[name] for name in _ARRAYS}
            report = json.loads(str(file["report"]))
        stations = tuple(station_report(station) for station in report.pop("stations"))
        calibration = CalibrationReport(**report.pop("calibration"))
        segments = tuple(tuple(segment) for segment in report.pop("segments"))
        warnings = tuple(report.pop("warnings"))
        row_report = RowReport(stations, segments, warnings=warnings, calibration=calibration, **report)
    except OSError as error:
        raise FileFormatError(path, f"cannot be read ({error.strerror or error})") from error
    except _DAMAGED as error:
        raise FileFormatError(path, f"not a row cloud: {error}") from error
    for name in ("points", "colors", "normals"):
        arrays[name] = arrays[name].astype(np.float64)
    return RowCloud(**arrays, report=row_report)
