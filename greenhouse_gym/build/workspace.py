"""The shapes around an arm: in the frame of its stand, within its reach, and no more of them than a scene holds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Array, Box, Capsule, Shape, distance_to_shapes, transform
from greenhouse_gym.scene import Stand

DECIMALS = 5
"""Decimals of a length in a scene, metres: 0.01 mm."""


def shoulder_point() -> Array:
    """(3,) the shoulder in the frame of a scene, metres."""
    return np.array([0.0, 0.0, Stand().shoulder_height])


def within_reach(shapes: Sequence[Shape], reach: float, width: float = np.inf) -> list[Shape]:
    """The shapes within the arm's reach whose middles lie within a width along the row.

    Args:
        shapes: In the frame of a scene.
        reach: Metres from the shoulder to a shape's surface.
        width: Metres along the row, the arm in the middle.
    """
    if not shapes:
        return []
    distance = distance_to_shapes(shoulder_point()[None], shapes)[0]
    return [
        shape for shape, far in zip(shapes, distance, strict=True) if far < reach and abs(middle(shape)[1]) < width / 2
    ]


def at_most(parts: Sequence[list[Shape]], most: int) -> list[list[Shape]]:
    """All shapes if they are few enough; else the pedicels, which matter least, go first, those far away before others.

    What is still too much goes by its distance from the shoulder: the arm meets the farthest last.

    Args:
        parts: Tomatoes, stems, clutter, or any others, in the frame of a scene.
        most: How many shapes may stay in all parts together.
    """
    everything = [shape for part in parts for shape in part]
    if len(everything) <= most:
        return list(parts)
    distance = distance_to_shapes(shoulder_point()[None], everything)[0]
    pedicel = [isinstance(shape, Stem) and shape.kind == "pedicel" for shape in everything]
    keep = {id(everything[i]) for i in np.lexsort([distance, pedicel])[:most]}
    return [[shape for shape in part if id(shape) in keep] for part in parts]


def middle(shape: Shape) -> Array:
    """(3,) the middle of a shape, metres."""
    return (shape.start + shape.end) / 2 if isinstance(shape, Capsule) else shape.center


def in_frame(shape: Shape, target_from_source: Array) -> Shape:
    """A shape expressed in another frame, rounded to 0.01 mm.

    Args:
        shape: In the frame source.
        target_from_source: (4, 4) pose of that frame in the frame target.
    """

    def point(p: Array) -> Array:
        return np.round(transform(target_from_source, p[None])[0], DECIMALS)

    if isinstance(shape, Box):
        turned = Rotation.from_matrix(target_from_source[:3, :3] @ shape.rotation).as_matrix()
        return Box(point(shape.center), np.round(shape.half_extents, DECIMALS), np.round(turned, 7))
    radius = round(shape.radius, DECIMALS)
    if isinstance(shape, Tomato):
        turned_axes = None
        if shape.rotation is not None:
            turned_axes = np.round(Rotation.from_matrix(target_from_source[:3, :3] @ shape.rotation).as_matrix(), 7)
        axes = None if shape.semi_axes is None else np.round(shape.semi_axes, DECIMALS)
        return Tomato(point(shape.center), radius, shape.truss, shape.ripeness, axes, turned_axes)
    if isinstance(shape, Stem):
        return Stem(point(shape.start), point(shape.end), radius, shape.kind)
    if isinstance(shape, Capsule):
        return Capsule(point(shape.start), point(shape.end), radius)
    return type(shape)(point(shape.center), radius)
