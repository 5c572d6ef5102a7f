"""Known poses are used as given, or corrected by the images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from row_helpers import from_stations, half_recording, true_poses

from greenhouse_gym.capture import Station
from greenhouse_gym.errors import ReconstructionError, UnknownNameError
from greenhouse_gym.geometry import Array, invert, pose, rotation_about
from greenhouse_gym.reconstruction import ReconstructionSettings, reconstruct_row
from greenhouse_gym.reconstruction.station_registration import register_stations

pytestmark = pytest.mark.xdist_group("row")
KNOWN = ReconstructionSettings(calibration_stations=0)


def posed(poses: list[Array | None]) -> object:
    stations = [Station(station.frames, place) for station, place in zip(half_recording(), poses, strict=False)]
    return from_stations(stations, half_recording())


def test_given_poses_are_believed() -> None:
    """Even if they say something that no tripod does: here the stations is three times as long."""
    stretched = [pose(translation=[0.0, 0.3 * k, 0.02 * k]) for k in range(3)]
    row = reconstruct_row(posed(stretched), KNOWN, poses="given")  # type: ignore[arg-type]
    assert row.registered.all()
    np.testing.assert_allclose(row.world_from_station, stretched, atol=1e-8)


def test_refined_poses_come_near_the_truth() -> None:
    true = true_poses(half_recording())[:3]
    off = [place @ pose(rotation_about([0, 1, 0], 0.004 * k), [0.0, 0.003 * k, 0.0]) for k, place in enumerate(true)]
    stations = register_stations(posed(list(off)), replace(KNOWN, poses="refine"))  # type: ignore[arg-type]
    assert set(stations.edges) >= {(0, 1), (1, 2)}
    for (i, j), edge in stations.edges.items():
        before, after = (np.abs(m - invert(true[i]) @ true[j])[:3, 3].max() for m in (invert(off[i]) @ off[j], edge[0]))
        assert after < 0.003
        assert before > after


def test_a_given_pose_stays_where_images_do_not_constrain_it() -> None:
    true = true_poses(half_recording())[:2]
    far = [true[0], true[1] @ pose(translation=[0.0, 0.5, 0.0])]
    stations = register_stations(posed(far), replace(KNOWN, poses="refine"))  # type: ignore[arg-type]
    np.testing.assert_allclose(stations.edges[0, 1].first_from_second, invert(far[0]) @ far[1], atol=1e-9)


def test_a_station_without_a_pose_is_skipped_and_named() -> None:
    true = true_poses(half_recording())[:3]
    stations = register_stations(posed([true[0], None, true[2]]), replace(KNOWN, poses="given"))  # type: ignore[arg-type]
    assert stations.segments == ((0, 2),)
    assert "pose is not known" in stations.reports[1].reason
    with pytest.raises(ReconstructionError, match="pose is not known"):
        register_stations(posed([None] * 3), replace(KNOWN, poses="given"))  # type: ignore[arg-type]


def test_unknown_ways_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="estimate, given, refine"):
        reconstruct_row(half_recording(), poses="guess")
