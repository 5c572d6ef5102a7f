"""Register one station to another: silhouettes, mean offset of the shared pixels, ICP from there, acceptance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from greenhouse_gym.capture.frames import RgbdFrame, Station
from greenhouse_gym.capture.rig import Camera, Rig
from greenhouse_gym.geometry import Array, pose, rotation_angle, transform
from greenhouse_gym.open3d_loader import open3d
from greenhouse_gym.reconstruction.clouds import Cloud, station_cloud, thin_out, to_open3d
from greenhouse_gym.reconstruction.foreground import foreground_mask
from greenhouse_gym.reconstruction.icp import Surface, align
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.shift import Shift, along, best_shift, overlap


@dataclass(frozen=True, eq=False)
class StationView:
    """What registration needs to know of a station.

    Attributes:
        frame: The reference camera's image; None once it is no longer needed.
        cloud: All cameras' foreground in the rig frame, at the merged cloud's density.
        surface: The same, a little thinner, for others to be registered to.
        source: The same, thinner still, to be registered to others.
    """

    frame: RgbdFrame | None
    cloud: Cloud
    surface: Surface
    source: Cloud


class Registration(NamedTuple):
    """How a station was registered to an earlier one, or why it was not.

    Attributes:
        first_from_second: (4, 4) pose of the second station's rig frame in the first's.
        accepted: Whether it passed every check.
        reason: Why not, or "".
        shift: The best shift of the silhouettes, if any.
        offset: (3,) mean offset of the shared pixels in the rig frame, metres: where ICP started.
        fitness: Share of points with a partner within the fine distance.
        rmse: Root mean square distance of those partners, metres.
        information: (6, 6) information matrix for the pose graph.
    """

    first_from_second: Array
    accepted: bool
    reason: str
    shift: Shift | None = None
    offset: Array | None = None
    fitness: float = 0.0
    rmse: float = float("nan")
    information: Array | None = None


def view_station(
    station: Station, rig: Rig, settings: ReconstructionSettings, bias: Mapping[str, float] | None = None
) -> StationView:
    """Prepare a station for registration and merging; ``bias`` is the cameras' relative depth error by name."""
    cloud = station_cloud(station, rig, settings, bias)
    return StationView(
        station.frames[rig.reference],
        cloud,
        Surface(thin_out(cloud, settings.surface_voxel)),
        thin_out(cloud, settings.register_voxel),
    )


def row_axis(camera: Camera) -> int:
    """The image axis along which the row passes: the one that lies closer to the rig's y."""
    rows_along_y, columns_along_y = abs(camera.rig_from_camera[1, 1]), abs(camera.rig_from_camera[1, 0])
    return 0 if rows_along_y >= columns_along_y else 1


def silhouette_shift(
    first: RgbdFrame, second: RgbdFrame, camera: Camera, steps: int, settings: ReconstructionSettings
) -> Shift | str:
    """The best shift between two reference images ``steps`` stations apart, or why there is none."""
    one, two = (foreground_mask(frame, settings.foreground) for frame in (first, second))
    for which, mask in (("first", one), ("second", two)):
        if mask.mean() < settings.min_foreground:
            return f"the {which} image has {mask.mean():.1%} foreground, less than {settings.min_foreground:.0%}"
    axis = row_axis(camera)
    focal = camera.intrinsics.fy if axis == 0 else camera.intrinsics.fx
    distance = float(np.median(second.depth[two]))
    low, high = settings.step_range
    found = best_shift(
        one, two, axis,
        shortest=int(low * steps * focal / settings.foreground),
        longest=int(min(high * steps, settings.longest_gap) * focal / distance),
        step=settings.shift_step,
    )  # fmt: skip
    if found is None:
        return "no shift leaves any foreground to compare"
    if found.difference > settings.max_shift_difference:
        return f"silhouettes differ by {found.difference:.0%} at the best shift"
    return found


def mean_offset(first: RgbdFrame, second: RgbdFrame, shift: Shift, settings: ReconstructionSettings) -> Array | None:
    """The paper's mean XYZ distance of the pixels both silhouettes share after the shift.

    Pixels that hit different things (their depths differ by more than 5 cm) are left out.

    Returns:
        (3,) metres in the camera frame, what to add to a point of the second image; None if nothing is shared.
    """
    a, b = overlap(first.depth, shift.pixels, shift.axis)
    one, two = first.depth[along(shift.axis, a)], second.depth[along(shift.axis, b)]
    farthest = settings.foreground
    shared = (one > 0) & (one < farthest) & (two > 0) & (two < farthest) & (np.abs(one - two) < 0.05)
    if not shared.any():
        return None
    rows, columns = np.nonzero(shared)
    starts = ((a.start, 0), (b.start, 0)) if shift.axis == 0 else ((0, a.start), (0, b.start))
    here, there = (
        frame.back_project(rows + row, columns + column)
        for frame, (row, column) in zip((first, second), starts, strict=True)
    )
    return np.asarray((here - there).mean(axis=0))


def coarse_icp(first: Cloud, second: Cloud, start: Array, settings: ReconstructionSettings) -> Array:
    """Open3D's point-to-plane ICP from ``start`` at the coarse distance: first_from_second."""
    registration = open3d().pipelines.registration
    result = registration.registration_icp(
        to_open3d(second), to_open3d(first), settings.coarse_distance, start,
        registration.TransformationEstimationPointToPlane(),
        registration.ICPConvergenceCriteria(max_iteration=settings.icp_iterations),
    )  # fmt: skip
    return np.round(np.array(result.transformation), 9)  # the last bits depend on Open3D's threads


def refine(
    first: StationView, second: StationView, start: Array, rig: Rig, steps: int, settings: ReconstructionSettings
) -> Registration:
    """Fine ICP from a start pose, and the checks that accept or refuse its result."""
    result = align(first.surface, second.source, start, settings)
    first_from_second = np.round(result.first_from_second, 9)
    head = rig.cameras[rig.reference].rig_from_camera[:3, 3]
    reason = implausible(first_from_second, head, steps, settings)
    if result.fitness < settings.min_fitness:
        reason = f"fitness {result.fitness:.2f} below {settings.min_fitness}"
    elif result.rmse > settings.max_rmse:
        reason = f"inlier RMSE {1e3 * result.rmse:.1f} mm above {1e3 * settings.max_rmse:.1f} mm"
    return Registration(
        first_from_second, not reason, reason, fitness=result.fitness, rmse=result.rmse, information=result.information
    )


def implausible(first_from_second: Array, head: Array, steps: int, settings: ReconstructionSettings) -> str:
    """Why a motion cannot be that of a tripod moved along the row by ``steps`` stations, or "".

    The motion is that of the reference camera, ``head`` (3,) in the rig frame: a tilt moves the rig frame's origin on
    the floor by centimetres without the tripod having been moved.
    """
    moved = transform(first_from_second, head[None])[0] - head
    low, high = settings.step_range[0] * steps, min(settings.step_range[1] * steps, settings.longest_gap)
    angle = rotation_angle(first_from_second[:3, :3])
    sideways = float(np.hypot(moved[0], moved[2]))
    if not low <= abs(moved[1]) <= high:
        return f"moved {100 * moved[1]:.1f} cm along the row, expected {100 * low:.0f} to {100 * high:.0f} cm"
    if angle > settings.max_rotation:
        return f"turned by {np.degrees(angle):.1f} degrees, at most {np.degrees(settings.max_rotation):.1f} expected"
    if sideways > settings.max_sideways:
        return f"moved {100 * sideways:.1f} cm across the row, at most {100 * settings.max_sideways:.0f} cm expected"
    return ""


def register(
    first: StationView, second: StationView, rig: Rig, steps: int, settings: ReconstructionSettings
) -> Registration:
    """Register a station to an earlier one that lies ``steps`` stations back, as in the paper."""
    if first.frame is None or second.frame is None:
        raise ValueError("registration by silhouettes needs both reference images")
    camera = rig.cameras[rig.reference]
    shift = silhouette_shift(first.frame, second.frame, camera, steps, settings)
    if isinstance(shift, str):
        return Registration(np.eye(4), False, shift)
    offset = mean_offset(first.frame, second.frame, shift, settings)
    if offset is None:
        return Registration(np.eye(4), False, "no pixels shared at the best shift", shift)
    in_rig = camera.rig_from_camera[:3, :3] @ offset
    if not len(first.source) or not len(second.source):
        return Registration(np.eye(4), False, "a station has no foreground points", shift, in_rig)
    start = coarse_icp(first.source, second.source, pose(translation=in_rig), settings)
    return refine(first, second, start, rig, steps, settings)._replace(shift=shift, offset=in_rig)
