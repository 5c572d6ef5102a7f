"""Registration of one station to another: silhouettes, mean offset of the shared pixels, ICP, acceptance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from greenhouse_gym.capture.rig import Camera
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.geometry import Array, invert, pose, rotation_angle, transform
from greenhouse_gym.geometry.point_clouds import merge, to_open3d
from greenhouse_gym.reconstruction.foreground import Shift, along, best_shifts, foreground_problem, overlapping_parts
from greenhouse_gym.reconstruction.icp import MAX_ITERATIONS, IcpResult, assess_pose, fine_icp
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.station_views import SAMPLES, CameraView, StationView

LONGEST_GAP = 0.45  # m between two stations of a segment
MAX_SHIFT_DIFFERENCE = 0.9  # fraction of the foreground that may differ at the best shift; ICP decides
_SHIFT_STEP = 2  # px, "a few pixels at a time"
_SHIFTS_TRIED = 3  # the best ones, until ICP accepts one
_COARSE_DISTANCE = 0.02  # m within which Open3D's ICP pairs points
_MIN_CONSTRAINT = (0.003, 0.05)  # of the two loosest motions; walls and tables leave three loose, a pole two, a row 0


class Registration(NamedTuple):
    """Registration of a station to an earlier one, accepted or refused."""

    first_from_second: Array  # (4, 4) pose of the second station's rig frame in the first's
    reason: str  # reason of a refusal, or ""
    shift: Shift | None = None  # the best shift of the silhouettes, if any
    offset: Array | None = None  # (3,) mean offset of shared pixels in the rig frame, metres; start of ICP
    fitness: float = 0.0  # fraction of the points in view of both with a partner within the fine distance
    rmse: float | None = None  # root mean square distance of those partners along their normals, metres
    information: Array | None = None  # (6, 6) information matrix for the pose graph

    @property
    def accepted(self) -> bool:
        """True if it passed every check."""
        return not self.reason


def row_axis(camera: Camera) -> int:
    """Return the image axis along which the row passes: the one that lies closer to the rig's y."""
    rows_along_y, columns_along_y = abs(camera.rig_from_camera[1, 1]), abs(camera.rig_from_camera[1, 0])
    return 0 if rows_along_y >= columns_along_y else 1


def silhouette_shifts(
    first: CameraView, second: CameraView, steps: int, settings: ReconstructionSettings
) -> list[Shift] | str:
    """Return the best shifts between two reference images ``steps`` stations apart, best first, or why none exists."""
    for which, view in (("first", first), ("second", second)):
        if problem := foreground_problem(view.depth, view.foreground, settings.foreground):
            return f"the {which} image has {problem}"
    axis = row_axis(second.camera)
    focal = second.camera.intrinsics.fy if axis == 0 else second.camera.intrinsics.fx
    distance = float(np.median(second.depth[second.foreground]))
    low, high = settings.step_range
    shortest = int(low * steps * focal / settings.foreground)
    longest = int(min(high * steps, LONGEST_GAP) * focal / distance)
    found = best_shifts(first.foreground, second.foreground, axis, shortest, longest, _SHIFT_STEP, _SHIFTS_TRIED)
    if not found:
        return "no shift leaves any foreground to compare"
    if found[0].difference > MAX_SHIFT_DIFFERENCE:
        return f"silhouettes differ by {found[0].difference:.0%} at the best shift"
    return found


def mean_offset(first: CameraView, second: CameraView, shift: Shift) -> Array | None:
    """Return the paper's mean XYZ distance of the pixels that both silhouettes share after the shift.

    A pixel may show a stem in one image and a leaf behind it in the other, so the mean is over the pixels whose depth
    difference is within 1.5 cm of the median difference. It is (3,) metres in the camera frame, to be added to a point
    of the second image; None if no pixel is shared.
    """
    a, b = (along(shift.axis, part) for part in overlapping_parts(first.depth, shift.pixels, shift.axis))
    rows, columns = np.nonzero(first.foreground[a] & second.foreground[b])
    if not len(rows):
        return None

    def points(view: CameraView, part: tuple[slice, slice]) -> Array:
        own_rows, own_columns = rows + (part[0].start or 0), columns + (part[1].start or 0)
        return view.camera.intrinsics.back_project(own_rows, own_columns, view.depth[own_rows, own_columns])

    offsets = points(first, a) - points(second, b)
    usual = np.abs(offsets[:, 2] - np.median(offsets[:, 2])) < 0.015
    return np.asarray(offsets[usual].mean(axis=0))


def coarse_icp(
    first: StationView, second: StationView, start: Array, distances: Sequence[float] = (_COARSE_DISTANCE,)
) -> Array:
    """Run Open3D's point-to-plane ICP with partners within ever smaller distances, metres: first_from_second."""
    registration = open3d().pipelines.registration
    target = to_open3d(merge([view.sample(SAMPLES) for view in first.cameras.values()]))
    source = to_open3d(second.sample.select(np.arange(0, len(second.sample), 2)))
    method = registration.TransformationEstimationPointToPlane()
    criteria = registration.ICPConvergenceCriteria(1e-4, 1e-4, MAX_ITERATIONS)
    for distance in distances:
        result = registration.registration_icp(source, target, distance, start, method, criteria)
        start = np.round(np.array(result.transformation), 9)  # the last bits depend on Open3D's threads
    return start


def coarse_icp_from_afar(first: StationView, second: StationView, start: Array) -> Array:
    """Run `coarse_icp` from a start (4, 4) that is right to a few centimetres."""
    return coarse_icp(first, second, start, (3 * _COARSE_DISTANCE, _COARSE_DISTANCE))


def refine_pair(
    first: StationView, second: StationView, start: Array, steps: int, stride: float, settings: ReconstructionSettings
) -> Registration:
    """Run fine ICP from a start pose, and the checks that accept or refuse its result.

    The second station's points must not stand where the first sees through. Where no ``stride`` is known, the first
    has not been checked against another station before, so the same is required of its points.
    """
    found = fine_icp(first, second.sample, start, settings)
    first_from_second = np.round(found.first_from_second, 9)
    head = second.reference.camera.rig_from_camera[:3, 3]
    reason = alignment_problem(found, settings) or motion_problem(first_from_second, head, steps, stride, settings)
    if not reason and not stride:
        through = assess_pose(second, first.sample, invert(first_from_second), settings).contradicted
        if through > settings.max_contradicted:
            reason = f"{through:.0%} of the earlier station stands where this one sees through"
    rmse = found.rmse if found.fitness else None
    return Registration(first_from_second, reason, fitness=found.fitness, rmse=rmse, information=found.information)


def alignment_problem(found: IcpResult, settings: ReconstructionSettings) -> str:
    """Return the reason why an alignment does not show the same plants twice, or ""."""
    if found.overlap < settings.min_overlap:
        return f"overlap {found.overlap:.2f} below {settings.min_overlap}"
    if found.fitness < settings.min_fitness:
        return f"fitness {found.fitness:.2f} below {settings.min_fitness}"
    if found.rmse > settings.max_rmse:
        return f"inlier RMSE {1e3 * found.rmse:.1f} mm above {1e3 * settings.max_rmse:.1f} mm"
    if found.contradicted > settings.max_contradicted:
        return f"{found.contradicted:.0%} stands where the other station sees through"
    if found.constraint[0] < _MIN_CONSTRAINT[0] or found.constraint[1] < _MIN_CONSTRAINT[1]:
        loose = max(1, int((found.constraint < _MIN_CONSTRAINT[1]).sum()))
        return f"the surfaces are too even to constrain the motion: {loose} of 6 motions hardly change the images"
    return ""


def motion_problem(
    first_from_second: Array, head: Array, steps: int, stride: float, settings: ReconstructionSettings
) -> str:
    """Return the reason why a motion cannot be that of a tripod moved along the row by ``steps`` stations, or "".

    The motion is that of the reference camera, ``head`` (3,) in the rig frame: a tilt moves the rig frame's origin on
    the floor by centimetres without the tripod having been moved. The sign of ``stride`` is the direction of the
    stations before along the rig's y, 0 if not known.
    """
    moved = transform(first_from_second, head[None])[0] - head
    low, high = settings.step_range[0] * steps, min(settings.step_range[1] * steps, LONGEST_GAP)
    angle = rotation_angle(first_from_second[:3, :3])
    sideways = float(np.hypot(moved[0], moved[2]))
    if not low <= abs(moved[1]) <= high:
        return f"moved {100 * moved[1]:.1f} cm along the row, expected {100 * low:.0f} to {100 * high:.0f} cm"
    if moved[1] * stride < 0:
        return f"moved {100 * moved[1]:.1f} cm along the row, opposite to the stations before"
    if angle > settings.max_rotation:
        return f"turned by {np.degrees(angle):.1f} degrees, at most {np.degrees(settings.max_rotation):.1f} expected"
    if sideways > settings.max_sideways:
        return f"moved {100 * sideways:.1f} cm across the row, at most {100 * settings.max_sideways:.0f} cm expected"
    return ""


def register_pair(
    first: StationView, second: StationView, steps: int, settings: ReconstructionSettings, stride: float = 0.0
) -> Registration:
    """Register a station to an earlier one that lies ``steps`` stations back, as in the paper.

    A row repeats itself, so where ICP from the best shift of the silhouettes is refused, it starts once more from the
    next best ones, and finally from where the tripod would stand after a usual step: ``stride`` metres along the rig's
    y per station, 0 if not known.
    """
    shifts = silhouette_shifts(first.reference, second.reference, steps, settings)
    if isinstance(shifts, str):
        return Registration(np.eye(4), shifts)
    best: Registration | None = None
    for shift in shifts:
        found = _register_from_shift(shift, first, second, steps, stride, settings)
        if found.accepted:
            return found
        best = best or found
    assert best is not None
    if stride and abs(stride) * steps <= LONGEST_GAP:
        start = coarse_icp_from_afar(first, second, pose(translation=[0.0, stride * steps, 0.0]))
        found = refine_pair(first, second, start, steps, stride, settings)
        if found.accepted:
            return found
    return best


def _register_from_shift(
    shift: Shift,
    first: StationView,
    second: StationView,
    steps: int,
    stride: float,
    settings: ReconstructionSettings,
) -> Registration:
    """Register a station to an earlier one from a shift of their silhouettes."""
    offset = mean_offset(first.reference, second.reference, shift)
    if offset is None:
        return Registration(np.eye(4), "no pixels shared at the best shift", shift)
    in_rig = second.reference.camera.rig_from_camera[:3, :3] @ offset
    start = coarse_icp(first, second, pose(translation=in_rig))
    return refine_pair(first, second, start, steps, stride, settings)._replace(shift=shift, offset=in_rig)
