"""Shapes as arrays, for computations over all shapes of a scene at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry.arrays import Array
from greenhouse_gym.geometry.shapes import Box, Capsule, Ellipsoid, Shape, Sphere

SPHERE, CAPSULE, ELLIPSOID, BOX = range(4)
_TYPES: tuple[type[Shape], ...] = (Sphere, Capsule, Ellipsoid, Box)


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

    def select(self, chosen: slice | npt.NDArray[np.integer]) -> ShapeArrays:
        """Return the shapes at the given indices."""
        return ShapeArrays._make(array[chosen] for array in self)


def arrays_of(shapes: Sequence[Shape]) -> ShapeArrays:
    """Convert shapes to arrays."""
    result = ShapeArrays.empty(len(shapes))
    for kind, shape_type in enumerate(_TYPES):
        rows = [k for k, shape in enumerate(shapes) if isinstance(shape, shape_type)]
        if not rows:
            continue
        chosen = [shapes[k] for k in rows]
        first, last, size = _FIELDS[kind]
        result.kinds[rows] = kind
        result.starts[rows] = [getattr(shape, first) for shape in chosen]
        result.ends[rows] = result.starts[rows] if first == last else [getattr(shape, last) for shape in chosen]
        sizes = np.array([getattr(shape, size) for shape in chosen]).reshape(len(rows), -1)
        result.sizes[rows, : sizes.shape[1]] = sizes
        if kind in (ELLIPSOID, BOX):
            result.rotations[rows] = [shape.rotation for shape in chosen if isinstance(shape, Ellipsoid | Box)]
    return result


_FIELDS = (
    ("center", "center", "radius"),
    ("start", "end", "radius"),
    ("center", "center", "semi_axes"),
    ("center", "center", "half_extents"),
)
