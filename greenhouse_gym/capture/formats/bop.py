"""Scenes of BOP: ``rgb/``, ``depth/`` and ``scene_camera.json`` with matrix, depth scale and pose of each image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field, TypeAdapter

from greenhouse_gym.capture.formats.single_camera import Lens, Pair, video
from greenhouse_gym.capture.image_files import read_any_color
from greenhouse_gym.capture.recordings import Recording, checked_pose
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.files import parsing, read_bytes
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, invert, pose

name = "bop"
description = "the folders rgb/ and depth/ and the file scene_camera.json of a scene of BOP"

INDEX = "scene_camera.json"
_MILLIMETRE = 0.001


class _Image(BaseModel):
    """Camera and pose of one image; lengths in millimetres."""

    matrix: Annotated[list[float], Field(alias="cam_K", min_length=9, max_length=9)]
    depth_scale: Annotated[float, Field(gt=0)] = 1.0
    rotation: list[float] | None = Field(None, alias="cam_R_w2c", min_length=9, max_length=9)
    translation: list[float] | None = Field(None, alias="cam_t_w2c", min_length=3, max_length=3)


def recognizes(path: Path) -> bool:
    """Return whether the folder has the file and color images."""
    return (path / INDEX).is_file() and (path / "rgb").is_dir()


def open(path: Path) -> Recording:
    """Open a scene of BOP.

    Raises:
        FileFormatError: A file is missing or damaged, or images differ in their camera. Images are checked when their
            station is read.
    """
    file = path / INDEX
    with parsing(file, "file of cameras"):
        images = TypeAdapter(dict[int, _Image]).validate_json(read_bytes(file, "calibration"))
    numbers = sorted(images)
    if not numbers:
        raise FileFormatError(file, "names no images")
    first = images[numbers[0]]
    for number in numbers:
        if (images[number].matrix, images[number].depth_scale) != (first.matrix, first.depth_scale):
            raise FileFormatError(file, f"image {number} has another camera than image {numbers[0]}; one is read")
    color = [_color(path, number) for number in numbers]
    height, width = read_any_color(color[0]).shape[:2]
    k = first.matrix
    pair = Pair(Lens(Intrinsics(width, height, k[0], k[4], k[2], k[5])), depth_scale=_MILLIMETRE * first.depth_scale)
    depth = [path / "depth" / f"{number:06d}.png" for number in numbers]
    return video(path, pair, color, depth, [_pose(file, number, images[number]) for number in numbers], [file])


def _color(path: Path, number: int) -> Path:
    names = [path / "rgb" / f"{number:06d}{suffix}" for suffix in (".png", ".jpg")]
    return next((name for name in names if name.is_file()), names[0])


def _pose(file: Path, number: int, image: _Image) -> Array | None:
    """Return world_from_camera."""
    if image.rotation is None or image.translation is None:
        return None
    camera_from_world = pose(np.reshape(image.rotation, (3, 3)), _MILLIMETRE * np.array(image.translation))
    return invert(checked_pose(file, f"the pose of image {number}", camera_from_world))
