"""One way in, `open_recording`, for every format that is known: the package's own, and those of installed packages.

A format is a module, or any object, with a ``name``, a ``description``, ``recognises(path)`` and ``open(path)``. A
package that brings one names it among its entry points:

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
from greenhouse_gym.capture.frames import RgbdFrame, Station
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.common.files import parsing
from greenhouse_gym.errors import FileFormatError, InvalidValueError, UnknownNameError

ENTRY_POINTS = "greenhouse_gym.formats"
"""The group of entry points by which other packages add formats."""


class RecordingFormat(Protocol):
    """What reads recordings of one kind; a module with these names is one."""

    @property
    def name(self) -> str:
        """What to call it, in ``open_recording(path, format=name)``."""

    @property
    def description(self) -> str:
        """What a recording of this kind consists of, in a few words."""

    def recognises(self, path: Path) -> bool:
        """Whether this looks like such a recording; no image is read, and nothing is raised for what it is not."""

    def open(self, path: Path) -> Recording:
        """The recording, whose ``load`` reads a station when it is asked for."""


_OWN: tuple[RecordingFormat, ...] = (own, calibrated, open3d, tum, scannet, bop, described, bags)
_MISSING = "there is no such folder or file"


@cache
def recording_formats() -> Mapping[str, RecordingFormat]:
    """All formats by name: the package's own first, then those that installed packages bring.

    Raises:
        InvalidValueError: An installed package's format cannot be imported, lacks one of the four names, or is called
            like another format.
    """
    formats = {known.name: known for known in _OWN}
    for entry in sorted(entry_points(group=ENTRY_POINTS), key=lambda entry: entry.name):
        where = f"the entry point {entry.name!r} ({entry.value}) of the group {ENTRY_POINTS}"
        try:
            found = _checked(entry.load(), where)
        except Exception as error:
            raise InvalidValueError(f"{where}: {error}") from error
        if found.name in formats:
            raise InvalidValueError(f"{where}: another format is called {found.name!r} as well")
        formats[found.name] = found
    return MappingProxyType(formats)


def open_recording(path: str | Path, format: str | RecordingFormat | None = None) -> Recording:
    """Open a recording; its stations are read when they are asked for.

    Args:
        path: Its folder, or whatever its format reads.
        format: One of `recording_formats` by name, or an object that is one; the one that recognizes the path when left
            out.

    Raises:
        UnknownNameError: No format is called so.
        InvalidValueError: What was given as a format is none.
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
        chosen = _checked(format, "the format that was given")
    with parsing(path, f"recording of the format {chosen.name!r}"):
        recording = chosen.open(path)
    if not isinstance(recording, Recording) or recording.size < 1:
        raise FileFormatError(path, f"the format {chosen.name!r} found no stations in it (it gave {recording!r:.80})")
    return replace(recording, load=_Checked(recording, path, chosen.name))


def _recognized(path: Path) -> RecordingFormat:
    formats = recording_formats()
    fitting = []
    for known in formats.values():
        with parsing(path, f"path for the format {known.name!r}"):
            if known.recognises(path):
                fitting.append(known)
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        names = ", ".join(known.name for known in fitting)
        raise FileFormatError(path, f"several formats recognize it: {names}; name the one that is meant")
    if not path.exists():
        raise FileFormatError(path, _MISSING)
    kinds = "; ".join(f"{known.name}: {known.description}" for known in formats.values())
    raise FileFormatError(path, f"not a recording of a known format ({kinds})")


def _checked(format: object, where: str) -> RecordingFormat:
    """The object, if it is a format.

    Raises:
        InvalidValueError: It lacks one of the four names.
    """
    missing = [name for name in ("name", "description", "recognises", "open") if not hasattr(format, name)]
    if missing:
        raise InvalidValueError(f"{where}, {format!r:.80}, is no recording format: it lacks {', '.join(missing)}")
    return format  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class _Checked:
    """Stations as a format's reader gives them, if they are some."""

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
