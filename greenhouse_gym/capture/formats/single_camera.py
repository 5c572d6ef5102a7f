"""Recordings of one hand-held camera.

The camera becomes a rig of one: the rig frame sits in the camera with x forward and z up in the image, so that
reconstruction finds the same conventions as with a tripod.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from greenhouse_gym.capture.formats.pairs import Pair
from greenhouse_gym.capture.image_files import read_any_color, read_any_depth
from greenhouse_gym.capture.recordings import Recording, read_frame
from greenhouse_gym.capture.rig import Camera, Intrinsics, RgbdFrame, Rig, Station
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, pose

RIG_FROM_CAMERA = pose([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Pose of the camera of a rig of one in the rig's frame."""

CAMERA = "camera"
"""Name of that camera."""


def single_camera(
    folder: Path,
    intrinsics: Intrinsics,
    color: Sequence[Path],
    depth: Sequence[Path],
    world_from_camera: Sequence[Array | None] | None = None,
    depth_scale: float = 0.001,
    described_by: Sequence[Path] = (),
) -> Recording:
    """Return a recording of one camera from its image files, depth aligned to color.

    Args:
        folder: Its folder, whose name becomes the recording's.
        intrinsics: The camera's intrinsics.
        color: The color images, one per station.
        depth: The depth images, as many.
        world_from_camera: (4, 4) true pose of the camera at each station, or None where it is not known.
        depth_scale: Metres per unit of the depth images.
        described_by: Files of intrinsics and poses.

    Raises:
        FileFormatError: There are no images, or the lists differ in length.
    """
    camera = Camera(intrinsics, RIG_FROM_CAMERA, depth_scale)
    poses = [None] * len(color) if world_from_camera is None else world_from_camera
    return _recording(folder, camera, partial(read_frame, camera=camera), color, depth, poses, described_by)


def video(
    folder: Path,
    pair: Pair,
    color: Sequence[Path],
    depth: Sequence[Path],
    world_from_camera: Sequence[Array | None],
    described_by: Sequence[Path] = (),
    notes: Sequence[str] = (),
) -> Recording:
    """Return a recording of one camera from image files of any kind that `Pair` turns into frames.

    Raises:
        FileFormatError: There are no images, or the lists differ in length.
    """
    camera = rig_of(pair).cameras[CAMERA]
    return _recording(folder, camera, partial(_read_pair, pair), color, depth, world_from_camera, described_by, notes)


def rig_of(pair: Pair) -> Rig:
    """Return the rig of one camera."""
    return Rig({CAMERA: Camera(pair.color.intrinsics, RIG_FROM_CAMERA, pair.depth_scale)}, CAMERA)


def station_pose(world_from_camera: Array | None) -> Array | None:
    """Return the pose of the rig frame for a pose of its only camera."""
    return None if world_from_camera is None else world_from_camera @ RIG_FROM_CAMERA.T


def _recording(
    folder: Path,
    camera: Camera,
    read: Callable[[Path, Path], RgbdFrame],
    color: Sequence[Path],
    depth: Sequence[Path],
    poses: Sequence[Array | None],
    described_by: Sequence[Path],
    notes: Sequence[str] = (),
) -> Recording:
    if not color:
        raise FileFormatError(folder, "holds no pairs of color and depth images")
    if not len(color) == len(depth) == len(poses):
        raise FileFormatError(folder, f"{len(color)} color images, {len(depth)} depth images, {len(poses)} poses")
    return Recording(
        folder.name,
        Rig({CAMERA: camera}, CAMERA),
        len(color),
        partial(_station, read, tuple(color), tuple(depth), tuple(poses)),
        folder,
        files=(*described_by, *color, *depth),
        notes=tuple(notes),
        camera_poses=True,
    )


def _station(
    read: Callable[[Path, Path], RgbdFrame],
    color: Sequence[Path],
    depth: Sequence[Path],
    poses: Sequence[Array | None],
    i: int,
) -> Station:
    return Station({CAMERA: read(color[i], depth[i])}, station_pose(poses[i]))


def _read_pair(pair: Pair, color: Path, depth: Path) -> RgbdFrame:
    return pair.frame(read_any_color(color), read_any_depth(depth), color)
