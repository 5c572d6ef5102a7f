"""Stations with known poses: a rig on rails, a camera on an arm, a tracked camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from greenhouse_gym.geometry import Array, invert, rotation_angle, transform
from greenhouse_gym.reconstruction.icp import IcpResult, fine_icp
from greenhouse_gym.reconstruction.pair_registration import alignment_problem
from greenhouse_gym.reconstruction.pose_graph import PoseEdge
from greenhouse_gym.reconstruction.report import StationReport
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.station_views import StationView

_GIVEN_INFORMATION = np.diag([1 / 0.0035**2] * 3 + [1 / 0.002**2] * 3)  # one sigma: 0.2 degrees, 2 mm
_MAX_CORRECTION = 0.05, np.deg2rad(3.0)  # m, rad by which images may correct a given motion


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
    accepted = not alignment_problem(found, settings) and shift < _MAX_CORRECTION[0] and turn < _MAX_CORRECTION[1]
    return found if accepted else None
