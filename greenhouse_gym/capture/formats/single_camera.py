"""Recordings of one hand-held camera, and frames from raw images: undistorted, depth aligned to color.

The camera becomes a rig of one: the rig frame sits in the camera with x forward and z up in the image, so that
reconstruction finds the same conventions as with a tripod.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.image_files import read_any_color, read_any_depth
from greenhouse_gym.capture.recordings import Recording, read_frame
from greenhouse_gym.capture.rig import Camera, Intrinsics, RgbdFrame, Rig, Station, size_text
from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, pose, transform

with needs("reconstruct"):
    import cv2

_BROWN = ("", "plumb_bob", "rational_polynomial", "thin_prism", "radtan", "brown_conrady")
_FISHEYES = ("equidistant", "fisheye", "kannala_brandt4")

RIG_FROM_CAMERA = pose([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Pose of the camera of a rig of one in the rig's frame."""

CAMERA = "camera"
"""Name of that camera."""


@dataclass(frozen=True)
class Lens:
    """A pinhole camera and the distortion of its images.

    Attributes:
        intrinsics: The pinhole, also of the undistorted images.
        distortion: OpenCV's coefficients (k1, k2, p1, p2, k3, ...), or (k1, k2, k3, k4) of a fisheye; empty for
            rectified images.
        fisheye: True for the equidistant model, in which an image without coefficients is no pinhole's either.
    """

    intrinsics: Intrinsics
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    @property
    def distorted(self) -> bool:
        """True if images differ from those of the pinhole."""
        return any(self.distortion) or (self.fisheye and len(self.distortion) > 0)


def distorted_lens(path: object, intrinsics: Intrinsics, coefficients: Iterable[float], model: str) -> Lens:
    """Return a lens by the name of its distortion model in ROS, OpenCV or RealSense's SDK.

    Args:
        path: The file that describes the lens, for messages.
        intrinsics: The pinhole.
        coefficients: The distortion coefficients; none for rectified images.
        model: Name of the model; an empty text is OpenCV's usual one.

    Raises:
        FileFormatError: The model is unknown and the coefficients are not all 0, or they do not fit the model.
    """
    distortion = tuple(float(each) for each in coefficients)
    fisheye = model.lower() in _FISHEYES
    if not any(distortion) and not fisheye:
        return Lens(intrinsics)
    if not fisheye and model.lower() not in _BROWN:
        known = ", ".join((*_BROWN[1:], *_FISHEYES))
        raise FileFormatError(path, f"the distortion model {model!r} is not undone; known are {known}")
    counts = (0, 4) if fisheye else (4, 5, 8, 12, 14)
    if len(distortion) not in counts or not np.isfinite(distortion).all():
        expected = " or ".join(map(str, counts))
        raise FileFormatError(path, f"{model or 'distortion'}: expected {expected} finite numbers, got {distortion}")
    return Lens(intrinsics, distortion, fisheye)


@dataclass(frozen=True, eq=False)
class Pair:
    """Lenses, relative pose and units of a camera's color and depth images."""

    color: Lens  # the color camera's lens
    depth: Lens | None = None  # the depth camera's lens; None where depth is aligned to color already
    color_from_depth: Array = field(default_factory=lambda: np.eye(4))  # (4, 4) metres
    depth_scale: float = 0.001  # metres per unit of whole numbers; fractional numbers are metres

    @classmethod
    def of(cls, color: Lens, depth: Lens, color_from_depth: Array, depth_scale: float = 0.001) -> Pair:
        """Return a pair of two lenses; the depth lens is None if lens and pose equal those of color."""
        same = color == depth and np.allclose(color_from_depth, np.eye(4), atol=1e-6)
        return cls(color, None if same else depth, color_from_depth, depth_scale)

    def frame(self, color: npt.NDArray[np.uint8], depth: npt.NDArray[Any], named: object) -> RgbdFrame:
        """Combine a color image (h, w, 3) and a depth image (h', w') in its own units into one frame.

        Raises:
            FileFormatError: An image does not have its lens's size, or holds something else than color or distances;
                ``named`` is its name in messages.
        """
        own = self.depth or self.color
        if color.dtype != np.uint8 or color.ndim != 3 or color.shape[2] != 3:
            raise FileFormatError(named, f"color: expected 8 bits of RGB, got {color.dtype} of shape {color.shape}")
        if depth.dtype.itemsize < 2 or depth.ndim != 2:
            raise FileFormatError(
                named,
                f"depth: expected one channel of 16 bits or of fractions, got {depth.dtype} of shape {depth.shape}; "
                "images of 8 bits, such as JPEG, hold no distances",
            )
        for kind, image, lens in (("color", color, self.color), ("depth", depth, own)):
            size = (lens.intrinsics.height, lens.intrinsics.width)
            if image.shape[:2] != size:
                raise FileFormatError(
                    named, f"{kind} image is {size_text(image.shape)}, the intrinsics say {size_text(size)}"
                )
        metres = in_metres(depth, self.depth_scale)
        if self.color.distorted:
            color = cv2.remap(color, *_undistortion(self.color), cv2.INTER_LINEAR)
        if own.distorted:
            metres = cv2.remap(metres, *_undistortion(own), cv2.INTER_NEAREST)
        if self.depth is not None:
            metres = aligned(metres, self.depth.intrinsics, self.color.intrinsics, self.color_from_depth)
        return RgbdFrame(color, metres, self.color.intrinsics)


def in_metres(depth: npt.NDArray[Any], scale: float) -> npt.NDArray[np.float32]:
    """Convert a depth image to metres, 0 where it is not a positive number."""
    metres = depth.astype(np.float32)
    if np.issubdtype(depth.dtype, np.integer):
        metres *= np.float32(scale)
    return np.where(np.isfinite(metres) & (metres > 0), metres, 0).astype(np.float32)


@lru_cache(maxsize=16)
def _undistortion(lens: Lens) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Return the coordinates in the distorted image of each pixel of the undistorted one."""
    k = lens.intrinsics
    distortion = np.array(lens.distortion)
    undistort = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    maps = undistort(k.matrix, distortion, np.eye(3), k.matrix, (k.width, k.height), cv2.CV_32FC1)
    return maps[0], maps[1]


def aligned(
    depth: npt.NDArray[np.float32], own: Intrinsics, color: Intrinsics, color_from_depth: Array
) -> npt.NDArray[np.float32]:
    """Project the depth (h', w') of one camera into another camera (h, w) next to it; the nearest reading wins.

    A pixel of a coarser depth image covers as many pixels of the color image as it is larger.
    """
    rows, columns = np.nonzero(depth > 0)
    z = depth[rows, columns].astype(np.float64)
    x, y, z = transform(color_from_depth, own.back_project(rows, columns, z)).T
    ahead = z > 1e-6
    x, y, z = x[ahead], y[ahead], z[ahead]
    finer = max(1, int(np.ceil(color.fx / own.fx)))
    steps = (np.arange(finer) + 0.5) / finer - 0.5
    across = [np.rint(x / z * color.fx + color.cx + step * color.fx / own.fx).astype(np.int32) for step in steps]
    down = [np.rint(y / z * color.fy + color.cy + step * color.fy / own.fy).astype(np.int32) for step in steps]
    result = np.full(color.height * color.width, np.inf, dtype=np.float32)
    metres = z.astype(np.float32)
    for v in down:
        for u in across:
            inside = (u >= 0) & (u < color.width) & (v >= 0) & (v < color.height)
            np.minimum.at(result, v[inside] * color.width + u[inside], metres[inside])
    result[~np.isfinite(result)] = 0.0
    return result.reshape(color.height, color.width)


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
