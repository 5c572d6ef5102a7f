"""Red fruit in clouds of a time-of-flight camera and of photogrammetry."""

from __future__ import annotations

import warnings

import numpy as np
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
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    depth = 1.05 + 0.015 * np.sin(u / 9.0) + 0.0002 * v
    color = np.tile([60.0, 90.0, 40.0], (*u.shape, 1)) * (0.8 + 0.2 * np.sin(u / 9.0 + v / 17.0))[..., None]
    for center, radius in zip(CENTERS, RADII, strict=True):
        along = (rays @ center) / (square := (rays**2).sum(axis=-1))
        inside = along**2 - (center @ center - radius**2) / square
        front = along - np.sqrt(np.maximum(inside, 0.0))
        hit = (inside > 0) & (front < depth)
        depth[hit], color[hit] = front[hit], 255 * RED
    leaf = (np.abs(u - 225) < 12) & (np.abs(v - 90) < 40)
    depth[leaf], color[leaf] = 0.86, (60, 90, 40)
    return depth, color.astype(np.uint8)


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


def extracted(cloud: Cloud) -> RowShapes:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ShapeWarning)
        return extract_shapes(cloud.points, cloud.colors, cloud.normals)


def right(shapes: RowShapes) -> list[bool]:
    """Return for each ball whether it was found in its size."""
    return [
        any(
            np.linalg.norm(t.center - WORLD_FROM_CAMERA @ center) < 0.5 * radius and abs(t.radius / radius - 1) < 0.2
            for t in shapes.tomatoes
        )
        for center, radius in zip(CENTERS, RADII, strict=True)
    ]


def test_fruit_is_found_in_a_frame_of_a_time_of_flight_camera() -> None:
    depth, color = photographed()
    sensed = sense_time_of_flight(depth, color, np.random.default_rng(0), TimeOfFlightNoise())
    shapes = extracted(cloud_of(sensed, color))
    assert sum(right(shapes)) >= 3
    assert len(shapes.tomatoes) <= 5


def test_fruit_is_found_in_a_cloud_of_photogrammetry() -> None:
    cloud = cloud_of(*photographed())
    made = photogrammetric(cloud, np.random.default_rng(0))
    assert 0.85 * len(cloud) < len(made) < 0.95 * len(cloud)
    shapes = extracted(made)
    assert sum(right(shapes)) >= 3
    assert len(shapes.tomatoes) <= 5
