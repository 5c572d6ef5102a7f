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
    for i in range(len(points)):
        p, best = (points[i, 0], points[i, 1], points[i, 2]), np.inf
        for k in range(count):
            away = (balls[k, 0] - p[0], balls[k, 1] - p[1], balls[k, 2] - p[2])
            reach = balls[k, 3] + min(best, limit) + _ROUNDING
            if reach < 0.0 or dot(away, away) > reach * reach:
                continue
            start, end = (starts[k, 0], starts[k, 1], starts[k, 2]), (ends[k, 0], ends[k, 1], ends[k, 2])
            size = (sizes[k, 0], sizes[k, 1], sizes[k, 2])
            best = min(best, _distance(p, kinds[k], start, end, size, rotations[k]))
        nearest[i] = best
