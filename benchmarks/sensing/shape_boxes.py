"""Measures of how well boxes cover a row's foliage: empty surface, points left out, fruit behind boxes."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, Box, distance_to_shapes
from greenhouse_gym.shapes import RowShapes
from greenhouse_gym.shapes.evidence import nearest_shapes

FAR = 0.015
"""Distance from all points at which a box's surface is empty, and from all shapes at which a point is left out, m."""


def box_figures(shapes: RowShapes, points: Array) -> dict[str, float]:
    """Measure the boxes among a row's shapes against its points (n, 3); world frame, x away from the aisle."""
    tree = cKDTree(points)
    empty = total = 0.0
    for box in shapes.clutter:
        surface, areas = box_surface(box)
        far = np.isinf(tree.query(surface, distance_upper_bound=FAR)[0])
        empty, total = empty + float(areas[far].sum()), total + float(areas.sum())
    fronts = np.array([t.center - [t.radius, 0.0, 0.0] for t in shapes.tomatoes]).reshape(-1, 3)
    inside = len(fronts) and len(shapes.clutter) and (distance_to_shapes(fronts, shapes.clutter) < 0).any(axis=1).mean()
    return {
        "empty_surface": empty / max(total, 1e-9),
        "points_left_out": float((nearest_shapes(points[::5], shapes.shapes, FAR).owner < 0).mean()),
        "fronts_inside": float(inside),
    }


def box_surface(box: Box, spacing: float = 0.01) -> tuple[Array, Array]:
    """Return evenly spaced points (n, 3) on a box's faces and the area (n,) that each represents."""
    points, areas = [], []
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        counts = [max(1, int(np.ceil(2 * box.half_extents[k] / spacing))) for k in others]
        ticks = [(2 * np.arange(n) + 1) / n - 1 for n in counts]
        u, v = (grid.ravel() for grid in np.meshgrid(*ticks))
        for side in (-1.0, 1.0):
            local = np.zeros((len(u), 3))
            local[:, axis], local[:, others[0]], local[:, others[1]] = side, u, v
            points.append(box.center + (local * box.half_extents) @ box.rotation.T)
            areas.append(np.full(len(u), 4 * np.prod(box.half_extents[others]) / len(u)))
    return np.concatenate(points), np.concatenate(areas)
