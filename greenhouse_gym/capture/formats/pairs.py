"""Frames from the raw color and depth images of a sensor: undistorted, depth aligned to color."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.frames import RgbdFrame, size_text
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, transform

with needs("reconstruct"):
    import cv2


@dataclass(frozen=True, eq=False)
class Lens:
    """A pinhole camera and the distortion of its images."""

    intrinsics: Intrinsics  # the pinhole
    distortion: tuple[float, ...] = ()  # OpenCV's coefficients (k1, k2, p1, p2, k3, ...); empty for rectified images


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
        same = color.intrinsics == depth.intrinsics and np.allclose(color_from_depth, np.eye(4), atol=1e-6)
        return cls(color, None if same else depth, color_from_depth, depth_scale)

    def frame(self, color: npt.NDArray[np.uint8], depth: npt.NDArray[Any], named: object) -> RgbdFrame:
        """Combine a color image (h, w, 3) and a depth image (h', w') in its own units into one frame.

        Raises:
            FileFormatError: An image does not have its lens's size; ``named`` is its name in messages.
        """
        own = self.depth or self.color
        for kind, image, lens in (("color", color, self.color), ("depth", depth, own)):
            size = (lens.intrinsics.height, lens.intrinsics.width)
            if image.shape[:2] != size:
                raise FileFormatError(
                    named, f"{kind} image is {size_text(image.shape)}, the intrinsics say {size_text(size)}"
                )
        metres = in_metres(depth, self.depth_scale)
        if any(self.color.distortion):
            color = cv2.remap(color, *_undistortion(self.color), cv2.INTER_LINEAR)
        if any(own.distortion):
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
    maps = cv2.initUndistortRectifyMap(k.matrix, distortion, None, k.matrix, (k.width, k.height), cv2.CV_32FC1)
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
