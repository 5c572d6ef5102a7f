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

from greenhouse_gym.capture.formats.bag_poses import ODOMETRY, POSE, PoseTopic, TimedPoses, rig_poses
from greenhouse_gym.capture.formats.bag_readers import OpenBag, open_bag
from greenhouse_gym.capture.formats.bag_topics import CameraTopics, MessageKey, cameras_of, is_rectified, match_moments
from greenhouse_gym.capture.formats.image_lists import POSE_TOLERANCE, nearest_in_time
from greenhouse_gym.capture.formats.ros_messages import (
    StaticFrames,
    bare_name,
    extrinsics_of,
    image_of,
    lens_of,
    moving_frames,
    pose_between,
    static_frames,
    track,
)
from greenhouse_gym.capture.formats.single_camera import RIG_FROM_CAMERA, Pair
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Camera, RgbdFrame, Rig, Station
from greenhouse_gym.common.files import parsing
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, invert, pose

name = "bag"
description = "a ROS 1 .bag (RealSense's too), a ROS 2 .mcap or .db3 with its metadata.yaml, or their folder"

_SUFFIXES = (".bag", ".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_STATIC, _MOVING = "/tf_static", "/tf"


def recognizes(path: Path) -> bool:
    """Return whether the path is a bag's file, or a folder with one and its ``metadata.yaml``."""
    if path.is_file():
        return path.name.lower().endswith(_SUFFIXES)
    files = path.iterdir() if (path / "metadata.yaml").is_file() else ()
    return any(file.name.lower().endswith(_SUFFIXES) for file in files)


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
        frame = bare_name(constants[cameras[reference].color_info].header.frame_id)
        moments, notes = match_moments(path, cameras, images)
        static = static_frames(constants.get(_STATIC, []))
        times = np.array([_color_stamp(moment) for moment in moments])
        timed = rig_poses(_pose_topics(reader, types), frame, static, times)
        if timed is None or not len(timed.times):
            said = () if timed is None else timed.notes
            timed = TimedPoses(*_camera_track(reader, frame, static), of_camera=True, notes=said)
    rig = Rig(
        {name: Camera(pair.color.intrinsics, RIG_FROM_CAMERA, pair.depth_scale) for name, pair in pairs.items()},
        reference,
    )
    for camera, topics in cameras.items():
        if pairs[camera].depth is not None and _color_from_depth(topics, constants) is None:
            notes.append(f"{camera}: the bag lacks the pose of depth to color; taken as the identity")
    load = _Stations(OpenBag(bag), pairs, tuple(moments), tuple(_nearest_poses(times, timed)))
    files = (bag,) if bag.is_file() else tuple(sorted(file for file in bag.iterdir() if file.is_file()))
    folder = bag.parent if bag.is_file() else bag
    notes += timed.notes
    return Recording(
        path.stem, rig, len(moments), load, folder, files=files, notes=tuple(notes), camera_poses=timed.of_camera
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
    color, depth = (
        lens_of(path, info, constants[info], rectified=is_rectified(images))
        for info, images in ((topics.color_info, topics.color), (topics.depth_info, topics.depth))
    )
    scale = float(constants[topics.units].data) if topics.units in constants else 0.001
    known = _color_from_depth(topics, constants)
    color_from_depth = np.eye(4) if known is None else known
    color_from_depth = pose(translation=-color.center) @ color_from_depth @ pose(translation=depth.center)
    return Pair.of(color.lens, depth.lens, color_from_depth, scale)


def _color_from_depth(topics: CameraTopics, constants: Mapping[str, Any]) -> Array | None:
    """Return color_from_depth (4, 4) by /tf_static or by RealSense's older recorder; None if unknown."""
    if topics.color_extrinsics in constants and topics.depth_extrinsics in constants:  # of one frame of the device
        color, depth = (extrinsics_of(constants[topic]) for topic in (topics.color_extrinsics, topics.depth_extrinsics))
        return color @ invert(depth)
    frames = [constants[topic].header.frame_id for topic in (topics.color_info, topics.depth_info)]
    return pose_between(static_frames(constants.get(_STATIC, [])), bare_name(frames[0]), bare_name(frames[1]))


def _pose_topics(reader: Any, types: Mapping[str, str]) -> list[PoseTopic]:
    """Return the topics of the bag with poses."""
    kinds = {topic: kind for topic, kind in types.items() if kind in (ODOMETRY, POSE)}
    messages: dict[str, list[tuple[float, Any]]] = {topic: [] for topic in kinds}
    for connection, at, raw in reader.messages(connections=_connections(reader, set(kinds))) if kinds else ():
        messages[connection.topic].append((_stamp(raw, at) / 1e9, reader.deserialize(raw, connection.msgtype)))
    found = (PoseTopic.of(topic, kinds[topic], each) for topic, each in messages.items())
    return [topic for topic in found if topic is not None]


def _camera_track(reader: Any, frame: str, static: StaticFrames) -> tuple[Array, Array]:
    """Return times (n,) and poses (n, 4, 4) of the rig frame around a camera's frame, by /tf; empty if unknown."""
    connections = _connections(reader, {_MOVING})
    found = reader.messages(connections=connections) if connections else ()
    moving = moving_frames(reader.deserialize(raw, connection.msgtype) for connection, _, raw in found)
    times, poses = track(frame, static, moving)
    return times, poses @ RIG_FROM_CAMERA.T


def _color_stamp(moment: Mapping[str, tuple[MessageKey, MessageKey]]) -> float:
    """Return the time of a moment by its first color image, seconds."""
    return next(iter(moment.values()))[0].stamp / 1e9


def _nearest_poses(times: Array, timed: TimedPoses) -> list[Array | None]:
    near = nearest_in_time(times, timed.times, POSE_TOLERANCE)
    return [None if k < 0 else timed.poses[k] for k in near]


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
        return self.pairs[name].frame(
            color, depth, f"{self.bag.bag}, {keys[0].topic} and {keys[1].topic} at {keys[0].stamp} ns"
        )


def _read(reader: Any, key: MessageKey) -> Any:
    connections = _connections(reader, {key.topic})
    for connection, _, raw in reader.messages(connections=connections, start=key.received, stop=key.received + 1):
        if _stamp(raw, key.received) == key.stamp:
            return image_of(key.topic, reader.deserialize(raw, connection.msgtype))
    raise FileFormatError(key.topic, f"the image at {key.stamp} ns is no longer there")
