"""A calibrated camera's folders: ``rgb/``, ``depth/`` (millimetres), ``camera_*.yaml``, and poses where known."""

from __future__ import annotations

import json
import re
from pathlib import Path

from greenhouse_gym.capture.formats.image_lists import depth_partners, read_poses, sorted_images
from greenhouse_gym.capture.formats.single_camera import Lens, Pair, distorted_lens, video
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.files import parsing, read_bytes
from greenhouse_gym.errors import FileFormatError

name = "calibrated"
description = "the folders rgb/ and depth/, camera_*.yaml, optionally groundtruth_handeye.txt"

_POSES = "groundtruth_handeye.txt"
_NUMBERS = ("image_width", "image_height", "camera_matrix", "distortion_coefficients")
_BARE_POINT = re.compile(r"\.(?=[\s,\]eE])")  # as OpenCV writes 10.
_FIELD = re.compile(r"^(\w+):\s*(?:!!\S+\s*)?(?:rows:.*\s+cols:.*\s+(?:dt:.*\s+)?data:\s*)?(\[[^\]]*\]|\S.*)$", re.M)


def recognizes(path: Path) -> bool:
    """Return whether the folder has both folders of images and a calibration."""
    return (path / "rgb").is_dir() and (path / "depth").is_dir() and bool(_calibrations(path))


def open(path: Path) -> Recording:
    """Open the folders of a calibrated camera.

    Raises:
        FileFormatError: A file is missing or damaged. Images are checked when their station is read.
    """
    calibration, *_ = _calibrations(path) or [path / "camera_*.yaml"]
    pair = Pair(_lens(calibration))
    color = sorted_images((path / "rgb").glob("*"))
    depth = depth_partners(path / "depth", color)
    truth = path / _POSES
    if not truth.exists():
        return video(path, pair, color, depth, [None] * len(color), [calibration])
    for file in color:
        if not file.stem.isdecimal():
            raise FileFormatError(file, f"expected a number as the image's name, by which {_POSES} gives its pose")
    ids, matrices = read_poses(truth)
    if len(set(ids)) < len(ids) or (ids != ids.round()).any():
        raise FileFormatError(truth, "expected a different whole number as the id of each pose")
    poses = dict(zip(ids.astype(int).tolist(), matrices, strict=True))
    known = [poses.get(int(file.stem)) for file in color]
    return video(path, pair, color, depth, known, [calibration, truth])


def _calibrations(path: Path) -> list[Path]:
    return sorted(path.glob("camera_*.yaml"))


def _lens(path: Path) -> Lens:
    """Read a calibration as ROS and OpenCV write it: matrices as lists, or as ``data`` below rows and columns."""
    with parsing(path, "calibration with image_width, image_height and a camera_matrix of nine numbers"):
        text = read_bytes(path, "calibration").decode()
        fields = dict(_FIELD.findall(text))
        values = {key: json.loads(_BARE_POINT.sub(".0", value)) for key, value in fields.items() if key in _NUMBERS}
        width, height, k = (values[key] for key in _NUMBERS[:3])
        distortion = values.get("distortion_coefficients", [])
        model = fields.get("distortion_model", "").strip("\"' ")
        return distorted_lens(path, Intrinsics(int(width), int(height), k[0], k[4], k[2], k[5]), distortion, model)
