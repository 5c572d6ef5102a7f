"""The third look: fruit of a few millimetres, as green as its leaves, among leaves that are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greenhouse_gym.reconstruction.point_clouds import Cloud
from greenhouse_gym.shapes import ShapeSettings, extract_shapes
from greenhouse_gym.shapes.networks import network
from greenhouse_gym.shapes.small_fruit import Credited, find_small, small_spheres
from greenhouse_gym.shapes.surfaces import look_at_surfaces, looked_at_finer

SETTINGS = ShapeSettings()
GREEN = np.array([0.40, 0.49, 0.26])
NOTHING = Credited([], np.zeros(0), np.zeros(0))


def ball(center: tuple[float, float, float], radius: float, seed: int = 0) -> Cloud:
    """The side of a ball that faces the aisle, a point per 2 mm square, with half a millimetre of noise."""
    random = np.random.default_rng(seed)
    unit = random.normal(size=(int(4 * np.pi * radius**2 / 0.002**2), 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    unit = unit[unit[:, 0] < 0]
    points = center + (radius + random.normal(0, 0.0005, (len(unit), 1))) * unit
    return Cloud(points, np.tile(GREEN, (len(unit), 1)), unit)


def leaf(bend: float, seed: int = 0) -> Cloud:
    """A green sheet of 30 by 30 cm behind everything, bent about an upright axis by so much, 1/m."""
    random = np.random.default_rng(seed)
    y, z = random.uniform(-0.15, 0.15, (2, 22_500))
    points = np.column_stack([0.55 + 0.5 * bend * y**2 + random.normal(0, 0.0005, len(y)), y, 1.1 + z])
    normals = np.column_stack([-np.ones(len(y)), bend * y, np.zeros(len(y))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(points, np.tile(GREEN, (len(y), 1)), normals)


def merged(*clouds: Cloud) -> Cloud:
    return Cloud(*(np.concatenate([getattr(c, name) for c in clouds]) for name in ("points", "colors", "normals")))


@pytest.mark.parametrize("radius", [0.0045, 0.006, 0.008, 0.011])
def test_small_balls_of_the_leaves_color_are_found(radius: float) -> None:
    places = [(0.45, 0.035 * k, 1.0 + 0.02 * k) for k in range(3)]
    cloud = merged(leaf(0.0), *(ball(place, radius, k) for k, place in enumerate(places)))
    found = extract_shapes(cloud.points, cloud.colors, cloud.normals).tomatoes
    assert len(found) == 3
    for place in places:
        assert min(np.linalg.norm(tomato.center - place) for tomato in found) < 0.3 * radius
    assert [tomato.radius for tomato in found] == pytest.approx(3 * [radius], rel=0.25)
    assert all(tomato.ripeness < 0.2 for tomato in found)


@pytest.mark.parametrize("bend", [0.0, 8.0, 25.0])
def test_a_leaf_bears_no_small_fruit(bend: float) -> None:
    sheet = leaf(bend)
    assert extract_shapes(sheet.points, sheet.colors, sheet.normals).tomatoes == ()


def test_small_round_things_are_fruit_beside_leaves_or_larger_fruit_only() -> None:
    alone = ball((0.45, 0.0, 1.1), 0.0045)
    assert extract_shapes(alone.points, alone.colors, alone.normals).tomatoes == ()


def test_small_fruit_need_not_be_looked_for() -> None:
    cloud = merged(leaf(0.0), ball((0.45, 0.0, 1.1), 0.0045))
    arrays = (cloud.points, cloud.colors, cloud.normals)
    assert len(extract_shapes(*arrays).tomatoes) == 1
    assert extract_shapes(*arrays, ShapeSettings(small_radii=None)).tomatoes == ()


def test_what_larger_fruit_explains_is_no_small_fruit() -> None:
    surface = look_at_surfaces(merged(leaf(0.0), ball((0.45, 0.0, 1.1), 0.011)), SETTINGS)
    small = small_spheres(surface, SETTINGS)
    assert small.fits, "there are small spheres to judge"
    sure = find_small(surface, NOTHING, SETTINGS, lambda measures: np.ones(len(measures)))
    assert sure.fits
    again = find_small(surface, sure, SETTINGS, lambda measures: np.ones(len(measures)))
    assert not again.fits, "what was found is not found once more"
    assert not find_small(surface, NOTHING, SETTINGS, lambda measures: np.zeros(len(measures))).fits


def test_a_finer_cloud_takes_over_what_its_surface_knows() -> None:
    cloud = merged(leaf(0.0), ball((0.45, 0.0, 1.1), 0.008))
    surface = look_at_surfaces(cloud.select(np.arange(0, len(cloud), 3)), SETTINGS)
    stray = replace(cloud, points=cloud.points + [5.0, 0.0, 0.0])
    fine = looked_at_finer(surface, merged(replace(cloud, normals=0 * cloud.normals), stray), SETTINGS)
    assert 0.9 * len(cloud) < len(fine) <= len(cloud), "points far from the surface are left out"
    assert fine.leaf == surface.leaf
    np.testing.assert_allclose(np.linalg.norm(fine.normals, axis=1), 1.0, atol=1e-9)
    empty = surface.select(np.zeros(0, dtype=np.int64))
    assert len(looked_at_finer(empty, cloud, SETTINGS)) == 0


@pytest.mark.parametrize("name", ["small_fruit", "peduncles"])
def test_networks_are_shipped_and_tell_probabilities(name: str) -> None:
    judge = network(name)
    said = judge(np.random.default_rng(0).normal(0, 100.0, (50, len(judge.center))))
    assert said.shape == (50,)
    assert np.isfinite(said).all()
    assert (said >= 0).all()
    assert (said <= 1).all()
