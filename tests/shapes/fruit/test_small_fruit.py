"""The third pass: fruit of a few millimetres, as green as leaves, and leaves without fruit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greenhouse_gym.geometry.point_clouds import Cloud
from greenhouse_gym.shapes import ShapeSettings, extract_shapes
from greenhouse_gym.shapes.fruit.detection import Fruit, without_bumps
from greenhouse_gym.shapes.fruit.large_fruit import ScoredFruit
from greenhouse_gym.shapes.fruit.small_fruit import find_small, small_spheres
from greenhouse_gym.shapes.fruit.spheres import SphereFit
from greenhouse_gym.shapes.networks import network
from greenhouse_gym.shapes.surface_cloud import measure_surface, transfer_surface

SETTINGS = ShapeSettings()
GREEN = np.array([0.40, 0.49, 0.26])
NOTHING = ScoredFruit([], np.zeros(0), np.zeros(0))


def ball(center: tuple[float, float, float], radius: float, seed: int = 0) -> Cloud:
    """The side of a ball that faces the aisle, a point per 2 mm square, with half a millimetre of noise."""
    random = np.random.default_rng(seed)
    unit = random.normal(size=(int(4 * np.pi * radius**2 / 0.002**2), 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    unit = unit[unit[:, 0] < 0]
    points = center + (radius + random.normal(0, 0.0005, (len(unit), 1))) * unit
    return Cloud(points, np.tile(GREEN, (len(unit), 1)), unit)


def leaf(curvature: float, seed: int = 0) -> Cloud:
    """A green sheet of 30 by 30 cm behind everything, with a curvature in 1/m about an upright axis."""
    random = np.random.default_rng(seed)
    y, z = random.uniform(-0.15, 0.15, (2, 22_500))
    points = np.column_stack([0.55 + 0.5 * curvature * y**2 + random.normal(0, 0.0005, len(y)), y, 1.1 + z])
    normals = np.column_stack([-np.ones(len(y)), curvature * y, np.zeros(len(y))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(points, np.tile(GREEN, (len(y), 1)), normals)


def merged(*clouds: Cloud) -> Cloud:
    return Cloud(*(np.concatenate([getattr(c, name) for c in clouds]) for name in ("points", "colors", "normals")))


@pytest.mark.parametrize("radius", [0.0045, 0.006, 0.008, 0.011])
def test_small_balls_of_the_leaves_color_are_found(radius: float) -> None:
    centers = [(0.45, 0.035 * k, 1.0 + 0.02 * k) for k in range(3)]
    cloud = merged(leaf(0.0), *(ball(center, radius, k) for k, center in enumerate(centers)))
    found = extract_shapes(cloud.points, cloud.colors, cloud.normals).tomatoes
    assert len(found) == 3
    for center in centers:
        assert min(np.linalg.norm(tomato.center - center) for tomato in found) < 0.3 * radius
    assert [tomato.radius for tomato in found] == pytest.approx(3 * [radius], rel=0.25)
    assert all(tomato.ripeness < 0.2 for tomato in found)


@pytest.mark.parametrize("curvature", [0.0, 8.0, 25.0])
def test_a_leaf_has_no_small_fruit(curvature: float) -> None:
    sheet = leaf(curvature)
    assert extract_shapes(sheet.points, sheet.colors, sheet.normals).tomatoes == ()


def test_small_balls_are_fruit_only_next_to_leaves_or_larger_fruit() -> None:
    alone = ball((0.45, 0.0, 1.1), 0.0045)
    assert extract_shapes(alone.points, alone.colors, alone.normals).tomatoes == ()


def test_the_third_pass_can_be_skipped() -> None:
    cloud = merged(leaf(0.0), ball((0.45, 0.0, 1.1), 0.0045))
    arrays = (cloud.points, cloud.colors, cloud.normals)
    assert len(extract_shapes(*arrays).tomatoes) == 1
    assert extract_shapes(*arrays, ShapeSettings(small_radii=None)).tomatoes == ()


def test_points_of_larger_fruit_are_no_small_fruit() -> None:
    surface = measure_surface(merged(leaf(0.0), ball((0.45, 0.0, 1.1), 0.011)))
    small = small_spheres(surface, SETTINGS)
    assert small.fits, "there are small spheres to score"
    confident = find_small(surface, NOTHING, SETTINGS, lambda features: np.ones(len(features)))
    assert confident.fits
    again = find_small(surface, confident, SETTINGS, lambda features: np.ones(len(features)))
    assert not again.fits, "nothing is found twice"
    assert not find_small(surface, NOTHING, SETTINGS, lambda features: np.zeros(len(features))).fits


def test_a_finer_cloud_takes_over_surface_measures() -> None:
    cloud = merged(leaf(0.0), ball((0.45, 0.0, 1.1), 0.008))
    surface = measure_surface(cloud.select(np.arange(0, len(cloud), 3)))
    outliers = replace(cloud, points=cloud.points + [5.0, 0.0, 0.0])
    fine = transfer_surface(surface, merged(replace(cloud, normals=0 * cloud.normals), outliers), SETTINGS)
    assert 0.9 * len(cloud) < len(fine) <= len(cloud), "points far from the surface are left out"
    assert fine.leaf_hue == surface.leaf_hue
    np.testing.assert_allclose(np.linalg.norm(fine.normals, axis=1), 1.0, atol=1e-9)
    empty = surface.select(np.zeros(0, dtype=np.int64))
    assert len(transfer_surface(empty, cloud, SETTINGS)) == 0


@pytest.mark.parametrize("name", ["fruit/small_fruit", "stems/peduncles"])
def test_shipped_networks_return_probabilities(name: str) -> None:
    classifier = network(name)
    scores = classifier(np.random.default_rng(0).normal(0, 100.0, (50, len(classifier.center))))
    assert scores.shape == (50,)
    assert np.isfinite(scores).all()
    assert (scores >= 0).all()
    assert (scores <= 1).all()


def bumps(confidence: float, count: int = 8, ripeness: float = 0.0) -> list[Fruit]:
    empty = np.zeros(0, dtype=np.int64)
    centers = np.column_stack([np.full(count, 0.5), 0.2 * np.arange(count), np.full(count, 1.1)])
    return [Fruit(SphereFit(center, 0.008, empty, 0.3, 0.0, 0.9), confidence, ripeness) for center in centers]


def test_small_green_fruit_needs_a_row_that_shows_some() -> None:
    assert without_bumps(bumps(0.55), SETTINGS) == []
    for shown in (bumps(0.9), bumps(0.55, count=3), bumps(0.55, ripeness=1.0), []):
        assert without_bumps(shown, SETTINGS) == shown


def test_doubtful_small_fruit_next_to_a_sure_one_is_kept() -> None:
    doubtful, sure = bumps(0.55), Fruit(replace(bumps(0.9)[0].sphere, center=np.array([0.5, 0.05, 1.1])), 0.9, 1.0)
    assert without_bumps([*doubtful, sure], SETTINGS) == [doubtful[0], sure]
