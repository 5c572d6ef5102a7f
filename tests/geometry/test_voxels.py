"""Cells of points and rays, held against the same rule in NumPy, and distances to shapes beyond a chunk of points."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.geometry import Box, Capsule, Sphere, distance_to_nearest, distance_to_shapes, rotation_about
from greenhouse_gym.geometry.voxels import cells_of, passed_cells

LOW, SHAPE, CELL = np.array([-0.4, 0.1, -0.8]), (7, 4, 11), 0.13


def expected_cells(points: np.ndarray) -> np.ndarray:
    cells = np.floor((points - LOW) / CELL)
    inside = ((cells >= 0) & (cells < SHAPE)).all(axis=1)
    x, y, z = np.where(inside[:, None], cells, 0).astype(int).T
    return np.where(inside, (x * SHAPE[1] + y) * SHAPE[2] + z, -1)


def test_points_lie_in_the_cells_of_the_rule() -> None:
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (5_000, 3))
    corners = LOW + CELL * np.indices((8, 5, 12)).reshape(3, -1).T
    strange = np.array([[np.nan, 0.2, 0.0], [np.inf, 0.2, 0.0], [0.0, -np.inf, 0.0], [1e300, 0.2, 0.0]])
    for each in (points, corners, strange, np.zeros((0, 3))):
        with np.errstate(invalid="ignore"):
            assert np.array_equal(cells_of(each, LOW, SHAPE, CELL), expected_cells(each))
    assert (cells_of(points, LOW, SHAPE, CELL) >= 0).any()
    assert np.array_equal(cells_of(points.tolist(), LOW.tolist(), SHAPE, CELL), expected_cells(points))


@pytest.mark.parametrize("seed", range(5))
def test_rays_pass_the_cells_of_their_samples(seed: int) -> None:
    random = np.random.default_rng(seed)
    origin, rays, lengths = random.uniform(-1, 1, 3), random.normal(size=(300, 3)), random.uniform(-0.2, 2, 300)
    expected = np.zeros(np.prod(SHAPE), dtype=bool)
    for ray, length in zip(rays, lengths, strict=True):
        along = np.arange(0.5, 50) * CELL
        found = expected_cells(origin + along[along < length, None] * ray)
        expected[found[found >= 0]] = True
    passed = passed_cells(origin, rays, lengths, LOW, SHAPE, CELL)
    assert 0 < passed.sum() < passed.size
    assert np.array_equal(passed, expected)
    assert not passed_cells(origin, rays, np.zeros(300), LOW, SHAPE, CELL).any()


@pytest.mark.parametrize("limit", [0.02, 0.3, np.inf])
@pytest.mark.parametrize("count", [31, 32, 33, 500])
def test_distances_of_many_points_are_those_of_each(count: int, limit: float) -> None:
    random = np.random.default_rng(count)
    shapes = [
        *(Sphere(random.uniform(-1, 1, 3), 0.05) for _ in range(30)),
        *(Capsule(center, center + random.normal(0, 0.2, 3), 0.02) for center in random.uniform(-1, 1, (30, 3))),
        *(Box(center, [0.1, 0.05, 0.01], rotation_about([1, 2, 3], 1.0)) for center in random.uniform(-1, 1, (30, 3))),
    ]
    near_each_other = random.uniform(-1, 1, 3) + random.normal(0, 0.1, (count, 3))
    for points in (random.uniform(-1.5, 1.5, (count, 3)), near_each_other):
        expected = distance_to_shapes(points, shapes).min(axis=1)
        found = distance_to_nearest(points, shapes, limit)
        within = expected <= limit
        assert found[within] == pytest.approx(expected[within], abs=1e-9)
        assert (found[~within] > limit).all()
