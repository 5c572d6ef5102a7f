"""Pose-graph optimization: all accepted registrations of a segment together (Open3D's Levenberg-Marquardt)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from greenhouse_gym.geometry import Array, invert
from greenhouse_gym.open3d_loader import open3d


class Edge(NamedTuple):
    """An accepted registration: ``first_from_second`` (4, 4) and its ``information`` (6, 6), rotation first."""

    first_from_second: Array
    information: Array


Edges = Mapping[tuple[int, int], Edge]
"""By the numbers of the earlier and the later station."""


def optimize(stations: Sequence[int], edges: Edges, distance: float) -> Array:
    """Poses (k, 4, 4) of ``stations`` in the first one's frame.

    Args:
        stations: Their numbers; an edge must join each to the next.
        edges: Registrations; those between other stations are left out.
        distance: Within which partners were looked for, metres.
    """
    pipelines = open3d().pipelines.registration
    graph = pipelines.PoseGraph()
    poses = [np.eye(4)]
    for earlier, later in pairwise(stations):
        poses.append(poses[-1] @ edges[earlier, later].first_from_second)
    for first_from_station in poses:
        graph.nodes.append(pipelines.PoseGraphNode(first_from_station))
    number = {station: k for k, station in enumerate(stations)}
    own = {(a, b): edge for (a, b), edge in edges.items() if a in number and b in number}
    for (earlier, later), edge in own.items():
        graph.edges.append(
            pipelines.PoseGraphEdge(
                number[later], number[earlier], edge.first_from_second, edge.information, uncertain=False
            )
        )
    if len(own) >= len(stations):  # else a chain, which fits as it is
        pipelines.global_optimization(
            graph,
            pipelines.GlobalOptimizationLevenbergMarquardt(),
            pipelines.GlobalOptimizationConvergenceCriteria(),
            pipelines.GlobalOptimizationOption(max_correspondence_distance=distance, reference_node=0),
        )
    optimized = np.array([node.pose for node in graph.nodes])
    return np.round(invert(optimized[0]) @ optimized, 9)
