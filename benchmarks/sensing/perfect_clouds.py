"""Clouds of perfect cameras at known poses, free of errors of sensors and registration."""

from __future__ import annotations

import numpy as np

from greenhouse_gym.capture import CaptureSettings, Recording, StereoDropout, StereoNoise
from greenhouse_gym.geometry import invert
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud
from greenhouse_gym.reconstruction.report import RowReport
from greenhouse_gym.reconstruction.row_cloud import find_outliers, merge_stations, remove_outliers
from greenhouse_gym.reconstruction.station_views import Calibration, station_view

NOISE_FREE = CaptureSettings(
    color_noise=0.0,
    noise=StereoNoise(
        disparity_noise=0.0,
        disparity_step=0.0,
        depth_unit=0.0,
        bias=0.0,
        dropout=0.0,
        edge_dropout=0.0,
        edge_fattening=0,
    ),
    dropout=StereoDropout(thin_dropout=0.0, mixed=0.0, glare_dropout=0.0, exposure_dropout=0.0),
)
"""The usual walk with cameras that measure without error (points hidden from one of the two imagers stay holes)."""


def perfect_cloud(recording: Recording, settings: ReconstructionSettings | None = None) -> RowCloud:
    """Merge a recording's stations at their true poses as `reconstruct_row` merges them."""
    settings = settings or ReconstructionSettings()
    clouds, min_depths, poses = {}, {}, []
    for i, station in enumerate(recording):
        assert station.world_from_station is not None
        view = station_view(station, Calibration(recording.rig), settings)
        clouds[i], poses = view.packed_cloud(), [*poses, station.world_from_station]
        min_depths[i] = view.min_depths()
    relative = np.array([invert(poses[0]) @ pose for pose in poses])
    merged = merge_stations(clouds, relative, settings)
    cloud = merged.cloud
    row = RowCloud(
        cloud.points, cloud.colors, cloud.normals, merged.station, np.ones(len(poses), dtype=bool), relative,
        RowReport(()),
    )  # fmt: skip
    return remove_outliers(row, find_outliers(merged, relative, min_depths, recording.rig, settings))
