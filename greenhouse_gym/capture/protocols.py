"""Capture protocols: rigs, heights and distances by which a row is photographed, in one pass or several.

A plan holds in the plants only where the scan saw them. The paper's level beam at 1.1 m sees nothing above 1.5 m and
measures nothing nearer than 0.2 m, so leaves that hang into the aisle above the fruit stay unobserved. The other
protocols raise the beam, step back, or pass twice.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from types import MappingProxyType

import numpy as np

from greenhouse_gym.capture.recordings import Pass, Recording
from greenhouse_gym.capture.rig import SEED_RIG, Rig, Station, three_camera_rig
from greenhouse_gym.capture.simulated import CaptureSettings, simulate_recording
from greenhouse_gym.crops.crop import STEM_LINE, PlantRow
from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import pose


@dataclass(frozen=True, eq=False)
class CaptureProtocol:
    """Rigs and distances by which a row is photographed.

    Attributes:
        name: Its name in `PROTOCOLS`.
        summary: One sentence for listings.
        passes: The rig of each pass along the row: the same cameras at different heights.
        back: Distance of the tripod behind its usual line, which is half a metre from the stems, metres.
        depth: Distance behind the stems at which the foreground ends, metres; the paper cuts 10 cm behind them.
    """

    name: str
    summary: str
    passes: tuple[Rig, ...] = (SEED_RIG,)
    back: float = 0.0
    depth: float = 0.10

    @property
    def distance(self) -> float:
        """Distance from the cameras to the stems, metres."""
        return STEM_LINE + self.back

    @property
    def foreground(self) -> float:
        """Distance from the reference camera at which the foreground is cut, metres."""
        return round(self.distance + self.depth, 6)


_UPRIGHT = three_camera_rig(beam="upright", spacing=0.45, inward=0.0, height=1.3)
_KNOWN = (
    CaptureProtocol("paper", "a level beam at 1.1 m, half a metre from the stems, the outer cameras turned inward"),
    CaptureProtocol("upright", "an upright beam, cameras at 0.85, 1.3 and 1.75 m, none turned", (_UPRIGHT,)),
    CaptureProtocol("back", "the paper's beam 0.8 m from the stems", back=0.3),
    CaptureProtocol("upright-back", "the upright beam 0.8 m from the stems", (_UPRIGHT,), back=0.3, depth=0.2),
    CaptureProtocol(
        "two-passes",
        "the paper's beam twice, at 1.0 and at 1.5 m, joined into one cloud",
        (three_camera_rig(height=1.0), three_camera_rig(height=1.5)),
    ),
)

PROTOCOLS: Mapping[str, CaptureProtocol] = MappingProxyType({protocol.name: protocol for protocol in _KNOWN})
"""The protocols by name; ``paper`` is the default everywhere."""


def get_protocol(name: str | None) -> CaptureProtocol:
    """Return a protocol by name; None is the paper's.

    Raises:
        UnknownNameError: No protocol has that name.
    """
    return PROTOCOLS["paper" if name is None else require_choice("protocol", name, PROTOCOLS)]


def simulate_protocol(
    row: PlantRow,
    seed: int,
    protocol: str | CaptureProtocol = "paper",
    stations: int | None = None,
    settings: CaptureSettings | None = None,
) -> Recording:
    """Photograph a grown row by a protocol.

    Args:
        row: The row.
        seed: Seed of the tripod's motion, the camera biases and the noise.
        protocol: Name or protocol.
        stations: Number of stations of each pass; by default one every step over the row's length.
        settings: Tripod and sensor errors; the protocol sets the distance.

    Returns:
        A recording that names its protocol; its stations carry their true poses, those of the first pass first.

    Raises:
        UnknownNameError: No protocol has that name.
        InvalidValueError: ``stations`` is not positive, or ``seed`` is negative.
    """
    chosen = get_protocol(protocol) if isinstance(protocol, str) else protocol
    shifted = replace(settings or CaptureSettings(), back=chosen.back)
    # one rig carries one set of cameras, so every pass has the first one's depth errors
    passes = [
        simulate_recording(row, seed, rig, stations, shifted, pass_number=k) for k, rig in enumerate(chosen.passes)
    ]
    return replace(join_passes(passes), protocol=chosen.name)


def join_passes(passes: Sequence[Recording]) -> Recording:
    """Join passes of one rig at several heights into one recording, the first pass's stations first.

    Each pass begins at about the same position. The joined recording has the first pass's rig; the frame of a station
    of a later pass is raised with the rig, and the recording gives the lift (`Recording.passes`).

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
    joined = tuple(map(Pass, starts, lifts))
    return Recording(first.name, first.rig, ends[-1], load, protocol=first.protocol, passes=joined, truth=first.truth)


def _station(passes: Sequence[Recording], starts: Sequence[int], lifts: Sequence[float], i: int) -> Station:
    """Return station ``i`` of all passes, raised with its rig."""
    k = bisect_right(starts, i) - 1
    station = passes[k][i - starts[k]]
    known = station.world_from_station
    return Station(station.frames, None if known is None else known @ pose(translation=[0.0, 0.0, lifts[k]]))


def _lift(first: Recording, later: Recording) -> float:
    """Return the height of the later recording's rig above the first one's, metres."""
    if first.rig.cameras.keys() != later.rig.cameras.keys() or first.rig.reference != later.rig.reference:
        raise InvalidValueError(
            f"recordings {first.name!r} and {later.name!r} have the cameras {_names(first.rig)} and "
            f"{_names(later.rig)}: expected the same, and the same reference"
        )
    lifts = []
    for name, camera in first.rig.cameras.items():
        other = later.rig.cameras[name]
        if camera.intrinsics != other.intrinsics or camera.depth_scale != other.depth_scale:
            raise InvalidValueError(f"camera {name!r} of {first.name!r} and of {later.name!r} differ in intrinsics")
        difference = other.rig_from_camera - camera.rig_from_camera
        lifts.append(float(difference[2, 3]))
        difference[2, 3] = 0.0
        if np.abs(difference).max() > 1e-6 or abs(lifts[-1] - lifts[0]) > 1e-6:
            raise InvalidValueError(
                f"camera {name!r} of {later.name!r} is not straight above that of {first.name!r}: expected rigs that "
                "differ only in their height"
            )
    return round(lifts[0], 9)


def _names(rig: Rig) -> str:
    return ", ".join(f"{name}{' (reference)' * (name == rig.reference)}" for name in rig.cameras)
