"""Occupancy grid of the scanned workspace: free, occupied or unknown; and boxes that cover its cells."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import product

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, model_validator

from greenhouse_gym.common.array_files import compress, decompress
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, ShapeArrays, Vector
from greenhouse_gym.geometry.voxels import cells_of

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
"""States of a voxel."""

REACH = 1.35
"""Distance from the shoulder beyond which no arm reaches, metres; occupancy matters only within it."""

MAX_VOXELS = 5_000_000

CORNERS = np.array(list(product((-0.25, 0.25), repeat=3)))
"""(8, 3) sample points of a voxel, relative to its center and side; it is free if all of them are."""

States = npt.NDArray[np.uint8]
Cells = npt.NDArray[np.bool_]


class OccupancyGrid(BaseModel):
    """Voxels in the scene frame; space outside them is unknown.

    Attributes:
        origin: (3,) lower corner of the first voxel, metres.
        voxel: Side of a voxel, metres.
        shape: Number of voxels along x, y and z.
        xz: State of each voxel, one byte each, as compressed text; see `from_states`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, ignored_types=(cached_property,))

    origin: Vector
    voxel: float = Field(gt=0, le=1)
    shape: tuple[int, int, int]
    xz: str = Field(repr=False)

    @model_validator(mode="after")
    def _data_fits(self, info: ValidationInfo) -> OccupancyGrid:
        if min(self.shape) < 1 or int(np.prod(self.shape, dtype=object)) > MAX_VOXELS:
            raise InvalidValueError(f"shape {self.shape}: expected 1 to {MAX_VOXELS} voxels")
        if not info.context:  # see `Scene.parse`
            self.states  # noqa: B018
        return self

    @classmethod
    def from_states(cls, states: States, origin: npt.ArrayLike, voxel: float, quick: bool = False) -> OccupancyGrid:
        """Create a grid of an array (x, y, z) of `UNKNOWN`, `FREE` and `OCCUPIED`.

        With ``quick``, its text is made in a tenth of the time and a little longer, for grids that are not saved.
        """
        shape = (int(states.shape[0]), int(states.shape[1]), int(states.shape[2]))
        text = compress(states.astype(np.uint8).tobytes(), quick)
        return cls(origin=np.asarray(origin), voxel=voxel, shape=shape, xz=text)

    @cached_property
    def states(self) -> States:
        """(x, y, z) uint8 of `UNKNOWN`, `FREE` and `OCCUPIED`, read-only.

        Raises:
            InvalidValueError: The data are damaged.
        """
        states = np.frombuffer(decompress(self.xz, int(np.prod(self.shape))), dtype=np.uint8).reshape(self.shape)
        if (largest := states.max()) > OCCUPIED:
            raise InvalidValueError(f"damaged data: the states of voxels are 0 to {OCCUPIED}, got {largest}")
        return states

    @property
    def centers(self) -> Array:
        """(x, y, z, 3) centers of the voxels, metres."""
        return self.origin + (np.moveaxis(np.indices(self.shape), 0, -1) + 0.5) * self.voxel

    def states_at(self, points: npt.ArrayLike) -> States:
        """Return the states (n,) of space at points (n, 3) of the scene."""
        cells = self.cells_of(points)
        return np.where(cells < 0, np.uint8(UNKNOWN), self.states.reshape(-1)[cells])

    def cells_of(self, points: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Return the flat indices (n,) of the voxels of points (n, 3) of the scene; -1 outside of the grid."""
        return cells_of(points, self.origin, self.shape, self.voxel)

    def is_known(self, points: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return whether space at points (n, 3) of the scene is free or occupied, (n,)."""
        return self.states_at(points) != UNKNOWN

    def known_fraction(self, center: npt.ArrayLike, reach: float) -> float:
        """Return the fraction of voxels above the floor within ``reach`` of a point (3,) that are known, else nan."""
        centers = self.centers
        near = (np.linalg.norm(centers - np.asarray(center), axis=-1) < reach) & (centers[..., 2] > 0)
        return float((self.states[near] != UNKNOWN).mean()) if near.any() else float("nan")


def require_occupancy(grid: OccupancyGrid | None, scene: str, user: str, instead: str) -> OccupancyGrid:
    """Return the occupancy grid of a scene.

    Args:
        grid: The grid, or None.
        scene: Name of the scene.
        user: Feature that needs the grid, named in the message.
        instead: Advice in the message, such as another option.

    Raises:
        InvalidValueError: There is no grid.
    """
    if grid is None:
        raise InvalidValueError(
            f"scene {scene!r} has no occupancy grid, which {user} needs: build it from its recording with this "
            f"version, or {instead}"
        )
    return grid


def boxes_covering(cells: Cells, origin: npt.ArrayLike, voxel: float, optional: Cells | None = None) -> ShapeArrays:
    """Cover the marked cells (x, y, z) of a grid by few boxes that do not overlap.

    Runs of cells along y are joined with equal neighbors along z, and then along x.

    Args:
        cells: The cells to cover.
        origin: (3,) lower corner of the grid, metres.
        voxel: Side of a cell, metres.
        optional: Further cells that may be covered where this saves boxes.
    """
    allowed = cells if optional is None else cells | optional
    edges = np.diff(np.pad(allowed, ((0, 0), (1, 1), (0, 0))).astype(np.int8), axis=1)
    starts, ends = (np.argwhere(edges.transpose(0, 2, 1) == sign) for sign in (1, -1))  # in pairs: x, z, y
    marked = np.cumsum(np.pad(cells, ((0, 0), (1, 0), (0, 0))), axis=1)
    x, z, first, last = *starts.T, ends[:, 2]
    needed = marked[x, last, z] > marked[x, first, z]
    runs = np.column_stack([x, x + 1, first, last, z, z + 1])[needed]
    return _boxes_of_blocks(runs, (2, 0), origin, voxel)


def boxes_around_points(points: npt.ArrayLike, voxel: float) -> ShapeArrays:
    """Cover the voxels (sides in metres) that contain points (n, 3) by few boxes that do not overlap."""
    p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if not len(p):
        return ShapeArrays.empty(0)
    origin = p.min(axis=0)
    cells = np.unique(((p - origin) / voxel).astype(np.int64), axis=0)
    blocks = np.stack([cells, cells + 1], axis=-1).reshape(-1, 6)
    return _boxes_of_blocks(blocks, (1, 2, 0), origin, voxel)


def _boxes_of_blocks(
    blocks: npt.NDArray[np.int64], axes: Sequence[int], origin: npt.ArrayLike, voxel: float
) -> ShapeArrays:
    """Return the boxes of blocks (n, 6) of cells after joining them along one axis after the other."""
    for axis in axes:
        blocks = _joined(blocks, axis)
    low, high = blocks[:, ::2], blocks[:, 1::2]
    centers, halves = np.asarray(origin, dtype=np.float64) + (low + high) * (voxel / 2), (high - low) * (voxel / 2)
    return ShapeArrays.of_boxes(np.asarray(centers, dtype=np.float64), np.asarray(halves, dtype=np.float64))


def _joined(blocks: npt.NDArray[np.int64], axis: int) -> npt.NDArray[np.int64]:
    """Join blocks (n, 6), two bounds per axis, that follow each other along an axis and agree in the other bounds."""
    start, end = 2 * axis, 2 * axis + 1
    others = [column for column in range(6) if column not in (start, end)]
    ordered = blocks[np.lexsort((blocks[:, start], *blocks[:, others].T))]
    here, before = ordered[1:], ordered[:-1]
    new = (here[:, others] != before[:, others]).any(axis=1) | (here[:, start] != before[:, end])
    bounds = np.flatnonzero(np.concatenate([[True], new, [True]])) if len(ordered) else np.zeros(1, np.int64)
    joined = ordered[bounds[:-1]]
    joined[:, end] = ordered[bounds[1:] - 1, end]
    return joined


def inside_boxes(points: Array, boxes: Sequence[tuple[Array, Array, Array]], margin: float) -> npt.NDArray[np.bool_]:
    """Return whether points (n, 3) lie within a margin of any box, given as center, half extents and rotation."""
    found = np.zeros(len(points), dtype=np.bool_)
    for center, half, rotation in boxes:
        found |= (np.abs((points - center) @ rotation) <= half + margin).all(axis=1)
    return found
