"""Grow a leaf: a drooping petiole with pairs of flat leaflets."""

from __future__ import annotations

import itertools

import numpy as np

from greenhouse_gym.geometry import Array, Box, Capsule, Shape

LEAFLET_THICKNESS = 0.002


def grow_leaf(rng: np.random.Generator, node: Array, azimuth: float) -> list[Shape]:
    """Grow one compound leaf from a node of the main stem.

    Args:
        rng: Source of all variation.
        node: (3,) point on the main stem's axis, metres.
        azimuth: Direction of growth about z, radians.

    Returns:
        The petiole as capsules and the leaflets as thin boxes.
    """
    outward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    length = rng.uniform(0.25, 0.38)
    slopes = np.linspace(rng.uniform(0.1, 0.5), rng.uniform(-0.9, -0.4), 5)
    steps = length / 5 * (np.cos(slopes)[:, None] * outward + np.sin(slopes)[:, None] * [0.0, 0.0, 1.0])
    points = np.vstack([node, node + np.cumsum(steps, axis=0)])
    leaf: list[Shape] = [Capsule(a, b, 0.0025) for a, b in itertools.pairwise(points)]
    for k in range(2, 6):
        along = (points[k] - points[k - 1]) / np.linalg.norm(points[k] - points[k - 1])
        side = np.cross(along, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side)
        for sign in (-1.0, 1.0) if k < 5 else (0.0,):
            direction = sign * side + 0.5 * along + [0.0, 0.0, rng.normal(-0.3, 0.15)]
            direction /= np.linalg.norm(direction)
            width = np.cross(direction, np.cross(along, direction) + [0.0, 0.0, 0.7])
            width /= np.linalg.norm(width)
            half_length, half_width = rng.uniform(0.035, 0.06), rng.uniform(0.018, 0.03)
            frame = np.column_stack([direction, width, np.cross(direction, width)])
            center = points[k] + (half_length + 0.01) * direction
            leaf.append(Box(center, np.array([half_length, half_width, LEAFLET_THICKNESS / 2]), frame))
    return leaf
