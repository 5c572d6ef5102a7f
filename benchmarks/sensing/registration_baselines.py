"""Two other methods of registration: plain Open3D, and the paper's method alone.

Both receive the same images with the same cut at 60 cm, the nominal step between stations, and the settings that did
best on rows that the benchmark does not use.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture import Recording, Rig, Station
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.geometry import Array, invert, pose, transform
from greenhouse_gym.reconstruction.foreground import along, best_shifts, foreground_mask, overlapping_parts
from greenhouse_gym.reconstruction.pair_registration import row_axis

FOREGROUND = 0.60  # m, the paper's cut
STEP = 0.10  # m along the row, nominal
VOXEL = 0.002  # m, the merged cloud
OUTLIER_NEIGHBORS, OUTLIER_RADIUS = 8, 0.006  # points, m


@dataclass(frozen=True, eq=False)
class BaselineRow:
    """Row reconstructed by a baseline, in the frame of its first registered station; fields as in `RowCloud`."""

    points: Array
    registered: npt.NDArray[np.bool_]
    world_from_station: Array


def multiway(recording: Recording, voxel: float = 0.008, links: int = 3) -> BaselineRow:
    """Register a recording as Open3D's tutorial of multiway registration does.

    Pairwise point-to-plane ICP, coarse then fine, on downsampled clouds with Open3D's normals; a pose graph with
    odometry edges and uncertain edges to stations up to ``links`` steps away; global optimization. Unlike in the
    tutorial, ICP starts from the nominal step (from the identity it finds nothing here), and for the uncertain edges
    from the chained odometry. Stations without points are left out.

    Args:
        recording: The recording.
        voxel: Size of the voxels, m; correspondence distances are 5 voxels, then 1 (15 and 1.5 in the tutorial drift
            more).
        links: Maximum number of steps between stations that are registered to each other.
    """
    o3d = open3d()
    pipelines = o3d.pipelines.registration
    coarse, fine = 5 * voxel, voxel
    merged = [_foreground(station, recording.rig) for station in recording]
    good = [i for i, points in enumerate(merged) if len(points)]
    clouds = [_with_normals(merged[i], voxel) for i in good]
    graph = pipelines.PoseGraph()
    graph.nodes.append(pipelines.PoseGraphNode(np.eye(4)))
    for target in range(1, len(good)):
        for source in range(target - 1, max(target - links, 0) - 1, -1):
            if source == target - 1:
                start = graph.nodes[source].pose @ pose(translation=[0.0, STEP * (good[target] - good[source]), 0.0])
            else:
                start = graph.nodes[target].pose
            source_from_target = np.linalg.inv(graph.nodes[source].pose) @ start
            for distance in (coarse, fine):
                source_from_target = _icp(clouds[target], clouds[source], distance, source_from_target).transformation
            information = pipelines.get_information_matrix_from_point_clouds(
                clouds[target], clouds[source], fine, source_from_target
            )
            if source == target - 1:
                graph.nodes.append(pipelines.PoseGraphNode(graph.nodes[source].pose @ source_from_target))
            graph.edges.append(
                pipelines.PoseGraphEdge(target, source, source_from_target, information, uncertain=source < target - 1)
            )
    pipelines.global_optimization(
        graph,
        pipelines.GlobalOptimizationLevenbergMarquardt(),
        pipelines.GlobalOptimizationConvergenceCriteria(),
        pipelines.GlobalOptimizationOption(
            max_correspondence_distance=fine, edge_prune_threshold=0.25, reference_node=0
        ),
    )
    poses = np.full((len(recording), 4, 4), np.nan)
    poses[good] = np.array([node.pose for node in graph.nodes])
    return _row(merged, poses)


def paper_chain(
    recording: Recording, distance: float = 0.01, voxel: float = 0.01, min_fitness: float = 0.4
) -> BaselineRow:
    """Register a recording by the paper's steps alone.

    Silhouettes are shifted to the smallest difference; the mean offset of the shared pixels starts Open3D's ICP between
    consecutive stations. After a failed pair the next station is tried against the last good one. Merging and radius
    outlier removal follow. ICP is point-to-plane, which drifts less than point-to-point. The paper does not define
    failure; here a pair fails if ICP reports a low fitness.

    Args:
        recording: The recording.
        distance: Correspondence distance of ICP, m.
        voxel: Size of the voxels to which clouds are downsampled for ICP, m.
        min_fitness: Minimum fraction of points with a correspondence.
    """
    rig = recording.rig
    merged: list[Array] = []
    poses = np.full((len(recording), 4, 4), np.nan)
    last: tuple[int, Station, Any] | None = None
    for i, station in enumerate(recording):
        merged.append(_foreground(station, rig))
        cloud = _with_normals(merged[i], voxel)
        if last is None:
            accepted = len(merged[i]) > 0
            poses[i] = np.eye(4) if accepted else np.nan
        else:
            k, earlier, target = last
            offset = silhouette_offset(earlier, station, rig, i - k)
            accepted = offset is not None
            if offset is not None:
                found = _icp(cloud, target, distance, pose(translation=offset))
                accepted = found.fitness >= min_fitness
                poses[i] = poses[k] @ found.transformation if accepted else np.nan
        if accepted:
            last = i, station, cloud
    return _row(merged, poses)


def silhouette_offset(first: Station, second: Station, rig: Rig, steps: int) -> Array | None:
    """Return the mean offset (3,) of the pixels that two silhouettes share, in the rig frame, m.

    The silhouettes of the reference camera are shifted as far as steps of 3 to 15 cm can shift them. The offset maps
    points of the second station to the first; None if a station has no foreground.
    """
    camera = rig.cameras[rig.reference]
    frames = [station.frames[rig.reference] for station in (first, second)]
    one, two = (foreground_mask(frame.depth, camera, rig, FOREGROUND) for frame in frames)
    if not one.any() or not two.any():
        return None
    axis = row_axis(camera)
    focal = camera.intrinsics.fx if axis else camera.intrinsics.fy
    nearest = float(np.median(frames[1].depth[two]))
    shifts = best_shifts(one, two, axis, int(0.03 * steps * focal / FOREGROUND), int(0.15 * steps * focal / nearest))
    if not shifts:
        return None
    a, b = overlapping_parts(one, shifts[0].pixels, axis)
    rows, columns = np.nonzero(one[along(axis, a)] & two[along(axis, b)])
    if not len(rows):
        return None
    here, there = (
        frame.back_project(rows + (0 if axis else part.start), columns + (part.start if axis else 0))
        for frame, part in zip(frames, (a, b), strict=True)
    )
    return np.asarray(camera.rig_from_camera[:3, :3] @ (here - there).mean(axis=0))


def _foreground(station: Station, rig: Rig) -> Array:
    """Return the downsampled foreground points (n, 3) of all cameras in the rig frame."""
    points = []
    for name, frame in station.frames.items():
        camera = rig.cameras[name]
        near = frame.points(foreground_mask(frame.depth, camera, rig, FOREGROUND))
        points.append(transform(camera.rig_from_camera, near))
    return _thinned(np.concatenate(points))


def _row(stations: list[Array], poses: Array) -> BaselineRow:
    """Merge the registered stations and remove points with few neighbors."""
    registered = np.isfinite(poses[:, 0, 0])
    poses = invert(poses[np.flatnonzero(registered)[0]]) @ poses
    points = _thinned(np.concatenate([transform(poses[i], stations[i]) for i in np.flatnonzero(registered)]))
    kept, _ = _cloud(points).remove_radius_outlier(OUTLIER_NEIGHBORS, OUTLIER_RADIUS)
    return BaselineRow(np.array(kept.points), registered, poses)


def _cloud(points: Array) -> Any:
    o3d = open3d()
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def _thinned(points: Array) -> Array:
    return np.array(_cloud(points).voxel_down_sample(VOXEL).points)


def _with_normals(points: Array, voxel: float) -> Any:
    """Return a downsampled Open3D cloud with Open3D's normals."""
    cloud = _cloud(points).voxel_down_sample(voxel)
    cloud.estimate_normals(open3d().geometry.KDTreeSearchParamHybrid(radius=2 * voxel, max_nn=30))
    return cloud


def _icp(source: Any, target: Any, distance: float, start: Array) -> Any:
    """Run Open3D's point-to-plane ICP; the result's transformation is target_from_source."""
    pipelines = open3d().pipelines.registration
    return pipelines.registration_icp(source, target, distance, start, pipelines.TransformationEstimationPointToPlane())
