"""Camera poses of a rig without a board, from the surfaces that two of its cameras see at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.frames import RgbdFrame
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Camera, Rig
from greenhouse_gym.capture.rig_file import Mounting
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, invert, pose, transform
from greenhouse_gym.reconstruction.calibration import calibrate
from greenhouse_gym.reconstruction.fitting import settings_for

_DISTANCES = (0.03, 0.015, 0.005)  # m within which surfaces are paired, one calibration after the other
_STATIONS = 8
_SEARCH_STATIONS = 4  # by which a displaced camera is searched for
_EVERY = 6  # rows and columns of an image that are compared then
_TURNS = ((-0.07, -0.035, 0.0, 0.035, 0.07), (-0.0175, 0.0, 0.0175), (-0.009, 0.0, 0.009))  # rad, about each axis
_SAME_DEPTH = 0.008  # m between two readings of a point
_REQUIRED_GAIN = 1.15  # times as many readings must agree before a camera is taken as displaced


class OverlapCalibration(NamedTuple):
    """Camera poses, their rotation and translation against the rig (rad, m), and the gap that is left, m."""

    mounting: Mounting
    turned: dict[str, float]
    shifted: dict[str, float]
    gap: float


def calibrate_from_overlap(recording: Recording) -> OverlapCalibration:
    """Estimate camera poses with ever smaller distances, after a search for cameras turned by up to four degrees.

    Raises:
        InvalidValueError: The cameras see too little in common.
    """
    settings = replace(settings_for(recording), calibration_stations=_STATIONS, calibrate_rig=True)
    current = replace(recording, rig=_searched_rig(recording, settings.foreground))
    bias, gap = dict.fromkeys(recording.rig.cameras, 0.0), 0.0
    for distance in _DISTANCES:
        found, report = calibrate(current, replace(settings, fine_distance=max(distance, settings.fine_distance)))
        current, bias, gap = replace(current, rig=found.rig), dict(report.bias), report.gap_after
    if not gap:
        raise InvalidValueError(
            f"recording {recording.name!r}: the cameras {', '.join(recording.rig.cameras)} see too little in common"
        )
    mounting = replace(Mounting.of(current.rig), depth_error=bias)
    return OverlapCalibration(mounting, *mounting.difference(recording.rig), gap)


def _searched_rig(recording: Recording, foreground: float) -> Rig:
    """Turn each camera so that clearly more of its readings agree with those of the reference camera."""
    chosen = np.unique(np.linspace(0, len(recording) - 1, _SEARCH_STATIONS).round().astype(int))
    stations = [recording[i].frames for i in chosen.tolist()]
    rig = recording.rig
    reference = rig.cameras[rig.reference]
    cameras = dict(rig.cameras)
    for name in rig.cameras.keys() - {rig.reference}:
        pairs = [(frames[name], frames[rig.reference]) for frames in stations]
        points = [tuple(frame.grid_points(_EVERY, foreground) for frame in pair) for pair in pairs]
        before = best = _agreeing(cameras[name], reference, pairs, points)
        best_pose = cameras[name].rig_from_camera
        for turns in _TURNS:
            start = best_pose
            for turn in product(turns, repeat=3):
                turned = start @ pose(Rotation.from_rotvec(turn).as_matrix())
                agreeing = _agreeing(replace(cameras[name], rig_from_camera=turned), reference, pairs, points)
                if agreeing > best:
                    best, best_pose = agreeing, turned
        if best > _REQUIRED_GAIN * before:
            cameras[name] = replace(cameras[name], rig_from_camera=best_pose)
    return Rig(cameras, rig.reference)


def _agreeing(
    camera: Camera,
    reference: Camera,
    pairs: Sequence[tuple[RgbdFrame, RgbdFrame]],
    points: Sequence[tuple[Array, ...]],
) -> int:
    """Count the readings of either camera that the other one has at the same depth."""
    reference_from_camera = invert(reference.rig_from_camera) @ camera.rig_from_camera
    count = 0
    for (own, other), (own_points, other_points) in zip(pairs, points, strict=True):
        for target, moved in (
            (other, transform(reference_from_camera, own_points)),
            (own, transform(invert(reference_from_camera), other_points)),
        ):
            kept, rows, columns = target.intrinsics.project(moved)
            difference = np.abs(target.depth[rows, columns] - moved[kept, 2])
            count += int(np.count_nonzero(difference < _SAME_DEPTH))
    return count
