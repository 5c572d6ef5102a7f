"""Settings that find themselves: where the foreground ends, and how far the sensor's noise reaches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from greenhouse_gym.capture.frames import RgbdFrame
from greenhouse_gym.capture.protocols import PROTOCOLS
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Camera, Rig
from greenhouse_gym.errors import FileFormatError, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.foreground import foreground_mask, forward_distance
from greenhouse_gym.reconstruction.settings import ReconstructionSettings

_LOOKED_AT = 3  # stations
_BIN = 0.05  # m of distance
_FARTHEST = 4.0  # m
_EMPTY = 0.003  # share of the readings; less in a bin is no surface
_GAP = 2  # empty bins that part the plants from what is behind them
_SOMETHING = 0.02  # share of the readings that plants are at least
_ENOUGH = 0.5  # share of the plants' readings within the paper's cut with which it stays
_PLANTS = 0.85  # share of the plants' readings that another cut keeps
_PATCH = 0.03  # rad, side of the patches that tell noise
_FLATTEST = 0.25  # quantile of the patches, the flattest being those that show noise alone
_FEWEST_PATCHES = 40
_REACH, _SPREAD = 4.0, 2.0  # times the noise of a reading: where partners are looked for, and how far they may differ
_MAX_NOISE = 0.008  # m


def settings_for(recording: Recording) -> ReconstructionSettings:
    """The settings that fit a recording: those of the protocol it says it follows, or what its images tell.

    Where it names no protocol, the foreground ends behind the nearest things before a gap in depth; the paper's cut
    stays where that is about right. Where readings scatter more than those of the paper's cameras at arm's length,
    partners are looked for farther apart.

    Raises:
        UnknownNameError: The recording names a protocol that does not exist.
    """
    if recording.protocol is not None:
        require_choice(f"protocol of recording {recording.name!r}:", recording.protocol, PROTOCOLS)
    frames = _frames(recording)
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


def _frames(recording: Recording) -> list[RgbdFrame]:
    """The reference camera's images at a few stations spread over a recording; those that can be read."""
    frames = []
    for i in sorted({k * (len(recording) - 1) // max(1, _LOOKED_AT - 1) for k in range(_LOOKED_AT) if len(recording)}):
        try:
            frame = recording[i].frames.get(recording.rig.reference)
        except FileFormatError:
            continue  # the walk through the recording reports it
        if frame is not None:
            frames.append(frame)
    return frames


def foreground_cut(frames: Sequence[RgbdFrame], camera: Camera, usual: float) -> float:
    """Where the plants end, metres before the camera, by the distances of everything that it sees.

    Args:
        frames: Its images.
        camera: The reference camera.
        usual: The cut that stays if it parts plants from what is behind them just as well.
    """
    seen = [forward_distance(frame.depth, camera)[frame.depth > 0] for frame in frames]
    distances = np.concatenate([np.zeros(0), *seen])
    distances = distances[distances < _FARTHEST]
    if not len(distances):
        return usual
    share = np.histogram(distances, np.arange(0.0, _FARTHEST + _BIN, _BIN))[0] / len(distances)
    end = len(share)
    for k in range(len(share)):
        if share[:k].sum() > _SOMETHING and (share[k : k + _GAP] < _EMPTY).all():
            end = k
            break
    plants = distances[distances < end * _BIN]
    if usual <= end * _BIN + _GAP * _BIN and np.mean(plants < usual) >= _ENOUGH:
        return usual
    return float(np.ceil(100 * np.quantile(plants, _PLANTS)) / 100)


def sensor_noise(frames: Sequence[RgbdFrame], camera: Camera, rig: Rig, farthest: float) -> float:
    """One sigma of a reading in metres, by how the flattest small patches of the foreground scatter; 0 if unknown.

    Args:
        frames: Images of the camera.
        camera: The camera.
        rig: Its rig.
        farthest: Where the foreground ends, metres.
    """
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
        left = inverse - inverse @ np.linalg.pinv(plane).T @ plane.T
        found.append(left.std(axis=1) * patches.mean(axis=1) ** 2)
    sigmas = np.concatenate(found)
    return float(np.quantile(sigmas, _FLATTEST)) if len(sigmas) >= _FEWEST_PATCHES else 0.0
