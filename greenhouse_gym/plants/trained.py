"""Hang the organs of Helios' vines along strings: a high-wire row as meshes, week by week.

Helios grows the organs; what a grower decides is decided here: which leaves are off, how high which truss hangs, how
many fruits it bears. A vine is lowered by one truss a week, so in week w every truss hangs one spacing lower and is a
week older than in week w - 1; plants, trusses and fruits keep their numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count

import numpy as np

from greenhouse_gym.crop import Tomato
from greenhouse_gym.geometry import Array
from greenhouse_gym.plants.cultivars import Cultivar
from greenhouse_gym.plants.foliage import grow_frond, leaf_palette
from greenhouse_gym.plants.fruiting import grow_mesh_truss
from greenhouse_gym.plants.helios import Vine, grow_vine
from greenhouse_gym.plants.organs import Organ, OrganKind, stems_of, tube
from greenhouse_gym.plants.plant_row import (
    GUTTER_HEIGHT,
    HIGHEST_TRUSS,
    LOWEST_TRUSS,
    PLANT_SPACING,
    ROW_PITCH,
    TRUSS_SPACING,
    WIRE_HEIGHT,
    PlantRow,
)

VINES = 3
"""Vines that Helios grows for a row; every plant takes its organs from one of them, each placed and sized anew."""

_STEM_COLOR = (0.42, 0.52, 0.27)
_STRING_COLOR = (0.85, 0.84, 0.78)
_PIPE_COLOR = (0.80, 0.80, 0.80)
_GUTTER_COLOR = (0.90, 0.90, 0.88)


@dataclass(frozen=True)
class _Crop:
    """What all plants of a row share."""

    seed: int
    week: int
    cultivar: Cultivar
    vines: tuple[Vine, ...]
    aspect: float
    leaf_redness: float


def grow_mesh_row(seed: int, length: float, week: int, cultivar: Cultivar, stem_line: float) -> PlantRow:
    """Grow a row of Helios plants with a second row behind it.

    Args:
        seed: Same seed, same plants; over the weeks the same plants grow on.
        length: Length of row to be photographed, metres; plants stand half a metre beyond both ends.
        week: Growth week, 0 = first harvest.
        cultivar: How the plants grow.
        stem_line: x of the row, metres.

    Raises:
        MissingDependencyError: PyHelios is missing, or not the version that was tried.
        GrowthError: The vines bear no fruit.
    """
    rng = np.random.default_rng([seed, 7])
    vines = tuple(grow_vine(int(rng.integers(1, 2**31)), cultivar.model) for _ in range(VINES))
    crop = _Crop(seed, week, cultivar, vines, rng.uniform(*cultivar.aspect), rng.uniform(*cultivar.leaf_redness))
    front = _grow_line(crop, 0, length, stem_line)
    back = _grow_line(crop, 1, length, stem_line + ROW_PITCH)
    return PlantRow(front.tomatoes, front.stems, (), length, week, back, front.organs)


def _grow_line(crop: _Crop, line: int, length: float, x: float) -> PlantRow:
    rng = np.random.default_rng([crop.seed, line])
    organs: list[Organ] = []
    tomatoes: list[Tomato] = []
    y = -0.5 + rng.uniform(0, 0.2)
    for plant in count():
        if y > length + 0.5:
            break
        base = np.array([x + rng.uniform(-0.03, 0.03), y, GUTTER_HEIGHT])
        grown, fruits = _grow_plant(crop, [crop.seed, line, plant], base, plant, len(tomatoes))
        organs += grown
        tomatoes += fruits
        y += rng.uniform(*PLANT_SPACING)
    organs += _fixtures(x, length)
    return PlantRow(tuple(tomatoes), stems_of(organs), (), length, crop.week, None, tuple(organs))


def _fixtures(x: float, length: float) -> list[Organ]:
    """The gutter and two pipe rails in front of the row."""
    low, high = -0.8, length + 0.8
    organs = []
    for beside in (0.32, 0.82):
        axis = np.array([[x - beside, low, 0.06, 0.0255], [x - beside, high, 0.06, 0.0255]])
        organs.append(tube_organ("pipe", axis, _PIPE_COLOR, around=16))
    corners = np.array([[i, j, k] for i in (-0.11, 0.11) for j in (low, high) for k in (-0.1, 0.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    vertices = corners + [x, 0.0, GUTTER_HEIGHT]
    return [*organs, Organ("gutter", vertices, triangles, np.tile(_GUTTER_COLOR, (12, 1)))]


def tube_organ(
    kind: OrganKind,
    axis: Array,
    color: Array | tuple[float, float, float],
    plant: int = -1,
    truss: int | None = None,
    around: int = 8,
) -> Organ:
    """An organ that is a tube along an axis (k, 4) of points and radii, in one color (3,)."""
    vertices, triangles = tube(axis, around)
    return Organ(kind, vertices, triangles, np.tile(color, (len(triangles), 1)), plant, truss, None, axis)


def _grow_plant(
    crop: _Crop, seed: list[int], base: Array, plant: int, first_fruit: int
) -> tuple[list[Organ], list[Tomato]]:
    """One plant's organs, and its tomatoes, the first of which is number ``first_fruit`` of the row."""
    rng = np.random.default_rng(seed)
    cultivar, vine = crop.cultivar, crop.vines[seed[2] % len(crop.vines)]
    spacing = rng.uniform(*TRUSS_SPACING)
    radius = rng.uniform(*cultivar.stem_radius)
    axis, string = _axes(rng, base, radius, cultivar.winding)
    organs = [
        tube_organ("main", axis, np.array(_STEM_COLOR) * rng.uniform(0.9, 1.1), plant, around=12),
        tube_organ("string", string, _STRING_COLOR, plant, around=5),
    ]
    tomatoes: list[Tomato] = []
    offset, twist, handle = rng.uniform(0, spacing), rng.uniform(0, 2 * np.pi), int(rng.integers(0, 1000))
    flowering = rng.uniform(*cultivar.flowering)
    palette = leaf_palette(rng, crop.leaf_redness)
    for j in range(crop.week, crop.week + int((HIGHEST_TRUSS - LOWEST_TRUSS) / spacing) + 2):
        own = np.random.default_rng([*seed, j])
        height = LOWEST_TRUSS + offset + (j - crop.week) * spacing
        if height > HIGHEST_TRUSS:
            break
        # pickers turn trusses to the aisle
        azimuth = np.pi + own.normal(0, 0.7)
        grown, fruits = grow_mesh_truss(
            np.random.default_rng([*seed, j, 1]),
            vine,
            cultivar,
            crop.aspect,
            _at(axis, height),
            azimuth,
            (flowering - height) / (flowering - 0.75),
            plant,
            100 * plant + j,
            first_fruit + len(tomatoes),
        )
        organs += grown
        tomatoes += fruits
        for leaf in range(3):
            leaf_height = height + (leaf + 0.5) * spacing / 3
            node_rng = np.random.default_rng([*seed, j, 2 + leaf])
            if max(cultivar.bare_below, LOWEST_TRUSS) < leaf_height < WIRE_HEIGHT - 0.1:
                frond = vine.fronds[(handle + 3 * j + leaf) % len(vine.fronds)]
                young = float(np.clip((WIRE_HEIGHT + 0.1 - leaf_height) / 0.4, 0.35, 1.0))
                size = young * node_rng.uniform(*cultivar.leaf_scale)
                turn = twist + 2.4 * (3 * j + leaf)
                organs += grow_frond(node_rng, frond, _at(axis, leaf_height), turn, size, palette, plant)
    return organs, tomatoes


def _axes(rng: np.random.Generator, base: Array, radius: float, winding: float) -> tuple[Array, Array]:
    """The axes (k, 4) of a main stem, and of the string it winds around, from the gutter to the wire."""
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
    beside = path - (taper + 0.003)[:, None] * around
    return stem, np.column_stack([beside, heights, np.full(len(heights), 0.001)])


def _at(axis: Array, height: float) -> Array:
    """Point and radius (4,) of an axis (k, 4) at a height."""
    return np.array([np.interp(height, axis[:, 2], axis[:, k]) for k in range(4)])
