"""Bounding-volume tree over the geoms of a static body, as MuJoCo's compiler makes it, bit for bit."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import inlined, kernel

Array = npt.NDArray[np.float64]
Ids = npt.NDArray[np.int32]

_EPSILON = 1e-14  # MuJoCo's mjEPS


@inlined
def _before(keys, a, b):
    """Return whether geom a comes before geom b along an axis; ties go to the lower id."""
    difference = keys[a] - keys[b]
    return difference < 0 if abs(difference) > _EPSILON else a < b


@inlined
def _partition(ids, first, count, middle, keys):
    """Reorder some ids so that the first ``middle`` come before the others (quickselect)."""
    low, high = first, first + count - 1
    nth = first + middle
    while low < high:
        pivot = ids[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while _before(keys, ids[i], pivot):
                i += 1
            while _before(keys, pivot, ids[j]):
                j -= 1
            if i <= j:
                ids[i], ids[j] = ids[j], ids[i]
                i += 1
                j -= 1
        if nth <= j:
            high = j
        elif nth >= i:
            low = i
        else:
            break


@kernel(
    "i8(f8[:, ::1], f8[:, ::1], f8[:, ::1], i4[::1], i4[:, ::1], i4[::1], f8[:, ::1])",
    writes=("depth", "child", "geom", "aabb"),
)
def tree_over(positions: Array, quats: Array, boxes: Array, depth: Ids, child: Ids, geom: Ids, aabb: Array) -> int:
    """Build the tree by splitting at the median along the longest axis.

    Args:
        positions: (n, 3) positions of the geoms.
        quats: (n, 4) their rotations.
        boxes: (n, 6) centers and half sizes of their boxes, in their own frames.
        depth: (2 n - 1,) the result: depths of the nodes,
        child: (2 n - 1, 2) their children or -1,
        geom: (2 n - 1,) the geoms of leaves or -1,
        aabb: (2 n - 1, 6) centers and half sizes of their boxes.

    Returns:
        The number of nodes.
    """
    count = len(positions)
    low, high = np.empty((count, 3)), np.empty((count, 3))
    corner, turned = np.empty(3), np.empty(3)
    for i in range(count):
        w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
        turns = not (w == 1.0 and x == 0.0 and y == 0.0 and z == 0.0)
        for axis in range(3):
            low[i, axis], high[i, axis] = np.inf, -np.inf
        for v in range(8):
            for axis in range(3):
                half = boxes[i, 3 + axis]
                corner[axis] = boxes[i, axis] + half if (v >> axis) & 1 else boxes[i, axis] - half
            a, b, c = corner[0], corner[1], corner[2]
            turned[0], turned[1], turned[2] = a, b, c
            if turns:
                s, t, u = w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a
                turned[0] = a + 2.0 * (y * u - z * t)
                turned[1] = b + 2.0 * (z * s - x * u)
                turned[2] = c + 2.0 * (x * t - y * s)
            for axis in range(3):
                p = turned[axis] + positions[i, axis]
                low[i, axis] = p if p < low[i, axis] else low[i, axis]
                high[i, axis] = p if p > high[i, axis] else high[i, axis]
    keys, ids = np.empty((3, count)), np.empty(count, np.int64)
    for i in range(count):
        ids[i] = i
        for axis in range(3):
            keys[axis, i] = positions[i, axis]
    stack = np.empty((2 * count + 2, 4), np.int64)  # first id, number of ids, depth, parent
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 0, count, 0, -1
    size, nodes = 1, 0
    bottom, top = np.empty(3), np.empty(3)
    while size > 0:
        size -= 1
        first, n, level, parent = stack[size, 0], stack[size, 1], stack[size, 2], stack[size, 3]
        for axis in range(3):
            bottom[axis], top[axis] = np.inf, -np.inf
        for k in range(first, first + n):
            for axis in range(3):
                bottom[axis] = min(bottom[axis], low[ids[k], axis])
                top[axis] = max(top[axis], high[ids[k], axis])
        for axis in range(3):
            if abs(bottom[axis] - top[axis]) < _EPSILON:
                bottom[axis] -= _EPSILON
                top[axis] += _EPSILON
            aabb[nodes, axis] = (top[axis] + bottom[axis]) / 2.0
            aabb[nodes, 3 + axis] = (top[axis] - bottom[axis]) / 2.0
        if parent >= 0:
            child[parent, 0 if child[parent, 0] < 0 else 1] = nodes
        depth[nodes], child[nodes, 0], child[nodes, 1], geom[nodes] = level, -1, -1, -1
        if n == 1:
            geom[nodes] = ids[first]
        else:
            longest = 0
            for axis in range(1, 3):
                if top[axis] - bottom[axis] >= top[longest] - bottom[longest] + _EPSILON:
                    longest = axis
            _partition(ids, first, n, n // 2, keys[longest])
            for part in range(1, -1, -1):  # the first half is taken from the stack first
                stack[size, 0] = first + part * (n // 2)
                stack[size, 1] = n - n // 2 if part else n // 2
                stack[size, 2], stack[size, 3] = level + 1, nodes
                size += 1
        nodes += 1
    return nodes
