"""Occupancy carving: free, occupied and unknown space from the depth images of a row.

A camera with a reading has seen through everything in front of it. A voxel whose eight corners have all been seen
through is free; one that holds points of the cloud is occupied; the others stay unknown: behind a surface, outside of
every image, or in front of a camera without a reading.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.settings_files import Positive, PositiveCount, check_numbers
from greenhouse_gym.errors import ReconstructionError
from greenhouse_gym.geometry import Array, invert, transform
from greenhouse_gym.reconstruction.row_cloud import RowCloud
from greenhouse_gym.reconstruction.station_views import BLOCK
from greenhouse_gym.scene.occupancy import CORNERS, FREE, OCCUPIED, UNKNOWN, States

_FARTHEST = 2.0  # m from a camera up to which its readings are used


@dataclass(frozen=True)
class CarvingSettings:
    """Settings of occupancy carving.

    Raises:
        InvalidValueError: A value is out of its bounds, such as the size of a voxel that is not positive.
    """

    voxel: Positive = 0.05  # m
    margin: float = 0.01  # m in front of a reading that may still be surface
    points: PositiveCount = 2  # points of the cloud in an occupied voxel
    aisle: bool = True  # space behind all cameras is free: the rig was pushed through it

    def __post_init__(self) -> None:
        check_numbers(self)


@dataclass(frozen=True, eq=False)
class CarvedSpace:
    """Occupancy of the space in front of a row."""

    states: States  # (x, y, z) state of each voxel, see `greenhouse_gym.scene.occupancy`
    origin: Array  # (3,) lower corner of the first voxel in the requested frame, metres
    voxel: float  # side of a voxel, metres

    def cut(self, low: npt.ArrayLike, high: npt.ArrayLike) -> tuple[States, Array]:
        """Return the voxels of a part from a corner (3,) to the opposite one, metres, and the part's origin (3,)."""
        first, last = (
            np.clip(np.rint((np.asarray(end) - self.origin) / self.voxel).astype(int), 0, self.states.shape)
            for end in (low, high)
        )
        part = self.states[tuple(slice(a, b) for a, b in zip(first, last, strict=True))]
        return part, self.origin + first * self.voxel


def carve(
    row: RowCloud, frame: Array, low: npt.ArrayLike, high: npt.ArrayLike, settings: CarvingSettings | None = None
) -> CarvedSpace:
    """Carve the occupancy of the space in front of a row.

    Args:
        row: The row with the space that its stations observed.
        frame: (4, 4) the requested frame from that of the cloud.
        low: (3,) lower corner of the space in the requested frame, metres.
        high: (3,) upper corner.
        settings: All settings.

    Raises:
        ReconstructionError: The row was read from a file, which holds no depth images.
    """
    settings = settings or CarvingSettings()
    cameras = _cameras(row, frame)
    voxel = settings.voxel
    first = np.floor(np.asarray(low, dtype=np.float64) / voxel).astype(int)
    shape = np.maximum(np.ceil(np.asarray(high, dtype=np.float64) / voxel).astype(int) - first, 1)
    origin = first * voxel
    centers = ((np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3) + 0.5) * voxel + origin).astype(np.float32)
    behind = min(float(pose[0, 3]) for pose, *_ in cameras)
    aisle = centers[:, 0] + voxel / 2 <= behind if settings.aisle else np.zeros(len(centers), dtype=bool)
    free = aisle.copy()
    pending = np.flatnonzero(~aisle)
    through = np.ones(len(pending), dtype=bool)
    for corner in CORNERS:
        left = np.flatnonzero(through)
        corners = centers[pending[left]] + (corner * voxel).astype(np.float32)
        through[left[~_seen_through(corners, cameras, settings.margin)]] = False
    free[pending[through]] = True
    states = np.where(free, FREE, UNKNOWN).astype(np.uint8).reshape(shape)
    cells = np.floor((transform(frame, row.points) - origin) / voxel).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < shape)).all(axis=1)]
    hits = np.bincount(np.ravel_multi_index(tuple(cells.T), tuple(shape)), minlength=states.size).reshape(shape)
    states[hits >= settings.points] = OCCUPIED
    return CarvedSpace(states, origin, voxel)


_Camera = tuple[Array, npt.NDArray[np.float32], Array]


def _cameras(row: RowCloud, frame: Array) -> list[_Camera]:
    """Return each station's cameras: pose in the frame, nearest readings, metres, and camera matrix in blocks."""
    if row.observed is None:
        raise ReconstructionError(
            "the row's cloud was read from a file, without the depth images that carving needs: reconstruct it again"
        )
    cameras = []
    for i in np.flatnonzero(row.registered):
        for name, depth in row.observed.min_depths[int(i)].items():
            camera = row.observed.rig.cameras[name]
            pose = frame @ row.world_from_station[i] @ camera.rig_from_camera
            blocks = camera.intrinsics.matrix.copy()
            blocks[:2, 2] += 0.5  # pixels are counted from their centers
            blocks[:2] /= BLOCK
            cameras.append((pose, (depth / np.float32(1e3)).astype(np.float32), blocks))
    return cameras


def _seen_through(points: npt.NDArray[np.float32], cameras: list[_Camera], margin: float) -> npt.NDArray[np.bool_]:
    """Mask the points (n, 3) that any camera has seen through."""
    result = np.zeros(len(points), dtype=bool)
    pending = np.argsort(points[:, 1], kind="stable")
    along = points[pending, 1]
    for pose, depth, blocks in cameras:
        span = slice(*np.searchsorted(along, [pose[1, 3] - _FARTHEST / 2, pose[1, 3] + _FARTHEST / 2]))
        near = pending[span]
        camera_from_frame = invert(pose)
        projection = (blocks @ camera_from_frame[:3, :3]).astype(np.float32)
        shift = (blocks @ camera_from_frame[:3, 3]).astype(np.float32)
        u, v, z = projection @ points[near].T + shift[:, None]
        ahead = np.flatnonzero((z > 1e-3) & (z < _FARTHEST))
        column, line = (u[ahead] / z[ahead]).astype(np.int64), (v[ahead] / z[ahead]).astype(np.int64)
        height, width = depth.shape
        inside = (u[ahead] >= 0) & (v[ahead] >= 0) & (column < width) & (line < height)
        ahead, column, line = ahead[inside], column[inside], line[inside]
        through = ahead[depth[line, column] > z[ahead] + margin]
        result[near[through]] = True
        keep = np.ones(len(pending), dtype=bool)
        keep[span.start + through] = False
        pending, along = pending[keep], along[keep]
    return result
