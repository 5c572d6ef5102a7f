"""Red fruit in clouds of a time-of-flight camera and of photogrammetry."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from shape_clouds import RED

from greenhouse_gym.capture import Intrinsics, TimeOfFlightNoise, sense_time_of_flight
from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.point_clouds import Cloud
from greenhouse_gym.reconstruction.station_views import image_normals
from greenhouse_gym.shapes import RowShapes, ShapeWarning, extract_shapes

CAMERA = Intrinsics(320, 240, 450.0, 450.0, 159.5, 119.5)
WORLD_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
CENTERS = np.array([[-0.12, -0.08, 0.9], [0.0, 0.05, 0.92], [0.13, -0.05, 0.95], [-0.15, 0.12, 0.97]])  # camera frame
RADII = np.array([0.036, 0.03, 0.038, 0.018])


def photographed() -> tuple[np.ndarray, np.ndarray]:
    """True depth and photograph of four balls, one of them half behind a leaf, in front of leaves."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    depth, color = with_balls(1.05 + 0.015 * np.sin(u / 9.0) + 0.0002 * v, CENTERS, RADII)
    leaf = (np.abs(u - 225) < 12) & (np.abs(v - 90) < 40)
    depth[leaf], color[leaf] = 0.86, (60, 90, 40)
    return depth, color.astype(np.uint8)


def with_balls(background: Array, centers: Array, radii: Array) -> tuple[Array, Array]:
    """Depth and colors of red balls in front of leaves at some depth."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    depth = background.copy()
    color = np.tile([60.0, 90.0, 40.0], (*u.shape, 1)) * (0.8 + 0.2 * np.sin(u / 9.0 + v / 17.0))[..., None]
    for center, radius in zip(centers, radii, strict=True):
        along = (rays @ center) / (square := (rays**2).sum(axis=-1))
        inside = along**2 - (center @ center - radius**2) / square
        front = along - np.sqrt(np.maximum(inside, 0.0))
        hit = (inside > 0) & (front < depth)
        depth[hit], color[hit] = front[hit], 255 * RED
    return depth, color


def cloud_of(depth: np.ndarray, color: np.ndarray) -> Cloud:
    v, u = np.nonzero(depth)
    rays = np.column_stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))])
    points = rays * depth[v, u].astype(float)[:, None]
    normals = image_normals(depth.astype(np.float32), depth > 0, CAMERA)
    return Cloud(points @ WORLD_FROM_CAMERA.T, color[v, u] / 255.0, normals @ WORLD_FROM_CAMERA.T)


def photogrammetric(cloud: Cloud, rng: np.random.Generator, holes: float = 0.1, blob: float = 0.006) -> Cloud:
    """A cloud like those of multi-view stereo: smooth blobs instead of sharp shapes, waves of 1.5 mm, and holes."""
    field = smooth_field(cloud.points, 0.12, rng)
    kept = cloud.select(field > np.quantile(field, holes))
    near = cKDTree(kept.points).query_ball_point(kept.points, blob)
    points, colors, normals = (
        np.array([values[rows].mean(axis=0) for rows in near]) for values in (kept.points, kept.colors, kept.normals)
    )
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    points += 0.0015 * smooth_field(points, 0.03, rng)[:, None] * normals
    return Cloud(points, colors, normals)


def smooth_field(points: Array, length: float, rng: np.random.Generator) -> Array:
    """A random field of mean square 1 at points (n, 3), with waves of about a length."""
    directions = rng.normal(size=(48, 3))
    waves = 2 * np.pi / length * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(np.sqrt(2 / 48) * np.cos(points @ waves.T + rng.uniform(0, 2 * np.pi, 48)).sum(axis=1))


def extracted(cloud: Cloud, with_normals: bool = True) -> RowShapes:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ShapeWarning)
        return extract_shapes(cloud.points, cloud.colors, cloud.normals if with_normals else None)


def right(shapes: RowShapes, centers: Array = CENTERS, radii: Array = RADII) -> list[bool]:
    """Return for each ball whether it was found in its size."""
    return [
        any(
            np.linalg.norm(t.center - WORLD_FROM_CAMERA @ center) < 0.5 * radius and abs(t.radius / radius - 1) < 0.2
            for t in shapes.tomatoes
        )
        for center, radius in zip(centers, radii, strict=True)
    ]


def test_fruit_is_found_in_a_frame_of_a_time_of_flight_camera() -> None:
    depth, color = photographed()
    sensed = sense_time_of_flight(depth, color, np.random.default_rng(0), TimeOfFlightNoise())
    shapes = extracted(cloud_of(sensed, color))
    assert sum(right(shapes)) >= 3
    assert len(shapes.tomatoes) <= 5


@pytest.mark.slow
@pytest.mark.parametrize("normals", ["given", "wrong", "missing"])
def test_fruit_of_all_sizes_is_found_along_a_row_whose_noise_grows_with_the_distance(normals: str) -> None:
    rng = np.random.default_rng(0)
    radii = np.array([0.008, 0.02, 0.012, 0.035, 0.05, 0.02])
    u, v = np.array([45, 45, 150, 150, 260, 280]), np.array([70, 160, 60, 160, 80, 190])
    wall = 0.6 + 0.003 * np.mgrid[: CAMERA.height, : CAMERA.width][1]  # an oblique row
    rays = np.column_stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(6)])
    centers = rays * (wall[v, u] - 0.02 - radii)[:, None]
    depth, color = with_balls(wall + 0.012 * np.sin(np.mgrid[:240, :320][1] / 9.0), centers, radii)
    cloud = cloud_of(depth + 0.001 * depth**2 * rng.normal(size=depth.shape), color)
    if normals == "wrong":  # by 12 to 50 degrees
        across = np.cross(cloud.normals, rng.normal(size=cloud.normals.shape))
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        turned = cloud.normals + np.tan(np.radians(rng.uniform(12, 50, (len(across), 1)))) * across
        cloud = replace(cloud, normals=turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9))
    shapes = extracted(cloud, with_normals=normals != "missing")
    assert sum(right(shapes, centers, radii)) >= 5
    assert len(shapes.tomatoes) <= 7


def test_fruit_is_found_in_a_cloud_of_photogrammetry() -> None:
    cloud = cloud_of(*photographed())
    made = photogrammetric(cloud, np.random.default_rng(0))
    assert 0.85 * len(cloud) < len(made) < 0.95 * len(cloud)
    shapes = extracted(made)
    assert sum(right(shapes)) >= 3
    assert len(shapes.tomatoes) <= 5
