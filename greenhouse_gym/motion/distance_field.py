"""Distance fields: distance and direction to the nearest obstacle, looked up in a grid instead of computed.

A field covers a box in front of the arm, in the frame of the arm's base (x forward, z up). It is sampled at nodes
2 cm apart, stored as float16 and capped at `MAX_DISTANCE`. A node whose nearest obstacle is a tomato also stores the
distance without that tomato, so that one field serves every target of a scene. Fields of many scenes are stacked in one
array, so that one lookup serves many simulations. A field is computed where it is looked up: an arm passes a fraction
of it.
"""

from __future__ import annotations

from threading import RLock
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array, ShapeArrays, invert, transform
from greenhouse_gym.geometry.shape_arrays import BOX, ELLIPSOID

Float32 = npt.NDArray[np.float32]

CELL = 0.02
"""Distance between nodes, metres."""

SHAPE = (48, 88, 88)
"""Number of nodes along x, y, z: multiples of `BLOCK`."""

BLOCK = 8
"""Nodes along x and y of a column of nodes, which is computed at once."""

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


def obstacle_field(
    shapes: ShapeArrays,
    tomatoes: int = 0,
    scene_from_base: npt.ArrayLike | None = None,
    out: npt.NDArray[np.uint64] | None = None,
) -> npt.NDArray[np.void]:
    """Compute the field of a scene (about 10 ms for 600 shapes). It is exact up to the rounding of float16.

    Args:
        shapes: All obstacles, in the scene frame, the tomatoes first. The others are no ellipsoids.
        tomatoes: Number of tomatoes.
        scene_from_base: (4, 4) pose of the arm's base in the scene; the identity when left out.
        out: Memory for the nodes, eight bytes each; new memory when left out.

    Returns:
        Array of shape `SHAPE` of `NODE`, metres.
    """
    from greenhouse_gym.motion.field_kernels import column_nodes

    source, (x, y, z) = _source(shapes, tomatoes, scene_from_base), SHAPE
    nodes = np.empty(x * y * z, dtype=np.uint64) if out is None else out
    whole, column = nodes.reshape(SHAPE), np.empty(_COLUMN, dtype=np.uint64)
    for i in range(0, x, BLOCK):
        for j in range(0, y, BLOCK):
            column_nodes(*source, i, j, column)
            whole[i : i + BLOCK, j : j + BLOCK] = column
    return nodes.view(NODE).reshape(SHAPE)


# the obstacles as `column_nodes` wants them
_Source = tuple[Float32, Float32, Array, npt.NDArray[np.bool_], Array, Array, Array, Array]


def _source(shapes: ShapeArrays, tomatoes: int, scene_from_base: npt.ArrayLike | None) -> _Source:
    base = np.eye(4) if scene_from_base is None else np.array(scene_from_base, dtype=np.float64)
    fruit, others = shapes.select(slice(tomatoes)), shapes.select(slice(tomatoes, None))
    centers = transform(invert(base), fruit.starts)
    spheres = np.column_stack([centers, fruit.sizes[:, 0]])
    return (*_parts(others, base), spheres, fruit.kinds == ELLIPSOID, fruit.starts, fruit.sizes, fruit.rotations, base)


def _parts(shapes: ShapeArrays, scene_from_base: Array) -> tuple[Float32, Float32]:
    """Return capsules (8, n) and boxes (15, m) in the base frame as `column_nodes` wants them."""
    rotation, position = scene_from_base[:3, :3], scene_from_base[:3, 3]
    starts = (shapes.starts - position) @ rotation
    axes = (shapes.ends - shapes.starts) @ rotation
    squared = (axes * axes).sum(-1)
    inverse = np.where(squared > 1e-12, 1.0 / np.maximum(squared, 1e-12), 0.0)
    box = shapes.kinds == BOX
    turns = (rotation.T @ shapes.rotations[box]).reshape(-1, 9)
    capsules = np.column_stack([starts, axes, inverse, shapes.sizes[:, 0]])[~box]
    boxes = np.column_stack([starts[box], shapes.sizes[box], turns])
    return np.ascontiguousarray(capsules.T, dtype=np.float32), np.ascontiguousarray(boxes.T, dtype=np.float32)


_SLOTS, _ROOM = 64, 256  # at first; a column takes 45 kB


class FieldStore:
    """Fields of many scenes, by slot; their columns are computed when they are looked up, into one array.

    Environments of several threads may share it.
    """

    def __init__(self) -> None:
        self._lock = RLock()  # held again where a world is freed while columns are computed
        self._sources: dict[int, _Source] = {}
        self._free = list(range(_SLOTS - 1, -1, -1))
        self._nodes = np.empty((_ROOM, *_COLUMN), dtype=np.uint64)
        self._unused = list(range(_ROOM - 1, -1, -1))  # columns
        # the first node, over the number of nodes along z, of the cells at x and y of a slot; -1 if not yet computed
        self._first = np.full((_SLOTS, *SHAPE[:2]), -1)

    def __len__(self) -> int:
        return len(self._sources)

    def add(self, shapes: ShapeArrays, tomatoes: int = 0, scene_from_base: npt.ArrayLike | None = None) -> int:
        """Return the slot of a new field, as `obstacle_field` computes it."""
        source = _source(shapes, tomatoes, scene_from_base)
        with self._lock:
            if not self._free:
                count = len(self._first)
                self._first = np.concatenate([self._first, np.full_like(self._first, -1)])
                self._free += range(2 * count - 1, count - 1, -1)
            slot = self._free.pop()
            self._sources[slot] = source
        return slot

    def remove(self, slot: int) -> None:
        """Release a slot."""
        with self._lock:
            columns = np.unique(self._first[slot] // BLOCK**2)
            self._unused += columns[columns >= 0].tolist()
            self._first[slot] = -1
            del self._sources[slot]
            self._free.append(slot)

    def _complete(self, cells: npt.NDArray[np.int64]) -> None:
        """Compute the missing columns of cells (k,), given by their indices in `_first`."""
        from greenhouse_gym.motion.field_kernels import column_nodes

        missing = cells[self._first.reshape(-1)[cells] < 0]
        slots, x, y = np.unravel_index(missing, self._first.shape)
        for slot, i, j in sorted(set(zip(slots.tolist(), (x // _CELLS).tolist(), (y // _CELLS).tolist(), strict=True))):
            if not self._unused:
                count = len(self._nodes)
                grown = np.empty((2 * count, *_COLUMN), dtype=np.uint64)
                grown[:count] = self._nodes
                self._nodes = grown
                self._unused += range(2 * count - 1, count - 1, -1)
            column = self._unused.pop()
            column_nodes(*self._sources[slot], _CELLS * i, _CELLS * j, self._nodes[column])
            own = self._first[slot, _CELLS * i : _CELLS * (i + 1), _CELLS * j : _CELLS * (j + 1)]
            own[:] = BLOCK**2 * column + _IN_COLUMN[: len(own), : own.shape[1]]

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
        from greenhouse_gym.motion.lookup_kernel import interpolate

        n, k, _ = points.shape
        cells, distances = np.empty(n * k, dtype=np.int64), np.empty((n, k), dtype=np.float32)
        directions = np.empty((n, k, 3), dtype=np.float32)
        request = slots, ignored, points, cells, distances, directions
        while not interpolate(self._first.reshape(-1), self._nodes.reshape(-1), *request):
            with self._lock:
                self._complete(cells)
        return distances, directions


class FieldsOfSimulations(NamedTuple):
    """Distance fields of the scenes of n simulations, valid until a simulation's next episode.

    Attributes:
        store: The fields.
        slots: (n,) slots.
        ignored: (n,) index of the tomato that is not an obstacle, or `NO_TOMATO`.
        along: (n, 1, 3) positions in the base frame of the frames in which the fields are given, metres.
    """

    store: FieldStore
    slots: npt.NDArray[np.int64]
    ignored: npt.NDArray[np.int64]
    along: Array

    def select(self, ids: npt.NDArray[np.int64]) -> FieldsOfSimulations:
        """Return the fields of some simulations."""
        return FieldsOfSimulations(self.store, self.slots[ids], self.ignored[ids], self.along[ids])

    def replaced(self, ids: npt.NDArray[np.int64], fresh: FieldsOfSimulations) -> FieldsOfSimulations:
        """Return a copy with the ``fresh`` fields of some simulations."""
        copies = self.slots.copy(), self.ignored.copy(), self.along.copy()
        for old, new in zip(copies, fresh[1:], strict=True):
            old[ids] = new
        return FieldsOfSimulations(self.store, *copies)

    def lookup(self, points: npt.NDArray[np.float64]) -> tuple[Float32, Float32]:
        """Return distances and directions at points (n, k, 3), as `FieldStore.lookup` does."""
        return self.store.lookup(self.slots, self.ignored, points - self.along)


_COLUMN = BLOCK, BLOCK, SHAPE[2]
_CELLS = BLOCK - 1  # along x and y in a column; neighboring columns share nodes
_IN_COLUMN = np.add.outer(BLOCK * np.arange(_CELLS), np.arange(_CELLS))
