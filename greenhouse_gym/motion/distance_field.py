"""Distance fields: distance and direction to the nearest obstacle, looked up in a grid instead of computed.

A field covers a box in front of the arm, in the frame of the arm's base (x forward, z up). It is sampled at nodes
2 cm apart, stored as float16 and capped at `MAX_DISTANCE`. A node whose nearest obstacle is a tomato also stores the
distance without that tomato, so that one field serves every target of a scene. Fields of many scenes are stacked in one
array, so that one lookup serves many simulations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Box, Capsule, Ellipsoid, Shape, distance_to_ellipsoids, transform

Float32 = npt.NDArray[np.float32]

CELL = 0.02
"""Distance between nodes, metres."""

SHAPE = (48, 88, 88)
"""Number of nodes along x, y, z: multiples of the largest block of `distance_field`."""

ORIGIN = (0.10, -0.87, -0.80)
"""Position of the first node in the frame of the arm's base, metres."""

MAX_DISTANCE = 0.3
"""Largest distance that is stored, metres."""

MAX_DEPTH = 1e3
"""Largest depth inside an obstacle that is stored, metres: larger than any plant, and within the range of float16."""

NODE = np.dtype([("distance", np.float16), ("otherwise", np.float16), ("tomato", np.int16), ("", np.int16)])
"""A node: the distance to the nearest obstacle, the distance without the tomato that it is, and the index of that
tomato or -1. Its eight bytes are fetched at once."""

NO_TOMATO = -2
"""Value of ``ignored`` in a lookup with every tomato as an obstacle."""

_BLOCK = 8
_AT_ONCE = 4096  # pairs whose distances are computed together, so that they stay in the processor's cache
_SLACK = 1e-5  # metres, more than float32 rounds off
_ALL_ROUND: Mapping[int, Ellipsoid] = MappingProxyType({})


def obstacle_field(
    tomatoes: npt.NDArray[np.floating],
    others: Sequence[Shape],
    scene_from_base: npt.ArrayLike | None = None,
    ellipsoids: Mapping[int, Ellipsoid] = _ALL_ROUND,
) -> npt.NDArray[np.void]:
    """Compute the field of a scene.

    Args:
        tomatoes: (t, 4) centers in the frame of the arm's base and radii, metres.
        others: All other obstacles, in the scene frame.
        scene_from_base: (4, 4) pose of the arm's base in the scene; the identity when left out.
        ellipsoids: The tomatoes that are ellipsoids, in the scene frame, by index.

    Returns:
        Array of shape `SHAPE` of `NODE`, metres.
    """
    field = np.empty(SHAPE, dtype=NODE)
    nearest = distance_field(others, scene_from_base).astype(np.float32)
    otherwise, tomato = nearest.copy(), np.full(SHAPE, -1, dtype=np.int16)
    for k, (*center, radius) in enumerate(np.asarray(tomatoes, dtype=np.float64)):
        ellipsoid = ellipsoids.get(k)
        reach = (radius if ellipsoid is None else ellipsoid.semi_axes.max()) + MAX_DISTANCE
        low = np.maximum(np.ceil((np.array(center) - reach - ORIGIN) / CELL), 0).astype(int)
        high = np.minimum(np.floor((np.array(center) + reach - ORIGIN) / CELL) + 1, SHAPE).astype(int)
        if (low >= high).any():
            continue
        part = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        x, y, z = (
            (np.arange(a, b) * CELL + o - c).astype(np.float32) ** 2
            for a, b, o, c in zip(low, high, ORIGIN, center, strict=True)
        )
        first, second = nearest[part], otherwise[part]
        away = np.sqrt(x[:, None, None] + y[:, None] + z)
        if ellipsoid is None:
            own = away - np.float32(radius)
        else:  # exact only where it may be nearer than the second nearest
            own = away - np.float32(ellipsoid.semi_axes.max() + _SLACK)
            maybe = own < second
            own[maybe] = _to_ellipsoid(ellipsoid, np.argwhere(maybe) + low, scene_from_base)
        closer = own < first
        second[...] = np.where(closer, first, np.minimum(second, own))
        first[closer] = own[closer]
        tomato[part][closer] = k
    field["distance"], field["otherwise"] = (np.maximum(d, -MAX_DEPTH) for d in (nearest, otherwise))
    field["tomato"] = tomato
    return field


def _to_ellipsoid(ellipsoid: Ellipsoid, nodes: npt.NDArray[np.int64], scene_from_base: npt.ArrayLike | None) -> Float32:
    """Return distances (n,) of nodes (n, 3), given by grid indices, to an ellipsoid in the scene frame."""
    points = nodes * CELL + ORIGIN
    points = points if scene_from_base is None else transform(scene_from_base, points)
    distance = distance_to_ellipsoids(points, ellipsoid.center, ellipsoid.semi_axes, ellipsoid.rotation)
    return distance[:, 0].astype(np.float32)


def distance_field(shapes: Sequence[Shape], scene_from_base: npt.ArrayLike | None = None) -> npt.NDArray[np.float16]:
    """Compute signed distances from the nodes of the grid to the union of the shapes, capped at `MAX_DISTANCE`.

    They are exact. Blocks of nodes are halved from 8 to 1 node per side; a shape stays with a block only while it may
    be the nearest one somewhere in it, so few pairs of node and shape remain (about 0.1 s for 600 shapes).

    Args:
        shapes: Spheres, capsules and boxes in the scene frame.
        scene_from_base: (4, 4) pose of the arm's base in the scene; the identity when left out.

    Returns:
        Array of shape `SHAPE`, float16, metres.
    """
    field = np.full(SHAPE, MAX_DISTANCE, dtype=np.float16)
    if not shapes:
        return field
    parts = _Parts(shapes, np.eye(4) if scene_from_base is None else np.asarray(scene_from_base, dtype=np.float64))
    # A family is the children of one block; at first each block is a family. `corner` (children, families, 3) is the
    # first node of each block. Pairs of a family and a shape are sorted by family; `first` (families,) is the index of
    # each family's first pair.
    corner = np.stack(np.meshgrid(*(np.arange(0, n, _BLOCK) for n in SHAPE), indexing="ij"), -1).reshape(1, -1, 3)
    count = corner.shape[1]
    family, part = np.repeat(np.arange(count), len(shapes)), np.tile(np.arange(len(shapes)), count)
    first = np.arange(count) * len(shapes)
    size = _BLOCK
    while True:
        distance = parts.distance(_components((corner + (size - 1) / 2) * CELL + ORIGIN), family, part)
        nearest = np.minimum.reduceat(distance, first, axis=1)
        if size == 1:
            field[tuple(np.moveaxis(corner, -1, 0))] = np.clip(nearest, -MAX_DEPTH, MAX_DISTANCE)
            return field
        radius = (size - 1) / 2 * CELL * np.sqrt(3.0)
        child, pair = np.nonzero(distance <= np.minimum(nearest + 2 * radius, MAX_DISTANCE + radius)[:, family])
        if len(pair) == 0:
            return field
        block = child * corner.shape[1] + family[pair]
        begins = np.diff(block, prepend=-1) != 0
        family, part, first, size = np.cumsum(begins) - 1, part[pair], np.flatnonzero(begins), size // 2
        corner = corner.reshape(-1, 3)[block[begins]] + size * _OCTANTS[:, None]


_OCTANTS = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(8, 3)


class _Parts:
    """Shapes as arrays in the base frame; spheres are capsules without length."""

    def __init__(self, shapes: Sequence[Shape], scene_from_base: npt.NDArray[np.float64]):
        rotation, position = scene_from_base[:3, :3], scene_from_base[:3, 3]
        self.is_box = np.array([isinstance(s, Box) for s in shapes])
        a, b, half = (np.zeros((len(shapes), 3)) for _ in range(3))
        turns = np.zeros((len(shapes), 3, 3))
        radius = np.zeros(len(shapes))
        for i, s in enumerate(shapes):
            a[i] = s.start if isinstance(s, Capsule) else s.center
            b[i] = s.end if isinstance(s, Capsule) else s.center
            if isinstance(s, Box):
                half[i], turns[i] = s.half_extents, rotation.T @ s.rotation
            else:
                radius[i] = s.radius
        self.start = _components((a - position) @ rotation)
        axis = (b - a) @ rotation
        squared = (axis * axis).sum(-1)
        self.axis = _components(axis)
        self.inverse = np.where(squared > 1e-12, 1.0 / np.maximum(squared, 1e-12), 0.0).astype(np.float32)
        self.radius = radius.astype(np.float32)
        self.half = _components(half)
        self.turn = _components(turns.reshape(-1, 9))

    def distance(self, points: Float32, family: npt.NDArray[np.int64], part: npt.NDArray[np.int64]) -> Float32:
        """Return signed distances (children, m) from the points (3, children, families) of m families to m shapes."""
        result = np.empty((points.shape[1], len(part)), dtype=np.float32)
        boxes = self.is_box[part]
        for chosen, measure in ((~boxes, self._to_capsules), (boxes, self._to_boxes)):
            pairs = np.flatnonzero(chosen)
            for begin in range(0, len(pairs), _AT_ONCE):
                chunk = pairs[begin : begin + _AT_ONCE]
                result[:, chunk] = measure(points[:, :, family[chunk]], part[chunk])
        return result

    def _to_capsules(self, points: Float32, i: npt.NDArray[np.int64]) -> Float32:
        offset, axis = points - self.start[:, None, i], self.axis[:, None, i]
        fraction = np.clip(_dot(offset, axis) * self.inverse[i], 0.0, 1.0)
        return _norm(offset - fraction * axis) - self.radius[i]

    def _to_boxes(self, points: Float32, i: npt.NDArray[np.int64]) -> Float32:
        offset, turn = points - self.start[:, None, i], self.turn[:, None, i]
        excess = np.stack([np.abs(_dot(turn[k::3], offset)) for k in range(3)]) - self.half[:, None, i]
        depth = np.maximum(np.maximum(excess[0], excess[1]), excess[2])
        return _norm(np.maximum(excess, 0.0)) + np.minimum(depth, 0.0)


def _components(vectors: npt.NDArray[np.floating]) -> Float32:
    """Return vectors (..., k) as (k, ...): rows of one component are faster than many short vectors."""
    return np.ascontiguousarray(np.moveaxis(vectors, -1, 0), dtype=np.float32)


def _dot(a: Float32, b: Float32) -> Float32:
    """Return inner products (...) of vectors (3, ...)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


class FieldStore:
    """Fields of many scenes in one array, indexed by slot."""

    def __init__(self) -> None:
        self._nodes = np.empty((16, _SIZE), dtype=np.uint64)
        self._free = list(range(15, -1, -1))

    def __len__(self) -> int:
        return len(self._nodes) - len(self._free)

    def add(self, field: npt.NDArray[np.void]) -> int:
        """Store a field of `obstacle_field` and return its slot."""
        if not self._free:
            count = len(self._nodes)
            grown = np.empty((2 * count, _SIZE), dtype=np.uint64)
            grown[:count] = self._nodes
            self._nodes = grown
            self._free = list(range(2 * count - 1, count - 1, -1))
        slot = self._free.pop()
        self._nodes[slot] = field.reshape(-1).view(np.uint64)
        return slot

    def remove(self, slot: int) -> None:
        """Release a slot."""
        self._free.append(slot)

    def lookup(
        self, slots: npt.NDArray[np.int64], ignored: npt.NDArray[np.int64], points: npt.NDArray[np.float64]
    ) -> tuple[Float32, Float32]:
        """Return distances and directions to the nearest obstacle, by trilinear interpolation.

        Outside the grid, the distance to the grid is added to the value at its nearest point. The computation is
        elementwise, so a simulation's result does not depend on the number of simulations.

        Args:
            slots: (n,) slots, one per simulation.
            ignored: (n,) index of the tomato that is not an obstacle, or `NO_TOMATO`.
            points: (n, k, 3) points in the frame of the arm's base, metres.

        Returns:
            Distances (n, k), metres, at most `MAX_DISTANCE`; unit directions (n, k, 3) towards the obstacle, zero
            where the distance is capped.
        """
        n, k, _ = points.shape
        # One row per axis from here on, and few array operations: their number sets the time of a single simulation.
        position = np.array(((points.reshape(-1, 3) - _ORIGIN) / CELL).T, dtype=np.float32, order="C")
        inside = np.minimum(np.maximum(position, _ZERO), _LAST)
        node = inside.astype(np.int64)
        x, y, z = inside - node.astype(np.float32)
        flat = _STRIDES @ node
        flat += (slots * _SIZE).repeat(k)
        corners = self._nodes.reshape(-1).take(flat + _CORNERS).view(NODE)  # (2, 2, 2, n * k): z, y, x
        is_ignored = corners["tomato"] == ignored.repeat(k)
        c = np.where(is_ignored, corners["otherwise"], corners["distance"]).astype(np.float32)
        # Interpolate along z, then y, then x: the value together with its slopes along the axes done so far.
        slope = c[1] - c[0]
        along_z = np.concatenate([(c[0] + z * slope)[:, :, None], slope[:, :, None]], axis=2)  # y; x; value, slope z
        slope = along_z[1] - along_z[0]
        along_y = np.concatenate([along_z[0] + y * slope, slope[:, :1]], axis=1)  # x; value, slopes z and y
        slope = along_y[1] - along_y[0]
        value, slope_z, slope_y = along_y[0] + x * slope
        # Two norms at once: of the slopes, and of the offset from the grid of points outside it.
        vectors = np.concatenate([slope[0], slope_y, slope_z, (position - inside).reshape(-1)]).reshape(2, 3, -1)
        length, outside = _norm(vectors.swapaxes(0, 1))
        slopes, distance = vectors[0], value + _CELL * outside
        length[(distance >= _NEARLY_MAX) | (length <= _TINY)] = np.inf
        direction = slopes / -length
        return np.minimum(distance, _MAX).reshape(n, k), direction.reshape(3, n, k).transpose(1, 2, 0)


_ORIGIN = np.array(ORIGIN)
# Just below the last node, so that every cell has an upper corner.
_LAST = np.nextafter(np.array(SHAPE, dtype=np.float32) - 1, np.float32(0.0))[:, None]
_STRIDES = np.array([SHAPE[1] * SHAPE[2], SHAPE[2], 1])
_SIZE = SHAPE[0] * SHAPE[1] * SHAPE[2]
_CORNERS = (_OCTANTS @ _STRIDES[::-1]).reshape(2, 2, 2, 1)
_ZERO, _TINY, _CELL, _MAX, _NEARLY_MAX = np.array([0.0, 1e-6, CELL, MAX_DISTANCE, MAX_DISTANCE - 1e-3], np.float32)


def _norm(vectors: Float32) -> Float32:
    """Return lengths (...) of vectors (3, ...)."""
    squares = vectors * vectors
    x, y, z = squares
    x += y
    x += z
    return np.asarray(np.sqrt(x, out=x))
