"""Silhouettes of single spheres, ellipsoids, capsules and boxes in an image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.geometry import Array, Box, Capsule, Ellipsoid, Shape, transform

_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


class Silhouette(NamedTuple):
    """Pixels that an object covers when nothing else is in the image.

    Attributes:
        image: Rows and columns of the part of the image that it may cover.
        covered: Mask of the covered pixels of that part.
        whole: Number of pixels that it would cover in an unbounded image.
    """

    image: tuple[slice, slice]
    covered: npt.NDArray[np.bool_]
    whole: int


@dataclass(frozen=True, eq=False)
class Outlines:
    """Objects as balls around eight points each: corners of a box, ends of a capsule or center of a sphere, repeated.

    Attributes:
        points: (n, 8, 3) metres.
        radii: (n,) metres; 0 for boxes, the longest semi-axis for ellipsoids.
        axes: (n, 3, 3) semi-axes of ellipsoids as columns, metres; NaN for all others.
    """

    points: Array
    radii: Array
    axes: Array

    @classmethod
    def of(cls, shapes: Sequence[Shape]) -> Outlines:
        """Return the outlines of shapes, in their frame."""
        points, radii = np.empty((len(shapes), 8, 3)), np.zeros(len(shapes))
        axes = np.full((len(shapes), 3, 3), np.nan)
        for i, shape in enumerate(shapes):
            if isinstance(shape, Box):
                points[i] = shape.center + (_CORNERS * shape.half_extents) @ shape.rotation.T
                continue
            radii[i] = shape.radius
            points[i] = np.repeat([shape.start, shape.end], 4, axis=0) if isinstance(shape, Capsule) else shape.center
            if isinstance(shape, Ellipsoid):
                radii[i] = shape.semi_axes.max()
                axes[i] = shape.rotation * shape.semi_axes
        return cls(points, radii, axes)

    def seen_from(self, camera_from_world: Array) -> Outlines:
        """Return these outlines in a camera's frame."""
        points = transform(camera_from_world, self.points.reshape(-1, 3)).reshape(-1, 8, 3)
        return Outlines(points, self.radii, camera_from_world[:3, :3] @ self.axes)

    def in_view(self, k: Intrinsics, farthest: float, of: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
        """Return indices of the objects ``of`` (n,) that may be visible: ahead and nearer than ``farthest`` (m)."""
        z = self.points[..., 2]
        ahead = of & (z.min(axis=1) > 2 * self.radii + 0.01) & (z.min(axis=1) < farthest)
        u, v, margin = _projected(np.where(ahead[:, None, None], self.points, [0.0, 0.0, 1.0]), self.radii[:, None], k)
        across = ((u + margin).max(axis=1) > 0) & ((u - margin).min(axis=1) < k.width)
        down = ((v + margin).max(axis=1) > 0) & ((v - margin).min(axis=1) < k.height)
        return np.flatnonzero(ahead & across & down)

    def silhouette(self, i: int, k: Intrinsics) -> Silhouette:
        """Return the silhouette of object ``i``, which is in the camera's frame and in front of the camera."""
        points, radius = self.points[i], float(self.radii[i])
        u, v, margin = _projected(points, radius, k)
        spans = [(int(np.floor((w - margin).min())), int(np.ceil((w + margin).max())) + 1) for w in (v, u)]
        y, x = ((np.arange(*span) - c) / f for span, c, f in zip(spans, (k.cy, k.cx), (k.fy, k.fx), strict=True))
        rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)
        if radius == 0:
            alone = _through_box(rays, points)
        elif np.isfinite(self.axes[i]).all():  # where its semi-axes are unit vectors, an ellipsoid is a unit ball
            unit = np.linalg.inv(self.axes[i])
            alone = _near_segment(rays @ unit.T, unit @ points[0], unit @ points[0], 1.0)
        else:
            alone = _near_segment(rays, points[0], points[-1], radius)
        image, part = [], []
        for (low, high), size in zip(spans, (k.height, k.width), strict=True):
            first, last = min(max(low, 0), size), min(max(high, 0), size)
            image.append(slice(first, last))
            part.append(slice(first - low, last - low))
        return Silhouette((image[0], image[1]), alone[part[0], part[1]], int(np.count_nonzero(alone)))


def _projected(points: Array, radius: float | Array, k: Intrinsics) -> tuple[Array, Array, Array]:
    """Return pixel columns and rows of points in the camera frame, and a bound on the image radius of a ball there."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    margin = 1.3 * radius * max(k.fx, k.fy) / np.maximum(z - radius, 1e-6) + 1.0
    return k.fx * x / z + k.cx, k.fy * y / z + k.cy, margin


def _near_segment(rays: Array, start: Array, end: Array, radius: float) -> npt.NDArray[np.bool_]:
    """Return a mask of the rays (..., 3) from the origin that come within ``radius`` of a segment in front of it.

    A point p = start + t along has the squared distance |p|^2 - (p . ray)^2 / ray^2 from a ray, a quadratic in t whose
    minimum on the segment lies at its vertex or at the end nearer to the vertex.
    """
    along = end - start
    squared = (rays * rays).sum(axis=-1)
    from_start, from_along = rays @ start, rays @ along
    quadratic = along @ along - from_along**2 / squared
    linear = start @ along - from_start * from_along / squared
    t = np.clip(-linear / np.maximum(quadratic, 1e-15), 0.0, 1.0)
    distance = start @ start - from_start**2 / squared + t * (2 * linear + t * quadratic)
    return np.asarray(distance < radius**2)


def _through_box(rays: Array, corners: Array) -> npt.NDArray[np.bool_]:
    """Return a mask of the rays (..., 3) from the origin that hit a box with corners (8, 3), by the slab method."""
    axes = (corners[[4, 2, 1]] - corners[0]) / 2
    axes /= (axes * axes).sum(axis=1, keepdims=True)  # in these coordinates the box reaches from -1 to 1
    origin, direction = -axes @ corners.mean(axis=0), rays @ axes.T
    direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    sides = np.stack([(-1.0 - origin) / direction, (1.0 - origin) / direction])
    return np.asarray(sides.min(axis=0).max(axis=-1) < sides.max(axis=0).min(axis=-1))
