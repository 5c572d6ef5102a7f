"""Stations whose poses are known: a rig on rails, a camera on an arm, a tracked camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from greenhouse_gym.geometry import Array, invert, rotation_angle, transform
from greenhouse_gym.reconstruction.graph import Edge
from greenhouse_gym.reconstruction.icp import Alignment, align
from greenhouse_gym.reconstruction.registration import unconvincing
from greenhouse_gym.reconstruction.report import StationReport
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.views import StationView

_TRUSTED = np.diag([1 / 0.0035**2] * 3 + [1 / 0.002**2] * 3)  # one sigma: 0.2 degrees, 2 mm
_ASTRAY = 0.05, np.deg2rad(3.0)  # m, rad by which images may correct a given motion
_UNKNOWN = "its pose is not known"


def place_as_given(
    i: int,
    view: StationView,
    segment: Sequence[int],
    views: Mapping[int, StationView],
    settings: ReconstructionSettings,
) -> tuple[StationReport, dict[int, Edge]]:
    """Join a station to those before it by the poses that are known, refined by what was seen where that is asked for.

    Args:
        i: Its number.
        view: What it sees.
        segment: The stations before it.
        views: Views of the last of those stations, by their numbers.
        settings: All settings.
    """
    if view.world_from_station is None:
        return StationReport(i, False, reason=_UNKNOWN), {}
    blind = tuple(name for name, camera in view.cameras.items() if not camera.foreground.any())
    if not segment:
        return StationReport(i, True, segment=i, blind=blind), {}
    edges: dict[int, Edge] = {}
    nearest: Alignment | None = None
    for steps, earlier in enumerate(reversed(segment), start=1):
        if steps > 1 and (steps not in settings.links or settings.poses == "given"):
            continue
        if earlier not in views:
            break
        known = views[earlier].world_from_station
        assert known is not None
        motion = invert(known) @ view.world_from_station
        found = None if settings.poses == "given" else refined(views[earlier], view, motion, settings)
        if found is not None:
            edges[earlier] = Edge(np.round(found.first_from_second, 9), found.information)
        elif steps == 1:
            edges[earlier] = Edge(motion, _TRUSTED)
        nearest = found if steps == 1 else nearest
    fitness, rmse = (nearest.fitness, nearest.rmse) if nearest else (None, None)
    report = StationReport(i, True, segment[-1], "", None, fitness, rmse, segment[0], blind)
    return report, edges


def refined(
    first: StationView, second: StationView, motion: Array, settings: ReconstructionSettings
) -> Alignment | None:
    """What the images make of a motion (4, 4) that is about right; None where they do not tell."""
    found = align(first, second.sample, motion, settings)
    head = second.reference.camera.rig_from_camera[None, :3, 3]
    astray = np.linalg.norm(transform(found.first_from_second, head) - transform(motion, head))
    turned = rotation_angle(found.first_from_second[:3, :3].T @ motion[:3, :3])
    told = not unconvincing(found, settings) and astray < _ASTRAY[0] and turned < _ASTRAY[1]
    return found if told else None
