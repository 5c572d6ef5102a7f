"""Where the cameras of a rig stand, without a board: from the surfaces that two of them see at once."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig_file import Mounting
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import invert, rotation_angle
from greenhouse_gym.reconstruction.calibration import calibrate
from greenhouse_gym.reconstruction.fitting import settings_for

_REACHES = (0.03, 0.015, 0.005)  # m within which surfaces are taken as one, ever nearer
_STATIONS = 8


class OverlapCalibration(NamedTuple):
    """What the overlap told: where the cameras stand, how far off they were (rad, m), and the gap that is left, m."""

    mounting: Mounting
    turned: dict[str, float]
    shifted: dict[str, float]
    gap: float


def calibrate_from_overlap(recording: Recording) -> OverlapCalibration:
    """Where the cameras stand, found ever closer, so that one that was knocked by a few degrees is found as well.

    Raises:
        InvalidValueError: The cameras see too little in common.
    """
    settings = replace(settings_for(recording), calibration_stations=_STATIONS, calibrate_rig=True)
    current, bias, gap = recording, dict.fromkeys(recording.rig.cameras, 0.0), 0.0
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
