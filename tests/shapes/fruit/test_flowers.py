"""Petals are recognized by their color; yellow fruit differs from flowers by its shape."""

from __future__ import annotations

import numpy as np
from shape_clouds import RED, half_sphere, together

from greenhouse_gym.crops import Palette
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.geometry.point_clouds import Cloud, voxel_means
from greenhouse_gym.shapes.fruit.detection import find_flowers, flower_mask, petal_mask
from greenhouse_gym.shapes.surface_cloud import SurfaceCloud, measure_surface

PETAL = np.array([0.9, 0.82, 0.06])


def flower(center: tuple[float, float, float], seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Six thin petals around a center, each bent its own way."""
    rng = np.random.default_rng(seed)
    parts = []
    for angle in np.arange(6) * np.pi / 3:
        along = np.array([rng.uniform(-0.8, 0.8), np.cos(angle), np.sin(angle)])
        along /= np.linalg.norm(along)
        across = np.cross(along, [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        where = rng.uniform([0.002, -0.003], [0.013, 0.003], (150, 2))
        points = np.array(center) + where @ np.stack([along, across]) + rng.normal(0, 0.0005, (150, 3))
        normal = np.cross(along, across)
        parts.append((points, np.tile(PETAL, (150, 1)), np.tile(-np.sign(normal[0]) * normal, (150, 1))))
    return together(*parts)


def surface_of(*parts: tuple[np.ndarray, np.ndarray, np.ndarray]) -> SurfaceCloud:
    return measure_surface(voxel_means(Cloud(*together(*parts)), 0.003)[0])


def test_neither_leaves_nor_fruit_have_the_color_of_petals() -> None:
    palette = Palette()
    assert not petal_mask(np.array([*palette.fruit, palette.leaf, *palette.stems.values(), (0.0, 0.0, 0.0)])).any()
    assert petal_mask(np.array([PETAL, 0.5 * PETAL, [0.96, 0.85, 0.16]])).all()


def test_a_sphere_on_petals_is_a_flower_and_yellow_fruit_is_none() -> None:
    yellow = half_sphere((0.5, 0.3, 1.1), 0.015, 1, 0.0005, PETAL)
    surface = surface_of(flower((0.5, 0.1, 1.1)), half_sphere((0.5, 0.2, 1.1), 0.03), yellow)
    spheres = [Sphere([0.5, 0.1, 1.1], 0.014), Sphere([0.5, 0.2, 1.1], 0.03), Sphere([0.5, 0.3, 1.1], 0.015)]
    np.testing.assert_array_equal(flower_mask(spheres, surface), [True, False, False])
    assert flower_mask([], surface).shape == (0,)


def test_each_flower_is_found_once_and_fruit_is_none() -> None:
    centers = [(0.5, 0.10, 1.1), (0.5, 0.13, 1.1), (0.48, 0.30, 1.2)]
    yellow = half_sphere((0.5, 0.2, 1.1), 0.015, 1, 0.0005, PETAL)
    surface = surface_of(*(flower(c, k) for k, c in enumerate(centers)), yellow, half_sphere((0.5, 0.4, 1.1), 0.03))
    found = find_flowers(surface, [Sphere([0.5, 0.2, 1.1], 0.015)])
    assert len(found) == 3
    for center in centers:
        assert min(np.linalg.norm(ball.center - center) for ball in found) < 0.004
    assert find_flowers(surface_of(half_sphere((0.5, 0.4, 1.1), 0.03, color=RED)), []) == ()
