from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from row_helpers import (
    black,
    from_stations,
    full_cloud,
    full_recording,
    grown,
    half_cloud,
    half_recording,
    true_poses,
)

from greenhouse_gym.accuracy import distance_to_truth, drift
from greenhouse_gym.capture import RgbdFrame, Station
from greenhouse_gym.errors import GreenhouseError, ReconstructionError
from greenhouse_gym.geometry import invert, pose, rotation_about, rotation_angle, transform
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, reconstruct_row
from greenhouse_gym.reconstruction.pair_registration import motion_problem, register_pair
from greenhouse_gym.reconstruction.station_views import Calibration, station_view

pytestmark = pytest.mark.xdist_group("row")  # the rows are rendered once

SETTINGS = ReconstructionSettings()
HEAD = np.array([0.0, 0.0, 1.1])  # of the reference camera in the rig frame


def motion_error(estimated: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Metres at the reference camera, radians."""
    moved = transform(estimated, HEAD[None]) - transform(true, HEAD[None])
    return float(np.linalg.norm(moved)), rotation_angle(estimated[:3, :3].T @ true[:3, :3])


def reconstructed(stations: Sequence[Station]) -> RowCloud:
    return reconstruct_row(from_stations(stations, half_recording()))


# -- against the truth ------------------------------------------------------------------------------------------------


def test_every_station_is_registered() -> None:
    row = full_cloud()
    assert row.registered.all()
    assert [report.against for report in row.report.stations] == [None, 0, 1, 2, 3]
    assert not any(report.reason for report in row.report.stations)
    np.testing.assert_array_equal(row.world_from_station[0], np.eye(4))


def test_neighboring_stations_are_registered_to_3_mm_and_a_third_of_a_degree() -> None:
    poses, true = full_cloud().world_from_station, true_poses(full_recording())
    for i in range(4):
        estimated = invert(poses[i]) @ poses[i + 1]
        distance, angle = motion_error(estimated, invert(true[i]) @ true[i + 1])
        assert distance < 0.003
        assert np.degrees(angle) < 0.3


def test_drift_is_a_small_share_of_the_way() -> None:
    found = drift(full_cloud(), true_poses(full_recording()))
    assert found.length == pytest.approx(0.4, abs=0.15)
    distance, _ = motion_error(
        full_cloud().world_from_station[-1],
        invert(true_poses(full_recording())[0]) @ true_poses(full_recording())[-1],
    )
    assert distance < 0.02 * found.length
    assert found.error < 0.03 * found.length


def test_the_cloud_lies_on_the_true_surfaces() -> None:
    distance = distance_to_truth(full_cloud(), grown(), true_poses(full_recording())[0])
    assert distance.mean() < 0.004
    assert np.quantile(distance, 0.95) < 0.015


def test_the_cloud_is_thinned_out_in_the_frame_of_the_first_station() -> None:
    row = full_cloud()
    n = len(row)
    assert n > 50_000
    assert row.points.shape == row.colors.shape == row.normals.shape == (n, 3)
    assert row.station.shape == (n,)
    assert set(np.unique(row.station)) == set(range(5))
    assert row.colors.min() >= 0.0
    assert row.colors.max() <= 1.0
    np.testing.assert_allclose(np.linalg.norm(row.normals, axis=1), 1.0, atol=1e-6)
    voxels = np.unique(np.floor((row.points - row.points.min(axis=0)) / 0.002).astype(int), axis=0)
    assert len(voxels) > 0.75 * n  # about one point per voxel
    assert row.points[:, 0].max() < 0.7  # the 60 cm cut; the row behind stands at 2.1 m
    assert row.report.points == n < row.report.merged_points
    looks_away = (row.normals * (row.points - [0.0, 0.2, 1.1])).sum(axis=1) > 0
    assert looks_away.mean() < 0.15  # normals point to the cameras


def test_the_same_recording_gives_the_same_row() -> None:
    again = reconstruct_row(half_recording())
    np.testing.assert_array_equal(again.world_from_station, half_cloud().world_from_station)
    np.testing.assert_array_equal(again.points, half_cloud().points)
    np.testing.assert_array_equal(again.station, half_cloud().station)


def test_progress_is_reported_and_true_poses_are_not_used() -> None:
    reported: list[int] = []
    stations = [Station(station.frames, None) for station in half_recording()]
    row = reconstruct_row(from_stations(stations[:3], half_recording()), on_station=reported.append)
    assert reported == [0, 1, 2]
    for i in range(2):
        a, b = row.world_from_station, half_cloud().world_from_station
        distance, _ = motion_error(invert(a[i]) @ a[i + 1], invert(b[i]) @ b[i + 1])
        assert distance < 0.004


def test_a_recording_in_the_other_direction_is_registered_too() -> None:
    there = half_cloud()
    back = reconstructed(list(half_recording())[::-1])
    assert back.registered.all()
    expected = invert(there.world_from_station[4]) @ there.world_from_station[0]
    distance, angle = motion_error(back.world_from_station[4], expected)
    assert distance < 0.01
    assert np.degrees(angle) < 1.0


# -- stations that cannot be registered -------------------------------------------------------------------------------


def test_a_black_station_is_skipped_and_the_next_tried_against_the_last_good_one() -> None:
    stations = list(half_recording())
    row = reconstructed([*stations[:2], black(stations[2]), *stations[3:]])
    np.testing.assert_array_equal(row.registered, [True, True, False, True, True])
    skipped, after = row.report.stations[2:4]
    assert "foreground" in skipped.reason
    assert not skipped.registered
    assert after.against == 1
    assert np.isnan(row.world_from_station[2]).all()
    assert 2 not in row.station
    true = true_poses(half_recording())
    distance, angle = motion_error(
        invert(row.world_from_station[1]) @ row.world_from_station[3], invert(true[1]) @ true[3]
    )
    assert distance < 0.006
    assert np.degrees(angle) < 0.6


def test_a_black_beginning_moves_the_frame_to_the_first_good_station() -> None:
    stations = list(half_recording())
    row = reconstructed([black(stations[0]), *stations[1:3]])
    np.testing.assert_array_equal(row.registered, [False, True, True])
    np.testing.assert_array_equal(row.world_from_station[1], np.eye(4))
    assert "0.0% foreground" in row.report.stations[0].reason


def test_only_the_reference_camera_black() -> None:
    stations = list(half_recording())[:3]
    frames = dict(stations[1].frames)
    frames["middle"] = black(stations[1]).frames["middle"]
    row = reconstructed([stations[0], Station(frames, None), stations[2]])
    np.testing.assert_array_equal(row.registered, [True, False, True])
    assert "foreground" in row.report.stations[1].reason


def test_the_other_cameras_black() -> None:
    stations = list(half_recording())[:2]
    frames = dict(black(stations[1]).frames)
    frames["middle"] = stations[1].frames["middle"]
    row = reconstructed([stations[0], Station(frames, None)])
    assert row.registered.all()


def test_only_black_stations_are_an_error_with_reasons() -> None:
    stations = [black(station) for station in half_recording()]
    with pytest.raises(ReconstructionError) as caught:
        reconstructed(stations)
    message = str(caught.value)
    assert "0 of 5 stations registered, at least 2 needed" in message
    for i in range(5):
        assert f"station {i}: camera 'middle': 0.0% foreground" in message


def test_one_good_station_among_black_ones_is_an_error() -> None:
    stations = [black(station) for station in half_recording()]
    stations[2] = half_recording()[2]
    with pytest.raises(ReconstructionError, match=r"0 of 5 stations.*station 3: camera 'middle': 0\.0% foreground"):
        reconstructed(stations)


def test_a_recording_without_stations_is_an_error() -> None:
    with pytest.raises(GreenhouseError):
        reconstructed([])


def test_a_station_photographed_twice_is_refused() -> None:
    stations = list(half_recording())
    row = reconstructed([stations[0], stations[1], stations[1], stations[2]])
    np.testing.assert_array_equal(row.registered, [True, True, False, True])
    assert row.report.stations[2].reason
    assert row.report.stations[3].against == 1


def test_a_station_that_jumped_by_40_cm_is_refused() -> None:
    stations = list(half_recording())
    with pytest.raises(ReconstructionError, match=r"0 of 2 stations registered.*station 1: \S"):
        reconstructed([stations[0], stations[4]])


def test_a_station_of_another_row_is_refused() -> None:
    stations = list(half_recording())
    upside_down = {
        name: RgbdFrame(f.color[:, ::-1].copy(), f.depth[:, ::-1].copy(), f.intrinsics)
        for name, f in stations[2].frames.items()
    }
    row = reconstructed([stations[0], stations[1], Station(upside_down, None), stations[2]])
    np.testing.assert_array_equal(row.registered, [True, True, False, True])


# -- plausibility -----------------------------------------------------------------------------------------------------


def about_head(turn: np.ndarray, shift: list[float]) -> np.ndarray:
    """A motion of the rig that turns about the reference camera and moves it."""
    return pose(turn, HEAD + shift - turn @ HEAD)


@pytest.mark.parametrize(
    ("motion", "steps", "reason"),
    [
        (about_head(np.eye(3), [0, 0.1, 0]), 1, ""),
        (about_head(np.eye(3), [0, -0.1, 0]), 1, ""),
        (about_head(rotation_about([1, 0, 0], 0.1), [0.02, 0.1, -0.02]), 1, ""),
        (about_head(np.eye(3), [0, 0.2, 0]), 1, "moved 20.0 cm along the row"),
        (about_head(np.eye(3), [0, 0.2, 0]), 2, ""),
        (about_head(np.eye(3), [0, 0.01, 0]), 1, "moved 1.0 cm along the row"),
        (about_head(np.eye(3), [0, 0.5, 0]), 5, "moved 50.0 cm along the row"),
        (about_head(rotation_about([0, 0, 1], 0.2), [0, 0.1, 0]), 1, "turned by 11.5 degrees"),
        (about_head(np.eye(3), [0.05, 0.1, 0.05]), 1, "moved 7.1 cm across the row"),
    ],
)
def test_motions_no_tripod_makes(motion: np.ndarray, steps: int, reason: str) -> None:
    found = motion_problem(motion, HEAD, steps, 0, SETTINGS)
    assert found.startswith(reason)
    assert bool(found) == bool(reason)


def test_the_tripod_keeps_its_direction() -> None:
    there, back = (about_head(np.eye(3), [0, step, 0]) for step in (0.1, -0.1))
    assert motion_problem(there, HEAD, 1, 1, SETTINGS) == motion_problem(back, HEAD, 1, -1, SETTINGS) == ""
    assert "opposite to the stations before" in motion_problem(back, HEAD, 1, 1, SETTINGS)
    assert "opposite to the stations before" in motion_problem(there, HEAD, 1, -1, SETTINGS)


def test_registration_says_how_it_went() -> None:
    known = Calibration(half_recording().rig)
    views = [station_view(half_recording()[i], known, SETTINGS) for i in (0, 1)]
    found = register_pair(views[0], views[1], 1, SETTINGS)
    assert found.accepted
    assert found.shift is not None
    assert found.offset is not None
    assert found.fitness > SETTINGS.min_fitness
    assert 0 < found.rmse < SETTINGS.max_rmse
    assert found.information is not None
    assert found.information.shape == (6, 6)
    np.testing.assert_array_equal(found.first_from_second, np.round(found.first_from_second, 9))
    back = register_pair(views[1], views[0], 1, SETTINGS)
    distance, angle = motion_error(back.first_from_second @ found.first_from_second, np.eye(4))
    assert distance < 0.004
    assert np.degrees(angle) < 0.5
    strict = ReconstructionSettings(min_fitness=0.999)
    refused = register_pair(views[0], views[1], 1, strict)
    assert not refused.accepted
    assert "fitness" in refused.reason
