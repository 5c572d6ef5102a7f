"""A color and a depth image as they come off a sensor, made one frame: distortion undone, depth aligned to color."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.frames import RgbdFrame
from greenhouse_gym.capture.images import read_exr, read_image
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.array_files import read_array
from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import parsing, read_bytes
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, transform

with needs("reconstruct"):
    import cv2


@dataclass(frozen=True, eq=False)
class Lens:
    """A pinhole and how its images are distorted.

    Attributes:
        intrinsics: The pinhole.
        distortion: OpenCV's coefficients (k1, k2, p1, p2, k3, ...); none of an image that is rectified.
    """

    intrinsics: Intrinsics
    distortion: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Pair:
    """How a camera's color and depth images belong together.

    Attributes:
        color: The color camera's lens.
        depth: The depth camera's; None where depth is aligned to color already.
        color_from_depth: (4, 4) pose of the depth camera in the color camera, metres.
        depth_scale: Metres per unit of whole numbers; numbers with a fraction are metres.
    """

    color: Lens
    depth: Lens | None = None
    color_from_depth: Array = field(default_factory=lambda: np.eye(4))
    depth_scale: float = 0.001

    @classmethod
    def of(cls, color: Lens, depth: Lens, color_from_depth: Array, depth_scale: float = 0.001) -> Pair:
        """A pair of two lenses, of which the depth's does not matter where it is, and stands, as the color's."""
        same = color.intrinsics == depth.intrinsics and np.allclose(color_from_depth, np.eye(4), atol=1e-6)
        return cls(color, None if same else depth, color_from_depth, depth_scale)

    def frame(self, color: npt.NDArray[np.uint8], depth: npt.NDArray[Any], named: object) -> RgbdFrame:
        """One frame of a color image (h, w, 3) and a depth image (h', w') in its own units.

        Raises:
            FileFormatError: An image is not of its lens's size; ``named`` is what to call it.
        """
        own = self.depth or self.color
        for what, image, lens in (("color", color, self.color), ("depth", depth, own)):
            size = (lens.intrinsics.height, lens.intrinsics.width)
            if image.shape[:2] != size:
                seen, said = f"{image.shape[1]}x{image.shape[0]}", f"{size[1]}x{size[0]}"
                raise FileFormatError(named, f"{what} image is {seen}, the intrinsics say {said}")
        metres = in_metres(depth, self.depth_scale)
        if any(self.color.distortion):
            color = cv2.remap(color, *_undistortion(self.color), cv2.INTER_LINEAR)
        if any(own.distortion):
            metres = cv2.remap(metres, *_undistortion(own), cv2.INTER_NEAREST)
        if self.depth is not None:
            metres = aligned(metres, self.depth.intrinsics, self.color.intrinsics, self.color_from_depth)
        return RgbdFrame(color, metres, self.color.intrinsics)


def in_metres(depth: npt.NDArray[Any], scale: float) -> npt.NDArray[np.float32]:
    """A depth image in metres, 0 where it is not a positive number."""
    metres = depth.astype(np.float32)
    if np.issubdtype(depth.dtype, np.integer):
        metres *= np.float32(scale)
    return np.where(np.isfinite(metres) & (metres > 0), metres, 0).astype(np.float32)


@lru_cache(maxsize=16)
def _undistortion(lens: Lens) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Where each pixel of the undistorted image is found."""
    k = lens.intrinsics
    distortion = np.array(lens.distortion)
    maps = cv2.initUndistortRectifyMap(k.matrix, distortion, None, k.matrix, (k.width, k.height), cv2.CV_32FC1)
    return maps[0], maps[1]


def aligned(
    depth: npt.NDArray[np.float32], own: Intrinsics, color: Intrinsics, color_from_depth: Array
) -> npt.NDArray[np.float32]:
    """Depth (h', w') of one camera as another camera (h, w) beside it would measure it; the nearest reading counts.

    A pixel of a coarser depth image covers several of the color image: as many as its size asks for.
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


def read_units(path: Path) -> npt.NDArray[Any]:
    """A depth image file in its own units: PNG, PGM or TIFF of 16 bits or of fractions, NPY or OpenEXR.

    Raises:
        FileFormatError: It is missing, damaged, of no such kind, or has several channels.
    """
    if path.suffix.lower() == ".npy":
        with parsing(path, "depth image"):
            image = read_array(read_bytes(path, "image"))
    elif path.suffix.lower() == ".exr":
        image = read_exr(path)
    else:
        image = read_image(path)
    if image.ndim != 2 or image.dtype.kind not in "uif" or image.dtype == np.uint8:
        raise FileFormatError(path, f"expected one channel of depth, got {image.dtype} of shape {image.shape}")
    return image
