"""A calibrated camera's folders: ``rgb/``, ``depth/`` (millimetres), ``camera_*.yaml``, and poses where known."""

from __future__ import annotations

import json
import re
from pathlib import Path

from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.formats.single_camera import read_numbers, single_camera
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.files import parsing, read_bytes
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, pose

name = "calibrated"
description = "the folders rgb/ and depth/, camera_*.yaml, optionally groundtruth_handeye.txt"

_POSES = "groundtruth_handeye.txt"


def recognises(path: Path) -> bool:
    """Whether the folder has both folders of images and a calibration."""
    return (path / "rgb").is_dir() and (path / "depth").is_dir() and bool(_calibrations(path))


def open(path: Path) -> Recording:
    """Open such a folder.

    Raises:
        FileFormatError: A file is missing or damaged. Images are checked when their station is read.
    """
    calibration, *_ = _calibrations(path) or [path / "camera_*.yaml"]
    intrinsics = _intrinsics(calibration)
    color = sorted((path / "rgb").glob("*.png"))
    truth = path / _POSES
    poses = _poses(truth) if truth.exists() else {}
    for file in color:
        if poses and not file.stem.isdecimal():
            raise FileFormatError(file, f"expected a number as the image's name, by which {_POSES} gives its pose")
    return single_camera(
        path, intrinsics, color, [path / "depth" / file.name for file in color],
        [poses.get(int(file.stem)) if poses else None for file in color],
        described_by=[calibration, *([truth] if poses else [])],
    )  # fmt: skip


def _calibrations(path: Path) -> list[Path]:
    return sorted(path.glob("camera_*.yaml"))


def _intrinsics(path: Path) -> Intrinsics:
    with parsing(path, "calibration with image_width, image_height and a camera_matrix of nine numbers"):
        text = read_bytes(path, "calibration").decode()
        fields = dict(re.findall(r"^(\w+):\s*(\S.*)$", text, re.M))
        matrix = json.loads(fields["camera_matrix"])
        return Intrinsics(
            int(fields["image_width"]), int(fields["image_height"]), matrix[0], matrix[4], matrix[2], matrix[5]
        )


def _poses(path: Path) -> dict[int, Array]:
    """World from camera by the number of the image."""
    poses = {}
    for row in read_numbers(path, 8):
        if not row[4:8].any():
            raise FileFormatError(path, f"the quaternion of image {row[0]:.0f} is zero")
        with parsing(path, "list of poses"):
            poses[int(row[0])] = pose(Rotation.from_quat(row[4:8]).as_matrix(), row[1:4])
    return poses
