"""Which topics of a bag belong to which camera, by how cameras name them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from greenhouse_gym.capture.formats.messages import INFO, KINDS
from greenhouse_gym.errors import FileFormatError


@dataclass(frozen=True)
class CameraTopics:
    """The topics of one camera: images, their CameraInfo, and what RealSense's recorder tells besides."""

    color: str
    depth: str
    color_info: str
    depth_info: str
    color_place: str
    depth_place: str
    units: str

    @property
    def once(self) -> tuple[str, ...]:
        """Topics of which one message is enough."""
        return (self.color_info, self.depth_info, self.color_place, self.depth_place, self.units)


def cameras_of(path: object, types: Mapping[str, str]) -> dict[str, CameraTopics]:
    """The cameras of a bag, by name, from its topics and their types.

    Raises:
        FileFormatError: There is no camera with color and depth, or one with two topics of the same.
    """
    images: dict[str, dict[str, list[str]]] = {}
    for topic, kind in types.items():
        if kind in KINDS and (what := _what(topic)):
            images.setdefault(_camera(topic), {}).setdefault(what, []).append(topic)
    cameras = {}
    for camera, both in images.items():
        if both.keys() == {"color", "depth"}:
            color, depth = (_one(path, camera, what, both[what]) for what in ("color", "depth"))
            cameras[camera] = CameraTopics(
                color, depth, _info(color, types), _info(depth, types), f"{_stem(color)}/tf/0", f"{_stem(depth)}/tf/0",
                f"{_stem(depth).rsplit('/', 1)[0]}/option/Depth_Units/value",
            )  # fmt: skip
    if not cameras:
        raise FileFormatError(path, f"no camera with images of color and of depth among its topics {', '.join(types)}")
    return cameras


def _what(topic: str) -> str:
    """Whether a topic shows color or depth, or ""."""
    low = topic.lower()
    return "depth" if "depth" in low else "color" if "color" in low or "rgb" in low else ""


def _camera(topic: str) -> str:
    """The part of a topic before what it shows."""
    parts = []
    for part in topic.strip("/").split("/"):
        if re.search("depth|color|rgb", part, re.I):
            break
        if not re.fullmatch(r"sensor_\d+", part):
            parts.append(part)
    return "-".join(parts) or "camera"


def _one(path: object, camera: str, what: str, topics: list[str]) -> str:
    """The topic to read: depth aligned to color before other depth, raw images before compressed ones."""
    topics = [topic for topic in topics if "aligned" in topic] or topics
    topics = [topic for topic in topics if "compressed" not in topic.lower()] or topics
    if len(topics) > 1:
        raise FileFormatError(
            path,
            f"camera {camera!r} has several topics of {what}: {', '.join(sorted(topics))}; leave out all but one: "
            "rosbags-convert --src BAG --dst FOLDER --exclude-topic TOPIC",
        )
    return topics[0]


def _stem(topic: str) -> str:
    """A topic without its last part; that of a compression, and what RealSense's recorder adds, go with it."""
    return re.sub(r"(/image/data|/[^/]+)$", "", re.sub(r"/(compressed|compressedDepth)$", "", topic))


def _info(image: str, types: Mapping[str, str]) -> str:
    """The topic of the CameraInfo that belongs to images: beside them, or where RealSense's recorders have it."""
    stem = _stem(image)
    places = [f"{stem}/{place}" for place in ("camera_info", "info/camera_info", "image/camera_info")]
    return next((place for place in places if types.get(place) == INFO), places[0])
