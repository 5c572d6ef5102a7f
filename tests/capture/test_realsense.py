"""What RealSense's own recorder writes, of a software device, is read back equal."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from greenhouse_gym.capture import open_recording

pytest.importorskip("rosbags")
libusb = pytest.importorskip("libusb_package")

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
for n in range(4):
    random = np.random.default_rng(n)
    images = (random.integers(300, 900, (H, W)).astype(np.uint16), random.integers(0, 255, (H, W, 3)).astype(np.uint8))
    for sensor, profile, image, size in zip((depth_sensor, color_sensor), (depth, color), images, (2, 3)):
        frame = rs.software_video_frame()
        frame.stride, frame.bpp, frame.pixels = W * size, size, np.ascontiguousarray(image)
        frame.timestamp, frame.domain = 1e12 + 33.0 * n, rs.timestamp_domain.hardware_clock
        frame.frame_number, frame.profile = n + 1, profile.as_video_stream_profile()
        if size == 2:
            frame.depth_units = 0.001
        sensor.on_video_frame(frame)
    time.sleep(0.1)
for sensor in sensors:
    sensor.stop()
    sensor.close()
"""


def test_a_recording_of_the_sdk_is_read_back(tmp_path: Path) -> None:
    file = tmp_path / "rs.db3"
    ctypes.CDLL(str(libusb.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    pytest.importorskip("pyrealsense2")
    subprocess.run([sys.executable, "-c", RECORD, str(file)], check=True, timeout=120)
    recording = open_recording(file)
    assert len(recording) >= 2  # the recorder may leave out the first or the last frame of a stream
    made = []
    for n in range(4):
        random = np.random.default_rng(n)
        made.append((random.integers(300, 900, (48, 64)) / 1000, random.integers(0, 255, (48, 64, 3))))
    for station in recording:
        frame = station.frames["device_0"]
        (n,) = (k for k, (depth, _) in enumerate(made) if np.allclose(frame.depth, depth, atol=1e-6))
        np.testing.assert_array_equal(frame.color, made[n][1])
        assert frame.intrinsics.fx == 50.0
