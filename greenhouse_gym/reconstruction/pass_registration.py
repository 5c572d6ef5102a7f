"""Registration of the passes of a recording: stations at equal positions along the row, across the lift."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from greenhouse_gym.capture.recordings import Pass, Recording
from greenhouse_gym.errors import ReconstructionError
from greenhouse_gym.geometry import Array, invert, pose, rotation_angle, transform
from greenhouse_gym.reconstruction.icp import IcpResult, fine_icp
from greenhouse_gym.reconstruction.pair_registration import alignment_problem, coarse_icp_from_afar
from greenhouse_gym.reconstruction.pose_graph import PoseEdge, PoseEdges
from greenhouse_gym.reconstruction.report import StationReport
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.station_views import Calibration, StationView, station_view

_EVERY = 3  # stations of a later pass from one that is registered to the passes before to the next
_START_OFFSETS = (0.0, 0.05, -0.05, 0.10, -0.10)  # m between the starts of a pass and of the first one
_MAX_CORRECTION = 0.10  # m from the start of a registration to its result

_GIVEN_INFORMATION = np.diag([1 / 0.0035**2] * 3 + [1 / 0.002**2] * 3)  # one sigma: 0.2 degrees, 2 mm
_MAX_DEVIATION = 0.05, np.deg2rad(3.0)  # m, rad by which images may correct a given motion


def pass_index(passes: Sequence[Pass], station: int) -> int:
    """Return the number of the pass that a station belongs to."""
    return sum(station >= one.first for one in passes) - 1


def register_passes(
    recording: Recording,
    calibration: Calibration,
    segments: Sequence[tuple[int, ...]],
    edges: PoseEdges,
    settings: ReconstructionSettings,
) -> tuple[tuple[tuple[int, ...], ...], dict[tuple[int, int], PoseEdge]]:
    """Register the longest segment of each later pass to those of the passes before.

    Segments come with the longest first; none spans two passes. ``edges`` are the accepted registrations within passes.

    Returns:
        The segments, the joined one first, and the edges between its passes.

    Raises:
        ReconstructionError: A pass has no segment long enough, or overlaps with none before it.
    """
    longest: list[tuple[int, ...]] = []
    for number in range(len(recording.passes)):
        own = [segment for segment in segments if pass_index(recording.passes, segment[0]) == number]
        if not own:
            raise ReconstructionError(
                f"recording {recording.name!r}: too few stations of pass {number} could be registered to each other"
            )
        longest.append(own[0])
    views: dict[int, StationView] = {}

    def view(station: int) -> StationView:
        if station not in views:
            views[station] = station_view(recording[station], calibration, settings)
        return views[station]

    along = {
        station: position
        for segment, one in zip(longest, recording.passes, strict=True)
        for station, position in _positions_along(segment, one, edges, recording).items()
    }
    found: dict[tuple[int, int], PoseEdge] = {}
    for number in range(1, len(longest)):
        before = [station for segment in longest[:number] for station in segment]
        offsets: tuple[float, ...] = _START_OFFSETS
        reasons: list[str] = []
        for later in longest[number][::_EVERY]:
            earlier = min(before, key=lambda i: abs(along[i] - along[later]))
            lift = recording.passes[number].lift - recording.passes[pass_index(recording.passes, earlier)].lift
            for offset in offsets:
                start = pose(translation=[0.0, along[later] - along[earlier] + offset, lift])
                edge = _register_near(view(earlier), view(later), start, settings)
                if isinstance(edge, PoseEdge):
                    found[earlier, later] = edge
                    offsets = (offset,)
                    break
                reasons.append(f"station {later} to {earlier}: {edge}")
        if not any(later in longest[number] for _, later in found):
            raise ReconstructionError(
                f"recording {recording.name!r}: pass {number} overlaps with no pass before it. {'; '.join(reasons)}"
            )
    joined = tuple(station for segment in longest for station in segment)
    return (joined, *(segment for segment in segments if segment not in longest)), found


def _positions_along(segment: Sequence[int], one: Pass, edges: PoseEdges, recording: Recording) -> dict[int, float]:
    """Return the distance along the row of each station of a segment from the start of its pass, metres."""
    head = recording.rig.cameras[recording.rig.reference].rig_from_camera[:3, 3]
    steps = [(transform(edges[pair].first_from_second, head[None])[0] - head)[1] for pair in pairwise(segment)]
    positions = np.concatenate([[0.0], np.cumsum(steps)])
    stride = positions[-1] / max(1, segment[-1] - segment[0])
    return dict(zip(segment, (positions + stride * (segment[0] - one.first)).tolist(), strict=True))


def _register_near(
    first: StationView, second: StationView, start: Array, settings: ReconstructionSettings
) -> PoseEdge | str:
    """Register two stations whose motion (4, 4) is known to a few centimetres; a refusal is its reason."""
    found = fine_icp(first, second.sample, coarse_icp_from_afar(first, second, start), settings)
    moved = np.round(found.first_from_second, 9)
    head = second.reference.camera.rig_from_camera[None, :3, 3]
    correction = float(np.linalg.norm(transform(moved, head) - transform(start, head)))
    reason = alignment_problem(found, settings)
    if not reason and (correction > _MAX_CORRECTION or rotation_angle(moved[:3, :3]) > settings.max_rotation):
        reason = f"ICP moved it by {100 * correction:.0f} cm"
    return reason or PoseEdge(moved, found.information)


def register_given_pose(
    i: int,
    view: StationView,
    segment: Sequence[int],
    views: Mapping[int, StationView],
    settings: ReconstructionSettings,
) -> tuple[StationReport, dict[int, PoseEdge]]:
    """Register station ``i`` to those of its segment by its given pose, refined by the images if the settings say so.

    ``views`` holds the last of the segment's stations by their numbers.
    """
    if view.world_from_station is None:
        return StationReport(i, False, reason="its pose is not known"), {}
    if not segment:
        return StationReport(i, True, segment=i, blind=view.blind), {}
    edges: dict[int, PoseEdge] = {}
    nearest: IcpResult | None = None
    for steps, earlier in enumerate(reversed(segment), start=1):
        if steps > 1 and (steps not in settings.links or settings.poses == "given"):
            continue
        if earlier not in views:
            break
        known = views[earlier].world_from_station
        assert known is not None
        motion = invert(known) @ view.world_from_station
        found = None if settings.poses == "given" else _refine_motion(views[earlier], view, motion, settings)
        if found is not None:
            edges[earlier] = PoseEdge(np.round(found.first_from_second, 9), found.information)
        elif steps == 1:
            edges[earlier] = PoseEdge(motion, _GIVEN_INFORMATION)
        nearest = found if steps == 1 else nearest
    fitness, rmse = (nearest.fitness, nearest.rmse) if nearest else (None, None)
    return StationReport(i, True, segment[-1], "", None, fitness, rmse, segment[0], view.blind), edges


def _refine_motion(
    first: StationView, second: StationView, motion: Array, settings: ReconstructionSettings
) -> IcpResult | None:
    """Refine a motion (4, 4) by the images; None where they do not constrain it or correct it too far."""
    found = fine_icp(first, second.sample, motion, settings)
    head = second.reference.camera.rig_from_camera[None, :3, 3]
    shift = np.linalg.norm(transform(found.first_from_second, head) - transform(motion, head))
    turn = rotation_angle(found.first_from_second[:3, :3].T @ motion[:3, :3])
    accepted = not alignment_problem(found, settings) and shift < _MAX_DEVIATION[0] and turn < _MAX_DEVIATION[1]
    return found if accepted else None
