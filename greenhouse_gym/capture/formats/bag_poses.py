"""Poses of a rig in a bag: their topic, and the frame to which they belong.

Bags hold poses of other things as well: markers in view, goals, the arm. A pose relative to a frame that moves with the
camera is none of the rig; odometry goes before other poses; then the topic with poses for most images is taken.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from greenhouse_gym.capture.formats.image_lists import POSE_TOLERANCE, nearest_in_time
from greenhouse_gym.capture.formats.ros_messages import StaticFrames, bare_name, pose_of
from greenhouse_gym.capture.formats.single_camera import RIG_FROM_CAMERA
from greenhouse_gym.geometry import Array

ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
"""Types of messages with the pose of a rig: x forward, z up, as in a rig's frame here."""

_ON_CAMERA = re.compile(r"optical|^cam(era)?\d*([_-]\w+)?[_-](link|frame)$|^cam(era)?\d*$")  # as drivers name frames
_WORLD = re.compile(r"map|odom|world|earth")


class TimedPoses(NamedTuple):
    """Poses of the rig frame.

    Attributes:
        times: (n,) seconds, sorted.
        poses: (n, 4, 4) world_from_rig.
        of_camera: True if they are known of the reference camera, around which a rig frame is assumed.
        notes: Sentences on the topics that were taken and left out.
    """

    times: Array
    poses: Array
    of_camera: bool
    notes: tuple[str, ...]


class PoseTopic(NamedTuple):
    """Messages of a topic with poses.

    Attributes:
        topic: Its name.
        kind: Type of the messages.
        parent: The frame in which the poses are.
        child: The frame that has them; empty if unknown.
        times: (n,) seconds, sorted.
        poses: (n, 4, 4) parent_from_child.
    """

    topic: str
    kind: str
    parent: str
    child: str
    times: Array
    poses: Array

    @classmethod
    def of(cls, topic: str, kind: str, messages: Iterable[tuple[float, Any]]) -> PoseTopic | None:
        """Return a topic from its messages and their times in seconds; None if it has none."""
        timed = sorted(messages, key=lambda each: each[0])
        if not timed:
            return None
        first = timed[0][1]
        parent, child = bare_name(first.header.frame_id), bare_name(getattr(first, "child_frame_id", ""))
        matrices = np.array([pose_of(message) for _, message in timed])
        return cls(topic, kind, parent, child, np.array([time for time, _ in timed]), matrices)


def rig_poses(topics: Sequence[PoseTopic], camera_frame: str, static: StaticFrames, images: Array) -> TimedPoses | None:
    """Return the poses of the rig; None if no topic gives any.

    Args:
        topics: All topics with poses.
        camera_frame: Frame of the reference camera's images.
        static: Frames that do not move against their parents.
        images: (m,) times of the images, seconds.
    """
    attached = _attached(camera_frame, static)
    left_out = [each for each in topics if each.parent in attached or _moves(each.parent)]
    counted = [(each, _count(each, images)) for each in topics if each not in left_out]
    usable = sorted(
        (each for each in counted if each[1]),
        key=lambda each: (each[0].kind != ODOMETRY, each[0].child not in attached, -each[1], each[0].topic),
    )
    notes = [
        f"the poses on {each.topic} are not of the rig: their frame {each.parent!r} moves with it" for each in left_out
    ]
    if not usable:
        return TimedPoses(np.zeros(0), np.zeros((0, 4, 4)), True, tuple(notes)) if notes else None
    chosen = usable[0][0]
    if len(topics) > 1 or chosen.kind != ODOMETRY:
        others = ", ".join(each.topic for each, _ in usable[1:])
        notes.insert(
            0, f"the poses of the rig are those on {chosen.topic}" + (f", not those on {others}" if others else "")
        )
    of_camera = chosen.child == camera_frame or (bool(chosen.child) and "optical" in chosen.child)
    poses = chosen.poses @ RIG_FROM_CAMERA.T if of_camera else chosen.poses
    return TimedPoses(chosen.times, poses, of_camera, tuple(notes))


def _count(topic: PoseTopic, images: Array) -> int:
    """Return the number of images at whose time the topic has a pose."""
    return int((nearest_in_time(images, topic.times, POSE_TOLERANCE) >= 0).sum())


def _moves(frame: str) -> bool:
    """Return whether a frame is on a camera by its name."""
    return bool(_ON_CAMERA.search(frame)) and not _WORLD.search(frame)


def _attached(frame: str, static: StaticFrames) -> set[str]:
    """Return the frames that do not move against a frame, with itself."""
    neighbors: dict[str, set[str]] = {}
    for child, (parent, _) in static.items():
        neighbors.setdefault(child, set()).add(parent)
        neighbors.setdefault(parent, set()).add(child)
    found, waiting = {frame}, [frame]
    while waiting:
        new = {each for each in neighbors.get(waiting.pop(), set()) - found if not _WORLD.search(each)}
        found |= new
        waiting += new
    return found
