"""Grow a row: plants along a line, week by week, as a list of analytic shapes.

A vine is lowered by about one truss a week while new trusses open at the top, so week w shows the same plants with
every truss one spacing lower and riper than in week w - 1. Dimensions are those of high-wire tomato at harvest.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count, pairwise

import numpy as np

from greenhouse_gym.crops.crop import (
    GUTTER_HEIGHT,
    HIGHEST_TRUSS,
    LOWEST_TRUSS,
    PLANT_SPACING,
    ROW_PITCH,
    TRUSS_SPACING,
    WIRE_HEIGHT,
    PlantRow,
)
from greenhouse_gym.crops.cultivars import FruitStyle
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Array, Box, Capsule, Shape, Sphere

BARE_BELOW = 1.35
"""Height below which leaves are taken off as the vine is lowered, metres."""

LEAFLET_THICKNESS = 0.002


def grow_analytic_row(seed: int, length: float, week: int, style: FruitStyle, stem_line: float) -> PlantRow:
    """Grow a row of tomato plants with a second row behind it.

    Args:
        seed: Same seed, same plants; over the weeks the same plants continue to grow.
        length: Length of row to be photographed, metres; plants stand half a metre beyond both ends.
        week: Growth week, 0 = first harvest.
        style: Number and size of the fruits.
        stem_line: x of the row, metres.
    """
    front = _grow_line(seed, 0, length, week, style, stem_line)
    back = _grow_line(seed, 1, length, week, style, stem_line + ROW_PITCH)
    return PlantRow(front.tomatoes, front.stems, front.clutter, length, week, behind=back)


def _grow_line(seed: int, line: int, length: float, week: int, style: FruitStyle, x: float) -> PlantRow:
    rng = np.random.default_rng([seed, line])
    tomatoes: list[Tomato] = []
    stems: list[Stem] = []
    clutter: list[Shape] = []
    y = -0.5 + rng.uniform(0, 0.2)
    truss_numbers = count()
    for plant in count():
        if y > length + 0.5:
            break
        base = np.array([x + rng.uniform(-0.03, 0.03), y, GUTTER_HEIGHT])
        fruits, parts, leaves = _grow_plant([seed, line, plant], base, week, style, truss_numbers)
        tomatoes += fruits
        stems += parts
        clutter += leaves
        y += rng.uniform(*PLANT_SPACING)
    low, high = -0.8, length + 0.8
    middle, half = (low + high) / 2, (high - low) / 2
    gutter = np.array([x, middle, GUTTER_HEIGHT - 0.05])
    clutter.append(Box(gutter, np.array([0.11, half, 0.05]), np.eye(3)))
    for side in (0.32, 0.82):
        ends = np.array([[x - side, low, 0.06], [x - side, high, 0.06]])
        stems.append(Stem(ends[0], ends[1], 0.0255, kind="pipe"))
    return PlantRow(tuple(tomatoes), tuple(stems), tuple(clutter), length, week)


def _grow_plant(
    seed: list[int], base: Array, week: int, style: FruitStyle, truss_numbers: Iterator[int]
) -> tuple[list[Tomato], list[Stem], list[Shape]]:
    rng = np.random.default_rng(seed)
    tomatoes: list[Tomato] = []
    spacing = rng.uniform(*TRUSS_SPACING)
    radius = rng.uniform(0.004, 0.007)
    heights = np.arange(GUTTER_HEIGHT, WIRE_HEIGHT + 0.05, 0.1)
    sway = np.cumsum(rng.normal(0, 0.008, (len(heights), 2)), axis=0)
    sway -= np.outer(np.linspace(0, 1, len(heights)), sway[-1])  # the string holds the top above the gutter
    axis = np.column_stack([base[0] + sway[:, 0], base[1] + sway[:, 1], heights])
    stems = [Stem(a, b, radius, kind="main") for a, b in pairwise(axis)]
    side = np.array([0.0, radius + 0.004, 0.0]) * rng.choice([-1.0, 1.0])
    stems += [Stem(a + side, b + side, 0.001, kind="string") for a, b in pairwise(axis)]

    clutter: list[Shape] = []
    offset = rng.uniform(0, spacing)
    twist = rng.uniform(0, 2 * np.pi)
    # truss j opens one spacing above truss j - 1; each week lowers the vine by one spacing
    for j in range(week, week + int((HIGHEST_TRUSS - LOWEST_TRUSS) / spacing) + 2):
        own = np.random.default_rng([*seed, j])
        height = LOWEST_TRUSS + offset + (j - week) * spacing
        if height > HIGHEST_TRUSS:
            break
        node = np.array([np.interp(height, heights, axis[:, k]) for k in range(3)])
        # pickers turn trusses to the aisle; leaves go all around
        azimuth = np.pi + own.normal(0, 0.7)
        ripeness = float(np.clip(1.0 - (height - 0.75) / 0.6, 0.0, 1.0))
        fruits, parts = _grow_truss(own, node, radius, azimuth, ripeness, style, next(truss_numbers))
        tomatoes += fruits
        stems += parts
        for leaf in range(3):
            leaf_height = height + (leaf + 0.5) * spacing / 3
            if leaf_height > max(BARE_BELOW, LOWEST_TRUSS) and leaf_height < WIRE_HEIGHT - 0.1:
                node = np.array([np.interp(leaf_height, heights, axis[:, k]) for k in range(3)])
                clutter += _grow_leaf(own, node, twist + 2.4 * (3 * j + leaf))
    return tomatoes, stems, clutter


def _grow_truss(
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
        rng: Source of all randomness.
        node: (3,) point on the main stem's axis, metres.
        stem_radius: Radius of the main stem, metres.
        azimuth: Direction of growth about z, radians; pi is towards the aisle.
        ripeness: Mean ripeness of the fruits; fruits near the stem are riper.
        style: Number and size of the fruits.
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
    parts = [Stem(a, b, thickness, kind="peduncle") for a, b in pairwise(rachis)]

    fractions = np.linspace(0.5, 1.0, count)
    joints = np.column_stack([np.interp(fractions, np.linspace(0, 1, len(rachis)), rachis[:, k]) for k in range(3)])
    sides = np.where(np.arange(count) % 2 == 0, 1.0, -1.0) * (np.arange(count) < count - 1)
    directions = sides[:, None] * sideways + 0.4 * outward + [0.0, 0.0, -0.8] + rng.normal(0, 0.15, (count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    pedicels = rng.uniform(0.009, 0.022, count)
    centers = joints + (pedicels + radii)[:, None] * directions
    centers = push_apart(centers, radii, joints, rachis, node, stem_radius)
    for joint, center, radius in zip(joints, centers, radii, strict=True):
        towards = (center - joint) / np.linalg.norm(center - joint)
        parts.append(Stem(joint, center - radius * towards, max(0.7 * thickness, 0.001), kind="pedicel"))
    spread = np.clip(ripeness + np.linspace(0.1, -0.1, count) + rng.normal(0, 0.04, count), 0.0, 1.0)
    fruits = [
        Tomato(Sphere(center, radius), truss, float(value))
        for center, radius, value in zip(centers, radii, spread, strict=True)
    ]
    return fruits, parts


def push_apart(centers: Array, radii: Array, joints: Array, rachis: Array, node: Array, stem_radius: float) -> Array:
    """Relax fruit centers (n, 3) until fruits clear each other, their pedicels, the rachis and the main stem."""
    centers = centers.copy()
    gap = radii[:, None] + radii[None] + 0.0005

    def separate() -> tuple[Array, Array]:
        """Return the overlaps of pairs of fruits (n, n) and the correction of each fruit (n, 3)."""
        delta = centers[:, None] - centers[None]
        distance = np.linalg.norm(delta, axis=-1) + np.eye(len(centers))
        overlap = np.maximum(gap - distance, 0.0) * (1.0 - np.eye(len(centers)))
        return overlap, 0.5 * ((overlap / distance)[..., None] * delta).sum(axis=1)

    for _ in range(50):
        for _ in range(200):
            overlap, move = separate()
            centers += move
            for points, clearance in ((rachis, radii + 0.003), (None, radii + stem_radius + 0.002)):
                if points is None:
                    away = centers - node
                    away[:, 2] = 0.0
                else:
                    nearest = np.linalg.norm(centers[:, None] - points[None], axis=-1).argmin(axis=1)
                    away = centers - points[nearest]
                size = np.maximum(np.linalg.norm(away, axis=1), 1e-6)
                centers += (np.maximum(clearance - size, 0.0) / size)[:, None] * away
            if overlap.max(initial=0.0) < 1e-4:
                break
        # a fruit pushed beyond its pedicel stays there and gets a longer one; a fruit pushed onto its pedicel moves off
        towards = centers - joints
        size = np.maximum(np.linalg.norm(towards, axis=1), 1e-6)
        centers += (np.maximum(radii + 0.004 - size, 0.0) / size)[:, None] * towards
        if separate()[0].max(initial=0.0) < 1e-3:
            break
    return centers


def _grow_leaf(rng: np.random.Generator, node: Array, azimuth: float) -> list[Shape]:
    """Grow one compound leaf from a node of the main stem: a drooping petiole with pairs of flat leaflets.

    Args:
        rng: Source of all randomness.
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
    leaf: list[Shape] = [Capsule(a, b, 0.0025) for a, b in pairwise(points)]
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
