"""Fine registration of two stations: point-to-plane ICP between surfaces that face the same way.

The error is measured along the mean of both normals (symmetric point-to-plane, Rusinkiewicz 2019) with Tukey weights.
Stems are thinner than the distance within which partners are looked for, and stations see them from different sides, so
two points are partners only if their normals agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from greenhouse_gym.geometry import Array, pose, transform
from greenhouse_gym.reconstruction.clouds import Cloud
from greenhouse_gym.reconstruction.settings import ReconstructionSettings


@dataclass(frozen=True, eq=False)
class Surface:
    """A cloud to register to; its search tree is built once."""

    cloud: Cloud

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree over the points."""
        return cKDTree(self.cloud.points)


@dataclass(frozen=True, eq=False)
class Alignment:
    """What fine registration found.

    Attributes:
        first_from_second: (4, 4).
        fitness: Share of the second cloud's points with a partner.
        rmse: Root mean square distance of partners along their normals, metres.
        information: (6, 6) rotation then translation, in the first cloud's frame, for the pose graph.
    """

    first_from_second: Array
    fitness: float
    rmse: float
    information: Array


def align(first: Surface, second: Cloud, start: Array, settings: ReconstructionSettings) -> Alignment:
    """Register the second cloud to the first from a start within ``settings.fine_distance``.

    Args:
        first: What to register to.
        second: The cloud to move.
        start: (4, 4) first_from_second to start from.
        settings: All settings.
    """
    current = np.array(start, dtype=np.float64)
    for _ in range(settings.icp_iterations):
        points, residual, axes = _partners(first, second, current, settings)
        if len(points) < 6:
            break
        center = points.mean(axis=0)
        jacobian = np.column_stack([np.cross(points - center, axes), axes])
        weighted = jacobian * _tukey(residual)[:, None]
        step = np.linalg.lstsq(jacobian.T @ weighted, -weighted.T @ residual, rcond=1e-9)[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        current = pose(turn, center + step[3:] - turn @ center) @ current
        if np.abs(step).max() < 1e-5:
            break
    points, residual, axes = _partners(first, second, current, settings)
    if len(points) < 6:
        return Alignment(current, 0.0, float("nan"), np.eye(6))
    jacobian = np.column_stack([np.cross(points, axes), axes])
    rmse = float(np.sqrt(np.mean(residual**2)))
    information = jacobian.T @ (jacobian * _tukey(residual)[:, None]) / max(rmse, 1e-6) ** 2
    return Alignment(current, len(points) / len(second), rmse, information)


def _partners(
    first: Surface, second: Cloud, first_from_second: Array, settings: ReconstructionSettings
) -> tuple[Array, Array, Array]:
    """Moved points (k, 3) that have a partner, distances along the mean normals (k,), those normals (k, 3)."""
    moved = transform(first_from_second, second.points)
    normals = second.normals @ first_from_second[:3, :3].T
    distance, rows = first.tree.query(moved, distance_upper_bound=settings.fine_distance, workers=-1)
    near = np.flatnonzero(np.isfinite(distance))
    near = near[(normals[near] * first.cloud.normals[rows[near]]).sum(axis=1) > settings.facing]
    rows = rows[near]
    axes = normals[near] + first.cloud.normals[rows]
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    residual = ((moved[near] - first.cloud.points[rows]) * axes).sum(axis=1)
    return moved[near], residual, axes


def _tukey(residual: Array) -> Array:
    """Weights (k,) that fall to zero at 2.5 standard deviations, estimated robustly, at least a millimetre."""
    scale = max(2.5 * 1.4826 * float(np.median(np.abs(residual))), 0.001)
    return np.clip(1 - (residual / scale) ** 2, 0, None) ** 2
