"""Boxes around the remaining points."""

from __future__ import annotations

import numpy as np
import pytest
from shape_clouds import half_sphere, plane, together

from greenhouse_gym.geometry import Box, distance_to_shapes
from greenhouse_gym.shapes import FINE_SHAPES, ShapeSettings, extract_shapes
from greenhouse_gym.shapes.clutter import CELL, COVERED, bounding_box, box_budget, cover_with_boxes

SETTINGS = ShapeSettings()


def test_boxes_cover_big_pieces_within_their_margin() -> None:
    points, colors, normals = together(plane(), half_sphere((0.4, 0.8, 1.1), 0.08))  # too large for a tomato
    shapes = extract_shapes(points, colors, normals)
    assert shapes.tomatoes == ()
    # the cloud is downsampled to 3 mm, so a point may stick out by that much more
    assert distance_to_shapes(points, shapes.clutter).min(axis=1).max() < COVERED + 0.003
    volume = sum(8 * np.prod(box.half_extents) for box in shapes.clutter)
    assert volume < 4 * (0.4 * 0.4 * 0.02 + 0.16**3 / 2)


@pytest.mark.parametrize("budget", [1, 2, 5, 40])
def test_boxes_keep_their_budget_and_cover_all_points(budget: int) -> None:
    random = np.random.default_rng(0)
    points = random.normal(0, 0.003, (3000, 3)) + random.uniform(0, 0.5, (1, 3)) * np.linspace(0, 1, 3000)[:, None]
    boxes = cover_with_boxes(points, np.tile([-1.0, 0.0, 0.0], (3000, 1)), budget, SETTINGS)
    assert 1 <= len(boxes) <= budget + 1
    if budget == 40:
        assert distance_to_shapes(points, boxes).min(axis=1).max() < COVERED + CELL


def test_no_budget_makes_boxes_that_are_mostly_empty() -> None:
    rng = np.random.default_rng(3)
    sheet = np.column_stack([np.zeros(2000), rng.uniform(-0.05, 0.05, (2000, 2))])
    leaves = [sheet + [0.0, 0.6 * k, 0.0] for k in range(4)]
    boxes = cover_with_boxes(np.concatenate(leaves), np.tile([-1.0, 0.0, 0.0], (8000, 1)), 1, SETTINGS)
    assert len(boxes) == 4
    assert all(box.half_extents.max() < 0.08 for box in boxes)


def test_more_boxes_enclose_less() -> None:
    bent = np.column_stack([np.cos(t := np.linspace(0, np.pi, 4000)), np.sin(t), 0 * t]) * 0.2
    normals = bent / np.linalg.norm(bent, axis=1, keepdims=True)
    bent += np.random.default_rng(0).normal(0, 0.002, bent.shape)
    few, many = (
        sum(8 * np.prod(b.half_extents) for b in cover_with_boxes(bent, normals, n, SETTINGS)) for n in (1, 40)
    )
    assert many < few < 0.25 * 8 * np.prod(bounding_box(bent).half_extents)


def test_no_budget_makes_a_plank_across_two_rails() -> None:
    rail = np.random.default_rng(0).uniform([0, 0, 0], [0.002, 2.0, 0.04], (20_000, 3))
    rails = np.concatenate([rail, rail + [0.0, 0.0, 0.12]])
    boxes = cover_with_boxes(rails, np.tile([-1.0, 0.0, 0.0], (len(rails), 1)), 1, SETTINGS)
    assert len(boxes) == 2


def test_fine_shapes_enclose_less_around_a_bent_leaf() -> None:
    angle, along = (g.ravel() for g in np.meshgrid(np.linspace(0, 2.5, 150), np.linspace(0, 0.12, 60)))
    normals = -np.column_stack([np.cos(angle), 0 * angle, np.sin(angle)])
    points = [0.5, 0.0, 1.0] + 0.06 * normals + along[:, None] * [0.0, 1.0, 0.0]
    points += np.random.default_rng(0).normal(0, 0.0005, points.shape)
    colors = np.tile([0.15, 0.35, 0.2], (len(points), 1))
    coarse, fine = (extract_shapes(points, colors, normals, settings) for settings in (SETTINGS, FINE_SHAPES))
    assert coarse.tomatoes == fine.tomatoes == ()
    assert len(fine.clutter) > len(coarse.clutter)
    volumes = [sum(8 * np.prod(box.half_extents) for box in shapes.clutter) for shapes in (coarse, fine)]
    assert volumes[1] < 0.8 * volumes[0]


@pytest.mark.parametrize("noise", [0.001, 0.0025, 0.003])
def test_noisy_skin_of_a_fruit_gets_no_box(noise: float) -> None:
    for seed in range(4):  # a rig farther back measures skin this thick
        points, colors, normals = half_sphere((0.5, 0.1, 1.1), 0.028, seed, noise)
        shapes = extract_shapes(points, colors, normals)
        assert len(shapes.tomatoes) == 1
        assert shapes.clutter == ()


def test_a_leaf_close_to_a_fruit_keeps_its_box() -> None:
    fruit, leaf = half_sphere((0.5, 0.2, 1.1), 0.028), plane()
    near = (leaf[0] * [1, 0.25, 0.25] + [-0.05, 0.15, 0.825], np.tile([0.24, 0.36, 0.2], (len(leaf[0]), 1)), leaf[2])
    shapes = extract_shapes(*together(fruit, near))
    assert distance_to_shapes(near[0], shapes.clutter).min(axis=1).max() < COVERED + 0.003


def test_boxes_of_a_leaf_curled_around_a_fruit_exclude_the_fruit() -> None:
    inside, covered = [], []
    for seed in range(6):
        random = np.random.default_rng(seed)
        fruit = half_sphere((0.5, 0.2, 1.1), 0.02, seed)[0]
        angle, along = random.uniform(-1.7, 1.7, 1500), random.uniform(-0.01, 0.01, 1500)
        normals = np.column_stack([-np.cos(angle), np.sin(angle), 0 * angle])
        leaf = [0.5, 0.2, 1.1] + 0.026 * normals + along[:, None] * [0.0, 0.0, 1.0]
        leaf += random.normal(0, 0.001, leaf.shape)
        kept = [
            cover_with_boxes(leaf, normals, 1, SETTINGS),
            *(cover_with_boxes(leaf, normals, n, SETTINGS, fruit) for n in (1, 20)),
        ]
        inside.append([(distance_to_shapes(fruit, boxes).min(axis=1) < -0.001).mean() for boxes in kept])
        covered.append([(distance_to_shapes(leaf, b).min(axis=1) < COVERED).mean() for b in kept])
    regardless, one, many = np.mean(inside, axis=0)
    assert regardless > 0.5  # one box around the leaf holds most of the fruit
    assert one < 0.2
    assert many < 0.02
    assert np.mean(covered, axis=0).min() > 0.96


def test_the_budget_grows_with_the_area() -> None:
    leaves = np.concatenate([plane(seed)[0] + [0, 0, 0.5 * seed] for seed in range(4)])  # one above the other
    budgets = [box_budget(leaves[: 20_000 * count], SETTINGS) for count in (1, 2, 4)]
    np.testing.assert_allclose(np.divide(budgets, budgets[0]), [1, 2, 4], rtol=0.05)
    assert box_budget(leaves[:1], SETTINGS) > 0


def test_two_leaves_that_cross_get_a_thin_box_each() -> None:
    random = np.random.default_rng(0)
    flat = random.uniform(-0.05, 0.05, (3000, 3)) * [0, 1, 1]
    upright = random.uniform(-0.05, 0.05, (3000, 3)) * [1, 1, 0]
    points = np.concatenate([flat, upright]) + random.normal(0, 0.0005, (6000, 3))
    boxes = cover_with_boxes(points, np.repeat([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], 3000, axis=0), 20, SETTINGS)
    assert len(boxes) <= 6
    assert (
        sum(8 * np.prod(box.half_extents) for box in boxes) < 0.3 * 0.1**3
    )  # one box around both would hold all of it


@pytest.mark.parametrize("count", [1, 2, 3, 50])
def test_a_bounding_box_holds_its_points(count: int) -> None:
    points = np.random.default_rng(count).uniform(-0.1, 0.1, (count, 3))
    assert distance_to_shapes(points, [Box(*bounding_box(points))]).max() < 1e-9
    assert distance_to_shapes(np.repeat(points[:1], 4, axis=0), [Box(*bounding_box(points))]).max() < 1e-9
