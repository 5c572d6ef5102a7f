"""New stands for training, composed of plants of reconstructed scenes: exchanged, mirrored, turned and shifted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.crops.parts import Stem, Tomato, is_leaf
from greenhouse_gym.crops.shape_tables import ShapeParts
from greenhouse_gym.geometry import Array, Box, Capsule, Sphere, distance_to_capsules, pose, rotation_about
from greenhouse_gym.geometry.shapes import AnyShape, mirrored, transformed
from greenhouse_gym.scene.obstacles import Shapes
from greenhouse_gym.scene.plant_motion import move_plants, nearest_truss
from greenhouse_gym.scene.scene import Provenance, Scene
from greenhouse_gym.scene.workspace import REACH, keep_nearest, within_reach

HALF_WIDTH = 0.8
"""Half width of a scene along the row, metres."""

ROOM = 0.35
"""Half width along the row that a plant takes; plants nearer to the end of a scene are incomplete, metres."""

TURN, SHIFT = 0.25, 0.02
"""Largest turn of a plant about its stem, radians, and standard deviation of its foot along x, metres."""

_SAME_PLANT = 0.2  # distance along the row below which two stems belong to one plant, metres
_SPACING = 0.5  # between plants beyond those of the scene, metres


Plant: TypeAlias = tuple[Array, Shapes]
"""Foot (2,) of a plant's stem, x and y, metres, and its shapes."""


def composed_scene(
    base: Scene, draw: Callable[[], Plant], rng: np.random.Generator, name: str, max_shapes: int
) -> Scene:
    """Compose a stand: the placement, fixtures and spacing of a scene, with plants of others.

    The row is shifted along y, each plant is mirrored at random, turned and shifted, and all plants move a little.
    Pipes, gutters and the arm stay where they are. The result has no targets, truth or occupancy grid.

    Args:
        base: Scene of the stand.
        draw: Function that draws a plant of the same kind.
        rng: Source of all randomness.
        name: Name of the new scene.
        max_shapes: Maximum number of shapes; the farthest are left out, as from scanned rows.
    """
    feet = np.array([foot for foot, _ in _stands(base)])
    if not len(feet):
        feet = np.array([[0.6, 0.0]])
    shift = rng.uniform(-_SPACING / 2, _SPACING / 2)
    slots = [*feet]
    while slots[0][1] + shift > -HALF_WIDTH - ROOM:
        slots.insert(0, slots[0] - [0.0, _SPACING])
    while slots[-1][1] + shift < HALF_WIDTH + ROOM:
        slots.append(slots[-1] + [0.0, _SPACING])
    grown = [_placed(foot + [SHIFT * rng.normal(), shift], draw(), rng) for foot in slots]
    trusses = np.cumsum([0, *(1 + max((t.truss for t in plant.tomatoes), default=-1) for plant in grown)])
    whole = Shapes(
        tomatoes=tuple(
            replace(tomato, truss=tomato.truss + int(first))
            for plant, first in zip(grown, trusses, strict=False)
            for tomato in plant.tomatoes
            if _inside(tomato.shape)
        ),
        stems=(
            *(stem for stem in base.stems if stem.kind == "pipe"),
            *(stem for plant in grown for stem in plant.stems if _inside(stem)),
        ),
        clutter=(
            *(piece for piece in base.clutter if not is_leaf(piece)),
            *(piece for plant in grown for piece in plant.clutter if _inside(piece)),
        ),
    )
    moved = move_plants(whole, PlantMotion(), rng)
    near = within_reach(ShapeParts(moved.tomatoes, moved.stems, moved.clutter), REACH)
    origin = base.provenance
    provenance = Provenance(row=name, style=origin.style, source=origin.source, protocol=origin.protocol)
    kept = keep_nearest(near, max_shapes)
    return Scene(name=name, placement=base.placement, provenance=provenance, **kept._asdict())


def plants_of(scene: Scene) -> list[Plant]:
    """Return the complete plants of a scene."""
    return [(foot, plant) for foot, plant in _stands(scene) if abs(foot[1]) <= HALF_WIDTH - ROOM]


def _stands(scene: Scene) -> list[Plant]:
    """Return all plants of a scene along the row; each shape but the fixtures belongs to the nearest stem."""
    stems = sorted((stem for stem in scene.stems if stem.kind == "main"), key=_along_row)
    if not stems:
        return []
    along = np.array([_along_row(stem) for stem in stems])
    owner = np.concatenate([[0], np.cumsum(np.diff(along) > _SAME_PLANT)])
    starts, ends = (np.array([getattr(stem, side) for stem in stems]) for side in ("start", "end"))

    def nearest(shapes: Sequence[AnyShape]) -> Array:
        points = np.array([_center(shape) for shape in shapes]).reshape(-1, 3)
        return owner[distance_to_capsules(points, starts, ends, np.zeros(len(stems))).argmin(axis=1)]

    hanging = [stem for stem in scene.stems if stem.kind in ("peduncle", "pedicel")]
    others = [stem for stem in scene.stems if stem.kind not in ("peduncle", "pedicel", "pipe")]
    leaves = [piece for piece in scene.clutter if is_leaf(piece)]
    of_tomato = nearest([tomato.shape for tomato in scene.tomatoes])
    # a truss hangs on one plant, that of most of its tomatoes
    of_truss = {
        truss: int(
            np.bincount([k for k, t in zip(of_tomato, scene.tomatoes, strict=True) if t.truss == truss]).argmax()
        )
        for truss in {tomato.truss for tomato in scene.tomatoes}
    }
    owners = [of_truss.get(truss, 0) for truss in nearest_truss(hanging, scene.tomatoes)]
    of_other, of_leaf = nearest(others), nearest(leaves)
    result = []
    for k in range(int(owner[-1]) + 1):
        own = (starts[owner == k] + ends[owner == k]) / 2
        plant = Shapes(
            tomatoes=tuple(t for t in scene.tomatoes if of_truss[t.truss] == k),
            stems=(
                *(stem for stem, o in zip(others, of_other, strict=True) if o == k),
                *(stem for stem, o in zip(hanging, owners, strict=True) if o == k),
            ),
            clutter=tuple(piece for piece, o in zip(leaves, of_leaf, strict=True) if o == k),
        )
        result.append((own[:, :2].mean(axis=0), plant))
    return result


def _placed(foot: Array, plant: Plant, rng: np.random.Generator) -> Shapes:
    """Return a plant at another foot, mirrored at random and turned about its stem."""
    old, shapes = plant
    flip = np.array([1.0, rng.choice([-1.0, 1.0]), 1.0])
    turned = pose(rotation_about([0.0, 0.0, 1.0], float(rng.uniform(-TURN, TURN))), [*foot, 0.0])
    back = -flip * [*old, 0.0]

    def place(shape: AnyShape) -> AnyShape:
        return transformed(mirrored(shape, flip, back), turned)

    tomatoes: tuple[Tomato, ...] = tuple(replace(t, shape=place(t.shape)) for t in shapes.tomatoes)
    stems: tuple[Stem, ...] = tuple(map(place, shapes.stems))
    clutter: tuple[Sphere | Capsule | Box, ...] = tuple(map(place, shapes.clutter))
    return Shapes(tomatoes=tomatoes, stems=stems, clutter=clutter)


def _center(shape: AnyShape) -> Array:
    return (shape.start + shape.end) / 2 if isinstance(shape, Capsule) else shape.center


def _along_row(shape: AnyShape) -> float:
    return float(_center(shape)[1])


def _inside(shape: AnyShape) -> bool:
    return abs(_along_row(shape)) <= HALF_WIDTH
