"""Drift of the stations, distance from a cloud to the true surfaces, and completeness of the cloud.

The true surfaces are the triangles that the simulated cameras see; they lie within 0.2 mm of the analytic shapes.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.raycast import RowRaycaster
from greenhouse_gym.capture.rig import Intrinsics, RgbdFrame, Rig
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.geometry import Array, invert, pose, transform

_WINDOW = 1.0  # m, longest window of the row that is aligned by itself
_WINDOW_SAMPLES, _ROW_SAMPLES = 3000, 6000  # approximate numbers of points that are aligned
_ITERATIONS = 30

_FOREGROUND = 0.60  # m, the usual cut
_VOXEL = 0.004  # m, side of the cubes that get one point each
_SKIP = 2  # pixels between rays in either direction
_WITHIN = 0.005  # m


class ReconstructedRow(Protocol):
    """Reconstruction to compare with the truth: a `RowCloud`, or the result of another method."""

    @property
    def points(self) -> Array:
        """(n, 3) metres, in the frame of the first registered station."""

    @property
    def registered(self) -> npt.NDArray[np.bool_]:
        """(stations,) mask of the registered stations."""

    @property
    def world_from_station(self) -> Array:
        """(stations, 4, 4), in the points' frame; NaN where not registered, identity for the first registered one."""


class Drift(NamedTuple):
    """Translation error of the last registered station relative to the first, and the length of the path, metres."""

    error: float
    length: float

    @property
    def fraction(self) -> float:
        """Error as a fraction of the length."""
        return self.error / self.length


def drift(row: ReconstructedRow, world_from_station: Array) -> Drift:
    """Compare a row's stations with their true poses (stations, 4, 4).

    The error is that of the last registered station's origin in the frame of the first; the length is that of the true
    path from station to station.
    """
    good = np.flatnonzero(row.registered)
    true = invert(world_from_station[good[0]]) @ world_from_station[good]
    error = np.linalg.norm(row.world_from_station[good[-1], :3, 3] - true[-1, :3, 3])
    length = np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).sum()
    return Drift(float(error), float(length))


def distance_to_truth(row: ReconstructedRow, truth: PlantRow, world_from_first: Array) -> Array:
    """Return unsigned distances (n,) metres from an even sample of a row's points to the nearest true surface.

    Args:
        row: The reconstructed row.
        truth: The grown row.
        world_from_first: (4, 4) true pose of the first registered station.
    """
    return distance_to_surface(transform(world_from_first, row.points), truth)


def distance_to_surface(points: Array, truth: PlantRow, samples: int = 20_000) -> Array:
    """Return unsigned distances (n,) metres from a sample of points (k, 3) in the world to the nearest true surface."""
    thinned = points[:: max(1, len(points) // samples)]
    return np.asarray(np.linalg.norm(thinned - _closest(RowRaycaster.of(truth), thinned), axis=1))


def place(row: ReconstructedRow, world_from_station: Array) -> Array:
    """Return a row's points (n, 3) in the world, with its first registered station at its true pose.

    Args:
        row: The reconstructed row.
        world_from_station: (stations, 4, 4) true poses.
    """
    return transform(world_from_station[np.flatnonzero(row.registered)[0]], row.points)


def place_by_windows(row: ReconstructedRow, truth: PlantRow, world_from_station: Array) -> Array:
    """Return a row's points in the world after one rigid alignment to the true surfaces per metre of the row.

    This removes the drift and leaves the accuracy within a metre. An alignment starts from the true pose of a
    registered station near the window's center and minimizes the distance to the closest true points.

    Args:
        row: The reconstructed row.
        truth: The grown row.
        world_from_station: (stations, 4, 4) true poses.

    Returns:
        (n, 3) metres, in the order of the row's points.
    """
    caster = RowRaycaster.of(truth)
    good = np.flatnonzero(row.registered)
    world_from_row = world_from_station[good] @ invert(row.world_from_station[good])
    along = place(row, world_from_station)[:, 1]
    station_along = transform(world_from_row[0], row.world_from_station[good, :3, 3])[:, 1]
    count = max(1, int(np.ceil(np.ptp(along) / _WINDOW)))
    edges = np.linspace(along.min(), along.max(), count + 1)
    member = np.digitize(along, edges[1:-1])
    placed = np.empty_like(row.points)
    for k in np.unique(member):
        own = row.points[member == k]
        thinned = own[:: max(1, len(own) // _WINDOW_SAMPLES)]
        nearest = np.argsort(np.abs(station_along - edges[k : k + 2].mean()), kind="stable")[:3]
        start = min((world_from_row[i] for i in nearest), key=lambda start: _median_distance(caster, start, thinned))
        placed[member == k] = transform(_align(caster, start, thinned), own)
    return placed


def align(row: ReconstructedRow, truth: PlantRow, world_from_station: Array) -> Array:
    """Return the (4, 4) pose of a row's frame in the world that brings its points closest to the true surfaces.

    One rigid motion for the whole row, starting from the true pose of its first registered station (of
    (stations, 4, 4)): it spreads the drift evenly, whereas `place` lets it grow.
    """
    start = world_from_station[np.flatnonzero(row.registered)[0]]
    return _align(RowRaycaster.of(truth), start, row.points[:: max(1, len(row.points) // _ROW_SAMPLES)])


def _closest(caster: RowRaycaster, points: Array) -> Array:
    """Return the points (n, 3) of the true surfaces closest to points (n, 3)."""
    queries = open3d().core.Tensor(points.astype(np.float32))
    return np.asarray(caster.scene.compute_closest_points(queries)["points"].numpy(), dtype=np.float64)


def _median_distance(caster: RowRaycaster, world_from_row: Array, points: Array) -> float:
    moved = transform(world_from_row, points)
    return float(np.median(np.linalg.norm(moved - _closest(caster, moved), axis=1)))


def _align(caster: RowRaycaster, start: Array, points: Array) -> Array:
    """Return the (4, 4) pose near ``start`` that brings points (n, 3) closest to the truth, by robust Gauss-Newton."""
    world_from_points = start
    for _ in range(_ITERATIONS):
        moved = transform(world_from_points, points)
        away = moved - _closest(caster, moved)
        distance = np.linalg.norm(away, axis=1)
        axes = away / np.maximum(distance, 1e-9)[:, None]
        center = moved.mean(axis=0)
        jacobian = np.column_stack([np.cross(moved - center, axes), axes])
        scale = max(2.5 * 1.4826 * float(np.median(distance)), 0.002)
        weighted = jacobian * (np.clip(1 - (distance / scale) ** 2, 0, None) ** 2)[:, None]
        step = np.linalg.lstsq(jacobian.T @ weighted, -weighted.T @ distance, rcond=1e-9)[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        world_from_points = pose(turn, center + step[3:] - turn @ center) @ world_from_points
        if np.abs(step).max() < 1e-6:
            break
    return world_from_points


def visible_surface(truth: PlantRow, rig: Rig, world_from_station: Array) -> Array:
    """Return points (n, 3) in the world, evenly spread over the true surface that a recording could show.

    Every camera views the true row without noise. Surface within the cut along the rig's forward axis from the
    reference camera counts, once regardless of the number of cameras that see it.

    Args:
        truth: The grown row.
        rig: The cameras.
        world_from_station: (stations, 4, 4) true poses.
    """
    caster = RowRaycaster.of(truth)
    front = rig.cameras[rig.reference].rig_from_camera[0, 3] + _FOREGROUND
    stations = []
    for station_pose in world_from_station:
        seen = []
        for camera in rig.cameras.values():
            intrinsics = _every(camera.intrinsics, _SKIP)
            view = caster.render(station_pose @ camera.rig_from_camera, intrinsics)
            frame = RgbdFrame(view.color, np.where(np.isfinite(view.depth), view.depth, 0), intrinsics)
            in_rig = transform(camera.rig_from_camera, frame.points())
            seen.append(transform(station_pose, in_rig[in_rig[:, 0] < front]))
        stations.append(_one_per_cube(np.concatenate(seen), _VOXEL))
    return _one_per_cube(np.concatenate(stations), _VOXEL)


def completeness(points: Array, surface: Array) -> float:
    """Return the fraction of surface points (n, 3) with a cloud point (k, 3) within 5 mm, in the same frame."""
    distance, _ = cKDTree(points).query(surface, distance_upper_bound=_WITHIN)
    return float(np.isfinite(distance).mean())


def _every(k: Intrinsics, skip: int) -> Intrinsics:
    """Return the camera with one pixel for every ``skip`` x ``skip`` pixels."""
    return Intrinsics(
        k.width // skip,
        k.height // skip,
        k.fx / skip,
        k.fy / skip,
        (k.cx + 0.5) / skip - 0.5,
        (k.cy + 0.5) / skip - 0.5,
    )


def _one_per_cube(points: Array, size: float) -> Array:
    """Return the first point in each occupied cube of the world's grid."""
    cubes = np.floor(points / size).astype(np.int64) + (1 << 20)
    keys = (cubes[:, 0] << 42) | (cubes[:, 1] << 21) | cubes[:, 2]
    return points[np.sort(np.unique(keys, return_index=True)[1])]
