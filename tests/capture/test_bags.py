"""Bags by reference writers, of rosbags and of RealSense's recorder, read back equal to the frames that went in."""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from bag_writer import FRAME, MCAP, ROS1, SQLITE, START, K, Writer, png
from row_helpers import half_recording
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture import Recording, RgbdFrame, open_recording
from greenhouse_gym.capture.formats import bag_topics
from greenhouse_gym.capture.formats.single_camera import RIG_FROM_CAMERA
from greenhouse_gym.capture.rig_file import Mounting, with_mounting
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import pose

rosbags = pytest.importorskip("rosbags.highlevel")
pytestmark = pytest.mark.xdist_group("row")


def frames() -> list[RgbdFrame]:
    return [half_recording()[i].frames["middle"] for i in range(3)]


def stamps(count: int = 3) -> list[int]:
    return [START + i * FRAME for i in range(count)]


def as_usual(path: Path, container: str, prefix: str = "/camera", late: int = 0) -> None:
    with Writer(path, container) as bag:
        bag.camera(prefix, frames(), late)


def assert_equal(recording: Recording, camera: str = "camera", expected: Sequence[RgbdFrame] = ()) -> None:
    for station, frame in zip(recording, expected or frames(), strict=True):
        np.testing.assert_array_equal(station.frames[camera].color, frame.color)
        np.testing.assert_allclose(station.frames[camera].depth, frame.depth, atol=1e-6)
        assert station.frames[camera].intrinsics.fx == pytest.approx(K.fx)


@pytest.mark.parametrize("container", [ROS1, MCAP, SQLITE])
def test_a_bag_is_read_back(tmp_path: Path, container: str) -> None:
    path = tmp_path / ("walk.bag" if container == ROS1 else "walk")
    as_usual(path, container)
    assert_equal(open_recording(path))
    if container == MCAP:
        (file,) = path.glob("*.mcap")
        assert_equal(open_recording(file))
        (path / "metadata.yaml").unlink()
        with pytest.raises(FileFormatError, match="reindex"):
            open_recording(file)
    if container == SQLITE:  # a database needs no metadata
        (file,) = path.glob("*.db3")
        (path / "metadata.yaml").unlink()
        assert_equal(open_recording(file))


def test_compressed_images_and_fractions_of_metres(tmp_path: Path) -> None:
    with Writer(tmp_path / "walk.bag", ROS1) as bag:
        for frame, stamp in zip(frames(), stamps(), strict=True):
            for kind in ("rgb", "depth"):
                bag.info(f"/{kind}/camera_info", stamp)
            bag.compressed("/rgb/image/compressed", png(frame.color[..., ::-1]), "rgb8; png compressed bgr8", stamp)
            bag.image("/depth/image", frame.depth, "32FC1", stamp)
    assert_equal(open_recording(tmp_path / "walk.bag"))


def test_compressed_depth(tmp_path: Path) -> None:
    with Writer(tmp_path / "walk.bag", ROS1) as bag:
        for frame, stamp in zip(frames(), stamps(), strict=True):
            for kind in ("rgb", "depth"):
                bag.info(f"/{kind}/camera_info", stamp)
            bag.image("/rgb/image", frame.color[..., ::-1], "bgr8", stamp)
            units = np.rint(frame.depth * 1000).astype(np.uint16)
            bag.compressed("/depth/image/compressedDepth", bytes(12) + png(units), "16UC1; compressedDepth png", stamp)
    assert_equal(open_recording(tmp_path / "walk.bag"))


def test_a_realsense_bag_of_ros_1_with_its_own_units(tmp_path: Path) -> None:
    with Writer(tmp_path / "rs.bag", ROS1) as bag:
        bag.realsense("device_0", frames(), 0.0001)
    recording = open_recording(tmp_path / "rs.bag")
    assert recording.rig.cameras["device_0"].depth_scale == pytest.approx(0.0001)
    assert_equal(recording, "device_0")


def test_poses_of_odometry_become_those_of_the_stations(tmp_path: Path) -> None:
    with Writer(tmp_path / "walk.bag", ROS1) as bag:
        bag.camera("/camera", frames())
        for i, stamp in enumerate(stamps()):
            bag.pose("/odom", pose(translation=[0.0, 0.1 * i, 0.0]), stamp + 1000)
    for i, station in enumerate(open_recording(tmp_path / "walk.bag")):
        np.testing.assert_allclose(station.world_from_station, pose(translation=[0.0, 0.1 * i, 0.0]), atol=1e-9)


def test_poses_of_moving_transforms_are_those_of_the_camera(tmp_path: Path) -> None:
    """A rail moves base in odom, a mast stands on base, and the camera hangs on the mast: map, odom, base, mast."""
    turned = pose(Rotation.from_euler("z", 30.0, degrees=True).as_matrix(), [0.0, 0.2, 1.1])
    hangs = pose(RIG_FROM_CAMERA[:3, :3], [0.1, 0.0, 0.0])
    places = [pose(translation=[0.0, 0.1 * i, 0.0]) for i in range(3)]
    with Writer(tmp_path / "walk", MCAP) as bag:
        bag.camera("/camera", frames())
        bag.transform("/tf_static", "base", "mast", turned, START)
        bag.transform("/tf_static", "mast", "camera", hangs, START)
        bag.transform("/tf", "map", "odom", pose(translation=[5.0, 0.0, 0.0]), START)
        for place, stamp in zip(places, stamps(), strict=True):
            bag.transform("/tf", "odom", "base", place, stamp + 1000)
    recording = open_recording(tmp_path / "walk")
    mast = Mounting({"camera": hangs}, "camera")
    for place, alone, on_mast in zip(places, recording, with_mounting(recording, mast), strict=True):
        world_from_mast = pose(translation=[5.0, 0.0, 0.0]) @ place @ turned
        np.testing.assert_allclose(alone.world_from_station, world_from_mast @ hangs @ RIG_FROM_CAMERA.T, atol=1e-9)
        np.testing.assert_allclose(on_mast.world_from_station, world_from_mast, atol=1e-9)


def test_transforms_in_a_ring_or_of_other_frames_are_ignored(tmp_path: Path) -> None:
    with Writer(tmp_path / "walk", SQLITE) as bag:
        bag.camera("/camera", frames())
        bag.transform("/tf", "map", "gripper", np.eye(4), START)
        bag.transform("/tf_static", "camera", "mast", np.eye(4), START)
        bag.transform("/tf_static", "mast", "camera", np.eye(4), START)
    assert all(station.world_from_station is None for station in open_recording(tmp_path / "walk"))


def test_several_cameras_are_matched_by_their_stamps_and_drops_are_reported(tmp_path: Path) -> None:
    with Writer(tmp_path / "walk.bag", ROS1) as bag:
        bag.camera("/left", frames())
        for k, (frame, stamp) in enumerate(zip(frames(), stamps(), strict=True)):
            for kind in ("color", "depth"):
                bag.info(f"/right/{kind}/camera_info", stamp)
            bag.image("/right/color/image_raw", frame.color, "rgb8", stamp + 4_000_000)
            if k != 1:
                bag.image("/right/depth/image_raw", frame.depth, "32FC1", stamp + 4_000_000)
    recording = open_recording(tmp_path / "walk.bag")
    assert set(recording.rig.cameras) == {"left", "right"}
    assert len(recording) == 2
    assert "1 of 3 moments lack an image (1 on /right/depth/image_raw)" in recording.notes[0]


def test_clocks_that_differ_are_reported(tmp_path: Path) -> None:
    as_usual(tmp_path / "walk.bag", ROS1, late=10**12)
    with pytest.raises(FileFormatError, match="clocks differ"):
        open_recording(tmp_path / "walk.bag")


def test_clocks_that_drift_are_detected_by_arrival_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each image of a video has a partner near in time, if only the wrong one."""
    with Writer(tmp_path / "walk.bag", ROS1) as bag:
        for camera, slower in (("left", 0), ("right", 60_000_000)):
            for i, frame in enumerate(frames()):
                got = START + i * FRAME
                stamp = got + i * slower
                for stream in ("color", "depth"):
                    bag.info(f"/{camera}/{stream}/camera_info", got)
                bag.image(f"/{camera}/color/image_raw", frame.color, "rgb8", stamp, got)
                bag.image(f"/{camera}/depth/image_raw", frame.depth, "32FC1", stamp, got)
    monkeypatch.setattr(bag_topics, "_ENDS", 1)
    assert "0.00 s at the beginning and 0.12 s at the end" in open_recording(tmp_path / "walk.bag").notes[0]


def test_a_camera_that_stops_before_the_others_is_reported(tmp_path: Path) -> None:
    with Writer(tmp_path / "walk.bag", ROS1) as bag:
        bag.camera("/left", frames())
        bag.camera("/right", frames()[:1])
    recording = open_recording(tmp_path / "walk.bag")
    assert len(recording) == 1
    assert "/left/color/image_raw has 3 images, /right/color/image_raw only 1" in recording.notes[0]


def test_missing_and_duplicate_topics_are_reported(tmp_path: Path) -> None:
    frame = frames()[0]
    with Writer(tmp_path / "blind.bag", ROS1) as bag:
        bag.image("/camera/color/image_raw", frame.color, "rgb8", START)
        bag.image("/camera/depth/image_raw", frame.depth, "32FC1", START)
    with pytest.raises(FileFormatError, match="no CameraInfo on /camera/color/camera_info"):
        open_recording(tmp_path / "blind.bag")
    with Writer(tmp_path / "twice.bag", ROS1) as bag:
        for topic in ("image_raw", "image_rect"):
            bag.image(f"/camera/color/{topic}", frame.color, "rgb8", START)
        bag.image("/camera/depth/image_raw", frame.depth, "32FC1", START)
    with pytest.raises(FileFormatError, match=r"several topics of color: .*image_raw, .*image_rect; leave"):
        open_recording(tmp_path / "twice.bag")
    with Writer(tmp_path / "gray.bag", ROS1) as bag:
        bag.image("/infra/image", frame.color, "rgb8", START)
    with pytest.raises(FileFormatError, match="no camera with images of color and of depth"):
        open_recording(tmp_path / "gray.bag")


def test_unknown_encodings_and_damaged_bags_are_reported(tmp_path: Path) -> None:
    with Writer(tmp_path / "odd.bag", ROS1) as bag:
        for kind in ("color", "depth"):
            bag.info(f"/camera/{kind}/camera_info", START)
        bag.image("/camera/color/image_raw", frames()[0].color, "bayer_rggb8", START)
        bag.image("/camera/depth/image_raw", frames()[0].depth, "32FC1", START)
    with pytest.raises(FileFormatError, match="'bayer_rggb8' are not read; known are rgb8"):
        open_recording(tmp_path / "odd.bag")[0]
    whole = (tmp_path / "odd.bag").read_bytes()
    (tmp_path / "cut.bag").write_bytes(whole[: len(whole) // 2])
    for name, content in (("empty.bag", b""), ("text.db3", b"no database"), ("cut.bag", whole[: len(whole) // 2])):
        (tmp_path / name).write_bytes(content)
        repair = "sqlite3 text.db3 .recover" if name == "text.db3" else f"rosbag reindex {name}"
        with pytest.raises(FileFormatError, match=f"{name}: not a valid bag .*; .* repair it: {repair}"):
            open_recording(tmp_path / name)


def test_depth_of_another_lens_is_aligned_by_the_static_transforms(tmp_path: Path) -> None:
    """Depth of a wall, seen from 15 mm next to the color camera."""
    wall = np.full((K.height, K.width), 0.5, np.float32)
    wall[:, K.width // 2 :] = 1.0
    with Writer(tmp_path / "walk", SQLITE) as bag:
        bag.info("/camera/color/camera_info", START, "color")
        bag.info("/camera/depth/camera_info", START, "depth")
        bag.transform("/tf_static", "color", "depth", pose(translation=[0.015, 0.0, 0.0]), START)
        bag.image("/camera/color/image_raw", frames()[0].color, "rgb8", START)
        bag.image("/camera/depth/image_raw", wall, "32FC1", START)
    depth = open_recording(tmp_path / "walk")[0].frames["camera"].depth
    edge = K.width // 2 + 0.015 / 0.5 * K.fx  # points move to the right by f 15 mm / z
    row = depth[K.height // 2]
    assert row[int(edge) - 2] == pytest.approx(0.5)
    assert row[int(edge) + 3] == pytest.approx(1.0)


def test_one_camera_is_read_without_the_others(tmp_path: Path) -> None:
    with Writer(tmp_path / "walk.bag", ROS1) as bag:
        bag.camera("/left", frames())
        for stamp in stamps():
            bag.image("/right/color/image_raw", frames()[0].color, "bayer_rggb8", stamp)
            bag.image("/right/depth/image_raw", frames()[0].depth, "32FC1", stamp)
            for kind in ("color", "depth"):
                bag.info(f"/right/{kind}/camera_info", stamp)
    recording = open_recording(tmp_path / "walk.bag")
    np.testing.assert_array_equal(recording.frame(1, "left").color, frames()[1].color)
    with pytest.raises(FileFormatError, match="bayer_rggb8"):
        recording[1]


def test_an_open_bag_is_read_by_threads_and_travels(tmp_path: Path) -> None:
    as_usual(tmp_path / "walk", SQLITE)
    recording = open_recording(tmp_path / "walk" / "walk.db3")
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda i: recording[i].frames["camera"], [2, 0, 1]))
    for frame, i in zip(found, (2, 0, 1), strict=True):
        np.testing.assert_array_equal(frame.color, frames()[i].color)
    assert_equal(pickle.loads(pickle.dumps(recording)))


@pytest.mark.parametrize("container", [ROS1, MCAP, SQLITE])
def test_a_truncated_bag_is_refused_or_read_in_part(tmp_path: Path, container: str) -> None:
    path = tmp_path / ("walk.bag" if container == ROS1 else "walk")
    as_usual(path, container)
    file = path if container == ROS1 else next(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) * 7 // 10])
    read: list[RgbdFrame] = []
    with contextlib.suppress(FileFormatError):
        read += [station.frames["camera"] for station in open_recording(path)]
    assert len(read) < 3
    for frame, expected in zip(read, frames(), strict=False):
        np.testing.assert_array_equal(frame.color, expected.color)
