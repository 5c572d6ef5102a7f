"""Pose-graph optimization: all accepted registrations of a segment together (Open3D's Levenberg-Marquardt)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.geometry import Array, invert


class PoseEdge(NamedTuple):
    """An accepted registration: ``first_from_second`` (4, 4) and its ``information`` (6, 6), rotation first."""

    first_from_second: Array
    information: Array


PoseEdges = Mapping[tuple[int, int], PoseEdge]
"""Registrations by the numbers of the earlier and the later station."""


def optimize_poses(stations: Sequence[int], edges: PoseEdges, distance: float) -> Array:
    """Return poses (k, 4, 4) of ``stations`` in the first one's frame.

    Edges must connect them all; those of other stations are ignored. ``distance`` is that of partners, metres.
    """
    pipelines = open3d().pipelines.registration
    graph = pipelines.PoseGraph()
    for first_from_station in _chained_poses(stations, edges):
        graph.nodes.append(pipelines.PoseGraphNode(first_from_station))
    number = {station: k for k, station in enumerate(stations)}
    own = {(a, b): edge for (a, b), edge in edges.items() if a in number and b in number}
    for (earlier, later), edge in own.items():
        graph.edges.append(
            pipelines.PoseGraphEdge(
                number[later], number[earlier], edge.first_from_second, edge.information, uncertain=False
            )
        )
    if len(own) >= len(stations):  # else a chain, which has no residual
        pipelines.global_optimization(
            graph,
            pipelines.GlobalOptimizationLevenbergMarquardt(),
            pipelines.GlobalOptimizationConvergenceCriteria(),
            pipelines.GlobalOptimizationOption(max_correspondence_distance=distance, reference_node=0),
        )
    optimized = np.array([node.pose for node in graph.nodes])
    return np.round(invert(optimized[0]) @ optimized, 9)


def _chained_poses(stations: Sequence[int], edges: PoseEdges) -> list[Array]:
    """Return poses of ``stations`` in the first one's frame by single edges, from the station before where possible.

    Raises:
        ValueError: The edges do not connect them all.
    """
    poses = {stations[0]: np.eye(4)}
    waiting = list(pairwise(stations))
    while waiting:
        left = []
        for before, station in waiting:
            pose = _pose_by_edge(station, [before, *poses], poses, edges)
            if pose is None:
                left.append((before, station))
            else:
                poses[station] = pose
        if len(left) == len(waiting):
            raise ValueError(f"no edges connect stations {[station for _, station in left]} to the others")
        waiting = left
    return [poses[station] for station in stations]


def _pose_by_edge(station: int, others: Sequence[int], poses: Mapping[int, Array], edges: PoseEdges) -> Array | None:
    """Return the pose of a station by its edge to the first of the others that has a pose and shares one."""
    for other in others:
        if other in poses and (other, station) in edges:
            return poses[other] @ edges[other, station].first_from_second
        if other in poses and (station, other) in edges:
            return poses[other] @ invert(edges[station, other].first_from_second)
    return None
