"""What a scan saw of the space around an arm: empty, surface, or unseen, in voxels."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from itertools import product

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from greenhouse_gym.crops.shape_tables import upright_boxes
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, Box, Vector
from greenhouse_gym.scene.packed import compressed, decompressed

UNSEEN, EMPTY, SURFACE = 0, 1, 2
"""What a voxel is."""

REACH = 1.35
"""Distance from the shoulder beyond which no arm reaches, metres; whether space was seen matters only within it."""

MOST_VOXELS = 5_000_000

States = npt.NDArray[np.uint8]
Cells = npt.NDArray[np.bool_]


class SeenSpace(BaseModel):
    """Voxels in the scene frame; what lies outside of them is unseen.

    Attributes:
        origin: (3,) the lower corner of the first voxel, metres.
        voxel: Side of a voxel, metres.
        shape: Number of voxels along x, y and z.
        data: Which voxels are seen, then which of all are surface, one bit each; see `of`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, ignored_types=(cached_property,))

    origin: Vector
    voxel: float = Field(gt=0, le=1)
    shape: tuple[int, int, int]
    data: str

    @model_validator(mode="after")
    def _matches(self) -> SeenSpace:
        if min(self.shape) < 1 or int(np.prod(self.shape, dtype=object)) > MOST_VOXELS:
            raise InvalidValueError(f"shape {self.shape}: expected 1 to {MOST_VOXELS} voxels")
        decompressed(self.data, 2 * self._plane)
        return self

    @property
    def _plane(self) -> int:
        return -(-int(np.prod(self.shape)) // 8)

    @classmethod
    def of(cls, states: States, origin: npt.ArrayLike, voxel: float) -> SeenSpace:
        """The space of an array (x, y, z) of `UNSEEN`, `EMPTY` and `SURFACE`."""
        planes = [np.packbits(plane.reshape(-1)).tobytes() for plane in (states != UNSEEN, states == SURFACE)]
        shape = (int(states.shape[0]), int(states.shape[1]), int(states.shape[2]))
        return cls(origin=np.asarray(origin), voxel=voxel, shape=shape, data=compressed(b"".join(planes)))

    @cached_property
    def states(self) -> States:
        """(x, y, z) uint8 of `UNSEEN`, `EMPTY` and `SURFACE`, read-only."""
        planes = np.frombuffer(decompressed(self.data, 2 * self._plane), dtype=np.uint8).reshape(2, -1)
        seen, surface = np.unpackbits(planes, axis=1, count=int(np.prod(self.shape)))
        states = np.where(surface > 0, SURFACE, seen).astype(np.uint8).reshape(self.shape)
        states.setflags(write=False)
        return states

    @property
    def centers(self) -> Array:
        """(x, y, z, 3) the middles of the voxels, metres."""
        return self.origin + (np.moveaxis(np.indices(self.shape), 0, -1) + 0.5) * self.voxel

    def at(self, points: npt.ArrayLike) -> States:
        """What points (n, 3) of the scene lie in, (n,) of `UNSEEN`, `EMPTY` and `SURFACE`."""
        cells = np.floor((np.asarray(points, dtype=np.float64).reshape(-1, 3) - self.origin) / self.voxel)
        inside = ((cells >= 0) & (cells < self.shape)).all(axis=1)
        result = np.full(len(cells), UNSEEN, dtype=np.uint8)
        result[inside] = self.states[tuple(cells[inside].astype(np.int64).T)]
        return result

    def __call__(self, points: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Whether points (n, 3) of the scene were seen, (n,)."""
        return self.at(points) != UNSEEN

    def share(self, center: npt.ArrayLike, reach: float) -> float:
        """Share of the voxels within ``reach`` metres of a point (3,), above the floor, that were seen; else nan."""
        centers = self.centers
        near = (np.linalg.norm(centers - np.asarray(center), axis=-1) < reach) & (centers[..., 2] > 0)
        return float((self.states[near] != UNSEEN).mean()) if near.any() else float("nan")


def required(space: SeenSpace | None, scene: str, asked_by: str, instead: str) -> SeenSpace:
    """What a scan saw of a scene's space, where something asks for it.

    Raises:
        InvalidValueError: The scene does not say; the message tells what helps.
    """
    if space is None:
        raise InvalidValueError(
            f"scene {scene!r} does not say what was seen of its space, which {asked_by} needs: build it from its "
            f"recording with this version, or {instead}"
        )
    return space


def boxes_of(cells: Cells, origin: npt.ArrayLike, voxel: float, either_way: Cells | None = None) -> list[Box]:
    """Few boxes, none of which overlap, that cover the marked cells (x, y, z) of a grid.

    Runs along y, those that are alike beside each other along z, and then along x, make a box.

    Args:
        cells: The cells to cover.
        origin: (3,) the grid's lower corner, metres.
        voxel: Side of a cell, metres.
        either_way: Cells that may be covered or not, whatever takes fewer boxes; no others are.
    """
    allowed = cells if either_way is None else cells | either_way
    edges = np.diff(np.pad(allowed, ((0, 0), (1, 1), (0, 0))).astype(np.int8), axis=1)
    starts, ends = (np.argwhere(edges.transpose(0, 2, 1) == sign) for sign in (1, -1))  # in pairs: x, z, y
    marked = np.cumsum(np.pad(cells, ((0, 0), (1, 0), (0, 0))), axis=1)
    x, z, first, last = *starts.T, ends[:, 2]
    needed = marked[x, last, z] > marked[x, first, z]
    runs = np.column_stack([x, x + 1, first, last, z, z + 1])[needed]
    return _boxes_of_blocks(runs, (2, 0), origin, voxel)


def boxes_around(points: npt.ArrayLike, voxel: float) -> list[Box]:
    """Few boxes, none of which overlap, that cover the voxels in which points (n, 3) lie, sides in metres."""
    places = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if not len(places):
        return []
    origin = places.min(axis=0)
    cells = np.unique(((places - origin) / voxel).astype(np.int64), axis=0)
    blocks = np.stack([cells, cells + 1], axis=-1).reshape(-1, 6)
    return _boxes_of_blocks(blocks, (1, 2, 0), origin, voxel)


def _boxes_of_blocks(
    blocks: npt.NDArray[np.int64], axes: Sequence[int], origin: npt.ArrayLike, voxel: float
) -> list[Box]:
    """The boxes of blocks (n, 6) of cells, joined along some axes, one after the other."""
    for axis in axes:
        blocks = _joined(blocks, axis)
    low, high = blocks[:, ::2], blocks[:, 1::2]
    centers = np.asarray(origin, dtype=np.float64) + (low + high) * (voxel / 2)
    return upright_boxes(centers, np.asarray((high - low) * (voxel / 2), dtype=np.float64))


def _joined(blocks: npt.NDArray[np.int64], axis: int) -> npt.NDArray[np.int64]:
    """Blocks (n, 6), each two ends per axis, with those joined that are alike and follow each other along an axis."""
    start, end = 2 * axis, 2 * axis + 1
    alike = [column for column in range(6) if column not in (start, end)]
    ordered = blocks[np.lexsort((blocks[:, start], *blocks[:, alike].T))]
    here, before = ordered[1:], ordered[:-1]
    new = (here[:, alike] != before[:, alike]).any(axis=1) | (here[:, start] != before[:, end])
    bounds = np.flatnonzero(np.concatenate([[True], new, [True]])) if len(ordered) else np.zeros(1, np.int64)
    joined = ordered[bounds[:-1]]
    joined[:, end] = ordered[bounds[1:] - 1, end]
    return joined


def inside_boxes(points: Array, boxes: Sequence[tuple[Array, Array, Array]], margin: float) -> npt.NDArray[np.bool_]:
    """Whether points (n, 3) lie within a margin of one of the boxes, each a center, half extents and rotation."""
    found = np.zeros(len(points), dtype=np.bool_)
    for center, half, rotation in boxes:
        found |= (np.abs((points - center) @ rotation) <= half + margin).all(axis=1)
    return found


CORNERS = np.array(list(product((-0.25, 0.25), repeat=3)))
"""(8, 3) places in a voxel, in its sides from its middle, at which it is looked at: all must be empty for it to be."""
