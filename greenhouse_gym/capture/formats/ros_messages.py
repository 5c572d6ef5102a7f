"""ROS messages as arrays: images of any usual encoding, lenses, poses, and trees of transforms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.formats.image_lists import nearest_in_time
from greenhouse_gym.capture.formats.single_camera import Lens, distorted_lens
from greenhouse_gym.capture.image_files import PNG_START, decode
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, invert, pose

with needs("reconstruct"):
    import cv2

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

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


def image_of(topic: str, message: Any) -> npt.NDArray[Any]:
    """Decode an image message: color (h, w, 3) RGB, or depth (h, w) in its own units.

    Raises:
        FileFormatError: Its encoding is not known, or it has too few bytes.
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
        data = data[data.find(PNG_START) :] if PNG_START in data[:64] else data
    image = decode(f"{topic} ({message.format!r})", data, cv2.IMREAD_UNCHANGED, foreign=True)
    return np.asarray(cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2RGB) if image.ndim == 3 else image)


class Calibrated(NamedTuple):
    """A lens, and the position of its optical center in the frame of its CameraInfo, metres."""

    lens: Lens
    center: Array


def lens_of(path: object, topic: str, message: Any, rectified: bool = False) -> Calibrated:
    """Convert a CameraInfo message.

    Args:
        path: The bag, for messages.
        topic: The topic of the message.
        message: The message.
        rectified: The images are rectified: ``P`` describes them, without distortion, instead of ``K`` and ``D``.

    Raises:
        FileFormatError: It holds no pinhole, or a distortion model that is not known.
    """
    fields = {name.lower(): value for name, value in vars(message).items()}
    projection = np.reshape(np.asarray(fields.get("p", np.zeros(12)), dtype=np.float64), (3, 4))
    rectified = rectified and projection[0, 0] > 0
    matrix = projection[:, :3] if rectified else np.reshape(np.asarray(fields["k"], dtype=np.float64), (3, 3))
    if not matrix[0, 0] > 0:
        raise FileFormatError(path, f"the CameraInfo on {topic} holds no focal length: the camera is not calibrated")
    focal, center = matrix[[0, 1], [0, 1]], matrix[:2, 2]
    size, corner = np.array([int(message.width), int(message.height)]), np.zeros(2)
    if (region := fields.get("roi")) is not None and region.width and region.height:
        size, corner = np.array([region.width, region.height]), np.array([region.x_offset, region.y_offset])
    binning = np.maximum([fields.get("binning_x", 1), fields.get("binning_y", 1)], 1)
    k = Intrinsics(*(size // binning).tolist(), *(focal / binning).tolist(), *((center - corner) / binning).tolist())
    if rectified:
        return Calibrated(Lens(k), np.append(-projection[:2, 3] / focal, 0.0))
    where = f"{path}, the CameraInfo on {topic}"
    return Calibrated(distorted_lens(where, k, fields["d"], fields.get("distortion_model", "")), np.zeros(3))


def extrinsics_of(message: Any) -> Array:
    """Convert a Transform message to (4, 4)."""
    return _pose(message.translation, message.rotation)


def pose_of(message: Any) -> Array:
    """Convert an Odometry or PoseStamped message to a pose (4, 4)."""
    inner = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    return _pose(inner.position, inner.orientation)


def _pose(vector: Any, turn: Any) -> Array:
    quaternion = [turn.x, turn.y, turn.z, turn.w]
    return pose(Rotation.from_quat(quaternion).as_matrix(), [vector.x, vector.y, vector.z])


StaticFrames = Mapping[str, tuple[str, Array]]
"""The parent of each frame, and its pose (4, 4) in that."""


class MovingFrame(NamedTuple):
    """A frame that moves: its parent, times (n,) in seconds in their order, and poses (n, 4, 4) in the parent."""

    parent: str
    times: Array
    poses: Array


def static_frames(messages: Iterable[Any]) -> dict[str, tuple[str, Array]]:
    """Return the frames of messages of /tf_static."""
    return {child: (parent, matrix) for message in messages for _, child, parent, matrix in _transforms(message)}


def moving_frames(messages: Iterable[Any]) -> dict[str, MovingFrame]:
    """Return the frames of messages of /tf."""
    entries: dict[str, list[tuple[float, str, Array]]] = {}
    for message in messages:
        for time, child, parent, matrix in _transforms(message):
            entries.setdefault(child, []).append((time, parent, matrix))
    frames = {}
    for child, each in entries.items():
        each.sort(key=lambda entry: entry[0])
        times, parents, matrices = zip(*each, strict=True)
        frames[child] = MovingFrame(parents[0], np.array(times), np.array(matrices))
    return frames


def _transforms(message: Any) -> Iterable[tuple[float, str, str, Array]]:
    """Yield time in seconds, frame, its parent and pose of each transform of a message."""
    for each in message.transforms:
        stamp = each.header.stamp
        child, parent = bare_name(each.child_frame_id), bare_name(each.header.frame_id)
        yield stamp.sec + 1e-9 * stamp.nanosec, child, parent, extrinsics_of(each.transform)


def bare_name(frame: str) -> str:
    """Return a frame's name as in ROS 2; in ROS 1 it may begin with a slash."""
    return frame.lstrip("/")


def track(frame: str, static: StaticFrames, moving: Mapping[str, MovingFrame]) -> tuple[Array, Array]:
    """Return times (n,) and poses (n, 4, 4) of a frame in the root frame; empty if no frame in between moves."""
    chain: list[MovingFrame | Array] = []
    passed = {frame}
    while (edge := moving.get(frame) or static.get(frame)) and edge[0] not in passed:
        chain.append(edge if isinstance(edge, MovingFrame) else edge[1])
        frame = edge[0]
        passed.add(frame)
    moves = [edge for edge in chain if isinstance(edge, MovingFrame)]
    if not moves:
        return np.zeros(0), np.zeros((0, 4, 4))
    times = max((edge.times for edge in moves), key=len)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    for each in chain:
        matrix = each.poses[nearest_in_time(times, each.times, np.inf)] if isinstance(each, MovingFrame) else each
        poses = matrix @ poses
    return times, poses


def pose_between(frames: StaticFrames, target: str, source: str) -> Array | None:
    """Return target_from_source (4, 4) by the tree of frames; None where it does not connect the two."""
    above: list[dict[str, Array]] = []
    for frame in (target, source):
        chain, here = {frame: np.eye(4)}, frame
        while here in frames and frames[here][0] not in chain:
            parent, parent_from_here = frames[here]
            chain[parent] = parent_from_here @ chain[here]
            here = parent
        above.append(chain)
    common = next((frame for frame in above[0] if frame in above[1]), None)
    return None if common is None else invert(above[0][common]) @ above[1][common]
