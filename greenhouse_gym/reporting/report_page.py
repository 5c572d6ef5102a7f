"""A reconstruction on one page that opens anywhere: pictures and plots inside, no scripts, no network."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from math import isfinite
from pathlib import Path
from string import Template
from typing import Literal

import numpy as np

from greenhouse_gym import __version__
from greenhouse_gym.capture.images import read_color
from greenhouse_gym.common.extras import needs
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction import ReconstructionSettings, RowCloud, StationReport
from greenhouse_gym.reconstruction.calibration import CalibrationReport
from greenhouse_gym.reporting import pieces
from greenhouse_gym.reporting.svg import Axis, Series, axis_around, plot

with needs("reconstruct"):
    import cv2

_PAGE = Template("""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$name</title>
<style>
$style
</style>
</head>
<body>
<h1>$name</h1>
$warnings
$figures
<h2>Cameras</h2>
$cameras
<h2>Pictures</h2>
$pictures
<h2>Stations</h2>
$plots
$stations
<h2>Files</h2>
$files
<footer>greenhouse-gym $version; $footer</footer>
</body>
</html>
""")

_CAPTIONS = {
    "1": "Stations {0} and {1} of the reference camera: neighbors of median fitness.",
    "2": "Their foreground: what belongs to the row.",
    "3": "Their silhouettes at the best shift: station {0} red, station {1} blue, both purple.",
    "4": "Their clouds (station {0} red, station {1} blue) where ICP began, left, and where it ended, right.",
    "5": "The longest segment, a color for each station, before outliers are removed.",
    "6": "The same without outliers.",
    "7": "The row in its own colors.",
    "8": "The mesh.",
    "9": "What the cameras saw of space: across the row with the aisle on the left, and along the row halfway to the "
    "plants. White is empty, green is surface, gray was never seen and may hold anything.",
}
"""By what the names of the pictures begin with."""


def report_page(
    name: str,
    rows: Sequence[RowCloud],
    faces: int,
    head: Array,
    settings: ReconstructionSettings,
    pair: tuple[int, int] | None,
    pictures: Sequence[Path],
    seen: float | None = None,
) -> str:
    """All about a reconstruction as one HTML page.

    Args:
        name: Name of the recording.
        rows: All segments, the longest first.
        faces: How many faces the mesh has.
        head: (3,) the reference camera in the rig frame.
        settings: The reconstruction's.
        pair: The stations that the pictures of a registration show, if there are any.
        pictures: PNG files as `registration_pictures` and `row_pictures` name them, in the page's order.
        seen: Share of the space within an arm's reach that was seen, if that is known.
    """
    report = rows[0].report
    paths = [_path(row, head) for row in rows]
    walked = sum(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) for path in paths)
    registered = sum(int(row.registered.sum()) for row in rows)
    return _PAGE.substitute(
        name=escape(name),
        style=pieces.STYLE,
        warnings=pieces.warnings(report.warnings),
        figures=pieces.figures(
            {
                "stations registered": f"{registered} of {len(report.stations)}",
                "walked": f"{walked:.2f} m",
                "points": f"{sum(map(len, rows)):,}",
                "mesh faces": f"{faces:,}",
                "segments" if len(rows) > 1 else "segment": f"{len(rows)}",
                **({} if seen is None else {"of the space within reach seen": f"{seen:.0%}"}),
            }
        ),
        cameras=_cameras(report.calibration),
        pictures=_pictures(pictures, pair),
        plots=_quality(report.stations, settings) + "".join(map(_seen_from_above, rows, paths)),
        stations=_stations(report.stations),
        files=_files(rows),
        footer=escape(", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in report.seconds.items())),
        version=__version__,
    )


def segment_name(segment: int) -> str:
    """What the files of a segment are called, without suffix: row, row-2, row-3."""
    return f"row-{segment + 1}" if segment else "row"


# -- the parts --------------------------------------------------------------------------------------------------------


def _cameras(found: CalibrationReport) -> str:
    """Depth errors, where the cameras stand, and by how much edges have grown."""
    grown = pieces.paragraph(_fattening(found)) if any(found.fattening) else ""
    if not found.gap_before:
        text = "The cameras saw too little in common to be calibrated; the rig file was trusted."
        return pieces.paragraph(text) + grown
    gaps = f"{1e3 * found.gap_before:.2f} mm before calibration and {1e3 * found.gap_after:.2f} mm after it"
    text = f"Where two cameras see one surface, the median distance between their readings is {gaps}. "
    if not found.turned:
        text += "The cameras stand where the rig file has them."
        return (
            pieces.paragraph(text)
            + pieces.table(
                ("camera", "reports depths"), ((name, _depth_error(bias)) for name, bias in found.bias.items()), {0}
            )
            + grown
        )
    text += "The rig was corrected: cameras stand elsewhere than the rig file has them."
    rows = (
        (name, _depth_error(bias), f"{np.degrees(found.turned[name]):.2f}°", f"{1e3 * found.shifted[name]:.1f} mm")
        for name, bias in found.bias.items()
    )
    return (
        pieces.paragraph(text)
        + pieces.table(("camera", "reports depths", "turned by", "shifted by"), rows, {0})
        + grown
    )


def _fattening(found: CalibrationReport) -> str:
    """By how much edges had grown."""
    along_rows, along_columns = found.fattening
    return (
        f"Beside the edges that photographs show, near things reached {along_rows} px too far along the rows of the "
        f"depth images and {along_columns} px along their columns; this was taken out."
    )


def _depth_error(bias: float) -> str:
    return f"{abs(bias):.2%} too {'long' if bias > 0 else 'short'}"


def _pictures(paths: Sequence[Path], pair: tuple[int, int] | None) -> str:
    """The pictures of one registration two by two, those of the row below each other."""
    figures = {path.name: _figure(path, _CAPTIONS[path.name[0]].format(*pair or ("", ""))) for path in paths}
    of_pair = "".join(figure for name, figure in figures.items() if name[0] in "1234")
    of_row = "".join(figure for name, figure in figures.items() if name[0] not in "1234")
    return f'<div class="pair">{of_pair}</div>{of_row}'


def _figure(path: Path, caption: str) -> str:
    """A picture as PNG or JPEG, whichever is smaller, with its caption."""
    image = read_color(path)
    _, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 85])
    kind, data = min(("png", path.read_bytes()), ("jpeg", jpeg.tobytes()), key=lambda encoded: len(encoded[1]))
    source = f"data:image/{kind};base64,{b64encode(data).decode()}"
    size = f'width="{image.shape[1]}" height="{image.shape[0]}"'
    text = escape(caption)
    return f'<figure><img src="{source}" {size} alt="{text}"><figcaption>{text}</figcaption></figure>\n'


def _measured(station: StationReport) -> tuple[float, float] | None:
    """Fitness and RMSE in millimetres, where ICP came that far."""
    if station.fitness is None or station.rmse is None or not isfinite(station.rmse):
        return None
    return station.fitness, 1e3 * station.rmse


def _quality(stations: Sequence[StationReport], settings: ReconstructionSettings) -> str:
    """Fitness and RMSE of each station, and what is accepted."""
    measured = [(station, values) for station in stations if (values := _measured(station))]
    across = Axis("station", -0.5, len(stations) - 0.5)

    def draw(column: int, title: str, unit: str, limit: float, least: float) -> str:
        def series(style: Literal["good", "bad"]) -> Series:
            chosen = [(s.station, v[column]) for s, v in measured if bool(s.reason) == (style == "bad")]
            return Series(
                np.reshape(chosen, (-1, 2)), style, [f"station {i}: {value:.2f} {unit}" for i, value in chosen]
            )

        top = max([least, *(1.05 * values[column] for _, values in measured)])
        accepted = Series(np.array([[across.low, limit], [across.high, limit]]), "limit")
        label = f"{title}, {unit}" if unit else title
        dots = [accepted, series("good"), series("bad")]
        return f"<figure>{plot(f'{title} of each station', across, Axis(label, 0, top), dots)}</figure>"

    most = 1e3 * settings.max_rmse
    text = (
        "Fitness: the share of the points both stations could see that found a partner; accepted above the dashed "
        "line. RMSE: how far those partners lie apart; accepted below it. Hollow red dots were refused."
    )
    plots = draw(0, "fitness", "", settings.min_fitness, 1.0) + draw(1, "RMSE", "mm", most, 1.1 * most)
    return f'{pieces.paragraph(text)}<div class="pair">{plots}</div>'


def _seen_from_above(row: RowCloud, path: Array) -> str:
    """The way of the reference camera through a segment, with the numbers of about twenty stations."""
    numbers = np.flatnonzero(row.registered)
    every = -(-len(numbers) // 20)
    series = Series(
        path[:, [1, 0]] * [1.0, 100.0],
        "good",
        [f"station {number}" for number in numbers],
        [str(number) if k % every == 0 else "" for k, number in enumerate(numbers)],
    )
    along = axis_around("along the row, m", series.points[:, 0], 0.2, flipped=True)
    across = axis_around("across, cm", series.points[:, 1], 6.0)
    segment = row.report.segment
    caption = (
        f"The tripod's way seen from above, segment {segment + 1}, in the frame of its first station: a slope shows "
        "that this one stood turned. The plants are at the top; left and right are as in the pictures."
    )
    drawn = plot(caption, along, across, [series], width=1120)
    return f"<figure>{drawn}<figcaption>{escape(caption)}</figcaption></figure>"


def _path(row: RowCloud, head: Array) -> Array:
    """Where the reference camera stood at each station of a segment, (k, 3)."""
    poses = row.world_from_station[row.registered]
    return np.asarray(poses[:, :3, :3] @ head + poses[:, :3, 3])


def _stations(stations: Iterable[StationReport]) -> str:
    """What happened to each station."""
    rows = []
    for s in stations:
        against = "" if s.against is None else f"refused by {s.against}" if s.reason else str(s.against)
        quality = [f"{value:.2f}" for value in _measured(s) or ()] or ["", ""]
        segment = "none" if s.segment is None else str(s.segment + 1)
        blind = [f"camera {name!r} saw no foreground" for name in s.blind]
        reason = "; ".join([s.reason, *blind] if s.reason else blind)
        shift = "" if s.shift_pixels is None else str(s.shift_pixels)
        rows.append((str(s.station), against, shift, *quality, segment, reason))
    return pieces.table(
        ("station", "registered to", "shift, px", "fitness", "RMSE, mm", "segment", "reason"), rows, {6}
    )


def _files(rows: Sequence[RowCloud]) -> str:
    """What lies beside the page."""
    table = []
    for row in rows:
        name, numbers = segment_name(row.report.segment), np.flatnonzero(row.registered)
        content = f"segment {row.report.segment + 1}: {len(numbers)} of stations {numbers[0]} to {numbers[-1]}"
        table.append((f"{name}.npz, {name}.ply", f"{content}, {len(row):,} points"))
    table += [("mesh.ply", "the mesh of segment 1"), ("report.json", "what this page tells, for programs")]
    text = "Stations of two segments could not be registered to each other, so each segment has a frame of its own."
    return (pieces.paragraph(text) if len(rows) > 1 else "") + pieces.table(("file", "content"), table, {0, 1})
