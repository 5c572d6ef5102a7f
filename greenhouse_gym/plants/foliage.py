"""Leaves of mesh plants: Helios' compound leaves, placed, drooped and colored."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from greenhouse_gym.geometry import Array, rotation_about
from greenhouse_gym.plants.helios import Frond
from greenhouse_gym.plants.organs import Organ, tube


class LeafPalette(NamedTuple):
    """A plant's leaf color: brightness R + G, redness (R - G) / (R + G), and blue as a share of R + G."""

    light: float
    redness: float
    blue: float

    def colors(self, tone: Array) -> Array:
        """Colors (t, 3) of triangles with tones (t, 2) as in `Frond`."""
        light = self.light * tone[:, 0]
        redness = self.redness + 0.5 * tone[:, 1]
        rgb = np.column_stack([light * (1 + redness) / 2, light * (1 - redness) / 2, light * self.blue])
        return np.clip(rgb, 0.0, 1.0)


def leaf_palette(rng: np.random.Generator, redness: float) -> LeafPalette:
    """One plant's leaf color around its row's redness (prior: plants of a row differ by 0.01, one sigma)."""
    return LeafPalette(rng.uniform(0.58, 0.78), redness + rng.normal(0, 0.01), rng.uniform(0.15, 0.25))


def grow_frond(
    rng: np.random.Generator, frond: Frond, node: Array, azimuth: float, size: float, palette: LeafPalette, plant: int
) -> list[Organ]:
    """A compound leaf at a node.

    Args:
        rng: Source of its variation.
        frond: Its shape.
        node: (4,) point on the main stem's axis and the stem's radius, metres.
        azimuth: Direction of growth about z, radians.
        size: Against Helios' own size.
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
    vertices, triangles = tube(axis, 7)
    stalk = np.tile(
        aged._replace(light=1.15 * aged.light, redness=aged.redness + 0.05).colors(np.array([[1.0, 0.0]])),
        (len(triangles), 1),
    )
    return [
        Organ("petiole", vertices, triangles, stalk, plant, axis=axis),
        Organ(
            "leaf", size * frond.blade.vertices @ turn.T + foot, frond.blade.triangles, aged.colors(frond.tone), plant
        ),
    ]
