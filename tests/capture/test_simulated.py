from __future__ import annotations

import numpy as np
import pytest
from row_helpers import HALF, grown

from greenhouse_gym.capture import SEED_RIG, CaptureSettings, Recording, Station, simulate_recording
from greenhouse_gym.capture.simulated import tripod_poses
from greenhouse_gym.errors import GreenhouseError, InvalidValueError
from greenhouse_gym.geometry import rotation_angle


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate_recording(grown(), seed=5, rig=HALF)


def assert_same(a: Station, b: Station) -> None:
    np.testing.assert_array_equal(a.world_from_station, b.world_from_station)
    for name, frame in a.frames.items():
        np.testing.assert_array_equal(frame.color, b.frames[name].color)
        np.testing.assert_array_equal(frame.depth, b.frames[name].depth)


def test_same_seed_same_frames_in_any_order(recording: Recording) -> None:
    again = simulate_recording(grown(), seed=5, rig=HALF)
    assert len(again) == len(recording) == 5
    last = recording[4]
    assert_same(again[1], recording[1])
    assert_same(again[4], last)


def test_other_seeds_give_other_motions_and_noise(recording: Recording) -> None:
    other = simulate_recording(grown(), seed=6, rig=HALF)
    a, b = recording[0], other[0]
    assert (a.world_from_station != b.world_from_station).any()  # type: ignore[union-attr]
    assert (a.frames["middle"].depth != b.frames["middle"].depth).any()


def test_frames_look_like_photographs(recording: Recording) -> None:
    station = recording[2]
    for frame in station.frames.values():
        near = (frame.depth > 0) & (frame.depth < 0.6)
        assert 0.05 < near.mean() < 0.6
        assert frame.color.std() > 20
        assert frame.depth.max() <= 3.02


def test_the_tripod_stays_within_its_errors() -> None:
    settings = CaptureSettings()
    poses = tripod_poses(400, 0, SEED_RIG, settings)
    head = SEED_RIG.cameras["middle"].rig_from_camera[:3, 3]
    heads = poses[:, :3, :3] @ head + poses[:, :3, 3] - head
    assert heads[0, 1] == pytest.approx(0.0)
    steps = np.diff(heads[:, 1])
    assert 0.085 <= steps.min() < 0.087
    assert 0.113 < steps.max() <= 0.115
    assert np.abs(heads[:, [0, 2]]).max() <= 0.01
    angles = [rotation_angle(p[:3, :3]) for p in poses]
    assert np.deg2rad(2.5) < max(angles) <= np.deg2rad(2.0) * np.sqrt(3) + 1e-3


def test_number_of_stations() -> None:
    assert len(simulate_recording(grown(), seed=0, rig=HALF, stations=3)) == 3
    assert len(simulate_recording(grown(), seed=0, rig=HALF, settings=CaptureSettings(step=0.05))) == 10


def test_without_errors_the_tripod_goes_straight() -> None:
    still = CaptureSettings(step_error=0.0, offset_error=0.0, angle_error=0.0)
    poses = tripod_poses(4, 0, SEED_RIG, still)
    np.testing.assert_allclose(poses[:, :3, :3], np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-15)
    np.testing.assert_allclose(poses[:, :3, 3], [[0, 0.1 * k, 0] for k in range(4)], atol=1e-15)


def test_bad_arguments() -> None:
    with pytest.raises(InvalidValueError, match="stations"):
        simulate_recording(grown(), seed=0, stations=0)
    with pytest.raises(GreenhouseError, match="seed"):
        simulate_recording(grown(), seed=-1)
