"""Grow a row: plants along a line, week by week, as a list of analytic primitives.

A vine is lowered by about one truss a week while new trusses open at the top, so week w shows the same plants with
every truss one spacing lower and riper than in week w - 1. Dimensions are those of high-wire tomato at harvest.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count, pairwise

import numpy as np

from greenhouse_gym.crops.cultivars import CULTIVARS, Cultivar
from greenhouse_gym.crops.leaf import grow_leaf
from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.crops.plant_row import (
    GUTTER_HEIGHT,
    HIGHEST_TRUSS,
    LOWEST_TRUSS,
    PLANT_SPACING,
    ROW_PITCH,
    STEM_LINE,
    TRUSS_SPACING,
    WIRE_HEIGHT,
    PlantRow,
)
from greenhouse_gym.crops.trained import grow_mesh_row
from greenhouse_gym.crops.truss import FruitStyle, grow_truss
from greenhouse_gym.errors import InvalidValueError, UnknownNameError, require_choice
from greenhouse_gym.geometry import Array, Box, Shape

__all__ = ["HIGHEST_TRUSS", "LOWEST_TRUSS", "PLANT_SPACING", "SOURCES", "STEM_LINE", "STYLES", "TRUSS_SPACING"]
__all__ += ["PlantRow", "grow_row"]

BARE_BELOW = 1.35  # leaves below this height are taken off as the vine is lowered

STYLES = {
    "cluster": FruitStyle(count=(3, 5), diameter=(0.045, 0.067), rachis=0.13),
    "beefsteak": FruitStyle(count=(3, 4), diameter=(0.067, 0.095), rachis=0.13),
    "cherry": FruitStyle(count=(10, 20), diameter=(0.026, 0.034), rachis=0.17),
}
"""Fruit styles by name: numbers and sizes as grown."""


SOURCES = ("own", "helios")
"""Where plants come from: analytic primitives of this module, or the organ meshes of Helios (extra ``plants``)."""


def grow_row(
    seed: int,
    length: float = 5.0,
    week: int = 0,
    style: str | Cultivar = "cluster",
    stem_line: float = STEM_LINE,
    source: str = "own",
) -> PlantRow:
    """Grow a row of tomato plants with a second row behind it.

    Args:
        seed: Same seed, same plants; over the weeks the same plants grow on.
        length: Length of row to be photographed, metres; plants stand half a metre beyond both ends.
        week: Growth week, 0 = first harvest.
        style: One of `STYLES`; with ``source="helios"`` one of `CULTIVARS`, or a `Cultivar`.
        stem_line: x of the row, metres.
        source: One of `SOURCES`.

    Returns:
        The row in the world frame.

    Raises:
        InvalidValueError: ``length`` is not positive and finite, or ``week`` or ``seed`` is negative.
        UnknownNameError: No such style or source.
        MissingDependencyError: ``source="helios"`` without the extra ``plants``.
    """
    if not (np.isfinite(length) and length > 0):
        raise InvalidValueError(f"length must be a positive number of metres, got {length!r}")
    if week < 0:
        raise InvalidValueError(f"week must be 0 or more, got {week!r}")
    if seed < 0:
        raise InvalidValueError(f"seed must be 0 or more, got {seed!r}")
    if require_choice("source of plants", source, SOURCES) == "helios":
        cultivar = style if isinstance(style, Cultivar) else CULTIVARS[require_choice("cultivar", style, CULTIVARS)]
        return grow_mesh_row(seed, length, week, cultivar, stem_line)
    if not isinstance(style, str) or style not in STYLES:
        raise UnknownNameError("fruit style", style, STYLES)
    front = _grow_line(seed, 0, length, week, STYLES[style], stem_line)
    back = _grow_line(seed, 1, length, week, STYLES[style], stem_line + ROW_PITCH)
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
    for beside in (0.32, 0.82):
        ends = np.array([[x - beside, low, 0.06], [x - beside, high, 0.06]])
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
    beside = np.array([0.0, radius + 0.004, 0.0]) * rng.choice([-1.0, 1.0])
    stems += [Stem(a + beside, b + beside, 0.001, kind="string") for a, b in pairwise(axis)]

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
        fruits, parts = grow_truss(own, node, radius, azimuth, ripeness, style, next(truss_numbers))
        tomatoes += fruits
        stems += parts
        for leaf in range(3):
            leaf_height = height + (leaf + 0.5) * spacing / 3
            if leaf_height > max(BARE_BELOW, LOWEST_TRUSS) and leaf_height < WIRE_HEIGHT - 0.1:
                node = np.array([np.interp(leaf_height, heights, axis[:, k]) for k in range(3)])
                clutter += grow_leaf(own, node, twist + 2.4 * (3 * j + leaf))
    return tomatoes, stems, clutter
