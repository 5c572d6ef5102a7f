"""Carving: what the registered frames of a row say of the space before it.

A camera that measures a depth has seen through everything up to it. A voxel through which cameras have seen at all its
eight places is empty; one that holds points of the cloud is surface; the others stay unknown, those behind a
surface, outside of every image, or before a camera that measured nothing there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.setting_checks import check_numbers
from greenhouse_gym.errors import ReconstructionError
from greenhouse_gym.geometry import Array, invert, transform
from greenhouse_gym.reconstruction.row import Look, RowCloud
from greenhouse_gym.reconstruction.views import BLOCK
from greenhouse_gym.scene.occupancy import CORNERS, FREE, OCCUPIED, UNKNOWN, States

_FARTHEST = 2.0  # m from a camera up to which its readings are asked


@dataclass(frozen=True)
class CarvingSettings:
    """How the seen space is carved.

    Raises:
        InvalidValueError: A value is not what it can be, such as the size of a voxel that is not positive.
    """

    voxel: float = 0.05  # m
    margin: float = 0.01  # m before a reading that may still be surface
    points: int = 2  # points of the cloud that make a voxel surface
    aisle: bool = True  # what lies behind all cameras counts as empty: somebody pushed the rig through it

    def __post_init__(self) -> None:
        check_numbers(self, positive=("voxel", "points"))


@dataclass(frozen=True, eq=False)
class Carving:
    """The space before a row.

    Attributes:
        states: (x, y, z) what each voxel is, of `greenhouse_gym.scene.occupancy`.
        origin: (3,) lower corner of the first voxel in the frame asked for, metres.
        voxel: Side of a voxel, metres.
    """

    states: States
    origin: Array
    voxel: float

    def cut(self, low: npt.ArrayLike, high: npt.ArrayLike) -> tuple[States, Array]:
        """The voxels of a part from a corner (3,) to the opposite one, metres, and the part's origin (3,)."""
        first, last = (
            np.clip(np.rint((np.asarray(end) - self.origin) / self.voxel).astype(int), 0, self.states.shape)
            for end in (low, high)
        )
        part = self.states[tuple(slice(a, b) for a, b in zip(first, last, strict=True))]
        return part, self.origin + first * self.voxel


def carve(
    row: RowCloud, frame: Array, low: npt.ArrayLike, high: npt.ArrayLike, settings: CarvingSettings | None = None
) -> Carving:
    """Carve the space before a row.

    Args:
        row: The row with what its stations saw.
        frame: (4, 4) the wanted frame from that of the cloud.
        low: (3,) lower corner of the space in the wanted frame, metres.
        high: (3,) upper corner.
        settings: All settings.

    Raises:
        ReconstructionError: The row does not know what its stations saw: it was read from a file.
    """
    settings = settings or CarvingSettings()
    if row.sight is None:
        raise ReconstructionError(
            "the row's cloud carries no sight of its stations: reconstruct it anew, not from a file"
        )
    voxel = settings.voxel
    first = np.floor(np.asarray(low, dtype=np.float64) / voxel).astype(int)
    shape = np.maximum(np.ceil(np.asarray(high, dtype=np.float64) / voxel).astype(int) - first, 1)
    origin = first * voxel
    centers = ((np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3) + 0.5) * voxel + origin).astype(np.float32)
    cameras = _cameras(row, frame)
    behind = min(float(pose[0, 3]) for pose, *_ in cameras)
    aisle = centers[:, 0] + voxel / 2 <= behind if settings.aisle else np.zeros(len(centers), dtype=bool)
    empty = aisle.copy()
    pending = np.flatnonzero(~aisle)
    through = np.ones(len(pending), dtype=bool)
    for corner in CORNERS:
        left = np.flatnonzero(through)
        seen = _seen_through(centers[pending[left]] + (corner * voxel).astype(np.float32), cameras, settings.margin)
        through[left[~seen]] = False
    empty[pending[through]] = True
    states = np.where(empty, FREE, UNKNOWN).astype(np.uint8).reshape(shape)
    cells = np.floor((transform(frame, row.points) - origin) / voxel).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < shape)).all(axis=1)]
    hits = np.bincount(np.ravel_multi_index(tuple(cells.T), tuple(shape)), minlength=states.size).reshape(shape)
    states[hits >= settings.points] = OCCUPIED
    return Carving(states, origin, voxel)


_Camera = tuple[Array, npt.NDArray[np.float32], Array]


def _cameras(row: RowCloud, frame: Array) -> list[_Camera]:
    """Each camera of stations and looks: its pose in the frame, its screen, metres, and its matrix in blocks."""
    assert row.sight is not None
    cameras = []
    places = [
        Look(row.world_from_station[i], row.sight.rig, row.sight.screens[int(i)])
        for i in np.flatnonzero(row.registered)
    ]
    for place in (*places, *row.sight.looks):
        for name, screen in place.screens.items():
            camera = place.rig.cameras[name]
            pose = frame @ place.row_from_rig @ camera.rig_from_camera
            blocks = camera.intrinsics.matrix.copy()
            blocks[:2, 2] += 0.5  # pixels are counted from their middles
            blocks[:2] /= BLOCK
            cameras.append((pose, (screen / np.float32(1e3)).astype(np.float32), blocks))
    return cameras


def _seen_through(points: npt.NDArray[np.float32], cameras: list[_Camera], margin: float) -> npt.NDArray[np.bool_]:
    """Which points (n, 3) some camera saw through."""
    seen = np.zeros(len(points), dtype=bool)
    order = np.argsort(points[:, 1], kind="stable")
    open_ones, along = order, points[order, 1]
    for pose, screen, blocks in cameras:
        span = slice(*np.searchsorted(along, [pose[1, 3] - _FARTHEST / 2, pose[1, 3] + _FARTHEST / 2]))
        asked = open_ones[span]
        camera_from_frame = invert(pose)
        projection = (blocks @ camera_from_frame[:3, :3]).astype(np.float32)
        shift = (blocks @ camera_from_frame[:3, 3]).astype(np.float32)
        u, v, z = projection @ points[asked].T + shift[:, None]
        ahead = np.flatnonzero((z > 1e-3) & (z < _FARTHEST))
        column, line = (u[ahead] / z[ahead]).astype(np.int64), (v[ahead] / z[ahead]).astype(np.int64)
        height, width = screen.shape
        inside = (u[ahead] >= 0) & (v[ahead] >= 0) & (column < width) & (line < height)
        ahead, column, line = ahead[inside], column[inside], line[inside]
        through = ahead[screen[line, column] > z[ahead] + margin]
        seen[asked[through]] = True
        keep = np.ones(len(open_ones), dtype=bool)
        keep[span.start + through] = False
        open_ones, along = open_ones[keep], along[keep]
    return seen
