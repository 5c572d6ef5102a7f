"""Registry of recording formats: `open_recording` reads the package's own and those of installed packages.

A format is a module, or any object, with a ``name``, a ``description``, ``recognizes(path)`` and ``open(path)``. A
package that provides one names it among its entry points:

    [project.entry-points."greenhouse_gym.formats"]
    my-rig = "my_package.my_rig"
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

from greenhouse_gym.capture.formats import bags, bop, calibrated, described, open3d, own, scannet, tum
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.capture.rig import RgbdFrame, Station
from greenhouse_gym.common.files import parsing
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError

ENTRY_POINTS = "greenhouse_gym.formats"
"""Group of entry points by which other packages add formats."""


class RecordingFormat(Protocol):
    """Protocol of a module that reads one kind of recording."""

    @property
    def name(self) -> str:
        """Name in ``open_recording(path, format=name)``."""

    @property
    def description(self) -> str:
        """Contents of a recording of this kind, in a few words."""

    def recognizes(self, path: Path) -> bool:
        """Return whether a path looks like a recording of this kind, without reading images or raising errors."""

    def open(self, path: Path) -> Recording:
        """Open the recording; its ``load`` reads a station when it is accessed."""


_OWN: tuple[RecordingFormat, ...] = (own, calibrated, open3d, tum, scannet, bop, described, bags)
_MISSING = "no such folder or file"


@cache
def recording_formats() -> Mapping[str, RecordingFormat]:
    """Return all formats by name: the package's own first, then those of installed packages.

    Raises:
        InvalidValueError: An installed package's format cannot be imported, lacks one of the four names, or has the
            name of another format.
    """
    formats = {known.name: known for known in _OWN}
    for entry in sorted(entry_points(group=ENTRY_POINTS), key=lambda entry: entry.name):
        where = f"the entry point {entry.name!r} ({entry.value}) of the group {ENTRY_POINTS}"
        try:
            found = _checked(entry.load(), where)
        except Exception as error:
            raise InvalidValueError(f"{where}: {error}") from error
        if found.name in formats:
            raise InvalidValueError(f"{where}: another format has the name {found.name!r}")
        formats[found.name] = found
    return MappingProxyType(formats)


def open_recording(path: str | Path, format: str | RecordingFormat | None = None) -> Recording:
    """Open a recording; each station is read when it is accessed.

    Args:
        path: Its folder, or a file that its format reads.
        format: A name in `recording_formats`, or a format; by default the one that recognizes the path.

    Raises:
        UnknownNameError: No format has that name.
        InvalidValueError: The format lacks one of the four names.
        FileFormatError: No format recognizes the path, or several do, or a file is missing or damaged. Images are
            checked when their station is read.
    """
    path = Path(path)
    if format is None:
        chosen = _recognized(path)
    elif isinstance(format, str):
        known = recording_formats()
        if format not in known:
            raise UnknownNameError("recording format", format, known)
        chosen = known[format]
        if chosen in _OWN and not path.exists():
            raise FileFormatError(path, _MISSING)
    else:
        chosen = _checked(format, "the given format")
    with parsing(path, f"recording of the format {chosen.name!r}"):
        recording = chosen.open(path)
    if not isinstance(recording, Recording) or recording.size < 1:
        kind = type(recording).__name__
        raise FileFormatError(path, f"the format {chosen.name!r} found no stations in it (it gave a {kind})")
    return replace(recording, load=_Checked(recording, path, chosen.name))


def _recognized(path: Path) -> RecordingFormat:
    formats = recording_formats()
    fitting = []
    for known in formats.values():
        with parsing(path, f"path for the format {known.name!r}"):
            if known.recognizes(path):
                fitting.append(known)
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        names = ", ".join(known.name for known in fitting)
        raise FileFormatError(path, f"several formats recognize it: {names}; choose one by its name")
    if not path.exists():
        raise FileFormatError(path, _MISSING)
    kinds = "; ".join(f"{known.name}: {known.description}" for known in formats.values())
    raise FileFormatError(path, f"not a recording of a known format ({kinds})")


def _checked(format: object, where: str) -> RecordingFormat:
    """Return the object, checked to be a format.

    Raises:
        InvalidValueError: It lacks one of the four names.
    """
    missing = [name for name in ("name", "description", "recognizes", "open") if not hasattr(format, name)]
    if missing:
        raise InvalidValueError(f"{where}, {format!r:.80}, is no recording format: it lacks {', '.join(missing)}")
    return format  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class _Checked:
    """Reader of a format's stations that checks their types."""

    recording: Recording
    path: Path
    name: str

    def __call__(self, i: int) -> Station:
        cameras = self.recording.rig.cameras
        with parsing(f"{self.path}, station {i}", f"station of the format {self.name!r}"):
            station = self.recording.load(i)
            if not isinstance(station, Station) or set(station.frames) != set(cameras):
                raise InvalidValueError(f"expected a frame of each camera ({', '.join(cameras)})")
            if not all(isinstance(frame, RgbdFrame) for frame in station.frames.values()):
                raise InvalidValueError("expected an RgbdFrame of each camera")
        return station

    def camera(self, i: int, name: str) -> RgbdFrame:
        with parsing(f"{self.path}, station {i}", f"station of the format {self.name!r}"):
            frame = self.recording.frame(i, name)
            if not isinstance(frame, RgbdFrame):
                raise InvalidValueError("expected an RgbdFrame of each camera")
        return frame
