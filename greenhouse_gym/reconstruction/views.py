"""A station as registration sees it: its images in metres, its foreground as points with colors and normals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.frames import RgbdFrame, Station
from greenhouse_gym.capture.rig import D435_DEPTH, Camera, Rig
from greenhouse_gym.geometry import Array, transform
from greenhouse_gym.reconstruction.fattening import Fattening, without_fattening
from greenhouse_gym.reconstruction.foreground import foreground_mask
from greenhouse_gym.reconstruction.normals import image_normals
from greenhouse_gym.reconstruction.point_clouds import Cloud, PackedCloud, merge
from greenhouse_gym.reconstruction.settings import ReconstructionSettings

BLOCK = 4  # px, side of the blocks of a screen
Screen: TypeAlias = npt.NDArray[np.uint16]
"""(height / BLOCK, width / BLOCK) millimetres, rounded up; 0 = no reading."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """The cameras as they are, where that could be found out.

    Attributes:
        rig: The rig with the cameras where they stand.
        bias: Relative depth error by camera: it reports ``(1 + bias)`` times the depth; 0 where not named.
        fattening: By how much near things grow over far ones in the depth images of all cameras.
    """

    rig: Rig
    bias: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    fattening: Fattening = field(default_factory=Fattening)


@dataclass(frozen=True, eq=False)
class CameraView:
    """What one camera of a station sees.

    Attributes:
        camera: The camera.
        color: (height, width, 3) uint8 RGB.
        depth: (height, width) float32 metres, the depth error and the fattening taken out; 0 = no reading.
        foreground: (height, width) mask of the row's pixels.
        normals: (height, width, 3) float32 unit normals of the foreground in the rig frame, toward the camera.
    """

    camera: Camera
    color: npt.NDArray[np.uint8]
    depth: npt.NDArray[np.float32]
    foreground: npt.NDArray[np.bool_]
    normals: npt.NDArray[np.float32]

    def points(self, rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]) -> Array:
        """Points (n, 3) in the rig frame of some pixels (n,)."""
        in_camera = self.camera.intrinsics.back_project(rows, columns, self.depth[rows, columns])
        return transform(self.camera.rig_from_camera, in_camera)

    def cloud(self, rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]) -> Cloud:
        """Some pixels (n,) of the foreground as a cloud in the rig frame."""
        return Cloud(
            self.points(rows, columns),
            self.color[rows, columns] / 255.0,
            self.normals[rows, columns].astype(np.float64),
        )

    def screen(self) -> Screen:
        """The nearest reading of each block of pixels: what lies behind it, the camera cannot have seen through."""
        k, far = self.camera.intrinsics, np.iinfo(np.uint16).max
        millimetres = np.where(self.depth > 0, np.minimum(1e3 * self.depth, far - 1), far).astype(np.uint16)
        padded = np.pad(millimetres, ((0, -k.height % BLOCK), (0, -k.width % BLOCK)), constant_values=far)
        blocks = padded.reshape(padded.shape[0] // BLOCK, BLOCK, -1, BLOCK).min(axis=(1, 3))
        return np.where(blocks == far, 0, blocks).astype(np.uint16)

    def sample(self, count: int) -> Cloud:
        """About ``count`` pixels of the foreground, evenly over them, as a cloud in the rig frame."""
        pixels = np.flatnonzero(self.foreground)
        chosen = pixels[np.linspace(0, len(pixels) - 1, min(count, len(pixels))).astype(np.int64)]
        return self.cloud(*np.divmod(chosen, self.foreground.shape[1]))


@dataclass(frozen=True, eq=False)
class StationView:
    """What all cameras of a station see.

    Attributes:
        cameras: By name.
        reference: The camera whose silhouettes align the stations.
        sample: Some of the foreground in the rig frame, for ICP to move.
        world_from_station: (4, 4) pose of the rig frame as the recording gives it; None where it does not.
    """

    cameras: Mapping[str, CameraView]
    reference: CameraView
    sample: Cloud
    world_from_station: Array | None = None

    def cloud(self) -> PackedCloud:
        """Every other pixel of the foreground of all cameras, as on a checkerboard, in the rig frame.

        Stereo matching shares its noise among neighbors, so the other half would say little more.
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


def _window(camera: Camera, settings: ReconstructionSettings) -> int:
    """Side in pixels of the window a normal is fitted in: as wide an angle as with the D435's depth mode, if finer."""
    wider = camera.intrinsics.fx / D435_DEPTH.fx
    return settings.normal_window if wider <= 1 else 2 * int(settings.normal_window * wider / 2) + 1


def view_camera(frame: RgbdFrame, name: str, calibration: Calibration, settings: ReconstructionSettings) -> CameraView:
    """What one image shows, the camera's depth error and its fattening taken out."""
    camera = calibration.rig.cameras[name]
    depth = np.nan_to_num(frame.depth, posinf=0.0, neginf=0.0) / np.float32(1.0 + calibration.bias.get(name, 0.0))
    depth = without_fattening(depth, calibration.fattening)
    mask = foreground_mask(depth, camera, calibration.rig, settings.foreground)
    normals = np.zeros((*depth.shape, 3), dtype=np.float32)
    in_camera = image_normals(depth, mask, camera.intrinsics, _window(camera, settings))
    normals.reshape(-1, 3)[np.flatnonzero(mask)] = in_camera @ camera.rig_from_camera[:3, :3].T
    return CameraView(camera, frame.color, depth, mask, normals)


def view_station(station: Station, calibration: Calibration, settings: ReconstructionSettings) -> StationView:
    """Prepare a station for registration and merging."""
    cameras = {name: view_camera(frame, name, calibration, settings) for name, frame in station.frames.items()}
    share = {name: np.count_nonzero(view.foreground) for name, view in cameras.items()}
    every = max(1, round(sum(share.values()) / settings.samples))
    return StationView(
        cameras,
        cameras[calibration.rig.reference],
        merge([view.sample(int(share[name]) // every) for name, view in cameras.items()]),
        station.world_from_station,
    )
