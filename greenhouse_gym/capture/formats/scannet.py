"""ScanNet's exported folders: ``color/``, ``depth/`` (millimetres), ``pose/`` and ``intrinsic/``, numbered alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from greenhouse_gym.capture.formats.image_lists import depth_partners, read_numbers, sorted_images
from greenhouse_gym.capture.formats.single_camera import Lens, Pair, video
from greenhouse_gym.capture.image_files import read_any_color, read_any_depth
from greenhouse_gym.capture.recordings import Recording, checked_pose
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.files import read_bytes
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, invert

name = "scannet"
description = "the folders color/, depth/, intrinsic/ and optionally pose/ as ScanNet exports them"

_COLOR, _DEPTH = "intrinsic_color.txt", "intrinsic_depth.txt"


def recognizes(path: Path) -> bool:
    """Return whether the folder has images and intrinsics of both cameras."""
    return all((path / part).is_dir() for part in ("color", "depth")) and (path / "intrinsic" / _COLOR).is_file()


def open(path: Path) -> Recording:
    """Open an exported folder of ScanNet; depth is aligned to color where the two cameras differ.

    Raises:
        FileFormatError: A file is missing or damaged. Images are checked when their station is read.
    """
    color = sorted_images((path / "color").glob("*"))
    depth = depth_partners(path / "depth", color)
    if not color:
        raise FileFormatError(path, "holds no color images")
    matrices = [path / "intrinsic" / name for name in (_COLOR, _DEPTH)]
    color_shape, depth_shape = read_any_color(color[0]).shape, read_any_depth(depth[0]).shape
    lenses = [Lens(_intrinsics(file, shape)) for file, shape in zip(matrices, (color_shape, depth_shape), strict=True)]
    extrinsics = [_matrix(path / "intrinsic" / f"extrinsic_{kind}.txt") for kind in ("color", "depth")]
    same = lenses[0].intrinsics == lenses[1].intrinsics
    pair = Pair(lenses[0], None if same else lenses[1], invert(extrinsics[0]) @ extrinsics[1])
    poses = [path / "pose" / f"{file.stem}.txt" for file in color]
    return video(path, pair, color, depth, [_pose(file) for file in poses], matrices)


def _intrinsics(file: Path, shape: tuple[int, ...]) -> Intrinsics:
    matrix = read_numbers(file, 4)
    if len(matrix) < 3:
        raise FileFormatError(file, f"expected a matrix of at least 3 rows, got {len(matrix)}")
    return Intrinsics(shape[1], shape[0], matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])


def _matrix(file: Path) -> Array:
    return checked_pose(file, "the matrix", read_numbers(file, 4)) if file.exists() else np.eye(4)


def _pose(file: Path) -> Array | None:
    """Read the pose of an image; None where tracking was lost, which is written as -inf."""
    if not file.exists() or b"inf" in read_bytes(file, "trajectory"):
        return None
    return checked_pose(file, "the pose", read_numbers(file, 4))
