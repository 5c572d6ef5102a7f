"""What lies in, on and around a sphere, shell by shell."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.geometry import Array, Sphere
from greenhouse_gym.shapes.surfaces import NO_LEAF, SurfaceCloud
from greenhouse_gym.shapes.surroundings import OF_COLOR, SURROUNDINGS, surroundings

SPACING = 0.002
BALL = Sphere([0.5, 0.1, 1.2], 0.01)


def surface(points: Array, normals: Array, tones: float | Array = 0.0, leaf: float = -0.2) -> SurfaceCloud:
    count = len(points)
    gray, bends = np.full((count, 3), 0.5), np.zeros((count, 2))
    return SurfaceCloud(points, gray, normals, bends, np.ones(count), np.full(count, tones), leaf, 0.02)


def half_ball(count: int = 300, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points on the side of `BALL` that faces the camera, and their normals."""
    unit = np.random.default_rng(seed).normal(size=(count, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    unit[:, 0] = -np.abs(unit[:, 0])
    return BALL.center + BALL.radius * unit, unit


def plane() -> tuple[np.ndarray, np.ndarray]:
    """A leaf across the middle of `BALL` that goes on far beyond it."""
    y, z = (values.ravel() for values in np.meshgrid(*[np.arange(-0.03, 0.03, SPACING)] * 2))
    return BALL.center + np.column_stack([np.zeros_like(y), y, z]), np.tile([-1.0, 0.0, 0.0], (len(y), 1))


def read(measures: np.ndarray) -> dict[str, float]:
    return dict(zip(SURROUNDINGS, measures, strict=True))


def test_a_ball_is_hollow_and_alone_and_a_leaf_goes_on_inside_and_beyond() -> None:
    ball = read(surroundings([BALL], surface(*half_ball()), SPACING)[0])
    leaf = read(surroundings([BALL], surface(*plane()), SPACING)[0])
    assert ball["facing, shell 3"] == pytest.approx(1.0)
    assert all(ball[f"filled, shell {k}"] == 0.0 for k in (0, 1, 2, 4, 5, 6))
    assert ball["filled, shell 3"] > 1.0
    assert all(leaf[f"filled, shell {k}"] > 0.5 for k in range(7))
    assert abs(leaf["facing, shell 3"]) < 1e-6


def test_colors_are_compared_with_the_skin_and_that_with_leaves() -> None:
    points, normals = (np.concatenate(both) for both in zip(half_ball(), plane(), strict=True))
    tones = np.repeat([0.05, -0.1], [300, len(points) - 300])
    found = read(surroundings([BALL], surface(points, normals, tones), SPACING)[0])
    assert found["redder, shell 3"] == pytest.approx((0.05 + 0.2) / 0.1)
    assert found["redder, shell 6"] == pytest.approx((-0.1 - 0.05) / 0.1)
    bare = read(surroundings([BALL], surface(points, normals, tones, NO_LEAF), SPACING)[0])
    assert bare["redder, shell 3"] == 0.0, "there are no leaves to compare with"


def test_one_color_says_nothing_by_color() -> None:
    points, normals = (np.concatenate(both) for both in zip(half_ball(), plane(), strict=True))
    measures = surroundings([BALL], surface(points, normals, 0.3, 0.3), SPACING)[0]
    np.testing.assert_allclose(measures[list(OF_COLOR)], 0.0, atol=1e-12)


def test_size_and_order_do_not_matter() -> None:
    points, normals = half_ball()
    order = np.random.default_rng(1).permutation(len(points))
    one = surroundings([BALL], surface(points, normals), SPACING)
    np.testing.assert_allclose(surroundings([BALL], surface(points[order], normals[order]), SPACING), one)
    large = Sphere(3 * BALL.center, 3 * BALL.radius)
    np.testing.assert_allclose(surroundings([large], surface(3 * points, normals), 3 * SPACING), one)


def test_nothing_near_is_measured_as_nothing() -> None:
    far = Sphere([5.0, 5.0, 5.0], 0.01)
    assert not surroundings([far], surface(*half_ball()), SPACING).any()
    assert surroundings([], surface(*half_ball()), SPACING).shape == (0, len(SURROUNDINGS))
