"""Script that reads LAZ and E57 files with native packages and writes records to its standard output.

It runs in a process of its own (`native.native_output`) and imports nothing of this package, so that it starts fast.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

E57_POINT = np.dtype([("xyz", "<f8", 3), ("rgb", "<f4", 3)])
"""Record of a point of an E57 file: its position in the file's frame and its color, NaN where it has none."""

_PIECE = 2**25  # bytes
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_INVALID = ("cartesianInvalidState", "sphericalInvalidState", "isColorInvalid")


def write_laz(
    path: str, points_at: int, description_at: int, description_size: int, length: int, total: int, step: int
) -> None:
    """Write every ``step``-th of ``total`` points as records of ``length`` bytes."""
    import lazrs

    with open(path, "rb") as file:  # noqa: PTH123
        file.seek(description_at)
        description = file.read(description_size)
        if lazrs.LazVlr(description).item_size() != length:
            raise ValueError(f"its compressed points do not have the {length} bytes that its header states")
        file.seek(points_at)
        reader = lazrs.ParLasZipDecompressor(file, description)
        size = max(1, _PIECE // length)
        for start in range(0, total, size):
            piece = np.empty((min(size, total - start), length), np.uint8)
            reader.decompress_many(piece.reshape(-1))
            sys.stdout.buffer.write(piece[-start % step :: step].tobytes())


def write_e57(path: str, max_points: int) -> None:
    """Write every k-th point of all scans, so that ``max_points`` remain.

    A line of JSON precedes them: the number of points in the file, and of each scan the number of points that follow
    and the values of black and white, which are equal if it does not state them.
    """
    import pye57

    with pye57.E57(path) as file:
        scans = [file.get_header(i) for i in range(file.scan_count)]
        counts = [scan.point_count for scan in scans]
        step = sum(counts) // (max_points + 1) + 1
        firsts = [-sum(counts[:i]) % step for i in range(len(counts))]
        kept = [len(range(first, count, step)) for first, count in zip(firsts, counts, strict=True)]
        summary = [sum(counts), [[n, *_color_range(scan)] for n, scan in zip(kept, scans, strict=True)]]
        sys.stdout.buffer.write(json.dumps(summary).encode() + b"\n")
        for scan, first in zip(scans, firsts, strict=True):
            done = 0
            for piece in _pieces(file, scan):
                sys.stdout.buffer.write(piece[(first - done) % step :: step].tobytes())
                done += len(piece)


def _color_range(scan: Any) -> tuple[float, float]:
    """Return the values of black and white of a scan; (0, 0) if it does not state them."""
    try:
        limits = scan["colorLimits"]
        ends = [_value(limits[f"colorRed{end}"]) for end in ("Minimum", "Maximum")]
    except Exception:  # there are none
        ends = [0.0, 0.0]
    return (ends[0], ends[1])


def _value(node: Any) -> float:
    return float(node.scaledValue() if hasattr(node, "scaledValue") else node.value())


def _pieces(file: Any, scan: Any) -> Iterator[np.ndarray[Any, np.dtype[Any]]]:
    """Yield the points of a scan in the frame of the file."""
    from pye57 import libe57

    position = next((names for names in (_CARTESIAN, _SPHERICAL) if set(names) <= set(scan.point_fields)), None)
    if position is None:
        raise ValueError(f"a scan has the fields {', '.join(scan.point_fields)}; expected cartesianX, Y and Z")
    names = [*position, *(name for name in (*_COLORS, *_INVALID) if name in scan.point_fields)]
    size = _PIECE // (8 * len(names))
    columns = {name: np.zeros(size) for name in names}
    buffers = libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, column, size, True, True))
    reader = scan.points.reader(buffers)
    if not np.linalg.norm(scan.rotation) > 0:
        raise ValueError("the rotation of a scan is zero")
    rotation, translation = scan.rotation_matrix, scan.translation
    while count := reader.read():
        here = {name: column[:count] for name, column in columns.items()}
        piece = np.full(count, np.nan, E57_POINT)
        xyz = np.column_stack([here[name] for name in position])
        if position is _SPHERICAL:
            distance, azimuth, elevation = xyz.T
            across = distance * np.cos(elevation)
            xyz = np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), distance * np.sin(elevation)])
        piece["xyz"] = xyz @ rotation.T + translation
        piece["xyz"][(here.get(f"{position[0][:9]}InvalidState", np.zeros(count)) != 0)] = np.nan
        if all(name in here for name in _COLORS):
            piece["rgb"] = np.column_stack([here[name] for name in _COLORS])
            piece["rgb"][here.get("isColorInvalid", np.zeros(count)) != 0] = np.nan
        yield piece
    reader.close()


if __name__ == "__main__":
    function, *arguments = json.loads(sys.argv[1])
    globals()[function](*arguments)
