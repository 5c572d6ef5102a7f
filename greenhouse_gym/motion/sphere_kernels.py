"""Kernel of the points near the spheres of an arm."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import inlined, kernel
from greenhouse_gym.geometry import Array


@inlined
def _inside(x, y, z, low, high):
    """Return whether a point lies in a box."""
    return low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]


@kernel("void(f8[:, ::1], f8[:, :, ::1], f8[::1], f8, b1[::1])", writes=("near",))
def mark_near(points: Array, centers: Array, radii: Array, limit: float, near: npt.NDArray[np.bool_]) -> None:
    """Mark the points within a distance of any of some spheres.

    Args:
        points: (n, 3) metres.
        centers: (m, b, 3) centers of the spheres of an arm in m configurations, metres.
        radii: (b,) metres.
        limit: Distance from the surfaces, metres.
        near: (n,) result.
    """
    count, spheres = centers.shape[0], len(radii)
    low, high = np.full((count + 1, 3), np.inf), np.full((count + 1, 3), -np.inf)  # boxes; the last encloses all
    for m in range(count):
        for b in range(spheres):
            for axis in range(3):
                low[m, axis] = min(low[m, axis], centers[m, b, axis] - radii[b] - limit)
                high[m, axis] = max(high[m, axis], centers[m, b, axis] + radii[b] + limit)
        for axis in range(3):
            low[count, axis] = min(low[count, axis], low[m, axis])
            high[count, axis] = max(high[count, axis], high[m, axis])
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        near[i] = False
        if not _inside(x, y, z, low[count], high[count]):
            continue
        for m in range(count):
            if not _inside(x, y, z, low[m], high[m]):
                continue
            for b in range(spheres):
                dx, dy, dz = x - centers[m, b, 0], y - centers[m, b, 1], z - centers[m, b, 2]
                reach = radii[b] + limit
                if reach >= 0.0 and dx * dx + dy * dy + dz * dz <= reach * reach:
                    near[i] = True
                    break
            if near[i]:
                break
