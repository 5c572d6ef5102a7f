"""Bags of ROS 1 and ROS 2, and those of RealSense's recorder, which are ROS 1 bags with topics of their own.

The bag is gone through once for the times of its images; an image is read when it is asked for, so memory is that of
one station however long the bag. A color and a depth image belong together by their time stamps.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from greenhouse_gym.capture.formats.bag_readers import OpenBag, opened
from greenhouse_gym.capture.formats.messages import POSES, extrinsics_of, image_of, lens_of, pose_of
from greenhouse_gym.capture.formats.moments import Message, stations_of
from greenhouse_gym.capture.formats.pairs import Pair
from greenhouse_gym.capture.formats.single_camera import RIG_FROM_CAMERA
from greenhouse_gym.capture.formats.topics import CameraTopics, cameras_of
from greenhouse_gym.capture.formats.transforms import bare, between, moving_frames, poses_of, track
from greenhouse_gym.capture.formats.videos import POSED_WITHIN, nearest_in_time
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


def recognises(path: Path) -> bool:
    """Whether it is such a file, or a folder with one and its ``metadata.yaml``."""
    if path.is_file():
        return path.suffix.lower() in _SUFFIXES
    return (path / "metadata.yaml").is_file() and any(file.suffix in _SUFFIXES for file in path.iterdir())


def open(path: Path) -> Recording:
    """Open a bag: a station for each moment of which every camera has a color and a depth image.

    Raises:
        FileFormatError: The bag is damaged, lacks images or their CameraInfo, or its cameras' clocks run apart.
        MissingDependencyError: The extra ``bags`` is not installed.
    """
    bag = _bag(path)
    with parsing(path, "bag"), opened(bag) as reader:
        types = {connection.topic: connection.msgtype for connection in reader.connections}
        cameras = cameras_of(path, types)
        moments, singles = _index(reader, cameras, types)
        pairs = {name: _pair(path, topics, singles) for name, topics in cameras.items()}
        reference = sorted(pairs)[len(pairs) // 2]
        posed = _poses(reader, types)
        of_camera = not len(posed[0])
        if of_camera:
            posed = _track(reader, singles[cameras[reference].color_info].header.frame_id, singles)
    stations, notes = stations_of(path, cameras, moments)
    rig = Rig(
        {name: Camera(pair.color.intrinsics, RIG_FROM_CAMERA, pair.depth_scale) for name, pair in pairs.items()},
        reference,
    )
    poses = [_nearest_pose(station, posed) for station in stations]
    for camera, topics in cameras.items():
        if pairs[camera].depth is not None and _color_from_depth(topics, singles) is None:
            notes.append(f"{camera}: the bag does not say how depth and color stand; taken as at one place")
    load = _Stations(OpenBag(bag), pairs, tuple(stations), tuple(poses))
    files = (bag,) if bag.is_file() else tuple(sorted(file for file in bag.iterdir() if file.is_file()))
    folder = bag.parent if bag.is_file() else bag
    return Recording(path.stem, rig, len(stations), load, folder, files=files, notes=tuple(notes), of_camera=of_camera)


def _bag(path: Path) -> Path:
    """What the reader opens: the file of a ROS 1 bag or of RealSense's recorder, the folder of a ROS 2 bag."""
    if path.suffix.lower() in (".bag", ".db3") or path.is_dir():
        return path
    if not (path.parent / "metadata.yaml").is_file():
        raise FileFormatError(path, "has no metadata.yaml beside it; make one by: ros2 bag reindex FOLDER")
    return path.parent


def _index(
    reader: Any, cameras: Mapping[str, CameraTopics], types: Mapping[str, str]
) -> tuple[dict[str, list[Message]], dict[str, Any]]:
    """All images by topic, and the first message of each topic that is told once."""
    images = {topic for topics in cameras.values() for topic in (topics.color, topics.depth)}
    once = {topic for topics in cameras.values() for topic in topics.once if topic in types} | {_STATIC}
    wanted = [connection for connection in reader.connections if connection.topic in images | once]
    found: dict[str, list[Message]] = {topic: [] for topic in images}
    singles: dict[str, Any] = {}
    for connection, at, raw in reader.messages(connections=wanted):
        if connection.topic in images:
            found[connection.topic].append(Message(connection.topic, at, _stamp(raw, at)))
        elif connection.topic == _STATIC:
            singles.setdefault(_STATIC, []).append(reader.deserialize(raw, connection.msgtype))
        elif connection.topic not in singles:
            singles[connection.topic] = reader.deserialize(raw, connection.msgtype)
    return {topic: sorted(messages, key=lambda each: each.stamp) for topic, messages in found.items()}, singles


def _stamp(raw: bytes, at: int) -> int:
    """When an image was taken: seconds and nanoseconds stand at the same place of every header."""
    seconds, nanoseconds = struct.unpack_from("<Ii", raw, 4)
    return int(seconds) * 10**9 + int(nanoseconds) if seconds else at


def _pair(path: Path, topics: CameraTopics, singles: Mapping[str, Any]) -> Pair:
    for topic in (topics.color_info, topics.depth_info):
        if topic not in singles:
            raise FileFormatError(path, f"has no CameraInfo on {topic}, which its images need")
    color, depth = (lens_of(path, topic, singles[topic]) for topic in (topics.color_info, topics.depth_info))
    scale = float(singles[topics.units].data) if topics.units in singles else 0.001
    apart = _color_from_depth(topics, singles)
    return Pair.of(color, depth, np.eye(4) if apart is None else apart, scale)


def _color_from_depth(topics: CameraTopics, singles: Mapping[str, Any]) -> Array | None:
    """How the two cameras stand, (4, 4), by /tf_static or by what RealSense's older recorder tells; else None."""
    if topics.color_place in singles and topics.depth_place in singles:  # of one frame of the device in each camera
        return extrinsics_of(singles[topics.color_place]) @ invert(extrinsics_of(singles[topics.depth_place]))
    frames = [singles[topic].header.frame_id for topic in (topics.color_info, topics.depth_info)]
    return between(poses_of(singles.get(_STATIC, [])), bare(frames[0]), bare(frames[1]))


def _poses(reader: Any, types: Mapping[str, str]) -> tuple[Array, Array]:
    """Times (n,) and poses (n, 4, 4) of the first topic that tells where the camera is, if there is one."""
    topic = next((topic for topic, kind in sorted(types.items()) if kind in POSES), None)
    wanted = [connection for connection in reader.connections if connection.topic == topic]
    if not wanted:
        return np.zeros(0), np.zeros((0, 4, 4))
    told = [
        (_stamp(raw, at) / 1e9, pose_of(reader.deserialize(raw, connection.msgtype)))
        for connection, at, raw in reader.messages(connections=wanted)
    ]
    told.sort(key=lambda each: each[0])
    return np.array([time for time, _ in told]), np.array([place for _, place in told])


def _track(reader: Any, frame: str, singles: Mapping[str, Any]) -> tuple[Array, Array]:
    """Times (n,) and poses (n, 4, 4) of the rig frame around a camera's frame, by /tf; none where that tells none."""
    wanted = [connection for connection in reader.connections if connection.topic == _MOVING]
    found = reader.messages(connections=wanted) if wanted else ()
    moving = moving_frames(reader.deserialize(raw, connection.msgtype) for connection, _, raw in found)
    times, poses = track(bare(frame), poses_of(singles.get(_STATIC, [])), moving)
    return times, poses @ RIG_FROM_CAMERA.T


def _nearest_pose(station: Mapping[str, tuple[Message, Message]], posed: tuple[Array, Array]) -> Array | None:
    stamp = next(iter(station.values()))[0].stamp / 1e9
    near = int(nearest_in_time(np.array([stamp]), posed[0], POSED_WITHIN)[0])
    return None if near < 0 else posed[1][near]


@dataclass(frozen=True, eq=False)
class _Stations:
    """Reads stations, or one camera's images of them."""

    bag: OpenBag
    pairs: Mapping[str, Pair]
    stations: Sequence[Mapping[str, tuple[Message, Message]]]
    poses: Sequence[Array | None]

    def __call__(self, i: int) -> Station:
        return Station({name: self.camera(i, name) for name in self.stations[i]}, self.poses[i])

    def camera(self, i: int, name: str) -> RgbdFrame:
        both = self.stations[i][name]
        with self.bag.reader() as reader:
            color, depth = (_read(reader, message) for message in both)
        return self.pairs[name].frame(color, depth, f"{self.bag.bag}, {both[0].topic} at {both[0].stamp} ns")


def _read(reader: Any, message: Message) -> Any:
    wanted = [connection for connection in reader.connections if connection.topic == message.topic]
    for connection, _, raw in reader.messages(connections=wanted, start=message.at, stop=message.at + 1):
        if _stamp(raw, message.at) == message.stamp:
            return image_of(message.topic, reader.deserialize(raw, connection.msgtype))
    raise FileFormatError(message.topic, f"the image at {message.stamp} ns is not there any more")
