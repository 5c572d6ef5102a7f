"""Several walks of one rig along a row, raised between them, as one recording."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from functools import partial
from itertools import accumulate

import numpy as np

from greenhouse_gym.capture.frames import Station
from greenhouse_gym.capture.recordings import Pass, Recording
from greenhouse_gym.capture.rig import Rig
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import pose


def join_passes(passes: Sequence[Recording]) -> Recording:
    """Walks of one rig at several heights as one recording, the first walk's stations first.

    Each walk begins at about the same place. The joined recording has the first walk's rig; the frame of a station of a
    later walk is raised with the rig, and the recording says by how much (`Recording.passes`).

    Args:
        passes: Recordings by rigs that differ only in their height above the floor.

    Raises:
        InvalidValueError: No recording, or rigs of different cameras or intrinsics, or turned or shifted otherwise.
    """
    if not passes:
        raise InvalidValueError("expected at least one recording to join")
    first = passes[0]
    if len(passes) == 1:
        return first
    lifts = [_lift(first, later) for later in passes]
    ends = list(accumulate(len(one) for one in passes))
    starts = [0, *ends[:-1]]

    load = partial(_station, passes, starts, lifts)
    return Recording(
        first.name, first.rig, ends[-1], load, protocol=first.protocol, passes=tuple(map(Pass, starts, lifts)),
        truth=first.truth,
    )  # fmt: skip


def _station(passes: Sequence[Recording], starts: Sequence[int], lifts: Sequence[float], i: int) -> Station:
    """Station i of all passes, raised with its rig."""
    k = bisect_right(starts, i) - 1
    station = passes[k][i - starts[k]]
    known = station.world_from_station
    return Station(station.frames, None if known is None else known @ pose(translation=[0.0, 0.0, lifts[k]]))


def _lift(first: Recording, later: Recording) -> float:
    """How much higher the later recording's rig stands, metres."""
    if first.rig.cameras.keys() != later.rig.cameras.keys() or first.rig.reference != later.rig.reference:
        raise InvalidValueError(
            f"recordings {first.name!r} and {later.name!r} have the cameras {_names(first.rig)} and "
            f"{_names(later.rig)}: expected the same, and the same reference"
        )
    lifts = []
    for name, camera in first.rig.cameras.items():
        other = later.rig.cameras[name]
        if camera.intrinsics != other.intrinsics or camera.depth_scale != other.depth_scale:
            raise InvalidValueError(f"camera {name!r} of {first.name!r} and of {later.name!r} has other intrinsics")
        difference = other.rig_from_camera - camera.rig_from_camera
        lifts.append(float(difference[2, 3]))
        difference[2, 3] = 0.0
        if np.abs(difference).max() > 1e-6 or abs(lifts[-1] - lifts[0]) > 1e-6:
            raise InvalidValueError(
                f"camera {name!r} of {later.name!r} is not where that of {first.name!r} is raised to: expected rigs "
                "that differ only in their height"
            )
    return round(lifts[0], 9)


def _names(rig: Rig) -> str:
    return ", ".join(f"{name}{' (reference)' * (name == rig.reference)}" for name in rig.cameras)
