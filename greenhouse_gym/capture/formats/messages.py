"""ROS messages as arrays: images of any usual encoding, lenses, poses."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.formats.pairs import Lens
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, pose

with needs("reconstruct"):
    import cv2

KINDS = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
"""Types of messages that are images."""

INFO = "sensor_msgs/msg/CameraInfo"

POSES = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped")
"""Types of messages that tell where a rig is: x forward, z up, as a rig's frame here."""

_ENCODINGS: dict[str, tuple[Any, int, int | None]] = {
    "rgb8": (np.uint8, 3, None),
    "bgr8": (np.uint8, 3, cv2.COLOR_BGR2RGB),
    "8UC3": (np.uint8, 3, cv2.COLOR_BGR2RGB),
    "rgba8": (np.uint8, 4, cv2.COLOR_RGBA2RGB),
    "bgra8": (np.uint8, 4, cv2.COLOR_BGRA2RGB),
    "mono8": (np.uint8, 1, cv2.COLOR_GRAY2RGB),
    "yuv422_yuy2": (np.uint8, 2, cv2.COLOR_YUV2RGB_YUY2),
    "16UC1": (np.uint16, 1, None),
    "mono16": (np.uint16, 1, None),
    "32FC1": (np.float32, 1, None),
}
_PNG = b"\x89PNG"


def image_of(topic: str, message: Any) -> npt.NDArray[Any]:
    """An image message: color (h, w, 3) RGB, or depth (h, w) in its own units.

    Raises:
        FileFormatError: Its encoding is not read, or its data are too few.
    """
    if hasattr(message, "format"):
        return _decompressed(topic, message)
    if message.encoding not in _ENCODINGS:
        known = ", ".join(_ENCODINGS)
        raise FileFormatError(topic, f"images of the encoding {message.encoding!r} are not read; known are {known}")
    kind, channels, conversion = _ENCODINGS[message.encoding]
    kind = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    width, height, step = int(message.width), int(message.height), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8)
    if step < width * channels * kind.itemsize or len(data) < step * height:
        raise FileFormatError(topic, f"an image of {width}x{height} {message.encoding} has {len(data)} bytes only")
    rows = data[: step * height].reshape(height, step)[:, : width * channels * kind.itemsize]
    image = np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("=")).reshape(height, width, channels)
    if channels == 1:
        image = image[..., 0]
    return image if conversion is None else np.asarray(cv2.cvtColor(image, conversion))


def _decompressed(topic: str, message: Any) -> npt.NDArray[Any]:
    data = bytes(message.data)
    if "compressedDepth" in message.format:  # a header of 12 bytes before the PNG
        if "32FC1" in message.format:
            raise FileFormatError(topic, "depth compressed as inverse fractions is not read; record 16UC1")
        data = data[data.find(_PNG) :] if _PNG in data[:64] else data
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise FileFormatError(topic, f"a compressed image ({message.format!r}, {len(data)} bytes) cannot be decoded")
    return np.asarray(cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2RGB) if image.ndim == 3 else image)


def lens_of(path: object, topic: str, message: Any) -> Lens:
    """The lens that a CameraInfo tells of.

    Raises:
        FileFormatError: It holds no pinhole.
    """
    matrix = np.asarray(message.K if hasattr(message, "K") else message.k, dtype=np.float64).reshape(3, 3)
    bent = np.asarray(message.D if hasattr(message, "D") else message.d, dtype=np.float64)
    if not matrix[0, 0] > 0:
        raise FileFormatError(path, f"the CameraInfo on {topic} holds no focal length: the camera is not calibrated")
    k = Intrinsics(
        int(message.width), int(message.height), float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]),
        float(matrix[1, 2]),
    )  # fmt: skip
    return Lens(k, tuple(bent.tolist()) if bent.any() else ())


def extrinsics_of(message: Any) -> Array:
    """A Transform message as (4, 4)."""
    return pose_from(message.translation, message.rotation)


def pose_of(message: Any) -> Array:
    """The pose (4, 4) of an Odometry or PoseStamped message."""
    told = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    return pose_from(told.position, told.orientation)


def pose_from(place: Any, turn: Any) -> Array:
    """A point or vector and a quaternion as (4, 4)."""
    quaternion = [turn.x, turn.y, turn.z, turn.w]
    return pose(Rotation.from_quat(quaternion).as_matrix(), [place.x, place.y, place.z])
