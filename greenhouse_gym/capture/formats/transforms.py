"""Where a frame is by the transforms of a bag: those that stand still, and those that move."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from greenhouse_gym.capture.formats.messages import pose_from
from greenhouse_gym.capture.formats.videos import nearest_in_time
from greenhouse_gym.geometry import Array, invert

Frames = Mapping[str, tuple[str, Array]]
"""The parent of each frame, and its pose (4, 4) in that."""


class Edge(NamedTuple):
    """A frame that moves: its parent, times (n,) in seconds in their order, and poses (n, 4, 4) in the parent."""

    parent: str
    times: Array
    poses: Array


def poses_of(messages: Iterable[Any]) -> dict[str, tuple[str, Array]]:
    """The frames of messages of /tf_static."""
    return {child: (parent, place) for message in messages for _, child, parent, place in _transforms(message)}


def moving_frames(messages: Iterable[Any]) -> dict[str, Edge]:
    """The frames of messages of /tf."""
    told: dict[str, list[tuple[float, str, Array]]] = {}
    for message in messages:
        for time, child, parent, place in _transforms(message):
            told.setdefault(child, []).append((time, parent, place))
    return {child: _edge(entries) for child, entries in told.items()}


def _transforms(message: Any) -> Iterable[tuple[float, str, str, Array]]:
    """Time in seconds, frame, its parent and pose of each transform of a message."""
    for each in message.transforms:
        stamp, moved = each.header.stamp, each.transform
        place = pose_from(moved.translation, moved.rotation)
        yield stamp.sec + 1e-9 * stamp.nanosec, bare(each.child_frame_id), bare(each.header.frame_id), place


def bare(frame: str) -> str:
    """A frame's name as ROS 2 has it: that of ROS 1 may begin with a slash."""
    return frame.lstrip("/")


def _edge(entries: list[tuple[float, str, Array]]) -> Edge:
    entries.sort(key=lambda each: each[0])
    return Edge(entries[0][1], np.array([time for time, _, _ in entries]), np.array([place for _, _, place in entries]))


def track(frame: str, still: Frames, moving: Mapping[str, Edge]) -> tuple[Array, Array]:
    """Times (n,) and poses (n, 4, 4) of a frame in the frame above all; none where nothing on the way there moves."""
    chain: list[Edge | Array] = []
    passed = {frame}
    while (edge := moving.get(frame) or still.get(frame)) and edge[0] not in passed:
        chain.append(edge if isinstance(edge, Edge) else edge[1])
        frame = edge[0]
        passed.add(frame)
    moves = [edge for edge in chain if isinstance(edge, Edge)]
    if not moves:
        return np.zeros(0), np.zeros((0, 4, 4))
    times = max((edge.times for edge in moves), key=len)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    for each in chain:
        here = each.poses[nearest_in_time(times, each.times, np.inf)] if isinstance(each, Edge) else each
        poses = here @ poses
    return times, poses


def between(frames: dict[str, tuple[str, Array]], target: str, source: str) -> Array | None:
    """(4, 4) target_from_source by the tree of frames; None where it does not join the two."""
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
