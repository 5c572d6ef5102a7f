"""Of which tomatoes a cloud holds skin."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.accuracy import skin_points
from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Ellipsoid, Sphere, rotation_about
from greenhouse_gym.geometry.point_clouds import Cloud

AXES = np.array([0.02, 0.02, 0.03])


def directions(count: int = 400, seed: int = 0) -> np.ndarray:
    unit = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(unit / np.linalg.norm(unit, axis=1, keepdims=True))


def cloud(points: np.ndarray, normals: np.ndarray) -> Cloud:
    return Cloud(points, np.full_like(points, 0.5), normals)


def test_skin_is_on_the_surface_and_faces_outwards() -> None:
    tomato, unit = Tomato(Sphere([0.5, 0.1, 1.2], 0.02), 0), directions()
    away = tomato.center + 0.02 * unit
    assert skin_points(cloud(away, unit), [tomato]).tolist() == [400]
    assert skin_points(cloud(away, -unit), [tomato]).tolist() == [0]
    assert skin_points(cloud(tomato.center + 0.024 * unit, unit), [tomato]).tolist() == [0]
    assert skin_points(cloud(tomato.center + 0.016 * unit, unit), [tomato]).tolist() == [0]
    assert skin_points(cloud(away[unit[:, 0] < 0], unit[unit[:, 0] < 0]), [tomato])[0] == (unit[:, 0] < 0).sum()


def test_the_skin_of_long_fruit_is_that_of_its_ellipsoid() -> None:
    turned = rotation_about([1.0, 0.0, 0.0], 0.7)
    tomato = Tomato(Ellipsoid([0.5, 0.1, 1.2], AXES, turned), 0, 0.5)
    unit = directions()
    normals = unit / AXES
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)) @ turned.T
    assert skin_points(cloud(tomato.center + (unit * AXES) @ turned.T, normals), [tomato]).tolist() == [400]
    ball = cloud(tomato.center + tomato.radius * unit, unit)
    assert 0 < skin_points(ball, [tomato])[0] < 400, "near the ends a ball of its size is inside of it"


def test_each_tomato_has_its_own_points_and_none_may_have_any() -> None:
    unit = directions()
    near, far = Tomato(Sphere([0.5, 0.0, 1.0], 0.02), 0), Tomato(Sphere([0.5, 0.5, 1.0], 0.02), 1)
    seen = cloud(near.center + 0.02 * unit, unit)
    assert skin_points(seen, [far, near]).tolist() == [0, 400]
    assert skin_points(seen, []).tolist() == []
    assert skin_points(cloud(np.zeros((0, 3)), np.zeros((0, 3))), [near]).tolist() == [0]
