"""Motion of plants since they were scanned: trusses turn and swing, stems and leaves shift.

The sizes are priors: a touch or a fan moves a truss that hangs by a peduncle of 3-4.5 mm by some degrees, a vine on its
string by about a centimetre, a leaf of 0.3 m by a few. Neighbors move together: stems and leaves follow smooth
displacement fields, and a truss moves rigidly about the point where it leaves the stem.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.crops.parts import Stem, Tomato, is_leaf
from greenhouse_gym.geometry import (
    Array,
    Box,
    Capsule,
    Ellipsoid,
    Sphere,
    centered_at,
    distance_to_capsules,
    distance_to_spheres,
    rotation_about,
)
from greenhouse_gym.scene.obstacles import Shapes

_WAVELENGTHS = (0.4, 1.2)  # range of the wavelengths of the displacement fields, metres
_WAVES = 6

Field = Callable[[Array], Array]


def move_plants(shapes: Shapes, motion: PlantMotion, rng: np.random.Generator) -> Shapes:
    """Move plants; pipes and gutters stay, and tomatoes keep their order.

    Args:
        shapes: The plants before they move.
        motion: Size of the motion.
        rng: Source of all randomness.
    """
    stem_field = _smooth_field(motion.stem_shift * np.array([1.0, 1.0, 0.0]), rng)
    leaf_field = _smooth_field(motion.leaf_shift * np.ones(3), rng)
    stems = list(shapes.stems)
    hanging = [k for k, stem in enumerate(stems) if stem.kind in ("peduncle", "pedicel")]
    trusses = sorted({tomato.truss for tomato in shapes.tomatoes})
    rotations = {truss: _sample_rotation(motion, rng) for truss in trusses}
    owners = dict(zip(hanging, nearest_truss([stems[k] for k in hanging], shapes.tomatoes), strict=True))
    roots = {
        truss: _root([stems[k] for k in hanging if owners[k] == truss], stems, shapes.tomatoes, truss)
        for truss in trusses
    }

    def with_truss(truss: int) -> Field:
        root, rotation = roots[truss], rotations[truss]
        shifted = root + stem_field(root[None])[0]
        return lambda points: (points - root) @ rotation.T + shifted

    def with_stem(points: Array) -> Array:
        return points + stem_field(points)

    def with_leaf(points: Array) -> Array:
        return points + stem_field(points) + leaf_field(points)

    def move_stem(k: int, stem: Stem) -> Stem:
        if stem.kind == "pipe":
            return stem
        field = with_truss(owners[k]) if k in owners else with_stem
        start, end = field(np.array([stem.start, stem.end]))
        return replace(stem, start=start, end=end)

    return Shapes(
        tomatoes=tuple(_move_tomato(t, with_truss(t.truss), rotations[t.truss]) for t in shapes.tomatoes),
        stems=tuple(move_stem(k, stem) for k, stem in enumerate(stems)),
        clutter=_move_leaves(shapes.clutter, with_leaf),
    )


def _smooth_field(size: Array, rng: np.random.Generator) -> Field:
    """Sample a displacement field: a sum of waves in random directions with standard deviations ``size`` (3,)."""
    directions = rng.normal(size=(_WAVES, 3))
    lengths = rng.uniform(*_WAVELENGTHS, _WAVES)
    waves = 2 * np.pi * directions / np.linalg.norm(directions, axis=1, keepdims=True) / lengths[:, None]
    phases = rng.uniform(0, 2 * np.pi, (_WAVES, 3))
    scale = size * np.sqrt(2.0 / _WAVES)
    return lambda points: (np.cos((points @ waves.T)[:, :, None] + phases) * scale).sum(axis=1)


def _sample_rotation(motion: PlantMotion, rng: np.random.Generator) -> Array:
    about, across = motion.truss_turn * rng.normal(), motion.truss_swing * rng.normal(size=2)
    angle = float(np.linalg.norm(across))
    swing = rotation_about([*across, 0.0], angle) if angle > 0 else np.eye(3)
    return np.asarray(swing @ rotation_about([0.0, 0.0, 1.0], float(about)))


def nearest_truss(stems: list[Stem], tomatoes: tuple[Tomato, ...]) -> list[int]:
    """Return the truss of the tomato nearest to the middle of each stem, or -1 without tomatoes."""
    if not stems or not tomatoes:
        return [-1] * len(stems)
    middles = np.array([(stem.start + stem.end) / 2 for stem in stems])
    gaps = distance_to_spheres(middles, [t.center for t in tomatoes], [t.radius for t in tomatoes])
    return [tomatoes[k].truss for k in gaps.argmin(axis=1)]


def _root(own: list[Stem], stems: list[Stem], tomatoes: tuple[Tomato, ...], truss: int) -> Array:
    """Return the root (3,) of a truss: the end of its stems nearest to a main stem, else a point above its fruit."""
    main = [stem for stem in stems if stem.kind == "main"]
    ends = np.array([end for stem in own for end in (stem.start, stem.end)]).reshape(-1, 3)
    if not len(ends):
        centers = np.array([t.center for t in tomatoes if t.truss == truss])
        return np.asarray([*centers[:, :2].mean(axis=0), centers[:, 2].max() + 0.05])
    if not main:
        return np.asarray(ends[ends[:, 2].argmax()])
    main_starts, main_ends = np.array([s.start for s in main]), np.array([s.end for s in main])
    gaps = distance_to_capsules(ends, main_starts, main_ends, np.array([s.radius for s in main])).min(axis=1)
    return np.asarray(ends[gaps.argmin()])


def _move_tomato(tomato: Tomato, field: Field, rotation: Array) -> Tomato:
    center = field(tomato.center[None])[0]
    if isinstance(tomato.shape, Ellipsoid):
        return replace(tomato, shape=replace(tomato.shape, center=center, rotation=rotation @ tomato.shape.rotation))
    return replace(tomato, shape=replace(tomato.shape, center=center))


def _move_leaves(shapes: Sequence[Sphere | Capsule | Box], field: Field) -> tuple[Sphere | Capsule | Box, ...]:
    """Move leaves, which may be thousands, with one evaluation of the field."""
    ends = np.array([[s.start, s.end] if isinstance(s, Capsule) else [s.center, s.center] for s in shapes])
    ends_after = field(ends.reshape(-1, 3)).reshape(-1, 2, 3)

    def move(shape: Sphere | Capsule | Box, start: Array, end: Array) -> Sphere | Capsule | Box:
        if not is_leaf(shape):
            return shape
        return replace(shape, start=start, end=end) if isinstance(shape, Capsule) else centered_at(shape, start)

    return tuple(move(shape, *after) for shape, after in zip(shapes, ends_after, strict=True))
