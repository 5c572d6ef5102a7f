"""Recordings of a software device by RealSense's own recorder are read back equal."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from typer.testing import CliRunner

from greenhouse_gym.capture import RgbdFrame, open_recording
from greenhouse_gym.capture.formats.single_camera import Lens, Pair
from greenhouse_gym.capture.realsense import _Stream, realsense_cameras
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.cli import app
from greenhouse_gym.errors import CameraError, FileFormatError

pytest.importorskip("rosbags")
libusb = pytest.importorskip("libusb_package")

FRAMES = 5  # the recorder starts with the first of them: a busy machine gives its images times far apart
RECORD = """
import ctypes, sys, time
import libusb_package
import numpy as np
ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
import pyrealsense2 as rs

W, H = 64, 48
device = rs.software_device()

def stream(sensor, kind, uid, format, bytes_each, focal):
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = W, H, focal, focal, 31.5, 23.5
    lens.model, lens.coeffs = rs.distortion.none, [0] * 5
    made = rs.video_stream()
    made.type, made.index, made.uid, made.width, made.height, made.fps = kind, 0, uid, W, H, 30
    made.bpp, made.fmt, made.intrinsics = bytes_each, format, lens
    return sensor.add_video_stream(made)

depth_sensor, color_sensor = device.add_sensor("Stereo Module"), device.add_sensor("RGB Camera")
depth = stream(depth_sensor, rs.stream.depth, 0, rs.format.z16, 2, 50.0)
color = stream(color_sensor, rs.stream.color, 1, rs.format.rgb8, 3, 50.0)
depth_sensor.add_read_only_option(rs.option.depth_units, 0.001)
same = rs.extrinsics()
same.rotation, same.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0]
depth.register_extrinsics_to(color, same)
recorder = rs.recorder(sys.argv[1], device)
queue = rs.frame_queue(20, keep_frames=True)
sensors = recorder.query_sensors()
for sensor in sensors:
    sensor.open(sensor.get_stream_profiles()[0])
    sensor.start(queue)
for n in range(int(sys.argv[2])):
    random = np.random.default_rng(n)
    images = (random.integers(300, 900, (H, W)).astype(np.uint16), random.integers(0, 255, (H, W, 3)).astype(np.uint8))
    ready = []
    for sensor, profile, image, size in zip((depth_sensor, color_sensor), (depth, color), images, (2, 3)):
        frame = rs.software_video_frame()
        frame.stride, frame.bpp, frame.pixels = W * size, size, np.ascontiguousarray(image)
        frame.timestamp, frame.domain = 1e12 + 33.0 * n, rs.timestamp_domain.hardware_clock
        frame.frame_number, frame.profile = n + 1, profile.as_video_stream_profile()
        if size == 2:
            frame.depth_units = 0.001
        ready.append((sensor, frame))
    for sensor, frame in ready:
        sensor.on_video_frame(frame)
    time.sleep(0.1)
for sensor in sensors:
    sensor.stop()
    sensor.close()
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recording of a software device by the SDK's recorder."""
    ctypes.CDLL(str(libusb.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    pytest.importorskip("pyrealsense2")
    file = tmp_path_factory.mktemp("realsense") / "rs.db3"
    subprocess.run([sys.executable, "-c", RECORD, str(file), str(FRAMES)], check=True, timeout=120)
    return file


def number_of(frame: RgbdFrame) -> int:
    """Return the number of the software device's frame that equals this one."""
    made = []
    for n in range(FRAMES):
        random = np.random.default_rng(n)
        made.append((random.integers(300, 900, (48, 64)) / 1000, random.integers(0, 255, (48, 64, 3))))
    (found,) = (n for n, (depth, _) in enumerate(made) if np.allclose(frame.depth, depth, atol=1e-6))
    np.testing.assert_array_equal(frame.color, made[found][1])
    return found


def test_a_recording_of_the_sdk_is_read_back(file: Path) -> None:
    stations = list(open_recording(file))
    assert all(station.frames["device_0"].intrinsics.fx == 50.0 for station in stations)
    numbers = [number_of(station.frames["device_0"]) for station in stations]
    assert numbers in ([0, 1, 2, 3, 4], [1, 2, 3, 4])


def test_the_sdk_plays_its_recording_back_as_a_camera(file: Path) -> None:
    with realsense_cameras(playback=[file]) as live:
        assert live.rig.cameras["camera"].intrinsics.fx == 50.0
        numbers = [number_of(moment.frames["camera"]) for moment in live.moments]
    assert numbers in ([0, 1, 2, 3, 4], [1, 2, 3, 4])


def test_the_command_records_what_is_played_back(file: Path, tmp_path: Path) -> None:
    asked = CliRunner().invoke(app, ["record", "--out", str(tmp_path / "row"), "--playback", str(file)], input="")
    assert asked.exit_code == 0, asked.output
    assert "station 0" in asked.output
    recording = open_recording(tmp_path / "row")
    number_of(recording[0].frames["camera"])


@pytest.mark.parametrize(("late", "kept"), [(0.0, 2), (20.0, 2), (33.0, 1)])
def test_frames_of_different_moments_are_no_pair(late: float, kept: int) -> None:
    def frame(image: npt.NDArray[Any], timestamp: float, domain: str = "hardware") -> SimpleNamespace:
        return SimpleNamespace(
            get_data=lambda: image,
            get_timestamp=lambda: timestamp,
            get_frame_timestamp_domain=lambda: domain,
            get_units=lambda: 0.001,
        )

    def moment(depth: SimpleNamespace, color: SimpleNamespace) -> SimpleNamespace:
        return SimpleNamespace(get_depth_frame=lambda: depth, get_color_frame=lambda: color)

    depth, color = np.full((48, 64), 500, np.uint16), np.zeros((48, 64, 3), np.uint8)
    sent = iter(
        [
            moment(frame(depth, 1000.0 + late), frame(color, 1000.0)),
            moment(frame(depth, 5000.0), frame(color, 1033.0, "another clock")),
        ]
    )

    def wait_for_frames(timeout: int) -> SimpleNamespace:
        found = next(sent, None)
        if found is None:
            raise RuntimeError("no frame")
        return found

    lens = Lens(Intrinsics(64, 48, 50.0, 50.0, 31.5, 23.5))
    stream = _Stream("camera", SimpleNamespace(wait_for_frames=wait_for_frames), Pair.of(lens, lens, np.eye(4)))
    frames = stream.frames()
    assert [time for time, _ in islice(frames, kept)] == [1.0, 1.033][-kept:]
    with pytest.raises(CameraError, match="sends no more images"):
        next(frames)


def test_no_camera_and_no_file_are_reported(tmp_path: Path) -> None:
    pytest.importorskip("pyrealsense2")
    with pytest.raises(CameraError, match="no RealSense camera is connected"), realsense_cameras():
        pass
    with pytest.raises(FileFormatError, match="no such file"), realsense_cameras(playback=[tmp_path / "x.bag"]):
        pass
    (tmp_path / "x.bag").write_bytes(b"nothing")
    with pytest.raises(CameraError, match="cannot be started"), realsense_cameras(playback=[tmp_path / "x.bag"]):
        pass
