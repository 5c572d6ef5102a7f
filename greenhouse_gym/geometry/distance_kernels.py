"""Kernel of distances from many points to the nearest of many shapes."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import inlined, kernel
from greenhouse_gym.geometry.arrays import Array
from greenhouse_gym.geometry.segment_kernels import dot, minus, segments_apart, to_ellipsoid
from greenhouse_gym.geometry.shape_arrays import BOX, ELLIPSOID

_ROUNDING = 1e-9  # metres
_CHUNK = 32  # points that are compared with the same shapes


@inlined
def _distance(p, kind, start, end, size, r):
    """Return the signed distance of a point to a shape; see `ShapeArrays`."""
    if kind != BOX and kind != ELLIPSOID:
        return math.sqrt(segments_apart(p, p, start, end)) - size[0]
    d = minus(p, start)
    q = (
        r[0, 0] * d[0] + r[1, 0] * d[1] + r[2, 0] * d[2],
        r[0, 1] * d[0] + r[1, 1] * d[1] + r[2, 1] * d[2],
        r[0, 2] * d[0] + r[1, 2] * d[1] + r[2, 2] * d[2],
    )
    if kind == ELLIPSOID:
        return to_ellipsoid(q, q, 0.0, size)
    x, y, z = abs(q[0]) - size[0], abs(q[1]) - size[1], abs(q[2]) - size[2]
    outside = (max(x, 0.0), max(y, 0.0), max(z, 0.0))
    return math.sqrt(dot(outside, outside)) + min(max(x, max(y, z)), 0.0)


@inlined
def _near_box(points, balls, limit, chosen):
    """Write the indices of the balls within a distance of the box around points (n, 3); return their number."""
    lx, ly, lz = np.inf, np.inf, np.inf
    hx, hy, hz = -np.inf, -np.inf, -np.inf
    for i in range(len(points)):
        lx, ly, lz = min(lx, points[i, 0]), min(ly, points[i, 1]), min(lz, points[i, 2])
        hx, hy, hz = max(hx, points[i, 0]), max(hy, points[i, 1]), max(hz, points[i, 2])
    count = 0
    for k in range(len(balls)):
        x, y, z = balls[k, 0], balls[k, 1], balls[k, 2]
        away = (max(lx - x, x - hx, 0.0), max(ly - y, y - hy, 0.0), max(lz - z, z - hz, 0.0))
        reach = balls[k, 3] + limit + _ROUNDING
        if reach >= 0.0 and dot(away, away) <= reach * reach:
            chosen[count] = k
            count += 1
    return count


@kernel(
    "void(f8[:, ::1], i1[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8, f8[::1])", writes=("nearest",)
)
def nearest_distances(
    points: Array,
    kinds: npt.NDArray[np.int8],
    starts: Array,
    ends: Array,
    sizes: Array,
    rotations: Array,
    limit: float,
    nearest: Array,
) -> None:
    """Write the signed distances (n,) from points (n, 3) to the nearest shape, inf if all are beyond a limit.

    The shapes are given by the fields of `ShapeArrays`.
    """
    count = len(kinds)
    balls = np.empty((count, 4))
    for k in range(count):
        for axis in range(3):
            balls[k, axis] = (starts[k, axis] + ends[k, axis]) / 2
        half = (ends[k, 0] - starts[k, 0], ends[k, 1] - starts[k, 1], ends[k, 2] - starts[k, 2])
        size = (sizes[k, 0], sizes[k, 1], sizes[k, 2])
        balls[k, 3] = math.sqrt(dot(half, half)) / 2 + (
            math.sqrt(dot(size, size)) if kinds[k] == BOX else max(size[0], max(size[1], size[2]))
        )
    chosen = np.empty(count, dtype=np.int64)
    for first in range(0, len(points), _CHUNK):
        chunk = points[first : first + _CHUNK]
        chosen_count = _near_box(chunk, balls, limit, chosen)
        for i in range(len(chunk)):
            p, best = (chunk[i, 0], chunk[i, 1], chunk[i, 2]), np.inf
            for j in range(chosen_count):
                k = chosen[j]
                away = (balls[k, 0] - p[0], balls[k, 1] - p[1], balls[k, 2] - p[2])
                reach = balls[k, 3] + min(best, limit) + _ROUNDING
                if reach < 0.0 or dot(away, away) > reach * reach:
                    continue
                start, end = (starts[k, 0], starts[k, 1], starts[k, 2]), (ends[k, 0], ends[k, 1], ends[k, 2])
                size = (sizes[k, 0], sizes[k, 1], sizes[k, 2])
                best = min(best, _distance(p, kinds[k], start, end, size, rotations[k]))
            nearest[first + i] = best
