"""Read point cloud files: points in the unit and frame of the file, with colors and normals if it has them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.array_files import read_array, read_arrays
from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import MAX_BYTES, parsing, read_bytes
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array

MAX_POINTS = 20_000_000
"""Maximum number of points that are used; of a larger file, every second, third, ... point is."""

_MIN_POINTS = 50  # a smaller cloud cannot hold a shape
_KIND = "cloud of points"
_BY_PIECES = (".xyz", ".txt", ".las", ".laz")
_MAX_WHOLE = 4 * 2**30  # bytes of a file of another kind, which is read at once
_PIECE = 10**6  # points
_MAX_HEAD = 1000  # lines before the points
_BYTES = {
    name: size
    for size, names in ((1, b"char uchar int8 uint8"), (2, b"short ushort int16 uint16"),
                        (4, b"int uint float int32 uint32 float32"), (8, b"double float64"))
    for name in names.split()
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class RawCloud:
    """Content of a point cloud file.

    Attributes:
        points: (n, 3) in the file's unit and frame, finite.
        colors: (n, 3) RGB in [0, 1], or None if the file has none.
        normals: (n, 3) of any length, or None if the file has none.
        notes: Sentences on what was left out.
    """

    points: Array
    colors: Array | None = None
    normals: Array | None = None
    notes: tuple[str, ...] = ()


def read_cloud(path: str | Path) -> RawCloud:
    """Read a cloud from a file of one of `CLOUD_SUFFIXES`.

    Organized clouds are read as well. Points without a finite position are left out, with a note.

    Raises:
        FileFormatError: The file is missing, damaged, of an unknown kind, or holds too few points.
        MissingDependencyError: A package that reads this kind of file is not installed.
    """
    path = Path(path)
    read = CLOUD_SUFFIXES.get(path.suffix.lower())
    if read is None:
        raise FileFormatError(path, f"not a file of a cloud by its suffix; known are {', '.join(CLOUD_SUFFIXES)}")
    if not path.is_file():
        raise FileFormatError(path, "cannot be read (no such file)")
    by_pieces = path.suffix.lower() in _BY_PIECES
    limit = MAX_BYTES[_KIND] if by_pieces else _MAX_WHOLE
    if path.stat().st_size > limit:
        advice = "" if by_pieces else "; LAS, LAZ and text are read piece by piece, or leave out points"
        raise FileFormatError(
            path, f"too large for a {_KIND}: {path.stat().st_size} bytes, at most {limit} bytes{advice}"
        )
    with parsing(path, _KIND):
        return _cleaned(path, read(path))


class _Parts(NamedTuple):
    """Arrays that a reader found; ``of`` is the number of points in the file if the reader already left some out."""

    points: npt.NDArray[Any]
    colors: npt.NDArray[Any] | None
    normals: npt.NDArray[Any] | None
    of: int = 0


def _every(total: int) -> int:
    """Return k if every k-th point is used."""
    return total // (MAX_POINTS + 1) + 1


def _cleaned(path: Path, parts: _Parts) -> RawCloud:
    notes = []
    rows = [None if part is None else part.reshape(-1, 3) for part in parts[:3]]
    total = max(parts.of, len(rows[0] if rows[0] is not None else ()))
    every = _every(total)
    if every > 1:
        notes.append(f"of {total} points one in {every} is used")
    if not parts.of:
        rows = [None if part is None else part[::every] for part in rows]
    for name, part in zip(("colors", "normals"), rows[1:], strict=True):
        if part is not None and rows[0] is not None and len(part) != len(rows[0]):
            raise FileFormatError(path, f"{len(part)} {name} for {len(rows[0])} points")
    assert rows[0] is not None
    kept = np.isfinite(rows[0]).all(axis=1)
    if not kept.all():
        notes.append(f"{np.count_nonzero(~kept)} of {len(kept)} points have no finite position and were left out")
    if np.count_nonzero(kept) < _MIN_POINTS:
        count = np.count_nonzero(kept)
        raise FileFormatError(path, f"holds {count} points, too few for a plant; expected at least {_MIN_POINTS}")
    found = rows[0][kept].astype(np.float64)
    return RawCloud(
        found,
        None if rows[1] is None else _fractions(path, rows[1][kept]),
        None if rows[2] is None else np.nan_to_num(rows[2][kept].astype(np.float64)),
        tuple(notes),
    )


def _fractions(path: Path, colors: npt.NDArray[Any]) -> Array:
    """Convert colors of any type to fractions of white."""
    whole = np.issubdtype(colors.dtype, np.integer)
    white = float(np.iinfo(colors.dtype).max) if whole else 255.0 if colors.max(initial=0.0) > 1.0 else 1.0
    result = np.nan_to_num(colors.astype(np.float64)) / white
    if result.min(initial=0.0) < 0.0 or result.max(initial=0.0) > 1.0:
        raise FileFormatError(path, f"colors from {colors.min()} to {colors.max()}; expected 0 to 1, or 0 to 255")
    return np.asarray(result)


def _with_open3d(path: Path) -> _Parts:
    _require_all_points(path)
    cloud = open3d().t.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
    if "positions" not in cloud.point:
        raise FileFormatError(path, "damaged, or holds no points")
    colors, normals = (cloud.point[name].numpy() if name in cloud.point else None for name in ("colors", "normals"))
    return _Parts(cloud.point["positions"].numpy(), colors, normals)


def _require_all_points(path: Path) -> None:
    """Refuse a file that holds fewer points than its header states; Open3D would invent the missing ones.

    Open3D itself detects this in PCD files that are not text.
    """
    with path.open("rb") as file:
        head: list[bytes] = []
        for line in islice(file, _MAX_HEAD):
            head.append(line.strip())
            if head[-1] == b"end_header" or head[-1].startswith(b"DATA"):
                break
        words = [line.split() for line in head]
        start = file.tell()
        if [b"DATA", b"ascii"] in words or [b"format", b"ascii", b"1.0"] in words:
            found = sum(1 for line in file if line.strip())
        elif words[0] == [b"ply"]:
            found = (path.stat().st_size - start) // max(1, _bytes_of_vertex(words))
        else:
            return
    counts = [int(line[-1]) for line in words if line[:1] == [b"POINTS"] or line[:2] == [b"element", b"vertex"]]
    if counts and found < counts[0]:
        raise FileFormatError(path, f"cut short: {found} of {counts[0]} points are there")


def _bytes_of_vertex(head: list[list[bytes]]) -> int:
    """Return the bytes of a point, the first element of a binary PLY file, or a lower bound if a type is unknown."""
    total = elements = 0
    for words in head:
        elements += words[:1] == [b"element"]
        if elements == 1 and words[:1] == [b"property"]:
            total += _BYTES.get(words[1], 1)
    return total


def _from_array(path: Path) -> _Parts:
    """Read an array whose last axis holds x y z, optionally r g b, and optionally the normal."""
    return _columns(path, read_array(read_bytes(path, _KIND)))


def _from_arrays(path: Path) -> _Parts:
    arrays = read_arrays(read_bytes(path, _KIND), MAX_BYTES[_KIND])
    if "points" not in arrays:
        raise FileFormatError(path, f"expected the arrays points, colors and normals; it has {', '.join(arrays)}")
    return _Parts(arrays["points"], arrays.get("colors"), arrays.get("normals"))


def _from_text(path: Path) -> _Parts:
    total = sum(1 for _ in _rows(path))
    kept = islice(_rows(path), None, None, _every(total))
    return _columns(path, np.loadtxt((row.replace(",", " ") for row in kept), ndmin=2), total)


def _rows(path: Path) -> Iterator[str]:
    with path.open(encoding="utf-8") as file:
        yield from (line for line in file if line[:1] not in "#/\n")


def _columns(path: Path, table: npt.NDArray[Any], of: int = 0) -> _Parts:
    if table.ndim < 2 or table.shape[-1] not in (3, 6, 9):
        raise FileFormatError(
            path, f"an array of shape {table.shape}; expected 3, 6 or 9 columns: x y z, r g b, normal"
        )
    flat = table.reshape(-1, table.shape[-1])
    colors, normals = flat[:, 3:6] if flat.shape[1] > 3 else None, flat[:, 6:] if flat.shape[1] > 6 else None
    return _Parts(flat[:, :3], colors, normals, of)


def _from_laser(path: Path) -> _Parts:
    with needs("scans"):
        import laspy
    points, channels = [], []
    with laspy.open(path) as file:
        total, done = file.header.point_count, 0
        every = _every(total)
        colored = "red" in file.header.point_format.dimension_names
        for piece in file.chunk_iterator(_PIECE):
            kept = piece[np.arange(-done % every, len(piece), every)]
            done += len(piece)
            points.append(np.column_stack([kept.x, kept.y, kept.z]))
            if colored:
                channels.append(np.column_stack([kept.red, kept.green, kept.blue]))
    if done < total:
        raise FileFormatError(path, f"cut short: {done} of {total} points are there")
    colors = np.concatenate(channels) if channels else np.zeros((0, 3), np.uint16)
    if colors.max(initial=0) <= 255:  # 16 bits by the standard, 8 in many files
        colors = colors.astype(np.uint8)
    return _Parts(np.concatenate(points or [np.zeros((0, 3))]), colors if colors.any() else None, None, total)


def _from_e57(path: Path) -> _Parts:
    """Read all scans of the file in its common frame."""
    with needs("scans"):
        import pye57
    with closing(pye57.E57(str(path))) as file:
        headers = [file.get_header(i) for i in range(file.scan_count)]
        colored = all("colorRed" in header.point_fields for header in headers)
        scans = [file.read_scan(i, colors=colored, ignore_missing_fields=True) for i in range(len(headers))]
    points, colors = (
        np.concatenate([np.column_stack([scan[name] for name in names]) for scan in scans])
        if scans and names[0] in scans[0]
        else None
        for names in (("cartesianX", "cartesianY", "cartesianZ"), ("colorRed", "colorGreen", "colorBlue"))
    )
    return _Parts(np.zeros((0, 3)) if points is None else points, colors, None)


CLOUD_SUFFIXES: Mapping[str, Callable[[Path], _Parts]] = MappingProxyType(
    {
        ".ply": _with_open3d,
        ".pcd": _with_open3d,
        ".npy": _from_array,
        ".npz": _from_arrays,
        ".xyz": _from_text,
        ".txt": _from_text,
        ".las": _from_laser,
        ".laz": _from_laser,
        ".e57": _from_e57,
    }
)
"""Readers of point cloud files by suffix."""
