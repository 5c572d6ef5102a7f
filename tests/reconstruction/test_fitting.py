"""Settings that find themselves: the foreground's end on every protocol, and the sensor's noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from row_helpers import HALF, from_stations, half_recording, with_depth

from greenhouse_gym.capture import PROTOCOLS, RgbdFrame, Rig, sense_depth, simulate_protocol
from greenhouse_gym.crops import grow_row
from greenhouse_gym.geometry import invert, pose, rotation_about, rotation_angle
from greenhouse_gym.reconstruction import ReconstructionSettings, settings_for
from greenhouse_gym.reconstruction.calibration import calibrate_from_overlap
from greenhouse_gym.reconstruction.settings import foreground_cut, sensor_noise

CAMERA = HALF.cameras["middle"]


@pytest.mark.parametrize("name", ["paper", "back", "upright-back"])
def test_the_foreground_ends_between_the_stems_and_the_next_row(name: str) -> None:
    protocol = PROTOCOLS[name]
    small = tuple(
        replace(rig, cameras={rig.reference: replace(rig.cameras[rig.reference], intrinsics=CAMERA.intrinsics)})
        for rig in protocol.passes
    )
    recording = simulate_protocol(grow_row(2, 0.4), 2, replace(protocol, passes=small), stations=1)
    found = settings_for(replace(recording, protocol=None)).foreground
    assert protocol.distance + 0.05 < found < protocol.distance + 0.5


def test_the_papers_cut_stays_where_it_is_right() -> None:
    assert settings_for(half_recording()) == ReconstructionSettings()


@pytest.mark.parametrize("metres", [0.4, 1.0])
def test_a_rig_farther_away_is_cut_farther_away(metres: float) -> None:
    far = [with_depth(s, lambda _, depth: np.where(depth > 0, depth + metres, 0)) for s in half_recording()]
    found = settings_for(from_stations(far, half_recording())).foreground
    assert 0.55 + metres < found < 0.85 + metres


def test_nothing_seen_leaves_the_usual_cut() -> None:
    empty = RgbdFrame(np.zeros((240, 424, 3), np.uint8), np.zeros((240, 424), np.float32), CAMERA.intrinsics)
    assert foreground_cut([empty], CAMERA, 0.6) == foreground_cut([], CAMERA, 0.6) == 0.6
    assert sensor_noise([empty], CAMERA, HALF, 0.6) == 0.0


@pytest.mark.parametrize("metres", [0.4, 0.8, 1.6])
def test_noise_is_that_of_the_sensor(metres: float) -> None:
    k = CAMERA.intrinsics
    tilted = metres * (1 + 0.2 * (np.arange(k.width) / k.width - 0.5))[None] * np.ones((k.height, 1))
    depth = sense_depth(tilted, k.fx, np.random.default_rng(0))
    frame = RgbdFrame(np.zeros((*depth.shape, 3), np.uint8), depth, k)
    expected = metres**2 * 0.08 / (k.fx * 0.05)
    assert sensor_noise([frame], CAMERA, HALF, 3.0) == pytest.approx(expected, rel=0.45)


def test_noisier_readings_widen_what_is_accepted() -> None:
    random = np.random.default_rng(0)
    noisy = [
        with_depth(s, lambda _, depth: np.where(depth > 0, depth + random.normal(0, 0.003, depth.shape), 0))
        for s in half_recording()
    ]
    found = settings_for(from_stations(noisy, half_recording()))
    assert 0.010 < found.fine_distance < 0.016
    assert 0.005 < found.max_rmse < 0.008


def test_a_camera_knocked_by_three_degrees_is_found_without_a_board() -> None:
    there = HALF.cameras["last"].rig_from_camera
    turn = rotation_about([0.3, 1.0, 0.2], np.deg2rad(3.0))
    knocked = replace(HALF.cameras["last"], rig_from_camera=pose(turn @ there[:3, :3], there[:3, 3] + [0, 0.01, 0]))
    rig = Rig({**HALF.cameras, "last": knocked}, HALF.reference)
    found = calibrate_from_overlap(replace(half_recording(), rig=rig))
    assert np.degrees(found.turned["last"]) == pytest.approx(3.0, abs=0.3)
    for name, camera in HALF.cameras.items():
        apart = invert(camera.rig_from_camera) @ found.mounting.rig_from_camera[name]
        assert np.degrees(rotation_angle(apart[:3, :3])) < 0.5
        assert np.linalg.norm(apart[:3, 3]) < 0.005
