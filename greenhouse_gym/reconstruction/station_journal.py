"""Journal of the registered stations of a recording, from which an interrupted registration resumes.

A folder holds one file per station, ``000012.npz``, each with the identity of the registration. Registration is
repeated from the first file that is missing, damaged or of another identity.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from greenhouse_gym.capture.recordings import Recording, fingerprint
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.geometry.point_clouds import PackedCloud
from greenhouse_gym.reconstruction.pose_graph import PoseEdge
from greenhouse_gym.reconstruction.report import StationReport
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.station_views import MinDepth

_REPORT = TypeAdapter(StationReport)
_VERSION = 4  # of the registration; raise it when results change, so that older journals are not resumed


@dataclass(frozen=True, eq=False)
class JournalEntry:
    """Result of one station."""

    report: StationReport  # its report; ``segment`` is the number of its segment's first station
    edges: dict[int, PoseEdge] = field(default_factory=dict)  # by the number of the earlier station
    cloud: PackedCloud | None = None  # its foreground in its rig frame; None without any
    min_depths: Mapping[str, MinDepth] = field(default_factory=dict)  # nearest readings of each of its cameras


@dataclass(eq=False)
class StationJournal:
    """Entries in the order of the stations, kept in a folder, or only in memory if that is None."""

    folder: Path | None
    identity: str
    entries: list[JournalEntry] = field(default_factory=list)

    @classmethod
    def open(cls, folder: Path | None, recording: Recording, settings: ReconstructionSettings) -> StationJournal:
        """Open the journal of the same recording and settings, or start a new one."""
        if folder is None:
            return cls(None, "")
        identity = [_VERSION, recording.name, fingerprint(recording, contents=False), asdict(settings)]
        journal = cls(folder, json.dumps(identity))
        while entry := _read(folder, len(journal.entries), journal.identity):
            journal.entries.append(entry)
        return journal

    def write(self, entry: JournalEntry) -> None:
        """Append a station."""
        self.entries.append(entry)
        if self.folder is None:
            return
        arrays: dict[str, Any] = {"identity": self.identity, "report": json.dumps(asdict(entry.report))}
        if entry.cloud is not None:
            arrays |= vars(entry.cloud)
        arrays |= {f"depth {name}": depth for name, depth in entry.min_depths.items()}
        for earlier, edge in entry.edges.items():
            arrays |= {f"pose {earlier}": edge.first_from_second, f"information {earlier}": edge.information}
        np.savez(buffer := io.BytesIO(), **arrays)
        write_atomically(station_file(self.folder, entry.report.station), buffer.getvalue())


def station_file(folder: Path, station: int) -> Path:
    """Return the file of a station in the folder of a journal."""
    return folder / f"{station:06d}.npz"


def _read(folder: Path, station: int, identity: str) -> JournalEntry | None:
    """Read the entry of a station; None if it is missing, damaged or of another registration."""
    try:
        with np.load(station_file(folder, station), allow_pickle=False) as file:
            arrays = dict(file)
        report = _REPORT.validate_json(str(arrays["report"]))
        if str(arrays["identity"]) != identity or report.station != station:
            return None
        by_kind: dict[str, dict[str, Any]] = {"depth": {}, "pose": {}, "information": {}}
        for name, array in arrays.items():
            kind, _, key = name.partition(" ")
            if key:
                by_kind[kind][key] = array
        edges = {int(k): PoseEdge(pose, by_kind["information"][k]) for k, pose in by_kind["pose"].items()}
        cloud = PackedCloud(*(arrays[name] for name in ("points", "colors", "normals"))) if "points" in arrays else None
    except Exception:  # damage has any form
        return None
    return JournalEntry(report, edges, cloud, by_kind["depth"])
