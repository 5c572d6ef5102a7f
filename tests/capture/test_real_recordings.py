"""Real recordings, where the environment variable GREENHOUSE_GYM_REAL_DATA names a folder that holds them."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from greenhouse_gym.capture import Intrinsics, Recording, open_recording
from greenhouse_gym.geometry import is_rotation, transform

FOLDER = Path(os.environ.get("GREENHOUSE_GYM_REAL_DATA", "/nonexistent"))
pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason="GREENHOUSE_GYM_REAL_DATA names no folder with real recordings"
)


@pytest.fixture(scope="module")
def table() -> Recording:
    return open_recording(FOLDER / "d435_table")


def test_the_d435_table_opens(table: Recording) -> None:
    assert len(table) == 16
    intrinsics = table.rig.cameras["camera"].intrinsics
    assert (intrinsics.width, intrinsics.height) == (1280, 720)
    numbers = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]
    np.testing.assert_allclose(numbers, [906.298, 905.149, 625.689, 355.472], atol=1e-3)


def test_its_clouds_are_metric(table: Recording) -> None:
    for i in (0, 7, 15):
        frame = table[i].frames["camera"]
        points = frame.points()
        assert frame.color.shape == (720, 1280, 3)
        assert frame.color.std() > 20
        assert len(points) > 0.5 * frame.depth.size
        assert points[:, 2].min() > 0.15
        middle = frame.depth[260:460, 530:750]
        assert np.median(middle[middle > 0]) == pytest.approx(0.54, abs=0.08)
        assert np.ptp(np.quantile(points[:, 0], [0.02, 0.98])) < 3.0


def test_its_poses_are_rotations_some_ten_centimetres_apart(table: Recording) -> None:
    poses = [station.world_from_station for station in table]
    assert all(pose is not None and is_rotation(pose[:3, :3]) for pose in poses)
    steps = np.linalg.norm(np.diff([pose[:3, 3] for pose in poses if pose is not None], axis=0), axis=1)
    assert 0.05 < np.median(steps) < 0.2


def test_its_poses_put_the_table_in_one_plane(table: Recording) -> None:
    """Stations seen through their true poses agree on where the object stands."""
    middles = []
    for i in range(0, 16, 3):
        station = table[i]
        assert station.world_from_station is not None
        world_from_camera = station.world_from_station @ table.rig.cameras["camera"].rig_from_camera
        frame = station.frames["camera"]
        mask = np.zeros(frame.depth.shape, bool)
        mask[310:410, 590:690] = True
        middles.append(np.median(transform(world_from_camera, frame.points(mask)), axis=0))
    assert np.ptp(middles, axis=0).max() < 0.3


def test_the_open3d_frames_open() -> None:
    recording = open_recording(FOLDER / "open3d_rgbd")
    assert len(recording) == 5
    assert recording.rig.cameras["camera"].intrinsics == Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
    for station in recording:
        assert station.world_from_station is not None
        assert is_rotation(station.world_from_station[:3, :3], tolerance=1e-4)
        frame = station.frames["camera"]
        depth = frame.depth[frame.depth > 0]
        assert 0.5 < np.median(depth) < 4.0
        assert depth.max() < 10.0
        assert len(frame.points()) == len(depth)


def test_neighboring_open3d_frames_overlap_through_their_poses() -> None:
    recording = open_recording(FOLDER / "open3d_rgbd")
    clouds = []
    for i in (0, 1):
        station = recording[i]
        assert station.world_from_station is not None
        points = station.frames["camera"].points()
        clouds.append(transform(station.world_from_station @ recording.rig.cameras["camera"].rig_from_camera, points))
    nearest, _ = cKDTree(clouds[1]).query(clouds[0][::50])
    assert np.median(nearest) < 0.02
