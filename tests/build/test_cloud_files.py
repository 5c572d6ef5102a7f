"""Point cloud files as other programs write them, and as they arrive: damaged, odd and hostile."""

from __future__ import annotations

import io
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from cloud_writers import (
    COLOR_NAMES,
    e57,
    geo_keys,
    las,
    pcd,
    ply_header,
    ply_with_columns,
    rows_of,
    with_valid_pages,
)

from greenhouse_gym.build.scans import RawCloud, read_cloud
from greenhouse_gym.build.scans.cloud_formats import native
from greenhouse_gym.common import array_files
from greenhouse_gym.errors import FileFormatError, MissingDependencyError
from greenhouse_gym.geometry import Array

RNG = np.random.default_rng(0)
POINTS = RNG.random((100, 3)).round(4)
RED = np.array([194, 26, 18])
FLOATS = POINTS.astype("<f4").tobytes()
ASCII = ply_header(100, form="ascii").decode()


def read(folder: Path, suffix: str, content: bytes | str) -> RawCloud:
    file = folder / f"cloud{suffix}"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_cloud(file)


def assert_points(cloud: RawCloud, expected: Array = POINTS) -> None:
    np.testing.assert_allclose(cloud.points, expected, atol=1e-4)


def assert_red(cloud: RawCloud) -> None:
    assert cloud.colors is not None
    np.testing.assert_allclose(cloud.colors, np.tile(RED / 255, (len(cloud.points), 1)), atol=0.003)


# -- numbers as text --------------------------------------------------------------------------------------------------

TEXTS = {
    ".ply": ASCII + "{}",
    ".pcd": pcd("x y z", [4] * 3, "F F F", "{}", 100, "ascii").decode(),
    ".xyz": "{}",
    ".txt": "// X Y Z\n{}",
}
TEXT = pytest.mark.parametrize("suffix", TEXTS)


@TEXT
@pytest.mark.parametrize("bad", ["null", "0,5", "1_0", "0x10", "1e", "--1", "1.2.3", "1d5", "", "1 2"])
def test_a_missing_or_unreadable_number_is_refused_with_its_line(tmp_path: Path, suffix: str, bad: str) -> None:
    for row in (0, 57):
        lines = rows_of(POINTS).splitlines()
        words = lines[row].split()
        lines[row] = f"{words[0]} {bad} {words[2]}"
        text = TEXTS[suffix].format("\n".join(lines) + "\n")
        line = text.count("\n", 0, text.index(lines[row])) + 1
        with pytest.raises(FileFormatError, match=rf"cloud\{suffix}: line {line}: ") as error:
            read(tmp_path, suffix, text)
        assert bad in str(error.value)


@TEXT
@pytest.mark.parametrize("spelling", ["nan", "-nan(ind)", "1.#QNAN", "-1.#IND00", "1.#INF", "inf", "1e400"])
def test_points_without_a_finite_position_are_left_out(tmp_path: Path, suffix: str, spelling: str) -> None:
    for axis in (1, 2):
        text = TEXTS[suffix].format(rows_of(POINTS).replace(f"{POINTS[57, axis]:.4f}", spelling, 1))
        cloud = read(tmp_path, suffix, text)
        assert_points(cloud, np.delete(POINTS, 57, axis=0))
        assert cloud.notes == ("1 of 100 points have no finite position and were left out",)


@TEXT
@pytest.mark.parametrize("form", ["crlf", "cr", "byte order mark", "blank lines", "comment in Latin-1"])
def test_line_ends_and_marks_of_editors(tmp_path: Path, suffix: str, form: str) -> None:
    whole = TEXTS[suffix].format(rows_of(POINTS))
    content = {
        "crlf": whole.replace("\n", "\r\n").encode(),
        "cr": whole.replace("\n", "\r").encode(),
        "byte order mark": whole.encode("utf-8-sig"),
        "blank lines": TEXTS[suffix].format("\n" + rows_of(POINTS).replace("\n", "\n \n")).encode(),
        "comment in Latin-1": whole.replace("ply\n", "ply\ncomment Gr\xf6\xdfe\n").encode("latin-1"),
    }[form]
    if suffix in (".xyz", ".txt", ".pcd") and form == "comment in Latin-1":
        content = "# Gr\xf6\xdfe\n".encode("latin-1") + content
    assert_points(read(tmp_path, suffix, content))


@TEXT
def test_text_that_ends_early_is_refused(tmp_path: Path, suffix: str) -> None:
    start = "100\n" if suffix in (".xyz", ".txt") else ""  # the number of points, as some writers put it first
    assert_points(read(tmp_path, suffix, start + TEXTS[suffix].format(rows_of(POINTS))))
    with pytest.raises(FileFormatError, match="cut short: at most 99 of 100"):
        read(tmp_path, suffix, start + TEXTS[suffix].format(rows_of(POINTS[:99])))


# -- columns of text --------------------------------------------------------------------------------------------------

NORMAL = "0 -0.6 0.8"
HEADERS = {
    "colors": ("//X Y Z R G B", "194 26 18", " ", True, False),
    "CloudCompare": ("//X Y Z Rf Gf Bf Nx Ny Nz", "0.7608 0.102 0.0706 " + NORMAL, " ", True, True),
    "normals first": ("x y z nx ny nz red green blue", NORMAL + " 194 26 18", " ", True, True),
    "quoted": ('"x","y","z","r","g","b"', "194 26 18", ",", True, False),
    "ParaView": ('"Points:0","Points:1","Points:2","RGB:0","RGB:1","RGB:2"', "194 26 18", ",", True, False),
    "units": ("X [m]; Y [m]; Z [m]; Intensity", "7", ";", False, False),
    "intensity between": ("# x y z intensity red green blue", "0.5 194 26 18", "\t", True, False),
    "infrared": ("x y z Infrared NaN_count name", "200 1 3", " ", False, False),
    "laser": ("//X Y Z Intensity ReturnNumber Classification", "200 1 3", " ", False, False),
    "normals": ("//X Y Z Nx Ny Nz", "0 0.6 0.8", " ", False, True),
    "no names, normals": ("", NORMAL, " ", False, True),
    "no names, both": ("", NORMAL + " 194 26 18", " ", True, True),
    "no names, other order": ("", "194 26 18 " + NORMAL, " ", True, True),
}


@pytest.mark.parametrize("name", HEADERS)
def test_columns_of_text_go_by_the_names_of_its_header(tmp_path: Path, name: str) -> None:
    header, rest, separator, colored, with_normals = HEADERS[name]
    cloud = read(tmp_path, ".txt", (header + "\n" if header else "") + rows_of(POINTS, rest, separator))
    assert_points(cloud)
    assert (cloud.colors is not None) == colored
    assert (cloud.normals is not None) == with_normals
    if colored:
        assert_red(cloud)
    if cloud.normals is not None:
        np.testing.assert_allclose(np.abs(cloud.normals[0]), [0, 0.6, 0.8])
    assert any("not used" in note for note in cloud.notes) == (
        name in ("units", "intensity between", "laser", "infrared")
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("x y z intensity\n" + rows_of(POINTS, "1 2 3"), "line 2: 6 numbers, expected the 4 that its header names"),
        (rows_of(POINTS, "7"), "line 1: 4 numbers, expected 3, 6 or 9, or a header"),
        (rows_of(POINTS, "stem"), "line 1: 'stem' is no number"),
        (rows_of(POINTS).replace(".", ","), "line 1: '0,6370' is no number"),
        (rows_of(POINTS, separator=";").replace(".", ","), "line 1: '0,6370' is no number"),
        (rows_of(POINTS, separator=",").replace(",0.2698", ",", 1), "line 1: 2 numbers"),
        ("1 " * 2_000_000, "line 1 is longer than"),
        ("", "no rows of numbers"),
        ("\0" * 1000, "no rows of numbers"),
        ("some words\n" * 2000, "no rows of numbers"),
    ],
)
def test_text_whose_columns_are_unclear_is_refused(tmp_path: Path, text: str, problem: str) -> None:
    with pytest.raises(FileFormatError, match=problem):
        read(tmp_path, ".txt", text)


def test_comments_among_and_behind_the_rows(tmp_path: Path) -> None:
    lines = rows_of(POINTS).splitlines()
    lines[3] += " # the third row"
    lines[7:7] = ["  # indented", "// another", "% one more", "\t"]
    assert_points(read(tmp_path, ".xyz", "\n".join(lines)))


def test_text_in_utf_16(tmp_path: Path) -> None:
    assert_points(read(tmp_path, ".txt", ("x,y,z\n" + rows_of(POINTS, separator=",")).encode("utf-16")))


# -- PLY --------------------------------------------------------------------------------------------------------------

CAMERA = "element camera 1\n" + "".join(f"property float v{i}\n" for i in range(21))
FACES = "element face 2\nproperty list uchar int vertex_indices\n"
TWO_FACES = struct.pack("<B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3)
NESTED = "element view 2\nproperty list uchar double k\nproperty short id\nproperty list ushort uchar name\n"
TWO_VIEWS = struct.pack("<BddhH3s", 2, 1.0, 2.0, 7, 3, b"abc") + struct.pack("<BhH", 0, 8, 0)
PLY_FILES = {
    "camera first": ply_header(100, before=CAMERA) + bytes(84) + FLOATS,
    "faces first": ply_header(100, before=FACES) + TWO_FACES + FLOATS,
    "lists and numbers first": ply_header(100, before=NESTED) + TWO_VIEWS + FLOATS,
    "an empty element first": ply_header(100, before="element nothing 4294967295\n") + FLOATS,
    "faces last": ply_header(100).replace(b"end_header", FACES.encode() + b"end_header") + FLOATS + TWO_FACES,
    "big endian": ply_header(100, form="binary_big_endian") + POINTS.astype(">f4").tobytes(),
    "a list per point": ply_header(100, "property list uchar float t\n")
    + b"".join(point.astype("<f4").tobytes() + struct.pack("<Bf", 1, 0.5) for point in POINTS),
    "text, faces first": ply_header(100, before=FACES, form="ascii")
    + b"3 0 1 2\n4 0 1 2 3\n"
    + rows_of(POINTS).encode(),
    "text, a list per point": ply_header(100, "property list uchar float t\n", form="ascii")
    + rows_of(POINTS, "2 0.5 0.5").encode(),
    "long comment": ply_header(100, before=f"comment {'a' * 5000}\nobj_info {'b' * 2_000_000}\n") + FLOATS,
    "long names": ply_header(100, f"property uchar {'b' * 5000}\n", before=f"element {'a' * 5000} 0\n")
    + b"".join(point.astype("<f4").tobytes() + b"\0" for point in POINTS),
    "many comments": ply_header(100, before="comment a\n" * 50_000) + FLOATS,
    "odd comments": ply_header(100, before="comment \0\xff\ncomment end_header\ncomment\n") + FLOATS,
    "upper case": ply_header(100).replace(b"x\n", b"X\n").replace(b"float z", b"float Z") + FLOATS,
    "crlf": ply_header(100).replace(b"\n", b"\r\n") + FLOATS,
}


@pytest.mark.parametrize("name", PLY_FILES)
def test_points_of_a_ply_file_are_found_among_other_elements(tmp_path: Path, name: str) -> None:
    assert_points(read(tmp_path, ".ply", PLY_FILES[name]))


BROKEN_PLY = {
    "cut short": (ply_header(100) + FLOATS[:-1], "at most 99 of 100"),
    "10^18 points": (ply_header(10**18) + FLOATS, "cut short"),
    "10^400 points": (ply_header(10**400) + FLOATS, "cut short"),
    "minus one point": (ply_header(-1) + FLOATS, "element vertex -1"),
    "cut short in the camera": (ply_header(100, before=CAMERA) + bytes(50), "cut short among its 1 elements camera"),
    "cut short in a list": (ply_header(100, before=FACES) + TWO_FACES[:20], "fewer than 2 elements face"),
    "too many lists": (ply_header(100, before=FACES.replace("2", str(2**32))) + bytes(1000), "fewer than"),
    "a negative list": (ply_header(100, before=FACES.replace("uchar", "char")) + b"\xff" + FLOATS, "length -1"),
    "no z": (ply_header(100).replace(b"float z", b"float w") + FLOATS, "the columns x, y, w; expected x, y and z"),
    "x twice": (ply_header(100, "property float x\n") + FLOATS + FLOATS, "more than once"),
    "no points": (b"ply\nformat ascii 1.0\nend_header\n", "expected vertex"),
    "unknown type": (ply_header(100, "property quad q\n") + FLOATS, "property quad q"),
    "unknown format": (ply_header(100, form="zip") + FLOATS, "states no format"),
    "no end": (b"ply\nformat ascii 1.0\n" + b"comment\n" * 1000, "from ply to end_header"),
    "text, too many numbers": (ply_header(100, form="ascii") + rows_of(POINTS, "7").encode(), "line 8: 4 numbers"),
    "text, red of 300": (
        ply_header(100, "property uchar red\nproperty uchar green\nproperty uchar blue\n", form="ascii")
        + rows_of(POINTS, "300 1 1").encode(),
        "red from 300 to 300; expected integers, uint8",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN_PLY)
def test_a_broken_ply_file_is_refused(tmp_path: Path, name: str) -> None:
    content, problem = BROKEN_PLY[name]
    with pytest.raises(FileFormatError, match=problem):
        read(tmp_path, ".ply", content)


COLORS = [
    (("diffuse_red", "diffuse_green", "diffuse_blue"), "uchar", "u1", 1),
    (("r", "g", "b"), "uchar", "u1", 1),
    (("Red", "Green", "Blue"), "ushort", "<u2", 257),
    (("red", "green", "blue"), "ushort", "<u2", 1),  # 8 bits in 16
    (("red", "green", "blue"), "float", "<f4", 1 / 255),
    (("colorR", "colorG", "colorB"), "double", "<f8", 1),
    (("vertex_red", "vertex_green", "vertex_blue"), "int", "<i4", 1),
    (("blue", "green", "red"), "uchar", "u1", 1),
]


@pytest.mark.parametrize(("names", "kind", "dtype", "scale"), COLORS)
def test_colors_of_all_names_and_types(
    tmp_path: Path, names: tuple[str, ...], kind: str, dtype: str, scale: float
) -> None:
    values = RED[::-1] if names[0] == "blue" else RED
    columns = {name: np.full(100, scale * value) for name, value in zip(names, values, strict=True)}
    cloud = read(tmp_path, ".ply", ply_with_columns(POINTS, columns, kind, dtype))
    assert_points(cloud)
    assert_red(cloud)


@pytest.mark.parametrize(
    ("kind", "dtype", "name"), [("uint", "<u4", "rgba"), ("int", "<i4", "rgb"), ("float", "<f4", "rgb")]
)
def test_packed_colors(tmp_path: Path, kind: str, dtype: str, name: str) -> None:
    packed = np.full(100, (194 << 16) + (26 << 8) + 18, np.uint32)
    content = ply_with_columns(POINTS, {name: packed.view(dtype)}, kind, dtype)
    assert_red(read(tmp_path, ".ply", content))


def test_colors_that_are_missing_partly_or_exceed_white(tmp_path: Path) -> None:
    names = ("red", "green", "blue")
    columns = {name: np.where(np.arange(100) < 40, np.nan, value / 255) for name, value in zip(names, RED, strict=True)}
    cloud = read(tmp_path, ".ply", ply_with_columns(POINTS, columns, "float", "<f4"))
    assert cloud.colors is not None
    assert (cloud.colors[:40] == 0.5).all()
    np.testing.assert_allclose(cloud.colors[40:], np.tile(RED / 255, (60, 1)), atol=1e-6)
    assert "40 of 100 points have no color and are taken as gray" in cloud.notes
    rounded = dict.fromkeys(names, np.full(100, 1.0000001))
    assert (read(tmp_path, ".ply", ply_with_columns(POINTS, rounded, "float", "<f4")).colors == 1.0).all()  # type: ignore[union-attr]
    for values in (np.full(100, 1e6), np.full(100, -0.5)):
        with pytest.raises(FileFormatError, match="colors from"):
            read(tmp_path, ".ply", ply_with_columns(POINTS, dict.fromkeys(names, values), "float", "<f4"))
    cloud = read(
        tmp_path, ".ply", ply_with_columns(POINTS, {"red": np.ones(100), "alpha": np.ones(100)}, "uchar", "u1")
    )
    assert cloud.colors is None
    assert cloud.notes == ("columns that were not used: red, alpha",)


# -- PCD --------------------------------------------------------------------------------------------------------------

PACKED = np.full(100, (194 << 16) + (26 << 8) + 18, np.uint32)
WITH_RGB = np.column_stack([POINTS.astype("<f4"), PACKED.view("<f4")]).tobytes()
OPAQUE = np.column_stack([POINTS.astype("<f4"), (PACKED | np.uint32(255 << 24)).view("<f4")]).tobytes()
NORMALS = np.tile([0.0, -0.6, 0.8], (100, 1))
SIX = np.column_stack([POINTS, NORMALS]).astype("<f4").tobytes()
PCD_FILES = {
    "one normal": (pcd("x y z normal_x", [4] * 4, "F F F F", WITH_RGB, 100), False, False),
    "normals": (pcd("x y z normal_x normal_y normal_z", [4] * 6, "F F F F F F", SIX, 100), False, True),
    "other normals": (pcd("x y z nx ny nz", [4] * 6, "F F F F F F", SIX, 100), False, True),
    "a letter changed": (pcd("x y z normal_x Aormal_y normal_z", [4] * 6, "F F F F F F", SIX, 100), False, False),
    "double precision": (pcd("x y z", [8] * 3, "F F F", POINTS.tobytes(), 100), False, False),
    "packed, as float": (pcd("x y z rgb", [4] * 4, "F F F F", WITH_RGB, 100), True, False),
    "packed, as integer": (pcd("x y z rgb", [4] * 4, "F F F U", WITH_RGB, 100), True, False),
    "packed and opaque": (pcd("x y z rgba", [4] * 4, "F F F F", OPAQUE, 100), True, False),
    "packed, as text of an integer": (
        pcd("x y z rgb", [4] * 4, "F F F U", rows_of(POINTS, str(PACKED[0])), 100, "ascii"), True, False,
    ),
    "packed, as text of a float": (
        pcd("x y z rgb", [4] * 4, "F F F F", rows_of(POINTS, repr(float(PACKED.view("<f4")[0]))), 100, "ascii"),
        True, False,
    ),
    "bytes": (
        pcd("x y z r g b", [4, 4, 4, 1, 1, 1], "F F F U U U",
            b"".join(point.astype("<f4").tobytes() + bytes(RED.tolist()) for point in POINTS), 100), True, False,
    ),
    "padding": (
        pcd("x y z _ rgb _", [4, 4, 4, 1, 4, 1], "F F F U F U",
            b"".join(point.astype("<f4").tobytes() + bytes(4) + PACKED[:1].tobytes() + bytes(12) for point in POINTS),
            100).replace(b"WIDTH", b"COUNT 1 1 1 4 1 12\nWIDTH"), True, False,
    ),
    "x twice": (pcd("x x y z", [4] * 4, "F F F F",
                    np.column_stack([POINTS[:, 0], POINTS]).astype("<f4").tobytes(), 100), False, False),
    "version 0.5": (pcd("x y z", [4] * 3, "F F F", FLOATS, 100).replace(b"FIELDS", b"COLUMNS"), False, False),
}  # fmt: skip


@pytest.mark.parametrize("name", PCD_FILES)
def test_fields_of_a_pcd_file(tmp_path: Path, name: str) -> None:
    content, colored, with_normals = PCD_FILES[name]
    cloud = read(tmp_path, ".pcd", content)
    assert_points(cloud)
    assert (cloud.colors is not None) == colored
    assert (cloud.normals is not None) == with_normals
    if colored:
        assert_red(cloud)


def compressed(content: bytes, unpacked: int, points: int = 100) -> bytes:
    block = struct.pack("<II", len(content), unpacked) + content
    return pcd("x y z", [4] * 3, "F F F", block, points, "binary_compressed")


BROKEN_PCD = {
    "cut short": (pcd("x y z", [4] * 3, "F F F", FLOATS[:-1], 100), "at most 99 of 100"),
    "10^12 points": (pcd("x y z", [4] * 3, "F F F", FLOATS, 10**12), "cut short"),
    "a size of 3": (pcd("x y z", [3] * 3, "F F F", FLOATS, 100), "size 3"),
    "a size missing": (pcd("x y z", [4] * 2, "F F F", FLOATS, 100), "3 fields with 2 sizes"),
    "10^9 values": (
        pcd("x y z", [4] * 3, "F F F", FLOATS, 100).replace(b"WIDTH", b"COUNT 1000000000 1 1\nWIDTH"), "pcd",
    ),
    "no values": (pcd("x y z", [4] * 3, "F F F", FLOATS, 100).replace(b"WIDTH", b"COUNT 0 1 1\nWIDTH"), "count 0"),
    "4 GB compressed to 10 bytes": (compressed(bytes(10), 12 * 357_913_941, 357_913_941), "damaged"),
    "other size": (compressed(bytes(100), 1100), "expected 1200"),
    "a repetition before the start": (compressed(b"\x3f\xff" * 50, 1200), "damaged"),
    "ends in a repetition": (compressed(b"\0\0" * 40 + b"\xff", 1200), "damaged"),
    "too long": (compressed(b"\0\0" + b"\xe0\xff\0" * 99, 1200), "damaged"),
    "unknown data": (pcd("x y z", [4] * 3, "F F F", FLOATS, 100, "binary_lz4"), "expected ascii, binary"),
    "no fields": (b"VERSION 0.7\nPOINTS 100\nDATA binary\n" + FLOATS, "no columns"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN_PCD)
def test_a_broken_pcd_file_is_refused(tmp_path: Path, name: str) -> None:
    content, problem = BROKEN_PCD[name]
    with pytest.raises(FileFormatError, match=problem):
        read(tmp_path, ".pcd", content)


def test_repetitions_of_a_compressed_pcd_file(tmp_path: Path) -> None:
    """100 times the same y and z; the block repeats four bytes that overlap themselves."""
    x = POINTS[:, 0].astype("<f4").tobytes()
    literal = b"".join(bytes([len(x[i : i + 32]) - 1]) + x[i : i + 32] for i in range(0, 400, 32))
    one = np.float32(0.25).tobytes()
    repeated = b"\x03" + one + b"\xe0" + bytes([255 - 0]) + b"\x03" + b"\xe0" + bytes([396 - 264 - 9]) + b"\x03"
    cloud = read(tmp_path, ".pcd", compressed(literal + 2 * repeated, 1200))
    assert_points(cloud, np.column_stack([POINTS[:, 0], np.full((100, 2), 0.25)]))


# -- LAS and LAZ ------------------------------------------------------------------------------------------------------

LASER = pytest.mark.parametrize("suffix", [".las", ".laz"])


def changed(content: bytes, at: int, layout: str, value: float) -> bytes:
    result = bytearray(content)
    struct.pack_into("<" + layout, result, at, value)
    return bytes(result)


@pytest.mark.parametrize(
    ("point_format", "version"), [(0, "1.2"), (1, "1.2"), (3, "1.3"), (6, "1.4"), (7, "1.4"), (8, "1.4")]
)
def test_point_formats_of_las(tmp_path: Path, point_format: int, version: str) -> None:
    colors = [257 * int(value) for value in RED] if point_format in (3, 7, 8) else None
    content = las(tmp_path / "w.las", POINTS, colors, point_format=point_format, version=version)
    cloud = read(tmp_path, ".las", content)
    assert_points(cloud)
    assert (cloud.colors is not None) == (colors is not None)
    if colors:
        assert_red(cloud)
        assert_red(read(tmp_path, ".las", las(tmp_path / "w.las", POINTS, RED.tolist())))  # 8 bits in 16


HOSTILE_LAS = {
    "2 million records": (100, "I", 2_000_000, "states 2000000 records"),
    "2^32 records": (100, "I", 2**32 - 1, "records"),
    "2^32 points": (107, "I", 2**32 - 1, "cut short|cannot be read"),
    "points beyond the end": (96, "I", 2**32 - 1, "points from byte 4294967295"),
    "points in the header": (96, "I", 0, "points from byte 0"),
    "points of 64 KB": (105, "H", 65535, "cut short|do not have the 65535 bytes"),
    "points of a byte": (105, "H", 1, "1 bytes"),
    "format 63": (104, "B", 63, "format 63"),
    "no scale": (131, "d", np.nan, "scales"),
    "a long header": (94, "H", 65535, "65535 bytes of header"),
    "no signature": (0, "I", 0, "not a LAS file"),
}


@LASER
@pytest.mark.parametrize("name", HOSTILE_LAS)
def test_counts_of_a_laser_file_that_cannot_be_are_refused(tmp_path: Path, suffix: str, name: str) -> None:
    at, layout, value, problem = HOSTILE_LAS[name]
    with pytest.raises(FileFormatError, match=problem):
        read(tmp_path, suffix, changed(las(tmp_path / f"w{suffix}", POINTS), at, layout, value))


HOSTILE_LAS_14 = {
    "2^32 later records": (243, "I", 2**32 - 1, "records"),
    "2^63 points": (247, "Q", 2**63, "cut short"),
}


@pytest.mark.parametrize("name", HOSTILE_LAS_14)
def test_counts_of_las_1_4_that_cannot_be_are_refused(tmp_path: Path, name: str) -> None:
    at, layout, value, problem = HOSTILE_LAS_14[name]
    content = las(tmp_path / "w.las", POINTS, point_format=7, version="1.4")
    with pytest.raises(FileFormatError, match=problem):
        read(tmp_path, ".las", changed(content, at, layout, value))


@pytest.mark.parametrize("fault", ["compressor of old", "chunks of 2^31", "2^32 chunks", "cut short"])
def test_damage_of_laz_that_the_decoder_dies_of_is_refused(tmp_path: Path, fault: str) -> None:
    """A Rust panic, and two times memory for tens of GB."""
    content = las(tmp_path / "w.laz", POINTS)
    record = content.find(b"laszip encoded") - 2 + 54
    table = struct.unpack_from("<Q", content, struct.unpack_from("<I", content, 96)[0])[0]
    damaged = {
        "compressor of old": changed(changed(content, record, "H", 1), record + 12, "I", 2**32 - 1),
        "chunks of 2^31": changed(content, record + 12, "I", 2**31),
        "2^32 chunks": changed(content, table + 4, "I", 2**32 - 1),
        "cut short": content[: len(content) // 2],
    }[fault]
    with pytest.raises(FileFormatError, match=r"cloud\.laz: cannot be read"):
        read(tmp_path, ".laz", damaged)


WKT_1 = (
    'COMPD_CS["a",PROJCS["NAD83 / Oregon [ft]",GEOGCS["NAD83",DATUM["N",SPHEROID["G",6378137,298.25]],'
    'UNIT["degree",0.0174532925199433]],PARAMETER["false_easting",1312335.958],UNIT["foot",0.3048]],'
    'VERT_CS["NAVD88",UNIT["metre",1.0]]]'
)
WKT_2 = (
    'PROJCRS["b",BASEGEOGCRS["N",DATUM["N",ELLIPSOID["G",6378137,298.25,LENGTHUNIT["metre",1]]]],CONVERSION["c",'
    'PARAMETER["Easting",1640416.67,LENGTHUNIT["metre",1]]],CS[Cartesian,2],AXIS["x",east,'
    'LENGTHUNIT["US survey foot",0.304800609601219]]]'
)
UNITS = {
    "survey feet": ([geo_keys((1024, 0, 1), (3072, 0, 2868), (3076, 0, 9003))], 1200 / 3937, 1.0),
    "feet, heights in metres": ([geo_keys((3076, 0, 9002), (4099, 0, 9001))], 0.3048, 1 / 0.3048),
    "metres": ([geo_keys((3076, 0, 9001))], 1.0, 1.0),
    "own": ([geo_keys((3076, 0, 32767), (3077, 34736, 0)), (34736, struct.pack("<d", 0.5))], 0.5, 1.0),
    "text, feet, heights in metres": ([(2112, WKT_1.encode() + b"\0")], 0.3048, 1 / 0.3048),
    "text of version 2": ([(2112, WKT_2.encode())], 0.304800609601219, 1.0),
    "text, local": ([(2112, b'LOCAL_CS["site",UNIT["millimetre",0.001]]')], 0.001, 1.0),
    "not looked up": ([geo_keys((1024, 0, 1), (3072, 0, 2868))], None, 1.0),
    "not in degrees": ([geo_keys((1024, 0, 2))], None, 1.0),
    "damaged text": ([(2112, b'PROJCS["a[[[[",GEOGCS[((' + 500 * b"(")], None, 1.0),
    "damaged keys": ([(34735, b"\xff" * 13)], None, 1.0),
    "unit of zero": ([(2112, b'PROJCS["a",UNIT["b",0]]')], None, 1.0),
}


@pytest.mark.parametrize("name", UNITS)
def test_units_that_a_las_file_states(tmp_path: Path, name: str) -> None:
    records, unit, vertical = UNITS[name]
    cloud = read(tmp_path, ".las", las(tmp_path / "w.las", POINTS, records=records))
    assert cloud.unit == (None if unit is None else pytest.approx(unit))
    assert_points(cloud, POINTS * [1, 1, vertical])
    assert any("the file states" in note for note in cloud.notes) == (unit is not None or name.startswith("not "))


def test_longitudes_and_latitudes_are_refused(tmp_path: Path) -> None:
    points = POINTS * [1e-5, 1e-5, 1e-4] + [5.0, 50.0, 0.0]
    content = las(tmp_path / "w.las", points, records=[geo_keys((1024, 0, 2))], scale=1e-8)
    with pytest.raises(FileFormatError, match="longitude and latitude"):
        read(tmp_path, ".las", content)


# -- E57 --------------------------------------------------------------------------------------------------------------

AXES = {f"cartesian{axis}": column for axis, column in zip("XYZ", POINTS.T, strict=True)}


def reds(scale: float, count: int = 100) -> dict[str, Array]:
    return {name: np.full(count, scale * value) for name, value in zip(COLOR_NAMES, RED, strict=True)}


def integers(image: object) -> object:
    return pytest.importorskip("pye57").libe57.IntegerNode(image, 0, 0, 65535)


def scaled(image: object) -> object:
    return pytest.importorskip("pye57").libe57.ScaledIntegerNode(image, 0, 0, 1000, 0.001, 0.0)


def test_colors_and_states_of_e57_scans(tmp_path: Path) -> None:
    """Fractions, 8, 10 and 16 bits, wrong limits, none, no colors, and points and colors that are marked as invalid."""
    invalid = {"cartesianInvalidState": np.arange(100) < 30, "isColorInvalid": np.arange(100) < 40}
    scans = [
        (AXES | reds(1 / 255), None, (0, 1)),
        (AXES | reds(1 / 255), scaled, (0, 1)),
        (AXES | reds(1), integers, (0, 255)),
        (AXES | reds(1023 / 255), integers, (0, 1023)),
        (AXES | reds(257), integers, (0, 65535)),
        (AXES | reds(1), integers, (0, 1)),
        (AXES | reds(257), integers, None),
        (AXES, None, None),
        (AXES | reds(1) | invalid, integers, (0, 255)),
    ]
    cloud = read(tmp_path, ".e57", e57(tmp_path / "w.e57", *scans))
    assert len(cloud.points) == 870
    assert cloud.colors is not None
    np.testing.assert_allclose(cloud.colors[:700], np.tile(RED / 255, (700, 1)), atol=0.004)
    assert (cloud.colors[700:810] == 0.5).all()
    np.testing.assert_allclose(cloud.colors[810:], np.tile(RED / 255, (60, 1)), atol=0.004)
    assert "30 of 900 points have no finite position and were left out" in cloud.notes
    assert "110 of 870 points have no color and are taken as gray" in cloud.notes


def test_a_turned_scan_in_spherical_coordinates(tmp_path: Path) -> None:
    distance = np.linalg.norm(POINTS, axis=1)
    x, y, z = POINTS.T
    angles = {"sphericalAzimuth": np.arctan2(y, x), "sphericalElevation": np.arcsin(z / distance)}
    content = e57(
        tmp_path / "w.e57", ({"sphericalRange": distance} | angles, None, None), rotation=(0.5**0.5, 0, 0, 0.5**0.5)
    )
    assert_points(read(tmp_path, ".e57", content), np.column_stack([-y, x, z]))


@pytest.mark.parametrize("fault", ["10^12 points", "no rotation", "no positions", "damaged page", "cut short"])
def test_a_broken_e57_file_is_refused(tmp_path: Path, fault: str) -> None:
    columns = {"intensity": POINTS[:, 0]} if fault == "no positions" else AXES
    whole = e57(tmp_path / "w.e57", (columns, None, None), rotation=(float(fault != "no rotation"), 0, 0, 0))
    content = {
        "10^12 points": with_valid_pages(
            whole.replace(b"0" * 30, b"0" * 20).replace(b'recordCount="100"', b'recordCount="1000000000000"')
        ),
        "damaged page": whole.replace(b"cartesianX", b"cartesianQ"),
        "cut short": whole[: len(whole) // 2],
    }.get(fault, whole)
    with pytest.raises(FileFormatError, match=r"cloud\.e57: "):
        read(tmp_path, ".e57", content)


def test_a_missing_decoder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content = las(tmp_path / "w.laz", POINTS)
    monkeypatch.setattr(native, "find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"lazrs is not installed: .*\[scans\]"):
        read(tmp_path, ".laz", content)
    monkeypatch.undo()
    (tmp_path / "lazrs.py").write_text("raise ImportError('libc.so.9: no such file')")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    with pytest.raises(MissingDependencyError, match=r"libc\.so\.9"):
        read(tmp_path, ".laz", content)


# -- NumPy ------------------------------------------------------------------------------------------------------------


def npz(**arrays: Array) -> bytes:
    np.savez_compressed(buffer := io.BytesIO(), **arrays)
    return buffer.getvalue()


def test_names_of_arrays_and_fields(tmp_path: Path) -> None:
    opaque = np.tile([194, 26, 18, 255], (100, 1)).astype(np.uint8)
    cloud = read(tmp_path, ".npz", npz(positions=POINTS, colors=opaque))
    assert_points(cloud)
    assert_red(cloud)
    image = read(tmp_path, ".npz", npz(points=POINTS.reshape(10, 10, 3), colors=POINTS.reshape(10, 10, 3)))
    np.testing.assert_array_equal(image.colors, POINTS)  # type: ignore[arg-type]
    records = np.zeros(100, [(name, "f8") for name in ("x", "y", "z")] + [(name, "u1") for name in ("r", "g", "b")])
    for name, column in zip(("x", "y", "z", "r", "g", "b"), (*POINTS.T, *opaque.T[:3]), strict=True):
        records[name] = column
    np.save(tmp_path / "cloud.npy", records)
    assert_red(read_cloud(tmp_path / "cloud.npy"))


@pytest.mark.parametrize(
    "arrays",
    [
        {"points": POINTS.T},
        {"points": POINTS + 1j},
        {"points": POINTS.astype(str)},
        {"points": POINTS[:, 0]},
        {"points": np.array(1.0)},
        {"points": POINTS, "colors": POINTS[:50]},
        {"points": POINTS, "normals": POINTS[:, :2]},
        {"cloud": POINTS},
    ],
)
def test_arrays_of_other_shapes_are_refused(tmp_path: Path, arrays: dict[str, Array]) -> None:
    with pytest.raises(FileFormatError, match="expected"):
        read(tmp_path, ".npz", npz(**arrays))


def test_an_archive_that_unpacks_to_much_more_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.zeros((100_000, 3))
    points[:100] = POINTS
    assert len(read(tmp_path, ".npz", npz(points=points)).points) == 100_000
    monkeypatch.setattr(array_files, "_SMALL", 1_000_000)
    with pytest.raises(FileFormatError, match=r"unpacked it has 24001\d\d bytes, at most 1000000 are read"):
        read(tmp_path, ".npz", npz(points=points))
