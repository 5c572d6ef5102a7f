"""Messages that hold no image, no depth or no lens are named by their topic."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.capture.formats.ros_messages import image_of, lens_of
from greenhouse_gym.errors import FileFormatError


def image(**changed: Any) -> SimpleNamespace:
    usual = {"encoding": "rgb8", "is_bigendian": 0, "width": 4, "height": 3, "step": 12, "data": np.zeros(36, np.uint8)}
    return SimpleNamespace(**(usual | changed))


def compressed(format: str, data: bytes) -> SimpleNamespace:
    return SimpleNamespace(format=format, data=np.frombuffer(data, np.uint8))


NO_IMAGES = {
    "4x3 rgb8 has 35 bytes only": image(data=np.zeros(35, np.uint8)),
    "has 36 bytes only": image(step=11),
    "'mono12' are not read; known are rgb8": image(encoding="mono12"),
    "inverse fractions is not read; record 16UC1": compressed("32FC1; compressedDepth png", bytes(20)),
    "60000x60000 pixels of 3 bytes is too large": compressed(
        "png", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + 2 * b"\0\0\xea\x60" + b"\b\2IEND\xaeB`\x82"
    ),
    "neither a PNG nor a JPEG file .7 bytes": compressed("rgb8; jpeg compressed bgr8", b"no jpeg"),
}


@pytest.mark.parametrize("said", NO_IMAGES)
def test_what_is_no_image_is_refused(said: str) -> None:
    with pytest.raises(FileFormatError, match=f"/camera/color.*{said}"):
        image_of("/camera/color", NO_IMAGES[said])


def test_rows_with_padding_and_big_endian_depth_are_read() -> None:
    depth = np.arange(6, dtype=">u2").reshape(2, 3)
    padded = np.zeros((2, 8), np.uint8)
    padded[:, :6] = depth.view(np.uint8)
    message = image(encoding="16UC1", is_bigendian=1, width=3, height=2, step=8, data=padded.ravel())
    np.testing.assert_array_equal(image_of("/camera/depth", message), depth)


def test_a_camera_without_focal_length_is_not_calibrated() -> None:
    info = SimpleNamespace(k=np.zeros(9), d=np.zeros(5), width=4, height=3)
    with pytest.raises(FileFormatError, match="on /camera/camera_info holds no focal length"):
        lens_of("walk.bag", "/camera/camera_info", info)
