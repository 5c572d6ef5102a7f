"""Depth of a time-of-flight camera: flying pixels, rounded corners, noise of distance and darkness, dark holes."""

from __future__ import annotations

import numpy as np
import pytest

from greenhouse_gym.capture import (
    SEED_RIG,
    CaptureSettings,
    TimeOfFlightNoise,
    sense_time_of_flight,
    simulate_recording,
)
from greenhouse_gym.crops import grow_row

SILENT = TimeOfFlightNoise(noise=0.0, flying=0.0, multipath=0.0, depth_unit=0.0)
SHAPE = (60, 80)


def gray(level: int) -> np.ndarray:
    return np.full((*SHAPE, 3), level, dtype=np.uint8)


def sense(depth: np.ndarray | float, color: np.ndarray | None = None, seed: int = 0, **errors: float) -> np.ndarray:
    noise = TimeOfFlightNoise(**{**vars(SILENT), **errors})
    color = gray(128) if color is None else color
    return sense_time_of_flight(np.broadcast_to(depth, SHAPE), color, np.random.default_rng(seed), noise)


def test_without_errors_the_depth_is_true_within_the_range() -> None:
    np.testing.assert_allclose(sense(1.3), 1.3, atol=1e-6)
    for nothing in (0.0, np.inf, np.nan, 3.5):
        assert not sense(nothing).any()


def test_noise_grows_with_distance_and_darkness() -> None:
    near, far, dark = (np.std(sense(d, gray(c), noise=3e-4)) for d, c in ((1.0, 128), (2.0, 128), (1.0, 32)))
    assert far == pytest.approx(4 * near, rel=0.2)
    assert dark == pytest.approx(2 * near, rel=0.2)
    assert 2e-4 < near < 1e-3


def test_dark_leaves_do_not_return_light() -> None:
    color = gray(128)
    color[:, :40] = 6
    seen = sense(1.3, color) > 0
    assert not seen[:, :40].any()
    assert seen[:, 40:].all()


def test_pixels_fly_between_near_and_far() -> None:
    step = np.where(np.arange(80) < 40, 1.0, 1.5)
    flying = sense(step, flying=0.5)
    between = (flying > 1.02) & (flying < 1.48)
    assert 0.2 < between[:, 39:41].mean() < 0.6
    assert not between[:, :39].any()
    assert not between[:, 41:].any()


def test_light_of_farther_surfaces_makes_near_ones_farther() -> None:
    step = np.where(np.arange(80) < 40, 1.0, 1.5)
    seen = sense(step, multipath=0.05)
    assert seen[30, 35] > 1.001
    assert seen[30, 5] == pytest.approx(1.0, abs=1e-4)
    assert (seen >= step.astype(np.float32) - 1e-6).all()


def test_a_row_is_recorded_by_time_of_flight() -> None:
    row = grow_row(3, 0.2, 0)
    shown = [
        simulate_recording(row, 3, stations=1, settings=CaptureSettings(noise=noise))[0].frames
        for noise in (TimeOfFlightNoise(), TimeOfFlightNoise(), CaptureSettings().noise)
    ]
    name = SEED_RIG.reference
    np.testing.assert_array_equal(shown[0][name].depth, shown[1][name].depth)
    both = (shown[0][name].depth > 0) & (shown[2][name].depth > 0)
    assert both.mean() > 0.1
    assert np.median(np.abs(shown[0][name].depth - shown[2][name].depth)[both]) < 0.01
