"""Organs of a plant as triangle meshes, and the truth that follows from them: ellipsoids of fruit, axes of stems."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from greenhouse_gym.crop import STEM_KINDS, Stem
from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array, Ellipsoid, transform

OrganKind = Literal[
    "fruit", "calyx", "leaf", "petiole", "main", "peduncle", "pedicel", "flower", "string", "pipe", "gutter"
]
ORGAN_KINDS: tuple[str, ...] = get_args(OrganKind)


@dataclass(frozen=True, eq=False)
class Organ:
    """One organ of a plant, or a fixture of the row, as a triangle mesh in the world frame (metres).

    Triangles wind counter-clockwise seen from outside, of a leaf from above.

    Attributes:
        kind: One of `ORGAN_KINDS`.
        vertices: (v, 3) metres.
        triangles: (t, 3) indices of vertices.
        colors: (t, 3) red, green and blue from 0 to 1 under white light.
        plant: Number of the plant within the row; -1 for fixtures.
        truss: Number of the truss it belongs to, or None.
        fruit: Index into the row's tomatoes, or None.
        axis: (k, 4) points on the axis of a tube and its radius there, metres, or None.
    """

    kind: OrganKind
    vertices: Array
    triangles: npt.NDArray[np.int64]
    colors: Array
    plant: int = -1
    truss: int | None = None
    fruit: int | None = None
    axis: Array | None = None

    def __post_init__(self) -> None:
        require_choice("organ kind", self.kind, ORGAN_KINDS)
        vertices, triangles = np.asarray(self.vertices, dtype=np.float64), np.asarray(self.triangles)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise InvalidValueError(f"{self.kind}: vertices must be finite and (v, 3), got shape {vertices.shape}")
        if triangles.ndim != 2 or triangles.shape[1:] != (3,) or not len(triangles):
            raise InvalidValueError(f"{self.kind}: triangles must be (t, 3) with t > 0, got shape {triangles.shape}")
        if triangles.min() < 0 or triangles.max() >= len(vertices):
            raise InvalidValueError(f"{self.kind}: triangles name vertices beyond the {len(vertices)} there are")
        if np.shape(self.colors) != (len(triangles), 3) or not np.isfinite(self.colors).all():
            raise InvalidValueError(
                f"{self.kind}: colors must be finite and ({len(triangles)}, 3), got shape {np.shape(self.colors)}"
            )
        if (empty := int(np.count_nonzero(areas(vertices, triangles) <= 0))) > 0:
            raise InvalidValueError(f"{self.kind}: {empty} of {len(triangles)} triangles have no area")
        if self.kind == "fruit" and volume(vertices, triangles) <= 0:
            raise InvalidValueError("fruit: its triangles wind inwards; expected counter-clockwise seen from outside")

    def moved(self, target_from_source: Array) -> Organ:
        """The organ after a rigid motion (4, 4)."""
        axis = None
        if self.axis is not None:
            axis = np.column_stack([transform(target_from_source, self.axis[:, :3]), self.axis[:, 3]])
        return replace(self, vertices=transform(target_from_source, self.vertices), axis=axis)


def areas(vertices: Array, triangles: npt.NDArray[np.int64]) -> Array:
    """Areas (t,) of triangles, square metres."""
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def volume(vertices: Array, triangles: npt.NDArray[np.int64]) -> float:
    """The volume a closed mesh encloses, cubic metres; negative where its triangles wind inwards."""
    a, b, c = (vertices - vertices.mean(axis=0))[triangles].transpose(1, 0, 2)
    return float((np.cross(a, b) * c).sum() / 6)


def fruit_ellipsoid(vertices: Array, rotation: Array) -> Ellipsoid:
    """The ellipsoid with the volume center and the second moments of a fruit's convex hull, along given axes.

    The hull makes ribs, holes and the way triangles wind irrelevant.

    Args:
        vertices: (v, 3) of the skin.
        rotation: (3, 3) world_from_fruit, which the ellipsoid keeps.

    Raises:
        InvalidValueError: The vertices enclose nothing.
    """
    local = vertices @ rotation
    try:
        hull = ConvexHull(local)
    except QhullError as error:
        raise InvalidValueError(f"fruit: its {len(vertices)} vertices enclose no volume") from error
    inside = local[hull.vertices].mean(axis=0)
    corners = local[hull.simplices] - inside  # tetrahedra with their fourth corner at the origin
    volumes = np.abs((np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum(axis=1)) / 6
    total = volumes.sum()
    center = (volumes[:, None] * corners.sum(axis=1) / 4).sum(axis=0) / total
    squares = (corners**2).sum(axis=1) + corners.sum(axis=1) ** 2
    moments = (volumes[:, None] * squares / 20).sum(axis=0) / total - center**2
    semi_axes = np.sqrt(5 * moments)  # of an ellipsoid's second moments, a^2 / 5
    semi_axes *= np.cbrt(total / (4 / 3 * np.pi * semi_axes.prod()))
    return Ellipsoid((inside + center) @ rotation.T, semi_axes, rotation)


def stems_of(organs: Iterable[Organ]) -> tuple[Stem, ...]:
    """Capsules along the axes of those organs that are stems, each with the mean of its ends' radii."""
    return tuple(
        Stem(a[:3], b[:3], float((a[3] + b[3]) / 2), kind=organ.kind)  # type: ignore[arg-type]
        for organ in organs
        if organ.kind in STEM_KINDS and organ.axis is not None
        for a, b in pairwise(organ.axis)
    )


def tube(axis: Array, around: int = 8) -> tuple[Array, npt.NDArray[np.int64]]:
    """A closed tube along points (k, 4) with radii, as vertices (v, 3) and triangles (t, 3) that wind outwards."""
    points, radii = axis[:, :3], axis[:, 3]
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along[0], np.eye(3)[np.abs(along[0]).argmin()])
    rings = []
    angles = np.arange(around) * 2 * np.pi / around
    for point, direction, radius in zip(points, along, radii, strict=True):
        side = side - (side @ direction) * direction  # carried along without twist
        side /= np.linalg.norm(side)
        up = np.cross(direction, side)
        rings.append(point + radius * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * up))
    count = len(points)
    vertices = np.concatenate([*rings, points[:1], points[-1:]])
    grid = np.arange(count * around).reshape(count, around)
    a, b = grid[:-1], grid[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    sides = np.concatenate([np.stack([a, d, c], axis=-1), np.stack([a, c, b], axis=-1)]).reshape(-1, 3)
    first, last = grid[0], grid[-1]
    start, end = np.full(around, count * around), np.full(around, count * around + 1)
    caps = [np.column_stack([start, np.roll(first, -1), first]), np.column_stack([end, last, np.roll(last, -1)])]
    return vertices, np.concatenate([sides, *caps])
