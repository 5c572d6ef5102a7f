"""Settings of the reconstruction, with the paper's values where it names one, and settings fitted to a recording.

Fitted are the cut of the foreground, and tolerances for the sensor's noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import Field

from greenhouse_gym.capture.protocols import PROTOCOLS, CaptureProtocol
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Camera, RgbdFrame, Rig
from greenhouse_gym.common.settings_files import Count, Fraction, Positive, check_numbers
from greenhouse_gym.errors import FileFormatError, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.foreground import foreground_mask, forward_distance

Poses = Literal["estimate", "given", "refine"]
POSES: tuple[str, ...] = get_args(Poses)

_STATIONS = 3  # by which settings are fitted
_BIN = 0.05  # m of distance
_FARTHEST = 4.0  # m
_EMPTY_BIN = 0.003  # fraction of the readings below which a bin holds no surface
_GAP = 2  # empty bins between the plants and what is behind them
_MIN_PLANTS = 0.02  # fraction of the readings
_MIN_WITHIN_USUAL = 0.5  # fraction of the plants' readings within the paper's cut for which it is kept
_KEPT_PLANTS = 0.85  # fraction of the plants' readings that another cut keeps
_PATCH = 0.03  # rad, side of the patches by which noise is measured
_FLATTEST = 0.25  # quantile of the patches; the flattest ones show noise alone
_MIN_PATCHES = 40
_REACH, _SPREAD = 4.0, 2.0  # distance of partners and accepted RMSE in sigmas of a reading
_MAX_NOISE = 0.008  # m


@dataclass(frozen=True)
class ReconstructionSettings:
    """Settings by which a recording becomes a row.

    Raises:
        InvalidValueError: A value is out of its bounds, such as the size of a voxel that is not positive.
        UnknownNameError: ``poses`` is not a known choice.
    """

    foreground: Positive = 0.60  # m, the paper's cut
    poses: Poses = "estimate"  # of the stations: estimated, given by the recording, or given and refined
    # registration
    fine_distance: Positive = 0.005  # m within which ICP pairs points of surfaces that face the same way
    links: tuple[Annotated[int, Field(ge=2)], ...] = (2, 3)  # also register stations that many steps apart
    # acceptance
    step_range: tuple[float, float] = (0.03, 0.15)  # m that the tripod may move from one station to the next
    min_overlap: Fraction = 0.15  # fraction of the points that the other station could see
    min_fitness: Fraction = 0.6  # fraction of those points with a partner within fine_distance
    max_rmse: Positive = 0.0025  # m along the normals of those partners
    max_contradicted: Fraction = 0.10  # fraction of the points in view of both that one station sees through
    max_rotation: Positive = 0.14  # rad between two stations, twice the tripod's +-2 degrees about each axis
    max_sideways: Positive = 0.06  # m across the row between two stations
    # calibration of the cameras
    calibration_stations: Count = 5  # by which depth errors and the rig are estimated; 0 = none
    calibrate_rig: bool = True  # also the camera poses, if that explains the overlap notably better
    calibrate_edges: bool = True  # also the edge fattening, where the photographs show it
    # the merged cloud
    voxel: Positive = 0.002  # m, one point of the cloud per cube of this size

    def __post_init__(self) -> None:
        require_choice("source of station poses", self.poses, POSES)
        check_numbers(self)

    @classmethod
    def of(cls, protocol: CaptureProtocol) -> ReconstructionSettings:
        """Return the settings that fit a protocol: the cut behind its plants, and tolerances for its distance.

        A stereo camera's noise grows with the square of the distance; neighboring pixels share it, so distances between
        partners and accepted errors scale with the distance alone.
        """
        usual = cls()
        farther = protocol.distance / PROTOCOLS["paper"].distance
        return cls(
            foreground=protocol.foreground,
            fine_distance=usual.fine_distance * farther,
            max_rmse=usual.max_rmse * farther,
        )


def settings_for(recording: Recording) -> ReconstructionSettings:
    """Return the settings that fit a recording: those of the protocol it names, or fitted to its images.

    Where it names no protocol, the foreground ends behind the nearest surfaces before a gap in depth; the paper's cut
    is kept where it is about right. Where readings are noisier than those of the paper's cameras at arm's length,
    partners may be farther apart.

    Raises:
        UnknownNameError: The recording names a protocol that does not exist.
    """
    if recording.protocol is not None:
        require_choice(f"protocol of recording {recording.name!r}:", recording.protocol, PROTOCOLS)
    frames = _reference_frames(recording)
    camera = recording.rig.cameras[recording.rig.reference]
    if recording.protocol is not None:
        settings = ReconstructionSettings.of(PROTOCOLS[recording.protocol])
    else:
        settings = ReconstructionSettings()
        settings = replace(settings, foreground=foreground_cut(frames, camera, settings.foreground))
    noise = min(sensor_noise(frames, camera, recording.rig, settings.foreground), _MAX_NOISE)
    return replace(
        settings,
        fine_distance=max(settings.fine_distance, round(_REACH * noise, 4)),
        max_rmse=max(settings.max_rmse, round(_SPREAD * noise, 5)),
    )


def _reference_frames(recording: Recording) -> list[RgbdFrame]:
    """Read the reference camera's images at stations spread over a recording; unreadable ones are left out."""
    frames = []
    for i in sorted({k * (len(recording) - 1) // max(1, _STATIONS - 1) for k in range(_STATIONS) if len(recording)}):
        try:
            frame = recording[i].frames.get(recording.rig.reference)
        except FileFormatError:
            continue  # station registration reports it
        if frame is not None:
            frames.append(frame)
    return frames


def foreground_cut(frames: Sequence[RgbdFrame], camera: Camera, usual: float) -> float:
    """Return the distance at which the plants end, metres before the camera, from the histogram of its readings.

    The ``usual`` cut is kept if it separates plants from the background about as well.
    """
    read = [forward_distance(frame.depth, camera)[frame.depth > 0] for frame in frames]
    distances = np.concatenate([np.zeros(0), *read])
    distances = distances[distances < _FARTHEST]
    if not len(distances):
        return usual
    histogram = np.histogram(distances, np.arange(0.0, _FARTHEST + _BIN, _BIN))[0] / len(distances)
    end = len(histogram)
    for k in range(len(histogram)):
        if histogram[:k].sum() > _MIN_PLANTS and (histogram[k : k + _GAP] < _EMPTY_BIN).all():
            end = k
            break
    plants = distances[distances < end * _BIN]
    if usual <= end * _BIN + _GAP * _BIN and np.mean(plants < usual) >= _MIN_WITHIN_USUAL:
        return usual
    return float(np.ceil(100 * np.quantile(plants, _KEPT_PLANTS)) / 100)


def sensor_noise(frames: Sequence[RgbdFrame], camera: Camera, rig: Rig, farthest: float) -> float:
    """Return one sigma of a reading in metres, from the residuals of flat patches of the foreground; 0 if unknown."""
    found: list[Array] = [np.zeros(0)]
    for frame in frames:
        side = max(5, round(_PATCH * frame.intrinsics.fx))
        depth = np.where(foreground_mask(frame.depth, camera, rig, farthest), frame.depth, 0.0)
        rows, columns = depth.shape[0] // side, depth.shape[1] // side
        blocks = depth[: rows * side, : columns * side].reshape(rows, side, columns, side)
        patches = blocks.swapaxes(1, 2).reshape(-1, side * side)
        patches = patches[(patches > 0).all(axis=1)]
        v, u = np.divmod(np.arange(side * side), side)
        plane = np.column_stack([u, v, np.ones(side * side)])
        inverse = 1.0 / patches  # a plane is linear in it
        residual = inverse - inverse @ np.linalg.pinv(plane).T @ plane.T
        found.append(residual.std(axis=1) * patches.mean(axis=1) ** 2)
    sigmas = np.concatenate(found)
    return float(np.quantile(sigmas, _FLATTEST)) if len(sigmas) >= _MIN_PATCHES else 0.0
