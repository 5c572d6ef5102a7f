"""Grow a truss: a drooping peduncle, pedicels left and right, fruits that touch but do not overlap."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Array, Sphere


@dataclass(frozen=True)
class FruitStyle:
    """How a cultivar fruits.

    Attributes:
        count: Fewest and most fruits per truss.
        diameter: Smallest and largest fruit, metres.
        rachis: Length of peduncle and rachis together, metres.
    """

    count: tuple[int, int]
    diameter: tuple[float, float]
    rachis: float


def grow_truss(
    rng: np.random.Generator,
    node: Array,
    stem_radius: float,
    azimuth: float,
    ripeness: float,
    style: FruitStyle,
    truss: int,
) -> tuple[list[Tomato], list[Stem]]:
    """Grow one truss from a node of the main stem.

    Args:
        rng: Source of all variation.
        node: (3,) point on the main stem's axis, metres.
        stem_radius: Radius of the main stem, metres.
        azimuth: Direction of growth about z, radians; pi is towards the aisle.
        ripeness: Mean ripeness of the fruits; those near the stem are riper.
        style: Numbers and sizes.
        truss: Number of the truss.

    Returns:
        The fruits, and the peduncle and pedicels as capsules.
    """
    outward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    sideways = np.array([-outward[1], outward[0], 0.0])
    count = int(rng.integers(style.count[0], style.count[1] + 1))
    radii = rng.uniform(*style.diameter) / 2 * rng.uniform(0.88, 1.0, count)
    radii = np.clip(radii, style.diameter[0] / 2, style.diameter[1] / 2)

    # the peduncle leaves the stem slightly upwards and bends down under the fruit
    segments = 6
    length = style.rachis * rng.uniform(0.85, 1.15)
    slopes = np.linspace(rng.uniform(0.2, 0.6), rng.uniform(-1.4, -1.1), segments)
    steps = length / segments * (np.cos(slopes)[:, None] * outward + np.sin(slopes)[:, None] * [0.0, 0.0, 1.0])
    rachis = np.vstack([node, node + np.cumsum(steps, axis=0)])
    thickness = rng.uniform(0.0015, 0.00225)
    parts = [Stem(a, b, thickness, kind="peduncle") for a, b in itertools.pairwise(rachis)]

    shares = np.linspace(0.5, 1.0, count)
    joints = np.column_stack([np.interp(shares, np.linspace(0, 1, len(rachis)), rachis[:, k]) for k in range(3)])
    sides = np.where(np.arange(count) % 2 == 0, 1.0, -1.0) * (np.arange(count) < count - 1)
    directions = sides[:, None] * sideways + 0.4 * outward + [0.0, 0.0, -0.8] + rng.normal(0, 0.15, (count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    pedicels = rng.uniform(0.009, 0.022, count)
    centers = joints + (pedicels + radii)[:, None] * directions
    centers = push_apart(centers, radii, joints, pedicels + radii, rachis, node, stem_radius)
    for joint, center, radius in zip(joints, centers, radii, strict=True):
        towards = (center - joint) / np.linalg.norm(center - joint)
        parts.append(Stem(joint, center - radius * towards, max(0.7 * thickness, 0.001), kind="pedicel"))
    spread = np.clip(ripeness + np.linspace(0.1, -0.1, count) + rng.normal(0, 0.04, count), 0.0, 1.0)
    fruits = [
        Tomato(Sphere(center, radius), truss, float(value))
        for center, radius, value in zip(centers, radii, spread, strict=True)
    ]
    return fruits, parts


def push_apart(
    centers: Array, radii: Array, joints: Array, reaches: Array, rachis: Array, node: Array, stem_radius: float
) -> Array:
    """Relax fruit centers (n, 3) until fruits clear each other, the rachis and the main stem, within their reach."""
    centers = centers.copy()
    gap = radii[:, None] + radii[None] + 0.0005

    def separate() -> tuple[Array, Array]:
        """How deep each two fruits overlap (n, n), and how each is to move because of it (n, 3)."""
        delta = centers[:, None] - centers[None]
        distance = np.linalg.norm(delta, axis=-1) + np.eye(len(centers))
        overlap = np.maximum(gap - distance, 0.0) * (1.0 - np.eye(len(centers)))
        return overlap, 0.5 * ((overlap / distance)[..., None] * delta).sum(axis=1)

    for _ in range(50):
        for _ in range(200):
            overlap, move = separate()
            centers += move
            for points, room in ((rachis, radii + 0.003), (None, radii + stem_radius + 0.002)):
                if points is None:
                    away = centers - node
                    away[:, 2] = 0.0
                else:
                    nearest = np.linalg.norm(centers[:, None] - points[None], axis=-1).argmin(axis=1)
                    away = centers - points[nearest]
                size = np.maximum(np.linalg.norm(away, axis=1), 1e-6)
                centers += (np.maximum(room - size, 0.0) / size)[:, None] * away
            if overlap.max(initial=0.0) < 1e-4:
                break
        # a fruit pushed beyond its pedicel keeps its place and gets the longer pedicel; one pushed onto it moves off
        towards = centers - joints
        size = np.maximum(np.linalg.norm(towards, axis=1), 1e-6)
        centers += (np.maximum(radii + 0.004 - size, 0.0) / size)[:, None] * towards
        if separate()[0].max(initial=0.0) < 1e-3:
            break
    return centers
