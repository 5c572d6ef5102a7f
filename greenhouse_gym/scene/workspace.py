"""Shapes in the workspace of an arm: in its frame, within its reach, limited in number."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.crops.shape_tables import ShapeParts
from greenhouse_gym.geometry import Array, Box, Capsule, Ellipsoid, Shape, Sphere, distance_to_shapes, transform
from greenhouse_gym.scene.obstacles import ArmPlacement

DECIMALS = 5
"""Decimals of a length in a scene, metres: 0.01 mm."""

REACH = 1.35
"""Distance from the shoulder at which shapes are left out of a scene, metres."""

Part = TypeVar("Part", bound=Tomato | Shape)


def shoulder_point() -> Array:
    """Return the shoulder (3,) in the frame of a scene, metres."""
    return np.array([0.0, 0.0, ArmPlacement().shoulder_height])


def within_reach(parts: ShapeParts, reach: float, width: float = np.inf) -> ShapeParts:
    """Select the shapes within the arm's reach whose centers lie within a width along the row.

    Args:
        parts: Shapes in the frame of a scene.
        reach: Distance from the shoulder to a shape's surface, metres.
        width: Width along the row with the arm in its middle, metres.
    """
    along = np.array([abs(middle(shape)[1]) for shape in parts.shapes])
    return parts.select((_distance_to_shoulder(parts) < reach) & (along < width / 2))


def keep_nearest(parts: ShapeParts, count: int) -> ShapeParts:
    """Select at most ``count`` shapes: other shapes before pedicels, which matter least, and near ones before far ones.

    Args:
        parts: Shapes in the frame of a scene.
        count: Maximum number of shapes.
    """
    pedicel = np.array([isinstance(shape, Stem) and shape.kind == "pedicel" for shape in parts.shapes])
    keep = np.zeros(len(pedicel), dtype=np.bool_)
    keep[np.lexsort((_distance_to_shoulder(parts), pedicel))[:count]] = True
    return parts.select(keep)


def _distance_to_shoulder(parts: ShapeParts) -> Array:
    return distance_to_shapes(shoulder_point()[None], parts.shapes)[0]


def middle(shape: Shape) -> Array:
    """Return the center (3,) of a shape, metres."""
    return (shape.start + shape.end) / 2 if isinstance(shape, Capsule) else shape.center


def in_frame(part: Part, target_from_source: Array) -> Part:
    """Express a shape or tomato in another frame, given by a pose (4, 4), rounded to 0.01 mm."""
    if isinstance(part, Tomato):
        return replace(part, shape=in_frame(part.shape, target_from_source))

    def point(p: Array) -> Array:
        return np.round(transform(target_from_source, p[None])[0], DECIMALS)

    def rotated(rotation: Array) -> npt.NDArray[np.float64]:
        return np.round(Rotation.from_matrix(target_from_source[:3, :3] @ rotation).as_matrix(), 7)

    if isinstance(part, Box):
        half_extents = np.round(part.half_extents, DECIMALS)
        return replace(part, center=point(part.center), half_extents=half_extents, rotation=rotated(part.rotation))
    radius = round(part.radius, DECIMALS)
    if isinstance(part, Capsule):
        return replace(part, start=point(part.start), end=point(part.end), radius=radius)
    if isinstance(part, Sphere):
        return replace(part, center=point(part.center), radius=radius)
    assert isinstance(part, Ellipsoid)
    axes = np.round(part.semi_axes, DECIMALS)
    return replace(part, center=point(part.center), semi_axes=axes, rotation=rotated(part.rotation), radius=radius)
