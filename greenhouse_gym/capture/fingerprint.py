"""Checksums of recordings, so that results of one are never taken for those of another."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.common.files import parsing
from greenhouse_gym.errors import FileFormatError

_BLOCK = 2**20  # bytes


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
