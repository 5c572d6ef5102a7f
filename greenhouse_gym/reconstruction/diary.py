"""What a walk has registered so far, noted station by station so that an interrupted one goes on.

A folder holds ``walk.jsonl``, a header and one line per station, and ``000012.npz``, each station's cloud. Checksums
tell what an interruption or a bad disk spoiled; the walk is done again from there.
"""

from __future__ import annotations

import io
import json
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from greenhouse_gym.capture.fingerprint import fingerprint
from greenhouse_gym.capture.recordings import Recording
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.errors import FileWriteError
from greenhouse_gym.reconstruction.graph import Edge
from greenhouse_gym.reconstruction.point_clouds import PackedCloud
from greenhouse_gym.reconstruction.report import StationReport
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.views import Screen

_REPORT = TypeAdapter(StationReport)
_VERSION = 3  # version of what a walk finds; raise it when registration changes, so that old notes are not continued


@dataclass(frozen=True, eq=False)
class Entry:
    """One station.

    Attributes:
        report: What happened to it; ``segment`` is the number of its segment's first station.
        edges: Its accepted registrations, by the number of the earlier station.
        cloud: Its foreground in its rig frame; None where it has none.
        screens: What each of its cameras did not see through.
    """

    report: StationReport
    edges: dict[int, Edge] = field(default_factory=dict)
    cloud: PackedCloud | None = None
    screens: Mapping[str, Screen] = field(default_factory=dict)


@dataclass(eq=False)
class Diary:
    """Entries in the order of the stations, and where they are kept.

    Attributes:
        folder: None keeps them in memory alone.
        entries: So far.
    """

    folder: Path | None
    entries: list[Entry]

    @classmethod
    def open(cls, folder: Path | None, recording: Recording, settings: ReconstructionSettings) -> Diary:
        """Continue what was noted of the same recording with the same settings, or begin anew."""
        if folder is None:
            return cls(None, [])
        header = json.dumps(_identity(recording, settings), sort_keys=True)
        log = folder / "walk.jsonl"
        lines = log.read_text(errors="replace").splitlines() if log.exists() else []
        if not lines or lines[0] != header:
            write_atomically(log, header + "\n")
            return cls(folder, [])
        entries: list[Entry] = []
        for line in lines[1:]:
            try:
                entry = _entry(json.loads(line), folder)
            except (OSError, ValueError, KeyError, TypeError, AttributeError):
                break  # the interruption fell into this line or its cloud
            if entry.report.station != len(entries):
                break
            entries.append(entry)
        write_atomically(log, "\n".join([header, *lines[1 : len(entries) + 1]]) + "\n")
        return cls(folder, entries)

    def write(self, entry: Entry) -> None:
        """Note a station; its cloud is put in place before the line that names it."""
        self.entries.append(entry)
        if self.folder is None:
            return
        checksum = None
        if entry.cloud is not None:
            buffer = io.BytesIO()
            arrays: dict[str, Any] = vars(entry.cloud) | {f"screen {k}": screen for k, screen in entry.screens.items()}
            np.savez(buffer, **arrays)
            write_atomically(_cloud_file(self.folder, entry.report.station), buffer.getvalue())
            checksum = zlib.crc32(buffer.getbuffer())
        line = {
            "report": asdict(entry.report),
            "cloud": checksum,
            "edges": {k: [matrix.tolist() for matrix in edge] for k, edge in entry.edges.items()},
        }
        log = self.folder / "walk.jsonl"
        try:
            with log.open("a") as file:
                file.write(json.dumps(line | {"checksum": _checksum(line)}) + "\n")
        except OSError as error:
            raise FileWriteError(log, error) from error


def _identity(recording: Recording, settings: ReconstructionSettings) -> dict[str, Any]:
    """What tells one walk from another: the recording, and all settings."""
    return {
        "version": _VERSION, "recording": recording.name, "fingerprint": fingerprint(recording, contents=False),
        "settings": json.loads(json.dumps(asdict(settings))),
    }  # fmt: skip


def _checksum(line: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(line).encode())


def _entry(line: dict[str, Any], folder: Path) -> Entry:
    """What a line says.

    Raises:
        ValueError: The line or its cloud is not what was written; other errors where it is not even a line.
    """
    if line.pop("checksum") != _checksum(line):
        raise ValueError("the line was spoiled")
    report = _REPORT.validate_python(line["report"])
    cloud, screens = None, {}
    if line["cloud"] is not None:
        content = _cloud_file(folder, report.station).read_bytes()
        if zlib.crc32(content) != line["cloud"]:
            raise ValueError("the cloud was spoiled")
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            cloud = PackedCloud(file["points"], file["colors"], file["normals"])
            screens = {name[7:]: file[name] for name in file.files if name.startswith("screen ")}
    edges = {int(k): Edge(np.array(pose), np.array(information)) for k, (pose, information) in line["edges"].items()}
    return Entry(report, edges, cloud, screens)


def _cloud_file(folder: Path, station: int) -> Path:
    return folder / f"{station:06d}.npz"
