"""Kernels of what many cameras see of many points: the light that gets through a map, and lines of sight."""

from __future__ import annotations

from math import floor, sqrt

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import inlined, kernel
from greenhouse_gym.geometry.voxel_kernels import cell_of

Floats = npt.NDArray[np.float64]

SHORT = 2
"""Last cells before a point, in which nothing hides it."""


@inlined
def _in_view(dx, dy, dz, turn, limits):
    """Return whether a point, given from the camera, is within its depths and in its image; see the kernels."""
    z = dx * turn[0, 2] + dy * turn[1, 2] + dz * turn[2, 2]
    return (
        limits[0] < z < limits[1]
        and abs(dx * turn[0, 0] + dy * turn[1, 0] + dz * turn[2, 0]) < limits[2] * z
        and abs(dx * turn[0, 1] + dy * turn[1, 1] + dz * turn[2, 1]) < limits[3] * z
    )


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
            if not _in_view(dx, dy, dz, turns[m], limits):
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


@kernel(
    "void(f8[:,:,::1], f8[:,::1], f8[:,::1], b1[::1], f8[:,::1], f8[::1], i8[::1], f8, f8[::1], f8, f8, b1[:,::1])",
    writes=("seen",),
)
def mark_seen(
    turns: Floats,
    origins: Floats,
    points: Floats,
    opaque: npt.NDArray[np.bool_],
    pose: Floats,
    low: Floats,
    shape: npt.NDArray[np.int64],
    cell: float,
    limits: Floats,
    step: float,
    short: float,
    seen: npt.NDArray[np.bool_],
) -> None:
    """Mark the points in view of each camera whose line of sight meets no opaque cell.

    Args:
        turns: (m, 3, 3) rotations base_from_camera.
        origins: (m, 3) positions of the cameras, metres.
        points: (k, 3) metres.
        opaque: (size,) which cells of a grid hide what is behind them.
        pose: (4, 4) pose of the base in the frame of the grid.
        low: (3,) lower corner of the grid, metres.
        shape: (3,) its number of cells.
        cell: Side of a cell, metres.
        limits: Smallest and largest depth, metres, and largest x and y at a depth of 1.
        step: Distance between samples along a line of sight, metres.
        short: Distance before its end in which nothing hides the point, metres.
        seen: (m, k) result.
    """
    for m in range(len(origins)):
        x, y, z = origins[m, 0], origins[m, 1], origins[m, 2]
        for k in range(len(points)):
            seen[m, k] = False
            dx, dy, dz = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z
            if not _in_view(dx, dy, dz, turns[m], limits):
                continue
            length, along, hidden = sqrt(dx * dx + dy * dy + dz * dz), step, False
            while along < length - short and not hidden:
                a = along / length
                px, py, pz = x + dx * a, y + dy * a, z + dz * a
                at = cell_of(
                    pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3],
                    pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3],
                    pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3],
                    low, shape, cell,
                )  # fmt: skip
                hidden = at >= 0 and opaque[at]
                along += step
            seen[m, k] = not hidden
