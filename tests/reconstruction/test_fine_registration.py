"""Normals from depth images, ICP between surfaces that face the same way, and the cameras' biases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greenhouse_gym.capture import SEED_RIG, Intrinsics, RgbdFrame, StereoNoise, WalkSettings, simulate_recording
from greenhouse_gym.capture.sensor import draw_biases
from greenhouse_gym.geometry import pose, rotation_about, rotation_angle
from greenhouse_gym.plants import grow_row
from greenhouse_gym.reconstruction import ReconstructionSettings
from greenhouse_gym.reconstruction.calibration import estimate_bias
from greenhouse_gym.reconstruction.clouds import Cloud
from greenhouse_gym.reconstruction.icp import Surface, align
from greenhouse_gym.reconstruction.normals import image_normals

SETTINGS = ReconstructionSettings()
CAMERA = Intrinsics(200, 150, 110.0, 105.0, 99.0, 74.0)


def plane_frame(normal: np.ndarray, distance: float) -> RgbdFrame:
    """A plane normal . X = -distance (the normal looks at the camera) as a depth image."""
    x, y = np.meshgrid((np.arange(200) - CAMERA.cx) / CAMERA.fx, (np.arange(150) - CAMERA.cy) / CAMERA.fy)
    depth = -distance / (normal[0] * x + normal[1] * y + normal[2])
    return RgbdFrame(np.zeros((150, 200, 3), dtype=np.uint8), depth.astype(np.float32), CAMERA)


@pytest.mark.parametrize("tilt", [0.0, 0.4, 0.9])
@pytest.mark.parametrize("about", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.8, 0.0)])
def test_normals_of_a_plane(tilt: float, about: tuple[float, float, float]) -> None:
    normal = rotation_about(about, tilt) @ np.array([0.0, 0.0, -1.0])
    frame = plane_frame(normal, 0.5)
    mask = np.zeros((150, 200), dtype=bool)
    mask[40:110, 50:150] = True
    mask &= (frame.depth > 0) & (frame.depth < 3)
    angles = np.degrees(np.arccos(np.clip(image_normals(frame, mask) @ normal, -1, 1)))
    assert angles.max() < 0.5


def test_a_background_outside_the_mask_does_not_bend_normals() -> None:
    normal = np.array([0.0, 0.0, -1.0])
    frame = plane_frame(normal, 0.5)
    depth = frame.depth.copy()
    depth[:, :100] = 2.0
    mask = np.zeros(depth.shape, dtype=bool)
    mask[:, 100:108] = True  # a stem eight pixels wide
    normals = image_normals(replace(frame, depth=depth), mask)
    assert np.degrees(np.arccos(np.clip(normals @ normal, -1, 1))).max() < 0.5


def test_single_pixels_look_back_along_the_ray() -> None:
    frame = plane_frame(np.array([0.0, 0.0, -1.0]), 0.5)
    mask = np.zeros(frame.depth.shape, dtype=bool)
    mask[10, 20] = True
    normals = image_normals(frame, mask)
    assert np.isfinite(normals).all()
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)


def half_stems(rng: np.random.Generator, side: float, noise: float = 0.0, upright: bool = False) -> Cloud:
    """Twelve stems 10 mm thick, in all directions or upright, each seen from one side only."""
    parts, normals = [], []
    for k in range(12):
        frame = np.eye(3) if upright else np.linalg.qr(np.random.default_rng(k).normal(size=(3, 3)))[0]
        center = np.random.default_rng(100 + k).uniform(-0.3, 0.3, 3)
        angle = side * rng.uniform(-0.2 * np.pi, 0.7 * np.pi, 600)
        around = np.cos(angle)[:, None] * frame[:, 0] + np.sin(angle)[:, None] * frame[:, 1]
        along = rng.uniform(-0.15, 0.15, 600)[:, None] * frame[:, 2]
        parts.append(center + along + (0.005 + noise * rng.normal(size=(600, 1))) * around)
        normals.append(around)
    points = np.concatenate(parts)
    return Cloud(points, np.zeros_like(points), np.concatenate(normals))


def test_stems_seen_from_two_sides_are_not_pulled_together() -> None:
    rng = np.random.default_rng(0)
    first, second = (half_stems(rng, side, 0.0005, upright=True) for side in (1.0, -1.0))
    start = pose(rotation_about([0.0, 0.0, 1.0], 0.004), [0.001, -0.001, 0.0])
    found = align(Surface(first), second, start, SETTINGS).first_from_second
    assert np.linalg.norm(found[:2, 3]) < 0.0003
    assert rotation_angle(found[:3, :3]) < 0.001


def test_a_known_motion_is_recovered() -> None:
    rng = np.random.default_rng(1)
    cloud = half_stems(rng, 1.0)
    motion = pose(rotation_about([0.3, 1.0, -0.5], 0.005), [0.001, 0.0015, -0.001])
    moved = cloud.moved(motion)
    found = align(Surface(moved), cloud, np.eye(4), SETTINGS)
    assert np.allclose(found.first_from_second, motion, atol=2e-4)
    assert found.fitness > 0.95
    assert np.linalg.eigvalsh(found.information).min() > 0


def test_clouds_without_partners_have_no_fitness() -> None:
    cloud = half_stems(np.random.default_rng(2), 1.0)
    far = cloud.moved(pose(translation=[5.0, 0.0, 0.0]))
    assert align(Surface(cloud), far, np.eye(4), SETTINGS).fitness == 0.0


def test_biases_of_the_cameras_are_found() -> None:
    noise = StereoNoise(bias=0.01)
    row = grow_row(5, 0.4)
    recording = simulate_recording(row, seed=5, stations=3, settings=WalkSettings(noise=noise))
    true = draw_biases(3, np.random.default_rng([5, 1]), noise)
    found = np.array([*estimate_bias(recording, SETTINGS).values()])
    assert abs(found.sum()) < 1e-6
    assert np.abs(found - (true - true.mean())).max() < 0.0015
    assert np.ptp(true) > 0.005


def test_one_camera_has_no_bias_to_compare() -> None:
    rig = replace(SEED_RIG, cameras={"middle": SEED_RIG.cameras["middle"]})
    recording = simulate_recording(grow_row(5, 0.4), seed=5, rig=rig, stations=2)
    assert estimate_bias(recording, SETTINGS) == {"middle": 0.0}
