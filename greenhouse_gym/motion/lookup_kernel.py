"""Kernel that looks up distance fields, see `greenhouse_gym.motion.distance_field`; lengths are in metres."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import inlined, kernel
from greenhouse_gym.motion.distance_field import BLOCK, CELL, MAX_DISTANCE, ORIGIN, SHAPE
from greenhouse_gym.motion.float16_kernels import from_half_bits

Float32 = npt.NDArray[np.float32]
Ids = npt.NDArray[np.int64]

_ACROSS, _ALONG, _UP = SHAPE
_ORIGIN_X, _ORIGIN_Y, _ORIGIN_Z = ORIGIN
_ZERO, _TINY, _INFINITE = np.float32(0.0), np.float32(1e-6), np.float32(np.inf)
_CELL, _MAX, _NEARLY_MAX = np.float32(CELL), np.float32(MAX_DISTANCE), np.float32(MAX_DISTANCE - 1e-3)
# just below the last node, so that every cell has an upper corner
_LAST_X, _LAST_Y, _LAST_Z = (np.nextafter(np.float32(count - 1), np.float32(0.0)) for count in SHAPE)


@inlined
def _within(position, last):
    """Return the nearest position within the grid; what is no number becomes 0, which reads no memory elsewhere."""
    position = position if position > _ZERO else _ZERO
    return position if position < last else last


@kernel(
    "b1(i8[::1], u8[::1], i8[:], i8[:], f8[:,:,:], i8[::1], f4[:,::1], f4[:,:,::1])",
    writes=("cells", "distances", "directions"),
)
def interpolate(
    first: Ids,
    nodes: npt.NDArray[np.uint64],
    slots: Ids,
    ignored: Ids,
    points: npt.NDArray[np.float64],
    cells: Ids,
    distances: Float32,
    directions: Float32,
) -> bool:
    """Interpolate distance fields between their nodes; see `greenhouse_gym.motion.distance_field.FieldStore.lookup`.

    Args:
        first: First node, over the number of nodes along z, of each cell at x and y of each slot; -1 if not computed.
        nodes: All nodes.
        slots: (n,) slots.
        ignored: (n,) index of the tomato that is no obstacle.
        points: (n, k, 3) points in the frame of the arm's base, metres.
        cells: (n k,) result: indices of the points' cells in ``first``.
        distances: (n, k) result, metres.
        directions: (n, k, 3) result: unit directions toward the obstacles.

    Returns:
        True if all cells were computed; else the results are incomplete.
    """
    complete, many = True, points.shape[1]
    c, offset, slopes = np.empty((2, 2, 2), np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    for i in range(len(points)):
        for p in range(many):
            at_x = np.float32((points[i, p, 0] - _ORIGIN_X) / CELL)
            at_y = np.float32((points[i, p, 1] - _ORIGIN_Y) / CELL)
            at_z = np.float32((points[i, p, 2] - _ORIGIN_Z) / CELL)
            x, y, z = _within(at_x, _LAST_X), _within(at_y, _LAST_Y), _within(at_z, _LAST_Z)
            offset[0], offset[1], offset[2] = at_x - x, at_y - y, at_z - z
            node_x, node_y, node_z = np.int64(x), np.int64(y), np.int64(z)
            x, y, z = x - np.float32(node_x), y - np.float32(node_y), z - np.float32(node_z)
            cell = (slots[i] * _ACROSS + node_x) * _ALONG + node_y
            cells[i * many + p] = cell
            if first[cell] < 0:
                complete = False
                continue
            corner = first[cell] * _UP + node_z
            for a in range(2):
                for b in range(2):
                    for d in range(2):
                        node = nodes[corner + a + _UP * b + BLOCK * _UP * d]
                        other = np.int16((node >> np.uint64(32)) & np.uint64(0xFFFF)) == ignored[i]
                        bits = (node >> np.uint64(16 if other else 0)) & np.uint64(0xFFFF)
                        c[a, b, d] = from_half_bits(np.uint32(bits))
            # along z, then y, then x: the value together with its slopes along the axes done so far
            up_0, up_1 = c[1, 0, 0] - c[0, 0, 0], c[1, 0, 1] - c[0, 0, 1]
            up_2, up_3 = c[1, 1, 0] - c[0, 1, 0], c[1, 1, 1] - c[0, 1, 1]
            low_0, low_1 = c[0, 0, 0] + z * up_0, c[0, 0, 1] + z * up_1
            slope_0, slope_1 = (c[0, 1, 0] + z * up_2) - low_0, (c[0, 1, 1] + z * up_3) - low_1
            value_0, value_1 = low_0 + y * slope_0, low_1 + y * slope_1
            rise_0, rise_1 = up_0 + y * (up_2 - up_0), up_1 + y * (up_3 - up_1)
            slopes[0] = value_1 - value_0
            value = value_0 + x * slopes[0]
            slopes[1], slopes[2] = slope_0 + x * (slope_1 - slope_0), rise_0 + x * (rise_1 - rise_0)
            length = np.sqrt(slopes[0] * slopes[0] + slopes[1] * slopes[1] + slopes[2] * slopes[2])
            outside = np.sqrt(offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2])
            distance = value + _CELL * outside
            if distance >= _NEARLY_MAX or length <= _TINY:
                length = _INFINITE
            for k in range(3):
                directions[i, p, k] = slopes[k] / -length
            distances[i, p] = _MAX if distance > _MAX else distance
    return complete
