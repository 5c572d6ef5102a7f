"""Signed distances from many points to many shapes at once; lengths are metres."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry.arrays import Array
from greenhouse_gym.geometry.shape_arrays import ShapeArrays, arrays_of
from greenhouse_gym.geometry.shapes import Box, Capsule, Ellipsoid, Shape, Sphere


def distance_to_spheres(points: npt.ArrayLike, centers: npt.ArrayLike, radii: npt.ArrayLike) -> Array:
    """Return signed distances (n, k), negative inside, from points (n, 3) to spheres: centers (k, 3), radii (k,)."""
    p, c = np.asarray(points, dtype=np.float64), np.asarray(centers, dtype=np.float64).reshape(-1, 3)
    return np.asarray(np.linalg.norm(p[:, None] - c[None], axis=-1) - np.asarray(radii), dtype=np.float64)


def distance_to_ellipsoids(
    points: npt.ArrayLike, centers: npt.ArrayLike, semi_axes: npt.ArrayLike, rotations: npt.ArrayLike
) -> Array:
    """Return signed distances (n, k), negative inside, to ellipsoids; arguments as for `distance_to_boxes`.

    Newton's method on the multiplier of the nearest point (Eberly, Distance from a Point to an Ellipse, an Ellipsoid,
    or a Hyperellipsoid, 2013) starts where it converges from one side. Exact to about 1e-7 of the size.
    """
    p = np.asarray(points, dtype=np.float64)
    c, e = (np.asarray(a, dtype=np.float64).reshape(-1, 3) for a in (centers, semi_axes))
    frames = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
    local = np.abs(np.einsum("kji,nkj->nki", frames, p[:, None] - c[None]))
    squares, smallest = e * e, e.min(axis=1)
    y = np.maximum(local, 1e-7 * smallest[:, None])  # off the symmetry planes, where the multiplier is not unique
    t = (e * y - squares).max(axis=-1)
    for _ in range(_NEWTON_STEPS):
        ratios = e * y / (t[..., None] + squares)
        excess = (ratios * ratios).sum(-1) - 1.0
        slope = -2.0 * (ratios * ratios / (t[..., None] + squares)).sum(-1)
        t = t - excess / slope
    nearest = squares * y / (t[..., None] + squares)
    inside = ((local / e) ** 2).sum(-1) < 1.0
    return np.asarray(np.where(inside, -1.0, 1.0) * np.linalg.norm(y - nearest, axis=-1), dtype=np.float64)


_NEWTON_STEPS = 9


def closest_on_segments(points: npt.ArrayLike, starts: npt.ArrayLike, ends: npt.ArrayLike) -> Array:
    """Return the closest points (n, k, 3) to points (n, 3) on the segments from starts (k, 3) to ends (k, 3)."""
    p = np.asarray(points, dtype=np.float64)[:, None]
    a, b = (np.asarray(e, dtype=np.float64).reshape(-1, 3)[None] for e in (starts, ends))
    axis = b - a
    squared = np.maximum((axis * axis).sum(-1), 1e-18)
    fraction = np.clip(((p - a) * axis).sum(-1) / squared, 0.0, 1.0)
    return np.asarray(a + fraction[..., None] * axis, dtype=np.float64)


def distance_to_capsules(
    points: npt.ArrayLike, starts: npt.ArrayLike, ends: npt.ArrayLike, radii: npt.ArrayLike
) -> Array:
    """Return signed distances (n, k), negative inside, to capsules: ends of their axes (k, 3), (k, 3), radii (k,)."""
    nearest = closest_on_segments(points, starts, ends)
    p = np.asarray(points, dtype=np.float64)[:, None]
    return np.asarray(np.linalg.norm(p - nearest, axis=-1) - np.asarray(radii), dtype=np.float64)


def distance_to_boxes(
    points: npt.ArrayLike, centers: npt.ArrayLike, half_extents: npt.ArrayLike, rotations: npt.ArrayLike
) -> Array:
    """Return signed distances (n, k), negative inside, to boxes: (k, 3), (k, 3), rotations (k, 3, 3) world_from_box."""
    p = np.asarray(points, dtype=np.float64)
    c, h = (np.asarray(e, dtype=np.float64).reshape(-1, 3) for e in (centers, half_extents))
    local = np.einsum("kji,nkj->nki", np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3), p[:, None] - c[None])
    excess = np.abs(local) - h[None]
    outside = np.linalg.norm(np.maximum(excess, 0.0), axis=-1)
    return np.asarray(outside + np.minimum(excess.max(-1), 0.0), dtype=np.float64)


_CHUNK = 4096  # points handled at a time, which bounds the memory for intermediate results
_DISTANCES: dict[type[Shape], tuple[Callable[..., Array], tuple[str, ...]]] = {
    Sphere: (distance_to_spheres, ("center", "radius")),
    Ellipsoid: (distance_to_ellipsoids, ("center", "semi_axes", "rotation")),
    Capsule: (distance_to_capsules, ("start", "end", "radius")),
    Box: (distance_to_boxes, ("center", "half_extents", "rotation")),
}


def distance_to_shapes(points: npt.ArrayLike, shapes: Sequence[Shape]) -> Array:
    """Return signed distances (n, k), negative inside, from points (n, 3) to a mixed list of k shapes.

    Args:
        points: (n, 3) metres.
        shapes: k shapes in the points' frame.
    """
    p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    result = np.empty((len(p), len(shapes)))
    by_kind: dict[type, list[int]] = {kind: [] for kind in _DISTANCES}
    for k, shape in enumerate(shapes):
        by_kind[next(kind for kind in _DISTANCES if isinstance(shape, kind))].append(k)
    for kind, (distance, fields) in _DISTANCES.items():
        columns = by_kind[kind]
        arguments = [np.array([getattr(shapes[k], field) for k in columns]) for field in fields]
        for first in range(0, len(p) if columns else 0, _CHUNK):
            rows = slice(first, first + _CHUNK)
            result[rows, columns] = distance(p[rows], *arguments)
    return result


def bounding_balls(shapes: Sequence[Shape]) -> tuple[Array, Array]:
    """Return centers (k, 3) and radii (k,) of balls that enclose k shapes, metres."""
    balls = [_bounding_ball(shape) for shape in shapes]
    return np.array([center for center, _ in balls]).reshape(-1, 3), np.array([radius for _, radius in balls])


def _bounding_ball(shape: Shape) -> tuple[Array, float]:
    if isinstance(shape, Box):
        return shape.center, float(np.linalg.norm(shape.half_extents))
    if isinstance(shape, Capsule):
        return (shape.start + shape.end) / 2, shape.length / 2 + shape.radius
    return shape.center, float(shape.semi_axes.max()) if isinstance(shape, Ellipsoid) else shape.radius


def distance_to_nearest(points: npt.ArrayLike, shapes: Sequence[Shape] | ShapeArrays, limit: float) -> Array:
    """Return signed distances (n,), negative inside, from points (n, 3) to the nearest shape, exact up to a limit.

    Args:
        points: (n, 3) metres.
        shapes: Shapes in the points' frame.
        limit: Distances up to the limit are exact, metres; larger ones may be too large.
    """
    from greenhouse_gym.geometry.distance_kernels import nearest_distances  # loads numba

    p = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 3)
    nearest = np.empty(len(p))
    nearest_distances(p, *(shapes if isinstance(shapes, ShapeArrays) else arrays_of(shapes)), limit, nearest)
    return nearest
