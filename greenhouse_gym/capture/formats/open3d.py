"""Open3D's RGB-D folders: ``color/``, ``depth/`` (millimetres), and camera and trajectory where they are known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field

from greenhouse_gym.capture.formats.image_lists import depth_partners, numbers, sorted_images
from greenhouse_gym.capture.formats.own import INDEX
from greenhouse_gym.capture.formats.single_camera import Lens, Pair, video
from greenhouse_gym.capture.recordings import Recording, checked_pose
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.files import parsing, read_bytes
from greenhouse_gym.geometry import Array

name = "open3d"
description = "the folders color/ and depth/, optionally camera*.json or intrinsic.json, and trajectory.log"

PRIMESENSE = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
"""Intrinsics that Open3D assumes for RGB-D folders without any."""


class _CameraFile(BaseModel):
    """Open3D's camera; the matrix is stored column by column."""

    width: int
    height: int
    intrinsic_matrix: list[float] = Field(min_length=9, max_length=9)


def recognizes(path: Path) -> bool:
    """Return whether the folder, or ``RGBD`` in it, has both folders of images, and no index of another format."""
    folder = _inner(path)
    described = any((folder / other).exists() for other in (INDEX, "cameras.yaml", "intrinsic"))
    return not described and (folder / "depth").is_dir() and bool(_color_images(folder))


def open(path: Path) -> Recording:
    """Open an RGB-D folder of Open3D.

    Raises:
        FileFormatError: A file is missing or damaged. Images are checked when their station is read.
    """
    folder = _inner(path)
    color = _color_images(folder)
    cameras = [*sorted(folder.glob("camera*.json")), *sorted(folder.glob("intrinsic*.json"))][:1]
    trajectory = folder / "trajectory.log"
    described_by = [*cameras, *([trajectory] if trajectory.exists() else [])]
    poses = _poses(trajectory, color) if trajectory.exists() else [None] * len(color)
    intrinsics = _intrinsics(cameras[0]) if cameras else PRIMESENSE
    return video(folder, Pair(Lens(intrinsics)), color, depth_partners(folder / "depth", color), poses, described_by)


def _inner(path: Path) -> Path:
    return path / "RGBD" if (path / "RGBD").is_dir() else path


def _color_images(folder: Path) -> list[Path]:
    return sorted_images((folder / "color").glob("*"))


def _intrinsics(path: Path) -> Intrinsics:
    with parsing(path, "camera with width, height and an intrinsic_matrix of nine numbers"):
        camera = _CameraFile.model_validate_json(read_bytes(path, "calibration"))
        m = camera.intrinsic_matrix
        return Intrinsics(camera.width, camera.height, m[0], m[4], m[6], m[7])


def _poses(path: Path, images: Sequence[Path]) -> list[Array | None]:
    """Return world_from_camera of each image; None for those without one.

    The first number of a header is the number in the name of its image, or else the index of the image. Other headers
    are ignored.
    """
    with parsing(path, "trajectory with a header line and a 4x4 matrix per image"):
        lines = [line.split() for line in read_bytes(path, "trajectory").decode().splitlines() if line.strip()]
        blocks = [np.array([list(map(float, row)) for row in lines[i + 1 : i + 5]]) for i in range(0, len(lines), 5)]
        found = [checked_pose(path, f"pose {i}", block) for i, block in enumerate(blocks)]
        ids = [int(line[0]) for line in lines[::5]]
    own = [number[-1] for number in numbers(images) or []]
    for names in (own, list(range(len(images)))):
        if len(set(ids)) == len(ids) and set(ids) <= set(names):
            by_id = dict(zip(ids, found, strict=True))
            return [by_id.get(name) for name in names]
    return [*found[: len(images)], *[None] * (len(images) - len(found))]
