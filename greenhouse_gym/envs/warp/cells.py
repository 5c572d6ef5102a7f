"""Lists of the shapes in the cells of a grid around each arm, in which collision detection looks for neighbors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greenhouse_gym.envs.warp.arm import ArmArrays, Ints
from greenhouse_gym.envs.warp.bank import ShapeTable
from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.shape_arrays import BOX, CAPSULE

CELL = 0.16
"""Size of a cell, metres."""


@dataclass(frozen=True, eq=False)
class CellLists:
    """Cells around the arms of s scenes, and the shapes whose bounding boxes overlap them.

    Attributes:
        start: (s * side^3 + 1,) first item of each cell.
        item: Rows of shapes, counted from the first of the scene.
        side: Number of cells along each axis.
        low: First corner of the grid from the arm's base, along each axis, metres.
    """

    start: Ints
    item: Ints
    side: int
    low: float


def reach_of(arm: ArmArrays) -> float:
    """Return a distance from the base that no part of an arm exceeds, metres."""
    ends = np.linalg.norm([arm.part_start, arm.part_end], axis=-1).max(axis=0) + arm.part_radius
    return float(np.linalg.norm(arm.position, axis=1).sum() + ends.max())


def cell_lists(shapes: ShapeTable, base: Array, reach: float) -> CellLists:
    """Sort shapes into cells.

    Args:
        shapes: Shapes of s scenes.
        base: (s, 3) positions of the arms, metres.
        reach: Distance from the base within which shapes are listed, metres.
    """
    side = int(np.ceil(2 * reach / CELL))
    low = -side * CELL / 2
    scene = np.repeat(np.arange(len(base)), shapes.count)
    row = np.arange(len(scene)) - shapes.first[scene]
    extent = np.sqrt(((shapes.rotation * shapes.size[:, None]) ** 2).sum(axis=-1))  # of spheres and ellipsoids
    extent = np.where((shapes.size[:, 1:] == 0).all(axis=1, keepdims=True), shapes.size[:, :1], extent)
    box, capsule = shapes.kind == BOX, shapes.kind == CAPSULE
    extent[box] = (np.abs(shapes.rotation[box]) * shapes.size[box, None]).sum(axis=-1)
    extent[capsule] = np.abs(shapes.rotation[capsule, :, 2]) * shapes.size[capsule, 1:2] + shapes.size[capsule, :1]
    corner = base[scene] + low
    first = np.floor((shapes.center - extent - corner) / CELL).astype(np.int64)
    last = np.floor((shapes.center + extent - corner) / CELL).astype(np.int64)
    inside = ((last >= 0) & (first < side)).all(axis=1)
    first, last = np.clip(first[inside], 0, side - 1), np.clip(last[inside], 0, side - 1)
    size = last - first + 1
    count = size.prod(axis=1)
    which = np.repeat(np.arange(len(count)), count)
    offset = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    _, y, z = size[which].T
    cell = first[which] + np.stack([offset // (y * z), offset // z % y, offset % z], axis=1)
    index = ((scene[inside][which] * side + cell[:, 0]) * side + cell[:, 1]) * side + cell[:, 2]
    start = np.concatenate([[0], np.cumsum(np.bincount(index, minlength=len(base) * side**3))])
    order = np.argsort(index, kind="stable")
    return CellLists(start.astype(np.int32), row[inside][which][order].astype(np.int32), side, low)
