"""Plant organs as triangle meshes, and the shapes derived from them: ellipsoids of fruit, axes of stems."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crops.parts import STEM_KINDS, Stem
from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array, Ellipsoid, transform

OrganKind = Literal[
    "fruit", "calyx", "leaf", "petiole", "main", "peduncle", "pedicel", "flower", "string", "pipe", "gutter"
]
ORGAN_KINDS: tuple[str, ...] = get_args(OrganKind)

THIN_KINDS = ("leaf", "calyx", "flower")
"""Kinds of organs that are sheets: light passes through them, and thin boxes represent them."""


@dataclass(frozen=True, eq=False)
class Organ:
    """One organ of a plant, or a fixture of the row, as a triangle mesh in the world frame (metres).

    Triangles wind counter-clockwise seen from outside, those of leaves from above.

    Attributes:
        kind: One of `ORGAN_KINDS`.
        vertices: (v, 3) metres.
        triangles: (t, 3) indices of vertices.
        colors: (t, 3) red, green and blue from 0 to 1 under white light.
        truss: Number of the truss it belongs to, or None.
        fruit: Index into the row's tomatoes, or None.
        axis: (k, 4) points on the axis of a tube and its radius there, metres, or None.
    """

    kind: OrganKind
    vertices: Array
    triangles: npt.NDArray[np.int64]
    colors: Array
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
            raise InvalidValueError(f"{self.kind}: triangles refer to vertices beyond the {len(vertices)} given")
        if np.shape(self.colors) != (len(triangles), 3) or not np.isfinite(self.colors).all():
            raise InvalidValueError(
                f"{self.kind}: colors must be finite and ({len(triangles)}, 3), got shape {np.shape(self.colors)}"
            )
        if (empty := int(np.count_nonzero(areas(vertices, triangles) <= 0))) > 0:
            raise InvalidValueError(f"{self.kind}: {empty} of {len(triangles)} triangles have no area")
        if self.kind == "fruit" and volume(vertices, triangles) <= 0:
            raise InvalidValueError("fruit: its triangles wind inwards; expected counter-clockwise seen from outside")

    def transformed(self, target_from_source: Array) -> Organ:
        """Express the organ in another frame, given by a pose (4, 4)."""
        axis = None
        if self.axis is not None:
            axis = np.column_stack([transform(target_from_source, self.axis[:, :3]), self.axis[:, 3]])
        return replace(self, vertices=transform(target_from_source, self.vertices), axis=axis)


def areas(vertices: Array, triangles: npt.NDArray[np.int64]) -> Array:
    """Return the areas (t,) of triangles, square metres."""
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def volume(vertices: Array, triangles: npt.NDArray[np.int64]) -> float:
    """Return the volume enclosed by a closed mesh, cubic metres; negative if its triangles wind inwards."""
    a, b, c = (vertices - vertices.mean(axis=0))[triangles].transpose(1, 0, 2)
    return float((np.cross(a, b) * c).sum() / 6)


def fruit_ellipsoid(vertices: Array, triangles: npt.NDArray[np.int64], rotation: Array) -> Ellipsoid:
    """Return the ellipsoid with the volume, centroid and second moments of a closed mesh, along given axes.

    Args:
        vertices: (v, 3) vertices of the skin.
        triangles: (t, 3) triangles, wound outwards.
        rotation: (3, 3) world_from_fruit; the rotation of the ellipsoid.

    Raises:
        InvalidValueError: The mesh encloses no volume.
    """
    local = vertices @ rotation
    middle = local.mean(axis=0)
    corners = (local - middle)[triangles]  # tetrahedra with their fourth corner at the origin
    volumes = (np.cross(corners[:, 0], corners[:, 1]) * corners[:, 2]).sum(axis=1) / 6
    total = volumes.sum()
    if total <= 0:
        raise InvalidValueError("fruit: the skin encloses no volume, or its triangles wind inwards")
    sums = corners.sum(axis=1)
    center = volumes @ sums / 4 / total
    moments = volumes @ ((corners**2).sum(axis=1) + sums**2) / 20 / total - center**2
    semi_axes = np.sqrt(5 * moments)  # an ellipsoid's second moments are a^2 / 5
    semi_axes *= np.cbrt(total / (4 / 3 * np.pi * semi_axes.prod()))
    return Ellipsoid((middle + center) @ rotation.T, semi_axes, rotation)


def stems_of(organs: Iterable[Organ]) -> tuple[Stem, ...]:
    """Return capsules along the axes of stem organs, each with the mean radius of its ends."""
    return tuple(
        Stem(a[:3], b[:3], float((a[3] + b[3]) / 2), kind=organ.kind)  # type: ignore[arg-type]
        for organ in organs
        if organ.kind in STEM_KINDS and organ.axis is not None
        for a, b in pairwise(organ.axis)
    )


def tube(axis: Array, around: int = 8) -> tuple[Array, npt.NDArray[np.int64]]:
    """Return vertices (v, 3) and outward triangles (t, 3) of a closed tube along points with radii (k, 4)."""
    points, radii = axis[:, :3], axis[:, 3]
    along = np.gradient(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.linalg.svd(along)[2][2]  # the direction least along the tube, so it hardly twists
    side = across - (along @ across)[:, None] * along
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angles = np.arange(around)[:, None, None] * 2 * np.pi / around
    rings = points + radii[:, None] * (np.cos(angles) * side + np.sin(angles) * np.cross(along, side))
    count = len(points)
    vertices = np.concatenate([rings.transpose(1, 0, 2).reshape(-1, 3), points[:1], points[-1:]])
    grid = np.arange(count * around).reshape(count, around)
    a, b = grid[:-1], grid[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    sides = np.concatenate([np.stack([a, d, c], axis=-1), np.stack([a, c, b], axis=-1)]).reshape(-1, 3)
    first, last = grid[0], grid[-1]
    start, end = np.full(around, count * around), np.full(around, count * around + 1)
    caps = [np.column_stack([start, np.roll(first, -1), first]), np.column_stack([end, last, np.roll(last, -1)])]
    return vertices, np.concatenate([sides, *caps])


def tube_organ(
    kind: OrganKind,
    axis: Array,
    color: Array | tuple[float, float, float],
    truss: int | None = None,
    around: int = 8,
) -> Organ:
    """Return an organ that is a tube along an axis (k, 4) of points and radii, in one color (3,)."""
    vertices, triangles = tube(axis, around)
    return Organ(kind, vertices, triangles, np.tile(color, (len(triangles), 1)), truss, None, axis)
