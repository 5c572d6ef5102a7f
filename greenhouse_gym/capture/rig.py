"""Cameras and their poses on the tripod, and the RGB-D images of a station.

Rig frame: origin on the floor below the tripod, x forward into the plants, y along the row, z up. Camera frame
(OpenCV): x right, y down, z forward in the image as it is stored.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, is_rotation, pose, rotation_about


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: image size and focal lengths and principal point in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy"):
            value = getattr(self, name)
            if not 0 < value < 1e6:
                raise InvalidValueError(f"intrinsics: {name} must be positive and below a million, got {value!r}")
        for name in ("cx", "cy"):
            if not abs(getattr(self, name)) < 1e6:
                raise InvalidValueError(f"intrinsics: {name} must be below a million, got {getattr(self, name)!r}")

    @property
    def matrix(self) -> Array:
        """Camera matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def back_project(
        self, rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64], depth: npt.NDArray[np.floating]
    ) -> Array:
        """Back-project pixels (n,) with ``depth`` (n,) metres to points (n, 3) in the camera frame."""
        z = depth.astype(np.float64)
        return np.column_stack([(columns - self.cx) / self.fx * z, (rows - self.cy) / self.fy * z, z])

    def project(self, points: Array) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Project points (n, 3) of the camera frame to the pixels of the image.

        Returns:
            Rows of those ``points`` that are inside the image (k,), and the row and the column of their pixels (k,).
        """
        ahead = np.flatnonzero(points[:, 2] > 1e-6)
        x, y, z = points[ahead].T
        columns = np.rint(x / z * self.fx + self.cx)
        rows = np.rint(y / z * self.fy + self.cy)
        inside = (columns >= 0) & (columns < self.width) & (rows >= 0) & (rows < self.height)
        return ahead[inside], rows[inside].astype(np.int64), columns[inside].astype(np.int64)


D435_DEPTH = Intrinsics(848, 480, 424.2, 424.2, 423.5, 239.5)
"""Depth mode of the D435 at 848x480."""


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera of a rig.

    Attributes:
        intrinsics: The pinhole model; color and depth images share it (depth aligned to color).
        rig_from_camera: (4, 4) pose of the camera in the rig frame, metres.
        depth_scale: Metres per unit of the stored depth images.
    """

    intrinsics: Intrinsics
    rig_from_camera: Array
    depth_scale: float = 0.001

    def __post_init__(self) -> None:
        matrix = np.array(self.rig_from_camera, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.allclose(matrix[3], [0, 0, 0, 1]):
            raise InvalidValueError(f"rig_from_camera must be a finite 4x4 pose, got {matrix.tolist()}")
        if not is_rotation(matrix[:3, :3], tolerance=1e-4):
            raise InvalidValueError(f"rig_from_camera: not a rotation: {matrix[:3, :3].tolist()}")
        if not (np.isfinite(self.depth_scale) and self.depth_scale > 0):
            raise InvalidValueError(f"depth_scale must be positive metres per unit, got {self.depth_scale!r}")
        matrix.setflags(write=False)
        object.__setattr__(self, "rig_from_camera", matrix)


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras on one tripod.

    Attributes:
        cameras: Each camera by name, in their order on the beam.
        reference: Name of the camera whose silhouettes align the stations: the middle one of the paper.
    """

    cameras: Mapping[str, Camera]
    reference: str

    def __post_init__(self) -> None:
        if self.reference not in self.cameras:
            raise InvalidValueError(f"reference camera {self.reference!r} is not among {', '.join(self.cameras)}")
        object.__setattr__(self, "cameras", MappingProxyType(dict(self.cameras)))

    def __reduce__(self) -> tuple[type[Rig], tuple[dict[str, Camera], str]]:
        return Rig, (dict(self.cameras), self.reference)  # a MappingProxyType cannot be pickled


def three_camera_rig(
    intrinsics: Intrinsics = D435_DEPTH,
    beam: Literal["level", "upright"] = "level",
    spacing: float = 0.25,
    inward: float = np.deg2rad(25.0),
    height: float = 1.1,
    portrait: bool = True,
) -> Rig:
    """Return the paper's rig: three cameras on a beam, the outer two turned towards the middle.

    Args:
        intrinsics: Intrinsics of all three.
        beam: ``"level"``: the beam lies along the row; ``"upright"``: it stands.
        spacing: Distance between neighbors on the beam, metres.
        inward: Angle by which the outer cameras turn to the middle, radians.
        height: Height of the middle camera above the floor, metres.
        portrait: Images lie on their side, so that the row passes along the image's vertical axis.
    """
    if portrait:  # image right is down in the world, image down is along the row
        upright_camera = np.column_stack([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    else:
        upright_camera = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    if beam == "level":
        along, axis = np.array([0.0, 1.0, 0.0]), [0.0, 0.0, 1.0]
    else:
        along, axis = np.array([0.0, 0.0, 1.0]), [0.0, -1.0, 0.0]
    cameras = {}
    for name, side in (("first", -1.0), ("middle", 0.0), ("last", 1.0)):
        turn = rotation_about(axis, -side * inward)
        position = np.array([0.0, 0.0, height]) + side * spacing * along
        cameras[name] = Camera(intrinsics, pose(turn @ upright_camera, position))
    return Rig(cameras, reference="middle")


SEED_RIG = three_camera_rig()
"""Three D435 in portrait on a level beam along the row, 25 cm apart, the outer two turned 25 degrees to the middle."""


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
