"""A cloud by several grids: the same surface, other voxels, and nothing that was left out comes back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.reconstruction.point_clouds import Cloud, voxel_means
from greenhouse_gym.shapes import ShapeSettings, extract_shapes
from greenhouse_gym.shapes.grids import by_grids
from greenhouse_gym.shapes.surfaces import SurfaceCloud, look_at_surfaces

SETTINGS = ShapeSettings(grids=3)


def ball_and_leaf() -> Cloud:
    """A red half ball of 2 cm above a green leaf, dense and noisy."""
    rng = np.random.default_rng(0)
    unit = rng.normal(size=(6000, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    unit[:, 0] = -np.abs(unit[:, 0])
    ball = [0.5, 0.1, 1.2] + 0.02 * unit + rng.normal(0.0, 0.0004, unit.shape)
    leaf = np.column_stack([np.full(9000, 0.55), *rng.uniform([[0.0], [1.0]], [[0.3], [1.1]], (2, 9000))])
    colors = np.repeat([[0.7, 0.2, 0.15], [0.3, 0.45, 0.2]], [6000, 9000], axis=0)
    normals = np.concatenate([unit, np.tile([-1.0, 0.0, 0.0], (9000, 1))])
    return Cloud(np.concatenate([ball, leaf]), colors, normals)


def surface_of(whole: Cloud) -> SurfaceCloud:
    return look_at_surfaces(voxel_means(whole, SETTINGS.voxel)[0], SETTINGS)


def test_each_grid_has_other_voxels_of_the_same_surface() -> None:
    whole = ball_and_leaf()
    surface = surface_of(whole)
    first, *others = by_grids(whole, surface, SETTINGS)
    assert first.surface is surface
    assert not first.shift.any()
    assert len(others) == 2
    for grid in others:
        back = grid.surface.points - grid.shift
        away, _ = cKDTree(surface.points).query(back)
        assert away.max() < 2 * SETTINGS.voxel
        assert np.median(away) > 1e-4, "they are other points"
        assert abs(len(back) / len(surface) - 1) < 0.1
        assert len(grid.fine) > len(grid.surface)
        assert grid.surface.leaf == pytest.approx(surface.leaf, abs=0.02)


def test_what_was_left_out_does_not_come_back() -> None:
    whole = ball_and_leaf()
    surface = surface_of(whole)
    kept = surface.select(surface.points[:, 2] > 1.15)
    for grid in by_grids(whole, kept, SETTINGS):
        for cloud in (grid.surface, grid.fine):
            assert (cloud.points[:, 2] - grid.shift[2]).min() > 1.15 - 2 * SETTINGS.voxel


def test_without_normals_small_fruit_is_looked_for_by_no_grid() -> None:
    whole = ball_and_leaf()
    bare = replace(whole, normals=np.zeros_like(whole.normals))
    assert [len(grid.fine) for grid in by_grids(bare, surface_of(whole), SETTINGS)] == [0, 0, 0]


@pytest.mark.parametrize("grids", [1, 2, 3])
def test_a_fruit_is_where_it_is_whatever_the_number_of_grids(grids: int) -> None:
    whole = ball_and_leaf()
    (tomato,) = extract_shapes(whole.points, whole.colors, whole.normals, ShapeSettings(grids=grids)).tomatoes
    assert np.linalg.norm(tomato.center - [0.5, 0.1, 1.2]) < 0.001
    assert abs(tomato.radius - 0.02) < 0.001


@pytest.mark.parametrize("grids", [0, -1, 1.5, "two"])
def test_a_number_of_grids_that_makes_no_sense_is_refused(grids: object) -> None:
    with pytest.raises(InvalidValueError, match="grids must be a whole number from 1 on"):
        ShapeSettings(grids=grids)  # type: ignore[arg-type]
