"""Depth edges that have grown over what lies behind them, and depth images without that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from row_helpers import grown, half_recording

from greenhouse_gym.capture import CaptureSettings, StereoNoise, sense_depth, simulate_recording, three_camera_rig
from greenhouse_gym.capture.rig import Intrinsics, RgbdFrame
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction import ReconstructionSettings
from greenhouse_gym.reconstruction.calibration import calibrate
from greenhouse_gym.reconstruction.edge_fattening import EdgeFattening, estimate_edge_fattening, undo_edge_fattening

CAMERA = Intrinsics(320, 240, 424.2, 424.2, 159.5, 119.5)
FAR = 0.8
NOISELESS = StereoNoise(
    disparity_noise=0.0, disparity_step=0.0, depth_unit=0.0, bias=0.0, dropout=0.0, edge_dropout=0.0
)


def balls() -> Array:
    """(240, 320) depth of twelve balls of 2 to 3.5 cm before a wall, metres."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    depth = np.full(u.shape, FAR)
    for k in range(12):
        center = np.array([0.085 * (k % 4 - 1.4), 0.085 * (k // 4 - 1.0), 0.5])
        along, square = rays @ center, (rays**2).sum(axis=-1)
        inside = along**2 - square * (center @ center - (0.02 + 0.0013 * k) ** 2)
        ahead = (along - np.sqrt(np.maximum(inside, 0.0))) / square
        depth = np.where(inside > 0, np.minimum(depth, ahead), depth)
    return depth


def photograph(depth: Array, shift: int = 0) -> np.ndarray:
    """Its photograph, near things red, the wall green, shifted to the right by some pixels."""
    color = np.where((depth < FAR - 0.1)[..., None], (170, 40, 30), (60, 120, 50)).astype(np.uint8)
    return np.roll(color, shift, axis=1)


def seen(noise: StereoNoise, seed: int, shift: int = 0) -> RgbdFrame:
    depth = sense_depth(balls(), CAMERA.fx, np.random.default_rng(seed), noise)
    return RgbdFrame(photograph(balls(), shift), depth, CAMERA)


@pytest.mark.parametrize("fattening", [0, 1, 2, 3])
def test_edge_fattening_is_measured_on_the_photograph(fattening: int) -> None:
    frames = [seen(StereoNoise(edge_fattening=fattening), seed) for seed in range(2)]
    assert estimate_edge_fattening(frames, FAR - 0.1) == (fattening, 0)


def test_fattening_along_columns_is_measured_as_well() -> None:
    frame = seen(StereoNoise(), 0)
    turned = RgbdFrame(
        np.ascontiguousarray(frame.color.transpose(1, 0, 2)),
        np.ascontiguousarray(frame.depth.T),
        replace(CAMERA, width=CAMERA.height, height=CAMERA.width),
    )
    assert estimate_edge_fattening([turned] * 2, FAR - 0.1) == (0, 1)


def test_a_photograph_that_is_shifted_changes_nothing() -> None:
    frames = [seen(StereoNoise(edge_fattening=2), seed, shift=1) for seed in range(3)]
    assert estimate_edge_fattening(frames, FAR - 0.1) == (2, 0)


def test_nothing_is_concluded_without_edges_in_photographs() -> None:
    frame = seen(StereoNoise(), 0)
    noise = np.random.default_rng(0).integers(0, 256, frame.color.shape, dtype=np.uint8)
    for color in (np.full_like(frame.color, 90), noise):
        assert estimate_edge_fattening([replace(frame, color=color)] * 3, FAR - 0.1) == (0, 0)
    assert estimate_edge_fattening([], FAR) == (0, 0)
    assert estimate_edge_fattening([frame], 0.3) == (0, 0)  # nothing is that near
    bad = np.where(np.random.default_rng(0).random(frame.depth.shape) < 0.5, np.nan, np.inf).astype(np.float32)
    assert estimate_edge_fattening([replace(frame, depth=bad)], FAR) == (0, 0)


@pytest.mark.parametrize("fattening", [1, 2])
def test_balls_are_as_large_as_they_were(fattening: int) -> None:
    true = balls()
    fattened = sense_depth(true, CAMERA.fx, np.random.default_rng(0), replace(NOISELESS, edge_fattening=fattening))
    eroded = undo_edge_fattening(fattened, EdgeFattening(fattening, 0))

    def error(image: np.ndarray) -> float:
        read = (image > 0) & (image < FAR - 0.1)
        return float(np.where(true < FAR - 0.1, np.abs(image - true), 0.05)[read].mean())  # 5 cm off beside a ball

    assert error(eroded) < 0.1 * error(fattened)
    lost = (eroded == 0) & (fattened > 0) & (true < FAR - 0.1)
    assert lost.sum() < 0.02 * (true < FAR - 0.1).sum()


@pytest.mark.parametrize("seed", range(3))
def test_with_noise_balls_are_no_longer_too_large(seed: int) -> None:
    true = balls()
    near = true < FAR - 0.1
    image = sense_depth(true, CAMERA.fx, np.random.default_rng(seed), StereoNoise())
    eroded = undo_edge_fattening(image, EdgeFattening(1, 0))

    def ahead(image: np.ndarray) -> float:
        """By how much readings on balls lie before them, metres."""
        return float((true - image)[near & (image > 0) & (image < FAR - 0.1)].mean())

    assert ahead(image) > 0.0007
    assert abs(ahead(eroded)) < 0.0002


def test_a_thin_bar_is_as_wide_as_it_was() -> None:
    true = np.full((60, 200), 1.0)
    true[:, 80:83] = 0.5
    fattened = sense_depth(true, CAMERA.fx, np.random.default_rng(0), NOISELESS)
    near = undo_edge_fattening(fattened, EdgeFattening(1, 0)) == 0.5
    assert np.flatnonzero(near.any(axis=0)).tolist() == [80, 81, 82]
    assert near[:, 80:83].all()


def test_without_fattening_images_stay_as_they_are() -> None:
    image = sense_depth(balls(), CAMERA.fx, np.random.default_rng(0))
    assert np.array_equal(undo_edge_fattening(image, EdgeFattening()), image)
    nothing = np.zeros_like(image)
    assert not undo_edge_fattening(nothing, EdgeFattening(2, 2)).any()


def test_calibration_measures_it_unless_it_is_switched_off() -> None:
    settings = ReconstructionSettings(calibration_stations=2)
    calibration, report = calibrate(half_recording(), settings)
    assert calibration.edge_fattening == report.edge_fattening == (1, 0)
    assert calibrate(half_recording(), replace(settings, calibrate_edges=False))[1].edge_fattening == (0, 0)
    assert calibrate(half_recording(), replace(settings, calibration_stations=0))[1].edge_fattening == (0, 0)


def test_a_single_camera_is_enough_and_a_perfect_one_has_none() -> None:
    rig = three_camera_rig(intrinsics=Intrinsics(424, 240, 212.1, 212.1, 211.5, 119.5))
    alone = replace(rig, cameras={"middle": rig.cameras["middle"]})
    for noise, expected in ((StereoNoise(), (1, 0)), (StereoNoise(edge_fattening=0), (0, 0))):
        recording = simulate_recording(grown(), seed=1, rig=alone, settings=CaptureSettings(noise=noise))
        assert calibrate(recording, ReconstructionSettings(calibration_stations=4))[0].edge_fattening == expected
