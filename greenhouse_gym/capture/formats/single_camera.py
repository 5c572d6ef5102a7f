"""Recordings of one hand-held camera, whatever their files are called.

The camera becomes a rig of one: the rig frame sits in the camera with x forward and z up in the image, so that
reconstruction finds the same conventions as with a tripod.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from greenhouse_gym.capture.frames import Station
from greenhouse_gym.capture.recordings import Recording, read_frame
from greenhouse_gym.capture.rig import Camera, Intrinsics, Rig
from greenhouse_gym.common.files import parsing, read_bytes
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, pose

RIG_FROM_CAMERA = pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
"""Where the camera of a rig of one stands in the rig's frame."""

CAMERA = "camera"
"""The name of that camera."""


def single_camera(
    folder: Path,
    intrinsics: Intrinsics,
    color: Sequence[Path],
    depth: Sequence[Path],
    world_from_camera: Sequence[Array | None] | None = None,
    depth_scale: float = 0.001,
    described_by: Sequence[Path] = (),
) -> Recording:
    """A recording of one camera from the names of its images.

    Args:
        folder: Where it lies; its name becomes the recording's.
        intrinsics: The camera's intrinsics.
        color: The color images, one per station.
        depth: The depth images, as many.
        world_from_camera: (4, 4) true pose of the camera at each station, or None where it is not known.
        depth_scale: Metres per unit of the depth images.
        described_by: The files that intrinsics and poses come from.

    Raises:
        FileFormatError: There are no images, or the lists differ in length.
    """
    poses = [None] * len(color) if world_from_camera is None else world_from_camera
    if not color:
        raise FileFormatError(folder, "holds no color images")
    if not len(color) == len(depth) == len(poses):
        raise FileFormatError(folder, f"{len(color)} color images, {len(depth)} depth images, {len(poses)} poses")
    camera = Camera(intrinsics, RIG_FROM_CAMERA, depth_scale)
    load = partial(_station, color, depth, camera, poses)
    rig = Rig({CAMERA: camera}, CAMERA)
    files = (*described_by, *color, *depth)
    return Recording(folder.name, rig, len(color), load, folder, files=files, of_camera=True)


def _station(
    color: Sequence[Path], depth: Sequence[Path], camera: Camera, poses: Sequence[Array | None], i: int
) -> Station:
    known = poses[i]
    frame = read_frame(color[i], depth[i], camera)
    return Station({CAMERA: frame}, None if known is None else known @ RIG_FROM_CAMERA.T)


def read_numbers(path: Path, columns: int) -> Array:
    """A text file of numbers (lines, columns), lines without any, and those that begin with #, left out.

    Raises:
        FileFormatError: The file cannot be read, or holds something else.
    """
    with parsing(path, f"file of {columns} numbers a line"):
        lines = [line.split() for line in read_bytes(path, "trajectory").decode().splitlines()]
        rows = np.array([list(map(float, line)) for line in lines if line and line[0][0] != "#"])
        if rows.ndim != 2 or rows.shape[1] != columns:
            raise ValueError(f"shape {rows.shape}")
        if not np.isfinite(rows).all():
            raise ValueError("not all are finite")
    return rows
