"""Images are in the order of their numbers, paired and posed by them, and read as they are stored."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from greenhouse_gym.capture import open_recording
from greenhouse_gym.capture.formats.image_lists import check_numbers, numbers, partners, poses_by_id, sorted_images
from greenhouse_gym.capture.image_files import read_any_color, read_any_depth, read_color
from greenhouse_gym.cli.main import app
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import pose

LENS = {"width": 16, "height": 12, "fx": 10.0, "fy": 10.0, "cx": 8.0, "cy": 6.0}


def paths(*names: str) -> list[Path]:
    return [Path(name) for name in names]


@pytest.mark.parametrize(
    "names",
    [
        ["0.png", "1.png", "2.png", "10.png", "11.png", "100.png"],
        ["frame_1_color.jpg", "frame_2_color.jpg", "frame_10_color.jpg"],
        ["100.250000.png", "100.500000.png", "101.125000.png"],
        ["a2.png", "a10.png", "b1.png"],
        ["0009.png", "10.png", "0011.png"],
        ["1305031098.png", "1305031102.png", "13050311020.png"],
    ],
)
def test_images_are_in_the_order_of_their_numbers(names: list[str]) -> None:
    assert [file.name for file in sorted_images(reversed(paths(*names)))] == names


def test_what_is_no_image_is_left_out() -> None:
    names = ["1.png", ".DS_Store", "Thumbs.db", "._1.png", "notes.txt", "2.PNG"]
    assert [file.name for file in sorted_images(paths(*names))] == ["1.png", "2.PNG"]


def test_numbers_are_those_that_differ() -> None:
    assert numbers(paths("cam1_0007.png", "cam1_0010.png")) == [(7,), (10,)]
    assert numbers(paths("848x480_3.png", "848x480_4.png")) == [(3,), (4,)]
    assert numbers(paths("a.png", "b.png")) is None
    assert numbers(paths("1.png", "01.png")) is None
    assert numbers(paths("1.png", "1_2.png")) is None
    assert numbers([]) is None


PARTNERS: dict[str, tuple[list[str], list[str], list[str | None]]] = {
    "equal names": (["2.jpg", "10.jpg"], ["10.png", "2.png"], ["2.png", "10.png"]),
    "other padding": (["2.jpg", "10.jpg"], ["0002.png", "0010.png"], ["0002.png", "0010.png"]),
    "other prefixes": (["c_2.jpg", "c_10.jpg"], ["d_10.png", "d_2.png"], ["d_2.png", "d_10.png"]),
    "one is missing": (["2.jpg", "10.jpg", "11.jpg"], ["2.png", "11.png"], ["2.png", None, "11.png"]),
    "one is missing, other padding": (["2.jpg", "3.jpg", "11.jpg"], ["02.png", "011.png"], ["02.png", None, "011.png"]),
    "no numbers": (["a.jpg", "b.jpg"], ["c.png", "d.png"], [None, None]),
}


@pytest.mark.parametrize("case", PARTNERS)
def test_depth_belongs_to_color_by_name_or_number(case: str) -> None:
    color, depth, expected = PARTNERS[case]
    found = partners(paths(*color), paths(*depth))
    assert [each and each.name for each in found] == expected


def test_lists_that_are_paired_in_order_must_fit() -> None:
    same = {"color": paths("1.png", "2.png"), "depth": paths("d01.png", "d02.png")}
    assert check_numbers("cameras.yaml", same) == []
    times = {"color": paths("1000.1.png", "1000.5.png"), "depth": paths("1000.2.png", "1000.6.png")}
    assert "paired in order" in check_numbers("cameras.yaml", times)[0]
    shifted = {"color": paths("0.png", "1.png", "2.png"), "depth": paths("1.png", "2.png", "3.png")}
    with pytest.raises(FileFormatError, match=r"cameras\.yaml: 0\.png has no partner"):
        check_numbers("cameras.yaml", shifted)


IMAGES = paths("7.png", "8.png", "10.png")
POSES = [pose(translation=[k, 0, 0]) for k in range(3)]


@pytest.mark.parametrize(
    ("ids", "expected"),
    [([7, 8, 10], [0, 1, 2]), ([8, 10], [None, 0, 1]), ([0, 1, 2], [0, 1, 2]), ([100.5, 100.7, 101.1], [0, 1, 2])],
)
def test_poses_belong_to_images_by_their_ids(ids: Sequence[float], expected: list[int | None]) -> None:
    found = poses_by_id("poses.txt", np.array(ids, float), POSES[: len(ids)], IMAGES)
    assert [None if each is None else int(each[0, 3]) for each in found] == expected


@pytest.mark.parametrize(
    ("ids", "problem"),
    [
        ([7, 8, 9], "the id 9, but no image"),
        ([7, 7, 8], "several poses with the id 7"),
        ([0, 1], "2 poses for 3 images"),
    ],
)
def test_ids_that_do_not_fit_are_refused(ids: Sequence[float], problem: str) -> None:
    with pytest.raises(FileFormatError, match=rf"poses\.txt.*{problem}"):
        poses_by_id("poses.txt", np.array(ids, float), POSES[: len(ids)], IMAGES)


# -- whole folders ----------------------------------------------------------------------------------------------------


def write_images(folder: Path, color: str, depth: str, count: int = 12, depth_suffix: str = "png") -> None:
    """Image i has the brightness 10 i + 5, its depth is 1 + i / 100 metres."""
    for kind in ("color", "depth"):
        name = {"color": color, "depth": depth}[kind]
        (folder / name).parent.mkdir(parents=True)
        for i in range(count):
            value = np.full((12, 16, 3), 10 * i + 5, np.uint8) if kind == "color" else None
            image = np.full((12, 16), 1000 + 10 * i, np.uint16) if value is None else value
            suffix = "png" if kind == "color" else depth_suffix
            assert cv2.imwrite(str(folder / f"{name.format(i)}.{suffix}"), image)


def write_camera(folder: Path) -> None:
    camera = {"width": 16, "height": 12, "intrinsic_matrix": [10.0, 0, 0, 0, 10, 0, 8, 6, 1]}
    (folder / "camera.json").write_text(json.dumps(camera))


def pairs(folder: Path) -> list[tuple[int, int]]:
    frames = [station.frames["camera"] for station in open_recording(folder)]
    return [(frame.color[0, 0, 0] // 10, round((float(frame.depth[0, 0]) - 1) * 100)) for frame in frames]


@pytest.mark.parametrize(("color", "depth"), [("{}", "{:04d}"), ("c{}", "d{}"), ("{}", "{}"), ("{:02d}", "{}")])
@pytest.mark.parametrize("form", ["described", "open3d", "scannet", "calibrated"])
def test_folders_are_paired_in_every_format(tmp_path: Path, form: str, color: str, depth: str) -> None:
    part = "rgb" if form in ("described", "calibrated") else "color"
    write_images(tmp_path, f"{part}/{color}", f"depth/{depth}")
    if form == "described":
        (tmp_path / "cameras.yaml").write_text(
            f"color: rgb/*.png\ndepth: depth/*.png\nintrinsics: {json.dumps(LENS)}\n"
        )
    elif form == "open3d":
        write_camera(tmp_path)
    elif form == "scannet":
        (tmp_path / "intrinsic").mkdir()
        for kind in ("color", "depth"):
            np.savetxt(tmp_path / "intrinsic" / f"intrinsic_{kind}.txt", np.diag([10.0, 10, 1, 1]))
    else:
        text = "image_width: 16\nimage_height: 12\ncamera_matrix: [10, 0, 8, 0, 10, 6, 0, 0, 1]\n"
        (tmp_path / "camera_x.yaml").write_text(text)
    assert pairs(tmp_path) == [(i, i) for i in range(12)]


def test_calibrations_as_ros_and_opencv_write_them(tmp_path: Path) -> None:
    """Their distortion is undone."""
    write_images(tmp_path, "rgb/{}", "depth/{}", count=2)
    forms = (
        "image_width: 16\nimage_height: 12\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [10, 0, 8, 0, 11, 6, 0, 0, 1]"
        "\ndistortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.1, 0, 0, 0, 0]\n",
        "image_width: 16\nimage_height: 12\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        "   data: [ 10., 0., 8., 0.,\n       11., 6., 0., 0., 1. ]\ndistortion_model: {model}\n"
        "distortion_coefficients: [0.1, 0, 0, 0, 0]\n",
    )
    for text in forms:
        (tmp_path / "camera_x.yaml").write_text(text.format(model="plumb_bob"))
        frame = open_recording(tmp_path)[0].frames["camera"]
        assert (frame.intrinsics.fx, frame.intrinsics.fy, frame.intrinsics.cx) == (10, 11, 8)
        assert frame.depth[0, 0] == 0  # outside of the distorted image
        (tmp_path / "camera_x.yaml").write_text(text.format(model="double_sphere"))
        with pytest.raises(FileFormatError, match="double_sphere"):
            open_recording(tmp_path)


def test_poses_of_a_described_folder_belong_to_their_images(tmp_path: Path) -> None:
    write_images(tmp_path, "rgb/{}", "depth/{}")
    content = f"color: rgb/*.png\ndepth: depth/*.png\nposes: p.txt\nintrinsics: {json.dumps(LENS)}\n"
    (tmp_path / "cameras.yaml").write_text(content)
    (tmp_path / "p.txt").write_text("".join(f"{i} {i} 0 0 0 0 0 1\n" for i in (10, 2, 11, 5)))
    places = [station.world_from_station for station in open_recording(tmp_path)]
    assert {i: place[0, 3] for i, place in enumerate(places) if place is not None} == {2: 2, 5: 5, 10: 10, 11: 11}


def test_poses_of_open3d_belong_to_the_images_of_their_headers(tmp_path: Path) -> None:
    write_images(tmp_path, "color/{}", "depth/{}", count=4)
    write_camera(tmp_path)
    matrix = "1 0 0 {0}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    for ids, expected in (((0, 3), [0, None, None, 3]), ((2, 1), [None, 1, 2, None]), ((0, 0), [0, 0, None, None])):
        log = "".join(f"{i} {i} {i + 1}\n{matrix.format(i)}" for i in ids)
        (tmp_path / "trajectory.log").write_text(log)
        places = [station.world_from_station for station in open_recording(tmp_path)]
        assert [None if place is None else place[0, 3] for place in places] == expected


# -- orientation ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("orientation", [1, 2, 3, 5, 6, 8])
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_images_are_read_as_they_are_stored(tmp_path: Path, suffix: str, orientation: int) -> None:
    image = np.full((12, 16, 3), 40, np.uint8)
    image[:6] = 220
    picture = Image.fromarray(image)
    exif = picture.getexif()
    exif[0x0112] = orientation
    file = tmp_path / f"c.{suffix}"
    picture.save(file, exif=exif)
    for read in (read_any_color, read_color) if suffix != "tif" else (read_any_color,):
        np.testing.assert_allclose(read(file), image, atol=12)


@pytest.mark.parametrize("order", ["<", ">"])
def test_depth_in_tiff_is_read_as_it_is_stored(tmp_path: Path, order: str) -> None:
    depth = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16)
    for orientation in (1, 3, 6):
        picture = Image.fromarray(depth.astype(f"{order}u2"))
        exif = picture.getexif()
        exif[0x0112] = orientation
        picture.save(tmp_path / "d.tif", exif=exif)
        np.testing.assert_array_equal(read_any_depth(tmp_path / "d.tif"), depth)


@pytest.mark.parametrize("header", [b"P5 99999 99999 65535\n", b"P6\n# a\n70000 1000 255\n", b"P5\n", b"P5 x y 255\n"])
def test_pictures_too_large_or_without_a_size_are_refused(tmp_path: Path, header: bytes) -> None:
    (tmp_path / "d.pgm").write_bytes(header + bytes(100))
    with pytest.raises(FileFormatError, match=r"d\.pgm: (an image of|truncated PNM)"):
        read_any_depth(tmp_path / "d.pgm")


def test_a_huge_tiff_is_refused(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(buffer := io.BytesIO(), "tiff")
    content = bytearray(buffer.getvalue())
    at = int.from_bytes(content[4:8], "little") + 2
    for tag in range(2):  # width and height come first
        content[at + 12 * tag + 2 : at + 12 * tag + 12] = b"\4\0\1\0\0\0" + (10**5).to_bytes(4, "little")
    (tmp_path / "d.tif").write_bytes(content)
    with pytest.raises(FileFormatError, match="too large"):
        read_any_depth(tmp_path / "d.tif")


# -- folders without readable content ------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("damage", ["pgm", "missing", "8 bits", "truncated", "other size"])
def test_an_import_of_which_nothing_can_be_read_says_why_and_writes_nothing(
    tmp_path: Path, damage: str, count: int
) -> None:
    folder, out = tmp_path / "scan", tmp_path / "out"
    write_images(folder, "color/{}", "depth/{}", count, "pgm" if damage == "pgm" else "png")
    write_camera(folder)
    for file in (folder / "depth").glob("*.png"):
        if damage == "missing":
            file.rename(file.with_name(f"no-{file.name}x"))
        elif damage == "8 bits":
            cv2.imwrite(str(file), np.zeros((12, 16), np.uint8))
        elif damage == "truncated":
            file.write_bytes(file.read_bytes()[:-20])
        elif damage == "other size":
            cv2.imwrite(str(file), np.zeros((6, 8), np.uint16))
    said = []
    for _ in range(2):
        result = CliRunner().invoke(app, ["import", str(folder), "--out", str(out)])
        assert isinstance(result.exception, FileFormatError)
        said.append(str(result.exception))
        assert not list(out.rglob("*.json"))
    assert said[0] == said[1]
    assert "0.p" in said[0]
    assert "mappingproxy" not in said[0]
