"""One way in, `open_recording`, for the package's own folders and for layouts that other tools write.

A single hand-held camera becomes a rig of one: the rig frame sits in the camera with x forward and z up in the image,
so that reconstruction finds the same conventions as with a tripod.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from greenhouse_gym.capture.frames import Station
from greenhouse_gym.capture.recordings import INDEX, Recording, checked_pose, open_folder, read_frame
from greenhouse_gym.capture.rig import Camera, Intrinsics, Rig
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, pose

PRIMESENSE = Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5)
"""What Open3D assumes for RGB-D folders that carry no intrinsics."""

_RIG_FROM_CAMERA = pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


def open_recording(path: str | Path) -> Recording:
    """Open a recording; its stations are read when they are asked for.

    Understood are the package's own folders (``recording.json``), a calibrated camera's folders (``rgb/``, ``depth/``,
    ``camera_*.yaml`` and optionally ``groundtruth_handeye.txt``), and Open3D's RGB-D folders (``color/``, ``depth/``
    and optionally ``trajectory.log`` and ``camera*.json``). Depth is in millimetres in all of them.

    Raises:
        FileFormatError: The folder is none of these, or a file in it is missing or damaged. Images are checked when
            their station is read.
    """
    folder = Path(path)
    if (folder / INDEX).exists():
        return open_folder(folder)
    if (folder / "rgb").is_dir() and (folder / "depth").is_dir():
        return _open_calibrated(folder)
    if (folder / "RGBD").is_dir():
        folder = folder / "RGBD"
    if (folder / "color").is_dir() and (folder / "depth").is_dir():
        return _open_open3d(folder)
    raise FileFormatError(path, f"not a recording: expected {INDEX}, or the folders rgb/ or color/ beside depth/")


def _open_calibrated(folder: Path) -> Recording:
    files = sorted(folder.glob("camera_*.yaml"))
    if not files:
        raise FileFormatError(folder, "no camera_*.yaml with the intrinsics")
    try:
        fields = dict(re.findall(r"^(\w+):\s*(\S.*)$", files[0].read_text(), re.M))
        matrix = json.loads(fields["camera_matrix"])
        intrinsics = Intrinsics(
            int(fields["image_width"]), int(fields["image_height"]), matrix[0], matrix[4], matrix[2], matrix[5]
        )
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise FileFormatError(
            files[0], f"expected image_width, image_height and a camera_matrix of nine numbers ({error})"
        ) from error
    poses: dict[int, Array] = {}
    truth = folder / "groundtruth_handeye.txt"
    if truth.exists():
        for row in _numbers(truth, 8):
            if not row[4:8].any():
                raise FileFormatError(truth, f"the quaternion of image {row[0]:.0f} is zero")
            poses[int(row[0])] = pose(Rotation.from_quat(row[4:8]).as_matrix(), row[1:4])
    color = sorted((folder / "rgb").glob("*.png"))
    for file in color:
        if poses and not file.stem.isdecimal():
            raise FileFormatError(file, f"expected a number as the image's name, by which {truth.name} gives its pose")
    return _single_camera(folder, intrinsics, color, [folder / "depth" / f.name for f in color],
                          [poses.get(int(f.stem)) if poses else None for f in color])  # fmt: skip


def _open_open3d(folder: Path) -> Recording:
    intrinsics = PRIMESENSE
    files = sorted(folder.glob("camera*.json"))
    if files:
        try:
            data = json.loads(files[0].read_text())
            m = data["intrinsic_matrix"]  # column-major
            intrinsics = Intrinsics(data["width"], data["height"], m[0], m[4], m[6], m[7])
        except (ValueError, KeyError, IndexError, TypeError) as error:
            raise FileFormatError(files[0], f"expected width, height and an intrinsic_matrix ({error})") from error
    color = sorted(f for f in (folder / "color").iterdir() if f.suffix.lower() in (".jpg", ".png"))
    poses: list[Array | None] = [None] * len(color)
    trajectory = folder / "trajectory.log"
    if trajectory.exists():
        try:
            lines = [line for line in trajectory.read_text().splitlines() if line.strip()]
            blocks = [np.array([list(map(float, row.split())) for row in lines[i + 1 : i + 5]])
                      for i in range(0, len(lines), 5)]  # fmt: skip
        except ValueError as error:
            raise FileFormatError(trajectory, f"expected a header line and a 4x4 matrix per image ({error})") from error
        for i, block in enumerate(blocks[: len(color)]):
            poses[i] = checked_pose(trajectory, f"pose {i}", block)
    return _single_camera(folder, intrinsics, color, [folder / "depth" / f"{f.stem}.png" for f in color], poses)


def _single_camera(
    folder: Path,
    intrinsics: Intrinsics,
    color: Sequence[Path],
    depth: Sequence[Path],
    world_from_camera: Sequence[Array | None],
) -> Recording:
    if not color:
        raise FileFormatError(folder, "holds no color images")
    camera = Camera(intrinsics, _RIG_FROM_CAMERA)

    def load(i: int) -> Station:
        known = world_from_camera[i]
        frame = read_frame(color[i], depth[i], camera)
        return Station({"camera": frame}, None if known is None else known @ _RIG_FROM_CAMERA.T)

    return Recording(folder.name, Rig({"camera": camera}, "camera"), len(color), load, folder)


def _numbers(path: Path, columns: int) -> Array:
    try:
        rows = np.array([list(map(float, line.split())) for line in path.read_text().splitlines() if line.strip()])
        if rows.ndim != 2 or rows.shape[1] != columns:
            raise ValueError(f"shape {rows.shape}")
        if not np.isfinite(rows).all():
            raise ValueError("not all are finite")
    except ValueError as error:
        raise FileFormatError(path, f"expected {columns} numbers a line ({error})") from error
    return rows
