"""Which images of a bag are of one moment, by their time stamps; drops, and clocks that run apart, are told."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from greenhouse_gym.capture.formats.topics import CameraTopics
from greenhouse_gym.capture.formats.videos import nearest_in_time
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array

_TOGETHER = 0.025  # s within which images are of one moment
_APART = 0.1  # s by which clocks differ that is no delay on the way to the bag
_ENDS = 30  # images at each end of a bag by which clocks are compared


@dataclass(frozen=True)
class Message:
    """Where a message is found: its topic, the time the bag has it at, and the time it was made, nanoseconds."""

    topic: str
    at: int
    stamp: int


def stations_of(
    path: object, cameras: Mapping[str, CameraTopics], found: Mapping[str, Sequence[Message]]
) -> tuple[list[dict[str, tuple[Message, Message]]], list[str]]:
    """For each moment the color and the depth message of every camera; and what was left out, a sentence each.

    Args:
        path: What to call the bag.
        cameras: The topics of each camera.
        found: The images of each topic, in the order of their stamps.

    Raises:
        FileFormatError: A topic has no images, or no moment has images of all.
    """
    for topics in cameras.values():
        for topic in (topics.color, topics.depth):
            if not found[topic]:
                raise FileFormatError(path, f"has no images on {topic}")
    most = max((topics.color for topics in cameras.values()), key=lambda topic: len(found[topic]))
    fewest = min((topics.color for topics in cameras.values()), key=lambda topic: len(found[topic]))
    times = _seconds(found[fewest])
    partners = {
        topic: nearest_in_time(times, _seconds(found[topic]), _TOGETHER)
        for topics in cameras.values()
        for topic in (topics.color, topics.depth)
    }
    whole = np.flatnonzero(np.all([partner >= 0 for partner in partners.values()], axis=0))
    if not len(whole):
        spans = ", ".join(f"{topic} {_span(messages)}" for topic, messages in found.items())
        raise FileFormatError(path, f"no moment has images of all cameras; do their clocks run apart? {spans}")
    notes = clocks_apart(cameras, found)
    if len(found[most]) > len(times) + 1:  # one more is how a recording ends
        counts = f"{most} has {len(found[most])} images, {fewest} only {len(times)} ({_span(found[fewest])})"
        notes.append(f"{counts}; the others were left out")
    if len(whole) < len(times):
        lost = {t: int((partner < 0).sum()) for t, partner in partners.items() if (partner < 0).any()}
        told = ", ".join(f"{count} on {topic}" for topic, count in lost.items())
        notes.append(f"{len(times) - len(whole)} of {len(times)} moments lack an image ({told}) and were left out")
    stations = [
        {
            camera: (found[topics.color][partners[topics.color][k]], found[topics.depth][partners[topics.depth][k]])
            for camera, topics in cameras.items()
        }
        for k in whole
    ]
    return stations, notes


def clocks_apart(cameras: Mapping[str, CameraTopics], found: Mapping[str, Sequence[Message]]) -> list[str]:
    """A sentence if the cameras' clocks differ, at either end, by more than images are late in the bag.

    Images of a video always have a partner near in time, even a wrong one; when the bag got them tells.
    """
    late = {
        camera: (_lateness(found[topics.color][:_ENDS]), _lateness(found[topics.color][-_ENDS:]))
        for camera, topics in cameras.items()
    }
    apart = [max(ends) - min(ends) for ends in zip(*late.values(), strict=True)]
    if max(apart) < _APART:
        return []
    told = f"{apart[0]:.2f} s in the beginning and {apart[1]:.2f} s in the end, by when the bag got their images"
    return [
        f"the clocks of the cameras differ by {told}: images of one station may be of different moments; synchronize "
        "the clocks, or stand still at each station"
    ]


def _lateness(messages: Sequence[Message]) -> float:
    return float(np.median([message.at - message.stamp for message in messages])) / 1e9


def _seconds(messages: Iterable[Message]) -> Array:
    return np.array([message.stamp for message in messages], dtype=np.float64) / 1e9


def _span(messages: Sequence[Message]) -> str:
    return f"{messages[0].stamp / 1e9:.3f} to {messages[-1].stamp / 1e9:.3f} s" if messages else "never"
