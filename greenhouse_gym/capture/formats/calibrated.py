"""A calibrated camera's folders: ``rgb/``, ``depth/`` (millimetres), ``camera_*.yaml``, and poses where known."""

from __future__ import annotations

import json
import re
from pathlib import Path

from greenhouse_gym.capture.formats.single_camera import single_camera
from greenhouse_gym.capture.formats.trajectories import read_poses
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.files import natural_order, parsing, read_bytes
from greenhouse_gym.errors import FileFormatError

name = "calibrated"
description = "the folders rgb/ and depth/, camera_*.yaml, optionally groundtruth_handeye.txt"

_POSES = "groundtruth_handeye.txt"


def recognizes(path: Path) -> bool:
    """Return whether the folder has both folders of images and a calibration."""
    return (path / "rgb").is_dir() and (path / "depth").is_dir() and bool(_calibrations(path))


def open(path: Path) -> Recording:
    """Open such a folder.

    Raises:
        FileFormatError: A file is missing or damaged. Images are checked when their station is read.
    """
    calibration, *_ = _calibrations(path) or [path / "camera_*.yaml"]
    intrinsics = _intrinsics(calibration)
    color = sorted((path / "rgb").glob("*.png"), key=natural_order)
    depth = [path / "depth" / file.name for file in color]
    truth = path / _POSES
    if not truth.exists():
        return single_camera(path, intrinsics, color, depth, described_by=[calibration])
    for file in color:
        if not file.stem.isdecimal():
            raise FileFormatError(file, f"expected a number as the image's name, by which {_POSES} gives its pose")
    numbers, matrices = read_poses(truth)
    poses = dict(zip(numbers.astype(int).tolist(), matrices, strict=True))
    known = [poses.get(int(file.stem)) for file in color]
    return single_camera(path, intrinsics, color, depth, known, described_by=[calibration, truth])


def _calibrations(path: Path) -> list[Path]:
    return sorted(path.glob("camera_*.yaml"))


def _intrinsics(path: Path) -> Intrinsics:
    with parsing(path, "calibration with image_width, image_height and a camera_matrix of nine numbers"):
        text = read_bytes(path, "calibration").decode()
        fields = dict(re.findall(r"^(\w+):\s*(\S.*)$", text, re.M))
        width, height, k = (json.loads(fields[key]) for key in ("image_width", "image_height", "camera_matrix"))
        return Intrinsics(int(width), int(height), k[0], k[4], k[2], k[5])
