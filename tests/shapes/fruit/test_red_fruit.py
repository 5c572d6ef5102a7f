"""Red fruit by its outline, under noise that hides its curvature."""

from __future__ import annotations

import numpy as np
import pytest
from shape_clouds import CAMERA, RED, together

from greenhouse_gym.geometry import Sphere
from greenhouse_gym.geometry.point_clouds import Cloud, voxel_means
from greenhouse_gym.shapes import ShapeSettings
from greenhouse_gym.shapes.fruit.red_fruit import find_red, sits_on
from greenhouse_gym.shapes.input_checks import outside_domain
from greenhouse_gym.shapes.surface_cloud import SurfaceCloud, measure_surface

SETTINGS = ShapeSettings()
GREEN = np.array([0.2, 0.4, 0.1])
NOISE = 0.002  # metres along the view


def facing(points: np.ndarray, normals: np.ndarray, color: np.ndarray, rng: np.random.Generator) -> tuple:
    """Points with noise along the view, and normals that this noise turns by some 40 degrees."""
    view = CAMERA - points
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    turned = normals + rng.normal(0, 0.5, normals.shape)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return points + rng.normal(0, NOISE, (len(points), 1)) * view, np.tile(color, (len(points), 1)), turned


def apple(center: tuple[float, float, float], radius: float, rng: np.random.Generator, whole: bool = False) -> tuple:
    unit = rng.normal(size=(int(4 * np.pi * radius**2 / 0.002**2), 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    unit = unit[(unit @ (CAMERA - center) > 0) | whole]
    return facing(np.array(center) + radius * unit, unit, RED, rng)


def wall(color: np.ndarray, rng: np.random.Generator, count: int = 60_000) -> tuple:
    points = np.column_stack([np.full(count, 0.6), rng.uniform(-0.1, 0.5, count), rng.uniform(0.9, 1.3, count)])
    return facing(points, np.tile([-1.0, 0.0, 0.0], (count, 1)), color, rng)


def surface_of(*parts: tuple) -> SurfaceCloud:
    return measure_surface(voxel_means(Cloud(*together(*parts)), SETTINGS.voxel)[0])


@pytest.mark.parametrize("radius", [0.02, 0.037, 0.048])
def test_one_ball_of_any_size_is_found_once_and_in_its_size(radius: float) -> None:
    rng = np.random.default_rng(0)
    surface = surface_of(wall(GREEN, rng), apple((0.5, 0.2, 1.1), radius, rng))
    found = find_red(surface, [], SETTINGS)
    assert len(found.fits) == 1
    assert found.fits[0].radius == pytest.approx(radius, rel=0.15)
    np.testing.assert_allclose(found.fits[0].center, [0.5, 0.2, 1.1], atol=0.3 * radius)
    assert found.confidence[0] > 0.5
    assert (surface.colors[found.fits[0].points, 0] > surface.colors[found.fits[0].points, 1]).all()


def test_fruit_of_two_sizes_is_found_in_one_cloud() -> None:
    rng = np.random.default_rng(1)
    surface = surface_of(wall(GREEN, rng), apple((0.5, 0.1, 1.1), 0.04, rng), apple((0.5, 0.3, 1.1), 0.02, rng))
    radii = sorted(fit.radius for fit in find_red(surface, [], SETTINGS).fits)
    assert radii == pytest.approx([0.02, 0.04], rel=0.2)


def test_noise_is_judged_where_a_fruit_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    monkeypatch.setattr("test_red_fruit.NOISE", 0.0005)
    near = wall(GREEN, rng, 30_000), apple((0.55, 0.2, 1.1), 0.014, rng)
    monkeypatch.setattr("test_red_fruit.NOISE", 0.004)  # farther from the camera
    far = [wall(GREEN, rng, 45_000), apple((0.55, 0.15, 1.1), 0.014, rng), apple((0.5, 0.3, 1.1), 0.045, rng)]
    far = [(points + [0.0, 1.5, 0.0], colors, normals) for points, colors, normals in far]
    surface = surface_of(*near, *far)
    assert surface.noises.min() < 0.4 * surface.noise
    found = find_red(surface, [], SETTINGS)
    near_fits = [fit for fit in found.fits if fit.center[1] < 1.0]
    assert len(near_fits) == 1, "the median noise of the whole cloud would hide it"
    assert near_fits[0].radius == pytest.approx(0.014, rel=0.2)
    far_fits = [fit for fit in found.fits if fit.center[1] > 1.0]
    assert len(far_fits) == 1, "noise hides the small one"
    assert far_fits[0].radius == pytest.approx(0.045, rel=0.2)


def test_fruit_seen_from_both_sides_is_found_once() -> None:
    rng = np.random.default_rng(6)
    points, colors, normals = wall(GREEN, rng, 40_000)
    leaves = points, colors, normals * rng.choice([-1.0, 1.0], (len(points), 1))
    balls = [((0.5, 0.1, 1.1), 0.036), ((0.72, 0.3, 1.1), 0.03)]
    surface = surface_of(leaves, *(apple(center, radius, rng, whole=True) for center, radius in balls))
    fits = sorted(find_red(surface, [], SETTINGS).fits, key=lambda fit: fit.center[0])
    assert len(fits) == 2
    for fit, (center, radius) in zip(fits, balls, strict=True):
        assert fit.radius == pytest.approx(radius, rel=0.25)
        np.testing.assert_allclose(fit.center, center, atol=0.3 * radius)


def test_a_red_wall_and_a_green_one_are_no_fruit() -> None:
    rng = np.random.default_rng(2)
    assert not find_red(surface_of(wall(RED, rng)), [], SETTINGS).fits
    assert not find_red(surface_of(wall(GREEN, rng)), [], SETTINGS).fits


def test_what_is_explained_is_not_found_again() -> None:
    rng = np.random.default_rng(3)
    surface = surface_of(wall(GREEN, rng), apple((0.5, 0.2, 1.1), 0.037, rng))
    assert not find_red(surface, [Sphere(np.array([0.5, 0.2, 1.1]), 0.038)], SETTINGS).fits


def test_a_bump_sits_on_a_large_ball_and_a_neighbor_does_not() -> None:
    ball = Sphere(np.zeros(3), 0.037)
    assert sits_on(Sphere(np.array([0.036, 0.0, 0.0]), 0.008), [ball])
    assert not sits_on(Sphere(np.array([0.05, 0.0, 0.0]), 0.008), [ball])
    assert not sits_on(Sphere(np.array([0.036, 0.0, 0.0]), 0.03), [ball])
    assert not sits_on(ball, [])


def test_strong_noise_is_outside_the_networks_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    gray = surface_of(wall(np.array([0.4, 0.4, 0.4]), rng))
    assert "normals vary" in outside_domain(gray)
    points, colors, _ = wall(GREEN, rng)
    clean = measure_surface(voxel_means(Cloud(points, colors, np.tile([-1.0, 0.0, 0.0], (len(points), 1))), 0.003)[0])
    assert outside_domain(clean) == ""
    assert outside_domain(gray.select(np.arange(100))) == "", "too few points to judge"
    monkeypatch.setattr("test_red_fruit.NOISE", 0.0026)  # as much as in rows that were recorded from 0.8 m, and more
    assert outside_domain(surface_of(wall(GREEN, rng))) == ""
    monkeypatch.setattr("test_red_fruit.NOISE", 0.004)
    assert "points scatter" in outside_domain(surface_of(wall(GREEN, rng)))
