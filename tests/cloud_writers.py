"""Point cloud files written byte by byte or by reference writers, with damage where a test wants it."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.geometry import Array

COLOR_NAMES = ("colorRed", "colorGreen", "colorBlue")


def rows_of(points: Array, rest: str = "", separator: str = " ") -> str:
    """Rows of text, each with the same words at its end."""
    end = separator + rest.replace(" ", separator) if rest else ""
    return "".join(separator.join(f"{value:.4f}" for value in point) + end + "\n" for point in points)


def ply_header(count: int, more: str = "", before: str = "", form: str = "binary_little_endian") -> bytes:
    """Header of a PLY file with the points as floats; ``more`` are properties, ``before`` lines before the points."""
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    return f"ply\nformat {form} 1.0\n{before}element vertex {count}\n{axes}{more}end_header\n".encode()


def ply_with_columns(points: Array, columns: Mapping[str, Array], kind: str, dtype: str) -> bytes:
    """Binary PLY file with more columns of one type."""
    fields = [(axis, "<f4") for axis in "xyz"] + [(name, dtype) for name in columns]
    records = np.zeros(len(points), fields)
    for axis, column in zip("xyz", points.T, strict=True):
        records[axis] = column
    for name, column in columns.items():
        records[name] = column
    return ply_header(len(points), "".join(f"property {kind} {name}\n" for name in columns)) + records.tobytes()


def pcd(fields: str, sizes: Sequence[int], types: str, content: bytes | str, count: int, form: str = "binary") -> bytes:
    """PCD file with a header of version 0.7; ``fields`` and ``types`` are separated by spaces."""
    header = f"VERSION 0.7\nFIELDS {fields}\nSIZE {' '.join(map(str, sizes))}\nTYPE {types}\n"
    header += f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {form}\n"
    return header.encode() + (content if isinstance(content, bytes) else content.encode())


def las(
    path: Path,
    points: Array,
    colors: Sequence[int] | None = None,
    records: Sequence[tuple[int, bytes]] = (),
    point_format: int = 2,
    version: str = "1.2",
    scale: float = 1e-4,
) -> bytes:
    """Write a LAS or LAZ file with one color and with records on its coordinate system; return its content."""
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [scale] * 3, np.floor(points.min(axis=0))
    for number, content in records:
        header.vlrs.append(laspy.VLR("LASF_Projection", number, "", content))
    written = laspy.LasData(header)
    written.xyz = points
    for name, value in zip(("red", "green", "blue"), colors or (), strict=False):
        written[name] = np.full(len(points), value, np.uint16)
    written.write(path)
    return path.read_bytes()


def geo_keys(*keys: tuple[int, int, int]) -> tuple[int, bytes]:
    """Record of GeoTIFF keys: number, where its value is (0 for here), and the value."""
    rows = b"".join(struct.pack("<4H", key, where, 1, value) for key, where, value in keys)
    return 34735, struct.pack("<4H", 1, 1, 0, len(keys)) + rows


Scan = tuple[Mapping[str, Array], Callable[[Any], Any] | None, tuple[float, float] | None]
"""Columns of a scan, the type of its colors given the file, and the values of black and white."""


def e57(path: Path, *scans: Scan, rotation: Sequence[float] = (1, 0, 0, 0)) -> bytes:
    """Write an E57 file of several scans by libE57; return its content."""
    pye57 = pytest.importorskip("pye57")
    lib = pye57.libe57
    file = pye57.E57(str(path), mode="w")
    image, kept = file.image_file, []
    for columns, color_type, limits in scans:
        scan, prototype = lib.StructureNode(image), lib.StructureNode(image)
        scan.set("guid", lib.StringNode(image, "{" + "0" * 30 + "}"))
        place, turn = lib.StructureNode(image), lib.StructureNode(image)
        for name, value in zip("wxyz", rotation, strict=True):
            turn.set(name, lib.FloatNode(image, float(value)))
        place.set("rotation", turn)
        scan.set("pose", place)
        for name in columns:
            own = color_type if name in COLOR_NAMES else None
            prototype.set(name, own(image) if own else lib.FloatNode(image, 0.0, lib.E57_DOUBLE, -1e6, 1e6))
        if limits is not None:
            stated = lib.StructureNode(image)
            for name in COLOR_NAMES:
                for end, value in zip(("Minimum", "Maximum"), limits, strict=True):
                    stated.set(name + end, lib.FloatNode(image, float(value)))
            scan.set("colorLimits", stated)
        points = lib.CompressedVectorNode(image, prototype, lib.VectorNode(image, True))
        scan.set("points", points)
        file.data3d.append(scan)
        buffers = lib.VectorSourceDestBuffer()
        for name, column in columns.items():
            kept.append(np.ascontiguousarray(column, dtype=np.float64))
            buffers.append(lib.SourceDestBuffer(image, name, kept[-1], len(column), True, True))
        writer = points.writer(buffers)
        writer.write(len(kept[-1]))
        writer.close()
    file.close()
    return path.read_bytes()


def with_valid_pages(content: bytes) -> bytes:
    """An E57 file whose pages have the checksums of what they hold, so that damage reaches the reader behind them."""
    result = bytearray(content)
    for at in range(0, len(result) - 1023, 1024):
        crc = 0xFFFFFFFF
        for byte in result[at : at + 1020]:
            crc = _CRC[(crc ^ byte) & 255] ^ (crc >> 8)
        result[at + 1020 : at + 1024] = struct.pack(">I", crc ^ 0xFFFFFFFF)
    return bytes(result)


def _crc_of(value: int) -> int:
    for _ in range(8):
        value = (value >> 1) ^ 0x82F63B78 if value & 1 else value >> 1
    return value


_CRC = [_crc_of(value) for value in range(256)]
