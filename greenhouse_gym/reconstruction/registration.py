"""Register one station to another: silhouettes, mean offset of the shared pixels, ICP from there, acceptance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from greenhouse_gym.capture.rig import Camera
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.geometry import Array, invert, pose, rotation_angle, transform
from greenhouse_gym.reconstruction.foreground import foreground_problem
from greenhouse_gym.reconstruction.icp import Alignment, align, assess
from greenhouse_gym.reconstruction.point_clouds import merge, to_open3d
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.shift import Shift, along, best_shifts, overlap
from greenhouse_gym.reconstruction.views import CameraView, StationView

_HELD = (0.003, 0.05)  # hold of the two motions least held; walls and tables leave three loose, a pole two, a row none


class Registration(NamedTuple):
    """How a station was registered to an earlier one, or why it was not.

    Attributes:
        first_from_second: (4, 4) pose of the second station's rig frame in the first's.
        reason: Why it was refused, or "".
        shift: The best shift of the silhouettes, if any.
        offset: (3,) mean offset of the shared pixels in the rig frame, metres: where ICP started.
        fitness: Share of the points both could see with a partner within the fine distance.
        rmse: Root mean square distance of those partners along their normals, metres; None without partners.
        information: (6, 6) information matrix for the pose graph.
    """

    first_from_second: Array
    reason: str
    shift: Shift | None = None
    offset: Array | None = None
    fitness: float = 0.0
    rmse: float | None = None
    information: Array | None = None

    @property
    def accepted(self) -> bool:
        """Whether it passed every check."""
        return not self.reason


def row_axis(camera: Camera) -> int:
    """The image axis along which the row passes: the one that lies closer to the rig's y."""
    rows_along_y, columns_along_y = abs(camera.rig_from_camera[1, 1]), abs(camera.rig_from_camera[1, 0])
    return 0 if rows_along_y >= columns_along_y else 1


def silhouette_shifts(
    first: CameraView, second: CameraView, steps: int, settings: ReconstructionSettings
) -> list[Shift] | str:
    """The best shifts between two reference images ``steps`` stations apart, the best first, or why there is none."""
    one, two = first.foreground, second.foreground
    for which, view in (("first", first), ("second", second)):
        problem = foreground_problem(
            view.depth, view.foreground, settings.foreground, settings.min_foreground, settings.max_foreground
        )
        if problem:
            return f"the {which} image has {problem}"
    axis = row_axis(second.camera)
    focal = second.camera.intrinsics.fy if axis == 0 else second.camera.intrinsics.fx
    distance = float(np.median(second.depth[two]))
    low, high = settings.step_range
    found = best_shifts(
        one, two, axis,
        shortest=int(low * steps * focal / settings.foreground),
        longest=int(min(high * steps, settings.longest_gap) * focal / distance),
        step=settings.shift_step,
        count=settings.shifts_tried,
    )  # fmt: skip
    if not found:
        return "no shift leaves any foreground to compare"
    if found[0].difference > settings.max_shift_difference:
        return f"silhouettes differ by {found[0].difference:.0%} at the best shift"
    return found


def mean_offset(first: CameraView, second: CameraView, shift: Shift) -> Array | None:
    """The paper's mean XYZ distance of the pixels both silhouettes share after the shift.

    A pixel may show a stem in one image and a leaf behind it in the other, so the mean is over the pixels whose depths
    differ by what most do: within 1.5 cm of the median difference.

    Returns:
        (3,) metres in the camera frame, what to add to a point of the second image; None if nothing is shared.
    """
    a, b = (along(shift.axis, part) for part in overlap(first.depth, shift.pixels, shift.axis))
    rows, columns = np.nonzero(first.foreground[a] & second.foreground[b])
    if not len(rows):
        return None

    def points(view: CameraView, part: tuple[slice, slice]) -> Array:
        own_rows, own_columns = rows + (part[0].start or 0), columns + (part[1].start or 0)
        return view.camera.intrinsics.back_project(own_rows, own_columns, view.depth[own_rows, own_columns])

    apart = points(first, a) - points(second, b)
    usual = np.abs(apart[:, 2] - np.median(apart[:, 2])) < 0.015
    return np.asarray(apart[usual].mean(axis=0))


def coarse_icp(
    first: StationView, second: StationView, start: Array, distance: float, settings: ReconstructionSettings
) -> Array:
    """Open3D's point-to-plane ICP from ``start`` with partners within ``distance`` metres: first_from_second."""
    registration = open3d().pipelines.registration
    target = merge([view.sample(settings.samples) for view in first.cameras.values()])
    source = second.sample.select(np.arange(0, len(second.sample), 2))
    result = registration.registration_icp(
        to_open3d(source), to_open3d(target), distance, start,
        registration.TransformationEstimationPointToPlane(),
        registration.ICPConvergenceCriteria(1e-4, 1e-4, settings.icp_iterations),
    )  # fmt: skip
    return np.round(np.array(result.transformation), 9)  # the last bits depend on Open3D's threads


def refine(
    first: StationView, second: StationView, start: Array, steps: int, pace: float, settings: ReconstructionSettings
) -> Registration:
    """Fine ICP from a start pose, and the checks that accept or refuse its result.

    What the second station sees must not stand where the first sees through. Where no ``pace`` is known, the first was
    held against no other station before, so the same is asked of what it sees.
    """
    found = align(first, second.sample, start, settings)
    first_from_second = np.round(found.first_from_second, 9)
    head = second.reference.camera.rig_from_camera[:3, 3]
    reason = unconvincing(found, settings) or implausible(first_from_second, head, steps, pace, settings)
    if not reason and not pace:
        through = assess(second, first.sample, invert(first_from_second), settings).contradicted
        if through > settings.max_contradicted:
            reason = f"{through:.0%} of the earlier station stands where this one sees through"
    return Registration(
        first_from_second,
        reason,
        fitness=found.fitness,
        rmse=found.rmse if found.fitness else None,
        information=found.information,
    )


def unconvincing(found: Alignment, settings: ReconstructionSettings) -> str:
    """Why an alignment does not show the same plants twice, or ""."""
    if found.overlap < settings.min_overlap:
        return f"overlap {found.overlap:.2f} below {settings.min_overlap}"
    if found.fitness < settings.min_fitness:
        return f"fitness {found.fitness:.2f} below {settings.min_fitness}"
    if found.rmse > settings.max_rmse:
        return f"inlier RMSE {1e3 * found.rmse:.1f} mm above {1e3 * settings.max_rmse:.1f} mm"
    if found.contradicted > settings.max_contradicted:
        return f"{found.contradicted:.0%} stands where the other station sees through"
    if found.held[0] < _HELD[0] or found.held[1] < _HELD[1]:
        loose = max(1, int((found.held < _HELD[1]).sum()))
        return f"the surfaces are too even to tell how far it moved: {loose} of 6 ways to move hardly change the images"
    return ""


def implausible(
    first_from_second: Array, head: Array, steps: int, pace: float, settings: ReconstructionSettings
) -> str:
    """Why a motion cannot be that of a tripod moved along the row by ``steps`` stations, or "".

    The motion is that of the reference camera, ``head`` (3,) in the rig frame: a tilt moves the rig frame's origin on
    the floor by centimetres without the tripod having been moved. The sign of ``pace`` is that of the walk so far along
    the rig's y, 0 if not known.
    """
    moved = transform(first_from_second, head[None])[0] - head
    low, high = settings.step_range[0] * steps, min(settings.step_range[1] * steps, settings.longest_gap)
    angle = rotation_angle(first_from_second[:3, :3])
    sideways = float(np.hypot(moved[0], moved[2]))
    if not low <= abs(moved[1]) <= high:
        return f"moved {100 * moved[1]:.1f} cm along the row, expected {100 * low:.0f} to {100 * high:.0f} cm"
    if moved[1] * pace < 0:
        return f"moved {100 * moved[1]:.1f} cm along the row, against the way of the stations before"
    if angle > settings.max_rotation:
        return f"turned by {np.degrees(angle):.1f} degrees, at most {np.degrees(settings.max_rotation):.1f} expected"
    if sideways > settings.max_sideways:
        return f"moved {100 * sideways:.1f} cm across the row, at most {100 * settings.max_sideways:.0f} cm expected"
    return ""


def register(
    first: StationView, second: StationView, steps: int, settings: ReconstructionSettings, pace: float = 0.0
) -> Registration:
    """Register a station to an earlier one that lies ``steps`` stations back, as in the paper.

    A row repeats itself, so where ICP does not convince from the best shift of the silhouettes, it starts once more
    from the next best ones, and at last from where the tripod would stand had it gone on as before.

    Args:
        first: The earlier station.
        second: The later one.
        steps: How many stations lie between them, plus one.
        settings: All settings.
        pace: Metres along the rig's y from one station to the next so far, 0 if not known.
    """
    shifts = silhouette_shifts(first.reference, second.reference, steps, settings)
    if isinstance(shifts, str):
        return Registration(np.eye(4), shifts)
    best: Registration | None = None
    for shift in shifts:
        found = register_from(shift, first, second, steps, pace, settings)
        if found.accepted:
            return found
        best = best or found
    assert best is not None
    if pace and abs(pace) * steps <= settings.longest_gap:
        found = register_at_pace(first, second, steps, pace, settings)
        if found.accepted:
            return found
    return best


def register_from(
    shift: Shift,
    first: StationView,
    second: StationView,
    steps: int,
    pace: float,
    settings: ReconstructionSettings,
) -> Registration:
    """Register a station to an earlier one from a shift of their silhouettes."""
    offset = mean_offset(first.reference, second.reference, shift)
    if offset is None:
        return Registration(np.eye(4), "no pixels shared at the best shift", shift)
    in_rig = second.reference.camera.rig_from_camera[:3, :3] @ offset
    start = coarse_icp(first, second, pose(translation=in_rig), settings.coarse_distance, settings)
    return refine(first, second, start, steps, pace, settings)._replace(shift=shift, offset=in_rig)


def register_at_pace(
    first: StationView, second: StationView, steps: int, pace: float, settings: ReconstructionSettings
) -> Registration:
    """Register a station to an earlier one from where the tripod would stand had it gone on as before."""
    start = pose(translation=[0.0, pace * steps, 0.0])
    for distance in (3 * settings.coarse_distance, settings.coarse_distance):
        start = coarse_icp(first, second, start, distance, settings)
    return refine(first, second, start, steps, pace, settings)
