from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from greenhouse_gym.accuracy.cover import outer_samples
from greenhouse_gym.crops.truth_shapes import leaf_boxes, surface_points
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import distance_to_shapes, rotation_about


def leaflet(bend: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A lobed leaflet 8 cm long and up to 5 cm wide, bent along and across, turned somehow."""
    along, across = np.meshgrid(np.linspace(0, 1, 40), np.linspace(-1, 1, 17), indexing="ij")
    half_width = 0.025 * np.sin(np.pi * along) ** 0.6 * (1 - 0.25 * np.abs(np.sin(6 * np.pi * along)))
    x, y = 0.08 * along, half_width * across
    z = bend * (-((x / 0.08) ** 2) * 0.03 + np.abs(y) * 0.5)
    turn = rotation_about(np.random.default_rng(seed).normal(size=3), 1.3)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3) @ turn.T + [0.3, 0.2, 1.5]
    grid = np.arange(40 * 17).reshape(40, 17)
    a, b, c, d = (g.reshape(-1) for g in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    return vertices, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


@pytest.mark.parametrize("bend", [0.0, 0.5, 1.0])
def test_boxes_lie_on_the_leaf_and_cover_it(bend: float) -> None:
    vertices, triangles = leaflet(bend)
    boxes = leaf_boxes(vertices, triangles)
    surface = surface_points(vertices, triangles, 0.0015)
    uncovered = distance_to_shapes(surface, boxes).min(axis=1)
    assert np.quantile(uncovered, 0.95) < 0.003
    assert uncovered.max() < 0.005
    samples = outer_samples(boxes, 1000, np.random.default_rng(0))
    gaps, _ = cKDTree(surface).query(samples)
    assert np.quantile(gaps, 0.95) < 0.004
    assert len(boxes) < 30
    assert len(boxes) >= (3 if bend else 1)


def test_a_flat_strip_is_one_box() -> None:
    vertices = np.array([[0, 0, 1], [0.1, 0, 1], [0.1, 0.02, 1], [0, 0.02, 1]], dtype=float)
    (box,) = leaf_boxes(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
    np.testing.assert_allclose(box.center, [0.05, 0.01, 1], atol=5e-4)
    np.testing.assert_allclose(sorted(box.half_extents)[1:], [0.01, 0.05], atol=5e-4)


def test_meshes_that_are_none_are_refused() -> None:
    assert leaf_boxes(np.zeros((0, 3)), np.zeros((0, 3), int)) == []
    with pytest.raises(InvalidValueError, match="vertices"):
        leaf_boxes(np.zeros((3, 2)), np.zeros((1, 3), int))
    with pytest.raises(InvalidValueError, match="vertices 0 to 3 of 3"):
        leaf_boxes(np.zeros((3, 3)), np.array([[0, 1, 3]]))
