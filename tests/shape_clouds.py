"""Clouds of simple shapes as a camera sees them: points, colors and normals."""

from __future__ import annotations

import numpy as np

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]
RED = np.array([0.76, 0.10, 0.07])
CAMERA = np.array([0.0, 0.2, 1.1])


def half_sphere(
    center: tuple[float, float, float], radius: float, seed: int = 0, noise: float = 0.001, color: np.ndarray = RED
) -> Arrays:
    """Points, colors and normals of the side of a ball that faces the camera, one per 2 mm square, with noise."""
    random = np.random.default_rng(seed)
    unit = random.normal(size=(int(4 * np.pi * radius**2 / 0.002**2), 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    unit = unit[unit @ (CAMERA - center) > 0]
    points = center + (radius + random.normal(0, noise, (len(unit), 1))) * unit
    normals = unit + random.normal(0, 0.1, unit.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = np.clip(color * random.uniform(0.5, 1.2, (len(unit), 1)), 0, 1)
    return points, colors, normals


def together(*parts: Arrays) -> Arrays:
    return tuple(np.concatenate(arrays) for arrays in zip(*parts, strict=True))  # type: ignore[return-value]


def cylinder(x: float, y: float, low: float, high: float, radius: float, seed: int = 0) -> Arrays:
    """The side of an upright cylinder that faces the camera."""
    random = np.random.default_rng(seed)
    count = int(np.pi * radius * (high - low) / 0.002**2)
    angle = random.uniform(np.pi / 2, 3 * np.pi / 2, count)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    points = np.column_stack([np.full(count, x), np.full(count, y), random.uniform(low, high, count)])
    points += (radius + random.normal(0, 0.0007, (count, 1))) * normals
    return points, np.tile([0.36, 0.50, 0.22], (count, 1)), normals


def plane(seed: int = 0, count: int = 20_000) -> Arrays:
    random = np.random.default_rng(seed)
    points = np.column_stack([np.full(count, 0.5), random.uniform(0, 0.4, count), random.uniform(0.9, 1.3, count)])
    points[:, 0] += random.normal(0, 0.001, count)
    return points, np.full((count, 3), 0.5), np.tile([-1.0, 0.0, 0.0], (count, 1))
