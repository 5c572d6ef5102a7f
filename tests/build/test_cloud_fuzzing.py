"""Damaged clouds of all formats, read in a process of its own: no foreign error, no crash, no hang, no full memory."""

from __future__ import annotations

import io
import os
import struct
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from cloud_writers import COLOR_NAMES, e57, geo_keys, las, pcd, ply_header, ply_with_columns, rows_of, with_valid_pages
from fuzzing import Damage, Source, assert_all_end_well, assert_what_is_no_file_does_no_harm
from mutants import damaged_arrays, damaged_bytes, damaged_numbers

from greenhouse_gym.build.scans import read_cloud
from greenhouse_gym.build.scans.frame import guess_unit, without_strays

POINTS = np.random.default_rng(0).random((120, 3)).round(4)
RED = {name: np.full(120, value) for name, value in zip(("red", "green", "blue"), (194, 26, 18), strict=True)}
FACES = "element face 2\nproperty list uchar int vertex_indices\n"
TWO_FACES = struct.pack("<B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3)
FLOATS = POINTS.astype("<f4").tobytes()
PACKED = rows_of(POINTS, "12720658")


def npy(array: np.ndarray) -> bytes:
    np.save(buffer := io.BytesIO(), array)
    return buffer.getvalue()


def npz() -> bytes:
    np.savez_compressed(buffer := io.BytesIO(), points=POINTS, colors=(255 * POINTS).astype(np.uint8), normals=POINTS)
    return buffer.getvalue()


def compressed() -> bytes:
    """Literal bytes for x and y, repetitions for z."""
    content = POINTS[:, :2].T.astype("<f4").tobytes()
    block = b"".join(bytes([31]) + content[i : i + 32] for i in range(0, len(content), 32))
    block += b"\x03" + np.float32(0.5).tobytes() + b"\xe0\xff\x03" + b"\xe0\xcb\x03"
    return pcd("x y z", [4] * 3, "F F F", struct.pack("<II", len(block), 1440) + block, 120, "binary_compressed")


def laser(suffix: str, point_format: int = 2, version: str = "1.2") -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        records = [
            geo_keys((1024, 0, 1), (3076, 0, 9003)),
            (2112, b'PROJCS["a",GEOGCS["b",UNIT["c",1]],UNIT["foot",0.3]]'),
        ]
        return las(Path(folder) / f"w{suffix}", POINTS, (1, 2, 3), records, point_format, version)


def two_scans() -> bytes:
    axes = {f"cartesian{axis}": column for axis, column in zip("XYZ", POINTS.T, strict=True)}
    colors = dict.fromkeys(COLOR_NAMES, np.full(120, 0.5)) | {"cartesianInvalidState": np.arange(120) % 7 == 0}
    with tempfile.TemporaryDirectory() as folder:
        return e57(Path(folder) / "w.e57", (axes | colors, None, (0, 1)), (axes, None, None))


FORMATS: Mapping[str, tuple[str, Callable[[], bytes]]] = MappingProxyType(
    {
        "ply": (".ply", lambda: ply_with_columns(POINTS, RED, "uchar", "u1")),
        "ply with lists": (".ply", lambda: ply_header(120, before=FACES) + TWO_FACES + FLOATS),
        "ply as text": (".ply", lambda: ply_header(120, form="ascii") + rows_of(POINTS).encode()),
        "pcd": (".pcd", lambda: pcd("x y z normal_x normal_y normal_z", [4] * 6, "F F F F F F",
                                    np.column_stack([POINTS, POINTS]).astype("<f4").tobytes(), 120)),
        "pcd compressed": (".pcd", compressed),
        "pcd as text": (".pcd", lambda: pcd("x y z rgb", [4] * 4, "F F F U", PACKED, 120, "ascii")),
        "text": (".txt", lambda: b"//X Y Z R G B Nx Ny Nz\n120\n" + rows_of(POINTS, "194 26 18 0 0.6 0.8").encode()),
        "commas": (".xyz", lambda: rows_of(POINTS, "1 2 3", ",").encode("utf-8-sig")),
        "npy": (".npy", lambda: npy(POINTS)),
        "npz": (".npz", npz),
        "las": (".las", lambda: laser(".las")),
        "las 1.4": (".las", lambda: laser(".las", 7, "1.4")),
        "laz": (".laz", lambda: laser(".laz")),
        "e57": (".e57", two_scans),
    }
)  # fmt: skip
NATIVE = ("laz", "e57")  # each read starts a process


def damages(kind: str) -> tuple[Damage, ...]:
    if kind == "npz":
        return damaged_arrays, damaged_bytes
    if kind == "e57":  # half of the time such that the decoder notices it behind the checksums only
        return damaged_bytes, lambda content, seed: with_valid_pages(damaged_numbers(content, seed))
    return damaged_bytes, damaged_numbers


def source_of(kind: str, suffix: str, content: Callable[[], bytes]) -> Source:
    def write(folder: Path) -> Path:
        path = folder / f"cloud{suffix}"
        path.write_bytes(content())
        assert len(read_cloud(path).points) > 100
        return path

    return Source(write, lambda path: guess_unit(without_strays(read_cloud(path)).points), damages(kind))


SOURCES = MappingProxyType({kind: source_of(kind, *each) for kind, each in FORMATS.items()})


def test_some_mutants_of_each_format(tmp_path: Path) -> None:
    pytest.importorskip("laspy")
    pytest.importorskip("pye57")
    assert_all_end_well(__name__, tmp_path, [(kind, 0, 3 if kind in NATIVE else 25) for kind in SOURCES])


@pytest.mark.timeout(60)
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes among the files of this system")
@pytest.mark.parametrize("kind", sorted(SOURCES.keys() - NATIVE))
def test_what_is_no_file_does_no_harm(tmp_path: Path, kind: str) -> None:
    assert_what_is_no_file_does_no_harm(SOURCES[kind], tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("kind", SOURCES)
def test_2000_mutants_of_each_format(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("laspy")
    pytest.importorskip("pye57")
    assert_all_end_well(__name__, tmp_path, [(kind, 0, 2000)])
