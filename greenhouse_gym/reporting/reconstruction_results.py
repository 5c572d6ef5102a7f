"""The files of a reconstruction, written to a work folder and moved into place when they are complete."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from greenhouse_gym.capture import Recording
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.common.settings_files import as_toml
from greenhouse_gym.errors import FileWriteError
from greenhouse_gym.reconstruction import (
    ReconstructionSettings,
    RowCloud,
    StationReport,
    TriangleMesh,
    report_as_json,
    save_row,
)
from greenhouse_gym.reconstruction.row_cloud import merge_segment, remove_outliers
from greenhouse_gym.reconstruction.row_files import save_mesh, save_points
from greenhouse_gym.reconstruction.station_registration import RegisteredStations
from greenhouse_gym.reporting.pictures import occupancy_picture, registration_pictures, row_pictures
from greenhouse_gym.reporting.report_page import report_page, segment_name


def write_results(
    stations: RegisteredStations,
    recording: Recording,
    settings: ReconstructionSettings,
    mesh_as: Callable[[RowCloud], TriangleMesh],
    out: Path,
    work: Path,
) -> tuple[list[RowCloud], TriangleMesh]:
    """Write the clouds of all segments, and mesh, pictures and report of the longest.

    Args:
        stations: The registered stations of the recording.
        recording: The recording, read again for pictures of its stations.
        settings: Settings of the reconstruction.
        mesh_as: Makes the mesh of a cloud.
        out: Folder of the results; those of an earlier reconstruction stay until all new ones are complete.
        work: Folder on the same disk for incomplete results; emptied first.

    Returns:
        The cloud of each segment, the longest first, and the mesh.

    Raises:
        FileWriteError: A file could not be written, for example because the disk is full.
    """
    shutil.rmtree(work, ignore_errors=True)
    merged, outlier = merge_segment(stations, 0, settings)
    rows = [remove_outliers(merged, outlier)]
    rows += [remove_outliers(*merge_segment(stations, k, settings)) for k in range(1, len(stations.segments))]
    for k, row in enumerate(rows):
        save_row(row, work / f"{segment_name(k)}.npz")
        save_points(row, work / f"{segment_name(k)}.ply")
    mesh = mesh_as(rows[0])
    save_mesh(mesh, work / "mesh.ply")
    report = rows[0].report
    write_atomically(work / "report.json", report_as_json(report))
    write_atomically(work / "settings.toml", as_toml(settings))
    pair = typical_pair(report.stations)
    pictures = registration_pictures(recording, *pair, stations.calibration, settings, work) if pair else []
    pictures += row_pictures(merged, rows[0], mesh, work)
    picture, observed = occupancy_picture(rows[0], work)
    pictures.append(picture)
    head = recording.rig.cameras[recording.rig.reference].rig_from_camera[:3, 3]
    page = report_page(recording.name, rows, len(mesh.triangles), head, settings, pair, pictures, observed)
    write_atomically(work / "report.html", page)
    _put_in_place(work, out)
    return rows, mesh


def typical_pair(stations: Sequence[StationReport]) -> tuple[int, int] | None:
    """Return the two neighbors whose registration has the median fitness; None if no neighbors were registered."""
    pairs = sorted(
        (s.fitness, s.station) for s in stations
        if s.registered and not s.reason and s.against == s.station - 1 and s.fitness is not None
    )  # fmt: skip
    if not pairs:
        return None
    _, station = pairs[(len(pairs) - 1) // 2]
    return station - 1, station


def _put_in_place(work: Path, out: Path) -> None:
    """Move results from one folder to another and replace those of an earlier run."""
    try:
        for old in out.iterdir():
            if re.fullmatch(r"row-\d+\.(npz|ply)|[1-9]-[a-z-]+\.png", old.name):
                old.unlink()
        for path in work.iterdir():
            path.replace(out / path.name)
    except OSError as error:
        raise FileWriteError(out, error) from error
