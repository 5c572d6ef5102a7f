"""Bags of ROS 1 and ROS 2, and those of RealSense's recorder, which are ROS 1 bags with topics of their own.

The bag is scanned once for the times of its images; each image is read when it is accessed, so memory is that of one
station however long the bag. Color and depth images are matched by their time stamps.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.capture.formats.bag_readers import OpenBag, open_bag
from greenhouse_gym.capture.formats.bag_topics import CameraTopics, MessageKey, cameras_of, match_moments
from greenhouse_gym.capture.formats.pairs import Pair
from greenhouse_gym.capture.formats.ros_messages import (
    POSES,
    bare_name,
    extrinsics_of,
    image_of,
    lens_of,
    moving_frames,
    pose_between,
    pose_of,
    static_frames,
    track,
)
from greenhouse_gym.capture.formats.single_camera import RIG_FROM_CAMERA
from greenhouse_gym.capture.formats.trajectories import POSE_TOLERANCE, nearest_in_time
from greenhouse_gym.capture.frames import RgbdFrame, Station
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Camera, Rig
from greenhouse_gym.common.files import parsing
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, invert

name = "bag"
description = "a ROS 1 .bag (RealSense's too), a ROS 2 .mcap or .db3 with its metadata.yaml, or their folder"

_SUFFIXES = (".bag", ".mcap", ".db3")
_STATIC, _MOVING = "/tf_static", "/tf"


def recognizes(path: Path) -> bool:
    """Return whether it is such a file, or a folder with one and its ``metadata.yaml``."""
    if path.is_file():
        return path.suffix.lower() in _SUFFIXES
    return (path / "metadata.yaml").is_file() and any(file.suffix in _SUFFIXES for file in path.iterdir())


def open(path: Path) -> Recording:
    """Open a bag: a station for each moment at which every camera has a color and a depth image.

    Raises:
        FileFormatError: The bag is damaged, lacks images or their CameraInfo, or its cameras' clocks differ.
        MissingDependencyError: The extra ``bags`` is not installed.
    """
    bag = _bag(path)
    with parsing(path, "bag"), open_bag(bag) as reader:
        types = {connection.topic: connection.msgtype for connection in reader.connections}
        cameras = cameras_of(path, types)
        images, constants = _index(reader, cameras, types)
        pairs = {name: _pair(path, topics, constants) for name, topics in cameras.items()}
        reference = sorted(pairs)[len(pairs) // 2]
        timed = _poses(reader, types)
        camera_poses = not len(timed[0])
        if camera_poses:
            timed = _camera_track(reader, constants[cameras[reference].color_info].header.frame_id, constants)
    moments, notes = match_moments(path, cameras, images)
    rig = Rig(
        {name: Camera(pair.color.intrinsics, RIG_FROM_CAMERA, pair.depth_scale) for name, pair in pairs.items()},
        reference,
    )
    for camera, topics in cameras.items():
        if pairs[camera].depth is not None and _color_from_depth(topics, constants) is None:
            notes.append(f"{camera}: the bag lacks the pose of depth to color; taken as the identity")
    load = _Stations(OpenBag(bag), pairs, tuple(moments), tuple(_nearest_pose(moment, timed) for moment in moments))
    files = (bag,) if bag.is_file() else tuple(sorted(file for file in bag.iterdir() if file.is_file()))
    folder = bag.parent if bag.is_file() else bag
    return Recording(
        path.stem, rig, len(moments), load, folder, files=files, notes=tuple(notes), camera_poses=camera_poses
    )


def _bag(path: Path) -> Path:
    """Return the path to open: the file of a ROS 1 bag or of RealSense's recorder, the folder of a ROS 2 bag."""
    if path.suffix.lower() in (".bag", ".db3") or path.is_dir():
        return path
    if not (path.parent / "metadata.yaml").is_file():
        raise FileFormatError(path, "has no metadata.yaml next to it; make one by: ros2 bag reindex FOLDER")
    return path.parent


def _index(
    reader: Any, cameras: Mapping[str, CameraTopics], types: Mapping[str, str]
) -> tuple[dict[str, list[MessageKey]], dict[str, Any]]:
    """Return all images by topic, and the first message of each constant topic."""
    images = {topic for topics in cameras.values() for topic in (topics.color, topics.depth)}
    constant = {topic for topics in cameras.values() for topic in topics.constant if topic in types} | {_STATIC}
    found: dict[str, list[MessageKey]] = {topic: [] for topic in images}
    constants: dict[str, Any] = {}
    for connection, at, raw in reader.messages(connections=_connections(reader, images | constant)):
        if connection.topic in images:
            found[connection.topic].append(MessageKey(connection.topic, at, _stamp(raw, at)))
        elif connection.topic == _STATIC:
            constants.setdefault(_STATIC, []).append(reader.deserialize(raw, connection.msgtype))
        elif connection.topic not in constants:
            constants[connection.topic] = reader.deserialize(raw, connection.msgtype)
    return {topic: sorted(messages, key=lambda each: each.stamp) for topic, messages in found.items()}, constants


def _connections(reader: Any, topics: set[str]) -> list[Any]:
    return [connection for connection in reader.connections if connection.topic in topics]


def _stamp(raw: bytes, received: int) -> int:
    """Return the time stamp of an image: seconds and nanoseconds are at the same offset of every header."""
    seconds, nanoseconds = struct.unpack_from("<Ii", raw, 4)
    return int(seconds) * 10**9 + int(nanoseconds) if seconds else received


def _pair(path: Path, topics: CameraTopics, constants: Mapping[str, Any]) -> Pair:
    for topic in (topics.color_info, topics.depth_info):
        if topic not in constants:
            raise FileFormatError(path, f"has no CameraInfo on {topic}, which its images need")
    color, depth = (lens_of(path, topic, constants[topic]) for topic in (topics.color_info, topics.depth_info))
    scale = float(constants[topics.units].data) if topics.units in constants else 0.001
    color_from_depth = _color_from_depth(topics, constants)
    return Pair.of(color, depth, np.eye(4) if color_from_depth is None else color_from_depth, scale)


def _color_from_depth(topics: CameraTopics, constants: Mapping[str, Any]) -> Array | None:
    """Return color_from_depth (4, 4) by /tf_static or by RealSense's older recorder; None if unknown."""
    if topics.color_extrinsics in constants and topics.depth_extrinsics in constants:  # of one frame of the device
        color, depth = (extrinsics_of(constants[topic]) for topic in (topics.color_extrinsics, topics.depth_extrinsics))
        return color @ invert(depth)
    frames = [constants[topic].header.frame_id for topic in (topics.color_info, topics.depth_info)]
    return pose_between(static_frames(constants.get(_STATIC, [])), bare_name(frames[0]), bare_name(frames[1]))


def _poses(reader: Any, types: Mapping[str, str]) -> tuple[Array, Array]:
    """Return times (n,) and poses (n, 4, 4) of the first topic with poses of the rig, if there is one."""
    topic = next((topic for topic, kind in sorted(types.items()) if kind in POSES), None)
    if topic is None:
        return np.zeros(0), np.zeros((0, 4, 4))
    timed = [
        (_stamp(raw, at) / 1e9, pose_of(reader.deserialize(raw, connection.msgtype)))
        for connection, at, raw in reader.messages(connections=_connections(reader, {topic}))
    ]
    timed.sort(key=lambda each: each[0])
    return np.array([time for time, _ in timed]), np.array([matrix for _, matrix in timed])


def _camera_track(reader: Any, frame: str, constants: Mapping[str, Any]) -> tuple[Array, Array]:
    """Return times (n,) and poses (n, 4, 4) of the rig frame around a camera's frame, by /tf; empty if unknown."""
    connections = _connections(reader, {_MOVING})
    found = reader.messages(connections=connections) if connections else ()
    moving = moving_frames(reader.deserialize(raw, connection.msgtype) for connection, _, raw in found)
    times, poses = track(bare_name(frame), static_frames(constants.get(_STATIC, [])), moving)
    return times, poses @ RIG_FROM_CAMERA.T


def _nearest_pose(moment: Mapping[str, tuple[MessageKey, MessageKey]], timed: tuple[Array, Array]) -> Array | None:
    stamp = next(iter(moment.values()))[0].stamp / 1e9
    near = int(nearest_in_time(np.array([stamp]), timed[0], POSE_TOLERANCE)[0])
    return None if near < 0 else timed[1][near]


@dataclass(frozen=True, eq=False)
class _Stations:
    """Reader of stations, or of one camera's images of them."""

    bag: OpenBag
    pairs: Mapping[str, Pair]
    moments: Sequence[Mapping[str, tuple[MessageKey, MessageKey]]]
    poses: Sequence[Array | None]

    def __call__(self, i: int) -> Station:
        return Station({name: self.camera(i, name) for name in self.moments[i]}, self.poses[i])

    def camera(self, i: int, name: str) -> RgbdFrame:
        keys = self.moments[i][name]
        with self.bag.reader() as reader:
            color, depth = (_read(reader, key) for key in keys)
        return self.pairs[name].frame(color, depth, f"{self.bag.bag}, {keys[0].topic} at {keys[0].stamp} ns")


def _read(reader: Any, key: MessageKey) -> Any:
    connections = _connections(reader, {key.topic})
    for connection, _, raw in reader.messages(connections=connections, start=key.received, stop=key.received + 1):
        if _stamp(raw, key.received) == key.stamp:
            return image_of(key.topic, reader.deserialize(raw, connection.msgtype))
    raise FileFormatError(key.topic, f"the image at {key.stamp} ns is no longer there")
