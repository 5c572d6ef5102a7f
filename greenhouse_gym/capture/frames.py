"""RGB-D images, and the stations of a tripod at which all cameras of a rig take one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array


@dataclass(frozen=True, eq=False)
class RgbdFrame:
    """One RGB-D image.

    Attributes:
        color: (height, width, 3) uint8 RGB.
        depth: (height, width) float32 metres along the optical axis; 0 = no reading.
        intrinsics: The pinhole model of both.
    """

    color: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float32]
    intrinsics: Intrinsics

    def __post_init__(self) -> None:
        expected = (self.intrinsics.height, self.intrinsics.width)
        if self.depth.shape != expected:
            raise InvalidValueError(
                f"depth image is {size_text(self.depth.shape)}, the intrinsics say {size_text(expected)}"
            )
        if self.color.shape != (*expected, 3):
            raise InvalidValueError(
                f"color image is {size_text(self.color.shape)}, the depth image {size_text(expected)}"
            )
        if self.color.dtype != np.uint8 or self.depth.dtype != np.float32:
            raise InvalidValueError(
                f"expected uint8 color and float32 depth in metres, got {self.color.dtype} and {self.depth.dtype}"
            )

    def points(self, mask: npt.NDArray[np.bool_] | None = None) -> Array:
        """Back-project the pixels with a reading, and within ``mask`` (height, width) if given, to (n, 3) metres."""
        return self.back_project(*self.pixels(mask))

    def grid_points(self, every: int, farthest: float) -> Array:
        """Back-project one in ``every`` rows and columns, up to ``farthest`` metres of depth, to (n, 3) metres."""
        grid = np.zeros(self.depth.shape, dtype=bool)
        grid[::every, ::every] = True
        return self.points(grid & (self.depth < farthest))

    def pixels(self, mask: npt.NDArray[np.bool_] | None = None) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return rows and columns, (n,) each, of the pixels with a reading, within ``mask`` if given."""
        valid = self.depth > 0 if mask is None else (self.depth > 0) & mask
        rows, columns = np.nonzero(valid)
        return rows, columns

    def back_project(self, rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]) -> Array:
        """Back-project the pixels at ``rows`` and ``columns`` (n,) to points (n, 3) in the camera frame, metres."""
        return self.intrinsics.back_project(rows, columns, self.depth[rows, columns])


def size_text(shape: tuple[int, ...]) -> str:
    """Return the size of an image of this array shape for messages: width x height."""
    return f"{shape[1]}x{shape[0]}" if len(shape) >= 2 else str(shape)


@dataclass(frozen=True, eq=False)
class Station:
    """One stop of the tripod.

    Attributes:
        frames: One RGB-D image per camera of the rig, by name.
        world_from_station: (4, 4) true pose of the rig frame, or None where it is not known.
    """

    frames: Mapping[str, RgbdFrame]
    world_from_station: Array | None = None
