"""Recordings of a single camera whose images need work before they are frames, and poses by time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.formats.pairs import Pair, read_units
from greenhouse_gym.capture.formats.single_camera import CAMERA, RIG_FROM_CAMERA, read_numbers
from greenhouse_gym.capture.frames import Station
from greenhouse_gym.capture.images import read_image
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import Camera, Rig
from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, pose

with needs("reconstruct"):
    import cv2

POSED_WITHIN = 0.05
"""Time between an image and a pose, in seconds, up to which the pose is taken as the image's."""


def rig_of(pair: Pair) -> Rig:
    """A rig of one camera: the rig frame sits in it with x forward and z up."""
    return Rig({CAMERA: Camera(pair.color.intrinsics, RIG_FROM_CAMERA, pair.depth_scale)}, CAMERA)


def video(
    folder: Path,
    pair: Pair,
    color: Sequence[Path],
    depth: Sequence[Path],
    world_from_camera: Sequence[Array | None],
    described_by: Sequence[Path] = (),
    notes: Sequence[str] = (),
) -> Recording:
    """A recording of one camera from its image files, each frame made when it is asked for.

    Raises:
        FileFormatError: There are no images, or the lists differ in length.
    """
    if not color:
        raise FileFormatError(folder, "holds no pairs of color and depth images")
    if not len(color) == len(depth) == len(world_from_camera):
        raise FileFormatError(folder, f"{len(color)} color images, {len(depth)} depth images")

    load = partial(_station, pair, tuple(color), tuple(depth), tuple(world_from_camera))
    files = (*described_by, *color, *depth)
    return Recording(
        folder.name, rig_of(pair), len(color), load, folder, files=files, notes=tuple(notes), of_camera=True
    )


def _station(
    pair: Pair, color: Sequence[Path], depth: Sequence[Path], world_from_camera: Sequence[Array | None], i: int
) -> Station:
    frame = pair.frame(read_any_color(color[i]), read_units(depth[i]), color[i])
    return Station({CAMERA: frame}, station_pose(world_from_camera[i]))


def station_pose(world_from_camera: Array | None) -> Array | None:
    """The pose of the rig frame of `rig_of`, of a camera's pose."""
    return None if world_from_camera is None else world_from_camera @ RIG_FROM_CAMERA.T


def read_any_color(path: Path) -> npt.NDArray[np.uint8]:
    """A color image of any kind that is read, as RGB."""
    image = read_image(path)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    if image.dtype != np.uint8 or image.shape[2] not in (3, 4):
        raise FileFormatError(path, f"expected color of 8 bits, got {image.dtype} of shape {image.shape}")
    return np.ascontiguousarray(cv2.cvtColor(np.asarray(image[..., :3]), cv2.COLOR_BGR2RGB))


def nearest_in_time(times: Array, others: Array, within: float) -> npt.NDArray[np.int64]:
    """For each of ``times`` (n,) the index of the nearest of the sorted ``others`` (m,), or -1 beyond ``within``."""
    if not len(others):
        return np.full(len(times), -1, dtype=np.int64)
    after = np.clip(np.searchsorted(others, times), 1, max(1, len(others) - 1))
    before = after - 1
    after = np.minimum(after, len(others) - 1)
    nearest = np.where(np.abs(others[after] - times) < np.abs(others[before] - times), after, before)
    return np.where(np.abs(others[nearest] - times) <= within, nearest, -1)


def poses_by_time(path: Path) -> tuple[Array, Array]:
    """Times (n,) and poses (n, 4, 4) of a file of lines ``time tx ty tz qx qy qz qw``, sorted by time."""
    rows = np.array(read_numbers(path, 8)).reshape(-1, 8)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    lengths = np.linalg.norm(rows[:, 4:], axis=1)
    if not (lengths > 1e-6).all():
        raise FileFormatError(path, f"the quaternion at time {rows[np.argmin(lengths), 0]} is zero")
    turns = Rotation.from_quat(rows[:, 4:]).as_matrix() if len(rows) else np.zeros((0, 3, 3))
    poses = [pose(turn, row[1:4]) for turn, row in zip(turns, rows, strict=True)]
    return rows[:, 0], np.array(poses).reshape(-1, 4, 4)


def chosen(recording: Recording, stations: Sequence[int]) -> Recording:
    """Some stations of a recording of a single pass."""
    return replace(recording, size=len(stations), load=partial(_kept, recording, tuple(stations)))


def _kept(recording: Recording, stations: Sequence[int], i: int) -> Station:
    return recording[stations[i]]
