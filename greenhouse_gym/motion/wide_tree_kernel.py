"""Kernel that turns a binary tree over geoms into one of wide nodes, for vector instructions.

Processors compare all children of a wide node with a capsule at once (Wald, Benthin, Boulos: Getting Rid of Packets,
2008).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import kernel

Array = npt.NDArray[np.float64]
Ids = npt.NDArray[np.int32]

WIDTH = 8
"""Largest number of children of a node."""

_MISSING = np.float32(-1e9)  # metres: half sizes of children that a node does not have
_ROUNDING = 1e-6  # of lengths: more than single precision loses


@kernel("i8(i4[:, ::1], i4[::1], f8[:, ::1], b1[::1], f8, f4[:, :, ::1], i4[:, ::1])", writes=("boxes", "children"))
def widen(
    child: Ids,
    geom: Ids,
    aabb: Array,
    left_out: npt.NDArray[np.bool_],
    margin: float,
    boxes: npt.NDArray[np.float32],
    children: Ids,
) -> int:
    """Build the wide tree: the child with the largest surface is replaced by its own two as long as there is room.

    Args:
        child: (b, 2) children of the nodes of a binary tree, which come after them.
        geom: (b,) the geoms of leaves or -1.
        aabb: (b, 6) centers and half sizes of the boxes.
        left_out: (g,) geoms that are left out.
        margin: Metres by which boxes grow.
        boxes: (b, 6, `WIDTH`) the result: centers and half sizes of the boxes of the children of each wide node,
        children: (b, `WIDTH`) and the children: nodes, or -1 - g for geom g.

    Returns:
        The number of wide nodes.
    """
    count, farthest = len(geom), 0.0
    low, high, surface = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    for n in range(count - 1, -1, -1):
        for axis in range(3):
            if geom[n] < 0:
                low[n, axis] = min(low[child[n, 0], axis], low[child[n, 1], axis])
                high[n, axis] = max(high[child[n, 0], axis], high[child[n, 1], axis])
            elif left_out[geom[n]]:
                low[n, axis], high[n, axis] = np.inf, -np.inf
            else:
                low[n, axis], high[n, axis] = aabb[n, axis] - aabb[n, 3 + axis], aabb[n, axis] + aabb[n, 3 + axis]
                farthest = max(farthest, abs(low[n, axis]), abs(high[n, axis]))
        x, y, z = high[n, 0] - low[n, 0], high[n, 1] - low[n, 1], high[n, 2] - low[n, 2]
        surface[n] = x * y + y * z + z * x if x >= 0.0 else -1.0
    margin += _ROUNDING * (1.0 + farthest)
    found, queue = np.empty(WIDTH, np.int64), np.zeros(count + 1, np.int64)
    made, size = 0, min(count, 1)
    while made < size:
        found[0], width = queue[made], 1
        while width < WIDTH:
            largest = -1
            for k in range(width):
                if geom[found[k]] < 0 and (largest < 0 or surface[found[k]] > surface[found[largest]]):
                    largest = k
            if largest < 0:
                break
            n = found[largest]
            found[largest], found[width] = child[n, 0], child[n, 1]
            width += 1
        for k in range(WIDTH):
            n = found[k]
            if k >= width or surface[n] < 0.0:
                children[made, k] = -1
                for axis in range(3):
                    boxes[made, axis, k], boxes[made, 3 + axis, k] = 0.0, _MISSING
                continue
            for axis in range(3):
                boxes[made, axis, k] = (low[n, axis] + high[n, axis]) / 2.0
                boxes[made, 3 + axis, k] = (high[n, axis] - low[n, axis]) / 2.0 + margin
            children[made, k] = -1 - geom[n]
            if geom[n] < 0:
                children[made, k], queue[size] = size, n
                size += 1
        made += 1
    return made
