"""Stations prepared for registration: corrected depth, foreground masks, points with colors and normals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.rig import D435_DEPTH, Camera, Intrinsics, RgbdFrame, Rig, Station
from greenhouse_gym.common.extras import needs
from greenhouse_gym.geometry import Array, transform
from greenhouse_gym.geometry.point_clouds import Cloud, PackedCloud, merge
from greenhouse_gym.reconstruction.edge_fattening import EdgeFattening, undo_edge_fattening
from greenhouse_gym.reconstruction.foreground import foreground_mask
from greenhouse_gym.reconstruction.settings import ReconstructionSettings

with needs("reconstruct"):
    import cv2

SAMPLES = 5000  # points of a station that ICP moves
NORMAL_WINDOW = 7  # px at the D435's 424 px of focal length, odd: side of the window in which a normal is fitted
BLOCK = 4  # px, side of the blocks of `MinDepth`

MinDepth: TypeAlias = npt.NDArray[np.uint16]
"""Nearest reading of each block of pixels (height / BLOCK, width / BLOCK), millimetres; 0 = no reading."""


def image_normals(
    depth: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], intrinsics: Intrinsics, window: int = 7
) -> Array:
    """Return unit normals toward the camera at the masked pixels of a depth image, in the camera frame.

    With x' = (u - cx) / fx and y' = (v - cy) / fy, the points of a plane n . X = d have 1/z = (n . (x', y', 1)) / d, so
    a linear fit of inverse depth in a window gives the normal's direction. Only masked pixels count, and all must
    have a reading, so the background of a surface does not bend its normals.

    Returns:
        (n, 3) unit vectors in the order of ``np.nonzero(mask)``; opposite to the line of sight where no fit exists.
    """
    k = intrinsics
    x = ((np.arange(k.width) - k.cx) / k.fx)[None, :].astype(np.float32)
    y = ((np.arange(k.height) - k.cy) / k.fy)[:, None].astype(np.float32)
    pixels = np.flatnonzero(mask)
    weight = mask.astype(np.float32)
    inverse = np.zeros(depth.shape, dtype=np.float32)
    inverse.ravel()[pixels] = 1.0 / depth.ravel()[pixels]

    def window_sum(image: npt.NDArray[np.float32]) -> Array:
        summed = cv2.boxFilter(image, -1, (window, window), normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed).ravel()[pixels].astype(np.float64)  # the filter adds up in float64 inside

    n = window_sum(weight)
    in_x, in_y = weight * x, weight * y
    mean_x, mean_y, mean_d = (window_sum(image) / n for image in (in_x, in_y, inverse))
    xx = window_sum(in_x * x) / n - mean_x**2
    yy = window_sum(in_y * y) / n - mean_y**2
    xy = window_sum(in_x * y) / n - mean_x * mean_y
    xd = window_sum(inverse * x) / n - mean_x * mean_d
    yd = window_sum(inverse * y) / n - mean_y * mean_d
    # a small ridge, a hundredth of a pixel squared, keeps lines of pixels solvable
    xx, yy = xx + 0.01 / k.fx**2, yy + 0.01 / k.fy**2
    determinant = xx * yy - xy**2
    a, b = (xd * yy - yd * xy) / determinant, (yd * xx - xd * xy) / determinant
    c = mean_d - a * mean_x - b * mean_y
    rows, columns = np.divmod(pixels, k.width)
    ray_x, ray_y = x[0, columns], y[rows, 0]
    size = np.sqrt(a * a + b * b + c * c)
    toward = -np.sign(a * ray_x + b * ray_y + c) / np.maximum(size, 1e-9)
    normals = np.column_stack([a * toward, b * toward, c * toward])
    if (flat := size <= 1e-9).any():
        against = -np.column_stack([ray_x, ray_y, np.ones(len(pixels))])[flat]
        normals[flat] = against / np.linalg.norm(against, axis=1, keepdims=True)
    return normals


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibrated cameras, as far as their errors are known; a camera reports ``(1 + bias)`` times the depth."""

    rig: Rig  # with corrected camera poses
    bias: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))  # relative depth error by camera
    edge_fattening: EdgeFattening = field(default_factory=EdgeFattening)  # of the depth images of all cameras


@dataclass(frozen=True, eq=False)
class CameraView:
    """One camera's image of a station, corrected."""

    camera: Camera
    color: npt.NDArray[np.uint8]  # (height, width, 3) RGB
    depth: npt.NDArray[np.float32]  # (height, width) metres, corrected; 0 = no reading
    foreground: npt.NDArray[np.bool_]  # (height, width) mask of the row's pixels
    normals: npt.NDArray[np.float32]  # (height, width, 3) unit, in the rig frame, toward the camera

    def points(self, rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]) -> Array:
        """Return the points (n, 3) of pixels (n,) in the rig frame."""
        in_camera = self.camera.intrinsics.back_project(rows, columns, self.depth[rows, columns])
        return transform(self.camera.rig_from_camera, in_camera)

    def cloud(self, rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]) -> Cloud:
        """Return foreground pixels (n,) as a cloud in the rig frame."""
        normals = self.normals[rows, columns].astype(np.float64)
        return Cloud(self.points(rows, columns), self.color[rows, columns] / 255.0, normals)

    def min_depth(self) -> MinDepth:
        """Return the nearest reading of each block of pixels, beyond which the camera cannot have seen through."""
        k, far = self.camera.intrinsics, np.iinfo(np.uint16).max
        millimetres = np.where(self.depth > 0, np.minimum(1e3 * self.depth, far - 1), far).astype(np.uint16)
        padded = np.pad(millimetres, ((0, -k.height % BLOCK), (0, -k.width % BLOCK)), constant_values=far)
        blocks = padded.reshape(padded.shape[0] // BLOCK, BLOCK, -1, BLOCK).min(axis=(1, 3))
        return np.where(blocks == far, 0, blocks).astype(np.uint16)

    def sample(self, count: int) -> Cloud:
        """Sample about ``count`` pixels of the foreground evenly, as a cloud in the rig frame."""
        pixels = np.flatnonzero(self.foreground)
        chosen = pixels[np.linspace(0, len(pixels) - 1, min(count, len(pixels))).astype(np.int64)]
        return self.cloud(*np.divmod(chosen, self.foreground.shape[1]))


@dataclass(frozen=True, eq=False)
class StationView:
    """All cameras' images of a station, corrected."""

    cameras: Mapping[str, CameraView]  # by name
    reference: CameraView  # the camera whose silhouettes align the stations
    sample: Cloud  # subset of the foreground in the rig frame, for ICP to move
    world_from_station: Array | None = None  # (4, 4) as the recording gives it

    @property
    def blind(self) -> tuple[str, ...]:
        """Names of the cameras without any foreground."""
        return tuple(name for name, camera in self.cameras.items() if not camera.foreground.any())

    def min_depths(self) -> dict[str, MinDepth]:
        """Return the nearest reading of each block of pixels of each camera."""
        return {name: camera.min_depth() for name, camera in self.cameras.items()}

    def packed_cloud(self) -> PackedCloud:
        """Return every other foreground pixel of all cameras, as on a checkerboard, in the rig frame.

        Stereo matching correlates the noise of neighbors, so the other half would add little.
        """
        points, colors, normals = [], [], []
        for view in self.cameras.values():
            rows, columns = np.divmod(np.flatnonzero(view.foreground), view.foreground.shape[1])
            black = (rows + columns) % 2 == 0
            rows, columns = rows[black], columns[black]
            points.append(view.points(rows, columns).astype(np.float32))
            colors.append(view.color[rows, columns])
            normals.append(np.rint(127 * view.normals[rows, columns]).astype(np.int8))
        return PackedCloud(np.concatenate(points), np.concatenate(colors), np.concatenate(normals))


def _window(camera: Camera) -> int:
    """Return the side of the window for normals, pixels: as wide an angle as with the D435's depth mode, or wider."""
    finer = camera.intrinsics.fx / D435_DEPTH.fx
    return NORMAL_WINDOW if finer <= 1 else 2 * int(NORMAL_WINDOW * finer / 2) + 1


def camera_view(frame: RgbdFrame, name: str, calibration: Calibration, settings: ReconstructionSettings) -> CameraView:
    """Correct one image by its camera's depth error and edge fattening, and extract its foreground."""
    camera = calibration.rig.cameras[name]
    depth = np.nan_to_num(frame.depth, posinf=0.0, neginf=0.0) / np.float32(1.0 + calibration.bias.get(name, 0.0))
    depth = undo_edge_fattening(depth, calibration.edge_fattening)
    mask = foreground_mask(depth, camera, calibration.rig, settings.foreground)
    normals = np.zeros((*depth.shape, 3), dtype=np.float32)
    in_camera = image_normals(depth, mask, camera.intrinsics, _window(camera))
    normals.reshape(-1, 3)[np.flatnonzero(mask)] = in_camera @ camera.rig_from_camera[:3, :3].T
    return CameraView(camera, frame.color, depth, mask, normals)


def station_view(station: Station, calibration: Calibration, settings: ReconstructionSettings) -> StationView:
    """Prepare a station for registration and merging."""
    cameras = {name: camera_view(frame, name, calibration, settings) for name, frame in station.frames.items()}
    sizes = {name: np.count_nonzero(view.foreground) for name, view in cameras.items()}
    every = max(1, round(sum(sizes.values()) / SAMPLES))
    return StationView(
        cameras,
        cameras[calibration.rig.reference],
        merge([view.sample(int(sizes[name]) // every) for name, view in cameras.items()]),
        station.world_from_station,
    )
