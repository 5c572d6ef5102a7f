"""Row clouds, points and meshes on disk.

A row cloud is one ``.npz`` file without pickles, its report as JSON inside it.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import TypeAdapter

from greenhouse_gym.common.array_files import read_arrays
from greenhouse_gym.common.files import MAX_BYTES, parsing, read_bytes, write_atomically
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.errors import FileFormatError, FileWriteError
from greenhouse_gym.geometry import is_pose
from greenhouse_gym.geometry.point_clouds import Cloud, to_open3d
from greenhouse_gym.reconstruction.meshing import TriangleMesh, mesh_to_open3d
from greenhouse_gym.reconstruction.report import RowReport
from greenhouse_gym.reconstruction.row_cloud import RowCloud

_REPORT = TypeAdapter(RowReport)
_FLOATS = ("points", "colors", "normals")
_ARRAYS = (*_FLOATS, "station", "registered", "world_from_station")


def report_as_json(report: RowReport) -> str:
    """Return a report as readable JSON."""
    return json.dumps(asdict(report), indent=1) + "\n"


def save_row(row: RowCloud, path: str | Path) -> Path:
    """Write a row cloud; points, colors and normals are stored as float32 (a tenth of a micrometre at arm's length)."""
    stored = {name: getattr(row, name) for name in _ARRAYS}
    stored |= {name: stored[name].astype(np.float32) for name in _FLOATS}
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
    arrays |= {name: arrays[name].astype(np.float64) for name in _FLOATS}
    return RowCloud(**{name: arrays[name] for name in _ARRAYS}, report=report, observed=None)


def _check(arrays: dict[str, npt.NDArray[Any]], report: RowReport) -> None:
    """Raise `ValueError` for arrays that fit neither each other, nor the report, nor a row."""
    points, stations = len(arrays["points"]), len(arrays["registered"])
    expected = dict.fromkeys(_FLOATS, ("f", (points, 3))) | {
        "station": ("i", (points,)),
        "registered": ("b", (stations,)),
        "world_from_station": ("f", (stations, 4, 4)),
    }
    for name, (kind, shape) in expected.items():
        if arrays[name].dtype.kind != kind or arrays[name].shape != shape:
            got = f"{arrays[name].dtype} of shape {arrays[name].shape}"
            raise ValueError(f"{name} must have the shape {shape} and numbers of the kind {kind!r}, got {got}")
    poses = arrays["world_from_station"][arrays["registered"]]
    for name, values in {**{name: arrays[name] for name in _FLOATS}, "poses of registered stations": poses}.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{name} are not all finite numbers")
    if points and not 0 <= arrays["station"].min() <= arrays["station"].max() < stations:
        raise ValueError(f"points of stations that do not exist; there are {stations}")
    if not all(map(is_pose, poses)):
        raise ValueError("a registered station has no 4x4 pose")
    if len(report.stations) not in (0, stations):
        raise ValueError(f"its report has {len(report.stations)} stations, the arrays have {stations}")


def save_points(cloud: Cloud, path: str | Path) -> None:
    """Write a cloud as a file that viewers open: PLY, PCD or XYZ, by the suffix.

    Raises:
        FileFormatError: The suffix is not known.
        FileWriteError: The file could not be written, for example because the disk is full.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".ply":  # on a full disk Open3D truncates these silently, and ends the process over .xyz
        write_atomically(path, _ply(cloud))
    elif suffix == ".xyz":
        np.savetxt(table := io.BytesIO(), cloud.points, "%.10f")
        write_atomically(path, table.getvalue())
    else:
        o3d = open3d().io
        _write(
            path,
            lambda name: o3d.write_point_cloud(name, to_open3d(cloud)),
            lambda name: len(o3d.read_point_cloud(name).points) == len(cloud),
        )


def _ply(cloud: Cloud) -> bytes:
    """Encode a cloud as a binary PLY file."""
    table = np.empty(len(cloud), np.dtype([("points", "<f8", 3), ("normals", "<f4", 3), ("colors", "u1", 3)]))
    table["points"], table["normals"] = cloud.points, cloud.normals
    table["colors"] = np.rint(255 * np.clip(cloud.colors, 0, 1))
    kinds = {"double": ("x", "y", "z"), "float": ("nx", "ny", "nz"), "uchar": ("red", "green", "blue")}
    properties = "".join(f"property {kind} {name}\n" for kind, names in kinds.items() for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n{properties}end_header\n"
    return header.encode() + table.tobytes()


def save_mesh(mesh: TriangleMesh, path: str | Path) -> None:
    """Write a mesh as a file that viewers open: PLY, OBJ or STL, by the suffix.

    Raises:
        FileFormatError: The suffix is not known.
        FileWriteError: The file could not be written, for example because the disk is full.
    """
    o3d, stored = open3d().io, mesh_to_open3d(mesh)
    stored.compute_vertex_normals()
    _write(
        path,
        lambda name: o3d.write_triangle_mesh(name, stored),
        lambda name: len(o3d.read_triangle_mesh(name).triangles) == len(mesh.triangles),
    )


def _write(path: str | Path, write: Callable[[str], bool], complete: Callable[[str], bool]) -> None:
    """Write to a temporary name of the same suffix, then rename.

    Open3D reports success on a full disk too, so the file is read again and must be ``complete``.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not write(str(temporary)):
            raise FileFormatError(path, "could not be written")
        if not complete(str(temporary)):
            raise OSError("only a part of it; is the disk full?")
        temporary.replace(path)
    except OSError as error:
        raise FileWriteError(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)
