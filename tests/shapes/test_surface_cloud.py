"""Surface measures of a cloud, and their transfer to a finer one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shape_clouds import cylinder, half_sphere, plane, together

from greenhouse_gym.crops import Palette
from greenhouse_gym.geometry.point_clouds import Cloud, voxel_means
from greenhouse_gym.shapes import ShapeSettings, ShapeWarning, extract_shapes
from greenhouse_gym.shapes.neighborhoods import mend_normals
from greenhouse_gym.shapes.surface_cloud import (
    NO_LEAF,
    SurfaceCloud,
    fine_surface,
    fruit_mask,
    measure_surface,
    redness,
    stem_mask,
)

SETTINGS = ShapeSettings()


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
    return measure_surface(voxel_means(whole, SETTINGS.voxel)[0])


def test_the_fine_surface_has_more_points_of_the_same_surface() -> None:
    whole = ball_and_leaf()
    surface = surface_of(whole)
    fine = fine_surface(whole, surface, SETTINGS)
    assert len(fine) > len(surface)
    assert cKDTree(surface.points).query(fine.points)[0].max() < 2 * SETTINGS.voxel
    assert fine.leaf_hue == surface.leaf_hue < -0.1


def test_points_removed_from_a_surface_are_not_in_the_fine_one() -> None:
    whole = ball_and_leaf()
    surface = surface_of(whole)
    kept = surface.select(surface.points[:, 2] > 1.15)
    assert fine_surface(whole, kept, SETTINGS).points[:, 2].min() > 1.15 - 2 * SETTINGS.voxel


def test_there_is_no_fine_surface_without_normals() -> None:
    whole = ball_and_leaf()
    bare = replace(whole, normals=np.zeros_like(whole.normals))
    assert len(fine_surface(bare, surface_of(whole), SETTINGS)) == 0


@pytest.mark.parametrize("shift", [0.0, 0.0007, 0.0015])
def test_a_fruit_is_found_wherever_the_voxels_lie(shift: float) -> None:
    whole = ball_and_leaf()
    (tomato,) = extract_shapes(whole.points + shift, whole.colors, whole.normals).tomatoes
    assert np.linalg.norm(tomato.center - shift - [0.5, 0.1, 1.2]) < 0.001
    assert abs(tomato.radius - 0.02) < 0.001


def as_surface(
    colors: np.ndarray, curvatures: tuple[float, float] = (0.0, 0.0), leaf_hue: float = NO_LEAF
) -> SurfaceCloud:
    """Points of some colors with the same curvatures, among leaves of one hue."""
    nothing, none = np.zeros((len(colors), 3)), np.zeros(len(colors))
    curved = np.tile(curvatures, (len(colors), 1))
    return SurfaceCloud(nothing, colors, nothing, curved, none, redness(colors), none, leaf_hue, 0.01)


def test_leaves_gutters_and_strings_are_neither_fruit_nor_stem() -> None:
    plant = np.array([*Palette().fruit, [0.36, 0.50, 0.22]])
    other = np.array([[0.20, 0.42, 0.16], [0.90, 0.90, 0.88], [0.85, 0.84, 0.78]])
    cloud = as_surface(np.concatenate([plant, other]), leaf_hue=-0.36)
    assert fruit_mask(cloud).tolist() == stem_mask(cloud).tolist() == [True] * 5 + [False] * 3
    assert fruit_mask(as_surface(np.full((4, 3), 0.5))).all()  # no colors at all
    assert len(fruit_mask(as_surface(np.zeros((0, 3))))) == 0


@pytest.mark.parametrize(
    ("curvatures", "fruit", "stem"), [((0, 3), 0, 0), ((30, 35), 1, 1), ((0, 120), 0, 1), ((-9, 9), 0, 0)]
)
def test_curvature_outweighs_the_color_of_leaves(curvatures: tuple[float, float], fruit: bool, stem: bool) -> None:
    cloud = as_surface(np.array([[0.3, 0.4, 0.2]]), curvatures, leaf_hue=-0.14)
    assert fruit_mask(cloud).tolist() == [fruit]
    assert stem_mask(cloud).tolist() == [stem]


def test_curvatures_and_leaf_hue_of_a_cloud() -> None:
    ball, stem, leaf = half_sphere((0.45, 0.2, 1.1), 0.03), cylinder(0.5, 0.5, 0.6, 1.4, 0.008), plane()
    leaf = (leaf[0] + [0.1, 1.0, 0.0], np.tile([0.24, 0.36, 0.2], (len(leaf[0]), 1)), leaf[2])
    cloud = measure_surface(Cloud(*together(ball, stem, leaf)))
    kind = np.repeat([0, 1, 2], [len(part[0]) for part in (ball, stem, leaf)])
    of_ball, of_stem, of_leaf = (np.median(cloud.curvatures[kind == k], axis=0) for k in range(3))
    np.testing.assert_allclose(of_ball, 1 / 0.03, rtol=0.35)
    assert abs(of_stem[0]) < 0.1 * of_stem[1]
    assert of_stem[1] > 60
    assert np.abs(of_leaf).max() < 5
    assert cloud.leaf_hue == pytest.approx(-0.2, abs=0.01)


@pytest.mark.parametrize("smooth", [False, True])
def test_wrong_normals_are_replaced_by_those_of_the_points(smooth: bool) -> None:
    rng = np.random.default_rng(5)
    whole = ball_and_leaf()
    axes = np.tile([0.0, 0.6, 0.8], (len(whole), 1)) if smooth else rng.normal(size=whole.points.shape)
    angles = np.full(len(whole), np.deg2rad(30)) if smooth else rng.uniform(*np.deg2rad((12, 50)), len(whole))
    across = np.cross(whole.normals, axes)
    turned = whole.normals + np.tan(angles)[:, None] * across / np.linalg.norm(across, axis=1, keepdims=True)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    assert surface_of(whole).alignment > 0.99
    assert surface_of(replace(whole, normals=turned)).alignment < 0.98
    with pytest.warns(ShapeWarning, match="normals of flat surfaces are off by"):
        found = extract_shapes(whole.points, whole.colors, turned)
    assert len(found.tomatoes) == 1
    assert found.tomatoes[0].radius == pytest.approx(0.02, abs=0.003)
    mended = mend_normals(replace(whole, normals=turned), voxel_means(replace(whole, normals=turned), 0.003)[0])[0]
    assert np.median((mended.normals * whole.normals).sum(axis=1)) > 0.98
