"""Growth of a high-wire row as meshes, week by week: organs of Helios' vines along strings.

Helios grows the organs. This module takes the decisions of a grower: which leaves are removed, at which height a truss
hangs, how many fruits it bears. A vine is lowered by one truss a week, so in week w every truss hangs one spacing lower
and is a week older than in week w - 1; plants, trusses and fruits keep their numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from greenhouse_gym.crops.crop import (
    GUTTER_COLOR,
    GUTTER_HEIGHT,
    HIGHEST_TRUSS,
    LOWEST_TRUSS,
    PLANT_SPACING,
    ROW_PITCH,
    TRUSS_SPACING,
    WIRE_HEIGHT,
    PlantRow,
)
from greenhouse_gym.crops.cultivars import Cultivar
from greenhouse_gym.crops.helios import Vine, grow_vine
from greenhouse_gym.crops.mesh_organs import (
    SHOOT_LEAVES_PER_METRE,
    TrussNode,
    grow_frond,
    grow_mesh_truss,
    grow_shoot,
    leaf_palette,
)
from greenhouse_gym.crops.organs import Organ, stems_of, tube_organ
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.errors import GrowthError
from greenhouse_gym.geometry import Array

VINES = 3
"""Number of vines that Helios grows for a row; each plant takes its organs from one vine, placed and scaled again."""

FIRST_RED = 0.75
"""Height at which a truss is red, metres."""

HIGHEST_LEAF = WIRE_HEIGHT - 0.1
LINE_SPACING = 0.35
SHOOT_LEAF = 0.5
"""Size of a side shoot's leaves relative to those of the main stem."""

_STEM_COLOR = (0.42, 0.52, 0.27)
_STRING_COLOR = (0.85, 0.84, 0.78)
_PIPE_COLOR = (0.80, 0.80, 0.80)


@dataclass(frozen=True)
class _RowTraits:
    """Traits that all plants of a row share."""

    seed: int
    week: int
    cultivar: Cultivar
    vines: tuple[Vine, ...]
    aspect: float
    leaf_redness: float
    leaf_size: float


def grow_mesh_row(seed: int, length: float, week: int, cultivar: Cultivar, stem_line: float) -> PlantRow:
    """Grow a row of Helios plants with a second row behind it.

    Args:
        seed: Same seed, same plants; over the weeks the same plants continue to grow.
        length: Length of row to be photographed, metres; plants stand half a metre beyond both ends.
        week: Growth week, 0 = first harvest.
        cultivar: Growth of the plants.
        stem_line: x of the row, metres.

    Raises:
        MissingDependencyError: PyHelios is missing or of an untested version.
        GrowthError: No plant bears fruit.
    """
    rng = np.random.default_rng([seed, 7])
    seeds = rng.integers(1, 2**31, VINES).tolist()
    vines = tuple(grow_vine(own, cultivar.model, cultivar.leaf_curl, cultivar.leaf_width) for own in seeds)
    traits = _RowTraits(
        seed,
        week,
        cultivar,
        vines,
        rng.uniform(*cultivar.aspect),
        rng.uniform(*cultivar.leaf_redness),
        _leaf_size(cultivar, vines),
    )
    front = _grow_row(traits, 0, length, stem_line)
    back = _grow_row(traits, 1, length, stem_line + ROW_PITCH)
    if not front.tomatoes:
        raise GrowthError(f"the row with seed {seed} bears no fruit in week {week}: {cultivar}")
    return replace(front, behind=back)


def _leaf_size(cultivar: Cultivar, vines: Sequence[Vine]) -> float:
    """Return the scale of Helios' leaves that gives a row its leaf area."""
    nodes = np.arange(cultivar.bare_below, HIGHEST_LEAF, float(np.mean(TRUSS_SPACING)) / 3)
    each = np.mean([frond.area for vine in vines for frond in vine.fronds])
    on_a_metre = cultivar.lines / np.mean(PLANT_SPACING) * (_youth(nodes) ** 2).sum() * each
    in_shoots = (
        1 + cultivar.side_shoots * SHOOT_LEAVES_PER_METRE * float(np.mean(cultivar.shoot_length)) * SHOOT_LEAF**2
    )
    return float(np.sqrt(cultivar.leaf_area / (on_a_metre * in_shoots)))


def _grow_row(traits: _RowTraits, number: int, length: float, x: float) -> PlantRow:
    """Grow one row, front or behind, with its lines of plants and its fixtures."""
    organs: list[Organ] = []
    tomatoes: list[Tomato] = []
    plants = count()
    for line in range(traits.cultivar.lines):
        seed = [traits.seed, number] if not line else [traits.seed, number, line]
        rng = np.random.default_rng(seed)
        y = -0.5 + rng.uniform(0, 0.2)
        while y <= length + 0.5:
            base = np.array([x + line * LINE_SPACING + rng.uniform(-0.03, 0.03), y, GUTTER_HEIGHT])
            grown, fruits = _grow_plant(traits, [traits.seed, number, next(plants)], base, len(tomatoes))
            organs += grown
            tomatoes += fruits
            y += rng.uniform(*PLANT_SPACING)
    organs += _fixtures(x, length)
    return PlantRow(tuple(tomatoes), stems_of(organs), (), length, traits.week, None, tuple(organs))


def _fixtures(x: float, length: float) -> list[Organ]:
    """Return the gutter and the two pipe rails in front of the row."""
    low, high = -0.8, length + 0.8
    organs = []
    for offset in (0.32, 0.82):
        axis = np.array([[x - offset, low, 0.06, 0.0255], [x - offset, high, 0.06, 0.0255]])
        organs.append(tube_organ("pipe", axis, _PIPE_COLOR, around=16))
    corners = np.array([[i, j, k] for i in (-0.11, 0.11) for j in (low, high) for k in (-0.1, 0.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    vertices = corners + [x, 0.0, GUTTER_HEIGHT]
    return [*organs, Organ("gutter", vertices, triangles, np.tile(GUTTER_COLOR, (12, 1)))]


def _grow_plant(traits: _RowTraits, seed: list[int], base: Array, first_fruit: int) -> tuple[list[Organ], list[Tomato]]:
    """Grow one plant; its tomatoes are numbered from ``first_fruit`` within the row."""
    rng = np.random.default_rng(seed)
    cultivar, vine = traits.cultivar, traits.vines[seed[2] % len(traits.vines)]
    spacing = rng.uniform(*TRUSS_SPACING)
    axis, string = _axes(rng, base, rng.uniform(*cultivar.stem_radius), cultivar.winding)
    stem_color = np.array(_STEM_COLOR) * rng.uniform(0.9, 1.1)
    organs = [
        tube_organ("main", axis, stem_color, around=12),
        tube_organ("string", string, _STRING_COLOR, around=5),
    ]
    tomatoes: list[Tomato] = []
    offset, twist, first_frond = rng.uniform(0, spacing), rng.uniform(0, 2 * np.pi), int(rng.integers(0, 1000))
    flowering = rng.uniform(*cultivar.flowering)
    palette = leaf_palette(rng, traits.leaf_redness)
    for j in range(traits.week, traits.week + int((HIGHEST_TRUSS - LOWEST_TRUSS) / spacing) + 2):
        own = np.random.default_rng([*seed, j])
        height = LOWEST_TRUSS + offset + (j - traits.week) * spacing
        if height > HIGHEST_TRUSS:
            break
        azimuth = np.pi + own.normal(0, 0.7)  # pickers turn trusses to the aisle
        age = (flowering - height) / (flowering - FIRST_RED)
        place = TrussNode(_at(axis, height), azimuth, 100 * seed[2] + j, first_fruit + len(tomatoes))
        grown, fruits = grow_mesh_truss(np.random.default_rng([*seed, j, 1]), vine, cultivar, traits.aspect, place, age)
        organs += grown
        tomatoes += fruits
        for leaf in range(3):
            node, here = 3 * j + leaf, height + (leaf + 0.5) * spacing / 3
            if not cultivar.bare_below < here < HIGHEST_LEAF:
                continue
            own = np.random.default_rng([*seed, j, 2 + leaf])
            frond = vine.fronds[(first_frond + node) % len(vine.fronds)]
            size = traits.leaf_size * float(_youth(np.array(here))) * own.uniform(0.88, 1.12)
            organs += grow_frond(own, frond, _at(axis, here), twist + 2.4 * node, size, palette)
            if own.random() < cultivar.side_shoots:
                shoot = own.uniform(*cultivar.shoot_length)
                foot, turn = _at(axis, here), twist + 2.4 * node + own.normal(0, 0.3)
                organs += grow_shoot(own, vine, foot, turn, shoot, SHOOT_LEAF * size, palette, stem_color)
    return organs, tomatoes


def _youth(height: Array) -> Array:
    """Return the relative size of leaves at heights: those at the top are still growing."""
    return np.clip((WIRE_HEIGHT + 0.1 - height) / 0.4, 0.35, 1.0)


def _axes(rng: np.random.Generator, base: Array, radius: float, winding: float) -> tuple[Array, Array]:
    """Return the axes (k, 4) of a main stem and of its string, from the gutter to the wire."""
    heights = np.arange(GUTTER_HEIGHT, WIRE_HEIGHT + 0.01, 0.04)
    coarse = np.arange(GUTTER_HEIGHT, WIRE_HEIGHT + 0.05, 0.1)
    sway = np.cumsum(rng.normal(0, 0.008, (len(coarse), 2)), axis=0)
    sway -= np.outer(np.linspace(0, 1, len(coarse)), sway[-1])  # the string holds the top above the gutter
    path = base[:2] + np.column_stack([np.interp(heights, coarse, sway[:, k]) for k in range(2)])
    # the stem winds around its string about once in two trusses
    phase = rng.uniform(0, 2 * np.pi) + heights * 2 * np.pi / 0.5
    around = np.column_stack([np.cos(phase), np.sin(phase)])
    taper = radius * np.interp(heights, [GUTTER_HEIGHT, WIRE_HEIGHT], [1.0, 0.7])
    stem = np.column_stack([path + winding * around, heights, taper])
    string = path - (taper + 0.003)[:, None] * around
    return stem, np.column_stack([string, heights, np.full(len(heights), 0.001)])


def _at(axis: Array, height: float) -> Array:
    """Return point and radius (4,) of an axis (k, 4) at a height."""
    return np.array([np.interp(height, axis[:, 2], axis[:, k]) for k in range(4)])
