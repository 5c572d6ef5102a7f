"""Recordings of any format, and what their readers share: images and poses of files, checked; and checksums."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field, FiniteFloat

from greenhouse_gym.capture.image_files import read_color, read_depth
from greenhouse_gym.capture.rig import Camera, RgbdFrame, Rig, Station, size_text
from greenhouse_gym.common.files import parsing
from greenhouse_gym.crops.crop import PlantRow
from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.geometry import Array, is_pose

_BLOCK = 2**20  # bytes


@dataclass(frozen=True)
class Pass:
    """One pass along the row.

    Attributes:
        first: Number of its first station.
        lift: Lift of the rig above that of the first pass, metres.
    """

    first: Annotated[int, Field(ge=0)]
    lift: FiniteFloat


@dataclass(frozen=True, eq=False)
class Recording:
    """Stations along a row: ``len(recording)`` of them, ``recording[i]`` reads or renders one.

    Attributes:
        name: Name in reports.
        rig: The cameras.
        size: Number of stations.
        load: Returns station i; called at each access, nothing is cached. It must be picklable to be used by other
            processes.
        folder: Folder on disk, or None for a simulated one.
        protocol: Name of its protocol in `greenhouse_gym.capture.PROTOCOLS`; None for the paper's, or where not known.
        passes: The passes along the row, each from about the same position; see `join_passes`.
        truth: The photographed row, in the frame of the stations' poses, with its collision shapes; None for a real
            row.
        notes: Sentences on omissions and assumptions of its reader.
        camera_poses: Whether known poses are those of the reference camera, around which a rig frame was assumed: a rig
            file then moves that frame, and the camera keeps its poses.
        files: Files that it is read from; empty for a simulated one. A change in them makes it another recording.
    """

    name: str
    rig: Rig
    size: int
    load: Callable[[int], Station]
    folder: Path | None = None
    protocol: str | None = None
    passes: tuple[Pass, ...] = (Pass(0, 0.0),)
    truth: PlantRow | None = None
    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()
    camera_poses: bool = False

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, index: int) -> Station:
        if not -self.size <= index < self.size:
            raise IndexError(f"recording {self.name!r} has {self.size} stations, not {index}")
        return self.load(index % self.size)

    def __iter__(self) -> Iterator[Station]:
        return (self.load(index) for index in range(self.size))

    def frame(self, index: int, camera: str) -> RgbdFrame:
        """Return one camera's image of a station; no other is read if ``load`` has a method ``camera(index, name)``."""
        alone = getattr(self.load, "camera", None)
        return self.load(index).frames[camera] if alone is None else alone(index, camera)


def read_frame(color_file: str | Path, depth_file: str | Path, camera: Camera) -> RgbdFrame:
    """Read one RGB-D image from a color and a depth file.

    Raises:
        FileFormatError: A file is missing, truncated, of the wrong kind, or the sizes disagree.
    """
    color, depth = read_color(color_file), read_depth(depth_file)
    if depth.shape != color.shape[:2]:
        problem = f"depth image is {size_text(depth.shape)}, its color image {color_file} is {size_text(color.shape)}"
        raise FileFormatError(depth_file, problem)
    try:
        return RgbdFrame(color, (depth * np.float32(camera.depth_scale)).astype(np.float32), camera.intrinsics)
    except InvalidValueError as error:
        raise FileFormatError(depth_file, str(error)) from error


def checked_pose(file: Path, label: str, matrix: npt.ArrayLike) -> Array:
    """Return a matrix of a file as a pose (4, 4), checked.

    Raises:
        FileFormatError: It has a wrong shape, is not finite, not a rotation, or its last row is not 0 0 0 1.
    """
    try:
        result = np.array(matrix, dtype=np.float64)
        if is_pose(result):
            return result
    except ValueError:
        pass
    raise FileFormatError(file, f"{label} is not a 4x4 pose: {matrix!r}")


def fingerprint(recording: Recording, contents: bool = True) -> str:
    """Return a checksum of a recording's cameras and images, in any format.

    Args:
        recording: The recording. Of one that is not on disk, the first and the last station are hashed.
        contents: Hash the contents of its files, so that a copy has the same fingerprint; otherwise their sizes and
            times, which is fast and reveals changes as well.

    Raises:
        FileFormatError: A file of the recording cannot be read.
    """
    passes = [(one.first, one.lift) for one in recording.passes]
    header = f"{len(recording)} {recording.protocol} {passes} {recording.truth is None}"
    checksum = hashlib.sha256(f"{header} {recording.rig.reference}".encode())
    for name, camera in recording.rig.cameras.items():
        checksum.update(f"\n{name} {camera.intrinsics} {camera.depth_scale!r}".encode())
        checksum.update(camera.rig_from_camera.tobytes())
    for part in _files(recording, contents) if recording.folder else _images(recording):
        checksum.update(part)
    return checksum.hexdigest()


def _files(recording: Recording, contents: bool) -> Iterator[bytes]:
    """Yield the name of each file, relative to the folder, and its content, or its size and time."""
    assert recording.folder is not None
    files = recording.files or tuple(sorted(path for path in recording.folder.rglob("*") if path.is_file()))
    for path in files:
        name = path.relative_to(recording.folder) if path.is_relative_to(recording.folder) else path
        yield f"\n{name} ".encode()
        if not path.is_file():
            yield b"missing"  # costs its station, not the recording
        elif contents:
            with parsing(path, "file of a recording"), path.open("rb") as file:
                checksum = hashlib.sha256()
                while block := file.read(_BLOCK):
                    checksum.update(block)
                yield checksum.digest()
        else:
            status = path.stat()
            yield f"{status.st_size} {status.st_mtime_ns}".encode()


def _images(recording: Recording) -> Iterator[bytes]:
    for i in sorted({0, len(recording) - 1}):
        try:
            station = recording[i]
        except FileFormatError:
            continue
        for name, frame in station.frames.items():
            yield name.encode()
            yield frame.color.tobytes()
            yield frame.depth.tobytes()
