"""Whether the cameras stand as the rig says: what two of them see of the same place must be at the same depth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, permutations

import numpy as np

from greenhouse_gym.capture.frames import RgbdFrame, Station
from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.geometry import Array, invert, transform

_FARTHEST = 1.5  # m
_EVERY = 6  # rows and columns of an image that are compared
_SAME = 0.03  # m
_FEWEST = 200  # readings that two cameras must share
_BETTER = 0.15  # share of readings by which another explanation must fit better
_TIED = 0.05  # share of readings by which two explanations cannot be told apart

Frames = Mapping[str, RgbdFrame]


def mounting_doubts(rig: Rig, stations: Sequence[Station]) -> tuple[str, ...]:
    """What may be wrong with how the cameras stand, a phrase each; nothing where no other explanation fits much better.

    Looked for are two cameras that were swapped, and images that are upside down, of one camera or of all. On a rig
    that looks the same when it is turned around, the two cannot be told apart.
    """
    as_told = _agreement(rig, [station.frames for station in stations])
    if as_told is None:
        return ()
    found = {text: _agreement(rig, changed) for text, changed in _others(stations)}
    shares = {text: share for text, share in found.items() if share is not None and share > as_told + _BETTER}
    return tuple(text for text, share in shares.items() if share > max(shares.values()) - _TIED)


def _others(stations: Sequence[Station]) -> Iterator[tuple[str, Sequence[Frames]]]:
    """Other explanations, each with the stations as they then would be."""
    names = list(stations[0].frames)
    for one, other in combinations(names, 2):
        changed = {one: other, other: one}
        swapped = [{name: s.frames[changed.get(name, name)] for name in names} for s in stations]
        yield f"the cameras {one} and {other} seem to be swapped", swapped
    for name in names:
        text = f"the images of camera {name} seem to be upside down"
        yield text, [_turned(station.frames, [name]) for station in stations]
    yield "all images seem to be upside down", [_turned(s.frames, names) for s in stations]


def _turned(frames: Frames, names: Sequence[str]) -> Frames:
    return {name: _upside_down(frame) if name in names else frame for name, frame in frames.items()}


def _upside_down(frame: RgbdFrame) -> RgbdFrame:
    return RgbdFrame(frame.color[::-1, ::-1], frame.depth[::-1, ::-1], frame.intrinsics)


def _agreement(rig: Rig, stations: Sequence[Frames]) -> float | None:
    """Share of the readings seen by two cameras at which both tell about the same depth; None if there are too few."""
    same = seen = 0
    for frames in stations:
        for one, other in permutations(frames, 2):
            there = frames[other]
            points = _some_points(frames[one])
            moved = transform(invert(rig.cameras[other].rig_from_camera) @ rig.cameras[one].rig_from_camera, points)
            kept, rows, columns = there.intrinsics.project(moved)
            depth = there.depth[rows, columns]
            read = depth > 0
            seen += int(np.count_nonzero(read))
            same += int(np.count_nonzero(np.abs(depth[read] - moved[kept[read], 2]) < _SAME))
    return same / seen if seen >= _FEWEST else None


def _some_points(frame: RgbdFrame) -> Array:
    grid = np.zeros(frame.depth.shape, dtype=bool)
    grid[::_EVERY, ::_EVERY] = True
    return frame.points(grid & (frame.depth < _FARTHEST))
