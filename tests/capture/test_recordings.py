from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from greenhouse_gym.capture import (
    Camera,
    Intrinsics,
    Recording,
    RgbdFrame,
    Rig,
    Station,
    open_recording,
    write_recording,
)
from greenhouse_gym.capture.formats.own import INDEX
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.geometry import pose, rotation_about

WIDTH, HEIGHT, STATIONS = 48, 32, 3


def tiny_recording(scale: float = 0.001, stations: int = STATIONS, known: bool = True) -> Recording:
    """Two cameras that see noise."""
    intrinsics = Intrinsics(WIDTH, HEIGHT, 40.0, 41.0, 23.5, 15.5)
    cameras = {
        "left": Camera(intrinsics, pose(rotation_about([1, 2, 3], 0.3), [0.1, 0.2, 0.3]), scale),
        "right": Camera(intrinsics, pose(translation=[0, 0.25, 0]), scale),
    }

    def load(i: int) -> Station:
        random = np.random.default_rng(i)
        frames = {}
        for name in cameras:
            depth = random.uniform(0.2, 3.0, (HEIGHT, WIDTH)).astype(np.float32)
            depth[random.random(depth.shape) < 0.1] = 0.0
            frames[name] = RgbdFrame(random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8), depth, intrinsics)
        return Station(frames, pose(rotation_about([0, 0, 1], 0.01 * i), [0, 0.1 * i, 0]) if known else None)

    return Recording("tiny", Rig(cameras, "right"), stations, load)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_recording(tiny_recording(), tmp_path / "recording")


def change_index(folder: Path, change: Callable[[Any], object]) -> None:
    data = json.loads((folder / INDEX).read_text())
    change(data)
    (folder / INDEX).write_text(json.dumps(data))


# -- round trip -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.001, 0.0001, 0.00025])
def test_round_trip(tmp_path: Path, scale: float) -> None:
    original = tiny_recording(scale)
    opened = open_recording(write_recording(original, tmp_path / "r"))
    assert (len(opened), opened.name, opened.rig.reference) == (STATIONS, "tiny", "right")
    assert list(opened.rig.cameras) == ["left", "right"]
    assert opened.folder == tmp_path / "r"
    for name, camera in original.rig.cameras.items():
        assert opened.rig.cameras[name].intrinsics == camera.intrinsics
        assert opened.rig.cameras[name].depth_scale == scale
        np.testing.assert_array_equal(opened.rig.cameras[name].rig_from_camera, camera.rig_from_camera)
    for a, b in zip(opened, original, strict=True):
        np.testing.assert_array_equal(a.world_from_station, b.world_from_station)
        assert list(a.frames) == list(b.frames)
        for name, frame in b.frames.items():
            np.testing.assert_array_equal(a.frames[name].color, frame.color)
            assert a.frames[name].depth.dtype == np.float32
            np.testing.assert_allclose(a.frames[name].depth, frame.depth, atol=0.5001 * scale)
            np.testing.assert_array_equal(a.frames[name].depth == 0, frame.depth == 0)


def test_a_second_round_trip_changes_nothing(folder: Path, tmp_path: Path) -> None:
    again = write_recording(open_recording(folder), tmp_path / "again")
    for path in sorted(folder.rglob("*.*")):
        assert (again / path.relative_to(folder)).read_bytes() == path.read_bytes()


def test_poses_may_be_unknown(tmp_path: Path) -> None:
    opened = open_recording(write_recording(tiny_recording(known=False), tmp_path / "r"))
    assert [station.world_from_station for station in opened] == [None] * STATIONS


def test_depth_beyond_the_files_range_is_clipped(tmp_path: Path) -> None:
    intrinsics = Intrinsics(2, 1, 1.0, 1.0, 0.0, 0.0)
    frame = RgbdFrame(np.zeros((1, 2, 3), np.uint8), np.array([[70.0, 65.0]], np.float32), intrinsics)
    rig = Rig({"c": Camera(intrinsics, np.eye(4))}, "c")
    written = write_recording(Recording("far", rig, 1, lambda i: Station({"c": frame})), tmp_path / "far")
    np.testing.assert_allclose(open_recording(written)[0].frames["c"].depth, [[65.535, 65.0]])


def test_a_recording_is_read_station_by_station(folder: Path) -> None:
    (folder / "depth" / "left" / "000001.png").unlink()
    opened = open_recording(folder)  # looks at no image
    assert len(opened) == STATIONS
    opened[0], opened[2], opened[-1]
    with pytest.raises(FileFormatError, match=r"depth/left/000001\.png"):
        opened[1]


def test_nothing_is_rendered_or_kept_before_it_is_asked_for() -> None:
    asked: list[int] = []
    tiny = tiny_recording()

    def load(i: int) -> Station:
        asked.append(i)
        return tiny[i]

    recording = Recording("counted", tiny.rig, STATIONS, load)
    assert asked == []
    assert recording[1] is not recording[1]
    assert recording[-1].world_from_station is not None
    assert asked == [1, 1, 2]
    stations = iter(recording)
    assert asked == [1, 1, 2]
    next(stations)
    assert asked == [1, 1, 2, 0]


@pytest.mark.parametrize("index", [STATIONS, -STATIONS - 1])
def test_there_are_no_stations_beyond_the_ends(folder: Path, index: int) -> None:
    with pytest.raises(IndexError, match="has 3 stations"):
        open_recording(folder)[index]


# -- writing ----------------------------------------------------------------------------------------------------------


class InterruptionError(Exception):
    pass


@pytest.mark.parametrize("at", range(STATIONS))
def test_an_interrupted_write_leaves_no_recording_and_can_be_repeated(tmp_path: Path, at: int) -> None:
    def interrupt(i: int) -> None:
        if i == at:
            raise InterruptionError

    with pytest.raises(InterruptionError):
        write_recording(tiny_recording(), tmp_path / "r", interrupt)
    assert not (tmp_path / "r" / INDEX).exists()
    with pytest.raises(FileFormatError):
        open_recording(tmp_path / "r")
    assert len(open_recording(write_recording(tiny_recording(), tmp_path / "r"))) == STATIONS
    assert not [path for path in (tmp_path / "r").rglob("*") if path.name.startswith(".")]


def test_writing_onto_a_recording_is_refused_and_keeps_the_old(folder: Path) -> None:
    before = {path: path.read_bytes() for path in folder.rglob("*.*")}
    with pytest.raises(FileFormatError, match=r"recording\.json: already holds a recording"):
        write_recording(tiny_recording(stations=1), folder)
    assert {path: path.read_bytes() for path in folder.rglob("*.*")} == before


def test_progress_is_reported(tmp_path: Path) -> None:
    reported: list[int] = []
    write_recording(tiny_recording(), tmp_path / "r", reported.append)
    assert reported == [0, 1, 2]


# -- damaged images ---------------------------------------------------------------------------------------------------

COLOR, DEPTH = Path("color/left/000000.png"), Path("depth/left/000000.png")


def png(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", image)[1].tobytes())


def truncated(data: bytes) -> bytes:
    return data[: len(data) // 2]


def garbled(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes(255 - b for b in data[middle : middle + 40]) + data[middle + 40 :]


IMAGES: list[tuple[str, Path, Callable[[bytes], bytes]]] = [
    ("empty color", COLOR, lambda data: b""),
    ("empty depth", DEPTH, lambda data: b""),
    ("truncated color", COLOR, truncated),
    ("truncated depth", DEPTH, truncated),
    ("color without its last byte", COLOR, lambda data: data[:-1]),
    ("garbled color", COLOR, garbled),
    ("garbled depth", DEPTH, garbled),
    ("text", COLOR, lambda data: b"not an image"),
    ("only an end", DEPTH, lambda data: data[-12:]),
    ("8-bit depth", DEPTH, lambda data: png(np.full((HEIGHT, WIDTH), 100, np.uint8))),
    ("3-channel depth", DEPTH, lambda data: png(np.full((HEIGHT, WIDTH, 3), 100, np.uint16))),
    ("smaller depth", DEPTH, lambda data: png(np.full((HEIGHT // 2, WIDTH // 2), 100, np.uint16))),
    ("turned depth", DEPTH, lambda data: png(np.full((WIDTH, HEIGHT), 100, np.uint16))),
]


@pytest.mark.parametrize(("file", "damage"), [i[1:] for i in IMAGES], ids=[i[0] for i in IMAGES])
def test_a_damaged_image_is_named(folder: Path, file: Path, damage: Callable[[bytes], bytes]) -> None:
    (folder / file).write_bytes(damage((folder / file).read_bytes()))
    opened = open_recording(folder)
    with pytest.raises(FileFormatError) as caught:
        opened[0]
    assert str(folder / file) in str(caught.value)
    opened[1]  # the others are not affected


@pytest.mark.parametrize("file", [COLOR, DEPTH])
def test_a_missing_image_is_named(folder: Path, file: Path) -> None:
    (folder / file).unlink()
    with pytest.raises(FileFormatError, match=rf"{file}: cannot be read"):
        open_recording(folder)[0]


def test_depth_of_another_size_than_color_names_both(folder: Path) -> None:
    (folder / DEPTH).write_bytes(png(np.full((10, 20), 100, np.uint16)))
    with pytest.raises(FileFormatError, match=rf"{DEPTH}: depth image is 20x10.*{COLOR} is {WIDTH}x{HEIGHT}"):
        open_recording(folder)[0]


def test_images_of_another_size_than_the_intrinsics(folder: Path) -> None:
    for file, channels in ((COLOR, (3,)), (DEPTH, ())):
        kind = np.uint8 if channels else np.uint16
        (folder / file).write_bytes(png(np.zeros((HEIGHT, WIDTH - 2, *channels), kind)))
    with pytest.raises(FileFormatError, match=rf"{DEPTH}: depth image is 46x32, the intrinsics say 48x32"):
        open_recording(folder)[0]


def test_gray_color_images_are_read_as_color(folder: Path) -> None:
    (folder / COLOR).write_bytes(png(np.full((HEIGHT, WIDTH), 77, np.uint8)))
    assert (open_recording(folder)[0].frames["left"].color == 77).all()


def test_depth_without_a_reading_is_no_damage(folder: Path) -> None:
    (folder / DEPTH).write_bytes(png(np.zeros((HEIGHT, WIDTH), np.uint16)))
    frame = open_recording(folder)[0].frames["left"]
    assert not frame.depth.any()
    assert frame.points().shape == (0, 3)


# -- damaged index ----------------------------------------------------------------------------------------------------


def camera(key: str, value: object) -> Callable[[Any], object]:
    return lambda data: data["cameras"]["left"].update({key: value})


def turned(matrix: np.ndarray) -> list[list[float]]:
    return pose(matrix, [0.0, 0.0, 1.0]).tolist()


nan = float("nan")
NO_POSE = {
    "a mirrored pose": turned(np.diag([1.0, 1.0, -1.0])),
    "a stretched pose": turned(1.1 * np.eye(3)),
    "NaN in a rotation": turned(np.full((3, 3), nan)),
    "NaN in a translation": pose(translation=[nan, 0, 0]).tolist(),
    "3x4 numbers": np.eye(4)[:3].tolist(),
    "a ragged matrix": [[1.0, 0.0], [0.0], [], []],
    "a wrong last row": np.diag([1.0, 1.0, 1.0, 2.0]).tolist(),
    "no numbers": [],
}
INDEXES: list[tuple[str, Callable[[Any], object], str]] = [
    *((f"{key} {value}", camera(key, value), key) for key in ("fx", "fy") for value in (nan, -40.0, 0.0)),
    ("infinite fx", camera("fx", float("inf")), "fx"),
    ("NaN cx", camera("cx", nan), "cx"),
    ("NaN cy", camera("cy", nan), "cy"),
    ("no width", camera("width", 0), "width"),
    ("negative height", camera("height", -32), "height"),
    ("half a pixel", camera("width", 47.5), "width"),
    ("text for fx", camera("fx", "wide"), r"cameras\.left\.fx"),
    ("depth scale 0", camera("depth_scale", 0.0), "depth_scale"),
    ("depth scale NaN", camera("depth_scale", nan), "depth_scale"),
    ("camera key", camera("model", "D435"), r"cameras\.left\.model"),
    *((f"rig: {name}", camera("rig_from_camera", value), "") for name, value in NO_POSE.items()),
    *(
        (f"station: {name}", lambda data, v=value: data["stations"][1].update(world_from_station=v), "station 1")
        for name, value in NO_POSE.items()
    ),
    ("unknown version", lambda data: data.update(schema_version=2), "schema_version"),
    ("unknown key", lambda data: data.update(operator="me"), "operator"),
    ("unknown key of a station", lambda data: data["stations"][0].update(time=1), r"stations\.0\.time"),
    ("unknown reference", lambda data: data.update(reference="middle"), "'middle' is not among left, right"),
    ("no cameras", lambda data: data.update(cameras={}), "reference"),
    ("no stations key", lambda data: data.pop("stations"), "stations"),
    ("cameras as a list", lambda data: data.update(cameras=[]), "cameras"),
]


@pytest.mark.parametrize(("change", "problem"), [i[1:] for i in INDEXES], ids=[i[0] for i in INDEXES])
def test_a_damaged_index_is_refused_when_it_is_opened(
    folder: Path, change: Callable[[Any], object], problem: str
) -> None:
    change_index(folder, change)
    with pytest.raises(FileFormatError, match=rf"recording\.json: .*{problem}"):
        open_recording(folder)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe", b'{"name": "x"}'])
def test_an_index_that_is_no_index(folder: Path, content: bytes) -> None:
    (folder / INDEX).write_bytes(content)
    with pytest.raises(FileFormatError, match=r"recording\.json"):
        open_recording(folder)


def test_a_station_without_images_for_a_camera(folder: Path) -> None:
    change_index(folder, lambda data: data["stations"][1]["color"].pop("right"))
    opened = open_recording(folder)
    opened[0]
    with pytest.raises(FileFormatError, match=r"recording\.json: station 1 names no images for camera 'right'"):
        opened[1]


def test_what_is_no_recording_at_all(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="not a recording"):
        open_recording(tmp_path)
    with pytest.raises(FileFormatError, match="missing: no such folder or file"):
        open_recording(tmp_path / "missing")
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(FileFormatError, match="not a recording"):
        open_recording(file)


# -- folders of other tools -------------------------------------------------------------------------------------------


@pytest.fixture
def calibrated(tmp_path: Path) -> Path:
    """A calibrated camera's folder with two images."""
    folder = tmp_path / "calibrated"
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for k in (0, 3):
        (folder / "rgb" / f"{k:04d}.png").write_bytes(png(np.full((HEIGHT, WIDTH, 3), 10 * k, np.uint8)))
        (folder / "depth" / f"{k:04d}.png").write_bytes(png(np.full((HEIGHT, WIDTH), 500 + k, np.uint16)))
    (folder / "camera_x.yaml").write_text(
        f"image_width: {WIDTH}\nimage_height: {HEIGHT}\ncamera_matrix: [40.0, 0, 24.0, 0, 41.0, 16.0, 0, 0, 1]\n"
    )
    (folder / "groundtruth_handeye.txt").write_text(
        "0 0 0 1 0 0 0 1\n3 0.1 0.2 0.3 0 0 0.7071067811865476 0.7071067811865476\n"
    )
    return folder


@pytest.fixture
def open3d_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "open3d"
    for kind in ("color", "depth"):
        (folder / kind).mkdir(parents=True)
    for k in range(2):
        (folder / "color" / f"{k:05d}.jpg").write_bytes(
            cv2.imencode(".jpg", np.full((HEIGHT, WIDTH, 3), 100, np.uint8))[1].tobytes()
        )
        (folder / "depth" / f"{k:05d}.png").write_bytes(png(np.full((HEIGHT, WIDTH), 800, np.uint16)))
    intrinsic = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": [40.0, 0, 0, 0, 41.0, 0, 24.0, 16.0, 1]}
    (folder / "camera_intrinsic.json").write_text(json.dumps(intrinsic))
    block = "\n".join(" ".join(map(str, row)) for row in pose(translation=[0.0, 0.0, 1.0]))
    (folder / "trajectory.log").write_text(f"0 0 1\n{block}\n1 1 2\n{block}\n")
    return folder


def test_a_calibrated_cameras_folder(calibrated: Path) -> None:
    opened = open_recording(calibrated)
    assert len(opened) == 2
    intrinsics = opened.rig.cameras["camera"].intrinsics
    assert intrinsics == Intrinsics(WIDTH, HEIGHT, 40.0, 41.0, 24.0, 16.0)
    assert opened[1].frames["camera"].depth[0, 0] == np.float32(0.503)
    # the true poses are those of the camera
    for station, turn, shift in ((opened[0], np.eye(3), [0, 0, 1]), (opened[1], None, [0.1, 0.2, 0.3])):
        assert station.world_from_station is not None
        world_from_camera = station.world_from_station @ opened.rig.cameras["camera"].rig_from_camera
        expected = rotation_about([0, 0, 1], np.pi / 2) if turn is None else turn
        np.testing.assert_allclose(world_from_camera, pose(expected, shift), atol=1e-12)


def test_an_open3d_folder(open3d_folder: Path) -> None:
    opened = open_recording(open3d_folder)
    assert len(opened) == 2
    assert opened.rig.cameras["camera"].intrinsics == Intrinsics(WIDTH, HEIGHT, 40.0, 41.0, 24.0, 16.0)
    assert opened[0].frames["camera"].depth[0, 0] == np.float32(0.8)
    assert opened[1].world_from_station is not None
    (open3d_folder / "trajectory.log").unlink()
    assert open_recording(open3d_folder)[1].world_from_station is None


@pytest.mark.parametrize(
    ("names", "numbers", "expected"),
    [
        (range(12), range(12), range(12)),
        (range(95, 105), range(95, 105), range(10)),
        (range(1, 12), range(11), range(11)),
        (range(12), [0, 5, 11], [0, None, None, None, None, 1, None, None, None, None, None, 2]),
        (range(9, 12), [11, 9, 10], [1, 2, 0]),
        (range(9, 12), [7, 7, 7], range(3)),
    ],
)
def test_images_of_open3d_meet_their_poses_by_number(
    open3d_folder: Path, names: Sequence[int], numbers: Sequence[int], expected: Sequence[int | None]
) -> None:
    for kind, suffix in (("color", ".jpg"), ("depth", ".png")):
        first = (open3d_folder / kind / f"00000{suffix}").read_bytes()
        shutil.rmtree(open3d_folder / kind)
        (open3d_folder / kind).mkdir()
        for name in names:
            (open3d_folder / kind / f"{name}{suffix}").write_bytes(first)
    blocks = [
        f"{number} {number} {number + 1}\n1 0 0 {i}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n" for i, number in enumerate(numbers)
    ]
    (open3d_folder / "trajectory.log").write_text("".join(blocks))
    found = [station.world_from_station for station in open_recording(open3d_folder)]
    assert [None if each is None else round(each[0, 3]) for each in found] == list(expected)


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("camera_x.yaml", ""),
        ("camera_x.yaml", "image_width: 48\nimage_height: 32\ncamera_matrix: [40.0, 0]\n"),
        ("camera_x.yaml", "image_width: wide\nimage_height: 32\ncamera_matrix: [40, 0, 24, 0, 41, 16, 0, 0, 1]\n"),
        ("camera_x.yaml", "image_width: 48\nimage_height: 32\ncamera_matrix: [-40, 0, 24, 0, 41, 16, 0, 0, 1]\n"),
        ("camera_x.yaml", "image_width: 48\nimage_height: 32\ncamera_matrix: [NaN, 0, 24, 0, 41, 16, 0, 0, 1]\n"),
        ("camera_x.yaml", b"\xff\xfe\xff"),
        ("groundtruth_handeye.txt", "0 0 0 1\n"),
        ("groundtruth_handeye.txt", "zero 0 0 1 0 0 0 1\n"),
        ("groundtruth_handeye.txt", "0 0 0 1 0 0 0 0\n"),
        ("groundtruth_handeye.txt", "0 0 nan 1 0 0 0 1\n"),
        ("groundtruth_handeye.txt", "nan 0 0 1 0 0 0 1\n"),
        ("groundtruth_handeye.txt", b"\xff\xfe\xff"),
        ("groundtruth_handeye.txt", ""),
    ],
)
def test_a_damaged_calibrated_folder(calibrated: Path, file: str, content: str | bytes) -> None:
    (calibrated / file).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(FileFormatError, match=file.replace(".", r"\.")):
        open_recording(calibrated)


def test_images_without_a_number_have_no_place_in_a_calibrated_folder(calibrated: Path) -> None:
    (calibrated / "rgb" / "cover.png").write_bytes((calibrated / "rgb" / "0000.png").read_bytes())
    with pytest.raises(FileFormatError, match=r"cover\.png"):
        open_recording(calibrated)


def test_a_calibrated_folder_without_calibration_or_images(calibrated: Path) -> None:
    for image in (calibrated / "rgb").iterdir():
        image.unlink()
    with pytest.raises(FileFormatError, match="no pairs of color and depth images"):
        open_recording(calibrated)
    (calibrated / "camera_x.yaml").unlink()
    with pytest.raises(FileFormatError, match="camera_"):
        open_recording(calibrated)


MIRRORED = "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n"


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("camera_intrinsic.json", "{"),
        ("camera_intrinsic.json", "[]"),
        ("camera_intrinsic.json", '{"width": 48, "height": 32, "intrinsic_matrix": [40]}'),
        ("camera_intrinsic.json", '{"width": 48, "height": 32, "intrinsic_matrix": [0, 0, 0, 0, 41, 0, 24, 16, 1]}'),
        ("camera_intrinsic.json", b"\xff\xfe\xff"),
        ("trajectory.log", "0 0 1\n1 0 0 0\n"),
        ("trajectory.log", "0 0 1\n1 0 0 x\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
        ("trajectory.log", MIRRORED),
        ("trajectory.log", MIRRORED.replace("-1", "nan")),
        ("trajectory.log", b"\xff\xfe\xff"),
    ],
)
def test_a_damaged_open3d_folder(open3d_folder: Path, file: str, content: str | bytes) -> None:
    (open3d_folder / file).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(FileFormatError, match=file.replace(".", r"\.")):
        open_recording(open3d_folder)


def test_a_truncated_jpeg_and_a_missing_depth_image(open3d_folder: Path) -> None:
    photo = open3d_folder / "color" / "00000.jpg"
    photo.write_bytes(truncated(photo.read_bytes()))
    (open3d_folder / "depth" / "00001.png").unlink()
    opened = open_recording(open3d_folder)
    with pytest.raises(FileFormatError, match=r"00000\.jpg: truncated"):
        opened[0]
    with pytest.raises(FileFormatError, match=r"00001\.png: cannot be read"):
        opened[1]


# -- frames -----------------------------------------------------------------------------------------------------------


def test_points_are_where_the_pixels_say() -> None:
    intrinsics = Intrinsics(4, 3, 2.0, 4.0, 1.5, 1.0)
    depth = np.zeros((3, 4), np.float32)
    depth[2, 3], depth[0, 0] = 2.0, 1.0
    frame = RgbdFrame(np.zeros((3, 4, 3), np.uint8), depth, intrinsics)
    np.testing.assert_allclose(frame.points(), [[-0.75, -0.25, 1.0], [1.5, 0.5, 2.0]])
    mask = np.zeros((3, 4), bool)
    mask[2] = True
    np.testing.assert_allclose(frame.points(mask), [[1.5, 0.5, 2.0]])


@pytest.mark.parametrize(
    ("color", "depth", "problem"),
    [
        (np.zeros((3, 4, 3), np.uint8), np.zeros((4, 3), np.float32), "depth image is 3x4, the intrinsics say 4x3"),
        (np.zeros((4, 3, 3), np.uint8), np.zeros((3, 4), np.float32), "color image is 3x4"),
        (np.zeros((3, 4), np.uint8), np.zeros((3, 4), np.float32), "color image"),
        (np.zeros((3, 4, 3), np.float32), np.zeros((3, 4), np.float32), "expected uint8 color"),
        (np.zeros((3, 4, 3), np.uint8), np.zeros((3, 4), np.uint16), "float32 depth in metres"),
    ],
)
def test_frames_are_checked(color: np.ndarray, depth: np.ndarray, problem: str) -> None:
    with pytest.raises(InvalidValueError, match=problem):
        RgbdFrame(color, depth, Intrinsics(4, 3, 2.0, 4.0, 1.5, 1.0))
