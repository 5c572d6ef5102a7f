"""Normals from depth images, ICP between surfaces that face the same way, and the cameras' biases."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from row_helpers import from_stations, rendered

from greenhouse_gym.capture import (
    SEED_RIG,
    CaptureSettings,
    Intrinsics,
    RgbdFrame,
    Station,
    StereoNoise,
    simulate_recording,
)
from greenhouse_gym.capture.rig import D435_DEPTH
from greenhouse_gym.capture.sensor import draw_biases
from greenhouse_gym.capture.simulated import perturbed_rig
from greenhouse_gym.crops import grow_row
from greenhouse_gym.geometry import invert, pose, rotation_about, rotation_angle, transform
from greenhouse_gym.reconstruction import ReconstructionSettings
from greenhouse_gym.reconstruction.calibration import calibrate
from greenhouse_gym.reconstruction.icp import fine_icp
from greenhouse_gym.reconstruction.pair_registration import alignment_problem, register_pair
from greenhouse_gym.reconstruction.station_views import Calibration, StationView, image_normals, station_view

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
    angles = np.degrees(np.arccos(np.clip(image_normals(frame.depth, mask, CAMERA) @ normal, -1, 1)))
    assert angles.max() < 0.5


def test_a_background_outside_the_mask_does_not_bend_normals() -> None:
    normal = np.array([0.0, 0.0, -1.0])
    frame = plane_frame(normal, 0.5)
    depth = frame.depth.copy()
    depth[:, :100] = 2.0
    mask = np.zeros(depth.shape, dtype=bool)
    mask[:, 100:108] = True  # a stem eight pixels wide
    normals = image_normals(depth, mask, CAMERA)
    assert np.degrees(np.arccos(np.clip(normals @ normal, -1, 1))).max() < 0.5


def test_single_pixels_look_back_along_the_ray() -> None:
    frame = plane_frame(np.array([0.0, 0.0, -1.0]), 0.5)
    mask = np.zeros(frame.depth.shape, dtype=bool)
    mask[10, 20] = True
    normals = image_normals(frame.depth, mask, CAMERA)
    assert np.isfinite(normals).all()
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)


NOISELESS = StereoNoise(
    disparity_noise=0.0, disparity_step=0.0, depth_unit=0.0, bias=0.0, dropout=0.0, edge_dropout=0.0, edge_fattening=0
)


@cache
def views(noiseless: bool) -> tuple[StationView, StationView, np.ndarray]:
    """Two stations and the true motion between them."""
    noise = NOISELESS if noiseless else StereoNoise(bias=0.0)
    recording = simulate_recording(grow_row(6, 0.5), seed=6, stations=2, settings=CaptureSettings(noise=noise))
    stations = list(recording)
    poses = [station.world_from_station for station in stations]
    assert poses[0] is not None
    assert poses[1] is not None
    one, two = (station_view(station, Calibration(recording.rig), SETTINGS) for station in stations)
    return one, two, invert(poses[0]) @ poses[1]


def off(motion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """A start a few millimetres and a third of a degree off a motion."""
    center = points.mean(axis=0)
    turn = rotation_about([0.3, 1.0, -0.5], 0.006)
    return motion @ pose(turn, center - turn @ center + [0.002, 0.002, -0.002])


@pytest.mark.parametrize(("noiseless", "millimetres", "degrees"), [(True, 0.1, 0.02), (False, 0.3, 0.08)])
def test_the_true_motion_is_recovered(noiseless: bool, millimetres: float, degrees: float) -> None:
    first, second, true = views(noiseless)
    found = fine_icp(first, second.sample, off(true, second.sample.points), SETTINGS)
    apart = transform(found.first_from_second, second.sample.points) - transform(true, second.sample.points)
    assert 1e3 * np.linalg.norm(apart.mean(axis=0)) < millimetres
    assert np.degrees(rotation_angle(found.first_from_second[:3, :3].T @ true[:3, :3])) < degrees
    assert found.overlap > 0.5
    assert found.fitness > 0.7
    assert found.contradicted < 0.02
    assert found.constraint[1] > 0.05
    assert np.linalg.eigvalsh(found.information).min() > 0


def test_what_is_not_there_is_contradicted() -> None:
    first, second, true = views(False)
    hand = second.sample.points.copy()
    toward = second.reference.camera.rig_from_camera[:3, 3] - hand
    hand += 0.5 * toward  # halfway to the camera
    half = np.arange(len(hand)) % 2 == 0
    points = np.where(half[:, None], hand, second.sample.points)
    found = fine_icp(first, replace(second.sample, points=points), true, SETTINGS)
    assert 0.3 < found.contradicted < 0.6


def test_clouds_without_partners_have_no_fitness() -> None:
    first, second, _ = views(False)
    far = pose(translation=[5.0, 0.0, 0.0])
    assert fine_icp(first, second.sample, far, SETTINGS).fitness == 0.0


def test_a_wall_does_not_constrain_its_motion() -> None:
    depth = np.full((D435_DEPTH.height, D435_DEPTH.width), 0.5) + np.random.default_rng(0).normal(0, 1e-3, (480, 848))
    depth[:, 400:] = 0  # so that the silhouettes have an edge
    frame = RgbdFrame(np.zeros((480, 848, 3), dtype=np.uint8), depth.astype(np.float32), D435_DEPTH)
    rig = replace(SEED_RIG, cameras={"middle": SEED_RIG.cameras["middle"]})
    wall = station_view(Station({"middle": frame}), Calibration(rig), SETTINGS)
    found = register_pair(wall, wall, 1, SETTINGS)
    assert found.reason
    moved = fine_icp(wall, wall.sample, pose(translation=[0.0, 0.08, 0.0]), SETTINGS)
    assert moved.fitness > SETTINGS.min_fitness
    assert "too even" in alignment_problem(moved, SETTINGS)


def test_biases_of_the_cameras_are_found() -> None:
    noise = StereoNoise(bias=0.01)
    row = grow_row(5, 0.4)
    recording = simulate_recording(row, seed=5, stations=3, settings=CaptureSettings(noise=noise))
    true = draw_biases(3, np.random.default_rng([5, 1]), noise.bias)
    calibration, report = calibrate(recording, SETTINGS)
    found = np.array([*report.bias.values()])
    assert np.abs(found - true).max() < 0.0015  # the part that is common to all cameras as well
    assert np.abs(true).max() > 0.005
    assert calibration.rig is recording.rig
    assert report.gap_after < report.gap_before


def test_one_camera_has_no_bias_to_compare() -> None:
    rig = replace(SEED_RIG, cameras={"middle": SEED_RIG.cameras["middle"]})
    recording = simulate_recording(grow_row(5, 0.4), seed=5, rig=rig, stations=2)
    assert calibrate(recording, SETTINGS)[1].bias == {"middle": 0.0}


def test_cameras_that_stand_off_the_rig_file_are_found() -> None:
    off_file = CaptureSettings(camera_offset=0.002, camera_angle=0.005)
    recording = rendered(simulate_recording(grow_row(7, 0.5), seed=7, settings=off_file))
    calibration, report = calibrate(recording, SETTINGS)
    actual = perturbed_rig(recording.rig, 7, off_file)
    assert report.turned
    for name, camera in actual.cameras.items():
        true, filed, found = (r.cameras[name].rig_from_camera for r in (actual, recording.rig, calibration.rig))
        if name != recording.rig.reference:
            before, after = (rotation_angle(true[:3, :3].T @ pose[:3, :3]) for pose in (filed, found))
            assert after < 0.3 * before
            assert np.linalg.norm(found[:3, 3] - true[:3, 3]) < 0.002
        assert camera.depth_scale == calibration.rig.cameras[name].depth_scale
    kept, _ = calibrate(from_stations(list(recording)[:2], recording), replace(SETTINGS, calibrate_rig=False))
    assert kept.rig is recording.rig
