"""Plain folders of images, described by a small file ``cameras.yaml`` next to them.

color: rgb/*.jpg               # sorted by the numbers in their names, as many as depth images
depth: depth/*.npy             # PNG, PGM or TIFF of 16 bits, fractions in TIFF, NPY or EXR
depth_scale: 0.001             # metres per unit of whole numbers; fractions are metres
intrinsics: {width: 1280, height: 720, fx: 915.1, fy: 915.2, cx: 640.3, cy: 358.8, distortion: [0.1, -0.2, 0, 0]}
                               # and distortion_model: equidistant for a fisheye
depth_intrinsics: {...}        # where depth is not aligned to color
color_from_depth: [[...], ...] # 4x4, metres
poses: poses.txt               # world from camera: "id tx ty tz qx qy qz qw", id an image's number or a time
reference: middle              # only with several cameras
cameras:                       # instead of the first six: each with the same keys and its pose on the rig
middle: {color: ..., depth: ..., intrinsics: {...}, rig_from_camera: [[...], ...]}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from greenhouse_gym.capture.formats.image_lists import check_numbers, poses_by_id, read_poses, sorted_images
from greenhouse_gym.capture.formats.single_camera import (
    CAMERA,
    RIG_FROM_CAMERA,
    Lens,
    Pair,
    distorted_lens,
    station_pose,
)
from greenhouse_gym.capture.image_files import read_any_color, read_any_depth
from greenhouse_gym.capture.recordings import Recording, checked_pose
from greenhouse_gym.capture.rig import Camera, Intrinsics, Rig, Station
from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import inside, parsing, read_bytes
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array

with needs("reconstruct"):
    import yaml

name = "described"
description = "any folders of color and depth images, described by a file cameras.yaml"

INDEX = "cameras.yaml"

Images: TypeAlias = Mapping[str, tuple[list[Path], list[Path]]]
"""Color and depth files by camera."""

_Matrix = Annotated[list[list[float]], Field(min_length=4, max_length=4)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid")


class _Lens(_Part):
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: list[float] = []
    distortion_model: str = "plumb_bob"

    def lens(self, file: Path) -> Lens:
        pinhole = Intrinsics(**self.model_dump(exclude={"distortion", "distortion_model"}))
        return distorted_lens(file, pinhole, self.distortion, self.distortion_model)


class _Camera(_Part):
    color: str
    depth: str
    intrinsics: _Lens
    depth_scale: Annotated[float, Field(gt=0)] = 0.001
    depth_intrinsics: _Lens | None = None
    color_from_depth: _Matrix | None = None
    rig_from_camera: _Matrix | None = None


class _Several(_Part):
    cameras: Annotated[dict[str, _Camera], Field(min_length=1)]
    reference: str
    poses: str | None = None


class _Single(_Camera):
    poses: str | None = None


def recognizes(path: Path) -> bool:
    """Return whether the folder has a description."""
    return (path / INDEX).is_file()


def open(path: Path) -> Recording:
    """Open a folder with a description.

    Raises:
        FileFormatError: The description is damaged or does not fit the files. Images are checked when their station is
            read.
    """
    file = path / INDEX
    with parsing(file, "description of cameras"):
        content = yaml.safe_load(read_bytes(file, "settings"))
        if not isinstance(content, dict):
            raise ValueError("expected keys with their values")
        if "cameras" in content:
            several = _Several.model_validate(content)
            cameras, reference, poses = several.cameras, several.reference, several.poses
        else:
            single = _Single.model_validate(content)
            cameras, reference, poses = {CAMERA: single}, CAMERA, single.poses
        pairs = {name: _pair(file, camera) for name, camera in cameras.items()}
        rig = Rig({name: _rig_camera(file, name, camera, pairs[name]) for name, camera in cameras.items()}, reference)
    images = {name: (_images(path, camera.color), _images(path, camera.depth)) for name, camera in cameras.items()}
    lists = {
        f"{name} {kind}": found
        for name, both in images.items()
        for kind, found in zip(("color", "depth"), both, strict=True)
    }
    counts = {kind: len(found) for kind, found in lists.items()}
    size = min(counts.values())
    if len(set(counts.values())) > 1 or not size:
        counted = ", ".join(f"{count} of {kind}" for kind, count in counts.items())
        raise FileFormatError(file, f"expected equally many images of each kind, found {counted}")
    notes = check_numbers(file, lists)
    alone = cameras.keys() == {CAMERA} and cameras[CAMERA].rig_from_camera is None
    known: list[Array | None] = [None] * size
    if poses is not None:
        ids, matrices = read_poses(inside(path, poses, named_in=file))
        matched = poses_by_id(path / poses, ids, list(matrices), images[reference][0])
        known = [station_pose(matrix) if alone else matrix for matrix in matched]
    files = (file, *(image for both in images.values() for found in both for image in found))
    load = partial(_station, pairs, images, tuple(known))
    return Recording(path.name, rig, size, load, path, files=files, notes=tuple(notes), camera_poses=alone)


def _station(pairs: Mapping[str, Pair], images: Images, poses: Sequence[Array | None], i: int) -> Station:
    frames = {}
    for name, pair in pairs.items():
        color, depth = (files[i] for files in images[name])
        frames[name] = pair.frame(read_any_color(color), read_any_depth(depth), color)
    return Station(frames, poses[i])


def _pair(file: Path, camera: _Camera) -> Pair:
    matrix = camera.color_from_depth
    return Pair(
        camera.intrinsics.lens(file),
        None if camera.depth_intrinsics is None else camera.depth_intrinsics.lens(file),
        np.eye(4) if matrix is None else checked_pose(file, "color_from_depth", matrix),
        camera.depth_scale,
    )


def _rig_camera(file: Path, name: str, camera: _Camera, pair: Pair) -> Camera:
    matrix = camera.rig_from_camera
    pose = RIG_FROM_CAMERA if matrix is None else checked_pose(file, f"{name}: rig_from_camera", matrix)
    return Camera(pair.color.intrinsics, pose, camera.depth_scale)


def _images(folder: Path, pattern: str) -> list[Path]:
    if Path(pattern).is_absolute() or ".." in Path(pattern).parts:
        raise FileFormatError(folder / INDEX, f"the pattern {pattern!r} leads out of the folder")
    return sorted_images(folder.glob(pattern))
