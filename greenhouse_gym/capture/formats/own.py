"""The package's own folders, read and written.

A folder holds ``recording.json`` and ``color/<camera>/000000.png``, ``depth/<camera>/000000.png`` (uint16). The images
of a station are read at each access, so a recording of any length needs the memory of one station. The ground truth of
a simulated recording is in ``truth.npz``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, model_validator

from greenhouse_gym.capture.image_files import encode_png
from greenhouse_gym.capture.recordings import Pass, Recording, checked_pose, read_frame
from greenhouse_gym.capture.rig import Camera, Intrinsics, Rig, Station
from greenhouse_gym.common.files import exclusive, inside, parsing, read_bytes, write_atomically
from greenhouse_gym.crops.truth_shapes import TRUTH, load_truth, save_truth
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.geometry import Array

INDEX = "recording.json"
_COARSEST = 0.001  # m, largest unit of depth that is written

name = "greenhouse"
description = f"{INDEX} and the images it names"


def recognizes(path: Path) -> bool:
    """Return whether the folder has an index."""
    return (path / INDEX).is_file()


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid")


class CameraRecord(_Model):
    """A camera in ``recording.json``.

    Attributes:
        width: Pixels.
        height: Pixels.
        fx: Focal length along the rows of the image, pixels.
        fy: Focal length along its columns, pixels.
        cx: Principal point, pixels.
        cy: Principal point, pixels.
        rig_from_camera: 4x4 pose of the camera on the tripod.
        depth_scale: Metres per unit of the depth images.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rig_from_camera: list[list[float]]
    depth_scale: float

    def camera(self) -> Camera:
        """Return the camera that this record describes."""
        intrinsics = Intrinsics(self.width, self.height, self.fx, self.fy, self.cx, self.cy)
        return Camera(intrinsics, np.array(self.rig_from_camera), self.depth_scale)


class StationRecord(_Model):
    """A station in ``recording.json``.

    Attributes:
        color: Color image of each camera, relative to the folder.
        depth: Depth image of each camera, aligned to the color image.
        world_from_station: 4x4 pose of the station, if known.
    """

    color: dict[str, str]
    depth: dict[str, str]
    world_from_station: list[list[float]] | None = None


class RecordingIndex(_Model):
    """Content of ``recording.json``.

    Attributes:
        name: Name of the row.
        reference: Camera whose silhouettes align the stations.
        cameras: Cameras by name.
        stations: Stations in their order along the row.
        protocol: Capture protocol, which sets the default settings.
        passes: Passes along the row.
    """

    schema_version: Literal[1] = 1
    name: str
    reference: str
    cameras: dict[str, CameraRecord]
    stations: list[StationRecord]
    protocol: str | None = None
    passes: tuple[Pass, ...] = (Pass(0, 0.0),)

    @model_validator(mode="after")
    def _passes_in_order(self) -> RecordingIndex:
        firsts = [one.first for one in self.passes]
        if firsts[:1] != [0] or firsts != sorted(set(firsts)) or firsts[-1] >= max(1, len(self.stations)):
            raise ValueError(f"passes must begin at station 0 and then at ever later stations, got {firsts}")
        return self


def open(path: Path) -> Recording:
    """Open a folder in the package's own format; each station is read when it is accessed.

    Raises:
        FileFormatError: The index is missing or damaged, or describes an impossible camera. Image files are checked
            when their station is read: missing, truncated, or of another size than the camera's.
    """
    folder = Path(path)
    file = folder / INDEX
    content = read_bytes(file, "recording index")
    with parsing(file, "recording index"):
        index = RecordingIndex.model_validate_json(content)
    try:
        rig = Rig({name: _camera(file, name, record) for name, record in index.cameras.items()}, index.reference)
    except InvalidValueError as error:
        raise FileFormatError(file, str(error)) from error
    images = [
        {kind: {name: inside(folder, image, named_in=file) for name, image in names.items()} for kind, names in both}
        for both in ((("color", record.color), ("depth", record.depth)) for record in index.stations)
    ]
    poses = [
        None if matrix is None else checked_pose(file, f"station {i}: world_from_station", matrix)
        for i, matrix in enumerate(record.world_from_station for record in index.stations)
    ]

    truth = load_truth(folder / TRUTH)
    image_files = [image for station in images for kind in station.values() for image in kind.values()]
    files = (file, *([folder / TRUTH] if truth else []), *image_files)
    load = partial(_station, file, rig, images, poses)
    return Recording(index.name, rig, len(index.stations), load, folder, index.protocol, index.passes, truth, files)


def _station(
    file: Path, rig: Rig, images: list[dict[str, dict[str, Path]]], poses: list[Array | None], i: int
) -> Station:
    """Read station ``i`` of a folder with the index ``file``."""
    color, depth = images[i]["color"], images[i]["depth"]
    frames = {}
    for name, camera in rig.cameras.items():
        if name not in color or name not in depth:
            raise FileFormatError(file, f"station {i} names no images for camera {name!r}")
        frames[name] = read_frame(color[name], depth[name], camera)
    return Station(frames, poses[i])


def _camera(file: Path, name: str, record: CameraRecord) -> Camera:
    with parsing(file, f"recording index: camera {name!r}"):
        return record.camera()


def write_recording(recording: Recording, path: str | Path, on_station: Callable[[int], None] | None = None) -> Path:
    """Write a recording in the package's folder format, station by station, the index last.

    Each file is written atomically, and the index comes last, so an interrupted write leaves no half recording.
    Depth is stored as uint16 in units of the camera's depth scale, or of a millimetre where that is finer.
    ``on_station`` is called with the index of each station written.

    Raises:
        FileFormatError: The folder already holds a finished recording.
    """
    writer = RecordingWriter(path, recording.name, recording.rig, recording.protocol, recording.passes)
    with exclusive(writer.folder, "*/*/"):  # kinds of images of each camera
        for i in range(len(recording)):
            writer.add(recording[i])
            if on_station:
                on_station(i)
        if recording.truth is not None:
            save_truth(recording.truth, writer.folder / TRUTH)
        writer.save_index()
    return writer.folder


class RecordingWriter:
    """Writer of a recording, station by station; readable from the first `save_index` on.

    Raises:
        FileFormatError: The folder already holds a finished recording.
    """

    def __init__(
        self,
        path: str | Path,
        name: str,
        rig: Rig,
        protocol: str | None = None,
        passes: tuple[Pass, ...] = (Pass(0, 0.0),),
    ):
        self.folder = Path(path)
        if (self.folder / INDEX).exists():
            raise FileFormatError(self.folder / INDEX, "already holds a recording; choose another folder or remove it")
        cameras = {
            camera_name: CameraRecord(
                **vars(camera.intrinsics),
                rig_from_camera=camera.rig_from_camera.tolist(),
                depth_scale=min(camera.depth_scale, _COARSEST),
            )
            for camera_name, camera in rig.cameras.items()
        }
        self._index = RecordingIndex(
            name=name, reference=rig.reference, cameras=cameras, stations=[], protocol=protocol
        )
        self._index.passes = passes  # not validated before their stations

    @property
    def count(self) -> int:
        """Number of stations written."""
        return len(self._index.stations)

    def add(self, station: Station) -> None:
        """Write the images of a station."""
        cameras = self._index.cameras
        names = {kind: {name: f"{kind}/{name}/{self.count:06d}.png" for name in cameras} for kind in ("color", "depth")}
        for name, frame in station.frames.items():
            units = np.clip(np.rint(frame.depth / cameras[name].depth_scale), 0, np.iinfo(np.uint16).max)
            for kind, image in (("color", frame.color), ("depth", units.astype(np.uint16))):
                write_atomically(self.folder / names[kind][name], encode_png(image))
        known = station.world_from_station
        pose = None if known is None else known.tolist()
        self._index.stations.append(StationRecord(**names, world_from_station=pose))

    def save_index(self) -> None:
        """Write the index of all stations so far, which makes them a readable recording."""
        write_atomically(self.folder / INDEX, self._index.model_dump_json(indent=1) + "\n")
