"""Topics and moments of bags: which topics belong to a camera, which images of all cameras to a moment."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from greenhouse_gym.capture.formats.image_lists import nearest_in_time
from greenhouse_gym.capture.formats.ros_messages import CAMERA_INFO, IMAGES
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array

_SAME_MOMENT = 0.025  # s between images of one moment
_MAX_DELAY = 0.1  # s; larger differences of clocks are no delay of messages
_ENDS = 30  # images at each end of a bag by which clocks are compared


@dataclass(frozen=True)
class CameraTopics:
    """The topics of one camera: images, their CameraInfo, and those of RealSense's recorder."""

    color: str
    depth: str
    color_info: str
    depth_info: str
    color_extrinsics: str
    depth_extrinsics: str
    units: str

    @property
    def constant(self) -> tuple[str, ...]:
        """Topics that need only one message."""
        return (self.color_info, self.depth_info, self.color_extrinsics, self.depth_extrinsics, self.units)


def cameras_of(path: object, types: Mapping[str, str]) -> dict[str, CameraTopics]:
    """Return the cameras of a bag, by name, from its topics and their types.

    Raises:
        FileFormatError: No camera has color and depth, or one has two topics of the same kind.
    """
    images: dict[str, dict[str, list[str]]] = {}
    for topic, kind in types.items():
        if kind in IMAGES and (content := _content(topic)):
            images.setdefault(_camera(topic), {}).setdefault(content, []).append(topic)
    cameras = {}
    for camera, topics in images.items():
        if topics.keys() == {"color", "depth"}:
            color, depth = (_single(path, camera, kind, topics[kind]) for kind in ("color", "depth"))
            sensor = _stem(depth).rsplit("/", 1)[0]
            cameras[camera] = CameraTopics(
                color=color,
                depth=depth,
                color_info=_info(color, types),
                depth_info=_info(depth, types),
                color_extrinsics=f"{_stem(color)}/tf/0",
                depth_extrinsics=f"{_stem(depth)}/tf/0",
                units=f"{sensor}/option/Depth_Units/value",
            )
    if not cameras:
        raise FileFormatError(path, f"no camera with images of color and of depth among its topics {', '.join(types)}")
    return cameras


def _content(topic: str) -> str:
    """Return "color", "depth" or "" by the name of a topic."""
    low = topic.lower()
    return "depth" if "depth" in low else "color" if "color" in low or "rgb" in low else ""


def _camera(topic: str) -> str:
    """Return the part of a topic before its content, which names the camera."""
    parts = []
    for part in topic.strip("/").split("/"):
        if re.search("depth|color|rgb", part, re.I):
            break
        if not re.fullmatch(r"sensor_\d+", part):
            parts.append(part)
    return "-".join(parts) or "camera"


def _single(path: object, camera: str, kind: str, topics: list[str]) -> str:
    """Return the topic to read: aligned depth rather than other depth, raw images rather than compressed ones."""
    topics = [topic for topic in topics if "aligned" in topic] or topics
    topics = [topic for topic in topics if "compressed" not in topic.lower()] or topics
    if kind == "depth":  # the other compression squeezes depth into 8 bits
        topics = [topic for topic in topics if "compresseddepth" in topic.lower()] or topics
    if len(topics) > 1:
        raise FileFormatError(
            path,
            f"camera {camera!r} has several topics of {kind}: {', '.join(sorted(topics))}; leave out all but one: "
            "rosbags-convert --src BAG --dst FOLDER --exclude-topic TOPIC",
        )
    return topics[0]


def is_rectified(topic: str) -> bool:
    """Return whether the images of a topic are rectified, which ROS marks in its name: image_rect, image_rect_color."""
    return re.search(r"(?<![a-z])rect(?!or)", topic.lower()) is not None


def _stem(topic: str) -> str:
    """Return a topic without the suffixes of compression and of RealSense's recorder."""
    return re.sub(r"(/image/data|/[^/]+)$", "", re.sub(r"/(compressed|compressedDepth)$", "", topic))


def _info(image: str, types: Mapping[str, str]) -> str:
    """Return the topic of the CameraInfo of images: next to them, or as RealSense's recorders name it."""
    stem = _stem(image)
    topics = [f"{stem}/{suffix}" for suffix in ("camera_info", "info/camera_info", "image/camera_info")]
    return next((topic for topic in topics if types.get(topic) == CAMERA_INFO), topics[0])


@dataclass(frozen=True)
class MessageKey:
    """Key of a message: its topic, the time at which the bag got it, and its time stamp, nanoseconds."""

    topic: str
    received: int
    stamp: int


def match_moments(
    path: object, cameras: Mapping[str, CameraTopics], found: Mapping[str, Sequence[MessageKey]]
) -> tuple[list[dict[str, tuple[MessageKey, MessageKey]]], list[str]]:
    """Return the color and depth messages of every camera for each moment, and notes on what was left out.

    Raises:
        FileFormatError: A topic has no images, or no moment has images of all.
    """
    image_topics = [topic for topics in cameras.values() for topic in (topics.color, topics.depth)]
    for topic in image_topics:
        if not found[topic]:
            raise FileFormatError(path, f"has no images on {topic}")
    color_topics = [topics.color for topics in cameras.values()]
    longest = max(color_topics, key=lambda topic: len(found[topic]))
    shortest = min(color_topics, key=lambda topic: len(found[topic]))
    times = _seconds(found[shortest])
    partners = {topic: nearest_in_time(times, _seconds(found[topic]), _SAME_MOMENT) for topic in image_topics}
    complete = np.flatnonzero(np.all([partner >= 0 for partner in partners.values()], axis=0))
    if not len(complete):
        spans = ", ".join(f"{topic} {_span(messages)}" for topic, messages in found.items())
        raise FileFormatError(path, f"no moment has images of all cameras; do their clocks differ? {spans}")
    notes = clock_differences(cameras, found)
    if len(found[longest]) > len(times) + 1:  # one more is how a recording ends
        counts = f"{longest} has {len(found[longest])} images, {shortest} only {len(times)} ({_span(found[shortest])})"
        notes.append(f"{counts}; the others were left out")
    if len(complete) < len(times):
        lost = {t: int((partner < 0).sum()) for t, partner in partners.items() if (partner < 0).any()}
        listed = ", ".join(f"{count} on {topic}" for topic, count in lost.items())
        notes.append(f"{len(times) - len(complete)} of {len(times)} moments lack an image ({listed}) and were left out")
    moments = [
        {
            camera: (found[topics.color][partners[topics.color][k]], found[topics.depth][partners[topics.depth][k]])
            for camera, topics in cameras.items()
        }
        for k in complete
    ]
    return moments, notes


def clock_differences(cameras: Mapping[str, CameraTopics], found: Mapping[str, Sequence[MessageKey]]) -> list[str]:
    """Return a note if the cameras' clocks differ, at either end, by more than the delay of messages.

    Images of a video always have a partner near in time, even a wrong one; the times at which the bag got them reveal
    the difference.
    """
    delays = {
        camera: (_delay(found[topics.color][:_ENDS]), _delay(found[topics.color][-_ENDS:]))
        for camera, topics in cameras.items()
    }
    differences = [max(ends) - min(ends) for ends in zip(*delays.values(), strict=True)]
    if max(differences) < _MAX_DELAY:
        return []
    measured = f"{differences[0]:.2f} s at the beginning and {differences[1]:.2f} s at the end"
    return [
        f"the clocks of the cameras differ by {measured}, by when the bag got their images: images of one station may "
        "be of different moments; synchronize the clocks, or stand still at each station"
    ]


def _delay(messages: Sequence[MessageKey]) -> float:
    return float(np.median([message.received - message.stamp for message in messages])) / 1e9


def _seconds(messages: Iterable[MessageKey]) -> Array:
    return np.array([message.stamp for message in messages], dtype=np.float64) / 1e9


def _span(messages: Sequence[MessageKey]) -> str:
    return f"{messages[0].stamp / 1e9:.3f} to {messages[-1].stamp / 1e9:.3f} s" if messages else "never"
