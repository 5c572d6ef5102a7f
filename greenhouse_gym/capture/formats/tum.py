"""Folders of TUM and ETH3D: ``rgb.txt`` and ``depth.txt``, lines of a time and a file, 5000 units to the metre."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from greenhouse_gym.capture.formats.image_lists import POSE_TOLERANCE, nearest_in_time, read_numbers, read_poses
from greenhouse_gym.capture.formats.single_camera import Lens, Pair, video
from greenhouse_gym.capture.image_files import read_any_color
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.files import inside, parsing, read_bytes
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array

name = "tum"
description = "rgb.txt and depth.txt as of TUM and ETH3D, optionally groundtruth.txt and calibration.txt"

_SCALE = 1 / 5000
_SAME_MOMENT = 0.02  # s between two images of a pair
_CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
_USUAL = (525.0, 525.0, 319.5, 239.5)


def recognizes(path: Path) -> bool:
    """Return whether the folder has both lists."""
    return (path / "rgb.txt").is_file() and (path / "depth.txt").is_file()


def open(path: Path) -> Recording:
    """Open a folder of TUM or ETH3D: each color image with the depth image and the pose nearest in time.

    Raises:
        FileFormatError: A file is missing or damaged. Images are checked when their station is read.
    """
    color_times, color = _list(path, "rgb.txt")
    depth_times, depth = _list(path, "depth.txt")
    partner = nearest_in_time(color_times, depth_times, _SAME_MOMENT)
    paired = np.flatnonzero(partner >= 0)
    notes = []
    if len(paired) < len(color):
        notes.append(f"{len(color) - len(paired)} of {len(color)} color images have no depth image at their time")
    truth, calibration = path / "groundtruth.txt", path / "calibration.txt"
    times, poses = read_poses(truth) if truth.exists() else (np.zeros(0), np.zeros((0, 4, 4)))
    posed = nearest_in_time(color_times[paired], times, POSE_TOLERANCE)
    known: list[Array | None] = [poses[k] if k >= 0 else None for k in posed]
    if not calibration.exists() and not any(label in path.name for label in _CAMERAS):
        notes.append("no calibration.txt: taken as 640x480 with a focal length of 525 pixels")
    described_by = [path / "rgb.txt", path / "depth.txt", *(f for f in (truth, calibration) if f.exists())]
    pair = Pair(Lens(_intrinsics(path, calibration)), depth_scale=_SCALE)
    images = [color[k] for k in paired], [depth[k] for k in partner[paired]]
    return video(path, pair, *images, known, described_by, notes)


def _intrinsics(path: Path, calibration: Path) -> Intrinsics:
    if not calibration.exists():
        return Intrinsics(640, 480, *next((known for label, known in _CAMERAS.items() if label in path.name), _USUAL))
    with parsing(calibration, "calibration with fx fy cx cy, then perhaps the width and height of the images"):
        numbers = read_numbers(calibration, len(read_bytes(calibration, "calibration").split()))[0]
        width, height = (int(numbers[4]), int(numbers[5])) if len(numbers) >= 6 else _size(path)
        return Intrinsics(width, height, *numbers[:4].tolist())


def _size(path: Path) -> tuple[int, int]:
    """Return width and height of the first color image."""
    height, width = read_any_color(_list(path, "rgb.txt")[1][0]).shape[:2]
    return width, height


def _list(folder: Path, file: str) -> tuple[Array, list[Path]]:
    """Read times (n,) and files of a list, sorted by time."""
    with parsing(folder / file, "list of times and files"):
        lines = [line.split(maxsplit=1) for line in read_bytes(folder / file, "trajectory").decode().splitlines()]
        pairs = sorted((float(line[0]), line[1].strip()) for line in lines if line and not line[0].startswith("#"))
        if not pairs:
            raise FileFormatError(folder / file, "names no images")
        return np.array([t for t, _ in pairs]), [inside(folder, f, named_in=folder / file) for _, f in pairs]
