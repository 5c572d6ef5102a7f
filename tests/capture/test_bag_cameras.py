"""Lenses, poses and depth of bags: distortion models, rectified images, frames of poses, depth of 8 bits, zstd."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from bag_writer import FRAME, ROS1, START, Writer, png

from greenhouse_gym.capture import Intrinsics, Recording, RgbdFrame, open_recording
from greenhouse_gym.capture.formats.bag_poses import ODOMETRY, POSE, PoseTopic, rig_poses
from greenhouse_gym.capture.formats.bag_topics import is_rectified
from greenhouse_gym.capture.formats.ros_messages import lens_of
from greenhouse_gym.capture.formats.single_camera import RIG_FROM_CAMERA, Pair, distorted_lens
from greenhouse_gym.errors import FileFormatError, GreenhouseError
from greenhouse_gym.geometry import pose

W, H, F = 320, 240, 150.0
LENS = Intrinsics(W, H, F, F, 160.0, 120.0)
RAY = np.array([0.7, 0.4, 1.0])

# -- distortion -------------------------------------------------------------------------------------------------------

MODELS: dict[str, tuple[float, ...]] = {
    "plumb_bob": (-0.2, 0.05, 0.001, -0.002, 0.01),
    "rational_polynomial": (0.4, 0.1, 0.001, -0.001, 0.02, 0.7, 0.2, 0.03),
    "thin_prism": (-0.1, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.001, 0.0, 0.001, 0.0),
    "equidistant": (0.05, -0.01, 0.002, -0.0005),
    "fisheye": (0.0, 0.0, 0.0, 0.0),
}


@pytest.mark.parametrize("model", MODELS)
def test_a_bright_spot_is_where_a_pinhole_shows_its_ray(model: str) -> None:
    coefficients = np.array(MODELS[model])
    project = cv2.fisheye.projectPoints if model in ("equidistant", "fisheye") else None
    if project:
        seen = project(RAY.reshape(1, 1, 3), np.zeros(3), np.zeros(3), LENS.matrix, coefficients)[0].ravel()
    else:
        seen = cv2.projectPoints(RAY.reshape(1, 3), np.zeros(3), np.zeros(3), LENS.matrix, coefficients)[0].ravel()
    color = np.full((H, W, 3), 20, np.uint8)
    u, v = np.rint(seen).astype(int)
    color[v - 1 : v + 2, u - 1 : u + 2] = 255
    frame = Pair(distorted_lens("x", LENS, coefficients, model)).frame(color, np.full((H, W), 900, np.uint16), "x")
    rows, columns = np.nonzero(frame.color[..., 0] > 100)
    expected = LENS.matrix @ RAY
    np.testing.assert_allclose([columns.mean(), rows.mean()], expected[:2], atol=2)


@pytest.mark.parametrize(
    ("model", "coefficients", "problem"),
    [
        ("double_sphere", [0.1, 0.2], "'double_sphere' is not undone"),
        ("Inverse Brown Conrady", [0.1, 0, 0, 0, 0], "'Inverse Brown Conrady' is not undone"),
        ("plumb_bob", [0.1, 0.2, 0.3], "expected 4 or 5 or 8"),
        ("equidistant", [0.1] * 5, "expected 0 or 4"),
        ("plumb_bob", [0.1, 0, float("nan"), 0, 0], "finite"),
        ("equidistant", [float("inf")] * 4, "finite"),
    ],
)
def test_unknown_models_are_refused_by_name(model: str, coefficients: list[float], problem: str) -> None:
    with pytest.raises(FileFormatError, match=rf"walk.bag.*{problem}"):
        distorted_lens("walk.bag", LENS, coefficients, model)


def test_models_without_distortion_are_pinholes() -> None:
    for model in ("", "double_sphere", "plumb_bob", "none"):
        assert not distorted_lens("x", LENS, [0.0] * 5, model).distorted
    assert not distorted_lens("x", LENS, [], "equidistant").distorted


def info(**changed: Any) -> SimpleNamespace:
    matrix = np.array([[200.0, 0, 160], [0, 210.0, 120], [0, 0, 1]])
    projection = np.array([[180.0, 0, 150, -18.0], [0, 180.0, 110, 0], [0, 0, 1, 0]])
    usual = {"width": W, "height": H, "k": matrix.ravel(), "p": projection.ravel(), "d": [0.1, 0, 0, 0, 0],
             "distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0}  # fmt: skip
    return SimpleNamespace(**(usual | changed))


def test_rectified_images_have_the_rectified_projection_without_distortion() -> None:
    raw, rectified = (lens_of("x", "/info", info(), rectified) for rectified in (False, True))
    assert raw.lens.distorted
    assert (raw.lens.intrinsics.fx, raw.center[0]) == (200.0, 0.0)
    assert not rectified.lens.distorted
    assert rectified.lens.intrinsics == Intrinsics(W, H, 180.0, 180.0, 150.0, 110.0)
    np.testing.assert_allclose(rectified.center, [0.1, 0, 0])  # the right one of a stereo camera


def test_a_rectified_projection_that_is_not_filled_in_falls_back() -> None:
    found = lens_of("x", "/info", info(p=np.zeros(12), d=[]), rectified=True)
    assert found.lens.intrinsics.fx == 200.0


def test_binning_and_region_of_interest_move_the_pinhole() -> None:
    region = SimpleNamespace(x_offset=40, y_offset=20, width=200, height=160)
    found = lens_of("x", "/info", info(binning_x=2, binning_y=2, roi=region)).lens.intrinsics
    assert found == Intrinsics(100, 80, 100.0, 105.0, 60.0, 50.0)


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ("/camera/rgb/image_rect_color", True),
        ("/camera/depth/image_rect_raw", True),
        ("/color/image_rect/compressed", True),
        ("/camera/color/image_raw", False),
        ("/direct/color/image", False),
        ("/corrected/color/image", False),
    ],
)
def test_rectified_topics_are_known_by_their_names(topic: str, expected: bool) -> None:
    assert is_rectified(topic) == expected


# -- depth that is none -----------------------------------------------------------------------------------------------


def walk(path: Path, *depth: tuple[str, str, bytes] | np.ndarray, encoding: str = "16UC1") -> Recording:
    with Writer(path, ROS1, Intrinsics(16, 12, 10.0, 10.0, 8.0, 6.0)) as bag:
        for i in range(2):
            stamp = START + i * FRAME
            for kind in ("color", "depth"):
                bag.info(f"/{kind}/camera_info", stamp)
            bag.image("/color/image_raw", np.full((12, 16, 3), 90, np.uint8), "rgb8", stamp)
            for each in depth:
                if isinstance(each, np.ndarray):
                    bag.image("/depth/image_raw", each, encoding, stamp)
                else:
                    topic, format, content = each
                    bag.compressed(f"/depth/image_raw/{topic}", content, format, stamp)
    return open_recording(path)


UNITS = np.linspace(400, 1500, 16 * 12).reshape(12, 16).astype(np.uint16)
SMALL = (UNITS >> 8).astype(np.uint8)
JPEG = ("compressed", "16UC1; jpeg compressed ", cv2.imencode(".jpg", SMALL)[1].tobytes())


@pytest.mark.parametrize(
    ("depth", "encoding"),
    [(JPEG, ""), (("compressed", "mono8; png compressed ", png(SMALL)), ""),
     (("compressed", "bgr8; jpeg", cv2.imencode(".jpg", np.dstack([SMALL] * 3))[1].tobytes()), ""),
     (SMALL, "mono8"), (np.dstack([SMALL] * 3), "rgb8")],
)  # fmt: skip
def test_depth_of_8_bits_is_refused(tmp_path: Path, depth: Any, encoding: str) -> None:
    recording = walk(tmp_path / "walk.bag", depth, encoding=encoding)
    with pytest.raises(FileFormatError, match=r"/depth/image_raw.*8 bits"):
        recording[0]


def test_depth_compressed_without_loss_is_preferred(tmp_path: Path) -> None:
    exact = ("compressedDepth", "16UC1; compressedDepth png", bytes(12) + png(UNITS))
    np.testing.assert_allclose(walk(tmp_path / "a.bag", JPEG, exact)[0].frames["camera"].depth, UNITS / 1000)
    plain = ("compressed", "16UC1; png compressed ", png(UNITS))
    np.testing.assert_allclose(walk(tmp_path / "b.bag", plain)[0].frames["camera"].depth, UNITS / 1000)


# -- poses ------------------------------------------------------------------------------------------------------------

TIMES = np.arange(3.0)


def topic(name: str, parent: str, child: str = "", kind: str = POSE, n: int = 3, step: float = 0.1) -> PoseTopic:
    places = np.array([pose(translation=[step * i, 0, 0]) for i in range(n)])
    return PoseTopic(name, kind, parent, child, TIMES[:n], places)


ODOM = topic("/odom", "odom", "base_link", ODOMETRY)
MARKER = topic("/aruco/pose", "camera_color_optical_frame", step=5.0)
STATIC = {"camera_link": ("base_link", np.eye(4)), "optical": ("camera_link", np.eye(4)), "odom": ("map", np.eye(4))}

CHOICES: dict[str, tuple[list[PoseTopic], str]] = {
    "a marker before the camera": ([MARKER, ODOM], "/odom"),
    "a marker in the camera's link": ([topic("/a", "camera_link"), ODOM], "/odom"),
    "a marker in a driver's frame": ([topic("/a", "cam0_depth_frame"), topic("/b", "map")], "/b"),
    "a marker in the frame of the base": ([topic("/a", "base_link"), topic("/b", "map")], "/b"),
    "a goal": ([topic("/a/goal_pose", "map", n=1), topic("/b", "map")], "/b"),
    "odometry after other poses": ([topic("/a", "map"), ODOM], "/odom"),
    "odometry of something else": ([topic("/a", "odom", "person", ODOMETRY), ODOM], "/odom"),
    "a tracking camera": ([topic("/a", "camera_odom_frame")], "/a"),
    "poses in a static map": ([topic("/a", "map")], "/a"),
}


@pytest.mark.parametrize("case", CHOICES)
def test_the_poses_of_the_rig_are_chosen(case: str) -> None:
    topics, expected = CHOICES[case]
    found = rig_poses(topics, "optical", STATIC, TIMES)
    assert found is not None
    np.testing.assert_array_equal(found.poses, next(each.poses for each in topics if each.topic == expected))
    assert f"those on {expected}" in found.notes[0]


def test_a_marker_alone_gives_no_poses_and_a_note() -> None:
    found = rig_poses([MARKER], "optical", {}, TIMES)
    assert found is not None
    assert len(found.times) == 0
    assert "/aruco/pose are not of the rig" in found.notes[0]


def test_odometry_alone_needs_no_note_and_no_topic_gives_none() -> None:
    found = rig_poses([ODOM], "optical", STATIC, TIMES)
    assert found is not None
    assert found.notes == ()
    assert rig_poses([], "optical", STATIC, TIMES) is None


def test_odometry_of_the_camera_itself_is_turned_to_the_rig() -> None:
    found = rig_poses([topic("/vio", "odom", "optical", ODOMETRY)], "optical", STATIC, TIMES)
    assert found is not None
    assert found.of_camera
    np.testing.assert_allclose(found.poses[1], pose(translation=[0.1, 0, 0]) @ RIG_FROM_CAMERA.T)


def test_the_poses_of_a_bag_with_a_marker_are_those_of_its_odometry(tmp_path: Path) -> None:
    frames = [RgbdFrame(np.zeros((12, 16, 3), np.uint8), np.ones((12, 16), np.float32), Intrinsics(16, 12, 9, 9, 8, 6))]
    with Writer(tmp_path / "walk.bag", ROS1, frames[0].intrinsics) as bag:
        bag.camera("/camera", frames * 2)
        for i in range(2):
            bag.pose("/aruco/pose", pose(translation=[0, 0, 0.9]), START + i * FRAME, "camera")
            bag.pose("/slam/pose", pose(translation=[0.1 * i, 0, 0]), START + i * FRAME, "map")
    recording = open_recording(tmp_path / "walk.bag")
    places = [station.world_from_station for station in recording]
    np.testing.assert_allclose(places, [pose(translation=[0.1 * i, 0, 0]) for i in range(2)])
    assert any("/slam/pose" in note for note in recording.notes)


# -- compressed files -------------------------------------------------------------------------------------------------


@pytest.fixture(params=["mcap", "sqlite"])
def compressed_bag(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    frame = RgbdFrame(np.zeros((12, 16, 3), np.uint8), np.ones((12, 16), np.float32), Intrinsics(16, 12, 9, 9, 8, 6))
    with_writer = Writer(tmp_path / "walk", request.param, frame.intrinsics)
    with_writer.writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with with_writer as bag:
        bag.camera("/camera", [frame] * 2)
    return tmp_path / "walk"


def test_a_bag_compressed_as_a_file_is_read(compressed_bag: Path) -> None:
    (file,) = compressed_bag.glob("*.zstd")
    for path in (compressed_bag, file):
        recording = open_recording(path)
        assert len(recording) == 2
        assert recording[1].frames["camera"].depth.max() == 1


def test_a_damaged_compressed_bag_is_refused(compressed_bag: Path) -> None:
    (file,) = compressed_bag.glob("*.zstd")
    whole = file.read_bytes()
    for content in (whole[: len(whole) // 2], b"no zstd", b"", whole[:100] + b"\0" * 50 + whole[150:]):
        file.write_bytes(content)
        with pytest.raises(GreenhouseError, match="walk"):
            open_recording(compressed_bag)
    (compressed_bag / "metadata.yaml").unlink()
    with pytest.raises(FileFormatError, match=r"metadata\.yaml"):
        open_recording(file)
