"""Turn a cloud into one like those of photogrammetry: smooth blobs instead of sharp shapes, waves, and holes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.point_clouds import Cloud

_WAVES = 48  # random plane waves that make a field


@dataclass(frozen=True)
class PhotogrammetryErrors:
    """Errors of multi-view stereo; guesses, since they depend on the photographs. Lengths in metres."""

    blob: float = 0.006  # radius within which points, colors and normals are averaged
    wave: float = 0.0015  # RMS displacement along the normals
    wave_length: float = 0.03  # of the displacement
    hole_fraction: float = 0.2  # of the surface without points
    hole_length: float = 0.12  # of the field that makes holes


def photogrammetric(cloud: Cloud, rng: np.random.Generator, errors: PhotogrammetryErrors | None = None) -> Cloud:
    """Return a cloud as photogrammetry might have made it, with fewer points."""
    errors = errors or PhotogrammetryErrors()
    field = _field(cloud.points, errors.hole_length, rng)
    kept = cloud.select(field > np.quantile(field, errors.hole_fraction))
    tree = cKDTree(kept.points)
    near = tree.query_ball_point(kept.points, errors.blob)
    points, colors, normals = (
        np.array([values[rows].mean(axis=0) for rows in near]) for values in (kept.points, kept.colors, kept.normals)
    )
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    points += errors.wave * _field(points, errors.wave_length, rng)[:, None] * normals
    return Cloud(points, colors, normals)


def _field(points: Array, length: float, rng: np.random.Generator) -> Array:
    """Sample a smooth random field of mean square 1 at points (n, 3), with waves of about a length."""
    directions = rng.normal(size=(_WAVES, 3))
    waves = 2 * np.pi / length * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(np.sqrt(2 / _WAVES) * np.cos(points @ waves.T + rng.uniform(0, 2 * np.pi, _WAVES)).sum(axis=1))
