"""Coverage of a cloud by shapes, and excess of shapes over the true surface; points on the skin of each tomato."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.accuracy.clouds import distance_to_surface
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import (
    Array,
    Box,
    Capsule,
    Ellipsoid,
    Shape,
    Sphere,
    bounding_balls,
    distance_to_nearest,
    distance_to_shapes,
    frame_along,
)
from greenhouse_gym.geometry.point_clouds import Cloud

COVERED_WITHIN = 0.008
"""Largest distance from a shape at which a point counts as covered, metres."""

EXCESS_BEYOND = 0.015
"""Distance from every true surface beyond which a shape's surface counts as excess, metres."""

_SAMPLES = 20_000  # points of a cloud, or on all surfaces

_ON_SKIN = 0.003
"""Largest distance of a skin point from a tomato's surface, metres, given the noise of a depth camera."""

_MIN_COSINE = 0.5
"""Smallest cosine between a skin point's normal and the direction away from the tomato's center."""


def coverage(points: Array, shapes: Sequence[Shape]) -> float:
    """Return the fraction of points (n, 3), evenly sampled, that lie inside or within `COVERED_WITHIN` of a shape."""
    thinned = points[:: max(1, len(points) // _SAMPLES)]
    return float((distance_to_nearest(thinned, shapes, COVERED_WITHIN) <= COVERED_WITHIN).mean())


def excess(shapes: Sequence[Shape], truth: PlantRow) -> float:
    """Return the fraction of the shapes' outer surface farther than `EXCESS_BEYOND` from every true surface.

    Surface inside another shape or inside a true solid does not count.

    Args:
        shapes: The shapes, in the world.
        truth: The grown row.
    """
    points = outer_samples(shapes, _SAMPLES, np.random.default_rng(0))
    if not len(points):
        return 0.0
    far = points[distance_to_surface(points, truth, len(points)) > EXCESS_BEYOND]
    solids: list[Shape] = []
    row: PlantRow | None = truth
    while row is not None:
        solids += row.shapes
        row = row.behind
    return float(np.count_nonzero(distance_to_nearest(far, solids, 0.0) > 0) / len(points))


def outer_samples(shapes: Sequence[Shape], count: int, rng: np.random.Generator) -> Array:
    """Sample ``count`` points on all surfaces and return those (n, 3) that lie inside no other shape."""
    if not shapes:
        return np.zeros((0, 3))
    areas = np.array([_area(shape) for shape in shapes])
    counts = rng.multinomial(count, areas / areas.sum())
    outer = []
    for index, shape in enumerate(shapes):
        points = _on_surface(shape, int(counts[index]), rng)
        others = [*shapes[:index], *shapes[index + 1 :]]
        outer.append(points[distance_to_nearest(points, others, 0.0) >= 0])
    return np.concatenate(outer)


def _area(shape: Shape) -> float:
    if isinstance(shape, Box):
        return float(8 * (shape.half_extents * np.roll(shape.half_extents, 1)).sum())
    length = shape.length if isinstance(shape, Capsule) else 0.0
    return 4 * np.pi * shape.radius**2 + 2 * np.pi * shape.radius * length


def _on_surface(shape: Shape, count: int, rng: np.random.Generator) -> Array:
    """Return points (count, 3) spread evenly over a shape's surface."""
    if isinstance(shape, Box):
        half = shape.half_extents
        faces = np.array([half[1] * half[2], half[2] * half[0], half[0] * half[1]])
        axis = rng.choice(3, count, p=faces / faces.sum())
        local = rng.uniform(-1.0, 1.0, (count, 3))
        local[np.arange(count), axis] = rng.choice([-1.0, 1.0], count)
        return np.asarray(shape.center + (local * half) @ shape.rotation.T)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    if isinstance(shape, Sphere):
        return np.asarray(shape.center + shape.radius * directions)
    if isinstance(shape, Ellipsoid):  # uniform by angle, which for fruit is uniform by area to a few percent
        return np.asarray(shape.center + (directions * shape.semi_axes) @ shape.rotation.T)
    length, radius = shape.length, shape.radius
    on_side = rng.random(count) < length / (length + 2 * radius)
    angle, height = rng.uniform(0, 2 * np.pi, count), rng.uniform(-0.5, 0.5, count)
    side = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), length * height])
    ends = radius * directions + np.outer(np.copysign(length / 2, directions[:, 2]), [0.0, 0.0, 1.0])
    local = np.where(on_side[:, None], side, ends)
    frame = frame_along(shape.end - shape.start) if length > 1e-9 else np.eye(3)
    return np.asarray((shape.start + shape.end) / 2 + local @ frame.T)


def skin_points(cloud: Cloud, tomatoes: Sequence[Tomato]) -> npt.NDArray[np.int64]:
    """Count the points (k,) of a cloud that are skin of each tomato: on its surface and facing outwards.

    Args:
        cloud: Points with normals, in the tomatoes' frame.
        tomatoes: The k tomatoes.
    """
    tree = cKDTree(cloud.points)
    counts = np.zeros(len(tomatoes), dtype=np.int64)
    for k, tomato in enumerate(tomatoes):
        reach = float(bounding_balls([tomato.shape])[1][0]) + _ON_SKIN
        near = np.array(tree.query_ball_point(tomato.center, reach), dtype=np.int64)
        away = cloud.points[near] - tomato.center
        outwards = (away * cloud.normals[near]).sum(axis=1) > _MIN_COSINE * np.linalg.norm(away, axis=1)
        on = np.abs(distance_to_shapes(cloud.points[near], [tomato.shape])[:, 0]) < _ON_SKIN
        counts[k] = np.count_nonzero(on & outwards)
    return counts
