"""Where the cameras of a rig stand, without a board: from the surfaces that two of them see at once."""

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
from greenhouse_gym.geometry import Array, invert, pose, rotation_angle, transform
from greenhouse_gym.reconstruction.calibration import calibrate
from greenhouse_gym.reconstruction.fitting import settings_for

_REACHES = (0.03, 0.015, 0.005)  # m within which surfaces are taken as one, ever nearer
_STATIONS = 8
_SEARCHED = 4  # stations by which a camera that was knocked is looked for
_EVERY = 6  # rows and columns of an image that are compared then
_TURNS = ((-0.07, -0.035, 0.0, 0.035, 0.07), (-0.0175, 0.0, 0.0175), (-0.009, 0.0, 0.009))  # rad, about each axis
_SAME = 0.008  # m between two readings of a place
_BETTER = 1.15  # times as many readings must agree before a camera is taken to be elsewhere


class OverlapCalibration(NamedTuple):
    """What the overlap told: where the cameras stand, how far off they were (rad, m), and the gap that is left, m."""

    mounting: Mounting
    turned: dict[str, float]
    shifted: dict[str, float]
    gap: float


def calibrate_from_overlap(recording: Recording) -> OverlapCalibration:
    """Where the cameras stand, found ever closer; one that was knocked by up to four degrees is searched for before.

    Raises:
        InvalidValueError: The cameras see too little in common.
    """
    settings = replace(settings_for(recording), calibration_stations=_STATIONS, calibrate_rig=True)
    current = replace(recording, rig=_searched(recording, settings.foreground))
    bias, gap = dict.fromkeys(recording.rig.cameras, 0.0), 0.0
    for reach in _REACHES:
        found, report = calibrate(current, replace(settings, fine_distance=max(reach, settings.fine_distance)))
        current, bias, gap = replace(current, rig=found.rig), dict(report.bias), report.gap_after
    if not gap:
        raise InvalidValueError(
            f"recording {recording.name!r}: the cameras {', '.join(recording.rig.cameras)} see too little in common"
        )
    apart = {
        name: invert(camera.rig_from_camera) @ current.rig.cameras[name].rig_from_camera
        for name, camera in recording.rig.cameras.items()
    }
    return OverlapCalibration(
        replace(Mounting.of(current.rig), depth_error=bias),
        {name: float(rotation_angle(each[:3, :3])) for name, each in apart.items()},
        {name: float(np.linalg.norm(each[:3, 3])) for name, each in apart.items()},
        gap,
    )  # fmt: skip


def _searched(recording: Recording, foreground: float) -> Rig:
    """The rig with each camera turned as far as makes clearly more of its readings agree with the reference's."""
    chosen = np.unique(np.linspace(0, len(recording) - 1, _SEARCHED).round().astype(int))
    stations = [recording[i].frames for i in chosen.tolist()]
    rig = recording.rig
    reference = rig.cameras[rig.reference]
    cameras = dict(rig.cameras)
    for name in rig.cameras.keys() - {rig.reference}:
        pairs = [(frames[name], frames[rig.reference]) for frames in stations]
        points = [tuple(_some_points(frame, foreground) for frame in pair) for pair in pairs]
        before = best = _agreeing(cameras[name], reference, pairs, points)
        place = cameras[name].rig_from_camera
        for turns in _TURNS:
            start = place
            for turn in product(turns, repeat=3):
                turned = start @ pose(Rotation.from_rotvec(turn).as_matrix())
                agreeing = _agreeing(replace(cameras[name], rig_from_camera=turned), reference, pairs, points)
                if agreeing > best:
                    best, place = agreeing, turned
        if best > _BETTER * before:
            cameras[name] = replace(cameras[name], rig_from_camera=place)
    return Rig(cameras, rig.reference)


def _agreeing(
    camera: Camera,
    reference: Camera,
    pairs: Sequence[tuple[RgbdFrame, RgbdFrame]],
    points: Sequence[tuple[Array, ...]],
) -> int:
    """How many readings of either camera the other one has at the same depth."""
    reference_from_camera = invert(reference.rig_from_camera) @ camera.rig_from_camera
    count = 0
    for (own, other), (seen, seen_there) in zip(pairs, points, strict=True):
        for there, moved in (
            (other, transform(reference_from_camera, seen)),
            (own, transform(invert(reference_from_camera), seen_there)),
        ):
            kept, rows, columns = there.intrinsics.project(moved)
            apart = np.abs(there.depth[rows, columns] - moved[kept, 2])
            count += int(np.count_nonzero(apart < _SAME))
    return count


def _some_points(frame: RgbdFrame, foreground: float) -> Array:
    grid = np.zeros(frame.depth.shape, dtype=bool)
    grid[::_EVERY, ::_EVERY] = True
    return frame.points(grid & (frame.depth < foreground))
