"""Read point cloud files: points in the unit and frame of the file, with its colors and normals, if any."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from greenhouse_gym.build.scans.cloud_formats.columns import Parts, every, fractions
from greenhouse_gym.build.scans.cloud_formats.las import read_las
from greenhouse_gym.build.scans.cloud_formats.native import read_e57
from greenhouse_gym.build.scans.cloud_formats.pcd import read_pcd
from greenhouse_gym.build.scans.cloud_formats.ply import read_ply
from greenhouse_gym.build.scans.cloud_formats.tables import read_npy, read_npz, read_text
from greenhouse_gym.common.files import MAX_BYTES, parsing
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array

GRAY = 0.5
"""Channels of points without a color."""

MIN_POINTS = 50
"""Minimum number of points; a smaller cloud cannot hold a shape."""

_KIND = "cloud of points"
_WHOLE = (".npy", ".npz")  # read at once
_MAX_WHOLE = 4 * 2**30  # bytes of such a file


@dataclass(frozen=True, eq=False)
class RawCloud:
    """Content of a point cloud file.

    Attributes:
        points: (n, 3) in the file's unit and frame, finite.
        colors: (n, 3) RGB in [0, 1], or None if the file has none.
        normals: (n, 3) of any length, or None if the file has none.
        notes: Sentences on what was left out.
        unit: Metres per unit if the file states it.
    """

    points: Array
    colors: Array | None = None
    normals: Array | None = None
    notes: tuple[str, ...] = ()
    unit: float | None = None


def read_cloud(path: str | Path) -> RawCloud:
    """Read a cloud from a file of one of `CLOUD_SUFFIXES`.

    Organized clouds are read as well. Points without a finite position are left out, with a note.

    Raises:
        FileFormatError: The file is missing, damaged, of an unknown kind, or holds too few points.
        MissingDependencyError: A package that reads this kind of file is not installed.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    read = CLOUD_SUFFIXES.get(suffix)
    if read is None:
        raise FileFormatError(path, f"not a file of a cloud by its suffix; known are {', '.join(CLOUD_SUFFIXES)}")
    if not path.is_file():
        raise FileFormatError(path, "cannot be read (no such file)")
    limit = _MAX_WHOLE if suffix in _WHOLE else MAX_BYTES[_KIND]
    if path.stat().st_size > limit:
        advice = "; LAS, LAZ and text are read piece by piece, or leave out points" if suffix in _WHOLE else ""
        raise FileFormatError(
            path, f"too large for a {_KIND}: {path.stat().st_size} bytes, at most {limit} bytes{advice}"
        )
    with parsing(path, _KIND):
        return _cleaned(path, read(path))


def _cleaned(path: Path, parts: Parts) -> RawCloud:
    """Return the parts as floating-point numbers, without points that have no finite position."""
    for name, array in (("points", parts.points), ("colors", parts.colors), ("normals", parts.normals)):
        if array is not None and (array.dtype.kind not in "iuf" or array.shape != (len(parts.points), 3)):
            raise FileFormatError(path, f"{name} are {array.dtype} of shape {array.shape}; expected numbers (n, 3)")
    total = max(parts.total, len(parts.points))
    step = every(total) if total == len(parts.points) else 1
    points, colors, normals = (
        None if each is None else each[::step] for each in (parts.points, parts.colors, parts.normals)
    )
    assert points is not None
    notes = [f"of {total} points one in {every(total)} is used"] if every(total) > 1 else []
    kept = np.isfinite(points).all(axis=1)
    if not kept.all():
        notes.append(f"{np.count_nonzero(~kept)} of {len(kept)} points have no finite position and were left out")
    if np.count_nonzero(kept) < MIN_POINTS:
        count = np.count_nonzero(kept)
        raise FileFormatError(path, f"holds {count} points, too few for a plant; expected at least {MIN_POINTS}")
    shades = None if colors is None else fractions(path, colors[kept])
    if shades is not None and (missing := np.isnan(shades).any(axis=1)).any():
        notes.append(f"{np.count_nonzero(missing)} of {len(shades)} points have no color and are taken as gray")
        shades[missing] = GRAY
    directions = None if normals is None else np.nan_to_num(normals[kept].astype(np.float64))
    return RawCloud(points[kept].astype(np.float64), shades, directions, (*notes, *parts.notes), parts.unit)


CLOUD_SUFFIXES: Mapping[str, Callable[[Path], Parts]] = MappingProxyType(
    {
        ".ply": read_ply,
        ".pcd": read_pcd,
        ".npy": read_npy,
        ".npz": read_npz,
        ".xyz": read_text,
        ".txt": read_text,
        ".las": read_las,
        ".laz": read_las,
        ".e57": read_e57,
    }
)
"""Readers of point cloud files by suffix."""
