"""A reconstruction on one page that opens anywhere: pictures and plots inside, no scripts, no network.

The files of a reconstruction are written to a work folder and moved into place when they are complete.
"""

from __future__ import annotations

import re
import shutil
from base64 import b64encode
from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from greenhouse_gym.capture import Recording
from greenhouse_gym.capture.image_files import read_color
from greenhouse_gym.common.extras import needs
from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.common.settings_files import as_toml
from greenhouse_gym.common.tables import Table
from greenhouse_gym.errors import FileWriteError
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction import (
    ReconstructionSettings,
    RowCloud,
    StationReport,
    TriangleMesh,
    report_as_json,
    save_row,
)
from greenhouse_gym.reconstruction.report import CalibrationReport
from greenhouse_gym.reconstruction.row_cloud import merge_segment, remove_outliers
from greenhouse_gym.reconstruction.row_files import save_mesh, save_points
from greenhouse_gym.reconstruction.station_registration import RegisteredStations
from greenhouse_gym.reporting.pages import render
from greenhouse_gym.reporting.pictures import occupancy_picture, registration_pictures, row_pictures
from greenhouse_gym.reporting.plots import BAD, GOOD, hover, limits_around, svg_plot, whole_numbers

with needs("reconstruct"):
    import cv2

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CAPTIONS = {
    "1": "Stations {0} and {1} of the reference camera: neighbors of median fitness.",
    "2": "Their foreground: the part that belongs to the row.",
    "3": "Their silhouettes at the best shift: station {0} red, station {1} blue, both purple.",
    "4": "Their clouds (station {0} red, station {1} blue) before ICP, left, and after it, right.",
    "5": "The longest segment, one color per station, before outliers are removed.",
    "6": "The same without outliers.",
    "7": "The row in its own colors.",
    "8": "The mesh.",
    "9": "Occupancy of the scanned space: across the row with the aisle on the left, and along the row halfway to the "
    "plants. White is free, green is occupied, gray is unknown: no camera observed it.",
}
"""By the first character of a picture's name; those up to 4 show one pair of stations."""


class _Picture(NamedTuple):
    image: str
    caption: str


def report_page(
    name: str,
    rows: Sequence[RowCloud],
    faces: int,
    head: Array,
    settings: ReconstructionSettings,
    pair: tuple[int, int] | None,
    pictures: Sequence[Path],
    observed: float | None = None,
) -> str:
    """Return the report on a reconstruction as one HTML page.

    Args:
        name: Name of the recording.
        rows: All segments, the longest first.
        faces: Number of faces of the mesh.
        head: (3,) the reference camera in the rig frame.
        settings: Settings of the reconstruction.
        pair: Stations in the pictures of a registration, if there are any.
        pictures: PNG files as `registration_pictures` and `row_pictures` name them, in the page's order.
        observed: Observed fraction of the space within an arm's reach, if known.
    """
    report = rows[0].report
    paths = [_camera_path(row, head) for row in rows]
    walked = sum(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) for path in paths)
    registered = sum(int(row.registered.sum()) for row in rows)
    shown = {path.name: _picture(path, _CAPTIONS[path.name[0]].format(*pair or ("", ""))) for path in pictures}
    return render(
        "reconstruction.html",
        title=name,
        warning_texts=report.warnings,
        totals={
            "stations registered": f"{registered} of {len(report.stations)}",
            "walked": f"{walked:.2f} m",
            "points": f"{sum(map(len, rows)):,}",
            "mesh faces": f"{faces:,}",
            "segments" if len(rows) > 1 else "segment": f"{len(rows)}",
            **({} if observed is None else {"of the space within reach observed": f"{observed:.0%}"}),
        },
        calibration=report.calibration,
        cameras=_cameras(report.calibration),
        pair_pictures=[picture for name, picture in shown.items() if name[0] in "1234"],
        row_pictures=[picture for name, picture in shown.items() if name[0] not in "1234"],
        quality_plots=_quality_plots(report.stations, settings),
        path_plots=[_path_plot(row, path) for row, path in zip(rows, paths, strict=True)],
        stations=_stations(report.stations),
        segments=len(rows),
        files=_files(rows),
        seconds=", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in report.seconds.items()),
    )


def segment_name(segment: int) -> str:
    """Return the name of a segment's files, without suffix: row, row-2, row-3."""
    return f"row-{segment + 1}" if segment else "row"


def _cameras(found: CalibrationReport) -> Table:
    """Return the depth error of each camera, and the correction of its pose if the rig was corrected."""
    heads, rows = ["camera", "reports depths"], [[name, _depth_error(bias)] for name, bias in found.bias.items()]
    if found.turned:
        heads += ["turned by", "shifted by"]
        for row in rows:
            row += [f"{np.degrees(found.turned[row[0]]):.2f}°", f"{1e3 * found.shifted[row[0]]:.1f} mm"]
    return Table(heads, rows)


def _depth_error(bias: float) -> str:
    return f"{abs(bias):.2%} too {'long' if bias > 0 else 'short'}"


def _picture(path: Path, caption: str) -> _Picture:
    """Embed a picture as PNG or JPEG, whichever is smaller."""
    image = read_color(path)
    _, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 85])
    kind, data = min(("png", path.read_bytes()), ("jpeg", jpeg.tobytes()), key=lambda encoded: len(encoded[1]))
    source = f"data:image/{kind};base64,{b64encode(data).decode()}"
    size = f'width="{image.shape[1]}" height="{image.shape[0]}"'
    return _Picture(f'<img src="{source}" {size} alt="{escape(caption)}">', caption)


def _measured(station: StationReport) -> tuple[float, float] | None:
    """Return fitness and RMSE in millimetres, or None if ICP did not run."""
    if station.fitness is None or station.rmse is None or not isfinite(station.rmse):
        return None
    return station.fitness, 1e3 * station.rmse


def _quality_plots(stations: Sequence[StationReport], settings: ReconstructionSettings) -> list[str]:
    """Plot fitness and RMSE of each station, and the thresholds of acceptance."""
    measured = [(station, values) for station in stations if (values := _measured(station))]

    def draw(axes: Axes, column: int, label: str, unit: str, limit: float, top: float) -> None:
        axes.axhline(limit, color=BAD, linestyle="--", linewidth=1)
        for station, values in measured:
            edge, face = (BAD, "white") if station.reason else (GOOD, GOOD)
            (dot,) = axes.plot(station.station, values[column], "o", markeredgecolor=edge, markerfacecolor=face)
            hover(dot, f"station {station.station}: {values[column]:.2f} {unit}")
        axes.set(xlabel="station", ylabel=label, xlim=(-0.5, len(stations) - 0.5))
        axes.set_ylim(0, max([top, *(1.05 * values[column] for _, values in measured)]))
        whole_numbers(axes)

    limit = 1e3 * settings.max_rmse
    fitness = partial(draw, column=0, label="fitness", unit="", limit=settings.min_fitness, top=1.0)
    rmse = partial(draw, column=1, label="RMSE, mm", unit="mm", limit=limit, top=1.1 * limit)
    return [svg_plot("fitness of each station", fitness), svg_plot("RMSE of each station", rmse)]


def _path_plot(row: RowCloud, path: Array) -> tuple[str, str]:
    """Plot the path of the reference camera through a segment from above; return the plot and its caption."""
    numbers = np.flatnonzero(row.registered)
    every = -(-len(numbers) // 20)
    along, across = path[:, 1], 100 * path[:, 0]

    def draw(axes: Axes) -> None:
        for k, (number, x, y) in enumerate(zip(numbers, along, across, strict=True)):
            (dot,) = axes.plot(x, y, "o", color=GOOD)
            hover(dot, f"station {number}")
            if k % every == 0:
                axes.annotate(str(number), (x, y), (0, 6), textcoords="offset points", ha="center")
        axes.set(xlabel="along the row, m", ylabel="across, cm")
        axes.set_xlim(limits_around(along, 0.2)[::-1])
        axes.set_ylim(limits_around(across, 6.0))

    caption = (
        f"Path of the tripod from above, segment {row.report.segment + 1}, in the frame of its first station: a slope "
        "shows that this station stood turned. The plants are at the top; left and right are as in the pictures."
    )
    return svg_plot(caption, draw, width=1120), caption


def _camera_path(row: RowCloud, head: Array) -> Array:
    """Return the positions (k, 3) of the reference camera at the stations of a segment."""
    poses = row.world_from_station[row.registered]
    return np.asarray(poses[:, :3, :3] @ head + poses[:, :3, 3])


def _stations(stations: Sequence[StationReport]) -> Table:
    rows = []
    for s in stations:
        against = "" if s.against is None else f"rejected by {s.against}" if s.reason else str(s.against)
        quality = [f"{value:.2f}" for value in _measured(s) or ()] or ["", ""]
        segment = "none" if s.segment is None else str(s.segment + 1)
        blind = [f"camera {name!r} saw no foreground" for name in s.blind]
        reason = "; ".join([s.reason, *blind] if s.reason else blind)
        shift = "" if s.shift_pixels is None else str(s.shift_pixels)
        rows.append((str(s.station), against, shift, *quality, segment, reason))
    return Table(("station", "registered to", "shift, px", "fitness", "RMSE, mm", "segment", "reason"), rows, {6})


def _files(rows: Sequence[RowCloud]) -> Table:
    """List the files next to the page."""
    files = []
    for row in rows:
        name, numbers = segment_name(row.report.segment), np.flatnonzero(row.registered)
        content = f"segment {row.report.segment + 1}: {len(numbers)} of stations {numbers[0]} to {numbers[-1]}"
        files.append((f"{name}.npz, {name}.ply", f"{content}, {len(row):,} points"))
    files += [("mesh.ply", "the mesh of segment 1"), ("report.json", "the figures of this page, for programs")]
    return Table(("file", "content"), files, {0, 1})


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
