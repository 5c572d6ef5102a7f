"""Leaves of mesh plants: Helios' compound leaves, placed, drooped and colored."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from greenhouse_gym.crops.helios import Frond, Vine
from greenhouse_gym.crops.organs import Organ, tube_organ
from greenhouse_gym.geometry import Array, rotation_about

SHOOT_LEAVES_PER_METRE = 14.0
_PLAIN = np.array([[1.0, 0.0]])


class LeafPalette(NamedTuple):
    """Leaf color of a plant: brightness R + G, redness (R - G) / (R + G), and blue as a fraction of R + G."""

    light: float
    redness: float
    blue: float

    def colors(self, tone: Array) -> Array:
        """Return colors (t, 3) of triangles with tones (t, 2) as in `Frond`."""
        light = self.light * tone[:, 0]
        redness = self.redness + 0.5 * tone[:, 1]
        rgb = np.column_stack([light * (1 + redness) / 2, light * (1 - redness) / 2, light * self.blue])
        return np.clip(rgb, 0.0, 1.0)


def leaf_palette(rng: np.random.Generator, redness: float) -> LeafPalette:
    """Sample the leaf color of a plant around its row's redness (prior: standard deviation 0.01 within a row)."""
    return LeafPalette(rng.uniform(0.58, 0.78), redness + rng.normal(0, 0.01), rng.uniform(0.15, 0.25))


def grow_frond(
    rng: np.random.Generator, frond: Frond, node: Array, azimuth: float, size: float, palette: LeafPalette, plant: int
) -> list[Organ]:
    """Grow a compound leaf at a node.

    Args:
        rng: Source of all randomness.
        frond: Its shape.
        node: (4,) point on the main stem's axis and the stem's radius, metres.
        azimuth: Direction of growth about z, radians.
        size: Scale of Helios' leaf.
        palette: Its plant's color.
        plant: Number of its plant.

    Returns:
        The petiole and the blade.
    """
    droop = rotation_about(np.array([0.0, 1.0, 0.0]), rng.uniform(0.0, 0.6))
    turn = rotation_about(np.array([0.0, 0.0, 1.0]), azimuth) @ droop
    foot = node[:3] + node[3] * 0.5 * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    axis = np.column_stack([size * frond.petiole[:, :3] @ turn.T + foot, size * frond.petiole[:, 3]])
    aged = palette._replace(light=palette.light * rng.uniform(0.9, 1.1), redness=palette.redness + rng.normal(0, 0.012))
    stalk = aged._replace(light=1.15 * aged.light, redness=aged.redness + 0.05).colors(_PLAIN)[0]
    blade = size * frond.blade.vertices @ turn.T + foot
    return [
        tube_organ("petiole", axis, stalk, plant, around=7),
        Organ("leaf", blade, frond.blade.triangles, aged.colors(frond.tone), plant),
    ]


def grow_shoot(
    rng: np.random.Generator,
    vine: Vine,
    node: Array,
    azimuth: float,
    length: float,
    leaf_size: float,
    palette: LeafPalette,
    color: Array,
    plant: int,
) -> list[Organ]:
    """Grow a side shoot: a stem that leaves the axil steeply and bends up or sags, with leaves of its own.

    Args:
        rng: Source of all randomness.
        vine: Vine that provides the leaves.
        node: (4,) point on the main stem's axis and the stem's radius, metres.
        azimuth: Direction of growth about z, radians.
        length: Its length, metres.
        leaf_size: Scale of Helios' leaves.
        palette: Its plant's leaf color.
        color: (3,) color of its stem.
        plant: Number of its plant.
    """
    steps = max(3, int(length / 0.04))
    slopes = np.linspace(rng.uniform(0.5, 1.1), rng.uniform(-0.4, 1.2), steps)
    turns = azimuth + np.cumsum(rng.normal(0, 0.15, steps))
    along = np.column_stack([np.cos(slopes) * np.cos(turns), np.cos(slopes) * np.sin(turns), np.sin(slopes)])
    points = node[:3] + np.vstack([np.zeros(3), np.cumsum(along * length / steps, axis=0)])
    radii = min(0.6 * node[3], 0.0025 + 0.006 * length) * np.linspace(1.0, 0.6, steps + 1)
    axis = np.column_stack([points, radii])
    organs = [tube_organ("main", axis, color, plant)]
    for leaf in range(1 + int(length * SHOOT_LEAVES_PER_METRE)):
        fraction = (leaf + 1) / (1 + int(length * SHOOT_LEAVES_PER_METRE))
        here = np.array([np.interp(fraction, np.linspace(0, 1, steps + 1), axis[:, k]) for k in range(4)])
        frond = vine.fronds[int(rng.integers(len(vine.fronds)))]
        size = leaf_size * float(rng.uniform(0.6, 1.1)) * (1.2 - 0.5 * fraction)
        organs += grow_frond(rng, frond, here, azimuth + 2.4 * (leaf + 1), size, palette, plant)
    return organs
