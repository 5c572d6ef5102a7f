"""Features of the shells in and around a sphere."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.geometry import Array, Sphere
from greenhouse_gym.shapes.fruit.sphere_features import COLOR_FEATURES, SHELL_FEATURES, shell_features
from greenhouse_gym.shapes.surface_cloud import NO_LEAF, SurfaceCloud

SPACING = 0.002
BALL = Sphere([0.5, 0.1, 1.2], 0.01)


def surface(points: Array, normals: Array, hues: float | Array = 0.0, leaf_hue: float = -0.2) -> SurfaceCloud:
    count = len(points)
    gray, flat = np.full((count, 3), 0.5), np.zeros((count, 2))
    return SurfaceCloud(
        points, gray, normals, flat, np.ones(count), np.full(count, hues), np.zeros(count), leaf_hue, 0.02
    )


def half_ball(count: int = 300, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points on the side of `BALL` that faces the camera, and their normals."""
    unit = np.random.default_rng(seed).normal(size=(count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    unit[:, 0] = -np.abs(unit[:, 0])
    return BALL.center + BALL.radius * unit, unit


def plane() -> tuple[np.ndarray, np.ndarray]:
    """A leaf through the middle of `BALL` that extends far outside of it."""
    y, z = (values.ravel() for values in np.meshgrid(*[np.arange(-0.03, 0.03, SPACING)] * 2))
    return BALL.center + np.column_stack([np.zeros_like(y), y, z]), np.tile([-1.0, 0.0, 0.0], (len(y), 1))


def read(features: np.ndarray) -> dict[str, float]:
    return dict(zip(SHELL_FEATURES, features, strict=True))


def test_a_ball_is_hollow_and_a_leaf_continues_inside_and_outside() -> None:
    ball = read(shell_features([BALL], surface(*half_ball()), SPACING)[0])
    leaf = read(shell_features([BALL], surface(*plane()), SPACING)[0])
    assert ball["facing, shell 3"] == pytest.approx(1.0)
    assert all(ball[f"filled, shell {k}"] == 0.0 for k in (0, 1, 2, 4, 5, 6))
    assert ball["filled, shell 3"] > 1.0
    assert all(leaf[f"filled, shell {k}"] > 0.5 for k in range(7))
    assert abs(leaf["facing, shell 3"]) < 1e-6


def test_colors_are_compared_with_the_skin_and_that_with_leaves() -> None:
    points, normals = (np.concatenate(both) for both in zip(half_ball(), plane(), strict=True))
    hues = np.repeat([0.05, -0.1], [300, len(points) - 300])
    found = read(shell_features([BALL], surface(points, normals, hues), SPACING)[0])
    assert found["redder, shell 3"] == pytest.approx((0.05 + 0.2) / 0.1)
    assert found["redder, shell 6"] == pytest.approx((-0.1 - 0.05) / 0.1)
    bare = read(shell_features([BALL], surface(points, normals, hues, NO_LEAF), SPACING)[0])
    assert bare["redder, shell 3"] == 0.0, "there are no leaves to compare with"


def test_one_color_gives_no_color_features() -> None:
    points, normals = (np.concatenate(both) for both in zip(half_ball(), plane(), strict=True))
    features = shell_features([BALL], surface(points, normals, 0.3, 0.3), SPACING)[0]
    np.testing.assert_allclose(features[list(COLOR_FEATURES)], 0.0, atol=1e-12)


def test_size_and_order_do_not_matter() -> None:
    points, normals = half_ball()
    order = np.random.default_rng(1).permutation(len(points))
    one = shell_features([BALL], surface(points, normals), SPACING)
    np.testing.assert_allclose(shell_features([BALL], surface(points[order], normals[order]), SPACING), one)
    large = Sphere(3 * BALL.center, 3 * BALL.radius)
    np.testing.assert_allclose(shell_features([large], surface(3 * points, normals), 3 * SPACING), one)


def test_features_without_points_are_zero() -> None:
    far = Sphere([5.0, 5.0, 5.0], 0.01)
    assert not shell_features([far], surface(*half_ball()), SPACING).any()
    assert shell_features([], surface(*half_ball()), SPACING).shape == (0, len(SHELL_FEATURES))
