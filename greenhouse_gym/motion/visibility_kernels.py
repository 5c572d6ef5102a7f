"""Kernel of the light that gets from many cameras to many points through a voxel map."""

from __future__ import annotations

from math import floor, sqrt

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import kernel

Floats = npt.NDArray[np.float64]

SHORT = 2
"""Last cells before a point, in which nothing hides it."""


@kernel(
    "void(f8[:,:,::1], f8[:,::1], f8[:,:,::1], f8[::1], f8[:,::1], f8[::1], f8[::1], i8[::1], f8, f8[::1], f8[:,::1])",
    writes=("out",),
)
def transmittances(
    turns: Floats,
    origins: Floats,
    centers: Floats,
    radii: Floats,
    points: Floats,
    opacity: Floats,
    low: Floats,
    shape: npt.NDArray[np.int64],
    cell: float,
    limits: Floats,
    out: Floats,
) -> None:
    """Compute the fraction of light that each camera gets from each point, 0 outside of its view.

    Args:
        turns: (m, 3, 3) rotations base_from_camera.
        origins: (m, 3) positions of the cameras, metres.
        centers: (m, b, 3) centers of spheres around the links of the arm, metres.
        radii: (b,) their radii, metres. Spheres that contain the camera hide nothing.
        points: (k, 3) metres.
        opacity: (size,) fraction of light that is lost in each cell of the map, see `VoxelBox`; 0 outside of it.
        low: (3,) lower corner of the map, metres.
        shape: (3,) its number of cells.
        cell: Side of a cell, metres.
        limits: Smallest and largest depth, metres, and largest x and y at a depth of 1.
        out: (m, k) result.
    """
    for m in range(len(origins)):
        for k in range(len(points)):
            out[m, k] = 0.0
            dx, dy, dz = points[k, 0] - origins[m, 0], points[k, 1] - origins[m, 1], points[k, 2] - origins[m, 2]
            z = dx * turns[m, 0, 2] + dy * turns[m, 1, 2] + dz * turns[m, 2, 2]
            if z <= limits[0] or z >= limits[1]:
                continue
            if abs(dx * turns[m, 0, 0] + dy * turns[m, 1, 0] + dz * turns[m, 2, 0]) >= limits[2] * z:
                continue
            if abs(dx * turns[m, 0, 1] + dy * turns[m, 1, 1] + dz * turns[m, 2, 1]) >= limits[3] * z:
                continue
            length = sqrt(dx * dx + dy * dy + dz * dz)
            light = 1.0
            for b in range(len(radii)):
                ax = centers[m, b, 0] - origins[m, 0]
                ay = centers[m, b, 1] - origins[m, 1]
                az = centers[m, b, 2] - origins[m, 2]
                along = (ax * dx + ay * dy + az * dz) / length
                squared = ax * ax + ay * ay + az * az
                radius = radii[b] * radii[b]
                if 0.0 < along < length and squared > radius and squared - along * along < radius:
                    light = 0.0
                    break
            if light == 0.0:
                continue
            for step in range(1, int(length / cell) - SHORT + 1):
                part = step * cell / length
                i = floor((origins[m, 0] + part * dx - low[0]) / cell)
                j = floor((origins[m, 1] + part * dy - low[1]) / cell)
                h = floor((origins[m, 2] + part * dz - low[2]) / cell)
                if 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= h < shape[2]:
                    light *= 1.0 - opacity[(i * shape[1] + j) * shape[2] + h]
                    if light < 0.01:
                        light = 0.0
                        break
            out[m, k] = light
