"""Rig files: camera poses of a rig, as ``calibrate`` writes them and ``import`` reads them.

reference: middle
cameras:
middle: {rig_from_camera: [[...], [...], [...], [0, 0, 0, 1]], depth_error: 0.001}
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from greenhouse_gym.capture.recordings import Recording, checked_pose
from greenhouse_gym.capture.rig import RgbdFrame, Rig, Station
from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import parsing, read_bytes, write_atomically
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.geometry import Array, invert, rotation_angle

with needs("reconstruct"):
    import yaml


@dataclass(frozen=True, eq=False)
class Mounting:
    """Camera poses of a rig, without the lenses; a camera reports ``(1 + depth_error)`` times the depth."""

    rig_from_camera: Mapping[str, Array]  # (4, 4) pose of each camera in the rig frame, metres
    reference: str  # the camera whose silhouettes align the stations
    depth_error: Mapping[str, float] = field(default_factory=dict)  # relative, where known

    @classmethod
    def of(cls, rig: Rig) -> Mounting:
        """Return the camera poses of a rig."""
        return cls({name: camera.rig_from_camera for name, camera in rig.cameras.items()}, rig.reference)

    def difference(self, rig: Rig) -> tuple[dict[str, float], dict[str, float]]:
        """Return the rotation, radians, and the translation, metres, of each camera against a rig."""
        moved = {
            name: invert(camera.rig_from_camera) @ self.rig_from_camera[name] for name, camera in rig.cameras.items()
        }
        turned = {name: float(rotation_angle(each[:3, :3])) for name, each in moved.items()}
        return turned, {name: float(np.linalg.norm(each[:3, 3])) for name, each in moved.items()}


class _Camera(BaseModel):
    model_config = ConfigDict(extra="forbid")
    rig_from_camera: Annotated[list[list[float]], Field(min_length=4, max_length=4)]
    depth_error: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid")
    reference: str
    cameras: Annotated[dict[str, _Camera], Field(min_length=1)]


def load_mounting(path: str | Path) -> Mounting:
    """Read a rig file.

    Raises:
        FileFormatError: It is missing, damaged, or its reference is none of its cameras.
    """
    path = Path(path)
    with parsing(path, "rig file"):
        file = _File.model_validate(yaml.safe_load(read_bytes(path, "settings")))
    if file.reference not in file.cameras:
        raise FileFormatError(path, f"reference {file.reference!r} is none of its cameras {', '.join(file.cameras)}")
    return Mounting(
        {
            name: checked_pose(path, f"{name}: rig_from_camera", camera.rig_from_camera)
            for name, camera in file.cameras.items()
        },
        file.reference,
        {name: camera.depth_error for name, camera in file.cameras.items() if camera.depth_error},
    )


def save_mounting(mounting: Mounting, path: str | Path) -> Path:
    """Write a rig file."""
    cameras = {
        name: {"rig_from_camera": np.round(matrix, 9).tolist(), "depth_error": mounting.depth_error.get(name, 0.0)}
        for name, matrix in mounting.rig_from_camera.items()
    }
    content = {"reference": mounting.reference, "cameras": cameras}
    return write_atomically(path, yaml.safe_dump(content, sort_keys=False, default_flow_style=None))


def with_mounting(recording: Recording, mounting: Mounting) -> Recording:
    """Return the recording with the camera poses of a rig file; cameras that the file does not name are left out.

    Raises:
        InvalidValueError: The recording lacks a camera of the file, or the file lacks the one with known poses.
    """
    rig = mounted_rig(recording.rig, mounting)
    old_from_new = None
    if recording.camera_poses:
        camera = recording.rig.reference
        if camera not in rig.cameras:
            raise InvalidValueError(f"the rig file leaves out the camera {camera}, whose poses the recording gives")
        old_from_new = recording.rig.cameras[camera].rig_from_camera @ invert(rig.cameras[camera].rig_from_camera)
    load = _Subset(recording, tuple(rig.cameras), old_from_new)
    return replace(recording, rig=rig, load=load, camera_poses=False)


def mounted_rig(rig: Rig, mounting: Mounting) -> Rig:
    """Return the rig with the camera poses of a rig file; cameras that the file does not name are left out.

    Raises:
        InvalidValueError: A camera of the file is missing.
    """
    missing = mounting.rig_from_camera.keys() - rig.cameras.keys()
    if missing:
        raise InvalidValueError(
            f"the rig file has the camera {', '.join(sorted(missing))}; the recording has only {', '.join(rig.cameras)}"
        )
    poses = mounting.rig_from_camera.items()
    return Rig({name: replace(rig.cameras[name], rig_from_camera=matrix) for name, matrix in poses}, mounting.reference)


@dataclass(frozen=True, eq=False)
class _Subset:
    """Reader of stations with a subset of their cameras, and with another rig frame."""

    recording: Recording
    names: tuple[str, ...]
    old_from_new: Array | None

    def __call__(self, i: int) -> Station:
        station = self.recording[i]
        known = station.world_from_station
        if known is not None and self.old_from_new is not None:
            known = known @ self.old_from_new
        return Station({name: station.frames[name] for name in self.names}, known)

    def camera(self, i: int, name: str) -> RgbdFrame:
        return self.recording.frame(i, name)
