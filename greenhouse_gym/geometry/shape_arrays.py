"""Shapes as arrays, for computations over all shapes of a scene at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry.arrays import Array
from greenhouse_gym.geometry.shapes import Box, Capsule, Ellipsoid, Shape, Sphere, unchecked

SPHERE, CAPSULE, ELLIPSOID, BOX = range(4)
TYPES: tuple[type[Shape], ...] = (Sphere, Capsule, Ellipsoid, Box)
"""Types of shapes by their kinds."""

FIELDS = (
    ("center", "center", "radius"),
    ("start", "end", "radius"),
    ("center", "center", "semi_axes"),
    ("center", "center", "half_extents"),
)
"""Start, end and size of each kind."""


class ShapeArrays(NamedTuple):
    """Shapes as arrays; lengths in metres.

    Attributes:
        kinds: (n,) `SPHERE`, `CAPSULE`, `ELLIPSOID` or `BOX`.
        starts: (n, 3) starts of capsules, centers of other shapes.
        ends: (n, 3) ends of capsules, centers of other shapes.
        sizes: (n, 3) semi-axes of ellipsoids and half extents of boxes; the radius of other shapes and two zeros.
        rotations: (n, 3, 3) of ellipsoids and boxes; the identity for other shapes.
    """

    kinds: npt.NDArray[np.int8]
    starts: Array
    ends: Array
    sizes: Array
    rotations: Array

    @classmethod
    def empty(cls, count: int) -> ShapeArrays:
        """Return arrays of shapes that are to be filled in: points without rotation."""
        starts, ends, sizes = np.zeros((3, count, 3))
        return cls(np.zeros(count, np.int8), starts, ends, sizes, np.tile(np.eye(3), (count, 1, 1)))

    @classmethod
    def of_boxes(cls, centers: Array, half_extents: Array) -> ShapeArrays:
        """Return boxes (n, 3), (n, 3) along the axes."""
        rotations = np.tile(np.eye(3), (len(centers), 1, 1))
        return cls(np.full(len(centers), BOX, np.int8), centers, centers, half_extents, rotations)

    @classmethod
    def joined(cls, parts: Sequence[ShapeArrays]) -> ShapeArrays:
        """Return all shapes of some arrays."""
        return cls._make(np.concatenate([part[k] for part in parts]) for k in range(len(cls._fields)))

    def select(self, chosen: slice | npt.NDArray[np.integer]) -> ShapeArrays:
        """Return the shapes at the given indices."""
        return ShapeArrays._make(array[chosen] for array in self)


def arrays_of(shapes: Sequence[Shape]) -> ShapeArrays:
    """Convert shapes to arrays."""
    result = ShapeArrays.empty(len(shapes))
    for kind, shape_type in enumerate(TYPES):
        rows = [k for k, shape in enumerate(shapes) if isinstance(shape, shape_type)]
        if not rows:
            continue
        chosen = [shapes[k] for k in rows]
        first, last, size = FIELDS[kind]
        result.kinds[rows] = kind
        result.starts[rows] = [getattr(shape, first) for shape in chosen]
        result.ends[rows] = result.starts[rows] if first == last else [getattr(shape, last) for shape in chosen]
        sizes = np.array([getattr(shape, size) for shape in chosen]).reshape(len(rows), -1)
        result.sizes[rows, : sizes.shape[1]] = sizes
        if kind in (ELLIPSOID, BOX):
            result.rotations[rows] = [shape.rotation for shape in chosen if isinstance(shape, Ellipsoid | Box)]
    return result


def shapes_from(arrays: ShapeArrays) -> list[Shape]:
    """Convert arrays back to shapes; their fields are views of the arrays."""
    views = [array.view() for array in arrays[1:]]
    for view in views:
        view.setflags(write=False)
    made: list[Shape] = []
    for kind, start, end, size, rotation in zip(arrays.kinds.tolist(), *views, strict=True):
        if kind == SPHERE:
            made += unchecked(Sphere, ("center", "radius"), [(start, float(size[0]))])
        elif kind == CAPSULE:
            made += unchecked(Capsule, ("start", "end", "radius"), [(start, end, float(size[0]))])
        elif kind == BOX:
            made += unchecked(Box, ("center", "half_extents", "rotation"), [(start, size, rotation)])
        else:
            row = start, size, rotation, float(np.cbrt(size.prod()))
            made += unchecked(Ellipsoid, ("center", "semi_axes", "rotation", "radius"), [row])
    return made
